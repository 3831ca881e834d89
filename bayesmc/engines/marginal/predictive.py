"""Choices that only what is seen depends on: all are weighed, and the row is taken in with the one drawn.

Where finite nodes say which reading is of what, or which readings are outliers, the numbers that are
integrated out move alike whatever they say. So the slice is linearised once for each particle; a choice costs
the row's predictive density alone, which needs as many rows as numbers are seen, and the belief is updated
once, with the choice that was drawn. With many landmarks and one reading that is the difference between the
square of all their numbers, and that square for each of them.

References
----------
Chen and Liu (2000), Mixture Kalman filters, J. R. Statist. Soc. B 62, sec. 3; Särkkä and Svensson (2023),
Bayesian Filtering and Smoothing, 2nd ed., ch. 7 and sec. 12.2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.gaussians import Gaussians
from bayesmc.linalg.square_root import condition_many, log_densities, standardised

#: share of a variance that a row leaves of it, below which a difference of squares loses too much
_LITTLE = 1e-6
#: share of a seen number's deviation below which it may follow from those before it
_CERTAIN = 1e-11


class Expected(NamedTuple):
    """A slice and what is seen of it, by choice: means, and coefficients of independent standard normals.

    Attributes
    ----------
    mean : ndarray, shape (particles, n)
    rows : ndarray, shape (particles, n, k)
    seen : ndarray, shape (particles, choices, p)
    seen_rows : ndarray, shape (particles, choices, p, k + p)
        The last are noise of what is seen alone.
    """

    mean: np.ndarray
    rows: np.ndarray
    seen: np.ndarray
    seen_rows: np.ndarray


class Weighed(NamedTuple):
    """A row weighed by every choice, and what is needed to take it in.

    Attributes
    ----------
    layout : Layout
    found : Expected
    log : ndarray, shape (particles, choices)
        Log predictive densities of the row.
    basis : ndarray, shape (particles, choices, p, k + p)
        The normals that the row tells, standardised innovations, as combinations of all.
    gain : ndarray, shape (particles, choices, n, p)
        What unknown numbers gain from them.
    mean : ndarray, shape (particles, choices, n)
        Given the row.
    """

    layout: Layout
    found: Expected
    log: np.ndarray
    basis: np.ndarray
    gain: np.ndarray
    mean: np.ndarray

    def averaged(self, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances over choices, by their shares, shape (particles, choices)."""
        rows = self.found.rows
        whole = np.vecdot(rows, rows)[:, None]
        left = whole - np.vecdot(self.gain, self.gain)
        one, choice, number = np.nonzero(left < _LITTLE * whole)
        if len(one):  # from the normals that the row does not tell
            rest = -np.vecmat(self.gain[one, choice, number], self.basis[one, choice])
            rest[:, : rows.shape[-1]] += rows[one, number]
            left[one, choice, number] = np.vecdot(rest, rest)
        mean = np.einsum("ij,ijn->in", shares, self.mean)
        away = self.mean - mean[:, None]
        return mean, np.einsum("ij,ijn->in", shares, left + away * away)

    def chosen(self, choice: np.ndarray) -> Gaussians:
        """The row taken in with one choice for each particle, shape (particles,)."""
        every = np.arange(len(choice))
        seen, below = self.found.seen_rows[every, choice], self.found.rows
        p, k = seen.shape[-2], below.shape[-1]
        rows = np.zeros((len(choice), p + below.shape[-2], seen.shape[-1]))
        rows[:, :p], rows[:, p:, :k] = seen, below
        made = condition_many(rows, p)
        return Gaussians(self.layout, self.mean[every, choice], made.factor, None)


def weighed(layout: Layout, found: Expected, row: np.ndarray) -> Weighed | None:
    """The row's predictive density by every choice; None where some of it may follow from the rest of it.

    Parameters
    ----------
    layout : Layout
        Without plates apart.
    row : ndarray, shape (p,)
        Seen in full.
    """
    made = _orthonormal(found.seen_rows)
    if made is None:
        return None
    basis, root = made
    off = row - found.seen
    if layout.angles is not None:
        off = np.where(layout.angles[: layout.p], wrap_angle(off), off)
    eta = standardised(root, off)
    gain = found.rows[:, None] @ basis[..., : found.rows.shape[-1]].swapaxes(-1, -2)
    mean = found.mean[:, None] + np.matvec(gain, eta)
    return Weighed(layout, found, log_densities(root, eta), basis, gain, mean)


# ---- private ------------------------------------------------------------------------------------


def _orthonormal(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows as ``root @ basis``: a lower triangle, and orthonormal rows; None where some may be combinations.

    By Gram and Schmidt, twice for each row, which is as good as reflections (Giraud, Langou, Rozloznik and
    van den Eshof 2005, Numerische Mathematik 101), and few operations on large arrays where p is small.
    """
    p = rows.shape[-2]
    basis, root = rows.copy(), np.zeros((*rows.shape[:-1], p))
    for i in range(p):
        own, before = basis[..., i, :], basis[..., :i, :]
        size = np.sqrt(np.vecdot(own, own))
        for _ in range(2 if i else 0):
            part = np.matvec(before, own)
            own -= np.vecmat(part, before)
            root[..., i, :i] += part
        left = np.sqrt(np.vecdot(own, own))
        if not (left > _CERTAIN * size).all():
            return None
        root[..., i, i] = left
        own /= left[..., None]
    return basis, root
