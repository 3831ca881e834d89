"""The package ``particles`` on the benchmark of de Freitas: its bootstrap filter, asked over a pipe.

``python -m benchmarks.peers.particles_run``, from the root of the repository in the peers'
environment. Each line on stdin is an object ``{"steps": T, "particles": N, "seed": s}`` and is
answered by ``{"seconds": ..., "log_likelihood": ...}``, with ``"mean"`` of every slice where
``"answer"`` is true. It keeps the moments of every slice, as bayesmc's answer has them.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

import numpy as np
import particles
from particles import collectors, distributions
from particles import state_space_models as ssm

from benchmarks.models_time import GROWTH, growth_series


class Growth(ssm.StateSpaceModel):
    """The model as the package's manual would have it written."""

    def PX0(self) -> Any:
        return distributions.Normal(scale=np.sqrt(GROWTH.start_variance))

    def PX(self, t: int, xp: np.ndarray) -> Any:
        mean = 0.5 * xp + 25.0 * xp / (1.0 + xp**2) + 8.0 * np.cos(1.2 * t)
        return distributions.Normal(loc=mean, scale=np.sqrt(GROWTH.state_variance))

    def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> Any:
        return distributions.Normal(loc=x**2 / 20.0, scale=np.sqrt(GROWTH.noise_variance))


class Bootstrap(ssm.Bootstrap):
    """The package's bootstrap filter, but that slice 0 is not seen."""

    def logG(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:
        return super().logG(t, xp, x) if t else np.zeros(len(x))


def run(steps: int, count: int) -> tuple[float, list[float]]:
    """The log-likelihood, and the mean of every slice."""
    filtering = particles.SMC(
        fk=Bootstrap(ssm=Growth(), data=growth_series(steps)),
        N=count,
        resampling="systematic",
        ESSrmin=0.5,
        collect=[collectors.Moments()],
    )
    filtering.run()
    return float(filtering.logLt), [float(m["mean"]) for m in filtering.summaries.moments]


def main() -> None:
    """Serve until stdin ends."""
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a peer prints must not pass for a reply
    run(3, 100)  # numba compiles its resampling
    for line in sys.stdin:
        asked = json.loads(line)
        np.random.seed(asked["seed"])  # noqa: NPY002 - the package draws from the global generator
        start = time.perf_counter()
        log_likelihood, mean = run(asked["steps"], asked["particles"])
        reply = {"seconds": time.perf_counter() - start, "log_likelihood": log_likelihood}
        if asked.get("answer"):
            reply["mean"] = mean
        print(json.dumps(reply), file=replies)


if __name__ == "__main__":
    main()
