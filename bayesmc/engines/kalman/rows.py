"""One row at a time: what Gaussian filters do online, and nonlinear ones always.

A node that is seen in full in a slice is a known number there, whatever it is elsewhere; so every row has the
layout that fits it, and functions are evaluated at what was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.kalman.covariances import full_factor
from bayesmc.engines.kalman.data import Pattern, certain_density, given_values, pattern_of, stacked
from bayesmc.engines.kalman.means import absorbed
from bayesmc.engines.kalman.passes import State, start_state
from bayesmc.engines.kalman.slices import Layout, unknown_nodes
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import DegeneracyError, UnsupportedError, ZeroProbabilityError
from bayesmc.linalg.square_root import Conditioned, condition

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


class Family(Protocol):
    """What a filter says of a slice by itself."""

    def refused_row(self, layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
        """Why it is refused, or None."""
        ...

    def expected(
        self,
        layout: Layout,
        values: Mapping[str, np.ndarray],
        state: State,
        pattern: Pattern,
        memory: Memory,
    ) -> Expected:
        """What a row is compared with."""
        ...


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
            state = start_state(layout)
        else:
            c = before.layout.carried
            state = State(before.mean[..., :c], before.factor[..., :c, :c])
        given, pattern = self._pattern(layout, row)
        target = stacked(layout, {n: row.seen[n].value for n in layout.seen}, ())
        if given is not None:
            places = pattern.observed[layout.p :] - layout.p
            target = np.concatenate([target, given[..., places]], axis=-1)
        mean, rows, terms = self.family.expected(layout, values, state, pattern, self.memory)
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


def _angles(layout: Layout, pattern: Pattern) -> np.ndarray | None:
    """Which observed numbers lie on a circle."""
    found = layout.angles
    return None if found is None else found[pattern.observed]
