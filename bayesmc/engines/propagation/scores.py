"""Normal scores: a number between bounds as a function of a standard normal one, so that its prior is exact.

With ``x = F^-1(Phi(z))`` the prior of z is the standard normal whatever the cdf F of x is: nothing has to be
approximated of it, and cavities of what reads x have an integral. Tails are taken from the side where they
are small.

References
----------
Nataf (1962), Determination des distributions de probabilites dont les marges sont donnees; Liu and Der
Kiureghian (1986), Multivariate distribution models with prescribed marginals and covariances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc import distributions as d
from bayesmc.distributions import Distribution
from bayesmc.distributions.transforms import Transform
from bayesmc.expression import Constant, Expression, Family, TracedArray, elementwise
from bayesmc.network import Model
from bayesmc.network.expressions import Followed, density

_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class NormalScores(Transform):
    """The map of a distribution of single numbers with the same parameters everywhere."""

    prior: Distribution
    inverse: Callable[[np.ndarray], np.ndarray]

    @classmethod
    def of(cls, prior: Distribution) -> NormalScores:
        """Of a distribution of one number with known parameters."""
        numbers = [float(getattr(prior, k)) for k in type(prior).parameter_ndim]
        return cls((), prior, _INVERSES[type(prior)](*numbers))

    def __reduce__(self) -> Any:
        return NormalScores.of, (self.prior,)

    def formula(self, u: Any) -> Any:
        if isinstance(u, TracedArray):
            return TracedArray(elementwise(self.inverse, u.expression))
        return self.inverse(u)

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(special.ndtri(self.prior.cdf(x)))

    def log_det_formula(self, u: Any) -> Any:
        """``log |dx/dz|``, of arrays."""
        return -0.5 * (u * u + _LOG_2PI) - self.prior.log_prob(self.inverse(u))


def scores_of(model: Model, name: str) -> NormalScores | None:
    """The map of a node whose prior has constant parameters, the same for all elements; None of others.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.propagation.scores import scores_of
    >>> from bayesmc.network import pose
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(2.0, 3.0))
    >>> scores = scores_of(pose(net, {}).model, "rate")
    >>> bool(np.isclose(bmc.Gamma(2.0, 3.0).cdf(scores.constrain(0.0)), 0.5))
    True
    """
    found = density(model, name)
    if not isinstance(found, Followed) or model[name].event_shape:
        return None
    prior = found.result
    if isinstance(prior, Family):
        values = {k: v.value if isinstance(v, Constant) else v for k, v in prior.parameters.items()}
        if any(isinstance(v, Expression) for v in values.values()):
            return None
        values = {k: v for k, v in values.items() if v is not None}
        prior = prior.make(**{k: _single(v) for k, v in values.items()})
    if type(prior) not in _INVERSES:
        return None
    numbers = [_single(getattr(prior, k)) for k in type(prior).parameter_ndim]
    if any(np.ndim(n) for n in numbers):
        return None
    return NormalScores.of(type(prior)(*(float(n) for n in numbers)))


# ---- private ------------------------------------------------------------------------------------


def _single(value: Any) -> Any:
    """A number that is the same all over, as one."""
    array = np.asarray(value)
    if array.size and (array == array.reshape(-1)[0]).all():
        return array.reshape(-1)[0]
    return array


def _gamma(concentration: float, rate: float) -> Callable[[np.ndarray], np.ndarray]:
    def inverse(z: np.ndarray) -> np.ndarray:
        low = special.gammaincinv(concentration, special.ndtr(np.minimum(z, 0.0)))
        high = special.gammainccinv(concentration, special.ndtr(-np.maximum(z, 0.0)))
        return np.where(z <= 0, low, high) / rate

    return inverse


def _beta(a: float, b: float) -> Callable[[np.ndarray], np.ndarray]:
    def inverse(z: np.ndarray) -> np.ndarray:
        low = special.betaincinv(a, b, special.ndtr(np.minimum(z, 0.0)))
        high = 1.0 - special.betaincinv(b, a, special.ndtr(-np.maximum(z, 0.0)))
        return np.where(z <= 0, low, high)

    return inverse


def _inverse_gamma(concentration: float, scale: float) -> Callable[[np.ndarray], np.ndarray]:
    upside_down = _gamma(concentration, 1.0)
    return lambda z: scale / upside_down(-z)


def _half_cauchy(scale: float) -> Callable[[np.ndarray], np.ndarray]:
    def inverse(z: np.ndarray) -> np.ndarray:
        low = np.tan(0.5 * np.pi * special.ndtr(np.minimum(z, 0.0)))
        high = 1.0 / np.tan(0.5 * np.pi * special.ndtr(-np.maximum(z, 0.0)))
        return scale * np.where(z <= 0, low, high)

    return inverse


#: family -> from its parameters the map, rising
_INVERSES: dict[type, Callable[..., Callable[[np.ndarray], np.ndarray]]] = {
    d.Uniform: lambda low, high: lambda z: low + (high - low) * special.ndtr(z),
    d.Exponential: lambda rate: lambda z: -special.log_ndtr(-z) / rate,
    d.Gamma: _gamma,
    d.InverseGamma: _inverse_gamma,
    d.Beta: _beta,
    d.HalfNormal: lambda scale: lambda z: -scale * special.ndtri(0.5 * special.ndtr(-z)),
    d.HalfCauchy: _half_cauchy,
    d.LogNormal: lambda loc, scale: lambda z: np.exp(loc + scale * z),
    d.Weibull: lambda k, scale: lambda z: scale * (-special.log_ndtr(-z)) ** (1.0 / k),
}
