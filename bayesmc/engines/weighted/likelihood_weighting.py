"""Likelihood weighting: the forward pass, with evidence as weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bayesmc.engines.forward import fast_steps
from bayesmc.engines.weighted.drawing import WeightedEngine, check_count, treatment
from bayesmc.network import Problem
from bayesmc.network.forward import Step, refuse_noiseless, refuse_unsampled, whole


@dataclass(frozen=True)
class LikelihoodWeighting(WeightedEngine):
    """Draw every hidden node given its parents and weight by the density of what is observed.

    It runs on any net that can be sampled forwards, and gives ``log_marginal_likelihood`` without bias
    (of the likelihood itself). Its error grows with the surprise of the evidence: ``weight_ess`` tells
    how many equally weighted draws the answer is worth, ``pareto_k`` whether even that can be trusted.

    Parameters
    ----------
    draws : int

    References
    ----------
    Fung and Chang (1990); Shachter and Peot (1990); Koller and Friedman (2009), sec. 12.3.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.5))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> posterior = bmc.infer(net, {"x": 1.0}, engine=bmc.LikelihoodWeighting(20_000), rng=0)
    >>> bool(abs(posterior.probability(lambda a: a == 1) - 0.5) < 0.02)
    True
    """

    draws: int = 10_000

    label: ClassVar[str] = "likelihood weighting"
    remedy: ClassVar[str] = "use more draws, or Exact() where explain(net, evidence) says it can"

    def __post_init__(self) -> None:
        check_count(self, "draws", self.draws, "100_000")

    def refusal(self, problem: Problem) -> str | None:
        reason = refuse_unsampled(problem.model, problem.observed, "LikelihoodWeighting")
        if reason is not None:
            return f"{reason}, or propose it (Importance)"
        return refuse_noiseless(problem.model, whole(problem.observed), "LikelihoodWeighting")

    def describe(self, problem: Problem) -> dict[str, str]:
        return {name: treatment(problem, name) for name in problem.model.nodes}

    def steps(self, problem: Problem) -> list[Step]:
        return fast_steps(problem.model, problem.observed, problem.inputs)
