"""Holds ``DiscreteFilter`` to enumeration and to the unrolled net, and to what it promises of hard data."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import scipy.special

import bayesmc as bmc
from bayesmc.engines.discrete import chain as discrete_chain
from bayesmc.engines.discrete import run as discrete_run
from bayesmc.engines.discrete.filter import DiscreteFilter
from bayesmc.errors import (
    ParameterError,
    QueryError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.results import SeriesPosterior
from bayesmc.testing import enumerate_posterior, session
from bayesmc.testing.makers.templates import RandomDbn, random_dbn

ENGINE = DiscreteFilter()
SEEDS = range(session.scaled(28, times=5))
#: rounding in two different orders of summation
TOLERANCE = 1e-10


case_of = functools.cache(random_dbn)


def exact_by_row(case: RandomDbn) -> list[Any]:
    """The unrolled net's posterior given rows 0 to t, for every t."""
    net = case.dbn.unroll(case.steps, case.inputs)
    evidence = case.dbn.unrolled_evidence(case.observations)
    return [
        bmc.infer(net, {k: v for k, v in evidence.items() if row_of(k) <= t}, engine=bmc.Exact())
        for t in range(case.steps)
    ]


def row_of(name: str) -> int:
    return int(name.split("[")[1][:-1])


def largest_difference(found: SeriesPosterior, wanted: Any) -> float:
    """Of probabilities, means and variances; ``wanted(t)`` is the exact posterior of slice t."""
    worst = 0.0
    for name in found.names:
        for k in range(found.steps):
            t = found.start + k
            exact, own = wanted(t), f"{name}[{t}]"
            if found.model[name].domain is not None:
                pairs = [(found.probabilities(name)[k], exact.probabilities(own))]
            else:
                pairs = [
                    (found.mean(name)[k], exact.mean(own)),
                    (found.var(name)[k], exact.var(own)),
                ]
            for a, b in pairs:
                assert a.shape == np.shape(b)
                worst = max(worst, float(np.abs(a - b).max(initial=0.0)))
    return worst


def nodes_of(dbn: bmc.DynamicBayesNet) -> set[str]:
    return {n for n in dbn if n not in dbn.inputs}


# ---- random templates ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_random_template_equals_the_unrolled_net(seed: int) -> None:
    case = case_of(seed)
    exact = exact_by_row(case)
    last = case.steps - 1
    ask: dict[str, Any] = {"inputs": case.inputs, "engine": ENGINE}
    found = bmc.filter(case.dbn, case.observations, **ask)
    assert set(found.names) == nodes_of(case.dbn)
    assert largest_difference(found, lambda t: exact[t]) < TOLERANCE
    increments = found.log_marginal_increments.reshape(case.steps, -1).sum(axis=1)
    wanted = np.array([p.log_marginal_likelihood for p in exact])
    np.testing.assert_allclose(np.cumsum(increments), wanted, rtol=0, atol=TOLERANCE)
    smoothed = bmc.smooth(case.dbn, case.observations, **ask)
    assert set(smoothed.names) == nodes_of(case.dbn)
    assert largest_difference(smoothed, lambda t: exact[last]) < TOLERANCE
    lag = seed % 3
    lagged = bmc.smooth(case.dbn, case.observations, lag=lag, **ask)
    assert largest_difference(lagged, lambda t: exact[min(t + lag, last)]) < TOLERANCE
    if case.steps > 2:
        past = {n: v[: last - 1] for n, v in case.observations.items()}
        ahead = bmc.forecast(case.dbn, past, steps=2, **ask)
        assert (ahead.start, ahead.steps, ahead.kind) == (last - 1, 2, "forecast")
        recalls = {"y"} if "y_prev" in case.story else set()  # its own forecast needs integrals
        assert set(ahead.names) >= nodes_of(case.dbn) - recalls
        assert largest_difference(ahead, lambda t: exact[last - 2]) < TOLERANCE


def test_random_templates_are_varied() -> None:
    """The generator reaches what it claims to reach, so that the tests above do test it."""
    stories = " | ".join(case_of(seed).story for seed in SEEDS)
    for what in ("[k]", "computed", "softmax", "table", "leaf", ", t", "y_prev", "z_prev", "u"):
        assert what in stories, what
    cases = [case_of(seed) for seed in SEEDS]
    masked = [any(np.ma.is_masked(v) for v in c.observations.values()) for c in cases]
    assert sum(masked) > 8


@pytest.mark.parametrize("seed", range(1000, 1000 + session.scaled(14, times=5)))
def test_smoothing_and_the_most_likely_path_equal_enumeration(seed: int) -> None:
    case = random_dbn(seed, nodes=(1, 2), steps=(1, 3))
    net = case.dbn.unroll(case.steps, case.inputs)
    seen = {  # continuous rows in full, since enumeration can only approximate missing ones
        n: v if case.dbn[n].states else np.ma.getdata(v) for n, v in case.observations.items()
    }
    brute = enumerate_posterior(net, case.dbn.unrolled_evidence(seen))
    ask: dict[str, Any] = {"inputs": case.inputs, "engine": ENGINE}
    smoothed = bmc.smooth(case.dbn, seen, **ask)
    for name in smoothed.names:
        for t in range(case.steps):
            if smoothed.model[name].domain is not None:
                wanted = brute.probabilities(f"{name}[{t}]")
                got = smoothed.probabilities(name)[t]
            else:
                wanted, got = brute.mean(f"{name}[{t}]"), smoothed.mean(name)[t]
            np.testing.assert_allclose(got, wanted, rtol=0, atol=TOLERANCE)
    path = bmc.most_likely(case.dbn, seen, **ask)
    chosen = np.ones(len(brute.weights), dtype=bool)
    for name, rows in path.items():
        for t in range(case.steps):
            every = brute.values(f"{name}[{t}]")
            same = np.asarray(every == rows[t])
            chosen &= same.reshape(len(same), -1).all(axis=1)
    assert chosen.sum() == 1
    assert brute.weights[chosen][0] >= brute.weights.max() * (1 - 1e-9)


def test_a_transposed_transition_is_found() -> None:
    """Negative control: the comparison sees a wrong model."""
    right, wrong = bmc.DynamicBayesNet(), bmc.DynamicBayesNet()
    table = np.array([[0.8, 0.15, 0.05], [0.3, 0.6, 0.1], [0.1, 0.5, 0.4]])
    for dbn, probs in ((right, table), (wrong, table.T / table.T.sum(axis=1, keepdims=True))):
        dbn.table("x", ["x_prev"], probs, initial=[0.2, 0.5, 0.3])
        dbn.add("y", lambda x: bmc.Normal(1.0 * x, 1.0))
    seen = {"y": [0.3, 1.2, 0.4, 2.0]}
    exact = exact_by_row(RandomDbn(right, 4, seen, None, ""))
    for dbn, is_right in ((right, True), (wrong, False)):
        off = largest_difference(bmc.filter(dbn, seen, engine=ENGINE), lambda t: exact[t])
        assert off < TOLERANCE if is_right else off > 1e-3


# ---- hard data ----------------------------------------------------------------------------------


def by_logs(log_start: Any, log_step: Any, log_rows: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """Filtering and smoothing by the textbook's sums, in logs throughout."""
    ahead = [log_start + log_rows[0]]
    for row in log_rows[1:]:
        ahead.append(scipy.special.logsumexp(ahead[-1][:, None] + log_step, axis=0) + row)
    back = [np.zeros(len(log_start))]
    for row in log_rows[:0:-1]:
        back.append(scipy.special.logsumexp(log_step + row + back[-1], axis=1))
    alpha, gamma = np.array(ahead), np.array(ahead) + np.array(back[::-1])
    return (
        np.exp(alpha - scipy.special.logsumexp(alpha, axis=1, keepdims=True)),
        np.exp(gamma - scipy.special.logsumexp(gamma, axis=1, keepdims=True)),
        float(scipy.special.logsumexp(alpha[-1])),
    )


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")
@pytest.mark.parametrize(
    ("table", "scale", "steps"),
    [
        ([[0.9, 0.1, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 1.0]], 0.01, 60),  # left to right
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], 0.01, 40),  # states never change
        ([[0.8, 0.1, 0.1], [0.2, 0.7, 0.1], [0.1, 0.1, 0.8]], 0.003, 60),  # rows of density e^-1e5
        ([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], 0.05, 30),  # a cycle
        ([[0.8, 0.1, 0.1], [0.2, 0.7, 0.1], [0.1, 0.1, 0.8]], 1.0, 400),
    ],
)
def test_densities_of_any_size_are_summed_right(table: Any, scale: float, steps: int) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], table, initial=[0.5, 0.3, 0.2])
    dbn.add("y", lambda x: bmc.Normal(1.0 * x, scale))
    y = np.random.default_rng(0).normal(1.0, 1.0, steps)
    y[: steps // 2] -= 0.7  # first one state is far likelier, then another
    with np.errstate(divide="ignore"):
        step = np.log(np.asarray(table))
    rows = np.stack([bmc.Normal(float(k), scale).log_prob(y) for k in range(3)], axis=1)
    filtered, smoothed, total = by_logs(np.log([0.5, 0.3, 0.2]), step, rows)
    found = bmc.filter(dbn, {"y": y}, engine=ENGINE)
    assert found.log_marginal_likelihood == pytest.approx(total, rel=1e-11)
    np.testing.assert_allclose(found.probabilities("x"), filtered, rtol=0, atol=1e-10)
    found = bmc.smooth(dbn, {"y": y}, engine=ENGINE)
    np.testing.assert_allclose(found.probabilities("x"), smoothed, rtol=0, atol=1e-10)
    found = bmc.smooth(dbn, {"y": y}, lag=steps, engine=ENGINE)
    np.testing.assert_allclose(found.probabilities("x"), smoothed, rtol=0, atol=1e-10)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")
def test_without_the_second_pass_lost_states_stay_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control of the test above: scaled sums alone forget a state that later rows call for."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], np.eye(2), initial=[0.5, 0.5])
    dbn.add("y", lambda x: bmc.Normal(1.0 * x, 0.01))
    y = [0.46, 0.46, 0.54, 0.54, 0.54]  # each row makes a state e^400 times likelier
    right = bmc.filter(dbn, {"y": y}, engine=ENGINE).probabilities("x")
    np.testing.assert_allclose(right[[1, 4], 1], [0.0, 1.0], atol=1e-12)
    monkeypatch.setattr(discrete_chain, "_lost", lambda *_: False)
    wrong = bmc.filter(dbn, {"y": y}, engine=ENGINE).probabilities("x")
    assert wrong[4, 1] < 0.5


def test_what_is_impossible_is_named() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.5, 0.5], [0.0, 1.0]], initial=[1.0, 0.0])
    dbn.table("y", ["x"], [[0.9, 0.1], [0.0, 1.0]])
    dbn.add("z", lambda x: bmc.Normal(1.0 * x, 1.0))
    with pytest.raises(ZeroProbabilityError, match="slice 2.*'y'"):
        bmc.filter(dbn, {"y": [0, 1, 0], "x": np.ma.masked_equal([9, 1, 9], 9)}, engine=ENGINE)
    with pytest.raises(ZeroProbabilityError, match="slice 2.*'x'"):
        seen = {"x": np.ma.masked_equal([9, 1, 0], 9), "z": [0.1, 0.2, 0.3]}
        bmc.most_likely(dbn, seen, engine=ENGINE)


def test_bad_parameters_count_only_where_they_are_possible() -> None:
    def declared(last: float) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet()
        steps = [[0.5, 0.5, 0.0], [0.5, 0.5 - last, last], [0.0, 0.0, 1.0]]
        dbn.table("x", ["x_prev"], steps, initial=[1.0, 0.0, 0.0])
        dbn.add("y", lambda x: bmc.Normal(1.0 * x, 1.5 - x))
        return dbn

    y = [0.1, 0.4, 0.3]
    found = bmc.filter(declared(0.0), {"y": y}, engine=ENGINE)
    assert found.probabilities("x")[:, 2].tolist() == [0.0, 0.0, 0.0]
    for ask in (bmc.filter, bmc.smooth, bmc.most_likely):
        with pytest.raises(ParameterError, match="'y'.*slice 2"):
            ask(declared(0.2), {"y": y}, engine=ENGINE)


def test_the_path_keeps_to_what_is_possible_and_breaks_ties_alike() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.0, 1.0], [1.0, 0.0]], initial=[0.5, 0.5])
    dbn.table("y", ["x"], [[0.5, 0.5], [0.5, 0.5]])
    path = bmc.most_likely(dbn, {"y": [0, 0, 1, 1]}, engine=ENGINE)["x"]
    assert path.tolist() in ([0, 1, 0, 1], [1, 0, 1, 0])
    again = bmc.most_likely(dbn, {"y": [0, 0, 1, 1]}, engine=ENGINE)["x"]
    assert path.tolist() == again.tolist()
    dbn.table("z", ["x"], [[0.9, 0.1], [0.2, 0.8]])
    best = bmc.most_likely(dbn, {"y": [0, 0, 1, 1]}, engine=ENGINE)
    assert (best["z"] == best["x"]).all()  # what nobody saw of a leaf is part of the path
    assert best["x"].tolist() == [0, 1, 0, 1]


def test_stretches_of_time_join_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long series are worked through in stretches; here they are three rows long, or one."""
    for seed in range(6):
        case = random_dbn(seed, nodes=(2, 3), steps=(6, 8))
        ask: dict[str, Any] = {"inputs": case.inputs, "engine": ENGINE}
        state = case.dbn["x0"].states[-1]
        ask["queries"] = {"q": lambda x0, state=state: 1.0 * np.asarray(x0 == state)}
        whole = [bmc.smooth(case.dbn, case.observations, lag=lag, **ask) for lag in (None, 0, 2)]
        queries = ask.pop("queries", None)
        path = bmc.most_likely(case.dbn, case.observations, **ask)
        with monkeypatch.context() as patch:
            patch.setattr(discrete_run, "STRETCH_ENTRIES", 60 if seed % 2 else 1)
            for lag, wanted in zip((None, 0, 2), whole, strict=True):
                found = bmc.smooth(case.dbn, case.observations, lag=lag, queries=queries, **ask)
                total = found.log_marginal_likelihood
                np.testing.assert_allclose(total, wanted.log_marginal_likelihood, rtol=1e-12)
                for name in wanted.names:
                    if wanted.model[name].domain is not None:
                        a, b = found.probabilities(name), wanted.probabilities(name)
                    else:
                        a, b = found.mean(name), wanted.mean(name)
                    np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
                for name, value in wanted.queries.items():
                    np.testing.assert_allclose(found.queries[name], value, rtol=0, atol=1e-11)
            again = bmc.most_likely(case.dbn, case.observations, **ask)
        for name, rows in path.items():
            assert (np.asarray(rows == again[name])).all()


# ---- plates, time, missing rows -----------------------------------------------------------------


def chains_of(count: int | None) -> bmc.DynamicBayesNet:
    plates = {"plates": "s"} if count else {}
    dbn = bmc.DynamicBayesNet(plates={"s": count} if count else None)
    dbn.table("x", ["x_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5], **plates)
    dbn.add("y", lambda x, y_prev: bmc.Normal(x + 0.5 * y_prev, 1.0),
            initial=lambda x: bmc.Normal(1.0 * x, 1.0), **plates)  # fmt: skip
    return dbn


def test_sequences_in_a_plate_are_filtered_apart_and_may_end_early() -> None:
    y = np.random.default_rng(1).normal(size=(7, 5))
    y[4:, 2] = np.nan  # this sequence is shorter than the others
    found = bmc.smooth(chains_of(5), {"y": y}, engine=ENGINE)
    assert found.log_marginal_increments.shape == (7, 5)
    path = bmc.most_likely(chains_of(5), {"y": y}, engine=ENGINE)["x"]
    for k in range(5):
        stop = 4 if k == 2 else 7
        alone = bmc.smooth(chains_of(None), {"y": y[:stop, k]}, engine=ENGINE)
        np.testing.assert_allclose(found.probabilities("x")[:stop, k], alone.probabilities("x"))
        total = found.log_marginal_likelihood[k]
        assert total == pytest.approx(alone.log_marginal_likelihood)
        own = bmc.most_likely(chains_of(None), {"y": y[:stop, k]}, engine=ENGINE)["x"]
        assert path[:stop, k].tolist() == own.tolist()


def test_plates_within_plates_apart() -> None:
    """Two plates apart, in either order, and one that some node reads across."""
    dbn = bmc.DynamicBayesNet(plates={"a": 2, "b": 3, "k": 2})
    rng = np.random.default_rng(7)
    lift = rng.normal(size=(3, 2))
    dbn.add(
        "z",
        lambda z_prev: bmc.Bernoulli(0.3 + 0.3 * z_prev),
        plates=("a", "b"),
        initial=bmc.Bernoulli(0.5),
    )
    dbn.add("x", lambda x_prev, z: bmc.Bernoulli(0.2 + 0.2 * z + 0.3 * x_prev), plates=("b", "k", "a"),
            initial=bmc.Bernoulli(0.4))  # fmt: skip
    dbn.add("y", lambda x: bmc.Normal(x.sum("k"), 1.0), plates=("b", "a"))
    dbn.add("w", lambda x: bmc.Normal(x + lift[:, :, None], 1.0), plates=("b", "k", "a"))
    dbn.add("v", lambda x_prev, z: bmc.Bernoulli(0.1 + 0.3 * z + 0.2 * x_prev.mean("k")),
            plates=("a", "b"), initial=bmc.Bernoulli(0.5))  # fmt: skip
    seen = {"y": rng.normal(size=(3, 3, 2)), "w": rng.normal(size=(3, 3, 2, 2))}
    seen["w"][1, 0, 1, 0] = np.nan
    exact = exact_by_row(RandomDbn(dbn, 3, seen, None, ""))
    found = bmc.filter(dbn, seen, engine=ENGINE)
    assert found.log_marginal_increments.shape in ((3, 2, 3), (3, 3, 2))
    assert largest_difference(found, lambda t: exact[t]) < TOLERANCE
    assert largest_difference(bmc.smooth(dbn, seen, engine=ENGINE), lambda t: exact[2]) < TOLERANCE
    path = bmc.most_likely(dbn, seen, engine=ENGINE)
    assert {n: v.shape[1:] for n, v in path.items()} == {"z": (2, 3), "x": (3, 2, 2), "v": (2, 3)}


def test_a_missing_number_that_counts_is_refused() -> None:
    y = [0.1, np.nan, 0.3]
    with pytest.raises(UnsupportedError, match="'y'.*missing in slice 1.*slice 2.*ParticleFilter"):
        bmc.filter(chains_of(None), {"y": y}, engine=ENGINE)
    assert "missing in slice 1" in str(ENGINE.unsupported(chains_of(None), {"y": y}))
    assert ENGINE.unsupported(chains_of(None), {"y": [0.1, 0.2, np.nan]}) is None


def test_functions_that_take_one_time_at_a_time_are_called_row_by_row() -> None:
    def declared(chance: Any) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet()
        dbn.input("u", event_shape=(2,))
        dbn.add("x", chance, initial=bmc.Bernoulli(0.5))
        dbn.add("y", lambda x: bmc.Normal(1.0 * x, 1.0))
        return dbn

    weights = np.array([[0.4, -0.2], [0.1, 0.3]])
    alone = declared(
        lambda x_prev, u: bmc.Bernoulli(0.3 + 0.3 * x_prev + 0.1 * np.tanh((weights @ u)[0]))
    )
    arrays = declared(
        lambda x_prev, u: bmc.Bernoulli(
            0.3 + 0.3 * x_prev + 0.1 * np.tanh(np.vecdot(weights[0], u))
        )
    )
    u, y = np.random.default_rng(3).normal(size=(9, 2)), np.linspace(-1, 2, 9)
    both = [bmc.smooth(d, {"y": y}, inputs={"u": u}, engine=ENGINE) for d in (alone, arrays)]
    np.testing.assert_allclose(*(b.probabilities("x") for b in both), rtol=1e-12)


def test_missing_counts_and_angles_are_forecast() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("n", lambda x: bmc.Poisson(1.0 + 4.0 * x))
    dbn.add("a", lambda x: bmc.VonMises(3.0 - 6.0 * x, 2.0))
    dbn.add("m", lambda x: bmc.MvNormal(np.stack([1.0 * x, -2.0 * x], axis=-1), np.eye(2)))
    seen = {"n": [2, 5], "a": [3.0, -3.1], "m": [[0.0, 0.1], [1.0, -2.0]]}
    found = bmc.forecast(dbn, seen, steps=1, engine=ENGINE)
    p = found.probabilities("x")[0, 1]
    assert found.mean("n")[0] == pytest.approx(1 + 4 * p)
    assert found.var("n")[0] == pytest.approx(1 + 4 * p + 16 * p * (1 - p))
    turn = (1 - p) * np.exp(3j) + p * np.exp(-3j)
    assert found.mean("a")[0] == pytest.approx(np.angle(turn))
    np.testing.assert_allclose(found.mean("m")[0], [p, -2 * p])


def test_a_counter_is_part_of_the_state() -> None:
    """A deterministic node that reads itself: how many heads so far, up to three."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("coin", bmc.Bernoulli(0.4))
    dbn.add("count", lambda count_prev, coin: np.minimum(count_prev + coin, 3), states=[0, 1, 2, 3],
            initial=lambda coin: coin)  # fmt: skip
    dbn.add("y", lambda count: bmc.Normal(1.0 * count, 1.0))
    seen = {"y": [0.1, 1.4, 1.2, 2.9]}
    exact = exact_by_row(RandomDbn(dbn, 4, seen, None, ""))
    assert largest_difference(bmc.filter(dbn, seen, engine=ENGINE), lambda t: exact[t]) < TOLERANCE
    path = bmc.most_likely(dbn, seen, engine=ENGINE)
    assert (np.cumsum(path["coin"]) == path["count"]).all()


def test_static_nodes_are_given() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("s", bmc.Bernoulli(0.5))
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Bernoulli(0.2 + 0.4 * s + 0.2 * x_prev),
        initial=bmc.Bernoulli(0.3),
    )
    dbn.add("y", lambda x: bmc.Normal(1.0 * x, 1.0))
    seen = {"y": [0.3, 0.9, 1.3], "s": 1}
    exact = bmc.infer(dbn.unroll(3), dbn.unrolled_evidence(seen), engine=bmc.Exact())
    found = bmc.smooth(dbn, seen, engine=ENGINE)
    np.testing.assert_allclose(found.probabilities("x")[1], exact.probabilities("x[1]"))
    with pytest.raises(UnsupportedError, match="'s' is not observed"):
        bmc.filter(dbn, {"y": [0.3]}, engine=ENGINE)


# ---- questions ----------------------------------------------------------------------------------


def test_queries_and_pairs_equal_enumeration() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.table(
        "w",
        ["w_prev", "x"],
        [[[0.2, 0.8], [0.6, 0.4]], [[0.5, 0.5], [0.1, 0.9]]],
        initial=[0.4, 0.6],
    )
    dbn.add("m", lambda x, w_prev: 2.0 * x + w_prev, initial=lambda x: 2.0 * x)
    dbn.table("y", ["w"], [[0.8, 0.2], [0.3, 0.7]])
    seen = {"y": np.ma.masked_equal([0, 1, 9, 1], 9)}
    queries = {
        "both": lambda x, w: x * w,
        "leaf": lambda y, x: (y == x) * 1.0,
        "m": lambda m, x: m * x,
    }
    found = bmc.smooth(dbn, seen, engine=ENGINE, queries=queries)
    brute = enumerate_posterior(dbn.unroll(4), dbn.unrolled_evidence(seen))
    for t in range(4):
        for name, function in queries.items():
            own = [f"{n}[{t}]" for n in function.__code__.co_varnames]
            assert found.queries[name][t] == pytest.approx(brute.expectation(function, *own))
    pairs = found.pairs("x")
    assert pairs.shape == (3, 2, 2)
    for t in range(1, 4):
        np.testing.assert_allclose(pairs[t - 1], brute.probabilities(f"x[{t - 1}]", f"x[{t}]"))
    with pytest.raises(QueryError, match="'y'"):
        found.pairs("y")
    with pytest.raises(UnknownNodeError, match="'q'"):
        bmc.filter(dbn, seen, engine=ENGINE, queries={"q": lambda q: q})


def row_at(rows: Any, t: int) -> Any:
    """One row with None or NaN where it is masked; None where all of it is."""
    value, mask = np.ma.getdata(rows)[t], np.ma.getmaskarray(rows)[t]
    if mask.all():
        return None
    blank = None if value.dtype.kind == "U" else np.nan
    return np.where(mask, blank, value) if mask.any() else value


def test_steps_one_by_one_equal_the_run_over_the_series() -> None:
    for seed in range(8):
        case = random_dbn(seed, steps=(3, 5))
        whole = bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=ENGINE)
        belief = ENGINE.start(case.dbn, rng=0)
        assert belief.t == -1
        for t in range(case.steps):
            row = {n: row_at(v, t) for n, v in case.observations.items()}
            now = {"u": case.inputs["u"][t]} if case.inputs else None
            belief = ENGINE.step(belief, row, inputs=now)
            for name in whole.names:
                if whole.model[name].domain is not None:
                    wanted = whole.probabilities(name)[t]
                    np.testing.assert_allclose(
                        belief.probabilities(name), wanted, rtol=0, atol=1e-10
                    )
                else:
                    wanted = whole.mean(name)[t]
                    np.testing.assert_allclose(belief.mean(name), wanted, rtol=0, atol=1e-10)
                    np.testing.assert_allclose(belief.std(name), whole.std(name)[t], atol=1e-7)
        np.testing.assert_allclose(belief.log_marginal_likelihood, whole.log_marginal_likelihood)
        assert belief.state.series.steps <= 3  # what a belief holds does not grow


def test_what_is_seen_may_differ_from_step_to_step() -> None:
    """A node inside a slice, above the state, is seen in one row and not in the next, and back."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", probs=[0.3, 0.7])
    dbn.table("x", ["z", "x_prev"], [[[0.9, 0.1], [0.6, 0.4]], [[0.5, 0.5], [0.2, 0.8]]],
              initial=[0.5, 0.5])  # fmt: skip
    dbn.table("y", ["x"], [[0.8, 0.2], [0.3, 0.7]])
    z = np.ma.masked_equal([9, 9, 0, 9, 1, 9, 0], 9)
    y = [0, 1, 1, 0, 1, 0, 0]
    whole = bmc.filter(dbn, {"z": z, "y": y}, engine=ENGINE).probabilities("x")
    belief = ENGINE.start(dbn)
    for t, row in enumerate(whole):
        belief = ENGINE.step(belief, {"y": y[t], "z": row_at(z, t)})
        np.testing.assert_allclose(belief.probabilities("x"), row, rtol=0, atol=1e-12)


def test_a_belief_that_has_absorbed_nothing_says_so() -> None:
    with pytest.raises(QueryError, match="absorbed nothing"):
        ENGINE.start(chains_of(None)).probabilities("x")


# ---- refusals -----------------------------------------------------------------------------------


def test_refusals_name_the_figure_and_another_engine() -> None:
    dbn = bmc.DynamicBayesNet(plates={"k": 20})
    dbn.add("z", bmc.Bernoulli(0.5))
    dbn.add("x", lambda x_prev, z: bmc.Bernoulli(0.2 + 0.2 * z + 0.5 * x_prev), plates="k",
            initial=bmc.Bernoulli(0.5))  # fmt: skip
    dbn.add("y", lambda x: bmc.Normal(x.sum("k"), 1.0))
    with pytest.raises(UnsupportedError, match="1.05e\\+06 values.*ParticleFilter"):
        bmc.filter(dbn, {"y": [3.0, 4.0]}, engine=ENGINE)
    dbn = chains_of(None)
    small = DiscreteFilter(max_bytes=100.0)
    with pytest.raises(UnsupportedError, match="bytes.*ParticleFilter"):
        bmc.filter(dbn, {"y": [0.3, 0.1]}, engine=small)
    dbn.add("v", lambda v_prev: bmc.Normal(v_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("w", lambda v: bmc.Normal(v, 1.0))
    with pytest.raises(UnsupportedError, match="'v' has no finite set of states"):
        bmc.filter(dbn, {"y": [0.3, 0.1], "w": [0.1, 0.2]}, engine=ENGINE)


def test_a_computed_node_two_slices_back_is_refused_with_the_fix() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("m", lambda m_prev, x: 0.5 * m_prev + x, initial=lambda x: 1.0 * x)
    dbn.add("y", lambda m: bmc.Normal(m, 1.0))
    with pytest.raises(UnsupportedError, match="states=.*ParticleFilter"):
        bmc.filter(dbn, {"y": [0.3, 0.1, 0.2]}, engine=ENGINE)


@pytest.mark.parametrize("options", [{"max_states": 0}, {"max_states": 1.5}, {"max_bytes": 0.0}])
def test_options_out_of_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        DiscreteFilter(**options)


def test_chains_that_never_meet_are_not_multiplied() -> None:
    """Forty binary chains, each with its own observed node: 2**40 states if they were one."""
    dbn = bmc.DynamicBayesNet()
    for k in range(40):
        dbn.table(f"x{k}", [f"x{k}_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    for k in range(40):
        dbn.add(f"y{k}", lambda x: bmc.Normal(1.0 * x, 1.0), parents=[f"x{k}"])
    y = np.random.default_rng(5).normal(size=(4, 40))
    found = bmc.filter(dbn, {f"y{k}": y[:, k] for k in range(40)}, engine=ENGINE)
    one = bmc.DynamicBayesNet()
    one.table("x", ["x_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    one.add("y", lambda x: bmc.Normal(1.0 * x, 1.0))
    each = [bmc.filter(one, {"y": y[:, k]}, engine=ENGINE) for k in (0, 17, 39)]
    for k, alone in zip((0, 17, 39), each, strict=True):
        np.testing.assert_allclose(found.probabilities(f"x{k}"), alone.probabilities("x"))


def test_describe_says_what_happens_to_each_node() -> None:
    dbn = chains_of(None)
    problem = bmc.explain(dbn, {"y": [0.1, 0.2]}, engine=ENGINE)
    assert "state with 2 values" in str(problem)
    assert "likelihood" in str(problem)


def test_the_most_likely_path_of_a_long_series() -> None:
    # NumPy unravels (n, 1) indices wrongly beyond 8,192 rows; the path is checked against plain Viterbi
    rows = np.array([[0.9, 0.08, 0.02], [0.05, 0.9, 0.05], [0.02, 0.08, 0.9]])
    dbn = bmc.DynamicBayesNet()
    dbn.table("w", ["w_prev"], rows, initial=[1 / 3] * 3)
    dbn.add("y", lambda w: bmc.Normal(1.0 * w, 1.0))
    y = dbn.sample(9000, rng=0)["y"][0]
    log, best = -0.5 * (y[0] - np.arange(3)) ** 2, []
    for seen in y[1:]:
        reached = log[:, None] + np.log(rows)
        best.append(reached.argmax(axis=0))
        log = reached.max(axis=0) - 0.5 * (seen - np.arange(3)) ** 2
    path = [int(log.argmax())]
    for chosen in reversed(best):
        path.append(int(chosen[path[-1]]))
    np.testing.assert_array_equal(bmc.most_likely(dbn, {"y": y})["w"], path[::-1])
