"""What a map between a support and unconstrained numbers is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import ShapeError
from bayesmc.shapes import Shape


@dataclass(frozen=True, eq=False)
class Transform:
    """A map ``u -> x`` from unconstrained numbers to the values of a support.

    Made by ``transform_of``. Arrays have any leading axes, which broadcast with those of the bounds.

    Attributes
    ----------
    event_shape : tuple of int
        Shape of one value x.
    unconstrained_shape : tuple of int
        Shape of the numbers u behind one value.

    Notes
    -----
    ``constrain`` takes every finite u to a finite x, inside the open support as far as floating
    point can tell. ``unconstrain`` raises for no value: a bound that the open support excludes
    gives infinite or NaN numbers, a value beyond it NaN. ``formula`` and ``log_det_formula`` take what stands
    for an array, too, so that derivatives come of the same lines; bounds may be such stand-ins.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> logit = bmc.Beta(2.0, 3.0).transform
    >>> logit.constrain(0.0).tolist(), logit.unconstrain([0.5, 0.0, 2.0]).tolist()
    (0.5, [0.0, -inf, nan])
    """

    event_shape: Shape

    @property
    def unconstrained_shape(self) -> Shape:
        """Shape of the unconstrained numbers behind one value."""
        return self.event_shape

    @property
    def angles(self) -> np.ndarray:
        """Which unconstrained numbers are angles, the same again after a turn; their shape."""
        return np.zeros(self.unconstrained_shape, bool)

    def constrain(self, u: Any) -> np.ndarray:
        """The value at ``u``, shape ``(..., *event_shape)`` from ``(..., *unconstrained_shape)``."""
        with np.errstate(all="ignore"):
            at = _checked(self, u, self.unconstrained_shape)
            return np.asarray(self._kept_inside(self.formula(at)))

    def unconstrain(self, x: Any) -> np.ndarray:
        """The numbers behind ``x``, shape ``(..., *unconstrained_shape)``."""
        with np.errstate(all="ignore"):
            return np.asarray(self._unconstrain(_checked(self, x, self.event_shape)))

    def log_abs_det_jacobian(self, u: Any) -> np.ndarray:
        """``log |det dx/du|`` at ``u``, summed over the event.

        For dependent coordinates the volume is that of the first K - 1 components of a simplex and
        of the lower triangle of a symmetric matrix. The shape is the broadcast of the leading axes
        of ``u`` and of the bounds.
        """
        with np.errstate(all="ignore"):
            return np.asarray(self.log_det_formula(_checked(self, u, self.unconstrained_shape)))

    def formula(self, u: Any) -> Any:
        """The map alone, of an array or of what stands for one: far out it may round onto a bound."""
        raise NotImplementedError

    def log_det_formula(self, u: Any) -> Any:
        """The formula of ``log_abs_det_jacobian``, of an array or of what stands for one."""
        raise NotImplementedError

    def _kept_inside(self, x: np.ndarray) -> np.ndarray:
        """Values of the formula, those on a bound next to it."""
        return x

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _summed(self, terms: np.ndarray) -> np.ndarray:
        """``terms`` of single numbers, added over the event axes."""
        axes = tuple(range(terms.ndim - len(self.event_shape), terms.ndim))
        return terms.sum(axis=axes) if axes else terms


def _checked(transform: Transform, value: Any, shape: Shape) -> np.ndarray:
    value = np.asarray(value, dtype=float)
    cut = value.ndim - len(shape)
    if cut < 0 or value.shape[cut:] != shape:
        raise ShapeError(
            f"{type(transform).__name__}: the values have shape {value.shape}, not (..., *{shape})"
        )
    return value
