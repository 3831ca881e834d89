"""Gaussian linear algebra: distances and linear maps, ill-conditioned covariances included."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import bayesmc.distributions as d
from bayesmc import gaussian
from bayesmc.errors import ParameterError, ShapeError
from tests.distributions.families import FEW


def exact_distance(cov: np.ndarray, x: np.ndarray) -> float:
    """``x' cov^-1 x`` in rational arithmetic, by Gaussian elimination without rounding."""
    n = len(x)
    rows = [[Fraction(v) for v in row] + [Fraction(w)] for row, w in zip(cov, x, strict=True)]
    for i in range(n):
        for j in range(i + 1, n):
            ratio = rows[j][i] / rows[i][i]
            rows[j] = [a - ratio * b for a, b in zip(rows[j], rows[i], strict=True)]
    solution = [Fraction(0)] * n
    for i in reversed(range(n)):
        known = sum((rows[i][j] * solution[j] for j in range(i + 1, n)), Fraction(0))
        solution[i] = (rows[i][n] - known) / rows[i][i]
    return float(sum(Fraction(w) * s for w, s in zip(x, solution, strict=True)))


@FEW
@given(st.integers(1, 6), st.integers(0, 2**32 - 1), st.floats(0, 9))
def test_distance_is_exact_under_bad_scaling(size: int, seed: int, decades: float) -> None:
    # components in units up to 10^18 apart: condition numbers to 10^36, no digits may be lost
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size)) + 2 * np.eye(size)
    cov = root @ root.T
    units = 2.0 ** np.round(rng.uniform(-decades, decades, size) * np.log2(10))
    cov = (cov + cov.T) / 2 * units[:, None] * units
    x = units * rng.normal(size=size)
    condition = np.linalg.cond(cov / np.sqrt(np.outer(np.diagonal(cov), np.diagonal(cov))))
    expected = exact_distance(cov, x)
    found = gaussian.squared_mahalanobis(x, np.zeros(size), cov)
    assert abs(found - expected) <= 1e-14 * condition * size**2 * expected
    np.testing.assert_array_equal(d.MvNormal(np.zeros(size), cov).squared_mahalanobis(x), found)


@pytest.mark.parametrize("size", [3, 5, 8])
def test_distance_under_the_hilbert_matrix(size: int) -> None:
    # condition 5e2, 5e5, 1.5e10: relative error eps * condition, as backward stability promises
    cov = 1.0 / (np.arange(size)[:, None] + np.arange(size) + 1)
    x = np.arange(1.0, size + 1)
    error = gaussian.squared_mahalanobis(x, np.zeros(size), cov) / exact_distance(cov, x) - 1
    assert abs(error) <= 20 * np.finfo(float).eps * np.linalg.cond(cov)


@FEW
@given(
    st.integers(1, 4),
    st.sampled_from([((), ()), ((3,), ()), ((), (3,)), ((2, 1), (3,)), ((3,), (3,))]),
    st.integers(0, 999),
)
def test_batches_equal_single_calls(size: int, batches: tuple, seed: int) -> None:
    rng = np.random.default_rng(seed)
    of_x, of_cov = batches
    root = rng.normal(size=(*of_cov, size, size)) + 3 * np.eye(size)
    cov = root @ np.matrix_transpose(root)
    cov = (cov + np.matrix_transpose(cov)) / 2
    x, mean = rng.normal(size=(*of_x, size)), rng.normal(size=size)
    found = gaussian.squared_mahalanobis(x, mean, cov)
    factor = gaussian.cholesky(cov)
    np.testing.assert_allclose(
        gaussian.squared_mahalanobis(x, mean, scale_tril=factor), found, rtol=1e-12
    )
    shape = np.broadcast_shapes(of_x, of_cov)
    assert found.shape == shape
    xs = np.broadcast_to(x, (*shape, size)).reshape(-1, size)
    covs = np.broadcast_to(cov, (*shape, size, size)).reshape(-1, size, size)
    for value, point, matrix in zip(found.reshape(-1), xs, covs, strict=True):
        r = point - mean
        np.testing.assert_allclose(value, r @ np.linalg.solve(matrix, r), rtol=1e-9)


def test_linear_map_is_the_textbook_formula() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 3, 3))
    cov, mean, matrix = (
        root @ np.matrix_transpose(root),
        rng.normal(size=3),
        rng.normal(size=(2, 3)),
    )
    noise, offset = np.diag([0.1, 0.2]), np.array([1.0, -1.0])
    mapped_mean, mapped_cov = gaussian.linear_map(mean, cov, matrix, offset, noise)
    np.testing.assert_allclose(mapped_mean, matrix @ mean + offset, rtol=1e-14)
    for k in range(5):
        np.testing.assert_allclose(mapped_cov[k], matrix @ cov[k] @ matrix.T + noise, rtol=1e-12)
    np.testing.assert_array_equal(mapped_cov, np.matrix_transpose(mapped_cov))


@pytest.mark.parametrize("form", ["cov", "scale_tril", "scale_diag"])
def test_the_linear_map_of_a_distribution_has_the_mapped_moments(form: str) -> None:
    rng = np.random.default_rng(1)
    root = np.tril(rng.normal(size=(4, 3, 3))) + 3 * np.eye(3)
    scales = {
        "cov": root @ np.matrix_transpose(root),
        "scale_tril": root,
        "scale_diag": np.linalg.diagonal(root),
    }
    dist = d.MvNormal(rng.normal(size=3), **{form: scales[form]})
    matrix, offset = rng.normal(size=(2, 3)), np.array([1.0, 2.0])
    mapped = dist.linear_map(matrix, offset)
    mean, cov = gaussian.linear_map(dist.loc, dist.cov, matrix, offset)
    assert mapped.batch_shape == (4,)
    np.testing.assert_allclose(mapped.mean, np.broadcast_to(mean, (4, 2)), rtol=1e-13)
    np.testing.assert_allclose(mapped.cov, cov, rtol=1e-12)


def test_a_map_of_an_ill_conditioned_gaussian_keeps_its_small_direction() -> None:
    # the difference of two components of standard deviation 1 that differ by 1e-9: through the
    # covariance, 1 - (1 - 1e-18) would be nothing
    dist = d.MvNormal([0.0, 0.0], scale_tril=[[1.0, 0.0], [1.0, 1e-9]])
    mapped = dist.linear_map([[1.0, -1.0]])
    np.testing.assert_allclose(mapped.scale_tril, [[1e-9]], rtol=1e-6)


@pytest.mark.parametrize("matrix", [[[1.0, 1.0], [2.0, 2.0]], [[0.0, 0.0]], np.ones((3, 2))])
def test_a_singular_map_is_refused(matrix: list) -> None:
    with pytest.raises(ParameterError):
        d.MvNormal([0.0, 0.0], [[2.0, 0.3], [0.3, 1.0]]).linear_map(matrix)


def test_the_first_matrix_that_is_not_positive_definite_is_named() -> None:
    covs = np.broadcast_to(np.eye(3), (2, 4, 3, 3)).copy()
    covs[1, 2, 0, 0] = -1.0
    covs[1, 3, 2, 2] = 0.0
    with pytest.raises(ParameterError, match=r"index \(1, 2\)") as caught:
        gaussian.cholesky(covs)
    assert caught.value.index == (1, 2)
    factor, bad = gaussian.try_cholesky(covs)
    assert np.argwhere(bad).tolist() == [[1, 2], [1, 3]]
    np.testing.assert_array_equal(factor, np.broadcast_to(np.eye(3), covs.shape))


@FEW
@given(st.integers(1, 5), st.integers(0, 999))
def test_the_recording_cholesky_agrees_with_lapack(size: int, seed: int) -> None:
    # a batch with one indefinite matrix takes the slower way, which must factor the rest alike
    root = np.random.default_rng(seed).normal(size=(6, size, size))
    cov = root @ np.matrix_transpose(root) + 0.1 * np.eye(size)
    cov = (cov + np.matrix_transpose(cov)) / 2
    cov[3] = -np.eye(size)
    factor, bad = gaussian.try_cholesky(cov)
    assert bad.tolist() == [k == 3 for k in range(6)]
    np.testing.assert_allclose(factor[~bad], np.linalg.cholesky(cov[~bad]), rtol=1e-9, atol=1e-12)


def test_rounding_asymmetry_is_allowed_and_more_is_not() -> None:
    cov = np.array([[1e16, 5e3], [5e3, 1.0]])
    cov[0, 1] += 1e-12 * 1e8  # relative to sqrt(a_ii a_jj)
    gaussian.cholesky(cov)
    cov[0, 1] += 1e-6 * 1e8
    with pytest.raises(ParameterError, match="symmetric"):
        gaussian.cholesky(cov)


@pytest.mark.parametrize(
    "call",
    [
        lambda: gaussian.cholesky(np.ones((2, 3))),
        lambda: gaussian.squared_mahalanobis(np.ones(3), np.zeros(3), np.eye(2)),
        lambda: d.MvNormal(np.zeros(2), np.eye(2)).log_prob(np.zeros(3)),
        lambda: d.MvNormal(np.zeros(2), np.eye(2)).linear_map(np.ones(2)),
        lambda: d.MvNormal(np.zeros(2), np.eye(2)).linear_map(np.ones((1, 3))),
    ],
)
def test_shapes_that_do_not_fit_are_refused(call: object) -> None:
    with pytest.raises(ShapeError):
        call()  # type: ignore[operator]


def test_distance_takes_exactly_one_scale() -> None:
    with pytest.raises(ParameterError, match="exactly one"):
        gaussian.squared_mahalanobis([0.0], [0.0])
