"""Moments of factors with Gaussian cavities: closed forms, and quadrature against them and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from bayesmc.factors.families import GammaFamily, Shares
from bayesmc.factors.quadrature import along_line, importance, on_lattice
from bayesmc.factors.tilted import gaussians, log_integral, mixed, probit, probit_messages

ONE = np.ones(1)


@pytest.mark.parametrize(
    "low, high", [(0.5, np.inf), (-1.0, 2.0), (6.0, 6.5), (9.0, np.inf), (-0.01, 0.01)]
)
def test_truncations_are_those_of_scipy(low: float, high: float) -> None:
    """Also far out, where the window has to find them."""
    inside = lambda u: np.where((u[..., 0] > low) & (u[..., 0] < high), 0.0, -np.inf)  # noqa: E731
    ends = np.array([[e for e in (low, high) if np.isfinite(e)]])
    found = along_line(inside, ONE, 0 * ONE, (0 * ONE, ONE), ends)
    right = stats.truncnorm(low, high)
    assert found.mean[0, 0] == pytest.approx(right.mean(), abs=1e-8)
    assert found.cov[0, 0, 0] == pytest.approx(right.var(), rel=1e-5)
    mass = (
        special.log_ndtr(-low)
        if high == np.inf
        else np.log(stats.norm.sf(low) - stats.norm.sf(high))
    )
    assert found.log[0] - 0.5 * np.log(2 * np.pi) == pytest.approx(mass, abs=1e-7)
    assert found.error < 1e-3


def test_messages_of_probits_are_what_their_moments_leave() -> None:
    rng = np.random.default_rng(0)
    sign, gain = rng.choice([-1.0, 1.0], 2_000), rng.choice([1.0, 0.0, -0.5], 2_000)
    offset, precision = 2.0 * rng.normal(size=2_000), np.exp(3.0 * rng.normal(size=2_000))
    linear = 3.0 * rng.normal(size=2_000) * np.sqrt(precision)
    whole = probit(sign, offset, gain, precision, linear)
    own, along = probit_messages(sign * offset, sign * gain, precision, linear)
    var, mean = whole.cov[:, 0, 0], whole.mean[:, 0]
    assert np.abs(var * (precision + own) - 1.0).max() < 1e-8
    assert (np.abs(var * (linear + along) - mean) / np.sqrt(var)).max() < 1e-8
    assert (own[gain == 0.0] == 0.0).all()


def test_probit_by_quadrature_is_the_closed_form() -> None:
    rng = np.random.default_rng(0)
    n = 40
    sign, offset, gain = rng.choice([-1.0, 1.0], n), rng.normal(0, 3, n), rng.normal(0, 2, n)
    precision, linear = rng.gamma(1.0, 1.0, n) + 0.05, rng.normal(0, 2, n)
    closed = probit(sign, offset, gain, precision, linear)
    near = linear / precision, 1 / np.sqrt(precision)
    found = along_line(
        lambda u: special.log_ndtr(sign * (offset + gain * u[..., 0])), precision, linear, near
    )
    off = np.abs(found.log - closed.log)
    assert off.max() <= found.error + 1e-9  # of the steepest; the others are much nearer
    assert np.sort(off)[-3] < 1e-6 and off.max() < 1e-4
    assert found.mean == pytest.approx(closed.mean, abs=1e-4)
    assert found.cov == pytest.approx(closed.cov, rel=1e-3)


def test_what_has_no_integral_is_told() -> None:
    flat = along_line(lambda u: 0.0 * u[..., 0], -0.1 * ONE, 0 * ONE, (0 * ONE, ONE))
    assert np.isnan(flat.log[0])
    mixture = along_line(  # half of it does not depend on u
        lambda u: np.logaddexp(-0.5 * u[..., 0] ** 2, 0.0), -0.01 * ONE, 0 * ONE, (0 * ONE, ONE)
    )
    assert np.isnan(mixture.log[0])
    assert np.isnan(log_integral(np.diag([1.0, -1.0]), np.zeros(2)))
    rows = np.array([[[1.0, 0.0, 0.5]]])  # says nothing of the second number
    assert np.isnan(gaussians(rows, np.zeros(1), np.diag([1.0, -1.0]), np.zeros(2)).log[0])


@pytest.mark.parametrize("k", [2, 3, 5])
def test_several_numbers_by_quadrature_are_the_closed_form(k: int) -> None:
    rng = np.random.default_rng(k)
    matrix, value = rng.normal(size=(k, k)), rng.normal(size=k)
    rows = np.concatenate([matrix, value[:, None]], axis=-1)[None]
    precision, linear = np.eye(k) + 0.3, rng.normal(size=k)
    closed = gaussians(rows, np.zeros(1), precision, linear)
    near = np.linalg.solve(precision, linear), np.linalg.inv(precision)

    def factor(u: np.ndarray) -> np.ndarray:
        return -0.5 * ((u @ matrix.T - value) ** 2).sum(axis=-1)

    found = (on_lattice if k <= 3 else importance)(factor, precision, linear, near)
    tolerance = 1e-6 if k <= 3 else 0.1
    assert found.log == pytest.approx(closed.log[0], abs=tolerance)
    assert found.mean == pytest.approx(closed.mean[0], abs=tolerance)
    assert found.cov == pytest.approx(closed.cov[0], abs=tolerance)


def test_mixtures_have_the_moments_of_their_draws() -> None:
    log = np.log([[0.2, 0.8]]) + 3.0
    mean, cov = np.array([[[0.0], [2.0]]]), np.array([[[[1.0]], [[0.25]]]])
    found = mixed(log, mean, cov)
    assert found.log[0] == pytest.approx(3.0)
    assert found.mean[0, 0] == pytest.approx(1.6)
    assert found.cov[0, 0, 0] == pytest.approx(0.2 * 1.0 + 0.8 * 0.25 + 0.2 * 0.8 * 4.0)


def test_expected_statistics_are_turned_back() -> None:
    rng = np.random.default_rng(1)
    naturals = np.stack([rng.uniform(-0.9, 300, 50), -rng.gamma(0.5, 20.0, 50) - 1e-3], axis=-1)
    gamma = GammaFamily()
    found = gamma.natural(gamma.expected(naturals), np.zeros((50, 2)))
    assert found == pytest.approx(naturals, rel=1e-6, abs=1e-8)
    shares = Shares(4)
    naturals = rng.gamma(0.7, 20.0, (50, 4)) - 0.95
    found = shares.natural(shares.expected(naturals), np.ones((50, 4)))
    assert found == pytest.approx(naturals, rel=1e-6, abs=1e-8)
    assert np.isnan(shares.log_total(np.array([-1.5, 0.0, 0.0, 0.0])))
