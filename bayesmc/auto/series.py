"""``filter``, ``smooth``, ``forecast``, ``most_likely``: one template, the same calls for every engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from typing import Any, NamedTuple, Never, overload

import numpy as np

from bayesmc.auto.choosing import checked_engine, engine_for
from bayesmc.auto.files import Opened
from bayesmc.auto.several import Folder, is_several, seed_of, several
from bayesmc.auto.switching import settled_or_kim, warn_where_merging_matters
from bayesmc.dbn import DynamicBayesNet, SeriesProblem, pose_series
from bayesmc.dbn.frames import times_ahead
from bayesmc.dbn.given import check_steps
from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.engines.beliefs import OnlineBelief
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, picks_told, read_queries
from bayesmc.engines.particles.filter import ParticleFilter
from bayesmc.engines.paths import Paths, forecast_from
from bayesmc.engines.propagation.engine import ExpectationPropagation
from bayesmc.randomness import seed_sequence
from bayesmc.results import SeriesPosterior
from bayesmc.workers import check_executor


@overload
def filter(
    dbn: DynamicBayesNet, observations: Mapping[str, Any], **options: Any
) -> SeriesPosterior: ...
@overload
def filter(
    dbn: DynamicBayesNet, observations: Sequence[Mapping[str, Any]], **options: Any
) -> list[SeriesPosterior]: ...
@by_keyword  # type: ignore[misc]
def filter(
    dbn: DynamicBayesNet,
    observations: Any,
    *beyond: Never,
    inputs: Any = None,
    engine: FilterEngine | None = None,
    rng: Any = None,
    progress: bool | None = None,
    keep: str | None = None,
    queries: Queries | None = None,
    checkpoint: Any = None,
    executor: Any = None,
) -> Any:
    """Beliefs about every slice given the rows up to it.

    Parameters
    ----------
    dbn : DynamicBayesNet
    observations : dict or DataFrame
        Node -> its rows, time first, shape ``(time, *plates, *event)``. Row k belongs to slice k; NaN, a
        masked entry or None is missing. Static nodes are given without time. Of a data frame (pandas, polars,
        pyarrow) columns are nodes and inputs, and its index or a column of dates labels the slices
        (``.times``). A list of such is one of independent series, each with an answer of its own.
    inputs : dict or DataFrame, optional
        Input -> its rows, time first; of several series a list of such, or one for all.
    engine : optional
        ``ParticleFilter(particles)``, ...; None chooses (see ``explain``).
    rng : seed, SeedSequence, Generator or None
        Of several series each draws from a child of the seed.
    keep : "particles", optional
        Hold the particles of all slices, for queries afterwards; memory grows with time.
    queries : dict, optional
        Name -> function of nodes of a slice, whose arguments have an axis of points, cells, states or
        particles first; its expectation in every slice is in ``.queries``, its standard error, where one is
        stated, in ``.queries_mcse``.
    checkpoint : path or CheckpointFile, optional
        A file in which a particle filter saves itself as the slices pass (the extra ``netcdf``), and other
        filters their answer; the same call goes on where the run was, with the same bits (see ``infer``). Of
        a list of series a folder, in which series k has the file ``series<k>.nc``.
    executor : concurrent.futures.Executor, optional
        Who works out units of work: series of a list, islands of an ``IslandFilter``. The same seed gives
        the same bits with any, and with none.

    Returns
    -------
    SeriesPosterior
        Of several series a list of them.

    Raises
    ------
    ModelError, EvidenceError, UnsupportedError, DegeneracyError
    CheckpointError, DamagedFileError
        The file is of another run, and the message says what differs; the disk is full; or it was cut off.

    Warns
    -----
    EngineWarning
        ``keep`` or ``queries`` has another engine answer than would without it; or Gaussians were merged by a
        ``SwitchingKalmanFilter`` that nobody named, and that matters (``forecast``, too).

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
    if beyond:
        refuse_positions(filter, beyond)
    if executor is not None:
        check_executor("filter", executor)
    options: dict[str, Any] = {"keep": keep, "queries": queries, "progress": progress}
    if not isinstance(observations, Mapping) and is_several(observations):
        folder = None if checkpoint is None else Folder("filter", checkpoint)
        quiet, seed = {**options, "progress": False}, seed_of(folder, rng)
        engine = folder.engine if engine is None and folder is not None else engine
        work = progress, executor, folder
        return several("filter", _filtered, dbn, observations, inputs, engine, seed, quiet, *work)
    problem = pose_series(dbn, observations, inputs)
    own = None if rng is None else seed_sequence(rng)
    run = _begun(problem, engine, own, {**options, "checkpoint": checkpoint}, executor)
    with run.kept, picks_told(problem.slices, problem.series):
        # asked here: warnings name the line that called
        found = run.answer or run.engine.filter(problem, run.seed, **run.options)
        found = run.ended(problem, found)
    if engine is None:
        warn_where_merging_matters("filter", found, problem)
    return found


@overload
def smooth(
    dbn: DynamicBayesNet, observations: Mapping[str, Any], **options: Any
) -> SeriesPosterior: ...
@overload
def smooth(
    dbn: DynamicBayesNet, observations: Sequence[Mapping[str, Any]], **options: Any
) -> list[SeriesPosterior]: ...
@by_keyword  # type: ignore[misc]
def smooth(
    dbn: DynamicBayesNet,
    observations: Any,
    *beyond: Never,
    inputs: Any = None,
    engine: FilterEngine | None = None,
    rng: Any = None,
    progress: bool | None = None,
    lag: int | None = None,
    queries: Queries | None = None,
    trajectories: int | None = None,
    backward: str | None = None,
    checkpoint: Any = None,
    executor: Any = None,
) -> Any:
    """Beliefs about every slice given all rows, or with ``lag`` given those up to so many slices later.

    Other parameters and errors are those of ``filter``, several series and an executor for them included.

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
        many times as lags reach back). With ``marginalize=`` 96 and the ancestor, without rejection.
        ``"exact"`` tries all particles for each.

    checkpoint : path or CheckpointFile, optional
        A file in which the answer is saved at the end, and nothing before: a smoother goes back over all
        rows. The same call returns it. Of a list of series a folder, in which each is saved as it is done.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
    >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]])
    >>> bmc.smooth(dbn, {"umbrella": [1, 1]}).probabilities("rain").round(3).tolist()
    [[0.117, 0.883], [0.117, 0.883]]
    """
    if beyond:
        refuse_positions(smooth, beyond)
    if executor is not None:
        check_executor("smooth", executor)
    options = {
        "lag": lag, "queries": queries, "trajectories": trajectories, "backward": backward,
        "progress": progress,
    }  # fmt: skip
    if not isinstance(observations, Mapping) and is_several(observations):
        folder = None if checkpoint is None else Folder("smooth", checkpoint)
        quiet, seed = {**options, "progress": False}, seed_of(folder, rng)
        engine = folder.engine if engine is None and folder is not None else engine
        work = progress, executor, folder
        return several("smooth", _smoothed, dbn, observations, inputs, engine, seed, quiet, *work)
    problem = pose_series(dbn, observations, inputs)
    own = None if rng is None else seed_sequence(rng)
    found = _smoothed(problem, engine, own, {**options, "checkpoint": checkpoint})
    observations, inputs, found.times = dbn.unframed(observations, inputs)
    found.paths = Paths(problem, observations, inputs)
    return found


@by_keyword
def forecast(
    dbn: DynamicBayesNet | OnlineBelief,
    observations: Any = None,
    *beyond: Never,
    steps: int,
    inputs: Any = None,
    engine: FilterEngine | None = None,
    rng: Any = None,
    progress: bool | None = None,
    queries: Queries | None = None,
) -> SeriesPosterior:
    """Beliefs about the ``steps`` slices after the last row, observed nodes included.

    ``inputs`` have rows for those slices, too. Other parameters and errors are those of ``filter``.

    Parameters
    ----------
    dbn : DynamicBayesNet or belief
        A belief, which ``engine.step`` returned, goes on from its slice: it comes with the ``engine`` that
        made it and without observations, and ``inputs`` have rows for the slices ahead alone.
    steps : int

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.5 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> bmc.forecast(dbn, {"x": [2.0]}, steps=3).mean("x").tolist()
    [1.0, 0.5, 0.25]
    """
    if beyond:
        refuse_positions(forecast, beyond)
    check_steps("forecast", steps)
    if isinstance(dbn, OnlineBelief):
        return _from_belief(dbn, observations, steps, inputs, engine, queries)
    if observations is None:
        raise TypeError(
            "forecast: give the observations so far, or a belief in place of the template"
        )
    problem = pose_series(dbn, observations, inputs, ahead=steps)
    times = times_ahead(dbn.template, observations, inputs, problem.steps, steps)
    observations, inputs, _ = dbn.unframed(observations, inputs)
    chosen = engine_for(problem, engine, Asked("forecast", None, read_queries("forecast", queries)))
    options: dict[str, Any] = {"keep": None, "queries": queries, "progress": progress}
    found = chosen.filter(problem, seed_sequence(rng), **options)
    if engine is None:
        warn_where_merging_matters("forecast", found, problem)
    found = found.last(steps, "forecast")
    found.times = times
    found.paths = Paths(problem, observations, inputs)
    return found


@by_keyword
def most_likely(
    dbn: DynamicBayesNet,
    observations: Any,
    *beyond: Never,
    inputs: Any = None,
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
    if beyond:
        refuse_positions(most_likely, beyond)
    problem = pose_series(dbn, observations, inputs)
    chosen = engine_for(problem, engine, Asked("most_likely"))
    return chosen.most_likely(problem, seed_sequence(rng), progress)


# ---- private ------------------------------------------------------------------------------------


class _Run(NamedTuple):
    """A series that is about to be filtered, or was by an earlier call that saved its answer."""

    engine: FilterEngine
    seed: np.random.SeedSequence
    options: dict[str, Any]
    file: Any = None
    answer: SeriesPosterior | None = None

    @property
    def kept(self) -> AbstractContextManager[Any]:
        """The file of the run, closed in the end."""
        return nullcontext() if self.file is None else closing(self.file)

    def ended(self, problem: SeriesProblem, found: SeriesPosterior) -> SeriesPosterior:
        """The answer, with its times, and in the file where the engine has not put it there."""
        found.times = problem.times
        saved = self.file is None or self.engine.saves
        if not saved and not getattr(found, "interrupted", False):
            self.file.finish(found)
        return found


def _begun(
    problem: SeriesProblem,
    engine: FilterEngine | None,
    seed: np.random.SeedSequence | None,
    options: dict[str, Any],
    executor: Any = None,
) -> _Run:
    """What is to be run; without a seed by that of its file, or a new one."""
    checkpoint = options.get("checkpoint")
    options = {n: v for n, v in options.items() if n != "checkpoint"}
    opened = None
    if checkpoint is not None:
        opened = Opened("filter", checkpoint, problem, engine is not None)
    engine = opened.engine if engine is None and opened is not None else engine
    queries = read_queries("filter", options["queries"])
    chosen = engine_for(problem, engine, Asked("filter", options["keep"], queries))
    if executor is not None and chosen.spreads:
        options["executor"] = executor
    if seed is None:
        seed = seed_sequence(None) if opened is None else opened.seed(None)
    if opened is None:
        return _Run(chosen, seed, options)
    file, answer = opened.begin(chosen, seed, options["keep"], {"queries": options["queries"]})
    if file is not None and chosen.saves:
        options["checkpoint"] = file
    return _Run(chosen, seed, options, file, answer)


def _filtered(
    problem: SeriesProblem,
    engine: FilterEngine | None,
    seed: np.random.SeedSequence,
    options: dict[str, Any],
) -> SeriesPosterior:
    """One of several series."""
    run = _begun(problem, engine, seed, options)
    with run.kept, picks_told(problem.slices, problem.series):
        found = run.answer or run.engine.filter(problem, run.seed, **run.options)
        found = run.ended(problem, found)
    if engine is None:
        warn_where_merging_matters("filter", found, problem)
    return found


def _smoothed(
    problem: SeriesProblem,
    engine: FilterEngine | None,
    seed: np.random.SeedSequence | None,
    options: dict[str, Any],
) -> SeriesPosterior:
    """A smoothed series, its answer kept in a file where one is wanted."""
    checkpoint = options.get("checkpoint")
    options = {n: v for n, v in options.items() if n != "checkpoint"}
    file = None
    if checkpoint is not None:
        opened = Opened("smooth", checkpoint, problem, engine is not None)
        if engine is None and opened.header is not None and opened.header.get("named"):
            engine = opened.engine
        seed = opened.seed(None) if seed is None else seed
        chosen = _smoother(problem, engine or opened.engine, options)[0]
        asked = {n: options[n] for n in ("lag", "queries", "trajectories", "backward")}
        file, answer = opened.begin(chosen, seed, None, asked)
        if file is None:
            return answer
    own = seed_sequence(None) if seed is None else seed
    with nullcontext() if file is None else closing(file):
        chosen, given = _smoother(problem, engine, options)
        # called from here, since warnings count the calls up to the user's line
        if engine is None and isinstance(chosen, ExpectationPropagation):
            found = settled_or_kim(chosen, problem, options["queries"], options["progress"])
        else:
            with picks_told(problem.slices, problem.series):
                found = chosen.smooth(problem, own, **given)
            if engine is None:
                warn_where_merging_matters("smooth", found, problem, options["lag"])
        whole = found.steps == problem.steps and not getattr(found, "interrupted", False)
        if file is not None and whole:
            file.finish(found)
    return found


def _smoother(
    problem: SeriesProblem, engine: FilterEngine | None, options: dict[str, Any]
) -> tuple[FilterEngine, dict[str, Any]]:
    """Who smooths, and what it is told besides.

    Raises
    ------
    ValueError
    """
    lag, queries = options["lag"], options["queries"]
    if lag is not None and (
        isinstance(lag, bool) or not isinstance(lag, (int, np.integer)) or lag < 0
    ):
        raise ValueError(f"smooth(lag={lag!r}): lag is a number of slices, 0 or more, or None")
    kind = "smooth" if lag is None else "fixed-lag"
    chosen = engine_for(problem, engine, Asked(kind, None, read_queries("smooth", queries)))
    own = ("trajectories", "backward")
    given = {n: options[n] for n in own if options[n] is not None}
    if given and not isinstance(chosen, ParticleFilter):
        name = next(iter(given))
        raise ValueError(
            f"smooth({name}={given[name]!r}): it says how particles are smoothed, and "
            f"{type(chosen).__name__} has none; leave it out, or give engine=ParticleFilter()"
        )
    return chosen, given | {"lag": lag, "queries": queries, "progress": options["progress"]}


def _from_belief(
    belief: OnlineBelief, observations: Any, steps: int, inputs: Any, engine: Any, queries: Any
) -> SeriesPosterior:
    if observations is not None:
        raise TypeError(
            "forecast: a belief has absorbed its rows already; leave observations out, or take in more rows "
            "with engine.step(belief, row)"
        )
    if engine is None:
        raise TypeError("forecast: give engine=, the one whose step returned the belief")
    asked = read_queries("forecast", queries)
    return forecast_from(checked_engine(engine), belief, steps, inputs, asked)
