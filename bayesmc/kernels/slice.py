"""Slice sampling of numbers, all chains and all elements at once.

References
----------
Neal (2003), Slice sampling, Annals of Statistics 31, sections 4.1 (stepping out, shrinkage) and 3 (integers).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.support import Support, is_half_line
from bayesmc.distributions.transforms import Transform, transform_of
from bayesmc.errors import DensityError
from bayesmc.kernels.base import TOLERANCE, Kernel, Memory
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.conditional import Conditional, conditional_of
from bayesmc.structure.target import Values

#: widths by which an interval may grow
_GROWTH = 64
#: evaluations that a move takes, about: both ends, two steps out, two shrinkages
EVALUATIONS = 6.0
#: shrinkages after which the density cannot be what it was
_SHRINKAGES = 400
#: shrunk intervals tried in one call, for arrays up to a size where calls cost more than numbers
_AHEAD = 4
_SMALL = 4096


def slice_move(
    log_density: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    width: np.ndarray,
    rng: np.random.Generator,
    low: Any = -np.inf,
    high: Any = np.inf,
    growth: int = _GROWTH,
) -> np.ndarray:
    """One step from every element of ``x``, each on its own slice.

    Parameters
    ----------
    log_density : callable
        Log densities, up to a constant, at an array of the shape of ``x``, or with an axis in front.
    width : ndarray
        Size of the first interval, broadcasts to ``x``.
    low, high : float or ndarray
        Bounds of the support.
    growth : int
        Widths by which an interval may grow; 0 where the first holds everything.

    Raises
    ------
    DensityError
        The density at ``x`` itself is zero, or no point was found.
    """
    left = x - width * rng.random(x.shape)
    ends = np.stack([x, left, left + width])
    bounds = np.stack([np.broadcast_to(low, x.shape), np.broadcast_to(high, x.shape)])
    inside = (ends > bounds[0]) & (ends < bounds[1])
    inside[0] = True
    found = log_density(np.where(inside, ends, x))
    if not (found[0] > -np.inf).all():
        raise DensityError("the density is zero at the chain's own value")
    level = found[0] - rng.standard_exponential(x.shape)
    ends, going = ends[1:], (found[1:] > level) & inside[1:]
    step = np.stack([np.broadcast_to(-width, x.shape), np.broadcast_to(width, x.shape)])
    # the growth that is allowed is split at random, so that the way back is as likely
    first = np.floor(growth * rng.random(x.shape))
    left_over = np.stack([first, growth - 1 - first])
    while True:
        going &= left_over > 0
        if not going.any():
            break
        ends = np.where(going, ends + step, ends)
        left_over = left_over - going
        going &= (ends > bounds[0]) & (ends < bounds[1])
        if not going.any():
            break
        going &= log_density(np.where(going, ends, x)) > level
    left, right = np.clip(ends, bounds[0], bounds[1])
    return _shrink(log_density, x, level, left, right, rng)


def _shrink(
    log_density: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    level: np.ndarray,
    left: np.ndarray,
    right: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draws from the intervals, shrunk towards ``x`` at every miss, until all have hit.

    Where the next interval lies does not depend on the density, so small arrays try several in one call.
    """
    ahead = _AHEAD if x.size <= _SMALL else 1
    result = x
    open_ = np.ones(x.shape, dtype=bool)
    for _ in range(_SHRINKAGES // ahead):
        tried = np.empty((ahead, *x.shape))
        for k in range(ahead):
            tried[k] = left + rng.random(x.shape) * (right - left)
            below = tried[k] < x
            left = np.where(below, tried[k], left)
            right = np.where(below, right, tried[k])
        good = log_density(np.where(open_, tried, x)) > level
        for k in range(ahead):
            hit = open_ & good[k]
            result = np.where(hit, tried[k], result)
            open_ = open_ & ~hit
        if not open_.any():
            return result
    raise DensityError(
        "slice sampling found no point at least as likely as the chain's own; the log density changes "
        "from call to call, or is NaN nearby"
    )


@dataclass(frozen=True, eq=False)
class _Line:
    """What one component moves along: its numbers, their logs, an angle, or the cells of integers.

    Attributes
    ----------
    start, end : ndarray
        Bounds of the numbers; a density may be infinite there, which rounding can reach.
    here : ndarray
        Where it is, which is taken in place of numbers that are not inside.
    """

    is_integer: bool
    on_logs: bool
    circle: Transform | None
    start: Any
    end: Any
    here: np.ndarray

    def value(self, at: np.ndarray) -> np.ndarray:
        """The component's value at places along the line."""
        if self.is_integer:
            return np.floor(at)
        if self.on_logs:
            return self.start + np.exp(at)
        # what depends on an angle need not repeat itself beyond the cut
        return at if self.circle is None else self.circle.constrain(at)

    def candidate(self, at: np.ndarray, dtype: np.dtype) -> tuple[np.ndarray, Any]:
        """The value to be tried at places, and what its log density lacks there, if anything."""
        found = self.value(at)
        if self.is_integer:
            return found.astype(dtype), None
        inside = (found > self.start) & (found < self.end)
        volume = np.where(inside, at if self.on_logs else 0.0, -np.inf)
        return np.where(inside, found, self.here), volume


class Slice(Kernel):
    """Slice sampling of a node of numbers; components of a vector one after the other.

    Parameters
    ----------
    blanket : Blanket
    debug : bool
        Hold the program of its full conditional against the model's functions wherever it is asked.
    """

    label = "slice"

    def __init__(self, blanket: Blanket, debug: bool = False) -> None:
        self.blanket, self.debug = blanket, debug
        self.names = (blanket.name,)
        self.is_integer = blanket.node.is_discrete
        support = blanket.node.support
        self.on_logs = support is not None and is_half_line(support)
        self.components = tuple(np.ndindex(blanket.event_shape))
        turns = 1 if blanket.broadcasts else len(blanket.classes)  # each asks for whole terms
        self.evaluations = EVALUATIONS * len(self.components) * turns

    def start(self, values: Values, chains: int) -> Memory:
        spread = np.ones(values[self.blanket.name].shape[1:])
        return {"width": spread, "moved": np.zeros_like(spread), "count": 0}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket = self.blanket
        name = blanket.name
        state = values
        for members in blanket.classes:
            for component in self.components:
                new = self._move(state, members, component, memory, rng)
                state = {**state, name: blanket.moved(state, new, members)}
        if warmup:
            low = blanket.node.support.low if self.on_logs else None  # type: ignore[union-attr]
            ends = (values[name], state[name])
            before, after = ends if low is None else (np.log(end - low) for end in ends)
            memory = self._adapted(memory, before, after)
        return {name: state[name]}, memory

    def _move(
        self,
        values: Values,
        members: np.ndarray | None,
        component: tuple[int, ...],
        memory: Memory,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """The node's value (of a class) with one component moved."""
        blanket = self.blanket
        now = blanket.current(values, members)
        at: Any = (Ellipsis, *component)
        x = now[at].astype(float)
        width = memory["width"][at]
        if members is not None:
            width = width.ravel()[members]
        support = self._support(values, component)
        low, high = self._bounds(support, members)
        growth, circle = _GROWTH, transform_of(support) if support.kind == "circle" else None
        if circle is not None:  # one turn holds everything
            width, growth = np.full(width.shape, 2 * np.pi), 0
        if self.is_integer:  # a number uniform in the cell of each integer
            x = x + rng.random(x.shape)
            high = high + 1.0
        line = _Line(self.is_integer, self.on_logs, circle, low, high, x)
        if self.on_logs:  # scales differ by factors: near zero an additive step would take forever
            x = np.log(x - low)
            low, high = -np.inf, np.inf

        full_conditional = self._full_conditional(values, members)

        def log_density(tried: np.ndarray) -> np.ndarray:
            candidate, volume = line.candidate(tried, now.dtype)
            if component:
                whole = np.array(np.broadcast_to(now, tried.shape + blanket.event_shape))
                whole[at] = candidate
                candidate = whole
            log = full_conditional(candidate)
            return np.broadcast_to(log if volume is None else log + volume, tried.shape)

        try:
            moved = slice_move(log_density, x, width, rng, low, high, growth)
        except DensityError as error:
            if f"{blanket.name!r}" in str(error):
                raise
            raise DensityError(f"node {blanket.name!r}: {error}", error.index) from error
        moved = line.value(moved)
        if not component:
            return moved.astype(now.dtype, copy=False)
        new = now.copy()
        new[at] = moved
        return new

    def _full_conditional(
        self, values: Values, members: np.ndarray | None
    ) -> Callable[[np.ndarray], np.ndarray]:
        """The log full conditional as a program, where it can be had and gives numbers."""
        at = None if self._conditional is None else self._conditional.given(values)

        def log_density(candidate: np.ndarray) -> np.ndarray:
            log = None if at is None else at(candidate)
            if log is None or not np.isfinite(log).all():  # what that means the functions know
                return self.blanket.log_density(values, candidate, members)
            if self.debug:
                self._check(log, self.blanket.log_density(values, candidate, members))
            return log

        return log_density

    @cached_property
    def _conditional(self) -> Conditional | None:
        return conditional_of(self.blanket)

    def _check(self, log: np.ndarray, wanted: np.ndarray) -> None:
        """Refuse a program that does not say what the model's functions say."""
        apart = np.abs(log - wanted).max()
        if not apart <= TOLERANCE * (1.0 + np.abs(log).max()):
            raise DensityError(
                f"node {self.blanket.name!r}: the program of its full conditional is off by {apart:.3g}; "
                "please report the model"
            )

    def _support(self, values: Values, component: tuple[int, ...]) -> Support:
        """Where one component may lie, given the parents."""
        blanket = self.blanket
        if blanket.own is None:
            support = blanket.node.support
        else:
            support = blanket.own.distribution(values)[0].support
        assert support is not None
        return _part(support, component[0]) if support.kind == "product" else support

    def _bounds(self, support: Support, members: np.ndarray | None) -> tuple[Any, Any]:
        """Bounds of a support, broadcasting to ``(chains, *plates)`` or the class."""
        blanket = self.blanket
        if support.kind not in ("interval", "integers"):
            return -np.inf, np.inf
        ends = []
        for end in (support.low, support.high):
            end = np.asarray(end, dtype=float)
            if members is not None and end.ndim:
                lead = end.shape[: max(end.ndim - len(blanket.node.plates), 0)]
                end = np.broadcast_to(end, lead + blanket.node.plate_shape)
                end = end.reshape(*lead, -1)[..., members]
            ends.append(end)
        return ends[0], ends[1]

    def _adapted(self, memory: Memory, before: np.ndarray, after: np.ndarray) -> Memory:
        """Widths follow how far steps go: about three times the mean, which is near the slice's size."""
        count = memory["count"] + 1
        step = np.abs(after.astype(float) - before).mean(axis=0)
        rate = max(1.0 / count, 0.02)
        moved = (1 - rate) * memory["moved"] + rate * step
        width = np.where(moved > 0, 3.0 * moved, memory["width"])
        if self.is_integer:
            width = np.maximum(np.ceil(width), 1.0)
        return {"width": width, "moved": moved, "count": count}


# ---- private ------------------------------------------------------------------------------------


def _part(support: Support, component: int) -> Support:
    """The support of one component of a product."""
    for part, size in support.parts:
        component -= max(size, 1)
        if component < 0:
            return part
    raise AssertionError("a product has a part for every component")
