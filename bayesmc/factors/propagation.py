"""Both passes of message passing over a clique tree, in ordinary arithmetic or in logarithms.

Message passing is written once against the few operations of a semiring. `LINEAR` (fast) runs under
NumPy's floating-point traps, so that an underflow that could matter is noticed and the pass is run
again with `LOG` (never underflows). `collect` multiplies messages towards the roots, `distribute`
carries normalised beliefs back and reads off every variable's marginal on the way. Cliques below
which nothing is observed keep their tables from call to call.

A product with a vector of ones adds up short rows an order of magnitude faster than `numpy.sum`.
Above a certain size BLAS would split the work over threads, which stalls for milliseconds when
another process holds the other core; so large tables go through in blocks that stay below it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from ..categorical import log_sum_exp
from .structure import Clique, CliqueShapes, Program, SumStep

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


Mask = tuple[int, int, int, int]
"""(before, states, after, state): in a table seen so, only one state of the middle axis stays."""


@dataclass(slots=True)
class Collected:
    """What one clique holds after the collect pass.

    Attributes
    ----------
    work : ndarray
        Potential, evidence and children's messages multiplied: (separator, residual) matrix.
    total : ndarray
        Its row sums.
    message : ndarray or None
        The same rescaled for the parent; None where everything is zero.
    log_scale : float
        Log of what the rescaling divided out.
    """

    work: np.ndarray
    total: np.ndarray
    message: np.ndarray | None
    log_scale: float


@dataclass
class Potentials:
    """One table per clique, with the collected cliques that no evidence has changed."""

    tables: Sequence[np.ndarray]
    semiring: Semiring
    unobserved: dict[int, Collected] = field(default_factory=dict)


def collect(
    cliques: Sequence[Clique],
    program: Program,
    potentials: Potentials,
    changed: set[int],
    slices: Mapping[int, int],
    masks: Mapping[int, Sequence[Mask]],
) -> list[Collected] | None:
    """Messages from the leaves to the roots; None if the total is zero.

    ``changed`` are the cliques at or above evidence; ``slices`` gives the state of each sliced
    variable, ``masks`` the evidence entered by zeroing.
    """
    semiring, tables, kept = potentials.semiring, potentials.tables, potentials.unobserved
    found: list[Collected] = [None] * len(cliques)  # type: ignore[list-item]
    for k in range(len(cliques) - 1, -1, -1):
        if k not in changed:
            one = kept.get(k)
            if one is None:
                one = _collect_one(tables[k], False, k, cliques, program, found, semiring)
                kept[k] = one
        else:
            table, owned = tables[k], False
            if program.cliques[k].sliced:
                index = tuple(
                    slice(slices[v], slices[v] + 1) if v in slices else slice(None)
                    for v in cliques[k].variables
                )
                table, owned = np.array(table[index], order="C"), True
            for mask in masks.get(k, ()):
                table, owned = _masked(table, mask, semiring.zero), True
            one = _collect_one(table, owned, k, cliques, program, found, semiring)
        if one.message is None:
            return None
        found[k] = one
    return found


def distribute(
    cliques: Sequence[Clique],
    program: Program,
    collected: Sequence[Collected],
    semiring: Semiring,
) -> tuple[list[np.ndarray], np.ndarray]:
    """Beliefs from the roots to the leaves.

    Returns
    -------
    ratios : list of ndarray
        For each clique the row weights that turn its collected table into its belief.
    marginals : ndarray
        The marginals of all variables that are not sliced, end to end, linear.
    """
    multiply, ratio_of = semiring.multiply, semiring.ratio
    sum_steps, weighted_rows = semiring.sum_steps, semiring.weighted_rows
    one = np.full(1, 1.0 if semiring.zero == 0.0 else 0.0)
    above: list[np.ndarray] = [one] * len(cliques)
    ratios: list[np.ndarray] = []
    marginals: list[np.ndarray] = []
    shapes = program.cliques
    for k, clique in enumerate(cliques):
        own = collected[k]
        ratio = ratio_of(above[k], own.total)
        ratios.append(ratio)
        outputs = shapes[k].outputs
        if outputs:
            residual = weighted_rows(ratio, own.work)
            for _, steps in outputs:
                marginals.append(sum_steps(residual, steps) if steps else residual)
        if clique.children:
            belief = multiply(own.work, ratio[:, None])
            for child in clique.children:
                above[child] = sum_steps(belief, shapes[child].from_parent)
    if not marginals:
        return ratios, np.zeros(0)
    flat = semiring.to_linear(np.concatenate(marginals))
    # The beliefs are normalised up to rounding, which grows along the tree; end it here.
    flat /= np.repeat(np.add.reduceat(flat, program.starts), program.counts)
    return ratios, flat


def _collect_one(
    table: np.ndarray,
    owned: bool,
    k: int,
    cliques: Sequence[Clique],
    program: Program,
    found: Sequence[Collected],
    semiring: Semiring,
) -> Collected:
    """Multiply the children's messages into a table, in place once the table is our own."""
    multiply = semiring.multiply
    for child in cliques[k].children:
        shapes: CliqueShapes = program.cliques[child]
        message = found[child].message
        assert message is not None
        if not shapes.parent_runs:  # a parent with a single entry
            table, owned = multiply(table, message[0]), True
            continue
        view = table.reshape(shapes.parent_runs)
        factor = message.reshape(shapes.message_runs)
        if owned:
            multiply(view, factor, out=view)
        else:
            table, owned = multiply(view, factor), True
    work = table.reshape(program.cliques[k].matrix)
    total = semiring.row_sums(work)
    message, log_scale = semiring.rescale(total)
    return Collected(work, total, message, log_scale)


def _masked(table: np.ndarray, mask: Mask, zero: float) -> np.ndarray:
    before, states, after, state = mask
    result = np.zeros((before, states, after))
    if zero != 0.0:
        result.fill(zero)
    result[:, state] = table.reshape(before, states, after)[:, state]
    return result


def total_log_scale(collected: Sequence[Collected]) -> float:
    """The log of the total of the product, once collected."""
    return math.fsum(one.log_scale for one in collected)
