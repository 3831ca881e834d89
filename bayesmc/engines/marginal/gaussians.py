"""One Kalman filter for each particle, all of them in one array operation.

Particles have means of their own. Covariances they share where these are the same: particles with the same
history of whatever coefficients and scales depend on, all particles where these depend on nothing sampled.
So a slice has a *pool* of roots, and every particle the place of its own.

A slice may be taken in for several *choices* of its finite nodes at once; bootstrap filters have one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.kalman.covariances import full_factor, without_absent
from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.means import absorbed
from bayesmc.engines.kalman.slices import Layout
from bayesmc.linalg.square_root import Conditioned, condition_many
from bayesmc.network import CompiledNode

#: kinds of coefficients up to which all of them are applied to all means, by one product of matrices
_FEW = 8


class Gaussians(NamedTuple):
    """Beliefs about the numbers of a slice that are integrated out.

    Attributes
    ----------
    layout : Layout
    mean : ndarray, shape (particles, *lead, n)
    factors : ndarray, shape (pool, *lead, n, m)
        Roots of covariances.
    which : ndarray of int, shape (particles,), or None
        Places in the pool; None where every particle has a root of its own.
    seen : frozenset of str
        Nodes that are taken to be seen in full in every slice.
    over : tuple of ndarray or None, shapes (particles, *lead, n)
        Means and variances over the choices that each particle had, of which one was drawn.
    """

    layout: Layout
    mean: np.ndarray
    factors: np.ndarray
    which: np.ndarray | None
    seen: frozenset[str] = frozenset()
    over: tuple[np.ndarray, np.ndarray] | None = None

    def taken(self, ancestors: np.ndarray | None) -> Gaussians:
        """Those of the ancestors, which may differ between elements of plates."""
        if ancestors is None:
            return self._replace(over=None)
        if ancestors.ndim == 1:
            mean = self.mean.take(ancestors, axis=0)
            if self.which is None:
                factors = self.factors.take(ancestors, axis=0)
                return Gaussians(self.layout, mean, factors, None, self.seen)
            which = self.which.take(ancestors)
            return Gaussians(self.layout, mean, self.factors, which, self.seen)
        mean = np.take_along_axis(self.mean, ancestors[..., None], 0)
        if self.which is not None and len(self.factors) == 1:
            which = np.zeros(len(mean), dtype=np.intp)
            return Gaussians(self.layout, mean, self.factors, which, self.seen)
        factors = np.take_along_axis(self.roots(), ancestors[..., None, None], 0)
        return Gaussians(self.layout, mean, factors, None, self.seen)

    def roots(self) -> np.ndarray:
        """Every particle's own, shape (particles, *lead, n, m)."""
        return self.factors if self.which is None else self.factors.take(self.which, axis=0)

    def has(self, name: str) -> bool:
        """Whether there is a belief about a node."""
        return name in self.layout.rows

    def joined(self, parties: Sequence[Any], at: np.ndarray) -> Gaussians:
        """Some of those of several parties, one after the other."""
        means = np.concatenate([p.inner.mean for p in parties])
        roots = np.concatenate([p.inner.roots() for p in parties])
        return self._replace(mean=means[at], factors=roots[at], which=None, over=None)

    def carried(self) -> Gaussians:
        """Of the numbers that the next slice reads."""
        c = self.layout.carried
        return self._replace(mean=self.mean[..., :c], factors=self.factors[..., :c, :])

    def mean_of(self, node: CompiledNode) -> np.ndarray:
        """Means of a node, shape (particles, *plates, *event)."""
        return self.layout.unpacked(node, self.mean[..., self.layout.rows[node.name]])

    def variance_of(self, node: CompiledNode) -> np.ndarray:
        """Variances of a node, shape (particles, *plates, *event)."""
        rows = self.factors[..., self.layout.rows[node.name], :]
        found = self.layout.unpacked(node, np.vecdot(rows, rows))
        return found if self.which is None else found.take(self.which, axis=0)

    def moments_of(self, node: CompiledNode) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances of a node, over the choices that there were."""
        if self.over is None:
            return self.mean_of(node), self.variance_of(node)
        place = self.layout.rows[node.name]
        mean, variance = (self.layout.unpacked(node, a[..., place]) for a in self.over)
        return mean, variance

    def completed(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Values of all nodes with a belief, one draw for each particle."""
        return self.values_of(self.drawn(rng) if self.layout.n else self.mean)

    def values_of(self, drawn: np.ndarray) -> dict[str, np.ndarray]:
        """Draws of all numbers, shape (particles, *lead, n), by node."""
        layout, found = self.layout, {}
        for name, place in layout.rows.items():
            found[name] = layout.unpacked(layout.model[name], drawn[..., place])
            found[name].flags.writeable = False
        return found

    def drawn(self, rng: np.random.Generator) -> np.ndarray:
        """One draw for each particle, shape (particles, *lead, n)."""
        noise = rng.standard_normal((*self.mean.shape[:-1], self.factors.shape[-1]))
        if len(self.factors) == 1 and self.factors.ndim == 3:
            return self.mean + noise @ self.factors[0].T
        return self.mean + np.matvec(self.roots(), noise)


class Coefficients(NamedTuple):
    """A slice as matrices, for each particle and choice: ``offset + moves @ before + noise @ normals``.

    Attributes
    ----------
    offset : ndarray, shape (particles, choices, *lead, p + n)
    moves : ndarray, shape (kinds, choices, *lead, p + n, n_prev)
    noise : ndarray, shape (kinds, choices, *lead, p + n, q)
    kind : ndarray of int, shape (particles,), or None
        Of each particle; None where every particle has its own.
    """

    offset: np.ndarray
    moves: np.ndarray
    noise: np.ndarray
    kind: np.ndarray | None


class Taken(NamedTuple):
    """A slice with its row, for each particle and choice.

    Attributes
    ----------
    layout : Layout
    log : ndarray, shape (particles, choices, *lead)
        Log densities of the row.
    mean : ndarray, shape (particles, choices, *lead, n)
    factors : ndarray, shape (groups, choices, *lead, n, m)
    group : ndarray of int, shape (particles,), or None
    """

    layout: Layout
    log: np.ndarray
    mean: np.ndarray
    factors: np.ndarray
    group: np.ndarray | None

    def averaged(self, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances over choices, by their shares, shape (particles, choices, *lead)."""
        variance = np.vecdot(self.factors, self.factors)
        if self.group is not None:
            variance = variance.take(self.group, axis=0)
        mean = np.einsum("ij...,ij...n->i...n", shares, self.mean)
        away = self.mean - mean[:, None]
        return mean, np.einsum("ij...,ij...n->i...n", shares, variance + away * away)

    def chosen(self, choice: np.ndarray | None) -> Gaussians:
        """With one choice for each particle, shape (particles, *lead); None where there is but one."""
        if choice is None:
            return Gaussians(self.layout, self.mean[:, 0], self.factors[:, 0], self.group)
        n = len(self.mean)
        at = choice[:, None, ..., None]
        mean = np.take_along_axis(self.mean, at, 1)[:, 0]
        if choice.ndim == 1 and self.group is not None:
            count = self.factors.shape[1]
            pool, which = np.unique(self.group * count + choice, return_inverse=True)
            groups, _, *own = self.factors.shape
            factors = self.factors.reshape(groups * count, *own).take(pool, axis=0)
            return Gaussians(self.layout, mean, factors, which)
        every = self.factors if self.group is None else self.factors.take(self.group, axis=0)
        every = np.broadcast_to(every, (n, *every.shape[1:]))
        factors = np.take_along_axis(every, at[..., None], 1)[:, 0]
        return Gaussians(self.layout, mean, factors, None)


def nothing(layout: Layout, particles: int) -> Gaussians:
    """What stands before slice 0."""
    lead = layout.lead
    which = np.zeros(particles, dtype=np.intp)
    return Gaussians(layout, np.zeros((particles, *lead, 0)), np.zeros((1, *lead, 0, 0)), which)


def take_in(
    layout: Layout,
    pattern: Pattern,
    before: Gaussians,
    found: Coefficients,
    row: np.ndarray,
    given: np.ndarray | None,
) -> Taken:
    """The slice after ``before``, given its row.

    Parameters
    ----------
    before : Gaussians
        Of the ancestors; of the numbers that this slice reads.
    row : ndarray, shape (*lead, observed)
    given : ndarray, shape (*lead, n), or None
        Values of numbers that are observed in part.
    """
    n, chosen = len(before.mean), pattern.chosen
    offset, moves, noise = (
        found.offset[..., chosen],
        found.moves[..., chosen, :],
        found.noise[..., chosen, :],
    )
    left, of_kind, group = _grouped(before, found.kind, len(moves))
    made = _conditioned(pattern, left, moves, noise, of_kind)
    mean = _expected(before.mean, offset, moves, found.kind)
    own = made
    if group is not None and len(made.root) > 1:
        certain = None if made.certain is None else made.certain.take(group, axis=0)
        root, gain = made.root.take(group, axis=0), made.gain.take(group, axis=0)
        own = Conditioned(root, gain, made.factor, None, certain)
    terms = _sizes(before.mean, offset, moves, found.kind)
    after, _, log = absorbed(layout, pattern, own, mean, row, given, terms=terms)
    factors = full_factor(layout, pattern, made.factor)
    count = moves.shape[1]
    log = np.broadcast_to(log, (n, count, *layout.lead))
    return Taken(layout, log, after, factors, group)


# ---- private ------------------------------------------------------------------------------------


def _grouped(
    before: Gaussians, kind: np.ndarray | None, kinds: int
) -> tuple[np.ndarray, np.ndarray | slice, np.ndarray | None]:
    """Roots and kinds of the particles that differ in either, and which of them each particle is."""
    alone = before.which is None or kind is None
    if alone and not (kinds == 1 and before.which is None):
        every = slice(None) if kind is None else kind
        return before.roots(), every, None
    if before.which is None:
        return before.factors, np.zeros(len(before.factors), dtype=np.intp), None
    assert kind is not None
    if kinds == 1 and len(before.factors) == 1:
        return before.factors, np.zeros(1, dtype=np.intp), before.which
    pairs, group = np.unique(before.which * kinds + kind, return_inverse=True)
    return before.factors.take(pairs // kinds, axis=0), pairs % kinds, group


def _conditioned(
    pattern: Pattern,
    left: np.ndarray,
    moves: np.ndarray,
    noise: np.ndarray,
    of_kind: np.ndarray | slice,
) -> Conditioned:
    """Each group and choice made triangular."""
    moves, noise = moves[of_kind], noise[of_kind]
    count, c = moves.shape[1], left.shape[-1]
    shape = (len(left), count, *noise.shape[2:-1])
    rows = np.zeros((*shape, c + noise.shape[-1]))
    np.matmul(moves, left[:, None], out=rows[..., :c])
    rows[..., c:] = noise
    if pattern.absent is not None:
        rows = without_absent(rows, pattern.absent)
    return condition_many(rows, len(pattern.observed))


def _expected(
    mean: np.ndarray, offset: np.ndarray, moves: np.ndarray, kind: np.ndarray | None
) -> np.ndarray:
    """What is expected of the chosen numbers, shape (particles, choices, *lead, r)."""
    if kind is None:
        return offset + np.matvec(moves, mean[:, None])
    kinds, count, r, c = moves.shape[0], moves.shape[1], moves.shape[-2], moves.shape[-1]
    if moves.ndim > 4 or kinds > _FEW:
        return offset + np.matvec(moves.take(kind, axis=0), mean[:, None])
    every = (mean @ moves.reshape(kinds * count * r, c).T).reshape(len(mean), kinds, count, r)
    own = every[:, 0] if kinds == 1 else every[np.arange(len(mean)), kind]
    return offset + own


def _sizes(
    mean: np.ndarray, offset: np.ndarray, moves: np.ndarray, kind: np.ndarray | None
) -> Callable[[], np.ndarray]:
    """How large the terms of what is expected are."""
    return lambda: _expected(np.abs(mean), np.abs(offset), np.abs(moves), kind)
