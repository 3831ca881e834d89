"""What terms say of a Normal block: rows of residuals, affine in the block, and their noise.

Like terms (the transitions of a chain of slices) are one, in one more plate.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from operator import is_
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal
from bayesmc.distributions.noiseless import with_noise
from bayesmc.errors import BayesmcError
from bayesmc.kernels.gaussian_layout import BlockSums, Layout
from bayesmc.kernels.gaussian_order import elements_read
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.like_functions import Slots, stack_arrays
from bayesmc.structure.like_terms import FEWEST, LikeTerms, TermSum
from bayesmc.structure.target import Target, Term, Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer

#: term -> the children by which the block's nodes enter it
Entering = Mapping[str, Mapping[str, Child]]


def block_terms(
    target: Target, blankets: Mapping[str, Blanket], layout: Layout, terms: Sequence[Term]
) -> list[BlockTerm]:
    """The terms of a block, like ones as one, in the order in which they begin."""
    entering: dict[str, dict[str, Child]] = {t.name: {} for t in terms}
    for name, blanket in blankets.items():
        for child in blanket.children:
            entering[child.term.name][name] = child
    parts = {}
    inside: set[str] = set()
    for group in _stacked(target, layout, terms, entering):
        members = [target.terms[n] for n in group.names]
        part = BlockTerm(target, blankets, layout, entering, members, group)
        if part.constant or not part.linked:
            parts[group.names[0]] = part
            inside |= set(group.names)
    for term in terms:
        if term.name not in inside:
            parts[term.name] = BlockTerm(target, blankets, layout, entering, [term])
    return [parts[t.name] for t in terms if t.name in parts]


class BlockTerm:
    """What one term, or a group of like ones, says of the block: rows ``constant + coefficients @ unknowns``.

    Coefficients and the data's part are kept where they cannot change; a noise that is the same for all
    elements of a chain then only scales what was summed before.

    Parameters
    ----------
    entering : dict
        Term -> node of the block -> how it enters.
    members : sequence of Term
    like : LikeTerms, optional
        The members as one; of a single term the block's own functions are asked.
    """

    def __init__(
        self,
        target: Target,
        blankets: Mapping[str, Blanket],
        layout: Layout,
        entering: Entering,
        members: Sequence[Term],
        like: LikeTerms | None = None,
    ) -> None:
        self.target, self.layout, self.blankets = target, layout, blankets
        self.members, self.like = tuple(members), like
        self.term = members[0] if like is None else like.term
        self.shape = self.term.shape if like is None else like.shape
        self.node = self.term.model[self.term.name]
        self.own = self.term.name in layout.names
        self.d = math.prod(self.node.event_shape)
        self.count = math.prod(self.shape)
        mask = self.term.mask
        #: elements that count
        self.seen = self.count if mask is None else int(mask.sum())
        self.children = dict(entering[self.term.name])
        self.columns = self._columns(self.children)
        #: the block enters like terms through deterministic nodes: slopes are found one by one
        self.linked = like is not None and _is_linked(target, self.term, self.children)
        self.dynamic = next(
            (n for n, c in self.children.items() if c.relation.kind == "lookup"), None
        )
        #: coefficients never change; nor does anything else but the noise; nor does that
        constancy = [self._constancy(t) for t in members]
        self.constant, self.fixed, self.frozen = (all(c) for c in zip(*constancy, strict=True))
        self.data = () if self.own else tuple(t.name for t in members)
        self._known = [target.known.get(n) for n in self.data]
        self.kept: Any = None
        self.slopes: np.ndarray | None = None
        self.summed: Any = None
        if like is not None:
            self._gather(like)
        self.spots = None if self.dynamic else self._spots(entering, ())
        self._entering = entering

    def add(self, base: Values, sums: BlockSums) -> None:
        """Add what the term says, given the state with the block at zero."""
        if self.stands(base):
            sums.add(*self.summed)
            return
        fixed = self._is_fixed(base)
        state = base if self.like is None else self._gathered(base)
        dist, keys = self._evaluated(base, state)
        self._mark_invalid(dist, sums)
        spots = self.spots if self.spots is not None else self._spots(self._entering, keys)
        uniform = self._uniform_scale(dist)
        if fixed and not self.frozen and uniform is not None:
            if self.summed is None:
                rows = self._rows(base, state, dist)
                self.summed = _first(self._sums(*self._masked(*rows), spots))
            weight = uniform**-2.0
            precision, linear, constant = self.summed
            constant = weight * constant - self.seen * np.log(uniform)
            sums.add(weight[:, None] * precision, weight[:, None] * linear, constant)
            return
        rows = self.kept
        if rows is None or not fixed:
            rows = self._rows(base, state, dist)
            self.kept = _first(rows) if fixed else None
        whitened, log_det = self._whitened(dist, *rows)
        precision, linear, constant = self._sums(*whitened, spots)
        summed = precision, linear, constant - log_det
        if fixed and self.frozen:
            self.summed = _first(summed)
        sums.add(*summed)

    def stands(self, values: Values) -> bool:
        """Whether it says what it said before, which is known."""
        return self.frozen and self.summed is not None and self._is_fixed(values)

    # ---- private -------------------------------------------------------------------------------

    def _constancy(self, term: Term) -> tuple[bool, bool, bool]:
        """Whether the coefficients, all but the noise, and everything that a term says never change."""
        target, names = self.target, self.layout.start
        above = target.hidden_above(term)
        discrete = any(target.model[n].is_discrete for n in above)
        sources = None if discrete or self.dynamic else _affine_sources(target, term, above)
        if sources is None:
            return False, False, False
        fixed = all(n in names for n in sources)
        fixed &= self.own or term.name not in target.chain  # a hidden child's value changes
        return True, fixed, fixed and all(n in names for n in above)

    def _is_fixed(self, values: Values) -> bool:
        return self.fixed and all(map(is_, [values[n] for n in self.data], self._known))

    def _gather(self, like: LikeTerms) -> None:
        """Which names stand for nodes of the block, at zero always, and which for others."""
        sources, names = like.slots.sources, self.layout.start
        base = self.layout.base
        self._zero = {
            n: stack_arrays([base[m] for m in these], len(self.target.model[n].value_shape))
            for n, these in sources.items()
            if n in names
        }
        others = {n: these for n, these in sources.items() if n not in names}
        self._slots = Slots(self.target, others, len(self.members))

    def _gathered(self, base: Values) -> Values:
        return {**self._slots.gathered(base), **self._zero}

    def _evaluated(self, base: Values, state: Values) -> tuple[Any, Any]:
        """The distribution, and the index by which it read the block."""
        try:
            return self._distribution(state)
        except BayesmcError:
            if self.like is not None:
                for term in self.members:  # the group knows the first one's name only
                    term.distribution(base)
            raise

    def _distribution(self, state: Values) -> tuple[Any, Any]:
        if self.dynamic is not None:
            child = self.children[self.dynamic]
            dist, _, keys = self.blankets[self.dynamic].distribution(child, state)
            return with_noise(dist), keys
        return with_noise(self.term.distribution(state)[0]), ()

    def _mark_invalid(self, dist: Any, sums: BlockSums) -> None:
        if dist.invalid is None:
            return
        lead = dist.invalid.shape[: max(dist.invalid.ndim - len(self.shape), 0)]
        each = np.broadcast_to(dist.invalid, lead + self.shape)
        invalid = np.asarray(each.reshape(*lead, len(self.members), -1).any(axis=-1))
        bad = np.asarray(invalid.any(axis=-1))
        if bad.any():
            first = int(np.argmax(invalid.reshape(-1, len(self.members)).any(axis=0)))
            sums.mark(bad, f"node {self.members[first].name!r}: {dist.problem}")

    def _uniform_scale(self, dist: Any) -> np.ndarray | None:
        """The noise of a scalar term where it is the same for all its elements, shape (chains or 1,)."""
        if self.d != 1 or isinstance(dist, MvNormal):
            return None
        scale = dist.scale
        plates = len(self.shape)
        if plates and scale.ndim >= 1 and any(n != 1 for n in scale.shape[-plates:]):
            return None
        return scale.reshape(-1)

    def _rows(self, base: Values, state: Values, dist: Any) -> tuple[np.ndarray, np.ndarray]:
        """Residuals: coefficients ``(lead, elements, d, columns)``, constants ``(lead, elements, d)``."""
        zero = self._flat(dist.loc)
        if self.linked and self.slopes is None:
            self.slopes = self._slopes_one_by_one(base)
        if self.slopes is not None:
            slopes = self.slopes
        else:
            steps = [self._flat(self._stepped(state, n, c).loc) - zero for n, c in self.columns]
            lead = np.broadcast_shapes((1,), *(s.shape[:1] for s in steps))
            slopes = np.zeros((*lead, self.count, self.d, len(steps)))
            for k, step in enumerate(steps):
                slopes[..., k] = step
            if self.constant:  # the same for all chains
                slopes = self.slopes = slopes[:1]
        coefficients = -slopes
        if not self.own:
            value = state[self.term.name]
            if isinstance(dist, LogNormal):
                value = np.log(value)
            return coefficients, self._flat(value) - zero
        free = np.concatenate([self.layout.free[t.name] for t in self.members]).astype(float)
        identity = np.eye(self.d) * free[:, None, None]
        identity = np.broadcast_to(identity, (*coefficients.shape[:-1], self.d))
        seen = self._flat(state[self.term.name])
        return np.concatenate([coefficients, identity], axis=-1), seen - zero

    def _stepped(self, base: Values, name: str, component: int) -> Any:
        """The distribution with one component of all free elements of a node at one."""
        state = dict(base)
        state[name] = base[name] + self._step(name, component).reshape(base[name].shape)
        if self.like is None:
            self.target.compute(state, self.target.between((name,), self.term))
        return self._distribution(state)[0]

    def _slopes_one_by_one(self, base: Values) -> np.ndarray:
        """Constant slopes of like terms, each from its own functions, shape (1, elements, d, columns)."""
        layout, found = self.layout, []
        for term in self.members:
            dist: Any = term.distribution(base)[0]
            zero = self._flat(dist.loc, term.shape)
            steps = []
            for name, component in self._columns(self._entering[term.name]):
                step = np.zeros((layout.counts[name], layout.dims[name]))
                step[:, component] = layout.free[name]
                state = {**base, name: base[name] + step.reshape(base[name].shape)}
                self.target.compute(state, self.target.between((name,), term))
                dist = term.distribution(state)[0]
                steps.append(self._flat(dist.loc, term.shape)[0] - zero[0])
            found.append(np.stack(steps, axis=-1))
        return np.concatenate(found)[None]

    def _step(self, name: str, component: int) -> np.ndarray:
        layout = self.layout
        names = (name,) if self.like is None else self.like.slots.sources[name]
        step = np.zeros((len(names), layout.counts[name], layout.dims[name]))
        step[..., component] = [layout.free[n] for n in names]
        return step

    def _columns(self, names: Iterable[str]) -> list[tuple[str, int]]:
        """The components of some nodes."""
        return [(n, c) for n in names for c in range(self.layout.dims[n])]

    def _flat(self, array: np.ndarray, plates: Shape | None = None) -> np.ndarray:
        """``(*lead, *plates, *event)`` as ``(lead, elements, d)``."""
        plates = self.shape if plates is None else plates
        shape = plates + self.node.event_shape
        array = np.asarray(array)
        lead = array.shape[: max(array.ndim - len(shape), 0)]
        full = np.broadcast_to(array, lead + shape)
        return full.reshape(math.prod(lead), math.prod(plates), self.d)

    def _whitened(
        self, dist: Any, rows: np.ndarray, rest: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Rows over the noise, and the log determinant of its root over all elements, shape (lead,)."""
        shape = np.broadcast_shapes(rows.shape[:-1], rest.shape)
        rows = np.broadcast_to(rows, (*shape, rows.shape[-1]))
        joint = np.concatenate([rows, np.broadcast_to(rest, shape)[..., None]], axis=-1)
        if isinstance(dist, MvNormal):
            factor = dist.scale_tril
            lead = factor.shape[: max(factor.ndim - 2 - len(self.shape), 0)]
            factor = np.broadcast_to(factor, (*lead, *self.shape, self.d, self.d))
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

    def _spots(self, entering: Entering, keys: Any) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the columns ``(lead, elements, columns)``, and entries of their pairs."""
        each = [self._places(entering, term, keys) for term in self.members]
        at = each[0] if len(each) == 1 else np.concatenate(each, axis=1)
        return at, self.layout.entry(at[..., :, None], at[..., None, :])

    def _places(self, entering: Entering, term: Term, keys: Any) -> np.ndarray:
        """Positions of the columns of one term, shape (lead, its elements, columns)."""
        layout = self.layout
        count = math.prod(term.shape)
        found = []
        columns = self.columns
        if self.linked:
            columns = self._columns(entering[term.name])
        elif self.like is not None:  # the nodes in the same places
            scope = self.members[0].scope
            columns = [(term.scope[scope.index(n)], c) for n, c in columns]
        for name, component in columns:
            relation = entering[term.name][name].relation
            elements = elements_read(relation, term)
            if elements is None:
                elements = relation.index_of(keys, term.shape).reshape(-1, count)
            found.append(layout.place(name, component, np.atleast_2d(elements)))
        if self.own:
            own = np.arange(count)[None]
            found += [layout.place(term.name, c, own) for c in range(self.d)]
        return np.stack(np.broadcast_arrays(*found), axis=-1)

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


def _stacked(
    target: Target, layout: Layout, terms: Sequence[Term], entering: Entering
) -> list[LikeTerms]:
    """Groups of like terms that the block's nodes enter alike."""
    alike: dict[Hashable, list[Term]] = {}
    for term in terms:
        key = _how_entered(target, layout, term, entering[term.name])
        if key is not None:
            alike.setdefault(key, []).append(term)
    many = [t for t in alike.values() if len(t) >= FEWEST]
    return [group for t in many for group in TermSum(target, t).groups]


def _how_entered(
    target: Target, layout: Layout, term: Term, children: Mapping[str, Child]
) -> Hashable | None:
    """How the block enters a term: in which places, or with how many columns; None by varying indices."""
    if any(c.relation.kind == "lookup" for c in children.values()):
        return None
    if _is_linked(target, term, children):
        own = tuple(n in layout.start for n in term.scope)
        return own, tuple(layout.dims[n] for n in children)
    kinds = tuple((n in layout.start, _kind(children.get(n))) for n in term.scope)
    return kinds if set(children) <= set(term.scope) else None


def _is_linked(target: Target, term: Term, children: Iterable[str]) -> bool:
    """Whether some nodes enter a term through deterministic ones."""
    return bool(target.between(tuple(children), term))


def _kind(child: Child | None) -> str | None:
    return None if child is None else child.relation.kind


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
