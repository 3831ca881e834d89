"""Graphs of random functions hold what the functions compute, and how that moves."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.expression import Program, TracedArray, leaf, reduction, trace
from bayesmc.passes.derivatives import gradient, tangent
from tests.expression.random_functions import ARGUMENTS, random_arguments, random_function

BATCHES = (
    dict.fromkeys(ARGUMENTS, ()),
    dict.fromkeys(ARGUMENTS, (7,)),
    dict.fromkeys(ARGUMENTS, (2, 6)),
    dict(zip(ARGUMENTS, [(2, 6), (6,), (2, 1), (), (6,), (1, 6)], strict=True)),
)
#: sqrt(eps) of longer numbers is none of NumPy's; differences of this width are good to 1e-9
WIDTH = 1e-3


def stand_ins() -> list[TracedArray]:
    found = []
    for name, (shape, dtype) in ARGUMENTS.items():
        full = (1, *shape) if name in ("a", "v", "k") else shape
        found.append(TracedArray(leaf(name, full, dtype)))
    return found


def close(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    scale = max(np.abs(a).max(initial=1.0), np.abs(b).max(initial=1.0))
    return bool(np.abs(a - b).max(initial=0.0) <= tolerance * scale)


@pytest.mark.parametrize("part", range(10))
def test_a_graph_computes_what_the_function_does(part: int) -> None:
    for seed in range(100 * part, 100 * (part + 1)):
        rng = np.random.default_rng([18, seed])
        function = random_function(rng)
        program = Program([trace(function, stand_ins())])
        for batches in BATCHES:
            values = random_arguments(rng, batches)
            (found,) = program(values)
            expected = function(*values.values())
            assert close(*np.broadcast_arrays(found, expected), 1e-12), (seed, function.__doc__)


@pytest.mark.parametrize("part", range(4))
def test_derivatives_are_those_of_differences(part: int) -> None:
    """Central differences of a high order, extrapolated: good to some 1e-9 of the largest entry."""
    for seed in range(25 * part, 25 * (part + 1)):
        rng = np.random.default_rng([19, seed])
        function = random_function(rng)
        root = trace(function, stand_ins())
        total = reduction(np.add, root, range(len(root.shape)))
        real = [n for n, (_, dtype) in ARGUMENTS.items() if dtype is float and n in total.leaves]
        if not real:
            continue
        found = gradient(total, real)
        program = Program([*found.values()])
        values = random_arguments(rng, dict.fromkeys(ARGUMENTS, ()))
        direction = {n: rng.normal(size=values[n].shape) for n in real}
        slopes = program(values)
        along = sum(float((s * direction[n]).sum()) for n, s in zip(found, slopes, strict=True))
        expected = _difference(function, values, direction)
        if expected is None:  # a kink or a jump lies between
            continue
        assert along == pytest.approx(expected, rel=1e-7, abs=1e-7), (seed, function.__doc__)
        moved = tangent(total, {n: _constant(d) for n, d in direction.items()})
        (forward,) = Program([moved])(values)
        assert float(forward) == pytest.approx(along, rel=1e-9, abs=1e-9), (seed, function.__doc__)


def _constant(value: np.ndarray):
    from bayesmc.expression import as_expression

    return as_expression(value)


def _difference(function, values, direction) -> float | None:
    def at(step: float) -> float:
        moved = {n: v + step * direction[n] if n in direction else v for n, v in values.items()}
        return float(np.sum(function(*moved.values())))

    found = []
    for width in (WIDTH, WIDTH / 2):
        steps = [at(k * width) for k in (-2, -1, 1, 2)]
        found.append((steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * width))
    coarse, fine = found
    smooth = abs(coarse - fine) <= 1e-7 * max(1.0, abs(fine))
    return (16 * fine - coarse) / 15 if smooth else None
