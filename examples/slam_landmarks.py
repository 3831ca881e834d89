"""Mapping while moving: a robot that knows no landmark finds out where they are, and where it is, at once.

Every particle drives its own way, and carries a small Kalman filter for each landmark: given the way, these
are independent (FastSLAM). The map is one plate of a dynamic Bayes net, static in time, that
``ParticleFilter(marginalize="mark")`` integrates out. Three ways to ask are compared:

- *known*: readings wear the barcode of their landmark, an input of the net.
- *unknown*: which landmark a reading is of, a new one or none, is a finite node, drawn by each particle
  from its posterior. Nothing is told but ranges and bearings.
- the same net under an extended Kalman filter (EKF-SLAM): one Gaussian of pose and landmarks. It makes
  readings linear at the prior mean, so it cannot place a landmark that it knows nothing of: all engines are
  given, for this comparison, a prior around where dead reckoning puts each landmark's first reading.

Where the reference data is at hand, the log is of the UTIAS MRCLAM set 6 (Leung, Halpern, Barfoot, Liu 2011,
International Journal of Robotics Research 30), else a generated one in the same files. Filters are told the
first pose and nothing else of the truth. Montemerlo, Thrun, Koller and Wegbreit (2002, 2003); Thrun, Burgard
and Fox (2005), Probabilistic Robotics, chapter 13.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import AndAngle, PoseNormal, bearing_to, compose, range_to
from examples import picture, reference
from examples.robot_landmarks import Drive, ellipse, marks_seen, write_mrclam

SPREAD, LASTING = 0.07, 200.0  # of the wheels' gains, as in `landmark_localization`
PER_METRE, PER_RADIAN, PER_SECOND = 5e-4, 5e-3, 1e-5  # variances that build up, in m^2 and rad^2
RANGE, BEARING = 0.15, 0.02  # m, rad
VAGUE, GUESSED = 30.0, 2.0  # m: standard deviations of a landmark's place beforehand
NEW, CLUTTER = 0.02, 0.002  # of readings: shares of landmarks not met before, and of none
PLACES = 25  # landmarks that a map has room for, where their number is not known


class Readings(NamedTuple):
    """A drive with one reading in a slice: ``which`` is its landmark, -1 where nothing was read.

    One row for each slice: times (T,), motion and effort (T, 3), which (T,), seen (T, 2), truth (T, 3).
    """

    times: np.ndarray
    motion: np.ndarray
    effort: np.ndarray
    which: np.ndarray
    seen: np.ndarray
    truth: np.ndarray

    @property
    def inputs(self) -> dict[str, np.ndarray]:
        return {"motion": self.motion, "effort": self.effort}

    def rmse(self, poses: np.ndarray) -> float:
        """Root mean square over time of the distance from the truth, in m."""
        lasts = np.diff(self.times, append=self.times[-1])
        square = np.square(poses[:, :2] - self.truth[:, :2]).sum(axis=-1)
        known = np.isfinite(square)
        return float(np.sqrt((square * lasts)[known].sum() / lasts[known].sum()))


def one_by_one(drive: Drive, upto: float = np.inf) -> Readings:
    """Slices of a drive with one reading each; readings of one instant follow each other without moving."""
    rows: list[tuple[int, int]] = []
    for k in np.flatnonzero(drive.times <= upto):
        found = np.flatnonzero(np.isfinite(drive.seen[k, :, 0]))
        rows += [(k, j) for j in found] or [(k, -1)]
    at, which = np.array(rows).T
    moves = np.diff(at, prepend=-1)[:, None] > 0
    seen = np.where((which >= 0)[:, None], drive.seen[at, which], np.nan)
    motion, effort = np.where(moves, drive.motion[at], 0.0), np.where(moves, drive.effort[at], 0.0)
    return Readings(drive.times[at], motion, effort, which, seen, drive.truth[at])


def robot(start: np.ndarray, places: int) -> bmc.DynamicBayesNet:
    """Gains of the wheels, and the pose; as many landmarks as the map has room for."""
    dbn = bmc.DynamicBayesNet("slam", plates={"landmark": places})
    dbn.input("motion", event_shape=(3,))
    dbn.input("effort", event_shape=(3,))  # metres, radians, seconds since the slice before

    @dbn.node(initial=bmc.MvNormal([1.0, 1.0], scale_diag=[SPREAD, SPREAD]))
    def gain(gain_prev, effort):
        kept = np.exp(-effort[..., 2:] / LASTING)
        scale = SPREAD * np.sqrt(1 - kept**2 + 1e-9)
        return bmc.MvNormal(1 + kept * (gain_prev - 1), scale_diag=scale * np.ones(2))

    @dbn.node(initial=PoseNormal(start, scale_diag=[1e-3, 1e-3, 1e-3]))
    def pose(pose_prev, gain, motion, effort):
        metres, radians, seconds = effort[..., 0], effort[..., 1], effort[..., 2]
        place = np.sqrt(PER_METRE * metres + 1e-8)
        heading = np.sqrt(PER_RADIAN * radians + PER_SECOND * seconds + 1e-8)
        driven = motion * gain[..., [0, 0, 1]]
        return PoseNormal(
            compose(pose_prev, driven), scale_diag=np.stack([place, place, heading], -1)
        )

    return dbn


def with_marks(dbn: bmc.DynamicBayesNet, mean: Any, scale: float) -> bmc.DynamicBayesNet:
    """Landmarks stay where they are: carried on without noise."""
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, scale_diag=np.zeros(2)),
        plates="landmark",
        initial=lambda: bmc.MvNormal(mean, scale_diag=[scale, scale]),
    )
    return dbn


def known_net(start: np.ndarray, mean: Any, scale: float, places: int) -> bmc.DynamicBayesNet:
    """Readings that say which landmark they are of."""
    dbn = with_marks(robot(start, places), mean, scale)
    dbn.input("which")

    @dbn.node
    def seen(pose, mark, which):
        place = mark[which]
        return AndAngle(
            bmc.Normal(range_to(pose, place), RANGE),
            bmc.WrappedNormal(bearing_to(pose, place), BEARING),
        )

    return dbn


def unknown_net(start: np.ndarray, places: int = PLACES) -> bmc.DynamicBayesNet:
    """Readings that say nothing: each particle counts the landmarks it has met, and picks.

    States of ``which``: the landmarks met, then ``places`` (a new one, which gets the next number) and
    ``places + 1`` (none: a reading from anywhere).
    """
    dbn = with_marks(robot(start, places), np.zeros(2), VAGUE)
    dbn.input("heard")
    dbn.input(
        "again"
    )  # whether it is of the same instant as the reading before, so of another landmark

    def shares(met, other=-1, again=0):
        met, other = np.asarray(met)[..., None], np.where(again, other, -1)[..., None]
        old = np.where(np.arange(places) < met, (1 - NEW - CLUTTER) / np.maximum(met, 1), 0.0)
        old = np.where(np.arange(places) == other, 0.0, old)
        new = np.where(met == 0, 1 - CLUTTER, np.where(met < places, NEW, 0.0))
        every = np.concatenate([old, new, CLUTTER + 0 * new], axis=-1)
        return bmc.Categorical(every / every.sum(axis=-1, keepdims=True))

    dbn.add(
        "which",
        lambda met_prev, number_prev, again: shares(met_prev, number_prev, again),
        initial=lambda: shares(0),
    )
    dbn.add(
        "met",
        lambda met_prev, which, heard: met_prev + (which == places) * heard,
        initial=lambda which, heard: (which == places) * heard,
    )

    @dbn.node(initial=lambda which: 0 * (which == places))
    def number(met_prev, which):
        new = np.minimum(met_prev, places - 1)
        return np.where(which == places, new, np.minimum(which, places - 1))

    @dbn.node
    def seen(pose, mark, number, which):
        place, none = mark[number.astype(int)], which == places + 1
        reach = np.where(none, 2.0, range_to(pose, place))
        angle = np.where(none, 0.0, bearing_to(pose, place))
        return AndAngle(
            bmc.Normal(reach, np.where(none, 2.0, RANGE)),
            bmc.WrappedNormal(angle, np.where(none, 0.5, BEARING)),
        )

    return dbn


def first_places(readings: Readings, marks: int) -> np.ndarray:
    """Where dead reckoning puts each landmark's first reading, shape (marks, 2)."""
    pose, found = readings.truth[0], np.full((marks, 2), np.nan)
    for motion, which, seen in zip(readings.motion, readings.which, readings.seen, strict=True):
        pose = compose(pose, motion)
        if which >= 0 and np.isnan(found[which, 0]):
            angle = pose[2] + seen[1]
            found[which] = pose[:2] + seen[0] * np.array([np.cos(angle), np.sin(angle)])
    return np.where(np.isnan(found), readings.truth[0, :2], found)


def with_labels(
    readings: Readings, drive: Drive, engine: Any, guessed: bool = False, seed: int = 0
) -> Any:
    """Beliefs of any engine where it is known which landmark is read."""
    marks = len(drive.marks)
    mean, scale = (first_places(readings, marks), GUESSED) if guessed else (np.zeros(2), VAGUE)
    inputs = {**readings.inputs, "which": np.maximum(readings.which, 0)}
    dbn = known_net(drive.start, mean, scale, marks)
    return bmc.filter(dbn, {"seen": readings.seen}, inputs=inputs, engine=engine, rng=seed)


def without_labels(readings: Readings, drive: Drive, engine: Any, seed: int = 0) -> Any:
    """Beliefs where it is not known."""
    again = np.diff(readings.times, prepend=-1.0) == 0
    inputs = {**readings.inputs, "heard": (readings.which >= 0) * 1, "again": again * 1}
    dbn = unknown_net(drive.start)
    rows = {"seen": readings.seen}
    with (
        warnings.catch_warnings()
    ):  # a reading that is nobody's surprises all particles: known here
        warnings.simplefilter("ignore", bmc.errors.LowEssWarning)
        return bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=seed, keep="particles")


def assigned(found: Any) -> np.ndarray:
    """The landmark of each reading on the path of the best particle, -1 where it is of none; shape (T,)."""
    clouds = found.clouds
    at = int(np.argmax(clouds[-1].weights))
    numbers = np.empty(len(clouds), dtype=int)
    for k in range(len(clouds) - 1, -1, -1):
        values = clouds[k].values
        numbers[k] = -1 if values["which"][at] == PLACES + 1 else values["number"][at]
        if clouds[k].ancestors is not None:
            at = int(clouds[k].ancestors[at])
    return numbers


def share_right(numbers: np.ndarray, readings: Readings, marks: int) -> float:
    """Of readings, the share whose landmark is right: numbers are matched one to one with landmarks."""
    from scipy.optimize import linear_sum_assignment

    heard = readings.which >= 0
    counts = np.zeros((PLACES, marks))
    some = heard & (numbers >= 0)
    np.add.at(counts, (numbers[some], readings.which[some]), 1)
    rows, columns = linear_sum_assignment(-counts)
    return float(counts[rows, columns].sum() / heard.sum())


def map_rmse(marks: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance of landmarks after the best rotation and shift, in m."""
    return float(np.sqrt(np.square(moved_onto(marks, truth) - truth).sum(axis=-1).mean()))


def moved_onto(marks: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Landmarks turned and shifted onto the true ones: the log fixes neither (Umeyama 1991)."""
    one, other = marks - marks.mean(axis=0), truth - truth.mean(axis=0)
    turn = np.arctan2(
        (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum(), (one * other).sum()
    )
    c, s = np.cos(turn), np.sin(turn)
    return one @ np.array([[c, s], [-s, c]]) + truth.mean(axis=0)


def fast_slam(particles: int) -> bmc.ParticleFilter:
    """FastSLAM 2.0; without ``proposal`` it is FastSLAM 1.0."""
    return bmc.ParticleFilter(particles, marginalize="mark", proposal="optimal")


def figures(
    folder: Path, robots: Sequence[int] = (1, 2, 3, 4, 5), particles: int = 100
) -> dict[int, dict[str, float]]:
    """Errors in m of the robots of an MRCLAM folder, and the share of readings assigned right."""
    found = {}
    for k in robots:
        drive = marks_seen(folder, k)
        readings = one_by_one(drive)
        vague = with_labels(readings, drive, fast_slam(particles))
        same = with_labels(readings, drive, fast_slam(particles), guessed=True)
        kalman = with_labels(readings, drive, bmc.ExtendedKalmanFilter(), guessed=True)
        lost = without_labels(readings, drive, fast_slam(20))
        found[k] = {
            "map": map_rmse(vague.mean("mark")[-1], drive.marks),
            "pose": readings.rmse(vague.mean("pose")),
            "pose, guessed": readings.rmse(same.mean("pose")),
            "pose, EKF-SLAM": readings.rmse(kalman.mean("pose")),
            "right": share_right(assigned(lost), readings, len(drive.marks)),
        }
    return found


def draw(drive: Drive, readings: Readings, found: Any, kalman: Any, spread: np.ndarray) -> Any:
    """The map with its ellipses and the path; errors over time."""
    figure, panels = picture.axes([["map", "error"]], (13, 6.2), width_ratios=[1.1, 1])
    ax = panels["map"]
    ax.plot(*readings.truth[:, :2].T, color=picture.EXACT, lw=1.6, label="truth")
    reckoned = drive.reckoned[drive.times <= readings.times[-1], :2]
    ax.plot(*reckoned.T, ":", color=picture.FAINT, label="dead reckoning")
    ax.plot(*found.mean("pose")[:, :2].T, color=picture.OTHER, lw=1, label="FastSLAM")
    ax.plot(*drive.marks.T, "^", color=picture.EXACT, ms=9, mfc="white", label="landmark")
    met = np.unique(readings.which[readings.which >= 0])
    for place, cov in zip(found.mean("mark")[-1][met], spread[met], strict=True):
        ax.plot(*ellipse(place, cov, 3.0), color=picture.OTHER, lw=1.4)
        ax.plot(*place, ".", color=picture.OTHER)
    ax.set(aspect="equal", xlabel="x in m", ylabel="y in m", title="landmarks with 3 sd ellipses")
    low, high = drive.marks.min(axis=0) - 2.0, drive.marks.max(axis=0) + 2.0
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=4, fontsize=9)
    ax = panels["error"]
    for name, belief, colour in (
        ("FastSLAM", found, picture.OTHER),
        ("EKF-SLAM", kalman, "#2a78b5"),
    ):
        error = np.hypot(*(belief.mean("pose") - readings.truth)[:, :2].T)
        label = f"{name}: {readings.rmse(belief.mean('pose')):.2f} m"
        ax.plot(readings.times, error, color=colour, lw=1, label=label)
    ax.set(xlim=(0, readings.times[-1]), ylim=(0, None), xlabel="s", ylabel="m")
    ax.set_title("distance from the truth")
    ax.legend(frameon=False)
    return figure


def log(fast: bool) -> tuple[str, Drive]:
    """Robot 1 of MRCLAM 6 where the data is, else (or for a smoke test) a generated drive."""
    folder = reference.folder("robot", "mrclam6")
    if folder is not None and not fast:
        return "MRCLAM 6, robot 1", marks_seen(folder, 1)
    with tempfile.TemporaryDirectory() as made:
        return "a generated drive", marks_seen(write_mrclam(Path(made), 60.0 if fast else 200.0), 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print errors of maps and paths, and draw them."""
    options = picture.options(__doc__, arguments)
    name, drive = log(options.fast)
    readings = one_by_one(drive, 25.0 if options.fast else np.inf)
    count = 20 if options.fast else 100
    found = with_labels(readings, drive, fast_slam(count))
    kalman = with_labels(readings, drive, bmc.ExtendedKalmanFilter(), guessed=True)
    short = one_by_one(drive, 8.0 if options.fast else 150.0)
    picks = assigned(without_labels(short, drive, fast_slam(10 if options.fast else 20)))
    met = np.unique(readings.which[readings.which >= 0])
    print(f"Mapping while moving: {name}, {readings.times[-1]:.0f} s, {len(met)} landmarks met")
    maps = [map_rmse(b.mean("mark")[-1][met], drive.marks[met]) for b in (found, kalman)]
    for engine, belief, error in zip(("FastSLAM", "EKF-SLAM"), (found, kalman), maps, strict=True):
        print(f"  {engine:10} path {readings.rmse(belief.mean('pose')):.2f} m, map {error:.2f} m")
    right = share_right(picks, short, len(drive.marks))
    print(f"  not told which landmarks: {100 * right:.0f} % of readings assigned right")
    spread = found.var("mark")[-1][:, :, None] * np.eye(2)
    picture.save(draw(drive, readings, found, kalman, spread), options.out, "slam_landmarks")


if __name__ == "__main__":
    main()
