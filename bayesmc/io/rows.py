"""What counts as a probability vector in a file: the one rule of all readers.

Files are rounded, so that rows sum to 1 only nearly. Where a fault stands, in file and line, is the
reader's business.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

ROW_TOLERANCE = 1e-6
"""A row's sum may always differ from 1 by this much."""

ENTRY_TOLERANCE = 5e-7
"""And by this much for each entry: half a unit of the sixth decimal, to which programs print."""


def first_improbable(values: Sequence[float]) -> int | None:
    """Position of the first number that is no probability, None where all are.

    Examples
    --------
    >>> from bayesmc.io.rows import first_improbable
    >>> first_improbable([0.2, 1.1, -0.3]), first_improbable([0.2, 0.8])
    (1, None)
    """
    # Written so that NaN fails; the common case needs no loop.
    if not values or (
        min(values) >= 0.0 and max(values) <= 1.0 + ROW_TOLERANCE and sum(values) < math.inf
    ):
        return None
    return next(k for k, value in enumerate(values) if not 0.0 <= value <= 1.0 + ROW_TOLERANCE)


def renormalised(rows: np.ndarray) -> tuple[np.ndarray, int | None]:
    """The rows with rounding divided out, and the index of one that is off by more than rounding.

    Rounding is a difference from 1 of at most 1e-6, or 5e-7 for each entry where that is more.

    Parameters
    ----------
    rows : ndarray, shape (count, states)

    Returns
    -------
    rows : ndarray, shape (count, states)
        Rows that sum to 1 to 1e-12 are left as they are.
    index : int or None
        The worst of the rows that are no probability vectors.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.io.rows import renormalised
    >>> rows, index = renormalised(np.array([[0.3, 0.7], [0.3, 0.6]]))
    >>> index
    1
    """
    sums = rows.sum(axis=1)
    off = np.abs(sums - 1.0)
    worst = int(np.argmax(off))
    # 0.999999 differs from 1 by 1.00000000003e-6
    is_rounding = off <= _allowed(rows.shape[1]) * (1 + 1e-9)
    # dividing exact rows as well would change their last digit
    divisors = np.where(is_rounding & (off > 1e-12), sums, 1.0)
    return rows / divisors[:, None], None if is_rounding.all() else worst


def sum_fault(row: np.ndarray) -> str:
    """What to say of a row that is off by more than rounding."""
    return (
        f"a row sums to {row.sum():.9g}, not 1 (differences up to {_allowed(row.size):g} are taken for "
        "rounding)"
    )


def without_rounding(probs: np.ndarray) -> np.ndarray:
    """A table, states last, with rounding divided out where that is all that is wrong with it."""
    rows, bad = renormalised(probs.reshape(-1, probs.shape[-1]))
    return probs if bad is not None else rows.reshape(probs.shape)


def _allowed(states: int) -> float:
    return max(ROW_TOLERANCE, ENTRY_TOLERANCE * states)
