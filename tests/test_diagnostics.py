"""Effective sizes, Monte Carlo errors and tails against closed forms and ArviZ."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import scipy.stats
from arviz_stats.base import array_stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bayesmc import diagnostics
from bayesmc.categorical import log_sum_exp

logs = hnp.arrays(float, st.integers(1, 20), elements=st.floats(-700, 700) | st.just(-np.inf))


@given(logs)
def test_log_sum_exp_is_scipys(values):
    got = log_sum_exp(values)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(got, scipy.special.logsumexp(values), rtol=1e-12, atol=1e-15)


def test_log_sum_exp_edges_and_axes():
    assert log_sum_exp(np.empty(0)) == -np.inf
    assert log_sum_exp(np.full(3, -np.inf)) == -np.inf
    assert log_sum_exp(np.array([1e5, 1e5])) == pytest.approx(1e5 + np.log(2))
    values = np.random.default_rng(0).normal(size=(3, 4, 2)) * 100
    for axis in (0, -1, (0, 2)):
        np.testing.assert_allclose(
            log_sum_exp(values, axis=axis), scipy.special.logsumexp(values, axis=axis)
        )


def test_weights_and_their_ess():
    lw = np.array([[0.0, 0.0, -np.inf, 0.0]])
    assert diagnostics.weight_ess(lw) == pytest.approx(3.0)
    assert diagnostics.weight_ess(lw - 5000.0) == pytest.approx(3.0)
    weights = diagnostics.normalised(lw + 5000.0)
    np.testing.assert_allclose(weights, [[1 / 3, 1 / 3, 0, 1 / 3]])
    one = np.array([[0.0, -800.0, -900.0]])
    assert diagnostics.weight_ess(one) == pytest.approx(1.0)


def test_weighted_moments_by_hand():
    values = np.array([[[1.0, 10.0], [2.0, 10.0], [4.0, 10.0]]])
    weights = np.array([[0.5, 0.25, 0.25]])
    np.testing.assert_allclose(diagnostics.weighted_mean(values, weights), [2.0, 10.0])
    np.testing.assert_allclose(diagnostics.weighted_mean(values, None), [7 / 3, 10.0])
    error = np.sqrt(0.25 * 1 + 0.0625 * 0 + 0.0625 * 4)
    np.testing.assert_allclose(diagnostics.weighted_mcse(values, weights), [error, 0.0])
    ess = diagnostics.weighted_ess(values, weights)
    np.testing.assert_allclose(ess, [1.5 / error**2, 1 / 0.375])


def test_weighted_mcse_is_the_error_seen():
    """Spread over 400 repetitions of an importance-sampled mean against the mean of its mcse.

    A chi-square of 399 degrees of freedom keeps the ratio within 15 % but for about 1e-4.
    """
    rng = np.random.default_rng(1)
    means, errors = [], []
    for _ in range(400):
        x = rng.normal(size=(1, 500))
        weights = diagnostics.normalised(0.7 * x)  # tilts N(0, 1) to N(0.7, 1)
        means.append(float(diagnostics.weighted_mean(x, weights)))
        errors.append(float(diagnostics.weighted_mcse(x, weights)))
    assert np.mean(means) == pytest.approx(0.7, abs=5 * np.std(means) / 20)
    assert np.std(means) / np.mean(errors) == pytest.approx(1.0, abs=0.15)
    # negative control: the unweighted formula is far off
    assert abs(np.std(means) / (1 / np.sqrt(500)) - 1) > 0.15


@pytest.mark.parametrize("k", [0.2, 0.5, 0.9])
def test_pareto_k_finds_the_shape_of_a_pareto_tail(k):
    """Weights with a generalised Pareto tail of known shape; the fit's spread at 20 000 is about 0.05."""
    u = np.random.default_rng(3).random(20_000)
    weights = np.log1p(np.expm1(-k * np.log(u)) / k)  # 1 + a GPD of shape k
    assert diagnostics.pareto_k(weights, len(weights)) == pytest.approx(k, abs=0.2)
    _, reference = array_stats.psislw(-weights)
    assert diagnostics.pareto_k(weights, len(weights)) == pytest.approx(float(reference), abs=0.05)


@pytest.mark.parametrize("family", ["exponential", "student"])
def test_pareto_k_is_arvizs_whatever_the_number_of_weights(family):
    """One weight less in the tail is another fit, and a cut at the tail itself has no excess."""
    # numbers of weights at which the tail's length is whole; ArviZ rounds it down elsewhere, and we up
    few = [25, 30, 40, 60, 100, 220, 225]
    # tails of 339 and 609 weights (113 and 203 squared) are easily one short by rounding
    squares = [m * m for m in (16, 17, 39, 40, 71, 100, 113, 150, 203)]
    for n in few + squares:
        rng = np.random.default_rng(n)
        lw = 1.5 * rng.exponential(size=n) if family == "exponential" else rng.standard_t(3, n)
        _, k = array_stats.psislw(-lw, r_eff=1.0)
        assert diagnostics.pareto_k(lw, n) == pytest.approx(float(k), abs=1e-6), n


def test_pareto_k_needs_only_the_tail():
    lw = np.random.default_rng(4).normal(size=50_000) * 1.5
    tail = np.sort(lw)[-5 * diagnostics.tail_length(len(lw)) :]
    assert diagnostics.pareto_k(tail, len(lw)) == pytest.approx(diagnostics.pareto_k(lw, len(lw)))
    assert diagnostics.pareto_k(lw + 1000.0, len(lw)) == pytest.approx(
        diagnostics.pareto_k(lw, len(lw)), abs=1e-6
    )


def test_pareto_k_of_weights_of_which_one_is_all():
    assert diagnostics.pareto_k(np.linspace(-9000.0, 0.0, 100), 100) == np.inf


def test_pareto_k_of_equal_and_of_few_weights():
    assert diagnostics.pareto_k(np.zeros(1000), 1000) == -np.inf
    assert np.isnan(diagnostics.pareto_k(np.arange(10.0), 10))


def test_tail_length_is_vehtaris():
    assert diagnostics.tail_length(100) == 20  # 0.2 n
    assert diagnostics.tail_length(10_000) == 300  # 3 sqrt n
    assert [diagnostics.tail_length(n) for n in (225, 226)] == [45, 46]


@pytest.mark.parametrize("kind", ["ess", "rhat", "mcse"])
def test_chain_statistics_are_arvizs(kind):
    rng = np.random.default_rng(5)
    values = np.cumsum(rng.normal(size=(4, 200, 2, 3)), axis=1) * 0.1 + rng.normal(
        size=(4, 200, 2, 3)
    )
    got = diagnostics.chain_statistic(kind, values)
    assert got.shape == (2, 3)
    for i in np.ndindex(2, 3):
        one = getattr(array_stats, kind)(values[(..., *i)], chain_axis=0, draw_axis=1)
        np.testing.assert_allclose(got[i], one, rtol=1e-10)


def test_chain_statistics_of_constants_and_of_too_few():
    constant = np.full((2, 50, 3), 7.0)
    assert diagnostics.chain_statistic("ess", constant).tolist() == [100.0] * 3
    assert diagnostics.chain_statistic("mcse", constant).tolist() == [0.0] * 3
    assert np.isnan(diagnostics.chain_statistic("rhat", constant)).all()
    assert np.isnan(diagnostics.chain_statistic("ess", np.zeros((2, 3, 2)))).all()


def test_rhat_sees_chains_that_disagree():
    rng = np.random.default_rng(6)
    good = rng.normal(size=(4, 500))
    bad = good + np.array([[0.0], [0.0], [0.0], [3.0]])
    assert diagnostics.chain_statistic("rhat", good) < 1.02
    assert diagnostics.chain_statistic("rhat", bad) > 1.3


_ARVIZ = {
    "ess": ("ess", {"method": "bulk"}),
    "tail_ess": ("ess", {"method": "tail", "prob": 0.05}),
    "mean_ess": ("ess", {"method": "mean"}),
    "rhat": ("rhat", {}),
    "nested": ("rhat_nested", {}),
}


@pytest.mark.parametrize("kind", _ARVIZ)
def test_figures_of_few_and_odd_draws_are_arvizs(kind):
    """Short chains, odd ones, ties, two values, heavy tails, chains apart: all as ArviZ has them."""
    rng = np.random.default_rng(7)
    name, options = _ARVIZ[kind]
    for _ in range(150):
        chains, draws = int(rng.choice([4, 8, 16])), int(rng.choice([4, 5, 7, 9, 13, 50, 101]))
        x, r = rng.normal(size=(chains, draws)), rng.choice([-0.6, 0.0, 0.5, 0.95])
        for k in range(1, draws):
            x[:, k] = r * x[:, k - 1] + np.sqrt(1 - r * r) * x[:, k]
        shapes = (np.round, lambda x: x > 1, lambda x: np.exp(3 * x), lambda x: x + x[:, :1])
        x = shapes[rng.integers(4)](x).astype(float)
        if kind == "nested":
            options = {"superchain_ids": np.repeat(np.arange(chains // 2), 2)}
            got = diagnostics.chain_statistic("rhat", x, superchains=chains // 2)
        else:
            got = diagnostics.chain_statistic(kind, x)
        with np.errstate(all="ignore"):
            scaled = np.ldexp(x, -np.frexp(np.ptp(x))[1])
            one = float(getattr(array_stats, name)(scaled, chain_axis=0, draw_axis=1, **options))
        if not (got == np.inf and one > 1e5):  # chains that stand still
            np.testing.assert_allclose(got, one, rtol=1e-9)


def test_nested_rhat_asks_whether_starts_are_forgotten():
    """Short chains that mix have a large R-hat and a small nested one; those that remember have both."""
    rng = np.random.default_rng(8)
    short = np.cumsum(rng.normal(size=(64, 4, 400)), axis=1)[:, -1, ::8] * 0.5
    slow = np.empty((64, 12))
    slow[:, 0] = rng.normal(size=64)
    for k in range(1, 12):
        slow[:, k] = 0.8 * slow[:, k - 1] + 0.6 * rng.normal(size=64)
    remembered = slow + np.repeat(rng.normal(size=8), 8)[:, None]
    assert diagnostics.chain_statistic("rhat", slow) > 1.1
    assert diagnostics.chain_statistic("rhat", slow, superchains=8) < 1.04
    assert diagnostics.chain_statistic("rhat", remembered, superchains=8) > 1.2
    assert diagnostics.chain_statistic("rhat", short, superchains=8) < 1.01


@pytest.mark.parametrize(
    ("chains", "draws", "block", "superchains"),
    [(8, 57, 1, 0), (8, 57, 1, 4), (8, 60, 1, 4), (1, 90, 1, 0), (8, 61, 3, 0), (8, 61, 3, 4)],
)
def test_all_figures_at_once_are_those_one_by_one(
    chains: int, draws: int, block: int, superchains: int
) -> None:
    rng = np.random.default_rng(5)
    values = rng.normal(size=(chains, draws, 3, 2)).cumsum(axis=1) * 0.1 + rng.normal(size=(3, 2))
    values[..., 1, 0] = values[..., 1, 0].round()  # ties
    values[0, 3, 2, 1] = np.nan
    found = diagnostics.chain_figures(values, block, superchains)
    far = np.abs(values - np.median(values, axis=(0, 1)))
    for got, kind, of in (
        (found.ess, "ess", values),
        (found.tail_ess, "tail_ess", values),
        (found.rhat, "rhat", values),
        (found.spread_ess, "ess", far),
    ):
        wanted = diagnostics.chain_statistic(kind, of, block, superchains)
        odd = draws % 2 and of is far  # its median counts the draw between the halves
        np.testing.assert_allclose(got, wanted, rtol=0.05 if odd else 1e-12)


def test_normal_scores_are_those_of_average_ranks() -> None:
    rng = np.random.default_rng(2)
    values = np.stack([rng.normal(size=40), rng.integers(0, 6, size=40), np.ones(40)])
    for rows in (values, values[:1]):
        ranks = scipy.stats.rankdata(rows, axis=1)
        wanted = scipy.stats.norm.ppf((ranks - 0.375) / 40.25)
        np.testing.assert_allclose(diagnostics.normal_scores(rows), wanted, rtol=1e-13, atol=1e-13)
