"""Smoothing by particles where nobody says how many, and the errors that it states, against exact answers.

Errors are held against those that are made: over runs and slices the root mean square of (answer - exact) /
stated error is near 1. Thirty slices of five runs hang together like some forty independent figures, so that
their root mean square lies outside of (0.65, 1.5) with a chance below 1e-4 where errors are right; those of
the level that hardly moves are five figures, whose lower end is 0.3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.particles import backward as backward_simulation
from bayesmc.engines.particles.coalescence import Sharing
from bayesmc.errors import LowEssWarning
from bayesmc.testing import session

RUNS, STEPS = 5, 30


def line() -> tuple[bmc.DynamicBayesNet, str]:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.3))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn, "x"


def slow() -> tuple[bmc.DynamicBayesNet, str]:
    """Rows that say little of a level that hardly moves: particles are seldom resampled."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.98 * x_prev, 0.15), initial=bmc.Normal(0.0, 0.75))
    dbn.add("y", lambda x: bmc.Normal(x, 3.0))
    return dbn, "x"


def lag() -> tuple[bmc.DynamicBayesNet, str]:
    dbn, start = bmc.DynamicBayesNet(), bmc.Normal(0.0, 1.2)

    def x(x_prev: Any, l_prev: Any) -> bmc.Normal:
        return bmc.Normal(1.2 * x_prev - 0.6 * l_prev, 0.8)

    dbn.add("x", x, initial=start)
    dbn.add("b", start)
    dbn.add("l", lambda x_prev: x_prev, initial=lambda b: b)
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))
    return dbn, "l"


def plate() -> tuple[bmc.DynamicBayesNet, str]:
    """Two levels that never meet: filters side by side."""
    dbn = bmc.DynamicBayesNet(plates={"i": 2})
    start = bmc.Normal(0.0, 2.0)
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=start, plates="i")
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    return dbn, "x"


def states() -> tuple[bmc.DynamicBayesNet, str]:
    dbn = bmc.DynamicBayesNet()
    table = [[0.9, 0.1], [0.2, 0.8]]
    dbn.table("z", ["z_prev"], table, ("low", "high"), initial=[0.5, 0.5])
    dbn.add("y", lambda z: bmc.Normal(np.where(z == "high", 1.0, 0.0), 1.2))
    return dbn, "z"


CASES = [line, slow, lag, plate, states]


def level(case: Callable[[], tuple[bmc.DynamicBayesNet, str]]) -> float:
    """Root mean square of errors over stated errors."""
    dbn, name = case()
    rows = {"y": dbn.sample(STEPS, 1, rng=5)["y"][0]}
    exact = bmc.smooth(dbn, rows)
    labelled = exact.model[name].domain is not None
    found = []
    for k in range(RUNS):
        options: dict[str, Any] = {"engine": bmc.ParticleFilter(300), "trajectories": 1000}
        drawn = bmc.smooth(dbn, rows, rng=session.seed() + k, **options)
        ask = (lambda p: p.probabilities(name)) if labelled else (lambda p: p.mean(name))
        found.append((ask(drawn) - ask(exact)) / drawn.mcse(name))
    return float(np.sqrt(np.mean(np.square(found))))


@pytest.mark.parametrize("case", CASES)
def test_stated_errors_are_those_that_are_made(case: Any) -> None:
    assert (0.3 if case is slow else 0.65) < level(case) < 1.5


@pytest.mark.parametrize("case", [line, slow])
def test_errors_that_forget_shared_particles_are_caught(
    case: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Sharing._part
    monkeypatch.setattr(Sharing, "_part", lambda self, s, off: 0.0 * real(self, s, off))
    assert level(case) > 1.5


def test_functions_and_queries_have_errors_too() -> None:
    dbn, _ = line()
    rows = {"y": dbn.sample(15, 1, rng=5)["y"][0]}
    queries = {"same": lambda x: x, "never": lambda x: x > 50.0}
    engine = bmc.ParticleFilter(500)
    found = bmc.smooth(dbn, rows, engine=engine, rng=0, queries=queries)
    np.testing.assert_allclose(found.queries_mcse["same"], found.mcse("x"), rtol=1e-9)
    np.testing.assert_allclose(found.mcse(lambda x: 2.0 * x), 2.0 * found.mcse("x"), rtol=1e-9)
    assert (found.queries["never"] == 0).all() and (found.queries_mcse["never"] > 1e-3).all()


# ---- where particles cannot tell ------------------------------------------------------------------


def jump(two: bool = True) -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """A level that jumps by forty of its steps in the middle of a series."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("a", lambda a_prev: bmc.Normal(a_prev, 0.1), initial=bmc.Normal(0.0, 1.0))
    if two:
        dbn.add("b", lambda b_prev: bmc.Normal(0.9 * b_prev, 0.1), initial=bmc.Normal(0.0, 0.3))
        dbn.add("y", lambda a, b: bmc.Normal(a + b, 0.2))
    else:
        dbn.add("y", lambda a: bmc.Normal(a, 0.2))
    y = np.random.default_rng(0).normal(0.0, 0.2, 40)
    y[20:] += 4.0
    return dbn, {"y": y}


@pytest.mark.parametrize("two", [True, False])
@pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")
def test_a_jump_is_no_sure_answer(two: bool) -> None:
    dbn, rows = jump(two)
    exact = bmc.smooth(dbn, rows, engine=bmc.KalmanFilter())
    with pytest.warns(LowEssWarning, match="cannot tell|worth less than"):
        found = bmc.smooth(dbn, rows, engine=bmc.ParticleFilter(budget=400_000), rng=0)
    off = np.abs(found.mean("a") - exact.mean("a"))
    assert off.max() > 0.5  # the answer is wrong, and says so
    assert (off <= 4.0 * found.mcse("a")).all()
    assert np.isinf(found.mcse("a")[19:22]).all()


def test_a_step_that_leaves_one_particle_says_so_once() -> None:
    dbn, rows = jump()
    engine = bmc.ParticleFilter()
    belief = engine.start(dbn, rng=0)
    for value in rows["y"][:20]:
        belief = engine.step(belief, {"y": value})
    assert np.isfinite(belief.log_marginal_likelihood_mcse)
    with pytest.warns(LowEssWarning, match="step leaves 1000 particles.*slice 20") as caught:
        for value in rows["y"][20:26]:
            belief = engine.step(belief, {"y": value})
    assert len(caught) == 1 and caught[0].filename == __file__
    assert np.isinf(belief.log_marginal_likelihood_mcse)


# ---- how many particles, and which are tried ------------------------------------------------------


def test_the_default_grows_as_a_filter_does() -> None:
    """The filter below is the one whose particles are kept, draw by draw; trajectories stay at a thousand."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Normal(-4.0, 0.754)
    dbn.add("x", lambda x_prev: bmc.Normal(-4 + 0.98 * (x_prev + 4), 0.15), initial=start)
    dbn.add("y", lambda x: bmc.Binomial(5000, logits=x))
    rows = {"y": dbn.sample(80, 1, rng=1)["y"][0]}
    engine = bmc.ParticleFilter()
    filtered = bmc.filter(dbn, rows, engine=engine, rng=0, keep="particles")
    found = bmc.smooth(dbn, rows, engine=engine, rng=0)
    assert filtered.counts[0] > 1000
    assert found.log_marginal_likelihood == filtered.log_marginal_likelihood
    assert found.particles("x").shape == (80, 1000)
    exact = bmc.smooth(dbn, rows)
    # eighty figures: a false alarm in fewer than one of a hundred runs with other seeds
    assert (np.abs(found.mean("x") - exact.mean("x")) < 4.0 * found.mcse("x")).all()


def drawn_backwards(seed: int) -> np.ndarray:
    """Errors of a smoothed position that moves by its velocity and next to nothing else."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("v", lambda v_prev: bmc.Normal(v_prev, 0.05), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "x", lambda x_prev, v_prev: bmc.Normal(x_prev + v_prev, 0.001), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    rows = {"y": dbn.sample(30, 1, rng=1)["y"][0]}
    engine = bmc.ParticleFilter(4000)
    found = bmc.smooth(dbn, rows, engine=engine, rng=seed, trajectories=500)
    exact = bmc.smooth(dbn, rows)
    return (found.mean("v") - exact.mean("v")) / exact.std("v")


def test_narrow_transitions_go_by_ancestors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no candidate would do but the ancestor; without it, others are taken that do not fit."""
    assert np.abs(drawn_backwards(session.seed())).max() < 0.6
    anyone = lambda cloud, index: np.zeros_like(index)  # noqa: E731
    monkeypatch.setattr(backward_simulation, "_parents", anyone)
    assert np.abs(drawn_backwards(session.seed())).max() > 0.6
