"""Invariance and detailed balance, exact and counted: the counts against the matrices, false alarms,
wrong input.

Right kernels at alpha = 1e-4 and fixed seeds. Counted tests are exact but for the two sides of a tail, so
that the rate of alarms over many seeds is held against the binomial law from above (once in 1e4).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.special

import bayesmc as bmc
from bayesmc.errors import BudgetError, ShapeError, UnsupportedError
from bayesmc.markov import MarkovChain
from bayesmc.testing import (
    detailed_balance,
    enumerate_posterior,
    invariant,
    random_evidence,
    random_net,
    transition_matrix,
)
from bayesmc.testing.verdict import uncounted

ALPHA = 1e-4


def pair() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.2, 0.3, 0.5]))
    net.add("b", lambda a: bmc.Bernoulli(0.1 + 0.35 * a))
    net.add("c", lambda a, b: bmc.Bernoulli(0.1 + 0.2 * a + 0.3 * b))
    return net


EVIDENCE = {"c": 1}
ROWS = enumerate(zip((0.2, 0.3, 0.5), (0.1, 0.45, 0.8), strict=True))
JOINT = np.array(
    [[p * (q if b else 1 - q) * (0.1 + 0.2 * a + 0.3 * b) for b in (0, 1)] for a, (p, q) in ROWS]
)


def draw(state: dict, name: str, rng: np.random.Generator, flat: float = 0.0) -> dict:
    """One node given the other, perhaps with something added to all its probabilities."""
    weights = (JOINT[:, state["b"]] if name == "a" else JOINT[state["a"]]) + flat
    return {**state, name: int(rng.choice(len(weights), p=weights / weights.sum()))}


def at_random(state: dict, rng: np.random.Generator) -> dict:
    return draw(state, "ab"[rng.integers(2)], rng)


def in_turn(state: dict, rng: np.random.Generator) -> dict:
    return draw(draw(state, "a", rng), "b", rng)


def biased(state: dict, rng: np.random.Generator) -> dict:
    return draw(state, "ab"[rng.integers(2)], rng, 0.02)


def test_counted() -> None:
    options: dict[str, Any] = {"draws": 4_000, "alpha": ALPHA, "rng": 1}
    assert invariant(at_random, pair(), EVIDENCE, **options)
    assert detailed_balance(at_random, pair(), EVIDENCE, **options)
    assert invariant(in_turn, pair(), EVIDENCE, **options)
    turned = detailed_balance(in_turn, pair(), EVIDENCE, **options)
    assert not turned
    assert "(a=" in turned.rejected[0].what and "->" in turned.rejected[0].what
    wrong = invariant(biased, pair(), EVIDENCE, **options)
    assert not wrong
    assert any(c.what.startswith("a = ") for c in wrong.rejected)


def test_batched_functions() -> None:
    def step(state: dict, rng: np.random.Generator) -> dict:
        weights = JOINT[:, state["b"]].T
        edges = np.cumsum(weights, axis=1) / weights.sum(axis=1, keepdims=True)
        return {"a": (rng.random((len(edges), 1)) > edges).sum(axis=1)}

    assert invariant(step, pair(), EVIDENCE, batched=True, alpha=ALPHA, rng=0)
    assert detailed_balance(step, pair(), EVIDENCE, batched=True, alpha=ALPHA, rng=0)

    def shared(state: dict, rng: np.random.Generator) -> dict:
        return {"a": np.minimum(step(state, rng)["a"], 1)}

    assert not invariant(shared, pair(), EVIDENCE, batched=True, rng=0)


@pytest.mark.thorough
def test_false_alarms() -> None:
    runs, alpha = 80, 0.1
    with uncounted():
        found = [
            [
                bool(test(at_random, pair(), EVIDENCE, draws=150, alpha=alpha, rng=seed))
                for seed in range(runs)
            ]
            for test in (invariant, detailed_balance)
        ]
    for results in found:
        assert scipy.special.bdtrc(results.count(False) - 1, runs, alpha) > 1e-4


def test_steps_out_of_the_support() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.5, 0.5, 0.0]))
    found = invariant(lambda s, rng: {"a": rng.integers(3)}, net, draws=500, rng=0)
    assert not found
    assert "probability zero, the first from (a=" in found.rejected[0].what


def test_partial_evidence_and_labels() -> None:
    net = bmc.BayesNet(plates={"i": 2})
    net.table("a", probs=[0.3, 0.7], states=["no", "yes"])
    net.add("x", lambda a: bmc.Bernoulli(np.where(a == "yes", 0.8, 0.1)), plates="i")
    seen = np.ma.MaskedArray([1, 0], mask=[False, True])

    def right(state: dict, rng: np.random.Generator) -> dict:
        x = state["x"]
        x[1] = rng.random() < (0.8 if state["a"] == "yes" else 0.1)
        return {"x": x}

    def moves_data(state: dict, rng: np.random.Generator) -> dict:
        return {"x": [rng.integers(2), state["x"][1]]}

    assert invariant(right, net, {"x": seen}, draws=3000, alpha=ALPHA, rng=0)
    assert not invariant(moves_data, net, {"x": seen}, draws=3000, rng=0)


# ---- exact --------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", [bmc.Gibbs(), bmc.MetropolisHastings(proposal={"a": "prior"})])
def test_engines_are_exact(engine: Any) -> None:
    found = invariant(engine, pair(), EVIDENCE)
    assert found
    assert "the whole sweep" in str([c.what for c in found.comparisons])
    assert detailed_balance(engine, pair(), EVIDENCE)


def test_chains_bring_their_matrix() -> None:
    states, matrix = transition_matrix(pair(), EVIDENCE, bmc.Gibbs())
    chain = MarkovChain(matrix, states)
    assert invariant(chain, pair(), EVIDENCE)
    assert not detailed_balance(chain, pair(), EVIDENCE)  # a sweep of two updates
    order = np.random.default_rng(0).permutation(len(states))
    mixed = MarkovChain(matrix[np.ix_(order, order)], [states[i] for i in order])
    assert invariant(mixed, pair(), EVIDENCE)
    slow = np.eye(6) * 0.5 + np.roll(np.eye(6), 1, axis=1) * 0.5
    wrong = invariant(MarkovChain(slow, states), pair(), EVIDENCE)
    assert not wrong
    assert "the chain: probability of (a=" in wrong.rejected[0].what
    with pytest.raises(ShapeError, match="the same joint states"):
        invariant(MarkovChain(np.eye(2)), pair(), EVIDENCE)


def test_exact_and_counted_agree() -> None:
    """Steps by the exact matrix of a kernel pass, and of one that is mixed with a wrong one do not."""
    asked = 0
    for seed in range(60):
        net = random_net(seed, nodes=(2, 4), deterministic=False)
        evidence = random_evidence(net, seed)
        hidden = [n for n in net if n not in evidence]
        try:
            states, matrix = transition_matrix(net, evidence, bmc.Gibbs())
        except UnsupportedError:
            continue
        if len(states[0]) != len(hidden):  # some are drawn forward
            continue
        number = {state: i for i, state in enumerate(states)}

        def step(state: dict, rng: Any, p: Any = matrix, s: Any = states, of: Any = number,
                 names: Any = hidden) -> dict:  # fmt: skip
            now = of[tuple(state[n] for n in names)]
            return dict(zip(names, s[rng.choice(len(s), p=p[now])], strict=True))

        def mixed(state: dict, rng: Any, right: Any = step, first: Any = states[0],
                  names: Any = hidden) -> dict:  # fmt: skip
            return right(state, rng) if rng.random() < 0.7 else dict(zip(names, first, strict=True))

        assert invariant(step, net, evidence, draws=2000, alpha=1e-5, rng=seed)
        assert not invariant(mixed, net, evidence, draws=2000, alpha=1e-5, rng=seed)
        asked += 1
    assert asked > 5


def test_coupled_sites_updated_at_once() -> None:
    """The classical fault, exactly: checkerboards are right, all at once is not."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("b", lambda a: bmc.Bernoulli(0.1 + 0.8 * a))
    states = enumerate_posterior(net)
    assert len(states.weights) == 4
    p = np.array([[0.9, 0.1], [0.1, 0.9]])
    matrix = np.array([[p[b, c] * p[a, d] for c in (0, 1) for d in (0, 1)]
                       for a in (0, 1) for b in (0, 1)])  # fmt: skip
    labels = [(a, b) for a in (0, 1) for b in (0, 1)]
    assert not invariant(MarkovChain(matrix, labels), net)


# ---- wrong input --------------------------------------------------------------------------------


def test_what_cannot_be_counted() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    with pytest.raises(UnsupportedError, match="'x' is hidden and has infinitely many values"):
        invariant(lambda s, rng: s, net)
    with pytest.raises(UnsupportedError, match="nothing is hidden"):
        invariant(lambda s, rng: s, net, {"x": 1.0})
    with pytest.raises(ValueError, match="alpha=2"):
        invariant(at_random, pair(), alpha=2)
    with pytest.raises(ValueError, match="draws=0"):
        detailed_balance(at_random, pair(), draws=0)
    with pytest.raises(UnsupportedError, match="moves no states"):
        invariant("gibbs", pair())
    wide = bmc.BayesNet(plates={"i": 11})
    wide.add("x", bmc.Bernoulli(0.5), plates="i")
    with pytest.raises(BudgetError, match="2048 joint states"):
        invariant(lambda s, rng: s, wide)
    graph = pair().to_factor_graph(EVIDENCE)
    with pytest.raises(UnsupportedError, match="a function needs a BayesNet"):
        invariant(at_random, graph)
    assert invariant(bmc.Gibbs(), graph)
