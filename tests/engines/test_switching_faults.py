"""``SwitchingKalmanFilter`` where rows are missing in part, modes cannot be, or parameters are bad."""

from __future__ import annotations

import itertools
import re
import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import SwitchingKalmanFilter
from bayesmc.dbn import pose_series
from bayesmc.engines.kalman.data import pattern_of
from bayesmc.errors import EngineWarning, ParameterError, UnsupportedError, ZeroProbabilityError
from bayesmc.testing import session
from bayesmc.testing.makers.switching_dbns import random_switching_dbn

RULES = ("gpb1", "imm", "gpb2")


def one_by_one(engine: Any, dbn: Any, rows: dict[str, Any]) -> list[Any]:
    """Beliefs after every row; None is missing."""
    steps, belief, found = len(next(iter(rows.values()))), engine.start(dbn), []
    for t in range(steps):
        belief = engine.step(belief, {n: v[t] for n, v in rows.items() if v[t] is not None})
        found.append(belief)
    return found


def sensors() -> bmc.DynamicBayesNet:
    """A number that two sensors see."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 0.3 + s), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.3), plates=["k"])
    return dbn


def test_rows_with_gaps_one_by_one_give_the_same() -> None:
    """No chance is in it, but where memory is handed out again: patterns known by their ids failed in 16."""
    dbn, engine = sensors(), SwitchingKalmanFilter()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        y = rng.normal(size=(12, 2))
        y[rng.random(y.shape) < 0.4] = np.nan
        together = bmc.filter(dbn, {"y": y}, engine=engine)
        belief = engine.start(dbn)
        for t in range(len(y)):
            belief = engine.step(belief, {"y": y[t]})
            assert abs(belief.mean("x") - together.mean("x")[t]) < 1e-9, (seed, t)
            assert abs(belief.var("x") - together.var("x")[t]) < 1e-9, (seed, t)


def test_patterns_are_known_by_what_they_observe() -> None:
    """Whatever the ids: those alike share coefficients, those unlike do not."""
    problem = pose_series(sensors(), {"y": [[0.1, 0.2], [np.nan, 0.3], [0.1, np.nan]]}, None)
    stretch = SwitchingKalmanFilter()._run(problem).stretches[1]
    layout, patterns = stretch.layout, []
    for seen in ([True, False], [True, False], [False, True]):
        mask = np.zeros(layout.n, dtype=bool)
        mask[layout.rows["y"]] = seen
        patterns.append(pattern_of(layout, mask))
    for ask in (stretch.chosen, stretch.coefficients):
        one, same, other = (ask(0, p, True) for p in patterns)
        assert one is same and one is not other


# ---- modes that cannot be -----------------------------------------------------------------------


def one_way(plates: tuple[str, ...] = ()) -> bmc.DynamicBayesNet:
    """From "a", where it starts, to "b" and never back."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    table = [[0.9, 0.1], [0.0, 1.0]]
    dbn.table("s", ["s_prev"], table, ("a", "b"), initial=[1.0, 0.0], plates=plates)
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(x_prev + (s == "b"), 0.3),
        initial=bmc.Normal(0.0, 1.0),
        plates=plates,
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.3), plates=plates)
    return dbn


@pytest.mark.parametrize("merging", RULES)
@pytest.mark.parametrize(
    ("seen", "bad"),
    [(["b"], 0), (["b", None], 0), (["a", "b", "a"], 2), ([None, "b", None, "a", None], 3)],
)
def test_an_impossible_mode_is_told_with_slice_and_node(
    merging: str, seen: list[Any], bad: int
) -> None:
    dbn, rows = one_way(), {"s": seen, "y": [0.1, 0.2, 1.0, 0.5, 0.2][: len(seen)]}
    engine = SwitchingKalmanFilter(merging)  # type: ignore[arg-type]
    message = f"slice {bad} has probability zero.*what was seen of 's' is impossible"
    for given in (engine, None) if None in seen else (engine,):
        with pytest.raises(ZeroProbabilityError, match=message):
            bmc.filter(dbn, rows, engine=given)
        assert "SwitchingKalmanFilter" in str(bmc.explain(dbn, rows, engine=given))
    with pytest.raises(ZeroProbabilityError, match=message):
        bmc.smooth(dbn, rows, engine=engine)
    belief = engine.start(dbn)
    for t in range(len(seen)):
        row = {n: v[t] for n, v in rows.items() if v[t] is not None}
        if t == bad:
            with pytest.raises(ZeroProbabilityError, match=message):
                engine.step(belief, row)
            break
        belief = engine.step(belief, row)


def test_an_impossible_mode_of_one_element_is_told() -> None:
    rows: dict[str, Any] = {"y": np.zeros((3, 2))}
    rows["s"] = [["a", "a"], ["a", "b"], ["b", "a"]]
    with pytest.raises(ZeroProbabilityError, match=r"slice 2 .*seen of 's' is impossible"):
        bmc.filter(one_way(("k",)), rows, engine=SwitchingKalmanFilter())
    rows["s"] = [["a", None], [None, None], ["b", None]]
    found = bmc.filter(one_way(("k",)), rows, engine=SwitchingKalmanFilter())
    assert found.probabilities("s")[2, 0].tolist() == [0.0, 1.0]


# ---- smoothing over gaps ------------------------------------------------------------------------


def stock() -> bmc.DynamicBayesNet:
    """As docs/switching.md has it: two numbers whose noise the mode tells."""
    dbn = bmc.DynamicBayesNet()
    table = [[0.95, 0.05], [0.2, 0.8]]
    dbn.table("regime", ["regime_prev"], table, ("calm", "rough"), initial=[0.8, 0.2])
    dbn.add(
        "drift",
        lambda drift_prev, regime: bmc.Normal(
            0.9 * drift_prev, np.where(regime == "rough", 0.5, 0.05)
        ),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add(
        "level",
        lambda level_prev, drift, regime: bmc.Normal(
            level_prev + drift, np.where(regime == "rough", 1.0, 0.1)
        ),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("price", lambda level: bmc.Normal(level, 0.3))
    return dbn


PRICES = [0.1, 0.0, 0.3, None, 2.6, 1.1, 1.4]


@pytest.mark.parametrize("merging", RULES)
@pytest.mark.parametrize("lag", [None, 2])
def test_rows_without_data_at_the_end_change_nothing(merging: Any, lag: int | None) -> None:
    dbn, engine, options = (
        stock(),
        SwitchingKalmanFilter(merging),
        {} if lag is None else {"lag": lag},
    )
    short = bmc.smooth(dbn, {"price": PRICES}, engine=engine, **options)
    rows = {"price": [*PRICES, None, None, None, None, None]}
    filtered = bmc.filter(dbn, rows, engine=engine)
    found = bmc.smooth(dbn, rows, engine=engine, **options)
    steps = len(PRICES)
    for name in ("level", "drift"):
        for moment in ("mean", "var"):
            one = getattr(found, moment)(name)
            np.testing.assert_array_equal(one[:steps], getattr(short, moment)(name))
            np.testing.assert_array_equal(
                one[steps - 1 :], getattr(filtered, moment)(name)[steps - 1 :]
            )
    now = found.probabilities("regime")
    np.testing.assert_array_equal(now[:steps], short.probabilities("regime"))
    np.testing.assert_array_equal(now[steps:], filtered.probabilities("regime")[steps:])


@pytest.mark.parametrize("lag", [None, 1, 3])
def test_every_element_apart_has_a_last_row_of_its_own(lag: int | None) -> None:
    """Each is what it is by itself; one has no row at all, and one a gap within."""
    rng, engine = np.random.default_rng(3), SwitchingKalmanFilter()
    options: dict[str, Any] = {} if lag is None else {"lag": lag}
    y = rng.normal(size=(7, 4))
    y[4:, 0] = y[:, 1] = y[2:5, 2] = np.nan

    def levels(count: int) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet(plates={"k": count})
        dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5], plates="k")
        first = bmc.Normal(0.0, 1.0)
        dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 0.3 + s), initial=first, plates="k")
        dbn.add("y", lambda x: bmc.Normal(x, 0.3), plates="k")
        return dbn

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EngineWarning)
        found = bmc.smooth(levels(4), {"y": y}, engine=engine, **options)
        filtered = bmc.filter(levels(4), {"y": y}, engine=engine)
        for k in range(4):
            own = bmc.smooth(levels(1), {"y": y[:, k : k + 1]}, engine=engine, **options)
            np.testing.assert_allclose(found.var("x")[:, k], own.var("x")[:, 0], rtol=1e-9)
            np.testing.assert_allclose(found.mean("x")[:, k], own.mean("x")[:, 0], atol=1e-9)
    for k, last in ((0, 3), (1, 0), (2, 6)):
        np.testing.assert_array_equal(found.var("x")[last:, k], filtered.var("x")[last:, k])
        assert lag or k == 1 or (found.var("x")[:last, k] != filtered.var("x")[:last, k]).all()


def test_a_gap_over_which_the_smoother_is_lost_is_warned_of() -> None:
    """Its deviations there are far above the exact ones; with data in all rows it says nothing."""
    dbn, rows = stock(), {"price": [-0.6, None, None, None, None, -3.2, -5.1, -5.2, -4.8]}
    kim = SwitchingKalmanFilter()
    assert "p(x[t+1] | s[t+1], all rows)" in str(
        bmc.explain(dbn, rows, engine=kim, question="smooth")
    )
    with pytest.warns(EngineWarning, match="slice 0 the standard deviation of 'level' is") as told:
        found = bmc.smooth(dbn, rows, engine=kim)
    assert told[0].filename == __file__
    assert "use ExpectationPropagation() or ParticleFilter(particles)" in str(told[0].message)
    right = bmc.infer(dbn, rows, engine=bmc.Exact())
    assert np.sqrt(found.var("level")[0] / right.var("level[0]")) > 1.5
    for seen in (PRICES, [0.1, 0.0, 0.3, 0.2, 2.6, 1.1, 1.4], [None, None, 0.3, 0.6]):
        with warnings.catch_warnings():
            warnings.simplefilter("error", EngineWarning)
            bmc.smooth(dbn, {"price": seen}, engine=SwitchingKalmanFilter())


def test_what_has_just_failed_is_not_advised(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*args: Any) -> Any:
        raise UnsupportedError("messages are lost")

    monkeypatch.setattr(bmc.ExpectationPropagation, "smoothed", fails)
    rows = {"price": [-0.6, None, None, None, None, -3.2, -5.1, -5.2, -4.8]}
    with pytest.warns(EngineWarning) as told:
        bmc.smooth(stock(), rows)
    why, gap = (str(w.message) for w in told)
    assert "messages are lost" in why
    assert gap.endswith("too wide: use ParticleFilter(particles)")
    assert told[1].filename == __file__


def test_random_templates_raise_no_false_alarm_of_gaps() -> None:
    """What is warned of is too wide; of 120 templates none was."""
    for seed in range(session.scaled(40, 12)):
        case = random_switching_dbn(seed)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            engine = SwitchingKalmanFilter()
            bmc.smooth(case.dbn, case.observations, inputs=case.inputs, engine=engine)
        assert not [w for w in told if issubclass(w.category, EngineWarning)], seed


# ---- parameters that are bad where modes cannot be ----------------------------------------------


def bad_where(which: str) -> bmc.DynamicBayesNet:
    """Mode 1 is impossible where ``u`` is negative, and so are some scales of it."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    start = bmc.Bernoulli(0.5 if which == "now" else 0.0)
    if which == "table":  # a bad probability where the mode before cannot be
        dbn.add(
            "s",
            lambda s_prev, u: bmc.Bernoulli(
                np.where((s_prev == 1) & (u < 0), 2.0, np.where(u > 0, 0.3, 0.0))
            ),
            initial=start,
        )
    else:
        dbn.add("s", lambda s_prev, u: bmc.Bernoulli(np.where(u > 0, 0.3, 0.0)), initial=start)
    x0 = bmc.Normal(0.0, 1.0)
    if which == "before":
        dbn.add(
            "x",
            lambda x_prev, s_prev, u: bmc.Normal(x_prev, np.where(s_prev == 1, u, 1.0)),
            initial=x0,
        )
    else:
        dbn.add("x", lambda x_prev, s, u: bmc.Normal(x_prev, np.where(s == 1, u, 1.0)), initial=x0)
    dbn.add("y", lambda x: bmc.Normal(x, 0.3))
    return dbn


BAD = [
    ("now", [1.0, -1.0, 2.0, -6.0, 1.0]),
    ("before", [1.0, -1.0, -2.0, -2.0, 1.0]),
    ("table", [1.0, -1.0, -2.0, 1.0, 2.0]),
]


@pytest.mark.parametrize("linearize", [False, True])
@pytest.mark.parametrize(("which", "u"), BAD)
def test_what_is_bad_only_where_modes_cannot_be_is_no_matter(
    which: str, u: Any, linearize: bool
) -> None:
    """Where the mode is sure in every slice but the last, the answer is exact."""
    dbn, rows = bad_where(which), {"y": [0.1, 0.2, 0.3, 0.4, 0.5]}
    engine = SwitchingKalmanFilter(linearize=linearize)
    found = bmc.filter(dbn, rows, inputs={"u": u}, engine=engine)
    right = bmc.infer(dbn, rows, inputs={"u": u}, engine=bmc.Exact())
    assert abs(found.mean("x")[-1] - right.mean("x[4]")) < 1e-4
    bound = 1e-9 if which == "before" else 0.01
    assert abs(found.log_marginal_likelihood - right.log_marginal_likelihood) < bound
    smoothed = bmc.smooth(dbn, rows, inputs={"u": u}, engine=engine)
    assert abs(smoothed.mean("x")[0] - right.mean("x[0]")) < 1e-2
    belief = engine.start(dbn)
    for t in range(5):
        belief = engine.step(belief, {"y": rows["y"][t]}, inputs={"u": u[t]})
    assert abs(belief.mean("x") - found.mean("x")[-1]) < 1e-9


def test_what_is_bad_where_a_mode_can_be_is_told_with_one_slice_and_the_mode() -> None:
    dbn, rows = bad_where("now"), {"y": [0.1, 0.2, 0.3, 0.4, 0.5]}
    dbn.add("z", lambda x, u, s: bmc.Normal(x, np.where((u < -5) & (s == 0), u, 1.0)))
    inputs = {"u": [1.0, -1.0, 2.0, -6.0, 1.0]}
    with pytest.raises(ParameterError) as told:
        bmc.filter(dbn, {**rows, "z": rows["y"]}, inputs=inputs, engine=SwitchingKalmanFilter())
    told_of = "slice 3: node 'z': Normal: scale must be positive and finite; got -6."
    assert str(told.value) == f"{told_of} (where s is 0, s_prev is 0)"


# ---- remedies -----------------------------------------------------------------------------------


@pytest.mark.parametrize("has_modes", [False, True])
def test_remedies_that_are_named_can_answer(has_modes: bool) -> None:
    """A hidden count is for none of them; what counts by a hidden number is for those linearised."""
    hidden, seen = bmc.DynamicBayesNet(), bmc.DynamicBayesNet()
    for dbn in (hidden, seen):
        if has_modes:
            dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    first = bmc.Poisson(3.0)
    if has_modes:
        hidden.add("n", lambda n_prev, s: bmc.Poisson(1.0 + n_prev + s), initial=first)
    else:
        hidden.add("n", lambda n_prev: bmc.Poisson(1.0 + n_prev), initial=first)
    hidden.add("y", lambda n: bmc.Normal(n, 1.0))
    start = bmc.Normal(0.0, 1.0)
    if has_modes:
        seen.add("x", lambda x_prev, s: bmc.Normal(x_prev, 0.1 + s), initial=start)
    else:
        seen.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=start)
    seen.add("y", lambda x: bmc.Poisson(np.exp(x)))
    able = {
        "ExtendedKalmanFilter": bmc.ExtendedKalmanFilter(),
        "UnscentedKalmanFilter": bmc.UnscentedKalmanFilter(),
        "SwitchingKalmanFilter(linearize=True)": SwitchingKalmanFilter(linearize=True),
        "SwitchingKalmanFilter or": SwitchingKalmanFilter(linearize=True),
        "ParticleFilter": bmc.ParticleFilter(200),
    }
    for dbn, engine in itertools.product(
        (hidden, seen), (bmc.KalmanFilter(), SwitchingKalmanFilter())
    ):
        with pytest.raises(UnsupportedError) as told:
            bmc.filter(dbn, {"y": [1, 2, 3]}, engine=engine)
        text = str(told.value)
        assert text.count("ParticleFilter") == 1, text
        for remedy in (r for r in able if re.search(rf"\b{re.escape(r)}", text.split("; use ")[1])):
            bmc.filter(dbn, {"y": [1, 2, 3]}, engine=able[remedy], rng=0)
