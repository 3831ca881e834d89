"""A filter that merges Gaussians and that nobody named says by how much merging may matter."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.auto import switching
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


def test_no_log_evidence_is_further_off_than_is_told() -> None:
    spoken = []
    for seed in SEEDS:
        dbn, rows = system(seed)
        wanted = bmc.infer(dbn, rows, engine=bmc.Exact()).log_marginal_likelihood
        words, found = told(dbn, rows)
        spoken.append("merges Gaussians" in words)
        differs = re.search(r"log evidence that differs by ([\d.e-]+)", words)
        assert abs(found - wanted) <= max(0.3, float(differs[1]) if differs else 0.0), seed
    assert any(spoken)


def test_modes_that_make_no_difference_are_not_spoken_of() -> None:
    for seed in SEEDS:
        case = random_switching_dbn(seed, 0.0)
        assert "merges" not in told(case.dbn, case.observations, case.inputs or None)[0]


def test_the_line_that_asked_is_named_and_an_engine_that_is_named_is_silent() -> None:
    with pytest.warns(EngineWarning, match="filter: .* by 0.* by up to 0.*ParticleFilter") as said:
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
