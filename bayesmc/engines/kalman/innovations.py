"""Innovations of a Gaussian filter: what rows were off, in units of what was expected of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy import special

from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.slices import Layout
from bayesmc.linalg.square_root import multiplied
from bayesmc.results.predictive import Predictive


class Innovations:
    """Standardised innovations of all slices, written as the slices pass.

    Parameters
    ----------
    layout : Layout
        Of any slice.
    names : iterable of str
        Observed nodes.
    steps : int

    Attributes
    ----------
    nis : ndarray, shape (time, *lead)
        Squares of the innovations, normalised by their joint covariance.
    df : ndarray of int, shape (time, *lead)
        Numbers that were observed.
    """

    def __init__(self, layout: Layout, names: Iterable[str], steps: int) -> None:
        self.layout, shape = layout, (steps, *layout.lead)
        self.nis = np.zeros(shape)
        self.df = np.zeros(shape, dtype=np.intp)
        self._of = {n: np.full((*shape, layout.size(n)), np.nan) for n in names}

    def put(
        self, at: Any, layout: Layout, pattern: Pattern, root: np.ndarray, eta: np.ndarray
    ) -> None:
        """Those of slices ``at`` (an index, or an array of them): roots, and what they standardise to."""
        p = len(pattern.observed)
        if not p:
            return
        self.nis[at] = np.vecdot(eta, eta)
        with np.errstate(invalid="ignore", divide="ignore"):
            off = multiplied(root, eta) / np.sqrt(np.vecdot(root, root))
        self.df[at] = p
        if pattern.absent is not None:
            self.df[at] = p - pattern.absent.sum(axis=-1)
            off = np.where(pattern.absent, np.nan, off)
        for name, place in layout.seen.items():
            if name in self._of:
                self._of[name][at] = off[..., place]
        given = pattern.observed[layout.p :] - layout.p
        for name in (n for n in layout.rows if n in self._of and len(given)):
            place = layout.rows[name]
            own = np.flatnonzero((given >= place.start) & (given < place.stop))
            rows = self._of[name][at]
            rows[..., given[own] - place.start] = off[..., layout.p + own]
            self._of[name][at] = rows

    def first(self, steps: int) -> Innovations:
        """Of the first so many slices."""
        found = Innovations(self.layout, (), steps)
        found.nis, found.df = self.nis[:steps], self.df[:steps]
        found._of = {n: v[:steps] for n, v in self._of.items()}
        return found

    def of(self, name: str) -> np.ndarray | None:
        """A node's, each number by its own standard deviation, shape ``(time, *plates, *event)``; or None."""
        if name not in self._of:
            return None
        return self.layout.unpacked(self.layout.slices.first[name], self._of[name])

    def predictive(self) -> Predictive:
        """The same as ranks: rows of a Gaussian are the less likely the larger their NIS."""
        seen = self.df > 0
        df = np.maximum(self.df, 1)
        ranks = np.where(seen, special.chdtrc(df, self.nis), np.nan)
        deficits = np.where(seen, 0.5 * (self.nis - self.df) / df, np.nan)
        return Predictive(ranks, deficits, {n: special.ndtr(self.of(n)) for n in self._of})
