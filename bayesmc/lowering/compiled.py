"""Expressions as functions of machine code, which give what ``Program`` does."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Leaf, Program, ordered
from bayesmc.lowering.code import REAL, TRUTH, WHOLE
from bayesmc.lowering.kernel import Kernel
from bayesmc.lowering.machine import Loaded, is_available, loaded
from bayesmc.lowering.ufuncs import kind_of
from bayesmc.shapes import Shape

_DTYPES = {REAL: np.dtype(float), WHOLE: np.dtype(np.int64), TRUTH: np.dtype(bool)}
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
        names = frozenset(n.name for n in self.leaves)
        Kernel(self.roots, names)  # refuses what has no machine code
        self._names = names

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        batches = {}
        for node in self.leaves:
            shape = np.shape(values[node.name])
            batches[node.name] = shape[: len(shape) - len(node.shape)]
        batch = np.broadcast_shapes(*batches.values()) if batches else ()
        entries = math.prod(batch)
        if not entries:
            return self.program(values)
        way = self.way(frozenset(n for n, b in batches.items() if math.prod(b) > 1))
        given = []
        for node in way.kernel.leaves:
            value, own = values[node.name], batches[node.name]
            if node.name in way.kernel.varying and own != batch:
                value = np.broadcast_to(np.reshape(value, own + node.shape), batch + node.shape)
            given.append(np.ascontiguousarray(value, _DTYPES[kind_of(node)]))
        found = [
            np.empty((batch if r.leaves & way.kernel.varying else ()) + r.shape, r.dtype)
            for r in self.roots
        ]
        if way.run(entries, given, found):
            return self.program(values)
        return [
            _of_own(f, batch, np.broadcast_shapes(*(batches[n] for n in r.leaves)), r.shape)
            for f, r in zip(found, self.roots, strict=True)
        ]

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
    """

    def __init__(self, roots: Sequence[Expression], varying: frozenset[str]) -> None:
        self.kernel = Kernel(roots, varying)
        self.loaded: Loaded = loaded(self.kernel.text, self.kernel.foreign)
        self._constants = list(self.kernel.constants.values())
        self._sizes = [n.size for n in self.kernel.kept]
        self._fixed = [_address(c) for c in self._constants]
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
        table = np.array(
            [*map(_address, given), *self._fixed, *self._memory(), *map(_address, found)], np.uintp
        )
        return self.loaded.call(entries, _address(table))

    def _memory(self) -> list[int]:
        """Addresses of what is kept of one entry, each thread's own."""
        own = self._own
        if not hasattr(own, "addresses"):
            own.arrays = [np.empty(size, np.float64) for size in self._sizes]
            own.addresses = [_address(a) for a in own.arrays]
        return own.addresses


# ---- private ------------------------------------------------------------------------------------


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def _of_own(found: np.ndarray, batch: Shape, own: Shape, shape: Shape) -> np.ndarray:
    """A result with the batch of the leaves that it depends on."""
    have = found.shape[: found.ndim - len(shape)]
    if have == own:
        return found
    if math.prod(own) == 1 and not have:
        return found.reshape(own + shape)
    lead = len(have) - len(own)
    at = (0,) * lead + tuple(slice(0, 1) if n == 1 else slice(None) for n in own)
    return found[at]
