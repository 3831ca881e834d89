"""Affine images: ``loc + scale * y`` of a continuous distribution, component by component."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.support import Support, interval, product
from bayesmc.distributions.tails import Tails, tails_of
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError
from bayesmc.shapes import Shape


class Affine(Distribution):
    """Distribution of ``x = loc + scale * y``, where ``y`` has the distribution ``base``.

    Parameters
    ----------
    base : Distribution or frozen scipy.stats distribution
        Continuous, of one number or of one vector.
    loc : array_like
        Finite shift. For numbers it broadcasts with the batch of ``base``; for vectors of d
        components its last axis is the event's: shape ``(..., d)``, or ``(..., 1)`` for one shift
        of all components, or a single number.
    scale : array_like
        Finite factor, not zero, shaped as ``loc``; a negative one flips.

    Raises
    ------
    ParameterError
        ``loc`` is not finite, or ``scale`` is zero or not finite.
    ShapeError
        ``loc`` or ``scale`` does not fit the base's batch and event.
    UnsupportedError
        The base is discrete, has matrices as values, or lies on a circle or on a simplex, which an
        affine map would leave.

    References
    ----------
    Murphy, Probabilistic Machine Learning: An Introduction, 2022, section 2.8.3.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> flipped = bmc.Affine(bmc.Exponential(1.0), 3.0, -2.0)
    >>> float(flipped.mean), flipped.support.describe(), float(flipped.cdf(3.0))
    (1.0, 'numbers <= 3', 1.0)
    """

    def __init__(self, base: Any, loc: Any = 0.0, scale: Any = 1.0) -> None:
        self.base = _usable(base)
        self.event_shape = self.base.event_shape
        vector = len(self.event_shape)
        loc, scale = (
            _shaped(name, value, self.event_shape)
            for name, value in (("loc", loc), ("scale", scale))
        )
        self._set_batch(
            self.base.batch_shape,
            loc.shape[: loc.ndim - vector],
            scale.shape[: scale.ndim - vector],
        )
        self._adopt(self.base)
        fine = np.isfinite(scale) & (scale != 0)
        self.loc = self._component("loc", loc, np.isfinite(loc), 0.0, "finite")
        self.scale = self._component("scale", scale, fine, 1.0, "finite and not zero")

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        vector = len(self.event_shape)
        return [*self.base.parameters(), (self.loc, vector), (self.scale, vector)]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return self.loc + self.scale * self.base.sample_to(rng, shape)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        log_scale = np.log(np.abs(self.scale))
        if self.event_shape:
            log_scale = np.broadcast_to(
                log_scale, log_scale.shape[:-1] + self.event_shape
            ).sum(axis=-1)  # fmt: skip
        return self.base.log_prob(self._back(x)) - log_scale

    @property
    def mean(self) -> np.ndarray:
        return self._full(self.loc + self.scale * self.base.mean)

    @property
    def var(self) -> np.ndarray:
        return self._full(self.scale**2 * self.base.var)

    @property
    def support(self) -> Support:
        support = self.base.support
        if support.kind == "interval":
            if not self.event_shape:
                return _mapped(support, self.loc, self.scale)
            loc, scale = np.broadcast_arrays(self.loc, self.scale, np.zeros(self.event_shape))[:2]
            parts = [_mapped(support, loc[..., k], scale[..., k]) for k in range(loc.shape[-1])]
            return product([(part, 0) for part in parts])
        if support.kind == "product":
            return _mapped_product(support, self.loc, self.scale, self.event_shape)
        return support

    def cdf(self, x: Any) -> np.ndarray:
        self._one_number("cdf")
        x = np.asarray(x, dtype=float)
        below = self.base.cdf(self._back(x))
        value = np.where(self.scale > 0, below, 1.0 - below)
        return np.where(np.isnan(x), np.nan, value)

    def ppf(self, q: Any) -> np.ndarray:
        self._one_number("ppf")
        q = as_quantile(q)
        return self.loc + self.scale * self.base.ppf(np.where(self.scale > 0, q, 1.0 - q))

    def _tails(self) -> Tails:
        return _AffineTails(self)

    def _back(self, x: np.ndarray) -> np.ndarray:
        """The base's value for ``x``; rounding does not take it out of the base's interval."""
        y = (x - self.loc) / self.scale
        support = self.base.support
        if support.kind != "interval" or self.event_shape:
            return y
        inside = self.support.contains(x)
        return np.where(inside, np.clip(y, support.low, support.high), y)

    def _full(self, value: np.ndarray) -> np.ndarray:
        return np.broadcast_to(value, self.batch_shape + self.event_shape)

    def _one_number(self, what: str) -> None:
        if self.event_shape:
            raise UnsupportedError(f"Affine: a vector of shape {self.event_shape} has no {what}")

    def _component(
        self, name: str, value: np.ndarray, ok: Any, fallback: float, requirement: str
    ) -> np.ndarray:
        if self.event_shape:
            ok = ok.all(axis=-1)
        return self._check(name, value, np.asarray(ok), fallback, requirement)


class _AffineTails(Tails):
    """The base's tails, changed over where the scale is negative."""

    def __init__(self, dist: Affine) -> None:
        super().__init__(dist)
        self.inner = tails_of(dist.base)
        self.up = dist.scale > 0
        pair = (self.inner.lower_resolution, self.inner.upper_resolution)
        self.lower_resolution = pair[0] if self.up.all() else max(pair)
        self.upper_resolution = pair[1] if self.up.all() else max(pair)
        if not self.up.any():
            self.lower_resolution, self.upper_resolution = pair[1], pair[0]

    def log_cdf(self, x: np.ndarray) -> np.ndarray:
        y = (x - self.dist.loc) / self.dist.scale
        return np.where(self.up, self.inner.log_cdf(y), self.inner.log_sf(y))

    def log_sf(self, x: np.ndarray) -> np.ndarray:
        y = (x - self.dist.loc) / self.dist.scale
        return np.where(self.up, self.inner.log_sf(y), self.inner.log_cdf(y))

    def lower(self, log_q: np.ndarray) -> np.ndarray:
        y = np.where(self.up, self.inner.lower(log_q), self.inner.upper(log_q))
        return self.dist.loc + self.dist.scale * y

    def upper(self, log_q: np.ndarray) -> np.ndarray:
        y = np.where(self.up, self.inner.upper(log_q), self.inner.lower(log_q))
        return self.dist.loc + self.dist.scale * y


_REFUSED = {
    "circle": "an angle would not keep its period",
    "simplex": "probabilities would no longer sum to 1",
    "positive definite": "a matrix would not stay positive definite",
    "increasing": "numbers in order may not keep their bounds or their order; move the base of Ordered",
    "correlation": "a correlation matrix would not keep ones on its diagonal",
}


def _usable(base: Any) -> Distribution:
    dist = as_distribution(base)
    if dist is None:
        raise ParameterError(f"Affine: base must be a distribution; got {type(base).__name__}")
    family, kind = type(dist).__name__, dist.support.kind
    if dist.is_discrete:
        raise UnsupportedError(
            f"Affine: {family} is discrete, and its values would no longer be whole numbers; "
            "scale it in a deterministic node"
        )
    if kind in _REFUSED:
        raise UnsupportedError(
            f"Affine: {family} lies on {dist.support.describe()}: {_REFUSED[kind]}; transform it "
            "in a deterministic node"
        )
    if len(dist.event_shape) > 1:
        raise UnsupportedError(f"Affine: {family} has matrices as values; use vectors or numbers")
    return dist


def _shaped(name: str, value: Any, event_shape: Shape) -> np.ndarray:
    """A parameter with the event's axis last."""
    array = as_float(value)
    if not event_shape:
        return array
    if array.ndim == 0:
        return array.reshape(1)
    if array.shape[-1] not in (1, *event_shape):
        raise ShapeError(
            f"Affine: {name} of shape {array.shape} does not fit vectors of {event_shape[0]} "
            f"components; its last axis must have length {event_shape[0]} or 1"
        )
    return array


def _mapped(support: Support, loc: Any, scale: Any) -> Support:
    """An interval's image; all flipped or none, or the open ends are taken as excluded."""
    ends = (
        loc + scale * np.asarray(support.low, float),
        loc + scale * np.asarray(support.high, float),
    )
    low, high = np.minimum(*ends), np.maximum(*ends)
    if np.all(np.isneginf(low)) and np.all(np.isposinf(high)):
        return Support("real")
    if np.all(scale > 0):
        return interval(low, high, support.open_low, support.open_high)
    if np.all(scale < 0):
        return interval(low, high, support.open_high, support.open_low)
    either = support.open_low or support.open_high
    return interval(low, high, either, either)


def _mapped_product(support: Any, loc: Any, scale: Any, event_shape: Shape) -> Support:
    loc, scale = (np.broadcast_to(v, v.shape[:-1] + event_shape) for v in (loc, scale))
    parts, at = [], 0
    for part, size in support.parts:
        if part.kind == "interval" and not size:
            part = _mapped(part, loc[..., at], scale[..., at])
        elif part.kind not in ("real", "real vector"):
            raise UnsupportedError(
                f"Affine: a part of the base lies on {part.describe()}, which an affine map leaves; "
                "apply Affine to the parts that it suits, inside the Joint"
            )
        parts.append((part, size))
        at += size or 1
    return type(support)(support.kind, parts=tuple(parts))
