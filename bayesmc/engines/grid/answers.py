"""What a belief on a grid says: moments, tables and densities of nodes, expectations of functions."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.engines.grid.moves import COUNTS
from bayesmc.engines.grid.slice import Placed, Scalar
from bayesmc.engines.grid.sources import is_previous, previous
from bayesmc.engines.grid.tables import GridModel
from bayesmc.engines.grid.terms import Label, Term, contract, dense
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network import CompiledNode
from bayesmc.results.posterior import circular_variance

Moments = tuple[np.ndarray, np.ndarray]


class Answers:
    """Answers about one slice.

    Parameters
    ----------
    model : GridModel
    before : Placed or None
        The slice before, for nodes that read it.
    now : Placed
    probs : ndarray, shape (*cells, *apart)
        Probabilities of the cells of this slice.
    pair : callable
        Terms whose product is the joint belief about the slice before and this one.
    """

    def __init__(
        self,
        model: GridModel,
        before: Placed | None,
        now: Placed,
        probs: np.ndarray,
        pair: Callable[[], list[Term]],
    ) -> None:
        self.model, self.before, self.now, self.pair = model, before, now, pair
        self.first = now.row.t == 0
        self.own = Term((*now.labels, *model.apart), probs)
        self.base = model.base(before, now)

    def table(self, name: str) -> np.ndarray:
        """Probabilities of a finite node's states, shape ``(*plates, states)``."""
        node = self._node(name)
        assert node.domain is not None
        states = np.arange(node.domain.size)
        value = self._value(name)
        if value is not None:
            hits = (value[..., None] == states).astype(float)
            return self._average(node, hits, 1)
        dist = self.model.evaluate(self.first, name, self.base)
        self._refuse_bad(node, dist)
        found = self._average(node, dist.probs_table, 1)
        seen = self.now.row.seen.get(name)
        if seen is None or seen.mask is None:
            return found
        return np.where(seen.mask[..., None], seen.value[..., None] == states, found)

    def moments(self, name: str) -> Moments | None:
        """Mean and variance of a node of numbers; None for one whose density has no closed ones."""
        node = self._node(name)
        value = self._value(name)
        if node.domain is not None and value is not None:
            if node.domain.labels is not None:
                return None
            value = node.decode(value)
        if value is not None:
            return self._moments(node, value, None)
        try:
            dist = self.model.evaluate(self.first, name, self.base)
            self._refuse_bad(node, dist)
            mean, var = self._moments(node, dist.mean, dist.var)
        except UnsupportedError:
            return None
        seen = self.now.row.seen.get(name)
        if seen is None or seen.mask is None:
            return mean, var
        mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
        return np.where(mask, seen.value, mean), np.where(mask, 0.0, var)

    def density(self, name: str) -> np.ndarray:
        """A node's density over its axes, shape ``(*plates, *cells)``; NaN where it is seen.

        Isolated values have probabilities.
        """
        node, model = self._node(name), self.model
        axes = model.axes.of[name]
        cells = tuple(a.size for a in axes)
        inner = [
            1 if p in model.apart else n for p, n in zip(node.plates, node.plate_shape, strict=True)
        ]
        out = np.full((*node.plate_shape, *cells), np.nan)
        held = {s.label: s for s in self.now.scalars}
        order = [model.apart.index(p) for p in node.plates if p in model.apart]
        events = math.prod(node.event_shape)
        for number, plates in enumerate(np.ndindex(*inner)):
            labels: list[Label] = [(name, number * events + k) for k in range(events)]
            if not all(label in held for label in labels):
                continue
            shape = (*cells, *model.lead)
            table = dense(
                contract([self.own], (*labels, *model.apart)), (*labels, *model.apart), shape
            )
            for k, label in enumerate(labels):
                widths = held[label].widths
                ones = (1,) * k, (1,) * (events - 1 - k)
                table = table / widths.reshape(*ones[0], len(widths), *ones[1], *widths.shape[1:])
            table = table.transpose(*(events + a for a in order), *range(events))
            at = tuple(
                slice(None) if p in model.apart else k
                for p, k in zip(node.plates, plates, strict=True)
            )
            out[at] = table
        seen = self.now.row.seen.get(name)
        if seen is not None and seen.mask is not None:
            out[seen.mask] = np.nan
        return out

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Mean of a function of nodes of the slice, whose arguments have a leading axis of cells."""
        names = list(inspect.signature(function).parameters)
        values = {}
        for name in names:
            if name not in self.model.slices.dynamic and name not in self.model.static:
                raise UnknownNodeError(f"a query reads {name!r}, which is no node of a slice")
            value = self._value(name)
            if value is None:
                raise QueryError(
                    f"a query reads {name!r}, which is hidden and not on the grid, since nothing depends on "
                    f"it; give it one, grid={{{name!r}: (low, high, cells)}}"
                )
            values[name] = value
        count = self._batch
        labels = self._used([(self._node(n), v, 0) for n, v in values.items()])
        sizes = self._sizes()
        grid = tuple(sizes[x] if x in labels else 1 for x in self._labels())
        cells = math.prod(grid)
        arguments = []
        for name, value in values.items():
            node = self._node(name)
            lead = value.ndim - len(node.value_shape)
            full = (1,) * (count - lead) + value.shape
            shape = (*grid, *node.value_shape)
            wide = np.broadcast_to(value.reshape(full), shape).reshape(cells, *node.value_shape)
            arguments.append(node.decode(wide))
        result = np.asarray(function(*arguments), dtype=float)
        apart = self.model.lead
        if result.shape[: 1 + len(apart)] != (cells, *apart):
            more = f", the plates {self.model.apart} next" if apart else ""
            raise QueryError(
                f"a query returns shape {result.shape}; it must return one value per cell, the axis of "
                f"{cells} cells first{more}"
            )
        weights = self._marginal(labels).reshape(
            (cells, *apart) + (1,) * (result.ndim - 1 - len(apart))
        )
        return np.where(weights > 0, weights * result, 0.0).sum(axis=0)

    # ---- private -------------------------------------------------------------------------------

    def _node(self, name: str) -> CompiledNode:
        return self.model.slices.model(self.now.row.t)[name]

    def _value(self, name: str) -> np.ndarray | None:
        """Values over the grid; None for a hidden node without axes."""
        if name in self.base and name not in self.model.leaves:
            return self.base[name]
        if name in self.model.leaves:
            seen = self.now.row.seen.get(name)
            return seen.value if seen is not None and seen.mask is None else None
        return self.model.computed(self.first, name, self.base)

    def _labels(self) -> list[Label]:
        was = [] if self.before is None else [previous(x) for x in self.before.labels]
        return [*was, *self.now.labels]

    @property
    def _batch(self) -> int:
        return len(self._labels())

    def _sizes(self) -> dict[Label, int]:
        def of(scalars: Sequence[Scalar]) -> dict[Label, int]:
            return {s.label: s.size for s in scalars}

        was = {} if self.before is None else of(self.before.scalars)
        return {**{previous(x): n for x, n in was.items()}, **of(self.now.scalars)}

    def _used(self, arrays: Sequence[tuple[CompiledNode, np.ndarray, int]]) -> set[Label]:
        """Axes that some of these values vary along."""
        found: set[Label] = set()
        labels = self._labels()
        for node, value, more in arrays:
            lead = value.ndim - len(node.value_shape) - more
            for k in range(lead):
                if value.shape[k] > 1:
                    found.add(labels[len(labels) - lead + k])
        return found

    def _marginal(self, used: set[Label]) -> np.ndarray:
        """Probabilities over some axes, of size one along the others: shape ``(*batch, *apart)``."""
        labels, sizes, apart = self._labels(), self._sizes(), self.model.apart
        was = any(is_previous(x) for x in used)
        terms = self.pair() if was else [self.own]
        keep = (*[x for x in labels if x in used], *apart)
        shape = (*(sizes[x] if x in used else 1 for x in labels), *self.model.lead)
        found = contract(terms, keep)
        return np.array(dense(found, (*labels, *apart), shape))

    def _average(self, node: CompiledNode, value: np.ndarray, more: int = 0) -> np.ndarray:
        """Expectation of values ``(*batch, *plates, *event)`` with ``more`` axes behind."""
        trailing = len(node.value_shape) + more
        value = np.asarray(value, dtype=float)
        if value.ndim < trailing:
            value = value.reshape((1,) * (trailing - value.ndim) + value.shape)
        lead = value.ndim - trailing
        full = (*node.value_shape, *value.shape[value.ndim - more :]) if more else node.value_shape
        used = self._used([(node, value, more)])
        if not used:
            return np.array(np.broadcast_to(value.reshape(value.shape[lead:]), full))
        value = value.reshape((1,) * (self._batch - lead) + value.shape)
        weights = self._aligned(used, node, len(node.event_shape) + more)
        with np.errstate(invalid="ignore"):
            product = np.where(weights > 0, weights * value, 0.0)
        return np.array(np.broadcast_to(product.sum(axis=tuple(range(self._batch))), full))

    def _refuse_bad(self, node: CompiledNode, dist: Distribution) -> None:
        """Bad parameters of what is missing are the user's to hear of, where cells that count have them."""
        if dist.invalid is None:
            return
        ones = (1,) * len(node.event_shape)
        mass = self._average(node, dist.invalid.reshape(dist.invalid.shape + ones) * 1.0)
        seen = self.now.row.seen.get(node.name)
        if seen is not None and seen.mask is not None:
            mass = np.where(seen.mask.reshape(seen.mask.shape + ones), 0.0, mass)
        if np.any(mass > COUNTS):
            assert dist.problem is not None
            raise type(dist.problem)(
                f"node {node.name!r}: {dist.problem} in slice {self.now.row.t}, on cells of probability "
                f"{float(np.max(mass)):.2g}; mend the function, or leave such cells out of the grid"
            )

    def _aligned(self, used: set[Label], node: CompiledNode, tail: int) -> np.ndarray:
        """Probabilities with axes where a node's values have them."""
        count, apart = self._batch, self.model.apart
        weights = self._marginal(used)
        order = [p for p in node.plates if p in apart]
        rest = [p for p in apart if p not in order]
        weights = weights.transpose(
            *range(count), *(count + apart.index(p) for p in (*order, *rest))
        )
        # a node outside the plates that are apart depends on no cell of theirs
        for _ in rest:
            weights = weights[..., 0]
        shape = list(weights.shape[:count])
        sizes = iter(weights.shape[count:])
        shape += [next(sizes) if p in apart else 1 for p in node.plates]
        return weights.reshape(shape + [1] * tail)

    def _moments(self, node: CompiledNode, value: Any, var: Any) -> Moments:
        """Of values over the grid, or of distributions' means and variances; circular for angles."""
        value = np.asarray(value, dtype=float)
        mean = self._average(node, value)
        spread = self._average(node, (value - mean) ** 2)
        if var is not None:
            spread = spread + self._average(node, var)
        if node.angles is None:
            return mean, spread
        length = 1.0 if var is None else np.exp(-0.5 * np.asarray(var))
        sine = self._average(node, length * np.sin(value))
        cosine = self._average(node, length * np.cos(value))
        turned, turns = np.arctan2(sine, cosine), circular_variance(cosine, sine)
        return np.where(node.angles, turned, mean), np.where(node.angles, turns, spread)
