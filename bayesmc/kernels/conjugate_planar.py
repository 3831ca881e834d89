"""Components of mixtures in the plane, in Python's floats: where these are few.

Means and covariances of a few pairs of numbers are some hundred multiplications, and calls of NumPy
would cost several times as much. Formulas and random numbers are those of ``conjugate_kinds``, so that
both ways give the same draws up to rounding. Nothing here evaluates a model: everything starts from sums
by label, ``n, x, y, xx, xy, yy`` of every component about one centre.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from bayesmc.distributions.wishart import gram

#: components of all chains together, up to which floats are faster than arrays
FEW = 24
#: squared sine of an angle between rows, below which a product may be singular to rounding
_CLOSE = 1e-6
#: a chi-square variate is at least this, as in ``distributions.wishart``
_LEAST = 1e-280

Pair = Sequence[float]
#: elements 00, 10 and 11 of a precision, and half its log determinant
Entry = tuple[float, float, float, float]


def planar_covariances(
    df: float,
    scale: Sequence[Pair],
    sums: list[list[float]],
    offs: Sequence[Pair],
    rng: np.random.Generator,
) -> tuple[list[list[list[float]]] | np.ndarray, list[Entry] | None] | None:
    """Draws of inverse-Wishart covariances.

    Parameters
    ----------
    df, scale
        Of the prior, the same for all.
    sums, offs
        By component: its sums, and its mean from their centre.

    Returns
    -------
    tuple or None
        Covariances, (components, 2, 2), and their precisions (None where rounding spoils these). None,
        before anything was drawn, where a scale matrix is singular to rounding.
    """
    roots = []
    try:
        for (n, x, y, xx, xy, yy), (a, b) in zip(sums, offs, strict=True):
            r00 = math.sqrt(scale[0][0] + xx - a * (2.0 * x - n * a))
            r10 = (scale[1][0] + xy - a * y - b * x + n * a * b) / r00
            r11 = math.sqrt(scale[1][1] + yy - b * (2.0 * y - n * b) - r10 * r10)
            if not r11 > 0.0:
                return None
            roots.append((r00, r10, r11))
    except (ValueError, ZeroDivisionError):
        return None
    drawn, entries, factors, exact = [], [], [], True
    normals, gamma = rng.standard_normal(len(sums)).tolist(), rng.standard_gamma
    for (r00, r10, r11), b10, row in zip(roots, normals, sums, strict=True):
        half = 0.5 * (df + row[0])
        b00 = math.sqrt(max(2.0 * gamma(half - 0.5), _LEAST))
        b11 = math.sqrt(max(2.0 * gamma(half), _LEAST))
        m00, m11 = r00 / b00, r11 / b11  # the draw's factor is the root over Bartlett's triangle
        m10 = (r10 - m11 * b10) / b00
        square, cross = m10 * m10 + m11 * m11, m00 * m10
        exact = exact and m11 * m11 >= _CLOSE * square
        drawn.append([[m00 * m00, cross], [cross, square]])
        factors.append([[m00, 0.0], [m10, m11]])
        w00, w11 = b00 / r00, b11 / r11  # and its inverse the other way round
        w10 = (b10 - w11 * r10) / r00
        entries.append((w00 * w00 + w10 * w10, w10 * w11, w11 * w11, math.log(w00 * w11)))
    if exact:
        return drawn, entries
    return gram(np.array(factors))[0], None


def planar_means(
    prior: Iterable[Pair],
    linear: Iterable[Pair],
    sums: list[list[float]],
    centre: Pair,
    entries: Sequence[Entry],
    rng: np.random.Generator,
) -> list[list[float]]:
    """Draws of means, (components, 2).

    Parameters
    ----------
    prior, linear
        By component: elements 00, 10, 11 of the prior's precision; that times its mean.
    entries
        By component: precision of the noise.
    """
    means = []
    noise = iter(rng.standard_normal(2 * len(sums)).tolist())
    cx, cy = centre
    for row, (p00, p10, p11, _), (q00, q10, q11), (h0, h1) in zip(
        sums, entries, prior, linear, strict=True
    ):
        n = row[0]
        x, y = row[1] + n * cx, row[2] + n * cy
        r00 = math.sqrt(q00 + n * p00)
        r10 = (q10 + n * p10) / r00
        r11 = math.sqrt(q11 + n * p11 - r10 * r10)
        z0 = (h0 + p00 * x + p10 * y) / r00  # forwards: where the noise comes in it is white
        z1 = (h1 + p10 * x + p11 * y - r10 * z0) / r11
        m0 = z0 + next(noise)
        m1 = (z1 + next(noise)) / r11  # and backwards
        means.append([(m0 - r10 * m1) / r00, m1])
    return means


def planar_coefficients(entries: Sequence[Entry], offs: Sequence[Pair]) -> list[list[float]]:
    """Coefficients of ``1, x, y, xx, xy, yy`` in the log density of every component."""
    found = []
    for (p00, p10, p11, half), (a, b) in zip(entries, offs, strict=True):
        h0, h1 = p00 * a + p10 * b, p10 * a + p11 * b
        found.append([half - 0.5 * (h0 * a + h1 * b), h0, h1, -0.5 * p00, -p10, -0.5 * p11])
    return found
