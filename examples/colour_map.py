"""A robot that paints a map of colours while it does not know where it is: tables carried by particles.

Every cell of a corridor, or of a hall, is light or dark. A robot sweeps it on command, does not always move
when it is told to, and sees the colour of the cell that it is on, sometimes wrongly. Where it is and what the
map is hang together: an exact filter needs a probability for each pair of a place and a map, 2,048 in a
corridor of 8 cells, and 10^21 in a hall of 64. Given the way of the robot the cells have nothing to do with
each other. So particles draw the place, and each carries a table of two numbers for every cell, of which a
reading touches one.

Murphy (2000), Bayesian map learning in dynamic environments, NIPS 12; Doucet, de Freitas, Murphy and Russell
(2000), Rao-Blackwellised particle filtering for dynamic Bayesian networks, UAI 16.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.errors import LowEssWarning
from examples import picture

SLIP, RIGHT = 0.1, 0.9
PARTICLES = 50


class Walk(NamedTuple):
    """What happened: colours of cells, places, readings, and commands (down, right)."""

    color: np.ndarray
    places: np.ndarray
    readings: np.ndarray
    down: np.ndarray
    right: np.ndarray


def moved(place: Any, down: Any, right: Any, height: int, width: int) -> Any:
    """Where a command leads from a cell; walls stop it."""
    row = np.clip(place // width + down, 0, height - 1)
    return row * width + np.clip(place % width + right, 0, width - 1)


def hall(height: int, width: int) -> bmc.DynamicBayesNet:
    """The model; a corridor has one row. Cells keep their colour: they follow from themselves."""
    cells = height * width
    dbn = bmc.DynamicBayesNet("colour map", plates={"cell": cells})
    dbn.input("down")
    dbn.input("right")

    @dbn.node(plates="cell", initial=bmc.Bernoulli(0.5))
    def color(color_prev: Any) -> bmc.Bernoulli:
        return bmc.Bernoulli(color_prev)

    @dbn.node(initial=bmc.Categorical(np.eye(cells)[0]))
    def place(place_prev: Any, down: Any, right: Any) -> bmc.Categorical:
        to = moved(place_prev, down, right, height, width)
        return bmc.Categorical((1 - SLIP) * np.eye(cells)[to] + SLIP * np.eye(cells)[place_prev])

    @dbn.node
    def reading(color: Any, place: Any) -> bmc.Bernoulli:
        return bmc.Bernoulli(np.where(color[place] == 1, RIGHT, 1 - RIGHT))

    return dbn


def sweep(height: int, width: int, steps: int, rng: np.random.Generator) -> Walk:
    """To and fro, row by row, and back."""
    color = rng.integers(0, 2, height * width)
    right, down, heading = np.zeros(steps, dtype=int), np.zeros(steps, dtype=int), 1
    lap = width  # commands for a row, of which the last leads to the next one
    for t in range(1, steps):
        if t % lap:
            right[t] = heading
        else:
            heading = -heading
            down[t] = 1 if (t // lap - 1) % (2 * max(height - 1, 1)) < height - 1 else -1
    at, places, readings = 0, [], []
    for t in range(steps):
        if t and rng.random() > SLIP:
            at = int(moved(at, down[t], right[t], height, width))
        places.append(at)
        readings.append(int(rng.random() < (RIGHT if color[at] else 1 - RIGHT)))
    return Walk(color, np.array(places), np.array(readings), down, right)


def filtered(dbn: bmc.DynamicBayesNet, walk: Walk, engine: Any, seed: int = 0) -> Any:
    """Beliefs after each reading."""
    inputs = {"down": walk.down, "right": walk.right}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)  # plain particles are here to be looked at
        return bmc.filter(dbn, {"reading": walk.readings}, inputs=inputs, engine=engine, rng=seed)


def by_tables(particles: int = PARTICLES) -> bmc.ParticleFilter:
    """Particles that draw the place with a look at the reading, and carry the map."""
    return bmc.ParticleFilter(particles, marginalize=["color"], proposal="optimal")


def shares(found: Any, walk: Walk) -> tuple[float, float]:
    """Mean probability of where the robot was, and of the colours at the end."""
    place = found.probabilities("place")[np.arange(len(walk.places)), walk.places]
    color = found.probabilities("color")[-1][np.arange(len(walk.color)), walk.color]
    return float(place.mean()), float(color.mean())


def corridor(walks: int, steps: int) -> dict[str, np.ndarray]:
    """Engine -> these of several walks along 8 cells, shape (walks, 2)."""
    engines = {
        "exact": bmc.DiscreteFilter(),
        "tables": by_tables(),
        "plain particles": bmc.ParticleFilter(PARTICLES),
    }
    dbn, rng = hall(1, 8), np.random.default_rng(4)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in engines}
    for seed in range(walks):
        walk = sweep(1, 8, steps, rng)
        for name, engine in engines.items():
            found[name].append(shares(filtered(dbn, walk, engine, seed), walk))
    return {name: np.array(own) for name, own in found.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    asked = picture.options(__doc__, arguments)
    walks, steps = (2, 8) if asked.fast else (10, 60)
    found = corridor(walks, steps)
    print(
        f"8 cells, {walks} walks of {steps} readings, {PARTICLES} particles; mean probability of the truth"
    )
    for name, own in found.items():
        place, color = own.mean(axis=0)
        print(f"  {name:16s} place {place:.3f}, map {color:.3f}")
    steps = 64 if asked.fast else 512
    dbn, walk = hall(8, 8), sweep(8, 8, steps, np.random.default_rng(7))
    filtered(dbn, Walk(walk.color, *(part[:3] for part in walk[1:])), by_tables())
    start = time.process_time()
    large = filtered(dbn, walk, by_tables())
    rate = steps / (time.process_time() - start)
    place, color = shares(large, walk)
    print(f"64 cells, {steps} readings: place {place:.3f}, map {color:.3f}")
    if rate < 50:
        print(f"only {rate:.0f} readings a second")  # real time is 50; not printed, as it varies
    draw(asked, found, walk, large)


def draw(asked: Any, found: dict[str, np.ndarray], walk: Walk, large: Any) -> None:
    """The hall, its map after some time, the way, and the corridor's figures."""
    figure, ax = picture.axes([["truth", "half", "map"], ["way", "way", "corridor"]], (10.5, 6.4))
    steps, quarter = len(walk.places), len(walk.places) // 4
    shown = (
        ("truth", walk.color, "the hall"),
        ("half", large.mean("color")[quarter], f"light? after {quarter} readings"),
        ("map", large.mean("color")[-1], f"light? after {steps} readings"),
    )
    for name, values, title in shown:
        ax[name].imshow(np.reshape(values, (8, 8)), cmap="Greys_r", vmin=0, vmax=1)
        ax[name].set(xticks=[], yticks=[])
        ax[name].set_title(title)
    ax["way"].imshow(
        large.probabilities("place").T, aspect="auto", origin="lower", cmap="Blues", vmin=0, vmax=1,
        interpolation="nearest",
    )  # fmt: skip
    ax["way"].plot(walk.places, color=picture.OTHER, lw=0.7, label="where it is")
    ax["way"].set(xlabel="reading", ylabel="cell")
    ax["way"].set_title("probability of each cell, given the readings so far")
    ax["way"].legend(loc="upper right", frameon=False, fontsize=8)
    at = np.arange(2)
    colors = (picture.EXACT, picture.DRAWS, picture.FAINT)
    for k, (name, own) in enumerate(found.items()):
        ax["corridor"].bar(at + 0.27 * (k - 1), own.mean(axis=0), 0.25, color=colors[k], label=name)
    ax["corridor"].set(xticks=at, ylim=(0, 1.25), title=f"8 cells, {PARTICLES} particles")
    ax["corridor"].set_xticklabels(["place", "map"])
    ax["corridor"].set_ylabel("mean probability of the truth")
    ax["corridor"].legend(loc="upper left", frameon=False, fontsize=8)
    picture.save(figure, asked.out, "colour_map")


if __name__ == "__main__":
    main()
