"""Learning beside statsmodels, hmmlearn and pyAgrum: optima, standard errors, EM of tables with missing data.

``python -m benchmarks.bench_fit [CASES [whole]]``: ALARM's tables are learned from up to CASES cases (1,000;
with 10,000 some 10 minutes), and with ``whole`` the peer goes on until it ends (another hour). The
peers' environment is that of ``make peers``.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import bayesmc as bmc
from benchmarks import alarm_tables
from benchmarks.harness import data_folder, peer_answer, table


def local_level(initial: tuple[float, float], spread: float) -> bmc.DynamicBayesNet:
    """Variances of a walk and of its noise; priors only say where to start."""
    dbn = bmc.DynamicBayesNet("local level")
    dbn.add_static("drift", bmc.HalfNormal(spread))
    dbn.add_static("noise", bmc.HalfNormal(spread))
    dbn.add(
        "level",
        lambda level_prev, drift: bmc.Normal(level_prev, np.sqrt(drift)),
        initial=bmc.Normal(initial[0], np.sqrt(initial[1])),
    )
    dbn.add("y", lambda level, noise: bmc.Normal(level, np.sqrt(noise)))
    return dbn


def autoregression(initial: tuple[float, float], spread: float) -> bmc.DynamicBayesNet:
    """An AR(1) around 0, seen with noise."""
    dbn = bmc.DynamicBayesNet("AR(1)")
    dbn.add_static("drift", bmc.HalfNormal(spread))
    dbn.add_static("noise", bmc.HalfNormal(spread))
    dbn.add_static("slope", bmc.Normal(0.0, 1.0))
    dbn.add(
        "level",
        lambda level_prev, drift, slope: bmc.Normal(slope * level_prev, np.sqrt(drift)),
        initial=bmc.Normal(initial[0], np.sqrt(initial[1])),
    )
    dbn.add("y", lambda level, noise: bmc.Normal(level, np.sqrt(noise)))
    return dbn


def regimes(y: np.ndarray, before: bool) -> bmc.DynamicBayesNet:
    """Two normal regimes; the state of slice 0 is even, or (``before``) that of two slices before it."""
    dbn = bmc.DynamicBayesNet("regimes", plates={"regime": 2})
    dbn.add_static("rows", bmc.Dirichlet([2.0, 2.0]), plates="regime")
    dbn.add_static("mean", bmc.Normal(float(y.mean()), 2.0 * float(y.std())), plates="regime")
    dbn.add_static("var", bmc.HalfNormal(2.0 * float(y.var())), plates="regime")
    even = bmc.Categorical([0.5, 0.5])

    def two_later(rows: Any) -> bmc.Categorical:
        one = 0.5 * rows[0] + 0.5 * rows[1]
        return bmc.Categorical(one[..., :1] * rows[0] + one[..., 1:] * rows[1])

    dbn.add(
        "s",
        lambda s_prev, rows: bmc.Categorical(rows[s_prev]),
        initial=two_later if before else even,
    )
    dbn.add("y", lambda s, mean, var: bmc.Normal(mean[s], np.sqrt(var[s])))
    return dbn


def counts(y: np.ndarray) -> bmc.DynamicBayesNet:
    """Two Poisson regimes."""
    dbn = bmc.DynamicBayesNet("counts", plates={"regime": 2})
    dbn.add_static("rows", bmc.Dirichlet([2.0, 2.0]), plates="regime")
    dbn.add_static("rate", bmc.Exponential(1.0 / float(y.mean())), plates="regime")
    dbn.add(
        "s", lambda s_prev, rows: bmc.Categorical(rows[s_prev]), initial=bmc.Categorical([0.5, 0.5])
    )
    dbn.add("y", lambda s, rate: bmc.Poisson(rate[s]))
    return dbn


def main(cases: int = 1_000, whole: bool = False) -> None:
    """Print optima and errors beside the peers' (Kalman, hidden Markov), then ALARM's tables."""
    print(table("maximum likelihood of series", *_series()) + "\n", flush=True)
    alarm_tables.main(cases, whole)


# ---- private ------------------------------------------------------------------------------------


def _series() -> tuple[list[str], list[list[object]]]:
    rows: list[list[object]] = []
    for name, kind, y, initial in _linear():
        made = {"local level": local_level, "AR(1)": autoregression}[kind]
        found, seconds = _timed(
            lambda m=made, y=y, i=initial: bmc.fit(m(i, float(np.nanvar(y))), {"y": y})
        )
        peer = _ask({"job": "kalman", "kind": kind, "y": y.tolist(), "initial": initial})
        rows.append(
            _row(
                name, "statsmodels", found, seconds, peer, lambda n, f=found: float(f.std_errors[n])
            )
        )
    growth, yearly = _columns("us_rgnp_hamilton.csv", 1), _yearly()
    found, seconds = _timed(lambda: bmc.fit(regimes(growth, True), {"y": growth}))
    peer = _ask({"job": "switching", "y": growth.tolist()})
    rows.append(
        _row("GNP growth, 2 regimes", "statsmodels", found, seconds, peer, _regime_errors(found))
    )
    for name, kind, y, dbn in (
        ("GNP growth, 2 regimes", "normal", growth, regimes(growth, False)),
        ("coal, 2 rates", "poisson", yearly, counts(yearly)),
    ):
        found, seconds = _timed(lambda d=dbn, y=y: bmc.fit(d, {"y": y}))
        peer = _ask({"job": "hidden Markov", "kind": kind, "y": y.tolist()})
        rows.append(_row(name, "hmmlearn", found, seconds, peer, None))
    header = ["series", "peer", "log likelihood", "less peer's", "worst s.e. ratio", "s", "peer, s"]
    return header, rows


def _row(
    name: str,
    by: str,
    found: Any,
    seconds: float,
    peer: dict[str, Any] | None,
    errors: Callable | None,
) -> list[object]:
    own = f"{found.log_likelihood:.5f}"
    if peer is None:
        return [name, by, own, "", "", seconds, ""]
    ratio: object = ""
    if errors is not None:
        ratios = [errors(n) / e for n, e in peer["std_errors"].items() if e > 0]
        ratio = f"{max(ratios, key=lambda r: abs(np.log(r))):.4f}"
    return [
        name,
        by,
        own,
        f"{found.log_likelihood - peer['log_likelihood']:+.1e}",
        ratio,
        seconds,
        peer["seconds"],
    ]


def _regime_errors(found: Any) -> Callable[[str], float]:
    """By the names of statsmodels, whose regimes may stand the other way round."""
    low = int(np.argmin(found["mean"]))

    def error(name: str) -> float:
        where = {"0": low, "1": 1 - low}
        if name.startswith("p["):
            return float(found.std_errors["rows"][where[name[2]], low])
        what = {"const": "mean", "sigma2": "var"}[name.split("[")[0]]
        return float(found.std_errors[what][where[name[-2]]])

    return error


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = call()
    return found, time.perf_counter() - start


def _ask(question: Mapping[str, Any]) -> dict[str, Any] | None:
    return peer_answer("fit_run.py", question)


def _linear() -> list[tuple[str, str, np.ndarray, tuple[float, float]]]:
    nile = _columns("nile.csv", 1)
    macro = _columns("us_macrodata.csv", 12)[1:]
    gaps = nile.copy()
    gaps[20:40] = np.nan
    return [
        ("Nile, local level", "local level", nile, (1000.0, 250_000.0)),
        ("Nile with a gap", "local level", gaps, (1000.0, 250_000.0)),
        ("US inflation, local level", "local level", macro, (0.0, 100.0)),
        ("US inflation, AR(1)", "AR(1)", macro - macro.mean(), (0.0, 10.0)),
    ]


def _columns(file: str, column: int) -> np.ndarray:
    path = data_folder() / "statespace" / file
    return np.genfromtxt(path, delimiter=",", skip_header=1, usecols=column)


def _yearly() -> np.ndarray:
    found = json.loads((data_folder() / "statespace" / "coal.ref.json").read_text())
    return np.array(found["yearly_counts_1851_1962"])


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), whole="whole" in sys.argv[2:])
