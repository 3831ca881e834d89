"""``ParticleFilter(marginalize=)`` against Kalman filters, exact conditioning and a loop over particles.

Comparisons that chance has a part in have a false-alarm rate of 1e-3 or less, at fixed seeds.
"""

from __future__ import annotations

import copy
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.marginal.reading import SliceReader
from bayesmc.errors import (
    BudgetError,
    DegeneracyError,
    LowEssWarning,
    QueryError,
    UnsupportedError,
)
from bayesmc.testing import exact, repeated_test, session
from bayesmc.testing.makers.linear_dbns import random_linear_dbn
from bayesmc.testing.makers.switching_dbns import random_switching_dbn
from tests.engines.test_switching import read, rows_of, template

AUTO = bmc.ParticleFilter(3, marginalize="auto")


def off(found: Any, wanted: Any) -> float:
    """Largest difference, relative where numbers are above 1."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    return float((np.abs(found - wanted) / (1 + np.abs(wanted))).max(initial=0.0))


def switching() -> bmc.DynamicBayesNet:
    """A level that is driven, and shaken, by a regime."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(0.9 * x_prev + s, np.where(s == 1, 2.0, 0.3)),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def volatile() -> bmc.DynamicBayesNet:
    """A level seen through noise whose size walks."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("h", lambda h_prev: bmc.Normal(0.9 * h_prev, 0.4), initial=bmc.Normal(0.0, 1.0))
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, h: bmc.Normal(x, np.exp(h / 2)))
    return dbn


ROWS = {"y": [0.3, 1.2, 3.0, 2.5, np.nan, 1.0]}


# ---- where nothing is sampled -------------------------------------------------------------------


def test_without_sampled_nodes_every_particle_is_the_kalman_filter() -> None:
    """Plates apart, vectors, lags, inputs, values missing in part: all to rounding."""
    asked = 0
    for seed in range(session.scaled(25, 4)):
        case = random_linear_dbn(seed)
        given: dict[str, Any] = {"inputs": case.inputs or None}
        right = bmc.filter(case.dbn, case.observations, engine=bmc.KalmanFilter(), **given)
        found = bmc.filter(case.dbn, case.observations, engine=AUTO, keep="particles", **given)
        assert off(found.log_marginal_increments, right.log_marginal_increments) < 1e-9, seed
        hidden = [n for n in case.hidden if n in right.names]
        for name in hidden:
            assert off(found.mean(name), right.mean(name)) < 1e-9, (seed, name)
            assert off(found.var(name), right.var(name)) < 1e-9, (seed, name)
            levels = [0.1, 0.6]
            assert off(found.quantile(name, levels), right.quantile(name, levels)) < 1e-6
        try:
            assert (
                off(np.squeeze(found.cov(*hidden[:2])), np.squeeze(right.cov(*hidden[:2]))) < 1e-9
            )
            asked += 1
        except QueryError:  # plates that are filtered separately
            continue
    assert asked > 3


def test_rows_one_by_one_are_those_of_the_kalman_filter_through_a_pickle_too() -> None:
    for seed in range(session.scaled(12, 4)):
        case = random_linear_dbn(seed)
        fixed = {n: v for n, v in case.observations.items() if n in case.dbn.static_nodes}
        moving = {n: v for n, v in case.observations.items() if n not in fixed}
        inputs = case.inputs or {}
        right = bmc.filter(
            case.dbn, case.observations, inputs=inputs or None, engine=bmc.KalmanFilter()
        )
        belief = AUTO.start(case.dbn, static=fixed, rng=0)
        for t in range(right.steps):
            row = {n: np.asarray(v)[t] for n, v in moving.items()}
            belief = AUTO.step(
                belief, row, inputs={n: np.asarray(v)[t] for n, v in inputs.items()} or None
            )
            if t == 1:
                belief = AUTO.start(case.dbn, belief=pickle.loads(pickle.dumps(belief)))
            for name in case.hidden:
                if name in right.names:
                    assert off(belief.mean(name), right.mean(name)[t]) < 1e-9, (seed, name, t)
                    assert off(belief.var(name), right.var(name)[t]) < 1e-9, (seed, name, t)


# ---- against exact answers ----------------------------------------------------------------------


@pytest.mark.parametrize("proposal", [None, "optimal"])
def test_marginals_are_exact_ones_under_holm(proposal: str | None) -> None:
    """Filtered figures of the last slice times estimated over exact evidence, which have no bias."""
    engine = bmc.ParticleFilter(200, marginalize="auto", proposal=proposal)
    asked = 0
    for seed in range(30, 30 + session.scaled(2, 12)):
        case = random_switching_dbn(seed)
        try:
            right = exact(case.dbn, case.observations, case.inputs or None)
        except (UnsupportedError, BudgetError):
            continue
        log = right.log_marginal_likelihood - right.log_static
        finite = {n for n in case.hidden if case.dbn[n].is_discrete}

        def figures(
            answer: Any, finite: set[str] = finite, names: Any = case.hidden
        ) -> dict[str, Any]:
            of = {n: answer.probabilities if n in finite else answer.mean for n in names}
            return {n: figure(n)[-1] for n, figure in of.items()}

        def estimate(rng: np.random.Generator, case: Any = case, log: Any = log) -> dict[str, Any]:
            given: dict[str, Any] = {"inputs": case.inputs or None, "engine": engine, "rng": rng}
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LowEssWarning)
                found = bmc.filter(case.dbn, case.observations, **given)
            ratio = np.exp(np.sum(found.log_marginal_likelihood) - log)
            return {n: ratio * f for n, f in figures(found).items()}

        truth = {n: np.asarray(f) for n, f in figures(right).items()}
        verdict = repeated_test(estimate, truth, replications=40, alpha=1e-3, rng=[seed, 1])
        assert verdict, (seed, verdict)
        asked += 1
    assert asked >= session.scaled(2, 4)


def test_covariances_that_particles_share_are_those_of_a_loop_over_particles() -> None:
    """A particle's regimes are read off; a filter along these gives its mean and variance."""
    engine = bmc.ParticleFilter(40, marginalize="auto", ess_threshold=0.0)
    found = bmc.filter(switching(), ROWS, engine=engine, rng=3, keep="particles")
    paths = found.particles("s")
    assert found.clouds is not None
    inner = found.clouds[-1].inner
    mean, variance = np.zeros(40), np.ones(40)
    log = np.zeros(40)
    for t, y in enumerate(ROWS["y"]):
        s = paths[t]
        if t:
            mean, variance = 0.9 * mean + s, 0.81 * variance + np.where(s == 1, 4.0, 0.09)
        if not np.isnan(y):
            total = variance + 0.25
            log += -0.5 * (y - mean) ** 2 / total - 0.5 * np.log(2 * np.pi * total)
            mean, variance = mean + variance / total * (y - mean), variance * 0.25 / total
    node = found.model["x"]
    np.testing.assert_allclose(inner.mean_of(node), mean, rtol=1e-10)
    np.testing.assert_allclose(inner.variance_of(node), variance, rtol=1e-10)
    np.testing.assert_allclose(found.clouds[-1].log_weights, log, rtol=1e-10)
    assert len(inner.factors) < 40  # some have the same history of regimes


def test_scales_that_every_particle_has_of_its_own_and_offsets_that_it_has() -> None:
    """By a volatility each filter has its variance; by an offset all share one."""
    found = bmc.filter(
        volatile(), ROWS, engine=bmc.ParticleFilter(50, marginalize="auto"), rng=1, keep="particles"
    )
    assert found.clouds is not None and len(found.clouds[3].inner.factors) > 20
    dbn = bmc.DynamicBayesNet()
    dbn.add("u", lambda u_prev: bmc.StudentT(4.0, u_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add("x", lambda x_prev, u: bmc.Normal(0.9 * x_prev + u, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    engine = bmc.ParticleFilter(50, marginalize="auto")
    found = bmc.filter(dbn, ROWS, engine=engine, rng=1, keep="particles")
    assert found.clouds is not None
    assert [len(p.inner.factors) for p in found.clouds] == [1] * 6


def test_integrating_out_leaves_less_to_chance() -> None:
    """Spreads of the log evidence of 30 runs: a ratio of variances below 1/2 is beyond an F law's 1e-3."""
    logs = {}
    for asked in (None, "auto"):
        engine = bmc.ParticleFilter(200, marginalize=asked)
        logs[asked] = [
            bmc.filter(switching(), ROWS, engine=engine, rng=r).log_marginal_likelihood
            for r in range(30)
        ]
    assert np.std(logs["auto"]) < 0.6 * np.std(logs[None])


def test_published_model_of_gnp(reference_data: Path) -> None:
    """Kim (1994): noise that is none, spreads of 50, 200 and 1,000 particles, and the mean of the last."""
    held = read(reference_data, "kim1994")
    dbn, rows, burn = template(held["model"]), rows_of(held["y"]), held["burn"]
    for particles, runs, spread in ((50, 15, 0.5), (200, 10, 0.24), (1000, 7, 0.09)):
        engine = bmc.ParticleFilter(particles, marginalize="auto", proposal="optimal")
        logs = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            for run in range(runs):
                found = bmc.filter(dbn, rows, engine=engine, rng=run)
                logs.append(found.log_marginal_increments[1 + burn :].sum())
        assert np.std(logs, ddof=1) <= spread, particles
    error = np.std(logs, ddof=1) / np.sqrt(len(logs))
    assert abs(np.mean(logs) - held["rbpf_loglik_mean"]) < 3 * error + 0.02  # by 0.014 off itself


# ---- what is integrated out ---------------------------------------------------------------------


def told(dbn: bmc.DynamicBayesNet, rows: Any, engine: bmc.ParticleFilter) -> dict[str, str]:
    return dict(bmc.explain(dbn, rows, engine=engine).nodes)


def test_what_breaks_linearity_is_sampled_and_said_to_be() -> None:
    nodes = told(volatile(), ROWS, AUTO)
    assert nodes["x"] == "integrated out, a Kalman filter for each particle"
    assert "not integrated out: node 'y' has a scale that depends on" in nodes["h"]
    assert "predictive density" in nodes["y"]
    engine = bmc.ParticleFilter(10, marginalize="auto", proposal="optimal")
    assert told(switching(), ROWS, engine)["s"] == "sampled given the slice before and the row"


def test_why_nothing_is_integrated_out_is_said_too() -> None:
    """A nonlinear state that the linear one drives (Schon, Gustafsson and Nordlund 2005)."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "n",
        lambda n_prev, l_prev: bmc.Normal(np.arctan(n_prev) + l_prev, 0.3),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("l", lambda l_prev: bmc.Normal(0.9 * l_prev, 0.2), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda n: bmc.Normal(0.1 * n**2, 0.3))
    nodes = told(dbn, {"y": [0.1, 0.2]}, AUTO)
    assert "'n', which is sampled, depends on it" in nodes["l"]
    assert "not known to be affine in" in nodes["n"]


def test_the_fewest_numbers_are_sampled() -> None:
    """A gain times three numbers: the gain is sampled, and what it follows; a count takes what it reads."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("b", lambda b_prev: bmc.Normal(b_prev, 0.1), initial=bmc.Normal(0.0, 1.0))
    dbn.add("a", lambda a_prev, b: bmc.Normal(a_prev + b, 0.1), initial=bmc.Normal(1.0, 0.1))
    start = bmc.MvNormal(np.zeros(3), np.eye(3))
    dbn.add(
        "x",
        lambda x_prev, a: bmc.MvNormal(np.asarray(a)[..., None] * x_prev, np.eye(3)),
        initial=start,
    )
    dbn.add("y", lambda x: bmc.Normal(x[..., 0], 1.0))
    nodes = told(dbn, {"y": [0.0, 1.0]}, AUTO)
    assert "integrated out, a" in nodes["x"]
    assert "'a', which is sampled, depends on it" in nodes["b"]
    dbn.add("k", lambda x: bmc.Poisson(np.exp(x[..., 1])))
    nodes = told(dbn, {"y": [0.0, 1.0], "k": [1, 2]}, AUTO)
    assert all("integrated out, a" not in how for how in nodes.values())


def test_computed_nodes_carry_what_they_are_computed_from() -> None:
    """A lag of what is integrated out is integrated out with it; one that is bent is not."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("b", bmc.Normal(0.0, 1.0))
    dbn.add(
        "x",
        lambda x_prev, l_prev, s: bmc.Normal(1.1 * x_prev - 0.5 * l_prev + s, 0.5),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("l", lambda x_prev: x_prev, initial=lambda b: b)
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    rows = {"y": [0.3, 1.2, 0.1]}
    right = exact(dbn, rows)
    engine = bmc.ParticleFilter(4000, marginalize="auto")
    found = bmc.filter(dbn, rows, engine=engine, rng=0)
    assert "integrated out, a" in told(dbn, rows, engine)["x"]
    for name in ("x", "l", "b"):
        gap = np.abs(found.mean(name)[-1] - right.mean(name)[-1])
        assert gap < 4 * found.mcse(name)[-1] + 1e-9, name
    dbn.add("m", lambda x: np.abs(x))
    assert "integrated out, a" not in told(dbn, rows, engine)["x"]


def test_names_say_what_is_integrated_out() -> None:
    dbn = volatile()
    assert bmc.ParticleFilter(5, marginalize="x").unsupported(dbn, ROWS) is None
    assert bmc.ParticleFilter(5, marginalize=["x"]).marginalize == ("x",)
    for names, what in (
        (["h"], "node 'y' has a scale that depends on the continuous node 'h'"),
        (["h", "x"], "scale that depends on"),
        (["y"], "'y', and that node is not hidden"),
        (["z"], "names 'z', which is no node of a slice"),
    ):
        reason = bmc.ParticleFilter(5, marginalize=names).unsupported(dbn, {"y": [0.3, 1.2]})
        assert reason is not None and what in reason, (names, reason)
    reason = bmc.ParticleFilter(5, marginalize=["s"]).unsupported(switching(), ROWS)
    assert reason is not None and "'x', which is sampled, depends on it" in reason


def test_what_a_sampled_node_depends_on_is_not_integrated_out() -> None:
    """A regime that looks at the level."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "s",
        lambda x_prev: bmc.Bernoulli(1 / (1 + np.exp(-x_prev))),
        initial=bmc.Bernoulli(0.5),
    )
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    assert (
        "'s' has finitely" in told(dbn, ROWS, AUTO)["x"]
        or "depends on it" in (told(dbn, ROWS, AUTO)["x"])
    )
    reason = bmc.ParticleFilter(5, marginalize="x").unsupported(dbn, ROWS)
    assert reason is not None and "on which 's' depends, which is sampled" in reason


def test_where_nothing_can_be_integrated_out_it_is_the_plain_filter() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Poisson(np.exp(x)))
    logs = [
        bmc.filter(
            dbn, {"y": [1, 3, 0]}, engine=bmc.ParticleFilter(100, marginalize=asked), rng=5
        ).log_marginal_likelihood
        for asked in (None, "auto")
    ]
    assert logs[0] == logs[1]


def test_a_branch_on_a_sampled_value_is_not_taken_for_all_particles() -> None:
    """Python's ``if`` on a regime cannot be read for a batch, so what it decides on is sampled."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("s", bmc.Bernoulli(0.5))

    def move(x_prev: Any, s: Any) -> Any:
        if np.ndim(s) == 0 and s == 1:
            return bmc.Normal(x_prev + 1.0, 1.0)
        return bmc.Normal(x_prev + np.where(s == 1, 1.0, 0.0), 1.0)

    dbn.add("x", move, initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    rows = {"y": [0.3, 1.2, 3.0]}
    found = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(4000, marginalize="auto"), rng=0)
    error = found.log_marginal_likelihood_mcse
    right = exact(switched(), rows).log_marginal_likelihood
    assert abs(found.log_marginal_likelihood - right) < 4 * error


def switched() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("s", bmc.Bernoulli(0.5))
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


# ---- answers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("proposal", [None, "optimal"])
def test_answers_of_all_kinds_are_near_exact_ones(proposal: str | None) -> None:
    """Within four stated errors; quantiles and covariances by what 20,000 particles leave."""
    engine = bmc.ParticleFilter(20_000, marginalize="auto", proposal=proposal)
    queries = {"both": lambda x, s: x * s}
    found = bmc.filter(switching(), ROWS, engine=engine, rng=2, keep="particles", queries=queries)
    unrolled = switching().unroll(6)
    right = bmc.infer(unrolled, switching().unrolled_evidence(ROWS), engine=bmc.Exact())
    error = found.log_marginal_likelihood_mcse
    assert abs(found.log_marginal_likelihood - right.log_marginal_likelihood) < 4 * error
    assert abs(found.mean("x")[-1] - right.mean("x[5]")) < 4 * found.mcse("x")[-1]
    assert abs(found.var("x")[-1] - right.var("x[5]")) < 0.02
    assert abs(found.cov("x", "s")[-1][0, 0] - right.var("x[5]")) < 0.02
    np.testing.assert_allclose(found.probabilities("s")[-1], right.probabilities("s[5]"), atol=0.02)
    draws = right.resample(200_000, rng=1)
    own, s = (np.asarray(draws[f"{n}[5]"]).reshape(-1) for n in "xs")
    assert (
        abs(found.queries["both"][-1] - (own * s).mean())
        < 4 * found.queries_mcse["both"][-1] + 0.01
    )
    np.testing.assert_allclose(
        found.quantile("x", [0.1, 0.5, 0.9])[-1], np.quantile(own, [0.1, 0.5, 0.9]), atol=0.02
    )
    rho = np.cov(own, s)
    np.testing.assert_allclose(found.cov("x", "s")[-1], rho, atol=0.02)


@pytest.mark.parametrize("seen", [[0.4, 0.1, 0.5, 0.7], [0.4, np.nan, 0.5, np.nan]])
def test_what_could_be_integrated_out_may_be_seen(seen: list[float]) -> None:
    """In all slices, where Gaussians of no number are left, or in some; by paths of regimes."""
    rows = {"y": [0.3, 1.2, np.nan, 2.5], "x": seen}
    logs = []
    for path in np.ndindex(2, 2, 2, 2):
        kalman = bmc.filter(switching(), {**rows, "s": list(path)}, engine=bmc.KalmanFilter())
        logs.append(kalman.log_marginal_likelihood)
    for proposal in (None, "optimal"):
        engine = bmc.ParticleFilter(4000, marginalize="auto", proposal=proposal)
        found = bmc.filter(switching(), rows, engine=engine, rng=0)
        error = 4 * found.log_marginal_likelihood_mcse + 1e-9
        assert abs(found.log_marginal_likelihood - np.logaddexp.reduce(logs)) < error


def test_trajectories_go_back_through_draws() -> None:
    right = exact(switching(), ROWS)
    engine = bmc.ParticleFilter(1000, marginalize="auto")
    runs = [bmc.smooth(switching(), ROWS, engine=engine, rng=r) for r in range(10)]
    for name, figure in (("x", "mean"), ("s", "probabilities")):
        each = np.array([getattr(run, figure)(name) for run in runs])
        error = each.std(axis=0, ddof=1) / np.sqrt(10)
        assert (np.abs(each.mean(axis=0) - getattr(right, figure)(name)) < 6 * error + 2e-3).all()


def test_a_forecast_goes_on_with_the_gaussians() -> None:
    rows = {"y": ROWS["y"][:4]}
    ahead = {"y": [*rows["y"], np.nan, np.nan]}
    right = exact(switching(), ahead)
    engine = bmc.ParticleFilter(20_000, marginalize="auto")
    found = bmc.forecast(switching(), rows, steps=2, engine=engine, rng=1)
    for name in ("x", "y"):
        truth = right.mean(name)[-1] if name in right.names else right.mean("x")[-1]
        assert abs(found.mean(name)[-1] - truth) < 4 * found.mcse(name)[-1] + 1e-9, name
    assert found.var("y")[-1] > found.var("x")[-1]


def test_rows_one_by_one_are_the_run_over_the_series() -> None:
    engine = bmc.ParticleFilter(3000, marginalize="auto", proposal="optimal")
    belief = engine.start(switching(), rng=1)
    for y in ROWS["y"]:
        before = copy.deepcopy(belief.now.inner.mean) if belief.now is not None else None
        after = engine.step(belief, {} if np.isnan(y) else {"y": y})
        if before is not None:
            np.testing.assert_array_equal(before, belief.now.inner.mean)
        belief = after
    right = exact(switching(), ROWS)
    error = belief.log_marginal_likelihood_mcse
    assert abs(belief.log_marginal_likelihood - right.log_marginal_likelihood) < 4 * error
    assert abs(belief.mean("x") - right.mean("x")[-1]) < 4 * belief.mcse("x")
    assert belief.particles("x").shape == (3000,)


def landmarks() -> bmc.DynamicBayesNet:
    """A robot that drives and turns, and sees where landmarks are from where it is."""
    dbn = bmc.DynamicBayesNet(plates={"mark": 4})
    push = np.array([0.5, 0.0, 0.1])
    dbn.add(
        "pose",
        lambda pose_prev: bmc.MvNormal(pose_prev + push, np.diag([0.01, 0.01, 0.002])),
        initial=bmc.MvNormal(np.zeros(3), 1e-4 * np.eye(3)),
    )
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, 1e-4 * np.eye(2)),
        plates="mark",
        initial=bmc.MvNormal(np.zeros(2), 9.0 * np.eye(2)),
    )

    def from_there(mark: Any, pose: Any) -> bmc.MvNormal:
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        x, y = mark[..., 0] - pose[..., 0], mark[..., 1] - pose[..., 1]
        return bmc.MvNormal(bmc.stack([c * x + s * y, c * y - s * x], axis=-1), 0.04 * np.eye(2))

    dbn.add("seen", from_there, plates="mark")
    return dbn


def test_a_plate_of_landmarks_is_a_plate_of_small_filters(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same as one large Gaussian for each particle, whatever is asked, to rounding."""
    rng = np.random.default_rng(3)
    rows = np.array(landmarks().sample(6, rng=1)["seen"][0])
    rows[rng.random(rows.shape[:2]) < 0.4] = np.nan
    engine = bmc.ParticleFilter(60, marginalize="auto")
    nodes = told(landmarks(), {"seen": rows}, engine)
    assert (
        nodes["mark"] == "integrated out, a Kalman filter for each particle and element of 'mark'"
    )
    answers = []
    for is_joint in (False, True):
        if is_joint:
            monkeypatch.setattr("bayesmc.engines.marginal.step.blocks_of", lambda *given: ())
        found = bmc.filter(landmarks(), {"seen": rows}, engine=engine, rng=1, keep="particles")
        assert found.clouds is not None
        assert found.clouds[-1].inner.factors.ndim == (3 if is_joint else 4)
        answers.append(
            (found.log_marginal_increments, found.mean("mark"), found.var("mark"), found.mcse("mark"),
             found.cov("mark"), found.cov("pose", "mark"), found.quantile("mark", [0.3]))
        )  # fmt: skip
    for one, two in zip(*answers, strict=True):
        assert off(one, two) < 1e-9


# ---- refusals -----------------------------------------------------------------------------------


def test_what_does_not_go_together_is_refused_by_name() -> None:
    for option in (
        {"auxiliary": True},
        {"recovery": bmc.Recovery({"x": bmc.Normal(0.0, 1.0)}, share=0.1)},
        {"adapt": bmc.KLD({"x": 0.5})},
    ):
        with pytest.raises(ValueError, match="do not go together"):
            bmc.ParticleFilter(10, marginalize="auto", **option)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="names of hidden nodes"):
        bmc.ParticleFilter(10, marginalize=3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="has no machine code"):
        bmc.ParticleFilter(10, marginalize="auto", compiled=True)
    with pytest.raises(ValueError, match="nothing is named"):
        bmc.ParticleFilter(10, marginalize=[])
    engine = bmc.ParticleFilter(10, marginalize="auto", proposal="optimal")
    reason = engine.unsupported(volatile(), ROWS)
    assert reason is not None and "'h', which is sampled, is not finite" in reason
    engine = bmc.ParticleFilter(
        10, marginalize="auto", proposal={"s": lambda x_prev: bmc.Bernoulli(0.5 + 0.0 * x_prev)}
    )
    reason = engine.unsupported(switching(), ROWS)
    assert reason is not None and "names 'x_prev', which marginalize= integrates out" in reason


def test_proposals_of_sampled_nodes_are_weighed() -> None:
    engine = bmc.ParticleFilter(
        5000,
        marginalize="auto",
        proposal={"s": lambda s_prev, y: bmc.Bernoulli(np.where(y > 1, 0.7, 0.4) + 0.0 * s_prev)},
    )
    rows = {"y": [0.3, 1.2, 3.0]}
    found = bmc.filter(switching(), rows, engine=engine, rng=4)
    right = exact(switching(), rows).log_marginal_likelihood
    assert abs(found.log_marginal_likelihood - right) < 4 * found.log_marginal_likelihood_mcse


def test_rows_that_no_particle_explains_name_the_slice() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[1.0, 0.0], [0.0, 1.0]], initial=[1.0, 0.0])
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    dbn.table("z", ["s"], [[1.0, 0.0], [0.0, 1.0]])
    with pytest.raises(DegeneracyError, match="in slice 1"):
        bmc.filter(dbn, {"y": [0.0, 1.0], "z": [0, 1]}, engine=AUTO)


def test_it_is_chosen_where_it_applies() -> None:
    explained = bmc.explain(volatile(), ROWS)
    assert explained.engine.marginalize == "auto"
    assert "integrated out" in explained.nodes["x"]
    assert "'x' integrated out" in explained.reasons[0]
    lagged = bmc.explain(volatile(), ROWS, question="fixed-lag").engine
    assert isinstance(lagged, bmc.ParticleFilter) and lagged.marginalize == "auto"


def test_coefficients_of_a_mode_are_read_once_whatever_other_modes_are_about(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Six modes: sets of those that particles have are many, and go on changing."""
    read: list[int] = []

    def counted(self: Any, values: Any, kinds: int, choices: int) -> Any:
        read.append(kinds)
        return reads(self, values, kinds, choices)

    reads = SliceReader.read_choices
    monkeypatch.setattr(SliceReader, "read_choices", counted)
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], np.full((6, 6), 0.04) + 0.76 * np.eye(6), initial=np.full(6, 1 / 6))
    dbn.add("x", lambda x_prev, s: bmc.Normal(0.9 * x_prev + s, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    engine = bmc.ParticleFilter(10, marginalize="auto", proposal="optimal")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        bmc.filter(dbn, {"y": np.linspace(0.0, 30.0, 60) % 9.0}, engine=engine, rng=0)
    assert sum(read) <= 2 * (1 + 6)  # of slice 0 and each mode before, for particles and for scouts
