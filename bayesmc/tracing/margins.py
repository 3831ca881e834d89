"""Margins of events: the affine value that is positive where a comparison of affine values is true."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.tracing.standin import StandIn, stand_ins


def margin_of(ufunc: Any, inputs: Any) -> Any:
    """The margin of what a ufunc makes of its inputs, or None."""
    rule = _EVENTS.get(ufunc)
    return None if rule is None else rule(*inputs)


def _exceeds(larger: Any, smaller: Any) -> Any:
    """The margin of ``larger > smaller``."""
    if any(not x.is_affine for x in stand_ins([larger, smaller])):
        return None
    margin: Any = np.subtract(larger, smaller)
    return margin if margin.is_affine else None


def _both(first: Any, second: Any, otherwise: float = -np.inf) -> Any:
    """The margin of an event joined with a condition on what is not traced."""
    event, condition = (first, second) if isinstance(first, StandIn) else (second, first)
    if isinstance(condition, StandIn) or np.asarray(condition).dtype != bool:
        return None
    if event.margin is None:
        return None
    kept = condition if otherwise < 0 else ~np.asarray(condition)
    return np.where(kept, event.margin, otherwise)


def _opposite(event: Any) -> Any:
    return None if event.margin is None else -event.margin


#: how comparisons, and conditions on them, make the margin of an event
_EVENTS: dict[Any, Callable[..., Any]] = {
    np.greater: _exceeds,
    np.greater_equal: _exceeds,
    np.less: lambda a, b: _exceeds(b, a),
    np.less_equal: lambda a, b: _exceeds(b, a),
    np.bitwise_and: _both,
    np.logical_and: _both,
    np.bitwise_or: lambda a, b: _both(a, b, np.inf),
    np.logical_or: lambda a, b: _both(a, b, np.inf),
    np.invert: _opposite,
    np.logical_not: _opposite,
}
