"""``SwitchingKalmanFilter`` where rows are missing in part, modes cannot be, or parameters are bad."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import SwitchingKalmanFilter
from bayesmc.dbn import pose_series
from bayesmc.engines.kalman.data import pattern_of
from bayesmc.errors import ZeroProbabilityError

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
    dbn.add(
        "x", lambda x_prev, s: bmc.Normal(x_prev + s, 0.3 + s), initial=bmc.Normal(0.0, 1.0)
    )
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
