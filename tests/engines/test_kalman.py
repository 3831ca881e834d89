"""``KalmanFilter`` against exact conditioning of the unrolled net, published numbers, and sixty digits."""

from __future__ import annotations

import csv
import json
import sys
import tracemalloc
from decimal import Decimal, getcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.kalman import covariances as kalman_covariances
from bayesmc.engines.kalman import means as kalman_means
from bayesmc.engines.kalman.filter import GaussianFilter, KalmanFilter
from bayesmc.linalg.square_root import Conditioned, condition
from bayesmc.testing import session
from bayesmc.testing.makers.linear_dbns import LinearSeries, random_linear_dbn

# fmt: off
NILE = [
    1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180, 799, 958,
    1140, 1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833, 701, 916, 692, 1020,
    1050, 969, 831, 726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845, 864, 862, 698, 845, 744, 796,
    1040, 759, 781, 865, 845, 944, 984, 897, 822, 1010, 771, 676, 649, 846, 812, 742, 801, 1040, 860, 874,
    848, 890, 744, 749, 838, 1050, 918, 986, 797, 923, 975, 815, 1020, 906, 901, 1170, 912, 746, 919, 718,
    714, 740,
]
# fmt: on


def local_level(mean: float, sd: float) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("local level")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, np.sqrt(1469.1)), initial=bmc.Normal(mean, sd))
    dbn.add("y", lambda x: bmc.Normal(x, np.sqrt(15099.0)))
    return dbn


def off(found: Any, wanted: Any) -> float:
    """Largest difference, relative where numbers are above 1."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    return float((np.abs(found - wanted) / (1 + np.abs(wanted))).max(initial=0.0))


def worst(case: LinearSeries, engine: Any = None) -> float:
    """Largest error of filter, smoother, fixed-lag smoother, forecast and likelihood of one case."""
    engine, last = engine or KalmanFilter(), case.steps
    options: dict[str, Any] = {"inputs": case.inputs, "engine": engine}
    exact = {k: case.exact(k) for k in range(1, last + 1)}
    filtered = bmc.filter(case.dbn, case.observations, **options)
    found = [
        (filtered, [exact[t + 1] for t in range(last)]),
        (bmc.smooth(case.dbn, case.observations, **options), [exact[last]] * last),
        (bmc.smooth(case.dbn, case.observations, lag=1, **options),
         [exact[min(t + 2, last)] for t in range(last)]),
    ]  # fmt: skip
    static = 0.0
    if "level" in case.observations:  # the engine takes it as known; its density is not a row's
        static = float(bmc.Normal(0.5, 1.0).log_prob(case.observations["level"]))
    total = np.sum(filtered.log_marginal_likelihood) + static
    errors = [off(total, exact[last].log_marginal_likelihood)]
    for posterior, wanted in found:
        for t, answer in enumerate(wanted):
            for name in case.hidden:
                errors.append(off(posterior.mean(name)[t], answer.mean(f"{name}[{t}]")))
                errors.append(off(posterior.var(name)[t], answer.var(f"{name}[{t}]")))
    return max(errors)


@pytest.mark.parametrize("seed", range(session.scaled(18, times=5)))
def test_equals_exact_conditioning(seed: int) -> None:
    assert worst(random_linear_dbn(seed)) < 1e-8


@pytest.mark.parametrize("seed", range(100, 100 + session.scaled(6, times=5)))
def test_forecast_equals_exact_conditioning(seed: int) -> None:
    case = random_linear_dbn(seed)
    timed = {n: v for n, v in case.observations.items() if n not in case.dbn.static_nodes}
    rows = {n: v[: case.steps - 2] for n, v in timed.items()}
    given = {n: v for n, v in case.observations.items() if n not in timed}
    found = bmc.forecast(
        case.dbn, {**given, **rows}, steps=2, inputs=case.inputs, engine=KalmanFilter()
    )
    exact = case.exact(case.steps - 2)
    for k, t in enumerate((case.steps - 2, case.steps - 1)):
        for name in (*case.hidden, *timed):
            assert off(found.mean(name)[k], exact.mean(f"{name}[{t}]")) < 1e-8
            assert off(found.var(name)[k], exact.var(f"{name}[{t}]")) < 1e-8
    assert found.cov(*case.hidden).shape[0] == 2


@pytest.mark.parametrize("field", ["root", "gain", "factor", "turn"])
def test_a_fault_in_the_update_is_seen(field: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A relative error of 1e-6 in any part of the conditioning does not pass."""

    def faulty(rows: np.ndarray, observed: int, carried: int | None = None) -> Conditioned:
        found = condition(rows, observed, carried)
        part = getattr(found, field)
        return found if part is None else found._replace(**{field: part * (1 + 1e-6)})

    monkeypatch.setattr(kalman_covariances, "condition", faulty)
    assert max(worst(random_linear_dbn(seed)) for seed in range(3)) > 1e-8


def test_joint_covariance_equals_exact_conditioning() -> None:
    case = random_linear_dbn(0)
    names = [n for n in case.hidden if n != "d"]
    smoothed = bmc.smooth(case.dbn, case.observations, inputs=case.inputs, engine=KalmanFilter())
    for t in range(case.steps):
        wanted = case.exact(case.steps).cov(*(f"{n}[{t}]" for n in names))
        assert off(smoothed.cov(*names)[t], wanted) < 1e-8


def test_nile_likelihood_with_a_vague_start() -> None:
    """Durbin and Koopman (2012): -632.5456 at (15099, 1469.1), the first row left out."""
    filtered = bmc.filter(local_level(0.0, 1e7), {"y": NILE}, engine=KalmanFilter())
    assert filtered.log_marginal_increments[1:].sum() == pytest.approx(-632.5456, abs=5e-5)
    # what is left of the start after one row is the row itself
    later = bmc.filter(
        local_level(1120.0, np.sqrt(15099.0 + 1469.1)), {"y": NILE[1:]}, engine=KalmanFilter()
    )
    assert later.log_marginal_likelihood == pytest.approx(-632.5456251156737, abs=1e-8)


def test_nile_reference(reference_data: Path) -> None:
    folder = reference_data / "statespace"
    exact = json.loads((folder / "nile.ref.json").read_text())["reference_exact"]["proper_prior"]
    with (folder / "nile.csv").open() as lines:
        rows = [float(row["volume"]) for row in csv.DictReader(lines)]
    assert rows == NILE
    dbn = local_level(1000.0, 500.0)
    filtered = bmc.filter(dbn, {"y": rows}, engine=KalmanFilter())
    smoothed = bmc.smooth(dbn, {"y": rows}, engine=KalmanFilter())
    assert filtered.log_marginal_likelihood == pytest.approx(exact["loglik"], abs=1e-9)
    for found, kind in ((filtered, "filtered"), (smoothed, "smoothed")):  # given to six decimals
        np.testing.assert_allclose(found.mean("x"), exact[f"{kind}_mean"], rtol=0, atol=6e-7)
        np.testing.assert_allclose(found.var("x"), exact[f"{kind}_var"], rtol=0, atol=6e-7)


def test_vague_starts_keep_their_digits() -> None:
    """A trend with both starts at a scale of 10^7, beside the textbook recursion in sixty digits."""
    rng = np.random.default_rng(4)
    rows = np.cumsum(np.cumsum(rng.normal(size=40))) + rng.normal(size=40)
    dbn = bmc.DynamicBayesNet("trend")
    vague = bmc.Normal(0.0, 1e7)
    dbn.add("v", lambda v_prev: bmc.Normal(v_prev, 0.125), initial=vague)
    dbn.add("x", lambda x_prev, v_prev: bmc.Normal(x_prev + v_prev, 0.5), initial=vague)
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    found = bmc.filter(dbn, {"y": rows}, engine=KalmanFilter())

    getcontext().prec = 60
    two_pi = Decimal("6.28318530717958647692528676655900576839433879875021")
    move = np.array([[Decimal(1), Decimal(0)], [Decimal(1), Decimal(1)]], dtype=object)
    noise = np.array([[Decimal(1) / 64, Decimal(0)], [Decimal(0), Decimal(1) / 4]], dtype=object)
    mean = np.array([Decimal(0), Decimal(0)], dtype=object)
    cov = np.array([[Decimal(10) ** 14, Decimal(0)], [Decimal(0), Decimal(10) ** 14]], dtype=object)
    for t, row in enumerate(rows):
        if t:
            mean, cov = move.dot(mean), move.dot(cov).dot(move.T) + noise
        total = cov[1, 1] + 1
        error = Decimal(float(row)) - mean[1]
        log = -((two_pi * total).ln() + error * error / total) / 2
        gain = cov[:, 1] / total
        mean, cov = mean + gain * error, cov - np.outer(gain, cov[1])
        assert off(found.log_marginal_increments[t], float(log)) < 1e-11
        for k, name in enumerate(("v", "x")):
            assert off(found.mean(name)[t], float(mean[k])) < 1e-10
            assert off(found.var(name)[t], float(cov[k, k])) < 1e-10


def four_numbers(varying: bool = False) -> bmc.DynamicBayesNet:
    move = np.array([[0.9, 0.1, 0, 0], [0, 0.9, 0.1, 0], [0, 0, 0.8, 0.1], [0.2, 0, 0, 0.7]])
    look = np.array([[1.0, 0.5, 0.0, -0.3], [0.2, 0.0, 1.0, 0.4]])
    dbn = bmc.DynamicBayesNet()
    if varying:
        dbn.add("x", lambda x_prev, t: bmc.MvNormal(
            np.matvec(move, x_prev) + np.sin(0.1 * t)[..., None], 0.5 * np.eye(4)),
            initial=bmc.MvNormal(np.zeros(4), np.eye(4)))  # fmt: skip
    else:
        dbn.add("x", lambda x_prev: bmc.MvNormal(np.matvec(move, x_prev), 0.5 * np.eye(4)),
                initial=bmc.MvNormal(np.zeros(4), np.eye(4)))  # fmt: skip
    dbn.add("y", lambda x: bmc.MvNormal(np.matvec(look, x), np.eye(2)))
    return dbn


def unlike_runs() -> bmc.DynamicBayesNet:
    """Every element of the plate has coefficients of its own."""
    rate = np.array([0.5, 0.9, 0.99])
    dbn = bmc.DynamicBayesNet(plates={"run": 3})
    dbn.add("x", lambda x_prev: bmc.Normal(rate * x_prev, 1.0), plates="run",
            initial=bmc.Normal(0.0, 1.0))  # fmt: skip
    dbn.add("y", lambda x: bmc.MvNormal(np.stack([x, 2 * x], axis=-1), np.eye(2)), plates="run")
    return dbn


@pytest.mark.parametrize("declared", ["same", "varying", "unlike"])
def test_settled_covariances_are_those_of_every_step(
    declared: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    dbn = unlike_runs() if declared == "unlike" else four_numbers(declared == "varying")
    rows = dbn.sample(600, rng=1)["y"][0]
    rows[300:303] = np.nan
    short = bmc.smooth(dbn, {"y": rows}, engine=KalmanFilter())
    calls = 0

    def counted(*arguments: Any) -> Conditioned:
        nonlocal calls
        calls += 1
        return condition(*arguments)

    monkeypatch.setattr(kalman_covariances, "condition", counted)
    monkeypatch.setattr(kalman_covariances, "_alike", lambda a, b: False)
    long = bmc.smooth(dbn, {"y": rows}, engine=KalmanFilter())
    assert calls == 600  # without the shortcut every slice is worked out
    np.testing.assert_allclose(short.mean("x"), long.mean("x"), rtol=0, atol=1e-12)
    np.testing.assert_allclose(short.cov("x"), long.cov("x"), rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        short.log_marginal_increments, long.log_marginal_increments, rtol=0, atol=1e-12
    )


def test_settled_covariances_are_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = 0

    def counted(*arguments: Any) -> Conditioned:
        nonlocal calls
        calls += 1
        return condition(*arguments)

    monkeypatch.setattr(kalman_covariances, "condition", counted)
    dbn = four_numbers()
    bmc.filter(dbn, {"y": dbn.sample(2000, rng=1)["y"][0]}, engine=KalmanFilter())
    assert calls < 300


def test_missing_rows_that_come_round_are_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every seventh row is missing: after some weeks all weeks are alike."""
    calls = 0

    def counted(*arguments: Any) -> Conditioned:
        nonlocal calls
        calls += 1
        return condition(*arguments)

    monkeypatch.setattr(kalman_covariances, "condition", counted)
    dbn = four_numbers()
    rows = dbn.sample(2100, rng=1)["y"][0]
    rows[6::7] = np.nan
    found = bmc.smooth(dbn, {"y": rows}, engine=KalmanFilter())
    assert calls < 400
    monkeypatch.setattr(kalman_covariances, "_alike", lambda a, b: False)
    every = bmc.smooth(dbn, {"y": rows}, engine=KalmanFilter())
    assert calls > 2100
    np.testing.assert_allclose(found.mean("x"), every.mean("x"), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.cov("x"), every.cov("x"), rtol=0, atol=1e-13)


def seen_now_and_then(plates: bool) -> tuple[bmc.DynamicBayesNet, dict[str, np.ndarray]]:
    """A state of two parts of which one is seen itself at times, and two sensors with gaps of their own."""
    place = {"plates": "run"} if plates else {}
    dbn = bmc.DynamicBayesNet(plates={"run": 3} if plates else {})
    dbn.add("a", lambda a_prev, b_prev: bmc.Normal(0.8 * a_prev + 0.3 * b_prev, 0.5), **place,
            initial=bmc.Normal(1.0, 2.0))  # fmt: skip
    dbn.add("b", lambda b_prev, t: bmc.Normal(0.9 * b_prev + np.sin(t), 0.4), **place,
            initial=bmc.Normal(0.0, 1.0))  # fmt: skip
    dbn.add("y", lambda a, b: bmc.Normal(a + b, 0.3), **place)
    dbn.add("z", lambda b: bmc.Normal(2 * b, 0.7), **place)
    drawn = dbn.sample(240, rng=5)
    rows = {n: drawn[n][0].copy() for n in ("a", "y", "z")}
    rng = np.random.default_rng(6)
    for name, share in (("a", 0.8), ("y", 0.2), ("z", 0.4)):
        rows[name][:150][rng.random(rows[name][:150].shape) < share] = np.nan
    rows["a"][150:] = np.nan
    return dbn, rows


@pytest.mark.parametrize("plates", [False, True])
@pytest.mark.parametrize("pieces", [(64, 1024), (20, 7), (1000, 1)])
def test_slices_together_are_those_one_by_one(
    plates: bool, pieces: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However a series is cut into pieces, it is what ``step`` makes of row after row."""
    monkeypatch.setattr(kalman_means, "_RUN", pieces[0])
    monkeypatch.setattr(kalman_means, "_CHUNK", pieces[1])
    dbn, rows = seen_now_and_then(plates)
    engine = KalmanFilter()
    found = bmc.filter(dbn, rows, engine=engine)
    belief, logs = engine.start(dbn), [np.zeros(3 if plates else ())]
    for t in range(240):
        belief = engine.step(belief, {n: v[t] for n, v in rows.items()})
        logs.append(belief.log_marginal_likelihood)
        for name in ("a", "b"):
            np.testing.assert_allclose(found.mean(name)[t], belief.mean(name), atol=1e-10)
            np.testing.assert_allclose(found.var(name)[t], belief.var(name), atol=1e-10)
    np.testing.assert_allclose(found.log_marginal_increments, np.diff(logs, axis=0), atol=1e-9)


def test_many_missing_rows_cost_what_a_loop_costs() -> None:
    """With rows missing at random nothing repeats; what is done slice by slice takes few calls of functions.

    It is 63 calls a row, most of them of array methods; row after row as ``step`` does it, it is 200.
    """
    rng = np.random.default_rng(0)
    rows = rng.normal(size=5000)
    rows[rng.random(5000) < 0.14] = np.nan
    calls = 0

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    dbn = local_level(0.0, 10.0)
    bmc.filter(dbn, {"y": rows[:50]}, engine=KalmanFilter())
    sys.setprofile(count)
    try:
        bmc.filter(dbn, {"y": rows}, engine=KalmanFilter())
    finally:
        sys.setprofile(None)
    assert calls < 100 * len(rows)


def test_elements_that_never_meet_are_filtered_separately() -> None:
    single = bmc.DynamicBayesNet()
    single.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    single.add("y", lambda x: bmc.Normal(x, 0.5))
    many = bmc.DynamicBayesNet(plates={"run": 64})
    many.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 1.0), plates="run",
             initial=bmc.Normal(0.0, 2.0))  # fmt: skip
    many.add("y", lambda x: bmc.Normal(x, 0.5), plates="run")
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(30, 64))
    rows[rng.random(rows.shape) < 0.2] = np.nan
    together = bmc.smooth(many, {"y": rows}, engine=KalmanFilter())
    assert together.log_marginal_increments.shape == (30, 64)
    assert together.cov("x").shape == (30, 64, 1, 1)
    for k in (0, 17, 63):
        alone = bmc.smooth(single, {"y": rows[:, k]}, engine=KalmanFilter())
        np.testing.assert_allclose(together.mean("x")[:, k], alone.mean("x"), atol=1e-12)
        np.testing.assert_allclose(together.var("x")[:, k], alone.var("x"), atol=1e-12)
        np.testing.assert_allclose(
            together.log_marginal_likelihood[k], alone.log_marginal_likelihood, atol=1e-10
        )


def test_what_is_observed_may_be_of_any_kind() -> None:
    """A seen regime switches the dynamics, a seen node enters nonlinearly, inputs are summed."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("sum", lambda u, sum_prev: sum_prev + u, initial=lambda u: 1.0 * u)
    dbn.add("x", lambda x_prev, s, y_prev: bmc.Normal(
        np.where(s == 1, 0.5, 0.9) * x_prev + np.sin(y_prev), np.where(s == 1, 2.0, 0.5)),
        initial=bmc.Normal(0.0, 1.0))  # fmt: skip
    dbn.add("y", lambda x, sum: bmc.Normal(x + 0.1 * sum, 1.0))  # noqa: A006
    inputs = {"u": np.array([0.0, 1.0, 1.0, 0.5, 1.0])}
    rows = {"s": [0, 1, 1, 0, 1], "y": [0.3, 1.2, -0.7, 0.4, 2.0]}
    found = bmc.smooth(dbn, rows, inputs=inputs, engine=KalmanFilter())
    exact = bmc.infer(dbn.unroll(5, inputs), dbn.unrolled_evidence(rows), engine=bmc.Exact())
    assert found.log_marginal_likelihood == pytest.approx(exact.log_marginal_likelihood, abs=1e-10)
    for t in range(5):
        assert off(found.mean("x")[t], exact.mean(f"x[{t}]")) < 1e-10
    assert found.mean("sum").tolist() == [0.0, 1.0, 2.0, 2.5, 3.5]


def test_functions_that_branch_on_time_are_read_slice_by_slice() -> None:
    def declared(where: Any) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet()
        dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        dbn.add("y", where)
        return dbn

    rows = {"y": [0.5, 0.2, 1.0, 3.0]}
    branch = declared(lambda x, t: bmc.Normal(2.0 * x if t < 2 else x - 1.0, 1.0))
    smooth = declared(lambda x, t: bmc.Normal(np.where(t < 2, 2.0 * x, x - 1.0), 1.0))
    found = [bmc.filter(d, rows, engine=KalmanFilter()) for d in (branch, smooth)]
    np.testing.assert_allclose(found[0].mean("x"), found[1].mean("x"), atol=1e-14)


@pytest.mark.parametrize(
    ("x", "y", "says"),
    [
        (lambda x_prev: bmc.Normal(np.sin(x_prev), 1.0), lambda x: bmc.Normal(x, 1.0), "'x' has a mean"),
        (lambda x_prev: bmc.Normal(x_prev, 1.0), lambda x: bmc.Normal(x, np.exp(x)), "'y' has a scale"),
        (lambda x_prev: bmc.Normal(x_prev, 1.0), lambda x: bmc.StudentT(3.0, x, 1.0), "'y' is StudentT"),
        (lambda x_prev: bmc.Normal(x_prev, 1.0), lambda x: bmc.Poisson(np.exp(x)), "'y' is discrete"),
        # slices 0 and 1 are looked at first; later ones must be affine, too
        (lambda x_prev, t: bmc.Normal(x_prev if t < 3 else x_prev**2, 1.0),
         lambda x: bmc.Normal(x, 1.0), "slice 3: node 'x' has a mean that is not known to be affine"),
    ],
)  # fmt: skip
def test_refuses_what_is_not_linear_gaussian(x: Any, y: Any, says: str) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", x, initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", y)
    with pytest.raises(bmc.errors.UnsupportedError, match=says) as caught:
        bmc.filter(dbn, {"y": [1, 0, 2, 1, 1]}, engine=KalmanFilter())
    assert "ExtendedKalmanFilter" in str(caught.value)


def test_refuses_what_is_nonlinear_through_deterministic_memory() -> None:
    """A computed node that starts as a constant, and whose square enters later."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("d", lambda x, d_prev: d_prev + x, initial=lambda t: 0.0 * t)
    dbn.add("y", lambda d_prev: bmc.Normal(d_prev**2, 1.0), initial=bmc.Normal(0.0, 1.0))
    with pytest.raises(bmc.errors.UnsupportedError, match="'y' has a mean"):
        bmc.filter(dbn, {"y": [1.0, 0.0, 2.0]}, engine=KalmanFilter())


def test_refuses_hidden_finite_nodes_and_particles() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("y", lambda s: bmc.Normal(1.0 * s, 1.0))
    with pytest.raises(bmc.errors.UnsupportedError, match="'s' is hidden and discrete"):
        bmc.filter(dbn, {"y": [1.0, 0.0]}, engine=KalmanFilter())
    plain = local_level(0.0, 1.0)
    with pytest.raises(bmc.errors.UnsupportedError, match="particles"):
        bmc.filter(plain, {"y": NILE}, engine=KalmanFilter(), keep="particles")


def test_bad_parameters_name_the_node() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev, t: bmc.Normal(x_prev, 2.5 - t), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(bmc.errors.ParameterError, match="'x'"):
        bmc.filter(dbn, {"y": [1.0, 0.0, 2.0, 1.0]}, engine=KalmanFilter())


def test_most_likely_is_the_smoothed_mean() -> None:
    found = bmc.most_likely(local_level(1000.0, 500.0), {"y": NILE}, engine=KalmanFilter())
    smoothed = bmc.smooth(local_level(1000.0, 500.0), {"y": NILE}, engine=KalmanFilter())
    assert list(found) == ["x"]
    np.testing.assert_array_equal(found["x"], smoothed.mean("x"))


@pytest.mark.parametrize("seed", range(session.scaled(6, times=5)))
def test_row_by_row_equals_all_at_once(seed: int) -> None:
    case = random_linear_dbn(seed)
    engine = KalmanFilter()
    filtered = bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=engine)
    static = {n: case.observations[n] for n in case.dbn.static_nodes}
    rows = {n: v for n, v in case.observations.items() if n not in static}
    belief = engine.start(case.dbn, static=static)
    for t in range(case.steps):
        row = {n: v[t] for n, v in rows.items()}
        given = {n: v[t] for n, v in case.inputs.items()}
        again = engine.step(belief, row, inputs=given)
        belief = engine.step(belief, row, inputs=given)
        for name in case.hidden:  # a step leaves the belief before it as it was
            np.testing.assert_array_equal(again.mean(name), belief.mean(name))
            assert off(belief.mean(name), filtered.mean(name)[t]) < 1e-9
            assert off(belief.cov(name), filtered.cov(name)[t]) < 1e-9
            assert off(belief.std(name), filtered.std(name)[t]) < 1e-9
    assert off(belief.log_marginal_likelihood, filtered.log_marginal_likelihood) < 1e-9


def test_a_belief_that_absorbed_nothing_says_so() -> None:
    engine = KalmanFilter()
    belief = engine.start(local_level(0.0, 1.0))
    assert belief.t == -1
    with pytest.raises(bmc.errors.QueryError, match="absorbed nothing"):
        belief.mean("x")
    belief = engine.step(belief)
    assert belief.log_marginal_likelihood == 0.0  # a row without observations says nothing
    with pytest.raises(bmc.errors.UnknownNodeError, match="'z'"):
        belief.mean("z")
    nonlinear = bmc.DynamicBayesNet()
    nonlinear.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 1.0), initial=bmc.Normal(0.0, 1.0))
    started = engine.step(engine.start(nonlinear))
    with pytest.raises(bmc.errors.UnsupportedError, match="'x' has a mean"):
        engine.step(started)


def test_says_what_it_does_to_each_node() -> None:
    explained = bmc.explain(local_level(0.0, 1.0), {"y": NILE}, engine=KalmanFilter())
    text = str(explained)
    assert "Gaussian" in text
    assert "updates" in text
    assert GaussianFilter.refusal is KalmanFilter.refusal


@pytest.mark.parametrize("lead", [(), (3,), (2, 3)])
def test_conditioning_is_that_of_dense_gaussians(lead: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(*lead, 5, 7))
    cov = rows @ np.matrix_transpose(rows)
    found = condition(rows.copy(), 2, 3)
    root, gain, factor = found.root, found.gain, found.factor
    seen, cross = cov[..., :2, :2], cov[..., 2:, :2]
    left = cov[..., 2:, 2:] - cross @ np.linalg.solve(seen, np.matrix_transpose(cross))
    np.testing.assert_allclose(root @ np.matrix_transpose(root), seen, atol=1e-12)
    np.testing.assert_allclose(gain @ np.matrix_transpose(root), cross, atol=1e-12)
    np.testing.assert_allclose(factor @ np.matrix_transpose(factor), left, atol=1e-12)
    assert found.turn is not None
    whole = np.zeros((*lead, 5, 5))  # rows times the turn are the triangle
    whole[..., :2, :2], whole[..., 2:, :2], whole[..., 2:, 2:] = root, gain, factor
    turned = rows[..., :3] @ found.turn[..., :5]  # the part of the first three entries of the noise
    own = rows[..., :3] @ np.matrix_transpose(rows[..., :3])
    np.testing.assert_allclose(turned @ np.matrix_transpose(whole), own, atol=1e-12)


def test_slice_zero_may_have_another_order() -> None:
    """There b reads a; later neither reads the other."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("b", lambda b_prev: bmc.Normal(b_prev, 1.0), initial=lambda a: bmc.Normal(a, 1.0))
    dbn.add("a", lambda a_prev: bmc.Normal(a_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda b: bmc.Normal(b, 1.0))
    rows = {"y": [1.0, 2.0]}
    found = bmc.smooth(dbn, rows, engine=KalmanFilter())
    exact = bmc.infer(dbn.unroll(2), dbn.unrolled_evidence(rows), engine=bmc.Exact())
    for name in ("a", "b"):
        assert off(found.mean(name), [exact.mean(f"{name}[{t}]") for t in range(2)]) < 1e-12


@pytest.mark.parametrize("lag", ["constant", "twice removed", "a sequence"])
def test_what_slice_zero_computes_as_a_constant_is_none_in_later_slices(lag: str) -> None:
    """A lag that begins at 0, one that is read through a computed node, and a sequence by itself."""
    dbn = bmc.DynamicBayesNet()
    if lag == "twice removed":
        dbn.add("m", lambda l_prev: 2.0 * l_prev, initial=lambda: 0.0)
    mean = {
        "constant": lambda x_prev, l_prev: bmc.Normal(1.2 * x_prev - 0.4 * l_prev, 0.7),
        "twice removed": lambda x_prev, m: bmc.Normal(1.2 * x_prev - 0.2 * m, 0.7),
        "a sequence": lambda x_prev, l_prev: bmc.Normal(x_prev - l_prev, 0.7),
    }[lag]
    dbn.add("x", mean, initial=bmc.Normal(0.0, 1.0))
    if lag == "a sequence":
        dbn.add("l", lambda l_prev: 1.0 + 0.5 * l_prev, initial=lambda: 0.0)
    else:
        dbn.add("l", lambda x_prev: x_prev, initial=lambda: 0.0)
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    rows = {"y": [0.1, 0.9, 1.2, 0.3, -0.5]}
    exact = bmc.infer(dbn.unroll(5), dbn.unrolled_evidence(rows), engine=bmc.Exact())
    engines: list[Any] = [KalmanFilter(), bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()]
    for engine in [*engines, bmc.ParticleFilter(3, marginalize="auto")]:
        found = bmc.filter(dbn, rows, engine=engine)
        assert off(found.log_marginal_likelihood, exact.log_marginal_likelihood) < 1e-9, engine
        assert off(found.mean("x")[-1], exact.mean("x[4]")) < 1e-9, engine


def test_nothing_hidden_and_nothing_seen() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("y", lambda y_prev: bmc.Normal(0.5 * y_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    engine, rows = KalmanFilter(), np.array([1.0, 2.0, 3.0])
    found = bmc.smooth(dbn, {"y": rows}, engine=engine)
    wanted = bmc.Normal([0.0, 0.5, 1.0], 1.0).log_prob(rows)
    np.testing.assert_allclose(found.log_marginal_increments, wanted, atol=1e-14)
    assert found.cov("y").tolist() == [[[0.0]]] * 3
    gap = bmc.smooth(dbn, {"y": [1.0, None, 3.0]}, engine=engine)
    np.testing.assert_allclose(gap.mean("y"), [1.0, 1.6, 3.0], atol=1e-14)
    np.testing.assert_allclose(gap.var("y"), [0.0, 0.8, 0.0], atol=1e-14)
    nothing = bmc.filter(dbn, {"y": [None, None]}, engine=engine)
    np.testing.assert_allclose(nothing.var("y"), [1.0, 1.25], atol=1e-14)
    assert nothing.log_marginal_likelihood == 0.0
    assert bmc.smooth(dbn, {"y": [1.0]}, lag=3, engine=engine).mean("y").tolist() == [1.0]


def test_online_memory_is_flat() -> None:
    engine = KalmanFilter()
    belief = engine.start(local_level(0.0, 1e7))
    rng = np.random.default_rng(0)

    def run(steps: int) -> None:
        nonlocal belief
        for _ in range(steps):
            belief = engine.step(belief, {"y": rng.normal()} if rng.random() < 0.7 else {})

    run(50)
    tracemalloc.start()
    run(50)
    before = tracemalloc.get_traced_memory()[0]
    run(500)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 50_000  # a hundred bytes a step, when one belief holds ten thousand


@pytest.mark.parametrize("engine", [None, KalmanFilter(), bmc.GridFilter(), bmc.ParticleFilter(50)])
def test_forecasts_from_no_rows_are_those_without_data(engine: Any) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(2.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    empty, nothing = (
        bmc.forecast(dbn, rows, steps=2, engine=engine, rng=0) for rows in ({"y": []}, {})
    )
    np.testing.assert_array_equal(empty.mean("y"), nothing.mean("y"))
