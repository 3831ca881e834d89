"""The likelihood field against a loop over particles and beams, and in a particle filter."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import ModelError, ParameterError, ShapeError
from bayesmc.robotics import end_points
from bayesmc.robotics import field as field_module
from bayesmc.robotics.beams import BeamModel, Beams, clean_ranges
from bayesmc.robotics.field import LikelihoodField
from bayesmc.robotics.free_space import FreeSpace
from bayesmc.robotics.grid import OccupancyGrid
from bayesmc.robotics.raycast import ray_cast
from bayesmc.testing import session

ANGLES = np.linspace(-2.0, 2.0, 11)
REACH = 6.0


def hall() -> OccupancyGrid:
    """A hall with boxes in it, no two corners alike."""
    occupied = np.pad(np.zeros((38, 28)), 1, constant_values=1.0)
    for x, y, width, height in ((5, 5, 3, 8), (20, 3, 6, 2), (30, 18, 2, 6), (12, 20, 7, 3)):
        occupied[x : x + width, y : y + height] = 1.0
    occupied[25:28, 25:28] = -1.0
    return OccupancyGrid(occupied, 0.2, origin=(-1.0, -2.0))


def standard(**options: object) -> LikelihoodField:
    return LikelihoodField(hall(), **{"sigma": 0.3, "max_range": REACH, **options})  # type: ignore[arg-type]


def poses(count: int, seed: int, beyond: float = 0.0) -> np.ndarray:
    left, right, bottom, top = hall().extent
    low, high = (left - beyond, bottom - beyond, -7.0), (right + beyond, top + beyond, 7.0)
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def by_loop(field: LikelihoodField, pose: np.ndarray, ranges: np.ndarray) -> tuple[float, bool]:
    """One scan's log density beam by beam, and whether no end point is within 0.002 cells of a border."""
    grid, mount = field.grid, field.mount
    obstacles = grid.center_of(np.argwhere(grid.occupied()))
    total, clear = 0.0, True
    for angle, length in zip(ANGLES, ranges, strict=True):
        if not 0 <= length < field.max_range:
            continue
        c, s = math.cos(pose[2]), math.sin(pose[2])
        laser = pose[:2] + [c * mount[0] - s * mount[1], s * mount[0] + c * mount[1]]
        turn = pose[2] + mount[2] + angle
        end = laser + length * np.array([math.cos(turn), math.sin(turn)])
        inside = (end - grid.origin) / grid.resolution
        clear = clear and np.abs(inside - np.rint(inside)).min() > 0.002
        density = field.z_rand / field.max_range
        if grid.contains(end) and grid.contains(pose):
            centre = grid.center_of(grid.cell_of(end))
            distance = np.hypot(*(obstacles - centre).T).min()
            density += field.z_hit * stats.norm.pdf(distance, 0.0, field.sigma)
        total += field.tempering * math.log(density)
    return total, clear


@pytest.mark.parametrize(
    "options",
    [{}, {"mount": (0.3, -0.2, 0.5)}, {"tempering": 0.3, "z_hit": 0.5}, {"z_rand": 0.01}],
)
def test_loop_over_beams(options: dict):
    field = standard(**options)
    ranges = np.random.default_rng(0).uniform(0.0, 1.1 * REACH, 11)
    ranges[[2, 5, 7]] = [np.nan, -1.0, np.inf]
    particles = poses(300, 1, beyond=1.0)
    found = field.given(particles, ANGLES).log_prob(ranges)
    checked = 0
    for pose, log in zip(particles, found, strict=True):
        expected, clear = by_loop(field, pose, ranges)
        if clear:
            checked += 1
            assert log == pytest.approx(expected, abs=2e-4)
    assert checked > 250
    moved = field.given(particles + [0.2, 0.0, 0.0], ANGLES).log_prob(ranges)
    on_map = field.grid.contains(particles)
    assert np.mean(np.abs(moved - found)[on_map] > 2e-3) > 0.8  # the comparison would see one cell


@settings(max_examples=session.scaled(40, 5))
@given(st.integers(0, 10**6), st.floats(-1e4, 1e4))
def test_turns_cost_nothing(seed: int, turns: float):
    field = standard()
    particles = poses(20, seed)
    ranges = np.random.default_rng(seed).uniform(0.0, REACH, 11)
    turned = particles + [0.0, 0.0, 2 * np.pi * round(turns)]
    found, again = (field.given(p, ANGLES).log_prob(ranges) for p in (particles, turned))
    clear = [by_loop(field, p, ranges)[1] for p in particles]
    np.testing.assert_allclose(again[clear], found[clear], atol=2e-4)


def test_small_blocks_and_clipping_change_nothing(monkeypatch: pytest.MonkeyPatch):
    particles = poses(1000, 2, beyond=3.0)
    ranges = np.random.default_rng(3).uniform(0.0, REACH, 11)
    whole = standard().given(particles, ANGLES).log_prob(ranges)
    for module in (end_points, field_module):
        monkeypatch.setattr(module, "BLOCK", 100)
    np.testing.assert_array_equal(standard().given(particles, ANGLES).log_prob(ranges), whole)
    monkeypatch.setattr(end_points, "_ROOMY", 0)
    clipped = standard()
    assert clipped._table.clips and clipped._table.margin == 1
    near = np.abs(clipped.given(particles, ANGLES).log_prob(ranges) - whole) < 2e-4
    assert near.mean() > 0.97  # another margin rounds some end points to the next cell


def test_no_returns_say_nothing():
    field, particles = standard(), poses(5, 4)
    for reading in (REACH, 80.0, np.inf, np.nan, -0.5):
        scan = field.given(particles, ANGLES)
        assert scan.log_prob(np.full(11, reading)).tolist() == [0.0] * 5
    ranges = np.full(11, 1.0)
    ranges[3:] = np.inf
    alone = field.given(particles, ANGLES[:3]).log_prob(np.ones(3))
    np.testing.assert_allclose(field.given(particles, ANGLES).log_prob(ranges), alone, atol=1e-5)


def test_robots_beyond_the_map():
    field = standard()
    beyond = np.array([[-1.2, 0.0, 0.0], [1e12, 0.0, 1.0], [0.0, -1e300, 0.0]])
    one_on_it = np.array([*beyond, [1.0, 0.0, 0.0]])
    log = field.given(one_on_it, ANGLES).log_prob(np.ones(11))
    np.testing.assert_allclose(log[:3], 11 * np.log(0.2 / REACH))
    assert log[3] == field.given(one_on_it[3], ANGLES).log_prob(np.ones(11)) != log[0]
    assert field.log_random == pytest.approx(np.log(0.2 / REACH))
    sure = standard(z_rand=0.0, z_hit=1.0)
    assert (sure.given(one_on_it, ANGLES).log_prob(np.ones(11))[:3] == -np.inf).all()
    for alone in beyond:
        log = field.given(alone, ANGLES).log_prob(np.ones(11))
        assert log == pytest.approx(11 * np.log(0.2 / REACH))


def test_clouds_beyond_the_map():
    """Farther off than the map is wide a start is a mistake; a belief nearer by may come back."""
    beyond = np.array([[-14.2, 0.0, 0.0], [1e12, 0.0, 1.0], [0.0, -1e300, 0.0]])
    with pytest.raises(
        ModelError, match="all of 3 poses are 13.2 m or more off the map, which spans x -1 to 7"
    ):
        standard().given(beyond, ANGLES).log_prob(np.ones(11))
    beyond[0, 0] = -7.2
    log = standard().given(beyond, ANGLES).log_prob(np.full(11, 4.0))
    np.testing.assert_allclose(log, 11 * np.log(0.2 / REACH))


@pytest.mark.parametrize("angles", [[-90.0, 0.0, 90.0], [0.0, 359.0], [0.0, 7.0]])
def test_angles_in_degrees(angles: list):
    with pytest.raises(ParameterError, match=r"angles are in radians; got .*np\.deg2rad"):
        standard().given([1.0, 0.0, 0.0], angles)
    around = np.linspace(0.0, 2 * np.pi, 9)
    assert standard().given([1.0, 0.0, 0.0], around).event_shape == (9,)


def test_mounts_turned_in_degrees():
    with pytest.raises(ParameterError, match=r"headings of a mount are in radians; got 180"):
        standard(mount=(0.1, 0.0, 180.0))
    assert standard(mount=(90.0, 0.0, -np.pi)).mount[0] == 90.0


def test_a_scan_has_beams():
    with pytest.raises(
        ShapeError, match=r"angles have shape \(0,\); give \(beams,\), one beam or more"
    ):
        standard().given([1.0, 0.0, 0.0], [])


def test_wrong_objects_are_named():
    with pytest.raises(
        TypeError, match=r"LikelihoodField: give an OccupancyGrid.* of shape \(3, 3\)"
    ):
        LikelihoodField(np.zeros((3, 3)))
    for options in ({"sigma": "a"}, {"z_hit": "a"}, {"mount": "abc"}, {"mount": ("a", 0.0, 0.0)}):
        ((name, _),) = options.items()
        with pytest.raises(ParameterError, match=f"LikelihoodField: {name} must be"):
            standard(**options)


def test_maps_without_obstacles():
    field = LikelihoodField(OccupancyGrid(np.zeros((20, 20)), 0.1), max_range=1.0)
    log = field.given([1.0, 1.0, 0.0], ANGLES).log_prob(np.full(11, 0.5))
    np.testing.assert_allclose(log, 11 * np.log(0.2), rtol=1e-6)


def test_scans_of_a_plate_and_scans_of_their_own():
    """A batch of scans, a few for many poses or one for each, gives what single scans give."""
    field = standard()
    particles = poses(600, 5, beyond=1.0).reshape(200, 3, 3)
    rng = np.random.default_rng(6)
    scan = field.given(particles, ANGLES)
    assert scan.batch_shape == (200, 3) and scan.event_shape == (11,)
    few = rng.uniform(0.0, 1.2 * REACH, (3, 11))
    found = scan.log_prob(few)
    for robot in range(3):
        alone = field.given(particles[:, robot], ANGLES).log_prob(few[robot])
        np.testing.assert_array_equal(found[:, robot], alone)
    own = rng.uniform(0.0, 1.2 * REACH, (200, 3, 11))
    found = scan.log_prob(own)
    alone = [[float(field.given(p, ANGLES).log_prob(z)) for p, z in zip(*both, strict=True)]
             for both in zip(particles, own, strict=True)]  # fmt: skip
    assert np.mean(np.abs(found - alone) < 2e-4) > 0.97  # float32 rounds in another order
    wide = field.given(particles[0, 0], ANGLES).log_prob(own)
    assert wide.shape == (200, 3)


def test_shapes_without_particles():
    field = standard()
    assert field.given([1.0, 1.0, 0.0], ANGLES).log_prob(np.ones(11)).shape == ()
    assert field.given(np.zeros((0, 3)), ANGLES).log_prob(np.ones(11)).shape == (0,)
    with pytest.raises(ShapeError, match=r"\(10,\)"):
        field.given([1.0, 1.0, 0.0], ANGLES).log_prob(np.ones(10))


def beam_p_value(draws: np.ndarray, pose: np.ndarray, angle: float) -> float:
    """Chi-square test of draws along one beam against the density in steps of 1/40 of a cell."""
    field = standard()
    fine = (np.arange(1200) + 0.5) * (REACH / 1200)
    ends = pose[:2] + fine[:, None] * [math.cos(pose[2] + angle), math.sin(pose[2] + angle)]
    inside = field.grid.contains(ends)
    cells = np.where(inside[:, None], field.grid.cell_of(ends), 0)
    distance = np.where(inside, field.grid.distances[cells[:, 0], cells[:, 1]], np.inf)
    density = 0.8 * stats.norm.pdf(distance, 0.0, 0.3) + 0.2 / REACH
    masses = density.reshape(12, 100).sum(axis=1) / density.sum()
    counts = np.histogram(draws, np.linspace(0.0, REACH, 13))[0]
    return float(stats.chisquare(counts, len(draws) * masses).pvalue)


def test_draws_follow_the_density_along_a_beam():
    """False alarm 1e-4 (fixed seed): steps of half a cell do not show. Another beam does."""
    field, pose = standard(), np.array([1.03, 0.17, 0.4])
    draws = field.given(pose, np.array([0.5, -2.4])).sample(rng=1, sample_shape=3_000)
    assert draws.shape == (3_000, 2) and (draws >= 0).all() and (draws < REACH).all()
    assert beam_p_value(draws[:, 0], pose, 0.5) > 1e-4
    assert beam_p_value(draws[:, 1], pose, 0.5) < 1e-4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": 0.0}, "sigma must be positive"),
        ({"max_range": np.inf}, "max_range must be positive and finite"),
        ({"z_hit": 1.2}, "z_hit must be between 0 and 1"),
        ({"z_hit": 0.9}, "z_hit \\+ z_rand <= 1"),
        ({"z_hit": 0.0, "z_rand": 0.0}, "0 < z_hit \\+ z_rand"),
        ({"tempering": -1.0}, "tempering must be positive"),
        ({"mount": (0.0, np.nan, 0.0)}, "mount must be three finite numbers"),
    ],
)
def test_bad_fields(change: dict, message: str):
    with pytest.raises(ParameterError, match=message):
        replace(standard(), **change)


def test_bad_poses():
    field = standard()
    with pytest.raises(ParameterError, match="pose must be finite.*at index 1"):
        field.given([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], ANGLES)
    with marking_invalid():
        scan = field.given([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], ANGLES)
    assert scan.invalid is not None and scan.invalid.tolist() == [False, True]
    with pytest.raises(ShapeError, match=r"poses have shape \(2,\)"):
        field.given([0.0, 0.0], ANGLES)
    with pytest.raises(ShapeError, match="angles have shape"):
        field.given(np.zeros(3), ANGLES[None])
    with pytest.raises(ParameterError, match="angles must be finite"):
        field.given(np.zeros(3), [np.nan])


# ---- in models ----------------------------------------------------------------------------------


def driven(sensor: object, grid: OccupancyGrid, steps: int, particles: int) -> tuple:
    """A robot on an arc through the hall: truth, and where a filter with this sensor believes it is."""
    truth = np.array([2.5, -0.5, 0.3]) + np.zeros((steps, 3))
    for t in range(1, steps):
        heading = truth[t - 1, 2]
        truth[t] = truth[t - 1] + [0.1 * math.cos(heading), 0.1 * math.sin(heading), 0.05]
    rng = np.random.default_rng(7)
    clear = ray_cast(grid, truth, ANGLES, REACH)
    ranges = clean_ranges(clear + 0.03 * rng.standard_normal(clear.shape), REACH)

    dbn = bmc.DynamicBayesNet("hall")
    noise = np.array([0.05, 0.05, 0.03])

    def moved(pose_prev):  # noqa: ANN001, ANN202
        step = [0.1 * np.cos(pose_prev[..., 2]), 0.1 * np.sin(pose_prev[..., 2])]
        turn = np.full(pose_prev.shape[:-1], 0.05)
        return bmc.MvNormal(pose_prev + np.stack([*step, turn], axis=-1), scale_diag=noise)

    start = bmc.MvNormal(truth[0], scale_diag=np.array([0.4, 0.4, 0.2]))
    dbn.add("pose", moved, initial=lambda: start)
    dbn.add("scan", sensor)
    filtered = bmc.filter(dbn, {"scan": ranges}, engine=bmc.ParticleFilter(particles), rng=3)
    return truth, np.asarray(filtered.mean("pose"))


def distance_at_the_end(track: tuple) -> float:
    truth, mean = track
    return float(np.sqrt(((mean - truth)[-10:, :2] ** 2).sum(axis=-1).mean()))


def test_field_tracks_a_robot():
    """Within a cell, where a field of another map (mirrored) is lost by more: fixed seed."""
    grid = hall()
    field = LikelihoodField(grid, sigma=0.15, max_range=REACH, tempering=0.5)
    found = distance_at_the_end(driven(lambda pose: field.given(pose, ANGLES), grid, 30, 1500))
    assert found < 0.1
    wrong = OccupancyGrid(grid.occupancy[::-1], grid.resolution, grid.origin)
    other = LikelihoodField(wrong, sigma=0.15, max_range=REACH, tempering=0.5)
    lost = distance_at_the_end(driven(lambda pose: other.given(pose, ANGLES), grid, 30, 1500))
    assert lost > 3 * found


def test_beams_on_cast_rays_track_a_robot():
    grid = hall()
    model = BeamModel(0.8, 0.05, 0.05, 0.1, sigma_hit=0.1, max_range=REACH, tempering=0.5)
    track = driven(lambda pose: Beams(ray_cast(grid, pose, ANGLES, REACH), model), grid, 25, 500)
    assert distance_at_the_end(track) < 0.1


def test_garbage_in_a_scan_is_refused_by_name():
    """NaN and negative ranges are evidence of nothing; ``clean_ranges`` says what they stand for."""
    field = standard()
    dbn = bmc.DynamicBayesNet("hall")
    dbn.add("pose", lambda pose_prev: bmc.MvNormal(pose_prev, scale_diag=np.full(3, 0.1)),
            initial=lambda: FreeSpace(field.grid))  # fmt: skip
    dbn.add("scan", lambda pose: field.given(pose, ANGLES))
    ranges = np.ones((3, 11))
    for garbage in (np.nan, -1.0):
        ranges[1, 4] = garbage
        with pytest.raises(bmc.errors.EvidenceError, match="scan"):
            bmc.filter(dbn, {"scan": ranges}, engine=bmc.ParticleFilter(50), rng=0)
    cleaned = clean_ranges(ranges, REACH)
    answer = bmc.filter(dbn, {"scan": cleaned}, engine=bmc.ParticleFilter(50), rng=0)
    assert np.isfinite(answer.mean("pose")).all()


def test_true_poses_of_the_intel_log_beat_others(reference_data: Path):
    folder = reference_data / "robot" / "intel"
    counts = np.load(folder / "intel_map_even_scans.npz")
    log = np.load(folder / "intel_laser_odom_corrected.npz")
    grid = OccupancyGrid.from_counts(
        counts["hits"], counts["free"], 0.1, tuple(counts["origin"]), threshold=0.3
    )
    field = LikelihoodField(grid, max_range=40.0)
    angles = np.deg2rad(np.arange(180) - 90)[::3]
    others = FreeSpace(grid).sample(rng=0, sample_shape=500)
    beaten = []
    for pose, ranges in zip(log["corrected_pose"][1::20], log["ranges"][1::20], strict=True):
        scores = field.given(np.concatenate([pose[None], others]), angles).log_prob(
            ranges[::3].astype(float)
        )
        beaten.append(scores[0] > scores[1:].max())
    assert np.mean(beaten) > 0.9
