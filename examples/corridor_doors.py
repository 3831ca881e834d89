"""Three doors along a corridor: a belief with several hills that becomes one, on a grid and by particles.

A robot in a straight corridor, anywhere on its first 16 metres, can tell only whether there is a door beside
it, and is right most of the time. The first door says that it stands at one of three; how far it then drives
until the next door says at which. The sensor is a node with two states, ``wall`` and ``door``, whose
probability depends on a position: a discrete child of a continuous parent.

One template, two engines: the grid (a histogram filter, exact but for its cells) and particles. The distance
between them is that of total variation over bins of half a metre: half the sum of absolute differences, 0 for
the same belief and 1 for two that share nothing. Beside it stands what as many independent draws from the
exact belief would have, so whatever is above that is the price of weights and resampling.

Fox, Burgard and Thrun (1999), Markov localization for mobile robots in dynamic environments, JAIR 11, figure
1; Thrun, Burgard and Fox (2005), Probabilistic Robotics, figure 1.2, table 4.1 (grid) and section 8.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

DOORS = (3.0, 6.0, 12.0)  # metres: no two pairs are as far apart
LENGTH = 16.0  # the robot starts within
END = 26.0  # and ends before
RIGHT, WRONG = 0.9, 0.1  # probability of "door" beside one, and beside a wall
WIDTH = 0.4  # metres from the middle of a door, a standard deviation, to where it is seen less well
CELLS = 540  # on -1 to 26: five centimetres, where the narrowest move is eleven wide
BINS = np.arange(-1.0, 26.5, 0.5)
PARTICLES, RUNS = (100, 1_000, 10_000), 100

#: metres driven into each slice, what is seen there, where the robot then is, and what that is called
DRIVEN = (0.0, 1.0, 1.5, 1.5, 2.0, 4.0)
SEEN = (None, "door", None, "door", "wall", "door")
TRUTH = 2.0 + np.cumsum(DRIVEN)
TITLES = (
    "somewhere",
    "1 m on, it sees a door",
    "1.5 m on, without a look",
    "1.5 m on, it sees a door",
    "2 m on, it sees wall",
    "4 m on, it sees a door",
)


def corridor(doors: Sequence[float] = DOORS, runs: int = 1) -> bmc.DynamicBayesNet:
    """The template, with a map of doors, and as many filters of the same robot side by side."""
    dbn = bmc.DynamicBayesNet("corridor", plates={"run": runs})
    dbn.input("u")

    @dbn.node(initial=bmc.Uniform(0.0, LENGTH), plates="run")
    def x(x_prev, u):
        return bmc.Normal(x_prev + u, np.hypot(0.05, 0.1 * u))

    @dbn.node(plates="run", states=("wall", "door"))
    def z(x):
        return bmc.Bernoulli(door_seen(x, doors))

    return dbn


def door_seen(x: Any, doors: Sequence[float] = DOORS) -> np.ndarray:
    """Probability that the sensor says "door" at x."""
    off = (np.asarray(x)[..., None] - np.asarray(doors)) / WIDTH
    return WRONG + (RIGHT - WRONG) * np.exp(-0.5 * off**2).max(axis=-1)


def filtered(dbn: bmc.DynamicBayesNet, engine: Any, keep: str | None = None) -> Any:
    """Beliefs of one engine, all runs having seen the same."""
    runs = dbn.plates["run"] or 1
    seen = [[row] * runs for row in SEEN]
    return bmc.filter(dbn, {"z": seen}, inputs={"u": DRIVEN}, engine=engine, rng=1, keep=keep)


def exact(doors: Sequence[float] = DOORS, cells: int = CELLS) -> Any:
    """The belief on the grid."""
    return filtered(corridor(doors), bmc.GridFilter({"x": (-1.0, END, cells)}))


def by_particles(particles: int, runs: int, doors: Sequence[float] = DOORS) -> Any:
    """The belief of several filters with so many particles each, all of them kept."""
    return filtered(corridor(doors, runs), bmc.ParticleFilter(particles), keep="particles")


def grid_shares(belief: Any) -> np.ndarray:
    """Probability of each bin by the grid, shape (slice, bin)."""
    density = belief.density("x")[:, 0]
    points = belief.grid("x")
    mass = density * (points[1] - points[0])
    return np.stack([np.histogram(points, BINS, weights=row)[0] for row in mass])


def particle_shares(belief: Any) -> np.ndarray:
    """Probability of each bin by particles, shape (slice, bin, run)."""
    found, weights = belief.particles("x"), belief.weights
    return np.stack(
        [
            np.stack([np.histogram(x, BINS, weights=w)[0] for x, w in zip(xs.T, ws.T, strict=True)], 1)
            for xs, ws in zip(found, weights, strict=True)
        ]
    )  # fmt: skip


def distances(shares: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Total variation of every run in every slice from the exact shares, shape (slice, run)."""
    return 0.5 * np.abs(shares - right[..., None]).sum(axis=1)


def of_independent(right: np.ndarray, particles: int) -> np.ndarray:
    """What as many independent draws would have in the mean, of each slice (by the normal approximation)."""
    return np.sqrt(right * (1 - right) / (2 * np.pi * particles)).sum(axis=1)


def report(found: dict[int, np.ndarray], right: np.ndarray, runs: int) -> None:
    """Print distances, beside those of independent draws."""
    print(f"Three doors: total variation between particles and the exact grid, mean of {runs} runs")
    print(f"  {'':26}" + "".join(f"{n:>16,}" for n in found) + "   particles")
    for t, title in enumerate(TITLES):
        cells = [
            f"{distance[t].mean():9.3f} ({of_independent(right, n)[t]:.3f})"
            for n, distance in found.items()
        ]
        print(f"  {title:26}" + "".join(f"{cell:>16}" for cell in cells))
    print("  in brackets: as many independent draws")


def draw(grid: Any, cloud: Any, found: dict[int, np.ndarray], right: np.ndarray) -> Any:
    """A panel for each slice, and distances against the number of particles."""
    mosaic = [[f"{t}", f"{t + 3}"] for t in range(3)] + [["distance", "distance"]]
    figure, panels = picture.axes(mosaic, (13, 10.5), height_ratios=[1, 1, 1, 1.1])
    for t in range(len(SEEN)):
        draw_slice(panels[f"{t}"], grid, cloud, t)
    handles = [h for t in "01" for h in panels[t].get_legend_handles_labels()[0]]
    shown = {h.get_label(): h for h in handles}
    panels["0"].legend(handles=shown.values(), frameon=False, ncols=2, loc="upper left", fontsize=9)
    ax, sizes = panels["distance"], np.array(list(found))
    for t, colour in ((3, picture.OTHER), (5, picture.EXACT)):
        means = [distance[t].mean() for distance in found.values()]
        ax.loglog(sizes, means, "o-", color=colour, label=f"slice {t}, particles of the filter")
        draws = [of_independent(right, n)[t] for n in sizes]
        ax.loglog(sizes, draws, "--", color=colour, label=f"slice {t}, independent draws")
    ax.set(xlabel="particles", ylabel="total variation", title="distance from the exact belief")
    ax.legend(frameon=False, loc="upper right")
    return figure


def draw_slice(ax: Any, grid: Any, cloud: Any, t: int) -> None:
    """Doors, the likelihood of what is seen, the exact belief and the particles' histogram."""
    density = grid.density("x")[t, 0]
    particles, weights = cloud.particles("x")[t, :, 0], cloud.weights[t, :, 0]
    top = max(density.max(), 0.12)
    for door in DOORS:
        ax.axvspan(
            door - 2 * WIDTH, door + 2 * WIDTH, 0, 0.7 if t == 0 else 0.95, color="#f3e3c3", lw=0
        )
    ax.hist(particles, np.arange(-1, END, 0.25), weights=weights, density=True,
            color=picture.DRAWS, label="particles")  # fmt: skip
    ax.plot(grid.grid("x"), density, color=picture.EXACT, label="exact belief")
    if SEEN[t] is not None:
        chance = door_seen(grid.grid("x"))
        likelihood = chance if SEEN[t] == "door" else 1 - chance
        ax.plot(grid.grid("x"), top * (1.1 + 0.35 * likelihood), color=picture.OTHER,
                label="likelihood of what it sees")  # fmt: skip
    ax.plot(TRUTH[t], 0, "^", color=picture.OTHER, ms=9, clip_on=False, zorder=5, label="robot")
    ax.set(title=f"{t}: {TITLES[t]}", xlim=(0, 18), ylim=(0, 1.9 * top), yticks=[])
    if t in (2, 5):
        ax.set_xlabel("position (m); doors shaded")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print distances between particles and grid, and draw both."""
    options = picture.options(__doc__, arguments)
    runs, sizes = (10, PARTICLES[:2]) if options.fast else (RUNS, PARTICLES)
    grid = exact()
    right = grid_shares(grid)
    found = {n: distances(particle_shares(by_particles(n, runs)), right) for n in sizes}
    report(found, right, runs)
    picture.save(draw(grid, by_particles(5_000, 1), found, right), options.out, "corridor_doors")


if __name__ == "__main__":
    main()
