"""Minka's clutter problem: a number to be found among readings of which half say nothing about it.

    theta ~ N(0, 100),   x_i ~ 1/2 N(theta, 1) + 1/2 N(0, 10)

The exact posterior is a mixture of 2^n Gaussians; on a line it can be had by quadrature. Expectation
propagation, assumed-density filtering, Laplace's method and variational Bayes (mean field) are held against
importance sampling and Gibbs: the error of mean and log evidence against the time that it took, as in the
figures of Minka (2001), A family of algorithms for approximate Bayesian inference, ch. 3.3. Engines that were
asked for more sweeps or draws stand further right. Laplace's method has the mode instead of the mean, and
variational Bayes a bound of the evidence: no time helps them beyond their bias.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

import bayesmc as bmc
from examples import picture

POINTS, TRUTH = 20, 2.0
COLOURS = {
    "EP": picture.OTHER,
    "ADF": picture.DRAWS,
    "Laplace": "tab:green",
    "VB": "tab:purple",
    "importance": picture.FAINT,
    "Gibbs": picture.EXACT,
}


def clutter(points: int) -> bmc.BayesNet:
    """The net: every reading has a label that says whether it is clutter."""
    net = bmc.BayesNet("clutter", plates={"point": points})
    net.add("theta", bmc.Normal(0.0, 10.0))
    net.add("is_clutter", bmc.Bernoulli(0.5), plates="point")

    @net.node(plates="point")
    def x(theta, is_clutter):
        clear = is_clutter == 0
        return bmc.Normal(np.where(clear, theta, 0.0), np.where(clear, 1.0, np.sqrt(10.0)))

    return net


def readings(seed: int, points: int = POINTS) -> np.ndarray:
    """Half of them around the truth, half of them anywhere."""
    rng = np.random.default_rng(seed)
    clear = rng.random(points) < 0.5
    return np.where(clear, rng.normal(TRUTH, 1.0, points), rng.normal(0.0, np.sqrt(10.0), points))


def exact(x: np.ndarray) -> tuple[float, float, float]:
    """Mean, variance and log evidence by the rectangle rule on a fine grid."""
    theta = np.linspace(-60.0, 60.0, 120_001)
    both = np.logaddexp(
        stats.norm.logpdf(x[:, None], theta, 1.0), stats.norm.logpdf(x, 0.0, np.sqrt(10.0))[:, None]
    )
    log = (both - np.log(2.0)).sum(axis=0) + stats.norm.logpdf(theta, 0.0, 10.0)
    top = log.max()
    weight = np.exp(log - top)
    total = weight.sum()
    mean = (weight * theta).sum() / total
    var = (weight * (theta - mean) ** 2).sum() / total
    return float(mean), float(var), float(top + np.log(total * (theta[1] - theta[0])))


def engines(fast: bool) -> dict[str, list[Any]]:
    """Engines by name, those that take longer behind."""
    few = 2 if fast else 5
    return {
        "EP": [bmc.ExpectationPropagation(sweeps=k, damping=0.0) for k in (1, 2, 3, 5, 20)],
        "ADF": [bmc.AssumedDensity()],
        "Laplace": [bmc.LaplaceApproximation(starts=k) for k in (1, 8)],
        "VB": [bmc.MeanField(restarts=1, sweeps=k) for k in (1, 2, 3, 5, 20)] + [bmc.MeanField()],
        "importance": [bmc.LikelihoodWeighting(10**k) for k in range(2, 2 + few)],
        "Gibbs": [bmc.Gibbs(draws=4**k * 5, warmup=20, chains=4) for k in range(1, 1 + few)],
    }


def errors(x: np.ndarray, fast: bool) -> dict[str, np.ndarray]:
    """By engine rows of seconds, error of the mean and of the log evidence."""
    mean, _, log = exact(x)
    net, found = clutter(len(x)), {}
    for name, kinds in engines(fast).items():
        rows = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            bmc.infer(net, {"x": x}, engine=kinds[0], rng=0, progress=False)  # reads the net
        for engine in kinds:
            started = time.process_time()
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore"
                )  # of few sweeps and few draws: that is what is shown
                posterior = bmc.infer(net, {"x": x}, engine=engine, rng=0, progress=False)
            seconds = time.process_time() - started
            told = posterior.log_marginal_likelihood
            rows.append(
                (
                    seconds,
                    abs(posterior.mean("theta") - mean),
                    np.nan if told is None else abs(told - log),
                )
            )
        found[name] = np.array(rows, dtype=float)
    return found


def report(x: np.ndarray, found: dict[str, np.ndarray]) -> None:
    """Print the table, and what the check says of EP's answer."""
    mean, var, log = exact(x)
    print(
        f"{len(x)} readings: mean {mean:.4f}, sd {np.sqrt(var):.4f}, log evidence {log:.4f}, exactly"
    )
    print("  engine        ms    error of mean    of log evidence")
    for name, rows in found.items():
        for seconds, off, told in rows:
            print(f"  {name:<10}{1000 * seconds:6.0f}{off:17.5f}{told:17.5f}")
    engine = bmc.ExpectationPropagation()
    print(bmc.infer(clutter(len(x)), {"x": x}, engine=engine).check(rng=0))


def draw(x: np.ndarray, found: dict[str, np.ndarray]) -> Any:
    """The posterior with both approximations; errors against time."""
    figure, panels = picture.axes([["posterior", "mean", "evidence"]], (13, 4))
    mean, var, _ = exact(x)
    theta = np.linspace(mean - 5 * np.sqrt(var), mean + 5 * np.sqrt(var), 400)
    both = np.logaddexp(
        stats.norm.logpdf(x[:, None], theta, 1.0), stats.norm.logpdf(x, 0.0, np.sqrt(10.0))[:, None]
    )
    log = both.sum(axis=0) + stats.norm.logpdf(theta, 0.0, 10.0)
    density = np.exp(log - log.max())
    ax = panels["posterior"]
    ax.plot(
        theta, density / (density.sum() * (theta[1] - theta[0])), color=picture.EXACT, label="exact"
    )
    shown = (
        ("EP", bmc.ExpectationPropagation(), picture.OTHER),
        ("ADF", bmc.AssumedDensity(), picture.DRAWS),
        ("Laplace", bmc.LaplaceApproximation(), COLOURS["Laplace"]),
        ("VB", bmc.MeanField(), COLOURS["VB"]),
    )
    for name, engine, colour in shown:
        posterior = bmc.infer(clutter(len(x)), {"x": x}, engine=engine, rng=0)
        height = stats.norm.pdf(theta, posterior.mean("theta"), posterior.std("theta"))
        ax.plot(theta, height, color=colour, label=name)
    ax.plot(x, np.zeros(len(x)), "|", ms=12, color=picture.FAINT)
    ax.set(xlim=(theta[0], theta[-1]), xlabel="theta", title="posterior")
    ax.legend(frameon=False)
    for column, (name, title) in enumerate(
        (("mean", "error of the mean"), ("evidence", "of the log evidence"))
    ):
        ax = panels[name]
        for engine, rows in found.items():
            ax.loglog(
                1000 * rows[:, 0],
                rows[:, column + 1],
                "o-",
                ms=4,
                color=COLOURS[engine],
                label=engine,
            )
        ax.set(xlabel="milliseconds", title=title)
        ax.legend(frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    options = picture.options(__doc__, arguments)
    x = readings(3)
    found = errors(x, options.fast)
    report(x, found)
    picture.save(draw(x, found), options.out, "clutter")


if __name__ == "__main__":
    main()
