"""Missing rows of a node that nobody can draw: weighed where they are seen, and left out where not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError

PARTICLES = 4000
SERIES = np.array([np.nan, 0.4, 1.9, np.nan, np.nan, 2.2, 1.1, 1.6])
PAIRS = np.array([[0.2, 1.0], [np.nan, 0.7], [np.nan, np.nan], [0.5, np.nan], [0.9, 1.4]])


def drift(bare: bool, plate: bool = False) -> bmc.DynamicBayesNet:
    """A random walk that is read with noise; bare, the reading has a density and no sampler."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2} if plate else None)
    plates: Any = "k" if plate else ()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.7), initial=bmc.Normal(0.0, 1.0))

    def read(x: Any) -> Any:
        seen = bmc.Normal(x, 0.5)
        return bmc.Density(seen.log_prob, batch_shape=seen.batch_shape) if bare else seen

    dbn.add("y", read, plates=plates)
    return dbn


@pytest.mark.parametrize("plate", [False, True])
def test_what_is_not_seen_weighs_nothing(plate: bool) -> None:
    """Against the Kalman filter; means differ by 5 of their standard errors once in a million."""
    rows = PAIRS if plate else SERIES
    exact = bmc.filter(drift(False, plate), {"y": rows}, engine=bmc.KalmanFilter())
    engine = bmc.ParticleFilter(PARTICLES)
    found = bmc.filter(drift(True, plate), {"y": rows}, engine=engine, rng=1)
    off = np.abs(found.mean("x") - exact.mean("x"))
    assert (off < 5 * np.maximum(found.mcse("x"), 0.01)).all(), off
    wrong = bmc.filter(drift(False, plate), {"y": np.nan_to_num(rows)}, engine=bmc.KalmanFilter())
    assert (np.abs(wrong.mean("x") - exact.mean("x")) > 0.2).any()  # zeros in their place
    assert np.isclose(
        found.log_marginal_likelihood, exact.log_marginal_likelihood,
        atol=5 * found.log_marginal_likelihood_mcse,
    )  # fmt: skip
    with pytest.raises(
        UnsupportedError, match="'y' is not answered .* has no sampler has no value"
    ):
        found.mean("y")


def test_it_is_forecast_past_and_stepped_over() -> None:
    rows = SERIES[:3]
    ahead = bmc.forecast(
        drift(True), {"y": rows}, engine=bmc.ParticleFilter(PARTICLES), steps=2, rng=0
    )
    exact = bmc.forecast(drift(False), {"y": rows}, engine=bmc.KalmanFilter(), steps=2)
    np.testing.assert_allclose(ahead.mean("x"), exact.mean("x"), atol=0.1)
    np.testing.assert_allclose(ahead.std("x"), exact.std("x"), rtol=0.1)
    engine = bmc.ParticleFilter(PARTICLES)
    belief = engine.start(drift(True), rng=0)
    for row in (*({"y": y} for y in rows[1:]), {"y": None}, {}):
        belief = engine.step(belief, row)
    assert belief.t == 3 and np.isfinite(belief.mean("x"))
    paths = bmc.smooth(
        drift(True), {"y": SERIES}, engine=bmc.ParticleFilter(500), trajectories=20, rng=0
    )
    assert np.isfinite(paths.mean("x")).all()


def test_what_is_read_must_still_be_drawn() -> None:
    dbn = drift(True)
    dbn.add("z", lambda y: bmc.Normal(y, 1.0))
    with pytest.raises(UnsupportedError, match="pass sample="):
        bmc.filter(dbn, {"y": SERIES, "z": np.zeros(8)}, engine=bmc.ParticleFilter(50), rng=0)
