"""Occupancy grids against brute force, and poses drawn from free space against their density."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import ModelError, ParameterError, ShapeError
from bayesmc.robotics.free_space import FreeSpace
from bayesmc.robotics.grid import OccupancyGrid
from bayesmc.robotics.pose_distributions import PoseNormal

OCCUPIED = hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9))
NAN = float("nan")


def room() -> OccupancyGrid:
    """3 by 2 free cells with an unknown one, walls around them."""
    inside = np.zeros((3, 2))
    inside[1, 1] = NAN
    return OccupancyGrid(np.pad(inside, 1, constant_values=0.9), 0.5, origin=(-1.0, 2.0))


# ---- cells --------------------------------------------------------------------------------------


def test_three_kinds_of_cells():
    grid = room()
    assert grid.occupied().sum() == 14 and grid.free().sum() == 5
    assert not grid.occupied()[2, 2] and not grid.free()[2, 2]
    assert grid.occupied(0.95).sum() == 0 and grid.free(0.95).sum() == 19


def test_minus_one_is_unknown_and_nothing_is_shared():
    given_ = np.array([[0.0, -1.0], [1.0, 0.25]])
    grid = OccupancyGrid(given_, 0.1)
    assert np.isnan(grid.occupancy[0, 1]) and given_[0, 1] == -1.0
    given_[:] = 0.5
    assert grid.occupancy[1, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        grid.occupancy[0, 0] = 1.0


@given(st.integers(-5, 9), st.integers(-5, 9), st.floats(0.05, 0.95), st.floats(0.05, 0.95))
def test_cells_of_points(ix: int, iy: int, u: float, v: float):
    grid = room()
    point = np.array(grid.origin) + (np.array([ix + u, iy + v])) * 0.5
    assert grid.cell_of(point).tolist() == [ix, iy]
    assert grid.cell_of(grid.center_of([ix, iy])).tolist() == [ix, iy]
    inside = 0 <= ix < 5 and 0 <= iy < 4
    assert bool(grid.contains(point)) == inside
    expected = grid.occupancy[ix, iy] if inside else NAN
    np.testing.assert_equal(float(grid.at(point)), expected)


def test_points_that_are_nowhere():
    grid = room()
    points = np.array([[NAN, 2.5], [np.inf, 2.5], [-1e300, 2.5], [0.0, 2.6]])
    assert grid.contains(points).tolist() == [False, False, False, True]
    assert np.isnan(grid.at(points)[:3]).all()
    with pytest.raises(ShapeError, match=r"points have shape \(\)"):
        grid.contains(1.0)


def test_poses_are_points():
    grid = room()
    assert grid.contains(np.array([[0.0, 2.6, 100.0]])).tolist() == [True]


@given(OCCUPIED, st.floats(0.01, 3.0))
def test_distances_by_brute_force(occupied: np.ndarray, resolution: float):
    grid = OccupancyGrid(occupied.astype(float), resolution)
    cells = np.argwhere(np.ones_like(occupied))
    obstacles = np.argwhere(occupied)
    expected = np.full(len(cells), np.inf)
    for k, cell in enumerate(cells):
        for obstacle in obstacles:
            expected[k] = min(expected[k], resolution * np.hypot(*(cell - obstacle)))
    np.testing.assert_allclose(grid.distances.ravel(), expected, rtol=1e-12)
    assert grid.distances is grid.distances


@given(OCCUPIED)
def test_empty_squares_by_brute_force(occupied: np.ndarray):
    squares = OccupancyGrid(occupied.astype(float), 1.0).empty_squares
    for left in (0, 1):
        for down in (0, 1):
            turned = occupied[:: 1 - 2 * left, :: 1 - 2 * down]
            expected = np.zeros(np.array(occupied.shape) + 1, dtype=int)
            for (ix, iy), _ in np.ndenumerate(turned):
                side = 0
                while (
                    ix + side < turned.shape[0]
                    and iy + side < turned.shape[1]
                    and not turned[ix : ix + side + 1, iy : iy + side + 1].any()
                ):
                    side += 1
                expected[ix, iy] = side
            np.testing.assert_array_equal(squares[2 * left + down], expected)


def test_counts():
    grid = OccupancyGrid.from_counts([[4, 0, 0]], [[0, 3, 0]], 0.1, prior=(0.5, 1.5))
    np.testing.assert_allclose(grid.occupancy, [[4.5 / 6, 0.5 / 5, NAN]])
    with pytest.raises(ShapeError, match=r"hits have shape \(1, 2\), passes \(1, 3\)"):
        OccupancyGrid.from_counts([[1, 2]], [[1, 2, 3]], 0.1)
    with pytest.raises(ParameterError, match=r"passes must be nonnegative.*at cell \(0, 1\)"):
        OccupancyGrid.from_counts([[1, 2]], [[1, -2]], 0.1)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((np.zeros((0, 3)), 0.1), ShapeError, "at least one cell"),
        ((np.zeros(3), 0.1), ShapeError, r"shape \(3,\)"),
        ((np.zeros((2, 2, 2)), 0.1), ShapeError, r"\(nx, ny\)"),
        (([[0.0, 1.5]], 0.1), ParameterError, r"got 1.5 at cell \(0, 1\)"),
        (([[0, 100]], 0.1), ParameterError, "percentages are divided by 100"),
        (([[0.0, np.inf]], 0.1), ParameterError, "between 0 and 1"),
        (([[0.0]], NAN), ParameterError, "resolution must be positive and finite; got nan"),
        (([[0.0]], 0.0), ParameterError, "resolution must be positive"),
        (([[0.0]], "wide"), ParameterError, "resolution must be a number; got 'wide'"),
        (([[0.0]], 0.1, (0.0, NAN)), ParameterError, "origin must be two finite numbers"),
        (([[0.0]], 0.1, (0.0, 0.0, 1.0)), ParameterError, "origin must be two finite numbers"),
        (([[0.0]], 0.1, (0.0, 0.0), 1.5), ParameterError, "threshold must be at most 1"),
    ],
)
def test_bad_grids(arguments: tuple, error: type[Exception], message: str):
    with pytest.raises(error, match=message):
        OccupancyGrid(*arguments)


def test_origin_of_the_intel_map_is_a_corner(reference_data: Path):
    """End points of scans that did not make the map lie on its obstacles, and half a cell aside less so."""
    folder = reference_data / "robot" / "intel"
    counts = np.load(folder / "intel_map_even_scans.npz")
    log = np.load(folder / "intel_laser_odom_corrected.npz")
    pose, ranges = log["corrected_pose"][1::2], log["ranges"][1::2].astype(float)
    heading = pose[:, 2:] + np.deg2rad(np.arange(180) - 90)
    ends = pose[:, None, :2] + ranges[..., None] * np.stack(
        [np.cos(heading), np.sin(heading)], axis=-1
    )
    ends = ends[ranges < 20.0]

    def mean_distance(shift: float) -> float:
        origin = tuple(counts["origin"] + shift)
        grid = OccupancyGrid.from_counts(counts["hits"], counts["free"], 0.1, origin, threshold=0.3)
        cells = grid.cell_of(ends[grid.contains(ends)])
        return float(np.minimum(grid.distances[cells[:, 0], cells[:, 1]], 1.0).mean())

    assert mean_distance(0.0) < 0.015 < 0.03 < mean_distance(-0.05)


# ---- free space ---------------------------------------------------------------------------------


def test_free_space_is_normalised():
    start = FreeSpace(room())
    assert start.area == pytest.approx(5 * 0.25)
    edges = (np.arange(200) + 0.5) / 200
    left, right, bottom, top = start.grid.extent
    x, y = np.meshgrid(left + (right - left) * edges, bottom + (top - bottom) * edges)
    poses = np.stack([x, y, np.full_like(x, 7.0)], axis=-1)
    mass = np.exp(start.log_prob(poses)).mean() * (right - left) * (top - bottom) * 2 * np.pi
    assert mass == pytest.approx(1.0, rel=1e-9)  # cell borders fall between the points


def test_density_beyond_free_space():
    start = FreeSpace(room())
    outside = [[-0.9, 2.1, 0.0], [0.25, 3.25, 0.0], [50.0, 2.6, 0.0], [NAN, 2.6, 0.0]]
    assert (start.log_prob(outside) == -np.inf).all()  # wall, unknown, beyond, nowhere
    assert start.log_prob([0.0, 2.6, np.inf]) == -np.inf
    assert start.log_prob([0.0, 2.6, 100.0]) == start.log_prob([0.0, 2.6, 0.0])
    with pytest.raises(ShapeError, match=r"not \(\.\.\., "):
        start.log_prob([0.0, 1.0])


def cells_p_value(draws: np.ndarray, grid: OccupancyGrid, free: np.ndarray) -> float:
    """Chi-square test of evenness over cells and quarters of the circle."""
    cells = grid.cell_of(draws)
    number = np.flatnonzero(free)
    where = np.searchsorted(number, cells[:, 0] * grid.shape[1] + cells[:, 1])
    quarter = np.floor((draws[:, 2] + np.pi) / (np.pi / 2)).astype(int)
    counts = np.bincount(4 * where + quarter, minlength=4 * len(number))
    return float(stats.chisquare(counts).pvalue)


def test_draws_are_even():
    """Of 20 cells by quarter; false alarm 1e-4 (fixed seed). The walls of one cell left out are found."""
    grid = room()
    draws = FreeSpace(grid).sample(rng=3, sample_shape=20_000)
    assert draws.shape == (20_000, 3)
    assert np.isfinite(FreeSpace(grid).log_prob(draws)).all()
    assert FreeSpace(grid).support.contains(draws).all()
    assert cells_p_value(draws, grid, grid.free()) > 1e-4
    assert cells_p_value(draws[draws[:, 0] > -0.45], grid, grid.free()) < 1e-4
    assert stats.kstest(np.mod(draws[:, 0], 0.5) / 0.5, "uniform").pvalue > 1e-4


def test_clearance():
    grid = OccupancyGrid(np.pad(np.zeros((5, 5)), 1, constant_values=1.0), 1.0)
    start = FreeSpace(grid, clearance=2.0)
    assert start.area == 9.0
    draws = start.sample(rng=0, sample_shape=500)
    assert (draws[:, :2] > 2.0).all() and (draws[:, :2] < 5.0).all()
    assert start.log_prob([1.5, 3.5, 0.0]) == -np.inf


@pytest.mark.parametrize(
    ("occupancy", "clearance", "message"),
    [
        (np.ones((3, 3)), 0.0, "no cell of OccupancyGrid.*is free"),
        (np.full((3, 3), NAN), 0.0, "all of it unknown"),
        (np.eye(3), 9.0, "at least 9.0 m from an obstacle"),
    ],
)
def test_no_free_cell(occupancy: np.ndarray, clearance: float, message: str):
    with pytest.raises(ModelError, match=message):
        FreeSpace(OccupancyGrid(occupancy, 0.1), clearance)


@pytest.mark.parametrize("clearance", [-1.0, NAN, np.inf])
def test_bad_clearance(clearance: Any):
    with pytest.raises(ParameterError, match="clearance must be nonnegative"):
        FreeSpace(room(), clearance)


def test_wrong_objects_are_named():
    with pytest.raises(
        TypeError, match=r"FreeSpace: give an OccupancyGrid.*array of shape \(3, 3\)"
    ):
        FreeSpace(np.zeros((3, 3)))
    with pytest.raises(TypeError, match=r"OccupancyGrid.*; got 'room.yaml'"):
        FreeSpace("room.yaml")
    for threshold in ("a", 0.0, 1.5, NAN, [0.5]):
        with pytest.raises(ParameterError, match=r"threshold must be in \(0, 1\]; got"):
            FreeSpace(room(), threshold=threshold)
    with pytest.raises(ParameterError, match="clearance must be nonnegative and finite; got 'a'"):
        FreeSpace(room(), "a")


def test_free_space_mixes_with_motion():
    start = FreeSpace(room())
    moved = PoseNormal([[0.0, 2.6, 0.0], [9.0, 2.6, 0.0]], scale_diag=[0.1, 0.1, 0.1])
    mixed = bmc.Mixture([0.75, 0.25], [moved, start])
    at = np.array([0.05, 2.55, 0.1])
    expected = np.log(0.75 * np.exp(moved.log_prob(at)) + 0.25 * np.exp(start.log_prob(at)))
    np.testing.assert_allclose(mixed.log_prob(at), expected)
    assert mixed.support.angles(3).tolist() == [False, False, True]


@pytest.mark.parametrize(
    "engine",
    [bmc.MetropolisHastings(600, warmup=300, chains=16), bmc.Gibbs(300, warmup=100, chains=16)],
)
def test_chains_stay_in_free_space(engine: Any):
    """Beside a wall; against weights of 50,000 even poses, within 0.05 (4 standard errors of 0.012)."""
    net = bmc.BayesNet()
    net.add("pose", FreeSpace(room()))
    net.add("x", lambda pose: bmc.Normal(pose[..., 0], 0.2))
    found = bmc.infer(net, {"x": 0.9}, engine=engine, rng=0)
    inside = found.expectation(lambda pose: FreeSpace(room()).cell_of(pose) >= 0)
    assert inside == 1.0
    poses = FreeSpace(room()).sample(1, 50_000)
    weights = np.exp(bmc.Normal(poses[:, 0], 0.2).log_prob(0.9))
    exact = (weights @ poses[:, :2]) / weights.sum()
    np.testing.assert_allclose(found.mean("pose")[:2], exact, atol=0.05)
    assert exact[0] < 0.84  # the control: without the wall it would be 0.9


def test_free_space_in_a_net():
    net = bmc.BayesNet()
    net.add("pose", FreeSpace(room()))
    net.add("x", lambda pose: bmc.Normal(pose[..., 0], 0.1))
    posterior = bmc.infer(net, {"x": -0.25}, engine=bmc.LikelihoodWeighting(4_000), rng=0)
    assert posterior.mean("pose")[0] == pytest.approx(-0.25, abs=0.05)
