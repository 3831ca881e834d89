"""Faults of switching Kalman filters and of expectation propagation, where they must be exact.

GPB2 is exact for two slices, IMM tells the moments of a slice without a row after one that has one, GPB1 its
means; where modes make no difference to numbers all of them are exact throughout.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from bayesmc.factors.expectation_propagation import Tilted, Visit, propagate
from bayesmc.factors.messages import ConditionalGaussian
from bayesmc.testing.oracles.answers import exact
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant
from tests.mutants.tests_of import Test


def switching(difference: float = 1.0) -> bmc.DynamicBayesNet:
    """A number whose drift and noise follow a mode, with readings of both."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.4, 0.6]], initial=[0.3, 0.7])
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(0.9 * x_prev + 2.0 * difference * z, 0.5 + difference * z),
        initial=lambda z: bmc.Normal(2.0 * difference * z, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.6))
    dbn.table("o", ["z"], [[0.7, 0.3], [0.2, 0.8]])
    return dbn


def figures(answer: Any) -> dict[str, np.ndarray]:
    return {"x": answer.mean("x"), "spread": answer.var("x"), "z": answer.probabilities("z")}


def last(rule: Any, rows: dict[str, Any], names: tuple[str, ...] = ("x", "spread", "z")) -> Test:
    """Some figures of the last slice, filtered."""

    def test(seed: int) -> Verdict:
        dbn = switching()

        def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
            found = bmc.filter(dbn, rows, engine=bmc.SwitchingKalmanFilter(rule))
            return {name: figures(found)[name][-1] for name in names}

        answer = figures(exact(switching(), rows))
        right = {name: answer[name][-1] for name in names}
        return repeated_test(estimate, right, replications=2, alpha=ALPHA, rng=seed)

    return test


def smoothed(seed: int) -> Verdict:
    """All slices, of modes that make no difference to numbers."""
    dbn = switching(0.0)

    def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
        return figures(bmc.smooth(dbn, LONG, engine=bmc.SwitchingKalmanFilter()))

    right = figures(exact(switching(0.0), LONG))
    return repeated_test(estimate, right, replications=2, alpha=ALPHA, rng=seed)


def propagated(seed: int) -> Verdict:
    """The same by messages, and the evidence."""
    dbn = switching(0.0)

    def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # figures are what is judged
            found = bmc.smooth(dbn, LONG, engine=bmc.ExpectationPropagation(damping=0.0))
        return figures(found) | {"log": np.nan_to_num(found.log_marginal_likelihood)}

    answer = exact(switching(0.0), LONG)
    right = figures(answer) | {"log": np.array(answer.log_marginal_likelihood)}
    return repeated_test(estimate, right, replications=2, alpha=ALPHA, rng=seed)


class _Slim:
    """A Gaussian factor of one number, of precision 4 at 1."""

    scope = (0,)

    def tilted(self, cavities: Sequence[Any], ends: Sequence[int]) -> Tilted:
        found = cavities[0].times(
            ConditionalGaussian.of(np.zeros(1), np.ones((1, 1)), np.full((1, 1, 1), 0.5))
        )
        return Tilted(found.log_total, [found])


def damped(seed: int) -> Verdict:
    """One sweep from a flat message: a share of 1 - damping of the factor's own."""
    prior = ConditionalGaussian.of(np.zeros(1), np.zeros((1, 1)), np.ones((1, 1, 1)))
    one = ConditionalGaussian.ones(1, (), 1)

    def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
        found = propagate([prior], [_Slim()], [[one]], [Visit(0, (0,))], sweeps=1, damping=0.25)
        return {"precision": found.beliefs[0].precision, "linear": found.beliefs[0].linear}

    right = {"precision": np.full((1, 1, 1), 1.0 + 0.75 * 4.0), "linear": np.full((1, 1), 3.0)}
    return repeated_test(estimate, right, replications=2, alpha=ALPHA, rng=seed)


LONG = {"y": np.array([0.5, 1.2, np.nan, 2.5]), "o": np.array([0.0, 1.0, 1.0, 0.0])}
TWO = {"y": np.array([0.5, 1.9]), "o": np.array([0.0, 1.0])}
AHEAD = {"y": np.array([1.5, np.nan]), "o": np.array([0.0, np.nan])}
FILTER, SMOOTH = "repeated_test of filter (no draws)", "repeated_test of smooth (no draws)"
AT = "bayesmc.engines.switching."
LOOP = "bayesmc.factors.expectation_propagation"

MUTANTS = [
    Mutant(
        "Gaussians are merged without the spread of their means",
        (Edit(f"{AT}merging:merged", "(root * (mean - centre", "(0.0 * root * (mean - centre"),),
        last("gpb2", TWO),
        FILTER,
    ),
    Mutant(
        "the mode is advanced by the wrong slice",
        (Edit(f"{AT}passes:_ahead", "start.log.take(pairs.src, ", "start.log.take(pairs.dst, "),),
        last("gpb2", TWO),
        FILTER,
    ),
    Mutant(
        "the mixing weights of IMM are transposed",
        (Edit(f"{AT}passes:_ahead", "return merged(groups.logs(log), start.mean[at]",
              "return merged(groups.logs(log).swapaxes(0, 1), start.mean[at]"),),
        last("imm", AHEAD),
        FILTER,
    ),
    Mutant(
        "GPB1 merges modes as if all were alike",
        (Edit(f"{AT}passes:_ahead", "merged(start.log[None]", "merged(0.0 * start.log[None]"),),
        last("gpb1", AHEAD, ("x", "z")),
        FILTER,
    ),
    Mutant(
        "Kim's smoother forgets how modes follow each other",
        (Edit(f"{AT}passes:turned_back", "before.log[pairs.src] + stretch.log_of(place.at)",
              "before.log[pairs.src]"),),
        smoothed,
        SMOOTH,
    ),
    Mutant(
        "Kim's smoother takes the next slice's numbers for known",
        (Edit(f"{AT}passes:smoothed", "root = left @ later.spread", "root = 0.0 * left @ later.spread"),),
        smoothed,
        SMOOTH,
    ),
    Mutant(
        "what came from outside is not divided out of a message",
        (Edit(f"{LOOP}:_State.visited", "belief.over(cavities[end], own[end])", "belief"),),
        propagated,
        SMOOTH,
    ),
    Mutant(
        "damping is applied twice",
        (Edit(f"{LOOP}:_State.visited", "self.share)", "self.share**2)"),),
        damped,
        "repeated_test of one sweep (no draws)",
    ),
    Mutant(
        "messages meet the modes of a slice transposed",
        (Edit(f"{AT}slice_factors:SliceFactor._noise", "(self.pairs.src, self.pairs.dst)",
              "(self.pairs.dst, self.pairs.src)"),),
        propagated,
        SMOOTH,
    ),
]  # fmt: skip
