"""The step of a particle filter as machine code: slices whose densities can be followed, weights, resampling.

Normals come from NumPy's generator in the order in which the steps of a slice draw them, so that a seed gives
the same particles to rounding. Whatever is out of the ordinary (a parameter out of range, a weight that is no
number) is done again by the plain steps, which say what is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import Row, SeriesProblem
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.smc import Selection
from bayesmc.engines.slice_densities import SliceDensities, read_slice
from bayesmc.engines.slice_program import agree, plainly
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import TraceError
from bayesmc.lowering import Kernel, SliceKernel, is_available, weight_loops

#: seconds in NumPy of a slice, and of a particle in it, below a tenth of which nothing is compiled
_SLICE, _PARTICLE, _WORTH = 1e-4, 4e-8, 0.1
#: seconds that a program saves of a slice, and of a particle in it; and that reading its densities takes
_CALLS, _PASSES, _READ = 6e-5, 4e-9, 5e-3
#: machine code, where it is kept with a model
_KEPT = "compiled slices"


def compiled_step(step: FilterStep, steps: int, is_systematic: bool) -> FilterStep:
    """A step whose slices are programs of NumPy's, or machine code, where that pays; the same object.

    Parameters
    ----------
    step : FilterStep
    steps : int
        How many slices it will make.
    is_systematic : bool
        Whether it resamples by ``resampling.systematic``.
    """
    saved = steps * (_CALLS + _PASSES * step.layout.particles)
    step.plan.is_read = saved > _READ
    if _why_not(step, steps) is None:
        step.machine = SliceCode(step)
        if is_systematic:
            step.resample = _resampling(step.resample)
    return step


def told(step: FilterStep, problem: SeriesProblem, is_systematic: bool) -> str:
    """What makes the slices of a series, and why nothing faster does; nothing where that is no question."""
    if not is_available() or _is_short(step, problem.steps):
        return ""
    reason = _why_not(step, problem.steps)
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
    return "slices as machine code" + ("" if is_systematic else ", but for resampling")


class SliceCode:
    """Particles of a slice by machine code: values and log weights, as ``SMCStep.propagated`` gives them.

    Parameters
    ----------
    step : FilterStep

    Attributes
    ----------
    refused : dict
        What kind of slice is not machine code -> why.
    """

    def __init__(self, step: FilterStep) -> None:
        self._step = step
        self._made: dict[Any, _Slice | None] = {}
        self.refused: dict[Any, str] = {}

    def __call__(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any] | None:
        """None where the plain steps must do it; the generator is then where it was."""
        ranks = self._step.ranks
        chosen = frozenset(n for n, v in before.items() if v.ndim == ranks[n])
        key = (row.t == 0, chosen, *row.seen)
        if any(seen.mask is not None for seen in row.seen.values()):
            return None
        state = rng.bit_generator.state
        if key not in self._made:
            return self._tried(key, row, before, chosen, selection, rng)
        made = self._made[key]
        found = None if made is None else made(row, before, selection, rng)
        if found is None:
            rng.bit_generator.state = state
        return found

    def exponentials(
        self, log: np.ndarray, level: float, weights: np.ndarray
    ) -> tuple[float, float]:
        """Fill weights; their sum and that of their squares."""
        return weight_loops().exponentials(log, level, weights)

    # ---- private -------------------------------------------------------------------------------

    def _tried(
        self,
        key: Any,
        row: Row,
        before: Mapping[str, np.ndarray],
        chosen: frozenset[str],
        selection: Selection,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any]:
        """The first slice of a kind: plain, with the machine code held against it."""
        step, state = self._step, rng.bit_generator.state
        found = None
        try:
            made = _Slice(step, row, chosen)
            found = made(row, before, selection, rng)
            if found is None:
                raise TraceError("it gives no numbers in the first slice")
        except TraceError as error:
            self._made[key], self.refused[key] = None, str(error)
        used = plainly(rng.bit_generator.state)
        rng.bit_generator.state = state
        values, log = step.propagated(step.steps(row), row, before, selection, rng)
        if found is not None:
            same = used == plainly(rng.bit_generator.state) and agree(found, (values, log))
            self._made[key] = made if same else None
            if not same:
                self.refused[key] = "it gives other particles than the plain steps"
        return values, log


# ---- private ------------------------------------------------------------------------------------


def _why_not(step: FilterStep, steps: int) -> str | None:
    if not is_available():
        return "there is no llvmlite"
    if _is_short(step, steps):
        return "it takes no time"
    if step.layout.apart or step.injection is not None or type(step.plan) is not SlicePlan:
        return "plates apart, injection and proposals are made by plain steps"
    return "proposals are made by plain steps" if step.plan.guided else None


def _is_short(step: FilterStep, steps: int) -> bool:
    return steps * (_SLICE + _PARTICLE * step.layout.particles) < _WORTH


def _resampling(plain: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    def resample(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
        found = None
        if weights.ndim == 1 and weights.flags.c_contiguous:
            found = weight_loops().systematic(weights, draws, rng.random)
        return plain(weights, draws, rng) if found is None else found

    return resample


def _read(step: FilterStep, row: Row) -> SliceDensities:
    return read_slice(step.slices.model(row.t), step.slices.dynamic, row.seen, step.kept)


class _Slice:
    """One kind of slice."""

    def __init__(self, step: FilterStep, row: Row, chosen: frozenset[str]) -> None:
        self._step, model = step, step.slices.model(row.t)
        kept = model.cache.setdefault(_KEPT, {})  # the next series finds it there
        key = (frozenset(row.seen), step.kept, chosen)
        if key not in kept:
            read = _read(step, row)
            roots, noises = [*read.values.values(), read.flagged], {z.noise for z in read.drawn}
            kept[key] = read, SliceKernel(roots, frozenset(noises), chosen)
        read, kernel = kept[key]
        self._names = list(read.values)
        self._rest = [n for n in step.kept if n not in read.values]
        block = min(step.layout.block, step.layout.particles)
        self._noise = {z.noise: np.empty((block, *z.shape)) for z in read.drawn}
        self._call = kernel.call(self._noise)
        self._everyone = np.arange(step.layout.particles)

    def __call__(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any] | None:
        step, n, call = self._step, selection.particles, self._call
        rows = self._everyone[:n] if selection.ancestors is None else selection.ancestors
        known = step.known(row)
        found = call.begin(known, before, rows, step.room, n)
        size = step.layout.block
        for low in range(0, n, size):
            count = min(size, n - low)
            for noise in self._noise.values():
                rng.standard_normal(out=noise if count == len(noise) else noise[:count])
            if call(low, count):
                return None
        *arrays, log = found
        level = log.item(log.argmax())
        if not level < math.inf:  # true for NaN, too
            return None
        for array in arrays:
            array.flags.writeable = n > size  # large ones are used again
        values = dict(zip(self._names, arrays, strict=True))
        for name in self._rest:
            values[name] = known[name]
        return values, log if row.seen else 0.0
