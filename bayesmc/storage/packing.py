"""Values as text and arrays, and back: what stands in a file of ours is data and never code.

A tree of numbers, strings, containers and arrays, and objects of classes of bayesmc by what they say of
their state (``__getstate__``, so that functions stay out as they do of pickles). Reading makes no other
objects, and calls nothing but these classes' own ``__setstate__`` and constructors; whoever writes a file
cannot have it run anything.
"""

from __future__ import annotations

import base64
import enum
import functools
import json
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.errors import FileFormatError, UnsupportedError

#: arrays begin at multiples of so many bytes
ALIGNED = 64
#: kinds of numbers that arrays hold: none are objects
_KINDS = "biufcSUMm"
#: where classes and functions are taken from
_HOME = "bayesmc."

#: an array that stands elsewhere: its name there
Elsewhere = Callable[[str], np.ndarray]


def packed(value: Any, elsewhere: Mapping[int, str] | None = None) -> list[bytes | memoryview]:
    """A value as bytes, in parts that are to be written one after the other.

    Parameters
    ----------
    elsewhere : dict, optional
        ``id`` of arrays that are written elsewhere -> the name under which ``unpacked`` will find them.

    Raises
    ------
    UnsupportedError
        It holds something that is no data: a function of the user's, an object of another package.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.storage.packing import packed, unpacked
    >>> parts = packed({"x": np.arange(3), "t": (1, None)})
    >>> unpacked(b"".join(parts))
    {'x': array([0, 1, 2]), 't': (1, None)}
    """
    packer = _Packer(elsewhere or {})
    tree = packer.of(value, "value")
    text = json.dumps([tree, packer.table()], separators=(",", ":")).encode()
    head = len(text).to_bytes(8, "little")
    parts: list[bytes | memoryview] = [head + text]
    at = 8 + len(text)
    for array in packer.arrays:
        gap = -at % ALIGNED
        parts.append(b"\0" * gap)
        if array.nbytes:
            parts.append(array.reshape(-1).view(np.uint8).data)
        at += gap + array.nbytes
    return parts


def unpacked(data: Any, elsewhere: Elsewhere | None = None) -> Any:
    """The value behind bytes that ``packed`` made.

    Parameters
    ----------
    data : bytes-like
    elsewhere : callable, optional
        From the name of an array that stands elsewhere to the array.

    Raises
    ------
    FileFormatError
    """
    view = memoryview(data)
    try:
        size = int.from_bytes(view[:8], "little")
        tree, table = json.loads(bytes(view[8 : 8 + size]))
        return _Unpacker(view[8 + size :], 8 + size, table, elsewhere).of(tree)
    except FileFormatError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise FileFormatError(
            f"what was saved cannot be read: {type(error).__name__}: {error}; it was written by another "
            "version of bayesmc, or is damaged"
        ) from error


# ---- private ------------------------------------------------------------------------------------


class _Packer:
    def __init__(self, elsewhere: Mapping[int, str]) -> None:
        self.elsewhere = elsewhere
        self.arrays: list[np.ndarray] = []
        self._rows: list[Any] = []
        self._met: dict[int, int] = {}
        self._held: list[Any] = []

    def table(self) -> list[Any]:
        """Dtype, shape and order of axes of every array."""
        return self._rows

    def of(self, value: Any, where: str) -> Any:
        """The tree of a value; ``where`` it stands, for messages."""
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        if kind in (list, tuple):
            items = [self.of(v, f"{where}[{k}]") for k, v in enumerate(value)]
            return items if kind is list else {"tuple": items}
        if kind in (dict, types.MappingProxyType):
            name = "dict" if kind is dict else "proxy"
            return {
                name: [[self.of(k, where), self.of(v, f"{where}[{k!r}]")] for k, v in value.items()]
            }
        found = self._simple(value, where)
        return self._object(value, where) if found is None else found

    def _simple(self, value: Any, where: str) -> Any:
        """Values of Python and NumPy besides; None where it is none."""
        if isinstance(value, np.ndarray) and type(value) is np.ndarray:
            return self._array(value, where)
        if isinstance(value, np.generic):
            if value.dtype.kind not in _KINDS:
                return None
            data = base64.b64encode(value.tobytes()).decode()
            return {"scalar": [value.dtype.str, data]}
        if isinstance(value, enum.Enum):
            return {"enum": [self._place(type(value), where), value.name]}
        if isinstance(value, (set, frozenset)):
            items = sorted((self.of(v, where) for v in value), key=json.dumps)
            return {type(value).__name__: items}
        if isinstance(value, (range, slice)):
            parts = [self.of(v, where) for v in (value.start, value.stop, value.step)]
            return {type(value).__name__: parts}
        if isinstance(value, bytes):
            return {"bytes": base64.b64encode(value).decode()}
        if isinstance(value, complex):
            return {"complex": [value.real, value.imag]}
        if value is Ellipsis:
            return {"ellipsis": None}
        if isinstance(value, np.dtype):
            return {"dtype": value.str}
        if isinstance(value, np.ufunc):
            return {"ufunc": value.__name__}
        if isinstance(value, np.random.SeedSequence):
            state = value.state
            return {
                "seed": [self.of(state[k], where) for k in ("entropy", "spawn_key", "pool_size")]
            }
        return None

    def _array(self, value: np.ndarray, where: str) -> Any:
        if id(value) in self.elsewhere:
            return {"elsewhere": self.elsewhere[id(value)]}
        if value.dtype == object:
            items = [self.of(v, where) for v in value.flat]
            return {"objects": [list(value.shape), items]}
        if value.dtype.kind not in _KINDS:
            raise self._refusal(value, where)
        if id(value) not in self._met:
            own = np.copy(value, order="K")  # no bits depend on an order of axes that got lost
            order = sorted(range(own.ndim), key=lambda k: (-own.strides[k], k))
            flat = np.array(own.transpose(order), order="C")
            self._rows.append([own.dtype.str, list(flat.shape), order, int(value.flags.writeable)])
            self.arrays.append(flat)
            self._met[id(value)] = len(self.arrays) - 1
            self._held.append(value)
        return {"array": self._met[id(value)]}

    def _object(self, value: Any, where: str) -> Any:
        if isinstance(value, type):
            return {"class": self._place(value, where)}
        if isinstance(value, types.FunctionType):
            if value.__module__.startswith(_HOME) and value.__qualname__.isidentifier():
                return {"function": self._place(value, where)}
            raise self._refusal(value, where)
        if isinstance(value, types.MethodType) and not isinstance(value.__self__, type):
            if not value.__name__.startswith("__"):
                return {"method": [self.of(value.__self__, where), value.__name__]}
        if isinstance(value, functools.partial):
            parts = value.func, value.args, value.keywords
            return {"partial": [self.of(p, where) for p in parts]}
        kind = type(value)
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            items = [self.of(v, f"{where}.{n}") for n, v in zip(value._fields, value, strict=True)]
            return {"named": [self._place(kind, where), items]}
        if not kind.__module__.startswith(_HOME):
            raise self._refusal(value, where)
        if id(value) in self._met:
            return {"again": self._met[id(value)]}
        number = len(self._held)
        self._met[id(value)] = -1 - number
        self._held.append(value)
        made = {"number": -1 - number}
        if kind.__reduce__ is not object.__reduce__:
            reduced: Any = value.__reduce__()
            state = [self.of(v, where) for v in reduced[1]]
            if len(reduced) > 2 and reduced[2] is not None:
                raise self._refusal(value, where)
            return {"made": [self._place(reduced[0], where), state], **made}
        state = value.__getstate__()
        slots = None
        if isinstance(state, tuple) and kind.__getstate__ is object.__getstate__:
            state, slots = state
        whole = state if isinstance(state, (list, tuple)) else dict(state or {})
        tree = self.of(whole, where)
        both = [tree, None if slots is None else self.of(dict(slots), where)]
        return {"object": [self._place(kind, where), both], **made}

    def _place(self, what: Any, where: str) -> str:
        module, name = what.__module__, what.__qualname__
        builtin = {"builtins.int", "builtins.float", "builtins.bool", "builtins.str"}
        if not module.startswith(_HOME) and f"{module}.{name}" not in builtin:
            raise self._refusal(what, where)
        if _found(f"{module}:{name}") != what:
            raise self._refusal(what, where)
        return f"{module}:{name}"

    @staticmethod
    def _refusal(value: Any, where: str) -> UnsupportedError:
        what = getattr(value, "__qualname__", None) or f"a {type(value).__qualname__}"
        return UnsupportedError(
            f"a file holds data alone, and {what} (of {type(value).__module__}, at {where}) is none"
        )


class _Unpacker:
    def __init__(
        self, data: memoryview, before: int, table: Sequence[Any], elsewhere: Elsewhere | None
    ) -> None:
        self._data, self._elsewhere = data, elsewhere
        self._arrays: dict[int, np.ndarray] = {}
        self._objects: dict[int, Any] = {}
        self._rows, at = [], before
        for dtype, shape, order, writeable in table:
            kind = np.dtype(dtype)
            if kind.kind not in _KINDS:
                raise FileFormatError(f"an array of {dtype!r} holds no numbers or strings")
            at += -at % ALIGNED
            count = int(np.prod(shape, dtype=np.int64))
            self._rows.append((kind, shape, order, writeable, at - before, count))
            at += count * kind.itemsize

    def of(self, tree: Any) -> Any:
        """The value of a tree."""
        if isinstance(tree, list):
            return [self.of(v) for v in tree]
        if not isinstance(tree, dict):
            return tree
        kind = next(iter(tree))
        if kind == "elsewhere":
            return self._elsewhere_(tree[kind])
        if kind == "objects":
            return self._objects_of(*tree[kind])
        return getattr(self, "_" + kind)(tree[kind], tree.get("number"))

    def _array(self, number: int, _: Any) -> np.ndarray:
        if number not in self._arrays:
            dtype, shape, order, writeable, at, count = self._rows[number]
            if at + count * dtype.itemsize > len(self._data):
                raise FileFormatError("what was saved is cut off: an array is missing")
            flat = np.frombuffer(self._data, dtype, count, at).reshape(shape).copy()
            array = flat.transpose(np.argsort(order)) if len(order) > 1 else flat
            array.flags.writeable = bool(writeable)
            self._arrays[number] = array
        return self._arrays[number]

    def _elsewhere_(self, name: str) -> np.ndarray:
        if self._elsewhere is None:
            raise FileFormatError(f"{name!r} stands elsewhere, and nobody says where")
        return self._elsewhere(name)

    def _objects_of(self, shape: Sequence[int], items: Sequence[Any]) -> np.ndarray:
        array = np.empty(len(items), dtype=object)
        for k, item in enumerate(items):
            array[k] = self.of(item)
        return array.reshape(shape)

    def _object(self, parts: Any, number: int) -> Any:
        place, (state, slots) = parts
        kind = _class(place)
        made = self._objects[number] = object.__new__(kind)
        given = self.of(state)
        if slots is not None:
            for name, value in self.of(slots).items():
                object.__setattr__(made, name, value)
        if hasattr(kind, "__setstate__"):
            made.__setstate__(given)
        elif given or hasattr(made, "__dict__"):
            made.__dict__.update(given)
        return made

    def _made(self, parts: Any, number: int) -> Any:
        place, arguments = parts
        maker, (home, _, name) = None, place.rpartition(".")
        if ":" in home:  # a constructor besides, of a class
            maker = getattr(_class(home), name, None)
            if not isinstance(maker, types.MethodType) or maker.__self__ is not _class(home):
                raise FileFormatError(f"there is no constructor {place}")
        made = self._objects[number] = (maker or _class(place))(*(self.of(a) for a in arguments))
        return made

    def _again(self, number: int, _: Any) -> Any:
        return self._objects[number]

    def _named(self, parts: Any, _: Any) -> Any:
        kind = _class(parts[0])
        if not issubclass(kind, tuple):
            raise FileFormatError(f"{parts[0]} is no tuple")
        return kind(*(self.of(v) for v in parts[1]))

    def _class(self, place: str, _: Any) -> Any:
        return _class(place)

    def _function(self, place: str, _: Any) -> Any:
        found = _found(place)
        if not isinstance(found, types.FunctionType) or not found.__module__.startswith(_HOME):
            raise FileFormatError(f"there is no function {place}")
        return found

    def _method(self, parts: Any, _: Any) -> Any:
        holder, name = self.of(parts[0]), parts[1]
        found = getattr(type(holder), name, None)
        ours = isinstance(found, types.FunctionType) and found.__module__.startswith(_HOME)
        if name.startswith("__") or not ours:
            raise FileFormatError(f"there is no method {name!r}")
        return getattr(holder, name)

    def _partial(self, parts: Any, _: Any) -> Any:
        function, arguments, keywords = (self.of(p) for p in parts)
        return functools.partial(function, *arguments, **keywords)

    def _enum(self, parts: Any, _: Any) -> Any:
        return _class(parts[0])[parts[1]]

    def _scalar(self, parts: Any, _: Any) -> Any:
        return np.frombuffer(base64.b64decode(parts[1]), np.dtype(parts[0]))[0]

    def _tuple(self, items: Any, _: Any) -> Any:
        return tuple(self.of(v) for v in items)

    def _dict(self, items: Any, _: Any) -> Any:
        return {self.of(k): self.of(v) for k, v in items}

    def _proxy(self, items: Any, _: Any) -> Any:
        return types.MappingProxyType(self._dict(items, _))

    def _set(self, items: Any, _: Any) -> Any:
        return {self.of(v) for v in items}

    def _frozenset(self, items: Any, _: Any) -> Any:
        return frozenset(self.of(v) for v in items)

    def _range(self, parts: Any, _: Any) -> Any:
        return range(*parts)

    def _slice(self, parts: Any, _: Any) -> Any:
        return slice(*(self.of(p) for p in parts))

    def _bytes(self, text: str, _: Any) -> Any:
        return base64.b64decode(text)

    def _complex(self, parts: Any, _: Any) -> Any:
        return complex(*parts)

    def _ellipsis(self, nothing: Any, _: Any) -> Any:
        return Ellipsis

    def _dtype(self, text: str, _: Any) -> Any:
        return np.dtype(text)

    def _ufunc(self, name: str, _: Any) -> Any:
        special = sys.modules.get("scipy.special")
        found = getattr(np, name, None) or getattr(special, name, None)
        if not isinstance(found, np.ufunc):
            raise FileFormatError(f"there is no function {name!r}")
        return found

    def _seed(self, parts: Any, _: Any) -> Any:
        entropy, spawn_key, pool_size = (self.of(p) for p in parts)
        return np.random.SeedSequence(entropy, spawn_key=spawn_key, pool_size=pool_size)


def _found(place: str) -> Any:
    """What stands at a place of a module that is loaded."""
    module, _, name = place.partition(":")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def _class(place: str) -> Any:
    """A class of bayesmc (or a type of numbers), which a file may make objects of."""
    found = _found(place)
    if place in ("builtins:int", "builtins:float", "builtins:bool", "builtins:str"):
        return found
    if (
        not isinstance(found, type)
        or not place.startswith(_HOME)
        or found.__module__ != place.partition(":")[0]
    ):
        raise FileFormatError(
            f"there is no class {place}; the file was written by another version of bayesmc"
        )
    return found
