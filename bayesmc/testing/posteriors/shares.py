"""Where a truth lies among the draws of a posterior: one number that is uniform if the posterior is right.

Draws of all kinds are ranked here: independent, of Markov chains, weighted. What is drawn, and by whom, is
not known here, nor how uniformity is judged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.diagnostics import chain_statistic, weight_ess
from bayesmc.engines.weighted.likelihood_weighting import LikelihoodWeighting
from bayesmc.errors import DensityError, ShapeError, UnknownNodeError
from bayesmc.network import Model
from bayesmc.network.evidence import store
from bayesmc.results import ChainsPosterior, DrawsPosterior

#: correlation of the draws of a chain that are kept, about
_CORRELATION = 0.05
#: share of their size within which values are taken as equal: sums of the same terms may differ in rounding
_ROUNDING = 1e-10


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of a posterior, whatever made it.

    Attributes
    ----------
    values : dict
        Hidden node -> stored values, shape ``(chains * draws, *plates, *event)``.
    shape : tuple of int
        Chains and draws of each.
    log_weights : ndarray, shape (chains * draws,), or None
    likelihood : bool
        Weights are the likelihood of the data, so that the truth's own is known.
    """

    values: Mapping[str, np.ndarray]
    shape: tuple[int, int]
    log_weights: np.ndarray | None = None
    likelihood: bool = False

    @property
    def count(self) -> int:
        return self.shape[0] * self.shape[1]

    @property
    def ess(self) -> float:
        """Effective number of weighted draws; infinite where there are no weights."""
        return math.inf if self.log_weights is None else weight_ess(self.log_weights)


def posterior_draws(
    posterior: Any, model: Model, names: tuple[str, ...], draws: int, rng: Any
) -> Draws:
    """Draws of ``names`` from a posterior; from one that holds none, so many are drawn."""
    if not isinstance(posterior, DrawsPosterior):
        posterior = posterior.resample(draws, rng=rng)
    raw = {n: store(model[n], posterior[n]) for n in names}
    shape = next(iter(raw.values())).shape[:2]
    log_weights, member = posterior.log_weights, 1
    if isinstance(posterior, ChainsPosterior):
        member = posterior.ensemble_size
    elif log_weights is None:  # independent: as many chains of one draw
        shape = (math.prod(shape), 1)
    if member > 1:  # draws come from the members of an ensemble in turn: each is a chain
        whole = shape[1] // member
        raw = {n: _by_member(v[:, : whole * member], member) for n, v in raw.items()}
        shape = (shape[0] * member, whole)
    flat = {n: v.reshape(math.prod(shape), *model[n].value_shape) for n, v in raw.items()}
    known = isinstance(posterior.engine, LikelihoodWeighting)
    return Draws(flat, shape, None if log_weights is None else log_weights.ravel(), known)


def users_draws(call: str, found: Any, model: Model, names: tuple[str, ...]) -> Draws:
    """Draws that a user's function returned: node -> array with one row for each draw."""
    if not isinstance(found, Mapping):
        raise TypeError(
            f"{call}: the sampler returned a {type(found).__name__}; return a dict of node -> draws, shape "
            "(draws, *plates, *event), or a Posterior"
        )
    lacking = [n for n in names if n not in found]
    if lacking:
        raise UnknownNodeError(
            f"{call}: the sampler returned no draws of {lacking[0]!r}; return all hidden nodes, {list(names)}"
        )
    values = {n: store(model[n], found[n]) for n in names}
    undefined = [n for n, v in values.items() if np.isnan(v).any()]
    if undefined:
        raise DensityError(f"{call}: the sampler returned NaN among the draws of {undefined[0]!r}")
    counts = {n: v.shape[: v.ndim - len(model[n].value_shape)] for n, v in values.items()}
    first = counts[names[0]]
    for name, batch in counts.items():
        if len(batch) != 1 or batch != first or not batch[0]:
            raise ShapeError(
                f"{call}: the sampler's draws of {name!r} have shape {values[name].shape}; return (draws, "
                f"*plates, *event) with the same number of draws for all hidden nodes"
            )
    return Draws(values, (1, first[0]))


def share_below(
    truth: np.ndarray,
    values: np.ndarray,
    draws: Draws,
    log_likelihood: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Share of the posterior below the truth, and the number of draws behind it, of every statistic.

    The truth and ``n`` independent draws are ``n + 1`` draws of one law, each as likely to be the lowest as
    any other; a uniform number in the truth's own part (and in that of what ties with it) makes the rank a
    uniform share, exactly, whatever ``n``. Chains are thinned first. Weighted draws take parts in proportion
    to their weights. Where the truth's own is known that is exact, too: given all ``n + 1`` values, each is
    the one from the posterior with a chance in proportion to its weight. Else it is put at its mean.

    Parameters
    ----------
    truth : ndarray, shape (statistics,)
    values : ndarray, shape (chains * draws, statistics)
    draws : Draws
    log_likelihood : float
        Of the data given the truth.
    rng : Generator

    Returns
    -------
    shares, counts : ndarray, shape (statistics,)
    """
    near = np.abs(values - truth) <= _ROUNDING * np.abs(truth)
    tied = near | (values == truth)
    below = (values < truth) & ~tied
    position = rng.random(len(truth))
    if draws.log_weights is not None:
        own = log_likelihood if draws.likelihood else None
        weights, of_truth = _weights(draws.log_weights, own)
        return weights @ below + position * (weights @ tied + of_truth), np.full(
            len(truth), draws.ess
        )
    shares, counts = np.empty(len(truth)), np.empty(len(truth))
    thinned = _thinning(values, draws.shape)
    for s, every in enumerate(thinned):
        # counted from the end: what is nearest to the law that the chain goes to
        lower, equal = (a[:, s].reshape(draws.shape)[:, ::-1][:, ::every] for a in (below, tied))
        counts[s] = lower.size
        shares[s] = (lower.sum() + position[s] * (equal.sum() + 1)) / (lower.size + 1)
    return shares, counts


# ---- private ------------------------------------------------------------------------------------


def _by_member(values: np.ndarray, members: int) -> np.ndarray:
    chains, draws = values.shape[:2]
    split = values.reshape(chains, draws // members, members, *values.shape[2:])
    return split.swapaxes(1, 2)


def _weights(log_weights: np.ndarray, own: float | None) -> tuple[np.ndarray, float]:
    """Weights of the draws and of the truth, which sum to 1."""
    top = log_weights.max()
    weights = np.exp(log_weights - top)
    # the mean weight of a draw of the posterior, which is what the truth is
    of_truth = float((weights**2).sum() / weights.sum())
    if own is not None:
        top = max(top, own)
        weights, of_truth = np.exp(log_weights - top), float(np.exp(own - top))
    total = weights.sum() + of_truth
    return weights / total, of_truth / total


def _thinning(values: np.ndarray, shape: tuple[int, int]) -> list[int]:
    """Of every statistic, how far apart draws of a chain are nearly independent.

    By the effective size: a chain of order one with that size has this correlation between neighbours.
    """
    chains, draws = shape
    if draws == 1:
        return [1] * values.shape[1]
    from scipy.stats import rankdata

    # of ranks, which is what is asked for: heavy tails and infinite values do no harm
    ranks = rankdata(values, axis=0).reshape(chains, draws, -1)
    sizes = chain_statistic("mean_ess", ranks)
    out = []
    for ess in np.nan_to_num(sizes, nan=chains):
        ratio = min(ess / (chains * draws), 1.0)
        correlation = (1.0 - ratio) / (1.0 + ratio)
        apart = math.log(_CORRELATION) / math.log(correlation) if correlation > 0 else 1.0
        out.append(min(max(math.ceil(apart), 1), draws))
    return out
