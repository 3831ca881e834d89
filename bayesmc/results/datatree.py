"""Draws as an ArviZ ``DataTree``: which groups, with what names of dimensions and coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import missing_extra
from bayesmc.network import Observed
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
    free = [n for n in posterior.names if posterior._is_free(n)]
    groups = {"posterior": {n: _labelled(posterior[n]) for n in free}}
    seen = {n: _with_gaps(model[n].decode(o.value), o) for n, o in posterior._seen.items()}
    if seen:
        groups["observed_data"] = {n: _labelled(v) for n, v in seen.items()}
    diverged = getattr(posterior, "divergences", None)
    if diverged is not None:
        groups["sample_stats"] = {"diverging": diverged}
    dims = {
        n: [*model[n].plates, *(f"{n}_dim_{i}" for i in range(len(model[n].event_shape)))]
        for n in [*free, *seen]
    }
    coords = {p: list(model.labels.get(p, range(n))) for p, n in model.sizes.items()}
    return arviz_base.from_dict(groups, dims=dims, coords=coords)


# ---- private ------------------------------------------------------------------------------------


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
