"""The terms of a posterior as expressions of what moves, with what is known put in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import (
    Call,
    Elementwise,
    Expression,
    Family,
    Leaf,
    broadcast,
    expressions_of,
    mapped,
    ordered,
    pick,
)
from bayesmc.expression.graph import cast
from bayesmc.network.expressions import NodeCall, Opaque, density, log_density_of, stored_leaf
from bayesmc.passes.arithmetic import is_all, rewritten, tidy
from bayesmc.passes.log_density import has_own_form
from bayesmc.passes.logarithms import stable
from bayesmc.passes.ranges import in_range
from bayesmc.structure.target import Target, Term


def put_in(roots: Sequence[Expression], given: Mapping[str, Expression]) -> list[Expression]:
    """Expressions with others in place of leaves, by name."""

    def change(node: Expression, _: list[Expression]) -> Expression | None:
        return given.get(node.name) if isinstance(node, Leaf) else None

    return rewritten(roots, change)


def known_values(target: Target, expressions: Iterable[Expression]) -> dict[str, Expression]:
    """Values that never change, of the leaves of expressions."""
    found: dict[str, Expression] = {}
    for name in frozenset().union(*(e.leaves for e in expressions)):
        if name in target.known and target.is_known(name):
            own = stored_leaf(target.model, target.model[name])
            found[name] = cast(np.broadcast_to(target.known[name], own.shape), own.dtype)
    return found


def elements(target: Target, term: Term, above: Mapping[str, Expression]) -> Expression:
    """The log factors of a term that count, one after the other.

    Raises
    ------
    UnsupportedError
    """
    return elements_of(target, [term], above)[0].anywhere


class Elements(NamedTuple):
    """The log factors of a term that count, one after the other.

    Attributes
    ----------
    anywhere, inside : Expression
        For all values of its node, and for those inside of its support.
    """

    anywhere: Expression
    inside: Expression


def elements_of(
    target: Target, terms: Sequence[Term], above: Mapping[str, Expression]
) -> list[Elements]:
    """The log factors of several terms: what these share, as those of a recursion do, is read once.

    Raises
    ------
    UnsupportedError
    """
    wholes = [_expression(term) for term in terms]
    if any(isinstance(n, Call) and isinstance(n.call, NodeCall) for n in ordered(*wholes)):
        for term, whole in zip(terms, wholes, strict=True):
            _refuse_opaque(term, whole, above)
    families = [None if t.is_potential else t.read.result for t in terms]  # type: ignore[union-attr]
    parameters = [list(expressions_of(f)) for f in families]
    every = [*wholes, *(e for own in parameters for e in own)]
    given = {**known_values(target, every), **above}
    logs = put_in(wholes, given)
    put = iter(stable(put_in([e for own in parameters for e in own], given)))
    found = []
    for term, family, log in zip(terms, families, logs, strict=True):
        log = broadcast(log, term.shape)
        both = [log, log]
        if not term.is_potential:
            if not (isinstance(family, Family) and has_own_form(family)):
                both[1] = _of_support(log)
            condition = in_range(mapped(family, lambda _: next(put)))
            both = [broadcast(tidy(np.where, condition, e, -np.inf), term.shape) for e in both]
        count = np.arange(log.size) if term.mask is None else np.flatnonzero(term.mask)
        found.append(Elements(*(pick([e], count) for e in both)))
    return found


# ---- private ------------------------------------------------------------------------------------


def _expression(term: Term) -> Expression:
    if term.expression is None:
        raise UnsupportedError(_why_not(term))
    return term.expression


def _why_not(term: Term) -> str:
    kind = "potential" if term.is_potential else "node"
    if isinstance(term.read, Opaque):
        return f"{kind} {term.name!r} is not followed: {term.read.reason}"
    try:
        log_density_of(term.model, term.name)
    except TraceError as error:
        return f"{kind} {term.name!r}: {error}"
    return f"{kind} {term.name!r} has no closed form"


def _refuse_opaque(term: Term, whole: Expression, above: Mapping[str, Expression]) -> None:
    """Refuse computed nodes that are called as they are, where they read what moves."""
    for node in ordered(whole):
        if (
            isinstance(node, Call)
            and isinstance(node.call, NodeCall)
            and node.leaves & above.keys()
        ):
            read = density(term.model, node.call.name)
            why = read.reason if isinstance(read, Opaque) else "it is called as it is"
            raise UnsupportedError(
                f"node {term.name!r} reads node {node.call.name!r}, which is not followed: {why}"
            )


def _of_support(log: Expression) -> Expression:
    """A log density inside of its support."""
    if isinstance(log, Elementwise) and log.function is np.where:
        _, inside, outside = log.operands
        if is_all(outside, -np.inf) and inside.shape == log.shape:
            return inside
    return log
