"""Markov random fields: a finite variable over many sites under factors on few sites each.

Sites of one colour move at once. `SiteSums` is for any such field: it gathers and sums the log factors
around every site. `SiteCounts` is for fields whose factors on pairs are alike: there the states of the
neighbours act through how many are in each state, so small whole numbers are added up, and they point into
a table of cumulative probabilities; where most neighbours lie at few distances, as on a grid, the adding
up is done by shifted slices of the whole field. Where factors make chains or trees, `SiteForest` draws all
sites as one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import expit

from bayesmc.categorical import edges, pick_log
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.forest import Forest
from bayesmc.kernels.sites import PairCounts, Sites, pair_counts, sites_of
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values

#: bits of a random number that are compared at once, and when these tie
_HIGH, _LOW = 8, 32
#: log factors gathered at once
_GATHERED = 1 << 22
#: entries of tables, for one chain
_ENTRIES = 1 << 21


def lattice_kernel(blanket: Blanket) -> Kernel | None:
    """The kernel of a finite variable over sites; None where its factors read other hidden quantities.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.lattice import lattice_kernel
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> ring = bmc.FactorGraph("ring", plates={"site": 6})
    >>> ring.variable("s", (-1, 1), plates="site")
    >>> i = np.arange(6)
    >>> ring.factor(lambda a, b: 0.5 * a * b, scope=("s", "s"), index=(i, (i + 1) % 6))
    >>> kernel = lattice_kernel(Blanket(target_of(pose(ring, None)), "s"))
    >>> kernel.match
    '6 sites of 2 states, 2 colours'
    """
    if blanket.node.domain is None or not blanket.node.plates or not blanket.size:
        return None
    sites = sites_of(blanket)
    if sites is None:
        return None
    counts = pair_counts(blanket.name, sites, blanket.classes)
    return SiteSums(blanket, sites) if counts is None else SiteCounts(blanket, counts)


class _Lattice(Kernel):
    """What both kernels share.

    Attributes
    ----------
    constrained : bool
        Some factor forbids joint states, so that moves of one site at a time may not reach all others.
    """

    constrained = False

    def __init__(self, blanket: Blanket) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        domain = blanket.node.domain
        assert domain is not None
        self.states = domain.size
        self.evaluations = float(domain.size)
        self.dtype = domain.dtype
        every = np.arange(blanket.size)
        self.classes = [every if c is None else c for c in blanket.classes]
        colours = "1 colour" if len(self.classes) == 1 else f"{len(self.classes)} colours"
        self.match = f"{blanket.size} sites of {self.states} states, {colours}"

    def log_density(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Log full conditional of each site's states up to a constant, shape ``(states, chains, sites)``."""
        raise NotImplementedError

    def _flat(self, values: Mapping[str, np.ndarray], name: str) -> np.ndarray:
        value = values[name]
        return value.reshape(len(value), -1)


class SiteSums(_Lattice):
    """Draws the sites of each colour from the sum of the log factors around them.

    Parameters
    ----------
    blanket : Blanket
    sites : Sites
    """

    label = "enumerate"

    def __init__(self, blanket: Blanket, sites: Sites) -> None:
        super().__init__(blanket)
        self.constrained = any(bool(np.isneginf(b.log).any()) for b in sites.batches)
        others = (n for batch in sites.batches for n in batch.names)
        self.read = tuple(dict.fromkeys([blanket.name, *others]))
        model = blanket.target.model
        sizes = [int(np.prod(model[n].plate_shape)) for n in self.read]
        self.begin = dict(zip(self.read, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
        self.table, roles = _pooled(blanket.name, sites, self.begin)
        self.parts = [_Around(members, blanket.size, roles) for members in self.classes]
        finite = bool(np.isfinite(self.table).all())
        self.odds = self.table[1] - self.table[0] if self.states == 2 and finite else None

    def log_density(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        state = self._state(values)
        log = np.zeros((self.states, len(state), self.blanket.size))
        for part in self.parts:
            log[..., part.members] = part.sums(self.table, state)
        return log

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        name = self.blanket.name
        state = self._state(values)
        for part in self.parts:
            if self.odds is not None:
                odds = part.sums(self.odds[None], state)[0]
                new = rng.random(odds.shape) < expit(odds)
            else:
                log = part.sums(self.table, state)
                new = pick_log(log, rng.random(log.shape[1:]), f"node {name!r}")
            state[:, part.members] = new
        moved = state[:, : self.blanket.size].astype(self.dtype)
        return {name: moved.reshape(values[name].shape)}, memory

    def _state(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """All states that are read, side by side, shape ``(chains, elements)``."""
        return np.concatenate([self._flat(values, n) for n in self.read], axis=1)


class SiteCounts(_Lattice):
    """Draws the sites of each colour by how many neighbours are in each state.

    Random bits are compared with the leading byte of cumulative probabilities; the few that tie are
    decided by the other bits, so that probabilities are exact to 2**-40.

    Parameters
    ----------
    blanket : Blanket
    counts : PairCounts
    """

    label = "enumerate"

    def __init__(self, blanket: Blanket, counts: PairCounts) -> None:
        super().__init__(blanket)
        self.counts = counts
        self.edges = _edges(counts.log_probs)
        high = np.minimum(self.edges >> np.uint64(_LOW), (1 << _HIGH) - 1).astype(np.uint8)
        self.high: list[Any] = list(high) if counts.base is not None else [*map(_byte_table, high)]
        self.weights = _byte_table(counts.weights)
        back = np.zeros(256, dtype=np.uint8)
        back[counts.weights] = np.arange(self.states)
        self.back = _byte_table(back)
        self.masks = []
        for members in self.classes:
            mask = np.zeros(blanket.size, dtype=np.uint8)
            mask[members] = 255
            self.masks.append(mask)

    def log_density(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        field = self._field(self._flat(values, self.blanket.name))
        log = np.zeros((self.states, len(field), self.blanket.size))
        for colour, members in enumerate(self.classes):
            rows = self._rows(self.counts.codes(field, colour))[:, members]
            log[..., members] = self.counts.log_probs[:, rows]
        return log

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        name = self.blanket.name
        field = self._field(self._flat(values, name))
        inner = self.counts.inner(field)
        # every site is drawn once, so that one byte for each will do
        words = rng.bit_generator.random_raw(-(-inner.size // 8))
        bits = words.view(np.uint8)[: inner.size].reshape(inner.shape)
        for colour, mask in enumerate(self.masks):
            new = self._drawn(self.counts.codes(field, colour), bits, mask, rng)
            if self.states > 2:
                new = _looked_up(self.weights, new).copy()
            # replaces the sites of this colour; several times faster than copying where a mask is true
            new ^= inner
            new &= mask
            inner ^= new
        moved = inner.copy() if self.states == 2 else _looked_up(self.back, inner)
        return {name: moved.reshape(values[name].shape)}, memory

    def _field(self, state: np.ndarray) -> np.ndarray:
        margin = self.counts.margin
        field = np.zeros((len(state), state.shape[1] + 2 * margin), dtype=np.uint8)
        inner = self.counts.inner(field)
        inner[:] = state if self.states == 2 else _looked_up(self.weights, state)
        return field

    def _rows(self, code: np.ndarray) -> np.ndarray:
        """Rows of the table of full conditionals."""
        return code if self.counts.base is None else self.counts.base + code

    def _drawn(
        self, code: np.ndarray, bits: np.ndarray, mask: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """New states of all sites; those of other colours are drawn to no end, which costs little."""
        rows = self._rows(code)
        new = tied = None
        for high in self.high:
            edge = high.take(rows) if isinstance(high, np.ndarray) else _looked_up(high, code)
            above, equal = (bits > edge).view(np.uint8), bits == edge
            new = above if new is None else np.add(new, above, out=new)
            tied = equal if tied is None else np.logical_or(tied, equal, out=tied)
        assert new is not None and tied is not None
        at = np.flatnonzero((tied.view(np.uint8) & mask).view(bool))
        if len(at):
            low = rng.bit_generator.random_raw(len(at)) >> np.uint64(64 - _LOW)
            whole = (bits.ravel()[at].astype(np.uint64) << np.uint64(_LOW)) | low
            new.ravel()[at] = (whole >= self.edges[:, rows.ravel()[at]]).sum(axis=0)
        return new


def site_forest(blanket: Blanket) -> SiteForest | None:
    """The kernel of a variable over sites; None where factors make cycles, or read other hidden quantities.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.lattice import site_forest
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> chain = bmc.FactorGraph("chain", plates={"site": 6})
    >>> chain.variable("s", (-1, 1), plates="site")
    >>> i = np.arange(5)
    >>> chain.factor(lambda a, b: 0.5 * a * b, scope=("s", "s"), index=(i, i + 1))
    >>> site_forest(Blanket(target_of(pose(chain, None)), "s")).match
    'filtering and sampling along 5 pairs of 6 sites, 2 states'
    """
    domain = blanket.node.domain
    if domain is None or not blanket.node.plates or not blanket.size:
        return None
    pairs = sum(len(c.relation.edges) for c in blanket.children if c.relation.kind == "rows")
    # sites of a cycle have as many pairs; some factors may stand on the same one
    if not 0 < pairs < 4 * blanket.size:
        return None
    if (2 * blanket.size) * domain.size**2 > _ENTRIES:
        return None
    sites = sites_of(blanket)
    if sites is None or any(b.names != (blanket.name,) * 2 for b in sites.batches):
        return None
    try:
        return SiteForest(blanket, sites)
    except ValueError:  # a cycle
        return None


class SiteForest(Kernel):
    """Draws all sites from their joint distribution.

    Parameters
    ----------
    blanket : Blanket
    sites : Sites
        Factors on single sites and on pairs of this variable alone.

    Raises
    ------
    ValueError
        Their pairs make a cycle.
    """

    label = "forest"

    def __init__(self, blanket: Blanket, sites: Sites) -> None:
        self.names = (blanket.name,)
        domain = blanket.node.domain
        assert domain is not None
        self.dtype, states = domain.dtype, domain.size
        every = [np.sort(np.stack(b.index, axis=1), axis=1) for b in sites.batches]
        edges, place = np.unique(np.concatenate(every), axis=0, return_inverse=True)
        self.forest = Forest(blanket.size, edges)
        self.single = sites.single.copy()
        seen = blanket.target.seen(blanket.name)
        if seen is not None and seen.mask is not None:
            other = np.arange(states)[:, None] != seen.value.ravel()
            self.single[other & seen.mask.ravel()] = -np.inf
        self.pairs = np.zeros((states, states, len(edges)))
        begin = 0
        for batch in sites.batches:
            log = np.broadcast_to(batch.log, (states, states, batch.rows))
            turned = batch.index[0] > batch.index[1]
            log = np.where(turned, log.swapaxes(0, 1), log)
            at: Any = (slice(None), slice(None), place.reshape(-1)[begin : begin + batch.rows])
            np.add.at(self.pairs, at, log)
            begin += batch.rows
        size = f"{len(edges)} pairs of {blanket.size} sites, {states} states"
        self.match = f"filtering and sampling along {size}"

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        (name,) = self.names
        chains = len(values[name])
        tables = np.empty((*self.pairs.shape[:2], self.forest.tables, chains))
        tables[:, :, : self.forest.edges] = self.pairs[..., None]
        single = np.repeat(self.single[..., None], chains, axis=2)
        uniform = np.ascontiguousarray(rng.random((chains, self.forest.count)).T)
        drawn, _ = self.forest.draw(single, tables, uniform, name)
        return {name: drawn.T.astype(self.dtype).reshape(values[name].shape)}, memory


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Role:
    """The factors of a batch as one of their entries sees them, one row each.

    ``begin`` points into the table of log factors; a state of element ``read[i]`` adds ``strides[i]``
    times itself.
    """

    site: np.ndarray
    begin: np.ndarray
    read: list[np.ndarray]
    strides: list[int]


def _pooled(name: str, sites: Sites, begin: Mapping[str, int]) -> tuple[np.ndarray, list[_Role]]:
    """All log factors in one table (states, entries), and how each entry of each batch reads it."""
    states, count = sites.single.shape
    pool = [sites.single]
    roles = [_Role(np.arange(count), np.arange(count), [], [])]
    size = count
    for batch in sites.batches:
        for own in (i for i, n in enumerate(batch.names) if n == name):
            log = np.moveaxis(batch.log, own, 0)
            others = [i for i in range(len(batch.names)) if i != own]
            read = [begin[batch.names[i]] + batch.index[i] for i in others]
            strides = [int(np.prod(log.shape[2 + k :])) for k in range(len(others))]
            at = np.arange(batch.rows) if log.shape[-1] > 1 else np.zeros(batch.rows, dtype=np.intp)
            roles.append(_Role(batch.index[own], size + at, read, strides))
            pool.append(log.reshape(states, -1))
            size += pool[-1].shape[1]
    return np.concatenate(pool, axis=1), roles


class _Around:
    """The factors around the sites of one colour, those of a site side by side."""

    def __init__(self, members: np.ndarray, count: int, roles: Sequence[_Role]) -> None:
        self.members = members
        place = np.full(count, -1)
        place[members] = np.arange(len(members))
        owner, begin = [], []
        depth = max(len(r.read) for r in roles)
        read: list[list[np.ndarray]] = [[] for _ in range(depth)]
        strides: list[list[np.ndarray]] = [[] for _ in range(depth)]
        for role in roles:
            rows = np.flatnonzero(place[role.site] >= 0)
            owner.append(place[role.site[rows]])
            begin.append(role.begin[rows])
            for i in range(depth):
                there = i < len(role.read)
                read[i].append(role.read[i][rows] if there else np.zeros(len(rows), dtype=np.intp))
                strides[i].append(np.full(len(rows), role.strides[i] if there else 0))
        owners = np.concatenate(owner)
        order = np.argsort(owners, kind="stable")
        self.begin = np.concatenate(begin)[order]
        self.read = [np.concatenate(r)[order] for r in read]
        self.strides = [np.concatenate(s)[order] for s in strides]
        # every site has a factor of its own, so that no part is empty
        self.starts = np.searchsorted(owners[order], np.arange(len(members)))

    def sums(self, table: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Sum of the log factors around each site, shape ``(len(table), chains, members)``."""
        most = max(1, _GATHERED // len(self.begin))
        if len(state) > most:
            parts = [state[i : i + most] for i in range(0, len(state), most)]
            return np.concatenate([self.sums(table, part) for part in parts], axis=1)
        index = np.broadcast_to(self.begin, (len(state), len(self.begin)))
        for read, strides in zip(self.read, self.strides, strict=True):
            index = index + state.take(read, axis=1) * strides
        return np.add.reduceat(table.take(index, axis=1), self.starts, axis=-1)


def _edges(log_probs: np.ndarray) -> np.ndarray:
    """Cumulative probabilities as integers, shape (states - 1, rows); impossible states have no width."""
    sums = np.minimum(edges(np.exp(log_probs - log_probs.max(axis=0)).T).T, 1.0)
    return np.rint(sums * float(1 << (_HIGH + _LOW))).astype(np.uint64)


def _byte_table(row: np.ndarray) -> bytes:
    """A row of at most 256 bytes as a table for ``_looked_up``."""
    return row.tobytes().ljust(256, b"\0")


def _looked_up(table: bytes, codes: np.ndarray) -> np.ndarray:
    """``table[codes]`` for bytes, read-only: the translation of byte strings needs no wide index."""
    return np.frombuffer(codes.tobytes().translate(table), dtype=np.uint8).reshape(codes.shape)
