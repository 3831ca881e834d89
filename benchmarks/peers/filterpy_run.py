"""FilterPy's Kalman filter in a loop over a series, asked over a pipe.

``python -m benchmarks.peers.filterpy_run``, from the root of the repository in the peers'
environment. Each line on stdin is an object ``{"steps": T}`` and is answered by ``{"seconds": ...,
"log_likelihood": ...}``, with ``"mean"`` of every slice where ``"answer"`` is true. Means, covariances
and the log-likelihood are kept, as in the loop by hand.
"""

from __future__ import annotations

import json
import os
import sys
import time

import numpy as np
from filterpy.kalman import KalmanFilter

from benchmarks import models_time as numbers


def run(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Means (steps, 4), covariances (steps, 4, 4) and the log-likelihood."""
    steps, size = len(y), len(numbers.START_MEAN)
    kalman = KalmanFilter(dim_x=size, dim_z=y.shape[1])
    kalman.x, kalman.P = numbers.START_MEAN.copy(), numbers.START_COVARIANCE.copy()
    kalman.F, kalman.Q = numbers.MOTION, numbers.MOTION_NOISE
    kalman.H, kalman.R = numbers.SIGHT, numbers.SIGHT_NOISE
    means, covariances, total = np.empty((steps, size)), np.empty((steps, size, size)), 0.0
    for t in range(steps):
        if t:
            kalman.predict()
        kalman.update(y[t])
        means[t], covariances[t] = kalman.x, kalman.P
        total += kalman.log_likelihood
    return means, covariances, float(total)


def main() -> None:
    """Serve until stdin ends."""
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a peer prints must not pass for a reply
    for line in sys.stdin:
        asked = json.loads(line)
        y = numbers.motion_series(asked["steps"])
        start = time.perf_counter()
        means, _, total = run(y)
        reply = {"seconds": time.perf_counter() - start, "log_likelihood": total}
        if asked.get("answer"):
            reply["mean"] = means.tolist()
        print(json.dumps(reply), file=replies)


if __name__ == "__main__":
    main()
