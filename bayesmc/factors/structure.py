"""The clique tree as a graph, and the index arithmetic of message passing, made before any table exists.

A clique's table is kept as one C-ordered array whose axes are its separator, then its residual.
Seen as a matrix (separator x residual), the message to the parent is a row sum, and a message from
the parent scales rows. What a child needs from its parent, or multiplies into it, is written in
the parent's axes merged into as few runs as possible, so that no array is ever transposed.

A variable that is observed may be *sliced*: it keeps its axis, with one state, so that the work
shrinks. Variables are positions ``0..n-1``; this room holds shapes and steps, no tables.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np

from .elimination import Elimination, elimination_order


@dataclass(frozen=True)
class TreeCost:
    """What a clique tree will cost, known before any table is allocated.

    Attributes
    ----------
    induced_width : int
        Variables in the largest clique, less one; -1 without variables.
    largest_entries : float
        Table entries of the largest clique (a float, as it can exceed any integer type).
    total_entries : float
        Table entries of all cliques together.
    bytes : float
        Upper bound on the tables held at once, in float64: the potentials, both passes'
        working copies and one belief.
    """

    induced_width: int
    largest_entries: float
    total_entries: float
    bytes: float


@dataclass(frozen=True)
class Clique:
    """One maximal clique; parents precede children in the tuple of cliques.

    Attributes
    ----------
    separator, residual : tuple of int
        The variables shared with the parent, in the parent's order, and the others.
    parent : int
        Position of the parent clique, -1 at a root.
    children : tuple of int
    """

    separator: tuple[int, ...]
    residual: tuple[int, ...]
    parent: int
    children: tuple[int, ...]

    @property
    def variables(self) -> tuple[int, ...]:
        """All variables, in the order of the axes of the clique's table."""
        return self.separator + self.residual


def build_cliques(elimination: Elimination) -> tuple[Clique, ...]:
    """The rooted forest of maximal cliques of an elimination, one tree per connected component.

    Notes
    -----
    A variable joins the clique of the first-eliminated member of its separator when it completes
    that clique, and opens a new one otherwise, which yields exactly the maximal cliques: Blair
    and Peyton, "An introduction to chordal graphs and clique trees" (1993), Algorithm 4.1.
    """
    position = {v: k for k, v in enumerate(elimination.order)}
    members: list[list[int]] = []
    parents: list[int] = []
    home: dict[int, int] = {}
    for v, *separator in reversed(elimination.cliques):
        if not separator:
            parent = -1
        else:
            parent = home[min(separator, key=position.__getitem__)]
            if len(members[parent]) == len(separator):
                members[parent].append(v)
                home[v] = parent
                continue
        home[v] = len(members)
        members.append([*separator, v])
        parents.append(parent)
    return _oriented(members, parents)


def tree_cost(cliques: Sequence[Clique], cardinalities: Sequence[int]) -> TreeCost:
    """The cost of a clique tree in entries and bytes."""
    entries = [math.prod(float(cardinalities[v]) for v in c.variables) for c in cliques]
    total, largest = math.fsum(entries), max(entries, default=0.0)
    width = max((len(c.variables) for c in cliques), default=0) - 1
    return TreeCost(width, largest, total, 8.0 * (3.0 * total + largest))


class TreeStructure:
    """What is known of a clique tree without its tables; see ``CliqueTree`` for the parameters.

    Attributes
    ----------
    variables : tuple of hashable
    cardinalities : tuple of int
    scopes : tuple of tuple of variables
    cliques : tuple of Clique
    home : dict
        The clique that each variable is a residual of.
    cost : TreeCost
    """

    def __init__(
        self,
        cardinalities: Mapping[Any, int] | Sequence[int],
        scopes: Iterable[Sequence[Hashable]],
        elimination: Elimination | None = None,
    ) -> None:
        named = cardinalities if isinstance(cardinalities, Mapping) else None
        self.variables: tuple[Hashable, ...] = (
            tuple(range(len(cardinalities))) if named is None else tuple(named)
        )
        sizes = list(cardinalities) if named is None else list(named.values())
        self.cardinalities: tuple[int, ...] = tuple(int(cast(int, n)) for n in sizes)
        self.scopes = tuple(tuple(scope) for scope in scopes)
        self.index = {v: k for k, v in enumerate(self.variables)}
        self._check()
        self._scopes = [tuple(self.index[v] for v in scope) for scope in self.scopes]
        if elimination is None:
            elimination = elimination_order(self.cardinalities, self._scopes)
        self.cliques = build_cliques(elimination)
        self.cost: TreeCost = tree_cost(self.cliques, self.cardinalities)
        self._position = {v: k for k, v in enumerate(elimination.order)}
        self.home = {v: k for k, c in enumerate(self.cliques) for v in c.residual}

    @cached_property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """The full shape of each clique's table."""
        return tuple(tuple(self.cardinalities[v] for v in c.variables) for c in self.cliques)

    @cached_property
    def containing(self) -> tuple[tuple[int, ...], ...]:
        """For each variable the cliques that hold it."""
        found: list[list[int]] = [[] for _ in self.variables]
        for k, clique in enumerate(self.cliques):
            for v in clique.variables:
                found[v].append(k)
        return tuple(map(tuple, found))

    @cached_property
    def mask_shapes(self) -> tuple[tuple[int, int, int], ...]:
        """For each variable its home clique's table seen as (before, states, after)."""
        found = []
        for v in range(len(self.variables)):
            shape = self.shapes[self.home[v]]
            axis = self.cliques[self.home[v]].variables.index(v)
            found.append((math.prod(shape[:axis]), shape[axis], math.prod(shape[axis + 1 :])))
        return tuple(found)

    def _check(self) -> None:
        for v, n in zip(self.variables, self.cardinalities, strict=True):
            if n < 1:
                raise ValueError(f"CliqueTree: variable {v!r} has {n} states; it needs at least 1")
        for scope in self.scopes:
            unknown = [v for v in scope if v not in self.index]
            if unknown or len(set(scope)) != len(scope):
                raise ValueError(
                    f"CliqueTree: the scope {scope} must name known variables, each once"
                    + (f"; unknown: {unknown}" if unknown else "")
                )


def _oriented(members: list[list[int]], parents: list[int]) -> tuple[Clique, ...]:
    """Cliques with their axes in order: the separator as in the parent, then the residual."""
    children: list[list[int]] = [[] for _ in members]
    for k, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(k)
    uses = _separator_uses(members, parents)
    cliques: list[Clique] = []
    axes: list[tuple[int, ...]] = []
    for k, (own, parent) in enumerate(zip(members, parents, strict=True)):
        inside = set(own)
        separator = tuple(v for v in axes[parent] if v in inside) if parent >= 0 else ()
        # Variables that many children ask for come first: what is summed out is then mostly a
        # trailing run of axes, which one matrix-vector product adds up.
        rest = [v for v in own if v not in separator]
        residual = tuple(sorted(rest, key=lambda v: (-uses[k].get(v, 0), v)))
        axes.append(separator + residual)
        cliques.append(Clique(separator, residual, parent, tuple(children[k])))
    return tuple(cliques)


def _separator_uses(members: list[list[int]], parents: list[int]) -> list[dict[int, int]]:
    """For each clique, in how many of its children each of its variables occurs."""
    uses: list[dict[int, int]] = [{} for _ in members]
    sets = [set(own) for own in members]
    for own, parent in zip(members, parents, strict=True):
        if parent >= 0:
            for v in own:
                if v in sets[parent]:
                    uses[parent][v] = uses[parent].get(v, 0) + 1
    return uses


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
