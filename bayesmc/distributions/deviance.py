"""Probabilities of large counts without the cancellation of their log factorials.

A log probability of counts is a sum of log factorials and powers that are far larger than itself:
at counts of 10^8 half the digits are lost. Written with what remains of each factorial beyond
Stirling's leading terms, and with deviances of counts from their expectations, every part is small.

References
----------
Loader, Fast and accurate computation of binomial probabilities, 2000.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special


def by_size(
    large: np.ndarray,
    small_formula: Callable[..., np.ndarray],
    large_formula: Callable[..., np.ndarray],
    *arguments: Any,
) -> np.ndarray:
    """The formula for each element's size; neither is evaluated where no element needs it."""
    if not large.any():
        return small_formula(*arguments)
    if large.all():
        return large_formula(*arguments)
    return np.where(large, large_formula(*arguments), small_formula(*arguments))


def stirling_rest(x: np.ndarray) -> np.ndarray:
    """``log Gamma(x + 1) - (x log(x) - x)``, whose large terms would cancel."""
    return by_size(x > 100, _stirling_direct, _stirling_series, x)


def _stirling_direct(x: np.ndarray) -> np.ndarray:
    return special.gammaln(x + 1) - special.xlogy(x, x) + x


def _stirling_series(x: np.ndarray) -> np.ndarray:
    inverse = 1 / np.maximum(x, 1.0)
    square = inverse * inverse
    series = (1 / 12 - square * (1 / 360 - square / 1260)) * inverse
    return series - 0.5 * np.log(inverse / (2 * np.pi))


def deviance(count: np.ndarray, expected: np.ndarray, log_expected: np.ndarray) -> np.ndarray:
    """``count log(count / expected) - count + expected``, without cancellation (Loader's bd0)."""
    excess = count - expected
    ratio = excess / (count + expected)
    far = ~(np.abs(ratio) < 0.1)
    return by_size(far, _near_deviance, _far_deviance, count, log_expected, excess, ratio)


def _near_deviance(count: Any, log_expected: Any, excess: Any, ratio: Any) -> np.ndarray:
    # log((1 + ratio) / (1 - ratio)) by its series, whose first term is the excess
    square = ratio * ratio
    series = square / 15
    for odd in (13, 11, 9, 7, 5, 3):
        series += 1 / odd
        series *= square
    return ratio * (excess + 2 * count * series)


def _far_deviance(count: Any, log_expected: Any, excess: Any, ratio: Any) -> np.ndarray:
    return np.where(count > 0, count * (np.log(count) - log_expected), 0.0) - excess
