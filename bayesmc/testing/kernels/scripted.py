"""A stand-in for ``numpy.random.Generator`` whose draws are set from outside, one row for each chain.

It makes a sampler's step a function that can be asked what follows from which draws. A draw is a whole
number ``k`` of a range; all values of the range are equally likely, and they are all that the real
generator can give: ``random`` has 2**53 of them. It serves calls whose first axis is that of the chains,
and raw words as table look-ups read them; what it cannot serve it refuses.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.special

from bayesmc.errors import UnsupportedError

#: values of a double drawn by ``random``, and of half of a raw word
_DOUBLE, _HALF = 1 << 53, 1 << 32


class ScriptedGenerator:
    """Gives out the draws of a script, and notes how many values each could have had.

    Parameters
    ----------
    script : ndarray of int64, shape (rows, draws)
        Draws in the order in which they are asked for; zero where it is too short.
    what : str
        Who draws, for messages.

    Attributes
    ----------
    ranges : list of int
        For each draw made so far the number of its values.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.testing.kernels.scripted import ScriptedGenerator
    >>> rng = ScriptedGenerator(np.array([[1 << 52, 2], [0, 0]]), "an example")
    >>> rng.random(2).tolist(), rng.integers(5, 8, size=(2, 1)).tolist(), rng.ranges
    ([0.5, 0.0], [[7], [5]], [9007199254740992, 3])
    """

    def __init__(self, script: np.ndarray, what: str) -> None:
        self.script, self.what = script, what
        self.ranges: list[int] = []

    def random(self, size: Any = None) -> np.ndarray:
        """Doubles in [0, 1), multiples of 2**-53."""
        return self._taken(size, _DOUBLE) * 2.0**-53

    def standard_exponential(self, size: Any = None) -> np.ndarray:
        """By inversion: minus the log of a multiple of 2**-53 in (0, 1]."""
        return -np.log((self._taken(size, _DOUBLE) + 1) * 2.0**-53)

    def integers(
        self,
        low: Any,
        high: Any = None,
        size: Any = None,
        dtype: Any = np.int64,
        endpoint: bool = False,
    ) -> np.ndarray:
        """Whole numbers of one range for all."""
        first, last = (0, low) if high is None else (low, high)
        bounds = {int(b) for b in np.unique(first)}, {int(b) for b in np.unique(last)}
        if any(len(b) != 1 for b in bounds):
            raise UnsupportedError(
                f"exact_sweep: {self.what} draws whole numbers of several ranges at once, which is not read"
            )
        (begin,), (end,) = bounds
        return (begin + self._taken(size, end + bool(endpoint) - begin)).astype(dtype)

    def binomial(self, n: Any, p: Any, size: Any = None) -> np.ndarray:
        """By inversion of the distribution function."""
        u = self.random(size)
        below = np.arange(int(np.max(n))).reshape((-1,) + (1,) * u.ndim)
        # beyond n the function is 1, which u never reaches
        cdf = np.where(below < n, scipy.special.bdtr(np.minimum(below, n), n, p), 1.0)
        return (u >= cdf).sum(axis=0)

    @property
    def bit_generator(self) -> ScriptedGenerator:
        """Itself: raw words come from the same script."""
        return self

    def random_raw(self, size: int) -> np.ndarray:
        """Words of 64 bits, whose halves of 32 bits are draws: one for each row, then the next."""
        rows = len(self.script)
        draws, rest = divmod(2 * size, rows)
        if rest:
            raise UnsupportedError(
                f"exact_sweep: {self.what} draws raw bits in a layout that is not known, so that its matrix "
                "cannot be read"
            )
        halves = self._taken((rows, draws), _HALF).astype(np.uint32)
        return np.ascontiguousarray(halves.T).reshape(-1).view(np.uint64)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise UnsupportedError(
            f"exact_sweep: {self.what} draws by rng.{name}, which is not read; only random, integers, "
            "standard_exponential, binomial and raw words are"
        )

    def _taken(self, size: Any, count: int) -> np.ndarray:
        """The next draws, each of ``count`` values, in an array of shape ``size``."""
        shape = (size,) if isinstance(size, (int, np.integer)) else tuple(size or ())
        rows = len(self.script)
        if shape[:1] != (rows,):
            raise UnsupportedError(
                f"exact_sweep: {self.what} draws an array of shape {shape} for {rows} chains; chains must "
                "come first"
            )
        begin, each = len(self.ranges), math.prod(shape[1:])
        self.ranges += [count] * each
        found = np.zeros((rows, each), dtype=np.int64)
        given = self.script[:, begin : begin + each]
        found[:, : given.shape[1]] = given
        return found.reshape(shape)
