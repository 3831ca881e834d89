"""Faults of mean field, against fixed points that plain loops find."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import optimize, special

import bayesmc as bmc
from bayesmc.engines.variational.ascent import BoundError
from bayesmc.errors import ConvergenceWarning
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant
from tests.mutants.tests_of import Test

X = np.array([1.2, 0.4, 2.2, 3.1, 1.9])


def mean_and_precision() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"i": len(X)})
    net.add("m", bmc.Normal(0.5, 2.0))
    net.add("p", bmc.Gamma(2.0, 3.0))
    net.add("x", lambda m, p: bmc.Normal(m, p**-0.5), plates="i")
    return net, {"x": X}


def by_loops() -> dict[str, Any]:
    """Bishop (2006), sec. 10.1.3, with a prior of the mean that is free of the precision."""
    n, expected = len(X), 1.0
    a = 2.0 + 0.5 * n
    for _ in range(300):
        var = 1.0 / (0.25 + n * expected)
        mean = var * (0.25 * 0.5 + expected * X.sum())
        b = 3.0 + 0.5 * ((X - mean) ** 2).sum() + 0.5 * n * var
        expected = a / b
    log = special.digamma(a) - math.log(b)
    bound = -0.5 * 0.25 * ((mean - 0.5) ** 2 + var) - 0.5 * math.log(2 * math.pi * 4.0)
    bound += 2.0 * math.log(3.0) - special.gammaln(2.0) + log - 3.0 * expected
    bound += 0.5 * n * (log - math.log(2 * math.pi)) - (b - 3.0) * expected
    bound += 0.5 * math.log(2 * math.pi * math.e * var)
    bound += a - math.log(b) + special.gammaln(a) + (1.0 - a) * special.digamma(a)
    return {"m": mean, "spread": var, "p": expected, "bound": bound}


def chain() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.table("a", [], TABLES[0])
    net.table("b", ["a"], TABLES[1])
    net.table("c", ["b"], TABLES[2])
    net.table("d", ["a", "c"], TABLES[3])
    return net, {"d": 1}


def chain_by_loops() -> dict[str, Any]:
    log = np.log(TABLES[0])[:, None, None] + np.log(TABLES[1])[:, :, None]
    log = log + np.log(TABLES[2])[None] + np.log(TABLES[3][..., 1])[:, None, :]
    best: tuple[float, list[np.ndarray]] = (-np.inf, [])
    for start in np.random.default_rng(0).dirichlet(np.ones(2), (6, 3)):
        tables = list(start)
        for _ in range(150):
            for k in range(3):
                others = [t for j, t in enumerate(tables) if j != k]
                expected = np.einsum("sab,a,b->s", np.moveaxis(log, k, 0), *others)
                tables[k] = special.softmax(expected)
        joint = np.einsum("a,b,c->abc", *tables)
        bound = float((joint * log).sum() + sum(special.entr(t).sum() for t in tables))
        best = max(best, (bound, tables), key=lambda pair: pair[0])
    return {"bound": best[0], "a": best[1][0], "b": best[1][1], "c": best[1][2]}


def count() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet()
    net.add("s", bmc.HalfNormal(1.5))
    net.add("y", lambda s: bmc.Poisson(s))
    return net, {"y": 3}


def count_by_climbing() -> dict[str, Any]:
    """The best log-normal."""

    def lost(at: np.ndarray) -> float:
        m, v = at[0], math.exp(2 * at[1])
        first, second = math.exp(m + 0.5 * v), math.exp(2 * m + 2 * v)
        prior = math.log(2.0) - 0.5 * math.log(2 * math.pi) - math.log(1.5) - 0.5 * second / 1.5**2
        fit = 3 * m - first - special.gammaln(4.0)
        return -(prior + fit + m + 0.5 * math.log(2 * math.pi * math.e) + at[1])

    found = optimize.minimize(lost, [0.5, -1.0], tol=1e-13)
    m, v = found.x[0], math.exp(2 * found.x[1])
    return {"bound": -found.fun, "s": math.exp(m + 0.5 * v)}


def held(
    make: Callable[[], tuple[bmc.BayesNet, dict[str, Any]]], right: Callable[[], dict[str, Any]]
) -> Test:
    """Means, variances, tables and the bound, as far as ``right`` has them."""

    def test(seed: int) -> Verdict:
        def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
            net, seen = make()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", ConvergenceWarning)
                    found = bmc.infer(net, seen, engine=bmc.MeanField(sweeps=300), rng=seed)
            except BoundError:  # which the engine found out by itself
                return {k: np.full(np.shape(v), FELL) for k, v in wanted.items()}
            figures = {"bound": found.elbo, "spread": found.var("m") if "m" in wanted else 0.0}
            for name in set(wanted) - set(figures):
                is_table = np.ndim(wanted[name]) > 0
                figures[name] = found.probabilities(name) if is_table else found.mean(name)
            return {k: np.round(figures[k], 5) for k in wanted}

        wanted = right()
        rounded = {k: np.round(v, 5) for k, v in wanted.items()}
        return repeated_test(estimate, rounded, replications=2, alpha=ALPHA, rng=seed)

    return test


#: stands for all figures where the bound has fallen
FELL = 1e6
TABLES = [
    np.array([0.3, 0.7]),
    np.array([[0.9, 0.1], [0.2, 0.8]]),
    np.array([[0.6, 0.4], [0.1, 0.9]]),
    np.array([[[0.7, 0.3], [0.5, 0.5]], [[0.2, 0.8], [0.9, 0.1]]]),
]
BY = "repeated_test of infer against loops (no draws)"
AT = "bayesmc.engines.variational."

MUTANTS = [
    Mutant(
        "in plates the expectation of a square is the square of an expectation",
        (Edit("bayesmc.passes.expectation:Expectation.cross", "total = add(total, spread)",
              "total = total if u.shape else add(total, spread)"),),
        held(mean_and_precision, by_loops),
        BY,
    ),
    Mutant(
        "a normal factor's entropy is left out of the bound",
        (Edit(f"{AT}factors:NormalFactor.entropy", "return self._entropy", "return 0.0"),),
        held(mean_and_precision, by_loops),
        BY,
    ),
    Mutant(
        "the degrees of freedom of a gamma factor are one too many",
        (Edit(f"{AT}factors:ScatterFactor.update", "df + (d + 1.0)", "df + (d + 2.0)"),),
        held(mean_and_precision, by_loops),
        BY,
    ),
    Mutant(
        "one neighbour's message is left out",
        (Edit(f"{AT}steps:Step.__init__", "if s.by_label is None]", "if s.by_label is None][:-1]"),),
        held(chain, chain_by_loops),
        BY,
    ),
    Mutant(
        "tables are updated by half of what is said",
        (Edit(f"{AT}factors:TableFactor.update", "logs -= logs.max(axis=0)",
              "logs *= 0.5; logs -= logs.max(axis=0)"),),
        held(chain, chain_by_loops),
        BY,
    ),
    Mutant(
        "the change of volume is left out of what free numbers climb",
        (Edit(f"{AT}free:FreeFactor.prepare", "add(energy, self.volume)", "energy"),),
        held(count, count_by_climbing),
        BY,
    ),
]  # fmt: skip
