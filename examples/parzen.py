"""A two-component Gaussian mixture, and its Parzen approximation from samples.

A Parzen window puts a small Gaussian on every sample and averages them (``bmc.KernelDensity``). Its
width decides: too narrow, and the estimate shows the samples rather than the density; too wide, and
the two modes run together. Silverman's rule gives the best width for one Gaussian of the samples'
spread; here most of the spread is the distance between two modes, and so the rule's window is too
wide for either. More samples pay for a narrower window.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

SIZES = (20, 200, 2000)
BANDWIDTHS = (0.15, "silverman", 1.5)
GRID = np.linspace(-6.0, 7.0, 1301)

MIXTURE = bmc.Mixture([0.55, 0.45], bmc.Normal([-1.5, 2.5], [0.7, 1.0]))
TRUTH = np.exp(MIXTURE.log_prob(GRID))
SAMPLES = MIXTURE.sample(np.random.default_rng(3), SIZES[-1])


def width(samples: int, bandwidth: Any) -> float:
    """The standard deviation of the kernel that a bandwidth stands for."""
    return float(bmc.KernelDensity(SAMPLES[:samples], bandwidth).kernel_cov.item() ** 0.5)


def approximations() -> dict[tuple[int, Any], np.ndarray]:
    """The estimate on the grid for every number of samples and every bandwidth."""
    return {
        (n, bandwidth): np.exp(bmc.KernelDensity(SAMPLES[:n], bandwidth).log_prob(GRID))
        for n in SIZES
        for bandwidth in BANDWIDTHS
    }


def error(estimate: np.ndarray) -> float:
    """The area between the estimate and the density: 0 for a perfect fit, 2 for no overlap."""
    return float(np.trapezoid(np.abs(estimate - TRUTH), GRID))


def draw(found: dict[tuple[int, Any], np.ndarray]) -> Any:
    """A row for each number of samples, a column for each bandwidth."""
    names = [[f"{n} samples, {_called(n, b)}" for b in BANDWIDTHS] for n in SIZES]
    figure, panels = picture.axes(names, (10, 7), sharex=True, sharey=True)
    for (name, ax), estimate in zip(panels.items(), found.values(), strict=True):
        ax.fill_between(GRID, TRUTH, color=picture.FAINT, alpha=0.35, lw=0, label="mixture")
        ax.plot(GRID, estimate, color=picture.OTHER, label="Parzen approximation")
        ax.set(title=name, ylim=(0, 0.5), xlim=(-6, 7), xticks=range(-6, 7, 3))
        ax.text(7, 0.45, f"area between {error(estimate):.2f}", ha="right", fontsize=9)
    figure.supxlabel("x")
    figure.supylabel("density")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how far each approximation is off, and draw them."""
    options = picture.options(__doc__, arguments)
    found = approximations()
    print("Parzen windows: area between the mixture and its approximation")
    for (n, bandwidth), estimate in found.items():
        print(f"  {n:5d} samples, {_called(n, bandwidth):21}  {error(estimate):.3f}")
    print(f"  Silverman's rule is for one Gaussian of the same spread, {MIXTURE.var**0.5:.2f}; "
          "the peaks here have 0.7 and 1.0")  # fmt: skip
    picture.save(draw(found), options.out, "parzen")


def _called(samples: int, bandwidth: Any) -> str:
    rule = "Silverman's" if bandwidth == "silverman" else "bandwidth"
    return f"{rule} {width(samples, bandwidth):.2f}"


if __name__ == "__main__":
    main()
