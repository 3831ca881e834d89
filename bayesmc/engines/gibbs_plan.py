"""Which kernel moves which node, and why: the table that ``explain`` shows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from bayesmc.engines.weighted import treatment
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.collapsed import CollapsedBlock, governing
from bayesmc.kernels.conjugate import conjugate_kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.gaussian_block import gaussian_blocks
from bayesmc.kernels.slice import Slice
from bayesmc.network import Problem
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, target_of

#: components that move together along learnt directions, at most
_FACTOR_SIZE = 24
_BOXES = ("real", "interval", "circle", "real vector", "product")


@dataclass(frozen=True, eq=False)
class Plan:
    """The kernels of a sweep.

    Attributes
    ----------
    kernels : list of Kernel
        In the order of a sweep.
    refusals : dict
        Node -> why it has no closed form.
    refusal : str or None
        Why there is no plan.
    """

    problem: Problem
    target: Target
    kernels: list[Kernel] = field(default_factory=list)
    refusals: dict[str, str] = field(default_factory=dict)
    refusal: str | None = None

    def describe(self) -> dict[str, str]:
        """What happens to each node."""
        found = {n: treatment(self.problem, n) for n in self.problem.model.nodes}
        for name in self.target.forward:
            if self.problem.model[name].is_stochastic and self.target.seen(name) is None:
                found[name] = "drawn forward: nothing observed depends on it"
        for kernel in self.kernels:
            for name in kernel.names:
                found[name] = kernel.words(name)
                if name in self.refusals:
                    found[name] += f" (no closed form: {self.refusals[name]})"
        return found


def plan_of(problem: Problem, debug: bool = False) -> Plan:
    """The plan for a posed problem."""
    target = target_of(problem)
    blankets = {name: Blanket(target, name) for name in target.chain}
    blocks = gaussian_blocks(target, blankets, debug)
    joined = {n for b in blocks for n in b.names}
    kernels: list[Kernel] = []
    refusals: dict[str, str] = {}
    left = [n for n in target.chain if n not in joined]
    numbers = []
    for name in left:
        blanket = blankets[name]
        if blanket.node.domain is not None:
            kernels.append(Enumerate(blanket))
            continue
        kernel = conjugate_kernel(blanket, debug)
        if isinstance(kernel, Kernel):
            kernels.append(kernel)
            continue
        refusals[name] = kernel
        numbers.append(name)
    for group in _together(target, blankets, numbers):
        if len(group) > 1 or target.model[group[0]].event_shape:
            kernels.append(FactorSlice(target, group))
            numbers = [n for n in numbers if n not in group]
    kernels += [Slice(blankets[n]) for n in numbers]
    for block in blocks:
        scales = governing(target, block, blankets)
        alone = {k.names[0]: k for k in kernels if len(k.names) == 1 and k.names[0] in scales}
        kernels = [k for k in kernels if k not in alone.values()]
        kernels.append(CollapsedBlock(target, block, scales, alone) if scales else block)
    order = {n: i for i, n in enumerate(target.chain)}
    kernels.sort(key=lambda k: -max(order[n] for n in k.names))
    return Plan(problem, target, kernels, refusals)


# ---- private ------------------------------------------------------------------------------------


def _together(
    target: Target, blankets: Mapping[str, Blanket], names: Sequence[str]
) -> list[tuple[str, ...]]:
    """Groups of unplated continuous nodes that share terms, small enough to move along learnt axes."""
    groups: list[list[str]] = []
    for name in names:
        node = target.model[name]
        support = node.support
        size = math.prod(node.event_shape)
        if node.plates or node.is_discrete or blankets[name].own is None:
            continue
        if support is None or support.kind not in _BOXES or size > _FACTOR_SIZE:
            continue
        mine = {id(t) for t in target.terms_of((name,))}
        merged = [name]
        for group in list(groups):
            meets = any(id(t) in mine for other in group for t in target.terms_of((other,)))
            sizes = sum(math.prod(target.model[n].event_shape) for n in (*group, *merged))
            if meets and sizes <= _FACTOR_SIZE:
                merged = [*group, *merged]
                groups.remove(group)
        groups.append(merged)
    return [tuple(n for n in target.chain if n in g) for g in groups]
