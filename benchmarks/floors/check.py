"""Do the floors answer rightly? ``python -m benchmarks.floors.check [NETWORK REFERENCE]``

The discrete floor is held against the exact answers of a reference file. The hybrid floor is held
against the declared model itself: its functions are evaluated on whole arrays with SciPy's
distributions behind them, which shares no line with the floor. Differences are in Monte Carlo
standard errors. One alone is beyond 4.5 with probability 7e-6; of the 450 or so compared, some one
is in fewer than 4 of 1,000 choices of the seeds, which are fixed.
"""

from __future__ import annotations

import gzip
import inspect
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from benchmarks import models
from benchmarks.floors import bif, lw_discrete, lw_hybrid
from benchmarks.harness import data_folder

LIMIT = 4.5


def main(arguments: list[str]) -> int:
    """Print the worst difference of each floor; 1 if any is beyond the limit."""
    data = data_folder() / "bn_discrete"
    files = [Path(a) for a in arguments]
    network, reference = files or [data / "bif/alarm.bif.gz", data / "refs/alarm.ref.json.gz"]
    worst = {}
    for uniforms in ("uint32", "float32"):
        for name, z in discrete(network, reference, uniforms).items():
            worst[f"discrete, {uniforms}, {name}"] = z
    control = discrete(network, reference, "uint32", wrong=True)
    worst["discrete, one table rolled (must fail)"] = -max(control.values())
    worst["hybrid"] = hybrid()
    worst["hybrid, one parent changed (must fail)"] = -hybrid(wrong=True)
    for name, z in worst.items():
        print(f"{name:45s} worst difference {abs(z):8.2f} standard errors")
    return int(any(z > LIMIT or -LIMIT < z < 0 for z in worst.values()))


def discrete(
    network: Path, reference: Path, uniforms: str, draws: int = 400_000, wrong: bool = False
) -> dict[str, float]:
    """Worst |z| over states and ``log p(evidence)``, by scenario of the reference file.

    Scenarios that no draw survives are left out. ``wrong`` is the negative control.
    """
    records = bif.read(network)
    nodes = bif.as_arrays(records)
    if wrong:
        name, card, parents, table = nodes[0]
        nodes[0] = (name, card, parents, np.roll(table, 1, axis=-1))
    worst = {}
    for name, scenario in json.loads(gzip.decompress(reference.read_bytes()))["scenarios"].items():
        evidence = bif.codes(records, scenario["evidence"])
        try:
            answer = lw_discrete.likelihood_weighting(nodes, evidence, draws, 7, uniforms=uniforms)
        except ValueError as error:
            print(f"{name}: {error}")
            continue
        z = [(answer.log_evidence - scenario["log_p_evidence"]) / _se_log(draws, answer.ess)]
        for record, found in zip(records, answer.marginals, strict=True):
            if record.name not in evidence:
                p = np.array(scenario["marginals"][record.name])
                carried = answer.ess * p * (1 - p) >= 10  # else the normal law does not hold
                z += list(((found - p) / np.sqrt(p * (1 - p) / answer.ess + 1e-12))[carried])
        worst[name] = float(np.abs(z).max())
    return worst


def hybrid(draws: int = 400_000, wrong: bool = False) -> float:
    """Worst |z| between the floor and the declared functions; ``wrong`` is the negative control."""
    answer = lw_hybrid.likelihood_weighting(draws, 7)
    values, log_weights = _run_declared(draws, 8, wrong)
    w = np.exp(log_weights - log_weights.max())
    ess = w.sum() ** 2 / (w @ w)
    log_evidence = log_weights.max() + np.log(w.mean())
    se = np.hypot(_se_log(draws, ess), _se_log(draws, answer.ess))
    z = [(answer.log_evidence - log_evidence) / se]
    w /= w.sum()
    for name in models.HIDDEN_CONTINUOUS:
        x = values[name]
        mean = w @ x
        var = w @ (x - mean) ** 2
        se = np.sqrt(2.0 * (w**2 @ (x - mean) ** 2))  # two independent runs of one size
        se_var = np.sqrt(2.0 * (w**2 @ ((x - mean) ** 2 - var) ** 2))
        z += [(answer.mean[name] - mean) / se, (answer.std[name] ** 2 - var) / se_var]
    for name in models.HIDDEN_DISCRETE:
        for state, found in enumerate(answer.probabilities[name]):
            hit = values[name] == state
            p = w @ hit
            z.append((found - p) / np.sqrt(2.0 * (w**2 @ (hit - p) ** 2)))
    return float(np.abs(z).max())


def _se_log(draws: int, ess: float) -> float:
    """Standard error of the log of a mean of weights (delta method)."""
    return float(np.sqrt(max(1.0 / ess - 1.0 / draws, 1e-20)))


def _run_declared(draws: int, seed: int, wrong: bool) -> tuple[dict[str, np.ndarray], np.ndarray]:
    rng = np.random.default_rng(seed)
    functions = models.declare(_Stand()).functions
    if wrong:
        functions["wind"] = lambda season: _Stand.Gamma(
            models.WIND_SHAPE[season % 3], models.WIND_RATE[season % 3]
        )
    values: dict[str, np.ndarray] = {}
    log_weights = np.zeros(draws)
    waiting = list(functions)
    while waiting:
        name = waiting.pop(0)
        parents = list(inspect.signature(functions[name]).parameters)
        if not all(p in values for p in parents):
            waiting.append(name)
            continue
        law = functions[name](*(values[p] for p in parents))
        if isinstance(law, np.ndarray):
            values[name] = law
        elif name in models.EVIDENCE:
            values[name] = np.full(draws, models.EVIDENCE[name])
            density = getattr(law, "logpdf", None) or law.logpmf
            log_weights += density(models.EVIDENCE[name])
        else:
            values[name] = law.rvs(size=draws, random_state=rng)
    return values, log_weights


class _Choice:
    """A categorical law with SciPy's ``rvs``."""

    def __init__(self, probs: np.ndarray) -> None:
        self.cumulative = np.cumsum(probs, axis=-1)

    def rvs(self, size: int, random_state: np.random.Generator) -> np.ndarray:
        passed = random_state.random(size)[:, None] >= self.cumulative[..., :-1]
        return passed.sum(axis=-1)


class _Stand:
    """SciPy's distributions under bayesmc's names, and a net that only collects functions."""

    def __init__(self) -> None:
        self.functions: dict[str, Callable[..., Any]] = {}

    def BayesNet(self, name: str) -> _Stand:  # noqa: N802
        return self

    def node(self, function: Callable[..., Any]) -> Callable[..., Any]:
        self.functions[function.__name__] = function
        return function

    Categorical = _Choice
    Bernoulli = staticmethod(scipy.stats.bernoulli)
    Normal = staticmethod(scipy.stats.norm)
    Beta = staticmethod(scipy.stats.beta)
    StudentT = staticmethod(scipy.stats.t)
    Poisson = staticmethod(scipy.stats.poisson)
    Gamma = staticmethod(lambda shape, rate: scipy.stats.gamma(shape, scale=1.0 / rate))
    Exponential = staticmethod(lambda rate: scipy.stats.expon(scale=1.0 / rate))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
