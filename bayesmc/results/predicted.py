"""Statistics of what was observed beside those of data that the posterior predicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.results.over_time import slices_of
from bayesmc.results.table import Summary

Statistic = Callable[[np.ndarray], Any]
_USUAL: Mapping[str, Statistic] = MappingProxyType(
    {"mean": np.mean, "sd": np.std, "min": np.min, "max": np.max}
)


def check_predictions(
    posterior: Any,
    name: str,
    statistics: Mapping[str, Statistic] | None,
    rng: Any,
    draws: int | None,
) -> Summary:
    """See ``Posterior.predictive_check``."""
    model = posterior.model
    rows = slices_of(model, name) or (name,)
    for row in rows:
        posterior._numeric(row, "predictive_check")
    seen = [posterior._seen.get(row) for row in rows]
    if any(part is None or part.mask is not None for part in seen):
        raise QueryError(
            f"predictive_check({name!r}): it compares nodes that were observed in full; this one was "
            "not, so ask "
            "predict(name) and compare what was seen with it"
        )
    data = np.stack([model[row].decode(p.value) for row, p in zip(rows, seen, strict=True)])
    drawn = posterior.predict(name, rng=rng, draws=draws)
    predicted = np.asarray(drawn[name])
    predicted = predicted.reshape((-1, *predicted.shape[2:]))
    if name in model.nodes:
        data = data[0]
    chosen = _USUAL if statistics is None else statistics
    figures = [_figures(label, function, data, predicted) for label, function in chosen.items()]
    columns = {key: np.array([row[key] for row in figures]) for key in figures[0]}
    return Summary(tuple(chosen), columns, f"{name}: observed, and {len(predicted)} predictions")


# ---- private ------------------------------------------------------------------------------------


def _figures(
    label: str, function: Statistic, data: np.ndarray, predicted: np.ndarray
) -> dict[str, float]:
    values = np.array([_number(label, function, one) for one in predicted])
    own = _number(label, function, data)
    low, high = np.quantile(values, [0.05, 0.95])
    above = np.mean(values > own) + 0.5 * np.mean(values == own)
    return {
        "observed": own,
        "predicted": float(values.mean()),
        "5%": float(low),
        "95%": float(high),
        "p": float(above),
    }


def _number(label: str, function: Statistic, data: np.ndarray) -> float:
    found = np.asarray(function(data))
    if found.ndim or found.dtype.kind not in "biuf":
        raise UnsupportedError(
            f"predictive_check: the statistic {label!r} returns shape {found.shape}, {found.dtype}; "
            "it gets one data "
            "set and returns one number"
        )
    return float(found)
