"""Where elements lie: arithmetic of indices, of which some are known and some are numbers of loops."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc.lowering.code import Index


def times(index: Index, factor: int) -> Index:
    """An index some times."""
    if isinstance(index, int) or factor == 0:
        return index * factor if isinstance(index, int) else 0
    return index if factor == 1 else index * factor


def plus(a: Index, b: Index) -> Index:
    """The sum of two indices."""
    if isinstance(a, int) and not isinstance(b, int):
        a, b = b, a
    return a if isinstance(b, int) and b == 0 else a + b


def flat(shape: Sequence[int], at: Sequence[Index]) -> Index:
    """Where an element lies in an array in C order."""
    found: Index = 0
    for k, index in enumerate(at):
        if shape[k] != 1:
            found = plus(found, times(index, math.prod(shape[k + 1 :])))
    return found


def unraveled(position: int, shape: Sequence[int]) -> tuple[int, ...]:
    """The index of an element that lies at a known position."""
    return tuple(int(i) for i in np.unravel_index(position, shape)) if shape else ()
