"""The step of a particle filter as machine code: slices whose densities can be followed, weights, resampling.

Normals come from NumPy's generator in the order in which the steps of a slice draw them, so that a seed gives
the same particles to rounding. Whatever is out of the ordinary (a parameter out of range, a weight that is no
number) is done again by the plain steps, which say what is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc import distributions as d
from bayesmc.dbn import Row, SeriesProblem
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.smc import Selection
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Expression,
    Family,
    as_expression,
    elementwise,
    leaf,
    reduction,
)
from bayesmc.expression.functions import product
from bayesmc.expression.graph import substituted
from bayesmc.lowering import Kernel, SliceKernel, is_available, weight_loops
from bayesmc.network import Model
from bayesmc.network.expressions import Opaque, density, log_density_of, value_of
from bayesmc.passes.arithmetic import ZERO, add
from bayesmc.passes.log_density import family_of
from bayesmc.passes.ranges import TRUE, in_range

#: seconds in NumPy of a slice, and of a particle in it, below a tenth of which nothing is compiled
_SLICE, _PARTICLE, _WORTH = 1e-4, 4e-8, 0.1
#: how far values and log weights may be off those of the plain steps
_RTOL = 1e-9
#: families of what is seen whose parameters are known to be right by ``in_range`` and these signs
_SEEN = (
    d.Normal, d.StudentT, d.Laplace, d.Cauchy, d.LogNormal, d.Poisson, d.Exponential, d.Gamma, d.InverseGamma,
    d.Weibull, d.Beta, d.Bernoulli, d.Geometric, d.NegativeBinomial, d.HalfNormal, d.HalfCauchy,
)  # fmt: skip
_POSITIVE = ("scale", "rate", "df", "concentration", "concentration0", "concentration1")


def compiled_step(step: FilterStep, steps: int, is_systematic: bool) -> FilterStep:
    """A step whose slices are machine code where that pays and there is a compiler; the same object.

    Parameters
    ----------
    step : FilterStep
    steps : int
        How many slices it will make.
    is_systematic : bool
        Whether it resamples by ``resampling.systematic``.
    """
    reason = _why_not(step, steps)
    if reason is None:
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
            _Slice(step, row, frozenset(previous for _, previous in step.before), compile=False)
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
        used = _plainly(rng.bit_generator.state)
        rng.bit_generator.state = state
        values, log = step.propagated(step.steps(row), row, before, selection, rng)
        if found is not None:
            same = used == _plainly(rng.bit_generator.state) and _agree(found, (values, log))
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


@dataclass(frozen=True)
class _Drawn:
    """What a hidden node draws: standard normals, ``shape`` of them."""

    name: str
    shape: tuple[int, ...]


class _Slice:
    """One kind of slice."""

    def __init__(
        self, step: FilterStep, row: Row, chosen: frozenset[str], compile: bool = True
    ) -> None:
        self._step = step
        model = step.slices.model(row.t)
        values, log, good, drawn = _expressions(step, model, row)
        self._names = [n for n in step.kept if n in values]
        flagged = elementwise(np.where, good, log, math.nan)
        roots = [*(values[n] for n in self._names), flagged]
        noises = frozenset(_noise(z.name) for z in drawn)
        if not compile:
            Kernel(roots, noises | chosen, chosen)  # refuses what has no machine code
            return
        kept = model.cache.setdefault("compiled slices", {})  # the next series finds it there
        key = (*roots, noises, chosen)
        if key not in kept:
            kept[key] = SliceKernel(roots, noises, chosen)
        self._kernel: SliceKernel = kept[key]
        self._drawn = drawn
        block = min(step.layout.block, step.layout.particles)
        self._noise = {_noise(z.name): np.empty((block, *z.shape)) for z in drawn}
        self._everyone = np.arange(step.layout.particles)

    def __call__(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        selection: Selection,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any] | None:
        step, n = self._step, selection.particles
        rows = self._everyone[:n] if selection.ancestors is None else selection.ancestors
        known = {**step.known(row), **before, **self._noise}
        found = [step.room((n, *shape)) for shape in self._kernel.shapes]
        run = self._kernel.begun(known, rows, found)
        for low in range(0, n, step.layout.block):
            count = min(step.layout.block, n - low)
            for noise in self._noise.values():
                rng.standard_normal(out=noise[:count])
            if run(low, count):
                return None
        *arrays, log = found
        level = log.item(log.argmax())
        if not level < math.inf:  # true for NaN, too
            return None
        values = dict(zip(self._names, arrays, strict=True))
        for array in arrays:
            array.flags.writeable = n > step.layout.block  # large ones are used again
        values |= {k: known[k] for k in step.kept if k not in values}
        return {k: values[k] for k in step.kept}, log if row.seen else 0.0


def _expressions(
    step: FilterStep, model: Model, row: Row
) -> tuple[dict[str, Expression], Expression, Expression, list[_Drawn]]:
    """Values of hidden nodes, the log weight, whether all is in its range, and what is drawn in which order.

    Raises
    ------
    TraceError
    """
    given: dict[str, Expression] = {}
    log, good, drawn = ZERO, TRUE, []
    for name in (n for n in model.nodes if n in step.slices.dynamic):
        node = model[name]
        if not node.is_stochastic:
            if name in step.kept:
                given[name] = substituted(value_of(model, name), given)
                if node.domain is not None:
                    raise TraceError(f"node {name!r} is computed and finite")
            continue
        read = density(model, name)
        if isinstance(read, Opaque):
            raise TraceError(f"node {name!r}: {read.reason}")
        family = read.result
        if not isinstance(family, Family):
            family = family_of(family)
        parameters = {
            k: substituted(v, given) if isinstance(v, Expression) else v
            for k, v in family.parameters.items()
        }
        family = Family(family.make, parameters)
        good = _and(good, _in_range(name, family))
        if name in row.seen:
            if family.make not in _SEEN:
                raise TraceError(f"node {name!r} is seen through a family without machine code")
            each = substituted(log_density_of(model, name), given)
            log = add(log, reduction(np.add, each, range(len(each.shape))))
        else:
            shape = (*node.plate_shape, *node.event_shape)
            drawn.append(_Drawn(name, shape))
            given[name] = _draw(name, family, leaf(_noise(name), shape))
            good = _and(good, _everywhere(elementwise(np.isfinite, given[name])))
    values = {n: e for n, e in given.items() if n in step.kept}
    if any(model[n].plates for n in step.slices.dynamic):
        raise TraceError("plates are drawn by plain steps")
    return values, log, good, drawn


def _noise(name: str) -> str:
    return f"\0noise of {name}"


def _draw(name: str, family: Family, noise: Expression) -> Expression:
    """A draw of a hidden node as its family makes it of standard normals."""
    p = family.parameters
    if family.make in (d.Normal, d.LogNormal):
        draw = elementwise(np.add, elementwise(np.multiply, noise, p["scale"]), p["loc"])
        return draw if family.make is d.Normal else elementwise(np.exp, draw)
    if family.make is d.MvNormal:
        scales = [p.get(k) for k in ("cov", "scale_tril", "scale_diag")]
        if all(s is None or isinstance(s, Constant) for s in scales):
            cov, tril, diag = scales
            if diag is not None:
                moved = elementwise(np.multiply, noise, diag)
            else:
                factor = np.linalg.cholesky(cov.value) if tril is None else tril.value  # type: ignore[union-attr]
                moved = product(np.matvec, as_expression(factor), noise)
            return elementwise(np.add, moved, p["loc"])
    raise TraceError(f"node {name!r} is drawn from a family without machine code")


def _in_range(name: str, family: Family) -> Expression:
    """Whether all parameters are what the family takes; those that are known have been looked at."""
    found = _everywhere(in_range(family))
    for key, value in family.parameters.items():
        if value is None or isinstance(value, Constant):
            continue
        if not isinstance(value, Expression):
            raise TraceError(f"node {name!r} is made of other distributions")
        if value.dtype.kind == "f":
            found = _and(found, _everywhere(elementwise(np.isfinite, value)))
        if key in _POSITIVE:
            found = _and(found, _everywhere(elementwise(np.greater, value, 0.0)))
    return found


def _and(a: Expression, b: Expression) -> Expression:
    if a is TRUE or b is TRUE:
        return b if a is TRUE else a
    return elementwise(np.logical_and, a, b)


def _everywhere(condition: Expression) -> Expression:
    return reduction(np.logical_and, condition, range(len(condition.shape)))


def _plainly(state: Any) -> Any:
    """The state of a generator, to be compared."""
    if isinstance(state, Mapping):
        return {k: _plainly(v) for k, v in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


def _agree(a: Sequence[Any], b: Sequence[Any]) -> bool:
    (values, log), (wanted, wanted_log) = a, b
    if list(values) != list(wanted):
        return False
    pairs = [(values[k], wanted[k]) for k in values] + [(log, wanted_log)]
    return all(
        np.shape(x) == np.shape(y) and np.allclose(x, y, rtol=_RTOL, atol=_RTOL) for x, y in pairs
    )
