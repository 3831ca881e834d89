"""One cloud of particles cut into islands, on whatever processes there are: alone, or under MPI.

By itself the script works here. Under MPI every rank but the first is a worker, and the same seed gives the
same figures to the last digit, whatever their number:

    mpiexec -n 3 python -m mpi4py.futures examples/islands_mpi.py

The model is linear and Gaussian, so that the Kalman filter says what the evidence is. The figure shows what
islands make of the rows: shares of the weight drift apart, and where their effective number falls below nine
tenths, islands are resampled whole. Verge, Dubarry, Del Moral and Moulines (2015), On parallel implementation
of sequential Monte Carlo methods: the island particle model, Statistics and Computing 25.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

STEPS = 60
ISLANDS = (1, 4, 16)


def walk() -> bmc.DynamicBayesNet:
    """A state that forgets slowly, seen through noise."""
    dbn = bmc.DynamicBayesNet("walk")
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))
    return dbn


def pool() -> Any:
    """An executor over the ranks of an MPI run; None where there is no such run."""
    if "mpi4py.futures" not in sys.modules:
        return nullcontext()
    from mpi4py import MPI
    from mpi4py.futures import MPIPoolExecutor

    return MPIPoolExecutor() if MPI.COMM_WORLD.Get_size() > 1 else nullcontext()


def runs(particles: int, repeats: int, rows: Any, executor: Any) -> dict[int, list[Any]]:
    """Filters with so many islands, by their number."""
    found: dict[int, list[Any]] = {}
    for count in ISLANDS:
        engine = bmc.IslandFilter(bmc.ParticleFilter(particles), islands=count)
        found[count] = [
            bmc.filter(walk(), rows, engine=engine, rng=k, executor=executor)
            for k in range(repeats)
        ]
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Filter one series with one cloud, with 4 and with 16 islands, and show how far the evidence is off."""
    options = picture.options(__doc__, arguments)
    particles, repeats = (1_600, 3) if options.fast else (64_000, 12)
    rows = {"y": walk().sample(STEPS, rng=6)["y"][0]}
    exact = bmc.filter(walk(), rows, engine=bmc.KalmanFilter())
    with pool() as executor, warnings.catch_warnings():
        warnings.simplefilter("ignore", bmc.errors.LowEssWarning)  # few particles in a smoke test
        workers = getattr(executor, "num_workers", 0)
        start = time.perf_counter()
        found = runs(particles, repeats, rows, executor)
        seconds = time.perf_counter() - start
    where = f"{workers} workers under MPI" if workers else "here"
    print(f"one cloud of {particles} particles, {STEPS} rows, {repeats} runs each, {where}")
    print(
        "  islands  log evidence of the first run  error, root of the mean square  exchanges a run"
    )
    for count, answers in found.items():
        logs = np.array([a.log_marginal_likelihood for a in answers])
        off = np.sqrt(np.mean((logs - exact.log_marginal_likelihood) ** 2))
        exchanges = [len(a.exchanged) if count > 1 else 0 for a in answers]
        print(f"  {count:7}  {logs[0]:29.12f}  {off:30.4f}  {np.mean(exchanges):15.1f}")
    print(f"  exact    {exact.log_marginal_likelihood:29.12f}")
    if workers:
        print(f"  {seconds:.1f} seconds in all")
    picture.save(figure(found, exact), options.out, "islands_mpi")


def figure(found: dict[int, list[Any]], exact: Any) -> Any:
    """Errors of the evidence row by row, and where islands exchanged."""
    panels, axes = picture.axes([[f"{n}" for n in found]], (10.0, 3.2), sharey=True)
    for count, answers in found.items():
        axis = axes[f"{count}"]
        for answer in answers:
            off = np.cumsum(answer.log_marginal_increments - exact.log_marginal_increments)
            axis.plot(off, color=picture.DRAWS, linewidth=0.9)
        for t in answers[0].exchanged if count > 1 else ():
            axis.axvline(t, color=picture.OTHER, linewidth=0.6)
        axis.axhline(0.0, color=picture.EXACT, linewidth=1.0)
        axis.set_title(f"{count} island{'s' if count > 1 else ''}")
        axis.set_xlabel("row")
    axes[f"{ISLANDS[0]}"].set_ylabel("log evidence, off the exact one")
    return panels


if __name__ == "__main__":
    main()
