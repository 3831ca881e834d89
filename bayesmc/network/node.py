"""Declarations: what a user wrote about one node, and what can be told of it before anything is evaluated."""

from __future__ import annotations

import graphlib
import inspect
from collections.abc import Callable, Hashable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from types import FunctionType
from typing import Any

import numpy as np

from bayesmc.distributions import MvNormal, Normal
from bayesmc.errors import CycleError, ModelError, ParameterError, QueryError, UnknownNodeError
from bayesmc.network.captured import Captured
from bayesmc.network.labels import Domain
from bayesmc.shapes import Shape, first_index

#: what a function without noise is known by
_MARK = "bayesmc_computes"
#: the same of a node that is drawn at first and computed from then on
_LAG = "bayesmc_lags"


@dataclass(frozen=True)
class Node:
    """One node of a net, as ``net[name]`` shows it.

    Attributes
    ----------
    name : str
    parents : tuple of str
        Names of the parents, in the order of the function's arguments.
    plates : tuple of str
    event_shape : tuple of int
        Shape of one value; ``()`` for a scalar.
    states : tuple or None
        Values of a finite discrete node in the order of its support; None for others.
    is_discrete : bool
    kind : str
        ``"stochastic"``, ``"deterministic"``, ``"input"`` or ``"fixed"`` (by ``do``).
    """

    name: str
    parents: tuple[str, ...]
    plates: tuple[str, ...]
    event_shape: Shape
    states: tuple[Any, ...] | None
    is_discrete: bool
    kind: str = "stochastic"


@dataclass(frozen=True, eq=False)
class Numbered:
    """A function with a number in the place of some arguments: that of a template, in one slice.

    Attributes
    ----------
    func : callable
    places : tuple of int
        Where the number stands among the arguments, in ascending order.
    number : int
    """

    func: Callable[..., Any]
    places: tuple[int, ...]
    number: int

    def filled(self, values: Sequence[Any], number: Any) -> list[Any]:
        """All arguments, from the others."""
        arguments = list(values)
        for place in self.places:
            arguments.insert(place, number)
        return arguments

    def __call__(self, *values: Any) -> Any:
        return self.func(*self.filled(values, self.number))


@dataclass(frozen=True, eq=False)
class Declaration:
    """What was declared under one name.

    ``source`` is "function", "table", "input", "fixed", or "variable" (of a factor graph: its function
    returns a flat density, log 1 on all of its support); ``function`` takes the parents in order. ``domain``
    is that of a fixed node; of a computed one the values that it shall have (of size 0: none are counted);
    ``captured`` what the function reads from around it, as it stood when it was declared.
    """

    name: str
    source: str
    parents: tuple[str, ...] = ()
    plates: tuple[str, ...] = ()
    states: tuple[Any, ...] | None = None
    function: Callable[..., Any] | None = None
    vectorize: bool = False
    probs: np.ndarray | None = None
    event_shape: Shape = ()
    value: np.ndarray | None = None
    domain: Domain | None = None
    captured: tuple[Captured, ...] = ()


@dataclass(frozen=True, eq=False)
class Potential:
    """An extra log factor on named nodes, or one factor per row of an index.

    Attributes
    ----------
    parents : tuple of str
        The scope, in the order of the function's arguments; with an index a name may stand twice.
    function : callable
        Returns log factors; with a table it looks positions up.
    plates : tuple of str
        One factor per element of these; none with an index.
    index : tuple of ndarray of int, optional
        For each entry of the scope the element that each row takes, shape (rows,): a position among
        the elements of the variable's plates in C order (all zeros for a variable without plates).
    is_table : bool
        The function takes positions of finite nodes instead of their values.
    captured : tuple of Captured
        What the function reads from around it, as it stood when it was declared.
    """

    name: str
    parents: tuple[str, ...]
    function: Callable[..., Any]
    plates: tuple[str, ...] = field(default=())
    index: tuple[np.ndarray, ...] | None = None
    is_table: bool = False
    captured: tuple[Captured, ...] = ()

    @property
    def scope(self) -> tuple[str, ...]:
        """Names of the nodes, in the order of the function's arguments."""
        return self.parents

    @property
    def rows(self) -> int | None:
        """Number of rows of the index; None without one."""
        return None if self.index is None else len(self.index[0])


def bind(
    name: str,
    function: Callable[..., Any],
    parents: Sequence[str] | Mapping[str, str] | None,
) -> tuple[tuple[str, ...], Callable[..., Any]]:
    """Parents of ``function`` in call order, and the function taking them positionally."""
    if isinstance(parents, str):
        raise ModelError(f"node {name!r}: parents={parents!r} is one string; give a list of names")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        if parents is None or isinstance(parents, Mapping):
            raise ModelError(
                f"node {name!r}: the arguments of {function!r} cannot be read; list parents="
            ) from None
        return tuple(parents), function
    positional, keyword, starred = _arguments(name, signature)
    if isinstance(parents, Mapping):
        unknown = set(parents) - set(positional) - set(keyword) - _defaults(signature)
        if unknown:
            raise ModelError(
                f"node {name!r}: parents= maps {sorted(unknown)}, which the function has no "
                f"argument for; its arguments are {positional + keyword}"
            )
        extra = [a for a in parents if a not in positional and a not in keyword]
        names = tuple(parents.get(a, a) for a in positional + keyword) + tuple(
            parents[a] for a in extra
        )
        return names, _with_keywords(function, len(positional), keyword + extra)
    if parents is not None:
        names = tuple(parents)
        _check_count(name, names, signature, positional, keyword, starred)
        return names, _with_keywords(function, len(names) - len(keyword), keyword)
    if starred:
        raise ModelError(f"node {name!r}: *{starred} needs parents= to say which nodes they are")
    return tuple(positional + keyword), _with_keywords(function, len(positional), keyword)


def decorating(
    function: Callable[..., Any] | None,
    name: str | None,
    add: Callable[..., None],
    rest: tuple[Any, ...],
    options: Mapping[str, Any],
    verb: str = "node",
) -> Any:
    """A decorator that declares a function by ``add``, or what that returns for one that is given."""
    if function is not None and not callable(function):
        raise ModelError(
            f"net.{verb}({function!r}): it decorates a function; give the node's name with name="
        )

    def declare(f: Callable[..., Any]) -> Callable[..., Any]:
        own = name if name is not None else getattr(f, "__name__", "<lambda>")
        if own == "<lambda>":
            raise ModelError(
                f"this function has no name to give the {verb} (a lambda or partial); "
                + ("use name= or net.add" if verb == "node" else "give the name before it")
            )
        add(own, f, *rest, **options)
        return f

    return declare if function is None else declare(function)


def checked_rows(name: str, table: np.ndarray) -> np.ndarray:
    """Rows renormalised where they are off by rounding; worse ones raise with their index."""
    from_one = np.abs(table.sum(axis=-1) - 1)
    bad = ~((table >= 0).all(axis=-1) & (from_one <= 1e-6))
    if bad.any():
        at = first_index(bad)
        raise ParameterError(
            f"node {name!r}: the row at parents' index {at} is {table[at]}, which is not a probability "
            f"vector (sum {table[at].sum():.6g}); every row of a table sums to 1",
            at,
        )
    table = table / table.sum(axis=-1, keepdims=True)
    table.flags.writeable = False
    return table


def plain_states(states: Sequence[Any]) -> tuple[Any, ...]:
    """States as plain Python values, so that labels compare and print as they were typed."""
    if isinstance(states, (str, Set)) or not isinstance(states, (Sequence, np.ndarray)):
        raise ModelError(f"states={states!r}: give a list or tuple, in the order of the support")
    return tuple(s.item() if isinstance(s, np.generic) else s for s in states)


def identity(function: Any) -> Hashable:
    """Equal for one function: one object, or one code with the same things around it."""
    if isinstance(function, Numbered):
        return identity(function.func), function.places, function.number
    if type(function) is not FunctionType:
        return id(function)
    keywords = function.__kwdefaults__ or {}
    around = [*(function.__defaults__ or ()), *keywords, *keywords.values()]
    for cell in function.__closure__ or ():
        try:
            around.append(cell.cell_contents)
        except ValueError:  # not yet filled
            return id(function)
    inside = tuple(repr(v) if type(v) in (int, float, bool, str) else id(v) for v in around)
    return function.__code__, id(function.__globals__), inside


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


def topological_order(parents: Mapping[str, Sequence[str]]) -> list[str]:
    """Names with every parent before its children, otherwise as declared (Kahn 1962)."""
    waiting = {name: len(set(above)) for name, above in parents.items()}
    children: dict[str, list[str]] = {name: [] for name in parents}
    for name, above in parents.items():
        for parent in set(above):
            children[parent].append(name)
    order = [name for name, count in waiting.items() if count == 0]
    for name in order:  # which grows
        for child in children[name]:
            waiting[child] -= 1
            if waiting[child] == 0:
                order.append(child)
    if len(order) == len(parents):
        return order
    try:
        graphlib.TopologicalSorter(parents).prepare()
        raise AssertionError
    except graphlib.CycleError as error:
        cycle = error.args[1][1:]  # parent before child
    start = cycle.index(min(cycle))
    path = [*cycle[start:], *cycle[: start + 1]]
    raise CycleError(
        f"the parents form a cycle: {' -> '.join(path)}; a net must be acyclic "
        "(for time, use a dynamic net with _prev arguments)",
        path,
    )


def observed_links(nodes: Any, evidence: Mapping[str, Any]) -> dict[str, int]:
    """Observed nodes that are computed, and numbers or vectors of them: name -> event axes.

    Parameters
    ----------
    nodes : mapping
        Name -> something with ``kind``, ``is_discrete`` and ``event_shape``.
    evidence : dict
    """
    found = {}
    for name in (n for n, value in evidence.items() if n in nodes and value is not None):
        node = nodes[name]
        if node.kind == "deterministic" and not node.is_discrete and len(node.event_shape) < 2:
            found[name] = len(node.event_shape)
    return found


def without_noise(declaration: Declaration, rank: int) -> Declaration:
    """The node as one without noise about what its function returns, a value with ``rank`` event axes."""
    function = declaration.function
    assert function is not None

    def link(*values: Any) -> Any:
        value = function(*values)
        if not rank:
            return Normal(value, 0.0)
        size = np.shape(value)[-1]
        return MvNormal(value, np.zeros((size, size)))

    link.__dict__[_MARK] = True
    return replace(declaration, function=link)


def is_link(declaration: Declaration) -> bool:
    """Whether a node was computed before ``without_noise``."""
    return _MARK in getattr(declaration.function, "__dict__", {})


def as_lag(function: Callable[..., Any]) -> Callable[..., Any]:
    """Mark the function of a node that is drawn in slice 0, and computed from then on."""
    function.__dict__[_LAG] = True
    return function


def way_out_of_lag(declaration: Declaration) -> str | None:
    """How a node that is drawn in slice 0 and computed later is declared as one that is computed in all."""
    if _LAG not in getattr(declaration.function, "__dict__", {}):
        return None
    name = declaration.name.partition("[")[0]
    return (
        f"{name!r} is drawn in slice 0 and computed later; give what stood before slice 0 a node of its own, "
        f"dbn.add('{name}_before', <the density>), and compute {name!r} in all slices, "
        f"initial=lambda {name}_before: {name}_before"
    )


# ---- private ------------------------------------------------------------------------------------


def _arguments(name: str, signature: inspect.Signature) -> tuple[list[str], list[str], str]:
    """Names of positional and of keyword-only arguments without default, and of ``*args``."""
    positional: list[str] = []
    keyword: list[str] = []
    starred = ""
    for argument in signature.parameters.values():
        if argument.kind is argument.VAR_KEYWORD:
            raise ModelError(
                f"node {name!r}: **{argument.name} is refused, since argument names are the parents; "
                "name the parents, or list them with parents="
            )
        if argument.kind is argument.VAR_POSITIONAL:
            starred = argument.name
        elif argument.default is argument.empty:
            (keyword if argument.kind is argument.KEYWORD_ONLY else positional).append(
                argument.name
            )
    return positional, keyword, starred


def _defaults(signature: inspect.Signature) -> set[str]:
    return {a.name for a in signature.parameters.values() if a.default is not a.empty}


def _check_count(
    name: str,
    names: tuple[str, ...],
    signature: inspect.Signature,
    positional: list[str],
    keyword: list[str],
    starred: str,
) -> None:
    needed = len(positional) + len(keyword)
    room = needed + len(_defaults(signature))
    if len(names) < needed or (len(names) > room and not starred):
        raise ModelError(
            f"node {name!r}: parents= lists {len(names)} names, but the function takes "
            f"{needed} arguments ({', '.join(positional + keyword)})"
        )


def _with_keywords(
    function: Callable[..., Any], positional: int, keyword: list[str]
) -> Callable[..., Any]:
    """``function`` with its keyword-only arguments taken by position, after the others."""
    if not keyword:
        return function

    def call(*values: Any) -> Any:
        return function(
            *values[:positional], **dict(zip(keyword, values[positional:], strict=True))
        )

    return call
