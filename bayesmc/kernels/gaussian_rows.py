"""What Normal terms say of a block: rows of residuals, affine in the block, and their noise.

Like terms are one. Coefficients, positions, offsets and scales come from one program for all chains; what
depends on nothing that a chain moves is kept, and a noise that is the same for all elements of a chain then
only scales what was summed before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.expression import Constant, Expression, Gather
from bayesmc.kernels.gaussian_layout import BlockSums, Components, Layout, Meeting
from bayesmc.kernels.gaussian_terms import NormalTerm
from bayesmc.linalg.patterns import cholesky
from bayesmc.passes.affine import Read, affine
from bayesmc.passes.templates import stacked_rows
from bayesmc.shapes import Shape
from bayesmc.structure.programs import StateProgram
from bayesmc.structure.target import Target, Values

#: pairs of columns that are held at a time
_MOST_PAIRS = 1 << 23
#: precision, linear term and constant, chains in front
Sums = tuple[np.ndarray, np.ndarray, np.ndarray]


class NormalRows:
    """Rows ``constant + coefficients @ unknowns`` of like terms.

    Parameters
    ----------
    target : Target
    members : sequence of NormalTerm
        Of one key, which the block's nodes enter in the same places.
    components : Components
        Of the block.

    Attributes
    ----------
    names : tuple of str
        The terms.
    meeting : Meeting
        Which components meet in their elements.
    layout : Layout
        Where components stand; set once that is decided.
    """

    layout: Layout

    def __init__(
        self, target: Target, members: Sequence[NormalTerm], components: Components
    ) -> None:
        self.target, self.components = target, components
        self.members, first = tuple(members), members[0]
        self.names = tuple(m.term.name for m in members)
        self.plates, self.event = first.term.shape, target.model[self.names[0]].event_shape
        self.elements = len(self.names) * math.prod(self.plates)
        self.d = math.prod(self.event)
        self.spread = first.kind.spread
        like = stacked_rows([first.roots], [m.template for m in members])
        assert like is not None, "they have one key"
        residual, scale = first.kind.parts(like.roots)
        inside = {n: k for k, n in enumerate(first.leaves) if n in components.start}
        form = affine(residual, inside)
        self._columns = [
            _Column(read, components.starts([m.leaves[inside[n]] for m in members]), n)
            for n, read in form.reads.items()
        ]
        reads = [c.read for c in self._columns]
        gains, places = [r.gain for r in reads], [r.at for r in reads]
        roots = [form.offset, *gains, *places, scale]
        self.program = StateProgram(target, roots, like.leaves, like.constants)
        known = self.program.is_known
        self._columns_known = all(map(known, (*gains, *places)))
        #: all but the noise stays what it is; everything does
        self._fixed = self._columns_known and known(form.offset)
        self._frozen = self._fixed and known(scale)
        self._mask = _mask(members, self.plates)
        #: elements that count
        self._seen = float(self.elements if self._mask is None else self._mask.sum())
        self._scale_shape = scale.shape
        self._kept: dict[str, Any] = {}
        self.meeting = self._meeting()

    def add(self, values: Values, sums: BlockSums) -> None:
        """Add what the terms say, given values of all nodes outside of the block."""
        still = self.program.are_known(values)
        kept = self._kept if still else {}
        if "all" in kept:
            sums.add(*kept["all"])
            return
        try:
            found = self.program(values, still)
        except IndexError:
            self.problem(values)  # raises in the user's words
            raise
        root, bad = self._noise(found[-1])
        summed = self._summed(found, root, kept)
        bad = bad | ~np.isfinite(summed[1]).all(axis=-1)  # or a mean overflows
        sums.bad |= bad
        sums.add(*summed)
        if self._frozen and still and not bad.any():
            kept["all"] = tuple(a[:1] for a in summed)

    def problem(self, values: Values) -> str | None:
        """What the terms' own functions find wrong, which may raise."""
        state = {**values, **self.components.state}
        self.target.compute(state, self.target.below(self.components.names))
        for member in self.members:
            dist: Any = member.term.distribution(state)[0]
            if dist.problem is not None:
                return f"node {member.term.name!r}: {dist.problem}"
        return None

    @property
    def standing(self) -> Sums | None:
        """What they say in every sweep alike, once that is known."""
        return self._kept.get("all")

    # ---- private -------------------------------------------------------------------------------

    def _summed(self, found: Sequence[np.ndarray], root: np.ndarray, kept: dict[str, Any]) -> Sums:
        is_scalar = root.ndim == 3 and self.d == 1
        if is_scalar and root.shape[1] == 1:  # one for all elements of a chain
            scale = root[:, 0, 0]
            precision, linear, constant = self._without_noise(found, kept)
            weight = scale**-2.0
            constant = weight * constant - self._seen * np.log(scale)
            return weight[:, None] * precision, weight[:, None] * linear, constant
        columns, rest = self._rows(found, kept)
        if is_scalar and not columns.is_common and columns.pair_spots is not None:
            pairs, line, squares = self._products(columns, rest, kept)
            weight = (root * root)[..., 0]
            pairs, line = pairs / weight[..., None, None], line / weight[..., None]
            products = pairs, line, squares / weight
        else:
            gains, rest = _whitened(columns.gains, rest, root)
            products = self._products(columns._replace(gains=gains), rest, {})
        scale = root if root.ndim == 3 else np.linalg.diagonal(root)
        log_det = np.log(scale).sum(axis=-1)
        if log_det.shape[1] == 1:
            log_det = log_det[:, 0] * self._seen
        else:
            log_det = (log_det if self._mask is None else log_det * self._mask).sum(axis=-1)
        precision, linear, constant = self._scattered(columns, *products)
        return precision, linear, constant - log_det

    def _without_noise(self, found: Sequence[np.ndarray], kept: dict[str, Any]) -> Sums:
        """Sums for a scale of one."""
        summed = kept.get("summed")
        if summed is None:
            columns, rest = self._rows(found, kept)
            pairs, line, squares = self._products(columns, rest, kept)
            precision = kept.get("precision")
            summed = self._scattered(columns, pairs, line, squares, precision)
            if self._columns_known:
                kept["precision"] = summed[0]
            if self._fixed:
                kept["summed"] = summed
        return summed

    def _products(
        self, columns: _Columns, rest: np.ndarray, kept: dict[str, Any]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each element: products of columns, of columns and constants, and of constants.

        Of elements that do not count zero; summed where all elements have the same columns.
        """
        gains = columns.gains
        if self._mask is not None:
            gains, rest = gains * self._mask[:, None, None], rest * self._mask[:, None]
        if columns.is_common:
            gains = _wide(gains, self.elements).reshape(len(gains), 1, -1, gains.shape[-1])
            rest = _wide(rest, self.elements).reshape(len(rest), 1, -1)
        pairs = kept.get("pairs")
        if pairs is None:
            pairs = self._pairs(columns, gains)
            if self._columns_known:
                kept["pairs"] = pairs
        return pairs, -np.vecmat(rest, gains), np.vecdot(rest, rest)

    def _pairs(self, columns: _Columns, gains: np.ndarray) -> np.ndarray:
        """Products of columns for each element; where they are too many, summed bit by bit."""
        if columns.pair_spots is not None:
            return np.swapaxes(gains, -1, -2) @ gains
        gains, layout = _wide(gains, self.elements), self.layout
        total = np.zeros((1, layout.entries))
        step = max(_MOST_PAIRS // gains.shape[-1] ** 2, 1)
        for begin in range(0, self.elements, step):
            part = gains[:, begin : begin + step]
            at = columns.spots.at[:, begin : begin + step]
            entries = layout.entry(at[..., :, None], at[..., None, :])
            pairs = np.swapaxes(part, -1, -2) @ part
            total = total + Spots(entries, layout.entries)(pairs)
        return total

    def _scattered(
        self,
        columns: _Columns,
        pairs: np.ndarray,
        line: np.ndarray,
        squares: np.ndarray,
        precision: np.ndarray | None = None,
    ) -> Sums:
        """Sums over elements, each in its place."""
        if precision is None:
            precision = pairs if columns.pair_spots is None else columns.pair_spots(pairs)
        times = 1 if columns.is_common else self.elements // squares.shape[1]
        return precision, columns.spots(line), -0.5 * times * squares.sum(axis=-1)

    def _rows(
        self, found: Sequence[np.ndarray], kept: dict[str, Any]
    ) -> tuple[_Columns, np.ndarray]:
        """Columns, and constants ``(lead, elements, d)``, from values of the roots."""
        columns = kept.get("columns")
        if columns is None:
            columns = self._joined(found)
            if self._columns_known:
                kept["columns"] = columns
        rest = self._full(found[0], self.event)
        return columns, rest if columns.seen is None else rest + columns.seen

    def _joined(self, found: Sequence[np.ndarray]) -> _Columns:
        """The columns of all nodes side by side."""
        n, free, base = len(self._columns), self.components.free, self.components.base
        gains, at = [], []
        for column, gain, place in zip(
            self._columns, found[1 : n + 1], found[n + 1 : -1], strict=True
        ):
            gains.append(self._full(gain, (*self.event, column.read.at.shape[-1])))
            at.append(self._at(place, column))
        gain, place = _beside(gains), _beside(at)
        seen = None
        if free is not None and base is not None:
            seen = (gain * base[place]).sum(axis=-1)
            gain = gain * free[place]
        gain, place = _by_element(gain, place)
        if self._columns_known and (gain == gain[:, :1]).all():
            gain = gain[:, :1]
        is_common = bool((place == place[:, :1]).all())
        spots = self.layout.position[place[:, :1] if is_common else place]
        layout, pair_spots = self.layout, None
        if is_common or spots[0].size * spots.shape[-1] <= _MOST_PAIRS:
            entries = layout.entry(spots[..., :, None], spots[..., None, :])
            pair_spots = Spots(entries, layout.entries)
        return _Columns(gain, seen, Spots(spots, layout.size), pair_spots, is_common)

    def _at(self, place: np.ndarray, column: _Column) -> np.ndarray:
        """Natural positions of components of the block, shape (lead, elements, d, k)."""
        at = self._full(place, (*self.event, column.read.at.shape[-1]))
        starts = np.repeat(column.starts, self.elements // len(column.starts))
        return at + starts[:, None, None]

    def _meeting(self) -> Meeting:
        at, varying = [np.empty((self.elements, 0), np.intp)], []
        known = self.program.known()
        for k, column in enumerate(self._columns, 1 + len(self._columns)):
            place = column.read.at
            if not self.program.is_known(place):
                (start,) = column.starts  # such terms stay by themselves
                size, dims = self.components.size_of(column.name)
                varying.append((start, start + size, _is_one_element(place, dims)))
                continue
            own = self._at(known[k], column)[0]
            alike = bool((own == own[:, :1]).all())
            at.append(own[:, 0] if alike else own.reshape(self.elements, -1))
        return Meeting(np.concatenate(at, axis=1), tuple(varying))

    def _full(self, array: np.ndarray, inner: Shape) -> np.ndarray:
        """``(*lead, members, *plates, *inner)`` as ``(lead, elements, d, ...)``; one for what all share."""
        shape = (len(self.names), *self.plates)
        n = array.ndim - len(inner)
        lead, middle = (
            array.shape[: max(n - len(shape), 0)],
            array.shape[max(n - len(shape), 0) : n],
        )
        elements = 1
        if math.prod(middle) != 1:
            elements = self.elements
            if middle != shape:
                array = np.broadcast_to(array, (*lead, *shape, *inner))
        return array.reshape(math.prod(lead), elements, self.d, *inner[len(self.event) :])

    def _noise(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scales ``(lead, elements, d)`` or roots of matrices, and the chains where some are none."""
        own = self._scale_shape
        is_matrix = self.spread in ("cov", "scale_tril")
        inner = (*self.event, *self.event) if is_matrix else self.event
        batch = value.shape[: value.ndim - len(own)]
        if self.spread == "cov":
            value, wrong = cholesky(value)
        else:
            checked = np.linalg.diagonal(value) if is_matrix else value
            wrong = np.asarray(~((checked > 0) & (checked < np.inf)))
            if wrong.any():
                where = np.asarray(wrong.any(axis=-1))[..., None, None] if is_matrix else wrong
                value = np.where(where, np.eye(self.d) if is_matrix else 1.0, value)
        pad = (1,) * (len(self.plates) + len(inner) - len(own))
        value = value.reshape((*batch, *pad, *own))
        if value.shape[value.ndim - len(inner) :] != inner:
            value = np.broadcast_to(value, value.shape[: value.ndim - len(inner)] + inner)
        bad = wrong.reshape(math.prod(batch[:-1]), -1).any(axis=-1)
        return self._full(value, inner), np.asarray(bad)


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Column:
    """What terms read of one place: coefficients and elements, and where the nodes' components begin."""

    read: Read
    starts: np.ndarray
    name: str


class Spots:
    """Where numbers of elements are added up.

    Parameters
    ----------
    at : ndarray of int, shape (lead or 1, elements, ...)
    count : int
        Places that there are.
    """

    def __init__(self, at: np.ndarray, count: int) -> None:
        self.at, self.count = at, count
        self._flat = np.empty(0, dtype=np.intp)
        self._lead = 0

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Sums of ``values (lead or 1, elements or 1, ...)`` by place, shape (lead, count)."""
        lead = max(len(values), len(self.at))
        if lead != self._lead:
            at = np.broadcast_to(self.at, (lead, *self.at.shape[1:])).reshape(lead, -1)
            self._flat = (at + np.arange(lead)[:, None] * self.count).reshape(-1)
            self._lead = lead
        shape = (lead, *self.at.shape[1:])
        if values.shape != shape:
            values = np.broadcast_to(values, shape)
        found = np.bincount(self._flat, values.reshape(-1), lead * self.count)
        return found.reshape(lead, self.count)


class _Columns(NamedTuple):
    """Of every element: coefficients ``(lead, elements, d, columns)``, and where columns and pairs stand.

    One element where all have the same; no places of pairs where these are too many. ``seen`` is what
    components that were seen add to constants.
    """

    gains: np.ndarray
    seen: np.ndarray | None
    spots: Spots
    pair_spots: Spots | None
    is_common: bool


def _whitened(
    gains: np.ndarray, rest: np.ndarray, root: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients and constants over the noise."""
    if root.ndim == 3:
        return gains / root[..., None], rest / root
    return np.linalg.solve(root, gains), np.linalg.solve(root, rest[..., None])[..., 0]


def _wide(array: np.ndarray, elements: int) -> np.ndarray:
    """What all elements share, for each."""
    return np.broadcast_to(array, (len(array), elements, *array.shape[2:]))


def _mask(members: Sequence[NormalTerm], shape: Shape) -> np.ndarray | None:
    """Ones for the elements that count, zeros for others; None where all do."""
    masks = [m.term.mask for m in members]
    if all(m is None for m in masks):
        return None
    full = [np.ones(shape) if m is None else m.astype(float) for m in masks]
    return np.concatenate([m.reshape(-1) for m in full])


def _beside(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays side by side along the last axis, the others broadcast."""
    if len(arrays) == 1:
        return arrays[0]
    lead = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
    return np.concatenate([np.broadcast_to(a, (*lead, a.shape[-1])) for a in arrays], axis=-1)


def _by_element(gains: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients ``(lead, elements, d, columns)`` of the components that all of an element reads."""
    d, k = at.shape[2:]
    if bool((at == at[:, :, :1]).all()):
        return gains, at[:, :, 0]
    wide = np.zeros((*gains.shape[:3], d, k))
    wide[:, :, np.arange(d), np.arange(d)] = gains
    return wide.reshape(*gains.shape[:3], d * k), at.reshape(*at.shape[:2], d * k)


def _is_one_element(at: Expression, dims: int) -> bool:
    """Whether varying positions are always within one element of a plate."""
    if isinstance(at, Gather) and isinstance(at.table, Constant):
        elements = at.table.value.reshape(at.table.shape[0], -1) // dims
        return bool((elements == elements[:, :1]).all())
    return at.size == 1
