"""Particle Metropolis: posteriors of static nodes against quadrature with the exact likelihood."""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.special

import bayesmc as bmc
from bayesmc.distributions import marking_invalid
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import ConvergenceWarning, UnsupportedError
from bayesmc.pmcmc import ParticleMetropolis
from bayesmc.pmcmc.filters import Filter
from bayesmc.pmcmc.quasi import Even, QuasiFilter, filter_of
from bayesmc.pmcmc.walk import ParameterWalk
from bayesmc.structure.target import target_of
from bayesmc.testing import session
from bayesmc.testing.verdict import holm

ALPHA = 1e-4
YS = {"y": [0.5, 1.9, -0.4, 0.9]}

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")


def walk() -> bmc.DynamicBayesNet:
    """A random walk whose steps have an unknown scale."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("scale", bmc.HalfNormal(1.0))
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, scale: bmc.Normal(x_prev, scale), initial=start)
    dbn.add("y", lambda x: bmc.Normal(x, 0.4))
    return dbn


def moments() -> dict[tuple[str, int], float]:
    """First and second moments of the scale and of the states, by quadrature over the scale."""
    grid = np.linspace(0.0, 6.0, 241)[1:]
    net, evidence = walk().unroll(4), walk().unrolled_evidence(YS)
    names = [f"x[{t}]" for t in range(4)]
    logs, means, squares = [], [], []
    for scale in grid:
        exact = bmc.infer(net, {**evidence, "scale": scale}, engine=bmc.Exact())
        logs.append(exact.log_marginal_likelihood)  # the prior of the scale is in it
        means.append([exact.mean(n) for n in names])
        squares.append([exact.var(n) + exact.mean(n) ** 2 for n in names])
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    found = {("scale", 1): weights @ grid, ("scale", 2): weights @ grid**2}
    for k, name in enumerate(names):
        found[name, 1] = weights @ np.array(means)[:, k]
        found[name, 2] = weights @ np.array(squares)[:, k]
    return found


def rejections(posterior: Any, exact: dict[tuple[str, int], float]) -> int:
    """How many moments do not match: chains are independent, so their means have a plain standard error."""
    values = []
    for (name, power), value in exact.items():
        means = np.mean(posterior[name] ** power, axis=1)
        error = means.std(ddof=1) / np.sqrt(len(means))
        values.append(scipy.special.erfc(abs(means.mean() - value) / error / np.sqrt(2.0)))
    return holm(sorted(values), ALPHA)


def test_posterior_is_that_of_quadrature(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = moments()
    engine = ParticleMetropolis(draws=200, warmup=100, chains=300, particles=8)
    found = bmc.infer(walk(), YS, engine=engine, rng=0)
    # false-alarm rate ALPHA, a little more with 300 chains
    assert rejections(found, exact) == 0
    assert list(found.acceptance) == ["scale"]
    assert 0.1 < found.acceptance["scale"].mean() < 0.6

    step = ParameterWalk.step

    def made_anew(self: Any, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        return step(self, values, {**memory, "log_likelihood": None}, rng, warmup)

    monkeypatch.setattr(ParameterWalk, "step", made_anew)
    assert rejections(bmc.infer(walk(), YS, engine=engine, rng=0), exact)


def test_likelihood_has_no_bias() -> None:
    """The mean of the estimate is the exact likelihood, for every chain's own parameters."""
    dbn, rng, chains = walk(), np.random.default_rng(0), 40_000
    problem = pose_any(dbn, YS)
    engine = ParticleMetropolis(particles=6)
    filter = Filter(engine._question(problem).trellis, 6)
    values = {**target_of(problem).known, "scale": np.tile([0.3, 1.5], chains // 2)}
    found = filter.run(values, chains, rng).log_likelihood.reshape(-1, 2)
    for k, scale in enumerate((0.3, 1.5)):
        evidence = {**dbn.unrolled_evidence(YS), "scale": scale}
        exact = bmc.infer(dbn.unroll(4), evidence, engine=bmc.Exact())
        prior = float(bmc.HalfNormal(1.0).log_prob(scale))
        ratio = np.exp(found[:, k] - (exact.log_marginal_likelihood - prior))
        # 4.4 standard errors: false-alarm rate 1e-5
        assert abs(ratio.mean() - 1.0) < 4.4 * ratio.std() / np.sqrt(len(ratio))
        assert abs(found[:, k].mean() - (exact.log_marginal_likelihood - prior)) > 0.02


def levels(case: str) -> tuple[bmc.DynamicBayesNet, dict[str, Any], int]:
    """Questions where one number goes on: with a gap, beside another, and in elements that never meet."""
    dbn = bmc.DynamicBayesNet(plates={"i": 2} if case == "plate" else None)
    own: Any = "i" if case == "plate" else ()
    dbn.add_static("scale", bmc.HalfNormal(1.0))
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, scale: bmc.Normal(0.9 * x_prev, scale), initial=start, plates=own)
    if case == "two draws":
        dbn.add("w", lambda x: bmc.Normal(x, 0.5))
        dbn.add("y", lambda w: bmc.Normal(w, 0.5))
    else:
        dbn.add("y", lambda x: bmc.Normal(x, 0.6), plates=own)
    y = np.array([0.5, 1.9, np.nan, 0.9, -0.7])
    return dbn, {"y": np.stack([y, -y[::-1]], axis=1) if case == "plate" else y}, len(y)


@pytest.mark.parametrize("case", ["gap", "two draws", "plate"])
def test_even_particles_leave_no_bias_and_less_variance(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against the exact likelihood and independent draws; points that are not uniform are noticed."""
    (dbn, rows, steps), chains = levels(case), 10_000
    problem = pose_any(dbn, rows)
    trellis = ParticleMetropolis()._question(problem).trellis
    even = filter_of(trellis, 12)
    assert isinstance(even, QuasiFilter)
    values = {**target_of(problem).known, "scale": np.full(chains, 0.7)}
    evidence = {**dbn.unrolled_evidence(rows), "scale": 0.7}
    exact = bmc.infer(dbn.unroll(steps), evidence, engine=bmc.Exact()).log_marginal_likelihood
    exact -= float(bmc.HalfNormal(1.0).log_prob(0.7))

    def off(filter: Filter) -> tuple[float, float]:
        rng = np.random.default_rng(session.seed())
        log = filter.run(values, chains, rng).log_likelihood - exact
        ratio = np.exp(log)
        return abs(ratio.mean() - 1.0) / ratio.std() * np.sqrt(chains), float(log.var())

    error, variance = off(even)
    assert error < 4.4  # standard errors: false-alarm rate 1e-5
    assert variance < 0.6 * off(Filter(trellis, 12))[1]
    real = np.random.Generator.random
    monkeypatch.setattr(Even, "random", lambda self, *a: 0.7 * real(self, *a))
    assert off(even)[0] > 4.4


def test_what_goes_on_besides_one_number_is_drawn_as_ever() -> None:
    dbn = walk()
    dbn.add("v", lambda v_prev: bmc.Normal(v_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("z", lambda v, x: bmc.Normal(v + x, 1.0))
    trellis = ParticleMetropolis()._question(pose_any(dbn, {"z": [1.0, 2.0]})).trellis
    assert type(filter_of(trellis, 12)) is Filter


def test_many_kinds_of_static_nodes() -> None:
    """A simplex, a partly seen plate and a computed node; the draws keep to their supports."""
    dbn = bmc.DynamicBayesNet(plates={"i": 3})
    dbn.add_static("shares", bmc.Dirichlet([2.0, 2.0, 2.0]))
    dbn.add_static("slope", bmc.Normal(0.0, 1.0), plates="i")
    dbn.add_static("double", lambda slope: 2.0 * slope, plates="i")
    dbn.add("z", lambda shares: bmc.Categorical(shares), plates="i")
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, double: bmc.Normal(x_prev + double, 1.0), initial=start, plates="i")
    dbn.add("y", lambda x, z: bmc.Normal(x + z, 0.5), plates="i")
    rows = {"y": np.arange(12.0).reshape(4, 3), "slope": [np.nan, 0.5, np.nan]}
    engine = ParticleMetropolis(draws=20, warmup=30, chains=3, particles=20)
    found = bmc.infer(dbn, rows, engine=engine, rng=0)
    assert np.allclose(found["shares"].sum(axis=-1), 1.0)
    assert (found["slope"][..., 1] == 0.5).all()
    assert np.allclose(found["double"], 2.0 * found["slope"])
    assert set(np.unique(found["z[2]"])) <= {0, 1, 2}


def test_same_seed_and_resuming() -> None:
    options = {"warmup": 45, "chains": 3, "particles": 6}
    long = _run(ParticleMetropolis(draws=30, **options))
    first = _run(ParticleMetropolis(draws=12, **options))
    dbn = walk()
    one = bmc.infer(dbn, YS, engine=ParticleMetropolis(draws=12, **options), rng=5)
    rest = bmc.infer(dbn, YS, engine=ParticleMetropolis(draws=18, **options), rng=5, resume=one)
    for name in ("scale", "x[2]"):
        assert np.array_equal(first[name], one[name])
        assert np.array_equal(long[name], rest[name])


def test_noisy_estimates_are_warned_of() -> None:
    dbn = walk()
    ys = {"y": np.r_[np.zeros(20), 6.0, -6.0, 6.0, -6.0]}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bmc.infer(dbn, ys, engine=ParticleMetropolis(draws=5, warmup=60, particles=5), rng=0)
    noisy = [w for w in caught if "estimated with an error" in str(w.message)]
    assert len(noisy) == 1
    assert issubclass(noisy[0].category, ConvergenceWarning)
    assert noisy[0].filename == __file__


def logits(steps: int) -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """Successes of 50 at a level that is pulled back to a mean: all of it unknown, and the prior far off."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("mu", bmc.Normal(5.0, 5.0))
    dbn.add_static("phi", bmc.Uniform(0.0, 1.0))
    dbn.add_static("sigma", bmc.HalfNormal(2.0))

    def first(mu: Any, phi: Any, sigma: Any) -> Any:
        return bmc.Normal(mu, sigma / np.sqrt(1 - phi**2))

    def moved(x_prev: Any, mu: Any, phi: Any, sigma: Any) -> Any:
        return bmc.Normal(mu + phi * (x_prev - mu), sigma)

    dbn.add("x", moved, initial=first)
    dbn.add("y", lambda x: bmc.Binomial(50, logits=x))
    rng, x = np.random.default_rng(3), [-2.0]
    while len(x) < steps:
        x.append(-2.0 + 0.9 * (x[-1] + 2.0) + 0.3 * rng.standard_normal())
    return dbn, {"y": rng.binomial(50, scipy.special.expit(x))}


@pytest.mark.parametrize("steps", [20, pytest.param(80, marks=pytest.mark.thorough)])
def test_chains_start_where_the_mass_is(steps: int) -> None:
    """By a pilot, which chooses the number of particles, too: more for more rows and for the same error."""
    dbn, rows = logits(steps)
    problem = pose_any(dbn, rows)
    sampler = ParticleMetropolis().sampler(problem)
    with marking_invalid(), np.errstate(all="ignore"):
        state = sampler.start(np.random.default_rng(0), 40)
        mu = state["values"]["mu"]
        assert np.abs(np.median(mu) + 2.0) < 0.8 and mu.std() < 2.0  # the prior says 5 +- 5
        (walk,), (memory,) = sampler.kernels, state["memory"]
        values = {**sampler.target.known, **state["values"]}
        same = {n: np.repeat(v[:1], 40, axis=0) for n, v in state["values"].items()}
        looks = walk.filter.of(memory["particles"]).run(
            {**values, **same}, 40, np.random.default_rng(1)
        )
        error = looks.log_likelihood.std()
    assert 50 <= memory["particles"] < 1000
    assert error < 2.0  # aimed at is 0.7, at least 50 particles are taken
    assert error > 0.3 or memory["particles"] == 50
    given = ParticleMetropolis(particles=70).sampler(problem)
    with marking_invalid(), np.errstate(all="ignore"):
        assert given.start(np.random.default_rng(0), 4)["memory"][0]["particles"] == 70


@pytest.mark.parametrize("chosen", [True, False])
def test_the_warmup_takes_more_particles_where_a_look_was_wrong(chosen: bool) -> None:
    """A given number stands."""
    dbn, rows = logits(40)
    engine = ParticleMetropolis() if chosen else ParticleMetropolis(particles=4)
    sampler, rng = engine.sampler(pose_any(dbn, rows)), np.random.default_rng(0)
    with marking_invalid(), np.errstate(all="ignore"):
        state = sampler.start(rng, 8)
        (walk,), memory = sampler.kernels, {**state["memory"][0], "particles": 4}
        values = {**sampler.target.known, **state["values"]}
        for _ in range(21):
            new, memory = walk.step(values, memory, rng, True)
            values = {**values, **new}
    assert (memory["particles"] > 10) is chosen
    assert np.isfinite(memory["log_likelihood"]).all()


@pytest.mark.thorough
@pytest.mark.parametrize("engine", [ParticleMetropolis(), bmc.ParticleGibbs()])
def test_five_hundred_rows_of_counts(engine: Any) -> None:
    """Over 250 effective draws of each parameter at default settings; the message says in what time."""
    dbn, rows = logits(500)
    begin = time.process_time()
    found = bmc.infer(dbn, rows, engine=engine, rng=0, keep=["mu", "phi", "sigma"])
    ess = {n: float(found.ess(n)) for n in ("mu", "phi", "sigma")}
    assert min(ess.values()) > 250, (ess, time.process_time() - begin)


def test_refusals() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0))
    with pytest.raises(UnsupportedError, match="give the template: infer"):
        bmc.infer(net, {"b": 1.0}, engine=ParticleMetropolis())
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    assert "none is hidden" in str(ParticleMetropolis().unsupported(dbn, {"y": [1.0, 2.0]}))
    dbn.add_static("k", bmc.Bernoulli(0.5))
    dbn.add("w", lambda x, k: bmc.Normal(x + k, 1.0))
    assert "'k' is discrete" in str(ParticleMetropolis().unsupported(dbn, {"w": [1.0, 2.0]}))


def _run(engine: Any) -> Any:
    return bmc.infer(walk(), YS, engine=engine, rng=5)


def test_explain_states_what_the_filters_take() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("scale", bmc.LogNormal(0.0, 0.5))
    dbn.add("x", lambda x_prev, scale: bmc.Normal(x_prev, scale), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    seen = {"y": np.zeros(20)}
    engine = bmc.ParticleMetropolis(draws=30, warmup=10, chains=4, particles=50)
    told = bmc.explain(dbn, seen, engine=engine).effort
    assert told.endswith(
        "each sweep filters 20 slices by 50 particles in every chain: 1.6e+05 particles moved in all"
    )
    told = bmc.explain(dbn, seen, engine=bmc.ParticleMetropolis()).effort
    assert told.endswith(
        "by 50 to 5000 particles in every chain: 9.6e+06 to 9.6e+08 particles moved in all"
    )
