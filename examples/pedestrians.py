"""Pedestrians by a boosted particle filter: a detector says where particles are drawn, weights make up.

Each pedestrian is an element of a plate with particles of its own: present or not, and where its box is. That
they exclude each other enters by ``claims``: what one is believed to have is less free for the others.
Detections that nobody has are offered to an element that is vacant. With the same number of particles, drawn
from the transition alone, a newcomer is found late or never.

The boxes are those of TUD Campus, where there are no frames: a detector's boxes are both proposal and
evidence. Where the data are missing, a drawn scene takes their place, with a detector trained on another one.

Okuma, Taleghani, de Freitas, Little and Lowe (2004), A boosted particle filter: multitarget detection and
tracking, ECCV; Schulz, Burgard, Fox and Cremers (2001), ICRA; Andriluka, Roth and Schiele (2008),
People-tracking-by-detection and people-detection-by-tracking, CVPR (the clip).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

import bayesmc as bmc
from bayesmc.vision import (
    BoxDetections,
    BoxMotion,
    boosted,
    claims,
    iou,
    left_free,
    padded,
    precision_recall,
    train_detector,
)
from examples import picture, rendered
from examples.reference import folder

SEED, PARTICLES, SLOTS = 0, 500, 16
BIRTH, DEATH = 0.01, 0.05  # in a frame, of each vacant element; of each that is there
LEAVING = 0.5  # in a frame, of one whose middle is outside the picture
VACANT, SHOWN = 0.1, 0.5  # probabilities of being there
SPARE = 0.5  # from which on a detection is offered to a vacant element


class Clip(NamedTuple):
    """Detections and the truth, frame by frame: rows (x, y, width, height, score) and (..., which)."""

    name: str
    detections: np.ndarray
    truth: list[np.ndarray]
    frame_shape: tuple[int, int]
    frames: np.ndarray | None = None


def campus(data: Path) -> Clip:
    """TUD Campus: a detector's boxes, and the truth."""
    found, true = (
        np.loadtxt(data / f"tud_campus_{name}.txt", delimiter=",") for name in ("det", "gt")
    )

    def rows(table: np.ndarray, t: int, last: int) -> np.ndarray:
        part = table[table[:, 0] == t]
        return np.column_stack([part[:, 2:4] + part[:, 4:6] / 2, part[:, 4:6], part[:, last]])

    times = range(1, int(found[:, 0].max()) + 1)
    detections = padded([rows(found, t, 6) for t in times])
    return Clip("TUD Campus", detections, [rows(true, t, 1) for t in times], (480, 640))


def drawn(seed: int = 1, train: int = 0, steps: int = 40) -> Clip:
    """A drawn scene, and what a detector sees there that was trained on another one."""
    seen, made = rendered.walkers(train), rendered.walkers(seed, steps)
    detector = train_detector(seen.frames[::3], seen.boxes[::3], features=300, rounds=40, rng=0)
    found = padded([detector.detect(frame) for frame in made.frames])
    return Clip("a drawn scene", found, made.boxes, made.frames.shape[1:], made.frames)


class Tracker:
    """The declared net, and the beliefs about its plate, frame by frame.

    Parameters
    ----------
    clip : Clip
    particles : int
        For each element.
    guided : bool
        Whether particles are drawn from detections, too.
    speed : float
        Of newcomers along the picture, as a share of their height in a frame.
    """

    def __init__(
        self, clip: Clip, particles: int = PARTICLES, guided: bool = True, speed: float = 0.03
    ) -> None:
        self.motion, self.reads = BoxMotion(), BoxDetections(clip.frame_shape)
        height, width = clip.frame_shape
        seen = clip.detections[clip.detections[..., 2] > 0]
        sizes = np.log(seen[:, 2:4]).mean(axis=0) if len(seen) else np.log([width / 10, height / 4])
        speed = speed * np.exp(sizes[1])
        self.start = bmc.MvNormal(
            [width / 2, height / 2, *sizes, 0.0, 0.0],
            scale_diag=[width / 2, height / 2, 0.4, 0.4, speed, speed / 5],
        )
        self.frame_shape, self.most = clip.frame_shape, clip.detections.shape[1]
        options = self._proposals() if guided else {}
        self.engine = bmc.ParticleFilter(particles, **options)
        self.dbn = self._net()

    def follow(self, detections: np.ndarray, rng: Any = SEED) -> list[np.ndarray]:
        """Boxes that are believed to be there, each frame's as rows (x, y, width, height, which)."""
        belief, names, last = self.engine.start(self.dbn, rng=rng), np.full(SLOTS, -1), 0
        there, mean = np.zeros(SLOTS), np.tile(self.start.mean, (SLOTS, 1))
        var, found = np.tile(self.start.var, (SLOTS, 1)), []
        for seen in detections:
            free, vacant = self.shares(there, mean, var, seen)
            belief = self.engine.step(
                belief,
                {"boxes": np.tile(seen, (SLOTS, 1, 1))},
                inputs={"free": free, "seen": seen, "vacant": vacant.astype(float)},
            )
            there, mean, var = self.summary(belief)
            names[there < VACANT] = -1
            rows = []
            for k in np.flatnonzero(there > SHOWN):
                if names[k] < 0:
                    names[k], last = last, last + 1
                rows.append([*mean[k, :2], *np.exp(mean[k, 2:4]), names[k]])
            found.append(np.array(rows).reshape(-1, 5))
        return found

    def shares(
        self, there: np.ndarray, mean: np.ndarray, var: np.ndarray, seen: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """How free each detection is for each element, and which elements are vacant."""
        ahead, there = self.motion.given(mean), there * (1 - DEATH)
        vacant = there < VACANT
        ratios = there[:, None] * self.reads.ratios(ahead.mean, seen, var[:, :4] + ahead.var[:, :4])
        claimed = claims(np.where(vacant[:, None], 0.0, ratios), 1 - there * self.reads.detected)
        free = np.where(vacant[:, None], 0.0, left_free(claimed))
        spare = np.where(seen[:, 2] > 0, 1 - claimed.sum(axis=0), 0.0)
        offered = [j for j in np.argsort(-spare * seen[:, 4]) if spare[j] >= SPARE]
        rooms = np.flatnonzero(vacant)
        if len(offered) > len(rooms):
            warnings.warn(f"all {SLOTS} elements are taken: raise SLOTS", stacklevel=2)
        for room, j in zip(rooms, offered, strict=False):
            free[room, j] = spare[j]
        return free, vacant

    def summary(self, belief: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Probability of being there; mean and variance of the state of what is."""
        weights = belief.weights * (belief.particles("present") != 0)
        box, there = belief.particles("box"), weights.sum(axis=0)
        share = weights / np.maximum(there, 1e-12)
        mean = (share[..., None] * box).sum(axis=0)
        var = (share[..., None] * (box - mean) ** 2).sum(axis=0)
        some = (there > 1e-6)[:, None]
        return there, np.where(some, mean, self.start.mean), np.where(some, var, self.start.var)

    # ---- the net -------------------------------------------------------------------------------

    def stays(self, box: np.ndarray) -> np.ndarray:
        """Probability of being there in the next frame."""
        height, width = self.frame_shape
        x, y = box[..., 0], box[..., 1]
        return np.where((x >= 0) & (x < width) & (y >= 0) & (y < height), 1 - DEATH, LEAVING)

    def goes(self, box: np.ndarray, going: np.ndarray) -> bmc.MvNormal:
        """On from where it was, or anywhere if it is new."""
        ahead, going = self.motion.given(box), going[..., None]
        loc = np.where(going, ahead.mean, self.start.mean)
        return bmc.MvNormal(loc, scale_diag=np.sqrt(np.where(going, ahead.var, self.start.var)))

    def _net(self) -> bmc.DynamicBayesNet:
        dbn, here = bmc.DynamicBayesNet("pedestrians", plates={"target": SLOTS}), self
        dbn.input("free", plates="target", event_shape=(self.most,))
        dbn.input("seen", event_shape=(self.most, 5))
        dbn.input("vacant", plates="target")

        @dbn.node(plates="target", initial=lambda vacant: bmc.Bernoulli(BIRTH * vacant))
        def present(present_prev, box_prev, vacant):
            return bmc.Bernoulli(np.where(present_prev != 0, here.stays(box_prev), BIRTH * vacant))

        @dbn.node(plates="target", initial=lambda: here.start)
        def box(box_prev, present_prev, present):
            return here.goes(box_prev, (present != 0) & (present_prev != 0))

        @dbn.node(plates="target")
        def boxes(box, present, free):
            return here.reads.given(box, present, free)

        return dbn

    def _proposals(self) -> dict[str, Any]:
        here = self

        def begins(free: Any, seen: Any, vacant: Any) -> np.ndarray:
            offered = (free * (seen[..., 2] > 0) * seen[..., 4]).max(axis=-1)
            return vacant * np.maximum(BIRTH, 0.5 * offered)

        def present(present_prev, box_prev, vacant, free, seen):
            stays = here.stays(box_prev)
            return bmc.Bernoulli(np.where(present_prev != 0, stays, begins(free, seen, vacant)))

        def box(box_prev, present_prev, present, free, seen):
            going = (present != 0) & (present_prev != 0)
            ahead = here.motion.given(box_prev)
            fits = free * here.reads.ratios(ahead.mean, seen, ahead.var[..., :4])
            fits = fits / (1 - here.reads.detected + fits.sum(axis=-1, keepdims=True))
            fits = np.where(going[..., None], fits, free * (present != 0)[..., None])
            return boosted(here.goes(box_prev, going), seen, fits)

        def present_first(free, seen, vacant):
            return bmc.Bernoulli(begins(free, seen, vacant))

        def box_first(present, free, seen):
            return boosted(here.start, seen, free * (present != 0)[..., None])

        return {
            "proposal": {"present": present, "box": box},
            "initial_proposal": {"present": present_first, "box": box_first},
        }


def nearest_neighbour(
    clip: Clip, least: float = 0.5, gate: float = 0.3, misses: int = 1, hits: int = 3
) -> list[np.ndarray]:
    """The plain tracker: a Kalman filter for each box, given the detection that overlaps it most.

    It begins with any detection that is left over, is shown after ``hits`` of them in all, and ends
    after more than ``misses`` frames without one: the defaults of Bewley et al. (2016), Simple online
    and realtime tracking. The motion and the noise are those of the particle filter.
    """
    motion, reads = BoxMotion(), BoxDetections(clip.frame_shape)
    ahead, look = np.eye(6), np.eye(4, 6)
    ahead[0, 4] = ahead[1, 5] = 1.0
    ahead[4, 4] = ahead[5, 5] = 1 - motion.damping
    tracks: list[dict[str, Any]] = []
    found, last = [], 0
    for seen in clip.detections:
        seen = seen[(seen[:, 2] > 0) & (seen[:, 4] >= least)]
        for track in tracks:
            noise = motion.given(track["mean"]).var
            track["mean"] = ahead @ track["mean"]
            track["cov"] = ahead @ track["cov"] @ ahead.T + np.diag(noise)
            track["missed"] += 1
        boxes = np.array([[*t["mean"][:2], *np.exp(t["mean"][2:4])] for t in tracks]).reshape(-1, 4)
        overlap = iou(boxes, seen)
        left = set(range(len(seen)))
        for k, j in zip(*linear_sum_assignment(overlap, maximize=True), strict=True):
            if overlap[k, j] < gate:
                continue
            left.remove(j)
            track, value = tracks[k], np.r_[seen[j, :2], np.log(seen[j, 2:4])]
            noise = np.diag([(reads.place * seen[j, 3]) ** 2] * 2 + [reads.size**2] * 2)
            gain = track["cov"] @ look.T @ np.linalg.inv(look @ track["cov"] @ look.T + noise)
            track["mean"] = track["mean"] + gain @ (value - look @ track["mean"])
            track["cov"] = track["cov"] - gain @ look @ track["cov"]
            track.update(missed=0, hits=track["hits"] + 1)
        for j in sorted(left):
            high = seen[j, 3]
            spread = (
                [(reads.place * high) ** 2] * 2 + [reads.size**2] * 2 + [(0.03 * high) ** 2] * 2
            )
            state = np.r_[seen[j, :2], np.log(seen[j, 2:4]), 0.0, 0.0]
            tracks.append(
                {"mean": state, "cov": np.diag(spread), "missed": 0, "hits": 1, "which": last}
            )
            last += 1
        tracks = [track for track in tracks if track["missed"] <= misses]
        rows = [
            [*t["mean"][:2], *np.exp(t["mean"][2:4]), t["which"]]
            for t in tracks
            if t["hits"] >= hits
        ]
        found.append(np.array(rows).reshape(-1, 5))
    return found


def report(clip: Clip, found: dict[str, list[np.ndarray]]) -> None:
    """Print precision and recall, and how many names were given."""
    print(f"  {'':38}{'precision':>10}{'recall':>8}{'names':>7}")
    seen = [rows[rows[:, 2] > 0] for rows in clip.detections]
    for name, rows in {"the detector alone": seen, **found}.items():
        score = precision_recall(rows, clip.truth)
        given = "" if rows is seen else len({int(row[4]) for part in rows for row in part})
        print(f"  {name:38}{score.precision:10.2f}{score.recall:8.2f}{given:>7}")


def draw(clip: Clip, found: list[np.ndarray]) -> Any:
    """Four frames with boxes: the truth dotted, detections thin, what is followed in colour."""
    names = ["a", "b", "c", "d"]
    figure, panels = picture.axes([names[:2], names[2:]], (13, 10))
    height, width = clip.frame_shape
    for name, k in zip(names, np.linspace(3, len(found) - 1, 4).astype(int), strict=True):
        ax = panels[name]
        if clip.frames is not None:
            ax.imshow(clip.frames[k], cmap="gray", vmin=0, vmax=255)
        for rows, style in ((clip.truth[k], ":"), (clip.detections[k], "-")):
            for x, y, w, h, _ in rows[rows[:, 2] > 0]:
                _box(ax, x, y, w, h, picture.FAINT, 1.2, style)
        for x, y, w, h, which in found[k]:
            colour = picture.pyplot().get_cmap("tab10")(int(which) % 10)
            _box(ax, x, y, w, h, colour, 2.5, "-")
            ax.text(
                x,
                y - h / 2,
                f"{int(which)}",
                color=colour,
                weight="bold",
                va="bottom",
                clip_on=True,
            )
        ax.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=f"frame {k + 1}")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Follow them with and without a look at the detections."""
    options = picture.options(__doc__, arguments)
    data = folder("vision")
    if data is None:
        print("no folder 'vision' of the data (BAYESMC_DATA): a drawn scene instead of TUD Campus")
    try:
        clip = drawn() if data is None else campus(data)
    except bmc.errors.MissingExtraError as error:
        print(f"pedestrians: left out, since {error}")
        return
    steps = 15 if options.fast else len(clip.detections)
    clip = clip._replace(detections=clip.detections[:steps], truth=clip.truth[:steps])
    print(f"{clip.name}, {steps} frames; {PARTICLES} particles for each of {SLOTS} elements")
    found = {
        "nearest neighbour, Kalman filters": nearest_neighbour(clip),
        "particles from the transition alone": Tracker(clip, guided=False).follow(clip.detections),
        "boosted: from detections, too": Tracker(clip).follow(clip.detections),
    }
    report(clip, found)
    picture.save(draw(clip, list(found.values())[-1]), options.out, "pedestrians")


# ---- private ------------------------------------------------------------------------------------


def _box(
    ax: Any, x: float, y: float, w: float, h: float, colour: Any, width: float, style: str
) -> None:
    left, right, top, bottom = x - w / 2, x + w / 2, y - h / 2, y + h / 2
    ax.plot(
        [left, right, right, left, left], [top, top, bottom, bottom, top], style, c=colour, lw=width
    )


if __name__ == "__main__":
    main()
