"""A sweep of ``MeanField`` over a Gaussian mixture beside the same by hand, scikit-learn and BayesPy.

Every sweep gives the evidence bound. A figure of bayesmc is the slope between a shorter and a longer call.
"""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack
from typing import Any

import numpy as np

import bayesmc as bmc
from benchmarks.floors import variational_mixture
from benchmarks.harness import HERE, SelfTimed, Worker, interleave, peer_python, table

SIZE, STATES = 10_000, 6
SWEEPS, FEWER = 220, 20
GOAL = 1.5
ENGINE = {"restarts": 1, "tolerance": 1e-15, "blocks": [("mean", "cov")]}


def main() -> None:
    """Print medians of one sweep; what is not installed is left out and named."""
    warnings.simplefilter("ignore")
    points, shares = variational_mixture.start(SIZE, STATES)
    tuned = variational_mixture.Tuned(points, shares)
    plain = variational_mixture.Plain(points, shares)
    net = mixture(SIZE, STATES)
    entries: dict[str, Any] = {
        "by hand, tuned": SelfTimed(lambda: seconds(lambda: tuned.run(SWEEPS)) / SWEEPS),
        "by hand, plain": SelfTimed(lambda: seconds(lambda: plain.run(FEWER)) / FEWER),
        "bayesmc": SelfTimed(lambda: own(net, points)),
    }
    with ExitStack() as stack:
        python = peer_python()
        if python is None:
            print("no peers installed: run `make peers` to have scikit-learn and BayesPy beside\n")
        else:
            script = HERE / "peers" / "variational_run.py"
            worker = stack.enter_context(Worker("the peers' mixtures", [str(python), str(script)]))
            for job in ("sklearn", "bayespy"):
                question = {"job": job, "size": SIZE, "states": STATES, "sweeps": FEWER}
                try:
                    worker.ask(**question)
                except RuntimeError as error:
                    print(f"{job}: {error}\n")
                    continue
                entries[job] = SelfTimed(
                    lambda q=question: float(worker.ask(**q)["seconds"]) / FEWER
                )
        times = interleave(entries, repeats=7, least=0.0)
    floor = times["by hand, tuned"].median
    rows: list[list[object]] = [
        [name, 1e3 * t.median, 1e3 * t.best, t.median / floor] for name, t in times.items()
    ]
    rows.append(["goal", "", "", GOAL])
    title = f"variational Gaussian mixture, K={STATES}, D=2, {SIZE} points, one sweep"
    print(table(title, ["", "ms", "best", "over tuned"], rows))


def mixture(size: int, states: int) -> bmc.BayesNet:
    """The model of the loops by hand."""
    net = bmc.BayesNet("mixture", plates={"kind": states, "point": size})
    net.add("weights", bmc.Dirichlet(np.full(states, variational_mixture.ALPHA)))
    net.add("cov", bmc.InverseWishart(variational_mixture.DF, np.eye(2)), plates="kind")
    net.add(
        "mean", lambda cov: bmc.MvNormal(np.zeros(2), cov / variational_mixture.BETA), plates="kind"
    )
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean, cov: bmc.MvNormal(mean[label], cov[label]), plates="point")
    return net


def own(net: bmc.BayesNet, points: np.ndarray) -> float:
    """Seconds of one sweep."""

    def run(sweeps: int) -> float:
        engine = bmc.MeanField(sweeps=sweeps, **ENGINE)  # type: ignore[arg-type]
        return seconds(lambda: bmc.infer(net, {"x": points}, engine=engine, rng=1))

    return (run(SWEEPS) - run(FEWER)) / (SWEEPS - FEWER)


def seconds(job: Any) -> float:
    """Wall-clock time of a call."""
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
