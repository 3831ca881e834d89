"""Extended and unscented Kalman filters: linear templates, textbook loops, benchmarks, angles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.kalman import levels as kalman_levels
from bayesmc.engines.kalman import passes as kalman_passes
from bayesmc.engines.kalman import rows as kalman_rows
from bayesmc.engines.kalman.extended import ExtendedKalmanFilter
from bayesmc.engines.kalman.filter import KalmanFilter
from bayesmc.engines.kalman.unscented import UnscentedKalmanFilter
from bayesmc.testing.linear_dbns import random_linear_dbn

ENGINES = [
    ExtendedKalmanFilter(),
    UnscentedKalmanFilter(1.0, 0.0, 2.0),
    UnscentedKalmanFilter(0.1, 2.0, 0.0),
]
SHORT = ["ekf", "ukf", "ukf, middle below zero"]


def off(found: Any, wanted: Any) -> float:
    found, wanted = np.asarray(found), np.asarray(wanted)
    return float((np.abs(found - wanted) / (1 + np.abs(wanted))).max(initial=0.0))


@pytest.mark.parametrize("engine", ENGINES, ids=SHORT)
@pytest.mark.parametrize("seed", range(16))
def test_equal_the_kalman_filter_on_linear_templates(seed: int, engine: Any) -> None:
    case = random_linear_dbn(seed)
    asked: list[tuple[Callable[..., Any], dict[str, Any]]] = [
        (bmc.filter, {}),
        (bmc.smooth, {}),
        (bmc.smooth, {"lag": 1}),
    ]
    for call, options in asked:
        found, wanted = (
            call(case.dbn, case.observations, inputs=case.inputs, engine=e, **options)
            for e in (engine, KalmanFilter())
        )
        assert off(found.log_marginal_increments, wanted.log_marginal_increments) < 1e-6
        for name in case.hidden:
            assert off(found.mean(name), wanted.mean(name)) < 1e-6
        assert off(found.cov(*case.hidden), wanted.cov(*case.hidden)) < 1e-6


@pytest.mark.parametrize("engine", ENGINES, ids=SHORT)
@pytest.mark.parametrize("seed", range(4))
def test_row_by_row_equals_all_at_once(seed: int, engine: Any) -> None:
    case = random_linear_dbn(seed)
    filtered = bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=engine)
    static = {n: case.observations[n] for n in case.dbn.static_nodes}
    belief = engine.start(case.dbn, static=static)
    for t in range(case.steps):
        row = {n: v[t] for n, v in case.observations.items() if n not in static}
        belief = engine.step(belief, row, inputs={n: v[t] for n, v in case.inputs.items()})
        for name in case.hidden:
            assert off(belief.mean(name), filtered.mean(name)[t]) < 1e-7
            assert off(belief.var(name), filtered.var(name)[t]) < 1e-7
    assert off(belief.log_marginal_likelihood, filtered.log_marginal_likelihood) < 1e-7


# ---- the growth benchmark of Gordon, Salmond and Smith (1993) ----------------------------------------


def growth(runs: int) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("growth", plates={"run": runs})
    dbn.add("x", lambda x_prev, t: bmc.Normal(move(x_prev, t), np.sqrt(10.0)), plates="run",
            initial=bmc.Normal(0.0, np.sqrt(5.0)))  # fmt: skip
    dbn.add("y", lambda x: bmc.Normal(x**2 / 20, 1.0), plates="run")
    return dbn


def move(x: Any, t: Any) -> Any:
    return 0.5 * x + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * t)


def slope(x: float) -> float:
    return 0.5 + 25 * (1 - x**2) / (1 + x**2) ** 2


def textbook_extended(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Means and variances given all rows so far, then those given all rows; and the log likelihood."""
    means, variances, ahead, log = [], [], [], 0.0
    m, p = 0.0, 5.0
    for t, row in enumerate(rows):
        if t:
            f = slope(m)
            m, p = move(m, t), f * p * f + 10.0
            ahead.append((f, m, p))
        if not np.isnan(row):
            h = m / 10
            s = h * p * h + 1.0
            log += -0.5 * (np.log(2 * np.pi * s) + (row - m**2 / 20) ** 2 / s)
            k = p * h / s
            m, p = m + k * (row - m**2 / 20), p - k * s * k
        means.append(m)
        variances.append(p)
    smoothed, spread = [means[-1]], [variances[-1]]
    for t in range(len(rows) - 2, -1, -1):
        f, m, p = ahead[t]
        g = variances[t] * f / p
        smoothed.insert(0, means[t] + g * (smoothed[0] - m))
        spread.insert(0, variances[t] + g * (spread[0] - p) * g)
    return np.array([means, smoothed]), np.array([variances, spread]), log


def textbook_unscented(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The same by three points at sqrt(3) standard deviations, laid anew for the observation."""
    weights = np.array([2 / 3, 1 / 6, 1 / 6])

    def moments(f: Callable[[Any], Any], m: float, p: float) -> tuple[float, float, float]:
        points = m + np.sqrt(3 * p) * np.array([0.0, 1.0, -1.0])
        values = f(points)
        mean = weights @ values
        return mean, weights @ (values - mean) ** 2, weights @ ((values - mean) * (points - m))

    means, variances, ahead, log = [], [], [], 0.0
    m, p = 0.0, 5.0
    for t, row in enumerate(rows):
        if t:
            mean, spread, cross = moments(lambda x, t=t: move(x, t), m, p)
            m, p = mean, spread + 10.0
            ahead.append((cross, m, p))
        if not np.isnan(row):
            mean, spread, cross = moments(lambda x: x**2 / 20, m, p)
            s = spread + 1.0
            log += -0.5 * (np.log(2 * np.pi * s) + (row - mean) ** 2 / s)
            m, p = m + cross / s * (row - mean), p - cross**2 / s
        means.append(m)
        variances.append(p)
    smoothed, spreads = [means[-1]], [variances[-1]]
    for t in range(len(rows) - 2, -1, -1):
        cross, m, p = ahead[t]
        smoothed.insert(0, means[t] + cross / p * (smoothed[0] - m))
        spreads.insert(0, variances[t] + cross / p * (spreads[0] - p) * cross / p)
    return np.array([means, smoothed]), np.array([variances, spreads]), log


@pytest.mark.parametrize(
    ("engine", "textbook", "tolerance"),
    [(ENGINES[0], textbook_extended, 1e-6), (ENGINES[1], textbook_unscented, 1e-9)],
    ids=SHORT[:2],
)
def test_equal_textbook_loops(engine: Any, textbook: Any, tolerance: float) -> None:
    dbn = growth(1)
    rows = dbn.sample(25, rng=3)["y"][0]
    rows[[0, 7, 8]] = np.nan
    means, variances, log = textbook(rows[:, 0])
    found = [
        bmc.filter(dbn, {"y": rows}, engine=engine),
        bmc.smooth(dbn, {"y": rows}, engine=engine),
    ]
    assert found[0].log_marginal_likelihood[0] == pytest.approx(log, rel=tolerance)
    for k, posterior in enumerate(found):
        assert off(posterior.mean("x")[:, 0], means[k]) < tolerance
        assert off(posterior.var("x")[:, 0], variances[k]) < tolerance


def errors_by_run(
    dbn: bmc.DynamicBayesNet, drawn: dict[str, np.ndarray], engine: Any
) -> np.ndarray:
    rows = drawn["y"][0].copy()
    rows[0] = np.nan
    filtered = bmc.filter(dbn, {"y": rows}, engine=engine)
    return np.sqrt(((filtered.mean("x") - drawn["x"][0])[1:] ** 2).mean(axis=0))


@pytest.mark.parametrize(
    ("engine", "wanted", "error"),
    [(ENGINES[0], 21.4, 0.8), (ENGINES[1], 11.65, 0.16)],
    ids=SHORT[:2],
)
def test_errors_on_the_growth_benchmark(engine: Any, wanted: float, error: float) -> None:
    """Averages of 200 runs beside published ones; 3 standard errors, so 0.3 % of fresh seeds would fail."""
    dbn = growth(200)
    found = errors_by_run(dbn, dbn.sample(101, rng=3), engine)
    allowed = 3 * np.hypot(found.std() / np.sqrt(200), error)
    assert abs(found.mean() - wanted) < allowed
    assert abs(found.mean() - 1.3 * wanted) > allowed  # the test can tell them apart


# ---- van der Merwe, de Freitas, Doucet and Wan (2000) --------------------------------------------


def gamma_noise(runs: int, left_out: float = 0.0) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("gamma noise", plates={"run": runs})
    dbn.add("x", lambda x_prev, t: bmc.Affine(
        bmc.Gamma(3.0, 2.0), 1 + np.sin(0.04 * np.pi * t) + 0.5 * x_prev - left_out),
        plates="run", initial=bmc.Normal(1.0, 1e-6))  # fmt: skip
    dbn.add("y", lambda x, t: bmc.Normal(np.where(t < 30, x**2 / 5, x / 2 - 2), np.sqrt(1e-5)),
            plates="run")  # fmt: skip
    return dbn


@pytest.mark.parametrize(
    ("engine", "bound", "published"),
    [(ENGINES[0], 0.11, 0.374), (ENGINES[1], 0.095, 0.280)],
    ids=SHORT[:2],
)
def test_errors_under_gamma_noise(engine: Any, bound: float, published: float) -> None:
    """Averages of 100 runs; standard errors are about 0.006, bounds two to three of them above the mean.

    The published errors come about when the filter leaves out the noise's mean of 1.5.
    """
    drawn = gamma_noise(100).sample(60, rng=1)

    def average(dbn: bmc.DynamicBayesNet) -> float:
        filtered = bmc.filter(dbn, {"y": drawn["y"][0]}, engine=engine)
        return float(np.sqrt(((filtered.mean("x") - drawn["x"][0]) ** 2).mean(axis=0)).mean())

    assert average(gamma_noise(100)) < bound
    assert abs(average(gamma_noise(100, 1.5)) - published) < 0.06


# ---- shapes, angles, refusals -------------------------------------------------------------------


def turning() -> bmc.DynamicBayesNet:
    """A heading that goes round the circle, and noisy compass readings."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("a", lambda a_prev: bmc.VonMises(a_prev + 0.3, 100.0), initial=bmc.VonMises(0.0, 50.0))
    dbn.add("y", lambda a: bmc.WrappedNormal(a, 0.2))
    return dbn


def turned(a: np.ndarray) -> np.ndarray:
    return np.remainder(a + np.pi, 2 * np.pi) - np.pi


@pytest.mark.parametrize("engine", ENGINES[:2], ids=SHORT[:2])
def test_angles_go_the_short_way_round(engine: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    dbn = turning()
    drawn = dbn.sample(80, rng=5)
    heading, rows = drawn["a"][0], {"y": drawn["y"][0]}
    filtered = bmc.filter(dbn, rows, engine=engine)
    assert np.abs(filtered.mean("a")).max() <= np.pi
    assert np.abs(turned(filtered.mean("a") - heading)).max() < 0.5
    particles = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(20_000), rng=0)
    # at these concentrations a Gaussian is right to about 0.01, which 20,000 particles resolve
    assert np.abs(turned(filtered.mean("a") - particles.mean("a"))).max() < 0.02
    assert filtered.log_marginal_likelihood == pytest.approx(
        particles.log_marginal_likelihood, abs=1.0
    )
    smoothed = bmc.smooth(dbn, rows, engine=engine)
    before, after = (np.abs(turned(p.mean("a") - heading)).mean() for p in (filtered, smoothed))
    assert after < before
    # without wrapping, the filter is lost where the heading crosses pi
    monkeypatch.setattr(kalman_levels, "wrap_angle", lambda a: a)
    monkeypatch.setattr(np, "remainder", lambda a, b: a)
    lost = bmc.filter(dbn, rows, engine=engine)
    monkeypatch.undo()
    assert np.abs(turned(lost.mean("a") - heading)).max() > 0.5


@pytest.mark.parametrize("engine", ENGINES[:2], ids=SHORT[:2])
def test_scales_may_depend_on_hidden_nodes(engine: Any) -> None:
    """Variances are those at the mean, or averaged over the points: three of them are exact for squares."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", bmc.Normal(1.0, 0.5))
    dbn.add("z", lambda x: bmc.Normal(2.0 * x, np.abs(x)))
    dbn.add("v", lambda x: bmc.MvNormal(
        np.stack([x, x], axis=-1), scale_diag=np.stack([np.abs(x), 2 * np.abs(x)], axis=-1)))  # fmt: skip
    found = bmc.filter(dbn, {"x": [np.nan, 1.0]}, engine=engine)
    average = 1.0 if engine is ENGINES[0] else 1.25  # E[x^2] = 1 + 0.25
    np.testing.assert_allclose(found.var("z"), [4 * 0.25 + average, 1.0], rtol=1e-9)
    np.testing.assert_allclose(found.var("v")[0], [0.25 + average, 0.25 + 4 * average], rtol=1e-9)


@pytest.mark.parametrize("engine", ENGINES[:2], ids=SHORT[:2])
def test_refuse_what_has_no_moments(engine: Any) -> None:
    def refusal(x: Any, y: Any) -> str:
        dbn = bmc.DynamicBayesNet()
        dbn.add("x", x, initial=bmc.Normal(0.0, 1.0) if callable(x) else None)
        dbn.add("y", y)
        with pytest.raises(bmc.errors.UnsupportedError) as caught:
            bmc.filter(dbn, {"y": [1.0, 0.0]}, engine=engine)
        return str(caught.value)

    walk = lambda x_prev: bmc.Normal(x_prev, 1.0)  # noqa: E731
    assert "'y' is observed" in refusal(walk, lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))))
    assert "'y'" in refusal(walk, lambda x: bmc.Cauchy(x, 1.0))
    assert "ParticleFilter" in refusal(walk, lambda x: bmc.StudentT(1.5, x, 1.0))
    assert "'x' is hidden and discrete" in refusal(bmc.Poisson(3.0), lambda x: bmc.Normal(x, 1.0))


def test_options_are_checked() -> None:
    for wrong in ({"alpha": 0.0}, {"kappa": np.inf}, {"beta": np.nan}, {"alpha": True}):
        with pytest.raises(ValueError, match=f"UnscentedKalmanFilter\\({next(iter(wrong))}="):
            UnscentedKalmanFilter(**wrong)  # type: ignore[arg-type]
    dbn = growth(1)
    rows = {"y": dbn.sample(5, rng=1)["y"][0]}
    with pytest.raises(bmc.errors.ParameterError, match="1 numbers lie"):
        bmc.filter(dbn, rows, engine=UnscentedKalmanFilter(kappa=-1.0))


def test_degenerate_rows_name_the_slice() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(np.exp(100 * x_prev), 1.0), initial=bmc.Normal(5.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x**2, 1.0))
    with pytest.raises(bmc.errors.BayesmcError) as caught:
        bmc.filter(dbn, {"y": [25.0, 1.0, 1.0, 2.0]}, engine=ExtendedKalmanFilter())
    assert isinstance(caught.value, (bmc.errors.DegeneracyError, bmc.errors.ParameterError))


def test_a_fault_in_the_update_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison with the textbook loop fails when gains are off by 1e-5."""
    plain = kalman_passes.absorbed

    def faulty(layout: Any, pattern: Any, found: Any, *rest: Any) -> Any:
        return plain(layout, pattern, found._replace(gain=found.gain * (1 + 1e-5)), *rest)

    monkeypatch.setattr(kalman_rows, "absorbed", faulty)
    with pytest.raises(AssertionError):
        test_equal_textbook_loops(ENGINES[1], textbook_unscented, 1e-9)
