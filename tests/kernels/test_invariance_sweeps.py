"""Whole sweeps of Gibbs sampling leave their posterior invariant: mixtures of overlapping components.

All of weights, labels, means and scales move. Geweke's test and the rank test at a chance of false alarm of
1e-4 each, at fixed seeds; ``--bayesmc-seed`` shifts them, and ``--bayesmc-thorough`` makes the tests longer.
A sweep is irreversible: the rank test gets the one in reverse order. Each test is shown to fail on a sweep
with an error in one kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.engines.mcmc.sweep import SweepSampler
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.network import pose
from bayesmc.structure.target import Target
from tests.kernels.invariance import Case, Make, Model, in_turn
from tests.kernels.wrong_naturals import with_naturals

COV = np.array([[1.0, 0.4], [0.4, 0.7]])
CENTRES = np.array([[-1.0, 0.0], [0.0, 1.0], [1.5, 0.0]])
POINTS = 12


def mixture(scale: Any, child: Callable[..., Any], vectors: bool = False) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"k": 3, "i": POINTS})
    net.add("weights", bmc.Dirichlet([1.0, 2.0, 1.5]))
    net.add(
        "mean",
        bmc.MvNormal(CENTRES, COV) if vectors else bmc.Normal(CENTRES[:, 0], 1.0),
        plates="k",
    )
    net.add("scale", scale, plates="k")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="i")
    net.add("y", lambda mean, scale, label: child(mean[label], scale[label]), plates="i")
    return net


NETS: dict[str, Callable[[], bmc.BayesNet]] = {
    "variances": lambda: mixture(
        bmc.InverseGamma(3.0, 2.0), lambda m, s: bmc.Normal(m, np.sqrt(s))
    ),
    "precisions": lambda: mixture(bmc.Gamma(3.0, 2.0), lambda m, s: bmc.Normal(m, s**-0.5)),
    "covariances": lambda: mixture(
        bmc.InverseWishart(5.0, COV), lambda m, s: bmc.MvNormal(m, s), vectors=True
    ),
    "standard deviations": lambda: mixture(  # not conjugate: a slice
        bmc.LogNormal(0.0, 0.5), lambda m, s: bmc.Normal(m, s)
    ),
}


CONJUGATE = ("variances", "precisions", "covariances")


class Sweep(Kernel):
    """One sweep of the engine's sampler."""

    def __init__(self, sampler: SweepSampler) -> None:
        self.sampler = sampler
        self.names = ("weights", "mean", "scale", "label")

    def start(self, values: Any, chains: int) -> Any:
        return {"each": [k.start(values, chains) for k in self.sampler.kernels]}

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        inside = {n: values[n] for n in self.sampler.target.chain}
        state = {"values": inside, "memory": memory["each"], "chains": len(values["mean"])}
        after = self.sampler.step(state, rng, warmup)
        return after["values"], {"each": after["memory"]}

    def end_warmup(self, memory: Any) -> Any:
        ends = zip(self.sampler.kernels, memory["each"], strict=True)
        return {"each": [k.end_warmup(m) for k, m in ends]}


#: each point counts less of its degree of freedom
HALF_A_SHAPE = {
    "scale": lambda kernel: with_naturals(kernel, lambda a, b: (0.5 * a, b)),
    "covariance": lambda kernel: with_naturals(
        kernel, lambda df, scale: (3.0 + 0.5 * (df - 3.0), scale)
    ),
}


class Shifted(Kernel):
    """Moves what another kernel draws to one side."""

    def __init__(self, kernel: Kernel) -> None:
        self.kernel, self.names = kernel, kernel.names

    def start(self, values: Any, chains: int) -> Any:
        return self.kernel.start(values, chains)

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        new, memory = self.kernel.step(values, memory, rng, warmup)
        return {n: v + 0.8 for n, v in new.items()}, memory


def without_weights(kernel: Enumerate) -> Kernel:
    """The labels' kernel, all labels as likely beforehand."""
    kernel.blanket.own = None
    return kernel


def sweep(net: Any, errors: Mapping[str, Callable] | None = None, backwards: bool = False) -> Make:
    """The sweep of a posed target; where its data are hidden, that of a net in which they have a child."""

    def make(target: Target) -> Kernel:
        problem = target.problem
        if "y" in target.chain:
            anchored = net()
            anchored.add("seen", lambda y: bmc.Bernoulli(0.5 + 0.0 * _number(y)), plates="i")
            problem = pose(anchored, {"seen": np.zeros(POINTS, dtype=int)})
        plan = plan_of(problem)
        sampler = SweepSampler(plan.target, plan.kernels)
        kernels = [k for k in sampler.kernels if "y" not in k.names]
        assert sorted(n for k in kernels for n in k.names) == ["label", "mean", "scale", "weights"]
        for name, error in (errors or {}).items():
            kernels = [error(k) if k.names == (name,) else k for k in kernels]
        sampler.kernels = kernels[::-1] if backwards else kernels
        return Sweep(sampler)

    return make


def _number(y: Any) -> Any:
    return y[..., 0] if np.ndim(y) and np.shape(y)[-1:] == (2,) else y


def case(name: str, how: str) -> Case:
    net = NETS[name]
    errors: dict[str, Mapping[str, Callable]] = {
        "labels": {"label": without_weights},
        "means": {"mean": Shifted},
    }
    if name in CONJUGATE:
        kind = "covariance" if name == "covariances" else "scale"
        errors["half a shape"] = {"scale": HALF_A_SHAPE[kind]}

    def reverse(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
        kernel = make(target)
        assert isinstance(kernel, Sweep)
        kernel.sampler.kernels = kernel.sampler.kernels[::-1]
        return kernel, {"each": memory["each"][::-1]}

    return Case(
        Model(net(), ("y",)), sweep(net), {n: sweep(net, e) for n, e in errors.items()}, reverse, how,
        warmup=20 if how == "moving" else 0, sizes={"replications": 2000},
    )  # fmt: skip


ALL = [(n, f) for n in NETS for f in ("", "labels")]
ALL += [(n, "half a shape") for n in CONJUGATE]


@pytest.mark.parametrize(("name", "fault", "test"), in_turn(ALL))
def test_sweep(name: str, fault: str, test: str) -> None:
    case(name, "moving").check(test, fault)


@pytest.mark.parametrize("fault", ["", "means"])
@pytest.mark.parametrize("name", ["variances", "covariances"])
def test_sweep_with_what_is_kept_of_the_evidence(name: str, fault: str) -> None:
    """Data are summed by label: every row has a posed problem of its own."""
    case(name, "posed").check("ranks", fault, replications=40)
