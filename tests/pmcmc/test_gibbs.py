"""Particle Gibbs: a sweep leaves exact posteriors alone, whatever the template, with five particles.

Chains that start at independent draws of the exact posterior are moved by a few sweeps; what they are then
must have the same distribution. Chains do not depend on each other, so figures over them have the errors of
independent draws.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.special

import bayesmc as bmc
from bayesmc.distributions import marking_invalid
from bayesmc.engines.mcmc import starts as starting
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import ReducibleWarning, UnsupportedError
from bayesmc.pmcmc import ParticleGibbs
from bayesmc.pmcmc.filters import ConditionalFilter, independent, picked
from bayesmc.testing.posteriors.matching import assert_matches
from bayesmc.testing.verdict import holm
from tests.pmcmc import templates
from tests.pmcmc.templates import Case

CHAINS, SWEEPS, ALPHA = 20_000, 4, 1e-4

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")


def rejected(case: Case, seed: int = 1) -> list[str]:
    """Figures of swept chains that are not those of the exact posterior, at a family-wise rate of ALPHA."""
    problem = pose_any(case.dbn, case.observations, case.inputs or None)
    engine = ParticleGibbs(particles=case.particles, chains=CHAINS)
    assert engine.refusal(problem) is None
    exact = bmc.infer(
        case.dbn, case.observations, inputs=case.inputs or None, engine=bmc.Exact()
    ).resample(2 * CHAINS, rng=seed)
    sampler = engine.sampler(problem)
    target = sampler.target
    drawn = {n: exact._stored[n][0] for n in (*target.chain, *target.links)}
    before = {n: v[:CHAINS] for n, v in drawn.items()}
    after = {n: v[CHAINS:] for n, v in drawn.items()}
    state: Any = {
        "values": before,
        "memory": [k.start({**target.known, **before}, CHAINS) for k in sampler.kernels],
        "chains": CHAINS,
    }
    rng = np.random.default_rng(seed)
    with marking_invalid(), np.errstate(all="ignore"):
        for _ in range(SWEEPS):
            state = sampler.step(state, rng, False)
    found = _figures(state["values"], target.chain)
    # both are of as many independent draws, so their difference has twice the variance
    wanted = _figures(after, target.chain)
    names, values = [], []
    for name in found:
        a, b = found[name], wanted[name]
        error = np.sqrt((a.var() + b.var()) / CHAINS)
        if error > 0:
            names.append(name)
            values.append(scipy.special.erfc(abs(a.mean() - b.mean()) / error / np.sqrt(2.0)))
    assert len(values) >= 6
    order = np.argsort(values)
    return [names[i] for i in order[: holm(sorted(values), ALPHA)]]


def _figures(values: dict[str, np.ndarray], chain: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Values, squares, and products of neighbours, one number for each chain."""
    flat = {
        f"{n}{list(i)}": values[n][(slice(None), *i)].astype(float)
        for n in chain
        for i in np.ndindex(values[n].shape[1:])
    }
    found = dict(flat)
    found |= {f"{n} squared": np.square(v) for n, v in flat.items()}
    found |= {f"{a} x {b}": flat[a] * flat[b] for a, b in itertools.pairwise(flat)}
    return found


@pytest.mark.parametrize("make", templates.CASES, ids=lambda f: f.__name__)
def test_a_sweep_leaves_the_posterior_alone(make: Callable[[], Case]) -> None:
    # false-alarm rate: ALPHA for each template
    assert rejected(make()) == []


def _not_kept(self: Any, drawn: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
    return drawn


def _blind_ancestor(
    self: Any, place: Any, known: Any, values: Any, log: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    return picked(log, rng)


def _weightless(
    self: Any, place: Any, known: Any, values: Any, log: np.ndarray, rng: np.random.Generator
) -> Any:
    log = log.copy()
    log[-1] = -np.inf
    return ORIGINAL(self, place, known, values, log, rng)


ORIGINAL = ConditionalFilter._selected


@pytest.mark.parametrize(
    ("method", "fault"),
    [("_kept", _not_kept), ("_ancestor", _blind_ancestor), ("_selected", _weightless)],
    ids=["trajectory not kept", "ancestor without the transition", "kept particle's weight lost"],
)
def test_faults_are_seen(monkeypatch: pytest.MonkeyPatch, method: str, fault: Any) -> None:
    monkeypatch.setattr(ConditionalFilter, method, fault)
    assert rejected(templates.gaussian())


def test_no_ancestor_is_drawn_past_a_running_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    case = templates.carried()
    engine = ParticleGibbs(particles=case.particles)
    problem = pose_any(case.dbn, case.observations)
    assert "with its own ancestors" in engine.describe(problem)["v[0]"]
    assert "with ancestor sampling" in engine.describe(_posed(templates.gaussian()))["x[0]"]

    def drawn_all_the_same(self, place, known, values, log, rng):
        return picked(log + self._onward(place, known, values, log.shape, rng), rng)

    monkeypatch.setattr(ConditionalFilter, "_ancestor", drawn_all_the_same)
    assert rejected(case)


def test_chains_find_the_posterior() -> None:
    case = templates.static()
    exact = bmc.infer(case.dbn, case.observations, engine=bmc.Exact())
    engine = ParticleGibbs(draws=60, warmup=30, chains=60, particles=10)
    found = bmc.infer(case.dbn, case.observations, engine=engine, rng=0)
    assert found["x[4]"].shape == (60, 60)
    assert_matches(found, exact, alpha=1e-4)  # its false-alarm rate


def test_nonlinear_agrees_with_weighting() -> None:
    """Slice kernels of static nodes, nothing of it linear; weighted draws of the unrolled net judge it."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("sigma", bmc.HalfNormal(1.0))
    dbn.add_static("level", bmc.Normal(0.0, 2.0))
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, sigma: bmc.Normal(0.7 * x_prev, sigma), initial=start)
    dbn.add("y", lambda x, level: bmc.Poisson(np.exp(level + 0.5 * x)))
    counts = {"y": [2, 0, 4]}
    engine = ParticleGibbs(draws=100, warmup=40, chains=100, particles=10)
    found = bmc.infer(dbn, counts, engine=engine, rng=0)
    judge = bmc.infer(dbn, counts, engine=bmc.LikelihoodWeighting(400_000), rng=1)
    weights = np.exp(judge.log_weights - judge.log_weights.max()).ravel()
    weights /= weights.sum()
    values = []
    for name in ("sigma", "level", *(f"x[{t}]" for t in range(3))):
        for power in (1, 2):
            # means over chains that do not depend on each other
            a, b = np.mean(found[name] ** power, axis=1), judge[name].ravel() ** power
            mean = weights @ b
            error = np.sqrt(a.var(ddof=1) / 100 + np.square(weights * (b - mean)).sum())
            values.append(scipy.special.erfc(abs(a.mean() - mean) / error / np.sqrt(2.0)))
    assert holm(sorted(values), ALPHA) == 0  # false-alarm rate ALPHA, a little more with 100 chains


def test_same_seed_and_resuming() -> None:
    case = templates.static()
    options = {"warmup": 20, "chains": 3, "particles": 6}
    long = _run(case, ParticleGibbs(draws=30, **options))
    again = _run(case, ParticleGibbs(draws=30, **options))
    first = _run(case, ParticleGibbs(draws=12, **options))
    rest = _run(case, ParticleGibbs(draws=18, **options), resume=first)
    for name in ("mu", "rich", "x[2]", "z[4]", "y[3]"):
        assert np.array_equal(long[name], again[name])
        assert np.array_equal(long[name], rest[name])
    anew = _run(templates.static(), ParticleGibbs(draws=18, **options), resume=first)
    assert np.array_equal(long["mu"], anew["mu"])  # the same template, declared again
    with pytest.raises(UnsupportedError, match="resume=.* earlier ParticleGibbs posterior"):
        _run(templates.gaussian(), ParticleGibbs(draws=18, **options), resume=first)


def test_starts_where_forward_draws_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every observation is within a narrow window of its state, which no forward draw of all slices meets."""
    monkeypatch.setattr(starting, "_MOST", 1 << 12)  # they are given up sooner
    dbn = bmc.DynamicBayesNet()
    start = bmc.Uniform(0.0, 1.0)
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=start)
    dbn.add("y", lambda x: bmc.Uniform(x - 0.15, x + 0.15))
    ys = np.cumsum(np.r_[0.5, np.tile([1.0, -0.8, 0.7, 0.9], 4)])
    engine = ParticleGibbs(draws=5, warmup=5, chains=2, particles=300)
    found = bmc.infer(dbn, {"y": ys}, engine=engine, rng=0)
    for t, y in enumerate(ys):
        assert (abs(found[f"x[{t}]"] - y) <= 0.15).all()


def test_overflow_is_a_density_of_zero() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("width", bmc.Normal(0.0, 300.0))
    dbn.add(
        "x", lambda x_prev, width: bmc.Normal(x_prev, np.exp(width)), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    engine = ParticleGibbs(draws=20, warmup=20, chains=2, particles=20)
    found = bmc.infer(dbn, {"y": [0.0, 1.0, 2.0]}, engine=engine, rng=0)
    assert np.isfinite(found["x[2]"]).all()


def test_refusals() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0))
    with pytest.raises(UnsupportedError, match="give the template: infer"):
        bmc.infer(net, {"b": 1.0}, engine=ParticleGibbs())
    dbn = bmc.DynamicBayesNet()
    dbn.add("y", bmc.Normal(0.0, 1.0))
    assert "nothing to learn" in str(ParticleGibbs().unsupported(dbn, {"y": [1.0, 2.0]}))
    dense = bmc.DynamicBayesNet()
    dense.add("x", bmc.Density(lambda x: -0.5 * x**2))
    dense.add("y", lambda x: bmc.Normal(x, 1.0))
    assert "without sample=" in str(ParticleGibbs().unsupported(dense, {"y": [1.0, 2.0]}))
    with pytest.raises(ValueError, match="2 or more"):
        ParticleGibbs(particles=1)
    with pytest.raises(ValueError, match="particles"):
        ParticleGibbs(particles=2.5)  # type: ignore[arg-type]


def test_static_nodes_alone() -> None:
    """Nothing hidden in the slices: what is left is Gibbs."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("level", bmc.Normal(0.0, 10.0))
    dbn.add("y", lambda level: bmc.Normal(level, 1.0))
    ys = {"y": [1.0, 2.0, 3.0]}
    found = bmc.infer(dbn, ys, engine=ParticleGibbs(draws=300, chains=4), rng=0)
    assert_matches(found, bmc.infer(dbn, ys, engine=bmc.Exact()), alpha=1e-4)


def test_ties_between_static_nodes_and_slices_are_warned_of() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("flip", bmc.Bernoulli(0.5))
    dbn.table("z", ["z_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("o", lambda z, flip: bmc.Bernoulli(np.where((z + flip) % 2 == 1, 1.0, 0.0)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bmc.infer(dbn, {"o": [1, 0, 0]}, engine=ParticleGibbs(draws=5, warmup=2), rng=0)
    assert any(
        issubclass(w.category, ReducibleWarning) and "'flip'" in str(w.message) for w in caught
    )


def test_every_static_engine_takes_a_template() -> None:
    case = templates.switching()
    exact = bmc.infer(case.dbn, case.observations, inputs=case.inputs, engine=bmc.Exact())
    chosen = bmc.infer(case.dbn, case.observations, inputs=case.inputs)
    assert chosen.mean("x[4]") == pytest.approx(exact.mean("x[4]"))
    unrolled = case.dbn.unroll(5, case.inputs)
    same = bmc.infer(unrolled, case.dbn.unrolled_evidence(case.observations), engine=bmc.Exact())
    assert same.mean("x[4]") == pytest.approx(exact.mean("x[4]"))


def test_indices_are_in_proportion_to_weights() -> None:
    rng = np.random.default_rng(0)
    weights = np.array([[0.0, 2.0], [0.3, 0.0], [0.7, 6.0], [0.0, 0.0]])
    shares = weights / weights.sum(axis=0)
    for draws in (independent(weights, 40_000, rng), _one_by_one(weights, 40_000, rng)):
        for column in range(2):
            counts = np.bincount(draws[:, column], minlength=4)
            p = shares[:, column]
            assert (counts[p == 0] == 0).all()
            # 5 standard errors of three counts, twice two columns: false-alarm rate 1e-5
            assert (abs(counts - 40_000 * p) <= 5.0 * np.sqrt(40_000 * p * (1 - p))).all()


def _one_by_one(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    with np.errstate(divide="ignore"):
        log = np.log(weights)
    return picked(np.repeat(log[:, None], draws, axis=1), rng)


def _posed(case: Case) -> Any:
    return pose_any(case.dbn, case.observations, case.inputs or None)


def _run(case: Case, engine: Any, resume: Any = None) -> Any:
    return bmc.infer(case.dbn, case.observations, engine=engine, rng=5, resume=resume)
