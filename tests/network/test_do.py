"""Interventions: cut from the parents, fixed, and the given net untouched."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError, UnknownNodeError


def net():
    net = bmc.BayesNet(plates={"p": 3, "open": None})
    net.add("u", bmc.Bernoulli(0.5))
    net.add("a", lambda u: bmc.Bernoulli(0.1 + 0.8 * u), states=("no", "yes"))
    net.add("y", lambda a, u: bmc.Normal((a == "yes") + 10.0 * u, 1.0), plates="p")
    net.add("s", lambda y: y.sum("p"))
    return net


def test_do_is_not_seeing():
    n = net()
    done = n.do(a="yes")
    np.testing.assert_allclose(
        bmc.infer(done, {"y": [6.0] * 3}, engine=bmc.Exact()).probabilities("u"), [0.5, 0.5]
    )
    seen = bmc.infer(n, {"a": "yes", "y": [6.0] * 3}, engine=bmc.Exact()).probabilities("u")
    np.testing.assert_allclose(seen, [0.1, 0.9])
    assert done["a"].parents == () and done["a"].kind == "fixed"
    assert n["a"].parents == ("u",) and n["a"].kind == "stochastic"
    assert set(done.graph.edges) == set(n.graph.edges) - {("u", "a")}


def test_mapping_and_keywords_and_plates():
    n = net()
    a = n.do({"y": [1.0, 2.0, 3.0]}, a="no")
    draws = a.sample(5, rng=0)
    assert (draws["y"] == [1.0, 2.0, 3.0]).all() and (draws["s"] == 6.0).all()
    assert (draws["a"] == "no").all()
    assert (n.do(s=100.0).sample(2, rng=0)["s"] == 100.0).all()
    assert n.do(a="yes").do(u=1).sample(50, rng=0)["u"].min() == 1
    assert len(n.do()) == len(n)


def test_a_deterministic_node_takes_any_value():
    n = bmc.BayesNet()
    n.add("a", bmc.Bernoulli(0.5))
    n.add("d", lambda a: 2 * a)
    n.add("x", lambda d: bmc.Normal(d, 1.0))
    fixed = n.do(d=5)
    assert (fixed.sample(3, rng=0)["d"] == 5).all()
    np.testing.assert_allclose(
        fixed.log_prob({"a": 1, "x": 5.0}), np.log(0.5) - 0.5 * np.log(2 * np.pi)
    )


def test_the_given_value_stays_the_users():
    value = np.array([1.0, 2.0, 3.0])
    n = net().do(y=value)
    value[0] = 99.0
    assert n.sample(1, rng=0)["y"].tolist() == [[1.0, 2.0, 3.0]]
    assert value.flags.writeable


def test_log_prob_leaves_the_fixed_node_out():
    n = net().do(a="yes")
    got = n.log_prob({"u": 1, "y": [11.0] * 3})
    np.testing.assert_allclose(got, np.log(0.5) - 1.5 * np.log(2 * np.pi))


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"zz": 1}, UnknownNodeError, r"do\(zz=...\): the net has no node 'zz'"),
        ({"a": "maybe"}, EvidenceError, r"'a'.*'maybe' is not a state; the states are 'no', 'yes'"),
        ({"u": 2}, EvidenceError, r"'u'.*2 is not among the values 0, 1"),
        ({"y": [1.0, 2.0]}, EvidenceError, r"'y' has shape \(2,\).*make \(3,\)"),
        (
            {"y": [1.0, np.nan, 2.0]},
            EvidenceError,
            r"do\(y=...\): .*nan.*a value for every element",
        ),
        ({"y": [1.0, None, 2.0]}, EvidenceError, r"do\(y=...\): .*'y'.*a value for every element"),
        ({"y": np.zeros((2, 3))}, EvidenceError, r"do\(y=...\): shape \(2, 3\), not \(3,\)"),
    ],
)
def test_refusals(values, error, message):
    with pytest.raises(error, match=message):
        net().do(values)


def rated():
    n = bmc.BayesNet()
    n.add("rate", bmc.Gamma(2.0, 1.0))
    return n


OUTSIDE = r"do\(rate=...\): -1.* outside the support \(numbers >=? 0\)"


def test_outside_the_support():
    n = rated()
    with pytest.raises(EvidenceError, match=OUTSIDE):
        n.do(rate=-1.0)
    n.input("u")
    with pytest.raises(EvidenceError, match=r"do\(u=...\): 'u' is an input; pass it with inputs="):
        n.do(u=1.0)


def test_outside_the_support_beside_an_input():
    n = rated()
    n.input("u")
    with pytest.raises(EvidenceError, match=OUTSIDE):
        n.do(rate=-1.0)


def test_a_support_set_by_an_input_is_not_judged_without_it():
    n = bmc.BayesNet()
    n.input("trials")
    n.add("k", lambda trials: bmc.Binomial(trials, 0.5))
    n.add("x", lambda k: bmc.Normal(k, 1.0))
    assert n.do(k=5).sample(2, rng=0, inputs={"trials": 10})["k"].tolist() == [5, 5]


def test_do_in_a_plate_read_from_data():
    n = bmc.BayesNet(plates={"p": None})
    n.add("x", bmc.Normal(0.0, 1.0), plates="p")
    n.add("y", lambda x: bmc.Normal(x, 1.0), plates="p")
    assert n.do(x=[1.0, 2.0, 3.0, 4.0]).sample(2, rng=0)["y"].shape == (2, 4)


def test_evidence_on_a_fixed_node_is_refused():
    with pytest.raises(
        EvidenceError, match="evidence on 'a', which is a fixed .do. node and takes none"
    ):
        bmc.infer(net().do(a="yes"), {"a": "no"})
