"""The loop by hand that switching filters are timed against answers what bayesmc answers."""

from __future__ import annotations

import numpy as np

import bayesmc as bmc
from benchmarks import models_switching
from benchmarks.floors import propagation, switching


def test_gpb2_by_hand_is_the_engine() -> None:
    y = models_switching.series(30)
    rows = {"y": np.concatenate([np.full((1, 2), np.nan), y])}
    found = bmc.filter(models_switching.target(bmc), rows, engine=bmc.SwitchingKalmanFilter())
    by_hand = switching.gpb2(y)
    np.testing.assert_allclose(found.log_marginal_increments[1:], by_hand.increments, atol=1e-10)
    np.testing.assert_allclose(found.mean("x")[1:], by_hand.mean, atol=1e-10)
    np.testing.assert_allclose(found.cov("x")[1:], by_hand.covariance, atol=1e-10)
    np.testing.assert_allclose(found.probabilities("mode")[1:], by_hand.modes, atol=1e-10)


def test_propagation_by_hand_is_the_engine() -> None:
    """Sweep by sweep, and where it settles."""
    y = models_switching.series(20)
    rows = {"y": np.concatenate([np.full((1, 2), np.nan), y])}
    engine = bmc.ExpectationPropagation(damping=0.0, tolerance=1e-9)
    found = bmc.smooth(models_switching.target(bmc), rows, engine=engine)
    by_hand = propagation.propagated(y, found.sweeps)
    assert found.converged
    assert abs(found.log_marginal_likelihood - by_hand.log) < 1e-8
    np.testing.assert_allclose(found.mean("x")[1:], by_hand.mean, atol=1e-8)
    np.testing.assert_allclose(found.probabilities("mode")[1:], by_hand.modes, atol=1e-8)
    assert abs(by_hand.log - propagation.propagated(y, 0).log) > 1e-3
