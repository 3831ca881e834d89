"""Strong elimination: random hybrid products against one dense Cholesky, and the price told beforehand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from bayesmc.factors import gaussian
from bayesmc.factors.gaussian import Conditional, GaussianFactor, StrongPlan, integrate, strong_plan

Scopes = list[tuple[tuple[Hashable, ...], tuple[Hashable, ...]]]


def tree(rng: np.random.Generator, size: int) -> Scopes:
    """Every block given an earlier one, switched or not."""
    parts: Scopes = [((), (0,))]
    for k in range(1, size):
        parts.append((scope(rng), (k, int(rng.integers(k)))))
    return [*parts, *(((), (k,)) for k in range(size) if rng.random() < 0.5)]


def loop(rng: np.random.Generator, size: int) -> Scopes:
    """A ring with chords."""
    parts: Scopes = [(scope(rng), (k, (k + 1) % size)) for k in range(size)]
    chord = rng.choice(size, size=3, replace=False).tolist()
    return [*parts, (scope(rng), tuple(chord)), *(((), (k,)) for k in range(size))]


def islands(rng: np.random.Generator, size: int) -> Scopes:
    """Two sets of blocks that share no factor."""
    first = tree(rng, size // 2)
    second = [(s, tuple(b + 100 for b in blocks)) for s, blocks in loop(rng, 4)]  # type: ignore[operator]
    return [*first, *second]


def scope(rng: np.random.Generator) -> tuple[Hashable, ...]:
    return tuple(v for v in ("s", "t", "u") if rng.random() < 0.3)


CARDS = {"s": 2, "t": 3, "u": 2}
GRAPHS: dict[str, Callable[[np.random.Generator, int], Scopes]] = {
    "tree": tree,
    "loop": loop,
    "islands": islands,
}


def product(
    rng: np.random.Generator, parts: Scopes
) -> tuple[list[GaussianFactor], dict[Hashable, int]]:
    """Factors of random rows that determine every block."""
    dims = {b: int(rng.integers(1, 4)) for b in dict.fromkeys(b for _, bs in parts for b in bs)}
    parts = [*parts, *(((), (b,)) for b in dims)]
    factors = []
    for names, blocks in parts:
        lead = tuple(CARDS[v] for v in names)  # type: ignore[index]
        width = sum(dims[b] for b in blocks)
        count = int(rng.integers(1, 4)) if len(blocks) > 1 else dims[blocks[0]]
        rows = rng.normal(size=(*lead, count, width + 1))
        factors.append(GaussianFactor(names, blocks, rows, rng.normal(size=lead)))
    return factors, dims


def shapes(factors: Sequence[GaussianFactor]) -> list[Any]:
    return [(f.scope, f.blocks, f.rows.shape[-2]) for f in factors]


def dense(
    factors: Sequence[GaussianFactor], dims: Mapping[Any, int], states: Mapping[Any, int]
) -> tuple[float, np.ndarray, np.ndarray, dict[Any, slice]]:
    """Log integral, mean and covariance of one configuration, by one Cholesky of the normal equations."""
    at, first = {}, 0
    for b, d in dims.items():
        at[b] = slice(first, first + d)
        first += d
    precision, shift, log_scale = np.zeros((first, first)), np.zeros(first), 0.0
    for f in factors:
        index = tuple(states[v] for v in f.scope)
        columns = np.concatenate([np.arange(first)[at[b]] for b in f.blocks])
        a, z = f.rows[index][:, :-1], f.rows[index][:, -1]
        precision[np.ix_(columns, columns)] += a.T @ a
        shift[columns] += a.T @ z
        log_scale += f.log_scale[index] - 0.5 * z @ z
    lower = np.linalg.cholesky(precision)
    half = np.linalg.solve(lower, shift)
    log_scale += 0.5 * half @ half - np.log(np.diagonal(lower)).sum()
    cov = np.linalg.inv(precision)
    return log_scale + 0.5 * first * np.log(2 * np.pi), cov @ shift, cov, at


def gathered(
    conditionals: Sequence[Conditional], dims: Mapping[Any, int], states: Mapping[Any, int]
) -> tuple[np.ndarray, np.ndarray, dict[Any, slice]]:
    """Mean and covariance of all blocks, from each given those integrated after it."""
    means: dict[Any, np.ndarray] = {}
    loads: dict[Any, np.ndarray] = {}  # on one standard normal vector for everything
    total = sum(dims.values())
    first = 0
    for given in reversed(conditionals):
        d = dims[given.block]
        index = tuple(states[v] for v in given.scope)
        load = np.zeros((d, total))
        load[:, first : first + d] = given.root[index]
        first += d
        mean = given.offset[index].copy()
        begin = 0
        for p in given.parents:
            gain = given.gain[index][:, begin : begin + dims[p]]
            begin += dims[p]
            mean += gain @ means[p]
            load += gain @ loads[p]
        means[given.block], loads[given.block] = mean, load
    at, first = {}, 0
    for b, d in dims.items():
        at[b] = slice(first, first + d)
        first += d
    load = np.concatenate([loads[b] for b in dims])
    return np.concatenate([means[b] for b in dims]), load @ load.T, at


@pytest.mark.parametrize("graph", GRAPHS)
def test_products_match_one_dense_cholesky(graph: str) -> None:
    for seed in range(12):
        rng = np.random.default_rng([seed, list(GRAPHS).index(graph)])
        factors, dims = product(rng, GRAPHS[graph](rng, int(rng.integers(3, 8))))
        plan = strong_plan(dims, CARDS, shapes(factors))
        conditionals, tables = integrate(plan, factors, dims, CARDS)
        assert sorted(map(str, (c.block for c in conditionals))) == sorted(map(str, dims))
        for states in map(
            dict, itertools.product(*([(v, k) for k in range(n)] for v, n in CARDS.items()))
        ):
            log_total, mean, cov, _ = dense(factors, dims, states)
            parts = [
                float(np.asarray(t)[tuple(states[v] for v in names)])
                for names, t in zip(plan.table_scopes, tables, strict=True)
            ]
            assert sum(parts) == pytest.approx(log_total, rel=1e-8, abs=1e-8)
            found_mean, found_cov, _ = gathered(conditionals, dims, states)
            size = max(1.0, float(np.abs(mean).max()), float(np.abs(cov).max()))
            np.testing.assert_allclose(found_mean, mean, rtol=0, atol=1e-8 * size)
            np.testing.assert_allclose(found_cov, cov, rtol=0, atol=1e-8 * size)


def test_a_factor_left_out_is_noticed() -> None:
    """Negative control: the dense answer without one row differs."""
    rng = np.random.default_rng(3)
    factors, dims = product(rng, loop(rng, 5))
    plan = strong_plan(dims, CARDS, shapes(factors))
    _, tables = integrate(plan, factors, dims, CARDS)
    states = {"s": 1, "t": 2, "u": 0}
    found = sum(
        float(np.asarray(t)[tuple(states[v] for v in names)])  # type: ignore[index]
        for names, t in zip(plan.table_scopes, tables, strict=True)
    )
    assert found == pytest.approx(dense(factors, dims, states)[0], rel=1e-8)
    short = GaussianFactor(
        factors[0].scope, factors[0].blocks, factors[0].rows[..., 1:, :], factors[0].log_scale
    )
    assert found != pytest.approx(dense([short, *factors[1:]], dims, states)[0], abs=1e-3)


@pytest.mark.parametrize("graph", GRAPHS)
def test_plans_foresee_scopes_and_memory(graph: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every product that is made is one that was planned, and no larger."""
    made: list[tuple[Any, Any, int]] = []
    original = gaussian.eliminate

    def watched(factors: Any, block: Any, dims: Any, cards: Any) -> Any:
        given, left = original(factors, block, dims, cards)
        lead = math.prod(cards[v] for v in given.scope)
        count = sum(f.rows.shape[-2] for f in factors)
        width = dims[block] + sum(dims[b] for b in given.parents) + 1
        made.append((block, given, 8 * lead * count * width))
        return given, left

    monkeypatch.setattr(gaussian, "eliminate", watched)
    for seed in range(8):
        rng = np.random.default_rng([seed, 7])
        factors, dims = product(rng, GRAPHS[graph](rng, 6))
        plan = strong_plan(dims, CARDS, shapes(factors))
        made.clear()
        _, tables = integrate(plan, factors, dims, CARDS)
        assert len(made) == len(plan.steps) == len(dims)
        for step, (block, given, size) in zip(plan.steps, made, strict=True):
            assert (step.block, step.scope, step.parents) == (block, given.scope, given.parents)
            assert size <= step.bytes
        assert [t.shape for t in tables] == [
            tuple(CARDS[v] for v in names)  # type: ignore[index]
            for names in plan.table_scopes
        ]
        assert plan.bytes == pytest.approx(sum(s.bytes for s in plan.steps))
        assert plan.largest is not None
        assert plan.largest.bytes == max(s.bytes for s in plan.steps)


def test_sets_that_share_nothing_stay_apart() -> None:
    parts = [(("s",), ("x",), 1), (("t",), ("y",), 1), ((), ("x",), 1), ((), ("y",), 1)]
    plan = strong_plan({"x": 1, "y": 1}, CARDS, parts)
    assert sorted(plan.table_scopes) == [("s",), ("t",)]
    assert all(not step.parents for step in plan.steps)


def test_nothing_to_integrate() -> None:
    plan = strong_plan({}, {}, [])
    assert plan == StrongPlan((), (), 0, None)
    assert integrate(plan, [], {}, {}) == ([], [])


# ---- chains ---------------------------------------------------------------------------------------


def switching_chain(length: int, separated: bool) -> list[Any]:
    """Steps between neighbours, each switched by a mode; separated: every second block is known."""
    parts: list[Any] = []
    for k in range(length):
        if separated:
            parts.append(((("m", k),), (k,), 1))
            parts.append(((("m", k),), (k,), 1))
        else:
            parts.append(((("m", k),), (k, k - 1) if k else (k,), 1))
            parts.append(((), (k,), 1))
    return parts


def test_a_chain_that_separates_costs_little() -> None:
    length = 200
    cards = {("m", k): 2 for k in range(length)}
    plan = strong_plan(dict.fromkeys(range(length), 1), cards, switching_chain(length, True))
    assert len(plan.table_scopes) == length
    assert max(map(len, plan.table_scopes)) == 1
    assert plan.bytes < 1e5


def test_one_switch_for_many_blocks_costs_little() -> None:
    """What one discrete variable switches stays one axis, however many blocks there are."""
    length = 300
    parts = [(("s",), (k, k - 1) if k else (k,), 1) for k in range(length)]
    plan = strong_plan(dict.fromkeys(range(length), 1), {"s": 4}, parts)
    assert plan.table_scopes == (("s",),)
    assert plan.bytes < 1e6


@pytest.mark.parametrize("length", [10, 30, 60, 400])
def test_a_chain_that_does_not_is_told_at_once(length: int) -> None:
    """Its modes all meet in one table: 2 to the length, known without making it."""
    cards = {("m", k): 2 for k in range(length)}
    plan = strong_plan(dict.fromkeys(range(length), 1), cards, switching_chain(length, False))
    assert plan.bytes >= 8 * 2.0**length
    assert plan.largest is not None
    assert len(plan.largest.scope) == length
    assert len(plan.table_scopes[0]) == length


def test_long_chains_are_planned_along() -> None:
    length = 3000
    parts = [((), (k, k - 1) if k else (k,), 1) for k in range(length)]
    plan = strong_plan(dict.fromkeys(range(length), 1), {}, parts)
    assert max(len(s.parents) for s in plan.steps) <= 2
