"""The full conditional of one variable: the product of the factors on its Markov blanket, normalised.

For teaching and debugging: it evaluates whole batches of factors at every candidate value. Engines have
their own ways to the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.distributions import Categorical, Density, Distribution, InverseCdf
from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.support import Support
from bayesmc.errors import ParameterError, ZeroProbabilityError
from bayesmc.network.factor_scope import Scope
from bayesmc.network.graph_view import GraphView, Values
from bayesmc.network.model import CompiledNode, Model
from bayesmc.shapes import Shape, broadcast_shapes

#: factor values up to which candidates are evaluated in one call
_AT_ONCE = 1 << 22


def full_conditional(
    view: GraphView, name: str, state: Mapping[str, Any], element: int | None
) -> Distribution:
    """See ``FactorGraph.full_conditional``; ``element`` is flat, None for all elements at once."""
    call = f"full_conditional({name!r})"
    node = view.model[name]
    alone = element is None or node.value_shape == node.event_shape
    values, batch = view.stored(call, state, name if alone else None)
    kernel = _Kernel(view, node, values, batch, element)
    if node.domain is not None:
        return _categorical(call, view, kernel)
    support = kernel.support()
    density = Density(kernel, None, node.event_shape, support, batch_shape=kernel.batch)
    if node.event_shape or node.is_discrete:
        return density
    middle = _mode(kernel, support)
    kernel.measure_from(middle)
    return InverseCdf(density, points=() if kernel.batch else middle)


# ---- private ------------------------------------------------------------------------------------


class _Kernel:
    """The unnormalised log full conditional as a function of stored candidates.

    Candidates have shape ``(*lead, *batch, *event)``, where ``batch`` holds the state's batch and, when all
    elements are asked for at once, the plates.
    """

    def __init__(
        self,
        view: GraphView,
        node: CompiledNode,
        values: Values,
        batch: Shape,
        element: int | None,
    ) -> None:
        self.view, self.node, self.element = view, node, element
        self.values, self.outer = values, batch
        self.batch = batch if element is not None else batch + node.plate_shape
        self.scopes = [s for s in view.scopes if node.name in s.reads]
        self._below = _below(view.model, node.name)
        self._zero: dict[str, np.ndarray] = {}
        with marking_invalid(), np.errstate(all="ignore"):
            self._prepare()

    def __call__(self, candidates: np.ndarray) -> np.ndarray:
        """Log density, shape ``(*lead, *batch)``."""
        candidates = np.asarray(candidates)
        event = len(self.node.event_shape)
        cut = candidates.ndim - event
        full = broadcast_shapes(candidates.shape[:cut], self.batch)
        spread = np.broadcast_to(candidates, full + candidates.shape[cut:])
        lead = full[: len(full) - len(self.batch)]
        flat = spread.reshape((-1, *self.batch, *candidates.shape[cut:]))
        most = max((math.prod(s.shape) for s in self.scopes), default=1)
        step = max(1, _AT_ONCE // max(most * math.prod(self.outer), 1))
        parts = [self._log(flat[k : k + step]) for k in range(0, len(flat), step)]
        return np.concatenate(parts).reshape(lead + self.batch) if parts else np.zeros(full)

    def support(self) -> Support:
        """The support of the variable given the state."""
        node = self.node
        if node.support is not None:
            return node.support
        with marking_invalid(), np.errstate(all="ignore"):
            dist, _ = self.view.model.evaluate(node.name, self.values)
        support = dist.support
        low, high = (self._bound(bound) for bound in (support.low, support.high))
        return replace(support, low=low, high=high)

    def _bound(self, bound: Any) -> np.ndarray:
        """A bound that depends on other variables, for the elements that are asked for."""
        each = np.broadcast_to(bound, self.outer + self.node.plate_shape)
        if self.element is None:
            return each
        return each.reshape((*self.outer, -1))[..., self.element]

    def measure_from(self, point: np.ndarray) -> None:
        """Give densities relative to those at a point, factor by factor.

        Sums of many logs lose digits that an integral to ten digits needs; differences near the point do not.
        """
        self._log(point[None], self._zero)

    def _prepare(self) -> None:
        """Evaluate what does not depend on the variable."""
        for name, node in self.view.model.nodes.items():
            if not node.is_stochastic and node.kind != "input" and name not in self._below:
                self.values[name], _ = self.view.model.evaluate(name, self.values)

    def _log(self, candidates: np.ndarray, keep: dict[str, np.ndarray] | None = None) -> np.ndarray:
        """Log density for candidates with one lead axis; the factors' logs go to ``keep``, if given."""
        model, name = self.view.model, self.node.name
        values = {**self.values, name: self._placed(candidates)}
        lead = (len(candidates), *self.outer)
        total: Any = np.zeros((len(candidates), *self.batch))
        impossible: Any = False
        problems: list[tuple[str, np.ndarray, str | None]] = []
        with marking_invalid(), np.errstate(all="ignore"):
            for computed in self._below:
                values[computed], _ = model.evaluate(computed, values)
            for scope in self.scopes:
                if scope.kind == "potential":
                    log = model.potential(scope.name, values, total=False)
                else:
                    dist, _ = model.evaluate(scope.name, values)
                    log = model.log_density(scope.name, dist, values[scope.name])
                    if dist.invalid is not None:
                        bad = np.broadcast_to(dist.invalid, lead + scope.shape)
                        mark = self._per_element(scope, bad.astype(float)) > 0
                        problems.append((scope.name, mark, dist.problem))
                        impossible = impossible | mark
                        log = np.where(dist.invalid, 0.0, log)
                if keep is not None:
                    log = np.broadcast_to(log, lead + scope.shape)[0]
                    keep[scope.name] = np.where(np.isfinite(log), log, 0.0)
                    continue
                log = log - self._zero.get(scope.name, 0.0)
                total = total + self._per_element(scope, np.broadcast_to(log, lead + scope.shape))
        self._refuse(problems, total)
        return np.where(impossible, -np.inf, total)

    def _refuse(self, problems: list[tuple[str, np.ndarray, str | None]], total: Any) -> None:
        """Bad parameters at a state that is possible are heard of; far out on the line they are not."""
        if self.node.domain is None:
            return
        for name, mark, problem in problems:
            if (mark & (total > -np.inf)).any():
                raise ParameterError(
                    f"full_conditional({self.node.name!r}): node {name!r}: {problem}, at a state of "
                    f"{self.node.name!r} that is possible"
                )

    def _placed(self, candidates: np.ndarray) -> np.ndarray:
        """The variable's stored values with the candidates in place."""
        node = self.node
        if self.element is None:
            return candidates
        event = candidates.shape[candidates.ndim - len(node.event_shape) :]
        count = math.prod(node.plate_shape)
        shape = (len(candidates), *self.outer)
        if node.name in self.values:
            current = np.broadcast_to(self.values[node.name], shape + node.value_shape)
            placed = current.astype(np.result_type(current, candidates))
        else:
            placed = np.empty(shape + node.value_shape, dtype=candidates.dtype)
        rows = placed.reshape((*shape, count, *event))
        rows[(Ellipsis, self.element) + (slice(None),) * len(event)] = candidates
        return rows.reshape(shape + node.value_shape)

    def _per_element(self, scope: Scope, log: np.ndarray) -> np.ndarray:
        """A batch of log factors summed for every element of the variable that is asked for."""
        lead = log.ndim - len(scope.shape)
        flat = log.reshape((*log.shape[:lead], -1))
        reads = scope.reads[self.node.name]
        if self.element is not None:
            rows = reads.rows_with(self.element)
            return (flat if rows is None else flat[..., rows]).sum(axis=-1)
        if not self.node.plates:
            return flat.sum(axis=-1)
        assert reads.columns is not None
        count = math.prod(self.node.plate_shape)
        if np.array_equal(reads.columns[0], np.arange(count)):
            summed = flat
        else:
            summed = np.zeros((*flat.shape[:-1], count))
            np.add.at(summed.T, reads.columns[0], flat.T)
        return summed.reshape(log.shape[:lead] + self.node.plate_shape)


def _mode(kernel: _Kernel, support: Support) -> np.ndarray:
    """About where the density is largest, shape the kernel's batch: a grid, and finer ones within it."""
    if support.kind == "interval":
        low, high = np.asarray(support.low, dtype=float), np.asarray(support.high, dtype=float)
    else:
        reach = np.pi if support.kind == "circle" else np.inf
        low, high = np.asarray(-reach), np.asarray(reach)
    lead = (-1,) + (1,) * len(kernel.batch)
    steps = np.linspace(-20.0, 20.0, 401).reshape(lead)
    bounded = np.isfinite(low), np.isfinite(high)
    if bounded[0].all() and bounded[1].all():
        grid = low + (high - low) / (1 + np.exp(-steps))
    elif bounded[0].all():
        grid = low + np.exp(steps)
    else:
        grid = high - np.exp(steps) if bounded[1].all() else np.sinh(steps)
    grid = np.broadcast_to(grid, (len(grid), *kernel.batch))
    for _ in range(8):
        best = np.argmax(kernel(grid), axis=0)[None]
        left = np.take_along_axis(grid, np.maximum(best - 1, 0), 0)
        right = np.take_along_axis(grid, np.minimum(best + 1, len(grid) - 1), 0)
        found = np.take_along_axis(grid, best, 0)[0]
        grid = left + (right - left) * np.linspace(0.0, 1.0, 17).reshape(lead)
    return found


def _below(model: Model, name: str) -> list[str]:
    """Deterministic nodes that are computed from a node, parents first."""
    found = {name}
    below = []
    for other, node in model.nodes.items():
        if node.kind == "deterministic" and found & set(node.parents):
            found.add(other)
            below.append(other)
    return below


def _categorical(call: str, view: GraphView, kernel: _Kernel) -> Categorical:
    """The normalised table of a finite variable; observed elements of a plate are certain."""
    node = kernel.node
    assert node.domain is not None
    states = np.arange(node.domain.size)
    log = kernel(states.reshape((-1,) + (1,) * len(kernel.batch)))
    log = np.moveaxis(log, 0, -1)
    top = log.max(axis=-1, keepdims=True)
    seen = view.observed.get(node.name)
    known = None
    if kernel.element is None and seen is not None and seen.mask is not None:
        known = seen.mask
    empty = np.isneginf(top[..., 0])
    if (empty if known is None else empty & ~known).any():
        raise ZeroProbabilityError(
            f"{call}: no state has positive probability given the others in state; check that the factors "
            "allow what state= holds"
        )
    weights = np.exp(log - np.where(np.isneginf(top), 0.0, top))
    if known is not None and seen is not None:
        certain = (seen.value[..., None] == states).astype(float)
        weights = np.where(known[..., None], certain, weights)
    return Categorical(weights / weights.sum(axis=-1, keepdims=True))
