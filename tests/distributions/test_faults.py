"""What is told of bad calls: the family, the fault and the fix; and which supports cover which."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import bayesmc.distributions as d
from bayesmc.distributions import support as s
from bayesmc.errors import BayesmcError, DensityError, ParameterError, ShapeError


def _branches(x: float) -> float:
    return -x if x > 0 else x


def _density(x: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * x**2)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: d.Normal().sample(0, -1), ShapeError, r"Normal.sample: sample_shape .* got -1"),
        (lambda: d.Normal().sample(0, 2.5), ShapeError, "Normal.sample: sample_shape .* got 2.5"),
        (lambda: d.Gamma(1.0, 1.0).sample(0, (2, -3)), ShapeError, r"Gamma.sample: .* got \(2, -3\)"),
        (lambda: d.Dirichlet([1.0, 1.0]).sample(0, (1.5,)), ShapeError, r"Dirichlet.sample: .* \(1.5,\)"),
        (lambda: d.Normal().log_prob("a"), ParameterError, "Normal.log_prob: .* must be numbers.*'a'"),
        (lambda: d.Poisson(1.0).log_prob(["a"]), ParameterError, "Poisson.log_prob: .* must be numbers"),
        (lambda: d.Normal([0, 1], 1).log_prob([1, 2, 3]), ShapeError,
         r"Normal.log_prob: values of shape \(3,\) do not broadcast with batch shape \(2,\)"),
        (lambda: d.Dirichlet([1.0, 1.0, 1.0]).constrain([0.0, 0.0, 0.0]), ShapeError,
         r"Dirichlet.constrain: the free values have shape \(3,\), which is not \(..., \*\(2,\)\)"),
        (lambda: d.Dirichlet([1.0, 1.0, 1.0]).unconstrain([0.5, 0.5]), ShapeError,
         r"Dirichlet.unconstrain: the values have shape \(2,\)"),
        (lambda: d.Uniform([0.0, 1.0], 2.0).log_abs_det_jacobian([0.0] * 3), ShapeError,
         r"Uniform.log_abs_det_jacobian: .* shape \(3,\), which does not broadcast with .* \(2,\)"),
        (lambda: d.Gamma(1.0, 1.0).constrain("a"), ParameterError, "Gamma.constrain: .* must be numbers"),
        (lambda: d.Density(_branches, support=(1, 0)), ParameterError, r"support=\(1, 0\).*low < high"),
        (lambda: d.Density(_branches, sample=3), TypeError, r"Density\(sample=3\): sample is a function"),
        (lambda: d.Density(lambda x: "a", batch_shape=()).log_prob(0.0), DensityError, "returned 'a'"),
        (lambda: d.Density(_branches, batch_shape=()).log_prob([0.0, 1.0]), DensityError,
         r"log_prob fails on arrays of shape \(2,\) \(ValueError.*np.where for if"),
        (lambda: d.InverseCdf(_branches), DensityError, "log_prob fails on arrays.*np.where for if"),
        (lambda: d.InverseCdf(_density), ParameterError, "must return the LOG density"),
    ],
)  # fmt: skip
def test_a_bad_call_is_told_with_the_family(call: Callable, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        call()


def test_what_is_not_the_callers_fault_passes_through() -> None:
    # negative controls: faults that are not of the shape keep their own words
    with pytest.raises(TypeError, match="SeedSequence|seed") as seed:
        d.Normal().sample("a", 3)
    assert not isinstance(seed.value, BayesmcError)
    with pytest.raises(ParameterError) as diverges:
        d.InverseCdf(lambda x: -np.log1p(np.abs(x)))
    assert "integral diverges" in str(diverges.value) and "LOG" not in str(diverges.value)


@pytest.mark.parametrize(
    ("wide", "narrow", "both_ways"),
    [
        (s.real, s.positive, False),
        (s.real, s.circle, False),
        (s.nonnegative, s.positive, True),  # the bound itself does not matter
        (s.positive, s.interval(0.0, 2.0), False),
        (s.interval(-1.0, 1.0), s.simplex, False),
        (s.interval([0.0, -1.0], [2.0, 3.0]), s.interval([0.5, -1.0], 2.0), False),
        (s.integers(0), s.integers(1, 6), False),
        (s.integers(0), s.as_support("counts"), True),
        (s.real_vector, s.product([(s.positive, 0), (s.simplex, 2)]), False),
        (s.product([(s.real, 0), (s.positive, 2)]),
         s.product([(s.unit_interval, 2), (s.positive, 0)]), False),
        (s.positive_definite, s.positive_definite, True),
        # of vectors of unlike lengths nothing is said
        (s.product([(s.real, 2)]), s.product([(s.positive, 3)]), True),
    ],
)  # fmt: skip
def test_covers(wide: s.Support, narrow: s.Support, both_ways: bool) -> None:
    assert wide.covers(wide) and narrow.covers(narrow)
    assert wide.covers(narrow)
    assert narrow.covers(wide) is both_ways


def test_covers_element_by_element_and_never_across_kinds() -> None:
    low = s.interval([0.0, 2.0], [1.0, 3.0])
    assert not low.covers(s.interval([2.0, 0.0], [3.0, 1.0]))
    assert not s.real.covers(s.integers(0)) and not s.integers(0).covers(s.real)
    assert not s.simplex.covers(s.positive_definite)
    three = s.interval([0.0, 0.0, 0.0], 1.0)
    assert low.covers(three)  # batches that do not fit: not surely uncovered
    assert not s.interval([5.0, 6.0], 9.0).covers(three)


def _crosses(dist: d.Distribution, q: np.ndarray) -> None:
    """The quantile is where the cdf crosses: a hair to either side brackets the probability."""
    x = dist.ppf(q)
    hair = 1e-12 * np.maximum(np.abs(x), 1e-3)
    assert (dist.cdf(x - hair) <= q * (1 + 1e-14)).all()
    assert (dist.cdf(x + hair) >= q * (1 - 1e-14)).all()


Q = np.array([1e-200, 1e-17, 1e-6, 0.1, 0.3, 0.5, 0.7, 0.9, 1 - 1e-9])


@pytest.mark.parametrize(
    "dist",
    [
        d.Mixture([0.3, 0.7], d.Normal([-1.0, 4.0], [1.0, 2.0])),
        d.Mixture([0.5, 0.5], [d.Cauchy(0.0, 1.0), d.Normal(3.0, 0.001)]),
        d.Mixture([0.999, 0.001], d.Normal([0.0, 40.0], [1.0, 1e-3])),
        d.Mixture([0.5, 0.5], d.Gamma([2.0, 300.0], 1.0)),
        d.KernelDensity(np.random.default_rng(0).normal(size=200)),
    ],
    ids=["two", "spike on tails", "far and light", "gammas", "kernels"],
)
def test_quantiles_of_mixtures_are_where_the_cdf_crosses(dist: d.Distribution) -> None:
    _crosses(dist, Q)


def test_a_gap_has_the_least_crossing_and_the_ends_are_the_supports() -> None:
    gap = d.Mixture([0.5, 0.5], [d.Uniform(0.0, 1.0), d.Uniform(3.0, 4.0)])
    np.testing.assert_allclose(gap.ppf([0.0, 0.25, 0.5, 0.75, 1.0]), [0.0, 0.5, 1.0, 3.5, 4.0])


def test_few_turns_are_enough() -> None:
    mixture = d.Mixture([0.3, 0.7], d.Normal([-1.0, 4.0], [1.0, 2.0]))
    calls = []

    class Counting(d.Mixture):
        def cdf(self, x: np.ndarray) -> np.ndarray:
            calls.append(None)
            return super().cdf(x)

    Counting(mixture.weights, mixture.components).ppf(np.linspace(0.01, 0.99, 99))
    assert len(calls) <= 25  # bisection to the last bit takes 53 and more
    calls.clear()
    one = Counting([1.0], d.Normal([0.3], 2.0))
    np.testing.assert_array_equal(one.ppf([0.1, 0.9]), d.Normal(0.3, 2.0).ppf([0.1, 0.9]))
    assert not calls


def test_moments_over_a_bounded_interval() -> None:
    # a power law at zero, and an interval much wider than the mass, which must fall back
    for base, low, high in [
        (d.Beta(0.3, 2.0), 0.0, 0.7),
        (d.Beta(5.0, 0.4), 0.2, 1.0),
        (d.Gamma(3.0, 1.0), 0.0, 1e9),
        (d.Gamma(3.0, 1.0), 1.0, 2.5),
    ]:
        cut = d.Truncated(base, low, high)
        grid = np.linspace(0, 1, 200_001)[1::2]  # midpoints of the quantile scale
        x = cut.ppf(grid)
        np.testing.assert_allclose(cut.mean, x.mean(), rtol=1e-5)
        np.testing.assert_allclose(cut.var, x.var(), rtol=2e-4)
