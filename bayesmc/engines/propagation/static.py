"""What expectation propagation and its one pass share on nets: refusals, what ``explain`` says, runs."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.approximate.posterior import ApproximatePosterior
from bayesmc.engines.base import Engine
from bayesmc.engines.propagation.approximation import Messages
from bayesmc.engines.propagation.sweeps import Settled
from bayesmc.engines.propagation.system import System, system_of
from bayesmc.errors import (
    BayesmcError,
    ConvergenceWarning,
    UnsupportedError,
    ZeroProbabilityError,
    did_you_mean,
)
from bayesmc.network import Problem
from bayesmc.results import Posterior

#: an error of quadrature above this is told
_ROUGH = 1e-3


class PropagatedPosterior(ApproximatePosterior):
    """Beliefs where messages ended: answers of ``ApproximatePosterior``, and how they were come by.

    Attributes
    ----------
    converged : bool
        Whether the last sweep changed no marginal by more than ``tolerance``, and left no message out.
    change : float
        What the last sweep changed, of the scalar that it changed most: the root of a symmetric
        Kullback-Leibler divergence, of numbers about in standard deviations.
    sweeps : int
    skipped : int
        Improper messages that were left out, in all sweeps.
    quadrature_error : float
        By how much coarser rules differ where moments have no closed form, the worst: in logs and standard
        deviations.
    log_marginal_likelihood : float
        Approximate, unless nothing had to be approximated; NaN where a factor has no integral with its
        cavity. Of ``AssumedDensity``, too, that of the messages where they ended (Minka 2004).
    log_as_met : float or None
        Of ``AssumedDensity``: the product of what it predicted of every factor before it took it in, in logs.
    """

    converged: bool
    change: float
    sweeps: int
    skipped: int
    quadrature_error: float
    log_as_met: float | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        engine: Any,
        system: System,
        end: Settled,
        seed: np.random.SeedSequence,
    ) -> PropagatedPosterior:
        found = cls(problem, engine, Messages(system), seed, float(end.log_total))
        found.converged, found.change, found.sweeps = end.converged, end.change, end.sweeps
        found.skipped, found.quadrature_error = end.skipped, end.error
        found.log_as_met = end.log_as_met
        return found


class MessageEngine(Engine):
    """Base of ``ExpectationPropagation`` and ``AssumedDensity`` on nets; a family supplies ``passed``."""

    label: ClassVar[str] = "expectation propagation"
    families: Mapping[str, str] | None

    def passed(self, system: System, progress: bool | None) -> Settled:
        """Pass messages."""
        raise NotImplementedError

    def doubt(self, end: Settled) -> str | None:
        """What is said where messages have not settled."""
        raise NotImplementedError

    def refusal(self, problem: Problem) -> str | None:
        try:
            _system(problem, self)
        except ZeroProbabilityError:
            return None
        except BayesmcError as error:
            return self._named(error)
        return None

    def describe(self, problem: Problem) -> dict[str, str]:
        system = _system(problem, self)
        return {name: _treated(problem, system, name) for name in problem.model.nodes}

    def effort(self, problem: Problem) -> str:
        """What ``explain`` adds: what is approximated, and that nobody knows by how much."""
        system = _system(problem, self)
        tables = sum(b.count for b in system.batches if b.kernel.how == "table")
        kinds = Counter[str]()
        for batch in system.batches:
            if batch.kernel.how != "table":
                kinds[batch.kernel.how] += batch.count
        parts = [f"{n} by {how}" for how, n in kinds.items()]
        if tables:
            kind = (
                "loopy belief propagation" if system.loops else "belief propagation on trees, exact"
            )
            parts.append(f"{tables} tables ({kind})")
        told = (
            ", ".join(parts)
            if parts
            else "nothing: all is linear-Gaussian, and the answer is exact"
        )
        if system.is_exact:
            return f"factors: {told}"
        return (
            f"factors approximated: {told}; messages are passed until they agree, and the bias of the "
            "answer, the log marginal likelihood included, is not known: posterior.check() tells"
        )

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> PropagatedPosterior:
        name = type(self).__name__
        if resume is not None:
            raise UnsupportedError(f"{name}: there is nothing to go on with; give more sweeps")
        try:
            system = _system(problem, self, again=True)
            with marking_invalid(), np.errstate(all="ignore"):
                end = self.passed(system, progress)
        except BayesmcError as error:
            error.args = (self._named(error), *error.args[1:])
            raise
        doubt = self.doubt(end)
        if doubt is not None:
            warnings.warn(doubt, ConvergenceWarning, stacklevel=3)
        if end.error > _ROUGH:
            warnings.warn(
                f"{name}: moments of some factors are rough: coarser rules differ by {end.error:.2g} (logs "
                "and standard deviations); hold the answer against posterior.check() or Gibbs",
                ConvergenceWarning,
                stacklevel=3,
            )
        return PropagatedPosterior.of(problem, self, system, end, seed)

    def _named(self, error: BayesmcError) -> str:
        """What an error says, by the name of this engine: parts that two of them share say the other's."""
        name = type(self).__name__
        text = str(error).removeprefix("ExpectationPropagation: ").removeprefix(f"{name}: ")
        return f"{name}: {text}"


def check_families(engine: Any) -> None:
    """Refuse families that there are not."""
    name, families = type(engine).__name__, engine.families
    if families is None:
        return
    if not isinstance(families, Mapping):
        raise ValueError(f"{name}(families={families!r}): give a dict from node to family")
    for node, family in families.items():
        if family != "normal":
            raise ValueError(
                f'{name}(families={{{node!r}: {family!r}}}): there is "normal", which maps the node to the '
                "line; its own family it keeps by itself where that can be"
            )


# ---- private ------------------------------------------------------------------------------------


def _system(problem: Problem, engine: MessageEngine, again: bool = False) -> System:
    """The system of a problem, as it was asked about before; a run takes it along."""
    mapped = frozenset(engine.families or ())
    who = type(engine).__name__
    kept: dict[Any, System] = problem.cache.setdefault("systems of messages", {})
    found = kept.pop(mapped, None)
    if found is None:
        for name in sorted(mapped):
            node = problem.model.nodes.get(name)
            if (
                node is None
                or not node.is_stochastic
                or node.domain is not None
                or node.is_discrete
            ):
                hint = did_you_mean(name, problem.model.nodes)
                raise UnsupportedError(
                    f"{who}: families= names {name!r}, which is no continuous node{hint}"
                )
        with marking_invalid(), np.errstate(all="ignore"):
            found = system_of(problem, who, mapped)
    if not again:
        kept[mapped] = found
    return found


def _treated(problem: Problem, system: System, name: str) -> str:
    model, node = problem.model, problem.model[name]
    seen = problem.observed.get(name)
    how = dict.fromkeys(b.kernel.how for b in system.batches if b.name == name)
    own = ", ".join(how)
    if seen is not None and seen.mask is None:
        if own:
            return f"observed: {own}"
        return "observed: linear-Gaussian, exact" if name in system.exact else "observed"
    if name in system.numbers:
        x = system.numbers[name]
        kind = "jointly Gaussian" if x.is_plain else "jointly Gaussian after a map to the line"
        prior = f"prior by {own}" if own else "linear-Gaussian prior, exact"
        if x.is_score:
            kind, prior = "jointly Gaussian in normal scores", "prior exact"
        return f"{kind}; {prior}"
    if name in system.kept:
        family = system.beliefs.families[system.kept[name].field].family
        return f"{family.words}; prior exact"
    if name in system.target.chain:
        return f"probabilities of its states; {own or 'no factor of its own'}"
    if node.kind == "deterministic":
        return "computed"
    if node.is_stochastic and node.declaration.value is None and model[name].kind != "input":
        return "drawn from the net afterwards: nothing observed depends on it"
    return "known"
