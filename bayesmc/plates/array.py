"""Parents that live in plates their child lacks: ``PlateArray`` and how several are aligned.

A child sees such a parent through named foreign plates. It gathers along them (``mean[label]``),
reduces them (``x.mean("point")``) or maps ufuncs over them, aligned by name; using one as it stands is
an error, because NumPy would silently take a foreign plate for a batch axis. This room holds the array
rules alone; which plates are foreign to whom is the network's business.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from bayesmc.errors import PlateError, StateError
from bayesmc.plates.gathered import Gathered
from bayesmc.shapes import Shape, broadcast_shapes, from_one


class PlateArray(NDArrayOperatorsMixin):
    """A value with foreign plates, shape ``(*batch, *own plates, *foreign plates, *event)``.

    Parameters
    ----------
    array : ndarray
        The values; ``own`` axes have the plate's size or 1.
    plates : tuple of str
        Names of the foreign plates, in axis order.
    own : int
        Number of axes for the child's own plates.
    event_ndim : int
        Number of event axes.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.plates import PlateArray
    >>> mean = PlateArray(np.array([[10.0, 20.0, 30.0]]), ("cluster",), own=1)
    >>> mean[np.array([2, 0, 0, 1])]
    array([30., 10., 10., 20.])
    >>> mean.sum("cluster")
    array([60.])
    """

    __slots__ = ("array", "event_ndim", "own", "plates")

    def __init__(
        self, array: np.ndarray, plates: tuple[str, ...], own: int = 0, event_ndim: int = 0
    ) -> None:
        self.array = array
        self.plates = plates
        self.own = own
        self.event_ndim = event_ndim

    @property
    def dtype(self) -> np.dtype:
        return self.array.dtype

    @property
    def sizes(self) -> dict[str, int]:
        """Size of each foreign plate."""
        return dict(zip(self.plates, self._split()[1], strict=True))

    def __repr__(self) -> str:
        names = ", ".join(f"{name}: {size}" for name, size in self.sizes.items())
        return f"PlateArray({names}; shape {self.array.shape})"

    # ---- gather -----------------------------------------------------------------------------

    def __getitem__(self, key: Any) -> Any:
        keys = key if isinstance(key, tuple) else (key,)
        dots = next((i for i, k in enumerate(keys) if k is Ellipsis), None)
        if dots is None:
            return self._gather(keys)
        component = self._component(keys[dots + 1 :])
        return component._gather(keys[:dots]) if dots else component

    def _component(self, keys: tuple[Any, ...]) -> PlateArray:
        """``v[..., 2]``: part of the event."""
        if len(keys) > self.event_ndim or not all(
            isinstance(k, (int, np.integer, slice)) for k in keys
        ):
            raise IndexError(
                f"v[..., {', '.join(map(str, keys))}] takes components of the event "
                f"({self.event_ndim} axes here) by integers or slices; "
                f"gather along plates {self.plates} with v[i]"
            )
        dropped = sum(not isinstance(k, slice) for k in keys)
        array = self.array[(Ellipsis, *keys)]
        return PlateArray(array, self.plates, self.own, self.event_ndim - dropped)

    def _gather(self, keys: tuple[Any, ...]) -> Any:
        if len(keys) > len(self.plates):
            raise IndexError(
                f"{len(keys)} indices for the foreign plates {self.plates}; "
                "components of a vector are taken with v[..., k]"
            )
        gathered = [k for k, key in enumerate(keys) if not _is_full_slice(key)]
        if not gathered:
            return self
        indices = [_as_index(keys[k], self.plates[k], self._split()[1][k]) for k in gathered]
        extra = _union(tuple(i.plates for i in indices))
        kept = [k for k in range(len(self.plates)) if k not in gathered]
        moved = [k for k in kept if self.plates[k] in extra]
        kept = [k for k in kept if k not in moved]
        table, lead = self._table(gathered, kept, extra)
        rows = self._rows(indices, gathered, extra, lead)
        names = tuple(self.plates[k] for k in kept)
        if not kept and not extra and self.event_ndim and isinstance(table, np.ndarray):
            return Gathered(table, rows)
        values = np.take(table, rows, axis=0)
        if hasattr(table, "states"):  # labels survive, also where NumPy makes a bare scalar
            values = type(table)(values, table.states)
        if not kept and not extra:
            return values
        return PlateArray(values, extra + names, self.own, self.event_ndim)

    def _table(
        self, gathered: list[int], kept: list[int], extra: tuple[str, ...]
    ) -> tuple[np.ndarray, Shape]:
        """Rows to gather from, shape ``(lead * gathered, *kept, *event)``, and the lead's shape.

        A kept plate that an index has too (``extra``) is aligned with it, so it joins the lead.
        """
        lead, sizes, event = self._split()
        start = len(lead)
        mine = [name for k, name in enumerate(self.plates) if k not in gathered]
        joined = [self.plates.index(name) for name in extra if name in mine]
        order = (
            *range(start),
            *(start + k for k in joined),
            *(start + k for k in gathered),
            *(start + k for k in kept),
            *range(start + len(sizes), self.array.ndim),
        )
        ones = tuple(sizes[self.plates.index(n)] if n in mine else 1 for n in extra)
        lead = lead + ones
        rest = tuple(sizes[k] for k in kept) + event
        array = np.transpose(self.array, order) if order != tuple(range(len(order))) else self.array
        return array.reshape((-1, *rest)), lead

    def _rows(
        self, indices: list[PlateArray], gathered: list[int], extra: tuple[str, ...], lead: Shape
    ) -> np.ndarray:
        """Row of the table for every element of the broadcast lead."""
        sizes = self._split()[1]
        rows: Any = 0
        for index, k in zip(indices, gathered, strict=True):
            rows = rows * sizes[k] + _expand(index, extra, 0, 0)
        per_lead = math.prod([sizes[k] for k in gathered])
        count = math.prod(lead)
        if count > 1:
            rows = rows + (np.arange(count) * per_lead).reshape(lead)
        else:
            rows = np.broadcast_to(rows, broadcast_shapes(np.shape(rows), lead))
        return rows

    # ---- reductions -------------------------------------------------------------------------

    def sum(self, *plates: str, **unknown: Any) -> Any:
        """Sum over the named foreign plates (all of them when none is named)."""
        return self._reduce(np.sum, plates, **unknown)

    def mean(self, *plates: str, **unknown: Any) -> Any:
        """Mean over the named foreign plates."""
        return self._reduce(np.mean, plates, **unknown)

    def prod(self, *plates: str) -> Any:
        """Product over the named foreign plates."""
        return self._reduce(np.prod, plates)

    def max(self, *plates: str) -> Any:
        """Largest value over the named foreign plates."""
        return self._reduce(np.max, plates)

    def min(self, *plates: str) -> Any:
        """Smallest value over the named foreign plates."""
        return self._reduce(np.min, plates)

    def any(self, *plates: str) -> Any:
        """Whether any element over the named foreign plates is true."""
        return self._reduce(np.any, plates)

    def all(self, *plates: str) -> Any:
        """Whether all elements over the named foreign plates are true."""
        return self._reduce(np.all, plates)

    def _reduce(self, function: Callable[..., Any], names: tuple[str, ...], **unknown: Any) -> Any:
        if unknown:
            raise TypeError(
                f".{function.__name__}({next(iter(unknown))}=...): foreign plates are reduced by name, "
                f"v.{function.__name__}({self.plates[0]!r})"
            )
        for name in names:
            if name not in self.plates:
                raise PlateError(
                    f".{function.__name__}({name!r}): the foreign plates here are {self.plates}"
                )
        chosen = names or self.plates
        start = len(self._split()[0])
        axes = tuple(start + self.plates.index(name) for name in chosen)
        if hasattr(self.array, "states") and function not in (np.any, np.all):
            raise TypeError(
                f".{function.__name__}() of labels {self.array.states} means nothing; compare them first, as "
                f"in (v == {self.array.states[0]!r}).any({self.plates[0]!r})"
            )
        result = function(_plain(self.array), axis=axes)
        left = tuple(name for name in self.plates if name not in chosen)
        return PlateArray(result, left, self.own, self.event_ndim) if left else result

    # ---- NumPy ------------------------------------------------------------------------------

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__":
            raise TypeError(
                f"np.{ufunc.__name__}.{method} would mix batch and plate axes of {self!r}; "
                f"reduce with .sum({self.plates[0]!r}) or gather first"
            )
        if "out" in kwargs:
            raise ValueError("a parent is read-only; write v = v + 1, not v += 1")
        bad = sorted(set(kwargs) & {"out", "where", "axis", "axes", "keepdims"})
        if bad:
            raise TypeError(
                f"np.{ufunc.__name__} on a parent with foreign plates takes no {bad[0]}="
            )
        if ufunc is np.matmul:
            raise TypeError("use np.vecdot(X, v) or np.matvec(A, v) instead of @ on plates")
        cores, core_out = _core_ndims(ufunc)
        aligned, names, event = align(inputs, cores)
        labels = [x for x in aligned if isinstance(x, str)]
        if labels and not any(hasattr(x, "states") for x in aligned):
            raise StateError(
                f"numbers in plate {self.plates[0]!r} are compared with the label {labels[0]!r}: the node "
                "has no labels; declare it with states="
            )
        try:
            result = ufunc(*aligned, **kwargs)
        except ValueError as error:
            raise PlateError(
                f"np.{ufunc.__name__}: {error}. A plain array is taken as a value of the child, without "
                f"the foreign plates {names}; for a constant along them use v.array, or make the "
                "constant an input or a node in that plate"
            ) from error
        wrap = [PlateArray(r, names, self.own, event + core_out) for r in _as_tuple(result)]
        return wrap[0] if len(wrap) == 1 else tuple(wrap)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.where and len(args) == 3 and not kwargs:
            aligned, names, event = align(args, (0, 0, 0))
            return PlateArray(np.where(*aligned), names, self.own, event)
        if func is np.clip and not set(kwargs) - {"a_min", "a_max", "min", "max"}:
            low, high = (*args[1:], None, None)[:2]
            low = kwargs.get("a_min", kwargs.get("min", low))
            high = kwargs.get("a_max", kwargs.get("max", high))
            value = args[0] if low is None else np.maximum(args[0], low)
            return value if high is None else np.minimum(value, high)
        raise TypeError(
            f"np.{func.__name__} does not know the foreign plates {self.plates}; gather with v[i], "
            f"reduce with .sum({self.plates[0]!r}), or take the plain array v.array"
        )

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise self.ungathered()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise AttributeError(
            f"a parent in foreign plates {self.plates} has no .{name}; gather with v[i], reduce with "
            f".sum({self.plates[0]!r}) and the like, or take the plain array v.array"
        )

    def ungathered(self) -> PlateError:
        """The error for using this value as it stands."""
        plate = self.plates[0]
        return PlateError(
            f"a parent in plate {plate!r}, which the child lacks, is used ungathered; pick elements "
            f"with v[index], reduce with v.sum({plate!r}) or v.mean({plate!r}), or take v.array"
        )

    def __bool__(self) -> bool:
        raise self.ungathered()

    def __float__(self) -> float:
        raise self.ungathered()

    def __int__(self) -> int:
        raise self.ungathered()

    def __index__(self) -> int:
        raise self.ungathered()

    def __len__(self) -> int:
        raise self.ungathered()

    def __iter__(self) -> Any:
        raise self.ungathered()

    def _split(self) -> tuple[Shape, Shape, Shape]:
        """Shapes of (batch and own plates), foreign plates, event."""
        end = self.array.ndim - self.event_ndim
        start = end - len(self.plates)
        shape = self.array.shape
        return shape[:start], shape[start:end], shape[end:]


def stack(arrays: Sequence[Any], axis: int = -1) -> Any:
    """Broadcast the arrays together, then stack them along a new axis (the last by default).

    Parents' batch shapes may differ, so ``np.stack`` alone would refuse them.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> bmc.stack([np.zeros((5, 3)), 1.0]).shape
    (5, 3, 2)
    """
    if any(isinstance(a, PlateArray) for a in arrays):
        if axis != -1:
            raise TypeError("stacking parents with foreign plates makes a vector: axis=-1 only")
        aligned, names, event = align(tuple(arrays), (0,) * len(arrays))
        own = next(a.own for a in arrays if isinstance(a, PlateArray))
        return PlateArray(np.stack(np.broadcast_arrays(*aligned), -1), names, own, event + 1)
    return np.stack(np.broadcast_arrays(*(_array_like(a) for a in arrays)), axis=axis)


def align(operands: Sequence[Any], cores: Sequence[int]) -> tuple[list[Any], tuple[str, ...], int]:
    """Operands reshaped so that NumPy broadcasts foreign plates by name.

    Returns them with the union of their foreign plates and the number of event axes outside the
    operation's core. A plain array is a value of the child: its foreign axes have size one.
    """
    names = _union(tuple(x.plates for x in operands if isinstance(x, PlateArray)))
    event = max(
        (
            x.event_ndim - c
            for x, c in zip(operands, cores, strict=True)
            if isinstance(x, PlateArray)
        ),
        default=0,
    )
    aligned: list[Any] = []
    for x, core in zip(operands, cores, strict=True):
        if isinstance(x, str):
            aligned.append(x)
        elif isinstance(x, PlateArray):
            aligned.append(_expand(x, names, event, core))
        else:
            array = _array_like(x)
            outer = array.ndim - core
            if outer > event:
                split = outer - event
                array = array.reshape(array.shape[:split] + (1,) * len(names) + array.shape[split:])
            aligned.append(array)
    return aligned, names, event


def _expand(x: PlateArray, names: tuple[str, ...], event: int, core: int) -> np.ndarray:
    """``x`` with its foreign axes in the order of ``names`` (size 1 where absent)."""
    lead, sizes, own_event = x._split()
    start = len(lead)
    order = [start + x.plates.index(n) for n in names if n in x.plates]
    tail = range(start + len(sizes), x.array.ndim)
    array = x.array
    axes = (*range(start), *order, *tail)
    if axes != tuple(range(array.ndim)):
        array = array.transpose(axes)
    pad = event - (x.event_ndim - core)
    middle = tuple(sizes[x.plates.index(n)] if n in x.plates else 1 for n in names)
    return array.reshape(lead + middle + (1,) * pad + own_event)


def _as_index(key: Any, plate: str, size: int) -> PlateArray:
    """An index along ``plate`` as a PlateArray of positions, checked against the plate's size."""
    foreign = key if isinstance(key, PlateArray) else None
    if foreign is not None and foreign.event_ndim:
        raise IndexError(
            f"plate {plate!r} is gathered by scalars, not by vectors; take a component with v[..., k]"
        )
    held = foreign.array if foreign is not None else key
    is_known = not hasattr(held, "within")  # what stands for an index is looked at once it is known
    array: Any = np.asarray(held) if is_known else held
    if array.dtype.kind not in "iu":
        way = "; give an input of whole numbers, .astype(int)" if array.dtype.kind == "f" else ""
        raise IndexError(
            f"plate {plate!r} is gathered by integers 0..{size - 1} (a discrete parent, an integer or "
            f"an integer array), not by {array.dtype} values{way}"
        )
    if is_known and array.size:
        low, high = int(array.min()), int(array.max())
        if low < 0 or high >= size:
            raise IndexError(
                f"index {low if low < 0 else high} is outside plate {plate!r}, whose positions are "
                f"0..{size - 1}" + from_one(low, high, size)
            )
    array = array.astype(np.intp, copy=False) if is_known else array.within(size)
    if foreign is None:
        return PlateArray(array, ())
    return PlateArray(array, foreign.plates, foreign.own, foreign.event_ndim)


def _array_like(value: Any) -> Any:
    """An array, or what stands for one (it has a shape of its own) as it is."""
    return value if hasattr(value, "reshape") else np.asanyarray(value)


def _plain(array: Any) -> Any:
    """An array without labels; what stands for an array as it is."""
    return np.asarray(array) if isinstance(array, np.ndarray) else array


def _union(names: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for group in names for name in group))


def _is_full_slice(key: Any) -> bool:
    if not isinstance(key, slice):
        return False
    if key != slice(None):
        raise IndexError("only the full slice : keeps a foreign plate; gather elements by index")
    return True


def _core_ndims(ufunc: Any) -> tuple[tuple[int, ...], int]:
    """Number of core axes of each input, and of the output, of a (generalised) ufunc."""
    if ufunc.signature is None:
        return (0,) * ufunc.nin, 0
    ins, outs = ufunc.signature.split("->")
    counts = tuple(_count(group) for group in ins.split("),("))
    return counts, _count(outs)


def _count(group: str) -> int:
    inner = group.strip("()")
    return len(inner.split(",")) if inner else 0


def _as_tuple(result: Any) -> tuple[Any, ...]:
    return result if isinstance(result, tuple) else (result,)
