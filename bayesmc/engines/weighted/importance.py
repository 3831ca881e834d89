"""Importance sampling: draw from proposals that look at the evidence, and weigh by p/q."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from bayesmc.engines.forward import fast_steps
from bayesmc.engines.proposal import (
    FUNCTION,
    as_function,
    bound,
    check_specification,
    check_targets,
)
from bayesmc.engines.proposing import proposal_steps
from bayesmc.engines.weighted.drawing import WeightedEngine, check_count, treatment
from bayesmc.errors import ModelError, UnsupportedError
from bayesmc.kernels.proposal import Key, Proposal, names_of
from bayesmc.network import Problem
from bayesmc.network.forward import Step, refuse_noiseless, refuse_parts, refuse_unsampled, whole
from bayesmc.network.sameness import same


@dataclass(frozen=True, repr=False)
class Importance(WeightedEngine):
    """Draw hidden nodes from proposals, or from the net where there is none, and weigh the draws.

    The weight of a draw is the density of the evidence times p/q of every proposed node: its density in
    the net over that of its proposal. Without proposals this is likelihood weighting, draw for draw.

    Parameters
    ----------
    draws : int
    proposal : dict
        Node name -> a function whose argument names are evidence, inputs or nodes drawn before, and which
        returns the distribution to draw the node from; or a distribution. Arguments arrive as they would
        at the target (its plates). A tuple of names is a block drawn jointly: its function, which sees
        plated nodes as foreign, returns a dict from name to distribution, or one vector distribution
        whose components go to the names in order (plates, then events, each in C order).

    Raises
    ------
    TypeError, ModelError
        Proposals that cannot be any, whatever the net. What does not fit the net or the evidence raises
        when asked, with the proposal's name.

    Notes
    -----
    The proposal must be able to draw whatever the posterior allows: a region it never visits is missing
    from every answer, and neither ``weight_ess`` nor ``pareto_k`` can tell. Where supports tell, there is a
    ``SupportWarning``. Heavier tails than the
    target's are safe, lighter ones show as a large ``pareto_k``. A partly observed node has its missing
    elements proposed, the others weigh by p. A finite node's proposal speaks the values of its support
    (0, 1, ... for a Categorical), as its conditional density does.

    References
    ----------
    Koller and Friedman (2009), sec. 12.2.2; Owen (2013), Monte Carlo Theory, Methods and Examples, ch. 9.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 0.1))
    >>> engine = bmc.Importance(20_000, proposal={"x": lambda y: bmc.StudentT(5.0, y, 0.15)})
    >>> posterior = bmc.infer(net, {"y": 2.0}, engine=engine, rng=0)
    >>> bool(abs(posterior.mean("x") - 2.0 / 1.01) < 0.005), bool(posterior.weight_ess > 10_000)
    (True, True)
    """

    draws: int = 10_000
    proposal: Mapping[Any, Any] = field(default_factory=dict, hash=False)

    label: ClassVar[str] = "importance sampling"
    remedy: ClassVar[str] = (
        "use more draws, proposals nearer the posterior with tails as heavy, or Exact() where "
        "explain(net, evidence) says it can"
    )

    def __post_init__(self) -> None:
        check_count(self, "draws", self.draws, "100_000")
        checked = MappingProxyType(_check_given(self.proposal))
        object.__setattr__(self, "proposal", checked)

    def refusal(self, problem: Problem) -> str | None:
        parts = refuse_parts(problem.observed, "Importance")
        if parts is not None:
            return parts
        self.steps(problem)  # raises where a proposal does not fit the net or the evidence
        given = {n for key in self.proposal for n in names_of(key)}
        reason = refuse_unsampled(problem.model, given | problem.observed.keys(), "Importance")
        if reason is not None:
            return f"{reason}, or propose it"
        return refuse_noiseless(problem.model, {*given, *whole(problem.observed)}, "Importance")

    def describe(self, problem: Problem) -> dict[str, str]:
        found = {name: treatment(problem, name) for name in problem.model.nodes}
        for proposal in _read(problem, self.proposal):
            for name in proposal.names:
                others = ", ".join(repr(n) for n in proposal.names if n != name)
                how = f" jointly with {others}" if others else ""
                seen = problem.observed.get(name)
                partly = "" if seen is None else "; observed elements weigh the draws"
                found[name] = f"proposed by its function{how}, weighted p/q{partly}"
        return found

    def steps(self, problem: Problem) -> list[Step]:
        self._require_functions()
        model = problem.model
        if not self.proposal:
            return fast_steps(model, problem.observed, problem.inputs)
        bare = replace(model, potentials={})  # potentials find their places in the new order
        plain = fast_steps(bare, problem.observed, problem.inputs)
        proposals = _read(problem, self.proposal)
        by_name = dict(zip(model.nodes, plain, strict=True))
        return proposal_steps(model, problem.observed, by_name, proposals)

    def known(self, problem: Problem) -> dict[str, np.ndarray]:
        """Inputs, and what is wholly observed: proposals may look at it before its turn."""
        seen = {n: o.value for n, o in problem.observed.items() if o.mask is None}
        return {**problem.inputs, **seen}

    def is_weighted(self, problem: Problem) -> bool:
        return bool(self.proposal) or super().is_weighted(problem)

    @property
    def zero_remedy(self) -> str:
        """What to check where no draw is possible."""
        if not self.proposal:
            return super().zero_remedy
        given = ", ".join(map(repr, self.proposal))
        return f"check the evidence, and whether the proposals of {given} reach what it allows"

    def continues(self, other: Any) -> bool:
        return isinstance(other, Importance) and bool(
            same(dict(other.proposal), dict(self.proposal))
        )

    def _require_functions(self) -> None:
        if any(spec is None for spec in self.proposal.values()):
            raise UnsupportedError(
                "Importance: this engine is a pickle's or a file's, which hold no functions; give it anew"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without the proposals' functions."""
        return {"draws": self.draws, "proposal": dict.fromkeys(self.proposal)}

    def __copy__(self) -> Importance:
        return self

    def __deepcopy__(self, memo: Any) -> Importance:
        return self

    def __repr__(self) -> str:
        keys = ", ".join(f"{key!r}: ..." for key in self.proposal)
        return f"Importance(draws={self.draws}, proposal={{{keys}}})"


# ---- private ------------------------------------------------------------------------------------


def _check_given(proposal: Any) -> dict[Key, Any]:
    given = check_specification("Importance", proposal, FUNCTION)
    for key, spec in given.items():
        as_function("Importance", key, spec, FUNCTION)
    return given


def _read(problem: Problem, specification: Mapping[Key, Any]) -> list[Proposal]:
    """Proposals read against a problem; none may look at what it is to draw."""
    found = []
    for key, spec in specification.items():
        check_targets("Importance", problem, key)
        function = as_function("Importance", key, spec, FUNCTION)
        proposal = bound("Importance", problem.model, key, function)
        if not proposal.is_independent:
            own = next(p for p in proposal.parents if p in proposal.names)
            raise ModelError(
                f"{proposal.what}: it names {own!r}, which it is to draw; name evidence, inputs or nodes "
                "drawn before"
            )
        found.append(proposal)
    return found
