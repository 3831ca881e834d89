"""Linear algebra of Gaussians as functions of arrays: distances, linear maps, Cholesky factors.

Everything goes through Cholesky factors and forward substitution; nothing is inverted explicitly.
Leading axes are batch and broadcast. This room knows arrays only: no distribution, no filter.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from bayesmc.errors import ParameterError, ShapeError
from bayesmc.shapes import first_index

_SMALL = 16  # rows of a matrix whose factor is kept
_ROUNDING = 1e-14  # of a variance: what rounding leaves of a pivot that is zero
_SYMMETRY = 1e-8  # of sqrt(a_ii a_jj): what rounding leaves of a product such as H S H'


def squared_mahalanobis(
    x: Any, mean: Any, cov: Any = None, *, scale_tril: Any = None
) -> np.ndarray:
    """Squared Mahalanobis distance ``(x - mean)' cov^-1 (x - mean)``.

    Parameters
    ----------
    x, mean : array_like, shape (..., d)
    cov : array_like, shape (..., d, d), optional
        Positive definite covariance.
    scale_tril : array_like, shape (..., d, d), optional
        Instead of ``cov``, its lower Cholesky factor.

    Returns
    -------
    ndarray, shape (...)
        Dimensionless; chi-square with d degrees of freedom when x is normal.

    Raises
    ------
    ParameterError
        ``cov`` is not symmetric positive definite; ``index`` is the first such matrix.

    References
    ----------
    Mahalanobis, On the generalised distance in statistics, 1936. Solved by forward substitution:
    Golub and Van Loan, Matrix Computations, 4th ed., algorithm 3.1.1.

    Examples
    --------
    >>> from bayesmc.gaussian import squared_mahalanobis
    >>> float(squared_mahalanobis([2.0, 0.0], [0.0, 0.0], [[4.0, 0.0], [0.0, 1.0]]))
    1.0
    """
    if (cov is None) == (scale_tril is None):
        raise ParameterError("squared_mahalanobis: give exactly one of cov and scale_tril")
    factor = cholesky(cov) if scale_tril is None else np.asarray(scale_tril, dtype=float)
    residual = np.asarray(x, dtype=float) - np.asarray(mean, dtype=float)
    z = solve_lower(factor, residual)
    return np.vecdot(z, z)


def linear_map(
    mean: Any, cov: Any, matrix: Any, offset: Any = None, noise_cov: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of ``H x + offset + noise`` for a Gaussian ``x``.

    Parameters
    ----------
    mean : array_like, shape (..., n)
    cov : array_like, shape (..., n, n)
    matrix : array_like, shape (..., m, n)
        ``H``.
    offset : array_like, shape (..., m), optional
    noise_cov : array_like, shape (..., m, m), optional
        Covariance of independent additive noise.

    Returns
    -------
    mean : ndarray, shape (..., m)
        ``H mean + offset``.
    cov : ndarray, shape (..., m, m)
        ``H cov H' + noise_cov``, exactly symmetric.

    References
    ----------
    Murphy, Probabilistic Machine Learning: Advanced Topics, 2023, section 2.3.1.

    Examples
    --------
    >>> from bayesmc.gaussian import linear_map
    >>> mean, cov = linear_map([1.0, 2.0], [[1.0, 0.0], [0.0, 4.0]], [[1.0, 1.0]])
    >>> mean.tolist(), cov.tolist()
    ([3.0], [[5.0]])
    """
    mean, cov, matrix = (np.asarray(a, dtype=float) for a in (mean, cov, matrix))
    mapped_mean = np.matvec(matrix, mean)
    if offset is not None:
        mapped_mean = mapped_mean + np.asarray(offset, dtype=float)
    mapped_cov = matrix @ cov @ np.matrix_transpose(matrix)
    if noise_cov is not None:
        mapped_cov = mapped_cov + np.asarray(noise_cov, dtype=float)
    return mapped_mean, 0.5 * (mapped_cov + np.matrix_transpose(mapped_cov))


def cholesky(cov: Any) -> np.ndarray:
    """Lower Cholesky factor of each covariance, shape (..., d, d).

    Raises
    ------
    ParameterError
        A matrix is not symmetric positive definite; ``index`` is the first one's batch index.

    Examples
    --------
    >>> from bayesmc.gaussian import cholesky
    >>> cholesky([[4.0, 0.0], [0.0, 9.0]]).tolist()
    [[2.0, 0.0], [0.0, 3.0]]
    """
    factor, bad = try_cholesky(cov)
    if bad is not None:
        index = first_index(bad)
        raise ParameterError(
            "cholesky: cov must be symmetric positive definite"
            + (f"; the matrix at index {index} is not" if index else ""),
            index,
        )
    return factor


def try_cholesky(cov: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Cholesky factors, and which matrices have none (None if all have); those get the identity.

    Symmetry is asked up to 1e-8 of ``sqrt(a_ii a_jj)``; the lower triangle is what counts.
    """
    cov = np.asarray(cov, dtype=float)
    if cov.ndim < 2 or cov.shape[-1] != cov.shape[-2]:
        raise ShapeError(f"cov must have shape (..., d, d); got {cov.shape}")
    if cov.ndim == 2 and cov.shape[-1] <= _SMALL:
        factor = _root_of(cov.tobytes(), cov.shape[-1])
        if factor is not None:
            return factor, None
    try:
        factor, bad = np.linalg.cholesky(cov), None
    except np.linalg.LinAlgError:
        factor, bad = _cholesky_by_columns(cov)
    if bad is None and np.isfinite(factor).all() and (cov == np.matrix_transpose(cov)).all():
        return factor, None
    faulty = ~_is_symmetric(cov) | ~np.isfinite(factor).all(axis=(-2, -1))
    if bad is not None:
        faulty |= bad
    if not faulty.any():
        return factor, None
    return np.where(faulty[..., None, None], np.eye(cov.shape[-1]), factor), faulty


def singular_cholesky(cov: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lower roots of covariances that may be singular, and which matrices have none (identities there).

    A pivot that is nothing but rounding is 0, and so is its column.

    References
    ----------
    Golub and Van Loan, Matrix Computations, 4th ed., section 4.2.8 (semidefinite matrices).

    Examples
    --------
    >>> from bayesmc.gaussian import singular_cholesky
    >>> root, bad = singular_cholesky([[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 9.0]])
    >>> root.tolist(), bool(bad)
    ([[2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 3.0]], False)
    """
    cov = np.asarray(cov, dtype=float)
    d = cov.shape[-1]
    scale = np.abs(np.linalg.diagonal(cov))
    bad = ~_is_symmetric(cov) | ~np.isfinite(cov).all(axis=(-2, -1))
    factor = np.zeros_like(cov)
    with np.errstate(all="ignore"):
        for j in range(d):
            row = factor[..., j, :j]
            pivot = cov[..., j, j] - np.vecdot(row, row)
            below = cov[..., j + 1 :, j] - np.matvec(factor[..., j + 1 :, :j], row)
            rounding = _ROUNDING * d * scale[..., j]
            none = np.abs(pivot) <= rounding
            bad |= pivot < -rounding
            # what a component without noise of its own leaves of the others must be nothing, too
            left = np.abs(below) > np.sqrt(
                _ROUNDING * d * scale[..., j, None] * scale[..., j + 1 :]
            )
            bad |= none & left.any(axis=-1)
            root = np.sqrt(np.where(none | (pivot <= 0), 1.0, pivot))
            factor[..., j, j] = np.where(none, 0.0, root)
            factor[..., j + 1 :, j] = np.where(none[..., None], 0.0, below / root[..., None])
    return np.where(bad[..., None, None], np.eye(d), factor), bad


@functools.lru_cache(maxsize=256)
def _root_of(numbers: bytes, d: int) -> np.ndarray | None:
    """The Cholesky factor of one small matrix, read-only; None where it is not symmetric positive definite.

    A covariance that never changes is given again and again: by the slices of a filter, or by the sweeps of
    a chain. The matrix itself is the key, since an array may be written to.
    """
    cov = np.frombuffer(numbers).reshape(d, d)
    try:
        factor = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(factor).all() and (cov == cov.T).all()):
        return None
    factor.flags.writeable = False
    return factor


def solve_lower(factor: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """``z`` with ``factor @ z = vector`` by forward substitution.

    ``factor`` (..., d, d) is lower triangular, ``vector`` (..., d); batches broadcast. A general
    solver would pivot, which loses the small components of a badly scaled covariance.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.gaussian import solve_lower
    >>> solve_lower(np.array([[2.0, 0.0], [1.0, 1.0]]), np.array([2.0, 3.0])).tolist()
    [1.0, 2.0]
    """
    d = factor.shape[-1]
    if vector.shape[-1:] != (d,):
        raise ShapeError(f"vectors of shape {vector.shape} do not fit matrices {factor.shape}")
    batch = np.broadcast_shapes(factor.shape[:-2], vector.shape[:-1])
    z = np.empty((d, *batch))  # component first: each step works on contiguous memory
    for i in range(d):
        if i == 0:
            z[0] = vector[..., 0]
        elif factor.ndim == 2:
            z[i] = vector[..., i] - np.tensordot(factor[i, :i], z[:i], 1)
        else:
            z[i] = vector[..., i]
            for j in range(i):
                z[i] -= factor[..., i, j] * z[j]
        z[i] /= factor[..., i, i]
    return np.moveaxis(z, 0, -1)


def _is_symmetric(cov: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", over="ignore"):
        scale = np.sqrt(np.abs(np.linalg.diagonal(cov)))
        allowed = _SYMMETRY * scale[..., :, None] * scale[..., None, :]
        return (np.abs(cov - np.matrix_transpose(cov)) <= allowed).all(axis=(-2, -1))


def _cholesky_by_columns(cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cholesky over the whole batch that records which matrices fail instead of raising."""
    factor = np.zeros_like(cov)
    bad = np.zeros(cov.shape[:-2], dtype=bool)
    with np.errstate(all="ignore"):
        for j in range(cov.shape[-1]):
            row = factor[..., j, :j]
            pivot = cov[..., j, j] - np.vecdot(row, row)
            fails = ~((pivot > 0) & (pivot < np.inf))
            bad |= fails
            root = np.sqrt(np.where(fails, 1.0, pivot))
            below = cov[..., j + 1 :, j] - np.matvec(factor[..., j + 1 :, :j], row)
            factor[..., j, j] = root
            factor[..., j + 1 :, j] = below / root[..., None]
    return factor, bad
