"""A factor times a Gaussian cavity: the integral, the mean and the covariance, many at a time.

Cavities come in natural parameters, ``exp(linear' u - u' precision u / 2)`` against ``du``, and need no
integral of their own: only the product must have one. Here are closed forms; of other factors see
``quadrature``.

References
----------
Minka (2001), A family of algorithms for approximate Bayesian inference, ch. 3; Rasmussen and Williams (2006),
Gaussian Processes for Machine Learning, 3.6 and 3.9 (probit).
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy import special

from bayesmc.gaussian import try_cholesky

_LOG_2PI = float(np.log(2.0 * np.pi))
_ROOT, _HALF = float(np.sqrt(2.0 / np.pi)), float(np.sqrt(0.5))


class Tilt(NamedTuple):
    """A factor times its cavity.

    Attributes
    ----------
    log : ndarray, shape (*lead)
        Log of the integral; NaN where it has none.
    mean : ndarray, shape (*lead, k)
    cov : ndarray, shape (*lead, k, k)
    error : float
        Of the worst: by how much a coarser rule differs, in logs and standard deviations; 0 of closed forms.
    """

    log: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    error: float = 0.0


def log_integral(precision: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Log of the integral of ``exp(linear' u - u' precision u / 2)``; NaN where it has none.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.tilted import log_integral
    >>> float(log_integral(np.eye(1), np.zeros(1)).round(6)), float(log_integral(-np.eye(1), np.zeros(1)))
    (0.918939, nan)
    """
    k = linear.shape[-1]
    if k == 1:
        own = precision[..., 0, 0]
        with np.errstate(all="ignore"):
            found = 0.5 * linear[..., 0] ** 2 / own + 0.5 * (_LOG_2PI - np.log(own))
        return np.where(own > 0, found, np.nan)
    root, bad = try_cholesky(precision)
    scaled = np.linalg.solve(root, linear[..., None])[..., 0]
    size = np.log(root.diagonal(0, -2, -1)).sum(axis=-1)
    found = 0.5 * np.vecdot(scaled, scaled) - size + 0.5 * k * _LOG_2PI
    return found if bad is None else np.where(bad, np.nan, found)


def gaussians(
    rows: np.ndarray, log_scale: np.ndarray, precision: np.ndarray, linear: np.ndarray
) -> Tilt:
    """``exp(log_scale - |A u - z|^2 / 2)`` with ``rows = [A | z]``, for some states each.

    Parameters
    ----------
    rows : ndarray, shape (*lead, states, m, k + 1)
    log_scale : ndarray, shape (*lead, states)
    precision, linear : ndarray, shapes (*lead, k, k) and (*lead, k)

    Returns
    -------
    Tilt
        Of every state, shapes (*lead, states, ...).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.tilted import gaussians
    >>> rows = np.array([[[1.0, 3.0]]])  # one state, (u - 3)^2 / 2
    >>> found = gaussians(rows, np.zeros(1), np.eye(1), np.zeros(1))
    >>> found.mean.tolist(), found.cov.tolist()
    ([[1.5]], [[[0.5]]])
    """
    matrix, value = rows[..., :-1], rows[..., -1]
    turned = np.matrix_transpose(matrix)
    own = precision[..., None, :, :] + turned @ matrix
    h = linear[..., None, :] + np.matvec(turned, value)
    log = log_scale - 0.5 * np.vecdot(value, value) + log_integral(own, h)
    bad = np.isnan(log)
    if bad.any():
        own = np.where(bad[..., None, None], np.eye(own.shape[-1]), own)
    cov = inverses(own)
    return Tilt(log, np.matvec(cov, h), cov)


def probit(sign: np.ndarray, offset: np.ndarray, gain: np.ndarray, precision: np.ndarray,
           linear: np.ndarray) -> Tilt:  # fmt: skip
    """The standard normal cdf of ``sign * (offset + gain u)``, of one number u.

    Parameters
    ----------
    sign, offset, gain, precision, linear : ndarray, shape (*lead)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.tilted import probit
    >>> one = np.ones(())
    >>> found = probit(one, 0 * one, one, one, 0 * one)
    >>> float((found.log - 0.5 * np.log(2 * np.pi)).round(6)), found.mean.round(6).tolist()
    (-0.693147, [0.56419])
    """
    with np.errstate(all="ignore"):
        var = 1.0 / precision
        mean = var * linear
        turned = sign * gain
        over = 1.0 / np.sqrt(1.0 + turned * turned * var)
        z = (sign * offset + turned * mean) * over
        log_cdf = special.log_ndtr(z)
        ratio = np.exp(-0.5 * z * z - 0.5 * _LOG_2PI - log_cdf)
        slope = turned * var * over
        pull = slope * ratio
        spread = var - slope * pull * (z + ratio)
        log = log_cdf + 0.5 * (linear * mean + _LOG_2PI + np.log(var))
    if not (precision > 0).all():
        log = np.where(precision > 0, log, np.nan)
    return Tilt(log, (mean + pull)[..., None], spread[..., None, None])


def probit_messages(
    shift: np.ndarray, slope: np.ndarray, precision: np.ndarray, linear: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What the moments of the normal cdf of ``shift + slope u`` leave when the cavity is divided out again.

    Precisions and linear terms, of proper cavities, from derivatives of the log integral by the cavity's
    mean, without the moments between. What over- or underflows warns as NumPy is told to.

    Parameters
    ----------
    shift, slope, precision, linear : ndarray, shape (*lead)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.tilted import probit, probit_messages
    >>> one = np.ones(())
    >>> precision, linear = probit_messages(0 * one, one, one, 0 * one)
    >>> whole = probit(one, 0 * one, one, one, 0 * one)
    >>> bool(np.isclose(1.0 / (one + precision), whole.cov[0, 0]))
    True
    >>> bool(np.isclose(linear / (one + precision), whole.mean[0]))
    True
    """
    var = 1.0 / precision
    mean = var * linear
    over = 1.0 / np.sqrt(1.0 + slope * slope * var)
    z = (shift + slope * mean) * over
    pull = slope * over
    ratio = _ROOT / special.erfcx(-_HALF * z)
    towards = pull * ratio
    curve = pull * towards * (z + ratio)
    own = curve / (1.0 - var * curve)
    return own, own * mean + towards * (1.0 + var * own)


def mixed(log: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> Tilt:
    """The moments of mixtures, over the axis of states.

    Parameters
    ----------
    log : ndarray, shape (*lead, states)
    mean, cov : ndarray, shapes (*lead, states, k) and (*lead, states, k, k)
    """
    if log.shape[-1] == 1:
        return Tilt(log[..., 0], mean[..., 0, :], cov[..., 0, :, :])
    total = log_sum(log)
    with np.errstate(invalid="ignore"):
        share = np.exp(log - total[..., None])
    share = np.where(log == -np.inf, 0.0, share)
    dead = (share == 0)[..., None]
    mean = np.where(dead, 0.0, mean)
    cov = np.where(dead[..., None], 0.0, cov)
    middle = (share[..., None] * mean).sum(axis=-2)
    off = mean - middle[..., None, :]
    spread = (share[..., None, None] * (cov + off[..., :, None] * off[..., None, :])).sum(axis=-3)
    return Tilt(total, middle, spread)


def inverses(matrices: np.ndarray) -> np.ndarray:
    """Of many small matrices, NaN of those that have none.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.tilted import inverses
    >>> inverses(np.array([[[2.0, 0.0], [0.0, 4.0]], np.ones((2, 2))])).tolist()
    [[[0.5, 0.0], [0.0, 0.25]], [[nan, nan], [nan, nan]]]
    """
    if matrices.shape[-1] == 1:
        with np.errstate(divide="ignore"):
            return 1.0 / matrices
    try:
        return np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        found = np.full(matrices.shape, np.nan)
        for at in np.ndindex(matrices.shape[:-2]):
            with suppress(np.linalg.LinAlgError):
                found[at] = np.linalg.inv(matrices[at])
        return found


def log_sum(log: np.ndarray) -> np.ndarray:
    """Log of a sum of exponentials over the last axis; -inf of nothing, NaN with NaN."""
    top = log.max(axis=-1)
    safe = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return np.log(np.exp(log - safe[..., None]).sum(axis=-1)) + safe
