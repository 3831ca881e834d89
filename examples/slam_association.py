"""Whose reading is it: a map made without being told which landmark is read, by particles of Kalman filters.

In FastSLAM a particle is a way that the robot may have gone. Here it is a list of whose the readings are, and
nothing else: given these, where the robot is, how its wheels slip and where the landmarks stand are one
Gaussian, which each particle carries (an extended Kalman filter, as in EKF-SLAM). A way that was drawn stays
as it was drawn; a Gaussian takes back what it said of the way and of the map when a landmark is seen again.

It is the same engine with other words, ``ParticleFilter(marginalize=("gain", "slip", "mark"))``: what is left
to sample is the finite node ``which``. For that all noise must be Gaussian whatever the heading is:

- What the wheels are wrong by is a node of its own, as seen from the robot, and the pose is computed.
- A reading is written as what it is off by, and zero is observed: as seen from the robot where the landmark
  was met before, and in the directions of the hall where it is new, since there a reading is linear in the
  place that it tells.

Where the reference data is at hand, the log is of the UTIAS MRCLAM set 6 (Leung, Halpern, Barfoot, Liu 2011,
International Journal of Robotics Research 30), else a generated one in the same files. Smith, Self and
Cheeseman (1990), Estimating uncertain spatial relationships in robotics; Chen and Liu (2000), Mixture Kalman
filters, J. R. Statist. Soc. B 62.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture
from examples.robot_landmarks import Drive, ellipse
from examples.slam_landmarks import (
    EAGER,
    FAR,
    HALL,
    LASTING,
    LATE,
    LONG,
    PLACES,
    SPREAD,
    Readings,
    best_way,
    fast_slam,
    instants,
    landmarks_of,
    log,
    one_by_one,
    share_near,
    share_right,
    turned,
    with_marks,
    with_picks,
    without_labels,
)

DEPTH, SHARE, BEARING = 0.05, 0.01, 0.01  # m, share of the depth, rad: what a reading is off by
FRESH, FRESH_SHARE = 0.03, 0.01  # m, share of the depth: the same in all directions
ANYWHERE = 3.0  # m: where what is read of no landmark is, around what it is taken for


def net(start: np.ndarray, places: int = PLACES) -> bmc.DynamicBayesNet:
    """The robot, its map, and one reading in a slice."""
    dbn = bmc.DynamicBayesNet("association", plates={"landmark": places})
    shapes = {"motion": (3,), "bend": (3, 2), "noise": (3, 3), "local": (2,), "blur": (2,)}
    for name, shape in shapes.items():
        dbn.input(name, event_shape=shape)
    for name in ("seconds", "fresh"):
        dbn.input(name)

    def gains(gain_prev, seconds):
        kept = np.exp(-seconds / LASTING)[..., None]
        anew = SPREAD * np.sqrt(1 - kept**2 + 1e-9)
        return bmc.MvNormal(1 + kept * (gain_prev - 1), scale_diag=anew * np.ones(2))

    dbn.add("gain", gains, initial=bmc.MvNormal(np.ones(2), scale_diag=[SPREAD, SPREAD]))
    dbn.add("slip", lambda noise: bmc.MvNormal(np.zeros(3), noise))

    @dbn.node(initial=lambda slip: start + slip)
    def pose(pose_prev, gain, slip, motion, bend):
        gone = motion + np.matvec(bend, gain - 1) + slip
        return pose_prev + np.matvec(turned(pose_prev[..., 2]), gone)

    with_picks(with_marks(dbn, np.zeros(2), HALL), places, 0.1 * EAGER)

    @dbn.node
    def off(pose, mark, number, which, local, blur, fresh):
        turn = turned(pose[..., 2])[..., :2, :2]
        away = mark[number.astype(int)] - pose[..., :2]
        met = np.vecmat(away, turn) - local
        new, none = ((which == places + k)[..., None] for k in range(2))
        mean = np.where(new, away - np.matvec(turn, local), np.where(none, 0.0, met))
        scale = np.where(new, fresh[..., None], np.where(none, ANYWHERE, blur))
        return bmc.MvNormal(mean, scale_diag=scale)

    return dbn


def mapped(readings: Readings, drive: Drive, particles: int, seed: int = 0) -> Any:
    """Beliefs about the map and the way; ``readings`` are `one_by_one`."""
    heard = readings.which >= 0
    again = (np.diff(readings.times, prepend=-1.0) == 0) & heard
    deep = np.where(heard, (readings.seen[:, 0] - FAR) / (1 + LONG), 1.0)
    angle = np.where(heard, readings.seen[:, 1] - LATE * readings.spin, 0.0)
    own = {k: getattr(readings, k) for k in ("motion", "bend", "noise", "seconds")}
    inputs = {
        **own,
        "heard": heard * 1,
        "count": np.cumsum(heard) - heard,
        "again": again * 1,
        "local": np.stack([deep, deep * np.tan(angle)], axis=-1),
        "blur": np.stack([np.hypot(DEPTH, SHARE * deep), BEARING * deep], axis=-1),
        "fresh": FRESH + FRESH_SHARE * deep,
    }
    rows = {"off": np.where(heard[:, None], [0.0, 0.0], np.nan)}
    engine = bmc.ParticleFilter(particles, marginalize=("gain", "slip", "mark"), proposal="optimal")
    return bmc.filter(
        net(drive.start), rows, inputs=inputs, engine=engine, rng=seed, keep="particles"
    )


def draw(drive: Drive, readings: Readings, found: Any, numbers: np.ndarray, other: Any) -> Any:
    """The map with its ellipses; how many readings were right by then, beside FastSLAM's."""
    figure, panels = picture.axes([["map", "right"]], (13, 6.0), width_ratios=[1.1, 1])
    ax = panels["map"]
    ax.plot(*readings.truth[:, :2].T, color=picture.EXACT, lw=1.4, label="truth")
    ax.plot(*found.mean("pose")[:, :2].T, color=picture.OTHER, lw=1, label="belief")
    ax.plot(*drive.marks.T, "^", color=picture.EXACT, ms=9, mfc="white", label="landmark")
    met = np.unique(numbers[numbers >= 0])
    for place, var in zip(found.mean("mark")[-1][met], found.var("mark")[-1][met], strict=True):
        ax.plot(*ellipse(place, np.diag(var)), color=picture.OTHER, lw=1.2)
    low, high = drive.marks.min(axis=0) - 2.0, drive.marks.max(axis=0) + 2.0
    ax.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set(xlabel="x in m", ylabel="y in m", title="landmarks that were met, 2 sd, not turned")
    ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize=9)
    ax, heard = panels["right"], readings.which >= 0
    for name, own, colour in (
        ("Kalman filters", numbers, picture.OTHER),
        ("FastSLAM", other, picture.DRAWS),
    ):
        right = heard & (landmarks_of(own, readings, len(drive.marks)) == readings.which)
        share = np.cumsum(right) / np.maximum(np.cumsum(heard), 1)
        ax.plot(readings.times, share, color=colour, lw=1.4, label=name)
    ax.set(xlim=(0, readings.times[-1]), ylim=(0, 1.02), xlabel="s")
    ax.set_title("share of readings assigned right so far")
    ax.legend(frameon=False, loc="lower right")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print shares of readings assigned right, the map's error, and draw both."""
    options = picture.options(__doc__, arguments)
    name, drive = log(options.fast, robot=4)
    readings = one_by_one(instants(drive, 8.0 if options.fast else 300.0))
    particles = 8 if options.fast else 40
    found = mapped(readings, drive, particles)
    other, _ = best_way(without_labels(readings, drive, fast_slam(particles)))
    numbers, _ = best_way(found)
    marks = len(drive.marks)
    heard = readings.which >= 0
    print(
        f"Whose reading is it: {name}, {readings.times[-1]:.0f} s, {heard.sum()} readings,", end=" "
    )
    print(f"{particles} particles")
    for title, own in (("Kalman filters", numbers), ("FastSLAM", other)):
        right, near = share_right(own, readings, marks), share_near(own, readings, drive.marks)
        met = len(np.unique(own[own >= 0]))
        print(f"  {title:14} {100 * right:3.0f} % of readings right,", end=" ")
        print(f"{100 * near:3.0f} % within .3 m,", end=" ")
        print(f"{met} landmarks met of {len(np.unique(readings.which[heard]))}")
    path = readings.rmse(found.mean("pose"))
    print(f"  path {path:.2f} m (root mean square)")
    picture.save(draw(drive, readings, found, numbers, other), options.out, "slam_association")


if __name__ == "__main__":
    main()
