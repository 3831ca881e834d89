"""The step of a particle filter as machine code: slices whose densities can be followed, weights, resampling.

Random numbers are those that NumPy's generator would hand out, in the order in which the steps of a slice
draw them, so that a seed gives the same particles to rounding. Whatever is out of the ordinary (a parameter
out of range, a weight that is no number) is done again by the plain steps, which say what is wrong.

The machine code of each kind of slice is held against the plain steps before its first use.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME, Row, SeriesProblem
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.made import MadeSlices, Store
from bayesmc.engines.particles.smc import Particles, Selection
from bayesmc.engines.particles.tracking import FADING, KEPT, LEAST, Tracker
from bayesmc.engines.slice_densities import SliceDensities, read_slice
from bayesmc.engines.slice_program import agree, plainly
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import TraceError
from bayesmc.expression import Leaf
from bayesmc.lowering import (
    NO_NUMBERS,
    Cloud,
    Kernel,
    Noise,
    Numbers,
    SliceCall,
    SliceKernel,
    is_available,
    known_column,
)
from bayesmc.resampling import stratified, systematic

#: seconds in NumPy of a slice, and of a particle in it, below a tenth of which nothing is compiled
_SLICE, _PARTICLE, _WORTH = 1e-4, 4e-8, 0.1
#: seconds that a program saves of a slice, and of a particle in it; and that reading its densities takes
_CALLS, _PASSES, _READ = 6e-5, 4e-9, 5e-3
#: seconds that machine code saves of a slice, and of a particle in it; that loading some takes, and llvmlite
_SAVED, _PER_PARTICLE, _LOAD, _IMPORT = 5e-5, 1e-8, 0.02, 0.02
#: machine code, where it is kept with a model
_KEPT = "compiled slices"
#: numbers of an array of slices that are made in one call, and such slices, at most
_NUMBERS, _TOGETHER = 1 << 17, 100


def compiled_step(step: FilterStep, steps: int, compiled: bool | None = None) -> FilterStep:
    """A step whose slices are programs of NumPy's, or machine code, where that pays; the same object.

    Parameters
    ----------
    step : FilterStep
    steps : int
        How many slices it will make.
    compiled : bool, optional
        Whether they are machine code; by default where that pays.
    """
    saved = steps * (_CALLS + _PASSES * step.layout.particles)
    step.plan.is_read = saved > _READ
    if _why_not(step, steps, compiled) is None:
        step.machine = SliceCode(step, only_kept=compiled is None and _is_short(step, steps))
    return step


def is_worth_compiling(particles: int, steps: int) -> bool:
    """Whether so many slices take long enough for machine code to pay, whatever is loaded already."""
    return steps * (_SLICE + _PARTICLE * particles) >= _WORTH


def told(step: FilterStep, problem: SeriesProblem, compiled: bool | None = None) -> str:
    """What makes the slices of a series, and why nothing faster does; nothing where that is no question."""
    if compiled is None and (not is_available() or _is_short(step, problem.steps)):
        return ""
    reason = _why_not(step, problem.steps, compiled)
    row = problem.series.row(problem.steps - 1)
    try:
        if reason is None and any(seen.mask is not None for seen in row.seen.values()):
            reason = "nodes that are seen in part are made by plain steps"
        if reason is None:
            chosen = frozenset(previous for _, previous in step.before)
            read = _read(step, row)
            roots, own = [*read.values.values(), read.flagged], {z.noise for z in read.drawn}
            Kernel(roots, chosen | own, chosen)  # refuses what has no machine code
    except TraceError as error:
        reason = str(error)
    if reason is not None:
        return f"slices in NumPy: {reason}"
    return "slices as machine code" + ("" if _resamples(step) else ", but for resampling")


class SliceCode:
    """Particles of a slice by machine code, or of several slices in a row.

    Parameters
    ----------
    step : FilterStep
    only_kept : bool, optional
        Take what an earlier run has compiled, and compile nothing.

    Attributes
    ----------
    refused : dict
        What kind of slice is not machine code -> why.
    """

    def __init__(self, step: FilterStep, only_kept: bool = False) -> None:
        self._step, self._only_kept = step, only_kept
        self._made: dict[Any, _Slice | None] = {}
        self.refused: dict[Any, str] = {}

    def __call__(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> Particles | None:
        """None where the plain steps must do it; the generator is then where it was."""
        made = self._of(row, before, selection, rng)
        return None if made is None else made.one(row, before, selection, rng)

    def several(
        self,
        problem: SeriesProblem,
        k: int,
        earlier: Particles | None,
        rng: np.random.Generator,
        beside: Callable[[], tuple[Tracker, Families] | None],
    ) -> MadeSlices | None:
        """As many slices from the k-th one on as can be made in one call; None where it is to be made alone.

        Where ``beside`` says that families are followed, moments are taken if those say all.
        """
        step = self._step
        if earlier is None or not _resamples(step):
            return None
        row = problem.series.row(k)
        before = {previous: earlier.values[n] for n, previous in step.before}
        n = len(earlier.weights)
        everyone = Selection(n, None, False, earlier.log_weights, earlier.log_total)
        made = self._of(row, before, everyone, rng)
        if made is None:
            return None
        found = made.several(problem, k, earlier, before, rng, beside())
        return found if len(found) else None

    # ---- private -------------------------------------------------------------------------------

    def _of(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> _Slice | None:
        """The machine code of a kind of slice, if there is any that is right."""
        ranks = self._step.ranks
        chosen = frozenset(n for n, v in before.items() if v.ndim == ranks[n])
        key = (row.t == 0, chosen, *row.seen)
        if any(seen.mask is not None for seen in row.seen.values()):
            return None
        if key not in self._made:
            self._made[key] = None
            try:
                made = _Slice(self._step, row, chosen, self._only_kept)
                if not made.is_right:
                    made.hold(row, before, selection, rng)
                self._made[key] = made
            except TraceError as error:
                self.refused[key] = str(error)
            except (
                Exception
            ):  # the plain steps break on what was tried: perhaps not on the next slice
                del self._made[key]
                return None
        return self._made[key]


# ---- private ------------------------------------------------------------------------------------


def _why_not(step: FilterStep, steps: int, compiled: bool | None) -> str | None:
    if compiled is False:
        return "compiled=False"
    if not is_available():
        return "there is no llvmlite: pip install bayesmc[fast]"
    if compiled is None and _is_short(step, steps) and not _is_at_hand(step, steps):
        return "it takes no time"
    if step.layout.apart or step.injection is not None or type(step.plan) is not SlicePlan:
        return "plates apart, injection and proposals are made by plain steps"
    return "proposals are made by plain steps" if step.plan.guided else None


def _is_short(step: FilterStep, steps: int) -> bool:
    return not is_worth_compiling(step.layout.particles, steps)


def _is_at_hand(step: FilterStep, steps: int) -> bool:
    """Whether machine code is loaded, or would be loaded in less time than it saves."""
    if step.slices.later.cache.get(_KEPT):
        return True
    load = _LOAD if "llvmlite" in sys.modules else _LOAD + _IMPORT
    return steps * (_SAVED + _PER_PARTICLE * step.layout.particles) > load


def _resamples(step: FilterStep) -> bool:
    """Whether machine code decides on offspring."""
    known = step.resample in (systematic, stratified)
    return known and step.first_stage is None and step.counts is None


def _read(step: FilterStep, row: Row) -> SliceDensities:
    return read_slice(step.slices.model(row.t), step.slices.dynamic, row.seen, step.kept)


class _Slice:
    """One kind of slice."""

    def __init__(self, step: FilterStep, row: Row, chosen: frozenset[str], only_kept: bool) -> None:
        self._step, model = step, step.slices.model(row.t)
        kept = model.cache.setdefault(_KEPT, {})  # the next series finds it there
        key = (frozenset(row.seen), step.kept, chosen)
        if key not in kept:
            read = _read(step, row)
            roots, noises = [*read.values.values(), read.flagged], read.drawn
            own = {z.noise: Noise(z.shape, z.is_uniform) for z in noises}
            kernel = SliceKernel(roots, own, chosen, only_kept)
            kept[key] = [list(read.values), kernel, False]
        self._kept = kept[key]
        self._names, self._kernel, _ = self._kept
        self._rest = [n for n in step.kept if n not in self._names]
        previous = dict(step.before)
        leaves = [p if (p := previous.get(n)) in chosen else None for n in self._names]
        self._call = SliceCall(self._kernel, leaves, step.layout.particles, step.layout.block)
        #: whether the slice after it reads what it reads
        self._goes_on = chosen == {previous[n] for n in self._names if n in previous}
        self._wide = max(math.prod(shape) for shape in self._kernel.shapes)
        self._columns: list[tuple[np.ndarray, int]] | None = None
        self._store = Store()

    @property
    def is_right(self) -> bool:
        """Whether it was held against the plain steps."""
        return self._kept[2]

    def hold(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> None:
        """Hold it against the plain steps, with ancestors and weights that are unlike each other.

        Raises
        ------
        TraceError
            It gives something else.
        """
        step, n, state = self._step, selection.particles, rng.bit_generator.state
        most = max((len(v) for k, v in before.items() if v.ndim == step.ranks[k]), default=n)
        ancestors = np.arange(n) * (most - 1) // max(n, 2)
        tried = Selection(n, ancestors if before else None, False, np.arange(n) % 7 / 7.0, 0.5)
        try:
            found = self.one(row, before, tried, rng)
            used, rng.bit_generator.state = plainly(rng.bit_generator.state), state
            values, log = step.propagated(step.steps(row), row, before, tried, rng)
            wanted = step.weighted(row, values, log, tried)
            same = used == plainly(rng.bit_generator.state)
        finally:
            rng.bit_generator.state = state
        if found is None:
            raise TraceError("it gives no numbers in the first slice")
        same = same and agree((found.values, found.log_weights), (values, wanted.log_weights))
        if not same or not math.isclose(found.increment, wanted.increment, abs_tol=1e-9):
            raise TraceError("it gives other particles than the plain steps")
        self._kept[2] = True

    def one(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> Particles | None:
        """One slice whose ancestors are chosen; None where it cannot be done."""
        n, known = selection.particles, self._step.known(row)
        columns = [
            known_column(leaf, known[leaf.name] if leaf.name in known else before[leaf.name])
            for leaf in self._kernel.known
        ]
        log = np.ascontiguousarray(np.broadcast_to(selection.log_weights, n), float)
        rows = selection.ancestors
        cloud = Cloud(before, log, log, 1.0, selection.log_normaliser, math.inf, rows=rows)
        shapes: list[Any] = [(), (), *self._kernel.shapes]
        own = [self._step.room((n, *shape)) for shape in shapes]
        arrays = [a[None] for a in own]
        arrays.insert(2, np.empty((1, n + 1), np.int64))
        addresses = [(a.ctypes.data, 0) for a in columns]
        made = self._call(-math.inf, cloud, addresses, arrays, rng)
        if not made.slices:
            return None
        total, log_total, ess, increment = made.told[1, :4].tolist()
        for array in own[2:]:
            array.flags.writeable = n > self._step.layout.block  # large ones are used again
        values = {**dict(zip(self._names, own[2:], strict=True)), **self._others(row)}
        return Particles(
            row.t, values, own[0], own[1], total, log_total, increment, ess, selection.ancestors,
            selection.resampled,
        )  # fmt: skip

    def several(
        self,
        problem: SeriesProblem,
        k: int,
        earlier: Particles,
        before: Mapping[str, np.ndarray],
        rng: np.random.Generator,
        beside: tuple[Tracker, Families] | None,
    ) -> MadeSlices:
        """Slices from the k-th one on, as many as are of this kind."""
        step, n = self._step, len(earlier.weights)
        leaves, series = [leaf.name for leaf in self._kernel.known], problem.series
        agreed = any(
            p in before and p.removesuffix(PREVIOUS) not in series.observed for p in leaves
        )
        if self._columns is None or agreed:
            self._columns = [self._column(problem, leaf, before) for leaf in self._kernel.known]
        goes_on = self._goes_on and not agreed
        most = max(1, min(_TOGETHER, _NUMBERS // (n * self._wide))) if goes_on else 1
        count, store = problem.series.alike(k, most), self._store
        log, weights = (np.ascontiguousarray(a) for a in (earlier.log_weights, earlier.weights))
        cloud = Cloud(before, log, weights, earlier.total, earlier.log_total, earlier.ess)
        numbers = None if beside is None else self._numbers(beside[0])
        if numbers is not None and beside is not None:
            drift = beside[1].drift
            if drift is not None:
                moves = np.zeros((2, len(numbers.where)))
                moves[:, numbers.where[:, 3] > 0] = drift.moves[:, 0]
                cloud = cloud._replace(worst=drift.largest, moves=moves)
        known = [(a.ctypes.data + k * size, size) for a, size in self._columns]
        values = [store((count, n, *shape)) for shape in self._kernel.shapes]
        arrays = [store((count, n)), store((count, n)), store((count, n + 1), np.int64), *values]
        strata = step.resample is stratified
        made = self._call(
            step.threshold * n, cloud, known, arrays, rng, numbers or NO_NUMBERS, strata
        )
        return MadeSlices(made, problem.series, k, arrays, self._names, self._rest, numbers)

    # ---- private -------------------------------------------------------------------------------

    def _others(self, row: Row) -> dict[str, np.ndarray]:
        """Values of nodes that all particles agree on."""
        known = self._step.known(row)
        return {name: known[name] for name in self._rest}

    def _numbers(self, tracker: Tracker) -> Numbers | None:
        """All numbers of nodes, and whose moves a tracker looks at; none where it takes others."""
        compass = tracker.compass
        moved = () if compass is None else tuple(n.name for n in compass.nodes)
        if not set(moved) <= set(self._names):
            return None
        where = [
            (3 + k, size, j, int(name in moved))
            for k, (name, shape) in enumerate(zip(self._names, self._kernel.shapes, strict=True))
            for size in (math.prod(shape),)
            for j in range(size)
        ]
        return Numbers(np.array(where, np.int64), FADING, KEPT, LEAST)

    def _column(
        self, problem: SeriesProblem, leaf: Leaf, before: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, int]:
        """A leaf's values in all slices of a series, and the bytes from one to the next.

        What particles of the slice before agree on, as it was computed there, is that of one slice.
        """
        series, name = problem.series, leaf.name
        times = series.start + np.arange(series.steps)
        every = {TIME: times, **series.inputs, **{n: o.value for n, o in series.observed.items()}}
        if name in every:
            found = every[name]
        elif name in before and name.removesuffix(PREVIOUS) not in every:
            return known_column(leaf, before[name]), 0
        elif name.endswith(PREVIOUS):
            found = every[name.removesuffix(PREVIOUS)]
            found = (
                np.concatenate([found[:1], found[:-1]]) if name != TIME + PREVIOUS else times - 1
            )
        else:
            return known_column(leaf, self._step.plan.static[name]), 0
        found = known_column(leaf, found)
        return found, found.strides[0]
