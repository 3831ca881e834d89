"""Metropolis-Hastings on a density of two hills, with random walks of three widths: 1, 8 and 500.

A narrow proposal accepts nearly everything and creeps; a wide one sees both hills and is nearly always
refused; one in between explores its hill well, and still does not cross the valley within reasonable time.
High acceptance is no proof of anything: the share of draws on either hill tells, and R-hat, which compares
chains that started on different ones.

The target, two Gaussians at -50 and 50 of standard deviation 10, and the widths are those of Murphy,
Machine Learning: A Probabilistic Perspective, 2012, figure 24.7.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from examples import picture

WEIGHTS, MEANS, SD = np.array([0.3, 0.7]), np.array([-50.0, 50.0]), 10.0
TARGET = bmc.Mixture(WEIGHTS, bmc.Normal(MEANS, SD))
WIDTHS = (1, 8, 500)
CHAINS = 8
GRID = np.linspace(-120.0, 120.0, 961)

VERDICTS = {
    1: "creeps: small steps are rarely refused, but each chain stays on the hill where it began",
    8: "explores one hill quickly; the valley, where the density is e^-12 of a hill's, is not crossed",
    500: "crosses all the time, but one step in twenty is taken: the chain mostly stands still",
}


def net() -> bmc.BayesNet:
    """The target as a net of one node."""
    net = bmc.BayesNet("two hills")
    net.add("x", TARGET)
    return net


def walk(width: float) -> Callable[[Any], bmc.Normal]:
    """A Normal step around where the chain is, as a proposal: a conditional density."""
    return lambda x: bmc.Normal(x, width)


def explored(width: float, draws: int) -> Any:
    """The posterior of a random walk of some width; no warmup, as a fixed width has nothing to learn."""
    engine = bmc.MetropolisHastings(
        draws=draws, warmup=0, chains=CHAINS, proposal={"x": walk(width)}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the table says it in numbers
        return bmc.infer(net(), engine=engine, rng=1)


def acceptance(width: float) -> float:
    """Exact rate of acceptance in the long run, by a sum over a grid of x and of steps."""
    x = np.linspace(-110.0, 110.0, 221)
    step = np.linspace(-6.0, 6.0, 1001) * width
    p = np.exp(TARGET.log_prob(x))
    q = np.exp(-0.5 * (step / width) ** 2)
    ratio = np.exp(TARGET.log_prob(x[:, None] + step) - TARGET.log_prob(x)[:, None])
    taken = np.minimum(1.0, ratio) @ (q / q.sum())
    return float(taken @ p / p.sum())


def right_hill(posterior: Any) -> np.ndarray:
    """Share of the draws of each chain that are on the right hill, shape (chains,)."""
    return (posterior["x"] > 0).mean(axis=1)


def report(posteriors: dict[int, Any]) -> None:
    """Acceptance, the shares of the hills and what the diagnostics say, for every width."""
    print(f"  {'width':>5}  {'acceptance':>10}  {'exact':>6}  {'on the right hill, by chain':28}  "
          f"{'R-hat':>6}  {'ESS':>6}")  # fmt: skip
    for width, posterior in posteriors.items():
        shares = " ".join(f"{share:.1f}" for share in right_hill(posterior))
        rate = posterior.acceptance["x"].mean()
        print(f"  {width:5}  {rate:10.3f}  {acceptance(width):6.3f}  {shares:28}  "
              f"{posterior.rhat('x'):6.3f}  {posterior.ess('x'):6.0f}")  # fmt: skip
    print(
        f"  exact: {WEIGHTS[1]:.1f} on the right hill; a chain that mixes has an R-hat below 1.01"
    )
    for width, verdict in VERDICTS.items():
        print(f"  width {width}: {verdict}")


def draw(posteriors: dict[int, Any]) -> Any:
    """For each width the trace of two chains, one from each hill, and the histogram of all draws."""
    mosaic = [[f"trace {w}", f"histogram {w}"] for w in posteriors]
    figure, panels = picture.axes(mosaic, (11, 8.4), width_ratios=[2, 1])
    density = np.exp(TARGET.log_prob(GRID))
    for width, posterior in posteriors.items():
        x = posterior["x"]
        ends = np.argmin(x[:, 0]), np.argmax(x[:, 0])
        trace, histogram = panels[f"trace {width}"], panels[f"histogram {width}"]
        for chain, colour in zip(ends, (picture.OTHER, picture.DRAWS), strict=True):
            trace.plot(x[chain, :1000], color=colour, lw=0.8)
        rate = posterior.acceptance["x"].mean()
        trace.set(title=f"width {width}: {rate:.0%} accepted", ylim=(-95, 95), ylabel="x")
        histogram.hist(
            x[list(ends)].T,
            bins=np.linspace(-95, 95, 77),
            density=True,
            stacked=True,
            color=[picture.OTHER, picture.DRAWS],
        )
        histogram.plot(GRID, density, color=picture.EXACT, label="target")
        histogram.set(title="these two chains", xlim=(-95, 95), yticks=[])
    panels[f"histogram {WIDTHS[0]}"].legend(frameon=False, loc="upper left")
    panels[f"trace {WIDTHS[-1]}"].set(xlabel="step")
    panels[f"histogram {WIDTHS[-1]}"].set(xlabel="x")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what each width reaches, and draw traces and histograms."""
    options = picture.options(__doc__, arguments)
    draws = 300 if options.fast else 10_000
    print(f"Metropolis-Hastings on two hills: {CHAINS} chains of {draws:,} steps for each width")
    posteriors = {width: explored(width, draws) for width in WIDTHS}
    report(posteriors)
    picture.save(draw(posteriors), options.out, "bimodal_mixture")


if __name__ == "__main__":
    main()
