"""Which move each node gets from Metropolis-Hastings: the user's proposals, and defaults for the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bayesmc.engines.mcmc.proposals import RandomWalk, Read, read_proposals
from bayesmc.engines.weighted.drawing import treatment
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.ensemble import AFRESH, BlockWalk
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.parts import may_be_drawn_anew, parts_of
from bayesmc.kernels.proposal import Key, Proposal, names_of
from bayesmc.kernels.proposed import Proposed, ProposedBlock
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.kernels.redrawn import Redrawn, redrawn_kernels
from bayesmc.network import Problem
from bayesmc.network.forward import refuse_unsampled
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, target_of

#: numbers beyond which continuous nodes no longer move as one block
LARGEST_BLOCK = 200
#: members of an ensemble, least and most
_LEAST, _MOST = 8, 64
#: numbers that one evaluation of all terms may take, for all members of all ensembles together
_ELEMENTS = 2e7


@dataclass(frozen=True, eq=False)
class Plan:
    """The kernels of a sweep.

    Attributes
    ----------
    kernels : list of Kernel
        In the order of a sweep.
    ensemble : int
        Members of the ensemble that each chain is; 1 where chains are ordinary.
    refusal : str or None
        Why the engine cannot answer.
    """

    problem: Problem
    target: Target
    kernels: list[Kernel] = field(default_factory=list)
    ensemble: int = 1
    refusal: str | None = None

    def describe(self) -> dict[str, str]:
        """What happens to each node."""
        found = {n: treatment(self.problem, n) for n in self.problem.model.nodes}
        for name in self.target.forward:
            if self.problem.model[name].is_stochastic and self.target.seen(name) is None:
                found[name] = "drawn forward: nothing observed depends on it"
        for kernel in self.kernels:
            if isinstance(kernel, Redrawn):
                found[kernel.names[0]] += f", then {kernel.label} {kernel.match}"
                continue
            for name in kernel.names:
                others = ", ".join(repr(n) for n in kernel.names if n != name)
                how = f"{kernel.label}: {kernel.match}" if kernel.match else kernel.label
                found[name] = how + (f", together with {others}" if others else "")
        return found


def plan_of(problem: Problem, proposal: Mapping[Key, Any], chains: int) -> Plan:
    """The plan for a posed problem.

    Raises
    ------
    UnknownNodeError, EvidenceError, ModelError
        A proposal that does not fit the net or the evidence.
    """
    read = read_proposals(problem, proposal)
    target = target_of(problem, _inside(problem, read))
    refusal = refuse_unsampled(
        problem.model,
        {*problem.observed, *target.chain},
        "MetropolisHastings",
    )
    given = {n for key in read for n in names_of(key)}
    kernels = [_asked_for(target, key, what) for key, what in read.items()]
    rest = [n for n in target.chain if n not in given]
    discrete = [n for n in rest if problem.model[n].is_discrete]
    continuous = [n for n in rest if not problem.model[n].is_discrete]
    kernels += [Jump(Blanket(target, n)) for n in reversed(discrete)]
    ensemble = 1
    if continuous:
        size = parts_of(target, continuous)[-1].stop
        if size > LARGEST_BLOCK:
            why = f"{size} continuous numbers are too many to move as one"
            kernels += [AdaptiveWalk(Blanket(target, n), why) for n in reversed(continuous)]
        else:
            ensemble = _members(target, size, chains)
            anew = AFRESH if may_be_drawn_anew(target, continuous) else 0.0
            kernels.append(BlockWalk(target, continuous, ensemble, alone=not kernels, anew=anew))
    kernels += redrawn_kernels(target, {n: Blanket(target, n) for n in rest}, kernels)
    return Plan(problem, target, kernels, ensemble, refusal)


# ---- private ------------------------------------------------------------------------------------


def _inside(problem: Problem, read: Mapping[Key, Read]) -> list[str]:
    """Nodes of the chain whether or not anything observed depends on them.

    These are nodes with proposals, those that proposals look at, and those that cannot be drawn forward.
    """
    found: list[str] = []
    for key, what in read.items():
        found += names_of(key)
        if isinstance(what, Proposal):
            found += what.parents
    found += [n for n, node in problem.model.nodes.items() if node.is_stochastic and node.unsampled]
    return list(dict.fromkeys(found))


def _asked_for(target: Target, key: Key, what: Read) -> Kernel:
    """The kernel of a proposal."""
    if isinstance(what, RandomWalk):
        if isinstance(key, tuple):
            scale = what.scale if what.scale.ndim else float(what.scale)
            return BlockWalk(
                target,
                key,
                scale=scale,
                unconstrained=what.unconstrained,
                adaptive=what.adaptive,
            )
        blanket = Blanket(target, key)
        if blanket.node.is_discrete:
            return Jump(blanket, int(what.scale.flat[0]))
        return AdaptiveWalk(
            blanket,
            scale=what.scale,
            unconstrained=what.unconstrained,
            adaptive=what.adaptive,
        )
    if isinstance(key, tuple):
        return ProposedBlock(target, key, what)
    return Proposed(Blanket(target, key), what)


def _members(target: Target, size: int, chains: int) -> int:
    """Members of an ensemble for a block of so many numbers; 1 where they would take too much memory."""
    wanted = min(max(2 * (size + 1), _LEAST), _MOST)
    elements = sum(max(math.prod(term.shape), 1) for term in target.terms.values())
    affordable = int(_ELEMENTS / (elements * chains)) // 2 * 2
    return min(wanted, affordable) if affordable >= 4 else 1
