"""Is an estimate of the evidence unbiased? Its mean over the exact one, in many runs, must be 1.

Weighting, rejection and particle filters estimate the probability of the evidence without bias, however few
draws they make; a weight that is forgotten, inverted or reset shows here although no posterior is looked at.
How good an estimate is (its variance) is not judged.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from bayesmc.auto import filter as filter_series
from bayesmc.categorical import log_sum_exp
from bayesmc.diagnostics import pareto_k
from bayesmc.engines.base import Engine
from bayesmc.engines.filtering import FilterEngine
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import (
    BayesmcWarning,
    DegeneracyError,
    DensityError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.randomness import seed_sequence
from bayesmc.testing.kernels.joint import check_sizes
from bayesmc.testing.oracles.answers import exact as exact_answer
from bayesmc.testing.posteriors.skewed import mean_p_value
from bayesmc.testing.verdict import Comparison, Verdict, check_level, counted

_CALL = "unbiased_evidence_test"
#: shape of the tail of the ratios from which on their variance may be infinite
_HEAVY = 0.5
#: runs that the ratios must be worth at least
_FEW = 30.0
#: share of the runs above which ratios are even enough, whatever their tail
_EVEN = 0.5
#: the figure that is judged
_WHAT = "mean of estimated over exact evidence"
#: standard errors beyond which it does not matter how many
_FAR = 1e6
#: logs of numbers that are held within floating point
_LARGEST = 700.0
#: relative difference of an estimate without Monte Carlo error
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class EvidenceResult(Verdict):
    """What `unbiased_evidence_test` found.

    Attributes
    ----------
    ratios : ndarray, shape (replications,)
        Estimated over exact evidence, one of each run; infinite beyond floating point.
    log_exact : float
        Log of the exact evidence.
    ess : float
        Runs of equal ratios that these are worth; 0 where all are zero.
    tail : float
        Shape of the tail of the ratios (Pareto k); NaN or minus infinity where they have none.
    """

    ratios: np.ndarray
    log_exact: float
    ess: float
    tail: float

    @property
    def uneven(self) -> bool:
        """Whether the ratios are so uneven that only a mean above 1 could be judged."""
        return _is_uneven(self.ess, self.tail, len(self.ratios))

    @property
    def judged(self) -> bool:
        """Whether the mean was judged: not where ratios are uneven, unless it is too large."""
        return not self.uneven or bool(self.rejected)

    def __bool__(self) -> bool:
        return self.judged and not self.rejected

    def _remarks(self) -> list[str]:
        if not self.uneven:
            return []
        if self.ess == 0.0:
            reason = f"every run of {len(self.ratios)} estimated zero"
        else:
            reason = (
                f"the ratios are worth {self.ess:.0f} of {len(self.ratios)} runs, with tail shape "
                f"{self.tail:.2g}: too uneven to tell whether their mean is too small"
            )
        return [
            f"  {'' if self.judged else 'not judged: '}{reason}; take more draws in each run, so that runs "
            "are more even, or better proposals, or likelier evidence"
        ]


def unbiased_evidence_test(
    engine: Any,
    net: Any = None,
    evidence: Mapping[str, Any] | None = None,
    *,
    inputs: Mapping[str, Any] | None = None,
    exact: Any = None,
    replications: int = 1000,
    alpha: float = 1e-3,
    rng: Any = None,
) -> EvidenceResult:
    """Test that the mean of estimated over exact evidence is 1.

    The engine is run ``replications`` times with seeds of their own. A run in which no draw is possible
    estimates zero, and counts as such.

    **False-alarm rate.** At most ``alpha`` in the limit of many runs. Ratios are skewed to the right, which
    makes Student's t reject a mean that is right, because its largest ratios have not come up. So each tail
    is judged by t and by Hall's transformation of t, which removes the effect of skewness to first order,
    and the larger p-value is taken. With 1000 runs the rate stays below ``alpha`` = 0.01 for ratios that are
    gamma, zero in most runs, or lognormal with a spread of the logs up to 1.3 (at ``alpha`` = 0.001 it is
    1.5 times that there).

    Where ratios are heavier, with a tail of shape above 0.5, whose variance may be infinite, or worth fewer
    than 30 runs, no test can tell that their mean is too small, and none is tried: ``uneven`` is true. The
    answer is then not true although nothing is ``rejected``, and says that nothing was judged; such an answer
    is no alarm, and not counted in the rate. That their mean is too large is judged by a bet then, at most at
    ``alpha`` whatever their law.

    Parameters
    ----------
    engine : Engine, FilterEngine or callable
        LikelihoodWeighting, Importance, Rejection on a net; ParticleFilter on a template; or a function
        ``estimate(rng)`` that returns the log of an estimate, which needs no net if ``exact`` is given. Take
        few draws: what goes wrong in a run shows in its mean whatever their number, and a bias of logs only
        where they are uneven.
    net : BayesNet or DynamicBayesNet, optional
    evidence : dict, optional
        As for ``infer``; of a template observations, as for ``filter``. To a filter, static nodes that are
        observed are known, and no part of the evidence; to a function of yours they are a part.
    inputs : dict, optional
    exact : float or object, optional
        Log of the exact evidence, or anything with ``log_marginal_likelihood`` (and perhaps
        ``accuracy``, which is added to the tolerance). By default `bayesmc.testing.exact` finds it.
    replications : int
        At least 100.
    alpha : float
        Chance of a false alarm.
    rng : optional
        Seed or generator.

    Returns
    -------
    EvidenceResult
        True if the mean was judged and does not deviate; with ``ratios``.

    Raises
    ------
    UnsupportedError
        The engine gives no evidence, or nothing exact applies.
    DensityError
        An estimate is NaN or infinite.
    ZeroProbabilityError
        The exact evidence is zero, so that there is no ratio.

    References
    ----------
    Hall (1992), On the removal of skewness by transformation, JRSS B 54; Del Moral (2004), Feynman-Kac
    formulae, sec. 7.4.2 (particle filters are unbiased); Vehtari et al. (2024), Pareto smoothed importance
    sampling, JMLR 25; Waudby-Smith and Ramdas (2024), Estimating means of bounded random variables by
    betting, JRSS B 86, sec. 4.

    Examples
    --------
    >>> import math
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import unbiased_evidence_test
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.3))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> weighting = bmc.LikelihoodWeighting(4)
    >>> bool(unbiased_evidence_test(weighting, net, {"x": 1.5}, rng=0))
    True

    A function's estimate of the integral of ``x**2`` over the unit interval, by the mean of the logs.

    >>> def mean_of_logs(rng):
    ...     return (2 * np.log(rng.random(10))).mean()
    >>> import numpy as np
    >>> bool(unbiased_evidence_test(mean_of_logs, exact=math.log(1 / 3), rng=0))
    False
    """
    check_sizes(_CALL, replications=(replications, 100))
    check_level(_CALL, alpha)
    log_exact, accuracy = _exact(engine, net, evidence, inputs, exact)
    estimate = _estimator(engine, net, evidence, inputs)
    seeds = seed_sequence(rng).spawn(replications)
    logs = np.array([_one(estimate, seed) for seed in seeds])
    bad = np.isnan(logs) | (logs == np.inf)
    if bad.any():
        run = int(np.flatnonzero(bad)[0])
        raise DensityError(
            f"{_CALL}: run {run} estimated a log evidence of {logs[run]:.6g}, against {log_exact:.6g} exact; "
            "estimates must be finite logs, or minus infinity for zero"
        )
    with np.errstate(over="ignore"):
        ratios = np.exp(logs - log_exact)
    ratios.flags.writeable = False
    figure, ess, tail = _judged(logs - log_exact, accuracy)
    return counted(
        EvidenceResult(
            _CALL, alpha, [figure], ratios=ratios, log_exact=log_exact, ess=ess, tail=tail
        )
    )


# ---- what is asked -------------------------------------------------------------------------------


def _exact(engine: Any, net: Any, evidence: Any, inputs: Any, exact: Any) -> tuple[float, float]:
    """Log of the exact evidence, and its error."""
    if exact is None:
        if net is None:
            raise ValueError(
                f"{_CALL}: give a net and evidence, or exact=, the log of the evidence that is estimated"
            )
        exact = exact_answer(net, evidence, inputs)
    value = getattr(exact, "log_marginal_likelihood", exact)
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise TypeError(
            f"{_CALL}: exact={exact!r} has no log evidence; give a number, or a posterior that has a "
            "log_marginal_likelihood"
        )
    if value == -math.inf:
        raise ZeroProbabilityError(
            f"{_CALL}: the exact evidence is zero, so that there is no ratio; give possible evidence"
        )
    if not math.isfinite(value):
        raise ValueError(f"{_CALL}: exact log evidence {value}; give a finite number")
    # the evidence of a filter is that of the rows alone
    static = getattr(exact, "log_static", None) if isinstance(engine, FilterEngine) else None
    return float(value) - (static or 0.0), float(getattr(exact, "accuracy", 0.0) or 0.0)


def _estimator(
    engine: Any, net: Any, evidence: Any, inputs: Any
) -> Callable[[np.random.SeedSequence], Any]:
    """A run as a function of its seed."""
    if net is None and isinstance(engine, (Engine, FilterEngine)):
        raise ValueError(f"{_CALL}: an engine needs a net to run on; give net and evidence")
    if isinstance(engine, FilterEngine):
        return partial(_filtered, engine, net, evidence, inputs)
    if isinstance(engine, Engine):
        problem = pose_any(net, evidence, inputs)
        refusal = engine.refusal(problem)
        if refusal is not None:
            raise UnsupportedError(f"{_CALL}: {refusal}")
        return lambda seed: (
            engine.run(
                problem, seed_sequence(seed), keep=[], progress=False
            ).log_marginal_likelihood
        )
    if callable(engine) and not isinstance(engine, type):
        return lambda seed: engine(np.random.default_rng(seed))
    raise TypeError(
        f"{_CALL}: engine={engine!r}; give an engine such as LikelihoodWeighting(10) or ParticleFilter(50), "
        "or a function estimate(rng) that returns the log of an estimate"
    )


def _filtered(engine: Any, net: Any, evidence: Any, inputs: Any, seed: Any) -> Any:
    found = filter_series(net, evidence, inputs=inputs, engine=engine, rng=seed, progress=False)
    total = found.log_marginal_likelihood
    # plates that are filtered apart have estimates of their own, independent of each other
    return None if total is None else float(np.sum(total))


def _one(estimate: Callable[[np.random.SeedSequence], Any], seed: np.random.SeedSequence) -> float:
    """Log evidence of one run."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", BayesmcWarning)
            found = estimate(seed)
    except (DegeneracyError, ZeroProbabilityError):
        return -math.inf  # the evidence is possible, and no draw shows it: an estimate of zero
    if found is None:
        raise UnsupportedError(
            f"{_CALL}: the engine gives no log evidence; LikelihoodWeighting, Importance, Rejection and "
            "ParticleFilter do, and a function estimate(rng) returns the log of its estimate"
        )
    if np.ndim(found) != 0 or np.asarray(found).dtype.kind not in "iuf":
        raise TypeError(
            f"{_CALL}: an estimate is {found!r}; return one real number, the log of the estimate"
        )
    return float(found)


# ---- the decision --------------------------------------------------------------------------------


def _judged(logs: np.ndarray, accuracy: float) -> tuple[Comparison, float, float]:
    """The mean of ratios, given by their logs, against 1; what the ratios are worth, and their tail.

    All is reckoned in units of the largest ratio, since logs may be off by more than floats can hold.
    """
    count, top = len(logs), float(logs.max())
    if top == -math.inf:
        return Comparison(_WHAT, 0.0, 1.0, 0.0, 1.0), 0.0, math.nan
    scaled = np.exp(logs - top)
    mean, spread = float(scaled.mean()), float(scaled.std(ddof=1))
    found = _bounded(top + math.log(mean))
    tolerance = accuracy + _ROUNDING
    if spread <= _ROUNDING * mean:
        off = 0.0 if abs(found - 1.0) <= tolerance else math.inf
        equal = Comparison(_WHAT, found, 1.0, off, 1.0 if off == 0.0 else 0.0)
        return equal, float(count), math.nan
    # what the error of the exact value explains does not count
    one = _bounded(-top)
    off = math.copysign(max(abs(mean - one) - tolerance * one, 0.0), mean - one)
    z = min(max(off / (spread / math.sqrt(count)), -_FAR), _FAR)
    ess = float(scaled.sum() ** 2 / (scaled**2).sum())
    tail = pareto_k(logs, count)
    if _is_uneven(ess, tail, count):
        p_value = _too_large(logs - math.log1p(tolerance))
    else:
        p_value = mean_p_value(scaled, z)
    return Comparison(_WHAT, found, 1.0, abs(z), p_value), ess, tail


def _bounded(log: float) -> float:
    """The exponential, held within floating point."""
    return math.exp(min(max(log, -_LARGEST), _LARGEST))


def _is_uneven(ess: float, tail: float, count: int) -> bool:
    # ratios that are even have few values at times, and a tail fitted to those says nothing
    return ess < _FEW or (ess < _EVEN * count and tail > _HEAVY)


def _too_large(logs: np.ndarray) -> float:
    """p-value of a mean of at most 1, exact for all nonnegative numbers (Waudby-Smith and Ramdas 2024).

    Who bets a fixed share on each ratio to exceed 1 multiplies his stake on average by at most 1, whatever
    their law; by Markov's inequality one over the stake is a p-value. The stake is spread over some shares.
    """
    shares = 0.5 ** np.arange(1, 12)[:, None]
    gains = np.logaddexp(np.log1p(-shares), np.log(shares) + logs).sum(axis=1)
    return min(1.0, math.exp(-max(float(log_sum_exp(gains)) - math.log(len(shares)), 0.0)))
