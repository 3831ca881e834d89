"""Every engine against enumeration, on random nets: an engine joins the matrix with one line.

Seeds are fixed, so a run is repeatable; ``BAYESMC_SEED`` shifts them on demand. One net under one engine
is compared at a false-alarm rate of 1e-3 (Holm over its states, means and evidence), and at the fixed
seeds none may be rejected. At fresh ones, with some 1,200 such comparisons, a chance rejection is likely
somewhere; there a rejected net is drawn again, with other random numbers, and fails if it is rejected
again (1e-6 each, 1e-3 for a whole run); and more than 3 first rejections among 60 nets (probability
5e-7) fail, too.
"""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import bayesmc as bmc
from bayesmc.errors import BudgetError, LowEssWarning, UnsupportedError, ZeroProbabilityError
from bayesmc.network import pose
from bayesmc.results import DrawsPosterior
from bayesmc.testing import (
    assert_matches,
    bayes_nets,
    compare,
    enumerate_posterior,
    evidence_for,
    random_evidence,
    random_net,
)

ALPHA = 1e-3
SHIFT = int(os.environ.get("BAYESMC_SEED", "0"))
SEEDS = range(SHIFT, SHIFT + 60)
KINDS: dict[str, dict[str, Any]] = {
    "discrete": {},
    "plates": {"plates": True},
    "hybrid": {"hybrid": True},
    "hybrid plates": {"hybrid": True, "plates": True},
}

Answer = Callable[[bmc.BayesNet, dict[str, Any], int], Any]


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
        assert all(issubclass(w.category, LowEssWarning) for w in caught)
        return None if caught else posterior

    return answer


#: name -> (answer, least share of the 60 nets of each kind that it must answer)
ENGINES: dict[str, tuple[Answer, dict[str, float]]] = {
    "Exact": (
        by(bmc.Exact()),
        {"discrete": 1, "plates": 0.95, "hybrid": 0.25, "hybrid plates": 0.25},
    ),
    "LikelihoodWeighting": (by(bmc.LikelihoodWeighting(20_000)), dict.fromkeys(KINDS, 0.9)),
    "LikelihoodWeighting, summaries": (
        by(bmc.LikelihoodWeighting(20_000), keep="summaries"),
        dict.fromkeys(KINDS, 0.9),
    ),
    "no engine named": (by(None), dict.fromkeys(KINDS, 0.9)),
}


@functools.cache
def problem(kind: str, seed: int) -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = random_net(seed, **KINDS[kind])
    return net, random_evidence(net, seed)


@functools.cache
def exact(kind: str, seed: int, observed: bool = True) -> Any:
    net, evidence = problem(kind, seed)
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
    return f"random_net({seed}, **{KINDS[kind]}), evidence {evidence}: {net.name}\n" + "\n".join(
        map(str, match.rejected)
    )


def check_all(answer: Answer, kind: str, observed: bool = True) -> int:
    """How many nets were answered; wrong answers raise."""
    results = [rejected(answer, kind, seed, seed + 1_000, observed) for seed in SEEDS]
    doubtful = [seed for seed, result in zip(SEEDS, results, strict=True) if result]
    assert len(doubtful) <= (3 if SHIFT else 0), "\n".join(filter(None, results))
    for seed in doubtful:
        again = rejected(answer, kind, seed, seed + 10**6, observed)
        assert not again, again
    return sum(result is not None for result in results)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("engine", ENGINES)
def test_engine_matches_enumeration(engine: str, kind: str) -> None:
    answer, share = ENGINES[engine]
    assert check_all(answer, kind) >= share[kind] * len(SEEDS)


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
                try:
                    result = posterior.expectation(lambda x, y: f(x) * g(y), names=names)  # noqa: B023
                except BudgetError:
                    continue  # the sums need all elements jointly
                expected = found.expectation(lambda x, y: f(x) * g(y), a, b)  # noqa: B023
                assert result == pytest.approx(expected, abs=1e-9)
                event = posterior.probability(lambda x, y: f(x) > g(y), names=names)  # noqa: B023
                chance = found.expectation(lambda x, y: f(x) > g(y), a, b)  # noqa: B023
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
        right = by(bmc.LikelihoodWeighting(20_000))(net, evidence, seed)
        if right is None or right.log_weights is None or np.ptp(right.log_weights) < 0.5:
            return None  # the weights say next to nothing
        wrong = change(right.log_weights)
        stored = dict(right._stored)
        return DrawsPosterior(right.problem, right.engine, stored, right._shape, wrong, True)

    return answer


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
