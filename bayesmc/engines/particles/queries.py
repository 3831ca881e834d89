"""What the particles of a slice say of functions, of quantiles and of covariances, by their weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.engines.averages import called
from bayesmc.engines.particles.blocks import Block
from bayesmc.engines.particles.genealogy import Families
from bayesmc.engines.particles.particles import Layout, Particles
from bayesmc.errors import QueryError, UnknownNodeError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.node import nodes_read
from bayesmc.results.posterior import quantile_levels


def expectation(
    layout: Layout,
    particles: Particles,
    model: Model,
    function: Callable[..., Any],
    read: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> np.ndarray:
    """Weighted mean of a function's values as ``read`` has them, shape what one value has."""
    return weighted_mean(particles, evaluated(layout, particles, model, function, read))


def evaluated(
    layout: Layout,
    particles: Particles,
    model: Model,
    function: Callable[..., Any],
    read: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> np.ndarray:
    """A function's values as ``read`` has them, particles first."""
    arguments = []
    for name in nodes_read(function):
        if name not in particles.values:
            raise UnknownNodeError(
                f"a query reads {name!r}, of which there are no particles; there are those of "
                f"{list(particles.values)}"
            )
        node = model[name]
        shape = (len(particles.weights), *node.value_shape)
        arguments.append(node.decode(np.broadcast_to(particles.values[name], shape)))
    values = read(np.asarray(called(function, arguments)))
    if not values.ndim or len(values) != len(particles.weights):
        raise QueryError(
            f"a query returns shape {values.shape}; it must return one value per particle, the axis of "
            f"{len(particles.weights)} particles first"
        )
    if layout.apart and values.shape[1 : 1 + len(layout.apart)] != layout.lead:
        raise QueryError(
            f"a query returns shape {values.shape}; plates {layout.apart} are filtered separately, so their "
            "axes follow that of the particles"
        )
    return values


def at_scouts(
    layout: Layout,
    particles: Particles,
    families: Families,
    model: Model,
    function: Callable[..., Any],
) -> np.ndarray | None:
    """A function at values of those who are where no particle is; None where it reads more of them."""
    if families.scouts is None or not set(nodes_read(function)) <= families.scouts.values.keys():
        return None
    values = dict(families.scouts.values)
    count = len(next(iter(values.values())))
    few = particles._replace(values=values, weights=np.ones(count))
    return evaluated(layout, few, model, function)


def weighted_mean(particles: Particles, values: np.ndarray) -> np.ndarray:
    """Mean of values that have the particles first, then the plates filtered separately."""
    lead = particles.weights.reshape(
        particles.weights.shape + (1,) * (values.ndim - particles.weights.ndim)
    )
    share = np.asarray(particles.total)
    total = share.reshape(share.shape + (1,) * (values.ndim - 1 - share.ndim))
    return (lead * values).sum(axis=0) / total


def probability(
    layout: Layout, particles: Particles, model: Model, event: Callable[..., Any]
) -> np.ndarray:
    """Weighted share of the particles for which an event holds."""

    def counted(values: np.ndarray) -> np.ndarray:
        if values.dtype.kind != "b":
            raise QueryError(
                f"probability: the function returns {values.dtype} values, not booleans; use expectation"
            )
        return values.astype(float)

    return expectation(layout, particles, model, event, counted)


def quantiles(
    layout: Layout, particles: Particles, node: CompiledNode, value: np.ndarray, q: Any
) -> np.ndarray:
    """Weighted quantiles of a node that is not made of labels, shape ``(*q.shape, *plates, *event)``."""
    levels = quantile_levels(node.name, q)
    numbers = np.broadcast_to(_values(node, value), (len(particles.weights), *node.value_shape))
    if node.angles is not None:  # an order needs a cut: opposite the mean
        mean = Block(layout, [particles]).mean_and_variance(node)[0][0]
        near = mean + np.remainder(numbers - mean + np.pi, 2 * np.pi) - np.pi
        numbers = np.where(node.angles, near, numbers)
    at = [node.plates.index(p) for p in layout.apart if p in node.plates]
    shape = [1] * numbers.ndim
    for axis, size in zip(at, layout.lead, strict=False):
        shape[1 + axis] = size
    shape[0] = len(particles.weights)
    weights = particles.weights.transpose(0, *(1 + k for k in np.argsort(at))).reshape(shape)
    weights = np.broadcast_to(weights, numbers.shape)
    return np.quantile(numbers, levels, axis=0, weights=weights, method="inverted_cdf")


def covariance(
    layout: Layout, particles: Particles, found: Sequence[tuple[CompiledNode, np.ndarray]]
) -> np.ndarray:
    """Weighted covariances of all numbers of some nodes."""
    if not found:
        raise UnknownNodeError("cov(): name at least one node")
    if layout.apart:
        raise QueryError(
            f"cov: elements of plate {layout.apart[0]!r} are filtered separately, each with weights of its "
            "own; use var, or expectation of a product"
        )
    n = len(particles.weights)
    columns = [
        np.broadcast_to(_values(node, value), (n, *node.value_shape)).reshape(n, -1)
        for node, value in found
    ]
    flat = np.concatenate(columns, axis=1).astype(float)
    shares = particles.weights / particles.total
    flat = flat - shares @ flat
    matrix = (flat * shares[:, None]).T @ flat
    return matrix[0, 0] if matrix.size == 1 else matrix


# ---- private ------------------------------------------------------------------------------------


def _values(node: CompiledNode, value: np.ndarray) -> np.ndarray:
    return value if node.domain is None else numbers_of(node)[value]


def numbers_of(node: CompiledNode) -> np.ndarray:
    """The numbers that a finite node's states stand for.

    Raises
    ------
    QueryError
    """
    assert node.domain is not None
    if node.domain.labels is not None:
        raise QueryError(f"{node.name!r} has labels, which have no mean; use probabilities")
    return np.asarray(node.domain.numbers, dtype=float)
