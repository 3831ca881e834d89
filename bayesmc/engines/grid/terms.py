"""Factors on a grid as arrays with named axes: products of them, summed or maximised over axes.

Axes leave one group after the other, so that factors that do not share an axis never meet in one table. Which
axes there are, and what stands in the tables, is not known here.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.shapes import Shape

Label = Hashable
Labels = tuple[Label, ...]


@dataclass(frozen=True, eq=False)
class Term:
    """A table with one label per axis; axes that it does not have are those it is constant along."""

    labels: Labels
    table: np.ndarray


def term_of(array: np.ndarray, labels: Sequence[Label]) -> Term:
    """An array as a term, without its axes of size one."""
    kept = tuple(label for label, n in zip(labels, array.shape, strict=True) if n > 1)
    return Term(kept, array.reshape([n for n in array.shape if n > 1]))


def dense(term: Term, labels: Labels, shape: Shape, full: bool = True) -> np.ndarray:
    """A term's table with these axes in this order, of size one where it has none unless ``full``."""
    order = [term.labels.index(label) for label in labels if label in term.labels]
    table = term.table.transpose(order)
    placed = table.reshape(
        [n if label in term.labels else 1 for label, n in zip(labels, shape, strict=True)]
    )
    return np.broadcast_to(placed, shape) if full else placed


def contract(terms: Sequence[Term], keep: Sequence[Label]) -> Term:
    """The product of all terms, summed over every axis that is not kept."""
    moved = _moved(terms, keep)
    if moved is not None:
        return moved
    left = list(terms)
    sizes = _sizes(left)
    for touched, _, labels in _steps([set(t.labels) for t in left], set(keep), sizes):
        chosen = [left[k] for k in touched]
        left = [t for k, t in enumerate(left) if k not in touched]
        left.append(_product(chosen, labels))
    present = {label for t in left for label in t.labels}
    return _product(left, tuple(label for label in keep if label in present))


def largest(
    scopes: Sequence[set[Label]], keep: Sequence[Label], sizes: Mapping[Label, int]
) -> float:
    """Entries of the largest table that ``contract`` makes."""
    left = [set(s) for s in scopes]
    found = 1.0
    for touched, _, labels in _steps(left, set(keep), sizes):
        left = [s for k, s in enumerate(left) if k not in touched] + [set(labels)]
        found = max(found, _count(labels, sizes))
    kept = {label for s in left for label in s}
    return max(found, _count(kept, sizes))


@dataclass(frozen=True, eq=False)
class Choice:
    """Where maxima were found: for every configuration of ``given`` the best position of ``chosen``."""

    chosen: Labels
    shape: Shape
    given: Labels
    best: np.ndarray

    def look_up(self, positions: Mapping[Label, int]) -> dict[Label, int]:
        """The best positions, given those of the other axes."""
        at = int(self.best[tuple(positions[label] for label in self.given)])
        found = np.unravel_index(at, self.shape)
        return {label: int(k) for label, k in zip(self.chosen, found, strict=True)}


def maximise(terms: Sequence[Term], keep: Sequence[Label]) -> tuple[Term, list[Choice]]:
    """The sum of all terms (logs), maximised over every axis that is not kept.

    The choices are in the order in which they were made; look them up from the last to the first.
    """
    left = list(terms)
    sizes = _sizes(left)
    choices = []
    for touched, gone, labels in _steps([set(t.labels) for t in left], set(keep), sizes):
        shape = tuple(sizes[label] for label in (*labels, *gone))
        total: Any = 0.0
        for k in touched:
            total = total + dense(left[k], (*labels, *gone), shape, full=False)
        flat = total.reshape(*shape[: len(labels)], -1)
        best = flat.argmax(axis=-1)
        value = np.take_along_axis(flat, best[..., None], axis=-1)[..., 0]
        left = [t for k, t in enumerate(left) if k not in touched] + [Term(labels, value)]
        choices.append(Choice(gone, shape[len(labels) :], labels, best))
    present = {label for t in left for label in t.labels}
    kept = tuple(label for label in keep if label in present)
    shape = tuple(sizes[label] for label in kept)
    result = np.zeros(shape)
    for t in left:
        result = result + dense(t, kept, shape, full=False)
    return Term(kept, result), choices


# ---- private ------------------------------------------------------------------------------------


def _moved(terms: Sequence[Term], keep: Sequence[Label]) -> Term | None:
    """The commonest product by itself, in a fraction of the time: a row of numbers times a table."""
    if len(terms) != 2 or len(keep) != 1 or len(terms[0].labels) != 1:
        return None
    row, table = terms
    if len(table.labels) != 2 or row.labels[0] in keep:
        return None
    if table.labels == (row.labels[0], keep[0]):
        return Term((keep[0],), row.table @ table.table)
    if table.labels == (keep[0], row.labels[0]):
        return Term((keep[0],), table.table @ row.table)
    return None


def _steps(
    scopes: list[set[Label]], keep: set[Label], sizes: Mapping[Label, int]
) -> Iterator[tuple[list[int], Labels, Labels]]:
    """What is multiplied, which axes leave, and which stay: cheapest axis first.

    Every step takes its tables off the list and puts the result at its end.
    """
    left = list(scopes)
    while True:
        free = list(dict.fromkeys(x for s in left for x in sorted(s, key=str) if x not in keep))
        if not free:
            return
        label = min(free, key=lambda x: _count(_merged(left, x)[1], sizes))
        touched, merged = _merged(left, label)
        elsewhere = {x for k, s in enumerate(left) if k not in touched for x in s}
        gone = tuple(x for x in free if x in merged and x not in elsewhere)
        labels = tuple(sorted((merged - set(gone)), key=str))
        yield touched, gone, labels
        left = [s for k, s in enumerate(left) if k not in touched] + [set(labels)]


def _merged(scopes: Sequence[set[Label]], label: Label) -> tuple[list[int], set[Label]]:
    touched = [k for k, s in enumerate(scopes) if label in s]
    return touched, set().union(*(scopes[k] for k in touched))


def _count(labels: Any, sizes: Mapping[Label, int]) -> float:
    return math.prod(float(sizes[x]) for x in labels)


def _sizes(terms: Sequence[Term]) -> dict[Label, int]:
    return {x: n for t in terms for x, n in zip(t.labels, t.table.shape, strict=True)}


def _product(terms: Sequence[Term], labels: Labels) -> Term:
    """The product of terms, summed over the axes that are not named."""
    number = {x: k for k, x in enumerate(dict.fromkeys(x for t in terms for x in t.labels))}
    arguments: list[Any] = []
    for t in terms:
        arguments += [t.table, [number[x] for x in t.labels]]
    if not arguments:
        return Term((), np.asarray(1.0))
    wanted = [number[x] for x in labels]
    return Term(labels, np.asarray(np.einsum(*arguments, wanted, optimize=len(terms) > 1)))
