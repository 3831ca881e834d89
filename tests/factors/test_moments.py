"""Moments, mixtures and draws of blocks, against dense joint Gaussians and sums over configurations."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np
import pytest
import scipy.stats

from bayesmc.factors import moments as module
from bayesmc.factors.gaussian import Conditional
from bayesmc.factors.moments import Components, Moments, mixture_scopes

CARDS = {"s": 2, "t": 3, "u": 2}
Joint = Callable[[tuple[Any, ...]], np.ndarray]


def network(
    rng: np.random.Generator, size: int, switched: float = 0.4
) -> tuple[list[Conditional], dict[Hashable, int]]:
    """Blocks given earlier ones; noise of a block may be degenerate or absent. In shuffled order."""
    dims: dict[Hashable, int] = {("x", k): int(rng.integers(1, 4)) for k in range(size)}
    names = list(dims)
    found = []
    for k, block in enumerate(names):
        count = int(rng.integers(0, min(k, 3) + 1))
        parents = tuple(names[j] for j in rng.choice(k, size=count, replace=False)) if k else ()
        scope = tuple(v for v in rng.permutation(list(CARDS)).tolist() if rng.random() < switched)
        lead = tuple(CARDS[v] for v in scope)
        d, n = dims[block], sum(dims[p] for p in parents)
        root = rng.normal(size=(*lead, d, d)) * rng.choice([0.0, 1.0], p=[0.15, 0.85])
        gain = rng.normal(size=(*lead, d, n)) * 0.7
        found.append(Conditional(block, scope, parents, rng.normal(size=(*lead, d)), gain, root))
    return [found[k] for k in rng.permutation(size)], dims


def joint_of(table: np.ndarray) -> Joint:
    """Marginal tables of a joint one, axes in the order asked for."""
    names = list(CARDS)

    def joint(scope: tuple[Any, ...]) -> np.ndarray:
        left = [v for v in names if v in scope]
        gone = tuple(k for k, v in enumerate(names) if v not in scope)
        return table.sum(axis=gone).transpose([left.index(v) for v in scope])

    return joint


def some_table(rng: np.random.Generator, zeros: bool = True) -> np.ndarray:
    table = rng.random(tuple(CARDS.values()))
    if zeros:
        table[rng.random(table.shape) < 0.3] = 0.0
        table[0, 0, 0] += 0.1
    return table / table.sum()


def dense(
    conditionals: Sequence[Conditional], dims: dict[Hashable, int], states: dict[str, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of all blocks in one configuration: one linear system."""
    at, first = {}, 0
    for b, d in dims.items():
        at[b] = slice(first, first + d)
        first += d
    gains, noise, offset = np.zeros((first, first)), np.zeros((first, first)), np.zeros(first)
    for given in conditionals:
        index = tuple(states[v] for v in given.scope)  # type: ignore[index]
        own = at[given.block]
        offset[own] = given.offset[index]
        noise[own, own] = given.root[index]
        begin = 0
        for p in given.parents:
            gains[own, at[p]] = given.gain[index][:, begin : begin + dims[p]]
            begin += dims[p]
    inverse = np.linalg.inv(np.eye(first) - gains)
    load = inverse @ noise
    return inverse @ offset, load @ load.T


def columns(dims: dict[Hashable, int], blocks: Sequence[Hashable]) -> np.ndarray:
    starts = dict(zip(dims, np.cumsum([0, *dims.values()]), strict=False))
    return np.concatenate([np.arange(starts[b], starts[b] + dims[b]) for b in blocks])


def mixture(
    conditionals: Sequence[Conditional], dims: dict[Hashable, int], table: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of all blocks over all configurations."""
    weights, means, seconds = [], [], []
    for index in np.ndindex(table.shape):
        mean, cov = dense(conditionals, dims, dict(zip(CARDS, index, strict=True)))
        weights.append(table[index])
        means.append(mean)
        seconds.append(cov + np.outer(mean, mean))
    mean = np.tensordot(weights, means, axes=1)
    return mean, np.tensordot(weights, seconds, axes=1) - np.outer(mean, mean)


@pytest.mark.parametrize("chunk", [1 << 14, 1, 3, 5])
def test_moments_are_those_of_the_mixture(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Worked on at once, or in chunks of configurations that are merged."""
    monkeypatch.setattr(module, "_CHUNK", chunk)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        conditionals, dims = network(rng, int(rng.integers(1, 8)))
        table = some_table(rng)
        found = Moments(conditionals, dims, CARDS, joint_of(table))
        mean, cov = mixture(conditionals, dims, table)
        for block in rng.permutation(len(dims)):
            name = list(dims)[block]
            at = columns(dims, [name])
            own_mean, own_cov = found.moments(name)
            np.testing.assert_allclose(own_mean, mean[at], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(own_cov, cov[np.ix_(at, at)], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("chunk", [1 << 14, 1, 3])
def test_components_are_joint_gaussians(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Several blocks at once, in the order asked for, split by further discrete variables."""
    monkeypatch.setattr(module, "_CHUNK", chunk)
    for seed in range(15):
        rng = np.random.default_rng([1, seed])
        conditionals, dims = network(rng, int(rng.integers(1, 8)))
        table = some_table(rng)
        found = Moments(conditionals, dims, CARDS, joint_of(table))
        names = list(dims)
        count = int(rng.integers(1, len(names) + 1))
        blocks = [names[k] for k in rng.choice(len(names), size=count, replace=False)]
        extra = [v for v in CARDS if rng.random() < 0.3]
        parts = found.components(blocks, extra)
        check_components(parts, conditionals, dims, table, blocks, extra)
        mean, cov = mixture(conditionals, dims, table)
        at = columns(dims, blocks)
        whole_mean, whole_cov = parts.collapsed()
        np.testing.assert_allclose(whole_mean, mean[at], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(whole_cov, cov[np.ix_(at, at)], rtol=1e-9, atol=1e-9)


def check_components(
    parts: Components,
    conditionals: Sequence[Conditional],
    dims: dict[Hashable, int],
    table: np.ndarray,
    blocks: Sequence[Hashable],
    extra: Sequence[str],
) -> None:
    scopes = above(conditionals)
    scope = set(extra).union(*(scopes[b] for b in blocks))
    assert set(parts.states) == scope
    at = columns(dims, blocks)
    size = len(parts.weights)
    assert parts.mean.shape == (size, len(at))
    assert parts.cov.shape == (size, len(at), len(at))
    assert (parts.weights > 0).all()
    names = [v for v in CARDS if v in scope]
    marginal = joint_of(table)(tuple(names))
    assert size == np.count_nonzero(marginal)
    for k in range(size):
        states = {v: int(parts.states[v][k]) for v in names}
        assert parts.weights[k] == pytest.approx(marginal[tuple(states[v] for v in names)])
        mean, cov = dense(conditionals, dims, {**dict.fromkeys(CARDS, 0), **states})
        np.testing.assert_allclose(parts.mean[k], mean[at], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(parts.cov[k], cov[np.ix_(at, at)], rtol=1e-9, atol=1e-9)


def above(conditionals: Sequence[Conditional]) -> dict[Hashable, set[Any]]:
    """The discrete variables of each block and of all blocks above it, by plain recursion."""
    of = {c.block: c for c in conditionals}

    def visit(block: Hashable) -> set[Any]:
        return set(of[block].scope).union(*(visit(p) for p in of[block].parents))

    return {block: visit(block) for block in of}


def test_scopes_of_mixtures() -> None:
    for seed in range(20):
        rng = np.random.default_rng([2, seed])
        conditionals, _ = network(rng, 9)
        scopes = mixture_scopes({c.block: (c.scope, c.parents) for c in conditionals})
        assert {b: frozenset(s) for b, s in scopes.items()} == above(conditionals)
        assert all(len(set(s)) == len(s) for s in scopes.values())
        order = list(scopes)
        of = {c.block: c for c in conditionals}
        assert all(order.index(p) < order.index(b) for b in order for p in of[b].parents)


def test_scopes_of_a_long_chain() -> None:
    """No recursion, and no cost that is quadratic in anything but the answer."""
    length = 5000
    blocks = {k: ((), (k - 1,) if k else ()) for k in reversed(range(length))}
    assert len(mixture_scopes(blocks)) == length


def test_a_long_chain_keeps_little_alive() -> None:
    """The joint covariance of a chain never holds more than two blocks: moments cost one pass."""
    length = 400
    step = Conditional(0, (), (), np.zeros(1), np.zeros((1, 0)), np.ones((1, 1)))
    chain = [step]
    for k in range(1, length):
        chain.append(
            Conditional(k, (), (k - 1,), np.ones(1), np.full((1, 1), 0.5), np.ones((1, 1)))
        )
    found = Moments(chain, dict.fromkeys(range(length), 1), {}, lambda scope: np.ones(()))
    mean, cov = found.moments(length - 1)
    assert mean[0] == pytest.approx(2.0)
    assert cov[0, 0] == pytest.approx(4 / 3)
    first, _ = found.moments(0)
    assert first[0] == 0.0


def test_no_discrete_variables_and_no_blocks() -> None:
    given = Conditional("x", (), (), np.array([1.0, 2.0]), np.zeros((2, 0)), np.eye(2))
    found = Moments([given], {"x": 2}, {}, lambda scope: np.ones(()))
    parts = found.components(["x"])
    assert parts.weights.tolist() == [1.0]
    assert parts.mean.tolist() == [[1.0, 2.0]]
    empty = found.components([])
    assert empty.mean.shape == (1, 0)
    assert empty.cov.shape == (1, 0, 0)


def test_one_configuration_is_not_one_row_for_all() -> None:
    """A block without a scope beside a switched one has its mean in every component."""
    rng = np.random.default_rng(0)
    plain = Conditional("x", (), (), np.array([3.0]), np.zeros((1, 0)), np.ones((1, 1)))
    switch = Conditional(
        "y", ("t",), (), np.arange(3.0)[:, None], np.zeros((3, 1, 0)), np.ones((3, 1, 1))
    )
    table = some_table(rng, zeros=False)
    found = Moments([plain, switch], {"x": 1, "y": 1}, CARDS, joint_of(table))
    parts = found.components(["x", "y"])
    np.testing.assert_array_equal(parts.mean, [[3.0, 0.0], [3.0, 1.0], [3.0, 2.0]])
    only = found.components(["x"], ["t"])
    assert only.mean.shape == (3, 1)
    assert only.cov.shape == (3, 1, 1)


def test_large_means_do_not_spoil_variances() -> None:
    """Chunks are merged by differences of means, not by sums of squares."""
    shift = 1e9
    given = Conditional(
        "x", ("t",), (), shift + np.arange(3.0)[:, None], np.zeros((3, 1, 0)), np.ones((3, 1, 1))
    )
    table = np.full(tuple(CARDS.values()), 1 / 12)
    for chunk in (1, 2, 100):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "_CHUNK", chunk)
            mean, cov = Moments([given], {"x": 1}, CARDS, joint_of(table)).moments("x")
        assert mean[0] - shift == pytest.approx(1.0, abs=1e-6)
        assert cov[0, 0] == pytest.approx(1 + 2 / 3, rel=1e-6)


# ---- draws ----------------------------------------------------------------------------------------


def test_draws_follow_the_blocks() -> None:
    """Whitened draws are standard normal in every configuration.

    Kolmogorov-Smirnov tests at 1e-4, about 150 of them at fixed seeds: fresh ones would raise a false
    alarm in 1.5 % of runs.
    """
    for seed in range(4):
        conditionals, dims, found, codes = drawn(seed)
        values = found.sample(np.random.default_rng(seed), codes, 2000)
        assert {b: v.shape for b, v in values.items()} == {b: (2000, d) for b, d in dims.items()}
        assert smallest_p(conditionals, dims, codes, values) > 1e-4


def test_draws_with_other_codes_are_noticed() -> None:
    """Negative control: codes that do not belong to the draws."""
    noticed = 0
    for seed in range(4):
        conditionals, dims, found, codes = drawn(seed)
        values = found.sample(np.random.default_rng(seed), codes, 2000)
        other = {v: c[::-1] for v, c in codes.items()}
        noticed += smallest_p(conditionals, dims, other, values) < 1e-4
    assert noticed == 4


def drawn(seed: int) -> tuple[Any, Any, Moments, dict[str, np.ndarray]]:
    rng = np.random.default_rng([3, seed])
    conditionals, dims = network(rng, 6, switched=0.6)
    conditionals = [
        Conditional(
            c.block, c.scope, c.parents, c.offset, c.gain, c.root + 0.5 * np.eye(dims[c.block])
        )
        for c in conditionals
    ]
    codes = {v: rng.integers(0, n, 2000).astype(np.uint8) for v, n in CARDS.items()}
    return conditionals, dims, Moments(conditionals, dims, CARDS, joint_of(some_table(rng))), codes


def smallest_p(conditionals: Any, dims: Any, codes: Any, values: Any) -> float:
    """Smallest p-value over all components, whitened by the dense Gaussian of each configuration."""
    joined = np.concatenate([values[b] for b in dims], axis=1)
    white = np.empty_like(joined)
    for index in itertools.product(*(range(n) for n in CARDS.values())):
        states = dict(zip(CARDS, index, strict=True))
        rows = np.logical_and.reduce([codes[v] == k for v, k in states.items()])
        mean, cov = dense(conditionals, dims, states)
        size = np.sqrt(np.diagonal(cov))
        lower = np.linalg.cholesky(cov / np.outer(size, size)) * size[:, None]
        white[rows] = np.linalg.solve(lower, (joined[rows] - mean).T).T
    return min(scipy.stats.kstest(column, "norm").pvalue for column in white.T)


def test_draws_without_discrete_variables() -> None:
    given = Conditional("x", (), (), np.array([5.0]), np.zeros((1, 0)), np.array([[2.0]]))
    child = Conditional("y", (), ("x",), np.zeros(1), np.ones((1, 1)), np.zeros((1, 1)))
    found = Moments([child, given], {"x": 1, "y": 1}, {}, lambda scope: np.ones(()))
    for draws in (0, 1, 7):
        values = found.sample(np.random.default_rng(0), {}, draws)
        assert values["x"].shape == (draws, 1)
        np.testing.assert_array_equal(values["x"], values["y"])
    values = found.sample(np.random.default_rng(0), {}, 1000)
    assert values["x"].std() == pytest.approx(2.0, rel=0.2)
