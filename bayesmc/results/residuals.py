"""Do innovations look like independent standard normal numbers? A table of chances, number by number."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import chdtr, chdtrc, ndtr

from bayesmc.errors import QueryError
from bayesmc.network import Model
from bayesmc.results.table import Summary

#: innovations below which nothing is judged
_FEWEST = 8


def check_residuals(model: Model, innovations: Mapping[str, np.ndarray], lags: int) -> Summary:
    """See ``SeriesPosterior.residual_check``.

    Parameters
    ----------
    innovations : dict
        Node -> shape ``(time, *plates, *event)``, NaN where nothing was compared.
    """
    if isinstance(lags, bool) or not isinstance(lags, (int, np.integer)) or lags < 1:
        raise QueryError(f"residual_check(lags={lags!r}): lags is a whole number, 1 or more")
    names: list[str] = []
    rows: list[dict[str, float]] = []
    for name, values in innovations.items():
        for at in np.ndindex(values.shape[1:]):
            own = [
                str(model.labels[p][i]) if p in model.labels else str(i)
                for p, i in zip(model[name].plates, at, strict=False)
            ]
            own += [str(i) for i in at[len(own) :]]
            names.append(f"{name}[{', '.join(own)}]" if at else name)
            rows.append(_figures(values[(slice(None), *at)], int(lags)))
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]} if rows else {}
    return Summary(tuple(names), columns, f"innovations, {lags} lags")


# ---- private ------------------------------------------------------------------------------------


def _figures(values: np.ndarray, lags: int) -> dict[str, float]:
    known = np.isfinite(values)
    found, n = values[known], int(known.sum())
    nan = float("nan")
    figures = {"count": float(n), "mean": nan, "sd": nan}
    figures |= dict.fromkeys(("p_mean", "p_sd", "p_autocorrelation", "p_normality"), nan)
    if n < _FEWEST:
        return figures
    figures["mean"], figures["sd"] = float(found.mean()), float(np.sqrt(np.mean(found**2)))
    figures["p_mean"] = float(2 * ndtr(-abs(found.sum()) / np.sqrt(n)))
    below = float(chdtr(n, float(found @ found)))
    figures["p_sd"] = 2 * min(below, 1 - below)
    figures["p_autocorrelation"] = _ljung_box(values, known, lags)
    centred = found - found.mean()
    spread = float(np.mean(centred**2))
    if spread > 0:
        skew, kurtosis = np.mean(centred**3) / spread**1.5, np.mean(centred**4) / spread**2
        figures["p_normality"] = float(chdtrc(2, n / 6 * (skew**2 + (kurtosis - 3) ** 2 / 4)))
    return figures


def _ljung_box(values: np.ndarray, known: np.ndarray, lags: int) -> float:
    """Ljung and Box (1978), Biometrika 65, eq. 1.5; of pairs both of which were compared."""
    n = int(known.sum())
    centred = np.where(known, values - values[known].mean(), 0.0)
    total = float(centred @ centred)
    used, statistic = 0, 0.0
    for lag in range(1, min(lags, len(values) - 1) + 1):
        pairs = int((known[lag:] & known[:-lag]).sum())
        if pairs < 2 or not total > 0:
            continue
        r = float(centred[lag:] @ centred[:-lag]) / total
        # with gaps there are fewer products than n - lag
        statistic += n * (n + 2) * r * r / min(pairs, n - lag)
        used += 1
    return float(chdtrc(used, statistic)) if used else float("nan")
