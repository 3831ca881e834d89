"""Variational Bayes of a Gaussian mixture: six components for Old Faithful, of which four die out.

Eruptions are standardised; the prior has weights ~ Dirichlet(a, ..., a), covariances ~ inverse Wishart(2, I)
and means ~ N(0, covariance). The posterior is approximated by q(weights) q(labels) prod_k q(mean_k, cov_k),
each factor in turn the best given the others, so that the evidence bound never falls. With a = 0.001 a
component that explains nothing costs more than it brings, and is emptied: the number of clusters is found in
one run. With a = 1 nothing empties them, and the bound itself says how many there are, up to the K! names of
components, of which it counts one.

Bishop (2006), Pattern Recognition and Machine Learning, sec. 10.2 and fig. 10.6.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from examples import picture
from examples.data_faithful import ERUPTIONS

TIMES = np.array(ERUPTIONS, dtype=float)
POINTS = (TIMES - TIMES.mean(axis=0)) / TIMES.std(axis=0)
SPARSE, EVEN = 1e-3, 1.0
MOST = 6
BLOCKS = [("mean", "cov")]
SEED = 5  # of the start that is drawn


def mixture(kinds: int, concentration: float) -> bmc.BayesNet:
    """Bishop's mixture of Gaussians."""
    net = bmc.BayesNet("mixture", plates={"kind": kinds, "eruption": len(POINTS)})
    net.add("weights", bmc.Dirichlet(np.full(kinds, concentration)))
    net.add("cov", bmc.InverseWishart(2.0, np.eye(2)), plates="kind")
    net.add("mean", lambda cov: bmc.MvNormal(np.zeros(2), cov), plates="kind")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="eruption")
    net.add(
        "times", lambda label, mean, cov: bmc.MvNormal(mean[label], cov[label]), plates="eruption"
    )
    return net


def learnt(
    kinds: int, concentration: float, restarts: int = 10, sweeps: int = 2000, rng: int = 1
) -> Any:
    """The approximate posterior."""
    engine = bmc.MeanField(restarts=restarts, sweeps=sweeps, blocks=BLOCKS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # of starts that are stopped on the way
        return bmc.infer(mixture(kinds, concentration), {"times": POINTS}, engine=engine, rng=rng)


def alive(posterior: Any) -> int:
    """Components that have an eruption's weight at least."""
    return int((posterior.mean("weights") * len(POINTS) > 1.0).sum())


def table(most: int, restarts: int) -> dict[tuple[float, int], Any]:
    """Posteriors by concentration and number of components."""
    return {
        (concentration, kinds): learnt(kinds, concentration, restarts)
        for concentration in (SPARSE, EVEN)
        for kinds in range(1, most + 1)
    }


def report(found: dict[tuple[float, int], Any]) -> None:
    """Print bounds, and how many components are left."""
    print(
        "Old Faithful by variational Bayes: evidence bound, with the K! names of components, and who is left"
    )
    print("    a      K      bound   + log K!  alive  sweeps  starts within 0.1")
    for (concentration, kinds), posterior in found.items():
        near = int((posterior.bounds > posterior.bounds[0] - 0.1).sum())
        named = posterior.elbo + math.lgamma(alive(posterior) + 1)
        print(
            f"  {concentration:5g}  {kinds:3}  {posterior.elbo:9.3f}  {named:9.3f}  {alive(posterior):5}  "
            f"{posterior.sweeps:6}  {near:6} of {len(posterior.bounds)}"
        )


def draw() -> Any:
    """Six components after two sweeps, on the way, and at the end; the bound over the sweeps."""
    stops = (2, 25, 2000)
    ways = [learnt(MOST, SPARSE, restarts=1, sweeps=stop, rng=SEED) for stop in stops]
    figure, panels = picture.axes([["0", "1", "2"], ["bound"] * 3], (12, 7), height_ratios=[1.6, 1])
    for k, posterior in enumerate(ways):
        ax = panels[str(k)]
        ax.plot(*TIMES.T, ".", ms=4, color=picture.FAINT)
        weights, mean, cov = (posterior.mean(name) for name in ("weights", "mean", "cov"))
        for j in np.flatnonzero(weights * len(POINTS) > 2.0):  # whose mean covariance is finite
            ring = _ellipse(mean[j], cov[j]) * TIMES.std(axis=0) + TIMES.mean(axis=0)
            ax.plot(*ring.T, color=picture.DRAWS, lw=0.6 + 3.0 * weights[j])
        ax.set(title=f"{posterior.sweeps} sweeps: {alive(posterior)} components")
        ax.set(xlabel="it lasted, minutes", xlim=(1.0, 6.0), ylim=(38.0, 102.0))
    panels["0"].set_ylabel("until the next, minutes")
    ax = panels["bound"]
    bounds = ways[-1].elbos
    ax.plot(np.arange(1, len(bounds) + 1), bounds, color=picture.EXACT)
    ax.set(xlabel="sweep", ylabel="evidence bound", title="the bound never falls", xscale="log")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and draw components that die out."""
    options = picture.options(__doc__, arguments)
    bmc.explain(mixture(MOST, SPARSE), {"times": POINTS}, bmc.MeanField(blocks=BLOCKS))
    report(table(3 if options.fast else MOST, 3 if options.fast else 10))
    picture.save(draw(), options.out, "variational_mixture")


def _ellipse(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Two standard deviations about a mean, shape (100, 2)."""
    angle = np.linspace(0.0, 2 * np.pi, 100)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return mean + 2.0 * circle @ np.linalg.cholesky(cov).T


if __name__ == "__main__":
    main()
