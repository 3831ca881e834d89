"""What a user's function receives of its parents, and calling it: the shape rules of the contract, once.

A parent arrives as ``(*batch, *[size if shared else 1 for the child's plates], *event)``; plates the
child lacks stay behind as foreign axes of a ``PlateArray``. Discrete parents are decoded on the way. What the
function returns is checked, and what goes wrong inside names the node. Functions that do not broadcast are
called element by element: slow, and asked for by name.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Categorical, Distribution, as_distribution
from bayesmc.distributions.ordered import moving_order
from bayesmc.distributions.support import Support
from bayesmc.errors import BayesmcError, ModelError, PlateError
from bayesmc.network.labels import Domain
from bayesmc.network.node import Declaration
from bayesmc.objects import are_objects
from bayesmc.plates import Gathered, PlateArray
from bayesmc.shapes import Shape, read_only
from bayesmc.states import StateArray


class Aligner:
    """Turns the stored value of one parent into the argument that one child's function receives.

    Parameters
    ----------
    child : tuple of str
        The child's plates.
    plates : tuple of str
        The parent's plates.
    event_ndim : int
        The parent's event axes.
    domain : Domain or None
        Of a finite discrete parent, whose positions are decoded to user values.
    positions : bool
        Pass the positions themselves (tables want them).
    """

    __slots__ = ("_axes", "_insert", "_plain", "domain", "event_ndim", "foreign", "own", "trailing")

    def __init__(
        self,
        child: Sequence[str],
        plates: Sequence[str],
        event_ndim: int,
        domain: Domain | None,
        positions: bool = False,
    ) -> None:
        shared = [p for p in child if p in plates]
        self.foreign = tuple(p for p in plates if p not in child)
        self.trailing = len(plates) + event_ndim
        self.event_ndim = event_ndim
        self.own = len(child)
        self.domain = None if positions else domain
        order = [plates.index(p) for p in (*shared, *self.foreign)]
        moved = order != list(range(len(order)))
        self._axes = (*order, *range(len(plates), self.trailing)) if moved else None
        self._insert: tuple[Any, ...] | None = None
        if len(shared) < len(child):
            inserted = (slice(None) if p in plates else None for p in child)
            rest = (slice(None),) * (len(self.foreign) + event_ndim)
            self._insert = (Ellipsis, *inserted, *rest)
        self._plain = self._axes is None and self._insert is None

    def batch_shape(self, value: np.ndarray) -> Shape:
        """Shape of the batch axes of a stored value."""
        return value.shape[: value.ndim - self.trailing]

    def __call__(self, value: np.ndarray) -> Any:
        """The read-only argument (a ``PlateArray`` when plates are foreign)."""
        if self.domain is not None:
            value = self.domain.decode(value)
        value = read_only(value) if self._plain else self.place(value)
        if self.foreign:
            return PlateArray(value, self.foreign, self.own, self.event_ndim)
        return value

    def place(self, value: np.ndarray) -> np.ndarray:
        """The value with its axes where the child wants them, read-only and not decoded."""
        if self._plain:
            return value
        if self._axes is not None:
            lead = value.ndim - self.trailing
            value = value.transpose(*range(lead), *(lead + a for a in self._axes))
        if self._insert is not None:
            value = value[self._insert]
        return read_only(value)


class RowAligner(Aligner):
    """Turns the stored value of one variable into the argument of a potential over rows of an index.

    The argument has shape ``(*batch, rows, *event)``: row r holds element ``flat[r]`` of the variable.

    Parameters
    ----------
    plates : tuple of str
        The variable's plates.
    flat : ndarray of int, shape (rows,)
        Positions among the elements of the plates, in C order.
    count : int
        Number of those elements.
    """

    __slots__ = ("_all", "count", "flat")

    def __init__(
        self,
        plates: Sequence[str],
        event_ndim: int,
        domain: Domain | None,
        flat: np.ndarray,
        count: int,
        positions: bool = False,
    ) -> None:
        super().__init__(plates, plates, event_ndim, domain, positions)
        self.own = 1
        self.flat, self.count = flat, count
        self._all = len(flat) == count and bool((flat == np.arange(count)).all())

    def __call__(self, value: np.ndarray) -> Any:
        return self.argument(self.place(value))

    def place(self, value: np.ndarray) -> np.ndarray:
        """The stored values of every row, read-only and not decoded."""
        lead = value.ndim - self.trailing
        event = value.shape[value.ndim - self.event_ndim :]
        elements = value.reshape((*value.shape[:lead], self.count, *event))
        if self._all or self.count == 1:  # one element broadcasts over the rows
            return elements
        return np.take(elements, self.flat, axis=lead)

    def argument(self, stored: np.ndarray) -> np.ndarray:
        """What the function receives for stored values of the rows (of one for all: it broadcasts)."""
        value = stored if self.domain is None else self.domain.decode(stored)
        lead = value.ndim - 1 - self.event_ndim
        shape = (*value.shape[:lead], len(self.flat), *value.shape[lead + 1 :])
        return read_only(value if value.shape == shape else np.broadcast_to(value, shape))


def call(
    declaration: Declaration,
    arguments: Sequence[Any],
    lead: Shape,
    links: Sequence[tuple[str, Aligner]],
    wants_array: bool = False,
) -> Any:
    """Call a node's function; what goes wrong inside names the node.

    Returns a ``Distribution``, or an array for a deterministic node.
    """
    name = declaration.name
    if declaration.probs is not None:
        return _table_rows(declaration, arguments)
    assert declaration.function is not None
    try:
        if declaration.vectorize:
            result: Any = _called_by_element(
                declaration.function, arguments, [link.event_ndim for _, link in links], lead
            )
        else:
            result = declaration.function(*arguments)
        if isinstance(result, Distribution):
            if wants_array:
                raise ModelError("a potential returns a log factor, not a distribution")
            return result
        wrapped = as_distribution(result)
        if wrapped is not None:
            return wrapped
        if result is None:
            raise ModelError("the function returns None; return a distribution or an array")
        if isinstance(result, PlateArray):
            raise result.ungathered()
        array = result if isinstance(result, StateArray) else _as_array(result)
        if array.dtype.kind not in "biuf" and not are_objects(array):
            raise ModelError(
                f"the function returns {type(result).__name__}; return a distribution (of bayesmc, or "
                "a frozen scipy.stats one), or an array of numbers for a deterministic node"
            )
        return array
    except BayesmcError as error:
        raise _renamed(error, f"node {name!r}: {_with_name(str(error), links)}") from error
    except Exception as error:
        own = _own_plate_reduced(declaration, error, links)
        if own is not None:
            raise PlateError(f"node {name!r}: {own}") from error
        raise ModelError(f"node {name!r}: {_explain(error, arguments)}") from error


def to_mix(declaration: Declaration, parents: Sequence[str], plate: str, how: str = "sum") -> str:
    """The lines that mix the elements of a plate, for a node of that plate that does so itself."""
    rest = tuple(p for p in declaration.plates if p != plate)
    plates = f", plates={rest if len(rest) > 1 else rest[0]!r}" if rest else ""
    parent = parents[0] if parents else "x"
    total = f"{parent}_{'total' if how == 'sum' else how}"
    others = ", ".join(dict.fromkeys([*parents, total]))
    return (
        "to mix elements (a mean, a cumulative sum), use an unplated deterministic node that reads the "
        f"whole plate, net.add({total!r}, lambda {parent}: {parent}.{how}({plate!r}){plates}), and read "
        f"that: lambda {others}: ... in {declaration.name!r}"
    )


class Elementwise(Distribution):
    """A batch made of one distribution object per element; every operation loops over them."""

    def __init__(self, parts: Sequence[Distribution], shape: Shape) -> None:
        self.parts = tuple(parts)
        self.batch_shape = shape
        self.event_shape = parts[0].event_shape
        self.is_discrete = parts[0].is_discrete  # type: ignore[misc]
        marks = [p.invalid is not None and bool(np.any(p.invalid)) for p in parts]
        if any(marks):
            self.invalid = np.reshape(marks, shape)
            self.problem = parts[marks.index(True)].problem

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        index = np.broadcast_to(np.arange(len(self.parts)).reshape(self.batch_shape), shape)
        draws = [self.parts[i].sample(rng) for i in index.ravel()]
        return np.reshape(np.stack(draws), shape + self.event_shape)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        lead = x.shape[: x.ndim - len(self.event_shape)]
        shape = np.broadcast_shapes(lead, self.batch_shape)
        index = np.broadcast_to(np.arange(len(self.parts)).reshape(self.batch_shape), shape)
        values = np.broadcast_to(x, shape + self.event_shape).reshape((-1, *self.event_shape))
        result = [self.parts[i].log_prob(v) for i, v in zip(index.ravel(), values, strict=True)]
        return np.reshape(np.array(result, dtype=float), shape)

    @property
    def mean(self) -> np.ndarray:
        return self._each("mean")

    @property
    def var(self) -> np.ndarray:
        return self._each("var")

    @property
    def support(self) -> Support:
        first = self.parts[0].support
        if first.kind == "increasing" and any(p.support != first for p in self.parts):
            raise moving_order()
        # bounds stay one per element, even if all are equal here: elsewhere they need not be
        if not self.batch_shape or first.kind not in ("interval", "integers"):
            return first
        low = np.array([np.asarray(p.support.low).flat[0] for p in self.parts])
        high = np.array([np.asarray(p.support.high).flat[0] for p in self.parts])
        low, high = low.reshape(self.batch_shape), high.reshape(self.batch_shape)
        return Support(first.kind, low, high, first.open_low, first.open_high)

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        """Three numbers per element that tell its family and parameters: families may be mixed."""
        rows = []
        for part in self.parts:
            family = float(zlib.crc32(type(part).__name__.encode()))
            values = np.concatenate([[0.0], *(np.ravel(a) for a, _ in part.parameters())])
            rows.append([family, values.sum(), values @ np.sin(np.arange(values.size))])
        return [(np.reshape(rows, (*self.batch_shape, 3)), 1)]

    def _each(self, what: str) -> np.ndarray:
        values = np.stack([getattr(p, what) for p in self.parts])
        return values.reshape(self.batch_shape + self.event_shape)


# ---- private ------------------------------------------------------------------------------------


def _as_array(result: Any) -> np.ndarray:
    """What a function returned as an array; nested things of several lengths are one of objects."""
    try:
        return np.asarray(result)
    except ValueError:
        return np.empty(0, dtype=object)


def _table_rows(declaration: Declaration, arguments: Sequence[Any]) -> Distribution:
    """The rows of a conditional probability table that the parents' positions pick."""
    probs = declaration.probs
    assert probs is not None
    if not arguments:
        return Categorical(probs)
    rows: Any = 0
    for card, positions in zip(probs.shape[:-1], arguments, strict=True):
        rows = rows * card + positions.astype(np.intp)
    return Categorical(Gathered(probs.reshape(-1, probs.shape[-1]), rows))


def _called_by_element(
    function: Callable[..., Any], arguments: Sequence[Any], event_ndims: Sequence[int], lead: Shape
) -> Any:
    """``function`` called once per element of the batch and plates ``lead``, results put together.

    Events stay whole: a vector parent reaches the function as a vector.
    """
    results = []
    for index in np.ndindex(lead):
        picked = [_pick(a, n, index) for a, n in zip(arguments, event_ndims, strict=True)]
        results.append(function(*picked))
    parts = [as_distribution(r) for r in results]
    if any(p is None for p in parts) and not all(p is None for p in parts):
        raise TypeError("it returns a distribution for some elements and a number for others")
    if results and parts[0] is not None:
        return Elementwise([p for p in parts if p is not None], lead)
    values = [np.asarray(r) for r in results]
    event = values[0].shape if values else ()
    return np.reshape(np.stack(values) if values else np.zeros(lead), lead + event)


def _pick(argument: Any, event_ndim: int, index: Shape) -> Any:
    """The element of one argument; its lead is right-aligned with the index and may have size 1."""
    if isinstance(argument, PlateArray):
        lead = argument.array.ndim - len(argument.plates) - argument.event_ndim
        part = argument.array[_own(index, argument.array.shape[:lead])]
        return PlateArray(part, argument.plates, 0, argument.event_ndim)
    array = np.asanyarray(argument)
    lead = array.ndim - event_ndim
    return array[(*_own(index, array.shape[:lead]), Ellipsis)]


def _own(index: Shape, shape: Shape) -> Shape:
    tail = index[len(index) - len(shape) :]
    return tuple(i if n > 1 else 0 for i, n in zip(tail, shape, strict=True))


def _own_plate_reduced(
    declaration: Declaration, error: Exception, links: Sequence[tuple[str, Aligner]]
) -> str | None:
    """What to write instead of ``x.sum("plate")`` on a plate of the node's own, if that is what failed."""
    named = isinstance(error, TypeError) and "'str' object cannot be interpreted" in str(error)
    shared = [
        name
        for name, link in links
        if isinstance(link, Aligner) and link.trailing - link.event_ndim > len(link.foreign)
    ]
    if not (named and shared):
        return None
    plate = declaration.plates[0]
    code = getattr(declaration.function, "__code__", None)
    read = code.co_names if code is not None else ()
    how = next((m for m in read if m in ("sum", "mean", "max", "min", "std", "var", "prod")), "sum")
    parents = list(dict.fromkeys([*shared, *(n for n, _ in links)]))
    return (
        f"{shared[0]!r} arrives as a plain array, element by element, since {plate!r} is a plate of the "
        f"node itself, so .{how}({plate!r}) has nothing to reduce; "
        + to_mix(declaration, parents, plate, how)
    )


def _with_name(message: str, links: Sequence[tuple[str, Aligner]]) -> str:
    """A message about ``v`` as one about the only parent that it can be."""
    foreign = list(dict.fromkeys(n for n, link in links if link.foreign))
    if len(foreign) != 1:
        return message
    return re.sub(r"\bv(?=\[index\]|\[i\]|\.sum\(|\.mean\(|\.array\b)", foreign[0], message)


def _renamed(error: BayesmcError, message: str) -> BayesmcError:
    """The same kind of error, carrying the same facts, with another message."""
    copy = type(error).__new__(type(error))
    copy.__dict__.update(error.__dict__)
    copy.args = (message,)
    return copy


def _explain(error: Exception, arguments: Sequence[Any]) -> str:
    hint = ""
    if "matmul" in str(error):
        hint = "; in a plate use np.matvec(A, v) or np.vecdot(x, v) instead of @"
    if isinstance(error, ValueError) and "read-only" in str(error):
        return "the function changes a parent in place; parents are read-only, so make a new array"
    shapes = ", ".join(
        str(a.array.shape if isinstance(a, PlateArray) else np.shape(a)) for a in arguments
    )
    return f"{type(error).__name__}: {error} (arguments of shapes {shapes or 'none'}){hint}"
