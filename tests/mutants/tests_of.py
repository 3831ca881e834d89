"""Tests as the catalogues use them: everything made anew at each call, as compiled models are kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.testing.oracles.answers import exact
from bayesmc.testing.posteriors.evidence import unbiased_evidence_test
from bayesmc.testing.posteriors.matching import compare
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.mutant import ALPHA
from tests.stated import stated_errors_test

Make = Callable[[], Any]
Test = Callable[[int], Verdict]


def matched(net: Make, evidence: Any, engine: Any, draws: int = 0) -> Test:
    """An engine's answer against the exact one; with ``draws``, so many draws of it."""

    def test(seed: int) -> Verdict:
        asked = net()
        rng = np.random.default_rng(seed)
        found = bmc.infer(asked, evidence, engine=engine, rng=rng)
        if draws:
            found = found.resample(draws, rng=rng)
        return compare(found, exact(_net(asked, evidence), _evidence(asked, evidence)), ALPHA)

    return test


def evidence_of(net: Make, evidence: Any, engine: Any, replications: int = 300) -> Test:
    """The mean of an engine's estimates of the evidence."""
    return lambda seed: unbiased_evidence_test(
        engine, net(), evidence, replications=replications, alpha=ALPHA, rng=seed
    )


def slices(
    ask: Callable[..., Any], dbn: Make, observations: Any, engine: Any, runs: int, **options: Any
) -> Test:
    """Means and probabilities of all slices, by ``filter`` or ``smooth``, in several runs.

    The exact ones are had slice by slice, of a filter from the rows so far.
    """

    def test(seed: int) -> Verdict:
        template = dbn()

        def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
            return _figures(ask(template, observations, engine=engine, rng=rng, **options))

        return repeated_test(
            estimate, _exact_slices(ask, dbn(), observations),
            replications=runs, alpha=ALPHA, rng=seed,
        )  # fmt: skip

    return test


def stated(dbn: Make, observations: Any, engine: Any, runs: int) -> Test:
    """Stated errors of the evidence and of the means of the last slice."""

    def test(seed: int) -> Verdict:
        template = dbn()
        right = bmc.filter(dbn(), observations)
        figures = {n: right.mean(n)[-1] for n in right.names if n not in observations}
        return stated_errors_test(
            lambda rng: bmc.filter(template, observations, engine=engine, rng=rng),
            right.log_marginal_likelihood, figures,
            lambda found: {n: (found.mean(n)[-1], found.mcse(n)[-1]) for n in figures},
            runs=runs, alpha=ALPHA, rng=seed,
        )  # fmt: skip

    return test


def estimated(estimate: Callable[[np.random.Generator], Any], right: Any, runs: int) -> Test:
    """Any estimate, in several runs."""
    return lambda seed: repeated_test(estimate, right, replications=runs, alpha=ALPHA, rng=seed)


# ---- private ------------------------------------------------------------------------------------


def _net(asked: Any, evidence: Any) -> Any:
    if not isinstance(asked, bmc.DynamicBayesNet):
        return asked
    return asked.unroll(len(next(iter(evidence.values()))))


def _evidence(asked: Any, evidence: Any) -> Any:
    return asked.unrolled_evidence(evidence) if isinstance(asked, bmc.DynamicBayesNet) else evidence


def _figures(posterior: Any) -> dict[str, np.ndarray]:
    """Means of x, probabilities of z, over time."""
    found = {}
    for name in ("x", "z"):
        if name not in posterior.model.nodes:
            continue
        is_finite = posterior.model[name].domain is not None
        found[name] = posterior.probabilities(name) if is_finite else posterior.mean(name)
    return found


def _exact_slices(ask: Callable[..., Any], template: Any, observations: Any) -> dict[str, Any]:
    steps = len(next(iter(observations.values())))
    if ask is bmc.smooth:
        return _figures_of(exact(template, observations))
    rows = [
        _figures_of(exact(template, {n: v[: k + 1] for n, v in observations.items()}))
        for k in range(steps)
    ]
    return {name: np.stack([row[name][k] for k, row in enumerate(rows)]) for name in rows[0]}


def _figures_of(answer: Any) -> dict[str, Any]:
    found = {}
    for name in ("x", "z"):
        if f"{name}[0]" not in answer.names:
            continue
        is_finite = answer.model[f"{name}[0]"].domain is not None
        found[name] = answer.probabilities(name) if is_finite else answer.mean(name)
    return found
