"""Finite nodes that particles integrate out as tables, against exact filters.

Comparisons that chance has a part in have a false-alarm rate of 1e-3 or less, at fixed seeds.
"""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.engines.marginal.options import split_of_problem
from bayesmc.errors import BudgetError, LowEssWarning, QueryError, UnsupportedError
from bayesmc.testing import exact, random_dbn, repeated_test, session

AUTO = bmc.ParticleFilter(12, marginalize="auto")
Maker = Callable[[], tuple[bmc.DynamicBayesNet, dict[str, Any]]]


def off(found: Any, wanted: Any) -> float:
    """Largest difference, relative where numbers are above 1."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    return float((np.abs(found - wanted) / (1 + np.abs(wanted))).max(initial=0.0))


def walk(cells: int, stay: float = 0.2) -> np.ndarray:
    """Transitions of one who goes round, and sometimes stays."""
    return stay * np.eye(cells) + (1 - stay) * np.roll(np.eye(cells), 1, axis=1)


def ring(cells: int, flip: float = 0.0, right: float = 0.9) -> bmc.DynamicBayesNet:
    """Murphy's colour map: one who goes round sees the colour of the cell, sometimes wrongly."""
    dbn = bmc.DynamicBayesNet("colour map", plates={"cell": cells})
    dbn.add(
        "color",
        lambda color_prev: bmc.Bernoulli(np.where(color_prev == 1, 1 - flip, flip)),
        initial=bmc.Bernoulli(0.5),
        plates="cell",
    )
    dbn.table("place", ["place_prev"], walk(cells), initial=np.eye(cells)[0])
    dbn.add(
        "reading",
        lambda color, place: bmc.Bernoulli(np.where(color[place] == 1, right, 1 - right)),
    )
    return dbn


# ---- templates of which a part has tables -------------------------------------------------------


def static_ring() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    return ring(4), {"reading": [1, 0, np.nan, 1, 1]}


def flipping_ring() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """Cells that are seen by themselves now and then."""
    color = np.full((5, 4), np.nan)
    color[1, 2], color[3, 0] = 1, 0
    return ring(4, 0.2), {"reading": [1, 0, 0, np.nan, 1], "color": color}


def several_sensors() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """Sensors that look at cells side by side, one of them by way of a computed node; rows partly seen."""
    dbn = bmc.DynamicBayesNet(plates={"cell": 3, "beam": 3})
    dbn.add(
        "kind",
        lambda kind_prev: bmc.Categorical(0.9 * np.eye(3)[kind_prev] + 0.1 / 3),
        initial=bmc.Categorical([0.5, 0.3, 0.2]),
        plates="cell",
        states=["wall", "door", "hall"],
    )
    dbn.table("place", ["place_prev"], walk(3, 0.4), initial=[0.4, 0.3, 0.3])
    dbn.add(
        "depth",
        lambda kind, place: bmc.Normal(
            np.where(kind[(place + np.arange(3)) % 3] == "door", 1.0, 0.0), 0.6
        ),
        plates="beam",
    )
    dbn.add("here", lambda kind, place: np.where(kind[place] == "hall", 0.9, 0.2))
    dbn.add("open", lambda here: bmc.Bernoulli(here))
    depth = np.array([[0.9, np.nan, 0.1], [0.4, 0.2, 1.1], [np.nan] * 3, [0.0, 0.3, 0.8]])
    return dbn, {"depth": depth, "open": [1, 0, 1, np.nan]}


def two_maps() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """Two things on each cell of a grid, of which one reading tells, and one that shifts the other."""
    dbn = bmc.DynamicBayesNet(plates={"row": 2, "col": 2})
    grid = ("row", "col")
    dbn.add(
        "paint",
        lambda paint_prev: bmc.Bernoulli(np.where(paint_prev == 1, 0.9, 0.2)),
        initial=bmc.Bernoulli(0.4),
        plates=grid,
    )
    dbn.add(
        "light",
        lambda light_prev, paint: bmc.Bernoulli(0.2 + 0.4 * light_prev + 0.3 * paint),
        initial=lambda paint: bmc.Bernoulli(0.3 + 0.3 * paint),
        plates=grid,
    )
    dbn.table("i", ["i_prev"], [[0.3, 0.7], [0.6, 0.4]], initial=[0.5, 0.5])
    dbn.table("j", ["j_prev", "i"], np.full((2, 2, 2), 0.5), initial=lambda i: bmc.Bernoulli(0.3 + 0.4 * i))
    dbn.add("y", lambda paint, light, i, j: bmc.Normal(paint[i, j] + 2.0 * light[i, j], 0.8))
    return dbn, {"y": [0.3, 2.2, 1.0]}


def mine_and_yours() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """Robots with maps of their own, which are filtered separately."""
    dbn = bmc.DynamicBayesNet(plates={"robot": 2, "cell": 3})
    dbn.add(
        "color",
        lambda color_prev: bmc.Bernoulli(np.where(color_prev == 1, 0.9, 0.1)),
        initial=bmc.Bernoulli(0.5),
        plates=("cell", "robot"),
    )
    dbn.add(
        "place",
        lambda place_prev: bmc.Categorical(walk(3)[place_prev]),
        initial=bmc.Categorical([0.6, 0.2, 0.2]),
        plates="robot",
    )
    dbn.add(
        "y", lambda color, place: bmc.Normal(color[place], 0.5), plates="robot"
    )
    return dbn, {"y": [[0.9, 0.1], [0.2, np.nan], [0.4, 1.3]]}


def driven_modes() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """A table whose transitions, and what is seen of it, depend on what is sampled, inputs and time."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.table("z", ["z_prev"], [[0.7, 0.2, 0.1], [0.1, 0.6, 0.3], [0.3, 0.3, 0.4]], initial=[0.5, 0.3, 0.2])
    dbn.add(
        "s",
        lambda s_prev, z, z_prev, u, t: bmc.Bernoulli(
            (0.2 + 0.5 * s_prev + 0.1 * (z == 2) + 0.05 * (z_prev == 1)) / (1 + 0.1 * u + 0.01 * t)
        ),
        initial=lambda z: bmc.Bernoulli(0.3 + 0.2 * (z == 1)),
    )
    dbn.add("change", lambda s, s_prev: s != s_prev, initial=lambda s: s == 2)
    dbn.add("y", lambda s, z, s_prev: bmc.Normal(2.0 * s + z - s_prev, 0.7), initial=lambda s: bmc.Normal(s, 1.0))
    return dbn, {"y": [0.3, 1.7, np.nan, 2.0]}


#: template -> nodes that are named, which leave others to be sampled
PARTS: dict[str, tuple[Maker, list[str]]] = {
    "static ring": (static_ring, ["color"]),
    "flipping ring": (flipping_ring, ["color"]),
    "several sensors": (several_sensors, ["kind"]),
    "two maps": (two_maps, ["paint", "light"]),
    "mine and yours": (mine_and_yours, ["color"]),
    "driven modes": (driven_modes, ["s"]),
}


def asked_of(name: str, observations: Mapping[str, Any]) -> dict[str, Any]:
    """Inputs of a template."""
    if name != "driven modes":
        return {}
    return {"inputs": {"u": np.linspace(0.0, 2.0, len(observations["y"]))}}


# ---- where nothing is sampled -------------------------------------------------------------------


def test_without_sampled_nodes_every_particle_is_the_exact_filter() -> None:
    """Random templates: plates, plates apart, computed nodes handed on, rows partly seen; to rounding."""
    asked = joint = 0
    for seed in range(session.scaled(30, 10)):
        case = random_dbn(seed, nodes=(1, 4), steps=(2, 5))
        given: dict[str, Any] = {"inputs": case.inputs or None}
        try:
            right = bmc.filter(case.dbn, case.observations, engine=bmc.DiscreteFilter(), **given)
        except (UnsupportedError, BudgetError):
            continue
        problem = pose_series(case.dbn, case.observations, case.inputs or None)
        split = split_of_problem(AUTO, problem)
        if split is None or split.tables is None:
            continue
        waits = split.tables.below | split.tables.names
        if any(n not in waits and n not in problem.seen for n in problem.slices.stochastic):
            continue
        found = bmc.filter(
            case.dbn, case.observations, engine=AUTO, keep="particles", rng=seed, **given
        )
        assert off(found.log_marginal_increments, right.log_marginal_increments) < 1e-10, seed
        names = [n for n in found.names if n in split.tables.names]
        numeric = [n for n in names if found.model[n].domain.labels is None]
        for name in names:
            assert off(found.probabilities(name), right.probabilities(name)) < 1e-10, (seed, name)
            assert (found.mcse(name) < 1e-8).all(), (seed, name)
        for name in numeric:
            assert off(found.mean(name), right.mean(name)) < 1e-10, (seed, name)
            assert off(found.var(name), right.var(name)) < 1e-10, (seed, name)
        if len(numeric) > 1:
            try:
                cov = right.cov(*numeric[:2]), found.cov(*numeric[:2])
            except (QueryError, UnsupportedError):
                pass
            else:
                assert off(*cov) < 1e-10, seed
                joint += 1
        asked += 1
    assert asked > 15 and joint > 3


def test_rows_one_by_one_are_those_of_the_exact_filter_through_a_pickle_too() -> None:
    dbn, observations = driven_modes()
    inputs = asked_of("driven modes", observations)["inputs"]
    right = bmc.filter(dbn, observations, inputs=inputs, engine=bmc.DiscreteFilter())
    belief = AUTO.start(dbn, rng=0)
    for t in range(right.steps):
        belief = AUTO.step(belief, {"y": observations["y"][t]}, inputs={"u": inputs["u"][t]})
        if t == 1:
            belief = AUTO.start(dbn, belief=pickle.loads(pickle.dumps(belief)))
        for name in ("s", "z"):
            assert off(belief.probabilities(name), right.probabilities(name)[t]) < 1e-10, t
            assert off(belief.mean(name), right.mean(name)[t]) < 1e-10, t
            assert belief.quantile(name, 0.5) == right.quantile(name, 0.5)[t]
    assert off(belief.log_marginal_likelihood, right.log_marginal_likelihood) < 1e-10


# ---- against exact filters ----------------------------------------------------------------------


@pytest.mark.parametrize("proposal", [None, "optimal"])
@pytest.mark.parametrize("name", PARTS)
def test_filtered_figures_are_exact_ones_under_holm(name: str, proposal: str | None) -> None:
    """Of all slices, times estimated over exact evidence: they have no bias. Nodes computed from tables too."""
    make, named = PARTS[name]
    dbn, observations = make()
    given = asked_of(name, observations)
    right = bmc.filter(dbn, observations, engine=bmc.DiscreteFilter(), **given)
    engine = bmc.ParticleFilter(60, marginalize=named, proposal=proposal)
    assert "integrated out, a table" in bmc.explain(dbn, observations, engine=engine, **given).nodes[named[0]]
    hidden = [n for n in right.names if n not in ("y", "reading", "depth") and n != "here"]

    def figures(found: Any) -> dict[str, Any]:
        return {n: np.asarray(found.probabilities(n)) for n in hidden}

    total = np.cumsum(right.log_marginal_increments, axis=0)

    def estimate(rng: np.random.Generator) -> dict[str, Any]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            found = bmc.filter(dbn, observations, engine=engine, rng=rng, **given)
        ratio = np.exp(np.cumsum(found.log_marginal_increments, axis=0) - total)
        made = {"evidence": ratio}
        for n, own in figures(found).items():
            plates = found.model[n].plates
            wide = ratio
            if ratio.ndim > 1:  # of plates apart, whose axes stand where the node has them
                at = 1 + plates.index("robot")
                wide = np.expand_dims(ratio, [k for k in range(1, own.ndim) if k != at])
            else:
                wide = ratio.reshape(-1, *(1,) * (own.ndim - 1))
            made[n] = own * wide
        return made

    truth = {"evidence": np.ones_like(total), **figures(right)}
    runs = session.scaled(40, 8)
    verdict = repeated_test(estimate, truth, replications=runs, alpha=1e-3, rng=[7, 1])
    assert verdict, verdict
