"""The way in: questions posed, engines chosen and run, and why."""

from bayesmc.auto.explaining import explain
from bayesmc.auto.explanation import Explanation
from bayesmc.auto.files import load
from bayesmc.auto.many import infer_many
from bayesmc.auto.prior import prior_predict
from bayesmc.auto.series import filter, forecast, most_likely, smooth
from bayesmc.auto.static import infer

__all__ = [
    "Explanation",
    "explain",
    "filter",
    "forecast",
    "infer",
    "infer_many",
    "load",
    "most_likely",
    "prior_predict",
    "smooth",
]
