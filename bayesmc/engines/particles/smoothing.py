"""From filtered clouds to trajectories given all rows: backward simulation, and ancestors of a fixed lag.

Backward simulation draws a particle of the last slice, then one of each slice before with its weight times
the density of what was drawn after it. Exactly that costs trajectories x particles per slice; where the
density is known to be bounded, particles are drawn by weight and accepted with its share of the bound
instead, and only what is still open after some rounds is drawn exactly.

References
----------
Godsill, Doucet and West (2004), Monte Carlo smoothing for nonlinear time series, JASA 99; Douc, Garivier,
Moulines and Olsson (2011), Ann. Appl. Probab. 21 (rejection); Taghavi et al. (2013), Adaptive stopping for
fast particle smoothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc.dbn import PREVIOUS, Series, Slices
from bayesmc.distributions import Cauchy, Laplace, MvNormal, Normal, StudentT
from bayesmc.engines.particles.cloud import Cloud, Layout, along_plates, even_cloud
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.network.forward import Compute, Pass, Step, WeighDrawn
from bayesmc.resampling import systematic

#: pairs of trajectories and particles in one call
_PAIRS = 1 << 18
#: rounds of rejection before what is open is drawn exactly
_ROUNDS = 40
#: families that are highest at ``loc``
_LOCATION = (Normal, MvNormal, StudentT, Laplace, Cauchy)


class Backward:
    """Draws trajectories backwards through the clouds of a filter.

    Parameters
    ----------
    plan : SlicePlan
    layout : Layout
        Of the clouds.
    rejection : bool
        Accept draws by a bound where one is known.
    """

    def __init__(self, plan: SlicePlan, layout: Layout, rejection: bool = True) -> None:
        self.plan, self.layout = plan, layout
        self.slices: Slices = plan.slices
        self.steps, self.crossing = _crossing(plan)
        self.rejection = rejection and not layout.apart and _is_bounded(plan, self.crossing)
        #: draws accepted by the bound, and drawn exactly
        self.accepted = self.exact = 0

    def trajectories(
        self, clouds: Sequence[Cloud], series: Series, count: int, rng: np.random.Generator
    ) -> list[Cloud]:
        """So many trajectories, as one cloud of equal weights per slice."""
        layout = Layout(count, self.layout.apart, self.layout.lead)
        last = clouds[-1]
        index = systematic(last.weights, count, rng)
        index = rng.permuted(index, axis=0) if count > 1 else index
        found = [even_cloud(last.t, self._taken(last, index), layout)]
        for k in range(len(clouds) - 2, -1, -1):
            index = self._drawn(clouds[k], found[-1], series, k, rng)
            found.append(even_cloud(clouds[k].t, self._taken(clouds[k], index), layout))
        return found[::-1]

    def log_densities(
        self, cloud: Cloud, after: dict[str, np.ndarray], series: Series, k: int
    ) -> np.ndarray:
        """Log density of slices ``after`` the k-th given every particle, shape (draws, particles, *apart)."""
        before = {
            n: v[None] if v.ndim > self._trailing(n) else v for n, v in self._before(cloud).items()
        }
        now = {n: v[:, None] if v.ndim > self._trailing(n) else v for n, v in after.items()}
        draws = max((len(v) for n, v in after.items() if v.ndim > self._trailing(n)), default=1)
        return self._log(before, now, series, k, (draws, self.layout.particles))

    # ---- private -------------------------------------------------------------------------------

    def _drawn(
        self, cloud: Cloud, after: Cloud, series: Series, k: int, rng: np.random.Generator
    ) -> np.ndarray:
        """For every trajectory a particle of the k-th cloud, shape (draws, *apart)."""
        count = len(after.weights)
        found = np.empty((count, *self.layout.lead), dtype=np.intp)
        open_ = np.arange(count)
        if self.rejection:
            open_ = self._by_rejection(cloud, after, series, k, rng, found)
        block = max(1, _PAIRS // self.layout.particles)
        for low in range(0, len(open_), block):
            mine = open_[low : low + block]
            values = {n: _rows(v, mine, self._trailing(n)) for n, v in after.values.items()}
            log = self.log_densities(cloud, values, series, k) + cloud.log_weights
            found[mine] = _picked(log, rng)
        self.exact += len(open_)
        return found

    def _by_rejection(
        self,
        cloud: Cloud,
        after: Cloud,
        series: Series,
        k: int,
        rng: np.random.Generator,
        found: np.ndarray,
    ) -> np.ndarray:
        """Fill ``found`` where a draw was accepted; gives the trajectories that are still open."""
        open_ = np.arange(len(found))
        bound = self._bound(cloud, series, k)
        if not math.isfinite(bound):
            return open_
        edges = np.cumsum(cloud.weights)
        edges /= edges[-1]
        before = self._before(cloud)
        for _ in range(_ROUNDS):
            tried = np.searchsorted(edges, rng.random(len(open_)), side="right")
            tried = np.minimum(tried, len(edges) - 1)
            old = {n: _rows(v, tried, self._trailing(n)) for n, v in before.items()}
            new = {n: _rows(v, open_, self._trailing(n)) for n, v in after.values.items()}
            log = self._log(old, new, series, k, (len(open_),))
            good = -rng.standard_exponential(len(open_)) < log - bound
            found[open_[good]] = tried[good]
            self.accepted += int(good.sum())
            open_ = open_[~good]
            if not len(open_) or good.mean() < 1.0 / self.layout.particles:
                break
        return open_

    def _bound(self, cloud: Cloud, series: Series, k: int) -> float:
        """The largest log density that the slice after the k-th can have after any particle."""
        row, model = series.row(k + 1), self.slices.later
        before = {n + PREVIOUS: v for n, v in self._before(cloud).items()}
        state = Pass(
            np.random.default_rng(0), (self.layout.particles,), {**self.plan.known(row), **before}
        )
        total = 0.0
        for name in self.slices.dynamic:
            node = model[name]
            if name not in self.crossing:
                continue
            if node.domain is not None:
                continue  # a probability is at most one
            dist, _ = model.evaluate(name, state.values)
            top = np.asarray(dist.log_prob(dist.loc))
            lead = np.broadcast_shapes(top.shape, (1,) * (1 + len(node.plates)))
            full = np.broadcast_to(top.reshape(lead), (lead[0], *node.plate_shape))
            total += float(full.reshape(len(full), -1).sum(axis=1).max())
        return total

    def _log(
        self,
        before: dict[str, np.ndarray],
        now: dict[str, np.ndarray],
        series: Series,
        k: int,
        batch: tuple[int, ...],
    ) -> np.ndarray:
        """Log density of the slice after the k-th: factors that the slice before enters."""
        known = {**self.plan.known(series.row(k + 1)), **now}  # fillers stand for what is missing
        known |= {n + PREVIOUS: v for n, v in before.items()}
        state = Pass(np.random.default_rng(0), batch, known)
        for step in self.steps:
            step(state)
        return np.broadcast_to(
            np.asarray(state.log_weight, dtype=float), (*batch, *self.layout.lead)
        )

    def _before(self, cloud: Cloud) -> dict[str, np.ndarray]:
        return {n: cloud.values[n] for n in self.slices.interface}

    def _taken(self, cloud: Cloud, index: np.ndarray) -> dict[str, np.ndarray]:
        """Values of chosen particles of a cloud."""
        found = {}
        for name, value in cloud.values.items():
            node = self.slices.later[name]
            if value.ndim == len(node.value_shape):
                found[name] = value
            elif not self.layout.apart:
                found[name] = value.take(index, axis=0)
            else:
                found[name] = along_plates(value, index, node.plates, self.layout.apart)
        return found

    def _trailing(self, name: str) -> int:
        return len(self.slices.later[name].value_shape)


def carried(slices: Slices) -> tuple[str, ...]:
    """Deterministic nodes that carry something of the slice before on to the next, such as running sums.

    Trajectories cannot be put together backwards through them: what they were is settled by the past.
    """
    reached = {n + PREVIOUS for n in slices.interface}
    found = []
    for name in slices.dynamic:
        node = slices.later[name]
        if not node.is_stochastic and reached & set(node.parents):
            reached.add(name)
            if name in slices.interface:
                found.append(name)
    return tuple(found)


def ancestors_of(clouds: Sequence[Cloud], layout: Layout, slices: Slices) -> dict[str, np.ndarray]:
    """Values in the first of some clouds in a row of the ancestors of the particles of the last."""
    index: np.ndarray | None = None
    for cloud in reversed(clouds[1:]):
        if cloud.ancestors is None:
            continue
        index = cloud.ancestors if index is None else _composed(cloud.ancestors, index)
    values = clouds[0].values
    if index is None:
        return values
    found = {}
    for name, value in values.items():
        node = slices.later[name]
        if value.ndim == len(node.value_shape):
            found[name] = value
        elif not layout.apart:
            found[name] = value.take(index, axis=0)
        else:
            found[name] = along_plates(value, index, node.plates, layout.apart)
    return found


# ---- private ------------------------------------------------------------------------------------


def _composed(ancestors: np.ndarray, index: np.ndarray) -> np.ndarray:
    if ancestors.ndim == 1:
        return ancestors[index]
    return np.take_along_axis(ancestors, index, axis=0)


def _crossing(plan: SlicePlan) -> tuple[list[Step], frozenset[str]]:
    """Steps for the factors of a slice that the one before enters, and the nodes whose factors they are."""
    model = plan.slices.later
    reached = {n + PREVIOUS for n in plan.slices.interface}
    steps: list[Step] = []
    crossing = set()
    for name in plan.slices.dynamic:
        node = model[name]
        if not reached & set(node.parents):
            continue
        if node.is_stochastic:
            steps.append(WeighDrawn(model, node, plan.apart))
            crossing.add(name)
        else:
            steps.append(Compute(model, node))
            reached.add(name)
    return steps, frozenset(crossing)


def _is_bounded(plan: SlicePlan, crossing: frozenset[str]) -> bool:
    """Whether every factor is a probability, or as high as its particle alone says."""
    model, slices = plan.slices.later, plan.slices
    own = set(slices.dynamic)
    for name in crossing:
        node = model[name]
        if node.domain is not None:
            continue
        if own & set(node.parents):
            return False
        dist, _ = model.evaluate(name, {**model.probe, **plan.static})
        if not isinstance(dist, _LOCATION):
            return False
    return True


def _rows(value: np.ndarray, index: np.ndarray, trailing: int) -> np.ndarray:
    return value if value.ndim == trailing else value.take(index, axis=0)


def _picked(log: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One index along axis 1 for every row, in proportion to the exponentials, shape (rows, *rest)."""
    log = log - log.max(axis=1, keepdims=True)
    edges = np.cumsum(np.exp(log), axis=1)
    top = edges[:, -1:]
    point = rng.random(top.shape) * top
    return np.minimum((edges <= point).sum(axis=1), log.shape[1] - 1)
