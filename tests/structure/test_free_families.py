"""Families whose log densities are composed: truncations, mixtures, joint parts, matrices, wrapped angles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError
from bayesmc.passes.interval_mass import log_mass
from tests.structure.test_unconstrained import check

S = np.array([[2.0, 0.3], [0.3, 1.0]])
INF = np.inf

Nodes = list[tuple[Any, ...]]
#: name -> (nodes, evidence, size of the plate)
MODELS: dict[str, tuple[Nodes, dict[str, Any], int]] = {}


def model(name: str, *nodes: Any, seen: Any = None, plate: int = 0) -> None:
    MODELS[name] = list(nodes), seen or {}, plate


model(
    "joint",
    ("a", bmc.Normal(0, 1)),
    ("x", lambda a: bmc.Joint(bmc.Normal(a, 1), bmc.Gamma(2.0, np.exp(a)), bmc.Beta(2.0, 2.0))),
)
model(
    "joint known",
    ("x", bmc.Joint(bmc.Normal(0.0, 1), bmc.Gamma(2.0, 1.0), bmc.Dirichlet(np.ones(3)))),
    ("y", lambda x: bmc.Normal(x[..., 0], 1.0)),
    seen={"y": 1.0},
)
model(
    "wishart",
    ("a", bmc.Gamma(2.0, 1.0)),
    ("x", lambda a: bmc.Wishart(3.0 + a, S)),
    ("y", lambda x: bmc.MvNormal(np.zeros(2), np.linalg.inv(x))),
    seen={"y": [0.3, 0.2]},
)
model(
    "iw",
    ("a", bmc.Gamma(2.0, 1.0)),
    ("x", lambda a: bmc.InverseWishart(4.0, S * a[..., None, None])),
    ("y", lambda x: bmc.MvNormal(np.zeros(2), x), "p"),
    seen={"y": [[0.3, 0.2], [1, 2.0]]},
    plate=2,
)
model("iw df", ("a", bmc.Normal(1.5, 1.0)), ("x", lambda a: bmc.InverseWishart(a, S)))
model(
    "wrapped",
    ("a", bmc.Gamma(2.0, 2.0)),
    ("m", bmc.WrappedNormal(1.0, 0.5)),
    ("y", lambda a, m: bmc.WrappedNormal(m, a), "p"),
    seen={"y": [0.3, 2.0, -3.0]},
    plate=3,
)
model(
    "wrapped scale",
    ("a", bmc.Normal(2.0, 2.0)),
    ("y", lambda a: bmc.WrappedNormal(0.3, a), "p"),
    seen={"y": [0.3, 2.0, -3.0]},
    plate=3,
)
model(
    "trunc weibull",
    ("k", bmc.Gamma(2.0, 2.0)),
    ("s", bmc.LogNormal(0.0, 1.0)),
    (
        "y",
        lambda k, s: bmc.Truncated(
            bmc.Weibull(k, s), np.array([0.1, 0.5, 0.0]), np.array([np.inf, 3.0, 2.0])
        ),
        "p",
    ),
    seen={"y": [0.3, 2.0, 1.0]},
    plate=3,
)
model(
    "trunc expon",
    ("k", bmc.Gamma(2.0, 2.0)),
    ("y", lambda k: bmc.Truncated(bmc.Exponential(k), k, np.inf), "p"),
    seen={"y": [0.3, 2.0, np.nan]},
    plate=3,
)
model(
    "trunc cauchy",
    ("k", bmc.Gamma(2.0, 2.0)),
    (
        "y",
        lambda k: bmc.Truncated(
            bmc.Cauchy(1.0, k), np.array([-np.inf, 0.5, -np.inf]), np.array([1.0, 3.0, np.inf])
        ),
        "p",
    ),
    seen={"y": [0.3, 2.0, np.nan]},
    plate=3,
)
model(
    "trunc hc",
    ("k", bmc.Gamma(2.0, 2.0)),
    ("y", lambda k: bmc.Truncated(bmc.HalfCauchy(k), 0.1, 9.0), "p"),
    seen={"y": [0.3, 2.0, np.nan]},
    plate=3,
)
model(
    "trunc hn",
    ("k", bmc.Gamma(2.0, 2.0)),
    ("y", lambda k: bmc.Truncated(bmc.HalfNormal(k), 0.1, 9.0), "p"),
    seen={"y": [0.3, 2.0, np.nan]},
    plate=3,
)
model(
    "trunc lognormal",
    ("k", bmc.Gamma(2.0, 2.0)),
    ("y", lambda k: bmc.Truncated(bmc.LogNormal(k, k), np.array([-1.0, 0.5, 0.1]), 9.0), "p"),
    seen={"y": [0.3, 2.0, np.nan]},
    plate=3,
)
model(
    "half t",
    ("s", bmc.Truncated(bmc.StudentT(3.0, 0.0, 2.0), 0.0)),
    ("y", lambda s: bmc.Normal(0.0, s)),
    seen={"y": 1.3},
)
model(
    "mixture mv",
    ("a", bmc.Normal(0, 1)),
    (
        "x",
        lambda a: bmc.Mixture(
            [0.5, 0.5],
            bmc.MvNormal(np.stack([np.stack([a, a], -1), np.stack([-a, 0 * a], -1)], -2), S),
        ),
    ),
)
model(
    "mixture unlike",
    ("w", bmc.Beta(2.0, 2.0)),
    (
        "y",
        lambda w: bmc.Mixture(bmc.stack([w, 1 - w]), [bmc.Normal(0.0, 1.0), bmc.Cauchy(w, 2.0)]),
        "p",
    ),
    seen={"y": [0.3, 20.0]},
    plate=2,
)
model(
    "mixture known",
    ("x", bmc.Mixture([0.3, 0.7], bmc.Normal([-1.0, 2.0], 0.5))),
    ("y", lambda x: bmc.Normal(x, 1.0)),
    seen={"y": 1.0},
)
model(
    "affine known",
    ("a", bmc.Normal(0, 1)),
    ("x", lambda a: bmc.Affine(bmc.StudentT(3.0, 0.0, 1.0), a, 2.0)),
)


@pytest.mark.parametrize("name", MODELS)
def test_value_and_gradient(name: str) -> None:
    nodes, evidence, plate = MODELS[name]
    net = bmc.BayesNet(plates={"p": plate} if plate else None)
    for node, cpd, *plates in nodes:
        net.add(node, cpd, plates=tuple(plates))
    density = bmc.log_density(net, evidence)._density
    assert check(density, np.random.default_rng(0)) > 0


def test_a_mass_without_closed_form_is_refused() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda a: bmc.Truncated(bmc.Gamma(a, 1.0), 0.5, 4.0))
    with pytest.raises(UnsupportedError, match="node 'y': no closed mass of Gamma"):
        bmc.log_density(net, {"y": 1.0})


#: family -> its parameters, bounds in the middle and far out
BOUNDS: dict[str, tuple[Callable[..., Any], dict[str, float], list[tuple[float, float]]]] = {
    "Normal": (
        bmc.Normal,
        {"loc": 0.5, "scale": 2.0},
        [(-1.0, 2.0), (30.0, INF), (-INF, -40.0), (30.0, 31.0), (-INF, INF)],
    ),
    "LogNormal": (
        bmc.LogNormal,
        {"loc": 0.5, "scale": 0.7},
        [(0.1, 2.0), (-1.0, 3.0), (100.0, INF), (0.0, INF), (500.0, 600.0)],
    ),
    "HalfNormal": (
        bmc.HalfNormal,
        {"scale": 0.7},
        [(0.1, 2.0), (-1.0, 0.5), (20.0, INF), (0.0, INF)],
    ),
    "Exponential": (
        bmc.Exponential,
        {"rate": 3.0},
        [(0.1, 2.0), (-1.0, 0.5), (300.0, INF), (1e-12, 2e-12), (0.0, INF)],
    ),
    "Weibull": (
        bmc.Weibull,
        {"concentration": 1.7, "scale": 2.0},
        [(0.1, 2.0), (-1.0, 0.5), (100.0, INF), (0.0, INF), (50.0, 50.1)],
    ),
    "Cauchy": (
        bmc.Cauchy,
        {"loc": 1.0, "scale": 2.0},
        [(-3.0, 4.0), (1e6, INF), (-INF, -1e6), (-INF, INF), (-5.0, -4.0), (1e5, 2e5)],
    ),
    "HalfCauchy": (
        bmc.HalfCauchy,
        {"scale": 2.0},
        [(0.5, 4.0), (1e6, INF), (-1.0, 3.0), (0.0, INF)],
    ),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_masses_are_those_of_the_family(name: str) -> None:
    make, parameters, bounds = BOUNDS[name]
    for low, high in bounds:
        with np.errstate(all="ignore"):
            found = log_mass(make, parameters, np.float64(low), np.float64(high))
        wanted = bmc.Truncated(make(**parameters), low, high).log_mass
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12, err_msg=f"{low}, {high}")
