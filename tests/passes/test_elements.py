"""Expressions taken apart into elements: the same values, whatever they are made of."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bayesmc.expression import (
    Expression,
    TracedArray,
    as_expression,
    elementwise,
    evaluate,
    leaf,
    ordered,
    reduction,
    trace,
)
from bayesmc.passes.elements import FEW, by_element, columns, together


def linear(x: Any, m: Any, s: Any) -> Any:
    return np.matvec(np.array([[0.5, 0.0], [1.0, -2.0]]), x) * s + m[..., 0]


def picked(x: Any, m: Any, s: Any) -> Any:
    return np.stack([x[..., 1] * s, np.exp(-x[..., 0]), m[..., 1, 0] + 0.0], axis=-1)


def summed(x: Any, m: Any, s: Any) -> Any:
    return np.sum(m * x[..., None], axis=-2) + np.max(m, axis=-1)


def alone(x: Any, m: Any, s: Any) -> Any:
    return s**2 / (1.0 + s**2)


LEAVES = [leaf("x", (2,)), leaf("m", (2, 2)), leaf("s", ())]


@pytest.mark.parametrize("function", [linear, picked, summed, alone])
@pytest.mark.parametrize("shared", [(), ("m",), ("x", "s")])
def test_values_are_the_same(function: Any, shared: tuple[str, ...]) -> None:
    root = trace(function, [TracedArray(node) for node in LEAVES])
    assert isinstance(root, Expression)
    rng = np.random.default_rng(0)
    values = {
        node.name: rng.normal(size=node.shape if node.name in shared else (50, *node.shape))
        for node in LEAVES
    }
    parts = by_element([root])
    assert parts is not None and parts[0].shape == root.shape
    each = list(parts[0].reshape(-1))
    assert all(not n.shape for n in ordered(*each))
    found = together(evaluate(each, columns(LEAVES, values)), root.shape, root.dtype)
    (wanted,) = evaluate([root], values)
    np.testing.assert_allclose(np.broadcast_to(found, wanted.shape), wanted, rtol=1e-12)
    assert found.dtype == wanted.dtype


def test_what_is_large_or_hangs_together_stays_whole() -> None:
    wide = leaf("w", (FEW**2 + 1,))
    assert by_element([elementwise(np.exp, wide)]) is None
    x = leaf("x", (2,))
    assert by_element([reduction(np.logaddexp, x, [0])]) is None
    assert by_element([elementwise(np.add, x, as_expression(np.ones(2)))]) is not None
