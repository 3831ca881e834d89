"""The normal distribution of one number; vectors are in ``mvnormal``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, all_finite, as_float
from bayesmc.distributions.support import Support, real
from bayesmc.shapes import Shape

_ROOT_HALF = math.sqrt(0.5)
_HALF_LOG_2PI = 0.5 * np.log(2 * np.pi)


class Normal(Distribution):
    """Normal (Gaussian) distribution, ``exp(-((x - loc) / scale)**2 / 2)`` normalised.

    Parameters
    ----------
    loc : array_like
        Mean, any shape.
    scale : array_like
        Standard deviation, not negative; broadcasts with ``loc``. With 0 it is the point ``loc``, which can
        be drawn and which exact engines take, but which has no density.

    Raises
    ------
    ParameterError
        ``loc`` not finite, ``scale`` negative or not finite, or the density of a point is asked for.

    References
    ----------
    Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions I, ch. 13.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> float(bmc.Normal(0.0, 2.0).log_prob(0.0).round(4))
    -1.6121
    """

    parameter_ndim = {"loc": 0, "scale": 0}
    #: the scale where it is one valid number
    _number: float | None = None

    def __init__(self, loc: Any = 0.0, scale: Any = 1.0) -> None:
        loc, scale = as_float(loc), as_float(scale)
        if not scale.ndim:  # the hottest of all: a Python number is compared ten times faster
            number = scale.item()
            if 0.0 < number < math.inf and all_finite(loc):
                self.batch_shape, self.loc, self.scale, self._number = loc.shape, loc, scale, number
                return
        self._set_batch(loc.shape, scale.shape)
        self.loc = self._finite("loc", loc)
        self.scale = scale
        if not ((scale > 0) & (scale < np.inf)).all():
            ok = (scale >= 0) & (scale < np.inf)
            self.scale = self._check("scale", scale, ok, 1.0, "positive and finite")
            self._without_noise("scale", self.scale == 0)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.standard_normal(shape))
        draws *= self.scale
        draws += self.loc
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        scale = self._number
        if scale is not None and 1e-150 < scale < 1e150:
            z = np.asarray(x - self.loc, dtype=float)
            z *= _ROOT_HALF / scale
            z *= z
            return np.subtract(-_HALF_LOG_2PI - math.log(scale), z, out=z if z.ndim else None)
        z = np.asarray((x - self.loc) / self.scale)
        z *= z  # in place: this is the hottest density there is
        z *= -0.5
        z -= _HALF_LOG_2PI
        return z - np.log(self.scale)

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(self.loc, self.batch_shape)

    @property
    def var(self) -> np.ndarray:
        return np.broadcast_to(self.scale**2, self.batch_shape)

    @property
    def support(self) -> Support:
        return real

    def cdf(self, x: Any) -> np.ndarray:
        off = np.asarray(x) - self.loc
        if self.noiseless is not None:
            some = np.where(self.scale == 0, 1.0, self.scale)
            return np.where(self.scale == 0, 1.0 * (off >= 0), special.ndtr(off / some))
        with np.errstate(over="ignore"):
            return special.ndtr(off / self.scale)

    def ppf(self, q: Any) -> np.ndarray:
        return self.loc + self.scale * special.ndtri(np.asarray(q))
