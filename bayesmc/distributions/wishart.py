"""Random positive definite matrices: Wishart, and InverseWishart for covariances.

Both work on Cholesky factors: draws come from triangular matrices of normal and chi variates, traces
from triangular solves. Nothing is inverted explicitly.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float
from bayesmc.distributions.support import Support, positive_definite
from bayesmc.errors import ShapeError
from bayesmc.gaussian import solve_lower, try_cholesky
from bayesmc.shapes import Shape

_LEAST = 1e-280  # chi-square variates of few degrees of freedom underflow; squares must not
_CLOSE = 1e-3  # sine of an angle between rows, below which a product may be singular to rounding
_FLOORS = 10.0 ** np.arange(
    -7, 0
)  # sines to raise such angles to; the first is almost always enough


class _MatrixFamily(Distribution):
    """What both families share: degrees of freedom, a scale matrix, factors of the values."""

    parameter_ndim = {"df": 0, "scale": 2}

    def __init__(self, df: Any, scale: Any) -> None:
        df, scale = as_float(df), as_float(scale)
        if scale.ndim < 2 or scale.shape[-1] != scale.shape[-2] or scale.shape[-1] < 1:
            raise ShapeError(
                f"{type(self).__name__}: scale must have shape (..., d, d); got {scale.shape}"
            )
        self._size = d = scale.shape[-1]
        self.event_shape = (d, d)
        self._set_batch(df.shape, scale.shape[:-2])
        ok = (df > d - 1) & (df < np.inf)
        above = f"finite and above {d - 1}, the size of the scale less one"
        self.df = self._check("df", df, ok, d + 4.0, above)
        self._root, bad = try_cholesky(scale)
        self.scale = scale
        if bad is not None:
            self.scale = self._check("scale", scale, ~bad, np.eye(d), "symmetric positive definite")

    @property
    def support(self) -> Support:
        return positive_definite

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-2:] != self.event_shape:
            d = self._size
            raise ShapeError(
                f"{type(self).__name__}: x has shape {x.shape}, not (..., {d}, {d}); "
                "its last two axes are one matrix"
            )
        root, bad = try_cholesky(x)
        density = self._log_density(root)
        if bad is None:
            return density
        unknown = np.isnan(x).any(axis=(-2, -1))
        return np.where(unknown, np.nan, np.where(bad, -np.inf, density))

    def _log_density(self, root: np.ndarray) -> np.ndarray:
        """Log density at ``root @ root.T``."""
        raise NotImplementedError

    def _log_constant(self) -> np.ndarray:
        """``log(2^(df d / 2) Gamma_d(df / 2))``, of Wishart and inverse Wishart alike."""
        half = 0.5 * self.df
        return half * self._size * np.log(2.0) + special.multigammaln(half, self._size)


class Wishart(_MatrixFamily):
    """Wishart distribution: ``sum_k z_k z_k'`` of ``df`` normal vectors of covariance ``scale``.

    Parameters
    ----------
    df : array_like, shape (...)
        Degrees of freedom, above d - 1; not necessarily whole.
    scale : array_like, shape (..., d, d)
        Symmetric positive definite; the mean is ``df * scale``.

    Raises
    ------
    ParameterError
        ``df`` out of range or ``scale`` not positive definite; ``index`` is the first one.
    ShapeError
        ``scale`` is not square.

    Notes
    -----
    ``log_prob`` is minus infinity at matrices that are not symmetric positive definite; symmetry
    is asked up to 1e-8, and the lower triangle counts. With ``df`` close to d - 1 most draws are
    singular to rounding; these have a pivot raised to the least that a Cholesky factor resolves.

    References
    ----------
    Wishart, Biometrika 20A, 1928. Draws: Bartlett, Proceedings of the Royal Society of Edinburgh
    53, 1933; Odell and Feiveson, JASA 61, 1966.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> precision = bmc.Wishart(5.0, np.eye(2))
    >>> precision.mean.tolist(), float(precision.log_prob(np.eye(2)).round(4))
    ([[5.0, 0.0], [0.0, 5.0]], -5.3228)
    """

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        lower = bartlett(rng, self.df[..., None] - np.arange(self._size), shape)
        return gram(self._root @ lower)[0]

    def _log_density(self, root: np.ndarray) -> np.ndarray:
        trace = _squares(self._root, root)
        return (
            0.5 * (self.df - self._size - 1) * _log_det(root)
            - 0.5 * trace
            - 0.5 * self.df * _log_det(self._root)
            - self._log_constant()
        )

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(_entries(self.df) * self.scale, self.batch_shape + self.event_shape)

    @property
    def var(self) -> np.ndarray:
        """Variance of each entry: ``df (v_ij^2 + v_ii v_jj)`` for a scale v."""
        spread = self.scale**2 + _diagonal_products(self.scale)
        return np.broadcast_to(_entries(self.df) * spread, self.batch_shape + self.event_shape)


class InverseWishart(_MatrixFamily):
    """Inverse Wishart distribution: of a matrix whose inverse is ``Wishart(df, scale^-1)``.

    The conjugate prior of a normal's covariance.

    Parameters
    ----------
    df : array_like, shape (...)
        Degrees of freedom, above d - 1; not necessarily whole.
    scale : array_like, shape (..., d, d)
        Symmetric positive definite; the mean is ``scale / (df - d - 1)`` where that is positive.

    Raises
    ------
    ParameterError
        ``df`` out of range or ``scale`` not positive definite; ``index`` is the first one.
    ShapeError
        ``scale`` is not square.

    Notes
    -----
    ``log_prob`` is minus infinity at matrices that are not symmetric positive definite; symmetry
    is asked up to 1e-8, and the lower triangle counts. With ``df`` close to d - 1 most draws are
    singular to rounding; these have a pivot raised to the least that a Cholesky factor resolves.

    References
    ----------
    Gelman et al., Bayesian Data Analysis, 3rd ed., 2013, section 3.6 and appendix A. Moments: von
    Rosen, Scandinavian Journal of Statistics 15, 1988.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> covariance = bmc.InverseWishart(5.0, np.eye(2))
    >>> covariance.mean.tolist(), float(covariance.log_prob(np.eye(2)).round(4))
    ([[0.5, 0.0], [0.0, 0.5]], -5.3228)
    """

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        # If a standard Wishart matrix is U U' with U upper triangular (Bartlett's factor, its order
        # reversed), its inverse is M M' with M = U'^-1, which again is lower triangular.
        d = self._size
        lower = bartlett(rng, self.df[..., None] - np.arange(d - 1, -1, -1.0), shape)
        return gram(_divide(self._root, lower))[0]

    def _log_density(self, root: np.ndarray) -> np.ndarray:
        trace = _squares(root, self._root)
        return (
            0.5 * self.df * _log_det(self._root)
            - 0.5 * trace
            - 0.5 * (self.df + self._size + 1) * _log_det(root)
            - self._log_constant()
        )

    @property
    def mean(self) -> np.ndarray:
        """Where ``df <= d + 1``, infinite on the diagonal and NaN elsewhere: integrals diverge."""
        excess = _entries(self.df) - self._size - 1
        diverged = np.where(np.eye(self._size, dtype=bool), np.inf, np.nan)
        mean = np.where(excess > 0, self.scale / np.where(excess > 0, excess, 1.0), diverged)
        return np.broadcast_to(mean, self.batch_shape + self.event_shape)

    @property
    def var(self) -> np.ndarray:
        """Variance of each entry; infinite for ``d + 1 < df <= d + 3``, NaN below."""
        n = _entries(self.df) - self._size
        safe = np.where(n > 3, n, 4.0)
        products = _diagonal_products(self.scale)
        spread = (safe + 1) * self.scale**2 + (safe - 1) * products
        var = spread / (safe * (safe - 1) ** 2 * (safe - 3))
        var = np.where(n > 3, var, np.where(n > 1, np.inf, np.nan))
        return np.broadcast_to(var, self.batch_shape + self.event_shape)


def bartlett(rng: np.random.Generator, df: np.ndarray, shape: Shape) -> np.ndarray:
    """Lower triangles of standard normals, with chi variates of ``df[..., i]`` on the diagonal."""
    d = df.shape[-1]
    lower = np.zeros((*shape, d, d))
    if d > 1:
        row, column = _below_diagonal(d)
        lower[..., row, column] = rng.standard_normal((*shape, row.size))
    squares = rng.chisquare(df, (*shape, d))
    np.maximum(squares, _LEAST, out=squares)
    np.sqrt(squares, out=lower.reshape((*shape, d * d))[..., :: d + 1])
    return lower


def gram(lower: np.ndarray) -> tuple[np.ndarray, bool]:
    """``lower @ lower.T``, symmetric to the last bit and positive definite after rounding, too.

    The second value says whether it is that product, or some pivots were looked at and perhaps raised.
    """
    product = _symmetric_product(lower)
    # rounding can lose a pivot only where some row lies close to the span of those above it
    pivots = lower.diagonal(0, -2, -1)
    close = pivots * pivots < _CLOSE**2 * product.diagonal(0, -2, -1)
    if close.any():
        return _raised(lower, product, close), False
    return product, True


def _raised(lower: np.ndarray, product: np.ndarray, close: np.ndarray) -> np.ndarray:
    """The products with pivots that rounding lost raised to the least that can be resolved."""
    shape, d = lower.shape, lower.shape[-1]
    lower, product = lower.reshape((-1, d, d)), product.reshape((-1, d, d)).copy()
    lengths = np.sqrt(np.vecdot(lower, lower))
    suspect = np.flatnonzero(close.reshape((-1, d)).any(axis=-1))
    # a Cholesky factor's backward error, relative to the diagonal (Higham 2002, theorem 10.3); with this
    # to spare a matrix has a factor however the steps are ordered, alone as in a batch
    spare = 1.0 - d * (d + 1) * np.finfo(float).eps * np.eye(d)
    for floor in _FLOORS:
        suspect = suspect[~positive_definite.contains(product[suspect] * spare)]
        if not suspect.size:
            break
        raised = lower[suspect]
        i = np.arange(d)
        raised[:, i, i] = np.maximum(raised[:, i, i], floor * lengths[suspect])
        product[suspect] = _symmetric_product(raised)
    return product.reshape(shape)


@cache
def _below_diagonal(d: int) -> tuple[np.ndarray, np.ndarray]:
    return np.tril_indices(d, -1)


def _symmetric_product(lower: np.ndarray) -> np.ndarray:
    product = lower @ lower.swapaxes(-1, -2)
    return 0.5 * (product + product.swapaxes(-1, -2))


def _squares(root: np.ndarray, other: np.ndarray) -> np.ndarray:
    """``trace((root root')^-1 (other other'))``, the sum of squares of ``root^-1 other``."""
    columns = np.matrix_transpose(other)
    if root.ndim > 2:  # each column of a matrix meets that matrix's own root
        root = root[..., None, :, :]
    z = solve_lower(root, columns)
    return np.vecdot(z, z).sum(axis=-1)


def _divide(matrix: np.ndarray, lower: np.ndarray) -> np.ndarray:
    """``matrix @ lower^-1`` for a lower triangular ``matrix``: the columns, last to first."""
    d = lower.shape[-1]
    batch = np.broadcast_shapes(matrix.shape[:-2], lower.shape[:-2])
    result = np.array(np.broadcast_to(matrix, (*batch, d, d)))
    for j in range(d - 1, -1, -1):
        result[..., j] -= np.matvec(result[..., j + 1 :], lower[..., j + 1 :, j])
        result[..., j] /= lower[..., j, j, None]
    return result


def _log_det(root: np.ndarray) -> np.ndarray:
    """Log determinant of ``root root'``."""
    return 2.0 * np.log(np.linalg.diagonal(root)).sum(axis=-1)


def _diagonal_products(scale: np.ndarray) -> np.ndarray:
    """``scale_ii scale_jj`` at each entry i, j."""
    diagonal = np.linalg.diagonal(scale)
    return diagonal[..., :, None] * diagonal[..., None, :]


def _entries(value: np.ndarray) -> np.ndarray:
    """A batch of numbers, to broadcast with matrices."""
    return value[..., None, None]
