"""How well things are followed in pictures, with the goals of each figure: one line per figure.

``python -m benchmarks.bench_vision [NAME ...]``; the names are ``head``, ``silhouette``, ``decoy``,
``detector``, ``boosted`` and ``pedestrians``, all of them by default. The clips are those of the reference
data (``BAYESMC_DATA``, else ``../shared/data``); what is not there is left out, and named. MOTA and IDF1 are
those of motmetrics, in the peers' environment (``make peers``; ``BAYESMC_PEERS`` names another).
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.vision import (
    BoxMotion,
    ContourEdges,
    Histograms,
    boosted,
    padded,
    precision_recall,
    train_detector,
)
from benchmarks.harness import data_folder, peer_python
from examples import pedestrians, rendered, talking_head

SEEDS = range(5)
GOAL_HEAD, GOAL_DRAWN, LOST = 6.0, 2.0, 16.0  # px; a radius away is lost
KINDS = ("bean", "star", "egg")
RUN = Path(__file__).parent / "peers" / "motmetrics_run.py"


def head() -> None:
    """Carphone: the worst of eight frames, each seed with dynamics of its own."""
    clip = talking_head.carphone(data_folder() / "vision")
    edges = ContourEdges(clip.space, clip.frames.shape[1:])
    worst = []
    for seed in SEEDS:
        start = time.process_time()
        dynamics = talking_head.learned(clip, edges, rng=seed + 100)
        learning = time.process_time() - start
        found = talking_head.errors(clip, talking_head.followed(clip, edges, dynamics, seed))
        seconds = time.process_time() - start - learning
        worst.append(max(found.values()))
        each = ", ".join(f"{e:.1f}" for e in found.values())
        print(f"  seed {seed}: {each} px; learned in {learning:.0f} s, "
              f"{1000 * seconds / len(clip.frames):.0f} ms a frame", flush=True)  # fmt: skip
    good = sum(e <= GOAL_HEAD for e in worst)
    print(
        f"  worst {max(worst):.1f} px; within {GOAL_HEAD:g} px: {good} of {len(worst)} seeds (goal: all)"
    )


def silhouette() -> None:
    """Drawn outlines of three shapes: the worst frame."""
    for kind in KINDS:
        worst = []
        for seed in SEEDS:
            clip = talking_head.silhouette(kind, seed)
            edges = ContourEdges(clip.space, clip.frames.shape[1:])
            states = talking_head.followed(clip, edges, talking_head.plain(6), seed)
            worst.append(max(talking_head.errors(clip, states).values()))
        good = sum(e <= GOAL_DRAWN for e in worst)
        print(f"  {kind:5}: worst frames {', '.join(f'{e:.1f}' for e in worst)} px; within "
              f"{GOAL_DRAWN:g} px: {good} of {len(worst)} (goal: all)", flush=True)  # fmt: skip


def decoy() -> None:
    """Met by another outline of its shape: mean error of the last five frames."""
    ours, theirs = [], []
    for seed in SEEDS:
        scene = rendered.with_decoy(seed)
        for found, means in (
            (ours, talking_head.met(scene, seed).mean("shape")),
            (theirs, talking_head.kalman(scene)),
        ):
            off = np.hypot(*(scene.space.center(means) - scene.space.center(scene.states)).T)
            found.append(off[-5:].mean())
    for name, found in (("Condensation", ours), ("Kalman filter", theirs)):
        lost = sum(e > LOST for e in found)
        print(
            f"  {name}: {', '.join(f'{e:.1f}' for e in found)} px; lost in {lost} of {len(found)}"
        )


def detector() -> None:
    """Precision and recall of detectors on frames that they were not trained on."""
    for name, (precision, recall, *_), frames in (_on_walkers(), _on_the_head()):
        print(
            f"  {name}: precision {precision:.2f}, recall {recall:.2f} on {frames} frames",
            flush=True,
        )


def boosted_head() -> None:
    """A head by its histogram alone, with and without proposals from the detector, from an unknown start."""
    clip, boxes = _head_boxes()
    if clip is None:
        return
    trained = _head_detector(clip, boxes)
    test = np.arange(60, 116)
    frames = clip.frames[test]
    found = padded([trained.detect(frame) for frame in frames])
    reference = Histograms(frames.shape[1:]).of(clip.frames[0], boxes[0]).astype(float)
    for name, guided in (("boosted", True), ("transition alone", False)):
        off = []
        for seed in SEEDS:
            means = _by_histogram(frames, found, reference, guided, seed)
            off.append(np.median(np.hypot(*(means[:, :2] - boxes[test, :2]).T)))
        each = ", ".join(f"{e:.0f}" for e in off)
        print(f"  {name}: median error {each} px (200 particles, anywhere at first)",
              flush=True)  # fmt: skip


def campus() -> None:
    """TUD Campus: MOTA and IDF1 beside the nearest-neighbour Kalman tracker."""
    python = peer_python()
    if python is None:
        print("  no peers installed (make peers): no MOTA and IDF1")
        return
    clip = pedestrians.campus(data_folder() / "vision")
    seen = [rows[rows[:, 2] > 0] for rows in clip.detections]
    scores = precision_recall(seen, clip.truth)
    print(f"  the given boxes: precision {scores.precision:.2f}, recall {scores.recall:.2f}")
    for name, options in (
        ("nearest neighbour", {}),
        ("the same, sure boxes only (0.7)", {"least": 0.7}),
        ("the same, coasting longer", {"least": 0.7, "misses": 3}),
    ):
        _print_score(
            name, [_score(python, pedestrians.nearest_neighbour(clip, **options), clip.truth)]
        )
    for name, guided in (("boosted", True), ("transition alone", False)):
        found = []
        for seed in SEEDS:
            tracker = pedestrians.Tracker(clip, guided=guided)
            found.append(_score(python, tracker.follow(clip.detections, seed), clip.truth))
        _print_score(f"{name}, {pedestrians.PARTICLES} particles", found)


Figure = tuple[Callable[[], None], str]
FIGURES: dict[str, Figure] = {
    "head": (head, "carphone_pristine.npz"),
    "silhouette": (silhouette, ""),
    "decoy": (decoy, ""),
    "detector": (detector, ""),
    "boosted": (boosted_head, "carphone_pristine.npz"),
    "pedestrians": (campus, "tud_campus_det.txt"),
}


def main(arguments: Sequence[str] = ()) -> None:
    """Print the figures that are asked for."""
    unknown = [name for name in arguments if name not in FIGURES and not name.startswith("-")]
    if unknown:
        sys.exit(f"no figure {unknown[0]!r}; there are {', '.join(FIGURES)}")
    for name in [name for name in arguments if name in FIGURES] or FIGURES:
        figure, needed = FIGURES[name]
        if needed and not (data_folder() / "vision" / needed).exists():
            print(
                f"{name}: no {needed} in {data_folder() / 'vision'}; set BAYESMC_DATA to have this figure"
            )
            continue
        print(f"{name}: {(figure.__doc__ or '').splitlines()[0]}", flush=True)
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            figure()
        print(f"  ({time.perf_counter() - start:.0f} s)\n", flush=True)


# ---- private ------------------------------------------------------------------------------------


def _on_walkers() -> tuple[str, Any, int]:
    train, test = rendered.walkers(0), rendered.walkers(1)
    trained = train_detector(train.frames[::3], train.boxes[::3], features=300, rounds=40, rng=0)
    found = [trained.detect(frame) for frame in test.frames[::2]]
    return "drawn walkers, another scene", precision_recall(found, test.boxes[::2]), len(found)


def _on_the_head() -> tuple[str, Any, int]:
    clip, boxes = _head_boxes()
    if clip is None:
        return "carphone: no data", (np.nan, np.nan), 0
    trained, test = _head_detector(clip, boxes), np.arange(60, 116, 4)
    found = [trained.detect(clip.frames[k]) for k in test]
    return "carphone's head, frames 60 on", precision_recall(found, boxes[test][:, None]), len(test)


def _head_detector(clip: talking_head.Clip, boxes: np.ndarray) -> Any:
    train = np.arange(0, 60, 4)
    return train_detector(clip.frames[train], boxes[train][:, None], features=300, rounds=40, rng=0)


def _head_boxes() -> tuple[Any, np.ndarray]:
    """The clip and the ellipses' boxes, in between by interpolation."""
    folder = data_folder() / "vision"
    if not (folder / "carphone_pristine.npz").exists():
        return None, np.zeros((0, 4))
    drawn = json.loads((folder / "carphone_head_ellipses.json").read_text("utf-8"))
    known = {}
    for k, e in drawn.items():
        c, s = np.cos(np.deg2rad(e["angle_deg"])), np.sin(np.deg2rad(e["angle_deg"]))
        wide = 2 * np.hypot(e["semi_x"] * c, e["semi_y"] * s)
        known[int(k)] = [e["cx"], e["cy"], wide, 2 * np.hypot(e["semi_x"] * s, e["semi_y"] * c)]
    rows = np.array(list(known.values())).T
    return talking_head.carphone(folder), np.stack(
        [np.interp(np.arange(116), list(known), row) for row in rows], axis=-1
    )


def _by_histogram(
    frames: np.ndarray, found: np.ndarray, reference: np.ndarray, guided: bool, seed: int
) -> np.ndarray:
    """Means of a box's state: weighed by its histogram, drawn from detections, too, where guided."""
    height, width = frames.shape[1:]
    looks, motion, most = Histograms((height, width), reference), BoxMotion(), found.shape[1]
    start = bmc.MvNormal(
        [width / 2, height / 2, np.log(50.0), np.log(80.0), 0.0, 0.0],
        scale_diag=[width / 3, height / 3, 0.4, 0.4, 2.0, 2.0],
    )
    dbn = bmc.DynamicBayesNet("head")
    dbn.input("seen", event_shape=(most, 5))
    dbn.add("box", lambda box_prev: motion.given(box_prev), initial=start)
    dbn.add("frame", lambda box: looks.given(box))
    options: dict[str, Any] = {}
    if guided:
        free = np.ones(most)
        options = {
            "proposal": {"box": lambda box_prev, seen: boosted(motion.given(box_prev), seen, free)},
            "initial_proposal": {"box": lambda seen: boosted(start, seen, free)},
        }
    engine = bmc.ParticleFilter(200, **options)
    return bmc.filter(dbn, {"frame": frames}, inputs={"seen": found}, engine=engine, rng=seed).mean(
        "box"
    )


def _score(python: Path, found: list[np.ndarray], true: list[np.ndarray]) -> dict[str, float]:
    given = {"found": [rows.tolist() for rows in found], "true": [rows.tolist() for rows in true]}
    run = subprocess.run(
        [str(python), str(RUN)],
        input=json.dumps(given),
        text=True,
        capture_output=True,
        check=False,
    )
    if run.returncode:
        raise RuntimeError(f"motmetrics failed: {run.stderr[-500:]}")
    return json.loads(run.stdout)


def _print_score(name: str, found: list[dict[str, float]]) -> None:
    def over(key: str) -> str:
        values = [score[key] for score in found]
        low = f" (least {min(values):.3f})" if len(values) > 1 else ""
        return f"{np.mean(values):.3f}{low}"

    switches = np.mean([score["num_switches"] for score in found])
    print(f"  {name:34} MOTA {over('mota')}, IDF1 {over('idf1')}, precision {over('precision')}, "
          f"recall {over('recall')}, {switches:.1f} switches", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
