"""FilterPy's IMM in a loop over a series, asked over a pipe.

``python -m benchmarks.peers.filterpy_imm``, from the root of the repository in the peers' environment. Each
line on stdin is an object ``{"steps": T}`` and is answered by ``{"seconds": ...}``, with ``"modes"`` and
``"mean"`` of the last slice.
"""

from __future__ import annotations

import json
import os
import sys
import time

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter

from benchmarks import models_switching as m


def run(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (steps, 4) and mode probabilities (steps, 3)."""
    filters = []
    for move, noise in zip(m.MOVES, m.NOISE, strict=True):
        kalman = KalmanFilter(dim_x=4, dim_z=2)
        kalman.x, kalman.P = m.START_MEAN.copy(), m.START_COVARIANCE.copy()
        kalman.F, kalman.Q, kalman.H, kalman.R = move, noise, m.SIGHT, m.SIGHT_NOISE
        filters.append(kalman)
    imm = IMMEstimator(filters, m.START, m.FOLLOW)
    means, modes = np.empty((len(y), 4)), np.empty((len(y), len(filters)))
    for t, row in enumerate(y):
        imm.predict()
        imm.update(row)
        means[t], modes[t] = imm.x, imm.mu
    return means, modes


def main() -> None:
    """Serve until stdin ends."""
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a peer prints must not pass for a reply
    for line in sys.stdin:
        y = m.series(json.loads(line)["steps"])
        start = time.perf_counter()
        means, modes = run(y)
        seconds = time.perf_counter() - start
        reply = {"seconds": seconds, "mean": means[-1].tolist(), "modes": modes[-1].tolist()}
        print(json.dumps(reply), file=replies)


if __name__ == "__main__":
    main()
