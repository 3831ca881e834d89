"""Smoothing with ``ParticleFilter(marginalize=)``: against Kalman smoothers, paths of regimes and grids.

Comparisons that chance has a part in have a false-alarm rate of 1e-3 or less, at fixed seeds.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BudgetError, LowEssWarning, UnsupportedError
from bayesmc.testing import exact, repeated_test, session
from bayesmc.testing.makers.linear_dbns import random_linear_dbn
from bayesmc.testing.makers.switching_dbns import random_switching_dbn
from tests.engines.test_marginal import off
from tests.engines.test_switching import read, rows_of, template
from tests.mutants.faults import Edit, planted

ROWS = {"y": [0.3, 1.2, 3.0, 2.5, np.nan, 1.0]}
AUTO = bmc.ParticleFilter(100, marginalize="auto")


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


def by_the_last() -> bmc.DynamicBayesNet:
    """Regimes that drive a level, and shake what is seen, one slice later."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add(
        "x", lambda x_prev, s_prev: bmc.Normal(0.9 * x_prev + s_prev, np.where(s_prev == 1, 0.5, 1.0)),
        initial=bmc.Normal(0.0, 1.0),
    )  # fmt: skip
    dbn.add(
        "y",
        lambda x, x_prev, s_prev: bmc.Normal(x - 0.5 * x_prev, np.where(s_prev == 1, 0.4, 1.5)),
        initial=lambda x: bmc.Normal(x, 0.5),
    )
    return dbn


def carrying(noise: float) -> bmc.DynamicBayesNet:
    """Trend and cycle in one vector that carries a lag (Kim 1994): a covariance without full rank."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.25, 0.75]], initial=[0.6, 0.4])

    def follow(z_prev: Any, s: Any) -> bmc.MvNormal:
        trend, cycle, lag = (z_prev[..., k] for k in range(3))
        mean = [trend + np.where(s == 1, -0.5, 0.8), 1.2 * cycle - 0.4 * lag, cycle]
        return bmc.MvNormal(bmc.stack(mean, axis=-1), scale_diag=np.array([0.1, 0.7, 0.0]))

    dbn.add("z", follow, initial=bmc.MvNormal(np.zeros(3), np.eye(3)))
    dbn.add("y", lambda z: bmc.Normal(z[..., 0] + z[..., 1], noise))
    return dbn


def lagging() -> bmc.DynamicBayesNet:
    """The same by a node that is computed, whose first value is a number."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.25, 0.75]], initial=[0.6, 0.4])
    dbn.add(
        "x",
        lambda x_prev, l_prev, s: bmc.Normal(1.2 * x_prev - 0.4 * l_prev + s, 0.7),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("l", lambda x_prev: x_prev, initial=lambda: 0.5)
    dbn.add("total", lambda total_prev, x: total_prev + x, initial=lambda x: x)
    dbn.add("y", lambda total: bmc.Normal(total, 0.3))
    return dbn


def remembering() -> bmc.DynamicBayesNet:
    """A regime that acts two slices later: paths drawn backwards would have to look as far ahead."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("r", lambda s_prev: 1.0 * s_prev, initial=lambda: 0.0)
    dbn.add(
        "x", lambda x_prev, r_prev: bmc.Normal(0.9 * x_prev + r_prev, 0.5),
        initial=bmc.Normal(0.0, 1.0),
    )  # fmt: skip
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def sites() -> bmc.DynamicBayesNet:
    """Numbers of sites that one regime shakes: small Gaussians side by side for each particle."""
    dbn = bmc.DynamicBayesNet(plates={"site": 3})
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(0.9 * x_prev + s, 0.4 + s),
        plates="site",
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5), plates="site")
    return dbn


SITES = {"y": [[0.3, -0.1, np.nan], [1.2, 0.8, 1.6], [np.nan] * 3, [0.6, 1.0, 0.1]]}
MODELS: dict[str, tuple[Callable[[], bmc.DynamicBayesNet], dict[str, Any]]] = {
    "switching": (switching, {"y": ROWS["y"][:5]}),
    "by the last regime": (by_the_last, {"y": ROWS["y"][:4]}),
    "singular": (lambda: carrying(0.3), {"y": ROWS["y"][:5]}),
    "singular, seen without noise": (lambda: carrying(0.0), {"y": ROWS["y"][1:]}),
    "computed": (lagging, {"y": ROWS["y"][:5]}),
    "remembering": (remembering, ROWS),
    "plates": (sites, SITES),
}


@cache
def by_paths(name: str, steps: int) -> tuple[float, dict[str, np.ndarray]]:
    """Log evidence, smoothed means and second moments: of Kalman smoothers along all paths of regimes."""
    logs, found = [], []
    dbn, rows = MODELS[name][0](), {"y": MODELS[name][1]["y"][:steps]}
    for path in itertools.product((0, 1), repeat=steps):
        given = {**rows, "s": list(path)}
        one = bmc.smooth(dbn, given, engine=bmc.KalmanFilter())
        hidden = [n for n in one.names if n not in given]
        own: dict[str, np.ndarray] = {"s": np.array(path, dtype=float)}
        for name in hidden:
            own[name] = one.mean(name)
            own[f"{name} squared"] = one.var(name) + own[name] ** 2
        logs.append(float(np.sum(one.log_marginal_likelihood)))
        found.append(own)
    log = float(np.logaddexp.reduce(logs))
    shares = np.exp(np.array(logs) - log)
    return log, {n: np.tensordot(shares, np.array([f[n] for f in found]), 1) for n in found[0]}


def figures(answer: Any, names: Any) -> dict[str, np.ndarray]:
    found = {}
    for name in names:
        own = name.removesuffix(" squared")
        mean = answer.probabilities("s")[..., 1] if own == "s" else answer.mean(own)
        found[name] = mean if own == name else answer.var(own) + mean**2
    return found


def judged(name: str, engine: bmc.ParticleFilter, runs: int, rng: Any = 0, **options: Any) -> Any:
    """Smoothed figures times estimated over exact evidence, against those of all paths.

    With a lag those of the first slice, of which the rows up to the lag tell.
    """
    make, rows = MODELS[name]
    dbn, told = make(), options.get("lag", len(rows["y"]) - 1) + 1
    log, truth = by_paths(name, told)
    if "lag" in options:
        truth = {n: f[:1] for n, f in truth.items()}

    def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            found = bmc.smooth(dbn, rows, engine=engine, rng=rng, **options)
        ratio = np.exp(found.log_marginal_increments[:told].sum() - log)
        return {n: ratio * f[: len(truth[n])] for n, f in figures(found, truth).items()}

    return repeated_test(estimate, truth, replications=runs, alpha=1e-3, rng=rng)


# ---- where nothing is sampled -------------------------------------------------------------------


def test_without_sampled_nodes_it_is_the_kalman_smoother() -> None:
    """Vectors, lags, running sums, inputs, values missing in part, of all rows and of some: to rounding."""
    asked = 0
    engine = bmc.ParticleFilter(3, marginalize="auto")
    for seed in range(session.scaled(6, 12)):
        case = random_linear_dbn(seed)
        for lag in ({}, {"lag": 1}):
            given: dict[str, Any] = {"inputs": case.inputs or None, **lag}
            right = bmc.smooth(case.dbn, case.observations, engine=bmc.KalmanFilter(), **given)
            try:
                found = bmc.smooth(case.dbn, case.observations, engine=engine, rng=0, **given)
            except UnsupportedError:
                assert right.log_marginal_increments.ndim > 1, seed  # plates filtered separately
                break
            if right.log_marginal_increments.ndim > 1:
                break
            for name in (n for n in case.hidden if n in right.names):
                assert off(found.mean(name), right.mean(name)) < 1e-8, (seed, name, lag)
                assert off(found.var(name), right.var(name)) < 1e-8, (seed, name, lag)
            asked += 1
    assert asked > 4


def test_what_is_told_without_noise_across_a_gap() -> None:
    """A place that moves by its speed alone, from a known start, seen exactly: later rows must add up."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("v", lambda v_prev: bmc.Normal(v_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "p", lambda p_prev, v_prev: bmc.Normal(p_prev + v_prev, 0.0), initial=bmc.Normal(0.0, 0.0)
    )
    dbn.add("y", lambda p: bmc.Normal(p, 0.0))
    rows = {"y": [0.0, np.nan, 0.5, 2.0, np.nan, np.nan, 3.0]}
    right = bmc.smooth(dbn, rows, engine=bmc.KalmanFilter())
    engine = bmc.ParticleFilter(3, marginalize="auto")
    found = bmc.smooth(dbn, rows, engine=engine, rng=0)
    for name in ("v", "p"):
        assert off(found.mean(name), right.mean(name)) < 1e-6, name
        assert off(found.var(name), right.var(name)) < 1e-6, name
    v, p = found.particles("v"), found.particles("p")
    np.testing.assert_allclose(p[1:], p[:-1] + v[:-1], atol=1e-5)  # draws add up, too


def test_draws_beside_the_beliefs_are_joint_ones() -> None:
    """Covariances of neighbouring slices of 4,000 draws: 1e-3 is beyond four standard errors of them."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("l", lambda x_prev: x_prev, initial=lambda: 0.0)
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    rows = {"y": [0.3, 1.2, np.nan, 2.0]}
    engine = bmc.ParticleFilter(4000, marginalize="auto")
    found = bmc.smooth(dbn, rows, engine=engine, rng=0, trajectories=4000)
    right = bmc.infer(dbn.unroll(4), dbn.unrolled_evidence(rows), engine=bmc.Exact())
    x = found.particles("x")
    wanted = right.cov(*(f"x[{t}]" for t in range(4)))
    assert np.abs(np.cov(x) - wanted).max() < 4.5 * wanted.max() * np.sqrt(2 / 4000)
    np.testing.assert_array_equal(found.particles("l")[1:], x[:-1])


# ---- against exact answers ----------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n in MODELS if session.is_thorough() or n != "singular"])
def test_smoothed_figures_are_those_of_all_paths(name: str) -> None:
    """Means, second moments and probabilities of all slices, under Holm; some particles, then all, tried."""
    runs = session.scaled(8, 16)
    proposal = "optimal" if name in ("switching", "computed") else None
    few = bmc.ParticleFilter(100, marginalize="auto", proposal=proposal)
    verdict = judged(name, few, runs)
    assert verdict, verdict
    if name == "by the last regime":
        verdict = judged(name, few, runs, rng=1, backward="exact")
        assert verdict, verdict


@pytest.mark.parametrize("name", ["by the last regime", "remembering", "computed"])
def test_fixed_lags_are_those_of_all_paths(name: str) -> None:
    verdict = judged(
        name, bmc.ParticleFilter(100, marginalize="auto"), session.scaled(8, 16), lag=2
    )
    assert verdict, verdict


def test_random_templates() -> None:
    """Smoothed figures of all slices times estimated over exact evidence."""
    engine = bmc.ParticleFilter(100, marginalize="auto")
    asked = 0
    for seed in range(40, 40 + session.scaled(1, 16)):
        case = random_switching_dbn(seed)
        try:
            right = exact(case.dbn, case.observations, case.inputs or None)
        except (UnsupportedError, BudgetError):
            continue
        given: dict[str, Any] = {"inputs": case.inputs or None, "engine": engine}
        log = right.log_marginal_likelihood - right.log_static
        numbers = [n for n in case.hidden if not case.dbn[n].is_discrete]

        def estimate(
            rng: np.random.Generator, case: Any = case, given: Any = given, log: Any = log,
            numbers: Any = numbers,
        ) -> dict[str, np.ndarray]:  # fmt: skip
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LowEssWarning)
                found = bmc.smooth(case.dbn, case.observations, rng=rng, **given)
            ratio = np.exp(np.sum(found.log_marginal_likelihood) - log)
            return {n: ratio * found.mean(n) for n in numbers}

        truth = {n: np.asarray(right.mean(n)) for n in numbers}
        verdict = repeated_test(
            estimate, truth, replications=session.scaled(6, 8), alpha=1e-3, rng=[seed, 2]
        )
        assert verdict, (seed, verdict)
        asked += 1
    assert asked >= session.scaled(1, 8)


def test_a_sampled_number_with_a_linear_one_is_that_of_a_grid() -> None:
    """A level through noise whose size walks, with leverage: what was seen moves the size on."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "h", lambda h_prev, y_prev: bmc.Normal(0.9 * h_prev - 0.2 * y_prev, 0.4),
        initial=bmc.Normal(0.0, 1.0),
    )  # fmt: skip
    dbn.add(
        "x", lambda x_prev, h: bmc.Normal(0.8 * x_prev + 0.3 * h, 0.5),
        initial=bmc.Normal(0.0, 1.0),
    )  # fmt: skip
    dbn.add("y", lambda x, h: bmc.Normal(x, np.exp(h / 2)))
    rows = {"y": [0.3, 1.0, -2.0, 0.5, 1.1]}
    cells = {"h": (-4.5, 4.5, 46), "x": (-4.0, 4.0, 46)}
    right = bmc.smooth(dbn, rows, engine=bmc.GridFilter(cells))
    found = bmc.smooth(dbn, rows, engine=bmc.ParticleFilter(1000, marginalize="auto"), rng=0)
    for name in ("x", "h"):
        bound = 4 * found.mcse(name) + 0.01
        assert (np.abs(found.mean(name) - right.mean(name)) < bound).all(), name
        assert (found.mcse(name) < 0.12).all(), name
    assert np.abs(found.var("x") - right.var("x")).max() < 0.05


# ---- answers ------------------------------------------------------------------------------------


def test_answers_are_mixtures_of_smoothed_beliefs() -> None:
    """Quantiles, covariances and functions, by what 1,000 paths leave."""
    found = bmc.smooth(
        switching(), ROWS, engine=bmc.ParticleFilter(3000, marginalize="auto"), rng=1,
        queries={"both": lambda x, s: x * s},
    )  # fmt: skip
    unrolled = bmc.infer(
        switching().unroll(6), switching().unrolled_evidence(ROWS), engine=bmc.Exact()
    )
    draws = unrolled.resample(100_000, rng=1)
    for t in (0, 2, 4):
        x, s = (np.asarray(draws[f"{n}[{t}]"]).reshape(-1) for n in "xs")
        quantiles = found.quantile("x", [0.1, 0.5, 0.9])[t]
        np.testing.assert_allclose(quantiles, np.quantile(x, [0.1, 0.5, 0.9]), atol=0.06)
        np.testing.assert_allclose(found.cov("x", "s")[t], np.cov(x, s), atol=0.06)
        bound = 4 * found.queries_mcse["both"][t] + 0.01
        assert abs(found.queries["both"][t] - (x * s).mean()) < bound


@cache
def several(marginalize: str | None) -> list[Any]:
    """Runs of one series."""
    engine = bmc.ParticleFilter(100, marginalize=marginalize)
    count = 20 if marginalize else 12
    return [bmc.smooth(switching(), ROWS, engine=engine, rng=r) for r in range(count)]


def test_stated_errors_are_those_of_runs() -> None:
    """Spreads of 20 runs over stated errors: between 0.55 and 1.5, where 1e-3 of runs are beyond."""
    runs = several("auto")
    for name in ("x", "s"):
        spread = np.std([r.mean(name) for r in runs], axis=0, ddof=1)
        stated = np.sqrt(np.mean([r.mcse(name) ** 2 for r in runs], axis=0))
        ratio = np.sqrt(np.mean(spread**2) / np.mean(stated**2))
        assert 0.55 < ratio < 1.5, (name, ratio)


def test_integrating_out_leaves_less_to_chance() -> None:
    """Spreads of runs of smoothed means: a ratio of variances below 1/4 is beyond an F law's 1e-3."""
    spreads = [
        np.sqrt(np.var([r.mean("x") for r in several(asked)], axis=0, ddof=1).mean())
        for asked in (None, "auto")
    ]
    assert spreads[1] < 0.5 * spreads[0]


def test_explain_says_how() -> None:
    for name, lag, what in (
        ("switching", False, "paths of what is sampled drawn backwards, a Kalman smoother along"),
        ("switching", True, "a Kalman smoother along the ancestors of each particle"),
        ("remembering", False, "nothing stays integrated out, as 'r' is computed from sampled"),
    ):
        make, rows = MODELS[name]
        question = "fixed-lag" if lag else "smooth"
        assert what in bmc.explain(make(), rows, engine=AUTO, question=question).effort


def test_published_model_of_gnp_is_smoothed(reference_data: Path) -> None:
    """Kim (1994) against expectation propagation, whose mean error on such models is .0015."""
    held = read(reference_data, "kim1994")
    dbn, rows = template(held["model"]), {"y": rows_of(held["y"])["y"][:16]}
    engine = bmc.ParticleFilter(100, marginalize="auto", proposal="optimal")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        found = bmc.smooth(dbn, rows, engine=engine, rng=0)
    near = bmc.smooth(dbn, rows, engine=bmc.ExpectationPropagation())
    gap = np.abs(found.probabilities("s") - near.probabilities("s"))[..., 1]
    assert gap.mean() < 0.02
    assert np.abs(found.mean("x") - near.mean("x")).mean() < 0.3


# ---- planted faults -----------------------------------------------------------------------------

SMOOTHING, MESSAGES = "bayesmc.engines.marginal.smoothing:", "bayesmc.engines.marginal.messages:"
FAULTS = {
    "rows that follow do not choose": (
        "switching", Edit(SMOOTHING + "_Paths.log_after", "found.reshape(which.shape) + log", "log")
    ),
    "sampled nodes that follow do not choose": (
        "switching", Edit(SMOOTHING + "_Paths.log_after", "(which.shape) + log", "(which.shape)")
    ),
    "beliefs are those of the filter": (
        "switching",
        Edit(SMOOTHING + "_Paths.believed", "combined(messages[k].numbers, filtered)", "filtered"),
    ),
    "constants that depend on the particle are lost": (
        "by the last regime", Edit(SMOOTHING + "_Paths.log_after", "own + log_evidence(", "log_evidence(")
    ),
    "the noise of a slice is forgotten": (
        "switching", Edit(MESSAGES + "_noise_of", "matrix @ noise[..., places, :]", "0.0")
    ),
}  # fmt: skip


RUNS = {
    "rows that follow do not choose": 70,
    "constants that depend on the particle are lost": 50,
    "the noise of a slice is forgotten": 30,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_caught(fault: str) -> None:
    name, edit = FAULTS[fault]
    with planted(edit):
        assert not judged(name, bmc.ParticleFilter(60, marginalize="auto"), RUNS.get(fault, 16))
