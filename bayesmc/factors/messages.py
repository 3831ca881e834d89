"""Approximate messages: members of exponential families by their natural parameters.

In natural parameters products are sums and quotients differences, and whether the result has a finite
integral is a question asked afterwards: a message by itself need not have one. ``Message`` is what
expectation propagation asks of a family, ``ConditionalGaussian`` the family of a finite variable with a
Gaussian for each of its states; with one state it is a Gaussian, without numbers a table.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesmc.gaussian import try_cholesky


class Message(ABC):
    """A positive function of one variable, up to nothing: its scale counts.

    Leading axes, of shape ``lead``, are problems side by side.
    """

    @abstractmethod
    def times(self, other: Any) -> Any:
        """The product."""

    @abstractmethod
    def over(self, other: Any, otherwise: Any) -> Any:
        """The quotient; ``otherwise`` stands where both are zero."""

    @abstractmethod
    def towards(self, other: Any, share: Any) -> Any:
        """A geometric mean: ``other`` counts by ``share``, shape lead. What is zero in one of them is so."""

    @abstractmethod
    def scaled(self, log: np.ndarray) -> Any:
        """Multiplied by numbers whose logs are given, shape lead."""

    @abstractmethod
    def where(self, chosen: np.ndarray, otherwise: Any) -> Any:
        """This message for some of the problems, another for the rest."""

    @property
    @abstractmethod
    def log_total(self) -> np.ndarray:
        """Log of the integral, shape lead; NaN where it is not finite or not positive."""

    @abstractmethod
    def distance(self, other: Any) -> np.ndarray:
        """How far two beliefs are apart, shape lead, whatever their scales.

        The root of the symmetric Kullback-Leibler divergence, which in natural parameters is their difference
        times that of the moments: of Gaussians that differ in their means, the difference in standard
        deviations.
        """

    def normalised(self) -> Any:
        """With integral 1; as it is where that is not finite."""
        log = self.log_total
        return self.scaled(-np.where(np.isfinite(log), log, 0.0))


class Moments(NamedTuple):
    """Of a conditional Gaussian.

    Attributes
    ----------
    log : ndarray, shape (states, *lead)
        Logs of the states' integrals.
    mean : ndarray, shape (states, *lead, n)
    factor : ndarray, shape (states, *lead, n, n)
        Roots of the covariances.
    """

    log: np.ndarray
    mean: np.ndarray
    factor: np.ndarray


@dataclass(frozen=True, eq=False)
class ConditionalGaussian(Message):
    """``exp(log + linear' x - x' precision x / 2)`` for every state, against ``dx / (2 pi)^(n / 2)``.

    Attributes
    ----------
    log : ndarray, shape (states, *lead)
        -inf where the function is zero; then the others are zero, too.
    linear : ndarray, shape (states, *lead, n)
    precision : ndarray, shape (states, *lead, n, n)
        Symmetric; of any signs.

    References
    ----------
    Lauritzen (1992), Propagation of probabilities, means and variances in mixed graphical association models.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.messages import ConditionalGaussian
    >>> one = np.ones((1, 1, 1))  # one state, one number
    >>> wide = ConditionalGaussian.of(np.zeros(1), np.array([[1.0]]), 2.0 * one)  # N(1, 2^2)
    >>> slim = ConditionalGaussian.of(np.zeros(1), np.array([[3.0]]), one)  # N(3, 1)
    >>> both = wide.times(slim)
    >>> both.moments.mean.round(6).tolist(), (both.moments.factor**2).round(6).tolist()
    ([[2.6]], [[[0.8]]])
    >>> bool(np.isnan(wide.over(slim, wide).log_total))  # the quotient has no integral
    True
    """

    log: np.ndarray
    linear: np.ndarray
    precision: np.ndarray

    @classmethod
    def of(cls, log: np.ndarray, mean: np.ndarray, factor: np.ndarray) -> ConditionalGaussian:
        """From moments; ``factor`` has lower roots of the covariances, without zeros on the diagonal."""
        none = log == -np.inf
        if none.any():
            factor = np.where(none[..., None, None], np.eye(mean.shape[-1]), factor)
        left = inverse(factor)
        right = left.swapaxes(-1, -2)
        scaled = np.matvec(left, mean)
        precision, linear = right @ left, np.matvec(right, scaled)
        precision = 0.5 * (precision + precision.swapaxes(-1, -2))  # differences show rounding
        size = np.log(np.abs(factor.diagonal(0, -2, -1))).sum(axis=-1)
        found = log - size - 0.5 * np.vecdot(scaled, scaled)
        return cls(found, *_without(none, linear, precision))

    @classmethod
    def ones(cls, states: int, lead: tuple[int, ...], numbers: int) -> ConditionalGaussian:
        """One everywhere."""
        shape = (states, *lead)
        return cls(
            np.zeros(shape), np.zeros((*shape, numbers)), np.zeros((*shape, numbers, numbers))
        )

    def times(self, other: ConditionalGaussian) -> ConditionalGaussian:
        log = self.log + other.log
        parts = self.linear + other.linear, self.precision + other.precision
        return ConditionalGaussian(log, *_without(log == -np.inf, *parts))

    def over(
        self, other: ConditionalGaussian, otherwise: ConditionalGaussian
    ) -> ConditionalGaussian:
        none, open_ = self.log == -np.inf, other.log == -np.inf
        parts = self.linear - other.linear, self.precision - other.precision
        if not (none.any() or open_.any()):
            return ConditionalGaussian(self.log - other.log, *parts)
        log = np.where(none, -np.inf, self.log - np.where(open_, 0.0, other.log))
        found = ConditionalGaussian(log, *_without(none, *parts))
        return found._where(~open_, otherwise)

    def towards(self, other: ConditionalGaussian, share: Any) -> ConditionalGaussian:
        share = np.asarray(share, dtype=float)
        if (share == 1.0).all():
            return other
        log, linear, precision = (
            (1.0 - s) * a + s * b
            for s, a, b in (
                (share, self.log, other.log),
                (share[..., None], self.linear, other.linear),
                (share[..., None, None], self.precision, other.precision),
            )
        )
        return ConditionalGaussian(log, *_without(log == -np.inf, linear, precision))

    def scaled(self, log: np.ndarray) -> ConditionalGaussian:
        return ConditionalGaussian(self.log + log, self.linear, self.precision)

    def where(self, chosen: np.ndarray, otherwise: ConditionalGaussian) -> ConditionalGaussian:
        if chosen.all():
            return self
        return self._where(np.broadcast_to(chosen, self.log.shape), otherwise)

    @cached_property
    def log_total(self) -> np.ndarray:
        return log_sum(self.moments.log)

    @cached_property
    def moments(self) -> Moments:
        """Of every state; the log is NaN where the integral is not finite."""
        precision, none = self.precision, self.log == -np.inf
        if none.any():
            precision = np.where(none[..., None, None], np.eye(precision.shape[-1]), precision)
        root, bad = try_cholesky(precision)
        left = inverse(root)
        scaled = np.matvec(left, self.linear)
        right = left.swapaxes(-1, -2)
        size = np.log(root.diagonal(0, -2, -1)).sum(axis=-1)
        log = self.log + 0.5 * np.vecdot(scaled, scaled) - size
        if bad is not None:
            log = np.where(bad, np.nan, log)
        return Moments(log, np.matvec(right, scaled), right)

    def distance(self, other: ConditionalGaussian) -> np.ndarray:
        (one, weight), (two, also) = (m._expected() for m in (self, other))
        alive = (weight > 0) & (also > 0)
        log = np.where(alive, self.log, 0.0) - np.where(alive, other.log, 0.0)
        log = log - np.where(alive, self.log_total - other.log_total, 0.0)
        linear, precision = self.linear - other.linear, self.precision - other.precision
        mean, square = (a - b for a, b in zip(one, two, strict=True))
        apart = log * (weight - also) + np.vecdot(linear, mean)
        apart = apart - 0.5 * (precision * square).sum(axis=(-2, -1))
        found = np.where(alive, apart, 0.0).sum(axis=0)
        found = np.where(((weight > 0) != (also > 0)).any(axis=0), np.inf, found)
        return np.sqrt(np.maximum(found, 0.0))

    # ---- private -------------------------------------------------------------------------------

    def _expected(self) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Weighted means and second moments by state, and the weights."""
        log, mean, factor = self.moments
        weight = np.exp(log - self.log_total)
        square = factor @ np.matrix_transpose(factor) + mean[..., :, None] * mean[..., None, :]
        return (weight[..., None] * mean, weight[..., None, None] * square), weight

    def _where(self, chosen: np.ndarray, otherwise: ConditionalGaussian) -> ConditionalGaussian:
        return ConditionalGaussian(
            np.where(chosen, self.log, otherwise.log),
            np.where(chosen[..., None], self.linear, otherwise.linear),
            np.where(chosen[..., None, None], self.precision, otherwise.precision),
        )


def inverse(root: np.ndarray) -> np.ndarray:
    """Of matrices that have one, such as triangles with no zeros on the diagonal."""
    return np.linalg.solve(root, np.eye(root.shape[-1]))


def log_sum(log: np.ndarray) -> np.ndarray:
    """Log of a sum of exponentials over the first axis; NaN where that is zero or not finite."""
    top = log.max(axis=0)
    fine = np.isfinite(top)
    if fine.all():
        return np.log(np.exp(log - top).sum(axis=0)) + top
    safe = np.where(fine, top, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(fine, np.log(np.exp(log - safe).sum(axis=0)) + safe, np.nan)


# ---- private ------------------------------------------------------------------------------------


def _without(
    none: np.ndarray, linear: np.ndarray, precision: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Zero where the function is zero."""
    if not none.any():
        return linear, precision
    return np.where(none[..., None], 0.0, linear), np.where(none[..., None, None], 0.0, precision)
