"""The expected log joint density of a net under independent factors, as an expression of their moments.

Every term is read off its graph (``passes.expectation``). Finite nodes are taken at each of their states, and
their tables are the weights; what a known plate says by one label is a product of its statistics with
coefficients by label, so that a sweep over a mixture is two products of matrices. Nodes that stand in the way
of closed forms become normal in unconstrained coordinates, and are values there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import InverseWishart, LogNormal, MvNormal, Normal, Wishart
from bayesmc.engines.variational.factors import table_of
from bayesmc.engines.variational.labels import LabelTerm, by_label, possible
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import (
    Constant,
    Expression,
    Family,
    broadcast,
    constant,
    elementwise,
    expressions_of,
    leaf,
    mapped,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.graph import cast, substituted
from bayesmc.network.expressions import Opaque, stored_leaf
from bayesmc.passes.arithmetic import multiply, tidied, tidy
from bayesmc.passes.expectation import Expectation
from bayesmc.passes.expected_density import (
    expected_log_density,
    plain_density,
)
from bayesmc.passes.log_density import family_of
from bayesmc.passes.moments import Hidden
from bayesmc.passes.reads import element_read
from bayesmc.passes.widening import widened
from bayesmc.structure.free_terms import elements_of, known_values
from bayesmc.structure.target import Target, Term

#: entries of one term at all joint states of its finite nodes
_MOST = 1 << 23
#: joint states of all elements of one node
_JOINTLY = 1 << 12
#: axes of one value of each parameter, of families that are taken apart
_NDIM: dict[Any, Mapping[str, int]] = {
    Normal: {"loc": 0, "scale": 0},
    LogNormal: {"loc": 0, "scale": 0},
    MvNormal: {"loc": 1, "cov": 2, "scale_tril": 2, "scale_diag": 1},
    Wishart: {"df": 0, "scale": 2},
    InverseWishart: {"df": 0, "scale": 2},
}


@dataclass(frozen=True, eq=False)
class Sum:
    """A term's expectation, summed over its elements: a number, or by label."""

    term: str
    plain: Expression | None = None
    by_label: LabelTerm | None = None

    @property
    def total(self) -> Expression:
        found = self.plain if self.by_label is None else self.by_label.total
        assert found is not None
        return found


class TermReader:
    """Reads terms under a choice of factors.

    Parameters
    ----------
    target : Target
    hidden : mapping
        Node -> ``Hidden``: what has a closed form.
    tables : mapping
        Finite node -> how many states it has.
    above : mapping
        Node -> its value, of those that are normal in unconstrained coordinates.
    groups : mapping, optional
        Finite node -> all nodes that it has one table with.
    """

    def __init__(
        self,
        target: Target,
        hidden: Mapping[str, Hidden],
        tables: Mapping[str, int],
        above: Mapping[str, Expression],
        groups: Mapping[str, tuple[str, ...]] | None = None,
    ) -> None:
        self.target, self.hidden, self.tables, self.above = target, hidden, tables, above
        self.groups = {} if groups is None else groups
        #: finite nodes several of whose elements meet in an entry
        self.meeting: set[str] = set()

    def __call__(self, term: Term) -> Sum:
        """The expectation of a term.

        Raises
        ------
        NoMoment
            It has none in closed form.
        UnsupportedError
            It cannot be followed.
        """
        whole = term.expression
        moving = frozenset() if whole is None else whole.leaves & {*self.hidden, *self.tables}
        if not moving:  # says why it is not followed, too
            (either,) = elements_of(self.target, [term], self.above)
            log = either.inside if term.name in self.above else either.anywhere
            return Sum(term.name, reduction(np.add, log, (0,)))
        assert whole is not None
        given = self._given(term, whole)
        whole = substituted(whole, given)
        finite = sorted(whole.leaves & set(self.tables))
        self._read_elements(term, whole, finite)
        if term.is_potential:
            log = self._of_expression(term, whole, finite)
            return Sum(term.name, self._summed(term, log, finite))
        assert not isinstance(term.read, Opaque)
        read = term.read.result
        family = read if isinstance(read, Family) else family_of(read)
        family = mapped(family, lambda e: substituted(e, given))
        value = self._value(term, given)
        if len(finite) == 1 and finite[0] not in self.groups:
            of = self._expectation(term)
            found = by_label(self.target, of, term, family, value, finite[0], self.above)
            if found is not None:
                return Sum(term.name, None, found)
        of = self._expectation(term)
        if family.make in _NDIM:
            grid, count = self._grid(finite)
            made = _padded(family, len(term.shape))
            node = self.target.model[term.name]
            own = reshape(value, (1,) * (len(node.value_shape) - len(value.shape)) + value.shape)
            if finite:
                made = mapped(made, lambda e: _wide(e, grid, count))
                own = _wide(own, grid, count)
            log = expected_log_density(of, made, own)
        else:
            base = broadcast(plain_density(family, value), term.shape)
            log = self._of_expression(term, base, finite)
        return Sum(term.name, self._summed(term, log, finite))

    # ---- private -------------------------------------------------------------------------------

    def _expectation(self, term: Term) -> Expectation:
        return Expectation(self.hidden, [term.name] if term.name in self.hidden else [])

    def _given(self, term: Term, whole: Expression) -> dict[str, Expression]:
        read = term.read
        parts = [] if isinstance(read, Opaque) or term.is_potential else expressions_of(read.result)
        return {**known_values(self.target, [whole, *parts]), **self.above}

    def _value(self, term: Term, given: Mapping[str, Expression]) -> Expression:
        """The value of a term's node as its distribution speaks of it."""
        node = self.target.model[term.name]
        value: Expression = stored_leaf(self.target.model, node)
        if term.name in self.target.known and self.target.is_known(term.name):
            known = np.broadcast_to(self.target.known[term.name], value.shape)
            value = cast(known, value.dtype)
        value = substituted(value, dict(given))
        if node.domain is not None and node.domain.low:
            value = elementwise(np.add, value, node.domain.low)
        return value

    def _of_expression(self, term: Term, base: Expression, finite: Sequence[str]) -> Expression:
        grid, count = self._grid(finite)
        base = tidied(base)
        return self._expectation(term)(widened(base, grid, count) if finite else base)

    def _grid(self, finite: Sequence[str]) -> tuple[dict[str, Expression], int]:
        """Every joint state of finite nodes: the same for all elements, or of all elements."""
        states = self._states(finite)
        grid: dict[str, Expression] = {}
        for name, own in zip(finite, states, strict=True):
            shape = self.target.model[name].value_shape
            if own.shape[1] == 1:
                own = np.broadcast_to(own, (len(own), math.prod(shape)))
            grid[name] = constant(own.reshape(-1, *shape))
        return grid, len(states[0]) if states else 1

    def _states(self, finite: Sequence[str]) -> list[np.ndarray]:
        """Of each node its states in all joint ones, ``(count, 1)``, or those of all its elements."""
        each = []
        for name in finite:
            states = np.arange(self.tables[name])
            size = math.prod(self.target.model[name].value_shape)
            if self._at[name] is not None:
                each.append(states[:, None])
                continue
            if len(states) ** size > _JOINTLY:
                raise UnsupportedError(
                    f"MeanField: entries of a term read several elements of finite node {name!r}, which have "
                    f"{len(states)}**{size} joint states; use Gibbs()"
                )
            every = np.stack(np.meshgrid(*[states] * size, indexing="ij"), axis=-1)
            each.append(every.reshape(-1, size))
        if math.prod(map(len, each)) > _MOST:
            raise UnsupportedError(
                f"MeanField: {', '.join(map(repr, finite))} meet in one term and have too many joint "
                "states; use Gibbs()"
            )
        at = np.meshgrid(*(np.arange(len(e)) for e in each), indexing="ij")
        return [e[a.reshape(-1)] for e, a in zip(each, at, strict=True)]

    def _read_elements(self, term: Term, whole: Expression, finite: Sequence[str]) -> None:
        """Which element of each finite node an entry reads; None where several, or if others tell which."""
        self._at: dict[str, np.ndarray | None] = {}
        for name in finite:
            shape = self.target.model[name].value_shape
            try:
                at = element_read(whole, name, np.arange(math.prod(shape)).reshape(shape))
            except TraceError:
                at = None
            if math.prod(shape) == 1:
                self._at[name] = np.zeros(term.shape, int)
            elif isinstance(at, Constant):
                self._at[name] = np.maximum(np.broadcast_to(at.value, term.shape), 0)
            else:
                self._at[name] = None
                self.meeting.add(name)

    def _summed(self, term: Term, log: Expression, finite: Sequence[str]) -> Expression:
        """A log factor summed over its elements, weighted by the tables of finite nodes."""
        states = self._states(finite)
        shape = (len(states[0]), *term.shape) if finite else term.shape
        if math.prod(shape) > _MOST:
            raise UnsupportedError(
                f"MeanField: term {term.name!r} has {math.prod(shape)} entries at all joint states of "
                f"{', '.join(map(repr, finite))}; use Gibbs()"
            )
        log = possible(broadcast(log, shape))
        if term.mask is not None:
            log = tidy(np.where, np.broadcast_to(term.mask, term.shape), log, 0.0)
        of = dict(zip(finite, states, strict=True))
        for group in dict.fromkeys(self.groups.get(n, (n,)) for n in finite):
            inside = {n: of[n] for n in group if n in of}
            weights = (
                self._weights(*inside.popitem(), len(term.shape))
                if len(group) == 1
                else self._joint_weights(group, inside)
            )
            log = multiply(log, weights)
        return reduction(np.add, broadcast(log, shape), range(len(shape)))

    def _weights(self, name: str, states: np.ndarray, rank: int) -> Expression:
        """The probability of each joint state for each entry."""
        shape = self.target.model[name].value_shape
        size, at = math.prod(shape), self._at[name]
        own = leaf(table_of((name,)), (self.tables[name], *shape))
        if at is not None:
            rows = states.reshape((-1,) + (1,) * at.ndim) * size
            return pick([own], rows + at)
        each = pick([own], states * size + np.arange(size))
        return reshape(reduction(np.multiply, each, (1,)), (len(states),) + (1,) * rank)

    def _joint_weights(
        self, group: tuple[str, ...], states: Mapping[str, np.ndarray]
    ) -> Expression:
        """The same of nodes that have one table: others are summed out of it."""
        shape = self.target.model[group[0]].value_shape
        places = [self._at[n] for n in states]
        first = places[0]
        if first is None or any(at is None or not np.array_equal(at, first) for at in places):
            raise UnsupportedError(
                f"MeanField(blocks=): a term reads different elements of {', '.join(map(repr, states))}, "
                "which have one table for every element"
            )
        sizes = [self.tables[n] for n in group]
        own = leaf(table_of(group), (math.prod(sizes), *shape))
        every = np.stack(np.unravel_index(np.arange(math.prod(sizes)), sizes))
        fits = np.ones((len(next(iter(states.values()))), every.shape[1]), bool)
        for name, wanted in states.items():
            fits &= every[group.index(name)] == wanted
        rows = np.nonzero(fits)[1].reshape(len(fits), -1)
        at = rows.reshape(rows.shape + (1,) * first.ndim) * math.prod(shape) + first
        return reduction(np.add, pick([own], at), (1,))


def has_moments(target: Target, name: str) -> str | None:
    """The kind of distribution that a continuous node may have in closed form; None for none.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.variational.reading import has_moments
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(rate))
    >>> has_moments(target_of(pose(net, {"count": 3})), "rate")
    'positive'
    """
    support = target.model[name].support
    if support is None or not support.is_single:
        return None
    low, high = float(np.ravel(support.low)[0]), float(np.ravel(support.high)[0])
    if support.kind in ("real", "real vector"):
        return "number"
    if support.kind == "interval" and low == 0 and high == np.inf:
        return "positive"
    if support.kind == "interval" and (low, high) == (0, 1):
        return "unit"
    if support.kind == "interval" and (low, high) == (-np.inf, np.inf):
        return "number"
    return {"simplex": "simplex", "positive definite": "matrix"}.get(support.kind)


# ---- private ------------------------------------------------------------------------------------


def _padded(family: Family, rank: int) -> Family:
    """Parameters with as many axes of elements as the term has plates."""
    ndim = _NDIM[family.make]

    def full(name: str, value: Any) -> Any:
        if value is None:
            return None
        lead = rank - (len(value.shape) - ndim[name])
        return reshape(value, (1,) * lead + value.shape)

    return Family(family.make, {k: full(k, v) for k, v in family.parameters.items()})


def _wide(node: Expression, grid: Mapping[str, Expression], count: int) -> Expression:
    """At all joint states, which are the first axis; of size 1 where they do not matter."""
    if node.leaves & grid.keys():
        return widened(node, grid, count)
    return reshape(node, (1, *node.shape))
