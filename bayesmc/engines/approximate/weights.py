"""Draws of an approximation weighed by the model's own functions, and weights with their tails smoothed."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.diagnostics import pareto_k
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.approximate.approximation import Approximation, Drawn
from bayesmc.engines.approximate.defensive import PriorLogs
from bayesmc.engines.approximate.evidence import log_constants
from bayesmc.engines.approximate.rare import log_of
from bayesmc.engines.approximate.stored import as_stored, completed
from bayesmc.errors import UnsupportedError, ZeroProbabilityError
from bayesmc.network import Problem
from bayesmc.results import DrawsPosterior, Posterior
from bayesmc.structure.target import Values, target_of

#: differences of log weights that are rounding
EQUAL = 1e-7
#: below this shape weights have a variance
FINITE = 0.5


class CheckedPosterior(DrawsPosterior):
    """Draws of an approximation, weighed so that they answer for the posterior."""

    k: float = np.nan
    #: how many of the draws, the last ones, are of the prior
    of_prior: int = 0

    @property
    def pareto_k(self) -> float | None:  # type: ignore[override]
        """Tail shape of the weights as they were before their tail was smoothed."""
        return self.k


@dataclass(frozen=True, eq=False)
class Batch:
    """Draws completed.

    Attributes
    ----------
    values : dict
        Stored values of all nodes.
    log_density : ndarray, shape (draws,)
        Of what an approximation draws from.
    log_target, log_prior : ndarray, shape (draws,)
        The model's, and of the prior.
    """

    values: Values
    log_density: np.ndarray
    log_target: np.ndarray
    log_prior: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """Log weights by the approximation; nothing where they are no numbers."""
        with np.errstate(invalid="ignore"):
            found = self.log_target - self.log_density
        return np.where(np.isnan(found), -np.inf, found)


def evaluated(
    posterior: Posterior, approximation: Approximation, drawn: Drawn, rng: np.random.Generator
) -> Batch:
    """Draws completed, with the log densities of the model and of the prior."""
    problem, draws = posterior._live("check"), len(drawn.log_density)
    values = completed(problem, approximation.names, drawn, rng)
    logs = _log_both(problem, approximation.names, values, draws)
    return Batch(values, drawn.log_density, *logs)


def weighed(posterior: Posterior, batch: Batch, raw: np.ndarray) -> CheckedPosterior:
    """Draws with log weights ``raw``: the model's density over that which they are drawn from,"""
    problem, draws = posterior._live("check"), len(raw)
    if not (raw > -np.inf).any():
        raise ZeroProbabilityError(
            f"check: the model gives none of {draws} draws of the approximation a positive density; ask a "
            "sampling engine"
        )
    smoothed, k = pareto_smoothed(raw)
    stored = as_stored(problem, batch.values)
    found = CheckedPosterior(
        problem, posterior.engine, stored, (1, draws), smoothed[None], independent=True
    )
    found.k = k
    total = float(log_sum_exp(smoothed[None]))
    found.log_marginal_likelihood = total - float(np.log(draws))
    ess = found.weight_ess
    assert ess is not None
    found.log_marginal_likelihood_mcse = float(np.sqrt(max(1 / ess - 1 / draws, 0.0)))
    return found


def defended(posterior: Posterior, batch: Batch, besides: Batch) -> CheckedPosterior:
    """Draws of an approximation and of the prior together, weighed by the density of their mixture."""
    one, two = len(batch.log_target), len(besides.log_target)
    log_density, target, prior = (
        np.concatenate([getattr(b, part) for b in (batch, besides)])
        for part in ("log_density", "log_target", "log_prior")
    )
    log_density = np.where(np.isnan(log_density), -np.inf, log_density)
    share = two / (one + two)
    with np.errstate(all="ignore"):
        raw = target - np.logaddexp(np.log1p(-share) + log_density, np.log(share) + prior)
    raw = np.where(np.isnan(raw), -np.inf, raw)
    values = {}
    for name, node in posterior.model.nodes.items():
        if name in batch.values:
            shape, parts = node.value_shape, [b.values[name] for b in (batch, besides)]
            if max(map(np.ndim, parts)) > len(shape):
                counted = zip(parts, (one, two), strict=True)
                parts = [np.concatenate([np.broadcast_to(v, (n, *shape)) for v, n in counted])]
            values[name] = parts[0]
    found = weighed(posterior, Batch(values, log_density, target, prior), raw)
    found.of_prior = two
    return found


def log_joint(problem: Problem, names: Any, values: Any, draws: int) -> np.ndarray:
    """The model's log density of the evidence and of nodes' values, what is drawn forward left out.

    Parameters
    ----------
    names : tuple of str
        The nodes of the approximation.
    values : dict
        Stored values of all nodes, shape ``(draws, *plates, *event)``.

    Returns
    -------
    ndarray, shape (draws,)
    """
    return _log_both(problem, names, values, draws)[0]


def pareto_smoothed(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Log weights with their largest replaced by quantiles of a generalised Pareto law, and its shape k.

    Weights that are equal to rounding are left as they are, with k minus infinity. The fit takes weights that
    come in lumps (of finite states), or one that stands out among next to equal ones, for a heavy tail. Of
    weights with that tail the largest of S carries about S^(k - 1) of their sum (Chatterjee and Diaconis 2018
    judge by that share); where it carries less than 1/sqrt(S), as it does of those with a variance, weights
    are left as they are, and k is the shape of so small a largest one.
    """
    from arviz_stats.base import array_stats

    possible = log_weights > -np.inf
    low, top = log_weights[possible].min(), log_weights[possible].max()
    if possible.all() and top - low < EQUAL:
        return log_weights.copy(), -np.inf
    k = pareto_k(log_weights[possible], log_weights.size)
    largest = _shape_of_largest(log_weights)
    if largest < FINITE <= k:  # a lump of weights, as of finite states, and no tail
        return log_weights.copy(), largest
    bottom = max(low, top - 600.0)  # what is farther below is nothing, and stays so
    filled = np.where(possible, np.maximum(log_weights, bottom), bottom - 50.0)
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = np.asarray(array_stats.psislw(-filled)[0])
    except ValueError:  # there is no tail: its weights are equal
        return log_weights.copy(), k
    at = int(filled.argmin())
    found = found + (filled[at] - found[at])  # as they were before they were made to sum to 1
    if not np.isfinite(found).all():
        return log_weights.copy(), k
    return np.where(possible, found, -np.inf), k


# ---- private ------------------------------------------------------------------------------------


def _log_both(
    problem: Problem, names: Any, values: Any, draws: int
) -> tuple[np.ndarray, np.ndarray]:
    """The log joint density, and what nodes' own densities given parents say of hidden elements."""
    target = target_of(problem, names)
    outside = set(target.chain) - set(names)
    if outside:
        raise UnsupportedError(
            f"check: the approximation says nothing of node {min(outside)!r}, on which something observed "
            "depends"
        )
    logs = PriorLogs(target, names, log_of)
    with marking_invalid(), np.errstate(all="ignore"):
        found = np.broadcast_to(target.log_density(values, log_of=logs), (draws,))
    return found + log_constants(target), np.broadcast_to(logs.total, (draws,))


def _shape_of_largest(log_weights: np.ndarray) -> float:
    """The shape of a tail whose largest weight carries the share of all that this one does."""
    share = log_weights.max() - float(log_sum_exp(log_weights[None]))
    return float(1.0 + share / np.log(log_weights.size))
