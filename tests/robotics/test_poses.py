"""Poses: the group's laws, angles at and around the cut, means on the circle, and distributions of poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import bayesmc.distributions as d
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.pose_distributions import AndAngle, PoseNormal
from bayesmc.robotics.poses import (
    angle_between,
    between,
    compass,
    compose,
    inverse,
    mean_pose,
    pose_errors,
    transform,
    wrap,
)

TURN = 2 * np.pi
#: rate of false alarms of each goodness-of-fit test below, were its seed fresh
ALARM = 1e-6

EDGES = [0.0, np.pi, -np.pi, np.nextafter(np.pi, 0), np.nextafter(np.pi, 4), 3 * np.pi, -3 * np.pi]
ANGLE = st.floats(-50, 50) | st.sampled_from(EDGES)
HUGE = st.floats(-1e15, 1e15) | st.sampled_from(EDGES)
COORDINATE = st.floats(-100, 100)
POSE = st.tuples(COORDINATE, COORDINATE, ANGLE).map(np.array)
POINT = st.tuples(COORDINATE, COORDINATE).map(np.array)


def assert_same(a: np.ndarray, b: np.ndarray, atol: float = 1e-9) -> None:
    """Equal poses: headings are compared on the circle."""
    distance, heading = pose_errors(a, b)
    np.testing.assert_allclose(distance, 0.0, atol=atol)
    np.testing.assert_allclose(heading, 0.0, atol=1e-12)


@given(POSE, POSE, POSE)
def test_compose_is_associative(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    assert_same(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(POSE, POSE)
def test_inverse_and_between_undo(a: np.ndarray, b: np.ndarray) -> None:
    origin = np.zeros(3)
    assert_same(compose(a, inverse(a)), origin)
    assert_same(compose(inverse(a), a), origin)
    assert_same(inverse(inverse(a)), a)
    assert_same(compose(a, between(a, b)), b)
    assert_same(between(a, b), compose(inverse(a), b))
    assert_same(compose(origin, a), a)


@given(POSE, POSE, POINT)
def test_points_go_along_with_poses(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> None:
    found = transform(compose(a, b), point)
    np.testing.assert_allclose(found, transform(a, transform(b, point)), atol=1e-9)
    as_pose = np.append(point, 0.0)
    np.testing.assert_allclose(transform(a, point), compose(a, as_pose)[:2], atol=1e-12)


def test_compose_is_the_product_of_matrices() -> None:
    # the laws above hold for other groups, too: for one with headings clockwise, say
    def matrix(pose: np.ndarray) -> np.ndarray:
        x, y, h = pose
        return np.array([[np.cos(h), -np.sin(h), x], [np.sin(h), np.cos(h), y], [0, 0, 1]])

    a, b = np.array([1.0, -2.0, 2.5]), np.array([0.3, 4.0, 1.9])
    product = matrix(a) @ matrix(b)
    np.testing.assert_allclose(matrix(compose(a, b)), product, atol=1e-14)
    assert np.abs(matrix(compose(b, a)) - product).max() > 0.1


@given(HUGE)
def test_wrap_lands_inside_and_stays_there(angle: float) -> None:
    found = float(wrap(angle))
    assert -np.pi <= found < np.pi
    assert float(wrap(found)) == found
    exact = np.remainder(angle, TURN)  # exact in floating point, in [0, 2 pi)
    assert found in (angle, exact, exact - TURN)
    if abs(angle) < 50:
        assert np.cos(found) == pytest.approx(np.cos(angle), abs=1e-13)
        assert np.sin(found) == pytest.approx(np.sin(angle), abs=1e-13)


def test_wrap_at_the_cut() -> None:
    assert wrap([np.pi, -np.pi, 3 * np.pi]).tolist() == [-np.pi, -np.pi, -np.pi]
    below = np.nextafter(np.pi, 0)
    assert wrap([below, -below, 0.0]).tolist() == [below, -below, 0.0]
    assert abs(wrap(np.nextafter(-np.pi, -4))) <= np.pi


@given(ANGLE, ANGLE, st.integers(-3, 3))
def test_differences_ignore_full_turns(a: float, b: float, k: int) -> None:
    found = angle_between(a, b)
    assert -np.pi <= found < np.pi
    assert abs(wrap(a + found - b)) < 1e-12
    assert abs(wrap(angle_between(a + k * TURN, b) - found)) < 1e-12


@given(ANGLE)
def test_compass_is_its_own_inverse(heading: float) -> None:
    assert abs(angle_between(compass(compass(heading)), heading)) < 1e-12
    np.testing.assert_allclose(np.sin(compass(heading)), np.cos(heading), atol=1e-12)


@given(POSE, st.integers(1, 6), st.randoms(use_true_random=False))
def test_the_mean_moves_with_the_frame(frame: np.ndarray, count: int, chance: object) -> None:
    rng = np.random.default_rng(chance.randrange(2**32))  # type: ignore[attr-defined]
    poses = rng.normal(size=(count, 3)) * [3.0, 3.0, 0.4]
    weights = rng.random(count) + 0.01
    moved = mean_pose(compose(frame, poses), weights)
    assert_same(moved, compose(frame, mean_pose(poses, weights)))
    assert_same(moved, mean_pose(compose(frame, poses), 7.0 * weights))


def test_the_mean_goes_over_any_axis_with_any_weights() -> None:
    rng = np.random.default_rng(0)
    poses, weights = rng.normal(size=(5, 4, 3)), rng.random((5, 4))
    for axis in (0, 1, -1):
        found = mean_pose(poses, weights, axis=axis)
        first = axis % 2
        turned = np.moveaxis(poses, first, 0), np.moveaxis(weights, first, 0)
        for k in range(found.shape[0]):
            assert_same(found[k], mean_pose(turned[0][:, k], turned[1][:, k]))
    assert_same(mean_pose(poses), mean_pose(poses, np.ones(5)))
    alone = mean_pose(poses, [0, 0, 1, 0, 0])
    assert_same(alone, poses[2])
    around = np.array([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1]])
    assert abs(angle_between(mean_pose(around)[2], np.pi)) < 1e-12
    assert abs(angle_between(around[:, 2].mean(), np.pi)) > 3  # a plain mean points the other way


def test_errors_are_positive_distances_and_short_turns() -> None:
    estimate = np.array([[0.0, 3.0, 3.0], [1.0, 1.0, 0.5]])
    distance, heading = pose_errors(estimate, [4.0, 0.0, -3.0])
    np.testing.assert_allclose(distance, [5.0, np.sqrt(10.0)])
    np.testing.assert_allclose(heading, [6.0 - TURN, 3.5 - TURN])


def test_leading_axes_broadcast() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(7, 1, 3)), rng.normal(size=(4, 3))
    assert compose(a, b).shape == between(a, b).shape == (7, 4, 3)
    assert transform(a, rng.normal(size=(4, 2))).shape == (7, 4, 2)
    np.testing.assert_array_equal(compose(a, b)[3, 2], compose(a[3, 0], b[2]))


def test_faults_say_the_call() -> None:
    with pytest.raises(ShapeError, match=r"compose: .*\(2,\)"):
        compose([0.0, 1.0], [0.0, 0.0, 0.0])
    with pytest.raises(ShapeError, match="transform: a point"):
        transform(np.zeros(3), np.zeros(3))
    with pytest.raises(ShapeError, match="mean_pose: one pose"):
        mean_pose(np.zeros(3))
    with pytest.raises(ShapeError, match="mean_pose: weights"):
        mean_pose(np.zeros((4, 3)), np.ones(3))
    for weights in ([0.0, 0.0], [1.0, -0.5], [np.nan, 1.0], [np.inf, 1.0]):
        with pytest.raises(ParameterError, match="mean_pose: weights"):
            mean_pose(np.zeros((2, 3)), weights)


# ---- distributions ------------------------------------------------------------------------------

COV = np.array([[0.5, 0.1, 0.2], [0.1, 0.3, -0.25], [0.2, -0.25, 0.9]])


@pytest.mark.parametrize("share", [0.01, 1.0, 9.0])
def test_pose_normal_is_the_sum_over_turns(share: float) -> None:
    loc = np.array([1.0, -2.0, 3.0])
    dist, flat = PoseNormal(loc, share * COV), d.MvNormal(loc, share * COV)
    x = flat.sample(0, 200)
    turns = TURN * np.arange(-9, 10)[:, None, None] * [0, 0, 1]
    terms = flat.log_prob(x + turns)
    np.testing.assert_allclose(
        dist.log_prob(x), np.logaddexp.reduce(terms, axis=0), rtol=1e-9, atol=1e-9
    )
    for k in (-2, 1):
        np.testing.assert_allclose(dist.log_prob(x + [0, 0, k * TURN]), dist.log_prob(x), atol=1e-9)
    if share == 9.0:  # negative control: the nearest turn alone is not enough there
        assert np.abs(dist.log_prob(x) - terms.max(axis=0)).max() > 0.1


def test_pose_normal_draws_and_moments() -> None:
    """Whitened draws are normal: 3 Kolmogorov-Smirnov tests at 1e-6 each, one negative control."""
    loc = np.array([1.0, -2.0, 3.0])
    dist = PoseNormal(loc, 0.05 * COV)
    x = dist.sample(0, 20_000)
    assert (x[:, 2] >= -np.pi).all() and (x[:, 2] < np.pi).all()
    assert (x[:, 2] < 0).any() and (x[:, 2] > 0).any()
    off = x - loc
    off[:, 2] = wrap(off[:, 2])
    white = np.linalg.solve(np.linalg.cholesky(0.05 * COV), off.T)
    for row in white:
        assert stats.kstest(row, "norm").pvalue > ALARM
    assert stats.kstest(1.1 * white[0], "norm").pvalue < ALARM
    np.testing.assert_allclose(dist.cov, 0.05 * COV)
    np.testing.assert_allclose(dist.cov_root @ dist.cov_root.T, 0.05 * COV)
    np.testing.assert_allclose(dist.var, 0.05 * np.diag(COV))
    np.testing.assert_allclose(PoseNormal(loc + [0, 0, TURN], COV).mean, loc)


def test_pose_normal_batches_and_scales() -> None:
    loc = np.random.default_rng(0).normal(size=(6, 3))
    dist = PoseNormal(loc, scale_diag=[0.1, 0.2, 0.3])
    assert (dist.batch_shape, dist.event_shape, dist.mean.shape) == ((6,), (3,), (6, 3))
    assert dist.cov.shape == (6, 3, 3)
    same = PoseNormal(loc, np.diag([0.01, 0.04, 0.09]))
    np.testing.assert_allclose(dist.log_prob(np.zeros(3)), same.log_prob(np.zeros(3)))
    assert dist.sample_to(np.random.default_rng(0), (2, 6)).shape == (2, 6, 3)
    with pytest.raises(ShapeError, match="PoseNormal"):
        PoseNormal([0.0, 1.0], np.eye(2))
    with pytest.raises(ParameterError, match="cov"):
        PoseNormal([0.0, 1.0, 2.0], -np.eye(3))
    with d.marking_invalid():
        marked = PoseNormal([[np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]], scale_diag=np.ones(3))
    assert marked.invalid is not None
    assert marked.invalid.tolist() == [True, False]


def test_and_angle_is_its_parts() -> None:
    position, heading = d.MvNormal([1.0, 2.0], COV[:2, :2]), d.VonMises([0.5, 3.1], 40.0)
    dist = AndAngle(position, heading)
    x = dist.sample(0, 9)
    assert x.shape == (9, 2, 3)
    parts = position.log_prob(x[..., :2]) + heading.log_prob(x[..., 2])
    np.testing.assert_allclose(dist.log_prob(x), parts)
    np.testing.assert_allclose(dist.log_prob(x + [0, 0, TURN]), parts, atol=1e-9)
    np.testing.assert_allclose(dist.mean[1], [1.0, 2.0, 3.1])
    np.testing.assert_allclose(dist.cov_root @ np.matrix_transpose(dist.cov_root), dist.cov)
    np.testing.assert_allclose(dist.cov[0, :2, :2], COV[:2, :2])
    assert dist.support == PoseNormal(np.zeros(3), COV).support
    assert AndAngle(d.Normal(0.0, 1.0), heading).event_shape == (2,)
    with pytest.raises(ParameterError, match="second part must be an angle"):
        AndAngle(position, d.Normal(0.0, 1.0))


@pytest.mark.parametrize("call", [compose, between, pose_errors])
def test_poses_that_do_not_broadcast_are_named(call):
    with pytest.raises(
        ShapeError, match=rf"{call.__name__}: arrays of shape \(4, 3\) and \(5, 3\)"
    ):
        call(np.zeros((4, 3)), np.zeros((5, 3)))
    call(np.zeros((4, 1, 3)), np.zeros((5, 3)))


def test_points_that_do_not_broadcast_are_named():
    with pytest.raises(ShapeError, match=r"transform: arrays of shape \(4, 3\) and \(5, 2\)"):
        transform(np.zeros((4, 3)), np.zeros((5, 2)))


def test_no_poses_have_no_mean():
    for shape, axis in (((0, 3), 0), ((4, 0, 3), 1)):
        with pytest.raises(ShapeError, match=f"mean_pose: .* have no entry along axis {axis}"):
            mean_pose(np.zeros(shape), axis=axis)
    assert mean_pose(np.zeros((4, 0, 3))).shape == (0, 3)
