"""The filters fused by numba, one thread: what the loops in NumPy are measured against.

Runs in an environment that has numba (that of the peers), from the root of the repository, and
imports nothing of bayesmc. ``python -m benchmarks.floors.filters_fused`` compiles when first asked;
each line on stdin is an object ``{"job": name, "steps": T, "particles": N, "seed": s}`` with the job
``growth``, ``hmm`` or ``kalman`` (which have no particles), and is answered by ``{"seconds": ...,
"log_likelihood": ..., "mean": [...]}``, the mean of each slice of the first coordinate. The clock
runs here. The end of stdin ends it.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np

from benchmarks import models_time

Answer = tuple[np.ndarray, np.ndarray]  # means of the slices, and increments of the log-likelihood


def main() -> None:
    """Serve until stdin ends."""
    for line in sys.stdin:
        asked = json.loads(line)
        run = _prepared(asked["job"], asked["steps"])
        start = time.perf_counter()
        mean, increments = run(asked.get("particles", 0), asked.get("seed", 1))
        seconds = time.perf_counter() - start
        reply = {"seconds": seconds, "log_likelihood": increments.sum()}
        if asked.get("answer"):
            reply["mean"] = mean.tolist()
        print(json.dumps(reply), flush=True)


@cache
def _prepared(job: str, steps: int) -> Callable[[int, int], Answer]:
    run = {"growth": _growth, "hmm": _hmm, "kalman": _kalman}[job](steps)
    run(10, 1)  # compiles
    return run


def _growth(steps: int) -> Callable[[int, int], Answer]:
    y, m = models_time.growth_series(steps), models_time.GROWTH
    roots = np.sqrt([m.start_variance, m.state_variance])

    def run(particles: int, seed: int) -> Answer:
        rng = np.random.Generator(np.random.SFC64(seed))
        return _growth_steps(y, particles, roots[0], roots[1], m.noise_variance, rng)

    return run


@numba.njit
def _growth_steps(y, n, start, scale, variance, rng):  # noqa: ANN001, ANN202
    steps = len(y)
    mean, increments = np.zeros(steps), np.zeros(steps)
    x, old, log, weights = np.empty(n), np.empty(n), np.zeros(n), np.ones(n)
    constant = -0.5 * math.log(2.0 * math.pi * variance)
    for i in range(n):
        x[i] = start * rng.standard_normal()
        mean[0] += x[i]
    mean[0] /= n
    total, ess, before = float(n), float(n), math.log(n)
    for t in range(1, steps):
        if ess < 0.5 * n:
            x, old = old, x
            u, reached, i = rng.random(), 0.0, 0
            for k in range(n):
                reached += weights[k] * n / total
                while i < n and i + u < reached:
                    x[i] = old[k]
                    i += 1
            while i < n:  # the sum may round below n
                x[i] = old[n - 1]
                i += 1
            log[:] = 0.0
            before = math.log(n)
        shift, top = 8.0 * math.cos(1.2 * t), -np.inf
        for i in range(n):
            z = x[i]
            z = z * (0.5 + 25.0 / (1.0 + z * z)) + shift + scale * rng.standard_normal()
            x[i] = z
            off = z * z / 20.0 - y[t]
            log[i] -= 0.5 * off * off / variance
            top = max(top, log[i])
        total, squares, first = 0.0, 0.0, 0.0
        for i in range(n):
            w = math.exp(log[i] - top)
            weights[i] = w
            total += w
            squares += w * w
            first += w * x[i]
        mean[t] = first / total
        ess = total * total / squares
        now = top + math.log(total)
        increments[t] = now - before + constant
        before = now
    return mean, increments


def _hmm(steps: int) -> Callable[[int, int], Answer]:
    y, numbers = models_time.hmm_series(steps), models_time.hmm_numbers()

    def run(particles: int, seed: int) -> Answer:
        return _hmm_steps(y, *numbers)

    return run


@numba.njit
def _hmm_steps(y, initial, transition, means):  # noqa: ANN001, ANN202
    steps, card = len(y), len(initial)
    found, increments = np.empty((steps, card)), np.empty(steps)
    constant = -0.5 * math.log(2.0 * math.pi)
    for t in range(steps):
        top = -np.inf
        for j in range(card):
            top = max(top, -0.5 * (y[t] - means[j]) ** 2)
        total = 0.0
        for j in range(card):
            if t == 0:
                p = initial[j]
            else:
                p = 0.0
                for i in range(card):
                    p += found[t - 1, i] * transition[i, j]
            found[t, j] = p * math.exp(-0.5 * (y[t] - means[j]) ** 2 - top)
            total += found[t, j]
        for j in range(card):
            found[t, j] /= total
        increments[t] = math.log(total) + top + constant
    return found[:, 0], increments


def _kalman(steps: int) -> Callable[[int, int], Answer]:
    m = models_time
    y = m.motion_series(steps)
    numbers: tuple[Any, ...] = (
        m.MOTION,
        m.MOTION_NOISE,
        m.SIGHT,
        m.SIGHT_NOISE,
        m.START_MEAN,
        m.START_COVARIANCE,
    )

    def run(particles: int, seed: int) -> Answer:
        return _kalman_steps(y, *numbers)

    return run


@numba.njit
def _times(a, b, out):  # noqa: ANN001, ANN202
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            s = 0.0
            for k in range(a.shape[1]):
                s += a[i, k] * b[k, j]
            out[i, j] = s


@numba.njit
def _kalman_steps(y, f, q, h, r, start, covariance):  # noqa: ANN001, ANN202
    steps, d = len(y), len(start)
    means, covariances, increments = np.empty((steps, d)), np.empty((steps, d, d)), np.empty(steps)
    m, p = start.copy(), covariance.copy()
    ft, ht = f.T.copy(), h.T.copy()
    spare, new = np.empty((d, d)), np.empty(d)
    cross, spread, inverse, gain = (
        np.empty((d, 2)),
        np.empty((2, 2)),
        np.empty((2, 2)),
        np.empty((d, 2)),
    )
    off = np.empty(2)
    for t in range(steps):
        if t > 0:
            for i in range(d):
                new[i] = 0.0
                for k in range(d):
                    new[i] += f[i, k] * m[k]
            m[:] = new
            _times(f, p, spare)
            _times(spare, ft, p)
            p += q
        _times(p, ht, cross)
        _times(h, cross, spread)
        spread += r
        determinant = spread[0, 0] * spread[1, 1] - spread[0, 1] * spread[1, 0]
        inverse[0, 0], inverse[1, 1] = spread[1, 1] / determinant, spread[0, 0] / determinant
        inverse[0, 1], inverse[1, 0] = -spread[0, 1] / determinant, -spread[1, 0] / determinant
        _times(cross, inverse, gain)
        for i in range(2):
            off[i] = y[t, i]
            for k in range(d):
                off[i] -= h[i, k] * m[k]
        square = 0.0
        for i in range(2):
            for j in range(2):
                square += off[i] * inverse[i, j] * off[j]
        for i in range(d):
            m[i] += gain[i, 0] * off[0] + gain[i, 1] * off[1]
            for j in range(d):
                p[i, j] -= gain[i, 0] * cross[j, 0] + gain[i, 1] * cross[j, 1]
        increments[t] = -0.5 * (square + math.log(determinant)) - math.log(2.0 * math.pi)
        means[t] = m
        covariances[t] = p
    return means[:, 0], increments


if __name__ == "__main__":
    main()
