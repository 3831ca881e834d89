"""The classic BUGS examples, restated in plain NumPy, held against long runs of JAGS and OpenBUGS.

Each module holds one kind of likelihood; its ``CASES`` are the tests. Hierarchies are written as nested
Normals: the linear predictor, not the residual effect, is the random quantity, which is the same
posterior and lets a Gibbs sampler draw the coefficients in closed form. Where the published variant
says otherwise (``seeds`` tests 2 to 4), it is written that way.
"""

from references.bugs import binomial, counts, discrete, normal
from references.case import Case

BUGS: tuple[Case, ...] = (*normal.CASES, *binomial.CASES, *counts.CASES, *discrete.CASES)

__all__ = ["BUGS"]
