"""What goes with elements one by one, and what is refused by name: other sensors, the past, labels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.robotics import PoseNormal, range_and_bearing
from bayesmc.testing import session
from bayesmc.testing.posteriors.repeated import repeated_test
from tests.mutants.elements import figures, world

ROWS = np.random.default_rng(7).normal(size=(4, 2, 2))
LABELS = np.array([[0, 1], [1, 0], [0, 1], [0, 1]])


def with_sensors() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """A linear sensor of the pose, which is silent once, and a plate of them."""
    dbn = world(False)
    dbn.add("gps", lambda pose: bmc.MvNormal(pose + 0.1, scale_diag=[0.3, 0.4]))
    dbn.add("far", lambda pose: bmc.Normal(pose[..., 0] - pose[..., 1], 0.5), plates="look")
    gps, far = ROWS[:, 0] * 0.5, ROWS[:, 1] * 0.5
    gps[1] = np.nan
    return dbn, {"seen": ROWS, "gps": gps, "far": far}


def test_other_sensors_of_a_guided_pose_weigh_it_and_lead_it() -> None:
    """Evidence and moments without bias beside the Kalman filter's: Holm at 1e-6."""
    dbn, rows = with_sensors()
    inputs = {"which": LABELS}
    exact = bmc.filter(dbn, rows, inputs=inputs, engine=bmc.KalmanFilter())
    engine = bmc.ParticleFilter(60, marginalize="mark", proposal="optimal")

    def run(rng: np.random.Generator) -> np.ndarray:
        found = bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=rng)
        share = np.exp(found.log_marginal_likelihood - exact.log_marginal_likelihood)
        return np.append(share * figures(found), share)

    truth = np.append(figures(exact), 1.0)
    runs = session.scaled(30)
    assert repeated_test(run, truth, replications=runs, alpha=1e-6, rng=0)
    found = bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=0)
    assert found.weight_ess.min() > 30
    np.testing.assert_allclose(found.mean("gps")[1], found.mean("pose")[1] + 0.1, atol=0.3)


def slam() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet(plates={"mark": 5, "look": 2})
    dbn.input("which", plates="look")
    start = PoseNormal(np.zeros(3), scale_diag=[0.01] * 3)
    dbn.add("pose", lambda pose_prev: PoseNormal(pose_prev, scale_diag=[0.02] * 3), initial=start)
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, scale_diag=np.zeros(2)),
        plates="mark",
        initial=bmc.MvNormal(np.zeros(2), scale_diag=[50.0, 50.0]),
    )
    dbn.add(
        "seen",
        lambda pose, mark, which: range_and_bearing(pose, mark[which], 0.1, 0.05),
        plates="look",
    )
    return dbn


def test_the_past_is_not_made_linear_at_vague_priors() -> None:
    dbn, rows, inputs = slam(), {"seen": np.ones((3, 2, 2))}, {"which": LABELS[:3]}
    plain, late = (bmc.ParticleFilter(10, marginalize="mark", delay=k) for k in (None, 1))
    told = r"make all 5 elements of 'mark' linear together"
    with pytest.raises(bmc.errors.UnsupportedError, match=f"delay= would {told}"):
        bmc.filter(dbn, rows, inputs=inputs, engine=late, rng=0)
    with pytest.raises(bmc.errors.UnsupportedError, match=f"smoothing would {told}"):
        bmc.smooth(dbn, rows, inputs=inputs, engine=plain, rng=0)
    with pytest.raises(bmc.errors.UnsupportedError, match=f"lag= would {told}"):
        bmc.smooth(dbn, rows, inputs=inputs, engine=plain, rng=0, lag=1)
    with pytest.raises(bmc.errors.UnsupportedError, match=told):
        belief = late.start(dbn, rng=0)
        late.step(belief, {"seen": rows["seen"][0]}, inputs={"which": LABELS[0]})
    assert "it cannot answer" in str(bmc.explain(dbn, rows, inputs=inputs, engine=late))


@pytest.mark.parametrize("label", [-1, 2])
@pytest.mark.parametrize("engine", [bmc.ParticleFilter(5, marginalize="mark"), bmc.KalmanFilter()])
def test_labels_of_no_element_are_told_by_name(label: int, engine: Any) -> None:
    """Where the reading is missing, too; labels read as floats say what to do."""
    dbn, rows, labels = world(False), np.array(ROWS), np.array(LABELS)
    labels[2, 1], rows[2, 1] = label, np.nan
    told = rf"slice 2: input 'which' is {label}, .* of plate 'mark', which are 0\.\.1, for 'seen'"
    with pytest.raises(bmc.errors.EvidenceError, match=told):
        bmc.filter(dbn, {"seen": rows}, inputs={"which": labels}, engine=engine, rng=0)
    with pytest.raises(bmc.errors.BayesmcError, match=r"not by float64 values; .*astype\(int\)"):
        bmc.filter(dbn, {"seen": ROWS}, inputs={"which": LABELS / 1.0}, engine=engine, rng=0)


def test_two_guided_nodes_are_told_by_name() -> None:
    dbn = bmc.DynamicBayesNet(plates={"mark": 2})
    dbn.input("which")
    for name in "xy":
        dbn.add(name, bmc.Normal(0.0, 1.0))
    start = bmc.Normal(0.0, 5.0)
    dbn.add("mark", lambda mark_prev: bmc.Normal(mark_prev, 0.0), plates="mark", initial=start)
    dbn.add("seen", lambda x, y, mark, which: bmc.Normal(mark[which] - x + y, 0.3))
    engine = bmc.ParticleFilter(10, marginalize="mark", proposal="optimal")
    with pytest.raises(bmc.errors.UnsupportedError, match="one vector .* 'x' is one of several"):
        bmc.filter(dbn, {"seen": [1.0]}, inputs={"which": [0]}, engine=engine, rng=0)
