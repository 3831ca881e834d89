"""Slices as numbers: how probable their modes are given those before, and their coefficients given both.

All pairs of modes (``pairs``) and all slices of a stretch are worked out together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME
from bayesmc.engines.filtering import in_slice
from bayesmc.engines.kalman.covariances import without_absent
from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.levels import Plan, Rule, expected_slice
from bayesmc.engines.kalman.passes import Ahead, Expected, Memory
from bayesmc.engines.kalman.reading import Linear, composed, reads_time
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.switching.mode_factors import (
    along_time,
    log_factors,
    modes_along,
    running_totals,
)
from bayesmc.engines.switching.modes import Modes
from bayesmc.engines.switching.pairs import Pairs
from bayesmc.errors import BayesmcError, ParameterError, UnsupportedError
from bayesmc.lowering import Coefficients
from bayesmc.network import Observed

#: entries of a table over time and pairs
_ENTRIES = 1 << 25
_NONE = np.zeros(0, dtype=np.intp)


class Stretch:
    """Slices of one layout, one after the other.

    Parameters
    ----------
    layout : Layout
    modes : Modes
    values : dict
        Known values with time first; static nodes without.
    observed : dict
        What is seen of nodes that are not always seen in full, with time first.
    count : int
    before, now : ndarray of int, or None
        Configurations that there are before (None in slice 0), and those to keep in these slices, possible
        or not; by default those that are possible.
    rule : Rule or None
        Makes slices linear that are not.
    reached : ndarray of bool, shape (before, *lead), optional
        Which configurations can be there just before the first slice; by default all of them. What is bad
        only where modes cannot be is not refused.

    Attributes
    ----------
    pairs : Pairs
    log : ndarray, shape (time or 1, pairs, *lead)
        Log probabilities of modes given those before, times densities of what depends on modes alone.

    Raises
    ------
    UnsupportedError, ParameterError
    """

    def __init__(
        self,
        layout: Layout,
        modes: Modes,
        values: Mapping[str, np.ndarray],
        observed: Mapping[str, Observed],
        count: int,
        before: np.ndarray | None,
        now: np.ndarray | None = None,
        rule: Rule | None = None,
        reached: np.ndarray | None = None,
    ) -> None:
        self.layout, self.modes, self.rule = layout, modes, rule
        static = layout.slices.template.static
        self.fixed = {n: v for n, v in values.items() if n in static}
        self.timed = {n: v for n, v in values.items() if n not in static}
        self.count, self._observed = count, observed
        self._memory = Memory()
        self._plan: Plan | None = None
        self._reached = reached
        #: whether some row was met that machine code leaves to NumPy
        self.is_singular = rule is not None
        every = np.arange(modes.count) if now is None else now
        table = self._table(observed, before, every)
        possible: np.ndarray = (table > -np.inf).reshape(*table.shape[:3], -1).any(axis=(0, 3))  # type: ignore[assignment]
        if not possible.any():  # that the first row rules all out is told when it is come to
            possible[:, :1] = True
        kept = np.flatnonzero(possible.any(axis=0)) if now is None else np.arange(len(every))
        src, dst = np.nonzero(possible[:, kept])
        if before is None:
            before, src = _NONE, _NONE
        self.pairs = Pairs(before, every[kept], src, dst, modes.classes(layout))
        src = self.pairs.src if len(before) else np.zeros(len(dst), dtype=np.intp)
        self.log = table[:, src, kept[self.pairs.dst]]

    def log_of(self, k: int) -> np.ndarray:
        """Of the k-th slice, shape (pairs, *lead)."""
        return self.log[k if len(self.log) > 1 else 0]

    def expected(
        self,
        k: int,
        pattern: Pattern,
        by_kind: bool,
        mean: np.ndarray,
        factor: np.ndarray,
    ) -> Expected:
        """What is expected of the k-th slice, for every kind or every pair.

        Parameters
        ----------
        mean : ndarray, shape (kinds or pairs, *lead, n_prev)
        factor : ndarray, shape (kinds or pairs, *lead, n_prev, n_prev)
        """
        if self.rule is not None:
            return self._linearised(k, pattern, by_kind, mean, factor)
        offset, moves, noise = self.chosen(k, pattern, by_kind)
        c = mean.shape[-1]
        rows = np.empty((*mean.shape[:-1], offset.shape[-1], c + noise.shape[-1]))
        np.matmul(moves, factor, out=rows[..., :c])
        rows[..., c:] = noise
        if pattern.absent is not None:
            rows = without_absent(rows, pattern.absent)

        def terms() -> np.ndarray:
            return np.abs(offset) + np.matvec(np.abs(moves), np.abs(mean))

        return Expected(offset + np.matvec(moves, mean), rows, terms)

    def chosen(self, k: int, pattern: Pattern, by_kind: bool) -> Linear:
        """Coefficients of the k-th slice, of the numbers that a pattern chooses, for kinds or for pairs."""
        timeless = len(self.linear.moves) == 1

        def choose() -> Linear:
            at, chosen = 0 if timeless else k, pattern.chosen
            offset, moves, noise = (a[at] for a in self.linear)
            found = [offset[..., chosen], moves[..., chosen, :], noise[..., chosen, :]]
            if not by_kind:
                found = [a.take(self.pairs.kind, axis=0) for a in found]
            return Linear(*found)

        key = "chosen", pattern.chosen.tobytes(), by_kind
        return self._memory(key, choose) if timeless else choose()

    def coefficients(self, k: int, pattern: Pattern, by_kind: bool) -> Coefficients:
        """The same as machine code reads them."""

        def choose() -> Coefficients:
            offset, moves, noise = self.chosen(k, pattern, by_kind)
            return Coefficients(moves, noise, offset)

        if len(self.linear.moves) > 1:
            return choose()
        return self._memory(("coefficients", pattern.chosen.tobytes(), by_kind), choose)

    @cached_property
    def linear(self) -> Linear:
        """Coefficients by slice and kind, shape (time or 1, kinds, *lead or ones, ...)."""
        return self._coefficients()

    def known(self, k: int, pair: int) -> dict[str, np.ndarray]:
        """All known values of the k-th slice given the modes of a pair."""
        found = {**self.fixed, **{n: v[k, ...] for n, v in self.timed.items()}}
        found |= self.pairs.values(self.modes, np.asarray(pair))
        for name in self.layout.computed:
            found[name] = self.layout.model.evaluate(name, found)[0]
        return found

    def ruling_out(self, k: int, before: np.ndarray) -> str | None:
        """The node that leaves no mode to the k-th slice, some element's at least; None if none does.

        Parameters
        ----------
        before : ndarray, shape (modes before or 1, *lead)
            Log probabilities.
        """
        modes = modes_along(self.modes.at(np.arange(self.modes.count)), 1)
        if len(self.pairs.before):
            modes |= modes_along(self.modes.at(self.pairs.before, PREVIOUS), 2)
        timed, seen = self._slice(k, self._observed)
        timed = along_time(timed, 2)
        values = {**self.fixed, **timed, **modes}
        start = np.where(before > -np.inf, 0.0, -np.inf)[None, :, None]
        for name, total in running_totals(self.layout, self.modes, values, seen, start):
            if (total == -np.inf).all(axis=(0, 1, 2)).any():
                return name
        return None

    def told(self, name: str) -> tuple[np.ndarray, np.ndarray | None] | None:
        """What modes alone say of a node that is averaged over them, by slice and mode.

        Returns
        -------
        tuple or None
            Probabilities of its states, shape (time or 1, modes, *plates, states), and None; or means and
            variances, shape (time or 1, modes, *value shape). None where the family has no such moments.
        """
        modes = modes_along(self.modes.at(self.pairs.now), 0)

        def over(timed: dict[str, np.ndarray], seen: Mapping[str, Observed]) -> np.ndarray:
            values = {**self.fixed, **along_time(timed, 1), **modes}
            for other in self.layout.computed:
                if not self.modes.reach(self.layout, other, PREVIOUS):
                    values[other] = self.layout.model.evaluate(other, values)[0]
            return _moments(self.layout.model, name, values)

        try:
            found = self._in_time(over, {})
        except UnsupportedError:  # no closed moments
            return None
        if self.layout.model[name].domain is not None:
            return found, None
        return found[..., 0], found[..., 1]

    # ---- private -------------------------------------------------------------------------------

    def _table(
        self, observed: Mapping[str, Observed], before: np.ndarray | None, now: np.ndarray
    ) -> np.ndarray:
        """Logs by slice and modes of both slices, shape (time or 1, before or 1, now, *lead)."""
        modes = modes_along(self.modes.at(now), 1)
        if before is not None:
            modes |= modes_along(self.modes.at(before, PREVIOUS), 2)
        size = len(now) * (1 if before is None else len(before)) * math.prod(self.layout.lead)

        def over(timed: dict[str, np.ndarray], seen: Any, start: Any = None) -> np.ndarray:
            values = {**self.fixed, **along_time(timed, 2), **modes}
            return log_factors(self.layout, self.modes, values, seen, start)

        try:
            found = self._in_time(over, observed)
        except ParameterError:
            if before is None:
                raise
            found = self._in_turn(over, observed, np.searchsorted(now, before))
        if found.size > _ENTRIES or size > _ENTRIES:
            raise UnsupportedError(
                f"modes of {self.count} slices and of those before make tables of {found.size:.3g} numbers; "
                "use ParticleFilter"
            )
        whole = (len(found), 1 if before is None else len(before), len(now), *self.layout.lead)
        return np.broadcast_to(found, whole)

    def _in_turn(
        self, over: Callable[..., np.ndarray], observed: Mapping[str, Observed], before: np.ndarray
    ) -> np.ndarray:
        """Slice by slice, each from the modes that can be there before; ``before`` are their places now."""
        reached = self._all_before(len(before)) if self._reached is None else self._reached
        parts: list[np.ndarray] = []
        for k in range(self.count):
            start = np.where(reached, 0.0, -np.inf)[None, :, None]
            timed, seen = self._slice(k, observed)
            with self._naming(k):
                parts.append(over(timed, seen, start))
            arrived = np.asarray((parts[-1] > -np.inf).any(axis=(0, 1)))
            reached = (
                arrived[before] if len(arrived) > 1 else np.broadcast_to(arrived, reached.shape)
            )
        whole = np.broadcast_shapes(*(p.shape[1:] for p in parts))
        return np.concatenate([np.broadcast_to(p, (1, *whole)) for p in parts])

    def _all_before(self, count: int) -> np.ndarray:
        return np.ones((count, *self.layout.lead), dtype=bool)

    def _coefficients(self) -> Linear:
        layout, pairs = self.layout, self.pairs
        values = modes_along(pairs.values(self.modes, pairs.of_kind), 0)
        still = {*values, *layout.computed}

        def over(timed: dict[str, np.ndarray]) -> Linear:
            count = len(next(iter(timed.values()))) if timed else 1
            known = {**self.fixed, **along_time(timed, 1), **values}
            return composed(layout, known, (count, len(pairs.of_kind)))

        def one(k: int, needed: np.ndarray) -> Linear:
            timed = self._slice(k, {})[0]
            try:
                return over(timed)
            except BayesmcError:
                return self._each({n: v[0] for n, v in timed.items()}, needed)

        timeless = not reads_time(layout, still)
        try:
            return over({n: v[:1] for n, v in self.timed.items()} if timeless else self.timed)
        except (
            BayesmcError
        ):  # slice by slice they say in which one, and what is impossible there is left out
            needed = self._needed
        if timeless:
            with self._naming(0):
                return one(0, np.asarray(needed.any(axis=0)))
        parts = []
        for k in range(self.count):
            with self._naming(k):
                parts.append(one(k, needed[k]))
        return Linear(*(np.concatenate(p) for p in zip(*parts, strict=True)))

    def _each(self, timed: dict[str, np.ndarray], needed: np.ndarray) -> Linear:
        """Of one slice, kind by kind; those that are not needed have another's coefficients if they fail."""
        layout, pairs = self.layout, self.pairs
        found: list[Linear | None] = []
        for kind, pair in enumerate(pairs.of_kind):
            values = pairs.values(self.modes, np.asarray(pair))
            try:
                found.append(composed(layout, {**self.fixed, **timed, **values}, ()))
            except BayesmcError as error:
                if needed[kind] or not needed.any():
                    shown = (
                        f"{n} is {_label(layout, n, v)}" for n, v in values.items() if not v.ndim
                    )
                    words = ", ".join(shown)
                    told = f"{error} (where {words})" if words else str(error)
                    error.args = (told, *error.args[1:])
                    raise
                found.append(None)
        some = found[int(needed.argmax())]
        assert some is not None
        whole = [some if f is None else f for f in found]
        return Linear(*(np.concatenate(p)[None] for p in zip(*whole, strict=True)))

    @cached_property
    def _needed(self) -> np.ndarray:
        """Which kinds can be in which slice, shape (time, kinds)."""
        found = np.zeros((self.count, len(self.pairs.of_kind)), dtype=bool)
        for kinds, pairs in zip(found, self._possible, strict=True):
            np.logical_or.at(kinds, self.pairs.kind, pairs)
        return found

    @cached_property
    def _possible(self) -> np.ndarray:
        """Which pairs can be in which slice, shape (time, pairs)."""
        pairs = self.pairs
        found = np.zeros((self.count, len(pairs.dst)), dtype=bool)
        count = max(len(pairs.before), 1)
        reached = self._all_before(count) if self._reached is None else self._reached
        src = pairs.src if len(pairs.before) else np.zeros(len(pairs.dst), dtype=np.intp)
        for k in range(self.count):
            can = (self.log_of(k) > -np.inf) & reached[src]
            found[k] = can.reshape(len(can), -1).any(axis=1)
            if (
                len(pairs.now) == count
            ):  # later slices go from the modes of one to the same of the next
                reached = np.zeros_like(reached)
                np.logical_or.at(reached, pairs.dst, can)
        return found

    def _slice(
        self, k: int, observed: Mapping[str, Observed]
    ) -> tuple[dict[str, np.ndarray], dict[str, Observed]]:
        """Values of the k-th slice, with an axis of length 1 for time."""
        part = slice(k, k + 1)
        return {n: v[part] for n, v in self.timed.items()}, {
            n: _rows(o, part) for n, o in observed.items()
        }

    def _naming(self, k: int) -> AbstractContextManager[None]:
        """Has errors say which slice they happened in, if there are several."""
        return in_slice(int(self.timed[TIME][k])) if self.count > 1 else nullcontext()

    def _in_time(self, function: Callable[..., Any], observed: Mapping[str, Observed]) -> Any:
        """A function of all slices at once, or one by one where functions do not take arrays of slices."""
        try:
            return function(self.timed, observed)
        except BayesmcError:  # one by one they say in which slice
            parts = []
            for k in range(self.count):
                with self._naming(k):
                    parts.append(function(*self._slice(k, observed)))
        whole = np.broadcast_shapes(*(p.shape[1:] for p in parts))
        return np.concatenate([np.broadcast_to(p, (1, *whole)) for p in parts])

    def _linearised(
        self, k: int, pattern: Pattern, by_kind: bool, mean: np.ndarray, factor: np.ndarray
    ) -> Expected:
        """One after the other, each linearised at its own mean."""
        assert self.rule is not None
        layout = self.layout
        found: list[tuple[np.ndarray, np.ndarray] | None] = []
        pairs = self.pairs.of_kind if by_kind else np.arange(len(self.pairs.dst))
        for unit, pair in enumerate(pairs):
            values = self.known(k, int(pair))
            plan = self._plan = self._plan or Plan(layout, values)
            ahead = Ahead(layout, values, mean[unit], factor[unit], pattern, self._memory)
            try:
                found.append(expected_slice(ahead, self.rule, plan))
            except ParameterError:
                needed = self._needed[k] if by_kind else self._possible[k]
                if needed[unit] or not needed.any():
                    raise
                found.append(None)
        some = next(p for p in found if p is not None)
        parts = [some if p is None else p for p in found]
        widest = max(rows.shape[-1] for _, rows in parts)
        wide = [
            np.concatenate([r, np.zeros((*r.shape[:-1], widest - r.shape[-1]))], axis=-1)
            for _, r in parts
        ]
        return Expected(np.stack([m for m, _ in parts]), np.stack(wide))


# ---- private ------------------------------------------------------------------------------------


def _moments(model: Any, name: str, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Probabilities of states, or means and variances, along the last axis; batch axes of time and mode."""
    node = model[name]
    result = model.evaluate(name, values)[0]
    if node.domain is not None:
        if node.is_stochastic:
            found = np.asarray(result.probs_table)
        else:
            found = (result[..., None] == np.arange(node.domain.size)) * 1.0
        rest = len(node.plates) + 1
    else:
        parts = (result.mean, result.var) if node.is_stochastic else (result, np.zeros(()))
        found = np.stack(np.broadcast_arrays(*(np.asarray(p, dtype=float) for p in parts)), axis=-1)
        rest = len(node.value_shape) + 1
    found = found.reshape((1,) * (2 + rest - found.ndim) + found.shape)
    return np.broadcast_to(found, (*found.shape[:2], *node.value_shape, found.shape[-1]))


def _label(layout: Layout, name: str, stored: np.ndarray) -> str:
    domain = layout.slices.first[name.removesuffix(PREVIOUS)].domain
    return repr(domain.states[int(stored)]) if domain is not None else str(stored)


def _rows(seen: Observed, part: slice) -> Observed:
    """Some rows of what is seen."""
    return Observed(seen.value[part], None if seen.mask is None else seen.mask[part])
