"""Sweeps of a variational Gaussian mixture by scikit-learn and BayesPy, in a process of its own.

Reads one line of JSON, ``{"job", "size", "states", "sweeps"}``, and answers with the seconds of so many
sweeps: of scikit-learn the difference of two fits, of BayesPy ``update(repeat=)``, with means and precisions
apart, as it has no factor of both that works. It imports nothing of bayesmc.
"""

from __future__ import annotations

import json
import sys
import time
import warnings

import numpy as np

WARMUP = 3


def main() -> None:
    """Answer questions until there are none."""
    warnings.simplefilter("ignore")
    jobs = {"sklearn": by_sklearn, "bayespy": by_bayespy}
    for line in sys.stdin:
        question = json.loads(line)
        try:
            job = jobs[question.pop("job")]
            answer = {"seconds": job(**question)}
        except Exception as error:  # the caller says what is missing
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


def points(size: int, states: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    means = rng.normal(0.0, 1.5, (states, 2))
    return means[rng.integers(0, states, size)] + rng.normal(0.0, 0.5, (size, 2))


def by_sklearn(size: int, states: int, sweeps: int) -> float:
    from sklearn.mixture import BayesianGaussianMixture

    x = points(size, states)

    def fit(count: int) -> float:
        model = BayesianGaussianMixture(
            n_components=states, max_iter=count, tol=0.0, init_params="random", random_state=1,
            weight_concentration_prior_type="dirichlet_distribution", weight_concentration_prior=1.0,
            mean_precision_prior=1.0, mean_prior=np.zeros(2), degrees_of_freedom_prior=2.0,
            covariance_prior=np.eye(2),
        )  # fmt: skip
        start = time.perf_counter()
        model.fit(x)
        return time.perf_counter() - start

    return fit(sweeps + WARMUP) - fit(WARMUP)


def by_bayespy(size: int, states: int, sweeps: int) -> float:
    for name, kind in (("int", int), ("float", float), ("bool", bool), ("complex", complex)):
        if not hasattr(np, name):  # names that it was written with
            setattr(np, name, kind)
    from bayespy.inference import VB
    from bayespy.nodes import Categorical, Dirichlet, Gaussian, Mixture, Wishart

    x = points(size, states)
    weights = Dirichlet(np.ones(states))
    label = Categorical(weights, plates=(size,))
    mean = Gaussian(np.zeros(2), np.eye(2), plates=(states,))
    precision = Wishart(2.0, np.eye(2), plates=(states,))
    seen = Mixture(label, Gaussian, mean, precision)
    seen.observe(x)
    label.initialize_from_random()
    vb = VB(seen, mean, precision, label, weights)
    vb.update(repeat=WARMUP, verbose=False, tol=0)
    start = time.perf_counter()
    vb.update(repeat=sweeps, verbose=False, tol=0)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
