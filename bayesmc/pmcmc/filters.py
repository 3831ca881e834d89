"""Filters of all chains in one array: particles on the first axis, chains on the second.

Each chain has static nodes of its own, so that one pass over the slices is a filter for each of them.
``Filter`` estimates likelihoods without bias; ``ConditionalFilter`` keeps a trajectory among its particles.

References
----------
Andrieu, Doucet and Holenstein (2010), Particle Markov chain Monte Carlo methods, JRSS B 72; Lindsten, Jordan
and Schön (2014), Particle Gibbs with ancestor sampling, JMLR 15.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.engines.particles.particles import along_plates
from bayesmc.network.forward import Pass
from bayesmc.pmcmc.trellis import Slice, Trellis
from bayesmc.resampling import systematic
from bayesmc.structure.target import Values

#: share of the particles below which their effective number has them resampled
_THRESHOLD = 0.5
#: the axis of chains, as if it were a plate
_CHAIN = "\0chain"


class Selection(NamedTuple):
    """Who has offspring: positions (None: everybody has one), and the log weights that these start with."""

    ancestors: np.ndarray | None
    carried: Any


@dataclass(eq=False)
class History:
    """What a run leaves.

    Attributes
    ----------
    clouds : list of dict
        For each slice hidden node -> values, shape ``(particles, chains, *plates, *event)``.
    ancestors : list of ndarray or None
        For each slice positions in the one before, shape ``(particles, chains, *apart)``; None where every
        particle has itself.
    log_weights : ndarray, shape (particles, chains, *apart)
        Of the last slice.
    log_likelihood : ndarray, shape (chains,)
        Log of an estimate without bias (with a trajectory kept it is none).
    """

    clouds: list[Values] = field(default_factory=list)
    ancestors: list[np.ndarray | None] = field(default_factory=list)
    log_weights: Any = None
    log_likelihood: Any = 0.0


class Filter:
    """Bootstrap filters: particles move by the template, and are resampled where weights are uneven.

    Parameters
    ----------
    trellis : Trellis
    particles : int
    chosen : bool
        Whether another number may be chosen for the data (``of``).
    """

    #: error of the log likelihood that is best aimed at
    best = 1.0

    def __init__(self, trellis: Trellis, particles: int, chosen: bool = False) -> None:
        self.trellis, self.particles, self.chosen = trellis, particles, chosen
        self.plates = {n: (_CHAIN, *trellis.model[n].plates) for n in trellis.series.slices.dynamic}
        self.trailing = {n: len(trellis.model[n].value_shape) for n in self.plates}
        self.apart = (_CHAIN, *trellis.apart)

    def of(self, particles: int) -> Filter:
        """The filter with another number of particles."""
        if particles == self.particles:
            return self
        other = copy.copy(self)
        other.particles = particles
        return other

    def run(self, values: Values, chains: int, rng: np.random.Generator) -> History:
        """One filter for the static nodes of every chain.

        Parameters
        ----------
        values : dict
            Stored values of static nodes, ``(chains, *plates, *event)`` or without chains; where a
            trajectory is kept, it is theirs.
        """
        shape = (self.particles, chains, *self.trellis.lead)
        static = self.trellis.statics(values)
        history = History(log_likelihood=np.zeros(shape[1:]))
        log, before = np.zeros(shape), dict[str, np.ndarray]()
        for k, place in enumerate(self.trellis.slices):
            known = {**static, **place.known}
            start = self._start(shape)
            if k:
                start = self._selected(place, {**known, **before}, values, log, rng)
                before = {n: self._taken(n, v, start.ancestors) for n, v in before.items()}
            state = Pass(self._chance(rng, shape), shape[:2], {**known, **before})
            self._pass(place, state, values)
            log, gained = _normalised(np.broadcast_to(start.carried + state.log_weight, shape))
            history.log_likelihood += gained
            history.clouds.append({n: state.values[n] for n in place.hidden})
            history.ancestors.append(start.ancestors)
            interface = self.trellis.series.slices.interface
            before = {n + PREVIOUS: state.values[n] for n in interface if n in state.values}
        history.log_weights = log
        history.log_likelihood = history.log_likelihood.reshape(chains, -1).sum(axis=1)
        return history

    def drawn(self, history: History, rng: np.random.Generator) -> Values:
        """One trajectory of every chain: name in the unrolled net -> values ``(chains, *plates, *event)``."""
        found: Values = {}
        index = picked(history.log_weights, rng)[None]
        for place, cloud, ancestors in zip(
            self.trellis.slices[::-1], history.clouds[::-1], history.ancestors[::-1], strict=True
        ):
            for name, own in place.hidden.items():
                found[own] = along_plates(cloud[name], index, self.plates[name], self.apart)[0]
            if ancestors is not None:
                index = np.take_along_axis(ancestors, index, axis=0)
        return found

    # ---- private -------------------------------------------------------------------------------

    def _chance(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.random.Generator:
        """What moves particles of a slice."""
        return rng

    def _start(self, shape: tuple[int, ...]) -> Selection:
        return Selection(None, -np.log(self.particles))

    def _selected(
        self,
        place: Slice,
        known: Values,
        values: Values,
        log: np.ndarray,
        rng: np.random.Generator,
    ) -> Selection:
        """Resample where weights are uneven."""
        weights = np.exp(log)
        poor = 1.0 / np.square(weights).sum(axis=0) < _THRESHOLD * self.particles
        if not poor.any():
            return Selection(None, log)
        chosen = systematic(weights, self.particles, rng)
        even = -np.log(self.particles)
        if poor.all():
            return Selection(chosen, even)
        own = np.arange(self.particles).reshape((-1,) + (1,) * poor.ndim)
        return Selection(np.where(poor, chosen, own), np.where(poor, even, log))

    def _pass(self, place: Slice, state: Pass, values: Values) -> None:
        for _, step in place.moves:
            step(state)

    def _taken(self, name: str, value: np.ndarray, ancestors: np.ndarray | None) -> np.ndarray:
        """A node's values in the slice before, of the ancestors."""
        own = name.removesuffix(PREVIOUS)
        if ancestors is None or value.ndim < 2 + self.trailing[own]:
            return value  # all particles agree
        return along_plates(value, ancestors, self.plates[own], self.apart)


class ConditionalFilter(Filter):
    """Filters among whose particles one trajectory is kept, the last; its ancestors are drawn anew.

    All others are resampled independently in every slice. A trajectory drawn at the end then leaves the
    distribution of trajectories given everything else invariant, whatever the number of particles.
    """

    def _selected(
        self,
        place: Slice,
        known: Values,
        values: Values,
        log: np.ndarray,
        rng: np.random.Generator,
    ) -> Selection:
        others = independent(np.exp(log), self.particles - 1, rng)
        kept = self._ancestor(place, known, values, log, rng)
        return Selection(np.concatenate([others, kept[None]]), -np.log(self.particles))

    def _ancestor(
        self,
        place: Slice,
        known: Values,
        values: Values,
        log: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """The kept trajectory's ancestor: by weight, times the density of what comes after it."""
        if self.trellis.carries:
            return np.full(log.shape[1:], self.particles - 1)
        return picked(log + self._onward(place, known, values, log.shape, rng), rng)

    def _onward(
        self,
        place: Slice,
        known: Values,
        values: Values,
        shape: tuple[int, ...],
        rng: np.random.Generator,
    ) -> Any:
        """Log density of the kept trajectory's slice after every particle of the one before."""
        here = {n: values[own] for n, own in place.hidden.items()}
        state = Pass(rng, shape[:2], {**known, **here})
        for step in place.crossing:
            step(state)
        return state.log_weight

    def _pass(self, place: Slice, state: Pass, values: Values) -> None:
        for name, step in place.moves:
            step(state)
            if name in place.hidden:
                state.values[name] = self._kept(state.values[name], values[place.hidden[name]])

    def _kept(self, drawn: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
        """Draws with those of the last particle replaced."""
        found = np.array(drawn)
        found[-1] = trajectory
        found.flags.writeable = False
        return found


def picked(log: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One index along the first axis, in proportion to the exponentials, shape ``log.shape[1:]``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.pmcmc.filters import picked
    >>> log = np.log([[0.5, 1e-9], [1e-9, 0.5]])
    >>> picked(log, np.random.default_rng(0)).tolist()
    [0, 1]
    """
    edges = np.cumsum(np.exp(log - log.max(axis=0)), axis=0)
    point = (1.0 - rng.random(log.shape[1:])) * edges[-1]
    return (edges < point).sum(axis=0)


def independent(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Independent indices along the first axis, in proportion to weights, in no order.

    It does what ``resampling.multinomial`` does, for many short columns in one search.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.pmcmc.filters import independent
    >>> weights = np.array([[0.5, 0.0], [0.5, 0.0], [0.0, 1.0]])
    >>> np.stack([np.bincount(i, minlength=3) for i in independent(weights, 100, np.random.default_rng(0)).T])
    array([[ 44,  56,   0],
           [  0,   0, 100]])
    """
    count, shape = len(weights), weights.shape[1:]
    edges = np.cumsum(weights.reshape(count, -1), axis=0)
    edges /= edges[-1]
    lane = np.arange(edges.shape[1])[:, None]  # one column stands behind the other
    points = rng.random((len(lane), draws)) + lane
    found = np.searchsorted((edges.T + lane).ravel(), points.ravel(), side="right")
    found = np.clip(found.reshape(points.shape) - count * lane, 0, count - 1)
    return found.T.reshape(draws, *shape)


# ---- private ------------------------------------------------------------------------------------


def _normalised(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log weights that sum to one, and the log of their sum; even where all are zero."""
    top = log.max(axis=0)
    dead = ~(top > -np.inf)
    level = np.where(dead, 0.0, top)
    total = np.exp(log - level).sum(axis=0)
    gained = np.where(dead, -np.inf, level + np.log(total))
    if dead.any():
        return np.where(dead, -np.log(len(log)), log - np.where(dead, 0.0, gained)), gained
    return log - gained, gained
