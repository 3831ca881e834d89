"""Scales moved with what they scale: invariance, what is taken for a scale, and hierarchies that mix.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; each is shown to fail
on a kernel with a deliberate error.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc import gibbs
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.rescaled import Rescaled, rescaled_kernels
from bayesmc.network import pose
from bayesmc.structure.target import Target, target_of
from bayesmc.testing import session
from tests.kernels.invariance import Case, Make, Model, each_test


class Flat(Rescaled):
    """Forgets the change of volume of one number."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.numbers -= 1


class Carried(Rescaled):
    """Counts deviations from where they were, though the mean has changed with the scale."""

    def _keeps_centres(self, state: Any, centres: Any, lead: Any) -> np.ndarray:
        return np.ones(lead, dtype=bool)


def shifted(kind: type[Rescaled] = Rescaled) -> Make:
    return lambda target: kind(target, "s", ("b",), 1)


def rescaled(kind: type[Rescaled] = Rescaled) -> Make:
    def make(target: Target) -> Kernel:
        (found,) = rescaled_kernels(target, ("b", "c"))
        assert isinstance(found, Rescaled)
        return kind(target, found.name, found.below, found.power)

    return make


def hierarchy(scale: Any, child: Callable[..., Any]) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("s", scale)
    net.add("b", child, plates="i")
    net.add("y", lambda b: bmc.Poisson(np.exp(np.clip(b, -5, 3))), plates="i")
    return net


NETS = {
    "precision": hierarchy(bmc.Gamma(2.0, 1.0), lambda m, s: bmc.Laplace(m, s**-0.5)),
    "scale": hierarchy(bmc.Uniform(0.0, 3.0), lambda m, s: bmc.Normal(m, s)),
}
CASES = {
    name: Case(Model(net, ("y",)), rescaled(), {"flat": rescaled(Flat)}, sizes={"draws": 12})
    for name, net in NETS.items()
}

# above a scale of 1 the effects lie elsewhere, so that it cannot be multiplied from one side to the other
CASES["shift"] = Case(
    Model(
        hierarchy(bmc.Uniform(0.0, 3.0), lambda m, s: bmc.Normal(m + 1.5 * (s > 1.0), s)), ("y",)
    ),
    shifted(),
    {"carried": shifted(Carried)},
    sizes={"draws": 20, "chains": 1000},
)


@pytest.mark.parametrize(("name", "fault", "test"), each_test(CASES))
def test_kernel(name: str, fault: str, test: str) -> None:
    CASES[name].check(test, fault)


@pytest.mark.parametrize(
    ("child", "power"),
    [
        (lambda m, s: bmc.Normal(m, s), 1),
        (lambda m, s: bmc.Normal(m, np.sqrt(s)), 2),
        (lambda m, s: bmc.Normal(m, 1 / np.sqrt(s)), -2),
        (lambda m, s: bmc.StudentT(4.0, m, 1 / s), -1),
        (lambda m, s: bmc.Normal(m, 1 + s), None),
        (lambda m, s: bmc.Normal(m + s, s), None),
    ],
)
def test_what_is_a_scale(child: Callable[..., Any], power: int | None) -> None:
    target = target_of(pose(hierarchy(bmc.Gamma(2.0, 1.0), child), {"y": [0, 3, 1]}))
    found = [k.power for k in rescaled_kernels(target, ("b",))]  # type: ignore[attr-defined]
    assert found == ([] if power is None else [power])


def test_a_random_walk_is_not_rescaled() -> None:
    """To scale one step moves where the next one begins: a kernel that did it was off by .05 of .4."""
    net = bmc.BayesNet()
    net.add("s", bmc.Gamma(2.0, 2.0))
    net.add("x0", lambda s: bmc.Normal(0.0, s))
    net.add("x1", lambda x0, s: bmc.Normal(x0, s))
    net.add("x2", lambda x1, s: bmc.Normal(x1, s))
    net.add("y", lambda x2: bmc.Poisson(np.exp(x2)))
    target = target_of(pose(net, {"y": 5}))
    assert rescaled_kernels(target, ("s", "x0", "x1", "x2")) == []


def test_effects_that_may_have_no_mean_are_left_where_they_have_none() -> None:
    """Student's t with one degree of freedom or less: such chains stay, and none of them breaks off."""
    rng = np.random.default_rng(3)
    net = bmc.BayesNet(plates={"i": 20})
    net.add("df", bmc.Gamma(2.0, 2.0))
    net.add("s", bmc.HalfNormal(2.0))
    net.add("b", lambda df, s: bmc.StudentT(df, 0.0, s), plates="i")
    net.add("y", lambda b: bmc.Poisson(np.exp(np.clip(b, -5, 3))), plates="i")
    rows = rng.poisson(np.exp(rng.standard_t(1.0, size=20).clip(-3, 3)))
    engine = bmc.Gibbs(draws=150, warmup=100)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = bmc.infer(net, {"y": rows}, engine=engine, rng=session.seed())
    assert (found["df"] < 1).any() and np.isfinite(found["b"]).all()


def logistic() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A logistic regression with random effects."""
    rng = np.random.default_rng(4)
    group, x, effect = np.repeat(np.arange(12), 6), rng.normal(size=72), rng.normal(size=12)
    net = bmc.BayesNet(plates={"g": 12, "i": 72})
    net.add("a", bmc.Normal(0.0, 5.0))
    net.add("s", bmc.HalfNormal(2.0))
    net.add("u", lambda s: bmc.Normal(0.0, s), plates="g")
    net.add("y", lambda a, u: bmc.Bernoulli(logits=a + x + u[group]), plates="i")
    return net, {"y": (rng.random(72) < 1 / (1 + np.exp(-x - effect[group]))).astype(int)}


@pytest.mark.thorough
def test_random_effects_mix(monkeypatch: pytest.MonkeyPatch) -> None:
    net, evidence = logistic()
    engine = bmc.Gibbs(draws=500, warmup=300)
    sizes = []
    for kernels in (
        rescaled_kernels,
        lambda target, slow: [],
    ):  # the second is the negative control
        monkeypatch.setattr(gibbs, "rescaled_kernels", kernels)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = bmc.infer(net, evidence, engine=engine, rng=session.seed())
        sizes.append(float(found.ess("s")))
    assert sizes[0] > 250 and sizes[0] > 1.5 * sizes[1]
