"""Whether functions are one function, up to numbers: the templates that a loop stamped out.

A loop declares ``lambda x, t=t: ...`` a hundred times: one code, with other defaults. ``skeleton`` tells what
of a function must be the same (code, globals, what is not a number) and lists the numbers that may differ;
``with_numbers`` puts others in their place. Nothing is said about whether the function broadcasts over them.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_PACKAGE = __name__.split(".")[0] + "."


@dataclass(frozen=True, eq=False)
class Skeleton:
    """What a function is.

    Attributes
    ----------
    key : hashable
        Equal for functions that differ in numbers only.
    numbers : tuple
        Numbers and arrays of numbers among its defaults and what it closes over, in a fixed order.
    """

    key: Hashable
    numbers: tuple[Any, ...]


def skeleton(function: Callable[..., Any] | None) -> Skeleton:
    """The skeleton of a function.

    What cannot be looked into (a list, a method of somebody's object) is the same only where it is the very
    same object.

    Examples
    --------
    >>> from bayesmc.structure.likeness import skeleton, with_numbers
    >>> f, g = (lambda x, t=t: x + t for t in (1, 2))
    >>> skeleton(f).key == skeleton(g).key, skeleton(g).numbers
    (True, (2,))
    >>> with_numbers(f, [10])(1)
    11
    """
    numbers: list[Any] = []
    try:
        return Skeleton(_key(function, numbers, ()), tuple(numbers))
    except RecursionError:  # it closes over itself
        return Skeleton(("object", id(function)), ())


def with_numbers(function: Callable[..., Any], numbers: Sequence[Any]) -> Callable[..., Any]:
    """The function with other numbers, in the order of its skeleton's."""
    left = list(numbers)
    return _rebuilt(function, left)


def same_number(a: Any, b: Any) -> bool:
    """Whether two numbers, or arrays of them, are the same to the last bit."""
    if a is b:
        return True
    x, y = np.asarray(a), np.asarray(b)
    return x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()


# ---- private ------------------------------------------------------------------------------------


def _is_number(value: Any) -> bool:
    if isinstance(value, (int, float)):
        return not isinstance(value, bool)
    return (
        type(value) is np.ndarray
        and value.dtype.kind in "iuf"
        or (isinstance(value, (np.integer, np.floating)))
    )


def _key(value: Any, numbers: list[Any] | None, above: tuple[int, ...]) -> Hashable:
    """The key of a value; numbers are listed, or with None are part of it."""
    if _is_number(value):
        array = np.asarray(value)
        if numbers is None:
            return ("number", array.dtype.str, array.shape, array.tobytes())
        numbers.append(value)
        return ("number", array.dtype.kind, array.shape)
    if value is None or isinstance(value, (bool, str, bytes)):
        return (type(value), value)
    if id(value) in above:
        raise RecursionError
    above = (*above, id(value))
    if isinstance(value, types.FunctionType):
        keywords = tuple(sorted((value.__kwdefaults__ or {}).items()))
        inner: Any = (value.__defaults__ or (), keywords, _contents(value))
        return (
            "function",
            value.__code__,
            id(value.__globals__),
            _key(inner, numbers, above),
        )
    if type(value) is tuple:
        return ("tuple", tuple(_key(v, numbers, above) for v in value))
    if type(value) is functools.partial:
        inner = (value.func, value.args, tuple(sorted(value.keywords.items())))
        return ("partial", _key(inner, numbers, above))
    if type(value) is np.ndarray and value.dtype.kind in "bSU":
        return ("array", value.dtype.str, value.shape, value.tobytes())
    if type(value).__module__.startswith(_PACKAGE) and hasattr(value, "__dict__"):
        # a distribution or a support: its shapes follow from its numbers, so these stay
        inner = tuple(sorted(vars(value).items()))
        return ("instance", type(value), _key(inner, None, above))
    return ("object", id(value))


def _contents(function: types.FunctionType) -> tuple[Any, ...]:
    """What a function closes over; an empty cell is ``Ellipsis``."""
    found = []
    for cell in function.__closure__ or ():
        try:
            found.append(cell.cell_contents)
        except ValueError:
            found.append(...)
    return tuple(found)


def _rebuilt(value: Any, left: list[Any]) -> Any:
    """A value with the next numbers in place of its own; ``left`` loses those."""
    if _is_number(value):
        return left.pop(0)
    if isinstance(value, types.FunctionType):
        keywords = dict(sorted((value.__kwdefaults__ or {}).items()))
        defaults = _rebuilt(value.__defaults__ or (), left)
        keywords = {name: _rebuilt(v, left) for name, v in keywords.items()}
        contents = _rebuilt(_contents(value), left)
        cells = tuple(types.CellType() if v is ... else types.CellType(v) for v in contents)
        made = types.FunctionType(
            value.__code__, value.__globals__, value.__name__, defaults or None, cells or None
        )
        made.__kwdefaults__ = keywords or None
        return made
    if type(value) is tuple:
        return tuple(_rebuilt(v, left) for v in value)
    if type(value) is functools.partial:
        function = _rebuilt(value.func, left)
        arguments = _rebuilt(value.args, left)
        ordered = dict(sorted(value.keywords.items()))
        return functools.partial(
            function, *arguments, **{name: _rebuilt(v, left) for name, v in ordered.items()}
        )
    return value
