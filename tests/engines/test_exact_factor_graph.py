"""Exact on factor graphs: against sums over all configurations, a published lattice, and nets."""

from __future__ import annotations

import itertools
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import errors

NAN = float("nan")


def pairs_of(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of every edge of a grid with free boundaries, in flat positions."""
    g = np.arange(height * width).reshape(height, width)
    ends = [(g[:, :-1], g[:, 1:]), (g[:-1], g[1:])]
    return tuple(np.concatenate([e[k].ravel() for e in ends]) for k in (0, 1))


def ising(height: int, width: int, coupling: float, field: Any = None) -> bmc.FactorGraph:
    graph = bmc.FactorGraph("ising", plates={"site": height * width})
    graph.variable("s", (-1, 1), plates="site")
    graph.factor(lambda a, b: coupling * a * b, scope=("s", "s"), index=pairs_of(height, width))
    if field is not None:
        sites = np.arange(height * width)
        graph.factor(lambda s: field.ravel() * s, scope="s", index=(sites,))
    return graph


def enumerated(graph: bmc.FactorGraph) -> tuple[float, dict[str, np.ndarray]]:
    """Log Z and the marginal tables of all variables, by summing over every configuration."""
    axes = [
        (name, e, record.states)
        for name, record in graph.variables.items()
        for e in range(record.size)
    ]
    rows = np.array(list(itertools.product(*(range(len(s)) for _, _, s in axes))))
    values: dict[str, np.ndarray] = {}
    for name, record in graph.variables.items():
        columns = [k for k, (n, _, _) in enumerate(axes) if n == name]
        codes = rows[:, columns].reshape(-1, *(graph.plates[p] for p in record.plates))
        values[name] = np.array(record.states)[codes]
    logs = graph.log_prob(values)
    top = logs.max()
    weights = np.exp(logs - top)
    tables = {}
    for name, record in graph.variables.items():
        states = np.array(record.states)
        hit = values[name][..., None] == states
        tables[name] = np.tensordot(weights, hit, 1) / weights.sum()
    return float(top + np.log(weights.sum())), tables


def held(graph: bmc.FactorGraph, atol: float = 1e-12) -> None:
    """Assert that Exact gives the enumerated answer."""
    log_z, tables = enumerated(graph)
    posterior = bmc.infer(graph, engine=bmc.Exact())
    assert posterior.log_marginal_likelihood == pytest.approx(log_z, abs=1e-10)
    for name, table in tables.items():
        np.testing.assert_allclose(posterior.probabilities(name), table, atol=atol)


def test_a_small_grid_with_a_field() -> None:
    field = np.random.default_rng(0).normal(size=(3, 4))
    held(ising(3, 4, 0.6, field))


@pytest.mark.parametrize("seed", range(6))
def test_random_graphs(seed: int) -> None:
    """Variables of several kinds, indexed, plated and single factors, tables and functions."""
    rng = np.random.default_rng(seed)
    graph = bmc.FactorGraph(plates={"i": 3, "j": 2})
    graph.variable("a", ("x", "y", "z"), plates="i")
    graph.variable("b", (-1, 1), plates=("i", "j"))
    graph.variable("c", 3)
    graph.variable("lonely", 2)
    graph.factor(rng.normal(size=(4, 3, 2)), ("a", "b"),
                 index=(rng.integers(0, 3, 4), (rng.integers(0, 3, 4), rng.integers(0, 2, 4))))  # fmt: skip
    graph.factor(rng.normal(size=(3, 3)), ("a", "a"), index=([0, 1], [2, 0]))
    scale = rng.normal(size=5)
    graph.factor(
        lambda b, c: scale * b * (c - 1.0),
        ("b", "c"),
        index=((rng.integers(0, 3, 5), rng.integers(0, 2, 5)), None),
    )
    graph.factor(lambda a, b: np.where(a == "y", 0.3 * b, 0.0), ("a", "b"))
    graph.factor(rng.normal(size=3), ("c",))
    graph.factor(lambda b: 0.2 * (b.sum("i") == 1), ("b",), plates="j")
    held(graph)


def test_a_narrow_grid_against_a_transfer_matrix() -> None:
    """A 4 x 40 grid: the transfer matrix over columns of 16 configurations is an independent answer."""
    coupling, height, width = 0.4, 4, 40
    field = np.random.default_rng(2).normal(size=(height, width))
    columns = np.array(list(itertools.product((-1, 1), repeat=height)))
    within = coupling * (columns[:, 1:] * columns[:, :-1]).sum(axis=1)
    own = within[:, None] + columns @ field
    across = np.exp(coupling * columns @ columns.T)
    forward, backward = [np.exp(own[:, 0])], [np.ones(16)]
    scales = []
    for k in range(1, width):
        scales.append(forward[-1].sum())
        forward.append((across.T @ (forward[-1] / scales[-1])) * np.exp(own[:, k]))
        after = across @ (backward[0] * np.exp(own[:, width - k]))
        backward.insert(0, after / after.sum())
    log_z = float(np.log(scales).sum() + np.log(forward[-1].sum()))
    both = np.array(forward) * np.array(backward)
    both /= both.sum(axis=1, keepdims=True)
    expected = (both @ columns).T.ravel()
    graph = ising(height, width, coupling, field)
    posterior = bmc.infer(graph)
    assert isinstance(posterior.engine, bmc.Exact)  # narrow, hence cheap
    assert posterior.log_marginal_likelihood == pytest.approx(log_z, abs=1e-9)
    np.testing.assert_allclose(posterior.mean("s"), expected, atol=1e-11)


@pytest.fixture(scope="module")
def lattices(reference_data: Path) -> dict[str, Any]:
    return json.loads((reference_data / "ising" / "ising.dev.ref.json").read_text())


def products(size: int, coupling: float) -> np.ndarray:
    """Mean of the product of both ends of every edge, as variables of their own."""
    i, j = pairs_of(size, size)
    graph = bmc.FactorGraph(plates={"site": size * size, "edge": len(i)})
    graph.variable("s", (-1, 1), plates="site")
    graph.variable("product", (-1, 1), plates="edge")
    graph.factor(
        lambda a, b, ab: np.where(a * b == ab, coupling * ab, -np.inf),
        scope=("s", "s", "product"),
        index=(i, j, np.arange(len(i))),
    )
    return bmc.infer(graph, engine=bmc.Exact()).mean("product")


def test_published_lattices(lattices: dict[str, Any]) -> None:
    for key, expected in lattices["lattice_exact"].items():
        size, coupling = expected["L"], expected["J"]
        posterior = bmc.infer(ising(size, size, coupling), engine=bmc.Exact())
        assert posterior.log_marginal_likelihood == pytest.approx(expected["logZ"], rel=1e-12), key
        # published as numerical derivatives of log Z, the second to fewer digits
        energy = products(size, coupling).sum()
        assert energy == pytest.approx(expected["mean_sum_xixj"], rel=1e-6), key
        field = 1e-3  # the mean magnetisation in a weak field is field * E[M^2]
        pulled = bmc.infer(ising(size, size, coupling, np.full((size, size), field)))
        square = pulled.mean("s").sum() / field / size**4
        assert square == pytest.approx(expected["E_M2_per_site2"], rel=1e-3), key


def test_moments_of_a_lattice_by_enumeration() -> None:
    """All 65,536 configurations of 4 x 4 spins, to more digits than are published."""
    spins = np.array(list(itertools.product((-1, 1), repeat=16)), dtype=float)
    i, j = pairs_of(4, 4)
    each = spins[:, i] * spins[:, j]
    weights = np.exp(0.4 * each.sum(axis=1))
    weights /= weights.sum()
    np.testing.assert_allclose(products(4, 0.4), weights @ each, rtol=1e-12)
    covariance = bmc.infer(ising(4, 4, 0.4), engine=bmc.Exact()).cov("s")
    np.testing.assert_allclose(covariance[i, j], weights @ each, rtol=1e-12)
    assert covariance.sum() == pytest.approx(weights @ spins.sum(axis=1) ** 2, rel=1e-12)


def test_published_patch(lattices: dict[str, Any], reference_data: Path) -> None:
    noisy = np.load(reference_data / "ising" / "horse.dev.npz")["noisy_small_p10"]
    patch = noisy[36:48, 20:80].astype(float)
    for key, expected in lattices["patch_exact"].items():
        graph = ising(12, 60, expected["J"], expected["h"] * patch)
        posterior = bmc.infer(graph, engine=bmc.Exact())
        found = posterior.probabilities("s")[:, 1]
        assert posterior.log_marginal_likelihood == pytest.approx(expected["logZ"], rel=1e-11), key
        published = np.ravel(expected["posterior_P_plus1"])  # to six digits
        np.testing.assert_allclose(found, published, atol=6e-7, err_msg=key)


def test_evidence_conditions_a_graph() -> None:
    field = np.random.default_rng(5).normal(size=(2, 3))
    graph = ising(2, 3, 0.5, field)
    seen = np.array([1.0, NAN, NAN, -1.0, NAN, NAN])
    posterior = bmc.infer(graph, {"s": seen}, engine=bmc.Exact())
    states = np.array(list(itertools.product((-1, 1), repeat=6)))
    states = states[(states[:, 0] == 1) & (states[:, 3] == -1)]
    weights = np.exp(graph.log_prob({"s": states}))
    np.testing.assert_allclose(posterior.mean("s"), weights @ states / weights.sum(), atol=1e-12)
    assert posterior.log_marginal_likelihood == pytest.approx(np.log(weights.sum()))


def test_observed_continuous_variables() -> None:
    y = np.array([0.3, -1.0, 2.0])
    graph = bmc.FactorGraph(plates={"i": 3})
    graph.variable("z", (-1, 1), plates="i")
    graph.variable("y", "real", plates="i")
    graph.factor(lambda z, y: -0.5 * (y - z) ** 2, ("z", "y"), index=([0, 1, 2], [0, 1, 2]))
    graph.factor(lambda a, b: 0.8 * a * b, ("z", "z"), index=([0, 1], [1, 2]))
    posterior = bmc.infer(graph, {"y": y}, engine=bmc.Exact())
    states = np.array(list(itertools.product((-1, 1), repeat=3)))
    logs = -0.5 * ((y - states) ** 2).sum(1) + 0.8 * (states[:, :-1] * states[:, 1:]).sum(1)
    weights = np.exp(logs)
    np.testing.assert_allclose(posterior.mean("z"), weights @ states / weights.sum(), atol=1e-12)
    assert posterior.log_marginal_likelihood == pytest.approx(np.log(weights.sum()))
    again = bmc.infer(graph, {"y": -y}, engine=bmc.Exact())  # other values, the same plan
    np.testing.assert_allclose(again.mean("z"), -posterior.mean("z"), atol=1e-12)


def test_a_graph_of_a_net_answers_as_the_net() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("a", bmc.Bernoulli(0.3), states=("no", "yes"))
    net.add("mu", lambda a: bmc.Normal(np.where(a == "yes", 2.0, -1.0), 1.0))
    net.add("x", lambda mu: bmc.Normal(mu, 2.0), plates="i")
    net.potential("pull", lambda a: np.where(a == "yes", 0.7, 0.0))
    evidence = {"x": [0.5, NAN, 1.0]}  # likely enough for weighting, too
    direct = bmc.infer(net, evidence, engine=bmc.Exact())
    graph = bmc.infer(net.to_factor_graph(evidence), engine=bmc.Exact())
    assert graph.log_marginal_likelihood == direct.log_marginal_likelihood
    np.testing.assert_array_equal(graph.probabilities("a"), direct.probabilities("a"))
    np.testing.assert_array_equal(graph.mean("x"), direct.mean("x"))
    weighted = [
        bmc.infer(n, e, engine=bmc.LikelihoodWeighting(500), rng=3)
        for n, e in ((net, evidence), (net.to_factor_graph(evidence), None))
    ]
    np.testing.assert_array_equal(weighted[0]["mu"], weighted[1]["mu"])
    more = bmc.infer(net.to_factor_graph(evidence), {"a": "no"}, engine=bmc.Exact())
    both = bmc.infer(net, {**evidence, "a": "no"}, engine=bmc.Exact())
    assert more.log_marginal_likelihood == pytest.approx(both.log_marginal_likelihood, abs=1e-12)
    with pytest.raises(errors.EvidenceError, match="has evidence already"):
        bmc.infer(net.to_factor_graph(evidence), {"x": [1.0, 2.0, 3.0]})


def test_inputs_are_settled_with_the_graph() -> None:
    net = bmc.BayesNet()
    net.input("u")
    net.add("a", lambda u: bmc.Bernoulli(u))
    graph = net.to_factor_graph(inputs={"u": 0.25})
    assert bmc.infer(graph, engine=bmc.Exact()).mean("a") == pytest.approx(0.25)
    assert graph.log_prob({"a": 1}) == pytest.approx(np.log(0.25))
    with pytest.raises(errors.EvidenceError, match="to_factor_graph"):
        bmc.infer(graph, inputs={"u": 0.5})


def test_later_declarations_do_not_reach_a_posterior() -> None:
    graph = ising(2, 2, 0.5)
    posterior = bmc.infer(graph, engine=bmc.Exact())
    before = posterior.probabilities("s")
    graph.factor(lambda s: 2.0 * s, scope="s")
    np.testing.assert_array_equal(posterior.probabilities("s"), before)
    assert bmc.infer(graph, engine=bmc.Exact()).mean("s")[0] > 0.9
    drawn = posterior.resample(50, rng=0)
    assert drawn["s"].shape == (1, 50, 4)
    loaded = pickle.loads(pickle.dumps(posterior))
    np.testing.assert_array_equal(loaded.probabilities("s"), before)


@pytest.mark.parametrize(
    "engine", [bmc.LikelihoodWeighting(100), bmc.Rejection(100), bmc.Importance(100)]
)
def test_forward_engines_refuse_variables_in_words(engine: Any) -> None:
    graph = ising(2, 2, 0.5)
    with pytest.raises(
        errors.UnsupportedError, match="'s' is a variable of a factor graph"
    ) as caught:
        bmc.infer(graph, engine=engine)
    assert "Exact() can answer this" in str(caught.value)
    assert "'s' is a variable" in engine.unsupported(graph)


def test_importance_takes_a_graph_whose_variables_are_proposed() -> None:
    graph = bmc.FactorGraph()
    graph.variable("x", "real")
    graph.factor(lambda x: -(x**4))
    engine = bmc.Importance(20_000, proposal={"x": lambda: bmc.Normal(0.0, 1.0)})
    posterior = bmc.infer(graph, engine=engine, rng=1)
    log_z = 0.5948753441  # log of Gamma(1/4) / 2
    error = posterior.log_marginal_likelihood_mcse
    # five standard errors: a false alarm in 1.7 million seeds
    assert abs(posterior.log_marginal_likelihood - log_z) < 5 * error < 0.05
    assert abs(posterior.log_marginal_likelihood - log_z - 0.1) > 5 * error  # control


def test_exact_refuses_continuous_variables_and_names_who_can() -> None:
    graph = bmc.FactorGraph()
    graph.variable("x", "real")
    graph.factor(lambda x: -(x**2))
    with pytest.raises(errors.UnsupportedError, match="'x' is continuous; use Gibbs"):
        bmc.infer(graph, engine=bmc.Exact())


def test_zero_everywhere_is_impossible() -> None:
    graph = bmc.FactorGraph()
    graph.variable("a", 2)
    graph.factor([-np.inf, -np.inf], scope="a")
    with pytest.raises(errors.ZeroProbabilityError):
        bmc.infer(graph, engine=bmc.Exact())


def test_no_order_is_looked_for_on_large_wide_grids() -> None:
    problem = ising(60, 60, 0.5)
    try:
        reason = str(bmc.explain(problem).refused["Exact"])
    except errors.UnsupportedError as error:  # nothing else can answer
        reason = str(error)
    assert "3596 discrete variables have three neighbours or more" in reason


def test_explain_says_what_happens_to_variables(capsys: pytest.CaptureFixture[str]) -> None:
    explanation = bmc.explain(ising(3, 3, 0.5))
    assert explanation.nodes == {"s": "eliminated"}
    assert "induced width 3" in capsys.readouterr().out
