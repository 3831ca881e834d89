"""Data as columns: frames by their columns, dicts as they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayesmc.errors import EvidenceError


def columns_of(data: Any) -> dict[str, Any]:
    """Name -> column.

    Whatever has ``columns`` and gives a column for a name counts as a data frame (pandas, polars, pyarrow's).

    Raises
    ------
    EvidenceError
    """
    if isinstance(data, Mapping):
        return dict(data)
    columns = getattr(data, "columns", None)
    if columns is not None and hasattr(data, "__getitem__"):
        return {str(name): data[name] for name in columns}
    raise EvidenceError(
        f"fit: data are a {type(data).__name__}; give a dict from name to values, or a data frame "
        "with a column for "
        "each node"
    )
