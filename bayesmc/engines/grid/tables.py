"""Densities of a slice as tables over its scalars and those of the slice before.

Tables that read the slice before are scaled cell by cell, so that sums over them do not underflow, and large
ones are made block by block while a block is in cache. Those that do not change are made once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS, Row
from bayesmc.engines.grid.slice import GridSlices, Placed, Values, sizes_by_label
from bayesmc.engines.grid.sources import Label, is_previous, previous
from bayesmc.errors import BudgetError, ParameterError
from bayesmc.factors.named import Named, aligned, without_ones
from bayesmc.network import CompiledNode
from bayesmc.shapes import padded

#: entries that are evaluated at once: their temporaries stay in cache
BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class Factor:
    """The density of one node over the grid.

    Attributes
    ----------
    table : Named
        Log densities; with a ``scale`` densities over the largest that the slice before can give.
    hidden : bool
        Whether it is the density of what is hidden (and adds up to one), not a likelihood.
    scale : Named or None
        Logs of those largest densities, over axes of this slice.
    invalid : Named or None
        Configurations with bad parameters, as ones; ``problem`` says what is wrong.
    """

    name: str
    table: Named
    hidden: bool
    scale: Named | None = None
    invalid: Named | None = None
    problem: ParameterError | None = None


class GridModel(GridSlices):
    """A template on a grid: its slices, and their densities as tables; see ``GridSlices``.

    With ``logs`` all tables are log densities.
    """

    @cached_property
    def _kept(self) -> dict[Any, Factor]:
        """Tables that do not change."""
        return {}

    def factors(self, before: Placed | None, now: Placed) -> list[Factor]:
        """Every density of a slice over its scalars and those of the slice before, parents first."""
        base, found = self.base(before, now), []
        for name in self.own:
            seen = now.row.seen.get(name)
            if seen is None and name in self.leaves:
                continue
            if seen is None or seen.mask is None:
                found.append(self._factor(name, before, now, base, seen is None))
            else:
                if name not in self.leaves:
                    found.append(self._factor(name, before, now, base, True, ~seen.mask))
                found.append(self._factor(name, before, now, base, False, seen.mask))
        return found

    def is_fixed(self, name: str, before: Placed | None, row: Row) -> bool:
        """Whether a density on its cells is that of any other slice in which the same is hidden."""
        sources = self.sources(before is None, name)
        seen = any(n in row.seen for n in sources.now) or (
            before is not None and any(n in before.row.seen for n in sources.before)
        )
        return not (sources.timed or seen)

    # ---- private -------------------------------------------------------------------------------

    def _factor(
        self, name: str, before: Placed | None, now: Placed, base: Values, hidden: bool,
        mask: np.ndarray | None = None,
    ) -> Factor:  # fmt: skip
        first = before is None
        fixed = mask is None and hidden and self.is_fixed(name, before, now.row)
        key = (first, before is not None and before.row.t == 0, name, ends_of(before))
        if fixed and key in self._kept:
            return self._kept[key]
        found = self._tabulated(name, before, now, base, hidden, mask)
        if fixed:
            self._kept[key] = found
        return found

    def _tabulated(
        self, name: str, before: Placed | None, now: Placed, base: Values, hidden: bool,
        mask: np.ndarray | None,
    ) -> Factor:  # fmt: skip
        sizes = sizes_by_label(before, now)
        labels = tuple(sizes)
        reach = self._reach(before is None, name, before, now)
        scope = [x for x in labels if x in reach]
        count = math.prod(sizes[x] for x in scope)
        if count * 8 > self.max_bytes:
            raise BudgetError(self.too_large(name, [sizes[x] for x in scope], count * 8), count * 8)
        numbers = count * math.prod(self.slices.first[name].event_shape)
        names = (*labels, *self.apart)
        was = tuple(k for k, x in enumerate(labels) if is_previous(x) and x in reach)
        if self.logs:
            was = ()
        # along an axis of this slice, blocks can be scaled while they are in cache
        inner = [x for x in scope if not is_previous(x)]
        if numbers <= BLOCK or not scope or not (inner or self.logs or not was):
            found = self._block(before is None, name, base, mask, len(labels), was)
        else:
            label = max(inner or scope, key=sizes.__getitem__)
            step = max(1, sizes[label] * BLOCK // numbers)
            found = self._in_blocks(
                before, name, base, mask, labels, was, label, sizes[label], step
            )
        scale = None if found.scale is None else without_ones(found.scale, names)
        bad = None if found.invalid is None else without_ones(found.invalid.astype(float), names)
        return Factor(name, without_ones(found.table, names), hidden, scale, bad, found.problem)

    def _in_blocks(
        self, before: Placed | None, name: str, base: Values, mask: np.ndarray | None,
        labels: tuple[Label, ...], was: tuple[int, ...], label: Label, n: int, step: int,
    ) -> Block:  # fmt: skip
        """A large table, block by block along one axis."""
        axis = labels.index(label)
        parts: list[np.ndarray | None] = [None, None, None]
        problem = None
        for low in range(0, n, step):
            base_here = self._window(base, len(labels) - axis, low, low + step)
            block = self._block(before is None, name, base_here, mask, len(labels), was)
            problem = problem or block.problem
            at = (slice(None),) * axis + (slice(low, low + step),)
            for k, part in enumerate((block.table, block.scale, block.invalid)):
                if part is None:
                    continue
                whole = parts[k]
                if whole is None:
                    whole = np.zeros((*part.shape[:axis], n, *part.shape[axis + 1 :]), part.dtype)
                    parts[k] = whole
                whole[at] = part
        table, scale, invalid = parts
        assert table is not None
        return Block(table, scale, invalid, problem)

    def _block(
        self, first: bool, name: str, base: Values, mask: np.ndarray | None, count: int,
        was: tuple[int, ...],
    ) -> Block:  # fmt: skip
        """A table, scaled where it reads the slice before."""
        log, invalid, problem = self.log(first, name, base, mask, count)
        was = tuple(k for k in was if log.shape[k] > 1)
        if not was:
            return Block(log, None, invalid, problem)
        top = log.max(axis=was, keepdims=True)
        top[top == -np.inf] = 0.0
        table = log - top
        np.exp(table, out=table)
        return Block(table, top, invalid, problem)

    def _window(self, base: Values, place: int, low: int, high: int) -> Values:
        """The values with one batch axis, the ``place``-th from the right, cut to a range."""
        found = {}
        for name, value in base.items():
            model = self.slices.later if name.endswith(PREVIOUS) else self.slices.first
            node = model.nodes.get(name)
            batch = value.ndim - len(node.value_shape) if node is not None else 0
            if batch >= place and value.shape[batch - place] > 1:
                value = value[(slice(None),) * (batch - place) + (slice(low, high),)]
            found[name] = value
        return found

    def log(
        self, first: bool, name: str, base: Values, mask: np.ndarray | None, count: int
    ) -> tuple[np.ndarray, np.ndarray | None, ParameterError | None]:
        """Log densities, shape ``(*batch, *apart)``, and where parameters are bad."""
        model = self.slices.first if first else self.slices.later
        node = model[name]
        if name in self.memory:
            came = self.computed(first, name, {n: v for n, v in base.items() if n != name})
            log = np.where(came == base[name], 0.0, -np.inf)
            return self._summed(log, node, None, count), None, None
        dist = self.evaluate(first, name, base)
        log = model.log_density(name, dist, base[name])
        bad = None
        if dist.invalid is not None and dist.invalid.any():
            log = np.where(dist.invalid, -np.inf, log)
            inside = dist.invalid if mask is None else dist.invalid & mask
            bad = self._summed(inside.astype(float), node, None, count) > 0
        return self._summed(log, node, mask, count), bad, dist.problem

    def _summed(
        self, log: np.ndarray, node: CompiledNode, mask: np.ndarray | None, count: int
    ) -> np.ndarray:
        """Log densities summed over plates whose elements meet, shape ``(*batch, *apart)``."""
        if mask is not None:
            log = np.where(mask, log, 0.0)
        log = padded(log, count + len(node.plates))
        kept: list[str] = []
        for k in reversed(range(len(node.plates))):
            axis, n = count + k, node.plate_shape[k]
            if node.plates[k] in self.apart:
                kept.insert(0, node.plates[k])
            elif log.shape[axis] == n:
                log = log.sum(axis=axis)
            else:
                log = log.take(0, axis=axis) * n
        return aligned(Named(tuple(kept), log), self.apart)

    def _reach(self, first: bool, name: str, before: Placed | None, now: Placed) -> set[Label]:
        hidden = {s.label[0] for s in now.scalars}
        found = {x for x in self.scope(first, name, frozenset(hidden)) if x in set(now.labels)}
        if before is not None:
            was = frozenset(s.label[0] for s in before.scalars)
            held = {previous(x) for x in before.labels}
            found |= {x for x in self.scope(first, name, was) if x in held}
        return found


def ends_of(before: Placed | None) -> tuple[Any, ...]:
    """Which points the slice before has: a belief may come from another grid."""
    scalars = () if before is None else before.scalars
    return tuple((s.size, s.points.flat[0], s.points.flat[-1]) for s in scalars)


# ---- private ------------------------------------------------------------------------------------


class Block(NamedTuple):
    """A table in the making, shapes ``(*batch, *apart)``."""

    table: np.ndarray
    scale: np.ndarray | None
    invalid: np.ndarray | None
    problem: ParameterError | None
