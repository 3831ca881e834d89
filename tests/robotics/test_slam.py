"""Maps that particles share, scans weighed by them, poses matched against them, and SLAM by the filter."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from bayesmc.errors import (
    EvidenceWarning,
    ModelError,
    ParameterError,
    ShapeError,
    UnsupportedError,
)
from bayesmc.robotics import (
    GridMap,
    Laser,
    LikelihoodField,
    MapField,
    OccupancyGrid,
    PoseNormal,
    ScanMapper,
    ScanMatcher,
    between,
    compose,
    pose_errors,
    ray_cast,
    read_map,
    write_map,
)
from bayesmc.robotics.grid_map import FAR, NEAR, TILE
from examples import slam_grid

ANGLES = np.linspace(-np.pi, np.pi, 72, endpoint=False)
LASER = Laser(ANGLES, max_range=12.0)


def world() -> OccupancyGrid:
    """A room of 9 m by 6 m with a pillar and a nook; cells of 0.05 m."""
    cells = np.zeros((180, 120))
    cells[[0, -1]], cells[:, [0, -1]] = 1.0, 1.0
    cells[60:70, 50:64], cells[120:124, :45], cells[150:, 90:] = 1.0, 1.0, 1.0
    return OccupancyGrid(cells, 0.05)


def scan(pose: np.ndarray, grid: OccupancyGrid) -> np.ndarray:
    return np.asarray(ray_cast(grid, pose, ANGLES, 12.0))


def drive() -> np.ndarray:
    """Once around the pillar."""
    turn = np.linspace(0.0, 2.0 * np.pi, 40)
    x, y = 3.25 + 1.6 * np.cos(turn), 2.85 + 1.3 * np.sin(turn)
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    return np.stack([x, y, heading], axis=-1)


def cells(grown: GridMap) -> dict[tuple[int, int], bytes]:
    return {key: tile.tobytes() for key, tile in grown.tiles.items()}


def shared() -> tuple[GridMap, np.ndarray]:
    """A map with a scan in it, and two that come of it."""
    seen = scan(np.array([2.0, 2.0, 0.3]), world())
    one = ScanMapper(LASER).updated(GridMap(0.05), [2.0, 2.0, 0.3], seen)[()]
    maps = np.empty(2, dtype=object)
    maps[:] = one
    poses = np.array([[2.0, 2.0, 0.3], [2.2, 2.0, 0.3]])
    return one, ScanMapper(LASER).updated(maps, poses, seen)


def test_a_shared_map_is_never_written() -> None:
    seen = scan(np.array([2.0, 2.0, 0.3]), world())
    one = ScanMapper(LASER).updated(GridMap(0.05), [2.0, 2.0, 0.3], seen)[()]
    before = cells(one)
    maps = np.empty(2, dtype=object)
    maps[:] = one  # as resampling leaves them: one object in two places
    poses = np.array([[2.0, 2.0, 0.3], [2.2, 2.0, 0.3]])
    new = ScanMapper(LASER).updated(maps, poses, seen)
    assert cells(one) == before
    assert maps[0] is one
    assert new[0] != new[1]
    assert new[0] != one
    with pytest.raises(ValueError, match="read-only"):
        next(iter(one.tiles.values()))[0, 0] = 1
    with pytest.raises(TypeError):
        one.tiles[0, 0] = np.zeros((TILE, TILE), dtype=np.int8)  # type: ignore[index]
    with pytest.raises(AttributeError, match="shared"):
        one.tiles = {}  # type: ignore[misc]


def test_what_no_beam_touches_stays_the_same_object() -> None:
    mapper, far = ScanMapper(Laser([0.0], max_range=80.0)), [0.0, 0.0, 0.0]
    one = mapper.updated(GridMap(0.05), far, [9.0])[()]
    two = mapper.updated(one, [0.0, 40.0, 0.0], [9.0])[()]
    assert all(two.tiles[key] is tile for key, tile in one.tiles.items())
    assert len(two.tiles) > len(one.tiles)
    own = {id(a) for m in (one, two) for a in m.tiles.values()}
    assert len(own) == len(two.tiles)
    assert all(tile.base is None for tile in two.tiles.values())  # a view would hold what is gone


def test_maps_are_values() -> None:
    one, (a, b) = shared()
    assert pickle.loads(pickle.dumps(a)) == a
    assert copy.deepcopy(a) is a
    assert a != b
    assert one != GridMap(0.05)
    assert GridMap(0.05) != GridMap(0.1)
    assert one.size == sum(t.nbytes for p in (one.tiles, one.squares) for t in p.values())


def test_distances_are_those_of_the_whole_map() -> None:
    from scipy.ndimage import distance_transform_edt

    grown, grid = GridMap(0.05), world()
    for pose in drive()[::13]:  # tiles change one scan at a time
        grown = ScanMapper(LASER).updated(grown, pose, scan(pose, grid))[()]
    keys = np.array([*grown.tiles, *grown.squares])
    low, high = keys.min(axis=0) - 1, keys.max(axis=0) + 2
    shape = tuple((high - low) * TILE)
    occupied, found = np.zeros(shape, dtype=bool), np.full(shape, FAR)
    for part, own in ((occupied, grown.tiles), (found, grown.squares)):
        for (i, j), tile in own.items():
            x, y = (i - low[0]) * TILE, (j - low[1]) * TILE
            part[x : x + TILE, y : y + TILE] = tile > 0 if part is occupied else tile
    square = np.rint(distance_transform_edt(~occupied) ** 2)
    assert occupied.sum() > 200
    assert (square <= NEAR).sum() > 5_000
    np.testing.assert_array_equal(found, np.where(square <= NEAR, square, FAR))


def test_a_map_says_what_the_world_is(tmp_path) -> None:
    grown, grid = GridMap(0.05), world()
    for pose in drive():
        grown = ScanMapper(LASER).updated(grown, pose, scan(pose, grid))[()]
    made = grown.grid()
    known = ~np.isnan(made.occupancy)
    points = made.center_of(np.argwhere(made.free()))
    assert known.sum() > 12_000
    assert (grid.at(points) == 0.0).mean() > 0.99
    walls = made.center_of(np.argwhere(made.occupied(0.7)))
    assert (
        np.median(
            grid.distances[tuple(np.clip(grid.cell_of(walls), 0, np.array(grid.shape) - 1).T)]
        )
        < 0.06
    )
    again = read_map(write_map(made, tmp_path / "map.yaml"))
    np.testing.assert_array_equal(again.occupied(), made.occupied())


def test_the_density_is_that_of_cells_and_interpolated_between() -> None:
    """One beam, one obstacle: by hand at the middles of cells, and half way between them."""
    laser = Laser([0.0], max_range=10.0)
    grown = ScanMapper(laser).updated(GridMap(0.1), [0.05, 0.05, 0.0], [2.0])[()]
    field = MapField(laser, sigma=0.15, z_hit=0.9, z_rand=0.1, tempering=0.5)

    def by_hand(distance: float) -> float:
        peak = 0.9 * np.exp(-0.5 * (distance / 0.15) ** 2) / (np.sqrt(2 * np.pi) * 0.15)
        return 0.5 * float(np.log(peak + 0.1 / 10.0))

    off = np.array([0.0, 0.1, 0.2, 0.3])
    at = np.stack([0.05 + off, np.full(4, 0.05), np.zeros(4)], axis=-1)
    log = field.given(at, grown).log_prob([2.0])
    np.testing.assert_allclose(log, [by_hand(d) for d in off], atol=1e-5)
    half = field.given([0.1, 0.05, 0.0], grown).log_prob([2.0])
    np.testing.assert_allclose(half, np.mean(log[:2]), atol=1e-5)
    nowhere = field.given([500.0, -3.0, 1.0], grown).log_prob([2.0])
    np.testing.assert_allclose(nowhere, 0.5 * np.log(0.01), atol=1e-6)


def test_each_pose_is_weighed_by_its_own_map() -> None:
    _, maps = shared()
    seen = scan(np.array([2.0, 2.0, 0.3]), world())
    poses = np.array([[2.0, 2.0, 0.3], [2.2, 2.0, 0.3]])
    together = MapField(LASER).given(poses, maps).log_prob(seen)
    alone = [MapField(LASER).given(p, m).log_prob(seen) for p, m in zip(poses, maps, strict=True)]
    np.testing.assert_allclose(together, alone, rtol=1e-6)
    crossed = MapField(LASER).given(poses, maps[::-1]).log_prob(seen)
    assert not np.allclose(together, crossed)


def test_matching_finds_the_pose_whatever_the_wheels_say() -> None:
    grid, path, mapper = world(), drive(), ScanMapper(LASER)
    grown = GridMap(0.05)
    for pose in path[:6]:
        grown = mapper.updated(grown, pose, scan(pose, grid))[()]
    off = np.random.default_rng(0).normal(size=(20, 3)) * [0.1, 0.1, 0.08]
    wheels = PoseNormal(path[6] + off, scale_diag=[0.1, 0.1, 0.08])
    found = ScanMatcher(MapField(LASER)).given(wheels, grown, scan(path[6], grid))
    assert found.batch_shape == (20,)
    away, turned = pose_errors(found.mean, path[6])
    assert away.max() < 0.05  # a cell
    assert np.abs(turned).max() < 0.02
    assert np.sqrt(np.linalg.det(found.cov)).max() < np.sqrt(np.linalg.det(wheels.cov)).max() / 20


def test_scans_without_a_hit_leave_the_motion() -> None:
    one, _ = shared()
    wheels = PoseNormal([2.0, 2.0, 0.3], scale_diag=[0.1, 0.2, 0.05])
    for nothing in (np.full(72, np.inf), np.full(72, 12.0), np.full(72, np.nan), np.zeros(72)):
        found = ScanMatcher(MapField(LASER)).given(wheels, one, nothing)
        np.testing.assert_allclose(found.mean, wheels.mean)
        np.testing.assert_allclose(found.cov, 1.2 * wheels.cov)
        assert MapField(LASER).given([2.0, 2.0, 0.3], one).log_prob(nothing) == 0.0
        assert ScanMapper(LASER).updated(one, [2.0, 2.0, 0.3], nothing)[()] is one


def test_scans_that_can_be_no_metres_are_told() -> None:
    """Readings beyond the longest range that differ are no code for no return; one number is."""
    one, _ = shared()
    pose, mapper = np.array([2.0, 2.0, 0.3]), ScanMapper(LASER)
    millimetres = 1000.0 * scan(pose, world())
    wheels = PoseNormal(pose, scale_diag=[0.1, 0.2, 0.05])
    for ask in (
        lambda: mapper.updated(one, pose, millimetres),
        lambda: MapField(LASER).given(pose, one).log_prob(millimetres),
        lambda: ScanMatcher(MapField(LASER)).given(wheels, one, millimetres),
        lambda: LikelihoodField(world(), max_range=12.0).given(pose, ANGLES).log_prob(millimetres),
    ):
        with pytest.raises(ModelError, match="none is a return.*millimetres"):
            ask()
    codes = np.where(np.arange(72) % 2, 12.0, 81.9)
    assert mapper.updated(one, pose, codes)[()] is one
    with pytest.warns(EvidenceWarning, match="without a return was put into a map that is empty"):
        assert not mapper.updated(GridMap(0.05), pose, codes)[()].tiles


def test_bad_input_is_refused_by_name() -> None:
    one, _ = shared()
    sensor, mapper = MapField(LASER), ScanMapper(LASER)
    with pytest.raises(ShapeError, match="71.*72 beams"):
        mapper.updated(one, [0.0, 0.0, 0.0], np.ones(71))
    with pytest.raises(ShapeError, match="72 beams"):
        sensor.given([0.0, 0.0, 0.0], one).log_prob(np.ones(3))
    with pytest.raises(ParameterError, match="np.deg2rad"):
        Laser(np.arange(-90.0, 90.0))
    with pytest.raises(TypeError, match="maps are GridMaps"):
        sensor.given([0.0, 0.0, 0.0], world())
    with pytest.raises(ParameterError, match="not finite"):
        mapper.updated(one, [np.nan, 0.0, 0.0], np.ones(72))
    with pytest.raises(ParameterError, match="in metres"):
        mapper.updated(one, [1e12, 0.0, 0.0], np.ones(72))
    three = slam_grid.Log(
        "late", LASER, np.ones((3, 72)), np.zeros((3, 3)), np.array([0.0, 2.0, 1.0])
    )
    with pytest.raises(ValueError, match="stamp of scan 2 is before"):
        slam_grid.mapped(three)
    with pytest.raises(ValueError, match="3 scans, 2 poses"):
        slam_grid.mapped(three._replace(odometry=np.zeros((2, 3))))
    with pytest.raises(ParameterError, match="different resolutions"):
        mapper.updated(np.array([one, GridMap(0.1)], dtype=object), np.zeros((2, 3)), np.ones(72))
    with pytest.raises(ParameterError, match="empty"):
        GridMap(0.05).grid()
    with pytest.raises(UnsupportedError, match="cannot be drawn"):
        sensor.given([0.0, 0.0, 0.0], one).sample(rng=0)
    with pytest.raises(ParameterError, match="occupied"):
        ScanMapper(LASER, occupied=0.4)
    with pytest.raises(ParameterError, match="resolution"):
        GridMap(0.0)


def test_slam_finds_path_and_map() -> None:
    """A room with known truth, wheels that slip; the defaults of the example. A fixed seed."""
    grid, truth = world(), drive()
    rng = np.random.default_rng(3)
    steps = between(truth[:-1], truth[1:]) + rng.normal(size=(39, 3)) * [0.03, 0.03, 0.04]
    odometry = [np.zeros(3)]
    for step in steps:
        odometry.append(compose(odometry[-1], step))
    scans = np.stack([scan(p, grid) for p in truth]) + rng.normal(size=(40, 72)) * 0.01
    log = slam_grid.Log("room", LASER, scans, np.array(odometry), np.arange(40.0), truth)
    found = slam_grid.mapped(log, particles=15, rng=0)
    there = between(truth[0], truth)
    by_wheels = pose_errors(log.odometry, there)[0].max()
    away, turned = pose_errors(found.poses, there)
    assert by_wheels > 0.25
    assert away.max() < 0.15
    assert np.abs(turned).mean() < 0.04
    walls = found.map.grid().occupied(0.7).sum()
    assert 400 < walls < 1500
