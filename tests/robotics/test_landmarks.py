"""Sensors of landmarks: geometry, densities at the cut and in the tails, and use as plates of a template."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.landmarks import (
    bearing,
    bearing_to,
    cone_range,
    range_and_bearing,
    range_only,
    range_to,
    sonar,
)
from bayesmc.robotics.motion import VelocityMotion
from bayesmc.robotics.pose_distributions import AndAngle, PoseNormal
from bayesmc.robotics.poses import compose, pose_errors, transform, wrap
from bayesmc.robotics.steps import unicycle

TURN = 2 * np.pi
#: rate of false alarms of each goodness-of-fit test below, were its seed fresh
ALARM = 1e-6
#: four corners of a room, and one outside
MARKS = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0], [-3.0, 9.0]])

COORDINATE = st.floats(-50, 50)
POSE = st.tuples(COORDINATE, COORDINATE, st.floats(-9, 9)).map(np.array)
POINT = st.tuples(COORDINATE, COORDINATE).map(np.array)


# ---- geometry -------------------------------------------------------------------------------------


@given(POSE, st.floats(0.01, 50), st.floats(-np.pi, np.pi))
def test_what_is_put_somewhere_is_seen_there(pose: Any, distance: float, angle: float) -> None:
    landmark = transform(pose, distance * np.array([np.cos(angle), np.sin(angle)]))
    assert range_to(pose, landmark) == pytest.approx(distance, abs=1e-9)
    assert range_to(pose[:2], landmark) == pytest.approx(distance, abs=1e-9)
    assert abs(wrap(bearing_to(pose, landmark) - angle)) < 1e-9
    assert -np.pi <= bearing_to(pose, landmark) < np.pi
    assert abs(wrap(bearing_to(pose[:2], landmark) - angle - pose[2])) < 1e-9


@given(POSE, POSE, POINT)
def test_readings_do_not_depend_on_the_frame(frame: Any, pose: Any, landmark: Any) -> None:
    moved, there = compose(frame, pose), transform(frame, landmark)
    assert range_to(moved, there) == pytest.approx(range_to(pose, landmark), abs=1e-9)
    if range_to(pose, landmark) > 1e-3:
        assert abs(wrap(bearing_to(moved, there) - bearing_to(pose, landmark))) < 1e-7


def test_particles_and_landmarks_broadcast() -> None:
    poses = np.random.default_rng(0).normal(size=(7, 1, 3))
    assert range_to(poses, MARKS).shape == bearing_to(poses, MARKS).shape == (7, 5)
    assert bearing_to(poses[..., :2], MARKS).shape == (7, 5)
    assert range_to(poses, MARKS)[3, 2] == math.dist(poses[3, 0, :2], MARKS[2])
    assert bearing_to([1.0, 2.0, 0.5], [1.0, 2.0]) == -0.5  # on top of it: no warning, no NaN


def brute_cone(pose: np.ndarray, points: np.ndarray, opening: float, most: float) -> float:
    found = most
    for x, y in points:
        ahead = math.cos(pose[2]) * (x - pose[0]) + math.sin(pose[2]) * (y - pose[1])
        distance = math.hypot(x - pose[0], y - pose[1])
        if ahead >= distance * math.cos(opening / 2):
            found = min(found, distance)
    return found


def test_the_cone_finds_the_nearest_point_inside() -> None:
    rng = np.random.default_rng(2)
    points, poses = rng.uniform(-5, 5, (30, 2)), rng.uniform(-5, 5, (200, 3))
    for opening in (0.2, 1.0, TURN):
        found = cone_range(poses, points, opening, 4.0)
        expected = [brute_cone(pose, points, opening, 4.0) for pose in poses]
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert (cone_range(poses, points, 0.2, 4.0) == 4.0).any()
    nearest = range_to(poses[:, None], points).min(axis=1)
    np.testing.assert_allclose(cone_range(poses, points, TURN, 99.0), nearest)
    # negative control: the cone matters
    assert (np.abs(cone_range(poses, points, 0.2, 99.0) - nearest) > 0.1).mean() > 0.5
    assert cone_range(poses, np.zeros((0, 2)), 0.2, 4.0).tolist() == [4.0] * 200
    mounts = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, np.pi / 2]])
    both = cone_range(compose(poses[:, None], mounts), points, 0.5, 4.0)
    assert both.shape == (200, 2)
    np.testing.assert_array_equal(
        both[:, 1], cone_range(compose(poses, mounts[1]), points, 0.5, 4.0)
    )


# ---- densities ------------------------------------------------------------------------------------


@given(POSE, POINT, st.floats(-np.pi, np.pi), st.integers(-2, 2), st.sampled_from([0.0, 0.2]))
def test_a_full_turn_costs_nothing(
    pose: Any, landmark: Any, angle: float, k: int, outlier: float
) -> None:
    dist = bearing(pose, landmark, 0.5, outlier)
    value = dist.log_prob(angle)
    np.testing.assert_allclose(dist.log_prob(angle + k * TURN), value, rtol=1e-9)
    turned = bearing(pose + [0, 0, k * TURN], landmark, 0.5, outlier).log_prob(angle)
    np.testing.assert_allclose(turned, value, rtol=1e-9)


@pytest.mark.parametrize("outlier", [0.0, 0.1])
def test_bearings_across_the_cut(outlier: float) -> None:
    """A landmark behind: readings on either side of pi are near it, as a plain normal does not know."""
    behind = bearing([0.0, 0.0, 0.0], [-4.0, 0.0], 0.05, outlier)
    assert behind.log_prob(np.pi - 0.02) == pytest.approx(behind.log_prob(-np.pi + 0.02), rel=1e-9)
    assert behind.log_prob(-np.pi + 0.02) > 1.0
    assert bmc.Normal(np.pi, 0.05).log_prob(-np.pi + 0.02) < -1000
    grid = TURN * np.arange(4000) / 4000
    assert np.exp(behind.log_prob(grid)).mean() * TURN == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    "make",
    [
        lambda x: range_only(x, MARKS[2], 0.2, bias=0.5),
        lambda x: range_only(x, MARKS[2], 0.2, df=4.0),
        lambda x: sonar(x, MARKS, 0.2, 1.0, 6.0, df=4.0, outlier=0.2),
        lambda x: bearing(x, MARKS[2], 0.2, 0.3),
    ],
    ids=["normal", "student", "sonar", "bearing"],
)
def test_draws_fit(make: Any) -> None:
    dist = make(np.array([4.0, 3.0, 0.7]))
    draws = dist.sample(1, 20_000)
    assert stats.kstest(dist.cdf(draws), "uniform").pvalue > ALARM
    # negative control, at the same number of draws and rate: 5 cm, or 0.05 rad, away
    assert stats.kstest(dist.cdf(draws + 0.05), "uniform").pvalue < ALARM


def test_tails_are_as_heavy_as_asked() -> None:
    pose, mark = [0.0, 0.0, 0.0], [3.0, 4.0]
    assert range_only(pose, mark, 0.1).log_prob(7.0) < -190
    assert range_only(pose, mark, 0.1, df=3.0).log_prob(7.0) > -10
    assert bearing(pose, mark, 0.05).log_prob(-2.0) < -1500
    share = bearing(pose, mark, 0.05, outlier=0.1).log_prob(-2.0)
    assert share == pytest.approx(np.log(0.1 / TURN))
    assert sonar(pose, [mark], 0.1, 3.0, 8.0).log_prob(2.0) < -400
    lost = sonar(pose, [mark], 0.1, 3.0, 8.0, outlier=0.2).log_prob(2.0)
    assert lost == pytest.approx(np.log(0.2 / 8.0))
    # a share given as an array, by a parent, is a mixture wherever it is zero, too
    mixed = bearing(pose, mark, 0.05, outlier=np.array([0.0, 0.1]))
    np.testing.assert_allclose(mixed.log_prob(0.9)[0], bearing(pose, mark, 0.05).log_prob(0.9))


def test_range_and_bearing_is_both() -> None:
    poses = np.random.default_rng(0).normal(size=(6, 1, 3))
    options: dict[str, Any] = {"bias": 0.3, "df": 5.0, "outlier": 0.1}
    dist = range_and_bearing(poses, MARKS, 0.2, 0.1, **options)
    assert (dist.batch_shape, dist.event_shape) == ((6, 5), (2,))
    x = dist.sample(1, 4)
    parts = range_only(poses, MARKS, 0.2, bias=0.3, df=5.0).log_prob(x[..., 0])
    parts = parts + bearing(poses, MARKS, 0.1, 0.1).log_prob(x[..., 1])
    np.testing.assert_allclose(dist.log_prob(x), parts)
    np.testing.assert_allclose(dist.log_prob(x + [0.0, TURN]), parts, atol=1e-9)


def test_faults_say_the_call() -> None:
    with pytest.raises(ShapeError, match="range_to: a pose"):
        range_to([1.0], MARKS)
    with pytest.raises(ShapeError, match="bearing_to: a point"):
        bearing_to([0.0, 0.0, 0.0], [1.0, 2.0, 3.0])
    with pytest.raises(ShapeError, match=r"cone_range: points must have shape \(P, 2\)"):
        cone_range([0.0, 0.0, 0.0], [1.0, 2.0], 0.1, 1.0)
    with pytest.raises(ParameterError, match="cone_range: opening must be positive; got -1"):
        cone_range([0.0, 0.0, 0.0], MARKS, -1.0, 1.0)
    with pytest.raises(ParameterError, match="scale must be positive"):
        bearing([0.0, 0.0, 0.0], MARKS, 0.0)
    with pytest.raises(ParameterError, match="weights"):
        bearing([0.0, 0.0, 0.0], MARKS, 0.1, outlier=1.5)


# ---- in a net -------------------------------------------------------------------------------------

PRIOR_MEAN, PRIOR_SCALE = np.array([3.0, 2.5, 3.0]), np.array([0.8, 0.6, 0.4])
SENSORS: dict[str, Any] = {
    "bearing": lambda pose: bearing(pose, MARKS, 0.3),
    "bearing with outliers": lambda pose: bearing(pose, MARKS, 0.3, outlier=0.1),
    "absolute bearing": lambda pose: bearing(pose[..., :2], MARKS, 0.3),
    "range": lambda pose: range_only(pose, MARKS, 0.5),
    "range, heavy tails": lambda pose: range_only(pose, MARKS, 0.5, bias=0.2, df=3.0),
    "range and bearing": lambda pose: range_and_bearing(pose, MARKS, 0.5, 0.3, df=3.0, outlier=0.1),
}
QUERIES = {
    "x": lambda pose: pose[..., 0],
    "y": lambda pose: pose[..., 1],
    "cos": lambda pose: np.cos(pose[..., 2]),
    "sin": lambda pose: np.sin(pose[..., 2]),
}


def one_slice(sensor: Any) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("sensor", plates={"landmark": len(MARKS)})
    dbn.add("pose", PoseNormal(PRIOR_MEAN, scale_diag=PRIOR_SCALE))
    dbn.add("z", sensor, plates="landmark")
    return dbn


def on_a_grid(sensor: Any, row: np.ndarray) -> tuple[np.ndarray, float]:
    """Means of the queries and the log likelihood of a row by a sum over 60 x 60 x 48 poses."""
    steps = [np.linspace(m - 5 * s, m + 5 * s, n)
             for m, s, n in zip(PRIOR_MEAN, PRIOR_SCALE, (60, 60, 48), strict=True)]  # fmt: skip
    poses = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    cell = np.prod([s[1] - s[0] for s in steps])
    terms = sensor(poses).log_prob(np.nan_to_num(row))
    seen = ~np.isnan(row).reshape(len(row), -1).any(axis=1)
    prior = bmc.MvNormal(PRIOR_MEAN, scale_diag=PRIOR_SCALE).log_prob(poses[:, 0])
    log = prior + terms[:, seen].sum(axis=1)
    weights = np.exp(log - log.max())
    total = weights.sum()
    means = [(weights * f(poses[:, 0])).sum() / total for f in QUERIES.values()]
    return np.array(means), float(np.log(total * cell) + log.max())


@pytest.mark.parametrize("name", SENSORS)
def test_the_particle_filter_agrees_with_a_grid(name: str) -> None:
    """One slice with two landmarks unseen; 0.03 is some 6 standard errors of 40,000 particles.

    As a negative control, the grid that takes unseen landmarks for readings of zero is elsewhere.
    """
    sensor = SENSORS[name]
    dbn = one_slice(sensor)
    dbn.validate()
    row = dbn.sample(1, rng=4)["z"][0, 0].copy()
    row[[1, 3]] = np.nan
    found = bmc.filter(
        dbn, {"z": row[None]}, engine=bmc.ParticleFilter(40_000), rng=0, queries=QUERIES
    )
    means, log = on_a_grid(sensor, row)
    np.testing.assert_allclose([found.queries[q][0] for q in QUERIES], means, atol=0.03)
    assert found.log_marginal_likelihood == pytest.approx(log, abs=0.05)
    wrong, lower = on_a_grid(sensor, np.nan_to_num(row))
    assert np.abs(wrong - means).max() > 0.1 or abs(lower - log) > 0.5


def test_unseen_rows_cost_nothing() -> None:
    dbn = one_slice(SENSORS["range and bearing"])
    nothing = np.full((1, 5, 2), np.nan)
    found = bmc.filter(dbn, {"z": nothing}, engine=bmc.ParticleFilter(500), rng=0)
    assert found.log_marginal_likelihood == 0.0


def test_a_range_without_its_bearing_is_a_range() -> None:
    """Its two numbers are independent given the pose, so what is missing of a reading costs nothing, too."""
    half, alone = np.full((1, 5, 2), np.nan), np.full((1, 5), np.nan)
    half[0, 2, 0] = alone[0, 2] = 1.0
    ranges = one_slice(lambda pose: range_only(pose, MARKS, 0.5, df=3.0))
    found, right = (
        bmc.filter(dbn, {"z": rows}, engine=bmc.ParticleFilter(500), rng=0)
        for dbn, rows in ((one_slice(SENSORS["range and bearing"]), half), (ranges, alone))
    )
    assert right.log_marginal_likelihood < -0.1
    assert found.log_marginal_likelihood == pytest.approx(right.log_marginal_likelihood)


def test_robust_sensors_bear_a_wrong_landmark() -> None:
    """One of five landmarks is taken for another: the robust estimate stays, the plain one is drawn away."""
    truth = np.array([3.2, 2.7, 2.9])
    row = np.stack([range_to(truth, MARKS), bearing_to(truth, MARKS)], axis=-1)
    row[0] = row[2]

    def error(**options: Any) -> float:
        dbn = one_slice(lambda pose: range_and_bearing(pose, MARKS, 0.2, 0.1, **options))
        engine = bmc.ParticleFilter(40_000)
        found = bmc.filter(dbn, {"z": row[None]}, engine=engine, rng=0, queries=QUERIES).queries
        return math.hypot(found["x"][0] - truth[0], found["y"][0] - truth[1])

    assert error(df=2.0, outlier=0.1) < 0.2
    assert error() > 2 * error(df=2.0, outlier=0.1)


def test_a_bias_is_estimated_along_with_the_pose() -> None:
    dbn = bmc.DynamicBayesNet("beacons", plates={"landmark": len(MARKS)})
    start = AndAngle(
        bmc.Joint(bmc.Uniform(0.0, 8.0), bmc.Uniform(0.0, 6.0)), bmc.VonMises(0.0, 0.0)
    )
    alphas = [0.02, 0.0, 0.05, 0.05, 0.0, 0.0]
    dbn.add("pose", lambda pose_prev: VelocityMotion(pose_prev, 0.5, 0.3, 1.0, alphas, 0.01),
            initial=start)  # fmt: skip
    dbn.add("bias", lambda bias_prev: bmc.Normal(bias_prev, 0.02), initial=bmc.Normal(0.0, 2.0))
    dbn.add("z", lambda pose, bias: range_only(pose, MARKS, 0.2, bias, df=5.0), plates="landmark")
    dbn.validate()
    rng = np.random.default_rng(0)
    path = unicycle([4.0, 1.0, 0.0], 0.5, 0.3, np.arange(40.0))
    rows = range_to(path[:, None], MARKS) + 2.8 + rng.normal(0.0, 0.2, (40, 5))
    rows[rng.random(rows.shape) < 0.4] = np.nan
    found = bmc.filter(dbn, {"z": rows}, engine=bmc.ParticleFilter(20_000), rng=1, queries=QUERIES)
    assert found.mean("bias")[-1] == pytest.approx(2.8, abs=0.15)
    tail = slice(20, None)
    off = np.hypot(found.queries["x"] - path[:, 0], found.queries["y"] - path[:, 1])[tail]
    assert np.sqrt((off**2).mean()) < 0.25


@pytest.mark.parametrize("landmarks", ["constant", "node"])
def test_a_ring_of_sonars_finds_the_heading(landmarks: str) -> None:
    """Six sonars as a plate; the posts they see are a constant, or a node in a plate of their own."""
    mounts = np.stack([np.zeros(6), np.zeros(6), np.arange(6) * np.pi / 3], axis=-1)
    posts = np.array([[1.0, 1.5], [5.0, 0.5], [6.0, 4.0], [2.0, 5.0]])
    dbn = bmc.DynamicBayesNet("ring", plates={"sonar": 6, "post": 4})
    dbn.add("pose", PoseNormal([3.0, 2.5, 0.0], scale_diag=[0.05, 0.05, 2.0]))
    if landmarks == "node":
        dbn.add("post", lambda: bmc.MvNormal(posts, scale_diag=[1e-6, 1e-6]), plates="post")
        dbn.add("z", lambda pose, post: sonar(compose(pose, mounts), post, 0.1, 1.0, 5.0,
                                              outlier=0.05), plates="sonar")  # fmt: skip
    else:
        dbn.add("z", lambda pose: sonar(compose(pose, mounts), posts, 0.1, 1.0, 5.0, outlier=0.05),
                plates="sonar")  # fmt: skip
    dbn.validate()
    truth = np.array([3.0, 2.5, 1.9])
    row = cone_range(compose(truth, mounts), posts, 1.0, 5.0)
    row[4] = np.nan
    engine = bmc.ParticleFilter(20_000)
    found = bmc.filter(dbn, {"z": row[None]}, engine=engine, rng=0, queries=QUERIES).queries
    estimate = [found["x"][0], found["y"][0], np.arctan2(found["sin"][0], found["cos"][0])]
    assert abs(pose_errors(estimate, truth)[1]) < 0.3


# ---- beside the extended Kalman filter --------------------------------------------------------------


def gaussian_robot(kind: str) -> bmc.DynamicBayesNet:
    """Range and bearing as two nodes; the heading is an angle, also for Gaussian filters."""
    dbn = bmc.DynamicBayesNet("robot", plates={"landmark": len(MARKS)})
    start = PoseNormal([4.0, 1.0, 2.5], scale_diag=[0.2, 0.2, 0.1])
    options = {"df": 5.0} if kind == "heavy tails" else {}

    def pose(pose_prev: Any) -> Any:
        at = unicycle(pose_prev, 0.5, 0.3, 1.0)
        return PoseNormal(at, scale_diag=[0.05, 0.05, 0.03])

    dbn.add("pose", pose, initial=start)
    dbn.add("range", lambda pose: range_only(pose, MARKS, 0.15, **options), plates="landmark")
    share = 0.02 if kind == "heavy tails" else 0.0
    dbn.add("bearing", lambda pose: bearing(pose, MARKS, 0.07, share), plates="landmark")
    return dbn


@pytest.mark.parametrize("kind", ["normal", "heavy tails"])
def test_one_declaration_runs_by_extended_kalman_and_particle_filter(kind: str) -> None:
    dbn = gaussian_robot(kind)
    drawn = dbn.sample(60, rng=3)
    truth, rows = drawn["pose"][0], {n: drawn[n][0].copy() for n in ("range", "bearing")}
    unseen = np.random.default_rng(1).random((60, 5)) < 0.5
    for row in rows.values():
        row[unseen] = np.nan
    kalman = bmc.filter(dbn, rows, engine=bmc.ExtendedKalmanFilter())
    particles = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(10_000), rng=0)
    for found in (kalman, particles):
        distance, heading = pose_errors(found.mean("pose"), truth)
        assert np.sqrt((distance**2).mean()) < 0.12
        assert np.abs(heading).max() < 0.2
    if kind == "normal":  # where noise is normal the two are the same to the curvature of a range
        distance, heading = pose_errors(kalman.mean("pose"), particles.mean("pose"))
        assert distance.max() < 0.03
        assert np.abs(heading).max() < 0.02
        assert kalman.log_marginal_likelihood == pytest.approx(
            particles.log_marginal_likelihood, abs=2.0
        )


@pytest.mark.parametrize("call", [range_to, bearing_to])
def test_landmarks_that_do_not_broadcast_are_named(call: Any) -> None:
    with pytest.raises(
        ShapeError, match=rf"{call.__name__}: arrays of shape \(4, 3\) and \(5, 2\)"
    ):
        call(np.zeros((4, 3)), np.zeros((5, 2)))
