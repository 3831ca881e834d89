"""Gibbs sampling on any net: every node from its full conditional, by the best kernel that fits it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from bayesmc.engines.base import Treatment
from bayesmc.engines.chains import ChainEngine
from bayesmc.engines.forward import fast_steps
from bayesmc.engines.gibbs_plan import Plan, plan_of
from bayesmc.engines.starting import start_states
from bayesmc.errors import UnsupportedError
from bayesmc.network import Problem
from bayesmc.network.forward import Pass, run
from bayesmc.structure.target import Values


@dataclass(frozen=True)
class Gibbs(ChainEngine):
    """Markov chains that draw every node in turn from its distribution given all others.

    What kernel a node gets is found, not declared (`explain` shows the table): nodes on which nothing
    observed depends are drawn forward; conjugate pairs in closed form; finite nodes by trying all states;
    numbers by slice sampling; simplices and matrices by an adaptive random walk. All chains and all
    elements of a plate move in one array operation.

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

    label: ClassVar[str] = "Gibbs sampling"

    def refusal(self, problem: Problem) -> str | None:
        try:
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

    def sampler(self, problem: Problem) -> GibbsSampler:
        plan = plan_of(problem, self.debug)
        return GibbsSampler(plan)


class GibbsSampler:
    """One sweep: every kernel in turn, deterministic nodes recomputed after each."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.target = plan.target
        self.kernels = plan.kernels
        problem = plan.problem
        bare = replace(problem.model, potentials={})  # none reads what is drawn forward
        steps = dict(
            zip(bare.nodes, fast_steps(bare, problem.observed, problem.inputs), strict=True)
        )
        self.forward = [steps[n] for n in self.target.forward]
        self.forward_nodes = self.target.forward

    def start(self, rng: np.random.Generator, chains: int) -> dict[str, Any]:
        values = start_states(self.target, chains, rng)
        inside = {n: values[n] for n in (*self.target.chain, *self.target.links)}
        return {
            "values": inside,
            "memory": [k.start(values, chains) for k in self.kernels],
            "chains": chains,
        }

    def step(self, state: Mapping[str, Any], rng: np.random.Generator, warmup: bool) -> Any:
        values: Values = {**self.target.known, **state["values"]}
        memories = list(state["memory"])
        for i, kernel in enumerate(self.kernels):
            new, memories[i] = kernel.step(values, memories[i], rng, warmup)
            values.update(new)
            self.target.refresh(values, kernel.names)
        return {**state, "values": {n: values[n] for n in state["values"]}, "memory": memories}

    def end_warmup(self, state: Mapping[str, Any]) -> Any:
        frozen = [k.end_warmup(m) for k, m in zip(self.kernels, state["memory"], strict=True)]
        return {**state, "memory": frozen}

    def values(self, state: Mapping[str, Any], rng: np.random.Generator) -> Values:
        values: Values = {**self.target.known, **state["values"]}
        if self.forward:
            values = run(self.forward, Pass(rng, (state["chains"],), values)).values
        return values

    def acceptance(self, state: Mapping[str, Any]) -> dict[str, np.ndarray]:
        found = {}
        for kernel, memory in zip(self.kernels, state["memory"], strict=True):
            rate = kernel.acceptance(memory)
            if rate is not None:
                found[", ".join(kernel.names)] = rate
        return found
