"""``infer_many``: many evidence sets on one prepared net."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple, Never

import numpy as np

from bayesmc.auto.files import Opened
from bayesmc.auto.several import Folder, in_folder, seed_of
from bayesmc.auto.static import able, check_keep, checked_answer, choice, run_saved
from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.engines.base import Engine
from bayesmc.engines.exact.exact import Exact
from bayesmc.engines.exact.many import Prepared, TablePosteriors
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import (
    BayesmcError,
    EvidenceError,
    EvidenceWarning,
    InterruptWarning,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import BayesNet, FactorGraph, Problem
from bayesmc.network.columns import is_frame, rows_of
from bayesmc.randomness import child, seed_sequence
from bayesmc.results import Posterior
from bayesmc.results.many import Posteriors
from bayesmc.workers import check_executor, completed
from bayesmc.workers.units import gathered, told_of_interrupt, workers_of

#: units of work for each worker, and questions in one at most: few enough for progress, many enough to travel
_UNITS, _MOST = 8, 64
#: impossible sets that a message names
_NAMED = 10


@by_keyword
def infer_many(
    net: BayesNet | FactorGraph | DynamicBayesNet,
    evidence: Any,
    *beyond: Never,
    inputs: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    engine: Any = None,
    rng: Any = None,
    progress: bool | None = None,
    keep: str | Sequence[str] = "draws",
    checkpoint: Any = None,
    executor: Any = None,
    on_impossible: str = "raise",
) -> Posteriors:
    """The posteriors of one net given many evidence sets, each as ``infer`` answers it.

    Where all nodes are finite, messages are passed for some hundred sets at once, whatever each of them
    observes. Elsewhere questions are answered one by one, here or by an executor's workers.

    Parameters
    ----------
    net : BayesNet, FactorGraph or DynamicBayesNet
        Compiled once for all sets with the same plate sizes.
    evidence : sequence of dict, or DataFrame
        One for each question; of a template, observations of one series each. Of a data frame each row is a
        question, with what is missing unobserved.
    inputs : dict or sequence of dict, optional
        The same for all, or one for each set.
    engine : optional
        None chooses, for each question.
    rng : seed, SeedSequence, Generator or None
        Question k draws from a child of the seed of its own: its answer does not depend on the other
        questions, nor on who works it out.
    progress : bool, optional
        Show a bar of units done.
    keep : "draws", "summaries" or a list of node names
        As in ``infer``.
    checkpoint : path or CheckpointFile, optional
        A folder in which question k has the file ``set<k>.nc``, as if it were asked about alone with
        ``infer(checkpoint=)``: the same call goes on where it was. Not where all sets are answered together,
        which takes less time than their files would.
    executor : concurrent.futures.Executor, optional
        Who answers batches of questions; see ``infer``.
    on_impossible : "raise" or "nan"
        What becomes of evidence of probability zero, or of which an engine finds no more. ``"nan"`` answers
        the other sets: NaN where it is asked about, ``posteriors[k]`` None, and why in
        ``posteriors.impossible``, with a warning.

    Returns
    -------
    Posteriors
        A sequence of posteriors that answers for all of them at once, evidence sets first.

    Raises
    ------
    EvidenceError, ModelError, UnsupportedError
        With the number of the evidence set. All sets are read before any is answered.
    ZeroProbabilityError
        Evidence is impossible, and of which sets, as far as they were asked.
    CheckpointError, DamagedFileError
        A file is of another run, and the message says what differs; the disk is full; or it was cut off.
    WorkerError

    Warns
    -----
    EvidenceWarning
        With ``on_impossible="nan"``: which sets are impossible.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> net.table("wet", ["rain"], [[0.9, 0.1], [0.1, 0.9]], states=("no", "yes"))
    >>> posteriors = bmc.infer_many(net, [{"wet": "yes"}, {"wet": "no"}, {}])
    >>> posteriors.probabilities("rain").round(3).tolist()
    [[0.308, 0.692], [0.973, 0.027], [0.8, 0.2]]
    """
    if beyond:
        refuse_positions(infer_many, beyond)
    check_executor("infer_many", executor)
    if on_impossible not in ("raise", "nan"):
        raise ValueError(
            f'infer_many(on_impossible={on_impossible!r}): give "raise", or "nan" to have the other sets '
            "answered"
        )
    sets = _read_sets(evidence)
    given = _read_inputs(inputs, len(sets))
    if not sets:
        return Posteriors([])
    with _in_set(0):
        first = pose_any(net, sets[0], given[0])
        check_keep("infer_many", keep, first, checkpoint)
        exact = engine
        if engine is None:
            exact = choice(first)
        elif isinstance(engine, Engine):
            exact = engine
    if type(exact) is Exact and (inputs is None or isinstance(inputs, Mapping)):
        prepared = Prepared.of(first, exact)
        states = None if prepared is None else prepared.states(sets)
        if prepared is not None and states is not None:
            if checkpoint is not None:
                raise UnsupportedError(
                    "infer_many(checkpoint=...): all sets are answered together here, exactly and in less "
                    "time than files of each would take; leave it out, and keep the answer by "
                    "posteriors.save(path)"
                )
            return _by_tables(prepared, states, progress, executor, on_impossible)
    problems = [first, *_posed(net, sets, given, first)]
    folder = None if checkpoint is None else Folder("infer_many", checkpoint, "set")
    if engine is None and folder is not None:
        engine = folder.engine
    shared = {
        "first": first, "engine": engine, "seed": seed_of(folder, rng), "keep": keep,
        "folder": None if folder is None else folder.file, "on_impossible": on_impossible,
    }  # fmt: skip
    return _one_by_one(problems, shared, progress, executor)


# ---- private ------------------------------------------------------------------------------------


def _by_tables(
    prepared: Prepared,
    states: np.ndarray,
    progress: bool | None,
    executor: Any,
    on_impossible: str,
) -> Posteriors:
    """Blocks of evidence sets on one clique tree."""
    units = list(prepared.units(states))
    shared = {"problem": prepared.problem, "engine": prepared.engine}
    flat: np.ndarray | None = None
    log_z = np.full(len(states), np.nan)
    prepared.problem.cache["prepared"] = prepared
    starts = np.cumsum([0, *map(len, units)])
    results = completed(
        _tables_answered, shared, units, executor,
        label="evidence sets", total=len(units), progress=progress,
    )  # fmt: skip
    try:
        for number, (logs, marginals) in results:
            if flat is None:
                flat = np.full((len(states), marginals.shape[1]), np.nan)
            at = slice(starts[number], starts[number + 1])
            log_z[at], flat[at] = logs, marginals
    except KeyboardInterrupt:
        done = int((~np.isnan(log_z)).sum())
        if not done:
            raise
        told_of_interrupt("infer_many", f"{done} of {len(log_z)} evidence sets", InterruptWarning)
    assert flat is not None
    wrong = np.flatnonzero(np.isneginf(log_z)).tolist()
    flat[wrong] = np.nan
    impossible = dict.fromkeys(wrong, "the evidence has probability zero")
    for k in wrong:  # which piece of evidence is to blame, one question says best
        try:
            with _in_set(k):
                prepared.engine.run(prepared.posed(states[k])[0], seed_sequence(0))
        except ZeroProbabilityError as error:
            impossible[k] = _why(error, k)
            if on_impossible == "raise":
                raise _also(error, wrong) from None
    _warn(impossible)
    return TablePosteriors(prepared, states, log_z, flat, np.isfinite(log_z), impossible)


def _tables_answered(
    shared: Mapping[str, Any], states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    problem = shared["problem"]
    prepared = problem.cache.get("prepared")
    if prepared is None:
        prepared = problem.cache["prepared"] = Prepared.of(problem, shared["engine"])
    found: tuple[np.ndarray, np.ndarray] = prepared.answered(states)
    return found


class _Impossible(NamedTuple):
    """In the place of the answer to a question that has none."""

    why: str


def _one_by_one(
    problems: Sequence[Problem], shared: Mapping[str, Any], progress: bool | None, executor: Any
) -> Posteriors:
    size = 1
    if executor is not None:
        size = min(_MOST, max(1, len(problems) // (_UNITS * workers_of(executor))))
    cuts = range(0, len(problems), size)
    units = [(k, list(problems[k : k + size])) for k in cuts]
    results = completed(
        _questions_answered, shared, units, executor,
        label="questions", total=len(units), progress=progress,
    )  # fmt: skip
    starts = [unit[0] for unit in units]
    found = gathered(results, starts, len(problems), "infer_many", "{} of {} evidence sets")
    impossible = {k: one.why for k, one in enumerate(found) if isinstance(one, _Impossible)}
    _warn(impossible)
    return Posteriors([None if k in impossible else one for k, one in enumerate(found)], impossible)


def _questions_answered(
    shared: Mapping[str, Any], unit: tuple[int, list[Problem]]
) -> list[Posterior | _Impossible]:
    found: list[Posterior | _Impossible] = []
    for k, problem in enumerate(unit[1], unit[0]):
        try:
            with _in_set(k):
                found.append(_answered(shared, k, problem))
        except ZeroProbabilityError as error:
            if shared["on_impossible"] == "raise":
                raise
            found.append(_Impossible(_why(error, k)))
    return found


def _answered(shared: Mapping[str, Any], k: int, problem: Problem) -> Posterior:
    """One question, in a file of its own where one is wanted."""
    engine, seed, keep = shared["engine"], child(shared["seed"], k), shared["keep"]
    if shared["folder"] is None:
        engine = able(problem, engine)
        return checked_answer(engine, engine.run(problem, seed, keep, False))
    file = in_folder(shared["folder"], "set", k)
    opened = Opened("infer_many", file, problem, engine is not None)
    engine = able(problem, opened.engine if engine is None else engine)
    return checked_answer(engine, run_saved(opened, engine, seed, keep, False, {}))


def _why(error: ZeroProbabilityError, k: int) -> str:
    return str(error).removeprefix(f"evidence set {k}: ")


def _also(error: ZeroProbabilityError, wrong: Sequence[int]) -> ZeroProbabilityError:
    """The error about the first of some sets, with all of them named."""
    others = f"; so is that of {_listed(wrong[1:])}" if len(wrong) > 1 else ""
    fix = 'on_impossible="nan" answers the other sets'
    return type(error)(f"{error}{others}; {fix}")


def _warn(impossible: Mapping[int, str]) -> None:
    if not impossible:
        return
    first = next(iter(impossible))
    warnings.warn(
        f"infer_many: there is no posterior of {_listed([*impossible])}, and answers about it are NaN "
        f"(set {first}: {impossible[first]})",
        EvidenceWarning,
        stacklevel=4,
    )


def _listed(sets: Sequence[int]) -> str:
    """Positions in words, some of very many."""
    shown = ", ".join(map(str, sets[:_NAMED]))
    more = f" and {len(sets) - _NAMED} more" if len(sets) > _NAMED else ""
    return f"set{'' if len(sets) == 1 else 's'} {shown}{more}"


def _posed(
    net: Any, sets: Sequence[Any], inputs: Sequence[Any], first: Problem
) -> Iterator[Problem]:
    """All questions but the first; what they share with it is one object, which travels once."""
    for k in range(1, len(sets)):
        with _in_set(k):
            problem = pose_any(net, sets[k], inputs[k])
        yield replace(problem, net=first.net) if problem.model is first.model else problem


def _read_sets(evidence: Any) -> list[Any]:
    fix = "give a list of dicts, one for each question"
    if is_frame(evidence):
        return rows_of(evidence, "infer_many")
    if isinstance(evidence, (Mapping, str)) or not hasattr(evidence, "__iter__"):
        raise EvidenceError(f"infer_many: evidence is a {type(evidence).__name__}; {fix}")
    sets = list(evidence)
    for k, one in enumerate(sets):
        if one is not None and not isinstance(one, Mapping):
            raise EvidenceError(f"infer_many: evidence set {k} is a {type(one).__name__}; {fix}")
    return [one or {} for one in sets]


def _read_inputs(inputs: Any, count: int) -> list[Any]:
    if inputs is None or isinstance(inputs, Mapping):
        return [inputs] * count
    given = list(inputs)
    if len(given) != count:
        raise EvidenceError(
            f"infer_many: {count} evidence sets and {len(given)} inputs; give one dict for all, or one for "
            "each"
        )
    return given


@contextmanager
def _in_set(k: int) -> Iterator[None]:
    """Has errors say in which evidence set they happened."""
    try:
        yield
    except BayesmcError as error:
        error.args = (f"evidence set {k}: {error}", *error.args[1:])
        raise
