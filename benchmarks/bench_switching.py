"""``SwitchingKalmanFilter`` beside GPB2 by hand and FilterPy's IMM; expectation propagation by hand, too."""

from __future__ import annotations

import warnings
from contextlib import ExitStack
from typing import Any

import numpy as np

import bayesmc as bmc
from benchmarks import models_switching
from benchmarks.bench_time import Filters
from benchmarks.floors import propagation, switching
from benchmarks.harness import interleave, peer_python, table

STEPS, MODES = 2_000, 3
GOAL_FLOOR, GOAL_FILTERPY = 1.5, 20.0
SMOOTHED, SWEEPS = 300, (2, 6)


def main() -> None:
    """Print medians; every answer has means, covariances and modes of all slices."""
    warnings.simplefilter("ignore")
    y = models_switching.series(STEPS)
    dbn = models_switching.target(bmc)
    dbn.validate()
    rows = {"y": np.concatenate([np.full((1, 2), np.nan), y])}

    def ours(merging: Any) -> bmc.SeriesPosterior:
        return bmc.filter(dbn, rows, engine=bmc.SwitchingKalmanFilter(merging))

    by_hand = switching.gpb2(y)
    np.testing.assert_allclose(ours("gpb2").mean("x")[1:], by_hand.mean, atol=1e-8)
    entries: dict[str, Any] = {"by hand, GPB2": lambda: switching.gpb2(y)}
    entries |= {
        f"bayesmc, {rule}": lambda rule=rule: ours(rule) for rule in ("gpb2", "imm", "gpb1")
    }
    with ExitStack() as stack:
        python = peer_python()
        if python is not None:
            try:
                worker = stack.enter_context(Filters(python, "benchmarks.peers.filterpy_imm"))
                found = worker.ask(steps=STEPS)
                mean = ours("imm").mean("x")[-1]
                np.testing.assert_allclose(mean, found["mean"], atol=1e-6)
                entries["FilterPy, IMM"] = worker.timed(steps=STEPS)
            except RuntimeError as error:
                print(f"{error}\n")
        times = interleave(entries, 5, budget=4.0)
    floor = times["by hand, GPB2"].median
    lines: list[list[object]] = []
    for name, found in times.items():
        filters = MODES**2 if "gpb2" in name.lower() else MODES
        each = 1e6 * found.median / STEPS
        lines.append([name, each, each / filters, found.median / floor])
    ours_each = times["bayesmc, gpb2"].median / MODES**2
    lines.append(["goal for gpb2", "", "", GOAL_FLOOR])
    if "FilterPy, IMM" in times:
        gained = times["FilterPy, IMM"].median / MODES / ours_each
        lines.append(["FilterPy over gpb2, per filter", "", gained, f"goal {GOAL_FILTERPY}"])
    title = f"switching target, 4 numbers, {MODES} modes, {STEPS} slices"
    print(table(title, ["", "us per slice", "us per filter", "over by hand"], lines))
    print()
    sweeps()


def sweeps() -> None:
    """A sweep of expectation propagation: more of them less fewer, of the same series, without damping."""
    y, dbn = models_switching.series(SMOOTHED), models_switching.target(bmc)
    rows = {"y": np.concatenate([np.full((1, 2), np.nan), y])}

    def ours(count: int) -> bmc.SeriesPosterior:
        engine = bmc.ExpectationPropagation(count, damping=0.0, tolerance=1e-300)
        return bmc.smooth(dbn, rows, engine=engine)

    few, many = SWEEPS
    by_hand = propagation.propagated(y, few)
    np.testing.assert_allclose(ours(few).mean("x")[1:], by_hand.mean, atol=1e-8)
    entries: dict[str, Any] = {
        "Kim": lambda: bmc.smooth(dbn, rows, engine=bmc.SwitchingKalmanFilter())
    }
    for count in SWEEPS:
        entries[f"by hand, {count}"] = lambda count=count: propagation.propagated(y, count)
        entries[f"bayesmc, {count}"] = lambda count=count: ours(count)
    times = interleave(entries, 5, budget=6.0)
    found = {
        who: (times[f"{who}, {many}"].median - times[f"{who}, {few}"].median) / (many - few)
        for who in ("by hand", "bayesmc")
    }
    lines: list[list[object]] = []
    for who, one in found.items():
        begun = times[f"{who}, {few}"].median - few * one
        lines.append([f"a sweep, {who}", 1e6 * one / SMOOTHED, one / found["by hand"]])
        lines.append([f"before the first, {who}", 1e6 * begun / SMOOTHED, ""])
    kim = times["Kim"].median
    lines.append(["filter and Kim's smoother, bayesmc", 1e6 * kim / SMOOTHED, ""])
    title = f"expectation propagation, the same target, {MODES} modes, {SMOOTHED} slices"
    print(table(title, ["", "us per slice", "over by hand"], lines))


if __name__ == "__main__":
    main()
