"""Graphs of random functions hold what the functions compute, and how that moves."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest

from bayesmc.expression import (
    Expression,
    Program,
    TracedArray,
    as_expression,
    leaf,
    reduction,
    trace,
)
from bayesmc.passes import derivatives
from bayesmc.passes.derivatives import gradient, tangent
from tests.expression.digits import DIGITS, decimals, in_digits
from tests.expression.random_functions import ARGUMENTS, random_arguments, random_function

BATCHES = (
    dict.fromkeys(ARGUMENTS, ()),
    dict.fromkeys(ARGUMENTS, (7,)),
    dict.fromkeys(ARGUMENTS, (2, 6)),
    dict(zip(ARGUMENTS, [(2, 6), (6,), (2, 1), (), (6,), (1, 6)], strict=True)),
)


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


def slopes_and_difference(seed: int) -> tuple[float, float, float] | None:
    """How a random function moves along a direction: reverse, forward, and by 50-digit differences."""
    rng = np.random.default_rng([19, seed])
    root = trace(random_function(rng), stand_ins())
    total = reduction(np.add, root, range(len(root.shape)))
    real = [n for n, (_, dtype) in ARGUMENTS.items() if dtype is float and n in total.leaves]
    if not real:
        return None
    values = random_arguments(rng, dict.fromkeys(ARGUMENTS, ()))
    along = {n: rng.normal(size=values[n].shape) for n in real}
    back = gradient(total, real)
    moved = tangent(total, {n: as_expression(d) for n, d in along.items()})
    forward, *slopes = Program([moved, *back.values()])(values)
    reverse = sum(float((s * along[n]).sum()) for n, s in zip(back, slopes, strict=True))
    return reverse, float(forward), _difference(total, values, along)


@pytest.mark.parametrize("part", range(10))
def test_derivatives_are_those_of_differences(part: int) -> None:
    """Of a thousand functions, to 1e-8."""
    compared = 0
    for seed in range(100 * part, 100 * (part + 1)):
        found = slopes_and_difference(seed)
        if found is not None:
            compared += 1
            reverse, forward, expected = found
            assert reverse == pytest.approx(expected, rel=1e-8, abs=1e-8), seed
            assert forward == pytest.approx(expected, rel=1e-8, abs=1e-8), seed
    assert compared > 80


def test_a_wrong_derivative_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A negative control: one that is off by a millionth."""
    rule = (lambda x, y: (1 + 1e-6) * np.cos(x),)
    monkeypatch.setitem(derivatives._KINKED, np.sin, rule)
    found = [f for f in map(slopes_and_difference, range(80)) if f is not None]
    off = [abs(reverse - expected) > 1e-8 * max(1, abs(expected)) for reverse, _, expected in found]
    assert sum(off) >= 2


def test_digits_are_those_of_numpy() -> None:
    """The reference itself: sixteen digits of it, which the library's evaluation gives, too."""
    for seed in range(40):
        rng = np.random.default_rng([20, seed])
        function = random_function(rng)
        values = random_arguments(rng, dict.fromkeys(ARGUMENTS, ()))
        found = in_digits(trace(function, stand_ins()), values).astype(float)
        assert close(*np.broadcast_arrays(found, function(*values.values())), 1e-13), seed


def _difference(
    total: Expression, values: dict[str, np.ndarray], along: dict[str, np.ndarray]
) -> float:
    """A central difference so narrow that it is right to some 35 digits."""
    with localcontext() as context:
        context.prec = DIGITS
        width = Decimal(10) ** -20

        def at(step: Decimal) -> Decimal:
            moved = {n: decimals(values[n]) + step * decimals(d) for n, d in along.items()}
            return in_digits(total, {**values, **moved}).item()

        return float((at(width) - at(-width)) / (2 * width))
