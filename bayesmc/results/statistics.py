"""Variances and quantiles of tables, and on circles."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions.circular import wrap_angle


def table_variance(table: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Variances of numbers under tables of probabilities, shape ``table.shape[:-1]``."""
    centred = numbers - (table @ numbers)[..., None]
    return (table * centred**2).sum(axis=-1)


def table_quantile(table: np.ndarray, numbers: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Quantiles of numbers under tables of probabilities, shape ``(*levels.shape, *table.shape[:-1])``."""
    order = np.argsort(numbers)
    below = np.cumsum(table[..., order], axis=-1)
    reach = below >= levels.reshape(levels.shape + (1,) * below.ndim) - 1e-12
    return numbers[order][np.argmax(reach, axis=-1)]


def near(angles: np.ndarray, mean: Any) -> np.ndarray:
    """Angles within half a turn of their mean: what needs an order needs a cut, best opposite the mean."""
    return mean + wrap_angle(angles - mean)


def circular_variance(cosine: Any, sine: Any) -> np.ndarray:
    """Square of the circular standard deviation, from mean cosine and sine (Mardia and Jupp 2000, 2.3)."""
    with np.errstate(divide="ignore"):
        return -np.log(np.minimum(np.asarray(cosine) ** 2 + np.asarray(sine) ** 2, 1.0))
