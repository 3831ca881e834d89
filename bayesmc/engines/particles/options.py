"""Options of a particle filter: what is wrong with them, and what they do to each node."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem, Slices
from bayesmc.engines.filtering import Queries
from bayesmc.engines.marginal.options import split_of_problem
from bayesmc.engines.particles.auxiliary import PluggedIn
from bayesmc.engines.particles.optimal import guidance
from bayesmc.engines.proposal import FUNCTION, as_function, check_specification
from bayesmc.engines.slice_steps import SlicePlan, SliceProposals, plates_apart
from bayesmc.errors import (
    ProposalWarning,
    UnknownNodeError,
    UnsupportedError,
    did_you_mean,
)
from bayesmc.kernels.proposal import names_of
from bayesmc.network import Observed
from bayesmc.network.forward import refuse_noiseless, refuse_parts, refuse_unsampled, whole
from bayesmc.network.node import nodes_read

#: why some particles are not smoothed
NOT_SMOOTHED = (
    "ParticleFilter: particles whose number changes (adapt=), or that begin anew (recovery=), are not "
    "smoothed; leave these out, and declare what can happen in the transition"
)


def check_count(option: str, given: Any, what: str, call: str = "ParticleFilter") -> None:
    """A whole number, 1 or more."""
    if isinstance(given, bool) or not isinstance(given, (int, np.integer)) or given < 1:
        raise ValueError(
            f"{call}({option}={given!r}): give a number of {option}, 1 or more, {what}"
        )


def check_number(
    option: str,
    given: Any,
    kinds: tuple[type, ...],
    is_good: Callable[[Any], bool],
    what: str,
    call: str = "ParticleFilter",
) -> None:
    """One number of some kinds."""
    if isinstance(given, bool) or not isinstance(given, kinds) or not is_good(given):
        raise ValueError(f"{call}({option}={given!r}): give {what}")


def check_numbers(engine: Any) -> None:
    """Options that are one number."""
    whole, real = (int, np.integer), (int, float)
    share = "a share of the particles, 0 (never resample) to 1 (always)"
    for option, kinds, is_good, what in (
        ("tolerance", real, lambda x: x > 0, "an error of the log evidence above 0, such as 0.5"),
        (
            "budget",
            whole,
            lambda x: x >= 1,
            "a number of particles times slices, such as 30_000_000",
        ),
        ("ess_threshold", real, lambda x: x >= 0, share),
    ):
        check_number(option, getattr(engine, option), kinds, is_good, what)


def check_choice(
    option: str, given: Any, one: str, other: str, call: str = "ParticleFilter"
) -> None:
    """One of two words."""
    if given not in (one, other):
        raise ValueError(f'{call}({option}={given!r}): give "{one}" or "{other}"')


def check_kind(option: str, given: Any, kind: type) -> None:
    """An object of a kind, or None."""
    if given is not None and not isinstance(given, kind):
        raise TypeError(f"ParticleFilter({option}={given!r}): give a {kind.__name__}(...), or None")


def read_functions(option: str, given: Any) -> Any:
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


def without_functions(engine: Any, options: Collection[str]) -> dict[str, Any]:
    """Its state as pickles carry it; ``options`` are those that hold functions by node."""
    state = dict(engine.__dict__)
    for option in options:
        if isinstance(state[option], Mapping):
            state[option] = dict.fromkeys(state[option])
    for option in ("resampling", "auxiliary"):
        state[option] = None if callable(state[option]) else state[option]
    return state


def read_by(queries: Queries, slices: Slices) -> list[str]:
    """Nodes that queries read."""
    found = []
    for query, function in queries.items():
        for name in nodes_read(function):
            if name not in slices.dynamic:
                raise UnknownNodeError(
                    f"queries={{{query!r}: ...}} reads {name!r}, which is no node of a slice"
                    f"{did_you_mean(name, slices.dynamic)}; there are "
                    f"{list(slices.dynamic)}"
                )
            found.append(name)
    return found


def check_together(engine: Any) -> None:
    """Refuse options that only make sense with others, or without them.

    Raises
    ------
    TypeError, ValueError
    """
    if not isinstance(engine.auxiliary, bool) and not callable(engine.auxiliary):
        what = "give True, False, or a function that returns log factors"
        raise TypeError(f"ParticleFilter(auxiliary={engine.auxiliary!r}): {what}")
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


def refused_parts(engine: Any, seen: Mapping[str, Observed]) -> str | None:
    """Why vectors seen in part are not taken: functions that are given would read what is not there."""
    looks = [o for o in ("proposal", "initial_proposal", "auxiliary") if getattr(engine, o)]
    looks = [o for o in looks if not isinstance(getattr(engine, o), str)]
    return refuse_parts(seen, f"ParticleFilter({looks[0]}=)") if looks else None


def check_parts(engine: Any, seen: Mapping[str, Observed]) -> None:
    """Refuse one row with such vectors.

    Raises
    ------
    UnsupportedError
    """
    parts = refused_parts(engine, seen)
    if parts is not None:
        raise UnsupportedError(parts)


def refused(engine: Any, problem: SeriesProblem, asked: SliceProposals | None) -> str | None:
    """Why the filter does not answer, beside what all filters refuse; None where it does.

    Raises
    ------
    ModelError
        From the proposals that are ``asked`` for.
    """
    parts = refused_parts(engine, problem.series.observed)
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
        asked.check(seen.keys(), problem.seen)
    split = None if engine.marginalize is None else split_of_problem(engine, problem)
    filtered = () if split is None else (*split.below, *split.inner)
    weighed = [n for n in whole(problem.series.observed) if n not in filtered]
    for model in (problem.slices.first, problem.slices.later):
        inside = {n for n in model.nodes if n not in problem.slices.dynamic} | known
        reason = refuse_unsampled(model, inside, "ParticleFilter") or refuse_noiseless(
            model, weighed, "ParticleFilter"
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
        plan = SlicePlan(slices, plates_apart(slices), problem.known_static)
        stage = PluggedIn(plan, engine.particles)
        full = {n: Observed(o.value[1]) for n, o in seen.items()}
        for name, how in stage.treated(problem.series.row(1)._replace(seen=full)).items():
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


def require_functions(engine: Any, options: Collection[str]) -> None:
    """Refuse an engine that came out of a pickle, and lost functions there."""
    given = [engine.resampling, engine.auxiliary]
    for option in options:
        functions = getattr(engine, option)
        given += functions.values() if isinstance(functions, Mapping) else ()
    whole = engine.recovery is None or engine.recovery.is_whole
    if not whole or any(value is None for value in given):
        raise UnsupportedError(
            "ParticleFilter: this engine is a pickle's or a file's, which hold no functions; give it anew"
        )
