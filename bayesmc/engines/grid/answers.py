"""What a belief on a grid says: moments, tables and densities of nodes, expectations of functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.distributions import Distribution
from bayesmc.engines.averages import called, over_line
from bayesmc.engines.grid.moves import COUNTS
from bayesmc.engines.grid.refined import Fine, cell_quantiles, quantiles, refined
from bayesmc.engines.grid.slice import Placed, sizes_by_label
from bayesmc.engines.grid.sources import Label, is_previous
from bayesmc.engines.grid.tables import GridModel
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.factors.named import Named, aligned, contract
from bayesmc.network import CompiledNode
from bayesmc.network.node import nodes_read
from bayesmc.results.statistics import circular_variance
from bayesmc.shapes import padded

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
        pair: Callable[[], list[Named]],
    ) -> None:
        self.model, self.before, self.now, self.pair = model, before, now, pair
        self.first = now.row.t == 0
        self.own = Named((*now.labels, *model.apart), probs)
        self.base = model.base(before, now)
        self.sizes = sizes_by_label(before, now)
        self.labels = tuple(self.sizes)
        self.held = {s.label: s for s in now.scalars}

    def table(self, name: str) -> np.ndarray | None:
        """Probabilities of a finite node's states, shape ``(*plates, states)``.

        None of one that is computed from a hidden node without axes.
        """
        node = self._node(name)
        assert node.domain is not None
        states = np.arange(node.domain.size)
        value = self._value(name)
        if value is not None:
            if not node.is_stochastic:
                found = self._computed(node, lambda v: v[..., None] == states)
                if found is not None:
                    return found
            hits = (value[..., None] == states).astype(float)
            return self._average(node, hits, 1)
        if not node.is_stochastic:
            return None
        dist = self.model.evaluate(self.first, name, self.base)
        self._refuse_bad(node, dist)
        found = self._average(node, dist.probs_table, 1)
        seen = self.now.row.seen.get(name)
        if seen is None or seen.mask is None:
            return found
        return np.where(seen.mask[..., None], seen.value[..., None] == states, found)

    def moments(self, name: str) -> Moments | None:
        """Mean and variance of a node of numbers.

        None for one whose density has no closed ones, or that is computed from a hidden node without axes.
        """
        node = self._node(name)
        value = self._value(name)
        if node.domain is not None and value is not None:
            if node.domain.labels is not None:
                return None
            value = node.decode(value)
        if value is not None:
            if not node.is_stochastic and node.angles is None:
                mean = self._computed(node, lambda v: v)
                if mean is not None:
                    var = self._computed(node, lambda v: (v - mean) ** 2)
                    assert var is not None
                    return mean, var
            return self._moments(node, value, None)
        if not node.is_stochastic:
            return None
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
        out = np.full((*node.plate_shape, *(a.size for a in axes)), np.nan)
        events = math.prod(node.event_shape)
        for number, at in enumerate(model.places(node)):
            labels = [(name, number * events + k) for k in range(events)]
            if not all(label in self.held for label in labels):
                continue
            scope = (*model.apart_of(node), *labels)
            table = aligned(contract([self.own], scope), scope)
            for label in labels:
                table = table / aligned(
                    Named((label, *model.apart), self.held[label].widths), scope
                )
            out[at] = table
        seen = self.now.row.seen.get(name)
        if seen is not None and seen.mask is not None:
            out[seen.mask] = np.nan
        return out

    def expectation(
        self,
        function: Callable[..., Any],
        read: Callable[[Any], np.ndarray] = np.asarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean of a function of nodes of the slice, whose arguments have a leading axis of cells; its error.

        ``read`` makes an array of what it returns. Where it reads one number on even cells, finite nodes
        beside, the cells are cut into finer ones. The error is zero, but for an event that no cell saw, or
        every cell: there it is the largest probability of a cell of one number.
        """
        names = nodes_read(function)
        for name in names:
            if name not in self.model.slices.dynamic and name not in self.model.static:
                raise UnknownNodeError(f"a query reads {name!r}, which is no node of a slice")
            if self._value(name) is None:
                here = self.model.sources(self.first, name).now & self.model.leaves
                hidden = next((n for n in sorted(here) if self._value(n) is None), name)
                of = "" if hidden == name else f", which is computed from {hidden!r}"
                raise QueryError(
                    f"a query reads {name!r}{of}, which is hidden and not on the grid, since nothing depends "
                    f"on it; give it one, grid={{{hidden!r}: (low, high, cells)}}"
                )
        nodes = [self._node(n) for n in names]

        def on_cells(values: Sequence[np.ndarray], cells: int) -> np.ndarray:
            result = read(
                called(function, [node.decode(v) for node, v in zip(nodes, values, strict=True)])
            )
            apart = self.model.lead
            if result.shape[: 1 + len(apart)] != (cells, *apart):
                more = f", the plates {self.model.apart} next" if apart else ""
                raise QueryError(
                    f"a query returns shape {result.shape}; it must return one value per cell, the axis of "
                    f"{cells} cells first{more}"
                )
            return result

        return self._averaged(names, on_cells)

    def quantile(self, name: str, levels: np.ndarray) -> np.ndarray:
        """Quantiles of a node on the grid, number by number, shape ``(*levels.shape, *plates, *event)``.

        Within cells the belief is interpolated; on uneven ones it is even in each.
        """
        node, model = self._node(name), self.model
        seen = self.now.row.seen.get(name)
        if name not in model.axes.of or name in model.leaves or node.domain is not None:
            raise UnsupportedError(
                f"quantile({name!r}): the node is not on the grid itself; ask of one that is (here "
                f"{sorted({s.label[0] for s in self.now.scalars})}), "
                "or of the probability of an event, probability(function)"
            )
        events = list(np.ndindex(*node.event_shape))
        out = np.empty((*levels.shape, *node.value_shape))
        for number, at in enumerate(model.places(node)):
            for k, event in enumerate(events):
                scalar = self.held.get((name, number * len(events) + k))
                if scalar is None:  # seen in all elements that are apart
                    assert seen is not None
                    out[(..., *at, *event)] = seen.value[(*at, *event)]
                    continue
                fine = self._fine(scalar.label, {scalar.label})
                if fine is not None:
                    found = quantiles(fine, levels)
                else:
                    share = self._marginal({scalar.label}).reshape(scalar.size, *model.lead)
                    found = cell_quantiles(scalar.points, share, levels, node.is_discrete)
                each = Named(model.apart, found.reshape((*levels.shape, *model.lead)))
                out[(..., *at, *event)] = aligned(each, model.apart_of(node))
        return out

    # ---- private -------------------------------------------------------------------------------

    def _averaged(
        self, names: Sequence[str], on_cells: Callable[[Sequence[np.ndarray], int], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The average of a function over all cells, of arguments ``(cells, *value_shape)``; its error."""
        values = {n: self._value(n) for n in names}
        kept = [(self._node(n), v, 0) for n, v in values.items() if v is not None]
        labels = self._used(kept)
        found = self._over_fine(names, on_cells, labels)
        if found is not None:
            return found
        grid = tuple(self.sizes[x] if x in labels else 1 for x in self.labels)
        cells = math.prod(grid)
        arguments = [self._wide(node, value, grid) for node, value, _ in kept]
        result = on_cells(arguments, cells).astype(float)
        weights = self._marginal(labels).reshape(
            (cells, *self.model.lead) + (1,) * (result.ndim - 1 - len(self.model.lead))
        )
        mean = np.where(weights > 0, weights * result, 0.0).sum(axis=0)
        unseen = (result == 0).all(axis=0) | (result == 1).all(axis=0)
        return mean, np.where(unseen, self._widest(labels, mean.ndim), 0.0)

    def _widest(self, labels: set[Label], rank: int) -> np.ndarray:
        """The largest probability of a cell of any one number, shape ``(*apart, 1, ...)`` of this rank."""
        first, apart = self.model.slices.first, len(self.model.lead)
        widest = np.zeros(self.model.lead)
        for x in labels:
            node = first[x[0].removesuffix(PREVIOUS)]
            if node.domain is None and not node.is_discrete:
                shares = self._marginal({x}).reshape(-1, *self.model.lead)
                widest = np.maximum(widest, shares.max(axis=0))
        return widest.reshape(self.model.lead + (1,) * (rank - apart))

    def _wide(self, node: CompiledNode, value: np.ndarray, grid: Sequence[int]) -> np.ndarray:
        """Values over the grid with one axis for all its cells."""
        lead = value.ndim - len(node.value_shape)
        full = (1,) * (len(grid) - lead) + value.shape
        wide = np.broadcast_to(value.reshape(full), (*grid, *node.value_shape))
        return wide.reshape(math.prod(grid), *node.value_shape)

    def _over_fine(
        self,
        names: Sequence[str],
        on_cells: Callable[[Sequence[np.ndarray], int], np.ndarray],
        labels: set[Label],
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The same on finer cells of the one number that is read; None where there is none, or several."""
        first = self.model.slices.first
        numbers = [x for x in labels if first[x[0].removesuffix(PREVIOUS)].domain is None]
        fine = self._fine(numbers[0], labels) if len(numbers) == 1 else None
        if fine is None:
            return None
        name, spot = numbers[0][0], self.labels.index(numbers[0])
        node = self._node(name)
        others = [self.sizes[x] if x in labels and x != numbers[0] else 1 for x in self.labels]
        carried = {n for n in self.now.values if n not in self.model.own}
        base = {n: v for n, v in self.base.items() if n not in carried}
        states, behind = math.prod(others), len(self.labels) - spot - 1

        def evaluate(_: np.ndarray, points: np.ndarray) -> np.ndarray:
            x = np.asarray(fine.number(points)).reshape(
                -1, *(1,) * (behind + len(node.value_shape))
            )
            held = {**base, name: np.broadcast_to(x, (*x.shape[: behind + 1], *node.value_shape))}
            grid = [*others[:spot], len(points), *others[spot + 1 :]]
            arguments = []
            for n in names:
                own, value = self._node(n), held.get(n)
                if value is None or n in self.model.leaves:
                    value = self._value(n) if n in self.model.leaves else None
                    if value is None:
                        value = self.model.computed(self.first, n, held)
                wide = self._wide(own, value, grid)
                wide = wide.reshape(math.prod(grid[:spot]), len(points), -1, *own.value_shape)
                arguments.append(np.moveaxis(wide, 1, 0).reshape(-1, *own.value_shape))
            result = on_cells(arguments, len(points) * states)
            return result.reshape(len(points), states, *result.shape[1:])

        masses = fine.masses.reshape(len(fine.points), states, *self.model.lead)
        means, errors = (x[0] for x in over_line(evaluate, 1, fine.points, masses[None]))
        mean = means.sum(axis=0)
        # a state in which the event never holds beside one in which it does says nothing of points
        unseen = (errors > 0).any(axis=0) & ((means == 0) | (errors > 0)).all(axis=0)
        unseen &= (mean == 0) | (np.abs(mean - masses.sum(axis=(0, 1)).max()) < 1e-9)
        return mean, np.where(unseen, errors.sum(axis=0), 0.0)

    def _fine(self, label: Label, labels: set[Label]) -> Fine | None:
        """The belief on finer cells of a number, shape (J, *others, *apart); None where it has none."""
        if any(x not in self.held for x in labels) or label not in self.held:
            return None  # of the slice before, or seen
        scalar = self.held[label]
        axes = self.model.axes.of[label[0]]
        number = label[1]
        if scalar.points.size != scalar.size:  # some elements are seen
            return None
        order = [x for x in self.labels if x in labels]
        shares = self._marginal(labels)
        shares = np.moveaxis(
            shares.reshape(*(self.held[x].size for x in order), *self.model.lead),
            order.index(label),
            0,
        )
        return refined(axes[number % len(axes)], scalar, shares)

    def _computed(
        self, node: CompiledNode, function: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray | None:
        """A function of a deterministic node, averaged on finer cells; None where that is not to be had."""
        apart, plates = self.model.apart, node.plates
        if any(p not in plates for p in apart):
            return None
        front = [1 + plates.index(p) for p in apart]

        def on_cells(values: Sequence[np.ndarray], cells: int) -> np.ndarray:
            result = np.asarray(function(values[0]))
            return np.moveaxis(result, front, range(1, 1 + len(front)))

        value = self._value(node.name)
        assert value is not None
        found = self._over_fine([node.name], on_cells, self._used([(node, value, 0)]))
        return (
            None
            if found is None
            else np.moveaxis(found[0], range(len(front)), [k - 1 for k in front])
        )

    def _node(self, name: str) -> CompiledNode:
        return self.model.slices.model(self.now.row.t)[name]

    def _value(self, name: str) -> np.ndarray | None:
        """Values over the grid; None for a hidden node without axes."""
        if name in self.base and name not in self.model.leaves:
            return self.base[name]
        if name in self.model.leaves:
            seen = self.now.row.seen.get(name)
            return seen.value if seen is not None and seen.mask is None else None
        needed = self.model.sources(self.first, name).now & self.model.leaves
        if any(self._value(n) is None for n in needed):
            return None
        return self.model.computed(self.first, name, self.base)

    def _used(self, arrays: Sequence[tuple[CompiledNode, np.ndarray, int]]) -> set[Label]:
        """Axes that some of these values vary along."""
        found: set[Label] = set()
        for node, value, more in arrays:
            lead = value.ndim - len(node.value_shape) - more
            for k in range(lead):
                if value.shape[k] > 1:
                    found.add(self.labels[len(self.labels) - lead + k])
        return found

    def _belief(self, used: set[Label]) -> Named:
        """Probabilities over some axes and the plates apart."""
        terms = self.pair() if any(map(is_previous, used)) else [self.own]
        return contract(terms, (*(x for x in self.labels if x in used), *self.model.apart))

    def _marginal(self, used: set[Label]) -> np.ndarray:
        """Probabilities over some axes, of size one along the others: shape ``(*batch, *apart)``."""
        shape = (*(self.sizes[x] if x in used else 1 for x in self.labels), *self.model.lead)
        return np.array(aligned(self._belief(used), (*self.labels, *self.model.apart), shape))

    def _average(self, node: CompiledNode, value: np.ndarray, more: int = 0) -> np.ndarray:
        """Expectation of values ``(*batch, *plates, *event)`` with ``more`` axes behind."""
        trailing = len(node.value_shape) + more
        value = np.asarray(value, dtype=float)
        value = padded(value, trailing)
        lead = value.ndim - trailing
        full = (*node.value_shape, *value.shape[value.ndim - more :]) if more else node.value_shape
        used = self._used([(node, value, more)])
        if not used:
            return np.array(np.broadcast_to(value.reshape(value.shape[lead:]), full))
        value = value.reshape((1,) * (len(self.labels) - lead) + value.shape)
        weights = self._aligned(used, node, len(node.event_shape) + more)
        with np.errstate(invalid="ignore"):
            product = np.where(weights > 0, weights * value, 0.0)
        return np.array(np.broadcast_to(product.sum(axis=tuple(range(len(self.labels)))), full))

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
        # a node outside the plates that are apart depends on no cell of theirs
        rest = tuple(p for p in self.model.apart if p not in node.plates)
        weights = aligned(self._belief(used), (*self.labels, *node.plates, *rest))
        at: Any = (Ellipsis, *(0,) * len(rest))
        weights = weights[at]
        return weights.reshape(weights.shape + (1,) * tail)

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
