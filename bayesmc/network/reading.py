"""Which nodes a query reads: one reading of a function's arguments for all results and engines."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from bayesmc.errors import QueryError, UnknownNodeError


def nodes_read(function: Callable[..., Any]) -> tuple[str, ...]:
    """Nodes that a query reads, in the order of its arguments.

    Arguments with a default are none, as for the functions of nodes.

    Parameters
    ----------
    function : callable
        Of nodes, by the names of its arguments.

    Raises
    ------
    UnknownNodeError
        ``*args`` and ``**kwargs`` name no node.
    QueryError
        The arguments cannot be read, as of some built-in functions.

    Examples
    --------
    >>> nodes_read(lambda x, y, c=0.3: x + y > c)
    ('x', 'y')
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        raise QueryError(
            f"query: the arguments of {function!r} cannot be read; write a function whose arguments are "
            "named like nodes"
        ) from None
    wanted = [p for p in parameters if p.default is p.empty]
    for p in wanted:
        if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL):
            raise UnknownNodeError(f"query: the argument {p} names no node")
    return tuple(p.name for p in wanted)
