"""Data frames over time: rows as slices, and whether the clock that labels them goes evenly.

Time is one plate more, the first. What labels it is the index, or a column of dates, or one that is called
like time; without any, row k is slice k. With a column called like a plate rows are about its elements,
one for each slice and element; else those are columns ``"x[a]"``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.dbn.calendar import is_even, last_times, uneven_at
from bayesmc.dbn.given import check_frame
from bayesmc.dbn.slices import TIME, Template
from bayesmc.errors import EvidenceError
from bayesmc.network.columns import (
    clock,
    columns_of,
    is_dated,
    is_frame,
    is_text,
    on_the_wall,
    zone_of,
)
from bayesmc.network.frames import names_of, read_table, with_inputs
from bayesmc.network.labels import is_default, oriented

#: what columns of time are called
_NAMES = (TIME, "time", "step", "slice", "date", "datetime", "timestamp")


def unframed_series(
    template: Template, observations: Any, inputs: Any = None
) -> tuple[Any, Any, np.ndarray | None]:
    """Observations and inputs as dicts, and the times of the slices where the data have some.

    Raises
    ------
    EvidenceError
        A column is nothing of the template; rows are not in the order of time, or not at equal steps of it
        (unless an input says how much time passes).
    """
    observations, inputs, times = _unframed(template, observations, inputs)
    return observations, inputs, None if times is None else times.wall


def times_ahead(
    template: Template, observations: Any, inputs: Any, count: int, steps: int
) -> np.ndarray | None:
    """What labels the last ``steps`` of ``count`` slices, the first of which have rows; None if nobody knows.

    Steps that are shorter than a day are even in time, and labels follow the clock of the data's zone where
    it is put forward or back; days, weeks and months are those of the calendar.
    """
    times = _unframed(template, observations, inputs)[2]
    if times is None:
        return None
    passed = np.diff(times.instants[:2])
    known = times.zone is not None and len(times.wall) < count and passed.size
    if not known or passed[0] >= np.timedelta64(1, "D"):
        return last_times(times.wall, count, steps)
    ahead = last_times(times.instants, count, steps)
    return None if ahead is None else on_the_wall(ahead, times.zone).astype(times.wall.dtype)


# ---- private ------------------------------------------------------------------------------------


def _unframed(template: Template, observations: Any, inputs: Any) -> tuple[Any, Any, _Times | None]:
    times = None
    _check_indexes(template, observations, inputs)
    if is_frame(observations):
        found, times = _read("observations", template, observations)
        inputs = with_inputs(found, inputs, template.later)
        observations = {n: v for n, v in found.items() if n not in template.inputs}
    if is_frame(inputs):
        inputs, own = _read("inputs", template, inputs)
        _check_alike(times, own)
        longer = own is not None and (times is None or len(own.wall) > len(times.wall))
        times = own if longer else times
    if times is None and isinstance(observations, Mapping):
        times = _index_of(template, observations)
    if times is not None:
        _check_even(template, times, inputs if isinstance(inputs, Mapping) else {})
    return observations, inputs, times


@dataclass(frozen=True, eq=False)
class _Times:
    """Times as the clock on the wall shows them, which label slices, and as instants, which are checked.

    Both are the same array where there is no zone, and ``zone`` is None.
    """

    wall: np.ndarray
    instants: np.ndarray
    zone: Any = None

    def take(self, rows: np.ndarray) -> _Times:
        return _Times(self.wall[rows], self.instants[rows], self.zone)


def _read(what: str, template: Template, frame: Any) -> tuple[dict[str, Any], _Times | None]:
    """Node -> its rows, time first, and their times."""
    later, plates = template.later, template.plates
    columns = columns_of(frame, what)
    axis = _time_column(what, template, columns, getattr(frame, "index", None))
    others = [axis] if axis is not None else []
    table = read_table(what, frame, later, plates.sizes, plates.labels, others)
    table = replace(table, index=None)
    times = (
        _times(what, axis, columns[axis])
        if axis is not None
        else _unnamed(what, frame, [*later, *plates.sizes])
    )
    names = names_of(table.columns, later)
    long = [n for n in names if any(p in table.keys for p in later[n].plates)]
    if long:
        if times is None:
            raise EvidenceError(
                f"{what}: rows say of which {next(iter(table.keys))!r} they are, and not of which "
                f"time; give a "
                "column or an index of times"
            )
        _check_known(what, times.instants)
        _, first, keys = np.unique(times.instants, return_index=True, return_inverse=True)
        times = times.take(first)
        table = replace(
            table,
            keys={**table.keys, "time": keys.ravel()},
            given={**table.given, "time": times.wall[keys.ravel()]},
            sizes={**table.sizes, "time": len(first)},
        )
    elif times is not None:
        _check_order(what, times.instants)
    if times is not None and TIME in (axis, getattr(getattr(frame, "index", None), "name", None)):
        _check_zero(what, template, times.wall)
    found = {}
    for name in names:
        own = later[name].plates
        if name in template.static:
            found[name] = table.values(name, own, plates.labels, bool(own))
        else:
            finer = any(set(later[n].plates) - set(own) for n in long)
            found[name] = table.values(name, ("time", *own), plates.labels, finer)
    return found, times


def _time_column(
    what: str, template: Template, columns: Mapping[str, Any], index: Any
) -> str | None:
    """The column that says of which time a row is."""
    free = [n for n in columns if n not in template.later and n not in template.plates.sizes]
    dated = [n for n in free if np.asarray(columns[n]).dtype.kind == "M" or _is_dates(columns[n])]
    if len(dated) > 1:
        raise EvidenceError(
            f"{what}: the columns {', '.join(map(repr, dated))} are times, and rows belong to one; drop the "
            "others"
        )
    named = [n for n in free if n.lower() in _NAMES]
    levels = [str(n) for n in getattr(index, "names", ()) if str(n) in free]
    if not dated and not named and getattr(index, "nlevels", 1) > 1 and len(levels) == 1:
        return levels[0]
    return next(iter(dated or named), None)


def _is_dates(column: Any) -> bool:
    array = np.asarray(column)
    if array.dtype.kind not in "OUT" or not array.size:
        return False
    return hasattr(array.ravel()[0], "isoformat") or is_dated(array)


def _unnamed(what: str, frame: Any, taken: Sequence[str] = ()) -> _Times | None:
    """Times of an index without a name of its own, or with one that says nothing else."""
    index = _index(frame)
    if index is None or getattr(index, "name", None) in taken or is_default(list(index)):
        return None
    return _times(what, None, index)


def _index(frame: Any) -> Any:
    """The index of a pandas object, where it has one level."""
    index = getattr(frame, "index", None)
    if index is None or isinstance(frame, (list, tuple, str)) or callable(index):
        return None
    return None if getattr(index, "nlevels", 1) > 1 else index


def _times(what: str, name: str | None, labels: Any) -> _Times:
    """Times of rows; texts are dates as ISO 8601 writes them.

    Raises
    ------
    EvidenceError
        Other texts.
    """
    wall = clock(labels)
    if is_text(wall):
        texts = wall.tolist()
        off = next(v for v in texts if v is not None and not is_dated([v]))
        where = "the index" if name is None else f"{name!r}"
        given = "frame.index" if name is None else f"frame[{name!r}]"
        drop = (
            "leave the labels out (reset_index(drop=True)) if rows are in the order of time"
            if name is None
            else "drop it if rows are in the order of time"
        )
        raise EvidenceError(
            f"{what}: rows are slices of time, and {where} labels them with texts ({off!r}) that are no "
            f"dates like '2024-01-31', so whether rows are in order cannot be told; give "
            f"pd.to_datetime({given}, format=...) or numbers, or {drop}"
        )
    if wall.dtype.kind != "M":
        return _Times(wall, wall)
    return _Times(wall, clock(labels, zone=True), zone_of(labels))


def _index_of(template: Template, observations: Mapping[str, Any]) -> _Times | None:
    """Times that a Series (or a table of one node) in a dict brings along."""
    for name, value in observations.items():
        if name in template.later and name not in template.static and _index(value) is not None:
            oriented(repr(name), value, template.later[name].plates, template.plates.labels, 1)
            found = _unnamed(repr(name), value)
            if found is not None:
                _check_order(repr(name), found.instants)
                return found
    return None


def _check_known(what: str, times: np.ndarray) -> None:
    if times.dtype.kind in "fM" and bool(np.any(times != times)):
        gap = int(np.flatnonzero(times != times)[0])
        raise EvidenceError(f"{what}: row {gap} has no time; drop the row")


def _check_order(what: str, times: np.ndarray) -> None:
    if np.ndim(times) != 1 or times.dtype.kind not in "iufMm":
        return
    _check_known(what, times)
    for k in np.flatnonzero(times[1:] <= times[:-1])[:1].tolist():
        if times[k + 1] == times[k]:
            raise EvidenceError(
                f"{what}: rows {k} and {k + 1} are both of time {_said(times[k])}; a slice has one row, and "
                "several things that were seen at a time are a plate (plates=, with a column of labels)"
            )
        raise EvidenceError(
            f"{what}: row {k + 1} is of time {_said(times[k + 1])}, before {_said(times[k])} of row "
            f"{k}; row k "
            "belongs to slice k, so sort the rows by time"
        )


def _check_alike(one: _Times | None, other: _Times | None) -> None:
    """Inputs may go on for longer than observations."""
    if one is None or other is None:
        return
    times, others = one.instants, other.instants
    count = min(len(times), len(others))
    zoned = one.instants is not one.wall and (
        (one.instants != one.wall).any() or (other.instants != other.wall).any()
    )
    for k in range(count):
        if times.dtype.kind == others.dtype.kind and times[k] == others[k]:
            continue
        if times.dtype.kind in "iuf" and others.dtype.kind in "iuf" and times[k] == others[k]:
            continue
        by = " (as instants, by UTC)" if zoned else ""
        raise EvidenceError(
            f"row {k} of the observations is of time {_said(times[k])}, and that of the inputs of "
            f"{_said(others[k])}{by}; row k of both belongs to slice k, so bring them to the same times"
        )


def _check_indexes(template: Template, observations: Any, inputs: Any) -> None:
    """Indexes of observations and of inputs that say nothing of time agree, too, position by position."""
    seen: tuple[str, list[Any]] | None = None
    both = is_frame(observations) and is_frame(inputs)
    for what, data in (("observations", observations), ("inputs", inputs)):
        parts = {what: data} if is_frame(data) else data if isinstance(data, Mapping) else {}
        for name, value in parts.items():
            if isinstance(value, np.ndarray) or name in template.static or _index(value) is None:
                continue
            if is_frame(value) and name == what and _is_told(what, template, value):
                continue
            if value is not data:
                check_frame(f"{what} of {name!r}", value)
            own = list(_index(value))
            other, before = seen = seen or (name, own)
            count = min(len(own), len(before))
            k = next((k for k in range(count) if own[k] != before[k]), None)
            if k is not None and not (both and _is_clock(own, before)):
                raise EvidenceError(
                    f"{name!r} and {other!r} are labelled unlike along 'time': row {k} is {own[k]!r} in one "
                    f"and {before[k]!r} in the other; row k belongs to slice k, so bring them to the same "
                    "index (reindex), or give .to_numpy()"
                )


def _is_told(what: str, template: Template, frame: Any) -> bool:
    """Whether a column says of which time rows are, or of which element, whatever the index."""
    columns = columns_of(frame, what)
    told = _time_column(what, template, columns, None) is not None
    return told or any(p in columns for p in template.plates.sizes)


def _is_clock(own: list[Any], before: list[Any]) -> bool:
    """Whether both are dates, which are compared as times."""
    return all(
        np.asarray(clock(np.array(v, dtype=object))).dtype.kind == "M" for v in (own, before)
    )


def _check_even(template: Template, given: _Times, inputs: Mapping[str, Any]) -> None:
    """Rows belong to slices one after the other, so time between them is the same, or an input.

    Days are even by the clock on the wall, hours by that of Greenwich.
    """
    times = given.instants
    if times.dtype.kind not in "iufM" or len(times) < 2:
        return
    if is_even(times) or is_even(given.wall):
        return
    if any(_tells(np.asarray(v), times) for v in inputs.values()):
        return
    k, times = uneven_at(times), given.wall
    raise EvidenceError(
        f"the rows are not at equal steps of time: from {_said(times[0])} to {_said(times[1])}, and from "
        f"{_said(times[k])} to {_said(times[k + 1])} (rows {k} and {k + 1}), and slices follow each "
        f"other evenly; "
        "fill the gaps with rows of NaN (pandas' asfreq, reindex), or declare the time that passes "
        "as an input of "
        "the template and give it (any steps will do then), or leave the times out "
        "(reset_index(drop=True)) if "
        "slices do not go by the clock"
    )


def _check_zero(what: str, template: Template, times: np.ndarray) -> None:
    """Rows labelled ``t`` are those of the template's ``t``, where that is read."""
    every = [*template.later.values(), *template.first.values()]
    reads = any(parent in (TIME, f"{TIME}_prev") for d in every for parent in d.parents)
    if reads and len(times) and times[0] != 0:
        raise EvidenceError(
            f"{what}: rows are labelled from t = {times[0]} on, and the template reads t, which is "
            f"0 in the first "
            "slice; give rows from 0 on (those without data as NaN), or call the column otherwise"
        )


def _tells(values: np.ndarray, times: np.ndarray) -> bool:
    """Whether an input is the time of each row, or that since the row before, in whatever unit."""
    if values.ndim != 1 or len(values) < len(times) or values.dtype.kind not in "iuf":
        return False
    seconds = (
        clock(times).astype("datetime64[us]").astype(float) if times.dtype.kind == "M" else times
    )
    passed = np.diff(np.asarray(seconds, dtype=float))
    values = values[: len(times)].astype(float)
    return _proportional(values[1:], passed) or _proportional(np.diff(values), passed)


def _proportional(values: np.ndarray, others: np.ndarray) -> bool:
    factor = float(values @ others) / max(float(others @ others), 1e-300)
    near = np.abs(values - factor * others) <= 1e-3 * np.abs(factor * others).max()
    return factor > 0 and bool(near.all())


def _said(time: Any) -> str:
    text = str(time)
    return text.removesuffix(".000000000").removesuffix(".000000").removesuffix("T00:00:00")
