"""Density: a distribution given as an equation, with or without a sampler."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc.distributions as d
from bayesmc.distributions.support import integers, interval
from bayesmc.errors import ShapeError, UnsupportedError

SCALES = np.array([1.0, 2.0, 3.0])


def _log_laplace(x: np.ndarray) -> np.ndarray:
    return -np.abs(x) / SCALES - np.log(2 * SCALES)


def _laplace(rng: np.random.Generator, sample_shape: tuple[int, ...]) -> np.ndarray:
    return rng.laplace(scale=SCALES, size=(*sample_shape, 3))


def test_the_batch_is_found_from_the_function() -> None:
    dist = d.Density(_log_laplace, _laplace)
    assert dist.batch_shape == (3,)
    assert not dist.is_discrete
    np.testing.assert_array_equal(
        dist.log_prob([[0.5], [1.0]]), _log_laplace(np.array([[0.5], [1.0]]))
    )
    draws = dist.sample(0, 20_000)
    # mean |x| is the scale, with a standard error of scale / sqrt(n): 6 of them
    assert (np.abs(np.abs(draws).mean(axis=0) / SCALES - 1) < 6 / np.sqrt(20_000)).all()


def test_the_function_is_not_called_before_it_is_needed() -> None:
    def refuse(x: np.ndarray) -> np.ndarray:
        raise AssertionError("called")

    dist = d.Density(refuse, lambda rng, shape: rng.normal(size=(*shape, 2)), batch_shape=(2,))
    assert dist.sample(0, 3).shape == (3, 2)


def test_without_a_sampler_sampling_is_refused_with_the_remedy() -> None:
    dist = d.Density(lambda x: -(x**2))
    assert not dist.can_sample
    with pytest.raises(
        UnsupportedError, match=r"pass sample=function\(rng, sample_shape\), wrap it as InverseCdf"
    ):
        dist.sample(0)


@pytest.mark.parametrize(
    ("support", "event_shape", "inside", "outside"),
    [
        ("positive", (), 0.5, [0.0, -1.0, np.nan, np.inf]),
        ("unit interval", (), 1.0, [1.5, -0.1]),
        ((-1, 2), (), 2.0, [2.1, -1.1]),
        (interval(0.0, 1.0, open_high=True), (), 0.0, [1.0]),
        ("nonnegative integer", (), 3, [-1, 0.5]),
        (integers(1, 3), (), 3, [0, 4, 1.5]),
        ("simplex", (2,), [0.5, 0.5], [[0.5, 0.6], [-0.1, 1.1]]),
        ("real", (2,), [1.0, -1.0], [[np.nan, 0.0], [np.inf, 0.0]]),
        ("positive", (2,), [1.0, 2.0], [[1.0, -1.0]]),
        ("positive definite", (2, 2), np.eye(2), [-np.eye(2)]),
    ],
    ids=str,
)
def test_outside_the_support_there_is_no_mass(
    support: object, event_shape: tuple, inside: object, outside: list
) -> None:
    axes = tuple(range(-len(event_shape), 0))
    dist = d.Density(lambda x: 0.0 * x.sum(axis=axes), event_shape=event_shape, support=support)
    assert dist.batch_shape == ()
    assert dist.log_prob(inside) == 0.0
    assert (dist.log_prob(outside) == -np.inf).all()
    assert dist.log_prob([inside, inside]).shape == (2,)


def test_an_integer_support_makes_it_discrete_and_tabulates() -> None:
    dist = d.Density(lambda x: np.log(x / 6), support=integers(1, 3))
    assert dist.is_discrete
    np.testing.assert_allclose(dist.probs_table, [1 / 6, 2 / 6, 3 / 6])


def test_equal_densities_have_equal_parameters_and_others_do_not() -> None:
    def make(rate: float) -> d.Density:
        return d.Density(lambda x: np.log(rate) - rate * x, support="positive")

    first, again, other = make(1.0).parameters(), make(1.0).parameters(), make(1.5).parameters()
    assert all(np.array_equal(a, b) for (a, _), (b, _) in zip(first, again, strict=True))
    assert not all(np.array_equal(a, b) for (a, _), (b, _) in zip(first, other, strict=True))


def test_a_vector_function_that_forgets_to_reduce_is_refused() -> None:
    dist = d.Density(lambda x: -(x**2), event_shape=(2,), batch_shape=())
    with pytest.raises(ShapeError, match="reduce the event axes"):
        dist.log_prob(np.zeros((5, 2)))


def test_a_function_that_mixes_the_batch_is_refused() -> None:
    dist = d.Density(lambda x: -np.sum(x**2) * np.ones(7))
    with pytest.raises(ShapeError, match="expected"):
        dist.log_prob(np.zeros(5))


def test_a_flat_density_is_broadcast() -> None:
    assert d.Density(lambda x: 0.0).log_prob(np.zeros((4, 5))).shape == (4, 5)


def test_a_sampler_of_the_wrong_shape_is_refused() -> None:
    dist = d.Density(_log_laplace, lambda rng, shape: rng.laplace(size=shape))
    with pytest.raises(ShapeError, match=r"returned shape \(4,\).*\(4, 3\)"):
        dist.sample(0, 4)


def test_event_shape_and_support_must_fit() -> None:
    with pytest.raises(ShapeError, match="takes event_shape of 1 axes"):
        d.Density(lambda x: 0.0, support="simplex")
    with pytest.raises(ValueError, match="support='reel' is not known"):
        d.Density(lambda x: 0.0, support="reel")
