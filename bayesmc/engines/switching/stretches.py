"""Slices as numbers: how probable their modes are given those before, and their coefficients given both.

All pairs of modes (``pairs``) and all slices of a stretch are worked out together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
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
from bayesmc.engines.switching.modes import Modes
from bayesmc.engines.switching.pairs import Pairs
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.lowering import Coefficients
from bayesmc.network import Observed
from bayesmc.network.forward import summed
from bayesmc.network.model import invalid_error
from bayesmc.network.noiseless import point_log_density

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
    ) -> None:
        self.layout, self.modes, self.rule = layout, modes, rule
        static = layout.slices.template.static
        self.fixed = {n: v for n, v in values.items() if n in static}
        self.timed = {n: v for n, v in values.items() if n not in static}
        self.count = count
        self._memory = Memory()
        self._plan: Plan | None = None
        #: whether some row was met that machine code leaves to NumPy
        self.is_singular = rule is not None
        every = np.arange(modes.count) if now is None else now
        table = self._table(observed, before, every)
        possible: np.ndarray = (table > -np.inf).reshape(*table.shape[:3], -1).any(axis=(0, 3))  # type: ignore[assignment]
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
            return self._made_linear(k, pattern, by_kind, mean, factor)
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

        return self._memory((id(pattern), by_kind), choose) if timeless else choose()

    def coefficients(self, k: int, pattern: Pattern, by_kind: bool) -> Coefficients:
        """The same as machine code reads them."""

        def choose() -> Coefficients:
            offset, moves, noise = self.chosen(k, pattern, by_kind)
            return Coefficients(moves, noise, offset)

        if len(self.linear.moves) > 1:
            return choose()
        return self._memory(("coefficients", id(pattern), by_kind), choose)

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

        def over(timed: dict[str, np.ndarray], seen: Mapping[str, Observed]) -> np.ndarray:
            values = {**self.fixed, **along_time(timed, 2), **modes}
            return log_factors(self.layout, self.modes, values, seen)

        found = self._in_time(over, observed)
        if found.size > _ENTRIES or size > _ENTRIES:
            raise UnsupportedError(
                f"modes of {self.count} slices and of those before make tables of {found.size:.3g} numbers; "
                "use ParticleFilter"
            )
        whole = (len(found), 1 if before is None else len(before), len(now), *self.layout.lead)
        return np.broadcast_to(found, whole)

    def _coefficients(self) -> Linear:
        layout, pairs = self.layout, self.pairs
        values = modes_along(pairs.values(self.modes, pairs.of_kind), 0)
        still = {*values, *layout.computed}

        def over(timed: dict[str, np.ndarray], seen: Mapping[str, Observed]) -> Linear:
            count = len(next(iter(timed.values()))) if timed else 1
            known = {**self.fixed, **along_time(timed, 1), **values}
            return composed(layout, known, (count, len(pairs.of_kind)))

        if not reads_time(layout, still):
            return over({n: v[:1] for n, v in self.timed.items()}, {})
        parts: list[Linear] = self._in_time(lambda timed, seen: [over(timed, seen)], {})
        return Linear(*(np.concatenate(p) for p in zip(*parts, strict=True)))

    def _in_time(self, function: Callable[..., Any], observed: Mapping[str, Observed]) -> Any:
        """A function of all slices at once, or one by one where functions do not take arrays of slices."""
        try:
            return function(self.timed, observed)
        except BayesmcError:  # one by one they say in which slice
            parts = []
            for k in range(self.count):
                part = slice(k, k + 1)
                clock = int(self.timed[TIME][k])
                with in_slice(clock) if self.count > 1 else nullcontext():
                    timed = {n: v[part] for n, v in self.timed.items()}
                    parts.append(function(timed, {n: _rows(o, part) for n, o in observed.items()}))
        if isinstance(parts[0], list):
            return [one for part in parts for one in part]
        whole = np.broadcast_shapes(*(p.shape[1:] for p in parts))
        return np.concatenate([np.broadcast_to(p, (1, *whole)) for p in parts])

    def _made_linear(
        self, k: int, pattern: Pattern, by_kind: bool, mean: np.ndarray, factor: np.ndarray
    ) -> Expected:
        """One after the other, each made linear at its own mean."""
        assert self.rule is not None
        layout, parts = self.layout, []
        pairs = self.pairs.of_kind if by_kind else np.arange(len(self.pairs.dst))
        for unit, pair in enumerate(pairs):
            values = self.known(k, int(pair))
            plan = self._plan = self._plan or Plan(layout, values)
            ahead = Ahead(layout, values, mean[unit], factor[unit], pattern, self._memory)
            parts.append(expected_slice(ahead, self.rule, plan))
        widest = max(rows.shape[-1] for _, rows in parts)
        wide = [
            np.concatenate([r, np.zeros((*r.shape[:-1], widest - r.shape[-1]))], axis=-1)
            for _, r in parts
        ]
        return Expected(np.stack([m for m, _ in parts]), np.stack(wide))


def along_time(timed: Mapping[str, np.ndarray], behind: int) -> dict[str, np.ndarray]:
    """Values with time first and so many further batch axes of length 1 behind it."""
    return {n: v.reshape(len(v), *(1,) * behind, *v.shape[1:]) for n, v in timed.items()}


def modes_along(values: Mapping[str, np.ndarray], behind: int) -> dict[str, np.ndarray]:
    """Values by configuration as a batch: time and, for the last of two, the mode before are in front.

    With ``behind`` 2 they are those of the slice before, and this slice's mode has the axis behind them.
    """
    shape = {0: (1, -1), 1: (1, 1, -1), 2: (1, -1, 1)}[behind]
    return {
        n: v.reshape(*(len(v) if s < 0 else s for s in shape), *v.shape[1:])
        for n, v in values.items()
    }


def log_factors(
    layout: Layout,
    modes: Modes,
    values: dict[str, np.ndarray],
    observed: Mapping[str, Observed],
) -> np.ndarray:
    """Log densities of all nodes that depend on modes and data alone, shape (time, before, now, *lead).

    Parameters
    ----------
    values : dict
        Known values and those of modes, with batch axes of time, the modes before and the modes now.
    observed : dict
        What is seen of modes and of nodes that may be missing, time first.

    Raises
    ------
    ParameterError
        Bad parameters where modes are possible.
    """
    total: Any = np.zeros((1, 1, 1, *(1,) * len(layout.lead)))
    for name in (n for n in layout.order if n in (*layout.certain, *layout.computed)):
        node, model = layout.model[name], layout.model
        is_mode = name in modes.names
        if name in layout.computed:
            result = model.evaluate(name, values)[0]
            if is_mode:
                log = np.where(result == values[name], 0.0, -np.inf)
                total = total + summed(log, node, layout.apart)
            else:
                values[name] = result
        else:
            seen = observed.get(name)
            mask = None
            if not is_mode and name in modes.leaves:
                if seen is None:
                    continue
                values[name], mask = _behind_time(seen.value), seen.mask
            result, batch = model.evaluate(name, values)
            if result.invalid is not None:
                error = invalid_error(node, result, _counts(total, batch), batch, noiseless=True)
                if error is not None:
                    raise error
            log = None
            if result.noiseless is not None:
                log = point_log_density(model, name, result, values)
            if log is None:
                log = model.log_density(name, result, values[name])
            if mask is not None:
                log = np.where(_behind_time(mask), log, 0.0)
            total = total + summed(np.asarray(log), node, layout.apart)
        if is_mode and name in observed:
            seen = observed[name]
            off = values[name] != _behind_time(seen.value)
            if seen.mask is not None:
                off = off & _behind_time(seen.mask)
            total = total + summed(np.where(off, -np.inf, 0.0), node, layout.apart)
    return total


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


def _behind_time(array: np.ndarray) -> np.ndarray:
    return array.reshape(len(array), 1, 1, *array.shape[1:])


def _counts(total: np.ndarray, batch: tuple[int, ...]) -> np.ndarray:
    """Which parts of a batch are possible so far."""
    single = tuple(axis for axis in range(3) if not batch or batch[axis] == 1)
    largest = np.max(total.reshape(*total.shape[:3], -1), axis=3)
    possible = np.max(largest, axis=single, keepdims=True) > -np.inf
    return np.broadcast_to(possible, batch) if batch else possible.reshape(())


def _rows(seen: Observed, part: slice) -> Observed:
    """Some rows of what is seen."""
    return Observed(seen.value[part], None if seen.mask is None else seen.mask[part])
