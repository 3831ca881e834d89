"""Labels in functions and queries: kept by what moves elements, loudly lost by what computes with them.

Where they would be lost in silence, every comparison would quietly be False.
"""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ModelError, StateError

ENGINES = [bmc.Exact(), bmc.LikelihoodWeighting(20_000)]
STATES = ("no", "yes")


def two() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3), states=STATES)
    net.add("b", bmc.Bernoulli(0.5), states=STATES)
    return net


#: functions of two labelled parents that move labels, with the probability that they hold
MOVING = {
    "bmc.stack": (lambda a, b: (bmc.stack([a, b]) == "yes").any(axis=-1), 0.65),
    "np.stack": (
        lambda a, b: (np.stack(np.broadcast_arrays(a, b), axis=-1) == "yes").all(axis=-1),
        0.15,
    ),
    "np.where": (lambda a, b: np.where(a == "no", a, b) == "yes", 0.15),
    "np.broadcast_arrays": (lambda a, b: np.broadcast_arrays(a, b)[0] == "yes", 0.3),
    "np.broadcast_to": (lambda a, b: np.broadcast_to(a, np.shape(a)) == "yes", 0.3),
    "np.concatenate": (
        lambda a, b: (
            np.concatenate([x[..., None] for x in np.broadcast_arrays(a, b)], axis=-1) == "yes"
        ).all(axis=-1),
        0.15,
    ),
    "np.copy": (lambda a, b: np.copy(a) == "yes", 0.3),
    "copy": (lambda a, b: a.copy() == "yes", 0.3),
    "index": (lambda a, b: bmc.stack([a, b])[..., 1] == "yes", 0.5),
    "isin": (lambda a, b: np.isin(a, ["yes"]) | (b == "yes"), 0.65),
}


@pytest.mark.parametrize("engine", ENGINES, ids=["exact", "weighting"])
@pytest.mark.parametrize("how", MOVING)
def test_what_moves_labels_keeps_them(how: str, engine) -> None:
    """20,000 draws: 4.5 standard errors of 0.0034, false alarm 7e-6 each at a fresh seed."""
    function, expected = MOVING[how]
    net = two()
    net.add("d", function)
    posterior = bmc.infer(net, engine=engine, rng=0)
    assert posterior.mean("d") == pytest.approx(expected, abs=0.016)
    assert posterior.probability(function) == pytest.approx(expected, abs=0.016)
    drawn = net.sample(2000, rng=1)
    np.testing.assert_array_equal(function(drawn["a"], drawn["b"]), drawn["d"])


#: functions that make numbers of labels: what they give is no state any more
COMPUTING = {
    "minimum": lambda a, b: np.minimum(a, b) == "yes",
    "maximum": lambda a, b: np.maximum(a, b) != "yes",
    "and": lambda a, b: (a & b) == "yes",
    "plus": lambda a, b: (a + 0) == "yes",
    "clip": lambda a, b: np.clip(a, 0, 1) == "yes",
    "max": lambda a, b: bmc.stack([a, b]).max(axis=-1) == "yes",
    "sort": lambda a, b: np.sort(bmc.stack([a, b]), axis=-1)[..., 0] == "yes",
    "select": lambda a, b: np.select([a == "no"], [a], b) == "yes",
    "astype": lambda a, b: a.astype(int) == "yes",
    "array of labels": lambda a, b: (a * 1) == np.array(["yes"]),
}


@pytest.mark.parametrize("vectorize", [False, True], ids=["arrays", "looped"])
@pytest.mark.parametrize("how", COMPUTING)
def test_labels_lost_in_a_function_are_heard_of(how: str, vectorize: bool) -> None:
    net = two()
    net.add("d", COMPUTING[how], vectorize=vectorize)
    with pytest.raises(StateError, match=r"node 'd'.*compared with .*'yes'.*states="):
        net.validate()


@pytest.mark.parametrize("engine", ENGINES, ids=["exact", "weighting"])
@pytest.mark.parametrize("how", COMPUTING)
def test_labels_lost_in_a_query_are_heard_of(how: str, engine) -> None:
    posterior = bmc.infer(two(), engine=engine, rng=0)
    for ask in (posterior.probability, posterior.expectation):
        with pytest.raises(StateError, match=r"compared with .*'yes'.*states="):
            ask(COMPUTING[how])


def test_a_deterministic_node_hands_labels_on() -> None:
    net = bmc.BayesNet(plates={"p": 3})
    net.add("a", bmc.Bernoulli(0.3), states=STATES, plates="p")
    net.add("c", lambda a: a, plates="p")
    net.add("first", lambda a: a[0])
    net.add("x", lambda c: bmc.Normal(np.where(c == "yes", 5.0, 0.0), 1.0), plates="p")
    assert net["c"].states == net["first"].states == STATES
    draws = net.sample(2000, rng=0)
    np.testing.assert_array_equal(draws["c"] == "yes", draws["a"] == "yes")
    np.testing.assert_array_equal(draws["first"] == "yes", draws["a"][:, 0] == "yes")
    high = draws["x"] > 2.5  # 2.5 standard deviations away on both sides
    assert ((draws["a"] == "yes") == high).mean() > 0.98
    p = bmc.infer(net, engine=bmc.LikelihoodWeighting(2000), rng=0)
    np.testing.assert_array_equal(p.probabilities("c"), p.probabilities("a"))
    with pytest.raises(bmc.errors.UnsupportedError, match="are labels and have no mean"):
        p.mean("c")


# ---- no labels declared -------------------------------------------------------------------------


def test_forgotten_states_are_heard_of_in_functions() -> None:
    for function in (
        lambda a: bmc.Normal(np.where(a == "yes", 5.0, 0.0), 1.0),
        lambda a: bmc.Normal(np.where(a != "yes", 5.0, 0.0), 1.0),
        lambda a: (a == "yes") * 1.0,
        lambda a: bmc.Normal(np.where(a == np.array("yes"), 5.0, 0.0), 1.0),
    ):
        for family in (bmc.Bernoulli(0.3), bmc.Poisson(3.0), bmc.Normal(0.0, 1.0)):
            net = bmc.BayesNet()
            net.add("a", family)
            net.add("x", function)
            with pytest.raises(StateError, match=r"node 'x'.*no labels.*states="):
                net.validate()


@pytest.mark.parametrize("plates", ["p", ()])
def test_forgotten_states_are_heard_of_across_plates(plates) -> None:
    net = bmc.BayesNet(plates={"p": 2, "q": 3})
    net.add("k", bmc.Bernoulli(0.3), plates="q")
    net.add("i", bmc.DiscreteUniform(0, 2), plates="p")
    if plates:
        net.add("x", lambda k, i: bmc.Bernoulli(0.1 + 0.5 * (k[i] == "yes")), plates="p")
    else:
        net.add("x", lambda k: (k == "yes").sum("q"))
    with pytest.raises(ModelError, match="node 'x'"):
        net.validate()


@pytest.mark.parametrize("engine", ENGINES, ids=["exact", "weighting"])
def test_forgotten_states_are_heard_of_in_queries(engine) -> None:
    net = bmc.BayesNet()
    net.add("k", bmc.Bernoulli(0.3))
    posterior = bmc.infer(net, engine=engine, rng=0)
    for query in (lambda k: k == "yes", lambda k: k != "yes", lambda k: "yes" == k):  # noqa: SIM300
        with pytest.raises(StateError, match=r"no labels.*states="):
            posterior.probability(query)
    assert posterior.probability(lambda k: k == 1) == pytest.approx(0.3, abs=0.02)


def test_a_potential_that_compares_with_labels_is_heard_of() -> None:
    net = bmc.BayesNet()
    net.add("k", bmc.Bernoulli(0.3))
    net.potential("f", lambda k: np.where(k == "yes", 0.0, -1.0))
    with pytest.raises(StateError, match=r"'?f'?.*no labels.*states="):
        net.validate()


# ---- what states may be -------------------------------------------------------------------------

BAD = {
    "mixed": (("a", "b", 1), "mixes numbers and labels"),
    "truth and text": ((True, "x", "y"), "mixes numbers and labels"),
    "set": ({"p", "q", "r"}, "a list or tuple, in the order of the support"),
    "frozenset": (frozenset("pqr"), "a list or tuple, in the order of the support"),
    "text": ("abc", "a list or tuple, in the order of the support"),
    "dict": ({"a": 0, "b": 1, "c": 2}, "a list or tuple, in the order of the support"),
    "None": (("a", "b", None), "an entry that names nothing"),
    "NaN": ((0.0, 1.0, float("nan")), "an entry that names nothing"),
    "twice": (("a", "a", "b"), "names a state twice"),
    "number twice": ((0, 0.0, 1), "names a state twice"),
}


@pytest.mark.parametrize("fault", BAD)
def test_states_that_do_not_name_values_are_refused(fault: str) -> None:
    states, message = BAD[fault]
    net = bmc.BayesNet()
    with pytest.raises(ModelError, match=message):
        net.table("k", probs=[0.2, 0.3, 0.5], states=states)
        net.validate()
    net = bmc.BayesNet()
    with pytest.raises(ModelError, match=message):
        net.add("k", bmc.Categorical([0.2, 0.3, 0.5]), states=states)
        net.validate()
    assert "k" not in net or fault not in ("set", "frozenset", "text", "dict")


@pytest.mark.parametrize(
    ("states", "kept"),
    [
        (["a", "b", "c"], ("a", "b", "c")),
        (np.array(["a", "b", "c"]), ("a", "b", "c")),
        (np.arange(3), (0, 1, 2)),
        ((0, 1.5, 2), (0.0, 1.5, 2.0)),
    ],
    ids=["list", "array of labels", "array of numbers", "integers and reals"],
)
def test_states_in_every_good_form(states, kept) -> None:
    net = bmc.BayesNet()
    net.add("k", bmc.Categorical([0.2, 0.3, 0.5]), states=states)
    assert net["k"].states == kept and all(type(s) in (str, int, float) for s in net["k"].states)
    exact = bmc.infer(net, engine=bmc.Exact())
    for state, p in zip(kept, (0.2, 0.3, 0.5), strict=True):
        assert exact.probability(lambda k, s=state: k == s) == pytest.approx(p)
        assert bmc.infer(net, {"k": state}).log_marginal_likelihood == pytest.approx(np.log(p))
