"""Continuous nodes as free numbers: which there are, their values, and the change of volume.

Values are had in two ways: as arrays, with the care that ``distributions.transforms`` takes far out, and as
expressions of the same formulas, which have derivatives. Bounds may depend on parents.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.support import Support, real
from bayesmc.distributions.transforms import Bounded, Identity, Transform, Wrapped, transform_of
from bayesmc.errors import UnsupportedError
from bayesmc.expression import (
    Constant,
    Expression,
    Program,
    TracedArray,
    broadcast,
    constant,
    pick,
    reduction,
)
from bayesmc.expression.functions import expression_of
from bayesmc.expression.graph import substituted
from bayesmc.network import CompiledNode
from bayesmc.network.expressions import Opaque
from bayesmc.passes.support import moving_support
from bayesmc.shapes import Shape
from bayesmc.structure.centring import Centred, location_and_scale
from bayesmc.structure.target import Target


@dataclass(frozen=True, eq=False)
class FreeNode:
    """A node that moves.

    Attributes
    ----------
    node : CompiledNode
    start : int
        Place of its first free number among all.
    elements : ndarray of int or None
        Flat plate elements that are hidden; None where all are. Of vectors seen in part flat components.
    seen : ndarray or None
        The values of the others, shape ``(*plates, *event)``.
    transform : Transform or None
        None where the bounds depend on parents.
    bounds : tuple of Expression
        In this case: lower and upper, of stored values of parents, shape the plates. Of an effect that is
        moved apart from its scale: location and scale.
    share : ndarray or None
        Of such an effect, for each free number how far it is centred (``structure.centring``).
    by_component : bool
        Whether components of real vectors are hidden one by one.
    """

    node: CompiledNode
    start: int
    elements: np.ndarray | None
    seen: np.ndarray | None
    transform: Transform | None
    bounds: tuple[Expression, ...] = ()
    by_component: bool = False
    share: np.ndarray | None = None

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def plates(self) -> Shape:
        """Shape of what moves or stays as one: the node's plates; of single components their places, too."""
        return self.node.value_shape if self.by_component else self.node.plate_shape

    @property
    def event(self) -> Shape:
        """Shape of what one such element is."""
        return () if self.by_component else self.node.event_shape

    @property
    def lead(self) -> Shape:
        """Shape of the elements that move: the plates, or their number."""
        return self.plates if self.elements is None else (len(self.elements),)

    @property
    def own_shape(self) -> Shape:
        """Shape of the free numbers of one element."""
        if self.transform is None:
            return self.event
        return self.transform.unconstrained_shape

    @property
    def size(self) -> int:
        return math.prod(self.lead) * math.prod(self.own_shape)

    @property
    def labels(self) -> list[str]:
        """A name for every free number: ``sd[2]``."""
        at = np.ndindex(*self.plates)
        places = list(at) if self.elements is None else [p for p, _ in self._hidden(at)]
        inner = list(np.ndindex(*self.own_shape))
        return [
            f"{self.name}[{', '.join(map(str, (*p, *i)))}]" if (p or i) else self.name
            for p, i in itertools.product(places, inner)
        ]

    @property
    def angles(self) -> np.ndarray:
        """Which of its free numbers are angles, the same again after a turn, shape (size,)."""
        own = self.own_shape
        each = np.zeros(own, bool) if self.transform is None else self.transform.angles
        return np.broadcast_to(each.ravel(), (math.prod(self.lead), math.prod(own))).ravel()

    @property
    def is_bounded(self) -> bool:
        """Whether its free numbers stand for values with bounds."""
        return not isinstance(self.transform, (Identity, Wrapped))

    def expressions(
        self, part: Expression, above: Mapping[str, Expression]
    ) -> tuple[Expression, Expression]:
        """The stored value, and the logarithm of the change of volume summed over all elements.

        Parameters
        ----------
        part : Expression
            Its free numbers, shape ``(size,)``.
        above : mapping
            Node -> its value, of those that move and are known.
        """
        u = TracedArray(pick([part], np.arange(self.size).reshape(self.lead + self.own_shape)))
        transform = self.transform
        if transform is None:
            transform = self._map(*(self._moving(substituted(b, dict(above))) for b in self.bounds))
        value = expression_of(transform.formula(u))
        volume = expression_of(transform.log_det_formula(u))
        volume = reduction(np.add, volume, range(len(volume.shape)))
        return self._with_seen(broadcast(value, (*self.lead, *self.event))), volume

    def constrained(self, u: np.ndarray, above: Mapping[str, np.ndarray]) -> np.ndarray:
        """Stored values at free numbers of shape ``(*batch, size)``, given those of nodes above."""
        own = u.reshape(u.shape[:-1] + self.lead + self.own_shape)
        value = self.map_at(above).constrain(own)
        if self.elements is None:
            return value
        assert self.seen is not None
        whole = np.empty((*u.shape[:-1], *self.seen.shape))
        whole[...] = self.seen
        count = math.prod(self.plates)
        whole.reshape(*u.shape[:-1], count, *self.event)[self._at] = value
        return whole

    def freed(self, value: np.ndarray, above: Mapping[str, np.ndarray]) -> np.ndarray:
        """The free numbers behind stored values, shape ``(*batch, size)``."""
        batch = value.shape[: value.ndim - len(self.node.value_shape)]
        if self.elements is not None:
            count = math.prod(self.plates)
            value = value.reshape(*batch, count, *self.event)[self._at]
        free = self.map_at(above).unconstrain(value)
        return free.reshape(*free.shape[: free.ndim - len(self.lead + self.own_shape)], self.size)

    def log_volume(self, u: np.ndarray, above: Mapping[str, np.ndarray]) -> np.ndarray:
        """The logarithm of the change of volume at free numbers, shape ``(*batch,)``."""
        own = u.reshape(u.shape[:-1] + self.lead + self.own_shape)
        found = self.map_at(above).log_abs_det_jacobian(own)
        return found.sum(axis=tuple(range(len(u.shape) - 1, found.ndim)))

    def map_at(self, above: Mapping[str, np.ndarray]) -> Transform:
        """The map, given the values of nodes above."""
        if self.transform is not None:
            return self.transform
        low, high = self._program(above)
        if self.elements is not None:
            low, high = (self._picked(b) for b in (low, high))
        return self._map(low, high)

    # ---- private -------------------------------------------------------------------------------

    def _map(self, low: Any, high: Any) -> Transform:
        """The map between two bounds, or of an effect with this location and scale."""
        if self.share is None:
            return Bounded(self.event, low, high)
        return Centred(self.event, low, high, self.share.reshape(self.lead + self.event))

    @property
    def _at(self) -> tuple[Any, ...]:
        events = (slice(None),) * len(self.event)
        return (..., self.elements, *events)

    @cached_property
    def _program(self) -> Program:
        return Program(self.bounds)

    def _hidden(self, places: Any) -> list[tuple[Shape, int]]:
        assert self.elements is not None
        wanted = set(self.elements.tolist())
        return [(p, k) for k, p in enumerate(places) if k in wanted]

    def _picked(self, bound: np.ndarray) -> np.ndarray:
        shape = self.plates
        flat = bound.reshape(*bound.shape[: bound.ndim - len(shape)], math.prod(shape))
        return flat[..., self.elements]

    def _moving(self, bound: Expression) -> Any:
        """A bound of the elements that move."""
        if self.elements is not None:
            bound = pick([bound], self.elements)
        return bound.value if isinstance(bound, Constant) else TracedArray(bound)

    def _with_seen(self, value: Expression) -> Expression:
        if self.elements is None:
            return value
        shape = self.node.value_shape
        width = math.prod(self.event)
        at = np.arange(math.prod(shape)).reshape(-1, width)
        at[self.elements] = math.prod(shape) + np.arange(len(self.elements) * width).reshape(
            -1, width
        )
        return pick([constant(self.seen), value], at.reshape(shape))


def free_node(
    target: Target,
    name: str,
    start: int,
    share: np.ndarray | None = None,
    moving: Collection[str] = (),
) -> FreeNode:
    """A node of the chain as free numbers.

    Parameters
    ----------
    share : ndarray, optional
        How far an effect is centred whose location and scale move with it, for each of its numbers.
    moving : collection of str
        What moves with it.

    Raises
    ------
    UnsupportedError
        It is discrete, or its bounds depend on parents in a way that is not known.
    """
    node = target.model[name]
    if node.is_discrete or node.domain is not None:
        raise UnsupportedError(f"node {name!r} is discrete: it has no unconstrained numbers")
    elements, seen = target.free_elements(name), target.seen(name)
    value = None if seen is None else np.broadcast_to(seen.value, node.value_shape)
    support = _support(target, node)
    if seen is not None and seen.parts is not None:
        if support.kind != "real vector":
            raise UnsupportedError(
                f"of node {name!r} vectors are seen in part that are not real vectors ({support.describe()})"
            )
        known = np.broadcast_to(seen.numbers(len(node.event_shape)), node.value_shape)
        hidden = np.flatnonzero(~known)
        return FreeNode(node, start, hidden, value, transform_of(real, ()), by_component=True)
    apart = None if share is None else location_and_scale(target, name, moving)
    if apart is not None:
        return FreeNode(node, start, elements, value, None, apart, share=share)
    if all(isinstance(b, (np.ndarray, float)) for b in (support.low, support.high)):
        if support.is_single:
            return FreeNode(node, start, elements, value, transform_of(support, node.event_shape))
        low, high = (np.broadcast_to(b, node.plate_shape) for b in (support.low, support.high))
        if elements is not None:
            low, high = (b.reshape(-1)[elements] for b in (low, high))
        return FreeNode(node, start, elements, value, Bounded(node.event_shape, low, high))
    bounds = tuple(
        broadcast(expression_of(b), node.plate_shape) for b in (support.low, support.high)
    )
    return FreeNode(node, start, elements, value, None, bounds)


# ---- private ------------------------------------------------------------------------------------


def _support(target: Target, node: CompiledNode) -> Support:
    if node.support is not None:
        return node.support
    term = target.terms.get(node.name)
    if term is not None and not isinstance(term.read, Opaque) and not node.event_shape:
        found = moving_support(term.read.result)
        if found is not None:
            return found
    why = "" if term is None or not isinstance(term.read, Opaque) else f": {term.read.reason}"
    raise UnsupportedError(
        f"the bounds of node {node.name!r} depend on its parents in a way that is not followed{why}"
    )
