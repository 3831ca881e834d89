"""Tables whose rows are probabilities: checking, cumulating and drawing from them.

Works on a plain table ``(R, K)`` and integer row numbers, so that a row shared by many draws is
checked and cumulated once. It knows neither distributions nor nodes.
"""

from __future__ import annotations

import numpy as np

TOLERANCE = 1e-6  # how far the sum of a row may be from one
_ROUNDING = 4 * np.finfo(float).eps
_NEVER = 2.0  # a threshold that no uniform number reaches


def normalise_rows(table: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Rows that sum to one, their former sums, and which rows cannot be (None if all can).

    Rows off by at most 1e-6 are divided by their sum. Faulty rows become uniform, so that a caller
    that only marks them can go on.
    """
    size = table.shape[-1]
    if not table.size:
        return table, np.ones(len(table)), None
    with np.errstate(invalid="ignore", over="ignore"):
        totals = table @ np.ones(size)  # faster than a sum along a short axis
        error = np.abs(totals - 1.0)
        worst = error.max()
        if not (worst <= TOLERANCE and table.min() >= 0):
            bad = ~((table >= 0).all(axis=-1) & (error <= TOLERANCE))
            table = np.where(bad[:, None], 1.0 / size, table)
            divisors = np.where(bad, 1.0, totals)
            return table / divisors[:, None], totals, bad
    if worst > size * _ROUNDING:
        table = table / totals[:, None]
    return table, totals, None


def cumulative_columns(table: np.ndarray) -> np.ndarray:
    """Running sums of each row, transposed to ``(K, R)`` so that each state is contiguous."""
    sums = np.array(table.T, order="C")
    for previous, current in zip(sums, sums[1:], strict=False):
        current += previous
    return sums


def pick_by_columns(u: np.ndarray, sums: np.ndarray, batch: tuple[int, ...]) -> np.ndarray:
    """States for uniform numbers ``u`` (overwritten), by one comparison per state.

    ``sums`` are ``cumulative_columns``, whose rows have shape ``batch``, which broadcasts to ``u``.
    """
    # Scaled by the row's total, u stays below it, so that a last state of probability zero whose
    # running sum fell short of one by rounding is never drawn.
    u *= sums[-1].reshape(batch)
    codes = np.zeros(u.shape, dtype=np.uint8)
    passed = np.empty(u.shape, dtype=bool)
    for sum_ in sums[:-1]:
        np.greater_equal(u, sum_.reshape(batch), out=passed)
        codes += passed.view(np.uint8)
    return codes.astype(np.int64)


def thresholds(table: np.ndarray) -> np.ndarray:
    """Running sums padded to a power of two for ``pick_by_search``, shape ``(R, 2**m)``."""
    rows, size = table.shape
    width = 1 << (size - 1).bit_length()
    padded = np.full((rows, width), _NEVER)
    sums = np.cumsum(table, axis=-1, out=padded[:, :size])
    # From the last state with mass on, nothing is ever passed: rounding cannot lead beyond it.
    sums[sums >= sums[:, -1:]] = _NEVER
    return padded


def pick_by_search(u: np.ndarray, padded: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """States for uniform numbers ``u`` by a branchless binary search in row ``rows`` of each."""
    width = padded.shape[-1]
    flat = padded.reshape(-1)
    first = np.broadcast_to(rows * width, u.shape)
    position = first.astype(np.int64)
    step = width // 2
    while step:
        position += step * (flat.take(position + (step - 1)) <= u)
        step //= 2
    return position - first
