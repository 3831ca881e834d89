"""Coupled Normal nodes drawn jointly: random effects and their mean, coefficients of one regression.

Given everything else the block is Gaussian. Its precision and linear term are sums over the terms it
enters, whose coefficients come from evaluating the user's functions at zero and at unit steps. The nodes of
one plate that meet only element by element are eliminated first (many small matrices), then the rest (one
dense matrix): the cost is linear in the elements of that plate.

References
----------
Rue and Held (2005), Gaussian Markov Random Fields, sec. 2.3; Gelfand, Sahu and Carlin (1995), Biometrika 82,
on why one at a time mixes slowly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal, Normal
from bayesmc.errors import DensityError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.gaussian_layout import BlockSums, Layout, solved
from bayesmc.kernels.gaussian_terms import BlockTerm
from bayesmc.kernels.verify import check_ratio
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer

#: components that one dense matrix may have
MAX_DENSE = 400
#: nodes of a block, whose precision matrix is dense
_MOST_NODES = 64
_FAMILIES = (Normal, MvNormal, LogNormal)


class GaussianBlock(Kernel):
    """Draws several Normal nodes from their joint full conditional."""

    label = "conjugate block"

    def __init__(
        self, target: Target, blankets: Mapping[str, Blanket], debug: bool = False
    ) -> None:
        self.target = target
        self.names = tuple(blankets)
        self.debug = debug
        self.terms = target.terms_of(self.names)
        self.path = target.below(self.names)
        self.layout = Layout(target, self.names, blankets, self.terms)
        self.parts = [BlockTerm(target, blankets, self.layout, term) for term in self.terms]
        self.match = "jointly Normal with " + ", ".join(self.names)
        self._standing: tuple[Any, list[BlockTerm]] = (None, [])
        self._moving: list[BlockTerm] = []

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        sums = self._summed(self._at_zero(values), len(values[self.names[0]]))
        noise = rng.standard_normal(sums.linear.shape)
        draw, _, bad = solved(self.layout, sums, noise)
        if bad.any():
            raise DensityError(self._why_bad(sums))
        new = self.layout.split(draw, values)
        if self.debug:
            self._check(values, new, sums.precision, sums.linear)
        return new, memory

    def log_integral(self, values: Values, count: int) -> np.ndarray:
        """Log of the block's terms, integrated over the block, shape (count,), up to a constant.

        Minus infinity where a parameter overflows or the precision is not positive definite.
        """
        sums = self._summed(self._at_zero(values), count)
        mean, log_det, bad = solved(self.layout, sums, None)
        log = sums.constant + 0.5 * np.vecdot(sums.linear, mean) - 0.5 * log_det
        return np.where(bad | np.isnan(log), -np.inf, log)

    # ---- private -------------------------------------------------------------------------------

    def _summed(self, base: Values, chains: int) -> BlockSums:
        """What all terms say, given the state with the block at zero."""
        sums = BlockSums(chains, self.layout)
        together, standing = self._standing
        if together is not None and all(part.stands(base) for part in standing):
            sums.add(*together)
            for part in self._moving:
                part.add(base, sums)
            return sums
        for part in self.parts:
            part.add(base, sums)
        if together is None:
            self._part_ways(base)
        return sums

    def _part_ways(self, base: Values) -> None:
        """Terms that say the same in every sweep are summed once, the others each time."""
        standing = [p for p in self.parts if p.stands(base)]
        self._moving = [p for p in self.parts if not p.stands(base)]
        if standing:
            columns = zip(*(p.summed for p in standing), strict=True)
            self._standing = tuple(sum(c) for c in columns), standing

    def _why_bad(self, sums: BlockSums) -> str:
        if sums.problem is not None:
            return str(sums.problem)
        return (
            f"nodes {', '.join(map(repr, self.names))}: their joint precision given the others is not "
            "positive definite; a scale is near zero or infinite"
        )

    def _at_zero(self, values: Values) -> Values:
        """The state with the block at zero (what is seen of it stays)."""
        state = dict(values)
        for name in self.names:
            state[name] = self.layout.base[name]
        for link in self.path:
            state[link], _ = self.target.model.evaluate(link, state)
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
            ", ".join(self.names),
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
    groups: list[list[str]] = []
    entered = {n: {t.name for t in target.terms_of((n,))} for n in able}
    for name in able:
        shared = [g for g in groups if any(entered[name] & entered[n] for n in g)]
        merged = [name]
        for group in shared:
            if len(group) + len(merged) > _MOST_NODES:
                continue  # a long chain is cut: each piece is drawn given its neighbours
            if _jointly_affine(target, [*group, *merged], blankets):
                merged = [*group, *merged]
                groups.remove(group)
        groups.append(merged)
    found = []
    for group in groups:
        order = [n for n in target.chain if n in group]
        if len(order) < 2:
            continue
        block = GaussianBlock(target, {n: blankets[n] for n in order}, debug)
        if block.layout.dg <= MAX_DENSE:
            found.append(block)
    return found


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
            result = target.model.evaluate(term.name, {**target.model.probe, **target.known})[0]
        except Exception:
            return False
        return type(result) in families
    try:
        result = traced_term(target, names, term).result
    except Untraceable:
        return False
    if not isinstance(result, TracedCall):
        return not isinstance(result, Tracer)  # it names the nodes and does nothing with them
    if result.function not in families:
        return False
    traced = result.traced
    return set(traced) <= {"loc"} and all(
        isinstance(v, Tracer) and v.is_affine for v in traced.values()
    )


def _jointly_affine(target: Target, names: Sequence[str], blankets: Mapping[str, Blanket]) -> bool:
    children: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        for child in blankets[name].children:
            children.setdefault(child.term.name, []).append((name, child.relation.kind))
    for term in target.terms_of(tuple(names)):
        found = children.get(term.name, [])
        entering = tuple(dict.fromkeys(n for n, _ in found))
        lookups = [n for n, kind in found if kind == "lookup"]
        if len(lookups) > 1 or (lookups and len(entering) > 1):
            return False
        if len(entering) > 1 and not _is_affine(target, entering, term):
            return False
    return True
