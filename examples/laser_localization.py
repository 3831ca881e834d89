"""A robot that is put down anywhere on a map and finds out where, with a laser: Monte Carlo localization.

The belief starts as particles spread evenly over all free space and all headings, and each scan leaves
those from where the walls would look like that. In an office many places look alike, so that for some scans
there are several clouds, and a mean of them is nowhere; then what the robot sees on its way decides. As
many particles are kept as the belief needs: twenty thousand at first, a thousand when one cloud is left
(KLD sampling).

The filter is the library's, and the net two nodes (``robot_logs.model``). The floor is made up and read
from the files that a robot would have (``robot_world``); where the reference data is there, the Intel
Research Lab follows, with the same functions. Slices are taken one by one, as on a robot, so that memory
holds one slice and not all.

The animation is a GIF of the made-up floor: the particles over time, with a robot at the true pose. It is
left out by ``--fast``.

Dellaert, Fox, Burgard and Thrun (1999), Monte Carlo localization for mobile robots, ICRA; Fox (2003),
Adapting the sample size in particle filters through KLD-sampling, IJRR 22.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from examples import picture, reference, robot_logs
from examples.robot_logs import Log

SEED, PARTICLES, LEAST = 1, 20_000, 1_000
SHOWN = (0, 10, 65)  # scans after which the particles are drawn
FRAMES, DOTS = 60, 2_000  # of the animation, and particles in each
QUICK = 80  # scans with --fast


class Run(NamedTuple):
    """What is kept of a filter that went through a log.

    Attributes
    ----------
    mean : ndarray, shape (time, 3)
    spread : ndarray, shape (time,)
        Standard deviation of the position in m.
    counts : ndarray of int, shape (time,)
        Particles.
    clouds : dict of int to ndarray, shape (dots, 3)
        Some of the particles of some slices.
    start : ndarray, shape (dots, 3)
        Of slice 0 before its scan has weighted them.
    """

    mean: np.ndarray
    spread: np.ndarray
    counts: np.ndarray
    clouds: dict[int, np.ndarray]
    start: np.ndarray


def run(dbn: bmc.DynamicBayesNet, log: Log, engine: Any, rng: int, slices: Sequence[int]) -> Run:
    """Filter slice by slice, with the particles of some slices put aside."""
    means, spreads, counts, clouds, start = [], [], [], {}, np.empty((0, 3))
    pick = np.random.default_rng(rng)
    for belief in robot_logs.beliefs(dbn, log, engine, rng):
        poses, weights = belief.particles("pose"), belief.weights
        means.append(belief.mean("pose"))
        spreads.append(np.sqrt(belief.var("pose")[:2].sum()))
        counts.append(len(weights))
        if belief.t == 0:
            start = poses[:DOTS]
        if belief.t in slices:  # by their weights, so that every dot counts the same
            clouds[belief.t] = poses[pick.choice(len(poses), DOTS, p=weights)]
    return Run(np.array(means), np.array(spreads), np.array(counts), clouds, start)


def located(log: Log, particles: int = PARTICLES, rng: int = SEED) -> Run:
    """Global localisation of a log from a laser, for the pictures."""
    dbn = robot_logs.model(log, log.floor, log.caution)
    return run(dbn, log, robot_logs.adaptive(particles, LEAST), rng, frames(log))


def frames(log: Log) -> np.ndarray:
    """Slices of the animation: all of the first, which are the interesting ones, then every so many."""
    first = min(FRAMES // 2, len(log.scans))
    later = np.linspace(first, len(log.scans) - 1, FRAMES - first).round().astype(int)
    return np.unique(np.concatenate([np.arange(first), later, SHOWN]))


def draw(log: Log, found: Run) -> Any:
    """Particles at three times, the paths, and error and number of particles over time."""
    clouds = [f"after {t}" for t in SHOWN]
    wide = np.ptp(log.grid.extent[:2]) > 1.3 * np.ptp(log.grid.extent[2:])
    size = (13.5, 9.2) if wide else (13.5, 11.5)
    figure, panels = picture.axes(
        [clouds, ["paths", "paths", "error"], ["paths", "paths", "count"]], size
    )
    for t, name in zip(SHOWN, clouds, strict=True):
        ax = panels[name]
        robot_logs.draw_map(ax, log)
        poses = found.clouds[t] if t else found.start
        robot_logs.draw_cloud(ax, poses, None if log.truth is None else log.truth[t])
        ax.set_title(f"after {t} scans" if t else "particles at the start")
    ax = panels["paths"]
    robot_logs.draw_map(ax, log)
    robot_logs.draw_paths(ax, log, settled(found))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, frameon=False)
    ax.set_title(f"{log.name}: the way, from where one cloud is left")
    draw_error(panels["error"], log, found)
    ax = panels["count"]
    ax.semilogy(found.counts, color=picture.DRAWS, lw=2)
    ax.set(xlabel="scans", ylabel="particles", title="as many as the belief needs")
    return figure


def settled(found: Run) -> np.ndarray:
    """The estimate, but for slices whose particles are in several places."""
    return np.where(found.spread[:, None] < 1.0, found.mean, np.nan)


def draw_error(ax: Any, log: Log, found: Run) -> None:
    """Error of the mean beside what the particles' spread claims."""
    ax.semilogy(found.spread, color=picture.FAINT, label="spread of the particles")
    ax.semilogy(robot_logs.errors(log, found.mean), color=picture.EXACT, label="error of the mean")
    for t in SHOWN[1:]:
        ax.axvline(t, color=picture.OTHER, lw=0.8, ls=":")
    ax.plot([], [], color=picture.OTHER, lw=0.8, ls=":", label="the maps above")
    ax.set(ylabel="m", title="error")
    ax.legend(frameon=False, fontsize=9)


def animate(log: Log, found: Run, path: Path) -> None:
    """Write the particles over time as a GIF."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    plt = picture.pyplot()
    figure, ax = plt.subplots(figsize=(6.4, 4.6), layout="constrained")
    robot_logs.draw_map(ax, log)
    dots = ax.scatter([], [], s=3, color=picture.DRAWS, lw=0, zorder=2)
    (disc,) = ax.plot([], [], "o", color=picture.OTHER, ms=7, mec="white", zorder=4)
    (nose,) = ax.plot([], [], color=picture.OTHER, lw=2, zorder=3)
    title = ax.set_title(" ")

    def show(t: int) -> tuple[Any, ...]:
        dots.set_offsets(found.clouds[t][:, :2])
        if log.truth is not None:
            x, y, heading = log.truth[t]
            disc.set_data([x], [y])
            nose.set_data([x, x + 1.4 * np.cos(heading)], [y, y + 1.4 * np.sin(heading)])
        title.set_text(f"{log.name}: {t} scans, {found.counts[t]:,} particles")
        return dots, disc, nose, title

    moving = FuncAnimation(figure, show, frames=sorted(found.clouds))
    path.parent.mkdir(parents=True, exist_ok=True)
    moving.save(path, PillowWriter(fps=6), dpi=80)
    plt.close(figure)
    print(f"wrote {path}")


def report(log: Log, found: Run) -> None:
    """Print what it came to."""
    error, wheels = robot_logs.errors(log, found.mean), robot_logs.errors(log, log.dead_reckoning)
    found_at = robot_logs.recovery_time(error, 0)
    half = len(error) // 2
    print(
        f"{log.name}: {len(error)} scans of {len(log.angles)} beams, {found.counts[0]:,} particles"
    )
    when = "never" if found_at is None else f"after {found_at} scans"
    print(f"  error below {robot_logs.FOUND:g} m and kept there: {when}")
    print(f"  median error over the second half: {np.median(error[half:]):.3f} m")
    print(f"  by its wheels alone, from the true start: {np.median(wheels[half:]):.1f} m")
    print(f"  particles at the end: {found.counts[-1]:,}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Localise on the made-up floor, and in the Intel Research Lab where its log is at hand."""
    options = picture.options(__doc__, arguments)
    data = reference.folder()
    logs = {"laser_localization": robot_logs.generated()}
    if data is not None and not options.fast:
        logs["laser_localization_intel"] = robot_logs.intel(data)
    named = ", ".join(log.name for log in logs.values())
    left_out = "" if len(logs) == 2 else "; the Intel log "
    if left_out:
        left_out += "is left out by --fast" if data is not None else "is not at hand"
    print(f"Global localisation with a laser on: {named}{left_out}")
    for name, whole in logs.items():
        log = robot_logs.first(whole, QUICK) if options.fast else whole
        found = located(log)
        report(log, found)
        picture.save(draw(log, found), options.out, name)
        if name == "laser_localization" and not options.fast:
            animate(log, found, options.out / f"{name}.gif")


if __name__ == "__main__":
    main()
