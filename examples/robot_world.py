"""A helper, not a script: an office floor and a robot that drives through it, made up and written as files.

A fresh clone has no robot's log, so one is made: a floor of 30 by 20 m (rooms, a corridor, doors, furniture
that is placed by chance, so that no two rooms look alike), a route through it that keeps off the walls, and
what the robot's instruments say on the way. They err in ways that are drawn from the library's own
densities: the wheels from ``OdometryMotion``, the laser and the sonars from ``Beams``, with readings that
are short (as of people who walk by), missing or anything at all. All of it is written as files that robots
have:

    map.yaml, map.png   the map, as ROS has it
    laser.log.gz        CARMEN's FLASER: 180 beams, a laser 20 cm ahead of the robot's centre, raw odometry
    sonar.log.gz        CARMEN's ROBOTLASER1 of 24 beams at 15 degrees: its reader has no message for sonars,
                        and this one states the angles of its beams and its range
    truth.log.gz        where the robot was, as CARMEN's ODOM

``robot_logs`` reads them as it would read anybody's. Run by itself, it draws the floor and the route.

Thrun, Burgard and Fox (2005), Probabilistic Robotics: tables 5.6 (odometry) and 6.1 (beams).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesmc.robotics import (
    BeamModel,
    Beams,
    OccupancyGrid,
    OdometryMotion,
    angle_between,
    between,
    compose,
    ray_cast,
    write_map,
)
from bayesmc.robotics.logs import Laser, Odometry, sick_angles, write_carmen
from examples import picture

WIDTH, HEIGHT, CELL = 30.0, 20.0, 0.1  # m
#: walls between rooms: left, bottom, right, top in m
WALLS = (
    (0.0, 8.9, 30.0, 9.1), (0.0, 11.0, 13.6, 11.2), (17.5, 11.0, 30.0, 11.2),
    (5.9, 11.2, 6.1, 20.0), (13.4, 11.2, 13.6, 20.0), (17.4, 11.0, 17.6, 20.0),
    (24.4, 11.2, 24.6, 20.0), (4.4, 0.0, 4.6, 9.0), (10.9, 0.0, 11.1, 9.0),
    (18.9, 0.0, 19.1, 9.0), (25.3, 0.0, 25.5, 9.0),
)  # fmt: skip
#: what is cut out of the walls again
DOORS = (
    (2.6, 11.0, 3.8, 11.2), (8.4, 11.0, 9.6, 11.2), (19.6, 11.0, 20.8, 11.2),
    (27.2, 11.0, 28.4, 11.2), (1.4, 8.9, 2.6, 9.1), (7.4, 8.9, 8.6, 9.1), (13.2, 8.9, 14.4, 9.1),
    (21.6, 8.9, 22.8, 9.1), (27.8, 8.9, 29.0, 9.1), (18.9, 3.2, 19.1, 4.4), (13.4, 16.4, 13.6, 17.6),
)  # fmt: skip
#: where the robot goes, one after the other
WAYPOINTS = (
    (7.6, 17.8), (15.5, 14.2), (16.8, 2.6), (22.8, 6.4), (27.8, 14.6), (12.2, 10.0), (7.8, 5.4),
    (2.2, 10.0), (3.2, 16.4),
)  # fmt: skip
PIECES = 38  # of furniture

MOUNT = np.array([0.2, 0.0, 0.0])  # of the laser on the robot
LASER, SONAR = sick_angles(180), np.deg2rad(np.arange(-180.0, 180.0, 15.0))
LASER_RANGE, SONAR_RANGE = 30.0, 4.0
NOTHING = 81.83  # what a SICK says where it saw nothing
#: how the instruments err
LASER_NOISE = BeamModel(0.86, 0.06, 0.04, 0.04, 0.03, 0.4, LASER_RANGE)
SONAR_NOISE = BeamModel(0.60, 0.12, 0.18, 0.10, 0.12, 0.6, SONAR_RANGE)
CONE = np.deg2rad([-10.0, -5.0, 0.0, 5.0, 10.0])  # a sonar hears the nearest thing in its cone
WHEELS = (0.004, 0.003, 0.003, 0.004)  # alphas of OdometryMotion, for steps of a fifth of a metre
STEP, TURN, PAUSE = 0.2, np.deg2rad(12.0), 0.25  # between scans: m, rad, s


class World(NamedTuple):
    """What there is and what was measured.

    Attributes
    ----------
    grid : OccupancyGrid
    truth, odometry : ndarray, shape (time, 3)
    laser : ndarray, shape (time, 180)
    sonar : ndarray, shape (time, 24)
    """

    grid: OccupancyGrid
    truth: np.ndarray
    odometry: np.ndarray
    laser: np.ndarray
    sonar: np.ndarray


@lru_cache(maxsize=4)
def world(seed: int = 0) -> World:
    """The floor, a drive through it and all readings; the same, read-only, for the same seed."""
    rng = np.random.default_rng(seed)
    grid = furnished(floor(), rng)
    truth = route(grid, WAYPOINTS)
    steps = OdometryMotion(np.zeros(3), between(truth[:-1], truth[1:]), WHEELS).sample(rng)
    odometry = [np.zeros(3)]  # the wheels know nothing of the map's frame
    for step in steps:
        odometry.append(compose(odometry[-1], step))
    made = np.array(odometry), scans(grid, truth, rng), echoes(grid, truth, rng)
    for array in (truth, *made):
        array.flags.writeable = False
    return World(grid, truth, *made)


def write_world(made: World, folder: Path) -> Path:
    """The files of a world, which readers of maps and logs read."""
    folder.mkdir(parents=True, exist_ok=True)
    times = PAUSE * np.arange(len(made.truth))
    rows = list(zip(times, made.odometry, strict=True))
    write_map(made.grid, folder / "map.yaml")
    write_carmen(
        folder / "laser.log.gz",
        [
            Laser(t, seen, LASER, pose, compose(pose, MOUNT))
            for (t, pose), seen in zip(rows, made.laser, strict=True)
        ],
    )
    write_carmen(
        folder / "sonar.log.gz",
        [
            Laser(t, heard, SONAR, pose, max_range=SONAR_RANGE)
            for (t, pose), heard in zip(rows, made.sonar, strict=True)
        ],
    )
    write_carmen(
        folder / "truth.log.gz",
        [Odometry(t, pose) for t, pose in zip(times, made.truth, strict=True)],
    )
    return folder


def floor() -> OccupancyGrid:
    """Rooms along a corridor, and a hall: without furniture."""
    cells = np.zeros((round(WIDTH / CELL), round(HEIGHT / CELL)))
    for box in WALLS:
        _fill(cells, box, 1.0)
    for box in DOORS:
        _fill(cells, box, 0.0)
    cells[[0, -1]] = cells[:, [0, -1]] = 1.0
    return OccupancyGrid(cells, CELL)


def furnished(grid: OccupancyGrid, rng: np.random.Generator) -> OccupancyGrid:
    """The same with tables, shelves and pillars, wherever they leave all waypoints within reach."""
    cells = grid.occupancy.copy()
    placed = 0
    while placed < PIECES:
        size = np.array([(1.6, 0.8), (0.8, 1.6), (0.4, 1.8), (1.8, 0.4), (0.5, 0.5)][placed % 5])
        size += rng.uniform(-0.1, 0.3, 2)
        low = rng.uniform((0.0, 0.0), np.array([WIDTH, HEIGHT]) - size)
        box, tried = (*low, *(low + size)), cells.copy()
        _fill(tried, box, 1.0)
        stands_alone = not cells[_cells_of(box)].any()  # through no wall and no other piece
        if stands_alone and _is_connected(OccupancyGrid(tried, CELL)):
            cells, placed = tried, placed + 1
    return OccupancyGrid(cells, CELL)


def route(grid: OccupancyGrid, waypoints: Sequence[tuple[float, float]]) -> np.ndarray:
    """Poses on the way, a step apart; where the way bends more than a little, the robot turns on the spot."""
    from scipy.ndimage import gaussian_filter1d

    cells = _shortest(grid, np.array(waypoints))
    path = gaussian_filter1d(grid.center_of(cells), 4.0, axis=0, mode="nearest")
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.arange(0.0, gone[-1], STEP)
    spots = np.stack([np.interp(at, gone, path[:, k]) for k in (0, 1)], axis=-1)
    dx, dy = np.diff(spots, axis=0).T
    headings = np.arctan2(dy, dx)
    poses = [[*spots[0], headings[0]]]
    for k in range(1, len(headings)):
        turn = float(angle_between(headings[k - 1], headings[k]))
        parts = max(1, int(np.ceil(abs(turn) / TURN)))
        poses += [
            [*spots[k], headings[k - 1] + turn * (i + 1) / parts] for i in range(parts)
        ]  # all but the last on the spot
    return np.array(poses)


def scans(grid: OccupancyGrid, poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the laser reads, in whole centimetres as lasers do."""
    expected = ray_cast(grid, compose(poses, MOUNT), LASER, LASER_RANGE)
    seen = Beams(expected, LASER_NOISE).sample(rng)
    return np.where(seen < LASER_RANGE, seen.round(2), NOTHING)


def echoes(grid: OccupancyGrid, poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the ring of sonars hears."""
    angles = (SONAR[:, None] + CONE).ravel()
    rays = ray_cast(grid, poses, angles, SONAR_RANGE).reshape(len(poses), len(SONAR), len(CONE))
    return Beams(rays.min(axis=-1), SONAR_NOISE).sample(rng).round(2)


def draw(made: World) -> Any:
    """The floor with the route, what odometry makes of it, and one scan of each kind."""
    figure, panels = picture.axes([["floor"], ["scans"]], (9, 12.2))
    for ax in panels.values():
        ax.imshow(made.grid.occupancy.T, origin="lower", extent=made.grid.extent, cmap="Greys")
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    path = compose(made.truth[0], made.odometry)
    ax = panels["floor"]
    ax.plot(*made.truth[:, :2].T, color=picture.EXACT, lw=2, label="route")
    ax.plot(*path[:, :2].T, color=picture.OTHER, lw=1.2, ls="--", label="by its wheels alone")
    ax.plot(*made.truth[0, :2], "o", color=picture.EXACT, label="start")
    ax.set(title="where the robot went, and where its wheels say it went")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False)
    ax, k = panels["scans"], len(made.truth) // 4
    pose = made.truth[k]
    ends = {
        "laser": (compose(pose, MOUNT), LASER, made.laser[k], LASER_RANGE, "."),
        "sonar": (pose, SONAR, made.sonar[k], SONAR_RANGE, "s"),
    }
    for (name, (at, angles, ranges, reach, mark)), colour in zip(
        ends.items(), (picture.OTHER, picture.DRAWS), strict=True
    ):
        hit = ranges < reach
        x = at[0] + ranges[hit] * np.cos(at[2] + angles[hit])
        y = at[1] + ranges[hit] * np.sin(at[2] + angles[hit])
        ax.plot(x, y, mark, color=colour, ms=5, label=f"{name}: {hit.sum()} of {len(hit)} beams")
    ax.plot(*pose[:2], "o", color=picture.EXACT, label="robot")
    ax.set(xlim=made.grid.extent[:2], ylim=made.grid.extent[2:], title="one scan")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Make a world, write its files to a folder that is thrown away, and draw it."""
    options = picture.options(__doc__, arguments)
    made = world()
    length = np.hypot(*np.diff(made.truth[:, :2], axis=0).T).sum()
    with tempfile.TemporaryDirectory() as folder:
        sizes = [path.stat().st_size for path in write_world(made, Path(folder)).iterdir()]
    print(f"A floor of {WIDTH:g} x {HEIGHT:g} m, {length:.0f} m of way, {len(made.truth)} scans")
    print(f"  {len(sizes)} files, {sum(sizes) / 1e6:.1f} MB")
    picture.save(draw(made), options.out, "robot_world")


# ---- private ------------------------------------------------------------------------------------


def _fill(cells: np.ndarray, box: Sequence[float], value: float) -> None:
    """Set the cells of a box (left, bottom, right, top in m), in place."""
    cells[_cells_of(box)] = value


def _cells_of(box: Sequence[float]) -> tuple[slice, slice]:
    left, bottom, right, top = (round(float(v) / CELL) for v in box)
    return slice(left, right), slice(bottom, top)


def _is_connected(grid: OccupancyGrid) -> bool:
    """Whether the robot gets from every waypoint to every other, 0.45 m from anything."""
    from scipy.ndimage import label

    # every other cell will do: nothing is thinner than two
    coarse = OccupancyGrid(grid.occupancy[::2, ::2], 2 * CELL)
    areas, _ = label(coarse.distances >= 0.45)
    doors = [((left + right) / 2, (bottom + top) / 2) for left, bottom, right, top in DOORS]
    places = coarse.cell_of(np.array([*WAYPOINTS, *doors]))
    found = areas[tuple(places.T)]
    return bool(found[0] and (found == found[0]).all())


def _shortest(grid: OccupancyGrid, waypoints: np.ndarray) -> np.ndarray:
    """Cells of the cheapest way through all waypoints; a step near a wall costs more."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    clear = grid.distances >= 0.4
    number = np.full(grid.shape, -1)
    number[clear] = np.arange(clear.sum())
    dear = 1.0 + (0.8 / np.maximum(grid.distances, 0.1)) ** 3
    edges = []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        here = (slice(0, -1 if dx else None), slice(1 if dy < 0 else 0, -1 if dy > 0 else None))
        there = (slice(dx, None), slice(dy, None) if dy >= 0 else slice(0, -1))
        both = clear[here] & clear[there]
        cost = np.hypot(dx, dy) * 0.5 * (dear[here] + dear[there])
        edges.append((number[here][both], number[there][both], cost[both]))
    start, end, cost = (np.concatenate(part) for part in zip(*edges, strict=True))
    graph = coo_array((cost, (start, end)), shape=(clear.sum(),) * 2).tocsr()
    stops = number[tuple(grid.cell_of(waypoints).T)]
    before = dijkstra(graph, directed=False, indices=stops[:-1], return_predecessors=True)[1]
    way = [stops[0]]
    for leg, stop in zip(before, stops[1:], strict=True):
        back = [stop]
        while leg[back[-1]] >= 0:
            back.append(leg[back[-1]])
        way += back[-2::-1]
    return np.argwhere(clear)[np.array(way)]


if __name__ == "__main__":
    main()
