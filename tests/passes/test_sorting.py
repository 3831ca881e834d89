"""Orders of few numbers by comparisons are those of a stable sort."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bayesmc.expression import Call, TracedArray, evaluate, leaf, ordered
from bayesmc.passes.sorting import FEW, by_comparisons


def order(shape: tuple[int, ...], **has: Any) -> Any:
    return np.argsort(TracedArray(leaf("x", shape)), **has).expression  # type: ignore[call-overload]


@pytest.mark.parametrize("shape", [(1,), (2,), (5,), (FEW,), (3, 4)])
def test_it_is_a_stable_sort(shape: tuple[int, ...]) -> None:
    (found,) = by_comparisons([order(shape)])
    assert not any(isinstance(n, Call) for n in ordered(found)) and found.shape == shape
    rng = np.random.default_rng(len(shape))
    x = rng.integers(0, 4, (200, *shape)).astype(float)  # many are equal
    x[rng.random(x.shape) < 0.2] = np.nan
    x[rng.random(x.shape) < 0.1] = -np.inf
    np.testing.assert_array_equal(
        evaluate([found], {"x": x})[0], np.argsort(x, axis=-1, kind="stable")
    )


@pytest.mark.parametrize(
    "root", [order((FEW + 1,)), order((3, 2), axis=0)], ids=["many", "another axis"]
)
def test_others_stay(root: Any) -> None:
    assert any(isinstance(n, Call) for n in ordered(*by_comparisons([root])))
