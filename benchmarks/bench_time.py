"""Filters beside loops written by hand, the same fused by numba, ``particles`` and FilterPy.

``python -m benchmarks.bench_time``; ``--short`` leaves out a million particles, takes a tenth of the
online steps and repeats less. Every
figure of bayesmc is a whole call, reading the series included; templates are compiled once before,
as they are for a user who filters one series after another.
"""

from __future__ import annotations

import resource
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import numpy as np

import bayesmc as bmc
from benchmarks import models_time
from benchmarks.floors import hmm, kalman, particle
from benchmarks.harness import (
    DOES_NOT_COUNT,
    HERE,
    SelfTimed,
    Timing,
    Worker,
    interleave,
    peer_python,
    reached,
    table,
)

PARTICLES = {1_000: 100, 10_000: 100, 100_000: 100, 1_000_000: 10}  # to slices filtered
MORE_STATES = (1_000, 10_000, 100_000)
HMM_STEPS, SEQUENCES, BATCHED_STEPS, KALMAN_STEPS = 100_000, 64, 10_000, 10_000
CHAINS = {10: 100, 100: 50, 1_000: 20}  # slices to sweeps timed
ONLINE_STEPS, ONLINE_PARTICLES = 100_000, 100
BUDGET = 4.0  # seconds for one entry of a table

GOAL_PARTICLE, GOAL_EXACT = 1.5, 1.25
FAST, GOAL_FAST = "bayesmc[fast]", 1.2
GOAL_BATCHED, GOAL_CHAIN, GOAL_FILTERPY = 8.0, 20.0, 4.0
GOAL_PEER = {1_000: 3.0, 10_000: 1.6, 100_000: 1.6, 1_000_000: 1.6}

# Time over that of the loop in NumPy, from the baselines.
FUSED_PARTICLE = {1_000: 1 / 2.2, 10_000: 1 / 1.27, 100_000: 1 / 1.23, 1_000_000: 1 / 1.40}
PEER_PARTICLE = {
    1_000: 10.4 / 2.2,
    10_000: 3.7 / 1.27,
    100_000: 3.0 / 1.23,
    1_000_000: 3.4 / 1.40,
}
FUSED_HMM, FUSED_KALMAN, PEER_KALMAN = 13 / 519, 3.1 / 367, 2_020 / 367


def main(arguments: Sequence[str] = ()) -> None:
    """Print every comparison; what is not installed or not there yet is left out and named."""
    warnings.simplefilter("ignore")
    short = "--short" in arguments
    repeats = 3 if short else 5
    with ExitStack() as stack:
        peers = {name: _asked(stack, name) for name in _MODULES}
        for count, steps in PARTICLES.items():
            if not (short and count > 100_000):
                print(_growth(count, steps, peers, repeats) + "\n", flush=True)
        for name in ("trend", "lorenz"):
            print(_more_states(name, repeats) + "\n", flush=True)
        print(_hmm(peers, repeats) + "\n", flush=True)
        print(_batched(repeats) + "\n", flush=True)
        print(_kalman(peers, repeats) + "\n", flush=True)
    print(_smoothing(repeats) + "\n", flush=True)
    print(_online(ONLINE_STEPS // 10 if short else ONLINE_STEPS), flush=True)


class Filters(Worker):
    """A process of the peers' environment that filters what ``models_time`` simulates."""

    def __init__(self, python: Any, module: str) -> None:
        super().__init__(f"the process of {module}", [str(python), "-m", module], cwd=HERE.parent)

    def timed(self, **question: Any) -> SelfTimed:
        """An entry for ``interleave``; the first run compiles and is not counted."""
        self.ask(**question)
        return SelfTimed(lambda: float(self.ask(**question)["seconds"]))


_MODULES = {
    "numba": "benchmarks.floors.filters_fused",
    "particles": "benchmarks.peers.particles_run",
    "FilterPy": "benchmarks.peers.filterpy_run",
}
_TRIALS = {
    "numba": {"job": "growth", "steps": 3, "particles": 10},
    "particles": {"steps": 3, "particles": 10, "seed": 1},
    "FilterPy": {"steps": 3},
}


def _asked(stack: ExitStack, name: str) -> Filters | None:
    python = peer_python()
    if python is None:
        return None
    worker = stack.enter_context(Filters(python, _MODULES[name]))
    try:
        worker.ask(**_TRIALS[name])
    except RuntimeError as error:
        print(f"{error}\n")
        return None
    return worker


def _growth(count: int, steps: int, peers: Mapping[str, Filters | None], repeats: int) -> str:
    y, seeds = models_time.growth_series(steps), iter(range(10**6))
    entries: dict[str, Any] = {"floor": lambda: particle.growth(y, count, next(seeds))}
    question = {"steps": steps, "particles": count, "seed": 1}
    for name, more in (("numba", {"job": "growth"}), ("particles", {})):
        worker = peers[name]
        if worker is not None:
            entries[name] = worker.timed(**question, **more)
    if hasattr(bmc, "ParticleFilter"):
        entries |= _filters("growth", {"y": y}, count)
    times = interleave(entries, repeats, budget=BUDGET)
    baselines = {"numba": FUSED_PARTICLE[count], "particles": PEER_PARTICLE[count]}
    rows = _judged(times, baselines, GOAL_PARTICLE, count * (steps + 1))
    if {"particles", "bayesmc"} <= times.keys():
        gained = times["particles"].median / times["bayesmc"].median
        rows.append(["particles over bayesmc", "", "", gained, f"goal {GOAL_PEER[count]}"])
    if {"numba", FAST} <= times.keys():
        ratio = times[FAST].median / times["numba"].median
        rows.append([f"{FAST} over numba", "", "", ratio, f"goal {GOAL_FAST}"])
    return table(
        f"particle filter, benchmark of de Freitas, {count} particles, {steps} slices",
        ["", "ms", "ns per particle and slice", "over floor", "baseline", ""],
        rows,
    )


def _more_states(name: str, repeats: int) -> str:
    """The floor is the loop of the benchmark's table around another model."""
    steps, rows = 100, []
    y = getattr(models_time, f"{name}_series")(steps)
    for count in MORE_STATES:
        seeds = iter(range(10**6))
        entries: dict[str, Any] = {
            "floor": lambda n=count, s=seeds: getattr(particle, name)(y, n, next(s))
        }
        if hasattr(bmc, "ParticleFilter"):
            entries |= _filters(name, {"y": y}, count)
        times = interleave(entries, repeats, budget=BUDGET)
        for found in _judged(times, {}, GOAL_PARTICLE, count * steps):
            rows.append([f"{found[0]}, {count} particles", *found[1:]])
    title = {"trend": "three scalar states", "lorenz": "one state that is a 3-vector"}[name]
    header = ["", "ms", "ns per particle and slice", "over floor", "baseline", ""]
    return table(f"particle filter, {title}, {steps} slices", header, rows)


def _filters(name: str, observations: Mapping[str, Any], count: int) -> dict[str, Any]:
    """In NumPy and, where there is a compiler, as machine code."""
    found = {"bayesmc": _call(name, observations, bmc.ParticleFilter(count, compiled=False))}
    if find_spec("llvmlite") is not None:
        found[FAST] = _call(name, observations, bmc.ParticleFilter(count, compiled=True))
    return found


def _hmm(peers: Mapping[str, Filters | None], repeats: int) -> str:
    y, numbers = models_time.hmm_series(HMM_STEPS), models_time.hmm_numbers()
    entries: dict[str, Any] = {"floor": lambda: hmm.filtered(y, *numbers)}
    worker = peers["numba"]
    if worker is not None:
        entries["numba"] = worker.timed(job="hmm", steps=HMM_STEPS)
    if hasattr(bmc, "DiscreteFilter"):
        entries["bayesmc"] = _call("hmm", {"y": y}, bmc.DiscreteFilter())
    times = interleave(entries, repeats, budget=BUDGET)
    return table(
        f"filter of a hidden Markov model, {models_time.STATES} states, {HMM_STEPS} slices",
        ["", "ms", "ns per slice", "over floor", "baseline", ""],
        _judged(times, {"numba": FUSED_HMM}, GOAL_EXACT, HMM_STEPS),
    )


def _batched(repeats: int) -> str:
    if not hasattr(bmc, "DiscreteFilter"):
        return "no bmc.DiscreteFilter: sequences side by side are not timed"
    entries = {}
    for sequences in (1, SEQUENCES):
        y = models_time.hmm_series(BATCHED_STEPS, sequences)
        dbn = models_time.hmm(bmc, sequences)
        entries[str(sequences)] = _run(dbn, {"y": y}, bmc.DiscreteFilter())
    times = interleave(entries, repeats, budget=BUDGET)
    one = times["1"].median
    rows = [
        [name, 1e3 * time.median, time.median / one, "" if k == 0 else f"goal {GOAL_BATCHED}"]
        for k, (name, time) in enumerate(times.items())
    ]
    title = f"hidden Markov sequences in a plate, {BATCHED_STEPS} slices, bayesmc"
    return table(title, ["sequences", "ms", "over one", ""], rows)


def _kalman(peers: Mapping[str, Filters | None], repeats: int) -> str:
    m = models_time
    y = m.motion_series(KALMAN_STEPS)
    model = kalman.Linear(
        m.MOTION, m.MOTION_NOISE, m.SIGHT, m.SIGHT_NOISE, m.START_MEAN, m.START_COVARIANCE
    )
    entries: dict[str, Any] = {
        "floor": lambda: kalman.filtered(y, model),
        "plain NumPy": lambda: kalman.plain(y, model),
    }
    for name, question in (("numba", {"job": "kalman"}), ("FilterPy", {})):
        worker = peers[name]
        if worker is not None:
            entries[name] = worker.timed(steps=KALMAN_STEPS, **question)
    if hasattr(bmc, "KalmanFilter"):
        entries["bayesmc"] = _call("motion", {"y": y}, bmc.KalmanFilter())
    times = interleave(entries, repeats, budget=BUDGET)
    baselines = {"numba": FUSED_KALMAN, "FilterPy": PEER_KALMAN}
    rows = _judged(times, baselines, GOAL_EXACT, KALMAN_STEPS)
    if {"FilterPy", "bayesmc"} <= times.keys():
        gained = times["FilterPy"].median / times["bayesmc"].median
        rows.append(["FilterPy over bayesmc", "", "", gained, f"goal {GOAL_FILTERPY}"])
    return table(
        f"Kalman filter, state of 4 numbers, 2 measured, {KALMAN_STEPS} slices",
        ["", "ms", "ns per slice", "over floor", "baseline", ""],
        rows,
    )


def _smoothing(repeats: int) -> str:
    """A sweep is the slope between a shorter and a longer call; the rest is what a call costs once."""
    rows: list[list[object]] = []
    y = models_time.volatility_series(max(CHAINS))
    for name in ("chain", "volatility"):
        dbn = getattr(models_time, name)(bmc)
        shortest = 0.0
        for steps, sweeps in CHAINS.items():
            label = f"{name}, {steps} slices"
            net, evidence = dbn.unroll(steps), dbn.unrolled_evidence({"y": y[:steps]})
            calls = {k: _gibbs(net, evidence, k * sweeps) for k in (1, 5)}
            times = interleave(
                {"once": calls[1], "more": calls[5]}, repeats, budget=BUDGET, warmup=1
            )
            once, more = times["once"].median, times["more"].median
            sweep = (more - once) / (4 * sweeps)
            shortest = shortest or sweep
            goal = f"goal {GOAL_CHAIN}" if steps == max(CHAINS) else ""
            rows.append([label, 1e6 * sweep, once - sweeps * sweep, sweep / shortest, goal])
    header = ["", "us per sweep", "once, s", "over the short", ""]
    return table("Gibbs smoothing of an unrolled chain, bayesmc", header, rows)


def _online(steps: int) -> str:
    """Row by row: what a step costs, and whether the process grows."""
    dbn, engine = models_time.growth(bmc), bmc.ParticleFilter(ONLINE_PARTICLES)
    y = models_time.growth_series(1_000)[1:]
    belief = engine.start(dbn, rng=0)
    rows: list[list[object]] = []
    start = perf_counter()
    for k in range(steps):
        belief = engine.step(belief, {"y": y[k % len(y)]})
        if k + 1 in (steps // 100, steps // 2, steps):
            spent = perf_counter() - start
            rows.append([f"{k + 1} steps", 1e6 * spent / (k + 1), _resident()])
    header = ["", "us per step", "process, MiB"]
    return table(f"Online steps of a filter of {ONLINE_PARTICLES} particles", header, rows)


def _resident() -> float:
    """Memory that the process has now, where the system says so; else the most it ever had."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize() / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def _gibbs(net: Any, evidence: Mapping[str, Any], draws: int) -> Callable[[], object]:
    seeds, engine = iter(range(10**6)), bmc.Gibbs(draws=draws, warmup=1, chains=1)
    return lambda: bmc.infer(net, evidence, engine=engine, rng=next(seeds), progress=False)


def _call(name: str, observations: Mapping[str, np.ndarray], engine: Any) -> Callable[[], object]:
    return _run(getattr(models_time, name)(bmc), observations, engine)


def _run(dbn: Any, observations: Mapping[str, np.ndarray], engine: Any) -> Callable[[], object]:
    seeds = iter(range(10**6))
    return lambda: bmc.filter(dbn, observations, engine=engine, rng=next(seeds), progress=False)


def _judged(
    times: Mapping[str, Timing], baselines: Mapping[str, float], goal: float, size: int
) -> list[list[object]]:
    """Rows of a table: time, time per unit, over the floor's, and whether the floor counts."""
    medians = {name: time.median for name, time in times.items()}
    floor, rows = medians["floor"], []
    for name, median in medians.items():
        said: list[object] = [""]
        if name == "bayesmc":
            said = [f"goal {goal}"]
        elif name == FAST and not baselines:
            said = [f"goal {GOAL_FAST}"]
        elif name == "floor":
            missed = [p for p, w in baselines.items() if p in medians]
            missed = [p for p in missed if not reached(floor, medians[p], baselines[p])]
            said = ["", f"{DOES_NOT_COUNT} ({', '.join(missed)})" if missed else ""]
        elif name in baselines:
            said = [float(baselines[name])]
        rows.append([name, 1e3 * median, 1e9 * median / size, median / floor, *said])
    return rows


if __name__ == "__main__":
    main(sys.argv[1:])
