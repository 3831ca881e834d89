"""Chains in modes that weigh nothing go on among the others; modes that weigh something keep their chains.

Windows are of independent draws of Normal modes, whose true weights are known; the runs at the end are
judged at 4.9 standard errors, a false alarm in a million for each figure. Planted faults are seen.
"""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from bayesmc.kernels import lost_chains
from bayesmc.kernels.lost_chains import LostChains
from bayesmc.testing import session

SHIFT = session.seed()


def window(
    heights: list[float],
    widths: list[float],
    size: int = 5,
    count: int = 50,
    rise: float = 0.0,
    apart: float = 20.0,
) -> np.ndarray:
    """Which chains are lost, each in a Normal mode of its own where heights differ; the last one rises."""
    rng, lost = np.random.default_rng(7 + SHIFT), LostChains()
    chains = len(heights)
    memory = lost.start(chains, size)
    for t in range(count):
        z = rng.standard_normal((chains, size))
        log = np.array(heights) - 0.5 * np.square(z).sum(axis=1)
        log[-1] += rise * (t / count - 1.0)
        places = apart * (np.array(heights) != heights[0])
        memory = lost.seen(memory, z * np.array(widths)[:, None] + places[:, None], log)
    return lost.found(memory)


def test_a_low_mode_is_lost_and_a_light_one_is_not() -> None:
    far = window([0, 0, 0, -60.0], [1, 1, 1, 1])
    assert far.tolist() == [False, False, False, True]
    assert not window([0, 0, 0, -15.0], [1, 1, 1, 1]).any()


def test_most_chains_may_be_lost() -> None:
    found = window([0.0] * 2 + [-60.0] * 6, [1] * 8)
    assert found.tolist() == [False] * 2 + [True] * 6
    assert not window([0.0] + [-60.0] * 7, [1] * 8).any()  # one chain alone is no witness
    assert window([0.0] * 2 + [-60.0] * 62, [1] * 64).sum() == 62


def test_a_spike_outweighs_nobody_and_width_makes_up_for_height() -> None:
    thin = np.exp(-12.0)
    assert not window([60.0, 60.0, 0, 0], [thin, thin, 1, 1]).any()  # equal weights
    assert not window([75.0, 75.0, 0, 0], [thin**2, thin**2, 1, 1]).any()  # the low ones weigh all
    assert window([160.0, 160.0, 0, 0], [thin, thin, 1, 1]).tolist() == [False, False, True, True]


def test_chains_on_their_way_and_windows_of_few_draws_are_left() -> None:
    heights = [0.0, 0, 0, -40.0]
    assert window(heights, [1] * 4, rise=2.0)[-1]
    assert not window(heights, [1] * 4, rise=60.0)[-1]
    assert not window(heights, [1] * 4, count=39).any()
    assert not window([0.0, -60.0], [1, 1]).any()


def smooth_and_rough(size: int = 40) -> np.ndarray:
    """Which chains are lost in two modes of equal weight: a smooth random walk's, and one of noise."""
    rng, lost = np.random.default_rng(5 + SHIFT), LostChains()
    steps = np.r_[0.4, np.full(size - 1, 0.02)]
    memory = lost.start(8, size)
    for _ in range(160):
        z = rng.standard_normal((8, size))
        log = -0.5 * np.square(z).sum(axis=1)
        smooth = np.arange(8) < 4
        u = np.where(smooth[:, None], np.cumsum(steps * z, axis=1), 5.0 + 0.3 * z)
        log -= np.where(smooth, np.log(steps).sum(), size * np.log(0.3))
        memory = lost.seen(memory, u, log)
    return lost.found(memory)


def test_a_narrow_mode_of_correlated_numbers_is_no_wider_than_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert not smooth_and_rough().any()
    spread = np.linalg.slogdet
    independent = lambda a: spread(a * np.eye(a.shape[-1]))  # noqa: E731
    monkeypatch.setattr(np.linalg, "slogdet", independent)
    assert smooth_and_rough()[4:].all()  # half of the posterior would be left out


def test_a_chain_that_stands_still_is_found_and_hides_no_other() -> None:
    rng, lost = np.random.default_rng(2 + SHIFT), LostChains()
    memory = lost.start(6, 3)
    low = np.array([0, 0, 0, 0, 100.0, 100.0])
    for _ in range(50):
        z = rng.standard_normal((6, 3)) * np.array([1, 1, 1, 1, 1, 0])[:, None]
        memory = lost.seen(memory, z + (20.0 * (low > 0))[:, None], -low)
    assert lost.found(memory).tolist() == [False] * 4 + [True] * 2


def test_a_chain_that_walks_slowly_is_not_judged() -> None:
    rng, lost = np.random.default_rng(3 + SHIFT), LostChains()
    memory, walk = lost.start(4, 20), np.zeros(20)
    for _ in range(60):
        z = rng.standard_normal((4, 20))
        walk = walk + 0.01 * z[3]
        z[3] = 30.0 + walk
        memory = lost.seen(memory, z, np.array([0, 0, 0, -60.0]))
    assert not lost.found(memory).any()


def test_few_draws_for_many_numbers_tell_nothing() -> None:
    heights = [0.0, 0, 0, -200.0]
    assert window(heights, [1] * 4, size=40, count=80)[-1]
    assert not window(heights, [1] * 4, size=40, count=79).any()
    assert not window([0.0, 0, 0, -9e9], [1] * 4, size=101, count=300).any()


def test_what_is_not_apart_is_no_mode_of_its_own() -> None:
    heights = [0.0, 0, 0, -60.0]
    assert window(heights, [1] * 4, apart=8.0)[-1]
    assert not window(heights, [1] * 4, apart=4.0).any()


def down_a_funnel(size: int = 50) -> np.ndarray:
    """Which of 32 chains are lost in one funnel: four that go far down it, others in its mouth."""
    rng, lost = np.random.default_rng(11 + SHIFT), LostChains()
    deep = np.arange(32) < 4
    memory = lost.start(32, size + 1)
    for _ in range(200):
        log_scale = np.where(deep, rng.normal(-4.0, 2.0, 32), rng.normal(-1.6, 0.4, 32))
        z = rng.standard_normal((32, size))
        u = np.column_stack([log_scale, np.exp(log_scale)[:, None] * z])
        memory = lost.seen(memory, u, -size * log_scale - 0.5 * np.square(z).sum(axis=1))
    return lost.found(memory)


def test_chains_in_the_mouth_of_a_funnel_are_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not down_a_funnel().any()
    monkeypatch.setattr(lost_chains, "_APART", 0.0)  # by height and weight alone they were
    assert down_a_funnel()[4:].any()


@pytest.mark.parametrize("size", [1, 10, 200])
def test_chains_of_one_mode_are_never_lost(size: int) -> None:
    assert not window([0.0] * 64, [1.0] * 64, size=size).any()


def test_a_lost_chain_goes_on_from_one_that_is_not() -> None:
    rng, lost = np.random.default_rng(SHIFT), LostChains()
    rows = lost.moved(np.array([False, True, False, True, True]), rng)
    assert rows[[0, 2]].tolist() == [0, 2] and set(rows[[1, 3, 4]]) <= {0, 2}


def two_modes(depth: float, width: float) -> bmc.BayesNet:
    """A number with a mode at 30, of scale 1, and one at -30 whose height is lower by ``depth``."""
    net = bmc.BayesNet("two modes")
    net.add("x", lambda: bmc.Normal(0.0, 30.0))

    def modes(x):
        high, low = -0.5 * (x - 30.0) ** 2, -0.5 * ((x + 30.0) / width) ** 2 - depth
        top = np.maximum(high, low)
        return top + np.log(np.exp(high - top) + np.exp(low - top))

    net.potential("modes", modes)
    return net


def answer(depth: float, width: float) -> np.ndarray:
    start = {"x": np.repeat([-30.0, 30.0], 16)}
    engine = bmc.HamiltonianMonteCarlo(chains=32, warmup=400, draws=200, start=start)
    net = two_modes(depth, width)
    return bmc.infer(net, engine=engine, rng=np.random.default_rng(3 + SHIFT))["x"]


def test_an_answer_is_of_the_mode_that_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    draws = answer(depth=60.0, width=1.0)
    mean = 30.0 * 900 / 901  # of the mode beside the prior
    error = 1.0 / np.sqrt(draws.size / 10)  # far fewer independent ones than there are
    assert abs(draws.mean() - mean) < 4.9 * error and draws.min() > 0
    monkeypatch.setattr(LostChains, "found", lambda self, m: np.zeros(len(m["mean"]), dtype=bool))
    with pytest.warns(ConvergenceWarning):
        assert answer(depth=60.0, width=1.0).min() < 0


def test_modes_that_weigh_something_keep_their_chains() -> None:
    with pytest.warns(ConvergenceWarning):
        draws = answer(depth=0.0, width=3.0)
    assert draws.min() < 0 < draws.max()


def test_densities_that_differ_from_chain_to_chain_are_not_compared() -> None:
    lost = LostChains(numbers=0)
    memory = lost.seen(lost.start(4, 2), np.zeros((4, 2)), np.zeros(4))
    assert not lost.found(memory).any() and memory["count"] == 0
