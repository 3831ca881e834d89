"""One variable of a BIF file, as the reader gives it and the writer takes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class BifNode:
    """One variable of a BIF file with its conditional probability table.

    Attributes
    ----------
    name : str
    states : tuple of str
        In file order.
    parents : tuple of str
        In the order of the ``probability`` block.
    probs : ndarray, shape (card(parent_1), ..., card(parent_n), card(name))
        Read-only; every row sums to 1.
    properties : tuple of str
        The texts of the variable's ``property`` lines.
    """

    name: str
    states: tuple[str, ...]
    parents: tuple[str, ...]
    probs: np.ndarray
    properties: tuple[str, ...] = ()
