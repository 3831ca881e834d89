"""Moving a cloud of particles to the next slice: choose who has offspring, pass the slice, weight.

The slice itself is a forward pass (``slice_steps``), taken in blocks of particles whose temporaries stay in
cache.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.particles.cloud import BLOCK, Cloud, Layout, Selection, along_plates
from bayesmc.engines.particles.counts import KLD
from bayesmc.engines.particles.drift import Compass
from bayesmc.engines.particles.families import Families, begun, drifted, followed, scouted
from bayesmc.engines.particles.forgetting import Sight
from bayesmc.engines.particles.recovery import Recovery
from bayesmc.engines.particles.scouts import Scouting
from bayesmc.engines.slice_steps import SlicePlan, size_of
from bayesmc.errors import DegeneracyError
from bayesmc.network.forward import Pass, Step, WeighDrawn
from bayesmc.resampling import ssp, stratified, systematic
from bayesmc.shapes import first_index

#: log factors by which particles of the slice before are chosen, from its values and the row
FirstStage = Callable[[Mapping[str, np.ndarray], Row, np.random.Generator], np.ndarray]

#: numbers up to which all particles are one block: a little too large is better than two
WHOLE = 12288


class Anew(Protocol):
    """What lets a share of the particles begin anew."""

    @property
    def options(self) -> Recovery: ...

    def mixed(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        earlier: Cloud,
        selection: Selection,
        passed: tuple[dict[str, np.ndarray], Any],
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any, Selection, int]:
        """Values, log weights, what they start with, and how many particles have begun anew."""
        ...


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
    plan : SlicePlan
    first_stage : callable, optional
        ``(before, row, rng) -> log factors``, by which particles are chosen for their future.
    rejuvenate : callable, optional
        ``row -> steps`` of a slice that does not look at the slice before, for where all weights vanish.
    kept : sequence of str, optional
        Nodes whose values clouds hold besides those that the next slice reads; all by default.
    counts : KLD, optional
        How many particles a slice needs, ``particles`` at most.
    recovery : Anew, optional
        Lets a share of the particles begin anew.
    """

    def __init__(
        self,
        slices: Slices,
        particles: int,
        resample: Callable[..., np.ndarray],
        threshold: float,
        plan: SlicePlan,
        first_stage: FirstStage | None = None,
        rejuvenate: Callable[[Row], Sequence[Step]] | None = None,
        kept: Sequence[str] | None = None,
        counts: KLD | None = None,
        recovery: Anew | None = None,
    ) -> None:
        self.counts, self.recovery = counts, recovery
        self.slices, self.particles = slices, particles
        self.resample, self.threshold = resample, threshold
        self.plan, self.apart = plan, plan.apart
        self.first_stage, self.rejuvenate = first_stage, rejuvenate
        wanted = slices.dynamic if kept is None else (*slices.interface, *kept)
        self.kept = tuple(dict.fromkeys(wanted))
        numbers = max(size_of(slices), 1)
        self.block = particles if particles * numbers <= WHOLE else max(1, BLOCK // numbers)
        self.lead = tuple(slices.first.sizes[p] for p in self.apart)
        self._before = tuple((n, n + PREVIOUS) for n in slices.interface)
        self._ranks = {n + PREVIOUS: len(slices.first[n].value_shape) for n in slices.dynamic}
        self._ranks |= {n: len(slices.first[n].value_shape) for n in slices.dynamic}
        self.layout = Layout(particles, self.apart, self.lead, self.block)
        self.sight = Sight([slices.later[n] for n in slices.interface], self.layout)
        self.scouting = Scouting(slices, plan)
        blind = plan.guided or first_stage is not None or recovery is not None
        compass = Compass(self.sight.nodes, self.layout)
        self.compass = compass if compass.nodes and not blind else None
        self._log_particles = math.log(particles)
        self._even = np.ones((particles, *self.lead))
        self._even.flags.writeable = False
        self._spare = _Spare()
        # after a first stage, what a family should have is not what its weight says
        self.steady = resample in (stratified, systematic, ssp) or first_stage is not None

    def moved(
        self,
        cloud: Cloud | None,
        families: Families | None,
        row: Row,
        rng: np.random.Generator,
    ) -> tuple[Cloud, Families]:
        """The cloud of the next slice, or of the first, and whose descendants its particles are."""
        if cloud is None or families is None:
            found = self.first(row, rng)
            now = begun(found, self.sight)
        else:
            found = self.next(cloud, row, rng)
            now = followed(families, cloud, found, self.steady, self.sight)
        if self.compass is not None:
            now = drifted(now, self.compass, cloud, found, self.sight)
        if self.scouting.nodes:
            scouts = self.scouting.after(now.scouts, cloud, found, row)
            now = scouted(now, scouts, found, self.sight)
        return found, now

    def first(self, row: Row, rng: np.random.Generator) -> Cloud:
        """The cloud of slice 0."""
        n, never = self.particles, np.zeros(self.lead, dtype=bool)
        return self._moved(row, {}, Selection(n, None, never, 0.0, self._log_particles), None, rng)

    def recycle(self, cloud: Cloud) -> None:
        """Take back the large arrays of a cloud that nobody will look at again."""
        if self.particles > self.block and self.counts is None:
            self._spare.put(cloud.weights, cloud.log_weights, *cloud.values.values())

    def next(self, cloud: Cloud, row: Row, rng: np.random.Generator) -> Cloud:
        """The cloud of the next slice: resample if need be, move, weight."""
        values = cloud.values
        before = {previous: values[n] for n, previous in self._before}
        selection = self._selected(cloud, before, row, rng)
        return self._moved(row, before, selection, cloud, rng)

    def _moved(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        earlier: Cloud | None,
        rng: np.random.Generator,
    ) -> Cloud:
        values, log = self._passed(self.plan.steps(row), row, before, selection, rng)
        if self.recovery is not None:
            return self._recovered(row, before, selection, earlier, (values, log), rng)
        cloud = self._weighted(row, values, log, selection)
        if _has_weight(cloud):
            return cloud
        if self.rejuvenate is not None:
            cloud = self._renewed(self.rejuvenate(row), row, before, cloud, selection, rng)
            if _has_weight(cloud):
                return cloud
        raise self._degenerate(row, before, cloud.values, selection)

    def _recovered(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        earlier: Cloud | None,
        passed: tuple[dict[str, np.ndarray], Any],
        rng: np.random.Generator,
    ) -> Cloud:
        """The cloud where a share of the particles has begun anew."""
        assert self.recovery is not None
        averages, count, (values, log) = None, 0, passed
        if earlier is not None:
            averages = earlier.averages
            mixed = self.recovery.mixed(row, before, earlier, selection, passed, rng)
            values, log, selection, count = mixed
        cloud = self._weighted(row, values, log, selection)
        if not _has_weight(cloud):
            raise self._degenerate(row, before, cloud.values, selection)
        if row.seen:
            averages = self.recovery.options.averaged(averages, row, cloud.increment)
        return cloud._replace(averages=averages, anew=count)

    def _renewed(
        self,
        steps: Sequence[Step],
        row: Row,
        before: Mapping[str, np.ndarray],
        cloud: Cloud,
        selection: Selection,
        rng: np.random.Generator,
    ) -> Cloud:
        """A cloud begun anew where it has no weight left; plate elements that have some stay as they are."""
        dead = ~np.asarray(cloud.total > 0)
        values, log = self._passed(steps, row, before, selection, rng)
        everyone = math.log(selection.particles)
        fresh = Selection(selection.particles, selection.ancestors, True, 0.0, everyone)
        new = self._weighted(row, values, log, fresh)
        if not self.lead:
            return new._replace(rejuvenated=True)
        mixed = {k: self._either(k, dead, v, cloud.values[k]) for k, v in new.values.items()}
        either = Selection(
            selection.particles,
            selection.ancestors,
            dead | selection.resampled,
            0.0,
            np.where(dead, everyone, selection.spent),
        )
        log = np.where(dead, new.log_weights, cloud.log_weights)
        return self._weighted(row, mixed, log, either)._replace(rejuvenated=dead)

    def _either(self, name: str, dead: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
        """A node's values: new ones in some elements of the plates apart, old ones in the others."""
        plates = self.slices.later[name].plates
        if any(p not in plates for p in self.apart):
            return new  # it hangs on nothing that was drawn
        at = [self.apart.index(p) for p in plates if p in self.apart]
        shape = [self.slices.first.sizes[p] if p in self.apart else 1 for p in plates]
        rank = self._ranks[name] - len(plates)
        return np.where(dead.transpose(at).reshape(*shape, *(1,) * rank), new, old)

    def _selected(
        self,
        cloud: Cloud,
        before: Mapping[str, np.ndarray],
        row: Row,
        rng: np.random.Generator,
    ) -> Selection:
        """Resample where weights are uneven; with a first stage, by what the next row makes of them."""
        n, total = len(cloud.weights), cloud.log_total
        weights, ess, factor, gained = cloud.weights, cloud.ess, None, 0.0
        if self.first_stage is not None and row.seen:
            factor = self.first_stage(before, row, rng)
            log = cloud.log_weights + factor
            level = _top(log)
            weights = np.exp(log - level)
            chosen_from = weights.sum(axis=0)
            ess = chosen_from**2 / _squares(weights)
            gained = level + np.log(chosen_from) - total
        poor = ess < self.threshold * n
        if self.counts is not None:
            return self._counted(self.counts, cloud, bool(poor), rng)
        some, every = (poor, poor) if not self.apart else (poor.any(), poor.all())
        if not some:
            return Selection(n, None, poor, cloud.log_weights, total)
        chosen = self.resample(weights, n, rng)
        carried: Any = 0.0
        if factor is not None:
            carried = -(factor[chosen] if not self.apart else np.take_along_axis(factor, chosen, 0))
        if every:
            return Selection(n, chosen, poor, carried, self._log_particles - gained)
        own = np.arange(n).reshape((-1,) + (1,) * len(self.apart))
        return Selection(
            n,
            np.where(poor, chosen, own),
            poor,
            np.where(poor, carried, cloud.log_weights),
            np.where(poor, self._log_particles - gained, total),
        )

    def _counted(
        self, counts: KLD, cloud: Cloud, poor: bool, rng: np.random.Generator
    ) -> Selection:
        """As many particles as the belief needs; they are left alone where that is what there are."""
        n = len(cloud.weights)
        chosen = self.resample(cloud.weights, self.particles, rng)
        taken = {k: self._taken(k, cloud.values[k], chosen) for k in counts.widths}
        needed = min(counts.needed(counts.bins(taken)), self.particles)
        if not poor and 0.8 * n <= needed <= n:
            return Selection(n, None, False, cloud.log_weights, cloud.log_total)
        if needed < self.particles:
            chosen = self.resample(cloud.weights, needed, rng)
        return Selection(needed, chosen, True, 0.0, math.log(needed))

    def _passed(
        self,
        steps: Sequence[Step],
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any]:
        """One forward pass over a slice, in blocks of particles: kept values and log weights."""
        n, ancestors, known = selection.particles, selection.ancestors, self.plan.known(row)
        if n <= self.block:
            for name, value in before.items():
                known[name] = self._taken(name, value, ancestors)
            state = Pass(rng, (n,), known)
            for step in steps:
                step(state)
            found = state.values
            return {k: found[k] for k in self.kept}, state.log_weight
        values: dict[str, np.ndarray] = {}
        log: Any = 0.0
        for low in range(0, n, self.block):
            high = min(low + self.block, n)
            part = None if ancestors is None else ancestors[low:high]
            taken = {
                k: self._taken(
                    k,
                    v if part is not None else self._cut(k, v, low, high),
                    part,
                )
                for k, v in before.items()
            }
            state = Pass(rng, (high - low,), {**known, **taken})
            for step in steps:
                step(state)
            self._store(values, state.values, low, high, n)
            weight = np.asarray(state.log_weight)
            if weight.ndim <= len(self.lead):
                log = weight  # nothing was seen, or nothing that depends on the particles
                continue
            if low == 0:
                log = self._spare.get((n, *self.lead), np.dtype(float))
            log[low:high] = weight
        return values, log

    def _store(
        self,
        values: dict[str, np.ndarray],
        found: Mapping[str, np.ndarray],
        low: int,
        high: int,
        n: int,
    ) -> None:
        for name in self.kept:
            value = found[name]
            if value.ndim == self._ranks[name]:
                values[name] = value  # the same for all particles
                continue
            if low == 0:
                values[name] = self._spare.get((n, *value.shape[1:]), value.dtype)
            values[name][low:high] = value

    def _cut(self, name: str, value: np.ndarray, low: int, high: int) -> np.ndarray:
        """A block of a node's values, read-only."""
        if value.ndim == self._ranks[name]:
            return value
        part = value[low:high]
        part.flags.writeable = False
        return part

    def _taken(self, name: str, value: np.ndarray, ancestors: np.ndarray | None) -> np.ndarray:
        """A node's values of the slice before, of the ancestors of a block."""
        if ancestors is None or value.ndim == self._ranks[name]:
            return value
        if not self.apart:
            found = value.take(ancestors, axis=0, mode="clip")  # they lie within
        else:
            found = along_plates(value, ancestors, self.slices.later[name].plates, self.apart)
        found.flags.writeable = False
        return found

    def _weighted(
        self, row: Row, values: dict[str, np.ndarray], log: Any, selection: Selection
    ) -> Cloud:
        """The cloud of a slice; its ``total`` is not positive where no weight is left."""
        n, shape = selection.particles, (selection.particles, *self.lead)
        carried = selection.carried
        log = carried + log if isinstance(carried, np.ndarray) else np.asarray(log)
        if log.ndim <= len(self.lead) and np.all(log == 0.0):
            even = np.full(self.lead, float(n)) if self.lead else float(n)
            return Cloud(
                row.t, values, np.broadcast_to(0.0, shape), self._even[:n], even, np.log(even),
                np.log(even) - selection.spent, even, selection.ancestors, selection.resampled,
            )  # fmt: skip
        if log.shape != shape:
            log = np.broadcast_to(log, shape)
        level = _top(log)
        weights, total, squares = self._exponentials(log, level)
        log_total = level + (
            np.log(total) if self.lead else math.log(total) if total > 0 else -math.inf
        )
        return Cloud(
            row.t, values, log, weights, total, log_total, log_total - selection.spent,
            _ratio(total * total, squares), selection.ancestors, selection.resampled,
        )  # fmt: skip

    def _exponentials(self, log: np.ndarray, level: Any) -> tuple[np.ndarray, Any, Any]:
        """Weights relative to a level, block by block, their sums and the sums of their squares."""
        if len(log) <= self.block:
            weights = log - level
            np.exp(weights, out=weights)
            return weights, self._sum(weights), _squares(weights)
        weights = self._spare.get(log.shape, np.dtype(float))
        total: Any = 0.0
        squares: Any = 0.0
        for low in range(0, len(log), self.block):
            part = weights[low : low + self.block]
            np.subtract(log[low : low + self.block], level, out=part)
            np.exp(part, out=part)
            total = total + self._sum(part)
            squares = squares + _squares(part)
        return weights, total, squares

    def _sum(self, weights: np.ndarray) -> Any:
        if weights.ndim == 1:
            return float(weights.dot(self._even[: len(weights)]))
        return np.add.reduce(weights)

    def _degenerate(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        values: Mapping[str, np.ndarray],
        selection: Selection,
    ) -> DegeneracyError:
        """The error, with the first observed node at which no weight was left."""
        taken = {k: self._taken(k, v, selection.ancestors) for k, v in before.items()}
        known = {**self.plan.known(row), **taken, **values}
        state = Pass(np.random.default_rng(0), (selection.particles,), known)
        model, node, which = self.slices.model(row.t), None, ""
        for name in (n for n in self.slices.dynamic if n in row.seen):
            WeighDrawn(model, model[name], self.apart)(state)
            alive = np.asarray(np.any(np.asarray(state.log_weight) > -np.inf, axis=0))
            if not alive.all():
                node, at = name, first_index(~alive)
                which = f" (plate element {at if len(at) > 1 else at[0]})" if at else ""
                break
        what = f"the value of {node!r}{which}" if node else "what was seen"
        return DegeneracyError(
            f"none of {selection.particles} particles explains {what} in slice {row.t}: every weight is "
            "zero; use more particles, a proposal= that looks at the observations, less narrow noise, "
            'recovery=, or on_degeneracy="rejuvenate"',
            row.t,
            node,
        )


# ---- private ------------------------------------------------------------------------------------


class _Spare:
    """Large arrays that are used again: fresh ones cost the machine a page at a time."""

    def __init__(self) -> None:
        self._free: dict[tuple[Any, ...], list[np.ndarray]] = {}

    def get(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        free = self._free.get((shape, dtype))
        return free.pop() if free else np.empty(shape, dtype)

    def put(self, *arrays: np.ndarray) -> None:
        for array in arrays:
            if array.flags.owndata and array.flags.writeable:
                self._free.setdefault((array.shape, array.dtype), []).append(array)


def _has_weight(cloud: Cloud) -> bool:
    total = cloud.total
    return bool(total > 0 if isinstance(total, float) else (total > 0).all())


def _ratio(above: Any, below: Any) -> Any:
    return above / below if not isinstance(below, float) or below else math.nan


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
