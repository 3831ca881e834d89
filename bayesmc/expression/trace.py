"""What a function does to its arguments: it is called with stand-ins, twice, and the results compared.

What it reads from around it counts, too. Clocks and chance are refused: two calls that differ show most of
it; what differs rarely is found by what is called, through the names that the code reads, into users' own
functions, modules and methods. NumPy hands a call on only where an argument stands for an array, so an
array around it that is indexed by one, a list that is made an array, and functions of SciPy that are no
ufuncs are put in place of themselves in a copy of the function.
"""

from __future__ import annotations

import contextlib
import dis
import functools
import inspect
import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import special

from bayesmc.errors import TraceError
from bayesmc.expression.array import TracedArray, TracedCall, is_traced, refusals
from bayesmc.expression.composed import COMPOSED
from bayesmc.expression.functions import expression_of, of_function
from bayesmc.expression.graph import Expression, as_expression, constant
from bayesmc.plates import PlateArray

#: modules of which some functions are replaced
_REPLACED = frozenset(("numpy", "scipy"))
#: modules whose functions give another answer the next time
_CHANGING = frozenset(("time", "random", "datetime", "secrets", "uuid", "os"))
#: modules whose functions give the same answer always
KNOWN = frozenset(("numpy", "scipy", "bayesmc", "builtins", "math"))
#: of these, where functions stand that users call in theirs
OPEN = ("bayesmc.robotics", "bayesmc.distributions")
#: types of values that call nothing
_PLAIN = frozenset((bool, int, float, str, np.ndarray, np.float64, type(None)))
#: containers up to this length are looked into
_FEW = 64


@dataclass(frozen=True, eq=False)
class Family:
    """A distribution whose parameters are expressions.

    Attributes
    ----------
    make : callable
        The family: a class of distributions, mostly.
    parameters : dict
        By the names of its constructor: an ``Expression``, a ``Family``, a list or tuple of these, or what
        else was given.
    """

    make: Callable[..., Any]
    parameters: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Frozen:
    """A family of ``scipy.stats``."""

    dist: Any

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Frozen) or hasattr(self.dist, "xk"):  # a table of its own
            return False
        return (type(self.dist), self.dist.name) == (type(other.dist), other.dist.name)

    def __hash__(self) -> int:
        return hash((type(self.dist), self.dist.name))

    def __call__(self, args: Sequence[Any], **kwds: Any) -> Any:
        return self.dist(*args, **kwds)


def trace(function: Callable[..., Any], arguments: Sequence[Any], is_steady: bool = False) -> Any:
    """What a function returns for stand-ins: an ``Expression``, a ``Family``, or what depends on none.

    Parameters
    ----------
    function : callable
    arguments : sequence
        ``TracedArray``, ``TracedStates``, ``PlateArray`` of these.
    is_steady : bool
        Whether it is known to give the same the next time, so that one call will do.

    Raises
    ------
    TraceError
        The function does what cannot be followed; the message says what.
    """
    why = None if is_steady else tells_time_or_chance(function)
    if why is not None:
        raise TraceError(why)
    times = 1 if is_steady else 2
    try:
        found = [_called(function, arguments) for _ in range(times)]
    except TraceError:
        if not isinstance(function, types.FunctionType):
            raise
        function = lifted(function)
        found = [_called(function, arguments) for _ in range(times)]
    if not same(found[0], found[-1]):
        raise TraceError("two calls with the same arguments differ")
    return found[0]


def expressions_of(traced: Any) -> Iterator[Expression]:
    """The expressions that something traced is made of, in order."""
    if isinstance(traced, Expression):
        yield traced
    elif isinstance(traced, Family):
        for value in traced.parameters.values():
            yield from expressions_of(value)
    elif isinstance(traced, (list, tuple)):
        for value in traced:
            yield from expressions_of(value)


def rebuilt(traced: Any, values: Iterator[Any]) -> Any:
    """What was traced, made of values in the place of its expressions, in order."""
    if isinstance(traced, Expression):
        return next(values)
    if isinstance(traced, Family):
        kept = {k: rebuilt(v, values) for k, v in traced.parameters.items()}
        return traced.make(*kept.pop(_starred(traced.make), ()), **kept)
    if isinstance(traced, (list, tuple)):
        return type(traced)(rebuilt(v, values) for v in traced)
    return traced


def mapped(traced: Any, change: Callable[[Expression], Expression]) -> Any:
    """What was traced, with every expression changed."""
    if isinstance(traced, Expression):
        return change(traced)
    if isinstance(traced, Family):
        return Family(traced.make, {k: mapped(v, change) for k, v in traced.parameters.items()})
    if isinstance(traced, (list, tuple)):
        return type(traced)(mapped(v, change) for v in traced)
    return traced


def same(first: Any, second: Any) -> bool:
    """Whether two traced results are equal."""
    if isinstance(first, Expression) or isinstance(second, Expression):
        return first is second
    if isinstance(first, Family) and isinstance(second, Family):
        keys = first.parameters.keys()
        return (
            first.make == second.make
            and keys == second.parameters.keys()
            and all(same(first.parameters[k], second.parameters[k]) for k in keys)
        )
    if isinstance(first, (list, tuple)) and isinstance(second, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    return type(first) is type(second)


def lifted(function: types.FunctionType) -> types.FunctionType:
    """A copy of a function, and of those that it calls, in which captured arrays are stand-ins."""
    return _lifted_function(function, {})


def tells_time_or_chance(function: Any) -> str | None:
    """What a function reads that another call finds changed, or None.

    Examples
    --------
    >>> import time
    >>> from bayesmc.expression.trace import tells_time_or_chance
    >>> tells_time_or_chance(lambda x: x * (time.time() > 0)), tells_time_or_chance(lambda x: 2 * x)
    ('it reads time, which another call finds changed', None)
    """
    seen: set[Any] = set()
    todo: list[tuple[Any, tuple[str, ...]]] = [(function, ())]  # values, and what is read of them
    while todo:
        value, names = todo.pop()
        if not isinstance(value, types.FunctionType):
            todo += _parts(value, names, seen)
        elif id(value) not in seen and (is_open(value) or value is function):
            seen.add(id(value))
            read = names_in(value.__code__)
            for name, held in _captured(value):
                found = _changing(name, held, read)
                if found is not None:
                    return found
                if type(held) not in _PLAIN and not is_left(held):
                    todo.append((held, read))
    return None


@lru_cache(maxsize=4096)
def names_in(code: types.CodeType) -> tuple[str, ...]:
    """Names that code reads, of functions inside of it, too."""
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return (*code.co_names, *(n for c in inner for n in names_in(c)))


def is_open(function: types.FunctionType) -> bool:
    """Whether a function is a user's, or one of those that users call in theirs."""
    module = str(function.__module__ or "")
    return _room(function) not in KNOWN or module.startswith(OPEN)


def is_left(value: Any) -> bool:
    """Whether a value is a module whose functions are what they seem."""
    if not isinstance(value, types.ModuleType):
        return False
    return value.__name__.split(".")[0] in KNOWN and not value.__name__.startswith(OPEN)


# ---- private ------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def _starred(make: Callable[..., Any]) -> str:
    """The name of ``*parts`` in a signature, where there is one."""
    # of a class its __init__'s: Python before 3.11.3 may take a class's signature from elsewhere
    own = make.__init__ if isinstance(make, type) else make  # type: ignore[misc]
    parameters = inspect.signature(own).parameters.values()
    return next((p.name for p in parameters if p.kind is p.VAR_POSITIONAL), "")


def _called(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    with refusals() as refused:
        try:
            found = _plain(function(*arguments))
        except TraceError:
            raise
        except Exception as error:
            why = refused[0] if refused else f"{type(error).__name__}: {error}"
            raise TraceError(why) from error
    if refused:  # and the function went on without
        raise TraceError(refused[0])
    return found


def _plain(value: Any) -> Any:
    """A function's result with expressions and families in the place of stand-ins."""
    if isinstance(value, PlateArray):
        raise value.ungathered()
    if isinstance(value, TracedArray):
        return value.expression
    if isinstance(value, TracedCall):
        kept = {k: _plain(v) for k, v in value.arguments.items()}
        return Family(value.function, kept)
    if all(hasattr(value, name) for name in ("dist", "args", "kwds")):  # of scipy.stats, frozen
        parts = _plain(list(value.args)), {k: _plain(v) for k, v in value.kwds.items()}
        return Family(Frozen(value.dist), {"args": parts[0], **parts[1]})
    if isinstance(value, (list, tuple)) and is_traced(value):
        return type(value)(_plain(v) for v in value)
    if isinstance(value, (np.ndarray, np.generic, float, int)) and not isinstance(value, bool):
        return as_expression(value)
    return value


def _lifted_function(
    function: types.FunctionType, seen: dict[int, types.FunctionType]
) -> types.FunctionType:
    if id(function) in seen:
        return seen[id(function)]
    scope = dict(function.__globals__)
    cells = tuple(types.CellType() for _ in function.__closure__ or ())
    made = types.FunctionType(
        function.__code__, scope, function.__name__, None, cells if function.__closure__ else None
    )
    seen[id(function)] = made
    for name in set(names_in(function.__code__)) & scope.keys():
        scope[name] = _lifted(scope[name], seen)
    made.__defaults__ = tuple(_lifted(v, seen) for v in function.__defaults__ or ()) or None
    kept = function.__kwdefaults__ or {}
    made.__kwdefaults__ = {k: _lifted(v, seen) for k, v in kept.items()} or None
    for new, old in zip(cells, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):
            new.cell_contents = _lifted(old.cell_contents, seen)
    return made


def _lifted(value: Any, seen: dict[int, types.FunctionType]) -> Any:
    if type(value) is np.ndarray and value.ndim and value.dtype in (float, np.int64, bool):
        return TracedArray(constant(value))
    if isinstance(value, types.FunctionType) and is_open(value):
        return _lifted_function(value, seen)
    if isinstance(value, types.ModuleType) and (
        not is_left(value) or value.__name__.split(".")[0] in _REPLACED
    ):
        return _Module(value)
    try:
        return _INSTEAD.get(value, value)
    except TypeError:  # cannot be looked up
        return value


class _Module:
    """A module with what it holds lifted when it is asked for."""

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return _lifted(getattr(self._module, name), {})


def _if_traced(original: Callable[..., Any], rule: Callable[..., Any]) -> Callable[..., Any]:
    def chosen(first: Any, *args: Any, **kwargs: Any) -> Any:
        if is_traced([first, *args, *kwargs.values()]):
            return rule(first, *args, **kwargs)
        return original(first, *args, **kwargs)

    return chosen


def _array(value: Any, dtype: Any = None, **kwargs: Any) -> Any:
    found = TracedArray(expression_of(value), True)
    return found if dtype is None else found.astype(dtype)


def _made(original: Callable[..., Any]) -> Callable[..., Any]:
    """A function that makes an array, which can then be indexed by, and filled with, stand-ins."""

    def made(*args: Any, **kwargs: Any) -> Any:
        found = _array(*args, **kwargs) if _is_copy(original, args) else original(*args, **kwargs)
        standard = type(found) is np.ndarray and found.dtype in (float, np.int64, bool)
        return TracedArray(constant(found), True) if standard and found.ndim else found

    return made


def _is_copy(original: Callable[..., Any], args: tuple[Any, ...]) -> bool:
    copies = original in (np.array, np.asarray, np.asanyarray)
    return copies and is_traced(list(args)) and not any(isinstance(a, TracedCall) for a in args)


_INSTEAD: dict[Any, Callable[..., Any]] = {
    original: _if_traced(original, rule)
    for original, rule in (
        (np.take, lambda *args, **kwargs: TracedArray(of_function(np.take, args, kwargs))),
        (np.float64, lambda x: _array(x, float)),
        *((f, COMPOSED[f]) for f in (special.logsumexp, special.softmax, special.log_softmax)),
    )
} | {
    original: _made(original)
    for original in (
        np.array, np.asarray, np.asanyarray, np.zeros, np.ones, np.empty, np.full, np.eye,
        np.identity, np.arange, np.linspace,
    )
}  # fmt: skip


def _captured(function: types.FunctionType) -> list[tuple[str, Any]]:
    """What a function reads from around it: globals, cells, defaults."""
    names = _globals(function.__code__)
    found = [(n, function.__globals__[n]) for n in names if n in function.__globals__]
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # an empty cell
            found.append((name, cell.cell_contents))
    found += [("a default", v) for v in function.__defaults__ or ()]
    return found


@lru_cache(maxsize=4096)
def _globals(code: types.CodeType) -> frozenset[str]:
    """Names that code looks up around it, of functions inside of it, too."""
    found = (i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL")
    return frozenset(found).union(
        *(_globals(c) for c in code.co_consts if isinstance(c, types.CodeType))
    )


def _parts(
    value: Any, names: tuple[str, ...], seen: set[Any]
) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """What is called where a value is, or where something is read of it."""
    if isinstance(value, functools.partial):
        yield from ((v, names) for v in (value.func, *value.args, *value.keywords.values()))
    elif isinstance(value, types.MethodType):
        yield value.__func__, ()
        yield value.__self__, names_in(value.__func__.__code__) if _has_code(value) else ()
    elif isinstance(value, (list, tuple)):
        yield from ((v, names) for v in value[:_FEW] if callable(v))
    elif isinstance(value, types.ModuleType):
        held = vars(value)
        yield from ((held[n], ()) for n in names if isinstance(held.get(n), types.FunctionType))
    else:
        yield from _methods(value, names, seen)


def _methods(
    value: Any, names: tuple[str, ...], seen: set[Any]
) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """Methods of a user's class that are called where something is read of an object, or of the class."""
    kind = value if isinstance(value, type) else type(value)
    if _room(kind) in KNOWN or (kind, names) in seen:
        return
    seen.add((kind, names))
    for name in ("__init__", "__call__", *names):
        for held in (vars(k).get(name) for k in kind.__mro__):
            method = getattr(held, "fget", None) or getattr(held, "__func__", held)
            method = getattr(method, "func", method)  # of a cached property
            if isinstance(method, types.FunctionType):
                yield method, ()
                yield value, names_in(method.__code__)  # through self
    own = getattr(value, "__dict__", {})
    yield from ((own[n], names) for n in names if callable(own.get(n)) and value is not kind)


def _has_code(method: types.MethodType) -> bool:
    return isinstance(method.__func__, types.FunctionType)


def _changing(name: str, value: Any, read: tuple[str, ...]) -> str | None:
    if isinstance(value, types.ModuleType):
        if value.__name__ in _CHANGING:
            return f"it reads {value.__name__}, which another call finds changed"
        if value is np and "random" in read:
            return "it draws random numbers"
    if isinstance(value, (np.random.Generator, np.random.RandomState)):
        return f"it draws random numbers from {name}"
    if callable(value) and _room(value) in _CHANGING:
        return f"it calls {name}, which another call finds changed"
    return None


def _room(value: Any) -> str:
    module = getattr(value, "__module__", None)
    return str(module or "").split(".")[0].lstrip("_")
