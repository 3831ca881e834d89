"""Functions that read a name from around them which has changed since they were declared are an error."""

import copy

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ModelError

RATE = 1.0
MATRIX = np.eye(2)


def with_rate(m):
    return bmc.Normal(m, RATE)


def loop_net():
    """The model of the issue."""
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    for i in range(3):
        net.add(f"y{i}", lambda m: bmc.Normal(m + 10 * i, 1))  # noqa: B023
    return net


@pytest.mark.parametrize(
    "ask",
    [
        lambda net: bmc.infer(net, {"y0": 1.0}),
        lambda net: bmc.infer(net, {"y0": 1.0}, engine=bmc.LikelihoodWeighting(100), rng=0),
        lambda net: net.sample(2, rng=0),
        lambda net: net.validate(),
        lambda net: net.do(m=1.0),
        lambda net: net.log_prob({"m": 0.0, "y0": 0.0, "y1": 0.0, "y2": 0.0}),
        lambda net: net["y0"],
    ],
)
def test_loop_variable_of_a_closure(ask):
    with pytest.raises(ModelError, match=r"node 'y0'.*'i'.* was 0 .* is 2 now; .*i=i"):
        ask(loop_net())


def test_loop_variable_as_a_default_keeps_its_value():
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    for i in range(3):
        net.add(f"y{i}", lambda m, i=i: bmc.Normal(m + 10 * i, 1))
    assert bmc.infer(net, engine=bmc.Exact()).mean("y1") == pytest.approx(10.0)


def test_loop_over_objects_and_arrays():
    for things in ([np.ones(2), np.ones(3)], [{"at": 1.0}, {"at": 2.0}], ["a", "b"]):
        net = bmc.BayesNet()
        for thing in things:
            net.add(f"y{len(net)}", lambda: bmc.Normal(float(len(str(thing))), 1.0))  # noqa: B023
        with pytest.raises(ModelError, match=r"node 'y0'.*thing=thing"):
            net.sample(1)


def test_global_that_changes_between_two_questions(monkeypatch):
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("y", lambda m: with_rate(m))  # by way of a function that it calls
    posterior = bmc.infer(net, {"y": 1.0}, engine=bmc.LikelihoodWeighting(1000), rng=0)
    monkeypatch.setitem(globals(), "RATE", 2.0)
    for ask in (lambda: bmc.infer(net, {"y": 1.0}), lambda: posterior.predict("y", rng=0)):
        with pytest.raises(ModelError, match=r"node 'y'.*'RATE'.* was 1.0 .* is 2.0 now"):
            ask()
    monkeypatch.setitem(globals(), "RATE", 1.0)
    assert bmc.infer(net, {"y": 1.0}).mean("m") == pytest.approx(0.5)


def test_array_written_over_and_array_put_in_its_place(monkeypatch):
    net = bmc.BayesNet()
    net.add("m", lambda: bmc.MvNormal(np.zeros(2), MATRIX))
    monkeypatch.setitem(globals(), "MATRIX", np.eye(2))
    net.sample(1)  # another array of the same numbers
    MATRIX[0, 0] = 3.0
    with pytest.raises(ModelError, match=r"node 'm'.*'MATRIX'"):
        net.sample(1)


def test_template_and_online_filter():
    dbn = bmc.DynamicBayesNet()
    scale = 1.0
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, scale), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    engine = bmc.KalmanFilter()
    belief = engine.step(engine.start(dbn), {"y": 1.0})
    net = dbn.unroll(2)
    scale = 2.0
    for ask in (
        lambda: bmc.filter(dbn, {"y": [1.0, 2.0]}),
        lambda: engine.step(belief, {"y": 2.0}),
        lambda: net.sample(1),
        lambda: dbn.sample(2),
    ):
        with pytest.raises(ModelError, match=r"'x.*'scale'.* was 1.0 .* is 2.0 now"):
            ask()


def test_factors_and_potentials():
    graph = bmc.FactorGraph(plates={"site": 3})
    graph.variable("s", (-1, 1), plates="site")
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    for weight in (1.0, 2.0):
        graph.factor(lambda s: weight * s, scope="s")  # noqa: B023
        net.potential(f"p{weight:g}", lambda a: -weight * a**2)  # noqa: B023
    with pytest.raises(ModelError, match=r"'factor_0'.*weight=weight"):
        bmc.infer(graph, engine=bmc.Exact())
    with pytest.raises(ModelError, match=r"'p1'.*weight=weight"):
        net.log_prob({"a": 0.0})


def test_what_may_change():
    """Functions, modules, names the function sets itself, objects that change inside, equal values."""
    calls, helper, seen, names = [], lambda m: m, 0, np

    class Settings:
        scale = 1.0

        def __init__(self):
            self.shift = np.zeros(2)

    settings = Settings()

    def y(m):
        nonlocal seen
        seen += 1
        calls.append(seen)
        return bmc.Normal(helper(m) + names.sum(settings.shift), settings.scale)

    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.node(y)
    helper = lambda m: 1.0 * m  # noqa: E731
    names = copy
    names, settings = np, Settings()
    assert net.sample(3, rng=0)["y"].shape == (3,)
    assert calls
