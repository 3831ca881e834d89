"""Coupled Normal nodes drawn jointly: random effects and their mean, coefficients of one regression.

Given everything else the block is Gaussian. Its precision and linear term are sums over the terms it
enters, whose coefficients come from evaluating the user's functions at zero and at unit steps. Elements of a
plate that meet only one by one (many small matrices), or the slices of a chain (a band), are eliminated
first, then the rest (one dense matrix): the cost is linear in those elements or slices. A precision that is
what it was in the sweep before is not factorised again.

References
----------
Rue and Held (2005), Gaussian Markov Random Fields, sec. 2.3 and 2.4; Gelfand, Sahu and Carlin (1995),
Biometrika 82, on why one at a time mixes slowly.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import is_
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal, Normal
from bayesmc.errors import DensityError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.gaussian_layout import BlockSums, Factor, Layout, factored, solved
from bayesmc.kernels.gaussian_terms import BlockTerm, block_terms
from bayesmc.kernels.verify import check_ratio
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer

#: components that one dense matrix may have, and how far from the diagonal a band may reach
MAX_DENSE = 400
#: numbers that are stored of one chain's precision
_MAX_ENTRIES = 1 << 22
#: nodes that are all named to the user, and how many of more
_SHOWN, _FEW = 8, 4
_FAMILIES = (Normal, MvNormal, LogNormal)


class GaussianBlock(Kernel):
    """Draws several Normal nodes from their joint full conditional.

    Parameters
    ----------
    blankets : dict
        Of the block's nodes.
    layout : Layout, optional
        Made before.
    """

    label = "conjugate block"

    def __init__(
        self,
        target: Target,
        blankets: Mapping[str, Blanket],
        debug: bool = False,
        layout: Layout | None = None,
    ) -> None:
        self.target = target
        self.names = tuple(blankets)
        self.debug = debug
        self.terms = target.terms_of(self.names)
        self.path = target.below(self.names)
        self.layout = layout or Layout(target, self.names, blankets, self.terms)
        self.parts = block_terms(target, blankets, self.layout, self.terms)
        self.match = "jointly Normal with " + shortened(self.names)
        #: what terms say that say the same in every sweep, and the data of which that holds
        self._standing: Any = None
        self._seen: Values = {}
        self._moving: list[BlockTerm] = []
        #: the precision of the last sweep and its factor
        self._last: tuple[np.ndarray, Factor] | None = None

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        sums = self._summed(values, len(values[self.names[0]]))
        noise = rng.standard_normal(sums.linear.shape)
        factor = self._factored(sums.precision)
        if (sums.bad | factor.bad).any():
            raise DensityError(self._why_bad(sums))
        draw = factor.solved(sums.linear, noise)
        new = self.layout.split(draw, values)
        if self.debug:
            self._check(values, new, sums.precision, sums.linear)
        return new, memory

    def log_integral(self, values: Values, count: int) -> np.ndarray:
        """Log of the block's terms, integrated over the block, shape (count,), up to a constant.

        Minus infinity where a parameter overflows or the precision is not positive definite.
        """
        sums = self._summed(values, count)
        mean, log_det, bad = solved(self.layout, sums, None)
        log = sums.constant + 0.5 * np.vecdot(sums.linear, mean) - 0.5 * log_det
        return np.where(bad | np.isnan(log), -np.inf, log)

    # ---- private -------------------------------------------------------------------------------

    def _summed(self, values: Values, chains: int) -> BlockSums:
        """What all terms say, the block at zero."""
        sums = BlockSums(chains, self.layout)
        moving = self.parts
        if self._stands(values):
            sums.add(*self._standing)
            moving = self._moving
        if moving:
            base = self._at_zero(values)
            for part in moving:
                part.add(base, sums)
            if self._standing is None:
                self._part_ways(base)
        return sums

    def _factored(self, precision: np.ndarray) -> Factor:
        """The factor of a precision: the last one, where that has not changed."""
        last = self._last
        if last is None or not np.array_equal(last[0], precision):
            last = self._last = precision, factored(self.layout, precision)
        return last[1]

    def _part_ways(self, base: Values) -> None:
        """Terms that say the same in every sweep are summed once, the others each time."""
        standing = [p for p in self.parts if p.stands(base)]
        self._moving = [p for p in self.parts if not p.stands(base)]
        if standing:
            columns = zip(*(p.summed for p in standing), strict=True)
            self._standing = tuple(sum(c) for c in columns)
            self._seen = {n: base[n] for p in standing for n in p.data}

    def _stands(self, values: Values) -> bool:
        """Whether all terms that were summed once still say the same."""
        seen = self._seen
        return self._standing is not None and all(
            map(is_, map(values.__getitem__, seen), seen.values())
        )

    def _why_bad(self, sums: BlockSums) -> str:
        if sums.problem is not None:
            return str(sums.problem)
        return (
            f"nodes {shortened(self.names, quoted=True)}: their joint precision given the others is not "
            "positive definite; a scale is near zero or infinite"
        )

    def _at_zero(self, values: Values) -> Values:
        """The state with the block at zero (what is seen of it stays)."""
        state = {**values, **self.layout.base}
        self.target.compute(state, self.path)
        return state

    def _check(
        self, values: Values, new: Values, precision: np.ndarray, linear: np.ndarray
    ) -> None:
        after = {**values, **new}
        self.target.refresh(after, self.names)
        logs: list[Any] = []
        sizes: list[Any] = []
        for state in (values, after):
            parts = [np.asarray(self.target.log_density(state, [t])) for t in self.terms]
            logs.append(sum(parts))
            sizes.append(sum(np.abs(p) for p in parts))
        joined = [self.layout.joined(state) for state in (values, after)]
        dense = self.layout.dense(precision)
        gauss = []
        for x in joined:
            gauss.append(np.vecdot(linear, x) - 0.5 * np.vecdot(x, np.matvec(dense, x)))
            sizes.append(np.abs(np.vecdot(linear, x)) + np.abs(np.vecdot(x, np.matvec(dense, x))))
        check_ratio(
            shortened(self.names),
            self.match,
            logs[1] - logs[0],
            gauss[1] - gauss[0],
            np.asarray(sum(sizes)),
        )


def gaussian_blocks(
    target: Target, blankets: Mapping[str, Blanket], debug: bool = False
) -> list[GaussianBlock]:
    """Blocks of two or more coupled Normal nodes whose terms are jointly affine in them."""
    able = [n for n, b in blankets.items() if _is_able(target, b)]
    found = []
    for names in _joint_groups(target, able, blankets):
        if len(names) > 1:
            found += _fitting(target, names, blankets, debug)
    return found


def vector_blocks(
    target: Target, blankets: Mapping[str, Blanket], joined: Collection[str], debug: bool = False
) -> list[GaussianBlock]:
    """Blocks of one Normal vector each, of those that are not ``joined`` to others.

    Its components are coupled as scalars of their own would be.
    """
    found = []
    for name, blanket in blankets.items():
        if name not in joined and math.prod(blanket.event_shape) > 1 and _is_able(target, blanket):
            found += _fitting(target, [name], blankets, debug)
    return found


def shortened(names: Sequence[str], quoted: bool = False) -> str:
    """The first few names, and how many there are.

    Examples
    --------
    >>> from bayesmc.kernels.gaussian_block import shortened
    >>> shortened([f"x[{t}]" for t in range(1000)])
    'x[0], x[1], x[2], x[3], ... (1000 nodes)'
    """
    shown = [repr(n) if quoted else n for n in names]
    if len(names) > _SHOWN:
        shown = [*shown[:_FEW], f"... ({len(names)} nodes)"]
    return ", ".join(shown)


# ---- private ------------------------------------------------------------------------------------


def _is_able(target: Target, blanket: Blanket) -> bool:
    """Whether a node is Normal with a Gaussian full conditional, as far as blocks can use it."""
    if blanket.own is None or len(blanket.event_shape) > 1 or blanket.node.is_discrete:
        return False
    for child in blanket.children:
        kind = child.relation.kind
        if kind == "whole" or (kind == "rows" and len(child.relation.rows) != 1):
            return False
        if child.term.is_potential or not _is_affine(target, (blanket.name,), child.term):
            return False
    return _is_affine(target, (), blanket.own, (Normal, MvNormal))


def _is_affine(
    target: Target, names: tuple[str, ...], term: Term, families: tuple[type, ...] = _FAMILIES
) -> bool:
    """Whether a term is Gaussian with a mean affine in the nodes, and nothing else of it varies with them."""
    if not names:
        try:
            known, probe = target.known, target.model.probe
            values = {n: known[n] if n in known else probe[n] for n in term.parents}
            result = target.model.evaluate(term.name, values)[0]
        except Exception:
            return False
        return type(result) in families
    try:
        result = traced_term(target, names, term).result
    except Untraceable:
        return False
    if not isinstance(result, TracedCall):
        return type(result) in families  # it names the nodes and does nothing with them
    if result.function not in families:
        return False
    traced = result.traced
    return set(traced) <= {"loc"} and all(
        isinstance(v, Tracer) and v.is_affine for v in traced.values()
    )


def _fitting(
    target: Target, names: Sequence[str], blankets: Mapping[str, Blanket], debug: bool
) -> list[GaussianBlock]:
    """A group as one block, or cut into halves (each drawn given the other) where that is too large."""
    if len(names) < 2 and not any(target.model[n].event_shape for n in names):
        return []
    own = {n: blankets[n] for n in names}
    layout = Layout(target, names, own, target.terms_of(names))
    if max(layout.width, layout.dg) <= MAX_DENSE and layout.entries <= _MAX_ENTRIES:
        return [GaussianBlock(target, own, debug, layout)]
    if len(names) < 2:
        return []
    half = len(names) // 2
    halves = names[:half], names[half:]
    return [block for part in halves for block in _fitting(target, part, blankets, debug)]


@dataclass(eq=False)
class _Group:
    """Nodes whose terms are jointly affine in them, and how they enter each term."""

    names: list[str]
    #: term -> nodes that it reads, and the kinds of relation
    children: dict[str, list[tuple[str, str]]]
    #: when it got its last member
    age: int
    #: the group that it has become part of
    into: _Group | None = None

    def now(self) -> _Group:
        group = self
        while group.into is not None:
            group = group.into
        return group


def _joint_groups(
    target: Target, able: Sequence[str], blankets: Mapping[str, Blanket]
) -> list[list[str]]:
    """Nodes that can be drawn together, each group in the chain's order.

    A node joins the groups whose terms it enters. Of two groups only the terms that both enter can stand in
    the way, and the smaller goes into the larger, so a slice of a long chain costs what one of a short does.
    """
    place = {n: i for i, n in enumerate(target.chain)}
    owners: dict[str, list[_Group]] = {}
    groups: list[_Group] = []
    for age, name in enumerate(able):
        children: dict[str, list[tuple[str, str]]] = {}
        for child in blankets[name].children:
            children.setdefault(child.term.name, []).append((name, child.relation.kind))
        merged = alone = _Group([name], children, age)
        terms = [t.name for t in target.terms_of((name,))]
        shared = {g.now() for t in terms for g in owners.get(t, ())}
        for group in sorted(shared, key=lambda g: g.age):
            if _jointly_affine(target, group, merged):
                merged = _merged(group, merged, age)
        groups.append(alone)
        for term in terms:
            owners.setdefault(term, []).append(alone)
    found = sorted((g for g in groups if g.into is None), key=lambda g: g.age)
    return [sorted(g.names, key=place.__getitem__) for g in found]


def _merged(one: _Group, other: _Group, age: int) -> _Group:
    """Two groups as one: the larger, changed."""
    small, large = sorted((one, other), key=lambda g: len(g.names))
    small.into = large
    large.age = age
    large.names += small.names
    for term, entering in small.children.items():
        large.children.setdefault(term, []).extend(entering)
    return large


def _jointly_affine(target: Target, one: _Group, other: _Group) -> bool:
    """Whether the terms that two groups share are affine in the nodes of both."""
    small, large = sorted((one.children, other.children), key=len)
    for name, these in small.items():
        if name not in large:
            continue
        found = [*these, *large[name]]
        entering = tuple(dict.fromkeys(n for n, _ in found))
        if any(kind == "lookup" for _, kind in found):
            return False
        if not _is_affine(target, entering, target.terms[name]):
            return False
    return True
