"""Which pair a child makes with a conjugate node, proved by tracing the child's function.

What the pair then adds to the node's full conditional is the affair of ``conjugate_children``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bayesmc.distributions import Distribution
from bayesmc.kernels.conjugate_kinds import Kind
from bayesmc.kernels.conjugate_pairs import Pair
from bayesmc.kernels.conjugate_picks import may_be_picked
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer


@dataclass(frozen=True, eq=False)
class Match:
    """A child and the pair that it makes.

    Attributes
    ----------
    power : float
        The power of the node in the parameter (1 for copies and means).
    is_copy : bool
        Whether the parameter is the node's value.
    unless_picked : str or None
        Why it makes no pair unless each element reads the node so or not at all (``conjugate_picks``);
        None where all do.
    """

    child: Child
    pair: Pair
    power: float
    is_copy: bool
    unless_picked: str | None = None


def match_of(
    blanket: Blanket, child: Child, kind: Kind, pairs: Sequence[Pair]
) -> Match | str | None:
    """The pair that a child makes with a kind, None where it does not vary with the node, or why not."""
    term = child.term
    if term.is_potential:
        return f"it enters the potential {term.name!r}"
    try:
        result = traced_term(blanket.target, (blanket.name,), term).result
    except Untraceable as error:
        return f"child {term.name!r} cannot be followed ({error})"
    if isinstance(result, Distribution):
        return None
    if not isinstance(result, TracedCall):
        return f"child {term.name!r} is no distribution that can be followed"
    family: Any = result.function
    traced = result.traced
    mine = [p for p in pairs if p.kind == kind.name and p.child is family]
    if not mine:
        return f"child {term.name!r} is {family.__name__}, which makes no conjugate pair"
    if len(traced) > 1:
        return f"it enters {_listed(traced)} of child {term.name!r}"
    ((parameter, value),) = traced.items()
    pair = next((p for p in mine if p.parameter == parameter), None)
    if pair is None or not isinstance(value, Tracer):
        return f"it enters the {parameter} of {family.__name__} {term.name!r}"
    reason = _why_not(blanket, child, pair, value)
    if reason is not None:
        told = f"the {parameter} of child {term.name!r} {reason}"
        may_pick = _may_pick(blanket, child, pair, value)
        return Match(child, pair, 1.0, False, told) if may_pick else told
    power = 1.0 if pair.form != "power" else value.power
    assert power is not None
    return Match(child, pair, power, value.is_copy)


# ---- private ------------------------------------------------------------------------------------


def _why_not(blanket: Blanket, child: Child, pair: Pair, value: Tracer) -> str | None:
    """Why a parameter does not have the form that the pair wants, or None."""
    if pair.form == "affine":
        return (
            None if value.is_affine else f"is not known to be affine in it (after {value.reason})"
        )
    if _is_mixed(child, value):
        return f"may depend on several elements of {blanket.name!r}"
    if pair.form == "pick":
        return "is not known to be its value or one minus it, state by state"
    if pair.form == "power":
        return (
            None if value.power is not None else "is not known to be a power of it times a constant"
        )
    if pair.form == "multiple":
        if value.power == 1.0 and value.whole_event:
            return None
        return "is not known to be its value times a number"
    if not value.is_copy or (blanket.event_shape and not value.whole_event):
        return "is not known to be its value itself"
    return None


def _is_mixed(child: Child, value: Tracer) -> bool:
    """Whether an element of the child may read several elements of the node."""
    relation = child.relation
    return relation.kind == "whole" or len(relation.rows) > 1 or len(value.sources) > 1


def _may_pick(blanket: Blanket, child: Child, pair: Pair, value: Tracer) -> bool:
    """Whether each element is affine in one of the node, so that trying a few values tells the rest."""
    if not may_be_picked(pair, len(child.term.model[child.term.name].event_shape)):
        return False
    if not value.is_affine or _is_mixed(child, value):
        return False
    if pair.kind != "shares":
        return True
    # a row that is no row has no slice to go to: nothing but finite nodes may say what is picked
    target = blanket.target
    above = [n for n in target.hidden_above(child.term) if target.model[n].domain is None]
    try:
        result = traced_term(target, tuple(above), child.term).result
    except Untraceable:
        return False
    probs = result.arguments.get(pair.parameter) if isinstance(result, TracedCall) else None
    return isinstance(probs, Tracer) and probs.is_affine


def _listed(traced: dict[str, Any]) -> str:
    return " and ".join(traced)
