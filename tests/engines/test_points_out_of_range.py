"""Parameters out of range at a point: a chain rejects it. Out of range at every point: the model's fault."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ParameterError
from bayesmc.network import pose

# few draws, of which the errors tell
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")

ENGINES = [bmc.Gibbs(300, 200), bmc.MetropolisHastings(500, 300)]
IDS = ["Gibbs", "Metropolis"]


def one_scale() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("s", bmc.Normal(1.0, 1.0))
    net.add("y", lambda s: bmc.Normal(0.0, s))
    return net


@pytest.mark.parametrize("engine", ENGINES, ids=IDS)
def test_a_scale_that_may_be_negative(engine: Any) -> None:
    posterior = bmc.infer(one_scale(), {"y": 0.5}, engine=engine, rng=0)
    s = np.linspace(1e-4, 9.0, 20_001)
    weights = np.exp(-0.5 * (s - 1.0) ** 2 - 0.5 * (0.5 / s) ** 2) / s
    exact = (s * weights).sum() / weights.sum()
    assert abs(posterior.mean("s") - exact) < 5.0 * posterior.mcse("s")  # false alarm 6e-7
    assert posterior["s"].min() > 0.0
    assert abs(np.abs(1.0 - exact)) > 5.0 * posterior.mcse("s")  # the prior's mean would be seen


@pytest.mark.parametrize("engine", ENGINES, ids=IDS)
def test_bounds_given_by_parents(engine: Any) -> None:
    """Half of the prior has them the wrong way round."""
    y = np.array([0.2, 0.4, 0.9, 0.5])
    net = bmc.BayesNet(plates={"i": 4})
    net.add("low", bmc.Normal(0.0, 1.0))
    net.add("high", bmc.Normal(0.0, 1.0))
    net.add("y", lambda low, high: bmc.Uniform(low, high), plates="i")
    posterior = bmc.infer(net, {"y": y}, engine=engine, rng=0)
    low, high = np.meshgrid(np.linspace(-6.0, 0.2, 801), np.linspace(0.9, 6.0, 801), indexing="ij")
    weights = np.exp(-0.5 * (low**2 + high**2)) * (high - low) ** -4
    for name, at in (("low", low), ("high", high)):  # 2 means: false alarm 1e-6
        exact = (at * weights).sum() / weights.sum()
        assert abs(posterior.mean(name) - exact) < 5.0 * posterior.mcse(name) + 0.005
    assert (posterior["low"] <= 0.2).all() and (posterior["high"] >= 0.9).all()


def test_a_scale_in_a_plate_with_many_elements() -> None:
    """Hardly any draw of the prior is in range for all of them."""
    net = bmc.BayesNet(plates={"g": 60})
    net.add("s", bmc.Normal(1.0, 0.5), plates="g")
    net.add("y", lambda s: bmc.Laplace(0.0, s), plates="g")
    posterior = bmc.infer(net, {"y": np.full(60, 0.7)}, engine=bmc.Gibbs(200, 100), rng=0)
    s = np.linspace(1e-4, 6.0, 20_001)
    weights = np.exp(-0.5 * ((s - 1.0) / 0.5) ** 2 - 0.7 / s) / s
    exact = (s * weights).sum() / weights.sum()
    mean = posterior.expectation(lambda s: s.mean(axis=-1))
    error = posterior.mcse("s").mean() / np.sqrt(60)
    assert abs(mean - exact) < 6.0 * error  # false alarm under 1e-6: elements are independent
    assert posterior["s"].min() > 0.0


@pytest.mark.parametrize("engine", [bmc.Gibbs(250, 100), bmc.ParticleGibbs(200, 50, 4, 20)])
def test_a_scale_of_hidden_states_that_may_be_negative(engine: Any) -> None:
    """No observed node has it: its chains must not start where states have no density."""
    y = np.array([0.2, 2.9, 0.4])
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("s", bmc.Normal(1.0, 1.0))
    dbn.add("x", lambda x_prev, s: bmc.Normal(0.5 * x_prev, s), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    posterior = bmc.infer(dbn, {"y": y}, engine=engine, rng=0)
    s = np.linspace(1e-4, 9.0, 2001)
    log = -0.5 * (s - 1.0) ** 2
    power = 0.5 ** np.arange(3)
    for k, scale in enumerate(s):  # covariance of the states, then of the rows
        cov = np.empty((3, 3))
        var = np.array([1.0, 0.25 + scale**2, 0.25 * (0.25 + scale**2) + scale**2])
        for i in range(3):
            for j in range(3):
                cov[i, j] = var[min(i, j)] * power[abs(i - j)]
        cov += np.eye(3)
        log[k] += -0.5 * y @ np.linalg.solve(cov, y) - 0.5 * np.linalg.slogdet(cov)[1]
    weights = np.exp(log - log.max())
    exact = (s * weights).sum() / weights.sum()
    assert abs(posterior.mean("s") - exact) < 5.0 * posterior.mcse("s")  # false alarm 1e-6
    assert posterior["s"].min() > 0.0


def test_what_is_wrong_at_every_point_is_named() -> None:
    net = bmc.BayesNet(plates={"g": 4})
    sign = np.array([1.0, 1.0, -1.0, 1.0])
    net.add("s", bmc.HalfNormal(1.0))
    net.add("y", lambda s: bmc.Normal(0.0, s * sign), plates="g")
    with pytest.raises(ParameterError, match=r"'y' \(plate element 2\).*scale must be positive"):
        bmc.infer(net, {"y": np.ones(4)}, engine=bmc.Gibbs(), rng=0)


def test_what_evidence_makes_wrong_is_named() -> None:
    net = bmc.BayesNet(plates={"g": 4})
    net.add("x", bmc.Normal(0.0, 1.0), plates="g")
    net.add("s", bmc.HalfNormal(1.0))
    net.add("y", lambda s, x: bmc.Normal(0.0, s * x), plates="g")
    evidence = {"x": [1.0, 2.0, -1.0, 3.0], "y": np.ones(4)}
    with pytest.raises(ParameterError, match=r"'y' \(plate element 2\).*every start"):
        bmc.infer(net, evidence, engine=bmc.Gibbs(), rng=0)


def test_states_that_are_out_of_range_stay_the_models_fault() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("y", lambda a: bmc.Normal(0.0, 1.0 - 2.0 * a))
    with pytest.raises(ParameterError, match="'y'.*scale must be positive"):
        bmc.infer(net, {"y": 0.5}, engine=bmc.Gibbs(), rng=0)


def test_engines_that_draw_forward_say_what_to_do() -> None:
    with pytest.raises(ParameterError, match=r"'y'.*prior that cannot be.*Truncated.*Gibbs"):
        bmc.infer(one_scale(), {"y": 0.5}, engine=bmc.LikelihoodWeighting(1000), rng=0)


def test_planning_tolerates_what_running_tolerates():
    """Bounds that cross at the values on which kernels are tried; a step function, so that slices move it."""
    net = bmc.BayesNet(plates={"date": 3})
    net.add("low", bmc.Uniform(0.0, 10.0))
    net.add("high", bmc.Uniform(0.0, 10.0))
    net.add("t", lambda low, high: bmc.Uniform(low, high), plates="date")
    net.add("x", lambda t: bmc.Normal(np.floor(2.0 * t), 1.0), plates="date")
    problem = pose(net, {"x": [8.0, 9.0, 11.0]})
    probe = problem.model.probe
    probe["low"], probe["high"] = probe["high"], probe["low"]
    engine = bmc.Gibbs(2000, warmup=200, chains=8)
    assert engine.refusal(problem) is None and "slice" in engine.describe(problem)["t"]
    assert bmc.MetropolisHastings(200).refusal(problem) is None
