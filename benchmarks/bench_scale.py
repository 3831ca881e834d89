"""What size costs: declaring, validating and sampling 200 and 2,000 scalar nodes; importing."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial

import bayesmc as bmc
from benchmarks.harness import interleave, table


def main() -> None:
    """Print seconds for each size, and the import beside what it cannot avoid."""
    rows: list[list[object]] = []
    sizes = (200, 2_000)
    declaring = interleave({str(n): partial(declared, n) for n in sizes}, repeats=15, least=0.0)
    for count in sizes:
        rows.append(
            [
                count,
                declaring[str(count)].median,
                _median(partial(_valid, count)),
                _median(partial(_valid(count).sample, 1_000, rng=0)),
            ]
        )
    rows.append(["ratio", *(b / a for a, b in zip(rows[0][1:], rows[1][1:], strict=True))])  # type: ignore[operator]
    rows.append(["goal", "ratio 12", "2 s", "2 s"])
    header = ["nodes", "declare, s", "declare and validate, s", "1,000 draws, s"]
    print(table("size", header, rows) + "\n")
    base, own = _imports()
    difference = own - base
    print(
        table(
            "import, median of 20 processes",
            ["", "s"],
            [
                ["numpy, scipy.special", base],
                ["and bayesmc", own],
                ["difference (goal .35)", difference],
            ],
        )
    )


def declared(count: int) -> bmc.BayesNet:
    """A net of scalar nodes, each with two parents declared before it."""
    net = bmc.BayesNet()
    net.add("x0", bmc.Normal(0.0, 1.0))
    for i in range(1, count):
        net.add(f"x{i}", _mean_of, parents=[f"x{i - 1}", f"x{max(i - 7, 0)}"])
    return net


def _mean_of(a, b):  # noqa: ANN001, ANN202
    return bmc.Normal(0.5 * a + 0.1 * b, 1.0)


def _valid(count: int) -> bmc.BayesNet:
    net = declared(count)
    net.validate()
    return net


def _median(work: Callable[[], object], repeats: int = 5) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def _imports() -> tuple[float, float]:
    """Medians of 20 interleaved processes each, with byte code cached as from the second start on."""
    commands = ("import numpy, scipy.special", "import numpy, scipy.special, bayesmc")
    times: list[list[float]] = [[], []]
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "PYTHONPYCACHEPREFIX": cache}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        for run in range(21):
            for kept, command in zip(times, commands, strict=True):
                start = time.perf_counter()
                subprocess.run([sys.executable, "-c", command], check=True, env=environment)
                if run:  # the first one compiles
                    kept.append(time.perf_counter() - start)
    return statistics.median(times[0]), statistics.median(times[1])


if __name__ == "__main__":
    main()
