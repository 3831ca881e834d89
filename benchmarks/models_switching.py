"""A target that flies straight, or turns left or right, with its numbers and a simulated series.

Nothing here imports bayesmc, which is handed in. By hand it is in ``floors/switching.py``, for FilterPy in
``peers/filterpy_imm.py``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_RATE = 0.2


def _turning(rate: float) -> np.ndarray:
    """Positions and velocities a second later (Bar-Shalom, Li and Kirubarajan 2001, eq. 11.7.1-4)."""
    if rate == 0.0:
        s, c = 1.0, 0.0
    else:
        s, c = np.sin(rate) / rate, (1.0 - np.cos(rate)) / rate
    found = np.eye(4)
    found[:2, 2:] = [[s, -c], [c, s]]
    found[2:, 2:] = [[np.cos(rate), -np.sin(rate)], [np.sin(rate), np.cos(rate)]]
    return found


MOVES = np.stack([_turning(0.0), _turning(_RATE), _turning(-_RATE)])
_PUSH = np.concatenate([0.5 * np.eye(2), np.eye(2)])
NOISE = np.stack([0.01 * _PUSH @ _PUSH.T + 1e-3 * np.eye(4)] * 3)
SIGHT, SIGHT_NOISE = np.eye(4)[:2], np.eye(2)
FOLLOW = np.array([[0.90, 0.05, 0.05], [0.10, 0.89, 0.01], [0.10, 0.01, 0.89]])
START = np.full(3, 1 / 3)
START_MEAN, START_COVARIANCE = np.zeros(4), 10.0 * np.eye(4)


def target(bmc: Any) -> Any:
    """The template; slice 0 has no row."""
    dbn = bmc.DynamicBayesNet("target")
    dbn.table("mode", ["mode_prev"], FOLLOW, initial=START)
    dbn.add(
        "x",
        lambda x_prev, mode: bmc.MvNormal(np.matvec(MOVES[mode], x_prev), NOISE[mode]),
        initial=bmc.MvNormal(START_MEAN, START_COVARIANCE),
    )
    dbn.add("y", lambda x: bmc.MvNormal(x[..., :2], SIGHT_NOISE))
    return dbn


def series(steps: int, seed: int = 0) -> np.ndarray:
    """Measured positions, shape (steps, 2), the first a second after the start."""
    rng = np.random.default_rng(seed)
    mode, x = 0, rng.multivariate_normal(START_MEAN, START_COVARIANCE)
    found = np.empty((steps, 2))
    for t in range(steps):
        mode = rng.choice(3, p=FOLLOW[mode])
        x = MOVES[mode] @ x + rng.multivariate_normal(np.zeros(4), NOISE[mode])
        found[t] = SIGHT @ x + rng.normal(size=2)
    return found
