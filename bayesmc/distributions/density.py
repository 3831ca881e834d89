"""A distribution given by its log density as a function, optionally with a way to sample it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.distributions.base import Distribution, draw_to
from bayesmc.distributions.support import Support, as_support
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    ParameterError,
    ShapeError,
    UnsupportedError,
)
from bayesmc.shapes import Shape, as_shape, broadcast_shapes, broadcasts_to


class Density(Distribution):
    """A distribution given as an equation: its log density, up to no constant at all.

    Parameters
    ----------
    log_prob : callable
        Maps values of shape ``(..., *event_shape)`` to log densities, broadcasting ``...`` with the
        batch of whatever parameters it closes over. Asked only inside the support to any effect.
    sample : callable, optional
        ``sample(rng, sample_shape)`` returns ``sample_shape + batch_shape + event_shape`` draws.
        Without it, engines that sample forwards refuse; ``InverseCdf(density)`` makes any
        density of one number samplable.
    event_shape : tuple of int
        Shape of one value.
    support : str, tuple or Support
        ``"real"``, ``"positive"``, ``"unit interval"``, ``"nonnegative integer"``, ``"simplex"``,
        ..., a pair ``(low, high)``, or a Support. A support on integers makes it discrete.
    batch_shape : tuple of int, optional
        Found by evaluating ``log_prob`` at one point when not given.

    Raises
    ------
    ParameterError
        The bounds of ``support`` leave nothing between them.
    DensityError
        On use, when ``log_prob`` fails or does not return numbers.
    ShapeError
        On use, when ``log_prob`` or ``sample`` returns another shape than promised.
    UnsupportedError
        On sampling, when there is no ``sample``.

    References
    ----------
    Koller and Friedman, Probabilistic Graphical Models, 2009, section 5.1: any conditional density
    is a local model.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> triangle = bmc.Density(lambda x: np.log(2 * x), support="unit interval")
    >>> triangle.log_prob([0.5, 2.0]).tolist()
    [0.0, -inf]
    """

    def __init__(
        self,
        log_prob: Callable[[np.ndarray], Any],
        sample: Callable[[np.random.Generator, Shape], Any] | None = None,
        event_shape: int | Shape = (),
        support: Any = "real",
        batch_shape: int | Shape | None = None,
    ) -> None:
        if not callable(log_prob):
            raise TypeError(
                f"Density({log_prob!r}): the first argument is a function, the log density"
            )
        if sample is not None and not callable(sample):
            raise TypeError(
                f"Density(sample={sample!r:.80}): sample is a function, sample(rng, sample_shape)"
            )
        self._function = log_prob
        self._sampler = sample
        self.event_shape = as_shape(event_shape)
        self._support = _checked_support(support)
        if self._support.kind == "real" and len(self.event_shape) == 1:
            self._support = as_support("real vector")
        self._batch = None if batch_shape is None else as_shape(batch_shape)
        self.is_discrete = self._support.is_discrete  # type: ignore[misc]
        event_ndim = self._support.event_ndim
        if event_ndim and event_ndim != len(self.event_shape):
            raise ShapeError(
                f"Density: support {self._support.describe()!r} takes event_shape of {event_ndim} "
                f"axes; got {self.event_shape}"
            )

    @property
    def batch_shape(self) -> Shape:  # type: ignore[override]
        if self._batch is None:
            point = _points(self._support, self.event_shape)[0]
            self._batch = np.shape(self._evaluate(point))
        return self._batch

    @property
    def can_sample(self) -> bool:
        """Whether a ``sample`` function was given."""
        return self._sampler is not None

    @property
    def support(self) -> Support:
        return self._support

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        """Log densities at a few points of the support stand for the function's parameters."""
        points = _points(self._support, self.event_shape)
        return [(np.broadcast_to(self.log_prob(point), self.batch_shape), 0) for point in points]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        if self._sampler is None:
            raise UnsupportedError(
                "Density.sample: this density was given without a way to sample it; pass "
                "sample=function(rng, sample_shape), wrap it as InverseCdf(density) if its values are "
                "single numbers, or use an engine that needs only log_prob"
            )
        return draw_to(
            lambda lead: self._draw(rng, lead), self.batch_shape, shape, self.event_shape
        )

    def _draw(self, rng: np.random.Generator, sample_shape: Shape) -> np.ndarray:
        draws = np.array(self._sampler(rng, sample_shape))  # type: ignore[misc]
        expected = sample_shape + self.batch_shape + self.event_shape
        if draws.shape != expected:
            raise ShapeError(
                f"Density: sample(rng, {sample_shape}) returned shape {draws.shape}, not "
                f"sample_shape + batch_shape + event_shape = {expected}"
            )
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        cut = x.ndim - len(self.event_shape)
        if cut < 0 or x.shape[cut:] != self.event_shape:
            raise ShapeError(f"Density: x has shape {x.shape}, not (..., *{self.event_shape})")
        lead, batch = x.shape[:cut], self.batch_shape
        value = self._evaluate(x)
        try:
            expected = broadcast_shapes(lead, batch)
        except ValueError:
            expected = None
        if expected is None or not broadcasts_to(value.shape, expected):
            wanted = expected if expected is not None else "the two to broadcast"
            raise ShapeError(
                f"Density: log_prob returned shape {value.shape} for values of shape {x.shape} "
                f"(event {self.event_shape}, batch {batch}); expected {wanted}: reduce the event "
                "axes and leave the others alone"
            )
        inside = self._inside(x)
        return np.where(inside, np.broadcast_to(value, expected), -np.inf)

    def _inside(self, x: np.ndarray) -> np.ndarray:
        inside: Any = self._support.contains(x)
        spare = len(self.event_shape) - self._support.event_ndim
        if spare:  # a support of numbers, a value of several
            inside = inside.all(axis=tuple(range(-spare, 0)))
        return inside

    def _evaluate(self, x: np.ndarray) -> np.ndarray:
        value: Any = None
        try:
            with np.errstate(all="ignore"):
                value = self._function(x)
                return np.asarray(value, dtype=float)
        except BayesmcError:
            raise
        except Exception as error:
            if value is None:
                fault = f"fails on arrays of shape {x.shape} ({type(error).__name__}: {error})"
            else:
                fault = f"returned {value!r:.80} for values of shape {x.shape}, not log densities"
            raise DensityError(
                f"Density: log_prob {fault}; write it with NumPy, element by element (np.where for if)"
            ) from error


def _checked_support(spec: Any) -> Support:
    support = as_support(spec)
    low, high = np.asarray(support.low, dtype=float), np.asarray(support.high, dtype=float)
    empty = low > high if support.is_discrete else low >= high
    if np.any(empty | np.isnan(low) | np.isnan(high)):
        raise ParameterError(f"Density(support={spec!r}): the support must have low < high")
    return support


def _points(support: Support, event_shape: Shape) -> list[np.ndarray]:
    """A few points of the support, unlike each other, to ask the function at."""
    kind = support.kind
    if kind == "simplex":
        size = event_shape[0]
        ramp = np.arange(1.0, size + 1)
        return [np.full(size, 1 / size), ramp / ramp.sum()]
    if kind == "positive definite":
        return [np.eye(event_shape[0]), 2.0 * np.eye(event_shape[0])]
    if kind == "correlation":
        return [np.eye(event_shape[0]), 0.5 * (np.eye(event_shape[0]) + 1.0)]
    if kind == "increasing":
        return [_in_order(support, event_shape[0], share) for share in (0.5, 0.8125)]
    if kind == "counts":
        return [np.zeros(event_shape), np.ones(event_shape)]
    if kind in ("interval", "integers"):
        # bounds that depend on the parents: the middle of the intersection, if there is one
        low, high = float(np.max(support.low)), float(np.min(support.high))
        places = _integers(low, high) if kind == "integers" else _numbers(low, high)
    else:
        places = [0.375, -1.25]
    return [np.full(event_shape, place) for place in places]


def _in_order(support: Support, size: int, share: float) -> np.ndarray:
    low, high = float(np.max(support.low)), float(np.min(support.high))
    if not np.isfinite(low):
        low = high - size if np.isfinite(high) else -1.25
    high = high if np.isfinite(high) else low + size
    return low + (high - low) * share * np.arange(1.0, size + 1) / (size + 1)


def _numbers(low: float, high: float) -> list[float]:
    if np.isfinite(low) and np.isfinite(high):
        return [low + 0.375 * (high - low), low + 0.8125 * (high - low)]
    if np.isfinite(low):
        return [low + 0.75, low + 2.5]
    return [high - 0.75, high - 2.5] if np.isfinite(high) else [0.375, -1.25]


def _integers(low: float, high: float) -> list[float]:
    start = low if np.isfinite(low) else high - 1 if np.isfinite(high) else 0.0
    return [start, min(start + 1, high)]
