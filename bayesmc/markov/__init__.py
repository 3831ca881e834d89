"""Finite Markov chains as matrices: what the theory behind MCMC says of them.

Which states communicate, where a chain settles, whether it is reversible, how fast it forgets its
start. A chain is a square array and labels; it knows no nets and no engines, and draws no posteriors:
it judges kernels whose transition matrix somebody has written down. Matrices are dense, so a few
thousand states are the most that it is made for.
"""

from __future__ import annotations

from bayesmc.markov.arrays import total_variation
from bayesmc.markov.chain import MarkovChain
from bayesmc.markov.findings import CommunicatingClass, DetailedBalance

__all__ = ["CommunicatingClass", "DetailedBalance", "MarkovChain", "total_variation"]
