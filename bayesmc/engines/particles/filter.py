"""``ParticleFilter``: options, refusals, the run over a series and the same moves one by one."""

from __future__ import annotations

import inspect
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, SeriesProblem, Slices, read_static
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, answer_so_far, pass_slices
from bayesmc.engines.particles.anew import Lost, Rejuvenation
from bayesmc.engines.particles.belief import ParticleBelief
from bayesmc.engines.particles.cloud import Cloud, Layout
from bayesmc.engines.particles.counts import KLD
from bayesmc.engines.particles.mover import Mover
from bayesmc.engines.particles.optimal import OptimalPlan
from bayesmc.engines.particles.record import FilteredParticles, Record
from bayesmc.engines.particles.recovery import Recovery
from bayesmc.engines.particles.smoothing import Backward, endless, lagged
from bayesmc.engines.particles.stages import GivenStage, PluggedIn
from bayesmc.engines.particles.telling import looks_told, warn_of_what_is_not_guided
from bayesmc.engines.proposal import FUNCTION, as_function, check_specification
from bayesmc.engines.slice_steps import SlicePlan, SliceProposals, plates_apart
from bayesmc.errors import LowEssWarning, UnknownNodeError, UnsupportedError, did_you_mean
from bayesmc.network.forward import refuse_unsampled
from bayesmc.progress import Progress
from bayesmc.randomness import Purpose, resumed, seed_sequence, stream
from bayesmc.resampling import Adaptive, checked, scheme_of

#: options that hold functions by node
_FUNCTIONS = ("proposal", "initial_proposal", "rejuvenation")
#: equally weighted particles below which a slice rests on a single one
_COLLAPSED = 2.0
#: share of such slices from which on a warning says so
_MANY = 0.1


@dataclass(frozen=True)
class ParticleFilter(FilterEngine):
    """Sequential Monte Carlo on a template: sample what is hidden, weight by what is seen, resample.

    Parameters
    ----------
    particles : int
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
        is seen is affine in them; else what is seen is made linear, or its log density quadratic, at each
        particle, mixtures of Gaussians component by component, and a tenth of the particles is drawn from
        their own densities. Hidden finite nodes are drawn from their own densities; ``explain`` says what
        guides each node, and why any is not guided.
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

    trajectories : int, optional
        Trajectories that ``smooth`` draws; by default as many as there are particles.
    backward : "rejection" or "exact"
        How ``smooth`` draws them: by rejection where the transition's height is known (time linear in the
        particles, and the same law), else with all particles tried for each.

    Raises
    ------
    DegeneracyError
        From the filter, with the slice and the node at which no weight was left.

    Warns
    -----
    ProposalWarning
        ``proposal="optimal"`` leaves a hidden number, or what is seen of it, out.
    LowEssWarning
        From the filter, where more than a tenth of the slices rest on little more than one particle.

    Notes
    -----
    Plates whose elements never meet are filtered separately, each with weights and ancestors of its own: 64
    sequences in a plate are 64 filters in one array.

    References
    ----------
    Gordon, Salmond and Smith (1993), IEE Proceedings F 140; Koller and Friedman (2009), sec. 15.3.3
    (LW-2TBN); Doucet and Johansen (2011), A tutorial on particle filtering and smoothing; Pitt and Shephard
    (1999), JASA 94; Okuma et al. (2004), A boosted particle filter.

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

    particles: int = 1000
    resampling: str | Callable[..., np.ndarray] = "systematic"
    ess_threshold: float = 0.5
    proposal: Mapping[Any, Any] | str | None = field(default=None, hash=False)
    initial_proposal: Mapping[Any, Any] | None = field(default=None, hash=False)
    auxiliary: bool | Callable[..., Any] = False
    on_degeneracy: str = "raise"
    rejuvenation: Mapping[Any, Any] | None = field(default=None, hash=False)
    adapt: KLD | None = None
    recovery: Recovery | None = None
    trajectories: int | None = None
    backward: str = "rejection"

    label: ClassVar[str] = "particle filter"
    keeps: ClassVar[bool] = True
    belief: ClassVar[type] = ParticleBelief

    def __post_init__(self) -> None:
        _check_count("particles", self.particles, "such as 10_000")
        if self.trajectories is not None:
            _check_count(
                "trajectories", self.trajectories, "or None for as many as there are particles"
            )
        _check_threshold(self.ess_threshold)
        scheme_of(self.resampling)
        _check_choice("backward", self.backward, "rejection", "exact")
        _check_choice("on_degeneracy", self.on_degeneracy, "raise", "rejuvenate")
        _check_kind("adapt", self.adapt, KLD)
        _check_kind("recovery", self.recovery, Recovery)
        if not isinstance(self.auxiliary, bool) and not callable(self.auxiliary):
            raise TypeError(
                f"ParticleFilter(auxiliary={self.auxiliary!r}): give True, False, or a function that returns "
                "log factors"
            )
        for option in _FUNCTIONS:
            object.__setattr__(self, option, _read_functions(option, getattr(self, option)))
        self._check_together()

    def _check_together(self) -> None:
        """Options that only make sense with others, or without them."""
        if isinstance(self.proposal, str) and self.initial_proposal is not None:
            raise ValueError(
                'ParticleFilter: proposal="optimal" proposes for slice 0 too; leave initial_proposal= out'
            )
        if self.recovery is not None and self.rejuvenation is not None:
            raise ValueError(
                "ParticleFilter: recovery= and rejuvenation= both begin anew; give one of them"
            )
        if self.adapt is not None and self.auxiliary is not False:
            raise ValueError("ParticleFilter: adapt= and auxiliary= do not go together")
        if (self.on_degeneracy == "rejuvenate") != (self.rejuvenation is not None):
            raise ValueError(
                'ParticleFilter: on_degeneracy="rejuvenate" and rejuvenation={node: density} go together'
            )

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions."""
        state = dict(self.__dict__)
        for option in _FUNCTIONS:
            if isinstance(state[option], Mapping):
                state[option] = dict.fromkeys(state[option])
        for option in ("resampling", "auxiliary"):
            state[option] = None if callable(state[option]) else state[option]
        return state

    def __copy__(self) -> ParticleFilter:
        return self

    def __deepcopy__(self, memo: Any) -> ParticleFilter:
        return self

    def _require_functions(self) -> None:
        given = [self.resampling, self.auxiliary]
        for option in _FUNCTIONS:
            functions = getattr(self, option)
            given += functions.values() if isinstance(functions, Mapping) else ()
        whole = self.recovery is None or self.recovery.is_whole
        if not whole or any(value is None for value in given):
            raise UnsupportedError(
                "ParticleFilter: this engine was unpickled, and pickles carry no functions; make it anew"
            )

    def refusal(self, problem: SeriesProblem) -> str | None:
        self._require_functions()
        common = super().refusal(problem)
        if common is not None:
            return common
        apart = plates_apart(problem.slices)
        for option in ("adapt", "recovery"):
            if getattr(self, option) is not None and apart:
                return (
                    f"ParticleFilter: {option}= is for one filter, and elements of plate {apart[0]!r} are "
                    "filtered separately; filter them one by one"
                )
        if self.adapt is not None:
            self.adapt.check(problem.slices.later, problem.slices.interface)
        known = {*problem.slices.template.static, *problem.series.observed}
        if not isinstance(self.proposal, str):
            proposals = self._proposals(problem.slices)
            seen = problem.series.observed
            proposals.check(seen.keys(), {n for n, o in seen.items() if o.mask is None})
        for model in (problem.slices.first, problem.slices.later):
            inside = {n for n in model.nodes if n not in problem.slices.dynamic} | known
            reason = refuse_unsampled(model, inside, "ParticleFilter")
            if reason is not None:
                return reason
        return None

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        if asked.what in ("smooth", "fixed-lag") and (self.adapt or self.recovery):
            return _NOT_SMOOTHED
        sums = endless(problem.slices, _seen(problem)) if asked.what == "smooth" else ()
        return _not_backwards(sums[0]) if sums else super().unable(problem, asked)

    def describe(self, problem: SeriesProblem) -> dict[str, str]:
        found = {}
        for name in problem.slices.template.later:
            node = problem.model[name]
            seen = problem.series.observed.get(name)
            if name in problem.slices.template.inputs:
                found[name] = "input"
            elif name in problem.slices.template.static:
                found[name] = "static, known"
            elif not node.is_stochastic:
                found[name] = "computed"
            elif seen is None:
                found[name] = "sampled given its parents"
            else:
                found[name] = "observed, weights the particles"
                if seen.mask is not None:
                    found[name] += "; sampled where it is missing"
        return found | looks_told(self, problem, found)

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> FilteredParticles:
        if keep not in (None, "particles"):
            raise ValueError(
                f'keep={keep!r}: give "particles", or None for answers of constant size'
            )
        warn_of_what_is_not_guided(self, problem.slices, problem.series.observed)
        try:
            found = self._passed(problem, seed, keep is not None, queries or {}, progress)
        except KeyboardInterrupt as stop:
            found = answer_so_far(stop, self)
        self._warn_of_collapse(found)
        return found

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> FilteredParticles:
        if self.adapt is not None or self.recovery is not None:
            raise UnsupportedError(_NOT_SMOOTHED)
        warn_of_what_is_not_guided(self, problem.slices, problem.series.observed)
        if lag is not None:
            return self._lagged(problem, seed, lag, queries or {}, progress)
        sums = endless(problem.slices, _seen(problem))
        if sums:
            raise UnsupportedError(_not_backwards(sums[0]))
        filtered = self._passed(problem, seed, True, {}, progress)
        self._warn_of_collapse(filtered)
        assert filtered.clouds is not None
        static = {n: o.value for n, o in problem.series.static.items()}
        mover = self._mover(problem.slices, static)
        count = self.particles if self.trajectories is None else self.trajectories
        by_bound = self.backward == "rejection"
        backward = Backward(mover.plan, mover.layout, by_bound, _seen(problem))
        with _quiet():
            rng = stream(seed, Purpose.SMOOTH)
            found = backward.trajectories(filtered.clouds, problem.series, count, rng)
            layout = Layout(count, mover.apart, mover.lead)
            record = Record(problem, layout, queries or {}, True)
            for k, cloud in enumerate(found):
                record.add(k, cloud)
        return self._given_filtered(record.posterior(self, "smooth"), filtered)

    def _lagged(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        lag: int,
        queries: Queries,
        progress: bool | None,
    ) -> FilteredParticles:
        """Slices by the particles of ``lag`` slices later, through their ancestors."""
        static = {n: o.value for n, o in problem.series.static.items()}
        mover = self._mover(problem.slices, static)
        record = Record(problem, mover.layout, queries, False)
        filtered = Record(problem, mover.layout, {}, False)
        window: deque[Cloud] = deque(maxlen=lag + 1)
        rng, rows, last = stream(seed, Purpose.FILTER), problem.series, problem.steps - 1
        cloud: Cloud | None = None

        def move(k: int) -> None:
            nonlocal cloud
            row = rows.row(k)
            cloud = mover.first(row, rng) if cloud is None else mover.next(cloud, row, rng)
            filtered.add(k, cloud)
            window.append(cloud)
            while window and (len(window) > lag or k == last):
                at = k - len(window) + 1
                record.add(at, lagged(list(window), mover.layout, mover.slices))
                window.popleft()

        with Progress(problem.steps, self.label, progress) as bar, _quiet():
            so_far = partial(filtered.posterior, self, "filter")
            pass_slices(rows.start, problem.steps, move, so_far, bar.advance)
        whole = filtered.posterior(self)
        self._warn_of_collapse(whole)
        return self._given_filtered(record.posterior(self, "fixed-lag"), whole)

    def _given_filtered(
        self, found: FilteredParticles, filtered: FilteredParticles
    ) -> FilteredParticles:
        """Smoothed answers with the filter's figures."""
        found.log_marginal_increments = filtered.log_marginal_increments
        found.log_marginal_likelihood = filtered.log_marginal_likelihood
        found.weight_ess, found.resampled = filtered.weight_ess, filtered.resampled
        found.unique_ancestors = filtered.unique_ancestors
        found.rejuvenated = filtered.rejuvenated
        return found

    def _nothing(self, dbn: DynamicBayesNet, static: Mapping[str, Any], rng: Any) -> ParticleBelief:
        return ParticleBelief(dbn, seed_sequence(rng), static)

    def _absorbed(self, belief: ParticleBelief, slices: Slices, row: Row) -> ParticleBelief:
        mover = belief.mover
        if mover is None:
            mover = self._mover(slices, read_static(slices, belief.static))
            warn_of_what_is_not_guided(self, slices, row.seen)
        chance = belief.chance
        rng = stream(belief.seed, Purpose.FILTER) if chance is None else resumed(chance)
        with _quiet():
            if belief.cloud is None:
                cloud = mover.first(row, rng)
            else:
                cloud = mover.next(belief.cloud, row, rng)
        total = belief.log_marginal_likelihood + cloud.increment
        return ParticleBelief(
            belief.dbn, belief.seed, belief.static, mover, cloud,
            total if np.ndim(total) else float(total), rng.bit_generator.state,
            {n: row.inputs[n] for n in slices.template.inputs},
        )  # fmt: skip

    # ---- private -------------------------------------------------------------------------------

    def _passed(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        keep: bool,
        queries: Queries,
        progress: bool | None,
    ) -> FilteredParticles:
        """All slices, one by one; Ctrl-C goes on, with the answer so far."""
        static = {n: o.value for n, o in problem.series.static.items()}
        asked = _asked(queries, problem.slices)
        mover = self._mover(problem.slices, static, None if keep else [*problem.hidden, *asked])
        record = Record(problem, mover.layout, queries, keep)
        rng, rows = stream(seed, Purpose.FILTER), problem.series
        cloud: Cloud | None = None

        def move(k: int) -> None:
            nonlocal cloud
            row, old = rows.row(k), cloud
            cloud = mover.first(row, rng) if old is None else mover.next(old, row, rng)
            record.add(k, cloud)
            if old is not None and not keep:
                mover.recycle(old)

        with Progress(problem.steps, self.label, progress) as bar, _quiet():
            so_far = partial(record.posterior, self, "filter")
            pass_slices(rows.start, problem.steps, move, so_far, bar.advance)
        return record.posterior(self)

    def _warn_of_collapse(self, filtered: FilteredParticles) -> None:
        """One warning where many slices rest on what is little more than one particle.

        A surprising row now and then does that to any filter, and the next rows mend it.
        """
        assert filtered.weight_ess is not None
        ess = filtered.weight_ess.reshape(filtered.steps, -1)
        poor = ess < min(_COLLAPSED, 0.9 * self.particles)
        share = poor.mean(axis=0)
        worst = int(share.argmax())
        if share[worst] > _MANY:
            own = ess[:, worst]
            at = int(own.argmin())
            warnings.warn(
                f"ParticleFilter: in {int(poor[:, worst].sum())} of {len(own)} slices the {self.particles} "
                f"particles are worth less than {_COLLAPSED:g} equally weighted ones (weight_ess; "
                f"{own[at]:.1f} in slice {filtered.start + at}), so means, spreads and the evidence rest on "
                "one of them: use more particles, a proposal= that looks at the observations, or less narrow "
                "noise",
                LowEssWarning,
                stacklevel=4,
            )

    def _proposals(self, slices: Slices) -> SliceProposals:
        assert not isinstance(self.proposal, str)
        first = self.initial_proposal or {}
        return SliceProposals(slices, self.proposal or {}, "ParticleFilter", first)

    def _mover(
        self,
        slices: Slices,
        static: Mapping[str, np.ndarray],
        kept: Sequence[str] | None = None,
    ) -> Mover:
        self._require_functions()
        scheme: Any = scheme_of(self.resampling)
        threshold = float(self.ess_threshold)
        if isinstance(scheme, Adaptive):
            scheme, threshold = scheme_of(scheme.scheme), scheme.threshold
        scheme = checked(scheme)
        apart = plates_apart(slices)
        if isinstance(self.proposal, str):
            plan: SlicePlan = OptimalPlan(slices, apart, static)
        else:
            plan = SlicePlan(slices, apart, static, self._proposals(slices))
        stage: Any = None
        if callable(self.auxiliary):
            stage = GivenStage(plan, self.auxiliary, self.particles)
        elif self.auxiliary:
            stage = PluggedIn(plan, self.particles)
        anew = Rejuvenation(plan, self.rejuvenation) if self.rejuvenation is not None else None
        lost = Lost(plan, self.recovery) if self.recovery is not None else None
        wanted = kept if kept is None or self.adapt is None else [*kept, *self.adapt.widths]
        return Mover(
            slices, self.particles, scheme, threshold, plan, stage, anew, wanted, self.adapt, lost
        )


# ---- private ------------------------------------------------------------------------------------


_NOT_SMOOTHED = (
    "ParticleFilter: particles whose number changes (adapt=), or that begin anew (recovery=), are not "
    "smoothed; leave these out, and declare what can happen in the transition"
)


def _seen(problem: SeriesProblem) -> set[str]:
    """Nodes that are seen in full in all slices."""
    return {n for n, o in problem.series.observed.items() if o.mask is None}


def _not_backwards(name: str) -> str:
    return (
        f"ParticleFilter: {name!r} is computed from its own past without end, so trajectories cannot be "
        "drawn backwards (lags of some slices can); smooth with lag=, or use infer(dbn, observations, "
        "engine=ParticleGibbs())"
    )


def _check_count(option: str, given: Any, what: str) -> None:
    if isinstance(given, bool) or not isinstance(given, (int, np.integer)) or given < 1:
        raise ValueError(
            f"ParticleFilter({option}={given!r}): give a number of {option}, 1 or more, {what}"
        )


def _check_threshold(given: Any) -> None:
    if isinstance(given, bool) or not isinstance(given, (int, float)) or not given >= 0:
        raise ValueError(
            f"ParticleFilter(ess_threshold={given!r}): give a share of the particles, 0 (never resample) "
            "to 1 (always)"
        )


def _check_choice(option: str, given: Any, one: str, other: str) -> None:
    if given not in (one, other):
        raise ValueError(f'ParticleFilter({option}={given!r}): give "{one}" or "{other}"')


def _check_kind(option: str, given: Any, kind: type) -> None:
    if given is not None and not isinstance(given, kind):
        raise TypeError(f"ParticleFilter({option}={given!r}): give a {kind.__name__}(...), or None")


def _read_functions(option: str, given: Any) -> Any:
    """Functions by node, checked and frozen; ``"optimal"`` and None as they are."""
    if option == "proposal" and isinstance(given, str):
        if given != "optimal":
            raise ValueError(
                f'ParticleFilter(proposal={given!r}): give "optimal", or a dict from node name to {FUNCTION}'
            )
        return given
    if given is None:
        return None
    functions = check_specification("ParticleFilter", given, FUNCTION, option)
    for key, spec in functions.items():
        as_function("ParticleFilter", key, spec, FUNCTION, option)
    return MappingProxyType(functions)


def _asked(queries: Queries, slices: Slices) -> list[str]:
    """Nodes that queries read."""
    found = []
    for query, function in queries.items():
        for name in inspect.signature(function).parameters:
            if name not in slices.dynamic:
                raise UnknownNodeError(
                    f"queries={{{query!r}: ...}} reads {name!r}, which is no node of a slice"
                    f"{did_you_mean(name, slices.dynamic)}; there are {list(slices.dynamic)}"
                )
            found.append(name)
    return found


@contextmanager
def _quiet() -> Iterator[None]:
    with marking_invalid(), np.errstate(all="ignore"):
        yield
