"""Mapping while moving: a robot that knows no landmark finds out where they are, and where it is, at once.

Every particle drives its own way, and carries a small Kalman filter for each landmark: given the way, these
are independent (FastSLAM). The map is one plate of a dynamic Bayes net, static in time, that
``ParticleFilter(marginalize="mark")`` integrates out. Three ways to ask are compared:

- known: readings wear the barcode of their landmark, an input of the net.
- unknown: which landmark a reading is of, a new one or none, is a finite node, drawn by each particle
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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import AndAngle, bearing_to, compose, range_to, transform, wrap
from examples import picture, reference
from examples.robot_landmarks import Drive, ellipse, marks_seen, write_mrclam

SPREAD, LASTING = 0.07, 200.0  # of the wheels' gains, as in `landmark_localization`
PER_METRE, PER_RADIAN, PER_SECOND = 5e-4, 1e-2, 1e-4  # variances that build up, in m^2 and rad^2
LONG, FAR, LATE = (
    0.02,
    0.04,
    0.033,
)  # of the camera: share and m that depths are too long by, s of delay
# Wider than one error, which lasts over many readings: m, share of what is read, rad
DEPTH, SHARE, BEARING = 0.2, 0.02, 0.06
STRAY = 0.002  # share of readings that wear the barcode of another landmark
# m, m, rad: what a reading of no landmark, or of another one, is about
ANYWHERE, ANYWHERE_DEPTH, ANYWHERE_BEARING = 4.0, 2.0, 0.5
VAGUE, GUESSED = 30.0, 2.0  # m: standard deviations of a landmark's place beforehand
# Where it is not known which landmark is read:
FAST_DEPTH, FAST_BEARING = 0.06, 0.012  # m, rad: what is off by itself in each reading
AIM = 0.008  # rad: what all bearings of an instant are off by
EAGER, CLUTTER = 3.0, 0.0005  # to meet new landmarks; share of readings that are of none
NEAR_DEPTH, NEAR_BEARING = 0.05, 0.012  # m, rad: by which nearness is judged
PLACES, HALL = 25, 8.0  # landmarks that a map has room for; m, how far they stand


class Readings(NamedTuple):
    """A drive as a filter gets it: a slice for each instant at which something was read.

    A slice has ``K`` readings, or fewer and NaN. ``which`` is whose they are, -1 where nothing was read; in
    `one_by_one` a slice has one reading and no axis for them.

    One row for each slice: times (T,), motion (T, 3) since the slice before, ``bend`` (T, 3, 2), how that
    moves with the gains of the wheels, ``noise`` (T, 3, 3), the covariance that built up on the way, seconds
    (T,), spin (T,) in rad/s, which (T, K), seen (T, K, 2), truth (T, 3).
    """

    times: np.ndarray
    motion: np.ndarray
    bend: np.ndarray
    noise: np.ndarray
    seconds: np.ndarray
    spin: np.ndarray
    which: np.ndarray
    seen: np.ndarray
    truth: np.ndarray

    @property
    def inputs(self) -> dict[str, np.ndarray]:
        """What all nets are told of the drive."""
        return {k: getattr(self, k) for k in ("motion", "bend", "noise", "seconds", "spin")}

    def rmse(self, poses: np.ndarray) -> float:
        """Root mean square of the distance from the truth, in m, over the slices where it is known."""
        square = np.square(poses[:, :2] - self.truth[:, :2]).sum(axis=-1)
        return float(np.sqrt(np.nanmean(square)))


def instants(drive: Drive, upto: float = np.inf) -> Readings:
    """Slices of a drive at which something was read; what the wheels said in between is added up.

    The way between two instants is one motion, with the noise that builds up on it. A filter that drew a turn
    in every second of a minute without landmarks could not take back the first when it sees one again; drawn
    as a whole, with a look at what is read at its end, the way can lead there.
    """
    some = np.isfinite(drive.seen[..., 0])
    most = max(int(some.sum(axis=1).max()), 1)
    rows: list[tuple[Any, ...]] = []
    way = _Way()
    for k in np.flatnonzero(drive.times <= upto):
        way.drive(drive.motion[k], drive.effort[k])
        if rows and not some[k].any():
            continue
        own = np.flatnonzero(some[k])
        which, seen = np.full(most, -1), np.full((most, 2), np.nan)
        which[: len(own)], seen[: len(own)] = own, drive.seen[k, own]
        spin = drive.motion[k, 2] / drive.effort[k, 2] if drive.effort[k, 2] > 0 else 0.0
        rows.append((drive.times[k], *way.told, spin, which, seen, drive.truth[k]))
        way = _Way()
    return Readings(*(np.array(column) for column in zip(*rows, strict=True)))


class _Way:
    """What the wheels say of a way, added up: motion, how it moves with the gains, covariance, seconds."""

    def __init__(self) -> None:
        self.motion, self.bend, self.noise = np.zeros(3), np.zeros((3, 2)), np.zeros((3, 3))
        self.seconds = 0.0

    @property
    def told(self) -> tuple[Any, ...]:
        return self.motion, self.bend, self.noise, self.seconds

    def drive(self, motion: np.ndarray, effort: np.ndarray) -> None:
        """One more stretch: its motion as seen from its start, and the metres, radians and seconds of it."""
        turn = turned(self.motion[2])
        x, y, angle = turn @ motion
        shift = np.eye(3)  # what stands before moves with the heading
        shift[:2, 2] = -y, x
        halfway = 0.5 * angle  # a gain of the turn bends the arc by half of it
        gains = turn @ [
            [motion[0], -halfway * motion[1]],
            [motion[1], halfway * motion[0]],
            [0, angle],
        ]
        place = PER_METRE * effort[0] + 1e-8
        heading = PER_RADIAN * effort[1] + PER_SECOND * effort[2] + 1e-8
        own = turn @ np.diag([place, place, heading]) @ turn.T
        self.bend = shift @ self.bend + gains
        self.noise = shift @ self.noise @ shift.T + own
        self.motion = self.motion + [x, y, angle]
        self.seconds += float(effort[2])


def turned(heading: Any) -> np.ndarray:
    """Rotations of (x, y, heading) by a heading, shape (..., 3, 3)."""
    c, s = np.cos(heading), np.sin(heading)
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, one]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def one_by_one(readings: Readings) -> Readings:
    """The same with one reading in a slice; those of one instant follow each other without moving.

    All bearings of an instant are off by something in common, how the camera points: the heading is told
    anew in each of them.
    """
    heard = readings.which >= 0
    heard[0, 0] = True  # where the drive starts is a slice also where nothing is read
    rows, columns = np.nonzero(heard)
    again = np.diff(rows, prepend=-1) == 0
    still = 1e-8 * np.eye(3)
    first = [np.where(again.reshape(-1, *[1] * (a.ndim - 1)), 0.0, a[rows]) for a in readings[1:5]]
    first[2] += np.where(again[:, None, None], still, np.diag([0.0, 0.0, AIM**2]))
    return Readings(
        readings.times[rows],
        *first,
        readings.spin[rows],
        readings.which[rows, columns],
        readings.seen[rows, columns],
        readings.truth[rows],
    )


def robot(start: np.ndarray, **plates: int) -> bmc.DynamicBayesNet:
    """The pose, and the gains of the wheels on the way to it, as one vector of five numbers.

    Gains of nodes of their own would be drawn blindly; in one vector with the pose, the proposal of FastSLAM
    2.0 leads them to where the way ended. The heading is a number that goes on beyond a full turn.
    """
    dbn = bmc.DynamicBayesNet("slam", plates=plates)
    for name, shape in (("motion", (3,)), ("bend", (3, 2)), ("noise", (3, 3))):
        dbn.input(name, event_shape=shape)
    for name in ("seconds", "spin"):
        dbn.input(name)
    first = bmc.MvNormal(
        np.append(start, [1.0, 1.0]), scale_diag=[1e-3, 1e-3, 1e-3, SPREAD, SPREAD]
    )

    @dbn.node(initial=first)
    def pose(pose_prev, motion, bend, noise, seconds):
        kept = np.exp(-seconds / LASTING)[..., None]
        gain = 1 + kept * (pose_prev[..., 3:] - 1)
        anew = SPREAD**2 * (1 - kept**2 + 1e-9)
        turn = turned(pose_prev[..., 2])
        driven = pose_prev[..., :3] + np.matvec(turn, motion + np.matvec(bend, gain - 1))
        steered = np.eye(5, 3) @ turn
        ends = steered @ bend + np.eye(5, 2, -3)  # where a way ends moves with the gains on it
        of_gains = anew[..., None] * ends @ np.swapaxes(ends, -1, -2)
        of_way = steered @ noise @ np.swapaxes(steered, -1, -2)
        return bmc.MvNormal(np.concatenate([driven, gain], axis=-1), of_gains + of_way)

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


def by_camera(pose: Any, place: Any, spin: Any) -> tuple[np.ndarray, np.ndarray]:
    """What a camera without noise reads of a landmark: how deep it stands, and where.

    It tells the distance by how large a barcode looks, which goes by the depth along the axis of the camera
    and not by the range; MRCLAM 6 writes the depth. Its pictures are some 33 ms old.
    """
    pose = pose[..., :3]
    angle = bearing_to(pose, place)
    deep = range_to(pose, place) * np.cos(angle)
    return (1 + LONG) * deep + FAR, angle + LATE * spin


def read_or_stray(read: tuple[Any, Any], none: Any, depth: Any, bearing: Any) -> AndAngle:
    """Density of a reading by the camera, or from anywhere (``none``)."""
    far, angle = read
    return AndAngle(
        bmc.Normal(np.where(none, ANYWHERE, far), np.where(none, ANYWHERE_DEPTH, depth)),
        bmc.WrappedNormal(np.where(none, 0.0, angle), np.where(none, ANYWHERE_BEARING, bearing)),
    )


def known_net(
    start: np.ndarray, mean: Any, scale: float, places: int, most: int
) -> bmc.DynamicBayesNet:
    """Readings that say which landmark they are of, ``most`` in an instant; of a few this is not true.

    Errors grow with the depth (``deep`` is what was read), since a camera tells it by size. A misread
    barcode is off by metres, and where no state stood for it a single one would leave those particles that
    are most wrong.
    """
    dbn = with_marks(robot(start, landmark=places, reading=most), mean, scale)
    dbn.input("which", plates="reading")
    dbn.input("deep", plates="reading")
    dbn.add("stray", bmc.Bernoulli(STRAY), plates="reading")

    @dbn.node(plates="reading")
    def seen(pose, mark, which, deep, spin, stray):
        wide = np.sqrt(DEPTH**2 + (SHARE * deep) ** 2)
        return read_or_stray(by_camera(pose, mark[which], spin), stray == 1, wide, BEARING)

    return dbn


def with_picks(dbn: bmc.DynamicBayesNet, places: int, eager: float = EAGER) -> bmc.DynamicBayesNet:
    """Which landmark a reading is of.

    States of ``which``: the landmarks met, then ``places`` (a new one, which gets the next number) and
    ``places + 1`` (none: a reading from anywhere). That a reading is of a new one is the less likely the more
    readings there were, as in a Chinese restaurant process. Readings of one instant are of different
    landmarks: those that are ``taken`` are out, one bit for each.
    """
    for name in ("heard", "count", "again"):  # read at all, readings before, of the same instant
        dbn.input(name)

    def shares(met, count, taken):
        met, count, taken = (np.asarray(a)[..., None] for a in (met, count, taken))
        free = (np.arange(places) < met) & (taken >> np.arange(places) & 1 == 0)
        new = np.where(met < places, eager / (eager + count), 0.0)
        old = np.where(free, (1 - new) / np.maximum(met, 1), 0.0)
        every = np.concatenate(
            [(1 - CLUTTER) * old, (1 - CLUTTER) * new, CLUTTER + 0 * new], axis=-1
        )
        return bmc.Categorical(every / every.sum(axis=-1, keepdims=True))

    dbn.add(
        "which",
        lambda met_prev, taken_prev, count, again: shares(met_prev, count, taken_prev * again),
        initial=lambda count: shares(0, count, 0),
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

    def bit(number, which, heard):
        return (1 << number.astype(int)) * (which <= places) * heard

    dbn.add(
        "taken",
        lambda taken_prev, number, which, heard, again: (
            taken_prev * again + bit(number, which, heard)
        ),
        initial=bit,
    )
    return dbn


def unknown_net(start: np.ndarray, places: int = PLACES) -> bmc.DynamicBayesNet:
    """Readings that say nothing: each particle counts the landmarks it has met, and picks."""
    dbn = with_picks(with_marks(robot(start, landmark=places), np.zeros(2), HALL), places)

    @dbn.node
    def seen(pose, mark, number, which, spin):
        read = by_camera(pose, mark[number.astype(int)], spin)
        return read_or_stray(read, which == places + 1, FAST_DEPTH, FAST_BEARING)

    return dbn


def first_places(readings: Readings, marks: int) -> np.ndarray:
    """Where dead reckoning puts each landmark's first reading, shape (marks, 2)."""
    pose, found = readings.truth[0], np.full((marks, 2), np.nan)
    for motion, own, seen in zip(readings.motion, readings.which, readings.seen, strict=True):
        pose = compose(pose, motion)
        for k, (deep, angle) in zip(own, seen, strict=True):
            if k >= 0 and np.isnan(found[k, 0]):
                found[k] = transform(pose, [deep, deep * np.tan(angle)])
    return np.where(np.isnan(found), readings.truth[0, :2], found)


def with_labels(
    readings: Readings,
    drive: Drive,
    engine: Any,
    guessed: bool = False,
    seed: int = 0,
    stray: np.ndarray | None = None,
) -> Any:
    """Beliefs of any engine, given which landmarks are read, and where known what is misread (``stray``)."""
    marks = len(drive.marks)
    mean, scale = (first_places(readings, marks), GUESSED) if guessed else (np.zeros(2), VAGUE)
    deep = np.where(readings.which >= 0, readings.seen[..., 0], 1.0)
    inputs = {**readings.inputs, "which": np.maximum(readings.which, 0), "deep": deep}
    rows = {"seen": readings.seen} | ({} if stray is None else {"stray": stray})
    dbn = known_net(drive.start, mean, scale, marks, readings.which.shape[1])
    return bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=seed)


class Averaged(NamedTuple):
    """Several runs of a filter as one belief; arrays by node, with an axis of slices first."""

    means: dict[str, np.ndarray]
    variances: dict[str, np.ndarray]

    def mean(self, name: str) -> np.ndarray:
        """Mean of a node over all runs."""
        return self.means[name]

    def var(self, name: str) -> np.ndarray:
        """Variance of a node: within the runs, and between them."""
        return self.variances[name]


def averaged(readings: Readings, drive: Drive, particles: int, runs: int) -> Averaged:
    """FastSLAM, run several times by itself; each run counts the same.

    What all particles of a run share of their past after many slices, how the map as a whole is turned above
    all, is one draw of the posterior for the whole run. A path by one draw is off by that draw and by the
    posterior's own spread, the mean of R of them by an R-th of the first (in squares). By their evidence the
    likeliest run would have nearly all the weight, since logs of evidence scatter by more than 1 from
    run to run; that is noise of the method, and tells little of which run is near the truth. Vergé,
    Dubarry, Del Moral and Moulines (2015), Statistics and Computing 25, on islands of particles.
    """
    engine, names = fast_slam(particles), ("pose", "mark")
    found = (with_labels(readings, drive, engine, seed=seed) for seed in range(runs))
    own = [[(f.mean(n), f.var(n)) for n in names] for f in found]
    means, variances = {}, {}
    for name, each in zip(names, zip(*own, strict=True), strict=True):
        mean, var = (np.stack(a) for a in zip(*each, strict=True))
        means[name], variances[name] = mean.mean(axis=0), var.mean(axis=0) + mean.var(axis=0)
    return Averaged(means, variances)


def ekf_slam(readings: Readings, drive: Drive, stray: np.ndarray | None = None) -> Any:
    """The same net under an extended Kalman filter, which has no states: it takes every barcode for right."""
    if stray is None:
        stray = np.zeros(readings.which.shape, dtype=int)
    return with_labels(readings, drive, bmc.ExtendedKalmanFilter(), guessed=True, stray=stray)


def misread(readings: Readings, marks: np.ndarray) -> np.ndarray:
    """Readings that by the truth are of another landmark than their barcode says, shape (T, K), 0 or 1."""
    deep, angle = by_camera(readings.truth[:, None], marks[np.maximum(readings.which, 0)], 0.0)
    far = np.abs(readings.seen[..., 0] - deep) > 1.2
    aside = np.abs(wrap(readings.seen[..., 1] - angle)) > 0.2
    return ((far | aside) & (readings.which >= 0)).astype(int)


def without_labels(readings: Readings, drive: Drive, engine: Any, seed: int = 0) -> Any:
    """Beliefs where it is not known."""
    heard = readings.which >= 0
    again = (np.diff(readings.times, prepend=-1.0) == 0) & heard
    count = np.cumsum(heard) - heard
    inputs = {**readings.inputs, "heard": heard * 1, "count": count, "again": again * 1}
    dbn, rows = unknown_net(drive.start), {"seen": readings.seen}
    return bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=seed, keep="particles")


def best_way(found: Any) -> tuple[np.ndarray, np.ndarray]:
    """The landmark of each reading on the path of the best particle, -1 where it is of none, and its poses.

    Shapes (T,) and (T, ...).
    """
    clouds = found.clouds
    at = int(np.argmax(clouds[-1].weights))
    numbers = np.empty(len(clouds), dtype=int)
    poses = np.empty((len(clouds), *clouds[0].values["pose"].shape[1:]))
    for k in range(len(clouds) - 1, -1, -1):
        values = clouds[k].values
        numbers[k] = -1 if values["which"][at] == PLACES + 1 else values["number"][at]
        poses[k] = values["pose"][at]
        if clouds[k].ancestors is not None:
            at = int(clouds[k].ancestors[at])
    return numbers, poses


def looked_back(
    numbers: np.ndarray, poses: np.ndarray, readings: Readings, rounds: int = 20
) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks of readings, and the map, by the whole record: a particle picks by what was read before.

    On the way of one particle, in turn until nothing changes: the map given whose each reading is, and
    whose it most probably is given the map. Each step makes the posterior of both larger.
    """
    marks = marks_on(poses, numbers, readings)
    for _ in range(rounds):
        before, numbers = numbers, most_probable(poses, marks, readings, np.unique(numbers))
        if (numbers == before).all():
            break
        marks = marks_on(poses, numbers, readings)
    return numbers, marks


def marks_on(poses: np.ndarray, numbers: np.ndarray, readings: Readings) -> np.ndarray:
    """The most probable map on a known way, with known landmarks, shape (PLACES, 2)."""
    some = (readings.which >= 0) & (numbers >= 0)
    net = bmc.BayesNet("map", plates={"landmark": PLACES, "reading": int(some.sum())})
    told = {"pose": poses[some], "number": numbers[some], "spin": readings.spin[some]}
    for name, value in told.items():
        net.input(name, plates="reading", event_shape=value.shape[1:])
    net.add("mark", bmc.MvNormal(np.zeros(2), scale_diag=[HALL, HALL]), plates="landmark")

    @net.node(plates="reading")
    def seen(pose, mark, number, spin):
        return read_or_stray(by_camera(pose, mark[number], spin), False, FAST_DEPTH, FAST_BEARING)

    return bmc.map(net, {"seen": readings.seen[some]}, inputs=told)["mark"]


def most_probable(
    poses: np.ndarray, marks: np.ndarray, readings: Readings, among: np.ndarray
) -> np.ndarray:
    """Whose readings are on a known way with a known map, -1 for none: each landmark once in an instant."""
    from scipy.optimize import linear_sum_assignment

    heard, among = readings.which >= 0, among[among >= 0]
    seen = readings.seen[:, None]
    read = by_camera(poses[:, None], marks[among], readings.spin[:, None])
    own = read_or_stray(read, False, FAST_DEPTH, FAST_BEARING).log_prob(seen)
    none = read_or_stray(read, True, FAST_DEPTH, FAST_BEARING).log_prob(seen)
    # what a particle believes of a reading beforehand, once it has met all these
    more = own + np.log((1 - CLUTTER) / len(among)) - none - np.log(CLUTTER)
    numbers = np.full(len(heard), -1)
    for rows in np.split(np.flatnonzero(heard), np.flatnonzero(np.diff(readings.times[heard])) + 1):
        at, which = linear_sum_assignment(-np.maximum(more[rows], 0.0))
        kept = more[rows[at], which] > 0
        numbers[rows[at[kept]]] = among[which[kept]]
    return numbers


def _counts(numbers: np.ndarray, readings: Readings, marks: int) -> np.ndarray:
    """How often each number of a path was given to readings of each landmark."""
    some = (readings.which >= 0) & (numbers >= 0)
    counts = np.zeros((PLACES, marks))
    np.add.at(counts, (numbers[some], readings.which[some]), 1)
    return counts


def landmarks_of(numbers: np.ndarray, readings: Readings, marks: int) -> np.ndarray:
    """The landmark that each reading was assigned to, -1 for none; numbers match landmarks one to one."""
    from scipy.optimize import linear_sum_assignment

    meaning = np.full(PLACES + 1, -1)  # the last is of no landmark
    rows, columns = linear_sum_assignment(-_counts(numbers, readings, marks))
    meaning[rows] = columns
    return meaning[numbers]


def share_right(numbers: np.ndarray, readings: Readings, marks: int) -> float:
    """Of readings, the share whose landmark is right."""
    heard = readings.which >= 0
    return float((landmarks_of(numbers, readings, marks) == readings.which)[heard].mean())


def share_near(numbers: np.ndarray, readings: Readings, marks: np.ndarray) -> float:
    """Of readings, the share within .3 m of the right one: a number stands for what it is read as most."""
    counts = _counts(numbers, readings, len(marks))
    near = np.hypot(*(marks[:, None] - marks).T) < 0.3
    own = (counts * near[counts.argmax(axis=1)]).sum()
    return float(own / (readings.which >= 0).sum())


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
    folder: Path, robots: Sequence[int] = (1, 2, 3, 4, 5), particles: int = 1200, runs: int = 4
) -> Iterator[tuple[int, dict[str, float]]]:
    """Errors in m of the robots of an MRCLAM folder where it is known which landmark is read, one by one."""
    for k in robots:
        drive = marks_seen(folder, k)
        readings = instants(drive)
        found = averaged(readings, drive, particles, runs)
        kalman = ekf_slam(readings, drive)
        told = ekf_slam(readings, drive, misread(readings, drive.marks))
        yield (
            k,
            {
                "map": map_rmse(found.mean("mark")[-1], drive.marks),
                "pose": readings.rmse(found.mean("pose")),
                "map, EKF-SLAM": map_rmse(kalman.mean("mark")[-1], drive.marks),
                "pose, EKF-SLAM": readings.rmse(kalman.mean("pose")),
                "map, EKF-SLAM told what is stray": map_rmse(told.mean("mark")[-1], drive.marks),
                "pose, EKF-SLAM told what is stray": readings.rmse(told.mean("pose")),
            },
        )


def picks(
    folder: Path, robots: Sequence[int] = (1, 2, 3, 4, 5), particles: int = 40
) -> Iterator[tuple[int, dict[str, float]]]:
    """Shares of readings assigned right where it is not known, beside those of who knows pose and map."""
    for k in robots:
        drive = marks_seen(folder, k)
        readings = one_by_one(instants(drive))
        found = without_labels(readings, drive, fast_slam(particles))
        on_the_way, poses = best_way(found)
        numbers, _ = looked_back(on_the_way, poses, readings)
        yield (
            k,
            {
                "right": share_right(numbers, readings, len(drive.marks)),
                "right on the way": share_right(on_the_way, readings, len(drive.marks)),
                "within .3 m": share_near(numbers, readings, drive.marks),
                "met": float(found.mean("met")[-1]),
                **ceilings(readings, drive.marks),
            },
        )


def ceilings(readings: Readings, marks: np.ndarray) -> dict[str, float]:
    """Shares right of who knows all poses and the map, and looks at readings, one in a slice, as independent.

    The nearest landmark, by deviations of depth and bearing; the same with each landmark once in an instant;
    and with what is off by the robot's own camera, a line in the depth and one in the bearing, taken away.
    """
    from scipy.optimize import linear_sum_assignment

    known = np.flatnonzero((readings.which >= 0) & np.isfinite(readings.truth[:, 0]))
    pose, seen, which = readings.truth[known], readings.seen[known], readings.which[known]
    read = np.stack(by_camera(pose[:, None], marks, readings.spin[known, None]), axis=-1)
    off = seen[:, None, :] - read
    off[..., 1] = wrap(off[..., 1])
    _, instant = np.unique(readings.times[known], return_inverse=True)

    def once(cost: np.ndarray) -> float:
        right = 0
        for rows in np.split(np.arange(len(which)), np.flatnonzero(np.diff(instant)) + 1):
            own, other = linear_sum_assignment(cost[rows])
            right += int((which[rows][own] == other).sum())
        return right / len(which)

    near = np.array([NEAR_DEPTH, NEAR_BEARING])
    cost = np.square(off / near).sum(axis=-1)
    own = np.arange(len(which)), which
    usual = (np.abs(off[own]) < 8 * near).all(axis=-1)  # without what is far off
    mended = off.copy()
    for k in range(2):
        lines = np.stack([np.ones_like(read[..., k]), read[..., k]], axis=-1)
        slope = np.linalg.lstsq(lines[own][usual], off[own][usual, k], rcond=None)[0]
        mended[..., k] -= lines @ slope
    return {
        "told all: nearest": float((cost.argmin(axis=1) == which).mean()),
        "each once": once(cost),
        "and unbiased": once(np.square(mended / near).sum(axis=-1)),
    }


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
    ax.set(aspect="equal", xlabel="x in m", ylabel="y in m", title="landmarks, 3 sd given the path")
    low, high = drive.marks.min(axis=0) - 2.0, drive.marks.max(axis=0) + 2.0
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=4, fontsize=9)
    ax = panels["error"]
    for name, belief, colour in (
        ("FastSLAM", found, picture.OTHER),
        ("EKF-SLAM", kalman, "#2a78b5"),
    ):
        error = np.hypot(*(belief.mean("pose")[:, :2] - readings.truth[:, :2]).T)
        label = f"{name}: {readings.rmse(belief.mean('pose')):.2f} m"
        ax.plot(readings.times, error, color=colour, lw=1, label=label)
    ax.set(xlim=(0, readings.times[-1]), ylim=(0, None), xlabel="s", ylabel="m")
    ax.set_title("distance from the truth")
    ax.legend(frameon=False)
    return figure


def log(fast: bool, robot: int = 1) -> tuple[str, Drive]:
    """A robot of MRCLAM 6 where the data is, else (or for a smoke test) a generated drive."""
    folder = reference.folder("robot", "mrclam6")
    if folder is not None and not fast:
        return f"MRCLAM 6, robot {robot}", marks_seen(folder, robot)
    with tempfile.TemporaryDirectory() as made:
        return "a generated drive", marks_seen(
            write_mrclam(Path(made), 60.0 if fast else 200.0, depths=True), 1
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print errors of maps and paths, and draw them."""
    options = picture.options(__doc__, arguments)
    name, drive = log(options.fast)
    readings = instants(drive, 25.0 if options.fast else np.inf)
    found = averaged(readings, drive, *((20, 2) if options.fast else (100, 2)))
    kalman = ekf_slam(readings, drive)
    short = one_by_one(instants(drive, 8.0 if options.fast else 60.0))
    engine = fast_slam(10 if options.fast else 20)
    on_the_way, poses = best_way(without_labels(short, drive, engine))
    numbers, _ = looked_back(on_the_way, poses, short)
    met = np.unique(readings.which[readings.which >= 0])
    print(f"Mapping while moving: {name}, {readings.times[-1]:.0f} s, {len(met)} landmarks met")
    for engine_name, belief in (("FastSLAM", found), ("EKF-SLAM", kalman)):
        marks, var = (a[-1][met] for a in (belief.mean("mark"), belief.var("mark")))
        path, after = readings.rmse(belief.mean("pose")), map_rmse(marks, drive.marks[met])
        off = np.sqrt((np.square(marks - drive.marks[met]) / var).mean())
        print(
            f"  {engine_name:10} path {path:.2f} m, map {after:.2f} m, before it is turned", end=" "
        )
        print(f"{off:.0f} times what its spread tells")
    first, right = (share_right(n, short, len(drive.marks)) for n in (on_the_way, numbers))
    near = share_near(numbers, short, drive.marks)
    print(
        f"  not told which landmarks: {100 * first:.0f} % of readings assigned right on the way,",
        end=" ",
    )
    print(f"{100 * right:.0f} % looking back, {100 * near:.0f} % within .3 m")
    spread = found.var("mark")[-1][:, :, None] * np.eye(2)
    picture.save(draw(drive, readings, found, kalman, spread), options.out, "slam_landmarks")


if __name__ == "__main__":
    main()
