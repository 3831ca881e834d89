"""What counts as evidence, what is missing, and every refusal with its message."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.support import nonnegative
from bayesmc.errors import EvidenceError
from bayesmc.network import pose


@pytest.fixture
def net():
    net = bmc.BayesNet(plates={"p": 3, "q": 2})
    net.add("z", bmc.Categorical([0.2, 0.3, 0.5]), states=("low", "mid", "high"))
    net.add("zs", bmc.Categorical([0.2, 0.3, 0.5]), plates="p", states=("low", "mid", "high"))
    net.add("spin", bmc.Bernoulli(0.5), plates="p", states=(-1, 1))
    net.add("die", bmc.DiscreteUniform(1, 6), plates="p")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("xs", bmc.Normal(0.0, 1.0), plates=("p", "q"))
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="p")
    net.add("rate", bmc.Gamma(2.0, 1.0), plates="p")
    net.add("count", bmc.Poisson(2.0), plates="p")
    net.add("share", bmc.Dirichlet(np.ones(3)))
    net.add("double", lambda x: 2 * x)
    net.add("twice", lambda count: 2 * count, plates="p")
    net.input("u")
    return net


def observed(net, **evidence):
    return pose(net, evidence, {"u": 1.0}).observed


def test_values_and_labels_of_every_kind(net):
    seen = observed(net, z="mid", zs=["low", "high", "mid"], spin=[-1, 1, -1], die=[1, 6, 3], x=2)
    assert seen["z"].value == 1 and seen["z"].mask is None
    assert seen["zs"].value.tolist() == [0, 2, 1]
    assert seen["spin"].value.tolist() == [0, 1, 0]
    assert seen["die"].value.tolist() == [0, 5, 2]
    assert seen["x"].value.dtype == float
    for labels in (
        np.array(["low", "high", "mid"]),
        np.array(["low", "high", "mid"], dtype=object),
    ):
        assert observed(net, zs=labels)["zs"].value.tolist() == [0, 2, 1]
    draws = net.sample(4, rng=0, inputs={"u": 0.0})  # what a net gives, it takes
    one = {
        name: draws[name][0]
        for name in ("z", "zs", "spin", "die", "x", "xs", "v", "count", "share")
    }
    again = observed(net, **one)
    assert again["zs"].value.tolist() == draws["zs"][0].codes.tolist()


@pytest.mark.parametrize(
    ("name", "value", "mask"),
    [
        ("xs", [[1.0, np.nan], [np.nan, np.nan], [2.0, 3.0]], [[1, 0], [0, 0], [1, 1]]),
        (
            "xs",
            np.ma.masked_array(np.zeros((3, 2)), [[0, 1], [1, 1], [0, 0]]),
            [[1, 0], [0, 0], [1, 1]],
        ),
        ("die", [1, None, 6], [1, 0, 1]),
        ("die", [1, np.nan, 6], [1, 0, 1]),
        ("die", np.ma.masked_array([1, 77, 6], [0, 1, 0]), [1, 0, 1]),
        ("zs", ["low", None, "mid"], [1, 0, 1]),
        ("zs", ["low", np.nan, "mid"], [1, 0, 1]),
        ("zs", np.ma.masked_array(np.array(["low", "??", "mid"]), [0, 1, 0]), [1, 0, 1]),
        ("v", [[1.0, 2.0], [np.nan, np.nan], [0.0, 0.0]], [1, 0, 1]),
        ("count", [1, np.nan, 0], [1, 0, 1]),
        ("spin", [-1, None, 1], [1, 0, 1]),
    ],
)
def test_missing_entries_of_a_plated_node(net, name, value, mask):
    seen = observed(net, **{name: value})[name]
    np.testing.assert_array_equal(seen.mask, np.array(mask, dtype=bool))
    assert np.isfinite(seen.value).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [("x", None), ("z", None), ("xs", None), ("xs", np.full((3, 2), np.nan)), ("zs", [None] * 3)],
)
def test_wholly_unobserved(net, name, value):
    assert name not in observed(net, **{name: value})


def test_draws_of_a_partly_observed_node_keep_what_was_seen(net):
    posterior = bmc.infer(
        net,
        {"xs": [[1.0, np.nan], [np.nan, np.nan], [2.0, 3.0]], "count": [4, np.nan, 0]},
        inputs={"u": 0.0},
        engine=bmc.LikelihoodWeighting(200),
        rng=0,
    )
    draws = posterior["xs"]
    assert draws.shape == (1, 200, 3, 2)
    assert (draws[..., 0, 0] == 1.0).all() and (draws[..., 2, :] == [2.0, 3.0]).all()
    assert draws[..., 1, :].std() > 0.5
    assert posterior["count"].dtype.kind in "iu"
    assert (posterior["count"][..., [0, 2]] == [4, 0]).all()


def test_counts_stay_integers_and_may_gather():
    net = bmc.BayesNet(plates={"k": 20, "p": 3})
    net.add("m", bmc.Normal(0.0, 1.0), plates="k")
    net.add("n", bmc.Poisson(2.0), plates="p")
    net.add("y", lambda m, n: bmc.Normal(m[np.minimum(n, 19)], 1.0), plates="p")
    for evidence in ([1.0, 2.0, 3.0], [1.0, np.nan, 3.0]):
        bmc.infer(net, {"n": evidence}, engine=bmc.LikelihoodWeighting(500), rng=0)


REFUSED = {
    "unknown": ({"zz": 1}, r"evidence on 'zz', which the net does not have"),
    "close": ({"rat": 1}, r"evidence on 'rat'.*did you mean 'rate'"),
    "deterministic": (
        {"twice": [2, 2, 2]},
        r"evidence on 'twice', which is a deterministic node and takes none; observe",
    ),
    "input": ({"u": 1.0}, r"evidence on 'u', which is an input node"),
    "label": ({"z": "lo"}, r"'lo' is not a state; the states are 'low', 'mid', 'high'"),
    "position": ({"z": 1}, r"1 is not a state.*; give the label, not its position"),
    "label in plate": ({"zs": ["low", "x", "mid"]}, r"'zs'.*'x' is not a state; the states are"),
    "state": ({"spin": [-1, 0, 1]}, r"'spin'.*0 is not among the values -1, 1"),
    "die": ({"die": [0, 1, 2]}, r"'die'.*0 is not among the values 1, 2, 3, 4, 5, 6"),
    "die fraction": ({"die": [1.5, 1, 2]}, r"'die'.*1\.5 is not among the values"),
    "text for number": ({"x": "high"}, r"evidence on 'x': 'high' is not among its values"),
    "text for numbers": ({"die": ["a", 1, 2]}, r"evidence on 'die'"),
    "shape": (
        {"xs": np.zeros((2, 3))},
        r"evidence on 'xs' has shape \(2, 3\).*p=3, q=2.*make \(3, 2\)",
    ),
    "scalar for plate": ({"die": 3}, r"evidence on 'die' has shape \(\).*p=3.*make \(3,\)"),
    "plate for scalar": (
        {"x": [1.0, 2.0]},
        r"evidence on 'x' has shape \(2,\).*plates \(none\).*make \(\)",
    ),
    "batch": ({"die": [[1, 2, 3]] * 4}, r"evidence on 'die' has shape \(4, 3\)"),
    "lone NaN": ({"x": np.nan}, r"evidence on 'x' is nan, which means nothing.*leave it out"),
    "infinity": (
        {"xs": np.full((3, 2), np.inf)},
        r"evidence on 'xs' is inf at index \(0, 0\); it must be finite",
    ),
    "infinity alone": ({"x": -np.inf}, r"evidence on 'x' is -inf; it must be finite"),
    "support": (
        {"rate": [1.0, -2.0, 3.0]},
        r"evidence on 'rate' is -2\.0 at index 1, outside its support \(numbers >=? 0\)",
    ),
    "count": (
        {"count": [1, -1, 0]},
        r"evidence on 'count' is -1 at index 1, outside its support \(integers >= 0\)",
    ),
    "fraction": (
        {"count": [1, 0.5, 0]},
        r"evidence on 'count' is 0\.5 at index 1, outside its support",
    ),
    "simplex": (
        {"share": [0.5, 0.5, 0.5]},
        r"evidence on 'share'.*outside its support \(vectors of probabilities that sum to 1\)",
    ),
    "part of a vector": (
        {"share": [0.5, np.nan, 0.2]},
        r"evidence on 'share': of one vector the entry at 1 is missing.*split the vector",
    ),
}


@pytest.mark.parametrize(("evidence", "message"), REFUSED.values(), ids=REFUSED)
def test_refused_with_the_reason(net, evidence, message):
    with pytest.raises(EvidenceError, match=message):
        bmc.infer(net, evidence, inputs={"u": 0.0})


def test_evidence_that_is_no_mapping(net):
    for bad in ([("x", 1.0)], "x", 3.0):
        with pytest.raises(
            EvidenceError, match="evidence is a .*; give a dict from node name to value"
        ):
            bmc.infer(net, bad, inputs={"u": 0.0})


INPUTS = {
    "missing": ({}, r"input 'u' has no value; pass inputs=\{'u': value\}"),
    "unknown": (
        {"u": 1.0, "w": 1.0},
        r"inputs= gives 'w', which is not a declared input; the inputs are \['u'\]",
    ),
    "node": ({"u": 1.0, "x": 1.0}, r"inputs= gives 'x', which is not a declared input"),
    "shape": ({"u": [1.0, 2.0]}, r"input 'u' has shape \(2,\).*make \(\)"),
    "NaN": ({"u": np.nan}, r"input 'u' is nan at index \(\); inputs must be finite"),
    "text": ({"u": "a"}, r"input 'u' has dtype .*; give numbers"),
}


@pytest.mark.parametrize(("inputs", "message"), INPUTS.values(), ids=INPUTS)
def test_inputs_refused_with_the_reason(net, inputs, message):
    for use in (
        lambda: bmc.infer(net, {}, inputs=inputs),
        lambda: net.sample(1, inputs=inputs),
        lambda: net.validate(inputs),
    ):
        with pytest.raises(EvidenceError, match=message):
            use()


def test_evidence_of_probability_zero_is_an_error():
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("b", lambda a: bmc.Bernoulli(np.where(a == 1, 1.0, 0.0)))
    for engine in (bmc.Exact(), bmc.LikelihoodWeighting(100), None):
        with pytest.raises(EvidenceError, match="probability.*zero|zero"):
            bmc.infer(net, {"a": 0, "b": 1}, engine=engine, rng=0)


def test_a_support_that_depends_on_parents_is_left_to_the_density():
    net = bmc.BayesNet()
    net.add("top", bmc.Gamma(5.0, 1.0))
    net.add("u", lambda top: bmc.Uniform(0.0, top))
    posterior = bmc.infer(net, {"u": 4.0}, engine=bmc.LikelihoodWeighting(2000), rng=0)
    assert posterior.probability(lambda top: top >= 4.0) == pytest.approx(1.0)


def test_an_interval_holds_for_every_component_of_a_vector(monkeypatch):
    monkeypatch.setattr(bmc.MvNormal, "support", nonnegative)
    net = bmc.BayesNet(plates={"k": 2})
    net.add("v", bmc.MvNormal(np.zeros(3), np.eye(3)), plates="k")
    bad = np.ones((2, 3))
    assert pose(net, {"v": bad}).observed["v"].mask is None
    bad[1, 2] = -1.0
    with pytest.raises(EvidenceError, match="outside its support"):
        pose(net, {"v": bad})
