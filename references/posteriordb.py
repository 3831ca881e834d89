"""Models of posteriordb, held against its reference draws, and rates with exact answers.

Flat priors are proper here, so wide that they are level over the posterior: Normals for coefficients,
a Uniform from 0 for scales. An ordered pair with equal priors is the sorted pair of two independent ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import bayesmc as bmc
from references.case import Case, Figures, Question

Columns = Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]


def regression(
    outcome: str,
    columns: Columns,
    sigma: bmc.Distribution,
    data: Any,
    log: Callable[[Any], Any] | None = None,
    flat: float = 1e4,
) -> Question:
    """A linear regression on ``columns``, with ``flat`` the prior scale of all coefficients."""
    variables = {name: np.array(value, dtype=float) for name, value in data.items()}
    y = variables[outcome]
    X = np.column_stack([np.ones(len(y)), *columns(variables)])
    net = bmc.BayesNet("regression", plates={"row": len(y)})
    net.input("X", plates="row", event_shape=(X.shape[1],))
    net.add("beta", bmc.MvNormal(np.zeros(X.shape[1]), scale_diag=np.full(X.shape[1], flat)))
    net.add("sigma", sigma)

    @net.node(plates="row")
    def response(X, beta, sigma):
        return bmc.Normal(np.vecdot(X, beta), sigma)

    return Question(net, {"response": y if log is None else log(y)}, {"X": X})


def kilpisjarvi(data: Any) -> Question:
    """Summer temperatures by year, not centred: intercept and slope are all but one number."""
    y = np.array(data["y"], dtype=float)
    X = np.column_stack([np.ones(len(y)), np.array(data["x"], dtype=float)])
    prior = ([data["pmualpha"], data["pmubeta"]], [data["psalpha"], data["psbeta"]])
    net = bmc.BayesNet("kilpisjarvi", plates={"year": len(y)})
    net.input("X", plates="year", event_shape=(2,))
    net.add("coefficients", bmc.MvNormal(prior[0], scale_diag=prior[1]))
    net.add("sigma", bmc.Uniform(0.0, 100.0))

    @net.node(plates="year")
    def response(X, coefficients, sigma):
        return bmc.Normal(np.vecdot(X, coefficients), sigma)

    return Question(net, {"response": y}, {"X": X})


def autoregression(data: Any) -> Question:
    """A series on its last K values, the first K taken as given."""
    K, y = data["K"], np.array(data["y"], dtype=float)
    lags = np.column_stack([y[K - k : len(y) - k] for k in range(1, K + 1)])
    net = bmc.BayesNet("arK", plates={"time": len(y) - K})
    net.input("lags", plates="time", event_shape=(K,))
    net.add("alpha", bmc.Normal(0.0, 10.0))
    net.add("beta", bmc.MvNormal(np.zeros(K), scale_diag=np.full(K, 10.0)))
    net.add("sigma", bmc.HalfCauchy(2.5))

    @net.node(plates="time")
    def response(lags, alpha, beta, sigma):
        return bmc.Normal(alpha + np.vecdot(lags, beta), sigma)

    return Question(net, {"response": y[K:]}, {"lags": lags})


def eight_schools(data: Any) -> Question:
    """Coaching effects in eight schools, not centred."""
    errors = np.array(data["sigma"], dtype=float)
    net = bmc.BayesNet("eight schools", plates={"school": len(errors)})
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("z", bmc.Normal(0.0, 1.0), plates="school")
    net.add("theta", lambda mu, tau, z: mu + tau * z, plates="school")
    net.add("y", lambda theta: bmc.Normal(theta, errors), plates="school")
    return Question(net, {"y": np.array(data["y"], dtype=float)})


def hidden_markov(data: Any) -> Question:
    """A hidden Markov model with two states, unrolled."""
    y = np.array(data["y"], dtype=float)
    net = bmc.BayesNet("hidden Markov", plates={"state": 2})
    net.add("theta", bmc.Dirichlet(np.ones(2)), plates="state")
    net.add("mu", bmc.Truncated(bmc.Normal([3.0, 10.0], 1.0), low=0.0), plates="state")
    net.potential("ordered", lambda mu: np.where(mu[0] < mu[1], 0.0, -np.inf))
    net.add("z[0]", bmc.Categorical([0.5, 0.5]))
    for t in range(1, len(y)):
        net.add(
            f"z[{t}]",
            lambda previous, theta: bmc.Categorical(theta[previous]),
            parents=[f"z[{t - 1}]", "theta"],
        )
    for t in range(len(y)):
        net.add(f"y[{t}]", lambda z, mu: bmc.Normal(mu[z], 1.0), parents=[f"z[{t}]", "mu"])
    return Question(net, {f"y[{t}]": value for t, value in enumerate(y)})


def gaussian_mixture(data: Any) -> Question:
    """Two Gaussians in proportions ``theta``, told apart by the order of their means."""
    y = np.array(data["y"], dtype=float)
    net = bmc.BayesNet("mixture", plates={"component": 2, "point": len(y)})
    net.add("unordered", bmc.Normal(0.0, 2.0), plates="component")
    net.add("mu", lambda unordered: np.sort(unordered.array, axis=-1))
    net.add("sigma", bmc.HalfNormal(2.0), plates="component")
    net.add("theta", bmc.Beta(5.0, 5.0))
    net.add("first", lambda theta: bmc.Bernoulli(theta), plates="point")

    @net.node(plates="point")
    def response(first, mu, sigma):
        return bmc.Normal(np.where(first, mu[..., 0], mu[..., 1]), sigma[1 - first])

    return Question(net, {"response": y})


def one_rate(data: Any) -> Question:
    """A rate, and counts predicted from its posterior and its prior."""
    net = bmc.BayesNet("one rate")
    net.add("theta", bmc.Beta(1.0, 1.0))
    net.add("k", lambda theta: bmc.Binomial(data["n"], theta))
    net.add("postpredk", lambda theta: bmc.Binomial(data["n"], theta))
    net.add("priortheta", bmc.Beta(1.0, 1.0))
    net.add("priorpredk", lambda priortheta: bmc.Binomial(data["n"], priortheta))
    return Question(net, {"k": data["k"]})


def two_rates(data: Any) -> Question:
    """Two rates and their difference."""
    net = bmc.BayesNet("two rates")
    net.add("theta1", bmc.Beta(1.0, 1.0))
    net.add("theta2", bmc.Beta(1.0, 1.0))
    net.add("k1", lambda theta1: bmc.Binomial(data["n1"], theta1))
    net.add("k2", lambda theta2: bmc.Binomial(data["n2"], theta2))
    net.add("delta", lambda theta1, theta2: theta1 - theta2)
    return Question(net, {"k1": data["k1"], "k2": data["k2"]})


def common_rate(data: Any) -> Question:
    """One rate behind two counts, and a count predicted."""
    net = bmc.BayesNet("common rate")
    net.add("theta", bmc.Beta(1.0, 1.0))
    net.add("k1", lambda theta: bmc.Binomial(data["n1"], theta))
    net.add("k2", lambda theta: bmc.Binomial(data["n2"], theta))
    net.add("postpredk1", lambda theta: bmc.Binomial(data["n1"], theta))
    return Question(net, {"k1": data["k1"], "k2": data["k2"]})


def _by_draws(posterior: str, build: Callable[[Any], Question], **options: Any) -> Case:
    """A model whose figures come from 10,000 reference draws."""

    def publish(content: Any) -> dict[str, Figures]:
        summary = content["reference"]["summary"]
        return {name: Figures(s["mean"], s["sd"], s["mcse_mean"]) for name, s in summary.items()}

    data, model = posterior.split("-")
    return _case(model, posterior, data, build, publish, **options)


def _exact(model: str, build: Callable[[Any], Question]) -> Case:
    """A model whose figures are exact."""

    def publish(content: Any) -> dict[str, Figures]:
        exact = content["reference"]["exact"][model]
        figures = {}
        for name, value in exact.items():
            if isinstance(value, list):  # a probability mass function on 0, 1, ...
                k = np.arange(len(value))
                mean = float(k @ value)
                sd = float(np.sqrt((k - mean) ** 2 @ value))
                figures[name.removesuffix("_pmf")] = Figures(mean, sd, 0.0)
            else:
                figures[name] = Figures(value["mean"], value["sd"], 0.0)
        return figures

    return _case(model, "exact_rates", f"{model}_data", build, publish)


def _case(
    model: str,
    reference: str,
    data: str,
    build: Callable[[Any], Question],
    publish: Callable[[Any], Mapping[str, Figures]],
    **options: Any,
) -> Case:
    files = {
        "data": f"posteriordb/data/{data}.json",
        "reference": f"posteriordb/reference/{reference}.json",
    }

    def question(content: Any) -> Question:
        return build(content["data"])

    return Case(model, "", files, question, publish, "posteriordb", **options)


def _earnings(model: str, columns: Columns, log: Any = np.log, **options: Any) -> Case:
    """Earnings on height and sex, with a scale that is flat far beyond the posterior."""
    wide = bmc.Uniform(0.0, 1e6 if log is None else 100.0)
    build = functools.partial(regression, "earn", columns, wide, log=log, **options)
    return _by_draws(f"earnings-{model}", build)


def _kidiq(model: str, columns: Columns) -> Case:
    """Test scores of children on their mothers' IQ and schooling."""
    build = functools.partial(regression, "kid_score", columns, bmc.HalfCauchy(2.5))
    return _by_draws(f"kidiq-{model}", build)


def _standardised(x: np.ndarray) -> np.ndarray:
    return (x - x.mean()) / x.std(ddof=1)


_HMM_MONITORS = {
    f"theta{row + 1}[{column + 1}]": ("theta", (row, column)) for row in (0, 1) for column in (0, 1)
}

POSTERIORDB: tuple[Case, ...] = (
    _by_draws("arK-arK", autoregression),
    _earnings("earn_height", lambda d: [d["height"]], log=None, flat=1e8),
    _earnings("log10earn_height", lambda d: [d["height"]], log=np.log10),
    _earnings("logearn_height", lambda d: [d["height"]]),
    _earnings("logearn_height_male", lambda d: [d["height"], d["male"]]),
    _earnings("logearn_interaction", lambda d: [d["height"], d["male"], d["height"] * d["male"]]),
    _earnings(
        "logearn_interaction_z",
        lambda d: [(z := _standardised(d["height"])), d["male"], z * d["male"]],
    ),
    _earnings("logearn_logheight_male", lambda d: [np.log(d["height"]), d["male"]]),
    _by_draws("eight_schools-eight_schools_noncentered", eight_schools),
    _by_draws("hmm_example-hmm_example", hidden_markov, monitors=_HMM_MONITORS),
    _kidiq("kidscore_momhs", lambda d: [d["mom_hs"]]),
    _kidiq("kidscore_momiq", lambda d: [d["mom_iq"]]),
    _kidiq("kidscore_momhsiq", lambda d: [d["mom_hs"], d["mom_iq"]]),
    _kidiq("kidscore_interaction", lambda d: [d["mom_hs"], d["mom_iq"], d["mom_hs"] * d["mom_iq"]]),
    _by_draws(
        "kilpisjarvi_mod-kilpisjarvi",
        kilpisjarvi,
        monitors={"alpha": ("coefficients", (0,)), "beta": ("coefficients", (1,))},
    ),
    _by_draws("low_dim_gauss_mix-low_dim_gauss_mix", gaussian_mixture),
    _exact("Rate_1", one_rate),
    _exact("Rate_2", two_rates),
    _exact("Rate_3", common_rate),
    _exact("Rate_4", one_rate),
    _exact("Rate_5", common_rate),
)
