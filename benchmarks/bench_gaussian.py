"""Exact answers on linear-Gaussian nets beside hand-written NumPy for that one model.

The hand-written code knows the model beforehand: a dense joint Gaussian prepared once, a Kalman smoother for
a chain, and an enumeration of regimes with a Kalman filter vectorised over them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

import bayesmc as bmc
from benchmarks.harness import data_folder, interleave, table

CHAIN, REGIMES = 300, 12


def main() -> None:
    """Print medians; every call has new evidence and answers all means and standard deviations."""
    rows: list[list[object]] = []
    for name, ours, hand in (_ecoli(), _chain(), _switching()):
        np.testing.assert_allclose(ours(), hand(), rtol=1e-8)
        times = interleave({"bayesmc": ours, "hand": hand}, repeats=9, budget=6.0)
        own, floor = times["bayesmc"].median, times["hand"].median
        rows.append([name, 1e3 * own, 1e3 * floor, own / floor])
    header = ["all means and sds", "bayesmc, ms", "hand-written, ms", "it / hand-written"]
    print(table("exact inference in Gaussian nets", header, rows) + "\n")


Pair = tuple[str, Callable[[], Any], Callable[[], Any]]


def _ecoli() -> Pair:
    """46 genes, a published linear-Gaussian net; four are seen."""
    scenario, nodes = _ecoli_data()
    net = bmc.BayesNet("ecoli70")
    for name, node in nodes.items():
        weights, loc, scale = list(node["coef"].values()), node["intercept"], node["sd"]
        net.add(
            name,
            lambda *x, w=weights, a=loc, s=scale: bmc.Normal(
                a + sum(c * v for c, v in zip(w, x, strict=True)), s
            ),
            parents=node["parents"],
        )
    net.validate()
    hidden = [n for n in nodes if n not in scenario]
    mean, cov = _joint(nodes)

    def ours() -> Any:
        posterior = bmc.infer(net, scenario, engine=bmc.Exact())
        return np.array([[posterior.mean(n), posterior.std(n)] for n in hidden])

    index = {n: k for k, n in enumerate(nodes)}
    seen = [index[n] for n in scenario]
    rest = [index[n] for n in hidden]
    values = np.array(list(scenario.values()))

    def hand() -> Any:
        factor = cho_factor(cov[np.ix_(seen, seen)])
        gain = cho_solve(factor, cov[np.ix_(seen, rest)]).T
        located = mean[rest] + gain @ (values - mean[seen])
        spread = np.sqrt(np.diag(cov)[rest] - np.vecdot(gain, cov[np.ix_(rest, seen)]))
        return np.stack([located, spread], axis=1)

    return "ecoli70, 46 nodes, 4 seen", ours, hand


def _chain() -> Pair:
    """A random walk seen through noise."""
    net = bmc.BayesNet("chain")
    net.add("x0", bmc.Normal(0.0, 1.0))
    for t in range(1, CHAIN):
        net.add(f"x{t}", lambda x: bmc.Normal(0.9 * x, 1.0), parents=[f"x{t - 1}"])
    for t in range(CHAIN):
        net.add(f"y{t}", lambda x: bmc.Normal(x, 0.5), parents=[f"x{t}"])
    y = np.random.default_rng(0).normal(size=CHAIN)
    evidence = {f"y{t}": y[t] for t in range(CHAIN)}

    def ours() -> Any:
        posterior = bmc.infer(net, evidence, engine=bmc.Exact())
        return np.array([[posterior.mean(f"x{t}"), posterior.std(f"x{t}")] for t in range(CHAIN)])

    def hand() -> Any:
        filtered, predicted = [], []
        m, p = 0.0, 1.0
        for value in y:
            predicted.append((m, p))
            k = p / (p + 0.25)
            m, p = m + k * (value - m), (1 - k) * p
            filtered.append((m, p))
            m, p = 0.9 * m, 0.81 * p + 1.0
        smooth = [filtered[-1]]
        for t in range(CHAIN - 2, -1, -1):
            (m, p), (mp, pp), (ms, ps) = filtered[t], predicted[t + 1], smooth[-1]
            g = 0.9 * p / pp
            smooth.append((m + g * (ms - mp), p + g * g * (ps - pp)))
        found = np.array(smooth[::-1])
        return np.stack([found[:, 0], np.sqrt(found[:, 1])], axis=1)

    return f"chain of {CHAIN} steps", ours, hand


def _switching() -> Pair:
    """A hidden walk whose step is switched by a hidden binary chain: every history of regimes counts."""
    net = bmc.BayesNet("switching")
    net.add("s0", bmc.Bernoulli(0.5))
    net.add("x0", lambda s: bmc.Normal(1.0 * s, 1.0), parents=["s0"])
    for t in range(1, REGIMES):
        net.add(f"s{t}", lambda s: bmc.Bernoulli(0.2 + 0.6 * s), parents=[f"s{t - 1}"])
        net.add(
            f"x{t}",
            lambda x, s: bmc.Normal(np.where(s == 1, 0.9, 0.3) * x + s, 1.0),
            parents=[f"x{t - 1}", f"s{t}"],
        )
    for t in range(REGIMES):
        net.add(f"y{t}", lambda x: bmc.Normal(x, 0.5), parents=[f"x{t}"])
    y = np.random.default_rng(1).normal(size=REGIMES)
    evidence = {f"y{t}": y[t] for t in range(REGIMES)}
    histories = np.array(np.unravel_index(np.arange(2**REGIMES), (2,) * REGIMES))

    def ours() -> Any:
        posterior = bmc.infer(net, evidence, engine=bmc.Exact())
        return np.array([posterior.mean(f"x{REGIMES - 1}"), posterior.log_marginal_likelihood])

    def hand() -> Any:
        s = histories
        logs = np.full(2**REGIMES, np.log(0.5))
        m, p = 1.0 * s[0], np.ones(2**REGIMES)
        for t in range(REGIMES):
            if t:
                chance = 0.2 + 0.6 * s[t - 1]
                logs += np.log(np.where(s[t] == 1, chance, 1 - chance))
                a = np.where(s[t] == 1, 0.9, 0.3)
                m, p = a * m + s[t], a * a * p + 1.0
            v = p + 0.25
            logs += -0.5 * (np.log(2 * np.pi * v) + (y[t] - m) ** 2 / v)
            m, p = m + p / v * (y[t] - m), p - p * p / v
        top = logs.max()
        weights = np.exp(logs - top)
        return np.array([weights @ m / weights.sum(), top + np.log(weights.sum())])

    return f"switching walk, 2^{REGIMES} histories", ours, hand


def _ecoli_data() -> tuple[dict[str, float], dict[str, Any]]:
    path = data_folder() / "bn_hybrid" / "ecoli70.json"
    data = json.loads(path.read_text())
    nodes: dict[str, Any] = {}
    todo = dict(data["nodes"])
    while todo:
        for name in [n for n, node in todo.items() if all(p in nodes for p in node["parents"])]:
            nodes[name] = todo.pop(name)
    return data["reference"]["E1"]["evidence"], nodes


def _joint(nodes: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of all nodes, by forward recursion."""
    index = {n: k for k, n in enumerate(nodes)}
    mean, cov = np.zeros(len(nodes)), np.zeros((len(nodes), len(nodes)))
    for k, node in enumerate(nodes.values()):
        at = [index[p] for p in node["parents"]]
        weights = np.array([node["coef"][p] for p in node["parents"]])
        mean[k] = node["intercept"] + weights @ mean[at]
        cov[k, :k] = cov[:k, k] = weights @ cov[at][:, :k]
        cov[k, k] = node["sd"] ** 2 + weights @ cov[np.ix_(at, at)] @ weights
    return mean, cov


if __name__ == "__main__":
    main()
