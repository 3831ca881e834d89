"""Where every component of a Normal block stands, and solving for it.

The nodes of one plate that meet only element by element come first, as many small matrices; the rest is one
dense matrix. Elimination goes in that order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.gaussian import try_cholesky
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values

#: components up to which plates are not eliminated apart
_SMALL = 24


class Layout:
    """Where every component of the block stands: local ones by element, then the dense rest."""

    def __init__(
        self,
        target: Target,
        names: Sequence[str],
        blankets: Mapping[str, Blanket],
        terms: Sequence[Term],
    ) -> None:
        self.names = tuple(names)
        self.nodes = {n: target.model[n] for n in names}
        self.counts = {n: math.prod(self.nodes[n].plate_shape) for n in names}
        self.dims = {n: math.prod(self.nodes[n].event_shape) for n in names}
        self.free: dict[str, np.ndarray] = {}
        self.base: Values = {}
        for n in names:
            seen = target.seen(n)
            free = np.ones(self.nodes[n].plate_shape, dtype=bool)
            base = np.zeros((1, *self.nodes[n].value_shape))
            if seen is not None:
                assert seen.mask is not None
                free = ~seen.mask
                mask = seen.mask.reshape(seen.mask.shape + (1,) * len(self.nodes[n].event_shape))
                base[0] = np.where(mask, seen.value, 0.0)
            self.free[n] = free.ravel()
            self.base[n] = base
        self.local = _local_nodes(target, self.names, blankets, terms, self.counts, self.dims)
        self.rest = tuple(n for n in names if n not in self.local)
        self.n = self.counts[self.local[0]] if self.local else 0
        self.dl = sum(self.dims[n] for n in self.local)
        self.dg = sum(self.counts[n] * self.dims[n] for n in self.rest)
        self.size = self.n * self.dl + self.dg
        self.offset: dict[str, int] = {}
        at = 0
        for n in self.local:
            self.offset[n] = at
            at += self.dims[n]
        at = 0
        for n in self.rest:
            self.offset[n] = at
            at += self.counts[n] * self.dims[n]
        #: entries of the three parts of the precision, and one to throw away
        self.entries = self.n * self.dl * (self.dl + self.dg) + self.dg**2 + 1

    def place(self, name: str, component: int, elements: np.ndarray) -> np.ndarray:
        """Position in the joined vector of one component of some elements."""
        if name in self.local:
            return elements * self.dl + self.offset[name] + component
        return self.n * self.dl + self.offset[name] + elements * self.dims[name] + component

    def entry(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Entry of the precision for two positions; what is kept elsewhere goes to the last."""
        cut = self.n * self.dl
        n, dl, dg = self.n, self.dl, self.dg
        # all kinds are computed and one picked
        element, inner = np.divmod(row, max(dl, 1))
        both = element * dl * dl + inner * dl + column % max(dl, 1)
        mixed = n * dl * dl + row * dg + (column - cut)
        rest = n * dl * (dl + dg) + (row - cut) * dg + (column - cut)
        row_local, column_local = row < cut, column < cut
        found = np.where(row_local & column_local, both, self.entries - 1)
        found = np.where(row_local & ~column_local, mixed, found)
        return np.where(~row_local & ~column_local, rest, found)

    def blocks(self, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precision of local elements, between them and the rest, and of the rest."""
        chains = len(precision)
        n, dl, dg = self.n, self.dl, self.dg
        first, second = n * dl * dl, n * dl * (dl + dg)
        local = precision[:, :first].reshape(chains, n, dl, dl)
        mixed = precision[:, first:second].reshape(chains, n, dl, dg)
        rest = precision[:, second:-1].reshape(chains, dg, dg)
        return local, mixed, rest

    def dense(self, precision: np.ndarray) -> np.ndarray:
        """The whole precision matrix (for checks)."""
        local, mixed, rest = self.blocks(precision)
        chains, cut = len(precision), self.n * self.dl
        full = np.zeros((chains, self.size, self.size))
        for e in range(self.n):
            at = slice(e * self.dl, (e + 1) * self.dl)
            full[:, at, at] = local[:, e]
            full[:, at, cut:] = mixed[:, e]
            full[:, cut:, at] = np.swapaxes(mixed[:, e], -1, -2)
        full[:, cut:, cut:] = rest
        return full

    def split(self, joined: np.ndarray, values: Mapping[str, np.ndarray]) -> Values:
        """A joined vector per chain as values of the nodes; what was seen stays."""
        new: Values = {}
        chains = len(joined)
        cut = self.n * self.dl
        local = joined[:, :cut].reshape(chains, self.n, self.dl)
        for name in self.names:
            d, count, at = self.dims[name], self.counts[name], self.offset[name]
            if name in self.local:
                part = local[:, :, at : at + d]
            else:
                part = joined[:, cut + at : cut + at + count * d].reshape(chains, count, d)
            if not self.free[name].all():
                old = values[name].reshape(chains, count, d)
                part = np.where(self.free[name][:, None], part, old)
            new[name] = np.ascontiguousarray(part).reshape(chains, *self.nodes[name].value_shape)
        return new

    def joined(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values of the nodes as one vector per chain, what was seen as zero."""
        chains = len(values[self.names[0]])
        joined = np.zeros((chains, self.size))
        for name in self.names:
            flat = values[name].reshape(chains, self.counts[name], self.dims[name])
            flat = np.where(self.free[name][:, None], flat, 0.0)
            for c in range(self.dims[name]):
                joined[:, self.place(name, c, np.arange(self.counts[name]))] = flat[..., c]
        return joined


class BlockSums:
    """Precision, linear term and constant of the log density of a block, per chain, as terms add to them."""

    def __init__(self, chains: int, layout: Layout) -> None:
        self.precision = np.zeros((chains, layout.entries))
        self.linear = np.zeros((chains, layout.size))
        self.constant = np.zeros(chains)
        self.bad = np.zeros(chains, dtype=bool)
        self.problem: str | None = None

    def add(self, precision: Any, linear: Any, constant: Any) -> None:
        self.precision += precision
        self.linear += linear
        self.constant += constant

    def mark(self, bad: np.ndarray, problem: str) -> None:
        """Chains in which a term has no meaning."""
        self.bad |= bad
        self.problem = self.problem or problem


def solved(
    layout: Layout, sums: BlockSums, noise: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean plus noise of the Gaussian's covariance, the log determinant of its precision, and bad chains."""
    linear = sums.linear
    chains = len(linear)
    local, mixed, rest = layout.blocks(sums.precision)
    local, rest = _with_units(layout, local, rest)
    cut, n, dl, dg = layout.n * layout.dl, layout.n, layout.dl, layout.dg
    joined = np.empty_like(linear)
    right = linear[:, cut:]
    log_det = np.zeros(chains)
    bad = sums.bad
    if cut:
        root, wrong = _factor(local)
        bad = bad | wrong.any(axis=-1)
        head = linear[:, :cut].reshape(chains, n, dl)
        both = np.concatenate([mixed, head[..., None]], axis=-1)
        both = both / root if dl == 1 else np.linalg.solve(root, both)
        mixed, head = both[..., :-1], both[..., -1]
        tall = mixed.reshape(chains, cut, dg)
        rest = rest - np.swapaxes(tall, -1, -2) @ tall
        right = right - np.vecmat(head.reshape(chains, cut), tall)
        log_det += 2.0 * np.log(np.linalg.diagonal(root)).sum(axis=(-2, -1))
    if dg:
        factor, wrong = _factor(rest)
        bad = bad | wrong
        half = np.linalg.solve(factor, right[..., None])[..., 0]
        if noise is not None:
            half = half + noise[:, cut:]
        joined[:, cut:] = np.linalg.solve(np.swapaxes(factor, -1, -2), half[..., None])[..., 0]
        log_det += 2.0 * np.log(np.linalg.diagonal(factor)).sum(axis=-1)
    if cut:
        if noise is not None:
            head = head + noise[:, :cut].reshape(head.shape)
        if dg:
            head = head - np.matvec(mixed, joined[:, None, cut:])
        if dl == 1:
            drawn = head / root[..., 0]
        else:
            drawn = np.linalg.solve(np.swapaxes(root, -1, -2), head[..., None])[..., 0]
        joined[:, :cut] = drawn.reshape(chains, cut)
    return joined, log_det, bad


# ---- private ------------------------------------------------------------------------------------


def _factor(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cholesky factors, and which matrices have none (those get the identity)."""
    try:
        if matrices.shape[-1] == 1:
            wrong = np.asarray(~((matrices > 0) & (matrices < np.inf))[..., 0, 0])
            return np.sqrt(np.where(wrong[..., None, None], 1.0, matrices)), wrong
        factor = np.linalg.cholesky(matrices)
        wrong = np.asarray(~np.isfinite(factor).all(axis=(-2, -1)))
        if not wrong.any():
            return factor, wrong
    except np.linalg.LinAlgError:
        pass
    factor, refused = try_cholesky(matrices)
    found = np.zeros(matrices.shape[:-2], dtype=bool) if refused is None else refused
    return factor, found


def _with_units(
    layout: Layout, local: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ones on the diagonal of what was seen, which nothing else says anything about."""
    for name in layout.names:
        free = layout.free[name]
        if free.all():
            continue
        seen = np.flatnonzero(~free)
        for c in range(layout.dims[name]):
            if name in layout.local:
                local = local.copy()
                local[:, seen, layout.offset[name] + c, layout.offset[name] + c] = 1.0
            else:
                at = layout.offset[name] + seen * layout.dims[name] + c
                rest = rest.copy()
                rest[:, at, at] = 1.0
    return local, rest


def _local_nodes(
    target: Target,
    names: Sequence[str],
    blankets: Mapping[str, Blanket],
    terms: Sequence[Term],
    counts: Mapping[str, int],
    dims: Mapping[str, int],
) -> tuple[str, ...]:
    """Nodes of one plate that meet only element by element, to be eliminated first."""
    if sum(counts[n] * dims[n] for n in names) <= _SMALL:
        return ()
    groups: dict[tuple[str, ...], list[str]] = {}
    for n in names:
        if target.model[n].plates:
            groups.setdefault(target.model[n].plates, []).append(n)
    order = sorted(groups.values(), key=lambda g: -sum(counts[n] * dims[n] for n in g))
    for group in order:
        if all(_meet_alone(target, group, blankets, term) for term in terms):
            return tuple(group)
    return ()


def _meet_alone(
    target: Target, group: Sequence[str], blankets: Mapping[str, Blanket], term: Term
) -> bool:
    """Whether every element of a term depends on one element of the group's plates only."""
    indices: list[np.ndarray | None] = []
    for name in group:
        if term.name == name:
            indices.append(np.arange(math.prod(term.shape)))
        for child in blankets[name].children:
            if child.term is not term:
                continue
            relation = child.relation
            if relation.kind == "lookup":
                indices.append(None)
            elif relation.kind == "rows":
                indices.append(relation.rows[0])
            else:
                at = np.unravel_index(np.arange(math.prod(term.shape)), term.shape)
                picked = [at[term.plates.index(p)] for p in relation.plates]
                indices.append(np.ravel_multi_index(picked, relation.shape))
    if len(indices) <= 1:
        return True
    known = [i for i in indices if i is not None]
    return len(known) == len(indices) and all(np.array_equal(known[0], i) for i in known[1:])
