"""One node's function read off: the linear-Gaussian conditionals of all its plate elements.

That a mean is affine is proved elsewhere (``affine``); the coefficients come from the user's own function,
called at a base point, one step away from it along every direction, and at two more points that must agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import MvNormal, Normal
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BudgetError, UnsupportedError
from bayesmc.factors.gaussian import Conditional, GaussianFactor, compressed, likelihood_rows
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.shapes import Shape
from bayesmc.structure.affine import is_hidden
from bayesmc.structure.discrete import InvalidRows, Variable
from bayesmc.structure.tables import configure

#: entries up to which a function is evaluated on all configurations, directions and elements
_ENTRIES = 1 << 26
#: relative error of a prediction from the coefficients that rounding may explain
_TOLERANCE = 1e-8
_CHECKS = 2


def hidden_elements(node: CompiledNode, seen: Observed | None) -> list[int]:
    """The elements of a continuous node that are not observed."""
    count = math.prod(node.plate_shape)
    if seen is None:
        return list(range(count))
    return [] if seen.mask is None else np.flatnonzero(~seen.mask).tolist()


@dataclass(frozen=True)
class _Parent:
    """A node that a function varies with; ``whole``: with all its elements at once."""

    name: str
    whole: bool


@dataclass(frozen=True, eq=False)
class _Column:
    """One direction in which hidden parents are moved: a component of one element, or of every own one."""

    parent: str
    element: int | None
    component: int
    step: float


class Reading:
    """One node's function read off: offsets, coefficients and scales of all its elements."""

    def __init__(
        self,
        model: Model,
        name: str,
        observed: Mapping[str, Observed],
        known: Mapping[str, np.ndarray],
    ) -> None:
        self.model, self.node, self.known, self.observed = model, model[name], known, observed
        self.count = math.prod(self.node.plate_shape)
        self.d = math.prod(self.node.event_shape)
        self.finite, self.hidden = self._parents()
        #: for every element of this node the parent's element that it reads
        self.places = {p.name: self._projected(p.name) for p in (*self.finite, *self.hidden)}
        self.columns = list(self._directions())
        self.alone = [p.name for p in self.finite if not p.whole]
        self.whole = [p.name for p in self.finite if p.whole]
        self.cards = [self._card(n) for n in self.alone]
        for n in self.whole:
            self.cards += [self._card(n)] * math.prod(model[n].plate_shape)
        self._kept: dict[Any, Conditional] = {}
        self._check_size()
        self._evaluate()
        del self.known, self.observed  # it outlives the question

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

    # ---- what the function depends on --------------------------------------------------------

    def _parents(self) -> tuple[list[_Parent], list[_Parent]]:
        """The finite and the hidden continuous nodes that it varies with."""
        finite: dict[str, bool] = {}
        hidden: dict[str, bool] = {}

        def visit(above: Sequence[str], own: tuple[str, ...], whole: bool) -> None:
            for parent in above:
                node = self.model[parent]
                if parent in self.known or node.kind in ("input", "fixed"):
                    continue
                foreign = whole or any(p not in own for p in node.plates)
                if node.domain is None and not node.is_stochastic:
                    visit(node.parents, node.plates, foreign)
                else:
                    found = hidden if is_hidden(node, self.observed) else finite
                    found[parent] = found.get(parent, False) or foreign

        visit(self.node.parents, self.node.plates, False)
        own = set(self.node.plates)
        pairs = [
            [_Parent(n, w or not set(self.model[n].plates) <= own) for n, w in found.items()]
            for found in (finite, hidden)
        ]
        return pairs[0], pairs[1]

    def _directions(self) -> Iterator[_Column]:
        for parent in self.hidden:
            node = self.model[parent.name]
            steps = _typical(self.model.probe[parent.name], math.prod(node.event_shape))
            elements: Sequence[int | None] = [None]
            if parent.whole:
                elements = hidden_elements(node, self.observed.get(parent.name))
            for e in elements:
                for component, step in enumerate(steps):
                    yield _Column(parent.name, e, component, step)

    def _check_size(self) -> None:
        points = 1 + len(self.columns) + _CHECKS
        entries = float(math.prod(self.cards)) * points * self.count * self.d**2
        if entries > _ENTRIES:
            raise BudgetError(
                f"node {self.node.name!r} depends on {len(self.cards)} discrete variables and "
                f"{len(self.columns)} continuous components: {entries:.3g} entries to evaluate, above "
                f"{_ENTRIES:.3g}",
                int(min(8 * entries, 2**62)),
            )

    # ---- what it returns ---------------------------------------------------------------------

    def _evaluate(self) -> None:
        """Offsets, coefficients, Cholesky factors and bad configurations, element axis last but one."""
        points, moved = self._points()
        shape = (*self.cards, 1 + len(self.columns) + _CHECKS, *self.node.plate_shape)
        with marking_invalid(), np.errstate(all="ignore"):
            names = self.node.parents
            values, _ = configure(self.model, self.known, self.alone, self.whole, names, points)
            result, _ = self.model.evaluate(self.node.name, values)
        axis = len(self.cards)
        mean, tril, invalid = _parameters(result, shape, self.d)
        loc = np.broadcast_to(mean, shape + self.node.event_shape)
        loc = loc.reshape((*shape[: axis + 1], self.count, self.d))
        first = (slice(None),) * axis + (0,)
        self.tril = tril[first].reshape((*self.cards, self.count, self.d, self.d))
        bad = np.asarray(invalid.any(axis=axis))
        self.invalid = bad.reshape((*self.cards, self.count))
        self.offset = loc[first].copy()  # a view would keep all points alive
        if self.hidden:
            self._check_scale(tril, axis)
        loc = np.moveaxis(loc, axis, -1)  # (*cards, elements, d, points)
        steps = np.array([c.step for c in self.columns])
        n = len(steps)
        self.matrix = (loc[..., 1 : n + 1] - loc[..., :1]) / steps
        self._check_affine(loc[..., n + 1 :], moved)
        #: whether an element's mean varies along a column at all, shape (columns, elements)
        moves = (self.matrix != 0).any(axis=-2).reshape(math.prod(self.cards), self.count, n)
        self.used = np.asarray(moves.any(axis=0)).T

    def _points(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Values of the hidden parents at every point, and how far the last points moved each column."""
        count = 1 + len(self.columns) + _CHECKS
        points = {}
        for parent in self.hidden:
            node = self.model[parent.name]
            seen = self.observed.get(parent.name)
            base = np.zeros((math.prod(node.plate_shape), math.prod(node.event_shape)))
            if seen is not None and seen.mask is not None:
                known = seen.value.reshape(base.shape)
                base = np.where(seen.mask.reshape(-1, 1), known, base)
            points[parent.name] = np.repeat(base[None], count, axis=0)
        moved = np.zeros((_CHECKS, len(self.columns), self.count))
        for k, column in enumerate(self.columns):
            node = self.model[column.parent]
            free = hidden_elements(node, self.observed.get(column.parent))
            chosen = free if column.element is None else [column.element]
            value = points[column.parent]
            value[1 + k, chosen, column.component] += column.step
            # unlike each other, and short in binary, so that what cancels does so without rounding
            turns = np.round(256 * np.sin(1.0 + k + np.arange(_CHECKS * len(value[0])))) / 128
            shifts = column.step * turns.reshape(_CHECKS, -1)
            # to both sides of the base, as every step goes to one only
            shifts = np.abs(shifts) * (-1.0) ** np.arange(_CHECKS)[:, None]
            value[-_CHECKS:, chosen, column.component] += shifts[:, chosen]
            kept = np.zeros_like(shifts)
            kept[:, chosen] = shifts[:, chosen]
            at = self.places[column.parent] if column.element is None else column.element
            moved[:, k] = kept[:, at] if column.element is None else kept[:, at, None]
        shaped = {n: v.reshape((count, *self.model[n].value_shape)) for n, v in points.items()}
        return shaped, moved

    def _check_scale(self, tril: np.ndarray, axis: int) -> None:
        """The scale must be the same at all points, whatever tracing said."""
        off = np.abs(tril - np.expand_dims(np.take(tril, 0, axis=axis), axis))
        size = np.abs(tril).max(axis=(-2, -1), initial=0.0)
        moves = (off.max(axis=(-2, -1), initial=0.0) > _TOLERANCE * size).any(axis=axis)
        if (moves.reshape(self.invalid.shape) & ~self.invalid).any():
            raise UnsupportedError(
                f"node {self.node.name!r} has a scale that depends on "
                f"{', '.join(repr(p.name) for p in self.hidden)}"
            )

    def _check_affine(self, found: np.ndarray, moved: np.ndarray) -> None:
        """What the function gives at further points must be what its coefficients say."""
        spread = np.abs(self.tril).sum(axis=-1)  # what is far below the noise does not count
        step = max((c.step for c in self.columns), default=0.0)
        for check in range(_CHECKS):
            expected = self.offset + np.matvec(self.matrix, moved[check].T)
            size = np.abs(self.offset) + np.matvec(np.abs(self.matrix), np.abs(moved[check].T))
            allowed = _TOLERANCE * (size + spread) + 1e-12 * step
            wrong = np.abs(found[..., check] - expected) > allowed
            if (wrong & ~self.invalid[..., None]).any():
                raise UnsupportedError(
                    f"node {self.node.name!r} has a mean that is not affine in "
                    f"{', '.join(repr(p.name) for p in self.hidden)}"
                )

    # ---- one element, or elements that are alike -----------------------------------------------

    def _blocks(self, e: int) -> tuple[tuple[Variable, ...], list[int]]:
        """The blocks that an element's mean varies with, and their columns."""
        found: dict[Variable, list[int]] = {}
        for k, column in enumerate(self.columns):
            at = column.element
            block = (column.parent, int(self.places[column.parent][e]) if at is None else at)
            found.setdefault(block, []).append(k)
        kept = {b: ks for b, ks in found.items() if self.used[ks, e].any()}
        return tuple(kept), [k for ks in kept.values() for k in ks]

    def alike(self, elements: np.ndarray) -> Iterator[np.ndarray]:
        """Groups of elements that depend on the same discrete variables and blocks."""
        if len(elements) == 1:
            yield elements
            return
        keys = [self.places[n][elements] for n in self.alone]
        moved = [k for k, c in enumerate(self.columns) if c.element is not None]
        for k, c in enumerate(self.columns):
            if c.element is None:
                keys.append(np.where(self.used[k][elements], self.places[c.parent][elements], -1))
        bits = np.packbits(self.used[moved][:, elements], axis=0).T
        numbers = np.stack([*keys, np.zeros(len(elements), dtype=np.intp)], axis=1)
        packed = np.concatenate([np.ascontiguousarray(numbers).view(np.uint8), bits], axis=1)
        rows = np.ascontiguousarray(packed).view(np.dtype((np.void, packed.shape[1]))).ravel()
        _, group = np.unique(rows, return_inverse=True)
        order = np.argsort(group, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            yield elements[part]

    def _projected(self, parent: str) -> np.ndarray:
        plates, own = self.model[parent].plates, self.node.plates
        at = np.unravel_index(np.arange(self.count), self.node.plate_shape) if own else ()
        picked = [at[own.index(p)] for p in plates if p in own]
        if len(picked) < len(plates) or not plates:
            return np.zeros(self.count, dtype=np.intp)
        return np.ravel_multi_index(picked, self.model[parent].plate_shape)

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
    if isinstance(result, np.ndarray):
        return result, np.broadcast_to(0.0, (*shape, d, d)), np.broadcast_to(False, shape)
    assert isinstance(result, (Normal, MvNormal))
    if isinstance(result, Normal):
        tril = np.broadcast_to(result.scale, shape)[..., None, None]
    else:
        tril = np.broadcast_to(result.scale_tril, (*shape, d, d))
    bad = False if result.invalid is None else result.invalid
    if result.noiseless is not None:  # exact answers take it as it is
        bad = bad & ~result.noiseless
    return result.loc, tril, np.broadcast_to(bad, shape)


def _typical(probe: np.ndarray, components: int) -> list[float]:
    """A power of two near the size of each component's values, so that steps of it lose no digits."""
    sizes = np.abs(probe).reshape(-1, components).max(axis=0, initial=0.0)
    sizes = np.where((sizes > 0) & np.isfinite(sizes), sizes, 1.0)
    return (2.0 ** np.clip(np.round(np.log2(sizes)), -1000, 1000)).tolist()


def _constant_along(array: np.ndarray, axis: int) -> bool:
    first = array.take([0], axis=axis)
    return bool((array == first).all())
