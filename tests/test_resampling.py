"""Systematic resampling: counts within one of their expectation, unbiased, in order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesmc.resampling import systematic


@given(
    st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30).filter(lambda w: sum(w) > 1e-6),
    st.integers(0, 200),
    st.integers(0, 50),
)
def test_counts_are_the_floor_or_ceiling_of_their_expectation(weights, draws, seed):
    weights = np.array(weights)
    picked = systematic(weights, draws, np.random.default_rng(seed))
    assert picked.shape == (draws,) and picked.dtype.kind == "i"
    assert (np.diff(picked) >= 0).all()
    counts = np.bincount(picked, minlength=len(weights))
    expected = draws * weights / weights.sum()
    # between neighbours' edges rounding may cost one more in floating point
    assert (counts >= np.floor(expected - 1e-9)).all() and (
        counts <= np.ceil(expected + 1e-9)
    ).all()
    assert counts[weights == 0].sum() == 0


def test_it_is_unbiased():
    """Mean counts over 4000 seeds; each has a variance of at most 1/4 per seed. False alarm 6e-5."""
    weights = np.array([0.07, 0.5, 0.0, 0.13, 0.3])
    runs = 4000
    total = np.zeros(5)
    for seed in range(runs):
        total += np.bincount(systematic(weights, 7, np.random.default_rng(seed)), minlength=5)
    error = 0.5 / np.sqrt(runs)
    assert (np.abs(total / runs - 7 * weights) < 4.2 * error).all()
    # negative control: rounding to the nearest count is biased by far more
    assert (np.abs(np.round(7 * weights) - 7 * weights) > 4.2 * error).any()


def test_scale_of_the_weights_does_not_matter():
    weights = np.array([1.0, 2.0, 3.0])
    one = systematic(weights, 50, np.random.default_rng(0))
    np.testing.assert_array_equal(one, systematic(weights / 6, 50, np.random.default_rng(0)))


@pytest.mark.parametrize("position", [0, 3, 9])
def test_one_heavy_draw_takes_all(position):
    weights = np.zeros(10)
    weights[position] = 1.0
    assert (systematic(weights, 25, np.random.default_rng(0)) == position).all()
