"""What the engines of this room share: they want the template, and a filter that can run on it.

Chains start with static nodes as elsewhere, and with trajectories that a filter has drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.engines.mcmc.sweep import SweepSampler
from bayesmc.engines.unrolled import pose_any, series_of
from bayesmc.engines.weighted.drawing import check_count
from bayesmc.errors import BayesmcError, ZeroProbabilityError
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.densities import instead
from bayesmc.network import Problem
from bayesmc.network.forward import refuse_noiseless, refuse_parts, refuse_unsampled
from bayesmc.pmcmc.filters import Filter
from bayesmc.pmcmc.trellis import Trellis
from bayesmc.pmcmc.walk import PARTICLES, ParameterWalk, prior_of
from bayesmc.structure.target import Target, Values, target_of

#: draws of the static nodes from their prior before giving up
_ATTEMPTS = 50


@dataclass(frozen=True, eq=False)
class Question:
    """A question over time, read for particles.

    Attributes
    ----------
    statics : tuple of str
        Static nodes of the chain.
    """

    target: Target
    trellis: Trellis
    statics: tuple[str, ...]


class ParticleEngine(ChainEngine):
    """Chains on an unrolled template, some of whose nodes are drawn by particle filters.

    Attributes
    ----------
    particles : int or None
    """

    particles: int | None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.particles is not None:
            check_count(self, "particles", self.particles, "100")

    def unsupported(
        self,
        net: Any,
        evidence: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Any] | None = None,
    ) -> str | None:
        problem = pose_any(net, evidence, inputs)
        try:
            return self.refusal(problem)
        except BayesmcError as error:
            return str(error)

    def refusal(self, problem: Problem) -> str | None:
        name = type(self).__name__
        parts = refuse_parts(problem.observed, name)
        if parts is not None:
            return parts
        if series_of(problem) is None:
            return (
                f"{name} runs particle filters on a template, and this is a plain net; give the template: "
                f"infer(dbn, observations, engine={name}()) with a DynamicBayesNet, or use Gibbs() here"
            )
        question = self._question(problem)
        if not question.target.chain:
            return (
                f"{name}: no observation depends on anything hidden, so that there is nothing to learn; "
                "LikelihoodWeighting(draws) draws from what is left"
            )
        given = {*problem.observed, *question.statics}
        evaluated = (n for n in question.target.terms if n in problem.model.nodes)
        return refuse_unsampled(problem.model, given, name) or refuse_noiseless(
            problem.model, evaluated, name
        )

    def effort(self, problem: Problem) -> str:
        """How many chains it would run, how long, and what its filters take: particles moved, in words."""
        lengths = self.lengths(problem)
        slices = len(self._question(problem).trellis.slices)
        sweeps = lengths.warmup + lengths.draws * self.thinning
        few, many = PARTICLES if self.particles is None else (self.particles, self.particles)
        moved = slices * lengths.chains * sweeps
        each = f"{few}" if few == many else f"{few} to {many}"
        total = f"{few * moved:.1e}" if few == many else f"{few * moved:.1e} to {many * moved:.1e}"
        return (
            f"{super().effort(problem)}; each sweep filters {slices} slices by {each} particles in every "
            f"chain: {total} particles moved in all"
        )

    def _question(self, problem: Problem) -> Question:
        """The question, read once."""
        found = problem.cache.get("particles")
        if found is None:
            series = series_of(problem)
            assert series is not None
            target = target_of(problem)
            trellis = Trellis(target, series)
            statics = tuple(n for n in target.chain if n in trellis.static)
            found = problem.cache["particles"] = Question(target, trellis, statics)
        return found


class ParticleSampler(SweepSampler):
    """Sweeps whose first trajectories are drawn by a filter, which sees what forward draws do not.

    Parameters
    ----------
    target : Target
    kernels : sequence of Kernel
    filter : Filter
    """

    def __init__(self, target: Target, kernels: Sequence[Kernel], filter: Filter) -> None:
        super().__init__(target, kernels)
        self.filter = filter
        walks = [k for k in self.kernels if isinstance(k, ParameterWalk)]
        self.walk = walks[0] if walks else None
        #: rates are low where estimates are noisy, which is warned of by itself
        self.acceptance_band = {", ".join(walk.statics): (0.02, 0.9) for walk in walks}

    def acceptance(self, state: Mapping[str, Any]) -> dict[str, np.ndarray]:
        found = {}
        for kernel, memory in zip(self.kernels, state["memory"], strict=True):
            rate = kernel.acceptance(memory)
            if rate is not None:
                names = kernel.statics if isinstance(kernel, ParameterWalk) else kernel.names
                found[", ".join(names)] = rate
        return found

    def _started(self, rng: np.random.Generator, chains: int, rows: int) -> dict[str, Any]:
        values = self._begun(rng, rows)
        particles = None if self.walk is None else self._located(values, rng, rows)
        self.target.refresh(values, self.target.chain)
        inside = {n: values[n] for n in (*self.target.chain, *self.target.links)}
        memory = [kernel.start(values, rows) for kernel in self.kernels]
        if particles is not None:
            memory = [{**m, "particles": particles} for m in memory]
        return {"values": inside, "memory": memory, "chains": chains}

    def _located(self, values: Values, rng: np.random.Generator, rows: int) -> int | None:
        """Put static nodes near the mass of their posterior; how many particles they need there."""
        assert self.walk is not None
        found = self.walk.located(values, rows, rng)
        if found is None:
            return None
        moved = {n: v for n, v in found[0].items() if n not in self.given}  # the user's start stays
        particles = found[1]
        state = {**values, **moved}
        self.target.refresh(state, self.walk.statics)
        history = self.filter.run(state, rows, rng)
        good = np.isfinite(history.log_likelihood)
        for name, value in {**moved, **self.filter.drawn(history, rng)}.items():
            values[name] = instead(~good, value, values[name])
        return particles

    def _begun(self, rng: np.random.Generator, rows: int) -> Values:
        """Static nodes and trajectories of positive density."""
        try:
            values = start_states(self.target, rows, rng, self.given_rows(rows), search=False)
        except ZeroProbabilityError as error:
            return self._searched(rng, rows, error)
        if not self.filter.trellis.names:
            return values
        history = self.filter.run(values, rows, rng)
        failed = ~np.isfinite(history.log_likelihood)
        for name, value in self.filter.drawn(history, rng).items():
            values[name] = instead(failed, value, values[name])
        return values

    def _searched(self, rng: np.random.Generator, rows: int, error: ZeroProbabilityError) -> Values:
        """Static nodes from their prior, until a filter finds a trajectory for some chain."""
        inside = {*self.filter.trellis.names}
        statics = tuple(n for n in self.target.chain if n not in inside)
        prior = prior_of(self.target, statics)
        for _ in range(_ATTEMPTS):
            given = self.given_rows(rows)
            values = start_states(prior, rows, rng, given) if statics else dict(self.target.known)
            history = self.filter.run(values, rows, rng)
            good = np.flatnonzero(np.isfinite(history.log_likelihood))
            if not len(good):
                continue
            values.update(self.filter.drawn(history, rng))
            chosen = np.arange(rows)
            failed = ~np.isfinite(history.log_likelihood)
            chosen[failed] = rng.choice(good, int(failed.sum()))
            moved = {n: values[n][chosen] for n in (*self.target.chain, *prior.links)}
            return {**self.target.known, **moved}
        raise error
