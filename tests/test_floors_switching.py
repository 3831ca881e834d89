"""The loop by hand that switching filters are timed against answers what bayesmc answers."""

from __future__ import annotations

import numpy as np

import bayesmc as bmc
from benchmarks import models_switching
from benchmarks.floors import switching


def test_gpb2_by_hand_is_the_engine() -> None:
    y = models_switching.series(30)
    rows = {"y": np.concatenate([np.full((1, 2), np.nan), y])}
    found = bmc.filter(models_switching.target(bmc), rows, engine=bmc.SwitchingKalmanFilter())
    by_hand = switching.gpb2(y)
    np.testing.assert_allclose(found.log_marginal_increments[1:], by_hand.increments, atol=1e-10)
    np.testing.assert_allclose(found.mean("x")[1:], by_hand.mean, atol=1e-10)
    np.testing.assert_allclose(found.cov("x")[1:], by_hand.covariance, atol=1e-10)
    np.testing.assert_allclose(found.probabilities("mode")[1:], by_hand.modes, atol=1e-10)
