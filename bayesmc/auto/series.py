"""``filter``, ``smooth``, ``forecast``, ``most_likely``: one template, the same calls for every engine."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from bayesmc.auto.explanation import Explanation
from bayesmc.auto.switching import REASON, settled_or_kim, why_too_long, within_budget
from bayesmc.dbn import DynamicBayesNet, SeriesProblem, pose_series
from bayesmc.dbn.given import check_steps
from bayesmc.engines.discrete.filter import DiscreteFilter
from bayesmc.engines.factored.filter import BoyenKoller, FactoredFrontier
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, common_refusal, read_queries
from bayesmc.engines.grid.filter import GridFilter
from bayesmc.engines.kalman.filter import KalmanFilter
from bayesmc.engines.marginal.options import asking, is_worth_it
from bayesmc.engines.particles.filter import ParticleFilter
from bayesmc.engines.propagation.engine import ExpectationPropagation
from bayesmc.engines.switching.filter import SwitchingKalmanFilter
from bayesmc.errors import EngineWarning, UnsupportedError
from bayesmc.randomness import seed_sequence
from bayesmc.results import SeriesPosterior

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


def filter(
    dbn: DynamicBayesNet,
    observations: Mapping[str, Any],
    *,
    inputs: Mapping[str, Any] | None = None,
    engine: FilterEngine | None = None,
    rng: Any = None,
    progress: bool | None = None,
    keep: str | None = None,
    queries: Queries | None = None,
) -> SeriesPosterior:
    """Beliefs about every slice given the rows up to it.

    Parameters
    ----------
    dbn : DynamicBayesNet
    observations : dict
        Node -> its rows, time first, shape ``(time, *plates, *event)``. Row k belongs to slice k; NaN, a
        masked entry or None is missing. Static nodes are given without time.
    inputs : dict, optional
        Input -> its rows, time first.
    engine : optional
        ``ParticleFilter(particles)``, ...; None chooses (see ``explain``).
    rng : seed, SeedSequence, Generator or None
    keep : "particles", optional
        Hold the particles of all slices, for queries afterwards; memory grows with time.
    queries : dict, optional
        Name -> function of nodes of a slice, whose arguments have an axis of points, cells, states or
        particles first; its expectation in every slice is in ``.queries``, its standard error, where one is
        stated, in ``.queries_mcse``.

    Returns
    -------
    SeriesPosterior

    Raises
    ------
    ModelError, EvidenceError, UnsupportedError, DegeneracyError

    Warns
    -----
    EngineWarning
        ``keep`` or ``queries`` has another engine answer than would without it.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(np.abs(x), 0.5))
    >>> engine = bmc.ParticleFilter(2000)
    >>> filtered = bmc.filter(dbn, {"y": [0.8, 1.4, np.nan]}, engine=engine, rng=0)
    >>> filtered.std("x").shape
    (3,)
    """
    problem = pose_series(dbn, observations, inputs)
    chosen = _engine(problem, engine, Asked("filter", keep, read_queries("filter", queries)))
    options: dict[str, Any] = {"keep": keep, "queries": queries, "progress": progress}
    return chosen.filter(problem, seed_sequence(rng), **options)


def smooth(
    dbn: DynamicBayesNet,
    observations: Mapping[str, Any],
    *,
    inputs: Mapping[str, Any] | None = None,
    engine: FilterEngine | None = None,
    rng: Any = None,
    progress: bool | None = None,
    lag: int | None = None,
    queries: Queries | None = None,
    trajectories: int | None = None,
    backward: str | None = None,
) -> SeriesPosterior:
    """Beliefs about every slice given all rows, or with ``lag`` given those up to so many slices later.

    Other parameters and errors are those of ``filter``.

    Warns
    -----
    EngineWarning
        Where no engine is named and messages of ``ExpectationPropagation``, which switching systems are
        smoothed by, do not come near to settling: then ``SwitchingKalmanFilter`` answers.

    Parameters
    ----------
    lag : int, optional
    trajectories : int, optional
        How many a particle filter draws backwards; by default as many as there are particles, 1,000 at most.
    backward : "rejection" or "exact", optional
        How it draws them: by rejection where the transition's height is known (the same law); what is still
        open, and elsewhere all, among 500 particles of the slice drawn by weight and the filter's own
        ancestor. So time is that of the filter, and at most some 500 densities per trajectory and slice (as
        many times as lags reach back). With ``marginalize=`` 32 and the ancestor, without rejection.
        ``"exact"`` tries all particles for each.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
    >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]])
    >>> bmc.smooth(dbn, {"umbrella": [1, 1]}).probabilities("rain").round(3).tolist()
    [[0.117, 0.883], [0.117, 0.883]]
    """
    problem = pose_series(dbn, observations, inputs)
    if lag is not None and (
        isinstance(lag, bool) or not isinstance(lag, (int, np.integer)) or lag < 0
    ):
        raise ValueError(f"smooth(lag={lag!r}): lag is a number of slices, 0 or more, or None")
    kind = "smooth" if lag is None else "fixed-lag"
    chosen = _engine(problem, engine, Asked(kind, None, read_queries("smooth", queries)))
    own = {"trajectories": trajectories, "backward": backward}
    options: dict[str, Any] = {n: given for n, given in own.items() if given is not None}
    if options and not isinstance(chosen, ParticleFilter):
        name = next(iter(options))
        raise ValueError(
            f"smooth({name}={options[name]!r}): it says how particles are smoothed, and "
            f"{type(chosen).__name__} has none; leave it out, or give engine=ParticleFilter()"
        )
    if engine is None and isinstance(chosen, ExpectationPropagation):
        return settled_or_kim(chosen, problem, queries, progress)
    options |= {"lag": lag, "queries": queries, "progress": progress}
    return chosen.smooth(problem, seed_sequence(rng), **options)


def forecast(
    dbn: DynamicBayesNet,
    observations: Mapping[str, Any],
    *,
    steps: int,
    inputs: Mapping[str, Any] | None = None,
    engine: FilterEngine | None = None,
    rng: Any = None,
    progress: bool | None = None,
    queries: Queries | None = None,
) -> SeriesPosterior:
    """Beliefs about the ``steps`` slices after the last row, observed nodes included.

    ``inputs`` have rows for those slices, too. Other parameters and errors are those of ``filter``.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.5 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> bmc.forecast(dbn, {"x": [2.0]}, steps=3).mean("x").tolist()
    [1.0, 0.5, 0.25]
    """
    check_steps("forecast", steps)
    problem = pose_series(dbn, observations, inputs, ahead=steps)
    chosen = _engine(problem, engine, Asked("forecast", None, read_queries("forecast", queries)))
    options: dict[str, Any] = {"keep": None, "queries": queries, "progress": progress}
    return chosen.filter(problem, seed_sequence(rng), **options).last(steps, "forecast")


def most_likely(
    dbn: DynamicBayesNet,
    observations: Mapping[str, Any],
    *,
    inputs: Mapping[str, Any] | None = None,
    engine: FilterEngine | None = None,
    rng: Any = None,
    progress: bool | None = None,
) -> dict[str, np.ndarray]:
    """The most likely trajectory of all hidden nodes together: name -> user values, time first.

    It is one joint mode, as the Viterbi algorithm finds it, and not the sequence of each slice's own mode.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], ("no", "yes"), initial=[0.5, 0.5])
    >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]])
    >>> bmc.most_likely(dbn, {"umbrella": [1, 0, 0]})["rain"].tolist()
    ['yes', 'no', 'no']
    """
    problem = pose_series(dbn, observations, inputs)
    chosen = _engine(problem, engine, Asked("most_likely"))
    return chosen.most_likely(problem, seed_sequence(rng), progress)


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
    checked = _checked(engine)
    why = _why_not(checked, problem, asked)
    if why is None:
        teller = asking(checked, question)
        nodes, effort = teller.describe(problem), teller.effort_for(problem, asked)
        return Explanation(checked, ("it was asked for",), {}, nodes, effort=effort)
    reasons = ("it was asked for, but it cannot answer",)
    return Explanation(checked, reasons, {type(checked).__name__: why})


# ---- private ------------------------------------------------------------------------------------


def _engine(problem: SeriesProblem, engine: FilterEngine | None, asked: Asked) -> FilterEngine:
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
    reason = _checked(engine).refusal(problem)
    if reason is None:
        return engine  # what else it cannot do, its own method says best
    others = [c() for c in _CANDIDATES if not isinstance(engine, c)]
    able = next((type(o).__name__ for o in others if _why_not(o, problem, asked) is None), None)
    unable = [
        f"{type(o).__name__}()"
        for o in (*others, FactoredFrontier())
        if f"{type(o).__name__}(" in reason and type(o) is not type(engine)
        if _why_not(o, problem, asked) is not None
    ]
    if unable:
        reason = f"{reason} (of these {' and '.join(unable)} cannot answer here, either)"
    if able is None or re.search(rf"\buse [^.;]*\b{able}\b", reason):  # which says it already
        raise UnsupportedError(reason)
    raise UnsupportedError(f"{reason}. {able}() can answer")


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


def _checked(engine: Any) -> FilterEngine:
    if isinstance(engine, type):
        raise TypeError(
            f"engine={engine.__name__} is a class; give an instance: {engine.__name__}()"
        )
    if not isinstance(engine, FilterEngine):
        raise TypeError(
            f"engine={engine!r} is no engine over time; use ParticleFilter(particles), KalmanFilter(), "
            "DiscreteFilter(), ..., or unroll the template for a static engine"
        )
    return engine
