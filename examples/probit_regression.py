"""Probit regression: expectation propagation against Gibbs sampling, in time and in digits.

    w ~ N(0, I),   y_i ~ Bernoulli(Phi(x_i w))

Every row is a factor of one number, its own x_i w, so that all rows are one array operation; Gibbs draws the
weights with a hidden number for each row (Albert and Chib 1993, Bayesian analysis of binary and polychotomous
response data, JASA 88), which the net declares. Rows that EP found probable beforehand, and did not see, say
how much the weights' spread matters.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from scipy import special

import bayesmc as bmc
from examples import picture


def data(rows: int, columns: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A design, weights, and labels."""
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(rows, columns))
    weights = rng.normal(size=columns)
    return design, weights, (design @ weights + rng.normal(size=rows) > 0).astype(int)


def probit(design: np.ndarray) -> bmc.BayesNet:
    """Labels given weights."""
    rows, columns = design.shape
    net = bmc.BayesNet("probit regression", plates={"row": rows})
    net.add("w", bmc.MvNormal(np.zeros(columns), np.eye(columns)))
    net.add("y", lambda w: bmc.Bernoulli(special.ndtr(np.vecdot(design, w))), plates="row")
    return net


def latent(design: np.ndarray) -> bmc.BayesNet:
    """The same with a hidden number for each row, which is positive where the label is 1."""
    rows, columns = design.shape
    net = bmc.BayesNet("probit regression, with hidden numbers", plates={"row": rows})
    net.add("w", bmc.MvNormal(np.zeros(columns), np.eye(columns)))
    net.add("z", lambda w: bmc.Normal(np.vecdot(design, w), 1.0), plates="row")
    net.add("y", lambda z: bmc.Bernoulli(z > 0), plates="row")
    return net


def main(arguments: Sequence[str] | None = None) -> None:
    options = picture.options(__doc__, arguments)
    rows, columns, draws = (120, 3, 300) if options.fast else (1000, 10, 2000)
    design, weights, y = data(rows, columns, 0)
    started = time.process_time()
    found = bmc.infer(probit(design), {"y": y}, engine=bmc.ExpectationPropagation())
    middle = time.process_time()
    gibbs = bmc.Gibbs(draws=draws, warmup=draws // 4, chains=4)
    drawn = bmc.infer(probit(design), {"y": y}, engine=gibbs, rng=0, progress=False)
    ended = time.process_time()
    print(
        f"{rows} rows, {columns} weights: EP {1000 * (middle - started):.0f} ms, {found.sweeps} sweeps;",
        end=" ",
    )
    print(f"Gibbs {ended - middle:.1f} s, {4 * draws} draws")
    off = (found.mean("w") - drawn.mean("w")) / drawn.std("w")
    print(f"  means differ by {np.abs(off).max():.3f} standard deviations at most", end=", ")
    print(f"Gibbs' own errors are {np.max(drawn.mcse('w') / drawn.std('w')):.3f}")
    print(
        f"  standard deviations by {100 * np.abs(found.std('w') / drawn.std('w') - 1).max():.1f} % at most"
    )
    print(f"  log evidence {found.log_marginal_likelihood:.3f}, approximately")
    figure, panels = picture.axes([["weights", "spread"]], (10, 4))
    ax = panels["weights"]
    ax.errorbar(
        weights, found.mean("w"), 2 * found.std("w"), fmt="o", color=picture.OTHER, label="EP"
    )
    ax.plot(weights, drawn.mean("w"), "x", color=picture.EXACT, label="Gibbs")
    ax.plot([weights.min(), weights.max()], [weights.min(), weights.max()], color=picture.FAINT)
    ax.set(xlabel="weight", ylabel="posterior, two standard deviations", title=f"{rows} rows")
    ax.legend(frameon=False)
    ax = panels["spread"]
    ax.plot(drawn.std("w"), found.std("w"), "o", color=picture.DRAWS)
    ends = [drawn.std("w").min(), drawn.std("w").max()]
    ax.plot(ends, ends, color=picture.FAINT)
    ax.set(xlabel="standard deviation, Gibbs", ylabel="EP", title="spreads")
    picture.save(figure, options.out, "probit_regression")


if __name__ == "__main__":
    main()
