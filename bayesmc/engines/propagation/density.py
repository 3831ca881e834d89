"""Any density or potential of coordinates and finite variables, read off its expression as factors.

Which affine combinations it reads its coordinates through says the pass ``directions``; where it jumps or
bends along them, ``breaks``. What cannot be read so is refused with the node's name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.engines.propagation.coordinates import Numbers
from bayesmc.engines.propagation.kernels import Density, Probit, Tables
from bayesmc.engines.propagation.probits import probit_of
from bayesmc.engines.propagation.scopes import basis
from bayesmc.errors import BudgetError, TraceError, UnsupportedError
from bayesmc.expression import (
    Elementwise,
    Expression,
    Program,
    as_expression,
    broadcast,
    elementwise,
)
from bayesmc.expression.graph import substituted as _with
from bayesmc.network import Model
from bayesmc.network.expressions import Opaque, density, log_factor_of, stored_leaf
from bayesmc.network.model import potential_shape
from bayesmc.passes.affine import Affine
from bayesmc.passes.arithmetic import rewritten
from bayesmc.passes.directions import breaks, directions
from bayesmc.passes.guarded import guarded
from bayesmc.passes.log_density import family_of, log_density
from bayesmc.passes.reads import element_read
from bayesmc.structure.tables import configure, reads_of

#: numbers that coefficients and evaluations of one term may have
_ENTRIES = 1 << 26


@dataclass(frozen=True, eq=False)
class Read:
    """Factors of one node or potential, not yet in components.

    Attributes
    ----------
    name : str
    kernel : Density, Probit or Tables
    scope : tuple of ndarray of int
        For every finite variable of a factor, which node's element it is: (node, elements).
    coordinates : ndarray of int, shape (count, m)
    weights : ndarray, shape (count, k, m)
    elements : ndarray of int, shape (count,)
    """

    name: str
    kernel: Density | Probit | Tables
    scope: tuple[tuple[str, np.ndarray], ...]
    coordinates: np.ndarray
    weights: np.ndarray
    elements: np.ndarray


class Terms:
    """Reads densities of a posed problem.

    Parameters
    ----------
    model : Model
    known : dict
        Stored values of all nodes that are wholly known.
    numbers : dict
        Hidden continuous nodes.
    finite : frozenset of str
        Finite nodes that are variables.
    """

    def __init__(
        self,
        model: Model,
        known: Mapping[str, np.ndarray],
        numbers: Mapping[str, Numbers],
        finite: frozenset[str],
    ) -> None:
        self.model, self.known, self.numbers, self.finite = model, known, numbers, finite
        self.cut = frozenset(n for n in finite if model[n].kind == "deterministic")

    def read(self, name: str, elements: np.ndarray | None = None) -> Read:
        """The factors of a node or potential, of some of its elements.

        Raises
        ------
        UnsupportedError, BudgetError
        """
        try:
            return self._read(name, elements)
        except TraceError as error:
            what = "node" if name in self.model.nodes else "potential"
            raise UnsupportedError(
                f"ExpectationPropagation: {what} {name!r} depends on continuous nodes in a way that is not "
                f"followed ({error}); use Gibbs or HamiltonianMonteCarlo"
            ) from error

    def shape_of(self, name: str) -> tuple[tuple[int, ...], tuple[str, ...], tuple[str, ...]]:
        """The shape of a term's factors, its plates and what it reads."""
        model = self.model
        if name in model.nodes:
            node = model[name]
            return node.plate_shape, node.plates, node.parents
        potential = model.potentials[name][0]
        return potential_shape(model.sizes, potential), potential.plates, potential.parents

    # ---- private -------------------------------------------------------------------------------

    def _read(self, name: str, elements: np.ndarray | None) -> Read:
        shape, plates, parents = self.shape_of(name)
        at = np.arange(math.prod(shape)) if elements is None else elements
        sure = probit_of(self, name, shape, at)
        if sure is not None:
            return Read(name, sure.kernel, (), sure.coordinates, sure.weights, at)
        root = self.log_factor(name, shape)
        free = {n.leaf.name for n in self.numbers.values()} & root.leaves  # type: ignore[attr-defined]
        inner = directions(_widened(root, frozenset(free)), free)
        scope, values, cards = self.configured(
            name, plates, parents, inner.residual, inner.combinations
        )
        told = self._told(inner.residual)
        for called, form in zip(inner.names, inner.combinations, strict=True):
            _hold_aligned(told, called, form, shape, values)
        places = tuple((n, own[at]) for n, own in scope)
        if not inner.combinations:
            (logs,) = Program([inner.residual])(values)
            wide = _spread(logs, (*cards, *shape), len(shape)).reshape(*cards, -1)[..., at]
            kernel = Tables(np.moveaxis(wide, -1, 0))
            none = np.zeros((len(at), 0))
            return Read(name, kernel, places, none.astype(int), none[:, None], at)
        offset, gain, coordinates = self.coefficients(inner.combinations, values, cards, shape, at)
        states, d = math.prod(cards), offset.shape[-1]
        m = coordinates.shape[-1]
        weights, within = basis(gain.reshape(len(at), states * d, m))
        within = within.reshape(len(at), states, d, -1)
        zero = breaks(inner.residual, inner.names)
        if zero and within.shape[-1] > 1 and d > 1:
            raise TraceError("it jumps or bends in several directions")
        residual = guarded([inner.residual])
        program = Program([*residual, *(broadcast(z, _full(z, shape)) for z in zero)])
        leaves = {n: f.offset.shape for n, f in zip(inner.names, inner.combinations, strict=True)}
        factors = Density(program, leaves, values, cards, shape, offset, within, at, len(zero))
        self._hold(name, factors, root, coordinates, weights, cards, shape, values)
        return Read(name, factors, places, coordinates, weights, at)

    def result(self, name: str) -> Any:
        found = density(self.model, name, self.cut)
        if isinstance(found, Opaque):
            raise TraceError(found.reason)
        return found.result

    def log_factor(self, name: str, shape: tuple[int, ...]) -> Expression:
        """The log factor of free numbers and what is known or finite."""
        model = self.model
        if name not in model.nodes:
            if isinstance(density(model, name), Opaque):
                self.result(name)
            root = log_factor_of(model, name)
            return self.substituted(root)
        node, family = model[name], self.result(name)
        if isinstance(family, Distribution):
            family = family_of(family)
        value: Expression = stored_leaf(model, node)
        if node.domain is not None and node.domain.low:
            value = elementwise(np.add, value, node.domain.low)
        root = broadcast(log_density(family, value), shape)
        root = self.substituted(root)
        own = self.numbers.get(name)
        if own is not None and not own.is_plain:
            root = elementwise(np.add, root, own.volume)
        return root

    def substituted(self, root: Expression) -> Expression:
        """With values of mapped nodes made of their free numbers."""
        mapped = {n: x for n, x in self.numbers.items() if n in root.leaves and not x.is_plain}
        for x in mapped.values():
            root = x.inside(root)
        return _with(root, {n: x.value for n, x in mapped.items()})

    def configured(
        self,
        name: str,
        plates: Sequence[str],
        parents: Sequence[str],
        residual: Expression,
        forms: Sequence[Affine],
    ) -> tuple[list[tuple[str, np.ndarray]], dict[str, np.ndarray], tuple[int, ...]]:
        """Finite variables that factors read, by element, and their values along axes of their own."""
        model = self.model
        leaves = set(residual.leaves)
        for form in forms:
            parts = [form.offset, *(e for r in form.reads.values() for e in (r.gain, r.at))]
            leaves = leaves.union(*(e.leaves for e in parts))
        names = [n for n in model.nodes if n in leaves and n in self.finite and n not in self.known]
        own = name in names
        aligned = set(reads_of(model, parents, plates, lambda n: n in self.known).alone)
        alone = [n for n in names if n in aligned or (own and n == name)]
        whole = [n for n in names if n not in alone]
        unknown = leaves - set(names) - set(self.known) - set(residual.leaves - set(model.nodes))
        unknown = {n for n in unknown if n in model.nodes}
        if unknown:
            raise TraceError(f"it reads {sorted(unknown)[0]!r}, which is not described by messages")
        entries = 1.0
        for n in names:
            elements = 1 if n in alone else math.prod(model[n].plate_shape)
            entries *= float(model[n].domain.size) ** elements  # type: ignore[union-attr]
        count = math.prod(model.sizes[p] for p in plates)
        if entries * count > _ENTRIES:
            raise BudgetError(
                f"ExpectationPropagation: {name!r} depends on {entries:.3g} configurations of finite nodes",
                int(min(8 * entries * count, 2**62)),
            )
        values, cards = configure(model, self.known, alone, whole, ())
        shape = tuple(model.sizes[p] for p in plates)
        index = np.indices(shape).reshape(len(shape), -1) if shape else np.zeros((0, 1), dtype=int)
        scope: list[tuple[str, np.ndarray]] = []
        for n in alone:
            node = model[n]
            own_at = [index[list(plates).index(p)] for p in node.plates]
            flat = np.zeros(index.shape[1], dtype=int)
            if own_at:
                flat = np.ravel_multi_index(own_at, node.plate_shape)
            scope.append((n, flat))
        for n in whole:
            for e in range(math.prod(model[n].plate_shape)):
                scope.append((n, np.full(max(count, 1), e)))
        return scope, values, cards

    def coefficients(
        self,
        forms: Sequence[Affine],
        values: Mapping[str, np.ndarray],
        cards: tuple[int, ...],
        shape: tuple[int, ...],
        at: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Offsets (f, states, d), coefficients (f, states, d, m), and their coordinates (f, m)."""
        by_leaf = {x.leaf.name: x for x in self.numbers.values()}  # type: ignore[attr-defined]
        count, states = math.prod(shape), math.prod(cards)
        offsets, gains, places = [], [], []
        for form in forms:
            inner = form.offset.size // max(count, 1)
            names = list(form.reads)
            parts = [e for n in names for e in (form.reads[n].gain, form.reads[n].at)]
            offset, *found = Program([form.offset, *parts])(values)
            full = (*cards, *form.offset.shape)
            offset = _spread(offset, full, len(form.offset.shape)).reshape(states, count, inner)
            own_gain, own_place = [], []
            for n, gain, place in zip(names, found[::2], found[1::2], strict=True):
                width = form.reads[n].gain.shape[-1]
                rank = len(form.offset.shape) + 1
                gain = _spread(gain, (*full, width), rank).reshape(states, count, inner, width)
                place = _spread(place, (*full, width), rank).reshape(states, count, inner, width)
                x = by_leaf[n]
                coordinate, seen = x.at.reshape(-1)[place], x.seen.reshape(-1)[place]
                known = coordinate < 0
                if known.any():
                    offset = offset + np.where(known, gain * seen, 0.0).sum(axis=-1)
                    gain = np.where(known, 0.0, gain)
                own_gain.append(gain)
                own_place.append(coordinate if gain.all() else np.where(gain == 0, -1, coordinate))
            offsets.append(offset)
            gains.append(_joined(own_gain, -1))
            places.append(_joined(own_place, -1))
        offset = np.moveaxis(_joined(offsets, -1), 1, 0)[at]
        widest = max(g.shape[-1] for g in gains)
        gain = _joined([_filled(g, widest, 0.0) for g in gains], 2)
        place = _joined([_filled(p, widest, -1) for p in places], 2)
        gain, place = (np.moveaxis(a, 1, 0)[at] for a in (gain, place))
        flat, where = gain.reshape(len(at), -1), place.reshape(len(at), -1)
        first, like = where[:1], bool(len(where)) and bool((where == where[:1]).all())
        coordinates = unique_rows(first if like else where)
        d, m = offset.shape[-1], coordinates.shape[-1]
        if float(len(at)) * states * d * m > _ENTRIES:
            raise BudgetError("ExpectationPropagation: too many coefficients", 8 * _ENTRIES)
        column = ((first if like else where)[..., None] == coordinates[:, None, :]).argmax(axis=-1)
        coordinates = np.broadcast_to(np.maximum(coordinates, 0), (len(at), m))
        if like and states * d == 1 and (np.bincount(column[0]) <= 1).all():
            full_gain = np.zeros((len(at), m))
            full_gain[:, column[0]] = np.where(first < 0, 0.0, flat)
            return offset, full_gain[:, None, None], coordinates
        full_gain = np.zeros((len(at), states, d, m))
        entry = np.repeat(np.arange(states * d), gain.shape[-1])
        target = full_gain.reshape(len(at), states * d, m)
        rows = np.arange(len(at))[:, None]
        np.add.at(target, (rows, entry[None, :], column), np.where(where < 0, 0.0, flat))
        return offset, full_gain, coordinates

    def _told(self, root: Expression) -> Expression:
        """With the known states in place: what is chosen by them is then an element, not any of several."""
        model = self.model
        states = {
            n: as_expression(np.broadcast_to(self.known[n], model[n].value_shape))
            for n in root.leaves & self.known.keys()
            if model[n].domain is not None
        }
        return _with(root, states) if states else root

    def _hold(
        self,
        name: str,
        kernel: Density,
        root: Expression,
        coordinates: np.ndarray,
        weights: np.ndarray,
        cards: tuple[int, ...],
        shape: tuple[int, ...],
        values: Mapping[str, np.ndarray],
    ) -> None:
        """Refuse factors that do not give what the log density does, at a few points."""
        size = max((int(x.at.max(initial=-1)) + 1 for x in self.numbers.values()), default=0)
        rng = np.random.default_rng(0)
        points = rng.normal(size=(3, size))
        given = dict(values)
        for x in self.numbers.values():
            own = np.where(x.at >= 0, points[:, np.maximum(x.at, 0)], x.seen)
            lead = (3, *(1,) * len(cards))
            given[x.leaf.name] = own.reshape(*lead, *x.leaf.shape)  # type: ignore[attr-defined]
        (wanted,) = Program([root])(given)
        states = math.prod(cards)
        lead = wanted.shape[: wanted.ndim - len(shape)]
        lead = (1,) * (1 + len(cards) - len(lead)) + lead
        wanted = np.broadcast_to(wanted.reshape(*lead, *shape), (3, *cards, *shape)).reshape(
            3, states, -1
        )
        wanted = np.moveaxis(wanted[..., kernel.elements], 1, 2)
        u = np.matvec(weights, points[:, coordinates])
        own = kernel.offset + np.matvec(kernel.gain, u[:, :, None])
        with np.errstate(all="ignore"):
            got = kernel.log_factor(np.arange(len(kernel.elements)), own)
            both = np.isfinite(got) & np.isfinite(wanted)
            same = np.abs(got - wanted) <= 1e-6 * (1.0 + np.abs(wanted))
        if not (same | ~both).all() or (np.isfinite(got) != np.isfinite(wanted)).any():
            raise TraceError("its factors differ from its log density")


# ---- private ------------------------------------------------------------------------------------


def _widened(root: Expression, wanted: frozenset[str]) -> Expression:
    """Operands that read some leaves in the shape of what is made of them, so that entries keep their own."""

    def wide(node: Expression, new: list[Expression]) -> Expression | None:
        if isinstance(node, Elementwise) and node.leaves & wanted:
            full = [broadcast(a, node.shape) if a.leaves & wanted else a for a in new]
            return node.with_operands(full)
        return None

    return rewritten([root], wide)[0]


def _hold_aligned(
    residual: Expression,
    name: str,
    form: Affine,
    shape: tuple[int, ...],
    values: Mapping[str, np.ndarray],
) -> None:
    """Refuse combinations that elements share: each has its own, whatever finite nodes are."""
    own, count = form.offset.shape, math.prod(shape)
    if own[: len(shape)] != shape:
        raise TraceError("elements of a plate share what is not affine")
    if count == 1:
        return
    numbers = np.repeat(np.arange(count), math.prod(own) // max(count, 1)).reshape(own)
    (found,) = Program([element_read(residual, name, numbers)])(values)
    if not ((found == np.arange(count).reshape(shape)) | (found < 0)).all():
        raise TraceError("elements of a plate read each other's numbers")


def _full(expression: Expression, shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(np.broadcast_shapes(expression.shape, shape))


def _spread(value: np.ndarray, full: tuple[int, ...], rank: int) -> np.ndarray:
    """Values with the batch axes of all configurations, some of which may be missing."""
    lead = value.shape[: value.ndim - rank]
    missing = len(full) - rank - len(lead)
    shaped = value.reshape((1,) * missing + value.shape)
    return np.broadcast_to(shaped, full)


def _joined(parts: Sequence[np.ndarray], axis: int) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)


def _filled(array: np.ndarray, width: int, value: float) -> np.ndarray:
    missing = width - array.shape[-1]
    if not missing:
        return array
    return np.concatenate(
        [array, np.full((*array.shape[:-1], missing), value, dtype=array.dtype)], axis=-1
    )


def unique_rows(places: np.ndarray) -> np.ndarray:
    """Different non-negative numbers of each row, filled up with its first; -1 in rows without any."""
    order = np.sort(places, axis=-1)
    first = np.ones_like(order, dtype=bool)
    first[:, 1:] = order[:, 1:] != order[:, :-1]
    first &= order >= 0
    width = max(int(first.sum(axis=-1).max(initial=1)), 1)
    found = np.full((len(places), width), -1)
    column = np.cumsum(first, axis=-1) - 1
    rows, at = np.nonzero(first)
    found[rows, column[rows, at]] = order[rows, at]
    lead = found[:, :1]
    return np.where(found < 0, lead, found)
