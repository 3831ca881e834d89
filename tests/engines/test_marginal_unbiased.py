"""``ParticleFilter(marginalize=)``: the evidence has no bias, and faults that give it one are seen.

On random switching templates that can be enumerated the mean of exp(log Z_hat - log Z) is 1 within four
standard errors, a false alarm in some 16,000 templates; 2,000 runs of each in a thorough session.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.engines.particles.smc import quiet
from bayesmc.errors import BudgetError, UnsupportedError
from bayesmc.testing import exact, session
from bayesmc.testing.makers.switching_dbns import random_switching_dbn
from tests.mutants.faults import Edit, planted

STEP = "bayesmc.engines.marginal.step:MarginalStep."
#: fault -> what is changed, under which proposals it is met
FAULTS = {
    "a start is sampled, and kept in the covariance as well": (
        Edit(
            STEP + "_taken",
            "made.chosen(None)",
            "(lambda g: g._replace(mean=g.drawn(rng)) if row.t == 0 else g)(made.chosen(None))",
        ),
        None,
    ),
    "finite nodes drawn given the row are not weighed by p/q": (
        Edit(
            STEP + "_taken",
            "log + own, after._replace(",
            "log + each.log.mean(axis=1), after._replace(",
        ),
        "optimal",
    ),
    "the regime of the wrong slice": (
        Edit(
            STEP + "_values",
            "for name, value in {**taken, **values}.items():",
            "late = {n: taken.get(n + '_prev', v) for n, v in values.items()}\n"
            "    for name, value in {**taken, **late}.items():",
        ),
        None,
    ),
}
PROPOSALS = (None, "optimal")


@cache
def templates(count: int) -> list[tuple[int, Any, float]]:
    """The first so many random templates whose evidence is known, with it."""
    found: list[tuple[int, Any, float]] = []
    for seed in range(104, 104 + 4 * count):
        case = random_switching_dbn(seed)
        try:
            right = exact(case.dbn, case.observations, case.inputs or None)
        except (UnsupportedError, BudgetError):
            continue
        log = float(np.sum(right.log_marginal_likelihood) - right.log_static)
        found.append((seed, case, log))
        if len(found) == count:
            break
    return found


def ratios(case: Any, log: float, proposal: str | None, runs: int) -> np.ndarray:
    """Estimated over exact evidence, run by run: of the filter's steps alone, which cost less."""
    engine = bmc.ParticleFilter(30, marginalize="auto", proposal=proposal)
    problem = pose_series(case.dbn, case.observations, case.inputs or None)
    step = engine.step_of(problem.slices, problem.known_static, seen=problem.seen)
    rng, found = np.random.default_rng([session.seed(), len(PROPOSALS)]), np.empty(runs)
    with quiet():
        for run in range(runs):
            now, total = None, -log
            for k in range(problem.steps):
                now = step(now, problem.series.row(k), rng)
                total += float(np.sum(now.increment))
            found[run] = np.exp(total)
    return found


def errors_off(found: np.ndarray) -> float:
    """By how many standard errors the mean is off 1."""
    error = found.std(ddof=1) / np.sqrt(len(found))
    return float(abs(found.mean() - 1.0) / (error + 1e-9))


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_the_evidence_has_no_bias(proposal: str | None) -> None:
    runs = session.scaled(40, 50)
    for seed, case, log in templates(session.scaled(1, 6)):
        found = ratios(case, log, proposal, runs)
        told = seed, found.mean(), found.std(ddof=1) / np.sqrt(runs)
        print(f"template {seed}, {proposal}: {told[1]:.5f} +- {told[2]:.5f}")
        assert errors_off(found) < 4, told


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_gives_it_one(fault: str) -> None:
    edit, proposal = FAULTS[fault]
    with planted(edit):
        assert any(
            errors_off(ratios(case, log, proposal, session.scaled(50, 40))) > 4
            for _, case, log in templates(session.scaled(2, 3))
        )
