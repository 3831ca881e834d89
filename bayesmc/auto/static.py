"""``infer``: a problem posed, and an engine run on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any, Never

import numpy as np

from bayesmc.auto.along import along_trajectories
from bayesmc.auto.explanation import Explanation
from bayesmc.auto.files import Opened
from bayesmc.auto.pilot import weighed
from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions import Laplace
from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.engines.approximate.laplace import LaplaceApproximation
from bayesmc.engines.base import Engine
from bayesmc.engines.exact.exact import Exact, readable_bytes
from bayesmc.engines.exact.hybrid_plan import too_large_to_search
from bayesmc.engines.filtering import FilterEngine
from bayesmc.engines.mcmc.gibbs import Gibbs, plan_of
from bayesmc.engines.options import engine_meant
from bayesmc.engines.unrolled import pose_any
from bayesmc.engines.weighted.likelihood_weighting import LikelihoodWeighting
from bayesmc.errors import UnknownNodeError, UnsupportedError, did_you_mean
from bayesmc.network import BayesNet, FactorGraph, Problem
from bayesmc.randomness import seed_sequence
from bayesmc.results import Posterior
from bayesmc.workers import check_executor

#: bytes up to which an exact answer counts as cheap
_CHEAP = 256 * 2**20


@by_keyword
def infer(
    net: BayesNet | FactorGraph | DynamicBayesNet,
    evidence: Any = None,
    *beyond: Never,
    inputs: Any = None,
    engine: Any = None,
    rng: Any = None,
    progress: bool | None = None,
    keep: str | Sequence[str] = "draws",
    resume: Posterior | None = None,
    checkpoint: Any = None,
    executor: Any = None,
) -> Posterior:
    """The posterior of a net, of a factor graph, or of a template over all its slices, given evidence.

    Parameters
    ----------
    net : BayesNet, FactorGraph or DynamicBayesNet
        A template is unrolled over its data: the answer is about nodes ``"x[0]"``, ``"x[1]"``, ... and its
        static nodes.
    evidence : dict or DataFrame, optional
        Node name -> value, an array over the node's plates, or a state label. A masked entry, NaN in a
        plated node, or None is unobserved. Of a template: observations, time first. Of a data frame (pandas,
        polars, pyarrow) columns are nodes and inputs, and a column called like a plate says which element a
        row is about.
    inputs : dict or DataFrame, optional
        Values of the net's input nodes; of a template time first.
    engine : optional
        ``Exact()``, ``LikelihoodWeighting(draws)``, ...; None chooses (see ``explain``).
    rng : seed, SeedSequence, Generator or None
        The same seed gives the same result.
    progress : bool, optional
        Show a bar for what takes over a second; None: on a terminal.
    keep : "draws", "summaries", "file", a list of node names, or {"file": a list of node names}
        What to hold: all draws; means, variances and probabilities alone, in constant memory; or the
        draws of some nodes. ``"file"`` leaves draws in the file of ``checkpoint``, from which the posterior
        reads them.
    resume : Posterior, optional
        An earlier posterior of the same question whose draws are continued; ``engine`` may be left out then.
    checkpoint : path or CheckpointFile, optional
        A file in which the run saves itself as it goes on (the extra ``netcdf``). The same call goes on where
        the run was, whatever happened to the process, and ends with the same bits as one that was never
        stopped; once it has ended, the call returns the answer that is in the file. Groups of chains save
        themselves each in a file of its own beside it, as long as the run goes on: ``run.g0.nc``, ... beside
        ``run.nc``.
    executor : concurrent.futures.Executor, optional
        Who works out units of work (chunks of draws, groups of chains): processes, threads, Dask, MPI. The
        same seed gives the same bits with any, and with none; engines whose work is one unit run here.

    Returns
    -------
    Posterior

    Raises
    ------
    ModelError, EvidenceError, UnsupportedError
        With the node's name, the fault and the fix.
    CheckpointError, DamagedFileError
        The file is of another run, and the message says what differs; the disk is full; or it was cut off.
    WorkerError
        A function does not travel to the executor's workers, or these were lost over and over.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> net.table("wet", ["rain"], [[0.9, 0.1], [0.1, 0.9]], states=("no", "yes"))
    >>> bmc.infer(net, {"wet": "yes"}).probabilities("rain").round(4).tolist()
    [0.3077, 0.6923]
    """
    if beyond:
        refuse_positions(infer, beyond)
    if executor is not None:
        check_executor("infer", executor)
    problem = pose_any(net, evidence, inputs, resume)
    check_keep("infer", keep, problem, checkpoint)
    if engine is None and resume is not None:
        engine = resume.engine
    opened = None if checkpoint is None else _opened(checkpoint, problem, resume)
    if engine is None and opened is not None:
        engine = opened.engine
    chosen = able(problem, engine)
    spread = {"executor": executor} if executor is not None and chosen.spreads else {}
    if opened is None:
        found = chosen.run(problem, seed_sequence(rng), keep, progress, resume, **spread)
    else:
        found = run_saved(opened, chosen, opened.seed(rng), keep, progress, spread)
    return checked_answer(chosen, found)


def able(problem: Problem, engine: Any) -> Any:
    """The engine that answers a posed problem: the one asked for, or one that is chosen.

    Raises
    ------
    UnsupportedError
        With one that can.
    """
    chosen = choice(problem) if engine is None else _checked(engine)
    reason = None if isinstance(chosen, Exact) else chosen.refusal(problem)
    if reason is not None:
        raise UnsupportedError(_with_alternative(reason, chosen, problem))
    return chosen


def checked_answer(engine: Any, found: Any) -> Posterior:
    """What an engine returned, refused if it is no posterior."""
    if not isinstance(found, Posterior):
        raise TypeError(
            f"{type(engine).__name__}.run returned {type(found).__name__}; an engine returns a Posterior"
        )
    return found


def run_saved(
    opened: Opened,
    engine: Any,
    seed: np.random.SeedSequence,
    keep: Any,
    progress: bool | None,
    spread: Mapping[str, Any],
) -> Any:
    """The answer of a run that is saved as it goes on."""
    if (keep == "file" or isinstance(keep, Mapping)) and not engine.saves:
        raise UnsupportedError(
            f"infer(keep={keep!r}): {type(engine).__name__} makes no draws that could stay in a file; leave "
            "keep= out"
        )
    file, answer = opened.begin(engine, seed, keep, {})
    if file is None:
        return answer
    with closing(file):
        if engine.saves:
            return engine.run(opened.problem, seed, keep, progress, None, checkpoint=file, **spread)
        found = engine.run(opened.problem, seed, keep, progress, None, **spread)
        file.finish(found)
    return found


def choice(problem: Problem) -> Any:
    """The engine that answers where the user names none."""
    return _choose(problem)[0]


def explained(
    net: BayesNet | FactorGraph | DynamicBayesNet,
    evidence: Mapping[str, Any] | None,
    engine: Any,
    inputs: Mapping[str, Any] | None,
) -> Explanation:
    """See ``explain``."""
    problem = pose_any(net, evidence, inputs)
    if engine is None:
        chosen, reasons, refused = _choose(problem)
    else:
        chosen, reasons, refused = _checked(engine), ("it was asked for",), {}
        why = chosen.refusal(problem)
        if why is not None:
            refused = {type(chosen).__name__: why}
            reasons = ("it was asked for, but it cannot answer",)
    if type(chosen).__name__ in refused:
        return Explanation(chosen, tuple(reasons), refused)
    nodes, table = chosen.describe(problem), tuple(chosen.table(problem))
    effort = chosen.effort(problem)
    return Explanation(chosen, tuple(reasons), refused, nodes, table, effort)


# ---- private ------------------------------------------------------------------------------------


def _choose(problem: Problem) -> tuple[Any, tuple[str, ...], dict[str, str]]:
    """Exact where cheap; Gibbs where something was observed and its chains can move; else weighting."""
    exact = Exact(max_bytes=_CHEAP)
    too_large = too_large_to_search(problem)
    why_not = too_large if too_large is not None else exact.refusal(problem)
    if why_not is None:
        cost = exact.cost(problem)
        size = readable_bytes(cost.bytes)
        return (
            Exact(),
            (f"hidden nodes are finite or linear-Gaussian: {cost.words}, about {size}",),
            {},
        )
    if too_large is None and Exact().refusal(problem) is None:
        cost = Exact().cost(problem)
        why_not = (
            f"it would take about {readable_bytes(cost.bytes)} ({cost.words}), more than counts as cheap; "
            "engine=bmc.Exact() answers all the same"
        )
    refused = {"Exact": why_not}
    weighting = LikelihoodWeighting()
    forward = weighting.refusal(problem)
    no_plan = Gibbs().refusal(problem)
    if no_plan is not None:
        if forward is not None:
            raise UnsupportedError(f"infer: no engine can answer. {why_not}. {forward}. {no_plan}")
        refused["Gibbs"] = no_plan
        return weighting, ("every hidden node can be sampled given its parents",), refused
    plan = plan_of(problem)
    if plan.kernels and (forward is not None or not plan.constraints):
        if forward is not None:
            refused["LikelihoodWeighting"] = forward
        found = weighed(problem, plan)
        along = along_trajectories(problem, plan) if found is None else None
        if along is not None:
            refused["Gibbs"] = f"its sweeps are of {plan.in_short()}"
            return along[0], (along[1],), refused
        if found is None:
            return (
                Gibbs(),
                (f"the full conditionals can be drawn from: {plan.in_short()}",),
                refused,
            )
        best, others = found
        refused.update({type(t.engine).__name__: t.words for t in others})
        return best.engine, (f"it did best in a short pilot: {best.words}",), refused
    if forward is not None:
        raise UnsupportedError(f"infer: no engine can answer. {why_not}. {forward}")
    if not plan.kernels:
        return weighting, ("nothing observed depends on a hidden node",), refused
    refused["Gibbs"] = (
        f"zero probabilities tie {', '.join(map(repr, plan.constraints[:4]))} together, so that its chains "
        "may be stuck"
    )
    return weighting, ("every hidden node can be sampled given its parents",), refused


def _opened(checkpoint: Any, problem: Problem, resume: Posterior | None) -> Opened:
    if resume is not None:
        raise ValueError(
            "infer(resume=..., checkpoint=...): checkpoint= goes on with its own run; give one of both "
            "(resume=bmc.load(path, net=net) adds draws to a run that has ended)"
        )
    return Opened("infer", checkpoint, problem)


def _checked(engine: Any) -> Any:
    if isinstance(engine, Laplace):  # the method has its name from the same man
        if engine.is_bare:
            return LaplaceApproximation()
        raise TypeError(
            f"engine={engine!r} is not an engine but a distribution; Laplace's method is "
            "engine=bmc.LaplaceApproximation()"
        )
    if isinstance(engine, type):
        raise TypeError(
            f"engine={engine.__name__} is a class; give an instance: {engine.__name__}()"
        )
    if isinstance(engine, FilterEngine) and not isinstance(engine, Engine):
        raise TypeError(
            f"engine={type(engine).__name__}(...) answers over time; call filter, smooth, forecast or "
            "most_likely with it, or give infer a static engine (Gibbs(draws), ParticleGibbs(...), ...)"
        )
    if not isinstance(engine, Engine):
        raise TypeError(
            f"engine={engine!r} is not an engine{engine_meant(engine)}; use Exact(), Gibbs(draws), "
            "LikelihoodWeighting(draws), ..."
        )
    return engine


def _with_alternative(reason: str, engine: Any, problem: Problem) -> str:
    try:
        other = _choose(problem)[0]
    except UnsupportedError:
        return reason
    if type(other) is type(engine):
        return reason
    return f"{reason}; {type(other).__name__}() can answer this"


def check_keep(call: str, keep: Any, problem: Problem, checkpoint: Any = None) -> None:
    """Refuse a ``keep`` that names neither a way to keep draws nor nodes."""
    choices = (
        'give "draws", "summaries", "file", a list of node names, or {"file": a list of node names}'
    )
    in_file = keep == "file" or (isinstance(keep, Mapping) and [*keep] == ["file"])
    if in_file and checkpoint is None:
        raise ValueError(f'{call}(keep={keep!r}): in which file? give checkpoint="run.nc"')
    listed = keep["file"] if in_file and isinstance(keep, Mapping) else keep
    if isinstance(listed, str):
        if isinstance(keep, Mapping) or keep not in ("draws", "summaries", "file"):
            raise ValueError(f"{call}(keep={keep!r}): {choices}")
        return
    if not isinstance(listed, Sequence):
        raise ValueError(f"{call}(keep={keep!r}): {choices}")
    for name in listed:
        if name not in problem.model.nodes:
            hint = did_you_mean(name, problem.model.nodes)
            raise UnknownNodeError(f"{call}: keep= names {name!r}, which is not a node{hint}")
