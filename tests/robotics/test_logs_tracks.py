"""Keyframes, poses at given times, merging and stacking."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesmc.errors import ShapeError
from bayesmc.robotics.logs import (
    GroundTruth,
    Laser,
    Measurement,
    Odometry,
    Velocity,
    keyframes,
    merge,
    pose_at,
    stack,
)
from bayesmc.robotics.poses import compose, wrap


def scan(t, x, y, heading):
    return Laser(t, [1.0], [0.0], [x, y, heading])


class TestKeyframes:
    def test_slow_motion_adds_up(self):
        scans = [scan(k, 0.07 * k, 0.0, 0.0) for k in range(10)]
        found = list(keyframes(scans, distance=0.2, angle=1.0))
        assert [key.laser.t for key in found] == [0, 3, 6, 9]
        assert found[0].motion.tolist() == [0.0, 0.0, 0.0]
        np.testing.assert_allclose(
            [key.motion for key in found[1:]], [[0.21, 0, 0]] * 3, atol=1e-12
        )

    def test_turning_on_the_spot_across_pi(self):
        scans = [scan(k, 0.0, 0.0, wrap(3.0 + 0.1 * k)) for k in range(7)]
        found = list(keyframes(scans, distance=1.0, angle=0.25))
        assert [key.laser.t for key in found] == [0, 3, 6]
        np.testing.assert_allclose([key.motion[2] for key in found[1:]], [0.3, 0.3])

    def test_a_whole_turn_between_scans_is_none(self):
        scans = [scan(0, 0, 0, 0.1), scan(1, 0, 0, 0.1 + 2 * math.pi)]
        assert len(list(keyframes(scans))) == 1

    @given(st.lists(st.tuples(*[st.floats(-3, 3)] * 3), min_size=1, max_size=20))
    def test_the_motions_compose_to_the_last_pose(self, poses):
        scans = [scan(float(k), *pose) for k, pose in enumerate(poses)]
        found = list(keyframes(scans, 0.5, 0.5))
        at = scans[0].pose
        for key in found:
            at = compose(at, key.motion)
            np.testing.assert_allclose(at[:2], key.laser.pose[:2], atol=1e-9)
            assert abs(wrap(at[2] - key.laser.pose[2])) < 1e-9

    def test_other_records_are_passed_over(self):
        records = [Odometry(0.0, [5.0, 0.0, 0.0]), scan(1.0, 0.0, 0.0, 0.0)]
        assert [key.laser.t for key in keyframes(records)] == [1.0]
        assert list(keyframes([])) == []

    def test_records_without_a_scan(self):
        found = keyframes(iter([Odometry(0.0, [5.0, 0.0, 0.0]), Velocity(1.0, 0.0, 0.0)]))
        with pytest.raises(
            ValueError, match="no record is a Laser, the last one is of type Velocity"
        ):
            list(found)

    @pytest.mark.parametrize("wrong", ["drive.log", b"drive.log", 3, None])
    def test_no_records_are_refused_at_once(self, wrong):
        with pytest.raises(TypeError, match="keyframes: give records, such as"):
            keyframes(wrong)

    def test_things_that_are_no_records(self):
        with pytest.raises(TypeError, match="one is of type ndarray"):
            list(keyframes([scan(0.0, 0, 0, 0), np.zeros(3)]))

    def test_thresholds(self):
        scans = [scan(k, 0.0, 0.0, 0.0) for k in range(3)]
        assert len(list(keyframes(scans, 0.0, 0.0))) == 3
        with pytest.raises(ValueError, match="distance=-1"):
            keyframes(scans, -1)
        with pytest.raises(ValueError, match="angle=nan"):
            keyframes(scans, 0.1, math.nan)


class TestPoseAt:
    track = [
        GroundTruth(0.0, [0.0, 0.0, 3.0]),
        GroundTruth(1.0, [2.0, -1.0, -3.0]),
        GroundTruth(5.0, [2.0, 3.0, -3.5]),
    ]

    def test_headings_go_the_short_way(self):
        found = pose_at(self.track, [0.0, 0.5, 1.0, 3.0, 5.0])
        np.testing.assert_allclose(
            found[:, :2], [[0, 0], [1, -0.5], [2, -1], [2, 1], [2, 3]], atol=1e-12
        )
        # 3.0 to -3.0 is a turn of 0.283 through pi, not of -6
        expected = wrap(np.array([3.0, 3.0 + (math.pi - 3.0), -3.0, -3.25, -3.5]))
        np.testing.assert_allclose(np.abs(wrap(found[:, 2] - expected)), 0.0, atol=1e-12)
        assert np.all((found[:, 2] >= -math.pi) & (found[:, 2] < math.pi))

    def test_nothing_is_extrapolated(self):
        found = pose_at(self.track, [-0.01, 5.01, math.nan, math.inf])
        assert np.isnan(found).all()

    def test_gaps(self):
        found = pose_at(self.track, [0.5, 1.0, 3.0, 5.0], max_gap=2.0)
        assert np.isnan(found).all(axis=1).tolist() == [False, False, True, False]

    def test_shapes(self):
        assert pose_at(self.track, 0.5).shape == (3,)
        assert pose_at(self.track, np.zeros((2, 4))).shape == (2, 4, 3)
        assert pose_at(self.track, []).shape == (0, 3)

    def test_one_record_and_repeated_times(self):
        one = [Odometry(1.0, [1.0, 2.0, 3.0])]
        found = pose_at(one, [0.9, 1.0, 1.1])
        assert np.isnan(found).all(axis=1).tolist() == [True, False, True]
        np.testing.assert_allclose(found[1], [1.0, 2.0, 3.0])
        twice = [*one, *one, Odometry(2.0, [2.0, 2.0, 3.0])]
        np.testing.assert_allclose(pose_at(twice, [1.0, 1.5])[:, 0], [1.0, 1.5])

    def test_errors(self):
        with pytest.raises(ValueError, match=r"sort it with merge\(track\)"):
            pose_at(self.track[::-1], 1.0)
        with pytest.raises(ShapeError, match="none at all"):
            pose_at([], 1.0)

    @given(st.lists(st.floats(0, 5), max_size=10))
    def test_it_agrees_with_interpolation_of_unwrapped_headings(self, times):
        columns = stack(self.track)
        found = pose_at(self.track, times)
        for k in (0, 1):
            slow = np.interp(times, columns["t"], columns["pose"][:, k])
            np.testing.assert_allclose(found[:, k], slow, atol=1e-12)
        heading = np.interp(times, columns["t"], np.unwrap(columns["pose"][:, 2]))
        np.testing.assert_allclose(wrap(found[:, 2] - heading), 0.0, atol=1e-12)


def test_merge_is_stable():
    steps = [Velocity(2.0, 1.0, 0.0), Velocity(1.0, 0.5, 0.0)]
    seen = (Measurement(t, 7, 1.0, 0.0) for t in (1.0, 1.5))
    merged = merge(steps, seen)
    assert [(type(r).__name__[0], r.t) for r in merged] == [
        ("V", 1.0), ("M", 1.0), ("M", 1.5), ("V", 2.0),
    ]  # fmt: skip
    assert merge() == ()


def test_stack():
    columns = stack(scan(float(k), k, 0.0, 0.0) for k in range(3))
    assert columns["t"].tolist() == [0.0, 1.0, 2.0]
    assert columns["pose"].shape == (3, 3) and columns["ranges"].shape == (3, 1)
    assert columns["max_range"].tolist() == [80.0] * 3
    subjects = stack([Measurement(0.0, 7, 1.0, 0.0)])["subject"]
    assert subjects.dtype.kind == "i"
    with pytest.raises(ShapeError, match="there are Laser, Odometry"):
        stack([scan(0.0, 0, 0, 0), Odometry(0.0, [0.0, 0.0, 0.0])])
    with pytest.raises(ShapeError, match="ranges is not equally long"):
        stack([scan(0.0, 0, 0, 0), Laser(0.0, [1.0, 2.0], [0.0, 1.0], [0.0, 0.0, 0.0])])
