"""The Dirichlet distribution on vectors of probabilities."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float
from bayesmc.distributions.support import Support, simplex
from bayesmc.errors import ShapeError
from bayesmc.shapes import Shape

_TINY = np.finfo(float).tiny
_SMALL = 0.1  # below it Gamma variates may all underflow, so that they are drawn as logarithms


class Dirichlet(Distribution):
    """Dirichlet distribution with density proportional to ``prod(x ** (concentration - 1))``.

    Parameters
    ----------
    concentration : array_like, shape (..., K)
        Positive prior counts.

    Raises
    ------
    ParameterError
        A concentration is not positive and finite; ``index`` is the first such vector.
    ShapeError
        ``concentration`` is a scalar or empty along its last axis.

    Notes
    -----
    ``log_prob`` is minus infinity off the simplex: a negative component, or a sum off by over 1e-6.

    References
    ----------
    Murphy, Probabilistic Machine Learning: Advanced Topics, 2023, section 2.2.5.1. Small
    concentrations are drawn as in Marsaglia and Tsang, ACM TOMS 26(3), 2000, section 6.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> weights = bmc.Dirichlet([1.0, 1.0, 2.0])
    >>> weights.mean.tolist(), float(weights.log_prob([0.25, 0.25, 0.5]).round(4))
    ([0.25, 0.25, 0.5], 1.0986)
    """

    parameter_ndim = {"concentration": 1}

    def __init__(self, concentration: Any) -> None:
        concentration = as_float(concentration)
        if concentration.ndim < 1 or concentration.shape[-1] < 1:
            raise ShapeError(
                f"Dirichlet: concentration must have shape (..., K); got {concentration.shape}"
            )
        self._set_batch(concentration.shape[:-1])
        self.event_shape = concentration.shape[-1:]
        ok = ((concentration > 0) & (concentration < np.inf)).all(axis=-1)
        self.concentration = self._check(
            "concentration", concentration, ok, 1.0, "positive and finite"
        )

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        a, full = self.concentration, shape + self.event_shape
        if a.size and a.min() < _SMALL:
            # log Gamma(a) = log Gamma(a + 1) + log(U) / a
            logs = -rng.standard_exponential(full) / a + np.log(rng.standard_gamma(a + 1, full))
            logs -= logs.max(axis=-1, keepdims=True)
            draws = np.exp(logs)
        else:
            draws = rng.standard_gamma(a, full)
        draws /= draws.sum(axis=-1, keepdims=True)
        return np.maximum(draws, _TINY, out=draws)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != self.event_shape:
            raise ShapeError(f"Dirichlet: x has shape {x.shape}, not (..., {self.event_shape[0]})")
        a = self.concentration
        log_beta = special.gammaln(a).sum(axis=-1) - special.gammaln(a.sum(axis=-1))
        density = special.xlogy(a - 1, x).sum(axis=-1) - log_beta
        outside = ~simplex.contains(x) & ~np.isnan(x).any(axis=-1)
        return np.where(outside, -np.inf, density)

    @property
    def mean(self) -> np.ndarray:
        return self.concentration / self.concentration.sum(axis=-1, keepdims=True)

    @property
    def var(self) -> np.ndarray:
        total = self.concentration.sum(axis=-1, keepdims=True)
        mean = self.concentration / total
        return mean * (1 - mean) / (total + 1)

    @property
    def support(self) -> Support:
        return simplex
