"""Where every component of a Normal block stands, and solving for it.

What is eliminated first (many small matrices, or a band) keeps its pattern; the rest is one dense matrix.
Which is which, ``gaussian_order`` says.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.kernels.gaussian_order import Components, order_of
from bayesmc.linalg.patterns import Band, cholesky, lapack
from bayesmc.structure.target import Values

#: components up to which triangles are solved by one call for all chains
_SMALL = 32


class Layout:
    """Where every component of the block stands: those eliminated first, then the dense rest.

    Attributes
    ----------
    cut, dg : int
        Components eliminated first, and of the rest.
    width : int
        How far a band that is eliminated first reaches from the diagonal; 0 where there is none.
    entries : int
        Numbers that are stored of a precision: of the first part, between it and the rest (row by row), of
        the rest; and one to throw away.
    """

    def __init__(self, components: Components) -> None:
        self.components, self.names = components, components.names
        order = order_of(components)
        self.position, self.first = order.position, order.first
        self.size = len(self.position)
        self.cut, self.dg = self.first.size, order.rest
        self.width = self.first.width if isinstance(self.first, Band) else 0
        self.entries = order.entries + 1
        self._units = np.empty(0, dtype=np.intp)
        if components.free is not None:  # the diagonal of what was seen
            seen = self.position[~components.free]
            self._units = self.entry(seen, seen)
        self._alike = tuple(self._like_nodes())

    def entry(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Entry of the precision for two positions; what is kept elsewhere goes to the last."""
        cut, dg, first = self.cut, self.dg, self.first
        # all kinds are computed and one picked
        found = np.full(np.broadcast_shapes(row.shape, column.shape), -1)
        row_first, column_first = row < cut, column < cut
        if cut:
            found = np.where(row_first & column_first, first.entry(row, column), found)
            mixed = first.entries + row * dg + (column - cut)
            found = np.where(row_first & ~column_first, mixed, found)
        rest = first.entries + cut * dg + (row - cut) * dg + (column - cut)
        found = np.where(~row_first & ~column_first, rest, found)
        return np.where(found < 0, self.entries - 1, found)

    def parts(self, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precision of what is eliminated first (as stored), between that and the rest, and of the rest."""
        lead, cut, dg = len(precision), self.cut, self.dg
        begin, end = self.first.entries, self.first.entries + cut * dg
        mixed = precision[:, begin:end].reshape(lead, cut, dg)
        return precision[:, :begin], mixed, precision[:, end:-1].reshape(lead, dg, dg)

    def with_units(self, precision: np.ndarray) -> np.ndarray:
        """Ones on the diagonal of what was seen, which nothing else says anything about."""
        if not len(self._units):
            return precision
        precision = precision.copy()
        precision[:, self._units] = 1.0
        return precision

    def dense(self, precision: np.ndarray) -> np.ndarray:
        """The whole precision matrix (for checks)."""
        first, mixed, rest = self.parts(precision)
        cut = self.cut
        full = np.zeros((len(precision), self.size, self.size))
        full[:, :cut, :cut] = self.first.dense(first)
        full[:, :cut, cut:] = mixed
        full[:, cut:, :cut] = np.swapaxes(mixed, -1, -2)
        full[:, cut:, cut:] = rest
        return full

    def split(self, joined: np.ndarray, values: Mapping[str, np.ndarray]) -> Values:
        """A joined vector per chain as values of the nodes; what was seen stays."""
        chains = len(joined)
        new: Values = {}
        columns = None
        for names, at in self._alike:
            shape = (len(names), chains, *self.components.nodes[names[0]].value_shape)
            if len(names) == 1:
                rows = joined.take(at[0], axis=1).reshape(shape)
            else:
                columns = np.ascontiguousarray(joined.T) if columns is None else columns
                rows = np.moveaxis(columns[at], -1, 1).reshape(shape)
            rows.flags.writeable = False
            new.update(zip(names, rows, strict=True))
        for name in self.components.partly:
            new[name] = np.where(self._free(name), new[name], values[name])
        return new

    def joined(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values of the nodes as one vector per chain, what was seen as zero."""
        flat = [
            np.where(self._free(n), values[n], 0.0).reshape(len(values[n]), -1) for n in self.names
        ]
        joined = np.empty((len(flat[0]), self.size))
        joined[:, self.position] = np.concatenate(flat, axis=1)
        return joined

    # ---- private -------------------------------------------------------------------------------

    def _free(self, name: str) -> np.ndarray:
        """Which components of a node are free, in the shape of its values."""
        components, start = self.components, self.components.start[name]
        shape = components.nodes[name].value_shape
        if components.free is None:
            return np.ones(shape, dtype=bool)
        return components.free[start : start + math.prod(shape)].reshape(shape)

    def _like_nodes(self) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
        """Nodes of one shape, and their positions ``(nodes, components)``."""
        groups: dict[Any, list[str]] = {}
        for name in self.names:
            groups.setdefault(self.components.nodes[name].value_shape, []).append(name)
        for names in groups.values():
            size, _ = self.components.size_of(names[0])
            start = self.components.starts(names)
            yield tuple(names), self.position[start[:, None] + np.arange(size)]


class BlockSums:
    """Precision, linear term and constant of the log density of a block, as terms add to them.

    The precision has one row where all chains have the same.
    """

    def __init__(self, chains: int, layout: Layout) -> None:
        self.precision = np.zeros((1, layout.entries))
        self.linear = np.zeros((chains, layout.size))
        self.constant = np.zeros(chains)
        self.bad = np.zeros(chains, dtype=bool)

    def add(self, precision: np.ndarray, linear: np.ndarray, constant: np.ndarray) -> None:
        if len(precision) > len(self.precision):
            self.precision = self.precision + precision
        else:
            self.precision += precision
        self.linear += linear
        self.constant += constant


@dataclass(frozen=True, eq=False)
class Factor:
    """A factorised precision: what solving needs of it, for each chain or one for all.

    Attributes
    ----------
    root : ndarray
        Of what is eliminated first.
    mixed : ndarray, shape (lead, cut, dg)
        ``root^-1`` times the entries between that and the rest.
    rest : ndarray, shape (lead, dg, dg)
        Cholesky factor of the rest, the first part eliminated.
    log_det : ndarray, shape (lead,)
        Of the precision.
    bad : ndarray of bool, shape (lead,)
        It is not positive definite.
    """

    layout: Layout
    root: np.ndarray
    mixed: np.ndarray
    rest: np.ndarray
    log_det: np.ndarray
    bad: np.ndarray

    def solved(self, linear: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        """The mean, plus noise of the Gaussian's covariance, shape (chains, size)."""
        layout, cut = self.layout, self.layout.cut
        head, right = linear[:, :cut], linear[:, cut:]
        joined = np.empty_like(linear)
        if cut:
            head = layout.first.lower(self.root, head[..., None])[..., 0]
        if layout.dg:
            if cut:
                right = right - np.vecmat(head, self.mixed)
            half = _triangle(self.rest, right, "N")
            if noise is not None:
                half = half + noise[:, cut:]
            joined[:, cut:] = _triangle(self.rest, half, "T")
        if cut:
            if noise is not None:
                head = head + noise[:, :cut]
            if layout.dg:
                head = head - np.matvec(self.mixed, joined[:, cut:])
            joined[:, :cut] = layout.first.upper(self.root, head[..., None])[..., 0]
        return joined


def factored(layout: Layout, precision: np.ndarray) -> Factor:
    """Factorise precisions as ``BlockSums`` holds them."""
    first, mixed, rest = layout.parts(layout.with_units(precision))
    lead = len(precision)
    log_det, bad = np.zeros(lead), np.zeros(lead, dtype=bool)
    root = first
    if layout.cut:
        root, log_det, bad = layout.first.factored(first)
        if layout.dg:
            mixed = layout.first.lower(root, mixed)
            rest = rest - np.swapaxes(mixed, -1, -2) @ mixed
    if layout.dg:
        rest, wrong = cholesky(rest)
        bad = bad | wrong
        log_det = log_det + 2.0 * np.log(np.linalg.diagonal(rest)).sum(axis=-1)
    return Factor(layout, root, mixed, rest, log_det, bad)


def solved(
    layout: Layout, sums: BlockSums, noise: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean plus noise of the Gaussian's covariance, the log determinant of its precision, and bad chains."""
    factor = factored(layout, sums.precision)
    joined = factor.solved(sums.linear, noise)
    shape = (len(joined),)
    return joined, np.broadcast_to(factor.log_det, shape), sums.bad | factor.bad


# ---- private ------------------------------------------------------------------------------------


def _triangle(factor: np.ndarray, right: np.ndarray, trans: str) -> np.ndarray:
    """Lower triangles, or their transposes, solved for one vector each ``(chains, d)``."""
    if factor.shape[-1] <= _SMALL:
        lower = factor if trans == "N" else np.swapaxes(factor, -1, -2)
        return np.linalg.solve(lower, right[..., None])[..., 0]
    trtrs = lapack().dtrtrs
    if len(factor) == 1:
        return trtrs(factor[0], right.T, lower=1, trans=int(trans == "T"))[0].T
    pairs = zip(factor, right, strict=True)
    return np.stack([trtrs(f, r, lower=1, trans=int(trans == "T"))[0] for f, r in pairs])
