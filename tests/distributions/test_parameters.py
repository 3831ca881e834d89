"""Parameters out of range: the message, the first offending index, and marking instead."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

import bayesmc.distributions as d
from bayesmc.errors import ParameterError, ShapeError

NAN, INF = np.nan, np.inf
NOT_PD = np.array([[1.0, 2.0], [2.0, 1.0]])

#: a call with exactly one fault, its index, and words of its message
FAULTS: list[tuple[Callable[[], d.Distribution], tuple[int, ...], str]] = [
    (lambda: d.Normal(0.0, -1.0), (), "Normal: scale must be positive and finite; got -1."),
    (
        lambda: d.Normal(0.0, [1.0, -1.0]),
        (1,),
        "scale must be positive and finite; got -1. at index 1",
    ),
    (
        lambda: d.Normal([[0, 1], [NAN, 2]], 1.0),
        (1, 0),
        r"loc must be finite; got nan at index (1, 0)",
    ),
    (lambda: d.Normal(0.0, INF), (), "scale must be positive"),
    (lambda: d.StudentT([3.0, -3.0], 0.0, 1.0), (1,), "StudentT: df must be positive"),
    (lambda: d.StudentT(3.0, 0.0, NAN), (), "scale must be positive"),
    (
        lambda: d.Uniform([0.0, 2.0], 2.0),
        (1,),
        "Uniform: high must be finite and above low; got 2.",
    ),
    (lambda: d.Uniform(0.0, NAN), (), "high must be finite and above low"),
    (lambda: d.Uniform(-INF, 0.0), (), "low must be finite"),
    (lambda: d.Beta([1.0, 0.0], 1.0), (1,), "Beta: concentration1 must be positive"),
    (lambda: d.Beta(1.0, NAN), (), "concentration0 must be positive"),
    (lambda: d.Gamma(1.0, [[1.0, -2.0]]), (0, 1), "Gamma: rate must be positive"),
    (lambda: d.Exponential(INF), (), "Exponential: rate must be positive and finite; got inf"),
    (
        lambda: d.Dirichlet([[1.0, 1.0], [1.0, 0.0]]),
        (1,),
        "Dirichlet: concentration must be positive",
    ),
    (lambda: d.Bernoulli([0.5, 1.5]), (1,), "Bernoulli: probs must be between 0 and 1; got 1.5 at"),
    (lambda: d.Bernoulli(logits=[0.0, NAN]), (1,), "logits must be a number"),
    (
        lambda: d.Binomial(2.5, 0.5),
        (),
        "Binomial: total_count must be a nonnegative whole number; got 2.5",
    ),
    (
        lambda: d.Binomial([3, -1], 0.5),
        (1,),
        "total_count must be a nonnegative whole number; got -1",
    ),
    (lambda: d.Binomial(3, [0.5, NAN]), (1,), "Binomial: probs must be between 0 and 1"),
    (lambda: d.Poisson([1.0, -1.0]), (1,), "Poisson: rate must be nonnegative and finite"),
    (lambda: d.Laplace([0.0, NAN], 1.0), (1,), "Laplace: loc must be finite; got nan at index 1"),
    (lambda: d.Laplace(0.0, [1.0, -1.0]), (1,), "scale must be positive and finite"),
    (lambda: d.Cauchy(INF, 1.0), (), "Cauchy: loc must be finite"),
    (lambda: d.Cauchy(0.0, 0.0), (), "Cauchy: scale must be positive"),
    (lambda: d.HalfNormal([1.0, -1.0]), (1,), "HalfNormal: scale must be positive"),
    (lambda: d.HalfCauchy(NAN), (), "HalfCauchy: scale must be positive"),
    (lambda: d.LogNormal(0.0, [[1.0, 0.0]]), (0, 1), "LogNormal: scale must be positive"),
    (lambda: d.LogNormal([INF, 0.0], 1.0), (0,), "LogNormal: loc must be finite"),
    (lambda: d.InverseGamma([1.0, 0.0], 1.0), (1,), "InverseGamma: concentration must be positive"),
    (lambda: d.InverseGamma(1.0, -1.0), (), "InverseGamma: scale must be positive"),
    (lambda: d.Weibull(NAN, 1.0), (), "Weibull: concentration must be positive"),
    (lambda: d.Weibull(1.0, [2.0, INF]), (1,), "Weibull: scale must be positive"),
    (lambda: d.VonMises([0.0, INF], 1.0), (1,), "VonMises: loc must be finite"),
    (
        lambda: d.VonMises(0.0, [1.0, -0.5]),
        (1,),
        "VonMises: concentration must be nonnegative and finite; got -0.5 at index 1",
    ),
    (lambda: d.VonMises(0.0, INF), (), "concentration must be nonnegative and finite"),
    (lambda: d.WrappedNormal(NAN, 1.0), (), "WrappedNormal: loc must be finite"),
    (lambda: d.WrappedNormal(0.0, [0.0, 1.0]), (0,), "WrappedNormal: scale must be positive"),
    (lambda: d.Geometric([0.5, 1.5]), (1,), "Geometric: probs must be between 0 and 1"),
    (
        lambda: d.Geometric([0.5, 0.0]),
        (1,),
        "Geometric: probs must be above 0, for with 0 no success ever comes; got 0. at index 1",
    ),
    (lambda: d.Geometric(logits=[0.0, -INF]), (1,), "logits must be above minus infinity"),
    (lambda: d.Geometric(logits=NAN), (), "Geometric: logits must be a number"),
    (lambda: d.NegativeBinomial([2.0, 0.0], 0.5), (1,), "total_count must be positive and finite"),
    (lambda: d.NegativeBinomial(2.0, [NAN, 0.5]), (0,), "probs must be between 0 and 1"),
    (
        lambda: d.NegativeBinomial(2.0, [0.5, 1.0]),
        (1,),
        "NegativeBinomial: probs must be below 1, for with 1 no failure ever comes; got 1.",
    ),
    (lambda: d.NegativeBinomial(2.0, logits=INF), (), "logits must be below infinity"),
    (
        lambda: d.Multinomial([3, -1], [0.5, 0.5]),
        (1,),
        "Multinomial: total_count must be a nonnegative whole number; got -1",
    ),
    (lambda: d.Multinomial(2.5, [0.5, 0.5]), (), "Multinomial: total_count must be a nonneg"),
    (
        lambda: d.Multinomial(3, [[0.5, 0.5], [0.5, 0.4]]),
        (1,),
        "Multinomial: probs must be nonnegative and sum to 1 within 1e-06 (this row sums to 0.9); "
        "got [0.5 0.4] at index 1",
    ),
    (lambda: d.Multinomial(3, logits=[[0.0, INF]]), (0,), "Multinomial: logits must be below inf"),
    (lambda: d.DiscreteUniform(0.5, 3), (), "DiscreteUniform: low must be a whole number; got 0.5"),
    (lambda: d.DiscreteUniform(0, [3, NAN]), (1,), "high must be a whole number"),
    (lambda: d.DiscreteUniform([0, 4], 3), (1,), "high must be at least low; got 3 at index 1"),
    (
        lambda: d.Categorical([[0.5, 0.5], [0.5, 0.4]]),
        (1,),
        "Categorical: probs must be nonnegative and sum to 1 within 1e-06 (this row sums to 0.9); "
        "got [0.5 0.4] at index 1",
    ),
    (
        lambda: d.Categorical([1.5, -0.5]),
        (),
        "sum to 1 within 1e-06 (this row holds -0.5); got [ 1",
    ),
    (lambda: d.Categorical([[[0.5, 0.5], [NAN, 0.5]]]), (0, 1), "at index (0, 1)"),
    (
        lambda: d.Categorical(logits=[[0.0, 0.0], [-INF, -INF]]),
        (1,),
        "logits must be below infinity",
    ),
    (lambda: d.Categorical(logits=[0.0, INF]), (), "logits must be below infinity"),
    (lambda: d.MvNormal([0.0, NAN], np.eye(2)), (), "MvNormal: loc must be finite"),
    (
        lambda: d.MvNormal(np.zeros(2), [np.eye(2), np.eye(2), NOT_PD]),
        (2,),
        "MvNormal: cov must be symmetric positive definite",
    ),
    (lambda: d.MvNormal(np.zeros(2), [[1.0, 0.5], [0.0, 1.0]]), (), "symmetric positive definite"),
    (lambda: d.MvNormal(np.zeros(2), [[NAN, 0.0], [0.0, 1.0]]), (), "symmetric positive definite"),
    (lambda: d.MvNormal(np.zeros(2), scale_tril=[[1.0, 0.5], [0.0, 1.0]]), (), "lower triangular"),
    (lambda: d.MvNormal(np.zeros(2), scale_tril=-np.eye(2)), (), "positive diagonal"),
    (
        lambda: d.MvNormal(np.zeros(2), scale_diag=[[1.0, 1.0], [1.0, -1.0]]),
        (1,),
        "scale_diag must be",
    ),
    (
        lambda: d.Mixture([0.5, 0.6], d.Normal([0, 1], 1)),
        (),
        "Mixture: weights must be nonnegative and",
    ),
    (
        lambda: d.as_distribution(stats.norm(0.0, [1.0, -1.0])),
        (1,),
        "scipy.stats.norm: parameters must be in SciPy's range; got [ 0. -1.] at index 1",
    ),
]


@pytest.mark.parametrize(
    ("call", "index", "message"), FAULTS, ids=[fault[2][:50] for fault in FAULTS]
)
def test_the_first_fault_is_named(call: Callable, index: tuple[int, ...], message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        call()
    assert message in str(caught.value)
    assert caught.value.index == index


@pytest.mark.parametrize(
    ("call", "index", "message"), FAULTS, ids=[fault[2][:50] for fault in FAULTS]
)
def test_a_marked_fault_leaves_the_rest_usable(
    call: Callable, index: tuple[int, ...], message: str
) -> None:
    with d.marking_invalid():
        if not index and message.startswith("scipy"):
            return
        dist = call()
    assert dist.invalid.shape == dist.batch_shape
    assert dist.invalid[index]
    assert dist.invalid.sum() == 1
    assert message in str(dist.problem)
    assert dist.problem.index == index
    draws = dist.sample(0, 50)
    assert draws.shape == (50, *dist.batch_shape, *dist.event_shape)
    good = ~dist.invalid
    assert np.isfinite(dist.log_prob(draws)[:, good]).all()


def test_marks_do_not_leak_out_of_the_block() -> None:
    with d.marking_invalid():
        assert d.Normal(0.0, -1.0).invalid is not None
    with pytest.raises(ParameterError):
        d.Normal(0.0, -1.0)


def test_valid_elements_are_untouched_by_a_marked_one() -> None:
    with d.marking_invalid():
        dist = d.Normal([0.0, 1.0, 2.0], [1.0, -1.0, 3.0])
        table = d.Categorical([[0.2, 0.8], [0.7, 0.7]])
    np.testing.assert_array_equal(
        dist.log_prob(0.5)[[0, 2]], d.Normal([0.0, 2.0], [1.0, 3.0]).log_prob(0.5)
    )
    np.testing.assert_array_equal(table.probs[0], [0.2, 0.8])


def test_several_faults_are_all_marked() -> None:
    with d.marking_invalid():
        dist = d.Gamma([1.0, -1.0, 1.0], [1.0, 1.0, 0.0])
    assert dist.invalid.tolist() == [False, True, True]
    assert "concentration" in str(dist.problem)  # the first one found


def test_a_mixture_adopts_the_marks_of_its_parts() -> None:
    with d.marking_invalid():
        stacked = d.Mixture([0.5, 0.5], d.Normal(0.0, [[1.0, 1.0], [1.0, -1.0]]))
        listed = d.Mixture([0.5, 0.5], [d.Normal(0.0, [1.0, -1.0]), d.Normal(0.0, 1.0)])
    assert stacked.invalid.tolist() == listed.invalid.tolist() == [False, True]
    assert "scale" in str(stacked.problem)


def test_a_linear_map_adopts_the_marks_of_its_gaussian() -> None:
    with d.marking_invalid():
        mapped = d.MvNormal(np.zeros(2), [np.eye(2), NOT_PD]).linear_map([[1.0, 1.0]])
    assert mapped.invalid.tolist() == [False, True]
    assert "cov" in str(mapped.problem)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: d.Normal(np.zeros(2), np.ones(3)), r"\(2,\), \(3,\) do not broadcast"),
        (lambda: d.MvNormal(0.0, np.eye(2)), "loc must have shape"),
        (lambda: d.MvNormal(np.zeros(3), np.eye(2)), "loc must have shape"),
        (lambda: d.MvNormal(np.zeros(2), np.ones((2, 3))), "loc must have shape"),
        (lambda: d.Dirichlet(1.0), r"shape \(..., K\)"),
        (lambda: d.Categorical(0.5), r"shape \(..., K\)"),
        (lambda: d.Categorical(np.zeros((2, 0))), "K at least 1"),
        (lambda: d.Multinomial(3, 0.5), r"Multinomial: probs must have shape \(..., K\)"),
        (
            lambda: d.Multinomial(3, logits=np.zeros((2, 0))),
            "logits must have shape .* K at least 1",
        ),
        (lambda: d.Multinomial([3, 4], np.full((3, 2), 0.5)), "do not broadcast"),
        (lambda: d.Multinomial(3, [0.5, 0.5]).log_prob([1, 1, 1]), r"not \(..., 2\)"),
        (lambda: d.Mixture([0.5, 0.5], d.Normal(0, 1)), "must count the components"),
        (lambda: d.Mixture([0.5, 0.5], d.Normal([0, 1, 2], 1)), "2 weights for 3 components"),
        (lambda: d.Mixture(1.0, d.Normal([0], 1)), "got a scalar"),
        (lambda: d.Mixture([1.0], []), "list of Distributions"),
        (lambda: d.Mixture([1.0], [3.0]), "list of Distributions"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(call: Callable, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        call()


def _negative_binomial(probs: object = None, *, logits: object = None) -> d.Distribution:
    return d.NegativeBinomial(3.0, probs, logits=logits)


def _multinomial(probs: object = None, *, logits: object = None) -> d.Distribution:
    return d.Multinomial(3, probs, logits=logits)


@pytest.mark.parametrize(
    "family", [d.Bernoulli, d.Categorical, d.Geometric, _negative_binomial, _multinomial]
)
def test_probs_and_logits_exclude_each_other(family: Callable[..., d.Distribution]) -> None:
    with pytest.raises(ParameterError, match="exactly one of probs and logits"):
        family([0.5, 0.5], logits=[0.0, 0.0])
    with pytest.raises(ParameterError, match="exactly one of probs and logits"):
        family()


def test_mvnormal_takes_exactly_one_scale() -> None:
    with pytest.raises(ParameterError, match="exactly one of cov"):
        d.MvNormal([0.0])
    with pytest.raises(ParameterError, match="exactly one of cov"):
        d.MvNormal([0.0], [[1.0]], scale_diag=[1.0])
