"""Cost of a row by the number of landmarks not in sight; maps and their spreads.

With ``--spread`` it says how far maps are off on drives of the declared model itself, in units of what the
filters tell; with ``--slam FOLDER`` what FastSLAM makes of MRCLAM 6, robot by robot.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import PoseNormal, bearing_to, compose, range_and_bearing, range_to
from benchmarks.harness import table

PARTICLES, STEPS, IN_SIGHT, GOAL = 100, 100, 20, 1.5
SEEDS, LENGTHS = 5, (100, 400)  # of drives on which spreads are judged


def net(marks: int, mean: Any = (0.0, 0.0), scale: float = 100.0) -> bmc.DynamicBayesNet:
    """A pose, a plate of landmarks, and two readings of picked ones."""
    dbn = bmc.DynamicBayesNet(plates={"mark": marks, "look": 2})
    dbn.input("motion", event_shape=(3,))
    dbn.input("which", plates="look")
    dbn.add(
        "pose",
        lambda pose_prev, motion: PoseNormal(
            compose(pose_prev, motion), scale_diag=[0.01, 0.01, 0.005]
        ),
        initial=PoseNormal(np.zeros(3), scale_diag=[1e-3] * 3),
    )
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, scale_diag=np.zeros(2)),
        plates="mark",
        initial=lambda: bmc.MvNormal(mean, scale_diag=[scale, scale]),
    )
    dbn.add(
        "seen",
        lambda pose, mark, which: range_and_bearing(pose, mark[which], 0.1, 0.05),
        plates="look",
    )
    return dbn


def drive(
    marks: int, steps: int = STEPS, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Motions, labels and readings, of a few landmarks that are in sight, and where all of them stand."""
    rng = np.random.default_rng(seed)
    motion, places = np.tile([0.1, 0.0, 0.05], (steps, 1)), rng.uniform(-4, 4, (marks, 2))
    pose, labels, rows = 1e-3 * rng.normal(size=3), [], []
    for k in range(steps):
        if k:
            pose = compose(pose, motion[k]) + rng.normal(size=3) * [0.01, 0.01, 0.005]
        own = rng.choice(IN_SIGHT, 2, replace=False)
        far = range_to(pose, places[own]) + 0.1 * rng.normal(size=2)
        angle = bearing_to(pose, places[own]) + 0.05 * rng.normal(size=2)
        labels.append(own)
        rows.append(np.stack([far, angle], -1))
    return motion, np.array(labels), np.array(rows), places


def timed(marks: int) -> tuple[float, float]:
    """Milliseconds of a row: in a step of a belief (median), and in a filter with all its answers."""
    dbn, (motion, labels, rows, _) = net(marks), drive(marks)
    engine = bmc.ParticleFilter(PARTICLES, marginalize="mark")
    belief, each = engine.start(dbn, rng=0), []
    for k in range(STEPS):
        inputs = {"motion": motion[k], "which": labels[k]}
        start = time.process_time()
        belief = engine.step(belief, {"seen": rows[k]}, inputs=inputs)
        each.append(time.process_time() - start)
    start = time.process_time()
    bmc.filter(
        dbn, {"seen": rows}, inputs={"motion": motion, "which": labels}, engine=engine, rng=0
    )
    return 1e3 * float(np.median(each)), 1e3 * (time.process_time() - start) / STEPS


def main() -> None:
    """Print milliseconds per row, and the ratio to 100 landmarks."""
    warnings.simplefilter("ignore")
    timed(100)
    lines: list[list[object]] = []
    few: list[float] = []
    for marks in (100, 1_000, 10_000):
        step, whole = timed(marks)
        own = [step, whole]
        few = few or own
        lines.append([marks, step, step / few[0], whole, whole / few[1]])
    title = f"a row of {PARTICLES} particles, {IN_SIGHT} landmarks in sight"
    header = ["landmarks", "step, ms", "ratio", "filter, ms", "ratio"]
    print(table(title, header, lines))
    print(f"goal: a ratio of {GOAL}; a filter answers about all landmarks in all rows")
    if "--spread" in sys.argv:
        spreads()
    if "--slam" in sys.argv:
        slam(Path(sys.argv[sys.argv.index("--slam") + 1]))


def spreads() -> None:
    """Squared errors of maps over variances that filters tell, on drives of the model: 1 is calibrated."""
    engines = {
        "EKF-SLAM": bmc.ExtendedKalmanFilter(),
        "FastSLAM, 100": bmc.ParticleFilter(100, marginalize="mark"),
        "FastSLAM, 1000": bmc.ParticleFilter(1000, marginalize="mark"),
        "FastSLAM 2.0, 100": bmc.ParticleFilter(100, marginalize="mark", proposal="optimal"),
    }
    lines: list[list[object]] = []
    for steps in LENGTHS:
        each: dict[str, list[float]] = {name: [] for name in engines}
        for seed in range(SEEDS):
            motion, labels, rows, places = drive(IN_SIGHT, steps, seed)
            guess = places + 0.5 * np.random.default_rng(seed).normal(size=places.shape)
            inputs = {"motion": motion, "which": labels}
            for name, engine in engines.items():
                found = bmc.filter(
                    net(IN_SIGHT, guess, 0.5),
                    {"seen": rows},
                    inputs=inputs,
                    engine=engine,
                    rng=seed,
                )
                off = np.square(found.mean("mark")[-1] - places) / found.var("mark")[-1]
                each[name].append(float(off.mean()))
        lines += [[steps, name, np.median(v), max(v)] for name, v in each.items()]
    print(table("squared errors over variances", ["slices", "filter", "median", "worst"], lines))


def slam(folder: Path) -> None:
    """Errors on the robots of an MRCLAM folder, and shares of readings assigned right."""
    from examples.slam_landmarks import figures, picks

    for found in (figures(folder), picks(folder)):
        for robot, own in found:
            print(robot, {k: round(v, 3) for k, v in own.items()}, flush=True)


if __name__ == "__main__":
    main()
