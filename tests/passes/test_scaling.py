"""Known factors and summands put together: the same values, with fewer operations on large arrays."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
import pytest

from bayesmc.expression import Elementwise, Expression, Program, TracedArray, leaf, ordered, trace
from bayesmc.passes import scaling
from bayesmc.passes.scaling import rescaled
from bayesmc.testing import session
from tests.expression.random_functions import ARGUMENTS, random_arguments, random_function
from tests.expression.test_random_functions import stand_ins

WEIGHTS = np.linspace(-1.0, 2.0, 40)  # 0 is none of them
COUNTS = np.arange(40) % 3
#: of x (40,), m (1,), s () -> element-wise operations on all of x's elements that are left
SUMS: dict[str, tuple[Any, int]] = {
    "normal": (lambda x, m, s: (-0.5 * ((x - m) / 2.0) ** 2 - 0.9 - np.log(2.0)).sum(), 2),
    "each its own": (lambda x, m, s: (-0.5 * ((x - m) / WEIGHTS) ** 2 - WEIGHTS).sum(), 4),
    "a constant in front": (lambda x, m, s: (3.0 - 2.0 * (-x)).sum(), 0),
    "of a quotient": (lambda x, m, s: ((2.0 * x) / (4.0 * np.exp(x)) * -1.0).sum(), 2),
    "what is the same for all": (lambda x, m, s: (np.sin(x) - m).sum(), 1),
    "counts with zeros": (lambda x, m, s: (COUNTS * x - COUNTS).sum(), 1),
    "of picks": (lambda x, m, s: np.exp((2.0 * x + WEIGHTS)[..., ::-1]).sum(), 3),
    "equal factors": (lambda x, m, s: (0.5 * np.sin(x) + 0.5 * np.cos(x)).sum(), 3),
    "opposite factors": (lambda x, m, s: (0.5 * np.sin(x) - 0.5 * np.cos(x)).sum(), 3),
    "one over": (lambda x, m, s: (-3.0 / (2.0 * np.exp(x))).sum(), 2),
    "rows": (lambda x, m, s: (2.0 * x[..., None] + np.ones(3)).sum(axis=-1).sum(), 1),
    "turned round": (lambda x, m, s: np.exp(-(x + 3.0)).sum(), 3),
}


def traced(function: Any) -> Expression:
    return trace(
        function, [TracedArray(leaf(n, s)) for n, s in (("x", (40,)), ("m", (1,)), ("s", ()))]
    )


@pytest.mark.parametrize("name", SUMS)
def test_sums(name: str) -> None:
    function, left = SUMS[name]
    root = traced(function)
    (made,) = rescaled([root])
    wide = [n for n in ordered(made) if isinstance(n, Elementwise) and n.size >= 40]
    assert len(wide) <= left
    rng = np.random.default_rng(0)
    values = {"x": rng.normal(size=(3, 40)), "m": rng.normal(size=(3, 1)), "s": rng.normal(size=3)}
    plain, written = Program([root])(values), Program([made])(values)
    np.testing.assert_allclose(np.broadcast_to(written[0], (3,)), plain[0], rtol=1e-12, atol=1e-12)


def test_what_is_infinite_stays_where_it_is() -> None:
    ends = np.where(np.arange(40) == 7, -np.inf, 0.0)
    root = traced(lambda x, m, s: np.exp(x + ends).sum() + (0.0 * x).sum())
    (made,) = rescaled([root])
    values = {"x": np.full(40, np.log(2.0)), "m": np.zeros(1), "s": np.array(0.0)}
    assert Program([made])(values)[0] == pytest.approx(78.0)


SEEDS = range(session.seed(), session.seed() + session.scaled(150, 20))


def differing() -> list[int]:
    found = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        root = trace(random_function(rng, 12), stand_ins())
        given = random_arguments(rng, dict.fromkeys(ARGUMENTS, ()))
        plain, written = Program([root, *rescaled([root])])(given)
        if not np.allclose(written, plain, rtol=1e-10, atol=1e-10):
            found.append(seed)
    return found


def test_random_functions_keep_their_values() -> None:
    assert not differing()


def test_lost_signs_and_factors_are_seen() -> None:
    """Negative control."""

    def wrong(node: Any, a: Any) -> Any:
        return scaling._Scaled(a.base, node.shape, -a.scale, a.offset)

    def dropped(node: Any, a: Any, b: Any) -> Any:
        found = scaling._multiply(node, a, b)
        return found if found is None else scaling._Scaled(found.base, node.shape)

    with mock.patch.object(scaling, "_RULES", {**scaling._RULES, np.negative: wrong}):
        with pytest.raises(AssertionError):
            test_sums("turned round")
    with mock.patch.object(scaling, "_RULES", {**scaling._RULES, np.multiply: dropped}):
        assert differing()
