"""Functions that are said in terms of others give what NumPy does, at the edges too."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bayesmc.expression import Program, TracedArray, evaluate, leaf, trace
from bayesmc.expression.graph import Call, ordered, reduction
from bayesmc.passes.derivatives import gradient

X = TracedArray(leaf("x", (2, 3)))
ODD = np.array([-np.inf, -3.0, -1.0, 0.25, 2.0, 5.0, np.inf, np.nan])


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7, 9])
@pytest.mark.parametrize("ends", [{}, {"left": -7.0}, {"right": np.nan}, {"left": 1, "right": 2}])
def test_interpolation_among_known_knots_is_that_of_numpy(count: int, ends: dict) -> None:
    rng = np.random.default_rng(count)
    knots, heights = np.sort(rng.normal(size=count)), rng.normal(size=count)
    x = np.concatenate([ODD, knots, rng.normal(size=20)])
    root = trace(lambda x: np.interp(x, knots, heights, **ends), [TracedArray(leaf("x", x.shape))])
    assert not any(isinstance(n, Call) for n in ordered(root))
    (found,) = Program([root])({"x": x[None]})
    np.testing.assert_allclose(found[0], np.interp(x, knots, heights, **ends), rtol=1e-14)


@pytest.mark.parametrize(
    "how",
    [
        lambda x: np.interp(x, [0.0, 1.0, 1.0, 2.0], [0.0, 1.0, 3.0, 4.0]),  # a jump
        lambda x: np.interp(x, [0.0, 1.0], [3.0, 4.0], period=2.0),
        lambda x: np.interp(x, [0.5], [3.0]),
        lambda x: np.interp(x, [0.0, 1.0, 3.0], [0.0, 1.0, -np.inf]),
        lambda x: np.interp(x, [0.0, 5e-324, 3.0], [0.0, 1.0, 2.0]),
    ],
    ids=["jump", "period", "one", "infinite", "steep"],
)
def test_other_interpolation_is_called_as_it_stands(how: Any) -> None:
    x = np.array([-0.3, 0.2, 1.0, 1.4, 9.0])
    root = trace(how, [TracedArray(leaf("x", x.shape))])
    (found,) = Program([root])({"x": x[None]})
    np.testing.assert_array_equal(found[0], how(x))


def test_a_slope_is_that_of_the_piece() -> None:
    knots, heights = np.array([-1.0, 0.5, 0.7, 3.0]), np.array([0.0, 3.0, 2.0, 2.5])
    root = trace(lambda x: np.interp(x, knots, heights), [TracedArray(leaf("x", (6,)))])
    (slope,) = gradient(reduction(np.add, root, [0]), ["x"]).values()
    x = np.array([[-2.0, -0.5, 0.6, 0.8, 2.9, 4.0]])
    wanted = np.array([[0.0, 2.0, -5.0, 0.5 / 2.3, 0.5 / 2.3, 0.0]])
    np.testing.assert_allclose(evaluate([slope], {"x": x})[0], wanted, rtol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, -1, None])
@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_running_products_are_those_of_numpy(axis: int | None, size: int) -> None:
    x = np.random.default_rng(size).normal(size=(3, size))
    x[1, 0] = 0.0
    root = trace(lambda x: np.cumprod(x, axis=axis), [TracedArray(leaf("x", x.shape))])
    (found,) = Program([root])({"x": x[None]})
    np.testing.assert_allclose(found[0], np.cumprod(x, axis=axis), rtol=1e-14)
    assert X.cumprod(axis=0).expression is np.cumprod(X, axis=0).expression


def test_running_products_of_truths_are_counts() -> None:
    x = np.array([2.0, 2.0, 0.5, 2.0])
    root = trace(lambda x: np.cumprod(x > 0) + np.cumprod(x > 1), [TracedArray(leaf("x", x.shape))])
    assert Program([root])({"x": x[None]})[0].tolist() == [[2, 2, 1, 1]]
