"""Coupled Normal nodes drawn jointly: random effects and their mean, coefficients of one regression.

Given everything else the block is Gaussian. Its precision and linear term are sums over the terms it
enters, whose coefficients are read off the expression graph. Elements of a plate that meet only one by one
(many small matrices), or the slices of a chain (a band), are eliminated first, then the rest (one dense
matrix): the cost is linear in those elements or slices. A precision that is what it was in the sweep before
is not factorised again.

References
----------
Rue and Held (2005), Gaussian Markov Random Fields, sec. 2.3 and 2.4; Gelfand, Sahu and Carlin (1995),
Biometrika 82, on why one at a time mixes slowly.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from operator import is_
from typing import Any

import numpy as np

from bayesmc.errors import DensityError
from bayesmc.kernels.base import Kernel, Memory, check_ratio
from bayesmc.kernels.gaussian_layout import BlockSums, Components, Layout
from bayesmc.kernels.gaussian_rows import NormalRows
from bayesmc.kernels.gaussian_terms import NormalTerms
from bayesmc.linalg.patterns import cholesky, lapack, triangular
from bayesmc.passes.reads import is_recursion
from bayesmc.structure.target import Target, Values

#: components that one dense matrix may have, and how far from the diagonal a band may reach
MAX_DENSE = 400
#: numbers that are stored of one chain's precision
_MAX_ENTRIES = 1 << 22
#: components up to which triangles are solved by one call for all chains
_SMALL = 32
#: nodes that are all named to the user, and how many of more
_SHOWN, _FEW = 8, 4


@dataclass(frozen=True, eq=False)
class Factor:
    """A factorised precision: what solving needs of it, for each chain or one for all.

    Attributes
    ----------
    root : ndarray
        Of what is eliminated first.
    mixed : ndarray, shape (lead, cut, dg)
        ``root^-1`` times the entries between that and the rest.
    rest : ndarray, shape (lead, dg, dg)
        Cholesky factor of the rest, the first part eliminated.
    log_det : ndarray, shape (lead,)
        Of the precision.
    bad : ndarray of bool, shape (lead,)
        It is not positive definite.
    """

    layout: Layout
    root: np.ndarray
    mixed: np.ndarray
    rest: np.ndarray
    log_det: np.ndarray
    bad: np.ndarray

    def halves(self, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A vector by the inverse of the precision's root: of what is eliminated first, and of the rest."""
        layout, cut = self.layout, self.layout.cut
        head, half = linear[:, :cut], linear[:, cut:]
        if cut:
            head = layout.first.lower(self.root, head[..., None])[..., 0]
        if layout.dg:
            if cut:
                half = half - np.vecmat(head, self.mixed)
            half = _triangle(self.rest, half, "N")
        return head, half

    def solved(self, linear: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        """The mean, plus noise of the Gaussian's covariance, shape (chains, size)."""
        layout, cut = self.layout, self.layout.cut
        joined = np.empty_like(linear)
        head, half = self.halves(linear)
        if noise is not None:
            head, half = head + noise[:, :cut], half + noise[:, cut:]
        if layout.dg:
            joined[:, cut:] = _triangle(self.rest, half, "T")
        if cut:
            if layout.dg:
                head = head - np.matvec(self.mixed, joined[:, cut:])
            joined[:, :cut] = layout.first.upper(self.root, head[..., None])[..., 0]
        return joined


def factored(layout: Layout, precision: np.ndarray) -> Factor:
    """Factorise precisions as ``BlockSums`` holds them."""
    first, mixed, rest = layout.parts(layout.with_units(precision))
    lead = len(precision)
    log_det, bad = np.zeros(lead), np.zeros(lead, dtype=bool)
    root = first
    if layout.cut:
        root, log_det, bad = layout.first.factored(first)
        if layout.dg:
            mixed = layout.first.lower(root, mixed)
            rest = rest - np.swapaxes(mixed, -1, -2) @ mixed
    if layout.dg:
        rest, wrong = cholesky(rest)
        bad = bad | wrong
        log_det = log_det + 2.0 * np.log(np.linalg.diagonal(rest)).sum(axis=-1)
    return Factor(layout, root, mixed, rest, log_det, bad)


def solved(
    layout: Layout, sums: BlockSums, noise: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean plus noise of the Gaussian's covariance, the log determinant of its precision, and bad chains."""
    factor = factored(layout, sums.precision)
    joined = factor.solved(sums.linear, noise)
    shape = (len(joined),)
    return joined, np.broadcast_to(factor.log_det, shape), sums.bad | factor.bad


class GaussianBlock(Kernel):
    """Draws several Normal nodes from their joint full conditional.

    Parameters
    ----------
    target : Target
    names : iterable of str
        The block's nodes.
    normal : NormalTerms, optional
        The target's, read before.

    Attributes
    ----------
    terms : tuple of Term
        All that some node enters.
    parts : list of NormalRows
        What these say, like ones as one.
    layout : Layout
    """

    label = "conjugate block"

    def __init__(
        self,
        target: Target,
        names: Iterable[str],
        debug: bool = False,
        normal: NormalTerms | None = None,
    ) -> None:
        self.target, self.names, self.debug = target, tuple(names), debug
        self.terms = target.terms_of(self.names)
        self.path = target.below(self.names)
        normal = normal or NormalTerms(target)
        components = Components(target, self.names)
        like = normal.like(self.terms, components.start)
        self.parts = [NormalRows(target, group, components) for group in like]
        components.meetings = [part.meeting for part in self.parts]
        self.layout = Layout(components)
        for part in self.parts:
            part.layout = self.layout
        self.match = "jointly Normal with " + shortened(self.names)
        #: what terms say that say the same in every sweep, and the data of which that holds
        self._standing: Any = None
        self._seen: Values = {}
        self._moving: list[NormalRows] = []
        #: the precision of the last sweep and its factor
        self._last: tuple[np.ndarray, Factor] | None = None

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        sums = self._summed(values, len(values[self.names[0]]))
        noise = rng.standard_normal(sums.linear.shape)
        factor = self._factored(sums.precision)
        if (sums.bad | factor.bad).any():
            raise DensityError(self._why_bad(values))
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
        factor = factored(self.layout, sums.precision)
        square = sum(np.vecdot(part, part) for part in factor.halves(sums.linear))
        log = sums.constant + 0.5 * square - 0.5 * factor.log_det
        return np.where(sums.bad | factor.bad | np.isnan(log), -np.inf, log)

    # ---- private -------------------------------------------------------------------------------

    def _summed(self, values: Values, chains: int) -> BlockSums:
        """What all terms say, the block at zero."""
        sums = BlockSums(chains, self.layout)
        moving = self.parts
        if self._stands(values):
            sums.add(*self._standing)
            moving = self._moving
        for part in moving:
            part.add(values, sums)
        if self._standing is None:
            self._part_ways(values)
        return sums

    def _factored(self, precision: np.ndarray) -> Factor:
        """The factor of a precision: the last one, where that has not changed."""
        last = self._last
        if last is None or not np.array_equal(last[0], precision):
            last = self._last = precision, factored(self.layout, precision)
        return last[1]

    def _part_ways(self, values: Values) -> None:
        """Terms that say the same in every sweep are summed once, the others each time."""
        standing = [p.standing for p in self.parts if p.standing is not None]
        self._moving = [p for p in self.parts if p.standing is None]
        if standing:
            self._standing = tuple(sum(c) for c in zip(*standing, strict=True))
            still = [p for p in self.parts if p.standing is not None]
            self._seen = {n: values[n] for p in still for n in p.program.watched}

    def _stands(self, values: Values) -> bool:
        """Whether all terms that were summed once still say the same."""
        seen = self._seen
        return self._standing is not None and all(
            map(is_, map(values.__getitem__, seen), seen.values())
        )

    def _why_bad(self, values: Values) -> str:
        for part in self.parts:
            if (problem := part.problem(values)) is not None:
                return problem
        return (
            f"nodes {shortened(self.names, quoted=True)}: their joint precision given the others is not "
            "positive definite; a scale is near zero or infinite"
        )

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
    target: Target, names: Iterable[str], debug: bool = False
) -> list[GaussianBlock]:
    """Blocks of two or more coupled Normal nodes whose terms are jointly affine in them."""
    normal = NormalTerms(target)
    able = [n for n in names if _is_able(normal, n)]
    groups = [g for g in _joint_groups(normal, able) if len(g) > 1]
    return [block for group in groups for block in _fitting(normal, group, debug)]


def vector_blocks(
    target: Target, names: Iterable[str], joined: Collection[str], debug: bool = False
) -> list[GaussianBlock]:
    """Blocks of one Normal vector each, of those that are not ``joined`` to others.

    Its components are coupled as scalars of their own would be.
    """
    normal, nodes = NormalTerms(target), target.model.nodes
    alone = [n for n in names if n not in joined and math.prod(nodes[n].event_shape) > 1]
    able = [n for n in alone if _is_able(normal, n)]
    return [block for name in able for block in _fitting(normal, [name], debug)]


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


def _is_able(normal: NormalTerms, name: str) -> bool:
    """Whether a node is Normal with a Gaussian full conditional."""
    if normal.target.model[name].is_discrete or not normal.is_prior(name):
        return False
    terms = normal.target.terms_of((name,))
    if is_recursion([t.expression for t in terms if t.expression is not None], name):
        return False
    found = [normal.of(t.name) for t in terms]
    return all(f is not None and normal.are_joint(f, (name,)) for f in found)


def _fitting(normal: NormalTerms, names: Sequence[str], debug: bool) -> list[GaussianBlock]:
    """A group as one block, or cut into halves (each drawn given the other) where that is too large."""
    target = normal.target
    if len(names) < 2 and not any(target.model[n].event_shape for n in names):
        return []
    block = GaussianBlock(target, names, debug, normal)
    layout = block.layout
    if max(layout.width, layout.dg) <= MAX_DENSE and layout.entries <= _MAX_ENTRIES:
        return [block]
    if len(names) < 2:
        return []
    half = len(names) // 2
    halves = names[:half], names[half:]
    return [block for part in halves for block in _fitting(normal, part, debug)]


@dataclass(eq=False)
class _Group:
    """Nodes whose terms are jointly affine in them, and how they enter each term."""

    names: list[str]
    #: the terms that these enter
    terms: set[str]
    #: when it got its last member
    age: int
    #: the group that it has become part of
    into: _Group | None = None

    def now(self) -> _Group:
        group = self
        while group.into is not None:
            group = group.into
        return group


def _joint_groups(normal: NormalTerms, able: Sequence[str]) -> list[list[str]]:
    """Nodes that can be drawn together, each group in the chain's order.

    A node joins the groups whose terms it enters. Of two groups only the terms that both enter can stand in
    the way, and the smaller goes into the larger, so a slice of a long chain costs what one of a short does.
    """
    target = normal.target
    place = {n: i for i, n in enumerate(target.chain)}
    entered: dict[str, list[_Group]] = {}
    owner: dict[str, _Group] = {}
    for age, name in enumerate(able):
        terms = [t.name for t in target.terms_of((name,))]
        merged = alone = owner[name] = _Group([name], set(terms), age)
        shared = {g.now() for t in terms for g in entered.get(t, ())}
        for group in sorted(shared, key=lambda g: g.age):
            if _are_joint(normal, owner, group, merged):
                merged = _merged(group, merged, age)
        for term in terms:
            entered.setdefault(term, []).append(alone)
    found = sorted((g for g in owner.values() if g.into is None), key=lambda g: g.age)
    return [sorted(g.names, key=place.__getitem__) for g in found]


def _merged(one: _Group, other: _Group, age: int) -> _Group:
    """Two groups as one: the larger, changed."""
    small, large = sorted((one, other), key=lambda g: len(g.names))
    small.into = large
    large.age = age
    large.names += small.names
    large.terms |= small.terms
    return large


def _are_joint(normal: NormalTerms, owner: dict[str, _Group], one: _Group, other: _Group) -> bool:
    """Whether the terms that two groups share are affine in the nodes of both."""
    small, large = sorted((one.terms, other.terms), key=len)
    for term in small & large:
        found = normal.of(term)
        assert found is not None, "a node that is able enters Normal terms only"
        inside = [n for n in found.leaves if n in owner and owner[n].now() in (one, other)]
        if not normal.are_joint(found, inside):
            return False
    return True


def _triangle(factor: np.ndarray, right: np.ndarray, trans: str) -> np.ndarray:
    """Lower triangles, or their transposes, solved for one vector each ``(chains, d)``."""
    if factor.shape[-1] <= _SMALL:
        return triangular(factor, right[..., None], trans == "T")[..., 0]
    trtrs = lapack().dtrtrs
    if len(factor) == 1:
        return trtrs(factor[0], right.T, lower=1, trans=int(trans == "T"))[0].T
    pairs = zip(factor, right, strict=True)
    return np.stack([trtrs(f, r, lower=1, trans=int(trans == "T"))[0] for f, r in pairs])
