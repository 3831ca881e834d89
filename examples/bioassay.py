"""The bioassay of Gelman et al.: twenty animals, four doses, and how far a Gaussian at the mode carries.

Five animals each were given four doses, on a log scale, and 0, 1, 3 and 5 of them died. The log odds of a
death are taken for linear in the dose. Two numbers can be had exactly, on a grid; beside it stand Laplace's
method, what ``posterior.check`` corrects it to, and Hamiltonian trajectories. The posterior has a long tail
towards steep lines: its mode lies most of a standard deviation from its mean, with a flat prior and with that
of exercise 3.11. The check says so (a Pareto k above a half), and draws of the Gaussian, weighed, give the
right answers all the same.

Gelman, Carlin, Stern, Dunson, Vehtari and Rubin (2013), Bayesian Data Analysis, 3rd ed., sec. 3.7, sec. 4.1
(mode 0.8 and 7.7, standard deviations 1.0 and 4.9) and exercise 3.11; data of Racine, Grieve, Fluhler and
Smith (1986).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import LowEssWarning
from examples import picture

DOSE = np.array([-0.86, -0.30, -0.05, 0.73])
ANIMALS, DEATHS = 5, np.array([0, 1, 3, 5])
#: mean and covariance of intercept and slope
PRIORS = {
    "flat": (np.zeros(2), 1e6 * np.eye(2)),
    "exercise 3.11": (np.array([0.0, 10.0]), np.array([[4.0, 10.0], [10.0, 100.0]])),
}
#: where nearly all of the mass is
INTERCEPT, SLOPE = (-6.0, 14.0), (-8.0, 90.0)


def assay(prior: str) -> bmc.BayesNet:
    """Intercept and slope of a line of log odds, and deaths by dose."""
    net = bmc.BayesNet("bioassay", plates={"group": len(DOSE)})
    net.add("line", bmc.MvNormal(*PRIORS[prior]))

    @net.node(plates="group")
    def deaths(line):
        return bmc.Binomial(ANIMALS, logits=line[..., 0] + line[..., 1] * DOSE)

    return net


@dataclass(frozen=True)
class Exact:
    """The posterior on a fine grid.

    Attributes
    ----------
    intercept, slope : ndarray
        Axes of the grid.
    mass : ndarray, shape (intercepts, slopes)
    log_evidence : float
    """

    intercept: np.ndarray
    slope: np.ndarray
    mass: np.ndarray
    log_evidence: float

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Means and standard deviations of intercept and slope."""
        axes = (self.intercept, self.mass.sum(axis=1)), (self.slope, self.mass.sum(axis=0))
        means = np.array([x @ share for x, share in axes])
        squares = np.array([x**2 @ share for x, share in axes])
        return means, np.sqrt(squares - means**2)


def on_a_grid(prior: str, points: int) -> Exact:
    """The sum over a grid of the net's own density: two numbers are few enough."""
    intercept, slope = np.linspace(*INTERCEPT, points), np.linspace(*SLOPE, points)
    lines = np.stack(np.meshgrid(intercept, slope, indexing="ij"), axis=-1)
    log = np.asarray(assay(prior).log_prob({"line": lines, "deaths": DEATHS}))
    cell = (intercept[1] - intercept[0]) * (slope[1] - slope[0])
    top = log.max()
    mass = np.exp(log - top)
    return Exact(intercept, slope, mass / mass.sum(), float(top + np.log(mass.sum() * cell)))


@dataclass(frozen=True)
class Answers:
    """What was found under one prior."""

    exact: Exact
    laplace: Any
    check: Any
    chains: Any


def ask(prior: str, points: int, ess: float) -> Answers:
    """The same question to a grid, to Laplace's method with its check, and to trajectories."""
    net, seen = assay(prior), {"deaths": DEATHS}
    laplace = bmc.infer(net, seen, engine=bmc.LaplaceApproximation(), rng=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)  # the table says what it found
        check = laplace.check(rng=2)
    chains = bmc.infer(net, seen, engine=bmc.HamiltonianMonteCarlo(ess=ess), rng=3)
    return Answers(on_a_grid(prior, points), laplace, check, chains)


def table(prior: str, found: Answers) -> str:
    """Means, standard deviations and log evidence by method."""
    means, sds = found.exact.moments()
    logs = {
        "Laplace": found.laplace.log_marginal_likelihood,
        "corrected": found.check.log_marginal_likelihood,
    }
    rows = [("grid", means, sds, found.exact.log_evidence)]
    for name, posterior in (
        ("Laplace", found.laplace),
        ("corrected", found.check.posterior),
        ("trajectories", found.chains),
    ):
        rows.append((name, posterior.mean("line"), posterior.std("line"), logs.get(name)))
    verdict = "usable once corrected" if found.check.ok else "not to be trusted"
    verdict = "near" if found.check.k < 0.5 else verdict
    lines = [
        f"{prior} prior: Pareto k {found.check.k:.2f}, Laplace's method {verdict}",
        f"  {'':13}{'intercept':>10}{'sd':>7}{'slope':>8}{'sd':>7}{'log evidence':>14}",
    ]
    for name, mean, sd, log in rows:
        told = f"{log:14.3f}" if log is not None else f"{'-':>14}"
        lines.append(f"  {name:13}{mean[0]:10.2f}{sd[0]:7.2f}{mean[1]:8.2f}{sd[1]:7.2f}{told}")
    return "\n".join(lines)


def lethal(posterior: Any) -> tuple[np.ndarray, np.ndarray]:
    """The dose at which half of the animals die: draws, and their weights."""
    line = posterior["line"].reshape(-1, 2)
    weights = np.ones(len(line)) if posterior.weights is None else posterior.weights.ravel()
    kept = line[:, 1] > 0  # else no dose kills more than another
    return -line[kept, 0] / line[kept, 1], weights[kept]


def draw(found: dict[str, Answers]) -> Any:
    """Exact mass and the Gaussian's ellipses above, the lethal dose below; a column for each prior."""
    names = [[f"{row}, {prior}" for prior in found] for row in ("posterior", "LD50")]
    figure, panels = picture.axes(names, (10, 7.5))
    for prior, answers in found.items():
        ax, exact = panels[f"posterior, {prior}"], answers.exact
        top = exact.mass.max()
        levels = top * np.array([0.05, 0.2, 0.5, 0.8, 1.0])
        ax.contourf(exact.intercept, exact.slope, exact.mass.T, levels, cmap="Blues")
        ellipses(ax, answers.laplace)
        mode = bmc.map(assay(prior), {"deaths": DEATHS})["line"]
        ax.plot(*mode, "+", color=picture.OTHER, ms=10, label="mode")
        ax.plot(*exact.moments()[0], "o", color=picture.EXACT, ms=5, label="mean")
        ax.set(
            title=f"{prior} prior, k {answers.check.k:.2f}", xlabel="intercept", ylabel="slope",
            xlim=(-3, 6), ylim=(-6, 32),
        )  # fmt: skip
        ax.legend(loc="lower right", fontsize=8)
        below = panels[f"LD50, {prior}"]
        edges = np.linspace(-0.6, 0.5, 61)
        for name, posterior, colour in (
            ("trajectories", answers.chains, picture.FAINT),
            ("Laplace", answers.laplace, picture.OTHER),
            ("corrected", answers.check.posterior, picture.EXACT),
        ):
            doses, weights = lethal(posterior)
            style: dict[str, Any] = (
                {"histtype": "stepfilled", "alpha": 0.4}
                if name == "trajectories"
                else {"histtype": "step", "lw": 1.5}
            )
            below.hist(
                doses, edges, weights=weights, density=True, color=colour, label=name, **style
            )
        below.set(xlabel="dose at which half of them die (log g/ml)", yticks=[])
        below.legend(fontsize=8)
    return figure


def ellipses(ax: Any, posterior: Any) -> None:
    """Where the Gaussian's density is a half, a fifth and a twentieth of its largest."""
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    root = np.linalg.cholesky(posterior.cov("line"))
    for level in (0.5, 0.2, 0.05):
        line = posterior.mean("line")[:, None] + np.sqrt(-2.0 * np.log(level)) * root @ circle
        ax.plot(*line, color=picture.OTHER, lw=1.0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables, and draw."""
    options = picture.options(__doc__, arguments)
    points, ess = (201, 500) if options.fast else (801, 4000)
    found = {prior: ask(prior, points, ess) for prior in PRIORS}
    print("Bioassay: 20 animals, four doses; exact answers are sums over a grid")
    for prior, answers in found.items():
        print(table(prior, answers))
    picture.save(draw(found), options.out, "bioassay")


if __name__ == "__main__":
    main()
