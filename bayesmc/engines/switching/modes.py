"""The mode of a slice: its hidden finite nodes together, and their joint configurations.

Given the mode a slice is linear-Gaussian, so everywhere else the mode counts as known: its nodes have one
value for each configuration, along a batch axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.distributions import MvNormal, Normal
from bayesmc.engines.discrete.slices import variables_of
from bayesmc.engines.filtering import quiet
from bayesmc.engines.kalman.slices import Layout, always_unknown
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.structure.tables import configurations

#: configurations that are written out, possible or not
_MOST = 1 << 10


class Modes:
    """What makes the mode of a slice.

    Parameters
    ----------
    slices : Slices
    seen : frozenset of str
        Nodes that are seen in full throughout.

    Attributes
    ----------
    names : tuple of str
        Nodes that make the mode: hidden finite ones, and computed finite ones that others need.
    leaves : tuple of str
        Nodes that are averaged over where they are missing: nothing reads them, and no Gaussian node needs
        them.
    apart : tuple of str
        Plates every element of which has a mode of its own.
    count : int
        Configurations, impossible ones included.
    values : dict
        Node -> stored values by configuration, shape (count, *plates).

    Raises
    ------
    UnsupportedError
        There are too many to write out.
    """

    def __init__(self, slices: Slices, seen: frozenset[str]) -> None:
        self.slices, self.seen = slices, seen
        self.apart = plates_apart(slices)
        finite = {n for n in slices.stochastic if slices.first[n].domain is not None}
        loose = _loose(slices, seen)
        bent = always_unknown(slices, seen | finite | loose)
        loose = {n for n in loose if not _reads(slices, n, bent)}
        read = variables_of(slices, seen, True) - bent
        names = [n for n in slices.dynamic if n in read]
        for name in slices.dynamic:  # what needs the mode before to be answered for is part of it
            node = slices.later[name]
            stems = {p.removesuffix(PREVIOUS) for p in node.parents if p.endswith(PREVIOUS)}
            late = bool(stems & set(names))
            if not node.is_stochastic:
                late |= name in slices.interface
            known = name in seen or name in bent or name in names
            if late and not known and node.domain is not None and not node.event_shape:
                names.append(name)
        self.names = tuple(n for n in slices.dynamic if n in names)
        hidden = (finite - seen - set(names)) | loose
        self.leaves = tuple(n for n in slices.dynamic if n in hidden)
        nodes = [slices.first[n] for n in self.names]
        count = math.prod(float(_size(n)) ** self._elements(n) for n in nodes)
        if count > _MOST:
            raise UnsupportedError(
                f"the finite nodes {', '.join(map(repr, self.names))} of a slice have {count:.4g} joint "
                f"states, and it goes through {_MOST} at most; use ParticleFilter"
            )
        values, sizes = configurations([], nodes, self.apart)
        self.count = math.prod(sizes)
        self.values = {
            n.name: np.broadcast_to(v, (*sizes, *n.plate_shape)).reshape(-1, *n.plate_shape)
            for n, v in zip(nodes, values, strict=True)
        }

    def _elements(self, node: Any) -> int:
        pairs = zip(node.plates, node.plate_shape, strict=True)
        return math.prod(size for plate, size in pairs if plate not in self.apart)

    def at(self, which: np.ndarray, ending: str = "") -> dict[str, np.ndarray]:
        """Stored values in some configurations, shape (*which.shape, *plates)."""
        return {n + ending: v[which] for n, v in self.values.items()}

    def known(self, seen: frozenset[str]) -> frozenset[str]:
        """Nodes that are known in a slice given its mode, or need not be."""
        return seen | set(self.names) | set(self.leaves)

    def why_not(self, layout: Layout) -> str | None:
        """Why the mode alone does not carry what is computed from it into the next slice, or None."""
        if not self.names:
            return None
        for name in layout.computed:
            if name not in layout.slices.interface or name in self.names:
                continue
            if self.reach(layout, name) or self.reach(layout, name, PREVIOUS):
                return (
                    f"node {name!r} is computed from finite nodes and read by the next slice, which should "
                    "read those nodes themselves"
                )
        return None

    def reach(self, layout: Layout, name: str, ending: str = "") -> frozenset[str]:
        """Nodes of the mode that a function reads, directly or through computed nodes.

        With ``ending`` those of the slice before, under their own names.
        """
        found: set[str] = set()
        todo, met = [name], {name}
        while todo:
            for parent in layout.model[todo.pop()].parents:
                stem = parent.removesuffix(PREVIOUS)
                if stem in self.names:
                    if (parent != stem) == bool(ending):
                        found.add(stem)
                elif parent in layout.order and parent not in met:
                    met.add(parent)
                    todo += [] if layout.model[parent].is_stochastic else [parent]
        return frozenset(found)

    def classes(self, layout: Layout) -> np.ndarray:
        """Configurations of the slice before by what Gaussian nodes read of them, shape (count,)."""
        placed = [self.reach(layout, n, PREVIOUS) for n in layout.placed]
        read = sorted(frozenset().union(*placed))
        if not read:
            return np.zeros(self.count, dtype=np.intp)
        rows = np.concatenate([self.values[n].reshape(self.count, -1) for n in read], axis=1)
        return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)


# ---- private ------------------------------------------------------------------------------------


def _loose(slices: Slices, seen: frozenset[str]) -> set[str]:
    """Nodes of other families than the Gaussian that nothing reads, and that are hidden now and then."""
    read = {
        parent.removesuffix(PREVIOUS)
        for model in (slices.first, slices.later)
        for name in slices.dynamic
        for parent in model[name].parents
    }
    found = set()
    for name in slices.stochastic:
        node = slices.later[name]
        if name in read or name in seen or node.domain is not None or node.angles is not None:
            continue
        if not _is_gaussian(slices.later, name):
            found.add(name)
    return found


def _reads(slices: Slices, name: str, others: frozenset[str]) -> bool:
    """Whether a node depends on some others, of its slice or the one before."""
    parents = (*slices.first[name].parents, *slices.later[name].parents)
    return any(p.removesuffix(PREVIOUS) in others for p in parents)


def _size(node: Any) -> int:
    return node.domain.size


def _is_gaussian(model: Any, name: str) -> bool:
    probe: Mapping[str, np.ndarray] = model.probe
    try:
        with quiet():
            return isinstance(model.evaluate(name, probe)[0], (Normal, MvNormal))
    except BayesmcError:
        return True  # what is wrong with it is told elsewhere
