"""``SwitchingKalmanFilter`` where rows are missing in part, modes cannot be, or parameters are bad."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import SwitchingKalmanFilter
from bayesmc.dbn import pose_series
from bayesmc.engines.kalman.data import pattern_of

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
