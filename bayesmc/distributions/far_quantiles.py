"""Quantiles of gamma and beta laws by the logarithm of a probability, however far out.

SciPy's inverses take the probability itself, which is zero below 1e-308. Beyond that Newton's method solves
for the logarithm of the number; the log of the tail is concave in it (or nearly so), and steps begin on the
side from which they do not overshoot.

References
----------
Abramowitz and Stegun (1964), 6.5.29 (series), 6.5.31 (continued fraction), 26.5.4 (beta); Press et al.
(2007), Numerical Recipes, 3rd ed., sec. 6.2 (Lentz's method).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import special

#: log probabilities below this are out of reach of SciPy's inverses
_FAR = -690.0
#: steps of Newton's method, and terms of a continued fraction
_STEPS, _TERMS = 60, 400
_SMALL = 1e-15
#: above this log probability a number next to nothing is left to the other tail
_LIKELY = -0.1


def gamma_lower(a: float, log_q: np.ndarray) -> np.ndarray:
    """Log of the number below which a gamma law of rate 1 has a probability.

    Parameters
    ----------
    a : float
        The concentration.
    log_q : ndarray

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.distributions.far_quantiles import gamma_lower, gamma_upper
    >>> bool(np.isclose(gamma_lower(1.0, np.array(-1000.0)), -1000.0))  # 1 - exp(-x) is about x
    True
    >>> bool(np.isclose(np.exp(gamma_upper(1.0, np.array(-1000.0))), 1000.0))
    True
    """

    def near(q: np.ndarray) -> np.ndarray:
        return special.gammaincinv(a, q)

    def far(wanted: np.ndarray) -> np.ndarray:
        t = (wanted + special.gammaln(a + 1.0)) / a
        for _ in range(_STEPS):
            x = np.exp(t)
            # P = x^a e^-x / Gamma(a + 1) * M(1, a + 1, x)
            series = special.hyp1f1(1.0, a + 1.0, x)
            log = a * t - x - special.gammaln(a + 1.0) + np.log(series)
            step = (wanted - log) * series / a
            t = t + step
            if (np.abs(step) < _SMALL * (1.0 + np.abs(t))).all():
                break
        return t

    return _split(log_q, near, far)


def gamma_upper(a: float, log_q: np.ndarray) -> np.ndarray:
    """Log of the number above which a gamma law of rate 1 has a probability; as ``gamma_lower``."""

    def near(q: np.ndarray) -> np.ndarray:
        return special.gammainccinv(a, q)

    def far(wanted: np.ndarray) -> np.ndarray:
        x = a - wanted + np.sqrt(2.0 * a * -wanted)  # above it: Boucheron et al. (2013), sec. 2.4
        for _ in range(_STEPS):
            over = _fraction(a, x)  # of the tail and the density
            log = (a - 1.0) * np.log(x) - x - special.gammaln(a) + np.log(over)
            step = (log - wanted) * over
            x = np.maximum(x + step, 0.5 * x)
            if (np.abs(step) < _SMALL * x).all():
                break
        return np.log(x)

    return _split(log_q, near, far)


def beta_lower(a: float, b: float, log_q: np.ndarray) -> np.ndarray:
    """Log of the number below which a beta law has a probability.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.distributions.far_quantiles import beta_lower
    >>> bool(np.isclose(beta_lower(2.0, 1.0, np.array(-1000.0)), -500.0))  # the cdf is x^2
    True
    """
    constant = np.log(a) + special.betaln(a, b)

    def near(q: np.ndarray) -> np.ndarray:
        return special.betaincinv(a, b, q)

    def far(wanted: np.ndarray) -> np.ndarray:
        t = np.minimum((wanted + constant) / a, np.log(a / (a + b)))
        for _ in range(_STEPS):
            x = np.exp(t)
            series = special.hyp2f1(a + b, 1.0, a + 1.0, x)
            log = a * t + b * np.log1p(-x) - constant + np.log(series)
            step = (wanted - log) * (1.0 - x) * series / a
            t = np.minimum(t + step, 0.5 * t)
            if (np.abs(step) < _SMALL * (1.0 + np.abs(t))).all():
                break
        return t

    return _split(log_q, near, far)


# ---- private ------------------------------------------------------------------------------------


def _split(
    log_q: np.ndarray, near: Callable[..., np.ndarray], far: Callable[..., np.ndarray]
) -> np.ndarray:
    """Logs of quantiles: SciPy's where probabilities and quantiles are numbers, else by Newton's method."""
    log_q = np.asarray(log_q, dtype=float)
    with np.errstate(all="ignore"):
        found = np.log(near(np.exp(log_q)))
        away = (log_q < _FAR) | ~(found > _FAR)  # some inverses end at the smallest number
        out = away & np.isfinite(log_q) & (log_q < _LIKELY)
        if out.any():
            found = np.array(found)
            found[out] = far(log_q[out])
    return found


def _fraction(a: float, x: np.ndarray) -> np.ndarray:
    """The upper tail of a gamma law over its density, by Lentz's method."""
    tiny = 1e-300
    b = x + 1.0 - a
    c, d = np.full_like(x, 1.0 / tiny), 1.0 / b
    found = d
    for k in range(1, _TERMS):
        numerator = -k * (k - a)
        b = b + 2.0
        d, c = numerator * d + b, b + numerator / c
        d = 1.0 / np.where(np.abs(d) < tiny, tiny, d)
        c = np.where(np.abs(c) < tiny, tiny, c)
        found = found * c * d
        if (np.abs(c * d - 1.0) < _SMALL).all():
            break
    return found * x
