"""Slices in machine code: held against those in NumPy, on the model's own functions, before they are used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.errors import DensityError, TraceError
from bayesmc.expression import Expression, Leaf, Program, ordered
from bayesmc.expression.graph import replaced
from bayesmc.lowering import Kernel, Slices, Turns
from bayesmc.lowering.slice_moves import ZERO
from bayesmc.passes.arrays import for_arrays
from bayesmc.passes.guarded import guarded
from bayesmc.passes.sorting import by_comparisons
from bayesmc.structure.conditional import Conditional, standing
from bayesmc.structure.target import Values

#: elements of what does not move up to which it is computed anew at every value that is tried
_ANEW = 256
#: how far moves may be off, in widths: rounding of densities moves no end of an interval
_OFF = 1e-7


class CompiledMoves:
    """Moves of some numbers along slices, by random numbers of their own.

    Parameters
    ----------
    root : Expression
        Log densities.
    name : str
        The leaf that moves.
    turns : Turns
    threads : int
        Threads that share the chains; the result is the same.

    Raises
    ------
    TraceError
        There is no machine code of it.
    """

    def __init__(self, root: Expression, name: str, turns: Turns, threads: int = 1) -> None:
        root, parts = machine_root(root, name)
        self.threads = threads
        self._parts = [part.name for part in parts.values()]
        self._standing = Program(for_arrays(parts)) if parts else None
        self.slices = Slices(root, name, turns)
        self.is_checked = False
        #: how its first moves were others than those in NumPy; empty if they were not
        self.differs = ""

    def __call__(
        self,
        values: Values,
        width: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        seeds: np.ndarray,
        ask: Callable[[int, np.ndarray], np.ndarray],
    ) -> np.ndarray:
        """The leaf's values after moves of all chains.

        Parameters
        ----------
        values : dict
            Stored values, of data that the log density knows, and the leaf's.
        width, low, high : ndarray, shape (chains, sites)
        seeds : ndarray of uint64, shape (chains, turns, 4)
            Of each chain's random numbers in each turn.
        ask : callable
            ``ask(chain, value)``: log densities by the model's functions, where machine code has no number.

        Raises
        ------
        DensityError
            A chain is where its density is zero, or finds no other place.
        """
        slices, before = self.slices, values[self.slices.name]
        others = dict(values)
        if self._standing is not None:
            others.update(zip(self._parts, self._standing(values), strict=True))
        value = np.array(before, slices.dtype, order="C")
        told = slices.move(value, width, low, high, seeds.copy(), others, ask, self.threads)
        if told[:, 0].any():
            raise DensityError(AT_ZERO if (told[:, 0] == ZERO).any() else LOST)
        return value.astype(before.dtype, copy=False)


class CompiledSlice(CompiledMoves):
    """Moves of a node along slices of its full conditional.

    Parameters
    ----------
    conditional : Conditional
    turns : Turns
    threads : int
    """

    def __init__(self, conditional: Conditional, turns: Turns, threads: int = 1) -> None:
        self.conditional = conditional
        #: widths and bounds of the last move, and what they were made of
        self.intervals: Any = None
        super().__init__(conditional.root, conditional.name, turns, threads)


class Streams:
    """The numbers that machine code draws for each chain in one turn, as ``slice_move`` asks for them.

    Parameters
    ----------
    seeds : ndarray of uint64, shape (chains, 4)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.compiled_slice import Streams
    >>> Streams(np.arange(1, 9, dtype=np.uint64).reshape(2, 4) << 60).random((2, 2))
    array([[0.0625, 0.4375],
           [0.3125, 0.6875]])
    """

    def __init__(self, seeds: np.ndarray) -> None:
        self._state = [seeds[:, k].copy() for k in range(4)]

    def random(self, shape: tuple[int, ...]) -> np.ndarray:
        """Uniform numbers above 0, by xoshiro256++: those of each chain one after the other."""
        found = np.empty(shape)
        flat = found.reshape(len(self._state[0]), -1)
        for k in range(flat.shape[1]):
            flat[:, k] = self._next()
        return found

    def standard_exponential(self, shape: tuple[int, ...]) -> np.ndarray:
        return -np.log(self.random(shape))

    def _next(self) -> np.ndarray:
        s = self._state
        found = _rotated(s[0] + s[3], 23) + s[0]
        t = s[1] << np.uint64(17)
        third, fourth = s[2] ^ s[0], s[3] ^ s[1]
        self._state = [s[0] ^ fourth, s[1] ^ third, third ^ t, _rotated(fourth, 45)]
        return ((found >> np.uint64(11)) + np.uint64(1)).astype(float) * 2.0**-53


#: what is said of a chain's own place, and of one that is not left
AT_ZERO = "the density is zero at the chain's own value"
LOST = (
    "slice sampling found no point at least as likely as the chain's own; the log density changes "
    "from call to call, or is NaN nearby"
)


def machine_root(root: Expression, name: str) -> tuple[Expression, dict[Expression, Leaf]]:
    """What is compiled of log densities, and what of them is computed by NumPy, once for every move."""
    (root,) = by_comparisons(guarded([root]))
    parts = standing(root, name)
    below = [n for n in ordered(*parts) if n.leaves] if parts else []
    if sum(n.size for n in below) <= _ANEW:
        parts = {}
    return (replaced(root, dict(parts)) if parts else root), parts


def why_not(root: Expression, name: str) -> str:
    """Why there is no machine code of log densities; empty where there is. Nothing is compiled to know."""
    root, _ = machine_root(root, name)
    try:
        Kernel([root], frozenset([name]))
    except TraceError as error:
        return str(error)
    return ""


def compare(found: np.ndarray, wanted: np.ndarray, width: np.ndarray) -> str:
    """How moves end elsewhere than those in NumPy; empty where they do not.

    Parameters
    ----------
    found, wanted : ndarray, shape (chains, *node)
    width : ndarray, shape (*node)
        Sizes of intervals.
    """
    off = ~(np.abs(found.astype(float) - wanted) <= _OFF * (1.0 + width + np.abs(wanted)))
    if not off.any():
        return ""
    at = np.unravel_index(int(np.argmax(off)), off.shape)
    return f"a slice of chain {at[0]} in machine code ends at {found[at]}, and in NumPy at {wanted[at]}"


# ---- private ------------------------------------------------------------------------------------


def _rotated(x: np.ndarray, by: int) -> np.ndarray:
    return (x << np.uint64(by)) | (x >> np.uint64(64 - by))
