"""Filtering and smoothing of a hidden Markov model by a loop in NumPy: one sequence, scaled.

The emissions' densities of all steps are taken at once; the loop writes into rows of arrays that
exist. This is the recursion of the textbook, with nothing that knows the number of states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Filtered:
    """Probabilities of the states, shape (steps, K), and increments of the log-likelihood."""

    probabilities: np.ndarray
    increments: np.ndarray


def filtered(
    y: np.ndarray, initial: np.ndarray, transition: np.ndarray, means: np.ndarray
) -> Filtered:
    """Each state given the rows up to it; ``y`` has shape (steps,), emissions unit variance."""
    likelihood, level = _likelihood(y, means)
    found = np.empty_like(likelihood)
    scales = np.empty(len(y))
    add, times, divide, dot = np.add.reduce, np.multiply, np.divide, np.dot
    row = found[0]
    times(initial, likelihood[0], out=row)
    scales[0] = scale = add(row)
    divide(row, scale, out=row)
    for t in range(1, len(y)):
        new = found[t]
        dot(row, transition, out=new)
        times(new, likelihood[t], out=new)
        scales[t] = scale = add(new)
        divide(new, scale, out=new)
        row = new
    return Filtered(found, np.log(scales) + level)


def smoothed(
    y: np.ndarray, initial: np.ndarray, transition: np.ndarray, means: np.ndarray
) -> Filtered:
    """Each state given all rows, and the increments of the filter."""
    likelihood, _ = _likelihood(y, means)
    forward = filtered(y, initial, transition, means)
    found = forward.probabilities.copy()
    add, times, divide, dot = np.add.reduce, np.multiply, np.divide, np.dot
    back, message = np.ascontiguousarray(transition.T), np.ones(len(initial))
    spare = np.empty(len(initial))
    for t in range(len(y) - 2, -1, -1):
        times(message, likelihood[t + 1], out=spare)
        dot(spare, back, out=message)
        divide(message, add(message), out=message)
        row = found[t]
        times(row, message, out=row)
        divide(row, add(row), out=row)
    return Filtered(found, forward.increments)


def _likelihood(y: np.ndarray, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Densities relative to the largest of their step, (steps, K), and its logarithm, (steps,)."""
    log = -0.5 * (y[:, None] - means) ** 2
    top = log.max(axis=1)
    return np.exp(log - top[:, None]), top - 0.5 * math.log(2.0 * math.pi)
