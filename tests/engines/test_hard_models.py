"""Models at which chains stick: they mix, or a warning names the cause; never a quiet wrong answer.

Reference figures are means and standard errors of nutpie 0.16.8 on the same models in PyMC 5.28: 4 chains of
5,000 draws after 2,000, seed 1, acceptance .95. The data are drawn here by fixed seeds. A figure is off by
4.9 joint errors once in a million; there are 22.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.special import expit

import bayesmc as bmc

Made = tuple[bmc.BayesNet, dict[str, Any]]


def ordinal() -> Made:
    """Answers of 286 subjects, three each, on a scale of four."""
    rng, subjects = np.random.default_rng(1), np.repeat(np.arange(286), 3)
    x, own = rng.normal(size=(858, 2)), rng.normal(0, 1.5, 286)
    seen = rng.logistic(size=858)[:, None] + (x @ [0.8, -0.5] + own[subjects])[:, None]
    y = (seen > np.array([-1.5, 0.0, 1.2])).sum(axis=1)
    net = bmc.BayesNet(plates={"subject": 286, "row": 858})
    net.add("sd", bmc.HalfNormal(2.0))
    net.add("u", bmc.Normal(0.0, 1.0), plates="subject")
    net.add("b", bmc.MvNormal(np.zeros(2), scale_diag=np.full(2, 2.5)))
    net.add("first", bmc.Normal(0.0, 3.0))
    net.add("gap", bmc.Exponential(1.0))
    net.add("gap_b", bmc.Exponential(1.0))

    @net.node(plates="row")
    def grade(sd: Any, u: Any, b: Any, first: Any, gap: Any, gap_b: Any) -> Any:
        at = np.vecdot(x, b) + sd * u[subjects]
        low, middle = expit(first - at), expit(first + gap - at)
        high = expit(first + gap + gap_b - at)
        return bmc.Categorical(np.stack([low, middle - low, high - middle, 1 - high], axis=-1))

    return net, {"grade": y}


def weibull() -> Made:
    """Lifetimes seen from a first day on, and up to a last."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=150)
    entry, lived = rng.uniform(0, 1.5, 150), np.zeros(150)
    for i, scale in enumerate(np.exp(1.0 + 0.5 * x)):
        while lived[i] <= entry[i]:
            lived[i] = scale * rng.weibull(1.6)
    died = lived < 6.0
    x_died, x_left, first, first_left = x[died], x[~died], entry[died], entry[~died]
    net = bmc.BayesNet(plates={"died": int(died.sum()), "left": int((~died).sum())})
    net.add("k", bmc.Gamma(2.0, 1.0))
    net.add("a", bmc.Normal(0.0, 5.0))
    net.add("b", bmc.Normal(0.0, 5.0))
    net.add(
        "t",
        lambda k, a, b: bmc.Truncated(bmc.Weibull(k, np.exp(a + b * x_died)), low=first),
        plates="died",
    )

    @net.node(plates="left")
    def alive(k: Any, a: Any, b: Any) -> Any:
        scale = np.exp(a + b * x_left)
        return bmc.Bernoulli(np.exp((first_left / scale) ** k - (6.0 / scale) ** k))

    return net, {"t": lived[died], "alive": np.ones(int((~died).sum()))}


def horseshoe() -> Made:
    rng = np.random.default_rng(3)
    x, b = rng.normal(size=(60, 20)), np.zeros(20)
    b[:3] = [2, -1.5, 1]
    y = x @ b + rng.normal(size=60)
    net = bmc.BayesNet(plates={"p": 20, "n": 60})
    net.add("tau", bmc.HalfCauchy(1.0))
    net.add("lam", bmc.HalfCauchy(1.0), plates="p")
    net.add("z", bmc.Normal(0.0, 1.0), plates="p")
    net.add("s", bmc.HalfNormal(2.0))
    net.add("b", lambda z, lam, tau: z * lam * tau, plates="p")
    net.add("y", lambda b, s: bmc.Normal(np.vecdot(x, b.array), s), plates="n")
    return net, {"y": y}


def volatility() -> Made:
    """Two hundred returns whose log variance walks."""
    rng = np.random.default_rng(4)
    h = -1 + np.cumsum(0.2 * rng.normal(size=200))
    y = np.exp(h / 2) * rng.normal(size=200)
    net = bmc.BayesNet(plates={"t": 200})
    net.add("s", bmc.HalfNormal(0.5))
    net.add("h0", bmc.Normal(0.0, 2.0))
    net.add("z", bmc.Normal(0.0, 1.0), plates="t")

    @net.node
    def y_(s: Any, h0: Any, z: Any) -> Any:
        h = h0[..., None] + s[..., None] * np.cumsum(z.array, axis=-1)
        return bmc.MvNormal(np.zeros(200), scale_diag=np.exp(h / 2))

    return net, {"y_": y}


def frailty() -> Made:
    """Two lifetimes of each of 38 patients, some censored, with a hidden factor of each patient's."""
    rng = np.random.default_rng(5)
    x = rng.integers(0, 2, (38, 2)).astype(float)
    own = rng.gamma(2, 0.5, 38)
    rate = own[:, None] * np.exp(-0.7 * x) * 0.3
    t = (rng.exponential(size=(38, 2)) / rate) ** (1 / 1.2)
    i, j = np.nonzero(t < 8.0)
    ci, cj = np.nonzero(t >= 8.0)
    died, left, seen = x[i, j], x[ci, cj], t[i, j]
    net = bmc.BayesNet(plates={"g": 38, "died": len(i), "left": len(ci)})
    net.add("shape", bmc.Gamma(2.0, 2.0))
    net.add("k", bmc.Gamma(2.0, 1.0))
    net.add("b", bmc.Normal(0.0, 2.0))
    net.add("base", bmc.Normal(0.0, 3.0))
    net.add("w", lambda shape: bmc.Gamma(shape, shape), plates="g")
    net.add(
        "t",
        lambda w, k, b, base: bmc.Weibull(k, (w[i] * np.exp(base + b * died)) ** (-1 / k)),
        plates="died",
    )
    net.add(
        "alive",
        lambda w, k, b, base: bmc.Bernoulli(np.exp(-w[ci] * np.exp(base + b * left) * 8.0**k)),
        plates="left",
    )
    return net, {"t": seen, "alive": np.ones(len(ci))}


def banana() -> Made:
    y = np.random.default_rng(6).normal(1.0, 2.0, 60)
    net = bmc.BayesNet(plates={"n": 60})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, b: bmc.Normal(a + b**2, 2.0), plates="n")
    return net, {"y": y}


#: model -> node -> mean, its error and the standard deviation
FIGURES: dict[Callable[[], Made], dict[str, tuple[Any, Any, Any]]] = {
    ordinal: {
        "sd": (1.494969, 0.001856, 0.139477),
        "b": ([1.015599, -0.510827], [0.00065, 0.000532], [0.090967, 0.080587]),
        "first": (-1.644906, 0.001324, 0.14283),
        "gap": (1.650313, 0.000924, 0.112659),
        "gap_b": (1.240452, 0.000703, 0.097316),
    },
    weibull: {
        "k": (1.759417, 0.001513, 0.159861),
        "a": (0.97739, 0.000555, 0.058956),
        "b": (0.408333, 0.000481, 0.058161),
    },
    volatility: {"s": (0.180526, 0.000678, 0.048587), "h0": (-0.595597, 0.007187, 0.508915)},
    frailty: {
        "shape": (1.297346, 0.008594, 0.511368),
        "k": (1.364637, 0.002229, 0.15971),
        "b": (-0.785073, 0.003255, 0.330022),
        "base": (-1.165259, 0.003623, 0.291784),
    },
    banana: {"a": (0.45104, 0.012906, 0.729103), "b": (0.000639, 0.017157, 0.882289)},
}
ENGINES = {"chosen": None, "trajectories": bmc.HamiltonianMonteCarlo(target_accept=0.9)}


def told(engine: Any, made: Made) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        posterior = bmc.infer(*made, engine=engine, rng=1)
    return posterior, [str(w.message) for w in caught]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "model",
    [pytest.param(m, marks=pytest.mark.thorough) if m is ordinal else m for m in FIGURES],
    ids=lambda m: m.__name__,
)
def test_as_another_sampler_has_it(model: Callable[[], Made], engine: str) -> None:
    if model is ordinal and engine == "trajectories":
        pytest.skip("it is what is chosen")
    posterior, words = told(ENGINES[engine], model())
    for name, (mean, error, sd) in FIGURES[model].items():
        off = (posterior.mean(name) - mean) / np.hypot(posterior.mcse(name), error)
        assert np.abs(off).max() < 4.9, (name, off, words)
        enough = np.min(posterior.ess(name)) > 400
        assert enough or words, name
        if enough:
            np.testing.assert_allclose(posterior.std(name), sd, rtol=0.3)


def test_horseshoe_is_told() -> None:
    """Coefficients as nutpie has them, and a warning of the scales that steps are too long for."""
    engine = bmc.HamiltonianMonteCarlo(500, warmup=600, chains=8, metric="dense")
    posterior, words = told(engine, horseshoe())
    mean = np.array([2.088394, -1.348899, 1.038351])
    off = (posterior.mean("b")[:3] - mean) / np.hypot(posterior.mcse("b")[:3], 0.003)
    assert np.abs(off).max() < 4.9
    assert any("trajectories diverged" in w for w in words)
