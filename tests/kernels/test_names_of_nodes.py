"""Nodes may have any names: what the library names inside does not get in their way."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.kernels.conjugate import conjugate_kernel
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import target_of

NAMES = ["noise", "gamma", "normal", "value", "itself", "scale", "precision", "linear", "element"]


@pytest.mark.parametrize("name", NAMES)
def test_draws_are_from_the_full_conditional(name: str, rng: np.random.Generator) -> None:
    """Standard deviations of 2,000 draws within 10 %, six standard errors: no false alarm in 10^8 runs."""
    net = bmc.BayesNet(plates={"row": 5})
    net.add(name, bmc.Gamma(2.0, 2.0))
    net.add("mean", bmc.Normal(0.0, 10.0))
    net.add("y", lambda mean, s: bmc.Normal(mean, s), parents=["mean", name], plates="row")
    target = target_of(pose(net, {"y": np.arange(5.0)}))
    kernel = conjugate_kernel(Blanket(target, "mean"))
    state = {**target.known, "mean": np.zeros(2000), name: np.full(2000, 0.1)}
    new, _ = kernel.step(state, kernel.start(state, 2000), rng, False)
    assert abs(new["mean"].std() / (0.1 / np.sqrt(5)) - 1) < 0.1


@pytest.mark.parametrize("name", ["value", "noise", "normal", "gamma"])
def test_labels_of_a_mixture(name: str) -> None:
    """Means of two clusters, far apart: within .3, ten posterior standard deviations."""
    data = np.repeat([-3.0, 3.0], 40) + np.tile([-0.2, 0.2], 40)
    net = bmc.BayesNet(plates={"k": 2, "row": 80})
    net.add(name, bmc.Normal(np.array([-1.0, 1.0]), 3.0), plates="k")
    net.add("z", bmc.Categorical([0.5, 0.5]), plates="row")
    net.add("y", lambda z, m: bmc.Normal(m[z], 0.3), parents=["z", name], plates="row")
    found = bmc.infer(net, {"y": data}, engine=bmc.Gibbs(200, 50), rng=0)
    assert np.abs(np.sort(found.mean(name)) - [-3.0, 3.0]).max() < 0.3
