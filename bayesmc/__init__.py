"""bayesmc: declare a hybrid Bayes net in plain NumPy, and ask it.

A conditional density is a function whose argument names are its parents and which returns a
distribution. See ``bayesmc.BayesNet`` and ``bayesmc.infer``.
"""

import importlib
import threading
from typing import TYPE_CHECKING, Any

from bayesmc import errors
from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions import (
    LKJ,
    Affine,
    Bernoulli,
    Beta,
    BetaBinomial,
    Binomial,
    Categorical,
    Cauchy,
    Density,
    Dirichlet,
    DiscreteUniform,
    Distribution,
    Exponential,
    Gamma,
    Geometric,
    HalfCauchy,
    HalfNormal,
    InverseCdf,
    InverseGamma,
    InverseWishart,
    Joint,
    KernelDensity,
    Laplace,
    LogNormal,
    Mixture,
    Multinomial,
    MvNormal,
    NegativeBinomial,
    Normal,
    Ordered,
    OrderedLogistic,
    Poisson,
    StudentT,
    Truncated,
    Uniform,
    VonMises,
    Weibull,
    Wishart,
    WrappedNormal,
)
from bayesmc.network import BayesNet, FactorGraph
from bayesmc.objects import FrozenObject
from bayesmc.plates import PlateArray, stack
from bayesmc.results import Elpd, Marginal, Pictures, Posterior, SeriesPosterior, Summary, compare
from bayesmc.storage import CheckpointFile
from bayesmc.structure.log_density import log_density

if TYPE_CHECKING:
    from bayesmc import io, markov, montecarlo
    from bayesmc.auto import (
        Explanation,
        explain,
        filter,
        forecast,
        infer,
        infer_many,
        load,
        most_likely,
        prior_predict,
        smooth,
    )
    from bayesmc.engines.approximate.laplace import LaplaceApproximation
    from bayesmc.engines.approximate.posterior_mode import PosteriorMode, map
    from bayesmc.engines.discrete.filter import DiscreteFilter
    from bayesmc.engines.exact.exact import Exact
    from bayesmc.engines.factored.filter import BoyenKoller, FactoredFrontier
    from bayesmc.engines.grid.filter import GridFilter
    from bayesmc.engines.kalman.filter import KalmanFilter
    from bayesmc.engines.kalman.nonlinear import ExtendedKalmanFilter, UnscentedKalmanFilter
    from bayesmc.engines.mcmc.gibbs import Gibbs
    from bayesmc.engines.mcmc.hamiltonian import HamiltonianMonteCarlo
    from bayesmc.engines.mcmc.metropolis import MetropolisHastings
    from bayesmc.engines.mcmc.proposals import Independence, RandomWalk
    from bayesmc.engines.particles.belief import ParticleBelief
    from bayesmc.engines.particles.filter import ParticleFilter
    from bayesmc.engines.particles.islands import IslandFilter
    from bayesmc.engines.particles.kld import KLD
    from bayesmc.engines.particles.recovery import Recovery
    from bayesmc.engines.propagation.engine import AssumedDensity, ExpectationPropagation
    from bayesmc.engines.switching.filter import SwitchingKalmanFilter
    from bayesmc.engines.variational.mean_field import MeanField
    from bayesmc.engines.weighted.importance import Importance
    from bayesmc.engines.weighted.likelihood_weighting import LikelihoodWeighting
    from bayesmc.engines.weighted.rejection import Rejection
    from bayesmc.learning.fit import fit
    from bayesmc.learning.fitted import Fit
    from bayesmc.pmcmc import ParticleGibbs, ParticleMetropolis

__version__ = "0.2.0"

__all__ = [
    "LKJ",
    "Affine",
    "AssumedDensity",
    "BayesNet",
    "Bernoulli",
    "Beta",
    "BetaBinomial",
    "Binomial",
    "BoyenKoller",
    "Categorical",
    "Cauchy",
    "CheckpointFile",
    "Density",
    "Dirichlet",
    "DiscreteFilter",
    "DiscreteUniform",
    "DynamicBayesNet",
    "Elpd",
    "Distribution",
    "Exact",
    "ExpectationPropagation",
    "Explanation",
    "Exponential",
    "ExtendedKalmanFilter",
    "FactorGraph",
    "FactoredFrontier",
    "Fit",
    "FrozenObject",
    "Gamma",
    "Geometric",
    "GridFilter",
    "Gibbs",
    "HamiltonianMonteCarlo",
    "HalfCauchy",
    "HalfNormal",
    "Importance",
    "Independence",
    "InverseCdf",
    "InverseGamma",
    "InverseWishart",
    "IslandFilter",
    "Joint",
    "KLD",
    "KalmanFilter",
    "KernelDensity",
    "Laplace",
    "LaplaceApproximation",
    "LikelihoodWeighting",
    "LogNormal",
    "Marginal",
    "MeanField",
    "MetropolisHastings",
    "Mixture",
    "Multinomial",
    "MvNormal",
    "NegativeBinomial",
    "Normal",
    "Ordered",
    "OrderedLogistic",
    "ParticleBelief",
    "ParticleFilter",
    "ParticleGibbs",
    "ParticleMetropolis",
    "PlateArray",
    "Poisson",
    "Posterior",
    "PosteriorMode",
    "RandomWalk",
    "Recovery",
    "Rejection",
    "SeriesPosterior",
    "StudentT",
    "Summary",
    "SwitchingKalmanFilter",
    "Truncated",
    "Uniform",
    "UnscentedKalmanFilter",
    "VonMises",
    "Weibull",
    "Wishart",
    "WrappedNormal",
    "compare",
    "errors",
    "explain",
    "filter",
    "fit",
    "forecast",
    "infer",
    "infer_many",
    "io",
    "load",
    "log_density",
    "map",
    "markov",
    "montecarlo",
    "most_likely",
    "prior_predict",
    "smooth",
    "stack",
]


#: rooms that load when first asked for, as not every program needs them
_ROOMS = ("auto", "engines", "io", "learning", "markov", "montecarlo", "plotting", "pmcmc", "robotics",
          "sklearn", "testing", "vision")  # fmt: skip
#: module -> its names that load it when first asked for, so that an import alone is quick: what asks and
#: answers is two thirds of the package. Type checkers read the same names above.
_WHERE = {
    "auto": (
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
    ),
    "engines.approximate.laplace": ("LaplaceApproximation",),
    "engines.approximate.posterior_mode": ("PosteriorMode", "map"),
    "engines.discrete.filter": ("DiscreteFilter",),
    "engines.exact.exact": ("Exact",),
    "engines.factored.filter": ("BoyenKoller", "FactoredFrontier"),
    "engines.grid.filter": ("GridFilter",),
    "engines.kalman.filter": ("KalmanFilter",),
    "engines.kalman.nonlinear": ("ExtendedKalmanFilter", "UnscentedKalmanFilter"),
    "engines.mcmc.gibbs": ("Gibbs",),
    "engines.mcmc.hamiltonian": ("HamiltonianMonteCarlo",),
    "engines.mcmc.metropolis": ("MetropolisHastings",),
    "engines.mcmc.proposals": ("Independence", "RandomWalk"),
    "engines.particles.belief": ("ParticleBelief",),
    "engines.particles.filter": ("ParticleFilter",),
    "engines.particles.islands": ("IslandFilter",),
    "engines.particles.kld": ("KLD",),
    "engines.particles.recovery": ("Recovery",),
    "engines.propagation.engine": ("AssumedDensity", "ExpectationPropagation"),
    "engines.switching.filter": ("SwitchingKalmanFilter",),
    "engines.variational.mean_field": ("MeanField",),
    "engines.weighted.importance": ("Importance",),
    "engines.weighted.likelihood_weighting": ("LikelihoodWeighting",),
    "engines.weighted.rejection": ("Rejection",),
    "learning.fit": ("fit",),
    "learning.fitted": ("Fit",),
    "pmcmc": ("ParticleGibbs", "ParticleMetropolis"),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}

#: threads that enter packages from two ends at once would meet half of a module
_LOADING = threading.RLock()


def __getattr__(name: str) -> Any:
    """Loads the module behind a name that is asked for the first time (PEP 562)."""
    with _LOADING:
        if name in _ROOMS:
            return importlib.import_module(f"bayesmc.{name}")
        if name not in _MODULES:
            raise AttributeError(f"module 'bayesmc' has no attribute {name!r}")
        found = getattr(importlib.import_module(f"bayesmc.{_MODULES[name]}"), name)
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    """All names, those not loaded yet included."""
    return sorted({*globals(), *__all__, *_ROOMS})


# answers stand below what draws them
Pictures.known = lambda: importlib.import_module("bayesmc.plotting").PICTURES
