"""The two ways to add and multiply: linear (fast) and logarithmic (never underflows).

Message passing is written once against these few operations. `LINEAR` runs under NumPy's
floating-point traps, so that an underflow that could matter is noticed and the pass is run again
with `LOG`. Nothing here knows of cliques.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..categorical import log_sum_exp
from .products import middle_sums, ones, row_sums, weighted_rows
from .program import SumStep

_TINY = 5e-324  # the least positive float: no positive sum is changed by a maximum with it


class Semiring(Protocol):
    """What message passing needs of numbers."""

    multiply: np.ufunc
    zero: float

    def row_sums(self, matrix: np.ndarray) -> np.ndarray:
        """Sum over the second axis."""

    def sum_steps(self, table: np.ndarray, steps: Sequence[SumStep]) -> np.ndarray:
        """Sum a table over runs of its axes; flat."""

    def rescale(self, message: np.ndarray) -> tuple[np.ndarray | None, float]:
        """The message with mean 1 and the log of what was divided out; None if it is all zero."""

    def ratio(self, above: np.ndarray, below: np.ndarray) -> np.ndarray:
        """Division with 0/0 = 0, as in Hugin propagation."""

    def weighted_rows(self, weights: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Sum over rows, each multiplied by its weight."""

    def to_linear(self, values: np.ndarray) -> np.ndarray:
        """Leave the semiring."""


class Linear(Semiring):
    """Ordinary arithmetic; sums are matrix-vector products, several times faster than `sum`."""

    multiply: np.ufunc = np.multiply
    zero = 0.0

    def row_sums(self, matrix: np.ndarray) -> np.ndarray:
        return row_sums(matrix)

    def sum_steps(self, table: np.ndarray, steps: Sequence[SumStep]) -> np.ndarray:
        for before, summed, after in steps:
            if after == 1:
                table = row_sums(table.reshape(before, summed))
            elif before == 1:
                table = weighted_rows(ones(summed), table.reshape(summed, after))
            else:
                table = middle_sums(table.reshape(before, summed, after))
        return table.reshape(-1)

    def rescale(self, message: np.ndarray) -> tuple[np.ndarray | None, float]:
        size = len(message)
        mean = float(row_sums(message.reshape(1, size))[0]) / size
        if mean == 0.0:
            return None, -math.inf
        return message / mean, math.log(mean)

    def ratio(self, above: np.ndarray, below: np.ndarray) -> np.ndarray:
        return above / np.maximum(below, _TINY)

    def weighted_rows(self, weights: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        return weighted_rows(weights, matrix)

    def to_linear(self, values: np.ndarray) -> np.ndarray:
        return values


class Log(Semiring):
    """Arithmetic on logarithms: products are sums, sums are log-sum-exp."""

    multiply: np.ufunc = np.add
    zero = -math.inf

    def row_sums(self, matrix: np.ndarray) -> np.ndarray:
        return log_sum_exp(matrix, 1)

    def sum_steps(self, table: np.ndarray, steps: Sequence[SumStep]) -> np.ndarray:
        for before, summed, after in steps:
            table = log_sum_exp(table.reshape(before, summed, after), 1)
        return table.reshape(-1)

    def rescale(self, message: np.ndarray) -> tuple[np.ndarray | None, float]:
        top = float(message.max())
        if top == -math.inf:
            return None, -math.inf
        return message - top, top

    def ratio(self, above: np.ndarray, below: np.ndarray) -> np.ndarray:
        return above - np.where(below == -math.inf, 0.0, below)

    def weighted_rows(self, weights: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        return log_sum_exp(matrix + weights[:, None], 0)

    def to_linear(self, values: np.ndarray) -> np.ndarray:
        return np.exp(values)


LINEAR = Linear()
LOG = Log()
