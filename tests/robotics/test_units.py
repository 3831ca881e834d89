"""Degrees for radians, swapped columns and transposed tables are named where the data can tell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError, EvidenceWarning, ParameterError
from bayesmc.robotics import (
    OdometryMotion,
    PoseNormal,
    bearing,
    bearing_to,
    compose,
    range_and_bearing,
    range_to,
)

MARKS = np.array([[3.0, 1.0], [-2.0, 4.0], [1.0, -3.0], [-4.0, -2.0]])
STEPS = 12
MOTION = np.tile([0.2, 0.0, 0.3], (STEPS, 1))
ENGINES = [bmc.ExtendedKalmanFilter(), bmc.ParticleFilter(200)]


def truth() -> np.ndarray:
    poses = [np.zeros(3)]
    for step in MOTION[1:]:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def readings() -> np.ndarray:
    return np.stack([range_to(truth()[:, None], MARKS), bearing_to(truth()[:, None], MARKS)], -1)


def robot(sensor: str) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("robot", plates={"mark": len(MARKS)})
    dbn.input("motion", event_shape=(3,))
    start = PoseNormal(np.zeros(3), scale_diag=[0.1, 0.1, 0.1])
    dbn.add("pose", lambda pose_prev, motion: OdometryMotion(
        pose_prev, motion, (0.05, 0.01, 0.05, 0.01)), initial=start)  # fmt: skip
    if sensor == "both":
        dbn.add("seen", lambda pose: range_and_bearing(pose, MARKS, 0.3, 0.1), plates="mark")
    else:
        dbn.add("seen", lambda pose: bearing(pose, MARKS, 0.1, outlier=0.05), plates="mark")
    return dbn


def filtered(sensor: str, seen: np.ndarray, engine: Any, motion: np.ndarray = MOTION) -> Any:
    return bmc.filter(
        robot(sensor), {"seen": seen}, inputs={"motion": motion}, engine=engine, rng=0
    )


@pytest.mark.parametrize("engine", ENGINES, ids=["ekf", "particles"])
@pytest.mark.parametrize("sensor", ["both", "bearing"])
def test_readings_as_they_should_be_are_no_news(sensor: str, engine: Any) -> None:
    """Warnings are errors: none comes, with readings left out, a turn more, or a range below 0."""
    seen = readings() if sensor == "both" else readings()[..., 1]
    seen[3, 1] = np.nan
    found = filtered(sensor, seen, engine)
    assert np.abs(found.mean("pose")[:, :2] - truth()[:, :2]).max() < 0.5
    seen[5, 0] += 2 * np.pi if sensor == "bearing" else 0.0
    filtered(sensor, seen, engine)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
@pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")
@pytest.mark.parametrize("engine", ENGINES, ids=["ekf", "particles"])
def test_bearings_in_degrees_and_swapped_columns_are_named(engine: Any) -> None:
    seen = readings()
    with pytest.warns(EvidenceWarning, match=r"'seen'.*radians.*np\.deg2rad"):
        filtered("both", seen * [1.0, np.degrees(1.0)], engine)
    with pytest.warns(EvidenceWarning, match=r"'seen'.*radians.*np\.deg2rad"):
        filtered("bearing", np.degrees(seen[..., 1]), engine)
    with pytest.warns(EvidenceWarning, match="swapped"):
        filtered("both", seen[..., ::-1], engine)
    with pytest.warns(EvidenceWarning, match="swapped"):  # of ranges beyond a full turn, too
        filtered("both", (seen * [5.0, 1.0])[..., ::-1], engine)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_static_nets_and_single_rows_are_looked_at() -> None:
    net = bmc.BayesNet(plates={"mark": len(MARKS)})
    net.add("pose", lambda: PoseNormal(np.zeros(3), scale_diag=[1.0, 1.0, 1.0]))
    net.add("seen", lambda pose: bearing(pose, MARKS, 0.1), plates="mark")
    with pytest.warns(EvidenceWarning, match="radians"):
        bmc.infer(net, {"seen": np.degrees(readings()[0, :, 1])}, engine=bmc.Importance(200), rng=0)
    engine = bmc.ExtendedKalmanFilter()
    with pytest.warns(EvidenceWarning, match="radians"):
        engine.step(
            engine.start(robot("bearing")), {"seen": np.degrees(readings()[0, :, 1])},
            inputs={"motion": MOTION[0]},
        )  # fmt: skip


def test_angles_that_add_up_are_no_degrees() -> None:
    """A heading that goes round and round and was unwrapped goes beyond what degrees do."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "a", lambda a_prev: bmc.WrappedNormal(a_prev + 0.5, 0.1), initial=bmc.VonMises(0.0, 0.0)
    )
    dbn.add("y", lambda a: bmc.WrappedNormal(a, 0.1))
    bmc.filter(dbn, {"y": 0.5 * np.arange(1000)}, engine=bmc.ParticleFilter(200), rng=0)
    with pytest.warns(EvidenceWarning, match=r"np\.remainder"):  # a doubt, with what to do
        bmc.filter(dbn, {"y": 0.5 * np.arange(100)}, engine=bmc.ParticleFilter(200), rng=0)


@pytest.mark.parametrize("engine", ENGINES, ids=["ekf", "particles"])
def test_turns_in_degrees_are_refused(engine: Any) -> None:
    with pytest.raises(ParameterError, match=r"turn of motion is in radians.*np\.deg2rad"):
        filtered("both", readings(), engine, MOTION * [1.0, 1.0, np.degrees(1.0)])
    OdometryMotion(np.zeros(3), [0.1, 0.0, 2 * np.pi], (0.1, 0.1, 0.1, 0.1))  # a turn is none


def test_tables_that_are_transposed_are_named() -> None:
    """By their labels where they are square, by the length of the others where they are not."""
    pd = pytest.importorskip("pandas")
    n = len(MARKS)
    dbn = bmc.DynamicBayesNet(plates={"mark": n})
    dbn.input("u", plates="mark")
    dbn.add("x", lambda x_prev, u: bmc.Normal(x_prev + u, 1.0), plates="mark",
            initial=bmc.Normal(0.0, 1.0))  # fmt: skip
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="mark")
    days = pd.date_range("2024-01-01", periods=n)
    right = pd.DataFrame(np.eye(n), index=days)
    engine = bmc.KalmanFilter()
    bmc.filter(dbn, {"y": right}, inputs={"u": np.eye(n)}, engine=engine)
    for wrong in (right.T, pd.DataFrame(np.eye(n), columns=pd.RangeIndex(n, name="time"))):
        with pytest.raises(
            EvidenceError, match=r"observations of 'y'.*time along its columns.*\.T"
        ):
            bmc.filter(dbn, {"y": wrong}, inputs={"u": np.eye(n)}, engine=engine)
        with pytest.raises(EvidenceError, match=r"inputs of 'u'.*time along its columns"):
            bmc.filter(dbn, {"y": right}, inputs={"u": wrong}, engine=engine)
    dbn.input("w")
    data = {"u": np.zeros((n, 9)), "w": np.zeros(9)}
    with pytest.raises(EvidenceError, match=r"'u' has shape \(4, 9\): is it transposed\?"):
        bmc.filter(dbn, {"y": np.zeros((9, n))}, inputs=data, engine=engine)
