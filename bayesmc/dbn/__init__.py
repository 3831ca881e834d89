"""Dynamic Bayes nets: a template of one slice, what it compiles to, and data over time."""

from bayesmc.dbn.problem import UNCOMPARED, SeriesProblem, pose_series
from bayesmc.dbn.series import Row, Series, read_row, read_static
from bayesmc.dbn.slices import PREVIOUS, TIME, Slices
from bayesmc.dbn.template import DynamicBayesNet

__all__ = [
    "UNCOMPARED",
    "PREVIOUS",
    "TIME",
    "DynamicBayesNet",
    "Row",
    "Series",
    "SeriesProblem",
    "Slices",
    "pose_series",
    "read_row",
    "read_static",
]
