"""Full conditionals of finite nodes as tables over their Markov blankets.

A term (a node's density or a potential) that depends on finite hidden nodes alone is evaluated once on all
their states, with evidence filled in and deterministic nodes passed through. Terms that read continuous
hidden nodes, or elements of foreign plates, are no tables; nothing is guessed about them here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.factors.named import Named, log_product
from bayesmc.network import Model
from bayesmc.structure.tables import configure, reads_of
from bayesmc.structure.target import Target, Term

#: entries up to which a term is tabulated
_TERM_ENTRIES = 1 << 22
#: configurations of a Markov blanket, and entries with the states, up to which a conditional is tabulated
_CONFIGURATIONS = 1 << 16
_ENTRIES = 1 << 20


@dataclass(frozen=True, eq=False)
class FiniteTerm:
    """A term over finite chain nodes, everything else filled in.

    Attributes
    ----------
    scope : tuple of str
        The chain nodes that it depends on, in axis order.
    log : ndarray, shape (*cards, *shape)
        Log factors. ``shape`` is that of the term's plates where some node of the scope has plates; else
        ``()``, the plates summed over.
    plates : tuple of str
        Names of the axes of ``shape``.
    """

    term: Term
    scope: tuple[str, ...]
    log: np.ndarray
    plates: tuple[str, ...] = ()


class FiniteTerms:
    """The terms of a target as tables, each made when first asked for."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._made: dict[str, FiniteTerm | None] = {}

    def of(self, term: Term) -> FiniteTerm | None:
        """The table of a term; None where it is none, or too large."""
        if term.name not in self._made:
            self._made[term.name] = _tabulated(self.target, term)
        return self._made[term.name]

    def around(self, names: Sequence[str]) -> tuple[FiniteTerm, ...] | None:
        """All terms that some nodes enter; None where one is no table."""
        found = []
        for term in self.target.terms_of(names):
            table = self.of(term)
            if table is None:
                return None
            found.append(table)
        return tuple(found)


@dataclass(frozen=True, eq=False)
class Conditional:
    """The joint full conditional of a block of nodes without plates.

    Attributes
    ----------
    names : tuple of str
        The block; its joint states run in C order, the last node fastest.
    cards : tuple of int
        States of each.
    blanket : tuple of str
        The chain nodes it depends on.
    blanket_cards : tuple of int
    probs : ndarray, shape (configurations of the blanket, joint states)
        Rows sum to one; a row of zeros is an impossible configuration.
    """

    names: tuple[str, ...]
    cards: tuple[int, ...]
    blanket: tuple[str, ...]
    blanket_cards: tuple[int, ...]
    probs: np.ndarray

    @property
    def states(self) -> int:
        """Number of joint states."""
        return self.probs.shape[1]

    @property
    def strides(self) -> tuple[int, ...]:
        """Weight of each node of the blanket in the number of a configuration."""
        return tuple(math.prod(self.blanket_cards[i + 1 :]) for i in range(len(self.blanket)))

    def probabilities(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Probabilities of the joint states given the rest, shape (chains or 1, joint states)."""
        at = np.zeros(1, dtype=np.intp)
        for name, stride in zip(self.blanket, self.strides, strict=True):
            at = at + values[name].astype(np.intp) * stride
        return self.probs[at]


def conditional_of(terms: FiniteTerms, names: Sequence[str]) -> Conditional | None:
    """The full conditional of a block over its Markov blanket; None where it is no table of moderate size.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conditionals import FiniteTerms, conditional_of
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Bernoulli(0.5))
    >>> net.add("y", lambda x: bmc.Bernoulli(0.2 + 0.6 * x))
    >>> target = target_of(pose(net, {"y": 1}))
    >>> conditional_of(FiniteTerms(target), ["x"]).probs.round(3).tolist()
    [[0.2, 0.8]]
    """
    model = terms.target.model
    around = terms.around(names)
    if around is None or any(model[n].plates or model[n].domain is None for n in names):
        return None
    everyone = dict.fromkeys(n for table in around for n in table.scope)
    if any(model[n].plates for n in everyone):
        return None
    blanket = tuple(n for n in everyone if n not in names)
    block = tuple(names)
    cards, outside = _cards(model, block), _cards(model, blanket)
    rows, states = math.prod(outside), math.prod(cards)
    if rows > _CONFIGURATIONS or rows * states > _ENTRIES:
        return None
    axes = (*blanket, *block)
    sizes = dict(zip(axes, outside + cards, strict=True))
    tables = [Named(table.scope, table.log) for table in around]
    log = log_product(tables, axes, sizes).reshape(rows, states)
    top = log.max(axis=1, keepdims=True)
    probs = np.exp(log - np.where(top > -np.inf, top, 0.0))
    sums = probs.sum(axis=1, keepdims=True)
    return Conditional(block, cards, blanket, outside, probs / np.where(sums > 0, sums, 1.0))


# ---- private ------------------------------------------------------------------------------------


def _tabulated(target: Target, term: Term) -> FiniteTerm | None:
    model = target.model
    scope, whole, others = reads_of(model, term.scope, term.plates, target.is_known, True)
    if whole or others:
        return None
    cards = _cards(model, scope)
    if float(math.prod(cards)) * math.prod(term.shape) > _TERM_ENTRIES:
        return None
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            values, _ = configure(model, target.known, scope, (), term.scope)
            if term.is_potential:
                log = term.log(values)
            else:
                dist, batch = term.distribution(values)
                if dist.invalid is not None and dist.invalid.any():
                    return None  # perhaps only where the configuration is impossible
                log = term.log_of(dist, batch, values[term.name])
    except BayesmcError:
        return None  # it fails at some configuration, perhaps an impossible one
    log = np.broadcast_to(log, cards + term.shape)
    if not any(model[n].plates for n in scope):
        return FiniteTerm(term, scope, log.sum(axis=tuple(range(len(cards), log.ndim))))
    return FiniteTerm(term, scope, log, term.plates)


def _cards(model: Model, names: Sequence[str]) -> tuple[int, ...]:
    return tuple(model[n].domain.size for n in names)  # type: ignore[union-attr]
