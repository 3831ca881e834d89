"""Slice sampling of one density as machine code: what ``slice_moves`` is given, on one thread or several."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Expression
from bayesmc.lowering.compiled import Way, address_of
from bayesmc.lowering.machine import is_available
from bayesmc.lowering.no_u_turn import FALLBACK
from bayesmc.lowering.slice_moves import LINES, TOLD, numbers_of, slice_moves
from bayesmc.lowering.trajectory import shared
from bayesmc.lowering.ufuncs import kind_of
from bayesmc.lowering.writer import DTYPES

#: ``ask(chain, value)``: log densities at a chain's value of the leaf, in the root's shape
Ask = Callable[[int, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Turns:
    """Which numbers move, and when: those of one turn at once.

    Attributes
    ----------
    places : sequence of ndarray of int
        For each turn flat places of the numbers in the leaf.
    answers : sequence of ndarray of int
        For each turn flat places of their log densities in the root.
    lines : sequence of str
        For each turn along what they move: ``slice_moves.LINES``.
    growth : sequence of int
        For each turn widths by which intervals may grow.
    """

    places: Sequence[np.ndarray]
    answers: Sequence[np.ndarray]
    lines: Sequence[str]
    growth: Sequence[int]

    @property
    def sites(self) -> int:
        """How many numbers move."""
        return sum(len(p) for p in self.places)


class Slices:
    """Moves along slices, without Python between calls of the density.

    Parameters
    ----------
    root : Expression
        Log densities.
    name : str
        The leaf that moves. All others have values of their own for each chain.
    turns : Turns

    Raises
    ------
    TraceError
        There is no machine code of these.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.lowering import Slices, Turns, is_available
    >>> x = leaf("x", (2,))
    >>> root = elementwise(np.multiply, -0.5, elementwise(np.square, x))
    >>> both = np.arange(2)
    >>> if is_available():
    ...     slices = Slices(root, "x", Turns([both], [both], ["real"], [64]))
    ...     x, seeds = np.zeros((3, 2)), np.arange(1, 13, dtype=np.uint64).reshape(3, 1, 4) << 40
    ...     ends = np.full((3, 2), np.inf)
    ...     told = slices.move(x, np.ones((3, 2)), -ends, ends, seeds, {}, lambda k, x: -0.5 * x**2)
    ...     assert (x != 0).all() and (told[:, 0] == 0).all()
    """

    def __init__(self, root: Expression, name: str, turns: Turns) -> None:
        if not is_available():
            raise TraceError("machine code needs llvmlite: pip install bayesmc[fast]")
        self.root, self.name, self.turns = root, name, turns
        self._way = Way([root], frozenset([name]))
        leaves = list(enumerate(self._way.kernel.leaves))
        if not self._way.loaded.direct:
            raise TraceError(f"the log density does not depend on {name!r}")
        (self.leaf,) = (n for _, n in leaves if n.name == name)
        self._others = [(k, n, DTYPES[kind_of(n)]) for k, n in leaves if n.name != name]
        #: the other leaves that it reads
        self.others = tuple(n.name for _, n, _ in self._others)
        self.dtype = DTYPES[kind_of(self.leaf)]
        if kind_of(root) != "double" or self.dtype.itemsize != 8:
            raise TraceError(f"{name!r} is no number, or its log density is none")
        self._run = slice_moves()
        starts = np.cumsum([0, *(len(p) for p in turns.places)])
        lines = [LINES.index(line) for line in turns.lines]
        self._tables = [np.ascontiguousarray(a, np.int64) for a in (starts, lines)]
        self._tables.append(np.array(turns.growth, float))
        joined = (np.concatenate(a) for a in (turns.places, turns.answers))
        self._tables += [np.ascontiguousarray(a, np.int64) for a in joined]
        self._addresses = [address_of(a) for a in self._tables]
        self._most = max(len(p) for p in turns.places)
        self._asking = _Asking()

    def move(
        self,
        value: np.ndarray,
        width: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        seeds: np.ndarray,
        others: Mapping[str, np.ndarray],
        ask: Ask,
        threads: int = 1,
    ) -> np.ndarray:
        """Moves of every chain, turn after turn; arrays are in C order.

        Parameters
        ----------
        value : ndarray, shape (*lead, *leaf)
            Of the leaf's type; it is written to. The lead is that of the chains, and of what else moves alike
            and apart: all are called chains here.
        width, low, high : ndarray, shape (chains, sites)
            Sizes of first intervals, and bounds, of all sites in the order of the turns.
        seeds : ndarray of uint64, shape (chains, turns, 4)
            Of each chain's random numbers in each turn; it is written to.
        others : mapping
            Stored values of the other leaves, ``(*lead, *leaf)`` or what broadcasts to it.
        ask : callable
            Tells what machine code cannot.
        threads : int
            Threads that share the chains; what comes out is the same.

        Returns
        -------
        ndarray, shape (chains, len(TOLD))
        """
        lead, sites = value.shape[: value.ndim - len(self.leaf.shape)], self.turns.sites
        chains = math.prod(lead)
        told = np.empty((chains, len(TOLD)))
        moving, held = self._moving(others, lead)
        asking = self._asking.begun(ask, self.leaf.shape, self.dtype, self.root.size)
        wholes = (len(self.turns.places), sites, self.leaf.size, self.root.size,
                  int(self.dtype.kind == "i"), len(self._others))  # fmt: skip
        before = [address_of(moving), asking.address]
        ends = [address_of(a) for a in (width, low, high, seeds, told)]
        behind = [address_of(value), *self._addresses, *ends]
        needed = numbers_of(self._most, self.leaf.size, self.root.size)

        def part(first: int, last: int) -> None:
            table, kept = self._way.table(1)
            memory = np.empty(needed)
            own = [self._way.loaded.direct, address_of(table), *before, address_of(memory)]
            self._run(first, last, *wholes, *own, *behind)
            del kept, table, memory  # they live as long as the call

        shared(part, chains, threads)
        del held
        asking.ended()
        return told

    # ---- private -------------------------------------------------------------------------------

    def _moving(
        self, values: Mapping[str, np.ndarray], lead: tuple[int, ...]
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Where each other leaf's value of every chain lies, and the memory behind it."""
        moving, held = np.zeros((len(self._others) + 1, 3), np.int64), []
        for row, (place, node, dtype) in zip(moving, self._others, strict=False):
            array = np.ascontiguousarray(values[node.name], dtype)
            step = dtype.itemsize * math.prod(node.shape)
            if array.ndim == len(node.shape):
                step = 0  # one for all chains
            elif array.shape != (*lead, *node.shape):
                array = np.ascontiguousarray(np.broadcast_to(array, (*lead, *node.shape)))
            held.append(array)
            row[:] = place, address_of(array), step
        return moving, held


# ---- private ------------------------------------------------------------------------------------


class _Asking(threading.local):
    """A function in C that asks whom it is told to, one for each thread that begins moves."""

    def __init__(self) -> None:
        self._asked: _Asked | None = None

    def begun(self, ask: Ask, shape: tuple[int, ...], dtype: np.dtype, results: int) -> _Asked:
        if self._asked is None:
            self._asked = _Asked(shape, dtype, results)
        self._asked.ask, self._asked.failed = ask, None
        return self._asked


class _Asked:
    """``ask`` as a function in C; its first error is kept, and what follows has no density."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype, results: int) -> None:
        self.ask: Ask | None = None
        self.failed: BaseException | None = None
        words = ctypes.c_int64 if dtype.kind == "i" else ctypes.c_double
        numbers, logs = words * math.prod(shape), ctypes.c_double * results

        def tell(chain: int, value: int, log: int, _: int) -> int:
            try:
                at = np.array(numbers.from_address(value), dtype).reshape(shape)
                found = np.broadcast_to(self.ask(chain, at), results)  # type: ignore[misc]
            except BaseException as error:
                self.failed = self.failed or error
                found = np.full(results, -np.inf)
            logs.from_address(log)[:] = found.astype(float).tolist()
            return 0

        self._tell = FALLBACK(tell)
        self.address = ctypes.cast(self._tell, ctypes.c_void_p).value or 0

    def ended(self) -> None:
        """Raise what went wrong."""
        failed, self.ask, self.failed = self.failed, None, None
        if failed is not None:
            raise failed
