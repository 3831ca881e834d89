"""Whether times follow each other at equal steps: of seconds, days, weekdays, months or years.

Arrays only. Clocks that are put forward or back by an hour do not make days uneven.
"""

from __future__ import annotations

import numpy as np

_HOUR = 3_600_000_000  # microseconds
_DAY = 24 * _HOUR


def is_even(times: np.ndarray) -> bool:
    """Whether ascending numbers or dates, shape (rows,), are at equal steps.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.dbn.calendar import is_even
    >>> months = np.array(["2020-01-31", "2020-02-29", "2020-03-31"], dtype="datetime64[D]")
    >>> is_even(months), is_even(np.array([0, 1, 3]))
    (True, False)
    """
    if len(times) < 3:
        return True
    if times.dtype.kind != "M":
        return _constant(np.diff(np.asarray(times, dtype=float)), 1e-6)
    exact = times.astype("datetime64[us]").astype(np.int64)
    steps = np.diff(exact)
    if _constant(steps, 1e-6) or _by_days(steps):
        return True
    return _by_months(times) or _by_weekdays(times)


def uneven_at(times: np.ndarray) -> int:
    """The row after which a step differs most from the first one."""
    exact = times.astype("datetime64[us]").astype(np.int64) if times.dtype.kind == "M" else times
    steps = np.diff(np.asarray(exact, dtype=float))
    return int(np.argmax(np.abs(steps - steps[0])))


def last_times(times: np.ndarray | None, count: int, steps: int) -> np.ndarray | None:
    """The times of the last ``steps`` of ``count`` slices, of which the first have some, at the same step.

    None where nobody knows.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.dbn.calendar import last_times
    >>> last_times(np.array(["2020-01-30", "2020-01-31"], dtype="datetime64[D]"), 3, 1).astype(str).tolist()
    ['2020-02-01']
    """
    if times is None or len(times) >= count:
        return times if times is None else times[count - steps : count]
    steps = count - len(times)
    if len(times) < 2 or not is_even(times):
        return None
    if times.dtype.kind != "M":
        return times[-1] + (times[1] - times[0]) * np.arange(1, steps + 1)
    passed = np.diff(times)
    if bool((passed == passed[0]).all()):
        return times[-1] + passed[0] * np.arange(1, steps + 1)
    if _by_weekdays(times):
        dates = times.astype("datetime64[D]")
        passed = np.busday_count(dates[0], dates[1]) * np.arange(1, steps + 1)
        return (np.busday_offset(dates[-1], passed) + (times[-1] - dates[-1])).astype(times.dtype)
    if not _by_months(times):
        return None
    months = times.astype("datetime64[M]")
    ahead = months[-1] + (months[1] - months[0]) * np.arange(1, steps + 1)
    days = (times.astype("datetime64[D]") - months.astype("datetime64[D]")).max()
    last = (ahead + 1).astype("datetime64[D]") - ahead.astype("datetime64[D]") - 1
    within = times[-1] - times[-1].astype("datetime64[D]")
    return (ahead.astype("datetime64[D]") + np.minimum(days, last) + within).astype(times.dtype)


# ---- private ------------------------------------------------------------------------------------


def _constant(steps: np.ndarray, tolerance: float) -> bool:
    middle = np.median(steps)
    return bool((np.abs(steps - middle) <= tolerance * max(abs(middle), 1e-300)).all())


def _by_days(steps: np.ndarray) -> bool:
    """Days that an hour is missing from, or that have one more."""
    days = np.round(steps / _DAY)
    off = np.abs(steps - days * _DAY)
    return bool((days == days[0]).all() and days[0] > 0 and np.isin(off, (0, _HOUR)).all())


def _by_months(times: np.ndarray) -> bool:
    """The same day of the month (or its last, where it has not so many) at the same time of day."""
    months, dates = times.astype("datetime64[M]"), times.astype("datetime64[D]")
    passed = np.diff(months.astype(np.int64))
    if (passed != passed[0]).any() or passed[0] < 1:
        return False
    days = (dates - months.astype("datetime64[D]")).astype(np.int64)
    length = ((months + 1).astype("datetime64[D]") - months.astype("datetime64[D]")).astype(
        np.int64
    )
    within = times - dates
    return bool((days == np.minimum(days.max(), length - 1)).all() and (within == within[0]).all())


def _by_weekdays(times: np.ndarray) -> bool:
    """From Monday to Friday."""
    dates = times.astype("datetime64[D]")
    within = times - dates
    if not np.is_busday(dates).all() or (within != within[0]).any():
        return False
    passed = np.busday_count(dates[:-1], dates[1:])
    return bool((passed == passed[0]).all())
