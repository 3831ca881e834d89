"""Partial derivatives of every ufunc that has a rule, and jumps, against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bayesmc.expression import Program, as_expression, elementwise, leaf
from bayesmc.passes import partials
from bayesmc.passes.derivatives import jumps, tangent

#: inside of the domain of everything but what wants numbers above 1
POINTS = np.array([0.31, 0.72, 0.55]), np.array([0.64, 0.17, 0.93])


def slopes_and_differences(ufunc: Any) -> tuple[np.ndarray, np.ndarray]:
    """Along a direction; central differences of the fourth order, good to some 1e-10."""
    values = [p + (ufunc is np.arccosh) for p in POINTS[: ufunc.nin]]
    moves = [0.7, -1.3][: ufunc.nin]
    names = ["a", "b"][: ufunc.nin]
    root = elementwise(ufunc, *(leaf(n, ()) for n in names))
    along = {n: as_expression(m) for n, m in zip(names, moves, strict=True)}
    (found,) = Program([tangent(root, along)])(dict(zip(names, values, strict=True)))

    def at(step: float) -> np.ndarray:
        return ufunc(*(v + step * m for v, m in zip(values, moves, strict=True)))

    h = 1e-3
    return found, (at(-2 * h) - 8 * at(-h) + 8 * at(h) - at(2 * h)) / (12 * h)


@pytest.mark.parametrize("ufunc", partials._PARTIALS, ids=lambda u: u.__name__)
def test_every_rule_is_right(ufunc: Any) -> None:
    found, wanted = slopes_and_differences(ufunc)
    np.testing.assert_allclose(np.broadcast_to(found, wanted.shape), wanted, rtol=1e-7, atol=1e-8)


def test_a_wrong_rule_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control."""
    wrong = {**partials._PARTIALS, np.sin: (lambda x, y: np.cos(x) * (1 + 1e-6),)}
    monkeypatch.setattr(partials, "_PARTIALS", wrong)
    found, wanted = slopes_and_differences(np.sin)
    assert not np.allclose(found, wanted, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(
    ("ufunc", "place"),
    [(np.floor, 2.0), (np.rint, 0.5), (np.sign, 0.0), (np.greater, 1.5), (np.floor_divide, 3.0)],
    ids=lambda x: getattr(x, "__name__", ""),
)
def test_jumps_are_told(ufunc: Any, place: float) -> None:
    x = leaf("x", ())
    root = elementwise(ufunc, x) if ufunc.nin == 1 else elementwise(ufunc, x, 1.5)
    (found,) = Program([jumps([root], ["x"])])({"x": np.array([place, place + 0.25])})
    assert found.tolist() == [True, False]
    (still,) = Program([jumps([root], ["z"])])({"x": np.array(place)})  # what moves it not
    assert not still
