"""Dynamic Bayes nets: a template of one slice, what it compiles to, and data over time."""

from bayesmc.dbn.series import Row, Series
from bayesmc.dbn.slices import PREVIOUS, TIME, Slices
from bayesmc.dbn.template import DynamicBayesNet

__all__ = ["PREVIOUS", "TIME", "DynamicBayesNet", "Row", "Series", "Slices"]
