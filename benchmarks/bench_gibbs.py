"""Gibbs sampling beside code written by hand, JAGS and PyMC.

``python -m benchmarks.bench_gibbs`` takes the comparators' cheap sizes; ``--long`` adds JAGS at 1e4
points (minutes) and PyMC where it is slow, ``--cold`` lets PyMC compile everything anew. What a
user waits for is in ``bench_waiting``. A figure of bayesmc per sweep is
the slope between a shorter and a longer call: what a call costs once is printed beside it.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

import bayesmc as bmc
from benchmarks import bench_waiting, models, models_gibbs
from benchmarks.floors import bif, gibbs_discrete, gibbs_ising, gibbs_mixture
from benchmarks.harness import (
    DOES_NOT_COUNT,
    HERE,
    SelfTimed,
    Timing,
    Worker,
    data_folder,
    interleave,
    network,
    peer_python,
    reached,
    table,
)
from benchmarks.peers import jags_run

GOAL = 1.5
SIZES = {1_000: 500, 10_000: 150, 100_000: 25}  # points to sweeps timed
CHAINS, SECONDS = 256, 2.0
GRID, GRID_SWEEPS = 256, 50
BUDGET = 4.0  # seconds for one entry of a table

# Peer time over floor time, from the baselines.
FUSED_MIXTURE = {1_000: 0.026 / 0.10, 10_000: 0.30 / 0.53, 100_000: 3.3 / 4.6}
JAGS_MIXTURE = {1_000: 2.1 / 0.10, 10_000: 101 / 0.53}
FUSED_DISCRETE, JAGS_DISCRETE = 26 / 135, 311 / 135
FUSED_ISING, SIMPLE_ISING = 20 / 30, 96 / 30


def main(arguments: Sequence[str] = ()) -> None:
    """Print every comparison; what is not installed is left out and named."""
    warnings.simplefilter("ignore")
    long = "--long" in arguments
    if not jags_run.installed():
        print("no program `jags` (Debian package jags): its figures are left out\n")
    with ExitStack() as stack:
        fused = _fused(stack)
        for size, sweeps in SIZES.items():
            print(_mixture(size, sweeps, fused, long) + "\n", flush=True)
        if data_folder().exists():
            print(_discrete(fused) + "\n", flush=True)
        print(_ising(fused) + "\n", flush=True)
    print(_overhead() + "\n", flush=True)
    bench_waiting.main(arguments)


class Fused(Worker):
    """The samplers fused by numba, in the peers' environment."""

    def __init__(self, python: Any) -> None:
        command = [str(python), "-m", "benchmarks.floors.gibbs_fused"]
        super().__init__("the fused samplers", command, cwd=HERE.parent)

    def timed(self, job: str, size: int, sweeps: int) -> SelfTimed:
        """An entry for ``interleave``; the first call compiles and is not counted."""
        self.seconds(job, size, 1)
        return SelfTimed(lambda: self.seconds(job, size, sweeps))

    def seconds(self, job: str, size: int, sweeps: int) -> float:
        """Seconds for so many sweeps. ``RuntimeError`` where there is no numba."""
        return float(self.ask(job=job, size=size, sweeps=sweeps)["seconds"])


def _fused(stack: ExitStack) -> Fused | None:
    python = peer_python()
    if python is None:
        print("no peers installed: run `make peers` to have the fused samplers and PyMC beside\n")
        return None
    fused = stack.enter_context(Fused(python))
    try:
        fused.seconds("ising", 16, 1)
    except RuntimeError as error:
        print(f"{error}\n")
        return None
    return fused


def _mixture(size: int, sweeps: int, fused: Fused | None, long: bool) -> str:
    points = models_gibbs.mixture_points(size)
    tuned, plain = gibbs_mixture.Tuned(points, 1), gibbs_mixture.Plain(points, 2)
    tuned.run(20), plain.run(20)
    entries: dict[str, Any] = {
        "floor": lambda: tuned.run(sweeps),
        "plain NumPy": lambda: plain.run(sweeps),
    }
    if fused is not None:
        entries["numba"] = fused.timed("mixture", size, sweeps)
    if hasattr(bmc, "Gibbs"):
        net, evidence = models_gibbs.mixture(bmc, size), {"x": points}
        entries |= _calls(
            lambda s: bmc.Gibbs(draws=s, warmup=1, chains=1), sweeps, net, evidence, ["mean"]
        )
    per_sweep, once = _per_sweep(interleave(entries, repeats=5, budget=BUDGET), sweeps)
    if jags_run.installed() and (size == 1_000 or (long and size == 10_000)):
        per_sweep["JAGS"], once["JAGS"] = _mixture_jags(points, 300 if size == 1_000 else 30)
    baselines = {"numba": FUSED_MIXTURE[size], "JAGS": JAGS_MIXTURE.get(size, 0.0)}
    rows = [
        [name, 1e3 * s, 1e9 * s / size, once.get(name, ""), *_judged(name, per_sweep, baselines)]
        for name, s in per_sweep.items()
    ]
    header = ["", "s per 1,000 sweeps", "ns per point", "once, s", "over floor", "baseline", ""]
    return table(f"Gaussian mixture, K=3, D=2, {size} points, one chain", header, rows)


def _mixture_jags(points: np.ndarray, sweeps: int) -> tuple[float, float]:
    prior = models_gibbs.MIXTURE_PRIOR
    data = {
        "x": points,
        "n": len(points),
        "alpha": np.full(3, prior.concentration),
        "zero": np.zeros(2),
        "prior.precision": np.eye(2) / prior.variance,
        "scatter": prior.scatter * np.eye(2),
        "df": prior.df,
    }
    run = jags_run.run(
        jags_run.packaged("mixture"),
        data,
        ["mean"],
        chains=1,
        warmup=1,
        draws=sweeps,
        starts={"mean": np.array(models_gibbs.MIXTURE_START)},
    )
    return run.sampling / sweeps, run.seconds - run.sampling


def _discrete(fused: Fused | None) -> str:
    records = bif.read(network("alarm"))
    nodes, evidence = bif.as_arrays(records), bif.codes(records, models.ALARM_EVIDENCE)
    net = bmc.io.read(network("alarm"))
    hidden = [name for name in net if name not in evidence]
    updates = CHAINS * len(hidden)
    sweeps = 128
    floors = {
        "floor": gibbs_discrete.Multiplied(nodes, evidence, CHAINS, 1),
        "tabulated by colour": gibbs_discrete.Tabulated(nodes, evidence, CHAINS, 2),
    }
    entries: dict[str, Any] = {
        name: (lambda floor=floor: floor.run(sweeps)) for name, floor in floors.items()
    }
    if fused is not None:
        entries["numba"] = fused.timed("discrete", 1, sweeps * CHAINS)
    if hasattr(bmc, "Gibbs"):
        entries |= _calls(
            lambda s: bmc.Gibbs(draws=s, warmup=1, chains=CHAINS),
            sweeps,
            net,
            models.ALARM_EVIDENCE,
            "summaries",
        )
    per_sweep, once = _per_sweep(interleave(entries, repeats=5, budget=BUDGET), sweeps)
    exact = bmc.infer(net, models.ALARM_EVIDENCE, engine=bmc.Exact())
    wanted = {name: exact.probabilities(name) for name in hidden}
    errors = {
        name: _floor_error(type(floor), nodes, evidence, wanted) for name, floor in floors.items()
    }
    if "bayesmc" in per_sweep:
        errors["bayesmc"] = _own_error(net, per_sweep["bayesmc"], wanted)
    if jags_run.installed():
        one, once["JAGS"], errors["JAGS"] = _discrete_jags(nodes, evidence, wanted)
        per_sweep["JAGS"] = one * CHAINS
    baselines = {"numba": FUSED_DISCRETE, "JAGS": JAGS_DISCRETE}
    rows = [
        [
            name,
            1e9 * s / updates,
            once.get(name, ""),
            errors.get(name, ""),
            *_judged(name, per_sweep, baselines),
        ]
        for name, s in per_sweep.items()
    ]
    header = ["", "ns per update", "once, s", f"error, {SECONDS:g} s", "over floor", "baseline", ""]
    return table(
        f"discrete Gibbs on ALARM, 5 evidence nodes, {CHAINS} chains (numba and JAGS: one)",
        header,
        rows,
    )


def _floor_error(
    kind: Callable[..., Any], nodes: Any, evidence: Any, wanted: Mapping[str, np.ndarray]
) -> float:
    sampler = kind(nodes, evidence, CHAINS, 3)
    start = time.perf_counter()
    while time.perf_counter() - start < SECONDS:
        sampler.run(64)
    found = dict(zip(sampler.net.names, sampler.counts.marginals(), strict=True))
    return _largest(found, wanted)


def _own_error(net: Any, per_sweep: float, wanted: Mapping[str, np.ndarray]) -> float:
    engine = bmc.Gibbs(draws=int(SECONDS / per_sweep), warmup=0, chains=CHAINS)
    posterior = bmc.infer(net, models.ALARM_EVIDENCE, engine=engine, rng=3, keep="summaries")
    return _largest({name: posterior.probabilities(name) for name in wanted}, wanted)


def _discrete_jags(
    nodes: Any, evidence: Any, wanted: Mapping[str, np.ndarray]
) -> tuple[float, float, float]:
    """Seconds per sweep, seconds besides, and the largest error of what two seconds give."""
    text, data = jags_run.network_model(nodes, evidence)
    trial = jags_run.run(text, data, list(wanted), chains=1, warmup=1, draws=20_000, thin=100)
    draws = int(SECONDS / trial.sampling * 20_000)
    run = jags_run.run(text, data, list(wanted), chains=1, warmup=1, draws=draws, thin=10)
    found = {
        name: np.bincount(run.draws[name].astype(int).ravel() - 1, minlength=len(p))
        / run.draws[name].size
        for name, p in wanted.items()
    }
    return run.sampling / draws, run.seconds - run.sampling, _largest(found, wanted)


def _largest(found: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]) -> float:
    return max(float(np.abs(found[name] - p).max()) for name, p in wanted.items())


def _ising(fused: Fused | None) -> str:
    coupling, field = models_gibbs.COUPLING, models_gibbs.FIELD
    parity = gibbs_ising.Parity(GRID, coupling, field, 1)
    spins = np.ones((GRID, GRID), int)
    entries: dict[str, Any] = {
        "floor": lambda: parity.run(GRID_SWEEPS),
        "simple NumPy": lambda: gibbs_ising.checkerboard(spins, coupling, field, GRID_SWEEPS, 2),
    }
    if fused is not None:
        entries["numba"] = fused.timed("ising", GRID, GRID_SWEEPS)
    if hasattr(bmc, "Gibbs") and hasattr(bmc, "FactorGraph"):
        graph = models_gibbs.ising(bmc, GRID)
        entries |= _calls(
            lambda s: bmc.Gibbs(draws=1, warmup=0, chains=1, thinning=s),
            GRID_SWEEPS,
            graph,
            None,
            "draws",
        )
    per_sweep, once = _per_sweep(interleave(entries, repeats=5, budget=BUDGET), GRID_SWEEPS)
    baselines = {"numba": FUSED_ISING, "simple NumPy": SIMPLE_ISING}
    rows = [
        [
            name,
            1e3 * GRID_SWEEPS * s,
            1e9 * s / GRID**2,
            once.get(name, ""),
            *_judged(name, per_sweep, baselines),
        ]
        for name, s in per_sweep.items()
    ]
    header = ["", f"ms, {GRID_SWEEPS} sweeps", "ns per site", "once, s"]
    header += ["over floor", "baseline", ""]
    return table(f"Ising {GRID}x{GRID}, one chain", header, rows)


def _overhead() -> str:
    if not hasattr(bmc, "Gibbs"):
        return "no bmc.Gibbs: the overhead of a sweep is not timed"
    net, evidence = models_gibbs.ten_scalars(bmc)
    sweeps = 400
    entries = _calls(
        lambda s: bmc.Gibbs(draws=s, warmup=100, chains=4), sweeps, net, evidence, "draws"
    )
    per_sweep, once = _per_sweep(interleave(entries, repeats=7), sweeps)
    row = [1e6 * per_sweep["bayesmc"], 1e5 * per_sweep["bayesmc"], once["bayesmc"]]
    header = ["model of 10 hidden scalars, 4 chains", "us per sweep", "us per node", "once, s"]
    return table("overhead of a sweep", header, [["bayesmc", *row]])


def _calls(
    engine: Callable[[int], Any], sweeps: int, net: Any, evidence: Any, keep: Any
) -> dict[str, Callable[[], object]]:
    """The two calls whose difference is ``2 * sweeps`` sweeps."""
    seeds = iter(range(10**6))

    def call(count: int) -> Callable[[], object]:
        return lambda: bmc.infer(net, evidence, engine=engine(count), rng=next(seeds), keep=keep)

    return {"bayesmc": call(sweeps), "bayesmc, three times": call(3 * sweeps)}


def _per_sweep(
    times: Mapping[str, Timing], sweeps: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds per sweep; and, for bayesmc, what a call costs besides."""
    medians = {name: time.median for name, time in times.items()}
    longer = medians.pop("bayesmc, three times", None)
    per_sweep = {name: median / sweeps for name, median in medians.items()}
    if longer is None:
        return per_sweep, {}
    per_sweep["bayesmc"] = (longer - medians["bayesmc"]) / (2 * sweeps)
    return per_sweep, {"bayesmc": medians["bayesmc"] - sweeps * per_sweep["bayesmc"]}


def _judged(
    name: str, per_sweep: Mapping[str, float], baselines: Mapping[str, float]
) -> list[object]:
    """Time over the floor's, what the baselines or the goal say, and whether the floor counts."""
    over = per_sweep[name] / per_sweep["floor"]
    if name == "bayesmc":
        return [over, f"goal {GOAL}"]
    if name == "floor":
        missed = [
            peer
            for peer, wanted in baselines.items()
            if peer in per_sweep and not reached(per_sweep["floor"], per_sweep[peer], wanted)
        ]
        return [over, "", f"{DOES_NOT_COUNT} ({', '.join(missed)})" if missed else ""]
    return [over, float(baselines[name]) if name in baselines else ""]


if __name__ == "__main__":
    main(sys.argv[1:])
