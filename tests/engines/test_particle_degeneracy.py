"""What a particle filter does where no weight is left, and with resampling schemes that go astray."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

import bayesmc as bmc


def plated() -> bmc.DynamicBayesNet:
    """Two walks that never meet, seen within a distance of one."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0), plates="k")
    dbn.add("y", lambda x: bmc.Uniform(x - 1.0, x + 1.0), plates="k")
    return dbn


ROWS = np.array([[0.0, 0.2], [0.1, 40.0], [0.0, 40.3], [0.2, 40.1]])
AGAIN: dict[str, Any] = {
    "on_degeneracy": "rejuvenate",
    "rejuvenation": {"x": lambda y: bmc.Normal(y, 0.5)},
}


def test_only_the_plate_element_without_weights_begins_anew() -> None:
    engine = bmc.ParticleFilter(4000, **AGAIN)
    filtered = bmc.filter(plated(), {"y": ROWS}, engine=engine, rng=0, keep="particles")
    assert filtered.rejuvenated.tolist() == [[False, False], [False, True]] + [[False, False]] * 2
    assert (filtered.ancestors[1, :, 1] == -1).all() and (filtered.ancestors[1, :, 0] >= 0).all()
    assert filtered.unique_ancestors[1, 1] == 0 and filtered.unique_ancestors[1, 0] > 0
    # the healthy element answers as it does beside a healthy one, which draws the same numbers
    calm = ROWS.copy()
    calm[1:, 1] = 0.0
    alone = bmc.filter(plated(), {"y": calm}, engine=engine, rng=0, keep="particles")
    assert not alone.rejuvenated.any()
    # slice 1 passes the same draws; from slice 2 on other numbers are drawn
    np.testing.assert_array_equal(filtered.mean("x")[:2, 0], alone.mean("x")[:2, 0])
    increments = filtered.log_marginal_increments, alone.log_marginal_increments
    np.testing.assert_array_equal(increments[0][:2, 0], increments[1][:2, 0])
    # two runs of 4,000 particles: standard errors below .03, alpha 1e-6
    assert abs(increments[0][2:, 0] - increments[1][2:, 0]).max() < 0.2


def test_the_increment_of_a_slice_begun_anew_is_that_of_the_given_density() -> None:
    def product(x: float) -> float:
        return stats.norm.pdf(x, 40.0, 0.5) * stats.uniform.pdf(40.0, x - 1.0, 2.0)

    exact = np.log(integrate.quad(product, 38.5, 41.5, points=[39.0, 41.0])[0])
    engine = bmc.ParticleFilter(20_000, **AGAIN)
    found = bmc.filter(plated(), {"y": ROWS}, engine=engine, rng=0).log_marginal_increments[1, 1]
    # the weights are 1/2 or 0: standard error of the log below .002; wrong by log N it would be off by 10
    assert abs(found - exact) < 0.01


def test_an_online_belief_says_that_it_began_anew() -> None:
    engine = bmc.ParticleFilter(100, **AGAIN)
    belief = engine.start(plated(), rng=0)
    told = []
    for row in ROWS:
        belief = engine.step(belief, {"y": row})
        told.append(np.broadcast_to(belief.rejuvenated, 2).tolist())
    assert told == [[False, False], [False, True], [False, False], [False, False]]


@pytest.mark.parametrize(
    ("scheme", "message"),
    [
        (lambda w, n, rng: np.arange(1, n + 1), "indices from 1 to 50; there are 50 particles"),
        (
            lambda w, n, rng: np.arange(n // 2),
            r"shape \(25,\) of dtype int64; it returns 50 sorted",
        ),
        (lambda w, n, rng: np.arange(n)[::-1], "not sorted"),
        (lambda w, n, rng: np.arange(float(n)), "dtype float64"),
    ],
)
def test_indices_of_a_users_scheme_are_looked_at(scheme: Any, message: str) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    engine = bmc.ParticleFilter(50, resampling=scheme, ess_threshold=2.0)
    with pytest.raises(ValueError, match=message):
        bmc.filter(dbn, {"y": [0.0, 1.0]}, engine=engine, rng=0)


def test_one_vector_cannot_be_proposed_for_plates_filtered_apart() -> None:
    dbn = bmc.DynamicBayesNet(plates={"k": 3})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0), plates="k")
    dbn.add("z", lambda x: bmc.Normal(x, 0.3), plates="k")
    dbn.add("y", lambda z: bmc.Normal(z, 1.0), plates="k")
    vector = {("x", "z"): lambda: bmc.MvNormal(np.zeros(6), np.eye(6))}
    with pytest.raises(
        bmc.errors.UnsupportedError, match="'k' are filtered separately.*return a dict"
    ):
        bmc.filter(dbn, {"y": np.zeros((2, 3))}, engine=bmc.ParticleFilter(3, proposal=vector))
