"""Weighted particles, and the one step of sequential Monte Carlo that makes those of the next slice.

First-stage weights, resampling, propagation, weighting: every filter of the house takes it, one of a template
(``filter_step``), filters of all chains of a particle Markov chain sampler in one array (``pmcmc.filters``),
elements of plates that never meet side by side.

References
----------
Gordon, Salmond and Smith (1993), IEE Proceedings F 140; Pitt and Shephard (1999), JASA 94 (first-stage
weights); Chopin and Papaspiliopoulos (2020), An introduction to sequential Monte Carlo, ch. 10.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.particles.recovery import Averages
from bayesmc.network import CompiledNode
from bayesmc.network.forward import Pass, Step

#: numbers of the largest node in a block of particles: its temporaries stay in cache
BLOCK = 8192


class Particles(NamedTuple):
    """Particles of one slice.

    Attributes
    ----------
    t : int
    values : dict
        Node -> stored values, shape ``(particles, *plates, *event)``; without the first axis where all
        particles agree.
    log_weights : ndarray, shape (particles, *apart)
        Up to a constant.
    weights : ndarray, shape (particles, *apart)
        Their exponentials relative to the largest.
    total : ndarray, shape (*apart,)
        Sums of ``weights``.
    log_total : ndarray, shape (*apart,)
        Log of the sums of the exponentials of ``log_weights``.
    increment : ndarray, shape (*apart,)
        Log density of the row given the rows before.
    ess : ndarray, shape (*apart,)
    ancestors : ndarray of int or None
        Positions in the slice before, sorted; None where every particle has itself.
    resampled : ndarray of bool, shape (*apart,)
    rejuvenated : ndarray of bool, shape (*apart,)
        Whether they were drawn anew, since all weights had vanished; such particles have no ancestors.
    averages : Averages or None
        How well the last rows were explained, where recovery looks at that.
    injected : int
        Particles that recovery let begin anew.
    inner : Gaussians or None
        Beliefs about what is integrated out.
    tables : Tables or None
        Beliefs about finite nodes that are.
    """

    t: int
    values: dict[str, np.ndarray]
    log_weights: np.ndarray
    weights: np.ndarray
    total: Any
    log_total: Any
    increment: Any
    ess: Any
    ancestors: np.ndarray | None = None
    resampled: Any = False
    rejuvenated: Any = False
    averages: Averages | None = None
    injected: int = 0
    inner: Any = None
    tables: Any = None


class Selection(NamedTuple):
    """Which particles have offspring, and what weight the offspring start with.

    Attributes
    ----------
    particles : int
        Of the next slice.
    ancestors : ndarray of int or None
        Sorted positions; None where everybody has one.
    resampled : bool or ndarray of bool, shape (*apart,)
    log_weights : ndarray or float
        That the offspring have already.
    log_normaliser : ndarray or float, shape (*apart,)
        Log of what their sum stands for: an increment is the log of the new sum, less this.
    """

    particles: int
    ancestors: np.ndarray | None
    resampled: Any
    log_weights: Any
    log_normaliser: Any


@dataclass(frozen=True)
class Layout:
    """How the arrays of particles are laid out.

    Attributes
    ----------
    particles : int
    apart : tuple of str
        Plates whose elements have weights of their own: axes of the weights after that of the particles.
    lead : tuple of int
        Their sizes.
    block : int
        Particles that are worked on at a time.
    """

    particles: int
    apart: tuple[str, ...]
    lead: tuple[int, ...]
    block: int = BLOCK


class Bare(NamedTuple):
    """What of a step describes its particles: it goes with a pickle, and moves none."""

    slices: Slices
    layout: Layout


class SMCStep:
    """Makes the particles of a slice from those of the slice before.

    A family of filters says which steps pass a row's slice, and what is known in it (``steps``, ``known``).

    Parameters
    ----------
    layout : Layout
        Particles come in blocks, whose temporaries stay in cache.
    nodes : mapping
        Name -> compiled node, of all nodes of a slice.
    interface : sequence of str
        Nodes that the next slice reads.
    kept : sequence of str
        Nodes whose values particles hold, besides these.
    resample : callable
        ``(weights, draws, rng) -> indices``.
    threshold : float
        Share of the particles below which their effective number has them resampled.
    chains : int, optional
        Independent filters side by side, as if they were a plate: the first of the layout's.
    """

    def __init__(
        self,
        layout: Layout,
        nodes: Mapping[str, CompiledNode],
        interface: Sequence[str],
        kept: Sequence[str],
        resample: Callable[..., np.ndarray],
        threshold: float,
        chains: int | None = None,
    ) -> None:
        self.layout, self.resample, self.threshold = layout, resample, threshold
        #: what decides on offspring, whatever does it
        self.scheme = resample
        self.batch = () if chains is None else (chains,)
        own = layout.apart[: len(self.batch)]
        self.kept = tuple(dict.fromkeys((*interface, *kept)))
        self.before = tuple((n, n + PREVIOUS) for n in interface)
        self.ranks = {n: 1 + len(self.batch) + len(node.value_shape) for n, node in nodes.items()}
        self.plates = {n: (*own, *node.plates) for n, node in nodes.items()}
        for name, previous in self.before:
            self.ranks[previous], self.plates[previous] = self.ranks[name], self.plates[name]
        self._log_particles = math.log(layout.particles)
        self._even = np.ones((layout.particles, *layout.lead))
        self._even.flags.writeable = False
        self._spare = _Spare()

    def __call__(self, earlier: Particles | None, row: Any, rng: np.random.Generator) -> Particles:
        """The particles of a row's slice, given those of the slice before; None before the first."""
        before, selection = self.chosen(earlier, row, rng)
        values, log = self.propagated(self.steps(row), row, before, selection, rng)
        return self.weighted(row, values, log, selection)

    def steps(self, row: Any) -> Sequence[Step]:
        """The steps of a row's slice."""
        raise NotImplementedError

    def known(self, row: Any) -> dict[str, np.ndarray]:
        """Values in place before a slice is passed, but for the slice before."""
        raise NotImplementedError

    def log_first_stage(
        self, before: Mapping[str, np.ndarray], row: Any, rng: np.random.Generator
    ) -> np.ndarray | None:
        """Log factors by which particles are chosen for their future, from their values and the row."""
        return None

    def stored(self, row: Any, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What is held of a slice."""
        return {name: values[name] for name in self.kept}

    def recycle(self, particles: Particles) -> None:
        """Take back the large arrays of particles that nobody will look at again."""
        if len(particles.weights) > self.layout.block:
            self._spare.put(particles.weights, particles.log_weights, *particles.values.values())

    def chosen(
        self, earlier: Particles | None, row: Any, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], Selection]:
        """The values of the slice before, and which of them have offspring."""
        if earlier is None:
            n, never = self.layout.particles, False
            resampled = np.zeros(self.layout.lead, dtype=bool) if self.layout.lead else never
            return {}, Selection(n, None, resampled, 0.0, self._log_particles)
        values = earlier.values
        before = {previous: values[n] for n, previous in self.before if n in values}
        return before, self.selected(earlier, before, row, rng)

    def selected(
        self,
        earlier: Particles,
        before: Mapping[str, np.ndarray],
        row: Any,
        rng: np.random.Generator,
    ) -> Selection:
        """Resample where weights are uneven; with a first stage, by what the next row makes of them."""
        n, total = len(earlier.weights), earlier.log_total
        weights, ess, gained = earlier.weights, earlier.ess, 0.0
        factor = self.log_first_stage(before, row, rng)
        if factor is not None:
            log = earlier.log_weights + factor
            level = _top(log)
            weights = np.exp(log - level)
            chosen_from = weights.sum(axis=0)
            ess = chosen_from**2 / _squares(weights)
            gained = level + np.log(chosen_from) - total
        poor = ess < self.threshold * n
        some, every = (poor.any(), poor.all()) if self.layout.lead else (poor, poor)
        if not some:
            return Selection(n, None, poor, earlier.log_weights, total)
        chosen = self.resample(weights, n, rng)
        carried: Any = 0.0
        if factor is not None:
            carried = -np.take_along_axis(factor, chosen, 0)
        if every:
            return Selection(n, chosen, poor, carried, self._log_particles - gained)
        own = np.arange(n).reshape((-1,) + (1,) * poor.ndim)
        return Selection(
            n,
            np.where(poor, chosen, own),
            poor,
            np.where(poor, carried, earlier.log_weights),
            np.where(poor, self._log_particles - gained, total),
        )

    def propagated(
        self,
        steps: Sequence[Step],
        row: Any,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any]:
        """One forward pass over a slice, in blocks of particles: stored values and log weights."""
        n, ancestors, known = selection.particles, selection.ancestors, self.known(row)
        if n <= self.layout.block:
            for name, value in before.items():
                known[name] = self.taken(name, value, ancestors)
            state = Pass(rng, (n, *self.batch), known)
            for step in steps:
                step(state)
            return self.stored(row, state.values), state.log_weight
        values: dict[str, np.ndarray] = {}
        log: Any = 0.0
        for low in range(0, n, self.layout.block):
            high = min(low + self.layout.block, n)
            part = slice(low, high)
            chosen = part if ancestors is None else ancestors[part]
            taken = {k: self.taken(k, v, chosen) for k, v in before.items()}
            state = Pass(rng, (high - low, *self.batch), {**known, **taken})
            for step in steps:
                step(state)
            for name, value in self.stored(row, state.values).items():
                if value.ndim < self.ranks[name]:
                    values[name] = value  # the same for all particles
                    continue
                if low == 0:
                    values[name] = self._spare.get((n, *value.shape[1:]), value.dtype)
                values[name][part] = value
            weight = np.asarray(state.log_weight)
            if weight.ndim <= len(self.layout.lead):
                log = weight  # nothing was seen, or nothing that depends on the particles
                continue
            if low == 0:
                log = self._spare.get((n, *self.layout.lead), np.dtype(float))
            log[part] = weight
        return values, log

    def taken(
        self, name: str, value: np.ndarray, ancestors: np.ndarray | slice | None
    ) -> np.ndarray:
        """A node's values in the slice before, of the ancestors; read-only."""
        if ancestors is None or value.ndim < self.ranks[name]:
            return value
        if isinstance(ancestors, slice):
            found = value[ancestors]
        elif not self.layout.apart:
            found = value.take(ancestors, axis=0, mode="clip")  # they lie within
        else:
            found = along_plates(value, ancestors, self.plates[name], self.layout.apart)
        found.flags.writeable = False
        return found

    def weighted(
        self, row: Any, values: dict[str, np.ndarray], log: Any, selection: Selection
    ) -> Particles:
        """The particles of a slice; their ``total`` is not positive where no weight is left."""
        n, lead = selection.particles, self.layout.lead
        carried, spent = selection.log_weights, selection.log_normaliser
        log = carried + log if isinstance(carried, np.ndarray) else np.asarray(log)
        if log.ndim <= len(lead) and np.all(log == 0.0):
            even = np.full(lead, float(n)) if lead else float(n)
            log_total = np.log(even)
            return Particles(
                row.t, values, np.broadcast_to(0.0, (n, *lead)), self._even[:n], even, log_total,
                log_total - spent, even, selection.ancestors, selection.resampled,
            )  # fmt: skip
        if log.shape != (n, *lead):
            log = np.broadcast_to(log, (n, *lead))
        level = _top(log)
        weights, total, squares = self.exponentials(log, level)
        if lead:
            log_total, ess = level + np.log(total), total * total / squares
        else:
            log_total = level + (math.log(total) if total > 0.0 else -math.inf)
            ess = total * total / squares if squares else math.nan
        return Particles(
            row.t, values, log, weights, total, log_total, log_total - spent, ess,
            selection.ancestors, selection.resampled,
        )  # fmt: skip

    def room(self, shape: tuple[int, ...]) -> np.ndarray:
        """An array of real numbers to be filled."""
        if shape[0] <= self.layout.block:
            return np.empty(shape)
        return self._spare.get(shape, np.dtype(float))

    def exponentials(self, log: np.ndarray, level: Any) -> tuple[np.ndarray, Any, Any]:
        """Weights relative to a level, block by block, their sums and the sums of their squares."""
        if len(log) <= self.layout.block:
            weights = log - level
            np.exp(weights, out=weights)
            return weights, self._sum(weights), _squares(weights)
        weights = self._spare.get(log.shape, np.dtype(float))
        total: Any = 0.0
        squares: Any = 0.0
        for low in range(0, len(log), self.layout.block):
            part = weights[low : low + self.layout.block]
            np.subtract(log[low : low + self.layout.block], level, out=part)
            np.exp(part, out=part)
            total = total + self._sum(part)
            squares = squares + _squares(part)
        return weights, total, squares

    # ---- private -------------------------------------------------------------------------------

    def _sum(self, weights: np.ndarray) -> Any:
        if weights.ndim == 1:
            return float(weights.dot(self._even[: len(weights)]))
        return np.add.reduce(weights)


def evenly_weighted(t: int, values: dict[str, np.ndarray], layout: Layout) -> Particles:
    """Draws of equal weight."""
    shape = (layout.particles, *layout.lead)
    ones, none = np.ones(shape), np.zeros(layout.lead)
    count = np.full(layout.lead, float(layout.particles))
    return Particles(t, values, np.zeros(shape), ones, count, np.log(count), none, count)


def along_plates(
    value: np.ndarray,
    index: np.ndarray,
    plates: tuple[str, ...],
    apart: tuple[str, ...],
) -> np.ndarray:
    """``value[index]`` on the first axis; elements of the plates ``apart`` have indices of their own."""
    ndim = 1 + len(plates)
    order = [apart.index(p) if p in apart else None for p in plates]
    shape = [len(index), *(index.shape[1 + k] if k is not None else 1 for k in order)]
    first = index.transpose(0, *(1 + k for k in order if k is not None)).reshape(shape)
    rest = [
        np.arange(value.shape[axis]).reshape([-1 if a == axis else 1 for a in range(ndim)])
        for axis in range(1, ndim)
    ]
    return value[(first, *rest)]


@contextmanager
def quiet() -> Iterator[None]:
    """Bad parameters are marked, and weights of zero are no matter."""
    with marking_invalid(), np.errstate(all="ignore"):
        yield


# ---- private ------------------------------------------------------------------------------------


class _Spare:
    """Large arrays that are used again: fresh ones cost the machine a page at a time."""

    def __init__(self) -> None:
        self._free: dict[tuple[Any, ...], list[np.ndarray]] = {}

    def get(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        try:  # in one step, as other threads may use the same step
            return self._free[shape, dtype].pop()
        except (KeyError, IndexError):
            return np.empty(shape, dtype)

    def put(self, *arrays: np.ndarray) -> None:
        for array in arrays:
            if array.flags.owndata and array.flags.writeable and array.dtype != object:
                self._free.setdefault((array.shape, array.dtype), []).append(array)


def _top(log: np.ndarray) -> Any:
    """The largest log weight; 0 where all are minus infinity."""
    if log.ndim == 1:
        level = log.item(log.argmax())  # several times faster than a reduction, for short arrays
        return level if level > -math.inf else 0.0
    level = np.maximum.reduce(log)
    return np.where(level > -np.inf, level, 0.0)


def _squares(weights: np.ndarray) -> Any:
    if weights.ndim == 1:
        return float(weights.dot(weights))
    return np.einsum("i...,i...->...", weights, weights)
