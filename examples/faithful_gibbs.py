"""Gibbs sampling of Gaussian mixtures: the two kinds of eruption of Old Faithful, learnt without being told.

Three models of the 272 eruptions, all with Dirichlet weights: waiting times alone; both times with
independent Normal and inverse-Wishart priors; and with a Normal-inverse-Wishart prior, in which a cluster's
mean is as uncertain as its points are scattered. What moves each node is found by the engine, not declared:
every full conditional but the labels' has a closed form, and labels have two states.

Nothing tells the clusters apart a priori, so what one chain calls cluster 0 may be cluster 1 of another:
R-hat of a cluster's mean is far from 1, and averages over chains mean nothing. Questions that do not depend
on names have answers: here clusters are ordered, in every draw, by their mean waiting time.

Gelman et al., Bayesian Data Analysis, 3rd ed. 2013, sections 3.6 and 22.3 (label switching).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from examples import picture
from examples.data_faithful import ERUPTIONS

TIMES = np.array(ERUPTIONS, dtype=float)  # minutes: it lasted, until the next
CENTRE = TIMES.mean(axis=0)
SPREAD = np.diag([2.0, 25.0]) ** 2  # of a cluster's mean about the centre
DF, SCATTER = 5.0, np.diag([0.2, 60.0])  # a cluster's covariance is SCATTER / (DF - 3) on average
KAPPA = 0.1  # eruptions that the prior of a mean is worth, where it is in units of the covariance
CHAINS = 4

#: priors of the waiting times alone: mean and sd of a cluster's mean, InverseGamma of its variance
WAIT_MEAN, WAIT_SD, SHAPE, SCALE = 76.0, 53.0, 2.0, 28.09


def waiting_only() -> bmc.BayesNet:
    """Waiting times as a mixture of two Normals."""
    net = _mixture("waiting times alone")
    net.add("variance", bmc.InverseGamma(SHAPE, SCALE), plates="cluster")
    net.add("mean", bmc.Normal(WAIT_MEAN, WAIT_SD), plates="cluster")

    @net.node(plates="eruption")
    def wait(label, mean, variance):
        return bmc.Normal(mean[label], np.sqrt(variance[label]))

    return net


def independent() -> bmc.BayesNet:
    """Both times; a cluster's mean and covariance are independent a priori."""
    net = _mixture("independent priors")
    net.add("cov", bmc.InverseWishart(DF, SCATTER), plates="cluster")
    net.add("mean", bmc.MvNormal(CENTRE, SPREAD), plates="cluster")
    return _seen(net)


def normal_inverse_wishart() -> bmc.BayesNet:
    """Both times; the prior of a cluster's mean is worth ``KAPPA`` eruptions."""
    net = _mixture("Normal-inverse-Wishart prior")
    net.add("cov", bmc.InverseWishart(DF, SCATTER), plates="cluster")
    net.add("mean", lambda cov: bmc.MvNormal(CENTRE, cov / KAPPA), plates="cluster")
    return _seen(net)


MODELS: tuple[tuple[Callable[[], bmc.BayesNet], dict[str, np.ndarray]], ...] = (
    (waiting_only, {"wait": TIMES[:, 1]}),
    (independent, {"times": TIMES}),
    (normal_inverse_wishart, {"times": TIMES}),
)


def by_wait(values: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Values of the clusters, shape (..., 2), in the order of their mean waiting times."""
    return np.take_along_axis(values, np.argsort(mean, axis=-1), axis=-1)


#: what is asked of each model: functions of the parameters that do not depend on the clusters' names
WAITING = {
    "share": lambda weights, mean: by_wait(weights, mean),
    "mean wait": lambda mean: by_wait(mean, mean),
    "sd of waits": lambda variance, mean: by_wait(np.sqrt(variance), mean),
}
BOTH = {
    "share": lambda weights, mean: by_wait(weights, mean[..., 1]),
    "mean wait": lambda mean: by_wait(mean[..., 1], mean[..., 1]),
    "sd of waits": lambda cov, mean: by_wait(np.sqrt(cov[..., 1, 1]), mean[..., 1]),
    "mean length": lambda mean: by_wait(mean[..., 0], mean[..., 1]),
    "correlation": lambda cov, mean: by_wait(
        cov[..., 0, 1] / np.sqrt(cov[..., 0, 0] * cov[..., 1, 1]), mean[..., 1]
    ),
}


def learnt(net: bmc.BayesNet, evidence: dict[str, np.ndarray], draws: int) -> Any:
    """The posterior of the parameters; labels move, but are not kept."""
    engine = bmc.Gibbs(draws=draws, warmup=draws // 2, chains=CHAINS)
    kept = [name for name in net if name != "label" and name not in evidence]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # about names, which is the point
        return bmc.infer(net, evidence, engine=engine, rng=3, keep=kept)


def answers(posterior: Any) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Posterior mean, standard deviation and Monte Carlo error of every question, short kind first."""
    found = {}
    for name, question in (BOTH if "cov" in posterior.names else WAITING).items():
        values = np.asarray(drawn(posterior, question))
        spread = values.reshape(-1, 2).std(axis=0)
        found[name] = posterior.expectation(question), spread, posterior.mcse(question)
    return found


def drawn(posterior: Any, question: Callable[..., np.ndarray]) -> np.ndarray:
    """Draws of a question, shape (chain, draw, 2)."""
    arguments = question.__code__.co_varnames[: question.__code__.co_argcount]
    return question(*(posterior[name] for name in arguments))


def report(posterior: Any) -> None:
    """What was learnt of each kind, and what R-hat says with and without names."""
    print(f"  {'':12}  {'short wait':>18}  {'long wait':>18}  {'Monte Carlo error':>18}")
    for name, (mean, sd, error) in answers(posterior).items():
        cells = [f"{m:8.3f} +- {s:6.3f}" for m, s in zip(mean, sd, strict=True)]
        print(f"  {name:12}  {cells[0]:>18}  {cells[1]:>18}  {error.max():18.1g}")
    question = (BOTH if "cov" in posterior.names else WAITING)["mean wait"]
    print(f"  R-hat of the means by name {np.max(posterior.rhat('mean')):.2f}, "
          f"in order {np.max(posterior.rhat(question)):.3f}")  # fmt: skip


def draw(posteriors: dict[str, Any]) -> Any:
    """Left the eruptions and what was learnt of both kinds; right names that switch, and the order."""
    mosaic = [["clusters", "named"], ["clusters", "ordered"]]
    figure, panels = picture.axes(mosaic, (11.5, 5.4), width_ratios=[1.25, 1])
    both = posteriors["Normal-inverse-Wishart prior"]
    ax = panels["clusters"]
    ax.plot(*TIMES.T, ".", ms=4, color=picture.FAINT)
    mean, cov = (
        both[name][:, -10:].reshape(-1, 2, *both[name].shape[3:]) for name in ("mean", "cov")
    )
    order = np.argsort(mean[..., 1], axis=-1)
    for kind, colour in enumerate((picture.OTHER, picture.DRAWS)):
        at = np.arange(len(order)), order[:, kind]
        for m, c in zip(mean[at], cov[at], strict=True):
            ax.plot(*_ellipse(m, c), color=colour, lw=0.6, alpha=0.5)
    ax.set(xlabel="it lasted, minutes", ylabel="until the next, minutes")
    ax.set_title("40 draws: ellipses of two standard deviations")
    waits = both["mean"][..., 1]
    for name, values in (("named", waits), ("ordered", np.sort(waits, axis=-1))):
        ax = panels[name]
        for k, colour in enumerate((picture.OTHER, picture.DRAWS)):
            ax.plot(values[:, :200, k].ravel(), color=colour, lw=0.8)
        for chain in range(1, CHAINS):
            ax.axvline(chain * min(200, values.shape[1]), color=picture.FAINT, lw=0.6, ls=":")
        ax.set(ylabel="mean wait", yticks=[55, 80])
    panels["named"].set_title(f"clusters by name, {CHAINS} chains one after the other")
    panels["ordered"].set_title("in order")
    panels["ordered"].set_xlabel("draw")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how each model is sampled and what it learns, and draw the clusters."""
    options = picture.options(__doc__, arguments)
    draws = 200 if options.fast else 2_000
    posteriors = {}
    for make, evidence in MODELS:
        net = make()
        print(f"Old Faithful, {net.name}")
        bmc.explain(net, evidence, bmc.Gibbs(draws=draws, warmup=draws // 2, chains=CHAINS))
        posteriors[net.name] = learnt(net, evidence, draws)
        report(posteriors[net.name])
        print()
    picture.save(draw(posteriors), options.out, "faithful_gibbs")


def _mixture(name: str) -> bmc.BayesNet:
    net = bmc.BayesNet(name, plates={"cluster": 2, "eruption": len(TIMES)})
    net.add("weights", bmc.Dirichlet(np.ones(2)))
    net.add("label", lambda weights: bmc.Categorical(weights), plates="eruption")
    return net


def _seen(net: bmc.BayesNet) -> bmc.BayesNet:
    @net.node(plates="eruption")
    def times(label, mean, cov):
        return bmc.MvNormal(mean[label], cov[label])

    return net


def _ellipse(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    angle = np.linspace(0.0, 2 * np.pi, 100)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return mean[:, None] + 2.0 * np.linalg.cholesky(cov) @ circle


if __name__ == "__main__":
    main()
