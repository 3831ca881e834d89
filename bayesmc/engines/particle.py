"""Particle filters: weighted draws of a slice, carried to the next, resampled where weights are uneven.

Every slice is one forward pass over the two-slice template (``slice_steps``); what a filter keeps of it is a
``Cloud``. ``particle_belief`` answers questions about a cloud, ``particle_record`` collects the answers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.slice_steps import SlicePlan, plates_apart, size_of
from bayesmc.errors import DegeneracyError
from bayesmc.network.forward import Pass, Step

#: numbers of the largest node in a block of particles: its temporaries stay in cache
BLOCK = 8192


@dataclass(frozen=True, eq=False)
class Cloud:
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
    increment : ndarray, shape (*apart,)
        Log density of the row given the rows before.
    ess : ndarray, shape (*apart,)
    ancestors : ndarray of int or None
        Positions in the cloud before, sorted; None where every particle has itself.
    resampled : ndarray of bool, shape (*apart,)
    """

    t: int
    values: dict[str, np.ndarray]
    log_weights: np.ndarray
    weights: np.ndarray
    total: np.ndarray
    increment: np.ndarray
    ess: np.ndarray
    ancestors: np.ndarray | None = None
    resampled: Any = False


class Mover:
    """Moves clouds from slice to slice: the plan of a particle filter on a template.

    Parameters
    ----------
    slices : Slices
    particles : int
    resample : callable
        ``(weights, draws, rng) -> indices``.
    threshold : float
        Share of the particles below which their effective number has them resampled.
    wanted : tuple of str
        Nodes whose values are kept, besides those that the next slice reads.
    static : dict
        Values of the static nodes.
    """

    def __init__(
        self,
        slices: Slices,
        particles: int,
        resample: Callable[..., np.ndarray],
        threshold: float,
        wanted: tuple[str, ...],
        static: Mapping[str, np.ndarray],
    ) -> None:
        self.slices, self.particles = slices, particles
        self.resample, self.threshold = resample, threshold
        self.apart = plates_apart(slices)
        self.plan = SlicePlan(slices, self.apart, static)
        self.kept = tuple(dict.fromkeys((*slices.interface, *wanted)))
        self.block = max(1, BLOCK // max(size_of(slices), 1))
        self.lead = tuple(slices.first.sizes[p] for p in self.apart)

    def first(self, row: Row, rng: np.random.Generator) -> Cloud:
        """The cloud of slice 0."""
        values, log = self._passed(row, {}, None, rng)
        return self._weighted(row, values, log, None, None, False)

    def next(self, cloud: Cloud, row: Row, rng: np.random.Generator) -> Cloud:
        """The cloud of the next slice: resample if need be, move, weight."""
        ancestors, resampled = self._selected(cloud, rng)
        before = {n + PREVIOUS: cloud.values[n] for n in self.slices.interface}
        values, log = self._passed(row, before, ancestors, rng)
        return self._weighted(row, values, log, cloud, ancestors, resampled)

    def _selected(self, cloud: Cloud, rng: np.random.Generator) -> tuple[np.ndarray | None, Any]:
        """Who has offspring, or None where everybody has one."""
        poor = cloud.ess < self.threshold * self.particles
        if not np.any(poor):
            return None, poor
        if not self.apart:
            return self.resample(cloud.weights, self.particles, rng), poor
        chosen = self.resample(cloud.weights, self.particles, rng)
        own = np.arange(self.particles).reshape((-1,) + (1,) * len(self.apart))
        return np.where(poor, chosen, own), poor

    def _passed(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        ancestors: np.ndarray | None,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any]:
        """One forward pass over a slice, in blocks of particles: kept values and log weights."""
        steps, known = self.plan.steps(row), self.plan.known(row)
        n = self.particles
        if n <= self.block:
            taken = {k: self._taken(k, v, ancestors) for k, v in before.items()}
            state = _run(steps, Pass(rng, (n,), {**known, **taken}))
            return {k: state.values[k] for k in self.kept}, state.log_weight
        values: dict[str, np.ndarray] = {}
        log: Any = 0.0
        for low in range(0, n, self.block):
            high = min(low + self.block, n)
            part = None if ancestors is None else ancestors[low:high]
            taken = {
                k: self._taken(k, v if part is not None else _cut(v, low, high, n), part)
                for k, v in before.items()
            }
            state = _run(steps, Pass(rng, (high - low,), {**known, **taken}))
            self._store(values, state.values, low, high)
            weight = np.asarray(state.log_weight)
            if low == 0:
                log = np.empty((n, *self.lead)) if weight.ndim > len(self.lead) else weight
            if log.ndim > len(self.lead):
                log[low:high] = weight
        for value in values.values():
            value.flags.writeable = False
        return values, log

    def _store(
        self, values: dict[str, np.ndarray], found: Mapping[str, np.ndarray], low: int, high: int
    ) -> None:
        for name in self.kept:
            value = found[name]
            shape = self.slices.first[name].value_shape
            if value.ndim == len(shape):
                values[name] = value  # the same for all particles
                continue
            if low == 0:
                values[name] = np.empty((self.particles, *shape), dtype=value.dtype)
            values[name][low:high] = value

    def _taken(self, name: str, value: np.ndarray, ancestors: np.ndarray | None) -> np.ndarray:
        """A node's values of the slice before, of the ancestors of a block."""
        if ancestors is None:
            return value
        node = self.slices.later[name]
        if value.ndim == len(node.value_shape):
            return value
        if not self.apart:
            return value.take(ancestors, axis=0)
        return _along_plates(value, ancestors, node.plates, self.apart, len(node.event_shape))

    def _weighted(
        self,
        row: Row,
        values: dict[str, np.ndarray],
        log: Any,
        cloud: Cloud | None,
        ancestors: np.ndarray | None,
        resampled: Any,
    ) -> Cloud:
        """The cloud of a slice, its weights those of before unless they were spent on resampling."""
        shape = (self.particles, *self.lead)
        level_before: Any = np.log(self.particles)
        if cloud is not None and not np.all(resampled):
            carried = cloud.log_weights
            before = np.log(cloud.total)
            if np.any(resampled):
                carried = np.where(resampled, 0.0, carried)
                before = np.where(resampled, np.log(self.particles), before)
            log, level_before = carried + log, before
        log = np.asarray(log, dtype=float)
        if log.shape != shape:
            log = np.broadcast_to(log, shape)
        level = log.max(axis=0)
        if not np.all(level > -np.inf):
            raise self._degenerate(row)
        log = log - level
        weights = np.exp(log)
        total = weights.sum(axis=0)
        ess = total * total / np.einsum("i...,i...->...", weights, weights)
        increment = level + np.log(total) - level_before
        return Cloud(row.t, values, log, weights, total, increment, ess, ancestors, resampled)

    def _degenerate(self, row: Row) -> DegeneracyError:
        seen = ", ".join(map(repr, row.seen))
        return DegeneracyError(
            f"no particle of {self.particles} explains what was seen in slice {row.t} (of {seen})",
            row.t,
        )


# ---- private ------------------------------------------------------------------------------------


def _run(steps: list[Step], state: Pass) -> Pass:
    for step in steps:
        step(state)
    return state


def _cut(value: np.ndarray, low: int, high: int, n: int) -> np.ndarray:
    return value[low:high] if value.ndim and len(value) == n else value


def _along_plates(
    value: np.ndarray,
    ancestors: np.ndarray,
    plates: tuple[str, ...],
    apart: tuple[str, ...],
    event_ndim: int,
) -> np.ndarray:
    """``value[ancestors]`` where every element of some plates has ancestors of its own."""
    index: list[Any] = []
    ndim = 1 + len(plates)
    order = [apart.index(p) if p in apart else None for p in plates]
    shape = [len(ancestors)] + [ancestors.shape[1 + k] if k is not None else 1 for k in order]
    moved = ancestors.transpose(0, *(1 + k for k in order if k is not None)).reshape(shape)
    index.append(moved)
    for axis in range(1, ndim):
        size = value.shape[axis]
        index.append(np.arange(size).reshape([size if a == axis else 1 for a in range(ndim)]))
    del event_ndim
    return value[tuple(index)]
