"""Columns and tables of other libraries as arrays: pandas, polars and pyarrow, none of which is imported.

A column is told by what it can do: ``isna`` (pandas), ``null_count`` (polars, pyarrow). What is missing
(None, NaN, NA, null) is NaN among numbers and None among labels; categories are what they stand for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from numbers import Number
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError

_ISO = re.compile(
    r"\d{4}-\d{2}(-\d{2}([T ]\d{2}:\d{2}(:\d{2}(\.\d+)?)?(?P<offset>Z|[+-]\d{2}:?\d{2})?)?)?$"
)
_PLAIN = (np.ndarray, list, tuple, str, int, float, dict)


def is_frame(data: Any) -> bool:
    """Whether something is a table with named columns (and no dict)."""
    if data is None or isinstance(data, (*_PLAIN, Mapping)):
        return False
    named = hasattr(data, "column_names") or hasattr(data, "columns")
    return named and hasattr(data, "__getitem__") and not hasattr(data, "dims")


def is_column(value: Any) -> bool:
    """Whether something is one column of polars or pyarrow, which has no labels of its own."""
    return not isinstance(value, _PLAIN) and hasattr(value, "null_count") and not is_frame(value)


def array_of(value: Any) -> np.ndarray:
    """A column (or a table of like columns) as an array: numbers with NaN, or objects with None.

    A column whose entries are lists is one of vectors, shape (rows, length).

    Examples
    --------
    >>> from bayesmc.network.columns import array_of
    >>> array_of(["yes", None]).tolist(), array_of([1, None]).tolist()
    (['yes', None], [1.0, nan])
    """
    if getattr(getattr(value, "dtype", None), "time_zone", None) is not None:  # polars', kept
        return _objects(value.to_list())
    if hasattr(value, "to_pylist"):  # pyarrow's, whose dictionaries are no arrays
        array = _objects(value.to_pylist()) if _is_coded(value) else np.asarray(value)
    else:
        array = np.asarray(value, dtype=object) if isinstance(value, list) else np.asarray(value)
    if array.dtype.kind != "O":
        return array
    if hasattr(value, "isna"):
        missing = np.asarray(value.isna(), dtype=bool)
    else:
        missing = np.reshape([_is_missing(v) for v in array.ravel().tolist()], array.shape)
    return _settled(array, missing.astype(bool))


def columns_of(data: Any, who: str = "fit") -> dict[str, Any]:
    """Name -> column as an array, of a table; a dict as it is.

    Named levels of a pandas index count as columns. Columns in two levels come as tables, by the first.

    Raises
    ------
    EvidenceError
    """
    if isinstance(data, Mapping):
        return dict(data)
    if not is_frame(data):
        raise EvidenceError(
            f"{who}: data are a {type(data).__name__}; give a dict from name to values, or a data frame with "
            "a column for each node"
        )
    if hasattr(data, "collect") and not hasattr(data, "to_dict"):
        raise EvidenceError(f"{who}: data are a {type(data).__name__}; give its .collect()")
    names = list(data.column_names if hasattr(data, "column_names") else data.columns)
    if getattr(getattr(data, "columns", None), "nlevels", 1) > 1:
        tops = list(dict.fromkeys(name[0] for name in names))
        return {**_levels(data, tops), **{str(top): data[top] for top in tops}}
    if len(set(map(str, names))) < len(names):
        twice = next(n for k, n in enumerate(names) if n in names[:k])
        raise EvidenceError(f"{who}: the data have two columns {twice!r}; drop one of them")
    found = {str(name): array_of(data[name]) for name in names}
    return {**_levels(data, found), **found}


def rows_of(data: Any, who: str) -> list[dict[str, Any]]:
    """The rows of a table as dicts, without what is missing.

    Raises
    ------
    EvidenceError
    """
    columns = columns_of(data, who)
    missing = {n: [_is_missing(v) for v in c.tolist()] for n, c in columns.items()}
    count = len(next(iter(columns.values()), ()))
    return [{n: c[k] for n, c in columns.items() if not missing[n][k]} for k in range(count)]


@dataclass(frozen=True, eq=False)
class Labelled:
    """Numbers and the index (and columns) that they came with."""

    values: np.ndarray
    index: Any
    columns: Any = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the numbers."""
        return self.values.shape

    @property
    def T(self) -> Labelled:  # noqa: N802
        """The first two axes exchanged."""
        return Labelled(np.swapaxes(self.values, 0, 1), self.columns, self.index)

    def to_numpy(self) -> np.ndarray:
        """The numbers alone."""
        return self.values

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype)

    def __len__(self) -> int:
        return len(self.values)


def clock(labels: Any, zone: bool = False) -> np.ndarray:
    """Labels of time as an array: as a clock on the wall shows them, or with ``zone`` that of Greenwich."""
    if getattr(labels, "tz", None) is not None:  # pandas'
        labels = labels.tz_convert(None) if zone else labels.tz_localize(None)
    elif hasattr(labels, "to_timestamp"):  # pandas' periods
        labels = labels.to_timestamp()
    array = np.asarray(labels)
    if array.dtype.kind in "OUT" and array.size and is_text(array):
        return _dates(array, zone)
    if array.dtype.kind == "O" and any(hasattr(v, "isoformat") for v in array[:1].tolist()):
        plain = [_bare(v, zone) for v in array.tolist()]
        return np.array(plain, dtype="datetime64[us]")
    return array


def zone_of(labels: Any) -> tzinfo | None:
    """The zone that labels of time are all in; None where they are in none, or in several."""
    found = getattr(labels, "tz", None)
    if found is not None or hasattr(labels, "tz"):
        return found
    array = np.asarray(labels)
    if array.dtype.kind != "O":
        return None
    zones = {str(z): z for z in (getattr(v, "tzinfo", None) for v in array.ravel().tolist())}
    return next(iter(zones.values())) if len(zones) == 1 else None


def on_the_wall(instants: np.ndarray, zone: tzinfo) -> np.ndarray:
    """Instants, by the clock of Greenwich, as clocks in a zone show them.

    Examples
    --------
    >>> from datetime import timedelta, timezone
    >>> import numpy as np
    >>> from bayesmc.network.columns import on_the_wall
    >>> instants, zone = np.array(["2024-01-31T23:00"], "M8[m]"), timezone(timedelta(hours=2))
    >>> on_the_wall(instants, zone).astype(str).tolist()
    ['2024-02-01T01:00:00.000000']
    """
    plain = instants.astype("datetime64[us]").tolist()
    shown = [v.replace(tzinfo=UTC).astimezone(zone).replace(tzinfo=None) for v in plain]
    return np.array(shown, dtype="datetime64[us]")


def is_text(labels: Any) -> bool:
    """Whether labels are texts, some of them perhaps missing."""
    known = [v for v in np.asarray(labels).ravel().tolist() if not _is_missing(v)]
    return bool(known) and all(isinstance(v, str) for v in known)


def is_dated(labels: Any) -> bool:
    """Whether labels are texts that are all dates as ISO 8601 writes them (or missing).

    Examples
    --------
    >>> from bayesmc.network.columns import is_dated
    >>> is_dated(["2024-01-31", None]), is_dated(["31/01/2024"])
    (True, False)
    """
    return is_text(labels) and clock(labels).dtype.kind == "M"


# ---- private ------------------------------------------------------------------------------------


def _dates(texts: np.ndarray, zone: bool) -> np.ndarray:
    """Texts as dates where all are some; else as they are."""
    plain: list[Any] = []
    for text in texts.tolist():
        if _is_missing(text):
            plain.append(np.datetime64("NaT"))
            continue
        match = _ISO.match(text.strip())
        if match is None:
            return texts
        try:
            if match["offset"]:
                plain.append(np.datetime64(_bare(datetime.fromisoformat(text.strip()), zone)))
            else:
                plain.append(np.datetime64(text.strip().replace(" ", "T")))
        except ValueError:
            return texts
    return np.array(plain, dtype="datetime64[us]")


def _levels(data: Any, names: Any) -> dict[str, np.ndarray]:
    """Named levels of an index, by name, where no column is called so."""
    index: Any = getattr(data, "index", None)
    own = getattr(index, "names", None) or ()
    return {
        str(name): _level(index.get_level_values(k))
        for k, name in enumerate(own)
        if name is not None and str(name) not in names
    }


def _level(labels: Any) -> np.ndarray:
    """Labels of a level; times keep their zone."""
    zoned = getattr(labels, "tz", None) is not None
    return np.asarray(labels, dtype=object) if zoned else clock(labels)


def _bare(time: Any, zone: bool) -> Any:
    """A date or time without its zone."""
    if getattr(time, "tzinfo", None) is None:
        return time
    return (time.astimezone(UTC) if zone else time).replace(tzinfo=None)


def _is_coded(column: Any) -> bool:
    kind = str(getattr(column, "type", ""))
    coded = kind.startswith(("dictionary", "list", "large_list", "fixed_size_list", "decimal"))
    return coded or (kind.startswith("timestamp") and "tz=" in kind)


def _objects(values: list[Any]) -> np.ndarray:
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array


def _is_missing(value: Any) -> bool:
    if value is None:
        return True
    return isinstance(value, (float, np.floating)) and math.isnan(value)


def _settled(array: np.ndarray, missing: np.ndarray) -> np.ndarray:
    known = array[~missing].tolist()
    if known and array.ndim == 1 and all(isinstance(v, (list, tuple, np.ndarray)) for v in known):
        shapes = {np.shape(v) for v in known}
        if len(shapes) == 1:
            rows = np.full((len(array), *shapes.pop()), np.nan)
            rows[~missing] = np.stack([np.asarray(v, dtype=float) for v in known])
            return rows
    if known and all(isinstance(v, (Number, np.bool_)) for v in known):
        if not missing.any():
            return np.reshape(np.array(known), array.shape)
        filled = np.full(array.shape, np.nan)
        filled[~missing] = np.array(known, dtype=float)
        return filled
    if not known:
        return np.full(array.shape, np.nan)
    settled = array.copy()
    settled[missing] = None
    return settled
