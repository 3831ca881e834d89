"""A short pilot that weighs engines where Gibbs has closed forms for nothing: effective draws for their work.

Only small nets are weighed, of a few numbers without plates, each drawn by slices: what a slice costs is not
worth it where one evaluation of the density is slow. Hierarchies are left to Gibbs, since short chains that
miss the neck of a funnel look as if they were fast. With finite nodes beside the numbers, weighted draws are
tried if they tell what every joint state weighs, and chains that might miss some are not.

Work is counted, not timed: a call of a node's density is one unit, and so are some thousand numbers that go
through it. A clock would make the choice, and so the answer, differ from run to run; seeds of the pilot are
fixed, so that the same question is always answered by the same engine.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from bayesmc.auto.along import follows
from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.gibbs import Gibbs, Plan
from bayesmc.engines.mcmc.metropolis import MetropolisHastings
from bayesmc.engines.weighted.likelihood_weighting import LikelihoodWeighting
from bayesmc.errors import BayesmcError
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.kernels.redrawn import Redrawn
from bayesmc.kernels.rescaled import Rescaled
from bayesmc.kernels.slice import Slice
from bayesmc.network import Model, Problem
from bayesmc.results import DrawsPosterior
from bayesmc.shapes import Shape
from bayesmc.structure.target import target_of

#: numbers in the chain up to which engines are weighed
_NUMBERS = 12
#: numbers whose arithmetic takes about as long as the call of a function
_ELEMENTS = 2000
#: sweeps of a pilot's warmup and draws; an ensemble's members give so many draws each; chains
_WARMUP, _DRAWS, _PER_MEMBER, _CHAINS = 100, 100, 8, 4
#: sweeps that tell what a sweep costs
_FEW = 8
#: draws of the pilot of weighting, and the share of them that must count for it to be taken
_WEIGHTED, _ENOUGH = 2000, 0.1
#: effective draws that there must be within every joint state of finite nodes
_WITHIN = 10
_ENOUGH_WEIGHTED = "weighted draws are good enough{}, so that no chains were tried"
_EACH_STATE = " within each joint state of the finite nodes"
#: evaluations of a density that its gradient takes about as long as
_GRADIENT = 3.0
#: how much better than Gibbs, which needs no tuning, another engine must be
_BETTER = 1.5
#: the pilots' own seed
_SEED = 17


@dataclass
class _Work:
    """What evaluations have cost so far."""

    units: float = 0.0

    def add(self, *values: Any) -> None:
        largest = max((np.size(value) for value in values), default=1)
        self.units += 1.0 + largest / _ELEMENTS


@dataclass(frozen=True, eq=False)
class CountedModel(Model):
    """A model that counts the work of its evaluations."""

    work: _Work = field(default_factory=_Work)

    def evaluate(self, name: str, values: Mapping[str, np.ndarray]) -> tuple[Any, Shape]:
        found, batch = super().evaluate(name, values)
        self.work.add(*(values[p] for p in self.nodes[name].parents))
        return found, batch

    def log_density(self, name: str, distribution: Any, stored: np.ndarray) -> np.ndarray:
        found = super().log_density(name, distribution, stored)
        self.work.add(found)
        return found

    def potential(
        self, name: str, values: Mapping[str, np.ndarray], total: bool = True
    ) -> np.ndarray:
        found = super().potential(name, values, total)
        self.work.add(*(values[p] for p in self.potentials[name][0].parents))
        return found


@dataclass(frozen=True)
class Trial:
    """What the pilot of one engine showed.

    Attributes
    ----------
    engine : Engine
        The engine with its default options.
    rate : float
        Effective draws of the slowest number for a thousand units of work.
    words : str
    """

    engine: Any
    rate: float
    words: str


def weighed(problem: Problem, plan: Plan) -> tuple[Trial, list[Trial]] | None:
    """The engine that the pilot finds best, and the others; None where there is nothing to weigh.

    Parameters
    ----------
    problem : Problem
    plan : Plan
        Of Gibbs.
    """
    if not _is_small(problem, plan):
        return None
    if "pilot" not in problem.cache:
        moved = dict.fromkeys(n for k in plan.kernels for n in k.names)
        finite = [n for n in moved if problem.model[n].domain is not None]
        if finite:
            problem.cache["pilot"] = _weighed_once(problem, finite)
        else:
            followed = follows(problem, [k for k in plan.kernels if not isinstance(k, BlockWalk)])
            problem.cache["pilot"] = _weighed(problem, followed)
    return problem.cache["pilot"]


# ---- private ------------------------------------------------------------------------------------


def _is_small(problem: Problem, plan: Plan) -> bool:
    """Whether Gibbs moves a few numbers by slices or walks, and no others, perhaps under finite nodes."""
    model = problem.model
    names = {n for kernel in plan.kernels for n in kernel.names}
    slow = any(isinstance(k, (Slice, FactorSlice, AdaptiveWalk, Hamiltonian)) for k in plan.kernels)
    finite = {n for n in names if model[n].domain is not None}
    known = (Slice, FactorSlice, AdaptiveWalk, BlockWalk, Hamiltonian, Redrawn, Rescaled)
    if not slow or any(
        not isinstance(k, known) and not finite >= set(k.names) for k in plan.kernels
    ):
        return False
    if any(model[n].plates or (model[n].is_discrete and n not in finite) for n in names):
        return False
    return sum(math.prod(model[n].event_shape) for n in names) <= _NUMBERS


def _weighed_once(problem: Problem, finite: list[str]) -> tuple[Trial, list[Trial]] | None:
    """Weighting where it will do: chains that switch between states may miss one in a pilot, and look fast.

    So may weighted draws where a state is rare beforehand, or where hardly a draw in it fits the data: they
    will do where the draws within each joint state tell what it weighs.
    """
    drawn = _weights(problem, finite)
    words = _ENOUGH_WEIGHTED.format(_EACH_STATE)
    return None if drawn is None else (drawn, [Trial(Gibbs(), 0.0, words)])


def _weighed(problem: Problem, followed: bool) -> tuple[Trial, list[Trial]] | None:
    """Cheap pilots first: Gibbs has a full one only where it could still be better than what they showed.

    Where it moves all numbers along trajectories in machine code, a gradient costs less than the call of
    one density, and no pilot of chains is worth its time.
    """
    drawn = _weights(problem)
    if drawn is not None:
        return drawn, [Trial(Gibbs(), 0.0, _ENOUGH_WEIGHTED.format(""))]
    if followed:
        return None
    walk = _chains(problem, MetropolisHastings())
    gibbs = _at_best(problem)
    if walk.rate < _BETTER * gibbs.rate:
        gibbs = _chains(problem, Gibbs())
    return (walk, [gibbs]) if walk.rate > _BETTER * gibbs.rate else (gibbs, [walk])


def _at_best(problem: Problem) -> Trial:
    """What Gibbs would be worth if all its draws were independent: a few sweeps tell what they cost."""
    engine, counted = Gibbs(), _counted(problem)
    try:
        engine.sampler(counted)
        units = _run(replace(engine, draws=_FEW, warmup=_FEW, chains=_CHAINS), counted)[1] / (
            2 * _FEW
        )
    except BayesmcError as error:
        return Trial(engine, 0.0, f"its pilot failed: {error}")
    words = f"{units / _CHAINS:.3g} evaluations of a density for each draw, at the least"
    return Trial(engine, 1000.0 * _CHAINS / units, words)


def _chains(problem: Problem, engine: Any) -> Trial:
    """A pilot of chains; of those that fail, or whose draws are worth nothing, the rate is zero."""
    counted = _counted(problem)
    try:
        members = getattr(engine.sampler(counted), "ensemble", 1)
        draws = max(_DRAWS, _PER_MEMBER * members)
        short: ChainEngine = replace(engine, draws=draws, warmup=_WARMUP, chains=_CHAINS)
        posterior, units = _run(short, counted)
    except BayesmcError as error:
        return Trial(engine, 0.0, f"its pilot failed: {error}")
    sizes = [_least(posterior, n) for n in posterior.names if n in _moved(problem)]
    ess = min(sizes, default=0.0)
    units *= draws / (draws + _WARMUP)
    words = f"{ess:.0f} effective of {draws * _CHAINS} draws, {_each(units, ess)}"
    return Trial(engine, 1000.0 * ess / units, words)


def _weights(problem: Problem, finite: Sequence[str] = ()) -> Trial | None:
    """A pilot of likelihood weighting; None where its weights are too uneven, or so within a joint state."""
    engine = LikelihoodWeighting()
    if engine.refusal(problem) is not None:
        return None
    counted = _counted(problem)
    try:
        posterior, units = _run(replace(engine, draws=_WEIGHTED), counted)
    except BayesmcError:
        return None
    ess = posterior.weight_ess or float(_WEIGHTED)
    k = posterior.pareto_k
    if ess < _ENOUGH * _WEIGHTED or (k is not None and k > 0.5):
        return None
    if finite and _least_within(posterior, finite) < _WITHIN:
        return None
    words = f"{ess:.0f} effective of {_WEIGHTED} draws, {_each(units, ess)}"
    return Trial(engine, 1000.0 * ess / units, words)


def _least_within(posterior: DrawsPosterior, names: Sequence[str]) -> float:
    """Effective draws within the joint state of some nodes that has the fewest, by their weights there.

    Draws of a state whose weights are uneven, or all zero, do not tell what the state weighs, however many
    they are: one that fits, and weighs more than all others together, may not be among them.
    """
    code, count = np.zeros(posterior._shape, dtype=np.intp), 1
    for name in names:
        domain = posterior.model[name].domain
        assert domain is not None
        stored = posterior._stored[name].reshape((*posterior._shape, -1))
        for element in np.moveaxis(stored, -1, 0):
            code, count = code * domain.size + element, count * domain.size
            if count > _WEIGHTED:
                return 0.0
    codes: np.ndarray = code.ravel()
    logs = np.zeros(posterior._shape) if posterior.log_weights is None else posterior.log_weights
    logs = np.ravel(logs)
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, codes, logs)
    if not np.isfinite(largest).all():  # a state without draws, or none of them possible
        return 0.0
    weights = np.exp(logs - largest[codes])
    total, squares = (np.bincount(codes, w, count) for w in (weights, weights**2))
    return float((total**2 / squares).min())


def _run(engine: Any, counted: Problem) -> tuple[DrawsPosterior, float]:
    """A posterior and the work that it took."""
    assert isinstance(counted.model, CountedModel)
    before = counted.model.work.units
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posterior = engine.run(counted, np.random.SeedSequence(_SEED), "draws", False, None)
    units = counted.model.work.units - before + _along_trajectories(posterior)
    return posterior, max(units, 1.0)


def _along_trajectories(posterior: DrawsPosterior) -> float:
    """The work of gradients, which no model sees: each as much as some evaluations of all densities."""
    point = getattr(posterior, "checkpoint", None)
    if point is None or posterior.problem is None:
        return 0.0
    work = sum(m["work"] for m in point.state.get("memory", ()) if "work" in m)
    calls, points = np.broadcast_to(work, 2)
    target = target_of(posterior.problem)
    numbers = sum(math.prod(term.shape) for term in target.terms.values())
    return _GRADIENT * float(calls * len(target.terms) + points * numbers / _ELEMENTS)


def _counted(problem: Problem) -> Problem:
    parts = {f.name: getattr(problem.model, f.name) for f in fields(Model)}
    return replace(problem, model=CountedModel(**{**parts, "cache": {}}), cache={})


def _moved(problem: Problem) -> set[str]:
    """Hidden continuous nodes with a density."""
    seen = {n for n, o in problem.observed.items() if o.mask is None}
    nodes = problem.model.nodes.items()
    return {n for n, c in nodes if c.is_stochastic and n not in seen and not c.is_discrete}


def _least(posterior: DrawsPosterior, name: str) -> float:
    """Effective draws of a node's slowest number; none where it stands still or is not defined."""
    return float(np.nan_to_num(posterior.ess(name), nan=0.0).min(initial=np.inf))


def _each(units: float, ess: float) -> str:
    if ess <= 0:
        return "none of them"
    return f"{units / ess:.3g} evaluations of a density for each"
