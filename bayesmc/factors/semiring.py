"""The two ways to add and multiply: linear (fast) and logarithmic (never underflows).

Message passing is written once against these few operations. `LINEAR` runs under NumPy's
floating-point traps, so that an underflow that could matter is noticed and the pass is run again
with `LOG`. Nothing here knows of cliques.

A product with a vector of ones adds up short rows an order of magnitude faster than `numpy.sum`.
Above a certain size BLAS would split the work over threads, which stalls for milliseconds when
another process holds the other core; so large tables go through in blocks that stay below it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..categorical import log_sum_exp
from .program import SumStep

_BLOCK = 8192  # entries: OpenBLAS starts threads for a matrix-vector product at 9216
_LONG_ROW = 4096  # beyond, rows are long enough for a plain loop over contiguous memory
_SHORT = np.ones(1024)
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


def ones(count: int) -> np.ndarray:
    """A vector of ones; short ones are views of one shared array."""
    return _SHORT[:count] if count <= 1024 else np.ones(count)


def row_sums(matrix: np.ndarray) -> np.ndarray:
    """Sum over the second axis."""
    if matrix.size <= _BLOCK:
        return matrix.dot(ones(matrix.shape[1]))
    if matrix.shape[1] > _LONG_ROW:
        return np.einsum("ij->i", matrix)
    return _in_blocks(matrix, ones(matrix.shape[1]))


def weighted_rows(weights: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Sum over the first axis, each row multiplied by its weight."""
    if matrix.size <= _BLOCK:
        return weights.dot(matrix)
    rows, columns = matrix.shape
    if rows == 1:
        return matrix[0] * weights[0]
    if columns > _LONG_ROW:
        return np.einsum("i,ij->j", weights, matrix)
    size = _BLOCK // columns
    whole = rows // size
    head = whole * size
    parts = np.matmul(
        weights[:head].reshape(whole, 1, size), matrix[:head].reshape(whole, size, columns)
    )
    result = parts.sum(axis=(0, 1))
    if head < rows:
        result += weights[head:].dot(matrix[head:])
    return result


def middle_sums(table: np.ndarray) -> np.ndarray:
    """Sum a three-dimensional table over its middle axis."""
    before, summed, after = table.shape
    if summed * after <= 64:
        # One small 0/1 matrix adds up the blocks of all rows at once.
        adder = _adder(summed, after)
        flat = table.reshape(before, summed * after)
        return flat.dot(adder) if flat.size * after <= _BLOCK else _in_blocks(flat, adder)
    if summed * after <= _BLOCK:
        return np.matmul(ones(summed), table)
    return np.einsum("ijk->ik", table)


def _in_blocks(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``matrix @ right``, some thousands of entries at a time."""
    rows, columns = matrix.shape
    size = max(1, _BLOCK // columns)
    whole = rows // size
    head = whole * size
    tail = right.shape[1:]
    result = np.empty((rows, *tail))
    np.matmul(
        matrix[:head].reshape(whole, size, columns),
        right,
        out=result[:head].reshape(whole, size, *tail),
    )
    if head < rows:
        np.matmul(matrix[head:], right, out=result[head:])
    return result


_ADDERS: dict[tuple[int, int], np.ndarray] = {}


def _adder(summed: int, after: int) -> np.ndarray:
    """The 0/1 matrix that sums the leading axis of a flattened (summed, after) block."""
    found = _ADDERS.get((summed, after))
    if found is None:
        found = _ADDERS[summed, after] = np.tile(np.eye(after), (summed, 1))
    return found
