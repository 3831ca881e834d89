"""Pictures: a net's graph with its plates, marginals, prior beside posterior.

Everything here draws on matplotlib axes and returns them; nothing is shown or saved. It needs
matplotlib, which the extra ``plot`` brings and which is loaded when something is drawn.
"""

from bayesmc.plotting.dag import plot_dag
from bayesmc.plotting.marginals import plot_marginal, plot_prior_posterior

__all__ = ["plot_dag", "plot_marginal", "plot_prior_posterior"]
