"""Chains on random nets with vague priors: they start, reject what is out of range, answer as a grid does."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from bayesmc.testing import session
from tests.matrix_vague import KINDS, Vague, random_vague

#: 5 cases of 2 means in an ordinary run: false alarm 10 * 6e-7 = 6e-6
MOST = 5.0
ENGINES = {"Gibbs": bmc.Gibbs(300, 300), "Metropolis": bmc.MetropolisHastings(500, 500)}


def deviations(made: Vague, engine: Any, seed: int) -> list[float]:
    """How many Monte Carlo errors each mean is off."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        posterior = bmc.infer(made.net, made.evidence, engine=engine, rng=seed)
    assert max(float(np.max(posterior.rhat(n))) for n in made.mean) < 1.1
    return [abs(posterior.mean(n) - m) / posterior.mcse(n) for n, m in made.mean.items()]


#: what ordinary runs take; thorough ones take all
USUAL = {
    ("lifetimes", "Gibbs"),
    ("negative scales", "Gibbs"),
    ("cutpoints out of order", "Gibbs"),
    ("lifetimes", "Metropolis"),
    ("linear probabilities", "Metropolis"),
}
CASES = [
    pytest.param(k, e, marks=[] if (k, e) in USUAL else [pytest.mark.thorough])
    for k in KINDS
    for e in ENGINES
]


@pytest.mark.parametrize(("kind", "engine"), CASES)
def test_chains_answer_as_the_grid_does(kind: str, engine: str) -> None:
    for seed in range(session.seed(), session.seed() + session.scaled(1, 5)):
        made = random_vague(kind, np.random.default_rng(seed))
        assert max(deviations(made, ENGINES[engine], seed)) < MOST


def test_a_wrong_grid_is_seen() -> None:
    """Three quarters of a standard deviation off is 12 errors at 250 effective draws."""
    made = random_vague("negative scales", np.random.default_rng(session.seed()))
    off = {
        "m": made.mean["m"] + 0.25,
        "s": made.mean["s"],
    }  # the standard deviation is 1.5 / sqrt(20)
    wrong = Vague(made.net, made.evidence, off)
    assert max(deviations(wrong, ENGINES["Gibbs"], session.seed())) > MOST
