"""``ParticleGibbs``: static nodes by the kernels of Gibbs, whole trajectories by a conditional filter.

A trajectory is all hidden nodes of all slices, drawn at once given the static nodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from bayesmc.engines.base import Treatment
from bayesmc.engines.mcmc.gibbs import Plan, plan_of
from bayesmc.errors import UnsupportedError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.network import Problem
from bayesmc.pmcmc.base import ParticleEngine, ParticleSampler
from bayesmc.pmcmc.filters import ConditionalStep, Filter
from bayesmc.pmcmc.trellis import Trellis
from bayesmc.structure.target import Values


@dataclass(frozen=True)
class ParticleGibbs(ParticleEngine):
    """Markov chains that draw the whole trajectory of a template at once, then its static nodes, and so on.

    The trajectory comes from a particle filter that keeps the current one among its particles (with ancestor
    sampling), static nodes from their full conditionals given it, as with ``Gibbs``: in closed form where
    there is one. Any number of particles from two on is exact in the long run; more of them mix faster. It is
    called with the template, ``infer(dbn, observations, engine=ParticleGibbs())``, and answers about the
    unrolled net: ``posterior.mean("x[3]")``, ``posterior["theta"]``.

    Parameters
    ----------
    draws : int
        Draws kept of every chain.
    warmup : int
        Sweeps before that.
    chains : int
        Chains, all in one array: many cost little more than few.
    particles : int
        Two or more, of each chain; the trajectory that is kept is one of them.
    thinning : int
        Sweeps per kept draw.
    start : dict, optional
        Node -> where its chains start, as for `Gibbs`; of static nodes, since a filter draws trajectories.
    groups : int, optional
        Groups of chains that run apart, as for `Gibbs`.

    Raises
    ------
    UnsupportedError
        From ``infer``: a plain net, a hidden node that cannot be sampled, or nothing hidden.

    Notes
    -----
    Where a deterministic node carries something on from slice to slice (a running sum), ancestors are not
    drawn anew: that is valid, too, but early slices then change seldom unless particles are many. Plates
    whose elements never meet have particles of their own.

    References
    ----------
    Andrieu, Doucet and Holenstein (2010), JRSS B 72; Lindsten, Jordan and Schön (2014), JMLR 15.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.pmcmc import ParticleGibbs
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add_static("precision", bmc.Gamma(2.0, 1.0))
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.5 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x, precision: bmc.Normal(x, precision**-0.5))
    >>> engine = ParticleGibbs(draws=400, warmup=50, chains=4, particles=20)
    >>> posterior = bmc.infer(dbn, {"y": [1.2, 0.7, -0.4]}, engine=engine, rng=0)
    >>> posterior["x[2]"].shape, bool(1.5 < posterior.mean("precision") < 3.0)
    ((4, 400), True)
    """

    draws: int = 500
    warmup: int = 100
    chains: int = 16
    particles: int = 50
    thinning: int = 1
    start: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    groups: int | None = None

    label: ClassVar[str] = "particle Gibbs"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.particles < 2:
            raise ValueError(
                f"ParticleGibbs(particles={self.particles!r}): one particle is the trajectory that is kept; "
                "give 2 or more, such as 100"
            )

    def refusal(self, problem: Problem) -> str | None:
        reason = super().refusal(problem)
        if reason is not None:
            return reason
        try:
            self._plan(problem)
        except UnsupportedError as error:
            return f"ParticleGibbs has no kernel for the static nodes: {error}"
        return None

    def describe(self, problem: Problem) -> dict[str, str]:
        return {row.node: str(row) for row in self.table(problem)}

    def table(self, problem: Problem) -> list[Treatment]:
        trajectory = self._trajectory(problem)
        drawn = {} if trajectory is None else dict.fromkeys(trajectory.names, trajectory)
        return [
            Treatment(row.node, *drawn[row.node].words(row.node), row.plates)
            if row.node in drawn
            else row
            for row in self._plan(problem).table()
        ]

    def tied(self, problem: Problem) -> Sequence[str]:
        return self._plan(problem).constraints

    def sampler(self, problem: Problem) -> ParticleSampler:
        question = self._question(problem)
        kernels: list[Kernel] = list(self._plan(problem).kernels)
        trajectory = self._trajectory(problem)
        if trajectory is not None:
            kernels.insert(0, trajectory)
        filter = Filter(question.trellis, self.particles)
        return ParticleSampler(question.target, kernels, filter)

    # ---- private -------------------------------------------------------------------------------

    def _plan(self, problem: Problem) -> Plan:
        """What moves the static nodes."""
        return plan_of(problem, only=self._question(problem).statics)

    def _trajectory(self, problem: Problem) -> Trajectory | None:
        trellis = self._question(problem).trellis
        return Trajectory(trellis, self.particles) if trellis.names else None


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
    >>> from bayesmc.pmcmc.gibbs import Trajectory
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
        self.filter = Filter(trellis, particles, step=ConditionalStep)
        self.names = trellis.names
        how = "with its own ancestors" if trellis.carries else "with ancestor sampling"
        self.match = f"the whole trajectory, {particles} particles, {how}"

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        history = self.filter.run(values, len(values[self.names[0]]), rng)
        return self.filter.drawn(history, rng), memory
