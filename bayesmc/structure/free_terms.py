"""The terms of a posterior as expressions of what moves, with what is known put in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import (
    Call,
    Elementwise,
    Expression,
    Family,
    broadcast,
    expressions_of,
    mapped,
    ordered,
    pick,
)
from bayesmc.expression.graph import cast, substituted
from bayesmc.network.expressions import NodeCall, Opaque, density, log_density_of, stored_leaf
from bayesmc.passes.arithmetic import is_all, tidy
from bayesmc.passes.log_density import has_own_form
from bayesmc.passes.logarithms import stable
from bayesmc.passes.ranges import in_range
from bayesmc.structure.target import Target, Term


def known_values(target: Target, expressions: Iterable[Expression]) -> dict[str, Expression]:
    """Values that never change, of the leaves of expressions."""
    found: dict[str, Expression] = {}
    for name in frozenset().union(*(e.leaves for e in expressions)):
        if name in target.known and target.is_known(name):
            own = stored_leaf(target.model, target.model[name])
            found[name] = cast(np.broadcast_to(target.known[name], own.shape), own.dtype)
    return found


def elements(
    target: Target, term: Term, above: Mapping[str, Expression], is_inside: bool = False
) -> Expression:
    """The log factors of a term that count, one after the other.

    Parameters
    ----------
    is_inside : bool
        Whether its node is inside of its support, wherever the free numbers are.

    Raises
    ------
    UnsupportedError
    """
    whole = term.expression
    if whole is None:
        raise UnsupportedError(_why_not(term))
    _refuse_opaque(term, whole, above)
    given = {**known_values(target, [whole, *expressions_of(term.read.result)]), **above}  # type: ignore[union-attr]
    log = broadcast(substituted(whole, given), term.shape)
    if not term.is_potential:
        family = term.read.result  # type: ignore[union-attr]
        if is_inside and not (isinstance(family, Family) and has_own_form(family)):
            log = _of_support(log)
        condition = in_range(mapped(family, lambda e: stable([substituted(e, given)])[0]))
        log = broadcast(tidy(np.where, condition, log, -np.inf), term.shape)
    return pick([log], np.arange(log.size) if term.mask is None else np.flatnonzero(term.mask))


# ---- private ------------------------------------------------------------------------------------


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
