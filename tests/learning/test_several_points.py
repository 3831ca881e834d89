"""Evidences of several points in one pass, and the slopes they tell, beside passes of their own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.learning import several_points
from bayesmc.learning.objectives import Evidence
from bayesmc.learning.series_evidence import SeriesEvidence, of_template


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.add_static("q", bmc.HalfNormal(1.0))
    dbn.add_static("r", bmc.HalfNormal(1.0))
    dbn.add_static("known", bmc.Normal(0.0, 1.0))
    dbn.add("x", lambda x_prev, q, u: bmc.Normal(0.9 * x_prev + u, q), initial=bmc.Normal(0.0, 2.0))
    dbn.add("y", lambda x, r, known: bmc.Normal(x + known, r))
    return dbn


def vectors() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add_static("q", bmc.HalfNormal(1.0), plates="k")

    @dbn.node(initial=bmc.MvNormal(np.zeros(2), np.eye(2)), plates="k")
    def x(x_prev: Any, q: Any) -> Any:
        return bmc.MvNormal(x_prev, q[..., None, None] ** 2 * np.eye(2))

    dbn.add("y", lambda x: bmc.MvNormal(x, np.eye(2)), plates="k")
    return dbn


def hidden() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("stay", bmc.Beta(2.0, 2.0))
    dbn.add_static("level", bmc.Normal(0.0, 2.0))
    dbn.add("s", lambda s_prev, stay: bmc.Bernoulli(np.where(s_prev == 1, stay, 1 - stay)),
            initial=bmc.Bernoulli(0.5))  # fmt: skip
    dbn.add("y", lambda s, level: bmc.Normal(level * s, 1.0))
    return dbn


def volatility() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("m", bmc.Normal(0.0, 1.0))
    dbn.add(
        "h", lambda h_prev, m: bmc.Normal(m + 0.8 * (h_prev - m), 0.5), initial=bmc.Normal(0, 1)
    )
    dbn.add("y", lambda h: bmc.Normal(0.0, np.exp(h / 2)))
    return dbn


def objective(dbn: bmc.DynamicBayesNet, rows: dict[str, Any], inputs: Any, names: tuple[str, ...],
              prior: bool = False, engine: Any = None) -> SeriesEvidence:  # fmt: skip
    problem = pose_series(dbn, rows, inputs)
    return of_template(dbn, problem, rows, inputs, names, prior, engine)[0]


CASES: dict[str, Any] = {
    "walk": lambda prior: objective(
        walk(), {"y": [0.1, None, 0.9, 1.4], "known": 0.3}, {"u": np.arange(4.0)}, ("q", "r"), prior),
    "vectors": lambda prior: objective(
        vectors(), {"y": vectors().sample(4, rng=0)["y"][0]}, None, ("q",), prior),
    "states": lambda prior: objective(hidden(), {"y": [0.1, 1.3, 0.9, None]}, None, ("stay", "level"), prior),
    "grid": lambda prior: objective(
        volatility(), {"y": [0.4, -1.3, 0.2]}, None, ("m",), prior, bmc.GridFilter({"h": (-6, 6, 60)})),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("prior", [False, True])
def test_points_side_by_side_are_points_one_by_one(case: str, prior: bool) -> None:
    asked = CASES[case](prior)
    us = np.random.default_rng(0).normal(size=(5, asked.size))
    together = asked._at_once(us)
    alone = [Evidence.value(asked, u) for u in us]
    assert together is not None
    np.testing.assert_allclose(together, alone, rtol=1e-9)
    np.testing.assert_allclose(asked.values(us), alone, rtol=1e-9)
    for u in us[:2]:
        np.testing.assert_allclose(asked.gradient(u), Evidence.gradient(asked, u), atol=2e-4)
        assert asked.value(u) == pytest.approx(Evidence.value(asked, u), rel=1e-9)


def test_one_pass_tells_value_and_slope(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = CASES["walk"](False)
    u = np.array([0.1, 0.2])
    asked.value(u)  # held against passes of their own
    monkeypatch.setattr(asked, "log_evidence", lambda values: pytest.fail("a pass of its own"))
    asked.value(u + 0.1)
    monkeypatch.setattr(
        several_points.SeveralPoints, "log_evidences", lambda *_: pytest.fail("twice")
    )
    assert np.isfinite(asked.gradient(u + 0.1)).all() and np.isfinite(asked.value(u + 0.1))


def test_answers_that_are_wrong_are_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = CASES["walk"](False)
    own = several_points.SeveralPoints.log_evidences

    def swapped(self: Any, points: Any) -> Any:
        found = own(self, points)
        return None if found is None else found[::-1]

    monkeypatch.setattr(several_points.SeveralPoints, "log_evidences", swapped)
    us = np.random.default_rng(0).normal(size=(3, 2))
    np.testing.assert_allclose(asked.values(us), [Evidence.value(asked, u) for u in us])
    np.testing.assert_allclose(asked.gradient(us[0]), Evidence.gradient(asked, us[0]))


def test_a_point_where_nothing_can_be_told_leaves_the_others() -> None:
    asked = CASES["walk"](False)
    us = np.array([[0.1, 0.2], [2000.0, 0.3], [0.3, 0.1]])
    found = asked.values(us)
    assert np.isfinite(found[[0, 2]]).all() and not np.isfinite(found[1])


def test_a_bar_says_what_is_climbed(capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setattr("bayesmc.progress.time.monotonic", iter(np.arange(0.0, 1e6, 2.0)).__next__)
    rows = {"y": [0.4, 1.3, -0.2, 2.0], "known": 0.0}
    bmc.fit(walk(), rows, inputs={"u": np.zeros(4)}, restarts=1, prior=True, progress=True)
    told = capsys.readouterr().err
    assert "fit: 32 starts" in told
    bmc.fit(walk(), rows, inputs={"u": np.zeros(4)}, restarts=1, prior=True, progress=False)
    assert not capsys.readouterr().err
