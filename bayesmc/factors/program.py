"""Index arithmetic of message passing, worked out once per set of sliced variables.

A clique's table is kept as one C-ordered array whose axes are its separator, then its residual.
Seen as a matrix (separator x residual), the message to the parent is a row sum, and a message from
the parent scales rows. What a child needs from its parent, or multiplies into it, is written in
the parent's axes merged into as few runs as possible, so that no array is ever transposed.

A variable that is observed may be *sliced*: it keeps its axis, with one state, so that the work
shrinks. This room holds shapes and steps, no tables.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from .structure import Clique

SumStep = tuple[int, int, int]
"""Seen as (before, summed, after), add up the middle axis."""


@dataclass(frozen=True, slots=True)
class CliqueShapes:
    """Shapes of one clique and of the messages between it and its parent.

    Attributes
    ----------
    shape : tuple of int
        One axis per variable.
    matrix : tuple of int
        (separator entries, residual entries).
    parent_runs, message_runs : tuple of int
        The parent's axes merged into runs that are wholly in or wholly out of the separator, and
        the message's shape that broadcasts against them.
    from_parent : tuple of SumStep
        What sums the parent's table to this clique's separator.
    outputs : tuple of (int, tuple of SumStep)
        For each residual variable that is not sliced, what sums the residual to it.
    sliced : bool
        Whether any of its variables is sliced.
    """

    shape: tuple[int, ...]
    matrix: tuple[int, int]
    parent_runs: tuple[int, ...]
    message_runs: tuple[int, ...]
    from_parent: tuple[SumStep, ...]
    outputs: tuple[tuple[int, tuple[SumStep, ...]], ...]
    sliced: bool


@dataclass(frozen=True, slots=True)
class Program:
    """The shapes of all cliques, and where each variable's marginal stands in the flat result.

    Attributes
    ----------
    cliques : tuple of CliqueShapes
    starts : ndarray of int
        Where each output begins, in the order in which the cliques yield them.
    counts : ndarray of int
    place : dict of int to (int, int)
        The slice of each variable that is not sliced.
    sliced : frozenset of int
    """

    cliques: tuple[CliqueShapes, ...]
    starts: np.ndarray
    counts: np.ndarray
    place: dict[int, tuple[int, int]]
    sliced: frozenset[int]


def compile_program(
    cliques: Sequence[Clique],
    cardinalities: Sequence[int],
    sliced: Collection[int] = (),
    unsliced: Program | None = None,
) -> Program:
    """The program of a tree in which the variables of ``sliced`` have one state.

    Cliques that this does not concern are taken over from ``unsliced``, the program without.
    """
    sliced = frozenset(sliced)
    sizes = [1 if v in sliced else int(n) for v, n in enumerate(cardinalities)]
    shapes = []
    place, end = {}, 0
    touched = [not sliced.isdisjoint(clique.variables) for clique in cliques]
    for k, clique in enumerate(cliques):
        if (
            unsliced is not None
            and not touched[k]
            and not (clique.parent >= 0 and touched[clique.parent])
        ):
            shapes.append(unsliced.cliques[k])
        else:
            shapes.append(_clique_shapes(clique, cliques, sizes, sliced))
        for v, _ in shapes[-1].outputs:
            place[v] = (end, end + sizes[v])
            end += sizes[v]
    bounds = np.array(list(place.values()), dtype=np.intp).reshape(-1, 2)
    return Program(tuple(shapes), bounds[:, 0], bounds[:, 1] - bounds[:, 0], place, sliced)


def sum_steps(sizes: Sequence[int], kept: Sequence[bool]) -> tuple[SumStep, ...]:
    """The steps that sum a table over the axes not kept; each axis run takes one step."""
    runs = _runs(sizes, kept)
    steps = []
    while not all(keep for _, keep in runs):
        k = max(k for k, (_, keep) in enumerate(runs) if not keep)
        before = math.prod(n for n, _ in runs[:k])
        after = math.prod(n for n, _ in runs[k + 1 :])
        steps.append((before, runs[k][0], after))
        runs = [*runs[:k], *runs[k + 1 :]]
    return tuple(steps)


def _clique_shapes(
    clique: Clique, cliques: Sequence[Clique], sizes: Sequence[int], sliced: frozenset[int]
) -> CliqueShapes:
    separator = set(clique.separator)
    residual_sizes = [sizes[v] for v in clique.residual]
    above = cliques[clique.parent].variables if clique.parent >= 0 else ()
    above_sizes = [sizes[v] for v in above]
    kept = [v in separator for v in above]
    runs = _runs(above_sizes, kept)
    return CliqueShapes(
        shape=tuple(sizes[v] for v in clique.variables),
        matrix=(math.prod(sizes[v] for v in clique.separator), math.prod(residual_sizes)),
        parent_runs=tuple(n for n, _ in runs),
        message_runs=tuple(n if keep else 1 for n, keep in runs),
        from_parent=sum_steps(above_sizes, kept),
        outputs=tuple(
            (v, sum_steps(residual_sizes, [u == v for u in clique.residual]))
            for v in clique.residual
            if v not in sliced
        ),
        sliced=not sliced.isdisjoint(clique.variables),
    )


def _runs(sizes: Sequence[int], kept: Sequence[bool]) -> list[tuple[int, bool]]:
    """Neighbouring axes of one kind merged; axes of size 1 belong anywhere and are dropped."""
    runs: list[tuple[int, bool]] = []
    for size, keep in zip(sizes, kept, strict=True):
        if size == 1:
            continue
        if runs and runs[-1][1] == keep:
            runs[-1] = (runs[-1][0] * size, keep)
        else:
            runs.append((size, keep))
    return runs
