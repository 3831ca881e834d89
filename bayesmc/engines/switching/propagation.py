"""``ExpectationPropagation`` over time: options, messages between slices, and what is said where they end."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Asked, Queries, quiet
from bayesmc.engines.switching.engine import SwitchingEngine
from bayesmc.engines.switching.merging import Mixture, without_rounding
from bayesmc.engines.switching.posterior import SwitchingSeries
from bayesmc.engines.switching.run import SwitchingRun
from bayesmc.engines.switching.slice_factors import Scale, SliceFactor
from bayesmc.engines.switching.smoothing import applied
from bayesmc.errors import ConvergenceWarning, UnsupportedError
from bayesmc.factors.expectation_propagation import Propagated, Visit, propagate
from bayesmc.factors.messages import ConditionalGaussian
from bayesmc.progress import Progress


class PropagatedSeries(SwitchingSeries):
    """Mixtures over modes where expectation propagation ended, and how it did.

    Answers what ``SwitchingSeries`` does.

    Attributes
    ----------
    converged : bool or ndarray
        Whether the last sweep changed nothing by more than ``tolerance``, and left no message out. Of plates
        that are filtered separately there is one for each element, here and below.
    change : float or ndarray
        What the last sweep changed, of the belief that it changed most: the root of a symmetric
        Kullback-Leibler divergence, in standard deviations where modes are certain.
    sweeps : int
    skipped : int or ndarray
        Improper messages that were left out, or taken back in part, in all sweeps.
    damping : float or ndarray
        In the last sweep.
    log_marginal_likelihood : float or ndarray
        Approximate; NaN where some slice with its messages has no finite integral.
        ``log_marginal_increments`` are the slices' parts of it; the log density of a row given those before
        is what ``filter`` has.
    """

    converged: Any
    change: Any
    sweeps: int
    skipped: Any
    damping: Any

    @classmethod
    def of(cls, answers: SwitchingSeries, end: Propagated) -> PropagatedSeries:
        """Answers with how they were come by."""
        found = object.__new__(cls)
        found.__dict__.update(answers.__dict__)
        found.sweeps = end.sweeps
        found.converged, found.change, found.skipped, found.damping = (
            a if np.ndim(a) else a.item()
            for a in (end.converged, end.change, end.skipped, end.damping)
        )
        return found


@dataclass(frozen=True)
class SeriesPropagation(SwitchingEngine):
    """``ExpectationPropagation`` as an engine over time, where it says what it does.

    References
    ----------
    Heskes and Zoeter (2002), Expectation propagation for approximate inference in dynamic Bayesian networks,
    UAI 18 (two-slice beliefs alpha_{t-1} psi_t beta_t, collapsed and divided); Zoeter and Heskes (2005),
    Change point problems in linear dynamical systems, JMLR 6.
    """

    sweeps: int = 200
    damping: float | None = None
    tolerance: float = 1e-5
    linearize: bool = False
    max_modes: int = 64

    label: ClassVar[str] = "expectation propagation"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_options(self)

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        return _NO_LAGS if asked.what == "fixed-lag" else super().unable(problem, asked)

    def refusal(self, problem: SeriesProblem) -> str | None:
        named = getattr(self, "families", None)
        if named:
            return (
                f"ExpectationPropagation(families={dict(named)!r}): over time all numbers are normal given "
                "the modes, and no node has another family; leave families= out"
            )
        return super().refusal(problem)

    def effort(self, problem: SeriesProblem) -> str:
        run = self._run(problem)
        return (
            f"{len(run.now)} modes, {len(run.stretches[-1].pairs.dst)} pairs of them a slice; smoothed by at "
            f"most {self.sweeps} passes back and forth; the log marginal likelihood is an approximation of "
            "unknown error"
        )

    def sweep_cost(self, problem: SeriesProblem) -> float:
        """Of a pass back and forth, in slices of few modes and numbers (some half a millisecond each)."""
        run = self._run(problem)
        layout, pairs = run.data.layouts[-1], len(run.stretches[-1].pairs.dst)
        work = pairs * math.prod(layout.lead) * (2.0 * layout.carried) ** 3
        return problem.steps * (1.0 + work / _WORK)

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> SwitchingSeries:
        if lag is not None:
            raise UnsupportedError(_NO_LAGS)
        answers, doubt = self.smoothed(problem, queries, progress)
        if doubt is not None:
            warnings.warn(doubt, ConvergenceWarning, stacklevel=3)
        return answers

    def smoothed(
        self, problem: SeriesProblem, queries: Queries | None, progress: bool | None
    ) -> tuple[PropagatedSeries, str | None]:
        """Beliefs where messages ended, and why these are no answer, or None."""
        run = self._run(problem)
        with quiet():
            with Progress(problem.steps, self.label, progress) as bar:
                filtered, increments = run.forward(partial(bar.advance, 1))
            messages = _Messages(run, filtered)
            with Progress(int(self.sweeps), self.label, progress) as bar:
                end = messages.passed(self, partial(bar.advance, 1))
            found = messages.answers(end)
            increments = messages.increments(end, increments)
        answers = PropagatedSeries.of(run.answers("smooth", found, increments, queries), end)
        return answers, _doubt(self, end)

    # ---- private -------------------------------------------------------------------------------

    @property
    def _told(self) -> str:
        return "expectation propagation"


# ---- private ------------------------------------------------------------------------------------

#: damping up to which nothing is made of improper messages that were met on the way
_CALM = 0.45
#: multiplications of a slice that cost as much as all else that is done for it
_WORK = 20_000.0
_NO_LAGS = (
    "ExpectationPropagation smooths given all rows, and lag= would pass messages anew for every slice; use "
    "SwitchingKalmanFilter"
)


class _Messages:
    """Between the slices of a series."""

    def __init__(self, run: SwitchingRun, filtered: list[Mixture]) -> None:
        self.filtered = [without_rounding(found) for found in run.completed(filtered)]
        backs = run.turned(self.filtered)
        self.scales = [Scale.of(found) for found in run.noise(self.filtered, backs)]
        for k, scale in enumerate(self.scales):
            if scale.is_singular:
                raise UnsupportedError(
                    f"ExpectationPropagation: rows after slice {run.data.series.start + k} tell some number "
                    "of it without noise, and messages about it would be infinite; use SwitchingKalmanFilter "
                    "or ParticleFilter, or give what is known without noise a little"
                )
        self.factors = []
        for k, back in enumerate(backs):
            if back is not None:
                pairs = run.places[k].stretch.pairs
                self.factors.append(SliceFactor(k, pairs, back, self.filtered[k], self.scales))

    def passed(self, engine: SeriesPropagation, advance: Any) -> Propagated:
        """Back and forth until nothing changes."""
        count = len(self.factors)
        both = list(zip(self.scales, self.filtered, strict=True))
        own, told = ([s.forward(f.log, zeros) for s, f in both] for zeros in (False, True))
        one = ConditionalGaussian.ones(*_sizes(own[0]))
        inner = [one.over(a, one) for a in own[1:-1]]
        priors = [one, *inner, one] if count else told
        sites = list(zip([told[0], *own[1:-1]], told[1:], strict=True)) if count else []
        back = [Visit(k, (0,)) for k in reversed(range(count))]
        forth = [Visit(k, (1,)) for k in range(count)]
        return propagate(
            priors, self.factors, sites, back + forth, sweeps=int(engine.sweeps),
            damping=engine.damping, tolerance=float(engine.tolerance), advance=advance,
        )  # fmt: skip

    def answers(self, end: Propagated) -> list[Mixture]:
        """All numbers of every slice; by beliefs alone where slices with their messages have no moments."""
        found = []
        for k, (scale, belief) in enumerate(zip(self.scales, end.beliefs, strict=True)):
            whole = self.factors[k - 1].answer(end.cavities[k - 1]) if k else None
            if whole is None:
                whole = applied(self.filtered[k], scale.smoothed(belief))
            found.append(whole)
        return found

    def increments(self, end: Propagated, forward: np.ndarray) -> np.ndarray:
        """By slice, so that they add up to the evidence; ``forward`` has those of the first pass."""
        found = forward.copy()
        found[1:] = end.logs
        found[1:-1] -= end.totals[1:-1]
        return found


def check_options(engine: Any) -> None:
    """Refuse sweeps, damping and tolerance that make no sense."""
    name, sweeps = type(engine).__name__, engine.sweeps
    if isinstance(sweeps, bool) or not isinstance(sweeps, (int, np.integer)) or sweeps < 1:
        raise ValueError(f"{name}(sweeps={sweeps!r}): give a number, 1 or more")
    if engine.damping is not None and not (
        _is_number(engine.damping) and 0.0 <= engine.damping < 1.0
    ):
        raise ValueError(
            f"{name}(damping={engine.damping!r}): give a share of the old message, 0 or more and less than "
            "1, or None"
        )
    if not _is_number(engine.tolerance) or not 0.0 < engine.tolerance < np.inf:
        raise ValueError(f"{name}(tolerance={engine.tolerance!r}): give a number above 0")


def _sizes(message: ConditionalGaussian) -> tuple[int, tuple[int, ...], int]:
    shape = message.linear.shape
    return shape[0], shape[1:-1], shape[-1]


def _is_number(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, (int, float, np.integer, np.floating))


def _doubt(engine: SeriesPropagation, end: Propagated) -> str | None:
    """By how much messages have not settled, or what there was on the way to where they did; or None."""
    if end.converged.all():
        rough = (end.skipped > 0) & (end.damping > _CALM)
        if not rough.any():
            return None
        return (
            f"ExpectationPropagation: messages have settled, but {int(end.skipped.max())} of them were taken "
            f"back on the way, as they were improper, and it took damping of {float(end.damping.max()):.2g}: "
            "such answers, and the log evidence above all, are at times far off; hold them against "
            "ParticleFilter"
        )
    whose = ""
    if end.converged.ndim:
        whose = f" for {int((~end.converged).sum())} of {end.converged.size} elements"
    change, left = float(end.change.max()), int(end.open.max(initial=0))
    out = (
        f" and left out or took back {left} improper messages ({int(end.skipped.max())} in all)"
        if left
        else ""
    )
    steadier = (
        "" if engine.damping is None else f"more damping than {float(engine.damping):.2g} or "
    )
    return (
        f"ExpectationPropagation: messages have not settled{whose} after {end.sweeps} sweeps: the last one "
        f"changed a belief by {change:.2g} (tolerance {float(engine.tolerance):.2g}){out}. Give {steadier}"
        "more sweeps, or take SwitchingKalmanFilter or ParticleFilter"
    )
