"""Learning the size and the shape of Gaussian steps while a chain warms up.

One covariance for every element that moves by itself, learnt from all chains together, and a scale for
every chain, which finds the mass from far away; at the end of the warmup the scales become one. The
numbers are those of an unconstrained space or of the node itself: nothing is known of nodes here, but
which numbers are angles, whose deviations from their mean go the short way round.

References
----------
Haario, Saksman and Tamminen (2001), Bernoulli 7; Andrieu and Thoms (2008), Statistics and Computing 18;
Vihola (2012), Statistics and Computing 22.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bayesmc.distributions.circular import wrap_angle
from bayesmc.distributions.support import Support
from bayesmc.distributions.transforms import transform_of
from bayesmc.shapes import Shape

#: adaptation slows down with these powers of the number of sweeps: covariances need longer memories
_DECAY, SCALE_DECAY = 0.6, 0.5
#: share of its diagonal that is added to a covariance, which chains that hardly move leave singular
_LOADING = 1e-4
#: sweeps between two factorisations of a covariance
_EVERY = 5
#: standard deviation at which a step round a circle goes anywhere, to exp(-20): longer ones are no better
_ANYWHERE = 2 * math.pi


def best_rate(size: int) -> float:
    """The acceptance rate at which a random walk in so many dimensions mixes best: 0.44 to 0.234.

    References
    ----------
    Roberts and Rosenthal (2001), Statistical Science 16.
    """
    return 0.234 + 0.206 / max(size, 1)


def turning(support: Support, event_shape: Shape, unconstrained: bool = True) -> np.ndarray:
    """Which of the numbers that walk for one value of a support are angles, flat.

    Examples
    --------
    >>> from bayesmc.distributions.support import circle, product, simplex
    >>> from bayesmc.kernels.adaptation import turning
    >>> turning(product([(simplex, 3), (circle, 0)]), (4,)).tolist()  # a simplex walks by two numbers
    [False, False, True]
    """
    if not unconstrained:
        return support.angles(math.prod(event_shape))
    if support.kind == "product":
        parts = [turning(part, (count,) if count else ()) for part, count in support.parts]
        return np.concatenate(parts)
    return support.angles(math.prod(transform_of(support, event_shape).unconstrained_shape))


class Steps:
    """Gaussian steps of elements that each have ``size`` numbers.

    A memory is a dict of arrays: ``mean`` (elements, size), ``cov`` and its Cholesky ``factor`` (elements,
    size, size), the latter scaled to determinant one; ``log_scale`` (chains, elements), the mean
    logarithm of the standard deviations, so that the length of steps does not follow a covariance that is
    still far off; ``average`` (elements,) of these; ``count``.

    Parameters
    ----------
    size : int
    scale : array_like, optional
        Standard deviations to start from, broadcasting to (elements, size); by default those of the
        starting points.
    adaptive : bool
        Whether anything is learnt.
    angles : ndarray of bool, shape (size,), optional
        Which numbers are angles: their means are circular, so that a cut of the circle through the mass
        does not pass for spread.
    """

    def __init__(
        self,
        size: int,
        scale: Any = None,
        adaptive: bool = True,
        angles: np.ndarray | None = None,
    ) -> None:
        self.size = size
        self.scale = scale
        self.adaptive = adaptive
        self.angles = angles if angles is not None and angles.any() else None
        #: nothing but angles has a longest step: where all are accepted, the scale would grow for good
        self._longest = math.log(_ANYWHERE) if angles is not None and angles.all() else math.inf
        self.rate = best_rate(size)
        self.base = 2.38 / math.sqrt(max(size, 1))

    def start(self, u: np.ndarray) -> dict[str, Any]:
        """The memory before the first step from points ``u``, shape (chains, elements, size)."""
        chains, elements, size = u.shape
        mean = self._mean(np.where(np.isfinite(u), u, 0.0))
        if self.scale is None:
            var = np.square(self.wrapped(u - mean)).mean(axis=0)
            var = np.where((var > 0) & np.isfinite(var), var, 1.0)
            log_scale = math.log(self.base) + 0.5 * np.log(var).sum(axis=1) / max(size, 1)
        else:
            var = np.broadcast_to(np.square(self.scale), (elements, size))
            log_scale = 0.5 * np.log(var).sum(axis=1) / max(size, 1)
        cov = np.zeros((elements, size, size))
        cov[:, np.arange(size), np.arange(size)] = var
        return {
            "mean": mean,
            "cov": cov,
            "factor": _unit(np.sqrt(cov)),
            "log_scale": np.tile(log_scale, (chains, 1)),
            "average": log_scale,
            "count": 0,
        }

    def draw(
        self, memory: dict[str, Any], rng: np.random.Generator, chains: Any = slice(None)
    ) -> np.ndarray:
        """A step of every element of some chains, shape (chains, elements, size)."""
        log_scale, factor = memory["log_scale"][chains], memory["factor"]
        normal = rng.standard_normal((*log_scale.shape, self.size))
        if self.size == 1:
            step = normal
        elif len(factor) == 1:
            step = normal @ factor[0].T
        else:
            step = np.einsum("eij,cej->cei", factor, normal)
        return step * np.exp(log_scale)[..., None]

    def learnt(
        self,
        memory: dict[str, Any],
        u: np.ndarray,
        rates: np.ndarray,
        typical: np.ndarray | None = None,
    ) -> dict[str, Any]:
        """The memory after a sweep.

        Parameters
        ----------
        u : ndarray, shape (chains, elements, size)
            Where the chains are.
        rates : ndarray, shape (chains, elements)
            Chances with which their steps were accepted; NaN where there was no step.
        typical : ndarray of bool, shape (chains,), optional
            Chains that covariances are learnt from.
        """
        if not self.adaptive:
            return memory
        count = memory["count"] + 1
        # few chains in many dimensions need many sweeps before they tell a covariance
        ahead = 1.0 + 10.0 * self.size / len(u)
        gain = (count + ahead) ** -_DECAY
        mean, cov = memory["mean"], memory["cov"]
        kept = u if typical is None else u[typical]
        if np.isfinite(kept).all() and len(kept):
            mean = mean + gain * self.wrapped(self._mean(kept) - mean)
            away = self.wrapped(kept - mean)
            if self.size == 1:
                square = np.square(away).mean(axis=0)[..., None]
            else:
                square = np.einsum("cei,cej->eij", away, away, optimize=True) / len(away)
            fine = np.isfinite(square)
            cov = np.where(fine, cov + gain * (square - cov), cov)
        error = np.where(np.isnan(rates), 0.0, rates / self.rate - 1.0)
        log_scale = memory["log_scale"] + (count + 1.0) ** -SCALE_DECAY * error
        log_scale = np.minimum(log_scale, self._longest)
        average = memory["average"] + gain * (log_scale.mean(axis=0) - memory["average"])
        factor = memory["factor"]
        if count % _EVERY == 0:
            factor = self._factor(cov, factor)
        return {
            "mean": mean,
            "cov": cov,
            "factor": factor,
            "log_scale": log_scale,
            "average": average,
            "count": count,
        }

    def frozen(self, memory: dict[str, Any]) -> dict[str, Any]:
        """The memory at the end of the warmup: one scale for all chains."""
        if not self.adaptive or not memory["count"]:
            return memory
        log_scale = np.broadcast_to(memory["average"], memory["log_scale"].shape).copy()
        factor = self._factor(memory["cov"], memory["factor"])
        return {**memory, "log_scale": log_scale, "factor": factor}

    def wrapped(self, difference: np.ndarray) -> np.ndarray:
        """The same numbers ``(..., size)`` with angles, or their differences, in [-pi, pi)."""
        if self.angles is None:
            return difference
        return np.where(self.angles, wrap_angle(difference), difference)

    def _mean(self, u: np.ndarray) -> np.ndarray:
        """Mean over chains, circular for angles, shape (elements, size)."""
        mean = u.mean(axis=0)
        if self.angles is None:
            return mean
        turned = np.arctan2(np.sin(u).mean(axis=0), np.cos(u).mean(axis=0))
        return np.where(self.angles, turned, mean)

    def _factor(self, cov: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        """Cholesky factors of covariances, made positive definite, of determinant one."""
        if self.size == 1:
            return otherwise
        at = np.arange(self.size)
        loaded = cov.copy()
        diagonal = loaded[:, at, at]
        least = 1e-12 * diagonal.max(axis=-1, keepdims=True) + 1e-300
        loaded[:, at, at] = (1.0 + _LOADING) * diagonal + least
        try:
            return _unit(np.linalg.cholesky(loaded))
        except np.linalg.LinAlgError:  # rounding: keep what was there
            return otherwise


def _unit(factor: np.ndarray) -> np.ndarray:
    """Triangular factors scaled to determinant one."""
    diagonal = np.diagonal(factor, axis1=-2, axis2=-1)
    return (
        factor / np.exp(np.log(diagonal).sum(axis=-1) / max(diagonal.shape[-1], 1))[:, None, None]
    )


def chance(log_ratio: np.ndarray) -> np.ndarray:
    """Probability of accepting: ``min(1, exp(log_ratio))``, zero where it is NaN."""
    return np.exp(np.minimum(np.where(np.isnan(log_ratio), -np.inf, log_ratio), 0.0))
