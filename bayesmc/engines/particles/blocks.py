"""Particles of several slices side by side, so that answers about many slices cost a few array operations.

Numbers of a node are laid out as ``(slices, elements, numbers, particles)``, where elements are those of the
plates that are filtered separately and numbers are all others of a value: what goes along a short last axis
is ten times slower.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.smc import Layout, Particles
from bayesmc.network import CompiledNode
from bayesmc.results.statistics import circular_variance

#: numbers of all particles of slices that are looked at side by side: what costs is calling NumPy
NUMBERS = 1 << 17


class Moments(NamedTuple):
    """Of a node that is no finite one.

    Attributes
    ----------
    mean, variance : ndarray, shape (slices, elements, numbers)
        Circular ones of angles.
    off, weighted : ndarray, shape (slices, elements, numbers, particles)
        By how much values lie off the mean (of angles, the sines of that over the mean resultant length), and
        that times the weights.
    """

    mean: np.ndarray
    variance: np.ndarray
    off: np.ndarray
    weighted: np.ndarray


class Block:
    """Slices in a row, each with as many particles, which agree on the same nodes.

    Parameters
    ----------
    layout : Layout
    slices : sequence of Particles
    whole : bool
        Nodes that all particles agree on are laid out, too.
    room : dict, optional
        Large arrays of blocks that nobody looks at any more: fresh ones cost the machine a page at a time.

    Attributes
    ----------
    weights : ndarray, shape (slices, elements, particles)
    total : ndarray, shape (slices, elements)
    """

    def __init__(
        self,
        layout: Layout,
        slices: Sequence[Particles],
        whole: bool = False,
        room: dict[Any, np.ndarray] | None = None,
    ) -> None:
        self.layout, self.slices, self.whole = layout, slices, whole
        self._room = {} if room is None else room
        self.particles = len(slices[0].weights)
        self.elements = math.prod(layout.lead)
        self.weights = self.turned([p.weights for p in slices], key="weights")[:, :, 0]
        self.total = np.array([p.total for p in slices], dtype=float).reshape(len(slices), -1)
        self._kept: dict[tuple[str, str], Any] = {}

    def flat(self, figures: Sequence[Any]) -> np.ndarray:
        """Figures of slices, each ``(*apart)``, as ``(slices, elements)``."""
        lead = self.layout.lead
        rows = figures if not lead else [np.broadcast_to(f, lead) for f in figures]
        return np.array(rows).reshape(len(rows), -1)

    def rows(self, node: CompiledNode) -> np.ndarray | None:
        """A node's stored values; None where all particles agree."""
        key = ("rows", node.name)
        if key not in self._kept:
            values = [_values(p, node) for p in self.slices]
            apart = set(self.layout.apart) <= set(node.plates)
            if apart and self.whole:
                shape = (self.particles, *node.value_shape)
                values = [np.broadcast_to(v, shape) for v in values]
            alike = not apart or values[0].ndim == len(node.value_shape)
            self._kept[key] = None if alike else self.turned(values, self._axes(node), node.name)
        return self._kept[key]

    def state_shares(self, node: CompiledNode) -> np.ndarray | None:
        """Probabilities of a finite node's states, shape ``(slices, elements, numbers, states)``.

        None where all particles agree.
        """
        assert node.domain is not None
        key = ("shares", node.name)
        if key in self._kept:
            return self._kept[key]
        size, codes = node.domain.size, self.rows(node)
        if codes is None:
            return None
        tables = self.state_rows(node)
        if tables is not None:
            flat = tables.reshape(*codes.shape[:2], -1, self.particles)
            found = self.weighted(flat).reshape(tables.shape[:-1])
            self._kept[key] = found
            return found
        lanes = math.prod(codes.shape[:-1])
        if lanes > 1:
            codes = codes.astype(np.intp) + size * np.arange(lanes).reshape(*codes.shape[:-1], 1)
        weights = np.broadcast_to(self.weights[:, :, None], codes.shape)
        counts = np.bincount(codes.reshape(-1), weights.reshape(-1), minlength=lanes * size)
        found = counts.reshape(*codes.shape[:-1], size) / self.total[:, :, None, None]
        self._kept[key] = found
        return found

    def state_rows(self, node: CompiledNode) -> np.ndarray | None:
        """What each particle's table says: ``(slices, elements, numbers, states, particles)``, or None."""
        if not has_table(self.slices[0], node):
            return None
        key = ("tables", node.name)
        if key not in self._kept:
            values = [p.tables.probabilities(node.name) for p in self.slices]
            rows = self.turned(values, self._axes(node), f"tables of {node.name}")
            size = values[0].shape[-1]
            self._kept[key] = rows.reshape(*rows.shape[:2], -1, size, self.particles)
        return self._kept[key]

    def table(self, node: CompiledNode) -> np.ndarray:
        """The same, shape ``(slices, *plates, states)``, also where particles agree."""
        assert node.domain is not None
        shares = self.state_shares(node)
        if shares is not None:
            return self.unturned(shares, node, (node.domain.size,))
        return (self._agreed(node)[..., None] == np.arange(node.domain.size)).astype(float)

    def moments(self, node: CompiledNode) -> Moments | None:
        """Moments of a node that is not finite; None where all particles agree."""
        key = ("moments", node.name)
        if key not in self._kept:
            rows = self.rows(node)
            self._kept[key] = None if rows is None else self._moments(node, rows)
        return self._kept[key]

    def mean(self, node: CompiledNode) -> np.ndarray:
        """Means of a node that is not finite, shape ``(slices, *plates, *event)``."""
        rows = self.rows(node) if node.angles is None else None
        if rows is None:
            return self.mean_and_variance(node)[0]
        return self.unturned(self.weighted(rows), node)

    def mean_and_variance(self, node: CompiledNode) -> tuple[np.ndarray, np.ndarray]:
        """The same, shapes ``(slices, *plates, *event)``, also where particles agree."""
        found = self.moments(node)
        if found is not None:
            return self.unturned(found.mean, node), self.unturned(found.variance, node)
        value = self._agreed(node)
        return value, np.zeros(value.shape)

    def weighted(self, rows: np.ndarray) -> np.ndarray:
        """Weighted means of rows, shape ``(slices, elements, numbers)``."""
        if (
            rows.size == self.particles
        ):  # one number in one slice: without what a stack of matrices costs
            mean = self.weights.reshape(-1).dot(rows.reshape(-1)) / self.total.item()
            return np.array(mean).reshape(1, 1, 1)
        return np.matvec(rows, self.weights) / self.total[..., None]

    def unturned(
        self, figures: np.ndarray, node: CompiledNode, more: tuple[int, ...] = ()
    ) -> np.ndarray:
        """Figures ``(slices, elements, numbers, *more)`` as ``(slices, *plates, *event, *more)``."""
        layout = self.layout
        if not layout.apart:
            return figures.reshape(len(figures), *node.value_shape, *more)
        at = self._axes(node)
        rest = [n for k, n in enumerate(node.value_shape) if k + 1 not in at]
        whole = figures.reshape(len(figures), *layout.lead, *rest, *more)
        return np.moveaxis(whole, range(1, 1 + len(at)), at)

    def turned(
        self, values: Sequence[np.ndarray], at: Sequence[int] = (), key: str = ""
    ) -> np.ndarray:
        """Values of slices, ``(particles, *rest)``, laid out; the elements' axes are ``at``, or the first."""
        n, shape = self.particles, values[0].shape
        numbers = math.prod(shape[1:]) // self.elements
        whole = (len(values), self.elements, numbers, n)
        if len(values) == 1 and len(shape) == 1:
            return values[0].reshape(whole)
        found = self._array(("turned", key), whole, values[0].dtype)
        for k, value in enumerate(values):
            if len(shape) == 1:
                found[k, 0, 0] = value
                continue
            first = np.moveaxis(value, at, range(1, 1 + len(at))) if at else value
            found[k] = first.reshape(n, self.elements, numbers).transpose(1, 2, 0)
        return found

    # ---- private -------------------------------------------------------------------------------

    def _axes(self, node: CompiledNode) -> list[int]:
        """Where the plates that are filtered separately lie among the axes of a node's values."""
        return [1 + node.plates.index(p) for p in self.layout.apart]

    def _agreed(self, node: CompiledNode) -> np.ndarray:
        """The values of a node that all particles agree on, slices first."""
        values = [p.values[node.name] for p in self.slices]
        rank = len(node.value_shape)
        return np.array([v if v.ndim == rank else v[0] for v in values])

    def _moments(self, node: CompiledNode, rows: np.ndarray) -> Moments:
        mean = self.weighted(rows)
        off = self._array(("off", node.name), rows.shape)
        weighted, weights = (
            self._array(("weighted", node.name), rows.shape),
            self.weights[:, :, None],
        )
        angles = None if node.angles is None else self._angles(node, rows)
        if angles is not None:
            cosine, sine = self.weighted(np.cos(rows)), self.weighted(np.sin(rows))
            mean = np.where(angles, np.arctan2(sine, cosine), mean)
        np.subtract(rows, mean[..., None], out=off)
        np.multiply(off, weights, out=weighted)
        variance = np.vecdot(weighted, off) / self.total[..., None]
        if any(_believed(p, node) for p in self.slices):
            none = np.zeros((self.particles, *node.value_shape))
            inside = [
                p.inner.moments_of(node)[1] if _believed(p, node) else none for p in self.slices
            ]
            variance += self.weighted(self.turned(inside, self._axes(node)))
        if angles is not None:
            variance = np.where(angles, circular_variance(cosine, sine), variance)
            length = np.exp(-0.5 * variance)[..., None]
            with np.errstate(divide="ignore", invalid="ignore"):
                off[...] = np.where(angles[..., None], np.sin(off) / length, off)
            np.multiply(off, weights, out=weighted)
        return Moments(mean, variance, off, weighted)

    def _array(self, key: Any, shape: tuple[int, ...], dtype: Any = float) -> np.ndarray:
        size, kept = math.prod(shape), self._room.get(key)
        if kept is None or kept.size < size or kept.dtype != dtype:
            kept = self._room[key] = np.empty(size, dtype)
        return kept[:size].reshape(shape)

    def _angles(self, node: CompiledNode, rows: np.ndarray) -> np.ndarray:
        """Which numbers are angles, shape (1, 1, numbers)."""
        assert node.angles is not None
        event = np.broadcast_to(node.angles, node.event_shape).reshape(-1)
        times = rows.shape[2] // max(event.size, 1)
        return np.tile(event, times).reshape(1, 1, -1)


def alike(one: Particles, other: Particles) -> bool:
    """Whether two slices can stand side by side: laid out alike, and none drawn anew."""
    if len(one.weights) != len(other.weights) or one.rejuvenated is not False:
        return False
    # without what is drawn once it is looked at
    if dict.keys(one.values) != dict.keys(other.values):
        return False
    for name, own in dict.items(one.values):
        if own.ndim != dict.__getitem__(other.values, name).ndim:
            return False
    return other.rejuvenated is False


def has_table(particles: Particles, node: CompiledNode) -> bool:
    """Whether each particle has a table of a node's states."""
    return particles.tables is not None and particles.tables.has(node.name)


class Figures(NamedTuple):
    """Of a filter in a slice; as ``Particles`` has them, but for the number of those that have offspring."""

    increment: Any
    ess: Any
    resampled: Any
    rejuvenated: Any
    particles: int
    injected: int
    unique: Any


def figures_of(p: Particles) -> Figures:
    """Those of a slice."""
    lead, n = p.weights.shape[1:], len(p.weights)
    return Figures(p.increment, p.ess, p.resampled, p.rejuvenated, n, p.injected, _unique(p, lead))


def diagnosed(slices: Sequence[Figures], lead: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Figures of the filter itself."""

    def flags(each: list[Any]) -> np.ndarray:
        return np.array(each if not lead else [np.broadcast_to(e, lead) for e in each], dtype=bool)

    return {
        "increments": np.array([p.increment for p in slices], dtype=float),
        "weight_ess": np.array([p.ess for p in slices], dtype=float),
        "resampled": flags([p.resampled for p in slices]),
        "rejuvenated": flags([p.rejuvenated for p in slices]),
        "counts": np.array([p.particles for p in slices]),
        "injected": np.array([p.injected for p in slices]),
        "unique_ancestors": np.array([p.unique for p in slices]),
    }


# ---- private ------------------------------------------------------------------------------------


def _values(particles: Particles, node: CompiledNode) -> np.ndarray:
    """What a mean is taken over: of what is integrated out, every particle's own mean."""
    if _believed(particles, node):
        return particles.inner.moments_of(node)[0]
    return particles.values[node.name]


def _believed(particles: Particles, node: CompiledNode) -> bool:
    """Whether particles have beliefs about a node."""
    return particles.inner is not None and particles.inner.has(node.name)


def _unique(particles: Particles, lead: tuple[int, ...]) -> Any:
    """How many particles of the slice before have offspring, shape ``(*apart)``."""
    chosen = particles.ancestors
    if chosen is None:
        found: Any = np.full(lead, len(particles.weights))
    else:  # without an axis it is ten times faster
        along = 0 if lead else None
        found = np.count_nonzero(chosen[1:] != chosen[:-1], axis=along) + 1
    return found if particles.rejuvenated is False else np.where(particles.rejuvenated, 0, found)
