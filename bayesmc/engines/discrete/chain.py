"""Forwards and backwards along a chain of joint states: filtering, smoothing, the most likely path.

Sums run over probabilities that are scaled row by row, three array operations a slice. Where a probability
that is not zero would leave the range of floating point and might be needed later, the chain is passed again
in logs, so that no answer depends on the size of the densities.

References
----------
Rabiner (1989), A tutorial on hidden Markov models; Koller and Friedman (2009), sec. 15.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.engines.discrete.slices import Block

#: below this a probability may have lost digits
TINY = 1e-290
#: transitions above this bring back whatever was lost, in one slice
FLOOR = 1e-100

#: slices after which the score of the best path starts again from zero
_REST = 32

#: makes the blocks of a chain anew: ``blocks(False)`` first to last, ``blocks(True)`` last to first
Blocks = Callable[[bool], Iterator[Block]]


@dataclass(frozen=True, eq=False)
class Passed:
    """Beliefs about the states of a chain.

    Attributes
    ----------
    belief : ndarray, shape (steps, sequences, states)
    log : ndarray or None
        Their logs, where the pass was made in logs.
    increments : ndarray, shape (steps, sequences)
        Log density of each row given those before.
    """

    belief: np.ndarray
    log: np.ndarray | None
    increments: np.ndarray

    def logs(self, steps: slice) -> np.ndarray:
        """Logs of the beliefs of some slices."""
        if self.log is not None:
            return self.log[steps]
        with np.errstate(divide="ignore"):
            return np.log(self.belief[steps])


def filtered(
    blocks: Blocks, steps: int, sequences: int, size: int, before: np.ndarray | None = None
) -> Passed:
    """Beliefs given the rows up to each slice; ``before`` are logs of those in the slice before the first."""
    found = _by_scaling(blocks, steps, sequences, size, before)
    return found if found is not None else _in_logs(blocks, steps, sequences, size, before)


def smoothed(blocks: Blocks, passed: Passed) -> Passed:
    """Beliefs given all rows, from those of the filter."""
    back = _back_in_logs if passed.log is not None else _back
    source = passed.log if passed.log is not None else passed.belief
    found = np.empty_like(source)
    found[-1] = source[-1]
    for block in blocks(True):
        if block.fixed is not None:
            before = slice(block.start - 1, block.stop - 1)
            back(block, source[before], found[block.start - 1 : block.stop])
    return _from(passed, found)


def lagged(blocks: Blocks, passed: Passed, lag: int) -> Passed:
    """Beliefs given the rows up to ``lag`` slices later."""
    in_logs = passed.log is not None
    source = passed.log if passed.log is not None else passed.belief
    found = source
    for _ in range(min(lag, len(source) - 1)):
        moved = np.empty_like(source)
        moved[-1] = source[-1]
        for block in blocks(False):
            if block.fixed is None:
                continue
            before, now = slice(block.start - 1, block.stop - 1), slice(block.start, block.stop)
            if in_logs:
                matrix = _log_matrix(block)
                ahead = _times_log(source[before], matrix)
                with np.errstate(invalid="ignore"):
                    ratio = np.where(found[now] == -np.inf, -np.inf, found[now] - ahead)
                moved[before] = source[before] + _times_log(ratio, np.swapaxes(matrix, -1, -2))
            else:
                matrix, _ = _matrix(block)
                ratio = found[now] * _inverse(_times(source[before], matrix))
                moved[before] = source[before] * _times(ratio, np.swapaxes(matrix, -1, -2))
        found = moved
    return _from(passed, found)


def most_likely(blocks: Blocks, steps: int, sequences: int, size: int) -> np.ndarray | None:
    """The states of the most likely path, shape (steps, sequences); ties go to the first state.

    None where no path is possible.

    References
    ----------
    Viterbi (1967), IEEE Transactions on Information Theory 13.
    """
    origin = np.zeros((steps, sequences, size), dtype=np.min_scalar_type(max(size - 1, 0)))
    best = np.zeros((sequences, size))
    for block in blocks(False):
        turned = None if block.fixed is None else np.swapaxes(_log_matrix(block), -1, -2)
        for k in range(block.stop - block.start):
            t = block.start + k
            if turned is not None:
                ways = best[:, None, :] + (turned if turned.ndim == 3 else turned[k])
                origin[t] = ways.argmax(axis=-1)
                best = ways.max(axis=-1)
            best = best + block.likelihood[k]
            if t % _REST == 0:  # digits stay, whatever the length
                top = best.max(axis=-1, keepdims=True)
                best = best - np.where(np.isfinite(top), top, 0.0)
    if not (best.max(axis=-1) > -np.inf).all():
        return None
    path = np.empty((steps, sequences), dtype=np.intp)
    path[-1] = best.argmax(axis=-1)
    every = np.arange(sequences)
    for t in range(steps - 1, 0, -1):
        path[t - 1] = origin[t, every, path[t]]
    return path


# ---- scaled probabilities -----------------------------------------------------------------------


def _by_scaling(
    blocks: Blocks, steps: int, sequences: int, size: int, before: np.ndarray | None
) -> Passed | None:
    """The forward pass on probabilities; None where they leave the range of floating point."""
    belief = np.empty((steps, sequences, size))
    scale = np.empty((steps, sequences))
    shift = np.empty((steps, sequences))
    last = None if before is None else np.exp(before)
    mixes, first = True, None
    with np.errstate(all="ignore"):
        for block in blocks(False):
            first = block.start if first is None else first
            rows = slice(block.start - first, block.stop - first)
            likelihood, off = _scaled(block.likelihood, 1)
            shift[rows] = off
            if block.fixed is None:
                scale[rows] = likelihood.sum(axis=-1)
                belief[rows] = likelihood / scale[rows][..., None]
            else:
                assert last is not None
                matrix, more = _matrix(block)
                shift[rows] += more
                mixes &= bool(matrix.min(initial=1.0) >= FLOOR)
                _forward(matrix, likelihood, last, belief[rows], scale[rows])
            last = belief[rows][-1]
        sound = bool((scale > 0).all())
        increments = np.log(scale) + shift
    if not sound:
        return None
    if not mixes and belief.min(initial=1.0) < TINY and _lost(blocks, belief, before):
        return None
    return Passed(belief, None, increments)


def _forward(
    matrix: np.ndarray,
    likelihood: np.ndarray,
    last: np.ndarray,
    belief: np.ndarray,
    scale: np.ndarray,
) -> None:
    """Fill in the beliefs of a block; ``matrix`` has shape (rows or none, sequences or 1, states, states)."""
    if matrix.ndim == 3 and len(matrix) == 1:
        if belief.shape[1] == 1:
            _forward_one(matrix[0], likelihood[:, 0], last[0], belief[:, 0], scale[:, 0])
            return
        dot, multiply, divide = np.dot, np.multiply, np.divide
        step, ones = matrix[0], np.ones((matrix.shape[-1], 1))
        for row, weights, total in zip(belief, likelihood, scale[..., None], strict=True):
            dot(last, step, out=row)
            multiply(row, weights, out=row)
            dot(row, ones, out=total)
            divide(row, total, out=row)
            last = row
        return
    for k, row in enumerate(belief):
        np.multiply(_times(last, matrix if matrix.ndim == 3 else matrix[k]), likelihood[k], out=row)
        np.add.reduce(row, axis=-1, out=scale[k])
        np.divide(row, scale[k][:, None], out=row)
        last = row


def _forward_one(
    step: np.ndarray,
    likelihood: np.ndarray,
    last: np.ndarray,
    belief: np.ndarray,
    scale: np.ndarray,
) -> None:
    """One sequence: the loop that everything else is measured against."""
    dot, multiply, divide = np.dot, np.multiply, np.divide
    ahead, ones, totals = np.empty(len(step)), np.ones(len(step)), []
    for row, weights in zip(belief, likelihood, strict=True):
        dot(last, step, out=ahead)
        multiply(ahead, weights, out=row)
        total = dot(row, ones)
        totals.append(total)
        divide(row, total, out=row)
        last = row
    scale[:] = totals


def _back(block: Block, before: np.ndarray, found: np.ndarray) -> None:
    """Fill in ``found[:-1]``, the slices before those of a block, from its last row backwards."""
    matrix, _ = _matrix(block)
    inverse = _inverse(_times(before, matrix))
    turned = np.ascontiguousarray(np.swapaxes(matrix, -1, -2))
    if matrix.ndim == 3 and len(matrix) == 1 and found.shape[1] == 1:
        dot, multiply, step = np.dot, np.multiply, turned[0]
        now = found[-1, 0].copy()
        ratio, ahead = np.empty(len(step)), np.empty(len(step))
        rows = zip(inverse[::-1, 0], before[::-1, 0], found[-2::-1, 0], strict=True)
        for scale, belief, row in rows:
            multiply(now, scale, out=ratio)
            dot(ratio, step, out=ahead)
            multiply(belief, ahead, out=row)
            now = row
    else:
        for k in range(len(before) - 1, -1, -1):
            step = turned if turned.ndim == 3 else turned[k]
            found[k] = before[k] * _times(found[k + 1] * inverse[k], step)
    found[:-1] /= found[:-1].sum(axis=-1, keepdims=True)


def _times(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``(..., sequences, states)`` times ``(sequences or 1, states, states)``, a matrix per row or one."""
    if matrix.ndim == 3 and len(matrix) == 1:
        return vectors @ matrix[0]
    return (vectors[..., None, :] @ matrix)[..., 0, :]


def _matrix(block: Block) -> tuple[np.ndarray, np.ndarray | float]:
    """Transitions of a block as probabilities up to a factor, and the log of that factor by row."""
    assert block.fixed is not None
    if block.moving is None:
        return np.exp(block.fixed), 0.0
    table, off = _scaled(block.fixed + block.moving, 2)
    return table, off


def _scaled(log: np.ndarray, axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Exponentials relative to the largest along the last axes, and its log, shape (rows, sequences)."""
    flat = log.reshape(*log.shape[: log.ndim - axes], -1)
    top = _largest(flat)
    safe = np.where(np.isfinite(top), top, 0.0)
    table = flat - safe[..., None]
    np.exp(table, out=table)
    return table.reshape(log.shape), safe


def _largest(array: np.ndarray) -> np.ndarray:
    """The largest along the last axis; a short axis goes column by column, which is faster."""
    if array.shape[-1] > 32:
        return array.max(axis=-1)
    top = array[..., 0].copy()
    for k in range(1, array.shape[-1]):
        np.maximum(top, array[..., k], out=top)
    return top


def _inverse(array: np.ndarray) -> np.ndarray:
    """Reciprocals, zero where there is none."""
    with np.errstate(divide="ignore", over="ignore"):
        found = 1.0 / array
    return np.where(np.isfinite(found), found, 0.0)


def _lost(blocks: Blocks, belief: np.ndarray, before: np.ndarray | None) -> bool:
    """Whether some state is possible that the beliefs have as (nearly) zero."""
    last = None if before is None else (before > -np.inf).astype(float)
    first = None
    for block in blocks(False):
        first = block.start if first is None else first
        allowed = block.likelihood > -np.inf
        fixed = None if block.fixed is None else np.isfinite(block.fixed).astype(float)
        for k in range(block.stop - block.start):
            if fixed is None:
                now = np.broadcast_to(allowed[k], belief.shape[1:])
            else:
                assert last is not None
                step = fixed if block.moving is None else fixed * np.isfinite(block.moving[k])
                now = (_times(last, step) > 0) & allowed[k]
            if (now & (belief[block.start - first + k] < TINY)).any():
                return True
            last = now.astype(float)
    return False


# ---- logs ---------------------------------------------------------------------------------------


def _in_logs(
    blocks: Blocks, steps: int, sequences: int, size: int, before: np.ndarray | None
) -> Passed:
    """The forward pass on logs: slower, and right whatever the densities."""
    log = np.empty((steps, sequences, size))
    increments = np.empty((steps, sequences))
    last, t = before, 0
    with np.errstate(all="ignore"):
        for block in blocks(False):
            for k in range(block.stop - block.start):
                if block.fixed is None:
                    now = np.broadcast_to(block.likelihood[k], (sequences, size))
                else:
                    assert last is not None
                    moving = None if block.moving is None else block.moving[k]
                    matrix = block.fixed if moving is None else block.fixed + moving
                    now = _times_log(last, matrix) + block.likelihood[k]
                total = log_sum_exp(now, -1)
                increments[t] = total
                log[t] = now - np.where(np.isfinite(total), total, 0.0)[:, None]
                last = log[t]
                t += 1
    return Passed(np.exp(log), log, increments)


def _back_in_logs(block: Block, before: np.ndarray, found: np.ndarray) -> None:
    """``_back`` on logs."""
    matrix = _log_matrix(block)
    ahead = _times_log(before, matrix)
    turned = np.swapaxes(matrix, -1, -2)
    with np.errstate(all="ignore"):
        for k in range(len(before) - 1, -1, -1):
            ratio = np.where(found[k + 1] == -np.inf, -np.inf, found[k + 1] - ahead[k])
            found[k] = before[k] + _times_log(ratio, turned if turned.ndim == 3 else turned[k])


def _log_matrix(block: Block) -> np.ndarray:
    assert block.fixed is not None
    return block.fixed if block.moving is None else block.fixed + block.moving


def _times_log(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``_times`` on logs."""
    return log_sum_exp(vectors[..., None] + matrix, -2)


def _from(passed: Passed, found: np.ndarray) -> Passed:
    if passed.log is None:
        return Passed(found, None, passed.increments)
    return Passed(np.exp(found), found, passed.increments)
