"""Gibbs sampling on any net: every node from its full conditional, by the best kernel that fits it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from bayesmc.engines.base import Treatment
from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.gibbs_plan import plan_of
from bayesmc.engines.mcmc.sweep import SweepSampler
from bayesmc.errors import UnsupportedError
from bayesmc.network import Problem
from bayesmc.network.forward import refuse_noiseless, refuse_parts
from bayesmc.structure.target import target_of


@dataclass(frozen=True)
class Gibbs(ChainEngine):
    """Markov chains that draw every node in turn from its distribution given all others.

    What kernel a node gets is found, not declared (`explain` shows the table): nodes on which nothing
    observed depends are drawn forward; conjugate pairs in closed form; chains and trees of finite nodes as
    one, by filtering and sampling along them; other finite nodes by trying all states; numbers by slice
    sampling; simplices and matrices by an adaptive random walk. All chains and all elements of a plate move
    in one array operation.

    Parameters
    ----------
    draws : int
        Draws kept of every chain.
    warmup : int
        Sweeps before that, in which widths and scales adapt.
    chains : int
        Chains, all in one array: many cost little more than one.
    thinning : int
        Sweeps per kept draw.
    debug : bool
        Check every conjugate draw against the densities of the model (slow): an error names the node.
    start : dict, optional
        Node -> where its chains start, shape ``(*plates, *event)`` for all of them or
        ``(chains, *plates, *event)`` for each; labels for states. Nodes that are left out are drawn given
        these. What nothing observed depends on is drawn forward, wherever it starts.

    References
    ----------
    Geman and Geman (1984), IEEE PAMI 6; Gelfand and Smith (1990), JASA 85; Plummer (2003), JAGS.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"i": 4})
    >>> net.add("mean", bmc.Normal(0.0, 10.0))
    >>> net.add("precision", bmc.Gamma(1.0, 1.0))
    >>> net.add("x", lambda mean, precision: bmc.Normal(mean, precision**-0.5), plates="i")
    >>> posterior = bmc.infer(net, {"x": [1.2, 0.8, 1.5, 0.5]}, engine=bmc.Gibbs(), rng=0)
    >>> bool(abs(posterior.mean("mean") - 1.0) < 0.05)
    True
    """

    draws: int = 1000
    warmup: int = 1000
    chains: int = 4
    thinning: int = 1
    debug: bool = False
    start: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)

    label: ClassVar[str] = "Gibbs sampling"

    def refusal(self, problem: Problem) -> str | None:
        parts = refuse_parts(problem.observed, "Gibbs")
        if parts is not None:
            return parts
        try:
            terms = [n for n in target_of(problem).terms if n in problem.model.nodes]
            reason = refuse_noiseless(problem.model, terms, "Gibbs")
            if reason is not None:
                return reason
            plan_of(problem, self.debug)
        except UnsupportedError as error:
            return f"Gibbs has no kernel for this net: {error}"
        return None

    def describe(self, problem: Problem) -> dict[str, str]:
        return {row.node: str(row) for row in self.table(problem)}

    def table(self, problem: Problem) -> list[Treatment]:
        return plan_of(problem, self.debug).table()

    def tied(self, problem: Problem) -> Sequence[str]:
        return plan_of(problem, self.debug).constraints

    def sampler(self, problem: Problem) -> SweepSampler:
        plan = plan_of(problem, self.debug)
        return SweepSampler(plan.target, plan.kernels)
