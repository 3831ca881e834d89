"""Who answers what at which price and error: every filter that can, asked of one switching template.

A level wanders, by little or by much, and nobody says which. There is one hidden number, so that a fine grid
is exact to all digits shown, and what the others are off from. Filters of finite nodes have it in cells.
Then smoothers are asked of the same with a sensor that breaks, which is harder. The table is that of
``docs/switching.md``.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.errors import BayesmcError, ConvergenceWarning, LowEssWarning

STEPS, SHORT, RUNS, SEED = 200, 7, 10, 5
WANDER, BLUR, BAD = np.array([0.1, 0.8]), 0.6, np.array([0.2, 2.0])
KEPT, REACH, CELLS, FINE = 0.95, 8.0, 60, 1600


class Price(NamedTuple):
    """What an answer costs and how far it is off.

    Attributes
    ----------
    each : float
        Milliseconds of processor time a slice.
    regime : float
        Mean distance of the probability that it is rough, per cent.
    level : float
        Mean distance of the level's mean, in per cent of its standard deviation.
    log : float
        Distance of the log evidence.
    """

    each: float
    regime: float
    level: float
    log: float


def stock(breaks: bool = False) -> bmc.DynamicBayesNet:
    """The template; with a sensor that breaks there are four modes, not two."""
    dbn = regimes("a level in two regimes")
    dbn.add(
        "level",
        lambda level_prev, regime: bmc.Normal(KEPT * level_prev, WANDER[regime]),
        initial=bmc.Normal(0.0, 1.0),
    )
    if breaks:
        sensor = [[0.9, 0.1], [0.3, 0.7]]
        dbn.table("sensor", ["sensor_prev"], sensor, ("good", "bad"), initial=[0.75, 0.25])
        dbn.add("reading", lambda level, sensor: bmc.Normal(level, BAD[sensor]))
    else:
        dbn.add("reading", lambda level: bmc.Normal(level, BLUR))
    return dbn


def regimes(name: str) -> bmc.DynamicBayesNet:
    """What is finite from the start: whether the level wanders by much."""
    dbn = bmc.DynamicBayesNet(name)
    follow = [[0.95, 0.05], [0.2, 0.8]]
    dbn.table("regime", ["regime_prev"], follow, ("calm", "rough"), initial=[0.8, 0.2])
    return dbn


def in_cells(cells: int = CELLS) -> bmc.DynamicBayesNet:
    """The same with the level in cells of the range that it has."""
    from scipy.stats import norm

    edges = np.linspace(-REACH, REACH, cells + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])

    def shares(mean: Any, scale: Any) -> np.ndarray:
        mass = np.diff(norm.cdf(edges, np.asarray(mean)[..., None], np.asarray(scale)[..., None]))
        return mass / mass.sum(axis=-1, keepdims=True)

    moved = shares(KEPT * middles[:, None], WANDER)
    dbn = regimes("a level in cells")
    dbn.table(
        "level", ["level_prev", "regime"], moved, tuple(middles.tolist()), initial=shares(0.0, 1.0)
    )
    dbn.add("reading", lambda level: bmc.Normal(level, BLUR))
    return dbn


class Asked(NamedTuple):
    """One line: what is asked of whom, about which template, how many times, and in words what it costs."""

    ask: Callable[..., Any]
    dbn: bmc.DynamicBayesNet
    engine: Any
    runs: int = 1


def lines() -> dict[str, Asked]:
    """Everybody who answers, and one who does not."""
    dbn, cells = stock(), in_cells()
    clusters = bmc.BoyenKoller([["regime"], ["level"]])
    filters: dict[str, Any] = {
        "GridFilter()": (dbn, bmc.GridFilter()),
        'SwitchingKalmanFilter("gpb1")': (dbn, bmc.SwitchingKalmanFilter("gpb1")),
        'SwitchingKalmanFilter("imm")': (dbn, bmc.SwitchingKalmanFilter("imm")),
        'SwitchingKalmanFilter("gpb2")': (dbn, bmc.SwitchingKalmanFilter("gpb2")),
        "ParticleFilter(1000)": (dbn, bmc.ParticleFilter(1000), RUNS),
        'the same, marginalize="auto"': (dbn, bmc.ParticleFilter(1000, marginalize="auto"), RUNS),
        'and proposal="optimal"': (
            dbn,
            bmc.ParticleFilter(1000, marginalize="auto", proposal="optimal"),
            RUNS,
        ),
        f"DiscreteFilter(), {CELLS} cells": (cells, bmc.DiscreteFilter()),
        "BoyenKoller([[regime], [level]])": (cells, clusters),
        "FactoredFrontier()": (cells, bmc.FactoredFrontier()),
    }
    smoothers: dict[str, Any] = {
        'SwitchingKalmanFilter("gpb2")': (dbn, bmc.SwitchingKalmanFilter("gpb2")),
        "ExpectationPropagation()": (dbn, bmc.ExpectationPropagation()),
        f"DiscreteFilter(), {CELLS} cells": (cells, bmc.DiscreteFilter()),
        "BoyenKoller([[regime], [level]])": (cells, clusters),
    }
    found = {name: Asked(bmc.filter, *rest) for name, rest in filters.items()}
    return found | {
        f"{name}, smoothed": Asked(bmc.smooth, *rest) for name, rest in smoothers.items()
    }


def rows(breaks: bool = False) -> dict[str, np.ndarray]:
    """Readings drawn from the template."""
    return {"reading": stock(breaks).sample(STEPS, rng=SEED)["reading"][0]}


def rightly(ask: Callable[..., Any], seen: dict[str, np.ndarray], breaks: bool = False) -> Any:
    """The answer on a fine grid."""
    engine = bmc.GridFilter(grid={"level": (-REACH, REACH, FINE)})
    return ask(stock(breaks), seen, engine=engine)


def priced(asked: Asked, seen: dict[str, np.ndarray], right: Any) -> Price:
    """Asked twice, of which the second counts: what is found out about a template is kept."""
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", (LowEssWarning, ConvergenceWarning))
        asked.ask(asked.dbn, seen, engine=asked.engine, rng=0)
        for run in range(asked.runs):
            begun = time.process_time()
            belief = asked.ask(asked.dbn, seen, engine=asked.engine, rng=run)
            took = time.process_time() - begun
            apart = abs(belief.probabilities("regime") - right.probabilities("regime"))[:, 1]
            off = abs(belief.mean("level") - right.mean("level")) / right.std("level")
            log = abs(belief.log_marginal_likelihood - right.log_marginal_likelihood)
            found.append((1e3 * took / STEPS, 100 * apart.mean(), 100 * off.mean(), log))
    return Price(*np.mean(found, axis=0))


def main() -> None:
    """Print the tables as Markdown."""
    print("| who answers | ms a slice | regime | level | log evidence |\n|---|---|---|---|---|")
    seen = rows()
    right = {ask: rightly(ask, seen) for ask in (bmc.filter, bmc.smooth)}
    for name, asked in lines().items():
        print(line(name, asked, seen, right[asked.ask]))
    short = {"reading": seen["reading"][:SHORT]}
    began = time.process_time()
    evidence = stock().unrolled_evidence(short)
    exact = bmc.infer(stock().unroll(SHORT), evidence, engine=bmc.Exact())
    took = 1e3 * (time.process_time() - began) / SHORT
    log = abs(exact.log_marginal_likelihood - rightly(bmc.filter, short).log_marginal_likelihood)
    print(f"| `Exact()`, {SHORT} slices | {_short(took)} | 0 | 0 | {_short(log)} |")
    print("\nwith a sensor that breaks, smoothed:")
    seen = rows(True)
    middle = rightly(bmc.smooth, seen, True)
    for engine in (
        bmc.SwitchingKalmanFilter(),
        bmc.ExpectationPropagation(),
        bmc.ExpectationPropagation(damping=0.8),
    ):
        print(line(repr(engine), Asked(bmc.smooth, stock(True), engine), seen, middle))


def line(name: str, asked: Asked, seen: dict[str, np.ndarray], right: Any) -> str:
    """One of the table."""
    try:
        price = priced(asked, seen, right)
    except BayesmcError as error:
        return f"| `{name}` | refuses: {str(error).split(';')[0]} | | | |"
    each, modes, level, log = map(_short, price)
    return f"| `{name}` | {each} | {modes} % | {level} % | {log} |"


def _short(value: float) -> str:
    if np.isnan(value):
        return "none"
    return f"{value:.2g}" if value >= 1e-4 else "0"


if __name__ == "__main__":
    main()
