"""Particle Markov chain Monte Carlo: trajectories and static nodes of a template given everything.

The engines here use other engines: sweeps of kernels for the static nodes, particle filters for the rest.
They answer ``infer(dbn, observations, engine=...)``; what a filter alone can say stands in ``engines``.
"""

from bayesmc.pmcmc.gibbs import ParticleGibbs
from bayesmc.pmcmc.metropolis import ParticleMetropolis

__all__ = ["ParticleGibbs", "ParticleMetropolis"]
