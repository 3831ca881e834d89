"""``read`` and ``write``: the format follows the name, and nets survive the way through a file."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import bayesmc as bmc
from bayesmc.errors import FileFormatError, UnsupportedError
from bayesmc.io.bif import format_bif
from bayesmc.io.record import TableNode
from bayesmc.io.xmlbif import format_xmlbif
from bayesmc.testing import random_net, session

SUFFIXES = [".bif", ".xmlbif", ".bifxml", ".xml"]
MARKS = {".bif": "probability (", ".xmlbif": "<TABLE>", ".bifxml": "<TABLE>", ".xml": "<TABLE>"}


def sprinkler():
    net = bmc.BayesNet("sprinkler")
    net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    net.add("wet", lambda rain: bmc.Categorical(np.where(rain == "yes", 0.9, 0.1)[..., None]
            * np.array([1.0, -1.0]) + np.array([0.0, 1.0])), states=("dry", "wet"))  # fmt: skip
    return net


def joint(net):
    """Probabilities of all joint states, nodes in alphabetical order, states as text."""
    nodes = bmc.io.to_networkx(net, tables=False).nodes
    states = {name: nodes[name]["states"] for name in sorted(net)}
    codes = np.indices([len(own) for own in states.values()]).reshape(len(states), -1)
    values = {
        name: np.array(own)[code] for (name, own), code in zip(states.items(), codes, strict=True)
    }
    order = {name: tuple(map(str, own)) for name, own in states.items()}
    return order, np.exp(net.log_prob(values))


@pytest.mark.parametrize("suffix", [s + gz for s in SUFFIXES for gz in ("", ".gz", ".GZ")])
def test_the_name_decides_the_format(tmp_path, suffix):
    path = tmp_path / f"garden.v2{suffix}"
    bmc.io.write(sprinkler(), path)
    data = path.read_bytes()
    assert (data[:2] == b"\x1f\x8b") == suffix.lower().endswith(".gz")
    text = (gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data).decode()
    assert MARKS[suffix.lower().removesuffix(".gz")] in text
    net = bmc.io.read(str(path))
    assert net.name == "garden"
    np.testing.assert_allclose(joint(net)[1], joint(sprinkler())[1])


def test_equal_nets_make_equal_files(tmp_path):
    for path in (tmp_path / "a.xml.gz", tmp_path / "b.xml.gz"):
        bmc.io.write(sprinkler(), path)
    assert (tmp_path / "a.xml.gz").read_bytes() == (tmp_path / "b.xml.gz").read_bytes()


@pytest.mark.parametrize("call", [bmc.io.read, lambda path: bmc.io.write(sprinkler(), path)])
@pytest.mark.parametrize("name", ["net.json", "net.gz", "bif", "net.bif.zip"])
def test_other_names_are_refused_with_those_known(tmp_path, call, name):
    with pytest.raises(FileFormatError, match=r"formats known here: \.bif, \.xmlbif, .*\.gz"):
        call(tmp_path / name)
    assert not list(tmp_path.iterdir())


@given(seed=st.integers(0, 2**32), suffix=st.sampled_from(SUFFIXES))
@settings(max_examples=session.scaled(60, 5))
def test_random_nets_round_trip(tmp_path_factory, seed, suffix):
    net = random_net(seed, nodes=(1, 5))
    path = tmp_path_factory.mktemp("nets") / f"net{suffix}"
    bmc.io.write(net, path)
    again = bmc.io.read(path)
    assert again.nodes == net.nodes
    (states, probs), (states_again, probs_again) = joint(net), joint(again)
    assert states_again == states
    np.testing.assert_allclose(probs_again, probs, rtol=1e-12, atol=0)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_order_of_declaration_is_kept(tmp_path, suffix):
    net = bmc.BayesNet("backwards")
    net.table("wet", ["rain"], [[0.9, 0.1], [0.2, 0.8]], states=("no", "yes"))
    net.table("rain", probs=[0.8, 0.2], states=("no", "yes"))
    assert list(net.model().nodes) == ["rain", "wet"]
    for path in (tmp_path / "one.bif", tmp_path / f"two{suffix}"):
        bmc.io.write(net, path)
        net = bmc.io.read(path)
        assert net.nodes == ("wet", "rain")
    np.testing.assert_allclose(bmc.infer(net, {"wet": "yes"}).probabilities("rain"), [1 / 3, 2 / 3])


@pytest.mark.parametrize("suffix", [".bif", ".xml"])
def test_a_cycle_is_found_with_its_line(tmp_path, suffix):
    nodes = [
        TableNode(name, ("no", "yes"), parents, np.full((2,) * len(parents) + (2,), 0.5))
        for name, parents in {"a": ("c",), "b": ("a",), "c": ("b",), "d": ("a", "c")}.items()
    ]
    path = tmp_path / f"ring{suffix}"
    path.write_text({".bif": format_bif, ".xml": format_xmlbif}[suffix](nodes))
    with pytest.raises(FileFormatError, match="parents form a cycle: a -> b -> c -> a;") as caught:
        bmc.io.read(path)
    start = {".bif": "probability ( a ", ".xml": "<DEFINITION>"}[suffix]
    lines = path.read_text().splitlines()
    first = next(k for k, line in enumerate(lines, 1) if line.startswith(start))
    assert (caught.value.path, caught.value.line) == (path, first)
    assert "_prev" not in str(caught.value)


@pytest.mark.parametrize("wrong", ["net.bif", None, {"a": 1}])
def test_what_is_no_net_is_refused_in_words(tmp_path, wrong):
    kind = type(wrong).__name__
    with pytest.raises(TypeError, match=rf"write\(net, path\): net is a {kind}, .*give a BayesNet"):
        bmc.io.write(wrong, tmp_path / "net.bif")
    with pytest.raises(TypeError, match=rf"to_networkx\(net\): net is a {kind}, .*give a BayesNet"):
        bmc.io.to_networkx(wrong)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("declare", "message"),
    [
        (lambda net: net.add("x", bmc.Normal(0, 1)), "'x' is stochastic without a finite set"),
        (lambda net: net.add("x", bmc.Poisson(3.0)), "'x' is stochastic without a finite set"),
        (lambda net: net.add("x", bmc.Bernoulli(0.5), plates="p"), "'x' is in a plate"),
        (lambda net: net.potential("x", lambda rain: 1.0 * (rain == "yes")), "no potentials"),
    ],
)
@pytest.mark.parametrize("suffix", [".bif", ".xml"])
def test_what_a_format_cannot_hold_is_refused(tmp_path, declare, message, suffix):
    net = bmc.BayesNet(plates={"p": 2})
    net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    declare(net)
    with pytest.raises(UnsupportedError, match=message) as caught:
        bmc.io.write(net, tmp_path / f"x{suffix}")
    assert {".bif": " BIF ", ".xml": " XMLBIF "}[suffix] in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_bad_parameters_at_a_configuration_are_not_written(tmp_path):
    net = bmc.BayesNet()
    net.table("a", probs=[1.0, 0.0], states=("no", "yes"))
    net.add("b", lambda a: bmc.Bernoulli(np.where(a == "yes", -1.0, 0.5)))
    assert bmc.infer(net, {}, engine=bmc.Exact()).probabilities("b")[0] == 0.5
    with pytest.raises(UnsupportedError, match="'b' has bad parameters at a='yes'"):
        bmc.io.write(net, tmp_path / "x.bif")


def test_interventions_and_deterministic_nodes_are_written_as_tables(tmp_path):
    net = sprinkler()
    net.add("umbrella", lambda rain: (rain == "yes") * 1, states=("left", "taken"))
    bmc.io.write(net.do(rain="yes"), tmp_path / "x.xml")
    again = bmc.io.read(tmp_path / "x.xml")
    posterior = bmc.infer(again, {}, engine=bmc.Exact())
    np.testing.assert_array_equal(posterior.probabilities("rain"), [0, 1])
    np.testing.assert_array_equal(posterior.probabilities("umbrella"), [0, 1])
    np.testing.assert_allclose(posterior.probabilities("wet"), [0.9, 0.1])
