"""Rejection sampling: exact draws, an unbiased integral, violated envelopes read aloud."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc import errors
from bayesmc.montecarlo import RejectionSample, rejection_sample

ALARM = 1e-6
BUMPS = bmc.Density(lambda x: np.logaddexp(-((x - 2) ** 2), -((x + 2) ** 2)))
BUMPS_INTEGRAL = 2 * np.sqrt(np.pi)
WIDE = bmc.Normal(0.0, 3.0)


def bumps_cdf(x: np.ndarray) -> np.ndarray:
    return 0.5 * (stats.norm.cdf(x, 2, np.sqrt(0.5)) + stats.norm.cdf(x, -2, np.sqrt(0.5)))


def test_draws_are_exact() -> None:
    found = rejection_sample(BUMPS, WIDE, 11.0, draws=20_000, rng=0)
    assert found.draws.shape == (20_000,)
    assert stats.kstest(found.draws, bumps_cdf).pvalue > ALARM
    # negative control: what the proposal would give, and the target with its modes moved a little
    assert stats.kstest(WIDE.sample(0, 20_000), bumps_cdf).pvalue < ALARM
    assert stats.kstest(found.draws, lambda x: bumps_cdf(x - 0.1)).pvalue < ALARM


def test_acceptance_and_integral() -> None:
    found = rejection_sample(BUMPS, WIDE, 11.0, draws=20_000, rng=1)
    rate = BUMPS_INTEGRAL / 11.0
    # false alarm 1e-6 (4.9 standard errors)
    assert abs(found.acceptance_rate - rate) < 4.9 * np.sqrt(rate * (1 - rate) / found.proposed)
    assert abs(found.log_normalizer - np.log(BUMPS_INTEGRAL)) < 4.9 * found.standard_error
    assert found.acceptance_rate == 20_000 / found.proposed
    logged = rejection_sample(BUMPS, WIDE, log_envelope=np.log(11.0), draws=20_000, rng=1)
    np.testing.assert_array_equal(logged.draws, found.draws)


def test_the_integral_is_unbiased() -> None:
    # 2,000 runs of 20 draws: the mean of Z-hat / Z is 1 within 4 standard errors (false alarm
    # 6e-5); the plain ratio n / N is biased by about (1 - rate) / n and is told apart
    runs = [rejection_sample(BUMPS, WIDE, 11.0, draws=20, rng=seed) for seed in range(2000)]
    ratios = np.array([np.exp(run.log_normalizer) for run in runs]) / BUMPS_INTEGRAL
    error = ratios.std() / np.sqrt(len(ratios))
    assert abs(ratios.mean() - 1) < 4 * error
    plain = np.array([11.0 * run.acceptance_rate for run in runs]) / BUMPS_INTEGRAL
    assert abs(plain.mean() - 1) > 4 * error
    # the reported error is the spread of the log, to the order of 1 / n
    np.testing.assert_allclose(
        np.log(ratios).std(), np.mean([run.standard_error for run in runs]), rtol=0.1
    )


def test_a_function_vectors_and_a_tight_envelope() -> None:
    def log_disc(z: np.ndarray) -> np.ndarray:
        return np.where((z**2).sum(axis=-1) <= 1, 0.0, -np.inf)

    square = bmc.Joint(bmc.Uniform(-1.0, 1.0), bmc.Uniform(-1.0, 1.0))
    found = rejection_sample(log_disc, square, 4.0, draws=5000, rng=0)
    assert found.draws.shape == (5000, 2)
    assert ((found.draws**2).sum(axis=-1) <= 1).all()
    assert abs(np.exp(found.log_normalizer) / np.pi - 1) < 4.9 * found.standard_error
    everything = rejection_sample(stats.norm(), bmc.Normal(), 1.0, draws=100, rng=0)
    assert (everything.proposed, everything.acceptance_rate) == (100, 1.0)


def test_the_same_seed_gives_the_same_draws() -> None:
    a, b = (rejection_sample(BUMPS, WIDE, 11.0, draws=100, rng=5) for _ in range(2))
    np.testing.assert_array_equal(a.draws, b.draws)
    assert a.proposed == b.proposed
    other = rejection_sample(BUMPS, WIDE, 11.0, draws=100, rng=6)
    assert not np.array_equal(a.draws, other.draws)


def test_a_violated_envelope_names_the_point_and_the_cure() -> None:
    with pytest.raises(errors.EnvelopeError, match="k q\\(z\\) = .*k of at least") as caught:
        rejection_sample(BUMPS, WIDE, 5.0, draws=1000, rng=0)
    error = caught.value
    z = float(error.point)
    ratio = np.exp(BUMPS.log_prob(z) - WIDE.log_prob(z)) / 5.0
    np.testing.assert_allclose(error.ratio, ratio)
    assert ratio > 1 and f"{5.0 * ratio:.6g}" in str(error) and f"z = {z:.6g}"[:8] in str(error)


def test_a_proposal_with_lighter_tails_is_found_out() -> None:
    with pytest.raises(errors.EnvelopeError):
        rejection_sample(bmc.StudentT(3.0), bmc.Normal(), 2.0, draws=20_000, rng=0)


def test_a_proposal_that_cannot_reach_warns() -> None:
    with pytest.warns(errors.SupportWarning, match="rejection_sample: .* never reached"):
        rejection_sample(BUMPS, bmc.Uniform(-1.0, 1.0), 11.0, draws=10, rng=0)


def test_it_gives_up_with_the_acceptance_so_far() -> None:
    with pytest.raises(errors.UnsupportedError, match="of 1,000 draws accepted among 2,000 prop"):
        rejection_sample(BUMPS, WIDE, 1100.0, draws=1000, rng=0, max_proposals=2000)


def test_one_draw_has_no_integral() -> None:
    found = rejection_sample(BUMPS, WIDE, 11.0, draws=1, rng=0)
    assert np.isnan(found.log_normalizer) and len(found.draws) == 1
    assert isinstance(found, RejectionSample)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: rejection_sample(BUMPS, WIDE), errors.ParameterError, "exactly one of"),
        (lambda: rejection_sample(BUMPS, WIDE, 1.0, log_envelope=0.0), errors.ParameterError,
         "exactly one of"),
        (lambda: rejection_sample(BUMPS, WIDE, -1.0), errors.ParameterError, "positive and finite"),
        (lambda: rejection_sample(BUMPS, WIDE, 11.0, draws=0), errors.ParameterError, "at least 1"),
        (lambda: rejection_sample(BUMPS, WIDE, 11.0, draws=2.5), errors.ParameterError, "whole"),
        (lambda: rejection_sample(BUMPS, WIDE, "a"), errors.ParameterError, "envelope must be a number"),
        (lambda: rejection_sample(BUMPS, WIDE, log_envelope="a"), errors.ParameterError,
         "log_envelope must be a number"),
        (lambda: rejection_sample(BUMPS, WIDE, 11.0, max_proposals="a"), errors.ParameterError,
         "max_proposals must be a whole number"),
        (lambda: rejection_sample(BUMPS, bmc.Poisson(1.0), 11.0), errors.UnsupportedError,
         "rejection_sample: .* continuous and the proposal Poisson discrete"),
        (lambda: rejection_sample(BUMPS, BUMPS, 11.0), errors.UnsupportedError, "InverseCdf"),
        (lambda: rejection_sample(BUMPS, bmc.Normal([0, 1], 1), 11.0), errors.ShapeError, "batch"),
        (lambda: rejection_sample(3.0, WIDE, 11.0), errors.ParameterError, "density must be"),
        (lambda: rejection_sample(lambda z: z * np.nan, WIDE, 11.0), errors.DensityError, "is nan at"),
        (lambda: rejection_sample(lambda z: z[:, None], WIDE, 11.0), errors.ShapeError, "one log"),
    ],
)  # fmt: skip
def test_bad_input_is_read_aloud(call: Callable, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        call()
