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
from bayesmc.errors import BudgetError, LowEssWarning, UnsupportedError
from bayesmc.testing import exact, random_dbn, repeated_test, session

AUTO = bmc.ParticleFilter(50, marginalize="auto")
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
    dbn.table(
        "j",
        ["j_prev", "i"],
        np.full((2, 2, 2), 0.5),
        initial=lambda i: bmc.Bernoulli(0.3 + 0.4 * i),
    )
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
    dbn.add("y", lambda color, place: bmc.Normal(color[place], 0.5), plates="robot")
    return dbn, {"y": [[0.9, 0.1], [0.2, np.nan], [0.4, 1.3]]}


def driven_modes() -> tuple[bmc.DynamicBayesNet, dict[str, Any]]:
    """A table whose transitions, and what is seen of it, depend on what is sampled, inputs and time."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.table(
        "z",
        ["z_prev"],
        [[0.7, 0.2, 0.1], [0.1, 0.6, 0.3], [0.3, 0.3, 0.4]],
        initial=[0.5, 0.3, 0.2],
    )
    dbn.add(
        "s",
        lambda s_prev, z, z_prev, u, t: bmc.Bernoulli(
            (0.2 + 0.5 * s_prev + 0.1 * (z == 2) + 0.05 * (z_prev == 1)) / (1 + 0.1 * u + 0.01 * t)
        ),
        initial=lambda z: bmc.Bernoulli(0.3 + 0.2 * (z == 1)),
    )
    dbn.add("change", lambda s, s_prev: s != s_prev, initial=lambda s: s == 2)
    dbn.add(
        "y",
        lambda s, z, s_prev: bmc.Normal(2.0 * s + z - s_prev, 0.7),
        initial=lambda s: bmc.Normal(s, 1.0),
    )
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
    asked = 0
    for seed in range(session.scaled(16, 15)):
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
        for name in (n for n in names if found.model[n].domain.labels is None):
            assert off(found.mean(name), right.mean(name)) < 1e-10, (seed, name)
            assert off(found.var(name), right.var(name)) < 1e-10, (seed, name)
        asked += 1
    assert asked > 8


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


@pytest.mark.parametrize(
    ("name", "proposal"),
    [(name, None) for name in PARTS]
    + [(n, "optimal") for n in (PARTS if session.is_thorough() else list(PARTS)[1::2])],
)
def test_filtered_figures_are_exact_ones_under_holm(name: str, proposal: str | None) -> None:
    """Of all slices, times estimated over exact evidence: they have no bias. Computed nodes too."""
    make, named = PARTS[name]
    dbn, observations = make()
    given = asked_of(name, observations)
    right = bmc.filter(dbn, observations, engine=bmc.DiscreteFilter(), **given)
    engine = bmc.ParticleFilter(60, marginalize=named, proposal=proposal)
    assert (
        "integrated out, a table"
        in bmc.explain(dbn, observations, engine=engine, **given).nodes[named[0]]
    )
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
    runs = session.scaled(25, 10)
    verdict = repeated_test(estimate, truth, replications=runs, alpha=1e-3, rng=[7, 1])
    assert verdict, verdict


def test_errors_are_as_large_as_they_say() -> None:
    """Stated errors of the evidence and of a map, beside the spread of 14 runs: 2 times, or 1.6 less."""
    dbn, rows = ring(8, 0.05), {"reading": [1, 0, 0, 1, 1, 0, 1, 1, 0, 0, 1, 1, 0, 1, 0]}
    right = bmc.filter(dbn, rows, engine=bmc.DiscreteFilter())
    engine = bmc.ParticleFilter(200, marginalize=["color"])
    logs, stated, maps, errors = [], [], [], []
    for seed in range(session.scaled(14, 6)):
        found = bmc.filter(dbn, rows, engine=engine, rng=seed)
        logs.append(found.log_marginal_likelihood - right.log_marginal_likelihood)
        stated.append(found.log_marginal_likelihood_mcse)
        maps.append(found.mean("color")[-1] - right.mean("color")[-1])
        errors.append(found.mcse("color")[-1])
    assert 0.5 < np.sqrt(np.mean(np.square(logs)) / np.mean(np.square(stated))) < 1.6
    assert 0.5 < np.sqrt(np.mean(np.square(maps)) / np.mean(np.square(errors))) < 1.6


def corridor(cells: int, slip: float) -> bmc.DynamicBayesNet:
    """Murphy's robot: it is told to go to and fro, and stays where it is now and then."""
    dbn = ring(cells)
    dbn.input("move")

    def place(place_prev: Any, move: Any) -> bmc.Categorical:
        to = np.clip(place_prev + move, 0, cells - 1)
        return bmc.Categorical((1 - slip) * np.eye(cells)[to] + slip * np.eye(cells)[place_prev])

    start = bmc.Categorical(np.eye(cells)[0])
    dbn.add("place", place, initial=start, replace=True)
    return dbn


def sweeps(rng: np.random.Generator, steps: int, slip: float) -> tuple[np.ndarray, ...]:
    """Places, readings and commands of a walk in eight cells."""
    color, at, places, readings = rng.integers(0, 2, 8), 0, [], []
    move = np.where((np.arange(-1, steps - 1) // 7) % 2 == 0, 1, -1)
    for t in range(steps):
        if t and rng.random() > slip:
            at = int(np.clip(at + move[t], 0, 7))
        places.append(at)
        readings.append(int(rng.random() < (0.9 if color[at] else 0.1)))
    return np.array(places), np.array(readings), move


def located(readings: np.ndarray, move: np.ndarray, slip: float) -> np.ndarray:
    """Exact probabilities of places, (steps, 8): 2,048 joint states, by hand."""
    maps = (np.arange(256)[:, None] >> np.arange(8)) & 1
    dark = np.where(maps.T == 1, 0.9, 0.1)
    belief, found = np.zeros((8, 256)), []
    belief[0] = 1 / 256
    for t, seen in enumerate(readings):
        if t:
            moved = slip * belief
            np.add.at(moved, np.clip(np.arange(8) + move[t], 0, 7), (1 - slip) * belief)
            belief = moved
        belief = belief * (dark if seen else 1 - dark)
        belief = belief / belief.sum()
        found.append(belief.sum(axis=1))
    return np.array(found)


def test_a_map_of_eight_cells_is_located_in_as_by_the_exact_filter() -> None:
    """Murphy (2000): 50 particles, the probability of where one was, over the rows of several walks.

    The gap to the exact filter has the error of its mean over walks, and is no larger than the filter says.
    """
    rng, slip, steps = np.random.default_rng(5), 0.1, 40
    dbn = corridor(8, slip)
    _, readings, move = sweeps(rng, 3, slip)
    few = bmc.filter(dbn, {"reading": readings}, inputs={"move": move}, engine=bmc.DiscreteFilter())
    assert off(few.probabilities("place"), located(readings, move, slip)) < 1e-10
    engines = {"tables": {"marginalize": "auto", "proposal": "optimal"}, "plain": {}}
    shares: dict[str, list[float]] = {name: [] for name in ("exact", *engines)}
    gaps, errors = [], []
    for seed in range(session.scaled(6, 10)):
        places, readings, move = sweeps(rng, steps, slip)
        right = located(readings, move, slip)
        shares["exact"].append(right[np.arange(steps), places].mean())
        for name, options in engines.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LowEssWarning)
                engine = bmc.ParticleFilter(50, **options)
                given: dict[str, Any] = {"inputs": {"move": move}, "engine": engine, "rng": seed}
                found = bmc.filter(dbn, {"reading": readings}, **given)
            shares[name].append(found.probabilities("place")[np.arange(steps), places].mean())
            error = found.mcse("place")
            if name == "tables":
                told = np.isfinite(error)
                gaps.append((found.mean("place") - right @ np.arange(8))[told])
                errors.append(error[told])
    less = {n: np.array(shares[n]) - np.array(shares["exact"]) for n in engines}
    error = less["tables"].std(ddof=1) / np.sqrt(len(less["tables"]))
    assert abs(less["tables"].mean()) < 4 * error and error < 0.03
    assert less["plain"].mean() < -0.05 < less["tables"].mean()
    gap, stated = np.concatenate(gaps), np.concatenate(errors)
    assert len(gap) > 0.4 * steps * len(shares["exact"])
    assert np.sqrt(np.mean(gap**2)) < 1.5 * np.sqrt(np.mean(stated**2))


def test_of_place_and_map_the_place_is_sampled() -> None:
    """What leaves the smaller tables; few enough joint states have one table, and nothing is sampled."""
    rows = {"reading": [1, 0, 1]}
    engine = bmc.ParticleFilter(50, marginalize="auto")
    nodes = bmc.explain(ring(64), rows, engine=engine).nodes
    assert nodes["color"] == (
        "integrated out, a table of 2 states for each particle and element of 'cell'"
    )
    assert "sampled" in nodes["place"] and "joint states of 'color', 'place'" in nodes["place"]
    assert "of the element of 'color' that it reads" in nodes["reading"]
    nodes = bmc.explain(ring(3), rows, engine=engine).nodes
    assert "a table of 24 joint states with 'color'" in nodes["place"]


def test_what_reads_more_than_one_element_shares_a_table_or_is_refused() -> None:
    def read(function: Any, cells: int) -> tuple[str | None, str]:
        dbn = ring(cells)
        dbn.add("reading", function, replace=True)
        engine = bmc.ParticleFilter(50, marginalize=["color"])
        rows = {"reading": [0.5, 0.2]}
        reason = engine.unsupported(dbn, rows)
        return reason, "" if reason else bmc.explain(dbn, rows, engine=engine).nodes["color"]

    def opaque(color: Any, place: Any) -> Any:
        at = np.asarray(place).reshape(-1)[0]  # what cannot be followed proves nothing
        return bmc.Normal(0.0 * place + 0.0 * color[0] + 0.0 * int(at), 1.0)

    for function in (
        lambda color, place: bmc.Normal(color[place] + color[0], 1.0),
        lambda color, place: bmc.Normal(color.sum("cell") + 0.0 * place, 1.0),
        lambda color, place: bmc.Normal(color[place] * (color[(place + 1) % 4] == 1), 1.0),
    ):
        reason, told = read(function, 4)
        assert reason is None and "a table of 16 joint states" in told
        reason, _ = read(function, 64)
        assert reason is not None and "more than 1024" in reason and "name fewer" in reason
    reason, told = read(lambda color, place: bmc.Normal(color[(place + 3) % 4], 1.0), 64)
    assert reason is None and "element of 'cell'" in told
    reason, told = read(opaque, 4)
    assert reason is None and "16 joint states" in told


def test_tables_and_kalman_filters_stand_side_by_side() -> None:
    """A map, and a level with regimes that has nothing to do with it: evidence and answers of both."""
    dbn = ring(4, 0.1)
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    alone = bmc.DynamicBayesNet()
    alone.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    for one in (dbn, alone):
        one.add(
            "x", lambda x_prev, s: bmc.Normal(0.9 * x_prev + s, 0.5), initial=bmc.Normal(0.0, 1.0)
        )
        one.add("y", lambda x: bmc.Normal(x, 0.5))
    y, reading = {"y": [0.3, 1.2, 2.0]}, {"reading": [1, 0, 1]}
    right, level = bmc.filter(ring(4, 0.1), reading, engine=bmc.DiscreteFilter()), exact(alone, y)
    total = right.log_marginal_likelihood + level.log_marginal_likelihood
    for proposal in (None, "optimal"):
        engine = bmc.ParticleFilter(4000, marginalize=["color", "x"], proposal=proposal)
        nodes = bmc.explain(dbn, {**y, **reading}, engine=engine).nodes
        assert "a Kalman filter" in nodes["x"] and "a table" in nodes["color"]
        found = bmc.filter(dbn, {**y, **reading}, engine=engine, rng=3)
        assert abs(found.log_marginal_likelihood - total) < 4 * found.log_marginal_likelihood_mcse
        assert (np.abs(found.mean("x")[-1] - level.mean("x")[-1]) < 4 * found.mcse("x")[-1]).all()
        gap = np.abs(found.mean("color")[-1] - right.mean("color")[-1])
        assert (gap < 4 * found.mcse("color")[-1] + 1e-9).all()


def test_covariances_are_within_tables_and_between_particles() -> None:
    """Of nodes that share a table, and of elements of which each has its own, all of it in one table too."""
    dbn, rows = ring(3, 0.1), {"reading": [1, 0, 1, 1]}

    def pair(a: int, b: int) -> Any:
        return lambda color: 1.0 * color[..., a] * color[..., b]

    queries = {f"{a}{b}": pair(a, b) for a in range(3) for b in range(3)}
    queries["where"] = lambda color, place: place * (color[..., 1] == 1)
    right = bmc.filter(dbn, rows, engine=bmc.DiscreteFilter(), queries=queries)
    both = np.array([[right.queries[f"{a}{b}"][-1] for b in range(3)] for a in range(3)])
    mean = right.mean("color")[-1]
    wanted = both - np.outer(mean, mean)
    where = right.queries["where"][-1] - right.mean("place")[-1] * mean[1]
    engine = bmc.ParticleFilter(50, marginalize="auto")
    found = bmc.filter(dbn, rows, engine=engine, rng=0, keep="particles")
    assert off(found.cov("color")[-1], wanted) < 1e-10
    assert off(found.cov("place", "color")[-1][0, 2], where) < 1e-10
    engine = bmc.ParticleFilter(20_000, marginalize=["color"])
    found = bmc.filter(dbn, rows, engine=engine, rng=0, keep="particles")
    assert off(found.cov("color")[-1], wanted) < 0.01
    assert off(found.cov("place", "color")[-1][0, 2], where) < 0.01


def test_forecasts_and_missing_rows_leave_tables_to_their_transition() -> None:
    dbn, rows = ring(3, 0.1), {"reading": [1, 0, 1]}
    engine = bmc.ParticleFilter(60, marginalize="auto")
    found = bmc.forecast(dbn, rows, steps=2, engine=engine, rng=0)
    right = bmc.forecast(dbn, rows, steps=2, engine=bmc.DiscreteFilter())
    assert off(found.probabilities("color"), right.probabilities("color")) < 1e-10
    assert off(found.probabilities("place"), right.probabilities("place")) < 1e-10
    gap = np.abs(found.probabilities("reading") - right.probabilities("reading"))
    assert (gap < 4.5 * np.sqrt(0.25 / 60)).all()  # one draw from each particle's table


def test_a_map_of_64_cells_runs_in_real_time() -> None:
    """At least 50 slices a second with 50 particles, by several times."""
    import time

    rows = {"reading": np.random.default_rng(0).integers(0, 2, 60)}
    for proposal in (None, "optimal"):
        engine = bmc.ParticleFilter(50, marginalize=["color"], proposal=proposal)
        bmc.filter(ring(64), {"reading": rows["reading"][:3]}, engine=engine, rng=0)
        start = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            bmc.filter(ring(64), rows, engine=engine, rng=0)
        assert 60 / (time.process_time() - start) > 50


# ---- refusals -----------------------------------------------------------------------------------


def test_what_cannot_have_a_table_is_refused_by_name() -> None:
    dbn = ring(4)
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("h", lambda h_prev, s: bmc.Normal(h_prev + s, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, h: bmc.Normal(x, np.exp(h)))
    rows = {"reading": [1, 0], "y": [0.1, 0.2]}
    for names, what in (
        (["s"], "'h', which is sampled, depends on it; leave 's' out"),
        (["colour"], "did you mean 'color'?"),
    ):
        reason = bmc.ParticleFilter(5, marginalize=names).unsupported(dbn, rows)
        assert reason is not None and what in reason, reason
    engine = bmc.ParticleFilter(
        5,
        marginalize=["color"],
        proposal={"place": lambda color_prev: bmc.Categorical(np.ones(4) / 4)},
    )
    reason = engine.unsupported(dbn, rows)
    assert reason is not None and "names 'color_prev', which marginalize= integrates out" in reason


def test_bad_parameters_at_a_possible_state_are_told() -> None:
    dbn = ring(4)
    dbn.add("reading", lambda color, place: bmc.Normal(0.0, 1.0 - 2.0 * color[place]), replace=True)
    with pytest.raises(bmc.errors.ParameterError, match="'reading'"):
        bmc.filter(
            dbn, {"reading": [0.1]}, engine=bmc.ParticleFilter(5, marginalize=["color"]), rng=0
        )


def test_places_where_no_particle_is_are_looked_after_by_scouts() -> None:
    """A jump of one in a thousand, which readings show: who missed it says that nothing is known."""
    dbn = ring(8)
    dbn.add(
        "color",
        lambda color_prev: bmc.Bernoulli(color_prev),
        initial=bmc.Bernoulli(np.where(np.arange(8) < 4, 0.9, 0.1)),
        plates="cell",
        replace=True,
    )
    step = 0.999 * np.eye(8) + 0.001 * np.roll(np.eye(8), 4, axis=1)
    dbn.table("place", ["place_prev"], step, initial=np.eye(8)[0], replace=True)
    rows = {"reading": [1] * 3 + [0] * 6}
    right = bmc.filter(dbn, rows, engine=bmc.DiscreteFilter()).log_marginal_likelihood
    missed = []
    for seed in range(12):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)
            engine = bmc.ParticleFilter(60, marginalize=["color"])
            found = bmc.filter(dbn, rows, engine=engine, rng=seed)
        if abs(found.log_marginal_likelihood - right) > 2.0:
            missed.append(np.isinf(found.log_marginal_likelihood_mcse))
    assert len(missed) > 5 and np.mean(missed) > 0.8, missed


def test_what_tables_cannot_take_in_is_refused_by_name() -> None:
    """Vectors seen in part; a sensor that is missing, and that a sampled node reads."""
    dbn = ring(3)
    dbn.add(
        "pair",
        lambda color, place: bmc.MvNormal(bmc.stack([color[place], 0.0 * place], -1), np.eye(2)),
    )
    engine = bmc.ParticleFilter(20, marginalize=["color"])
    rows = {"reading": [1, 0], "pair": np.array([[0.1, np.nan], [0.2, 0.3]])}
    reason = engine.unsupported(dbn, rows)
    assert reason is not None and "of 'pair' some components are missing" in reason
    dbn = ring(3)
    dbn.add(
        "place",
        lambda place_prev, reading_prev: bmc.Categorical(walk(3)[(place_prev + reading_prev) % 3]),
        initial=bmc.Categorical([1.0, 0.0, 0.0]),
        replace=True,
    )
    belief = engine.step(engine.start(dbn, rng=0), {"reading": 1})
    with pytest.raises(UnsupportedError, match="'reading' is missing in slice 1, and 'place'"):
        engine.step(belief, {})
    reason = engine.unsupported(dbn, {"reading": [1, np.nan]})
    assert reason is not None and "'reading', which is sampled, depends on it" in reason
    assert engine.unsupported(dbn, {"reading": [1, 0]}) is None


def test_maps_are_integrated_out_where_no_engine_is_named_and_few_states_are_not() -> None:
    chosen = bmc.explain(ring(64), {"reading": [1, 0, 1]})
    assert isinstance(chosen.engine, bmc.ParticleFilter) and chosen.engine.marginalize == "auto"
    assert "'color' integrated out" in chosen.reasons[0]
    dbn, start = bmc.DynamicBayesNet(), bmc.Normal(0.0, 1.0)
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 1.0), initial=start)
    dbn.add("z", lambda z_prev, x: bmc.Normal(np.cos(x) + z_prev, 0.3), initial=start)
    dbn.add("y", lambda z, x, s: bmc.Normal(z**2 + s, np.exp(x)))
    chosen = bmc.explain(dbn, {"y": [0.1, 0.2]})
    assert isinstance(chosen.engine, bmc.ParticleFilter) and chosen.engine.marginalize is None


def test_proposals_of_sampled_nodes_are_weighed() -> None:
    dbn, rows = ring(4, 0.1), {"reading": [1, 0, 1, 1]}
    right = bmc.filter(dbn, rows, engine=bmc.DiscreteFilter())
    engine = bmc.ParticleFilter(
        4000,
        marginalize=["color"],
        proposal={"place": lambda place_prev: bmc.Categorical(0.5 * np.eye(4)[place_prev] + 0.125)},
    )
    found = bmc.filter(dbn, rows, engine=engine, rng=4)
    gap = abs(found.log_marginal_likelihood - right.log_marginal_likelihood)
    assert gap < 4 * found.log_marginal_likelihood_mcse < 0.4
    gaps = np.abs(found.mean("color") - right.mean("color"))
    assert (gaps < 4 * found.mcse("color") + 1e-9).all()
