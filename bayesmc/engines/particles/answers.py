"""What the particles of some slices say of functions, of quantiles and of covariances, slice by slice."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.averages import as_event, called
from bayesmc.engines.marginal.mixtures import covariance_within, mixture_quantiles
from bayesmc.engines.marginal.tables.answers import table_covariance, table_quantiles
from bayesmc.engines.particles.blocks import Block, has_table
from bayesmc.engines.particles.errors import ByFamily, Variances, function_errors, node_errors
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.smc import Layout, Particles
from bayesmc.errors import QueryError, UnknownNodeError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.node import nodes_read
from bayesmc.results.laws import DrawnLaws, Laws, SliceLaws, curve_between
from bayesmc.results.posterior import quantile_levels
from bayesmc.results.series import numbers_of_states


class Answers(NamedTuple):
    """Particles of slices, and what their errors are told by; all answers have the slices first."""

    layout: Layout
    model: Model
    particles: list[Particles]
    families: list[Families]
    #: of trajectories that were drawn backwards
    sharing: Variances | None = None

    def expectation(
        self, function: Callable[..., Any], read: Callable[[Any], Any] = np.asarray
    ) -> np.ndarray:
        """Weighted means of a function's values as ``read`` has them, ``(slices, *what one value has)``."""
        return np.stack([self._mean(p, read(self._at(p, function))) for p in self.particles])

    def probability(self, event: Callable[..., Any]) -> np.ndarray:
        """Weighted shares of the particles for which an event holds."""
        return self.expectation(event, as_event)

    def mcse(self, function: Callable[..., Any]) -> np.ndarray:
        """Errors of a function's means."""
        values = [self._at(p, function) for p in self.particles]
        if self.sharing is not None:
            block = Block(self.layout, self.particles)
            return function_errors(self.sharing, block, values, [])
        found = []
        for own, families, value in zip(self.particles, self.families, values, strict=True):
            there = at_scouts(self.layout, own, families, self.model, function)
            block = Block(self.layout, [own])
            found.append(function_errors(ByFamily(block, [families]), block, [value], [there])[0])
        return np.stack(found)

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles of a node that is not made of labels, shape ``(slices, *q.shape, *plates, *event)``."""
        node, levels = self.model[name], quantile_levels(name, q)
        return np.stack([self._quantiles(p, node, levels) for p in self.particles])

    def cov(self, *names: str) -> np.ndarray:
        """Weighted covariances of all numbers of some nodes; of one number, its variance."""
        if not names:
            raise UnknownNodeError("cov(): name at least one node")
        if self.layout.apart:
            raise QueryError(
                f"cov: elements of plate {self.layout.apart[0]!r} are filtered separately, each with weights "
                "of its own; use var, or expectation of a product"
            )
        return np.stack([self._covariance(p, names) for p in self.particles])

    def node_errors(
        self, nodes: Sequence[CompiledNode], filtered: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Errors of nodes of trajectories: infinite where the filter's are."""
        assert self.sharing is not None
        block, found = Block(self.layout, self.particles, whole=True), {}
        for node in nodes:
            errors = node_errors(self.sharing, block, node)
            found[node.name] = np.where(np.isinf(filtered[node.name]), np.inf, errors)
        return found

    def stacked(self, node: CompiledNode) -> np.ndarray:
        """Particles of all slices, shape ``(slices, particles, *plates, *event)``."""
        shape = (self.layout.particles, *node.value_shape)
        rows = [np.broadcast_to(p.values[node.name], shape) for p in self.particles]
        return np.array(node.decode(np.stack(rows)), subok=True)

    def weights(self) -> np.ndarray:
        """Normalised weights of all slices."""
        return np.stack([p.weights / p.total for p in self.particles])

    def ancestors(self) -> np.ndarray:
        """Positions of ancestors in the slices before; -1 for particles that were drawn anew."""
        shape = (self.layout.particles, *self.layout.lead)
        own = np.arange(shape[0]).reshape((-1,) + (1,) * len(self.layout.apart))
        rows = []
        for p in self.particles:
            found = own if p.ancestors is None else p.ancestors
            rows.append(np.broadcast_to(np.where(p.rejuvenated, -1, found), shape))
        return np.stack(rows)

    # ---- private -------------------------------------------------------------------------------

    def _at(self, particles: Particles, function: Callable[..., Any]) -> np.ndarray:
        return evaluated(self.layout, particles, self.model, function)

    def _mean(self, particles: Particles, values: np.ndarray) -> np.ndarray:
        """Mean of values that have the particles first, then the plates filtered separately."""
        more = (1,) * (values.ndim - particles.weights.ndim)
        total = np.asarray(particles.total)
        weights = particles.weights.reshape(particles.weights.shape + more)
        return (weights * values).sum(axis=0) / total.reshape(total.shape + more)

    def _numbers(self, particles: Particles, node: CompiledNode, what: str = "mean") -> np.ndarray:
        """A node's values, of labels none, with an axis of particles."""
        value = particles.values[node.name]
        value = value if node.domain is None else numbers_of_states(node, what)[value]
        return np.broadcast_to(value, (len(particles.weights), *node.value_shape))

    def _means(self, particles: Particles, node: CompiledNode) -> np.ndarray:
        """The same; of what is integrated out each particle's own mean."""
        if has_table(particles, node):
            return np.asarray(particles.tables.probabilities(node.name) @ numbers_of_states(node))
        inner = particles.inner
        if inner is not None and inner.has(node.name):
            return np.asarray(inner.mean_of(node))
        return self._numbers(particles, node)

    def laws(self, name: str) -> Laws:
        """The distribution of every number of a node, slice by slice."""
        node = self.model[name]
        found: list[Laws] = []
        for now in self.particles:
            numbers, weights = self._placed(now, node)
            if now.inner is not None and now.inner.has(name) or has_table(now, node):

                def quantile(q: np.ndarray, now: Particles = now) -> np.ndarray:
                    return self._quantiles(now, node, q)

                found.append(curve_between(numbers.shape[1:], quantile))
                continue
            total = weights.sum(axis=0, keepdims=True)
            found.append(DrawnLaws(numbers, weights / total, node.is_discrete))
        return SliceLaws(found)

    def _quantiles(self, now: Particles, node: CompiledNode, levels: Any) -> np.ndarray:
        numbers, weights = self._placed(now, node)
        if has_table(now, node):
            return table_quantiles(now.tables, node.name, numbers_of_states(node), weights, levels)
        if now.inner is not None and now.inner.has(node.name):
            return mixture_quantiles(now.inner, node, weights, levels)
        return np.quantile(numbers, levels, axis=0, weights=weights, method="inverted_cdf")

    def _placed(self, now: Particles, node: CompiledNode) -> tuple[np.ndarray, np.ndarray]:
        """A node's numbers in one slice, angles near their mean, and a weight for each."""
        layout, numbers = self.layout, self._numbers(now, node, "quantile")
        if node.angles is not None:  # an order needs a cut: opposite the mean
            mean = Block(layout, [now]).mean_and_variance(node)[0][0]
            near = mean + np.remainder(numbers - mean + np.pi, 2 * np.pi) - np.pi
            numbers = np.where(node.angles, near, numbers)
        at = [node.plates.index(p) for p in layout.apart if p in node.plates]
        shape = [len(now.weights)] + [1] * (numbers.ndim - 1)
        for axis, size in zip(at, layout.lead, strict=False):
            shape[1 + axis] = size
        weights = now.weights.transpose(0, *(1 + k for k in np.argsort(at))).reshape(shape)
        return numbers, np.broadcast_to(weights, numbers.shape)

    def _covariance(self, now: Particles, names: tuple[str, ...]) -> np.ndarray:
        n = len(now.weights)
        columns = [self._means(now, self.model[name]).reshape(n, -1) for name in names]
        flat, shares = np.concatenate(columns, axis=1).astype(float), now.weights / now.total
        flat = flat - shares @ flat
        matrix = (flat * shares[:, None]).T @ flat
        nodes = [self.model[name] for name in names]
        if now.inner is not None and any(now.inner.has(name) for name in names):
            matrix += covariance_within(now.inner, nodes, shares)
        if now.tables is not None:
            numbers = {n.name: numbers_of_states(n) for n in nodes if has_table(now, n)}
            matrix += table_covariance(now.tables, nodes, numbers, shares)
        return matrix[0, 0] if matrix.size == 1 else matrix


def evaluated(
    layout: Layout,
    particles: Particles,
    model: Model,
    function: Callable[..., Any],
) -> np.ndarray:
    """A function's values, particles first."""
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
    values = np.asarray(called(function, arguments))
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
