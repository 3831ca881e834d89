"""Maps between a support and unconstrained numbers, with their Jacobians.

A sampler that moves freely on the real line needs three things of a bounded value: where a free
point lands, where a value came from, and by how much volume is stretched on the way. A
``Transform`` is made from a ``Support`` alone; it knows neither densities nor samplers, and
discrete supports have none.

The maps are those of the Stan Reference Manual (version 2.36, chapter "Constraint Transforms").
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.intervals import PIECES, is_finite
from bayesmc.distributions.matrix_transforms import LogCholesky, PartialCorrelations
from bayesmc.distributions.support import Support
from bayesmc.distributions.transform import Transform
from bayesmc.errors import ShapeError, UnsupportedError
from bayesmc.shapes import Shape

_TINY = np.finfo(float).tiny
_LOG_STEP = 690.0  # many steps of exp(690) are still a double


def transform_of(support: Support, event_shape: Shape = ()) -> Transform:
    """The map between unconstrained numbers and values of a support.

    Parameters
    ----------
    support : Support
        Its bounds may be arrays that broadcast with the values (one per batch element, say);
        some may be infinite.
    event_shape : tuple of int
        Shape of one value. A support of numbers with a longer event shape applies to each number.

    Returns
    -------
    Transform

    Raises
    ------
    UnsupportedError
        The support is discrete.
    ShapeError
        ``event_shape`` does not fit the support.

    References
    ----------
    Stan Reference Manual, version 2.36, chapter "Constraint Transforms".

    Examples
    --------
    >>> from bayesmc.distributions.support import positive, simplex
    >>> from bayesmc.distributions.transforms import transform_of
    >>> transform_of(positive).constrain([-1000.0, 0.0]).tolist()
    [5e-324, 1.0]
    >>> sticks = transform_of(simplex, (4,))
    >>> sticks.unconstrained_shape, sticks.constrain([0.0, 0.0, 0.0]).round(6).tolist()
    ((3,), [0.25, 0.25, 0.25, 0.25])
    """
    if support.is_discrete:
        raise UnsupportedError(
            f"transform: discrete values ({support.describe()}) have no unconstrained space; "
            "enumerate them or update them by Gibbs sampling"
        )
    _check_event(support, event_shape)
    kind = support.kind
    if kind in ("real", "real vector"):
        return Identity(event_shape)
    if kind == "interval":
        low, high = np.asarray(support.low, dtype=float), np.asarray(support.high, dtype=float)
        if support.is_constant and low.size and high.size:
            low, high = low.flat[0], high.flat[0]
        return Bounded(event_shape, np.asarray(low), np.asarray(high))
    if kind == "product":
        return _side_by_side(support, event_shape)
    if kind == "increasing":
        if not support.is_single:
            raise UnsupportedError(
                "transform: numbers in order between bounds that differ have no map"
            )
        least, most = (float(np.asarray(b).flat[0]) for b in (support.low, support.high))
        return Increasing(event_shape, least, most)
    return _OF_KIND[kind](event_shape)


class Identity(Transform):
    """Unbounded numbers and vectors: ``x = u``."""

    def formula(self, u: Any) -> Any:
        return +u

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        return x.copy()

    def log_det_formula(self, u: Any) -> Any:
        return np.zeros(np.shape(u)[: np.ndim(u) - len(self.event_shape)])


class Wrapped(Transform):
    """Angles: ``x`` is ``u`` wrapped to [-pi, pi).

    A covering of the circle, not a bijection: u and u + 2 pi are one angle, of Jacobian one.
    """

    def formula(self, u: Any) -> Any:
        # an angle already in range keeps all its digits
        return u - 2 * np.pi * np.floor((u + np.pi) / (2 * np.pi))

    @property
    def angles(self) -> np.ndarray:
        return np.ones(self.unconstrained_shape, bool)

    def _kept_inside(self, x: np.ndarray) -> np.ndarray:
        return np.where(x >= np.pi, -np.pi, np.maximum(x, -np.pi))

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        return self._kept_inside(self.formula(x))

    def log_det_formula(self, u: Any) -> Any:
        return np.zeros(np.shape(u)[: np.ndim(u) - len(self.event_shape)])


@dataclass(frozen=True, eq=False)
class Bounded(Transform):
    """Numbers with bounds, each finite or not.

    ``low + exp(u)``, ``high - exp(u)`` or ``low + (high - low) expit(u)``; ``u`` where there is no
    bound.
    """

    low: np.ndarray
    high: np.ndarray

    @cached_property
    def _inside(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the greatest number between the bounds."""
        return np.nextafter(self.low, np.inf), np.nextafter(self.high, -np.inf)

    @cached_property
    def _bounds(self) -> tuple[np.ndarray, list[int], Shape]:
        """Which bounds each element has (0 none, 1 low, 2 high, 3 both), those found, the shape."""
        has = np.asarray(is_finite(self.low) + 2 * is_finite(self.high))
        return has, [int(k) for k in np.unique(has)], has.shape

    def formula(self, u: Any) -> Any:
        return self._piecewise("constrain", u)

    def _kept_inside(self, x: np.ndarray) -> np.ndarray:
        # far out exp and expit round onto a bound, or overflow
        least, greatest = self._inside
        return np.minimum(np.maximum(x, least), greatest)

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        return self._piecewise("unconstrain", x)

    def log_det_formula(self, u: Any) -> Any:
        return self._summed(self._piecewise("log_det", u))

    def _piecewise(self, what: str, value: Any) -> Any:
        """Each element by the formula for the bounds that it has."""
        has, found, shape = self._bounds
        full = np.broadcast_shapes(value.shape, shape)
        if not found:
            return np.empty(full)
        parts = [PIECES[what][k](value, self.low, self.high) for k in found]
        result = parts[0]
        for k, part in zip(found[1:], parts[1:], strict=True):
            result = np.where(has == k, part, result)
        if result.shape != full:  # the Jacobian of one bound does not depend on it: of its batch
            result = np.copy(np.broadcast_to(result, full))
        return result


class StickBreaking(Transform):
    """Vectors of K probabilities, from K - 1 numbers; zeros are the uniform vector.

    Component k takes the share ``expit(u_k - log(K - k))`` of what the components before it left.
    """

    @property
    def unconstrained_shape(self) -> Shape:
        return (self.event_shape[0] - 1,)

    def formula(self, u: Any) -> Any:
        log_share, log_left = self._sticks(u)
        one = np.zeros((*u.shape[:-1], 1))
        share = np.concatenate([log_share, one], axis=-1)
        return np.exp(share + np.concatenate([one, log_left], axis=-1))

    def _kept_inside(self, x: np.ndarray) -> np.ndarray:
        return np.maximum(x, _TINY)

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        # the tail is added up from its end, which keeps the digits that 1 - (sum so far) would lose
        after = np.flip(np.cumsum(np.flip(x, axis=-1), axis=-1), axis=-1)[..., 1:]
        u = np.log(x[..., :-1]) - np.log(after) + self._centre()
        outside = ~(np.abs(x.sum(axis=-1, keepdims=True) - 1) <= 1e-6)
        return np.where(outside | (x < 0).any(axis=-1, keepdims=True), np.nan, u)

    def log_det_formula(self, u: Any) -> Any:
        log_share, log_left = self._sticks(u)
        # d x_k / d u_k = z_k (1 - z_k) (what is left before k): a triangular matrix
        return (log_share + log_left).sum(axis=-1)

    def _sticks(self, u: Any) -> tuple[Any, Any]:
        """Logarithms of each share of the remainder, and of what remains after it."""
        shifted = u - self._centre()
        return special.log_expit(shifted), np.cumsum(special.log_expit(-shifted), axis=-1)

    def _centre(self) -> np.ndarray:
        return np.log(np.arange(self.event_shape[0] - 1, 0, -1))


@dataclass(frozen=True, eq=False)
class Increasing(Transform):
    """Numbers in order between bounds, each finite or not: logarithms of how far each is from the next.

    With no bound the first number stands for itself. Between two bounds the K + 1 steps are shares of the
    whole (`StickBreaking`). Beyond 690 logarithms count as 690, for the sum of larger steps is no double.
    """

    low: float
    high: float

    def formula(self, u: Any) -> Any:
        if math.isfinite(self.low) and math.isfinite(self.high):
            shares = self._shares.formula(u)[..., :-1]
            return self.low + (self.high - self.low) * np.cumsum(shares, axis=-1)
        if math.isfinite(self.low):
            return self.low + np.cumsum(self._steps(u), axis=-1)
        if math.isfinite(self.high):
            return self.high - np.flip(np.cumsum(np.flip(self._steps(u), -1), axis=-1), -1)
        return np.cumsum(np.concatenate([u[..., :1], self._steps(u[..., 1:])], axis=-1), axis=-1)

    def _kept_inside(self, x: np.ndarray) -> np.ndarray:
        """Steps that rounding took away are the least there are, up, and then down from the bound."""
        x, size = np.maximum(x, np.nextafter(self.low, np.inf)), self.event_shape[0]
        for k in range(1, size):
            x[..., k] = np.maximum(x[..., k], np.nextafter(x[..., k - 1], np.inf))
        x[..., -1] = np.minimum(x[..., -1], np.nextafter(self.high, -np.inf))
        for k in range(size - 1, 0, -1):
            x[..., k - 1] = np.minimum(x[..., k - 1], np.nextafter(x[..., k], -np.inf))
        return x

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        has_low, has_high = math.isfinite(self.low), math.isfinite(self.high)
        one = np.ones((*x.shape[:-1], 1))
        ends = [self.low * one] * has_low, [self.high * one] * has_high
        steps = np.diff(np.concatenate([*ends[0], x, *ends[1]], axis=-1), axis=-1)
        if has_low and has_high:
            return self._shares._unconstrain(steps / (self.high - self.low))
        logs = np.log(steps)
        return logs if has_low or has_high else np.concatenate([x[..., :1], logs], axis=-1)

    def log_det_formula(self, u: Any) -> Any:
        if math.isfinite(self.low) and math.isfinite(self.high):
            wide = self.event_shape[0] * math.log(self.high - self.low)
            return self._shares.log_det_formula(u) + wide
        is_free = not (math.isfinite(self.low) or math.isfinite(self.high))
        return np.sum(u[..., 1:] if is_free else u, axis=-1)

    @property
    def _shares(self) -> StickBreaking:
        return StickBreaking((self.event_shape[0] + 1,))

    def _steps(self, u: Any) -> Any:
        return np.exp(np.minimum(u, _LOG_STEP))


_OF_KIND: dict[str, Callable[[Shape], Transform]] = {
    "circle": Wrapped,
    "simplex": StickBreaking,
    "positive definite": LogCholesky,
    "correlation": PartialCorrelations,
}


@dataclass(frozen=True, eq=False)
class SideBySide(Transform):
    """A vector whose parts have maps of their own; the numbers behind them follow in order."""

    parts: tuple[Transform, ...]

    @property
    def unconstrained_shape(self) -> Shape:
        return (sum(_width(part.unconstrained_shape) for part in self.parts),)

    @property
    def angles(self) -> np.ndarray:
        return np.concatenate([np.atleast_1d(part.angles) for part in self.parts])

    def formula(self, u: Any) -> Any:
        pieces = self._cut(u, lambda part: part.unconstrained_shape)
        values = [part.formula(piece) for part, piece in zip(self.parts, pieces, strict=True)]
        return _joined(values, [part.event_shape for part in self.parts])

    def _kept_inside(self, x: np.ndarray) -> np.ndarray:
        pieces = self._cut(x, lambda part: part.event_shape)
        kept = [part._kept_inside(piece) for part, piece in zip(self.parts, pieces, strict=True)]
        return _joined(kept, [part.event_shape for part in self.parts])

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        pieces = self._cut(x, lambda part: part.event_shape)
        values = [part.unconstrain(piece) for part, piece in zip(self.parts, pieces, strict=True)]
        return _joined(values, [part.unconstrained_shape for part in self.parts])

    def log_det_formula(self, u: Any) -> Any:
        pieces = self._cut(u, lambda part: part.unconstrained_shape)
        total = np.zeros(u.shape[:-1])
        for part, piece in zip(self.parts, pieces, strict=True):
            total = total + part.log_det_formula(piece)
        return total

    def _cut(self, vector: Any, shape_of: Callable[[Transform], Shape]) -> list[Any]:
        pieces, start = [], 0
        for part in self.parts:
            shape = shape_of(part)
            stop = start + _width(shape)
            pieces.append(vector[..., start:stop] if shape else vector[..., start])
            start = stop
        return pieces


def _check_event(support: Support, event_shape: Shape) -> None:
    axes = support.event_ndim
    fits = not axes or len(event_shape) == axes
    if support.kind in ("simplex", "increasing"):
        fits = fits and event_shape[0] > 0
    elif support.kind in ("positive definite", "correlation"):
        fits = fits and event_shape[0] == event_shape[1]
    elif support.kind == "product":
        fits = fits and event_shape[0] == sum(max(count, 1) for _, count in support.parts)
    if not fits:
        raise ShapeError(f"transform: {support.describe()} have no event shape {event_shape}")


def _side_by_side(support: Support, event_shape: Shape) -> Transform:
    parts = [transform_of(part, (count,) if count else ()) for part, count in support.parts]
    return SideBySide(event_shape, tuple(parts))


def _width(shape: Shape) -> int:
    return shape[0] if shape else 1


def _joined(values: list[Any], shapes: list[Shape]) -> Any:
    """Parts along the last axis, their leading axes broadcast; a part of shape () is one column."""
    rows = [v if shape else v[..., None] for v, shape in zip(values, shapes, strict=True)]
    lead = np.broadcast_shapes(*(row.shape[:-1] for row in rows))
    return np.concatenate([np.broadcast_to(row, lead + row.shape[-1:]) for row in rows], axis=-1)
