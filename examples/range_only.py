"""Range only: a mowing robot hears how far four radio beacons are, always too far; the bias is estimated.

Ranges of such radios come out too long, by how much depends on antennas and ground. Nothing is subtracted by
hand: the *bias* is a node, known to within 5 m at the start, and the filters find it with the path. It is
declared in two ways.

- constant: one number for all ranges.
- growing: a bias for a range of 40 m, and by how much it grows per metre of range. On the Plaza all four
  beacons say that it does, and the error of the position is a quarter of that with a constant.

Both are parameters; but a particle filter that never moves a parameter is left with few of its values, so the
nodes wander, the bias by 15 cm in a minute; the extended Kalman filter is given the same template.

How far the wheels err is learned from the first 100 s, where somebody followed the robot. That matters: the
generated robot's headings drift five times as much as those of Plaza 1; with Plaza 1's noise, filters are
up to twice as far off there, sure of it, and the particle filter warns (``ModelMisfitWarning``).

Where the reference data is at hand, the log is Plaza 1 (Djugash, Hamner and Roth 2009, Journal of
Field Robotics 26), else a generated one in the same files, whose bias is 2.5 m and constant. Filters are told
the first true pose, with 0.3 rad of doubt about the heading, and where the beacons are.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import PoseNormal, between, compose, range_only, range_to, wrap
from examples import picture, reference
from examples.robot_landmarks import Drive, ellipse, ranges_heard, write_plaza

DOUBT, GROWTH, MIDDLE = 5.0, 0.1, 40.0  # m, m per m, and the range in m that the bias is stated for
WANDER = (0.02, 5e-4)  # of both, in the root of a second
FOLLOWED = 100.0  # s from the start in which true poses are known, for the noise of the wheels
LEAST = (
    1e-3,
    1e-4,
)  # variances per metre in m^2 and rad^2 that no wheels are below: see `wheel_noise`
NOISE = {"constant": 2.5, "growing": 1.0}  # m; what a constant leaves out of the bias is noise
PARTICLES = 1000


def robot(drive: Drive, bias_is: str = "growing") -> bmc.DynamicBayesNet:
    """The bias, the pose, and the range of each beacon."""
    dbn = bmc.DynamicBayesNet("range only", plates={"beacon": len(drive.marks)})
    dbn.input("motion", event_shape=(3,))
    dbn.input("effort", event_shape=(3,))  # metres, radians, seconds since the slice before

    def wandering(scale):
        def node(before, effort):
            return bmc.Normal(before, scale * np.sqrt(effort[..., 2] + 1e-6))

        return node

    dbn.add("bias", wandering(WANDER[0]), ["bias_prev", "effort"], initial=bmc.Normal(0.0, DOUBT))
    per_metre, turn_per_metre = wheel_noise(drive)
    if bias_is == "growing":
        start = bmc.Normal(0.0, GROWTH)
        dbn.add("growth", wandering(WANDER[1]), ["growth_prev", "effort"], initial=start)
    else:
        dbn.add("growth", lambda: 0.0)

    @dbn.node(initial=PoseNormal(drive.start, scale_diag=[0.1, 0.1, 0.3]))
    def pose(pose_prev, motion, effort):
        metres = effort[..., 0]
        place, heading = np.sqrt(per_metre * metres + 1e-6), np.sqrt(turn_per_metre * metres + 1e-7)
        scale = np.stack([place, place, heading], axis=-1)
        return PoseNormal(compose(pose_prev, motion), scale_diag=scale)

    @dbn.node(plates="beacon")
    def heard(pose, bias, growth):
        longer = bias + growth * (range_to(pose, drive.marks) - MIDDLE)
        return range_only(pose, drive.marks, NOISE[bias_is], longer)

    return dbn


def wheel_noise(drive: Drive) -> tuple[float, float]:
    """Variances that build up along the way, in m^2 and rad^2 per metre, from where true poses are known.

    What the wheels say of each metre, its length and its turn, against the true poses: headings that are all
    turned make no difference, which is for filters to notice. Plaza 1's true headings come from the robot's
    own gyroscope, which is then right without fail; hence a least variance.
    """
    driven = np.cumsum(drive.effort[drive.times <= FOLLOWED, 0])
    at = np.unique(np.searchsorted(driven[:-1], np.arange(0.0, driven[-1], 1.0)))
    said, was = (between(poses[at[:-1]], poses[at[1:]]) for poses in (drive.reckoned, drive.truth))
    longer = np.hypot(*said[:, :2].T) - np.hypot(*was[:, :2].T)
    metres = np.diff(driven[at]).sum()
    place, turn = (longer**2).sum() / metres, (wrap(said[:, 2] - was[:, 2]) ** 2).sum() / metres
    return max(float(place), LEAST[0]), max(float(turn), LEAST[1])


def filtered(
    drive: Drive, engine: Any, bias_is: str = "growing", seed: int = 0, keep: str | None = None
) -> Any:
    """Beliefs slice by slice, of any engine over time."""
    inputs = {"motion": drive.motion, "effort": drive.effort}
    dbn, rows = robot(drive, bias_is), {"heard": drive.seen}
    return bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=seed, keep=keep)


def figures(
    folder: Path, seeds: Sequence[int] = (0, 1, 2, 3, 4), particles: int = PARTICLES
) -> dict[str, dict[str, float]]:
    """Errors in m on the Plaza log of a folder, and the bias at the end with its standard deviation.

    The reference, an extended Kalman filter from whose ranges 2.8 m were subtracted, was off by 1.06 m.
    """
    drive = ranges_heard(folder)
    found = {"dead reckoning": {"rmse": drive.rmse(drive.reckoned)}}
    for bias_is in ("constant", "growing"):
        kalman = [filtered(drive, bmc.ExtendedKalmanFilter(), bias_is)]
        cloud = [filtered(drive, bmc.ParticleFilter(particles), bias_is, seed) for seed in seeds]
        found[f"extended Kalman, {bias_is}"] = _summary(drive, kalman)
        if cloud:
            found[f"particles, {bias_is}"] = _summary(drive, cloud)
    return found


def _summary(drive: Drive, runs: list[Any]) -> dict[str, float]:
    """Means over runs."""
    return {
        "rmse": float(np.mean([drive.rmse(b.mean("pose")) for b in runs])),
        "bias": float(np.mean([b.mean("bias")[-1] for b in runs])),
        "sd": float(np.mean([b.std("bias")[-1] for b in runs])),
        "growth": float(np.mean([b.mean("growth")[-1] for b in runs])),
    }


COLOURS = {
    "extended Kalman, constant": "#c98a1b",
    "extended Kalman, growing": "#2a78b5",
    "particles, growing": picture.OTHER,
}


def beliefs(drive: Drive, particles: int) -> dict[str, Any]:
    """The Kalman filter with both biases, the particle filter with the better one, held for its ellipses."""
    return {
        "extended Kalman, constant": filtered(drive, bmc.ExtendedKalmanFilter(), "constant"),
        "extended Kalman, growing": filtered(drive, bmc.ExtendedKalmanFilter()),
        "particles, growing": filtered(drive, bmc.ParticleFilter(particles), keep="particles"),
    }


def draw(drive: Drive, found: dict[str, Any]) -> Any:
    """Map with paths and ellipses; errors over time; the bias."""
    layout = [["map", "error"], ["map", "bias"]]
    figure, panels = picture.axes(layout, (14, 7.6), width_ratios=[1.1, 1])
    _draw_map(panels["map"], drive, found)
    ax = panels["error"]
    for name, belief in found.items():
        mean = belief.mean("pose")
        label = f"{name}: {drive.rmse(mean):.2f} m"
        ax.plot(drive.times, drive.error(mean), color=COLOURS[name], lw=1, label=label)
    wheels = drive.error(drive.reckoned)
    label = f"dead reckoning: {drive.rmse(drive.reckoned):.2f} m"
    ax.plot(drive.times, wheels, ":", color=picture.FAINT, lw=1.6, label=label)
    worst = max(np.nanmax(drive.error(belief.mean("pose"))) for belief in found.values())
    top = min(1.5 * np.nanmax(wheels), 2.5 * worst)  # wheels alone may end anywhere
    ax.set(xlim=(0, drive.times[-1]), ylim=(0, top), ylabel="m")
    ax.set_title("distance from the truth")
    ax.legend(frameon=False, loc="upper center", ncols=2, fontsize=9)
    _draw_bias(panels["bias"], drive, found)
    return figure


def _draw_map(ax: Any, drive: Drive, found: dict[str, Any]) -> None:
    """The first minutes, with two-sigma ellipses every so often: a mower covers its own tracks."""
    upto = drive.times <= min(400.0, drive.times[-1])
    ax.plot(*drive.truth[upto, :2].T, color=picture.EXACT, lw=2.2, label="truth")
    ax.plot(*drive.reckoned[upto, :2].T, ":", color=picture.FAINT, lw=1.6, label="dead reckoning")
    at = np.searchsorted(drive.times, np.linspace(20.0, drive.times[upto][-1], 10))
    for name, belief in found.items():
        mean = belief.mean("pose")
        ax.plot(*mean[upto, :2].T, color=COLOURS[name], lw=1.1, label=name)
        for k in np.minimum(at, len(mean) - 1):
            ax.plot(*ellipse(mean[k, :2], belief.cov("pose")[k, :2, :2]), color=COLOURS[name], lw=1)
    ax.plot(*drive.marks.T, "^", color=picture.EXACT, ms=9, mfc="white", label="beacon")
    ax.plot(*drive.start[:2], "o", color=picture.EXACT, ms=7)
    ax.set(
        aspect="equal", xlabel="x in m", ylabel="y in m",
        title=f"the first {drive.times[upto][-1]:.0f} s, with 2 sd ellipses",
    )  # fmt: skip
    ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, fontsize=9)


def _draw_bias(ax: Any, drive: Drive, found: dict[str, Any]) -> None:
    for name, belief in found.items():
        mean, spread = belief.mean("bias"), 2 * belief.std("bias")
        ax.fill_between(
            drive.times, mean - spread, mean + spread, color=COLOURS[name], alpha=0.15, lw=0
        )
        label = f"{name}: {mean[-1]:.2f} ± {belief.std('bias')[-1]:.2f} m"
        ax.plot(drive.times, mean, color=COLOURS[name], label=label)
    end = found["extended Kalman, growing"].mean("bias")[-1]
    ax.set(xlim=(0, drive.times[-1]), ylim=(end - 2.0, end + 2.0), xlabel="s", ylabel="m")
    ax.set_title(f"bias of a range of {MIDDLE:.0f} m, with 2 sd")
    ax.legend(frameon=False, loc="lower right", fontsize=9)


def log(fast: bool) -> tuple[str, Drive]:
    """Plaza 1 where the data is, else (or for a smoke test) a generated drive."""
    folder = reference.folder("robot", "plaza")
    if folder is not None and not fast:
        return "Plaza 1", ranges_heard(folder)
    with tempfile.TemporaryDirectory() as made:
        folder = write_plaza(Path(made), 100.0 if fast else 600.0)
        return "a generated drive", ranges_heard(folder)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print errors and biases, and draw them."""
    options = picture.options(__doc__, arguments)
    name, drive = log(options.fast)
    found = beliefs(drive, 500 if options.fast else 4000)
    readings = int((~np.isnan(drive.seen)).sum())
    print(f"Range only: {name}, {drive.times[-1]:.0f} s, {readings} ranges")
    print(f"  {'':28}{'RMSE, m':>8}   bias at {MIDDLE:.0f} m, m    growth, m/m")
    print(f"  {'dead reckoning':28}{drive.rmse(drive.reckoned):8.3f}")
    for engine, belief in found.items():
        told = _summary(drive, [belief])
        print(
            f"  {engine:28}{told['rmse']:8.3f}   {told['bias']:6.2f} +- {told['sd']:.2f}    "
            f"{told['growth']:8.3f}"
        )
    picture.save(draw(drive, found), options.out, "range_only")


if __name__ == "__main__":
    main()
