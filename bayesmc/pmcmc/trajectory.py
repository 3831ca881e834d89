"""All hidden nodes of all slices drawn at once given the static nodes: particle Gibbs, with ancestors."""

from __future__ import annotations

import numpy as np

from bayesmc.kernels.base import Kernel, Memory
from bayesmc.pmcmc.filters import ConditionalFilter
from bayesmc.pmcmc.trellis import Trellis
from bayesmc.structure.target import Values


class Trajectory(Kernel):
    """Draws a trajectory by a filter that keeps the current one among its particles.

    Parameters
    ----------
    trellis : Trellis
    particles : int
        Two or more; any number leaves the distribution of trajectories invariant, more of them mix faster.

    References
    ----------
    Lindsten, Jordan and Schön (2014), Particle Gibbs with ancestor sampling, JMLR 15, algorithm 2.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.unrolled import pose_any, series_of
    >>> from bayesmc.pmcmc.trajectory import Trajectory
    >>> from bayesmc.pmcmc.trellis import Trellis
    >>> from bayesmc.structure.target import target_of
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> problem = pose_any(dbn, {"y": [0.3, 0.7, 1.1]})
    >>> target = target_of(problem)
    >>> kernel = Trajectory(Trellis(target, series_of(problem)), particles=10)
    >>> kernel.names
    ('x[0]', 'x[1]', 'x[2]')
    >>> values = {**target.known, **{name: np.zeros(4) for name in kernel.names}}  # four chains
    >>> new, _ = kernel.step(values, {}, np.random.default_rng(0), False)
    >>> new["x[2]"].shape
    (4,)
    """

    label = "conditional particle filter"

    def __init__(self, trellis: Trellis, particles: int) -> None:
        self.filter = ConditionalFilter(trellis, particles)
        self.names = trellis.names
        how = "with its own ancestors" if trellis.carries else "with ancestor sampling"
        self.match = f"the whole trajectory, {particles} particles, {how}"

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        history = self.filter.run(values, len(values[self.names[0]]), rng)
        return self.filter.drawn(history, rng), memory
