"""Units of work on two processes beside one and none, many questions at once, and islands of particles.

``python -m benchmarks.bench_workers`` times, ``--shared 8`` only what is shared out and has an 8 in its name;
with ``--islands 2000`` it runs the filter with 1, 4 and 16 islands so often and prints means and variances of
the evidence instead. Wall times of several processes say little while the machine does something else: look
at the load, and at the columns by processors' time, where two workers take as long as the busier one of them
and what is done here before and after.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from benchmarks.harness import Peer, data_folder, network, peer_python, table

SETS, LOOPED, ASKED = 10_000, 400, 200
ROUNDS = 3


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--islands", type=int, default=0, metavar="RUNS")
    parser.add_argument("--shared", nargs="?", const="", metavar="WHAT")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    if options.islands:
        print(islands(options.islands))
        return
    print(f"load before: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores\n")
    print(shared_out(options.shared or "", options.rounds) + "\n")
    if options.shared is None and data_folder().exists():
        print(many_questions() + "\n")
    print(f"load after: {os.getloadavg()[0]:.2f}")


def shared_out(only: str, rounds: int) -> str:
    """Seconds here, on one process and on two: by the clock, and by processors' time."""
    rows: list[list[object]] = []
    for name, run in (
        ("8 series of about 1 s each", lambda e, k: series(8, 250_000, 250, e, k)),
        ("64 series of about 0.02 s each", lambda e, k: series(64, 30_000, 50, e, k)),
        ("8 chains in 2 groups of about 4 s each", chains),
    ):
        if only in name:
            found = timed(run, rounds)
            (here, one, two), (more, more_spent) = found.best, found.overhead
            speed = [one[k] / two[k] for k in (0, 1)]
            rows.append(
                [
                    name,
                    here[0],
                    one[0],
                    two[0],
                    more,
                    speed[0],
                    one[1],
                    two[1],
                    more_spent,
                    speed[1],
                ]
            )
    header = ["what", "here, s", "1 worker", "2 workers", "overhead, %", "2 over 1", "1 worker, CPU s",
              "2 workers", "overhead, %", "2 over 1"]  # fmt: skip
    return table(
        f"the same work shared out (best of {rounds} rounds in turn, each with another seed; overhead of one "
        "worker: the median of rounds)",
        header,
        rows,
    )


class Timed(NamedTuple):
    """Seconds here, on one process and on two, and what one process takes more than here, in percent.

    By the clock, and by processors' time: of the busiest worker besides what is done here.
    """

    best: list[tuple[float, float]]
    overhead: tuple[float, float]


def timed(run: Callable[[Any, int], None], rounds: int) -> Timed:
    """The same work done here, by one process and by two, in turn."""
    found = np.full((rounds, 3, 2), np.inf)
    with processes(1) as one, processes(2) as two:
        executors = [None, Clocked(one), Clocked(two)]
        for executor in executors:
            run(executor, 0)  # workers import and compile
        for r in range(rounds):
            for k, executor in enumerate(executors):
                start, own = time.perf_counter(), time.process_time()
                if executor is not None:
                    executor.seconds.clear()
                run(executor, r + 1)
                taken = time.perf_counter() - start, time.process_time() - own
                busiest = max(executor.seconds.values()) if executor is not None else 0.0
                found[r, k] = taken[0], taken[1] + busiest
    best = [(float(wall), float(spent)) for wall, spent in found.min(axis=0)]
    more = 100 * (np.median(found[:, 1] / found[:, 0], axis=0) - 1)
    return Timed(best, (float(more[0]), float(more[1])))


class Clocked(Executor):
    """An executor that says how long each of its workers was at work, by its processor's time."""

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool, self._max_workers = pool, pool._max_workers  # type: ignore[attr-defined]
        #: process -> seconds
        self.seconds: dict[int, float] = {}

    def submit(self, fn: Any, /, *args: Any, **options: Any) -> Future[Any]:
        found: Future[Any] = Future()

        def done(inner: Future[Any]) -> None:
            try:
                process, seconds, result = inner.result()
            except BaseException as error:
                found.set_exception(error)
                return
            self.seconds[process] = self.seconds.get(process, 0.0) + seconds
            found.set_result(result)

        self._pool.submit(clocked, fn, *args, **options).add_done_callback(done)
        return found


def clocked(fn: Any, *args: Any, **options: Any) -> tuple[int, float, Any]:
    """The process that works, how long it did, and what came out."""
    start = time.process_time()
    result = fn(*args, **options)
    return os.getpid(), time.process_time() - start, result


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        yield pool


def series(count: int, particles: int, steps: int, executor: Any, seed: int) -> None:
    rng = np.random.default_rng(0)
    rows = [{"y": rng.normal(size=steps)} for _ in range(count)]
    bmc.filter(WALK, rows, engine=bmc.ParticleFilter(particles), rng=seed, executor=executor)


def chains(executor: Any, seed: int) -> None:
    engine = bmc.Gibbs(draws=4500, warmup=500, chains=8, groups=2)
    bmc.infer(ROBUST, DATA, engine=engine, rng=seed, keep=["level", "scale"], executor=executor)


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("walk")
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    dbn.add("y", lambda x: bmc.StudentT(4.0, x, 0.7))
    return dbn


def robust() -> bmc.BayesNet:
    net = bmc.BayesNet("robust", plates={"i": 20_000})
    net.add("level", bmc.Normal(0.0, 1.0))
    net.add("scale", bmc.Gamma(2.0, 2.0))
    net.add("y", lambda level, scale: bmc.StudentT(4.0, level, scale), plates="i")
    return net


WALK, ROBUST = walk(), robust()
DATA = {"y": np.random.default_rng(3).standard_t(4, 20_000)}


def many_questions() -> str:
    """Process time for each evidence set of ALARM, all marginals read; pyAgrum's of its own process."""
    net = bmc.io.read(network("alarm"))
    sets = random_sets(net, SETS)
    names = list(net)

    def together() -> None:
        posteriors = bmc.infer_many(net, sets)
        for name in names:
            posteriors.probabilities(name)

    def loop() -> None:
        for evidence in sets[:LOOPED]:
            posterior = bmc.infer(net, evidence, engine=bmc.Exact())
            for name in names:
                posterior.probabilities(name)

    times = {
        "infer_many": 1e6 * spent(together) / SETS,
        "a loop of infer": 1e6 * spent(loop) / LOOPED,
    }
    if peer_python() is not None:
        with Peer("exact-pyagrum", network("alarm"), 0) as peer:
            seconds = [peer.cpu_seconds(evidence) for evidence in sets[:ASKED]]
        times["pyAgrum's loop"] = 1e6 * float(np.mean(seconds))
    own = times["infer_many"]
    rows = [[name, value, value / own] for name, value in times.items()]
    title = f"ALARM, {SETS} evidence sets of 1 to 8 nodes, all marginals"
    return table(title, ["what", "us each", "over infer_many"], rows)


def random_sets(net: bmc.BayesNet, count: int) -> list[dict[str, str]]:
    """Evidence drawn from the net, on nodes chosen at random."""
    rng = np.random.default_rng(0)
    names, drawn = list(net), net.sample(count, rng=1)
    labels = {n: np.asarray(net[n].states)[np.asarray(drawn[n].codes)] for n in names}
    found = []
    for k in range(count):
        seen = rng.choice(len(names), size=int(rng.integers(1, 9)), replace=False)
        found.append({names[j]: str(labels[names[j]][k]) for j in seen})
    return found


def spent(run: Callable[[], None]) -> float:
    run()
    start = time.process_time()
    run()
    return time.process_time() - start


def islands(runs: int) -> str:
    """Means and variances of the evidence over the exact one: 2,048 particles in all, 40 rows."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))
    drawn = dbn.unroll(40).sample(1, rng=0)
    data = {"y": np.array([float(np.ravel(drawn[f"y[{t}]"])[0]) for t in range(40)])}
    exact = bmc.filter(dbn, data, engine=bmc.KalmanFilter()).log_marginal_likelihood
    rows: list[list[object]] = []
    plain = None
    for count in (1, 4, 16):
        engine = bmc.IslandFilter(bmc.ParticleFilter(2048), islands=count)
        found, exchanges, told = [], 0, []
        for k in range(runs):
            answer = bmc.filter(dbn, data, engine=engine, rng=k + 1_000_000 * count)
            found.append(float(np.exp(answer.log_marginal_likelihood - exact)))
            told.append(answer.log_marginal_likelihood_mcse)
            exchanges += len(answer.exchanged) if count > 1 else 0
        values = np.array(found)
        plain = values.var() if plain is None else plain
        off = (values.mean() - 1) / (values.std() / np.sqrt(runs))
        sd = float(np.std(np.log(values)))
        rows.append(
            [count, values.mean(), off, values.var() / plain, exchanges / runs, sd, np.median(told)]
        )
    header = ["islands", "mean", "standard errors off 1", "variance over plain", "exchanges", "sd of log",
              "stated"]  # fmt: skip
    return table(f"evidence over the exact one, {runs} runs", header, rows)


if __name__ == "__main__":
    main()
