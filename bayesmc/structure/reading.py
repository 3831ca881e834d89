"""One node's expression as the linear-Gaussian conditionals of all its plate elements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import MvNormal, Normal
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BudgetError, TraceError, UnsupportedError
from bayesmc.expression import Constant, Expression
from bayesmc.factors.gaussian import Conditional, GaussianFactor, compressed, likelihood_rows
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.expressions import Followed, density
from bayesmc.network.model import deterministic_above
from bayesmc.network.readings import by_element
from bayesmc.passes.reads import element_read
from bayesmc.shapes import Shape
from bayesmc.structure.affine import (
    Gains,
    NotLinearError,
    finite_leaves,
    is_hidden,
    linear_node,
)
from bayesmc.structure.discrete import InvalidRows, Variable
from bayesmc.structure.tables import configure

#: entries up to which coefficients are evaluated for all configurations and elements
_ENTRIES = 1 << 26
#: an element of the node reads no element of another one, or more than one
NOTHING, MANY = -1, -2


def hidden_elements(node: CompiledNode, seen: Observed | None) -> list[int]:
    """The elements of a continuous node that are not observed."""
    count = math.prod(node.plate_shape)
    if seen is None:
        return list(range(count))
    return [] if seen.mask is None else np.flatnonzero(~seen.mask).tolist()


class Reading:
    """Offsets, coefficients and scales of all elements of a node.

    Parameters
    ----------
    model : Model
    name : str
    observed : dict
    known : dict
        Stored values of inputs, fixed nodes and nodes observed in full.

    Raises
    ------
    BudgetError
        It has too many configurations.
    UnsupportedError
        It is not linear-Gaussian with these values after all.
    """

    def __init__(
        self,
        model: Model,
        name: str,
        observed: Mapping[str, Observed],
        known: Mapping[str, np.ndarray],
    ) -> None:
        self.model, self.node = model, model[name]
        self.count = math.prod(self.node.plate_shape)
        self.d = math.prod(self.node.event_shape)
        #: for every element of this node the element that it reads of a finite or hidden one
        self.places: dict[str, np.ndarray] = {}
        leaves = density(model, name, finite_leaves(model)).leaves
        free = [n for n in model.nodes if n in leaves and n not in known]
        hidden = [n for n in free if is_hidden(model[n], observed)]
        self._place([n for n in free if n not in hidden])
        self._kept: dict[Any, Conditional] = {}
        self._check_size(len(hidden))
        self._evaluate(frozenset(hidden), observed, known)

    def conditional(self, e: int, states: Mapping[Variable, int]) -> Conditional:
        """One element given the discrete variables and blocks it depends on."""
        scope = self.scope(e)
        key = (e, tuple(states.get(v) for v in scope))
        if key not in self._kept:
            blocks, columns = self._blocks(e)
            matrix = self.matrix[..., e, :, :][..., columns]
            arrays = [self.offset[..., e, :], matrix, self.tril[..., e, :, :]]
            scope, arrays = _reduced(scope, arrays, states)
            self._kept[key] = Conditional((self.node.name, e), scope, blocks, *arrays)
        return self._kept[key]

    def likelihood(
        self, group: np.ndarray, values: np.ndarray, states: Mapping[Variable, int]
    ) -> GaussianFactor:
        """The density of observed elements that are alike, as one factor of what they depend on.

        ``values`` has shape ``(elements of the group, d)``.
        """
        e = int(group[0])
        blocks, columns = self._blocks(e)
        rows, log_scale = likelihood_rows(
            self.matrix[..., group, :, :][..., columns],
            values - self.offset[..., group, :],
            self.tril[..., group, :, :],
        )
        lead = rows.shape[: len(self.cards)]
        rows = rows.reshape((*lead, -1, rows.shape[-1]))
        rows, log_scale = compressed(rows, log_scale.sum(axis=-1))
        scope, arrays = _reduced(self.scope(e), [rows, log_scale], states)
        return GaussianFactor(scope, blocks, arrays[0], arrays[1])

    def without_noise(self, elements: np.ndarray) -> np.ndarray:
        """Which of some elements have a component without noise, at some configuration."""
        pivots = np.linalg.diagonal(self.tril)[..., elements, :]
        return (pivots == 0).reshape(-1, len(elements), self.d).any(axis=(0, 2))

    def invalid_rows(self) -> Iterator[InvalidRows]:
        """Elements and configurations with bad parameters."""
        if not self.invalid.any():
            return
        rows = self.invalid.reshape(math.prod(self.cards), self.count)
        bad = np.asarray(rows.any(axis=0))
        for e in np.flatnonzero(bad).tolist():
            yield self.node.name, e, self.scope(e), self.invalid[..., e]

    # ---- what it depends on ------------------------------------------------------------------

    def _place(self, finite: Sequence[str]) -> None:
        """Which finite nodes take part with one element for each of this node, and which with all."""
        self.alone, self.whole = [], []
        for name in finite:
            place = self._elements_of(name)
            if (place == MANY).any():
                self.whole.append(name)
            else:
                self.alone.append(name)
                self.places[name] = np.where(place == NOTHING, 0, place)
        self.cards = [self._card(n) for n in self.alone]
        for name in self.whole:
            self.cards += [self._card(name)] * math.prod(self.model[name].plate_shape)

    def _elements_of(self, name: str) -> np.ndarray:
        """The element of a node that each element of this one depends on."""
        node, parent = self.node, self.model[name]
        count = math.prod(parent.plate_shape)
        leaves = finite_leaves(self.model)
        found = density(self.model, node.name, leaves)
        if isinstance(found, Followed):
            event_ndim = 0 if self.node.is_stochastic else len(self.node.event_shape)
            return self._read_of(name, by_element(found.result, event_ndim))
        if count > 1:  # what is known is that plates are aligned
            direct = not deterministic_above(self.model, node.name, leaves)
            if not (direct and set(parent.plates) <= set(node.plates)):
                return np.full(self.count, MANY)
        at = np.arange(count).reshape(parent.plate_shape)
        order = sorted(range(at.ndim), key=lambda k: node.plates.index(parent.plates[k]))
        shape = [
            n if p in parent.plates else 1
            for p, n in zip(node.plates, node.plate_shape, strict=True)
        ]
        return np.broadcast_to(at.transpose(order).reshape(shape), node.plate_shape).reshape(-1)

    def _read_of(self, name: str, roots: Iterable[Expression]) -> np.ndarray:
        """The element of a node that all expressions of an element read."""
        parent = self.model[name]
        count = math.prod(parent.plate_shape)
        numbers = np.repeat(np.arange(count), math.prod(parent.event_shape))
        parts = [np.full(self.node.plate_shape, NOTHING)]
        try:
            found = [element_read(r, name, numbers) for r in roots if name in r.leaves]
        except TraceError:
            return np.full(self.count, MANY)
        for at in found:
            if not isinstance(at, Constant):
                return np.full(self.count, MANY)
            parts.append(np.broadcast_to(at.value, self.node.plate_shape))
        return _merged(np.stack(parts), 0).reshape(-1)

    def _check_size(self, columns: float) -> None:
        entries = float(math.prod(self.cards)) * self.count * self.d * (self.d + columns)
        if entries > _ENTRIES:
            raise BudgetError(
                f"node {self.node.name!r} depends on {len(self.cards)} discrete variables and "
                f"{columns:.0f} continuous components: {entries:.3g} entries to evaluate, above "
                f"{_ENTRIES:.3g}",
                int(min(8 * entries, 2**62)),
            )

    # ---- what it says ------------------------------------------------------------------------

    def _evaluate(
        self,
        hidden: frozenset[str],
        observed: Mapping[str, Observed],
        known: Mapping[str, np.ndarray],
    ) -> None:
        """Offsets, coefficients, Cholesky factors and bad configurations, element axis last but one."""
        with marking_invalid(), np.errstate(all="ignore"):
            names = (*self.alone, *self.whole)
            values, _ = configure(self.model, known, self.alone, self.whole, names)
            given = {n: v for n, v in values.items() if n not in hidden}
            try:
                leaves = finite_leaves(self.model)
                linear = linear_node(self.model, self.node.name, hidden, leaves, given)
            except NotLinearError as error:
                raise UnsupportedError(f"node {self.node.name!r} {error}") from error
            result, gains = linear(values)
        shape = (*self.cards, *self.node.plate_shape)
        mean, tril, invalid = _parameters(result, shape, self.d)
        lead = (*self.cards, self.count)
        self.tril = tril.reshape((*lead, self.d, self.d))
        self.invalid = np.array(invalid.reshape(lead))
        offset = np.broadcast_to(mean, shape + self.node.event_shape)
        self.offset = np.array(offset.reshape((*lead, self.d)))
        parts, self.columns = [], []
        for name in (n for n in self.model.nodes if n in gains):
            part, columns = self._coefficients(name, gains[name], observed.get(name))
            parts.append(part)
            self.columns += columns
        self.matrix = np.concatenate([np.zeros((*lead, self.d, 0)), *parts], axis=-1)
        #: whether an element's mean varies along a column at all, shape (columns, elements)
        moves = (self.matrix != 0).any(axis=-2)
        moves = moves.reshape(math.prod(self.cards), self.count, len(self.columns))
        self.used = np.asarray(moves.any(axis=0)).T

    def _coefficients(
        self, name: str, gains: Gains, seen: Observed | None
    ) -> tuple[np.ndarray, list[tuple[str, int | None]]]:
        """Coefficients of a hidden node, shape (*cards, elements, d, columns), and the columns.

        A column is a component of one element, or of the one that each element of this node reads. What is
        seen goes into the offset.
        """
        node = self.model[name]
        count, d = math.prod(node.plate_shape), math.prod(node.event_shape)
        k = gains.gain.shape[-1]
        self._check_size(k)
        lead = (*self.cards, self.count, self.d)
        shape = (*self.cards, *self.node.value_shape, k)
        gain = np.broadcast_to(gains.gain, shape).reshape(-1, k)
        at = np.broadcast_to(gains.at, shape).reshape(-1, k)
        if seen is not None and seen.mask is not None:
            value = np.where(np.repeat(seen.mask.reshape(-1), d), seen.value.reshape(-1), 0.0)
            self.offset += (gain * value[at]).sum(axis=-1).reshape(lead)
            gain = np.where(seen.mask.reshape(-1)[at // d], 0.0, gain)
        place = np.zeros(self.count, dtype=np.intp)
        if count > 1:
            read = np.where(gain != 0, at // d, NOTHING).reshape(-1, self.count, self.d, k)
            place = _merged(read, (0, 2, 3))
        width, column = d, at % d
        columns: list[tuple[str, int | None]] = [(name, None)] * d
        if (place == MANY).any():
            free = hidden_elements(node, seen)
            self._check_size(len(free) * d)
            columns = [(name, e) for e in free for _ in range(d)]
            width = len(columns)
            first = np.zeros(count, dtype=np.intp)
            first[free] = np.arange(len(free)) * d
            column = first[at // d] + column
        else:
            self.places[name] = np.where(place == NOTHING, 0, place)
        index = np.arange(len(gain))[:, None] * width + column
        total = np.bincount(index.reshape(-1), gain.reshape(-1), len(gain) * width)
        return total.reshape(*lead, width), columns

    # ---- one element, or elements that are alike -----------------------------------------------

    def _blocks(self, e: int) -> tuple[tuple[Variable, ...], list[int]]:
        """The blocks that an element's mean varies with, and their columns."""
        found: dict[Variable, list[int]] = {}
        for k, (name, at) in enumerate(self.columns):
            block = (name, int(self.places[name][e]) if at is None else at)
            found.setdefault(block, []).append(k)
        kept = {b: ks for b, ks in found.items() if self.used[ks, e].any()}
        return tuple(kept), [k for ks in kept.values() for k in ks]

    def alike(self, elements: np.ndarray) -> Iterator[np.ndarray]:
        """Groups of elements that depend on the same discrete variables and blocks."""
        if len(elements) == 1:
            yield elements
            return
        keys = [self.places[n][elements] for n in self.alone]
        moved = [k for k, (_, at) in enumerate(self.columns) if at is not None]
        for k, (name, at) in enumerate(self.columns):
            if at is None:
                keys.append(np.where(self.used[k][elements], self.places[name][elements], -1))
        bits = np.packbits(self.used[moved][:, elements], axis=0).T
        numbers = np.stack([*keys, np.zeros(len(elements), dtype=np.intp)], axis=1)
        packed = np.concatenate([np.ascontiguousarray(numbers).view(np.uint8), bits], axis=1)
        rows = np.ascontiguousarray(packed).view(np.dtype((np.void, packed.shape[1]))).ravel()
        _, group = np.unique(rows, return_inverse=True)
        order = np.argsort(group, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            yield elements[part]

    def scope(self, e: int) -> tuple[Variable, ...]:
        scope = [(n, int(self.places[n][e])) for n in self.alone]
        for n in self.whole:
            scope += [(n, k) for k in range(math.prod(self.model[n].plate_shape))]
        return tuple(scope)

    def _card(self, name: str) -> int:
        domain = self.model[name].domain
        assert domain is not None
        return domain.size


# ---- private ------------------------------------------------------------------------------------


def _reduced(
    scope: tuple[Variable, ...], arrays: Sequence[np.ndarray], states: Mapping[Variable, int]
) -> tuple[tuple[Variable, ...], list[np.ndarray]]:
    """Without the axes of observed variables, and of those that make no difference."""
    kept = list(scope)
    reduced = list(arrays)
    for variable in scope:
        axis = kept.index(variable)
        if variable in states:
            state = states[variable]
        elif all(_constant_along(a, axis) for a in reduced):
            state = 0
        else:
            continue
        reduced = [a.take(state, axis=axis) for a in reduced]
        kept.remove(variable)
    return tuple(kept), reduced


def _parameters(result: Any, shape: Shape, d: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, Cholesky factor ``(*shape, d, d)`` and bad places ``(*shape)`` of what a function returned."""
    if not isinstance(result, (Normal, MvNormal)):  # computed
        return (
            np.asarray(result),
            np.broadcast_to(0.0, (*shape, d, d)),
            np.broadcast_to(False, shape),
        )
    if isinstance(result, Normal):
        tril = np.broadcast_to(result.scale, shape)[..., None, None]
    else:
        tril = np.broadcast_to(result.scale_tril, (*shape, d, d))
    bad = False if result.invalid is None else result.invalid
    if result.noiseless is not None:  # exact answers take it as it is
        bad = bad & ~result.noiseless
    return result.loc, tril, np.broadcast_to(bad, shape)


def _constant_along(array: np.ndarray, axis: int) -> bool:
    first = array.take([0], axis=axis)
    return bool((array == first).all())


def _merged(parts: np.ndarray, axes: int | tuple[int, ...]) -> np.ndarray:
    """What entries along some axes read together."""
    most = np.iinfo(np.intp).max
    low = np.min(np.where(parts == NOTHING, most, parts), axis=axes, initial=most)
    high = np.max(parts, axis=axes, initial=NOTHING)
    return np.where((high == NOTHING) | (low == high), high, MANY)
