"""Poses where a sensor says: draws against their density, the density against an integral, and its use."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics import (
    FreeSpace,
    LikelihoodField,
    OccupancyGrid,
    OdometryMotion,
    SensorPoses,
    ray_cast,
)

ANGLES = np.deg2rad(np.arange(-90.0, 91.0, 15.0))


def room() -> OccupancyGrid:
    """An L of 6 by 4 m, so that no corner looks like another."""
    free = np.zeros((60, 40))
    free[35:, 22:] = 1.0
    free[10:14, 30:] = 1.0
    return OccupancyGrid(np.pad(free, 1, constant_values=1.0), 0.1, origin=(-2.0, 1.0))


GRID = room()
SPACE = FreeSpace(GRID)
FIELD = LikelihoodField(GRID, sigma=0.3, max_range=10.0, tempering=0.5)


def sensor(poses: np.ndarray) -> bmc.Distribution:
    return FIELD.given(poses, ANGLES)


def aim(spacing: float = 0.37, headings: int = 20, even: float = 0.1) -> SensorPoses:
    return SensorPoses(SPACE, sensor, spacing, headings, even)


TRUTH = np.array([0.33, 2.21, 0.7])
SCAN = ray_cast(GRID, TRUTH, ANGLES, 10.0)


def test_the_density_integrates_to_one_over_free_space() -> None:
    """By evenly spread poses: the mean of the density is one over the volume (4 standard errors, 6e-5)."""
    poses = SPACE.sample(0, 200_000)
    density = np.exp(aim().given(SCAN).log_prob(poses)) * SPACE.area * 2 * np.pi
    assert abs(density.mean() - 1.0) < 4 * density.std() / np.sqrt(len(poses))


def test_draws_have_the_density() -> None:
    """Expectations under the density, by draws and by weighted even poses (4 standard errors, 6e-5 each)."""
    aimed = aim().given(SCAN)
    draws, even = aimed.sample(1, 100_000), SPACE.sample(2, 400_000)
    weights = np.exp(aimed.log_prob(even)) * SPACE.area * 2 * np.pi
    for f in (lambda p: p[:, 0], lambda p: p[:, 1], lambda p: np.cos(p[:, 2] - p[:, 0])):
        one, other = f(draws), weights * f(even)
        error = np.hypot(one.std() / np.sqrt(len(one)), other.std() / np.sqrt(len(other)))
        assert abs(one.mean() - other.mean()) < 4 * error
    # the control: draws of another reading are seen to be others
    late = aim().given(SCAN * 0.7).sample(1, 100_000)
    assert abs(late[:, 0].mean() - draws[:, 0].mean()) > 0.1


def test_draws_lie_on_free_cells_and_in_their_bins_evenly() -> None:
    aimed = aim(even=1e-9).given(SCAN)
    poses = aimed.sample(3, 50_000)
    assert (SPACE.cell_of(poses) >= 0).all() and np.isfinite(aimed.log_prob(poses)).all()
    best = int(aimed.probabilities.argmax())
    inside = aim()._bins.of(poses) == best
    share = aimed.probabilities[best]
    assert abs(inside.mean() - share) < 5 * np.sqrt(share / len(poses))  # alpha 6e-7
    turns = poses[inside, 2] / (2 * np.pi) * 20 % 1.0
    assert stats.kstest(turns, "uniform").pvalue > 1e-6


def test_most_draws_are_near_the_pose_that_was_seen() -> None:
    poses = aim(0.25, 48, 0.05).given(SCAN).sample(4, 10_000)
    near = np.hypot(*(poses - TRUTH)[:, :2].T) < 0.5
    evenly = np.hypot(*(SPACE.sample(4, 10_000) - TRUTH)[:, :2].T) < 0.5
    assert near.mean() > 0.3 > 5 * evenly.mean()


def test_middles_are_those_of_free_cells() -> None:
    found = aim()
    assert (SPACE.cell_of(found.poses) >= 0).mean() > 0.9  # a middle may fall into a wall's corner
    assert len(found.poses) % 20 == 0
    np.testing.assert_array_equal(found._bins.of(SPACE.sample(0, 100)) >= 0, True)
    wide = SensorPoses(SPACE, sensor, spacing=100.0, headings=1)
    np.testing.assert_allclose(wide.poses, [[*SPACE.centers.mean(axis=0), 0.0]])


def test_poses_elsewhere_have_no_density() -> None:
    aimed = aim().given(SCAN)
    poses = np.array([[50.0, 2.0, 0.0], [-1.99, 1.01, 0.0], [np.nan, 2.0, 0.0], [0.0, 2.0, np.nan]])
    np.testing.assert_array_equal(aimed.log_prob(poses), -np.inf)
    turned = TRUTH + [0.0, 0.0, 4 * np.pi]
    assert aimed.log_prob(turned) == pytest.approx(aimed.log_prob(TRUTH), abs=1e-9)


def test_a_reading_that_says_nothing_leaves_even_poses() -> None:
    impossible = SensorPoses(
        SPACE, lambda poses: bmc.Uniform(poses[:, 0] + 50.0, poses[:, 0] + 51.0)
    )
    for reading in (0.0, np.nan):
        aimed = impossible.given(reading)
        poses = aimed.sample(0, 1000)
        np.testing.assert_allclose(aimed.log_prob(poses), SPACE.log_prob(poses))
    nothing = aim().given(np.full(len(ANGLES), 10.0))  # no beam came back
    np.testing.assert_allclose(nothing.probabilities, 1 / len(nothing.probabilities))


def test_readings_are_kept_for_the_blocks_of_a_cloud() -> None:
    calls = []

    def counted(poses: np.ndarray) -> Any:
        calls.append(len(poses))
        return sensor(poses)

    found = SensorPoses(SPACE, counted, 0.5, 12)
    assert found.given(SCAN) is found.given(SCAN.copy())
    assert found.given(SCAN * 0.9) is not found.given(SCAN)
    assert len(calls) == 2
    with pytest.raises(ShapeError, match="one reading at a time"):  # the same bytes
        found.given(SCAN[:, None])


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: aim(0.0), ParameterError, "spacing must be positive"),
        (lambda: aim(np.nan), ParameterError, "spacing"),
        (lambda: aim(headings=0), ParameterError, "headings must be 1 or more"),
        (lambda: aim(headings=True), ParameterError, "headings"),
        (lambda: aim("a"), ParameterError, "spacing must be positive and finite; got 'a'"),
        (lambda: aim(even=1.5), ParameterError, "even must be above 0"),
        (
            lambda: aim(even=0.0),
            ParameterError,
            "a proposal that leaves poses out gives wrong weights",
        ),
        (lambda: aim(even=np.nan), ParameterError, "even must be above 0"),
        (
            lambda: SensorPoses(GRID, sensor),
            TypeError,
            "space must be a FreeSpace, such as FreeSpace(grid)",
        ),
        (lambda: SensorPoses(SPACE, None), TypeError, "sensor must be a function of poses"),
        (lambda: SensorPoses(SPACE, FIELD), TypeError, "lambda pose: field.given(pose, angles)"),
        (lambda: aim().given(np.stack([SCAN, SCAN])), ShapeError, "one reading at a time"),
        (
            lambda: SensorPoses(SPACE, lambda poses: bmc.Normal(0.0, 1.0)).given(0.0),
            ShapeError,
            "one for each pose",
        ),
        (lambda: aim().given(SCAN).log_prob([0.0, 1.0]), ShapeError, "not (..., 3)"),
    ],
)
def test_wrong_input_is_named(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error) as caught:
        make()
    assert message in str(caught.value)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_a_lost_robot_is_found_with_few_particles() -> None:
    """Three hundred, of 21 m2 and all headings: found in all of 10 seeds when aimed, evenly in few."""
    still, looked = bmc.robotics.PoseNormal, aim(0.3, 36)
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "pose", lambda pose_prev: still(pose_prev, scale_diag=(0.02, 0.02, 0.02)), initial=SPACE
    )
    dbn.add("scan", lambda pose: sensor(pose))
    scans = {"scan": np.repeat(SCAN[None], 5, axis=0)}
    found = {}
    for name, options in {
        "aimed": {"initial_proposal": {"pose": lambda scan: looked.given(scan)}},
        "evenly": {},
    }.items():
        engine = bmc.ParticleFilter(300, **options)
        last = [bmc.filter(dbn, scans, engine=engine, rng=k).mean("pose")[-1] for k in range(10)]
        found[name] = sum(np.hypot(*(pose - TRUTH)[:2]) < 0.2 for pose in last)
    assert found["aimed"] == 10 and found["evenly"] < 10


# ---- a robot that may be carried away -----------------------------------------------------------

SHARE, NOISE, WIDE = 0.1, (0.02, 0.02, 0.05, 0.02), LikelihoodField(GRID, 0.5, max_range=10.0)
WIDE = replace(WIDE, tempering=0.15)
STEP = np.array([0.2, 0.0, 0.1])
#: there a while, then elsewhere
ROWS = {"scan": np.stack([SCAN] * 2 + [ray_cast(GRID, [3.1, 1.6, -1.0], ANGLES, 10.0)] * 2)}
INPUTS = {"motion": np.stack([np.zeros(3), *[STEP] * 3])}


def moved(pose_prev: np.ndarray, motion: np.ndarray) -> OdometryMotion:
    return OdometryMotion(pose_prev, motion, NOISE, floor=(0.1, 0.1, 0.1))


def with_jump(pose_prev: np.ndarray, motion: np.ndarray) -> bmc.Mixture:
    return bmc.Mixture([1 - SHARE, SHARE], [moved(pose_prev, motion), SPACE])


def robot(transition: Any) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.input("motion", event_shape=(3,))
    dbn.add("pose", transition, initial=SPACE)
    dbn.add("scan", lambda pose: WIDE.given(pose, ANGLES))
    return dbn


COARSE = SensorPoses(SPACE, lambda poses: WIDE.given(poses, ANGLES), 0.4, 24, 0.2)


def dual(pose_prev: np.ndarray, motion: np.ndarray, scan: np.ndarray) -> bmc.Mixture:
    return bmc.Mixture([0.7, 0.3], [moved(pose_prev, motion), COARSE.given(scan)])


class Unweighed(bmc.Mixture):
    """Draws of the dual, with the density of the declared jump: so that nothing makes up for them."""

    def __init__(self, pose_prev: np.ndarray, motion: np.ndarray, scan: np.ndarray) -> None:
        drawn = dual(pose_prev, motion, scan)
        super().__init__(drawn.weights, drawn.components)
        self.declared = with_jump(pose_prev, motion)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        return self.declared.log_prob(x)


def unweighed_dual(pose_prev: np.ndarray, motion: np.ndarray, scan: np.ndarray) -> Unweighed:
    return Unweighed(pose_prev, motion, scan)


#: of the log evidence, so that numbers are near one
LEVEL = -13.5


def evidences(transition: Any, runs: int = 40, **options: Any) -> np.ndarray:
    engine = bmc.ParticleFilter(400, **options)
    dbn = robot(transition)
    logs = [
        bmc.filter(dbn, ROWS, inputs=INPUTS, engine=engine, rng=seed).log_marginal_likelihood
        for seed in range(runs)
    ]
    return np.exp(np.array(logs) - LEVEL)


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Difference of means in standard errors."""
    error = np.hypot(one.std(ddof=1), other.std(ddof=1)) / np.sqrt(len(one))
    return float(abs(one.mean() - other.mean()) / error)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_a_declared_jump_with_the_dual_proposal_has_the_evidence_of_recovery() -> None:
    """Estimates of the evidence are unbiased: means of 40 agree within 4 standard errors (6e-5 each)."""
    recovered = evidences(moved, recovery=bmc.Recovery({"pose": SPACE}, share=SHARE))
    declared = evidences(with_jump)
    aimed = evidences(with_jump, proposal={"pose": dual})
    assert apart(recovered, declared) < 4 and apart(recovered, aimed) < 4
    unweighed = evidences(with_jump, proposal={"pose": unweighed_dual})
    assert apart(recovered, unweighed) > 8
