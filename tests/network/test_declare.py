"""Declaring nets: every form, any order, and no side effects."""

from __future__ import annotations

import functools
import itertools

import networkx
import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    CycleError,
    DuplicateNodeError,
    ModelError,
    ParameterError,
    PlateError,
    ShapeError,
    UnknownNodeError,
)

# ---- forms --------------------------------------------------------------------------------------


def test_all_forms_declare_the_same_net():
    decorated = bmc.BayesNet(plates={"p": 3})

    @decorated.node
    def a():
        return bmc.Bernoulli(0.3)

    @decorated.node(plates="p", states=("no", "yes"))
    def b(a):
        return bmc.Categorical(np.stack([1 - 0.2 - 0.5 * a, 0.2 + 0.5 * a], axis=-1))

    @decorated.node(plates=("p",))
    def x(b, a):
        return bmc.Normal(np.where(b == "yes", 1.0, 0.0) + a, 1.0)

    added = bmc.BayesNet(plates={"p": 3})
    added.add("x", x, plates=["p"])  # before its parents
    added.table("b", ["a"], [[0.8, 0.2], [0.3, 0.7]], states=("no", "yes"), plates="p")
    added.add("a", [0.7, 0.3])
    listed = bmc.BayesNet(plates={"p": 3})
    listed.add("a", scipy.stats.bernoulli(0.3))
    listed.add("b", [[0.8, 0.2], [0.3, 0.7]], ["a"], "p", ("no", "yes"))
    listed.add("x", lambda first, second: x(second, first), ["a", "b"], "p")
    mapped = bmc.BayesNet(plates={"p": 3})
    mapped.add("a", bmc.Bernoulli(0.3))
    mapped.node(b, plates="p", states=("no", "yes"))
    mapped.add("x", lambda u, v: x(v, u), parents={"v": "b", "u": "a"}, plates="p")
    draws = decorated.sample(20, rng=0)
    for other in (added, listed, mapped):
        np.testing.assert_allclose(
            decorated.log_prob(draws),
            other.log_prob({"a": draws["a"], "b": draws["b"].labels, "x": draws["x"]}),
            rtol=1e-12,
        )
    assert mapped["x"].parents == ("a", "b") and decorated["x"].parents == ("b", "a")


def test_the_decorator_returns_the_function_unchanged():
    net = bmc.BayesNet()

    def f():
        return bmc.Normal(0.0, 1.0)

    assert net.node(f) is f
    assert net.node(name="other")(f) is f
    assert list(net) == ["f", "other"] and len(net) == 2 and "f" in net and "g" not in net


def test_any_order_of_declarations():
    parts = {
        "a": lambda: bmc.Bernoulli(0.5),
        "b": lambda a: bmc.Normal(a, 1.0),
        "c": lambda b: 2 * b,
        "d": lambda a, c: bmc.Normal(a + c, 1.0),
    }
    densities = []
    for order in itertools.permutations(parts):
        net = bmc.BayesNet()
        for name in order:
            net.add(name, parts[name])
        densities.append(float(net.log_prob({"a": 1, "b": 0.5, "d": 2.0})))
        assert list(net) == list(order)
    np.testing.assert_allclose(densities, densities[0], rtol=1e-14)


def test_arguments_with_defaults_are_no_parents():
    net = bmc.BayesNet()
    net.add("x0", bmc.Normal(0.0, 1.0))
    for i in range(1, 4):
        net.add(f"x{i}", lambda previous, i=i: bmc.Normal(previous + i, 1.0), parents=[f"x{i - 1}"])
    assert net["x3"].parents == ("x2",)
    values = {f"x{i}": float(sum(range(i + 1))) for i in range(4)}
    np.testing.assert_allclose(net.log_prob(values), -2 * np.log(2 * np.pi))

    @net.node
    def y(x3, scale=2.0, *, shift=1.0):
        return bmc.Normal(x3 + shift, scale)

    assert net["y"].parents == ("x3",)


def test_keyword_only_arguments_are_parents():
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, *, b: bmc.Normal(a - 2 * b, 1.0))
    net.add("z", lambda p, *, q: bmc.Normal(p - 2 * q, 1.0), parents=["a", "b"])
    net.add("w", lambda *, q, p: bmc.Normal(p - 2 * q, 1.0), parents={"p": "a", "q": "b"})
    assert net["y"].parents == net["z"].parents == ("a", "b")
    values = {"a": 1.0, "b": 3.0, "y": -5.0, "z": -5.0, "w": -5.0}
    np.testing.assert_allclose(
        net.log_prob(values), -0.5 * (1 + 9) - 2.5 * np.log(2 * np.pi), rtol=1e-12
    )


def test_a_mapping_may_bind_an_argument_with_a_default():
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda m=5.0: bmc.Normal(m, 1.0), parents={"m": "a"})
    assert net["y"].parents == ("a",)
    np.testing.assert_allclose(net.log_prob({"a": 0.0, "y": 0.0}), -np.log(2 * np.pi))


def test_star_arguments_need_parents():
    net = bmc.BayesNet()
    for name in "abc":
        net.add(name, bmc.Normal(0.0, 1.0))
    net.add("total", lambda *v: v[0] + 10 * v[1] + 100 * v[2], parents=["a", "b", "c"])
    net.add(
        "mixed",
        lambda first, *rest, last: first + 10 * rest[0] + 100 * last,
        parents=["a", "b", "c"],
    )
    draws = net.sample(3, rng=0)
    for name in ("total", "mixed"):
        np.testing.assert_allclose(draws[name], draws["a"] + 10 * draws["b"] + 100 * draws["c"])
    with pytest.raises(
        ModelError, match=r"node 'y': \*v needs parents= to say which nodes they are"
    ):
        net.add("y", lambda *v: sum(v))
    with pytest.raises(
        ModelError, match=r"node 'y': \*\*kw is refused.*argument names are the parents"
    ):
        net.add("y", lambda **kw: 0)
    with pytest.raises(ModelError, match=r"node 'y': \*\*kw is refused"):
        net.add("y", lambda **kw: 0, parents=["a"])


def test_partials_classes_methods_and_ufuncs():
    class Sensor:
        def __init__(self, gain):
            self.gain = gain

        def read(self, a):
            return bmc.Normal(self.gain * a, 1.0)

    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", functools.partial(lambda a, s: bmc.Normal(a, s), s=2.0))
    net.add("c", functools.partial(lambda s, a: bmc.Normal(a, s), 2.0))
    net.add("d", Sensor(3.0).read)
    net.add("e", np.exp, parents=["a"])
    net.add("f", bmc.Normal, parents=["a", "e"])
    net.node(functools.partial(lambda a: bmc.Normal(a, 1.0)), name="g")
    assert [net[n].parents for n in "bcdefg"] == [("a",)] * 4 + [("a", "e"), ("a",)]
    draws = net.sample(4, rng=0)
    np.testing.assert_array_equal(draws["e"], np.exp(draws["a"]))
    with pytest.raises(ModelError, match="no name to give the node.*name="):
        net.node(lambda a: bmc.Normal(a, 1.0))
    with pytest.raises(ModelError, match="no name to give the node.*name="):
        net.node(functools.partial(lambda a: bmc.Normal(a, 1.0)))


def test_one_node_twice_as_a_parent():
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("y", lambda p, q: bmc.Bernoulli(0.2 + 0.3 * p + 0.3 * q), parents=["a", "a"])
    np.testing.assert_allclose(net.log_prob({"a": 1, "y": 1}), np.log(0.5 * 0.8))
    np.testing.assert_allclose(bmc.infer(net, {"y": 1}).probabilities("a"), [0.2, 0.8])


def test_names_that_are_no_identifiers():
    net = bmc.BayesNet()
    net.add("x[0]", bmc.Normal(0.0, 1.0))
    net.add("x[1]", lambda x: bmc.Normal(x, 1.0), parents=["x[0]"])
    net.add("élan vital", lambda x: bmc.Normal(x, 1.0), parents={"x": "x[1]"})
    assert set(net.sample(2, rng=0)) == {"x[0]", "x[1]", "élan vital"}
    for bad in ("", None, 3):
        with pytest.raises(ModelError, match="name is a non-empty string"):
            net.add(bad, bmc.Normal(0.0, 1.0))


def test_nodes_are_frozen_records():
    net = bmc.BayesNet("n", plates={"p": 3})
    net.add("z", bmc.Categorical([0.5, 0.5]), plates="p", states=("no", "yes"))
    net.add("d", bmc.DiscreteUniform(2, 4))
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="p")
    net.add("t", lambda v: v[..., 0], plates="p")
    net.input("u", event_shape=2)
    z, d, v, t, u = (net[n] for n in "zdvtu")
    assert (z.parents, z.plates, z.event_shape, z.states, z.is_discrete) == (
        (),
        ("p",),
        (),
        ("no", "yes"),
        True,
    )
    assert d.states == (2, 3, 4) and d.kind == "stochastic"
    assert v.event_shape == (2,) and v.states is None and not v.is_discrete
    assert t.kind == "deterministic" and t.parents == ("v",)
    assert u.kind == "input" and u.event_shape == (2,)
    with pytest.raises(AttributeError):
        z.plates = ()
    with pytest.raises(UnknownNodeError, match="no node 'w'"):
        net["w"]


def test_graph_is_a_copy():
    net = bmc.BayesNet("g", plates={"p": 2})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0), plates="p")
    graph = net.graph
    assert isinstance(graph, networkx.DiGraph)
    assert set(graph.edges) == {("a", "b")} and graph.nodes["b"]["plates"] == ("p",)
    graph.remove_node("a")
    graph.nodes["b"]["plates"] = ()
    assert set(net.graph.edges) == {("a", "b")} and net.graph.nodes["b"]["plates"] == ("p",)
    assert net["b"].parents == ("a",)


def test_replace_takes_the_place_of_a_node():
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0))
    with pytest.raises(DuplicateNodeError, match="node 'a' is declared already; .*replace=True"):
        net.add("a", bmc.Normal(5.0, 1.0))
    np.testing.assert_allclose(net.log_prob({"a": 5.0, "b": 5.0}), -12.5 - np.log(2 * np.pi))
    net.add("a", bmc.Normal(5.0, 1.0), replace=True)
    np.testing.assert_allclose(net.log_prob({"a": 5.0, "b": 5.0}), -np.log(2 * np.pi))

    @net.node(replace=True)
    def b(a):
        return bmc.Normal(-a, 1.0)

    np.testing.assert_allclose(net.log_prob({"a": 5.0, "b": -5.0}), -np.log(2 * np.pi))
    net.table("c", [], [0.5, 0.5])
    with pytest.raises(DuplicateNodeError, match="'c' is declared already"):
        net.table("c", [], [0.1, 0.9])
    with pytest.raises(DuplicateNodeError, match="'c' is declared already"):
        net.input("c")
    with pytest.raises(DuplicateNodeError, match="potential 'c'"):
        net.potential("c", lambda a: a)
    net.potential("f", lambda a: -a)
    with pytest.raises(DuplicateNodeError, match="'f'"):
        net.add("f", bmc.Normal(0.0, 1.0))


# ---- names, cycles, plates ----------------------------------------------------------------------


def test_a_cycle_shows_its_path():
    net = bmc.BayesNet()
    net.add("start", bmc.Normal(0.0, 1.0))
    net.add("a", lambda start, c: bmc.Normal(c, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0))
    net.add("c", lambda b: bmc.Normal(b, 1.0))
    net.add("end", lambda c: bmc.Normal(c, 1.0))
    with pytest.raises(
        CycleError, match="cycle: a -> b -> c -> a; a net must be acyclic"
    ) as caught:
        net.validate()
    assert caught.value.path == ("a", "b", "c", "a")
    own = bmc.BayesNet()
    own.add("x", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(CycleError, match="cycle: x -> x"):
        own.sample(1)


def test_an_unknown_parent_is_named_with_a_hint():
    net = bmc.BayesNet()
    net.add("temperature", bmc.Normal(0.0, 1.0))
    net.add("y", lambda temprature: bmc.Normal(temprature, 1.0))
    for use in (net.validate, lambda: net.sample(1), lambda: net["y"], lambda: net.graph):
        with pytest.raises(
            UnknownNodeError,
            match=r"node 'y' has the parent 'temprature': .*did you mean 'temperature'.*parents=",
        ):
            use()
    net.add("temprature", bmc.Normal(0.0, 1.0))
    net.validate()


def test_a_wrong_plate_is_named():
    net = bmc.BayesNet(plates={"point": 3})
    with pytest.raises(
        PlateError, match=r"node 'x' is in plate 'points'.*\['point'\].*BayesNet\(plates="
    ):
        net.add("x", bmc.Normal(0.0, 1.0), plates="points")
    with pytest.raises(PlateError, match="node 'x': plates=.* names a plate twice"):
        net.add("x", bmc.Normal(0.0, 1.0), plates=("point", "point"))
    with pytest.raises(PlateError, match="node 'u' is in plate 'q'"):
        net.input("u", plates="q")
    with pytest.raises(PlateError, match="'f' is in plate 'q'"):
        net.potential("f", lambda: 0.0, plates="q")
    with pytest.raises(PlateError, match="negative"):
        bmc.BayesNet(plates={"p": -1})
    with pytest.raises(PlateError, match="'abc' is one string"):
        bmc.BayesNet(plates={"p": "abc"})
    assert len(net) == 0  # nothing half declared


def test_plates_by_labels_and_from_data():
    net = bmc.BayesNet(plates={"site": ("north", "south"), "day": None})
    net.add("m", bmc.Normal(0.0, 1.0), plates="site")
    net.add("x", lambda m: bmc.Normal(m, 1.0), plates=("day", "site"))
    assert net.plates == {"site": 2, "day": None}
    posterior = bmc.infer(net, {"x": np.zeros((5, 2))}, rng=0).resample(50, rng=0)
    assert posterior["x"].shape[2:] == (5, 2)
    assert posterior.summary().names[:2] == ("m[north]", "m[south]")
    assert net.sample(3, rng=0, plates={"day": 4})["x"].shape == (3, 4, 2)
    with pytest.raises(
        PlateError, match="size of plate 'day' is not known; observe a node in it, or declare"
    ):
        net.sample(3)
    with pytest.raises(PlateError, match="plates= gives 'week'"):
        net.sample(3, plates={"week": 4})
    net.add("w", lambda x: bmc.Normal(x, 1.0), plates=("day", "site"))
    with pytest.raises(
        PlateError, match="plate 'day' has size 5 in the data of 'x' but 4 in that of 'w'"
    ):
        bmc.infer(net, {"x": np.zeros((5, 2)), "w": np.zeros((4, 2))})
    assert net.log_prob(
        {"m": np.zeros(2), "x": np.zeros((6, 3, 2)), "w": np.zeros((6, 3, 2))}
    ).shape == (6,)


def test_parents_given_wrongly():
    net = bmc.BayesNet()
    for bad in ("ab", "a"):
        with pytest.raises(ModelError, match="is one string; give a list of names"):
            net.add("y", lambda a: bmc.Normal(a, 1.0), parents=bad)
        with pytest.raises(ModelError, match="is one string; give a list of names"):
            net.table("y", bad, [[0.5, 0.5]])
    with pytest.raises(
        ModelError,
        match=r"node 'y': parents= lists 3 names, but the function takes 1 arguments \(a\)",
    ):
        net.add("y", lambda a: bmc.Normal(a, 1.0), parents=["a", "b", "c"])
    with pytest.raises(
        ModelError, match="node 'y': parents= lists 1 names, but the function takes 2"
    ):
        net.add("y", lambda a, b: bmc.Normal(a, 1.0), parents=["a"])
    with pytest.raises(
        ModelError, match=r"parents= maps \['c'\], which the function has no argument for"
    ):
        net.add("y", lambda a: bmc.Normal(a, 1.0), parents={"c": "a"})
    with pytest.raises(ModelError, match="a distribution has no arguments for parents="):
        net.add("y", bmc.Normal(0.0, 1.0), parents=["a"])
    with pytest.raises(ModelError, match="a table lists its parents in the order of its axes"):
        net.add("y", [[0.5, 0.5]], parents={"a": "b"})
    assert len(net) == 0


# ---- states -------------------------------------------------------------------------------------


def test_numeric_states_arrive_as_those_numbers():
    seen = []
    net = bmc.BayesNet()
    net.add("spin", bmc.Bernoulli(0.5), states=(-1, 1))
    net.add("level", bmc.Categorical([0.2, 0.3, 0.5]), states=(0.5, 10.0, 2.0))
    net.add("flag", bmc.Bernoulli(0.5), states=(False, True))

    @net.node
    def y(spin, level, flag):
        seen.append((set(np.unique(spin)), set(np.unique(level)), flag.dtype))
        return bmc.Normal(spin * level, np.where(flag, 1.0, 2.0))

    net.validate()
    assert set().union(*(s[0] for s in seen)) == {-1, 1}
    assert set().union(*(s[1] for s in seen)) == {0.5, 2.0, 10.0}
    assert all(s[2] == np.dtype(bool) for s in seen)
    np.testing.assert_allclose(
        net.log_prob({"spin": -1, "level": 10.0, "flag": True, "y": -10.0}),
        np.log(0.5 * 0.3 * 0.5) - 0.5 * np.log(2 * np.pi),
    )
    draws = net.sample(500, rng=0)
    assert set(np.unique(draws["level"])) == {0.5, 2.0, 10.0}
    assert bmc.infer(net, {"spin": -1}, rng=0).mean("level") == pytest.approx(4.1, abs=0.2)


def test_states_as_arrays_of_text():
    for states in (("no", "yes"), ["no", "yes"], np.array(["no", "yes"])):
        net = bmc.BayesNet()
        net.add("a", bmc.Bernoulli(0.5), states=states)
        net.add("x", lambda a: bmc.Normal(np.where(a == "yes", 1.0, 0.0), 1.0))
        np.testing.assert_allclose(
            net.log_prob({"a": "yes", "x": 1.0}), np.log(0.5) - 0.5 * np.log(2 * np.pi)
        )
        assert net["a"].states == ("no", "yes")


def test_states_given_wrongly():
    def declared(states, cpd=None):
        net = bmc.BayesNet()
        net.add("a", cpd if cpd is not None else bmc.Bernoulli(0.5), states=states)
        return net

    with pytest.raises(
        ModelError, match="node 'a': states= has 3 entries, but the distribution has 2 values"
    ):
        declared(("x", "y", "z")).validate()
    with pytest.raises(ModelError, match="node 'a': states= names a state twice"):
        declared(("x", "x")).validate()
    with pytest.raises(
        ModelError, match="node 'a': states= need a distribution with finitely many values"
    ):
        declared(("x", "y"), bmc.Poisson(1.0)).validate()
    with pytest.raises(ModelError, match="node 'a': states= need .*; Normal is on real numbers"):
        declared(("x", "y"), bmc.Normal(0.0, 1.0)).validate()
    with pytest.raises(
        ModelError, match="node 'a': states= has 3 entries, but the last axis of probs has 2"
    ):
        declared(("x", "y", "z"), [0.5, 0.5])
    net = bmc.BayesNet()
    net.add("n", bmc.Poisson(3.0))
    net.add("k", lambda n: bmc.Binomial(n, 0.5), states=tuple("abcd"))
    with pytest.raises(ModelError, match="node 'k': states= need .* do not depend on the parents"):
        net.validate()


def test_a_label_misspelt_in_a_function_is_named():
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5), states=("no", "yes"))
    net.add("x", lambda a: bmc.Normal(np.where(a == "yess", 1.0, 0.0), 1.0))
    with pytest.raises(
        ModelError, match="node 'x': 'yess' is not a state; the states are 'no', 'yes'"
    ):
        net.validate()


def test_states_of_a_deterministic_node():
    net = bmc.BayesNet()
    net.add("a", bmc.DiscreteUniform(1, 6))
    net.add("size", lambda a: np.where(a > 4, 1, 0), states=("small", "large"))
    net.add("x", lambda size: bmc.Normal(np.where(size == "large", 5.0, 0.0), 1.0))
    exact = bmc.infer(net, {"x": 2.5}, engine=bmc.Exact())  # x = 2.5 favours neither
    np.testing.assert_allclose(exact.probabilities("size"), [2 / 3, 1 / 3])
    assert net.sample(200, rng=0)["size"].labels.tolist().count("large") in range(40, 95)


# ---- tables -------------------------------------------------------------------------------------


def test_tables_follow_parents_and_states_in_order():
    rng = np.random.default_rng(0)
    probs = rng.dirichlet(np.ones(2), size=(3, 2))
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.2, 0.3, 0.5]), states=("x", "y", "z"))
    net.add("b", bmc.DiscreteUniform(4, 5))
    net.table("c", ["a", "b"], probs, states=(10, 20))
    for i, j, k in np.ndindex(3, 2, 2):
        got = net.log_prob({"a": "xyz"[i], "b": 4 + j, "c": (10, 20)[k]})
        np.testing.assert_allclose(got, np.log([0.2, 0.3, 0.5][i] * 0.5 * probs[i, j, k]))


def test_tables_with_wrong_shapes_and_rows():
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    with pytest.raises(
        ModelError, match="node 'b': probs has 1 axes, but 1 parents and the node itself make 2"
    ):
        net.table("b", ["a"], [0.5, 0.5])
    with pytest.raises(ModelError, match="node 'b': table.. needs probs="):
        net.table("b", ["a"])
    with pytest.raises(
        ParameterError, match=r"node 'b': the row at parents' index \(1,\) .*sum 0\.9.*sums to 1"
    ) as caught:
        net.table("b", ["a"], [[0.5, 0.5], [0.4, 0.5]])
    assert caught.value.index == (1,)
    for row in ([1.2, -0.2], [np.nan, 1.0], [np.inf, 0.0]):
        with pytest.raises(ParameterError, match="node 'b': the row"):
            net.table("b", ["a"], [[0.5, 0.5], row])
    for probs in (np.full((3, 2), 0.5), np.full((1, 2), 0.5)):
        net.table("b", ["a"], probs, replace=True)
        with pytest.raises(ShapeError, match=f"node 'b'.*{len(probs)} .*parent 'a'"):
            net.validate()


def test_rows_off_by_rounding_are_renormalised_and_worse_ones_refused():
    net = bmc.BayesNet()
    net.table("a", [], np.array([0.3, 0.7 + 9e-7]))
    np.testing.assert_allclose(np.exp(net.log_prob({"a": np.array([0, 1])})).sum(), 1.0, rtol=1e-15)
    with pytest.raises(ParameterError, match="node 'b': .*sums to 1"):
        net.table("b", [], np.array([0.3, 0.7 + 3e-6]))


def test_a_table_whose_parent_is_foreign_or_not_finite():
    net = bmc.BayesNet(plates={"p": 3})
    net.add("a", bmc.Bernoulli(0.5), plates="p")
    net.table("b", ["a"], [[0.5, 0.5], [0.1, 0.9]])
    with pytest.raises(
        PlateError, match=r"node 'b': the table's parent 'a' is in plates \('p',\), .*plates="
    ):
        net.validate()
    for parent in (bmc.Normal(0.0, 1.0), bmc.Poisson(30.0)):
        net = bmc.BayesNet()
        net.add("a", parent)
        net.table("b", ["a"], [[0.5, 0.5], [0.1, 0.9]])
        with pytest.raises(ModelError, match="node 'b'.*parent 'a'"):
            net.validate()


def test_a_table_in_plates_with_shared_and_unplated_parents():
    probs = np.random.default_rng(1).dirichlet(np.ones(2), size=(2, 3))
    net = bmc.BayesNet(plates={"p": 3, "q": 3})
    net.table("g", [], [0.5, 0.5])
    net.table("h", [], [0.2, 0.3, 0.5], plates="q")
    net.table("c", ["g", "h"], probs, plates=("p", "q"))
    draws = net.sample(4, rng=0)
    expected = np.log(0.5) + np.log(np.array([0.2, 0.3, 0.5]))[draws["h"]].sum(-1)
    rows = probs[draws["g"][:, None, None], draws["h"][:, None, :], draws["c"]]
    np.testing.assert_allclose(net.log_prob(draws), expected + np.log(rows).sum((-1, -2)))


# ---- inputs and potentials ----------------------------------------------------------------------


def test_inputs():
    net = bmc.BayesNet(plates={"p": None})
    net.input("u", plates="p")
    net.input("g", event_shape=2)
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, u, g: bmc.Normal(a * u + g[..., 0] - g[..., 1], 1.0), plates="p")
    given = {"u": [1.0, 2.0, 3.0], "g": [5.0, 1.0]}
    values = {"a": 2.0, "y": [6.0, 8.0, 10.0]}
    np.testing.assert_allclose(net.log_prob(values, inputs=given), -2.0 - 2 * np.log(2 * np.pi))
    assert net.sample(4, rng=0, inputs=given)["y"].shape == (4, 3)


def test_potentials_by_decorators():
    net = bmc.BayesNet(plates={"row": 3})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0), plates="row")

    @net.potential
    def order(a, b):
        return np.where((a < b).all("row"), 0.0, -np.inf)

    @net.potential("near")
    def _(a):
        return -(a**2)

    @net.potential(plates="row")
    def each(b):
        return -(b**2)

    @net.potential(parents=["a", "b"])
    def both(x, y):
        return -((x - y.sum("row")) ** 2)

    net.potential(function=lambda a: -a, name="named")
    assert net.potentials["order"].parents == ("a", "b") and order is not None
    assert net.potentials["both"].parents == ("a", "b")
    assert net.potentials["named"].parents == ("a",)
    assert net.potentials["near"].parents == ("a",)
    assert net.potentials["each"].plates == ("row",)
    with pytest.raises(bmc.errors.ModelError, match="the name comes first"):
        net.potential(order, "order")
    with pytest.raises(bmc.errors.ModelError, match="it decorates a function"):
        net.potential(3)
    with pytest.raises(bmc.errors.ModelError):
        net.potential("nothing", None)
    with pytest.raises(bmc.errors.ModelError, match="no name to give the potential"):
        net.potential(lambda a: -(a**2))
    with pytest.raises(bmc.errors.DuplicateNodeError):
        net.potential(each)


def test_potentials_with_and_without_plates():
    net = bmc.BayesNet(plates={"p": 3})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    draws = net.sample(5, rng=0)
    before = net.log_prob(draws)
    net.potential("each", lambda x, a: -((x - a) ** 2), plates="p")
    net.potential("all", lambda v: 0.1 * v.sum("p"), parents=["x"])
    expected = before - ((draws["x"] - draws["a"][:, None]) ** 2).sum(-1) + 0.1 * draws["x"].sum(-1)
    np.testing.assert_allclose(net.log_prob(draws), expected, rtol=1e-12)
    net.potential("bad", lambda x: x)
    with pytest.raises(PlateError, match=r"potential.*'?bad'?.*used ungathered.*x?\.?sum"):
        net.log_prob(draws)


# ---- nothing a user passes in changes -----------------------------------------------------------


def test_nothing_passed_in_is_mutated_or_kept():
    probs = np.array([[0.5, 0.5], [0.1, 0.9 + 5e-7]])
    states, parents, plates = ["no", "yes"], ["a"], {"p": 2}
    net = bmc.BayesNet(plates=plates)
    net.add("a", bmc.Bernoulli(0.5), plates="p")
    net.table("b", parents, probs, states=states, plates=["p"])
    u, x = np.array([1.0, 2.0]), np.array([0.5, np.nan])
    net.input("u", plates="p")
    net.add("x", lambda a, u: bmc.Normal(a * u, 1.0), plates="p")
    evidence, inputs = {"x": x, "b": np.array(["yes", "no"])}, {"u": u}
    seed = np.random.SeedSequence(5)
    kept = [v.copy() for v in (probs, u, x)]
    first = bmc.infer(net, evidence, inputs=inputs, engine=bmc.LikelihoodWeighting(500), rng=seed)
    net.sample(3, rng=seed, inputs=inputs)
    net.do({"b": np.array(["yes", "yes"])})
    for before, now in zip(kept, (probs, u, x), strict=True):
        np.testing.assert_array_equal(before, now)
        assert now.flags.writeable
    assert seed.n_children_spawned == 0
    assert (states, parents, plates) == (["no", "yes"], ["a"], {"p": 2})
    assert set(evidence) == {"x", "b"} and set(inputs) == {"u"}
    # and later changes by the user do not reach the net or the posterior
    mean = first.mean("x").copy()
    probs[:] = [1.0, 0.0]
    u[:] = 100.0
    x[:] = -7.0
    states[0], parents[0], plates["p"] = "other", "zzz", 9
    np.testing.assert_array_equal(first.mean("x"), mean)
    assert (
        net["b"].states == ("no", "yes") and net["b"].parents == ("a",) and net.plates == {"p": 2}
    )
    values = {"a": [0, 1], "b": ["yes", "no"], "x": [0.0, 100.0]}
    expected = np.log(0.5 * 0.5 * 0.5 * 0.1) - np.log(2 * np.pi)
    np.testing.assert_allclose(net.log_prob(values, inputs=inputs), expected, rtol=1e-6)


def scribble(array):
    """Write to an answer where that is possible at all."""
    if array.flags.writeable:
        array[...] = 9


def test_writing_to_answers_changes_nothing():
    net = bmc.BayesNet(plates={"p": 2})
    net.add("a", bmc.Bernoulli(0.5), states=("no", "yes"))
    net.add("c", lambda: np.array([1.0, 2.0]), plates="p")
    net.add("x", lambda c: bmc.Normal(c, 1.0), plates="p")
    draws = net.sample(3, rng=0)
    for array in draws.values():
        array[...] = 0  # the user's own
    assert net.sample(3, rng=0)["c"].tolist() == [[1.0, 2.0]] * 3
    for engine in (bmc.LikelihoodWeighting(200), bmc.Exact()):
        posterior = bmc.infer(net, {"x": [0.0, 0.0]}, engine=engine, rng=0)
        scribble(posterior.mean("x"))
        scribble(posterior.probabilities("a"))
        scribble(posterior.marginal("a").probabilities)
        assert posterior.mean("x").tolist() == [0.0, 0.0]
        assert posterior.probabilities("a").sum() == pytest.approx(1.0)
    drawn = posterior.resample(5, rng=0)
    drawn["x"][...] = 9
    assert (drawn["x"] == 0.0).all()


def test_a_posterior_holds_a_snapshot():
    net = bmc.BayesNet(plates={"p": 2})
    net.add("a", bmc.Bernoulli(0.5))
    net.add("x", lambda a: bmc.Normal(a, 1.0), plates="p")
    posterior = bmc.infer(net, {"x": [1.0, 1.0]}, engine=bmc.LikelihoodWeighting(2000), rng=0)
    exact = bmc.infer(net, {"x": [1.0, 1.0]}, engine=bmc.Exact())
    before = posterior.mean("a"), exact.mean("a")
    predicted = posterior.predict("x", rng=1).mean("x")
    net.add("a", bmc.Bernoulli(0.999), replace=True)
    net.add("x", lambda a: bmc.Normal(a + 100.0, 1.0), plates="p", replace=True)
    net.add("more", bmc.Normal(0.0, 1.0))
    assert (posterior.mean("a"), exact.mean("a")) == before
    np.testing.assert_array_equal(posterior.predict("x", rng=1).mean("x"), predicted)
    assert exact.predict("x", rng=1).mean("x").max() < 5
    assert "more" not in posterior.names


def test_copies_are_independent():
    net = bmc.BayesNet(plates={"p": 2})
    net.add("a", bmc.Normal(0.0, 1.0))
    other = net.copy()
    other.add("b", lambda a: bmc.Normal(a, 1.0), plates="p")
    net.add("c", bmc.Normal(0.0, 1.0))
    assert list(net) == ["a", "c"] and list(other) == ["a", "b"]
    assert "BayesNet" in repr(net)
