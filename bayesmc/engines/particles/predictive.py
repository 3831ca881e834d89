"""Rows that a particle filter expects, drawn from a few of its particles and held against those that come.

In some slices (all of a short series) a few particles of the slice before are moved on without looking at the
row, and draw rows of their own. Other particles then say how likely the row that came is, and each of those
drawn. Where the model is right and the particles are draws from the belief, the row is one of the lot,
whatever the family, so its rank is uniform. Nothing here touches the particles or the numbers that they are
drawn with.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayesmc.categorical import pick
from bayesmc.dbn import PREVIOUS, Row, SeriesProblem
from bayesmc.engines.particles.smc import Particles, along_plates
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import UnsupportedError
from bayesmc.network import Observed
from bayesmc.network.forward import Pass
from bayesmc.network.forward import run as passed
from bayesmc.results.predictive import UNLIKELY, Predictive

#: draws from a belief without particles: so many values of each node that the next slice reads, first axis
Draws = Callable[[np.random.Generator, int], Mapping[str, np.ndarray]]

#: rows drawn in a slice, and particles that say how likely they are
ROWS, JUDGES = 19, 20
#: slices that are looked at: so many of a series, and every so manieth of a long one; a look costs as much as
#: moving a thousand particles
LOOKS, EVERY = 8, 12
#: slices that are looked at after a row that is unlikely, and the share of rows filtered separately that
#: must be
MORE, SHARE = 4, 0.2
#: the same where rows are wide, such as scans, which are dear to draw; and from how many numbers on they are
WIDE_LOOKS, WIDE_EVERY, WIDE = 16, 32, 16
#: the judges of the row that came, and of each one drawn
_JUDGES = np.tile(np.arange(ROWS, ROWS + JUDGES), ROWS + 1)
#: and rows below which none is: too few for any conclusion
_FEW = 5


class Replicates:
    """What is compared, written as the slices pass.

    Parameters
    ----------
    problem : SeriesProblem
    plan : SlicePlan
        Its proposals, if any, are not used.
    rng : Generator
        Of its own.
    most : int, optional
        Slices that are looked at, but for those after a row that is unlikely.
    """

    def __init__(
        self,
        problem: SeriesProblem,
        plan: SlicePlan,
        rng: np.random.Generator,
        most: int | None = None,
    ) -> None:
        self.slices, self.rng, self.steps = problem.slices, rng, problem.steps
        self.plan = SlicePlan(problem.slices, plan.apart, plan.static)
        self.plan.is_read = plan.is_read
        self.lead = tuple(problem.slices.first.sizes[p] for p in plan.apart)
        self.names = tuple(problem.series.observed)
        self._wide = _numbers_seen(problem) >= WIDE
        self._looked, self._until = _chosen(problem, self._wide, rng, most), -1
        # what is without noise has no density to be judged by, and what has no sampler makes no row
        nodes = [problem.slices.model(t)[n] for n in self.names for t in (0, 1)]
        self._cannot = any(node.noiseless or node.unsampled for node in nodes)
        self._broken = ""
        self._exponents: dict[str, float] = {}
        lead = (problem.steps, *self.lead)
        self._rows, self._deficits = np.full(lead, np.nan), np.full(lead, np.nan)
        shapes = {n: problem.slices.first[n].value_shape for n in self.names}
        self._ranks = {n: np.full((problem.steps, *shapes[n]), np.nan) for n in self.names}
        self._sizes = {n: math.prod(shapes[n]) for n in self.names}

    def wanted(self, k: int) -> bool:
        """Whether the k-th row is looked at."""
        return (k in self._looked or k <= self._until) and not (self._cannot or self._broken)

    def look(self, k: int, before: Particles | Draws | None, row: Row) -> None:
        """Compare the k-th row, whose slice follows that of particles, or of a belief that draws."""
        if not self.wanted(k) or not row.seen:
            return
        try:
            values = self._taken(before)
            drawn = self._drawn(row, {n: v[0] for n, v in values.items()})
            log = self._judged(row, drawn, {n: v[1] for n, v in values.items()})
        except UnsupportedError:  # a density that cannot be drawn from
            self._cannot = True
            return
        except (
            Exception
        ) as error:  # users' functions may break on rows that never came: that is said
            self._broken = f"slice {row.t}: {type(error).__name__}: {error}"
            return
        self._write(k, row, drawn, log)

    def found(self, steps: int | None = None) -> Predictive | None:
        """What came of it; None where nothing was compared."""
        if self._cannot or not self._looked:
            return None
        whole = Predictive(self._rows, self._deficits, self._ranks, self._broken)
        return whole if steps is None else whole.first(steps)

    def rows(self, first: int, end: int) -> dict[str, Any]:
        """What came of some slices, to be saved."""
        part = slice(first, end)
        ranks = {n: a[part] for n, a in self._ranks.items()}
        return {"rows": self._rows[part], "deficits": self._deficits[part], "ranks": ranks}

    def put(self, first: int, rows: Mapping[str, Any]) -> None:
        """Take in what was saved of the slices from one on."""
        part = slice(first, first + len(rows["rows"]))
        self._rows[part], self._deficits[part] = rows["rows"], rows["deficits"]
        for name, ranks in rows["ranks"].items():
            self._ranks[name][part] = ranks

    @property
    def state(self) -> tuple[Any, ...]:
        """All else that changes as slices pass."""
        return self.rng.bit_generator.state, self._until, self._cannot, self._broken

    def go_on(self, state: tuple[Any, ...]) -> None:
        """Be where another one was."""
        self.rng.bit_generator.state, self._until, self._cannot, self._broken = state

    # ---- private -------------------------------------------------------------------------------

    def _taken(self, before: Particles | Draws | None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Values of the slice before, of the particles that draw rows and of those that judge them."""
        if before is None:
            return {}
        held = before if isinstance(before, Particles) else None
        drawn = before.values if isinstance(before, Particles) else before(self.rng, ROWS + JUDGES)
        lots = (ROWS + JUDGES, *self.lead)
        chosen = None if held is None else pick(held.weights, self.rng.random(lots))
        found = {}
        for name in self.slices.interface:
            value = drawn[name]
            node = self.slices.later[name]
            if value.ndim == len(node.value_shape):
                found[name + PREVIOUS] = value, value
                continue
            if chosen is None:
                taken = value
            elif self.lead:
                taken = along_plates(value, chosen, node.plates, self.plan.apart)
            else:
                taken = value[chosen]
            found[name + PREVIOUS] = taken[:ROWS], taken.take(_JUDGES, axis=0)
        return found

    def _drawn(self, row: Row, before: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Rows drawn without looking at the one that came, shape (rows, *plates, *event) by node."""
        unseen = Row(row.t, {}, row.inputs)
        state = Pass(self.rng, (ROWS,), {**self.plan.known(unseen), **before})
        values = passed(self.plan.steps(unseen), state).values
        shapes = {n: (ROWS, *self.slices.first[n].value_shape) for n in row.seen}
        return {n: _shaped(values[n], shape) for n, shape in shapes.items()}

    def _judged(
        self, row: Row, drawn: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray]
    ) -> np.ndarray:
        """Log densities of the row that came, first, and of those drawn, shape (1 + rows, *lead)."""
        seen = {}
        for name, own in row.seen.items():
            one = _shaped(np.asarray(own.value), drawn[name].shape[1:])
            each = np.concatenate([one[None], drawn[name]])
            seen[name] = Observed(each.repeat(JUDGES, axis=0), own.mask)
        judged = Row(row.t, seen, row.inputs)
        count = (1 + ROWS) * JUDGES
        state = Pass(self.rng, (count,), {**self.plan.known(judged), **before})
        log = passed(self.plan.steps(judged), state).log_weight
        log = _shaped(np.asarray(log, dtype=float), (count, *self.lead))
        log = log.reshape(1 + ROWS, JUDGES, *self.lead)
        level = np.maximum(np.maximum.reduce(log, axis=1, keepdims=True), _LEAST)
        return np.log(np.add.reduce(np.exp(log - level), axis=1) / JUDGES) + level[:, 0]

    def _write(self, k: int, row: Row, drawn: Mapping[str, np.ndarray], log: np.ndarray) -> None:
        self._rows[k] = ranks = self._rank(log[0], log[1:])
        if not self._wide and np.count_nonzero(ranks < UNLIKELY) > SHARE * np.size(ranks):
            self._until = k + MORE
        log = np.maximum(log, _LEAST)
        off = np.add.reduce(log[1:]) / ROWS - log[0]
        self._deficits[k] = off / np.maximum(self._numbers(row), _TINY)
        for name, own in row.seen.items():
            node = self.slices.first[name]
            ranks = self._rank(own.value, drawn[name])
            if own.mask is not None:
                mask = own.mask.reshape(own.mask.shape + (1,) * len(node.event_shape))
                ranks = np.where(mask, ranks, np.nan)
            self._ranks[name][k] = ranks

    def _rank(self, value: Any, others: np.ndarray) -> Any:
        """Where values lie among others, along the first axis; ties are broken by chance."""
        if others.ndim == 1:  # without an axis it is several times faster
            low, same = np.count_nonzero(others < value), np.count_nonzero(others == value)
            return (low + self.rng.random() * (same + 1)) / (ROWS + 1)
        less = (others < value).sum(axis=0)
        equal = (others == value).sum(axis=0)
        return (less + self.rng.random(less.shape) * (equal + 1)) / (ROWS + 1)

    def _numbers(self, row: Row) -> Any:
        """How many numbers a row has, shape (*lead); those of tempered densities count for less."""
        if not self.lead and all(own.mask is None for own in row.seen.values()):
            return sum(self._worth(row, n) * self._sizes[n] for n in row.seen)
        total = np.zeros(self.lead)
        for name, own in row.seen.items():
            node = self.slices.first[name]
            mask = np.ones(node.plate_shape) if own.mask is None else own.mask
            each = mask * float(np.prod(node.event_shape, dtype=float)) * self._worth(row, name)
            apart = [node.plates.index(p) for p in self.plan.apart]
            rest = tuple(i for i in range(len(node.plates)) if i not in apart)
            left = [p for p in node.plates if p in self.plan.apart]
            total = total + each.sum(axis=rest).transpose([left.index(p) for p in self.plan.apart])
        return total

    def _worth(self, row: Row, name: str) -> float:
        """The exponent of a density that has one, such as a scan's: numbers that count for less than one."""
        if name not in self._exponents:
            model = self.slices.model(row.t)
            found = model.evaluate(name, model.probe)[0]
            self._exponents[name] = float(getattr(found, "tempering", 1.0))
        return self._exponents[name]


# ---- private ------------------------------------------------------------------------------------

#: log densities below this one are this one: of rows that no particle explains
_LEAST = -1e12
#: numbers of an element without any, to divide by
_TINY = 1e-9


def _shaped(value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A value of a shape; views that are none cost more than they are worth."""
    return value if value.shape == shape else np.broadcast_to(value, shape)


def _numbers_seen(problem: SeriesProblem) -> int:
    """Of an element of the plates, in a slice."""
    model = problem.slices.first
    return sum(math.prod(model[n].event_shape) for n in problem.series.observed)


def _chosen(
    problem: SeriesProblem, wide: bool, rng: np.random.Generator, most: int | None
) -> frozenset[int]:
    """The slices that are looked at: one of each stretch, at random, among those with something seen."""
    some = np.zeros(problem.steps, dtype=bool)
    for seen in problem.series.observed.values():
        some |= True if seen.mask is None else seen.mask.reshape(problem.steps, -1).any(axis=1)
    rows = np.flatnonzero(some)
    if len(rows) < _FEW:
        return frozenset()
    least, every = (WIDE_LOOKS, WIDE_EVERY) if wide else (LOOKS, EVERY)
    if len(rows) <= least:
        return frozenset(rows.tolist())
    edges = np.linspace(0, len(rows), min(max(least, len(rows) // every), most or len(rows)) + 1)
    at = edges[:-1] + rng.random(len(edges) - 1) * np.diff(edges)
    return frozenset(rows[np.minimum(at.astype(np.intp), len(rows) - 1)].tolist())
