"""A bee's dance cut into its phases: she waggles, turns to the left or to the right, and nobody says which.

What a camera saw of her, frame by frame, is her place and the way she heads. Behind them is a switching
model:

    phase_t, stage_t  waggle, turn_left, turn_right; four stages in a row, of which only the last is left
    course_t ~ N(course_{t-1} + rate[phase], wander[phase]),    heading_t ~ N(course_t, blur[phase])
    speed_t ~ N(R(rate[phase]) speed_{t-1}, sway[phase])        both components; R turns them
    place_t ~ N(place_{t-1} + speed_{t-1}, .1),                 seen_t ~ N(place_t, wobble[phase])

A phase that is left with the same probability in every frame is more likely to last for one frame than for
any other number; stages make short ones rare. The heading jumps by full turns and is unwrapped before.

Three ways to the numbers, which are not equally honest, and agreement with what a person says of the frames:

- by a stretch: labels of the first 450 frames; agreement is told of the 675 others as well;
- by no labels: from rough numbers (below) the frames are labelled, numbers learned from these labels, and
  so on. The rough numbers stand on what the words mean and on a look at the track. They matter: with half
  the ``wobble`` it takes more rounds, with twice as much no frame is a waggle any more;
- by all labels of the sequence that is labelled then: what the model can do, no forecast of anything.

Given labels the dance is a Kalman filter's, and numbers come by EM (Shumway and Stoffer 1982): from means
and variances of what the smoother says of ``turned``, ``pushed`` and what is left of the measurements, phase
by phase. ``R`` follows the rate of the headings. The same is done with a hidden Markov model of the
increments alone, which ``DiscreteFilter`` smooths exactly.

Found by a stretch of labels, the phases are those of the person, and so is their number: frames that differ
are where one ends. Stages help little, and increments alone do as well. Without hindsight (filtered) more
than a frame in eight is wrong.

Oh, Rehg, Balch and Dellaert (2008), Learning and inferring motion patterns using parametric segmental
switching linear dynamic systems, IJCV 77: sequence 2. They learn from five other sequences, which are not at
hand; two decodings of theirs agree with the labels in .829 and .828 of the frames, one with durations in
.924.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, LowEssWarning
from examples import picture, reference

PHASES = ("waggle", "turn_left", "turn_right")
STAGES, STRETCH = 4, 450
ROUNDS, STEPS = 8, 20  # of labelling, and of EM
LAST = 50.0  # frames that a phase lasts, a guess: its times are not learned
BOTH = np.eye(2)


@dataclass(frozen=True)
class Numbers:
    """What is learned; by phase, shape (3,), and ``then``, which phase follows which, shape (3, 3)."""

    rate: np.ndarray  # rad a frame
    wander: np.ndarray
    blur: np.ndarray  # rad
    sway: np.ndarray
    wobble: np.ndarray  # pixels
    then: np.ndarray


#: a full turn takes some sixty frames; who waggles goes straight on, and is twice as hard to see
ROUGH = Numbers(
    rate=np.array([0.0, -0.1, 0.1]),
    wander=np.array([0.2, 0.2, 0.2]),
    blur=np.array([0.2, 0.2, 0.2]),
    sway=np.array([0.3, 0.3, 0.3]),
    wobble=np.array([2.0, 1.0, 1.0]),
    then=np.array([[0.0, 0.5, 0.5], [0.7, 0.0, 0.3], [0.7, 0.3, 0.0]]),
)


# ---- data ---------------------------------------------------------------------------------------


def seen(folder: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Rows of a dance, and what a person says of its frames, shape (frames,)."""
    x, y, heading = (np.loadtxt(folder / f"{name}image.txt") for name in "xyt")
    rows = {"heading": np.unwrap(heading), "seen": np.stack([x, y], axis=-1)}
    return rows, np.loadtxt(folder / "label0.txt", dtype=str)


def increments(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What she did since the frame before: turns, and steps along and across her heading."""
    heading, step = rows["heading"], np.diff(rows["seen"], axis=0)
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    found = {
        "turn": np.diff(heading),
        "along": c * step[:, 0] + s * step[:, 1],
        "across": c * step[:, 1] - s * step[:, 0],
    }
    return {name: np.concatenate([[np.nan], values]) for name, values in found.items()}


# ---- models -------------------------------------------------------------------------------------


def phases(dbn: bmc.DynamicBayesNet, then: np.ndarray, stages: int) -> None:
    """Declare ``phase`` and ``stage``: a phase is left from its last stage only."""
    go, last = stages / LAST, stages - 1
    phase = np.empty((3, stages, 3))
    phase[:] = np.eye(3)[:, None]
    phase[:, last] = (1.0 - go) * np.eye(3) + go * then
    ahead = (1.0 - go) * np.eye(stages) + go * np.eye(stages, k=1)
    ahead[last] = np.eye(stages)[last]
    stage = np.empty((3, stages, 3, stages))
    stage[:] = np.eye(stages)[0]
    for k in range(3):
        stage[k, :, k] = ahead
    dbn.table("phase", ["phase_prev", "stage_prev"], phase, PHASES, initial=np.full(3, 1 / 3))
    dbn.table(
        "stage", ["phase_prev", "stage_prev", "phase"], stage, initial=np.full(stages, 1 / stages)
    )


def turning(rate: np.ndarray) -> np.ndarray:
    """Rotations by so many radians, shape (3, 2, 2)."""
    c, s = np.cos(rate), np.sin(rate)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def dance(by: Numbers, stages: int = STAGES) -> bmc.DynamicBayesNet:
    """The model; without ``stages`` phases are anything, frame by frame, for labels that are given."""
    dbn = bmc.DynamicBayesNet("dance")
    if stages:
        phases(dbn, by.then, stages)
    else:
        dbn.table("phase", [], np.full(3, 1 / 3), PHASES)
    turn = turning(by.rate)
    anywhere = bmc.MvNormal(np.array([180.0, 130.0]), 60.0**2 * BOTH)

    @dbn.node(initial=bmc.Normal(0.0, 3.0))
    def course(course_prev, phase):
        return bmc.Normal(course_prev + by.rate[phase], by.wander[phase])

    @dbn.node(initial=bmc.MvNormal(np.zeros(2), BOTH))
    def speed(speed_prev, phase):
        noise = (by.sway**2)[phase][..., None, None] * BOTH
        return bmc.MvNormal(np.matvec(turn[phase], speed_prev), noise)

    @dbn.node(initial=anywhere)
    def place(place_prev, speed_prev):
        return bmc.MvNormal(place_prev + speed_prev, 0.1**2 * BOTH)

    @dbn.node
    def heading(course, phase):
        return bmc.Normal(course, by.blur[phase])

    @dbn.node
    def seen(place, phase):
        return bmc.MvNormal(place, (by.wobble**2)[phase][..., None, None] * BOTH)

    if not stages:  # what numbers are learned from
        dbn.add(
            "turned",
            lambda course, course_prev: course - course_prev,
            initial=lambda course: 0 * course,
        )
        dbn.add(
            "pushed",
            lambda speed, speed_prev, phase: speed - np.matvec(turn[phase], speed_prev),
            initial=lambda speed: 0 * speed,
        )
    return dbn


def markov(mean: np.ndarray, spread: np.ndarray, then: np.ndarray) -> bmc.DynamicBayesNet:
    """Increments alone; mean and spread have shape (3 increments, 3 phases)."""
    dbn = bmc.DynamicBayesNet("increments of a dance")
    phases(dbn, then, STAGES)
    for k, name in enumerate(("turn", "along", "across")):
        dbn.add(name, lambda phase, k=k: bmc.Normal(mean[k][phase], spread[k][phase]))
    return dbn


# ---- learning -----------------------------------------------------------------------------------


def learned(
    rows: dict[str, np.ndarray], labels: np.ndarray, start: Numbers = ROUGH, steps: int = STEPS
) -> Numbers:
    """By labels of the first rows, from ``start``: expectation and maximisation in turn."""
    known = {name: values[: len(labels)] for name, values in rows.items()} | {"phase": labels}
    mine = np.stack([labels == phase for phase in PHASES]).astype(float)
    share = mine / mine.sum(axis=1, keepdims=True)
    later = mine * (np.arange(len(labels)) > 0)
    later /= later.sum(axis=1, keepdims=True)
    by = replace(start, then=followed(labels))
    for _ in range(steps):
        told = bmc.smooth(dance(by, stages=0), known, engine=bmc.KalmanFilter())

        def square(name: str, of: Any = 0.0, told: Any = told) -> np.ndarray:
            """The mean of the square of a node less ``of``, shape (frames,)."""
            found = (told.mean(name) - of) ** 2 + told.var(name)
            return found if found.ndim == 1 else found.mean(axis=-1)

        rate = later @ told.mean("turned")
        by = replace(
            by,
            rate=rate,
            wander=np.sqrt(later @ square("turned") - rate**2),
            sway=np.sqrt(later @ square("pushed")),
            blur=np.sqrt(share @ square("course", known["heading"])),
            wobble=np.sqrt(share @ square("place", known["seen"])),
        )
    return by


def followed(labels: np.ndarray) -> np.ndarray:
    """How often a phase follows another one, one seen before each."""
    count = 1.0 - np.eye(3)
    for before, after in zip(labels[:-1], labels[1:], strict=True):
        if before != after:
            count[PHASES.index(before), PHASES.index(after)] += 1.0
    return count / count.sum(axis=1, keepdims=True)


def learned_alone(rows: dict[str, np.ndarray], rounds: int) -> Numbers:
    """By no labels: those found with the numbers so far, again and again."""
    by = ROUGH
    for _ in range(rounds):
        by = learned(rows, labelled(by, rows), by, steps=3)
    return by


def markov_learned(moves: dict[str, np.ndarray], labels: np.ndarray) -> bmc.DynamicBayesNet:
    """The hidden Markov model, by labels of the first rows."""
    values = np.stack([moves[name][1 : len(labels)] for name in ("turn", "along", "across")])
    each = [values[:, labels[1:] == phase] for phase in PHASES]
    mean, spread = (np.stack([f(v, axis=1) for v in each], axis=1) for f in (np.mean, np.std))
    return markov(mean, spread, followed(labels))


# ---- labelling ----------------------------------------------------------------------------------


def named(belief: Any) -> np.ndarray:
    """The phase that is most probable, frame by frame."""
    return np.array(PHASES)[belief.probabilities("phase").argmax(axis=1)]


def labelled(by: Numbers, rows: dict[str, np.ndarray], stages: int = STAGES) -> np.ndarray:
    """Frames labelled by Kim's smoother."""
    return named(bmc.smooth(dance(by, stages), rows, engine=bmc.SwitchingKalmanFilter()))


def ways(
    rows: dict[str, np.ndarray], labels: np.ndarray, rounds: int = ROUNDS, steps: int = STEPS
) -> dict[str, dict[str, np.ndarray]]:
    """Labels found, by how numbers were learned, and by model."""
    moves = increments(rows)
    numbers = {
        f"the first {STRETCH} labels": (
            learned(rows, labels[:STRETCH], steps=steps),
            labels[:STRETCH],
        ),
        "no labels": (learned_alone(rows, rounds), None),
        "all labels": (learned(rows, labels, steps=steps), labels),
    }
    found: dict[str, dict[str, np.ndarray]] = {}
    for how, (by, shown) in numbers.items():
        found[how] = {
            "switching, stages": labelled(by, rows),
            "switching, no stages": labelled(by, rows, stages=1),
        }
        if shown is not None:
            exact = bmc.smooth(markov_learned(moves, shown), moves, engine=bmc.DiscreteFilter())
            found[how]["increments alone"] = named(exact)
    return found


def engines(sweeps: int, particles: int) -> dict[str, tuple[Any, Any]]:
    """What is asked, and of whom, by name; without sweeps or particles not of those who have them."""
    found: dict[str, tuple[Any, Any]] = {
        "filtered, GPB2": (bmc.filter, bmc.SwitchingKalmanFilter("gpb2")),
        "smoothed, IMM and Kim": (bmc.smooth, bmc.SwitchingKalmanFilter("imm")),
        "smoothed, GPB2 and Kim": (bmc.smooth, bmc.SwitchingKalmanFilter("gpb2")),
    }
    if particles:
        engine = bmc.ParticleFilter(particles, marginalize="auto", proposal="optimal")
        found[f"filtered, {particles} particles"] = bmc.filter, engine
    if sweeps:
        found[f"smoothed, EP, {sweeps} sweeps"] = bmc.smooth, bmc.ExpectationPropagation(sweeps)
    return found


def report(rows: Any, labels: np.ndarray, found: Any, sweeps: int, particles: int) -> None:
    """Agreement with the labels: of models, and of engines on one of them."""
    print(
        f"{len(labels)} frames, {runs(labels)} phases"
        + " " * 26
        + "agree, of all  after 450  phases"
    )
    for how, models in found.items():
        for model, got in models.items():
            right = got == labels
            after = f"{right[STRETCH:].mean():11.3f}" if how != "all labels" else "  (learned)"
            print(f"  by {how:<22}{model:<22}{right.mean():13.3f}{after}{runs(got):8}")
    print(
        f"engines, by the first {STRETCH} labels"
        + " " * 8
        + "agree after 450  log evidence  seconds"
    )
    template = dance(learned(rows, labels[:STRETCH]))
    for name, (ask, engine) in engines(sweeps, particles).items():
        begun = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", (ConvergenceWarning, LowEssWarning))
            belief = ask(template, rows, engine=engine, rng=0)
        took = time.process_time() - begun
        right = (named(belief) == labels)[STRETCH:].mean()
        settled = getattr(belief, "converged", True)
        note = "" if settled else f"  not settled: beliefs change by {belief.change:.1g}"
        log = belief.log_marginal_likelihood
        print(f"  {name:<35}{right:17.3f}{log:14.1f}{took:9.1f}{note}")


def runs(labels: np.ndarray) -> int:
    """How many phases there are, one after the other."""
    return 1 + int((labels[1:] != labels[:-1]).sum())


def draw(rows: dict[str, np.ndarray], labels: np.ndarray, found: dict[str, Any]) -> Any:
    """The track by phases, as a person has them and as found; headings, and all labellings along time."""
    shown = found[f"the first {STRETCH} labels"]
    lines = {
        "a person": labels,
        f"by {STRETCH} labels": shown["switching, stages"],
        "by no labels": found["no labels"]["switching, stages"],
        "no stages": shown["switching, no stages"],
        "increments": shown["increments alone"],
    }
    colours = dict(zip(PHASES, (picture.EXACT, picture.DRAWS, picture.OTHER), strict=True))
    figure, panels = picture.axes([["said", "found"], ["time", "time"]], (12, 10),
                                  height_ratios=[1.15, 1.0])  # fmt: skip
    place = rows["seen"]
    for name, title in (("said", "a person"), ("found", f"by {STRETCH} labels")):
        ax = panels[name]
        ax.plot(*place.T, color=picture.FAINT, lw=0.5)
        for phase, colour in colours.items():
            here = lines[title] == phase
            ax.plot(*place[here].T, ".", ms=4, color=colour, label=phase.replace("_", " "))
        ax.set(aspect="equal", title=f"phases, {title}", xlabel="pixels")
        ax.set_ylim(195, 78)  # as the camera has it
    panels["said"].legend(frameon=False, loc="lower left", ncols=3, markerscale=2)
    ax, frames = panels["time"], np.arange(len(labels))
    heading = rows["heading"]
    for phase, colour in colours.items():
        here = labels == phase
        ax.plot(frames[here], heading[here], ".", ms=3, color=colour)
    low, step = heading.min() - 2.0, 1.6
    for k, got in enumerate(lines.values()):
        for phase, colour in colours.items():
            ax.vlines(
                frames[got == phase], low - step * k - 1.2, low - step * k, color=colour, lw=1
            )
    ax.axvline(STRETCH - 0.5, color=picture.FAINT, ls="--")
    turns = np.arange(-12, 1, 4)
    ax.set_yticks(
        [*(low - step * k - 0.6 for k in range(len(lines))), *turns],
        [*lines, *(f"{turn} rad" for turn in turns)],
    )
    ax.set(xlim=(-1, len(labels)), xlabel="frame (dashed: up to here labels were given)",
           title="heading, unwrapped, and phases along time")  # fmt: skip
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print agreements, and draw the dance."""
    options = picture.options(__doc__, arguments)
    folder = reference.folder("switching", "bee_sequence2")
    if folder is None:
        print("skipped: the bee's sequence is not at hand (set BAYESMC_DATA)")
        return
    rows, labels = seen(folder)
    if options.fast:
        rows, labels = {name: values[:480] for name, values in rows.items()}, labels[:480]
    found = ways(rows, labels, *((1, 3) if options.fast else (ROUNDS, STEPS)))
    report(rows, labels, found, *((0, 0) if options.fast else (8, 200)))
    picture.save(draw(rows, labels, found), options.out, "bee_dance")


if __name__ == "__main__":
    main()
