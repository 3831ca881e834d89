"""Real networks against published exact answers: every scenario, marginals and log P(evidence)."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest

from bayesmc.factors import CliqueTree
from bayesmc.factors.propagation import LINEAR
from bayesmc.io.bif import parse_bif, read_text

EXACT = ["alarm", "asia", "cancer", "earthquake", "hepar2", "mildew", "pigs", "sachs", "survey",
         "water"]  # fmt: skip


def load(root, name):
    nodes = parse_bif(read_text(root / "bn_discrete" / "bif" / f"{name}.bif.gz"), name)
    tree = CliqueTree(
        {node.name: len(node.states) for node in nodes},
        [(*node.parents, node.name) for node in nodes],
    )
    return {node.name: node for node in nodes}, tree


def scenarios(root, name):
    with gzip.open(root / "bn_discrete" / "refs" / f"{name}.ref.json.gz", "rt") as file:
        return json.load(file)["scenarios"]


@pytest.mark.parametrize("name", EXACT)
def test_exact_answers(reference_data, name):
    nodes, tree = load(reference_data, name)
    bound = tree.bind([node.probs for node in nodes.values()])
    expected = scenarios(reference_data, name)
    assert len(expected) == 4
    for scenario in expected.values():
        evidence = {v: nodes[v].states.index(s) for v, s in scenario["evidence"].items()}
        answer = bound.calibrate(evidence)
        assert answer._context.semiring is LINEAR  # no real net should need the slow way
        assert answer.log_z == pytest.approx(scenario["log_p_evidence"], abs=1e-9)
        assert scenario["marginals"].keys() == nodes.keys() - evidence.keys()
        for v, marginal in scenario["marginals"].items():
            np.testing.assert_allclose(answer.marginal(v), marginal, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["alarm", "hepar2", "sachs"])
def test_the_log_domain_agrees(reference_data, name):
    nodes, tree = load(reference_data, name)
    bound = tree.bind([node.probs for node in nodes.values()])
    for scenario in scenarios(reference_data, name).values():
        evidence = {v: nodes[v].states.index(s) for v, s in scenario["evidence"].items()}
        linear, log = bound.calibrate(evidence), bound.calibrate(evidence, log_domain=True)
        assert log.log_z == pytest.approx(linear.log_z, abs=1e-11)
        np.testing.assert_allclose(
            np.concatenate(log.marginals()), np.concatenate(linear.marginals()), atol=1e-12
        )


def test_munin1_is_known_to_be_too_large_before_anything_is_allocated(reference_data):
    _, tree = load(reference_data, "munin1")
    assert tree.cost.largest_entries > 1e7
    assert tree.cost.bytes > 2e9
