"""Options of engines as users write them: names of other programs, and engines called by a word."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from bayesmc.distributions.parameters import Named
from bayesmc.errors import did_you_mean

#: what options of engines are called here -> what PyMC, Stan, JAGS, BUGS and their like call them
_SAID: dict[str, str] = {
    "warmup": "burnin burn_in burn n_burnin num_burnin tune n_tune num_warmup n_warmup iter_warmup adapt "
    "n_adapt nadapt adapt_steps",
    "draws": "iter n_iter niter num_iter iterations n_iterations num_iterations samples n_samples nsamples "
    "num_samples sample n_sample num_draws n_draws ndraws iter_sampling n_steps steps",
    "chains": "n_chains nchains num_chains nchain chain",
    "thinning": "thin n_thin nthin num_thin thinning_interval",
    "particles": "n_particles num_particles nparticles n_part particle draws samples n_samples num_samples N",
    "target_accept": "adapt_delta delta target_accept_prob target_acceptance target_acceptance_rate accept",
    "max_depth": "max_treedepth max_tree_depth treedepth tree_depth",
    "start": "init inits initvals initval init_values initial initial_values init_params",
    "threads": "cores n_cores num_threads n_threads",
    "ess_threshold": "threshold ess_min essrmin ess_rmin",
    "resampling": "resample resample_method resampling_method scheme",
    "metric": "mass mass_matrix inv_metric",
    "reparametrize": "centered centred noncentered reparam reparameterize",
}
#: words of those that count the warmup, too
_ALL_ITERATIONS = "iter n_iter niter num_iter iterations n_iterations num_iterations".split()
#: options that are arguments of the call here
_OF_THE_CALL = {
    "rng": "rng seed random_seed random_state prng key",
    "progress": "progress progressbar progress_bar show_progress verbose",
    "executor": "executor jobs n_jobs parallel_chains mp_ctx",
    "inputs": "inputs",
    "keep": "keep var_names parameters_to_save monitor",
}
_ENGINES = {
    "HamiltonianMonteCarlo()": "nuts hmc hamiltonian nouturn stan",
    "Gibbs()": "gibbs mcmc jags bugs",
    "MetropolisHastings()": "metropolis mh rwm metropolishastings randomwalk",
    "MeanField()": "vi advi variational variationalinference meanfield vb variationalbayes",
    "LaplaceApproximation()": "laplace map quap inla mode",
    "ExpectationPropagation()": "ep expectationpropagation",
    "Exact()": "exact ve variableelimination junctiontree enumeration bp beliefpropagation",
    "LikelihoodWeighting(draws)": "lw likelihoodweighting weighting",
    "Importance(draws)": "is importance importancesampling",
    "Rejection(draws)": "rejection rejectionsampling abc",
    "ParticleFilter(particles)": "pf smc particle particlefilter bootstrap sir sequentialmontecarlo",
    "ParticleGibbs()": "pgibbs pg particlegibbs csmc pgas",
    "ParticleMetropolis()": "pmmh pmh particlemetropolis pmcmc",
    "KalmanFilter()": "kalman kf kalmanfilter",
    "ExtendedKalmanFilter()": "ekf extendedkalman extendedkalmanfilter",
    "UnscentedKalmanFilter()": "ukf unscented unscentedkalman unscentedkalmanfilter",
    "SwitchingKalmanFilter()": "skf imm gpb1 gpb2 slds switchingkalmanfilter",
    "DiscreteFilter()": "hmm forward forwardbackward viterbi discrete discretefilter",
    "GridFilter()": "grid gridfilter histogram",
}  # fmt: skip


class Options(Named):
    """What builds engines of options: an option that there is not is refused with the one that is meant.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> bmc.Rejection(n_samples=100)
    Traceback (most recent call last):
        ...
    TypeError: Rejection has no option 'n_samples' (did you mean draws?); it takes draws, bound, max_proposals
    """

    @classmethod
    def refuse_option(cls, name: str) -> None:
        """Raise for an option that the engine does not have.

        Raises
        ------
        TypeError
            Says what it takes and which was meant.
        """
        owner: Any = next(k for k in cls.__mro__ if "__init__" in k.__dict__)
        made = owner.__dict__.get("__dataclass_params__")
        if made is None or not made.init:  # an __init__ that somebody wrote knows what it takes
            return
        takes = [f.name for f in fields(owner) if f.init]
        raise TypeError(
            f"{cls.__name__} has no option {name!r}{_meant(name, takes)}; it takes "
            f"{', '.join(takes) or 'none'}"
        )


def engine_meant(engine: Any) -> str:
    """`` (did you mean bmc.Gibbs()?)`` for an engine called by a word; or nothing.

    Examples
    --------
    >>> from bayesmc.engines.options import engine_meant
    >>> engine_meant("NUTS"), engine_meant("magic"), engine_meant(3)
    (' (did you mean bmc.HamiltonianMonteCarlo()?)', '', '')
    """
    if not isinstance(engine, str):
        return ""
    word = "".join(c for c in engine.lower() if c.isalnum())
    meant = next((n for n, words in _ENGINES.items() if word in [_bare(n), *words.split()]), None)
    return "" if meant is None else f" (did you mean bmc.{meant}?)"


# ---- private ------------------------------------------------------------------------------------


def _bare(name: str) -> str:
    return name.split("(")[0].lower()


def _meant(name: str, takes: list[str]) -> str:
    plain = name.replace(".", "_").lower()
    for option, words in _SAID.items():
        if option in takes and (plain in words.split() or name in words.split()):
            counted = "warmup" in takes and plain in _ALL_ITERATIONS
            return f" (did you mean {option}{', counted after warmup' if counted else ''}?)"
    for argument, words in _OF_THE_CALL.items():
        if plain in words.split():
            return f" ({argument}= is given to the call, such as infer(..., {argument}=...))"
    return did_you_mean(name, takes)
