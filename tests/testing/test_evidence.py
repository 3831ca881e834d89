"""Holds the test of unbiased evidence to its level, and lets it find planted faults.

Seeds are fixed; each check of a right estimate has a false-alarm rate of 1e-3 over fresh seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import DegeneracyError, DensityError, UnsupportedError, ZeroProbabilityError
from bayesmc.testing import exact
from bayesmc.testing.posteriors.evidence import _judged, unbiased_evidence_test
from bayesmc.testing.verdict import BUDGET

#: log density of y = 1.5 under Normal(0, sqrt 2), which `weighting` estimates
LOG_Z = -0.5 * 1.5**2 / 2 - 0.5 * math.log(2 * math.pi * 2)


def net() -> bmc.BayesNet:
    declared = bmc.BayesNet()
    declared.add("k", bmc.Bernoulli(0.4))
    declared.add("x", lambda k: bmc.Normal(2.0 * k, 1.0))
    declared.add("y", lambda x: bmc.Normal(0.5 * x, 0.7))
    return declared


def template() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


#: a series with a gap
SERIES = {"y": [0.5, -0.3, np.nan, 1.4]}

LOOKING = {
    "k": lambda y: bmc.Bernoulli(0.5 * y),
    "x": lambda k, y: bmc.StudentT(4.0, k + y, 1.0),
}


def log_normal(x: Any, loc: Any = 0.0, scale: float = 1.0) -> Any:
    return -0.5 * ((x - loc) / scale) ** 2 - math.log(scale * math.sqrt(2 * math.pi))


def weighting(rng: np.random.Generator, draws: int = 6) -> np.ndarray:
    """Log weights of draws of a Normal(0, 1) whose sum with a Normal(0, 1) was 1.5."""
    return log_normal(1.5, rng.normal(size=draws))


def mean_of(log_weights: np.ndarray) -> float:
    return float(np.logaddexp.reduce(log_weights) - np.log(len(log_weights)))


# ---- right estimates ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "engine",
    [bmc.LikelihoodWeighting(5), bmc.Importance(4, LOOKING), bmc.Rejection(5), bmc.Exact()],
    ids=lambda e: type(e).__name__,
)
def test_engines_are_unbiased(engine: Any) -> None:
    found = unbiased_evidence_test(engine, net(), {"y": 1.3}, replications=200, rng=1)
    assert found
    assert not found.uneven
    spread = np.log(found.ratios).std()
    assert spread < 1e-12 if isinstance(engine, bmc.Exact) else 0.1 < spread < 1.2


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
def test_particle_filters_are_unbiased(threshold: float) -> None:
    engine = bmc.ParticleFilter(8, ess_threshold=threshold)
    assert unbiased_evidence_test(engine, template(), SERIES, replications=200, rng=2)


def test_elements_of_a_plate_that_are_filtered_apart_count_together() -> None:
    dbn = bmc.DynamicBayesNet(plates={"i": 2})
    dbn.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 1.0), initial=bmc.Normal(0, 1), plates="i")
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    series = {"y": [[0.5, 1.0], [-0.3, 0.2]]}
    found = unbiased_evidence_test(bmc.ParticleFilter(8), dbn, series, replications=100, rng=0)
    assert found
    assert found.ratios.shape == (100,)


def test_the_exact_evidence_may_be_a_number_or_a_posterior() -> None:
    kalman = bmc.filter(template(), SERIES, engine=bmc.KalmanFilter())
    one = unbiased_evidence_test(
        bmc.KalmanFilter(), template(), SERIES, exact=kalman, replications=100
    )
    assert one
    assert one.log_exact == pytest.approx(kalman.log_marginal_likelihood)
    assert (
        one.log_exact
        == unbiased_evidence_test(
            lambda rng: one.log_exact, exact=one.log_exact, replications=100
        ).log_exact
    )


def test_a_function_needs_no_net() -> None:
    found = unbiased_evidence_test(lambda rng: mean_of(weighting(rng)), exact=LOG_Z, rng=0)
    assert found
    assert found.ratios.shape == (1000,)
    again = unbiased_evidence_test(lambda rng: mean_of(weighting(rng)), exact=LOG_Z, rng=0)
    np.testing.assert_array_equal(found.ratios, again.ratios)


def test_runs_without_a_possible_draw_estimate_zero() -> None:
    """Left out, they would leave estimates that are too large."""
    coin = bmc.BayesNet()
    coin.add("a", bmc.Bernoulli(0.3))
    coin.table("b", ["a"], [[1.0, 0.0], [0.0, 1.0]])
    found = unbiased_evidence_test(bmc.LikelihoodWeighting(3), coin, {"b": 1}, rng=0)
    assert found
    assert 0.25 < (found.ratios == 0.0).mean() < 0.45

    def lost(rng: np.random.Generator) -> float:
        if rng.random() < 0.5:
            raise DegeneracyError("no weight is left", 0)
        return math.log(2.0)

    assert unbiased_evidence_test(lost, exact=0.0, rng=0)


# ---- planted faults -----------------------------------------------------------------------------


def forgetting(right: bool) -> Callable[[np.random.Generator], float]:
    """A particle filter that resamples now and then, and forgets earlier weights where it does not."""

    def estimate(rng: np.random.Generator) -> float:
        x, log_weights, total = rng.normal(size=10), np.zeros(10), 0.0
        for t, y in enumerate([1.5, -1.0, 2.0]):
            x = 0.8 * x + rng.normal(size=10) if t else x
            before = log_weights if right else np.zeros(10)
            log_weights = log_weights + log_normal(y, x)
            new = log_normal(y, x)
            total += np.logaddexp.reduce(before + new) - np.logaddexp.reduce(before)
            weights = np.exp(log_weights - log_weights.max())
            weights /= weights.sum()
            if 1.0 / (weights**2).sum() < 3.0:
                x, log_weights = rng.choice(x, size=10, p=weights), np.zeros(10)
        return float(total)

    return estimate


def test_a_filter_that_forgets_earlier_weights_is_caught() -> None:
    series = {"y": [1.5, -1.0, 2.0]}
    exact = bmc.filter(template(), series, engine=bmc.KalmanFilter())
    assert unbiased_evidence_test(forgetting(True), exact=exact, replications=600, rng=0)
    found = unbiased_evidence_test(forgetting(False), exact=exact, replications=600, rng=0)
    assert not found
    assert "mean of estimated over exact evidence: " in repr(found)
    assert "standard errors" in repr(found)


def importance(rng: np.random.Generator, sign: float) -> float:
    """Draws of Normal(0.7, 0.8) for the Normal(0, 1); ``sign`` of the log of p/q."""
    x = rng.normal(0.7, 0.8, size=8)
    ratio = log_normal(x) - log_normal(x, 0.7, 0.8)
    return mean_of(log_normal(1.5, x) + sign * ratio)


FAULTS: dict[str, Callable[[np.random.Generator], float]] = {
    "mean of logs": lambda rng: float(weighting(rng).mean()),
    "one draw too few in the mean": lambda rng: mean_of(weighting(rng)) + math.log(6 / 5),
    "largest weight": lambda rng: float(weighting(rng).max()),
    "q/p": lambda rng: importance(rng, -1.0),
    "no p/q": lambda rng: importance(rng, 0.0),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_wrong_estimates_are_caught(fault: str) -> None:
    found = unbiased_evidence_test(FAULTS[fault], exact=LOG_Z, replications=600, rng=0)
    assert not found
    assert found.comparisons[0].errors > 3.0


def test_a_right_proposal_passes() -> None:
    assert unbiased_evidence_test(lambda rng: importance(rng, 1.0), exact=LOG_Z, rng=0)


def test_what_has_no_error_must_be_equal() -> None:
    assert not unbiased_evidence_test(lambda rng: 1e-6, exact=0.0, replications=100)
    assert unbiased_evidence_test(lambda rng: 1e-12, exact=0.0, replications=100)


# ---- the level, and where there is none ---------------------------------------------------------

LAWS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "lognormal": lambda rng: np.exp(rng.normal(-0.5, 1.0, 1000)),
    "gamma": lambda rng: rng.gamma(0.2, 5.0, 1000),
    "mostly zero": lambda rng: (rng.random(1000) < 0.05) * 20.0,
}


def logs_of(ratios: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log(ratios)


@pytest.mark.parametrize("law", LAWS)
def test_the_level_holds_for_skewed_ratios(law: str) -> None:
    """At most 9 alarms of 300 at level 0.01 but for a chance of 1e-3; Student's t is over it."""
    rng = np.random.default_rng(3)
    alarms = sum(_judged(logs_of(LAWS[law](rng)), 0.0)[0].p_value < 0.01 for _ in range(300))
    assert alarms <= stats.binom.ppf(0.999, 300, 0.01)


def test_ratios_that_are_too_uneven_are_not_called_too_small() -> None:
    """Their mean is 1, but nearly all are far below and the rest have not come up."""
    found = unbiased_evidence_test(lambda rng: rng.normal(-8.0, 4.0), exact=0.0, rng=1)
    assert found.ratios.mean() < 0.5
    assert stats.ttest_1samp(found.ratios, 1.0).pvalue < 1e-3
    assert not found.rejected
    assert found.uneven
    assert "too uneven to tell whether their mean is too small" in repr(found)


def test_what_was_not_judged_is_not_true() -> None:
    """No alarm either: nothing is rejected, and the text says what to do."""
    found = unbiased_evidence_test(lambda rng: rng.normal(-8.0, 4.0), exact=0.0, rng=1)
    assert not found
    assert not found.judged
    assert "not judged: the ratios are worth" in repr(found)
    assert "take more draws in each run, so that runs are more even" in repr(found)
    none = unbiased_evidence_test(lambda rng: -math.inf, exact=0.0, replications=100)
    assert not none
    assert (none.rejected, none.judged, none.uneven, none.ess) == ((), False, True, 0.0)
    assert "not judged: every run of 100 estimated zero" in repr(none)


@pytest.mark.parametrize("off", [-1e6, -800.0, -40.0, 40.0, 800.0, 1e6])
@pytest.mark.parametrize("spread", [0.0, 1e-6, 0.5])
def test_estimates_that_are_off_by_more_than_floats_hold(off: float, spread: float) -> None:
    found = unbiased_evidence_test(
        lambda rng: off + spread * rng.normal(), exact=0.0, replications=100, rng=0
    )
    assert [c.p_value for c in found.rejected] == [pytest.approx(0.0, abs=1e-6)]
    assert not found
    uneven = unbiased_evidence_test(
        lambda rng: off + 8.0 * rng.normal(), exact=0.0, replications=100, rng=0
    )
    assert not uneven
    assert uneven.judged == (off > 0)


def test_ratios_that_are_too_uneven_are_called_too_large() -> None:
    found = unbiased_evidence_test(lambda rng: rng.normal(-2.0, 4.0), exact=0.0, rng=0)
    assert found.uneven
    assert not found
    rng = np.random.default_rng(0)
    alarms = 0
    for _ in range(400):
        alarms += _judged(rng.normal(-4.5, 3.0, 200), 0.0)[0].p_value < 0.05
    assert alarms <= stats.binom.ppf(0.999, 400, 0.05)


# ---- what it says -------------------------------------------------------------------------------


def test_its_alpha_is_in_the_budget() -> None:
    before = BUDGET.spent.get("unbiased_evidence_test", 0.0)
    unbiased_evidence_test(lambda rng: 0.0, exact=0.0, replications=100, alpha=0.25)
    assert BUDGET.spent["unbiased_evidence_test"] == pytest.approx(before + 0.25)


def test_wrong_arguments_are_named() -> None:
    y = {"y": 1.3}
    with pytest.raises(ValueError, match=r"replications=10\): give a whole number, at least 100"):
        unbiased_evidence_test(bmc.Exact(), net(), y, replications=10)
    with pytest.raises(ValueError, match=r"alpha=0\): give a probability"):
        unbiased_evidence_test(bmc.Exact(), net(), y, alpha=0)
    with pytest.raises(ValueError, match="give a net and evidence, or exact="):
        unbiased_evidence_test(lambda rng: 0.0)
    with pytest.raises(ValueError, match="needs a net"):
        unbiased_evidence_test(bmc.Exact(), exact=0.0)
    with pytest.raises(TypeError, match="has no log evidence; give a number"):
        unbiased_evidence_test(bmc.Exact(), net(), y, exact="0.1")
    with pytest.raises(TypeError, match="give an engine such as LikelihoodWeighting"):
        unbiased_evidence_test(bmc.LikelihoodWeighting, net(), y)
    with pytest.raises(UnsupportedError, match="the engine gives no log evidence"):
        unbiased_evidence_test(bmc.Gibbs(draws=5, warmup=5, chains=1), net(), y)
    with pytest.raises(ZeroProbabilityError, match="the exact evidence is zero"):
        unbiased_evidence_test(lambda rng: 0.0, exact=-math.inf)
    with pytest.raises(DensityError, match="run 0 estimated a log evidence of nan"):
        unbiased_evidence_test(lambda rng: math.nan, exact=0.0)
    with pytest.raises(TypeError, match="return one real number"):
        unbiased_evidence_test(lambda rng: np.zeros(3), exact=0.0)


def test_static_nodes_that_a_filter_knows_are_no_evidence() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("m", bmc.Normal(0.0, 2.0))
    dbn.add("x", lambda x_prev, m: bmc.Normal(x_prev + m, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    rows = {"m": 1.3, "y": [0.3, 1.1]}
    for engine in (bmc.ParticleFilter(20), bmc.KalmanFilter()):
        assert unbiased_evidence_test(engine, dbn, rows, replications=100, alpha=1e-4, rng=0)
        options = {"replications": 100, "alpha": 1e-4, "rng": 0}
        assert unbiased_evidence_test(engine, dbn, rows, exact=exact(dbn, rows), **options)
        whole = exact(dbn, rows).log_marginal_likelihood
        assert not unbiased_evidence_test(engine, dbn, rows, exact=whole, **options)
