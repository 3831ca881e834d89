"""A Gaussian pushed through a nonlinear function is no Gaussian.

A robot drives past a landmark 1 m beside its track. Where it is along the track is known to a
Gaussian; the bearing to the landmark is a deterministic node of the net. Its exact density comes
from the change of variables, p(bearing) = p(x) |dx / d bearing|. An extended Kalman filter takes
the tangent instead, and with it a Gaussian of another mean and width, some of it at bearings that
cannot be.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

MEAN, SD = 0.6, 0.8  # metres before the landmark
POSITION = bmc.Normal(MEAN, SD)
# The tangent at the mean: d bearing / dx = -1 / (1 + x**2) radians per metre.
SLOPE = -np.degrees(1 / (1 + MEAN**2))
LINEARISED = bmc.Normal(np.degrees(np.arctan2(1.0, MEAN)), SD * abs(SLOPE))
GRID = np.linspace(0.5, 179.5, 1791)  # degrees

net = bmc.BayesNet("bearing")
net.add("x", POSITION)


@net.node
def bearing(x):
    return np.degrees(np.arctan2(1.0, x))


def exact_density(angle: np.ndarray) -> np.ndarray:
    """Per degree: x = 1 / tan(bearing), so that |dx / d bearing| = 1 / sin(bearing)**2."""
    radians = np.radians(angle)
    return np.exp(POSITION.log_prob(1 / np.tan(radians))) / np.sin(radians) ** 2 * np.pi / 180


def draw(samples: np.ndarray) -> Any:
    """The function, with the density of its argument below and that of its value beside it."""
    figure, panels = picture.axes([["value", "function"], [".", "x"]], (9, 6.5),
                                  width_ratios=[1, 1.3], height_ratios=[2, 1])  # fmt: skip
    x, angle = np.linspace(-2.5, 3.7, 400), np.linspace(-45, 180, 451)
    function, value = panels["function"], panels["value"]
    function.plot(x, bearing(x), color=picture.EXACT, label="bearing = atan2(1 m, x)")
    function.plot(x, LINEARISED.mean + SLOPE * (x - MEAN), "--", color=picture.OTHER,
                  label="tangent at the mean")  # fmt: skip
    panels["x"].fill_between(x, np.exp(POSITION.log_prob(x)), color=picture.DRAWS)
    panels["x"].set(xlabel="x, metres before the landmark", ylabel="density, per metre", ylim=0)
    value.hist(samples, 90, range=(0, 180), density=True, orientation="horizontal",
               color=picture.DRAWS, label="samples")  # fmt: skip
    value.plot(exact_density(GRID), GRID, color=picture.EXACT, label="exact density")
    value.plot(np.exp(LINEARISED.log_prob(angle)), angle, "--", color=picture.OTHER,
               label="linearised")  # fmt: skip
    value.set(xlabel="density, per degree", xlim=(0.018, 0), xticks=[0.015, 0.01, 0.005, 0])
    for ax in (value, function):
        ax.set(ylabel="bearing, degrees", ylim=(-45, 180), yticks=range(-45, 181, 45))
        ax.legend(frameon=False, loc="upper left" if ax is value else "upper right")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print mean, standard deviation and what lies below 20 degrees three ways, and draw."""
    options = picture.options(__doc__, arguments)
    samples = net.sample(5_000 if options.fast else 200_000, rng=1)["bearing"]
    mean = np.trapezoid(GRID * exact_density(GRID), GRID)
    sd = np.sqrt(np.trapezoid((GRID - mean) ** 2 * exact_density(GRID), GRID))
    below = 1 - POSITION.cdf(1 / np.tan(np.radians(20.0)))
    print("Pushforward: bearing to the landmark, in degrees")
    for name, *row in (
        ("exact", mean, sd, below),
        ("samples", samples.mean(), samples.std(), np.mean(samples < 20)),
        ("linearised", LINEARISED.mean, LINEARISED.scale, LINEARISED.cdf(20.0)),
    ):
        print("  {:10}  mean {:6.2f}  sd {:5.2f}  P(< 20) {:.4f}".format(name, *map(float, row)))
    picture.save(draw(samples), options.out, "pushforward")


if __name__ == "__main__":
    main()
