"""Likelihood weighting beside hand-tuned NumPy and peers; its memory against the number of draws."""

from __future__ import annotations

import tracemalloc
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import bayesmc as bmc
from bayesmc.io.bif import parse_bif, read_text
from benchmarks import models
from benchmarks.floors import bif, lw_discrete, lw_hybrid
from benchmarks.harness import (
    DOES_NOT_COUNT,
    LW_BASELINE,
    Peer,
    interleave,
    network,
    peer_python,
    reached,
    table,
)

GOAL = 1.5


def main() -> None:
    """Print the comparison at 1e5 draws (peers too) and at 1e6, then the memory."""
    warnings.simplefilter("ignore")
    print(_compare(100_000, peers=True))
    print(_compare(1_000_000, peers=False))
    print(_memory())


def _compare(draws: int, peers: bool) -> str:
    path = network("alarm")
    records = bif.read(path)
    nodes, codes = bif.as_arrays(records), bif.codes(records, models.ALARM_EVIDENCE)
    seeds = iter(range(10**6))
    read = bmc.io.read(path)
    functions = models.alarm_functions(bmc, parse_bif(read_text(path)))
    hybrid = models.declare(bmc)
    entries: dict[str, Any] = {
        "floor": lambda: lw_discrete.likelihood_weighting(
            nodes, codes, draws, next(seeds), uniforms="float32"
        ),
        "floor, 32-bit integers": lambda: lw_discrete.likelihood_weighting(
            nodes, codes, draws, next(seeds)
        ),
        "bayesmc, ALARM from BIF": _ours(read, models.ALARM_EVIDENCE, draws, seeds),
        "bayesmc, ALARM as functions": _ours(functions, models.ALARM_EVIDENCE, draws, seeds),
        "hybrid floor": lambda: lw_hybrid.likelihood_weighting(draws, next(seeds)),
        "bayesmc, hybrid net": _ours(hybrid, models.EVIDENCE, draws, seeds),
    }
    with ExitStack() as stack:
        if peers and peer_python() is not None:
            for job in LW_BASELINE:
                entries[job] = stack.enter_context(Peer(job, path, draws)).timed(
                    models.ALARM_EVIDENCE
                )
        times = interleave(entries, repeats=7)
    medians = {name: time.median for name, time in times.items()}
    rows = [_row(name, medians, draws) for name in medians]
    header = ["", "ms", "over its floor", "goal", "pgmpy / it", "pyAgrum / it", ""]
    return table(f"likelihood weighting, {draws} draws, 5 evidence nodes", header, rows) + "\n"


def _row(name: str, medians: dict[str, float], draws: int) -> list[object]:
    floor = medians["hybrid floor" if "hybrid" in name else "floor"]
    over = medians[name] / floor
    ratios: list[object] = [
        medians[peer] / medians[name] if peer in medians and "hybrid" not in name else ""
        for peer in LW_BASELINE
    ]
    note = ""
    if name.startswith("floor"):
        missed = [
            peer
            for peer, wanted in LW_BASELINE.items()
            if peer in medians and not reached(medians[name], medians[peer], wanted)
        ]
        note = DOES_NOT_COUNT if missed else ""
    goal: object = GOAL if name.startswith("bayesmc") else ""
    return [name, 1e3 * medians[name], over, goal, *ratios, note]


def _ours(net: Any, evidence: Any, draws: int, seeds: Any) -> Callable[[], object]:
    engine = bmc.LikelihoodWeighting(draws)
    return lambda: bmc.infer(net, evidence, engine=engine, rng=next(seeds), keep="summaries")


def _memory() -> str:
    net = bmc.io.read(network("alarm"))
    rows: list[list[object]] = []
    for draws in (10_000, 100_000, 1_000_000):
        row: list[object] = [draws]
        for keep in ("summaries", "draws"):
            tracemalloc.start()
            bmc.infer(
                net, models.ALARM_EVIDENCE, engine=bmc.LikelihoodWeighting(draws), rng=0, keep=keep
            )
            row.append(tracemalloc.get_traced_memory()[1] / 2**20)
            tracemalloc.stop()
        rows.append(row)
    header = ["draws", 'keep="summaries"', 'keep="draws"']
    return table("peak memory of one call on ALARM, MiB", header, rows) + "\n"


if __name__ == "__main__":
    main()
