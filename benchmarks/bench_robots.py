"""Localising a robot: one update beside a loop by hand and published C++ figures; rays, beams, bins.

``python -m benchmarks.bench_robots``; ``--short`` leaves out 100,000 particles and repeats less. An update is
what a robot does for each scan of its laser: move the particles as the wheels say (``OdometryMotion``), weigh
them by 60 beams (``LikelihoodField``), resample (systematic, every time). The drive is the made-up one of the
examples, so that nothing but the checkout is needed; a beam that saw nothing is left out by everybody.

The published figures are those of Beluga, a library of Monte Carlo localisation in C++, on another machine:
an order of magnitude to be near to, not a race. How well real robots are localised is in
``bench_robot_logs``.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from itertools import cycle
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import (
    BeamModel,
    Beams,
    FreeSpace,
    LikelihoodField,
    OccupancyGrid,
    OdometryMotion,
    PoseNormal,
    RayTable,
    SensorPoses,
    fit_beams,
    ray_cast,
)
from benchmarks.floors.localization import Floor, Localization
from benchmarks.harness import SelfTimed, Timing, interleave, table
from examples import robot_logs
from examples.robot_logs import Log

PARTICLES = {1_000: 60, 10_000: 30, 20_000: 20, 100_000: 6}  # to scans filtered
BELUGA = {1_000: 0.8, 10_000: 8.0}  # ms of an update
GOAL_BELUGA, GOAL_HERTZ, AT_RATE = 3.0, 10.0, 20_000
ALPHAS, NEAR, SIGMA, TEMPERING = (0.01, 0.0025, 0.01, 0.0025), (0.1, 0.1, 0.05), 0.2, 0.3
POSES = 2_000  # rays are cast from so many
READINGS = 20_000  # that the beam model is fitted to
BUDGET = 6.0  # seconds for one entry of a table


def main(arguments: Sequence[str] = ()) -> None:
    """Print every table."""
    warnings.simplefilter("ignore")
    short = "--short" in arguments
    repeats, log = 3 if short else 7, drive()
    print(updates(log, repeats, 20_000 if short else 100_000) + "\n", flush=True)
    print(rays(log, repeats) + "\n", flush=True)
    print(others(log, repeats), flush=True)


def drive() -> Log:
    """The made-up floor and a drive through it, 60 beams a scan."""
    return robot_logs.generated()


def net(log: Log) -> bmc.DynamicBayesNet:
    """A pose that moves as the wheels say, and a scan."""
    dbn, field = bmc.DynamicBayesNet("localisation"), sensor(log)
    dbn.input("motion", event_shape=(3,))

    @dbn.node(initial=PoseNormal(_start(log), scale_diag=NEAR))
    def pose(pose_prev, motion):
        return OdometryMotion(pose_prev, motion, ALPHAS)

    dbn.add("scan", lambda pose: field.given(pose, log.angles))
    return dbn


def sensor(log: Log) -> LikelihoodField:
    """The likelihood field of the log's map."""
    return LikelihoodField(
        log.grid, SIGMA, max_range=log.reach, mount=log.mount, tempering=TEMPERING
    )


def by_hand(log: Log) -> Localization:
    """The same model for the loop in NumPy."""
    field, grid = sensor(log), log.grid
    floor = Floor(
        field.log_density(), field.log_random, grid.resolution, grid.origin, log.reach, log.mount
    )
    return Localization(floor, log.angles, _start(log), NEAR, ALPHAS)


def run(dbn: bmc.DynamicBayesNet, log: Log, particles: int, seed: int) -> Any:
    """Beliefs about the slices of a log, by ``bmc.filter``."""
    inputs, engine = {"motion": log.motion}, bmc.ParticleFilter(particles, ess_threshold=1.0)
    return bmc.filter(
        dbn, {"scan": log.scans}, inputs=inputs, engine=engine, rng=seed, progress=False
    )


def step_by_step(dbn: bmc.DynamicBayesNet, log: Log, particles: int, seed: int) -> list[np.ndarray]:
    """The same row by row, as on a robot, with the mean pose after each."""
    engine, means = bmc.ParticleFilter(particles, ess_threshold=1.0), []
    belief = engine.start(dbn, rng=seed)
    for scan, motion in zip(log.scans, log.motion, strict=True):
        belief = engine.step(belief, {"scan": scan}, inputs={"motion": motion})
        means.append(belief.mean("pose"))
    return means


def updates(log: Log, repeats: int, most: int) -> str:
    """One update, in ms: by hand, of a whole log, row by row, and of the sensor alone."""
    rows: list[list[object]] = []
    dbn, loop, field = net(log), by_hand(log), sensor(log)
    for count, scans in PARTICLES.items():
        if count > most:
            continue
        part, seeds = robot_logs.first(log, scans), iter(range(10**6))
        poses = run(dbn, robot_logs.first(log, 2), count, 0).mean("pose")[-1]
        cloud = poses + np.random.default_rng(0).normal(0.0, NEAR, (count, 3))
        entries: dict[str, Callable[[], object] | SelfTimed] = {
            "floor": lambda n=count, part=part, s=seeds: loop.filtered(
                part.scans, part.motion, n, next(s)
            ),
            "bayesmc": lambda n=count, part=part, s=seeds: run(dbn, part, n, next(s)),
            "row by row": lambda n=count, part=part, s=seeds: step_by_step(dbn, part, n, next(s)),
            "sensor": lambda cloud=cloud, part=part: [
                field.given(cloud, log.angles).log_prob(scan) for scan in part.scans
            ],
        }
        rows += _judged(count, scans, interleave(entries, repeats, budget=BUDGET))
    beams = (log.scans < log.reach).sum(axis=1).mean()
    return table(
        f"one update, {log.scans.shape[1]} beams a scan ({beams:.0f} of them see something), "
        "motion and resampling included",
        ["", "ms", "over floor", "over Beluga", "Hz", ""],
        rows,
    )


def rays(log: Log, repeats: int) -> str:
    """Rays cast and looked up, from poses all over the floor, and those of a tracked cloud."""
    rng = np.random.default_rng(0)
    everywhere = FreeSpace(log.grid).sample(rng, sample_shape=POSES)
    cloud = _start(log) + rng.normal(0.0, NEAR, (POSES, 3))
    known = RayTable(log.grid, log.reach)
    for poses in (everywhere, cloud):
        known.ranges(poses, log.angles)  # cells that are known now
    entries: dict[str, Callable[[], object]] = {
        "exact, all over the floor": lambda: ray_cast(log.grid, everywhere, log.angles, log.reach),
        "exact, of a tracked cloud": lambda: ray_cast(log.grid, cloud, log.angles, log.reach),
        "table, all over the floor": lambda: known.ranges(everywhere, log.angles),
        "table, of a tracked cloud": lambda: known.ranges(cloud, log.angles),
    }
    times = interleave(entries, repeats, budget=BUDGET)
    beams = POSES * len(log.angles)
    rows = [[name, beams / t.median / 1e6, 1e9 * t.median / beams] for name, t in times.items()]
    nx, ny = log.grid.shape
    title = f"ray casting on {nx} x {ny} cells of {log.grid.resolution:g} m (tables: cells known)"
    return table(title, ["", "million beams/s", "ns per beam"], rows)


def others(log: Log, repeats: int) -> str:
    """What is done once, or once in a while."""
    model = BeamModel(max_range=log.reach)
    coarse = LikelihoodField(log.grid, 0.4, max_range=log.reach, mount=log.mount, tempering=0.2)
    expected = np.random.default_rng(0).uniform(0.5, 20.0, READINGS)
    readings = Beams(expected, BeamModel(0.7, 0.15, 0.05, 0.1, max_range=log.reach)).sample(1)
    aimed = SensorPoses(FreeSpace(log.grid), lambda pose: coarse.given(pose, log.angles))
    scans, start, scan = cycle(log.scans), _start(log), log.scans[0]  # two scans are remembered
    entries: dict[str, Callable[[], object]] = {
        f"fit_beams, {READINGS} readings": lambda: fit_beams(readings, expected, model),
        f"SensorPoses.given, {len(aimed.poses)} bins": lambda: aimed.given(next(scans)),
        "a map's likelihood field": lambda: (
            sensor(_anew(log)).given(start, log.angles).log_prob(scan)
        ),
    }
    times = interleave(entries, repeats, budget=BUDGET)
    return table("once in a while", ["", "ms"], [[n, 1e3 * t.median] for n, t in times.items()])


# ---- private ------------------------------------------------------------------------------------


def _start(log: Log) -> np.ndarray:
    assert log.truth is not None
    return log.truth[0]


def _anew(log: Log) -> Log:
    """The log with a map of which nothing is worked out yet."""
    grid = log.grid
    return log._replace(grid=OccupancyGrid(grid.occupancy, grid.resolution, grid.origin))


def _judged(count: int, scans: int, times: dict[str, Timing]) -> list[list[object]]:
    """Rows of the table of updates."""
    floor, rows = times["floor"].median, []
    for name, time in times.items():
        ms, goals = 1e3 * time.median / scans, []
        over: object = ms / BELUGA[count] if count in BELUGA else ""
        if name == "bayesmc":
            if count in BELUGA:
                goals.append(_said("Beluga", ms / BELUGA[count], GOAL_BELUGA, below=True))
            if count == AT_RATE:
                goals.append(_said("Hz", 1e3 / ms, GOAL_HERTZ, below=False))
        rows.append(
            [
                f"{name}, {count} particles",
                ms,
                time.median / floor,
                "" if name in ("floor", "sensor") else over,
                1e3 / ms,
                "; ".join(goals),
            ]
        )
    return rows


def _said(what: str, found: float, goal: float, below: bool) -> str:
    met = found < goal if below else found >= goal
    return f"{what} {'<' if below else '>='} {goal:g}: {'met' if met else 'MISSED'}"


if __name__ == "__main__":
    main(sys.argv[1:])
