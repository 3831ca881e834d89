"""The random nets: valid, seeded, bounded, and with every feature they promise."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import Phase, find, given, settings
from hypothesis import strategies as st

import bayesmc as bmc
from bayesmc.testing import (
    bayes_nets,
    enumerate_posterior,
    evidence_for,
    random_evidence,
    random_net,
    session,
)
from bayesmc.testing.makers.spelling import as_code

EVERYTHING = {"hybrid": True, "plates": True}


def test_the_seed_decides() -> None:
    names = [random_net(seed, **EVERYTHING).name for seed in range(20)]
    assert names == [random_net(seed, **EVERYTHING).name for seed in range(20)]
    assert len(set(names)) > 15
    net = random_net(4)
    for seed in range(5):
        assert str(random_evidence(net, seed)) == str(random_evidence(net, seed))


def test_every_feature_occurs() -> None:
    nets = [random_net(seed, **EVERYTHING) for seed in range(150)]
    kinds = {k for net in nets for k in re.findall(r": ([a-z ]+)\(", net.name)}
    assert kinds == {
        "table", "rows", "logistic", "softmax", "uniform integers", "binomial", "deterministic",
        "normal", "student", "gamma", "beta", "exponential", "uniform", "poisson",
    }  # fmt: skip
    seen = set()
    for net in nets:
        model = net.model()
        for name, node in model.nodes.items():
            states = net[name].states
            if states is not None and node.is_stochastic:
                seen.add(
                    "labels"
                    if isinstance(states[0], str)
                    else "numbers"
                    if 0.5 in states
                    else "plain"
                )
            for parent, link in node.links:
                above = model[parent]
                if link.foreign:
                    seen.add("foreign")
                elif above.plates and above.plates != node.plates[: len(above.plates)]:
                    seen.add("turned or inner plate")
                if above.plates and set(above.plates) & set(node.plates):
                    seen.add("shared")
                if above.domain is None and node.domain is not None and node.is_stochastic:
                    seen.add("discrete child of a continuous parent")
            if node.declaration.probs is not None and (node.declaration.probs == 0).any():
                seen.add("zero")
    assert seen == {
        "labels", "numbers", "plain", "foreign", "turned or inner plate", "shared", "zero",
        "discrete child of a continuous parent",
    }  # fmt: skip


def test_gathers_occur() -> None:
    """A foreign plate is picked from by a discrete parent in some nets, averaged over in others."""
    lines = [as_code(random_net(seed, plates=True)) for seed in range(200)]
    assert len(re.findall(r"(?:v\d|\))\[v\d\]", "".join(lines))) >= 3
    assert "".join(lines).count(".mean()") >= 15


@pytest.mark.parametrize("limit", [8, 100, 4000])
def test_configurations_are_bounded(limit: int) -> None:
    for seed in range(60):
        net = random_net(seed, configurations=limit, plates=True, hybrid=True)
        assert len(enumerate_posterior(net).weights) <= max(limit, 2)


def test_options_are_kept() -> None:
    for seed in range(40):
        net = random_net(seed, nodes=(2, 3), states=2, deterministic=False)
        assert 2 <= len(net) <= 3
        assert not net.plates
        assert all(net[name].kind == "stochastic" for name in net)
        assert all(len(net[name].states) == 2 for name in net)
    with_zeros = sum(_zeros(random_net(seed)) for seed in range(40))
    without = sum(_zeros(random_net(seed, zeros=False)) for seed in range(40))
    assert with_zeros > 5
    assert without == 0


@pytest.mark.parametrize(
    "options", [{"nodes": (0, 2)}, {"nodes": (3, 2)}, {"states": 1}, {"configurations": 1}]
)
def test_options_are_checked(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        random_net(0, **options)


def test_evidence_is_possible_and_of_every_form() -> None:
    forms = set()
    for seed in range(150):
        net = random_net(seed, **EVERYTHING)
        evidence = random_evidence(net, seed, chance=0.6)
        found = enumerate_posterior(net, evidence)
        assert np.isfinite(found.log_marginal_likelihood)
        for value in evidence.values():
            forms.add(type(value).__name__)
            if isinstance(value, np.ndarray) and value.dtype == object and None in value.tolist():
                forms.add("missing labels")
            if isinstance(value, np.ndarray) and value.dtype.kind == "f" and np.isnan(value).any():
                forms.add("NaN")
    assert forms >= {"int", "float", "str", "ndarray", "MaskedArray", "missing labels", "NaN"}


@settings(max_examples=session.scaled(30, 5))
@given(bayes_nets(**EVERYTHING), st.data())
def test_strategies_give_valid_nets_and_possible_evidence(net: bmc.BayesNet, data) -> None:
    net.validate()
    evidence = data.draw(evidence_for(net))
    assert np.isfinite(enumerate_posterior(net, evidence).log_marginal_likelihood)


def test_nets_shrink_to_the_cause() -> None:
    """The smallest net with a child in two plates has nothing else in it."""
    small = find(
        bayes_nets(**EVERYTHING),
        lambda net: any(len(net[n].plates) == 2 and net[n].parents for n in net),
        settings=settings(
            max_examples=500,
            database=None,
            derandomize=True,
            phases=(Phase.generate, Phase.shrink),
        ),
    )
    assert len(small) <= 3
    assert small.plates == {"k": 2, "n": 2}
    assert sum(len(small[name].parents) for name in small) == 1


def _zeros(net: bmc.BayesNet) -> bool:
    return any(d.probs is not None and (d.probs == 0).any() for d in net._declarations.values())
