"""How far a sample can be trusted: effective sizes, Monte Carlo errors, tails of weights.

Chains are judged by ArviZ's figures, worked out for all scalars at once: importing ArviZ takes longer than
many a run. Weighted draws are judged by the delta method of self-normalised importance sampling, and their
tail as ArviZ does. Arrays have shape ``(chain, draw, ...)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.special

#: below this effective size a weighted answer has no reliable error bar either
MIN_WEIGHT_ESS = 100.0
#: above this the weights' variance may be infinite (Vehtari et al. 2024, sec. 3.2.4)
MAX_PARETO_K = 0.7
#: failures and successes that are added to the variance of a share, z**2 for z = 2
_ADDED = 4.0
#: strength of the prior on scales, and draws that the prior on shapes counts as, and where that lies
_SCALES, _SHAPES, _SHAPE = 3.0, 10.0, 0.5


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
    length = tail_length(draws)
    top = np.sort(top_log_weights)
    if draws < 25 or len(top) <= length:
        return float("nan")
    tail, below = top[-length:], top[:-length]
    if tail[-1] - tail[0] <= 1e-9:
        return -np.inf
    # Weights of discrete nets are tied; the cut must lie strictly below the tail, or its lower
    # quarter has no excess and the fit divides by zero.
    lower = below[below < tail[0] - 1e-12]
    cut = np.exp(max((lower[-1] if len(lower) else tail[0] - 1e-6) - tail[-1], -700.0))
    return _pareto_shape(np.exp(np.maximum(tail - tail[-1], -700.0)) - cut)


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


def share_mcse(error: Any, count: Any, step: Any = 1.0) -> np.ndarray:
    """Standard error of a share, never zero: ``sqrt(error**2 + (2 * step / count)**2)``.

    What draws show of a share has no spread where all of them agree, and too little of it where few differ.
    As Agresti and Coull (1998) add ``z**2`` draws, half of them successes, this adds ``z**2 / count**2`` to
    the variance, with z = 2. So two standard errors about a share of independent draws hold the truth in 95 %
    of all cases and more, whatever it is and how many draws there are (95.1 % at the least); two about a
    share that was never seen reach to ``4 / count``, where the exact bound at that level is ``3.7 / count``
    (Clopper and Pearson 1934).

    Parameters
    ----------
    error : array_like
        Standard error as the draws show it.
    count : array_like
        Effective number of draws.
    step : array_like
        By how much the figure changes with one unseen state; 0 where it is no share.

    References
    ----------
    Agresti and Coull (1998), The American Statistician 52; Brown, Cai and DasGupta (2001), Statistical
    Science 16.

    Examples
    --------
    >>> from bayesmc.diagnostics import share_mcse
    >>> float(share_mcse(0.0, 1000))
    0.002
    """
    # an error of 1 / 2 leaves nothing out
    unseen = np.sqrt(_ADDED) / np.maximum(count, 2.0 * np.sqrt(_ADDED))
    return np.hypot(error, np.multiply(step, unseen))


def chain_statistic(
    kind: str, values: np.ndarray, block: int = 1, superchains: int = 0
) -> np.ndarray:
    """ArviZ's figure of every scalar of some chains, shape ``values.shape[2:]``; NaN if undefined.

    Parameters
    ----------
    kind : {"ess", "tail_ess", "mean_ess", "rhat", "mcse"}
        Bulk effective size; the smaller one of the 5 % and 95 % quantiles; that of the mean;
        rank-normalised split R-hat, the larger of the plain and the folded one; standard error of the
        mean.
    values : ndarray, shape (chain, draw, ...)
    block : int
        Draws of a chain come in turn from this many members of an ensemble. Neighbours are then nearly
        independent while draws ``block`` apart are not, so errors are those of the means of blocks, an
        effective size is a variance over a squared error (at most the number of draws). R-hat compares
        ensembles with the spread of the draws within them. Draws after the last whole block do not count.
    superchains : int
        Where it is 2 or more, R-hat is the nested one of so many equally large groups of consecutive chains,
        for chains that are many and short: groups are compared with the spread within them, so that it
        tells whether their starts are forgotten, however short each chain.

    Notes
    -----
    R-hat of one chain compares its halves as if they were two chains. Chains that stand still at different
    values have an infinite R-hat, and values that are all equal have none (NaN).

    References
    ----------
    Vehtari et al. (2021), Bayesian Analysis 16(2); Geyer (1992), Statistical Science 7(4); Margossian et al.
    (2024), Nested R-hat, Bayesian Analysis, eq. 4 to 8.

    Examples
    --------
    >>> import numpy as np
    >>> draws = np.random.default_rng(0).normal(size=(4, 1000))
    >>> chain_statistic("rhat", draws).round(2).item()
    1.0
    """
    (found,) = _by_scalar(values, block, lambda some: (_figures(kind, some, block, superchains),))
    return found


class ChainFigures(NamedTuple):
    """Figures of ``chain_statistic``; ``spread_ess`` is the bulk one of distances from the median."""

    ess: np.ndarray
    tail_ess: np.ndarray
    rhat: np.ndarray
    spread_ess: np.ndarray


def chain_figures(values: np.ndarray, block: int = 1, superchains: int = 0) -> ChainFigures:
    """All figures by which chains are judged, for little more than one of them: draws are ranked once.

    Parameters
    ----------
    values : ndarray, shape (chain, draw, ...)
    block, superchains : int
        As in ``chain_statistic``.

    Examples
    --------
    >>> import numpy as np
    >>> draws = np.random.default_rng(0).normal(size=(4, 1000))
    >>> found = chain_figures(draws)
    >>> bool(found.rhat == chain_statistic("rhat", draws)), bool(found.ess == chain_statistic("ess", draws))
    (True, True)
    """
    return ChainFigures(
        *_by_scalar(values, block, lambda some: _all_figures(some, block, superchains), 4)
    )


def normal_scores(values: np.ndarray) -> np.ndarray:
    """Values as quantiles of a standard Normal by their ranks, those of equal ones averaged.

    Parameters
    ----------
    values : ndarray, shape (scalar, ...)
        Ranked within each scalar.

    References
    ----------
    Blom (1958), Statistical Estimates and Transformed Beta-Variables; Vehtari et al. (2021), eq. 14.

    Examples
    --------
    >>> import numpy as np
    >>> normal_scores(np.array([[3.0, 1.0, 2.0]])).round(2).tolist()
    [[0.87, -0.87, 0.0]]
    """
    flat = values.reshape(len(values), -1)
    order = np.argsort(flat, axis=1)
    sorted_ = np.take_along_axis(flat, order, axis=1)
    size = flat.shape[1]
    new = np.ones(flat.shape, dtype=bool)
    np.not_equal(sorted_[:, 1:], sorted_[:, :-1], out=new[:, 1:])
    # quantiles of the ranks 1, 1.5, 2, ...: each is worked out once
    ranks = np.arange(1.0, size + 0.5, 1.0 if new.all() else 0.5)
    quantiles = scipy.special.ndtri((ranks - 0.375) / (size + 0.25))
    scores = np.empty(flat.shape)
    if new.all():
        np.put_along_axis(scores, order, quantiles[None], axis=1)
        return scores.reshape(values.shape)
    at = np.arange(size)
    first = np.maximum.accumulate(np.where(new, at, 0), axis=1)
    ends = np.ones(flat.shape, dtype=bool)
    ends[:, :-1] = new[:, 1:]
    last = np.minimum.accumulate(np.where(ends, at, size)[:, ::-1], axis=1)[:, ::-1]
    np.put_along_axis(scores, order, quantiles[first + last], axis=1)
    return scores.reshape(values.shape)


# ---- private: scalars of chains in whole blocks, shape (scalar, chain, draw) -----------------------


#: R-hat above which the variance within chains is but a rounding error: rank-normalised values of chains
#: that move at all stay far below
_STILL = 1e6
#: numbers that figures are worked out of at once
_AT_ONCE = 1 << 19


def _by_scalar(
    values: np.ndarray,
    block: int,
    figures: Callable[[np.ndarray], tuple[np.ndarray, ...]],
    count: int = 1,
) -> list[np.ndarray]:
    """Figures of whole blocks of draws, of some scalars at a time; NaN where there are too few."""
    chains, whole = values.shape[0], values.shape[1] // block * block
    if whole < 4 * block or not values.size:
        return [np.full(values.shape[2:], np.nan) for _ in range(count)]
    flat = values[:, :whole].reshape(chains, whole, -1)
    step = max(_AT_ONCE // (chains * whole), 1)
    with np.errstate(all="ignore"):
        found = []
        for at in range(0, flat.shape[2], step):
            some = np.array(np.moveaxis(flat[..., at : at + step], -1, 0), dtype=float, order="C")
            found.append(figures(some))
    return [np.concatenate(f).reshape(values.shape[2:]) for f in zip(*found, strict=True)]


def _all_figures(values: np.ndarray, block: int, superchains: int) -> tuple[np.ndarray, ...]:
    """Effective sizes in bulk and tails, R-hat, and the effective size of distances from the median."""
    lost = np.isnan(values).any(axis=(1, 2))
    tail = _ess("tail_ess", values, block)
    if block > 1 or len(values[0]) == 1:  # R-hat splits other draws than effective sizes
        far = np.abs(values - np.median(values, axis=(1, 2), keepdims=True))
        rhat = _rhat(values, superchains)
        ess, spread = _ess("ess", values, block), _ess("ess", far, block)
    else:
        split = _split(values)
        scores, folded = normal_scores(split), normal_scores(_folded(split))
        ess, spread = _ess_of_halves(scores), _ess_of_halves(folded)
        rhat = _rhat_of(scores, folded, superchains)
    return tuple(np.where(lost, np.nan, figure) for figure in (ess, tail, rhat, spread))


def _figures(kind: str, values: np.ndarray, block: int, superchains: int) -> np.ndarray:
    lost = np.isnan(values).any(axis=(1, 2))
    if kind == "rhat":
        found = _rhat(values, superchains)
    elif kind != "mcse":
        found = _ess(kind, values, block)
    else:
        still = np.ptp(values, axis=(1, 2)) == 0  # rounding makes their standard deviation positive
        error = values.std(axis=(1, 2), ddof=1) / np.sqrt(_ess("mean_ess", values, block))
        found = np.where(still, 0.0, error)
    return np.where(lost, np.nan, found)


def _rhat(values: np.ndarray, superchains: int) -> np.ndarray:
    if values.shape[1] == 1:
        values = _split(values)
    if values.shape[2] < 4:
        return np.full(len(values), np.nan)
    split = _split(values)
    return _rhat_of(normal_scores(split), normal_scores(_folded(split)), superchains)


def _folded(split: np.ndarray) -> np.ndarray:
    """Distances from the median."""
    return np.abs(split - np.median(split, axis=(1, 2), keepdims=True))


def _rhat_of(scores: np.ndarray, folded: np.ndarray, superchains: int) -> np.ndarray:
    """R-hat of half-chains, by the scores of their values and of their distances from the median."""
    ratio = _nested(superchains) if superchains > 1 else _between_and_within
    found = np.maximum(ratio(scores), ratio(folded))
    return np.where(found > _STILL, np.inf, found)


def _between_and_within(values: np.ndarray) -> np.ndarray:
    """R-hat of values that are what they are (Vehtari et al. 2021, eq. 1 to 4)."""
    draws = values.shape[2]
    between = values.mean(axis=2).var(axis=1, ddof=1)
    within = values.var(axis=2, ddof=1).mean(axis=1)
    return np.sqrt(between / within + (draws - 1) / draws)


def _nested(superchains: int) -> Callable[[np.ndarray], np.ndarray]:
    """Nested R-hat of half-chains, first halves first (Margossian et al. 2024, eq. 4 to 8)."""

    def ratio(values: np.ndarray) -> np.ndarray:
        count = len(values)
        means = values.mean(axis=2).reshape(count, 2, superchains, -1)
        means = np.moveaxis(means, 2, 1).reshape(count, superchains, -1)
        within = means.var(axis=2, ddof=1).mean(axis=1) + values.var(axis=2, ddof=1).mean(axis=1)
        return np.sqrt(1.0 + means.mean(axis=2).var(axis=1, ddof=1) / within)

    return ratio


def _ess(kind: str, values: np.ndarray, block: int) -> np.ndarray:
    values = np.ldexp(values, -np.frexp(np.ptp(values, axis=(1, 2), keepdims=True))[1])
    if block > 1:
        found = [_ensemble_ess(series, block) for series in _series(kind, values)]
    elif kind == "tail_ess":  # levels are those of all draws
        found = [_ess_of_halves(_split(series)) for series in _series(kind, values)]
    else:
        found = [_ess_of_halves(series) for series in _series(kind, _split(values))]
    return np.minimum.reduce(found)


def _series(kind: str, values: np.ndarray) -> list[np.ndarray]:
    """What the figure is an effective size of the mean of (Vehtari et al. 2021, sec. 4)."""
    if kind == "mean_ess":
        return [values]
    if kind == "tail_ess":
        levels = np.quantile(values, [0.05, 0.95], axis=(1, 2), keepdims=True)
        return [(values <= level).astype(float) for level in levels]
    return [normal_scores(values)]


def _ensemble_ess(values: np.ndarray, block: int) -> np.ndarray:
    """Variance of the draws over the squared error of their mean, judged by block means."""
    means = values.reshape(*values.shape[:2], -1, block).mean(axis=-1)
    size = math.prod(values.shape[1:])
    ratio = values.var(axis=(1, 2), ddof=1) / means.var(axis=(1, 2), ddof=1)
    found = np.minimum(ratio * _ess_of_halves(_split(means)), size)
    return np.where(np.ptp(values, axis=(1, 2)) == 0, float(size), found)


def _ess_of_halves(split: np.ndarray) -> np.ndarray:
    """Effective sizes for means of half-chains, by Geyer's initial monotone sequence."""
    import scipy.fft  # a tenth of the time that importing the package takes

    _, chains, draws = split.shape
    size = chains * draws
    length = scipy.fft.next_fast_len(2 * draws, real=True)
    centred = split - split.mean(axis=2, keepdims=True)
    power = np.abs(scipy.fft.rfft(centred, n=length, axis=2)) ** 2
    covariance = scipy.fft.irfft(power.mean(axis=1), n=length, axis=1)[:, :draws] / draws
    within = covariance[:, :1] * draws / (draws - 1.0)
    total = covariance[:, :1].copy()
    if chains > 1:
        total += split.mean(axis=2).var(axis=1, ddof=1)[:, None]
    rho = 1.0 - (within - covariance) / total
    rho[:, 0] = 1.0
    pairs = rho[:, : draws // 2 * 2].reshape(len(rho), -1, 2).sum(axis=2)
    # the last pair that is looked at is the first without a positive sum
    most = min(max((draws - 3) // 2, 0), pairs.shape[1] - 1)
    ended = pairs[:, : most + 1] <= 0
    ended[:, most] = True
    last = ended.argmax(axis=1)
    kept = np.arange(pairs.shape[1]) < last[:, None]
    falling = np.minimum.accumulate(pairs, axis=1)
    row = np.arange(len(rho))
    even, pair = rho[row, 2 * last], pairs[row, last]
    tau = -1.0 + 2.0 * np.where(kept, falling, 0.0).sum(axis=1)
    tau += np.where((even > 0) | (pair >= 0), even, 0.0)
    found = size / np.maximum(tau, 1.0 / np.log10(size))
    found = np.where(np.isnan(rho).any(axis=1), np.nan, found)
    return np.where(np.ptp(split, axis=(1, 2)) == 0, float(size), found)


def _split(values: np.ndarray) -> np.ndarray:
    """Halves of chains as chains, first halves first."""
    half = values.shape[2] // 2
    return np.concatenate([values[:, :, :half], values[:, :, -half:]], axis=1)


# ---- private: tails of weights ------------------------------------------------------------------


def _pareto_shape(excess: np.ndarray) -> float:
    """Shape of a generalised Pareto distribution, by sorted draws of it.

    Its posterior mean under an empirical prior of the scale (Zhang and Stephens 2009, Technometrics 51, sec.
    3), drawn to 1/2 as by ten draws (Vehtari et al. 2024, appendix C).
    """
    n = len(excess)
    points = 30 + int(np.sqrt(n))
    quartile = excess[int(n / 4 + 0.5) - 1]
    if not quartile > 0:
        return float(np.inf)  # next to the largest, the others are nothing
    spread = 1.0 - np.sqrt(points / (np.arange(points) + 0.5))
    theta = 1.0 / excess[-1] + spread / (_SCALES * quartile)
    with np.errstate(all="ignore"):
        shape = np.log1p(-theta[:, None] * excess).mean(axis=1)
        log = n * (np.log(-theta / shape) - shape - 1.0)
        weights = normalised(log)
        theta = weights @ theta
        return float((n * np.log1p(-theta * excess).mean() + _SHAPES * _SHAPE) / (n + _SHAPES))
