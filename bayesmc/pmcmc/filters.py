"""Filters of all chains in one array: particles on the first axis, chains on the second.

Each chain has static nodes of its own, so that one pass over the slices is a filter for each of them.
``Filter`` estimates likelihoods without bias; with ``ConditionalStep`` it keeps a trajectory among its
particles.

References
----------
Andrieu, Doucet and Holenstein (2010), Particle Markov chain Monte Carlo methods, JRSS B 72; Lindsten, Jordan
and Schön (2014), Particle Gibbs with ancestor sampling, JMLR 15.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.categorical import pick
from bayesmc.engines.particles.smc import Layout, Particles, Selection, SMCStep, along_plates
from bayesmc.network.forward import Pass, Step
from bayesmc.pmcmc.trellis import Slice, Trellis
from bayesmc.resampling import systematic
from bayesmc.structure.target import Values

#: share of the particles below which their effective number has them resampled
_THRESHOLD = 0.5
#: the axis of chains, as if it were a plate
_CHAIN = "\0chain"


class History(NamedTuple):
    """What a run leaves.

    Attributes
    ----------
    slices : list of Particles
        Values have shape ``(particles, chains, *plates, *event)``, weights ``(particles, chains, *apart)``.
    log_likelihood : ndarray, shape (chains,)
        Log of an estimate without bias (with a trajectory kept it is none).
    """

    slices: list[Particles]
    log_likelihood: np.ndarray


class ChainStep(SMCStep):
    """The step of the filters of all chains, given their static nodes.

    Parameters
    ----------
    trellis : Trellis
    particles : int
    values : dict
        Stored values of static nodes, ``(chains, *plates, *event)`` or without chains; where a trajectory is
        kept, it is theirs.
    chains : int
    """

    def __init__(self, trellis: Trellis, particles: int, values: Values, chains: int) -> None:
        slices = trellis.series.slices
        layout = Layout(particles, (_CHAIN, *trellis.apart), (chains, *trellis.lead), particles)
        nodes = {n: trellis.model[n] for n in slices.dynamic}
        super().__init__(
            layout, nodes, slices.interface, slices.dynamic, systematic, _THRESHOLD, chains
        )
        self.trellis, self.values, self.static = trellis, values, trellis.statics(values)

    def steps(self, row: Slice) -> Sequence[Step]:
        return [step for _, step in row.moves]

    def known(self, row: Slice) -> dict[str, np.ndarray]:
        return {**self.static, **row.known}

    def stored(self, row: Slice, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {n: values[n] for n in self.kept if n in values}

    def weighted(
        self, row: Slice, values: dict[str, np.ndarray], log: Any, selection: Selection
    ) -> Particles:
        """As ever; where a chain has no weight left, its particles go on alike, for nothing."""
        found = super().weighted(row, values, log, selection)
        dead = ~(found.total > 0)
        if not dead.any():
            return found
        even = float(self.layout.particles)
        return found._replace(
            log_weights=np.where(dead, 0.0, found.log_weights),
            weights=np.where(dead, 1.0, found.weights),
            total=np.where(dead, even, found.total),
            log_total=np.where(dead, np.log(even), found.log_total),
            increment=np.where(dead, -np.inf, found.increment),
            ess=np.where(dead, even, found.ess),
        )


class Filter:
    """Bootstrap filters: particles move by the template, and are resampled where weights are uneven.

    Parameters
    ----------
    trellis : Trellis
    particles : int
    chosen : bool
        Whether another number may be chosen for the data (``of``).
    step : callable
        Makes the step of a run from the trellis, the number of particles, values and chains.
    """

    #: error of the log likelihood that is best aimed at
    best = 1.0

    def __init__(
        self,
        trellis: Trellis,
        particles: int,
        chosen: bool = False,
        step: Callable[[Trellis, int, Values, int], ChainStep] = ChainStep,
    ) -> None:
        self.trellis, self.particles, self.chosen, self.step = trellis, particles, chosen, step

    def of(self, particles: int) -> Filter:
        """The filter with another number of particles."""
        if particles == self.particles:
            return self
        other = copy.copy(self)
        other.particles = particles
        return other

    def run(self, values: Values, chains: int, rng: np.random.Generator) -> History:
        """One filter for the static nodes of every chain; ``values`` and ``chains`` as for ``ChainStep``."""
        step = self.step(self.trellis, self.particles, values, chains)
        log, slices = np.zeros((chains, *self.trellis.lead)), list[Particles]()
        now: Particles | None = None
        with np.errstate(divide="ignore", invalid="ignore"):  # chains without a weight are no fault
            for place in self.trellis.slices:
                now = step(now, place, rng)
                log = log + now.increment
                slices.append(now)
        return History(slices, log.reshape(chains, -1).sum(axis=1))

    def drawn(self, history: History, rng: np.random.Generator) -> Values:
        """One trajectory of every chain: name in the unrolled net -> values ``(chains, *plates, *event)``."""
        found: Values = {}
        if not history.slices:
            return found
        model, apart = self.trellis.model, (_CHAIN, *self.trellis.apart)
        index = picked(history.slices[-1].log_weights, rng)[None]
        for place, now in zip(self.trellis.slices[::-1], history.slices[::-1], strict=True):
            for name, own in place.hidden.items():
                plates = (_CHAIN, *model[name].plates)
                found[own] = along_plates(now.values[name], index, plates, apart)[0]
            if now.ancestors is not None:
                index = np.take_along_axis(now.ancestors, index, axis=0)
        return found


class ConditionalStep(ChainStep):
    """One of its particles, the last, is that of a trajectory; its ancestors are drawn anew.

    All others are resampled independently in every slice. A trajectory drawn at the end then leaves the
    distribution of trajectories given everything else invariant, whatever the number of particles.
    """

    def selected(
        self,
        earlier: Particles,
        before: Mapping[str, np.ndarray],
        row: Slice,
        rng: np.random.Generator,
    ) -> Selection:
        n = self.layout.particles
        others = independent(earlier.weights, n - 1, rng)
        kept = self.ancestor(earlier, before, row, rng)
        everybody = np.ones(self.layout.lead, dtype=bool)
        chosen = np.concatenate([others, kept[None]])
        return Selection(n, chosen, everybody, 0.0, self._log_particles)

    def ancestor(
        self,
        earlier: Particles,
        before: Mapping[str, np.ndarray],
        row: Slice,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """The kept trajectory's ancestor: by weight, times the density of what comes after it."""
        if self.trellis.carries:
            return np.full(self.layout.lead, self.layout.particles - 1)
        return picked(earlier.log_weights + self.onward(before, row, rng), rng)

    def onward(self, before: Mapping[str, np.ndarray], row: Slice, rng: np.random.Generator) -> Any:
        """Log density of the kept trajectory's slice after every particle of the one before."""
        here = {n: self.values[own] for n, own in row.hidden.items()}
        shape = (self.layout.particles, *self.batch)
        state = Pass(rng, shape, {**self.known(row), **before, **here})
        for step in row.crossing:
            step(state)
        return state.log_weight

    def steps(self, row: Slice) -> Sequence[Step]:
        found: list[Step] = []
        for name, step in row.moves:
            found.append(step)
            if name in row.hidden:
                found.append(_Keep(self, name, self.values[row.hidden[name]]))
        return found

    def kept_among(self, drawn: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
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
    return pick(np.exp(log - log.max(axis=0)), rng.random(log.shape[1:]))


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


class _Keep:
    """Puts a kept trajectory's value in the place of the last draw."""

    def __init__(self, step: ConditionalStep, name: str, trajectory: np.ndarray) -> None:
        self.step, self.name, self.trajectory = step, name, trajectory

    def __call__(self, state: Pass) -> None:
        drawn = state.values[self.name]
        state.values[self.name] = self.step.kept_among(drawn, self.trajectory)
