"""The strategies: valid draws, small failing examples that print as code, readable refusals; and the library
held to what they draw."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, find, given, settings

import bayesmc as bmc
from bayesmc.categorical import log_sum_exp
from bayesmc.diagnostics import normalised, weight_ess
from bayesmc.errors import MissingExtraError, UnsupportedError
from bayesmc.network.parts import without_idle_plates
from bayesmc.resampling import SCHEMES
from bayesmc.testing import enumerate_posterior, random_evidence, random_net, session
from bayesmc.testing.makers.families import _FAMILIES, random_distribution
from bayesmc.testing.makers.spelling import as_code
from bayesmc.testing.makers.strategies import (
    bayes_nets,
    dbns,
    distributions,
    evidence_for,
    factor_graphs,
    log_weights,
)
from bayesmc.testing.makers.weights import random_log_weights

FEW = settings(max_examples=session.scaled(20, 5), suppress_health_check=[HealthCheck.too_slow])
SHRINK = settings(FEW, max_examples=300, phases=(Phase.generate, Phase.shrink))


def smallest(strategy: Any, fault: Callable[[Any], bool]) -> Any:
    return find(strategy, fault, settings=SHRINK)


# ---- what they shrink to ------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"hybrid": True, "plates": True}, {"continuous": True}])
def test_the_smallest_net_with_an_edge_has_two_nodes(options: dict[str, Any]) -> None:
    net = smallest(bayes_nets(**options), lambda net: any(net[n].parents for n in net))
    assert len(net) == 2
    assert sum(len(net[n].parents) for n in net) == 1
    assert len(as_code(net).splitlines()) <= 4


def test_the_smallest_net_is_that_of_the_fault() -> None:
    def has_a_state_of_zero(net: bmc.BayesNet) -> bool:
        return any(d.probs is not None and (d.probs == 0).any() for d in net.declarations.values())

    net = smallest(bayes_nets(plates=True, hybrid=True), has_a_state_of_zero)
    assert as_code(net).splitlines()[1:] in (
        ['net.table("v0", [], [1.0, 0.0])'],
        ['net.table("v0", [], [0.0, 1.0])'],
    )


def test_plates_that_nothing_is_on_are_dropped() -> None:
    net = smallest(bayes_nets(plates=True, nodes=(1, 3)), lambda net: True)
    assert as_code(net).splitlines()[0] == "net = bmc.BayesNet()"
    one = smallest(bayes_nets(plates=True), lambda net: any(net[n].plates for n in net))
    assert len(one.plates) == 1
    labelled = bmc.BayesNet(plates={"city": ["Ulm", "Bonn"], "idle": ["a", "b"]})
    labelled.add("x", bmc.Normal(0.0, 1.0), plates="city")
    kept = without_idle_plates(labelled)._plates
    assert kept.sizes == {"city": 2} and kept.labels == {"city": ("Ulm", "Bonn")}


def test_the_smallest_of_the_others() -> None:
    case = smallest(dbns(), lambda case: case.steps > 1)
    assert case.steps == 2 and len(case.dbn.template.later) == 1
    graph = smallest(factor_graphs(), lambda g: any(len(f.scope) > 1 for f in g.factors))
    assert len(graph) <= 2 and len(as_code(graph).splitlines()) <= 4
    dist = smallest(distributions(extreme=True), lambda d: d.batch_shape == (2,))
    assert set(as_code(dist)) <= set("bmc.HalfNormalExponential(np.array([0.0, 1.0]))")
    assert len(as_code(dist)) < 60
    weights = smallest(log_weights(), lambda w: np.isneginf(w).any())
    assert sorted(weights.tolist()) == [-np.inf, 0.0]


def test_a_failing_example_is_told_in_code() -> None:
    @SHRINK
    @given(bayes_nets(nodes=(2, 4)))
    def no_net_has_edges(net: bmc.BayesNet) -> None:
        assert not any(net[n].parents for n in net)

    with pytest.raises(AssertionError) as caught:
        no_net_has_edges()
    told = "\n".join(caught.value.__notes__)
    code = told[told.index("net = bmc.BayesNet(") : told.index("\n    ,")]
    names: dict[str, Any] = {}
    exec(
        "\n".join(["import numpy as np, bayesmc as bmc", *map(str.strip, code.splitlines())]), names
    )
    assert any(names["net"][n].parents for n in names["net"])


def test_a_net_of_a_user_is_told_as_before() -> None:
    from hypothesis.vendor import pretty

    net = bmc.BayesNet("mine")
    net.add("a", lambda: bmc.Normal(0.0, 1.0))
    bayes_nets()  # registers how nets are told
    assert pretty.pretty(net) == repr(net)
    assert pretty.pretty(bmc.Normal(0.0, 1.0)) == repr(bmc.Normal(0.0, 1.0))


# ---- nets ---------------------------------------------------------------------------------------


def test_continuous_nets_are_continuous_and_bounded() -> None:
    for seed in range(30):
        net = random_net(seed, continuous=True, plates=True, nodes=(2, 5))
        kinds = [net[n] for n in net]
        assert 2 <= len(net) <= 5 and not any(node.is_discrete for node in kinds)
        elements = sum(
            int(np.prod([net.plates[p] for p in node.plates], dtype=int))
            for node in kinds
            if node.kind == "stochastic"
        )
        assert elements <= 3  # 32 points each, 1 << 15 in all


def test_coupling_scales_what_parents_do() -> None:
    """Without it parents change nothing; with more of it they change more."""
    effect = []
    for coupling in (0.0, 1.0, 4.0):
        total = 0.0
        for seed in range(40):
            net = random_net(seed, nodes=(2, 3), states=2, deterministic=False, coupling=coupling)
            # a parent changes nothing where pairs are independent
            found = enumerate_posterior(net)
            for a, b in itertools.combinations(net, 2):
                pair = found.probabilities(a, b)
                total += np.abs(pair - np.multiply.outer(pair.sum(1), pair.sum(0))).sum()
        effect.append(total)
    assert effect[0] < 1e-10 < effect[1] < effect[2]


def test_least_states_are_kept() -> None:
    for seed in range(30):
        net = random_net(seed, states=(3, 4), deterministic=False)
        assert {len(net[n].states or ()) for n in net} <= {3, 4}


@FEW
@given(bayes_nets(plates=True, states=(2, 4), coupling=3.0, configurations=1 << 10))
def test_exact_equals_enumeration(net: bmc.BayesNet) -> None:
    evidence = random_evidence(net, 0)
    if bmc.Exact().unsupported(net, evidence):
        return
    found, exact = bmc.infer(net, evidence, engine=bmc.Exact()), enumerate_posterior(net, evidence)
    np.testing.assert_allclose(
        found.log_marginal_likelihood, exact.log_marginal_likelihood, atol=1e-9
    )
    for name in net:
        if net[name].states is not None:
            ours, theirs = found.probabilities(name), exact.probabilities(name)
            np.testing.assert_allclose(ours, theirs, atol=1e-9)


# ---- templates, graphs --------------------------------------------------------------------------


@settings(FEW, max_examples=session.scaled(15, 5))
@given(dbns(nodes=(1, 2), steps=(1, 3)))
def test_filters_equal_the_unrolled_net(case: Any) -> None:
    engine = bmc.DiscreteFilter()
    found = bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=engine)
    net = case.dbn.unroll(case.steps, case.inputs)
    exact = bmc.infer(net, case.dbn.unrolled_evidence(case.observations), engine=bmc.Exact())
    total = np.sum(found.log_marginal_likelihood)
    np.testing.assert_allclose(total, exact.log_marginal_likelihood, atol=1e-9)


def by_brute_force(graph: bmc.FactorGraph) -> tuple[float, dict[str, np.ndarray]]:
    """Log Z and the probabilities of the states, from ``log_prob`` of all configurations."""
    shapes = {n: tuple(graph.plates[p] for p in v.plates) for n, v in graph.variables.items()}
    axes = [
        range(len(v.states))
        for n, v in graph.variables.items()
        for _ in range(int(np.prod(shapes[n], dtype=int)))
    ]
    grid, start, at, values = np.array(list(itertools.product(*axes))), 0, {}, {}
    for name, variable in graph.variables.items():
        count = int(np.prod(shapes[name], dtype=int))
        at[name] = grid[:, start : start + count].reshape(len(grid), *shapes[name])
        values[name] = np.array(variable.states)[at[name]]
        start += count
    log_p = graph.log_prob(values)
    weights = normalised(log_p)
    chances = {
        name: np.stack(
            [np.tensordot(weights, at[name] == k, axes=(0, 0)) for k in range(len(v.states))],
            axis=-1,
        )
        for name, v in graph.variables.items()
    }
    return log_sum_exp(log_p), chances


@FEW
@given(factor_graphs(coupling=3.0, configurations=1 << 9))
def test_exact_sums_factor_graphs(graph: bmc.FactorGraph) -> None:
    log_z, chances = by_brute_force(graph)
    posterior = bmc.infer(graph, engine=bmc.Exact())
    np.testing.assert_allclose(posterior.log_marginal_likelihood, log_z, atol=1e-9)
    for name, expected in chances.items():
        np.testing.assert_allclose(posterior.probabilities(name), expected, atol=1e-9)


def test_a_lost_factor_is_found_and_shrunk() -> None:
    """The negative control: an engine that forgets the last factor, and the smallest graph that shows it."""

    def differs(graph: bmc.FactorGraph) -> bool:
        lines = as_code(graph).splitlines()
        if "factor(" not in lines[-1]:
            return False
        names: dict[str, Any] = {"bmc": bmc, "np": np}
        exec("\n".join(lines[:-1]), names)
        faulty = bmc.infer(names["graph"], engine=bmc.Exact())
        return not np.isclose(faulty.log_marginal_likelihood, by_brute_force(graph)[0])

    found = smallest(factor_graphs(configurations=1 << 8), differs)
    assert len(as_code(found).splitlines()) == 3


@settings(FEW, max_examples=session.scaled(15, 5))
@given(factor_graphs(continuous=True))
def test_continuous_graphs_are_gaussian_and_gibbs_takes_them(graph: bmc.FactorGraph) -> None:
    names = [n for n, v in graph.variables.items() if v.states is None]
    far = {
        n: np.full([graph.plates[p] for p in v.plates], 1e4) if v.states is None
        else np.full([graph.plates[p] for p in v.plates], v.states[0])
        for n, v in graph.variables.items()
    }  # fmt: skip
    near = {n: np.zeros_like(x) if n in names else x for n, x in far.items()}
    assert np.isfinite(graph.log_prob(near))
    if names:  # so every ray leads down
        assert graph.log_prob(far) < -1e7
        assert "continuous" in (bmc.Exact().unsupported(graph, {}) or "")


# ---- distributions ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", _FAMILIES)
@pytest.mark.parametrize("extreme", [False, True])
def test_draws_densities_and_quantiles_of_every_family(name: str, extreme: bool) -> None:
    for seed in range(6):
        dist = random_distribution(seed, families=(name,), extreme=extreme)
        x = dist.sample(rng=seed, sample_shape=3)
        log_p = dist.log_prob(x)
        assert x.shape == (3, *dist.batch_shape, *dist.event_shape)
        assert log_p.shape == (3, *dist.batch_shape)
        assert (log_p > -np.inf).all(), as_code(dist)  # not NaN either
        assert np.ndim(dist.support.kind) == 0
        if not dist.event_shape and not extreme:
            check_quantiles(dist)


def check_quantiles(dist: bmc.Distribution) -> None:
    q = np.array([0.01, 0.3, 0.5, 0.9, 0.999]).reshape(5, *[1] * len(dist.batch_shape))
    try:
        x = dist.ppf(q)
    except UnsupportedError:
        return
    if dist.is_discrete:
        assert (dist.cdf(x) >= q - 1e-12).all() and (dist.cdf(x - 1) < q + 1e-12).all(), as_code(
            dist
        )
    else:
        np.testing.assert_allclose(dist.cdf(x), np.broadcast_to(q, x.shape), rtol=1e-7)


def test_every_family_is_drawn() -> None:
    """Public families are all here, but for those that are made of users' functions."""
    public = {
        name
        for name, value in vars(bmc).items()
        if isinstance(value, type) and issubclass(value, bmc.Distribution)
    }
    assert public - set(_FAMILIES) <= {"Distribution", "Density", "InverseCdf"}
    drawn = {type(random_distribution(seed)).__name__ for seed in range(400)}
    assert drawn == set(_FAMILIES)


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
@pytest.mark.parametrize("event_ndim", [0, 1])
def test_kinds_and_ranks_are_kept(kind: str, event_ndim: int) -> None:
    for seed in range(20):
        dist = random_distribution(seed, kind=kind, event_ndim=event_ndim, batch_ndim=1)
        assert dist.is_discrete == (kind == "discrete")
        assert len(dist.event_shape) == event_ndim and len(dist.batch_shape) <= 1


# ---- log weights --------------------------------------------------------------------------------


def test_log_weights_have_what_they_promise() -> None:
    many = [random_log_weights(seed) for seed in range(200)]
    assert any(np.isneginf(w).any() for w in many)
    assert any(len(set(w.tolist())) < len(w) for w in many)
    assert any(np.ptp(w[np.isfinite(w)]) > 1e5 for w in many)
    assert any(w[np.isfinite(w)].min() > 1e4 for w in many)
    assert all(np.isfinite(w).any() and not np.isnan(w).any() and w.max() < np.inf for w in many)
    assert {len(random_log_weights(seed, size=(2, 4))) for seed in range(60)} == {2, 3, 4}
    plain = [random_log_weights(s, ties=False, zeros=False, huge=False, size=9) for s in range(50)]
    assert all(w.shape == (9,) and np.ptp(w) < 2 and np.isfinite(w).all() for w in plain)
    assert any(np.isneginf(random_log_weights(seed, all_zero=True)).all() for seed in range(60))


@FEW
@given(log_weights())
def test_weights_are_normalised_and_resampled(log_w: np.ndarray) -> None:
    weights = normalised(log_w)
    np.testing.assert_allclose(weights, np.exp(log_w - log_sum_exp(log_w)), atol=1e-12)
    assert 1 - 1e-9 <= weight_ess(log_w) <= len(log_w) + 1e-9
    for name, scheme in SCHEMES.items():
        for draws in (1, 7):
            indices = scheme(weights, draws, np.random.default_rng(draws))
            assert indices.shape == (draws,) and (weights[indices] > 0).all(), name
            off = np.bincount(indices, minlength=len(weights)) - draws * weights
            assert (
                name in ("multinomial", "stratified", "residual") or (np.abs(off) < 1 + 1e-9).all()
            )


# ---- evidence, refusals -------------------------------------------------------------------------


def test_evidence_is_that_of_the_net() -> None:
    net = random_net(13, nodes=(2, 2), states=2)
    assert smallest(evidence_for(net), lambda e: len(e) == 2).keys() == {"v0", "v1"}


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda: bayes_nets(nodes=3), ValueError, r"bayes_nets: nodes=3: give \(fewest, most\)"),
        (lambda: bayes_nets(nodez=3), TypeError, r"bayes_nets\(nodez=...\): no such option; it takes"),
        (lambda: bayes_nets(states=(3, 9)), ValueError, "states=.*give 2 to 5"),
        (lambda: bayes_nets(states=(4, 3)), ValueError, "fewest <= most"),
        (lambda: bayes_nets(parents=-1), ValueError, "parents=-1"),
        (lambda: bayes_nets(coupling=-1.0), ValueError, "coupling=-1.0: give a factor"),
        (lambda: bayes_nets(coupling=np.nan), ValueError, "coupling=nan"),
        (lambda: bayes_nets(coupling="a"), TypeError, "coupling='a'.: give a number"),
        (lambda: bayes_nets(plates=2), TypeError, "plates=2.: give True or False"),
        (lambda: log_weights(huge=3), TypeError, "huge=3.: give True or False"),
        (lambda: bayes_nets(continuous=True, hybrid=True), ValueError, "give one"),
        (lambda: bayes_nets(continuous=True, nodes=(4, 4)), ValueError, r"32\*\*4 = 1048576; allow"),
        (lambda: dbns(steps=(0, 2)), ValueError, "dbns: steps="),
        (lambda: dbns(plates=True), TypeError, "it takes nodes, steps, zeros"),
        (lambda: factor_graphs(states=1), ValueError, "factor_graphs: states=1"),
        (lambda: factor_graphs(variables=(4, 4), configurations=8), ValueError, "at least 16"),
        (lambda: distributions(kind="integer"), ValueError, "kind='integer': give one of"),
        (lambda: distributions(event_ndim=3), ValueError, "event_ndim=3"),
        (lambda: distributions(families=("Gauss",)), ValueError, "'Gauss' is none of Normal"),
        (lambda: distributions(families="Normal"), ValueError, "give a tuple of names"),
        (lambda: distributions(kind="discrete", event_ndim=2), ValueError, "no family is all of"),
        (lambda: log_weights(size=0), ValueError, "log_weights: size"),
        (lambda: log_weights(zeros=False, all_zero=True), ValueError, "needs zeros=True"),
        (lambda: evidence_for(bmc.Normal(0.0, 1.0)), TypeError, "give a BayesNet, not Normal"),
        (lambda: evidence_for(random_net(1), 40), ValueError, "chance=40"),
        (lambda: evidence_for(random_net(1), "a"), ValueError, "chance='a'"),  # type: ignore[arg-type]
    ],
)  # fmt: skip
def test_wrong_options_are_told(ask: Callable[[], Any], error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        ask()


def test_without_hypothesis_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hypothesis", None)
    for strategy in (bayes_nets, dbns, distributions, factor_graphs, log_weights):
        with pytest.raises(MissingExtraError, match=r"bayesmc\[test\]"):
            strategy()
