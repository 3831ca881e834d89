"""The step that the options of a particle filter ask for."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Slices
from bayesmc.engines.marginal.options import split_asked
from bayesmc.engines.marginal.step import MarginalStep
from bayesmc.engines.particles.auxiliary import GivenStage, PluggedIn
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.optimal import OptimalPlan
from bayesmc.engines.particles.recovery import Recovery
from bayesmc.engines.particles.rejuvenation import Injection, Rejuvenation
from bayesmc.engines.slice_steps import SlicePlan, SliceProposals, plates_apart
from bayesmc.resampling import Adaptive, checked, scheme_of


def made_step(
    engine: Any,
    slices: Slices,
    static: Mapping[str, np.ndarray],
    kept: Sequence[str] | None,
    seen: Collection[str],
) -> FilterStep:
    """The step of a filter with a number of particles; see ``ParticleFilter.step_of``."""
    scheme: Any = scheme_of(engine.resampling)
    threshold = float(engine.ess_threshold)
    if isinstance(scheme, Adaptive):
        scheme, threshold = scheme_of(scheme.scheme), scheme.threshold
    apart, count = plates_apart(slices), engine.particles
    is_optimal = isinstance(engine.proposal, str)
    asked = None
    if not is_optimal:
        first = engine.initial_proposal or {}
        asked = SliceProposals(slices, engine.proposal or {}, "ParticleFilter", first)
    if (split := split_asked(engine, slices, static, seen)) is not None:
        plan = SlicePlan(slices, apart, static)
        return MarginalStep(plan, split, count, checked(scheme), threshold, kept, asked)
    plan = (
        OptimalPlan(slices, apart, static)
        if is_optimal
        else SlicePlan(slices, apart, static, asked)
    )
    stage: Any = None
    if callable(engine.auxiliary):
        stage = GivenStage(plan, engine.auxiliary, count)
    elif engine.auxiliary:
        stage = PluggedIn(plan, count)
    renewed = None if engine.rejuvenation is None else Rejuvenation(plan, engine.rejuvenation)
    recovery: Recovery | None = engine.recovery
    injection = None if recovery is None else Injection(plan, recovery)
    wanted = kept if kept is None or engine.adapt is None else [*kept, *engine.adapt.widths]
    return FilterStep(
        plan, count, checked(scheme), threshold, stage, renewed, wanted, engine.adapt, injection
    )
