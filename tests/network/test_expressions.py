"""Densities of models as expressions: the zoo is followed, and a wrong reading is never taken."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import Program, as_expression, elementwise, reduction
from bayesmc.network import expressions
from bayesmc.network.expressions import Followed, Opaque, density
from tests.network.zoo import ZOO, build


def read(net, inputs=None):
    model = net.model({}, inputs or {})
    return {n: density(model, n) for n, node in model.nodes.items() if node.links}


@pytest.mark.parametrize("name", ZOO)
def test_the_zoo_is_followed(name):
    net, inputs = build(name)
    for node, found in read(net, inputs).items():
        if isinstance(found, Opaque):
            assert "vectorize=True" in found.reason or "Density" in found.reason, (
                node,
                found.reason,
            )


@pytest.mark.parametrize("name", ZOO)
def test_log_densities_are_those_of_the_model(name):
    """Summed over the nodes they are the joint density, and their gradient is that of differences."""
    net, inputs = build(name)
    model = net.model({}, inputs or {})
    total = as_expression(0.0)
    for node in model.nodes.values():
        if node.is_stochastic and node.kind == "stochastic":
            try:
                own = expressions.log_density_of(model, node.name)
            except TraceError as error:
                pytest.skip(str(error))
            own = reduction(np.add, own, range(len(own.shape)))
            total = elementwise(np.add, total, own)
    draws = net.sample(3, rng=1, **({"inputs": inputs} if inputs else {}))
    stored = {
        n: model[n].domain.encode(v) if model[n].domain is not None else v
        for n, v in draws.items()
        if n in total.leaves
    }
    for n in total.leaves - set(stored):
        stored[n] = np.asarray((inputs or {})[n])
    (found,) = Program([total])(stored)
    expected = net.log_prob(draws, **({"inputs": inputs} if inputs else {}))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_deterministic_nodes_are_substituted():
    net = bmc.BayesNet(plates={"point": 4})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: 2 * a)
    net.add("c", lambda b: np.exp(b) + np.arange(4.0), plates="point")
    net.add("y", lambda c: bmc.Normal(c, 1.0), plates="point")
    assert read(net)["y"].leaves == {"a"}


def test_an_opaque_deterministic_node_is_a_call():
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: 2.0 if a > 0 else -1.0, vectorize=True)
    net.add("y", lambda b: bmc.Normal(b + 1, 1.0))
    found = read(net)
    assert isinstance(found["b"], Opaque)
    assert found["b"].leaves == {"a"}
    assert isinstance(found["y"], Followed)
    assert found["y"].leaves == {"a"}


def test_a_density_that_closes_over_parents_is_not_taken_for_a_constant():
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a: bmc.Density(lambda t: -0.5 * (t - a) ** 2, support="real"))
    (found,) = read(net).values()
    assert isinstance(found, Opaque)
    assert "Density" in found.reason


def test_a_function_that_shows_another_face_to_stand_ins_is_opaque():
    """Negative control: the same function without the lie is followed."""

    def lying(a):
        return bmc.Normal(a if isinstance(a, np.ndarray) else 2 * a, 1.0)

    for function, kind in ((lying, Opaque), (lambda a: bmc.Normal(2 * a, 1.0), Followed)):
        net = bmc.BayesNet()
        net.add("a", bmc.Normal(0.0, 1.0))
        net.add("y", function)
        assert isinstance(read(net)["y"], kind)


def test_a_wrong_reading_is_never_taken(monkeypatch):
    """A rule of the tracer that is wrong makes functions opaque, not answers wrong."""
    wrong = dict(expressions.Program.__dict__)
    original = wrong["__call__"]

    def off(self, values):
        return [v + 1e-6 for v in original(self, values)]

    monkeypatch.setattr(expressions.Program, "__call__", off)
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a: bmc.Normal(a, 1.0))
    assert isinstance(read(net)["y"], Opaque)


def growth(steps, drift):
    dbn = bmc.DynamicBayesNet()

    @dbn.node(initial=bmc.Normal(0.0, 1.0))
    def x(x_prev, t):
        return bmc.Normal(drift(x_prev, t), 1.0)

    model = dbn.unroll(steps).model({}, {})
    return model, [density(model, f"x[{t}]") for t in range(1, steps)]


def test_slices_share_a_reading():
    """Of the index of the slice, too, where the function can be followed for all of them at once."""
    for drift, shared in (
        (lambda x, t: 0.5 * x + np.cos(1.2 * t), True),
        (lambda x, t: x if t % 2 else -x, False),
        (lambda x, t: x + 10**t % 7, False),  # other numbers as integers of 64 bits
    ):
        model, found = growth(30, drift)
        assert all(isinstance(f, Followed) for f in found)
        assert (len({id(f.reading) for f in found}) == 1) == shared
        values = {f"x[{t}]": np.array([0.3, -2.0]) for t in range(30)}
        for t, f in enumerate(found, 1):
            (loc, _) = Program(f.result.parameters.values())(values)
            np.testing.assert_allclose(loc, drift(values["x[0]"], t), rtol=1e-15)


def test_a_number_at_which_the_reading_is_wrong_is_noticed():
    """Negative control: t = 19 alone differs, which no stand-in for numbers shows."""

    def lying(x, t):
        return x + (100.0 if isinstance(x, np.ndarray) and np.all(t == 19) else 0.0)

    _, found = growth(24, lying)
    assert [t for t, f in enumerate(found, 1) if isinstance(f, Opaque)] == [19]


def test_potentials_are_followed():
    graph = bmc.FactorGraph(plates={"site": 6})
    graph.variable("s", (-1, 1), plates="site")
    graph.variable("f", "real")
    graph.factor(lambda a, b: 0.4 * a * b, scope=("s", "s"), index=(np.arange(5), np.arange(1, 6)))
    graph.factor(lambda f: -(f**2), scope="f")
    graph.factor(lambda s, f: s * f, scope=("s", "f"))
    model = graph.model({}, {})
    values = {"s": np.array([[0, 1, 1, 0, 1, 0], [1, 1, 1, 0, 0, 0]]), "f": np.array([0.5, -1.0])}
    for name in model.potentials:
        (found,) = Program([expressions.log_factor_of(model, name)])(values)
        np.testing.assert_allclose(found, model.potential(name, values, total=False), rtol=1e-15)


def test_deterministic_nodes_may_follow_from_each_other_a_thousand_times():
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("s[0]", lambda x: x)
    step = lambda s, x: 0.5 * s + x  # noqa: E731
    for t in range(1, 1000):
        net.add(f"s[{t}]", step, parents=[f"s[{t - 1}]", "x"])
    net.add("y", lambda s: bmc.Normal(s, 1.0), parents=["s[999]"])
    found = density(net.model({}, {}), "y")
    (loc, _) = Program(found.result.parameters.values())({"x": np.array([1.0, 3.0])})
    np.testing.assert_allclose(loc, [2.0, 6.0])
