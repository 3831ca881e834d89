"""A series as Gaussian filters read it: known values of every slice, and rows stacked as vectors.

Nodes that are seen in full throughout are numbers that functions read; nodes seen now and then are unknown
ones of which some are given. Which of them are given makes the pattern of a slice.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME, SeriesProblem
from bayesmc.engines.filtering import in_slice
from bayesmc.engines.kalman.slices import Layout, always_unknown
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.network import Observed
from bayesmc.network.forward import summed
from bayesmc.network.noiseless import point_log_density


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which numbers of a slice are observed.

    Attributes
    ----------
    observed : ndarray of int
        Places of observed numbers among the seen and the unknown ones.
    kept : ndarray of int
        Places of the unknown numbers that are worked out, those that the next slice reads first.
    given : ndarray of bool, shape ([*lead], n), or None
        Unknown numbers that are observed in this slice.
    absent : ndarray of bool, shape (*lead, observed), or None
        Observed numbers that some elements of the plates apart lack.
    """

    observed: np.ndarray
    kept: np.ndarray
    given: np.ndarray | None = None
    absent: np.ndarray | None = None

    @cached_property
    def chosen(self) -> np.ndarray:
        """Observed numbers, then those that are kept, among the seen and the unknown ones."""
        return np.concatenate([self.observed, self.kept])


class SeriesData:
    """The data of a problem.

    Parameters
    ----------
    problem : SeriesProblem
    given : frozenset of str
        Further nodes whose values layouts count as known, though no data say them.

    Attributes
    ----------
    layouts : tuple of Layout
        Of slice 0 and of later ones.
    known : frozenset of str
        Nodes with a density that are seen in full throughout.
    """

    def __init__(self, problem: SeriesProblem, given: frozenset[str] = frozenset()) -> None:
        slices, series = problem.slices, problem.series
        self.slices, self.series, self.steps = slices, series, series.steps
        self.known = frozenset(n for n, o in series.observed.items() if o.mask is None)
        unknown = always_unknown(slices, self.known | given)
        apart = plates_apart(slices)
        before = tuple(n for n in slices.interface if n in unknown)
        self.layouts = (
            Layout(slices, apart, True, before, unknown),
            Layout(slices, apart, False, before, unknown),
        )
        self.static = problem.known_static
        self._computed: dict[str, np.ndarray] = {}
        self._plain = tuple(_computed_by_data(layout, given) for layout in self.layouts)
        if any(n in slices.interface for names in self._plain for n in names):
            self._computed = self._values_computed(self.steps)

    def layout(self, k: int) -> Layout:
        """The layout of slice k."""
        return self.layouts[min(k, 1)]

    def values(self, low: int, high: int) -> dict[str, np.ndarray]:
        """Known values of slices, time first; static ones without time. All of one layout."""
        clock = np.arange(low, high)
        found = {**self.static, TIME: clock}
        timed = {**self.series.inputs, **{n: self.series.observed[n].value for n in self.known}}
        timed |= self._computed
        for name, values in timed.items():
            found[name] = values[low:high]
            if low:
                found[name + PREVIOUS] = values[low - 1 : high - 1]
        if low:
            found[TIME + PREVIOUS] = clock - 1
        return found

    def at(self, k: int) -> dict[str, np.ndarray]:
        """Known values of one slice."""
        found = self.values(k, k + 1)
        return {n: v if n in self.static else v[0, ...] for n, v in found.items()}

    def seen(self, low: int, high: int) -> np.ndarray:
        """Values of the seen numbers of slices of one layout, shape (time, *lead, p)."""
        found = self._seen[min(low, 1)]
        return found if low == 0 else found[low - 1 : high - 1]

    def spans(self) -> Iterator[tuple[Layout, tuple[int, int]]]:
        """Slice 0 and the later ones."""
        yield self.layouts[0], (0, 1)
        if self.steps > 1:
            yield self.layouts[1], (1, self.steps)

    @cached_property
    def given(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Values of unknown numbers and which are observed, shape (time, *lead, n); None if none is."""
        return given_values(self.layouts[0], self.series.observed, (self.steps,))

    @cached_property
    def patterns(self) -> tuple[list[Pattern], np.ndarray]:
        """The patterns that occur, with those of slice 0 apart, and which each slice has."""
        first = Pattern(*_places(self.layouts[0], None))
        later = Pattern(*_places(self.layouts[1], None))
        which = np.ones(self.steps, dtype=np.intp)
        which[0] = 0
        if self.given is None:
            return [first, later], which
        mask = self.given[1]
        flat = np.packbits(mask.reshape(self.steps, -1), axis=1)
        found: dict[Any, int] = {}
        patterns: list[Pattern] = []
        for k in range(self.steps):
            key = (k == 0, flat[k].tobytes())
            if key not in found:
                found[key] = len(patterns)
                patterns.append(pattern_of(self.layout(k), mask[k]))
            which[k] = found[key]
        return patterns, which

    def certain(self) -> np.ndarray:
        """Log densities of seen nodes that depend on nothing unknown, shape (time, *lead)."""
        lead = self.layouts[0].lead
        total = np.zeros((self.steps, *lead))
        for layout, (low, high) in self.spans():
            if layout.certain:
                total[low:high] = certain_densities(layout, self.values(low, high), high - low)
        return total

    def computed(self, steps: int) -> dict[str, np.ndarray]:
        """Values in the first slices of deterministic nodes that are known throughout, time first."""
        names = set(self._plain[0]) & set(self._plain[1])
        if not names:
            return {}
        found = self._computed or self._values_computed(steps)
        return {n: found[n][:steps] for n in names}

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _seen(self) -> list[np.ndarray]:
        found = []
        for layout, (low, high) in self.spans():
            observed = {n: self.series.observed[n].value[low:high] for n in layout.seen}
            found.append(stacked(layout, observed, (high - low,)))
        return found

    def _values_computed(self, steps: int) -> dict[str, np.ndarray]:
        """Deterministic nodes slice by slice, since they may read their own past."""
        rows: dict[str, list[np.ndarray]] = {}
        before: dict[str, np.ndarray] = {}
        for k in range(steps):
            layout, values = self.layout(k), {**self.at(k), **before}
            before = {}
            for name in self._plain[min(k, 1)]:
                with in_slice(k):
                    value = layout.model.evaluate(name, values)[0]
                values[name] = value
                before[name + PREVIOUS] = value
                rows.setdefault(name, []).append(value)
        return {n: np.stack(v) for n, v in rows.items() if len(v) == steps}


def stacked(layout: Layout, values: Mapping[str, np.ndarray], batch: tuple[int, ...]) -> np.ndarray:
    """Values of the seen nodes as vectors, shape (*batch, *lead, p)."""
    found = np.empty((*batch, *layout.lead, layout.p))
    for name, place in layout.seen.items():
        found[..., place] = layout.packed(layout.model[name], values[name].astype(float))
    return found


def given_values(
    layout: Layout, observed: Mapping[str, Observed], batch: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Unknown numbers that are observed in part: values and which, shape (*batch, *lead, n)."""
    names = [n for n in layout.rows if n in observed]
    if not names:
        return None
    values = np.zeros((*batch, *layout.lead, layout.n))
    mask = np.zeros(values.shape, dtype=bool)
    for name in names:
        node, seen = layout.model[name], observed[name]
        assert seen.mask is not None
        full = np.broadcast_to(
            seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape)), seen.value.shape
        )
        if seen.parts is not None:
            full = full | seen.parts
        values[..., layout.rows[name]] = layout.packed(node, seen.value.astype(float))
        mask[..., layout.rows[name]] = layout.packed(node, full)
    return values, mask


def pattern_of(layout: Layout, mask: np.ndarray) -> Pattern:
    """The pattern of a slice in which some unknown numbers, shape (*lead, n), are observed."""
    flat = mask.reshape(math.prod(layout.lead), layout.n)
    some, every = np.asarray(flat.any(axis=0)), np.asarray(flat.all(axis=0))
    if (some == every).all():
        observed, kept = _places(layout, some)
        return Pattern(observed, kept, some if some.any() else None)
    observed = np.concatenate([np.arange(layout.p), layout.p + np.flatnonzero(some)])
    absent = np.concatenate(
        [np.zeros((*layout.lead, layout.p), dtype=bool), ~mask[..., some]], axis=-1
    )
    return Pattern(observed, layout.p + np.arange(layout.n), mask, absent)


def certain_densities(layout: Layout, values: dict[str, np.ndarray], count: int) -> np.ndarray:
    """Log densities of seen nodes that depend on nothing unknown, shape (count, *lead)."""
    total = np.zeros((count, *layout.lead))
    static = layout.slices.template.static
    for k in range(count):
        at = {n: v if n in static else v[k, ...] for n, v in values.items()}
        total[k] = certain_density(layout, at)
    return total


def certain_density(layout: Layout, at: Mapping[str, np.ndarray]) -> Any:
    """The same of one slice, shape (*lead)."""
    total: Any = np.zeros(layout.lead)
    if not layout.certain:
        return total
    at = dict(at)
    for name in (n for n in layout.order if n in (*layout.computed, *layout.certain)):
        result = layout.model.evaluate(name, at)[0]
        if name in layout.computed:
            at[name] = result
            continue
        node = layout.model[name]
        log = None
        if result.noiseless is not None:
            log = point_log_density(layout.model, name, result, at)
        if log is None:
            log = layout.model.log_density(name, result, at[name])
        total = total + summed(np.asarray(log), node, layout.apart)
    return total


# ---- private ------------------------------------------------------------------------------------


def _computed_by_data(layout: Layout, given: Collection[str]) -> tuple[str, ...]:
    """Deterministic nodes whose value data say, parents first: those that depend on none of ``given``."""
    below = set(given)
    while True:  # what depends on the slice before may stand ahead of it
        more = {
            n for n in layout.computed
            if any(p.removesuffix(PREVIOUS) in below for p in layout.model[n].parents)
        }  # fmt: skip
        if more <= below:
            return tuple(n for n in layout.computed if n not in below)
        below |= more


def _places(layout: Layout, given: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Observed numbers and those to work out; given ones that the next slice does not read are dropped."""
    p, n = layout.p, layout.n
    if given is None:
        return np.arange(p), p + np.arange(n)
    observed = np.concatenate([np.arange(p), p + np.flatnonzero(given)])
    rest = ~given
    rest[: layout.carried] = True
    return observed, p + np.flatnonzero(rest)
