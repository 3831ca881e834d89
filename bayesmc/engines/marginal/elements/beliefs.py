"""What particles believe of plates whose elements are integrated out one by one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.elements.pool import Pool
from bayesmc.network import CompiledNode

#: of layouts, by node: where its numbers stand, by element and by flat place, worked out once
_PLACES: WeakKeyDictionary[Layout, dict[str, tuple[np.ndarray, np.ndarray]]] = WeakKeyDictionary()


class ElementBeliefs(NamedTuple):
    """Gaussian beliefs about the elements of plates, and about what was not read of them.

    Attributes
    ----------
    layout : Layout
        Of the nodes of the plates, which are its leading axes.
    pool : Pool
    seen : frozenset of str
        Nodes that are taken to be seen in full in every slice.
    missing : dict
        Reading that is missing, if only in part -> means and variances of its values, shape (particles,
        *plates, *event).
    """

    layout: Layout
    pool: Pool
    seen: frozenset[str] = frozenset()
    missing: Mapping[str, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def past(self) -> tuple[()]:
        """No slice before is followed."""
        return ()

    def taken(self, ancestors: np.ndarray | None) -> ElementBeliefs:
        """Those of the ancestors, which may differ between elements of plates apart."""
        return self if ancestors is None else self._replace(pool=self.pool.taken(ancestors))

    def carried(self) -> ElementBeliefs:
        return self._replace(missing={})

    def has(self, name: str) -> bool:
        """Whether there is a belief about a node."""
        return name in self.layout.rows or name in self.missing

    def dense(self) -> tuple[np.ndarray, np.ndarray]:
        """Of all elements: ``(particles, *lead, n)`` and ``(particles, *lead, n, n)``."""
        mean, root = self.pool.at(np.arange(len(self.pool.home)))
        lead = (len(mean), *self.layout.lead)
        return mean.reshape(*lead, -1), root.reshape(*lead, *root.shape[-2:])

    def mean_of(self, node: CompiledNode) -> np.ndarray:
        """Means of a node, shape (particles, *plates, *event)."""
        return self.moments_of(node)[0]

    def variance_of(self, node: CompiledNode) -> np.ndarray:
        """Variances of a node, shape (particles, *plates, *event)."""
        return self.moments_of(node)[1]

    def moments_of(self, node: CompiledNode) -> tuple[np.ndarray, np.ndarray]:
        if node.name in self.missing:
            return self.missing[node.name]
        numbers = getattr(node, "numbers", None)
        if numbers is not None:  # of some of them alone
            return self.moments_at(node.node, numbers)  # type: ignore[attr-defined]
        mean, root = self.dense()
        place = self.layout.rows[node.name]
        rows = root[..., place, :]
        unpacked = self.layout.unpacked
        return unpacked(node, mean[..., place]), unpacked(node, np.vecdot(rows, rows))

    def numbers(self, node: CompiledNode) -> np.ndarray | None:
        """Flat places of a node's numbers about which particles may differ; None where all may."""
        if node.name in self.missing:
            return None
        live = self.pool.live
        if 2 * len(live) > len(self.pool.home):
            return None
        return np.sort(self._places(node)[live].reshape(-1))

    def moments_at(self, node: CompiledNode, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances of some of a node's numbers, shape (particles, numbers)."""
        width = self.layout.size(node.name)
        turned = self._turned(node)[numbers]
        element, component = turned // width, turned % width
        ids, back = np.unique(element, return_inverse=True)
        mean, root = self.pool.at(ids)
        component = component + self.layout.rows[node.name].start
        rows = root[:, back, component]
        return mean[:, back, component], np.vecdot(rows, rows)

    def agreed(self, node: CompiledNode) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances of one particle, shape (*plates, *event)."""
        one = self._replace(pool=self.pool.of_one())
        mean, variance = one.moments_of(node)
        return mean[0], variance[0]

    def agreed_since(
        self, earlier: ElementBeliefs, node: CompiledNode
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flat places of numbers that may be others than in earlier beliefs, their means and variances."""
        one = self._replace(pool=self.pool.of_one())
        if node.name in self.missing or node.name in earlier.missing:
            every = np.arange(math.prod(node.value_shape))
            mean, variance = one.moments_of(node)
            return every, mean[0].reshape(-1), variance[0].reshape(-1)
        numbers = self._places(node)[self.pool.written_since(earlier.pool)].reshape(-1)
        mean, variance = one.moments_at(node, numbers)
        return numbers, mean[0], variance[0]

    def covariance(self, nodes: Sequence[CompiledNode], shares: np.ndarray) -> np.ndarray:
        """Mean of the particles' covariances of nodes one after the other; 0 for what they know."""
        sizes = [math.prod(node.value_shape) for node in nodes]
        whole, low, places, rows = np.zeros((sum(sizes), sum(sizes))), 0, [], []
        root = self.dense()[1] if any(n.name in self.layout.rows for n in nodes) else None
        for node, size in zip(nodes, sizes, strict=True):
            if node.name in self.missing:
                own = self.missing[node.name][1].reshape(len(shares), -1)
                each = np.arange(low, low + size)
                whole[each, each] = shares @ own
            elif root is not None and node.name in self.layout.rows:
                n = root.shape[-1]
                rows.append(root.reshape(len(root), -1, n, n)[:, :, self.layout.rows[node.name]])
                places.append(low + self._places(node))
            low += size
        if rows:
            own, at = np.concatenate(rows, axis=2), np.concatenate(places, axis=1)
            found = np.einsum("i,ieaj,iebj->eab", shares, own, own)
            whole[at[:, :, None], at[:, None, :]] = found
        return whole

    def completed(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Values of all nodes of the plates, one draw for each particle."""
        mean, root = self.dense()
        drawn = mean + np.matvec(root, rng.standard_normal(mean.shape))
        found = {}
        for name, place in self.layout.rows.items():
            found[name] = self.layout.unpacked(self.layout.model[name], drawn[..., place])
            found[name].flags.writeable = False
        return found

    # ---- private -------------------------------------------------------------------------------

    def _turned(self, node: CompiledNode) -> np.ndarray:
        """By flat place of a node's numbers, its place in the order of elements."""
        return self._kept(node)[1]

    def _places(self, node: CompiledNode) -> np.ndarray:
        """Flat places of a node's numbers, by element and component."""
        return self._kept(node)[0]

    def _kept(self, node: CompiledNode) -> tuple[np.ndarray, np.ndarray]:
        kept = _PLACES.setdefault(self.layout, {})
        if node.name not in kept:
            size = math.prod(node.value_shape)
            packed = self.layout.packed(node, np.arange(size).reshape(node.value_shape))
            turned = np.empty(size, dtype=np.intp)
            turned[packed.reshape(-1)] = np.arange(size)
            kept[node.name] = packed.reshape(len(self.pool.home), -1), turned
        return kept[node.name]


class DrawnLater(dict):
    """Values of nodes of which some are drawn when they are first looked at.

    Parameters
    ----------
    values : dict
    names : sequence of str
        Nodes that are drawn later.
    draw : callable
        Gives their values.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        names: Sequence[str],
        draw: Callable[[], Mapping[str, np.ndarray]],
    ) -> None:
        super().__init__(values)
        self._draw: Callable[[], Mapping[str, np.ndarray]] | None = draw
        self._names = tuple(n for n in names if not dict.__contains__(self, n))

    def __missing__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(name)
        self._fill()
        return dict.__getitem__(self, name)

    def __contains__(self, name: object) -> bool:
        return dict.__contains__(self, name) or name in self._names

    def __iter__(self) -> Iterator[str]:
        yield from dict.__iter__(self)
        yield from self._names

    def __len__(self) -> int:
        return dict.__len__(self) + len(self._names)

    def keys(self) -> Any:
        return list(self)

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default

    def items(self) -> Any:
        self._fill()
        return dict.items(self)

    def values(self) -> Any:
        self._fill()
        return dict.values(self)

    def copy(self) -> dict:
        return dict(self.items())

    def __or__(self, other: Any) -> dict:
        return self.copy() | other

    def __reduce__(self) -> Any:
        return dict, (self.copy(),)

    @property
    def held(self) -> Any:
        """Those that there are already."""
        return dict.items(self)

    # ---- private -------------------------------------------------------------------------------

    def _fill(self) -> None:
        if self._draw is not None:
            drawn = self._draw()
            for name in self._names:
                dict.__setitem__(self, name, drawn[name])
            self._draw, self._names = None, ()
