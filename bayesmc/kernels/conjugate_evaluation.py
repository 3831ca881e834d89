"""A child evaluated with its node at a neutral value: parameters, data, and how both are summed."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.gaussian import solve_lower
from bayesmc.kernels.conjugate_data import Elements
from bayesmc.kernels.conjugate_sums import Collector

#: Cholesky factors up to which inverting them one by one is faster than substituting in all at once
_FEW = 64


class Evaluated:
    """A child's distribution with the node at its neutral value.

    Parameters
    ----------
    dist : Distribution
    steps : bool
        Whether its first axis runs through the neutral value and steps away from it.
    plates : int
        Number of the child's plates.
    data : Elements
    collector : Collector
    """

    def __init__(
        self, dist: Any, steps: bool, plates: int, data: Elements, collector: Collector
    ) -> None:
        self.dist, self.steps, self.plates = dist, steps, plates
        self.data, self.collector = data, collector
        self.lost: np.ndarray | None = None
        if dist.invalid is not None:  # where a coefficient overflowed, there is no closed form
            self.lost = padded(dist.invalid, steps + 1 + plates) & (data.count > 0)
        self._inverse: np.ndarray | None = None

    def get(self, parameter: str, event_ndim: int = 0) -> np.ndarray:
        """A parameter with axes for chains and plates."""
        array = self.at_points(parameter, event_ndim)
        return array[0] if self.steps else array

    def at_points(self, parameter: str, event_ndim: int = 0) -> np.ndarray:
        """A parameter at the neutral value and all steps, if there are any."""
        array = padded(getattr(self.dist, parameter), self.steps + 1 + self.plates + event_ndim)
        if self.lost is not None:
            lost = self.lost.reshape(self.lost.shape + (1,) * event_ndim)
            array = np.where(lost, np.nan, array)
        return array

    def whitened(self, residual: np.ndarray) -> np.ndarray:
        """Residuals of vectors divided by the Cholesky factor, which is inverted once where there are few."""
        if self._inverse is None:
            tril = self.get("scale_tril", 2)
            if tril.size > _FEW * tril.shape[-1] ** 2:
                return solve_lower(tril, residual)
            # of an upper triangle: back substitution, nothing is pivoted
            self._inverse = np.linalg.inv(np.matrix_transpose(tril))
        return np.vecmat(residual, self._inverse)

    def slope(self, steps: np.ndarray) -> np.ndarray:
        """Slopes of the mean in every component, see ``slope_of``."""
        return slope_of(self.dist, self.plates, steps)

    def sum(self, array: np.ndarray, event_ndim: int = 0) -> np.ndarray:
        return self.collector.sum(np.asarray(array, dtype=float), event_ndim)

    def outer(self, rows: np.ndarray) -> np.ndarray:
        return self.collector.outer(rows)

    def tally(self, states: int) -> np.ndarray:
        return self.collector.tally(self.data.value, states, self.data.mask)


def slope_of(dist: Any, plates: int, steps: np.ndarray) -> np.ndarray:
    """Slopes of a mean in every component, shape ``(components, lead, *plates, ...)``.

    ``dist`` was evaluated at zero and one step along each component.
    """
    loc = padded(dist.loc, 2 + plates + len(dist.event_shape))
    if len(loc) == 1:  # it does not vary after all
        return np.zeros((len(steps), *loc.shape[1:]))
    return (loc[1:] - loc[:1]) / steps.reshape((-1,) + (1,) * (loc.ndim - 1))


def padded(array: Any, ndim: int) -> np.ndarray:
    """An array with axes of size one in front, so that it has at least ``ndim``."""
    array = np.asarray(array)
    return array.reshape((1,) * (ndim - array.ndim) + array.shape) if array.ndim < ndim else array
