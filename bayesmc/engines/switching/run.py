"""A series passed forward and back, and rows taken one by one: what leads from data to mixtures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, SeriesProblem, Slices
from bayesmc.engines.filtering import pass_slices
from bayesmc.engines.kalman.covariances import by_pattern
from bayesmc.engines.kalman.data import Pattern, SeriesData, given_values, pattern_of, stacked
from bayesmc.engines.kalman.levels import Rule
from bayesmc.engines.kalman.passes import Memory
from bayesmc.engines.kalman.reading import reads_time
from bayesmc.engines.kalman.slices import Layout, unknown_nodes
from bayesmc.engines.switching.merging import Mixture
from bayesmc.engines.switching.modes import Modes
from bayesmc.engines.switching.passes import (
    Back,
    Place,
    Smoothed,
    advanced,
    smoothed,
    turned_back,
    unsmoothed,
    whole,
)
from bayesmc.engines.switching.posterior import Beliefs, SwitchingSeries, answers, by_modes
from bayesmc.engines.switching.smoothing import last_rows, smoothed_back
from bayesmc.engines.switching.stretches import Stretch
from bayesmc.errors import DegeneracyError, UnsupportedError, ZeroProbabilityError
from bayesmc.lowering import gaussian_loops, is_available
from bayesmc.network import Observed

#: slices from which on machine code is loaded
_LONG = 300


class Options(NamedTuple):
    """Of the engine."""

    engine: Any
    merging: str
    rule: Rule | None
    most: int


class SwitchingRun:
    """A series, slice 0 and the later slices as stretches over the modes that it can come to.

    Raises
    ------
    UnsupportedError, ParameterError
    """

    def __init__(
        self, problem: SeriesProblem, modes: Modes, data: SeriesData, options: Options
    ) -> None:
        self.problem, self.modes, self.data, self.options = problem, modes, data, options
        series = problem.series
        self.observed = {n: o for n, o in series.observed.items() if n not in data.known}
        rule = options.rule
        first = Stretch(
            data.layouts[0], modes, data.values(0, 1), self._seen(0, 1), 1, None, rule=rule
        )
        self.now, self.stretches = first.pairs.now, [first]
        if data.steps > 1:
            later = data.values(1, data.steps), self._seen(1, data.steps), data.steps - 1
            while True:
                _check_count(len(self.now), options)
                start = self._reached(first)
                found = Stretch(data.layouts[1], modes, *later, self.now, rule=rule, reached=start)
                more = np.union1d(self.now, found.pairs.now)
                if len(more) == len(self.now):
                    break
                self.now = more
            self.stretches.append(
                Stretch(
                    data.layouts[1],
                    modes,
                    *later,
                    self.now,
                    self.now,
                    rule,
                    self._reached(first),
                )  # fmt: skip
            )
        _check_count(len(self.now), options)

    def forward(self, advance: Callable[[], None]) -> tuple[list[Mixture], np.ndarray]:
        """Mixtures over modes of every slice given the rows up to it, and log densities of the rows."""
        data, merging = self.data, self.options.merging
        loops = gaussian_loops() if self.is_compiled else None
        found: list[Mixture] = []
        increments = np.empty((data.steps, *data.layouts[0].lead))
        places = self.places

        def move(k: int) -> None:
            place = places[k]
            after, increments[k] = advanced(merging, found[-1] if found else None, place, loops)
            check_row(data.series.start + k, increments[k], place, found[-1] if found else None)
            found.append(after if k else self._over_all(after))

        def so_far(k: int) -> SwitchingSeries:
            return self.answers("filter", found[:k], increments[:k])

        pass_slices(data.series.start, data.steps, move, so_far, advance)
        return found, increments

    def smoothed(self, filtered: list[Mixture], lag: int | None) -> list[Mixture]:
        """The same given all rows, or those of so many slices later: Kim's smoother."""
        return smoothed_back(self.places, filtered, self.last_rows, lag)

    @cached_property
    def last_rows(self) -> np.ndarray:
        """The last slice with data so far, shape (time, *lead)."""
        return last_rows(self.data, self.modes, self.observed)

    def completed(self, filtered: list[Mixture]) -> list[Mixture]:
        """With all unknown numbers."""
        return [whole(place, found) for place, found in zip(self.places, filtered, strict=True)]

    def turned(self, filtered: list[Mixture]) -> list[Back | None]:
        """How every slice but the first leads back to the one before."""
        steps = range(1, self.data.steps)
        return [None, *(turned_back(filtered[k - 1], self.places[k]) for k in steps)]

    def noise(self, filtered: list[Mixture], backs: list[Back | None]) -> list[Smoothed]:
        """Moments of the filter's noise given all rows, slice by slice."""
        here = unsmoothed(filtered[-1], self.data.layouts[0].carried)
        found = [here]
        for k in range(self.data.steps - 1, 0, -1):
            back = backs[k]
            assert back is not None
            here = smoothed(back, self.places[k], filtered[k], here)
            found.append(here)
        return found[::-1]

    @cached_property
    def places(self) -> list[Place]:
        """Every slice with its row."""
        data = self.data
        patterns, which = data.patterns
        values = None if data.given is None else data.given[0]
        found: list[Any] = [None] * data.steps
        for _, (low, high) in data.spans():
            stretch, seen = self.stretches[min(low, 1)], data.seen(low, high)
            for group in by_pattern(which[low:high]):
                pattern = patterns[which[low + group[0]]]
                given = None if values is None else values[low:high][group]
                rows = _with_given(stretch.layout, pattern, seen[group], given)
                carried = _is_carried(stretch.layout, pattern)
                for m, (k, row) in enumerate(zip(group.tolist(), rows, strict=True)):
                    own = None if given is None else given[m]
                    found[low + k] = Place(stretch, k, pattern, row, own, carried)
        return found

    def whole(self, found: list[Mixture]) -> Mixture:
        """All unknown numbers of the first so many slices, time first."""
        which = self.data.patterns[1][: len(found)]
        places, steps, first = self.places, len(found), found[0]
        lead = first.log.shape
        n = self.data.layouts[0].n
        log, mean = np.empty((steps, *lead)), np.empty((steps, *lead, n))
        factor = np.empty((steps, *lead, n, n))
        for group in by_pattern(which):
            arrays = (np.stack(a) for a in zip(*(found[k] for k in group), strict=True))
            place = places[group[0]]
            if self.data.given is not None:
                place = place._replace(given=self.data.given[0][group])
            for array, part in zip(
                (log, mean, factor), whole(place, Mixture(*arrays)), strict=True
            ):
                array[group] = part
        return Mixture(log, mean, factor)

    def answers(
        self, kind: str, found: list[Mixture], increments: np.ndarray, queries: Any = None
    ) -> SwitchingSeries:
        """Of the first so many slices."""
        steps, data, series = len(found), self.data, self.problem.series
        model = self.problem.slices.first
        known = {n: series.observed[n].value[:steps] for n in data.known}
        known |= self.problem.known_static | data.computed(steps)
        known = {n: np.broadcast_to(v, (steps, *model[n].value_shape)) for n, v in known.items()}
        told: dict[str, tuple[Any, Any]] = {
            n: (one[:steps], None if two is None else two[:steps])
            for n, (one, two) in self.told.items()
        }
        weights, mean, factor = self.whole(found)
        beliefs = Beliefs(
            data.layouts[0], self.modes, self.now, np.exp(weights), mean, factor, known,
            values_by_mode(model, told),
        )  # fmt: skip
        seen = {
            n: Observed(o.value[:steps], None if o.mask is None else o.mask[:steps])
            for n, o in self.observed.items()
        }
        return answers(
            self.options.engine, beliefs, kind, increments, told, seen, series.start, queries
        )  # fmt: skip

    @property
    def is_compiled(self) -> bool:
        """Whether there is machine code for it, and enough to do."""
        plain = self.options.rule is None and not self.data.layouts[0].lead
        return plain and self.data.steps >= _LONG and is_available()

    @cached_property
    def told(self) -> dict[str, tuple[Any, Any]]:
        """See ``posterior.by_modes``."""
        return by_modes(self.stretches, self.now)

    # ---- private -------------------------------------------------------------------------------

    def _seen(self, low: int, high: int) -> dict[str, Observed]:
        wanted = {*self.modes.names, *self.modes.leaves}
        return {
            n: Observed(o.value[low:high], None if o.mask is None else o.mask[low:high])
            for n, o in self.observed.items()
            if n in wanted
        }

    def _reached(self, first: Stretch) -> np.ndarray:
        """Which modes slice 0 can have, shape (modes, *lead)."""
        pairs, log = first.pairs, first.log_of(0)
        found = np.zeros((len(self.now), *log.shape[1:]), dtype=bool)
        found[np.searchsorted(self.now, pairs.now[pairs.dst])] = log > -np.inf
        return found

    def _over_all(self, first: Mixture) -> Mixture:
        """Slice 0 over all modes that there are later; those that it cannot have weigh nothing."""
        here = np.searchsorted(self.now, self.stretches[0].pairs.now)
        if len(here) == len(self.now):
            return first
        whole = [np.zeros((len(self.now), *a.shape[1:])) for a in first]
        whole[0][...] = -np.inf
        for wide, own in zip(whole, first, strict=True):
            wide[here] = own
        return Mixture(*whole)


class SwitchingState(NamedTuple):
    """A slice as a belief goes on from it.

    Attributes
    ----------
    modes : Modes
    now : ndarray of int
    found : Mixture
    layout : Layout
    known : dict
        Values of what is known.
    told : dict
        See ``by_modes``.
    observed : dict
    memory : Memory or None
        None out of a pickle.
    """

    modes: Modes
    now: np.ndarray
    found: Mixture
    layout: Layout
    known: dict[str, np.ndarray]
    told: dict[str, tuple[Any, Any]]
    observed: dict[str, Observed]
    memory: Memory | None

    def posterior(self, t: int) -> SwitchingSeries:
        """Answers about this slice."""
        model = self.layout.slices.first
        known = {n: np.broadcast_to(v, model[n].value_shape)[None] for n, v in self.known.items()}
        weights, mean, factor = (a[None] for a in self.found)
        beliefs = Beliefs(
            self.layout, self.modes, self.now, np.exp(weights), mean, factor, known,
            values_by_mode(model, self.told),
        )  # fmt: skip
        return answers(None, beliefs, "filter", None, self.told, self.observed, t)


def row_taken(
    slices: Slices,
    modes: Modes,
    static: Mapping[str, np.ndarray],
    row: Row,
    before: SwitchingState | None,
    options: Options,
) -> tuple[SwitchingState, np.ndarray]:
    """The slice after ``before``, and the log density of its row.

    What rows of the same kind share is worked out once.

    Raises
    ------
    UnsupportedError, ParameterError, DegeneracyError, ZeroProbabilityError
    """
    mine = {*modes.names, *modes.leaves}
    seen = frozenset(n for n, o in row.seen.items() if o.mask is None) - mine
    carried = () if before is None else before.layout.after
    memory = Memory() if before is None or before.memory is None else before.memory

    def lay_out() -> Layout:
        unknown = unknown_nodes(slices, before is None, modes.known(seen), carried)
        return Layout(slices, modes.apart, before is None, carried, unknown)

    layout = memory((before is None, carried, seen), lay_out)
    values = {**row.inputs, **{n: row.seen[n].value for n in seen}}
    if before is not None:
        values |= {n + PREVIOUS: v for n, v in before.known.items()}
    timed = {n: np.asarray(v)[None] for n, v in values.items()}
    observed = {
        n: Observed(o.value[None], None if o.mask is None else o.mask[None])
        for n, o in row.seen.items()
        if n in mine
    }
    some = np.zeros((), dtype=np.intp)
    possible = {**static, **values, **modes.at(some), **modes.at(some, PREVIOUS)}
    why = memory(
        (layout, options.engine), lambda: options.engine.refused_slice(modes, layout, possible)
    )
    if why is not None:
        raise UnsupportedError(f"{type(options.engine).__name__}: {why}")
    there = None if before is None else before.now

    def make() -> tuple[Stretch, dict[str, tuple[Any, Any]]]:
        found = Stretch(layout, modes, {**static, **timed}, observed, 1, there, rule=options.rule)
        return found, by_modes([found], found.pairs.now)

    still = not observed and _is_still(modes, layout)
    key = layout, options.engine, None if there is None else there.tobytes()
    stretch, told = memory(key, make) if still else make()
    _check_count(len(stretch.pairs.now), options)
    partly = {n: o for n, o in row.seen.items() if n not in seen and n not in mine}
    found = given_values(layout, partly, ())
    nothing = np.zeros((*layout.lead, layout.n), dtype=bool)
    pattern = pattern_of(layout, nothing if found is None else found[1])
    given = None if found is None else found[0]
    target = stacked(layout, {n: row.seen[n].value for n in layout.seen}, ())
    target = _with_given(layout, pattern, target, given)
    place = Place(stretch, 0, pattern, target, given, _is_carried(layout, pattern))
    after, increment = advanced(options.merging, None if before is None else before.found, place)
    after = whole(place, after)
    check_row(row.t, increment, place, None if before is None else before.found)
    known = {n: row.seen[n].value for n in seen}
    plain = (n for n in layout.computed if n not in modes.names and not modes.tell(layout, n))
    known |= {n: _evaluated(layout, n, {**static, **values}) for n in plain}
    state = SwitchingState(modes, stretch.pairs.now, after, layout, known, told, observed, memory)
    return state, increment


def check_row(t: int, increment: Any, place: Place, before: Mixture | None) -> None:
    """Refuse a row that no mode can have.

    Raises
    ------
    ZeroProbabilityError, DegeneracyError
    """
    if increment.ndim == 0 and math.isfinite(increment) or np.isfinite(increment).all():
        return
    if np.isnan(increment).any() or not (increment < np.inf).all():
        raise DegeneracyError(f"the row of slice {t} has no density given those before", t)
    log = np.zeros((1, *increment.shape)) if before is None else before.log
    node = place.stretch.ruling_out(place.at, log)
    if node is None:
        layout, numbers = place.layout, place.pattern.observed - place.layout.p
        partly = (n for n, at in layout.rows.items() if np.isin(np.r_[at], numbers).any())
        names = ", ".join(map(repr, (*layout.seen, *partly)))
    else:
        names = repr(node)
    raise ZeroProbabilityError(
        f"the row of slice {t} has probability zero given those before, whatever the modes: what was seen of "
        f"{names} is impossible; check that row, or give what is known without noise (a scale of 0, a "
        "probability of 0) a little"
    )


def values_by_mode(model: Any, told: Mapping[str, tuple[Any, Any]]) -> dict[str, np.ndarray]:
    """Values of computed nodes that modes tell, by slice and mode."""
    return {
        n: one.argmax(axis=-1) if two is None else one
        for n, (one, two) in told.items()
        if not model[n].is_stochastic
    }


# ---- private ------------------------------------------------------------------------------------


def _check_count(count: int, options: Options) -> None:
    if count > options.most:
        raise UnsupportedError(
            f"the finite nodes of a slice have {count} joint states that are possible, more than max_modes="
            f"{options.most}; allow more, or use ParticleFilter"
        )


def _is_carried(layout: Layout, pattern: Pattern) -> bool:
    """Whether the next slice reads numbers that are observed in this one."""
    return pattern.given is not None and bool(pattern.given[..., : layout.carried].any())


def _with_given(
    layout: Layout, pattern: Any, row: np.ndarray, given: np.ndarray | None
) -> np.ndarray:
    """Values of the numbers that a pattern observes."""
    if given is None or len(pattern.observed) == layout.p:
        return row
    return np.concatenate([row, given[..., pattern.observed[layout.p :] - layout.p]], axis=-1)


def _is_still(modes: Modes, layout: Layout) -> bool:
    """Whether modes and coefficients are the same in all rows that see the same nodes."""
    given = {*modes.names, *modes.leaves}
    known = {*given, *(n + PREVIOUS for n in modes.names), *layout.computed}
    return set(layout.certain) <= given and not reads_time(layout, known)


def _evaluated(layout: Layout, name: str, values: dict[str, np.ndarray]) -> np.ndarray:
    """A computed node's value; those above it come first."""
    for parent in layout.model[name].parents:
        if parent in layout.computed and parent not in values:
            values[parent] = _evaluated(layout, parent, values)
    return layout.model.evaluate(name, values)[0]
