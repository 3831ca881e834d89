"""Mean field on the random nets of the matrix of engines, with the bias that it is allowed.

Variances are too small and means may be off: what is held is that the bound is no more than the exact log
evidence (within four errors of its integrals), that it never falls, that the corrected answers of ``check``
are right where k is small (at the matrix's false-alarm rate, at fixed seeds), and that means of
linear-Gaussian nets are exact where every factor has a closed form. Where zero probabilities tie nodes it
must say so.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, LowEssWarning, ReducibleWarning, UnsupportedError
from bayesmc.network import pose
from bayesmc.testing import compare, session
from bayesmc.testing.verdict import NothingToCompare
from tests.matrix import ALPHA, SHIFT, exact, problem

NETS = range(SHIFT, SHIFT + session.scaled(12, 10))
#: least share of the nets of each kind that it must answer, settled
LEAST = {"discrete": 0.6, "plates": 0.6, "hybrid": 0.6, "hybrid plates": 0.6, "gaussian": 0.6}


def answered(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
    """The posterior; None where it refuses, has not settled, or says that states are left out."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            posterior = bmc.infer(net, evidence, engine=bmc.MeanField(restarts=4), rng=seed)
        except UnsupportedError:
            return None
    kinds = [w.category for w in caught]
    assert all(issubclass(k, (ConvergenceWarning, ReducibleWarning)) for k in kinds)
    assert posterior.converged == (ConvergenceWarning not in kinds)
    return None if caught else posterior


def wrong(kind: str, seed: int) -> str | None:
    """What does not hold; "" where all does, None for no answer."""
    net, evidence = problem(kind, seed)
    posterior, right = answered(net, evidence, seed), exact(kind, seed)
    if posterior is None:
        return None
    above = posterior.elbo - right.log_marginal_likelihood
    if above > 4 * posterior.elbo_mcse + 1e-7 * (1 + abs(posterior.elbo)):
        return f"{kind} {seed}: the bound is above the log evidence by {above:.3g}"
    if (np.diff(posterior.elbos) < -1e-9).any():
        return f"{kind} {seed}: the bound fell"
    closed = all("closed" in w for w in posterior.engine._plan(posterior.problem).why.values())
    if kind == "gaussian" and closed and is_linear(net, evidence):
        for name in posterior.approximation.names:
            off = np.abs(posterior.mean(name) - right.mean(name)) / posterior.std(name).max()
            if off.max() > 1e-4:
                return f"{kind} {seed}: the mean of {name} is off by {off.max():.2g} sd"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        check = posterior.check(4000, rng=seed)
    if not check.k < 0.5:  # further out errors are right only on the whole
        return ""
    try:
        match = compare(check.posterior, right, ALPHA)
    except NothingToCompare:
        return ""
    return "\n".join([f"{kind} {seed}:", *map(str, match.rejected)]) if match.rejected else ""


def is_linear(net: bmc.BayesNet, evidence: dict[str, Any]) -> bool:
    """Whether nothing finite is hidden."""
    posed = pose(net, evidence)
    known = {name for name, seen in posed.observed.items() if seen.mask is None}
    return not any(n.is_discrete and name not in known for name, n in posed.model.nodes.items())


@pytest.mark.parametrize("kind", LEAST)
def test_bound_and_corrected_answers(kind: str) -> None:
    found = [wrong(kind, seed) for seed in NETS]
    faults = [f for f in found if f]
    if SHIFT == 1 or session.seed() == 0:
        assert not faults, "\n".join(faults)
    else:  # at fresh seeds one chance rejection of comparisons is no fault
        assert len(faults) <= 1, "\n".join(faults)
    assert sum(f is not None for f in found) >= LEAST[kind] * len(found)
