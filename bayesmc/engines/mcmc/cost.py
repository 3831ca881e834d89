"""What a sweep spends on each node, as a share: numbers of log densities that kernels ask for, counted.

A clock would say something else on every machine and at every run. What a kernel does beside (solving for
a block, drawing) is not counted, nor are Python's calls, which decide where all arrays are small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from bayesmc.kernels.base import Kernel
from bayesmc.structure.target import Target


def numbers_of(kernel: Kernel, target: Target) -> float:
    """Numbers of log densities that one move of one chain asks for, about.

    Examples
    --------
    Eleven numbers (the prior and ten observations), some six times each:

    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.mcmc.cost import numbers_of
    >>> from bayesmc.engines.mcmc.gibbs import plan_of
    >>> from bayesmc.network import pose
    >>> net = bmc.BayesNet(plates={"i": 10})
    >>> net.add("slope", bmc.StudentT(3.0, 0.0, 1.0))
    >>> net.add("y", lambda slope: bmc.Normal(np.floor(slope), 1.0), plates="i")
    >>> plan = plan_of(pose(net, {"y": np.arange(10.0)}))
    >>> numbers_of(plan.kernels[0], plan.target)
    66.0
    """
    elements = 0
    for term in target.terms_of(kernel.names):
        event = () if term.is_potential else target.model[term.name].event_shape
        elements += math.prod(term.shape) * max(math.prod(event), 1)
    return float(elements * kernel.evaluations)


def shares(kernels: Sequence[Kernel], target: Target) -> dict[str, float]:
    """Node -> the share of a sweep's numbers that is spent on it; none where one kernel does all.

    What a kernel spends on several nodes together is theirs by how many numbers each of them has.
    """
    if len(kernels) < 2:
        return {}
    spent: dict[str, float] = {}
    for kernel in kernels:
        sizes = {n: math.prod(target.model[n].value_shape) for n in kernel.names}
        numbers, size = numbers_of(kernel, target), sum(sizes.values())
        for name, own in sizes.items():
            spent[name] = spent.get(name, 0.0) + numbers * own / size
    total = sum(spent.values())
    return {name: one / total for name, one in spent.items()} if total > 0 else {}
