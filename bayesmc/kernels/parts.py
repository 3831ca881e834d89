"""Several nodes as one vector of free numbers: where each stands, which are angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.kernels.adaptation import turning
from bayesmc.kernels.random_walk import some_support, walked
from bayesmc.shapes import Shape
from bayesmc.structure.target import Target

#: numbers that are few enough for a mixture to be fitted to them
_FEW = 6


@dataclass(frozen=True)
class Part:
    """Where the numbers of one node stand in the vector of a block.

    Attributes
    ----------
    free : ndarray or None
        Flat plate elements that move; None where all do.
    shape : tuple of int
        Of the unconstrained numbers of one element.
    start, stop : int
    """

    name: str
    free: np.ndarray | None
    shape: Shape
    start: int
    stop: int


def parts_of(target: Target, names: Sequence[str], unconstrained: bool = True) -> list[Part]:
    """Where the numbers of each node stand in the vector of a block; names with parents first."""
    parts, start = [], 0
    for name in names:
        node = target.model[name]
        free = target.free_elements(name)
        support = some_support(target.model, name)
        shape = walked(support, node.event_shape, unconstrained).unconstrained_shape
        count = math.prod(node.plate_shape) if free is None else len(free)
        stop = start + count * math.prod(shape)
        parts.append(Part(name, free, shape, start, stop))
        start = stop
    return parts


def angles_of(target: Target, part: Part, unconstrained: bool) -> np.ndarray:
    """Which numbers of a part are angles, shape (stop - start,)."""
    support = some_support(target.model, part.name)
    one = turning(support, target.model[part.name].event_shape, unconstrained)
    return np.tile(one, (part.stop - part.start) // max(len(one), 1))


def may_be_drawn_anew(target: Target, names: Sequence[str]) -> bool:
    """Whether some nodes are all that is hidden, few numbers, each with a prior that can be drawn from.

    Angles are left out, which a mixture does not know to be such, and nodes that are seen in part.
    """
    nodes = [target.model[n] for n in names]
    if set(names) != set(target.chain) or any(n not in target.terms for n in names):
        return False
    if any(n.is_discrete or n.unsampled or target.seen(n.name) is not None for n in nodes):
        return False
    parts = parts_of(target, names)
    angles = (turned for part in parts for turned in angles_of(target, part, True))
    return parts[-1].stop <= _FEW and not any(angles)
