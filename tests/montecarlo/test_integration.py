"""Integration: intervals that cover as often as they say, weights, boxes, and bad input."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc import errors
from bayesmc.montecarlo import Estimate, hit_or_miss, integrate

WIDE = bmc.StudentT(4.0, 0.0, 2.0)


def _quarter(p: np.ndarray) -> np.ndarray:
    return (p**2).sum(axis=-1) <= 1


WAYS: dict[str, tuple[Callable[[int], Estimate], float]] = {
    "plain": (lambda s: integrate(lambda x: x**2, bmc.Normal(), 500, s), 1.0),
    "weighted": (lambda s: integrate(lambda x: x**2, bmc.Normal(), 500, s, proposal=WIDE), 1.0),
    "normalised": (
        lambda s: integrate(
            lambda x: x**2, lambda x: -(x**2) / 2, 500, s, proposal=WIDE, normalised=True
        ),
        1.0,
    ),
    "a function's integral": (
        lambda s: integrate(lambda x: 1 + 0 * x, lambda x: -(x**4), 500, s, proposal=WIDE),
        1.812804954110954,
    ),
    "hit or miss": (lambda s: hit_or_miss(_quarter, [0, 0], [1, 1], 500, s), np.pi / 4),
    "under a lid": (lambda s: hit_or_miss(np.sin, 0.0, np.pi, 500, s, height=1.5), 2.0),
}


@pytest.mark.parametrize("name", WAYS)
def test_intervals_cover_as_often_as_they_say(name: str) -> None:
    # 800 intervals of level 0.9; skewness costs up to a percent. Beyond 5.5 standard errors
    # of the binomial: false alarm below 1e-6. Intervals half as wide (cover 0.59) are told apart.
    estimate, truth = WAYS[name]
    made = [estimate(seed) for seed in range(800)]
    band = 5.5 * np.sqrt(0.9 * 0.1 / 800) + 0.01

    def coverage(shrink: float) -> float:
        hits = [abs(e.value - truth) <= shrink * (e.value - e.interval(0.9)[0]) for e in made]
        return float(np.mean(hits))

    assert abs(coverage(1.0) - 0.9) < band
    assert abs(coverage(0.5) - 0.9) > band
    if name != "normalised":  # the others are unbiased: 4.9 standard errors
        values = np.array([float(e) for e in made])
        assert abs(values.mean() - truth) < 4.9 * values.std() / np.sqrt(len(values))


def test_vectors_of_values_and_of_points() -> None:
    cov = np.array([[2.0, 0.5], [0.5, 1.0]])
    found = integrate(lambda x: x[:, :, None] * x[:, None, :], bmc.MvNormal([0, 0], cov), 50_000, 0)
    assert found.value.shape == found.standard_error.shape == (2, 2)
    assert (np.abs(found.value - cov) < 5.5 * found.standard_error).all()
    scipy = integrate(lambda x: x, stats.norm(3.0, 0.1), 1000, 0)
    assert abs(float(scipy) - 3.0) < 5.5 * 0.1 / np.sqrt(1000)


def test_a_proposal_makes_a_rare_event_cheap() -> None:
    tail = integrate(
        # beyond the proposal's reach the function vanishes, so a bare function gives the density
        lambda x: x > 5,
        bmc.Normal().log_prob,
        10_000,
        0,
        proposal=bmc.Truncated(bmc.Normal(), 5.0),
    )
    np.testing.assert_allclose(tail.value, stats.norm.sf(5), rtol=1e-9)
    shifted = integrate(lambda x: x > 5, bmc.Normal(), 10_000, 0, proposal=bmc.Normal(5.0, 1.0))
    assert abs(shifted.value - stats.norm.sf(5)) < 5.5 * shifted.standard_error
    assert shifted.standard_error < 0.05 * stats.norm.sf(5)


def test_the_same_seed_gives_the_same_estimate() -> None:
    a, b = (integrate(np.cos, bmc.Normal(), 70_000, 3) for _ in range(2))
    assert float(a) == float(b)
    assert float(a) != float(integrate(np.cos, bmc.Normal(), 70_000, 4))
    assert a.draws == 70_000
    assert abs(float(a) - np.exp(-0.5)) < 5.5 * a.standard_error


def test_poor_weights_warn() -> None:
    with pytest.warns(errors.LowEssWarning, match="effective draws of 1000"):
        integrate(lambda x: x, bmc.Normal(), 1000, 0, proposal=bmc.Normal(8.0, 1.0))


def test_no_hit_is_not_certainty() -> None:
    none = hit_or_miss(lambda x: x > 2, 0.0, 1.0, 1000, 0)
    assert none.value == 0 and 0 < none.interval(0.95)[1] < 0.01


def test_all_draws_alike_are_not_certainty() -> None:
    guard = 2 / 1000
    wide = bmc.Normal(0.0, 1.5)
    for never in (True, False):

        def alike(x: np.ndarray, never: bool = never) -> np.ndarray:
            return (x > 50) == never

        plain = integrate(alike, bmc.Normal(), 1000, 0)
        np.testing.assert_allclose(plain.standard_error, guard)
        for normalised in (True, False):
            weighted = integrate(alike, bmc.Normal(), 1000, 0, proposal=wide, normalised=normalised)
            assert weighted.standard_error >= guard  # weights only lower the effective draws
    pair = integrate(lambda x: np.stack([x > 50, x > 0], axis=-1), bmc.Normal(), 1000, 0)
    np.testing.assert_allclose(pair.standard_error[0], guard)
    np.testing.assert_allclose(pair.standard_error[1], 0.5 / np.sqrt(1000), rtol=0.05)
    # numbers may be constant: their error is zero (the negative control)
    assert integrate(lambda x: 3.0 + 0 * x, bmc.Normal(), 1000, 0).standard_error == 0


def test_a_proposal_that_cannot_reach_warns() -> None:
    with pytest.warns(
        errors.SupportWarning, match=r"Uniform lies on numbers in \[-1, 1\].*support="
    ):
        integrate(lambda x: x, bmc.Normal(), 1000, 0, proposal=bmc.Uniform(-1.0, 1.0))
    cut = bmc.Density(bmc.Normal().log_prob, support=(-1, 1))
    # declared, or wider, it does not (warnings are errors here)
    integrate(lambda x: x, cut, 1000, 0, proposal=bmc.Uniform(-1.0, 1.0))
    integrate(lambda x: x, bmc.Gamma(2.0, 1.0), 1000, 0, proposal=bmc.Normal(2.0, 2.0))


def _branches(x: np.ndarray) -> float:
    return 1.0 if x > 0 else 0.0


def test_a_lid_that_is_too_low_names_the_point() -> None:
    with pytest.raises(
        errors.EnvelopeError, match=r"is 1\.\d+ at 1\.\d+, outside the box.*height=1"
    ) as e:
        hit_or_miss(lambda x: 1.2 * np.sin(x), 0.0, np.pi, 1000, 0, height=1.0)
    assert 1 < e.value.ratio <= 1.2
    np.testing.assert_allclose(1.2 * np.sin(e.value.point), e.value.ratio)
    with pytest.raises(errors.EnvelopeError, match="shift the function to be nonnegative"):
        hit_or_miss(lambda x: x, -1.0, 1.0, 1000, 0, height=2.0)


def test_an_estimate_is_a_value() -> None:
    estimate = Estimate(3.14159, 0.0123, 1000)
    assert repr(estimate) == "Estimate(3.1416 +- 0.012, 1,000 draws)"
    low, high = estimate.interval(0.6827)
    np.testing.assert_allclose([low, high], [3.14159 - 0.0123, 3.14159 + 0.0123], rtol=1e-4)
    with pytest.raises(AttributeError):
        estimate.value = 3.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        estimate.value[...] = 3.0
    vector = Estimate([1.0, 2.0], [0.1, 0.2], 10)
    assert repr(vector) == "Estimate(shape (2,), errors up to 0.2, 10 draws)"
    with pytest.raises(TypeError, match=r"shape \(2,\)"):
        float(vector)
    with pytest.raises(errors.ParameterError, match="between 0 and 1"):
        estimate.interval(95)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: integrate(np.sum, bmc.Normal(), 10), errors.QueryError, "points along the first"),
        (lambda: integrate(np.log, bmc.Gamma(1.0, 1.0), 1), errors.ParameterError, "at least 2"),
        (lambda: integrate(lambda x: 1 / (0 * x), bmc.Poisson(1.0), 9), errors.QueryError, "inf|nan"),
        (lambda: integrate(np.cos, 3.0), errors.ParameterError, "must be a distribution"),
        (lambda: integrate(np.cos, bmc.Normal([0, 1], 1.0)), errors.ShapeError, "one distribution"),
        (lambda: integrate(np.cos, bmc.Normal(), normalised=True), errors.ParameterError, "proposal="),
        (lambda: integrate(np.cos, bmc.Density(lambda x: -(x**2))), errors.UnsupportedError,
         "InverseCdf"),
        (lambda: integrate(np.cos, bmc.Uniform(5, 6).log_prob, 9, 0, proposal=bmc.Uniform(0, 1)),
         errors.ZeroProbabilityError, "covers the density"),
        (lambda: integrate(np.cos, bmc.Normal(), 9, 0, proposal=bmc.Poisson(1.0)),
         errors.UnsupportedError, "Normal is continuous and the proposal Poisson discrete"),
        (lambda: integrate(np.cos, bmc.Poisson(1.0), 9, 0, proposal=bmc.Normal()),
         errors.UnsupportedError, "give a proposal on integers >= 0"),
        (lambda: integrate(lambda x: 1j * x, bmc.Normal(), 9), errors.QueryError, "complex numbers"),
        (lambda: integrate(lambda x: x.astype(str), bmc.Normal(), 9), errors.QueryError, "must return real"),
        (lambda: integrate(_branches, bmc.Normal(), 9), errors.QueryError,
         r"fails on arrays of shape \(9,\) \(ValueError.*np.where for if"),
        (lambda: integrate(np.cos, _branches, 9, proposal=bmc.Normal()), errors.QueryError,
         "log density distribution fails on arrays"),
        (lambda: integrate("x", bmc.Normal(), 9), errors.ParameterError, "function must be callable"),
        (lambda: integrate(np.cos, bmc.Normal(), "9"), errors.ParameterError, "draws must be a whole.*'9'"),
        (lambda: integrate(np.cos, bmc.Normal(), np.inf), errors.ParameterError, "draws must be a whole"),
        (lambda: hit_or_miss(3, 0.0, 1.0), errors.ParameterError, "hit_or_miss: function must be callable"),
        (lambda: hit_or_miss(_branches, 0.0, 1.0), errors.QueryError, "hit_or_miss: the function fails"),
        (lambda: hit_or_miss(_quarter, "a", 1.0), errors.ParameterError, "low and high must be numbers"),
        (lambda: hit_or_miss(np.sin, 0.0, 1.0, height="a"), errors.ParameterError, "height must be a number"),
        (lambda: hit_or_miss(_quarter, [0, 0], [1, np.inf]), errors.ParameterError, "finite low < high"),
        (lambda: hit_or_miss(_quarter, [0, 0], [1, 1, 1]), errors.ShapeError, "components"),
        (lambda: hit_or_miss(np.sin, 0.0, 1.0), errors.QueryError, "not booleans"),
        (lambda: hit_or_miss(lambda p: p > 0, [0, 0], [1, 1]), errors.QueryError, "axis=-1"),
        (lambda: hit_or_miss(np.sin, 0.0, 1.0, height=-1.0), errors.ParameterError, "height must be"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
def test_bad_input_is_read_aloud(call: Callable, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        call()
