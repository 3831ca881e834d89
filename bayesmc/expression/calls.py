"""Methods that the graph holds as one call, whatever they do inside."""

from __future__ import annotations

import functools
import types
from collections.abc import Callable
from typing import Any

from bayesmc.expression.array import TracedArray
from bayesmc.expression.functions import repeated


def as_one_call(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of a frozen object that broadcasts over leading axes, to be called again as it stands.

    Of stand-ins it makes one ``Call``, which has no derivative unless its result is of whole numbers;
    of arrays it is the method.

    Examples
    --------
    >>> from bayesmc.expression import TracedArray, as_one_call, leaf
    >>> class Steps:
    ...     @as_one_call
    ...     def of(self, x):
    ...         return (x > 0).astype(int) if x.any() else 0 * x.astype(int)
    >>> Steps().of(TracedArray(leaf("x", (3,)))).expression
    <Call of (3,)>
    """

    @functools.wraps(method)
    def called(self: Any, *args: Any) -> Any:
        if any(isinstance(a, TracedArray) for a in args):
            # two bound methods are equal where they are of one object
            return TracedArray(repeated(types.MethodType(method, self), args, {}))
        return method(self, *args)

    return called
