"""Sums over one axis of large tables, as matrix products of bounded size.

A product with a vector of ones adds up short rows an order of magnitude faster than `numpy.sum`.
Above a certain size BLAS would split the work over threads, which stalls for milliseconds when
another process holds the other core; so large tables go through in blocks that stay below it.
"""

from __future__ import annotations

import numpy as np

_BLOCK = 8192  # entries: OpenBLAS starts threads for a matrix-vector product at 9216
_LONG_ROW = 4096  # beyond, rows are long enough for a plain loop over contiguous memory

_SHORT = np.ones(1024)


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
