"""The errors that particle filters state: of the evidence, of means, of shares, and where they cannot tell.

Runs are replicated as elements of a plate, which are filters of their own in one array; all have the same
rows.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.engines.particles.enough import of_states
from bayesmc.engines.particles.genealogy import begun, followed
from bayesmc.engines.particles.record import FilteredParticles
from bayesmc.engines.particles.smc import Layout, Particles
from bayesmc.errors import LowEssWarning
from bayesmc.resampling import systematic
from bayesmc.testing import session

RUNS = 100
GRID = bmc.GridFilter(grid={"x": (-12.0, 6.0, 600)})
#: errors beyond 3 stated ones among 100 runs that are let pass: of a true rate of 1 %, more come once in
#: 2,000 times. With half the error stated, 13 are beyond on average, and as few as 5 come once in 200 times.
LET_PASS = 5


def replicated(declare: Callable[..., None], runs: int = 0) -> bmc.DynamicBayesNet:
    """A template by itself, or so many of it side by side."""
    dbn = bmc.DynamicBayesNet(plates={"run": runs} if runs else {})
    declare(dbn, {"plates": "run"} if runs else {})
    return dbn


def binomial(dbn: bmc.DynamicBayesNet, plates: dict[str, Any]) -> None:
    """The model of the issue."""
    start = bmc.Normal(-4, 0.754)
    dbn.add("x", lambda x_prev: bmc.Normal(-4 + 0.98 * (x_prev + 4), 0.15), initial=start, **plates)
    dbn.add("y", lambda x: bmc.Binomial(50, logits=x), **plates)


def growth(dbn: bmc.DynamicBayesNet, plates: dict[str, Any]) -> None:
    """Two modes in most slices."""

    def mean(x_prev: Any, t: Any) -> Any:
        return 0.5 * x_prev + 25 * x_prev / (1 + x_prev**2) + 8 * np.cos(1.2 * t)

    start = bmc.Normal(0.0, np.sqrt(5.0))
    dbn.add(
        "x", lambda x_prev, t: bmc.Normal(mean(x_prev, t), np.sqrt(10.0)), initial=start, **plates
    )
    dbn.add("y", lambda x: bmc.Normal(x**2 / 20, 1.0), **plates)


def line(dbn: bmc.DynamicBayesNet, plates: dict[str, Any]) -> None:
    dbn.add(
        "x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.7), initial=bmc.Normal(0.0, 1.0), **plates
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.6), **plates)


def machine(dbn: bmc.DynamicBayesNet, plates: dict[str, Any]) -> None:
    """Numbers and labels."""
    step = np.array([[0.8, 0.15, 0.05], [0.1, 0.8, 0.1], [0.2, 0.1, 0.7]])
    start = bmc.Categorical([0.6, 0.3, 0.1])
    dbn.add("z", lambda z_prev: bmc.Categorical(step[z_prev]), initial=start, **plates)
    turn = [[0.9, 0.1], [0.2, 0.8]]
    dbn.table("w", ["w_prev"], turn, ("no", "yes"), initial=[0.9, 0.1], **plates)
    dbn.add("y", lambda z, w: bmc.Normal(1.5 * z + 1.0 * (w == "yes"), 1.0), **plates)


def rows(declare: Callable[..., None], steps: int) -> np.ndarray:
    return np.asarray(replicated(declare).sample(steps, rng=3)["y"][0], dtype=float)


def series(kind: str, steps: int) -> np.ndarray:
    """Rows of the binomial model, and rows that it explains badly."""
    found, rng = rows(binomial, steps), np.random.default_rng(5)
    half = steps // 2
    if kind in ("small step", "step"):
        share = 0.06 if kind == "small step" else 0.15
        found[half:] = rng.binomial(50, share, steps - half)
    elif kind == "outliers":
        found[:: steps // 4] = 10
    elif kind == "far outliers":
        found[half // 2 :: half] = 25
    elif kind == "bursts":
        found[half : half + 10] = rng.binomial(50, 0.6, 10)
    return found


def run(declare: Callable[..., None], y: np.ndarray, engine: Any, runs: int = RUNS) -> Any:
    """Filters side by side."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        given = {"y": np.repeat(y[:, None], runs, axis=1)}
        return bmc.filter(replicated(declare, runs), given, engine=engine, rng=session.seed())


def ratios(found: Any, exact: Any) -> np.ndarray:
    """Errors of the log evidence in units of the stated ones; 0 where no error is stated."""
    off = found.log_marginal_likelihood - exact.log_marginal_likelihood
    return off / found.log_marginal_likelihood_mcse


# ---- the evidence -------------------------------------------------------------------------------

BINOMIAL = ["well", "small step", "step", "outliers", "far outliers", "bursts"]
THOROUGH = ["small step", "far outliers"]


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.thorough] * (k in THOROUGH)) for k in BINOMIAL]
)
def test_the_binomial_series_is_within_three_errors(kind: str) -> None:
    """Rows from the model, level shifts, outliers, bursts: what cannot be told is infinite."""
    y = series(kind, 120)
    exact = bmc.filter(replicated(binomial), {"y": y}, engine=GRID)
    found = run(binomial, y, bmc.ParticleFilter(1000))
    off = ratios(found, exact)
    assert (np.abs(off) > 3).sum() <= LET_PASS
    told = np.isfinite(found.log_marginal_likelihood_mcse)
    if kind in ("well", "outliers"):
        assert told.mean() >= 0.75
        # of 100 normal figures the spread strays beyond these once in 10,000 times
        assert 0.75 < np.sqrt(np.mean(off[told] ** 2)) < 1.3
        assert (2 * np.abs(off) > 3).sum() > LET_PASS  # half the error would be caught
    if kind == "small step":
        assert told.mean() >= 0.5
    if kind in ("step", "far outliers", "bursts"):
        assert told.mean() <= 0.1


FILTERS: dict[str, tuple[Callable[..., None], dict[str, Any]]] = {
    "systematic": (line, {}),
    "multinomial": (line, {"resampling": "multinomial"}),
    "residual": (line, {"resampling": "residual"}),
    "always": (line, {"ess_threshold": 2.0}),
    "auxiliary": (line, {"auxiliary": True}),
    "optimal": (line, {"proposal": "optimal"}),
    "fully adapted": (line, {"proposal": "optimal", "auxiliary": True, "ess_threshold": 1.0}),
    "two modes": (growth, {}),
    "states": (machine, {}),
}


@pytest.mark.parametrize("variant", FILTERS)
def test_stated_errors_are_those_of_many_runs(variant: str) -> None:
    """Of the evidence of 100 runs, and of their means at every fifth slice.

    The spread of a hundred normal figures strays beyond a quarter once in 3,000 times; those of means are
    looser, as errors of thirty families are, and correlated along the series.
    """
    declare, options = FILTERS[variant]
    y = rows(declare, 40)
    engine = bmc.GridFilter(grid={"x": (-40.0, 40.0, 600)}) if declare is growth else None
    exact = bmc.filter(replicated(declare), {"y": y}, engine=engine)
    found = run(declare, y, bmc.ParticleFilter(1000, **options))
    off = ratios(found, exact)
    told = np.isfinite(found.log_marginal_likelihood_mcse).mean()
    assert told >= (0.75 if declare is growth else 0.95)
    assert (np.abs(off) > 3).sum() <= LET_PASS
    assert 0.75 < np.sqrt(np.mean(off**2)) < 1.3
    for name in ("x",) if declare is not machine else ("z",):
        z = (found.mean(name) - exact.mean(name)[:, None]) / found.mcse(name)
        assert z.shape == (40, RUNS)
        assert 0.8 < np.sqrt(np.mean(z[::5] ** 2)) < 1.3
        assert np.sqrt(np.mean((2 * z[::5]) ** 2)) > 1.3  # half the error would be caught
    if declare is machine:
        z = (found.probabilities("w") - exact.probabilities("w")[:, None]) / found.mcse("w")
        assert 0.8 < np.sqrt(np.mean(z[::5] ** 2)) < 1.3


@pytest.mark.parametrize("options", [
    {"adapt": bmc.KLD({"x": 0.1}, least=300)},
    {"recovery": bmc.Recovery({"x": bmc.Normal(0.0, 1.5)}, share=0.02)},
], ids=["adapt", "recovery"])  # fmt: skip
def test_errors_hold_where_numbers_change_and_some_begin_anew(options: dict[str, Any]) -> None:
    """Of forty runs, the spread of the evidence is the stated error within a third, but once in 500 times."""
    y, dbn = rows(line, 40), replicated(line)
    engine = bmc.ParticleFilter(2000, **options)
    found = [bmc.filter(dbn, {"y": y}, engine=engine, rng=[session.seed(), k]) for k in range(40)]
    logs = np.array([f.log_marginal_likelihood for f in found])
    stated = np.sqrt(np.mean([f.log_marginal_likelihood_mcse**2 for f in found]))
    assert 0.67 < logs.std(ddof=1) / stated < 1.4


#: runs of three thousand rows whose error may be infinite, of 100: it is no answer. Two such tests of a
#: thousand particles had 6 in 200; more than 10 of 100 come once in 1,000 times where 4 are to be expected
UNTOLD = 10


def three_thousand(kind: str, engine: bmc.ParticleFilter) -> np.ndarray:
    """Errors over stated ones, of 100 seeds one after the other; NaN where the error is infinite."""
    y, dbn = series(kind, 3000), replicated(binomial)
    exact = bmc.filter(dbn, {"y": y}, engine=GRID).log_marginal_likelihood
    off = []
    for k in range(RUNS):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            found = bmc.filter(dbn, {"y": y}, engine=engine, rng=[session.seed(), k])
        error = found.log_marginal_likelihood_mcse
        off.append(
            (found.log_marginal_likelihood - exact) / error if np.isfinite(error) else np.nan
        )
    print(
        f"{kind}, {engine.particles} particles: {np.isnan(off).sum()} infinite, "
        f"{(np.abs(off) > 3).sum()} beyond three, root mean square {np.sqrt(np.nanmean(np.square(off))):.2f}"
    )
    return np.array(off)


@pytest.mark.thorough
@pytest.mark.parametrize("particles", [1000, None])
def test_three_thousand_rows_are_within_three_errors(particles: int | None) -> None:
    """The series of the issue: 99 of 100 seeds, with a number of particles and without.

    Of 100 normal figures two or more are beyond 3 once in 30 times; of the halved errors fewer than two, once
    in 60,000 times.
    """
    off = three_thousand("well", bmc.ParticleFilter(particles))
    told = off[~np.isnan(off)]
    assert len(told) >= RUNS - UNTOLD
    assert (np.abs(told) > 3).sum() <= 1
    assert (2 * np.abs(told) > 3).sum() > 1  # half the error would be caught
    assert 0.75 < np.sqrt(np.mean(told**2)) < 1.3


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [k for k in BINOMIAL if k != "well"])
def test_three_thousand_rows_that_the_model_explains_badly(kind: str) -> None:
    """With a number of particles: what is told is right, and most often nothing can be told."""
    off = three_thousand(kind, bmc.ParticleFilter(1000))
    assert (np.abs(off) > 3).sum() <= LET_PASS


# ---- how many particles -------------------------------------------------------------------------


def test_particles_grow_until_the_error_is_small() -> None:
    y = rows(line, 150)
    dbn = replicated(line)
    exact = bmc.filter(dbn, {"y": y}).log_marginal_likelihood
    few = bmc.filter(dbn, {"y": y}, engine=bmc.ParticleFilter(tolerance=1.0), rng=0)
    many = bmc.filter(dbn, {"y": y}, engine=bmc.ParticleFilter(tolerance=0.2), rng=0)
    assert few.counts[0] < many.counts[0]
    assert many.log_marginal_likelihood_mcse < 0.2 < few.log_marginal_likelihood_mcse < 1.0
    for found in (few, many):
        assert abs(found.log_marginal_likelihood - exact) < 4 * found.log_marginal_likelihood_mcse
    again = bmc.filter(dbn, {"y": y}, engine=bmc.ParticleFilter(tolerance=0.2), rng=0)
    assert again.log_marginal_likelihood == many.log_marginal_likelihood


def test_the_run_that_answers_is_not_one_that_chose_the_number() -> None:
    """It is the run that its number of particles would give by itself."""
    y, dbn = rows(line, 100), replicated(line)
    found = bmc.filter(dbn, {"y": y}, engine=bmc.ParticleFilter(), rng=7)
    same = bmc.filter(dbn, {"y": y}, engine=bmc.ParticleFilter(int(found.counts[0])), rng=7)
    assert found.log_marginal_likelihood == same.log_marginal_likelihood


def steady() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """Position and velocity where next to nothing moves by itself.

    The evidence is known well by few particles, the states of a slice are not.
    """
    moved = np.array([[1.0, 1.0], [0.0, 1.0]])
    noise = 1e-4 * np.array([[1 / 3, 0.5], [0.5, 1.0]])
    dbn = bmc.DynamicBayesNet()
    start = bmc.MvNormal(np.zeros(2), np.diag([25.0, 1.0]))
    dbn.add("s", lambda s_prev: bmc.MvNormal(np.matvec(moved, s_prev), noise), initial=start)
    dbn.add("y", lambda s: bmc.Normal(s[..., 0], 4.0))
    return dbn, {"y": dbn.sample(40, 1, rng=1)["y"][0]}


def states_off(seed: int) -> tuple[float, float]:
    """By how much means are off in standard deviations, and spreads, at the most."""
    dbn, given = steady()
    exact = bmc.filter(dbn, given)
    found = bmc.filter(dbn, given, engine=bmc.ParticleFilter(), rng=seed)
    off = np.abs(found.mean("s") - exact.mean("s")) / exact.std("s")
    return float(off.max()), float(np.abs(found.std("s") / exact.std("s") - 1).max())


def test_particles_grow_until_states_are_known() -> None:
    """Of 120 runs with other seeds none is off by more than .23 and .13: of four, under one in ten times."""
    found = [states_off(session.seed() + k) for k in range(4)]
    assert max(mean for mean, _ in found) < 0.3
    assert max(spread for _, spread in found) < 0.2


def test_by_the_evidence_alone_they_are_too_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control."""
    monkeypatch.setattr("bayesmc.engines.particles.enough.of_states", lambda *given: {})
    found = [states_off(session.seed() + k) for k in range(4)]
    assert max(mean for mean, _ in found) > 0.3 or max(spread for _, spread in found) > 0.2


def test_one_hard_slice_of_finite_states_is_not_a_tenth() -> None:
    """Numbers of a domain have no axis of states: slices are ranked, and not each by itself."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("k", lambda k_prev: bmc.Bernoulli(0.1 + 0.8 * k_prev), initial=bmc.Bernoulli(0.5))
    dbn.add("y", lambda k: bmc.Normal(k, 1.0))
    y = dbn.sample(50, 1, rng=1)["y"][0]
    found = bmc.filter(dbn, {"y": y}, engine=bmc.ParticleFilter(300), rng=0)
    slices = pose_series(dbn, {"y": y}, None).slices
    errors = np.sort(found.mcse("k") / 0.5)
    assert isinstance(found, FilteredParticles)
    assert of_states(found, slices)["k"] == pytest.approx(errors[44])
    assert errors[44] < errors[-1]


def test_states_that_are_not_known_well_say_so() -> None:
    """Few particles leave trajectories with few ancestors, though the evidence is known well."""
    dbn, given = steady()
    with pytest.warns(LowEssWarning, match="means of 's' off by.*a larger budget= than 16_000"):
        found = bmc.smooth(dbn, given, engine=bmc.ParticleFilter(budget=16_000), rng=0)
    assert found.log_marginal_likelihood_mcse < 0.5
    assert (found.mcse("s") / found.std("s")).max() > 0.5


@pytest.mark.parametrize("kind", ["step", "far outliers", "bursts"])
def test_a_budget_that_is_spent_says_so(kind: str) -> None:
    engine = bmc.ParticleFilter(budget=400_000)
    with pytest.warns(LowEssWarning, match="cannot tell.*budget=|worth less than"):
        found = bmc.filter(replicated(binomial), {"y": series(kind, 100)}, engine=engine, rng=0)
    assert found.counts[0] == 4000
    assert np.isinf(found.log_marginal_likelihood_mcse)


def test_a_number_of_particles_is_kept_and_warns() -> None:
    rows_given, engine = {"y": series("bursts", 300)}, bmc.ParticleFilter(300)
    with pytest.warns(LowEssWarning, match="300 particles cannot tell.*use more particles"):
        found = bmc.filter(replicated(binomial), rows_given, engine=engine, rng=0)
    assert found.counts[0] == 300


def test_impossible_rows_are_tried_with_more_particles() -> None:
    """A spike that a thousand particles miss."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Uniform(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Uniform(x - 2e-4, x + 2e-4))
    found = bmc.filter(dbn, {"y": [0.5]}, engine=bmc.ParticleFilter(), rng=0)
    assert found.counts[0] > 1000
    assert abs(found.log_marginal_likelihood) < 4 * found.log_marginal_likelihood_mcse


def test_options_that_are_wrong_are_named() -> None:
    for options in ({"tolerance": 0.0}, {"tolerance": "small"}, {"budget": 0}, {"budget": 1.5}):
        with pytest.raises(ValueError, match=next(iter(options))):
            bmc.ParticleFilter(**options)


# ---- what else is answered ----------------------------------------------------------------------


def test_beliefs_and_queries_state_what_the_series_does() -> None:
    y, dbn, engine = rows(line, 20), replicated(line), bmc.ParticleFilter(500)
    options: dict[str, Any] = {"engine": engine, "rng": 4, "queries": {"up": lambda x: x > 0}}
    found = bmc.filter(dbn, {"y": y}, **options, keep="particles")
    belief = engine.start(dbn, rng=4)
    for k, value in enumerate(y):
        belief = engine.step(belief, {"y": value})
        np.testing.assert_allclose(belief.mcse("x"), found.mcse("x")[k], rtol=1e-9)
        np.testing.assert_allclose(belief.mcse(lambda x: x), found.mcse("x")[k], rtol=1e-9)
    assert belief.log_marginal_likelihood_mcse == found.log_marginal_likelihood_mcse
    assert engine.start(dbn).log_marginal_likelihood_mcse == 0.0
    assert found.queries_mcse["up"].shape == (20,)
    np.testing.assert_allclose(found.mcse(lambda x: x > 0), found.queries_mcse["up"])
    plain = bmc.filter(dbn, {"y": y}, **options)
    np.testing.assert_array_equal(plain.mcse("x"), found.mcse("x"))
    assert copy.deepcopy(plain).log_marginal_likelihood_mcse == plain.log_marginal_likelihood_mcse


def test_shares_that_no_particle_has_have_an_error() -> None:
    """A state of probability 1e-4, which 500 particles rarely meet."""
    dbn = bmc.DynamicBayesNet()
    step = [[0.9999, 0.0001], [0.5, 0.5]]
    dbn.table("z", ["z_prev"], step, ("up", "down"), initial=[0.9999, 0.0001])
    dbn.add("y", lambda z: bmc.Normal(0.0 * (z == "up"), 1.0))
    found = bmc.filter(dbn, {"y": [0.0] * 5}, engine=bmc.ParticleFilter(500), rng=0)
    never = found.probabilities("z")[:, 1] == 0
    assert never.any()
    assert (found.mcse("z")[never] > 1e-3).all()


@pytest.mark.parametrize("labelled", [True, False])
def test_rare_states_are_within_three_errors_whatever_their_values_are(labelled: bool) -> None:
    """Three errors about a rare state hold the truth in 49 of 50 runs, as a share, a mean, and a query."""
    dbn = bmc.DynamicBayesNet()

    def chance(s_prev: np.ndarray) -> np.ndarray:
        return np.where(s_prev == ("up" if labelled else 1), 0.5, 0.001)

    states = ("down", "up") if labelled else None
    dbn.add("s", lambda s_prev: bmc.Bernoulli(chance(s_prev)), states=states,
            initial=bmc.Bernoulli(0.001))  # fmt: skip
    dbn.add("y", lambda s: bmc.Normal(np.where(s == ("up" if labelled else 1), 1.0, 0.0), 0.6))
    y, name = {"y": [0.1, 0.3, 0.9, 0.2, 0.1]}, "s"
    queries = {"q": lambda s: (s == ("up" if labelled else 1)) * 1.0}
    right = bmc.filter(dbn, y).probabilities(name)[:, 1]
    outside = 0
    for seed in range(50):
        found = bmc.filter(dbn, y, engine=bmc.ParticleFilter(300), rng=seed, queries=queries)
        error = found.mcse(name)[:, 1] if labelled else found.mcse(name)
        assert (error > 0).all()
        off = np.abs(found.probabilities(name)[:, 1] - right)
        outside += bool((off > 3 * np.minimum(error, found.queries_mcse["q"])).any())
    assert outside <= 1


def test_fixed_lags_forecasts_and_smoothed_series() -> None:
    y, dbn, engine = rows(line, 30), replicated(line), bmc.ParticleFilter(1000)
    exact = bmc.smooth(dbn, {"y": y}, lag=3)
    found = bmc.smooth(dbn, {"y": y}, lag=3, engine=engine, rng=1)
    z = (found.mean("x") - exact.mean("x")) / found.mcse("x")
    assert 0.4 < np.sqrt(np.mean(z**2)) < 2.0  # thirty figures that hang together
    ahead = bmc.forecast(dbn, {"y": y}, steps=4, engine=engine, rng=1)
    assert ahead.mcse("x").shape == ahead.mean("x").shape == (4,)
    whole = bmc.smooth(dbn, {"y": y}, engine=engine, rng=1)
    assert whole.log_marginal_likelihood_mcse > 0
    right = bmc.smooth(dbn, {"y": y})
    z = (whole.mean("x") - right.mean("x")) / whole.mcse("x")
    assert 0.4 < np.sqrt(np.mean(z**2)) < 2.0
    assert (exact.mcse("x") == 0).all()
    assert bmc.filter(dbn, {"y": y}).log_marginal_likelihood_mcse == 0.0


@pytest.mark.parametrize("seed", range(12))
def test_one_filter_in_python_numbers_says_what_arrays_of_filters_say(seed: int) -> None:
    """Families of made-up slices, some with weights of long tails, by themselves and in a plate of one."""
    rng, n = np.random.default_rng(seed), int(10 ** (2 + seed % 3))

    def both(t: int, ancestors: np.ndarray | None, log: np.ndarray) -> list[Particles]:
        weights = np.exp(log - log.max())
        total, ess = float(weights.sum()), float(weights.sum() ** 2 / (weights**2).sum())
        one = Particles(t, {}, log, weights, total, 0.0, 0.0, ess, ancestors, ancestors is not None)
        wide = [None if a is None else a[:, None] for a in (log, weights, ancestors)]
        figures = (np.array([f]) for f in (total, 0.0, 0.0, ess))
        resampled = np.array([one.resampled])
        return [one, Particles(t, {}, wide[0], wide[1], *figures, wide[2], resampled)]

    layouts = Layout(n, (), ()), Layout(n, ("each",), (1,))
    before = both(0, None, rng.standard_normal(n))
    families = [begun(p, layout) for p, layout in zip(before, layouts, strict=True)]
    seen = set()
    for t in range(1, 200):
        ancestors = systematic(before[0].weights, n, rng)
        tailed = rng.choice([0.2, 1.0, 3.0]) * rng.standard_t(3, n)
        now = both(t, ancestors, tailed if seed % 2 else rng.standard_normal(n))
        found = [followed(f, b, p, True) for f, b, p in zip(families, before, now, strict=True)]
        families, before = [f for f, _ in found], now
        one, other = families
        seen |= {"odd"} if np.max(one.doubted) == t else set()
        seen |= {"due"} if (one.born == t).any() and np.isfinite(found[0][1]) else set()
        assert np.allclose(found[0][1], found[1][1], rtol=1e-9)
        for name in ("bounds", "shares", "explained", "born", "doubted"):
            left, right = getattr(one, name), getattr(other, name)
            assert np.allclose(left, np.reshape(right, np.shape(left)), rtol=1e-9), (t, name)
    assert "due" in seen or "odd" in seen
