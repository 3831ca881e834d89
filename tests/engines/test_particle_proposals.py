"""Proposals that look at the row and first stages, against exact answers, over structures of many kinds.

Evidence is held against the truth on thousands of filters at once: runs are a plate whose elements never
meet.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.engines.particles import linearisation
from bayesmc.engines.particles import optimal as guarding
from bayesmc.engines.particles.auxiliary import PluggedIn
from bayesmc.engines.particles.linearisation import Belief, LookAhead
from bayesmc.engines.particles.looking import has_moments
from bayesmc.engines.particles.mixtures import ByCase, Cases
from bayesmc.engines.particles.optimal import Guarded, groups_of, is_affine, order_of
from bayesmc.errors import ModelError, ProposalWarning
from bayesmc.network.forward import Pass
from bayesmc.testing import session

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")

Build = Callable[..., bmc.DynamicBayesNet]


def template(runs: int) -> tuple[bmc.DynamicBayesNet, Any]:
    """A template whose nodes are meant for ``runs`` filters side by side, or for one."""
    return bmc.DynamicBayesNet(plates={"run": runs} if runs else None), "run" if runs else ()


def level(dbn: bmc.DynamicBayesNet, own: Any) -> None:
    dbn.add(
        "x", lambda x_prev: bmc.Normal(0.8 * x_prev, 0.9), initial=bmc.Normal(0.0, 1.0), plates=own
    )


def linear(runs: int = 0) -> bmc.DynamicBayesNet:
    dbn, own = template(runs)
    level(dbn, own)
    dbn.add("y", lambda x: bmc.Normal(x, 0.7), plates=own)
    return dbn


def sharp(runs: int = 0) -> bmc.DynamicBayesNet:
    """Rows that say far more than the transition."""
    dbn, own = template(runs)
    dbn.add(
        "x", lambda x_prev: bmc.Normal(0.9 * x_prev, 2.0), initial=bmc.Normal(0.0, 2.0), plates=own
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.3), plates=own)
    return dbn


def bent(runs: int = 0) -> bmc.DynamicBayesNet:
    """A sensor with a mean that is not affine, narrow beside the bend."""
    dbn, own = template(runs)
    level(dbn, own)
    dbn.add("y", lambda x: bmc.Normal(x + 0.4 * np.sin(2 * x), 0.2), plates=own)
    return dbn


def heavy(runs: int = 0) -> bmc.DynamicBayesNet:
    dbn, own = template(runs)
    level(dbn, own)
    dbn.add("y", lambda x: bmc.StudentT(1.0, x, 0.5), plates=own)
    return dbn


def counted(runs: int = 0) -> bmc.DynamicBayesNet:
    """A count, and a computed node on the way to it."""
    dbn, own = template(runs)
    level(dbn, own)
    dbn.add("rate", lambda x: np.exp(0.5 * x), plates=own)
    dbn.add("y", lambda rate: bmc.Poisson(rate), plates=own)
    return dbn


def answered(runs: int = 0) -> bmc.DynamicBayesNet:
    """A yes or no."""
    dbn, own = template(runs)
    level(dbn, own)
    dbn.add("y", lambda x: bmc.Bernoulli(1 / (1 + np.exp(-2 * x))), plates=own)
    return dbn


def turning(runs: int = 0) -> bmc.DynamicBayesNet:
    """A heading near the cut of the circle, by a compass."""
    dbn, own = template(runs)
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(3.0, 0.3), plates=own)
    dbn.add("y", lambda x: bmc.WrappedNormal(x, 0.2), plates=own)
    return dbn


def compass(runs: int = 0) -> bmc.DynamicBayesNet:
    """As ``turning``, of another family, and from a start that leaves the whole circle open."""
    dbn, own = template(runs)
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(3.0, 2.0), plates=own)
    dbn.add("y", lambda x: bmc.VonMises(x, 20.0), plates=own)
    return dbn


def bearing(runs: int = 0) -> bmc.DynamicBayesNet:
    """A position by the direction in which it is seen, straight behind the observer."""
    dbn, own = template(runs)
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 0.5), plates=own)
    dbn.add("y", lambda x: bmc.WrappedNormal(np.arctan2(x, -2.0), 0.1), plates=own)
    return dbn


def cut(runs: int = 0) -> bmc.DynamicBayesNet:
    """A hidden finite node between two numbers."""
    dbn, own = template(runs)
    level(dbn, own)
    dbn.add("u", lambda x: bmc.Normal(x, 0.6), plates=own)
    dbn.add("z", lambda x: bmc.Bernoulli(1 / (1 + np.exp(-2 * x))), plates=own)
    dbn.add("v", lambda x, z: bmc.Normal(0.5 * x + 2.0 * z, 0.7), plates=own)
    dbn.add("y", lambda v: bmc.Normal(v, 0.4), plates=own)
    return dbn


def with_leaf(runs: int = 0) -> bmc.DynamicBayesNet:
    """Two sensors, one without moments."""
    dbn, own = template(runs)
    level(dbn, own)
    dbn.add("y", lambda x: bmc.Normal(x, 0.5), plates=own)
    dbn.add("w", lambda x: bmc.StudentT(1.0, x, 0.5), plates=own)
    return dbn


def sensors(runs: int = 0) -> bmc.DynamicBayesNet:
    """A level behind an offset, and three sensors in a plate, of which some fail."""
    dbn = bmc.DynamicBayesNet(plates={"s": 3, **({"run": runs} if runs else {})})
    own: Any = "run" if runs else ()
    level(dbn, own)
    dbn.add("y", lambda x: bmc.Normal(x, 0.5), plates=("s", "run") if runs else "s")
    return dbn


def relayed(runs: int = 0) -> bmc.DynamicBayesNet:
    """Three readings, of which some are lost, and a copy of each."""
    dbn = sensors(runs)
    own = ("s", "run") if runs else "s"
    dbn.add("w", lambda y: bmc.Normal(y, 0.8), plates=own)
    return dbn


def switched(runs: int = 0) -> bmc.DynamicBayesNet:
    dbn, own = template(runs)
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5], plates=own)
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(0.8 * x_prev + 3.0 * z, 0.5),
        initial=lambda z: bmc.Normal(3.0 * z, 1.0),
        plates=own,
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.4), plates=own)
    return dbn


GAP = np.nan
X_GRID = {"x": (-7.0, 7.0, 1500)}
TURN_GRID = {"x": (-10.0, 16.0, 2600)}
#: structure -> template, rows, the engine that is exact there
CASES: dict[str, tuple[Build, dict[str, Any], Any]] = {
    "linear": (linear, {"y": [0.3, 1.5, GAP, 2.0]}, bmc.KalmanFilter()),
    "sharp": (sharp, {"y": [0.3, 2.5, GAP, -1.0]}, bmc.KalmanFilter()),
    "bent": (bent, {"y": [0.3, 1.5, GAP, -1.0]}, bmc.GridFilter(grid=X_GRID)),
    "heavy tails": (heavy, {"y": [0.3, 4.0, GAP, -1.0]}, bmc.GridFilter(grid=X_GRID)),
    "counts": (counted, {"y": [1, 3, None, 0]}, bmc.GridFilter(grid=X_GRID)),
    "yes or no": (answered, {"y": [1, 1, None, 0]}, bmc.GridFilter(grid=X_GRID)),
    "turning": (turning, {"y": [3.1, -3.0, GAP, -2.8]}, bmc.GridFilter(grid=TURN_GRID)),
    "compass": (compass, {"y": [0.2, 0.4, GAP, 0.1]}, bmc.GridFilter(grid=TURN_GRID)),
    "bearing": (bearing, {"y": [3.1, -3.1, GAP, 3.0]}, bmc.GridFilter(grid=X_GRID)),
    "cut": (
        cut,
        {"u": [0.5, GAP, -0.3, 1.0], "y": [1.0, 0.2, GAP, 2.5]},
        bmc.GridFilter(grid={"x": (-6.0, 6.0, 120), "v": (-6.0, 8.0, 120)}),
    ),
    "a sensor without moments": (
        with_leaf,
        {"y": [0.2, 1.0, GAP, 0.4], "w": [GAP, GAP, 1.0, 2.0]},
        bmc.GridFilter(grid=X_GRID),
    ),
    "sensors that fail": (
        sensors,
        {"y": [[0.2, 1.0, GAP], [GAP, GAP, 0.3], [GAP, GAP, GAP], [1.0, 2.0, 1.5]]},
        bmc.KalmanFilter(),
    ),
    "readings that are lost": (
        relayed,
        {
            "y": [[0.2, 1.0, GAP], [GAP, GAP, 0.3], [GAP, GAP, GAP]],
            "w": [[0.2, 1.5, 0.8], [0.1, 1.0, 0.5], [-0.4, 1.0, GAP]],
        },
        bmc.KalmanFilter(),
    ),
    "switched": (switched, {"y": [0.3, 3.5, GAP, 5.0]}, bmc.Exact()),
}
#: cases in which thirty particles tell nothing
WILD = ("sharp", "bent", "compass")
#: filters side by side; where logs of estimates have a long tail, more, for their spread
RUNS = dict.fromkeys(CASES, session.scaled(400)) | {"switched": session.scaled(800)}


def side_by_side(rows: dict[str, Any], runs: int) -> dict[str, Any]:
    found = {}
    for name, value in rows.items():
        array = np.array(value, dtype=float)
        found[name] = np.repeat(array[..., None], runs, axis=-1)
        if name == "y" and all(v is None or isinstance(v, int) for v in value):
            filled = np.nan_to_num(found[name]).astype(int)
            found[name] = np.ma.masked_array(filled, mask=np.isnan(found[name]))
    return found


def evidence_of(case: str) -> float:
    build, rows, engine = CASES[case]
    if isinstance(engine, bmc.Exact):
        steps, dbn = len(rows["y"]), build()
        found = bmc.infer(dbn.unroll(steps), dbn.unrolled_evidence(rows), engine=engine)
        return float(found.log_marginal_likelihood)
    return float(bmc.filter(build(), rows, engine=engine).log_marginal_likelihood)


def estimates(case: str, particles: int, **options: Any) -> np.ndarray:
    """Log evidence of that many filters."""
    build, rows, _ = CASES[case]
    engine = bmc.ParticleFilter(particles, **options)
    found = bmc.filter(build(RUNS[case]), side_by_side(rows, RUNS[case]), engine=engine, rng=7)
    return found.log_marginal_likelihood


def deviation(found: np.ndarray, log_evidence: float) -> float:
    """Standard errors by which the mean of estimates over the evidence is off 1."""
    ratio = np.exp(found - log_evidence)
    return float((ratio.mean() - 1.0) / (ratio.std(ddof=1) / np.sqrt(len(ratio))))


OPTIONS: dict[str, dict[str, Any]] = {
    "optimal": {"proposal": "optimal"},
    "auxiliary": {"auxiliary": True},
    "both": {"proposal": "optimal", "auxiliary": True},
}


@pytest.mark.parametrize("case", CASES)
def test_the_evidence_is_unbiased(case: str) -> None:
    """Mean of Z-hat / Z within 4 standard errors of 1 (6e-5 each, 5e-3 for all 84)."""
    exact = evidence_of(case)
    for name, options in OPTIONS.items():
        for threshold in (0.5, 2.0):
            particles = 150 if case in WILD else 30
            found = estimates(case, particles, ess_threshold=threshold, **options)
            assert found.std() < 1.0, (name, threshold)
            assert abs(deviation(found, exact)) < 4, (name, threshold)


def test_a_wrong_density_of_the_draws_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same check fails where the density of what was drawn is off by a fifth."""

    def wrong(self: LookAhead, values: Any, belief: Any) -> np.ndarray:
        return REAL_DENSITY(self, values, belief) + 0.2

    monkeypatch.setattr(LookAhead, "log_density", wrong)
    assert abs(deviation(estimates("bent", 30, proposal="optimal"), evidence_of("bent"))) > 4


REAL_DENSITY = LookAhead.log_density


# ---- first stages -------------------------------------------------------------------------------


def test_the_fully_adapted_filter_has_even_weights() -> None:
    """First stage and proposal exact: weights say p(y | x_prev) / p(y | x_prev)."""
    rows = {"y": sharp().sample(30, 1, rng=0)["y"][0]}
    options: dict[str, Any] = {"auxiliary": True, "ess_threshold": 2.0}
    engine = bmc.ParticleFilter(500, proposal="optimal", **options)
    found = bmc.filter(sharp(), rows, engine=engine, rng=0, keep="particles")
    np.testing.assert_allclose(found.weight_ess, 500, rtol=1e-9)
    np.testing.assert_allclose(found.weights, 1 / 500, rtol=1e-6)
    exact = bmc.filter(sharp(), rows, engine=bmc.KalmanFilter())
    assert abs(found.log_marginal_likelihood - exact.log_marginal_likelihood) < 0.2
    plain = bmc.filter(sharp(), rows, engine=bmc.ParticleFilter(500, **options), rng=0)
    assert plain.weight_ess.min() < 100


def long_run(**options: Any) -> np.ndarray:
    """Errors of the log evidence of 50 filters over 50 slices with a sharp sensor."""
    rows = sharp().sample(50, 1, rng=11)["y"][0]
    exact = bmc.filter(sharp(), {"y": rows}, engine=bmc.KalmanFilter()).log_marginal_likelihood
    engine = bmc.ParticleFilter(1000, **options)
    repeated = {"y": np.repeat(rows[:, None], 50, axis=1)}
    return bmc.filter(sharp(50), repeated, engine=engine, rng=0).log_marginal_likelihood - exact


def test_a_first_stage_does_not_spoil_a_sharp_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """The density at the mean of what is hidden does: it is narrower than p(y | x_prev)."""
    bootstrap = long_run()
    auxiliary = long_run(auxiliary=True)
    adapted = long_run(auxiliary=True, proposal="optimal")
    assert auxiliary.std() < 1.4 * bootstrap.std()  # a ratio of variances of 50 draws each: 1e-2
    assert abs(auxiliary.mean()) < 5 * bootstrap.std()
    assert adapted.std() < 0.1 and abs(adapted.mean()) < 0.1

    def at_the_mean(self: LookAhead, state: Any) -> Any:
        belief = REAL_BELIEF(self, state)
        off = state.values["y"][:, None] - 0.9 * state.values["x_prev"].reshape(-1, 50, 1)
        return belief._replace(log_density=-0.5 * (off[..., 0].reshape(-1, 50) / 0.3) ** 2)

    monkeypatch.setattr(LookAhead, "believed", at_the_mean)
    monkeypatch.setattr("bayesmc.engines.particles.auxiliary._SHARE", 1e-12)
    assert long_run(auxiliary=True).mean() < -5


REAL_BELIEF = LookAhead.believed


def test_a_first_stage_does_not_spoil_the_growth_benchmark() -> None:
    """24 series of 80 slices: errors paired with those of the bootstrap filter."""
    dbn = bmc.DynamicBayesNet(plates={"run": 24})
    dbn.add(
        "x",
        lambda x_prev, t: bmc.Normal(
            0.5 * x_prev + 25 * x_prev / (1 + x_prev**2) + 8 * np.cos(1.2 * t), np.sqrt(10.0)
        ),
        initial=bmc.Normal(0.0, np.sqrt(5.0)),
        plates="run",
    )
    dbn.add("y", lambda x: bmc.Normal(x**2 / 20, 1.0), plates="run")
    drawn = dbn.sample(81, 1, rng=3)
    path, rows = drawn["x"][0], drawn["y"][0].copy()
    rows[0] = np.nan
    error = {}
    for name, options in ({"bootstrap": {}} | OPTIONS).items():
        found = bmc.filter(dbn, {"y": rows}, engine=bmc.ParticleFilter(500, **options), rng=0)
        error[name] = np.sqrt(((found.mean("x") - path)[1:] ** 2).mean(axis=0))
    assert 4.3 < error["bootstrap"].mean() < 5.1
    for name in OPTIONS:
        worse = error[name] - error["bootstrap"]
        # a guided filter is no worse: 4 standard errors (3e-5 each)
        assert worse.mean() < 4 * worse.std() / np.sqrt(len(worse)), name


def factors(dbn: bmc.DynamicBayesNet, rows: dict[str, Any], t: int, particles: int) -> Any:
    """First-stage factors of slice ``t`` from a run up to the slice before, and that slice's particles."""
    engine = bmc.ParticleFilter(particles)
    filtered = bmc.filter(dbn, rows, engine=engine, rng=0, keep="particles")
    problem = pose_series(dbn, rows)
    plan = engine.step_of(problem.slices, {}).plan
    before = {n + "_prev": filtered.clouds[t - 1].values[n] for n in problem.slices.interface}
    stage = PluggedIn(plan, particles)
    return stage(before, problem.series.row(t), np.random.default_rng(0)), before


def test_the_first_stage_is_the_density_of_the_row_given_the_slice_before() -> None:
    """Finite nodes summed over, numbers integrated out, sensors that fail left out."""
    log, before = factors(switched(), {"y": [0.3, 3.5]}, 1, 50)
    rows = np.array([[0.8, 0.2], [0.3, 0.7]])[before["z_prev"]]
    by_state = stats.norm.pdf(
        3.5, 0.8 * before["x_prev"][:, None] + [0.0, 3.0], np.sqrt(0.5**2 + 0.4**2)
    )
    np.testing.assert_allclose(log, np.log((rows * by_state).sum(axis=1)), rtol=1e-7)
    log, before = factors(sensors(), {"y": [[0.2, 1.0, 0.1], [GAP, 1.5, 0.3]]}, 1, 50)
    mean, cov = 0.8 * before["x_prev"], 0.81 * np.ones((2, 2)) + 0.25 * np.eye(2)
    wanted = [stats.multivariate_normal([m, m], cov).logpdf([1.5, 0.3]) for m in mean]
    np.testing.assert_allclose(log, wanted, rtol=1e-7)


def test_a_first_stage_draws_lost_readings_that_others_depend_on() -> None:
    """An estimate: on average over 4000 particles right to 5 %, some 5 standard errors."""
    rows = {"y": [[0.2, 1.0, GAP], [GAP, 1.5, 0.3]], "w": [[0.2, 1.5, 0.8], [2.5, 1.0, 0.5]]}
    log, before = factors(relayed(), rows, 1, 4000)
    own = np.diag([0.25 + 0.64, 0.25, 0.25])
    law = stats.multivariate_normal(np.zeros(3), 0.81 + own)
    off = np.array([2.5, 1.5, 0.3]) - 0.8 * before["x_prev"][:, None]
    copies = stats.norm.pdf([1.0, 0.5], [1.5, 0.3], 0.8).prod()
    assert np.exp(log).mean() == pytest.approx(law.pdf(off).mean() * copies, rel=0.05)


def test_an_estimated_first_stage_rules_nothing_out() -> None:
    """No factor is below a tenth of their mean, so weights are bounded by ten times those without."""
    log, _ = factors(heavy(), {"y": [0.0, 40.0]}, 1, 200)
    assert log.min() > np.log(0.0999 * np.exp(log).mean())
    log, _ = factors(linear(), {"y": [0.0, 40.0]}, 1, 200)
    assert log.min() < np.log(0.0999 * np.exp(log).mean())  # an exact one may


@pytest.mark.parametrize("auxiliary", [True, lambda x_prev, y: -0.3 * (y - x_prev) ** 2])
def test_first_stages_where_the_slice_before_is_seen(auxiliary: Any) -> None:
    engine = bmc.ParticleFilter(4000, auxiliary=auxiliary, ess_threshold=2.0)
    rows = {"x": [1.0, None, None], "y": [1.0, 2.0, 0.5]}
    found = bmc.filter(linear(), rows, engine=engine, rng=0)
    exact = bmc.filter(linear(), rows, engine=bmc.KalmanFilter())
    assert abs(found.log_marginal_likelihood - exact.log_marginal_likelihood) < 0.1
    np.testing.assert_allclose(found.mean("x"), exact.mean("x"), atol=0.06)


def test_first_stages_where_nothing_is_carried() -> None:
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add("x", bmc.Normal(0.0, 1.0), plates="k")
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="k")
    for auxiliary in (True, lambda y: -(y**2)):
        engine = bmc.ParticleFilter(4000, auxiliary=auxiliary, ess_threshold=2.0)
        found = bmc.filter(dbn, {"y": [[1.0, 0.0], [2.0, 1.0]]}, engine=engine, rng=0)
        np.testing.assert_allclose(found.mean("x")[1], [1.0, 0.5], atol=0.06)


def test_a_first_stage_returns_one_factor_per_particle() -> None:
    engine = bmc.ParticleFilter(9, auxiliary=lambda x_prev: 0.0, ess_threshold=2.0)
    with pytest.raises(ModelError, match=r"returns shape \(\) in slice 1.*shape \(9,\)"):
        bmc.filter(linear(), {"y": [0.0, 1.0]}, engine=engine, rng=0)


# ---- the proposal derived from the densities ----------------------------------------------------


def test_the_optimal_proposal_leaves_weights_of_one_ancestor_even() -> None:
    """Where it is exact the weight is p(y | x before), whatever was drawn."""
    engine = bmc.ParticleFilter(200, proposal="optimal")
    found = bmc.filter(linear(), {"y": [0.7]}, engine=engine, rng=0)
    assert found.weight_ess[0] == pytest.approx(200)
    assert found.log_marginal_likelihood == pytest.approx(
        float(bmc.Normal(0.0, np.sqrt(1.49)).log_prob(0.7))
    )


def crossed(bend: float = 0.0) -> bmc.DynamicBayesNet:
    """Two plates apart, named in another order by other nodes, and sensors in a third."""
    slope, scale = np.array([[0.5], [0.9]]), np.array([0.3, 0.6, 1.0])
    dbn = bmc.DynamicBayesNet(plates={"a": 2, "b": 3, "s": 2})
    dbn.add(
        "x",
        lambda x_prev: bmc.Normal(slope * x_prev, scale),
        initial=bmc.Normal(3.0 * slope, scale),
        plates=("a", "b"),
    )
    dbn.add("m", lambda x: bmc.Normal(x, 0.4), plates=("b", "a"))
    if bend:
        dbn.add("y", lambda m: bmc.Normal(m + bend * np.sin(2 * m), 0.5), plates=("b", "a"))
    else:
        dbn.add("y", lambda m: bmc.Normal(m, 0.5), plates=("b", "a"))
    dbn.add("w", lambda x: bmc.Normal(2.0 * x, 0.8), plates=("s", "b", "a"))
    return dbn


def crossed_rows(bend: float = 0.0) -> dict[str, np.ndarray]:
    drawn = crossed(bend).sample(3, 1, rng=0)
    rows = {"y": drawn["y"][0], "w": drawn["w"][0].copy()}
    rows["w"][1, 0, 2, 1] = np.nan
    return rows


def test_guarded_plates_apart_keep_their_elements() -> None:
    """Against 100,000 particles that look at nothing: 0.03 and 0.05 are some 4 standard errors."""
    rows = crossed_rows(0.5)
    engine = bmc.ParticleFilter(5000, proposal="optimal", auxiliary=True)
    found = bmc.filter(crossed(0.5), rows, engine=engine, rng=0)
    plain = bmc.filter(crossed(0.5), rows, engine=bmc.ParticleFilter(100_000), rng=1)
    np.testing.assert_allclose(
        found.log_marginal_increments, plain.log_marginal_increments, atol=0.05
    )
    np.testing.assert_allclose(found.mean("m"), plain.mean("m"), atol=0.03)


def test_plates_apart_keep_their_elements() -> None:
    """Six filters, exact in slice 0; weights of the fully adapted filter are even in all slices."""
    rows = crossed_rows()
    exact = bmc.filter(crossed(), rows, engine=bmc.KalmanFilter())
    engine = bmc.ParticleFilter(4000, proposal="optimal", auxiliary=True, ess_threshold=2.0)
    found = bmc.filter(crossed(), rows, engine=engine, rng=0)
    assert found.log_marginal_increments.shape == (3, 2, 3)
    np.testing.assert_allclose(
        found.log_marginal_increments[0], exact.log_marginal_increments[0], rtol=1e-9
    )
    np.testing.assert_allclose(
        found.log_marginal_increments, exact.log_marginal_increments, atol=0.05
    )
    np.testing.assert_allclose(found.weight_ess, 4000, rtol=1e-9)
    np.testing.assert_allclose(found.mean("x"), exact.mean("x"), atol=0.06)


def vectors(counts: bool = True) -> bmc.DynamicBayesNet:
    """Vectors, two hidden nodes in a row, a computed one, a plate of readings, counts."""
    dbn = bmc.DynamicBayesNet(plates={"s": 2})
    still = bmc.MvNormal(np.zeros(2), np.eye(2))
    dbn.add("v", lambda v_prev: bmc.MvNormal(0.9 * v_prev, 0.3 * np.eye(2)), initial=still)
    dbn.add(
        "p", lambda p_prev, v: bmc.Normal(p_prev + v[..., 0], 0.2), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("q", lambda p, v: p + v[..., 1])
    dbn.add("y", lambda q: bmc.Normal(q, 0.1), plates="s")
    if counts:
        dbn.add("c", lambda v: bmc.Poisson(np.exp(0.5 * v[..., 0])))
    return dbn


def vector_rows() -> dict[str, np.ndarray]:
    drawn = vectors().sample(12, 1, rng=0)
    return {"y": drawn["y"][0], "c": drawn["c"][0]}


@functools.cache
def evidence_by_many() -> float:
    engine = bmc.ParticleFilter(30_000)
    return float(bmc.filter(vectors(), vector_rows(), engine=engine, rng=1).log_marginal_likelihood)


@pytest.mark.parametrize("auxiliary", [False, True])
def test_the_optimal_proposal_of_a_nonlinear_block(auxiliary: bool) -> None:
    """Of the same evidence as 100 times the particles of the bootstrap filter, with far less spread.

    The mean of ten lies within 0.6, which is three of its standard errors at the spread allowed.
    """
    rows = vector_rows()
    engine = bmc.ParticleFilter(300, proposal="optimal", auxiliary=auxiliary)
    found = [
        bmc.filter(vectors(), rows, engine=engine, rng=k).log_marginal_likelihood for k in range(10)
    ]
    assert np.std(found) < 0.6
    assert abs(np.mean(found) - evidence_by_many()) < 0.6


def test_vectors_that_are_affine_are_drawn_exactly() -> None:
    """Without the count the fully adapted filter has even weights, and the Kalman filter's evidence."""
    drawn = vectors(counts=False).sample(6, 1, rng=0)
    rows = {"y": drawn["y"][0]}
    engine = bmc.ParticleFilter(3000, proposal="optimal", auxiliary=True, ess_threshold=2.0)
    found = bmc.filter(vectors(counts=False), rows, engine=engine, rng=0)
    exact = bmc.filter(vectors(counts=False), rows, engine=bmc.KalmanFilter())
    np.testing.assert_allclose(found.weight_ess, 3000, rtol=1e-6)
    assert abs(found.log_marginal_likelihood - exact.log_marginal_likelihood) < 0.2


def test_a_bend_that_is_wide_beside_the_noise_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """30 slices: means linearised again and a guard keep the evidence, one tangent alone does not."""
    rows = {"y": bent().sample(30, 1, rng=2)["y"][0]}
    grid = bmc.GridFilter(grid=X_GRID)
    exact = bmc.filter(bent(), rows, engine=grid).log_marginal_likelihood
    engine = bmc.ParticleFilter(2000, proposal="optimal")
    guarded = bmc.filter(bent(), rows, engine=engine, rng=0)
    assert abs(guarded.log_marginal_likelihood - exact) < 0.5
    monkeypatch.setattr(linearisation, "_TURNS", 1)
    monkeypatch.setattr(guarding, "SHARE", 1e-12)
    assert bmc.filter(bent(), rows, engine=engine, rng=0).log_marginal_likelihood < exact - 1


ANGLES = {
    "turning": ({"y": [-3.1]}, TURN_GRID),
    "bearing": ({"y": [-3.0]}, X_GRID),
}


@pytest.mark.parametrize("case", ANGLES)
def test_angles_are_taken_the_short_way_round(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Means to 0.02 (some 5 standard errors), and draws that are nearly all of use.

    The bearing is read across the cut of the circle at the very mean, so its slope is wrapped, too.
    """
    rows, grid = ANGLES[case]
    engine = bmc.ParticleFilter(5000, proposal="optimal")
    build = CASES[case][0]
    found = bmc.filter(build(), rows, engine=engine, rng=0)
    exact = bmc.filter(build(), rows, engine=bmc.GridFilter(grid=grid))
    assert abs(found.mean("x")[0] - exact.mean("x")[0]) < 0.02
    assert abs(found.log_marginal_likelihood - exact.log_marginal_likelihood) < 0.03
    assert found.weight_ess[0] > 0.85 * 5000
    monkeypatch.setattr(linearisation, "wrap_angle", lambda x: x)
    assert bmc.filter(build(), rows, engine=engine, rng=0).weight_ess[0] < 0.5 * 5000


def test_an_angle_that_may_be_anywhere_moves_nothing() -> None:
    """A Gaussian has one mode: where the circle is open, the belief stays and the density is wrapped."""
    wanted = {turning: (1 / (1 / 0.09 + 1 / 0.04), 0.13), compass: (4.0, 4.0513)}
    for build, (var, total) in wanted.items():
        model = pose_series(build(), {"y": [0.2]}).slices.first
        look = LookAhead(model, ["x"], {"y": None}, ["x", "y"], ())
        state = Pass(np.random.default_rng(0), (1,), {"y": np.array(3.5 - 2 * np.pi)})
        belief = look.believed(state)
        assert belief.cov.item() == pytest.approx(var)
        density = bmc.WrappedNormal(3.0, np.sqrt(total)).log_prob(3.5)
        assert belief.log_density.item() == pytest.approx(float(density), rel=1e-4)
        mean = 3.0 if build is compass else 3.0 + 0.5 * 0.09 / 0.13
        assert belief.mean.item() == pytest.approx(mean)


def test_sensors_that_are_missing_are_drawn_from_their_own_densities() -> None:
    """Standard deviations to 3 %, some 5 standard errors; a Cauchy sensor has quartiles only."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    dbn.add("w", lambda x: bmc.Normal(x**3, 0.1))
    dbn.add("c", lambda x: bmc.StudentT(1.0, x, 2.0))
    engine = bmc.ParticleFilter(20_000, proposal="optimal")
    rows = {"y": [1.0, 0.5], "w": [None, 0.1], "c": [None, 0.3]}
    found = bmc.filter(dbn, rows, engine=engine, rng=0, keep="particles")
    x = np.random.default_rng(0).normal(0.8, np.sqrt(0.2), 1_000_000)
    assert found.std("w")[0] == pytest.approx(float((x**3).std()), rel=0.03)
    off = found.particles("c")[0] - found.particles("x")[0]
    assert np.percentile(off, 75) - np.percentile(off, 25) == pytest.approx(4.0, rel=0.08)


def grouped(dbn: bmc.DynamicBayesNet, rows: dict[str, Any]) -> list[tuple[Any, Any]]:
    problem = pose_series(dbn, rows)
    model, row = problem.slices.later, problem.series.row(1)
    order = order_of(model, problem.slices)
    found = groups_of(model, order, row.seen, lambda n: has_moments(model, n))
    taken = [n for g in found for n in (*g.before, *g.after)]
    assert sorted(taken) == sorted(problem.slices.dynamic)
    for k, name in enumerate(taken):
        above = [
            p for p in model[name].parents if p in problem.slices.dynamic and p not in row.seen
        ]
        assert set(above) <= set(taken[:k])
    return [(g.block, g.seen) for g in found]


def test_slices_are_cut_at_hidden_finite_nodes() -> None:
    both = {"u": [0.1, 0.2], "y": [0.1, 0.2]}
    assert grouped(cut(), both) == [(("x",), ("u",)), (("v",), ("y",))]
    gap = {"u": [0.1, None], "y": [0.1, 0.2]}
    assert grouped(cut(), gap) == [((), ()), (("v",), ("y",))]
    known = {"u": [0.1, None], "z": [1, 1], "y": [0.1, 0.2]}
    assert grouped(cut(), known) == [(("x", "v"), ("z", "y"))]
    missing = {"y": [0.1, 0.2], "w": [0.1, None]}
    assert grouped(with_leaf(), missing) == [(("x",), ("y",)), ((), ())]
    assert grouped(with_leaf(), {"y": [0.1, None], "w": [0.1, 0.2]}) == [((), ())]


def test_affine_blocks_are_told_from_others() -> None:
    rows = {"y": [0.1, 0.2]}
    told = {}
    for build in (linear, bent, turning, switched):
        problem = pose_series(build(), rows)
        model, row = problem.slices.later, problem.series.row(1)
        order = order_of(model, problem.slices)
        (group,) = groups_of(model, order, row.seen, lambda n: n == "y")
        told[build] = is_affine(model, group)
    assert told == {linear: True, bent: False, turning: False, switched: True}


def test_guards_bound_the_weights() -> None:
    """No weight is more than ten times that of the bootstrap filter, far from any tangent."""
    problem = pose_series(bent(), {"y": [1.3]})
    engine = bmc.ParticleFilter(5000, proposal="optimal")
    made_by = engine.step_of(problem.slices, {})
    row = problem.series.row(0)
    assert any(isinstance(step, Guarded) for step in made_by.plan.steps(row))
    found = made_by(None, row, np.random.default_rng(0))
    density = stats.norm.logpdf(1.3, found.values["x"] + 0.4 * np.sin(2 * found.values["x"]), 0.2)
    assert (found.log_weights <= density + np.log(10.0) + 1e-9).all()


def test_families_without_a_variance_are_left_to_themselves() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.StudentT(1.0, x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.warns(ProposalWarning, match="'x': StudentT has no mean and variance to go by"):
        bmc.filter(dbn, {"y": [0.0, 0.1]}, engine=bmc.ParticleFilter(99, proposal="optimal"), rng=0)
    with pytest.raises(ValueError, match='give "optimal", or a dict'):
        bmc.ParticleFilter(9, proposal="best")
    dbn = linear()
    dbn.add("never", lambda x: bmc.StudentT(1.0, x, 1.0))  # drawn from its own density
    bmc.filter(dbn, {"y": [0.0]}, engine=bmc.ParticleFilter(9, proposal="optimal"), rng=0)


# ---- slice 0 ------------------------------------------------------------------------------------


def wide(runs: int = 0) -> bmc.DynamicBayesNet:
    """A start that the first row narrows a great deal."""
    dbn, own = template(runs)
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.5), initial=bmc.Normal(0.0, 20.0), plates=own)
    dbn.add("y", lambda x: bmc.Normal(x, 0.5), plates=own)
    return dbn


LOOKED: dict[str, Any] = {"x": lambda y: bmc.Normal(y, 0.7)}
GIVEN: dict[str, Any] = {"x": lambda x_prev, y: bmc.Normal(0.5 * (x_prev + y), 0.6)}


@pytest.mark.parametrize("proposal", [None, GIVEN], ids=["later ones as they are", "both"])
def test_a_proposal_for_the_start_is_weighed_and_finds_more(proposal: Any) -> None:
    rows = {"y": np.array([30.0, 30.4, 29.8])}
    exact = bmc.filter(wide(), rows, engine=bmc.KalmanFilter()).log_marginal_likelihood
    together = {"y": np.repeat(rows["y"][:, None], 2_000, axis=1)}
    engine = bmc.ParticleFilter(50, initial_proposal=LOOKED, proposal=proposal)
    found = bmc.filter(wide(2_000), together, engine=engine, rng=0)
    ratio = np.exp(found.log_marginal_likelihood - exact)
    # mean of Z-hat / Z is 1 within 4 standard errors (alpha 6e-5 each)
    assert abs(ratio.mean() - 1.0) < 4 * ratio.std(ddof=1) / np.sqrt(len(ratio))
    plain = bmc.filter(wide(), rows, engine=bmc.ParticleFilter(50), rng=0)
    assert np.mean(found.weight_ess[0]) > 5 * plain.weight_ess[0]


def test_a_proposal_for_the_start_stays_there(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def looked(y: Any, t: Any) -> bmc.Distribution:
        asked.append(int(t))
        return bmc.Normal(y, 0.7)

    rows = {"y": np.array([30.0, 30.4, 29.8])}
    engine = bmc.ParticleFilter(100, initial_proposal={"x": looked})
    bmc.filter(wide(), rows, engine=engine, rng=0)
    assert set(asked) == {0}
    # it comes before one for all slices
    both = bmc.ParticleFilter(100, initial_proposal={"x": looked}, proposal=LOOKED)
    bmc.filter(wide(), rows, engine=both, rng=0)
    assert set(asked) == {0}
    # and is not used where what it looks at is missing
    asked.clear()
    missing = {"y": np.ma.masked_invalid([np.nan, 30.4, 29.8])}
    bmc.filter(wide(), missing, engine=engine, rng=0)
    assert not asked


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"proposal": "optimal", "initial_proposal": LOOKED}, ValueError, "slice 0 too"),
        ({"initial_proposal": "optimal"}, TypeError, "dict from node name"),
        ({"initial_proposal": {"q": bmc.Normal(0.0, 1.0)}}, Exception, "'q'"),
        ({"initial_proposal": GIVEN}, ModelError, "x_prev"),
        ({"initial_proposal": {"y": bmc.Normal(0.0, 1.0)}}, ModelError, "observed in every slice"),
    ],
)
def test_wrong_proposals_for_the_start_are_named(options: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        bmc.filter(wide(), {"y": [1.0]}, engine=bmc.ParticleFilter(10, **options), rng=0)


def test_a_case_without_a_share_counts_for_nothing() -> None:
    """It explains nothing of the row, and its covariance may be no number either."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    model = pose_series(dbn, {"y": [0.0]}).slices.first
    look = LookAhead(model, ["x"], {"y": np.zeros(())}, ["x", "y"], (), True)
    mean = np.zeros((4, 1))
    good, bad = (Belief(mean, np.full((4, 1, 1), v), np.zeros(4)) for v in (2.0, np.nan))
    shares = np.array([[0.0] * 4, [-np.inf] * 4])
    found = ByCase([look, look]).log_density(
        {"x": np.arange(4.0)}, Cases((good, bad), shares, np.zeros(4))
    )
    assert found == pytest.approx(stats.norm(0.0, np.sqrt(2.0)).logpdf(np.arange(4.0)))
