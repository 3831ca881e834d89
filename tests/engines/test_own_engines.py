"""Engines and kernels that somebody wrote wrongly: they are told what was returned, and what was wanted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.base import Engine
from bayesmc.engines.mcmc.sweep import SweepSampler
from bayesmc.errors import ModelError
from bayesmc.kernels.base import Kernel
from bayesmc.network import pose
from bayesmc.structure.target import target_of


def coin() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("y", lambda p: bmc.Bernoulli(p))
    return net


@dataclass(frozen=True)
class Forgetful(Engine):
    def refusal(self, problem: Any) -> None:
        return None

    def run(self, *_: Any, **__: Any) -> Any:
        return None


class Empty(Engine):
    pass


def test_an_engine_returns_a_posterior() -> None:
    with pytest.raises(
        TypeError, match="Forgetful.run returned NoneType; an engine returns a Posterior"
    ):
        bmc.infer(coin(), {"y": 1}, engine=Forgetful())


def test_a_method_that_is_missing_is_named() -> None:
    with pytest.raises(NotImplementedError, match=r"Empty has no method refusal\(problem\)"):
        bmc.infer(coin(), {"y": 1}, engine=Empty())


class Still(Kernel):
    names = ("p",)

    def __init__(self, new: dict[str, Any]) -> None:
        self.new = new

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        return self.new, memory


@pytest.mark.parametrize(
    ("new", "said"),
    [
        ({"q": np.full(4, 0.5)}, "Still.step moves 'p' .names., but returned only q"),
        (
            {"p": np.full(1, 0.5)},
            r"returned shape \(1,\) for node 'p', whose state has shape \(4,\)",
        ),
        ({"p": np.full(4, np.nan)}, "returned 'p' with values that are not finite"),
    ],
)
def test_a_kernel_returns_its_nodes(new: dict[str, Any], said: str) -> None:
    target = target_of(pose(coin(), {"y": 1}))
    sampler = SweepSampler(target, [Still(new)])
    rng = np.random.default_rng(0)
    state = sampler.start(rng, 4)
    with pytest.raises(ModelError, match=said):
        sampler.step(state, rng, True)


def test_a_kernel_that_stays_is_fine() -> None:
    target = target_of(pose(coin(), {"y": 1}))
    rng = np.random.default_rng(0)
    sampler = SweepSampler(target, [Still({"p": np.full(4, 0.5)})])
    state = sampler.step(sampler.start(rng, 4), rng, True)
    assert state["values"]["p"].tolist() == [0.5] * 4
