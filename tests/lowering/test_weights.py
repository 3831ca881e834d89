"""Loops of particle filters in machine code, beside those in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.lowering import weight_loops
from bayesmc.resampling import systematic

pytest.importorskip("llvmlite", reason="llvmlite is not installed")


@pytest.mark.parametrize("n", [1, 2, 7, 100, 5000])
def test_weights_and_their_sums(n: int) -> None:
    log = np.random.default_rng(n).normal(size=n) * 30
    log[n // 2 :: 7] = -np.inf
    level, weights = float(log.max()) if n > 1 else 0.0, np.empty(n)
    total, squares = weight_loops().exponentials(log, level, weights)
    np.testing.assert_allclose(weights, np.exp(log - level), rtol=1e-15)
    np.testing.assert_allclose([total, squares], [weights.sum(), weights @ weights], rtol=1e-13)


def test_systematic_resampling_takes_the_same_ancestors() -> None:
    for seed in range(300):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 60))
        weights = rng.exponential(size=n) * rng.choice([0.0, 1.0, 1e-12, 1e6], size=n)
        if seed % 3 == 0:
            weights = np.ones(n)
        if not weights.any():
            weights[0] = 1.0
        draws = int(rng.integers(1, 80)) if seed % 2 else n
        state = np.random.default_rng(seed).bit_generator.state
        expected = systematic(weights, draws, rng_of(state))
        found = weight_loops().systematic(weights, draws, rng_of(state).random)
        np.testing.assert_array_equal(found, expected, err_msg=str(seed))


def rng_of(state: object) -> np.random.Generator:
    bits = np.random.PCG64()
    bits.state = state
    return np.random.Generator(bits)


@pytest.mark.parametrize(
    "weights", [np.zeros(5), np.full(5, np.nan), np.full(5, 1e300), np.full(3, 1e-300)]
)
def test_weights_of_no_moderate_sum_are_left_to_numpy(weights: np.ndarray) -> None:
    assert weight_loops().systematic(weights, 5, lambda: pytest.fail("drawn")) is None
