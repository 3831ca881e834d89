"""The categorical distribution on ``0 .. K-1``, held as a table of rows and row numbers.

Rows shared by several batch elements (a broadcast array, or a lazy gather) are checked and
cumulated once, and a log probability reads only the entries asked for.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.support import Support, integers
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.shapes import Shape

_FEW_STATES = 32  # up to here one comparison per state beats a binary search in many rows,
_SEARCHED = 8  # and from here a search in a single one beats the comparisons


TOLERANCE = 1e-6  # how far the sum of a row may be from one
_ROUNDING = 4 * np.finfo(float).eps
_NEVER = 2.0  # a threshold that no uniform number reaches


class Categorical(Distribution):
    """Categorical distribution on the states ``0`` to ``K - 1``.

    Give exactly one of ``probs`` and ``logits``.

    Parameters
    ----------
    probs : array_like, shape (..., K)
        Probabilities; a row off one by at most 1e-6 is renormalised. A lazy gather (an object with
        ``table`` (R, K) and ``rows`` (...)) is read entry by entry, never materialised.
    logits : array_like, shape (..., K)
        Unnormalised log probabilities; minus infinity is probability zero.

    Raises
    ------
    ParameterError
        A row has a negative or NaN entry or does not sum to one; ``index`` is that row's.
    ShapeError
        The parameter has no last axis of states.

    References
    ----------
    Murphy, Probabilistic Machine Learning: An Introduction, 2022, section 2.5.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> weather = bmc.Categorical([[0.7, 0.2, 0.1], [0.1, 0.4, 0.5]])
    >>> weather.log_prob([0, 2]).round(4).tolist()
    [-0.3567, -0.6931]
    """

    is_discrete = True
    parameter_ndim = {"probs": 1}
    _probs_name = "probs"

    def __init__(self, probs: Any = None, *, logits: Any = None) -> None:
        if (probs is None) == (logits is None):
            raise ParameterError("Categorical: give exactly one of probs and logits")
        name = "probs" if logits is None else "logits"
        table, self._rows, batch = _as_rows(probs if logits is None else logits)
        if table.ndim != 2 or table.shape[-1] < 1:
            raise ShapeError(f"Categorical: {name} must have shape (..., K) with K at least 1")
        self._set_batch(batch)
        self._size = table.shape[-1]
        self._table = table
        self._sums: np.ndarray | None = None
        self._padded: np.ndarray | None = None
        self._logs: np.ndarray | None = None
        if logits is None:
            self._table = self._checked_probs(table)
        else:
            self._logs = self._checked_logits(table)
            self._table = np.exp(self._logs)

    @property
    def probs(self) -> np.ndarray:
        """Probabilities, shape ``batch_shape + (K,)``, normalised."""
        if self._rows is None:
            return self._table.reshape(self.batch_shape + (self._size,))
        return self._table[self._rows]

    @property
    def probs_table(self) -> np.ndarray:
        return self.probs

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        u = np.asarray(rng.random(shape))
        if len(self._table) == 1 and self._size > _SEARCHED:
            sums = np.cumsum(self._table[0])
            u *= sums[-1]  # stays below it, so that a last state without mass is never reached
            return np.asarray(np.searchsorted(sums[:-1], u, side="right"))
        if self._rows is None and self._size <= _FEW_STATES:
            if self._sums is None:
                self._sums = cumulative_columns(self._table)
            return pick_by_columns(u, self._sums, self.batch_shape)
        if self._padded is None:
            self._padded = thresholds(self._table)
        return pick_by_search(u, self._padded, self._row_numbers())

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        codes, ok = _as_codes(x, self._size)
        if x.ndim == 0 and (self._rows is None or self._rows.size >= len(self._table)):
            column = self._table[:, codes] if self._logs is None else self._logs[:, codes]
            out = self._by_row(np.log(column) if self._logs is None else column)
            return out if ok is None or ok else np.full_like(out, -np.inf)
        one_row = len(self._table) == 1 and not self.batch_shape
        entries = codes if one_row else self._row_numbers() * self._size + codes
        if self._logs is None and self._table.size <= np.size(entries):
            self._logs = np.log(self._table)
        if self._logs is not None:
            out = self._logs.reshape(-1).take(entries)
        else:
            out = np.log(self._table.reshape(-1).take(entries))
        return out if ok is None else np.where(ok, out, -np.inf)

    @property
    def mean(self) -> np.ndarray:
        """Mean of the state's number."""
        return self._by_row(self._table @ np.arange(self._size))

    @property
    def var(self) -> np.ndarray:
        codes = np.arange(self._size)
        mean = self._table @ codes
        return self._by_row((self._table * (codes - mean[:, None]) ** 2).sum(axis=-1))

    @property
    def support(self) -> Support:
        return integers(0, self._size - 1)

    def cdf(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        # one column of zeros in front: the state below the first
        sums = np.concatenate(
            [np.zeros((len(self._table), 1)), np.cumsum(self._table, axis=-1)], axis=-1
        )
        sums[:, -1] = 1.0
        column = np.clip(np.floor(np.nan_to_num(x, nan=0.0)) + 1, 0, self._size).astype(np.int64)
        entries = self._row_numbers() * (self._size + 1) + column
        return np.where(np.isnan(x), np.nan, sums.reshape(-1).take(entries))

    def ppf(self, q: Any) -> np.ndarray:
        q = as_quantile(q)
        shape = np.broadcast_shapes(q.shape, self.batch_shape)
        sums = np.cumsum(self._table, axis=-1)
        state = np.zeros(shape)
        for code in range(self._size - 1):
            state += self._by_row(sums[:, code]) < q
        return np.where(np.isnan(q), np.nan, state)

    def _row_numbers(self) -> np.ndarray:
        if self._rows is not None:
            return self._rows
        return np.arange(len(self._table)).reshape(self.batch_shape)

    def _by_row(self, values: np.ndarray) -> np.ndarray:
        """One number per row of the table, as the batch sees them."""
        if self._rows is None:
            return values.reshape(self.batch_shape)
        return values[self._rows]

    def _checked_probs(self, table: np.ndarray) -> np.ndarray:
        rows, totals, bad = normalise_rows(table)
        if bad is not None and (seen := self._by_row(bad)).any():
            row = self._first_row(seen)
            least = table[row].min()
            fault = f"holds {least:.8g}" if least < 0 else f"sums to {totals[row]:.8g}"
            self._reject(
                self._probs_name,
                table[row],
                seen,
                f"nonnegative and sum to 1 within {TOLERANCE:g} (this row {fault})",
            )
        return rows

    def _checked_logits(self, table: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            peak = table.max(axis=-1, keepdims=True)
            bad = ~np.isfinite(peak[:, 0])
            if bad.any():
                if (seen := self._by_row(bad)).any():
                    row = self._first_row(seen)
                    requirement = "below infinity, not NaN, and one of them finite"
                    self._reject("logits", table[row], seen, requirement)
                table = np.where(bad[:, None], 0.0, table)
                peak = np.where(bad[:, None], 0.0, peak)
            shifted = table - peak
            return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))

    def _first_row(self, seen: np.ndarray) -> int:
        """Number of the row that the first element of ``seen`` uses."""
        rows = np.broadcast_to(self._row_numbers(), seen.shape)
        return int(rows.reshape(-1)[int(np.argmax(seen))])


def _as_rows(source: Any) -> tuple[np.ndarray, np.ndarray | None, Shape]:
    """A table of rows, the row of each batch element (None: in order), and the batch shape."""
    if hasattr(source, "table") and hasattr(source, "rows") and np.ndim(source.table) == 2:
        rows = np.asarray(source.rows)
        return as_float(source.table), rows, rows.shape
    array = as_float(source)
    if array.ndim < 1 or array.shape[-1] < 1:
        return np.empty((0, 0)), None, ()
    batch = array.shape[:-1]
    if 0 in array.strides[:-1] and array.size:
        # broadcast along some batch axes: the same rows again and again
        kept = tuple(slice(0, 1) if stride == 0 else slice(None) for stride in array.strides[:-1])
        array = array[kept]
        table = array.reshape(-1, array.shape[-1])
        rows = np.arange(len(table)).reshape(array.shape[:-1])
        return table, np.broadcast_to(rows, batch), batch
    return array.reshape(-1, array.shape[-1]), None, batch


def _as_codes(x: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray | None]:
    """States as safe indices, and where they are states at all (None: everywhere)."""
    if x.dtype.kind in "iub":
        codes = x.astype(np.int64)
        if not codes.size or (codes.min() >= 0 and codes.max() < size):
            return codes, None
        ok = (codes >= 0) & (codes < size)
    else:
        ok = (x >= 0) & (x < size) & (x == np.floor(x))
        codes = x
    return np.where(ok, codes, 0).astype(np.int64), ok


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
