"""Forests of finite nodes drawn as one: sums and draws against enumeration; what is joined and read."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.errors import ConvergenceWarning, ParameterError, ZeroProbabilityError
from bayesmc.kernels.forest import Forest
from bayesmc.kernels.forest_block import ForestBlock
from bayesmc.kernels.lattice import SiteForest
from bayesmc.network import pose
from bayesmc.structure.target import Target
from bayesmc.testing import invariant, session
from bayesmc.testing.posteriors.matching import assert_matches
from bayesmc.testing.verdict import uncounted

# ---- arrays -----------------------------------------------------------------------------------------


def _random(rng: np.random.Generator, count: int, states: int, zeros: float) -> tuple[Any, ...]:
    edges = [(int(rng.integers(0, v)), v) for v in range(1, count) if rng.random() < 0.85]
    edges = [e if rng.random() < 0.5 else e[::-1] for e in edges]
    names = rng.permutation(count)
    edges = [(int(names[a]), int(names[b])) for a, b in edges]
    single = rng.normal(size=(states, count))
    pairs = 2.0 * rng.normal(size=(states, states, len(edges)))
    pairs[rng.random(pairs.shape) < zeros] = -np.inf
    return edges, single, pairs


def _joint(edges: list[tuple[int, int]], single: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Log weights of all joint states, by the definition."""
    states, count = single.shape
    log = np.zeros((states,) * count)
    for at in np.ndindex(*log.shape):
        log[at] = sum(single[k, v] for v, k in enumerate(at))
        log[at] += sum(pairs[at[a], at[b], e] for e, (a, b) in enumerate(edges))
    return log


def _drawn(edges: Any, single: Any, pairs: Any, rows: int, rng: Any) -> tuple[Any, Any]:
    forest = Forest(single.shape[1], np.array(edges).reshape(-1, 2))
    tables = np.full((*pairs.shape[:2], forest.tables, rows), np.nan)
    tables[:, :, : forest.edges] = pairs[..., None]
    uniform = rng.random((single.shape[1], rows))
    return forest.draw(np.repeat(single[..., None], rows, axis=2), tables, uniform)


@pytest.mark.parametrize("states", [2, 3, 13])
def test_sums_are_those_of_enumeration(states: int, rng: np.random.Generator) -> None:
    for _ in range(20):
        count = int(rng.integers(1, 9 if states < 4 else 4))
        edges, single, pairs = _random(rng, count, states, 0.15)
        log = _joint(edges, single, pairs)
        if log.max() == -np.inf:
            with pytest.raises(ZeroProbabilityError, match="no state has positive probability"):
                _drawn(edges, single, pairs, 1, rng)
            continue
        _, total = _drawn(edges, single, pairs, 2, rng)
        assert np.allclose(total, np.log(np.exp(log).sum()), rtol=1e-12)


@pytest.mark.parametrize("states", [2, 13])
def test_draws_have_the_joint_law(states: int, rng: np.random.Generator) -> None:
    """Chi-squared tests of all joint states at 1e-5 each, 8 and 3 of them: a false alarm in 9,000 runs."""
    count = 6 if states == 2 else 2
    for _ in range(8 if states == 2 else 3):
        edges, single, pairs = _random(rng, count, states, 0.0)
        probs = np.exp(_joint(edges, single, 0.3 * pairs)).ravel()
        probs /= probs.sum()
        assert _tail(_drawn(edges, single, 0.3 * pairs, 20_000, rng)[0], probs, states) > 1e-5
        wrong, _ = _drawn(edges[:-1], single, 0.3 * pairs[..., :-1], 20_000, rng)
        if edges:
            assert _tail(wrong, probs, states) < 1e-5  # one factor is forgotten


def _tail(drawn: np.ndarray, probs: np.ndarray, states: int) -> float:
    """Tail probability of counts; rare states are taken together."""
    at = np.ravel_multi_index(tuple(drawn), (states,) * len(drawn))
    counts = np.bincount(at, minlength=len(probs))
    rare = probs * len(at) < 10
    seen = np.append(counts[~rare], counts[rare].sum())
    wanted = np.append(probs[~rare], probs[rare].sum()) * len(at)
    kept = wanted > 0
    return float(stats.chisquare(seen[kept], wanted[kept]).pvalue)


@pytest.mark.parametrize("states", [2, 20])
def test_far_apart_evidence_is_not_lost(states: int, rng: np.random.Generator) -> None:
    """A chain that can only go up, with readings that contradict each other by a factor of e**1000."""
    count = 9
    single = np.zeros((states, count))
    single[1:, 0] = -np.inf
    single[0, 1:4] = -1000.0
    single[1:, 4:8] = -1000.0
    step = np.where(np.triu(np.ones((states, states))) > 0, 0.0, -np.inf)
    edges = [(t, t + 1) for t in range(count - 1)]
    drawn, total = _drawn(edges, single, np.repeat(step[..., None], count - 1, axis=2), 50, rng)
    assert (drawn[:8] == 0).all() and (drawn[8] > 0).any()
    assert np.allclose(total, -3000.0 + np.log(states), rtol=1e-12)


def test_cycles_are_refused() -> None:
    for edges in (
        [(0, 1), (1, 2), (2, 0)],
        [(0, 1), (1, 0)],
        [(0, 0)],
        [(0, 1), (1, 2), (2, 3), (3, 0)],
    ):
        with pytest.raises(ValueError, match="cycle"):
            Forest(4, np.array(edges))


# ---- nets -------------------------------------------------------------------------------------------

PARITY = np.array([[0.9, 0.1], [0.3, 0.7]])


def hidden_chain(steps: int = 6) -> tuple[Any, dict[str, Any]]:
    """Unknown rates and emissions; two readings are missing."""
    dbn = bmc.DynamicBayesNet(plates={"state": 2})
    dbn.add_static("row", bmc.Dirichlet(np.ones(2)), plates="state")
    dbn.add_static("mean", bmc.Normal(0.0, 2.0), plates="state")
    dbn.add(
        "s", lambda s_prev, row: bmc.Categorical(row[s_prev]), initial=bmc.Categorical([0.4, 0.6])
    )
    dbn.add("y", lambda s, mean: bmc.Normal(mean[s], 0.7))
    rows = np.linspace(-1.0, 1.0, steps)
    rows[[1, 4]] = np.nan
    return dbn.unroll(steps), dbn.unrolled_evidence({"y": rows})


def factorial(steps: int = 5) -> tuple[Any, dict[str, Any]]:
    """Two chains that the readings tie, through a sum that is computed first."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("sd", bmc.Gamma(3.0, 3.0))
    for name, size in (("a", 2), ("b", 3)):
        stay = np.full((size, size), 0.3 / (size - 1)) + np.eye(size) * (0.7 - 0.3 / (size - 1))
        dbn.add(
            name,
            lambda now, stay=stay: bmc.Categorical(np.take(stay, now, axis=0)),
            parents={"now": f"{name}_prev"},
            initial=bmc.Categorical(np.ones(size) / size),
        )
    dbn.add("level", lambda a, b: 1.0 * a - b)
    dbn.add("y", lambda level, sd: bmc.Normal(level, sd))
    rows = np.array([0.3, -0.7, -1.9, 0.5, 1.2])
    return dbn.unroll(steps), dbn.unrolled_evidence({"y": rows[:steps]})


def left_to_right(steps: int = 6) -> tuple[Any, dict[str, Any]]:
    """States that are never gone back to; counts whose rates are unknown."""
    dbn = bmc.DynamicBayesNet(plates={"state": 3})
    dbn.add_static("rate", bmc.Gamma(2.0, [2.0, 1.0, 0.4]), plates="state")
    go = np.array([[0.7, 0.3, 0.0], [0.0, 0.6, 0.4], [0.0, 0.0, 1.0]])
    dbn.add(
        "s", lambda s_prev: bmc.Categorical(go[s_prev]), initial=bmc.Categorical([1.0, 0.0, 0.0])
    )
    dbn.add("y", lambda s, rate: bmc.Poisson(rate[s]))
    return dbn.unroll(steps), dbn.unrolled_evidence({"y": np.array([0, 1, 1, 4, 6, 5])[:steps]})


def unlike() -> tuple[Any, dict[str, Any]]:
    """Nodes that differ in states, labels and kind, with an unknown share; they make one cycle."""
    net = bmc.BayesNet()
    net.add("p", bmc.Beta(2.0, 2.0))
    net.add("a", lambda p: bmc.Bernoulli(p), states=("no", "yes"))
    net.add("b", lambda a: bmc.Bernoulli(np.where(a == "yes", 0.8, 0.3)))
    net.add("c", lambda b, p: bmc.Binomial(3, np.where(b == 1, p, 0.5)))
    net.add("d", lambda a: bmc.DiscreteUniform(2, 4), states=None)
    net.add("e", lambda d, c: bmc.Normal(1.0 * d + c, 1.0))
    return net, {"e": 4.2}


def in_plates() -> tuple[Any, dict[str, Any]]:
    """A short chain for each element, some of it seen, and two readings of each end."""
    net = bmc.BayesNet(plates={"i": 3, "k": 2})
    net.add("row", bmc.Dirichlet([1.0, 2.0]), plates="k")
    net.add("a", bmc.Bernoulli(0.4), plates="i")
    net.add("b", lambda a, row: bmc.Categorical(row[a]), plates="i")
    net.add("c", lambda b, row: bmc.Categorical(row[b]), plates="i")
    net.add("y", lambda c: bmc.Normal(1.0 * c, 0.8), plates=("i", "k"))
    seen = np.array([[0.2, 1.1], [0.9, np.nan], [-0.3, 0.4]])
    return net, {"y": seen, "b": np.array([np.nan, 1.0, np.nan])}


def field() -> tuple[Any, dict[str, Any]]:
    """Variables of a factor graph that a loop declared, with an unknown coupling; they make cycles."""
    graph = bmc.FactorGraph()
    graph.variable("j", bmc.Normal(0.0, 1.0).support)
    graph.factor(lambda j: -0.5 * j**2, scope=("j",))
    names = [[f"s[{i},{k}]" for k in range(3)] for i in range(2)]
    for name in itertools.chain(*names):
        graph.variable(name, (-1, 1))
    pairs = [(r[k], r[k + 1]) for r in names for k in range(2)]
    for pair in [*pairs, *zip(names[0], names[1], strict=True)]:
        graph.factor(lambda a, b, j: j * a * b, scope=(*pair, "j"))
    return graph, {}


MODELS: dict[str, Callable[[], tuple[Any, dict[str, Any]]]] = {
    "hidden chain": hidden_chain, "factorial": factorial, "left to right": left_to_right,
    "unlike": unlike, "in plates": in_plates, "field": field,
}  # fmt: skip
#: nodes that each block draws, in the order of the blocks
JOINED = {
    "hidden chain": [6], "left to right": [6], "unlike": [3, 3], "in plates": [3], "field": [4, 5],
    "factorial": [7, 8],
}  # fmt: skip


def _blocks(net: Any, evidence: Any) -> tuple[Target, list[ForestBlock]]:
    plan = plan_of(pose(net, evidence))
    return plan.target, [k for k in plan.kernels if isinstance(k, ForestBlock)]


def _state(target: Target, rng: np.random.Generator, rows: int = 3) -> dict[str, np.ndarray]:
    states = target.states
    assert states is not None
    at = rng.integers(0, len(states[target.chain[0]]), rows)
    state = {
        n: v if n in target.known and n not in target.chain else v[at] for n, v in states.items()
    }
    for name in target.chain:  # of what is seen in part, the seen
        seen = target.seen(name)
        if seen is not None:
            state[name] = np.where(seen.mask, seen.value, state[name]).astype(state[name].dtype)
    return state


@pytest.mark.parametrize("name", MODELS)
def test_factors_are_those_of_the_joint_density(name: str, rng: np.random.Generator) -> None:
    """Sums of a block's factors and the joint density differ by a constant, over random joint states."""
    target, blocks = _blocks(*MODELS[name]())
    assert blocks and {n for b in blocks for n in b.names} == {
        n for n in target.chain if target.model[n].domain is not None
    }
    state = _state(target, rng)
    for block in blocks:
        with marking_invalid(), np.errstate(all="ignore"):
            single, tables, proper = block.log_factors(state)
            assert proper
            found, wanted = [], []
            for _ in range(40):
                new = {n: _other(target, n, state[n], rng) for n in block.names}
                found.append(_sum(block, single, tables, new))
                full = {**state, **new}
                target.refresh(full, block.names)
                wanted.append(target.log_density(full))
        for one, other in zip(np.array(found).T, np.array(wanted).T, strict=True):
            possible = np.isfinite(other)
            assert (np.isfinite(one) == possible).all() and possible.any()
            gap = one[possible] - other[possible]
            assert np.allclose(gap, gap[0], atol=1e-9)


def _other(target: Target, name: str, now: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    size = target.model[name].domain.size
    new = rng.integers(0, size, now.shape).astype(now.dtype)
    seen = target.seen(name)
    return new if seen is None else np.where(seen.mask, now, new)


def _sum(block: ForestBlock, single: Any, tables: Any, new: Any) -> np.ndarray:
    rows = single.shape[-1]
    state = np.array([new[n].reshape(-1) for n in block.names])
    at = np.arange(rows)
    total = sum(single[state[i], i, at] for i in range(len(state)))
    for step in block.forest.rounds:
        for side in (step.leaf, step.left, step.right):
            for v, n, e, first in zip(*_columns(side), strict=True):
                if e < block.forest.edges:
                    a, b = (state[v], state[n]) if first else (state[n], state[v])
                    total = total + tables[a, b, e, at]
    return total.reshape(len(next(iter(new.values()))), -1).sum(axis=1)


def _columns(side: Any) -> tuple[Any, ...]:
    return side.variables, side.neighbours, side.edge, side.is_first


@pytest.mark.parametrize("name", MODELS)
def test_blocks_are_as_large_as_they_come(name: str) -> None:
    _, blocks = _blocks(*MODELS[name]())
    sizes = sorted(len(b.names) for b in blocks)
    assert sizes == sorted(JOINED[name])


def small() -> bmc.BayesNet:
    """A tree of tables, and a reading of a leaf."""
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.2, 0.5, 0.3]))
    net.add("b", lambda a: bmc.Bernoulli(0.2 + 0.3 * a))
    net.add("c", lambda a: bmc.Bernoulli(0.9 - 0.4 * a))
    net.add("d", lambda c: bmc.Categorical(np.take(PARITY, c, axis=0)))
    net.add("y", lambda b, d: bmc.Bernoulli(0.15 + 0.3 * b + 0.4 * d))
    return net


def _block(target: Target) -> ForestBlock:
    return ForestBlock(target, ("a", "c", "b"))


def _forgetful(target: Target) -> ForestBlock:
    """Draws a leaf without what the rest says of it."""
    block = ForestBlock(target, ("a", "c", "b"))
    block.read.all, block.places = block.read.all[:-1], block.places[:-1]
    return block


def test_a_block_leaves_the_posterior_invariant() -> None:
    """Exact, but for rounding: transition matrices are read off the draws."""
    assert invariant(_block, small(), {"y": 1})
    assert not invariant(_forgetful, small(), {"y": 1})


def _with_bad_scale(share: float) -> bmc.BayesNet:
    """A scale below zero in a state that has some probability, or none."""
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.5, 0.5 - share, share]))
    net.add("p", bmc.Beta(2.0, 2.0))
    net.add("b", lambda a, p: bmc.Bernoulli(np.where(a == 0, p, 0.7)))
    net.add("y", lambda a, b: bmc.Normal(b, 1.0 - 0.8 * a))
    return net


def test_bad_parameters_count_where_they_are_possible() -> None:
    (block,) = _blocks(_with_bad_scale(0.0), {"y": 0.3})[1]
    assert block.names == ("a", "b")
    few = bmc.Gibbs(draws=20, warmup=20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        posterior = bmc.infer(_with_bad_scale(0.0), {"y": 0.3}, engine=few, rng=0)
    assert posterior.probabilities("a")[2] == 0.0
    with pytest.raises(ParameterError, match="'y'.*scale"):
        bmc.infer(_with_bad_scale(0.3), {"y": 0.3}, engine=few, rng=0)


def test_nodes_without_finite_neighbours_are_left_to_others() -> None:
    """Labels of a mixture, and tables of which no two are alike."""
    mixture = bmc.BayesNet(plates={"i": 5, "k": 2})
    mixture.add("weights", bmc.Dirichlet(np.ones(2)))
    mixture.add("mean", bmc.Normal(0.0, 3.0), plates="k")
    mixture.add("label", lambda weights: bmc.Categorical(weights), plates="i")
    mixture.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="i")
    assert not _blocks(mixture, {"x": np.arange(5.0)})[1]
    assert not _blocks(small(), {"y": 1})[1]


def sites(pairs: list[tuple[int, int]]) -> bmc.FactorGraph:
    """Sites of three states with factors on pairs that are not symmetric, one of them stated twice."""
    graph = bmc.FactorGraph(plates={"site": 4})
    graph.variable("s", 3, plates="site")
    first, second = zip(*pairs, strict=True)
    graph.factor(lambda a, b: 0.8 * a - 0.5 * a * b, scope=("s", "s"), index=(first, second))
    graph.factor(lambda a, b: 1.0 * (a > b), scope=("s", "s"), index=(first[:1], second[:1]))
    graph.factor(lambda a: 0.3 * a, scope=("s",), index=([1],))
    return graph


def test_tables_of_one_shape_are_not_of_a_kind() -> None:
    """Nodes of different tables move fast one by one, as many as there are; those of one table as one."""

    def kernels(alike: bool) -> set[str]:
        net = bmc.BayesNet()
        net.table("s[0]", probs=[0.5, 0.5])
        for t in range(1, 12):
            stay = 0.9 if alike else 0.9 - 0.01 * t
            rows = [[stay, 1 - stay], [1 - stay, stay]]
            net.table(f"s[{t}]", parents=[f"s[{t - 1}]"], probs=rows)
        return {type(k).__name__ for k in plan_of(pose(net, {"s[11]": 1})).kernels}

    assert kernels(True) == {"ForestBlock"}
    assert kernels(False) == {"TableSweep"}


def test_sites_of_a_factor_graph() -> None:
    """Trees of sites are drawn at once, and right; a ring is left to other kernels."""
    tree, ring = sites([(1, 0), (1, 2), (3, 1)]), sites([(0, 1), (1, 2), (2, 3), (3, 0)])
    assert [type(k) for k in plan_of(pose(tree, {})).kernels] == [SiteForest]
    assert SiteForest not in [type(k) for k in plan_of(pose(ring, {})).kernels]
    exact = bmc.infer(tree, {}, engine=bmc.Exact())
    engine = bmc.Gibbs(draws=2000, warmup=1, chains=4)
    # false-alarm rate 1e-5
    assert_matches(bmc.infer(tree, {}, engine=engine, rng=session.seed()), exact, alpha=1e-5)
    seen = {"s": np.array([np.nan, 2.0, np.nan, np.nan])}
    given = bmc.infer(tree, seen, engine=engine, rng=session.seed())
    assert_matches(given, bmc.infer(tree, seen, engine=bmc.Exact()), alpha=1e-5)
    assert given.probabilities("s")[1, 2] == 1.0
    wrong = bmc.infer(sites([(0, 1), (1, 2), (3, 1)]), {}, engine=bmc.Exact())
    with uncounted(), pytest.raises(AssertionError, match="'s'"):
        found = bmc.infer(tree, {}, engine=engine, rng=session.seed())
        assert_matches(found, wrong, alpha=1e-5)  # one factor the wrong way round
