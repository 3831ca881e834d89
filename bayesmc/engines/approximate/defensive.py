"""Draws of the prior among those that check an approximation: regions that it never reaches show there.

Weights p/q of draws of q are silent about what q misses. Of a mixture of q and the prior they are not: where
the prior has mass and q has none they are large (a defensive mixture, Hesterberg 1995, sec. 2). Only what the
prior meets shows, so that of many numbers, or of vague priors, other modes stay unseen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.approximate.approximation import Approximation, Drawn
from bayesmc.engines.forward import fast_steps
from bayesmc.errors import BayesmcError
from bayesmc.network import Problem
from bayesmc.network.forward import Pass
from bayesmc.structure.target import Target, Values, target_of

#: share of the prior's draws among all
SHARE = 0.2


def prior_draws(
    problem: Problem, approximation: Approximation, draws: int, rng: np.random.Generator
) -> Drawn | None:
    """Draws of an approximation's nodes from their densities given parents, with its own log density of them.

    Nothing below a node is looked at; parents that are observed have the values seen. None where the
    approximation cannot weigh values that it has not drawn, or some node cannot be drawn so.

    Returns
    -------
    Drawn
        ``log_density`` is that of what ``approximation.spread`` draws from (of ``draw`` without).
    """
    weigh = getattr(approximation, "log_density", None)
    target = target_of(problem, approximation.names)
    names = approximation.names
    if weigh is None or not names or not all(name in target.terms for name in names):
        return None
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            values = _ancestral(problem, target, names, draws, rng)
            return Drawn(values, np.asarray(weigh(values)))
    except (BayesmcError, ArithmeticError, ValueError):  # extreme values of vague priors
        return None


class PriorLogs:
    """A sum of log densities of nodes given parents, kept while terms of the whole are added up.

    Parameters
    ----------
    target : Target
    names : tuple of str
    log_of : callable
        Log factors of a term at values.
    """

    def __init__(self, target: Target, names: Any, log_of: Any) -> None:
        self.target, self.names, self.log_of = target, frozenset(names), log_of
        self.total: Any = 0.0

    def __call__(self, term: Any, values: Mapping[str, np.ndarray]) -> np.ndarray:
        log: np.ndarray = self.log_of(term, values)
        if term.name in self.names and not term.is_potential:
            lead = log.shape[: log.ndim - len(term.shape)]
            own = np.broadcast_to(log, lead + term.shape)
            seen = self.target.seen(term.name)
            if seen is not None and seen.mask is not None:
                own = np.where(seen.mask, 0.0, own)
            self.total = self.total + own.reshape(*lead, -1).sum(axis=-1)
        return log


# ---- private ------------------------------------------------------------------------------------


def _ancestral(
    problem: Problem, target: Target, names: Any, draws: int, rng: np.random.Generator
) -> Values:
    """Values of nodes, parents first, computed nodes between them as they are met."""
    nodes = list(problem.model.nodes)
    bare = replace(problem.model, potentials={})  # these are weighed, not drawn from
    steps = dict(zip(nodes, fast_steps(bare, problem.observed, problem.inputs), strict=True))
    wanted = {*names, *target.links}
    state = Pass(rng, (draws,), dict(target.known))
    for name in nodes:
        if name in wanted:
            steps[name](state)
    shapes = {name: (draws, *problem.model[name].value_shape) for name in names}
    return {name: np.broadcast_to(state.values[name], shape) for name, shape in shapes.items()}
