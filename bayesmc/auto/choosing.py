"""Which engine answers over time: what can, in which order, and why not another."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

from bayesmc.auto.explanation import Explanation
from bayesmc.auto.switching import REASON, why_too_long, within_budget
from bayesmc.dbn import DynamicBayesNet, SeriesProblem, pose_series
from bayesmc.engines.discrete.filter import DiscreteFilter
from bayesmc.engines.factored.filter import BoyenKoller, FactoredFrontier
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, picks_told, read_queries
from bayesmc.engines.grid.filter import GridFilter
from bayesmc.engines.kalman.filter import KalmanFilter
from bayesmc.engines.marginal.options import asking, is_worth_it
from bayesmc.engines.options import engine_meant
from bayesmc.engines.particles.filter import ParticleFilter
from bayesmc.engines.propagation.engine import ExpectationPropagation
from bayesmc.engines.refusals import common_refusal
from bayesmc.engines.switching.filter import SwitchingKalmanFilter
from bayesmc.errors import EngineWarning, UnsupportedError

#: engines in the order in which they are tried
_CANDIDATES: tuple[type[FilterEngine], ...] = (
    DiscreteFilter,
    BoyenKoller,
    KalmanFilter,
    GridFilter,
    ExpectationPropagation,
    SwitchingKalmanFilter,
    ParticleFilter,
)
_WHY = {
    "DiscreteFilter": "all hidden nodes are finite",
    "BoyenKoller": "all hidden nodes are finite, but too many for one joint state",
    "KalmanFilter": "all hidden nodes are linear-Gaussian",
    "ExpectationPropagation": REASON,
    "SwitchingKalmanFilter": "hidden numbers are linear-Gaussian given finite nodes; answers are approximate",
    "ParticleFilter": "every hidden node can be sampled given its parents",
    "GridFilter": "hidden nodes are finite, angles, on bounded intervals, or the one number of a slice",
}
_QUESTIONS = ("filter", "smooth", "fixed-lag", "forecast", "most_likely")


def explained_series(
    dbn: DynamicBayesNet,
    observations: Mapping[str, Any] | None,
    engine: FilterEngine | None,
    inputs: Mapping[str, Any] | None,
    question: str,
    keep: str | None = None,
    queries: Queries | None = None,
) -> Explanation:
    """See ``explain``."""
    if question not in _QUESTIONS:
        raise ValueError(
            f"explain(question={question!r}): there are {', '.join(map(repr, _QUESTIONS))}"
        )
    problem = pose_series(dbn, observations, inputs)
    asked = Asked(question, keep, read_queries("explain", queries))
    if engine is None:
        chosen, reasons, refused, _ = _choose(problem, asked)
        nodes = asking(chosen, question).describe(problem)
        return Explanation(
            chosen, reasons, refused, nodes, effort=chosen.effort_for(problem, asked)
        )
    checked = checked_engine(engine)
    why = _why_not(checked, problem, asked)
    if why is None:
        teller = asking(checked, question)
        nodes, effort = teller.describe(problem), teller.effort_for(problem, asked)
        return Explanation(checked, ("it was asked for",), {}, nodes, effort=effort)
    reasons = ("it was asked for, but it cannot answer",)
    return Explanation(checked, reasons, {type(checked).__name__: why})


def evidence_engine(problem: SeriesProblem, engine: FilterEngine | None) -> FilterEngine:
    """The engine that tells the log evidence of a series without random error.

    Raises
    ------
    UnsupportedError
        It draws at random, gives no evidence, or no such engine takes the model.
    """
    chosen = engine_for(problem, engine, Asked("filter"))
    if isinstance(chosen, ParticleFilter):
        raise UnsupportedError(
            "fit: the evidence by a ParticleFilter has a random error, and a climb would follow it; "
            "infer the static "
            "nodes with engine=ParticleMetropolis(draws), or take a deterministic filter "
            "(engine=GridFilter(), "
            "UnscentedKalmanFilter(), SwitchingKalmanFilter())"
        )
    return chosen


def engine_for(problem: SeriesProblem, engine: FilterEngine | None, asked: Asked) -> FilterEngine:
    """The engine asked for, or the one chosen; a refusal is raised with an alternative."""
    if engine is None:
        chosen = _choose(problem, asked)
        if chosen.instead is not None:
            warnings.warn(
                f"{asked.what}: {chosen.instead}; if that is what you want, name the engine, "
                f"engine={type(chosen.engine).__name__}(...)",
                EngineWarning,
                stacklevel=3,
            )
        return chosen.engine
    with picks_told(problem.slices, problem.series):
        reason = checked_engine(engine).refusal(problem)
    if reason is None:
        return engine  # what else it cannot do, its own method says best
    others = [c() for c in _CANDIDATES if not isinstance(engine, c)]
    able = next((type(o).__name__ for o in others if _why_not(o, problem, asked) is None), None)
    unable = [
        f"{type(o).__name__}()"
        for o in (*others, FactoredFrontier())
        if f"{type(o).__name__}()" in reason and type(o) is not type(engine)
        if _why_not(o, problem, asked) is not None
    ]
    if unable:
        reason = f"{reason} (of these {' and '.join(unable)} cannot answer here, either)"
    if able is None or re.search(rf"\buse [^.;]*\b{able}\b", reason):  # which says it already
        raise UnsupportedError(reason)
    raise UnsupportedError(f"{reason}. {able}() can answer")


def checked_engine(engine: Any) -> FilterEngine:
    """An engine over time; anything else is refused.

    Raises
    ------
    TypeError
    """
    if isinstance(engine, type):
        raise TypeError(
            f"engine={engine.__name__} is a class; give an instance: {engine.__name__}()"
        )
    if not isinstance(engine, FilterEngine):
        raise TypeError(
            f"engine={engine!r} is no engine over time{engine_meant(engine)}; use "
            "ParticleFilter(particles), KalmanFilter(), "
            "DiscreteFilter(), ..., or unroll the template for a static engine"
        )
    return engine


# ---- private ------------------------------------------------------------------------------------


class _Chosen(NamedTuple):
    """An engine that was chosen, why, why not others, and which an option kept from being chosen."""

    engine: FilterEngine
    reasons: tuple[str, ...]
    refused: dict[str, str]
    instead: str | None = None


def _choose(problem: SeriesProblem, asked: Asked) -> _Chosen:
    refused: dict[str, str] = {}
    late: list[FilterEngine] = []
    displaced: FilterEngine | None = None
    plain = Asked(asked.what)
    for candidate in _CANDIDATES:
        engine, name = _made(candidate, problem, asked), candidate.__name__
        if isinstance(engine, BoyenKoller) and not DiscreteFilter().is_out_of_room(problem):
            continue  # it has nothing to say that an exact filter does not
        if isinstance(engine, ExpectationPropagation) and asked.what != "smooth":
            continue  # its first pass forward is the switching filter's
        reason = engine.refusal(problem)
        if reason is None:
            reason = engine.unable(problem, asked)
            if reason is not None and displaced is None and engine.unable(problem, plain) is None:
                displaced = engine if engine.is_displaced(problem) else None
        if reason is None and (silent := engine.unanswered(problem)):
            reason = f"it would not answer for {', '.join(map(repr, silent))}"
        if reason is None:
            reason = engine.unasked(problem, asked)
            if reason is None and isinstance(engine, ExpectationPropagation):
                reason = why_too_long(engine, problem)
            if reason is not None:
                late.append(engine)
        if reason is None:
            instead = _instead(engine, displaced, asked, refused)
            why = asking(engine, asked.what).reasons(problem) or (_WHY[name],)
            return _Chosen(engine, why if instead is None else (*why, instead), refused, instead)
        refused[name] = reason
    if late:  # nothing that is better can answer
        name = type(late[0]).__name__
        del refused[name]
        return _Chosen(late[0], (_WHY[name],), refused)
    alike = common_refusal("no engine over time", problem)
    if alike is not None:  # all of them say it
        raise UnsupportedError(f"{asked.what}: {alike}")
    whys = ". ".join(w if w.startswith(n) else f"{n}: {w}" for n, w in refused.items())
    raise UnsupportedError(f"{asked.what}: no engine can answer. {whys}")


def _made(candidate: type[FilterEngine], problem: SeriesProblem, asked: Asked) -> FilterEngine:
    """A candidate; particles integrate out what they can, where they answer what is asked then."""
    if candidate is ParticleFilter and common_refusal(ParticleFilter(), problem) is None:
        engine = ParticleFilter(marginalize="auto")
        if (
            is_worth_it(asking(engine, asked.what), problem)
            and _why_not(engine, problem, asked) is None
        ):
            return engine
    if candidate is ExpectationPropagation and asked.what == "smooth":
        return within_budget(problem)
    return candidate()


def _instead(
    chosen: FilterEngine, displaced: FilterEngine | None, asked: Asked, refused: Mapping[str, str]
) -> str | None:
    """What an option does to the choice of engine."""
    if displaced is None:
        return None
    option = f"keep={asked.keep!r}" if asked.keep is not None else f"queries={list(asked.queries)}"
    name = type(displaced).__name__
    return f"{option} has {type(chosen).__name__} answer where {name} would without it ({refused[name]})"


def _why_not(engine: FilterEngine, problem: SeriesProblem, asked: Asked) -> str | None:
    """Why an engine has no answer, or None."""
    reason = engine.refusal(problem)
    return engine.unable(problem, asked) if reason is None else reason
