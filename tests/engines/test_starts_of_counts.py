"""Chains start where counts are far from what their prior draws: a finite density somewhere is enough.

Errors of means are estimates; a right answer fails one of them once in a million runs (5 of them).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.errors import ZeroProbabilityError

#: runs are short
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")


def mean_of_trials(k: int, rate: float, p: float) -> float:
    """Of N ~ Poisson(rate) given k of Binomial(N, p): what was missed is Poisson(rate * (1 - p))."""
    n = np.arange(k, k + 200)
    log = n * np.log(rate) - special.gammaln(n + 1) + special.gammaln(n + 1)
    log = log - special.gammaln(n - k + 1) + (n - k) * np.log1p(-p)
    weight = np.exp(log - log.max())
    return float(n @ weight / weight.sum())


def close(found: bmc.Posterior, name: str, truth: np.ndarray, times: float = 5.0) -> bool:
    return bool((np.abs(found.mean(name) - truth) < times * found.mcse(name) + 1e-9).all())


@pytest.mark.parametrize("k", [30, 300])
def test_more_successes_than_trials_that_the_prior_draws(k: int) -> None:
    net = bmc.BayesNet()
    net.add("N", bmc.Poisson(5.0))
    net.add("k", lambda N: bmc.Binomial(N, 0.5))
    found = bmc.infer(net, {"k": k}, engine=bmc.Gibbs(800, chains=2, warmup=200), rng=0)
    truth = mean_of_trials(k, 5.0, 0.5)
    assert close(found, "N", np.asarray(truth))
    assert not close(found, "N", np.asarray(truth + 1.0)), "the control"


def test_counts_of_a_plate() -> None:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("N", bmc.Poisson(5.0), plates="i")
    net.add("k", lambda N: bmc.Binomial(N, 0.5), plates="i")
    k = np.arange(6) * 8
    found = bmc.infer(net, {"k": k}, engine=bmc.Gibbs(800, chains=2, warmup=200), rng=0)
    assert close(found, "N", np.array([mean_of_trials(int(n), 5.0, 0.5) for n in k]))


def test_counts_beside_numbers() -> None:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("N", bmc.Geometric(0.1))
    net.add("k", lambda N: bmc.DiscreteUniform(1, N + 1), plates="i")
    found = bmc.infer(
        net, {"k": [19, 40, 242, 60]}, engine=bmc.Gibbs(800, chains=2, warmup=200), rng=0
    )
    n = np.arange(241, 2000)
    weight = np.exp((n - 241) * np.log(0.9) - 4 * np.log((n + 1) / 242))
    assert close(found, "N", np.asarray(n @ weight / weight.sum()))


def test_what_no_count_makes_possible_is_refused() -> None:
    net = bmc.BayesNet()
    net.add("N", bmc.DiscreteUniform(0, 10))
    net.add("p", bmc.Beta(1, 1))
    net.add("k", lambda N, p: bmc.Binomial(N, p))
    with pytest.raises(ZeroProbabilityError, match="'k'"):
        bmc.infer(net, {"k": 12}, engine=bmc.Gibbs(10), rng=0)
