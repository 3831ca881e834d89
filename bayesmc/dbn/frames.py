"""Data frames over time: rows as slices, and whether the clock that labels them goes evenly.

Time is one plate more, the first. What labels it is the index, or a column of dates, or one that is called
like time; without any, row k is slice k. With a column called like a plate rows are about its elements,
one for each slice and element; else those are columns ``"x[a]"``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.dbn.calendar import is_even, uneven_at
from bayesmc.dbn.slices import TIME, Template
from bayesmc.errors import EvidenceError
from bayesmc.network.columns import clock, columns_of, is_frame
from bayesmc.network.frames import names_of, read_table, with_inputs
from bayesmc.network.labels import is_default

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
    times = None
    if is_frame(observations):
        found, times = _read("observations", template, observations)
        inputs = with_inputs(found, inputs, template.later)
        observations = {n: v for n, v in found.items() if n not in template.inputs}
    if is_frame(inputs):
        inputs, own = _read("inputs", template, inputs)
        _check_alike(times, own)
        times = own if own is not None and (times is None or len(own) > len(times)) else times
    if times is None and isinstance(observations, Mapping):
        times = _index_of(template, observations)
    if times is not None:
        _check_even(template, times, inputs if isinstance(inputs, Mapping) else {})
    return observations, inputs, times


# ---- private ------------------------------------------------------------------------------------


def _read(what: str, template: Template, frame: Any) -> tuple[dict[str, Any], np.ndarray | None]:
    """Node -> its rows, time first, and their times."""
    later, plates = template.later, template.plates
    columns = columns_of(frame, what)
    axis = _time_column(what, template, columns, getattr(frame, "index", None))
    others = [axis] if axis is not None else []
    table = read_table(what, frame, later, plates.sizes, plates.labels, others)
    table = replace(table, index=None)
    times = _times(columns[axis]) if axis is not None else _unnamed(frame)
    names = names_of(table.columns, later)
    long = [n for n in names if any(p in table.keys for p in later[n].plates)]
    if long:
        if times is None:
            raise EvidenceError(
                f"{what}: rows say of which {next(iter(table.keys))!r} they are, and not of which "
                f"time; give a "
                "column or an index of times"
            )
        times, keys = np.unique(times, return_inverse=True)
        table = replace(
            table,
            keys={**table.keys, "time": keys.ravel()},
            given={**table.given, "time": times[keys]},
            sizes={**table.sizes, "time": len(times)},
        )
    elif times is not None:
        _check_order(what, times)
    if times is not None and TIME in (axis, getattr(getattr(frame, "index", None), "name", None)):
        _check_zero(what, template, times)
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
    return array.dtype.kind == "O" and array.size > 0 and hasattr(array.ravel()[0], "isoformat")


def _unnamed(frame: Any) -> np.ndarray | None:
    """Times of an index without a name of its own, or with one that says nothing else."""
    index = getattr(frame, "index", None)
    if index is None or callable(index) or getattr(index, "nlevels", 1) > 1:
        return None
    labels = list(index)
    return None if is_default(labels) or any(isinstance(v, str) for v in labels) else _times(index)


def _times(labels: Any) -> np.ndarray:
    """Times by the clock on the wall; by that of Greenwich where only that goes evenly."""
    wall = clock(labels)
    if wall.dtype.kind != "M":
        return wall
    unique = np.unique(wall)
    other = clock(labels, zone=True)
    return wall if is_even(unique) and len(unique) == len(np.unique(other)) else other


def _index_of(template: Template, observations: Mapping[str, Any]) -> np.ndarray | None:
    """Times that a Series (or a table of one node) in a dict brings along."""
    for name, value in observations.items():
        if name in template.later and name not in template.static and hasattr(value, "index"):
            found = None if callable(value.index) else _unnamed(value)
            if found is not None:
                return found
    return None


def _check_order(what: str, times: np.ndarray) -> None:
    if np.ndim(times) != 1 or times.dtype.kind not in "iufMm":
        return
    if times.dtype.kind in "fM" and bool(np.any(times != times)):
        gap = int(np.flatnonzero(times != times)[0])
        raise EvidenceError(f"{what}: row {gap} has no time; drop the row")
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


def _check_alike(times: np.ndarray | None, others: np.ndarray | None) -> None:
    """Inputs may go on for longer than observations."""
    if times is None or others is None:
        return
    count = min(len(times), len(others))
    for k in np.flatnonzero(times[:count] != others[:count])[:1].tolist():
        raise EvidenceError(
            f"row {k} of the observations is of time {_said(times[k])}, and that of the inputs of "
            f"{_said(others[k])}; row k of both belongs to slice k, so bring them to the same times"
        )


def _check_even(template: Template, times: np.ndarray, inputs: Mapping[str, Any]) -> None:
    """Rows belong to slices one after the other, so time between them is the same, or an input."""
    if times.dtype.kind not in "iufM" or len(times) < 2:
        return
    if is_even(times) or any(_tells(np.asarray(v), times) for v in inputs.values()):
        return
    k = uneven_at(times)
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
