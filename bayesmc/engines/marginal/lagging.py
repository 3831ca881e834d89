"""Beliefs about earlier slices given later rows, carried along by every particle: fixed lags.

Numbers of a slice are a mean and coefficients of independent normals, its noise. Taking in the next row turns
that noise into the row's standardised innovations, the noise of the next slice, and a rest of which no later
row tells anything. So an earlier slice is a mean that moves with the innovations, coefficients of the newest
slice's noise (*link*) and of what is left behind (*spread*). Nothing goes backwards, no covariance is formed,
and resampling takes it along.

References
----------
Kailath, Sayed and Hassibi (2000), Linear Estimation, ch. 12 (array algorithms); Anderson and Moore (1979),
Optimal Filtering, sec. 7.3 (fixed lags by carrying earlier slices).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.engines.kalman.slices import Layout


class Turned(NamedTuple):
    """What a row tells of the noise of the slice before.

    Attributes
    ----------
    turn : ndarray, shape (groups, *lead, c, k)
        That noise by innovations, noise of the new slice, and the rest.
    eta : ndarray, shape (particles, *lead, p)
        Standardised innovations.
    at : ndarray of int or slice
        Places of the groups in the pool before.
    kept : int
        Entries of the noise of the new slice that ``turn`` has.
    width : int
        Entries that it has in all: what is observed has none of its own.
    """

    turn: np.ndarray
    eta: np.ndarray
    at: np.ndarray | slice
    kept: int
    width: int


class Lagged(NamedTuple):
    """The belief about the numbers of a slice, given its rows and some later ones.

    Attributes
    ----------
    layout : Layout
        Of that slice.
    mean : ndarray, shape (particles, *lead, n)
    link : ndarray, shape (pool, *lead, n, m)
        Coefficients of the noise of the newest slice, whose pool this is.
    spread : ndarray, shape (pool, *lead, n, k)
        Coefficients of noise that no later row tells of.
    """

    layout: Layout
    mean: np.ndarray
    link: np.ndarray
    spread: np.ndarray

    def taken(self, ancestors: np.ndarray, which: np.ndarray | None) -> Lagged:
        """Those of the ancestors; ``which`` are their places in the pool, if there is one."""
        if ancestors.ndim == 1:
            found = self._replace(mean=self.mean.take(ancestors, axis=0))
            if which is not None:
                return found
            return found._replace(
                link=self.link.take(ancestors, axis=0), spread=self.spread.take(ancestors, axis=0)
            )
        found = self._replace(mean=np.take_along_axis(self.mean, ancestors[..., None], 0))
        if which is not None and len(self.link) == 1:
            return found
        every = (self.link, self.spread)
        if which is not None:
            every = self.link.take(which, axis=0), self.spread.take(which, axis=0)
        link, spread = (np.take_along_axis(a, ancestors[..., None, None], 0) for a in every)
        return found._replace(link=link, spread=spread)

    def factors(self) -> np.ndarray:
        """Roots of covariances, shape (pool, *lead, n, m + k)."""
        return np.concatenate([self.link, self.spread], axis=-1)


def newest(layout: Layout, mean: np.ndarray, factors: np.ndarray) -> Lagged:
    """The belief about a slice of which no later row is known."""
    return Lagged(layout, mean, factors, np.zeros((*factors.shape[:-1], 0)))


def told_more(
    past: Sequence[Lagged], turned: Turned, group: np.ndarray | None, observed: int
) -> list[Lagged]:
    """Beliefs about earlier slices once one more row is known.

    Parameters
    ----------
    past : sequence of Lagged
        Of the ancestors.
    group : ndarray of int, shape (particles,), or None
        Which of the groups each particle is in.
    observed : int
        How many numbers of the row were observed.
    """
    turn, eta = turned.turn, turned.eta
    edge = observed + turned.kept
    shift, carried, rest = turn[..., :observed], turn[..., observed:edge], turn[..., edge:]
    found = []
    for own in past:
        before = own.link[turned.at]
        gain = before @ shift
        gain = gain if group is None or len(gain) == 1 else gain.take(group, axis=0)
        link = np.zeros((*before.shape[:-1], turned.width))
        link[..., : turned.kept] = before @ carried
        spread = _narrow(np.concatenate([own.spread[turned.at], before @ rest], axis=-1))
        found.append(Lagged(own.layout, own.mean + np.matvec(gain, eta), link, spread))
    return found


# ---- private ------------------------------------------------------------------------------------


def _narrow(root: np.ndarray) -> np.ndarray:
    """The same covariance by fewer columns, where there are many."""
    n, k = root.shape[-2:]
    if k <= 2 * n:
        return root
    return np.matrix_transpose(np.linalg.qr(np.matrix_transpose(root), mode="r"))
