"""Answers about nodes of whose numbers particles agree on most: only the others are worked out for each.

Elements of a plate that a filter integrates out one by one and has not read yet are the same for all of its
particles, however many there are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.blocks import Block
from bayesmc.engines.particles.errors import ByFamily, node_errors
from bayesmc.engines.particles.smc import Particles
from bayesmc.network import CompiledNode


class SomeNumbers(NamedTuple):
    """Some of a node's numbers, as if they were a vector node of their own.

    Attributes
    ----------
    node : CompiledNode
    numbers : ndarray of int, shape (k,)
        Flat places.
    """

    node: CompiledNode
    numbers: np.ndarray
    plates: tuple[str, ...] = ()
    domain: None = None
    angles: None = None

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def value_shape(self) -> tuple[int, ...]:
        return self.numbers.shape

    @property
    def event_shape(self) -> tuple[int, ...]:
        return self.numbers.shape


def some_numbers(slices: Sequence[Particles], node: CompiledNode) -> np.ndarray | None:
    """Flat places of a node's numbers about which particles of some slices may differ; None where all may."""
    found = []
    for p in slices:
        told = getattr(p.inner, "numbers", None)
        if told is None or p.weights.ndim > 1 or node.name not in p.inner.layout.rows:
            return None
        own = told(node)
        if own is None:
            return None
        found.append(own)
    return np.unique(np.concatenate(found))


def answers_of(
    block: Block, by: ByFamily | None, node: CompiledNode, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, variances and errors of means, shape ``(slices, *plates, *event)``."""
    count = len(block.slices)
    means, variances = np.empty((2, count, math.prod(node.value_shape)))
    first = block.slices[0].inner
    means[0], variances[0] = (a.reshape(-1) for a in first.agreed(node))
    for k in range(1, count):  # what nothing has written since is not worked out again
        inner, earlier = block.slices[k].inner, block.slices[k - 1].inner
        means[k], variances[k] = means[k - 1], variances[k - 1]
        some, mean, variance = inner.agreed_since(earlier, node)
        means[k, some], variances[k, some] = mean, variance
    errors = np.zeros(means.shape)
    if len(numbers):
        own: CompiledNode = SomeNumbers(node, numbers)  # type: ignore[assignment]
        found = block.mean_and_variance(own)
        means[:, numbers], variances[:, numbers] = found
        if by is not None:
            errors[:, numbers] = node_errors(by, block, own)
    shape = (count, *node.value_shape)
    return means.reshape(shape), variances.reshape(shape), errors.reshape(shape)


def numbers_of(particles: Particles, node: CompiledNode) -> int:
    """How many numbers are worked out of a node."""
    held = dict.get(
        particles.values, node.name
    )  # without drawing what is drawn once it is looked at
    if held is not None:
        return int(held.size)
    some = some_numbers([particles], node)
    count = math.prod(node.value_shape) if some is None else len(some)
    return count * len(particles.weights)


def write_agreed(rows: Any, block: Block, by: ByFamily | None, node: CompiledNode) -> bool:
    """Write answers about a node where particles agree on most of it; whether they do."""
    some = some_numbers(block.slices, node)
    if some is None:
        return False
    found = answers_of(block, by, node, some)
    for what, own in zip(("means", "variances", "errors"), found, strict=True):
        if by is not None or what != "errors":
            rows[what][node.name] = own
    return True
