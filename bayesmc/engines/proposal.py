"""Proposals as a user writes them, read against a problem: the same for every engine that takes some.

A proposal is read like a node: its argument names are what it depends on, aligned as for its target. Which
arguments make sense, and what is drawn when, is the engine's affair; ``kernels.proposal`` says what a read
proposal can be asked.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from bayesmc.distributions import as_distribution
from bayesmc.errors import EvidenceError, ModelError, UnknownNodeError
from bayesmc.kernels.proposal import Key, Parts, Proposal, names_of
from bayesmc.network import Model, Problem
from bayesmc.network.calling import Aligner
from bayesmc.network.declaring import unknown
from bayesmc.network.node import Declaration, bind

#: what every engine takes as a proposal, in words
FUNCTION = "a function of named nodes that returns a distribution"


def check_specification(
    engine: str, proposal: Any, accepted: str, option: str = "proposal"
) -> dict[Key, Any]:
    """A copy of what a user gave as proposals, its keys looked at; ``option`` is where, for messages.

    Raises
    ------
    TypeError
        No mapping, or a key that is neither a name nor a tuple of names.
    ModelError
        Two proposals for one node.
    """
    if not isinstance(proposal, Mapping):
        raise TypeError(
            f"{engine}({option}={proposal!r}): give a dict from node name to {accepted}"
        )
    seen: set[str] = set()
    for key in proposal:
        if not key or not all(isinstance(n, str) for n in names_of(key)):
            raise TypeError(
                f"{engine}: the key {key!r} of {option}= is no node name; give a name, or a tuple of names "
                "that are proposed jointly"
            )
        for name in names_of(key):
            if name in seen:
                raise ModelError(
                    f"{engine}: {name!r} has two proposals in {option}=; every node is drawn by one, so keep "
                    "one of them"
                )
            seen.add(name)
    return dict(proposal)


def as_function(
    engine: str, key: Key, given: Any, accepted: str, option: str = "proposal"
) -> Callable[..., Any]:
    """The function of a proposal; a distribution (for a block, also a dict of them) is a constant one.

    Raises
    ------
    TypeError
        Something else.
    """
    if isinstance(key, tuple) and isinstance(given, Mapping):
        return lambda: given
    distribution = as_distribution(given)
    if distribution is not None:
        return lambda: distribution
    if not callable(given) or isinstance(given, type):
        raise TypeError(
            f"{engine}: the {option} for {key!r} is {given!r}; give {accepted}, or a distribution"
        )
    return given


def check_targets(engine: str, problem: Problem, key: Key, option: str = "proposal") -> None:
    """Refuse targets that are never drawn.

    Raises
    ------
    UnknownNodeError, ModelError, EvidenceError
    """
    what = f"{engine}: {option} for {key!r}"
    for name in names_of(key):
        node = problem.model.nodes.get(name)
        if node is None:
            raise UnknownNodeError(f"{what}: {_unknown(problem.model, name)}")
        if node.kind != "stochastic":
            kind = {"fixed": "fixed by do()", "input": "an input"}.get(node.kind, "deterministic")
            raise ModelError(f"{what}: {name!r} is {kind} and never drawn; name a stochastic node")
        seen = problem.observed.get(name)
        if seen is not None and seen.mask is None:
            raise EvidenceError(
                f"{what}: {name!r} is observed, so there is nothing to draw; leave out the {option} or the "
                "evidence"
            )


def bound(engine: str, model: Model, key: Key, function: Callable[..., Any]) -> Proposal:
    """A user's function, bound to the nodes that its arguments name.

    Raises
    ------
    ModelError
        Arguments that cannot be read.
    UnknownNodeError
        An argument that is no node.
    """
    what = f"{engine}: proposal for {key!r}"
    _check_signature(function, what)
    parents, call = bind(what, function, None)
    for parent in parents:
        if parent not in model.nodes:
            raise UnknownNodeError(
                f"{what}: its argument {parent!r} is no node ({_unknown(model, parent)}); for a constant use "
                f"a default, {parent}={parent}"
            )
    names = names_of(key)
    if isinstance(key, tuple):
        call = _jointly(call, names)
    plates = () if isinstance(key, tuple) else model[key].plates
    links = tuple(
        (p, Aligner(plates, model[p].plates, len(model[p].event_shape), model[p].domain))
        for p in parents
    )
    declaration = Declaration(", ".join(names), "function", parents, plates, function=call)
    return Proposal(engine, key, names, declaration, links)


# ---- private ------------------------------------------------------------------------------------


def _check_signature(function: Callable[..., Any], what: str) -> None:
    """Argument names are all that says what a proposal depends on, so they must be readable."""
    try:
        arguments = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        raise ModelError(
            f"{what}: the arguments of {function!r} cannot be read; wrap it in a function whose arguments "
            "are the nodes it needs"
        ) from None
    for argument in arguments:
        if argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
            raise ModelError(
                f"{what}: *{argument.name} is refused, since argument names say what a proposal depends on; "
                "name the nodes"
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
