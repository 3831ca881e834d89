"""What a term's function does to some nodes, found by calling it once with stand-ins for their values."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import ParameterError
from bayesmc.network.model import arguments_of
from bayesmc.plates import Lookups, PlateArray
from bayesmc.structure.target import Target, Term
from bayesmc.tracing import TracedCall, Tracer, is_traced

#: what holds no stand-in; an error is a mark of bad parameters
_PLAIN = (np.ndarray, np.generic, np.dtype, np.ufunc, float, int, str, bytes, ParameterError)
#: how deep distributions may hold others
_DEPTH = 12


@dataclass(frozen=True, eq=False)
class Traced:
    """A call with stand-ins.

    Attributes
    ----------
    result : object
        What the function returned: a ``TracedCall``, a distribution or an array that do not depend on the
        traced nodes, or a ``Tracer``.
    keys : list of tuple
        Indices by which a traced node in foreign plates was looked up.
    keys_are_constant : bool
        They are the same in every call.
    """

    result: Any
    keys: list[tuple[Any, ...]]
    keys_are_constant: bool = False

    @property
    def sources(self) -> frozenset[str]:
        """Names that the result varies with; ``x[0]`` through the first lookup, ``x[*]`` through all of x."""
        if not isinstance(self.result, TracedCall):
            return _sources(self.result, 0)
        found = (
            _sources(v, _event_axes(self.result.function, k)) for k, v in self.result.traced.items()
        )
        return frozenset().union(*found)


class Untraceable(Exception):
    """A function that cannot be followed; the message says why."""


def trace_term(target: Target, names: tuple[str, ...], term: Term) -> Traced | None:
    """A term's function with stand-ins for chain nodes; None where it cannot be followed."""
    try:
        return traced_term(target, names, term)
    except Untraceable:
        return None


def traced_term(target: Target, names: tuple[str, ...], term: Term) -> Traced:
    """As ``trace_term``; raises ``Untraceable`` with the reason."""
    result, keys = _call(target, names, term)
    constant = False
    if keys and not any(target.model[n].is_discrete for n in target.hidden_above(term)):
        constant = _same_keys(target, term, keys)
    return Traced(result, keys, constant)


# ---- private ------------------------------------------------------------------------------------


def _call(target: Target, names: tuple[str, ...], term: Term) -> tuple[Any, list[tuple[Any, ...]]]:
    model = target.model
    # nothing is copied: there may be thousands of nodes, and as many calls
    values: Any = ChainMap({}, target.known, model.probe)
    for name in names:
        node = model[name]
        if node.domain is not None:
            raise Untraceable(f"{name!r} is discrete")
        values[name] = Tracer(
            np.asarray(values[name], dtype=float), [name], event_ndim=len(node.event_shape)
        )
    keys: list[tuple[Any, ...]] = []
    with marking_invalid(), np.errstate(all="ignore"):
        for link in target.between(names, term):
            node = model[link]
            if node.declaration.vectorize or node.declaration.function is None or node.domain:
                raise Untraceable(f"node {link!r} cannot be followed")
            value, batch = _made(node.links, values, node.declaration.function, [])
            if not is_traced(value):
                value = np.asarray(value)
            values[link] = np.broadcast_to(value, batch + node.value_shape)
        if term.is_potential:
            potential, links = model.potentials[term.name]
            function: Any = potential.function
            vectorize = False
        else:
            declaration = model[term.name].declaration
            links = model[term.name].links
            function, vectorize = declaration.function, declaration.vectorize
        if vectorize or function is None:
            raise Untraceable(f"{term.name!r} is called element by element")
        result, _ = _made(links, values, function, keys)
    _refuse_hidden(result, term)
    return result, keys


def _refuse_hidden(result: Any, term: Term) -> None:
    """Refuse results in which a stand-in may stand unseen: in a closure, or in another library's object."""
    if is_traced(result) or isinstance(result, (np.ndarray, np.generic, float, int, bool)):
        return
    if not isinstance(result, Distribution):
        what = type(result).__module__.partition(".")[0]
        raise Untraceable(f"{term.name!r} is an object of {what}, which shows no parameters")
    if not _is_open(result):
        raise Untraceable(f"{term.name!r} is {type(result).__name__}, given by a function")


def _is_open(value: Any, depth: int = 0) -> bool:
    """Whether an object holds numbers only, at most inside of our own objects and lists."""
    if value is None or isinstance(value, _PLAIN):
        return True
    if depth > _DEPTH:
        return False
    if isinstance(value, (list, tuple)):
        return all(_is_open(v, depth + 1) for v in value)
    if isinstance(value, Mapping):
        return all(_is_open(v, depth + 1) for v in value.values())
    if type(value).__module__.startswith("bayesmc."):
        return all(_is_open(v, depth + 1) for v in _attributes(value))
    return False


def _attributes(value: Any) -> Iterator[Any]:
    """What an object keeps, in its dict and in slots."""
    yield from getattr(value, "__dict__", {}).values()
    for family in type(value).__mro__:
        for name in getattr(family, "__slots__", ()):
            if hasattr(value, name):
                yield getattr(value, name)


def _made(links: Any, values: Mapping[str, Any], function: Any, keys: list[Any]) -> tuple[Any, Any]:
    arguments, batch = arguments_of(links, values)
    made = []
    for i, (parent, _) in enumerate(links):
        argument = arguments[i]
        if isinstance(argument, PlateArray) and is_traced(argument.array):
            argument = Lookups(
                argument.array, argument.plates, argument.own, argument.event_ndim, parent
            )
            made.append(argument)
            arguments[i] = argument
    try:
        result = function(*arguments)
    except Exception as error:
        raise Untraceable(str(error)) from error
    if any(argument.keys_changed for argument in made):
        raise Untraceable("an index is changed after it was used")
    for argument in made:
        keys.extend(argument.keys)
    if len([a for a in made if a.keys]) > 1:
        raise Untraceable("several parents in foreign plates are looked up")
    return result, batch


def _same_keys(target: Target, term: Term, keys: list[tuple[Any, ...]]) -> bool:
    """Whether the indices stay the same, with all hidden continuous nodes traced."""
    everyone = tuple(n for n in target.hidden_above(term) if target.model[n].domain is None)
    try:
        _, again = _call(target, everyone, term)
    except Untraceable:
        return False
    flat = [k for pair in again for k in pair]
    if any(is_traced(k) for k in flat):
        return False
    wanted = [tuple(np.asarray(k).tobytes() for k in pair) for pair in keys]
    found = [tuple(np.asarray(k).tobytes() for k in pair) for pair in again]
    return all(k in found for k in wanted)


def _event_axes(family: Any, parameter: str) -> int:
    """Axes that one value of a parameter has, whatever it is given as."""
    ndims = getattr(family, "parameter_ndim", {})
    others = {"scale_tril": 2, "scale_diag": 1, "logits": ndims.get("probs", 0)}
    return ndims.get(parameter, others.get(parameter, 0))


def _sources(value: Any, event_ndim: int) -> frozenset[str]:
    """Sources of a parameter with some event axes; elements out of their places count as all of them."""
    if isinstance(value, Tracer):
        return value.at_plates(event_ndim).sources
    if isinstance(value, TracedCall):
        value = list(value.arguments.values())
    if isinstance(value, (list, tuple)):
        return frozenset().union(*(_sources(v, event_ndim) for v in value))
    return frozenset()
