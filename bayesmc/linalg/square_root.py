"""One move of a Kalman filter or smoother as functions of arrays, in array square-root form.

What is known of a slice before its row is read is a vector ``mean + rows @ noise`` with independent standard
normal ``noise``: the first entries of it are those of the slice before, the others are new. An orthogonal
transformation of the noise makes ``rows`` lower triangular, observed quantities first, which is conditioning:
their own block is the root of the innovations' covariance, the block below it the gain, the last block the
root of the covariance that is left. No covariance is ever formed, subtracted or inverted, so a start that is
vague by 10^7 loses no digits, and quantities without noise of their own, which make covariances singular, are
nothing special. The smoother goes back through the same transformations: an orthogonal matrix tells what the
noise of the slice before was, given that of the slice after.

Nothing here knows nodes or templates. Leading axes are batch.

References
----------
Kailath, Sayed and Hassibi (2000), Linear Estimation, ch. 12 (array algorithms); Särkkä and Svensson (2023),
Bayesian Filtering and Smoothing, 2nd ed., ch. 6, 7 and 12.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from bayesmc.gaussian import solve_lower
from bayesmc.linalg.patterns import lapack

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


class Conditioned(NamedTuple):
    """A slice's rows made triangular.

    Attributes
    ----------
    root : ndarray, shape (..., p, p)
        Lower root of the innovations' covariance.
    gain : ndarray, shape (..., n, p)
        What the n unknowns gain from standardised innovations.
    factor : ndarray, shape (..., n, n)
        Lower root of the unknowns' covariance given the row.
    turn : ndarray, shape (..., carried, k), or None
        Noise of the slice before as a combination of the transformed noise: p standardised innovations, n
        entries that ``factor`` multiplies, and what neither of them touches.
    certain : ndarray of bool, shape (..., p), or None
        Observed quantities that follow from those before them, without noise; None where none does. They
        stand in ``root`` with a noise of their own, which tells nothing of anything else.
    """

    root: np.ndarray
    gain: np.ndarray
    factor: np.ndarray
    turn: np.ndarray | None = None
    certain: np.ndarray | None = None


def condition(rows: np.ndarray, observed: int, carried: int | None = None) -> Conditioned:
    """Condition on the first rows.

    Parameters
    ----------
    rows : ndarray, shape (..., r, k)
        Coefficients of the noise; overwritten.
    observed : int
        How many rows, from the first, are observed.
    carried : int, optional
        With it the result has ``turn``, of the first so many entries of the noise.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.linalg.square_root import condition
    >>> found = condition(np.array([[3.0, 4.0], [3.0, 0.0]]), 1)  # y = x + 4 w, x = 3 v
    >>> found.root.tolist(), found.factor.round(6).tolist()  # var(x | y) = 9 - 81 / 25
    ([[5.0]], [[2.4]])
    """
    r, k = rows.shape[-2:]
    if k < r:
        rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], r - k))], axis=-1)
        k = r
    p = observed
    whole = rows.copy() if p else rows
    lower, turn = _triangular(rows, carried)
    certain = None
    if _has_tiny_pivot(lower):
        size = np.sqrt(np.vecdot(whole, whole))
        lower, turn, certain = _without_certain(whole, size, lower, turn, p, carried)
        _forget_rounding(lower, size, p)
    return Conditioned(lower[..., :p, :p], lower[..., p:, :p], lower[..., p:, p:], turn, certain)


def condition_many(rows: np.ndarray, observed: int) -> Conditioned:
    """``condition`` for many small matrices, without ``turn``: by Cholesky factors where that loses nothing.

    Covariances are formed there, so a pivot has lost as many digits as its square is smaller than the
    variance of its row. Where that is more than a few, all are made triangular from the rows themselves.

    Parameters
    ----------
    rows : ndarray, shape (..., r, k)
    observed : int

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.linalg.square_root import condition_many
    >>> found = condition_many(np.array([[[3.0, 4.0], [3.0, 0.0]]]), 1)
    >>> found.root.tolist(), found.factor.round(6).tolist()
    ([[[5.0]]], [[[2.4]]])
    """
    p = observed
    covariance = rows @ rows.swapaxes(-1, -2)
    try:
        lower = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return condition(rows, p)
    pivots = lower.diagonal(0, -2, -1)
    if not (pivots * pivots > _CLEAR * covariance.diagonal(0, -2, -1)).all():
        return condition(rows, p)
    return Conditioned(lower[..., :p, :p], lower[..., p:, :p], lower[..., p:, p:])


def standardised(root: np.ndarray, innovation: np.ndarray) -> np.ndarray:
    """Innovations as independent standard normals, shape (..., p)."""
    p = innovation.shape[-1]
    if p == 1:
        return innovation / root[..., 0]
    if root.ndim == 2 and innovation.ndim == 1 and p:
        return lapack().dtrtrs(root, innovation, lower=1)[0]
    return solve_lower(root, innovation)


def log_densities(
    root: np.ndarray, eta: np.ndarray, seen: Any = None, certain: np.ndarray | None = None
) -> np.ndarray:
    """Log density of a row from its standardised innovations; ``seen`` counts them, if not all.

    What is ``certain`` given the rest counts as a probability, which is one.
    """
    count = eta.shape[-1] if seen is None else seen
    diagonal = root.diagonal(0, -2, -1)
    if certain is not None:
        count = count - certain.sum(axis=-1)
        eta, diagonal = np.where(certain, 0.0, eta), np.where(certain, 1.0, diagonal)
    log_det = np.log(diagonal).sum(axis=-1)
    return -0.5 * np.vecdot(eta, eta) - log_det - count * HALF_LOG_2PI


def went_in(root: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """How large the terms are whose sum tells how far each quantity is from what those before it say.

    What rounding leaves of a difference is relative to them, not to the difference.

    Parameters
    ----------
    root : ndarray, shape (..., p, p)
    sizes : ndarray, shape (..., p)
        Absolute values of the quantities themselves.

    Examples
    --------
    >>> import numpy as np
    >>> root = np.array([[1.0, 0.0], [3.0, 2.0]])  # the second is three times the first, and noise
    >>> went_in(root, np.array([10.0, 1.0])).tolist()
    [10.0, 31.0]
    """
    terms = root.diagonal(0, -2, -1)[..., None] * _inverse(root)
    return np.matvec(np.abs(terms), sizes)


def multiplied(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """``matrix @ vector`` for batches of either."""
    if matrix.ndim == 2:
        return vectors @ matrix.T
    return np.matvec(matrix, vectors)


class Turned(NamedTuple):
    """What carries a smoother from a slice to the one before.

    Attributes
    ----------
    shift : ndarray, shape (..., carried, p)
        On standardised innovations.
    link : ndarray, shape (..., carried, carried)
        On the noise of the later slice.
    spread : ndarray, shape (..., carried, carried)
        Covariance that is left.
    """

    shift: np.ndarray
    link: np.ndarray
    spread: np.ndarray


def turned(turn: np.ndarray, observed: int, carried: int) -> Turned:
    """Split a transformation; ``carried`` entries of the later slice are known to the slice after it.

    With spread S of the later slice's noise, that of the earlier one's is ``link @ S @ link.T + spread``.
    """
    rest = turn[..., observed + carried :]
    return Turned(
        turn[..., :observed],
        turn[..., observed : observed + carried],
        rest @ np.matrix_transpose(rest),
    )


# ---- private ------------------------------------------------------------------------------------


#: what rounding leaves of a row that is a combination of those before it, relative to its size
_ROUNDING = 16 * float(np.finfo(float).eps)
#: share of a variance that is left of it by what stands before, with which its root keeps twelve digits
_CLEAR = 1e-3
#: pivots so small beside the largest entry are worth a look
_SUSPECT = 1e-11


def _has_tiny_pivot(lower: np.ndarray) -> bool:
    pivots = lower.diagonal(0, -2, -1)
    return bool(pivots.size) and not pivots.min() > _SUSPECT * np.abs(lower).max()


def _inverse(root: np.ndarray) -> np.ndarray:
    """Of lower triangles; rows from a pivot of zero on are not to be used."""
    p = root.shape[-1]
    pivots = root.diagonal(0, -2, -1)
    filled = root + np.eye(p) * (pivots == 0)[..., None]
    with np.errstate(over="ignore", invalid="ignore"):
        return np.matrix_transpose(solve_lower(filled[..., None, :, :], np.eye(p)))


def _without_certain(
    rows: np.ndarray,
    size: np.ndarray,
    lower: np.ndarray,
    turn: np.ndarray | None,
    observed: int,
    carried: int | None,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """The triangle once observed rows that follow from those before have got noise of their own.

    One after the other: what comes after such a row is only right once it is out of the way.
    """
    p, lead = observed, rows.shape[:-2]
    size = np.where(size > 0, size, 1.0)[..., :p]
    terms = went_in(lower[..., :p, :p], size)
    certain = np.zeros((*lead, p), dtype=bool)
    places = np.arange(p)
    for i in range(p):
        follows = lower[..., i, i] <= _ROUNDING * terms[..., i]
        follows |= ~lower[..., i, :].any(axis=-1)
        if not (follows & ~certain[..., i]).any():
            continue
        certain[..., i] |= follows
        fresh = np.zeros((*lead, rows.shape[-2], p))
        fresh[..., places, places] = np.where(certain, size, 0.0)
        lower, turn = _triangular(np.concatenate([rows, fresh], axis=-1), carried)
        terms = went_in(lower[..., :p, :p], size)
    return lower, turn, certain if certain.any() else None


def _forget_rounding(lower: np.ndarray, size: np.ndarray, observed: int) -> None:
    """What is known without noise has a root of exactly zero, in place."""
    p = observed
    left = lower[..., p:, p:]
    gains = lower[..., p:, :p] @ _inverse(lower[..., :p, :p])
    terms = np.maximum(size[..., p:], np.matvec(np.abs(gains), size[..., :p]))
    left[np.sqrt(np.vecdot(left, left)) <= _ROUNDING * terms] = 0.0


def _triangular(rows: np.ndarray, carried: int | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Rows as a lower triangle whose diagonal is not negative, and what turned the noise; overwrites them."""
    r = rows.shape[-2]
    if rows.ndim == 2 and rows.size:
        return _by_lapack(rows, carried)
    lower, turn = _by_numpy(rows, carried)
    signs = np.copysign(1.0, lower.diagonal(0, -2, -1))[..., None, :]
    lower *= signs
    if turn is not None:
        turn[..., :r] *= signs
    return lower, turn


@functools.cache
def _lower_mask(r: int) -> np.ndarray:
    return np.tri(r)


def _by_lapack(rows: np.ndarray, carried: int | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Householder by LAPACK's own interface: a third of the time of ``numpy.linalg.qr`` on small matrices."""
    dgeqrf, dorgqr = lapack().dgeqrf, lapack().dorgqr
    r, k = rows.shape
    packed, tau, _, _ = dgeqrf(rows.T, overwrite_a=1)
    lower = packed.T[:, :r] * _lower_mask(r)
    signs = np.copysign(1.0, lower.diagonal())
    lower *= signs
    if carried is None:
        return lower, None
    square = np.zeros((k, k), order="F")
    square[:, :r] = packed
    turn = dorgqr(square, tau, overwrite_a=1)[0][:carried].copy()
    turn[:, :r] *= signs
    return lower, turn


def _by_numpy(rows: np.ndarray, carried: int | None) -> tuple[np.ndarray, np.ndarray | None]:
    r = rows.shape[-2]
    columns = np.matrix_transpose(rows)
    if carried is None:
        triangle = np.linalg.qr(columns, mode="r")
        return np.matrix_transpose(triangle).copy(), None
    full, upper = np.linalg.qr(columns, mode="complete")
    lower = np.matrix_transpose(upper[..., :r, :]).copy()
    return lower, full[..., :carried, :].copy()
