"""How often the tests of the kit raise a false alarm: ``python -m tests.alarms``, a table of counts and
bounds.

Two-node nets with right samplers, at level .01; each test 10,000 times, those that simulate whole joint laws
1,000 times, with fresh seeds (``--seed`` repeats a run). The count of alarms may exceed the 99.9 % point
of the binomial law in one run of a thousand. The suite holds a small part of this (`tests/testing`).
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import secrets
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import scipy.special

import bayesmc as bmc
from bayesmc.errors import BayesmcWarning
from bayesmc.testing import (
    check_cpd,
    check_density,
    compare,
    detailed_balance,
    exact,
    geweke_test,
    invariant,
    rank_test,
    repeated_test,
    simulation_based_calibration,
    unbiased_evidence_test,
)

ALPHA = 0.01


@cache
def normal() -> bmc.BayesNet:
    net = bmc.BayesNet("normal")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    return net


@cache
def hybrid() -> bmc.BayesNet:
    net = bmc.BayesNet("hybrid")
    net.add("k", bmc.Categorical([0.3, 0.3, 0.4]))
    net.add("x", lambda k: bmc.Normal(1.5 * k, 1.0 + 0.5 * k))
    return net


@cache
def finite() -> bmc.BayesNet:
    net = bmc.BayesNet("finite")
    net.add("a", bmc.Categorical([0.2, 0.3, 0.5]))
    net.add("b", lambda a: bmc.Bernoulli(0.1 + 0.35 * a))
    return net


@cache
def answer(name: str) -> Any:
    net, evidence = ASKED[name]
    return exact(net(), evidence)


ASKED: dict[str, tuple[Callable[[], bmc.BayesNet], dict[str, Any]]] = {
    "normal": (normal, {"y": 0.8}),
    "hybrid": (hybrid, {}),
    "hybrid, seen": (hybrid, {"x": 1.3}),
}


def matches(engine: Any, name: str, **options: Any) -> Callable[[int], Any]:
    def one(seed: int) -> Any:
        net, evidence = ASKED[name]
        posterior = bmc.infer(net(), evidence, engine=engine, rng=seed)
        return compare(posterior, answer(name), ALPHA, rng=seed, **options)

    return one


def draw_x(state: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The exact full conditional."""
    return {"x": rng.normal(np.asarray(state["y"]) / 2, math.sqrt(0.5))}


def walk_x(state: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Metropolis, so that chains are correlated."""
    x, y = state["x"], state["y"]
    new = x + rng.normal(0.0, 1.5, np.shape(x))
    log = 0.5 * (x**2 + (y - x) ** 2 - new**2 - (y - new) ** 2)
    return {"x": np.where(np.log(rng.random(np.shape(x))) < log, new, x)}


def draw_a(state: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    share = np.array([0.1, 0.45, 0.8])
    weights = np.array([0.2, 0.3, 0.5]) * np.where(
        np.asarray(state["b"])[..., None], share, 1 - share
    )
    edges = np.cumsum(weights, axis=-1) / weights.sum(axis=-1, keepdims=True)
    return {"a": (rng.random((*weights.shape[:-1], 1)) > edges).sum(axis=-1)}


def estimate(rng: np.random.Generator) -> float:
    """Of the evidence of ``y = 0.8`` in `normal`, by four draws of the prior."""
    x = rng.normal(size=4)
    return float(
        scipy.special.logsumexp(-0.5 * (0.8 - x) ** 2) - math.log(4 * math.sqrt(2 * math.pi))
    )


def sample_x(evidence: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    return {"x": rng.normal(evidence["y"] / 2, math.sqrt(0.5), size=40)}


@dataclass(frozen=True)
class Case:
    """A test of a right sampler."""

    name: str
    runs: int
    one: Callable[[int], Any]


LOG_Z = -0.5 * 0.8**2 / 2 - 0.5 * math.log(4 * math.pi)
CASES = (
    Case("assert_matches, likelihood weighting", 10_000, matches(
        bmc.LikelihoodWeighting(1000), "hybrid, seen")),
    Case("assert_matches, independent draws", 10_000, matches(bmc.LikelihoodWeighting(500), "hybrid")),
    Case("assert_matches, chains", 10_000, matches(bmc.Gibbs(60, warmup=5, chains=4), "normal")),
    Case("assert_matches with draws", 10_000, matches(bmc.LikelihoodWeighting(400), "hybrid", draws=150)),
    Case("unbiased_evidence_test", 10_000, lambda s: unbiased_evidence_test(
        estimate, exact=LOG_Z, alpha=ALPHA, rng=s, replications=200)),
    Case("invariant, counted", 10_000, lambda s: invariant(
        draw_a, finite(), draws=1000, batched=True, alpha=ALPHA, rng=s)),
    Case("detailed_balance, counted", 10_000, lambda s: detailed_balance(
        draw_a, finite(), draws=1000, batched=True, alpha=ALPHA, rng=s)),
    Case("check_density", 10_000, lambda s: check_density(bmc.Gamma(2.5, 1.5), alpha=ALPHA, rng=s)),
    Case("check_cpd", 10_000, lambda s: check_cpd(hybrid(), "x", alpha=ALPHA, rng=s)),
    Case("geweke_test, independent", 1000, lambda s: geweke_test(
        draw_x, normal(), batched=True, alpha=ALPHA, rng=s)),
    Case("geweke_test, correlated", 1000, lambda s: geweke_test(
        walk_x, normal(), batched=True, alpha=ALPHA, rng=s)),
    Case("geweke_test, Metropolis-Hastings", 1000, lambda s: geweke_test(
        bmc.MetropolisHastings(proposal={"x": lambda x: bmc.Normal(x, 1.0)}), normal(), draws=50,
        alpha=ALPHA, rng=s)),
    Case("rank_test", 1000, lambda s: rank_test(walk_x, normal(), batched=True, alpha=ALPHA, rng=s)),
    Case("rank_test, Gibbs", 1000, lambda s: rank_test(bmc.Gibbs(), finite(), alpha=ALPHA, rng=s)),
    Case("rank_test, sequential", 1000, lambda s: rank_test(
        walk_x, normal(), batched=True, alpha=ALPHA, stages=4, replications=400, rng=s)),
    Case("simulation_based_calibration", 1000, lambda s: simulation_based_calibration(
        sample_x, normal(), alpha=ALPHA, rng=s, replications=100)),
    Case("simulation_based_calibration, Gibbs", 1000, lambda s: simulation_based_calibration(
        bmc.Gibbs(20, warmup=5, chains=4), normal(), alpha=ALPHA, rng=s, replications=40)),
    Case("repeated_test", 10_000, lambda s: repeated_test(
        lambda rng: math.exp(estimate(rng)), math.exp(LOG_Z), alpha=ALPHA, rng=s)),
)  # fmt: skip


def bound(runs: int) -> int:
    """The 99.9 % point of the binomial law of false alarms."""
    counts = np.arange(runs + 1)
    return int(np.searchsorted(scipy.special.bdtr(counts, runs, ALPHA), 0.999))


def alarms(case: Case, seeds: list[int]) -> int:
    """How many of these runs raise an alarm."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BayesmcWarning)
        return sum(bool(case.one(seed).rejected) for seed in seeds)


def _batch(job: tuple[int, list[int]]) -> int:
    return alarms(CASES[job[0]], job[1])


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 1 where a count is beyond its bound."""
    parser = argparse.ArgumentParser(prog="python -m tests.alarms", description=__doc__)
    parser.add_argument("--only", default="", help="cases whose names hold this")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--share", type=float, default=1.0, help="of the runs")
    parser.add_argument("--seed", type=int, default=secrets.randbits(31))
    asked = parser.parse_args(arguments)
    print(f"level {ALPHA:g}, seed {asked.seed}")
    print(f"{'test':<40} {'runs':>6} {'alarms':>6} {'bound':>6} {'ms per run':>10}", flush=True)
    fine = True
    with multiprocessing.get_context("fork").Pool(asked.jobs) as pool:
        for number, case in enumerate(CASES):
            if asked.only not in case.name:
                continue
            runs = max(int(case.runs * asked.share), 1)
            words = np.random.SeedSequence([asked.seed, number]).generate_state(runs, np.uint64)
            seeds = [int(word) for word in words]
            start = time.perf_counter()
            count = sum(pool.map(_batch, [(number, seeds[k::50]) for k in range(50)], chunksize=1))
            each = (time.perf_counter() - start) / runs * 1e3
            fine &= count <= bound(runs)
            print(
                f"{case.name:<40} {runs:>6} {count:>6} {bound(runs):>6} {each:>10.1f}", flush=True
            )
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
