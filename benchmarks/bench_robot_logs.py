"""How well the logs of real robots are localised, with the goals of each and the seeds: one line per figure.

``python -m benchmarks.bench_robot_logs [NAME ...] [--seeds N]``; the names are ``tracking``, ``global``,
``kidnapped``, ``wean1``, ``wean4``, ``mrclam``, ``plaza``, all of them by default. Every line is printed as
soon as it is known. With ``--seeds`` below those that a goal is stated for, what is printed is the figure of
these seeds, and the goal is scaled to their number.

The logs are those of the reference data (``BAYESMC_DATA``, else ``../shared/data``); what is not there is
left out, and named. The models are those of the examples, which say what is in them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.harness import data_folder
from examples import landmark_localization, range_only, robot_logs

SEEDS, FEW = range(10), range(5)
TRACKED, ANYWHERE, FOUND_BY = 500, 20_000, 100  # particles, particles, scans
GOAL_TRACKING, GOAL_GLOBAL, GOAL_MANY = 0.09, 0.3, 0.9  # m, m, and the share of seeds
GOAL_WEAN = {1: 0.85, 4: 0.95}
GOAL_MRCLAM, GOAL_PLAZA = 1.05, 1.06  # over the reference's error, and m

Figure = Callable[[Path, Sequence[int]], None]


def main(arguments: Sequence[str] = ()) -> None:
    """Print the figures that are asked for."""
    options = _options(arguments)
    warnings.simplefilter("ignore")
    folder = data_folder() / "robot"
    for name in options.names or FIGURES:
        figure, needed, seeds = FIGURES[name]
        if not (folder / needed).exists():
            print(f"{name}: no {folder / needed}; set BAYESMC_DATA to have this figure", flush=True)
            continue
        start = time.perf_counter()
        figure(data_folder(), seeds[: options.seeds] if options.seeds else seeds)
        print(f"  ({time.perf_counter() - start:.0f} s)\n", flush=True)


# ---- figures ------------------------------------------------------------------------------------


def tracking(data: Path, seeds: Sequence[int]) -> None:
    """Intel, from a known start: root mean square error, the mean over the seeds."""
    log = robot_logs.intel(data)
    print(f"Intel Research Lab, tracking, {TRACKED} particles, {len(log.scans)} scans")
    found = []
    for seed in seeds:
        found.append(_rms(robot_logs.tracking(log, TRACKED, seed)))
        _line(f"seed {seed}", f"RMSE {found[-1]:.4f} m")
    wheels = _rms(robot_logs.errors(log, log.dead_reckoning))
    _line("dead reckoning", f"RMSE {wheels:.1f} m")
    mean = float(np.mean(found))
    _verdict(
        f"mean of {len(found)} seeds",
        f"{mean:.4f} m",
        f"<= {GOAL_TRACKING} m",
        mean <= GOAL_TRACKING,
    )


def anywhere(data: Path, seeds: Sequence[int]) -> None:
    """Intel, from anywhere on the map: the median error over the second half of the log."""
    log = robot_logs.intel(data)
    print(f"Intel Research Lab, global localisation, {ANYWHERE} particles at most")
    good = []
    for seed in seeds:
        error = robot_logs.lost(log, ANYWHERE, seed)
        median = float(np.median(error[len(error) // 2 :]))
        good.append(median < GOAL_GLOBAL)
        _line(f"seed {seed}", f"median {median:.3f} m over the second half")
    _count(good, f"below {GOAL_GLOBAL} m")


def kidnapped(data: Path, seeds: Sequence[int]) -> None:
    """Intel, spliced to a scan at least 10 m away: scans until found and held."""
    log = robot_logs.intel(data)
    recovery = robot_logs.looking(log)
    print(f"Intel Research Lab, kidnapped, {ANYWHERE} particles; each seed has a splice of its own")
    good = []
    for seed in seeds:
        spliced, at = robot_logs.carried_off(log, np.random.default_rng(seed))
        error = robot_logs.kidnapped(spliced, ANYWHERE, recovery, seed)
        after = robot_logs.recovery_time(error, at)
        found = after is not None and after <= FOUND_BY
        worst = np.inf if after is None else error[at + after :].max()
        good.append(found and worst < robot_logs.FOUND)
        when = "never" if after is None else f"after {after} scans, then at most {worst:.2f} m"
        _line(f"seed {seed}", f"cut at {at}, found {when} to the end")
    _count(good, f"found by scan {FOUND_BY}, and for good")


def wean(number: int) -> Figure:
    """A log of Wean Hall, from anywhere: end points near obstacles over the last half."""

    def figure(data: Path, seeds: Sequence[int]) -> None:
        log, every = robot_logs.wean(data, number), robot_logs.wean(data, number, every=1)
        print(f"{log.name}, global localisation, {ANYWHERE} particles at most")
        good = []
        for seed in seeds:
            poses = robot_logs.anywhere(log, ANYWHERE, seed)
            share = robot_logs.last_half(every, poses)
            good.append(share >= GOAL_WEAN[number])
            x, y, heading = poses[-1]
            _line(f"seed {seed}", f"share {share:.3f}, ends at ({x:.1f}, {y:.1f}, {heading:.2f})")
        _count(good, f"a share of {GOAL_WEAN[number]} or more")

    return figure


def mrclam(data: Path, seeds: Sequence[int]) -> None:
    """MRCLAM 6: both filters of one declared model against a small extended Kalman filter by hand."""
    print(f"MRCLAM 6, landmarks, {landmark_localization.PARTICLES} particles, mean RMSE of seeds")
    for robot in range(1, 6):
        found = landmark_localization.figures(data / "robot" / "mrclam6", [robot], seeds)[robot]
        goal = GOAL_MRCLAM * found["reference"]
        _line(f"robot {robot}", f"dead reckoning {found['dead reckoning']:.3f} m")
        for name in ("particles", "extended Kalman"):
            text = f"{found[name]:.3f} m, {found[name] / found['reference']:.2f} of the reference"
            _verdict(f"robot {robot}, {name}", text, f"<= {goal:.3f} m", found[name] <= goal)


def plaza(data: Path, seeds: Sequence[int]) -> None:
    """Plaza 1: ranges alone, their bias estimated."""
    print(f"Plaza 1, range only, {range_only.PARTICLES} particles, mean RMSE of seeds")
    found = range_only.figures(data / "robot" / "plaza", seeds)
    for name, each in found.items():
        text = f"{each['rmse']:.3f} m"
        if "bias" in each:
            text += f", bias {each['bias']:.2f} +- {each['sd']:.2f} m"
        if name.endswith("growing"):  # the model that is put forward
            _verdict(name, text, f"<= {GOAL_PLAZA} m", each["rmse"] <= GOAL_PLAZA)
        else:
            _line(name, text)


#: name -> figure, what it needs of the reference data, and the seeds that its goal is stated for
FIGURES: dict[str, tuple[Figure, str, Sequence[int]]] = {
    "tracking": (tracking, "intel", SEEDS),
    "global": (anywhere, "intel", SEEDS),
    "kidnapped": (kidnapped, "intel", SEEDS),
    "wean1": (wean(1), "wean", SEEDS),
    "wean4": (wean(4), "wean", SEEDS),
    "mrclam": (mrclam, "mrclam6", FEW),
    "plaza": (plaza, "plaza", FEW),
}


# ---- private ------------------------------------------------------------------------------------


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_robot_logs")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(FIGURES))
    parser.add_argument("--seeds", type=int, help="how many seeds, from 0 on")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in FIGURES]
    if unknown or (options.seeds is not None and options.seeds < 1):
        parser.error(f"give some of {', '.join(FIGURES)}, and one seed or more")
    return options


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _line(what: str, said: str) -> None:
    print(f"  {what:42}{said}", flush=True)


def _verdict(what: str, said: str, goal: str, met: bool) -> None:
    _line(what, f"{said:40} goal {goal}: {'met' if met else 'MISSED'}")


def _count(good: Sequence[bool], what: str) -> None:
    """How many seeds are good; nine in ten are to be."""
    least = math.ceil(GOAL_MANY * len(good))
    said = f"{sum(good)} of {len(good)} seeds"
    _verdict(what, said, f"{least} of {len(good)}", sum(good) >= least)


if __name__ == "__main__":
    main(sys.argv[1:])
