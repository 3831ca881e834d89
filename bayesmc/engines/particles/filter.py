"""``ParticleFilter``: options, refusals, the run over a series and the same moves one by one."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, SeriesProblem, Slices
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, answer_so_far
from bayesmc.engines.marginal import options as marginal
from bayesmc.engines.particles.auxiliary import GivenStage, PluggedIn
from bayesmc.engines.particles.belief import ParticleBelief, absorbed, bound, warn_of_a_lonely_step
from bayesmc.engines.particles.compiled_step import compiled_step, told
from bayesmc.engines.particles.delaying import ahead_told, not_delayed, read_delay
from bayesmc.engines.particles.enough import BUDGET, START, TOLERANCE, warn_of_errors
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.kld import KLD
from bayesmc.engines.particles.lags import by_lag
from bayesmc.engines.particles.layers import not_backwards
from bayesmc.engines.particles.optimal import OptimalPlan
from bayesmc.engines.particles.options import (
    NOT_SMOOTHED,
    check_choice,
    check_count,
    check_kind,
    check_numbers,
    check_parts,
    check_together,
    described,
    looks_told,
    read_by,
    read_functions,
    refused,
    require_functions,
    warn_of_what_is_not_guided,
    without_functions,
)
from bayesmc.engines.particles.record import FilteredParticles
from bayesmc.engines.particles.recovery import Recovery
from bayesmc.engines.particles.rejuvenation import Injection, Rejuvenation
from bayesmc.engines.particles.run import filtered_by
from bayesmc.engines.particles.runs import run_of, with_enough
from bayesmc.engines.particles.smoothing import Backwards, backwards
from bayesmc.engines.refusals import check_keep, no_past_of_objects, not_with_objects
from bayesmc.engines.slice_steps import SlicePlan, SliceProposals, plates_apart
from bayesmc.errors import UnsupportedError
from bayesmc.randomness import seed_sequence
from bayesmc.resampling import Adaptive, checked, scheme_of
from bayesmc.results import RunFile
from bayesmc.results.predictive import warn_of_misfit
from bayesmc.storage import Saver

#: options that hold functions by node
_FUNCTIONS = ("proposal", "initial_proposal", "rejuvenation")


@dataclass(frozen=True)
class ParticleFilter(FilterEngine):
    """Sequential Monte Carlo on a template: sample what is hidden, weight by what is seen, resample.

    Parameters
    ----------
    particles : int, optional
        By default as many as ``tolerance`` needs, 1,000 or more, for ``filter``, ``smooth`` and ``forecast``:
        short runs of few particles say how many (a quarter of the time, or a third, goes there), and the run
        that answers has a random stream of its own. 1,000 for ``start`` and ``step``, and with ``adapt``.
        Where the particles of all slices are held (``smooth`` without ``lag=``, ``keep="particles"``),
        particles times slices are at most 5 million.
    resampling : str, callable or Adaptive
        ``"multinomial"``, ``"stratified"``, ``"systematic"``, ``"residual"``, ``"ssp"``, or a function
        ``(weights, draws, rng) -> sorted indices``; an ``Adaptive`` brings its own threshold, which is taken
        instead of ``ess_threshold``.
    ess_threshold : float
        Particles are resampled on the way into a slice where they are worth less than this share of their
        number: 1 resamples (nearly) always, 0 never (sequential importance sampling).
    proposal : dict, optional
        Node, or tuple of nodes drawn jointly -> a function whose arguments are the slice before
        (``x_prev``), observed nodes of the slice, inputs, ``t`` or nodes drawn before, and which returns the
        distribution to draw from, as for ``Importance``; weights are multiplied by p/q. It does not apply
        where it names what is missing (an observation, or the slice before slice 0): there the node's own
        density is drawn from. A detector mixed with the transition is a ``Mixture`` of both. ``"optimal"``
        derives one from the declared densities: p(x_t | x_{t-1}, y_t) where hidden nodes are Normal and what
        is seen is affine in them; else what is seen is linearised, or its log density quadratic, at each
        particle, mixtures of Gaussians component by component, and a tenth of the particles is drawn from
        their own densities. Hidden finite nodes are drawn from their own densities; ``explain`` says what
        guides each node, and why any is not guided. With any proposal vectors are seen whole or not at all.
    initial_proposal : dict, optional
        As ``proposal``, for slice 0 alone: where the first observations say the start could be.
    auxiliary : bool or callable
        Resample with a look at the next row: particles are chosen by their weight times a first-stage
        factor, by default the density of the row given the slice before: exact where means are affine, else
        an estimate mixed with a tenth of its mean. Or a function of the slice before and observed nodes that
        returns log factors.
    on_degeneracy : "raise" or "rejuvenate"
        What to do where all weights vanish.
    rejuvenation : dict, optional
        Node -> density to draw it from then, given observed nodes, inputs or ``t``; all nodes that the next
        slice reads. The slice is weighted as if that density were the model's, so its answers and the
        evidence are biased; ``rejuvenated`` of the result says which slices.
    adapt : KLD, optional
        How many particles a slice needs, at most ``particles``: many where the belief is wide, few where it
        is narrow. Particles are then resampled whenever their number changes.
    recovery : Recovery, optional
        Lets a share of the particles begin anew in every slice, so that a filter that is lost finds back.
    marginalize : "auto", sequence of str, or None
        Hidden nodes that are integrated out (Rao-Blackwellised): Normal and MvNormal ones, linear given the
        sampled ones, by a Kalman filter for each particle, finite ones by a table (or one for each element of
        a plate). ``"auto"``: what can be, names: those; ``explain`` says which. Nonlinear means of named ones
        are linearised at each particle's own mean: answers and evidence are approximations then.
        ``proposal="optimal"`` draws the sampled nodes, which must be finite, from p(s_t | s_{t-1}, y_t) (the
        mixture Kalman filter). Tables answer ``filter`` and ``forecast`` alone.
    delay : int, optional
        How many rows answers look ahead: those for slice t are given the rows up to t + delay (at the end
        what there is), by the weights of slice t + delay on the ancestors in t; beliefs about what is
        integrated out take these rows in, too. Ancestors are few where the delay is long. Beliefs of ``step``
        answer as late (``about``, ``back``).
    tolerance : float
        Error of the log evidence that is aimed at where ``particles`` is left out. Means of states are aimed
        at, too: to a tenth of their standard deviation, in nine tenths of the slices.
    compiled : bool, optional
        Whether slices are machine code, which needs the extra `[fast]`: always, never, or by default where
        the series would take more than a tenth of a second in NumPy, or where machine code of an earlier run
        is at hand and saves more than loading it takes. The particles are the same to rounding. `explain`
        says what is not, and why.
    budget : int
        Particles times slices (times elements of plates that are filtered separately) that this may take:
        seconds. With ``proposal="optimal"`` or ``auxiliary=True`` each counts as 20, which is about what a
        look at the row costs.

    Raises
    ------
    DegeneracyError
        From the filter, with the slice and the node at which no weight was left.

    Warns
    -----
    ProposalWarning
        ``proposal="optimal"`` leaves a hidden number, or what is seen of it, out.
    LowEssWarning
        From the filter, where more than a tenth of the slices rest on little more than one particle, or the
        stated error of the log evidence is above 1, or cannot be told (with a given number of particles:
        above 3, or cannot be told since the first row that is seen, or several, leave fewer than two); where
        no number is given, also where means of states are off by half their standard deviation in a tenth of
        the slices. From ``step``, where no number is given, at the first slice that rests on fewer than two.

    Notes
    -----
    Answers state their own errors: ``log_marginal_likelihood_mcse``, ``mcse(name)`` and ``queries_mcse``.
    They come from the genealogy: particles of a slice are cut into groups of neighbours, and what the shares
    of their descendants differ by says how far all together are off (as Chan and Lai 2013 and Lee and
    Whiteley 2018 do with single particles; groups make it right for systematic resampling, too). That of the
    evidence is the root of the mean square error, sqrt(v + v^2/4) for a log of variance v, which is v/2 too
    low on average. Particles know nothing of where none of them has been: the error is infinite where a slice
    rests on fewer than four, where their descendants show that later rows ask for the edge of the cloud,
    where rows go on pulling means the same way, and where a few scouts in states of finite nodes that next to
    no particle has find more than a tenth of the belief there. Means have infinite errors from such a slice
    on, until what is random in the transition could have carried particles over all that they stood on. Those
    of trajectories drawn backwards count how few these are, and which of them share particles in a slice.

    Plates whose elements never meet are filtered separately, each with weights and ancestors of its own: 64
    sequences in a plate are 64 filters in one array.

    References
    ----------
    Gordon, Salmond and Smith (1993), IEE Proceedings F 140; Koller and Friedman (2009), sec. 15.3.3
    (LW-2TBN); Doucet and Johansen (2011), A tutorial on particle filtering and smoothing; Pitt and Shephard
    (1999), JASA 94; Okuma et al. (2004), A boosted particle filter; Chan and Lai (2013), Ann. Statist. 41;
    Lee and Whiteley (2018), Biometrika 105; Chen, Wang and Liu (2000), IEEE IT 46 (delayed weights).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    >>> dbn.add("y", lambda x: bmc.StudentT(4.0, x, 0.5))
    >>> filtered = bmc.filter(dbn, {"y": [1.2, 0.4, 0.7]}, engine=bmc.ParticleFilter(5000), rng=0)
    >>> filtered.mean("x").shape, bool(filtered.log_marginal_likelihood < 0)
    ((3,), True)
    """

    particles: int | None = None
    resampling: str | Callable[..., np.ndarray] = "systematic"
    ess_threshold: float = 0.5
    proposal: Mapping[Any, Any] | str | None = field(default=None, hash=False)
    initial_proposal: Mapping[Any, Any] | None = field(default=None, hash=False)
    auxiliary: bool | Callable[..., Any] = False
    on_degeneracy: str = "raise"
    rejuvenation: Mapping[Any, Any] | None = field(default=None, hash=False)
    adapt: KLD | None = None
    recovery: Recovery | None = None
    marginalize: Any = None
    delay: int | None = None
    tolerance: float = TOLERANCE
    compiled: bool | None = None
    budget: int = BUDGET
    question: str = field(default="filter", init=False, repr=False, compare=False)

    label: ClassVar[str] = "particle filter"
    keeps: ClassVar[bool] = True
    saves: ClassVar[bool] = True
    belief: ClassVar[type] = ParticleBelief

    def __post_init__(self) -> None:
        if self.particles is not None:
            check_count("particles", self.particles, "such as 10_000")
        check_numbers(self)
        scheme_of(self.resampling)
        check_choice("on_degeneracy", self.on_degeneracy, "raise", "rejuvenate")
        if self.compiled is not None and not isinstance(self.compiled, bool):
            raise ValueError(
                f"ParticleFilter(compiled={self.compiled!r}): give True, False or None"
            )
        check_kind("adapt", self.adapt, KLD)
        check_kind("recovery", self.recovery, Recovery)
        for option in _FUNCTIONS:
            object.__setattr__(self, option, read_functions(option, getattr(self, option)))
        check_together(self)
        if self.marginalize is not None:
            object.__setattr__(self, "marginalize", marginal.read_marginalize(self))
        if self.delay is not None:
            object.__setattr__(self, "delay", read_delay(self))

    def __getstate__(self) -> dict[str, Any]:
        return without_functions(self, _FUNCTIONS)

    def __copy__(self) -> ParticleFilter:
        return self

    def __deepcopy__(self, memo: Any) -> ParticleFilter:
        return self

    def refusal(self, problem: SeriesProblem) -> str | None:
        require_functions(self, _FUNCTIONS)
        common = super().refusal(problem) or not_with_objects(self, problem)
        if common is not None:
            return common
        asked = None if isinstance(self.proposal, str) else self._proposals(problem.slices)
        why = None if self.marginalize is None else marginal.why_not(self, problem, asked)
        return refused(self, problem, asked) if why is None else why

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        if asked.what in ("smooth", "fixed-lag") and (self.adapt or self.recovery):
            return NOT_SMOOTHED
        if why := (
            no_past_of_objects(problem, asked.what, asked.keep, self.delay)
            or not_delayed(self.delay, asked)
            or marginal.not_of_the_past(self, problem, asked.what)
        ):
            return why
        sums = marginal.endless_sums(self, problem) if asked.what == "smooth" else ()
        return not_backwards(sums[0]) if sums else super().unable(problem, asked)

    def reasons(self, problem: SeriesProblem) -> tuple[str, ...]:
        return marginal.reasons(self, problem)

    def describe(self, problem: SeriesProblem) -> dict[str, str]:
        found = described(problem)
        if not self._integrates(problem):
            found |= looks_told(self, problem, found)
        return marginal.told(self, problem, found)

    def effort(self, problem: SeriesProblem) -> str:
        step = self._sized(START).step_of(problem.slices, problem.known_static, seen=problem.seen)
        own = marginal.effort_told(self, problem) if step.integrated else ""
        return own or told(step, problem, self.compiled)

    def effort_for(self, problem: SeriesProblem, asked: Asked) -> str:
        if asked.what != "filter":
            return marginal.back(self, problem, asked)
        return ahead_told(self.delay, self.effort(problem))

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
        checkpoint: RunFile | None = None,
    ) -> FilteredParticles:
        check_keep(problem, keep, self.delay)
        if not self._integrates(problem):
            warn_of_what_is_not_guided(self, problem.slices, problem.series.observed)
        try:
            whole = keep is not None, queries or {}, progress
            found, filtered = run_of(self, problem, seed, *whole, checkpoint)
        except KeyboardInterrupt as stop:
            found = filtered = answer_so_far(stop, self)
        carried = marginal.numbers_carried(self, problem)
        warn_of_errors(filtered, found, problem.slices, self, carried)
        warn_of_misfit(filtered.predictive, type(self).__name__, found.start, 3)
        return found

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
        trajectories: int | None = None,
        backward: str = "rejection",
    ) -> FilteredParticles:
        if trajectories is not None:
            what = "or None for as many as there are particles, 1,000 at most"
            check_count("trajectories", trajectories, what, "smooth")
        check_choice("backward", backward, "rejection", "exact", "smooth")
        if why := self.unable(problem, Asked("smooth" if lag is None else "fixed-lag")):
            raise UnsupportedError(why)
        own: ParticleFilter = marginal.asking(self, "smooth" if lag is None else "fixed-lag")
        if not own._integrates(problem):
            warn_of_what_is_not_guided(self, problem.slices, problem.series.observed)
        sized = with_enough(own, problem, seed, lag is None, progress)
        if lag is not None:
            found, filtered = by_lag(sized, problem, seed, lag, False, queries or {}, progress)
        else:
            asked = Backwards(trajectories, backward == "rejection")
            found, filtered = backwards(sized, problem, seed, queries or {}, progress, asked)
        carried = marginal.numbers_carried(own, problem)
        warn_of_errors(filtered, found, problem.slices, self, carried)
        warn_of_misfit(filtered.predictive, type(self).__name__, filtered.start, 3)
        return found

    def step_of(
        self,
        slices: Slices,
        static: Mapping[str, np.ndarray],
        kept: Sequence[str] | None = None,
        seen: Collection[str] = (),
    ) -> FilterStep:
        """The step of this filter on a template, whose particles hold some nodes (all by default).

        ``seen`` are nodes that are seen in full in every slice.
        """
        require_functions(self, _FUNCTIONS)
        scheme: Any = scheme_of(self.resampling)
        threshold = float(self.ess_threshold)
        if isinstance(scheme, Adaptive):
            scheme, threshold = scheme_of(scheme.scheme), scheme.threshold
        apart, count = plates_apart(slices), self.particles
        assert count is not None
        is_optimal = isinstance(self.proposal, str)
        asked = None if is_optimal else self._proposals(slices)
        if self.marginalize is not None:
            split = marginal.split_asked(self, slices, static, seen)
            if split is not None:
                own = checked(scheme), threshold, kept, asked
                return marginal.marginal_step(self, split, slices, static, *own)
        plan = (
            OptimalPlan(slices, apart, static)
            if is_optimal
            else SlicePlan(slices, apart, static, asked)
        )
        stage: Any = None
        if callable(self.auxiliary):
            stage = GivenStage(plan, self.auxiliary, count)
        elif self.auxiliary:
            stage = PluggedIn(plan, count)
        renewed = None if self.rejuvenation is None else Rejuvenation(plan, self.rejuvenation)
        recovery: Recovery | None = self.recovery
        injection = None if recovery is None else Injection(plan, recovery)
        wanted = kept if kept is None or self.adapt is None else [*kept, *self.adapt.widths]
        return FilterStep(
            plan, count, checked(scheme), threshold, stage, renewed, wanted, self.adapt, injection
        )

    def _nothing(self, dbn: DynamicBayesNet, static: Mapping[str, Any], rng: Any) -> ParticleBelief:
        return ParticleBelief(dbn, seed_sequence(rng), static)

    def _bound(
        self, belief: ParticleBelief, dbn: DynamicBayesNet, slices: Slices
    ) -> ParticleBelief:
        return bound(self._sized(START), belief, dbn, slices)

    def _absorbed(self, belief: ParticleBelief, slices: Slices, row: Row) -> ParticleBelief:
        check_parts(self, row.seen)
        if self.marginalize is None and not isinstance(belief.made_by, FilterStep):
            warn_of_what_is_not_guided(self, slices, row.seen)
        found = absorbed(self._sized(START), belief, slices, row)
        if self.particles is None:
            assert found.now is not None
            warn_of_a_lonely_step(belief.now, belief.families, found.now)
        return found

    # ---- private -------------------------------------------------------------------------------

    def _passed(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        keep: bool,
        queries: Queries,
        progress: bool | None,
        unit: int = 0,
        saver: Saver | None = None,
    ) -> FilteredParticles:
        """All slices, one by one."""
        asked = read_by(queries, problem.slices)
        kept = None if keep else [*problem.hidden, *asked]
        step = self.step_of(problem.slices, problem.known_static, kept, problem.seen)
        if not step.integrated:
            compiled = self.compiled if saver is None else saver.state["compiled"]
            step = compiled_step(step, problem.steps, compiled)
        return filtered_by(self, step, problem, seed, keep, queries, progress, unit, saver=saver)

    def _integrates(self, problem: SeriesProblem) -> bool:
        """Whether anything is integrated out."""
        return self.marginalize is not None and bool(marginal.split_of_problem(self, problem))

    def _sized(self, particles: int) -> ParticleFilter:
        """The same filter with so many particles, where their number was left out."""
        if self.particles is not None:
            return self
        found = object.__new__(type(self))
        found.__dict__.update(self.__dict__, particles=particles)
        return found

    def _proposals(self, slices: Slices) -> SliceProposals:
        assert not isinstance(self.proposal, str)
        first = self.initial_proposal or {}
        return SliceProposals(slices, self.proposal or {}, "ParticleFilter", first)
