"""What a function does to its arguments: it is called with stand-ins, twice, and the results compared."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression.array import TracedArray, TracedCall, is_traced, refusals
from bayesmc.expression.changing import tells_time_or_chance
from bayesmc.expression.graph import Expression, as_expression
from bayesmc.expression.lifting import lifted
from bayesmc.plates import PlateArray


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


def trace(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """What a function returns for stand-ins: an ``Expression``, a ``Family``, or what depends on none.

    Parameters
    ----------
    function : callable
    arguments : sequence
        ``TracedArray``, ``TracedStates``, ``PlateArray`` of these.

    Raises
    ------
    TraceError
        The function does what cannot be followed; the message says what.
    """
    why = tells_time_or_chance(function)
    if why is not None:
        raise TraceError(why)
    try:
        first, again = _called(function, arguments), _called(function, arguments)
    except TraceError:
        if not isinstance(function, types.FunctionType):
            raise
        function = lifted(function)
        first, again = _called(function, arguments), _called(function, arguments)
    if not same(first, again):
        raise TraceError("two calls with the same arguments differ")
    return first


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
        return traced.make(**{k: rebuilt(v, values) for k, v in traced.parameters.items()})
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


# ---- private ------------------------------------------------------------------------------------


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
