"""The closed forms: what a prior brings to the full conditional, and the distribution that sums up to.

A *kind* is an exponential family as natural parameters: tuples of arrays ``(lead, *plates, ...)`` that
priors start and children add to. A flat prior brings zeros, a truncated one its base's parameters; the
bounds of both come back in the posterior. Which children fit which kind stands in ``conjugate_pairs``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Beta,
    Dirichlet,
    Distribution,
    Exponential,
    Gamma,
    InverseGamma,
    InverseWishart,
    MvNormal,
    Normal,
    Truncated,
    Uniform,
)
from bayesmc.distributions.support import Support, interval
from bayesmc.kernels.vector_draws import gammas, inverse_wishart_draw, normal_draw
from bayesmc.shapes import Shape

Naturals = tuple[np.ndarray, ...]
#: lower and upper end of a truncated full conditional
Bounds = tuple[Any, Any]


class Kind:
    """One family of full conditionals.

    Attributes
    ----------
    name : str
        As the table of pairs says it.
    priors : tuple of type
        Families whose density has this form.
    event_ndims : tuple of int
        Trailing axes of each natural parameter.
    """

    name = ""
    priors: tuple[type, ...] = ()
    takes_flat = False
    event_ndims: tuple[int, ...] = ()

    def neutral(self, event_shape: Shape) -> np.ndarray:
        """A value at which children are evaluated, shape the event."""
        raise NotImplementedError

    def natural(self, base: Distribution) -> Naturals:
        """Natural parameters of a prior."""
        raise NotImplementedError

    def flat(self, low: np.ndarray, high: np.ndarray) -> Naturals:
        """Natural parameters of a flat prior: zeros, NaN where it lies outside the parameter's range."""
        raise NotImplementedError

    def power(self, base: Distribution | None) -> float | None:
        """The power of the value that the prior's exponential has; None where any will do."""
        return None

    def posterior(self, naturals: Naturals, bounds: Bounds | None, power: float) -> Distribution:
        """The distribution with these natural parameters, between the bounds."""
        raise NotImplementedError

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        """A draw of ``shape`` and the event without the checks of a distribution, or None."""
        return None


class Mean(Kind):
    """``exp(h x - P x^2 / 2)`` of a number."""

    name = "mean"
    priors = (Normal,)
    takes_flat = True
    event_ndims = (0, 0)

    def neutral(self, event_shape: Shape) -> np.ndarray:
        return np.zeros(event_shape)

    def natural(self, base: Any) -> Naturals:
        precision = base.scale**-2.0
        return precision, precision * base.loc

    def flat(self, low: np.ndarray, high: np.ndarray) -> Naturals:
        zeros = np.zeros(np.broadcast_shapes(low.shape, high.shape))
        return zeros, zeros

    def posterior(self, naturals: Naturals, bounds: Bounds | None, power: float) -> Distribution:
        precision, linear = naturals
        base = Normal(linear / precision, precision**-0.5)
        return base if bounds is None else Truncated(base, *bounds)

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        if bounds is not None:
            return None
        precision, linear = naturals
        draw = linear / precision + rng.standard_normal(shape) / np.sqrt(precision)
        # where a coefficient was lost the draw is no number, and the posterior says which
        return draw if math.isfinite(draw.sum()) else None


class MeanVector(Kind):
    """``exp(h'x - x'Px / 2)`` of a vector."""

    name = "mean"
    priors = (MvNormal,)
    event_ndims = (2, 1)

    def neutral(self, event_shape: Shape) -> np.ndarray:
        return np.zeros(event_shape)

    def natural(self, base: Any) -> Naturals:
        # inverting an upper triangle is back substitution: nothing is pivoted
        root = np.linalg.inv(np.matrix_transpose(base.scale_tril))
        precision = root @ np.matrix_transpose(root)
        return precision, np.matvec(precision, base.loc)

    def posterior(self, naturals: Naturals, bounds: Bounds | None, power: float) -> Distribution:
        precision, linear = naturals
        factor = _root_of_inverse(precision)
        mean = np.matvec(factor, np.vecmat(linear, factor))
        return MvNormal(mean, scale_tril=factor)

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        precision, linear = naturals
        draw = normal_draw(rng, precision, linear, shape)
        return draw if math.isfinite(draw.sum()) else None


class Scale(Kind):
    """``x^a exp(-b x^power)``: a power of x is Gamma."""

    name = "scale"
    priors = (Gamma, Exponential, InverseGamma)
    takes_flat = True
    event_ndims = (0, 0)

    def neutral(self, event_shape: Shape) -> np.ndarray:
        return np.ones(event_shape)

    def natural(self, base: Any) -> Naturals:
        if isinstance(base, Gamma):
            return base.concentration - 1.0, base.rate
        if isinstance(base, InverseGamma):
            return -base.concentration - 1.0, base.scale
        return np.zeros(np.shape(base.rate)), base.rate

    def flat(self, low: np.ndarray, high: np.ndarray) -> Naturals:
        zeros = np.where((low >= 0) & (high > 0), 0.0, np.nan)
        return zeros, zeros

    def power(self, base: Distribution | None) -> float | None:
        if base is None:
            return None
        return -1.0 if isinstance(base, InverseGamma) else 1.0

    def posterior(self, naturals: Naturals, bounds: Bounds | None, power: float) -> Distribution:
        exponent, rate = naturals
        concentration = (exponent + 1.0) / power
        if bounds is not None and _covers(bounds, 0.0, np.inf):
            bounds = None
        if power == -1.0:
            base: Distribution = InverseGamma(concentration, rate)
        else:
            base = Gamma(concentration, rate)
        if power in (1.0, -1.0):
            return base if bounds is None else Truncated(base, *bounds)
        if bounds is not None:
            ends = [np.asarray(b, dtype=float) ** power for b in bounds]
            base = Truncated(base, *(ends if power > 0 else ends[::-1]))
        return RootOf(base, power)


class Share(Kind):
    """``x^a (1 - x)^b``: Beta."""

    name = "share"
    priors = (Beta,)
    takes_flat = True
    event_ndims = (0, 0)

    def neutral(self, event_shape: Shape) -> np.ndarray:
        return np.full(event_shape, 0.5)

    def natural(self, base: Any) -> Naturals:
        return base.concentration1 - 1.0, base.concentration0 - 1.0

    def flat(self, low: np.ndarray, high: np.ndarray) -> Naturals:
        zeros = np.where((low >= 0) & (high <= 1), 0.0, np.nan)
        return zeros, zeros

    def posterior(self, naturals: Naturals, bounds: Bounds | None, power: float) -> Distribution:
        base = Beta(naturals[0] + 1.0, naturals[1] + 1.0)
        if bounds is None or _covers(bounds, 0.0, 1.0):
            return base
        return Truncated(base, *bounds)


class Shares(Kind):
    """``prod x_k^a_k`` on the simplex: Dirichlet."""

    name = "shares"
    priors = (Dirichlet,)
    event_ndims = (1,)

    def neutral(self, event_shape: Shape) -> np.ndarray:
        return np.full(event_shape, 1.0 / event_shape[-1])

    def natural(self, base: Any) -> Naturals:
        return (base.concentration,)

    def posterior(self, naturals: Naturals, bounds: Bounds | None, power: float) -> Distribution:
        return Dirichlet(naturals[0])

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        counts = naturals[0]
        if not np.minimum.reduce(counts, axis=None, initial=1.0) >= 1.0:
            return None  # small ones underflow, which the family looks after
        draw = gammas(rng, counts, shape + counts.shape[-1:])
        draw /= np.add.reduce(draw, axis=-1, keepdims=True)
        return draw


class Covariance(Kind):
    """``|x|^-(df + d + 1)/2 exp(-tr(S x^-1) / 2)``: inverse Wishart."""

    name = "covariance"
    priors = (InverseWishart,)
    event_ndims = (0, 2)

    def neutral(self, event_shape: Shape) -> np.ndarray:
        return np.eye(event_shape[-1])

    def natural(self, base: Any) -> Naturals:
        return base.df, base.scale

    def posterior(self, naturals: Naturals, bounds: Bounds | None, power: float) -> Distribution:
        return InverseWishart(*naturals)

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        df, scale = naturals
        return inverse_wishart_draw(rng, df, scale, shape)


#: all kinds, in the order in which they are tried for a flat prior
KINDS: tuple[Kind, ...] = (Mean(), MeanVector(), Scale(), Share(), Shares(), Covariance())


def split_prior(prior: Distribution) -> tuple[Distribution | None, Bounds | None]:
    """The base of a prior (None if flat) and its bounds (None if there are none)."""
    if isinstance(prior, Uniform):
        return None, (prior.low, prior.high)
    if isinstance(prior, Truncated) and not prior.is_discrete:
        low, high = prior.low, prior.high
        if isinstance(prior.base, Uniform):
            return None, (np.maximum(low, prior.base.low), np.minimum(high, prior.base.high))
        return prior.base, (low, high)
    return prior, None


class RootOf(Distribution):
    """The distribution of x where ``x**power`` is drawn from ``base``, on positive numbers.

    Parameters
    ----------
    base : Distribution
        Of one positive number.
    power : float
        Not zero.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conjugate_kinds import RootOf
    >>> sd = RootOf(bmc.Gamma(2.0, 1.0), -2.0)  # 1 / sd**2 is Gamma
    >>> float(sd.log_prob(1.0).round(4))
    -0.3069
    """

    def __init__(self, base: Distribution, power: float) -> None:
        self.base, self.exponent = base, power
        self._set_batch(base.batch_shape)
        self._adopt(base)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return self.base.sample_to(rng, shape) ** (1.0 / self.exponent)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        volume = np.log(abs(self.exponent)) + (self.exponent - 1.0) * np.log(x)
        return np.where(x > 0, self.base.log_prob(x**self.exponent) + volume, -np.inf)

    @property
    def support(self) -> Support:
        inner = self.base.support
        ends = [np.asarray(e, dtype=float) for e in (inner.low, inner.high)]
        with np.errstate(divide="ignore"):
            ends = [e ** (1.0 / self.exponent) for e in ends]
        low, high = ends if self.exponent > 0 else ends[::-1]
        return interval(low, high, True, True)


# ---- private ------------------------------------------------------------------------------------


def _covers(bounds: Bounds, low: float, high: float) -> bool:
    return bool(np.all(bounds[0] <= low) and np.all(bounds[1] >= high))


def _root_of_inverse(precision: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor of the inverse of each matrix.

    With rows and columns reversed, a Cholesky factor turns into an upper triangle U with
    ``precision = U U'``, whose inverse is back substitution.
    """
    spread = (
        np.linalg.diagonal(precision) ** -0.5
    )  # unit diagonal, whatever the units of components
    scaled = precision * (spread[..., :, None] * spread[..., None, :])
    upper = np.linalg.cholesky(scaled[..., ::-1, ::-1])[..., ::-1, ::-1]
    return spread[..., :, None] * np.matrix_transpose(np.linalg.inv(upper))
