"""``ParticleFilter(marginalize="auto")`` beside a Rao-Blackwellised filter by hand in NumPy."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

import bayesmc as bmc
from benchmarks import models_switching
from benchmarks.floors import rao_blackwell
from benchmarks.harness import interleave, table

STEPS, PARTICLES = 200, (100, 1_000, 10_000)
GOAL = 1.5  # at 1,000 particles


def main() -> None:
    """Print medians; every answer has means, variances, modes and increments of all slices."""
    warnings.simplefilter("ignore")
    y = models_switching.series(STEPS)
    dbn = models_switching.target(bmc)
    dbn.validate()
    rows = {"y": np.concatenate([np.full((1, 2), np.nan), y])}
    lines: list[list[object]] = []
    for count in PARTICLES:

        def ours(proposal: Any = None, count: int = count) -> bmc.SeriesPosterior:
            engine = bmc.ParticleFilter(count, marginalize="auto", proposal=proposal)
            return bmc.filter(dbn, rows, engine=engine, rng=0)

        entries: dict[str, Any] = {
            "by hand": lambda count=count: rao_blackwell.target(y, count, 0),
            "bayesmc": ours,
            'bayesmc, proposal="optimal"': lambda ours=ours: ours("optimal"),
        }
        times = interleave(entries, 5, budget=4.0)
        floor = times["by hand"].median
        for name, found in times.items():
            each = 1e3 * found.median / STEPS
            lines.append([f"{count:_}, {name}", each, found.median / floor])
    lines.append(["goal at 1_000, drawn from the model", "", GOAL])
    title = f"switching target, 4 numbers for each particle, {STEPS} slices"
    print(table(title, ["particles", "ms per slice", "over by hand"], lines))


if __name__ == "__main__":
    main()
