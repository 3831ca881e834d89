"""Forward and backward over the slices of a series, all at once or one row at a time.

Where coefficients are known beforehand, covariances do not depend on the data, so they come first
(``covariances``), and means follow (``means``). Online, and where filters are nonlinear, rows are taken one
by one: a node that is seen in full in a slice is a known number there, whatever it is elsewhere, so every row
has the layout that fits it, and functions are evaluated at what was seen. How one slice is conditioned is in
``linalg.square_root``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.kalman.covariances import (
    Chosen,
    Covariances,
    by_pattern,
    full_factor,
    stacked_fields,
    worked_out,
)
from bayesmc.engines.kalman.data import (
    Pattern,
    SeriesData,
    certain_density,
    given_values,
    pattern_of,
    stacked,
)
from bayesmc.engines.kalman.means import Innovations, absorbed, all_means
from bayesmc.engines.kalman.reading import Linear
from bayesmc.engines.kalman.slices import Layout, unknown_nodes
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import DegeneracyError, UnsupportedError, ZeroProbabilityError
from bayesmc.linalg.square_root import Conditioned, condition, multiplied, turned


class Turns(NamedTuple):
    """What carries a smoother from a slice to the one before, for each kind of slice, and each slice.

    Attributes
    ----------
    links, spreads : ndarray, shape (kinds, [*lead], carried, carried)
        On the noise of the later slice, and the covariance that is left; zero of slice 0.
    shifts : ndarray, shape (time, *lead, carried)
        What the innovations of a slice tell of the noise of the one before.
    """

    links: np.ndarray
    spreads: np.ndarray
    shifts: np.ndarray


@dataclass(frozen=True, eq=False)
class Filtered:
    """Every slice given the rows up to it.

    Attributes
    ----------
    means : ndarray, shape (time, *lead, n)
    factors : ndarray, shape (kinds, [*lead], n, n)
        Roots of covariances; ``which`` says which one is a slice's.
    which : ndarray of int, shape (time,)
        The kind of each slice.
    increments : ndarray, shape (time, *lead)
    turns : Turns or None
        None where no smoother asks.
    innovations : Innovations
    """

    means: np.ndarray
    factors: np.ndarray
    which: np.ndarray
    increments: np.ndarray
    turns: Turns | None
    innovations: Innovations

    def first(self, steps: int) -> Filtered:
        """The first so many slices, for answers; they carry no smoother."""
        return Filtered(
            self.means[:steps], self.factors, self.which[:steps], self.increments[:steps], None,
            self.innovations.first(steps),
        )  # fmt: skip


def forward(
    data: SeriesData,
    matrices: tuple[Linear, Linear | None],
    smoothing: bool,
    advance: Callable[[int], None],
) -> Filtered:
    """The filter: ``matrices`` are those of slice 0 and of the later ones.

    Increments that are not finite are for the caller to refuse; what comes before them is right.
    """
    chosen = Chosen(data, matrices)
    covariances = worked_out(data, chosen, smoothing, advance)
    found = all_means(data, chosen, covariances, smoothing)
    turns = None
    if found.shifts is not None:
        turns = Turns(*_turns(data.layouts[0], covariances), found.shifts)
    factors = _factors(data, chosen, covariances)
    which, increments = covariances.which, found.increments
    return Filtered(found.means, factors, which, increments, turns, found.innovations)


class Smoothed(NamedTuple):
    """Every slice given later rows: the noise of ``means + factor @ noise`` has these moments.

    Attributes
    ----------
    noise : ndarray, shape (time, *lead, carried)
    spread : ndarray, shape (time, [*lead], carried, carried)
    """

    noise: np.ndarray
    spread: np.ndarray


def backward(layout: Layout, filtered: Filtered, lag: int | None) -> Smoothed:
    """The smoother: of all rows, or of those up to ``lag`` slices later."""
    assert filtered.turns is not None
    carried, steps, lead = layout.carried, len(filtered.which), layout.lead
    links, spreads, shifts = filtered.turns
    wide = links.shape[1:-2]
    noise = np.zeros((steps, *lead, carried))
    spread = np.broadcast_to(np.eye(carried), (steps, *wide, carried, carried)).copy()
    if lag == 0 or steps == 1 or not carried:
        return Smoothed(noise, spread)
    if lag is None:
        (_back_in_numbers if noise[0].size == 1 else _back)(
            filtered.turns, filtered.which, noise, spread
        )
        return Smoothed(noise, spread)
    link, rest = links[filtered.which[1:]], spreads[filtered.which[1:]]
    for ahead in range(
        min(lag, steps - 1), 0, -1
    ):  # slice k goes from k + ahead to the one before that
        count = steps - ahead
        later = slice(ahead - 1, steps - 1)
        shared = link[later].reshape(
            count, *(1,) * (len(lead) - len(wide)), *wide, carried, carried
        )
        noise[:count] = shifts[ahead:] + np.matvec(shared, noise[:count])
        turn = np.matrix_transpose(link[later])
        spread[:count] = link[later] @ spread[:count] @ turn + rest[later]
    return Smoothed(noise, spread)


#: kinds of rows of which something is remembered
_KEPT = 64


def contradicts(layout: Layout, log: np.ndarray, made: Conditioned | None = None) -> bool:
    """Whether a row without density is one that contradicts what is known without noise."""
    bare = any(layout.model[n].noiseless for n in layout.order)
    return bool((log == -np.inf).any()) and (
        bare or (made is not None and made.certain is not None)
    )


def impossible_row(t: int) -> ZeroProbabilityError:
    """What is seen is not what it must be: the error that says so."""
    return ZeroProbabilityError(
        f"the row of slice {t} has probability zero given those before: it contradicts what is known without "
        "noise (a scale of 0, or a singular covariance); check the row, or give the node a little noise"
    )


class Expected(NamedTuple):
    """Of the numbers that a pattern chooses.

    Attributes
    ----------
    mean : ndarray, shape (*lead, numbers)
    rows : ndarray, shape ([*lead], numbers, k)
        Coefficients of the noise.
    terms : callable or None
        How large the terms are whose sum is ``mean``; asked for where something is known without noise.
    """

    mean: np.ndarray
    rows: np.ndarray
    terms: Callable[[], np.ndarray] | None = None


class Memory:
    """What was worked out for rows of the same kind before; bounded, since patterns may be many."""

    def __init__(self) -> None:
        self._kept: dict[Any, Any] = {}

    def __call__(self, key: Any, make: Callable[[], Any]) -> Any:
        """The entry of a key, made if there is none."""
        if key not in self._kept:
            while len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = make()
        return self._kept[key]


class Ahead(NamedTuple):
    """A slice whose row is still to be taken in.

    Attributes
    ----------
    layout : Layout
    values : dict
        Of the nodes that are known.
    mean : ndarray, shape (*lead, n_prev)
        Of the numbers of the slice before: ``mean + factor @ (independent normals)``.
    factor : ndarray, shape ([*lead], n_prev, n_prev)
    pattern : Pattern
    memory : Memory
    """

    layout: Layout
    values: Mapping[str, np.ndarray]
    mean: np.ndarray
    factor: np.ndarray
    pattern: Pattern
    memory: Memory


class Family(Protocol):
    """What a filter says of a slice by itself."""

    def refused_row(self, layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
        """Why it is refused, or None."""

    def expected(self, ahead: Ahead) -> Expected:
        """What a row is compared with."""


class Taken(NamedTuple):
    """A slice given its row and those before.

    Attributes
    ----------
    layout : Layout
    mean : ndarray, shape (*lead, n)
    factor : ndarray, shape ([*lead], n, n)
    made : Conditioned
    eta : ndarray, shape (*lead, observed)
    log_density : ndarray, shape (*lead,)
        Of the row given those before.
    known : dict
        Values of the nodes that are known.
    pattern : Pattern
    """

    layout: Layout
    mean: np.ndarray
    factor: np.ndarray
    made: Conditioned
    eta: np.ndarray
    log_density: np.ndarray
    known: dict[str, np.ndarray]
    pattern: Pattern


class RowTaker:
    """Takes in rows for a filter; ``static`` holds the values of the static nodes."""

    def __init__(self, family: Family, slices: Slices, static: Mapping[str, np.ndarray]) -> None:
        self.family, self.slices, self.static = family, slices, dict(static)
        self.memory = Memory()

    def take(self, row: Row, before: Taken | None, turning: bool = False) -> Taken:
        """The slice after ``before``; ``turning`` keeps what a smoother needs.

        Raises
        ------
        UnsupportedError, DegeneracyError, ParameterError
        """
        layout = self._layout(row, before)
        values = self._values(row, before)
        for name in layout.computed:
            values[name] = layout.model.evaluate(name, values)[0]
        why = self.memory(("why", layout), lambda: self.family.refused_row(layout, values))
        if why is not None:
            raise UnsupportedError(f"{type(self.family).__name__}: {why}")
        if before is None:
            carried = np.zeros((*layout.lead, 0)), np.zeros((0, 0))
        else:
            c = before.layout.carried
            carried = before.mean[..., :c], before.factor[..., :c, :c]
        given, pattern = self._pattern(layout, row)
        target = stacked(layout, {n: row.seen[n].value for n in layout.seen}, ())
        if given is not None:
            places = pattern.observed[layout.p :] - layout.p
            target = np.concatenate([target, given[..., places]], axis=-1)
        ahead = Ahead(layout, values, *carried, pattern, self.memory)
        mean, rows, terms = self.family.expected(ahead)
        made = condition(rows, len(pattern.observed), layout.n_prev if turning else None)
        angles = _angles(layout, pattern)
        after, eta, log = absorbed(layout, pattern, made, mean, target, given, angles, terms)
        log = log + certain_density(layout, values)
        if contradicts(layout, log, made):
            raise impossible_row(row.t)
        if not (np.isfinite(after).all() and np.isfinite(log).all()):
            raise DegeneracyError(
                f"the row of slice {row.t} has no density given those before", row.t
            )
        known = {n: o.value for n, o in row.seen.items() if o.mask is None}
        known |= {n: values[n] for n in layout.computed}
        return Taken(
            layout, after, full_factor(layout, pattern, made.factor), made, eta, log, known, pattern
        )

    # ---- private -------------------------------------------------------------------------------

    def _layout(self, row: Row, before: Taken | None) -> Layout:
        first, slices = before is None, self.slices
        carried = () if before is None else before.layout.after
        seen = frozenset(n for n, o in row.seen.items() if o.mask is None)

        def make() -> Layout:
            unknown = unknown_nodes(slices, first, seen, carried)
            return Layout(slices, plates_apart(slices), first, carried, unknown)

        return self.memory((first, carried, seen), make)

    def _values(self, row: Row, before: Taken | None) -> dict[str, np.ndarray]:
        found = {**self.static, **row.inputs}
        if before is not None:
            found |= {n + PREVIOUS: v for n, v in before.known.items()}
        for name, seen in row.seen.items():
            if seen.mask is None:
                found[name] = seen.value
        return found

    def _pattern(self, layout: Layout, row: Row) -> tuple[np.ndarray | None, Pattern]:
        partly = {n: o for n, o in row.seen.items() if o.mask is not None}
        found = given_values(layout, partly, ())
        if found is not None:
            return found[0], pattern_of(layout, found[1])
        nothing = np.zeros((*layout.lead, layout.n), dtype=bool)
        return None, self.memory(("nothing given", layout), lambda: pattern_of(layout, nothing))


# ---- private ------------------------------------------------------------------------------------


def _factors(data: SeriesData, chosen: Chosen, covariances: Covariances) -> np.ndarray:
    """Roots of the covariances of all unknown numbers, by kind."""
    first = covariances.patterns[covariances.which[0]]
    parts = {}
    for places in by_pattern(covariances.patterns):
        index = covariances.patterns[places[0]]
        layout = data.layouts[0] if index == first else data.layouts[1]
        factor = stacked_fields([covariances.conditioned[k] for k in places], "factor")
        parts[places.tobytes()] = (places, full_factor(layout, chosen.patterns[index], factor))
    return _joined(len(covariances.patterns), list(parts.values()))


def _turns(layout: Layout, covariances: Covariances) -> tuple[np.ndarray, np.ndarray]:
    """Links and spreads by kind; slice 0 has none."""
    links, spreads, c = [], [], layout.carried
    for places in by_pattern(covariances.patterns):
        records = [covariances.conditioned[k] for k in places]
        found = turned(stacked_fields(records, "turn"), records[0].root.shape[-1], layout.carried)
        if found.link.shape[-2] == c:
            links.append((places, found.link))
            spreads.append((places, found.spread))
    kinds = len(covariances.patterns)
    if not links:
        return np.zeros((kinds, c, c)), np.zeros((kinds, c, c))
    return _joined(kinds, links), _joined(kinds, spreads)


def _joined(kinds: int, parts: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Arrays of some kinds each as one, with the axes of plates where any has them."""
    lead = np.broadcast_shapes(*(a.shape[1:-2] for _, a in parts))
    found = np.zeros((kinds, *lead, *parts[0][1].shape[-2:]))
    for places, array in parts:
        wide = array.reshape(len(array), *(1,) * (found.ndim - array.ndim), *array.shape[1:])
        found[places] = wide
    return found


def _back(turns: Turns, which: np.ndarray, noise: np.ndarray, spread: np.ndarray) -> None:
    """Through all slices, last to first, in place."""
    links, rest, shifts = list(turns.links), list(turns.spreads), turns.shifts
    alone = turns.links.ndim == 3
    for k in range(len(which) - 2, -1, -1):
        kind = which[k + 1]
        link = links[kind]
        noise[k] = shifts[k + 1] + multiplied(link, noise[k + 1])
        if alone:  # several times faster than @ on small matrices
            spread[k] = link.dot(spread[k + 1]).dot(link.T) + rest[kind]
        else:
            spread[k] = link @ spread[k + 1] @ np.matrix_transpose(link) + rest[kind]


def _back_in_numbers(
    turns: Turns, which: np.ndarray, noise: np.ndarray, spread: np.ndarray
) -> None:
    """The same of one number in each slice: the arithmetic of Python's numbers is the faster one."""
    links, rest = turns.links.ravel().tolist(), turns.spreads.ravel().tolist()
    shifts, kinds = turns.shifts.ravel().tolist(), which.tolist()
    here, left = 0.0, 1.0
    means, variances = [here], [left]
    for k in range(len(kinds) - 1, 0, -1):
        link = links[kinds[k]]
        here = shifts[k] + link * here
        left = link * left * link + rest[kinds[k]]
        means.append(here)
        variances.append(left)
    noise[...] = np.array(means[::-1]).reshape(noise.shape)
    spread[...] = np.array(variances[::-1]).reshape(spread.shape)


def _angles(layout: Layout, pattern: Pattern) -> np.ndarray | None:
    """Which observed numbers lie on a circle."""
    found = layout.angles
    return None if found is None else found[pattern.observed]
