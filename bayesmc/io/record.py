"""One discrete variable as a file has it: what readers of all formats give and writers take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class TableNode:
    """One variable of a file with its conditional probability table.

    Attributes
    ----------
    name : str
    states : tuple of str
        In file order.
    parents : tuple of str
        In the order in which the file conditions on them.
    probs : ndarray, shape (card(parent_1), ..., card(parent_n), card(name))
        Read-only; every row sums to 1.
    properties : tuple of str
        The texts of the variable's ``property`` lines or elements.
    line : int or None
        Where the file says what its parents are (from 1).
    """

    name: str
    states: tuple[str, ...]
    parents: tuple[str, ...]
    probs: np.ndarray
    properties: tuple[str, ...] = ()
    line: int | None = None
