"""Fingerprints: what a question is, in a form that another process can compare with its own.

A function is told by the graph of what it computes, with what it read from around it as numbers in it; one
that cannot be followed by its code, and by what that reads. So a net that is declared anew by the same
lines has the same fingerprint, and one that says something else has another, in the place where it does.
"""

from __future__ import annotations

import functools
import hashlib
import types
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import BayesmcError
from bayesmc.expression import Expression, ordered
from bayesmc.expression.trace import Family
from bayesmc.network.evidence import Observed
from bayesmc.network.expressions import Followed, density
from bayesmc.network.model import CompiledNode, Model
from bayesmc.network.sameness import DEFINED, parts_of

#: objects within objects that are looked into
_DEPTH = 12
_SIMPLE = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis))

#: what differs, in words -> what stands there
Fingerprint = dict[str, str]


def fingerprint(model: Model) -> Fingerprint:
    """What a compiled net says, node by node.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network.fingerprint import fingerprint
    >>> def of(scale):
    ...     net = bmc.BayesNet()
    ...     net.add("x", bmc.Normal(0.0, 1.0))
    ...     net.add("y", lambda x: bmc.Normal(scale * x, 1.0))
    ...     return fingerprint(net.model({}, {}))
    >>> [what for what, now in of(3.0).items() if of(2.0)[what] != now], of(2.0) == of(2.0)
    (["the density of node 'y'"], True)
    """
    found = {"the nodes": _short(list(model.nodes)), "the sizes of plates": repr(dict(model.sizes))}
    if model.labels:
        found["the labels of plates"] = digest(model.labels)
    for name, node in model.nodes.items():
        found[f"the declaration of node {name!r}"] = digest(_outline(node))
        if node.declaration.source == "function":
            found[f"the density of node {name!r}"] = _of_function(
                model, name, node.declaration.function
            )
    for name, (potential, _) in model.potentials.items():
        rest = potential.parents, potential.plates, potential.index, potential.is_table
        found[f"the scope of potential {name!r}"] = digest(rest)
        found[f"the potential {name!r}"] = _of_function(model, name, potential.function)
    return found


def evidence_fingerprint(observed: Mapping[str, Observed], what: str = "evidence") -> Fingerprint:
    """What was seen, node by node."""
    return {
        f"the {what} of {name!r}": digest((seen.value, seen.mask, seen.parts))
        for name, seen in observed.items()
    }


def digest(value: Any) -> str:
    """A short name of what a value holds: equal for equal values, in any process.

    Functions count by their code and what it reads, objects by their attributes.
    """
    hashed = hashlib.sha256()
    for piece in _pieces(value, {}, _DEPTH):
        hashed.update(len(piece).to_bytes(8, "little"))
        hashed.update(piece)
    return hashed.hexdigest()[:16]


# ---- private ------------------------------------------------------------------------------------


def _short(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 12 else f"{len(names)} nodes ({digest(names)})"


def _outline(node: CompiledNode) -> tuple[Any, ...]:
    own = node.declaration
    states = None if node.domain is None else node.domain.states
    shown = (node.kind, own.source, node.parents, node.plates, node.value_shape, states)
    return (*shown, own.probs, own.value, own.vectorize)


def _of_function(model: Model, name: str, function: Any) -> str:
    try:
        found = density(model, name)
    except BayesmcError:
        return digest(function)
    if isinstance(found, Followed):
        return "graph " + digest(found.result)
    return "code " + digest(function)


def _pieces(value: Any, met: dict[int, Any], depth: int) -> Iterator[bytes]:
    """Bytes that tell a value from others."""
    if isinstance(value, Expression):
        yield from _of_graph(value, met, depth)
    elif isinstance(value, np.ndarray) and value.dtype != object:
        data = np.ma.getdata(value)
        yield f"array {value.shape} {value.dtype.str}".encode()
        yield np.ascontiguousarray(data).tobytes()
        if isinstance(value, np.ma.MaskedArray):
            yield np.ma.getmaskarray(value).tobytes()
    elif isinstance(value, np.generic):
        yield value.dtype.str.encode() + value.tobytes()
    elif isinstance(value, _SIMPLE):
        yield f"{type(value).__name__} {value!r}".encode()
    elif depth == 0 or id(value) in met:
        yield f"a {type(value).__name__}".encode()
    else:
        met[id(value)] = value
        for part in _inside(value):
            yield from (part,) if isinstance(part, bytes) else _pieces(part[0], met, depth - 1)
        del met[id(value)]  # which holds what is around, lest it go round for ever


def _inside(value: Any) -> Iterator[Any]:
    """Bytes, and values in tuples of one, that a value is made of."""
    yield _kind(value)
    if isinstance(value, Family):
        yield (value.make,)
        yield (value.parameters,)
    elif isinstance(value, Distribution):
        names = getattr(type(value), "parameter_ndim", None) or sorted(vars(value))
        for name in names:
            yield name.encode()
            yield (getattr(value, name, None),)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield (key,)
            yield (item,)
    elif isinstance(value, (set, frozenset)):
        for text in sorted(digest(v) for v in value):
            yield text.encode()
    elif isinstance(value, (list, tuple)):
        yield str(len(value)).encode()
        for item in value:
            yield (item,)
    elif isinstance(value, types.FunctionType):
        yield from _of_code(value)
    elif isinstance(value, (types.MethodType, types.CodeType, functools.partial)):
        for item in parts_of(value) or ():
            yield (item,)
    elif not isinstance(value, (*DEFINED, range, slice)) and not _is_named(value):
        for own in parts_of(value) or ():
            yield (dict(sorted(own.items())),)


def _kind(value: Any) -> bytes:
    """What sort of thing a value is, and its name where it is one that has a name."""
    if isinstance(value, (range, slice)):
        return repr(value).encode()
    if isinstance(value, types.CodeType | types.FunctionType):
        return type(value).__name__.encode()
    if isinstance(value, DEFINED) or _is_named(value):
        return f"{getattr(value, '__module__', '')} {getattr(value, '__name__', '')}".encode()
    return f"{type(value).__module__} {type(value).__qualname__}".encode()


def _is_named(value: Any) -> bool:
    """Whether it is a package's own, such as ``np.where``, which its name tells."""
    home = getattr(value, "__module__", None) or ""
    return callable(value) and home.startswith(("numpy", "scipy")) and hasattr(value, "__name__")


def _of_code(function: types.FunctionType) -> Iterator[Any]:
    """A user's function by its code and what it reads; one of a package by its name."""
    if function.__module__ and function.__module__.split(".")[0] in ("numpy", "scipy", "bayesmc"):
        yield f"{function.__module__} {function.__qualname__}".encode()
        return
    inner = getattr(function, "__wrapped__", None)
    for part in parts_of(function) or ():
        yield (part,)
    if inner is not None:
        yield (inner,)


def _of_graph(root: Expression, met: dict[int, Any], depth: int) -> Iterator[bytes]:
    number: dict[Expression, int] = {}
    for node in ordered(root):
        number[node] = len(number)
        operands = [number[o] for o in node.operands]
        yield f"{type(node).__name__} {operands} {node.shape} {node.dtype.str}".encode()
        for part in node.content:
            yield from _pieces(part, {}, max(depth - 1, 4))
