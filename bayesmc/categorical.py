"""Finite distributions given by weights or by their logs: sums in logs, and draws by inversion.

States stand on the first axis, so that a few of them are gone through array by array. No draw is ever a
state of weight zero, whatever rounding does to running sums.

References
----------
Devroye (1986), Non-Uniform Random Variate Generation, sec. III.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import ZeroProbabilityError

#: columns up to which rows are compared one column at a time, and states up to which sums go one by one
_COLUMNS, _STATES = 16, 64
#: and of arrays whose last axis is that of the states
_SHORT = 8


def log_sum_exp(log: np.ndarray, axis: Any = None) -> Any:
    """``log(sum(exp(log)))`` without overflow; minus infinity for an empty or zero sum.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.categorical import log_sum_exp
    >>> log_sum_exp(np.log([[0.25, 0.5], [0.25, 0.125]]) - 2000.0, axis=1).round(3).tolist()
    [-2000.288, -2000.981]
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if axis == -1 and log.ndim > 1 and 0 < log.shape[-1] <= _SHORT:
            log, axis = np.moveaxis(log, -1, 0), 0
        if axis == 0 and 0 < len(log) <= _STATES:
            top = _largest(log)
            top = np.where(np.isfinite(top), top, 0.0)
            total = np.exp(log[0] - top)
            for row in log[1:]:
                total += np.exp(row - top)
            return np.log(total) + top
        top = np.max(log, axis=axis, keepdims=True, initial=-np.inf)
        top = np.where(np.isfinite(top), top, 0.0)
        total = np.log(np.sum(np.exp(log - top), axis=axis, keepdims=True)) + top
    return total.item() if axis is None else np.squeeze(total, axis=axis)


def pick(weights: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Positions along the first axis, in proportion to weights.

    Parameters
    ----------
    weights : ndarray, shape (states, *shape)
        Non-negative, with a positive sum, which need not be 1.
    uniform : ndarray, shape (*shape,) or (draws, *shape)
        Random numbers, uniform on [0, 1).

    Returns
    -------
    ndarray of int, shape of ``uniform``

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.categorical import pick
    >>> weights = np.array([[0.0, 3.0], [2.0, 1.0], [0.0, 0.0]])
    >>> pick(weights, np.array([[0.0, 0.74], [0.9999, 0.76]])).tolist()
    [[1, 0], [1, 1]]
    """
    sums = np.cumsum(weights, axis=0)
    level = _below(uniform, sums[-1])
    if level.ndim < sums.ndim:
        return (level >= sums[:-1]).sum(axis=0)
    columns = sums.reshape(len(sums), -1).T
    found = np.empty((len(level), len(columns)), dtype=np.intp)
    for k, (edges, at) in enumerate(zip(columns, level.reshape(found.shape).T, strict=True)):
        found[:, k] = edges.searchsorted(at, side="right")
    return found.reshape(level.shape)


def pick_log(log: np.ndarray, uniform: np.ndarray, what: str) -> np.ndarray:
    """Positions along the first axis, in proportion to the exponentials of logs.

    Parameters
    ----------
    log : ndarray, shape (states, *shape)
    uniform : ndarray, shape (*shape,)
        Random numbers, uniform on [0, 1).
    what : str
        Whose states they are, for errors.

    Returns
    -------
    ndarray of unsigned int, shape (*shape,)

    Raises
    ------
    ZeroProbabilityError
        All states are impossible somewhere.
    """
    count, top = len(log), _largest(log)
    if not np.isfinite(top).all():
        raise impossible(what)
    sums = [np.exp(log[0] - top)]
    for row in log[1:]:
        sums.append(sums[-1] + np.exp(row - top))
    level = uniform * sums[-1]
    if count == 1:
        return np.zeros(top.shape, dtype=np.uint8)
    found = (level >= sums[0]).view(np.uint8)
    if count > 256:
        found = found.astype(np.intp)
    for edge in sums[1:-1]:
        found = found + (level >= edge)
    return found


def pick_rows(weights: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """For each draw a column of its row, with probability in proportion to the row's weights.

    Parameters
    ----------
    weights : ndarray, shape (r, c)
        Non-negative; the rows in use have a positive sum, which need not be 1.
    rows : ndarray of int, shape (draws,)
    rng : numpy.random.Generator

    Returns
    -------
    ndarray of intp, shape (draws,)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.categorical import pick_rows
    >>> weights = np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 0.5]])
    >>> pick_rows(weights, np.array([0, 1, 0]), np.random.default_rng(0))
    array([1, 2, 1])
    """
    columns = weights.shape[1]
    uniform = rng.random(len(rows))
    if columns == 1 or not len(rows):
        return np.zeros(len(rows), dtype=np.intp)
    if len(weights) == 1:
        return pick(weights[0][:, None], uniform[:, None])[:, 0]
    if len(weights) > len(rows):  # far more rows than draws: add up only those in use
        used, rows = np.unique(rows, return_inverse=True)
        weights = weights[used]
    sums = np.cumsum(weights, axis=1)
    level = _below(uniform, sums[:, -1][rows])
    if columns > _COLUMNS:
        return _bisected(sums, rows, level)
    picked = np.zeros(len(rows), dtype=np.intp)
    for column in range(columns - 1):
        picked += sums[:, column][rows] <= level
    return picked


def edges(probs: np.ndarray) -> np.ndarray:
    """Running sums of rows up to 1, shape (rows, states - 1): a draw is how many its uniform number reaches.

    From the last possible state on they are infinite, so that no draw leads beyond it.
    """
    sums = np.cumsum(probs, axis=1)
    total = sums[:, -1:]
    found = sums / np.where(total > 0, total, 1.0)
    last = probs.shape[1] - 1 - np.argmax(probs[:, ::-1] > 0, axis=1)
    found[np.arange(probs.shape[1]) >= last[:, None]] = np.inf
    return found[:, :-1]


def searched(edges: np.ndarray, start: Any, levels: np.ndarray, width: int) -> np.ndarray:
    """How many edges of its row each level reaches, by binary search without branches.

    Parameters
    ----------
    edges : ndarray, shape (rows * width,)
        Ascending in each row, whose last ones no level reaches.
    start : ndarray of int
        Where the row of each level begins; broadcasts to ``levels``.
    width : int
        A power of two.
    """
    start = np.broadcast_to(start, levels.shape)
    at = start.copy()
    step = width // 2
    while step:
        at += step * (levels >= edges.take(at + (step - 1)))
        step //= 2
    return at - start


def impossible(what: str) -> ZeroProbabilityError:
    """That no state can follow, of which nodes."""
    return ZeroProbabilityError(
        f"{what}: no state has positive probability given the others; the chain is at an impossible "
        "configuration"
    )


# ---- private ------------------------------------------------------------------------------------


def _largest(log: np.ndarray) -> np.ndarray:
    """The largest along the first axis."""
    top = log[0]
    for row in log[1:]:
        top = np.maximum(top, row)
    return top


def _below(uniform: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Where among running sums each draw falls, never at the total itself: so small it may be."""
    return np.minimum(uniform * total, np.nextafter(total, 0.0))


def _bisected(sums: np.ndarray, rows: np.ndarray, level: np.ndarray) -> np.ndarray:
    """How many sums of its row are at most ``level``, for each draw: all rows in step."""
    last = sums.shape[1] - 1
    picked = np.zeros(len(rows), dtype=np.intp)
    step = 1 << (last.bit_length() - 1)
    while step:
        reached = picked + step
        value = sums[rows, np.minimum(reached, last) - 1]
        picked = np.where((reached <= last) & (value <= level), reached, picked)
        step >>= 1
    return picked
