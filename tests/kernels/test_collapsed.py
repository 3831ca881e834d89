"""Which scales a warmup calls slow: those that most chains move slowly, not those that one is late with."""

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.kernels.collapsed import CollapsedBlock, governing
from bayesmc.kernels.gaussian_block import GaussianBlock
from bayesmc.kernels.slice import Slice
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import target_of

SWEEPS = 60


def kernel() -> CollapsedBlock:
    net = bmc.BayesNet(plates={"k": 4})
    net.add("tau", bmc.LogNormal(0.0, 1.0))
    net.add("mu", bmc.Normal(0.0, 1.0))
    net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="k")
    net.add("y", lambda theta: bmc.Normal(theta, 1.0), plates="k")
    target = target_of(pose(net, {"y": np.arange(4.0)}))
    blankets = {n: Blanket(target, n) for n in target.chain}
    block = GaussianBlock(target, {n: blankets[n] for n in ("mu", "theta")})
    scales = governing(target, block, blankets)
    return CollapsedBlock(target, block, scales, {n: Slice(b) for n, b in scales.items()})


def walked(memory: float, chains: int, rng: np.random.Generator) -> np.ndarray:
    """Stationary autoregressive series ``(sweeps, chains)``."""
    series = [rng.normal(size=chains)]
    for _ in range(SWEEPS - 1):
        fresh = rng.normal(size=chains)
        series.append(memory * series[-1] + np.sqrt(1 - memory**2) * fresh)
    return np.array(series)


def is_slow(series: np.ndarray) -> bool:
    made: Any = kernel()
    memory = {"until": 40 + SWEEPS, "series": {"tau": series}, "slow": {"tau": False}}
    return bool(made._decided(memory)["slow"]["tau"])


@pytest.mark.parametrize("chains", [16, 64])
@pytest.mark.parametrize("seed", range(5))
def test_one_late_chain_makes_no_scale_slow(chains: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    series = walked(0.4, chains, rng)
    assert not is_slow(series)
    series[:, : chains // 16] -= 15.0
    assert not is_slow(series)


@pytest.mark.parametrize("chains", [4, 16, 64])
@pytest.mark.parametrize("seed", range(5))
def test_a_scale_that_most_chains_move_slowly_is_slow(chains: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    assert is_slow(walked(0.95, chains, rng))
    # the neck of a funnel: chains differ in how slow they are, and none is late
    speeds = np.where(rng.random(chains) < 0.5, 0.98, 0.9)
    assert is_slow(np.stack([walked(m, 1, rng)[:, 0] for m in speeds], axis=1))
