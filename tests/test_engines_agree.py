"""Every engine against exact answers, on random nets: an engine joins the matrix with one line.

Nets of discrete nodes, and of these and a few continuous scalars, are enumerated; conditional linear-Gaussian
ones, with vectors, are answered by brute force over their configurations.

Seeds are fixed, so a run is repeatable; ``--bayesmc-seed`` shifts them on demand. One net under one engine
is compared at a false-alarm rate of 1e-3 (Holm over its states, means and evidence), and at the fixed
seeds none may be rejected. At fresh ones, with some 1,200 such comparisons, a chance rejection is likely
somewhere; there a rejected net is drawn again, with other random numbers, and fails if it is rejected
again (1e-6 each, 1e-3 for a whole run); and more than 3 first rejections among 60 nets (probability
5e-7) fail, too.
"""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import bayesmc as bmc
from bayesmc.distributions import as_distribution
from bayesmc.engines.proposing import Propose
from bayesmc.errors import (
    BudgetError,
    ConvergenceWarning,
    LowEssWarning,
    ReducibleWarning,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import Problem, pose
from bayesmc.network.forward import Pass, Step, WeighDrawn
from bayesmc.results import DrawsPosterior
from bayesmc.testing import (
    assert_matches,
    bayes_nets,
    compare,
    enumerate_posterior,
    evidence_for,
    gaussian_evidence,
    random_evidence,
    random_gaussian_net,
    random_net,
    session,
)

ALPHA = 1e-3
SHIFT = session.seed()
SEEDS = range(SHIFT, SHIFT + 60)
KINDS: dict[str, dict[str, Any]] = {
    "discrete": {},
    "plates": {"plates": True},
    "hybrid": {"hybrid": True},
    "hybrid plates": {"hybrid": True, "plates": True},
    "gaussian": {"plates": True, "vectors": True},
}

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
        states = net[parent].states
        assert states is not None
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


#: name -> (answer, least share of the 60 nets of each kind that it must answer)
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
    "MetropolisHastings": (
        by(bmc.MetropolisHastings(200, warmup=200, chains=32)),
        dict.fromkeys(KINDS, 0.5),
    ),
    "no engine named": (by(None), dict.fromkeys(KINDS, 0.9)),
}


@functools.cache
def problem(kind: str, seed: int) -> tuple[bmc.BayesNet, dict[str, Any]]:
    if kind == "gaussian":
        net, _ = random_gaussian_net(seed, **KINDS[kind])
        return net, gaussian_evidence(net, seed, chance=0.25)
    net = random_net(seed, **KINDS[kind])
    return net, random_evidence(net, seed)


@functools.cache
def exact(kind: str, seed: int, observed: bool = True) -> Any:
    net, evidence = problem(kind, seed)
    if kind == "gaussian":
        _, plain = random_gaussian_net(seed, **KINDS[kind])
        return plain.posterior(evidence if observed else {})
    return enumerate_posterior(net, evidence if observed else None)


def rejected(answer: Answer, kind: str, seed: int, draw: int, observed: bool = True) -> str | None:
    """What does not match, with what is needed to see it again; "" if all does; None for no answer."""
    net, evidence = problem(kind, seed)
    evidence = evidence if observed else {}
    posterior = answer(net, evidence, draw)
    if posterior is None:
        return None
    match = compare(posterior, exact(kind, seed, observed), ALPHA)
    if not match.rejected:
        return ""
    maker = "random_gaussian_net" if kind == "gaussian" else "random_net"
    return f"{maker}({seed}, **{KINDS[kind]}), evidence {evidence}: {net.name}\n" + "\n".join(
        map(str, match.rejected)
    )


#: chains take longer for an answer than independent draws: nets of each kind that they are asked
CHAIN_NETS = 10
#: the draws of these are those of likelihood weighting (`test_summaries_agree_with_draws`)
SUMMARY_NETS = 30


def check_all(
    answer: Answer, kind: str, observed: bool = True, nets: int = len(SEEDS), draw: int = 1_000
) -> int:
    """How many nets were answered; wrong answers raise."""
    seeds = SEEDS[:nets]
    results = [rejected(answer, kind, seed, seed + draw, observed) for seed in seeds]
    doubtful = [seed for seed, result in zip(seeds, results, strict=True) if result]
    assert len(doubtful) <= (3 if SHIFT else 0), "\n".join(filter(None, results))
    for seed in doubtful:
        again = rejected(answer, kind, seed, seed + 10**6, observed)
        assert not again, again
    return sum(result is not None for result in results)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("engine", ENGINES)
def test_engine_matches_exact_answers(engine: str, kind: str) -> None:
    answer, share = ENGINES[engine]
    chains = engine in ("Gibbs", "MetropolisHastings")
    chains |= engine == "no engine named" and kind.startswith("hybrid")  # mostly Gibbs
    nets, draw = (CHAIN_NETS, 2_000) if chains else (len(SEEDS), 1_000)
    if engine == "LikelihoodWeighting, summaries":
        nets = SUMMARY_NETS
    assert check_all(answer, kind, nets=nets, draw=draw) >= share[kind] * nets


class Sampled:
    """Draws of ``net.sample`` as `assert_matches` reads an answer."""

    log_marginal_likelihood = None
    weight_ess = None

    def __init__(self, net: bmc.BayesNet, draws: int, seed: int) -> None:
        self.model = pose(net, None).model
        self.draws = net.sample(draws, rng=seed)
        self.count = draws

    def probabilities(self, name: str) -> np.ndarray:
        states = self.model[name].domain.states
        return np.stack([(self.draws[name] == s).mean(axis=0) for s in states], axis=-1)

    def mean(self, name: str) -> np.ndarray:
        return self.draws[name].mean(axis=0)

    def mcse(self, name: str) -> np.ndarray:
        return self.draws[name].std(axis=0) / np.sqrt(self.count)

    def ess(self, name: str) -> np.ndarray:
        return np.full(self.draws[name].shape[1:], float(self.count))[
            (..., None) if self.model[name].domain and self.model[name].domain.labels else ...
        ]


@pytest.mark.parametrize("kind", KINDS)
def test_ancestral_sampling_matches_enumeration(kind: str) -> None:
    answered = check_all(lambda net, _, s: Sampled(net, 20_000, s), kind, observed=False)
    assert answered == len(SEEDS)


# ---- the oracle itself --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["discrete", "plates"])
def test_enumeration_agrees_with_the_joint_density(kind: str) -> None:
    """Another way to the same numbers: ``net.log_prob`` of every complete assignment."""
    for seed in SEEDS:
        net, evidence = problem(kind, seed)
        found = exact(kind, seed)
        values = {n: found.values(n) for n in found.names if net[n].kind == "stochastic"}
        log_joint = np.asarray(net.log_prob(values))
        total = np.logaddexp.reduce(np.broadcast_to(log_joint, found.weights.shape))
        assert total == pytest.approx(found.log_marginal_likelihood, abs=1e-9)
        np.testing.assert_allclose(np.exp(log_joint - total), found.weights, atol=1e-12)
        if not evidence:  # all configurations that are possible are there
            assert total == pytest.approx(0.0, abs=1e-9)


# ---- unbiased evidence --------------------------------------------------------------------------

RUNS = 2000


def discrete_net() -> tuple[bmc.BayesNet, dict[str, Any], dict[Any, Any]]:
    """A net, evidence, and proposals for what is hidden: here against the arrow from a to b."""
    net = bmc.BayesNet("discrete")
    net.table("a", probs=[0.7, 0.3])
    net.table("b", ["a"], [[0.1, 0.2, 0.7], [0.6, 0.3, 0.1]])
    net.table("c", ["a", "b"], [[[0.95, 0.05], [0.5, 0.5], [0.8, 0.2]], [[0.3, 0.7]] * 3])
    backwards = {"b": bmc.Categorical([0.5, 0.4, 0.1]), "a": lambda b: bmc.Bernoulli(0.7 - 0.2 * b)}
    return net, {"c": 1}, backwards


def hybrid_net() -> tuple[bmc.BayesNet, dict[str, Any], dict[Any, Any]]:
    net = bmc.BayesNet("hybrid")
    net.add("k", bmc.Bernoulli(0.4))
    net.add("x", lambda k: bmc.Normal(2.0 * k, 1.0))
    net.add("y", lambda x: bmc.Normal(0.5 * x, 0.7))
    looking = {
        "k": lambda y: bmc.Bernoulli(0.5 * y),
        "x": lambda k, y: bmc.StudentT(4.0, k + y, 1.0),
    }
    return net, {"y": 1.3}, looking


def plated_net() -> tuple[bmc.BayesNet, dict[str, Any], dict[Any, Any]]:
    net = bmc.BayesNet("plated", plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 1.5))
    net.add("z", bmc.Bernoulli(0.4), plates="i")
    net.add("x", lambda m, z: bmc.Normal(m + 1.5 * z, 1.0), plates="i")

    def block(m: Any) -> dict[str, Any]:
        return {"z": bmc.Bernoulli([0.2, 0.5, 0.8]), "x": bmc.Normal(m[..., None] + 0.5, 1.6)}

    return net, {"x": [0.3, np.nan, 2.2]}, {"m": bmc.StudentT(4.0, 0.6, 0.9), ("z", "x"): block}


EVIDENCE_NETS = {"discrete": discrete_net, "hybrid": hybrid_net, "plated": plated_net}
#: draws are few, so that the log of an estimate is biased for all to see
EVIDENCE_ENGINES: dict[str, Callable[[Any], Any]] = {
    "LikelihoodWeighting": lambda _: bmc.LikelihoodWeighting(5),
    "Importance": lambda proposed: bmc.Importance(4, proposed),
    "Rejection": lambda _: bmc.Rejection(8),
}


@functools.cache
def evidence_ratios(engine: str, net: str) -> np.ndarray:
    """Estimates of the evidence over the exact one, one per run."""
    declared, evidence, proposed = EVIDENCE_NETS[net]()
    exact_log = enumerate_posterior(declared, evidence).log_marginal_likelihood
    asked = EVIDENCE_ENGINES[engine](proposed)
    posed = pose(declared, evidence)
    seeds = np.random.SeedSequence([SHIFT, 77]).spawn(RUNS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        logs = [asked.run(posed, seed, keep=[]).log_marginal_likelihood for seed in seeds]
    return np.exp(np.array(logs) - exact_log)


def off_by(estimates: np.ndarray, value: float) -> float:
    """Distance of a mean from a value, in standard errors."""
    return abs(estimates.mean() - value) / (estimates.std(ddof=1) / np.sqrt(len(estimates)))


@pytest.mark.parametrize("net", EVIDENCE_NETS)
@pytest.mark.parametrize("engine", EVIDENCE_ENGINES)
def test_the_evidence_is_unbiased(engine: str, net: str) -> None:
    """Within 4 standard errors: a false alarm has probability 6e-5, among the nine 6e-4."""
    ratios = evidence_ratios(engine, net)
    assert 0.1 < np.log(ratios).std() <= 1.0
    assert off_by(ratios, 1.0) < 4.0


@pytest.mark.parametrize("net", EVIDENCE_NETS)
def test_a_biased_estimate_of_the_evidence_is_caught(net: str) -> None:
    """The log of an unbiased estimate is biased; so is the plain share of accepted draws."""
    for engine in EVIDENCE_ENGINES:
        assert off_by(np.log(evidence_ratios(engine, net)), 0.0) > 4.0, engine
    declared, evidence, _ = EVIDENCE_NETS[net]()
    p = bmc.infer(declared, evidence, engine=bmc.Rejection(8), rng=0)
    log_bound = p.log_marginal_likelihood - np.log((8 - 1) / (p.proposed - 1))
    exact_z = np.exp(enumerate_posterior(declared, evidence).log_marginal_likelihood - log_bound)
    rates = evidence_ratios("Rejection", net) * exact_z  # (n - 1) / (N - 1)
    shares = 8 / (7 / rates + 1)
    assert off_by(shares / exact_z, 1.0) > 4.0


# ---- queries ------------------------------------------------------------------------------------


def answered_by_tables(kind: str) -> Iterator[tuple[bmc.BayesNet, Any, Any]]:
    """The nets that `Exact` takes, each with its posterior and the enumerated one."""
    for seed in SEEDS:
        net, evidence = problem(kind, seed)
        if not bmc.Exact().unsupported(net, evidence):
            yield net, bmc.infer(net, evidence, engine=bmc.Exact()), exact(kind, seed)


def total_of(net: bmc.BayesNet, name: str) -> Callable[[Any], Any]:
    axes = tuple(range(-len(net[name].plates), 0))
    return lambda value: np.asarray(value, dtype=float).sum(axis=axes)


@pytest.mark.parametrize("kind", ["discrete", "plates", "hybrid plates"])
def test_exact_queries_agree_with_enumeration(kind: str) -> None:
    asked = 0
    for net, posterior, found in answered_by_tables(kind):
        finite = [n for n in found.names if found.model[n].domain is not None]
        numeric = [n for n in found.names if not _is_labelled(found.model[n])]
        for a in finite[:2]:
            for b in finite[-2:]:
                np.testing.assert_allclose(
                    posterior.probabilities(a, b), found.probabilities(a, b), atol=1e-9
                )
                asked += 1
        for a in numeric[:2]:
            np.testing.assert_allclose(posterior.var(a), found.var(a), atol=1e-9)
            for b in numeric[-2:]:
                f, g = total_of(net, a), total_of(net, b)
                names = {"x": a, "y": b}
                expected = found.expectation(lambda x, y: f(x) * g(y), a, b)  # noqa: B023
                chance = found.expectation(lambda x, y: f(x) > g(y), a, b)  # noqa: B023
                try:
                    result = posterior.expectation(lambda x, y: f(x) * g(y), names=names)  # noqa: B023
                    event = posterior.probability(lambda x, y: f(x) > g(y), names=names)  # noqa: B023
                except BudgetError:
                    continue  # the sums need all elements jointly
                except (
                    UnsupportedError
                ):  # hidden continuous values are averaged where that is affine
                    assert any(found.model[n].domain is None for n in (a, b))
                    continue
                assert result == pytest.approx(expected, abs=1e-9)
                assert event == pytest.approx(chance, abs=1e-9)
                asked += 1
        both = [n for n in numeric if n in finite][:3]
        if both:
            np.testing.assert_allclose(posterior.cov(*both), _cov(found, both), atol=1e-9)
    assert asked > 60


@pytest.mark.parametrize("kind", ["plates", "hybrid plates"])
def test_exact_queries_by_plate_agree_with_enumeration(kind: str) -> None:
    asked = 0
    for _, posterior, found in answered_by_tables(kind):
        for name in found.names:
            node = found.model[name]
            if _is_labelled(node) or not node.plates:
                continue
            same = posterior.expectation(lambda x: x, plates=node.plates, names={"x": name})
            np.testing.assert_allclose(same, found.mean(name), atol=1e-9)
            turned = posterior.expectation(lambda x: x, plates=node.plates[::-1], names={"x": name})
            np.testing.assert_allclose(turned, found.mean(name).T, atol=1e-9)
            if len(node.plates) == 2:  # the first is foreign to the query, the second shared
                try:
                    reduced = posterior.expectation(
                        lambda x, p=node.plates[0]: x.max(p) ** 2,
                        plates=node.plates[1],
                        names={"x": name},
                    )
                except BudgetError:
                    continue
                expected = found.expectation(lambda x: x.max(axis=1) ** 2, name)
                np.testing.assert_allclose(reduced, expected, atol=1e-9)
            asked += 1
    assert asked > 15


def test_exact_quantiles_agree_with_enumeration() -> None:
    levels = np.array([0.0, 0.1, 0.5, 0.9, 1.0])
    for _, posterior, found in answered_by_tables("plates"):
        for name in found.names:
            node = found.model[name]
            if node.domain is None or _is_labelled(node):
                continue
            numbers = np.asarray(node.domain.numbers)
            answer = posterior.quantile(name, levels)
            assert answer.shape == levels.shape + node.plate_shape
            table = found.probabilities(name)
            below = np.where(numbers <= answer[..., None], table, 0).sum(axis=-1)
            under = np.where(numbers < answer[..., None], table, 0).sum(axis=-1)
            q = levels.reshape(-1, *([1] * len(node.plates)))
            assert (below >= q - 1e-9).all() and (under <= q + 1e-9).all()


@pytest.mark.parametrize("kind", KINDS)
def test_weighted_queries_are_weighted_means_of_the_draws(kind: str) -> None:
    for seed in SEEDS[:20]:
        net, evidence = problem(kind, seed)
        posterior = by(bmc.LikelihoodWeighting(500))(net, evidence, seed)
        if posterior is None:
            continue
        weights = np.full((1, 500), 1 / 500) if posterior.weights is None else posterior.weights
        assert weights.sum() == pytest.approx(1.0)
        for name in posterior.names:
            node = posterior.model[name]
            draws = posterior[name]
            assert draws.shape == (1, 500, *node.value_shape)
            if node.domain is not None:
                tables = [
                    np.tensordot(weights, (draws == s) * 1.0, axes=2) for s in node.domain.states
                ]
                np.testing.assert_allclose(
                    posterior.probabilities(name), np.stack(tables, axis=-1), atol=1e-12
                )
            if _is_labelled(node):
                continue
            mean = np.tensordot(weights, draws, axes=2)
            spread = np.tensordot(weights, (draws - mean) ** 2, axes=2)
            np.testing.assert_allclose(posterior.mean(name), mean, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(posterior.var(name), spread, rtol=1e-9, atol=1e-9)
            same = posterior.expectation(lambda x: x, names={"x": name})
            np.testing.assert_allclose(same, mean, rtol=1e-9, atol=1e-9)
            above = posterior.probability(lambda x: x > 0.3, names={"x": name})
            expected = np.tensordot(weights, (draws > 0.3) * 1.0, axes=2)
            np.testing.assert_allclose(above, expected, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_summaries_agree_with_draws(kind: str) -> None:
    """The same seed draws the same values, kept or not."""
    for seed in SEEDS[:20]:
        net, evidence = problem(kind, seed)
        engine = bmc.LikelihoodWeighting(3000)
        kept, sums = (by(engine, keep=k)(net, evidence, seed) for k in ("draws", "summaries"))
        assert (kept is None) == (sums is None)
        if kept is None:
            continue
        assert sums.log_marginal_likelihood == pytest.approx(kept.log_marginal_likelihood, abs=1e-9)
        for name in kept.names:
            node = kept.model[name]
            if node.domain is not None:
                np.testing.assert_allclose(
                    sums.probabilities(name), kept.probabilities(name), atol=1e-9
                )
            if not _is_labelled(node):
                np.testing.assert_allclose(sums.mean(name), kept.mean(name), rtol=1e-7, atol=1e-7)
                np.testing.assert_allclose(sums.var(name), kept.var(name), rtol=1e-6, atol=1e-7)
            if kept.weights is not None:
                np.testing.assert_allclose(sums.mcse(name), kept.mcse(name), rtol=1e-5, atol=1e-9)


# ---- shrinking counterexamples ------------------------------------------------------------------


@settings(max_examples=60)
@given(bayes_nets(plates=True, configurations=2048), st.data())
def test_exact_matches_on_drawn_nets(net: bmc.BayesNet, data: Any) -> None:
    evidence = data.draw(evidence_for(net))
    found = enumerate_posterior(net, evidence)
    assert_matches(bmc.infer(net, evidence, engine=bmc.Exact()), found)


# ---- negative controls --------------------------------------------------------------------------


def reweighted(change: Callable[[np.ndarray], np.ndarray | None]) -> Answer:
    """Likelihood weighting with a fault in its weights."""

    def answer(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
        right = by(bmc.LikelihoodWeighting(10_000))(net, evidence, seed)
        if right is None or right.log_weights is None or np.ptp(right.log_weights) < 0.5:
            return None  # the weights say next to nothing
        wrong = change(right.log_weights)
        stored = dict(right._stored)
        return DrawsPosterior(right.problem, right.engine, stored, right._shape, wrong, True)

    return answer


class Inverted(bmc.Importance):
    """Importance sampling with weights q/p, as a misprint has it; zeros of p are cut off."""

    def steps(self, problem: Problem) -> list[Step]:
        return [
            inverted(step) if isinstance(step, (Propose, WeighDrawn)) else step
            for step in super().steps(problem)
        ]


def inverted(step: Step) -> Step:
    def wrong(state: Pass) -> None:
        before, state.log_weight = state.log_weight, 0.0
        step(state)
        state.log_weight = before - np.clip(state.log_weight, -50.0, None)

    return wrong


def transposed(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
    """Exact answers of a net in which one table has two of its parents' axes exchanged."""
    for name in net:
        declared = net._declarations[name]
        probs = declared.probs
        if probs is None or probs.ndim < 3 or probs.shape[0] != probs.shape[1]:
            continue
        wrong = net.copy()
        swapped = np.swapaxes(probs, 0, 1)
        wrong._declarations[name] = replace(declared, probs=swapped)
        if not np.allclose(swapped, probs):
            try:
                return bmc.infer(wrong, evidence, engine=bmc.Exact())
            except ZeroProbabilityError:
                return None
    return None


# fault, options of the nets
FAULTS: dict[str, tuple[Answer, dict[str, Any]]] = {
    "forgets the weights": (reweighted(lambda log_w: None), {}),
    "inverts the weights": (reweighted(lambda log_w: -np.maximum(log_w, -50)), {}),
    "squares the weights": (reweighted(lambda log_w: 2 * log_w), {}),
    "weighs by q/p": (by_importance(Inverted, 10_000), {"nodes": (3, 6)}),
    "weighs by q/p, hybrid": (by_importance(Inverted, 10_000), {"hybrid": True, "nodes": (3, 6)}),
    "transposes a table": (transposed, {"states": 2, "nodes": (4, 8)}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_engine_is_caught(fault: str) -> None:
    """On most nets: some faults change no marginal (two parents that are both observed, say)."""
    answer, options = FAULTS[fault]
    caught = tried = 0
    for seed in range(60):
        net = random_net(seed, **options)
        evidence = random_evidence(net, seed)
        posterior = answer(net, evidence, seed)
        if posterior is not None:
            tried += 1
            caught += bool(compare(posterior, enumerate_posterior(net, evidence), ALPHA).rejected)
    assert tried >= 10
    assert caught >= 0.75 * tried, f"{caught} of {tried}"


# ---- private ------------------------------------------------------------------------------------


def _is_labelled(node: Any) -> bool:
    return node.domain is not None and node.domain.labels is not None


def _cov(found: Any, names: list[str]) -> np.ndarray:
    flat = np.concatenate(
        [np.asarray(found.values(n), dtype=float).reshape(len(found.weights), -1) for n in names],
        axis=1,
    )
    centred = flat - found.weights @ flat
    matrix = (centred * found.weights[:, None]).T @ centred
    return matrix[0, 0] if matrix.size == 1 else matrix
