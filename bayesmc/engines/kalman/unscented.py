"""``UnscentedKalmanFilter``: Gaussian beliefs by sigma points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesmc.engines.kalman.levels import Level, Made
from bayesmc.engines.kalman.nonlinear import NonlinearFilter
from bayesmc.errors import ParameterError


@dataclass(frozen=True)
class UnscentedKalmanFilter(NonlinearFilter):
    """Approximate beliefs about nonlinear templates: moments are those at a few points around the mean.

    Parameters
    ----------
    alpha, beta, kappa : float
        Of the scaled unscented transformation of n numbers: points lie ``alpha sqrt(n + kappa)`` standard
        deviations from the mean; the middle one weighs ``1 - n / (alpha^2 (n + kappa))`` in means and
        ``1 - alpha^2 + beta`` more in covariances.

    Raises
    ------
    ValueError
        An option is not finite, or ``alpha`` not positive.
    ParameterError
        In a run: ``n + kappa`` is not positive, or what comes of a negative weight is no covariance.

    Notes
    -----
    The additive form: noise is not among the numbers that points are laid for; its covariance is
    averaged over the points. Points are laid anew for every level of a slice: for the slice before, then
    around what is predicted. Other families than Normal and MvNormal, angles, counts and what takes no
    continuous values are treated as in ``ExtendedKalmanFilter``. What the points tell beyond a regression
    line is noise, so a slice is a linear model again and the smoother that of ``KalmanFilter``, with
    cross-covariances by points. ``most_likely`` is answered for linear-Gaussian templates only.

    References
    ----------
    Julier and Uhlmann (2004), Proc. IEEE 92; van der Merwe and Wan (2001), ICASSP; Särkkä and Svensson
    (2023), Bayesian Filtering and Smoothing, 2nd ed., ch. 8 and 9.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import UnscentedKalmanFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 0.3), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x**2, 0.5))
    >>> engine = UnscentedKalmanFilter()
    >>> bmc.smooth(dbn, {"y": [0.3, 0.5, 0.9]}, engine=engine).std("x").shape
    (3,)
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 2.0

    label: ClassVar[str] = "unscented Kalman filter"

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "kappa"):
            value = getattr(self, name)
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float))
                or not np.isfinite(value)
            ):
                raise ValueError(f"UnscentedKalmanFilter({name}={value!r}): give a finite number")
        if not self.alpha > 0:
            raise ValueError(
                f"UnscentedKalmanFilter(alpha={self.alpha!r}): give a positive number, such as 1.0"
            )

    def made_linear(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """A regression line through sigma points; what is off the line is noise.

        In differences from the mean at pairs of opposite points, their halved difference is the line, and
        their sum is off it. So the covariance that is left is a sum of squares, and nothing is subtracted.
        """
        n, k = rows.shape[-2:]
        if not n:
            found, moments = level(mean[None])
            scales = [None if m.scale is None else m.scale[0] for m in moments]
            return Made(found[0], np.zeros((*found.shape[1:], k)), level.noise(scales))
        if n + self.kappa <= 0:
            raise _not_positive(
                f"points of {n} numbers lie sqrt({n} + kappa) standard deviations away"
            )
        if k < n:
            rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], n - k))], axis=-1)
        turn, upper = np.linalg.qr(np.matrix_transpose(rows))
        root = np.matrix_transpose(upper)  # mean + root @ z, where z = turn' @ noise
        width = self.alpha**2 * (n + self.kappa)
        moves = np.moveaxis(np.sqrt(width) * root, -1, 0)
        found, moments = level(np.concatenate([mean[None], mean + moves, mean - moves]))
        weight = 0.5 / width
        off = level.off(found[1:], found[0])
        centre = weight * off.sum(axis=0)
        up, down = off[:n] - centre, off[n:] - centre
        line = np.moveaxis(up - down, 0, -1) * (weight * np.sqrt(width))
        bent = np.moveaxis(up + down, 0, -1) * np.sqrt(0.5 * weight)
        middle = 1.0 - n / width + 1.0 - self.alpha**2 + self.beta
        noise = level.noise([self._averaged(m.scale, weight, mean.ndim - 1) for m in moments])
        fresh = self._with_middle(bent, centre, middle, noise)
        link = (line @ np.matrix_transpose(turn))[..., :k]
        return Made(found[0] + centre, link, fresh)

    @staticmethod
    def _averaged(scale: np.ndarray | None, weight: float, lead: int) -> np.ndarray | None:
        """A node's noise, its covariance averaged over the points."""
        if scale is None or (scale == scale[:1]).all():
            return None if scale is None else scale[0]
        if scale.ndim == 2 + lead:
            squared = scale**2
            found = squared[0] + weight * (squared[1:] - squared[0]).sum(axis=0)
            root = np.sqrt(found) if (found >= 0).all() else None
        else:
            middle = 1.0 - weight * (len(scale) - 1)
            root = _joint_root(scale[0], middle, scale[1:], weight)
        if root is None:
            raise _not_positive("noise averaged over sigma points is not positive")
        return root

    @staticmethod
    def _with_middle(
        bent: np.ndarray, centre: np.ndarray, middle: float, noise: np.ndarray
    ) -> np.ndarray:
        """Roots of everything off the line, side by side."""
        if middle >= 0:
            return np.concatenate([bent, np.sqrt(middle) * centre[..., None], noise], axis=-1)
        whole = sum(a @ np.matrix_transpose(a) for a in (bent, noise))
        root = _root_of(whole + middle * centre[..., None] * centre[..., None, :])
        if root is None:
            raise _not_positive(
                f"the middle point weighs {middle:.3g}, and the covariance is not positive"
            )
        return root


# ---- private ------------------------------------------------------------------------------------


def _joint_root(first: np.ndarray, middle: float, others: np.ndarray, weight: float) -> Any:
    """A root of a weighted sum of covariances, given roots of them, or None where it has none."""
    if middle < 0:
        squared = others @ np.matrix_transpose(others)
        return _root_of(middle * first @ np.matrix_transpose(first) + weight * squared.sum(axis=0))
    roots = np.concatenate([np.sqrt(middle) * first[None], np.sqrt(weight) * others])
    beside = np.matrix_transpose(np.concatenate(tuple(roots), axis=-1))
    return np.matrix_transpose(np.linalg.qr(beside, mode="r"))


def _root_of(covariance: np.ndarray) -> np.ndarray | None:
    """A root of a covariance, which may be singular; None of what is no covariance."""
    values, vectors = np.linalg.eigh(covariance)
    if (values >= -1e-9 * np.abs(values).max(axis=-1, keepdims=True)).all():
        return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return None


def _not_positive(what: str) -> ParameterError:
    return ParameterError(
        f"UnscentedKalmanFilter: {what}; use alpha=1, beta=0 and kappa=0 or more, or a ParticleFilter"
    )
