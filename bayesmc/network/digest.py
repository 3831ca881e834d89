"""Digests: a short name of what a value holds, equal for equal values in any process.

Numbers count by their bytes, containers by their entries, a user's functions by their code and what it reads
around it, objects by their class and their state. What an installed package defines is told by its name: it
is the same wherever that version is installed. Sharing is told apart from equality for functions, classes and
objects alone, so that each of them is walked once.
"""

from __future__ import annotations

import dis
import functools
import hashlib
import importlib.util
import sys
import sysconfig
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.expression import Expression, ordered
from bayesmc.expression.trace import Family, names_in
from bayesmc.network.sameness import DEFINED, parts_of

#: containers within containers that are looked into
_DEPTH = 60
_SIMPLE = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis), range, slice)
#: attributes of a class that are made from the others, or say nothing of what it computes
_OF_CLASS = frozenset({"__doc__", "__repr__", "__str__", "__annotate__", "__annotate_func__"})
#: objects that hold nothing that a density could read, and generators, which are refused elsewhere
_EMPTY = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, types.ModuleType)
_LOCKS = ("lock", "RLock")


def digest(value: Any, unseen: Callable[[Any], None] | None = None) -> str:
    """A short name of what a value holds: equal for equal values, in any process.

    Functions count by their code and what it reads, objects by their class and their state.

    Parameters
    ----------
    value : object
    unseen : callable, optional
        Called with what cannot be looked into, of which only the type counts.

    Examples
    --------
    >>> from collections import deque
    >>> from bayesmc.network.digest import digest
    >>> digest(deque([1.0])) == digest(deque([1.0])), digest(deque([1.0])) == digest(deque([2.0]))
    (True, False)
    """
    hashed = hashlib.sha256()
    for piece in _Walk(unseen or _ignored).pieces(value, _DEPTH):
        hashed.update(len(piece).to_bytes(8, "little"))
        hashed.update(piece)
    return hashed.hexdigest()[:16]


# ---- private ------------------------------------------------------------------------------------


def _ignored(_: Any) -> None:
    """Of values that cannot be looked into the type is enough."""


class _Walk:
    """Through one value, naming functions, classes and objects by the order in which they are met."""

    def __init__(self, unseen: Callable[[Any], None]) -> None:
        self.unseen = unseen
        self.met: dict[int, tuple[int, Any]] = {}  # held, so that no other object has the same id
        self.around: dict[int, Any] = {}

    def pieces(self, value: Any, depth: int) -> Iterator[bytes]:
        """Bytes that tell a value from others."""
        if isinstance(value, Expression):
            yield from self._of_graph(value, depth)
        elif isinstance(value, np.ndarray) and value.dtype != object:
            yield from _of_array(value)
        elif isinstance(value, np.generic):
            yield value.dtype.str.encode() + value.tobytes()
        elif isinstance(value, _SIMPLE):
            yield f"{type(value).__name__} {value!r}".encode()
        elif depth == 0:
            self.unseen(value)
            yield _kind(value)
        elif isinstance(value, (np.ndarray, list, tuple, set, frozenset, Mapping, Family)):
            yield from self._of_container(value, depth)
        elif id(value) in self.met:
            yield f"met {self.met[id(value)][0]}".encode()
        else:
            self.met[id(value)] = len(self.met), value
            for part in self._inside(value):
                yield from (part,) if isinstance(part, bytes) else self.pieces(part[0], depth - 1)

    def _of_container(self, value: Any, depth: int) -> Iterator[bytes]:
        if id(value) in self.around:
            yield b"what it lies in"
            return
        self.around[id(value)] = value
        yield _kind(value)
        if isinstance(value, (set, frozenset)):
            yield from sorted(digest(v, self.unseen).encode() for v in value)
        else:
            entries = list(_entries(value))
            yield str(len(entries)).encode()
            for entry in entries:
                yield from self.pieces(entry, depth - 1)
        if not isinstance(value, (list, tuple, np.ndarray, Family)):
            yield from self._of_own_kind(value, depth)
        del self.around[id(value)]

    def _of_own_kind(self, value: Any, depth: int) -> Iterator[bytes]:
        """What a user's kind of container has beside its entries."""
        if not is_installed(type(value).__module__):
            yield from self.pieces(type(value), depth - 1)

    def _inside(self, value: Any) -> Iterator[Any]:
        """Bytes, and values in tuples of one, that a value is made of."""
        yield _kind(value)
        if isinstance(value, Distribution):
            yield from self._of_distribution(value)
        elif isinstance(value, types.FunctionType):
            yield from _of_function(value)
        elif isinstance(value, type):
            if not is_installed(value.__module__):
                yield from _of_class(value)
        elif isinstance(value, types.CodeType):
            yield (parts_of(value),)
        elif isinstance(value, (types.MethodType, functools.partial)):
            yield (parts_of(value),)
        elif isinstance(value, types.BuiltinFunctionType):
            if not isinstance(value.__self__, (types.ModuleType, type(None))):
                yield (value.__self__,)  # `counts.get` is of its dictionary
        elif isinstance(value, (property, staticmethod, classmethod, functools.cached_property)):
            names = ("fget", "__func__", "func")
            yield ([getattr(value, n) for n in names if hasattr(value, n)],)
        elif isinstance(value, DEFINED):
            if not _is_named(value) and isinstance(value, np.ufunc):
                self.unseen(value)
        elif not _is_named(value):
            yield from self._of_object(value)

    def _of_distribution(self, value: Distribution) -> Iterator[Any]:
        yield (type(value),)
        for name in getattr(type(value), "parameter_ndim", None) or sorted(vars(value)):
            yield name.encode()
            yield (getattr(value, name, None),)

    def _of_object(self, value: Any) -> Iterator[Any]:
        """An object by its class, and by what it would be copied from."""
        yield (type(value),)
        if isinstance(value, _EMPTY) or type(value).__name__ in _LOCKS:
            return
        try:
            reduced = value.__reduce_ex__(4)
        except Exception:  # an object may fail to be copied as it likes
            own = parts_of(value)
            if own is None:
                self.unseen(value)
            yield (own,)
            return
        if isinstance(reduced, str):
            yield reduced.encode()
            yield (parts_of(value),)  # of a function with a cache, the function
            return
        make, arguments, *rest = reduced
        yield (make,)
        yield (arguments,)
        for part in rest[:1]:  # the state: a dictionary, or it with slots
            states = part if isinstance(part, tuple) else (part,)
            yield ([_settled(value, s) for s in states],)
        for part in rest[1:]:  # entries of lists and of mappings
            yield (None if part is None else list(part),)

    def _of_graph(self, root: Expression, depth: int) -> Iterator[bytes]:
        number: dict[Expression, int] = {}
        for node in ordered(root):
            number[node] = len(number)
            operands = [number[o] for o in node.operands]
            yield f"{type(node).__name__} {operands} {node.shape} {node.dtype.str}".encode()
            for part in node.content:
                yield from self.pieces(part, max(depth - 1, 4))


def _of_array(value: np.ndarray) -> Iterator[bytes]:
    yield f"array {value.shape} {value.dtype.str}".encode()
    yield np.ascontiguousarray(np.ma.getdata(value)).tobytes()
    if isinstance(value, np.ma.MaskedArray):
        yield np.ma.getmaskarray(value).tobytes()


def _entries(value: Any) -> Iterable[Any]:
    if isinstance(value, np.ndarray):
        return [value.shape, *value.flat]
    if isinstance(value, Mapping):
        return [part for item in value.items() for part in item]
    return (value.make, value.parameters) if isinstance(value, Family) else value


def _settled(owner: Any, state: Any) -> Any:
    """Attributes in the order of their names, without what is worked out from the others when asked for."""
    if not isinstance(state, dict) or not all(isinstance(k, str) for k in state):
        return state
    kind = type(owner)
    lazy = functools.cached_property
    return {k: state[k] for k in sorted(state) if not isinstance(getattr(kind, k, None), lazy)}


def _of_function(function: types.FunctionType) -> Iterator[Any]:
    """A user's function by its code and what it reads; one of a package by its name and its closure."""
    parts: list[Any] = parts_of(function) or []
    code, defaults, keywords, cells, around = parts
    if is_installed(function.__globals__.get("__name__", "")):
        yield f"{function.__module__} {function.__qualname__}".encode()
        yield (cells,)
        return
    names = names_in(function.__code__)
    yield ([code, defaults, keywords, [_read_from(cell, names) for cell in cells]],)
    for name in sorted(around):
        yield name.encode()
        yield (_read_from(around[name], names),)
    for name in sorted(set(_imported(function.__code__))):
        yield name.encode()
        yield _source(name)
    if hasattr(function, "__wrapped__"):
        yield (function.__wrapped__,)


def _read_from(value: Any, names: Iterable[str]) -> Any:
    """A global that code reads; of a user's module, what the code names of it."""
    if not isinstance(value, types.ModuleType) or is_installed(value.__name__):
        return value
    own = vars(value)
    return {n: _read_from(own[n], names) for n in sorted(set(names)) if n in own}


def _imported(code: types.CodeType) -> Iterator[str]:
    """Modules that code imports when it runs."""
    for step in dis.get_instructions(code):
        if step.opname == "IMPORT_NAME":
            yield step.argval
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from _imported(inner)


def _source(module: str) -> bytes:
    """The text of a user's module, which is read where a function imports it when it runs."""
    if is_installed(module):
        return b""
    try:
        spec = importlib.util.find_spec(module)
        return b"" if spec is None or not spec.origin else Path(spec.origin).read_bytes()
    except (ImportError, ValueError, OSError):
        return b""


def _of_class(kind: type) -> Iterator[Any]:
    """A user's class by what it does and holds, and by the classes that it stands on."""
    yield (list(kind.__bases__),)
    for name, own in sorted(vars(kind).items()):
        hidden = name.startswith("__") and not isinstance(own, (types.FunctionType, staticmethod))
        made = isinstance(own, (types.MemberDescriptorType, types.GetSetDescriptorType))
        if hidden or made or name in _OF_CLASS or name.startswith("_abc_"):
            continue
        yield name.encode()
        yield (own,)


def _kind(value: Any) -> bytes:
    """What sort of thing a value is, and its name where it is one that has a name."""
    if isinstance(value, (types.CodeType, types.FunctionType)):
        return type(value).__name__.encode()
    if isinstance(value, DEFINED) or _is_named(value):
        return f"{getattr(value, '__module__', '')} {getattr(value, '__name__', '')}".encode()
    return f"{type(value).__module__} {type(value).__qualname__}".encode()


def _is_named(value: Any) -> bool:
    """Whether it is what an installed package has under its name, such as ``np.where``."""
    home, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    name = name or getattr(value, "__name__", None)
    if not callable(value) or not isinstance(home, str) or not isinstance(name, str):
        return False
    found: Any = sys.modules.get(home)
    for step in name.split("."):
        found = getattr(found, step, None)
    return found is value and is_installed(home)


@functools.lru_cache(maxsize=4096)
def is_installed(module: str) -> bool:
    """Whether a module comes with Python, with this package or with another that is installed.

    Examples
    --------
    >>> from bayesmc.network.digest import is_installed
    >>> is_installed("numpy.linalg"), is_installed("math"), is_installed("__main__")
    (True, True, False)
    """
    top = module.split(".")[0]
    if top in sys.stdlib_module_names or top in ("numpy", "scipy", "bayesmc", "builtins"):
        return True
    try:
        spec = importlib.util.find_spec(top) if top != "__main__" else None
    except (ImportError, ValueError):
        return False
    origin = getattr(spec, "origin", None) or ""
    homes = {sysconfig.get_paths()[k] for k in ("purelib", "platlib")}
    away = any(part in ("site-packages", "dist-packages") for part in Path(origin).parts)
    return away or any(origin.startswith(h) for h in homes if h)
