"""What a cloud of particles says of nodes and functions, with the weights of its slice."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.engines.averages import called
from bayesmc.engines.particles.cloud import Cloud, Layout
from bayesmc.errors import QueryError, UnknownNodeError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.reading import nodes_read
from bayesmc.results.posterior import circular_variance, quantile_levels, table_variance


def expectation(
    layout: Layout,
    cloud: Cloud,
    model: Model,
    function: Callable[..., Any],
    read: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> np.ndarray:
    """Weighted mean of a function's values as ``read`` has them, shape what one value has."""
    return weighted_mean(cloud, evaluated(layout, cloud, model, function, read))


def evaluated(
    layout: Layout,
    cloud: Cloud,
    model: Model,
    function: Callable[..., Any],
    read: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> np.ndarray:
    """A function's values as ``read`` has them, particles first."""
    arguments = []
    for name in nodes_read(function):
        if name not in cloud.values:
            raise UnknownNodeError(
                f"a query reads {name!r}, of which there are no particles; there are those of "
                f"{list(cloud.values)}"
            )
        node = model[name]
        shape = (len(cloud.weights), *node.value_shape)
        arguments.append(node.decode(np.broadcast_to(cloud.values[name], shape)))
    values = read(np.asarray(called(function, arguments)))
    if not values.ndim or len(values) != len(cloud.weights):
        raise QueryError(
            f"a query returns shape {values.shape}; it must return one value per particle, the axis of "
            f"{len(cloud.weights)} particles first"
        )
    if layout.apart and values.shape[1 : 1 + len(layout.apart)] != layout.lead:
        raise QueryError(
            f"a query returns shape {values.shape}; plates {layout.apart} are filtered separately, so their "
            "axes follow that of the particles"
        )
    return values


def elsewhere(
    layout: Layout, cloud: Cloud, model: Model, function: Callable[..., Any]
) -> Callable[[Mapping[str, np.ndarray]], np.ndarray | None]:
    """The function at values of a few who are not among the particles; None where it reads more of them."""

    def there(values: Mapping[str, np.ndarray]) -> np.ndarray | None:
        count = len(next(iter(values.values())))
        if not set(nodes_read(function)) <= values.keys():
            return None
        few = cloud._replace(values=dict(values), weights=np.ones(count))
        return evaluated(layout, few, model, function)

    return there


def weighted_mean(cloud: Cloud, values: np.ndarray) -> np.ndarray:
    """Mean of values that have the particles first, then the plates filtered separately."""
    lead = cloud.weights.reshape(cloud.weights.shape + (1,) * (values.ndim - cloud.weights.ndim))
    share = np.asarray(cloud.total)
    total = share.reshape(share.shape + (1,) * (values.ndim - 1 - share.ndim))
    return (lead * values).sum(axis=0) / total


def probability(
    layout: Layout, cloud: Cloud, model: Model, event: Callable[..., Any]
) -> np.ndarray:
    """Weighted share of the particles for which an event holds."""

    def counted(values: np.ndarray) -> np.ndarray:
        if values.dtype.kind != "b":
            raise QueryError(
                f"probability: the function returns {values.dtype} values, not booleans; use expectation"
            )
        return values.astype(float)

    return expectation(layout, cloud, model, event, counted)


def quantiles(
    layout: Layout, cloud: Cloud, node: CompiledNode, value: np.ndarray, q: Any
) -> np.ndarray:
    """Weighted quantiles of a node that is not made of labels, shape ``(*q.shape, *plates, *event)``."""
    levels = quantile_levels(node.name, q)
    numbers = np.broadcast_to(_values(node, value), (len(cloud.weights), *node.value_shape))
    if node.angles is not None:  # an order needs a cut: opposite the mean
        mean = mean_of(layout, cloud, node, value)
        near = mean + np.remainder(numbers - mean + np.pi, 2 * np.pi) - np.pi
        numbers = np.where(node.angles, near, numbers)
    at = [node.plates.index(p) for p in layout.apart if p in node.plates]
    shape = [1] * numbers.ndim
    for axis, size in zip(at, layout.lead, strict=False):
        shape[1 + axis] = size
    shape[0] = len(cloud.weights)
    weights = cloud.weights.transpose(0, *(1 + k for k in np.argsort(at))).reshape(shape)
    weights = np.broadcast_to(weights, numbers.shape)
    return np.quantile(numbers, levels, axis=0, weights=weights, method="inverted_cdf")


def covariance(
    layout: Layout, cloud: Cloud, found: Sequence[tuple[CompiledNode, np.ndarray]]
) -> np.ndarray:
    """Weighted covariances of all numbers of some nodes."""
    if not found:
        raise UnknownNodeError("cov(): name at least one node")
    if layout.apart:
        raise QueryError(
            f"cov: elements of plate {layout.apart[0]!r} are filtered separately, each with weights of its "
            "own; use var, or expectation of a product"
        )
    n = len(cloud.weights)
    columns = [
        np.broadcast_to(_values(node, value), (n, *node.value_shape)).reshape(n, -1)
        for node, value in found
    ]
    flat = np.concatenate(columns, axis=1).astype(float)
    shares = cloud.weights / cloud.total
    flat = flat - shares @ flat
    matrix = (flat * shares[:, None]).T @ flat
    return matrix[0, 0] if matrix.size == 1 else matrix


def table_of_states(
    layout: Layout, cloud: Cloud, node: CompiledNode, value: np.ndarray
) -> np.ndarray:
    """Probabilities of a finite node's states, shape ``(*plates, states)``."""
    assert node.domain is not None
    states = np.arange(node.domain.size)
    if value.ndim == len(node.value_shape):
        return (value[..., None] == states).astype(float)
    if not layout.apart and not node.plates:
        counts = np.bincount(value, cloud.weights, minlength=len(states))
        return counts / cloud.total
    hits = value[..., None] == states
    return _average(layout, cloud, node, hits.astype(float), 1)


def moments(layout: Layout, cloud: Cloud, node: CompiledNode, value: np.ndarray) -> tuple[Any, Any]:
    """Mean and variance of a node that is not finite, circular ones of angles, in blocks of particles."""
    if value.ndim == len(node.value_shape):
        return value, np.zeros(node.value_shape)
    if layout.apart:
        return _moments_apart(layout, cloud, node, value)
    if value.ndim == 1 and node.angles is None:
        return _of_numbers(layout, cloud, value)
    shape = value.shape[1:]
    flat = value.reshape(len(value), -1)
    angular = None
    if node.angles is not None:
        angular = np.broadcast_to(node.angles, shape).reshape(-1)
    mean, variance = _of_columns(layout, cloud, flat, angular)
    return mean.reshape(shape), variance.reshape(shape)


def mean_of(layout: Layout, cloud: Cloud, node: CompiledNode, value: np.ndarray) -> Any:
    """Mean of a node, shape ``(*plates, *event)``; circular for angles."""
    if node.domain is not None:
        return table_of_states(layout, cloud, node, value) @ _numbers(node)
    if value.ndim == len(node.value_shape):
        return value
    if node.angles is None:
        return _average(layout, cloud, node, value)
    return moments(layout, cloud, node, value)[0]


def variance_of(layout: Layout, cloud: Cloud, node: CompiledNode, value: np.ndarray) -> Any:
    """Variance of a node, shape ``(*plates, *event)``; for angles ``-2 log R``."""
    if node.domain is not None:
        return table_variance(table_of_states(layout, cloud, node, value), _numbers(node))
    return moments(layout, cloud, node, value)[1]


# ---- private ------------------------------------------------------------------------------------


def _moments_apart(
    layout: Layout, cloud: Cloud, node: CompiledNode, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same where plate elements have weights of their own."""
    mean = _average(layout, cloud, node, value)
    off = value - mean
    off *= off
    variance = _average(layout, cloud, node, off)
    if node.angles is not None:
        # angles of an event lie side by side on one axis, whatever its shape
        turning, more = value[..., node.angles], 1 - len(node.event_shape)
        cosine = _average(layout, cloud, node, np.cos(turning), more)
        sine = _average(layout, cloud, node, np.sin(turning, out=turning), more)
        mean[..., node.angles] = np.arctan2(sine, cosine)
        variance[..., node.angles] = circular_variance(cosine, sine)
    return mean, variance


def _of_numbers(layout: Layout, cloud: Cloud, value: np.ndarray) -> tuple[Any, Any]:
    """Of one number per particle."""
    first = second = centre = 0.0
    for low in range(0, len(value), layout.block):
        part, weights = value[low : low + layout.block], cloud.weights[low : low + layout.block]
        here = weights.dot(part)
        if low == 0:
            centre = _near_the_mean(cloud, here, part, weights)
        off = part - centre
        off *= off
        first, second = first + here, second + weights.dot(off)
    return _settled(layout, cloud, len(value), first, second, centre)


def _of_columns(
    layout: Layout, cloud: Cloud, flat: np.ndarray, angular: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Of each column; ``angular`` says which are angles."""
    first, second = np.zeros(flat.shape[1]), np.zeros(flat.shape[1])
    centre = np.zeros((flat.shape[1], 1))
    sine: Any = 0.0
    cosine: Any = 0.0
    for low in range(0, len(flat), layout.block):
        part, weights = flat[low : low + layout.block], cloud.weights[low : low + layout.block]
        # whatever goes along a short last axis is ten times slower
        rows = np.array(part.T, dtype=float, order="C" if len(part) > part.shape[1] else "F")
        here = rows.dot(weights)
        if low == 0:
            centre = _near_the_mean(cloud, here, part, weights)[:, None]
        first += here
        if angular is not None:
            up, along = _turned(rows[angular], weights)
            sine, cosine = sine + up, cosine + along
        rows -= centre
        rows *= rows
        second += rows.dot(weights)
    mean, variance = _settled(layout, cloud, len(flat), first, second, centre[:, 0])
    if angular is not None:
        sine, cosine = sine / cloud.total, cosine / cloud.total
        mean[angular] = np.arctan2(sine, cosine)
        variance[angular] = circular_variance(cosine, sine)
    return mean, variance


def _near_the_mean(cloud: Cloud, here: Any, part: np.ndarray, weights: np.ndarray) -> Any:
    """The mean of the first block, about which squares do not cancel."""
    share = cloud.total if len(part) == len(cloud.weights) else weights.sum()
    return here / share if share > 0 else part[0]


def _settled(
    layout: Layout, cloud: Cloud, n: int, first: Any, second: Any, centre: Any
) -> tuple[Any, Any]:
    """Mean and variance of sums of values and of squares about a centre."""
    mean, variance = first / cloud.total, second / cloud.total
    if n > layout.block:
        variance = np.maximum(variance - (mean - centre) ** 2, 0.0)
    return mean, variance


def _turned(angles: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sums of the sines and cosines of rows of angles.

    Both from the tangent of the half angle, since what costs is calling such functions.
    """
    tangent = np.tan(0.5 * angles)
    square = tangent * tangent
    weighted = weights / (1.0 + square)  # cos = (1 - t^2) / (1 + t^2), sin = 2 t / (1 + t^2)
    tangent *= weighted
    square *= weighted
    return 2.0 * tangent.sum(axis=-1), weighted.sum(axis=-1) - square.sum(axis=-1)


def _average(
    layout: Layout, cloud: Cloud, node: CompiledNode, value: np.ndarray, more: int = 0
) -> Any:
    """Weighted mean over particles; ``more`` axes follow the event's."""
    if not layout.apart:
        flat = cloud.weights @ value.reshape(len(value), -1) if value.ndim > 1 else None
        if flat is None:
            return cloud.weights @ value / cloud.total
        return (flat / cloud.total).reshape(value.shape[1:])
    order = [p for p in node.plates if p in layout.apart]
    axes = [layout.apart.index(p) for p in order]
    shape = [
        n if p in layout.apart else 1 for p, n in zip(node.plates, node.plate_shape, strict=True)
    ]
    tail = [1] * (len(node.event_shape) + more)
    weights = cloud.weights.transpose(0, *(1 + a for a in axes)).reshape(len(value), *shape, *tail)
    total = cloud.total.transpose(axes).reshape(*shape, *tail)
    return (weights * value).sum(axis=0) / total


def _values(node: CompiledNode, value: np.ndarray) -> np.ndarray:
    return value if node.domain is None else _numbers(node)[value]


def _numbers(node: CompiledNode) -> np.ndarray:
    assert node.domain is not None
    if node.domain.labels is not None:
        raise QueryError(f"{node.name!r} has labels, which have no mean; use probabilities")
    return np.asarray(node.domain.numbers, dtype=float)
