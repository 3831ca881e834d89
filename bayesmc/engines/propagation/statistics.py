"""Nodes that keep their own family: which they are, and factors read as linear in its statistics.

A Gamma, Beta or Dirichlet node with known parameters keeps its family where every density that reads it is
linear in the logarithms of its numbers (of a Gamma node in the number, too), whatever finite nodes are:
counts, labels, waiting times. Where one is not, the node is mapped to the line.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc import distributions as d
from bayesmc.distributions import Distribution
from bayesmc.engines.propagation.beliefs import Conjugates
from bayesmc.engines.propagation.density import Terms, unique_rows
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Family,
    Leaf,
    Program,
    Reduction,
    broadcast,
    elementwise,
    expressions_of,
    leaf,
    ordered,
    rebuilt,
    replaced,
)
from bayesmc.factors import families as f
from bayesmc.network import Model, Observed
from bayesmc.network.expressions import Followed, density
from bayesmc.passes.affine import affine
from bayesmc.passes.arithmetic import rewritten
from bayesmc.passes.reads import reads, sunk
from bayesmc.structure.target import Target


@dataclass(frozen=True, eq=False)
class Statistic:
    """A statistic of a node's elements as a leaf, as coordinates are (``Numbers``).

    Attributes
    ----------
    leaf : Leaf
    at : ndarray of int, shape of the leaf
        Numbers of the statistics among all.
    seen : ndarray
        Zeros.
    """

    leaf: Leaf
    at: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True, eq=False)
class Kept:
    """A node that keeps its family.

    Attributes
    ----------
    field : int
        Which of the families' arrays.
    rows : ndarray of int, shape (elements,)
        Where in it.
    """

    name: str
    field: int
    rows: np.ndarray


@dataclass(frozen=True, eq=False)
class Linear:
    """Factors that are linear in statistics: see ``ConjugateBatch``."""

    name: str
    field: int
    at: np.ndarray
    coefficients: np.ndarray
    offsets: np.ndarray
    scope: tuple[tuple[str, np.ndarray], ...]


class OwnFamilies:
    """Nodes that keep their family, and the factors that read them.

    Attributes
    ----------
    nodes : dict
        Name -> ``Kept``.
    factors : dict
        Name of a term -> ``Linear``.
    fields : list of Conjugates
        With the priors.
    log_scale : float
        Of the priors.
    """

    def __init__(
        self,
        model: Model,
        target: Target,
        known: Mapping[str, np.ndarray],
        finite: frozenset[str],
        observed: Mapping[str, Observed],
        mapped: Collection[str],
    ) -> None:
        self.model, self.target, self.known, self.finite = model, target, known, finite
        self.nodes: dict[str, Kept] = {}
        self.factors: dict[str, Linear] = {}
        self.fields: list[Conjugates] = []
        self.log_scale = 0.0
        priors = {}
        for name in target.chain:
            if model[name].domain is None and name not in mapped and name not in observed:
                found = self._prior(name)
                if found is not None:
                    priors[name] = found
        while not self._all_linear(priors):
            pass

    # ---- private -------------------------------------------------------------------------------

    def _prior(self, name: str) -> tuple[f.Family, np.ndarray] | None:
        """The family of a prior with known parameters, and its natural parameters, shape (elements, p)."""
        node, found = self.model[name], density(self.model, name)
        if not isinstance(found, Followed) or found.leaves - set(self.known):
            return None
        prior = found.result
        if isinstance(prior, Family):
            if prior.make not in _PRIORS:
                return None
            values = Program(list(expressions_of(prior)))(self.known)
            own = rebuilt(list(prior.parameters.values()), iter(values))
            prior = prior.make(**dict(zip(prior.parameters, own, strict=True)))
        make = _PRIORS.get(type(prior))
        natural = None if make is None else make(prior)
        if natural is None:
            return None
        p = natural.shape[-1]
        wide = np.broadcast_to(natural, (*node.plate_shape, p)).reshape(-1, p)
        family = f.GammaFamily() if type(prior) in (d.Gamma, d.Exponential) else f.Shares(p)
        return family, wide

    def _all_linear(self, priors: dict[str, tuple[f.Family, np.ndarray]]) -> bool:
        """Read all factors of the nodes; those of which one is not linear are left out, for another try."""
        self._lay_out(priors)
        self.factors = {}
        if not priors:
            return True
        statistics = self._statistics()
        terms = Terms(self.model, self.known, statistics, self.finite)  # type: ignore[arg-type]
        for term in self.target.terms_of(tuple(priors)):
            if term.name in priors and not self._above(term.name, priors):
                continue
            try:
                self.factors[term.name] = self._read(terms, term.name, statistics)
            except BayesmcError:
                for name in [*self._above(term.name, priors), term.name]:
                    priors.pop(name, None)
                return False
        return True

    def _above(self, name: str, priors: Collection[str]) -> list[str]:
        model = self.model
        reached = model.above(model.parents(name), lambda n: not model[n].is_stochastic)
        return [n for n in reached if n in priors]

    def _lay_out(self, priors: Mapping[str, tuple[f.Family, np.ndarray]]) -> None:
        kinds: dict[f.Family, list[np.ndarray]] = {}
        self.nodes, self.log_scale = {}, 0.0
        for name, (family, natural) in priors.items():
            held = kinds.setdefault(family, [])
            start = sum(len(h) for h in held)
            held.append(natural)
            rows = start + np.arange(len(natural))
            self.nodes[name] = Kept(name, list(kinds).index(family), rows)
            self.log_scale -= float(family.log_total(natural).sum())
        self.fields = [Conjugates(k, np.concatenate(parts)) for k, parts in kinds.items()]

    def _statistics(self) -> dict[str, Statistic]:
        """Leaves that stand for statistics, numbered field by field."""
        sizes = [field.naturals.size for field in self.fields]
        self.starts: np.ndarray = np.cumsum([0, *sizes])
        found = {}
        for name, kept in self.nodes.items():
            node, family = self.model[name], self.fields[kept.field].family
            p = family.size
            at = self.starts[kept.field] + kept.rows[:, None] * p + np.arange(p)
            if node.event_shape:
                parts: dict[str, np.ndarray] = {"log": at}
            elif isinstance(family, f.Shares):
                parts = {"log": at[:, 0], "log1m": at[:, 1]}
            else:
                parts = {"log": at[:, 0], "x": at[:, 1]}
            for what, numbers in parts.items():
                own = leaf(f"{what} {name}", node.value_shape)
                found[own.name] = Statistic(own, numbers.reshape(own.shape), np.zeros(own.shape))
        return found

    def _read(self, terms: Terms, name: str, statistics: Mapping[str, Statistic]) -> Linear:
        shape, plates, parents = terms.shape_of(name)
        root = terms.log_factor(name, shape)
        for node in self.nodes:
            if node in root.leaves:
                root = _in_logs(root, node, statistics)
        form = affine(root, statistics)
        scope, values, cards = terms.configured(name, plates, parents, root, (form,))
        seen = self.target.terms[name].mask
        at = np.arange(math.prod(shape)) if seen is None else np.flatnonzero(seen)
        offset, gain, numbers = terms.coefficients((form,), values, cards, shape, at)
        fields = np.searchsorted(self.starts, numbers, side="right") - 1
        if (fields != fields.flat[0]).any():
            raise TraceError("it reads several families")
        field = int(fields.flat[0])
        p = self.fields[field].family.size
        row, which = np.divmod(numbers - self.starts[field], p)
        rows = unique_rows(row)
        states = math.prod(cards)
        found = np.zeros((len(at), states, rows.shape[1], p))
        place = (row[..., None] == rows[:, None, :]).argmax(axis=-1)
        factor = np.arange(len(at))[:, None, None]
        state = np.arange(states)[None, :, None]
        np.add.at(found, (factor, state, place[:, None], which[:, None]), gain[:, :, 0])
        places = tuple((n, own[at]) for n, own in scope)
        lead = (len(at), *cards)
        return Linear(
            name, field, rows, found.reshape(*lead, *found.shape[2:]), offset.reshape(lead), places
        )


# ---- private ------------------------------------------------------------------------------------


def _exactly(low: Any, high: Any) -> bool:
    return bool((np.asarray(low) == 0.0).all() and (np.asarray(high) == 1.0).all())


def _stacked(*parts: Any) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*map(np.asarray, parts)), axis=-1).astype(float)


#: family -> the natural parameters of one of its members; None of members that are not in the family
_PRIORS: dict[type[Distribution], Any] = {
    d.Gamma: lambda p: _stacked(p.concentration - 1.0, -p.rate),
    d.Exponential: lambda p: _stacked(0.0 * p.rate, -p.rate),
    d.Beta: lambda p: _stacked(p.concentration1 - 1.0, p.concentration0 - 1.0),
    d.Uniform: lambda p: _stacked(0.0 * p.low, 0.0 * p.low) if _exactly(p.low, p.high) else None,
    d.Dirichlet: lambda p: np.asarray(p.concentration) - 1.0,
}


def _whole(node: Expression, new: Sequence[Expression], name: str) -> Expression | None:
    """The sum over all shares of a vector is one: what sums so, at a few vectors of shares, is that."""
    if not isinstance(node, Reduction) or node.ufunc is not np.add or name not in node.leaves:
        return None
    rng, values = np.random.default_rng(0), dict[str, np.ndarray]()
    for own in ordered(node):
        if isinstance(own, Leaf) and own.name == name and own.shape:
            values[own.name] = rng.dirichlet(np.ones(own.shape[-1]), (3, *own.shape[:-1]))
        elif isinstance(own, Leaf) and own.states:
            values[own.name] = rng.integers(own.states, size=(3, *own.shape))
        elif isinstance(own, Leaf):
            return None
    (found,) = Program([node])(values)
    return broadcast(1.0, node.shape) if np.allclose(found, 1.0, rtol=0, atol=1e-12) else None


def _in_logs(root: Expression, name: str, statistics: Mapping[str, Statistic]) -> Expression:
    """An expression with a node's statistics as leaves in place of the node."""
    if not {f"log1m {name}", f"x {name}"} & set(statistics):  # shares as a vector
        (root,) = rewritten([root], lambda node, new: _whole(node, new, name))
    root = sunk(root, name)
    logs = _Logs(root, name, statistics)
    (found,) = rewritten([root], logs.change)
    plain = statistics.get(f"x {name}")
    if name in found.leaves and plain is not None:
        found = replaced(found, {logs.own: plain.leaf})
    if name in found.leaves:
        raise TraceError(f"it is not linear in logarithms of {name!r}")
    return found


class _Logs:
    """Logarithms of a leaf's elements, and of one minus these, as leaves of their own."""

    def __init__(self, root: Expression, name: str, statistics: Mapping[str, Statistic]) -> None:
        self.name, self.statistics = name, statistics
        self.chosen = set(reads(root, name))
        (self.own,) = (n for n in ordered(root) if isinstance(n, Leaf) and n.name == name)

    def change(self, node: Expression, new: Sequence[Expression]) -> Expression | None:
        """What stands for a function of the leaf; None where it is kept."""
        if not isinstance(node, Elementwise):
            return None
        function, inner = node.function, node.operands
        if function is np.log and self.name in inner[0].leaves:
            return self._logged(inner[0])
        if function is np.log1p:
            return self._complement(self._negated(inner[0]))
        if function is special.xlogy and self.name not in inner[0].leaves:
            log = self._logged(inner[1]) if self.name in inner[1].leaves else None
        elif function is special.xlog1py:
            log = self._complement(self._negated(inner[1]))
        else:
            return None
        return None if log is None else elementwise(np.multiply, new[0], log)

    def _stands(self, what: str, choice: Expression) -> Expression | None:
        found = self.statistics.get(f"{what} {self.name}")
        return None if found is None else replaced(choice, {self.own: found.leaf})

    def _complement(self, choice: Expression | None) -> Expression | None:
        return None if choice is None else self._stands("log1m", choice)

    def _negated(self, node: Expression) -> Expression | None:
        """The choice whose negative a node is."""
        if isinstance(node, Elementwise) and node.function is np.negative:
            return node.operands[0] if node.operands[0] in self.chosen else None
        return None

    def _logged(self, node: Expression) -> Expression | None:
        """The logarithm of a choice, of one minus it, of products and quotients."""
        if node in self.chosen:
            return self._stands("log", node)
        if self.name not in node.leaves:
            return elementwise(np.log, node)
        if not isinstance(node, Elementwise):
            return None
        if node.function is np.subtract:
            one, other = node.operands
            is_one = isinstance(one, Constant) and bool((one.value == 1.0).all())
            return self._complement(other) if is_one and other in self.chosen else None
        if node.function in (np.multiply, np.divide):
            parts = [self._logged(a) for a in node.operands]
            if parts[0] is not None and parts[1] is not None:
                added = np.add if node.function is np.multiply else np.subtract
                return elementwise(added, *parts)
        return None
