"""The log evidence by one pass over arrays against the filter's own, slice by slice."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.engines.grid import chain
from bayesmc.engines.grid.filter import GridFilter
from bayesmc.errors import ParameterError
from bayesmc.learning.series_evidence import SeriesEvidence, of_template


def counts(steps: int = 400) -> tuple[bmc.DynamicBayesNet, dict[str, Any], dict[str, Any]]:
    """Counts of a random walk; with an input, and rows that are missing."""
    rng = np.random.default_rng(20261128)  # the same whichever tests ran before
    dbn = bmc.DynamicBayesNet("counts")
    dbn.input("law")
    dbn.add_static("s", bmc.HalfNormal(0.5))
    dbn.add_static("effect", bmc.Normal(0.0, 1.0))
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev, s), initial=bmc.Normal(1.0, 1.0))
    dbn.add("n", lambda x, law, effect: bmc.Poisson(np.exp(x + effect * law)))
    dbn.add("z", lambda x: bmc.Normal(x, 0.7))
    law = (np.arange(steps) > steps // 2).astype(float)
    x = 1.5 + np.cumsum(0.05 * rng.normal(size=steps))
    z = x + 0.7 * rng.normal(size=steps)
    z[rng.random(steps) < 0.3] = np.nan
    return dbn, {"n": rng.poisson(np.exp(x - 0.3 * law)), "z": z}, {"law": law}


def volatility(steps: int = 300) -> tuple[bmc.DynamicBayesNet, dict[str, Any], None]:
    """The first slice is unlike the others."""
    dbn = bmc.DynamicBayesNet("volatility")
    dbn.add_static("phi", bmc.Uniform(-1.0, 1.0))
    dbn.add_static("sd", bmc.HalfNormal(0.5))
    dbn.add(
        "h",
        lambda h_prev, phi, sd: bmc.Normal(phi * h_prev, sd),
        initial=lambda phi, sd: bmc.Normal(0.0, sd / np.sqrt(1 - phi**2)),
    )
    dbn.add("r", lambda h: bmc.Normal(0.0, np.exp(h / 2)))
    return dbn, {"r": np.random.default_rng(1).normal(size=steps)}, None


CASES = {
    "counts": (counts, {"s": 0.1, "effect": -0.2}),
    "volatility": (volatility, {"phi": 0.9, "sd": 0.3}),
}


@pytest.mark.filterwarnings("ignore::bayesmc.errors.GridWarning")  # the error of a taken grid
@pytest.mark.parametrize("case", CASES)
def test_it_is_the_evidence_of_the_filter(case: str) -> None:
    make, static = CASES[case]
    dbn, data, inputs = make()
    engine = GridFilter()
    problem = pose_series(dbn, {**data, **static}, inputs)
    grid = engine.grid_for(problem)
    for scale in (1.0, 0.9, 1.1):
        values = {n: v * scale for n, v in static.items()}
        problems = [pose_series(dbn, {**data, **values}, inputs) for _ in range(2)]
        for one in problems:
            engine.taking(one, grid)
        whole = engine.filter(problems[0], np.random.SeedSequence(0), progress=False)
        found, off = engine.log_evidence(problems[1])
        np.testing.assert_allclose(found, whole.log_marginal_likelihood, rtol=1e-12)
        assert off < 1e-2
        mover, _ = engine._start(problems[1])
        rows = chain.increments_along(mover, problems[1].series)
        np.testing.assert_allclose(rows, whole.log_marginal_increments, rtol=0, atol=1e-10)


def timed(dbn: bmc.DynamicBayesNet) -> None:
    dbn.add("x", lambda x_prev, s, t: bmc.Normal(x_prev, s * (1 + 0.01 * t)),
            initial=bmc.Normal(1.0, 1.0))  # fmt: skip


def read_before(dbn: bmc.DynamicBayesNet) -> None:
    dbn.add("z", lambda x, x_prev: bmc.Normal(x + 0.1 * x_prev, 0.7),
            initial=lambda x: bmc.Normal(x, 0.7))  # fmt: skip


def of_rows(dbn: bmc.DynamicBayesNet) -> None:
    dbn.add("x", lambda x_prev, z_prev, s: bmc.Normal(x_prev + 0.1 * z_prev, s),
            initial=bmc.Normal(1.0, 1.0))  # fmt: skip


@pytest.mark.parametrize("change", [timed, read_before, of_rows])
def test_slices_that_differ_otherwise_are_moved_one_by_one(change: Any) -> None:
    dbn, data, inputs = counts(60)
    data["z"] = np.nan_to_num(data["z"], nan=1.0)
    other = bmc.DynamicBayesNet("other")
    other.input("law")
    other.add_static("s", bmc.HalfNormal(0.5))
    declared = {
        "x": lambda: other.add("x", lambda x_prev, s: bmc.Normal(x_prev, s),
                               initial=bmc.Normal(1.0, 1.0)),
        "n": lambda: other.add("n", lambda x, law: bmc.Poisson(np.exp(x - 0.3 * law))),
        "z": lambda: other.add("z", lambda x: bmc.Normal(x, 0.7)),
    }  # fmt: skip
    changed = "z" if change is read_before else "x"
    for name, declare in declared.items():
        if name == changed:
            change(other)
        else:
            declare()
    engine, static = GridFilter(), {"s": 0.1}
    problem = pose_series(other, {**data, **static}, inputs)
    mover, _ = engine._start(problem)
    assert chain.increments_along(mover, problem.series) is None
    whole = engine.filter(problem, np.random.SeedSequence(0), progress=False)
    assert engine.log_evidence(problem)[0] == pytest.approx(whole.log_marginal_likelihood)


def test_bad_parameters_are_told_by_the_slow_way() -> None:
    dbn = bmc.DynamicBayesNet("bad")
    dbn.input("shift")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(2.0, 0.3))
    dbn.add("n", lambda x, shift: bmc.Poisson(x - shift))
    shift = np.zeros(50)
    shift[40:] = 1.9
    problem = pose_series(dbn, {"n": np.full(50, 2)}, {"shift": shift})
    with pytest.raises(ParameterError, match=r"'n'"):
        GridFilter({"x": np.linspace(0.05, 5.0, 200)}).log_evidence(problem)


def test_a_grid_that_does_not_fit_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Densities narrower than cells add up to more than 1, so that the evidence would rise for ever."""
    dbn, data, inputs = counts(200)
    found, unknowns = of_template(
        dbn, pose_series(dbn, data, inputs), data, inputs, ("s", "effect"), False, None
    )
    assert isinstance(found, SeriesEvidence)
    wide, narrow = (
        unknowns.numbers({"s": np.array(s), "effect": np.array(-0.2)}) for s in (0.3, 0.04)
    )
    assert found.settle(narrow)
    alone = found.value(narrow)
    assert found.settle(wide)
    assert np.isfinite(found.value(wide))
    assert found.value(narrow) == pytest.approx(alone, abs=1e-3)
    # negative control: without a look at the mass the grid is taken, and is off by a hundred times as much
    assert found.settle(wide)
    monkeypatch.setattr(found, "_off", np.inf)
    assert abs(found.value(narrow) - alone) > 0.1


def test_trials_that_take_far_more_cells_are_refused() -> None:
    dbn, data, inputs = counts(100)
    found, unknowns = of_template(
        dbn, pose_series(dbn, data, inputs), data, inputs, ("s", "effect"), False, None
    )
    wide, narrow = (
        unknowns.numbers({"s": np.array(s), "effect": np.array(-0.2)}) for s in (0.3, 0.004)
    )
    assert found.settle(wide)
    assert np.isfinite(found.value(wide))
    assert found.value(narrow) == -np.inf
    assert "no step is worth" in str(found.refused)
    assert np.isfinite(found.value(wide))
