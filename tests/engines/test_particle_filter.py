"""Particle filters against exact answers: evidence without bias, answers, steps, plates, and what goes wrong.

Unbiasedness is tested on thousands of filters at once: runs are a plate whose elements never meet.
"""

from __future__ import annotations

import copy
import tracemalloc
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.particles import filter_step
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.smc import Selection
from bayesmc.errors import (
    DegeneracyError,
    EvidenceError,
    ModelError,
    ParameterError,
    QueryError,
    UnknownNodeError,
    UnsupportedError,
)
from bayesmc.resampling import SCHEMES, Adaptive
from bayesmc.testing import session

ROWS = np.array([0.3, 1.5, np.nan, 2.0, 1.1])

# few particles, so that many runs are cheap
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")


def switching(runs: int = 0) -> bmc.DynamicBayesNet:
    """A regime, a level that it drives, a noisy reading: ``runs`` of them side by side, or one."""
    dbn = bmc.DynamicBayesNet("switching", plates={"run": runs} if runs else None)
    own: Any = "run" if runs else ()
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5], plates=own)
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(0.8 * x_prev + z, 0.5 + 0.5 * z),
        initial=lambda z: bmc.Normal(1.0 * z, 1.0),
        plates=own,
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.7), plates=own)
    return dbn


def linear() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 0.9), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))
    return dbn


def exact_of(dbn: bmc.DynamicBayesNet, rows: dict[str, Any]) -> Any:
    steps = len(next(iter(rows.values())))
    return bmc.infer(dbn.unroll(steps), dbn.unrolled_evidence(rows), engine=bmc.Exact())


def deviation(estimates: np.ndarray, log_evidence: float) -> float:
    """Standard errors by which the mean of estimates over the evidence is off 1."""
    ratio = np.exp(estimates - log_evidence)
    return float((ratio.mean() - 1.0) / (ratio.std(ddof=1) / np.sqrt(len(ratio))))


def nearer(x_prev, y):
    return bmc.Normal(0.5 * x_prev + 0.5 * y, 0.8)


def boosted(x_prev, z, y):
    """A detector's density and the transition, half and half."""
    moved, detected = bmc.Normal(0.8 * x_prev + z, 0.5 + 0.5 * z), bmc.Normal(y, 0.7)
    return bmc.Mixture([0.5, 0.5], [moved, detected])


def looked_ahead(x_prev, y):
    return -0.3 * (y - x_prev) ** 2


VARIANTS: dict[str, dict[str, Any]] = {
    "bootstrap": {},
    "proposal": {"proposal": {"x": nearer}},
    "boosted": {"proposal": {"x": boosted}},
    "both proposed": {
        "proposal": {"z": lambda z_prev, y: bmc.Bernoulli(0.5 + 0.1 * (y > 1)), "x": nearer}
    },
    "optimal": {"proposal": "optimal"},
    "auxiliary": {"auxiliary": True},
    "auxiliary, optimal": {"auxiliary": True, "proposal": "optimal"},
    "auxiliary by a function": {"auxiliary": looked_ahead},
    "auxiliary, heavy tails": {
        "auxiliary": True,
        "proposal": {"x": lambda x_prev, y: bmc.StudentT(5.0, 0.4 * x_prev + 0.6 * y, 0.7)},
    },
}
RUNS = 2000
EVIDENCE = exact_of(switching(), {"y": ROWS}).log_marginal_likelihood


def estimates(**options: Any) -> np.ndarray:
    """Log evidence of 2000 filters of 15 particles."""
    engine = bmc.ParticleFilter(15, **options)
    rows = np.repeat(ROWS[:, None], RUNS, axis=1)
    return bmc.filter(switching(RUNS), {"y": rows}, engine=engine, rng=5).log_marginal_likelihood


@pytest.mark.parametrize("threshold", [0.0, 0.5, 2.0], ids=["never", "adaptive", "always"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_evidence_is_unbiased(variant: str, threshold: float) -> None:
    """Mean of Z-hat / Z within 4 standard errors of 1 (6e-5 each, 1.7e-3 for all 27)."""
    found = estimates(ess_threshold=threshold, **VARIANTS[variant])
    assert found.std() < 1.0
    assert abs(deviation(found, EVIDENCE)) < 4


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("threshold", [0.5, 2.0], ids=["adaptive", "always"])
def test_the_evidence_is_unbiased_by_every_scheme(scheme: str, threshold: float) -> None:
    """As above (6e-5 each, 6e-4 for all 10)."""
    assert abs(deviation(estimates(resampling=scheme, ess_threshold=threshold), EVIDENCE)) < 4


def random_hybrid(seed: int, runs: int = 0) -> tuple[bmc.DynamicBayesNet, np.ndarray]:
    """A random switching template of up to ten slices, ``runs`` of them side by side, and its rows."""
    rng = np.random.default_rng([17, seed])
    states, steps = int(rng.integers(2, 4)), int(rng.integers(3, 11))
    table = rng.dirichlet(np.ones(states), size=states)
    slope, shift = rng.uniform(-0.9, 0.9, states), rng.normal(0.0, 1.0, states)
    scale, noise = rng.uniform(0.4, 1.2, states), rng.uniform(0.5, 1.2)
    back = rng.uniform(-0.4, 0.4)
    dbn = bmc.DynamicBayesNet(plates={"run": runs} if runs else None)
    own: Any = "run" if runs else ()
    dbn.table("z", ["z_prev"], table, initial=rng.dirichlet(np.ones(states)), plates=own)
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(slope[z] * x_prev + shift[z], scale[z]),
        initial=lambda z: bmc.Normal(shift[z], 1.0),
        plates=own,
    )
    dbn.add(
        "y",
        lambda x, y_prev: bmc.Normal(x + back * y_prev, noise),
        initial=lambda x: bmc.Normal(x, noise),
        plates=own,
    )
    rows = dbn.sample(steps, 1, rng=seed)["y"][0]
    if runs:
        rows = np.repeat(rows[:, :1], runs, axis=1)
    return dbn, rows


RANDOM = (
    {},
    {"proposal": "optimal"},
    {"proposal": {"x": lambda x_prev, y: bmc.StudentT(4.0, 0.2 * x_prev + 0.6 * y, 1.4)}},
    {"auxiliary": True},
)


@pytest.mark.parametrize("threshold", [0.5, 2.0], ids=["adaptive", "always"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_evidence_of_random_templates_is_unbiased(scheme: str, threshold: float) -> None:
    """Two templates and proposals each, 800 runs: within 4 standard errors (6e-5 each, 1.3e-3 in all).

    Templates on which the log evidence spreads by more than 1 tell nothing and give way to the next.
    """
    turn = 2 * list(SCHEMES).index(scheme) + int(threshold) // 2
    for k in range(2):
        options = RANDOM[(2 * turn + k + turn // 2) % len(RANDOM)]
        engine = bmc.ParticleFilter(60, resampling=scheme, ess_threshold=threshold, **options)
        for seed in range(100 * turn + 10 * k, 100 * turn + 10 * k + 5):
            dbn, rows = random_hybrid(seed, session.scaled(800))
            found = bmc.filter(dbn, {"y": rows}, engine=engine, rng=seed).log_marginal_likelihood
            if found.std() < 1.0:
                break
        assert found.std() < 1.0, (seed, options)
        exact = exact_of(random_hybrid(seed)[0], {"y": rows[:, 0]}).log_marginal_likelihood
        assert abs(deviation(found, exact)) < 4, (seed, options)


def forget_weights(step: FilterStep, *arguments: Any) -> Selection:
    found = REAL_SELECTED(step, *arguments)
    return found._replace(log_weights=0.0, log_normaliser=np.log(step.layout.particles))


def forget_first_stage(step: FilterStep, *arguments: Any) -> Selection:
    found = REAL_SELECTED(step, *arguments)
    return found if not np.any(found.resampled) else found._replace(log_weights=0.0)


def keep_weights(step: FilterStep, earlier: Any, *arguments: Any) -> Selection:
    found = REAL_SELECTED(step, earlier, *arguments)
    if found.ancestors is None:
        return found
    twice = np.take_along_axis(earlier.log_weights, found.ancestors, axis=0)
    return found._replace(log_weights=twice, log_normaliser=np.log(np.exp(twice).sum(axis=0)))


REAL_SELECTED = FilterStep.selected
FAULTS = {
    "weights forgotten where nothing was resampled": (forget_weights, {"ess_threshold": 0.3}),
    "first stage not divided out": (forget_first_stage, {"auxiliary": True, "ess_threshold": 2.0}),
    "weights kept after resampling": (keep_weights, {"ess_threshold": 2.0}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_bias_the_evidence(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong, options = FAULTS[fault]
    monkeypatch.setattr(FilterStep, "selected", wrong)
    assert abs(deviation(estimates(**options), EVIDENCE)) > 4


def test_slice_zero_may_have_an_order_of_its_own() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("b", lambda b_prev: bmc.Normal(b_prev, 1.0), initial=lambda a: bmc.Normal(a, 1.0))
    dbn.add("a", lambda a_prev: bmc.Normal(a_prev, 1.0), initial=bmc.Normal(2.0, 1.0))
    found = bmc.filter(dbn, {"b": [None, None]}, engine=bmc.ParticleFilter(20_000), rng=0)
    assert abs(found.mean("b")[1] - 2.0) < 0.1


def test_one_filter_is_unbiased_like_many() -> None:
    """Without plates: 200 filters one by one, within 4 standard errors (6e-5)."""
    dbn, engine = switching(), bmc.ParticleFilter(20, proposal={"x": nearer})
    found = [
        bmc.filter(dbn, {"y": ROWS}, engine=engine, rng=k).log_marginal_likelihood
        for k in range(session.scaled(200))
    ]
    assert abs(deviation(np.array(found), EVIDENCE)) < 4


# ---- answers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
def test_answers_are_those_of_the_unrolled_net(variant: str) -> None:
    """100,000 particles; means of x and P(z) of every slice to 0.02, some 5 standard errors."""
    engine = bmc.ParticleFilter(100_000, **VARIANTS[variant])
    filtered = bmc.filter(
        switching(),
        {"y": ROWS},
        engine=engine,
        rng=2,
        queries={"up": lambda x, z: (x > 1) & (z == 1)},
    )
    for t in range(len(ROWS)):
        rows = {"y": ROWS[: t + 1]}
        if np.isnan(rows["y"]).all():
            continue
        exact = exact_of(switching(), rows)
        assert abs(filtered.mean("x")[t] - exact.mean(f"x[{t}]")) < 0.02
        assert abs(filtered.std("x")[t] - exact.std(f"x[{t}]")) < 0.02
        both = filtered.probabilities("z")[t] - exact.probabilities(f"z[{t}]")
        assert np.abs(both).max() < 0.02
        assert (
            abs(filtered.log_marginal_increments[: t + 1].sum() - exact.log_marginal_likelihood)
            < 0.02
        )
    draws = exact_of(switching(), {"y": ROWS}).resample(40_000, rng=1)
    wanted = ((draws["x[4]"] > 1) & (draws["z[4]"] == 1)).mean()
    assert abs(filtered.queries["up"][4] - wanted) < 0.02
    assert filtered.mean("y")[0] == ROWS[0] and filtered.std("y")[2] > 0.7


def test_blocks_change_nothing_but_the_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many small blocks give answers as good as one."""
    monkeypatch.setattr(filter_step, "WHOLE", 10**6)
    whole = bmc.filter(switching(), {"y": ROWS}, engine=bmc.ParticleFilter(20_000), rng=0)
    monkeypatch.setattr(filter_step, "WHOLE", 0)
    monkeypatch.setattr(filter_step, "BLOCK", 1000)
    cut = bmc.filter(switching(), {"y": ROWS}, engine=bmc.ParticleFilter(20_000), rng=0)
    np.testing.assert_allclose(whole.mean("x"), cut.mean("x"), atol=0.05)
    np.testing.assert_allclose(whole.std("x"), cut.std("x"), rtol=0.05)
    np.testing.assert_allclose(whole.weight_ess, cut.weight_ess, rtol=0.05)
    assert abs(whole.log_marginal_likelihood - cut.log_marginal_likelihood) < 0.1


def test_forecasts_are_those_of_the_unrolled_net() -> None:
    rows = {"y": ROWS[:2]}
    ahead = bmc.forecast(switching(), rows, steps=3, engine=bmc.ParticleFilter(100_000), rng=0)
    exact = exact_of(switching(), {"y": [*ROWS[:2], np.nan, np.nan, np.nan]})
    assert ahead.start == 2 and ahead.steps == 3 and ahead.kind == "forecast"
    for t in range(3):
        assert abs(ahead.mean("x")[t] - exact.mean(f"x[{t + 2}]")) < 0.03
        assert abs(ahead.std("y")[t] - exact.std(f"y[{t + 2}]")) < 0.03


def test_steps_one_by_one_are_the_run() -> None:
    engine = bmc.ParticleFilter(500, proposal={"x": nearer})
    filtered = bmc.filter(switching(), {"y": ROWS}, engine=engine, rng=9)
    belief = engine.start(switching(), rng=9)
    assert belief.t == -1
    with pytest.raises(QueryError, match="absorbed nothing yet"):
        belief.mean("x")
    for t, row in enumerate(ROWS):
        before = belief
        belief = engine.step(belief, {} if np.isnan(row) else {"y": row})
        assert belief.t == t and belief.mean("x") == filtered.mean("x")[t]
        assert np.array_equal(belief.probabilities("z"), filtered.probabilities("z")[t])
    again = engine.step(before, {"y": ROWS[-1]})
    assert again.mean("x") == belief.mean("x")  # a step changes nothing of the old belief
    assert belief.log_marginal_likelihood == pytest.approx(filtered.log_marginal_likelihood)
    assert belief.expectation(lambda x, z: x * z) == pytest.approx(
        (belief.weights * belief.particles("x") * belief.particles("z")).sum()
    )


def test_controls_alone_and_measurements_alone() -> None:
    """Rows with inputs only leave weights as they are; without a transition rows only weigh."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.add("x", lambda x_prev, u: bmc.Normal(x_prev + u, 0.1), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    u = np.array([0.0, 1.0, 1.0, 1.0])
    moved = bmc.filter(
        dbn, {"y": [0.0, None, None, None]}, inputs={"u": u}, engine=bmc.ParticleFilter(4000), rng=0
    )
    assert np.allclose(moved.log_marginal_increments[1:], 0.0)
    assert np.allclose(np.diff(moved.mean("x")), 1.0, atol=0.02)
    still = bmc.DynamicBayesNet()
    still.add_static("c", bmc.Normal(0.0, 1.0))
    still.add("y", lambda c: bmc.Normal(c, 1.0))
    found = bmc.filter(still, {"y": [1.0, 2.0], "c": 0.5}, engine=bmc.ParticleFilter(10), rng=0)
    expected = bmc.Normal(0.5, 1.0).log_prob(np.array([1.0, 2.0]))
    np.testing.assert_allclose(found.log_marginal_increments, expected)


def test_plates_that_never_meet_are_filters_of_their_own() -> None:
    rows = np.array([[0.3, 2.0], [1.5, -0.5], [0.5, np.nan]])
    filtered = bmc.filter(switching(2), {"y": rows}, engine=bmc.ParticleFilter(50_000), rng=1)
    assert filtered.log_marginal_likelihood.shape == (2,) and filtered.weight_ess.shape == (3, 2)
    for k in range(2):
        exact = exact_of(switching(), {"y": rows[:, k]})
        assert abs(filtered.log_marginal_likelihood[k] - exact.log_marginal_likelihood) < 0.03
        assert abs(filtered.mean("x")[2, k] - exact.mean("x[2]")) < 0.03


def test_plates_that_meet_are_one_joint_state() -> None:
    """Two levels seen through their sum."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.5), initial=bmc.Normal(0.0, 1.0), plates="k")
    dbn.add("y", lambda x: bmc.Normal(x.sum("k"), 0.5))
    rows = {"y": [1.0, 1.5, 2.5]}
    filtered = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(100_000), rng=1)
    exact = exact_of(dbn, rows)
    assert isinstance(filtered.log_marginal_likelihood, float)
    assert abs(filtered.log_marginal_likelihood - exact.log_marginal_likelihood) < 0.03
    np.testing.assert_allclose(filtered.mean("x")[2], exact.mean("x[2]"), atol=0.02)


def test_partly_missing_elements_are_drawn() -> None:
    dbn = bmc.DynamicBayesNet(plates={"s": 3})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="s")
    rows = {"y": np.array([[1.0, np.nan, 2.0], [np.nan, np.nan, np.nan], [3.0, 2.0, 1.0]])}
    filtered = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(100_000), rng=1)
    exact = exact_of(dbn, rows)
    assert abs(filtered.log_marginal_likelihood - exact.log_marginal_likelihood) < 0.03
    assert abs(filtered.mean("x")[2] - exact.mean("x[2]")) < 0.02
    assert (
        filtered.mean("y")[0, 0] == pytest.approx(1.0)
        and abs(filtered.mean("y")[0, 1] - 1.0) < 0.05
    )


def test_history_is_kept_on_demand() -> None:
    engine = bmc.ParticleFilter(300, ess_threshold=0.7)
    kept = bmc.filter(switching(), {"y": ROWS}, engine=engine, rng=1, keep="particles")
    x, w, a = kept.particles("x"), kept.weights, kept.ancestors
    assert x.shape == w.shape == a.shape == (5, 300)
    np.testing.assert_allclose((x * w).sum(axis=1), kept.mean("x"))
    for t in range(1, 5):
        assert len(np.unique(a[t])) == kept.unique_ancestors[t]
        assert kept.resampled[t] == (kept.weight_ess[t - 1] < 0.7 * 300)
    gone = bmc.filter(switching(), {"y": ROWS}, engine=engine, rng=1)
    assert np.array_equal(gone.mean("x"), kept.mean("x"))
    with pytest.raises(UnsupportedError, match='give keep="particles"'):
        gone.particles("x")


def test_memory_does_not_grow_with_time() -> None:
    """Two hundred steps hold no more than twenty did, but for the answers."""
    engine, dbn = bmc.ParticleFilter(2000), switching()
    belief = engine.start(dbn, rng=0)
    for _ in range(20):
        belief = engine.step(belief, {"y": 0.5})
    tracemalloc.start()
    for k in range(200):
        belief = engine.step(belief, {"y": 0.5})
        if k == 20:
            before = tracemalloc.get_traced_memory()[0]
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 50_000


def test_an_adaptive_scheme_brings_its_own_threshold() -> None:
    plain = bmc.ParticleFilter(200, resampling="stratified", ess_threshold=0.8)
    wrapped = bmc.ParticleFilter(200, resampling=Adaptive("stratified", 0.8))
    one, two = (bmc.filter(switching(), {"y": ROWS}, engine=e, rng=3) for e in (plain, wrapped))
    assert np.array_equal(one.mean("x"), two.mean("x"))


def test_angles_are_averaged_around_the_circle() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("a", lambda a_prev: bmc.VonMises(a_prev, 50.0), initial=bmc.VonMises(3.1, 50.0))
    dbn.add("y", lambda a: bmc.VonMises(a, 50.0))
    filtered = bmc.filter(dbn, {"y": [3.1, -3.1, 3.1]}, engine=bmc.ParticleFilter(5000), rng=0)
    assert np.all(np.abs(np.abs(filtered.mean("a")) - np.pi) < 0.15)
    assert np.all(filtered.std("a") < 0.3)


# ---- what goes wrong ----------------------------------------------------------------------------


def narrow() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=bmc.Normal(0.0, 1.0))
    dbn.add("easy", lambda x: bmc.Normal(x, 1.0))
    dbn.add("hard", lambda x: bmc.Uniform(x - 0.5, x + 0.5))
    return dbn


def test_a_filter_without_weights_names_slice_and_node() -> None:
    rows = {"easy": [0.0, 0.0, 0.0], "hard": [0.0, 30.0, 0.0]}
    with pytest.raises(DegeneracyError, match=r"value of 'hard' in slice 1.*rejuvenate") as caught:
        bmc.filter(narrow(), rows, engine=bmc.ParticleFilter(100), rng=0)
    assert caught.value.t == 1 and caught.value.node == "hard"


def test_rejuvenation_begins_anew_and_says_so() -> None:
    engine = bmc.ParticleFilter(
        1000,
        on_degeneracy="rejuvenate",
        rejuvenation={"x": lambda hard: bmc.Normal(hard, 1.0)},
    )
    rows = {"easy": [0.0, 30.0, 30.0], "hard": [0.0, 30.0, 30.0]}
    filtered = bmc.filter(narrow(), rows, engine=engine, rng=0)
    assert filtered.rejuvenated.tolist() == [False, True, False]
    assert abs(filtered.mean("x")[1] - 30.0) < 0.3 and np.isfinite(filtered.log_marginal_likelihood)
    far = {"x": bmc.Normal(-50.0, 1.0)}
    engine = bmc.ParticleFilter(100, on_degeneracy="rejuvenate", rejuvenation=far)
    with pytest.raises(DegeneracyError, match="slice 1"):
        bmc.filter(narrow(), rows, engine=engine, rng=0)


def test_a_plate_of_filters_names_the_one_that_failed() -> None:
    rows = np.array([[0.0, 0.0], [0.0, 1e9]])
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=bmc.Normal(0.0, 1.0), plates="k")
    dbn.add("y", lambda x: bmc.Uniform(x - 5.0, x + 5.0), plates="k")
    with pytest.raises(DegeneracyError, match=r"'y' \(plate element 1\) in slice 1"):
        bmc.filter(dbn, {"y": rows}, engine=bmc.ParticleFilter(50), rng=0)


def test_static_nodes_must_be_known() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("s", bmc.Gamma(2.0, 2.0))
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev, s), initial=bmc.Normal(0.0, 1.0))
    engine = bmc.ParticleFilter(50)
    with pytest.raises(UnsupportedError, match=r"'s' is not observed; observe it.*ParticleGibbs"):
        bmc.filter(dbn, {"x": [0.0]}, engine=engine)
    assert bmc.filter(dbn, {"x": [0.0], "s": 1.0}, engine=engine).steps == 1
    belief = engine.start(dbn, static={"s": 1.0}, rng=0)
    assert engine.step(belief, {"x": 0.3}).t == 0
    with pytest.raises(EvidenceError, match="static node 's' has no value"):
        engine.step(engine.start(dbn, rng=0), {"x": 0.3})


def test_a_bad_parameter_names_the_node() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(1.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(0.0, x))
    with pytest.raises(ParameterError, match="node 'y': Normal: scale must be positive"):
        bmc.filter(dbn, {"y": [0.1, 0.2]}, engine=bmc.ParticleFilter(100), rng=0)


BAD: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "no particles": ({"particles": 0}, ValueError, r"particles=0\): give a number of particles"),
    "a share": ({"ess_threshold": -1}, ValueError, "ess_threshold=-1"),
    "a scheme": ({"resampling": "sistematic"}, ValueError, "did you mean 'systematic'"),
    "degeneracy": ({"on_degeneracy": "ignore"}, ValueError, 'give "raise" or "rejuvenate"'),
    "no densities": ({"on_degeneracy": "rejuvenate"}, ValueError, "go together"),
    "a list": ({"proposal": [1]}, TypeError, r"ParticleFilter\(proposal=\[1\]\): give a dict"),
    "twice": ({"proposal": {"x": nearer, ("x",): nearer}}, ModelError, "'x' has two proposals"),
    "auxiliary": ({"auxiliary": 3}, TypeError, "auxiliary=3"),
}


def test_bad_options_of_smoothing_say_what_to_give() -> None:
    engine, rows = bmc.ParticleFilter(10), {"y": ROWS}
    with pytest.raises(ValueError, match='backward=.fast.*give "rejection" or "exact"'):
        bmc.smooth(linear(), rows, engine=engine, backward="fast")
    with pytest.raises(
        ValueError, match=r"smooth\(trajectories=0\): give a number of trajectories"
    ):
        bmc.smooth(linear(), rows, engine=engine, trajectories=0)
    with pytest.raises(ValueError, match=r"smooth\(trajectories=9\).*KalmanFilter has none"):
        bmc.smooth(linear(), rows, trajectories=9)


@pytest.mark.parametrize("fault", BAD)
def test_bad_options_say_what_to_give(fault: str) -> None:
    options, error, message = BAD[fault]
    with pytest.raises(error, match=message):
        bmc.ParticleFilter(**options)


MISFITS: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "unknown target": ({"proposal": {"w": nearer}}, UnknownNodeError, "proposal for 'w'"),
    "unknown argument": (
        {"proposal": {"x": lambda q: bmc.Normal(q, 1.0)}}, UnknownNodeError, "'q' is no node"
    ),
    "its own target": (
        {"proposal": {"x": lambda x: bmc.Normal(x, 1.0)}}, ModelError, "names 'x', which it is to draw"
    ),
    "what is never seen": (
        {"proposal": {"z": lambda x: bmc.Bernoulli(0.5 + 0 * x)}}, ModelError, "'x'.*is not observed"
    ),
    "another kind": (
        {"proposal": {"x": lambda x_prev: bmc.Poisson(1.0 + 0 * x_prev)}}, ModelError, "is continuous"
    ),
    "a first stage of the wrong shape": (
        {"auxiliary": lambda x_prev: np.zeros(3)}, ModelError, "returns shape"
    ),
    "an unknown first stage": ({"auxiliary": lambda w: w}, UnknownNodeError, "auxiliary= names 'w'"),
}  # fmt: skip


@pytest.mark.parametrize("fault", MISFITS)
def test_options_that_do_not_fit_the_template_say_so(fault: str) -> None:
    options, error, message = MISFITS[fault]
    engine = bmc.ParticleFilter(50, ess_threshold=2.0, **options)
    with pytest.raises(error, match=message):
        bmc.filter(switching(), {"y": ROWS}, engine=engine, rng=0)


def test_queries_of_unknown_nodes_say_which_there_are() -> None:
    with pytest.raises(UnknownNodeError, match=r"queries=.'a': .* reads 'q'.*\['z', 'x', 'y'\]"):
        bmc.filter(
            switching(),
            {"y": ROWS},
            engine=bmc.ParticleFilter(9),
            queries={"a": lambda q: q},
            rng=0,
        )
    with pytest.raises(ValueError, match=r"forecast\(steps=0\)"):
        bmc.forecast(switching(), {"y": ROWS}, steps=0)


def test_options_are_values() -> None:
    one = bmc.ParticleFilter(10, proposal={"x": nearer})
    assert one == bmc.ParticleFilter(10, proposal={"x": nearer}) != bmc.ParticleFilter(11)
    assert copy.copy(one) == one and hash(one) == hash(
        bmc.ParticleFilter(10, proposal={"x": nearer})
    )
