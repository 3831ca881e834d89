"""``ParticleMetropolis``: static nodes by a random walk, their likelihood estimated by a particle filter."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from bayesmc.engines.mcmc.loop import Loop
from bayesmc.engines.weighted.drawing import treatment
from bayesmc.errors import ConvergenceWarning
from bayesmc.network import Problem
from bayesmc.pmcmc.base import ParticleEngine, ParticleSampler
from bayesmc.pmcmc.quasi import filter_of
from bayesmc.pmcmc.walk import ParameterWalk

#: errors of the log likelihood beyond which a chain hardly moves, and the best to have
_NOISY, _BEST = 2.0, 1.0
#: particles where none are given and nothing is known of the data
_FIRST = 200


@dataclass(frozen=True)
class ParticleMetropolis(ParticleEngine):
    """Markov chains over static nodes, each step of which runs a particle filter over all rows.

    Static nodes move together on the unconstrained scale, by an adaptive random walk and by steps to anywhere
    in what the warmup has learnt of the posterior; a step is accepted by the filter's estimate of the
    likelihood, and the trajectory drawn from that filter comes with it. The estimate is kept with its chain,
    which makes the answers exact in the long run for any number of particles. It suits static nodes that hold
    the trajectory fast, where ``ParticleGibbs`` mixes slowly. It is called with the template, ``infer(dbn,
    observations, engine=ParticleMetropolis())``.

    Parameters
    ----------
    draws, warmup, thinning : int
        As for ``Gibbs``.
    chains : int
        They share one array, so that many cost little more than few.
    particles : int, optional
        Of each filter. Best is an error of the log likelihood near 1 (its variance falls with the number of
        particles, and rises with that of rows). By default as many as it takes for that, from 50 to 5,000, by
        a look at the posterior before the warmup, where chains start, too; the warmup measures the error, and
        over 2 there is a warning.
    groups : int, optional
        Groups of chains that run apart, as for `Gibbs`.

    Raises
    ------
    UnsupportedError
        From ``infer``: a plain net, no continuous static node to learn, a discrete one, or a hidden node that
        cannot be sampled.

    Notes
    -----
    Where one number of each chain goes from slice to slice, particles are sorted by it and moved by points
    that lie evenly, which takes a fifth of the particles or less for the same error. The estimate has no bias
    either way.

    It takes slices times particles, chains and sweeps, which ``explain`` says before; a processor moves
    something like a million particles of one number in a second.

    References
    ----------
    Gerber and Chopin (2015), Sequential quasi Monte Carlo, JRSS B 77;
    Andrieu, Doucet and Holenstein (2010), JRSS B 72, sec. 2.4.2; Pitt, Silva, Giordani and Kohn (2012),
    J. Econometrics 171 (how many particles).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.pmcmc import ParticleMetropolis
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add_static("scale", bmc.LogNormal(0.0, 0.5))
    >>> dbn.add("x", lambda x_prev, scale: bmc.Normal(x_prev, scale), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> engine = ParticleMetropolis(draws=500, warmup=150, chains=20, particles=50)
    >>> posterior = bmc.infer(dbn, {"y": [0.2, 2.9, 0.4]}, engine=engine, rng=0)
    >>> posterior["scale"].shape, list(posterior.acceptance)
    ((20, 500), ['scale'])
    """

    draws: int = 500
    warmup: int = 100
    chains: int = 16
    particles: int | None = None
    thinning: int = 1
    start: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    groups: int | None = None

    label: ClassVar[str] = "particle Metropolis"

    def refusal(self, problem: Problem) -> str | None:
        reason = super().refusal(problem)
        if reason is not None:
            return reason
        question = self._question(problem)
        if not question.statics:
            return (
                "ParticleMetropolis walks over static nodes, and none is hidden; ParticleGibbs() draws "
                "trajectories alone, and so does smooth(dbn, observations)"
            )
        discrete = [n for n in question.statics if problem.model[n].is_discrete]
        if discrete:
            return (
                f"ParticleMetropolis walks over continuous static nodes, and {discrete[0]!r} is discrete; "
                "ParticleGibbs() takes those, too"
            )
        return None

    def describe(self, problem: Problem) -> dict[str, str]:
        found = {n: treatment(problem, n) for n in problem.model.nodes}
        walk = self._walk(problem)
        for name in walk.names:
            found[name] = ": ".join(walk.words(name))
        return found

    def sampler(self, problem: Problem) -> ParticleSampler:
        walk = self._walk(problem)
        return ParticleSampler(self._question(problem).target, [walk], walk.filter)

    # ---- private -------------------------------------------------------------------------------

    def _walk(self, problem: Problem) -> ParameterWalk:
        question = self._question(problem)
        filter = filter_of(question.trellis, self.particles or _FIRST, self.particles is None)
        return ParameterWalk(question.target, question.statics, filter)

    def _posterior(self, problem: Problem, sampler: Any, held: Any, loop: Loop) -> Any:
        (memory,) = loop.last.state["memory"]
        error = memory["error"]
        if len(memory["looks"]) and error > _NOISY:
            wanted = memory["particles"] * (error / _BEST) ** 2
            warnings.warn(
                f"ParticleMetropolis: the log likelihood is estimated with an error of {error:.1f} (standard "
                f"deviation), so that chains hardly move; give about particles={wanted:.0f}",
                ConvergenceWarning,
                stacklevel=5,
            )
        return super()._posterior(problem, sampler, held, loop)
