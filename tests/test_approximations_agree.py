"""Engines that approximate, on random nets: how far off they may be, and that a check tells where they are.

The bias that an engine is allowed is stated below, of means in exact standard deviations and of the log
evidence, where its own check finds a small Pareto k, and where it finds one that is only just good enough.
Where it finds a larger one nothing is promised; where an approximation is exact (k minus infinity) all must
agree with the exact answer. Answers by draws may err by five standard errors besides.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.approximate.posterior import ApproximatePosterior
from bayesmc.errors import ConvergenceWarning, ReducibleWarning, UnsupportedError
from bayesmc.testing import session
from tests.matrix import KINDS, SHIFT, exact, problem, quiet_check

NETS = session.scaled(7, 15)


@dataclass(frozen=True)
class Allowed:
    """Bias that is allowed.

    Attributes
    ----------
    mean, log_evidence : float
        Where k is below a half.
    usable_mean, usable_log_evidence : float
        Where it is below the bound of the check.
    share : dict
        Kind of net -> least share of nets that are judged.
    exact : float
        Both where all weights of the check are equal.
    """

    mean: float
    log_evidence: float
    usable_mean: float
    usable_log_evidence: float
    share: dict[str, float]
    exact: float = 1e-6


#: engine, what it is allowed
APPROXIMATIONS: dict[str, tuple[Any, Allowed]] = {
    "LaplaceApproximation": (
        bmc.LaplaceApproximation(),
        Allowed(0.6, 0.3, 1.0, 0.5, {"hybrid": 0.2, "hybrid plates": 0.05, "gaussian": 0.4}),
    ),
    "MeanField": (
        bmc.MeanField(restarts=2),
        # of few states the largest weights are equal (k is minus infinity), and the others need not be
        Allowed(0.8, 0.8, 1.2, 1.5, dict.fromkeys(KINDS, 0.2), 0.8),
    ),
    "ExpectationPropagation": (
        bmc.ExpectationPropagation(),
        Allowed(0.2, 0.2, 0.4, 0.4, dict.fromkeys(KINDS, 0.6)),
    ),
}


def judged(engine: Any, allowed: Allowed, kind: str, seed: int) -> bool:
    """Whether there was something to judge; what is too far off raises."""
    net, evidence = problem(kind, seed)
    if engine.unsupported(net, evidence) is not None:
        return False
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        posterior = bmc.infer(net, evidence, engine=engine, rng=seed)
    assert all(issubclass(w.category, (ConvergenceWarning, ReducibleWarning)) for w in caught)
    check = quiet_check(posterior, 4000, seed)
    if caught or not check.ok:
        return False
    mean, log_evidence = allowed.usable_mean, allowed.usable_log_evidence
    if check.k < 0.5:
        mean, log_evidence = allowed.mean, allowed.log_evidence
    if check.k == -np.inf:
        mean, log_evidence = allowed.exact, allowed.exact
    right = exact(kind, seed)
    off = posterior.log_marginal_likelihood - right.log_marginal_likelihood
    assert abs(off) < log_evidence, (seed, off, check.k)
    for name in right.names:
        try:
            wanted, sd = right.mean(name), np.sqrt(np.maximum(right.var(name), 0.0))
            found, error = posterior.mean(name), posterior.mcse(name)
        except (UnsupportedError, ValueError):  # labels
            continue
        assert (abs(found - wanted) <= mean * sd + 5 * error + 1e-9).all(), (seed, name, check.k)
    return True


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("engine", APPROXIMATIONS)
def test_bias_is_what_is_allowed(engine: str, kind: str) -> None:
    asked, allowed = APPROXIMATIONS[engine]
    count = sum(judged(asked, allowed, kind, seed) for seed in range(SHIFT, SHIFT + NETS))
    assert count >= int(allowed.share.get(kind, 0.0) * NETS)


def test_a_bias_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three tenths of a standard deviation, where the answer ought to be exact."""
    engine, allowed = APPROXIMATIONS["LaplaceApproximation"]
    right = ApproximatePosterior.mean
    monkeypatch.setattr(
        ApproximatePosterior, "mean", lambda self, name: right(self, name) + 0.3 * self.std(name)
    )
    with pytest.raises(AssertionError):
        for seed in range(SHIFT, SHIFT + NETS):
            judged(engine, allowed, "gaussian", seed)
