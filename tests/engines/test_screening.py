"""The screen ranks first what is worst, and says nothing of scalars that never move."""

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc.screening import looked_at, screened
from bayesmc.network import pose


def walks(count: int, chains: int, draws: int, memory: np.ndarray) -> np.ndarray:
    """Autoregressive series, shape (scalar, chain, draw)."""
    rng = np.random.default_rng(4)
    x = rng.normal(size=(count, chains))
    found = np.empty((count, chains, draws))
    for t in range(draws):
        x = memory[:, None] * x + np.sqrt(1 - memory[:, None] ** 2) * rng.normal(size=x.shape)
        found[..., t] = x
    return found


@pytest.mark.parametrize("block", [1, 4])
def test_the_slowest_and_the_most_apart_come_first(block: int) -> None:
    memory = np.linspace(0.0, 0.2, 60)
    memory[17] = 0.97
    draws = walks(60, 8, 800, memory)
    draws[41, :4] += 1.0
    apart, ess = screened(draws, block)
    assert np.argmax(apart) == 41
    assert 17 in np.argsort(ess)[:2]
    one_by_one = [screened(draws[k : k + 1], block) for k in range(60)]
    np.testing.assert_allclose(apart, [a[0] for a, _ in one_by_one], rtol=1e-12)
    np.testing.assert_allclose(ess, [e[0] for _, e in one_by_one], rtol=1e-12)


def test_draws_too_few_say_nothing() -> None:
    apart, ess = screened(np.zeros((3, 4, 7)), 2)
    assert np.isnan(apart).all() and np.isnan(ess).all()


@pytest.mark.parametrize("draws", [50, 3001])
def test_what_stands_still_is_left_out_and_angles_are_not_cut(draws: int) -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.add("angle", bmc.VonMises(np.pi, 4.0))
    net.add("still", bmc.Normal(0.0, 1.0))
    net.add("rare", bmc.Bernoulli(0.1))
    model = pose(net, {}).model
    rng = np.random.default_rng(0)
    rare = np.zeros((70, draws), np.uint8)
    rare[9, 1] = 1  # in a draw that thinning may pass by
    angle = np.angle(np.exp(1j * (np.pi + 0.3 * rng.normal(size=(70, draws)))))
    stored = {
        "x": rng.normal(size=(70, draws, 3)),
        "angle": angle,
        "still": np.full((1, 1), 2.0),
        "rare": rare,
    }
    stored["x"][..., 1] = 5.0
    nodes = [model[n] for n in ("x", "angle", "still", "rare")]
    found = looked_at(nodes, model, stored, 1, 0)
    assert found.scalars == [("angle", ()), ("rare", ()), ("x", (0,)), ("x", (2,))]
    assert found.draws.shape[:2] == (4, 64)
    assert found.share == 64 / 70
    assert found.draws[0].std() < 0.5
    whole = looked_at(nodes, model, stored, 1, 7)
    assert whole.share == 1.0 and whole.draws.shape[1] == 70
