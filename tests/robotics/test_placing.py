"""A filter sure of the wrong place shows under the likelihood field, too; floors are where robots drive."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ModelError, ModelMisfitWarning, ShapeError
from bayesmc.robotics import (
    FreeSpace,
    OccupancyGrid,
    PoseNormal,
    between,
    check_poses,
    compose,
    fit_field,
    fit_floor,
    fit_odometry,
)
from examples import robot_logs

LAST, FIRST = slice(-90, None), 40


@pytest.fixture(scope="module", params=[1, pytest.param(2, marks=pytest.mark.thorough)])
def learned(request: pytest.FixtureRequest) -> tuple[robot_logs.Log, Any]:
    """A floor that nobody tuned anything to; settings from the end of its log, questions about its start."""
    log = robot_logs.generated(every=6, seed=request.param)
    truth = log.truth
    assert truth is not None
    noise = fit_odometry(log.motion[LAST], between(truth[-91:-1], truth[LAST]))
    fit = fit_field(robot_logs.field(log, 0.2, 1.0), log.scans[LAST], truth[LAST], log.angles)
    return robot_logs.first(log, FIRST)._replace(noise=noise), fit


def followed(log: robot_logs.Log, fit: Any, start: np.ndarray) -> np.ndarray:
    """Poses by a filter that is told a start, under the field that was learned."""
    near = PoseNormal(start, scale_diag=[0.3, 0.3, 0.1])
    net = robot_logs.net(log, near, lambda pose: fit.field.given(pose, log.angles))
    return robot_logs.localized(net, log, bmc.ParticleFilter(400), 0).mean("pose")


def test_a_filter_in_the_right_place_is_not_lost(learned) -> None:
    """And a window in the middle that somebody stood in front of does not matter at the end."""
    log, fit = learned
    poses = followed(log, fit, log.truth[0])
    assert robot_logs.errors(log, poses)[-1] < 0.5
    found = check_poses(fit, log.scans, poses)
    assert not found.lost.any()
    assert found.known < found.limit < found.anywhere
    crowd = log.scans.copy()
    crowd[5:8] = 0.5
    assert not check_poses(fit, crowd, poses).lost[-1]


@pytest.mark.parametrize(
    "off", [(0.0, 0.0, np.pi), (4.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2)],
    ids=["turned", "in the next room", "sideways"],
)  # fmt: skip
def test_a_filter_in_a_wrong_place_is_lost(learned, off: tuple[float, float, float]) -> None:
    log, fit = learned
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the filter's own, which need not come
        poses = followed(log, fit, compose(log.truth[0], off))
    assert robot_logs.errors(log, poses)[-1] > 1.0
    with pytest.warns(ModelMisfitWarning, match="somewhere else"):
        found = check_poses(fit, log.scans, poses)
    assert found.lost[-1] and found.unexplained[-20:].mean() > found.limit


def test_what_does_not_go_together_is_refused(learned) -> None:
    log, fit = learned
    with pytest.raises(ShapeError, match="beams"):
        check_poses(fit, log.scans[:, :-1], log.truth)
    with pytest.raises(ShapeError, match="check_poses"):
        check_poses(fit, log.scans, log.truth[:-1])
    with pytest.raises(ValueError, match="window"):
        check_poses(fit, log.scans, log.truth, window=0)
    with pytest.raises(TypeError, match="fit_field"):
        check_poses(fit.field, log.scans, log.truth)


@pytest.mark.parametrize(
    "change",
    [lambda p: p[:, [1, 0, 2]], lambda p: p * [1.0, 1.0, 180 / np.pi], lambda p: p + [5.0, 3.0, 0.0],
     lambda p: np.roll(p, 30, axis=0)],
    ids=["swapped", "degrees", "another frame", "out of step"],
)  # fmt: skip
def test_nothing_is_learned_of_poses_that_are_wrong(learned, change: Any) -> None:
    _, fit = learned
    with pytest.raises(ModelError, match="x before y"):
        fit_field(fit.field, fit.ranges, change(fit.poses), fit.angles)


def test_units_of_ranges_and_motions_are_noticed(learned) -> None:
    log, fit = learned
    with pytest.raises(ModelError, match="in metres"):
        fit_field(fit.field, 1000 * fit.ranges, fit.poses, fit.angles)
    moved = between(log.truth[:-1], log.truth[1:])
    fit_odometry(log.motion[1:], moved)
    for motion, known in (
        (log.motion[1:], moved * [1.0, 1.0, 180 / np.pi]),
        (log.motion[1:], moved[:, [1, 0, 2]]),
        (log.truth[1:], moved),
    ):
        with pytest.warns(ModelMisfitWarning, match="from one pose to the next"):
            fit_odometry(motion, known)


def test_a_scan_leaves_half_of_a_search(learned) -> None:
    """The effective share in the median over scans, by other poses than the search took: .35 to .65."""
    log, fit = learned
    floor = fit_floor(log.grid, fit.poses)
    plain = fit.searching(10**9, floor)  # so many that no particle is far from the truth
    spots = plain.given(floor.sample(5, sample_shape=3000), log.angles)
    share = []
    for scan in fit.ranges[::5]:
        log_weights = spots.log_prob(scan)
        weights = np.exp(log_weights - log_weights.max())
        share.append(weights.sum() ** 2 / (weights**2).sum() / len(weights))
    assert 0.35 < np.median(share) < 0.65
    few = fit.searching(300, floor)
    assert few.tempering <= plain.tempering < fit.field.tempering
    assert fit.searching(300, floor.area).tempering == pytest.approx(few.tempering, rel=0.3)


def test_a_floor_is_where_the_robot_drove(rng: np.random.Generator) -> None:
    """Not what was seen through a window, whose cells were looked at now and then."""
    hits, passes = np.zeros((60, 40)), np.full((60, 40), 50.0)
    hits[:, 20] = 60.0  # a wall
    passes[:, 21:] = rng.integers(1, 4, (60, 19))
    grid = OccupancyGrid.from_counts(hits, passes, 0.1, threshold=0.45)
    poses = rng.uniform([0.0, 0.0, -3.0], [6.0, 2.0, 3.0], (100, 3))
    floor = fit_floor(grid, poses)
    assert floor.area == pytest.approx(12.0)
    assert FreeSpace(grid).area == pytest.approx(23.4)  # what a search would begin on otherwise
    poses[0] = [3.0, 3.0, 0.0]  # one that strayed
    assert fit_floor(grid, poses).area == pytest.approx(12.0)
    assert fit_floor(grid, poses[1:], clearance=0.5).area < 10.0
    sure = OccupancyGrid(np.where(hits > 0, 1.0, 0.0), 0.1)  # a map of noughts and ones
    assert fit_floor(sure, poses).area == pytest.approx(FreeSpace(sure).area)
    with pytest.raises(ModelError, match="x before y"):
        fit_floor(grid, poses + [50.0, 0.0, 0.0])
    with pytest.raises(ShapeError, match="20 poses"):
        fit_floor(grid, poses[:5])
