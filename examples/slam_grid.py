"""A robot that maps a building that nobody has mapped before: SLAM with Rao-Blackwellised particles.

Every particle is a path and the map that the scans make along it. A scan weighs a pose by the map of its own
particle, and poses are proposed from where the scan fits that map, so that thirty particles are enough for
hundreds of metres. When the robot comes back to where it has been, particles whose maps fit are kept.
Particles share what their maps have in common, so that resampling copies no map.

The filter is the library's, and the net three nodes:

    pose given pose_prev and motion        what the wheels say, with noise
    scan given pose and map_prev           MapField: end points of beams lie near obstacles of the map so far
    map given map_prev, pose and scan      the map with the scan in it: computed, an object for each particle

Another robot, sensor or prior is another function. The floor is made up (``robot_world``), so the true path
is known; where the reference data is there, the Intel Research Lab follows, with the same functions, and its
errors are those of the relations between poses that people found by hand (Kümmerle et al.).

Written beside the pictures: the map as a ROS map file, and an animation of the map as it grows (not with
``--fast``).

Grisetti, Stachniss and Burgard (2007), Improved techniques for grid mapping with Rao-Blackwellized particle
filters, IEEE Transactions on Robotics 23; Doucet, de Freitas, Murphy and Russell (2000), Rao-Blackwellised
particle filtering for dynamic Bayesian networks, UAI. Data: D. Haehnel (Intel); Kümmerle et al. (2009), On
measuring the accuracy of SLAM algorithms, Autonomous Robots 27.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import (
    GridMap,
    Laser,
    MapField,
    PoseNormal,
    ScanMapper,
    ScanMatcher,
    between,
    clean_ranges,
    compose,
    pose_errors,
    wrap,
    write_map,
)
from examples import picture, reference, robot_logs

SEED, PARTICLES, CELL = 1, 30, 0.05  # cells in m
APART, TURNED = 0.1, 0.05  # m and rad between scans that are used
FRAMES = 60  # of the animation
QUICK = 60  # scans with --fast


class Log(NamedTuple):
    """What a robot brings home that had no map.

    Attributes
    ----------
    name : str
    laser : Laser
    scans : ndarray, shape (time, beams)
        Ranges in m.
    odometry : ndarray, shape (time, 3)
        Poses by the wheels alone.
    stamps : ndarray, shape (time,)
        In s.
    truth : ndarray, shape (time, 3), or None
    """

    name: str
    laser: Laser
    scans: np.ndarray
    odometry: np.ndarray
    stamps: np.ndarray
    truth: np.ndarray | None = None


class Run(NamedTuple):
    """What a filter made of a log.

    Attributes
    ----------
    used : ndarray of int, shape (slices,)
        Scans of the log that were.
    path : ndarray, shape (slices, 3)
        Of the best particle: its poses, back along its ancestors.
    poses : ndarray, shape (time, 3)
        The same for all scans of the log: in between go the wheels.
    spread : ndarray, shape (slices,)
        Standard deviation of the position in m.
    ess : ndarray, shape (slices,)
        Particles that those of each slice are worth.
    grown : dict of int to GridMap
        Maps on the way, of the particle that was best then.
    map : GridMap
        Of the best particle.
    size : int
        Bytes of the maps of all particles at the end, what they share counted once.
    seconds : float
        Processor time.
    """

    used: np.ndarray
    path: np.ndarray
    poses: np.ndarray
    spread: np.ndarray
    ess: np.ndarray
    grown: dict[int, GridMap]
    map: GridMap
    size: int
    seconds: float


# ---- the net, and a filter on it ----------------------------------------------------------------


def moved(pose_prev: Any, motion: Any) -> PoseNormal:
    """The next pose by the wheels: noise grows with the way and with the turn, and is never nought.

    Sideways, too: a laser that is not mounted where the robot turns is carried along an arc.
    """
    way, turn = np.hypot(motion[..., 0], motion[..., 1]), np.abs(wrap(motion[..., 2]))
    across = np.hypot(0.01, 0.1 * way + 0.1 * turn)
    around = np.hypot(0.01, 0.2 * way + 0.2 * turn)
    return PoseNormal(
        compose(pose_prev, motion), scale_diag=bmc.stack([across, across, around], axis=-1)
    )


def net(laser: Laser, cell: float = CELL) -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """SLAM as a model, and where its poses are proposed."""
    sensor, mapper, empty = MapField(laser), ScanMapper(laser), GridMap(cell)
    matcher = ScanMatcher(sensor)
    dbn = bmc.DynamicBayesNet("grid SLAM")
    dbn.input("motion", event_shape=(3,))
    start = PoseNormal(np.zeros(3), scale_diag=[1e-3, 1e-3, 1e-3])  # where the map has its origin
    dbn.add("pose", moved, parents=["pose_prev", "motion"], initial=start)

    @dbn.node(initial=lambda pose: sensor.given(pose, empty))
    def scan(pose, map_prev):
        return sensor.given(pose, map_prev)

    @dbn.node(name="map", initial=lambda pose, scan: mapper.updated(empty, pose, scan))
    def map_(map_prev, pose, scan):
        return mapper.updated(map_prev, pose, scan)

    def looking(pose_prev, motion, map_prev, scan):
        return matcher.given(moved(pose_prev, motion), map_prev, scan)

    return dbn, {"pose": looking}


def mapped(
    log: Log, particles: int = PARTICLES, rng: Any = SEED, frames: Sequence[int] = ()
) -> Run:
    """SLAM on a log, scan by scan.

    Raises
    ------
    ValueError
        Stamps that run backwards, or as many scans as there are not poses.
    """
    if not len(log.scans) == len(log.odometry) == len(log.stamps):
        raise ValueError(
            f"{log.name}: {len(log.scans)} scans, {len(log.odometry)} poses by the wheels and "
            f"{len(log.stamps)} stamps; each scan has one of both"
        )
    back = np.flatnonzero(np.diff(log.stamps) < 0)
    if len(back):
        raise ValueError(
            f"{log.name}: the stamp of scan {back[0] + 1} is before that of scan {back[0]}; sort the log by "
            "its stamps"
        )
    dbn, looking = net(log.laser)
    engine = bmc.ParticleFilter(particles, proposal=looking)
    used = keyframes(log.odometry)
    scans = clean_ranges(log.scans[used], log.laser.max_range)
    motion = between(log.odometry[used][:-1], log.odometry[used][1:])
    motion = np.concatenate([np.zeros((1, 3)), motion])
    began = time.process_time()
    belief, clouds, grown = engine.start(dbn, rng=rng), [], {}
    spread, ess = np.empty(len(used)), np.empty(len(used))
    for k in range(len(used)):
        belief = engine.step(belief, {"scan": scans[k]}, inputs={"motion": motion[k]})
        clouds.append((belief.particles("pose"), belief.ancestors))
        spread[k], ess[k] = np.sqrt(belief.var("pose")[:2].sum()), belief.weight_ess
        if k in frames:
            grown[k] = belief.particles("map")[belief.weights.argmax()]
    seconds = time.process_time() - began
    best, maps = int(belief.weights.argmax()), belief.particles("map")
    path = traced(clouds, best)
    tiles = {id(a): a.nbytes for m in maps for part in (m.tiles, m.squares) for a in part.values()}
    since = np.searchsorted(used, np.arange(len(log.scans)), side="right") - 1
    poses = compose(path[since], between(log.odometry[used[since]], log.odometry))
    return Run(used, path, poses, spread, ess, grown, maps[best], sum(tiles.values()), seconds)


def keyframes(odometry: np.ndarray, apart: float = APART, turned: float = TURNED) -> np.ndarray:
    """The scans that are used: the first, and each that is so far from the last one by the wheels."""
    found = [0]
    for k in range(1, len(odometry)):
        x, y, turn = between(odometry[found[-1]], odometry[k])
        if np.hypot(x, y) >= apart or abs(wrap(turn)) >= turned:
            found.append(k)
    return np.array(found)


def traced(clouds: Sequence[tuple[np.ndarray, np.ndarray | None]], last: int) -> np.ndarray:
    """The poses of a particle and of its ancestors, first to last."""
    path = []
    for poses, ancestors in reversed(clouds):
        path.append(poses[last])
        last = last if ancestors is None else int(ancestors[last])
    return np.array(path[::-1])


# ---- logs, and how well they are mapped ---------------------------------------------------------


def generated(seed: int = 0) -> Log:
    """The made-up floor, with a laser of 90 beams; nobody looks at its map."""
    made = robot_logs.generated(every=2, seed=seed)
    laser = Laser(made.angles, made.reach, made.mount)
    odometry = [np.zeros(3)]
    for step in made.motion[1:]:
        odometry.append(compose(odometry[-1], step))
    stamps = np.arange(float(len(made.scans)))
    return Log(made.name, laser, made.scans, np.array(odometry), stamps, made.truth)


def real(data: Path, name: str) -> Log:
    """``"intel"``, the Intel Research Lab, or ``"fr079"``, building 079 in Freiburg."""
    folder = {"intel": "robot/intel", "fr079": "slam"}[name]
    with np.load(data / folder / f"{name}_laser_odom_corrected.npz") as log:
        scans, odometry, stamps = (log[k] for k in ("ranges", "odom_pose", "timestamp"))
    angles = np.deg2rad(np.arange(scans.shape[1]) * (180.0 / scans.shape[1]) - 90.0)
    called = {"intel": "Intel Research Lab", "fr079": "Freiburg, building 079"}[name]
    return Log(called, Laser(angles), scans.astype(float), odometry, stamps)


def first(log: Log, used: int) -> Log:
    """The beginning of a log, so many scans that are used."""
    keys = keyframes(log.odometry)
    end = int(keys[used]) if used < len(keys) else len(log.scans)
    truth = None if log.truth is None else log.truth[:end]
    return log._replace(
        scans=log.scans[:end], odometry=log.odometry[:end], stamps=log.stamps[:end], truth=truth
    )


def relations(data: Path, name: str) -> np.ndarray:
    """True relative poses: two stamps, and the second pose seen from the first, shape (relations, 5)."""
    return np.loadtxt(data / "slam" / f"{name}.relations")[:, [0, 1, 2, 3, 7]]


def relation_errors(
    true: np.ndarray, a: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """By how much relative poses are off, in m and rad; nothing is aligned, as Kümmerle et al. have it."""
    off = between(true[:, 2:], between(a, b))
    return np.hypot(off[:, 0], off[:, 1]), np.abs(wrap(off[:, 2]))


def at_stamps(log: Log, poses: np.ndarray, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the scans next to some stamps, and by how many seconds they are off."""
    at = np.abs(log.stamps - stamps[:, None]).argmin(axis=1)
    return poses[at], np.abs(log.stamps[at] - stamps)


# ---- pictures -----------------------------------------------------------------------------------


def draw(log: Log, found: Run) -> Any:
    """The map with the path, what the wheels say, and the spread along the way."""
    figure, panels = picture.axes([["map", "wheels"], ["map", "spread"]], (13.5, 7.8))
    draw_map(panels["map"], found.map)
    panels["map"].plot(*found.path[:, :2].T, color=picture.DRAWS, lw=1.2)
    panels["map"].set_title(f"{log.name}: the best particle's map and path")
    ax = panels["wheels"]
    wheels = between(log.odometry[0], log.odometry)
    ax.plot(*wheels[:, :2].T, color=picture.FAINT, lw=1.0, label="by the wheels alone")
    ax.plot(*found.path[:, :2].T, color=picture.DRAWS, lw=1.2, label="mapped")
    if log.truth is not None:
        truth = between(log.truth[0], log.truth)
        ax.plot(*truth[:, :2].T, color=picture.OTHER, lw=1.0, ls=":", label="true")
    ax.set(aspect="equal", xlabel="m", ylabel="m", title="the path")
    ax.legend(frameon=False, fontsize=9)
    ax = panels["spread"]
    ax.plot(found.spread, color=picture.EXACT, lw=1.2)
    ax.set(xlabel="scans used", ylabel="m", title="spread of the particles' positions")
    return figure


def draw_map(ax: Any, grown: GridMap, extent: tuple[float, ...] | None = None) -> Any:
    """Obstacles dark, free space light, what nobody has seen grey."""
    grid = grown.grid()
    shown = np.where(np.isnan(grid.occupancy), 0.35, grid.occupancy)
    image = ax.imshow(
        shown.T, origin="lower", extent=grid.extent, cmap="gray_r", vmin=0, vmax=1, zorder=0
    )
    left, right, bottom, top = extent or grid.extent
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
    ax.set_facecolor("0.65")
    return image


def animate(log: Log, found: Run, path: Path) -> None:
    """Write the map as it grows as a GIF."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    plt = picture.pyplot()
    extent = found.map.grid().extent
    figure, ax = plt.subplots(figsize=(6.0, 5.0), layout="constrained")

    def show(k: int) -> tuple[Any, ...]:
        ax.clear()
        image = draw_map(ax, found.grown[k], extent)
        (way,) = ax.plot(*found.path[: k + 1, :2].T, color=picture.DRAWS, lw=1.0)
        ax.plot(*found.path[k, :2], "o", color=picture.OTHER, ms=5)
        ax.set_title(f"{log.name}: {k + 1} scans")
        return image, way

    moving = FuncAnimation(figure, show, frames=sorted(found.grown))
    path.parent.mkdir(parents=True, exist_ok=True)
    moving.save(path, PillowWriter(fps=6), dpi=80)
    plt.close(figure)
    print(f"wrote {path}")


def report(log: Log, found: Run, true: np.ndarray | None = None) -> None:
    """Print what it came to."""
    drove = log.stamps[-1] - log.stamps[0]
    print(f"{log.name}: {len(found.used)} of {len(log.scans)} scans, {PARTICLES} particles")
    if log.truth is not None:
        there, wheels = between(log.truth[0], log.truth), between(log.odometry[0], log.odometry)
        error, own = (pose_errors(p, there)[0] for p in (found.poses, wheels))
        print(f"  error of the path: mean {error.mean():.3f} m, at most {error.max():.3f} m")
        print(f"  by its wheels alone: mean {own.mean():.2f} m, at most {own.max():.2f} m")
    if true is not None:
        (a, late), (b, later) = (at_stamps(log, found.poses, true[:, k]) for k in (0, 1))
        own = np.maximum(late, later) < 0.005
        error = relation_errors(true, a, b)[0][own]
        print(f"  error by {own.sum()} relations, nothing aligned: mean {error.mean():.3f} m")
    print(f"  maps of all particles, what they share counted once: {found.size / 2**20:.1f} MiB")
    print(f"  {found.seconds:.0f} s of processor time", end="")
    print("" if log.truth is not None else f"; the robot drove for {drove:.0f} s")


def main(arguments: Sequence[str] | None = None) -> None:
    """Map the made-up floor, and the Intel Research Lab where its log is at hand."""
    options = picture.options(__doc__, arguments)
    data = reference.folder()
    logs = {"slam_grid": (generated(), None)}
    if data is not None and (data / "slam" / "intel.relations").exists() and not options.fast:
        logs["slam_grid_intel"] = (real(data, "intel"), relations(data, "intel"))
    print(f"Grid SLAM on: {', '.join(log.name for log, _ in logs.values())}")
    for name, (whole, true) in logs.items():
        log = first(whole, QUICK) if options.fast else whole
        count = len(keyframes(log.odometry))
        frames = () if options.fast else np.unique(np.linspace(0, count - 1, FRAMES).astype(int))
        found = mapped(log, frames=frames)
        report(log, found, true)
        picture.save(draw(log, found), options.out, name)
        print(f"wrote {write_map(found.map.grid(), options.out / f'{name}_map.yaml')}")
        if not options.fast:
            animate(log, found, options.out / f"{name}.gif")


if __name__ == "__main__":
    main()
