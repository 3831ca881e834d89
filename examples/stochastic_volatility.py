"""Stochastic volatility: how restless the pound was against the dollar, day by day.

    x_t = mu + rho (x_{t-1} - mu) + sigma u_t,    r_t = exp(x_t / 2) e_t

A return says little about the spread that it came from, so that beliefs are wide and not Gaussian: no Kalman
filter, but one state, which a grid holds exactly and particles hold nearly. The likelihood is one number for
the whole series, and the one that parameters are learnt by; both filters give it, one with an error bar. The
picture shows what is known of the volatility at the end of each day, and what backward simulation makes of
it with hindsight.

The series is GBP against USD, daily from 1997 to 1999, where ``BAYESMC_DATA`` names the reference data, else
750 days drawn from the model. Kim, Shephard and Chib (1998), Stochastic volatility, Review of Economic
Studies 65; Chopin and Papaspiliopoulos (2020), An Introduction to Sequential Monte Carlo, section 2.4.3.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from examples import picture

MU, RHO, SIGMA = -1.02, 0.9702, 0.178
DAYS = 750
LOG_LIKELIHOOD = -492.454242  # of the reference series at these parameters
COPIES = 40  # filters beside each other, whose spread is the error of one


class Returns(NamedTuple):
    """Daily returns in percent, and where they are from."""

    source: str
    values: np.ndarray


def volatility(copies: int | None = None) -> bmc.DynamicBayesNet:
    """The template, or copies of it side by side: ``x`` is the log variance of the day's return."""
    dbn = bmc.DynamicBayesNet("stochastic volatility", plates={"copy": copies} if copies else None)
    plates = ("copy",) if copies else ()
    spread = SIGMA / np.sqrt(1 - RHO**2)

    @dbn.node(initial=bmc.Normal(MU, spread), plates=plates)
    def x(x_prev):
        return bmc.Normal(MU + RHO * (x_prev - MU), SIGMA)

    @dbn.node(plates=plates)
    def r(x):
        return bmc.Normal(0.0, np.exp(x / 2))

    return dbn


def returns() -> Returns:
    """The reference series if it is there, else one drawn from the model."""
    folder = os.environ.get("BAYESMC_DATA")
    path = Path(folder) / "statespace" / "GBP_vs_USD_9798.txt" if folder else None
    if path is None or not path.is_file():
        drawn = volatility().sample(DAYS, rng=4)
        return Returns("simulated", drawn["r"][0])
    pounds = np.loadtxt(path, skiprows=2, usecols=3, max_rows=DAYS + 1)  # a note follows
    return Returns("GBP against USD, 1997-99", 100 * np.diff(np.log(pounds)))


def grid(cells: int) -> Any:
    """The exact filter but for cells, over ten standard deviations of the state on both sides."""
    reach = 10 * SIGMA / np.sqrt(1 - RHO**2)
    return bmc.GridFilter({"x": (MU - reach, MU + reach, cells)})


def log_likelihoods(values: np.ndarray, particles: int, copies: int = COPIES) -> np.ndarray:
    """Estimates by so many filters with particles and chances of their own, shape (copies,)."""
    rows = {"r": np.repeat(values[:, None], copies, axis=1)}
    engine = bmc.ParticleFilter(particles)
    return bmc.filter(volatility(copies), rows, engine=engine, rng=1).log_marginal_likelihood


def pooled(estimates: np.ndarray) -> tuple[float, float]:
    """Log of the mean likelihood, which is unbiased before the log, and its standard error."""
    top = estimates.max()
    share = np.exp(estimates - top)
    error = share.std(ddof=1) / share.mean() / np.sqrt(len(share))
    return float(top + np.log(share.mean())), float(error)


def beliefs(values: np.ndarray, particles: int, trajectories: int, cells: int) -> dict[str, Any]:
    """Filtered and smoothed by particles, and exactly."""
    rows, dbn = {"r": values}, volatility()
    engine = bmc.ParticleFilter(particles)
    return {
        "filtered": bmc.filter(dbn, rows, engine=engine, rng=2),
        "smoothed": bmc.smooth(dbn, rows, engine=engine, rng=2, trajectories=trajectories),
        "filtered exactly": bmc.filter(dbn, rows, engine=grid(cells)),
        "smoothed exactly": bmc.smooth(dbn, rows, engine=grid(cells)),
    }


def report(found: dict[str, Any], series: Returns, particles: int) -> None:
    """Print log-likelihoods, and how far particles are off the grid."""
    exact = found["filtered exactly"].log_marginal_likelihood
    print("  log-likelihood")
    held = f", reference {LOG_LIKELIHOOD:.6f}" if series.source != "simulated" else ""
    print(f"    grid                      {exact:.6f}{held}")
    for n in (particles // 8, particles):
        estimates = log_likelihoods(series.values, n)
        estimate, error = pooled(estimates)
        print(f"    {COPIES} filters of {n:5,}       {estimate:.3f} +- {error:.3f}; "
              f"one of them is off by {estimates.std(ddof=1):.3f}")  # fmt: skip
    print("  mean of x by particles and by the grid differ by at most")
    for how in ("filtered", "smoothed"):
        off = np.abs(found[how].mean("x") - found[f"{how} exactly"].mean("x")).max()
        sd = found[f"{how} exactly"].std("x").mean()
        print(f"    {how}                  {off:.3f}, where beliefs are {sd:.2f} wide")


def draw(found: dict[str, Any], series: Returns) -> Any:
    """Returns inside of the volatility; volatility by day, filtered and smoothed."""
    figure, panels = picture.axes([["returns"], ["filtered"], ["smoothed"]], (11, 8.6), sharex=True)
    days = np.arange(len(series.values))
    ax = panels["returns"]
    ax.plot(days, series.values, ".", color=picture.EXACT, ms=3)
    wide = 2 * np.exp(found["smoothed"].mean("x") / 2)
    ax.fill_between(days, -wide, wide, color=picture.DRAWS, alpha=0.4, lw=0, label="2 x volatility")
    ax.set(ylabel="return, %", title=series.source)
    ax.legend(frameon=False, loc="upper right")
    for how, called in (("filtered", "at the end of each day"), ("smoothed", "with hindsight")):
        ax = panels[how]
        mean, sd = (getattr(found[how], what)("x") for what in ("mean", "std"))
        low, middle, high = (np.exp((mean + z * sd) / 2) for z in (-1.645, 0.0, 1.645))
        ax.fill_between(days, low, high, color=picture.DRAWS, alpha=0.5, lw=0, label="90 %")
        ax.plot(days, middle, color=picture.OTHER, lw=1.4, label="particles")
        exact = np.exp(found[f"{how} exactly"].mean("x") / 2)
        ax.plot(days, exact, color=picture.EXACT, lw=0.8, ls="--", label="grid")
        ceiling = 1.25 * float(np.quantile(high, 0.995))  # room for the legend
        ax.set(ylabel="volatility, %", title=called, ylim=(0, ceiling), xlim=(0, days[-1]))
    panels["smoothed"].set(xlabel="day")
    panels["filtered"].legend(frameon=False, loc="upper right", ncols=3)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the log-likelihoods, and draw the volatility."""
    options = picture.options(__doc__, arguments)
    series = returns()
    particles, trajectories, cells = (200, 50, 100) if options.fast else (2000, 500, 200)
    if options.fast:
        series = series._replace(values=series.values[:150])
    print(f"Stochastic volatility: {len(series.values)} days, {series.source}")
    found = beliefs(series.values, particles, trajectories, cells)
    report(found, series, particles)
    picture.save(draw(found, series), options.out, "stochastic_volatility")


if __name__ == "__main__":
    main()
