"""Pictures: a net's graph, marginals, Markov chains, beliefs over time, particles, predicted data.

Everything here draws on matplotlib axes and returns them; nothing is shown or saved, and no setting of
matplotlib is changed. Each picture stands under ``posterior.plot``, too: ``plot_trace(posterior)`` is
``posterior.plot.trace()``. It needs matplotlib, which the extra ``plot`` brings and which is loaded when
something is drawn.
"""

from bayesmc.plotting.bands import plot_bands, plot_forecast
from bayesmc.plotting.chains import plot_energy, plot_rank, plot_trace
from bayesmc.plotting.dag import plot_dag
from bayesmc.plotting.marginals import plot_marginal, plot_prior_posterior
from bayesmc.plotting.numbers import plot_forest, plot_pair
from bayesmc.plotting.particles import plot_ancestry, plot_weights
from bayesmc.plotting.predictive import plot_predictive

#: by the names that they have under ``posterior.plot``
PICTURES = {
    function.__name__.removeprefix("plot_"): function
    for function in (
        plot_ancestry, plot_bands, plot_dag, plot_energy, plot_forecast, plot_forest, plot_marginal,
        plot_pair, plot_predictive, plot_rank, plot_trace, plot_weights,
    )
}  # fmt: skip

__all__ = [
    "plot_ancestry",
    "plot_bands",
    "plot_dag",
    "plot_energy",
    "plot_forecast",
    "plot_forest",
    "plot_marginal",
    "plot_pair",
    "plot_predictive",
    "plot_prior_posterior",
    "plot_rank",
    "plot_trace",
    "plot_weights",
]
