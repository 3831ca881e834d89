"""From filtered particles to trajectories given all rows: backward simulation, and ancestors of a fixed lag.

Backward simulation draws a particle of the last slice, then one of each slice before with its weight times
the density of what was drawn after it. Exactly that costs trajectories x particles per slice; where the
density is known to be bounded, particles are drawn by weight and accepted with its share of the bound
instead, and only what is still open after some rounds is drawn otherwise: exactly, or, where particles are
many, among a few hundred of them drawn by weight and the ancestor that the filter knows. A move among such
candidates leaves the law of what is drawn backwards as it is (it is a Gibbs step over which of them is the
draw); the ancestor helps where transitions are so narrow that next to no other particle would do.

Elements of plates that are filtered separately have a past each: positions have shape ``(rows, *apart)``, and
what is still open is packed to the front in every element for itself.

Computed nodes that carry something on, such as lags (``l = x_prev``), make what comes after a slice depend on
more than the slice before it. A particle of slice k is then drawn with its weight times the density of all
drawn slices that its values still enter, what is computed there being computed anew:

    p(x_k, l_k | x_{k+1:T}, y) ~ p(x_k, l_k | y_{1:k}) p(x_{k+1} | x_k, l_k) p(x_{k+2} | x_{k+1}, x_k) ...

Of the pair x_k alone is kept: l_k, a draw of x_{k-1}, is integrated out by forgetting it, and the next step
draws x_{k-1} given x_{k:T}. With lags up to p these are p factors; where a value is never forgotten (running
sums) it would be all that follow, and drawing backwards is refused.

Where a filter began anew (rejuvenation), nothing is known of how its particles came about: there both kinds
of smoothing take the slice before as the filter left it.

References
----------
Godsill, Doucet and West (2004), Monte Carlo smoothing for nonlinear time series, JASA 99; Douc, Garivier,
Moulines and Olsson (2011), Ann. Appl. Probab. 21 (rejection); Taghavi et al. (2013), Adaptive stopping for
fast particle smoothing; Andrieu, Lee and Vihola (2018), Bernoulli 24, and Dau and Chopin (2023), On backward
smoothing algorithms, Ann. Statist. 51 (moves among candidates, from the ancestor); Lindsten and Schön (2013),
Backward simulation methods for Monte Carlo statistical inference, sec. 4 (models with memory).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from itertools import pairwise
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, Series, Slices
from bayesmc.engines.particles.families import ancestors_worth
from bayesmc.engines.particles.layers import LOCATION, Layer, is_bounded, layers_of
from bayesmc.engines.particles.smc import Layout, Particles, along_plates, evenly_weighted
from bayesmc.engines.slice_steps import SlicePlan, size_of
from bayesmc.network.forward import Pass, Step, summed
from bayesmc.resampling import multinomial, systematic

#: trajectories that are drawn where nobody says how many, at most
TRAJECTORIES = 1000
#: numbers of all pairs of trajectories and particles in one call
_PAIRS = 1 << 18
#: rounds of rejection before what is open is drawn exactly
_ROUNDS = 40
#: particles drawn by weight among which a draw is made, where more are too many to be tried
_CANDIDATES = 500


class Backward:
    """Draws trajectories backwards through the particles of a filter.

    Parameters
    ----------
    plan : SlicePlan
    layout : Layout
        Of the particles.
    rejection : bool
        Accept draws by a bound where one is known, and try a few candidates alone where particles are many.
    seen : collection of str
        Nodes that are seen in full in all slices.

    Attributes
    ----------
    positions : list of ndarray
        Of the trajectories drawn last, in each slice's particles, shape ``(trajectories, *apart)``.
    """

    def __init__(
        self,
        plan: SlicePlan,
        layout: Layout,
        rejection: bool = True,
        seen: Collection[str] = (),
    ) -> None:
        self.plan, self.layout = plan, layout
        self.slices: Slices = plan.slices
        self.layers = layers_of(plan, seen)
        self.crossing = self.layers[0].crossing
        one = len(self.layers) == 1
        self.rejection = rejection and one and is_bounded(plan, self.crossing)
        self.few = rejection
        self.positions: list[np.ndarray] = []
        #: draws accepted by the bound, and drawn exactly, or among candidates
        self.accepted = self.exact = 0

    def trajectories(
        self, filtered: Sequence[Particles], series: Series, count: int, rng: np.random.Generator
    ) -> list[Particles]:
        """So many trajectories, as particles of equal weights in each slice."""
        layout = Layout(count, self.layout.apart, self.layout.lead)
        last = filtered[-1]
        index = _at_random(last, count, rng)
        self.positions = [index]
        found = [evenly_weighted(last.t, self._taken(last.values, index), layout)]
        for k in range(len(filtered) - 2, -1, -1):
            after = _After(found[: -1 - len(self.layers) : -1], filtered[k + 1 :])
            index = self._drawn(
                filtered[k], after, series, k, _parents(filtered[k + 1], index), rng
            )
            self.positions.append(index)
            values = self._taken(filtered[k].values, index)
            before: Mapping[str, np.ndarray] = values
            for m, layer in enumerate(self.layers[: len(found)]):
                now = found[-1 - m]
                before = self._computed(layer, before, now.values, series, k + m)
                found[-1 - m] = now._replace(values=dict(before))
            found.append(evenly_weighted(filtered[k].t, values, layout))
        self.positions.reverse()
        return found[::-1]

    def log_densities(
        self, here: Particles, after: _After, series: Series, k: int, draws: int
    ) -> np.ndarray:
        """Log density of slices ``after`` the k-th given every particle, shape (draws, particles, *apart).

        What was seen has no axis for draws or particles, so their numbers come from elsewhere.
        """
        before = {
            n: v[None] if v.ndim > self._trailing(n) else v for n, v in self._before(here).items()
        }
        now = after.each(lambda n, v: v[:, None] if v.ndim > self._trailing(n) else v)
        return self._log(before, now, series, k, (draws, len(here.log_weights)))

    # ---- private -------------------------------------------------------------------------------

    def _drawn(
        self,
        here: Particles,
        after: _After,
        series: Series,
        k: int,
        parents: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """For every trajectory a particle of the k-th slice, shape (draws, *apart).

        ``parents`` are the filter's ancestors of what was drawn after it. Where the slice after began anew,
        its density given the one before means nothing.
        """
        anew = after.anew[0]
        shape = (after.draws, *self.layout.lead)
        found = np.empty(shape, dtype=np.intp)
        if np.any(anew):
            found[...] = _at_random(here, len(found), rng)
        own = np.arange(len(found)).reshape((-1,) + (1,) * len(self.layout.lead))
        rows, wanted = _packed(
            np.broadcast_to(own, shape), np.broadcast_to(~np.asarray(anew), shape)
        )
        if self.rejection and len(rows):
            rows, wanted = self._by_rejection(here, after, series, k, rows, wanted, found, rng)
        block = max(1, _PAIRS // (self._tries * max(size_of(self.slices), 1)))
        for low in range(0, len(rows), block):
            mine, asked = rows[low : low + block], wanted[low : low + block]
            drawn = after.taken(self._taken, mine)
            if self._tries < self.layout.particles:
                own = np.take_along_axis(parents, mine, axis=0)
                index = self._among_few(here, drawn, series, k, own, rng)
            else:
                log = self.log_densities(here, drawn, series, k, len(mine)) + here.log_weights
                index = _picked(_explained(log, here.log_weights), rng)
            _put(found, mine, index, asked)
        self.exact += int(np.count_nonzero(wanted))
        return found

    @property
    def _tries(self) -> int:
        """Particles that are tried for a draw that no bound has accepted."""
        return min(self.layout.particles, _CANDIDATES) if self.few else self.layout.particles

    def _among_few(
        self,
        here: Particles,
        after: _After,
        series: Series,
        k: int,
        own: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Particles drawn from candidates by weight and the ancestor that each trajectory has."""
        tried = systematic(here.weights, self._tries, rng)
        values, even = self._taken(here.values, tried), np.zeros(tried.shape)
        few = here._replace(values=values, log_weights=even)
        log = self.log_densities(few, after, series, k, len(own))
        before = self._taken(self._before(here), own)
        last = self._log(before, after, series, k, (len(own),))[:, None]
        log = np.concatenate([log, last], axis=1)
        at = _picked(_explained(log, np.zeros(log.shape[1:])), rng)
        drawn = np.take_along_axis(tried, np.minimum(at, len(tried) - 1), axis=0)
        return np.where(at == len(tried), own, drawn)

    def _by_rejection(
        self,
        here: Particles,
        after: _After,
        series: Series,
        k: int,
        rows: np.ndarray,
        wanted: np.ndarray,
        found: np.ndarray,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Fill ``found`` where a draw was accepted; gives what is still open, as it was given."""
        bound = self._bound(here, series, k)
        if not np.isfinite(bound).all():
            return rows, wanted
        supply, before = _Supply(here.weights, len(rows), rng), self._before(here)
        for _ in range(_ROUNDS):
            tried = supply.take(len(rows))
            old, new = self._taken(before, tried), after.taken(self._taken, rows)
            log = self._log(old, new, series, k, (len(rows),))
            good = wanted & (-rng.standard_exponential(rows.shape) < log - bound)
            _put(found, rows, tried, good)
            accepted = int(np.count_nonzero(good))
            self.accepted += accepted
            rows, wanted = _packed(rows, wanted & ~good)
            if not len(rows) or accepted * self._tries < good.size:
                break  # what a round costs is no longer saved
        return rows, wanted

    def _bound(self, here: Particles, series: Series, k: int) -> np.ndarray:
        """The largest log density of the slice after the k-th given any particle, shape (*apart,).

        Infinite where none is known.
        """
        row, model, apart = series.row(k + 1), self.slices.later, self.layout.apart
        known = {**self.plan.known(row)}
        known |= {n + PREVIOUS: v for n, v in self._before(here).items()}
        total = np.zeros(self.layout.lead)
        for name in self.slices.dynamic:
            node = model[name]
            if name not in self.crossing or node.domain is not None:
                continue  # a probability is at most one
            dist, _ = model.evaluate(name, known)
            if type(dist) not in LOCATION:  # its function may return one family now, another then
                return np.full(self.layout.lead, np.inf)
            top = summed(np.asarray(dist.log_prob(dist.loc)), node, apart)
            total = total + (top.max(axis=0) if top.ndim > len(apart) else top)
        return total

    def _log(
        self,
        before: Mapping[str, np.ndarray],
        after: _After,
        series: Series,
        k: int,
        batch: tuple[int, ...],
    ) -> np.ndarray:
        """Log density of the slices after the k-th: factors that the k-th enters."""
        total: Any = 0.0
        anew: Any = False
        for m, (layer, now) in enumerate(zip(self.layers, after.values, strict=False)):
            anew = anew | np.asarray(after.anew[m])
            if np.all(anew):
                break
            state = self._passed(layer.steps, before, now, series, k + m, batch)
            log = np.asarray(state.log_weight, dtype=float)
            total = total + (np.where(anew, 0.0, log) if m and np.any(anew) else log)
            before = {n: state.values[n] if n in layer.carried else now[n] for n in now}
        return np.broadcast_to(total, (*batch, *self.layout.lead))

    def _computed(
        self,
        layer: Layer,
        before: Mapping[str, np.ndarray],
        now: Mapping[str, np.ndarray],
        series: Series,
        k: int,
    ) -> Mapping[str, np.ndarray]:
        """Values of the slice after the k-th, with what is computed from the slice before as now drawn."""
        if not layer.computed:
            return now
        state = self._passed(layer.computed, before, now, series, k, ())
        return {name: state.values[name] for name in now}

    def _passed(
        self,
        steps: Sequence[Step],
        before: Mapping[str, np.ndarray],
        now: Mapping[str, np.ndarray],
        series: Series,
        k: int,
        batch: tuple[int, ...],
    ) -> Pass:
        known = {**self.plan.known(series.row(k + 1)), **now}  # fillers stand for what is missing
        known |= {n + PREVIOUS: before[n] for n in self.slices.interface}
        state = Pass(np.random.default_rng(0), batch, known)
        for step in steps:
            step(state)
        return state

    def _before(self, here: Particles) -> dict[str, np.ndarray]:
        return {n: here.values[n] for n in self.slices.interface}

    def _taken(self, values: Mapping[str, np.ndarray], index: np.ndarray) -> dict[str, np.ndarray]:
        return _taken(values, index, self.slices, self.layout.apart)

    def _trailing(self, name: str) -> int:
        return len(self.slices.later[name].value_shape)


def lagged(filtered: Sequence[Particles], layout: Layout, slices: Slices) -> Particles:
    """What the last of some slices in a row says of the first: ancestors of its particles, with its weights.

    A particle that was drawn anew has no ancestors. Where that happened, the last slice before it speaks.
    Those that share ancestors are worth no more than these.
    """
    shape = (layout.particles, *layout.lead)
    own = np.arange(shape[0]).reshape((-1,) + (1,) * len(layout.lead))
    index: np.ndarray | None = None
    spoken = filtered[-1]
    for before, here in reversed(list(pairwise(filtered))):
        anew = np.asarray(here.rejuvenated)
        if not anew.all() and here.ancestors is not None:
            ancestors = np.where(anew, own, here.ancestors)
            index = ancestors if index is None else np.take_along_axis(ancestors, index, axis=0)
        if anew.any():
            spoken = _either(anew, before, spoken)
            index = None if index is None else np.where(anew, own, index)
    values, ess = filtered[0].values, spoken.ess
    if index is not None:
        values = _taken(values, index, slices, layout.apart)
        ess = ancestors_worth(index, spoken)
    return spoken._replace(t=filtered[0].t, values=values, ess=ess)


# ---- private ------------------------------------------------------------------------------------


class _Supply:
    """Independent positions by weight, shape (count, *apart), made many at a time."""

    def __init__(self, weights: np.ndarray, size: int, rng: np.random.Generator) -> None:
        self.weights, self.size, self.rng = weights, size, rng
        self._left = np.empty((0, *weights.shape[1:]), dtype=np.intp)

    def take(self, count: int) -> np.ndarray:
        if count > len(self._left):
            sorted_ = multinomial(self.weights, max(self.size, count), self.rng)
            self._left = self.rng.permuted(sorted_, axis=0)
        found, self._left = self._left[:count], self._left[count:]
        return found


def _at_random(here: Particles, count: int, rng: np.random.Generator) -> np.ndarray:
    """Positions by weight, in no order, shape (count, *apart)."""
    return rng.permuted(systematic(here.weights, count, rng), axis=0)


def _parents(here: Particles, index: np.ndarray) -> np.ndarray:
    """Ancestors of particles in the slice before; where these began anew they mean nothing."""
    return index if here.ancestors is None else np.take_along_axis(here.ancestors, index, axis=0)


def _explained(log: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Log weights; where no particle explains what came after, there is only the filter's word."""
    explained = np.any(log > -np.inf, axis=1, keepdims=True)
    return log if explained.all() else np.where(explained, log, otherwise)


def _taken(
    values: Mapping[str, np.ndarray], index: np.ndarray, slices: Slices, apart: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Values at chosen positions, shape (rows, *apart); what all particles agree on stays as it is."""
    found = {}
    for name, value in values.items():
        node = slices.later[name]
        if value.ndim == len(node.value_shape):
            found[name] = value
        elif not apart:
            found[name] = value.take(index, axis=0)
        else:
            found[name] = along_plates(value, index, node.plates, apart)
    return found


def _packed(rows: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of which something is wanted: to the front in every element, cut where nobody wants more."""
    most = int(wanted.sum(axis=0).max())
    order = np.argsort(~wanted, axis=0, kind="stable")[:most]
    return np.take_along_axis(rows, order, axis=0), np.take_along_axis(wanted, order, axis=0)


def _put(found: np.ndarray, rows: np.ndarray, values: np.ndarray, where: np.ndarray) -> None:
    """``found[rows] = values`` in every element, where asked for."""
    old = np.take_along_axis(found, rows, axis=0)
    np.put_along_axis(found, rows, np.where(where, values, old), axis=0)


def _either(anew: np.ndarray, before: Particles, after: Particles) -> Particles:
    """Particles with the weights of the one ``before`` in some elements of the plates apart."""
    if not anew.ndim:
        return before
    return after._replace(
        log_weights=np.where(anew, before.log_weights, after.log_weights),
        weights=np.where(anew, before.weights, after.weights),
        total=np.where(anew, before.total, after.total),
        log_total=np.where(anew, before.log_total, after.log_total),
        ess=np.where(anew, before.ess, after.ess),
    )


class _After:
    """Slices drawn after some slice, the next first: values, and where the filter began anew in them."""

    def __init__(self, drawn: Sequence[Particles], filtered: Sequence[Particles]) -> None:
        self.values: list[Mapping[str, np.ndarray]] = [here.values for here in drawn]
        self.anew = [here.rejuvenated for here in filtered[: len(drawn)]]
        self.draws = len(drawn[0].weights)

    def each(self, change: Callable[[str, np.ndarray], np.ndarray]) -> _After:
        """With other values."""
        return self._with([{n: change(n, v) for n, v in now.items()} for now in self.values])

    def taken(self, take: Callable[..., dict[str, np.ndarray]], rows: np.ndarray) -> _After:
        """Of some trajectories only."""
        return self._with([take(now, rows) for now in self.values])

    def _with(self, values: list[dict[str, np.ndarray]]) -> _After:
        other = copy(self)
        other.values = list(values)
        return other


def _picked(log: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One index along axis 1 for every row, in proportion to the exponentials, shape (rows, *rest)."""
    log = log - log.max(axis=1, keepdims=True)
    edges = np.cumsum(np.exp(log), axis=1)
    top = edges[:, -1:]
    point = rng.random(top.shape) * top
    return np.minimum((edges <= point).sum(axis=1), log.shape[1] - 1)
