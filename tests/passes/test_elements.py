"""Entries depend on the element that is said and on no other: other elements are changed, nothing moves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.expression import Program, TracedArray, leaf, trace
from bayesmc.passes.elements import MANY, NOTHING, elements

ORDER = np.array([2, 0, 0, 1])

CASES: dict[str, tuple[Callable, list[int]]] = {
    "itself": (lambda x, k: x, [0, 1, 2]),
    "another order": (lambda x, k: x[ORDER] + 1.0, [2, 0, 0, 1]),
    "some": (lambda x, k: bmc.stack([x[0], 3.0, x[2] * x[2]]), [0, NOTHING, 2]),
    "neighbours": (lambda x, k: x[1:] - x[:-1], [MANY, MANY]),
    "a sum": (lambda x, k: x.sum(axis=-1), MANY),
    "an own sum": (lambda x, k: np.stack([x, 2 * x], axis=-1).sum(axis=-1), [0, 1, 2]),
    "a gather": (lambda x, k: np.take_along_axis(x, k, axis=-1), [MANY] * 3),
    "a gather by it": (lambda x, k: DESIGN[(x > 0).astype(int)], [0, 1, 2]),
    "a call": (lambda x, k: np.sort(x), [MANY] * 3),
    "nothing": (lambda x, k: k + 1, [NOTHING] * 3),
}
DESIGN = np.array([1.0, 4.0])


@pytest.mark.parametrize("name", CASES)
def test_entries_depend_on_the_element_that_is_said(name: str) -> None:
    function, wanted = CASES[name]
    root = trace(
        function, [TracedArray(leaf("x", (3,))), TracedArray(leaf("k", (3,), int, states=3))]
    )
    found = elements(root, "x", 3)
    assert found.tolist() == wanted
    program, rng = Program([root]), np.random.default_rng(0)
    x, k = rng.normal(size=3), np.array([0, 2, 2])
    (before,) = program({"x": x, "k": k})
    for element in range(3):
        moved = np.where(np.arange(3) == element, -x, x)
        (after,) = program({"x": moved, "k": k})
        still = (found != element) & (found != MANY)
        np.testing.assert_array_equal(after[still], before[still])


def test_vectors_have_one_element_each() -> None:
    root = trace(lambda x: x.sum(axis=-1), [TracedArray(leaf("x", (2, 3)))])
    assert elements(root, "x", 2).tolist() == [0, 1]
