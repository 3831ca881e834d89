"""Joint densities of the reference models written by hand, each with a random point to try it at.

A density takes the data and a generator and gives values of all stochastic nodes with their log density.
Distributions are SciPy's, and ``normal`` takes precisions, as the BUGS examples are published.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import stats

from references import CASES, Case, data_folder

Values = dict[str, Any]
Point = tuple[Values, float]
Density = Callable[[Any, np.random.Generator], Point]
BY_NAME = {case.name: case for case in CASES}


def normal(x: Any, mean: Any, precision: Any) -> float:
    return float(np.sum(stats.norm.logpdf(x, mean, np.asarray(precision, dtype=float) ** -0.5)))


def gamma(x: Any, shape: float, rate: Any) -> float:
    return float(np.sum(stats.gamma.logpdf(x, shape, scale=1 / np.asarray(rate, dtype=float))))


def vague_precisions(*taus: float) -> float:
    return sum(gamma(tau, 0.001, 0.001) for tau in taus)


def filled(data: Any, rng: np.random.Generator, centre: float, spread: float) -> np.ndarray:
    """Observations, with the missing ones made up."""
    y = np.array(data, dtype=float)
    return np.where(np.isnan(y), rng.normal(centre, spread, y.shape), y)


def rats(d: Any, rng: np.random.Generator) -> Point:
    Y = filled(d["Y"], rng, 250, 30)
    x = np.array(d["x"])
    tau_c, tau_alpha, tau_beta = rng.gamma(5, 0.01), rng.gamma(5, 0.001), rng.gamma(5, 1.0)
    alpha_c, beta_c = rng.normal(240, 5), rng.normal(6, 0.2)
    alpha, beta = rng.normal(240, 15, len(Y)), rng.normal(6, 0.5, len(Y))
    logp = normal(alpha_c, 0, 1e-4) + normal(beta_c, 0, 1e-4)
    logp += vague_precisions(tau_c, tau_alpha, tau_beta)
    logp += normal(alpha, alpha_c, tau_alpha) + normal(beta, beta_c, tau_beta)
    for i in range(len(Y)):
        for j in range(len(x)):
            logp += normal(Y[i, j], alpha[i] + beta[i] * (x[j] - np.mean(x)), tau_c)
    values = {"tau_c": tau_c, "tau_alpha": tau_alpha, "tau_beta": tau_beta, "alpha_c": alpha_c}
    return {**values, "beta_c": beta_c, "alpha": alpha, "beta": beta, "Y": Y}, logp


def line(d: Any, rng: np.random.Generator) -> Point:
    x, Y = np.array(d["x"]), np.array(d["Y"], dtype=float)
    alpha, beta, tau = rng.normal(3, 1), rng.normal(0.8, 0.4), rng.gamma(2, 1)
    logp = normal(alpha, 0, 1e-4) + normal(beta, 0, 1e-4) + vague_precisions(tau)
    logp += normal(Y, alpha + beta * (x - 3), tau)
    return {"alpha": alpha, "beta": beta, "tau": tau, "Y": Y}, logp


def dyes(d: Any, rng: np.random.Generator) -> Point:
    y = np.array(d["y"], dtype=float)
    theta, mu = rng.normal(1500, 50), rng.normal(1500, 50, 6)
    tw, tb = rng.gamma(2, 1e-4), rng.gamma(2, 1e-3)
    logp = normal(theta, 0, 1e-10) + vague_precisions(tw, tb) + normal(mu, theta, tb)
    logp += sum(normal(y[i], mu[i], tw) for i in range(6))
    return {"theta": theta, "mu": mu, "tau_within": tw, "tau_between": tb, "y": y}, logp


def equiv(d: Any, rng: np.random.Generator) -> Point:
    Y = filled(d["Y"], rng, 1.4, 0.2)
    mu, phi, pi = rng.normal(0, 1, 3)
    tau1, tau2 = rng.gamma(2, 20, 2)
    delta = rng.normal(0, 0.2, 10)
    logp = normal([mu, phi, pi], 0, 1e-6) + vague_precisions(tau1, tau2) + normal(delta, 0, tau2)
    for i, group in enumerate(d["group"]):
        for k in (1, 2):
            treatment = group * (k - 1.5) + 1.5
            mean = mu + (-1) ** (treatment - 1) * phi / 2 + (-1) ** (k - 1) * pi / 2 + delta[i]
            logp += normal(Y[i, k - 1], mean, tau1)
    return {
        "mu": mu,
        "phi": phi,
        "pi": pi,
        "tau": tau1,
        "tau_delta": tau2,
        "delta": delta,
        "Y": Y,
    }, logp


def stacks(d: Any, rng: np.random.Generator) -> Point:
    Y, x = np.array(d["Y"], dtype=float), np.array(d["x"], dtype=float)
    beta0, beta, tau = rng.normal(17, 2), rng.normal(0, 5, 3), rng.gamma(2, 0.1)
    logp = normal(beta0, 0, 1e-5) + normal(beta, 0, 1e-5) + vague_precisions(tau)
    z = stats.zscore(x, ddof=1)
    logp += normal(Y, beta0 + z @ beta, tau)
    return {"beta0": beta0, "beta": beta, "tau": tau, "Y": Y}, logp


def seeds(test: str) -> Density:
    def density(d: Any, rng: np.random.Generator) -> Point:
        x1, x2, r, n = (np.array(d[key]) for key in ("x1", "x2", "r", "n"))
        a = rng.normal(0, 0.5, 4)
        b, sigma = rng.normal(0, 0.5, 21), rng.uniform(0.1, 1)
        fixed = a[0] + a[1] * x1 + a[2] * x2 + a[3] * x1 * x2
        logp, values = normal(a, 0, 1e-6), dict(zip(_SEEDS_NAMES, a, strict=True))
        if test == "test1":
            effect, random = b, {"tau": sigma**-2, "logit_p": fixed + b}
            logp += vague_precisions(sigma**-2) + normal(b, 0, sigma**-2)
        elif test == "test2":
            effect, random = b - b.sum() / 21, {"tau": sigma**-2, "c": b}
            logp += vague_precisions(sigma**-2) + normal(b, 0, sigma**-2)
        elif test in ("test3", "test4"):
            effect, random = sigma * b, {"sigma": sigma, "z": b}
            logp += -sigma if test == "test3" else -math.log(10)
            logp += normal(b, 0, 1)
        else:  # a density of tau becomes one of sigma with the Jacobian of sigma ** -2
            effect, random = b, {"sigma": sigma, "logit_p": fixed + b}
            logp += stats.pareto.logpdf(sigma**-2, 0.5, scale=0.01) + math.log(2 * sigma**-3)
            logp += normal(b, 0, sigma**-2)
        logp += stats.binom.logpmf(r, n, stats.logistic.cdf(fixed + effect)).sum()
        return {**values, **random, "r": r}, float(logp)

    return density


_SEEDS_NAMES = ("alpha0", "alpha1", "alpha2", "alpha12")


def surgical_fixed(d: Any, rng: np.random.Generator) -> Point:
    p = rng.uniform(0.02, 0.2, 12)
    return {"p": p, "r": d["r"]}, float(stats.binom.logpmf(d["r"], d["n"], p).sum())


def surgical_random(d: Any, rng: np.random.Generator) -> Point:
    mu, tau, b = rng.normal(-2.5, 0.2), rng.gamma(5, 1), rng.normal(-2.5, 0.4, 12)
    logp = normal(mu, 0, 1e-6) + vague_precisions(tau) + normal(b, mu, tau)
    logp += stats.binom.logpmf(d["r"], d["n"], 1 / (1 + np.exp(-b))).sum()
    return {"mu": mu, "tau": tau, "b": b, "r": d["r"]}, float(logp)


def beetles(inverse_link: Callable[[Any], Any]) -> Density:
    def density(d: Any, rng: np.random.Generator) -> Point:
        a, b = rng.normal(0.7, 0.1), rng.normal(20, 2)
        x = np.array(d["x"])
        p = inverse_link(a + b * (x - x.sum() / 8))
        logp = normal([a, b], 0, 1e-3) + stats.binom.logpmf(d["r"], d["n"], p).sum()
        return {"alpha_star": a, "beta": b, "r": d["r"]}, float(logp)

    return density


def hearts(d: Any, rng: np.random.Generator) -> Point:
    alpha, delta = rng.normal(-0.5, 0.3), rng.normal(0.3, 0.5)
    cured = (np.array(d["y"]) == 0) & (rng.random(12) < 0.7)
    p, theta = stats.logistic.cdf([alpha, delta])
    logp = normal([alpha, delta], 0, 1e-4)
    for y, t, is_cured in zip(d["y"], d["t"], cured, strict=True):
        logp += math.log(theta) if is_cured else math.log1p(-theta) + stats.binom.logpmf(y, t, p)
    state = np.where(cured, "cured", "sick")
    return {"alpha": alpha, "delta": delta, "state": state, "y": d["y"]}, float(logp)


def pump(d: Any, rng: np.random.Generator) -> Point:
    alpha, beta, theta = rng.gamma(2, 0.3), rng.gamma(2, 0.5), rng.gamma(1, 0.5, 10)
    logp = -alpha + gamma(beta, 0.1, 1) + gamma(theta, alpha, beta)
    logp += stats.poisson.logpmf(d["x"], theta * np.array(d["t"])).sum()
    return {"alpha": alpha, "beta": beta, "theta": theta, "x": d["x"]}, float(logp)


def salm(test: str) -> Density:
    def density(d: Any, rng: np.random.Generator) -> Point:
        x, y = np.array(d["x"], dtype=float), np.array(d["y"])
        a, b, g, sigma = rng.normal(3, 0.2), rng.normal(0.3, 0.1), rng.normal(0, 1e-3), 0.3
        residual = rng.normal(0, 0.3, (6, 3))
        lx = np.log(x + 10)
        eta = (a + b * (lx - lx.mean()) + g * (x - x.mean()))[:, None] + residual
        logp = normal([a, b], 0, 1e-4) + normal(g, 0, 1e-10) + normal(residual, 0, sigma**-2)
        logp += stats.poisson.logpmf(y, np.exp(eta)).sum()
        values = {"alpha_star": a, "beta": b, "gamma": g, "log_rate": eta, "y": y}
        if test == "test1":
            return {**values, "tau": sigma**-2}, float(logp + vague_precisions(sigma**-2))
        logp += stats.pareto.logpdf(sigma**-2, 0.5, scale=0.04) + math.log(2 * sigma**-3)
        return {**values, "sigma": sigma}, float(logp)

    return density


def epil(test: str) -> Density:
    def density(d: Any, rng: np.random.Generator) -> Point:
        c, v4 = rng.normal(0, 0.3, 5), rng.normal(0, 0.2)
        tau_b1, tau_b = rng.gamma(5, 1, 2)
        b1, b = rng.normal(0, 0.5, 59), rng.normal(0, 0.3, (59, 4))
        logp = normal(c, 0, 1e-4) + normal(v4, 0, 1e-4) + vague_precisions(tau_b1)
        logp += normal(b1, 0, tau_b1)
        if test == "test2":
            logp += vague_precisions(tau_b) + normal(b, 0, tau_b)
        effect, log_rate = np.empty(59), np.empty((59, 4))
        for j in range(59):
            log_base = math.log(d["Base"][j] / 4)
            treated = d["Trt"][j]
            effect[j] = c[0] + c[1] * log_base + c[2] * treated + c[3] * treated * log_base
            effect[j] += c[4] * math.log(d["Age"][j]) + b1[j]
            for k in range(4):
                log_rate[j, k] = effect[j] + v4 * d["V4"][k] + (b[j, k] if test == "test2" else 0)
                logp += stats.poisson.logpmf(d["y"][j][k], math.exp(log_rate[j, k]))
        values = {
            "coefficients": c,
            "alpha_V4": v4,
            "tau_b1": tau_b1,
            "patient_effect": effect,
            "y": d["y"],
        }
        if test == "test2":
            values |= {"tau_b": tau_b, "log_rate": log_rate}
        return values, float(logp)

    return density


def asia(d: Any, rng: np.random.Generator) -> Point:
    s, t, c, b, x = rng.integers(0, 2, 5)
    either = max(t, c)
    p = 0.5 * d["p.smoking"][s] * d["p.tuberculosis"][d["asia"] - 1][t]
    p *= d["p.lung.cancer"][s][c] * d["p.bronchitis"][s][b] * d["p.xray"][either][x]
    p *= d["p.dyspnoea"][either][b][d["dyspnoea"] - 1]
    hidden = {"smoking": s, "tuberculosis": t, "lung_cancer": c, "bronchitis": b, "xray": x}
    values = {name: value + 1 for name, value in hidden.items()}
    return {**values, "asia": d["asia"], "dyspnoea": d["dyspnoea"]}, math.log(p)


def asia_learnt(d: Any, rng: np.random.Generator) -> Point:
    theta = rng.dirichlet([1, 1], 2)
    smoking = [rng.integers(1, 3) if value is None else value for value in d["smoking"]]
    seen = {name: d[name] for name in ("asia", "tuberculosis", "lung.cancer", "bronchitis")}
    seen |= {"smoking": smoking, "xray": d["xray"], "dyspnoea": d["dyspnoea"]}
    logp = 0.0
    for i in range(d["N"]):
        v = {name: values[i] - 1 for name, values in seen.items()}
        either = max(v["tuberculosis"], v["lung.cancer"])
        logp += math.log(0.5 * d["p.smoking"][v["smoking"]])
        logp += math.log(d["p.tuberculosis"][v["asia"]][v["tuberculosis"]])
        logp += math.log(d["p.lung.cancer"][v["smoking"]][v["lung.cancer"]])
        logp += math.log(theta[v["smoking"], v["bronchitis"]])
        logp += math.log(d["p.xray"][either][v["xray"]])
        logp += math.log(d["p.dyspnoea"][either][v["bronchitis"]][v["dyspnoea"]])
    return {name.replace(".", "_"): value for name, value in seen.items()} | {
        "theta_b": theta
    }, logp


def eyes(d: Any, rng: np.random.Generator) -> Point:
    y = np.array(d["y"])
    P, T = rng.dirichlet([5, 5]), (y > 543).astype(int)
    T[rng.integers(0, 48, 5)] ^= 1
    lambda1, theta, tau = rng.normal(537, 1), rng.normal(12, 1), rng.gamma(5, 0.02)
    logp = normal(lambda1, 0, 1e-6) + normal(theta, 0, 1e-6) + math.log(2) + gamma(tau, 0.01, 0.01)
    logp += np.log(P[T]).sum() + normal(y, np.array([lambda1, lambda1 + theta])[T], tau)
    return {"P": P, "lambda1": lambda1, "theta": theta, "tau": tau, "group": T, "y": y}, float(logp)


def regression(case: str, prior_of_sigma: Callable[[float], float]) -> Callable[..., Point]:
    """Coefficients are flat here; ``case`` says where the interesting points are."""

    def density(d: Any, rng: np.random.Generator) -> Point:
        at = drawn(BY_NAME[case], rng)
        sigma = at.pop("sigma")
        beta = np.array(list(at.values()))
        y, columns = _RESPONSES[case](d)
        logp = normal(y, sum(b * x for b, x in zip(beta, [1.0, *columns], strict=True)), sigma**-2)
        return {"beta": beta, "sigma": sigma, "response": y}, logp + prior_of_sigma(sigma)

    return density


def drawn(case: Case, rng: np.random.Generator) -> dict[str, float]:
    """Every published parameter near its published mean."""
    published = case.published(data_folder())
    return {name: f.mean + 0.5 * f.sd * rng.normal() for name, f in published.items()}


def _half_cauchy(sigma: float) -> float:
    return float(stats.halfcauchy.logpdf(sigma, scale=2.5))


def _flat(sigma: float) -> float:
    return 0.0


def _columns(d: Any, *names: str) -> list[np.ndarray]:
    return [np.array(d[name], dtype=float) for name in names]


def _earnings(d: Any, log: Callable[[Any], Any], *columns: np.ndarray) -> Any:
    return log(np.array(d["earn"], dtype=float)), columns


_RESPONSES: dict[str, Callable[[Any], Any]] = {
    "earn_height": lambda d: _earnings(d, lambda y: y, *_columns(d, "height")),
    "log10earn_height": lambda d: _earnings(d, np.log10, *_columns(d, "height")),
    "logearn_height": lambda d: _earnings(d, np.log, *_columns(d, "height")),
    "logearn_height_male": lambda d: _earnings(d, np.log, *_columns(d, "height", "male")),
    "logearn_interaction": lambda d: _earnings(
        d, np.log, *_columns(d, "height", "male"), np.multiply(d["height"], d["male"])
    ),
    "logearn_interaction_z": lambda d: _earnings(
        d,
        np.log,
        z := stats.zscore(np.array(d["height"], dtype=float), ddof=1),
        *_columns(d, "male"),
        z * d["male"],
    ),
    "logearn_logheight_male": lambda d: _earnings(
        d, np.log, np.log(d["height"]), *_columns(d, "male")
    ),
    "kidscore_momhs": lambda d: (_columns(d, "kid_score")[0], _columns(d, "mom_hs")),
    "kidscore_momiq": lambda d: (_columns(d, "kid_score")[0], _columns(d, "mom_iq")),
    "kidscore_momhsiq": lambda d: (_columns(d, "kid_score")[0], _columns(d, "mom_hs", "mom_iq")),
    "kidscore_interaction": lambda d: (
        _columns(d, "kid_score")[0],
        [*_columns(d, "mom_hs", "mom_iq"), np.multiply(d["mom_hs"], d["mom_iq"])],
    ),
}


def kilpisjarvi(d: Any, rng: np.random.Generator) -> Point:
    beta, sigma = rng.normal(0.0176, 0.007), rng.uniform(0.9, 1.4)
    y = np.array(d["y"])
    alpha = y.mean() - beta * np.mean(d["x"]) + rng.normal(0, 0.3)
    logp = stats.norm.logpdf(alpha, d["pmualpha"], d["psalpha"])
    logp += stats.norm.logpdf(beta, d["pmubeta"], d["psbeta"])
    logp += normal(y, alpha + beta * np.array(d["x"]), sigma**-2)
    return {"coefficients": [alpha, beta], "sigma": sigma, "response": y}, float(logp)


def autoregression(d: Any, rng: np.random.Generator) -> Point:
    y, K = d["y"], d["K"]
    alpha, beta, sigma = rng.normal(0, 0.01), rng.normal(0, 0.3, K), rng.uniform(0.1, 0.3)
    logp = normal(alpha, 0, 0.01) + normal(beta, 0, 0.01) + _half_cauchy(sigma)
    for t in range(K, d["T"]):
        mean = alpha + sum(beta[k - 1] * y[t - k] for k in range(1, K + 1))
        logp += normal(y[t], mean, sigma**-2)
    return {"alpha": alpha, "beta": beta, "sigma": sigma, "response": y[K:]}, logp


def eight_schools(d: Any, rng: np.random.Generator) -> Point:
    mu, tau, z = rng.normal(4, 3), rng.gamma(2, 2), rng.normal(0, 1, 8)
    logp = normal(mu, 0, 1 / 25) + float(stats.halfcauchy.logpdf(tau, scale=5)) + normal(z, 0, 1)
    logp += float(stats.norm.logpdf(d["y"], mu + tau * z, d["sigma"]).sum())
    return {"mu": mu, "tau": tau, "z": z, "y": np.array(d["y"], dtype=float)}, logp


def hidden_markov(d: Any, rng: np.random.Generator) -> Point:
    theta, mu = rng.dirichlet([3, 3], 2), np.sort(rng.normal([3, 9], 0.3))
    z = rng.integers(0, 2, d["N"])
    logp = normal(mu, [3, 10], 1) + normal(d["y"], mu[z], 1)
    logp += sum(math.log(theta[z[t - 1], z[t]]) for t in range(1, d["N"]))
    values: Values = {f"z[{t}]": z[t] for t in range(d["N"])}
    values |= {f"y[{t}]": d["y"][t] for t in range(d["N"])}
    return {**values, "theta": theta, "mu": mu}, logp


def gaussian_mixture(d: Any, rng: np.random.Generator) -> Point:
    mu, sigma, theta = rng.normal([-2.7, 2.9], 0.3), rng.gamma(5, 0.2, 2), rng.beta(5, 5)
    y = np.array(d["y"])
    second = (y > 0) ^ (rng.random(len(y)) < 0.01)
    logp = normal(mu, 0, 1 / 4) + 2 * math.log(2) + normal(sigma, 0, 1 / 4)
    logp += float(stats.beta.logpdf(theta, 5, 5))
    for s, weight in ((False, theta), (True, 1 - theta)):
        logp += (second == s).sum() * math.log(weight)
        logp += normal(y[second == s], mu[int(s)], sigma[int(s)] ** -2)
    values = {"unordered": rng.permutation(mu), "sigma": sigma, "theta": theta}
    return {**values, "first": 1 - second, "response": y}, logp


def one_rate(d: Any, rng: np.random.Generator) -> Point:
    theta, prior = rng.uniform(size=2)
    k = rng.integers(0, d["n"] + 1, 2)
    logp = stats.binom.logpmf(d["k"], d["n"], theta) + stats.binom.logpmf(k[0], d["n"], theta)
    logp += stats.binom.logpmf(k[1], d["n"], prior)
    values = {
        "theta": theta,
        "k": d["k"],
        "postpredk": k[0],
        "priortheta": prior,
        "priorpredk": k[1],
    }
    return values, float(logp)


def two_rates(d: Any, rng: np.random.Generator) -> Point:
    theta = rng.uniform(size=2)
    logp = stats.binom.logpmf([d["k1"], d["k2"]], [d["n1"], d["n2"]], theta).sum()
    return {"theta1": theta[0], "theta2": theta[1], "k1": d["k1"], "k2": d["k2"]}, float(logp)


def common_rate(d: Any, rng: np.random.Generator) -> Point:
    theta, k = rng.uniform(), rng.integers(0, d["n1"] + 1)
    ks, ns = [d["k1"], d["k2"], k], [d["n1"], d["n2"], d["n1"]]
    logp = stats.binom.logpmf(ks, ns, theta).sum()
    return {"theta": theta, "k1": d["k1"], "k2": d["k2"], "postpredk1": k}, float(logp)


DENSITIES: dict[str, Density] = {
    "rats test1": rats,
    "rats test2": rats,
    "line test1": line,
    "dyes test1": dyes,
    "equiv test1": equiv,
    "equiv test2": equiv,
    "stacks": stacks,
    **{f"seeds {test}": seeds(test) for test in ("test1", "test2", "test3", "test4", "test5")},
    "surgical fixed": surgical_fixed,
    "surgical random": surgical_random,
    "beetles test1": beetles(stats.logistic.cdf),
    "beetles test2": beetles(stats.norm.cdf),
    "beetles test3": beetles(stats.gumbel_l.cdf),
    "hearts test1": hearts,
    "pump test1": pump,
    **{f"salm {test}": salm(test) for test in ("test1", "test2")},
    **{f"epil {test}": epil(test) for test in ("test1", "test2")},
    "asia test1": asia,
    "asia test2": asia_learnt,
    "eyes test1": eyes,
    "arK": autoregression,
    **{n: regression(n, _half_cauchy if "kid" in n else _flat) for n in _RESPONSES},
    "eight_schools_noncentered": eight_schools,
    "hmm_example": hidden_markov,
    "kilpisjarvi": kilpisjarvi,
    "low_dim_gauss_mix": gaussian_mixture,
    "Rate_1": one_rate,
    "Rate_2": two_rates,
    "Rate_3": common_rate,
    "Rate_4": one_rate,
    "Rate_5": common_rate,
}
#: where a prior is improper as published, or its constant is left out: log densities to a constant
UP_TO_A_CONSTANT = {*_RESPONSES, "kilpisjarvi", "hmm_example"}
