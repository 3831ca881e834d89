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
from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.gaussians import Gaussians
from bayesmc.gaussian import solve_lower
from bayesmc.linalg.square_root import condition_many, log_densities, standardised

#: share of a variance that is left of it by a row below which a difference of squares loses too much
_CLEAR = 1e-6


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
    kept : ndarray of int, shape (n,)
        The order in which unknown numbers are worked out.
    found : Expected
    log : ndarray, shape (particles, choices)
        Log predictive densities of the row.
    gain : ndarray, shape (particles, choices, n, p)
        What unknown numbers gain from standardised innovations.
    root : ndarray, shape (particles, choices, p, p)
        Of the innovations' covariance.
    mean : ndarray, shape (particles, choices, n)
        Given the row.
    """

    layout: Layout
    kept: np.ndarray
    found: Expected
    log: np.ndarray
    gain: np.ndarray
    root: np.ndarray
    mean: np.ndarray

    def averaged(self, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances over choices, by their shares, shape (particles, choices)."""
        rows = self.found.rows[:, self.kept]
        whole = np.vecdot(rows, rows)[:, None]
        left = whole - np.vecdot(self.gain, self.gain)
        one, choice, number = np.nonzero(left < _CLEAR * whole)
        if len(one):  # by what of the noise the row does not tell
            basis = solve_lower(
                self.root[one, choice][:, None],
                self.found.seen_rows[one, choice].swapaxes(-1, -2),
            ).swapaxes(-1, -2)
            rest = -np.vecmat(self.gain[one, choice, number], basis)
            rest[:, : rows.shape[-1]] += rows[one, number]
            left[one, choice, number] = np.vecdot(rest, rest)
        mean = np.einsum("ij,ijn->in", shares, self.mean)
        away = self.mean - mean[:, None]
        return mean, np.einsum("ij,ijn->in", shares, left + away * away)

    def chosen(self, choice: np.ndarray) -> Gaussians:
        """The row taken in with one choice for each particle, shape (particles,)."""
        every, p = np.arange(len(choice)), self.root.shape[-1]
        seen = self.found.seen_rows[every, choice]
        rows = np.zeros((len(choice), p + len(self.kept), seen.shape[-1]))
        rows[:, :p], rows[:, p:, : self.found.rows.shape[-1]] = seen, self.found.rows[:, self.kept]
        made = condition_many(rows, p)
        return Gaussians(self.layout, self.mean[every, choice], made.factor, None)


def weighed(layout: Layout, pattern: Pattern, found: Expected, row: np.ndarray) -> Weighed | None:
    """The row's predictive density by every choice; None where some of it is certain given the rest of it.

    Parameters
    ----------
    layout : Layout
        Without plates apart.
    pattern : Pattern
        Of a row that is seen in full.
    row : ndarray, shape (p,)
    """
    p, kept = layout.p, pattern.kept - layout.p
    made = condition_many(found.seen_rows, p)
    if made.certain is not None:
        return None
    off = row - found.seen
    if layout.angles is not None:
        off = np.where(layout.angles[:p], wrap_angle(off), off)
    eta = standardised(made.root, off)
    rows = found.rows[:, kept]
    cross = rows[:, None] @ found.seen_rows[..., : rows.shape[-1]].swapaxes(-1, -2)
    gain = solve_lower(made.root[:, :, None], cross)
    mean = found.mean[:, None, kept] + np.matvec(gain, eta)
    return Weighed(layout, kept, found, log_densities(made.root, eta), gain, made.root, mean)
