"""Finite nodes moved with the numbers below them: invariance, and chains that cross where others stand still.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; each is shown to fail
on a kernel with a deliberate error.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.redrawn import Redrawn, redrawn_kernels
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target
from tests.kernels.invariance import Case, Make, Model, each_test


class Careless(Redrawn):
    """Takes all states for equally likely beforehand."""

    def _log(self, state: Any) -> np.ndarray:
        return super()._log({**state, self.names[0]: np.zeros_like(state[self.names[0]])})


def redrawn(kind: type[Redrawn] = Redrawn, apart: bool | None = None) -> Make:
    def make(target: Target) -> Kernel:
        names = [n for n in target.chain if n != "y"]
        kernels = redrawn_kernels(target, {n: Blanket(target, n) for n in names})
        found = max(kernels, key=lambda k: len(k.names))
        assert isinstance(found, Redrawn)
        if apart is not None:
            assert (found.group.apart is not None) is apart
        return kind(target, {n: Blanket(target, n) for n in names}, found.group)

    return make


def backwards(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
    kernel = make(target)
    assert isinstance(kernel, Redrawn)
    kernel.from_last = True
    return kernel, memory


def of_elements() -> Model:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("z", bmc.Categorical([0.6, 0.3, 0.1]), plates="i")
    net.add("m", lambda z: bmc.Normal(2.0 * z, 0.5 + 0.3 * z), plates="i")
    net.add("y", lambda m, z: bmc.StudentT(4.0, m - 0.3 * z, 1.0), plates="i")
    return Model(net, ("y",))


def of_sums() -> Model:
    """Every datum depends on all elements, which take turns."""
    net = bmc.BayesNet(plates={"j": 3, "i": 4})
    one, other = np.array([0, 1, 2, 0]), np.array([1, 2, 0, 2])
    net.add("z", bmc.Bernoulli(0.3), plates="j")
    net.add("b", lambda z: bmc.Normal(0.5 * z, np.where(z, 2.0, 0.2)), plates="j")
    net.add("y", lambda b: bmc.Laplace(b[one] - 0.5 * b[other], 1.0), plates="i")
    return Model(net, ("y",))


def of_all_below() -> Model:
    """A switch above two numbers and a plate."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("z", bmc.Bernoulli(0.2))
    net.add("m", lambda z: bmc.Normal(3.0 * z, 0.5))
    net.add("scale", lambda z: bmc.Gamma(2.0 + 2 * z, 2.0))
    net.add("x", lambda m, scale: bmc.Normal(m, scale), plates="i")
    net.add("y", lambda x: bmc.Poisson(np.exp(np.clip(x, -5, 2))), plates="i")
    return Model(net, ("y",))


ROWS = np.array([[0.6, 0.3, 0.1], [0.1, 0.2, 0.7]])


def of_many_states() -> Model:
    """A switch above finite nodes that only their number is seen of."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("z", bmc.Bernoulli(0.1))
    net.add("w", lambda z: bmc.Categorical(ROWS[z]), plates="i")
    net.add("y", lambda w: bmc.Poisson(0.5 + w.sum()))
    return Model(net, ("y",))


CASES = {
    "elements": Case(of_elements(), redrawn(apart=True), {"careless": redrawn(Careless)}),
    "sums": Case(of_sums(), redrawn(apart=False), {"careless": redrawn(Careless)}, backwards),
    "all below": Case(of_all_below(), redrawn(), {"careless": redrawn(Careless)}),
    "many states": Case(of_many_states(), redrawn(), {"careless": redrawn(Careless)}),
}


@pytest.mark.parametrize(("name", "fault", "test"), each_test(CASES))
def test_kernel(name: str, fault: str, test: str) -> None:
    CASES[name].check(test, fault)
