"""The ceiling robot: one number per second, the brightness overhead, keeps a robot on its map.

A robot drives through a museum of 60 by 40 metres and looks up with a camera that is reduced to a single
pixel. Its map is a mosaic of the ceiling: rows of lights, some of them missing and some mounted crosswise, so
that no two places have the same surroundings. One brightness says little. Its likelihood, as a function of
the place, is a picture of all lights, of all their rims, or of all that is dark; no Gaussian resembles that.
But the robot moves, and a cloud of particles that was a banana without the sensor shrinks each time a light
passes overhead, or fails to. It is a weak sensor all the same: now and then a cloud follows the wrong lights.

The first picture is the mosaic with the three likelihoods; the second one drive: particles with the sensor
over those by motion alone, and the truth. The table is the error over several drives of the same commands.

The mosaic is made up; the paper's was stitched from 250 images of the Smithsonian's National Museum of
American History.

Dellaert, Burgard, Fox and Thrun (1999), Using the condensation algorithm for robust, vision-based mobile
robot localization, CVPR; Dellaert, Monte Carlo Inference (lecture notes), figures 4, 7 and 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc import robotics
from examples import picture

WIDE, DEEP, CELL = 60.0, 40.0, 0.1  # metres
BRIGHT, EDGE, DARK = 0.95, 0.6, 0.22  # of a light, at its rim, and of the ceiling
LIGHT = (2.2, 1.0)  # metres
RIM = 0.4  # metres over which a light's brightness falls off
SPREAD = 0.08  # standard deviation of a reading
ALPHAS = np.array([0.01, 0.0, 0.001, 0.01, 0.0, 0.0])  # see ``VelocityMotion``
START = robotics.PoseNormal([8.0, 7.5, 0.0], scale_diag=[0.5, 0.5, 0.05])
PARTICLES, RUNS = 2_000, 20
SHOWN = (0, 20, 45, 70, 95, 117)

#: forward velocity (m/s) and turn to the left (rad/s), a row for each second; the first row is not driven
AHEAD, LEFT, RIGHT = (1.0, 0.0), (1.0, np.pi / 16), (1.0, -np.pi / 16)
DRIVEN = np.array(
    [AHEAD] * 38 + [LEFT] * 16 + [AHEAD] * 24 + [RIGHT] * 16 + [AHEAD] * 24, dtype=float
)


def ceiling(seed: int = 5) -> robotics.Ceiling:
    """A mosaic of rows of lights, of which a quarter is missing and a quarter mounted crosswise."""
    rng = np.random.default_rng(seed)
    x = np.arange(CELL / 2, WIDE, CELL)[:, None]
    y = np.arange(CELL / 2, DEEP, CELL)
    # panels of the ceiling differ a little in their grey, and no picture is without noise
    grey = rng.normal(0.0, 0.02, (60, 40)).repeat(10, axis=0).repeat(10, axis=1)
    image = DARK + grey + rng.normal(0.0, 0.01, grey.shape)
    for row in np.arange(2.5, DEEP, 5.0):
        for column in np.arange(3.0, WIDE, 4.5):
            kind, (dx, dy) = rng.random(), rng.normal(0.0, 0.25, 2)
            if kind < 0.25:
                continue
            length, width = LIGHT[::-1] if kind < 0.5 else LIGHT
            beyond = np.maximum(
                np.abs(x - column - dx) - length / 2, np.abs(y - row - dy) - width / 2
            )
            lit = np.clip(0.5 - beyond / RIM, 0.0, 1.0)
            image += lit * (BRIGHT - image)
    return robotics.Ceiling(np.clip(image, 0.0, 1.0), CELL)


def robot(above: robotics.Ceiling, runs: int = 1) -> bmc.DynamicBayesNet:
    """The template, of as many drives side by side."""
    dbn = bmc.DynamicBayesNet("ceiling robot", plates={"run": runs})
    dbn.input("u", event_shape=(2,))

    @dbn.node(initial=START, plates="run")
    def pose(pose_prev, u):
        return robotics.VelocityMotion(pose_prev, u[..., 0], u[..., 1], 1.0, ALPHAS)

    @dbn.node(plates="run")
    def z(pose):
        return above.given(pose, SPREAD)

    return dbn


def simulated(dbn: bmc.DynamicBayesNet, seed: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """True poses, shape (slice, run, 3), and readings, shape (slice, run)."""
    drawn = dbn.sample(len(DRIVEN), inputs={"u": DRIVEN}, rng=seed)
    return drawn["pose"][0], drawn["z"][0]


def beliefs(
    dbn: bmc.DynamicBayesNet, z: np.ndarray, particles: int, keep: str | None = None
) -> dict[str, Any]:
    """By motion alone, where every reading is missing, and with the sensor."""
    rows = {"motion alone": np.full_like(z, np.nan), "with the sensor": z}
    engine = bmc.ParticleFilter(particles)
    return {
        name: bmc.filter(dbn, {"z": seen}, inputs={"u": DRIVEN}, engine=engine, rng=2, keep=keep)
        for name, seen in rows.items()
    }


def errors(
    above: robotics.Ceiling, runs: int = RUNS, particles: int = PARTICLES
) -> dict[str, np.ndarray]:
    """Distance of the mean from the truth, shape (slice, run)."""
    dbn = robot(above, runs)
    truth, z = simulated(dbn)
    found = beliefs(dbn, z, particles)
    return {
        name: robotics.pose_errors(belief.mean("pose"), truth)[0] for name, belief in found.items()
    }


def report(found: dict[str, np.ndarray], particles: int) -> None:
    """Print errors over time, and of whole drives."""
    runs = next(iter(found.values())).shape[1]
    print(
        f"Ceiling robot: error of the mean position in metres, {runs} drives, {particles:,} particles"
    )
    print(f"  {'':16}" + "".join(f"{f'{t} s':>8}" for t in SHOWN) + "    RMSE of a drive")
    for name, off in found.items():
        drive = np.sqrt((off**2).mean(axis=0))
        spread = drive.std(ddof=1) / np.sqrt(runs)
        cells = "".join(f"{off[t].mean():8.2f}" for t in SHOWN)
        print(f"  {name:16}{cells}    {drive.mean():5.2f} +- {spread:.2f}")
    less = found["with the sensor"] < found["motion alone"]
    better = (found["with the sensor"][-1] < found["motion alone"][-1]).sum()
    print(
        f"  the sensor is nearer in {less.mean():.0%} of all seconds, and at the end of {better} drives"
    )


def draw_map(above: robotics.Ceiling) -> Any:
    """The mosaic, and what a bright, a middling and a dark reading say of the place."""
    figure, panels = picture.axes([["mosaic"] * 3, ["bright", "edge", "dark"]], (12, 10.4),
                                  height_ratios=[2.2, 1])  # fmt: skip
    ax = panels["mosaic"]
    show(ax, above.image, above, "gray", vmin=0.0, vmax=1.0)
    path = commanded()
    ax.plot(*path[:, :2].T, "--", color=picture.OTHER, lw=1.5)
    ax.set_title("brightness of the ceiling, and the drive as commanded")
    for name, reading in (("bright", BRIGHT), ("edge", EDGE), ("dark", DARK)):
        show(panels[name], above.likelihood_image(reading, SPREAD), above, "Blues")
        panels[name].set_title(f"likelihood of {reading:.2f}: {name}")
    return figure


def draw_drive(above: robotics.Ceiling, particles: int) -> Any:
    """Six moments of one drive."""
    dbn = robot(above)
    truth, z = simulated(dbn, seed=11)  # a drive that stays on the mosaic
    found = beliefs(dbn, z, particles, keep="particles")
    rows = [[f"{t}" for t in SHOWN[:3]], [f"{t}" for t in SHOWN[3:]]]
    figure, panels = picture.axes(rows, (15, 7.6), sharex=True, sharey=True)
    colours = {"motion alone": picture.DRAWS, "with the sensor": "#ff5d5d"}
    rng = np.random.default_rng(0)
    for t in SHOWN:
        ax = panels[f"{t}"]
        show(ax, above.image, above, "gray", vmin=0.0, vmax=1.6)
        for name, belief in found.items():
            drawn = rng.choice(particles, min(particles, 1_500), p=belief.weights[t, :, 0])
            places = belief.particles("pose")[t, drawn, 0, :2]
            ax.plot(*places.T, ".", color=colours[name], ms=1.8, alpha=0.6, rasterized=True)
            ax.plot([], [], "o", color=colours[name], label=name)
        ax.plot(*truth[: t + 1, 0, :2].T, color="#ffe14d", lw=1)
        ax.plot(*truth[t, 0, :2], "*", color="#ffe14d", mec=picture.EXACT, ms=10, label="robot")
        off = robotics.pose_errors(found["with the sensor"].mean("pose")[t, 0], truth[t, 0])[0]
        ax.set_title(f"{t} s: off by {off:.2f} m with the sensor")
    panels[f"{SHOWN[0]}"].legend(loc="upper right", framealpha=0.9, fontsize=9)
    return figure


def commanded() -> np.ndarray:
    """The drive without noise, shape (slice, 3)."""
    poses = [START.mean]
    for v, turn in DRIVEN[1:]:
        poses.append(robotics.unicycle(poses[-1], v, turn, 1.0))
    return np.stack(poses)


def show(ax: Any, image: np.ndarray, above: robotics.Ceiling, cmap: str, **limits: float) -> None:
    """An image over the map's metres."""
    ax.imshow(image.T, origin="lower", extent=above.extent, cmap=cmap, **limits)
    ax.set(xlim=(0, WIDE), ylim=(0, DEEP), xlabel="x (m)", ylabel="y (m)")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print errors with and without the sensor; draw the map, the likelihoods and one drive."""
    options = picture.options(__doc__, arguments)
    runs, particles = (2, 250) if options.fast else (RUNS, PARTICLES)
    above = ceiling()
    report(errors(above, runs, particles), particles)
    picture.save(draw_map(above), options.out, "ceiling_map")
    picture.save(draw_drive(above, particles), options.out, "ceiling_robot")


if __name__ == "__main__":
    main()
