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

from bayesmc.distributions import MvNormal
from bayesmc.expression import Constant, Expression, Gather
from bayesmc.kernels.gaussian_band import cholesky
from bayesmc.kernels.gaussian_layout import BlockSums, Layout
from bayesmc.kernels.gaussian_order import Components, Meeting
from bayesmc.kernels.gaussian_terms import LikeNormals
from bayesmc.passes.affine import Read, affine
from bayesmc.shapes import Shape
from bayesmc.structure.programs import StateProgram
from bayesmc.structure.target import Target, Values

#: precision, linear term and constant, chains in front
Sums = tuple[np.ndarray, np.ndarray, np.ndarray]


class NormalRows:
    """Rows ``constant + coefficients @ unknowns`` of like terms.

    Parameters
    ----------
    target : Target
    like : LikeNormals
    components : Components
        Of the block.

    Attributes
    ----------
    names : tuple of str
        The terms.
    own : bool
        They are densities of nodes of the block.
    meeting : Meeting
        Which components meet in their elements.
    layout : Layout
        Where components stand; set once that is decided.
    """

    layout: Layout

    def __init__(self, target: Target, like: LikeNormals, components: Components) -> None:
        self.target, self.like, self.components = target, like, components
        self.names = like.names
        self.own = self.names[0] in components.start
        first = like.members[0]
        self.plates, self.event = first.term.shape, target.model[self.names[0]].event_shape
        self.elements = len(self.names) * math.prod(self.plates)
        self.d = math.prod(self.event)
        inside = {n: k for k, n in enumerate(first.leaves) if n in components.start}
        form = affine(like.residual, inside)
        self._columns = [
            _Column(read, components.starts([m.leaves[inside[n]] for m in like.members]), n)
            for n, read in form.reads.items()
        ]
        reads = [c.read for c in self._columns]
        gains, places = [r.gain for r in reads], [r.at for r in reads]
        roots = [form.offset, *gains, *places, like.scale]
        self.program = StateProgram(target, roots, [m.leaves for m in like.members], like.constants)
        known = self.program.is_known
        self._columns_known = all(map(known, (*gains, *places)))
        #: all but the noise stays what it is; everything does
        self._fixed = self._columns_known and known(form.offset)
        self._frozen = self._fixed and known(like.scale)
        self._mask = _mask(like, self.plates)
        #: elements that count
        self._seen = float(self.elements if self._mask is None else self._mask.sum())
        self.meeting = self._meeting()
        self._kept: dict[str, Any] = {}

    def add(self, values: Values, sums: BlockSums) -> None:
        """Add what the terms say, given values of all nodes outside of the block."""
        known = self.program.are_known(values)
        kept = self._kept if known else {}
        if "all" not in kept:
            try:
                found = self.program(values)
            except IndexError:
                self._ask(values, None)
                raise
            root, wrong = self._noise(found[-1])
            if wrong:
                self._ask(values, sums)
            summed = (self._scaled if root.ndim == 1 else self._whitened)(found, root, kept)
            if not np.isfinite(summed[1]).all():  # a mean that overflows
                self._ask(values, sums)
                sums.bad |= ~np.isfinite(summed[1]).all(axis=-1)
            if not self._frozen:
                sums.add(*summed)
                return
            kept["all"] = tuple(a[:1] for a in summed)
        sums.add(*kept["all"])

    @property
    def standing(self) -> Sums | None:
        """What they say in every sweep alike, once that is known."""
        return self._kept.get("all")

    # ---- private -------------------------------------------------------------------------------

    def _scaled(self, found: Sequence[np.ndarray], scale: np.ndarray, kept: dict[str, Any]) -> Sums:
        """With one scale for all elements of a chain: sums without it, times its inverse square."""
        if "rest" not in kept:
            rows = self._rows(found, kept)
            unit = self._masked(rows, rows.gains, rows.rest)
            precision = kept.get("precision")
            precision = self._precision(unit) if precision is None else precision
            if self._columns_known:
                kept["precision"] = precision
            rest = precision, *self._linear(unit)
            if self._fixed:
                kept["rest"] = rest
        else:
            rest = kept["rest"]
        precision, linear, constant = rest
        weight = scale**-2.0
        constant = weight * constant - self._seen * np.log(scale)
        return weight[:, None] * precision, weight[:, None] * linear, constant

    def _whitened(
        self, found: Sequence[np.ndarray], root: np.ndarray, kept: dict[str, Any]
    ) -> Sums:
        """Rows over the noise, summed."""
        rows = self._rows(found, kept)
        gains, rest = rows.gains, rows.rest
        if root.ndim == 4:
            lead = np.broadcast_shapes(gains.shape[:3], rest.shape)
            right = np.concatenate(
                [
                    np.broadcast_to(gains, (*lead, gains.shape[-1])),
                    np.broadcast_to(rest, lead)[..., None],
                ],
                axis=-1,
            )
            solved = np.linalg.solve(root, right)
            gains, rest = solved[..., :-1], solved[..., -1]
            log_scale = np.log(np.linalg.diagonal(root)).sum(axis=-1)
        else:
            gains, rest = gains / root[..., None], rest / root
            log_scale = np.log(root).sum(axis=-1)
        if self._mask is not None:
            log_scale = log_scale * self._mask
        rows = self._masked(rows, gains, rest)
        linear, constant = self._linear(rows)
        return self._precision(rows), linear, constant - log_scale.sum(axis=-1)

    def _masked(self, rows: _Rows, gains: np.ndarray, rest: np.ndarray) -> _Rows:
        """Rows with those of elements that do not count as zeros."""
        if self._mask is not None:
            gains, rest = gains * self._mask[:, None, None], rest * self._mask[:, None]
        return rows._replace(gains=gains, rest=rest)

    def _precision(self, rows: _Rows) -> np.ndarray:
        gains = rows.gains
        if rows.is_common:
            flat = gains.reshape(len(gains), -1, gains.shape[-1])
            pairs = (np.swapaxes(flat, -1, -2) @ flat)[:, None]
        else:
            pairs = np.einsum("...ka,...kb->...ab", gains, gains)
        return _scattered(pairs, rows.entries, self.layout.entries)

    def _linear(self, rows: _Rows) -> tuple[np.ndarray, np.ndarray]:
        gains, rest = rows.gains, rows.rest
        if rows.is_common:
            flat = gains.reshape(len(gains), -1, gains.shape[-1])
            line = -np.vecmat(rest.reshape(len(rest), -1), flat)[:, None]
        else:
            line = -np.einsum("...ka,...k->...a", gains, rest)
        return _scattered(line, rows.places, self.layout.size), -0.5 * (rest * rest).sum((-2, -1))

    def _rows(self, found: Sequence[np.ndarray], kept: dict[str, Any]) -> _Rows:
        """Coefficients, constants and positions, from values of the roots."""
        rows = kept.get("rows")
        if rows is None:
            rows = self._joined(found)
            if self._columns_known:
                kept["rows"] = rows
        return rows._replace(rest=self._full(found[0], self.event) + rows.rest)

    def _joined(self, found: Sequence[np.ndarray]) -> _Rows:
        """The columns of all nodes side by side; constants of what was seen."""
        n, free, base = len(self._columns), self.components.free, self.components.base
        gains, at = [], []
        for column, gain, place in zip(
            self._columns, found[1 : n + 1], found[n + 1 : -1], strict=True
        ):
            shape = (*self.event, column.read.at.shape[-1])
            gains.append(self._full(gain, shape))
            at.append(self._at(place, column))
        gains, at = _beside(gains), _beside(at)
        rest: Any = 0.0
        if free is not None:
            rest = (gains * base[at]).sum(axis=-1)
            gains = gains * free[at]
        gains, at = _by_element(gains, at)
        is_common = bool((at == at[:, :1]).all())
        places = self.layout.position[at[:, :1] if is_common else at]
        entries = self.layout.entry(places[..., :, None], places[..., None, :])
        return _Rows(gains, rest, places, entries, is_common)

    def _at(self, place: np.ndarray, column: _Column) -> np.ndarray:
        """Natural positions of components of the block, shape (lead, elements, d, k)."""
        at = self._full(place, (*self.event, column.read.at.shape[-1]))
        starts = np.repeat(column.starts, self.elements // len(column.starts))
        return at + starts[:, None, None]

    def _meeting(self) -> Meeting:
        at, varying = [np.empty((self.elements, 0), np.intp)], []
        for column in self._columns:
            place = column.read.at
            if not self.program.is_known(place):
                (start,) = column.starts  # such terms stay by themselves
                size, dims = self.components.size_of(column.name)
                varying.append((start, start + size, _is_one_element(place, dims)))
                continue
            known = self.program.known()
            k = 1 + len(self._columns) + self._columns.index(column)
            own = self._at(known[k], column)[0]
            alike = bool((own == own[:, :1]).all())
            at.append(own[:, 0] if alike else own.reshape(self.elements, -1))
        return Meeting(np.concatenate(at, axis=1), tuple(varying))

    def _full(self, array: np.ndarray, inner: Shape) -> np.ndarray:
        """``(*lead, members, *plates, *inner)``, or what broadcasts to it, as ``(lead, elements, ...)``.

        The last axes are ``d`` and what comes after the event.
        """
        shape = (*self.plates, *inner)
        members = () if len(self.names) == 1 else (len(self.names),)
        lead = array.shape[: max(array.ndim - len(shape) - len(members), 0)]
        full = np.broadcast_to(array, (*lead, *members, *shape))
        tail = inner[len(self.event) :]
        return full.reshape(math.prod(lead), self.elements, self.d, *tail)

    def _noise(self, value: np.ndarray) -> tuple[np.ndarray, bool]:
        """Scales ``(lead, elements, d)``, roots of matrices, or one scale for each chain; and if all are.

        Ones in the place of what is no scale.
        """
        member, own = self.like.members[0], self.like.scale.shape
        is_matrix = member.spread in ("cov", "scale_tril")
        inner = (*self.event, *self.event) if is_matrix else self.event
        batch = value.shape[: value.ndim - len(own)]
        if member.spread == "cov":
            value, wrong = cholesky(value)
        else:
            checked = np.linalg.diagonal(value) if is_matrix else value
            wrong = ~((checked > 0) & (checked < np.inf))
            if wrong.any():
                wrong = wrong.any(axis=-1)[..., None, None] if is_matrix else wrong
                value = np.where(wrong, np.eye(self.d) if is_matrix else 1.0, value)
        bad = bool(wrong.any())
        lead = batch if len(self.names) == 1 else batch[:-1]
        if member.family is not MvNormal and value.size == math.prod(lead):
            return value.reshape(-1), bad
        pad = len(self.plates) + len(inner) - len(own)
        return self._full(value.reshape(*batch, *(1,) * pad, *own), inner), bad

    def _ask(self, values: Values, sums: BlockSums | None) -> None:
        """Let the terms' own functions say what is wrong: they raise, or mark chains."""
        state = {**values, **self.components.state}
        self.target.compute(state, self.target.below(self.components.names))
        for member in self.like.members:
            dist: Any = member.term.distribution(state)[0]
            if dist.invalid is None or sums is None:
                continue
            shape = member.term.shape
            lead = dist.invalid.shape[: max(dist.invalid.ndim - len(shape), 0)]
            each = np.broadcast_to(dist.invalid, lead + shape)
            bad = np.asarray(each.reshape(*lead, -1).any(axis=-1))
            if bad.any():
                sums.mark(bad, f"node {member.term.name!r}: {dist.problem}")


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Column:
    """What terms read of one place: coefficients and elements, and where the nodes' components begin."""

    read: Read
    starts: np.ndarray
    name: str


class _Rows(NamedTuple):
    """Of every element: coefficients ``(lead, elements, d, columns)``, constants ``(lead, elements, d)``.

    Where the columns and their pairs stand, ``(lead, elements, columns)``; one element where all have the
    same.
    """

    gains: np.ndarray
    rest: np.ndarray
    places: np.ndarray
    entries: np.ndarray
    is_common: bool


def _mask(like: LikeNormals, shape: Shape) -> np.ndarray | None:
    """Ones for the elements that count, zeros for others; None where all do."""
    masks = [m.term.mask for m in like.members]
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


def _scattered(values: np.ndarray, spots: np.ndarray, count: int) -> np.ndarray:
    """Sums of ``values (lead, *rest)`` by ``spots (lead or 1, *rest)``, shape (lead, count)."""
    lead = max(len(values), len(spots))
    values = np.broadcast_to(values, (lead, *values.shape[1:])).reshape(lead, -1)
    spots = np.broadcast_to(spots, (lead, *spots.shape[1:])).reshape(lead, -1)
    if lead == 1:
        return np.bincount(spots[0], weights=values[0], minlength=count)[None]
    offsets = np.arange(lead)[:, None] * count
    flat = np.bincount((spots + offsets).ravel(), weights=values.ravel(), minlength=lead * count)
    return flat.reshape(lead, count)
