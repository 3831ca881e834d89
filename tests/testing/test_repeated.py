"""The mean of a random answer: alarms as often as stated, wrong answers found, wrong input named."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import binom

from bayesmc.errors import ShapeError
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import uncounted


@pytest.mark.parametrize("runs", [5, 20])
def test_alarms_come_as_often_as_stated(runs: int) -> None:
    rng = np.random.default_rng(1)
    with uncounted():
        alarms = sum(
            not repeated_test(lambda g: g.normal(size=2), [0.0, 0.0], replications=runs, alpha=0.01, rng=rng)
            for _ in range(300)
        )  # fmt: skip
    assert alarms <= binom.ppf(0.999, 300, 0.01)


def test_alarms_of_skewed_figures() -> None:
    rng = np.random.default_rng(2)
    with uncounted():
        alarms = sum(
            not repeated_test(lambda g: g.exponential(), 1.0, replications=60, alpha=0.01, rng=rng)
            for _ in range(300)
        )
    assert alarms <= binom.ppf(0.999, 300, 0.01)


def test_a_wrong_mean_is_named() -> None:
    found = repeated_test(
        lambda rng: {"x": rng.normal([0.0, 1.0]), "p": 0.25}, {"x": [0.0, 0.0], "p": 0.25}, rng=0
    )
    assert [c.what for c in found.rejected] == ["mean of 'x'[1]"]


def test_figures_without_chance_must_agree() -> None:
    assert repeated_test(lambda rng: 0.3, 0.3 + 1e-12, replications=2)
    assert not repeated_test(lambda rng: 0.3, 0.3001, replications=2)
    assert repeated_test(lambda rng: 0.3, 0.3001, replications=2, accuracy=1e-3)
    assert not repeated_test(lambda rng: np.nan, 0.3, replications=2)


def test_figures_of_any_exact_type() -> None:
    assert repeated_test(lambda rng: Fraction(1, 3), Fraction(1, 3), replications=5, rng=0)
    assert repeated_test(lambda rng: [2**70, 1.0], [2**70, 1.0], replications=5, rng=0)


def test_allowed_error() -> None:
    def biased(rng: np.random.Generator) -> float:
        return rng.normal(0.05, 0.1)

    assert not repeated_test(biased, 0.0, replications=200, rng=0)
    assert repeated_test(biased, 0.0, replications=200, accuracy=0.05, rng=0)


@pytest.mark.parametrize(
    ("estimate", "exact", "options", "error", "words"),
    [
        (
            lambda rng: {"a": 1.0},
            {"b": 1.0},
            {},
            ShapeError,
            r"returned \['a'\], exact holds \['b'\]",
        ),
        (lambda rng: [1.0, 2.0], 1.0, {}, ShapeError, r"shape \(2,\), exact has \(\)"),
        (lambda rng: 1.0, np.nan, {}, ValueError, "no number"),
        (lambda rng: {}, {}, {}, ValueError, "exact={} holds no figure"),
        (lambda rng: [], [], {}, ValueError, "holds no figure"),
        (lambda rng: None, 0.0, {}, TypeError, r"estimate\(rng\) is None; give real numbers"),
        (lambda rng: 1j, 0.0, {}, TypeError, "is 1j; give real numbers"),
        (lambda rng: 1.0, "a", {}, TypeError, "exact is 'a'; give real numbers"),
        (0.0, lambda rng: 1.0, {}, TypeError, "estimate=0.0; give a function"),
        (lambda rng: 1.0, 1.0, {"accuracy": -1.0}, ValueError, "0 or more"),
        (lambda rng: 1.0, 1.0, {"replications": 1}, ValueError, "at least 2"),
        (lambda rng: 1.0, 1.0, {"alpha": 2.0}, ValueError, "strictly between 0 and 1"),
    ],
)
def test_wrong_input(estimate, exact, options, error, words) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(error, match=words):
        repeated_test(estimate, exact, **options)
