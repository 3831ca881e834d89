"""Does a posterior match an exact one? Every probability, mean and log evidence, in one decision.

Monte Carlo answers are judged by their own standard errors, all comparisons together under a stated
false-alarm rate; answers without Monte Carlo error must agree to a tolerance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

#: effective number of draws below which a mean or log evidence is not judged: no normal limit yet
_MIN_ESS = 100.0


@dataclass(frozen=True)
class Comparison:
    """One figure against its exact value.

    Attributes
    ----------
    what : str
        Node, element and state.
    found, exact : float
    errors : float
        Distance in standard errors (infinite where none is allowed).
    p_value : float
        Of a distance at least this large, were the answer right.
    """

    what: str
    found: float
    exact: float
    errors: float
    p_value: float

    def __str__(self) -> str:
        return (
            f"{self.what}: {self.found:.6g} against {self.exact:.6g} exact, "
            f"{self.errors:.3g} standard errors (p = {self.p_value:.2g})"
        )


@dataclass(frozen=True)
class Match:
    """What was compared, and what was rejected.

    Attributes
    ----------
    comparisons : int
        Figures compared.
    skipped : int
        Figures with too few effective draws to be judged.
    worst : Comparison or None
        The least likely one.
    rejected : tuple of Comparison
        Those that do not match, worst first; empty when all is well.
    alpha : float
        Family-wise false-alarm rate of the decision.
    """

    comparisons: int
    skipped: int
    worst: Comparison | None
    rejected: tuple[Comparison, ...]
    alpha: float


def compare(
    posterior: Any,
    exact: Any,
    alpha: float = 1e-3,
    *,
    rtol: float = 1e-9,
    min_count: float = 10.0,
    names: Sequence[str] | None = None,
) -> Match:
    """What differs between a posterior and an exact one, and whether chance explains it.

    Compared are the probability of every state of every element of finite nodes, the means of all other
    nodes, and the log evidence. A probability is judged by binomial tails at its effective count
    ``n_eff`` (the smaller of the weights' ESS and the node's own), i.e. with the standard error under the
    exact value; means by their standard error, at least that of the exact variance at ``n_eff``; evidence
    by its ratio to the exact one. A state of exact probability zero must have exactly none. Holm's method
    keeps the chance of any false alarm in one call at ``alpha``. A posterior whose ``ess`` is infinite is
    exact, and must agree within ``rtol * max(1, |value|)``. The ``accuracy`` of ``exact`` is added to
    every tolerance.

    It cannot see what the draws do not show: heavy weights that no draw has met (look at ``pareto_k``),
    faults below the Monte Carlo error, errors of joint probabilities with right marginals.

    Parameters
    ----------
    posterior : Posterior
        Of any engine.
    exact : Enumerated or Posterior
        Anything with ``names``, ``probabilities``, ``mean``, ``var``, ``log_marginal_likelihood``.
    alpha : float
        Family-wise false-alarm rate.
    rtol : float
        Tolerance without Monte Carlo error.
    min_count : float
        Compare states with ``n_eff * p * (1 - p)`` at least this.
    names : sequence of str, optional
        Nodes to compare; by default all that ``exact`` knows.

    Returns
    -------
    Match

    Raises
    ------
    AssertionError
        Where the two do not even have the same shapes.

    References
    ----------
    Holm (1979), Scand. J. Statist. 6.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import compare, enumerate_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.3))
    >>> found = bmc.infer(net, engine=bmc.LikelihoodWeighting(5000), rng=0)
    >>> compare(found, enumerate_posterior(net)).rejected
    ()
    """
    table = _Table(rtol + getattr(exact, "accuracy", 0.0), min_count)
    _compare_evidence(table, posterior, exact)
    for name in names if names is not None else exact.names:
        node = posterior.model[name]
        if node.kind == "input":
            continue
        if node.domain is not None:
            _compare_states(table, posterior, exact, name, node)
        else:
            _compare_mean(table, posterior, exact, name, node)
    found = sorted(table.comparisons, key=lambda c: (c.p_value, -c.errors))
    rejected = found[: holm([comparison.p_value for comparison in found], alpha)]
    return Match(len(found), table.skipped, found[0] if found else None, tuple(rejected), alpha)


def assert_matches(posterior: Any, exact: Any, **options: Any) -> Match:
    """Raise unless a posterior matches an exact one.

    Parameters
    ----------
    posterior, exact
        As `compare` takes them; there stands what is compared, and what cannot be seen.
    **options
        Of `compare`: ``alpha`` (family-wise false-alarm rate, 1e-3), ``rtol`` (tolerance without
        Monte Carlo error, 1e-9), ``min_count`` (rarer states are not compared, 10), ``names``
        (nodes to compare, all).

    Returns
    -------
    Match

    Raises
    ------
    AssertionError
        Naming nodes, elements, states, both values and the number of standard errors.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import assert_matches, enumerate_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.3))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> weighted = bmc.infer(net, {"x": 1.5}, engine=bmc.LikelihoodWeighting(5000), rng=0)
    >>> assert_matches(weighted, enumerate_posterior(net, {"x": 1.5})).comparisons
    4
    """
    match = compare(posterior, exact, **options)
    if match.rejected:
        shown = "\n  ".join(map(str, match.rejected[:10]))
        more = f"\n  ... and {len(match.rejected) - 10} more" if len(match.rejected) > 10 else ""
        raise AssertionError(
            f"assert_matches: {len(match.rejected)} of {match.comparisons} figures of "
            f"{posterior!r} differ from the exact ones (Holm, false-alarm rate {match.alpha:g}):"
            f"\n  {shown}{more}"
        )
    return match


# ---- private ------------------------------------------------------------------------------------


class _Table:
    """Comparisons as they come in."""

    def __init__(self, tolerance: float, min_count: float) -> None:
        self.tolerance = tolerance
        self.min_count = min_count
        self.comparisons: list[Comparison] = []
        self.skipped = 0

    def add(self, what: str, found: float, exact: float, errors: float, p_value: float) -> None:
        comparison = Comparison(what, float(found), float(exact), float(errors), float(p_value))
        self.comparisons.append(comparison)

    def is_close(self, found: float, exact: float, scale: float = 1.0) -> bool:
        return bool(abs(found - exact) <= self.tolerance * max(scale, abs(exact)))

    def equal(self, what: str, found: float, exact: float, scale: float = 1.0) -> None:
        """A figure without Monte Carlo error."""
        near = self.is_close(found, exact, scale)
        self.add(what, found, exact, 0.0 if near else np.inf, 1.0 if near else 0.0)

    def normal(
        self, what: str, found: float, exact: float, error: float, scale: float = 1.0
    ) -> None:
        """A figure with a normal error; what the tolerance explains does not count."""
        excess = max(abs(found - exact) - self.tolerance * max(scale, abs(exact)), 0.0)
        z = excess / error
        self.add(what, found, exact, z, 2.0 * float(scipy.special.ndtr(-z)))


def _compare_evidence(table: _Table, posterior: Any, exact: Any) -> None:
    found, value = posterior.log_marginal_likelihood, exact.log_marginal_likelihood
    if found is None or value is None:
        return
    error = posterior.log_marginal_likelihood_mcse
    if not np.isfinite(found):
        table.equal("log evidence", found, value)
    elif not error:
        table.equal("log evidence", found, value)
    elif error > 1.0 / np.sqrt(_MIN_ESS):
        table.skipped += 1
    else:
        # the estimate of the likelihood itself is unbiased and nearly normal, its log is not
        table.normal("log evidence (ratio)", float(np.exp(found - value)), 1.0, error)


def _compare_states(table: _Table, posterior: Any, exact: Any, name: str, node: Any) -> None:
    found, value = posterior.probabilities(name), exact.probabilities(name)
    if found.shape != value.shape:
        raise AssertionError(
            f"node {name!r}: probabilities of shape {found.shape}, not {value.shape}"
        )
    count = np.broadcast_to(_effective(posterior, name, node)[..., None], value.shape[:-1] + (1,))
    for at in np.ndindex(value.shape):
        p, q, n = float(value[at]), float(found[at]), float(count[(*at[:-1], 0)])
        what = f"node {name!r}{_element(at[:-1])}, state {node.domain.states[at[-1]]!r}"
        if p == 0.0 or p > 1 - 1e-12 or not np.isfinite(n) or not np.isfinite(q):
            if p == 0.0 and table.tolerance < 1e-6:
                exactly = table.is_close(q, 0.0) if not np.isfinite(n) else q == 0.0
                table.add(what, q, p, 0.0 if exactly else np.inf, 1.0 if exactly else 0.0)
            else:
                table.equal(what, q, p)
        elif n * p * (1 - p) < table.min_count:
            table.skipped += 1
        else:
            _add_binomial(table, what, q, p, n)


def _add_binomial(table: _Table, what: str, q: float, p: float, n: float) -> None:
    """Two-sided binomial tail at ``n`` effective draws, interpolated by the incomplete beta function."""
    off = q - p
    off = np.sign(off) * max(abs(off) - table.tolerance, 0.0)
    k = min(max(n * (p + off), 0.0), n)
    above = float(scipy.special.betainc(k, n - k + 1, p)) if k > 0 else 1.0
    below = 1.0 - float(scipy.special.betainc(k + 1, n - k, p)) if k < n else 1.0
    error = np.sqrt(p * (1 - p) / n)
    table.add(what, q, p, abs(off) / error, min(1.0, 2 * min(above, below)))


def _compare_mean(table: _Table, posterior: Any, exact: Any, name: str, node: Any) -> None:
    found, value = np.asarray(posterior.mean(name)), np.asarray(exact.mean(name))
    if found.shape != value.shape:
        raise AssertionError(f"node {name!r}: mean of shape {found.shape}, not {value.shape}")
    spread = np.sqrt(np.maximum(exact.var(name), 0.0))
    count = np.broadcast_to(_effective(posterior, name, node), value.shape)
    error = np.broadcast_to(posterior.mcse(name), value.shape)
    for at in np.ndindex(value.shape):
        what = f"mean of node {name!r}{_element(at)}"
        m, x, sd, n = float(value[at]), float(found[at]), float(spread[at]), float(count[at])
        if not np.isfinite(n) or not np.isfinite(x) or sd <= 1e-9 * max(1.0, abs(m)):
            table.equal(what, x, m, max(sd, 1.0))
        elif n < _MIN_ESS:
            table.skipped += 1
        else:
            table.normal(what, x, m, max(sd / np.sqrt(n), float(error[at])), sd)


def _effective(posterior: Any, name: str, node: Any) -> np.ndarray:
    """Effective number of draws behind each element; the worst of its states for labels."""
    ess = np.asarray(posterior.ess(name), dtype=float)
    if node.domain is not None and node.domain.labels is not None:
        ess = ess.min(axis=-1)
    ess = np.where(np.isnan(ess), np.inf if posterior.weight_ess is None else ess, ess)
    return ess if posterior.weight_ess is None else np.fmin(ess, posterior.weight_ess)


def holm(p_values: Sequence[float], alpha: float) -> int:
    """How many p-values, smallest first, Holm's step-down procedure rejects (Holm 1979)."""
    count = len(p_values)
    kept = (k for k, p in enumerate(p_values) if not p * (count - k) < alpha)
    return next(kept, count)


def _element(at: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, at))}]" if at else ""
