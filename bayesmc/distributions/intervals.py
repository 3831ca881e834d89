"""Formulas that take free numbers to intervals and back, of arrays or of what stands for them.

They are those of the Stan Reference Manual (version 2.36, chapter "Constraint Transforms").
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special


def is_finite(bound: Any) -> np.ndarray:
    """Whether bounds are finite; what stands for an array is."""
    if isinstance(bound, (np.ndarray, float)):
        return np.isfinite(bound)
    return np.ones(np.shape(bound), dtype=bool)


# ---- private ------------------------------------------------------------------------------------


def _free(value: Any, low: Any, high: Any) -> Any:
    return +value


def _above(u: Any, low: Any, high: Any) -> Any:
    return low + np.exp(u)


def _above_inverse(x: Any, low: Any, high: Any) -> Any:
    return np.log(x - low)


def _exp_log_det(u: Any, low: Any, high: Any) -> Any:
    return +u


def _below(u: Any, low: Any, high: Any) -> Any:
    return high - np.exp(u)


def _below_inverse(x: Any, low: Any, high: Any) -> Any:
    return np.log(high - x)


def _between(u: Any, low: Any, high: Any) -> Any:
    # an average rather than low + (high - low) z: next to a bound of zero it keeps its digits
    return low * _share(-u) + high * _share(u)


def _share(u: Any) -> Any:
    """``expit(u)`` down to the smallest double; SciPy's is zero from -709 on."""
    share = special.expit(u)
    if not isinstance(share, (np.ndarray, float)):
        return share  # of what stands for an array
    far = np.asarray(u) < -700.0
    return np.where(far, np.exp(np.minimum(u, 0.0)), share) if far.any() else share


def _between_inverse(x: Any, low: Any, high: Any) -> Any:
    return np.log(x - low) - np.log(high - x)


def _between_log_det(u: Any, low: Any, high: Any) -> Any:
    width = np.log(0.5 * high - 0.5 * low) + math.log(2.0)  # high - low itself may overflow
    return width + special.log_expit(u) + special.log_expit(-u)


def _no_log_det(u: Any, low: Any, high: Any) -> Any:
    return np.zeros_like(u)


#: formulas for no bound, a lower one, an upper one, both
PIECES: dict[str, tuple[Callable[..., Any], ...]] = {
    "constrain": (_free, _above, _below, _between),
    "unconstrain": (_free, _above_inverse, _below_inverse, _between_inverse),
    "log_det": (_no_log_det, _exp_log_det, _exp_log_det, _between_log_det),
}
