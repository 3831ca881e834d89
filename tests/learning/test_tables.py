"""Tables by expectation-maximisation: against brute force, closed forms, and climbing the same likelihood."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy import optimize

import bayesmc as bmc
from bayesmc.errors import (
    ConvergenceWarning,
    EvidenceError,
    ModelError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.learning.cases import Cases
from bayesmc.learning.expectation_maximisation import maximised


def sprinkler() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.table("cloudy", [], [0.4, 0.6], ("no", "yes"))
    net.table("rain", ["cloudy"], [[0.8, 0.2], [0.3, 0.7]])
    net.table("sprinkler", ["cloudy"], [[0.5, 0.3, 0.2], [0.8, 0.1, 0.1]])
    wet = [[[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]], [[0.3, 0.7], [0.2, 0.8], [0.1, 0.9]]]
    net.table("wet", ["rain", "sprinkler"], wet)
    return net


def cases(count: int, missing: float, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    drawn = sprinkler().sample(count, rng=seed)
    found = {}
    for name, values in drawn.items():
        column = np.array(values.tolist(), dtype=object)
        column[rng.random(count) < missing] = None
        found[name] = column
    return found


def test_expected_counts_are_those_of_brute_force() -> None:
    """Both ways of summing, by components and all at once, over every joint state."""
    rng = np.random.default_rng(0)
    names, cards = ("a", "b", "c", "d", "e"), (2, 3, 2, 2, 3)
    parents = {"a": (), "b": ("a",), "c": ("a",), "d": ("c", "b"), "e": ("d",)}
    shape = {
        n: [*(cards[names.index(p)] for p in parents[n]), cards[names.index(n)]] for n in names
    }
    tables = {
        n: rng.dirichlet(np.ones(shape[n][-1]), shape[n][:-1]).reshape(shape[n]) for n in names
    }
    states = np.array(list(product(*(range(c) for c in cards))))
    codes = states[rng.integers(0, len(states), 40)].copy()
    codes[rng.random(codes.shape) < 0.4] = -1
    log, wanted = 0.0, {n: np.zeros(shape[n]) for n in names}
    at = {n: [names.index(p) for p in (*parents[n], n)] for n in names}
    joint = np.prod([tables[n][tuple(states[:, k] for k in at[n])] for n in names], axis=0)
    for row in codes:
        fits = ((states == row) | (row < 0)).all(axis=1)
        mass = joint * fits
        log += np.log(mass.sum())
        for n in names:
            np.add.at(wanted[n], tuple(states[:, k] for k in at[n]), mass / mass.sum())
    together = Cases(names, cards, parents, codes)
    apart = Cases(names, cards, parents, codes)
    apart.components = tuple(apart._components())
    apart.shown = {f.name: apart._shown(f, None) for f in apart.families}
    assert len(together.components) == 1 < len(apart.components)
    for read in (together, apart):
        total, counts = read.expected(tables)
        assert total == pytest.approx(log)
        for n in names:
            np.testing.assert_allclose(counts[n], wanted[n], atol=1e-10)


def test_complete_cases_are_counted() -> None:
    data = cases(400, 0.0)
    found = bmc.fit(sprinkler(), data, counts={"rain": 1.0})
    rain, cloudy = (np.asarray(data[n]) for n in ("rain", "cloudy"))
    seen = np.array([[((cloudy == c) & (rain == r)).sum() for r in (0, 1)] for c in ("no", "yes")])
    wanted = (seen + 1) / (seen + 1).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(found["rain"], wanted)
    share = (cloudy == "yes").mean()
    np.testing.assert_allclose(found["cloudy"], [1 - share, share])
    error = np.sqrt(share * (1 - share) / 400)
    assert found.std_errors["cloudy"][1] == pytest.approx(error, rel=1e-4)
    np.testing.assert_allclose(bmc.infer(found.net).probabilities("cloudy"), found["cloudy"])


def test_em_rises_to_where_no_table_is_better() -> None:
    data = cases(300, 0.25)
    found = bmc.fit(sprinkler(), data, tolerance=1e-8)
    assert found.converged and (np.diff(found.history) > -1e-9).all()
    rng = np.random.default_rng(1)
    for _ in range(5):  # tables nearby are no better
        start = {}
        for name, table in found.values.items():
            other = table * np.exp(0.03 * rng.normal(size=table.shape))
            start[name] = other / other.sum(axis=-1, keepdims=True)
        with pytest.warns(ConvergenceWarning):
            near = bmc.fit(sprinkler(), data, start=start, max_iterations=1, tolerance=0.0)
        assert near.history[0] < found.log_likelihood + 1e-9
    errors = found.std_errors["cloudy"]
    few = np.sqrt(found["cloudy"].prod() / 300)  # if nothing were missing
    assert few < errors[0] < 1.5 * few


def test_frames_speak_names_and_states() -> None:
    pandas = pytest.importorskip("pandas")
    data = cases(200, 0.2)
    frame = pandas.DataFrame(data)
    frame["cloudy"] = pandas.Categorical(frame["cloudy"], ["yes", "no"])  # another order
    frame["rain"] = pandas.array(data["rain"], dtype="Int64")
    one, other = bmc.fit(sprinkler(), frame), bmc.fit(sprinkler(), data)
    for name in one.values:
        np.testing.assert_allclose(one[name], other[name])


def umbrella() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.7, 0.3], [0.4, 0.6]], ("dry", "wet"), initial=[0.5, 0.5])
    dbn.table("o", ["s"], [[0.6, 0.3, 0.1], [0.1, 0.3, 0.6]])
    return dbn


@pytest.mark.thorough
def test_hidden_markov_tables_are_where_climbing_ends() -> None:
    truth = bmc.DynamicBayesNet()
    truth.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], ("dry", "wet"), initial=[0.5, 0.5])
    truth.table("o", ["s"], [[0.8, 0.15, 0.05], [0.05, 0.15, 0.8]])
    rows = truth.sample(150, rng=3)["o"][0]
    found = bmc.fit(umbrella(), {"o": rows}, learn=["s", "o"], tolerance=1e-8)
    assert found.converged and (np.diff(found.history) > -1e-9).all()
    nodes = bmc.DynamicBayesNet(plates={"k": 2})
    nodes.add_static("A", bmc.Dirichlet([1.0, 1.0]), plates="k")
    nodes.add_static("B", bmc.Dirichlet([1.0, 1.0, 1.0]), plates="k")
    start = found["s initial"]
    nodes.add("s", lambda s_prev, A: bmc.Categorical(A[s_prev]), initial=bmc.Categorical(start))
    nodes.add("o", lambda s, B: bmc.Categorical(B[s]))
    begin = {"A": [[0.85, 0.15], [0.25, 0.75]], "B": [[0.75, 0.2, 0.05], [0.1, 0.2, 0.7]]}
    climbed = bmc.fit(nodes, {"o": rows}, start=begin)
    assert climbed.log_likelihood == pytest.approx(found.log_likelihood, abs=1e-5)
    np.testing.assert_allclose(found["s"], climbed["A"], atol=1e-3)
    np.testing.assert_allclose(found.std_errors["s"], climbed.std_errors["A"], rtol=0.05)


def test_hidden_markov_tables_rise_and_come_back_in_the_template() -> None:
    rows = umbrella().sample(40, rng=3)["o"][0]
    with pytest.warns(ConvergenceWarning, match="max_iterations"):
        found = bmc.fit(umbrella(), {"o": rows}, max_iterations=5)
    assert (np.diff(found.history) > 0).all() and set(found.values) == {"s", "s initial", "o"}
    again = bmc.filter(found.net, {"o": rows}).log_marginal_likelihood
    assert again == pytest.approx(found.log_likelihood)


@pytest.mark.thorough
def test_families_over_two_slices_are_counted_at_once() -> None:
    """A table that reads another node's past: from the exact posterior of all slices."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("a", ["a_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.table(
        "b",
        ["a_prev", "a"],
        [[[0.9, 0.1], [0.5, 0.5]], [[0.4, 0.6], [0.1, 0.9]]],
        initial=[0.5, 0.5],
    )
    rows = dbn.sample(25, rng=1)["b"][0]
    found = bmc.fit(dbn, {"b": rows}, learn=["b"], max_iterations=60, tolerance=1e-4)
    assert (np.diff(found.history) > -1e-9).all() and found.history[-1] > found.history[0] + 0.5


def test_what_does_not_fit_is_refused_in_words() -> None:
    data = cases(20, 0.0)
    zero = {"cloudy": [0.0, 1.0]}
    plated = bmc.BayesNet(plates={"p": 3})
    plated.table("c", [], [0.5, 0.5])
    plated.add("x", lambda c: bmc.Bernoulli(0.3 + 0.4 * c), plates="p")
    for options, error, says in (
        ({"data": {**data, "wet": [3] * 20}}, EvidenceError, "no state.*0, 1"),
        ({"data": {**data, "wet": [1]}}, EvidenceError, "different lengths"),
        ({"data": {**data, "weet": [1] * 20}}, EvidenceError, "did you mean 'wet'"),
        ({"data": {}}, EvidenceError, "no data"),
        ({"data": 3}, EvidenceError, "data frame"),
        ({"start": {"rain": [0.5, 0.5]}}, ModelError, r"shape \(2,\); .*shape \(2, 2\)"),
        ({"start": {"cloudy": [0.5, 0.6]}}, ModelError, "no table of probabilities.*sum to 1"),
        ({"start": {"cloudy": {"no": 0.5, "yes": 0.5}}}, ModelError, "no array of numbers"),
        ({"start": [0.5, 0.5]}, ModelError, "start= is a list; give a dict"),
        ({"max_iterations": 0}, ModelError, "max_iterations is 0; give 1 or more"),
        ({"start": zero}, ZeroProbabilityError, "start="),
        ({"counts": -1.0}, ModelError, "negative"),
        ({"counts": {"x": 1.0}}, ModelError, "not learned"),
    ):
        given: Any = {"data": data, **options}
        with pytest.raises(error, match=says):
            bmc.fit(sprinkler(), **given)
    with pytest.raises(UnsupportedError, match="plates"):
        bmc.fit(plated, {"x": [0, 1, 1]}, learn=["c"])


def test_extrapolated_steps_end_where_plain_ones_do() -> None:
    rng = np.random.default_rng(5)
    cases = Cases(["a", "b", "c"], [2, 3, 2], {"a": (), "b": ("a",), "c": ("b",)},
                  np.where(rng.random((60, 3)) < 0.4, -1, rng.integers(0, [2, 3, 2], (60, 3))))  # fmt: skip
    start = {
        n: rng.dirichlet(np.ones(k), shape)
        for n, k, shape in [("a", 2, ()), ("b", 3, (2,)), ("c", 2, (3,))]
    }
    counts = {n: np.full(t.shape, 0.5) for n, t in start.items()}
    plain = {n: t.copy() for n, t in start.items()}
    for _ in range(1500):
        _, found = cases.expected(plain)
        plain = {n: found[n] + counts[n] for n in plain}
        plain = {n: t / t.sum(axis=-1, keepdims=True) for n, t in plain.items()}
    learned = maximised(cases.expected, start, counts, 1e-10, 2000)
    assert learned.converged and (np.diff(learned.history) >= 0).all()
    assert len(learned.history) < 400
    for name, table in plain.items():
        np.testing.assert_allclose(learned.tables[name], table, atol=1e-4)
    # an objective that nothing but plain steps raises is followed all the same
    assert (
        maximised(cases.expected, plain, counts, 1e-10, 5).history[-1] >= learned.history[-1] - 1e-8
    )


def test_an_optimum_is_that_of_another_package() -> None:
    """pyAgrum 3.3.1's EM from the same tables, without noise and prior, after 82 plain iterations."""
    codes = (
        "0??1 0000 ?000 1111 0?01 100? 0?00 1?01 1000 ?100 012? 11?1 110? 1??0 001? 11?1 "
        "?100 1101 ??21 10?0 0000 1000 1?00 1100 000? 0010 1021 1?11 ?100 1101 11?1 ?1?1 "
        "110? 0?00 1000 0?00 ?121 0?10 112? ??00 110? 1101 0000 1?01 00?0 1?01 11?1 00?0"
    )
    theirs = {
        "cloudy": [0.352857354, 0.647142646],
        "rain": [[0.7865816392, 0.2134183608], [0.2539601821, 0.7460398179]],
        "sprinkler": [
            [0.6714010594, 0.2196301163, 0.1089688243],
            [0.7645999853, 0.0880792894, 0.1473207253],
        ],
        "wet": [
            [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
            [[0.3395257625, 0.6604742375], [0.0, 1.0], [0.0, 1.0]],
        ],
    }
    states: dict[str, Any] = {"cloudy": ("no", "yes")}
    columns = {
        name: [
            None if row[k] == "?" else states.get(name, range(3))[int(row[k])]
            for row in codes.split()
        ]
        for k, name in enumerate(theirs)
    }
    found = bmc.fit(sprinkler(), columns, tolerance=1e-13)
    assert found.converged
    assert found.log_likelihood == pytest.approx(-89.8335598002, abs=1e-8)
    for name, table in theirs.items():
        np.testing.assert_allclose(found[name], table, atol=1e-6)
    assert len(bmc.fit(sprinkler(), columns, start=found.values).history) == 2  # stays there


def test_a_series_with_gaps_is_learned_as_direct_maximisation_learns_it() -> None:
    """Gaps in what nobody reads count for nothing: the optimum of the forward algorithm's likelihood."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("mood", ["mood_prev"], [[0.7, 0.3], [0.4, 0.6]], initial=[0.5, 0.5])
    dbn.table("noise", ["mood"], [[0.7, 0.3], [0.2, 0.8]])
    rows: list[Any] = ([0] * 12 + [1] * 8) * 5
    rows[7] = rows[14] = rows[50] = None
    found = bmc.fit(dbn, {"noise": rows}, tolerance=1e-9)
    assert found.converged and (np.diff(found.history) > -1e-9).all()

    def loss(u: np.ndarray) -> float:
        p = 1 / (1 + np.exp(-u))
        move, shown = (np.stack([1 - q, q], axis=-1) for q in (p[1:3], p[3:]))
        belief, total = np.array([1 - p[0], p[0]]), 0.0
        for t, row in enumerate(rows):
            belief = belief @ move if t else belief
            joint = belief if row is None else belief * shown[:, row]
            total += np.log(joint.sum())
            belief = joint / joint.sum()
        return -total

    best = optimize.minimize(loss, [-1.0, -2.0, 2.0, -1.0, 1.0], options={"gtol": 1e-4})
    assert found.log_likelihood == pytest.approx(-best.fun, abs=1e-4)
    p = 1 / (1 + np.exp(-best.x))
    learned = [found["mood"][:, 1], found["noise"][:, 1]]
    np.testing.assert_allclose(np.ravel(learned), p[1:], atol=2e-3)


def test_nothing_observed_is_no_series_to_learn_from() -> None:
    with pytest.raises(EvidenceError, match="nothing is observed"):
        bmc.fit(umbrella(), {"o": [None, None, None]})
