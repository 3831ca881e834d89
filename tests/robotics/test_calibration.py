"""Wheel noise and tempering learned from known poses; beams that are learned tell a wrong place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ModelMisfitWarning, ShapeError
from bayesmc.robotics import (
    BeamModel,
    Beams,
    LikelihoodField,
    OccupancyGrid,
    OdometryMotion,
    PoseNormal,
    RayTable,
    fit_beams,
    fit_field,
    fit_odometry,
)
from bayesmc.testing import session
from examples import robot_logs

ALPHAS = (0.02, 0.004, 0.01, 0.006)


def steps(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(session.seed() + 1)
    motion = rng.uniform([0.1, -0.1, -0.6], [1.0, 0.1, 0.6], (count, 3))
    return motion, OdometryMotion(np.zeros(3), motion, ALPHAS).sample(rng)


def test_the_noise_of_wheels_is_found() -> None:
    """Standard deviations of 4,000 steps, each within a fourth of the truth: eight deviations of the estimate
    or more. Strays in one of fifty change little, and other noise is seen.
    """
    motion, moved = steps(4000)
    found = np.sqrt(fit_odometry(motion, moved))
    np.testing.assert_allclose(found, np.sqrt(ALPHAS), rtol=0.25)
    moved[::50] += [3.0, 0.0, 1.0]
    np.testing.assert_allclose(np.sqrt(fit_odometry(motion, moved)), np.sqrt(ALPHAS), rtol=0.35)
    wrong = fit_odometry(motion, motion + 3 * (steps(4000)[1] - motion))
    assert (np.sqrt(wrong) > 2 * np.sqrt(ALPHAS)).all()
    with pytest.raises(ShapeError, match="10 steps or more"):
        fit_odometry(motion[:5], moved[:5])


@pytest.fixture(scope="module")
def rooms() -> tuple[LikelihoodField, np.ndarray]:
    """A field of a hall with pillars, smooth at the steps that slopes are taken by, and poses in it."""
    cells = np.pad(np.zeros((120, 80)), 2, constant_values=1.0)
    for x, y in ((30, 20), (60, 55), (90, 30), (100, 60), (45, 65)):
        cells[x : x + 6, y : y + 6] = 1.0
    field = LikelihoodField(OccupancyGrid(cells, 0.1), sigma=0.3, max_range=6.0)
    rng = np.random.default_rng(session.seed() + 2)
    spots = rng.uniform([1.0, 1.0, -3.0], [11.0, 7.0, 3.0], (4000, 3))
    clear = field.grid.distances[tuple(field.grid.cell_of(spots[:, :2]).T)] > 0.8
    return field, spots[clear][:400]


def test_beams_that_say_the_same_are_counted_once(rooms) -> None:
    """Independent ones keep their weight, to a factor of two; of each repeated five times a fifth is left."""
    field, poses = rooms
    angles = np.linspace(-2.0, 2.0, 12)
    scans = field.given(poses, angles).sample(session.seed() + 3)
    fit = fit_field(field, scans, poses, angles)
    assert 6 < fit.witnesses < 24 and 0.5 < fit.field.z_hit < 0.9
    again = fit_field(field, scans.repeat(5, axis=1), poses, angles.repeat(5))
    assert again.witnesses == pytest.approx(fit.witnesses, rel=0.05)
    assert again.field.tempering < 0.5 * fit.field.tempering
    near, far = (fit.searching(n, 100.0).tempering for n in (100_000, 1000))
    assert far <= near <= fit.field.tempering
    for wrong in ((0, 10.0), (10, -1.0)):
        with pytest.raises(ValueError, match="positive"):
            fit.searching(*wrong)
    with pytest.raises(ShapeError, match="20 scans or more"):
        fit_field(field, scans, poses[:50], angles)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.thorough)])
def test_learned_beams_tell_a_wrong_place_on_a_floor_that_nobody_tuned_to(seed: int) -> None:
    """Calibrated on the end of the log and checked on its start; the wrong place is a mirrored corridor's."""
    log = robot_logs.generated(every=15, seed=seed)
    last, first = slice(-90, None), slice(0, 30)
    table = RayTable(log.grid, max_range=log.reach, headings=180)
    mount = np.array(log.mount)

    def expected(pose: np.ndarray) -> np.ndarray:
        return table.ranges(bmc.robotics.compose(pose, mount), log.angles)

    start = BeamModel(max_range=log.reach)
    model = fit_beams(log.scans[last], expected(log.truth[last]), start).model
    model = replace(model, tempering=0.3)
    noise = fit_odometry(log.motion[last], np.vstack(
        [bmc.robotics.between(log.truth[k - 1], log.truth[k]) for k in range(len(log.truth) - 90,
         len(log.truth))]))  # fmt: skip
    part = robot_logs.first(log, 30)._replace(noise=noise)

    def checked(pose: np.ndarray) -> np.ndarray:
        net = robot_logs.net(
            part, PoseNormal(pose, scale_diag=[0.3, 0.3, 0.1]),
            lambda pose: Beams(expected(pose), model),
        )  # fmt: skip
        return robot_logs.localized(net, part, bmc.ParticleFilter(400), 0).row_ranks

    right = log.truth[first][0]
    ranks = checked(right)
    assert np.nanmean(ranks[np.isfinite(ranks)] < 0.05) < 0.2
    wrong = bmc.robotics.compose(right, [0.0, 0.0, np.pi])
    with pytest.warns(ModelMisfitWarning):
        checked(wrong)
