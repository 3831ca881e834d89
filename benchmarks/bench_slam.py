"""How well buildings are mapped from scans alone, by relations between poses that people found: seed by seed.

``python -m benchmarks.bench_slam [intel | fr079 ...] [--seeds N] [--particles N]``; both logs and five
seeds by default. The metric is that of Kümmerle et al. (2009): the mean over all relations of by how
much a relative pose is off; nothing is aligned. The logs are those of the reference data
(``BAYESMC_DATA``, else ``../shared/data``), and the model and the filter are those of ``examples.slam_grid``.

Relations have stamps. ``own``: both are those of scans of the log, within 5 ms. ``all``: poses between scans
follow from the wheels as GMapping's log has them (Intel), or lie between those of the neighbours (Freiburg).
Beside them stand the wheels alone, and the poses that GMapping found.
"""

from __future__ import annotations

import argparse
import gzip
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bayesmc.robotics import between, compose, wrap
from benchmarks.harness import data_folder
from examples import slam_grid
from examples.slam_grid import Log

LOGS = {"intel": 0.08, "fr079": 0.065}  # m
FASTER = 5.0  # than the robot drove
NEAR = 0.005  # s
CLOCK = 976052857.3372376  # s: where the clock of GMapping's log begins

Track = Callable[[np.ndarray], np.ndarray]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each seed, and what is known of others."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "logs", nargs="*", metavar="LOG", help=f"{', '.join(LOGS)}; both by default"
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--particles", type=int, default=slam_grid.PARTICLES)
    options = parser.parse_args(arguments)
    for name in options.logs or LOGS:
        if name not in LOGS:
            parser.error(f"there is no log {name!r}; there are {', '.join(LOGS)}")
        if not (data_folder() / "slam" / f"{name}.relations").exists():
            print(f"{name}: no data; set BAYESMC_DATA to have this figure", flush=True)
            continue
        figure(name, range(options.seeds), options.particles)


def figure(name: str, seeds: Sequence[int], particles: int) -> None:
    """One log."""
    data = data_folder()
    log, true = slam_grid.real(data, name), slam_grid.relations(data, name)
    drove = log.stamps[-1] - log.stamps[0]
    print(f"{log.name}: {len(log.scans)} scans, {len(true)} relations, {drove:.0f} s")
    print(
        f"  at most {LOGS[name]} m, {FASTER:g} times faster than the robot drove; {particles} particles"
    )
    between_scans = _by_wheels(data) if name == "intel" else None
    for what, poses in (("wheels", log.odometry), ("GMapping", corrected(data, name))):
        print(f"  {what:9s}{told(log, poses, true, between_scans)}", flush=True)
    for seed in seeds:
        found = slam_grid.mapped(log, particles, seed)
        line = told(log, found.poses, true, between_scans)
        print(
            f"  seed {seed}   {line}; {found.seconds:.0f} s ({drove / found.seconds:.1f} times faster), "
            f"maps {found.size / 2**20:.1f} MiB",
            flush=True,
        )


def told(
    log: Log, poses: np.ndarray, true: np.ndarray, between_scans: tuple[np.ndarray, ...] | None
) -> str:
    """The errors of a path in words."""
    (a, late), (b, later) = (slam_grid.at_stamps(log, poses, true[:, k]) for k in (0, 1))
    own = np.maximum(late, later) < NEAR
    error, turned = slam_grid.relation_errors(true[own], a[own], b[own])
    words = f"own {error.mean():.4f} +- {error.std():.4f} m, {turned.mean():.4f} rad ({own.sum()})"
    if between_scans is None:
        a, b = (_between_neighbours(log.stamps, poses, true[:, k]) for k in (0, 1))
        error, turned = slam_grid.relation_errors(true, a, b)
    else:
        (a, one), (b, other) = (_carried(between_scans, poses, true[:, k]) for k in (0, 1))
        error, turned = slam_grid.relation_errors(true[one & other], a[one & other], b[one & other])
    return words + (
        f"; all {error.mean():.4f} +- {error.std():.4f} m, {turned.mean():.4f} rad ({len(error)})"
    )


def corrected(data: Path, name: str) -> np.ndarray:
    """The poses that GMapping found."""
    folder = {"intel": "robot/intel", "fr079": "slam"}[name]
    with np.load(data / folder / f"{name}_laser_odom_corrected.npz") as log:
        return np.asarray(log["corrected_pose"])


# ---- private ------------------------------------------------------------------------------------


def _between_neighbours(stamps: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses between those of two scans."""
    k = np.clip(np.searchsorted(stamps, at) - 1, 0, len(stamps) - 2)
    share = np.clip((at - stamps[k]) / (stamps[k + 1] - stamps[k]), 0.0, 1.0)[:, None]
    step = poses[k + 1] - poses[k]
    step[:, 2] = wrap(step[:, 2])
    return np.asarray(poses[k] + share * step)


def _by_wheels(data: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of GMapping's log, the last scan before each, and what the wheels say since."""
    times, scan, since = [], [], []
    count, start = -1, None
    with gzip.open(data / "robot" / "intel" / "intel.gfs.log.gz", "rt") as lines:
        for words in map(str.split, lines):
            if words[0] == "FLASER":
                count, start = count + 1, None
            elif words[0] == "ODOM":
                pose = np.array([float(w) for w in words[1:4]])
                start = pose if start is None else start
                if float(words[7]):  # the first after a scan has no time
                    times.append(float(words[7]) + CLOCK)
                    scan.append(count)
                    since.append(between(start, pose))
    return np.array(times), np.array(scan), np.array(since)


def _carried(
    wheels: tuple[np.ndarray, ...], poses: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses at some times by the wheels since the last scan, and whether there was one."""
    times, scan, since = wheels
    k = np.abs(times - at[:, None]).argmin(axis=1)
    there = (scan[k] >= 0) & (scan[k] < len(poses))
    return compose(poses[np.clip(scan[k], 0, len(poses) - 1)], since[k]), there


if __name__ == "__main__":
    main()
