"""Memory of long runs: ``python -m benchmarks.memory`` prints it on the way and at the end of each.

``python -m benchmarks.memory --steps`` has online filters take in a million rows each, some minutes in all.
Memory of the process itself is counted (anonymous pages), not pages of files, which the system takes back.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
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
        for share in (0.01, 0.1, 0.5, 1.0):
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


def online(watch: Watch, engine: Any = None) -> None:
    engine = bmc.ParticleFilter(100) if engine is None else engine
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
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
#: particles, the same with answers that come late, and a Kalman filter
ONLINE = {
    "100 particles": bmc.ParticleFilter(100),
    "100 particles, 5 rows late": bmc.ParticleFilter(100, delay=5),
    "KalmanFilter": bmc.KalmanFilter(),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the numbers that are stated")
    parser.add_argument("--only", default="")
    parser.add_argument(
        "--steps",
        type=int,
        nargs="?",
        const=10**6,
        metavar="N",
        help="online steps alone, so many (10^6) by each of several filters",
    )
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.steps is not None:
        for name, engine in ONLINE.items():
            tell(partial(online, engine=engine), f"online steps, {name}", given.steps)
        return
    for name, (run, total) in chosen(given.only):
        tell(run, name, max(10, int(total * given.share)))


def tell(run: Callable[[Watch], None], name: str, total: int) -> None:
    """Memory at some shares of a run, and how long it took."""
    watch, begun = Watch(total), time.process_time()
    run(watch)
    told = ", ".join(f"at {s * total:.0f}: {m:.1f} MiB" for s, m in watch.found.items())
    print(f"{total} {name}: {told}; {time.process_time() - begun:.0f} s", flush=True)


def chosen(only: str) -> Iterator[tuple[str, tuple[Callable[[Watch], None], int]]]:
    return (item for item in RUNS.items() if only in item[0])


if __name__ == "__main__":
    main()
