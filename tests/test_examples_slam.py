"""Landmark SLAM: what its shares count, and that readings of an instant exclude each other."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bayesmc.robotics import compose
from examples import slam_association, slam_landmarks
from examples.robot_landmarks import marks_seen, write_mrclam
from examples.slam_landmarks import Readings, by_camera, instants, turned


def made(which: list[int], times: list[float], seen: Any = None) -> Readings:
    """One reading in a slice, by a robot that stands still at the origin."""
    n = len(which)
    seen = np.zeros((n, 2)) if seen is None else np.asarray(seen)
    still = np.tile(1e-8 * np.eye(3), (n, 1, 1))
    rows, bend, zero = np.zeros((n, 3)), np.zeros((n, 3, 2)), np.zeros(n)
    return Readings(np.array(times), rows, bend, still, zero, zero, np.array(which), seen, rows)


def test_shares_by_hand() -> None:
    """Numbers 7 and 2 are landmarks 0 and 1; number 3 is a double of landmark 1, and one is missed."""
    readings = made([0, 0, 1, 1, 1, -1, 2, 1], list(range(8)))
    numbers = np.array([7, 7, 2, 2, 3, -1, 7, -1])
    marks = np.array([[0.0, 0.0], [5.0, 0.0], [0.1, 0.0]])
    assert slam_landmarks.share_right(numbers, readings, 3) == pytest.approx(4 / 7)
    assert slam_landmarks.share_near(numbers, readings, marks) == pytest.approx(6 / 7)


def test_who_knows_all_is_right_where_landmarks_are_apart() -> None:
    marks = np.array([[2.0, 0.0], [2.0, 2.0], [2.0, 0.1]])
    place = [by_camera(np.zeros(3), marks[k], 0.0) for k in (0, 1, 0)]
    found = slam_landmarks.ceilings(made([0, 1, 2], [0.0, 0.0, 1.0], place), marks)
    assert found["told all: nearest"] == pytest.approx(
        2 / 3
    )  # the third is read as if it were the first
    both = slam_landmarks.ceilings(made([0, 1, 2], [0.0, 0.0, 0.0], place), marks)
    assert both["each once"] == 1.0  # but not where that one is read, too


def test_readings_of_an_instant_are_of_different_landmarks() -> None:
    """Two stand 6 cm apart, less than readings tell; a robot that stands still reads both in each instant."""
    times = np.repeat(np.arange(12.0), 2)
    noise = np.random.default_rng(0).normal(size=(24, 2)) * [0.02, 0.01]
    seen = np.tile([[3.0, 0.0], [3.0, 0.02]], (12, 1)) + noise
    readings = made([0, 1] * 12, times.tolist(), seen)
    drive: Any = SimpleNamespace(start=np.zeros(3))
    engine = slam_landmarks.fast_slam(8)
    numbers, _ = slam_landmarks.best_way(slam_landmarks.without_labels(readings, drive, engine))
    assert (numbers[::2] != numbers[1::2]).all()
    assert set(numbers.tolist()) <= {-1, 0, 1}


def test_looking_back_mends_what_was_taken_for_another() -> None:
    """Four landmarks; a fifth of the readings of two that stand .3 m apart are swapped, one is of nothing.

    These are .1 rad apart, eight standard deviations of a bearing.
    """
    rng = np.random.default_rng(5)
    marks = np.array([[3.0, 0.0], [3.0, 0.3], [0.0, 3.0], [-3.0, -1.0]])
    which = rng.integers(4, size=240)
    poses = np.ones((240, 5))
    poses[:, :2] = rng.uniform(-0.5, 0.5, (240, 2))
    way = marks[which] - poses[:, :2]
    poses[:, 2] = np.arctan2(way[:, 1], way[:, 0]) + rng.uniform(-0.4, 0.4, 240)
    seen = np.stack(by_camera(poses, marks[which], 0.0), axis=-1)
    seen += rng.normal(size=seen.shape) * [0.06, 0.012]
    seen[17] = 9.0, -1.4
    readings = made(which.tolist(), list(range(240)), seen)
    swapped = np.where((rng.random(240) < 0.2) & (which < 2), 1 - which, which)
    numbers, found = slam_landmarks.looked_back(swapped, poses, readings)
    assert (swapped != which).sum() > 15
    assert np.flatnonzero(numbers != which).tolist() == [17]
    assert numbers[17] == -1
    np.testing.assert_allclose(found[:4], marks, atol=0.06)  # five standard deviations of the worst
    # the map is the most probable one: no landmark moved on its own is better
    again = slam_landmarks.marks_on(poses, numbers, readings)
    np.testing.assert_allclose(again, found, atol=1e-6)
    np.testing.assert_allclose(found[4:], 0.0, atol=1e-6)  # nobody has read these


def test_a_camera_reads_depths_and_is_late() -> None:
    deep, angle = by_camera(np.array([1.0, 0.0, np.pi / 2]), np.array([0.0, 2.0]), 0.5)
    assert deep == pytest.approx(1.02 * 2.0 + 0.04)
    assert angle == pytest.approx(np.arctan2(1.0, 2.0) + 0.033 * 0.5)


def test_the_way_between_readings_is_what_the_stretches_add_up_to() -> None:
    """Motion to rounding; how it moves with the gains, and its covariance, against differences and draws."""
    rng = np.random.default_rng(3)
    motion = np.column_stack(
        [rng.uniform(0.1, 0.3, 6), rng.normal(0, 0.02, 6), rng.normal(0, 0.2, 6)]
    )
    effort = np.column_stack([motion[:, 0], np.abs(motion[:, 2]), np.ones(6)])
    seen = np.full((6, 2, 2), np.nan)
    seen[5, 1] = 2.0, 0.1
    drive: Any = SimpleNamespace(
        times=np.arange(6.0), motion=motion, effort=effort, seen=seen, truth=np.zeros((6, 3))
    )
    found = instants(drive)
    assert len(found.times) == 2
    assert found.which.tolist() == [[-1], [1]]

    def gone(gain: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """What stands for arcs here are arcs: a turn's gain bends a stretch by half of what it adds."""
        pose = np.zeros(3)
        for k in range(1, 6):
            bent = turned(0.5 * (gain[1] - 1) * motion[k, 2])[:2, :2] @ motion[k, :2]
            step = np.array([*(gain[0] * bent), gain[1] * motion[k, 2]])
            pose = pose + turned(pose[2]) @ (step + noise[k])
        return pose

    still = np.zeros((6, 3))
    np.testing.assert_allclose(found.motion[1], gone(np.ones(2), still), rtol=1e-12)
    for k in range(2):
        some = 1e-6 * np.eye(2)[k]
        slope = (gone(1 + some, still) - gone(1 - some, still)) / 2e-6
        np.testing.assert_allclose(found.bend[1, :, k], slope, rtol=1e-6, atol=1e-9)
    # 4,000 draws tell a covariance to 1 in 45: entries are held to five of that (false alarms below 1e-5)
    place = slam_landmarks.PER_METRE * effort[:, 0]
    heading = slam_landmarks.PER_RADIAN * effort[:, 1] + slam_landmarks.PER_SECOND * effort[:, 2]
    noise = rng.normal(size=(4_000, 6, 3)) * np.sqrt(np.column_stack([place, place, heading]))
    cov = np.cov(np.array([gone(np.ones(2), n) for n in noise]).T)
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert (np.abs(found.noise[1] - cov) < 0.11 * scale).all()


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")  # six particles
def test_runs_are_averaged_each_counting_the_same(tmp_path: Path) -> None:
    """Variances are those within the runs, and what their means are apart."""
    drive = marks_seen(write_mrclam(tmp_path, 30.0, depths=True), 1)
    readings = instants(drive, 4.0)
    found = slam_landmarks.averaged(readings, drive, 6, 3)
    engine = slam_landmarks.fast_slam(6)
    own = [slam_landmarks.with_labels(readings, drive, engine, seed=seed) for seed in range(3)]
    for name in ("pose", "mark"):
        means = np.stack([f.mean(name) for f in own])
        assert (means[0] != means[1]).any()
        np.testing.assert_allclose(found.mean(name), means.mean(axis=0), rtol=1e-12)
        apart = np.square(means - means.mean(axis=0)).mean(axis=0)
        within = sum(f.var(name) for f in own) / 3
        np.testing.assert_allclose(found.var(name), within + apart, rtol=1e-12, atol=1e-15)


def test_particles_of_kalman_filters_close_a_loop() -> None:
    """Twice around a square of 4 m whose wheels turn 3 % too far a side, past five landmarks: none met twice.

    Two stand .3 m apart, six standard deviations of what is read. The map is off by the first turns, which
    nothing tells later; after the best turn and shift it is not.
    """
    rng = np.random.default_rng(4)
    marks = np.array([[2.0, 1.5], [2.3, 1.5], [5.5, 2.0], [2.0, 5.5], [-1.5, 2.0]])
    pose, rows = np.zeros(3), []
    for k in range(160):
        step = np.array([0.2, 0.0, 0.0]) if k % 20 < 16 else np.array([0.0, 0.0, np.pi / 8])
        pose = compose(pose, step)
        told = step * [1.02, 1.0, 1.03] + rng.normal(size=3) * [0.01, 0.01, 0.01]
        deep, angle = by_camera(pose, marks, 0.0)
        sight = np.flatnonzero((deep > 0.5) & (deep < 5.0) & (np.abs(angle) < 0.8))
        own = [(k, m, deep[m], angle[m]) for m in rng.permutation(sight)] or [(k, -1, np.nan, 0.0)]
        rows += [(*o, told if o is own[0] else np.zeros(3), pose) for o in own]
    times, which, deep, angle, motion, truth = (np.array(a) for a in zip(*rows, strict=True))
    first = np.diff(times, prepend=-1.0) > 0
    seen = np.stack([deep, angle], axis=-1) + rng.normal(size=(len(rows), 2)) * [0.04, 0.008]
    noise = np.where(first[:, None, None], np.diag([2e-4, 2e-4, 4e-4]), 1e-8 * np.eye(3))
    zero = np.zeros(len(rows))
    bend = np.zeros((len(rows), 3, 2))
    bend[:, 0, 0], bend[:, 2, 1] = motion[:, 0], motion[:, 2]
    readings = Readings(
        times.astype(float), motion, bend, noise, 0.2 * first, zero, which, seen, truth
    )
    drive: Any = SimpleNamespace(start=np.zeros(3))
    found = slam_association.mapped(readings, drive, 20)
    numbers, _ = slam_landmarks.best_way(found)
    assert set(which.tolist()) == {-1, 0, 1, 2, 3, 4}
    assert slam_landmarks.share_right(numbers, readings, 5) > 0.99
    assert found.mean("met")[-1] == pytest.approx(5, abs=0.01)
    of = [int(np.bincount(numbers[which == m]).argmax()) for m in range(5)]
    assert slam_landmarks.map_rmse(found.mean("mark")[-1][of], marks) < 0.1
    assert readings.rmse(found.mean("pose")) < 0.5
