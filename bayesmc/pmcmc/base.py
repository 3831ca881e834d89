"""What the engines of this room share: they want the template, and a filter that can run on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.unrolled import pose_any, series_of
from bayesmc.engines.weighted.drawing import check_count
from bayesmc.errors import BayesmcError
from bayesmc.network import Problem
from bayesmc.network.forward import refuse_noiseless, refuse_parts, refuse_unsampled
from bayesmc.pmcmc.trellis import Trellis
from bayesmc.structure.target import Target, target_of


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
