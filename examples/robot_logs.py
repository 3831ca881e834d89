"""A helper, not a script: logs of robots as arrays, and Monte Carlo localisation of any of them.

A log is a map, scans, what odometry says happened in between, and the true poses where somebody knows them.
There are always the files that ``robot_world`` makes; where the reference data is at hand
(``BAYESMC_DATA``, or ``../shared/data`` beside the checkout) there are a lap through the Intel Research
Lab, and two logs of Wean Hall. Whatever the log, the net is the same one, and so are the functions that
measure how well it localises:

    pose given pose_prev and motion   OdometryMotion with noise on two rotations and a translation
    on_floor given pose               always seen as True: no robot stands in a wall
    scan given pose                   LikelihoodField: end points of beams lie near obstacles

Beams of one scan share their errors (a map that is a little off, people), so that their product is far too
sure; the exponent ``tempering`` makes up for it: .3 for a robot that knows where it is, .05 for one that has
no idea, since with some particles for each square metre none is quite right. On the made-up floor, where
many corners look alike, it is .02 then: better to wait than to be sure too soon.

Dellaert, Fox, Burgard and Thrun (1999), Monte Carlo localization for mobile robots, ICRA; Thrun, Burgard
and Fox (2005), Probabilistic Robotics, chapter 8. Intel: D. Haehnel's log, poses by GMapping. Wean Hall:
Carnegie Mellon.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import (
    FreeSpace,
    LikelihoodField,
    OccupancyGrid,
    OdometryMotion,
    PoseNormal,
    SensorPoses,
    between,
    clean_ranges,
    compose,
    pose_errors,
    read_map,
)
from bayesmc.robotics.logs import Keyframe, keyframes, pose_at, read_carmen, read_wean
from examples import picture, robot_world

REACH = 30.0  # m, from which on a laser's reading is none
ALPHAS = (0.01, 0.0025, 0.01, 0.0025)  # variances of odometry, per step between scans
TRACKING, GLOBAL, BARE = 0.3, 0.05, 0.02  # tempering; the last for rooms with little in them
NEAR = (0.1, 0.1, 0.05)  # standard deviations of a known start: m, m, rad
FOUND = 0.5  # m: error below which a robot knows where it is
HELD = 20  # scans for which it has to know it


class Log(NamedTuple):
    """What a robot brings home.

    Attributes
    ----------
    name : str
    grid : OccupancyGrid
    angles : ndarray, shape (beams,)
        Of the beams, in rad.
    scans : ndarray, shape (time, beams)
        Ranges in m, ``reach`` where nothing was seen.
    motion : ndarray, shape (time, 3)
        Each pose seen from the one before, by odometry; zeros for the first.
    truth : ndarray, shape (time, 3), or None
    mount : tuple of float
        Pose of the range finder on the robot.
    reach : float
        Range of the sensor in m.
    caution : float
        Tempering for a robot that may be anywhere.
    noise : tuple of float
        Of the wheels: four variances, see ``OdometryMotion``.
    hits : float
        Share of beams that end at what is on the map: fewer where people walk about.
    free : float, optional
        Occupancy below which a cell is floor, where that is less than the map's threshold.
    """

    name: str
    grid: OccupancyGrid
    angles: np.ndarray
    scans: np.ndarray
    motion: np.ndarray
    truth: np.ndarray | None
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reach: float = REACH
    caution: float = GLOBAL
    noise: tuple[float, float, float, float] = ALPHAS
    hits: float = 0.8
    free: float | None = None

    @property
    def floor(self) -> FreeSpace:
        """Where the robot can be."""
        return FreeSpace(self.grid, threshold=self.free)

    @property
    def dead_reckoning(self) -> np.ndarray:
        """Poses by odometry alone, from the true first one (or the origin), shape (time, 3)."""
        poses = [np.zeros(3) if self.truth is None else self.truth[0]]
        for step in self.motion[1:]:
            poses.append(compose(poses[-1], step))
        return np.array(poses)


# ---- logs ---------------------------------------------------------------------------------------


def generated(sensor: str = "laser", every: int = 3, seed: int = 0) -> Log:
    """The made-up floor, by way of files: ``sensor`` is ``"laser"`` or ``"sonar"``."""
    with tempfile.TemporaryDirectory() as folder:
        made = robot_world.write_world(robot_world.world(seed), Path(folder))
        name = "Generated floor" if sensor == "laser" else f"Generated floor, {sensor}"
        return carmen(made, sensor, every)._replace(name=name, caution=BARE)


def carmen(folder: Path, sensor: str = "laser", every: int = 3) -> Log:
    """A folder with ``map.yaml``, ``laser.log.gz`` (or ``sonar``) and perhaps ``truth.log.gz``."""
    found = list(keyframes(read_carmen(folder / f"{sensor}.log.gz"), 0.39, 0.3))
    known = folder / "truth.log.gz"
    truth = None
    if known.exists():
        truth = pose_at(list(read_carmen(known)), [key.laser.t for key in found])
    reach = min(REACH, found[0].laser.max_range)
    return _log(folder.name, read_map(folder / "map.yaml"), found, truth, reach, every)


def intel(data: Path, every: int = 3) -> Log:
    """Intel Research Lab: the map is made of the even scans, and the odd ones are localised on it."""
    folder = data / "robot" / "intel"
    with np.load(folder / "intel_map_even_scans.npz") as m:
        origin = (float(m["origin"][0]), float(m["origin"][1]))
        grid = OccupancyGrid.from_counts(m["hits"], m["free"], 0.1, origin, threshold=0.3)
    with np.load(folder / "intel_laser_odom_corrected.npz") as log:
        ranges, odometry, truth = (
            log[name][1::2] for name in ("ranges", "odom_pose", "corrected_pose")
        )
    beams = np.arange(0, ranges.shape[1], every)
    motion = np.concatenate([np.zeros((1, 3)), between(odometry[:-1], odometry[1:])])
    scans = clean_ranges(ranges[:, beams], REACH)
    return Log("Intel Research Lab", grid, np.deg2rad(beams - 90.0), scans, motion, truth)


def wean(data: Path, number: int, every: int = 3) -> Log:
    """Wean Hall, log 1 or 4; nobody knows the true poses.

    The map is a picture that shades what was hardly seen, people walk along, and the wheels slip.
    """
    folder = data / "robot" / "wean"
    with np.load(folder / "wean_map_from_gif.npz") as m:
        cells = m["occupancy_xy"].astype(float)
    grid = OccupancyGrid(np.where(cells < 0.0, np.nan, cells), 0.1)
    found = list(keyframes(read_wean(folder / f"robotdata{number}.log.gz")))
    log = _log(f"Wean Hall, log {number}", grid, found, None, REACH, every)
    return log._replace(caution=0.1, noise=(0.04, 0.02, 0.04, 0.02), hits=0.5, free=0.1)


def first(log: Log, scans: int) -> Log:
    """The beginning of a log."""
    truth = None if log.truth is None else log.truth[:scans]
    return log._replace(scans=log.scans[:scans], motion=log.motion[:scans], truth=truth)


def spliced(log: Log, at: int, to: int, length: int | None = None) -> Log:
    """The kidnapped robot: the first ``at`` scans, then those from ``to`` on (so many of them, or all).

    The wheels say that nothing has happened in between.
    """
    end = len(log.scans) if length is None else min(to + length, len(log.scans))
    kept = np.r_[np.arange(at), np.arange(to, end)]
    motion = log.motion[kept]
    motion[at] = 0.0
    truth = None if log.truth is None else log.truth[kept]
    return log._replace(scans=log.scans[kept], motion=motion, truth=truth)


def carried_off(log: Log, rng: np.random.Generator, far: float = 10.0) -> tuple[Log, int]:
    """The log spliced at a random scan to one at least ``far`` metres away, and where it was cut."""
    truth = _known(log)
    quarter = len(truth) // 4
    at = int(rng.integers(quarter // 2, 2 * quarter))
    away = np.hypot(*(truth[:, :2] - truth[at - 1, :2]).T) >= far
    away[-min(120, 2 * quarter) :] = False  # enough is left to find back in
    return spliced(log, at, int(rng.choice(np.flatnonzero(away))), 150), at


# ---- the net, and a filter on it ----------------------------------------------------------------


def net(log: Log, start: Any, scan: Callable[[Any], bmc.Distribution]) -> bmc.DynamicBayesNet:
    """A robot that moves as its wheels say, up to noise, stays out of walls, and has a sensor."""
    dbn, floor = bmc.DynamicBayesNet(log.name), log.floor
    dbn.input("motion", event_shape=(3,))

    @dbn.node(initial=start)
    def pose(pose_prev, motion):
        return OdometryMotion(pose_prev, motion, log.noise)

    @dbn.node
    def on_floor(pose):  # a map may be wrong in one of a hundred places
        return bmc.Bernoulli(np.where(floor.cell_of(pose) >= 0, 0.99, 0.01))

    dbn.add("scan", lambda pose: scan(pose))
    return dbn


def model(
    log: Log, start: Any, tempering: float = TRACKING, sigma: float = 0.2
) -> bmc.DynamicBayesNet:
    """The net with the likelihood field of the log's map for a sensor; ``sigma`` in m."""
    seen = field(log, sigma, tempering)
    return net(log, start, lambda pose: seen.given(pose, log.angles))


def field(log: Log, sigma: float, tempering: float) -> LikelihoodField:
    """The likelihood field of the log's map."""
    return LikelihoodField(
        log.grid, sigma, log.hits, 1.0 - log.hits, log.reach, log.mount, tempering
    )


def aimed(log: Log, spacing: float = 0.5, headings: int = 36) -> SensorPoses:
    """Where a scan says the robot could be: bins of half a metre and ten degrees, and a field to match."""
    coarse = field(log, 0.3, 2.0 * log.caution)
    return SensorPoses(
        log.floor, lambda pose: coarse.given(pose, log.angles), spacing, headings, even=0.1
    )


def looking(log: Log, share: float = 0.01, draws: float = 0.05) -> bmc.Recovery:
    """Recovery that draws from where the scan says the robot could be."""
    aim = aimed(log)
    return bmc.Recovery(
        {"pose": log.floor}, share, draws=draws, proposal={"pose": lambda scan: aim.given(scan)}
    )


def near(log: Log) -> PoseNormal:
    """A start that is known."""
    return PoseNormal(_known(log)[0], scale_diag=NEAR)


def localized(
    dbn: bmc.DynamicBayesNet, log: Log, engine: Any, rng: Any, keep: str | None = None
) -> Any:
    """Beliefs about all slices of a log."""
    seen = {"scan": log.scans, "on_floor": np.ones(len(log.scans), dtype=bool)}
    return bmc.filter(dbn, seen, inputs={"motion": log.motion}, engine=engine, rng=rng, keep=keep)


def beliefs(dbn: bmc.DynamicBayesNet, log: Log, engine: Any, rng: Any) -> Iterator[Any]:
    """The same slice by slice, as on a robot: particles of one slice at a time, not of all."""
    belief = engine.start(dbn, rng=rng)
    for scan, motion in zip(log.scans, log.motion, strict=True):
        belief = engine.step(belief, {"scan": scan, "on_floor": True}, inputs={"motion": motion})
        yield belief


def adaptive(particles: int, least: int = 500, **options: Any) -> bmc.ParticleFilter:
    """At most so many particles: as many as half a metre's and 15 degrees' bins need (KLD sampling)."""
    bins = bmc.KLD({"pose": (0.5, 0.5, np.deg2rad(15.0))}, least=least)
    return bmc.ParticleFilter(particles, adapt=bins, **options)


# ---- how well -----------------------------------------------------------------------------------


def errors(log: Log, poses: np.ndarray) -> np.ndarray:
    """Distances in m from the true positions, shape (time,)."""
    return pose_errors(poses, _known(log))[0]


def tracking(log: Log, particles: int, rng: Any, **options: Any) -> np.ndarray:
    """Errors of a robot that knows where it starts, shape (time,); ``options`` of ``model``."""
    engine = bmc.ParticleFilter(particles)
    found = localized(model(log, near(log), **options), log, engine, rng)
    return errors(log, found.mean("pose"))


def anywhere(log: Log, particles: int | bmc.ParticleFilter, rng: Any, **options: Any) -> np.ndarray:
    """Estimated poses of a robot that starts anywhere on the map, shape (time, 3).

    ``particles`` is their number, drawn from where the first scan says it could be, or a filter with options
    of its own; ``options`` are those of ``model``.
    """
    engine = particles
    if isinstance(engine, int):
        aim = aimed(log)
        first_look = {"pose": lambda scan: aim.given(scan)}
        engine = bmc.ParticleFilter(engine, initial_proposal=first_look)
    dbn = model(log, log.floor, **{"tempering": log.caution, **options})
    return localized(dbn, log, engine, rng).mean("pose")


def lost(log: Log, particles: int | bmc.ParticleFilter, rng: Any, **options: Any) -> np.ndarray:
    """Errors of one that starts anywhere on the map, shape (time,)."""
    return errors(log, anywhere(log, particles, rng, **options))


def kidnapped(
    log: Log, particles: int, recovery: bmc.Recovery | None, rng: Any, **options: Any
) -> np.ndarray:
    """Errors on a log that was spliced, from a known start, shape (time,)."""
    engine = bmc.ParticleFilter(particles, recovery=recovery)
    dbn = model(log, near(log), **{"tempering": log.caution, **options})
    return errors(log, localized(dbn, log, engine, rng).mean("pose"))


def recovery_time(error: np.ndarray, at: int, held: int = HELD) -> int | None:
    """Scans after slice ``at`` until the error is below half a metre and stays there, or None."""
    good = error[at:] < FOUND
    for k in range(len(good) - held + 1):
        if good[k : k + held].all():
            return k
    return None


def inliers(log: Log, poses: np.ndarray, within: float = 0.3, reach: float = 20.0) -> np.ndarray:
    """Which end points lie near an obstacle, a flat array: a measure that needs no true poses.

    Beams that reach farther than ``reach`` are left out; a laser's beams are all wanted, ``every=1``.
    """
    sensor = compose(poses, np.array(log.mount))
    heading = sensor[:, 2:] + log.angles
    ends = sensor[:, None, :2] + log.scans[..., None] * np.stack(
        [np.cos(heading), np.sin(heading)], axis=-1
    )
    points = ends[log.scans < reach]
    inside = log.grid.contains(points)
    distance = np.full(len(points), np.inf)
    distance[inside] = log.grid.distances[tuple(log.grid.cell_of(points[inside]).T)]
    return distance <= within


def last_half(log: Log, poses: np.ndarray) -> float:
    """Share of ``inliers`` over the second half of a log: how Wean Hall, without truth, is judged."""
    half = len(poses) // 2
    return float(inliers(log._replace(scans=log.scans[half:]), poses[half:]).mean())


# ---- pictures -----------------------------------------------------------------------------------


def draw_map(ax: Any, log: Log, margin: float = 1.0) -> None:
    """The map: obstacles dark, free space white, the unknown grey; cut to what is known."""
    shown = np.where(log.grid.occupied(), 1.0, np.where(log.grid.free(), 0.0, 0.25))
    ax.imshow(
        shown.T, origin="lower", extent=log.grid.extent, cmap="Greys", vmax=1.4, zorder=0,
        interpolation="antialiased",
    )  # fmt: skip
    ix, iy = np.nonzero(log.grid.free())
    low = log.grid.center_of([ix.min(), iy.min()]) - margin
    high = log.grid.center_of([ix.max(), iy.max()]) + margin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)  # a bar says how long things are
    ax.plot(low[0] + margin + np.array([0.0, 5.0]), [low[1] + 0.4 * margin] * 2, "k", lw=3)
    ax.annotate(
        "5 m", (low[0] + margin + 5.0, low[1] + 0.4 * margin), xytext=(5, 0),
        textcoords="offset points", va="center", fontsize=8,
    )  # fmt: skip


def draw_cloud(ax: Any, poses: np.ndarray, truth: np.ndarray | None) -> None:
    """Particles, and the true pose with an arrow along its heading."""
    ax.scatter(*poses[:, :2].T, s=4, color=picture.DRAWS, lw=0, zorder=2, rasterized=True)
    if truth is not None:
        draw_robot(ax, truth)


def draw_robot(ax: Any, pose: np.ndarray, color: str = picture.OTHER, size: float = 1.6) -> None:
    """A ring, so that particles are seen in it, and an arrow."""
    dx, dy = size * np.cos(pose[2]), size * np.sin(pose[2])
    ax.annotate(
        "", (pose[0] + dx, pose[1] + dy), (pose[0], pose[1]),
        arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.5}, zorder=4,
    )  # fmt: skip
    ax.plot(pose[0], pose[1], "o", color=color, mfc="none", ms=9, mew=1.5, zorder=5)


def draw_paths(ax: Any, log: Log, estimate: np.ndarray) -> None:
    """The truth, the estimate and what the wheels make of it."""
    wheels = log.dead_reckoning
    ax.plot(*wheels[:, :2].T, ":", color=picture.FAINT, lw=1.4, label="by its wheels alone")
    if log.truth is not None:
        ax.plot(*log.truth[:, :2].T, color=picture.OTHER, lw=2.6, alpha=0.55, label="truth")
    ax.plot(*estimate[:, :2].T, color=picture.EXACT, lw=1.1, label="mean of the particles")


# ---- private ------------------------------------------------------------------------------------


def _log(
    name: str,
    grid: OccupancyGrid,
    found: list[Keyframe],
    truth: np.ndarray | None,
    reach: float,
    every: int,
) -> Log:
    first = found[0].laser
    x, y, heading = first.offset.round(6)  # logs give poses to a micrometre
    ranges = np.array([key.laser.ranges[::every] for key in found])
    motion = np.array([key.motion for key in found])
    return Log(
        name, grid, first.angles[::every], clean_ranges(ranges, reach), motion, truth,
        (float(x), float(y), float(heading)), reach,
    )  # fmt: skip


def _known(log: Log) -> np.ndarray:
    if log.truth is None:
        raise ValueError(f"{log.name}: nobody knows the true poses; use inliers")
    return log.truth
