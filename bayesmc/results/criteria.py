"""How well a model predicts what it has not seen: leave-one-out by importance sampling, WAIC, comparisons.

Smoothing the weights is arviz-stats' affair, by its array interface.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import LowEssWarning, QueryError
from bayesmc.results.scales import Scale, refuse_other_scales
from bayesmc.results.table import Summary


@dataclass(frozen=True, eq=False)
class Elpd:
    """Expected log predictive density of new data like those observed; larger is better.

    Attributes
    ----------
    kind : "loo" or "waic"
    elpd : float
    se : float
        Standard error over observations.
    p : float
        Effective number of parameters.
    pointwise : ndarray, shape (observations,)
        The contributions of the observations, node by node in order of ``names``.
    pareto_k : ndarray or None, shape (observations,)
        How far the importance weights of each can be trusted (not above ``good_k``); None for WAIC.
    good_k : float
    names : tuple of str
        The observed nodes.
    warning : str
        What is doubtful; empty where nothing is.
    scale : Scale or None
        What the densities are of, where that is known.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"i": 5})
    >>> net.add("m", bmc.Normal(0.0, 10.0))
    >>> net.add("y", lambda m: bmc.Normal(m, 1.0), plates="i")
    >>> posterior = bmc.infer(net, {"y": [0.1, -0.4, 0.3, 1.0, 0.2]}, engine=bmc.Gibbs(500), rng=0)
    >>> posterior.waic().pointwise.shape
    (5,)
    """

    kind: str
    elpd: float
    se: float
    p: float
    pointwise: np.ndarray
    pareto_k: np.ndarray | None
    good_k: float
    names: tuple[str, ...]
    warning: str = ""
    scale: Scale | None = None

    def __str__(self) -> str:
        many = f"{len(self.pointwise)} observations of {', '.join(self.names)}"
        lines = [
            f"elpd_{self.kind} {self.elpd:.2f} (se {self.se:.2f}), p_{self.kind} {self.p:.2f}, {many}"
        ]
        if self.pareto_k is not None:
            bad = int((self.pareto_k > self.good_k).sum())
            lines.append(f"Pareto k above {self.good_k:.2f}: {bad} of {len(self.pareto_k)}")
        return "\n".join([*lines, *([self.warning] if self.warning else [])])

    __repr__ = __str__


#: draws that PSIS needs: a fifth of them, five at least, are the tail that is smoothed
FEWEST = 25


def leave_one_out(
    log_likelihood: Mapping[str, np.ndarray], r_eff: float, distinct: int | None = None
) -> Elpd:
    """PSIS-LOO of pointwise log likelihoods, each ``(chain, draw, ...)``; see ``Posterior.loo``.

    ``distinct`` is how many draws are not copies of others, where some are.

    References
    ----------
    Vehtari, Gelman and Gabry (2017), Practical Bayesian model evaluation, Statistics and Computing 27, sec.
    2.
    """
    from arviz_stats.base import array_stats

    values = _columns("loo", log_likelihood)
    if not len(values):
        raise QueryError("loo: no observation has a value; infer with observed data")
    count = values.shape[-1] * values.shape[-2]
    if count < FEWEST:
        raise QueryError(
            f"loo: {count} draws are too few to smooth the tail of their weights; give {FEWEST} or more, "
            "better some thousands: more draws of the engine, or resample(4000) of an exact answer"
        )
    with np.errstate(all="ignore"):  # tails of copies, which are refused below
        elpd_i, k, p_i = (
            np.asarray(part)
            for part in array_stats.loo(values, chain_axis=-2, draw_axis=-1, r_eff=r_eff)
        )
    copies = distinct is not None and distinct < FEWEST
    if copies or np.isnan(elpd_i).any():
        told = f"{count} draws are copies of {distinct}" if distinct else "draws repeat each other"
        raise QueryError(
            f"loo: {told}, and the tail of their weights is the same few values over and over, which "
            "cannot be smoothed; make the weights more equal (more draws, Importance with a proposal), or "
            "infer with an engine of Markov chains: HamiltonianMonteCarlo, Gibbs"
        )
    good_k = min(1 - 1 / np.log10(count), 0.7) if count > 1 else 0.7
    bad = int((k > good_k).sum())
    warning = ""
    if bad:
        warning = (
            f"loo: the Pareto k of {bad} of {len(k)} observations is above {good_k:.2f} (the largest is "
            f"{k.max():.2f}): leaving one of them out changes the posterior too much for its draws to be "
            "reweighted; use a model with heavier tails, or leave these out and infer again"
        )
        warnings.warn(warning, LowEssWarning, stacklevel=3)
    return _summed("loo", elpd_i, p_i, k, good_k, tuple(log_likelihood), warning)


def widely_applicable(log_likelihood: Mapping[str, np.ndarray]) -> Elpd:
    """WAIC of pointwise log likelihoods; see ``Posterior.waic``.

    References
    ----------
    Watanabe (2010), JMLR 11, eq. 31; Vehtari, Gelman and Gabry (2017), eqs. 11 to 13.
    """
    values = _columns("waic", log_likelihood)
    flat = values.reshape(len(values), -1)
    peak = flat.max(axis=1, keepdims=True)
    lppd = np.log(np.exp(flat - peak).mean(axis=1)) + peak[:, 0]
    p_i = flat.var(axis=1)
    warning = ""
    if (p_i > 0.4).any():
        warning = (
            f"waic: the log likelihood of {int((p_i > 0.4).sum())} of {len(p_i)} observations varies "
            "by more than "
            "0.4 over draws, where WAIC is unreliable; use loo(), which says how far it can be trusted"
        )
        warnings.warn(warning, LowEssWarning, stacklevel=3)
    return _summed("waic", lppd - p_i, p_i, None, np.nan, tuple(log_likelihood), warning)


def compare(models: Mapping[str, Any] | Sequence[Any], criterion: str = "loo") -> Summary:
    """Models ranked by how well they are expected to predict new data.

    Parameters
    ----------
    models : dict, or sequence of posteriors
        Name -> ``Posterior``, or what its ``loo()`` or ``waic()`` returned; all given the same observations,
        or transformed ones brought to one scale (``log_jacobian=``). Posteriors of nets with
        names of their own need no others.
    criterion : "loo" or "waic"
        What is asked of posteriors.

    Returns
    -------
    Summary
        A row for each model, best first: ``rank``, ``elpd``, ``se``, ``p``, ``elpd_diff`` (to the best), its
        standard error ``dse``, ``weight`` (of a stack of predictive distributions), ``warning`` (1: not to be
        relied on). A difference of few ``dse``, or below 4, tells models apart poorly.

    Raises
    ------
    QueryError
        Other observations, other scales, or criteria of different kinds.

    References
    ----------
    Vehtari, Gelman and Gabry (2017), sec. 5; Yao, Vehtari, Simpson and Gelman (2018), Using stacking to
    average Bayesian predictive distributions, Bayesian Analysis 13, eq. 4.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> def fitted(tail):
    ...     net = bmc.BayesNet(plates={"day": 12})
    ...     net.add("mean", bmc.Normal(0.0, 10.0))
    ...     net.add("y", lambda mean: tail(mean), plates="day")
    ...     y = np.r_[np.linspace(-1.0, 1.0, 11), 9.0]
    ...     return bmc.infer(net, {"y": y}, engine=bmc.Gibbs(500, warmup=200), rng=0)
    >>> import warnings
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore")
    ...     table = bmc.compare({"normal": fitted(lambda m: bmc.Normal(m, 1.0)),
    ...                          "student": fitted(lambda m: bmc.StudentT(2.0, m, 1.0))})
    >>> table.names
    ('student', 'normal')
    """
    if criterion not in ("loo", "waic"):
        raise QueryError(f"compare(criterion={criterion!r}): give 'loo' or 'waic'")
    models = _by_name(models)
    found = {name: _criterion(name, model, criterion) for name, model in models.items()}
    order = sorted(found, key=lambda name: -found[name].elpd)
    best = found[order[0]]
    for name in order[1:]:
        other = found[name]
        if other.kind != best.kind or len(other.pointwise) != len(best.pointwise):
            raise QueryError(
                f"compare: {order[0]!r} has {len(best.pointwise)} observations ({best.kind}), {name!r} "
                f"{len(other.pointwise)} ({other.kind}); models are compared on the same observations"
            )
    refuse_other_scales(order, [found[name].scale for name in order])
    rows = [found[name] for name in order]
    away = np.stack([best.pointwise - row.pointwise for row in rows])
    count = len(best.pointwise)
    columns = {
        "rank": np.arange(len(rows), dtype=float),
        "elpd": np.array([row.elpd for row in rows]),
        "se": np.array([row.se for row in rows]),
        "p": np.array([row.p for row in rows]),
        "elpd_diff": away.sum(axis=1),
        "dse": np.sqrt(count * away.var(axis=1)),
        "weight": _stacking(np.stack([row.pointwise for row in rows], axis=1)),
        "warning": np.array([float(bool(row.warning)) for row in rows]),
    }
    return Summary(tuple(order), columns, f"compared by {best.kind}")


# ---- private ------------------------------------------------------------------------------------


def _columns(what: str, log_likelihood: Mapping[str, np.ndarray]) -> np.ndarray:
    """Observations first, then chains and draws; what was not observed is left out."""
    parts = []
    for name, values in log_likelihood.items():
        flat = np.moveaxis(values.reshape(*values.shape[:2], -1), -1, 0)
        known = ~np.isnan(flat).all(axis=(1, 2))
        flat = flat[known]
        if not np.isfinite(flat).all():
            raise QueryError(
                f"{what}: an observation of {name!r} has log density -inf or NaN at some draws, so "
                "that it cannot be "
                "reweighted; the draws must allow all that was observed"
            )
        parts.append(flat)
    return np.concatenate(parts)


def _summed(
    kind: str,
    elpd_i: np.ndarray,
    p_i: np.ndarray,
    k: np.ndarray | None,
    good_k: float,
    names: tuple[str, ...],
    warning: str,
) -> Elpd:
    error = float(np.sqrt(len(elpd_i) * np.var(elpd_i)))
    return Elpd(
        kind, float(elpd_i.sum()), error, float(p_i.sum()), elpd_i, k, float(good_k), names, warning
    )


def _by_name(models: Any) -> Mapping[str, Any]:
    """Models by name; a sequence of posteriors by the names of their nets."""
    if isinstance(models, (list, tuple)) and len(models) > 1:
        names: list[Any] = [getattr(getattr(m, "model", None), "name", None) for m in models]
        if not all(isinstance(n, str) for n in names) or len(set(names)) < len(names):
            raise QueryError(
                f"compare: {len(models)} models in a {type(models).__name__}, which have no names of their "
                f"own (here {names}); give a dict, compare({{'first': a, 'second': b}}), or give the nets "
                "names, BayesNet('first')"
            )
        return dict(zip(names, models, strict=True))
    if not isinstance(models, Mapping) or len(models) < 2:
        found = "one" if isinstance(models, (Mapping, list, tuple)) and models else "none"
        if not isinstance(models, (Mapping, list, tuple)):
            found = f"a {type(models).__name__}"
        raise QueryError(
            f"compare: give two models or more, as in compare({{'first': a, 'second': b}}), not {found}"
        )
    return models


def _criterion(name: str, model: Any, criterion: str) -> Elpd:
    if isinstance(model, Elpd):
        return model
    if not hasattr(model, criterion):
        raise QueryError(
            f"compare: {name!r} is a {type(model).__name__}; give posteriors, or results of loo() or waic()"
        )
    found: Elpd = getattr(model, criterion)()
    return found


def _stacking(pointwise: np.ndarray) -> np.ndarray:
    """Weights of models whose mixture predicts best, ``pointwise`` being (observations, models).

    The mean log score is concave in the weights, and multiplying them by their gradient raises it, as EM does
    for the weights of a mixture whose components are known; Newton's method would need its constraints.
    """
    density = np.exp(pointwise - pointwise.max(axis=1, keepdims=True))
    weights = np.full(density.shape[1], 1.0 / density.shape[1])
    for _ in range(100_000):
        new = weights * (density / (density @ weights)[:, None]).mean(axis=0)
        done = np.abs(new - weights).max() < 1e-10
        weights = new / new.sum()
        if done:
            break
    return weights
