"""Trajectories of one density as machine code: what ``no_u_turn`` is given, on one thread or several."""

from __future__ import annotations

import contextvars
import ctypes
import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.lowering.compiled import Compiled, Way, address_of
from bayesmc.lowering.no_u_turn import FALLBACK, TOLD, numbers_of, transitions
from bayesmc.lowering.ufuncs import kind_of
from bayesmc.lowering.writer import DTYPES
from bayesmc.shapes import Shape

#: ``ask(chain, u)``: the log density of a chain at free numbers ``(size,)``, and its gradient
Ask = Callable[[int, np.ndarray], tuple[Any, np.ndarray]]


@dataclass(frozen=True)
class Told:
    """What is told of one transition of every chain, each ``(chains,)``."""

    acceptance: np.ndarray
    leaves: np.ndarray
    depth: np.ndarray
    divergent: np.ndarray
    energy: np.ndarray


class Trajectories:
    """Transitions of the No-U-Turn sampler, without Python between the leaves of a tree.

    Parameters
    ----------
    run : Compiled or None
        The log density and its gradient; None where ``ask`` is to tell every leaf.
    free : str
        The leaf of the free numbers. All others have values of their own for each chain.

    Raises
    ------
    TraceError
        There is no machine code of these.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.lowering import Trajectories, is_available
    >>> def ask(chain, u):
    ...     return -0.5 * (u**2).sum(), -u
    >>> u, log, slope = np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2))
    >>> seeds = np.arange(4, dtype=np.uint64)[None]
    >>> if is_available():
    ...     told = Trajectories(None, "u").move(
    ...         (u, log, slope), np.ones((1, 2)), np.full(1, 0.5), np.ones(2), seeds, 10, ask)
    ...     assert told.depth[0] == 2 and (slope == -u).all()
    """

    def __init__(self, run: Compiled | None, free: str) -> None:
        self._run = transitions()
        self._way = None if run is None else Way(run.roots, frozenset([free]))
        #: of other leaves: place, name, type, shape and bytes of a value
        self._others: list[tuple[int, str, np.dtype, Shape, int]] = []
        if self._way is None:
            return
        leaves = list(enumerate(self._way.kernel.leaves))
        if not self._way.loaded.direct or not any(n.name == free for _, n in leaves):
            raise TraceError("the log density does not depend on its free numbers alone")
        for k, leaf in leaves:
            if leaf.name != free:
                dtype = DTYPES[kind_of(leaf)]
                size = dtype.itemsize * math.prod(leaf.shape)
                self._others.append((k, leaf.name, dtype, leaf.shape, size))

    def move(
        self,
        place: tuple[np.ndarray, np.ndarray, np.ndarray],
        momenta: np.ndarray,
        step: np.ndarray,
        root: np.ndarray,
        seeds: np.ndarray,
        max_depth: int,
        ask: Ask,
        others: Mapping[str, np.ndarray] | None = None,
        threads: int = 1,
    ) -> Told:
        """One transition of every chain; arrays are in C order, and those of the place are written to.

        Parameters
        ----------
        place : tuple of ndarray
            Free numbers ``(chains, size)``, log densities and gradients; then where the chains went.
        momenta : ndarray, shape (chains, size)
            Whitened.
        step : ndarray, shape (chains,)
        root : ndarray, shape (size,) or (size, size)
            Square root of the inverse metric.
        seeds : ndarray of uint64, shape (chains, 4)
            Of each chain's random numbers; it is written to.
        max_depth : int
        ask : callable
            Tells what machine code cannot.
        others : mapping, optional
            Stored values of hidden nodes that do not move, chains first.
        threads : int
            Threads that share the chains; what comes out is the same.
        """
        chains, size = place[0].shape
        told, failed = np.empty((chains, len(TOLD))), [None]
        moving, held = self._moving(others or {}, chains)
        arrays = (*place, momenta, step, root, seeds, told)
        addresses = [address_of(a) for a in arrays]
        fallback = _callback(ask, size, failed)

        def part(first: int, last: int) -> None:
            direct, table = 0, np.zeros(1, np.uintp)
            kept: list[np.ndarray] = []  # lives as long as the call
            if self._way is not None:
                direct, (table, kept) = self._way.loaded.direct, self._way.table(2)
            memory = np.empty(numbers_of(size, max_depth))
            wholes = (first, last, size, max_depth, int(root.ndim > 1), len(self._others))
            pointers = (direct, address_of(table), address_of(moving), fallback, address_of(memory))
            self._run(*wholes, *pointers, *addresses)
            del kept, table

        shared(part, chains, threads)
        del held
        if failed[0] is not None:
            raise failed[0]
        return Told(*told.T)

    # ---- private -------------------------------------------------------------------------------

    def _moving(
        self, values: Mapping[str, np.ndarray], chains: int
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Where each other leaf's value of every chain lies, and the memory behind it."""
        rows, held = [], []
        for place, name, dtype, shape, size in self._others:
            array = np.ascontiguousarray(values[name], dtype)
            if array.shape != (chains, *shape):
                array = np.ascontiguousarray(np.broadcast_to(array, (chains, *shape)))
            held.append(array)
            rows.append((place, address_of(array), size))
        return np.array([*rows, (0, 0, 0)], np.int64), held


def shared(part: Callable[[int, int], None], chains: int, threads: int) -> None:
    """``part(first, last)`` of chains that threads share, with what the caller has set (``np.errstate``)."""
    if threads == 1:
        part(0, chains)
        return
    ends = [chains * k // threads for k in range(threads + 1)]
    parts = [(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True) if a < b]
    settings = [contextvars.copy_context() for _ in parts]  # what C asks Python runs in these

    def run(own: contextvars.Context, ends: tuple[int, int]) -> None:
        own.run(part, *ends)

    list(_pool(threads).map(run, settings, parts))


# ---- private ------------------------------------------------------------------------------------


def _callback(ask: Ask, size: int, failed: list[Any]) -> Any:
    """``ask`` as a function in C; its first error is kept, and what follows has no density."""

    def tell(chain: int, u: int, value: int, gradient: int) -> int:
        numbers = ctypes.c_double * size
        try:
            log, slope = ask(chain, np.array(numbers.from_address(u)))
        except BaseException as error:
            failed[0] = failed[0] or error
            log, slope = -np.inf, np.zeros(size)
        ctypes.c_double.from_address(value).value = float(log)
        numbers.from_address(gradient)[:] = np.asarray(slope, float).tolist()
        return 0

    return FALLBACK(tell)


@lru_cache(maxsize=8)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "bayesmc")


# threads end with their process: a forked child would wait for them
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)
