"""Slice sampling of numbers, all chains and all elements at once.

References
----------
Neal (2003), Slice sampling, Annals of Statistics 31, sections 4.1 (stepping out, shrinkage) and 3 (integers).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.transforms import transform_of
from bayesmc.errors import DensityError, TraceError
from bayesmc.kernels.base import ANYHOW, TOLERANCE, How, Kernel, Memory
from bayesmc.kernels.compiled_slice import CompiledSlice, Streams, compare, why_not
from bayesmc.kernels.slice_sites import Line, Sites
from bayesmc.lowering import is_available, is_worth_it
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.conditional import At, Conditional, conditional_or_reason
from bayesmc.structure.target import Values

#: widths by which an interval may grow
GROWTH = 64
#: evaluations that a move takes, about: both ends, two steps out, two shrinkages
EVALUATIONS = 6.0
#: shrinkages after which the density cannot be what it was
_SHRINKAGES = 400
#: shrunk intervals tried in one call, for arrays up to a size where calls cost more than numbers
_AHEAD = 4
_SMALL = 4096
#: steps in NumPy of a move, besides those of the density, for each time that it is asked
BESIDE = 40


def slice_move(
    log_density: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    width: np.ndarray,
    rng: np.random.Generator,
    low: Any = -np.inf,
    high: Any = np.inf,
    growth: int = GROWTH,
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


class Slice(Kernel):
    """Slice sampling of a node of numbers; components of a vector one after the other.

    Parameters
    ----------
    blanket : Blanket
    debug : bool
        Hold the program of its full conditional against the model's functions wherever it is asked, and
        every move in machine code against that in NumPy.
    how : How
        Whether moves are machine code.
    reads_data : bool
        Whether what is known is read from the state: for like nodes as one, whose data differ.

    Notes
    -----
    Which of both a run began with is part of the memory, so that a resumed run draws the same numbers. Where
    machine code is to be had no more, NumPy draws them.
    """

    label = "slice"

    def __init__(
        self,
        blanket: Blanket,
        debug: bool = False,
        how: How = ANYHOW,
        reads_data: bool = False,
    ) -> None:
        self.blanket, self.debug, self.how = blanket, debug, how
        self.reads_data = reads_data
        self._expects = False
        self._made: tuple[Any, Any, CompiledSlice | str] | None = None
        self.names = (blanket.name,)
        self.components = tuple(np.ndindex(blanket.event_shape))
        turns = 1 if blanket.broadcasts else len(blanket.classes)  # each asks for whole terms
        self.evaluations = EVALUATIONS * len(self.components) * turns

    def expect(self, steps: int, chains: int) -> None:
        """Moves are machine code where so many steps pay for it."""
        self._expects = self._pays(steps, chains)

    def told(self, steps: int, chains: int) -> str:
        if not is_available() or not self._pays(steps, chains):
            return ""
        found = self._followed
        why = found if isinstance(found, str) else why_not(found.root, found.name)
        return f"slices in NumPy: {why}" if why else "in machine code"

    def start(self, values: Values, chains: int) -> Memory:
        spread = np.ones(values[self.blanket.name].shape[1:])
        machine = self._expects and isinstance(self._code, CompiledSlice)
        return {"width": spread, "moved": np.zeros_like(spread), "count": 0, "machine": machine}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        name = self.blanket.name
        if memory.get("machine"):
            new, memory = self._by_machine(values, memory, rng)
        else:
            new = self._by_numpy(values, memory, rng)
        if warmup:
            low = self.blanket.node.support.low if self.sites.on_logs else None  # type: ignore[union-attr]
            ends = (values[name], new)
            before, after = ends if low is None else (np.log(end - low) for end in ends)
            memory = self._adapted(memory, before, after)
        return {name: new}, memory

    # ---- private -------------------------------------------------------------------------------

    def _pays(self, steps: int, chains: int) -> bool:
        """Whether so many steps take longer in NumPy than compiling."""
        if self.how.compiled is not None:
            return self.how.compiled
        if isinstance(self._followed, str):
            return False
        calls = int(self.evaluations * steps)
        return is_worth_it([self._followed.root], calls, chains, BESIDE)

    @property
    def sites(self) -> Sites:
        """What moves when."""
        return Sites(self.blanket, self.components)

    @property
    def _code(self) -> CompiledSlice | str:
        """Its moves in machine code, or why there are none."""
        if isinstance(self._followed, str):
            return self._followed
        made, classes, components = self._made, self.blanket.classes, self.components
        if made is None or made[0] is not classes or made[1] is not components:
            self._made = made = classes, components, self._compiled(self._followed)
        return made[2]

    def _compiled(self, conditional: Conditional) -> CompiledSlice | str:
        try:
            turns = self.sites.turns_in_machine_code(GROWTH)
            return CompiledSlice(conditional, turns, self.how.threads)
        except TraceError as error:
            return str(error)

    def _by_machine(
        self, values: Values, memory: Memory, rng: np.random.Generator
    ) -> tuple[np.ndarray, Memory]:
        """New values by machine code, where it says what NumPy does."""
        chains = math.prod(self.sites.lead(values))
        turns = len(self.blanket.classes) * len(self.components)
        seeds = rng.integers(0, 1 << 64, (chains, turns, 4), np.uint64)
        code = self._code
        if isinstance(code, str) or not code.conditional.knows(values):
            return self._by_numpy(values, memory, seeds), memory
        if code.differs:  # as the run in which that was found went on
            wanted = self._by_numpy(values, memory, seeds, is_checking=True)
            return wanted, {**memory, "machine": False}

        def ask(chain: int, value: np.ndarray) -> np.ndarray:
            return self._asked(values, chain, value)

        try:
            found = code(values, *self._intervals(code, values, memory["width"]), seeds, ask)
        except DensityError as error:
            raise self._of_node(error) from error
        if not (self.debug or not code.is_checked):
            return found, memory
        wanted = self._by_numpy(values, memory, seeds, is_checking=True)
        code.differs = compare(found, wanted, memory["width"])
        if code.differs and self.debug:
            raise DensityError(f"node {self.blanket.name!r}: {code.differs}")
        code.is_checked = True
        return (wanted, {**memory, "machine": False}) if code.differs else (found, memory)

    def _intervals(
        self, code: CompiledSlice, values: Values, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Widths and bounds: those of the last move, where neither can have changed."""
        key = width, self.sites.lead(values)
        last: Any = code.intervals
        if last is None or last[0][0] is not width or last[0][1] != key[1]:
            found = self.sites.intervals(values, width)
            last = key, found
            if self.blanket.node.support is not None:
                code.intervals = last
        return last[1]

    def _asked(self, values: Values, chain: int, value: np.ndarray) -> np.ndarray:
        """Log densities of one chain by the model's functions, where its elements stand at a value."""
        state = self._row(values, np.unravel_index(chain, self.sites.lead(values)))
        # elements of earlier turns have moved, and those of later ones read them
        state[self.blanket.name] = value.astype(values[self.blanket.name].dtype)[None]
        shape = self.blanket.node.plate_shape
        found = np.zeros(shape).reshape(-1)
        for members in self.blanket.classes:
            at: Any = slice(None) if members is None else members
            flat = value.reshape(-1, *self.blanket.event_shape)
            candidate = (value if members is None else flat[at])[None]
            log = self.blanket.log_density(state, candidate, members)
            own = shape if members is None else (len(at),)
            found[at] = np.broadcast_to(log.reshape(log.shape[log.ndim - len(own) :]), own).ravel()
        return found

    def _row(self, values: Values, at: tuple[Any, ...]) -> Values:
        """The state of one chain (of one of like nodes), an axis of size 1 before the plates."""
        target, found = self.blanket.target, dict[str, np.ndarray]()
        for name, value in values.items():
            if name in target.model.nodes:
                axes = np.ndim(value) - len(target.model[name].value_shape)
                # known values have no chains; what all share has an axis of size 1
                own = at[len(at) - axes :] if axes else ()
                place = tuple(int(min(k, n - 1)) for k, n in zip(own, value.shape, strict=False))
                found[name] = value[place][None] if axes else value
        return found

    def _of_node(self, error: DensityError) -> DensityError:
        """An error that names the node."""
        if f"{self.blanket.name!r}" in str(error):
            return error
        return DensityError(f"node {self.blanket.name!r}: {error}", error.index)

    def _by_numpy(
        self,
        values: Values,
        memory: Memory,
        rng: np.random.Generator | np.ndarray,
        is_checking: bool = False,
    ) -> np.ndarray:
        """New values; by the numbers that machine code draws where its seeds are given.

        Parameters
        ----------
        rng : Generator or ndarray, shape (chains, turns, 4)
        is_checking : bool
            Ask the model's own functions alone.
        """
        name, state = self.blanket.name, values
        for turn, (members, component) in enumerate(self.sites.turns()):
            own = Streams(rng[:, turn]) if isinstance(rng, np.ndarray) else rng
            new = self._move(state, members, component, memory, own, is_checking)
            state = {**state, name: self.blanket.moved(state, new, members)}
        return state[name]

    def _move(
        self,
        values: Values,
        members: np.ndarray | None,
        component: tuple[int, ...],
        memory: Memory,
        rng: Any,
        is_checking: bool = False,
    ) -> np.ndarray:
        """The node's value (of a class) with one component moved."""
        blanket = self.blanket
        now = blanket.current(values, members)
        at: Any = (Ellipsis, *component)
        x = now[at].astype(float)
        width = memory["width"][at]
        if members is not None:
            width = width.ravel()[members]
        support = self.sites.support(values, component)
        low, high = self.sites.bounds(support, members)
        growth, circle = GROWTH, transform_of(support) if support.kind == "circle" else None
        if circle is not None:  # one turn holds everything
            width, growth = np.full(width.shape, 2 * np.pi), 0
        if self.sites.is_integer:  # a number uniform in the cell of each integer
            x = x + rng.random(x.shape)
            high = high + 1.0
        line = Line(self.sites.is_integer, self.sites.on_logs, circle, low, high, x)
        if (
            self.sites.on_logs
        ):  # scales differ by factors: near zero an additive step would take forever
            x = np.log(x - low)
            low, high = -np.inf, np.inf

        full_conditional = self._full_conditional(values, members, is_checking)

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
            raise self._of_node(error) from error
        moved = line.value(moved)
        if not component:
            return moved.astype(now.dtype, copy=False)
        new = now.copy()
        new[at] = moved
        return new

    def _full_conditional(
        self, values: Values, members: np.ndarray | None, is_checking: bool
    ) -> Callable[[np.ndarray], np.ndarray]:
        """The log full conditional as a program, where it can be had and gives numbers."""
        is_opaque = is_checking or isinstance(self._followed, str)
        at = None if is_opaque else self._followed.given(values)  # type: ignore[union-attr]

        def log_density(candidate: np.ndarray) -> np.ndarray:
            log = None if at is None else self._of_class(at, values, candidate, members)
            if log is None or not np.isfinite(log).all():  # what that means the functions know
                return self.blanket.log_density(values, candidate, members)
            if self.debug:
                self._check(log, self.blanket.log_density(values, candidate, members))
            return log

        return log_density

    def _of_class(
        self, at: At, values: Values, candidate: np.ndarray, members: np.ndarray | None
    ) -> np.ndarray:
        """The program's answer for the elements that move."""
        log = at(self.blanket.filled(values, candidate, members))
        if members is None:
            return log
        lead = log.shape[: log.ndim - len(self.blanket.node.plates)]
        return log.reshape(*lead, -1)[..., members]

    @cached_property
    def _followed(self) -> Conditional | str:
        return conditional_or_reason(self.blanket, self.reads_data)

    def _check(self, log: np.ndarray, wanted: np.ndarray) -> None:
        """Refuse a program that does not say what the model's functions say."""
        apart = np.abs(log - wanted).max()
        if not apart <= TOLERANCE * (1.0 + np.abs(log).max()):
            raise DensityError(
                f"node {self.blanket.name!r}: the program of its full conditional is off by {apart:.3g}; "
                "please report the model"
            )

    def _adapted(self, memory: Memory, before: np.ndarray, after: np.ndarray) -> Memory:
        """Widths follow how far steps go: about three times the mean, which is near the slice's size."""
        count = memory["count"] + 1
        step = np.abs(after.astype(float) - before).mean(axis=0)
        rate = max(1.0 / count, 0.02)
        moved = (1 - rate) * memory["moved"] + rate * step
        width = np.where(moved > 0, 3.0 * moved, memory["width"])
        if self.sites.is_integer:
            width = np.maximum(np.ceil(width), 1.0)
        return {**memory, "width": width, "moved": moved, "count": count}
