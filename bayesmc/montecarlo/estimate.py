"""An estimate with its Monte Carlo error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc.errors import ParameterError


@dataclass(frozen=True, eq=False)
class Estimate:
    """A Monte Carlo estimate of a number or an array, and how far it can be trusted.

    Attributes
    ----------
    value : ndarray
        The estimate, shape ``()`` for a number.
    standard_error : ndarray
        Its standard error, of the same shape and in the same unit.
    draws : int
        How many draws it rests on.

    References
    ----------
    Robert and Casella, Monte Carlo Statistical Methods, 2nd ed., 2004, section 3.2.

    Examples
    --------
    >>> from bayesmc.montecarlo import Estimate
    >>> estimate = Estimate(3.1, 0.05, 1000)
    >>> estimate, float(estimate)
    (Estimate(3.1 +- 0.05, 1,000 draws), 3.1)
    >>> [round(float(bound), 3) for bound in estimate.interval(0.95)]
    [3.002, 3.198]
    """

    value: Any
    standard_error: Any
    draws: int

    def __post_init__(self) -> None:
        for name in ("value", "standard_error"):
            array = np.array(getattr(self, name), dtype=float)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Bounds that hold the truth with probability ``level``, by the central limit theorem.

        Parameters
        ----------
        level : float
            Between 0 and 1, both excluded.
        """
        if not 0 < level < 1:
            raise ParameterError(f"interval(level={level!r}): level must lie between 0 and 1")
        reach = special.ndtri(0.5 + 0.5 * level) * self.standard_error
        return self.value - reach, self.value + reach

    def __float__(self) -> float:
        if self.value.ndim:
            raise TypeError(
                f"float(Estimate): the estimate has shape {self.value.shape}; use its .value"
            )
        return float(self.value)

    def __repr__(self) -> str:
        draws = f"{self.draws:,} draws"
        if self.value.ndim:
            worst = self.standard_error.max(initial=0.0)
            return f"Estimate(shape {self.value.shape}, errors up to {worst:.2g}, {draws})"
        return f"Estimate({_digits(self.value, self.standard_error)}, {draws})"


def _digits(value: Any, error: Any) -> str:
    """A value with as many digits as its error leaves, and the error."""
    value, error = float(value), float(error)
    if not (np.isfinite(value) and np.isfinite(error)) or error <= 0 or value == 0:
        return f"{value:.6g} +- {error:.2g}"
    digits = int(np.clip(np.ceil(np.log10(abs(value) / error)) + 2, 2, 15))
    return f"{value:.{digits}g} +- {error:.2g}"
