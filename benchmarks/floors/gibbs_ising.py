"""Gibbs sampling of an Ising model on a grid by hand-written NumPy: one chain, one thread.

The law is proportional to ``exp(J sum_<ij> s_i s_j + h sum_i s_i)`` with spins of -1 and 1, four
neighbours and free boundaries. A sweep is two half-sweeps, one for each colour of a checkerboard.

- :func:`checkerboard` is what one writes first: whole arrays, a mask for the colour.
- :class:`Parity` keeps each colour in an array of its own, bytes within a border of zeros, so that
  a field of neighbours is four sums of bytes and its probability one of nine numbers.
"""

from __future__ import annotations

import numpy as np


def checkerboard(spins: np.ndarray, coupling: float, field: float, sweeps: int, seed: int) -> None:
    """Sweeps over ``spins``, (rows, columns) of -1 and 1, in place."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices(spins.shape)
    for sweep in range(2 * sweeps):
        around = np.zeros(spins.shape)
        around[1:] += spins[:-1]
        around[:-1] += spins[1:]
        around[:, 1:] += spins[:, :-1]
        around[:, :-1] += spins[:, 1:]
        up = 1.0 / (1.0 + np.exp(-2.0 * (coupling * around + field)))
        new = np.where(rng.random(spins.shape) < up, 1, -1)
        spins[:] = np.where((rows + columns) % 2 == sweep % 2, new, spins)


class Parity:
    """The colours of a checkerboard in two arrays; ``size`` is even.

    Site ``(r, c)`` of colour ``k = (r + c) % 2`` lies at row ``r``, column ``c // 2`` of array k.
    """

    def __init__(self, size: int, coupling: float, field: float, seed: int) -> None:
        self.rng = np.random.Generator(np.random.SFC64(seed))
        shape = size, size // 2
        self.padded = [np.zeros((size + 2, size // 2 + 2), np.int8) for _ in range(2)]
        self.colours = [array[1:-1, 1:-1] for array in self.padded]
        for colour in self.colours:
            colour[:] = 2 * self.rng.integers(0, 2, shape, dtype=np.int8) - 1
        around = np.arange(-4, 5)
        self.up = (1.0 / (1.0 + np.exp(-2.0 * (coupling * around + field)))).astype(np.float32)
        self.around, self.index = np.empty(shape, np.int8), np.empty(shape, np.intp)
        self.bound, self.uniform = np.empty(shape, np.float32), np.empty(shape, np.float32)
        self.below = np.empty(shape, bool)

    def run(self, sweeps: int) -> None:
        """So many sweeps."""
        for _ in range(sweeps):
            self._half(0)
            self._half(1)

    def spins(self) -> np.ndarray:
        """The grid, (size, size) of -1 and 1."""
        rows, columns = np.indices((len(self.around), len(self.around)))
        both = np.stack(self.colours)
        return both[(rows + columns) % 2, rows, columns // 2]

    def _half(self, colour: int) -> None:
        np.add(self._around(colour), 4, out=self.index, casting="unsafe")
        self.up.take(self.index, out=self.bound, mode="clip")
        self.rng.random(out=self.uniform, dtype=np.float32)
        np.less(self.uniform, self.bound, out=self.below)
        spins = self.colours[colour]
        np.multiply(self.below.view(np.int8), 2, out=spins)
        spins -= 1

    def _around(self, colour: int) -> np.ndarray:
        other, around = self.padded[1 - colour], self.around
        np.add(other[:-2, 1:-1], other[2:, 1:-1], out=around)
        around += other[1:-1, 1:-1]
        # Rows of even columns have their other neighbour a column before, the rest a column after.
        even, odd = colour, 1 - colour
        around[even::2] += other[1 + even : -1 : 2, :-2]
        around[odd::2] += other[1 + odd : -1 : 2, 2:]
        return around
