"""What a reading's density says of the element of a plate that it picks, as a function of this element alone.

Its mean and its noise are those of the declared function's expression, in which whatever is read of the plate
is a leaf of its own; so an element is looked at without the others, whatever picks it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.kalman.slices import covariance_root
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import Expression, Leaf, Program, broadcast, expressions_of, leaf, ordered
from bayesmc.expression import rebuilt as made_of
from bayesmc.expression.graph import replaced
from bayesmc.expression.trace import mapped
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.model import Model, invalid_error
from bayesmc.passes.derivatives import tangent
from bayesmc.passes.mean import mean
from bayesmc.passes.reads import element_read, reads, sunk
from bayesmc.structure.picked import picked_element


class Way(NamedTuple):
    """One of the places where a density reads a plate.

    Attributes
    ----------
    name : str
        The leaf that stands for what is read there.
    shape : tuple of int
    element, component : Expression of whole numbers, of that shape
        What each entry reads.
    offset : int
        Where the node's numbers stand among those of an element.
    reader : ndarray of int, shape (entries,)
        The element of the reading that each entry belongs to.
    """

    name: str
    shape: tuple[int, ...]
    element: Expression
    component: Expression
    offset: int
    reader: np.ndarray


class Seen(NamedTuple):
    """What readings say at some values of the elements that they pick.

    Attributes
    ----------
    mean : ndarray, shape (batch, readings, d)
    noise : ndarray, shape (batch or 1, readings, d, d)
        Roots of covariances.
    """

    mean: np.ndarray
    noise: np.ndarray


class PickedLook:
    """A node whose elements read one element of a plate each.

    Parameters
    ----------
    model : Model
    name : str
        The reading.
    states : dict
        Node of the plate -> where its numbers stand among those of an element.
    cut : sequence of str
        Computed nodes whose values are given.

    Attributes
    ----------
    at : Expression
        The element that each reading reads; -1 where none.
    leaves : frozenset of str
        Known values that it depends on.
    count, width : int
        How many readings it counts as, of how many numbers each: one where all elements share one pick.

    Raises
    ------
    TraceError
        It is not proven that each reading reads one element, or its mean has no known derivative.
    """

    def __init__(
        self, model: Model, name: str, states: Mapping[str, slice], cut: Sequence[str]
    ) -> None:
        self.node, self.states = model[name], states
        read = density(model, name, frozenset(cut))
        if isinstance(read, Opaque):
            raise TraceError(read.reason)
        sources = [s for s in states if s in read.leaves]
        at = picked_element(model, name, sources, cut) if sources else None
        if at is None or at.leaves & states.keys():
            raise TraceError("it may read several elements")
        self.at = at
        self._ways: dict[Expression, Way] = {}
        self._result = mapped(read.result, lambda e: self._apart(model, e, sources))
        self._mean = broadcast(
            self._apart(model, mean(read.result), sources), self.node.value_shape
        )
        self.ways = tuple(self._ways.values())
        self.count, self.width = self._arranged()
        roots = [*expressions_of(self._result), self._mean, at, *self._found()]
        own = {w.name for w in self.ways}
        self.leaves = frozenset().union(*(e.leaves for e in roots)) - own
        if self.leaves & states.keys():
            raise TraceError("it reads the plate in ways that are not told apart")
        self.moments = Program([*expressions_of(self._result), self._mean])
        self._places = Program([at])
        self._entries = Program(self._found())
        self._slopes: dict[Any, Program] = {}
        self._slopes[None] = self._tangent({w.name: w.shape for w in self.ways})

    def places(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Elements that are read, shape (batch or 1, readings)."""
        (found,) = self._places({n: values[n] for n in self.at.leaves})
        found = np.asarray(found)
        lead = found.shape[: found.ndim - len(self.node.plate_shape)]
        return found.reshape(lead[-1] if lead else 1, -1)[:, : self.count]

    def entries(self, values: Mapping[str, np.ndarray], at: np.ndarray) -> list[np.ndarray]:
        """Which number of its element each entry of each way is; checked against what is read."""
        found = self._entries(values)
        components = []
        for way, element, component in zip(self.ways, found[::2], found[1::2], strict=True):
            size = math.prod(way.shape)
            element, component = (np.asarray(a).reshape(-1, size) for a in (element, component))
            wanted = at[:, way.reader]
            if ((element != wanted) & (element >= 0) & (wanted >= 0)).any():
                raise UnsupportedError(
                    f"node {self.node.name!r} reads its plate in an order that cannot be followed; pick one "
                    "element by one index, or leave marginalize= out"
                )
            components.append(way.offset + np.maximum(component, 0))
        return components

    def __call__(
        self, values: Mapping[str, np.ndarray], entries: Sequence[np.ndarray], x: np.ndarray
    ) -> Seen:
        """Means and noise.

        Parameters
        ----------
        values : dict
            What is known, with a batch or without.
        entries : list of ndarray
            As ``entries`` has them.
        x : ndarray, shape (batch, readings, n)
            Values of the elements that are read.

        Raises
        ------
        ParameterError
        """
        *parameters, mean = self.moments({**values, **self._leaves(entries, x)})
        node, batch = self.node, len(x)
        shape = (batch, *node.value_shape)
        result = made_of(self._result, iter(parameters))
        if result.invalid is not None:
            error = invalid_error(
                node, result, np.ones((batch,), dtype=bool), (batch,), noiseless=True
            )
            if error is not None:
                raise error
        mean = np.broadcast_to(mean, shape).reshape(batch, self.count, self.width)
        root = covariance_root(result)
        plates, d = node.plate_shape, math.prod(node.event_shape)
        if root is not None:
            lead = root.shape[: max(root.ndim - 2 - len(plates), 0)]
            return Seen(mean, self._blocks(np.broadcast_to(root, (*lead, *plates, d, d))))
        scale = np.sqrt(np.asarray(result.var))
        lead = scale.shape[: max(scale.ndim - len(node.value_shape), 0)]
        scale = np.broadcast_to(scale, (*lead, *node.value_shape))
        scale = scale.reshape(-1, self.count, self.width)
        return Seen(mean, scale[..., None] * np.eye(self.width))

    def slopes(
        self, values: Mapping[str, np.ndarray], entries: Sequence[np.ndarray], x: np.ndarray
    ) -> np.ndarray:
        """How means move with the elements that are read, shape (batch, readings, d, n)."""
        n = x.shape[-1]
        moves = {
            f"move of {way.name}": np.equal(np.arange(n)[:, None, None], c)
            .astype(float)
            .reshape((n, len(c), *way.shape))
            for way, c in zip(self.ways, entries, strict=True)
        }  # fmt: skip
        (found,) = self._slopes[None]({**values, **self._leaves(entries, x), **moves})
        return self._by_number(found, n, len(x))

    def prepare(self, name: str) -> None:
        """Make ready how means move with a node that is known.

        Raises
        ------
        TraceError
        """
        if name not in self._slopes:
            roots = [n for n in ordered(self._mean) if isinstance(n, Leaf) and n.name == name]
            self._slopes[name] = self._tangent({n.name: n.shape for n in roots})

    def slopes_along(
        self,
        name: str,
        values: Mapping[str, np.ndarray],
        entries: Sequence[np.ndarray],
        x: np.ndarray,
    ) -> np.ndarray:
        """The same with a node that is known, whose numbers count one by one.

        Raises
        ------
        TraceError
        """
        self.prepare(name)
        value = values[name]
        size = math.prod(value.shape[1:])
        unit = np.eye(size).reshape(size, 1, *value.shape[1:])
        (found,) = self._slopes[name](
            {**values, **self._leaves(entries, x), f"move of {name}": unit}
        )
        return self._by_number(found, size, len(x))

    # ---- private -------------------------------------------------------------------------------

    def _arranged(self) -> tuple[int, int]:
        """Readings, and numbers of each."""
        count, width = math.prod(self.node.plate_shape), math.prod(self.node.event_shape)
        apart = {len(set(way.reader.tolist())) for way in self.ways}
        if apart == {count}:
            return count, width
        if apart != {1}:
            raise TraceError("some of its elements share what they read")
        return 1, count * width

    def _blocks(self, root: np.ndarray) -> np.ndarray:
        """Roots of readings, ``(batch or 1, readings, width, width)``, from those of a node's elements."""
        d = root.shape[-1]
        if d == self.width:
            return root.reshape(-1, self.count, d, d)
        own = root.reshape(-1, self.width // d, d, d)
        found = np.zeros((len(own), 1, self.width, self.width))
        for k in range(own.shape[1]):
            found[:, 0, k * d : (k + 1) * d, k * d : (k + 1) * d] = own[:, k]
        return found

    def _found(self) -> list[Expression]:
        return [e for w in self._ways.values() for e in (w.element, w.component)]

    def _tangent(self, shapes: Mapping[str, tuple[int, ...]]) -> Program:
        return Program(
            [tangent(self._mean, {n: leaf(f"move of {n}", s) for n, s in shapes.items()})]
        )

    def _by_number(self, found: np.ndarray, count: int, batch: int) -> np.ndarray:
        full = np.broadcast_to(found, (count, batch, *self.node.value_shape))
        return np.moveaxis(full.reshape(count, batch, self.count, self.width), 0, -1)

    def _leaves(self, entries: Sequence[np.ndarray], x: np.ndarray) -> dict[str, np.ndarray]:
        """What the ways read."""
        found = {}
        for way, component in zip(self.ways, entries, strict=True):
            own = x[:, way.reader]
            value = np.take_along_axis(own, component[..., None], -1)
            found[way.name] = value.reshape(len(x), *way.shape)
        return found

    def _apart(self, model: Model, root: Expression, sources: Sequence[str]) -> Expression:
        """An expression with leaves of their own for what it reads of the plate."""
        for source in sources:
            if source not in root.leaves:
                continue
            whole = sunk(root, source)
            found = {r: self._way(model, source, r) for r in reads(whole, source)}
            root = replaced(whole, {r: leaf(w.name, w.shape) for r, w in found.items()})
        return root

    def _way(self, model: Model, source: str, read: Expression) -> Way:
        if read not in self._ways:
            node, shape = model[source], read.shape
            count, size = math.prod(node.plate_shape), math.prod(node.event_shape)
            every = np.arange(count * size).reshape(node.value_shape)
            self._ways[read] = Way(
                f"way {len(self._ways)} into the plate", shape,
                element_read(read, source, every // size), element_read(read, source, every % size),
                self.states[source].start, self._reader(shape),
            )  # fmt: skip
        return self._ways[read]

    def _reader(self, shape: tuple[int, ...]) -> np.ndarray:
        """By entry of something read, the reading that it belongs to: the first of those that share it."""
        plates = self.node.plate_shape
        own = np.arange(math.prod(plates)).reshape(plates)
        ahead = shape[: len(plates)]
        if len(ahead) < len(plates) or any(
            a not in (1, p) for a, p in zip(ahead, plates, strict=True)
        ):
            return np.zeros(math.prod(shape), dtype=np.intp)
        some = own[tuple(slice(0, a) for a in ahead)]
        wide = some.reshape((*ahead, *(1,) * (len(shape) - len(ahead))))
        return np.broadcast_to(wide, shape).reshape(-1)
