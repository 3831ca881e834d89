"""The same nets in pgmpy and pyAgrum, where they are installed: files both ways, adapters, answers.

``make peers`` installs both in an environment of their own; here each test skips without its library.
"""

from __future__ import annotations

import logging
import re
import warnings

import networkx
import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.io.bif import read_text
from bayesmc.testing import random_net
from tests.io.test_files import joint

SEEDS = range(8)
#: aGrUM writes six significant digits
SIX_DIGITS = 1e-5

pytestmark = pytest.mark.filterwarnings("default")  # the libraries' own warnings are theirs


@pytest.fixture(scope="module")
def pgmpy():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        package = pytest.importorskip("pgmpy")
        pytest.importorskip("pgmpy.models")
        pytest.importorskip("pgmpy.readwrite")
    logging.getLogger("pgmpy").setLevel(logging.ERROR)
    return package


@pytest.fixture(scope="module")
def gum():
    return pytest.importorskip("pyagrum")


def discrete(seed):
    return random_net(seed, nodes=(3, 6), deterministic=False)


def check_equal(net, other, tolerance=1e-12):
    """The joint distributions agree, states compared as text."""
    (states, probs), (states_other, probs_other) = joint(net), joint(other)
    assert states_other == states
    np.testing.assert_allclose(probs_other, probs, rtol=0, atol=tolerance)


@pytest.mark.parametrize("seed", SEEDS)
def test_pgmpy_reads_our_files_and_we_read_its(tmp_path, pgmpy, seed):
    net = discrete(seed)
    bmc.io.write(net, tmp_path / "ours.xml")
    model = pgmpy.readwrite.XMLBIFReader(str(tmp_path / "ours.xml")).get_model()
    check_equal(net, bmc.io.from_pgmpy(model))
    pgmpy.readwrite.XMLBIFWriter(model).write(str(tmp_path / "theirs.xml"))
    states, probs = joint(bmc.io.read(tmp_path / "theirs.xml"))
    np.testing.assert_allclose(probs, joint(net)[1], rtol=0, atol=1e-12)
    # pgmpy's writer puts an underscore for what is no letter or digit
    spelled = {
        name: tuple(re.sub(r"\W", "_", s) for s in own) for name, own in joint(net)[0].items()
    }
    assert states == spelled


@pytest.mark.parametrize("seed", SEEDS)
def test_pyagrum_reads_our_files_and_we_read_its(tmp_path, gum, seed):
    net = discrete(seed)
    bmc.io.write(net, tmp_path / "ours.bifxml")
    bn = gum.loadBN(str(tmp_path / "ours.bifxml"))
    check_equal(net, bmc.io.from_pyagrum(bn))
    gum.saveBN(bn, str(tmp_path / "theirs.bifxml"))
    check_equal(net, bmc.io.read(tmp_path / "theirs.bifxml"), SIX_DIGITS)


@pytest.mark.parametrize("seed", SEEDS)
def test_pyagrum_answers_as_we_do(tmp_path, gum, seed):
    net = discrete(seed)
    bmc.io.write(net, tmp_path / "x.bifxml")
    bn = gum.loadBN(str(tmp_path / "x.bifxml"))
    engine = gum.LazyPropagation(bn)
    posterior = bmc.infer(net, {}, engine=bmc.Exact())
    for name in net:
        np.testing.assert_allclose(
            posterior.probabilities(name), engine.posterior(name).toarray(), atol=1e-9
        )


def test_pgmpy_tables_with_unsorted_evidence(pgmpy):
    from pgmpy.factors.discrete import TabularCPD
    from pgmpy.inference import VariableElimination
    from pgmpy.models import DiscreteBayesianNetwork

    rng = np.random.default_rng(0)
    states = {"a": ["x", "y"], "b": [0, 1, 2], "c": ["n", "p"]}
    model = DiscreteBayesianNetwork([("a", "c"), ("b", "c")])
    model.add_cpds(
        TabularCPD("a", 2, [[0.2], [0.8]], state_names={"a": states["a"]}),
        TabularCPD("b", 3, [[0.2], [0.3], [0.5]], state_names={"b": states["b"]}),
        TabularCPD("c", 2, rng.dirichlet([1, 1], 6).T, ["b", "a"], [3, 2], state_names=states),
    )
    assert model.check_model()
    net = bmc.io.from_pgmpy(model)
    for evidence in ({"b": 2}, {"a": "y"}, {"a": "x", "b": 0}):
        theirs = VariableElimination(model).query(["c"], evidence, show_progress=False)
        ours = bmc.infer(net, evidence, engine=bmc.Exact()).probabilities("c")
        np.testing.assert_allclose(ours, theirs.values, atol=1e-12)


def test_pgmpy_linear_gaussians_have_the_same_joint(pgmpy):
    from pgmpy.factors.continuous import LinearGaussianCPD
    from pgmpy.models import LinearGaussianBayesianNetwork

    model = LinearGaussianBayesianNetwork([("x", "y"), ("z", "y")])
    model.add_cpds(
        LinearGaussianCPD("x", [1.0], 2.0),
        LinearGaussianCPD("z", [0.0], 1.0),
        LinearGaussianCPD("y", [0.5, 2.0, -1.0], 0.7, ["x", "z"]),
    )
    mean, cov = model.to_joint_gaussian()
    order = list(networkx.topological_sort(model))
    point = np.array([0.3, -0.7, 1.1])
    ours = bmc.io.from_pgmpy(model).log_prob(dict(zip(order, point, strict=True)))
    assert ours == pytest.approx(bmc.MvNormal(mean, cov).log_prob(point))


def test_pyagrum_variables_of_every_kind(gum):
    bn = gum.BayesNet()
    for variable in (
        gum.LabelizedVariable("l", "", ["no", "yes"]), gum.RangeVariable("r", "", -1, 1),
        gum.IntegerVariable("i", "", [2, 5, 9]), gum.NumericalDiscreteVariable("n", "", [0.5, 1.5]),
        gum.DiscretizedVariable("d", "", [0, 1, 2.5]),
    ):  # fmt: skip
        bn.add(variable)
    for parent, child in ("ld", "rd", "di", "rn"):
        bn.addArc(parent, child)
    bn.generateCPTs()
    net = bmc.io.from_pyagrum(bn)
    assert [net[name].states for name in "lrind"] == [
        ("no", "yes"), (-1, 0, 1), (2, 5, 9), (0.5, 1.5), ("[0;1[", "[1;2.5]"),
    ]  # fmt: skip
    engine = gum.LazyPropagation(bn)
    engine.setEvidence({"i": 1, "n": 0})
    posterior = bmc.infer(net, {"i": 5, "n": 0.5}, engine=bmc.Exact())
    for name in "lrd":
        np.testing.assert_allclose(
            posterior.probabilities(name), engine.posterior(name).toarray(), atol=1e-9
        )


def test_pyagrum_aggregators_become_tables(gum):
    bn = gum.fastBN("a[2];b[2]")
    bn.addNoisyOR(gum.LabelizedVariable("o", "", 2), 0.1)
    bn.addWeightedArc("a", "o", 0.3)
    bn.addWeightedArc("b", "o", 0.4)
    engine = gum.LazyPropagation(bn)
    net = bmc.io.from_pyagrum(bn)
    probs = bmc.infer(net, {}, engine=bmc.Exact()).probabilities("o")
    np.testing.assert_allclose(probs, engine.posterior("o")[:], atol=1e-9)


def test_pyagrum_influence_diagrams_are_refused(gum):
    with pytest.raises(bmc.errors.UnsupportedError, match="decisions and utilities"):
        bmc.io.from_pyagrum(gum.InfluenceDiagram())


@pytest.mark.parametrize("name", ["alarm", "hepar2", "mildew", "water"])
def test_pyagrum_files_of_reference_networks(tmp_path, reference_data, gum, name):
    """Six digits leave rows of many states off by more than 1e-6."""
    path = reference_data / "bn_discrete" / "bif" / f"{name}.bif.gz"
    (tmp_path / "x.bif").write_text(read_text(path))
    gum.saveBN(gum.loadBN(str(tmp_path / "x.bif")), str(tmp_path / "x.bifxml"))
    ours = bmc.io.to_networkx(bmc.io.read(path)).nodes
    for source in (bmc.io.read, lambda file: bmc.io.from_pyagrum(gum.loadBN(str(file)))):
        theirs = bmc.io.to_networkx(source(tmp_path / "x.bifxml")).nodes
        for node in ours:
            assert tuple(map(str, theirs[node]["states"])) == ours[node]["states"]
            order = [theirs[node]["table_parents"].index(p) for p in ours[node]["table_parents"]]
            probs = np.transpose(theirs[node]["probs"], [*order, len(order)])
            np.testing.assert_allclose(probs, ours[node]["probs"], rtol=0, atol=SIX_DIGITS)
