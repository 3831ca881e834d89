"""Entries depend on the elements that are said and on no other: other elements are changed, nothing moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import Constant, Expression, Program, TracedArray, leaf, trace
from bayesmc.passes import reads
from bayesmc.passes.reads import element_read, elements_read

ORDER = np.array([2, 0, 0, 1])
FIRST, SECOND = np.array([0, 1, 2, 2]), np.array([1, 2, 0, 0])
DESIGN = np.array([1.0, 4.0])

#: what reads one element: which one, at k = (0, 2, 2)
ONE: dict[str, tuple[Callable, list[int]]] = {
    "itself": (lambda x, k: x, [0, 1, 2]),
    "another order": (lambda x, k: x[ORDER] + 1.0, [2, 0, 0, 1]),
    "some": (lambda x, k: bmc.stack([x[0], 3.0, x[2] * x[2]]), [0, -1, 2]),
    "an own sum": (lambda x, k: np.stack([x, 2 * x], axis=-1).sum(axis=-1), [0, 1, 2]),
    "a gather by it": (lambda x, k: DESIGN[(x > 0).astype(int)], [0, 1, 2]),
    "nothing": (lambda x, k: k + 1, [-1, -1, -1]),
    "a lookup": (lambda x, k: np.take_along_axis(x, k, axis=-1), [0, 2, 2]),
    "a lookup of what follows": (lambda x, k: np.tanh(2 * np.take(np.exp(x), k)), [0, 2, 2]),
    "a lookup in another order": (lambda x, k: np.take(x[ORDER], k), [2, 0, 0]),
}
#: what reads several in several ways
PAIRS: dict[str, tuple[Callable, list[list[int]]]] = {
    "pairs": (lambda x, k: x[FIRST] - x[SECOND], [[0, 1, 2, 2], [1, 2, 0, 0]]),
    "neighbours": (lambda x, k: np.exp(x[1:] * x[:-1]), [[1, 2], [0, 1]]),
    "a lookup and itself": (lambda x, k: np.take(2 * x, k) - x, [[0, 2, 2], [0, 1, 2]]),
}
#: what reads several in one way
SEVERAL: dict[str, Callable] = {
    "a sum": lambda x, k: x.sum(axis=-1),
    "a call": lambda x, k: np.sort(x),
    "running sums": lambda x, k: np.cumsum(x),
    "a lookup by it": lambda x, k: np.take(x, (x > 0).astype(int)),
    "a sum of looked up ones": lambda x, k: np.take(x, k).sum(axis=-1),
}


def _traced(function: Callable) -> Any:
    return trace(
        function, [TracedArray(leaf("x", (3,))), TracedArray(leaf("k", (3,), int, states=3))]
    )


def _departure(root: Expression, found: list[np.ndarray]) -> float:
    """How far entries move with elements that they are not said to read."""
    program, rng = Program([root]), np.random.default_rng(0)
    x, k = rng.normal(size=3), np.array([0, 2, 2])
    (before,) = program({"x": x, "k": k})
    worst = 0.0
    for element in range(3):
        moved = np.where(np.arange(3) == element, -x, x)
        (after,) = program({"x": moved, "k": k})
        still = np.all([at != element for at in found], axis=0)
        worst = max(worst, np.abs(after - before)[still].max(initial=0.0))
    return float(worst)


def _at(found: Expression) -> np.ndarray:
    (numbers,) = Program([found])({"k": np.array([0, 2, 2])})
    return np.broadcast_to(numbers, found.shape)


@pytest.mark.parametrize("name", ONE)
def test_entries_depend_on_the_element_that_is_said(name: str) -> None:
    function, wanted = ONE[name]
    root = _traced(function)
    found = _at(element_read(root, "x", np.arange(3)))
    assert found.tolist() == wanted
    assert _departure(root, [found]) == 0


@pytest.mark.parametrize("name", [*ONE, *PAIRS])
def test_ways_in_are_told_apart(name: str) -> None:
    function, wanted = PAIRS[name] if name in PAIRS else (ONE[name][0], [ONE[name][1]])
    root = _traced(function)
    found = [_at(at) for at in elements_read(root, "x", np.arange(3))]
    if name == "some":  # two ways in, of which each entry has one
        found = [np.max(found, axis=0)]
    assert sorted(at.tolist() for at in found) == sorted([] if name == "nothing" else wanted)
    assert name == "nothing" or _departure(root, found) == 0


@pytest.mark.parametrize("name", SEVERAL)
def test_several_elements_are_refused(name: str) -> None:
    root = _traced(SEVERAL[name])
    with pytest.raises(TraceError):
        element_read(root, "x", np.arange(3))
    with pytest.raises(TraceError):
        elements_read(root, "x", np.arange(3))


def test_a_wrong_rule_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: a lookup that is taken for the first rows of its table."""
    root = _traced(ONE["a lookup"][0])
    monkeypatch.setattr(reads, "_gathered", lambda node, inner: inner[0])
    assert _departure(root, [_at(element_read(root, "x", np.arange(3)))]) > 0.1


def test_vectors_have_one_element_each() -> None:
    root = trace(lambda x: x.sum(axis=-1), [TracedArray(leaf("x", (2, 3)))])
    found = element_read(root, "x", np.repeat(np.arange(2), 3))
    assert isinstance(found, Constant)
    assert found.value.tolist() == [0, 1]
