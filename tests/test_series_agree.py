"""Every engine over time on random templates, under every test that applies.

The part of the matrix that `test_engines_agree` leaves out: answers against exact ones, estimates that have
no bias however few the particles, calibration. A comparison that chance has a part in has a false-alarm rate
of 1e-4 (Holm over its figures); an ordinary run has some 40 of them, at fixed seeds, a thorough one some
1,000.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import (
    ConvergenceWarning,
    EngineWarning,
    QueryError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.testing import (
    compare,
    repeated_test,
    session,
    simulation_based_calibration,
    unbiased_evidence_test,
    uncounted,
)
from tests.matrix_time import (
    CHAINS,
    COMPUTING,
    EVEN,
    FEW,
    MANY,
    MARGINAL,
    PARTICLES,
    RUNS,
    SHIFT,
    TRIED,
    answered,
    bent,
    cases,
    hidden,
    late,
    stated,
    tabled,
    unbiased,
)
from tests.stated import stated_errors_test

ALPHA = 1e-4
VARIANTS = PARTICLES | MARGINAL
ONE = bmc.SwitchingKalmanFilter()


@pytest.mark.parametrize("engine", COMPUTING)
def test_filters_and_smoothers_match_exact_answers(engine: str) -> None:
    """Every slice given all rows, and the last one filtered; there is no chance in it."""
    engine_used, rtol, kinds = COMPUTING[engine]
    for kind in kinds:
        for _, case in cases(kind, MANY):
            given: dict[str, Any] = {"inputs": case.inputs, "engine": engine_used}
            smoothed = bmc.smooth(case.dbn, case.observations, **given)
            found = compare(smoothed, case.exact, ALPHA, rtol=rtol)
            assert found, (case.dbn, found)
            filtered = bmc.filter(case.dbn, case.observations, **given)
            found = compare(filtered, case.exact, ALPHA, rtol=rtol)
            assert found, (case.dbn, found)


@pytest.mark.parametrize("engine", COMPUTING)
def test_late_answers_match_exact_ones(engine: str) -> None:
    """Every slice given the rows up to one after it (``lag=1``); there is no chance in it."""
    engine_used, rtol, kinds = COMPUTING[engine]
    asked = 0
    for kind in kinds:
        for _, case in cases(kind, session.scaled(1, 20)):
            given: dict[str, Any] = {"inputs": case.inputs, "engine": engine_used, "lag": 1}
            try:
                found = bmc.smooth(case.dbn, case.observations, **given)
            except UnsupportedError:
                continue
            for answer, right in late(case, found, 1).values():
                scale = max(float(np.abs(right).max()), 1.0)
                np.testing.assert_allclose(answer, right, rtol=rtol, atol=rtol * scale)
                asked += 1
    assert asked or engine == "ExpectationPropagation"  # which says that it has no lags


@pytest.mark.parametrize("engine", COMPUTING)
def test_functions_of_nodes_match_exact_answers(engine: str) -> None:
    """Second moments and shares of the nodes of every slice, as queries; there is no chance in it."""
    engine_used, rtol, kinds = COMPUTING[engine]
    asked = 0
    for kind in kinds:
        for _, case in cases(kind, 1 if kind == "switching" and not session.is_thorough() else 2):
            given: dict[str, Any] = {"inputs": case.inputs, "engine": engine_used}
            plain = bmc.smooth(case.dbn, case.observations, **given)
            for name in plain.names:
                if not hidden(case, name):
                    continue
                function, right = function_of(case.exact, plain.model[name])
                queries = {name: function}
                try:
                    found = bmc.smooth(case.dbn, case.observations, queries=queries, **given)
                except (UnsupportedError, QueryError, EngineWarning):
                    continue  # a node that nothing reads has no table of its own, and this is said
                answer = found.queries[name]
                scale = np.abs(right).max()
                np.testing.assert_allclose(answer, right, rtol=10 * rtol, atol=10 * rtol * scale)
                asked += 1
    assert asked


def function_of(exact: Any, node: Any) -> tuple[Any, np.ndarray]:
    """A function of a node, and its mean in every slice: whether it is in its last state, or its square."""
    name, domain = node.name, node.domain
    if domain is None:
        return eval(f"lambda {name}: {name} ** 2"), exact.mean(name) ** 2 + exact.var(name)
    last = (domain.numbers if domain.labels is None else domain.labels)[-1]
    return eval(f"lambda {name}: {name} == last", {"last": last}), exact.probabilities(name)[
        ..., -1
    ]


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ProposalWarning")
@pytest.mark.parametrize(("variant", "kind"), TRIED)
def test_particle_filters_have_no_bias(variant: str, kind: str) -> None:
    """Evidence, filtered and smoothed figures, of fifty particles."""
    engine = bmc.ParticleFilter(50, **VARIANTS[variant])
    tried = 0
    chosen = list(cases(kind, 3 * FEW))
    turn, enough = list(VARIANTS).index(variant), 0
    if (
        not session.is_thorough()
    ):  # variants take turns at templates, and at others where these are uneven
        own = chosen[turn :: len(VARIANTS)]
        chosen = own + [other for other in chosen if other not in own]
        enough = len(own)
    for k, (seed, case) in enumerate(chosen):
        if enough and k >= enough and tried:
            break
        options: dict[str, Any] = {"alpha": ALPHA, "rng": np.random.SeedSequence([seed, 5])}
        evidence = unbiased_evidence_test(
            engine, case.dbn, case.observations, inputs=case.inputs, replications=100, **options
        )
        assert not evidence.rejected, evidence
        with np.errstate(divide="ignore", invalid="ignore"):  # estimates of zero
            spread = np.log(evidence.ratios).std()
        if not spread <= EVEN:
            continue  # the mean over a few runs would have no error to judge by
        estimate, right = unbiased(case, engine)
        if not sum(np.size(value) for value in right.values()):
            continue  # all of it was observed
        found = repeated_test(estimate, right, replications=RUNS, **options)
        assert found, (case.dbn, found)
        tried += 1
    assert tried


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
@pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")
def test_linearised_nodes_are_exact_where_tangents_are() -> None:
    """Filtered, and one row late by ``lag=`` and ``delay=``, as where means are known to be affine, at equal
    seeds: there is no chance in it."""
    found = (bent(seed) for seed in range(SHIFT, SHIFT + 100))
    for case, dbn, names in itertools.islice((f for f in found if f is not None), 2 * FEW):
        engine = bmc.ParticleFilter(40, marginalize=names)
        given: dict[str, Any] = {"inputs": case.inputs, "rng": 3}
        told = bmc.explain(dbn, case.observations, inputs=case.inputs, engine=engine).nodes
        assert any("linearised" in text for text in told.values())
        for ask, other, more in (
            (bmc.filter, engine, {}),
            (bmc.filter, replace(engine, delay=1), {}),
            (bmc.smooth, engine, {"lag": 1}),
        ):
            plain, own = (
                ask(d, case.observations, engine=other, **given, **more) for d in (case.dbn, dbn)
            )
            for name in names:
                np.testing.assert_allclose(own.mean(name), plain.mean(name), rtol=1e-7, atol=1e-9)
                np.testing.assert_allclose(own.var(name), plain.var(name), rtol=1e-7, atol=1e-9)
            np.testing.assert_allclose(
                own.log_marginal_likelihood, plain.log_marginal_likelihood, rtol=1e-9
            )


def test_particle_filters_with_tables_have_no_bias() -> None:
    """Evidence, and filtered figures of all nodes, where some finite ones are integrated out by name."""
    tried = 0
    for seed, case in cases("finite", 6 * FEW):
        engine = tabled(case, seed)
        if engine is None:
            continue
        options: dict[str, Any] = {"alpha": ALPHA, "rng": np.random.SeedSequence([seed, 11])}
        evidence = unbiased_evidence_test(
            engine, case.dbn, case.observations, inputs=case.inputs, replications=100, **options
        )
        assert not evidence.rejected, (case.dbn, engine.marginalize, evidence)
        with np.errstate(divide="ignore", invalid="ignore"):
            if not np.log(evidence.ratios).std() <= EVEN:
                continue
        estimate, right = unbiased(case, engine)
        found = repeated_test(estimate, right, replications=RUNS, **options)
        assert found, (case.dbn, engine.marginalize, found)
        tried += 1
        if tried == FEW:
            break
    assert tried


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
@pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")
def test_particle_filters_of_machine_code_agree() -> None:
    """In every slice's figures at equal seeds; there is no chance in it."""
    pytest.importorskip("llvmlite", reason="llvmlite is not installed")
    told = []
    for seed, case in (*cases("linear", 3 * MANY), *cases("one number", MANY)):
        given = {"inputs": case.inputs, "rng": seed}
        engine = bmc.ParticleFilter(500, compiled=True)
        plain, fast = (
            bmc.filter(case.dbn, case.observations, engine=replace(engine, compiled=own), **given)
            for own in (False, True)
        )
        for name in plain.mean_errors:
            for own, other in ((fast.mean, plain.mean), (fast.var, plain.var)):
                np.testing.assert_allclose(own(name), other(name), rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(fast.mcse(name), plain.mcse(name), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(
            fast.log_marginal_increments, plain.log_marginal_increments, rtol=1e-9, atol=1e-9
        )
        question: dict[str, Any] = {"inputs": case.inputs, "question": "filter"}
        told.append(bmc.explain(case.dbn, case.observations, engine=engine, **question).effort)
    assert sum(text.startswith("slices as machine code") for text in told) >= 3, told


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ProposalWarning")
@pytest.mark.parametrize(("variant", "kind"), TRIED)
def test_particle_filters_state_their_errors(variant: str, kind: str) -> None:
    """Of the evidence and of the filtered figures of the last slice; half of them would be caught."""
    engine = bmc.ParticleFilter(400, **VARIANTS[variant])
    chosen = list(cases(kind, 3 * FEW))
    if not session.is_thorough():  # variants take turns at templates
        first = list(VARIANTS).index(variant) % len(chosen)
        chosen = chosen[first:] + chosen[:first]
    judged = caught = 0
    for seed, case in chosen:
        if judged and not session.is_thorough():
            break  # the first at which the filter tells its error
        if variant in MARGINAL and is_apart(case):
            continue  # rare states of elements that are filtered separately have no scouts
        options: dict[str, Any] = {"runs": 60, "alpha": ALPHA, "rng": [seed, 6, session.seed()]}
        found = stated_errors_test(*stated(case, engine), **options)
        assert found, (case.dbn, found)
        judged += len(found.comparisons) > 0
        with uncounted():
            caught += not stated_errors_test(*stated(case, engine, 0.5), **options)
    assert judged and caught >= judged / 2


def is_apart(case: Any) -> bool:
    """Whether elements of a plate are filtered separately."""
    found = bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=ONE, rng=0)
    return np.ndim(found.log_marginal_likelihood) > 0


@pytest.mark.parametrize(("engine", "kind"), [(e, k) for e in CHAINS for k in CHAINS[e][1]])
def test_particle_chains_match_exact_answers(engine: str, kind: str) -> None:
    asked = 0
    for seed, case in cases(kind, 8 * FEW, first=3):  # the first of all are slow, and doubted
        posterior = answered(case, CHAINS[engine][0], seed)
        if posterior is not None:
            found = compare(posterior, case.exact, ALPHA)
            assert found, (case.dbn, found)
            asked += 1
        if asked == FEW:
            break
    assert asked >= FEW / 2


def jumping() -> bmc.DynamicBayesNet:
    """A regime, and a level that it drives by an unknown gain."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("gain", bmc.Normal(1.0, 0.5))
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add(
        "x",
        lambda x_prev, z, gain: bmc.Normal(0.7 * x_prev + gain * z, 0.6),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.8))
    return dbn


@pytest.mark.parametrize("engine", CHAINS)
def test_particle_chains_are_calibrated(engine: str) -> None:
    dbn, steps = jumping(), 3
    chains = {"ParticleGibbs": bmc.ParticleGibbs, "ParticleMetropolis": bmc.ParticleMetropolis}
    short = chains[engine](draws=25, warmup=50, chains=8, particles=20)
    rows = [f"y[{t}]" for t in range(steps)]

    def ask(evidence: dict[str, Any], rng: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            return bmc.infer(dbn, {"y": [evidence[n] for n in rows]}, engine=short, rng=rng)

    def pay_no_heed(evidence: dict[str, Any], rng: Any) -> Any:
        drawn = dbn.unroll(steps).sample(200, rng=rng)
        return {n: v for n, v in drawn.items() if n not in rows}

    options: dict[str, Any] = {"observed": rows, "replications": session.scaled(20, 8),
                               "alpha": ALPHA, "rng": session.seed()}  # fmt: skip
    found = simulation_based_calibration(ask, dbn.unroll(steps), **options)
    assert found, found
    with uncounted():
        assert not simulation_based_calibration(pay_no_heed, dbn.unroll(steps), **options)


# ---- negative controls --------------------------------------------------------------------------


def upside_down(case: Any) -> dict[str, Any]:
    """The data with the last row first."""
    static = case.dbn.static_nodes
    return {n: v if n in static else v[::-1] for n, v in case.observations.items()}


@pytest.mark.parametrize("kind", ["finite", "linear"])
def test_data_in_the_wrong_order_are_seen(kind: str) -> None:
    seen = 0
    for _, case in cases(kind, MANY):
        try:
            smoothed = bmc.smooth(case.dbn, upside_down(case), inputs=case.inputs)
        except ZeroProbabilityError:
            continue
        with uncounted():
            seen += not compare(smoothed, case.exact, rtol=1e-6)
    assert seen >= 0.8 * MANY


def test_a_bias_of_few_particles_is_seen() -> None:
    """Averages by normalised weights are biased; times the evidence they are not."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))
    rows = {"y": [1.5, 2.0]}
    exact = bmc.infer(dbn, rows, engine=bmc.Exact()).mean("x[1]")
    engine = bmc.ParticleFilter(5)

    def plain(rng: np.random.Generator) -> float:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return float(bmc.filter(dbn, rows, engine=engine, rng=rng).mean("x")[-1])

    assert not repeated_test(plain, exact, replications=400, alpha=ALPHA, rng=0)
