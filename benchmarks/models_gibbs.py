"""The models that samplers are timed on: a mixture, a grid, eight schools, rats, ten scalars.

``bmc`` is handed in as the module that supplies distributions, as in ``benchmarks.models``: nothing
here imports bayesmc. The same models for JAGS are ``peers/jags_*.bug``, for PyMC in
``peers/pymc_models.py``, by hand under ``floors/``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class MixturePrior:
    """Dirichlet(concentration), means N(0, variance I), covariances IW(df, scatter I)."""

    concentration: float
    variance: float
    df: float
    scatter: float


MIXTURE_PRIOR = MixturePrior(1.0, 100.0, 4.0, 1.0)
MIXTURE_START = ((-2.0, 0.0), (2.0, 1.0), (0.0, -3.0))
"""Start of the hand-written samplers and of JAGS; also where the data's components lie."""

COUPLING, FIELD = 0.4, 0.1
"""Of the Ising grid: below the critical coupling of 0.44, with a weak field."""

EIGHT_SCHOOLS = {
    "y": [28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0],
    "sigma": [15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0],
}


def mixture_points(count: int) -> np.ndarray:
    """Points of three overlapping components, (count, 2)."""
    rng = np.random.default_rng(count)
    label = rng.choice(3, count, p=[0.5, 0.3, 0.2])
    roots = np.array(
        [[[1.0, 0.0], [0.3, 0.8]], [[0.7, 0.0], [-0.2, 0.9]], [[1.2, 0.0], [0.1, 0.6]]]
    )
    return np.array(MIXTURE_START)[label] + np.matvec(roots[label], rng.standard_normal((count, 2)))


def mixture(bmc: Any, count: int) -> Any:
    """The Gaussian mixture over ``count`` points; evidence is ``{"x": points}``."""
    prior = MIXTURE_PRIOR
    net = bmc.BayesNet("mixture", plates={"cluster": 3, "point": count})

    @net.node
    def weights():
        return bmc.Dirichlet(np.full(3, prior.concentration))

    @net.node(plates="cluster")
    def mean():
        return bmc.MvNormal(np.zeros(2), prior.variance * np.eye(2))

    @net.node(plates="cluster")
    def covariance():
        return bmc.InverseWishart(prior.df, prior.scatter * np.eye(2))

    @net.node(plates="point")
    def label(weights):
        return bmc.Categorical(weights)

    @net.node(plates="point")
    def x(label, mean, covariance):
        return bmc.MvNormal(mean[label], covariance[label])

    return net


def grid_pairs(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Every pair of neighbours of a ``size`` by ``size`` grid with free boundaries, once."""
    site = np.arange(size * size).reshape(size, size)
    first = np.concatenate([site[:, :-1].ravel(), site[:-1].ravel()])
    second = np.concatenate([site[:, 1:].ravel(), site[1:].ravel()])
    return first, second


def ising(bmc: Any, size: int) -> Any:
    """The grid as a factor graph: one call for the pairs, one for the sites."""
    graph = bmc.FactorGraph("ising", plates={"site": size * size})
    graph.variable("s", (-1, 1), plates="site")
    graph.factor(lambda a, b: COUPLING * a * b, scope=("s", "s"), index=grid_pairs(size))
    graph.factor(lambda s: FIELD * s, scope=("s",), index=(np.arange(size * size),))
    return graph


def eight_schools(bmc: Any, centred: bool) -> Any:
    """Rubin's eight schools; evidence is ``{"y": EIGHT_SCHOOLS["y"]}``."""
    sigma = np.array(EIGHT_SCHOOLS["sigma"])
    net = bmc.BayesNet("eight schools", plates={"school": len(sigma)})

    @net.node
    def mu():
        return bmc.Normal(0.0, 5.0)

    @net.node
    def tau():
        return bmc.HalfCauchy(5.0)

    if centred:

        @net.node(plates="school")
        def theta(mu, tau):
            return bmc.Normal(mu, tau)

    else:

        @net.node(plates="school")
        def z():
            return bmc.Normal(0.0, 1.0)

        @net.node(plates="school", name="theta")
        def theta_of(mu, tau, z):
            return mu + tau * z

    @net.node(plates="school")
    def y(theta):
        return bmc.Normal(theta, sigma)

    return net


def rats_data(data: Path) -> dict[str, np.ndarray]:
    """``Y``, (30, 5) weights in grams, and ``x``, 5 days, from the BUGS reference data."""
    found = json.loads((data / "bugs" / "jags_classic" / "rats.json").read_text())
    values = found["data"]["rats-data.R"]
    return {"Y": np.array(values["Y"], float), "x": np.array(values["x"], float)}


def rats(bmc: Any, days: np.ndarray) -> Any:
    """Growth of 30 rats, intercepts and slopes by rat (BUGS); evidence is ``{"y": Y}``."""
    centred = days - days.mean()
    net = bmc.BayesNet("rats", plates={"rat": 30, "day": len(days)})
    for name in ("tau_c", "tau_alpha", "tau_beta"):
        net.add(name, bmc.Gamma(1e-3, 1e-3))
    for name in ("alpha_c", "beta_c"):
        net.add(name, bmc.Normal(0.0, 100.0))

    @net.node(plates="rat")
    def alpha(alpha_c, tau_alpha):
        return bmc.Normal(alpha_c, 1.0 / np.sqrt(tau_alpha))

    @net.node(plates="rat")
    def beta(beta_c, tau_beta):
        return bmc.Normal(beta_c, 1.0 / np.sqrt(tau_beta))

    @net.node(plates=("rat", "day"))
    def y(alpha, beta, tau_c):
        return bmc.Normal(alpha + beta * centred, 1.0 / np.sqrt(tau_c))

    return net


def ten_scalars(bmc: Any) -> tuple[Any, dict[str, float]]:
    """Ten hidden scalars that want five kinds of kernel, and evidence: what a sweep costs at least.

    Every node is declared by a function of its own, so that nothing can be stacked.
    """
    net = bmc.BayesNet("ten scalars")
    net.add("share", bmc.Beta(2.0, 2.0))
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("precision", bmc.Gamma(2.0, 2.0))
    net.add("level", bmc.Normal(0.0, 3.0))
    net.add("variance", bmc.InverseGamma(3.0, 2.0))
    net.add("regime", lambda share: bmc.Bernoulli(share), parents=["share"])
    net.add("kind", lambda regime: bmc.Categorical(KINDS[regime]), parents=["regime"])
    net.add(
        "slope",
        lambda level, precision: bmc.Normal(0.5 * level, 1.0 / np.sqrt(precision)),
        parents=["level", "precision"],
    )
    net.add("shift", lambda kind: bmc.Normal(SHIFTS[kind], 1.0), parents=["kind"])
    net.add(
        "heavy",
        lambda level, shift: bmc.StudentT(4.0, level + shift, 1.0),
        parents=["level", "shift"],
    )
    net.add("count", lambda rate: bmc.Poisson(3.0 * rate), parents=["rate"])
    net.add("hits", lambda share: bmc.Binomial(20, share), parents=["share"])
    net.add(
        "seen",
        lambda slope, shift, variance: bmc.Normal(slope + shift, np.sqrt(variance)),
        parents=["slope", "shift", "variance"],
    )
    net.add("late", lambda heavy: bmc.Normal(heavy, 0.5), parents=["heavy"])
    return net, {"count": 7, "hits": 13, "seen": 1.4, "late": 0.8}


KINDS = np.array([[0.6, 0.3, 0.1], [0.1, 0.3, 0.6]])
SHIFTS = np.array([-1.0, 0.0, 2.0])
