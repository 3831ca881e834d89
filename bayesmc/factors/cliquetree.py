"""Exact inference in a product of discrete factors: a clique tree, prepared once and asked often.

`CliqueTree` is the plan (structure and cost), `BoundTree` the plan with tables, and `Calibrated`
(in `bayesmc.factors.calibrated`) the answer for one evidence. It knows nothing of nets: variables
are hashables with cardinalities, factors are arrays, linear or logarithmic.

Notes
-----
Hugin propagation on the clique tree of a greedy triangulation: Lauritzen and Spiegelhalter (1988);
Jensen, Lauritzen and Olesen (1990); Koller and Friedman (2009), chapter 10.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import DensityError, EvidenceError, ShapeError
from .calibrated import Calibrated, Context
from .elimination import Elimination
from .propagation import LINEAR, LOG, Mask, Potentials, collect, distribute, total_log_scale
from .structure import Program, TreeStructure, compile_program


@dataclass(frozen=True, eq=False)
class LogTable:
    """A factor given by its natural logarithms; ``-inf`` is a zero entry.

    Examples
    --------
    >>> LogTable(np.array([-1000.0, -2000.0])).values.shape
    (2,)
    """

    values: np.ndarray


FactorLike = np.ndarray | LogTable | tuple[np.ndarray, float]
"""A table of linear values, of logarithms, or a pair (linear values, log of a multiplier)."""


def factor_from_log(log_values: np.ndarray) -> tuple[np.ndarray, float]:
    """Linear values with their largest at 1, and the log of what was divided out.

    Entries below e**-745 of the largest become zero; pass a `LogTable` where that could matter.

    Examples
    --------
    >>> values, log_scale = factor_from_log(np.array([-1000.0, -1000.0 + np.log(0.5)]))
    >>> values.round(9), log_scale
    (array([1. , 0.5]), -1000.0)
    """
    top = float(np.max(log_values, initial=-math.inf))
    if top == -math.inf:
        return np.zeros(np.shape(log_values)), 0.0
    return np.exp(log_values - top), top


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a factor goes: its clique, and the transposition and shape that align its axes."""

    clique: int
    axes: tuple[int, ...]
    shape: tuple[int, ...]
    own_shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Given:
    """One checked factor: linear values (None where only logarithms are safe) and their scale."""

    linear: np.ndarray | None
    logs: np.ndarray | None
    log_scale: float

    def as_log(self) -> np.ndarray:
        if self.logs is not None:
            return self.logs
        assert self.linear is not None
        with np.errstate(divide="ignore"):
            return np.log(self.linear)


def check_factor(factor: FactorLike, placement: Placement, index: int) -> Given:
    """The factor as arrays of float64, refused if its shape or an entry is not a factor's."""
    if isinstance(factor, LogTable):
        logs = np.asarray(factor.values, dtype=float)
        _check_shape(logs, placement, index)
        if np.isnan(logs).any() or (logs == math.inf).any():
            raise DensityError(
                f"CliqueTree.bind: log-factor {index} has a NaN or plus infinity; give finite "
                "values or minus infinity"
            )
        linear, log_scale = factor_from_log(logs)
        shifted = logs - log_scale
        finite = shifted[shifted > -math.inf]
        safe = finite.size == 0 or finite.min() > -600.0
        return Given(linear if safe else None, shifted, log_scale)
    values, log_scale = factor if isinstance(factor, tuple) else (factor, 0.0)
    linear = np.asarray(values, dtype=float)
    _check_shape(linear, placement, index)
    if not (linear.min(initial=0.0) >= 0.0 and linear.max(initial=0.0) < math.inf):
        raise DensityError(
            f"CliqueTree.bind: factor {index} has a negative, infinite or NaN entry; give finite "
            "values of at least 0"
        )
    return Given(linear, None, float(log_scale))


def multiply_linear(
    shapes: Sequence[tuple[int, ...]], placements: Sequence[Placement], givens: Sequence[Given]
) -> tuple[list[np.ndarray], float] | None:
    """The potentials, each with its largest entry near 1; None if one would underflow."""
    if any(given.linear is None for given in givens):
        return None
    log_scale = math.fsum(given.log_scale for given in givens)
    tables: list[np.ndarray | None] = [None] * len(shapes)
    try:
        with np.errstate(under="raise", over="raise"):
            for given, where in zip(givens, placements, strict=True):
                linear = given.linear
                assert linear is not None
                if where.clique < 0:
                    if linear == 0.0:
                        return [np.zeros(shape) for shape in shapes], -math.inf
                    log_scale += math.log(float(linear))
                    continue
                aligned = linear.transpose(where.axes).reshape(where.shape)
                table = tables[where.clique]
                table = aligned if table is None else table * aligned
                top = float(table.max())
                if 0.0 < top and not 1e-100 < top < 1e100:
                    table, log_scale = table / top, log_scale + math.log(top)
                tables[where.clique] = table
    except FloatingPointError:
        return None
    return [_filled(table, shape, 1.0) for table, shape in zip(tables, shapes, strict=True)], (
        log_scale
    )


def add_logs(
    shapes: Sequence[tuple[int, ...]], placements: Sequence[Placement], givens: Sequence[Given]
) -> tuple[list[np.ndarray], float]:
    """The logs of the potentials, and the log of the multiplier they lack."""
    log_scale = math.fsum(given.log_scale for given in givens)
    tables: list[np.ndarray | None] = [None] * len(shapes)
    for given, where in zip(givens, placements, strict=True):
        if where.clique < 0:
            log_scale += float(given.as_log())
            continue
        aligned = given.as_log().transpose(where.axes).reshape(where.shape)
        table = tables[where.clique]
        tables[where.clique] = aligned if table is None else table + aligned
    return [_filled(table, shape, 0.0) for table, shape in zip(tables, shapes, strict=True)], (
        log_scale
    )


def _filled(table: np.ndarray | None, shape: tuple[int, ...], neutral: float) -> np.ndarray:
    """A C-ordered private array of the full shape."""
    if table is None:
        return np.full(shape, neutral)
    return np.array(np.broadcast_to(table, shape), dtype=float, order="C")


def _check_shape(values: np.ndarray, placement: Placement, index: int) -> None:
    if values.shape != placement.own_shape:
        raise ShapeError(
            f"CliqueTree.bind: factor {index} has shape {values.shape}, but its scope has the "
            f"cardinalities {placement.own_shape}"
        )


_SLICE_ABOVE = 30_000  # entries; below, compiling shapes for an evidence costs more than it saves
_PROGRAMS_KEPT = 8


class CliqueTree(TreeStructure):
    """The plan for exact inference in a product of factors with fixed scopes.

    Parameters
    ----------
    cardinalities : mapping of hashable to int, or sequence of int
        The number of states of each variable; with a sequence the variables are ``0..n-1``.
    scopes : iterable of sequences of variables
        The scope of each factor, in the order of its axes. Scopes may repeat, and may be empty.
    elimination : Elimination, optional
        In positions of ``cardinalities``; by default the best that `elimination_order` finds.

    Attributes
    ----------
    variables : tuple of hashable
    cardinalities : tuple of int
    scopes : tuple of tuple of variables
    cost : TreeCost
        Known before any table is allocated.

    Examples
    --------
    Rain wets the grass; the grass is wet.

    >>> tree = CliqueTree({"rain": 2, "wet": 2}, [("rain",), ("rain", "wet")])
    >>> tables = [np.array([0.8, 0.2]), np.array([[0.9, 0.1], [0.1, 0.9]])]
    >>> answer = tree.calibrate(tables, {"wet": 1})
    >>> answer.marginal("rain").round(4), round(float(np.exp(answer.log_z)), 4)
    (array([0.3077, 0.6923]), 0.26)
    """

    def __init__(
        self,
        cardinalities: Mapping[Any, int] | Sequence[int],
        scopes: Iterable[Sequence[Hashable]],
        elimination: Elimination | None = None,
    ) -> None:
        super().__init__(cardinalities, scopes, elimination)
        self._programs: dict[frozenset[int], Program] = {}

    def bind(self, factors: Sequence[FactorLike]) -> BoundTree:
        """The tree with the factors' tables, one per scope, to be asked under any evidence.

        Raises
        ------
        ShapeError
            If there is not one table per scope, or a table does not have its scope's shape.
        DensityError
            If an entry is negative, NaN or infinite.
        """
        placements = self.placements
        if len(factors) != len(placements):
            raise ShapeError(
                f"CliqueTree.bind: {len(factors)} factors for {len(placements)} scopes; give one "
                "table per scope"
            )
        given = [
            check_factor(factor, placement, k)
            for k, (factor, placement) in enumerate(zip(factors, placements, strict=True))
        ]
        return BoundTree(self, given)

    def calibrate(
        self, factors: Sequence[FactorLike], evidence: Mapping[Any, int] | None = None
    ) -> Calibrated:
        """Both passes for these tables and this evidence; see `BoundTree.calibrate`."""
        return self.bind(factors).calibrate(evidence)

    def program(self, sliced: frozenset[int] = frozenset()) -> Program:
        """The shapes for evidence that slices these variables; the last few are kept."""
        found = self._programs.get(sliced)
        if found is None:
            unsliced = self.program() if sliced else None
            found = compile_program(self.cliques, self.cardinalities, sliced, unsliced)
            if len(self._programs) >= _PROGRAMS_KEPT:
                for old in list(self._programs)[1:]:  # the first, without evidence, stays
                    self._programs.pop(old, None)
            self._programs[sliced] = found
        return found

    @cached_property
    def placements(self) -> list[Placement]:
        found = []
        for scope in self._scopes:
            own = tuple(self.cardinalities[v] for v in scope)
            if not scope:
                found.append(Placement(-1, (), (), own))
                continue
            # The clique made by eliminating the scope's first variable holds all the others.
            clique = self.home[min(scope, key=self._position.__getitem__)]
            order = self.cliques[clique].variables
            axes = tuple(sorted(range(len(scope)), key=lambda a: order.index(scope[a])))  # noqa: B023
            shape = tuple(self.cardinalities[v] if v in scope else 1 for v in order)
            found.append(Placement(clique, axes, shape, own))
        return found


class BoundTree:
    """A clique tree with tables; made by `CliqueTree.bind`, asked by `calibrate`.

    Cliques below which nothing is observed keep their messages between calls, so that new evidence
    costs the collect pass only from the observed variables to the root.
    """

    def __init__(self, tree: CliqueTree, given: Sequence[Given]) -> None:
        self.tree = tree
        self._given = tuple(given)

    @cached_property
    def _linear(self) -> tuple[Potentials, float] | None:
        tree = self.tree
        found = multiply_linear(tree.shapes, tree.placements, self._given)
        return None if found is None else (Potentials(found[0], LINEAR), found[1])

    @cached_property
    def _log(self) -> tuple[Potentials, float]:
        tree = self.tree
        tables, log_scale = add_logs(tree.shapes, tree.placements, self._given)
        return Potentials(tables, LOG), log_scale

    def calibrate(
        self, evidence: Mapping[Any, int] | None = None, *, log_domain: bool = False
    ) -> Calibrated:
        """The distribution given that variables are in these states.

        Runs in ordinary arithmetic; where that underflows, again with logarithms, so that the
        answer is right either way. Evidence of probability zero gives ``log_z == -inf``.

        Parameters
        ----------
        evidence : mapping of variable to int, optional
            Positions of states, from 0.
        log_domain : bool
            Use logarithms from the start.

        Raises
        ------
        EvidenceError
            If a variable is unknown, or a state out of range.
        """
        tree = self.tree
        states = _evidence_states(tree, evidence or {})
        sliced = tree.cost.total_entries > _SLICE_ABOVE
        program = tree.program(frozenset(states) if sliced else frozenset())
        if not log_domain and self._linear is not None:
            try:
                with np.errstate(under="raise", over="raise"):
                    return self._run(*self._linear, program, states)
            except FloatingPointError:
                pass  # something underflowed that later evidence might have needed
        with np.errstate(all="ignore"):
            return self._run(*self._log, program, states)

    def _run(
        self, potentials: Potentials, log_scale: float, program: Program, states: dict[int, int]
    ) -> Calibrated:
        tree = self.tree
        changed, masks = _entered(tree, program, states)
        slices = states if program.sliced else {}
        context = Context(tree, program, potentials.semiring, states)
        collected = None
        if log_scale > -math.inf:
            collected = collect(tree.cliques, program, potentials, changed, slices, masks)
        if collected is None:
            return Calibrated(context, -math.inf, None, (), np.zeros(0))
        # An underflow here only loses parts of beliefs that are below 1e-308 of the whole.
        with np.errstate(under="ignore"):
            ratios, flat = distribute(tree.cliques, program, collected, potentials.semiring)
        log_z = log_scale + total_log_scale(collected)
        return Calibrated(context, log_z, collected, ratios, flat)


def _evidence_states(tree: TreeStructure, evidence: Mapping[Any, int]) -> dict[int, int]:
    states = {}
    for variable, state in evidence.items():
        k = tree.index.get(variable)
        if k is None:
            raise EvidenceError(f"BoundTree.calibrate: unknown variable {variable!r} in evidence")
        if not 0 <= state < tree.cardinalities[k]:
            raise EvidenceError(
                f"BoundTree.calibrate: state {state} of {variable!r} is out of range; it has "
                f"states 0..{tree.cardinalities[k] - 1}"
            )
        states[k] = int(state)
    return states


def _entered(
    tree: TreeStructure, program: Program, states: Mapping[int, int]
) -> tuple[set[int], dict[int, list[Mask]]]:
    """The cliques whose tables evidence changes, with all above them, and what is masked where."""
    changed: set[int] = set()
    masks: dict[int, list[Mask]] = {}
    for v, state in states.items():
        if program.sliced:
            touched: Sequence[int] = tree.containing[v]
        else:
            touched = (tree.home[v],)
            masks.setdefault(touched[0], []).append((*tree.mask_shapes[v], state))
        for k in touched:
            while k >= 0 and k not in changed:
                changed.add(k)
                k = tree.cliques[k].parent
    return changed, masks
