"""Beliefs between the points of a grid: cells of one number cut into finer ones, for functions that jump.

Sums over cells are as good as exact for what is smooth, and cells need be no narrower than the belief wants;
an event that begins within a cell needs the density there. Belief and function are put on finer points: by
trigonometric interpolation where the belief ends before the grid does (or comes round), by splines elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bayesmc.engines.grid.axes import Axis
from bayesmc.engines.grid.slice import Scalar

#: finer cells of a number at least, and of one cell
_CELLS, _PARTS = 1024, 8
#: share of the highest cell up to which a belief has ended at the last one
_ENDED = 1e-5


class Fine(NamedTuple):
    """A belief about a number on finer cells.

    Attributes
    ----------
    points : ndarray, shape (J,)
        Even ones, in the coordinate of the axis.
    masses : ndarray, shape (J, ...)
        Their probabilities; the axes of ``shares`` behind.
    number : callable
        From the coordinate to the number.
    """

    points: np.ndarray
    masses: np.ndarray
    number: Callable[[np.ndarray], np.ndarray]


def refined(axis: Axis, scalar: Scalar, shares: np.ndarray) -> Fine | None:
    """Probabilities of cells, shape (n, ...), on finer ones; None where cells are not even.

    ``shares`` are of a scalar that is nowhere seen.
    """
    lattice = axis.lattice
    if lattice is None or scalar.size != axis.size or scalar.size < 4:
        return None
    parts = max(_PARTS, math.ceil(_CELLS / axis.size))
    step = lattice.step / parts
    points = lattice.low + step * (np.arange(parts * axis.size) + 0.5)
    ends = np.abs(shares[[0, -1]]).max(axis=0)
    if lattice.comes_round or np.all(ends <= _ENDED * shares.max(axis=0)):
        masses = _trigonometric(shares, parts)
    else:
        masses = _splines(shares, parts)
    masses = np.clip(masses, 0.0, None)
    total, was = masses.sum(axis=0), shares.sum(axis=0)
    masses = masses * np.divide(was, total, out=np.zeros(np.shape(total)), where=total > 0)
    return Fine(points, masses, lattice.line.number)


def quantiles(fine: Fine, levels: np.ndarray) -> np.ndarray:
    """Numbers below which so much lies, shape (*levels.shape, ...)."""
    step = fine.points[1] - fine.points[0]
    edges = np.concatenate([[fine.points[0] - step / 2], fine.points + step / 2])
    flat = fine.masses.reshape(len(fine.points), -1)
    below = np.concatenate([np.zeros((1, flat.shape[1])), np.cumsum(flat, axis=0)])
    below = below / below[-1]
    found = [np.interp(levels.ravel(), below[:, k], edges) for k in range(flat.shape[1])]
    at = np.stack(found, axis=-1).reshape((*levels.shape, *fine.masses.shape[1:]))
    return np.asarray(fine.number(at))


def cell_quantiles(
    points: np.ndarray, shares: np.ndarray, levels: np.ndarray, isolated: bool
) -> np.ndarray:
    """The same on any cells, shape (n, ...): linear within cells that end halfway between points.

    Of ``isolated`` values the least below or at which so much lies.
    """
    n = len(shares)
    share = shares.reshape(n, -1)
    where = np.broadcast_to(points, shares.shape).reshape(n, -1).astype(float)
    found = np.empty((levels.size, share.shape[1]))
    for k, (mass, x) in enumerate(zip(share.T, where.T, strict=True)):
        below = np.cumsum(mass) / mass.sum()
        if isolated or np.count_nonzero(mass) == 1:
            # rounding of the sum must not carry a level to the next value
            at = np.searchsorted(below, levels.ravel() * (1 - 1e-12))
            found[:, k] = x[np.clip(at, np.flatnonzero(mass)[0], np.flatnonzero(mass)[-1])]
            continue
        halves = (x[1:] + x[:-1]) / 2
        edges = np.concatenate([[2 * x[0] - halves[0]], halves, [2 * x[-1] - halves[-1]]])
        found[:, k] = np.interp(levels.ravel(), np.concatenate([[0.0], below]), edges)
    return found.reshape((*levels.shape, *shares.shape[1:]))


# ---- private ------------------------------------------------------------------------------------


def _trigonometric(shares: np.ndarray, parts: int) -> np.ndarray:
    n = len(shares)
    waves = np.fft.rfft(shares, axis=0)
    turn = np.exp(2j * np.pi * np.arange(len(waves)) * (0.5 / parts - 0.5) / n)
    waves = waves * turn.reshape(-1, *(1,) * (shares.ndim - 1))
    return np.fft.irfft(waves, n * parts, axis=0)


def _splines(shares: np.ndarray, parts: int) -> np.ndarray:
    from scipy.interpolate import CubicSpline

    n = len(shares)
    fine = (np.arange(n * parts) + 0.5) / parts - 0.5
    return np.asarray(CubicSpline(np.arange(n), shares, axis=0)(fine)) / parts
