"""What the matrix of engines and nets is made of: the nets, their exact answers, the engines as functions.

Nets of discrete nodes, and of these and a few continuous scalars, are enumerated; conditional linear-Gaussian
ones, with vectors, are answered by brute force over their configurations.
"""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions import as_distribution
from bayesmc.errors import (
    BudgetError,
    ConvergenceWarning,
    LowEssWarning,
    ReducibleWarning,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import pose
from bayesmc.testing import compare, session
from bayesmc.testing.posteriors.matrix import KINDS, matrix_case
from bayesmc.testing.verdict import NothingToCompare

ALPHA = 1e-3
SHIFT = session.seed()
SEEDS = range(SHIFT, SHIFT + session.scaled(30, 4))

Answer = Callable[[bmc.BayesNet, dict[str, Any], int], Any]


#: a posterior that comes with one of these does not carry
DOUBTS = (LowEssWarning, ConvergenceWarning, ReducibleWarning)


def by(engine: Any, **options: Any) -> Answer:
    """The answer of an engine; None where it refuses, or warns that its answer does not carry."""

    def answer(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
        if engine is not None and engine.unsupported(net, evidence):
            with pytest.raises(UnsupportedError):  # a refusal is a refusal in both places
                bmc.infer(net, evidence, engine=engine, rng=seed, **options)
            return None
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            posterior = bmc.infer(net, evidence, engine=engine, rng=seed, **options)
        assert all(issubclass(w.category, DOUBTS) for w in caught)
        return None if caught else posterior

    return answer


def own_distribution(net: bmc.BayesNet, name: str, arguments: tuple[Any, ...]) -> Any:
    """What a node's own function or table says, given what the function of a proposal receives."""
    declared = net._declarations[name]
    if declared.probs is None:
        assert declared.function is not None
        return as_distribution(declared.function(*arguments))
    at = []
    for parent, value in zip(declared.parents, arguments, strict=True):
        domain = net.model()[parent].domain
        assert domain is not None
        states = net[parent].states or domain.to_support(np.arange(domain.size))
        one_hot = np.stack([np.asarray(value == state) for state in states], axis=-1)
        at.append(one_hot.argmax(axis=-1))
    return bmc.Categorical(declared.probs[tuple(at)])


def wider(own: Any, is_finite: bool) -> Any:
    """A distribution that covers another one and is not it."""
    if is_finite:
        if own.support.values[0] != 0:
            return bmc.DiscreteUniform(own.support.values[0], own.support.values[-1])
        table = own.probs_table
        return bmc.Categorical(0.5 * table + 0.5 / table.shape[-1])
    if own.is_discrete:
        return bmc.Poisson(1.3 * own.mean + 0.5)
    if isinstance(own, bmc.MvNormal):
        return bmc.MvNormal(own.mean + 0.2, 1.5 * own.cov)
    if own.support.kind == "real":
        return bmc.StudentT(5.0, own.mean + 0.2, 1.1 * np.sqrt(own.var))
    if np.isinf(own.support.high).all():
        return bmc.Exponential(0.8 / own.mean)
    if isinstance(own, bmc.Beta):
        return bmc.Uniform(0.0, np.ones(own.batch_shape))
    return bmc.Normal(own.mean, np.sqrt(2.0 * own.var))  # also outside the support, where p is zero


def proposals(net: bmc.BayesNet, evidence: dict[str, Any]) -> dict[str, Any]:
    """For every hidden node a proposal that depends on the node's parents and differs from its density."""
    found = {}
    problem = pose(net, evidence)
    for name, node in problem.model.nodes.items():
        seen = problem.observed.get(name)
        if not node.is_stochastic or (seen is not None and seen.mask is None):
            continue

        def propose(
            *arguments: Any, name: str = name, finite: bool = node.domain is not None
        ) -> Any:
            return wider(own_distribution(net, name, arguments), finite)

        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        arguments = [inspect.Parameter(parent, kind) for parent in dict.fromkeys(node.parents)]
        assert len(arguments) == len(node.parents)
        propose.__signature__ = inspect.Signature(arguments)  # type: ignore[attr-defined]
        found[name] = propose
    return found


def by_importance(engine: type[bmc.Importance], draws: int) -> Answer:
    """Importance sampling of everything hidden, from proposals made for each net."""

    def answer(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
        return by(engine(draws, proposals(net, evidence)))(net, evidence, seed)

    return answer


def by_rejection(draws: int, max_proposals: int) -> Answer:
    """Rejection; None where it would take too many proposals."""

    def answer(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
        engine = bmc.Rejection(draws, max_proposals=max_proposals)
        try:
            return by(engine)(net, evidence, seed)
        except (BudgetError, ZeroProbabilityError) as error:
            assert "proposals" in str(error)
            return None

    return answer


def by_check(engine: Any, draws: int) -> Answer:
    """What a check corrects an approximation to; None where it doubts, or the engine does."""

    def answer(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
        posterior = by(engine)(net, evidence, seed)
        if posterior is None:
            return None
        check = quiet_check(posterior, draws, seed)
        return check.posterior if check.ok else None

    return answer


def quiet_check(posterior: Any, draws: int, seed: int) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        return posterior.check(draws, rng=seed)


#: name -> (answer, least share of the nets of each kind that it must answer)
ENGINES: dict[str, tuple[Answer, dict[str, float]]] = {
    "Exact": (
        by(bmc.Exact()),
        {"discrete": 1, "plates": 0.95, "hybrid": 0.25, "hybrid plates": 0.25, "gaussian": 1},
    ),
    "LikelihoodWeighting": (by(bmc.LikelihoodWeighting(10_000)), dict.fromkeys(KINDS, 0.9)),
    "LikelihoodWeighting, summaries": (
        by(bmc.LikelihoodWeighting(10_000), keep="summaries"),
        dict.fromkeys(KINDS, 0.9),
    ),
    "Importance": (by_importance(bmc.Importance, 10_000), dict.fromkeys(KINDS, 0.8)),
    "Rejection": (by_rejection(2000, 200_000), dict.fromkeys(KINDS, 0.8)),
    # a sweep costs much the same for 32 chains as for 16, so many chains and few sweeps
    "Gibbs": (by(bmc.Gibbs(200, warmup=100, chains=32, debug=True)), dict.fromkeys(KINDS, 0.85)),
    "HamiltonianMonteCarlo": (
        by(bmc.HamiltonianMonteCarlo(200, warmup=200, chains=32)),
        {"discrete": 0.5, "plates": 0.4, "hybrid": 0.4, "hybrid plates": 0.6, "gaussian": 0.4},
    ),
    "MetropolisHastings": (
        by(bmc.MetropolisHastings(250, warmup=200, chains=32)),
        dict.fromkeys(KINDS, 0.5),
    ),
    "LaplaceApproximation, corrected": (
        by_check(bmc.LaplaceApproximation(), 4000),
        {"discrete": 0, "plates": 0, "hybrid": 0.2, "hybrid plates": 0.1, "gaussian": 0.4},
    ),
    "MeanField, corrected": (
        by_check(bmc.MeanField(restarts=2), 4000),
        {"discrete": 0.2, "plates": 0.2, "hybrid": 0.2, "hybrid plates": 0.2, "gaussian": 0.2},
    ),
    "ExpectationPropagation, corrected": (
        by_check(bmc.ExpectationPropagation(), 4000),
        dict.fromkeys(KINDS, 0.5),
    ),
    "no engine named": (by(None), dict.fromkeys(KINDS, 0.9)),
}


@functools.cache
def problem(kind: str, seed: int) -> tuple[bmc.BayesNet, dict[str, Any]]:
    return matrix_case(kind, seed)[:2]


@functools.cache
def exact(kind: str, seed: int, observed: bool = True) -> Any:
    _, evidence, answer = matrix_case(kind, seed)
    return answer(evidence if observed else None)


def rejected(answer: Answer, kind: str, seed: int, draw: int, observed: bool = True) -> str | None:
    """What does not match, with what is needed to see it again; "" if all does; None for no answer."""
    net, evidence = problem(kind, seed)
    evidence = evidence if observed else {}
    posterior = answer(net, evidence, draw)
    if posterior is None:
        return None
    try:
        match = compare(posterior, exact(kind, seed, observed), ALPHA)
    except NothingToCompare:
        return ""
    if not match.rejected:
        return ""
    maker = "random_gaussian_net" if kind == "gaussian" else "random_net"
    return f"{maker}({seed}, **{KINDS[kind]}), evidence {evidence}: {net.name}\n" + "\n".join(
        map(str, match.rejected)
    )
