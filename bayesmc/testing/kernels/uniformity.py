"""Are ranks uniform? Pearson's chi-square of counts over equal cells, with its exact distribution.

The limiting law is wrong by a factor in the far tail, where a test with a small false-alarm rate looks; the
exact one is a convolution, and the Fourier transform does it. It knows nothing of kernels.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import scipy.special

#: p-values below this are reported as this: rounding errors of the transform stay under it
_SMALLEST = 1e-12
#: elements of the transform above which the chi-square limit is used (it takes a second, once; then the
#: limit is good, since there are thousands of counts)
_LARGEST = 2**25


def uniformity_p_value(counts: Any) -> float:
    """p-value of the hypothesis that all cells are equally likely, by Pearson's statistic.

    Exact: the chance that a multinomial sample is at least as uneven, found by a discrete Fourier transform
    of independent Poisson counts, given their sum. Above some thousand counts the chi-square limit is
    taken, which is then within a few per cent, even in the tail.

    Parameters
    ----------
    counts : array_like
        How often each cell was hit, shape ``(cells,)``.

    Returns
    -------
    float
        At least 1e-12, which stands for all that is smaller.

    Raises
    ------
    ValueError
        Counts that are not whole, nonnegative numbers in one row of at least two.

    References
    ----------
    Good, Gover and Mitchell (1970), Exact distributions for X^2 and for the likelihood-ratio statistic
    for the equiprobable multinomial distribution, JASA 65.

    Examples
    --------
    Two counts in two cells: half of the samples have both in one.

    >>> from bayesmc.testing import uniformity_p_value
    >>> round(uniformity_p_value([2, 0]), 12)
    0.5
    >>> uniformity_p_value([48, 0]) < 1e-11
    True
    """
    counts = np.asarray(counts)
    if counts.ndim != 1 or len(counts) < 2 or (counts < 0).any() or (counts % 1 != 0).any():
        raise ValueError(
            f"uniformity_p_value: counts are {counts!r}; give whole numbers, nonnegative, "
            "for at least two cells"
        )
    cells, total = len(counts), int(counts.sum())
    frequencies, length = _sizes(total, cells)
    if frequencies * length > _LARGEST:
        pearson = cells / total * float(((counts - total / cells) ** 2).sum())
        return max(float(scipy.special.chdtrc(cells - 1, pearson)), _SMALLEST)
    uneven = int(((counts.astype(int) - _centre(total, cells)) ** 2).sum())
    tail = _tail(total, cells)
    return float(tail[uneven]) if uneven < len(tail) else _SMALLEST


# ---- private ------------------------------------------------------------------------------------


def _centre(total: int, cells: int) -> int:
    """A whole number near the mean count; about it squares are small, which keeps the transform short."""
    return round(total / cells)


def _sizes(total: int, cells: int) -> tuple[int, int]:
    """Lengths of the transform for the sum of counts and for the sum of squares.

    What lies beyond is folded back, and must be rarer than `_SMALLEST`: sums ten standard deviations off,
    and squares beyond the chi-square tail of 1e-15 (Laurent and Massart 2000, lemma 1) with a supplement
    for one Poisson cell in its exponential tail; never more than the squares of a full cell.
    """
    mean, centre = total / cells, _centre(total, cells)
    chi_square = cells + 2.0 * np.sqrt(35.0 * cells) + 70.0
    bound = mean * chi_square + (np.sqrt(74.0 * mean) + 25.0) ** 2
    most = (total - centre) ** 2 + (cells - 1) * centre**2 + 1
    frequencies = 2 ** int(np.ceil(np.log2(10.0 * np.sqrt(total) + 64.0)))
    return frequencies, 2 ** int(np.ceil(np.log2(min(bound, most) + 1)))


@lru_cache(maxsize=32)
def _tail(total: int, cells: int) -> np.ndarray:
    """``tail[d]``: chance of a sum of squares about `_centre` of at least ``d``."""
    frequencies, length = _sizes(total, cells)
    mean, centre = max(total, 1) / cells, _centre(total, cells)
    reach = int(np.sqrt(length - 1))
    offsets = np.arange(-min(reach, centre), reach + 1)
    counts = offsets + centre
    mass = np.exp(counts * np.log(mean) - mean - scipy.special.gammaln(counts + 1.0))
    joint = np.zeros(length, dtype=complex)
    wanted = total - cells * centre
    # The sum over frequencies above the half gives the complex conjugate: twice the real part.
    for k in range(frequencies // 2 + 1):
        turn = 2j * np.pi * k / frequencies
        one = np.zeros(length, dtype=complex)
        np.add.at(one, offsets**2, mass * np.exp(turn * offsets))
        weight = 1.0 if k in (0, frequencies // 2) else 2.0
        joint += weight * np.exp(-turn * wanted) * _power(np.fft.fft(one), cells)
    density = np.maximum(np.fft.ifft(joint).real, 0.0)
    tail = np.cumsum(density[::-1])[::-1]
    tail = np.maximum(tail / tail[0], _SMALLEST)
    tail.flags.writeable = False
    return tail


def _power(base: np.ndarray, exponent: int) -> np.ndarray:
    """A whole power by squaring: NumPy's own goes through complex logarithms."""
    result = np.ones_like(base)
    while exponent:
        if exponent & 1:
            result = result * base
        base = base * base
        exponent >>= 1
    return result
