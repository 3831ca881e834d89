"""``SwitchingKalmanFilter`` against exact conditioning, published and independent figures, a plain loop."""

from __future__ import annotations

import functools
import gzip
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import ExpectationPropagation, SwitchingKalmanFilter
from bayesmc.engines.switching import run
from bayesmc.errors import BudgetError, QueryError, UnsupportedError, ZeroProbabilityError
from bayesmc.lowering import is_available
from bayesmc.testing import exact, session
from bayesmc.testing.makers.linear_dbns import LinearSeries
from bayesmc.testing.makers.switching_dbns import random_switching_dbn

RULES = ("gpb1", "imm", "gpb2")
SEEDS = range(session.scaled(12, 5))


def off(found: Any, wanted: Any) -> float:
    """Largest difference, relative where numbers are above 1."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    return float((np.abs(found - wanted) / (1 + np.abs(wanted))).max(initial=0.0))


def figures(answer: Any, names: Any, finite: Any) -> list[np.ndarray]:
    return [
        f
        for n in names
        for f in ([answer.probabilities(n)] if n in finite else [answer.mean(n), answer.var(n)])
    ]


@functools.cache
def answered(seed: int, difference: float) -> tuple[LinearSeries, Any]:
    """A random template and its exact answer, None where histories are too many."""
    case = random_switching_dbn(seed, difference)
    try:
        return case, exact(case.dbn, case.observations, case.inputs or None)
    except (UnsupportedError, BudgetError):
        return case, None


def finite(case: LinearSeries) -> set[str]:
    return {n for n in case.hidden if case.dbn[n].is_discrete}


# ---- exact where it must be ---------------------------------------------------------------------


@pytest.mark.parametrize("merging", RULES)
def test_modes_that_make_no_difference_leave_all_exact(merging: str) -> None:
    asked = 0
    for seed in SEEDS:
        case, right = answered(seed, 0.0)
        if right is None:
            continue
        options: dict[str, Any] = {"inputs": case.inputs, "engine": SwitchingKalmanFilter(merging)}
        smoothed = bmc.smooth(case.dbn, case.observations, **options)
        filtered = bmc.filter(case.dbn, case.observations, **options)
        log = np.sum(filtered.log_marginal_likelihood) + right.log_static
        assert off(log, right.log_marginal_likelihood) < 1e-8
        for one, two in zip(
            figures(smoothed, case.hidden, finite(case)),
            figures(right, case.hidden, finite(case)),
            strict=True,
        ):
            assert off(one, two) < 1e-7, (seed, case.dbn)
        for one, two in zip(
            figures(filtered, case.hidden, finite(case)),
            figures(right, case.hidden, finite(case)),
            strict=True,
        ):
            assert off(one[-1], two[-1]) < 1e-7, (seed, case.dbn)
        asked += 1
    assert asked > len(SEEDS) / 2


def test_two_slices_are_exact_with_gpb2() -> None:
    """All pairs of modes are there; nothing was merged before them."""
    asked = 0
    for seed in SEEDS:
        case = random_switching_dbn(seed)
        rows = {n: v if n in case.dbn.static_nodes else v[:2] for n, v in case.observations.items()}
        inputs = {n: v[:2] for n, v in case.inputs.items()} or None
        try:
            right = exact(case.dbn, rows, inputs)
        except (UnsupportedError, BudgetError):
            continue
        filtered = bmc.filter(case.dbn, rows, inputs=inputs, engine=SwitchingKalmanFilter())
        log = np.sum(filtered.log_marginal_likelihood) + right.log_static
        assert off(log, right.log_marginal_likelihood) < 1e-8, seed
        hidden = [n for n in case.hidden if n in filtered.names]
        for one, two in zip(
            figures(filtered, hidden, finite(case)),
            figures(right, hidden, finite(case)),
            strict=True,
        ):
            assert off(one[-1], two[-1]) < 1e-7, (seed, case.dbn)
        asked += 1
    assert asked > len(SEEDS) / 2


def test_random_templates_are_near_exact_answers_and_rules_in_order() -> None:
    """Bounds are some three times what 57 templates gave: .0013, .014, .042 on average."""
    errors: dict[str, list[float]] = {rule: [] for rule in RULES}
    shares: dict[str, list[float]] = {rule: [] for rule in RULES}
    for seed in range(session.scaled(16, 5)):
        case, right = answered(seed, 1.0)
        if right is None:
            continue
        for rule in RULES:
            engine = SwitchingKalmanFilter(rule)
            found = bmc.smooth(case.dbn, case.observations, inputs=case.inputs, engine=engine)
            log = np.sum(found.log_marginal_likelihood) + right.log_static
            errors[rule].append(abs(float(log - right.log_marginal_likelihood)))
            wrong = np.abs(found.probabilities("mode") - right.probabilities("mode"))
            shares[rule].append(wrong.mean())
    means = {rule: np.mean(e) for rule, e in errors.items()}
    assert means["gpb2"] < means["imm"] < means["gpb1"], means
    assert means["gpb2"] < 0.005 and means["imm"] < 0.04 and means["gpb1"] < 0.12, means
    assert np.mean(shares["gpb2"]) < 0.02, shares


def test_vague_starts_lose_no_digits() -> None:
    """Two modes that are alike, of a level and a slope of which nothing is known."""
    found = []
    for modes in (0, 1):
        dbn = bmc.DynamicBayesNet()
        if modes:
            dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.4, 0.6]], initial=[0.5, 0.5])
        dbn.add("v", lambda v_prev: bmc.Normal(v_prev, 0.1), initial=bmc.Normal(0.0, 1e7))
        dbn.add(
            "x",
            lambda x_prev, v_prev: bmc.Normal(x_prev + v_prev, 0.1),
            initial=bmc.Normal(0.0, 1e7),
        )
        if modes:
            dbn.add("y", lambda x, s: bmc.Normal(x + 0.0 * s, 0.5))
        else:
            dbn.add("y", lambda x: bmc.Normal(x, 0.5))
        engine = SwitchingKalmanFilter() if modes else bmc.KalmanFilter()
        found.append(bmc.smooth(dbn, {"y": [1.0, 2.5, 2.9, np.nan, 5.2]}, engine=engine))
    one, two = found
    assert off(one.log_marginal_increments, two.log_marginal_increments) < 1e-9
    for name in ("x", "v"):
        assert off(one.mean(name), two.mean(name)) < 1e-8
        assert off(one.var(name), two.var(name)) < 1e-8


def seen_by_bearing(turn: float, family: Any) -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """A target that a radar sees, all of it turned about the radar; and rows that are turned, too."""
    rows = {
        "range": [10.1, 9.2, 8.3, 7.9, 7.1, 6.4],
        "bearing": [0.06, 0.09, 0.22, 0.3, 0.35, 0.54],
    }
    c, s = np.cos(turn), np.sin(turn)
    about = np.kron(np.eye(2), [[c, -s], [s, c]])
    move = np.eye(4) + np.eye(4, k=2)
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    start = bmc.MvNormal(about @ [10.0, 1.0, -1.0, 0.3], 0.3 * np.eye(4))
    dbn.add(
        "x",
        lambda x_prev, s: bmc.MvNormal(
            np.matvec(move, x_prev), np.where((s == 1)[..., None, None], 0.3, 0.01) * np.eye(4)
        ),
        initial=start,
    )
    dbn.add("range", lambda x: bmc.Normal(np.hypot(x[..., 0], x[..., 1]), 0.1))
    dbn.add("bearing", lambda x: family(np.arctan2(x[..., 1], x[..., 0]), 0.05))
    rows["bearing"] = (np.array(rows["bearing"]) + turn + np.pi) % (2 * np.pi) - np.pi
    return dbn, rows


@pytest.mark.parametrize(
    "engine", [SwitchingKalmanFilter(linearize=True), ExpectationPropagation(linearize=True)]
)
def test_readings_on_a_circle_say_the_same_whatever_north_is(engine: Any) -> None:
    """Of Normal ones they do not, where they cross the cut: such a mix-up would show."""
    found = {}
    for family in (bmc.WrappedNormal, bmc.Normal):
        for turn in (0.0, np.pi - 0.2):
            dbn, rows = seen_by_bearing(turn, family)
            belief = bmc.smooth(dbn, rows, engine=engine)
            found[family, turn] = np.array([
                belief.log_marginal_likelihood, *belief.probabilities("s")[:, 1],
                *np.hypot(*belief.mean("x")[:, :2].T),
            ])  # fmt: skip
    for family in (bmc.WrappedNormal, bmc.Normal):
        same = off(found[family, np.pi - 0.2], found[family, 0.0]) < 1e-8
        assert same == (family is bmc.WrappedNormal)
    assert off(found[bmc.WrappedNormal, 0.0], found[bmc.Normal, 0.0]) < 1e-8
    belief = engine.start(dbn := seen_by_bearing(3.0, bmc.WrappedNormal)[0])
    rows = seen_by_bearing(3.0, bmc.WrappedNormal)[1]
    for k in range(6):
        belief = engine.step(belief, {name: values[k] for name, values in rows.items()})
    whole = bmc.filter(dbn, rows, engine=engine).log_marginal_likelihood
    assert abs(belief.log_marginal_likelihood - whole) < 1e-9
    rows["bearing"][3] = np.nan  # of which there would be Gaussians to merge
    with pytest.raises(UnsupportedError, match="'bearing' is an angle that is not seen in every"):
        bmc.filter(dbn, rows, engine=engine)


@pytest.mark.parametrize("merging", RULES)
def test_pairs_of_modes_that_cannot_be_need_no_numbers(merging: str) -> None:
    """Of numbers in a mode that cannot be before nothing is known; a reading divides by the distance."""

    def target(modes: bool) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet()
        follow = [[0.8, 0.2], [0.3, 0.7]]
        start = bmc.MvNormal([3.0, 4.0], 0.1 * np.eye(2))
        if modes:
            dbn.table("s", ["s_prev"], follow, initial=[1.0, 0.0])
            dbn.add(
                "x", lambda x_prev, s: bmc.MvNormal(x_prev + s[..., None], np.eye(2)), initial=start
            )
        else:
            dbn.input("s")
            dbn.add("x", lambda x_prev, s: bmc.MvNormal(x_prev + s, np.eye(2)), initial=start)
        dbn.add("y", lambda x: bmc.Normal(x[..., 0] / np.hypot(x[..., 0], x[..., 1]), 0.2))
        return dbn

    rows = {"y": [0.6, 0.7]}
    found = bmc.filter(target(True), rows, engine=SwitchingKalmanFilter(merging, linearize=True))
    logs = [
        bmc.filter(
            target(False), rows, inputs={"s": [0.0, s]}, engine=bmc.ExtendedKalmanFilter()
        ).log_marginal_likelihood
        for s in (0.0, 1.0)
    ]
    total = np.logaddexp(np.log(0.8) + logs[0], np.log(0.2) + logs[1])
    assert abs(found.log_marginal_likelihood - total) < 1e-9
    assert abs(found.probabilities("s")[1, 1] - np.exp(np.log(0.2) + logs[1] - total)) < 1e-9


# ---- published and independent figures ----------------------------------------------------------


def template(model: dict[str, Any]) -> bmc.DynamicBayesNet:
    """A model of the files, whose start stands before the first row's transition: slice 0 has no row."""
    p, pi, a, c, q, h, d, r, m0, v0 = (
        np.array(model[k]) for k in ("P", "pi", "A", "c", "Q", "H", "d", "R", "m0", "V0")
    )
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], p, initial=pi)
    own = (lambda s: bmc.MvNormal(m0[s], v0)) if m0.ndim == 2 else bmc.MvNormal(m0, v0)
    dbn.add("x", lambda x_prev, s: bmc.MvNormal(c[s] + np.matvec(a[s], x_prev), q[s]), initial=own)
    if len(h) == 1:
        scale = np.sqrt(r[:, 0, 0])
        dbn.add("y", lambda x, s: bmc.Normal(d[s, 0] + np.vecdot(h[0], x), scale[s]))
    else:
        dbn.add("y", lambda x, s: bmc.MvNormal(d[s] + np.matvec(h, x), r[s]))
    return dbn


def rows_of(y: Any) -> dict[str, np.ndarray]:
    y = np.array(y)
    y = y[:, 0] if y.shape[1] == 1 else y
    return {"y": np.concatenate([np.full((1, *y.shape[1:]), np.nan), y])}


def read(folder: Path, name: str) -> Any:
    with gzip.open(folder / "switching" / f"{name}.json.gz") as file:
        return json.load(file)


@pytest.mark.parametrize("name", ["kim1994", "kim_yoo1995"])
def test_published_models_give_what_independent_code_gives(reference_data: Path, name: str) -> None:
    held = read(reference_data, name)
    dbn, rows, burn = template(held["model"]), rows_of(held["y"]), held["burn"]
    for rule in RULES:
        wanted = held["computed"][rule]
        found = bmc.filter(dbn, rows, engine=SwitchingKalmanFilter(rule))
        np.testing.assert_allclose(
            found.log_marginal_increments[1:], wanted["increments"], atol=1e-9
        )
        np.testing.assert_allclose(
            found.probabilities("s")[1:], wanted["filtered_modes"], atol=1e-9
        )
        np.testing.assert_allclose(found.mean("x")[1:], wanted["filtered_means"], atol=1e-9)
    total = found.log_marginal_increments[1 + burn :].sum()
    if name == "kim1994":
        assert abs(total - held["published_loglik"]) < 1e-5
        cycle = found.mean("x")[1 + burn :, 0]
        np.testing.assert_allclose(cycle, held["published_cycle_x0"], atol=5e-5)
    else:
        assert abs(total - -1280.429) < 0.01


def test_slds_suite(reference_data: Path) -> None:
    """The last model is one on which expectation propagation does not settle."""
    suite = read(reference_data, "slds_suite")[:-1]
    bounds = {"gpb1": 0.65, "imm": 0.12, "gpb2": 0.02}
    for rule in RULES:
        logs, modes = [], []
        for held in suite:
            engine = SwitchingKalmanFilter(rule)
            found = bmc.smooth(template(held["model"]), rows_of(held["y"]), engine=engine)
            logs.append(abs(found.log_marginal_likelihood - held["loglik"]))
            modes.append(np.abs(found.probabilities("s")[1:] - held["smoothed_mode"]).mean())
        assert np.mean(logs) <= bounds[rule], rule
        if rule == "gpb2":
            assert np.mean(modes) <= 0.045


def reference(merging: str, model: dict[str, Any], y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Increments and mode probabilities by loops over modes, with covariances (Bar-Shalom et al. 2001, 11.6).

    Offsets depend on the mode before, too, so that there is a filter for every pair under every rule.
    """
    p, pi, a, c, q, h, r = (model[k] for k in ("P", "pi", "A", "c", "Q", "H", "R"))
    k = len(pi)
    means, covs, weights = [np.zeros(2)] * k, [np.eye(2)] * k, pi
    increments, probabilities = [], []
    for row in y:
        logs = np.full((k, k), -np.inf)
        made = {}
        centre = weights @ np.array(means)
        pool = sum(
            w * (v + np.outer(m - centre, m - centre))
            for w, m, v in zip(weights, means, covs, strict=True)
        )
        for i in range(k):
            for j in range(k):
                m, v = (centre, pool) if merging == "gpb1" else (means[i], covs[i])
                m, v = a[j] @ m + c[i, j], a[j] @ v @ a[j].T + q[j]
                s = h @ v @ h + r[j]
                gain = v @ h / s
                miss = row - h @ m
                logs[i, j] = np.log(weights[i] * p[i, j]) - 0.5 * (
                    miss**2 / s + np.log(2 * np.pi * s)
                )
                made[i, j] = m + gain * miss, v - np.outer(gain, gain) * s
        top = np.logaddexp.reduce(logs, axis=(0, 1))
        pair = np.exp(logs - top)
        weights = pair.sum(axis=0)
        means, covs = [], []
        for j in range(k):
            share = pair[:, j] / weights[j]
            mean = sum(share[i] * made[i, j][0] for i in range(k))
            means.append(mean)
            covs.append(
                sum(
                    share[i]
                    * (made[i, j][1] + np.outer(made[i, j][0] - mean, made[i, j][0] - mean))
                    for i in range(k)
                )
            )
        increments.append(top)
        probabilities.append(weights)
    return np.array(increments), np.array(probabilities)


@pytest.mark.parametrize("merging", RULES)
def test_a_plain_loop_gives_the_same_where_numbers_depend_on_the_mode_before(merging: str) -> None:
    """There IMM has nothing to mix, and is GPB2."""
    rng = np.random.default_rng(5)
    k = 3
    model = {
        "P": rng.dirichlet(np.ones(k), size=k), "pi": rng.dirichlet(np.ones(k)),
        "A": 0.5 * rng.normal(size=(k, 2, 2)), "c": rng.normal(size=(k, k, 2)),
        "Q": np.array([np.diag(v) for v in rng.uniform(0.1, 1.0, size=(k, 2))]),
        "H": rng.normal(size=2), "R": rng.uniform(0.1, 1.0, size=k),
    }  # fmt: skip
    p, pi, a, c, q, h, r = (model[n] for n in ("P", "pi", "A", "c", "Q", "H", "R"))
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], p, initial=pi)
    dbn.add(
        "x",
        lambda x_prev, s, s_prev: bmc.MvNormal(c[s_prev, s] + np.matvec(a[s], x_prev), q[s]),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )
    dbn.add("y", lambda x, s: bmc.Normal(np.vecdot(h, x), np.sqrt(r)[s]))
    y = rng.normal(size=15)
    found = bmc.filter(
        dbn, {"y": np.concatenate([[np.nan], y])}, engine=SwitchingKalmanFilter(merging)
    )
    increments, probabilities = reference(merging, model, y)
    np.testing.assert_allclose(found.log_marginal_increments[1:], increments, atol=1e-10)
    np.testing.assert_allclose(found.probabilities("s")[1:], probabilities, atol=1e-10)


# ---- one row at a time, lags, what is ahead -----------------------------------------------------


def in_rows(observations: dict[str, Any], static: Any, t: int) -> dict[str, Any]:
    return {n: v[t] for n, v in observations.items() if n not in static}


@pytest.mark.parametrize("merging", RULES)
def test_rows_one_by_one_give_the_same(merging: str) -> None:
    for seed in SEEDS:
        case = random_switching_dbn(seed)
        engine = SwitchingKalmanFilter(merging)
        whole = bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=engine)
        known = case.dbn.static_nodes
        belief = engine.start(
            case.dbn, static={n: v for n, v in case.observations.items() if n in known}
        )
        for t in range(case.steps):
            inputs = {n: v[t] for n, v in case.inputs.items()}
            belief = engine.step(belief, in_rows(case.observations, known, t), inputs=inputs)
            if t == 1:  # pickles travel without functions
                static = {"belief": pickle.loads(pickle.dumps(belief))}
                belief = engine.start(case.dbn, **static)
            for name in case.hidden:
                if name in finite(case):
                    assert off(belief.probabilities(name), whole.probabilities(name)[t]) < 1e-9
                else:
                    assert off(belief.mean(name), whole.mean(name)[t]) < 1e-9
                    assert off(belief.var(name), whole.var(name)[t]) < 1e-9
        assert off(belief.log_marginal_likelihood, whole.log_marginal_likelihood) < 1e-9


def test_lags_lie_between_filter_and_smoother() -> None:
    for seed in SEEDS:
        case = random_switching_dbn(seed)
        options: dict[str, Any] = {"inputs": case.inputs, "engine": SwitchingKalmanFilter()}
        filtered = bmc.filter(case.dbn, case.observations, **options)
        smoothed = bmc.smooth(case.dbn, case.observations, **options)
        for lag, wanted in ((0, filtered), (case.steps, smoothed)):
            found = bmc.smooth(case.dbn, case.observations, lag=lag, **options)
            for name in (n for n in case.hidden if n not in finite(case)):
                assert off(found.mean(name), wanted.mean(name)) < 1e-12
                assert off(found.var(name), wanted.var(name)) < 1e-12
        one = bmc.smooth(case.dbn, case.observations, lag=1, **options)
        cut = {n: v if n in case.dbn.static_nodes else v[:2] for n, v in case.observations.items()}
        inputs = {n: v[:2] for n, v in case.inputs.items()}
        if any(np.isnan(v).all() for v in cut.values()):
            continue
        short = bmc.smooth(case.dbn, cut, inputs=inputs, engine=options["engine"])
        for name in (n for n in case.hidden if n in short.names and n not in finite(case)):
            assert off(one.mean(name)[0], short.mean(name)[0]) < 1e-10


def regimes(counted: bool = True) -> bmc.DynamicBayesNet:
    """A level whose drift and noise switch, with a sensor of the regime that is often missing."""
    dbn = bmc.DynamicBayesNet("regimes")
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.3, 0.7]], ("calm", "rough"), initial=[0.6, 0.4])
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(
            0.9 * x_prev + (s == "rough"), np.where(s == "rough", 1.5, 0.2)
        ),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    dbn.table("alarm", ["s"], [[0.8, 0.2], [0.3, 0.7]])
    if counted:
        dbn.add("count", lambda s: bmc.Poisson(np.where(s == "rough", 4.0, 1.0)))
    return dbn


ROWS = {
    "y": np.array([0.1, 0.4, np.nan, 2.5]),
    "alarm": np.array([0.0, np.nan, 1.0, np.nan]),
    "count": np.array([1.0, np.nan, np.nan, 5.0]),
}


def test_what_nothing_reads_is_averaged_over_where_it_is_missing() -> None:
    dbn = regimes()
    found = bmc.filter(dbn, ROWS, engine=SwitchingKalmanFilter())
    rough = found.probabilities("s")[:, 1]
    alarm = found.probabilities("alarm")
    np.testing.assert_allclose(alarm[[1, 3], 1], (0.2 + 0.5 * rough)[[1, 3]])
    np.testing.assert_array_equal(alarm[[0, 2]], [[1.0, 0.0], [0.0, 1.0]])
    count = 1 + 3 * rough
    np.testing.assert_allclose(found.mean("count"), [1.0, count[1], count[2], 5.0])
    np.testing.assert_allclose(found.var("count")[1], count[1] + 9 * rough[1] * (1 - rough[1]))
    two = {n: ROWS[n][:2] for n in ("y", "alarm")}
    right = exact(regimes(counted=False), two)
    short = bmc.filter(regimes(counted=False), two, engine=SwitchingKalmanFilter())
    assert off(short.log_marginal_likelihood, right.log_marginal_likelihood) < 1e-10
    with pytest.raises(UnsupportedError, match="averaged over"):
        found.expectation(lambda count: count)


def test_a_forecast_goes_on_from_the_last_row() -> None:
    """Two slices are exact, the second of which is ahead."""
    dbn, rows = regimes(counted=False), {"y": np.array([0.3]), "alarm": np.array([1.0])}
    ahead = bmc.forecast(dbn, rows, steps=2, engine=SwitchingKalmanFilter())
    right = exact(dbn, {n: np.append(v, np.nan) for n, v in rows.items()})
    for name in ("x", "y"):
        assert off(ahead.mean(name)[0], right.mean(name)[1]) < 1e-10
        assert off(ahead.var(name)[0], right.var(name)[1]) < 1e-10
    for name in ("s", "alarm"):
        assert off(ahead.probabilities(name)[0], right.probabilities(name)[1]) < 1e-10
    assert ahead.quantile("x", [0.1, 0.9]).shape == (2, 2) and ahead.cov("x", "y").shape == (
        2,
        2,
        2,
    )


# ---- what is asked of a slice -------------------------------------------------------------------


def test_quantiles_functions_and_covariances_are_those_of_the_mixture() -> None:
    dbn, rows = regimes(counted=False), {n: ROWS[n] for n in ("y", "alarm")}
    options: dict[str, Any] = {"engine": SwitchingKalmanFilter()}
    found = bmc.filter(dbn, rows, **options)
    asked = {
        "square": lambda x: x**2,
        "both": lambda x, s: (x > 1.0) & (s == "rough"),
        "y": lambda x, y: x * y,
    }
    with_queries = bmc.filter(dbn, rows, queries=asked, **options)
    np.testing.assert_allclose(
        with_queries.queries["square"], found.mean("x") ** 2 + found.var("x"), rtol=1e-9
    )
    np.testing.assert_allclose(with_queries.queries["both"], found.probability(asked["both"]))
    weights = found.probabilities("s")
    by_mode = [found.expectation(lambda x, s, k=k: x * (s == k)) for k in ("calm", "rough")]
    np.testing.assert_allclose(sum(by_mode), found.mean("x"), rtol=1e-9)
    centres = np.stack(by_mode, axis=1) / weights
    spread = [found.expectation(lambda x, s, k=k: x**2 * (s == k)) for k in ("calm", "rough")]
    scales = np.sqrt(np.stack(spread, axis=1) / weights - centres**2)
    mixture = bmc.Mixture(weights, bmc.Normal(centres, scales))
    levels = [0.05, 0.5, 0.95]
    wanted = np.stack([mixture.ppf(level) for level in levels], axis=1)
    np.testing.assert_allclose(found.quantile("x", levels), wanted, rtol=1e-6)
    joint = found.cov("x", "y")
    product = with_queries.queries["y"] - found.mean("x") * found.mean("y")
    np.testing.assert_allclose(joint[:, 0, 1], product, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(joint[:, 0, 0], found.var("x"))
    with pytest.raises(QueryError, match="is finite"):
        found.cov("x", "s")


def test_plates_that_never_meet_have_modes_of_their_own() -> None:
    """Together they are what each is by itself."""
    table, drift = np.array([[0.8, 0.2], [0.3, 0.7]]), np.array([0.0, 2.0])

    def declared(**plates: Any) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet(plates={"site": 3} if plates else None)
        dbn.table("s", ["s_prev"], table, initial=[0.5, 0.5], **plates)
        dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + drift[s], 0.3 + drift[s]),
                initial=bmc.Normal(0.0, 1.0), **plates)  # fmt: skip
        dbn.add("y", lambda x: bmc.Normal(x, 0.5), **plates)
        return dbn

    y = np.cumsum(np.random.default_rng(0).normal(size=(8, 3)) ** 2, axis=0)
    y[3, 1] = np.nan
    engine = SwitchingKalmanFilter()
    whole = bmc.smooth(declared(plates="site"), {"y": y}, engine=engine)
    assert whole.log_marginal_likelihood.shape == (3,)
    for k in range(3):
        one = bmc.smooth(declared(), {"y": y[:, k]}, engine=engine)
        assert off(whole.log_marginal_likelihood[k], one.log_marginal_likelihood) < 1e-10
        assert off(whole.mean("x")[:, k], one.mean("x")) < 1e-10
        assert off(whole.probabilities("s")[:, k], one.probabilities("s")) < 1e-10
        assert off(whole.quantile("x", 0.2)[:, k], one.quantile("x", 0.2)) < 1e-8


# ---- linear where asked -------------------------------------------------------------------------


def test_linearised_slices_are_those_of_the_extended_filter() -> None:
    """Of one mode; of linear templates they are the same as without."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 0.3), initial=bmc.Normal(0.5, 0.5))
    dbn.add("y", lambda x: bmc.Normal(np.exp(x), 0.2))
    rows = {"y": [1.1, np.nan, 2.0, 1.4]}
    for ask in (bmc.filter, bmc.smooth):
        one = ask(dbn, rows, engine=SwitchingKalmanFilter(linearize=True))
        two = ask(dbn, rows, engine=bmc.ExtendedKalmanFilter())
        assert off(one.mean("x"), two.mean("x")) < 1e-10
        assert off(one.var("x"), two.var("x")) < 1e-10
        assert off(one.log_marginal_likelihood, two.log_marginal_likelihood) < 1e-10
    dbn.add(
        "z", lambda x: bmc.Gamma(9.0, 9.0 / np.exp(x))
    )  # missing now and then, it tells nothing then
    rows["z"] = [1.0, 0.7, np.nan, 2.0]
    one = bmc.smooth(dbn, rows, engine=SwitchingKalmanFilter(linearize=True))
    two = bmc.smooth(dbn, rows, engine=bmc.ExtendedKalmanFilter())
    assert off(one.mean("x"), two.mean("x")) < 1e-10 and off(one.mean("z"), two.mean("z")) < 1e-10
    rows = {n: ROWS[n] for n in ("y", "alarm")}
    for rule in RULES:
        given = [
            bmc.smooth(
                regimes(counted=False), rows, engine=SwitchingKalmanFilter(rule, linearize=on)
            )
            for on in (True, False)
        ]
        assert off(given[0].mean("x"), given[1].mean("x")) < 1e-10
        assert off(given[0].probabilities("s"), given[1].probabilities("s")) < 1e-10


# ---- refusals, choice ---------------------------------------------------------------------------


def test_modes_that_depend_on_hidden_numbers_are_refused_by_name() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("s", lambda x_prev: bmc.Bernoulli(logits=x_prev), initial=bmc.Bernoulli(0.5))
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    for linearize in (False, True):
        engine = SwitchingKalmanFilter(linearize=linearize)
        why = engine.unsupported(dbn, {"y": [0.0, 1.0]})
        assert why is not None and "'s' depends on continuous nodes that are hidden" in why
        with pytest.raises(UnsupportedError, match="'s' depends on continuous"):
            engine.step(engine.step(engine.start(dbn), {"y": 0.0}), {"y": 0.0})


def test_what_is_not_linear_is_refused_and_linearize_named() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.1, 0.9]], initial=[0.5, 0.5])
    dbn.add(
        "x", lambda x_prev, s: bmc.Normal(np.sin(x_prev) + s, 1.0), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(UnsupportedError, match=r"not known to be affine.*linearize=True"):
        bmc.filter(dbn, {"y": [0.0, 1.0]}, engine=SwitchingKalmanFilter())
    assert (
        bmc.filter(dbn, {"y": [0.0, 1.0]}, engine=SwitchingKalmanFilter(linearize=True)).steps == 2
    )
    with pytest.raises(UnsupportedError, match="does not find the most likely"):
        bmc.most_likely(dbn, {"y": [0.0]}, engine=SwitchingKalmanFilter(linearize=True))
    why = bmc.KalmanFilter().unsupported(dbn, {"y": [0.0, 1.0]})
    assert why is not None and "SwitchingKalmanFilter" in why


def test_too_many_modes_are_refused_with_their_number() -> None:
    dbn = bmc.DynamicBayesNet(plates={"k": 4})
    dbn.table("s", ["s_prev"], np.full((3, 3), 1 / 3), initial=np.full(3, 1 / 3), plates="k")
    dbn.add(
        "x", lambda x_prev, s: bmc.Normal(x_prev + s.sum("k"), 1.0), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(UnsupportedError, match=r"81 joint states .* max_modes=64"):
        bmc.filter(dbn, {"y": [0.0]}, engine=SwitchingKalmanFilter())
    assert (
        bmc.filter(dbn, {"y": [0.0]}, engine=SwitchingKalmanFilter("imm", max_modes=81)).steps == 1
    )


@pytest.mark.parametrize(
    "options", [{"merging": "gpb3"}, {"linearize": 1}, {"max_modes": 0}, {"max_modes": True}]
)
def test_bad_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        SwitchingKalmanFilter(**options)


def test_a_row_that_no_mode_can_have_is_refused_and_the_rest_handed_over() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.5, 0.5], [0.5, 0.5]], initial=[0.5, 0.5])
    dbn.table("o", ["s"], [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0]])
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(ZeroProbabilityError, match="slice 2") as caught:
        bmc.filter(dbn, {"y": [0.0, 1.0, 1.0], "o": [0, 1, 2]}, engine=SwitchingKalmanFilter())
    assert caught.value.filtered.steps == 2
    assert caught.value.filtered.probabilities("s")[1].tolist() == [0.0, 1.0]


def test_modes_that_cannot_be_are_left_out() -> None:
    """A counter of slices since a change: of 8 x 2 states few follow each other."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("new", [], [0.8, 0.2])
    dbn.add("age", lambda age_prev, new: np.where(new == 1, 0, np.minimum(age_prev + 1, 3)),
            initial=lambda new: 0 * new)  # fmt: skip
    dbn.add(
        "x",
        lambda x_prev, age: bmc.Normal(x_prev, np.where(age == 0, 3.0, 0.2)),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    rows = {"y": [0.0, 0.1, 4.0, 4.2]}
    right = exact(dbn, rows)
    found = bmc.filter(dbn, rows, engine=SwitchingKalmanFilter(max_modes=8))
    assert abs(found.log_marginal_likelihood - right.log_marginal_likelihood) < 0.01
    np.testing.assert_allclose(found.probabilities("age").sum(axis=-1), 1.0)
    assert "5 states" in bmc.explain(dbn, rows, engine=SwitchingKalmanFilter()).nodes["age"]


def test_it_is_chosen_for_switching_templates_and_says_what_it_is() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.1, 0.9]], initial=[0.5, 0.5])
    covs = np.array([1.0, 4.0])[:, None, None] * np.eye(2)
    start = bmc.MvNormal(np.zeros(2), np.eye(2))
    dbn.add("x", lambda x_prev, s: bmc.MvNormal(0.9 * x_prev, covs[s]), initial=start)
    dbn.add("y", lambda x: bmc.Normal(x[..., 0], 1.0))
    found = bmc.explain(dbn, {"y": [0.0, 1.0, 2.0]})
    assert isinstance(found.engine, SwitchingKalmanFilter) and found.engine.merging == "gpb2"
    assert "approximation of unknown error" in str(found)
    assert bmc.filter(dbn, {"y": [0.0, 1.0, 2.0]}).log_marginal_likelihood_mcse is None


@pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")
@pytest.mark.parametrize("merging", RULES)
def test_machine_code_gives_the_same(merging: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of random templates, and of one without noise in its readings, which it leaves to NumPy."""
    singular = bmc.DynamicBayesNet()
    singular.table("mode", ["mode_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    singular.add("a", lambda a_prev: bmc.Normal(0.9 * a_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    singular.add("b", lambda b_prev: bmc.Normal(b_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    singular.add("y", lambda a, b, mode: bmc.Normal(a + b + 3.0 * mode, 0.0))
    rows = {"y": np.random.default_rng(0).normal(size=6)}
    made = [random_switching_dbn(seed) for seed in SEEDS]
    cases = [(c.dbn, c.observations, c.inputs) for c in made] + [(singular, rows, {})]
    compiled = 0
    for dbn, observations, inputs in cases:
        found = []
        for least in (1, 10**9):
            monkeypatch.setattr(run, "_LONG", least)
            engine = SwitchingKalmanFilter(merging)
            compiled += "machine code" in str(
                bmc.explain(dbn, observations, engine=engine, inputs=inputs)
            )
            found.append(bmc.smooth(dbn, observations, inputs=inputs, engine=engine))
        one, two = found
        assert off(one.log_marginal_increments, two.log_marginal_increments) < 1e-10
        for name in one.names:
            if dbn[name].is_discrete:
                assert off(one.probabilities(name), two.probabilities(name)) < 1e-10
            else:
                assert off(one.mean(name), two.mean(name)) < 1e-10
                assert off(one.var(name), two.var(name)) < 1e-10
    assert compiled > len(cases) / 3
