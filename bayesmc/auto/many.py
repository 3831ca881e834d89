"""``infer_many``: many evidence sets on one prepared net."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.auto.static import able, check_keep, checked_answer, choice
from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions.parameters import by_keyword
from bayesmc.engines.base import Engine
from bayesmc.engines.exact.exact import Exact
from bayesmc.engines.exact.many import Prepared, TablePosteriors
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import BayesmcError, EvidenceError, InterruptWarning
from bayesmc.network import BayesNet, FactorGraph, Problem
from bayesmc.network.columns import is_frame, rows_of
from bayesmc.randomness import child, seed_sequence
from bayesmc.results import Posterior
from bayesmc.results.many import Posteriors
from bayesmc.workers import check_executor, completed
from bayesmc.workers.units import gathered, told_of_interrupt, workers_of

#: units of work for each worker, and questions in one at most: few enough for progress, many enough to travel
_UNITS, _MOST = 8, 64


@by_keyword
def infer_many(
    net: BayesNet | FactorGraph | DynamicBayesNet,
    evidence: Any,
    *,
    inputs: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    engine: Any = None,
    rng: Any = None,
    progress: bool | None = None,
    keep: str | Sequence[str] = "draws",
    executor: Any = None,
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
    executor : concurrent.futures.Executor, optional
        Who answers batches of questions; see ``infer``.

    Returns
    -------
    Posteriors
        A sequence of posteriors that answers for all of them at once, evidence sets first.

    Raises
    ------
    EvidenceError, ModelError, UnsupportedError
        With the number of the evidence set. All sets are read before any is answered.
    WorkerError

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
    check_executor("infer_many", executor)
    sets = _read_sets(evidence)
    given = _read_inputs(inputs, len(sets))
    if not sets:
        return Posteriors([])
    with _in_set(0):
        first = pose_any(net, sets[0], given[0])
        check_keep("infer_many", keep, first)
        exact = engine
        if engine is None:
            exact = choice(first)
        elif isinstance(engine, Engine):
            exact = engine
    if type(exact) is Exact and (inputs is None or isinstance(inputs, Mapping)):
        prepared = Prepared.of(first, exact)
        states = None if prepared is None else prepared.states(sets)
        if prepared is not None and states is not None:
            return _by_tables(prepared, states, progress, executor)
    problems = [first, *_posed(net, sets, given, first)]
    return _one_by_one(problems, engine, rng, progress, keep, executor)


# ---- private ------------------------------------------------------------------------------------


def _by_tables(
    prepared: Prepared, states: np.ndarray, progress: bool | None, executor: Any
) -> Posteriors:
    """Blocks of evidence sets on one clique tree."""
    units = list(prepared.units(states))
    shared = {"problem": prepared.problem, "engine": prepared.engine}
    flat: np.ndarray | None = None
    log_z = np.full(len(states), np.nan)
    done = np.zeros(len(states), dtype=bool)
    prepared.problem.cache["prepared"] = prepared
    starts = np.cumsum([0, *map(len, units)])
    results = completed(
        _tables_answered, shared, units, executor,
        label="evidence sets", total=len(units), progress=progress,
    )  # fmt: skip
    try:
        for number, (logs, marginals) in results:
            if flat is None:
                flat = np.empty((len(states), marginals.shape[1]))
            at = slice(starts[number], starts[number + 1])
            log_z[at], flat[at], done[at] = logs, marginals, True
            if np.isneginf(logs).any():
                wrong = int(starts[number] + np.flatnonzero(np.isneginf(logs))[0])
                with _in_set(wrong):  # which piece of evidence is to blame, one question says best
                    prepared.engine.run(prepared.posed(states[wrong])[0], seed_sequence(0))
    except KeyboardInterrupt:
        if not done.any():
            raise
        told_of_interrupt(
            "infer_many", f"{done.sum()} of {len(done)} evidence sets", InterruptWarning
        )
    assert flat is not None
    return TablePosteriors(prepared, states, log_z, flat, done)


def _tables_answered(
    shared: Mapping[str, Any], states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    problem = shared["problem"]
    prepared = problem.cache.get("prepared")
    if prepared is None:
        prepared = problem.cache["prepared"] = Prepared.of(problem, shared["engine"])
    found: tuple[np.ndarray, np.ndarray] = prepared.answered(states)
    return found


def _one_by_one(
    problems: Sequence[Problem],
    engine: Any,
    rng: Any,
    progress: bool | None,
    keep: Any,
    executor: Any,
) -> Posteriors:
    seed = seed_sequence(rng)
    size = 1
    if executor is not None:
        size = min(_MOST, max(1, len(problems) // (_UNITS * workers_of(executor))))
    cuts = range(0, len(problems), size)
    units = [(k, list(problems[k : k + size])) for k in cuts]
    shared = {"first": problems[0], "engine": engine, "seed": seed, "keep": keep}
    results = completed(
        _questions_answered, shared, units, executor,
        label="questions", total=len(units), progress=progress,
    )  # fmt: skip
    starts = [unit[0] for unit in units]
    return Posteriors(
        gathered(results, starts, len(problems), "infer_many", "{} of {} evidence sets")
    )


def _questions_answered(
    shared: Mapping[str, Any], unit: tuple[int, list[Problem]]
) -> list[Posterior]:
    found = []
    for k, problem in enumerate(unit[1], unit[0]):
        with _in_set(k):
            engine = able(problem, shared["engine"])
            seed = child(shared["seed"], k)
            found.append(checked_answer(engine, engine.run(problem, seed, shared["keep"], False)))
    return found


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
