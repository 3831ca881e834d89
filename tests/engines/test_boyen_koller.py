"""``BoyenKoller`` against dense arrays by definition, the exact filter, and the stored runs of two plants."""

from __future__ import annotations

import gzip
import json
import pickle
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.engines.factored import coupling
from bayesmc.engines.factored.slices import FactoredSlices
from bayesmc.errors import (
    ModelMisfitWarning,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from tests.engines.factored_references import boyen_koller, coupled, factored_frontier, margin
from tests.matrix_time import MANY, Whole, cases

#: clusters of four nodes in a row
CLUSTERINGS = {
    "single": [[0], [1], [2], [3]],
    "pairs": [[0, 2], [1, 3]],
    "uneven": [[0, 1, 2], [3]],
    "chain": [[0, 1], [1, 2], [2, 3]],
    "star": [[0, 1], [1, 2], [1, 3]],
    "wide": [[0, 1, 2], [1, 2, 3]],
}


def named(clusters: list[list[int]]) -> list[list[str]]:
    return [[f"x{k}" for k in cluster] for cluster in clusters]


def tables(answer: Any, nodes: int) -> np.ndarray:
    """Probabilities of all nodes side by side, (time, states of all)."""
    return np.concatenate([answer.probabilities(f"x{k}") for k in range(nodes)], axis=-1)


def margins(joints: list[np.ndarray]) -> np.ndarray:
    return np.array([
        np.concatenate([margin(j, [k]).reshape(-1) for k in range(j.ndim)]) for j in joints
    ])  # fmt: skip


# ---- by definition ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CLUSTERINGS)
@pytest.mark.parametrize("sparse", [1.0, 0.15])
def test_filters_and_smooths_as_dense_arrays_do(name: str, sparse: float) -> None:
    for seed in range(3):
        rng = np.random.default_rng([seed, 1])
        model = coupled(rng, sparse=sparse)
        rows = model.rows(6, rng)
        increments, filtered, smoothed = boyen_koller(model, rows, CLUSTERINGS[name])
        engine = bmc.BoyenKoller(named(CLUSTERINGS[name]))
        found = bmc.filter(model.dbn, rows, engine=engine)
        np.testing.assert_allclose(found.log_marginal_increments, increments, atol=1e-10)
        np.testing.assert_allclose(tables(found, 4), margins(filtered), atol=1e-10)
        found = bmc.smooth(model.dbn, rows, engine=engine)
        np.testing.assert_allclose(tables(found, 4), margins(smoothed), atol=1e-10)


def test_what_is_asked_of_several_clusters_is_answered_before_the_projection() -> None:
    rng = np.random.default_rng(3)
    model = coupled(rng)
    rows = model.rows(5, rng)
    engine = bmc.BoyenKoller(named(CLUSTERINGS["single"]))
    same = {"same": lambda x0, x3: (x0 == x3) * 1.0}
    _, filtered, smoothed = boyen_koller(model, rows, CLUSTERINGS["single"])
    for call, joints in ((bmc.filter, filtered), (bmc.smooth, smoothed)):
        found = call(model.dbn, rows, engine=engine, queries=same)
        right = [np.trace(margin(j, [0, 3]).reshape(model.cards[0], -1)) for j in joints]
        np.testing.assert_allclose(found.queries["same"], right, atol=1e-10)
        np.testing.assert_allclose(
            found.expectation(lambda x0, x3: (x0 == x3) * 1.0), right, atol=1e-10
        )


@pytest.mark.parametrize(
    "engine", [bmc.BoyenKoller(named(CLUSTERINGS["chain"])), bmc.FactoredFrontier()]
)
def test_fixed_lags_grow_from_the_filter_to_the_smoother(engine: Any) -> None:
    rng = np.random.default_rng(4)
    model = coupled(rng)
    rows = model.rows(6, rng)
    whole = bmc.smooth(model.dbn, rows, engine=engine)
    filtered = bmc.filter(model.dbn, rows, engine=engine)
    last = bmc.smooth(model.dbn, rows, engine=engine, lag=20)
    none = bmc.smooth(model.dbn, rows, engine=engine, lag=0)
    two = bmc.smooth(model.dbn, rows, engine=engine, lag=2)
    np.testing.assert_allclose(tables(last, 4), tables(whole, 4), atol=1e-12)
    np.testing.assert_allclose(tables(none, 4), tables(filtered, 4), atol=1e-12)
    cut = {
        n: v[:4] for n, v in rows.items()
    }  # slice 1 with two rows after it is all of a short series
    short = bmc.smooth(model.dbn, cut, engine=engine)
    np.testing.assert_allclose(tables(two, 4)[1], tables(short, 4)[1], atol=1e-12)


# ---- exact where it must be ---------------------------------------------------------------------


@pytest.mark.parametrize("question", ["filter", "smooth", "lag", "forecast"])
def test_one_cluster_is_the_exact_filter(question: str) -> None:
    exact, whole, asked = bmc.DiscreteFilter(), Whole(), 0
    for _, case in cases("finite", 4 * MANY):
        options: dict[str, Any] = {"inputs": case.inputs}
        call = bmc.filter if question == "filter" else bmc.smooth
        if question == "lag":
            options["lag"] = 1
        if question == "forecast":
            if case.inputs:
                continue
            call, options = bmc.forecast, {"steps": 2}
        right = call(case.dbn, case.observations, engine=exact, **options)
        found = call(case.dbn, case.observations, engine=whole, **options)
        assert right.names == found.names
        for name in right.names:
            if right.model[name].domain is not None:
                pair = found.probabilities(name), right.probabilities(name)
            else:
                pair = found.mean(name), right.mean(name)
            np.testing.assert_allclose(*pair, rtol=1e-9, atol=1e-10)
        if question != "forecast":
            np.testing.assert_allclose(
                found.log_marginal_increments, right.log_marginal_increments, atol=1e-10
            )
        asked += 1
    assert asked >= MANY


def test_independent_chains_are_exact_one_by_one() -> None:
    rng = np.random.default_rng(5)
    dbn, rows = bmc.DynamicBayesNet(), {}
    for k in range(3):
        dbn.table(
            f"x{k}", [f"x{k}_prev"], rng.dirichlet(np.ones(3), size=3), initial=np.ones(3) / 3
        )
        dbn.table(f"y{k}", [f"x{k}"], rng.dirichlet(np.ones(2), size=3))
        rows[f"y{k}"] = rng.integers(2, size=12)
    for call in (bmc.filter, bmc.smooth):
        right = call(dbn, rows, engine=bmc.DiscreteFilter())
        for engine in (bmc.BoyenKoller([["x0"], ["x1"], ["x2"]]), bmc.FactoredFrontier()):
            found = call(dbn, rows, engine=engine)
            np.testing.assert_allclose(tables(found, 3), tables(right, 3), atol=1e-12)
            assert found.log_marginal_likelihood == pytest.approx(right.log_marginal_likelihood)
        across = call(dbn, rows, engine=bmc.BoyenKoller([["x0", "x1"], ["x1", "x2"], ["x2", "x0"]]))
        np.testing.assert_allclose(tables(across, 3), tables(right, 3), atol=1e-12)


# ---- the stored runs ----------------------------------------------------------------------------


def plant(root: Path, name: str) -> tuple[bmc.DynamicBayesNet, list[str], list[dict[str, Any]]]:
    """A template, its persistent nodes and runs; row 0, before the first transition, is missing."""
    folder = root / "dbn_factored"
    net, runs = (
        json.loads(gzip.open(folder / f"{name}_{what}.json.gz").read())
        for what in ("dbn", "filter")
    )
    kept = [n for n in net if any(n in other["prev"] for other in net.values())]
    dbn = bmc.DynamicBayesNet(name)
    for n, node in net.items():
        above = [f"{p}_prev" for p in node["prev"]] + node["now"]
        table = np.array(node["table"])
        uniform = {"initial": np.full(table.shape[-1], 1 / table.shape[-1])} if n in kept else {}
        dbn.table(n, above, table, **uniform)
    for run in runs:
        run["rows"] = {n: [None, *(row[n] for row in run["obs"])] for n in run["obs"][0]}
    return dbn, kept, runs


def parts(kept: list[str], sizes: list[int]) -> list[list[str]]:
    ends = np.cumsum(sizes)
    return [kept[e - n : e] for e, n in zip(ends, sizes, strict=True)]


PLANTS = {
    ("water", "BK 1^8"): ([1] * 8, 0.018),
    ("water", "BK 2+4+2 {12}{3456}{78}"): ([2, 4, 2], 0.0054304),
    ("water", "FF"): (None, 0.0438),
    ("bat", "BK 1^10"): ([1] * 10, 0.14),
    ("bat", "BK 5+5"): ([5, 5], 0.00192),
    ("bat", "BK 3+2+4+1"): ([3, 2, 4, 1], 0.0215),
}


@pytest.mark.parametrize(("name", "clustering"), PLANTS)
def test_stored_runs(reference_data: Path, name: str, clustering: str) -> None:
    dbn, kept, runs = plant(reference_data, name)
    sizes, _ = PLANTS[name, clustering]
    engine: Any = bmc.FactoredFrontier() if sizes is None else bmc.BoyenKoller(parts(kept, sizes))
    for run in runs:
        found = bmc.filter(dbn, run["rows"], engine=engine)
        stored = run["approx"][clustering]
        off = np.array([
            np.abs(found.probabilities(n)[1:] - np.array(run["marginals"][n])).sum(axis=-1)
            for n in kept
        ])  # fmt: skip
        assert off.mean() == pytest.approx(stored["l1_mean"], abs=1e-8)
        assert off.max() == pytest.approx(stored["l1_max"], abs=1e-8)
        assert abs(found.log_marginal_increments[0]) < 1e-12
        if "loglik" in stored:
            assert found.log_marginal_likelihood == pytest.approx(stored["loglik"], abs=1e-8)


def joint_tables(
    dbn: bmc.DynamicBayesNet, rows: Any, engine: Any, kept: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """The belief that is handed on, over all joint states, (time, *cards), and increments, from slice 1."""
    problem = pose_series(dbn, rows)
    run: Any = engine._run(engine._plan(problem), problem.series)
    increments = run.forward()
    (beliefs,), found = run._forwards, np.ones(())
    for cluster, table in zip(beliefs.clusters, beliefs.tables, strict=True):
        at = [kept.index(v[1]) for v in cluster.scope]
        order = np.argsort(at)
        shape = [1] * len(kept)
        for k, n in zip(sorted(at), np.array(table.shape[2:])[order], strict=True):
            shape[k] = n
        found = found * table[:, 0].transpose(0, *(1 + order)).reshape(-1, *shape)
    return found[1:], increments[1:, 0]


@pytest.mark.parametrize("name", ["water", "bat"])
def test_divergence_from_the_exact_filter(reference_data: Path, name: str) -> None:
    """KL(exact || factored) per slice, on the first run; the exact filter is one cluster of everything."""
    dbn, kept, (run, *_) = plant(reference_data, name)
    exact, increments = joint_tables(dbn, run["rows"], bmc.BoyenKoller([kept]), kept)
    np.testing.assert_allclose(increments, run["increments"], atol=1e-8)
    for k, n in enumerate(kept):
        out = tuple(1 + j for j in range(len(kept)) if j != k)
        np.testing.assert_allclose(exact.sum(axis=out), run["marginals"][n], atol=1e-8)
    for (plant_name, clustering), (sizes, bound) in PLANTS.items():
        if plant_name != name:
            continue
        if sizes is None:
            engine: Any = bmc.FactoredFrontier()
        else:
            engine = bmc.BoyenKoller(parts(kept, sizes))
        near, _ = joint_tables(dbn, run["rows"], engine, kept)
        held = exact > 0
        logs = np.log(np.where(held, exact, 1.0)) - np.log(np.where(held, near, 1.0))
        divergence = (exact * logs).sum(axis=tuple(range(1, exact.ndim)))
        stored = run["approx"][clustering]
        assert divergence.mean() == pytest.approx(stored["kl_mean"], abs=1e-8)
        assert divergence.max() == pytest.approx(stored["kl_max"], abs=1e-8)
        assert divergence.mean() <= bound


def test_clusters_that_are_found_do_no_worse_than_those_of_the_files(reference_data: Path) -> None:
    for name, hand in (("water", "BK 2+4+2 {12}{3456}{78}"), ("bat", "BK 5+5")):
        dbn, kept, runs = plant(reference_data, name)
        off = []
        for run in runs:
            found = bmc.filter(dbn, run["rows"], engine=bmc.BoyenKoller())
            off += [
                np.abs(found.probabilities(n)[1:] - np.array(run["marginals"][n])).sum(axis=-1)
                for n in kept
            ]
        assert np.mean(off) <= 0.8 * np.mean([run["approx"][hand]["l1_mean"] for run in runs])


def test_clusters_that_are_found_are_better_than_drawn_ones() -> None:
    """Three pairs of six nodes at random templates, the limit lowered so that the choice matters."""
    better = []
    for seed in range(6):
        rng = np.random.default_rng([seed, 3])
        model = coupled(rng, nodes=6, sparse=0.5)
        rows = model.rows(25, rng)
        exact = tables(bmc.filter(model.dbn, rows, engine=bmc.DiscreteFilter()), 6)

        def error(engine: Any, dbn: Any = model.dbn, rows: Any = rows, exact: Any = exact) -> float:
            return float(np.abs(tables(bmc.filter(dbn, rows, engine=engine), 6) - exact).mean())

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(coupling, "STATES", 9)
            found = error(bmc.BoyenKoller())
        order = rng.permuted(np.tile(np.arange(6), (5, 1)), axis=1)
        drawn = [error(bmc.BoyenKoller(named(o.reshape(3, 2).tolist()))) for o in order]
        better.append(found - np.mean(drawn))
    assert np.mean(better) < 0 and np.median(better) < 0


# ---- numbers ------------------------------------------------------------------------------------


def rare(tiny: float) -> bmc.DynamicBayesNet:
    """Two states that hardly ever change, with readings that can be far out; a twin that follows."""
    dbn = bmc.DynamicBayesNet()
    stay = [[1 - tiny, tiny], [tiny, 1 - tiny]]
    dbn.table("x0", ["x0_prev"], stay, initial=[0.5, 0.5])
    dbn.table("x1", ["x0_prev", "x1_prev"], [stay, stay[::-1]], initial=[0.5, 0.5])
    dbn.add("y", lambda x0, x1: bmc.Normal(40.0 * x0 + 3.0 * x1, 1.0))
    return dbn


@pytest.mark.parametrize("tiny", [1e-300, 1e-120, 0.0])
def test_what_leaves_the_range_of_numbers_is_not_lost(tiny: float) -> None:
    """States of probability e**-800 and below come back when rows ask for them; none is zero by chance."""
    rows = {"y": [0.0, 0.0, 0.0, 43.0, 40.0, 40.0, np.nan, 3.0]}
    if tiny == 0.0:
        rows = {"y": [0.0, 20.0, 25.0, 43.0, 40.0]}
    for call in (bmc.filter, bmc.smooth):
        right = call(rare(tiny), rows, engine=bmc.DiscreteFilter())
        found = call(rare(tiny), rows, engine=bmc.BoyenKoller([["x0", "x1"]]))
        np.testing.assert_allclose(
            found.log_marginal_increments, right.log_marginal_increments, rtol=1e-9, atol=1e-12
        )
        np.testing.assert_allclose(tables(found, 2), tables(right, 2), rtol=1e-7, atol=1e-300)
        for engine in (bmc.BoyenKoller([["x0"], ["x1"]]), bmc.FactoredFrontier()):
            apart = call(rare(tiny), rows, engine=engine)
            assert np.isfinite(tables(apart, 2)).all()
            assert np.isfinite(apart.log_marginal_likelihood)


def test_sequences_share_the_passes_and_never_meet() -> None:
    rng = np.random.default_rng(6)
    model = coupled(rng)
    dbn = bmc.DynamicBayesNet(plates={"patient": 3})
    for k, (above, table) in enumerate(zip(model.parents, model.tables, strict=True)):
        names = [f"x{j}_prev" for j in above]
        dbn.table(f"x{k}", names, table, initial=model.initial[k], plates="patient")
    for k, (above, table) in enumerate(zip(model.seen, model.readings, strict=True)):
        dbn.table(f"y{k}", [f"x{j}" for j in above], table, plates="patient")
    each = [model.rows(7, rng) for _ in range(3)]
    rows = {n: np.ma.stack([one[n] for one in each], axis=1) for n in each[0]}
    clusterings = [named(CLUSTERINGS[n]) for n in ("chain", "uneven")]
    for engine in (*map(bmc.BoyenKoller, clusterings), bmc.BoyenKoller(), bmc.FactoredFrontier()):
        for call in (bmc.filter, bmc.smooth):
            found = call(dbn, rows, engine=engine)
            assert found.log_marginal_increments.shape == (7, 3)
            for s, one in enumerate(each):
                alone = call(model.dbn, one, engine=engine)
                np.testing.assert_allclose(
                    found.log_marginal_increments[:, s], alone.log_marginal_increments, atol=1e-10
                )
                for k in range(4):
                    np.testing.assert_allclose(
                        found.probabilities(f"x{k}")[:, s], alone.probabilities(f"x{k}"), atol=1e-10
                    )


def test_elements_of_plates_are_clusters_of_their_own() -> None:
    """A common node and the elements of a plate that it drives: a cluster of each element with it."""
    dbn = bmc.DynamicBayesNet(plates={"sensor": 3})
    dbn.table("g", ["g_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    table = [[[0.9, 0.1], [0.4, 0.6]], [[0.5, 0.5], [0.1, 0.9]]]
    dbn.table("x", ["g_prev", "x_prev"], table, initial=[0.5, 0.5], plates="sensor")
    dbn.table("y", ["x"], [[0.8, 0.2], [0.3, 0.7]], plates="sensor")
    rows = {"y": np.random.default_rng(0).integers(2, size=(6, 3))}
    engine = bmc.BoyenKoller([["g", "x"]])
    loop, seen = bmc.DynamicBayesNet(), {}
    loop.table("g", ["g_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    for k in range(3):
        loop.table(f"x{k}", ["g_prev", f"x{k}_prev"], table, initial=[0.5, 0.5])
        loop.table(f"y{k}", [f"x{k}"], [[0.8, 0.2], [0.3, 0.7]])
        seen[f"y{k}"] = rows["y"][:, k]
    spelt = bmc.BoyenKoller([["g", f"x{k}"] for k in range(3)])
    listed = bmc.BoyenKoller([["g", ("x", k)] for k in range(3)])
    for call in (bmc.filter, bmc.smooth):
        found, right = call(dbn, rows, engine=engine), call(loop, seen, engine=spelt)
        np.testing.assert_allclose(found.probabilities("g"), right.probabilities("g"), atol=1e-12)
        for k in range(3):
            np.testing.assert_allclose(
                found.probabilities("x")[:, k], right.probabilities(f"x{k}"), atol=1e-12
            )
        also = call(dbn, rows, engine=listed)
        np.testing.assert_allclose(also.probabilities("x"), found.probabilities("x"), atol=1e-12)


def test_forty_coupled_chains_take_less_than_two_seconds() -> None:
    rng, dbn, nodes = np.random.default_rng(1), bmc.DynamicBayesNet(), 40
    for k in range(nodes):
        near = [j for j in (k - 1, k, k + 1) if 0 <= j < nodes]
        table = rng.dirichlet(np.ones(2), size=(2,) * len(near))
        dbn.table(f"x{k}", [f"x{j}_prev" for j in near], table, initial=[0.5, 0.5])
        dbn.table(f"y{k}", [f"x{k}"], rng.dirichlet(np.ones(2), size=2))
    drawn = dbn.sample(200, rng=rng)
    rows = {f"y{k}": drawn[f"y{k}"][0] for k in range(nodes)}
    found = {}
    for engine in (bmc.BoyenKoller(), bmc.BoyenKoller([[f"x{k}"] for k in range(nodes)])):
        start = time.process_time()
        found[engine] = bmc.filter(dbn, rows, engine=engine)
        assert time.process_time() - start < 2.0
    near, single = found.values()
    assert single.log_marginal_likelihood == pytest.approx(near.log_marginal_likelihood, abs=3.0)


# ---- row by row, and refusals -------------------------------------------------------------------


@pytest.mark.parametrize(
    "engine",
    [bmc.BoyenKoller(), bmc.BoyenKoller(named(CLUSTERINGS["chain"])), bmc.FactoredFrontier()],
)
def test_rows_one_by_one_say_what_all_of_them_do(engine: Any) -> None:
    rng = np.random.default_rng(7)
    model = coupled(rng)
    rows = model.rows(6, rng)
    whole = bmc.filter(model.dbn, rows, engine=engine)
    belief = engine.start(model.dbn)
    for t in range(6):
        if t == 3:
            belief = engine.start(model.dbn, belief=pickle.loads(pickle.dumps(belief)))
        row = {n: v[t] for n, v in rows.items() if v[t] is not np.ma.masked}
        belief = engine.step(belief, row)
        for k in range(4):
            np.testing.assert_allclose(
                belief.probabilities(f"x{k}"), whole.probabilities(f"x{k}")[t], atol=1e-10
            )
    assert belief.log_marginal_likelihood == pytest.approx(whole.log_marginal_likelihood)


def test_a_belief_goes_on_with_its_own_kind_of_filter_alone() -> None:
    model = coupled(np.random.default_rng(16))
    engines = [bmc.DiscreteFilter(), bmc.BoyenKoller(), bmc.FactoredFrontier()]
    for one in engines:
        belief = one.step(one.start(model.dbn), {"y0": 0})
        for other in engines:
            if other is not one:
                with pytest.raises(TypeError, match="what start or step of this kind"):
                    other.step(belief, {"y0": 1})
        other = bmc.BoyenKoller(named(CLUSTERINGS["pairs"]))  # the belief keeps its clusters
        if isinstance(one, bmc.BoyenKoller):
            again = other.step(belief, {"y0": 1})
            right = one.step(belief, {"y0": 1})
            assert again.log_marginal_likelihood == right.log_marginal_likelihood


def test_a_belief_goes_on_with_its_own_clusters() -> None:
    """Inputs decide what is coupled, and move on; a pickled belief keeps what it was started with."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    names = [f"x{k}" for k in range(4)]
    tie = np.array([[[0.9, 0.1], [0.1, 0.9]], [[0.6, 0.4], [0.4, 0.6]]])
    for k, name in enumerate(names):
        ahead, across = f"x{(k + 1) % 4}_prev", f"x{(k + 2) % 4}_prev"
        dbn.add(name, lambda own, a, b, u: bmc.Categorical(tie[own, np.where(u > 0, a, b)]),
                {"own": f"{name}_prev", "a": ahead, "b": across, "u": "u"},
                initial=bmc.Categorical([0.5, 0.5]))  # fmt: skip
        dbn.table(f"y{k}", [name], [[0.8, 0.2], [0.3, 0.7]])
    rng = np.random.default_rng(0)
    rows = {f"y{k}": rng.integers(2, size=8) for k in range(4)}
    inputs = {"u": np.array([1.0] * 4 + [-1.0] * 4)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coupling, "STATES", 4)
        for engine in (bmc.BoyenKoller(), bmc.FactoredFrontier()):
            whole = bmc.filter(dbn, rows, inputs=inputs, engine=engine)
            belief = engine.start(dbn)
            for t in range(8):
                belief = engine.start(dbn, belief=pickle.loads(pickle.dumps(belief)))
                row = {n: v[t] for n, v in rows.items()}
                belief = engine.step(belief, row, inputs={"u": inputs["u"][t]})
                for name in names:
                    np.testing.assert_allclose(
                        belief.probabilities(name), whole.probabilities(name)[t], atol=1e-12
                    )


@pytest.mark.parametrize(
    ("clusters", "error", "words"),
    [
        ([["x0", "z"], ["x1"], ["x2"], ["x3"]], UnknownNodeError, "no node 'z'"),
        ([["x0", "x1"], ["x2"]], UnsupportedError, "reads 'x3', in none of the clusters"),
        ([["x0", "y0"], ["x1"], ["x2"], ["x3"]], UnsupportedError, "does not read 'y0'"),
        ([["x0", "x1"], ["x1", "x2"], ["x2", "x0"], ["x3"]], UnsupportedError, "overlap in a ring"),
        ([["x0", ("x1", 2)], ["x2"], ["x3"]], UnsupportedError, "give one position in each"),
    ],
)
def test_bad_clusters_are_refused_by_name(clusters: Any, error: Any, words: str) -> None:
    model = coupled(np.random.default_rng(8))
    rows = model.rows(3, np.random.default_rng(9))
    engine = bmc.BoyenKoller(clusters)
    with pytest.raises(UnsupportedError, match=words):
        bmc.filter(model.dbn, rows, engine=engine)
    assert words in str(engine.unsupported(model.dbn, rows))
    with pytest.raises(error, match=words):
        engine.step(engine.start(model.dbn), {"y0": 0})


@pytest.mark.parametrize("clusters", ["x", ["x0", "x1"], 3, [[0]], [[("x", "y")]]])
def test_what_is_no_list_of_clusters_is_refused(clusters: Any) -> None:
    with pytest.raises(TypeError, match="give clusters="):
        bmc.BoyenKoller(clusters)


def test_impossible_rows_are_refused_by_name() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("a", ["a_prev"], [[1.0, 0.0], [0.0, 1.0]], initial=[1.0, 0.0])
    dbn.table("b", ["a_prev", "b_prev"], np.full((2, 2, 2), 0.5), initial=[0.5, 0.5])
    dbn.table("u", ["b"], [[0.5, 0.5], [0.5, 0.5]])
    dbn.table("v", ["a"], [[1.0, 0.0], [0.0, 1.0]])
    rows = {"u": [0, 1, 0], "v": [0, 0, 1]}
    for engine in (bmc.BoyenKoller(), bmc.BoyenKoller([["a"], ["b"]]), bmc.FactoredFrontier()):
        with pytest.raises(ZeroProbabilityError, match="slice 2, what was seen of 'v'"):
            bmc.filter(dbn, rows, engine=engine)


def many(nodes: int) -> bmc.DynamicBayesNet:
    """Switches in a row, each of which follows the one before it."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("x0", ["x0_prev"], [[0.8, 0.2], [0.2, 0.8]], initial=[0.5, 0.5])
    follow = np.array([[[0.9, 0.1], [0.4, 0.6]], [[0.6, 0.4], [0.1, 0.9]]])
    for k in range(1, nodes):
        dbn.table(f"x{k}", [f"x{k - 1}_prev", f"x{k}_prev"], follow, initial=[0.5, 0.5])
    dbn.table("y", [f"x{nodes - 1}"], [[0.8, 0.2], [0.2, 0.8]])
    return dbn


def test_where_the_joint_state_is_too_large_this_is_the_engine() -> None:
    rows = {"y": [0, 1, 1, 1]}
    with pytest.raises(UnsupportedError, match=r"use BoyenKoller\(\) or FactoredFrontier\(\)"):
        bmc.filter(many(25), rows, engine=bmc.DiscreteFilter())
    said = bmc.explain(many(25), rows)
    assert isinstance(said.engine, bmc.BoyenKoller)
    assert "approximation" in said.reasons[0] and "DiscreteFilter" in said.refused
    assert isinstance(bmc.filter(many(25), rows).engine, bmc.BoyenKoller)
    assert isinstance(bmc.explain(many(5), rows).engine, bmc.DiscreteFilter)
    assert "BoyenKoller" not in bmc.explain(many(5), rows).refused
    assert "BoyenKoller" in bmc.explain(many(25), rows, question="most_likely").refused
    wide = bmc.DynamicBayesNet()
    wide.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    wide.add("y", lambda x: bmc.Normal(x, 1.0))
    assert "BoyenKoller" not in bmc.explain(wide, {"y": [0.0]}).refused


def test_a_thousand_switches_are_no_number_too_large() -> None:
    rows = {"y": [0, 1]}
    assert "inf" in str(bmc.DiscreteFilter().unsupported(many(1100), rows))
    assert bmc.FactoredFrontier().unsupported(many(1100), rows) is None


def test_trees_that_are_too_large_are_refused_with_the_figure() -> None:
    rows = {"y": [0, 1]}
    said = bmc.BoyenKoller(max_bytes=1e4).unsupported(many(25), rows)
    assert said is not None and "give smaller clusters=" in said
    assert "max_bytes" in str(bmc.FactoredFrontier(max_bytes=100).unsupported(many(25), rows))
    with pytest.raises(ValueError, match="positive number of bytes"):
        bmc.BoyenKoller(max_bytes=0)


def test_clusters_are_the_same_for_any_data_and_any_run() -> None:
    rng = np.random.default_rng(10)
    model = coupled(rng)

    def found(rows: dict[str, Any]) -> Any:
        plan = bmc.BoyenKoller()._plan(pose_series(model.dbn, rows))
        assert isinstance(plan, FactoredSlices)
        return [[c.scope for c in clusters] for clusters in plan.clusters]

    assert found(model.rows(3, rng)) == found(model.rows(8, rng, 0.5))


def test_what_is_tied_most_is_put_together_first() -> None:
    """Pairs of nodes that move together, each pair on its own but for a weak tie between them."""
    dbn, weak = bmc.DynamicBayesNet(), 0.01
    for k in range(12):
        other = f"x{k + 1}_prev" if k % 2 == 0 else f"x{k - 1}_prev"
        aside = f"x{(k + 2) % 12}_prev"
        base = np.array([[0.9, 0.5], [0.5, 0.1]])[..., None] + weak * np.array([0.5, -0.5])
        dbn.table(
            f"x{k}",
            [f"x{k}_prev", other, aside],
            np.stack([base, 1 - base], -1),
            initial=[0.5, 0.5],
        )
        dbn.table(f"y{k}", [f"x{k}"], [[0.7, 0.3], [0.3, 0.7]])
    rows = {"y0": [0, 1]}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coupling, "STATES", 16)  # parts of four joint states: the pairs
        plan: Any = bmc.BoyenKoller()._plan(pose_series(dbn, rows))
    for cluster in plan.clusters[0]:
        members = {int(v[1][1:]) for v in cluster.scope}
        assert members == {k ^ 1 for k in members}, "a pair was torn apart"


# ---- the factored frontier ----------------------------------------------------------------------


@pytest.mark.parametrize("sparse", [1.0, 0.3])
def test_the_frontier_is_what_loops_say(sparse: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng([seed, 2])
        model = coupled(rng, sparse=sparse)
        rows = model.rows(6, rng)
        increments, filtered, smoothed = factored_frontier(model, rows)
        found = bmc.filter(model.dbn, rows, engine=bmc.FactoredFrontier())
        np.testing.assert_allclose(found.log_marginal_increments, increments, atol=1e-10)
        np.testing.assert_allclose(
            tables(found, 4), [np.concatenate(p) for p in filtered], atol=1e-10
        )
        found = bmc.smooth(model.dbn, rows, engine=bmc.FactoredFrontier())
        np.testing.assert_allclose(
            tables(found, 4), [np.concatenate(p) for p in smoothed], atol=1e-10
        )


def test_the_frontier_takes_regular_templates_alone() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("a", ["a_prev"], [[0.8, 0.2], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.table("b", ["a"], [[0.8, 0.2], [0.2, 0.8]])
    dbn.table("y", ["b"], [[0.8, 0.2], [0.2, 0.8]])
    said = bmc.FactoredFrontier().unsupported(dbn, {"y": [0, 1]})
    assert said is not None and "'b' would not reach its parent 'a'" in said
    assert bmc.BoyenKoller().unsupported(dbn, {"y": [0, 1]}) is None


def test_the_frontier_takes_readings_of_what_is_handed_on_alone() -> None:
    """What is seen of a node that nothing reads tells its parents of the slice before, which are gone."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("a", ["a_prev"], [[0.8, 0.2], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.table("b", ["a_prev"], [[0.8, 0.2], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.table("y", ["b"], [[0.8, 0.2], [0.2, 0.8]])
    said = bmc.FactoredFrontier().unsupported(dbn, {"y": [0, 1]})
    assert said is not None and "what is seen of 'y' would tell 'b'" in said
    dbn.table("z", ["a"], [[0.8, 0.2], [0.2, 0.8]])
    unseen = bmc.filter(dbn, {"z": [0, 1]}, engine=bmc.FactoredFrontier())
    right = bmc.filter(dbn, {"z": [0, 1]}, engine=bmc.DiscreteFilter())
    np.testing.assert_allclose(unseen.probabilities("a"), right.probabilities("a"), atol=1e-12)


@pytest.mark.parametrize("first", [True, False])
def test_the_frontier_takes_in_readings_of_the_slice_before_at_once(first: bool) -> None:
    """A reading of the slice before, declared before or after the node that moves on; exact on one chain."""
    dbn = bmc.DynamicBayesNet()

    def reading() -> None:
        table = [[0.8, 0.2], [0.3, 0.7]]
        dbn.table("y", ["x_prev"], table, initial=[0.5, 0.5])

    if first:
        reading()
    dbn.table("x", ["x_prev"], [[0.7, 0.3], [0.2, 0.8]], initial=[0.4, 0.6])
    if not first:
        reading()
    rows = {"y": [0, 0, 1, 1, 1]}
    for call in (bmc.filter, bmc.smooth):
        found = call(dbn, rows, engine=bmc.FactoredFrontier())
        right = call(dbn, rows, engine=bmc.DiscreteFilter())
        np.testing.assert_allclose(found.probabilities("x"), right.probabilities("x"), atol=1e-12)
        assert found.log_marginal_likelihood == pytest.approx(right.log_marginal_likelihood)


def test_the_frontier_has_no_tables_of_two_slices() -> None:
    rng = np.random.default_rng(11)
    model = coupled(rng)
    rows = model.rows(4, rng)
    with pytest.raises(bmc.errors.QueryError):
        bmc.smooth(model.dbn, rows, engine=bmc.FactoredFrontier()).pairs("x0")
    whole = [f"x{k}" for k in range(4)]
    pairs = bmc.smooth(model.dbn, rows, engine=bmc.BoyenKoller([whole])).pairs("x0")
    right = bmc.smooth(model.dbn, rows, engine=bmc.DiscreteFilter()).pairs("x0")
    np.testing.assert_allclose(pairs, right, atol=1e-10)


# ---- what is said -------------------------------------------------------------------------------


def test_what_is_exact_is_said_to_be_and_what_is_not_is_not() -> None:
    model = coupled(np.random.default_rng(12))
    rows = model.rows(3, np.random.default_rng(13))
    whole = bmc.explain(model.dbn, rows, engine=bmc.BoyenKoller([[f"x{k}" for k in range(4)]]))
    assert "exact" in whole.effort and "approximate" not in whole.effort
    for engine in (bmc.BoyenKoller(named(CLUSTERINGS["pairs"])), bmc.FactoredFrontier()):
        said = bmc.explain(model.dbn, rows, engine=engine)
        assert "approximate, the log marginal likelihood too" in said.effort
        found = bmc.filter(model.dbn, rows, engine=engine)
        assert found.log_marginal_likelihood_mcse is None
    words = bmc.explain(model.dbn, rows, engine=bmc.BoyenKoller(named(CLUSTERINGS["pairs"]))).nodes
    assert "(x0, x2)" in words["x0"] and words["x0"] == words["x2"]


def test_what_no_cluster_holds_has_a_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    model = coupled(np.random.default_rng(14))
    rows = model.rows(3, np.random.default_rng(15))
    engine = bmc.BoyenKoller(named(CLUSTERINGS["single"]))
    found = bmc.filter(model.dbn, rows, engine=engine)
    monkeypatch.setattr("bayesmc.engines.factored.run.BLOCK_ENTRIES", 8)
    assert found.expectation(lambda x0: x0 * 1.0).shape == (3,)
    with pytest.raises(bmc.errors.BudgetError, match="x0, x3 together, which no cluster holds"):
        found.expectation(lambda x0, x3: x0 * x3 * 1.0)


def test_elements_of_a_plate_filtered_apart_are_not_named_one_by_one() -> None:
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    infects = [[[0.95, 0.05], [0.3, 0.7]], [[0.7, 0.3], [0.2, 0.8]]]
    dbn.table("a", ["b_prev", "a_prev"], infects, initial=[0.9, 0.1], plates="k")
    dbn.table("b", ["a_prev", "b_prev"], infects, initial=[0.9, 0.1], plates="k")
    dbn.table("test", ["a"], [[0.9, 0.1], [0.2, 0.8]], plates="k")
    rows = {"test": [[0, 1], [1, 1]]}
    named = [[("a", 0), ("b", 0)], [("a", 1)], [("b", 1)]]
    with pytest.raises(UnsupportedError, match=r"\('a', 0\): elements of plate 'k' never meet"):
        bmc.filter(dbn, rows, engine=bmc.BoyenKoller(named))
    bmc.filter(dbn, rows, engine=bmc.BoyenKoller([["a", "b"]]))


@pytest.mark.parametrize("family", [bmc.BoyenKoller, bmc.FactoredFrontier])
def test_they_say_who_they_are_and_that_answers_are_approximate(family: Any) -> None:
    dbn = bmc.DynamicBayesNet()
    infects = [[[0.999, 0.001], [0.5, 0.5]], [[0.5, 0.5], [0.2, 0.8]]]
    dbn.table("a", ["b_prev", "a_prev"], infects, initial=[0.999, 0.001])
    dbn.table("b", ["a_prev", "b_prev"], infects, initial=[0.999, 0.001])
    dbn.table("test", ["a"], [[0.999, 0.001], [0.9, 0.1]])
    engine = bmc.BoyenKoller([["a"], ["b"]]) if family is bmc.BoyenKoller else family()
    rows = {"test": np.ones(60, dtype=int)}
    for ask in (bmc.filter, bmc.smooth):
        with pytest.warns(ModelMisfitWarning, match=family.__name__) as told:
            ask(dbn, rows, engine=engine)
        assert not any("DiscreteFilter" in str(w.message) for w in told)
    for question in ("filter", "smooth", "fixed-lag", "forecast"):
        assert "approximate" in str(bmc.explain(dbn, rows, engine=engine, question=question))
    with pytest.raises(ValueError, match="positive number of bytes"):
        family(max_bytes=True)


def test_what_the_frontier_refuses_is_refused_row_by_row() -> None:
    """A reading of b tells a of the same slice, which the frontier would not hear."""
    dbn = bmc.DynamicBayesNet("irregular")
    dbn.table("a", ["a_prev"], [[0.9, 0.1], [0.1, 0.9]], initial=[0.5, 0.5])
    wear = [[[0.95, 0.05], [0.1, 0.9]], [[0.9, 0.1], [0.05, 0.95]]]
    dbn.table("b", ["b_prev", "a"], wear, initial=[0.5, 0.5])
    dbn.table("y", ["b"], [[0.95, 0.05], [0.05, 0.95]])
    engine = bmc.FactoredFrontier()
    belief = engine.start(dbn)
    for ask in (
        lambda: engine.step(belief, {"y": 1}),
        lambda: bmc.filter(dbn, {"y": [1, 1]}, engine=engine),
    ):
        with pytest.raises(
            UnsupportedError, match="'b' would not reach its parent 'a'.*BoyenKoller"
        ):
            ask()
