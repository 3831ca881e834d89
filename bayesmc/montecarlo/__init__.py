"""Monte Carlo on one density, without nets: rejection sampling, integration, hit or miss.

What the engines do to whole nets, done to a single density or region, with the figures by which to
judge it. Nets, evidence and posteriors are not known here.
"""

from __future__ import annotations

from bayesmc.montecarlo.estimate import Estimate
from bayesmc.montecarlo.integration import hit_or_miss, integrate
from bayesmc.montecarlo.rejection import RejectionSample, rejection_sample

__all__ = ["Estimate", "RejectionSample", "hit_or_miss", "integrate", "rejection_sample"]
