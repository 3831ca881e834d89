"""Margins of events: the number that exceeds zero where a comparison of numbers is true."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Elementwise, Expression, Pick, elementwise


def margin(event: Expression) -> Expression:
    """What exceeds zero where an event is true: one comparison, and conditions on what is known.

    Raises
    ------
    TraceError
        The event compares more than once, or otherwise.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.events import margin
    >>> x = leaf("x", (3,))
    >>> event = trace(lambda x: (x < 1.0) & np.array([True, True, False]), [TracedArray(x)])
    >>> evaluate([margin(event)], {"x": np.array([0.5, 2.0, 0.5])})
    [array([ 0.5, -1. , -inf])]
    """
    if not event.leaves and event.dtype.kind == "b":
        return elementwise(np.where, event, np.inf, -np.inf)
    if isinstance(event, Pick):
        return event.with_operands([margin(a) for a in event.operands])
    if isinstance(event, Elementwise):
        function, inner = event.function, event.operands
        if function in (np.greater, np.greater_equal):
            return elementwise(np.subtract, *inner)
        if function in (np.less, np.less_equal):
            return elementwise(np.subtract, *inner[::-1])
        if function is np.logical_not or function is np.invert:
            return elementwise(np.negative, margin(*inner))
        if function in _JOINED and sum(bool(a.leaves) for a in inner) == 1:
            other, known = sorted(inner, key=lambda a: not a.leaves)
            otherwise = _JOINED[function]
            kept = known if otherwise < 0 else elementwise(np.logical_not, known)
            return elementwise(np.where, kept, margin(other), otherwise)
    raise TraceError(f"{event.detail or type(event).__name__} is no comparison")


#: how events are joined with a condition on what is known: the margin where the condition decides
_JOINED: dict[Any, float] = {
    np.logical_and: -np.inf,
    np.bitwise_and: -np.inf,
    np.logical_or: np.inf,
    np.bitwise_or: np.inf,
}
