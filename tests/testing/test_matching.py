"""The statistical match: its false-alarm rate, its power, and what it says."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.testing import assert_matches, compare, enumerate_posterior


def diagnosis() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"test": 3})
    net.add("ill", bmc.Categorical([0.7, 0.2, 0.1]), states=("no", "mild", "severe"))
    net.add("positive", lambda ill: bmc.Bernoulli(0.1 + 0.4 * ill), plates="test")
    net.add("fever", lambda ill: bmc.Normal(37.0 + ill, 0.7))
    return net


EVIDENCE = {"positive": np.ma.MaskedArray([1, 0, 1], mask=[False, True, False])}


class Shifted:
    """An answer with one figure moved."""

    def __init__(self, right, **moved) -> None:
        self._right, self._moved = right, moved

    def __getattr__(self, key):
        return self._moved.get(key, getattr(self._right, key))


def weighted(seed: int, draws: int = 4000, **options):
    engine = bmc.LikelihoodWeighting(draws)
    return bmc.infer(diagnosis(), EVIDENCE, engine=engine, rng=seed, **options)


def test_false_alarms_are_as_rare_as_stated() -> None:
    """At alpha = 0.05, at most 0.05 of right answers are rejected.

    400 answers: more than 34 rejections (true rate 0.05) have probability 1e-3; the figures depend on
    each other and Holm is conservative, so fewer are expected, but not none at alpha = 0.5.
    """
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    matches = [compare(weighted(seed), exact, alpha=0.05) for seed in range(400)]
    assert sum(bool(m.rejected) for m in matches) <= scipy.stats.binom.ppf(0.999, 400, 0.05)
    loose = [compare(weighted(seed), exact, alpha=0.5) for seed in range(60)]
    assert any(m.rejected for m in loose)


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_a_right_answer_passes_and_says_how_much_was_compared(keep: str) -> None:
    match = assert_matches(weighted(0, keep=keep), enumerate_posterior(diagnosis(), EVIDENCE))
    # evidence, 3 states of ill, 3 x 2 of positive, the mean of fever; none is too rare
    assert match.comparisons + match.skipped == 1 + 3 + 6 + 1
    assert match.skipped == 0
    assert match.worst is not None
    assert not match.rejected


def test_small_faults_are_caught() -> None:
    """Power: with 40,000 draws (ESS 9,000) a probability off by 0.05, a mean off by 0.1 and log
    evidence off by 0.2 are five standard errors away, or more."""
    right = weighted(0, draws=40_000)
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    wrong = right.probabilities("ill") + [0.05, -0.05, 0.0]
    faults = [
        {"probabilities": lambda n: wrong if n == "ill" else right.probabilities(n)},
        {"mean": lambda n: right.mean(n) + 0.1},
        {"log_marginal_likelihood": right.log_marginal_likelihood + 0.2},
    ]
    named = ["node 'ill', state", "mean of node 'fever'", "log evidence"]
    for fault, name in zip(faults, named, strict=True):
        with pytest.raises(AssertionError, match=name):
            assert_matches(Shifted(right, **fault), exact)


def test_the_message_says_what_differs_by_how_much() -> None:
    right = weighted(0)
    wrong = right.probabilities("positive")[:, ::-1]
    bad = Shifted(
        right, probabilities=lambda n: wrong if n == "positive" else right.probabilities(n)
    )
    with pytest.raises(AssertionError) as caught:
        assert_matches(bad, enumerate_posterior(diagnosis(), EVIDENCE), alpha=0.01)
    text = str(caught.value)
    for part in ("figures of", "false-alarm rate 0.01", "node 'positive'[0], state 0", "exact",
                 "standard errors", "p = "):  # fmt: skip
        assert part in text


def test_weight_on_impossible_states_is_caught() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.5, 0.5, 0.0]))
    right = bmc.infer(net, engine=bmc.LikelihoodWeighting(1000), rng=0)
    exact = enumerate_posterior(net)
    assert_matches(right, exact)
    leak = right.probabilities("a") + [-1e-4, 0, 1e-4]  # far below the Monte Carlo error
    with pytest.raises(AssertionError, match="state 2"):
        assert_matches(Shifted(right, probabilities=lambda n: leak), exact)


def test_rare_states_are_not_judged() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.9995, 0.0005]))
    right = bmc.infer(net, engine=bmc.LikelihoodWeighting(1000), rng=0)
    exact = enumerate_posterior(net)
    match = assert_matches(right, exact)
    assert (match.comparisons, match.skipped) == (1, 2)  # log evidence alone is compared
    assert assert_matches(right, exact, min_count=0.1).skipped == 0


def test_exact_answers_must_agree_to_the_tolerance() -> None:
    net = diagnosis()
    evidence = {"positive": [1, 0, 1], "fever": 38.0}
    exact = enumerate_posterior(net, evidence)
    right = bmc.infer(net, evidence, engine=bmc.Exact())
    assert assert_matches(right, exact).comparisons == 1 + 3 + 6 + 1
    off = right.probabilities("ill") + [1e-7, -1e-7, 0.0]
    bad = Shifted(right, probabilities=lambda n: off if n == "ill" else right.probabilities(n))
    with pytest.raises(AssertionError, match="node 'ill', state 'no'"):
        assert_matches(bad, exact)
    assert_matches(bad, exact, rtol=1e-6)
    bad = Shifted(right, log_marginal_likelihood=right.log_marginal_likelihood + 1e-6)
    with pytest.raises(AssertionError, match="log evidence"):
        assert_matches(bad, exact)


def test_nan_never_matches() -> None:
    right = weighted(0)
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    for fault in (
        {"mean": lambda n: right.mean(n) * np.nan},
        {"probabilities": lambda n: right.probabilities(n) * np.nan},
        {"log_marginal_likelihood": np.nan},
    ):
        with pytest.raises(AssertionError):
            assert_matches(Shifted(right, **fault), exact)


def test_shapes_must_agree() -> None:
    right = weighted(0)
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    bad = Shifted(right, probabilities=lambda n: right.probabilities(n)[..., :1])
    with pytest.raises(AssertionError, match="shape"):
        assert_matches(bad, exact)


def test_too_few_effective_draws_are_not_judged() -> None:
    exact = enumerate_posterior(diagnosis(), EVIDENCE)
    with pytest.warns(bmc.errors.LowEssWarning):
        few = weighted(0, draws=60)
    match = compare(few, exact)
    assert match.skipped >= 5
