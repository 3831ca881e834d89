"""Rows of a regression visited all at once: the fixed points of row by row, and what where they swing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.engines.propagation.lines import LineBatch
from bayesmc.engines.propagation.pace import Pace
from bayesmc.engines.propagation.system import system_of
from bayesmc.network import pose
from benchmarks.floors import probit


def regression(design: np.ndarray, sd: float) -> bmc.BayesNet:
    net = bmc.BayesNet("probit", plates={"row": len(design)})
    columns = design.shape[1]
    net.add("w", bmc.MvNormal(np.zeros(columns), sd**2 * np.eye(columns)))
    net.add("y", lambda w: bmc.Bernoulli(special.ndtr(np.vecdot(design, w))), plates="row")
    return net


def held_against_row_by_row(design: np.ndarray, y: np.ndarray, sd: float, engine: object) -> object:
    found = bmc.infer(regression(design, sd), {"y": y}, engine=engine)
    floor = probit.one_by_one(sd * design, y, tolerance=1e-13, most=300)
    np.testing.assert_allclose(found.mean("w") / sd, floor.mean, atol=1e-9)
    np.testing.assert_allclose(found.cov("w") / sd**2, floor.cov, atol=1e-9)
    assert found.log_marginal_likelihood == pytest.approx(floor.log_evidence, abs=1e-9)
    return found


def test_rows_at_once_end_where_rows_in_turn_do() -> None:
    rng = np.random.default_rng(3)
    engine = bmc.ExpectationPropagation(tolerance=1e-11)
    for rows, columns, sd in ((300, 6, 1.0), (40, 60, 3.0), (200, 3, 30.0)):
        design = rng.normal(size=(rows, columns))
        y = (design[:, 0] + rng.normal(size=rows) > 0).astype(int)
        held_against_row_by_row(design, y, sd, engine)
    by_hand = probit.in_parallel(design * sd, y, tolerance=1e-12)
    assert by_hand.log_evidence == pytest.approx(
        probit.one_by_one(design * sd, y).log_evidence, abs=1e-6
    )


def test_rows_that_overshoot_together_are_visited_in_parts() -> None:
    """Five hundred equal rows under a vague prior swing however short their steps are."""
    design, y = np.ones((500, 1)), np.ones(500, dtype=int)
    engine = bmc.ExpectationPropagation(tolerance=1e-11, sweeps=300)
    found = held_against_row_by_row(design, y, 100.0, engine)
    assert found.converged  # type: ignore[attr-defined]


def test_what_is_kept_with_a_model_is_read_anew_where_what_is_known_changes() -> None:
    design = np.random.default_rng(0).normal(size=(30, 2))
    net = bmc.BayesNet("probit", plates={"row": 30})
    net.input("shift")
    net.add("w", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add(
        "y",
        lambda w, shift: bmc.Bernoulli(special.ndtr(np.vecdot(design, w) + shift)),
        plates="row",
    )
    y = np.tile([0, 1], 15)
    engine = bmc.ExpectationPropagation(tolerance=1e-11)
    for shift in (0.0, 2.0):
        found = bmc.infer(net, {"y": y}, inputs={"shift": shift}, engine=engine)
        wide = bmc.BayesNet("probit", plates={"row": 30})
        wide.add("w", bmc.MvNormal(np.zeros(2), np.eye(2)))
        wide.add(
            "y",
            lambda w, shift=shift: bmc.Bernoulli(special.ndtr(np.vecdot(design, w) + shift)),
            plates="row",
        )
        other = bmc.infer(wide, {"y": y}, engine=engine)
        np.testing.assert_allclose(found.mean("w"), other.mean("w"), atol=1e-12)
    part = bmc.infer(net, {"y": [1, *[None] * 29]}, inputs={"shift": 0.0}, engine=engine)
    again = bmc.infer(net, {"y": [*[None] * 29, 1]}, inputs={"shift": 0.0}, engine=engine)
    assert abs(part.mean("w") - again.mean("w")).max() > 0.01


def test_only_factors_of_one_number_without_states_are_flat() -> None:
    net = regression(np.eye(3), 1.0)
    assert all(isinstance(b, LineBatch) for b in system_of(pose(net, {"y": [0, 1, 1]})).batches)


def test_damping_goes_where_it_only_slows_and_comes_back() -> None:
    ahead, pace = np.ones(1), Pace(0.5)
    for change in (1.0, 0.55, 0.3):
        pace.saw(change, ahead)
    assert pace.share == 1.0
    for change in (0.1, 0.09):  # whole steps come no closer
        pace.saw(change, -ahead)
        ahead = -ahead
    assert pace.share == 0.5
    steady = Pace(0.5)
    for _ in range(30):  # far to go, always the same way: shorter steps would not help
        steady.saw(1.0, ahead)
    assert steady.share == 0.5
