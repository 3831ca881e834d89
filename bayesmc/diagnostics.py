"""How far a sample can be trusted: effective sizes, Monte Carlo errors, tails of weights.

Chains are judged by ArviZ (``arviz_stats``), imported when first needed; weighted draws by the delta
method of self-normalised importance sampling. Arrays have shape ``(chain, draw, ...)``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

#: below this effective size a weighted answer has no reliable error bar either
MIN_WEIGHT_ESS = 100.0
#: above this the weights' variance may be infinite (Vehtari et al. 2024, sec. 3.2.4)
MAX_PARETO_K = 0.7


def log_sum_exp(log_values: np.ndarray, axis: Any = None) -> Any:
    """``log(sum(exp(log_values)))`` without overflow; minus infinity for an empty or zero sum."""
    top = np.max(log_values, axis=axis, keepdims=True, initial=-np.inf)
    safe = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.sum(np.exp(log_values - safe), axis=axis, keepdims=True)) + safe
    return total.item() if axis is None else np.squeeze(total, axis=axis)


def normalised(log_weights: np.ndarray) -> np.ndarray:
    """Weights that sum to 1, through log-sum-exp."""
    weights = np.exp(log_weights - np.max(log_weights))
    return weights / weights.sum()


def weight_ess(log_weights: np.ndarray) -> float:
    """Effective number of equally weighted draws, ``(sum w)**2 / sum w**2`` (Kong 1992)."""
    weights = np.exp(log_weights - np.max(log_weights))
    return float(weights.sum() ** 2 / (weights**2).sum())


def pareto_k(top_log_weights: np.ndarray, draws: int) -> float:
    """Shape of the generalised Pareto tail of the weights (Vehtari et al. 2024).

    Parameters
    ----------
    top_log_weights : ndarray
        At least the ``tail_length(draws)`` largest log weights and some below them, in any order.
    draws : int
        Number of weights in all, which fixes the length of the tail.

    Notes
    -----
    Minus infinity where all weights in the tail are equal: there is no tail.
    """
    from arviz_stats.base import array_stats

    length = tail_length(draws)
    top = np.sort(top_log_weights)
    if draws < 25 or len(top) <= length:
        return float("nan")
    tail, below = top[-length:], top[:-length]
    if tail[-1] - tail[0] <= 1e-9:
        return -np.inf
    # Weights of discrete nets are tied; the cut must lie strictly below the tail, or its lower
    # quarter has no excess and the fit divides by zero. The tail's length is ours: ArviZ takes
    # min(n / 5, 3 sqrt(n / r_eff)) of n weights, and n / 5 is it by construction.
    lower = below[below < tail[0] - 1e-12]
    cut = lower[-1] if len(lower) else tail[0] - 1e-6
    weights = np.concatenate([np.full(4 * length, cut), tail])
    weights = np.maximum(weights, tail[-1] - 700.0)
    with np.errstate(all="ignore"):
        _, k = array_stats.psislw(-weights, r_eff=min(1.0, 44.0 / length))
    return float(k)


def tail_length(draws: int) -> int:
    """Number of largest weights that make up the tail."""
    return int(np.ceil(min(0.2 * draws, 3 * np.sqrt(draws))))


def weighted_mean(values: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Mean over the two leading axes (chain, draw); ``weights`` sum to 1."""
    if weights is None:
        return np.mean(values, axis=(0, 1))
    return weighted_sum(values, weights)


def weighted_sum(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum of ``weights * values`` over (chain, draw); a weight of zero silences even infinity."""
    with np.errstate(invalid="ignore"):
        total = np.tensordot(weights, values, axes=([0, 1], [0, 1]))
    if np.isfinite(total).all():
        return total
    lead = (weights > 0).reshape(weights.shape + (1,) * (values.ndim - 2))
    return np.tensordot(weights, np.where(lead, values, 0.0), axes=([0, 1], [0, 1]))


def weighted_mcse(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Standard error of a self-normalised weighted mean (Owen 2013, eq. 9.9)."""
    with np.errstate(invalid="ignore", over="ignore"):
        centred = values - weighted_mean(values, weights)
        return np.sqrt(weighted_sum(centred**2, weights**2))


def weighted_ess(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Number of independent draws from the posterior with the same error; the weights' own for constants."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        centred = values - weighted_mean(values, weights)
        variance = weighted_sum(centred**2, weights)
        error = weighted_sum(centred**2, weights**2)
        return np.where(error > 0, variance / error, 1.0 / np.sum(weights**2))


def chain_statistic(kind: str, values: np.ndarray) -> np.ndarray:
    """ArviZ's ``ess``, ``rhat`` or ``mcse`` of every scalar, shape ``values.shape[2:]``; NaN if undefined."""
    from arviz_stats.base import array_stats

    if values.shape[1] < 4 or not values.size:
        return np.full(values.shape[2:], np.nan)
    function = getattr(array_stats, kind)
    flat = np.moveaxis(values.reshape(values.shape[:2] + (-1,)), -1, 0)
    out = []
    for one in flat.astype(float):
        if np.ptp(one) == 0:
            out.append({"ess": float(one.size), "rhat": np.nan, "mcse": 0.0}[kind])
        else:
            with np.errstate(all="ignore"):
                out.append(float(function(one, chain_axis=0, draw_axis=1)))
    return np.array(out).reshape(values.shape[2:])
