"""Templates whose counts are out of as many as an input, or the time, says: no slice sets the bound for all.

Particle answers are held to 5 of their stated errors: one false alarm in a million.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import EvidenceError


def template(density: Any) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.input("n")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", density)
    return dbn


def by_hand(y: list[int], n: list[int]) -> float:
    """The log evidence of binomial counts, by sums over points."""
    x = np.linspace(-14.0, 14.0, 1401)
    step = x[1] - x[0]
    move = stats.norm.pdf(x[:, None] - x[None, :]) * step
    belief, total = stats.norm.pdf(x) * step, 0.0
    for k, (seen, out_of) in enumerate(zip(y, n, strict=True)):
        belief = (move @ belief if k else belief) * stats.binom.pmf(
            seen, out_of, 1 / (1 + np.exp(-x))
        )
        total += np.log(belief.sum())
        belief = belief / belief.sum()
    return float(total)


@pytest.mark.parametrize(("y", "n"), [([1, 9, 0, 3], [3, 10, 2, 7]), ([9, 1, 0], [10, 3, 2])])
def test_counts_out_of_an_input(y: list[int], n: list[int]) -> None:
    dbn = template(lambda x, n: bmc.Binomial(n, logits=x))
    truth = by_hand(y, n)
    found = bmc.filter(dbn, {"y": y}, inputs={"n": n})
    assert found.log_marginal_likelihood == pytest.approx(truth, abs=1e-6)
    found = bmc.filter(dbn, {"y": y}, inputs={"n": n}, engine=bmc.ParticleFilter(4000), rng=0)
    error = found.log_marginal_likelihood_mcse
    assert abs(found.log_marginal_likelihood - truth) < 5 * error
    assert abs(by_hand(y, [*n[:-1], n[-1] + 5]) - truth) > 10 * error, "the control"


def test_counts_out_of_the_time() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, t: bmc.Binomial(t + 2, logits=x))
    found = bmc.filter(dbn, {"y": [1, 3, 0, 5]})
    truth = by_hand([1, 3, 0, 5], [2, 3, 4, 5])
    assert found.log_marginal_likelihood == pytest.approx(truth, abs=1e-6)


def test_uniform_counts_out_of_an_input() -> None:
    dbn = template(lambda x, n: bmc.DiscreteUniform(0, n))
    n = np.array([3, 10, 2, 7])
    found = bmc.filter(dbn, {"y": [1, 9, 0, 3]}, inputs={"n": n}, engine=bmc.ParticleFilter(50))
    assert found.log_marginal_likelihood == pytest.approx(-np.log(n + 1.0).sum())


def test_values_that_are_the_same_in_all_slices_stay_finite() -> None:
    """The control: states, and tables that are looked up by the time, beyond which they end."""
    levels = np.array([[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]])
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "s", lambda s_prev, t: bmc.Categorical(levels[int(t)]), initial=bmc.Categorical(levels[0])
    )
    dbn.add("y", lambda s: bmc.Normal(1.0 * s, 1.0))
    found = bmc.filter(dbn, {"y": [0.0, 1.0, 0.5]}, engine=bmc.DiscreteFilter())
    assert found.probabilities("s").shape == (3, 2)
    dbn = template(lambda x, n: bmc.Bernoulli(1 / (1 + np.exp(n * x))))
    with pytest.raises(EvidenceError, match="2 is not among the values 0, 1"):
        bmc.filter(dbn, {"y": [0, 2]}, inputs={"n": [1, 2]})
