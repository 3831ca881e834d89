"""Series as users give them, before nodes are looked at: are rows alike, how many are there, which way up.

Nothing here knows a template.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError
from bayesmc.shapes import Shape


def check_steps(who: str, steps: Any) -> None:
    """Refuse what is no number of slices."""
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
        raise ValueError(f"{who}(steps={steps!r}): steps is a number of slices, 1 or more")


def count_of(
    observed: Mapping[str, Any], inputs: Mapping[str, Any], steps: int | None, ahead: int
) -> int:
    """The number of slices, which all data agree on; ``ahead`` of them have inputs alone."""
    lengths = {n: len(v) + ahead for n, v in observed.items()} | {
        n: len(v) for n, v in inputs.items()
    }
    wanted = {*lengths.values(), *(() if steps is None else (int(steps),))}
    if len(wanted) > 1:
        each = ", ".join(f"{n!r} {len(v)}" for n, v in {**observed, **inputs}.items())
        more = f"; asked for {steps} slices" if steps is not None else ""
        more += f"; inputs go on for {ahead} slices after the last row" if ahead else ""
        more += _transposed({**observed, **inputs})
        raise EvidenceError(
            f"the data differ in length ({each}{more}); row k belongs to slice k, and a missing row is NaN "
            "or None"
        )
    if not wanted and not ahead:
        raise EvidenceError("no observations and no inputs: give at least one series, time first")
    count = wanted.pop() if wanted else ahead
    if not count:
        raise EvidenceError(
            f"the series of {', '.join(map(repr, {**observed, **inputs}))} have no rows; give one per slice"
        )
    return count


def check_even(what: str, value: Any, hint: str) -> None:
    """Refuse lists whose rows differ in shape, with the first row that does."""
    if not isinstance(value, (list, tuple)) or not value:
        return
    shapes = [_shape_of(row) for row in value]
    usual = max(set(shapes) - {None}, key=shapes.count, default=None)
    for k, shape in enumerate(shapes):
        if value[k] is None and usual in ((), None) and "missing" in hint:
            continue  # numbers, some of them missing
        if shape != usual:
            got = "None" if value[k] is None else "ragged" if shape is None else f"of shape {shape}"
            raise EvidenceError(
                f"{what}: row {k} is {got}, others are of shape {usual}; rows are alike, and {hint}"
            )


def check_frame(what: str, value: Any) -> None:
    """Refuse a table whose labels say that time runs along its columns, square or not."""
    columns, index = getattr(value, "columns", None), getattr(value, "index", None)
    if columns is None or index is None:
        return
    kinds = [np.asarray(labels).dtype.kind for labels in (index, columns)]
    names = [str(getattr(labels, "name", None) or "").lower() for labels in (index, columns)]
    times = [
        k == "M" or n in ("t", "time", "step", "slice") for k, n in zip(kinds, names, strict=True)
    ]
    if times == [False, True]:
        raise EvidenceError(
            f"{what}: by its labels the table has time along its columns; time comes first, so give its .T"
        )


def is_plain(data: Any) -> bool:
    """Whether data are a dict (or none) of what has no index of its own."""
    if data is None:
        return True
    if not isinstance(data, dict):
        return False
    listed = (np.ndarray, list, tuple, str)
    return not any(not isinstance(v, listed) and hasattr(v, "index") for v in data.values())


def is_missing(row: Any) -> bool:
    """Whether a whole row is missing."""
    if row is None or row is np.ma.masked:
        return True
    if isinstance(row, np.ma.MaskedArray) and np.ma.getmaskarray(row).all():
        return True
    if isinstance(row, (list, tuple)):
        return bool(row) and all(is_missing(r) for r in row)
    array = np.asarray(row)
    return array.dtype.kind == "f" and array.size > 0 and bool(np.isnan(array).all())


# ---- private ------------------------------------------------------------------------------------


def _shape_of(row: Any) -> Shape | None:
    try:
        return None if row is None else np.shape(row)
    except ValueError:
        return None


def _transposed(data: Mapping[str, Any]) -> str:
    """A hint where one series has along its second axis what the others have along the first."""
    if len(data) < 2:
        return ""
    lengths = [len(v) for v in data.values()]
    usual = max(set(lengths), key=lengths.count)
    for name, value in data.items():
        shape = np.shape(value)
        if len(shape) > 1 and shape[0] != usual == shape[1]:
            return (
                f"; {name!r} has shape {shape}: is it transposed? time comes first, so give its .T"
            )
    return ""
