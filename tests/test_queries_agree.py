"""Answers to queries on random nets: exact ones against enumeration, weighted ones against their draws."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BayesmcWarning, BudgetError, UnsupportedError, ZeroProbabilityError
from bayesmc.testing import session
from tests.matrix import KINDS, SEEDS, by, exact, problem


def answered_by_tables(kind: str) -> Iterator[tuple[bmc.BayesNet, Any, Any]]:
    """The nets that `Exact` takes, each with its posterior and the enumerated one."""
    # of nets with numbers it takes a quarter
    seeds = SEEDS if kind.startswith("hybrid") else SEEDS[: session.scaled(15, 8)]
    for seed in seeds:
        net, evidence = problem(kind, seed)
        if not bmc.Exact().unsupported(net, evidence):
            yield net, bmc.infer(net, evidence, engine=bmc.Exact()), exact(kind, seed)


def total_of(net: bmc.BayesNet, name: str) -> Callable[[Any], Any]:
    axes = tuple(range(-len(net[name].plates), 0))
    return lambda value: np.asarray(value, dtype=float).sum(axis=axes)


@pytest.mark.parametrize("kind", ["discrete", "plates", "hybrid plates"])
def test_exact_queries_agree_with_enumeration(kind: str) -> None:
    asked = tables = 0
    for net, posterior, found in answered_by_tables(kind):
        finite = [n for n in found.names if found.model[n].domain is not None]
        numeric = [n for n in found.names if not _is_labelled(found.model[n])]
        for a in finite[:2]:
            for b in finite[-2:]:
                np.testing.assert_allclose(
                    posterior.probabilities(a, b), found.probabilities(a, b), atol=1e-9
                )
                tables += 1
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
    assert asked > 20 and tables > 20


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
    assert asked > 10


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
            if kept.weights is not None:  # of what is certain, roots of rounded squares: 3e-9 and 0
                np.testing.assert_allclose(sums.mcse(name), kept.mcse(name), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("kind", ["discrete", "plates", "hybrid"])
def test_errors_of_shares_hold_the_truth(kind: str) -> None:
    """Few draws, so that many a state is never met: its error is not zero, and tells how often it may be.

    Two errors hold 95 % of the shares of independent draws; those of one net depend on each other. With
    five, binomial counts of 40 draws are off once in 1e5.
    """
    answers: list[tuple[Any, str, range]] = [
        (bmc.LikelihoodWeighting(40), "draws", SEEDS),
        (bmc.LikelihoodWeighting(40), "summaries", SEEDS),
        (bmc.Gibbs(40, warmup=20, chains=4), "draws", SEEDS[:5]),
    ]
    unseen, held = 0, []
    for engine, keep, seeds in answers:
        for seed in seeds:
            net, evidence = problem(kind, seed)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", BayesmcWarning)  # so few draws are worth one
                try:
                    posterior = bmc.infer(net, evidence, engine=engine, rng=seed, keep=keep)
                except ZeroProbabilityError:
                    continue
            if posterior.weight_ess is not None and posterior.weight_ess < 15:
                continue
            found = exact(kind, seed)
            for name in found.names:
                node, seen = posterior.model[name], posterior._seen.get(name)
                if node.domain is None or (seen is not None and seen.mask is None):
                    continue
                labelled = _is_labelled(node)
                got, truth = (
                    a.probabilities(name) if labelled else a.mean(name) for a in (posterior, found)
                )
                error = posterior.mcse(name)
                if not node.is_stochastic or seen is not None or node.domain.size == 1:
                    continue  # part of it is known
                assert (error > 0).all(), (seed, name)
                off = np.abs(got - truth) / error
                assert (off < 5).all(), (seed, name, off)
                held.append((off < 2).mean())
                unseen += int((posterior.probabilities(name) == 0).sum())
    assert unseen > 2 and np.mean(held) > 0.93


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
