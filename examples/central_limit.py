"""Sums of uniforms become Gaussian.

The net has a plate of uniform terms and one deterministic node that sums over the whole plate. The
sum of n terms has mean n/2 and variance n/12; scaled to mean 0 and variance 1, its density is made
of polynomials of degree n - 1 (Irwin 1927; Hall 1927), and with four terms it is hard to tell from
the bell curve. The difference between the two, drawn below on a scale of its own, goes on to shrink
like 1/n. The tails are the last to follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb, factorial, sqrt
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

TERMS = (1, 2, 4, 8, 12)
GAUSSIAN = bmc.Normal(0.0, 1.0)
GRID = np.linspace(-3.4, 3.4, 1001)
BELL = np.exp(GAUSSIAN.log_prob(GRID))


def scaled_sum(terms: int) -> bmc.BayesNet:
    """``z``, the sum of uniform terms, shifted and scaled to mean 0 and variance 1."""
    net = bmc.BayesNet("central limit", plates={"term": terms})
    net.add("term", bmc.Uniform(0.0, 1.0), plates="term")
    net.add("z", lambda term: (term.sum("term") - terms / 2) / sqrt(terms / 12))
    return net


def exact(terms: int, z: Any, degree: int) -> np.ndarray:
    """Irwin and Hall's polynomials: the cdf of ``z`` at degree n, its density at degree n - 1."""
    total = terms / 2 + np.asarray(z) * sqrt(terms / 12)
    inside = np.minimum(total, terms)
    parts = (
        (-1) ** k * comb(terms, k) * np.where(total > k, (inside - k) ** degree, 0.0)
        for k in range(terms + 1)
    )
    return sum(parts) / factorial(degree) * sqrt(terms / 12) ** (terms - degree)


def gap(terms: int) -> float:
    """The largest difference between the density of ``z`` and the Gaussian's, on the grid."""
    return float(np.abs(exact(terms, GRID, terms - 1) - BELL).max())


def draw(samples: dict[int, np.ndarray]) -> Any:
    """A column for each number of terms: the densities, and the exact one minus the Gaussian."""
    names = [[f"{row} {n}" for n in samples] for row in ("density", "difference")]
    figure, panels = picture.axes(names, (13, 5), sharex=True, height_ratios=[1.5, 1])
    bins = sqrt(3) * np.linspace(-2, 2, 61)
    for n, z in samples.items():
        above, below = panels[f"density {n}"], panels[f"difference {n}"]
        above.hist(z, bins, density=True, color=picture.DRAWS, label="samples")
        above.plot(GRID, exact(n, GRID, n - 1), color=picture.EXACT, label="exact density")
        above.plot(GRID, BELL, "--", color=picture.OTHER, label="Gaussian")
        above.set(title=f"{n} term{'s' * (n > 1)}", ylim=(0, 0.45))
        below.axhline(0, ls="--", color=picture.OTHER)
        below.plot(GRID, exact(n, GRID, n - 1) - BELL, color=picture.EXACT)
        below.set(xlabel="scaled sum z", ylim=(-0.04, 0.04))
        largest = f"at most {gap(n):.3f} apart" + ", off the scale" * (gap(n) > 0.04)
        below.set_title(largest, fontsize="medium")
        if n != TERMS[0]:
            above.tick_params(labelleft=False)
            below.tick_params(labelleft=False)
    panels[f"density {TERMS[0]}"].set_ylabel("density")
    panels[f"difference {TERMS[0]}"].set_ylabel("exact - Gaussian")
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how often z exceeds 2 and how far the densities are apart, and draw them."""
    options = picture.options(__doc__, arguments)
    draws = 5_000 if options.fast else 200_000
    samples = {n: scaled_sum(n).sample(draws, rng=n)["z"] for n in TERMS}
    print(f"Central limit: P(z > 2), which is {1 - GAUSSIAN.cdf(2.0):.4f} for a Gaussian")
    for n, z in samples.items():
        share = np.mean(z > 2)
        error = sqrt(share * (1 - share) / draws)
        print(f"  {n:2d} terms: exact {exact(n, -2.0, n):.4f}, sampled {share:.4f} +- {error:.4f}; "
              f"densities at most {gap(n):.4f} apart")  # fmt: skip
    picture.save(draw(samples), options.out, "central_limit")


if __name__ == "__main__":
    main()
