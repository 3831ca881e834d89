"""What was drawn from a child, as conjugate kernels need it: how many, their total, squares about a mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from bayesmc.gaussian import solve_lower

#: what a pair may ask of the values before anything else
TRANSFORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "value": lambda z: np.asarray(z, dtype=float),
    "log": np.log,
    "reciprocal": np.reciprocal,
}


class Sums(Protocol):
    """How elements of a child are summed for elements of a node (``conjugate_sums``)."""

    def sum(self, array: np.ndarray, event_ndim: int = 0) -> np.ndarray: ...

    def outer(self, rows: np.ndarray) -> np.ndarray: ...


class Elements:
    """Values of a child one by one, those that are not seen left out.

    Attributes
    ----------
    count : ndarray
        1 for every element that counts, else 0; broadcasts to ``(1, *plates)``.
    """

    def __init__(self, value: np.ndarray, mask: np.ndarray | None, event_ndim: int) -> None:
        self.event_ndim = event_ndim
        self.value = value
        self.count = np.ones((1,) * (value.ndim - event_ndim))
        self.mask = mask
        if mask is not None:
            self.count = mask.astype(float)[None]
            self.value = np.where(mask.reshape(mask.shape + (1,) * event_ndim), value, 0.0)

    @property
    def total(self) -> np.ndarray:
        """Sum of the values."""
        return self.value

    def deviations(self, loc: np.ndarray) -> np.ndarray:
        """Sum of the values less ``loc``, shape with the event."""
        return self._counted(self.value - loc)

    def squares(self, loc: np.ndarray) -> np.ndarray:
        """Sum of squares about ``loc``."""
        return self._counted((self.value - loc) ** 2)

    def mahalanobis(self, loc: np.ndarray, tril: np.ndarray) -> np.ndarray:
        """Sum of squared Mahalanobis distances from ``loc``."""
        z = solve_lower(tril, self.value - loc)
        return np.vecdot(z, z) * self.count

    def scatter(self, loc: np.ndarray, spread: np.ndarray, into: Sums) -> np.ndarray:
        """Scatter matrices about ``loc``, each over its ``spread``, summed for every element of a node."""
        return into.outer((self.deviations(loc) / np.sqrt(spread)[..., None])[..., None, :])

    def _counted(self, array: np.ndarray) -> np.ndarray:
        if self.mask is None:
            return array
        return array * self.count.reshape(self.count.shape + (1,) * self.event_ndim)
