"""Children whose support depends on a node: what its density's features say is not all."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import bayesmc as bmc


def gamma() -> tuple[bmc.BayesNet, float, float]:
    """``x e^-x / x`` above 3: an exponential from there on."""
    net = bmc.BayesNet()
    net.add("x", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda x: bmc.Uniform(0.0, x))
    return net, 3.0, 4.0


def both_ends() -> tuple[bmc.BayesNet, float, float]:
    net = bmc.BayesNet()
    net.add("x", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda x: bmc.Uniform(-x, x))
    return net, -3.0, 4.0


def flat() -> tuple[bmc.BayesNet, float, float]:
    """``x^-2`` between 2 and 10."""
    net = bmc.BayesNet(plates={"row": 2})
    net.add("x", bmc.Uniform(0.0, 10.0))
    net.add("y", lambda x: bmc.Uniform(0.0, x), plates="row")
    return net, 2.0, np.log(5.0) / (1 / 2 - 1 / 10)


@pytest.mark.parametrize("model", [gamma, both_ends, flat])
def test_the_support_counts(model: Callable[[], tuple[bmc.BayesNet, float, float]]) -> None:
    """Means within five stated errors: a false alarm in 500,000 runs. Without the support: 1, 1, none."""
    net, y, mean = model()
    evidence = {"y": np.array([y, y]) if "row" in net.plates else y}
    found = bmc.infer(net, evidence, engine=bmc.Gibbs(2000, 500), rng=0)
    assert abs(found.mean("x") - mean) < 5 * found.mcse("x") < 0.5
