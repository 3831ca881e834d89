"""Beliefs on a grid: probabilities of cells, carried to the next slice, back again, and along one best path.

Probabilities add up to one over the cells of a slice; densities are never renormalised, so that the
likelihood has the error of the quadrature rule and no other, and a grid too small or too coarse shows.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.grid.edges import Edges
from bayesmc.engines.grid.slice import Placed
from bayesmc.engines.grid.sources import Label, previous
from bayesmc.engines.grid.tables import Factor, GridModel
from bayesmc.errors import BudgetError, GridWarning, ZeroProbabilityError
from bayesmc.factors.named import (
    Choice,
    Named,
    Scope,
    aligned,
    contract,
    largest,
    maximise,
    sizes_of,
)
from bayesmc.shapes import Shape

#: probability of bad parameters from which on they are the user's to hear of
COUNTS = 1e-8
#: predictions below which sums have underflowed, and the share of a slice that may be lost so
TINY, LOST = 1e-290, 1e-9


@dataclass(frozen=True, eq=False)
class Cells:
    """The belief about a slice.

    Attributes
    ----------
    placed : Placed
    probs : ndarray, shape (*cells, *apart)
        Probabilities of the cells, one axis per hidden scalar.
    predicted : ndarray
        What the slice before gives every cell, as ``back`` needs it; None in slice 0.
    increment : ndarray, shape (*apart,)
        Log density of the row given the rows before.
    mass : ndarray, shape (*apart,)
        What the densities of what is hidden add up to: one, where nothing is left out.
    """

    placed: Placed
    probs: np.ndarray
    predicted: np.ndarray | None
    increment: np.ndarray
    mass: np.ndarray

    def shares(self, name: str) -> np.ndarray | None:
        """Probabilities of the points of a node of one number, (n, *apart); None where it has none."""
        axis = self.placed.axis(name)
        return None if axis is None else self.placed.marginal(self.probs, axis)


class GridMover:
    """Moves beliefs over a grid from slice to slice.

    Parameters
    ----------
    model : GridModel
    tolerance : float
        Mass that may be lost or gained, and density in an outer cell beside the highest, before a
        ``GridWarning``.
    """

    def __init__(self, model: GridModel, tolerance: float) -> None:
        self.model, self.tolerance = model, tolerance
        self.edges = Edges(model.slices, model.axes)
        self.warned: set[str] = set()
        #: mass that the worst slice after the first lost, or had too much
        self.off = 0.0

    def move(self, cells: Cells | None, row: Row) -> Cells:
        """The belief about a slice, from the one before (None: slice 0) and its row.

        Raises
        ------
        ZeroProbabilityError, UnsupportedError, BudgetError, ParameterError
        """
        model = self.model
        before = None if cells is None else cells.placed
        now = model.place(row)
        factors = model.factors(before, now)
        self._refuse_invalid(cells, now, factors)
        labels, shape = (*now.labels, *model.apart), self._shape(now)
        predicted, rest = None, None
        prior, likelihood = self._local(factors, now, shape)
        if cells is not None:
            moved = contract(self._moving(cells, now, factors), labels)
            predicted = aligned(moved, labels, shape)
            rest = prior + likelihood
            prior = prior + np.log(predicted)
        mass = prior
        if cells is not None and any(f.scale is not None and not f.hidden for f in factors):
            mass = self._without_likelihood(cells, now, [f for f in factors if f.hidden])
        whole = self._check_mass(mass, now)
        log = prior + likelihood
        axes = tuple(range(len(now.scalars)))
        level = log.max(axis=axes) if axes else log
        if not np.all(level > -np.inf):
            raise self._impossible(row)
        if predicted is not None and rest is not None:
            self._refuse_underflow(row, predicted, rest, level)
        probs = np.exp(log - level)
        total = probs.sum(axis=axes) if axes else probs
        probs = probs / total
        self._check_cells(probs, now)
        self._check_edges(probs, now)
        return Cells(now, probs, predicted, np.asarray(level + np.log(total)), whole)

    def likelihood(self, cells: Cells | None, row: Row) -> tuple[Placed, np.ndarray]:
        """What a row makes of the cells of its slice, in logs; the most that the slice before allows."""
        now = self.model.place(row)
        factors = self.model.factors(None if cells is None else cells.placed, now)
        return now, self._local(factors, now, self._shape(now))[1]

    def back(self, cells: Cells, after: Cells, smoothed: np.ndarray) -> np.ndarray:
        """Smoothed probabilities of a slice, from those of the one after."""
        model, before = self.model, cells.placed
        labels = (*map(previous, before.labels), *model.apart)
        found = contract(self.pair(cells, after, smoothed), labels)
        probs = aligned(found, labels, (*before.shape, *model.lead))
        axes = tuple(range(len(before.scalars)))
        probs = probs / (probs.sum(axis=axes) if axes else 1.0)
        self._check_edges(probs, before)
        return probs

    def pair(self, cells: Cells, after: Cells, smoothed: np.ndarray) -> list[Named]:
        """Terms whose product is the joint belief about a slice and the one after, whose belief is given."""
        assert after.predicted is not None
        now = after.placed
        factors = self.model.factors(cells.placed, now)
        some = after.predicted > 0
        ratio = np.divide(smoothed, after.predicted, out=np.zeros(some.shape), where=some)
        return [*self._moving(cells, now, factors), Named((*now.labels, *self.model.apart), ratio)]

    def best(
        self, rows: Sequence[Row], advance: Any
    ) -> list[tuple[Placed, tuple[np.ndarray, ...]]]:
        """The most likely cell of every slice: positions along its axes, shape ``(1, *apart)``."""
        model, lead = self.model, self.model.lead
        elements = list(np.ndindex(*lead))
        value: list[Named] = []
        history: list[list[list[Choice]]] = []
        placed: list[Placed] = []
        for row in rows:
            before = placed[-1] if placed else None
            now = model.place(row)
            terms = [f.table for f in model.factors(before, now)] + _closed(now, model.apart)
            sizes = self._sizes(now) | sizes_of([*terms, *value])
            found = [
                maximise(
                    [_at(t, model.apart, e) for t in terms] + ([value[k]] if value else []),
                    now.labels,
                    sizes,
                )
                for k, e in enumerate(elements)
            ]
            if any(not (best > -np.inf).any() for best, _ in found):
                raise self._impossible(row)
            later = tuple(map(previous, now.labels))
            value = [Named(later, best - best.max()) for best, _ in found]
            history.append([choices for _, choices in found])
            placed.append(now)
            advance()
        path = _traced(value, history, placed, elements, lead)
        self._check_path(path, placed)
        return [
            (now, tuple(at[s.label][None] for s in now.scalars))
            for now, at in zip(placed, path, strict=True)
        ]

    # ---- private -------------------------------------------------------------------------------

    def _shape(self, now: Placed) -> Shape:
        return (*now.shape, *self.model.lead)

    def _sizes(self, now: Placed) -> dict[Any, int]:
        return dict(zip((*now.labels, *self.model.apart), self._shape(now), strict=True))

    def _moving(self, cells: Cells, now: Placed, factors: Sequence[Factor]) -> list[Named]:
        """The belief before and all densities that read it, scaled."""
        apart = self.model.apart
        terms = [Named((*map(previous, cells.placed.labels), *apart), cells.probs)]
        terms += [f.table for f in factors if f.scale is not None]
        sizes = self._sizes(now) | sizes_of(terms)
        entries = largest([t.scope for t in terms], (*now.labels, *apart), sizes)
        if entries * 8 > self.model.max_bytes:
            names = ", ".join(sorted({s.label[0] for s in now.scalars}))
            raise BudgetError(
                self.model.too_large(names, [s.size for s in now.scalars], entries * 8),
                int(entries * 8),
            )
        return terms

    def _local(
        self, factors: Sequence[Factor], now: Placed, shape: Shape
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log densities of what is hidden, and the likelihood, over the cells of the slice alone."""
        labels = (*now.labels, *self.model.apart)
        prior, likelihood = np.zeros(shape), np.zeros(shape)
        for scalar in now.scalars:
            axes = (scalar.label, *self.model.apart)
            full = (scalar.size, *self.model.lead)
            width = np.broadcast_to(np.log(scalar.widths), full)
            prior += aligned(Named(axes, width), labels)
        for factor in factors:
            log = factor.table if factor.scale is None else factor.scale
            part = aligned(log, labels)
            if factor.hidden:
                prior += part
            else:
                likelihood += part
        return prior, likelihood

    def _without_likelihood(
        self, cells: Cells, now: Placed, hidden: Sequence[Factor]
    ) -> np.ndarray:
        """Log masses that the slice before gives to cells, where what is seen reads it, too."""
        labels, shape = (*now.labels, *self.model.apart), self._shape(now)
        prior, _ = self._local(hidden, now, shape)
        moved = contract(self._moving(cells, now, hidden), labels)
        return prior + np.log(aligned(moved, labels, shape))

    def _check_mass(self, log_mass: np.ndarray, now: Placed) -> np.ndarray:
        """The mass on the grid, after a warning where some is missing."""
        axes = tuple(range(len(now.scalars)))
        if not axes:
            return np.ones(np.shape(log_mass))
        mass = np.asarray(np.exp(log_mass).sum(axis=axes))
        off = np.abs(mass - 1)
        if now.row.t:
            self.off = max(self.off, float(np.max(off)))
        if "mass" in self.warned or not np.any(off > self.tolerance):
            return mass
        worst = float(np.asarray(mass).flat[int(np.argmax(off))])
        self.warned.add("mass")
        if worst < 1:
            why = "mass leaks over the edges of the grid, or falls between cells that are too wide"
        else:
            why = "cells are too wide for a density as narrow as this"
        warnings.warn(
            f"GridFilter: the densities of slice {now.row.t} add up to {worst:.4g} over the grid, not 1: "
            f"{why}; give a wider or a finer grid",
            GridWarning,
            stacklevel=2,
        )
        return mass

    def _check_cells(self, probs: np.ndarray, now: Placed) -> None:
        """Warn where a belief stands on so few cells that sums over cells are no integrals."""
        if "cells" in self.warned:
            return
        for k, scalar in enumerate(now.scalars):
            name = scalar.label[0]
            node = self.model.slices.first[name]
            if node.is_discrete or name in now.row.seen or scalar.size < 3:
                continue
            top = float(now.marginal(probs, k).max())
            # the error of a sum for a normal density whose highest cell has this probability
            error = 2 * np.exp(-np.pi / top**2)
            if error > self.tolerance:
                self.warned.add("cells")
                warnings.warn(
                    f"GridFilter: {top:.3g} of the belief about {name!r} in slice {now.row.t} stands on one "
                    "cell, so moments and likelihood are no better than a cell is wide; give a finer grid",
                    GridWarning,
                    stacklevel=2,
                )
                return

    def _check_edges(self, probs: np.ndarray, now: Placed) -> None:
        """Warn where a belief, after its row, goes on beyond the grid."""
        if "edges" in self.warned or not np.isfinite(self.tolerance):
            return
        outer = self.edges.highest(probs, now)
        if outer is None or outer.share <= self.tolerance:
            return
        self.warned.add("edges")
        warnings.warn(
            f"GridFilter: the belief about {outer.name!r} in slice {now.row.t} goes on beyond its grid: the "
            f"density in the outer cell, at {outer.point:.4g}, is {outer.share:.2g} of the highest, and what "
            "lies outside is left out; give a wider grid",
            GridWarning,
            stacklevel=2,
        )

    def _check_path(
        self, path: Sequence[Mapping[Label, np.ndarray]], placed: Sequence[Placed]
    ) -> None:
        """Warn where the best path runs along the edge of the grid."""
        if not np.isfinite(self.tolerance):
            return
        for positions, now in zip(path, placed, strict=True):
            outer = self.edges.reached(positions, now)
            if outer is not None:
                warnings.warn(
                    f"GridFilter: the most likely value of {outer.name!r} in slice {now.row.t} is the outer "
                    f"point of its grid, {outer.point:.4g}, and may lie outside; give a wider grid",
                    GridWarning,
                    stacklevel=2,
                )
                return

    def _refuse_invalid(self, cells: Cells | None, now: Placed, factors: Sequence[Factor]) -> None:
        """Bad parameters raise where the cells that give them have mass."""
        for k, factor in enumerate(factors):
            if factor.invalid is None:
                continue
            above = [f for f in factors[:k] if f.hidden]
            terms = [factor.invalid]
            if cells is not None:
                terms += self._moving(cells, now, above)
            shape = self._shape(now)
            prior, _ = self._local(above, now, shape)
            terms.append(Named((*now.labels, *self.model.apart), np.exp(prior)))
            needed = {x for t in [f.table for f in above] + [factor.invalid] for x in t.scope}
            spare = [s for s in now.scalars if s.label not in needed]
            size = float(np.prod([s.widths.sum(axis=0).max() for s in spare], initial=1.0))
            mass = contract(terms, self.model.apart).values / size
            if np.any(mass > COUNTS):
                assert factor.problem is not None
                raise type(factor.problem)(
                    f"node {factor.name!r}: {factor.problem} in slice {now.row.t}, on cells of probability "
                    f"{float(np.max(mass)):.2g}; mend the function, or leave such cells out of the grid"
                )

    def _refuse_underflow(
        self, row: Row, predicted: np.ndarray, rest: np.ndarray, level: np.ndarray
    ) -> None:
        """Refuse to go on where cells that the belief cannot tell from zero may hold all there is."""
        lost = predicted < TINY
        if lost.any() and np.any(
            np.where(lost, np.log(TINY) + rest, -np.inf) > level + np.log(LOST)
        ):
            raise ZeroProbabilityError(
                f"GridFilter: what was seen in slice {row.t} is so far from what the belief before it allows "
                "that its probability underflows; check the data, widen the noise, or use another engine"
            )

    def _impossible(self, row: Row) -> ZeroProbabilityError:
        seen = ", ".join(map(repr, row.seen)) or "nothing"
        return ZeroProbabilityError(
            f"no cell of the grid explains what was seen in slice {row.t} (of {seen}); check the data, or "
            "give a wider grid"
        )


# ---- private ------------------------------------------------------------------------------------


def _closed(now: Placed, apart: Scope) -> list[Named]:
    """Points that stand for nothing, as terms that rule them out."""
    with np.errstate(divide="ignore"):
        return [
            Named((s.label, *apart), np.log(np.where(s.widths > 0, 1.0, 0.0)))
            for s in now.scalars
            if s.widths.shape[1:] != (1,) * len(apart)
        ]


def _at(term: Named, apart: Scope, element: tuple[int, ...]) -> Named:
    """A term at one element of the plates that are apart."""
    at = dict(zip(apart, element, strict=True))
    index = tuple(at.get(x, slice(None)) for x in term.scope)
    return Named(tuple(x for x in term.scope if x not in at), term.values[index])


def _traced(
    value: Sequence[Named],
    history: Sequence[Sequence[Sequence[Choice]]],
    placed: Sequence[Placed],
    elements: Sequence[tuple[int, ...]],
    lead: Shape,
) -> list[dict[Label, np.ndarray]]:
    """Back along the best choices, for every element by itself."""
    found = [{s.label: np.zeros(lead, dtype=np.intp) for s in p.scalars} for p in placed]
    for k, element in enumerate(elements):
        last = np.unravel_index(int(value[k].values.argmax()), placed[-1].shape)
        at: dict[Any, int] = {
            s.label: int(i) for s, i in zip(placed[-1].scalars, last, strict=True)
        }
        for t in reversed(range(len(placed))):
            for label, position in at.items():
                found[t][label][element] = position
            if not t:
                break
            known = dict(at)
            for choice in reversed(history[t][k]):
                known.update(choice.look_up(known))
            at = {s.label: known.get(previous(s.label), 0) for s in placed[t - 1].scalars}
    return found
