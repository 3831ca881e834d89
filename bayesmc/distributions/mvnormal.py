"""The multivariate normal distribution, parametrised by covariance, Cholesky factor or diagonal."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions.base import Distribution, all_finite, as_float
from bayesmc.distributions.support import Support, real_vector
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.gaussian import singular_cholesky, solve_lower, try_cholesky
from bayesmc.shapes import Shape

_LOG_2PI = np.log(2 * np.pi)


class MvNormal(Distribution):
    """Multivariate normal distribution on vectors of length d.

    Give exactly one of ``cov``, ``scale_tril`` and ``scale_diag``.

    Parameters
    ----------
    loc : array_like, shape (..., d)
        Mean.
    cov : array_like, shape (..., d, d)
        Covariance, symmetric positive definite, or singular: then values lie on a plane, can be drawn, and
        exact engines take them, but there is no density.
    scale_tril : array_like, shape (..., d, d)
        Lower Cholesky factor of the covariance, whose diagonal is not negative.
    scale_diag : array_like, shape (..., d)
        Standard deviations of independent components.

    Raises
    ------
    ParameterError
        ``loc`` not finite, or a scale that is indefinite or not finite; ``index`` is the first one. The
        density of a singular one is asked for.
    ShapeError
        The last axes do not fit each other.

    References
    ----------
    Murphy, Probabilistic Machine Learning: Advanced Topics, 2023, section 2.3.1.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> pose = bmc.MvNormal([0.0, 0.0], [[4.0, 1.0], [1.0, 1.0]])
    >>> float(pose.log_prob([0.0, 0.0]).round(4))
    -2.3872
    >>> float(pose.squared_mahalanobis([2.0, 0.0]).round(4))
    1.3333
    """

    splits = True
    parameter_ndim = {"loc": 1, "cov": 2}

    def __init__(
        self, loc: Any, cov: Any = None, *, scale_tril: Any = None, scale_diag: Any = None
    ) -> None:
        if sum(part is not None for part in (cov, scale_tril, scale_diag)) != 1:
            raise ParameterError("MvNormal: give exactly one of cov, scale_tril and scale_diag")
        loc = as_float(loc)
        self._cov: np.ndarray | None = None
        self._tril: np.ndarray | None = None
        self._diag: np.ndarray | None = None
        if scale_diag is not None:
            self._set_diag(loc, as_float(scale_diag))
        elif scale_tril is not None:
            self._set_tril(loc, as_float(scale_tril))
        else:
            self._set_cov(loc, as_float(cov))
        self.loc = loc
        if not all_finite(loc):  # by its sum: looking at every vector costs more than a draw
            finite = np.isfinite(loc).all(axis=-1)
            self.loc = self._check("loc", loc, finite, 0.0, "finite")

    @property
    def scale_tril(self) -> np.ndarray:
        """Lower Cholesky factor of the covariance."""
        if self._tril is None:
            self._tril = _diagonal_matrix(self._diag)
        return self._tril

    @property
    def cov(self) -> np.ndarray:
        """Covariance, shape ``(..., d, d)``; its batch broadcasts to ``batch_shape``."""
        if self._cov is None:
            if self._diag is not None:
                self._cov = _diagonal_matrix(self._diag**2)
            else:
                self._cov = self.scale_tril @ np.matrix_transpose(self.scale_tril)
        return self._cov

    def squared_mahalanobis(self, x: Any) -> np.ndarray:
        """``(x - loc)' cov^-1 (x - loc)``; chi-square with d degrees of freedom.

        ``x`` has shape ``(..., d)``; the result is the broadcast of ``...`` and the batch.
        """
        x = np.asarray(x, dtype=float)
        if x.shape[-1:] != self.event_shape:
            raise ShapeError(
                f"MvNormal: x has shape {np.shape(x)}, not (..., {self.event_shape[0]})"
            )
        residual = x - self.loc
        if self._diag is not None:
            z = residual / self._diag
        else:
            z = solve_lower(self.scale_tril, residual)
        return np.vecdot(z, z)

    def linear_map(self, matrix: Any, offset: Any = 0.0) -> MvNormal:
        """The distribution of ``H x + offset``: mean ``H loc + offset``, covariance ``H cov H'``.

        Parameters
        ----------
        matrix : array_like, shape (..., m, d)
            ``H``, of full row rank.
        offset : array_like, shape (..., m)

        Raises
        ------
        ParameterError
            ``H cov H'`` is singular.

        Notes
        -----
        The new Cholesky factor is the triangle of a QR decomposition of ``(H L)'``, so that the
        covariance is never formed and its condition number never squared.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> total = bmc.MvNormal([1.0, 2.0], scale_diag=[3.0, 4.0]).linear_map([[1.0, 1.0]])
        >>> total.mean.tolist(), total.cov.round(6).tolist()
        ([3.0], [[25.0]])
        """
        matrix = as_float(matrix)
        if matrix.ndim < 2 or matrix.shape[-1] != self.event_shape[0]:
            raise ShapeError(
                f"MvNormal.linear_map: H has shape {matrix.shape}, not (..., m, d) "
                f"with d = {self.event_shape[0]}"
            )
        root = matrix @ self.scale_tril
        rows, columns = root.shape[-2:]
        if rows > columns:
            raise ParameterError(
                f"MvNormal.linear_map: {rows} rows of H on {columns} components give a singular "
                "covariance; drop rows or add noise (bayesmc.gaussian.linear_map)"
            )
        upper = np.linalg.qr(np.matrix_transpose(root), mode="r")
        diagonal = np.linalg.diagonal(upper)
        # A column whose new direction is all rounding is a linear combination of earlier rows of H.
        rounding = columns * np.finfo(float).eps * np.linalg.norm(root, axis=-1)
        sign = np.where(diagonal < 0, -1.0, 1.0)
        factor = np.matrix_transpose(upper * sign[..., None])
        singular = np.abs(diagonal) <= rounding
        if singular.any():
            factor = np.where(singular[..., None] & np.eye(rows, dtype=bool), 0.0, factor)
        mapped = MvNormal(np.matvec(matrix, self.loc) + as_float(offset), scale_tril=factor)
        mapped._require_noise()
        mapped._adopt(self)
        return mapped

    def log_prob_of(self, x: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Log density of some components by themselves; the batch broadcasts.

        Parameters
        ----------
        x : ndarray, shape (..., d)
        present : ndarray of bool, shape (d,)

        Examples
        --------
        >>> import numpy as np
        >>> import bayesmc as bmc
        >>> pose = bmc.MvNormal([0.0, 1.0], [[4.0, 1.0], [1.0, 1.0]])
        >>> float(pose.log_prob_of(np.array([0.0, 9.0]), np.array([True, False])).round(4))
        -1.6121
        """
        if present.all():
            return self.log_prob_unchecked(x)
        at = np.flatnonzero(present)
        if not len(at):
            return np.zeros(np.broadcast_shapes(x.shape[:-1], self.batch_shape))
        part = MvNormal(self.loc[..., at], self.cov[..., at[:, None], at])
        return part.log_prob_unchecked(x[..., at])

    def completed(
        self, rng: np.random.Generator, shape: Shape, x: np.ndarray, present: np.ndarray
    ) -> np.ndarray:
        """Draws, shape ``(*shape, d)``, of the components that are not there given those that are.

        Parameters
        ----------
        x : ndarray, shape (..., d)
            Broadcasts to the draws.
        present : ndarray of bool, shape (d,)

        References
        ----------
        Doucet (2010), A note on efficient conditional simulation of Gaussian distributions (a joint draw
        moved by what was seen, less what was drawn of it).
        """
        draws = self.sample_to(rng, shape)
        at, rest = np.flatnonzero(present), np.flatnonzero(~present)
        inside, across = (self.cov[..., rows[:, None], at] for rows in (at, rest))
        off = np.linalg.solve(inside, (x - draws)[..., at, None])[..., 0]
        draws[..., rest] += np.matvec(across, off)
        return np.where(present, x, draws)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        z = rng.standard_normal(shape + self.event_shape)
        if self._diag is not None:
            z *= self._diag
        elif self.scale_tril.ndim == 2:
            z = z @ self.scale_tril.T
        else:
            z = np.matvec(self.scale_tril, z)
        z += self.loc
        return z

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        scales = self._diag if self._diag is not None else np.linalg.diagonal(self.scale_tril)
        log_det = 2.0 * np.log(scales).sum(axis=-1)
        normaliser = self.event_shape[0] * _LOG_2PI + log_det
        return -0.5 * (normaliser + self.squared_mahalanobis(x))

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(self.loc, self.batch_shape + self.event_shape)

    @property
    def var(self) -> np.ndarray:
        variances = self._diag**2 if self._diag is not None else np.linalg.diagonal(self.cov)
        return np.broadcast_to(variances, self.batch_shape + self.event_shape)

    @property
    def support(self) -> Support:
        return real_vector

    def _set_diag(self, loc: np.ndarray, scales: np.ndarray) -> None:
        self._set_shapes(loc, scales.shape[:-1], scales.shape[-1:], scales.ndim < 1)
        ok = ((scales >= 0) & (scales < np.inf)).all(axis=-1)
        self._diag = self._check("scale_diag", scales, ok, 1.0, "positive and finite")
        self._note_singular("scale_diag", self._diag)

    def _set_tril(self, loc: np.ndarray, factor: np.ndarray) -> None:
        square = factor.ndim >= 2 and factor.shape[-1] == factor.shape[-2]
        self._set_shapes(loc, factor.shape[:-2], factor.shape[-1:], not square)
        diagonal = np.linalg.diagonal(factor)
        ok = (diagonal >= 0).all(axis=-1) & np.isfinite(factor).all(axis=(-2, -1))
        ok &= (np.triu(factor, 1) == 0).all(axis=(-2, -1))
        self._tril = self._check(
            "scale_tril",
            factor,
            ok,
            np.eye(factor.shape[-1]),
            "lower triangular and finite with a positive diagonal",
        )
        self._note_singular("scale_tril", np.linalg.diagonal(self._tril))

    def _set_cov(self, loc: np.ndarray, cov: np.ndarray) -> None:
        square = cov.ndim >= 2 and cov.shape[-1] == cov.shape[-2]
        self._set_shapes(loc, cov.shape[:-2], cov.shape[-1:], not square)
        self._tril, bad = try_cholesky(cov)
        self._cov = cov
        if bad is None:
            return
        root, indefinite = singular_cholesky(cov)
        identity = np.eye(cov.shape[-1])
        self._tril = np.where(bad[..., None, None], root, self._tril)
        self._cov = self._check("cov", cov, ~indefinite, identity, "symmetric positive definite")
        self._note_singular("cov", np.linalg.diagonal(self._tril))

    def _note_singular(self, name: str, pivots: np.ndarray) -> None:
        """Note elements with a component that follows from those before it."""
        if not (pivots > 0).all():
            self._without_noise(f"a pivot of {name}", (pivots == 0).any(axis=-1))

    def _set_shapes(self, loc: np.ndarray, batch: Shape, size: Shape, malformed: bool) -> None:
        if malformed or loc.ndim < 1 or loc.shape[-1:] != size:
            raise ShapeError(
                f"MvNormal: loc must have shape (..., d) and its scale (..., d, d), or (..., d) as "
                f"scale_diag; got loc {loc.shape} and a scale of length {size} after batch {batch}"
            )
        self.event_shape = size
        self._set_batch(loc.shape[:-1], batch)


def _diagonal_matrix(diagonal: Any) -> np.ndarray:
    return np.asarray(diagonal)[..., None] * np.eye(np.shape(diagonal)[-1])
