"""``ExpectationPropagation`` over time against exact conditioning, kept figures, a plain loop in moments."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import ExpectationPropagation, SwitchingKalmanFilter
from bayesmc.auto import switching
from bayesmc.errors import ConvergenceWarning, EngineWarning, UnsupportedError
from bayesmc.testing import exact, session
from bayesmc.testing.makers.switching_dbns import random_switching_dbn
from tests.engines.test_switching import answered, figures, finite, off, read, rows_of, template

EP = ExpectationPropagation()
#: for answers that are exact
SETTLED = ExpectationPropagation(tolerance=1e-10)


# ---- exact where it must be ---------------------------------------------------------------------


@pytest.mark.parametrize("difference", [0.0, 1.0])
def test_exact_where_modes_make_no_difference_and_with_two_slices(difference: float) -> None:
    """With two slices nothing is collapsed before it is asked for."""
    asked = 0
    for seed in range(session.scaled(6, 10)):
        if difference:
            case = random_switching_dbn(seed)
            static = case.dbn.static_nodes
            rows = {n: v if n in static else v[:2] for n, v in case.observations.items()}
            inputs = {n: v[:2] for n, v in case.inputs.items()} or None
            try:
                right = exact(case.dbn, rows, inputs)
            except UnsupportedError:
                continue
        else:
            case, right = answered(seed, 0.0)
            rows, inputs = case.observations, case.inputs or None
            if right is None:
                continue
        found = bmc.smooth(case.dbn, rows, inputs=inputs, engine=SETTLED)
        assert np.all(found.converged) and not np.any(found.skipped)
        log = np.sum(found.log_marginal_likelihood) + right.log_static
        assert off(log, right.log_marginal_likelihood) < 1e-8, seed
        hidden = [n for n in case.hidden if n in found.names]
        for one, two in zip(
            figures(found, hidden, finite(case)), figures(right, hidden, finite(case)), strict=True
        ):
            assert off(one, two) < 1e-7, (seed, case.dbn)
        asked += 1
    assert asked >= session.scaled(3, 4)


def test_random_templates_are_nearer_than_with_kims_smoother() -> None:
    """Bounds are some four times what 24 templates gave: 5e-5 and 1.6e-5 on average; GPB2: .0018, .011."""
    logs, modes, kim, numbers = [], [], [], []
    for seed in range(session.scaled(8, 10)):
        case, right = answered(seed, 1.0)
        if right is None:
            continue
        both = [
            bmc.smooth(case.dbn, case.observations, inputs=case.inputs, engine=engine)
            for engine in (EP, SwitchingKalmanFilter())
        ]
        assert np.all(both[0].converged)
        log = np.sum(both[0].log_marginal_likelihood) + right.log_static
        logs.append(abs(float(log - right.log_marginal_likelihood)))
        wrong = [np.abs(f.probabilities("mode") - right.probabilities("mode")).mean() for f in both]
        modes.append(wrong[0])
        kim.append(wrong[1])
        names = [n for n in case.hidden if n not in finite(case)]
        numbers.append(
            [max((off(f.mean(n), right.mean(n)) for n in names), default=0.0) for f in both]
        )
    assert np.mean(logs) < 2e-4 and np.mean(modes) < 7e-5, (logs, modes)
    assert np.mean(modes) < 0.05 * np.mean(kim)
    assert np.mean(numbers, axis=0)[0] < 0.1 * np.mean(numbers, axis=0)[1]


def test_vague_starts_lose_no_digits() -> None:
    dbn, plain = bmc.DynamicBayesNet(), bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.4, 0.6]], initial=[0.5, 0.5])
    for net in (dbn, plain):
        net.add("v", lambda v_prev: bmc.Normal(v_prev, 0.1), initial=bmc.Normal(0.0, 1e7))
        net.add(
            "x",
            lambda x_prev, v_prev: bmc.Normal(x_prev + v_prev, 0.1),
            initial=bmc.Normal(0.0, 1e7),
        )
    dbn.add("y", lambda x, s: bmc.Normal(x + 0.0 * s, 0.5))
    plain.add("y", lambda x: bmc.Normal(x, 0.5))
    rows = {"y": [1.0, 2.5, 2.9, np.nan, 5.2]}
    one = bmc.smooth(dbn, rows, engine=SETTLED)
    two = bmc.smooth(plain, rows, engine=bmc.KalmanFilter())
    assert one.converged
    assert off(one.log_marginal_increments, two.log_marginal_increments) < 1e-7
    for name in ("x", "v"):
        assert off(one.mean(name), two.mean(name)) < 1e-7
        assert off(one.var(name), two.var(name)) < 1e-7


# ---- kept figures -------------------------------------------------------------------------------


def test_slds_suite(reference_data: Path) -> None:
    logs, modes = [], []
    for held in read(reference_data, "slds_suite")[:-1]:
        dbn, rows = template(held["model"]), rows_of(held["y"])
        found = bmc.smooth(dbn, rows, engine=EP)
        assert found.converged
        kim = bmc.smooth(dbn, rows, engine=SwitchingKalmanFilter())
        wrong, before = (
            np.abs(f.probabilities("s")[1:] - held["smoothed_mode"]).mean() for f in (found, kim)
        )
        assert wrong < before
        logs.append(abs(found.log_marginal_likelihood - held["loglik"]))
        modes.append(wrong)
        assert abs(found.log_marginal_increments.sum() - found.log_marginal_likelihood) < 1e-9
    assert np.mean(logs) <= 0.003 and np.mean(modes) <= 0.0015


def test_what_does_not_settle_is_a_warning_that_says_by_how_much(reference_data: Path) -> None:
    """The last model of the suite, whose messages become improper."""
    held = read(reference_data, "slds_suite")[-1]
    dbn, rows = template(held["model"]), rows_of(held["y"])
    for damping in (0.0, 0.2):
        with pytest.warns(ConvergenceWarning, match="have not settled .* changed a belief by"):
            found = bmc.smooth(dbn, rows, engine=ExpectationPropagation(damping=damping))
        assert not found.converged and found.skipped > 0
        assert np.isfinite(found.mean("x")).all() and np.isfinite(found.probabilities("s")).all()
    with pytest.warns(ConvergenceWarning, match="settled, but .* taken back .* far off"):
        found = bmc.smooth(dbn, rows, engine=EP)  # which finds a damping with which they settle
    assert found.converged and found.damping > 0.2
    wrong = np.abs(found.probabilities("s")[1:] - held["smoothed_mode"]).mean()
    kim = bmc.smooth(dbn, rows, engine=SwitchingKalmanFilter()).probabilities("s")[1:]
    assert wrong < np.abs(kim - held["smoothed_mode"]).mean()
    engine = ExpectationPropagation(damping=0.7, sweeps=400)
    steady = bmc.smooth(dbn, rows, engine=engine)
    assert steady.converged and np.isfinite(steady.log_marginal_likelihood)
    with pytest.warns(ConvergenceWarning, match="changed a belief by"):
        short = bmc.smooth(dbn, rows, engine=ExpectationPropagation(sweeps=2, damping=0.7))
    assert short.sweeps == 2 and short.change > 1e-5


def test_smooth_without_an_engine_passes_messages_or_says_that_it_is_kims_answer() -> None:
    """Two numbers, of which no grid is made; by exact conditioning Kim's smoother is off by .08."""
    follow = [[0.95, 0.05], [0.2, 0.8]]
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], follow, initial=[0.8, 0.2])
    dbn.add(
        "v", lambda v_prev, s: bmc.Normal(0.9 * v_prev, 0.05 + 0.45 * s), initial=bmc.Normal(0, 1)
    )
    dbn.add(
        "x", lambda x_prev, v, s: bmc.Normal(x_prev + v, 0.1 + 0.9 * s), initial=bmc.Normal(0, 1)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.3))
    rows = {"y": [0.1, 0.0, 0.3, None, 2.6, 1.1]}
    found, kim = (bmc.smooth(dbn, rows, engine=e) for e in (None, SwitchingKalmanFilter()))
    right = bmc.infer(dbn, rows, engine=bmc.Exact())
    assert found.converged
    wrong, before = (
        max(
            np.abs(f.probabilities("s")[t] - right.probabilities(f"s[{t}]")).max() for t in range(6)
        )
        for f in (found, kim)
    )
    assert wrong < 0.02 and wrong < 0.3 * before, (wrong, before)
    exact_tell = bmc.DynamicBayesNet()  # messages about x would be infinite
    exact_tell.table("s", ["s_prev"], follow, initial=[0.5, 0.5])
    exact_tell.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 0.5), initial=bmc.Normal(0.0, 1.0))
    exact_tell.add("z", lambda z_prev: bmc.Normal(z_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    exact_tell.add(
        "y", lambda x_prev: bmc.Normal(x_prev, 0.0), initial=lambda x: bmc.Normal(x, 1.0)
    )
    with pytest.warns(EngineWarning, match="SwitchingKalmanFilter answers .*without noise"):
        found = bmc.smooth(exact_tell, {"y": [0.1, 0.3, 0.2]})
    assert np.isfinite(found.mean("x")).all()


def test_long_series_are_kims_by_default_and_explain_says_why(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The price is counted before anything is passed."""
    dbn, rows = jumping(), {"y": np.zeros(30)}
    dbn.add("z", lambda z_prev: bmc.Normal(z_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    assert "ExpectationPropagation(sweeps=200" in str(bmc.explain(dbn, rows, question="smooth"))
    monkeypatch.setattr(switching, "_BUDGET", 1000)
    assert "ExpectationPropagation(sweeps=32" in str(bmc.explain(dbn, rows, question="smooth"))
    monkeypatch.setattr(switching, "_BUDGET", 300)
    told = bmc.explain(dbn, rows, question="smooth")
    assert isinstance(told.engine, SwitchingKalmanFilter)
    assert "30 slices would take too long" in told.refused["ExpectationPropagation"]
    for question in ("filter", "fixed-lag"):
        assert isinstance(bmc.explain(dbn, rows, question=question).engine, SwitchingKalmanFilter)


def test_real_gnp_as_particles_have_it(reference_data: Path) -> None:
    """GPB2, the published figure, is off by .2; lags that repeat make covariances singular."""
    held = read(reference_data, "kim1994")
    found = bmc.smooth(template(held["model"]), rows_of(held["y"]), engine=EP)
    log = found.log_marginal_increments[1 + held["burn"] :].sum()
    assert found.converged and abs(log - held["rbpf_loglik_mean"]) < 0.05


# ---- a plain loop ------------------------------------------------------------------------------


def by_hand(model: dict[str, Any], y: np.ndarray, sweeps: int) -> tuple[float, np.ndarray]:
    """Messages about (s_t, x_t) as precisions by loops over modes (Heskes and Zoeter 2002).

    One number; the start is before the first row. Log evidence and smoothed probabilities of modes.
    """
    p, pi, a, c, q, h, r = (np.asarray(model[k]) for k in ("P", "pi", "a", "c", "q", "h", "r"))
    k, steps = len(pi), len(y)
    one = np.zeros((k, 3))  # log, linear, precision
    start = np.column_stack([np.log(pi) - 0.5 * np.log(2 * np.pi), np.zeros(k), np.ones(k)])
    alpha, beta = [start, *[one] * steps], [one] * (steps + 1)

    def two_slices(t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        log, mean, cov = np.empty((k, k)), np.empty((k, k, 2)), np.empty((k, k, 2, 2))
        for i in range(k):
            for j in range(k):
                g = np.array([-a[j], 1.0])
                precision = np.outer(g, g) / q[j] + np.diag([0.0, h**2 / r[j]])
                linear = g * c[j] / q[j] + np.array([0.0, h * y[t - 1] / r[j]])
                precision += np.diag([alpha[t - 1][i, 2], beta[t][j, 2]])
                linear += [alpha[t - 1][i, 1], beta[t][j, 1]]
                cov[i, j] = np.linalg.inv(precision)
                mean[i, j] = cov[i, j] @ linear
                log[i, j] = np.log(p[i, j]) + alpha[t - 1][i, 0] + beta[t][j, 0]
                log[i, j] -= 0.5 * (c[j] ** 2 / q[j] + y[t - 1] ** 2 / r[j])
                log[i, j] -= 0.5 * np.log(q[j] * r[j]) - 0.5 * np.linalg.slogdet(cov[i, j])[1]
                log[i, j] += 0.5 * linear @ mean[i, j]
        return log, mean, cov

    def collapsed(log: np.ndarray, mean: np.ndarray, var: np.ndarray) -> np.ndarray:
        """Over the first axis, in natural parameters."""
        total = np.logaddexp.reduce(log, axis=0)
        share = np.exp(log - total)
        m = (share * mean).sum(axis=0)
        v = (share * (var + (mean - m) ** 2)).sum(axis=0)
        return np.column_stack([total - 0.5 * (np.log(2 * np.pi * v) + m**2 / v), m / v, 1 / v])

    def integral(message: np.ndarray) -> float:
        g, b, w = message.T
        return float(np.logaddexp.reduce(g + 0.5 * b**2 / w + 0.5 * np.log(2 * np.pi / w)))

    for _ in range(sweeps):
        for t in range(1, steps + 1):
            log, mean, cov = two_slices(t)
            alpha[t] = collapsed(log, mean[..., 1], cov[..., 1, 1]) - beta[t]
        for t in range(steps, 0, -1):
            log, mean, cov = two_slices(t)
            beta[t - 1] = collapsed(log.T, mean[..., 0].T, cov[..., 0, 0].T) - alpha[t - 1]
    total = sum(np.logaddexp.reduce(two_slices(t)[0], axis=(0, 1)) for t in range(1, steps + 1))
    total -= sum(integral(alpha[t] + beta[t]) for t in range(1, steps))
    weights = []
    for t in range(1, steps + 1):
        log = np.logaddexp.reduce(two_slices(t)[0], axis=0)
        weights.append(np.exp(log - np.logaddexp.reduce(log)))
    return total, np.array(weights)


def test_a_plain_loop_ends_at_the_same_point() -> None:
    compared = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        k = 2 + seed % 2
        model = {
            "P": rng.dirichlet(np.ones(k), size=k), "pi": rng.dirichlet(np.ones(k)),
            "a": rng.uniform(-0.9, 0.9, k), "c": rng.normal(size=k), "h": 1.0,
            "q": rng.uniform(0.2, 1.5, k), "r": rng.uniform(0.2, 1.5, k),
        }  # fmt: skip
        a, c, q, r = (model[n] for n in "acqr")
        y = rng.normal(0.0, 1.5, size=7)
        dbn = bmc.DynamicBayesNet()
        dbn.table("s", ["s_prev"], model["P"], initial=model["pi"])
        dbn.add(
            "x",
            lambda x_prev, s, a=a, c=c, q=q: bmc.Normal(a[s] * x_prev + c[s], np.sqrt(q)[s]),
            ["x_prev", "s"],
            initial=bmc.Normal(0.0, 1.0),
        )
        dbn.add("y", lambda x, s, r=r: bmc.Normal(x, np.sqrt(r)[s]), ["x", "s"])
        engine = ExpectationPropagation(tolerance=1e-9, sweeps=300)
        found = bmc.smooth(dbn, {"y": np.concatenate([[np.nan], y])}, engine=engine)
        if not found.converged:
            continue
        log, weights = by_hand(model, y, 60)
        assert abs(found.log_marginal_likelihood - log) < 1e-7, seed
        np.testing.assert_allclose(found.probabilities("s")[1:], weights, atol=1e-7)
        compared += 1
    assert compared >= 5


# ---- filtering, plates, numbers that nothing carries on --------------------------------------------


def test_filter_and_forecast_are_the_first_pass_forward() -> None:
    for seed in range(4):
        case = random_switching_dbn(seed)
        for ask, more in ((bmc.filter, {}), (bmc.forecast, {"steps": 2})):
            if more and case.inputs:
                continue
            one, two = (
                ask(case.dbn, case.observations, inputs=case.inputs, engine=engine, **more)
                for engine in (EP, SwitchingKalmanFilter("gpb2"))
            )
            for a, b in zip(
                figures(one, case.hidden, finite(case)),
                figures(two, case.hidden, finite(case)),
                strict=True,
            ):
                np.testing.assert_array_equal(a, b)
            np.testing.assert_array_equal(one.log_marginal_increments, two.log_marginal_increments)


def jumping(plates: dict[str, int] | None = None) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet(plates=plates)
    within = {"plates": list(plates or {})}
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.4, 0.6]], initial=[0.5, 0.5], **within)
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(0.9 * x_prev, 0.2 + 1.5 * s),
        initial=bmc.Normal(0.0, 1.0),
        **within,
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.4), **within)
    return dbn


def test_elements_of_plates_have_messages_of_their_own() -> None:
    rng = np.random.default_rng(3)
    rows = rng.normal(0.0, 2.0, size=(8, 3))
    rows[4, 1] = np.nan
    whole = bmc.smooth(jumping({"site": 3}), {"y": rows}, engine=SETTLED)
    assert whole.converged.shape == whole.change.shape == whole.skipped.shape == (3,)
    for k in range(3):
        one = bmc.smooth(jumping(), {"y": rows[:, k]}, engine=SETTLED)
        assert whole.converged[k] and one.converged
        assert off(whole.log_marginal_likelihood[k], one.log_marginal_likelihood) < 1e-6
        assert off(whole.mean("x")[:, k], one.mean("x")) < 1e-6
        assert off(whole.probabilities("s")[:, k], one.probabilities("s")) < 1e-6


def test_all_that_switching_posteriors_answer() -> None:
    rows = {"y": np.array([0.1, np.nan, 4.0, 3.1, -2.0])}
    found = bmc.smooth(jumping(), rows, engine=EP, queries={"both": lambda x, s: x * s})
    right = exact(jumping(), rows)
    low, high = found.quantile("x", [0.1, 0.9]).T
    assert (low < right.mean("x")).all() and (right.mean("x") < high).all()
    assert found.cov("x").shape == (5, 1, 1)
    assert off(found.probability(lambda x, s: (x > 1.0) & (s == 1)).shape, (5,)) == 0
    assert off(found.queries["both"], found.expectation(lambda x, s: x * s)) < 1e-12
    assert off(found.mean("y"), right.mean("y")) < 0.01  # missing, and carried on by nothing
    assert off(found.var("y"), right.var("y")) < 0.01
    one = bmc.smooth(jumping(), {"y": [0.3]}, engine=EP)
    assert one.converged and one.steps == 1
    assert off(one.mean("x"), exact(jumping(), {"y": np.array([0.3])}).mean("x")) < 1e-9


def test_modes_that_may_not_follow_are_left_out() -> None:
    """A state that is left for ever, one that is never come to first, a last row that rules one out."""
    dbn = bmc.DynamicBayesNet()
    table = [[0.7, 0.3, 0.0], [0.0, 0.6, 0.4], [0.0, 0.0, 1.0]]
    dbn.table("s", ["s_prev"], table, initial=[1.0, 0.0, 0.0])
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(0.8 * x_prev + s, 0.3 + 0.2 * s),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    dbn.table("o", ["s"], [[1.0, 0.0], [1.0, 0.0], [0.5, 0.5]])
    for last in (0.0, 1.0):
        rows = {"y": np.array([0.1, 0.5, 1.4, 2.5]), "o": np.array([np.nan, np.nan, np.nan, last])}
        found = bmc.smooth(dbn, rows, engine=EP)
        right = exact(dbn, rows)
        assert found.converged and not found.skipped
        assert off(found.log_marginal_likelihood, right.log_marginal_likelihood) < 2e-3
        assert off(found.probabilities("s"), right.probabilities("s")) < 2e-3
        assert (found.probabilities("s")[right.probabilities("s") == 0] == 0).all()
        assert off(found.mean("x"), right.mean("x")) < 2e-3


def test_modes_without_numbers_are_exact() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.7, 0.3], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("y", lambda s: bmc.Normal(2.0 * s, 1.0))
    rows = {"y": [0.1, 1.2, None, 2.0]}
    found, right = bmc.smooth(dbn, rows, engine=SETTLED), bmc.smooth(dbn, rows)
    assert off(found.log_marginal_likelihood, right.log_marginal_likelihood) < 1e-9
    assert off(found.probabilities("s"), right.probabilities("s")) < 1e-9


def test_functions_are_linearised_on_the_way_forward() -> None:
    dbn = jumping()
    plain = bmc.smooth(dbn, {"y": [0.1, 2.0, -1.0]}, engine=EP)
    linear = bmc.smooth(dbn, {"y": [0.1, 2.0, -1.0]}, engine=ExpectationPropagation(linearize=True))
    assert off(plain.mean("x"), linear.mean("x")) < 1e-6
    bent = bmc.DynamicBayesNet()
    bent.table("s", ["s_prev"], [[0.9, 0.1], [0.4, 0.6]], initial=[0.5, 0.5])
    bent.add("x", lambda x_prev, s: bmc.Normal(x_prev, 0.1 + s), initial=bmc.Normal(0.0, 1.0))
    bent.add("y", lambda x: bmc.Normal(np.tanh(x), 0.4))
    with pytest.raises(UnsupportedError, match=r"ExpectationPropagation\(linearize=True\)"):
        bmc.smooth(bent, {"y": [0.1]}, engine=EP)
    found = bmc.smooth(bent, {"y": [0.1, 0.5]}, engine=ExpectationPropagation(linearize=True))
    assert np.isfinite(found.mean("x")).all()


# ---- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"sweeps": 0}, {"sweeps": 1.5}, {"sweeps": True}, {"damping": 1.0}, {"damping": -0.1},
        {"damping": "some"}, {"tolerance": 0.0}, {"tolerance": np.nan}, {"linearize": 1},
        {"max_modes": 0},
    ],
)  # fmt: skip
def test_options_are_refused_by_name(options: dict[str, Any]) -> None:
    name = next(iter(options))
    with pytest.raises(ValueError, match=rf"ExpectationPropagation\({name}="):
        ExpectationPropagation(**options)


def test_what_it_cannot_do_is_refused_by_name() -> None:
    dbn, rows = jumping(), {"y": [0.1, 0.2, 0.3]}
    with pytest.raises(UnsupportedError, match="ExpectationPropagation .*lag=.*SwitchingKalman"):
        bmc.smooth(dbn, rows, lag=1, engine=EP)
    why = bmc.explain(dbn, rows, engine=EP, question="fixed-lag")
    assert "SwitchingKalmanFilter" in str(why)
    with pytest.raises(UnsupportedError, match="most likely"):
        bmc.most_likely(dbn, rows, engine=EP)
    with pytest.raises(UnsupportedError, match="ExpectationPropagation has no particles"):
        bmc.filter(dbn, rows, keep="particles", engine=EP)
    with pytest.raises(UnsupportedError, match="max_modes=1"):
        bmc.smooth(dbn, rows, engine=ExpectationPropagation(max_modes=1))
    guarded = bmc.DynamicBayesNet()
    guarded.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    guarded.add("s", lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))))
    guarded.add("y", lambda x, s: bmc.Normal(x + s, 1.0))
    why = EP.unsupported(guarded, {"y": [0.0, 1.0]})
    assert why is not None and why.startswith("ExpectationPropagation: ")


def test_families_are_of_nets_and_refused_over_time() -> None:
    engine = ExpectationPropagation(families={"x": "normal"})
    with pytest.raises(UnsupportedError, match=r"families=.*over time"):
        bmc.smooth(jumping(), {"y": [0.1]}, engine=engine)


def test_errors_that_are_not_of_chance_are_not_told_to_be_none() -> None:
    rows = {"y": [0.1, 0.4]}
    for engine in (EP, SwitchingKalmanFilter()):
        assert bmc.smooth(jumping(), rows, engine=engine).mcse("x") is None
        assert bmc.filter(jumping(), rows, engine=engine).mcse("s") is None


def test_numbers_that_later_rows_tell_exactly_are_refused() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x_prev: bmc.Normal(x_prev, 0.0), initial=lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(UnsupportedError, match="rows after slice 0 tell .* without noise"):
        bmc.smooth(dbn, {"y": [0.1, 0.3, 0.2]}, engine=EP)


def test_explain_says_what_it_is() -> None:
    said = str(bmc.explain(jumping(), {"y": [0.1, 0.2]}, engine=EP))
    assert "merged approximately (expectation propagation)" in said
    assert "4 pairs of them a slice" in said and "approximation of unknown error" in said


def test_nothing_is_said_where_messages_settle() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = bmc.smooth(jumping(), {"y": [0.1, 3.0, 2.5]}, engine=EP)
    assert found.converged is True and found.change <= 1e-5 and found.skipped == 0


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_readings_without_noise_tell_numbers_of_a_mode(noise: float) -> None:
    """Nothing is left to merge but what rounding leaves of means that are equal; 0.3: in one mode only."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, s: bmc.Normal(x + s, np.array([0.0, noise])[s]))
    rows = {"y": [0.1, 1.2, 2.0, 0.3, -0.2]}
    found = bmc.smooth(dbn, rows, engine=EP)
    right = bmc.infer(dbn.unroll(5), dbn.unrolled_evidence(rows), engine=bmc.Exact())
    assert found.converged
    assert abs(found.log_marginal_likelihood - right.log_marginal_likelihood) < 1e-3
    for t in range(5):
        assert abs(found.mean("x")[t] - right.mean(f"x[{t}]")) < 1e-3
        assert off(found.probabilities("s")[t], right.probabilities(f"s[{t}]")) < 1e-3
