"""The same seed gives the same bits with no executor, threads or processes, from all engines that sample."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.weighted import drawing
from tests.workers.test_units import Elsewhere

pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")

DATA = {"y": np.linspace(-1.0, 2.0, 12)}
ROWS = {"y": np.cumsum(np.linspace(-1.0, 1.0, 10))}


def net() -> bmc.BayesNet:
    found = bmc.BayesNet(plates={"i": 12})
    found.add("a", bmc.Normal(0.0, 1.0))
    found.add("s", bmc.Gamma(2.0, 2.0))
    found.add("y", lambda a, s: bmc.Normal(a, s**-0.5), plates="i")
    return found


def coins() -> bmc.BayesNet:
    found = bmc.BayesNet()
    found.add("a", bmc.Beta(1.0, 1.0))
    found.add("n", lambda a: bmc.Binomial(9, a))
    return found


def walk() -> bmc.DynamicBayesNet:
    found = bmc.DynamicBayesNet()
    found.static(lambda: bmc.Gamma(2.0, 2.0), name="s")
    found.add("x", lambda x_prev, s: bmc.Normal(0.9 * x_prev, s), initial=bmc.Normal(0.0, 1.0))
    found.add("y", lambda x: bmc.StudentT(4.0, x, 1.0))
    return found


def seen() -> bmc.DynamicBayesNet:
    found = bmc.DynamicBayesNet()
    found.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    found.add("y", lambda x: bmc.StudentT(4.0, x, 1.0))
    return found


def static(
    engine: Any, keep: str = "draws", name: str = "a", asked: Any = net, data: Any = DATA
) -> Any:
    question = functools.cache(asked)

    def run(executor: Any) -> list[np.ndarray]:
        answer = bmc.infer(question(), data, engine=engine, rng=3, keep=keep, executor=executor)
        found = [answer.mean(name), answer.var(name), answer.mcse(name)]
        return found + ([answer[name]] if keep == "draws" else [])

    return run


def series(call: Callable[..., Any], engine: Any) -> Any:
    def run(executor: Any) -> list[np.ndarray]:
        rows = [{"y": ROWS["y"][:n]} for n in (10, 6, 8)]
        answers = call(seen(), rows, engine=engine, rng=3, executor=executor)
        return [answer.mean("x") for answer in answers]

    return run


def islands(executor: Any) -> list[np.ndarray]:
    engine = bmc.IslandFilter(bmc.ParticleFilter(400), islands=4)
    answer = bmc.filter(seen(), ROWS, engine=engine, rng=3, executor=executor)
    return [answer.mean("x"), answer.var("x"), answer.mcse("x"), answer.log_marginal_increments]


def many(executor: Any) -> list[np.ndarray]:
    sets = [{"y": DATA["y"] + k} for k in range(3)]
    engine = bmc.LikelihoodWeighting(500)
    return [bmc.infer_many(net(), sets, engine=engine, rng=3, executor=executor).mean("a")]


RUNS = {
    "weighting": static(bmc.LikelihoodWeighting(70_000)),
    "weighting, sums": static(bmc.LikelihoodWeighting(70_000), "summaries"),
    "importance": static(
        bmc.Importance(70_000, proposal={"a": lambda y: bmc.Normal(y.mean(), 1.0)})
    ),
    "rejection": static(bmc.Rejection(1500), asked=coins, data={"n": 7}),
    "Gibbs": static(bmc.Gibbs(30, 10, 4, groups=2)),
    "Gibbs, sums": static(bmc.Gibbs(40, 10, 4, groups=2), "summaries"),
    "Hamiltonian": static(bmc.HamiltonianMonteCarlo(10, 10, 2, groups=2)),
    "Metropolis": static(bmc.MetropolisHastings(10, 5, 2, groups=2)),
    "particle Gibbs": static(bmc.ParticleGibbs(4, 2, 2, groups=2), "draws", "s", walk, ROWS),
    "particle Metropolis": static(
        bmc.ParticleMetropolis(4, 4, 2, 50, groups=2), "draws", "s", walk, ROWS
    ),
    "particle filter": series(bmc.filter, bmc.ParticleFilter(200)),
    "particle smoother": series(bmc.smooth, bmc.ParticleFilter(100)),
    "islands": islands,
    "many questions": many,
}


def check(name: str, executors: Sequence[Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = RUNS[name](None)
        for executor in executors:
            found = RUNS[name](executor)
            pairs = zip(expected, found, strict=True)
            assert all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.fixture(autouse=True)
def small_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit for each chunk, so that few draws make several."""
    monkeypatch.setattr(drawing, "_CHUNKS", 1)


@pytest.mark.parametrize("name", RUNS)
def test_same_bits_wherever_units_run(name: str) -> None:
    with ThreadPoolExecutor(2) as threads:
        check(name, [threads, Elsewhere()])


@pytest.mark.parametrize("name", ["weighting", "islands"])
def test_same_bits_from_processes(name: str, processes: ProcessPoolExecutor) -> None:
    check(name, [processes])


@pytest.mark.thorough
@pytest.mark.parametrize("name", RUNS)
def test_same_bits_from_processes_of_every_engine(
    name: str, processes: ProcessPoolExecutor
) -> None:
    check(name, [processes])


@pytest.mark.thorough
@pytest.mark.skipif(
    os.environ.get("OPENBLAS_NUM_THREADS") != "1",
    reason="workers of loky and Dask add with one thread, so this process must, too",
)
def test_same_bits_from_loky_and_dask() -> None:
    loky = pytest.importorskip("loky", reason="loky is not installed")
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            executors = [loky.get_reusable_executor(2), client.get_executor()]
            for name in RUNS:
                check(name, executors)
            executors[0].shutdown()


def test_other_seeds_give_other_draws() -> None:
    """The comparison above would see a stream that all units share."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posterior = bmc.infer(net(), DATA, engine=bmc.Gibbs(20, 5, 4, groups=2), rng=3)
    first, second = posterior["a"][:2], posterior["a"][2:]
    assert not np.array_equal(first, second)
