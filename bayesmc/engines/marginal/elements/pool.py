"""Gaussian beliefs of all particles about many elements, of which few change at a time.

What is written together is a *generation*: means and roots of some elements by *version*, and the version
that each particle has. Resampling moves versions alone; writing adds a generation and leaves the others as
they are, so a belief that somebody holds stays what it was. Generations merge as in a log-structured
merge-tree: there are few of them, every element is rewritten a logarithmic number of times, and versions
that no particle has any more go. So neither resampling nor writing costs more where there are more elements
that are not read.

References
----------
Thrun, Burgard and Fox (2005), Probabilistic Robotics, sec. 13.9 (maps shared by particles, in logarithmic
time, there by trees); O'Neil et al. (1996), The log-structured merge-tree, Acta Informatica 33.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Generation(NamedTuple):
    """Elements that were written together.

    Attributes
    ----------
    ids : ndarray of int, shape (k,)
    mean : ndarray, shape (k, versions, n)
    root : ndarray, shape (k, versions, n, n)
    which : ndarray of int, shape (groups, particles)
        The version of each particle, for elements of each group of plates apart.
    """

    ids: np.ndarray
    mean: np.ndarray
    root: np.ndarray
    which: np.ndarray


class Pool(NamedTuple):
    """Beliefs about all elements.

    Attributes
    ----------
    generations : tuple of Generation
        The oldest first.
    home, row : ndarray of int, shape (elements,)
        The generation that an element's belief is in, and where.
    group : ndarray of int, shape (elements,)
        To which elements of plates apart it belongs.
    """

    generations: tuple[Generation, ...]
    home: np.ndarray
    row: np.ndarray
    group: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray, root: np.ndarray, group: np.ndarray, particles: int) -> Pool:
        """All elements at once: ``(particles or 1, elements, n)`` and ``(..., n, n)``."""
        count = max(len(mean), len(root))
        elements = mean.shape[1]
        mean = np.broadcast_to(mean, (count, *mean.shape[1:])).swapaxes(0, 1)
        root = np.broadcast_to(root, (count, *root.shape[1:])).swapaxes(0, 1)
        groups = int(group.max(initial=0)) + 1
        own = np.arange(particles) if count == particles else np.zeros(particles, dtype=np.intp)
        which = np.broadcast_to(own, (groups, particles))
        every = np.arange(elements)
        home = np.zeros(elements, dtype=np.int32)
        return cls((Generation(every, mean, root, which),), home, every.astype(np.int32), group)

    @property
    def particles(self) -> int:
        return self.generations[0].which.shape[1]

    @property
    def live(self) -> np.ndarray:
        """Elements about which particles may differ."""
        several = np.array([g.mean.shape[1] > 1 for g in self.generations])
        return np.flatnonzero(several[self.home])

    def taken(self, ancestors: np.ndarray) -> Pool:
        """Those of ancestors, as many as wanted: shape ``(wanted,)`` or ``(wanted, *apart)``."""
        chosen = ancestors.reshape(len(ancestors), -1).T
        groups = len(self.generations[0].which)
        at = np.broadcast_to(chosen, (groups, chosen.shape[1]))
        found = [g._replace(which=np.take_along_axis(g.which, at, 1)) for g in self.generations]
        return self._replace(generations=tuple(found))

    def of_one(self) -> Pool:
        """Of the first particle alone."""
        return self._narrowed(np.zeros(1, dtype=np.intp))

    def at(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Beliefs of all particles about some elements: shapes (particles, k, n), (particles, k, n, n)."""
        n = self.generations[0].mean.shape[-1]
        mean = np.empty((len(ids), self.particles, n))
        root = np.empty((len(ids), self.particles, n, n))
        homes = self.home[ids]
        for number in np.unique(homes):
            own, generation = np.flatnonzero(homes == number), self.generations[number]
            rows = self.row[ids[own], None]
            versions = generation.which[self.group[ids[own]]]
            mean[own], root[own] = generation.mean[rows, versions], generation.root[rows, versions]
        return mean.swapaxes(0, 1), root.swapaxes(0, 1)

    def written_since(self, earlier: Pool) -> np.ndarray:
        """Elements whose beliefs stand elsewhere than in an earlier pool; others are the very same arrays."""
        pairs = zip(self.generations, earlier.generations, strict=False)
        is_same = np.zeros(len(self.generations), dtype=bool)
        for k, (own, other) in enumerate(pairs):
            is_same[k] = own.mean is other.mean and own.root is other.root
        stays = (self.home == earlier.home) & (self.row == earlier.row) & is_same[self.home]
        return np.flatnonzero(~stays)

    def put(self, ids: np.ndarray, mean: np.ndarray, root: np.ndarray) -> Pool:
        """With other beliefs about some elements: ``(particles, k, n)`` and ``(particles, k, n, n)``."""
        groups = self.generations[0].which.shape[0]
        which = np.broadcast_to(np.arange(self.particles), (groups, self.particles))
        fresh = Generation(ids, mean.swapaxes(0, 1), root.swapaxes(0, 1), which)
        home, row = self.home.copy(), self.row.copy()
        home[ids], row[ids] = len(self.generations), np.arange(len(ids))
        return Pool((*self.generations, fresh), home, row, self.group)._merged()

    # ---- private -------------------------------------------------------------------------------

    def _merged(self) -> Pool:
        """With as few generations as keep rewriting rare: sizes fall by half from one to the next.

        The first holds what every particle agrees on, and is never rewritten.
        """
        found = self
        while len(found.generations) > 2:
            *earlier, older, newer = found.generations
            if len(older.ids) >= 2 * len(newer.ids):
                break
            last = len(found.generations) - 1
            kept = [g.ids[found.home[g.ids] == k] for k, g in ((last - 1, older), (last, newer))]
            ids = np.concatenate(kept)
            made = found._compact(ids)
            home, row = found.home.copy(), found.row.copy()
            home[ids], row[ids] = last - 1, np.arange(len(ids))
            found = Pool((*earlier, made), home, row, found.group)
        return found

    def _compact(self, ids: np.ndarray) -> Generation:
        """Some elements as one generation, with the versions that particles have."""
        last = self.generations[-2:]
        key = last[0].which * last[1].mean.shape[1] + last[1].which
        if len(key) == 1:
            _, first, which = np.unique(key[0], return_index=True, return_inverse=True)
            which = which[None]
        else:
            first, which = np.arange(self.particles), None
        some = self._narrowed(first)
        mean, root = some.at(ids)
        if which is None:
            which = np.broadcast_to(first, key.shape)
        return Generation(ids, mean.swapaxes(0, 1), root.swapaxes(0, 1), which)

    def _narrowed(self, particles: np.ndarray) -> Pool:
        """Of some particles."""
        found = tuple(g._replace(which=g.which[:, particles]) for g in self.generations)
        return self._replace(generations=found)
