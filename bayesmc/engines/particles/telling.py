"""What a particle filter says of its looks at the row: in ``explain``, and in a warning where it has none."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from typing import Any

from bayesmc.dbn import SeriesProblem, Slices
from bayesmc.engines.particles.auxiliary import PluggedIn
from bayesmc.engines.particles.optimal import guidance
from bayesmc.engines.slice_steps import SlicePlan, plates_apart
from bayesmc.errors import ProposalWarning
from bayesmc.kernels.proposal import names_of
from bayesmc.network import Observed


def looks_told(engine: Any, problem: SeriesProblem, treated: Mapping[str, str]) -> dict[str, str]:
    """What is done to nodes that a proposal or a look ahead concerns, given what is done to them otherwise.

    Parameters
    ----------
    engine : ParticleFilter
    problem : SeriesProblem
    treated : dict
        Node -> words.
    """
    slices, seen = problem.slices, problem.series.observed
    found = dict(treated)
    for key in engine.proposal if isinstance(engine.proposal, Mapping) else ():
        for name in names_of(key):
            found[name] = found[name].replace(
                "sampled given its parents", "sampled from its proposal"
            )
    if engine.proposal == "optimal":
        told = guidance(slices, seen, plates_apart(slices), min(problem.steps - 1, 1))
        for name, by in told.guided.items():
            found[name] = f"sampled with a look at {', '.join(map(repr, by))}"
        for name in seen:
            guided = [repr(n) for n, by in told.guided.items() if name in by]
            if guided:
                found[name] += f"; guides {', '.join(guided)}"
        for name, why in told.unguided.items():
            found[name] += f"; not guided: {why}"
        for name, why in told.unheard.items():
            found[name] += f"; guides nothing: {why}"
    if engine.auxiliary is True and problem.steps > 1:
        static = {n: o.value for n, o in problem.series.static.items()}
        stage = PluggedIn(SlicePlan(slices, plates_apart(slices), static), engine.particles)
        whole = {n: Observed(o.value[1]) for n, o in seen.items()}
        for name, how in stage.treated(problem.series.row(1)._replace(seen=whole)).items():
            found[name] += f"; {how} by the look ahead"
    return found


def warn_of_what_is_not_guided(engine: Any, slices: Slices, seen: Collection[str]) -> None:
    """One warning where ``proposal="optimal"`` leaves a hidden number to its own density.

    Call it from ``filter`` or ``smooth`` itself.

    Warns
    -----
    ProposalWarning
    """
    if engine.proposal != "optimal":
        return
    missing = guidance(slices, seen, plates_apart(slices)).missing()
    if missing is not None:
        warnings.warn(
            f'ParticleFilter(proposal="optimal") does not guide all that is hidden: {missing}. What is '
            "not guided is drawn from its own density; give proposal={...} for it, or use more particles",
            ProposalWarning,
            stacklevel=4,
        )
