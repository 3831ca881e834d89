"""``prior_predict``: what a model says before anything is observed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Never

from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.engines.weighted.likelihood_weighting import LikelihoodWeighting
from bayesmc.errors import ModelError, UnsupportedError
from bayesmc.network import BayesNet, Problem, read_inputs
from bayesmc.randomness import seed_sequence
from bayesmc.results import Posterior


@by_keyword
def prior_predict(
    net: BayesNet | DynamicBayesNet,
    draws: int = 1000,
    *beyond: Never,
    inputs: Any = None,
    plates: Mapping[str, int] | None = None,
    steps: int | None = None,
    rng: Any = None,
) -> Posterior:
    """Draws of all nodes from the prior, data included, asked as a posterior is.

    Parameters
    ----------
    net : BayesNet or DynamicBayesNet
    draws : int
    inputs : dict, optional
        Values of the input nodes (of a template time first); they bring sizes of plates.
    plates : dict, optional
        Sizes of plates that are else read from data.
    steps : int, optional
        Slices of a template.
    rng : seed, SeedSequence, Generator or None

    Returns
    -------
    Posterior
        Of independent draws: ``prior["y"]``, ``prior.quantile("y", [0.05, 0.95])``,
        ``prior.probability(...)``.

    Raises
    ------
    ModelError, EvidenceError, PlateError, UnsupportedError

    References
    ----------
    Gabry, Simpson, Vehtari, Betancourt and Gelman (2019), Visualization in Bayesian workflow, JRSS A 182,
    sec. 3.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"day": None})
    >>> net.add("mean", bmc.Normal(0.0, 10.0))
    >>> net.add("y", lambda mean: bmc.Normal(mean, 1.0), plates="day")
    >>> prior = bmc.prior_predict(net, 4000, plates={"day": 3}, rng=0)
    >>> prior["y"].shape, float(prior.std("y")[0].round())
    ((1, 4000, 3), 10.0)
    """
    if beyond:
        refuse_positions(prior_predict, beyond)
    if isinstance(net, DynamicBayesNet):
        if steps is None:
            raise ModelError(
                "prior_predict: give steps=, how many slices of the template there are"
            )
        net, inputs = net.unroll(steps, inputs), None
    elif steps is not None:
        raise ModelError("prior_predict(steps=...): a net has no slices; leave it out")
    if not isinstance(net, BayesNet):
        raise ModelError(
            f"prior_predict: expected a BayesNet or a DynamicBayesNet, not {type(net).__name__}"
        )
    inputs = net.unframed(None, inputs)[1]
    model = net.model(None, inputs, plates)
    declarations = {n: c.declaration for n, c in model.nodes.items()}
    known = read_inputs(declarations, model.sizes, inputs, model.labels)
    problem = Problem(net.snapshot(), model, {}, known)
    engine = LikelihoodWeighting(draws)
    refused = engine.refusal(problem)
    if refused is not None:
        raise UnsupportedError(f"prior_predict: {refused}")
    return engine.run(problem, seed_sequence(rng))
