"""How long ``fit`` takes on templates with a trend and a season, an ARMA, regimes, and stochastic volatility.

``python -m benchmarks.bench_fit_series [NAME ...]``: airline, arma, hamilton, volatility. Reference data are
read from ``BAYESMC_DATA``.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import bayesmc as bmc
from benchmarks.harness import data_folder, table


def airline() -> tuple[Any, ...]:
    """Logs of passengers: a trend, and a season of twelve months by ten lags."""
    path = data_folder() / "statespace" / "AirPassengers.csv"
    rows = np.log(np.genfromtxt(path, delimiter=",", skip_header=1)[:, 2])
    dbn, vague = bmc.DynamicBayesNet("airline"), bmc.Normal(0.0, 100.0)
    for name in ("s_level", "s_slope", "s_season", "s_seen"):
        dbn.add_static(name, bmc.HalfNormal(0.1))

    @dbn.node(initial=vague)
    def level(level_prev: Any, slope_prev: Any, s_level: Any) -> Any:
        return bmc.Normal(level_prev + slope_prev, s_level)

    dbn.add("slope", lambda slope_prev, s_slope: bmc.Normal(slope_prev, s_slope), initial=vague)
    lags = ["season", *(f"lag{k}" for k in range(1, 11))]

    def season(s_season: Any, *before: Any) -> Any:
        return bmc.Normal(-sum(before), s_season)

    dbn.add("season", season, ["s_season", *(f"{n}_prev" for n in lags)], initial=vague)
    for before, lag in zip(lags, lags[1:], strict=False):
        dbn.add(lag, lambda value: value, [f"{before}_prev"], initial=vague)
    dbn.add("y", lambda level, season, s_seen: bmc.Normal(level + season, s_seen))
    return dbn, {"y": rows}, None, None


def arma() -> tuple[Any, ...]:
    """Sunspots of 309 years as an ARMA(2,1)."""
    path = data_folder() / "statespace" / "sunspots.csv"
    rows = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1]
    dbn = bmc.DynamicBayesNet("ARMA(2,1)")
    dbn.add_static("mu", bmc.Normal(50.0, 100.0))
    for name in ("phi1", "phi2", "theta"):
        dbn.add_static(name, bmc.Normal(0.0, 1.0))
    dbn.add_static("sigma", bmc.HalfNormal(50.0))
    dbn.add("e", lambda sigma: bmc.Normal(0.0, sigma))

    @dbn.node(initial=bmc.Normal(0.0, 40.0))
    def x(
        x_prev: Any, x_lag_prev: Any, e: Any, e_prev: Any, phi1: Any, phi2: Any, theta: Any
    ) -> Any:
        return bmc.Normal(phi1 * x_prev + phi2 * x_lag_prev + e + theta * e_prev, 0.0)

    dbn.add("x_lag", lambda x_prev: x_prev, initial=bmc.Normal(0.0, 40.0))
    dbn.add("y", lambda mu, x: bmc.Normal(mu + x, 0.0))
    return dbn, {"y": rows}, None, None


def hamilton() -> tuple[Any, ...]:
    """Growth of GNP as an AR(4) about means that switch."""
    path = data_folder() / "statespace" / "us_rgnp_hamilton.csv"
    growth = np.genfromtxt(path, delimiter=",", skip_header=1)[:, 1]
    dbn = bmc.DynamicBayesNet("Hamilton")
    for name, prior in (("p00", bmc.Beta(1.0, 1.0)), ("p10", bmc.Beta(1.0, 1.0)),
                        ("mu0", bmc.Normal(0.0, 2.0)), ("mu1", bmc.Normal(0.0, 2.0)),
                        ("sigma", bmc.HalfNormal(2.0))):  # fmt: skip
        dbn.add_static(name, prior)
    for k in range(1, 5):
        dbn.add_static(f"phi{k}", bmc.Normal(0.0, 1.0))
        dbn.input(f"y{k}")

    def to(state: Any, p00: Any, p10: Any) -> Any:
        return bmc.Bernoulli(np.where(state == 1, 1 - p10, 1 - p00))

    def lasting(p00: Any, p10: Any) -> Any:
        return bmc.Bernoulli((1 - p00) / (1 - p00 + p10))

    def chained(older: str) -> Callable[..., Any]:
        source = f"lambda {older}, p00, p10: to({older}, p00, p10)"
        return eval(source, {"to": to})  # type: ignore[no-any-return]

    dbn.add("s", to, ["s_prev", "p00", "p10"], initial=chained("s1"))
    for k in range(1, 5):
        start = lasting if k == 4 else chained(f"s{k + 1}")
        before = "s_prev" if k == 1 else f"s{k - 1}_prev"
        dbn.add(f"s{k}", lambda value: value, [before], initial=start)
    own = [f"{n}{k}" for n in ("s", "y", "phi") for k in range(1, 5)]

    def y(s: Any, mu0: Any, mu1: Any, sigma: Any, *rest: Any) -> Any:
        states, rows, phis = rest[:4], rest[4:8], rest[8:]
        mean = np.where(s == 1, mu1, mu0)
        for state, row, phi in zip(states, rows, phis, strict=True):
            mean = mean + phi * (row - np.where(state == 1, mu1, mu0))
        return bmc.Normal(mean, sigma)

    dbn.add("y", y, ["s", "mu0", "mu1", "sigma", *own])
    inputs = {f"y{k}": growth[4 - k : len(growth) - k] for k in range(1, 5)}
    return dbn, {"y": growth[4:]}, inputs, None


def volatility() -> tuple[Any, ...]:
    """Returns of the pound: stochastic volatility, on a grid."""
    folder = data_folder() / "statespace"
    lines = (folder / "GBP_vs_USD_9798.txt").read_text().splitlines()[2:]
    fields = [line.split() for line in lines]
    rate = np.array([float(f[3]) for f in fields if len(f) >= 4 and f[0].isdigit()])
    count = json.loads((folder / "gbp_sv.ref.json").read_text())["n_returns"]
    dbn = bmc.DynamicBayesNet("stochastic volatility")
    dbn.add_static("mu", bmc.Normal(0.0, 3.0))
    dbn.add_static("rho", bmc.Uniform(-1.0, 1.0))
    dbn.add_static("sigma", bmc.HalfNormal(1.0))

    @dbn.node(initial=lambda mu, rho, sigma: bmc.Normal(mu, sigma / np.sqrt(1 - rho**2)))
    def x(x_prev: Any, mu: Any, rho: Any, sigma: Any) -> Any:
        return bmc.Normal(mu + rho * (x_prev - mu), sigma)

    dbn.add("r", lambda x: bmc.Normal(0.0, np.exp(x / 2)))
    rows = 100 * np.diff(np.log(rate))[:count]
    return dbn, {"r": rows}, None, bmc.GridFilter({"x": (-8, 5, 150)})


MODELS = {"airline": airline, "arma": arma, "hamilton": hamilton, "volatility": volatility}


def main(names: list[str]) -> None:
    rows = []
    for name in names or MODELS:
        if name not in MODELS:
            raise SystemExit(f"there is no model {name!r}; there are {', '.join(MODELS)}")
        dbn, data, inputs, engine = MODELS[name]()
        start = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = bmc.fit(dbn, data, inputs=inputs, engine=engine)
        spent = time.process_time() - start
        ends = ", ".join(f"{end:.3f}" for end in found.climbs)
        rows.append([name, f"{found.log_likelihood:.6f}", f"{spent:.1f}", ends])
    header = ["model", "log likelihood", "processor time, s", "climbs ended at"]
    print(table("Fits of templates", header, rows))


if __name__ == "__main__":
    main(sys.argv[1:])
