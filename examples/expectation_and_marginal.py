"""Expectations and marginals from samples.

From samples of a joint density any expectation is an average, and a marginal is what is left when
the other components are dropped: no integral is done. Two nodes make a banana-shaped joint; their
distance from the origin has no closed form, and its running mean closes in on the value that sums
on a grid give, at the rate that its standard error promises.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

net = bmc.BayesNet("banana")
net.add("x", bmc.Normal(0.0, 1.0))


@net.node
def y(x):
    return bmc.Normal(0.7 * x**2 - 0.5, 0.6)


def distance(x, y):
    return np.sqrt(x**2 + y**2)


X, Y = np.linspace(-6.0, 6.0, 601), np.linspace(-4.0, 28.0, 1601)
# The joint density on a grid, and from it what the samples are compared with.
JOINT = np.exp(net.log_prob({"x": X[:, None], "y": Y}))
MARGINAL_X, MARGINAL_Y = np.trapezoid(JOINT, Y, axis=1), np.trapezoid(JOINT, X, axis=0)
EXACT = float(np.trapezoid(np.trapezoid(distance(X[:, None], Y) * JOINT, Y, axis=1), X))


def running_mean(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the first 1, 2, 3, ... values, and its standard error."""
    count = np.arange(1, len(values) + 1)
    mean = np.cumsum(values) / count
    variance = np.cumsum(values**2) / count - mean**2
    return mean, np.sqrt(np.maximum(variance, 0) / np.maximum(count - 1, 1))


def draw(samples: dict[str, np.ndarray]) -> Any:
    """The samples with both marginals, and the running mean of the distance."""
    figure, panels = picture.axes([["x", "."], ["joint", "y"], ["mean", "mean"]], (8, 9.5),
                                  width_ratios=[3, 1], height_ratios=[1, 3, 2])  # fmt: skip
    top, joint, side, bottom = (panels[name] for name in ("x", "joint", "y", "mean"))
    x, y, color = samples["x"], samples["y"], picture.DRAWS
    joint.contour(X, Y, JOINT.T, 6, colors=picture.EXACT, linewidths=0.8)
    joint.plot(x[:2000], y[:2000], ".", ms=2.5, color=color, zorder=0)
    joint.set(xlabel="x", ylabel="y", xlim=(-3.5, 3.5), ylim=(-2.5, 7.5))
    top.hist(x, 70, range=(-3.5, 3.5), density=True, color=color, label="samples")
    top.plot(X, MARGINAL_X, color=picture.EXACT, label="exact")
    top.set(xlim=(-3.5, 3.5), ylabel="p(x)", xticklabels=[])
    top.legend(frameon=False)
    side.hist(y, 70, range=(-2.5, 7.5), density=True, color=color, orientation="horizontal")
    side.plot(MARGINAL_Y, Y, color=picture.EXACT)
    side.set(ylim=(-2.5, 7.5), xlabel="p(y)", yticklabels=[])
    mean, error = running_mean(distance(x, y))
    n = np.unique(np.geomspace(10, len(mean), 2000).astype(int))
    mean, error = mean[n - 1], error[n - 1]
    bottom.fill_between(n, mean - 2 * error, mean + 2 * error, color=color, lw=0,
                        label="two standard errors to each side")  # fmt: skip
    bottom.plot(n, mean, color=picture.EXACT, lw=1, label="running mean")
    bottom.axhline(EXACT, color=picture.OTHER, ls="--", label=f"sum on a grid, {EXACT:.4f}")
    bottom.set(xscale="log", xlim=(10, n[-1]), ylim=(EXACT - 0.5, EXACT + 0.5),
               xlabel="number of samples", ylabel="mean distance from the origin")  # fmt: skip
    bottom.legend(frameon=False, loc="upper right")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the mean distance for growing numbers of samples, and draw."""
    options = picture.options(__doc__, arguments)
    samples = net.sample(10_000 if options.fast else 100_000, rng=4)
    mean, error = running_mean(distance(samples["x"], samples["y"]))
    print(f"Expectation and marginal: mean distance from the origin; on a grid {EXACT:.4f}")
    for n in [10**k for k in range(2, 6) if 10**k <= len(mean)]:
        print(f"  {n:7,} samples: {mean[n - 1]:.4f} +- {error[n - 1]:.4f}")
    picture.save(draw(samples), options.out, "expectation_and_marginal")


if __name__ == "__main__":
    main()
