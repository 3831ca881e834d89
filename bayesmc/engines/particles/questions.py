"""Which questions a particle filter answers, which not and why, and what it does with each node."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.slice_steps import SliceProposals, plates_apart
from bayesmc.network.forward import refuse_noiseless, refuse_parts, refuse_unsampled, whole

if TYPE_CHECKING:
    from bayesmc.engines.particles.filter import ParticleFilter


def check_together(engine: ParticleFilter) -> None:
    """Refuse options that only make sense with others, or without them.

    Raises
    ------
    ValueError
    """
    if isinstance(engine.proposal, str) and engine.initial_proposal is not None:
        raise ValueError(
            'ParticleFilter: proposal="optimal" proposes for slice 0 too; leave initial_proposal= out'
        )
    if engine.recovery is not None and engine.rejuvenation is not None:
        raise ValueError(
            "ParticleFilter: recovery= and rejuvenation= both begin anew; give one of them"
        )
    if engine.adapt is not None and engine.auxiliary is not False:
        raise ValueError("ParticleFilter: adapt= and auxiliary= do not go together")
    if (engine.on_degeneracy == "rejuvenate") != (engine.rejuvenation is not None):
        raise ValueError(
            'ParticleFilter: on_degeneracy="rejuvenate" and rejuvenation={node: density} go together'
        )


def refused(
    engine: ParticleFilter, problem: SeriesProblem, asked: SliceProposals | None
) -> str | None:
    """Why the filter does not answer, beside what all filters refuse; None where it does.

    Raises
    ------
    ModelError
        From the proposals that are ``asked`` for.
    """
    looks = [o for o in ("proposal", "initial_proposal", "auxiliary") if getattr(engine, o)]
    parts = refuse_parts(problem.series.observed, f"ParticleFilter({looks[0]}=)") if looks else None
    if parts is not None:
        return parts
    apart = plates_apart(problem.slices)
    for option in ("adapt", "recovery"):
        if getattr(engine, option) is not None and apart:
            return (
                f"ParticleFilter: {option}= is for one filter, and elements of plate {apart[0]!r} are "
                "filtered separately; filter them one by one"
            )
    if engine.adapt is not None:
        engine.adapt.check(problem.slices.later, problem.slices.interface)
    known = {*problem.slices.template.static, *problem.series.observed}
    if asked is not None:
        seen = problem.series.observed
        asked.check(seen.keys(), {n for n, o in seen.items() if o.mask is None})
    for model in (problem.slices.first, problem.slices.later):
        inside = {n for n in model.nodes if n not in problem.slices.dynamic} | known
        reason = refuse_unsampled(model, inside, "ParticleFilter") or refuse_noiseless(
            model, whole(problem.series.observed), "ParticleFilter"
        )
        if reason is not None:
            return reason
    return None


def described(problem: SeriesProblem) -> dict[str, str]:
    """What happens to each node, in words."""
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
    return found
