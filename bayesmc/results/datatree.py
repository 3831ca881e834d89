"""Draws as an ArviZ ``DataTree``: which groups, with what names of dimensions and coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from bayesmc.errors import missing_extra
from bayesmc.network import Model, Observed
from bayesmc.results.over_time import slices_of
from bayesmc.results.posterior import Posterior
from bayesmc.states import StateArray


def datatree(posterior: Posterior) -> Any:
    """The draws and data of a posterior with equally weighted draws.

    Raises
    ------
    MissingExtraError
        Without arviz-base, or without xarray, which it needs for this (the extra ``arviz``).
    """
    try:
        import arviz_base
        import xarray  # noqa: F401
    except ImportError as error:
        package = (error.name or "arviz-base").partition(".")[0].replace("_", "-")
        raise missing_extra(package, "arviz") from None
    model = posterior.model
    free = _by_template(model, [n for n in posterior.names if posterior._is_free(n)])
    groups = {"posterior": {n: _labelled(posterior[n]) for n in free}}
    seen = {n: _with_gaps(model[n].decode(o.value), o) for n, o in posterior._seen.items()}
    data = {
        n: _over_time([seen.get(row) for row in rows])
        for n, rows in _by_template(model, seen, partly=True).items()
    }
    if data:
        groups["observed_data"] = data
    told = {"diverging": "divergences", "energy": "energies"}
    kept = {n: getattr(posterior, own, None) for n, own in told.items()}
    stats = {n: found for n, found in kept.items() if found is not None}
    if stats:
        groups["sample_stats"] = stats
    dims = {}
    for name, rows in {**free, **_by_template(model, seen, partly=True)}.items():
        node = model[rows[0]]
        own = [*node.plates, *(f"{name}_dim_{i}" for i in range(len(node.event_shape)))]
        dims[name] = own if rows == (name,) else ["time", *own]
    coords = {p: list(model.labels.get(p, range(n))) for p, n in model.sizes.items()}
    return arviz_base.from_dict(groups, dims=dims, coords=coords)


# ---- private ------------------------------------------------------------------------------------


def _by_template(
    model: Model, names: Iterable[str], partly: bool = False
) -> dict[str, tuple[str, ...]]:
    """Nodes, and the slices of an unrolled template by its name, where all (or some) are there."""
    listed = list(names)
    found: dict[str, tuple[str, ...]] = {}
    for name in listed:
        base = name.rpartition("[")[0]
        rows = slices_of(model, base) if name.endswith("]") else None
        whole = rows is not None and (partly or set(rows) <= set(listed))
        found[base if whole else name] = rows if whole and rows is not None else (name,)
    return found


def _over_time(rows: Sequence[Any]) -> np.ndarray:
    """What was observed, time first where there are slices; NaN (None for labels) in those without data."""
    if len(rows) == 1:
        return _labelled(rows[0])
    known = [None if row is None else _labelled(row) for row in rows]
    one = next(row for row in known if row is not None)
    if all(row is not None for row in known):
        return np.stack(known)  # type: ignore[arg-type]
    is_number = one.dtype.kind in "biuf"
    gap = np.full(one.shape, np.nan if is_number else None, dtype=float if is_number else object)
    return np.stack([gap if row is None else row.astype(gap.dtype) for row in known])


def _labelled(values: np.ndarray) -> np.ndarray:
    """Plain values: labels where there are labels."""
    return values.labels if isinstance(values, StateArray) else np.asarray(values)


def _with_gaps(values: np.ndarray, seen: Observed) -> np.ndarray:
    """Observed values with NaN (None for labels) where nothing was observed."""
    if seen.mask is None:
        return values
    if isinstance(values, StateArray):
        labels = values.labels.astype(object)
        labels[~seen.mask] = None
        return labels
    numbers = np.array(values, dtype=float)
    numbers[~seen.mask] = np.nan
    return numbers
