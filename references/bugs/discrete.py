"""Discrete unknowns: asia, with its tables known or learnt, and eyes, a mixture."""

from __future__ import annotations

from typing import Any

import numpy as np

import bayesmc as bmc
from references.bugs.common import VAGUE, jags_case
from references.case import Question

#: absent and present, as BUGS counts them: a mean is 1 + the probability of "present"
_CODES = (1, 2)


def asia(data: Any) -> Question:
    """The chest clinic of Lauritzen and Spiegelhalter: dyspnoea after a visit to Asia."""
    net = bmc.BayesNet("asia")
    net.table("bronchitis", ["smoking"], data["p.bronchitis"], states=_CODES)
    _asia_nodes(net, data, ())
    return Question(net, {"asia": data["asia"], "dyspnoea": data["dyspnoea"]})


def asia_learnt(data: Any) -> Question:
    """Asia, with the probabilities of bronchitis given smoking learnt from a few patients."""
    net = bmc.BayesNet("asia, learnt", plates={"smoker": 2, "patient": data["N"]})
    net.add("theta_b", bmc.Dirichlet(np.ones(2)), plates="smoker")

    @net.node(plates="patient", states=_CODES)
    def bronchitis(smoking, theta_b):
        return bmc.Categorical(theta_b[smoking - 1])

    _asia_nodes(net, data, "patient")
    seen = ("asia", "smoking", "tuberculosis", "lung.cancer", "bronchitis", "xray", "dyspnoea")
    evidence = {name.replace(".", "_"): np.array(data[name], dtype=float) for name in seen}
    return Question(net, evidence)


def eyes(data: Any) -> Question:
    """Peak sensitivity wavelengths of monkeys' eyes: two groups, both of which exist."""
    measured = np.array(data["y"], dtype=float)
    net = bmc.BayesNet("eyes", plates={"eye": len(measured)})
    net.add("P", bmc.Dirichlet(np.ones(2)))
    net.add("lambda1", VAGUE)
    net.add("theta", bmc.HalfNormal(VAGUE.scale))
    net.add("tau", bmc.Gamma(0.01, 0.01))
    net.add("sigma", lambda tau: 1 / np.sqrt(tau))
    net.add("lambda2", lambda lambda1, theta: lambda1 + theta)
    net.add("group", lambda P: bmc.Categorical(P), plates="eye")

    @net.node(plates="eye")
    def y(group, lambda1, theta, sigma):
        return bmc.Normal(lambda1 + theta * group, sigma)

    def both_groups_exist(group):
        first = group == 0
        return np.where(first.any("eye") & ~first.all("eye"), 0.0, -np.inf)

    net.potential("both_groups_exist", both_groups_exist)
    return Question(net, {"y": measured})


def _asia_nodes(net: bmc.BayesNet, data: Any, plates: str | tuple[()]) -> None:
    """All of asia but bronchitis. The prior of ``asia`` is idle: it is always observed."""
    net.table("asia", probs=[0.5, 0.5], states=_CODES, plates=plates)
    net.table("smoking", probs=data["p.smoking"], states=_CODES, plates=plates)
    net.table("tuberculosis", ["asia"], data["p.tuberculosis"], states=_CODES, plates=plates)
    net.table("lung_cancer", ["smoking"], data["p.lung.cancer"], states=_CODES, plates=plates)

    @net.node(plates=plates)
    def either(tuberculosis, lung_cancer):
        return np.maximum(tuberculosis, lung_cancer)

    net.table("xray", ["either"], data["p.xray"], states=_CODES, plates=plates)
    net.table(
        "dyspnoea", ["either", "bronchitis"], data["p.dyspnoea"], states=_CODES, plates=plates
    )


CASES = (
    jags_case("asia", "test1", asia),
    jags_case("asia", "test2", asia_learnt),
    jags_case(
        "eyes",
        "test1",
        eyes,
        monitors={"lambda[1]": ("lambda1", ()), "lambda[2]": ("lambda2", ())},
    ),
)
