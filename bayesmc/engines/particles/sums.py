"""Sums over the particles of a slice, taken while these are in cache: all that answers and errors need.

For numbers without labels, angles or plates that are filtered separately. ``blocks`` says the same of slices
side by side, of whatever kind their nodes are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.engines.particles.errors import ENOUGH, by_shares
from bayesmc.engines.particles.families import OLD, YOUNG, Families
from bayesmc.engines.particles.smc import Particles
from bayesmc.network import CompiledNode

#: particles from which on sums are taken slice by slice, and numbers up to which they are
MANY, NUMBERS = 4096, 8


class Moments(NamedTuple):
    """Of the numbers of a slice that particles do not agree on, one after the other.

    Attributes
    ----------
    places : dict
        Node -> where its numbers begin and end.
    mean, variance : list of float
    shift, wide : list of float
        By how much the numbers lie off the mean without the slice's row, and the variance there.
    """

    places: dict[str, tuple[int, int]]
    mean: list[float]
    variance: list[float]
    shift: list[float]
    wide: list[float]


class Tally(NamedTuple):
    """A slice by its sums.

    Attributes
    ----------
    moments : Moments
    agreed : dict
        Values of nodes that all particles agree on.
    total : float
        Of the weights.
    old, young : list of ndarray, shapes (groups,)
        By family, sums of the weights, and of the weights times by how much each number lies off its mean;
        those of the young origin where few of the old are left, else None.
    families : Families
    """

    moments: Moments
    agreed: dict[str, np.ndarray]
    total: float
    old: list[np.ndarray]
    young: list[np.ndarray] | None
    families: Families


class Sums(NamedTuple):
    """Of slices in a row, in which particles agree on the same nodes.

    Attributes
    ----------
    mean, variance : ndarray, shape (slices, numbers)
    total : ndarray, shape (slices,)
        Of the weights.
    old, young : ndarray, shape (slices, 1 + numbers, groups)
        As in a ``Tally``; those of the young origin are right where ``few``.
    few, lost : ndarray of bool, shape (slices,)
        Where few of the old origin's families are left; where the filter has lost sight.
    """

    mean: np.ndarray
    variance: np.ndarray
    total: np.ndarray
    old: np.ndarray
    young: np.ndarray
    few: np.ndarray
    lost: np.ndarray


class Summing:
    """Takes the sums of slices of one filter.

    Parameters
    ----------
    nodes : sequence of CompiledNode
    particles : int
        At most.
    """

    def __init__(self, nodes: Sequence[CompiledNode], particles: int) -> None:
        self._ranks = {n.name: len(n.value_shape) for n in nodes}
        self._even = np.ones(particles)
        self._own: dict[tuple[str, ...], dict[str, tuple[int, int]]] = {}
        sizes = [math.prod(n.value_shape) for n in nodes]
        self._sizes = dict(zip(self._ranks, sizes, strict=True))
        self._off = np.empty(particles)
        self._weighted = np.empty((sum(sizes), particles))

    def fits(self, now: Particles) -> bool:
        """Whether a slice is one of those that sums say all of."""
        return now.rejuvenated is False

    def moments(self, earlier: Particles | None, now: Particles) -> Moments:
        """Of a slice, given the slice before."""
        values, weights, total, n = now.values, now.weights, now.total, len(now.weights)
        places = self._places(values)
        prior, spent, off, own = self._even[:n], float(n), self._off[:n], None
        if now.resampled is not True and earlier is not None and len(earlier.weights) == n:
            prior, spent = earlier.weights, earlier.total
            own = prior
        found: list[tuple[float, float, float, float]] = []
        for name in places:
            for column in _columns(values[name], n):
                weighted = self._weighted[len(found), :n]
                mean = float(column.dot(weights)) / total
                np.subtract(column, mean, out=off)
                shift = float(off.dot(prior)) / spent
                if own is None:
                    square = float(off.dot(off)) / spent
                else:
                    square = float(np.multiply(off, own, out=weighted).dot(off)) / spent
                variance = float(np.multiply(off, weights, out=weighted).dot(off)) / total
                found.append((mean, variance, shift, square - shift * shift))
        if len(found) == 1:
            return Moments(places, *[[figure] for figure in found[0]])
        return Moments(places, *map(list, zip(*found, strict=True) if found else ((), (), (), ())))

    def tally(self, now: Particles, moments: Moments, families: Families) -> Tally:
        """All sums of the slice whose moments were taken last."""
        weights, total, n = now.weights, now.total, len(now.weights)
        columns = [weights, *self._weighted[: len(moments.mean), :n]]
        old, young = _by_family(columns, families.bounds[OLD]), None
        if float(old[0].dot(old[0])) * ENOUGH > total * total:
            young = _by_family(columns, families.bounds[YOUNG])
        agreed: dict[str, np.ndarray] = {}
        if len(moments.places) < len(self._ranks):
            agreed = {k: now.values[k] for k in self._ranks if k not in moments.places}
        return Tally(moments, agreed, total, old, young, families)

    # ---- private -------------------------------------------------------------------------------

    def _places(self, values: Mapping[str, np.ndarray]) -> dict[str, tuple[int, int]]:
        """Where numbers lie that particles do not agree on; the same object where these are the same."""
        names = tuple([k for k, rank in self._ranks.items() if values[k].ndim > rank])
        found = self._own.get(names)
        if found is None:
            found, low = {}, 0
            for name in names:
                found[name] = low, low + self._sizes[name]
                low += self._sizes[name]
            self._own[names] = found
        return found


def answers(found: Sequence[Tally]) -> dict[str, Sequence[np.ndarray]]:
    """Means, variances and errors of each node's numbers, slices first."""
    runs: list[list[Tally]] = []
    for tally in found:
        if runs and runs[-1][0].moments.places is tally.moments.places:
            runs[-1].append(tally)
        else:
            runs.append([tally])
    parts = [_of_run(run) for run in runs]
    if len(parts) == 1:
        return parts[0]
    joined = {n: zip(*(part[n] for part in parts), strict=True) for n in parts[0]}
    return {n: tuple(map(np.concatenate, each)) for n, each in joined.items()}


def figures(sums: Sums) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, variances and errors of all numbers, each ``(slices, numbers)``."""
    total, few = sums.total[:, None, None], sums.few
    errors = _variances(sums.old, total)
    if few.any():
        young, was = _variances(sums.young[few], total[few]), errors[few]
        errors[few] = np.maximum(np.where(np.isinf(was), 0.0, was), young)
    errors[sums.lost] = np.inf
    return sums.mean, sums.variance, np.sqrt(errors)


# ---- private ------------------------------------------------------------------------------------


def _columns(value: np.ndarray, n: int) -> Iterable[np.ndarray]:
    """The numbers of a node, each of all particles."""
    if value.ndim == 1:
        return (value,)
    return value.reshape(n, -1).T.copy()


def _by_family(columns: Sequence[np.ndarray], bounds: np.ndarray) -> list[np.ndarray]:
    """Sums over the particles of each family."""
    starts, ends, add = bounds[:-1], bounds[1:], np.add.reduceat
    some = ends > starts
    if some.all():
        return [add(column, starts) for column in columns]
    found, at = np.zeros((len(columns), len(starts))), starts[some]
    for own, column in zip(found, columns, strict=True):
        own[some] = add(column, at)
    return list(found)


def _of_run(run: Sequence[Tally]) -> dict[str, Sequence[np.ndarray]]:
    """The same of slices in which particles agree on the same nodes."""
    old = np.array([s.old for s in run])
    few = np.array([s.young is not None for s in run])
    young = np.zeros_like(old)
    for own, tally in zip(young, run, strict=True):
        if tally.young is not None:
            own[:] = tally.young
    lost = [s.families.lost is not None and bool(s.families.lost.where) for s in run]
    sums = Sums(
        np.array([s.moments.mean for s in run]), np.array([s.moments.variance for s in run]),
        np.array([s.total for s in run]), old, young, few, np.array(lost),
    )  # fmt: skip
    whole, places = figures(sums), run[0].moments.places
    found: dict[str, Sequence[np.ndarray]] = {
        n: tuple(a[:, low:high] for a in whole) for n, (low, high) in places.items()
    }
    for name in run[0].agreed:
        values = np.array([s.agreed[name].reshape(-1) for s in run], dtype=float)
        found[name] = values, np.zeros(values.shape), np.zeros(values.shape)
    return found


def _variances(sums: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Variances of means, shape (slices, numbers)."""
    shares = sums / total
    return by_shares(shares[:, 1:], shares[:, :1])
