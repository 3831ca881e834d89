"""Switched Gaussian factors: densities, products and integrals against quadrature and exact fractions."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import scipy.special
import scipy.stats

from bayesmc.factors.gaussian import (
    Conditional,
    GaussianFactor,
    along,
    compressed,
    eliminate,
    likelihood_rows,
    union_of,
)

CARDS = {"s": 2, "t": 3, "u": 1}


def random_factor(
    rng: np.random.Generator,
    scope: Sequence[str],
    blocks: Sequence[str],
    dims: Mapping[str, int],
    count: int,
) -> GaussianFactor:
    lead = tuple(CARDS[v] for v in scope)
    columns = sum(dims[b] for b in blocks)
    rows = rng.normal(size=(*lead, count, columns + 1))
    return GaussianFactor(tuple(scope), tuple(blocks), rows, rng.normal(size=lead))


def log_value(
    factor: GaussianFactor, states: Mapping[str, int], values: Mapping[str, np.ndarray]
) -> np.ndarray:
    """The factor's logarithm at values ``(..., d)`` of its blocks, written out."""
    at = tuple(states[v] for v in factor.scope)
    x = [np.atleast_1d(values[b]) for b in factor.blocks]
    lead = np.broadcast_shapes(*(v.shape[:-1] for v in x))
    parts = [np.broadcast_to(v, (*lead, v.shape[-1])) for v in x]
    joined = np.concatenate([*parts, -np.ones((*lead, 1))], axis=-1)
    residual = joined @ factor.rows[at].T
    return factor.log_scale[at] - 0.5 * (residual**2).sum(axis=-1)


def total(
    factors: Sequence[GaussianFactor], states: Mapping[str, int], values: Mapping[str, np.ndarray]
) -> np.ndarray:
    return np.sum([log_value(f, states, values) for f in factors], axis=0)


def configurations(scope: Sequence[str]) -> Iterator[dict[str, int]]:
    for states in itertools.product(*(range(CARDS[v]) for v in scope)):
        yield dict(zip(scope, states, strict=True))


def quadrature(
    factors: Sequence[GaussianFactor],
    block: str,
    d: int,
    states: Mapping[str, int],
    values: Mapping[str, np.ndarray],
) -> float:
    """Log of the integral over a block by the trapezoidal rule, about the block's mode.

    Of a Gaussian the rule is exact to rounding at four points per standard deviation; the grid follows
    the Gaussian's own axes, found by finite differences, so that nothing of the code is used.
    """
    f = lambda x: total(factors, states, {**values, block: x})  # noqa: E731
    zero, unit = np.zeros(d), np.eye(d)
    gradient = np.array([(f(u) - f(-u)) / 2 for u in unit])
    hessian = np.array([[f(u + v) - f(u) - f(v) + f(zero) for u in unit] for v in unit])
    mode = np.linalg.solve(hessian, -gradient)
    axes = np.linalg.cholesky(np.linalg.inv(-hessian))
    steps = np.linspace(-9.0, 9.0, 73)
    grid = np.stack(np.meshgrid(*[steps] * d, indexing="ij"), axis=-1).reshape(-1, d)
    cell = (steps[1] - steps[0]) ** d * abs(np.linalg.det(axes))
    return float(scipy.special.logsumexp(f(mode + grid @ axes.T)) + np.log(cell))


LAYOUTS: dict[str, list[tuple[tuple[str, ...], tuple[str, ...], int]]] = {
    "alone": [((), ("x",), 3)],
    "alone, as many rows as components": [((), ("x",), 2)],
    "switched": [(("s",), ("x",), 3)],
    "one parent": [((), ("x", "a"), 2), ((), ("x",), 1)],
    "first and last": [(("s",), ("a", "x"), 2), (("t",), ("x", "b"), 2)],
    "scopes in both orders": [(("s", "t"), ("x", "a"), 2), (("t", "s"), ("a", "x"), 3)],
    "more rows than columns": [(("t",), ("a", "x", "b"), 9), ((), ("x",), 2)],
    "a scope of one state": [(("u", "s"), ("x", "a"), 2), (("u",), ("x",), 1)],
    "three factors": [(("s",), ("x", "a"), 1), (("t",), ("b", "x"), 2), (("s",), ("x",), 2)],
}


@pytest.mark.parametrize("d", [1, 2])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_block_is_integrated_out(layout: str, d: int) -> None:
    """Integral and conditional of a random product, at random values of the blocks that are left."""
    dims = {"x": d, "a": 2, "b": 1}
    for seed in range(3):
        rng = np.random.default_rng([seed, d, list(LAYOUTS).index(layout)])
        factors = [random_factor(rng, *part[:2], dims, part[2]) for part in LAYOUTS[layout]]
        given, left = eliminate(factors, "x", dims, CARDS)
        scope, blocks = union_of(factors, "x")
        assert (left.scope, left.blocks) == (scope, blocks[1:])
        assert (given.block, given.scope, given.parents) == ("x", scope, blocks[1:])
        assert left.rows.shape[-2] < left.rows.shape[-1]
        for states in configurations(scope):
            values = {b: rng.normal(size=dims[b]) for b in blocks[1:]}
            wanted = quadrature(factors, "x", d, states, values)
            found = (
                log_value(left, states, values) if blocks[1:] else left.log_scale[*states.values()]
            )
            assert found == pytest.approx(wanted, rel=1e-8, abs=1e-8)
            check_conditional(given, factors, states, values)


def check_conditional(
    given: Conditional,
    factors: Sequence[GaussianFactor],
    states: Mapping[str, int],
    values: Mapping[str, np.ndarray],
) -> None:
    """As a function of the block, the product is the conditional's density times a constant."""
    at = tuple(states[v] for v in given.scope)
    above = np.concatenate([np.zeros(0), *(values[b] for b in given.parents)])
    mean = given.offset[at] + given.gain[at] @ above
    density = scipy.stats.multivariate_normal(mean, given.root[at] @ given.root[at].T)
    points = mean + np.random.default_rng(0).normal(size=(5, len(mean))) @ given.root[at].T
    ratio = total(factors, states, {**values, given.block: points}) - density.logpdf(points)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-8, atol=1e-8)


def test_a_row_off_by_a_hundredth_is_noticed() -> None:
    """Negative control of the quadrature."""
    rng = np.random.default_rng(0)
    dims = {"x": 1, "a": 2}
    factors = [random_factor(rng, ("s",), ("x", "a"), dims, 3)]
    values = {"a": rng.normal(size=2)}
    _, left = eliminate(factors, "x", dims, CARDS)
    wanted = quadrature(factors, "x", 1, {"s": 1}, values)
    assert log_value(left, {"s": 1}, values) == pytest.approx(wanted, abs=1e-8)
    rows = left.rows.copy()
    rows[..., 0, :] *= 1.01
    spoilt = GaussianFactor(left.scope, left.blocks, rows, left.log_scale)
    assert log_value(spoilt, {"s": 1}, values) != pytest.approx(wanted, abs=1e-6)


def test_arguments_are_left_alone() -> None:
    rng = np.random.default_rng(1)
    dims = {"x": 2, "a": 1}
    factors = [random_factor(rng, ("s",), ("x", "a"), dims, 4)]
    before = factors[0].rows.copy(), factors[0].log_scale.copy()
    eliminate(factors, "x", dims, CARDS)
    np.testing.assert_array_equal(factors[0].rows, before[0])
    np.testing.assert_array_equal(factors[0].log_scale, before[1])


# ---- rows -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1, 3])
def test_likelihood_rows_are_a_normal_density(d: int) -> None:
    rng = np.random.default_rng(d)
    matrix = rng.normal(size=(4, d, 2))
    residual = rng.normal(size=(4, d))
    tril = np.tril(rng.normal(size=(d, d))) * (1 - np.eye(d)) + np.diag(rng.uniform(0.1, 2, d))
    rows, log_scale = likelihood_rows(matrix, residual, tril)
    assert rows.shape == (4, d, 3)
    assert log_scale.shape == (4,)
    x = rng.normal(size=2)
    for k in range(4):
        exact = scipy.stats.multivariate_normal.logpdf(
            residual[k] - matrix[k] @ x, np.zeros(d), tril @ tril.T
        )
        found = log_scale[k] - 0.5 * ((rows[k] @ [*x, -1.0]) ** 2).sum()
        assert found == pytest.approx(exact, rel=1e-10)


def test_rows_are_compressed_without_loss() -> None:
    rng = np.random.default_rng(5)
    for count in range(1, 9):
        for rank in (1, 2, 3):
            shape = (2, count, rank)
            rows = rng.normal(size=shape) @ rng.normal(size=(2, rank, 4))  # of deficient rank, too
            log_scale = rng.normal(size=2)
            short, scale = compressed(rows, log_scale)
            assert short.shape[-2] <= max(min(count, 3), 0)
            for x in rng.normal(size=(4, 3)):
                at = [*x, -1.0]
                before = log_scale - 0.5 * ((rows @ at) ** 2).sum(axis=-1)
                after = scale - 0.5 * ((short @ at) ** 2).sum(axis=-1)
                np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-9)


def test_axes_follow_the_wanted_scope() -> None:
    rng = np.random.default_rng(2)
    array = rng.normal(size=(2, 3, 7))
    moved = along(array, ("s", "t"), ("t", "v", "s"))
    assert moved.shape == (3, 1, 2, 7)
    np.testing.assert_array_equal(moved[:, 0].swapaxes(0, 1), array)
    np.testing.assert_array_equal(along(array, ("s", "t"), ("s", "t")), array)
    assert along(np.ones(4), (), ("s",)).shape == (1, 4)


# ---- stiff scales ---------------------------------------------------------------------------------


def exact_means(rows: np.ndarray) -> list[Fraction]:
    """The least squares solution of ``A x = z``, in fractions."""
    exact = [[Fraction(float(v)) for v in row] for row in rows]
    n = len(exact[0]) - 1
    system = [
        [sum((row[i] * row[j] for row in exact), Fraction(0)) for j in range(n + 1)]
        for i in range(n)
    ]
    for i in range(n):
        pivot = next(k for k in range(i, n) if system[k][i])
        system[i], system[pivot] = system[pivot], system[i]
        system[i] = [v / system[i][i] for v in system[i]]
        for k in range(n):
            if k != i and system[k][i]:
                factor = system[k][i]
                system[k] = [a - factor * b for a, b in zip(system[k], system[i], strict=True)]
    return [row[n] for row in system]


def chain(rng: np.random.Generator, steps: int, low: float, high: float) -> list[GaussianFactor]:
    """A walk that is seen at every step, all noises between ``10**low`` and ``10**high``."""
    factors = []
    for k in range(steps):
        noise, error = 10.0 ** rng.uniform(low, high, size=2)
        gain = rng.uniform(0.5, 1.5)
        matrix = np.array([[1.0]]) if k == 0 else np.array([[1.0, -gain]])
        blocks: tuple[Any, ...] = (k,) if k == 0 else (k, k - 1)
        rows, scale = likelihood_rows(matrix, np.array([0.3]), np.array([[noise]]))
        factors.append(GaussianFactor((), blocks, rows, scale))
        seen, scale = likelihood_rows(
            np.array([[1.0]]), rng.normal(size=1) + k, np.array([[error]])
        )
        factors.append(GaussianFactor((), (k,), seen, scale))
    return factors


def means_by_elimination(
    factors: Sequence[GaussianFactor], order: Sequence[Any]
) -> dict[Any, float]:
    dims = dict.fromkeys(order, 1)
    live = list(factors)
    conditionals = []
    for block in order:
        parts = [f for f in live if block in f.blocks]
        live = [f for f in live if block not in f.blocks]
        given, left = eliminate(parts, block, dims, {})
        conditionals.append(given)
        live.append(left)
    means: dict[Any, float] = {}
    for given in reversed(conditionals):
        above = np.array([means[p] for p in given.parents])
        means[given.block] = float(given.offset[0] + given.gain[0] @ above)
    return means


def all_rows(factors: Sequence[GaussianFactor], blocks: Sequence[Any]) -> np.ndarray:
    """One dense system of scalar blocks."""
    parts = []
    for factor in factors:
        dense = np.zeros((factor.rows.shape[-2], len(blocks) + 1))
        dense[:, [*(blocks.index(b) for b in factor.blocks), -1]] = factor.rows
        parts.append(dense)
    return np.concatenate(parts)


def is_well_posed(rows: np.ndarray) -> bool:
    """Whether a relative change of 1e-13 in the entries moves the solution by less than 1e-8."""
    rng = np.random.default_rng(0)
    base = np.array(list(map(float, exact_means(rows))))
    for _ in range(3):
        moved = rows * (1 + 1e-13 * rng.choice([-1, 1], size=rows.shape))
        found = np.array(list(map(float, exact_means(moved))))
        if np.abs(found - base).max() > 1e-8 * max(1.0, np.abs(base).max()):
            return False
    return True


@pytest.mark.parametrize(("low", "high"), [(-2, 2), (-4, 4), (-8, 0), (0, 8), (-8, 8)])
def test_stiff_chains_keep_six_digits(low: float, high: float) -> None:
    """Noises sixteen decades apart in one product, in both orders and from the middle."""
    checked = 0
    for seed in range(25):
        rng = np.random.default_rng([seed, int(low) + 10, int(high)])
        steps = 5
        factors = chain(rng, steps, low, high)
        rows = all_rows(factors, range(steps))
        if not is_well_posed(rows):
            continue
        checked += 1
        exact = np.array(list(map(float, exact_means(rows))))
        for order in ((0, 1, 2, 3, 4), (4, 3, 2, 1, 0), (2, 0, 4, 1, 3)):
            means = means_by_elimination(factors, order)
            found = np.array([means[k] for k in range(steps)])
            np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-6)
    assert checked > 10


def test_log_scales_of_extreme_noise() -> None:
    """The density of what is seen, in closed form, where squares of scales would under- or overflow."""
    for prior, error in itertools.product((1e-160, 1e-8, 1.0, 1e8, 1e160), repeat=2):
        a, a_scale = likelihood_rows(np.eye(1), np.zeros(1), np.array([[prior]]))
        b, b_scale = likelihood_rows(np.eye(1), np.array([error]), np.array([[error]]))
        factors = [GaussianFactor((), ("x",), a, a_scale), GaussianFactor((), ("x",), b, b_scale)]
        given, left = eliminate(factors, "x", {"x": 1}, {})
        sd = np.hypot(prior, error)
        exact = -0.5 * np.log(2 * np.pi) - np.log(sd) - 0.5 * (error / sd) ** 2
        assert float(left.log_scale) == pytest.approx(exact, rel=1e-10)
        spread = min(prior, error) * (max(prior, error) / sd)
        mean = spread * (prior / sd)
        assert abs(float(given.root[0, 0])) == pytest.approx(spread, rel=1e-9)
        assert float(given.offset[0]) == pytest.approx(mean, rel=1e-9, abs=1e-9 * spread)


@pytest.mark.parametrize("squeeze", [False, True], ids=["as they are", "compressed first"])
@pytest.mark.parametrize("width", [2, 4, 8])
def test_stiff_rows_survive_compression(width: int, squeeze: bool) -> None:
    """Dense rows of scales far apart in any order, as many observations of one block give them."""
    dims = {"a": 2, "b": 2}
    checked = 0
    for seed in range(60):
        rng = np.random.default_rng([seed, width])
        count = int(rng.integers(5, 9))
        rows = rng.normal(size=(count, 5)) * 10.0 ** rng.uniform(-width, width, size=(count, 1))
        if not is_well_posed(rows):
            continue
        checked += 1
        exact = np.array(list(map(float, exact_means(rows))))
        short = compressed(rows, np.zeros(()))[0] if squeeze else rows
        factor = GaussianFactor((), ("a", "b"), short, np.zeros(()))
        first, left = eliminate([factor], "a", dims, {})
        last, _ = eliminate([left], "b", dims, {})
        found = np.concatenate([first.offset + first.gain @ last.offset, last.offset])
        np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-6 * np.abs(exact).max())
    assert checked > 30
