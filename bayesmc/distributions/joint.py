"""Independent parts laid side by side as one vector."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.base import Distribution
from bayesmc.distributions.support import Support, product, real_vector
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError
from bayesmc.shapes import Shape


class Joint(Distribution):
    """One vector whose parts are independent: a number takes one component, a vector its own.

    Parameters
    ----------
    *parts : Distribution or frozen scipy.stats distribution
        Continuous, of numbers or vectors, in the order of the components; or one list of them.
        Their batch shapes broadcast.

    Raises
    ------
    ParameterError
        No parts, or one that is no distribution.
    UnsupportedError
        A part is discrete, has matrices as values, or lies on a circle.

    References
    ----------
    Koller and Friedman, Probabilistic Graphical Models, 2009, section 2.1.4 (independence).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> pose = bmc.Joint(bmc.MvNormal([0.0, 1.0], [[1.0, 0.5], [0.5, 1.0]]), bmc.Gamma(2.0, 1.0))
    >>> pose.event_shape, pose.mean.tolist(), float(pose.log_prob([0.0, 1.0, 1.0]).round(4))
    ((3,), [0.0, 1.0, 2.0], -2.694)
    """

    splits = True
    #: the arguments are the parts, in order, and there is nothing else: each class says so for itself
    parts_as_given = True

    def __init__(self, *parts: Any) -> None:
        self.parts = tuple(_usable(part) for part in _listed(parts))
        self._sizes = tuple(part.event_shape[0] if part.event_shape else 0 for part in self.parts)
        self.event_shape = (sum(max(size, 1) for size in self._sizes),)
        self._set_batch(*(part.batch_shape for part in self.parts))
        for part in self.parts:
            self._adopt(part)

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [pair for part in self.parts for pair in part.parameters()]

    def log_prob_of(self, x: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Log density of some components by themselves, as ``MvNormal.log_prob_of``.

        Raises
        ------
        UnsupportedError
            A part that has no marginals is present in part.
        """
        total: Any = np.zeros(np.broadcast_shapes(x.shape[:-1], self.batch_shape))
        for part, where in self._places():
            if present[where].all():
                total = total + part.log_prob_unchecked(x[..., where])
            elif present[where].any():
                total = total + part.log_prob_of(x[..., where], present[where])
        return total

    def completed(
        self, rng: np.random.Generator, shape: Shape, x: np.ndarray, present: np.ndarray
    ) -> np.ndarray:
        """Draws of the components that are not there given those that are, as ``MvNormal.completed``."""
        draws = self.sample_to(rng, shape)
        part: Any
        for part, where in self._places():
            here = present[where]
            if here.any() and not here.all():
                draws[..., where] = part.completed(rng, shape, x[..., where], here)
        return np.where(present, x, draws)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.empty(shape + self.event_shape)
        for part, where in self._places():
            draws[..., where] = part.sample_to(rng, shape)
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != self.event_shape:
            raise ShapeError(f"Joint: x has shape {x.shape}, not (..., *{self.event_shape})")
        terms = np.broadcast_arrays(
            *(part.log_prob(x[..., where]) for part, where in self._places())
        )
        impossible = np.any([term == -np.inf for term in terms], axis=0)
        # a part that cannot be makes the whole impossible, also where another density is infinite
        return np.where(impossible, -np.inf, sum(np.where(impossible, 0.0, term) for term in terms))

    @property
    def mean(self) -> np.ndarray:
        return self._lay("mean")

    @property
    def var(self) -> np.ndarray:
        return self._lay("var")

    @property
    def cov(self) -> np.ndarray:
        """Covariance matrix, shape ``(*batch, d, d)``: blocks of the parts, zero between them."""
        d = self.event_shape[0]
        result = np.zeros((*self.batch_shape, d, d))
        for part, where in self._places():
            if not isinstance(where, slice):
                result[..., where, where] = part.var
                continue
            block = getattr(part, "cov", None)
            if block is None:
                raise UnsupportedError(f"Joint: {type(part).__name__} has no closed covariance")
            result[..., where, where] = block() if callable(block) else block
        return result

    @property
    def support(self) -> Support:
        supports = [part.support for part in self.parts]
        if all(support.kind in ("real", "real vector") for support in supports):
            return real_vector
        pairs: list[tuple[Support, int]] = []
        for support, size in zip(supports, self._sizes, strict=True):
            pairs += support.parts or [(support, size)]
        return product(pairs)

    def _places(self) -> Iterator[tuple[Distribution, Any]]:
        """Each part with its component, or the slice of its components."""
        start = 0
        for part, size in zip(self.parts, self._sizes, strict=True):
            yield part, slice(start, start + size) if size else start
            start += max(size, 1)

    def _lay(self, moment: str) -> np.ndarray:
        result = np.empty(self.batch_shape + self.event_shape)
        for part, where in self._places():
            result[..., where] = getattr(part, moment)
        return result


def _listed(parts: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(parts) == 1 and isinstance(parts[0], (list, tuple)):
        parts = tuple(parts[0])
    if not parts:
        raise ParameterError(
            "Joint: give the parts, as in Joint(Normal(0.0, 1.0), Gamma(2.0, 1.0))"
        )
    return parts


def _usable(part: Any) -> Distribution:
    dist = as_distribution(part)
    if dist is None:
        raise ParameterError(f"Joint: a part must be a distribution; got {type(part).__name__}")
    family = type(dist).__name__
    if dist.is_discrete:
        raise UnsupportedError(
            f"Joint: {family} is discrete and cannot be a component of a real vector; give it a node "
            "of its own"
        )
    if len(dist.event_shape) > 1:
        raise UnsupportedError(
            f"Joint: {family} has values of shape {dist.event_shape}; only numbers and vectors can be "
            "laid side by side"
        )
    if dist.support.kind == "circle":
        raise UnsupportedError(
            f"Joint: {family} is an angle, which a vector would not know to be circular; give it a "
            "node of its own"
        )
    return dist
