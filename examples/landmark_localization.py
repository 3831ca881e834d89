"""Landmark localisation: a robot among fifteen known landmarks, by particles and an extended Kalman filter.

A camera on the robot reads range and bearing of landmarks that wear barcodes; in between, the wheels tell how
far it went and turned. The template below is declared once and filtered twice. Three things about these logs
are in it:

- The wheels are wrong by some per cent, for minutes, in length and in turn. Their two *gains* are nodes that
  wander around one, and are estimated with the pose.
- The error of a range stays nearly the same from reading to reading. A density takes readings for
  independent, so its scale is wider than that of one error (0.4 m, where single ones are 0.1 to 0.2 m off).
- One bearing in a hundred is of something else. Particles are weighted by the mixture as it stands; the
  extended Kalman filter takes its circular variance, a Gaussian wide enough for the strays.

The picture shows the map, both errors over time (grey where no landmark was in view: nothing but the wheels),
and what becomes of the gains. Filters are told the first true pose and the landmarks, and no more of the
truth; the scales of noise, one set for all five robots, were chosen by hand on these logs.

Where the reference data is at hand, the log is of the UTIAS MRCLAM set 6 (Leung, Halpern, Barfoot
and Liu 2011, International Journal of Robotics Research 30), else a generated one in the same files, which is
read by the same reader. Thrun, Burgard and Fox (2005), Probabilistic Robotics, chapters 7 and 8.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import PoseNormal, compose, range_and_bearing
from examples import picture, reference
from examples.robot_landmarks import Drive, ellipse, marks_seen, write_mrclam

SPREAD, LASTING = 0.07, 200.0  # of the gains: standard deviation, and seconds until they are others
PER_METRE, PER_RADIAN, PER_SECOND = 5e-4, 5e-3, 1e-5  # variances that build up, in m^2 and rad^2
RANGE, BEARING, STRAY = 0.4, 0.1, 0.01  # m, rad, and the share of bearings of something else
PARTICLES = 1000


def robot(drive: Drive) -> bmc.DynamicBayesNet:
    """Gains of the wheels, the pose, and what is seen of each landmark."""
    dbn = bmc.DynamicBayesNet("robot", plates={"landmark": len(drive.marks)})
    dbn.input("motion", event_shape=(3,))
    dbn.input("effort", event_shape=(3,))  # metres, radians, seconds since the slice before

    @dbn.node(initial=bmc.MvNormal([1.0, 1.0], scale_diag=[SPREAD, SPREAD]))
    def gain(gain_prev, effort):
        kept = np.exp(-effort[..., 2:] / LASTING)
        scale = SPREAD * np.sqrt(1 - kept**2 + 1e-9)  # some noise also where no time passes
        return bmc.MvNormal(1 + kept * (gain_prev - 1), scale_diag=scale * np.ones(2))

    @dbn.node(initial=PoseNormal(drive.start, scale_diag=[0.01, 0.01, 0.01]))
    def pose(pose_prev, gain, motion, effort):
        metres, radians, seconds = effort[..., 0], effort[..., 1], effort[..., 2]
        place = np.sqrt(PER_METRE * metres + 1e-8)
        heading = np.sqrt(PER_RADIAN * radians + PER_SECOND * seconds + 1e-8)
        driven = motion * gain[..., [0, 0, 1]]
        scale = np.stack([place, place, heading], axis=-1)
        return PoseNormal(compose(pose_prev, driven), scale_diag=scale)

    @dbn.node(plates="landmark")
    def seen(pose):
        return range_and_bearing(pose, drive.marks, RANGE, BEARING, outlier=STRAY)

    return dbn


def filtered(drive: Drive, engine: Any, seed: int = 0, keep: str | None = None) -> Any:
    """Beliefs slice by slice, of any engine over time."""
    inputs = {"motion": drive.motion, "effort": drive.effort}
    rows = {"seen": drive.seen}
    return bmc.filter(robot(drive), rows, inputs=inputs, engine=engine, rng=seed, keep=keep)


def figures(
    folder: Path,
    robots: Iterable[int] = (1, 2, 3, 4, 5),
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    particles: int = PARTICLES,
) -> dict[int, dict[str, float]]:
    """Errors in m of the robots of an MRCLAM folder, root mean squares over time (`Drive.rmse`).

    Of particles it is the mean over the seeds. ``reference`` is what a small extended Kalman filter
    with a gate reached on the same log, where the folder says so.
    """
    noted = folder / "mrclam6.ref.json"
    results = json.loads(noted.read_text())["results"] if noted.is_file() else {}
    found = {}
    for k in robots:
        drive = marks_seen(folder, k)
        by_seed = [
            drive.rmse(filtered(drive, bmc.ParticleFilter(particles), seed).mean("pose"))
            for seed in seeds
        ]
        found[k] = {
            "dead reckoning": drive.rmse(drive.reckoned),
            "extended Kalman": drive.rmse(filtered(drive, bmc.ExtendedKalmanFilter()).mean("pose")),
            "particles": float(np.mean(by_seed)) if by_seed else np.nan,
            "reference": results.get(f"mrclam6_robot{k}", {}).get("EKF_rmse_m", np.nan),
        }
    return found


def beliefs(drive: Drive, particles: int) -> dict[str, Any]:
    """What both engines say; particles are held for their covariances."""
    return {
        "extended Kalman": filtered(drive, bmc.ExtendedKalmanFilter()),
        "particles": filtered(drive, bmc.ParticleFilter(particles), keep="particles"),
    }


COLOURS = {"extended Kalman": "#2a78b5", "particles": picture.OTHER}


def draw(drive: Drive, found: dict[str, Any]) -> Any:
    """Map with paths and ellipses; errors over time; the gains."""
    layout = [["map", "error"], ["map", "gain"]]
    figure, panels = picture.axes(layout, (14, 7.6), width_ratios=[1.15, 1])
    _draw_map(panels["map"], drive, found)
    _draw_errors(panels["error"], drive, found)
    _draw_gains(panels["gain"], drive, found)
    return figure


def _draw_map(ax: Any, drive: Drive, found: dict[str, Any]) -> None:
    """The first minutes, with two-sigma ellipses every so often: a whole drive covers itself."""
    upto = drive.times <= min(150.0, drive.times[-1])
    ax.plot(*drive.truth[upto, :2].T, color=picture.EXACT, lw=2.2, label="truth")
    reckoned = drive.reckoned[upto]
    ax.plot(*reckoned[:, :2].T, ":", color=picture.FAINT, lw=1.6, label="dead reckoning")
    at = np.searchsorted(drive.times, np.linspace(8.0, drive.times[upto][-1], 9))
    for name, belief in found.items():
        mean = belief.mean("pose")
        ax.plot(*mean[upto, :2].T, color=COLOURS[name], lw=1.1, label=name)
        for k in np.minimum(at, len(mean) - 1):
            ax.plot(*ellipse(mean[k, :2], belief.cov("pose")[k, :2, :2]), color=COLOURS[name], lw=1)
    ax.plot(*drive.marks.T, "^", color=picture.EXACT, ms=8, mfc="white", label="landmark")
    ax.plot(*drive.start[:2], "o", color=picture.EXACT, ms=7)
    ax.set(
        aspect="equal", xlabel="x in m", ylabel="y in m",
        title=f"the first {drive.times[upto][-1]:.0f} s, with 2 sd ellipses",
    )  # fmt: skip
    ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=5, fontsize=9)


def _draw_errors(ax: Any, drive: Drive, found: dict[str, Any]) -> None:
    for low, high in _unseen(drive):
        ax.axvspan(low, high, color="0.9", lw=0)
    for name, belief in found.items():
        mean = belief.mean("pose")
        label = f"{name}: {drive.rmse(mean):.2f} m"
        ax.plot(drive.times, drive.error(mean), color=COLOURS[name], lw=1, label=label)
    wheels = drive.error(drive.reckoned)
    label = f"dead reckoning: {drive.rmse(drive.reckoned):.2f} m"
    ax.plot(drive.times, wheels, ":", color=picture.FAINT, lw=1.6, label=label)
    ax.set(yscale="log", ylim=(0.01, None), xlim=(0, drive.times[-1]), ylabel="m")
    ax.set_title("distance from the truth (grey: no landmark in view for 5 s)")
    ax.set_ylim(top=12 * max(1.0, float(np.nanmax(wheels))))
    ax.legend(frameon=False, loc="upper center", ncols=3, fontsize=9)


def _draw_gains(ax: Any, drive: Drive, found: dict[str, Any]) -> None:
    kalman = found["extended Kalman"]
    for k, (name, colour) in enumerate((("length", picture.EXACT), ("turn", picture.OTHER))):
        mean, spread = kalman.mean("gain")[:, k], 2 * kalman.std("gain")[:, k]
        ax.fill_between(drive.times, mean - spread, mean + spread, color=colour, alpha=0.13, lw=0)
        ax.plot(drive.times, mean, color=colour, label=f"{name}, extended Kalman")
        cloud = found["particles"].mean("gain")[:, k]
        ax.plot(drive.times, cloud, "--", color=colour, lw=1, label=f"{name}, particles")
    ax.axhline(1.0, color=picture.FAINT, lw=0.8)
    ax.set(xlim=(0, drive.times[-1]), ylim=(0.72, 1.28), xlabel="s")
    ax.set_title("gains of the wheels, with 2 sd: true motion over what they say")
    ax.legend(frameon=False, loc="upper center", ncols=2, fontsize=9)


def _unseen(drive: Drive, least: float = 5.0) -> list[tuple[float, float]]:
    """When no landmark was in view for so many seconds."""
    at = drive.times[~np.isnan(drive.seen[..., 0]).all(axis=1)]
    edges = np.concatenate([[0.0], at, drive.times[-1:]])
    return [(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a > least]


def log(fast: bool) -> tuple[str, Drive]:
    """A robot of MRCLAM 6 where the data is, else (or for a smoke test) a generated one."""
    folder = reference.folder("robot", "mrclam6")
    if folder is not None and not fast:
        return "MRCLAM 6, robot 1", marks_seen(folder, 1)
    with tempfile.TemporaryDirectory() as made:
        return "a generated robot", marks_seen(write_mrclam(Path(made), 60.0 if fast else 300.0), 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print errors of both filters, and draw them."""
    options = picture.options(__doc__, arguments)
    name, drive = log(options.fast)
    found = beliefs(drive, 200 if options.fast else 500)
    readings = int((~np.isnan(drive.seen[..., 0])).sum())
    print(f"Landmark localisation: {name}, {drive.times[-1]:.0f} s, {readings} readings")
    print(f"  {'':18}{'RMSE, m':>8}   gains at the end")
    print(f"  {'dead reckoning':18}{drive.rmse(drive.reckoned):8.3f}")
    for engine, belief in found.items():
        length, turn = belief.mean("gain")[-1]
        print(f"  {engine:18}{drive.rmse(belief.mean('pose')):8.3f}   {length:.3f}, {turn:.3f}")
    picture.save(draw(drive, found), options.out, "landmark_localization")


if __name__ == "__main__":
    main()
