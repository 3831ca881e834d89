"""Static nodes moved by a random walk whose likelihood is a filter's estimate: particle marginal Metropolis.

The estimate that a chain stands on is kept until the chain moves: made anew, it would no longer leave the
posterior invariant.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.special

from bayesmc.kernels.adaptation import chance
from bayesmc.kernels.base import Memory
from bayesmc.kernels.densities import accepted, instead
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.random_walk import counted
from bayesmc.pmcmc.filters import Filter
from bayesmc.structure.target import Target, Values

#: sweeps of the warmup between two looks at the error of the estimate, and how much of what was seen is kept
_EVERY, _KEPT = 20, 256
#: median of the absolute difference of two normal numbers, in standard deviations of one
_MEDIAN = 0.9539
#: the error of the log likelihood that is taken for granted before the first look
_FIRST_ERROR = 1.0
#: share of accepted steps of length zero below which the walk no longer makes up for the error
_LEAST = 0.25


class ParameterWalk(BlockWalk):
    """An adaptive random walk of static nodes, and the trajectory of the filter that was accepted with them.

    Parameters
    ----------
    target : Target
        Of the unrolled net.
    statics : tuple of str
        Continuous static nodes of the chain.
    filter : Filter

    Notes
    -----
    An error of the log likelihood lowers the rate at which steps are accepted, by ``erfc(sd / 2)`` for steps
    of length zero. The warmup measures it, and aims at that share of the usual rate, so that steps do not
    shrink because particles are few.

    References
    ----------
    Andrieu, Doucet and Holenstein (2010), JRSS B 72, sec. 2.4.2 (PMMH); Pitt, Silva, Giordani and Kohn
    (2012), J. Econometrics 171, and Sherlock, Thiery, Roberts and Rosenthal (2015), Ann. Statist. 43, on the
    error.
    """

    label = "adaptive random walk"

    def __init__(self, target: Target, statics: tuple[str, ...], filter: Filter) -> None:
        super().__init__(prior_of(target, statics), statics, alone=True)
        self.filter = filter
        self.statics = self.names
        self.names = (*self.statics, *filter.trellis.names)
        self.match += f", likelihood by {filter.particles} particles"

    def words(self, name: str) -> tuple[str, str]:
        if name in self.statics:
            return self.label, self.match
        return "particle filter", "drawn with the static nodes"

    def start(self, values: Values, chains: int) -> Memory:
        u, log = self._placed(values)
        return {
            "steps": self.steps.start(u[:, None]),
            "u": u,
            "log": log,
            "log_likelihood": None,
            "error": _FIRST_ERROR,
            "looks": np.zeros(0),
            "sweep": 0,
            "accepted": np.zeros(chains),
            "moves": 0,
        }

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        now = {n: values[n] for n in self.names}
        if memory["log_likelihood"] is None:
            found, likelihood = self._estimated(values, rng)
            now = {**now, **found}
            memory = {**memory, "log_likelihood": likelihood}
        u, log, likelihood = memory["u"], memory["log"], memory["log_likelihood"]
        tried = u + self.steps.draw(memory["steps"], rng)[:, 0]
        moved, grown = self._evaluated({**values, **now}, tried)
        state = {**values, **moved}
        self.block.target.refresh(state, self.statics)
        found, estimate = self._estimated(state, rng)
        log_ratio = (grown - log) + (estimate - likelihood)
        accept = accepted(log_ratio, rng)
        new = {n: instead(~accept, v, now[n]) for n, v in {**moved, **found}.items()}
        memory = {
            **memory,
            "u": instead(~accept, tried, u),
            "log": np.where(accept, grown, log),
            "log_likelihood": np.where(accept, estimate, likelihood),
        }
        if not warmup:
            return new, counted(memory, accept)
        return new, self._adapted({**values, **new}, memory, chance(log_ratio), rng)

    # ---- private -------------------------------------------------------------------------------

    def _estimated(self, values: Values, rng: np.random.Generator) -> tuple[Values, np.ndarray]:
        """A trajectory given the static nodes, and the log of an estimate of their likelihood."""
        history = self.filter.run(values, len(values[self.statics[0]]), rng)
        return self.filter.drawn(history, rng), history.log_likelihood

    def _adapted(
        self, values: Values, memory: Memory, rates: np.ndarray, rng: np.random.Generator
    ) -> Memory:
        """What the warmup learns: steps, and the error of the estimate."""
        sweep = memory["sweep"] + 1
        memory = {**memory, "sweep": sweep}
        share = max(float(scipy.special.erfc(memory["error"] / 2.0)), _LEAST)
        rates = np.minimum(rates / share, 1.0)[:, None]
        steps = self.steps.learnt(memory["steps"], memory["u"][:, None], rates)
        memory["steps"] = steps
        if sweep % _EVERY:
            return memory
        self.block.target.refresh(values, self.statics)
        once, twice = (self._estimated(values, rng)[1] for _ in range(2))
        with np.errstate(invalid="ignore"):
            apart = np.abs(once - twice)
        looks = np.concatenate([memory["looks"], apart[~np.isnan(apart)]])[-_KEPT:]
        error = float(np.median(looks)) / _MEDIAN if len(looks) else memory["error"]
        return {**memory, "error": error, "looks": looks}


def prior_of(target: Target, statics: tuple[str, ...]) -> Target:
    """The static nodes by themselves: their own densities, and what is computed from them."""
    inside = set(statics)
    terms = {n: target.terms[n] for n in target.chain if n in inside}
    reached, links = set(statics), []
    for link in target.links:
        parents = {p for p in target.model[link].parents if not target.is_known(p)}
        if parents and parents <= reached:
            reached.add(link)
            links.append(link)
    return replace(target, chain=tuple(terms), links=tuple(links), terms=terms, _below={})
