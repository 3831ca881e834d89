"""Real GNP split into a trend that switches, a cycle that swings, and recessions that nobody saw.

    log GNP_t = trend_t + cycle_t,    trend_t = trend_{t-1} + drift[state_t],
    cycle_t ~ N(1.26 cycle_{t-1} - .35 cycle_{t-2}, .80)           in per cent; state_t is recession or boom

What is seen is the growth of a quarter, drift[state_t] + cycle_t - cycle_{t-1}, without noise: United
States, 1952 to 1984. With the published numbers (Lam's model as Kim estimated it) everything is asked of
four engines:

- ``SwitchingKalmanFilter("gpb2")`` is Kim's filter, which gave the published log-likelihood and cycle, and
  has Kim's smoother. It is an approximation, and so are published figures;
- ``SwitchingKalmanFilter("imm")`` is a cheaper one;
- ``ExpectationPropagation()`` passes messages until they agree;
- ``ParticleFilter(marginalize="auto", proposal="optimal")`` draws states and integrates the cycle out: its
  log-likelihood has an error that it knows, and is what the others are off from.

Kim (1994), Dynamic linear models with Markov-switching, J. Econometrics 60; Lam (1990), The Hamilton model
with a general autoregressive component, J. Monetary Economics 26; Kim and Nelson (1999), State-Space Models
with Regime Switching, sec. 5.4. The dates of recessions in the picture are those of the NBER (quarters of
peak and trough).
"""

from __future__ import annotations

import gzip
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, LowEssWarning
from examples import picture, reference

FIRST = 1952.75  # the quarter of the first published figure; the last is 1984.75
PARTICLES, RUNS = 1000, 5
#: quarters of peaks and troughs, nber.org
RECESSIONS = ((1953.25, 1954.25), (1957.5, 1958.25), (1960.25, 1961.0), (1969.75, 1970.75),
              (1973.75, 1975.0), (1980.0, 1980.5), (1981.5, 1982.75))  # fmt: skip


class Data(NamedTuple):
    """Growth in per cent a quarter, its model's numbers, and what was published.

    Attributes
    ----------
    growth : ndarray, shape (quarters,)
    burn : int
        Quarters at the start that the log-likelihood leaves out.
    cycle : ndarray, shape (quarters - burn,)
        Filtered, as published.
    log_likelihood : float
    model : dict
        Arrays of the numbers.
    """

    growth: np.ndarray
    burn: int
    cycle: np.ndarray
    log_likelihood: float
    model: dict[str, np.ndarray]


def read(folder: Path) -> Data:
    """The file of Kim (1994)."""
    with gzip.open(folder / "kim1994.json.gz") as file:
        held = json.load(file)
    model = {name: np.array(values) for name, values in held["model"].items()}
    return Data(
        np.array(held["y"])[:, 0], held["burn"], np.array(held["published_cycle_x0"]),
        held["published_loglik"], model,
    )  # fmt: skip


def economy(model: dict[str, np.ndarray]) -> bmc.DynamicBayesNet:
    """The template; slice 0 is the quarter before the first, whose growth nobody knows."""
    lags, noise, drift = model["A"][0], model["Q"][0], model["d"][:, 0]
    dbn = bmc.DynamicBayesNet("trend and cycle")
    dbn.table("state", ["state_prev"], model["P"], ("recession", "boom"), initial=model["pi"])

    @dbn.node(initial=bmc.MvNormal(model["m0"], model["V0"]))
    def both(both_prev):
        """The cycle of a quarter and that of the quarter before, which is known without noise."""
        return bmc.MvNormal(np.matvec(lags, both_prev), noise)

    @dbn.node
    def growth(both, state):
        return drift[state] + both[..., 0] - both[..., 1]

    return dbn


def rows(data: Data) -> dict[str, np.ndarray]:
    """The quarters, and one before them."""
    return {"growth": np.concatenate([[np.nan], data.growth])}


def log_likelihood(belief: Any, data: Data) -> float:
    """Of the quarters that count."""
    return float(belief.log_marginal_increments[1 + data.burn :].sum())


def cycle(belief: Any, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation, per cent of GNP, in the quarters that count."""
    counted = slice(1 + data.burn, None)
    return belief.mean("both")[counted, 0], belief.std("both")[counted, 0]


def recession(belief: Any, data: Data) -> np.ndarray:
    """Probability of a recession in the quarters that count."""
    return belief.probabilities("state")[1 + data.burn :, 0]


def answers(
    data: Data, particles: int = PARTICLES, runs: int = RUNS, sweeps: int = 100
) -> dict[str, Any]:
    """Beliefs by name; the last is a list of runs."""
    dbn, seen = economy(data.model), rows(data)
    kim = bmc.SwitchingKalmanFilter("gpb2")
    drawn = bmc.ParticleFilter(particles, marginalize="auto", proposal="optimal")
    with warnings.catch_warnings():
        # how far they are off is looked at by runs; how far messages are from settled is printed
        warnings.simplefilter("ignore", (LowEssWarning, ConvergenceWarning))
        many = [bmc.filter(dbn, seen, engine=drawn, rng=run) for run in range(runs)]
        settled = bmc.smooth(dbn, seen, engine=bmc.ExpectationPropagation(sweeps))
    return {
        "filtered, IMM": bmc.filter(dbn, seen, engine=bmc.SwitchingKalmanFilter("imm")),
        "filtered, Kim": bmc.filter(dbn, seen, engine=kim),
        "smoothed, Kim": bmc.smooth(dbn, seen, engine=kim),
        "smoothed, EP": settled,
        "particles": many,
    }


def dated(quarters: np.ndarray) -> np.ndarray:
    """Whether the NBER has a recession in a quarter: after the peak, up to the trough."""
    return np.any([(quarters > peak) & (quarters <= trough) for peak, trough in RECESSIONS], axis=0)


def report(found: dict[str, Any], data: Data) -> None:
    """Figures of every engine; the truth of filtered ones is what particles say on average."""
    many = found["particles"]
    logs = np.array([log_likelihood(run, data) for run in many])
    middle = np.mean([recession(run, data) for run in many], axis=0)
    centre = np.mean([cycle(run, data)[0] for run in many], axis=0)
    apart = np.mean([abs(cycle(run, data)[0] - centre).mean() for run in many])
    names = f"{len(many)} runs of {many[0].engine.particles} particles"
    error = logs.std(ddof=1) / np.sqrt(len(many))
    print(
        f"real GNP, {len(data.cycle)} quarters"
        + " " * 22
        + "log likelihood   cycle off by   recession off by"
    )
    print(f"  published (Kim's filter)                {data.log_likelihood:20.4f}")
    for name in ("filtered, IMM", "filtered, Kim"):
        belief = found[name]
        off = (
            abs(cycle(belief, data)[0] - centre).mean(),
            abs(recession(belief, data) - middle).mean(),
        )
        print(f"  {name:<40}{log_likelihood(belief, data):20.4f}{off[0]:13.3f} %{off[1]:17.4f}")
    print(f"  filtered, {names:<30}{logs.mean():20.4f}{apart:13.3f} %   (+- {error:.2f})")
    end = found["smoothed, EP"]
    swept = f"smoothed, EP, {end.sweeps} sweeps, the last by {end.change:.0e}"
    print(f"  {swept:<40}{log_likelihood(end, data):20.4f}")
    off = abs(cycle(found["filtered, Kim"], data)[0] - data.cycle).max()
    print(f"  Kim's filtered cycle is the published one within {off:.0e}")
    truth = dated(FIRST + 0.25 * np.arange(len(data.cycle)))
    print(f"  probably of a recession (the NBER dates {truth.sum()} quarters so)")
    for name in ("filtered, Kim", "smoothed, Kim", "smoothed, EP"):
        called = recession(found[name], data) > 0.5
        print(
            f"    {name}: {called.sum()} quarters, {(called & truth).sum()} of these among the NBER's"
        )


def draw(found: dict[str, Any], data: Data) -> Any:
    """The trend in the series, the cycle on the published one, and recessions."""
    quarters = FIRST + 0.25 * np.arange(len(data.cycle))
    figure, panels = picture.axes([["level"], ["cycle"], ["recession"]], (10, 10), sharex=True)
    for ax in panels.values():
        for peak, trough in RECESSIONS:
            ax.axvspan(peak, trough, color=picture.FAINT, alpha=0.25, lw=0)
    mean, sd = cycle(found["smoothed, EP"], data)
    level = np.cumsum(data.growth)[data.burn :]
    ax = panels["level"]
    ax.plot(quarters, level, color=picture.EXACT, lw=1, label="log GNP")
    ax.plot(quarters, level - mean, color=picture.OTHER, label="trend, smoothed by EP")
    ax.set(ylabel="per cent", title="real GNP of the United States (grey: recessions by the NBER)")
    ax = panels["cycle"]
    ax.fill_between(
        quarters, mean - 1.645 * sd, mean + 1.645 * sd, color=picture.OTHER, alpha=0.2, lw=0
    )
    ax.plot(quarters, mean, color=picture.OTHER, label="smoothed by EP, 90 %")
    ax.plot(quarters, cycle(found["filtered, Kim"], data)[0], color=picture.DRAWS, lw=4,
            label="filtered by GPB2")  # fmt: skip
    ax.plot(quarters, data.cycle, color=picture.EXACT, lw=1, label="published")
    ax.set(ylabel="per cent of GNP", title="cycle")
    ax = panels["recession"]
    many = np.array([recession(run, data) for run in found["particles"]])
    ax.plot(
        quarters,
        recession(found["filtered, Kim"], data),
        color=picture.DRAWS,
        lw=3,
        label="filtered by GPB2",
    )
    ax.plot(
        quarters, many.mean(axis=0), ".", color=picture.EXACT, ms=3, label="filtered, particles"
    )
    ax.plot(
        quarters,
        recession(found["smoothed, Kim"], data),
        color=picture.FAINT,
        label="smoothed by Kim",
    )
    ax.plot(
        quarters,
        recession(found["smoothed, EP"], data),
        color=picture.OTHER,
        label="smoothed by EP",
    )
    ax.set(ylabel="probability", title="recession", ylim=(-0.02, 1.25), xlim=quarters[[0, -1]])
    for ax in panels.values():
        ax.legend(frameon=False, fontsize=9, ncols=4, loc="upper left")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print figures, and draw the split."""
    options = picture.options(__doc__, arguments)
    folder = reference.folder("switching")
    if folder is None:
        print("skipped: the series of GNP is not at hand (set BAYESMC_DATA)")
        return
    data = read(folder)
    found = answers(data, *((50, 2, 2) if options.fast else (PARTICLES, RUNS)))
    report(found, data)
    picture.save(draw(found, data), options.out, "gnp_trend_cycle")


if __name__ == "__main__":
    main()
