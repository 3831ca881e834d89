"""Expressions as functions of machine code, which give what ``Program`` does."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Leaf, Program, ordered
from bayesmc.lowering.kernel import Kernel
from bayesmc.lowering.machine import Loaded, is_available, loaded
from bayesmc.lowering.ufuncs import kind_of
from bayesmc.lowering.writer import DTYPES
from bayesmc.shapes import Shape

#: sets of shapes that are remembered
_SHAPES = 512
#: ways in which leaves may have a batch or not that are compiled
_WAYS = 4


def compiled(roots: Sequence[Expression]) -> Compiled:
    """Expressions as machine code.

    Parameters
    ----------
    roots : sequence of Expression

    Raises
    ------
    TraceError
        There is no compiler, or something has no machine code: which, and why.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import Program, elementwise, leaf
    >>> from bayesmc.lowering import compiled, is_available
    >>> roots = [elementwise(np.multiply, leaf("x", (2,)), [1.0, 10.0])]
    >>> run = compiled(roots) if is_available() else Program(roots)
    >>> run({"x": np.array([[1.0, 2.0], [3.0, 4.0]])})
    [array([[ 1., 20.],
           [ 3., 40.]])]
    """
    if not is_available():
        raise TraceError("machine code needs llvmlite: pip install bayesmc[fast]")
    return Compiled(roots)


class Compiled:
    """Expressions of machine code: called as ``Program`` is.

    What the machine code cannot do (an angle too large, an index that is an error) is done by NumPy.

    Parameters
    ----------
    roots : sequence of Expression
    """

    def __init__(self, roots: Sequence[Expression]) -> None:
        self.roots = tuple(roots)
        self.leaves = [n for n in ordered(*roots) if isinstance(n, Leaf)]
        self.program = Program(roots)
        self._ways: dict[frozenset[str], Way] = {}
        self._shapes: dict[tuple[Shape, ...], _Shapes] = {}
        self._dtypes = [DTYPES[kind_of(n)] for n in self.leaves]
        names = frozenset(n.name for n in self.leaves)
        Kernel(self.roots, names)  # refuses what has no machine code
        self._names = names

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        given = [values[node.name] for node in self.leaves]
        key = tuple([np.shape(v) for v in given])
        shapes = self._shapes.get(key)
        if shapes is None:
            if len(self._shapes) >= _SHAPES:
                self._shapes.clear()
            shapes = self._shapes[key] = self._shaped(key)
        if not shapes.entries:
            return self.program(values)
        for k, (own, whole) in shapes.widened:
            given[k] = np.broadcast_to(np.reshape(given[k], own), whole)
        arrays = [
            v
            if type(v) is np.ndarray and v.dtype is d and v.flags.c_contiguous
            else np.ascontiguousarray(v, d)
            for v, d in zip(given, self._dtypes, strict=True)
        ]
        found = [np.empty(shape, dtype) for shape, dtype in shapes.results]
        if shapes.way.run(shapes.entries, arrays, found):
            return self.program(values)
        if shapes.of_own:
            for k, (at, shape) in shapes.of_own:
                found[k] = found[k][at].reshape(shape)
        return found

    def bound(self, values: Mapping[str, np.ndarray]) -> Bound:
        """The function of the one leaf that has no value here, for callers in C.

        Parameters
        ----------
        values : mapping
            The other leaves, without a batch.

        Raises
        ------
        TraceError
            More than one leaf has no value, or none.
        """
        free = [n for n in self.leaves if n.name not in values]
        if len(free) != 1:
            raise TraceError(f"{len(free)} leaves have no values, not one")
        way = self.way(frozenset([free[0].name]))
        given = [
            np.zeros(n.shape, d)
            if n is free[0]
            else np.array(np.broadcast_to(values[n.name], n.shape), d, order="C")
            for n, d in zip(self.leaves, self._dtypes, strict=True)
        ]
        return Bound(way, given, len(self.roots))

    def _shaped(self, key: Sequence[Shape]) -> _Shapes:
        """What is to be done with values of these shapes."""
        batches = {
            n.name: s[: len(s) - len(n.shape)] for n, s in zip(self.leaves, key, strict=True)
        }
        batch = np.broadcast_shapes(*batches.values()) if batches else ()
        entries = math.prod(batch)
        many = frozenset(n for n, b in batches.items() if math.prod(b) > 1)
        way = self.way(many or self._names)
        varying = way.kernel.varying
        widened = [
            (k, (batches[n.name] + n.shape, batch + n.shape))
            for k, n in enumerate(self.leaves)
            if n.name in varying and batches[n.name] != batch
        ]
        results, of_own = [], []
        for k, root in enumerate(self.roots):
            have = batch if root.leaves & varying else ()
            own = np.broadcast_shapes(*(batches[n] for n in root.leaves))
            results.append((have + root.shape, root.dtype))
            if have != own:
                lead = max(len(have) - len(own), 0)
                at = (0,) * lead + tuple(
                    slice(0, 1) if n == 1 else slice(None) for n in own[: len(have) - lead]
                )
                of_own.append((k, (at, own + root.shape)))
        return _Shapes(entries, way, widened, results, of_own)

    def way(self, varying: frozenset[str]) -> Way:
        """The function where these leaves have values for each entry, and the others have one for all."""
        found = self._ways.get(varying)
        if found is None:
            if len(self._ways) >= _WAYS:
                varying = self._names
            found = self._ways.get(varying) or Way(self.roots, varying)
            self._ways[varying] = found
        return found


class Way:
    """One function of machine code, and the memory that it needs.

    Parameters
    ----------
    roots : sequence of Expression
    varying : frozenset of str
        Leaves that have values of their own for each entry.
    kernel : Kernel, optional
        Of these, where it is written already.
    """

    def __init__(
        self,
        roots: Sequence[Expression],
        varying: frozenset[str],
        kernel: Kernel | None = None,
    ) -> None:
        self.kernel = kernel or Kernel(roots, varying)
        self.loaded: Loaded = loaded(self.kernel.text, self.kernel.foreign)
        self._constants = list(self.kernel.constants.values())
        self._own = threading.local()

    def run(self, entries: int, given: Sequence[np.ndarray], found: Sequence[np.ndarray]) -> int:
        """Fill arrays with results: 0, or the bits of what could not be done.

        Parameters
        ----------
        entries : int
        given : sequence of ndarray
            Values of the leaves, in the kernel's order and types, in C order.
        found : sequence of ndarray
        """
        own = self._own
        if not hasattr(own, "table"):
            own.table, own.kept = self.table(len(found))
            own.address = address_of(own.table)
        table = own.table
        for k, array in enumerate(given):
            table[k] = address_of(array)
        last = len(table) - len(found)
        for k, array in enumerate(found):
            table[last + k] = address_of(array)
        return self.loaded.call(entries, own.address)

    def table(self, results: int) -> tuple[np.ndarray, list[np.ndarray]]:
        """Addresses of all arguments, those of leaves and results still open, and the memory behind some."""
        kept = [np.empty(n.size) for n in self.kernel.kept]
        fixed = [address_of(a) for a in (*self._constants, *kept)]
        leaves, last = len(self.kernel.leaves), results + bool(self.kernel.chosen)
        return np.array([*[0] * leaves, *fixed, *[0] * last], np.uintp), kept


class Bound:
    """A function of one array in C, and what it reads besides.

    Not for two threads at once: each binds its own.

    Attributes
    ----------
    address : int
        Of ``int32_t f(int64_t entries, const double *x, double *result0, ..., void **arguments)``. It reads
        ``entries`` arrays one after the other and writes as many of each result. It returns 0; anything else
        means that the results must not be used (an index outside of a table, an angle above 10^6).
    arguments : int
        The address that it is given as its last argument, valid as long as this object lives.
    """

    def __init__(self, way: Way, given: Sequence[np.ndarray], results: int) -> None:
        self._way, self._given = way, given
        self._table, self._kept = way.table(results)
        for k, array in enumerate(given):
            self._table[k] = address_of(array)
        self.address: int = way.loaded.direct
        self.arguments: int = address_of(self._table)


# ---- private ------------------------------------------------------------------------------------


class _Shapes(NamedTuple):
    """Calls with values of certain shapes.

    Attributes
    ----------
    entries : int
    way : Way
    widened : list
        Leaves that must be broadcast: place, its own shape and that of the whole batch.
    results : list
        Shapes and types.
    of_own : list
        Results that depend on less than the whole batch: place, index and shape.
    """

    entries: int
    way: Way
    widened: list[tuple[int, tuple[Shape, Shape]]]
    results: list[tuple[Shape, np.dtype]]
    of_own: list[tuple[int, tuple[tuple[Any, ...], Shape]]]


def address_of(array: np.ndarray) -> int:
    """Where an array lies; much faster than ``array.ctypes``."""
    if array.flags.writeable:  # several times faster
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]
    return array.__array_interface__["data"][0]
