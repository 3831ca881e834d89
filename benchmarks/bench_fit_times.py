"""How long ``fit`` takes, by model and length of the data: seconds of one processor, compiling included.

``python -m benchmarks.bench_fit_times``: half a minute. Tables are timed by ``bench_fit``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

import bayesmc as bmc
from benchmarks.harness import table


def local_level(rows: int, rng: np.random.Generator) -> bmc.Fit:
    """Two standard deviations, by the Kalman filter."""
    dbn = bmc.DynamicBayesNet("local level")
    dbn.add_static("drift", bmc.HalfNormal(5.0))
    dbn.add_static("noise", bmc.HalfNormal(5.0))
    dbn.add(
        "level", lambda level_prev, drift: bmc.Normal(level_prev, drift), initial=bmc.Normal(0, 3)
    )
    dbn.add("y", lambda level, noise: bmc.Normal(level, noise))
    y = np.cumsum(0.7 * rng.normal(size=rows)) + 1.3 * rng.normal(size=rows)
    return bmc.fit(dbn, {"y": y})


def sine(rows: int, rng: np.random.Generator) -> bmc.Fit:
    """Two standard deviations of a level that moves by a sine, by the unscented Kalman filter."""
    dbn = bmc.DynamicBayesNet("sine")
    dbn.add_static("drift", bmc.HalfNormal(1.0))
    dbn.add_static("noise", bmc.HalfNormal(5.0))
    dbn.add(
        "x",
        lambda x_prev, drift: bmc.Normal(x_prev + np.sin(x_prev), drift),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x, noise: bmc.Normal(x, noise))
    return bmc.fit(dbn, {"y": rng.normal(size=rows)}, engine=bmc.UnscentedKalmanFilter())


def mixture(points: int, rng: np.random.Generator) -> bmc.Fit:
    """Two means and a share."""
    net = bmc.BayesNet("two kinds", plates={"kind": 2, "point": None})
    net.add("share", bmc.Dirichlet([1.0, 1.0]))
    net.add("mean", bmc.Normal(0.0, 5.0), plates="kind")
    net.add("which", lambda share: bmc.Categorical(share), plates="point")
    net.add("x", lambda which, mean: bmc.Normal(mean[which], 1.0), plates="point")
    return bmc.fit(net, {"x": np.where(rng.random(points) < 0.3, 3, -1) + rng.normal(size=points)})


def logistic(rows: int, rng: np.random.Generator) -> bmc.Fit:
    """Six coefficients."""
    net = bmc.BayesNet("logistic", plates={"row": None})
    net.input("X", plates="row", event_shape=(6,))
    net.add("beta", bmc.MvNormal(np.zeros(6), 25.0 * np.eye(6)))
    net.add("y", lambda X, beta: bmc.Bernoulli(logits=np.vecdot(X, beta)), plates="row")
    X = rng.normal(size=(rows, 6))
    chance = 1 / (1 + np.exp(-X @ [1.0, -1.0, 0.5, 0.0, 0.0, 2.0]))
    return bmc.fit(net, {"y": (rng.random(rows) < chance).astype(int)}, inputs={"X": X})


FITS: tuple[tuple[str, Callable[[int, np.random.Generator], bmc.Fit], tuple[int, ...]], ...] = (
    ("local level", local_level, (100, 1_000, 10_000)),
    ("mixture of two", mixture, (300, 3_000)),
    ("logistic regression", logistic, (1_000, 30_000)),
    ("level that moves by a sine", sine, (200,)),
)


def times() -> Iterator[tuple[str, int, str, int, bool]]:
    """Model, length of the data, seconds of the processor, steps, and whether the climb ended."""
    for name, fitted, sizes in FITS:
        for size in sizes:
            began = time.process_time()
            found = fitted(size, np.random.default_rng(4))
            spent = time.process_time() - began
            yield name, size, f"{spent:.2f}", found.iterations, found.converged


if __name__ == "__main__":
    print(table("fit", ("model", "data", "s", "steps", "converged"), list(times())))
