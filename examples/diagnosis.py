"""ASIA, the chest clinic of Lauritzen and Spiegelhalter: a diagnosis net of eight yes-or-no nodes.

Lauritzen, S. L. and Spiegelhalter, D. J. (1988). Local computations with probabilities on graphical
structures and their application to expert systems. J. R. Statist. Soc. B 50(2), 157-224; the
probabilities are the paper's. "Shortness-of-breath (dyspnoea) may be due to tuberculosis, lung
cancer or bronchitis, or none of them, or more than one of them."
"""

from __future__ import annotations

import numpy as np

import bayesmc as bmc

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
