"""Parameters learned from data: by climbing the evidence, and tables by expectation-maximisation."""

from bayesmc.learning.fit import fit
from bayesmc.learning.fitted import Fit

__all__ = ["Fit", "fit"]
