"""Proposals of importance sampling, as a user writes them and as they are read.

A proposal is read like a node: its argument names are what it depends on, aligned as for its target. What is
drawn from it, and when, is ``proposing``'s affair.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.errors import EvidenceError, ModelError, UnknownNodeError
from bayesmc.network import Model, Problem
from bayesmc.network.align import Aligner
from bayesmc.network.node import Declaration, bind
from bayesmc.network.store import unknown

#: a node's name, or several that are drawn jointly
Key = str | tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Proposal:
    """One proposal, read against a problem.

    Attributes
    ----------
    key : str or tuple of str
        As the user wrote it; a tuple is a joint block.
    names : tuple of str
        Nodes it draws.
    declaration : Declaration
        Its function and the names of what that takes, in order.
    links : tuple of (str, Aligner)
    """

    key: Key
    names: tuple[str, ...]
    declaration: Declaration
    links: tuple[tuple[str, Aligner], ...]

    @property
    def parents(self) -> tuple[str, ...]:
        return self.declaration.parents

    @property
    def what(self) -> str:
        """What messages call it."""
        return f"proposal for {self.key!r}"


def check_specification(proposal: Any) -> dict[Key, Any]:
    """A copy of what a user gave as proposals, refused where it cannot be one whatever the net."""
    if not isinstance(proposal, Mapping):
        raise TypeError(
            f"Importance(proposal={proposal!r}): give a dict from node name to a function of named nodes "
            "that returns a distribution"
        )
    seen: set[str] = set()
    for key, spec in proposal.items():
        names = (key,) if isinstance(key, str) else key
        if not isinstance(names, tuple) or not names or not all(isinstance(n, str) for n in names):
            raise TypeError(
                f"Importance: the key {key!r} of proposal= is no node name; give a name, or a tuple of "
                "names that are drawn jointly"
            )
        for name in names:
            if name in seen:
                raise ModelError(
                    f"Importance: {name!r} has two proposals; one node is drawn once, so keep one of them"
                )
            seen.add(name)
        _as_function(key, spec)
    return dict(proposal)


def read_proposals(problem: Problem, specification: Mapping[Key, Any]) -> list[Proposal]:
    """Proposals read against a problem; every fault names the proposal.

    Raises
    ------
    UnknownNodeError, EvidenceError, ModelError
        A target or an argument that cannot be one.
    """
    return [_read(problem, key, spec) for key, spec in specification.items()]


class Parts(Distribution):
    """Independent distributions of several nodes, as a block's function may return them."""

    def __init__(self, parts: Mapping[str, Distribution]) -> None:
        self.parts = dict(parts)


# ---- private ------------------------------------------------------------------------------------


def _as_function(key: Key, spec: Any) -> Callable[..., Any]:
    """The function of a proposal; a distribution (for a block, also a dict of them) is a constant one."""
    if isinstance(key, tuple) and isinstance(spec, Mapping):
        return lambda: spec
    distribution = as_distribution(spec)
    if distribution is not None:
        return lambda: distribution
    if not callable(spec):
        raise TypeError(
            f"Importance: the proposal for {key!r} is {spec!r}; give a function of named nodes that "
            "returns a distribution, or a distribution"
        )
    return spec


def _read(problem: Problem, key: Key, spec: Any) -> Proposal:
    model = problem.model
    names = key if isinstance(key, tuple) else (key,)
    what = f"proposal for {key!r}"
    for name in names:
        _check_target(problem, name, what)
    function = _as_function(key, spec)
    _check_signature(function, what)
    parents, bound = bind(what, function, None)
    for parent in parents:
        _check_argument(problem, parent, names, what)
    plates: tuple[str, ...] = ()
    if isinstance(key, tuple):
        bound = _jointly(bound, names)
    else:
        plates = model[key].plates
    label = key if isinstance(key, str) else ", ".join(key)
    declaration = Declaration(label, "function", parents, plates, function=bound)
    links = tuple(
        (p, Aligner(plates, model[p].plates, len(model[p].event_shape), model[p].domain))
        for p in parents
    )
    return Proposal(key, names, declaration, links)


def _check_target(problem: Problem, name: str, what: str) -> None:
    node = problem.model.nodes.get(name)
    if node is None:
        raise UnknownNodeError(f"Importance: {what}: {_unknown(problem.model, name)}")
    if node.kind != "stochastic":
        kind = {"fixed": "fixed by do()", "input": "an input"}.get(node.kind, "deterministic")
        raise ModelError(
            f"Importance: {what}: {name!r} is {kind} and never drawn; propose a stochastic node"
        )
    seen = problem.observed.get(name)
    if seen is not None and seen.mask is None:
        raise EvidenceError(
            f"Importance: {what}: {name!r} is observed, so there is nothing to draw; leave out the "
            "proposal or the evidence"
        )


def _check_signature(function: Callable[..., Any], what: str) -> None:
    """Argument names are all that says what a proposal depends on, so they must be readable."""
    try:
        arguments = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        raise ModelError(
            f"Importance: {what}: the arguments of {function!r} cannot be read; wrap it in a function "
            "whose arguments are the nodes it needs"
        ) from None
    for argument in arguments:
        if argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
            raise ModelError(
                f"Importance: {what}: *{argument.name} is refused, since argument names say what a "
                "proposal depends on; name the nodes"
            )


def _check_argument(problem: Problem, parent: str, names: tuple[str, ...], what: str) -> None:
    if parent in names:
        raise ModelError(
            f"Importance: {what}: it names {parent!r}, which it is to draw; name evidence, inputs or "
            "nodes drawn before"
        )
    if parent not in problem.model.nodes:
        raise UnknownNodeError(
            f"Importance: {what}: its argument {parent!r} is no node ({_unknown(problem.model, parent)}); "
            f"for a constant use a default, {parent}={parent}"
        )


def _unknown(model: Model, name: str) -> str:
    return unknown({n: c.declaration for n, c in model.nodes.items()}, name)


def _jointly(function: Callable[..., Any], names: tuple[str, ...]) -> Callable[..., Any]:
    """A block's function, with a dict of distributions in one piece."""

    def joint(*arguments: Any) -> Any:
        result = function(*arguments)
        if not isinstance(result, Mapping):
            return result
        if set(result) != set(names):
            raise ModelError(
                f"the function returns distributions for {sorted(map(str, result))}, but the block is "
                f"{list(names)}; give one for each"
            )
        parts = {name: as_distribution(part) for name, part in result.items()}
        for name, part in parts.items():
            if part is None:
                raise ModelError(
                    f"the function returns {type(result[name]).__name__} for {name!r}; return a "
                    "distribution"
                )
        return Parts({name: part for name, part in parts.items() if part is not None})

    return joint
