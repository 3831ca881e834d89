"""A filter that merges Gaussians and that nobody named says by how much merging may matter."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import SwitchingKalmanFilter
from bayesmc.auto import choosing, switching
from bayesmc.errors import EngineWarning
from bayesmc.testing import session
from bayesmc.testing.makers.switching_dbns import random_switching_dbn

SEEDS = range(session.scaled(24, 10))


def system(seed: int, steps: int = 6) -> tuple[bmc.DynamicBayesNet, dict[str, np.ndarray]]:
    """A random system of two numbers in two modes of unlike noise, and rows about one."""
    rng = np.random.default_rng(seed)
    turn = 0.9 * np.linalg.qr(rng.normal(size=(2, 2)))[0]
    spread = np.exp(rng.normal(size=2) + [-1.5, 1.0])
    stays = rng.uniform(0.5, 0.95, 2)
    dbn = bmc.DynamicBayesNet()
    table = [[stays[0], 1 - stays[0]], [1 - stays[1], stays[1]]]
    dbn.table("s", ["s_prev"], table, initial=[0.5, 0.5])
    covs = (spread**2)[:, None, None] * np.eye(2)
    start = bmc.MvNormal(np.zeros(2), np.eye(2))
    dbn.add("x", lambda x_prev, s: bmc.MvNormal(np.matvec(turn, x_prev), covs[s]), initial=start)
    dbn.add("y", lambda x: bmc.Normal(x[..., 0], 0.3))
    return dbn, {"y": 2.0 * rng.normal(size=steps)}


def told(dbn: bmc.DynamicBayesNet, rows: object, inputs: object = None) -> tuple[str, float]:
    """What ``filter`` warns of, "" for nothing, and its log evidence."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = bmc.filter(dbn, rows, inputs=inputs)
    words = [str(w.message) for w in caught if issubclass(w.category, EngineWarning)]
    logs = np.sum(found.log_marginal_increments, axis=0)
    return " ".join(words), float(np.ravel(logs).sum())


def test_no_log_evidence_is_far_off_without_a_word() -> None:
    spoken = []
    for seed in SEEDS:
        dbn, rows = system(seed)
        if seed % 3 == 0:
            rows["y"][2:4] = np.nan
        wanted = bmc.infer(dbn, rows, engine=bmc.Exact()).log_marginal_likelihood
        words, found = told(dbn, rows)
        spoken.append("merges Gaussians" in words)
        assert abs(found - wanted) < 0.1 or spoken[-1], seed
        assert ("rows are missing" in words) == (seed % 3 == 0)
    assert any(spoken) and not all(spoken)


def test_differences_are_those_of_both_filters() -> None:
    dbn, rows = system(1)
    both = [bmc.filter(dbn, rows, engine=bmc.SwitchingKalmanFilter(r)) for r in ("gpb2", "gpb1")]
    evidence = abs(np.subtract(*(f.log_marginal_likelihood for f in both)))
    probability = np.abs(np.subtract(*(f.probabilities("s") for f in both))).max()
    words = told(dbn, rows)[0]
    assert f"differs by {evidence:.2g} and probabilities by up to {probability:.2g}" in words


def test_what_evidence_alone_tells_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    dbn, rows = system(1)
    for pair, spoken in [((0.11, 0.0), True), ((0.0, 0.11), True), ((0.09, 0.09), False)]:
        monkeypatch.setattr(switching, "_differences", lambda *_, pair=pair: pair)
        assert ("merges Gaussians" in told(dbn, rows)[0]) == spoken


def test_several_series_and_fixed_lags_are_told_of() -> None:
    dbn, rows = system(1)
    with pytest.warns(EngineWarning, match="filter: SwitchingKalmanFilter answers"):
        bmc.filter(dbn, [rows, rows])
    with pytest.warns(EngineWarning, match="smooth: SwitchingKalmanFilter answers"):
        bmc.smooth(dbn, rows, lag=2)


def test_smoothers_are_held_against_smoothers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choosing, "why_too_long", lambda *_: "too long")
    dbn, rows = system(1)
    both = [bmc.smooth(dbn, rows, engine=bmc.SwitchingKalmanFilter(r)) for r in ("gpb2", "gpb1")]
    probability = np.abs(np.subtract(*(f.probabilities("s") for f in both))).max()
    with pytest.warns(EngineWarning, match=f"smooth: .*by up to {probability:.2g}"):
        bmc.smooth(dbn, rows)


@pytest.mark.parametrize("shorter", [True, False])
def test_whoever_stops_the_comparison_has_the_answer(
    shorter: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    dbn, rows = system(1)
    plain = SwitchingKalmanFilter.filter

    def stopped(self: SwitchingKalmanFilter, problem: Any, seed: Any, **options: Any) -> Any:
        found = plain(self, problem, seed, **options)
        if self.merging == "gpb1":
            if shorter:
                return found.last(3, "filter")
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(SwitchingKalmanFilter, "filter", stopped)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert bmc.filter(dbn, rows).steps == 6


def test_modes_that_make_no_difference_are_not_spoken_of() -> None:
    for seed in SEEDS:
        case = random_switching_dbn(seed, 0.0)
        assert "merges" not in told(case.dbn, case.observations, case.inputs or None)[0]


def test_the_line_that_asked_is_named_and_an_engine_that_is_named_is_silent() -> None:
    with pytest.warns(
        EngineWarning, match="filter: .*differs by .* by up to 0.*ParticleFilter"
    ) as said:
        bmc.filter(*system(1))
    assert said[0].filename == __file__
    with pytest.warns(EngineWarning, match="forecast: SwitchingKalmanFilter answers") as said:
        bmc.forecast(*system(1), steps=2)
    assert said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bmc.filter(*system(1), engine=bmc.SwitchingKalmanFilter())
        bmc.forecast(*system(1), steps=2, engine=bmc.SwitchingKalmanFilter())


def test_a_filter_that_is_held_against_itself_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planted fault: the test above would see it."""
    monkeypatch.setattr(switching, "replace", lambda engine, **_: engine)
    assert "merges" not in told(*system(1))[0]
