"""What one term says of a Normal block: rows of residuals, affine in the block, and their noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal
from bayesmc.kernels.gaussian_layout import BlockSums, Layout
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.target import Target, Term, Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer


class BlockTerm:
    """What one term says of the block: rows ``constant + coefficients @ unknowns``, whitened.

    Coefficients and the data's part are kept where they cannot change; a noise that is the same for all
    elements of a chain then only scales what was summed before.
    """

    def __init__(
        self, target: Target, blankets: Mapping[str, Blanket], layout: Layout, term: Term
    ) -> None:
        self.target, self.layout, self.term = target, layout, term
        self.node = target.model[term.name]
        self.own = term.name in layout.names
        self.d = math.prod(self.node.event_shape)
        self.count = math.prod(term.shape)
        #: elements that count
        self.seen = self.count if term.mask is None else int(term.mask.sum())
        self.children: dict[str, Child] = {}
        for name, blanket in blankets.items():
            for child in blanket.children:
                if child.term is term:
                    self.children[name] = child
        self.blankets = blankets
        self.columns = [(n, c) for n in self.children for c in range(layout.dims[n])]
        self.dynamic = next(
            (n for n, c in self.children.items() if c.relation.kind == "lookup"), None
        )
        above = target.hidden_above(term)
        discrete = any(target.model[n].is_discrete for n in above)
        sources = None if discrete or self.dynamic else _affine_sources(target, term, above)
        #: coefficients never change; nor does anything else but the noise; nor does that
        self.constant = sources is not None
        self.fixed = sources is not None and sources <= set(layout.names)
        self.fixed &= self.own or term.name not in target.chain  # a hidden child's value changes
        self.frozen = self.fixed and set(above) <= set(layout.names)
        self.kept: Any = None
        self.slopes: np.ndarray | None = None
        self.summed: Any = None
        self.spots = None if self.dynamic else self._spots(())

    def add(self, base: Values, sums: BlockSums) -> None:
        """Add what the term says, given the state with the block at zero."""
        if self.stands(base):
            sums.add(*self.summed)
            return
        fixed = self._is_fixed(base)
        dist, _, keys = self._distribution(base)
        if dist.invalid is not None:
            lead = dist.invalid.shape[: max(dist.invalid.ndim - len(self.term.shape), 0)]
            invalid = np.broadcast_to(dist.invalid, lead + self.term.shape).reshape(*lead, -1)
            bad = np.asarray(invalid.any(axis=-1))
            sums.mark(bad, f"node {self.term.name!r}: {dist.problem}")
        spots = self.spots if self.spots is not None else self._spots(keys)
        uniform = self._uniform_scale(dist)
        if fixed and not self.frozen and uniform is not None:
            if self.summed is None:
                self.summed = _first(self._sums(*self._masked(*self._rows(base, dist)), spots))
            weight = uniform**-2.0
            precision, linear, constant = self.summed
            constant = weight * constant - self.seen * np.log(uniform)
            sums.add(weight[:, None] * precision, weight[:, None] * linear, constant)
            return
        rows = self.kept
        if rows is None or not fixed:
            rows = self._rows(base, dist)
            self.kept = _first(rows) if fixed else None
        whitened, log_det = self._whitened(dist, *rows)
        precision, linear, constant = self._sums(*whitened, spots)
        summed = precision, linear, constant - log_det
        if fixed and self.frozen:
            self.summed = _first(summed)
        sums.add(*summed)

    def stands(self, base: Values) -> bool:
        """Whether it says what it said before, which is known."""
        return self.frozen and self.summed is not None and self._is_fixed(base)

    # ---- private -------------------------------------------------------------------------------

    def _is_fixed(self, base: Values) -> bool:
        return self.fixed and (
            self.own or base[self.term.name] is self.target.known[self.term.name]
        )

    def _distribution(self, state: Values) -> tuple[Any, Any, Any]:
        if self.dynamic is not None:
            return self.blankets[self.dynamic].distribution(self.children[self.dynamic], state)
        return (*self.term.distribution(state), ())

    def _uniform_scale(self, dist: Any) -> np.ndarray | None:
        """The noise of a scalar term where it is the same for all its elements, shape (chains or 1,)."""
        if self.d != 1 or isinstance(dist, MvNormal):
            return None
        scale = dist.scale
        plates = len(self.term.shape)
        if plates and scale.ndim >= 1 and any(n != 1 for n in scale.shape[-plates:]):
            return None
        return scale.reshape(-1)

    def _rows(self, base: Values, dist: Any) -> tuple[np.ndarray, np.ndarray]:
        """Residuals: coefficients ``(lead, elements, d, columns)``, constants ``(lead, elements, d)``."""
        zero = self._flat(dist.loc)
        if self.slopes is not None:
            slopes = self.slopes
        else:
            steps = [self._flat(self._stepped(base, n, c).loc) - zero for n, c in self.columns]
            lead = np.broadcast_shapes((1,), *(s.shape[:1] for s in steps))
            slopes = np.zeros((*lead, self.count, self.d, len(steps)))
            for k, step in enumerate(steps):
                slopes[..., k] = step
            if self.constant:  # the same for all chains
                slopes = self.slopes = slopes[:1]
        coefficients = -slopes
        if not self.own:
            value = base[self.term.name]
            if isinstance(dist, LogNormal):
                value = np.log(value)
            return coefficients, self._flat(value) - zero
        free = self.layout.free[self.term.name].astype(float)
        identity = np.eye(self.d) * free[:, None, None]
        identity = np.broadcast_to(identity, (*coefficients.shape[:-1], self.d))
        seen = self._flat(self.layout.base[self.term.name])
        return np.concatenate([coefficients, identity], axis=-1), seen - zero

    def _stepped(self, base: Values, name: str, component: int) -> Any:
        """The term's distribution with one component of all free elements of a node at one."""
        node = self.layout.nodes[name]
        step = np.zeros((1, self.layout.counts[name], self.layout.dims[name]))
        step[0, self.layout.free[name], component] = 1.0
        state = dict(base)
        state[name] = base[name] + step.reshape(1, *node.value_shape)
        for link in self.target.below((name,)):
            state[link], _ = self.target.model.evaluate(link, state)
        return self._distribution(state)[0]

    def _flat(self, array: np.ndarray) -> np.ndarray:
        """``(*lead, *plates, *event)`` as ``(lead, elements, d)``."""
        shape = self.term.shape + self.node.event_shape
        array = np.asarray(array)
        lead = array.shape[: max(array.ndim - len(shape), 0)]
        full = np.broadcast_to(array, lead + shape)
        return full.reshape(math.prod(lead), self.count, self.d)

    def _whitened(
        self, dist: Any, rows: np.ndarray, rest: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Rows over the noise, and the log determinant of its root over all elements, shape (lead,)."""
        shape = np.broadcast_shapes(rows.shape[:-1], rest.shape)
        rows = np.broadcast_to(rows, (*shape, rows.shape[-1]))
        joint = np.concatenate([rows, np.broadcast_to(rest, shape)[..., None]], axis=-1)
        if isinstance(dist, MvNormal):
            factor = dist.scale_tril
            lead = factor.shape[: max(factor.ndim - 2 - len(self.term.shape), 0)]
            factor = np.broadcast_to(factor, (*lead, *self.term.shape, self.d, self.d))
            factor = factor.reshape(math.prod(lead), self.count, self.d, self.d)
            joint = np.linalg.solve(factor, joint)
            log_scale = np.log(np.linalg.diagonal(factor)).sum(axis=-1)
        else:
            scale = self._flat(dist.scale)
            joint = joint / scale[..., None]
            log_scale = np.log(scale).sum(axis=-1)
        if self.term.mask is not None:
            log_scale = log_scale * self.term.mask.reshape(-1)
        return self._masked(joint[..., :-1], joint[..., -1]), log_scale.sum(axis=-1)

    def _masked(self, rows: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of elements that do not count as zeros."""
        mask = self.term.mask
        if mask is None:
            return rows, rest
        return rows * mask.reshape(-1, 1, 1), rest * mask.reshape(-1, 1)

    def _spots(self, keys: Any) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the columns ``(lead, elements, columns)``, and entries of their pairs."""
        places = []
        for name, component in self.columns:
            at = self._elements_of(name, keys)
            places.append(self.layout.place(name, component, at))
        if self.own:
            own = np.arange(self.count)[None]
            places += [self.layout.place(self.term.name, c, own) for c in range(self.d)]
        at = np.stack(np.broadcast_arrays(*places), axis=-1)
        return at, self.layout.entry(at[..., :, None], at[..., None, :])

    def _elements_of(self, name: str, keys: Any) -> np.ndarray:
        """Element of a node that each element of the term depends on, shape (lead, elements)."""
        relation = self.children[name].relation
        if relation.kind == "lookup":
            index = relation.index_of(keys, self.term.shape)
            return index.reshape(-1, self.count)
        if relation.kind == "rows":
            return relation.rows[0][None]
        node = self.layout.nodes[name]
        if not node.plates:
            return np.zeros((1, self.count), dtype=np.intp)
        at = np.unravel_index(np.arange(self.count), self.term.shape)
        picked = [at[self.term.plates.index(p)] for p in node.plates]
        return np.ravel_multi_index(picked, node.plate_shape)[None]

    def _sums(
        self,
        rows: np.ndarray,
        rest: np.ndarray,
        spots: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precision entries, linear terms and constants summed over elements, lead in front."""
        pairs = np.einsum("...ka,...kb->...ab", rows, rows)
        line = -np.einsum("...ka,...k->...a", rows, rest)
        return (
            _scattered(pairs, spots[1], self.layout.entries),
            _scattered(line, spots[0], self.layout.size),
            -0.5 * (rest * rest).sum(axis=(-2, -1)),
        )


# ---- private ------------------------------------------------------------------------------------


def _affine_sources(target: Target, term: Term, above: tuple[str, ...]) -> set[str] | None:
    """The hidden nodes that a term's mean is jointly affine in; None where it is not in some."""
    if not above:
        return set()
    try:
        result = traced_term(target, above, term).result
    except Untraceable:
        return None
    loc = result.arguments.get("loc") if isinstance(result, TracedCall) else None
    if not isinstance(loc, Tracer):
        return set()
    return {n for s in loc.sources for n in above if _may_be(s, n)} if loc.is_affine else None


def _may_be(source: str, name: str) -> bool:
    """Whether a source may be a node, or a lookup in it: ``x[0]`` may be either."""
    return source == name or (source.startswith(f"{name}[") and source.endswith("]"))


def _first(arrays: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """What is the same for all chains, once."""
    return tuple(a[:1] for a in arrays)


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
