"""Models for the invariance tests of continuous kernels, each with three overlapping categories or more."""

from __future__ import annotations

from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import PoseNormal
from tests.kernels.invariance import Model, mixture

SHARES = [0.2, 0.3, 0.5]
CENTRES = np.array([-1.0, 0.0, 1.5])
COV = np.array([[1.0, 0.4], [0.4, 0.7]])
RING, NEXT = np.arange(5), (np.arange(5) + 1) % 5
GAMMA = bmc.Gamma(3.0, 2.0)

# ---- models ------------------------------------------------------------------------------------------


def of_x(prior: Any, child: Any) -> Model:
    return Model(mixture(prior, child, 8), ("y",), ("x",))


def line() -> Model:
    return of_x(bmc.StudentT(5.0, 0.0, 1.0), lambda x: bmc.Normal(x, 1.2))


def half_line() -> Model:
    return of_x(GAMMA, lambda x: bmc.Gamma(x, 1.0))


def bounded() -> Model:
    return of_x(bmc.Truncated(bmc.Normal(0.0, 0.7), -1.0, 1.5), lambda x: bmc.Normal(x**2, 0.8))


def circle() -> Model:
    return of_x(bmc.VonMises(0.5, 1.0), lambda x: bmc.Normal(np.cos(x), 0.6))


def integers() -> Model:
    return of_x(bmc.Poisson(3.0), lambda x: bmc.Normal(1.0 * x, 2.0))


def pairs() -> Model:
    """Vectors, whose components move one after the other."""
    return of_x(
        bmc.Joint(bmc.Normal(0.0, 1.0), bmc.Uniform(0.0, 2.0)),
        lambda x: bmc.Normal(x[..., 0] * x[..., 1], 0.8),
    )


def simplex() -> Model:
    return of_x(bmc.Dirichlet([1.0, 2.0, 1.5]), lambda x: bmc.Categorical(x))


def matrices() -> Model:
    return of_x(bmc.InverseWishart(5.0, 2 * COV), lambda x: bmc.MvNormal(np.ones(2), x))


def moving_bounds(moved: str) -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 8})
    net.add("top", bmc.Gamma(4.0, 2.0))
    net.add("x", lambda top: bmc.Truncated(bmc.Normal(0.5, 0.7), -0.5, top), plates="k")
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda x, label: bmc.Normal(x[label] ** 2, 1.0), plates="i")
    return Model(net, ("y",), (moved,))


def moving_integers() -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 8})
    net.add("total", bmc.Poisson(6.0))
    net.add("x", lambda total: bmc.Binomial(total, 0.4), plates="k")
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda x, label: bmc.Normal(1.0 * x[label], 3.0), plates="i")
    return Model(net, ("y",), ("x",))


def ring() -> Model:
    """Neighbours share data: elements of three colours."""
    net = bmc.BayesNet(plates={"k": 5, "pair": 5})
    net.add("x", bmc.Gamma(2.0, 2.0), plates="k")
    net.add("y", lambda x: bmc.Normal(x[RING] * x[NEXT], 0.7), plates="pair")
    return Model(net, ("y",))


def several() -> Model:
    """Nodes of all kinds that share their data."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("a", bmc.StudentT(5.0, 0.0, 1.0))
    net.add("s", bmc.Gamma(3.0, 2.0))
    net.add("v", bmc.MvNormal([0.0, 0.5], COV))
    net.add("u", bmc.Uniform(0.0, 1.0))
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add(
        "y",
        lambda a, s, v, u, label: bmc.Normal(
            a + s * CENTRES[label] + v[..., 0] * v[..., 1], 0.3 + u
        ),
        plates="i",
    )
    return Model(net, ("y",), ("a", "s", "v", "u"))


def few() -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 8})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x", lambda a: bmc.Gamma(3.0, np.exp(a)), plates="k")
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda x, label: bmc.Normal(1.0, x[label]), plates="i")
    return Model(net, ("y",), ("a", "x"))


def two() -> Model:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("s", bmc.Gamma(3.0, 2.0))
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda a, s, label: bmc.Normal(a + CENTRES[label], s), plates="i")
    return Model(net, ("y",), ("a", "s"))


def heading(prior: Any) -> Model:
    """A number and an angle that share their data."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("h", prior)
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add(
        "y",
        lambda a, h, label: bmc.Normal(a + np.sin(h) + CENTRES[label] * np.cos(h), 1.0),
        plates="i",
    )
    return Model(net, ("y",), ("a", "h"))


def robot() -> Model:
    """A pose whose heading lies near the cut of the circle, and goes with its position."""
    cov = [[0.5, 0.1, 0.2], [0.1, 0.4, -0.1], [0.2, -0.1, 0.5]]
    net = bmc.BayesNet(plates={"i": 4})
    net.add("x", PoseNormal([0.0, 1.0, np.pi - 0.2], cov))
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add(
        "y",
        lambda x, label: bmc.Normal(
            x[..., 0] + np.sin(x[..., 2]) + CENTRES[label] * x[..., 1] * np.cos(x[..., 2]), 1.0
        ),
        plates="i",
    )
    return Model(net, ("y",), ("x",))


def labels() -> Model:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("z", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda z: bmc.Normal(CENTRES[z], 1.0), plates="i")
    return Model(net, ("y",))
