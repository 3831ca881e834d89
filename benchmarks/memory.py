"""Memory of long runs: ``python -m benchmarks.memory`` prints it at a tenth, a half and the end of each.

Memory of the process itself is counted (anonymous pages), not pages of files, which the system takes back.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.results import Sums
from bayesmc.storage import Saver


def anonymous() -> float:
    """MiB of this process that are no file's."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon"):
            return int(line.split()[1]) / 1024
    return float("nan")


class Watch:
    """Notes memory as a run passes some share of its way."""

    def __init__(self, total: int) -> None:
        self.total, self.at, self.found = total, 0, dict[float, float]()

    def advance(self, count: int = 1) -> None:
        self.at += count
        for share in (0.1, 0.5, 1.0):
            if share not in self.found and self.at >= share * self.total:
                self.found[share] = anonymous()


def net() -> bmc.BayesNet:
    made = bmc.BayesNet("rain")
    made.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    made.add("level", lambda rain: bmc.Normal(np.where(rain == "yes", 2.0, 0.0), 1.0))
    made.add("gauge", lambda level: bmc.Normal(level, 0.5))
    return made


def weighted(watch: Watch) -> None:
    plain = Sums.add

    def add(self: Sums, values: Any, log: Any, draws: int) -> None:
        plain(self, values, log, draws)
        watch.advance(draws)

    Sums.add = add  # type: ignore[method-assign]
    engine = bmc.LikelihoodWeighting(watch.total)
    bmc.infer(net(), {"gauge": 1.5}, engine=engine, rng=0, keep="summaries")
    Sums.add = plain  # type: ignore[method-assign]


def in_file(watch: Watch) -> None:
    plain = Saver.save

    def save(self: Saver, rows: Any, state: Any) -> None:
        plain(self, rows, state)
        watch.advance(rows["draws"])

    Saver.save = save  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.nc"
        engine = bmc.LikelihoodWeighting(watch.total)
        posterior = bmc.infer(
            net(), {"gauge": 1.5}, engine=engine, rng=0, keep="file", checkpoint=path
        )
        print(
            f"    {path.stat().st_size / watch.total:.1f} bytes of the file for each draw, "
            f"{anonymous():.0f} MiB with the posterior; mean {posterior['level'][0, :1000].mean():.2f}"
        )
    Saver.save = plain  # type: ignore[method-assign]


def online(watch: Watch) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    engine = bmc.ParticleFilter(100)
    belief, rng = engine.start(dbn, rng=0), np.random.default_rng(0)
    x = 0.0
    for _ in range(watch.total):
        x = 0.9 * x + rng.normal()
        belief = engine.step(belief, {"y": x + 0.5 * rng.normal()})
        watch.advance()


def calls(watch: Watch) -> None:
    asked, rng = net(), np.random.default_rng(0)
    for _ in range(watch.total):
        bmc.infer(asked, {"gauge": rng.normal()}, rng=0)
        watch.advance()


RUNS: dict[str, tuple[Callable[[Watch], None], int]] = {
    "weighted draws, summed": (weighted, 10**8),
    "weighted draws, in the file": (in_file, 10**7),
    "online steps": (online, 10**6),
    "calls of infer": (calls, 10**5),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the numbers that are stated")
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for name, (run, total) in chosen(given.only):
        watch = Watch(max(10, int(total * given.share)))
        run(watch)
        told = ", ".join(f"{100 * s:.0f} %: {m:.0f} MiB" for s, m in watch.found.items())
        print(f"{watch.total} {name}: {told}", flush=True)


def chosen(only: str) -> Iterator[tuple[str, tuple[Callable[[Watch], None], int]]]:
    return (item for item in RUNS.items() if only in item[0])


if __name__ == "__main__":
    main()
