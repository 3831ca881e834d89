"""Results: posteriors that answer the same queries whatever made them."""

from bayesmc.results.chains import ChainsPosterior, ChainsSums, Checkpoint
from bayesmc.results.criteria import Elpd, compare
from bayesmc.results.draws import DrawsPosterior
from bayesmc.results.marginal import Marginal
from bayesmc.results.pictures import Pictures
from bayesmc.results.posterior import Posterior
from bayesmc.results.running import Sums
from bayesmc.results.saving import RunFile, save
from bayesmc.results.series import SeriesPosterior
from bayesmc.results.sums import RunningChains, SumsPosterior
from bayesmc.results.table import Summary

__all__ = [
    "ChainsPosterior",
    "ChainsSums",
    "Checkpoint",
    "DrawsPosterior",
    "Elpd",
    "Marginal",
    "Pictures",
    "Posterior",
    "RunFile",
    "RunningChains",
    "SeriesPosterior",
    "Summary",
    "Sums",
    "SumsPosterior",
    "compare",
    "save",
]
