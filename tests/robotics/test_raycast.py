"""Ray casting against two obvious loops: small steps along the ray, and cell by cell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics import raycast
from bayesmc.robotics.grid import OccupancyGrid
from bayesmc.robotics.raycast import RayTable, ray_cast
from bayesmc.testing import session

SMALL = hnp.arrays(
    bool, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.booleans()
)


def scattered(shape: tuple[int, int], share: float, seed: int) -> OccupancyGrid:
    occupied = np.random.default_rng(seed).random(shape) < share
    return OccupancyGrid(occupied.astype(float), 0.25, origin=(-2.0, 1.0))


def faults(grid: OccupancyGrid, pose: np.ndarray, found: float, reach: float) -> list[str]:
    """What is wrong with a distance, by walking the ray in steps of 1/50 of a cell."""
    step = grid.resolution / 50
    direction = np.array([math.cos(pose[2]), math.sin(pose[2])])

    def touches(length: float) -> bool:  # an obstacle within a hair of the point
        point = pose[:2] + length * direction
        around = point + 1e-7 * np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])
        return bool((grid.at(around) >= grid.threshold).any())

    lengths = np.arange(0.0, min(found - 1e-9, reach), step)
    on_the_way = grid.at(pose[:2] + lengths[:, None] * direction) >= grid.threshold
    wrong = []
    if on_the_way.any():
        wrong.append(f"passes through an obstacle at {lengths[np.argmax(on_the_way)]}")
    if found < reach and not touches(found):
        wrong.append(f"stops at {found}, where there is none")
    return wrong


def by_cells(grid: OccupancyGrid, pose: np.ndarray, reach: float) -> float:
    """Amanatides and Woo's traversal of one ray that starts on the map."""
    x, y = (pose[:2] - grid.origin) / grid.resolution
    dx, dy = math.cos(pose[2]), math.sin(pose[2])
    ix, iy, t = math.floor(x), math.floor(y), 0.0
    occupied = grid.occupied()
    while 0 <= ix < grid.shape[0] and 0 <= iy < grid.shape[1]:
        if occupied[ix, iy]:
            return min(t * grid.resolution, reach)
        to_x = ((ix + 1 if dx > 0 else ix) - x) / dx if dx else math.inf
        to_y = ((iy + 1 if dy > 0 else iy) - y) / dy if dy else math.inf
        t = min(to_x, to_y)
        if to_x < to_y:
            ix += 1 if dx > 0 else -1
        else:
            iy += 1 if dy > 0 else -1
    return reach


def starts(grid: OccupancyGrid, count: int, seed: int, beyond: float = 0.0) -> np.ndarray:
    left, right, bottom, top = grid.extent
    rng = np.random.default_rng(seed)
    low, high = (left - beyond, bottom - beyond, -10.0), (right + beyond, top + beyond, 10.0)
    return rng.uniform(low, high, (count, 3))


@settings(max_examples=session.scaled(60, 5))
@given(SMALL, st.integers(0, 10_000))
def test_steps_of_a_fiftieth(occupied: np.ndarray, seed: int):
    grid = OccupancyGrid(occupied.astype(float), 0.5, origin=(3.0, -1.0))
    poses = starts(grid, 8, seed, beyond=1.0)
    found = ray_cast(grid, poses, np.zeros(1), 5.0)[:, 0]
    for pose, length in zip(poses, found, strict=True):
        assert faults(grid, pose, length, 5.0) == []


def test_steps_find_what_is_wrong():
    grid = scattered((20, 30), 0.1, 0)
    poses = starts(grid, 50, 1)
    found = ray_cast(grid, poses, np.zeros(1), 8.0)[:, 0]
    met = (found > 0.02) & (found < 7.9)
    assert met.sum() > 25
    for pose, length in zip(poses[met], found[met], strict=True):
        assert faults(grid, pose, length, 8.0) == []
        assert faults(grid, pose, length - 0.01, 8.0) != []
    late = [
        faults(grid, p, n + 0.02, 8.0) != [] for p, n in zip(poses[met], found[met], strict=True)
    ]
    assert np.mean(late) > 0.9  # all but grazed corners


@pytest.mark.parametrize(("shape", "share"), [((40, 31), 0.05), ((31, 64), 0.3), ((1, 50), 0.1)])
def test_cell_by_cell(shape: tuple[int, int], share: float):
    grid = scattered(shape, share, 4)
    poses = starts(grid, 400, 5)
    angles = np.array([-1.0, 0.0, 2.0])
    found = ray_cast(grid, poses, angles, 6.0)
    expected = [[by_cells(grid, p + [0, 0, a], 6.0) for a in angles] for p in poses]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_few_rays_at_a_time(monkeypatch: pytest.MonkeyPatch):
    grid = scattered((40, 40), 0.02, 6)
    poses, angles = starts(grid, 50, 7, beyond=2.0), np.linspace(-3, 3, 9)
    whole = ray_cast(grid, poses, angles, 20.0)
    monkeypatch.setattr(raycast, "_AT_ONCE", 7)
    monkeypatch.setattr(raycast, "_GATHER_EVERY", 1)
    np.testing.assert_array_equal(ray_cast(grid, poses, angles, 20.0), whole)


def test_along_the_axes_and_from_borders():
    grid = OccupancyGrid(np.pad(np.zeros((4, 4)), 1, constant_values=1.0), 1.0)
    quarter = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2])
    np.testing.assert_allclose(ray_cast(grid, [2.5, 2.5, 0.0], quarter, 9.0), [2.5, 2.5, 1.5, 1.5])
    np.testing.assert_allclose(ray_cast(grid, [2.0, 3.0, 0.0], quarter, 9.0), [3.0, 2.0, 1.0, 2.0])
    diagonal = ray_cast(grid, [1.0, 1.0, np.pi / 4], np.zeros(1), 9.0)
    np.testing.assert_allclose(diagonal, [4 * math.sqrt(2)])


def test_inside_obstacles_beyond_the_map_and_too_far():
    grid = OccupancyGrid([[0.0, 0.0, 1.0, 0.0]], 1.0)  # along y; one column
    up = np.array([np.pi / 2])
    assert ray_cast(grid, [0.5, 2.5, 0.0], up, 9.0).tolist() == [0.0]
    np.testing.assert_allclose(ray_cast(grid, [0.5, -3.0, 0.0], up, 9.0), [5.0])  # enters the map
    assert ray_cast(grid, [0.5, -3.0, 0.0], -up, 9.0).tolist() == [9.0]
    assert ray_cast(grid, [7.5, 0.5, 0.0], up, 9.0).tolist() == [9.0]
    assert ray_cast(grid, [0.5, 0.5, 0.0], up, 1.0).tolist() == [1.0]
    unknown = OccupancyGrid([[0.0, -1.0, 1.0]], 1.0)
    np.testing.assert_allclose(ray_cast(unknown, [0.5, 0.5, 0.0], up, 9.0), [1.5])


def test_maps_without_obstacles():
    grid = OccupancyGrid(np.zeros((5, 3)), 0.1)
    assert (ray_cast(grid, np.zeros((2, 3)), np.arange(5.0), 2.5) == 2.5).all()


def test_shapes():
    grid = scattered((10, 10), 0.1, 0)
    assert ray_cast(grid, np.zeros(3), np.zeros(7), 3.0).shape == (7,)
    assert ray_cast(grid, np.zeros((4, 2, 3)), np.zeros(7), 3.0).shape == (4, 2, 7)
    assert ray_cast(grid, np.zeros((4, 1, 3)), np.zeros((2, 7)), 3.0).shape == (4, 2, 7)
    assert ray_cast(grid, np.zeros((0, 3)), np.zeros(7), 3.0).shape == (0, 7)


@pytest.mark.parametrize(
    ("poses", "angles", "reach", "error", "message"),
    [
        (np.zeros(2), np.zeros(1), 1.0, ShapeError, r"poses have shape \(2,\)"),
        (np.zeros(3), 0.0, 1.0, ShapeError, r"give \(beams,\)"),
        (np.zeros((4, 3)), np.zeros((3, 1)), 1.0, ShapeError, "do not fit poses"),
        ([0, np.nan, 0], np.zeros(1), 1.0, ParameterError, r"poses must be finite.*\(1,\)"),
        (np.zeros(3), [np.inf], 1.0, ParameterError, "angles must be finite"),
        (np.zeros(3), np.zeros(1), np.nan, ParameterError, "max_range must be positive"),
        (np.zeros(3), np.zeros(1), -1.0, ParameterError, "max_range must be positive"),
    ],
)
def test_bad_rays(poses, angles, reach, error, message):  # noqa: ANN001
    with pytest.raises(error, match=message):
        ray_cast(scattered((5, 5), 0.1, 0), poses, angles, reach)


# ---- the table ----------------------------------------------------------------------------------


def test_table_holds_rays_from_centres():
    grid = scattered((15, 20), 0.1, 8)
    table = RayTable(grid, 4.0, headings=12)
    cells = np.array([[3, 4], [3, 4], [14, 19], [0, 7]])
    poses = np.concatenate(
        [grid.center_of(cells), [[0.0], [np.pi / 2], [-7 * np.pi / 6], [1e3]]], axis=1
    )
    poses[3, 2] = 20 * np.pi
    angles = np.arange(12) * (np.pi / 6)
    np.testing.assert_allclose(
        table.ranges(poses, angles), ray_cast(grid, poses, angles, 4.0), atol=4.0 / 65535
    )
    assert table._known.sum() == 3  # what was not asked for is not cast


def test_table_rounds_to_cell_and_heading():
    grid = OccupancyGrid(np.pad(np.zeros((30, 30)), 1, constant_values=1.0), 0.1)
    table = RayTable(grid, 10.0, headings=360)
    poses = np.random.default_rng(0).uniform((0.2, 0.2, -9), (3.0, 3.0, 9), (200, 3))
    angles = np.linspace(-1.5, 1.5, 20)
    error = np.abs(table.ranges(poses, angles) - ray_cast(grid, poses, angles, 10.0))
    assert np.median(error) < 0.05 and np.quantile(error, 0.99) < 0.3
    assert table.ranges([-5.0, 0.0, 0.0], angles).tolist() == [10.0] * 20


@pytest.mark.parametrize("headings", [0, -3, 2.5, "many"])
def test_bad_tables(headings: object):
    with pytest.raises(ParameterError, match="headings must be a positive whole number"):
        RayTable(scattered((5, 5), 0.1, 0), 1.0, headings)  # type: ignore[arg-type]


def test_wrong_objects_are_named():
    with pytest.raises(
        TypeError, match=r"ray_cast: give an OccupancyGrid.*array of shape \(3, 3\)"
    ):
        ray_cast(np.zeros((3, 3)), [1.0, 1.0, 0.0], [0.0], 5.0)
    with pytest.raises(TypeError, match="RayTable: give an OccupancyGrid"):
        RayTable(np.zeros((3, 3)), 5.0)
