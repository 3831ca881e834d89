"""Angles: their mean and deviation are circular, whatever way the answer is held."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc

CENTRE = np.pi - 0.1  # draws fall on both sides of the cut at pi


def compass() -> bmc.BayesNet:
    """A heading near pi, wrapped to (-pi, pi], and something that depends on it."""

    def heading():
        return bmc.Density(
            lambda x: (
                -0.5 * (np.remainder(x - CENTRE + np.pi, 2 * np.pi) - np.pi) ** 2 / 0.25
                - np.log(0.5 * np.sqrt(2 * np.pi))
            ),
            sample=lambda rng, shape: (
                np.remainder(CENTRE + 0.5 * rng.standard_normal(shape) + np.pi, 2 * np.pi) - np.pi
            ),
            support="circle",
        )

    net = bmc.BayesNet()
    net.node(heading)
    net.add("seen", lambda heading: bmc.Normal(np.sin(heading), 0.3))
    return net


def by_quadrature(seen: float) -> tuple[float, float]:
    """Circular mean and standard deviation on a fine grid of unwrapped angles."""
    x = np.linspace(CENTRE - 3, CENTRE + 3, 20_001)
    w = np.exp(-0.5 * ((x - CENTRE) / 0.5) ** 2 - 0.5 * ((seen - np.sin(x)) / 0.3) ** 2)
    resultant = (w * np.exp(1j * x)).sum() / w.sum()
    return float(np.angle(resultant)), float(np.sqrt(-2 * np.log(abs(resultant))))


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_mean_and_deviation_of_an_angle(keep: str) -> None:
    """Within 4.5 standard errors (false alarm 7e-6); a linear mean would be off by over a radian."""
    engine = bmc.LikelihoodWeighting(40_000)
    posterior = bmc.infer(compass(), {"seen": -0.1}, engine=engine, rng=3, keep=keep)
    mean, deviation = by_quadrature(-0.1)
    off = np.remainder(posterior.mean("heading") - mean + np.pi, 2 * np.pi) - np.pi
    assert abs(off) < 4.5 * posterior.mcse("heading")
    assert posterior.mcse("heading") < 0.01
    assert posterior.std("heading") == pytest.approx(deviation, rel=0.03)


def test_error_of_an_angle_is_the_spread_of_its_answers() -> None:
    """80 runs: their spread is within 40 % of the stated error (false alarm below 1e-6)."""
    engine = bmc.LikelihoodWeighting(1_000)
    runs = [bmc.infer(compass(), {"seen": -0.1}, engine=engine, rng=k) for k in range(80)]
    means = np.remainder([r.mean("heading") for r in runs], 2 * np.pi)
    assert np.std(means) == pytest.approx(np.mean([r.mcse("heading") for r in runs]), rel=0.4)


def test_quantiles_of_an_angle_are_cut_opposite_its_mean() -> None:
    posterior = bmc.infer(compass(), engine=bmc.LikelihoodWeighting(20_000), rng=0)
    low, middle, high = posterior.quantile("heading", [0.05, 0.5, 0.95])
    assert low < middle < high
    assert high - low == pytest.approx(2 * 1.645 * 0.5, rel=0.05)


def test_labels_have_no_expectation() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3), states=("no", "yes"))
    posterior = bmc.infer(net, engine=bmc.LikelihoodWeighting(100), rng=0)
    with pytest.raises(bmc.errors.UnsupportedError, match="labels .* no mean.*a == 'no'"):
        posterior.expectation(lambda a: a)
