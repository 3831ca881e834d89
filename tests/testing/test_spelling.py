"""What the generators make prints as code, and the code makes the same again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ModelError
from bayesmc.testing import random_net
from bayesmc.testing.makers.families import random_distribution
from bayesmc.testing.makers.graphs import random_factor_graph
from bayesmc.testing.makers.spelling import affine, as_code
from bayesmc.testing.makers.templates import random_dbn

NETS: dict[str, dict[str, Any]] = {
    "plates": {"plates": True, "states": 4},
    "hybrid": {"hybrid": True, "plates": True},
    "continuous": {"continuous": True, "plates": True, "coupling": 2.5},
}


def run(code: str) -> dict[str, Any]:
    """What the code declares; it needs two imports and nothing else."""
    names: dict[str, Any] = {}
    exec("import numpy as np\nimport bayesmc as bmc\n" + code, names)
    return names


def assert_same(net: bmc.BayesNet, again: bmc.BayesNet, seed: int) -> None:
    assert net.nodes == again.nodes and net.plates == again.plates
    draws = net.sample(3, rng=seed)
    np.testing.assert_array_equal(net.log_prob(draws), again.log_prob(draws))
    for name in net:
        assert net[name] == again[name]


@pytest.mark.parametrize("kind", NETS)
def test_code_makes_the_same_net(kind: str) -> None:
    for seed in range(30):
        net = random_net(seed, **NETS[kind])
        again = run(as_code(net))["net"]
        assert_same(net, again, seed)


def test_code_makes_the_same_template_and_data() -> None:
    for seed in range(10):
        case = random_dbn(seed, nodes=(1, 2), steps=(2, 2))
        names = run(repr(case))
        again = names["dbn"]
        inputs = names.get("inputs")
        assert names["observations"].keys() == case.observations.keys()
        for name, rows in case.observations.items():
            np.testing.assert_array_equal(names["observations"][name], rows)
            mask = np.ma.getmaskarray(rows)
            np.testing.assert_array_equal(np.ma.getmaskarray(names["observations"][name]), mask)
        ours, theirs = case.dbn.unroll(2, case.inputs), again.unroll(2, inputs)
        assert_same(ours, theirs, seed)


@pytest.mark.parametrize("continuous", [False, True])
def test_code_makes_the_same_graph(continuous: bool) -> None:
    for seed in range(25):
        graph = random_factor_graph(seed, continuous=continuous)
        again = run(as_code(graph))["graph"]
        assert [f.scope for f in graph.factors] == [f.scope for f in again.factors]
        rng = np.random.default_rng(seed)
        values = {}
        for name, variable in graph.variables.items():
            shape = (5, *(graph.plates[p] for p in variable.plates))
            if variable.states is None:
                values[name] = rng.normal(size=shape)
            else:
                values[name] = np.array(variable.states)[
                    rng.integers(len(variable.states), size=shape)
                ]
        np.testing.assert_array_equal(graph.log_prob(values), again.log_prob(values))


def test_code_makes_the_same_distribution() -> None:
    for seed in range(100):
        dist = random_distribution(seed, extreme=bool(seed % 2))
        again = run("dist = " + as_code(dist))["dist"]
        assert type(dist) is type(again) and dist.batch_shape == again.batch_shape
        np.testing.assert_array_equal(dist.sample(rng=seed), again.sample(rng=seed))


def test_copies_and_later_nodes() -> None:
    net = random_net(13, nodes=(2, 2), states=2)
    assert as_code(net.copy()) == as_code(net)
    net.table("new", ["v0"], [[0.5, 0.5], [0.25, 0.75]], ("low", "high"))
    assert as_code(net).splitlines()[-1] == (
        'net.table("new", ["v0"], [[0.5, 0.5], [0.25, 0.75]], states=("low", "high"))'
    )
    assert_same(net, run(as_code(net))["net"], 0)
    net.table("v1", ["v0"], [[0.5, 0.5], [0.25, 0.75]], replace=True)  # no stale line
    assert "lambda" not in as_code(net)


def test_what_is_not_known_is_refused() -> None:
    net = bmc.BayesNet()
    net.add("a", lambda: bmc.Normal(0.0, 1.0))
    for thing, words in (
        (net, "'a' was not made by the generators"),
        (bmc.Normal(0.0, 1.0), "the distribution was not made"),
        (random_net(13).do(v0=0), "'v0' was not made"),
        ("x", "give a net, a template, .* not str"),
    ):
        with pytest.raises(ModelError, match=words):
            as_code(thing)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("offset", "terms", "text"),
    [
        (0.0, [], "0.0"),
        (0.5, [], "0.5"),
        (0.0, [(1.0, "a"), (-1.0, "b")], "1.0 * a - b"),
        (0.0, [(-1.0, "a")], "-1.0 * a"),
        (-0.5, [(-0.75, "a"), (0.0, "b")], "-0.5 - 0.75 * a + 0.0 * b"),
        (np.array([0.5, 1.0]), [(1.0, "a")], "np.array([0.5, 1.0]) + a"),
    ],
)
def test_affine_reads_as_a_person_writes_it(offset: Any, terms: list, text: str) -> None:
    assert affine(offset, terms) == text
