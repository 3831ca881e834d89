"""Bootstrap filters written by hand in NumPy for three models: one thread, everything in place.

They compute what a run of bayesmc's answers with: the filtered mean of every slice and the increments
of the log-likelihood, resampling systematically where the effective number of particles has fallen
below half. What makes them fast: SFC64; coordinates in planes of their own, ``(d, particles)``;
particles moved and weighted in blocks whose temporaries stay in cache; offspring counted and
summed up instead of searched, and gathered block by block.

A model is a small class whose methods work on one block; the loop around them is shared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from benchmarks.models_time import GROWTH, LORENZ, TREND

BLOCK = 8192  # particles
SHARE = 0.5  # of the particles, below which their effective number has them resampled


@dataclass(frozen=True)
class Filtered:
    """Means of the slices, shape (steps, d), and increments of the log-likelihood, (steps,)."""

    mean: np.ndarray
    increments: np.ndarray


class Model(Protocol):
    """One model by hand: ``x``, ``noise`` and ``spare`` have shape (d, block), all else (block,)."""

    dimension: int
    constant: float  # of the log density of an observation

    def start(self, x: np.ndarray) -> None:
        """Draws of slice 0 in place of standard normal ``x``."""

    def move(self, x: np.ndarray, noise: np.ndarray, spare: np.ndarray, t: int) -> None:
        """The next slice in place of ``x``, given standard normal ``noise``."""

    def weigh(self, x: np.ndarray, y: float, out: np.ndarray, spare: np.ndarray) -> None:
        """Log density of ``y`` less the constant."""


def growth(y: np.ndarray, particles: int, seed: int) -> Filtered:
    """The benchmark of de Freitas; slices whose y is NaN are not weighted."""
    return bootstrap(_Growth(), y, particles, seed)


def trend(y: np.ndarray, particles: int, seed: int) -> Filtered:
    """Three scalar states, in the order log scale, speed, position."""
    return bootstrap(_Trend(), y, particles, seed)


def lorenz(y: np.ndarray, particles: int, seed: int) -> Filtered:
    """One state that is a 3-vector."""
    return bootstrap(_Lorenz(), y, particles, seed)


def bootstrap(model: Model, y: np.ndarray, particles: int, seed: int) -> Filtered:
    """Filter a series, shape (steps,), by ``particles`` draws per slice."""
    steps, n, d = len(y), particles, model.dimension
    rng = np.random.Generator(np.random.SFC64(seed))
    cloud = _Cloud(d, n)
    x, blocks = cloud.values[0], cloud.blocks[0]
    rng.standard_normal(out=x)
    model.start(x)
    mean, increments = np.empty((steps, d)), np.zeros(steps)
    ess, level = float(n), math.log(n)
    largest, add, minus, exp = np.maximum.reduce, np.add.reduce, np.subtract, np.exp
    for t, seen in enumerate(y.tolist()):
        again = t > 0 and ess < SHARE * n
        source, ancestors = x, None
        if again:
            ancestors = cloud.ancestors(rng.random())
            current = 1 if x is cloud.values[0] else 0
            x, blocks = cloud.values[current], cloud.blocks[current]
            level = math.log(n)
        fresh, missing, top = again or t == 0, math.isnan(seen), -math.inf
        for part, log, _, noise, spare, low, high in blocks:
            if ancestors is not None:
                for old, new in zip(source, part, strict=True):
                    old.take(ancestors[low:high], out=new, mode="clip")
            if t:
                rng.standard_normal(out=noise)
                model.move(part, noise, spare, t)
            if missing:
                if fresh:
                    log.fill(0.0)
            elif fresh:
                model.weigh(part, seen, log, spare)
            else:
                model.weigh(part, seen, noise[0], spare)
                log += noise[0]
            top = max(top, float(largest(log)))
        total, squares, moments = 0.0, 0.0, np.zeros(d)
        for part, log, weights, _, _, _, _ in blocks:
            minus(log, top, out=weights)
            exp(weights, out=weights)
            total += float(add(weights))
            squares += float(weights.dot(weights))
            moments += part.dot(weights)
        mean[t] = moments / total
        ess = total * total / squares
        before, level = level, top + math.log(total)
        increments[t] = level - before + (0.0 if missing else model.constant)
    return Filtered(mean, increments)


class _Cloud:
    """Two sets of values, to resample from one into the other, weights, and views of all by block."""

    def __init__(self, dimension: int, n: int) -> None:
        self.n = n
        self.values = [np.empty((dimension, n)), np.empty((dimension, n))]
        self.log, self.weights = np.empty(n), np.empty(n)
        self.running, self.edges = np.empty(n), np.empty(n, np.intp)
        width = min(n, BLOCK)
        noise, spare = np.empty(dimension * width), np.empty(dimension * width)
        spans = [(low, min(low + width, n)) for low in range(0, n, width)]
        self.blocks = [
            [
                (
                    values[:, low:high],
                    self.log[low:high],
                    self.weights[low:high],
                    noise[: dimension * (high - low)].reshape(dimension, -1),
                    spare[: dimension * (high - low)].reshape(dimension, -1),
                    low,
                    high,
                )
                for low, high in spans
            ]
            for values in self.values
        ]

    def ancestors(self, u: float) -> np.ndarray:
        """Systematic resampling: sorted positions of the ancestors."""
        running, edges, n = self.running, self.edges, self.n
        np.add.accumulate(self.weights, out=running)
        running *= n / running[-1]
        running += u
        edges[:] = running
        edges[-1] = n  # the sum may round below n
        counts = np.bincount(edges, minlength=n)[:n]
        return np.add.accumulate(counts, out=counts)


class _Growth:
    dimension = 1
    constant = -0.5 * math.log(2.0 * math.pi * GROWTH.noise_variance)
    scale = math.sqrt(GROWTH.state_variance)
    root = math.sqrt(0.5 / GROWTH.noise_variance)

    def start(self, x: np.ndarray) -> None:
        x *= math.sqrt(GROWTH.start_variance)

    def move(self, x: np.ndarray, noise: np.ndarray, spare: np.ndarray, t: int) -> None:
        np.multiply(x, x, out=spare)  # x (1/2 + 25 / (1 + x^2)) + 8 cos(1.2 t) + noise
        spare += 1.0
        np.divide(25.0, spare, out=spare)
        spare += 0.5
        x *= spare
        noise *= self.scale
        noise += 8.0 * math.cos(1.2 * t)
        x += noise

    def weigh(self, x: np.ndarray, y: float, out: np.ndarray, spare: np.ndarray) -> None:
        part = x[0]
        np.multiply(part, part, out=out)
        out *= self.root / 20.0
        out -= self.root * y
        np.multiply(out, out, out=out)
        np.negative(out, out=out)


class _Trend:
    dimension = 3
    constant = -0.5 * math.log(2.0 * math.pi)
    scales = np.array([[TREND.log_scale_scale], [TREND.speed_scale], [TREND.position_scale]])
    decays = np.array([[TREND.log_scale_decay], [TREND.speed_decay]])

    def start(self, x: np.ndarray) -> None:
        x *= TREND.start_scale
        # the position of slice 0 hangs on no speed

    def move(self, x: np.ndarray, noise: np.ndarray, spare: np.ndarray, t: int) -> None:
        noise *= self.scales
        x[:2] *= self.decays
        x += noise
        x[2] += x[1]

    def weigh(self, x: np.ndarray, y: float, out: np.ndarray, spare: np.ndarray) -> None:
        scaled = spare[0]
        np.negative(x[0], out=scaled)
        np.exp(scaled, out=scaled)
        np.subtract(x[2], y, out=out)
        out *= scaled
        out *= out
        out *= -0.5
        out -= x[0]


class _Lorenz:
    dimension = 3
    constant = -0.5 * math.log(2.0 * math.pi * LORENZ.noise_scale**2)
    root = np.array(LORENZ.root)
    scale = math.sqrt(0.5) / LORENZ.noise_scale

    def start(self, x: np.ndarray) -> None:
        x *= LORENZ.start_scale
        x += np.array(LORENZ.start_mean)[:, None]

    def move(self, x: np.ndarray, noise: np.ndarray, spare: np.ndarray, t: int) -> None:
        h, (a, b, c) = LORENZ.step, x
        first, second, third = spare
        np.subtract(b, a, out=first)
        first *= h * LORENZ.sigma
        np.subtract(LORENZ.rho, c, out=second)
        second *= a
        second -= b
        second *= h
        np.multiply(a, b, out=third)
        third *= h
        c *= 1.0 - h * LORENZ.beta
        x += spare
        np.dot(self.root, noise, out=spare)
        x += spare

    def weigh(self, x: np.ndarray, y: float, out: np.ndarray, spare: np.ndarray) -> None:
        np.subtract(x[0], y, out=out)
        out *= self.scale
        np.multiply(out, out, out=out)
        np.negative(out, out=out)
