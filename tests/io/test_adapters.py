"""Nets of pgmpy and pyAgrum, in stand-ins that have the attributes that the adapters read and no more.

``test_peers`` does the same with the libraries themselves, where they are installed.
"""

from __future__ import annotations

import sys
from types import SimpleNamespace

import networkx
import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError, ModelError, ParameterError, UnsupportedError


class PgmpyModel(networkx.DiGraph):
    def __init__(self, edges=(), *, name="", cpds=()):
        super().__init__(edges, name=name)
        self.add_nodes_from(cpd.variables[0] for cpd in cpds)
        self.cpds = {cpd.variables[0]: cpd for cpd in cpds}

    def get_cpds(self, node):
        return self.cpds.get(node)


def tabular(values, **states):
    """As TabularCPD keeps it: one axis per variable, the node's own first."""
    return SimpleNamespace(
        variables=list(states), state_names=states, values=np.array(values, dtype=float)
    )


def linear(variable, beta, std, evidence=()):
    return SimpleNamespace(variables=[variable, *evidence], beta=np.array(beta), std=std)


AGE = tabular([0.2, 0.8], age=["young", "old"])
DOSE = tabular([0.5, 0.3, 0.2], dose=[0, 1, 2])
ILL_GIVEN = np.array([[[0.9, 0.8, 0.7], [0.6, 0.5, 0.4]], [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]])
ILL = tabular(ILL_GIVEN, ill=["no", "yes"], age=["young", "old"], dose=[0, 1, 2])
EDGES = [("age", "ill"), ("dose", "ill")]


def test_pgmpy_tables_have_the_variable_first_and_ours_last():
    net = bmc.io.from_pgmpy(PgmpyModel(EDGES, name="clinic", cpds=[AGE, DOSE, ILL]))
    assert (net.name, set(net)) == ("clinic", {"age", "dose", "ill"})
    assert net["ill"].parents == ("age", "dose")
    assert (net["age"].states, net["dose"].states) == (("young", "old"), (0, 1, 2))
    probs = bmc.io.to_networkx(net).nodes["ill"]["probs"]
    for a in range(2):
        for d in range(3):
            np.testing.assert_allclose(probs[a, d], ILL_GIVEN[:, a, d])


def test_pgmpy_states_of_a_parent_are_matched_by_name():
    swapped = tabular(
        ILL_GIVEN[:, ::-1, [2, 0, 1]], ill=["no", "yes"], age=["old", "young"], dose=[2, 0, 1]
    )
    plain = bmc.io.from_pgmpy(PgmpyModel(EDGES, cpds=[AGE, DOSE, ILL]))
    other = bmc.io.from_pgmpy(PgmpyModel(EDGES, cpds=[AGE, DOSE, swapped]))
    values = {"age": "young", "dose": 2, "ill": "yes"}
    assert other.log_prob(values) == pytest.approx(np.log(0.2 * 0.2 * 0.3))
    assert plain.log_prob(values) == pytest.approx(other.log_prob(values))


def test_pgmpy_linear_gaussians_become_normals():
    model = PgmpyModel(
        [("x", "y"), ("z", "y")],
        cpds=[linear("x", [1.0], 2.0), linear("z", [0.0], 1.0),
              linear("y", [0.5, 2.0, -1.0], 0.7, ["x", "z"])],
    )  # fmt: skip
    net = bmc.io.from_pgmpy(model)
    expected = bmc.Normal(0.5 + 2 * 3.0 - 1.0 * 4.0, 0.7).log_prob(2.0)
    alone = bmc.Normal(1.0, 2.0).log_prob(3.0) + bmc.Normal(0.0, 1.0).log_prob(4.0)
    assert net.log_prob({"x": 3.0, "z": 4.0, "y": 2.0}) == pytest.approx(expected + alone)
    assert net["y"].parents == ("x", "z")


@pytest.mark.parametrize(
    ("model", "error", "message"),
    [
        (networkx.DiGraph(), TypeError, r"DiGraph is no directed model of pgmpy .*get_cpds\(\)"),
        (object(), TypeError, "object is no directed model"),
        (PgmpyModel(EDGES, cpds=[AGE, ILL]), ModelError, "'dose' has no conditional density"),
        (PgmpyModel(EDGES[:1], cpds=[AGE, DOSE, ILL]), ModelError, r"are \['age'\]; .*check_model"),
        (PgmpyModel(cpds=[tabular([0.5, 0.5], a=[0, 1]), SimpleNamespace(variables=["b"])]),
         UnsupportedError, "'b' has a SimpleNamespace; only TabularCPD"),
        (PgmpyModel([(("x", 0), ("x", 1))]), UnsupportedError, "named by tuple.*unrolled"),
        (PgmpyModel(EDGES, cpds=[tabular([0.2, 0.8], age=["baby", "old"]), DOSE, ILL]), ModelError,
         r"the states \['young', 'old'\], but its own are \['baby', 'old'\]"),
        (PgmpyModel([("x", "b")], cpds=[linear("x", [0.0], 1.0),
                                        tabular(np.full((2, 2), 0.5), b=[0, 1], x=[0, 1])]),
         UnsupportedError, "the table of 'b' has the parent 'x', which is none itself"),
        (PgmpyModel([("x", "y")], cpds=[linear("x", [0.0], 1.0), linear("y", [1.0], 1.0, ["x"])]),
         ModelError, "'y' has 0 slopes for 1 parents"),
        (PgmpyModel(cpds=[tabular([0.5, 0.4], a=[0, 1])]), ParameterError, "'a'.*sum 0.9"),
    ],
    ids=["graph", "object", "no cpd", "edges", "noisy or", "dynamic", "states", "hybrid", "slopes",
         "rows"],
)  # fmt: skip
def test_pgmpy_models_without_a_counterpart_are_refused(model, error, message):
    with pytest.raises(error, match=message):
        bmc.io.from_pgmpy(model)


class AgrumNet:
    """Nodes are numbers; ``cpt[:]`` has the axes of ``names`` from the last to the first."""

    def __init__(self, *nodes):
        self._nodes = nodes

    def nodes(self):
        return set(range(len(self._nodes)))

    def variable(self, number):
        return self._nodes[number][0]

    def cpt(self, number):
        _, names, table = self._nodes[number]
        return type("Cpt", (), {"names": names, "__getitem__": lambda self, key: table[key]})()


def agrum_variable(kind, values):
    return SimpleNamespace(
        stype=lambda: kind,
        labels=lambda: tuple(map(str, values)),
        numerical=lambda k: float(values[k]),
        domainSize=lambda: len(values),
    )


def test_pyagrum_tables_have_their_axes_reversed():
    ill_age_dose = ILL_GIVEN  # axes: ill, age, dose
    bn = AgrumNet(
        (agrum_variable("Labelized", ["young", "old"]), ("age",), np.array([0.2, 0.8])),
        (agrum_variable("Range", [-1, 0, 1]), ("dose",), np.array([0.5, 0.3, 0.2])),
        (agrum_variable("Labelized", ["no", "yes"]), ("ill", "age", "dose"), ill_age_dose.T),
    )
    net = bmc.io.from_pyagrum(bn)
    assert net["ill"].parents == ("age", "dose")
    probs = bmc.io.to_networkx(net).nodes["ill"]["probs"]
    np.testing.assert_allclose(probs, np.moveaxis(ILL_GIVEN, 0, -1))
    values = {"age": "young", "dose": 1, "ill": "yes"}
    assert net.log_prob(values) == pytest.approx(np.log(0.2 * 0.2 * 0.3))


@pytest.mark.parametrize(
    ("kind", "values", "states"),
    [
        ("Labelized", ["no", "yes"], ("no", "yes")),
        ("Range", [-1, 0], (-1, 0)),
        ("Integer", [2, 9], (2, 9)),
        ("NumericalDiscrete", [0.5, 1.5], (0.5, 1.5)),
        ("Discretized", ["[0;1[", "[1;2.5]"], ("[0;1[", "[1;2.5]")),
    ],
)
def test_pyagrum_variables_keep_their_values(kind, values, states):
    net = bmc.io.from_pyagrum(
        AgrumNet((agrum_variable(kind, values), ("x",), np.array([0.5, 0.5])))
    )
    assert net["x"].states == states
    assert [type(s) for s in net["x"].states] == [type(s) for s in states]


@pytest.mark.parametrize(
    ("bn", "error", "message"),
    [
        (object(), TypeError, r"object is no discrete Bayes net \(it has no nodes\(\)\)"),
        (SimpleNamespace(isUtilityNode=None), UnsupportedError, "decisions and utilities"),
        (AgrumNet((agrum_variable("Continuous", [0, 1]), ("x",), np.ones(2) / 2)),
         UnsupportedError, "'x' is a variable of kind 'Continuous'; known are Labelized"),
        (AgrumNet((agrum_variable("Range", [0, 1]), ("x",), np.zeros(2))), ParameterError, "'x'"),
    ],
)  # fmt: skip
def test_pyagrum_nets_without_a_counterpart_are_refused(bn, error, message):
    with pytest.raises(error, match=message):
        bmc.io.from_pyagrum(bn)


def test_adapters_import_no_library():
    assert not {"pgmpy", "pyagrum"} & set(sys.modules)
    bmc.io.from_pgmpy(PgmpyModel(EDGES, cpds=[AGE, DOSE, ILL]))
    assert not {"pgmpy", "pyagrum"} & set(sys.modules)


def everything():
    net = bmc.BayesNet("all", plates={"k": 3, "n": None})
    net.input("u")
    net.add("a", bmc.Bernoulli(0.2), states=("no", "yes"))
    net.table("b", ["a"], [[0.3, 0.7], [0.4, 0.6]], states=(-1, 1))
    net.add("m", lambda b, u: bmc.MvNormal(np.stack([b * u, u + 0 * b], -1), np.eye(2)))
    net.add("c", bmc.Bernoulli([0.1, 0.2, 0.3]), plates="k")
    net.add("d", lambda c, a: (c == 1) & (a == "yes"), plates="k", states=(0, 1))
    net.add("x", lambda a: bmc.Normal(1.0 * (a == "yes"), 1.0), plates="n")
    net.potential("f", lambda a, b: 0.1 * b * (a == "yes"))
    return net


def test_to_networkx_says_what_nodes_are():
    net = everything()
    graph = bmc.io.to_networkx(net, inputs={"u": 1.5})
    assert isinstance(graph, networkx.DiGraph)
    assert graph.graph == {
        "name": "all", "plates": {"k": 3, "n": None}, "potentials": {"f": ("a", "b")},
    }  # fmt: skip
    assert set(graph.edges) == set(net.graph.edges)
    order = list(graph)
    assert all(order.index(parent) < order.index(child) for parent, child in graph.edges)
    kinds = {name: graph.nodes[name]["kind"] for name in graph}
    assert kinds.pop("u") == "input" and kinds.pop("d") == "deterministic"
    assert set(kinds.values()) == {"stochastic"}
    m, b, x = (graph.nodes[name] for name in "mbx")
    assert (m["event_shape"], m["is_discrete"], m["states"]) == ((2,), False, None)
    assert (m["parents"], x["plates"]) == (("b", "u"), ("n",))
    assert (b["event_shape"], b["is_discrete"], b["states"]) == ((), True, (-1, 1))
    assert [name for name in graph if "probs" in graph.nodes[name]] == ["a", "c", "b", "d"]


def test_to_networkx_tables_follow_their_parents():
    nodes = bmc.io.to_networkx(everything(), inputs={"u": 1.5}).nodes
    assert nodes["b"]["table_parents"] == ("a",)
    np.testing.assert_allclose(nodes["b"]["probs"], [[0.3, 0.7], [0.4, 0.6]])
    np.testing.assert_allclose(nodes["c"]["probs"], [[0.9, 0.1], [0.8, 0.2], [0.7, 0.3]])
    d = nodes["d"]
    assert (d["table_parents"], d["probs"].shape) == (("c", "a"), (2, 2, 3, 2))
    np.testing.assert_array_equal(d["probs"][..., 1, 1], [[0, 0], [0, 1]])
    with pytest.raises(ValueError, match="read-only"):
        nodes["b"]["probs"][0, 0] = 1.0
    bare = bmc.io.to_networkx(everything(), inputs={"u": 1.5}, tables=False)
    assert not [name for name in bare if "probs" in bare.nodes[name]]


def test_to_networkx_is_a_copy_and_knows_interventions():
    net = everything()
    graph = bmc.io.to_networkx(net.do(a="yes"), inputs={"u": 1.5})
    assert (graph.nodes["a"]["kind"], graph.nodes["a"]["parents"]) == ("fixed", ())
    np.testing.assert_array_equal(graph.nodes["a"]["probs"], [0, 1])
    graph.remove_node("b")
    assert "b" in net


def test_to_networkx_asks_for_inputs():
    with pytest.raises(EvidenceError, match="input 'u' has no value; pass inputs="):
        bmc.io.to_networkx(everything())
