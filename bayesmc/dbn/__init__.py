"""Dynamic Bayes nets: a template of one slice, what it compiles to, and data over time."""

from bayesmc.dbn.problem import UNCOMPARED, SeriesProblem, pose_series, undrawn, with_computed
from bayesmc.dbn.series import Row, Series, read_row
from bayesmc.dbn.slices import PREVIOUS, TIME, Slices
from bayesmc.dbn.static import given_static, read_static
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
    "given_static",
    "pose_series",
    "read_row",
    "read_static",
    "undrawn",
    "with_computed",
]
