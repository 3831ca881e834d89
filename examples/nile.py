"""The Nile, 1871 to 1970: a level that wanders under noise, by the Kalman filter.

    level_t = level_{t-1} + N(0, 1469.1),    flow_t = level_t + N(0, 15099)

The local level model, with the variances of maximum likelihood. A first level of which nothing is known is
``Normal(0, 1e7)``: filters keep their precision however vague it is, and the log-likelihood that is published
leaves the first year out. The picture shows what the filter knows of each year at its end, what the smoother
knows with hindsight, what becomes of both where two spells of twenty years are taken away, and a forecast.

Annual flow at Aswan in 10^8 m^3: Cobb (1978), The problem of the Nile, Biometrika 65, table 1. Durbin and
Koopman (2012), Time Series Analysis by State Space Methods, 2nd ed., chapter 2, figures 2.1, 2.2, 2.5, 2.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

FLOW = np.array([
    1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180,
    799, 958, 1140, 1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833, 701,
    916, 692, 1020, 1050, 969, 831, 726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845, 864, 862,
    698, 845, 744, 796, 1040, 759, 781, 865, 845, 944, 984, 897, 822, 1010, 771, 676, 649, 846, 812,
    742, 801, 1040, 860, 874, 848, 890, 744, 749, 838, 1050, 918, 986, 797, 923, 975, 815, 1020, 906,
    901, 1170, 912, 746, 919, 718, 714, 740,
], dtype=float)  # fmt: skip
YEARS = np.arange(1871, 1971)
NOISE, WANDER = 15099.0, 1469.1
AHEAD = 30
LOG_LIKELIHOOD = -632.5456  # published, without the first year
GAPS = (slice(20, 40), slice(60, 80))


def local_level(noise: float = NOISE, wander: float = WANDER) -> bmc.DynamicBayesNet:
    """The template, by its two variances."""
    dbn = bmc.DynamicBayesNet("local level")

    @dbn.node(initial=bmc.Normal(0.0, 1e7))
    def level(level_prev):
        return bmc.Normal(level_prev, np.sqrt(wander))

    @dbn.node
    def flow(level):
        return bmc.Normal(level, np.sqrt(noise))

    return dbn


def with_gaps() -> np.ndarray:
    """The series without 1891-1910 and 1931-1950, as NaN."""
    flow = FLOW.copy()
    for gap in GAPS:
        flow[gap] = np.nan
    return flow


def log_likelihood(dbn: bmc.DynamicBayesNet) -> float:
    """Of all years but the first, whose density only says how vague the start is."""
    found = bmc.filter(dbn, {"flow": FLOW}, engine=bmc.KalmanFilter())
    return float(found.log_marginal_increments[1:].sum())


def prediction_errors(filtered: Any) -> np.ndarray:
    """What was off each year in the forecast of the year before, in standard deviations; shape (99,)."""
    ahead = np.sqrt(filtered.var("level")[:-1] + WANDER + NOISE)
    return (FLOW[1:] - filtered.mean("level")[:-1]) / ahead


def answers() -> dict[str, Any]:
    """Every belief that is shown."""
    dbn, engine = local_level(), bmc.KalmanFilter()
    rows, gappy = {"flow": FLOW}, {"flow": with_gaps()}
    return {
        "filtered": bmc.filter(dbn, rows, engine=engine),
        "smoothed": bmc.smooth(dbn, rows, engine=engine),
        "filtered with gaps": bmc.filter(dbn, gappy, engine=engine),
        "smoothed with gaps": bmc.smooth(dbn, gappy, engine=engine),
        "forecast": bmc.forecast(dbn, rows, steps=AHEAD, engine=engine),
    }


def report(found: dict[str, Any]) -> None:
    """Print the log-likelihood and some years."""
    print("Nile: local level, log-likelihood of 1872-1970")
    print(f"  {log_likelihood(local_level()):.4f}, published {LOG_LIKELIHOOD:.4f}")
    for noise, wander in ((NOISE, 0.5 * WANDER), (NOISE, 2.0 * WANDER), (0.9 * NOISE, WANDER)):
        other = log_likelihood(local_level(noise, wander))
        print(f"  {other:.4f} at variances {noise:.0f} and {wander:.1f}")
    off = prediction_errors(found["filtered"])
    print(f"  standardised errors of one-year forecasts: mean {off.mean():.2f}, sd {off.std():.2f}")
    print("  level of      filtered          smoothed")
    for year in (1871, 1899, 1913, 1970):
        k = year - YEARS[0]
        cells = (
            f"{found[how].mean('level')[k]:7.1f} +- {found[how].std('level')[k]:5.1f}"
            for how in ("filtered", "smoothed")
        )
        print(f"  {year}    {'  '.join(cells)}")
    last = found["forecast"]
    print(f"  flow of {YEARS[-1] + AHEAD} forecast from {YEARS[-1]}: {last.mean('flow')[-1]:.1f} "
          f"+- {last.std('flow')[-1]:.1f}")  # fmt: skip


def draw(found: dict[str, Any]) -> Any:
    """Filtered, smoothed, with gaps, and the forecast."""
    figure, panels = picture.axes(
        [["filtered", "smoothed"], ["gaps", "forecast"]], (12, 7.6), sharey=True
    )
    for how in ("filtered", "smoothed"):
        ax = panels[how]
        ax.plot(YEARS, FLOW, ".", color=picture.FAINT)
        band(ax, YEARS, found[how], "level", picture.OTHER, f"{how} level, 90 %")
    ax = panels["gaps"]
    ax.plot(YEARS, with_gaps(), ".", color=picture.FAINT)
    for gap in GAPS:
        ax.axvspan(*YEARS[gap][[0, -1]], color=picture.FAINT, alpha=0.15, lw=0)
    band(ax, YEARS, found["filtered with gaps"], "level", picture.DRAWS, "filtered")
    band(ax, YEARS, found["smoothed with gaps"], "level", picture.OTHER, "smoothed")
    ax, after = panels["forecast"], YEARS[-1] + 1 + np.arange(AHEAD)
    ax.plot(YEARS, FLOW, ".", color=picture.FAINT)
    ax.plot(YEARS, found["filtered"].mean("level"), color=picture.EXACT, lw=1)
    band(ax, after, found["forecast"], "flow", picture.DRAWS, "forecast flow, 90 %")
    band(ax, after, found["forecast"], "level", picture.OTHER, "forecast level, 90 %")
    panels["filtered"].set(ylim=(400, 1450), title="at the end of each year")
    panels["smoothed"].set(title="with hindsight")
    panels["gaps"].set(title="without 40 of the years")
    panels["forecast"].set(title=f"{AHEAD} years ahead")
    figure.supylabel("flow of the Nile, $10^8$ m$^3$ a year")
    for ax in panels.values():
        ax.legend(frameon=False, loc="upper right", fontsize=9, ncols=2)
    return figure


def band(ax: Any, years: np.ndarray, belief: Any, name: str, colour: str, label: str) -> None:
    """Mean and 90 % interval of a node over time."""
    mean, width = belief.mean(name), 1.645 * belief.std(name)
    ax.plot(years, mean, color=colour, label=label)
    ax.fill_between(years, mean - width, mean + width, color=colour, alpha=0.2, lw=0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the figures, and draw them."""
    options = picture.options(__doc__, arguments)
    found = answers()
    report(found)
    picture.save(draw(found), options.out, "nile")


if __name__ == "__main__":
    main()
