"""ASIA, the chest clinic of Lauritzen and Spiegelhalter: a diagnosis net of eight yes-or-no nodes.

Lauritzen, S. L. and Spiegelhalter, D. J. (1988). Local computations with probabilities on graphical
structures and their application to expert systems. J. R. Statist. Soc. B 50(2), 157-224; the
probabilities are the paper's. "Shortness-of-breath (dyspnoea) may be due to tuberculosis, lung
cancer or bronchitis, or none of them, or more than one of them."
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc import plotting
from examples import compare, picture

ANSWERS = ("no", "yes")
DISEASES = ("tuberculosis", "cancer", "bronchitis")

# A smoker short of breath, back from Asia; then the X-ray comes back positive.
AT_FIRST = {"asia": "yes", "smoking": "yes", "dyspnoea": "yes"}
WITH_XRAY = {**AT_FIRST, "xray": "yes"}


def chest_clinic() -> bmc.BayesNet:
    """The net, each node a function of its parents."""
    net = bmc.BayesNet("chest clinic")

    @net.node(states=ANSWERS)
    def asia():
        return bmc.Bernoulli(0.01)

    @net.node(states=ANSWERS)
    def smoking():
        return bmc.Bernoulli(0.5)

    @net.node(states=ANSWERS)
    def tuberculosis(asia):
        return bmc.Bernoulli(np.where(asia == "yes", 0.05, 0.01))

    @net.node(states=ANSWERS)
    def cancer(smoking):
        return bmc.Bernoulli(np.where(smoking == "yes", 0.10, 0.01))

    @net.node(states=ANSWERS)
    def bronchitis(smoking):
        return bmc.Bernoulli(np.where(smoking == "yes", 0.60, 0.30))

    @net.node
    def either(tuberculosis, cancer):
        return (tuberculosis == "yes") | (cancer == "yes")

    @net.node(states=ANSWERS)
    def xray(either):
        return bmc.Bernoulli(np.where(either, 0.98, 0.05))

    # The same as a table: axes in the order of the parents, then the node itself.
    net.table(
        "dyspnoea",
        parents=["either", "bronchitis"],
        probs=[[[0.9, 0.1], [0.2, 0.8]], [[0.3, 0.7], [0.1, 0.9]]],
        states=ANSWERS,
    )
    return net


def questions(draws: int) -> Iterator[compare.Table]:
    """Which disease, before the X-ray and after it."""
    yield which_disease(draws, "a smoker back from Asia, short of breath", AT_FIRST)
    yield which_disease(draws, "the same, and the X-ray is positive", WITH_XRAY)


def which_disease(draws: int, when: str, evidence: Mapping[str, str]) -> compare.Table:
    """The diseases given the findings, exactly and by two kinds of sampling."""
    net = chest_clinic()

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [(posterior.probabilities(name)[1], posterior.mcse(name)[1]) for name in DISEASES]

    counted = compare.count(
        net,
        draws,
        lambda values: np.all([values[name] == evidence[name] for name in evidence], axis=0),
        lambda kept: [kept[name] == "yes" for name in DISEASES],
    )
    rows = (
        compare.infer(net, evidence, bmc.Exact(), ask),
        compare.infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
        counted,
    )
    return compare.Table(f"Which disease? {when}", DISEASES, rows)


def draw() -> dict[str, Any]:
    """The graph, and the unobserved nodes before any finding and after all of them."""
    picture.pyplot()
    net = chest_clinic()
    healthy, ill = (bmc.infer(net, e, engine=bmc.Exact()) for e in ({}, WITH_XRAY))
    panels = plotting.plot_prior_posterior(healthy, ill)
    panels[0].set_ylabel("probability")
    return {
        "chest_clinic": plotting.plot_dag(net, observed=WITH_XRAY).figure,
        "chest_clinic_marginals": panels[0].figure,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table for each question, and draw the net and its marginals."""
    options = picture.options(__doc__, arguments)
    for table in questions(20_000 if options.fast else 1_000_000):
        compare.print_table(table)
    for name, figure in draw().items():
        picture.save(figure, options.out, name)


if __name__ == "__main__":
    main()
