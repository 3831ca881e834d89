"""Poses by Gaussian filters: headings wrap number by number, covariances are roots, maybe singular."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.kalman.nonlinear import _joint_root
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import ModelMisfitWarning
from bayesmc.robotics.landmarks import bearing, range_and_bearing, range_only
from bayesmc.robotics.motion import OdometryMotion, VelocityMotion
from bayesmc.robotics.pose_distributions import PoseDistribution, PoseNormal
from bayesmc.robotics.poses import pose_errors
from bayesmc.robotics.steps import euler_step, unicycle

MARKS = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0], [-3.0, 9.0]])
STEPS = 100
#: the robot drives circles, so the heading passes the cut at pi every 42 slices
DRIVEN = np.tile([0.5, 0.15], (STEPS, 1))
START = PoseNormal([3.0, 2.0, 3.0], scale_diag=[0.2, 0.2, 0.1])


def by_velocity(pose_prev: Any, u: Any) -> Any:
    alphas = [0.02, 0.01, 0.02, 0.02, 0.001, 0.001]
    return VelocityMotion(pose_prev, u[..., 0], u[..., 1], 1.0, alphas)


def by_odometry(pose_prev: Any, u: Any) -> Any:
    ahead = unicycle(np.zeros(3), u[..., 0], u[..., 1], 1.0)
    return OdometryMotion(pose_prev, ahead, [0.02, 0.01, 0.02, 0.02])


def by_noise(pose_prev: Any, u: Any) -> Any:
    at = euler_step(pose_prev, u[..., 0], u[..., 1], 1.0)
    return PoseNormal(at, scale_diag=[0.05, 0.05, 0.05])


MOTIONS = {"velocity": by_velocity, "odometry": by_odometry, "noise": by_noise}


def robot(motion: str, sensor: str, start: Any = START) -> bmc.DynamicBayesNet:
    """Five landmarks, of which a reading is range and bearing: one node of vectors, or two of numbers."""
    dbn = bmc.DynamicBayesNet("robot", plates={"landmark": len(MARKS)})
    dbn.input("u", event_shape=(2,))
    dbn.add("pose", MOTIONS[motion], initial=start)
    if sensor == "joint":
        dbn.add("z", lambda pose: range_and_bearing(pose, MARKS, 0.15, 0.07), plates="landmark")
    else:
        dbn.add("r", lambda pose: range_only(pose, MARKS, 0.15), plates="landmark")
        dbn.add("b", lambda pose: bearing(pose, MARKS, 0.07), plates="landmark")
    return dbn


def drive(motion: str) -> tuple[np.ndarray, dict[str, dict[str, np.ndarray]]]:
    """True poses, and what was seen of two landmarks in five, for each sensor: the same readings."""
    drawn = robot(motion, "joint").sample(STEPS, inputs={"u": DRIVEN}, rng=1)
    seen = drawn["z"][0].copy()
    seen[np.random.default_rng(0).random(seen.shape[:-1]) < 0.6] = np.nan
    two = {"r": seen[..., 0].copy(), "b": seen[..., 1].copy()}
    return drawn["pose"][0], {"joint": {"z": seen}, "two nodes": two}


def root_mean_square(found: Any, truth: np.ndarray) -> float:
    return float(np.sqrt((pose_errors(found.mean("pose"), truth)[0] ** 2).mean()))


# ---- beside the particle filter -------------------------------------------------------------------


@pytest.mark.parametrize("motion", MOTIONS)
def test_three_filters_agree_on_one_declaration(motion: str) -> None:
    """Between runs of 12,000 particles the RMSE varies by 0.5 %, the evidence by 0.35 (standard deviations).

    The linearised evidence is off by up to 1.0 and the RMSE by 0.6 % in the mean of ten runs, so each bound
    is some three deviations away: false alarms in 5e-3 of the runs, were their seeds fresh.
    """
    truth, rows = drive(motion)
    particles = bmc.filter(
        robot(motion, "joint"), rows["joint"], inputs={"u": DRIVEN},
        engine=bmc.ParticleFilter(12_000), rng=0,
    )  # fmt: skip
    for engine in (bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()):
        found = {
            sensor: bmc.filter(robot(motion, sensor), rows[sensor], inputs={"u": DRIVEN}, engine=engine)
            for sensor in rows
        }  # fmt: skip
        joint, two = found.values()
        np.testing.assert_allclose(joint.mean("pose"), two.mean("pose"), atol=1e-8)
        np.testing.assert_allclose(joint.var("pose"), two.var("pose"), atol=1e-9)
        assert joint.log_marginal_likelihood == pytest.approx(two.log_marginal_likelihood, abs=1e-6)
        error = root_mean_square(joint, truth)
        assert error == pytest.approx(root_mean_square(particles, truth), rel=0.02)
        assert joint.log_marginal_likelihood == pytest.approx(
            particles.log_marginal_likelihood, abs=2.0
        )
        headings = pose_errors(joint.mean("pose"), particles.mean("pose"))[1]
        assert np.abs(headings).max() < 0.05


def test_smoothing_passes_the_cut() -> None:
    truth, rows = drive("velocity")
    for engine in (bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()):
        dbn, options = robot("velocity", "joint"), {"inputs": {"u": DRIVEN}, "engine": engine}
        filtered = bmc.filter(dbn, rows["joint"], **options)
        smoothed = bmc.smooth(dbn, rows["joint"], **options)
        assert root_mean_square(smoothed, truth) < 0.9 * root_mean_square(filtered, truth)
        heading = smoothed.mean("pose")[:, 2]
        assert np.abs(np.diff(heading)).max() > 6  # it jumps from one side of the cut to the other
        assert np.abs(pose_errors(smoothed.mean("pose"), truth)[1]).max() < 0.2
        assert ((heading >= -np.pi) & (heading < np.pi)).all()
        assert smoothed.mean("pose")[:, 0].max() > np.pi  # the other components stay as they are


# ---- angles number by number ----------------------------------------------------------------------


def test_a_heading_that_is_no_angle_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """The planted fault: with all components plain numbers innovations of 2 pi tear the filter away."""
    truth, rows = drive("noise")
    options = {"inputs": {"u": DRIVEN}, "engine": bmc.ExtendedKalmanFilter()}
    right = bmc.filter(robot("noise", "joint"), rows["joint"], **options)
    monkeypatch.setattr(
        Layout, "angles_of", lambda self, name: np.zeros(self.size(name), dtype=bool)
    )
    with pytest.warns(ModelMisfitWarning):
        wrong = bmc.filter(robot("noise", "joint"), rows["joint"], **options)
    assert wrong.log_marginal_likelihood < right.log_marginal_likelihood - 100
    assert root_mean_square(wrong, truth) > 5 * root_mean_square(right, truth)


def test_layouts_know_which_numbers_are_angles() -> None:
    dbn = robot("noise", "joint")
    belief = bmc.ExtendedKalmanFilter().step(
        bmc.ExtendedKalmanFilter().start(dbn), inputs={"u": DRIVEN[0]}
    )
    assert belief.layout.angles_of("pose").tolist() == [False, False, True]
    assert belief.layout.angles_of("z").tolist() == [False, True] * len(MARKS)


@pytest.mark.parametrize("engine", [bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()])
def test_a_start_of_another_family_is_matched_alike(engine: Any) -> None:
    """Slice 0 by a plain normal vector: what later slices say of the circle counts."""
    _, rows = drive("noise")
    flat = bmc.MvNormal([3.0, 2.0, 3.0], scale_diag=[0.2, 0.2, 0.1])
    found = [
        bmc.filter(robot("noise", "joint", start), rows["joint"], inputs={"u": DRIVEN}, engine=engine)
        for start in (START, flat)
    ]  # fmt: skip
    np.testing.assert_allclose(found[0].mean("pose"), found[1].mean("pose"), atol=1e-9)
    assert found[0].log_marginal_likelihood == pytest.approx(found[1].log_marginal_likelihood)


@pytest.mark.parametrize("engine", [bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()])
def test_a_pose_that_is_seen_costs_no_turns(engine: Any) -> None:
    """A whole pose is measured, in two conventions of the heading: full turns make no difference."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u", event_shape=(2,))
    dbn.add("pose", by_noise, initial=START)
    dbn.add("fix", lambda pose: PoseNormal(pose, scale_diag=[0.3, 0.3, 0.1]))
    drawn = dbn.sample(STEPS, inputs={"u": DRIVEN}, rng=2)
    fixes, rows = drawn["fix"][0], []
    for shift in (0.0, 2 * np.pi):
        turned = fixes.copy()
        turned[::3, 2] += shift
        turned[5] = np.nan
        rows.append(bmc.filter(dbn, {"fix": turned}, inputs={"u": DRIVEN}, engine=engine))
    np.testing.assert_allclose(rows[0].mean("pose"), rows[1].mean("pose"), atol=1e-9)
    assert root_mean_square(rows[0], drawn["pose"][0]) < 0.2


# ---- roots of covariances -------------------------------------------------------------------------


class Slide(PoseDistribution):
    """Noise along one direction alone: the covariance has rank one."""

    parameter_ndim = {"loc": 1}
    along = np.array([1.0, 0.5, 0.0])

    def __init__(self, loc: Any) -> None:
        self.loc = np.asarray(loc, dtype=float)
        self._set_batch(self.loc.shape[:-1])

    @property
    def mean(self) -> np.ndarray:
        return self.loc

    @property
    def cov_root(self) -> np.ndarray:
        root = np.zeros((*self.batch_shape, 3, 3))
        root[..., :, 1] = 0.3 * self.along
        return root

    def _sample(self, rng: np.random.Generator, shape: Any) -> np.ndarray:
        return self.loc + 0.3 * rng.standard_normal((*shape, 1)) * self.along


@pytest.mark.parametrize("engine", [bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()])
def test_a_singular_root_is_noise_in_fewer_directions(engine: Any) -> None:
    """The same robot with its one source of noise as a node of its own, by the exact filter."""
    drift = np.array([0.1, 0.0, 0.0])
    singular = bmc.DynamicBayesNet()
    singular.add("pose", lambda pose_prev: Slide(pose_prev + drift), initial=START)
    singular.add("x", lambda pose: bmc.Normal(pose[..., 0], 0.2))
    plain = bmc.DynamicBayesNet()
    plain.add("push", lambda: bmc.Normal(0.0, 0.3))
    plain.add(
        "at", lambda at_prev, push: at_prev + drift + push[..., None] * Slide.along,
        initial=lambda start: start,
    )  # fmt: skip
    plain.add("start", lambda: bmc.MvNormal([3.0, 2.0, 3.0], scale_diag=[0.2, 0.2, 0.1]))
    plain.add("x", lambda at: bmc.Normal(at[..., 0], 0.2))
    rows = {"x": [3.1, 3.4, None, 3.2, 3.3]}
    found = bmc.filter(singular, rows, engine=engine)
    exact = bmc.filter(plain, rows, engine=bmc.KalmanFilter())
    np.testing.assert_allclose(found.mean("pose"), exact.mean("at"), atol=1e-9)
    np.testing.assert_allclose(found.cov("pose"), exact.cov("at"), atol=1e-9)
    assert found.log_marginal_likelihood == pytest.approx(exact.log_marginal_likelihood, abs=1e-9)


@pytest.mark.parametrize("middle", [0.4, 0.0, -0.1])
def test_roots_of_sums_of_singular_covariances(middle: float) -> None:
    rng = np.random.default_rng(3)
    first, others = rng.standard_normal((2, 3, 3)), rng.standard_normal((6, 2, 3, 3))
    first[..., 2], others[..., 2] = 0.0, 0.0
    first[0, 2], others[:, 0, 2] = 0.0, 0.0
    wanted = middle * first @ np.matrix_transpose(first)
    wanted = wanted + 0.3 * (others @ np.matrix_transpose(others)).sum(axis=0)
    root = _joint_root(first, middle, others, 0.3)
    np.testing.assert_allclose(root @ np.matrix_transpose(root), wanted, atol=1e-12)


def test_what_is_no_covariance_has_no_root() -> None:
    first, others = np.eye(3)[None] * 3.0, np.ones((6, 1, 3, 3)) * 0.01
    assert _joint_root(first, -1.0, others, 0.1) is None


def test_vectors_without_a_root_are_refused() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("p", lambda p_prev: bmc.Dirichlet(10 * p_prev), initial=bmc.Dirichlet([1.0, 2.0]))
    dbn.add("y", lambda p: bmc.Normal(p[..., 0], 0.1))
    why = bmc.ExtendedKalmanFilter().unsupported(dbn, {"y": [0.1, 0.4]})
    assert why is not None
    assert "cov_root" in why and why.endswith("use ParticleFilter")
