"""Exact answers: hidden nodes that are finite, or linear-Gaussian given the finite ones, are eliminated.

The plan is made elsewhere; here stand the options, the refusals and what is wrong with impossible evidence.
The cost is known, and refused if too high, before any large table exists.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.engines.base import Engine
from bayesmc.engines.exact.exact_posterior import ExactPosterior
from bayesmc.engines.exact.hybrid_plan import Cost, Plan, plan_for, why_no_plan
from bayesmc.errors import (
    BudgetError,
    ModelError,
    ParameterError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.factors import Calibrated
from bayesmc.network import Model, Problem
from bayesmc.results import Posterior
from bayesmc.structure import InvalidRows, Variable


@dataclass(frozen=True)
class Exact(Engine):
    """Variable elimination in both directions: all marginals and the evidence's probability at once.

    It takes nets whose hidden nodes have finitely many values, and conditional linear-Gaussian ones: hidden
    continuous nodes that are Normal or MvNormal with a mean affine in other continuous nodes, where finite
    nodes may switch coefficients and scales. Observed continuous nodes may be of any family and enter any
    function, as long as what they depend on is finite or linear-Gaussian. Continuous nodes are integrated
    out first, one at a time, then finite ones are summed out, in orders that are searched for: the order
    matters more than the arithmetic.

    Parameters
    ----------
    max_bytes : float
        Memory above which it refuses, with the figure, before allocating.

    References
    ----------
    Lauritzen and Spiegelhalter (1988); Koller and Friedman (2009), ch. 9, 10 and 14.2; Lauritzen (1992).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.5))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> posterior = bmc.infer(net, {"x": 2.0}, engine=bmc.Exact())
    >>> float(posterior.mean("a").round(4))
    0.8808
    >>> float(bmc.infer(net, {"a": 1}, engine=bmc.Exact()).mean("x"))
    2.0
    """

    max_bytes: float = 2.0 * 2**30

    def __post_init__(self) -> None:
        if not (isinstance(self.max_bytes, (int, float)) and self.max_bytes > 0):
            raise ValueError(
                f"Exact(max_bytes={self.max_bytes!r}): give a positive number of bytes"
            )

    def refusal(self, problem: Problem) -> str | None:
        error = self._why_not(problem)
        return None if error is None else str(error)

    def cost(self, problem: Problem) -> Cost:
        """Bytes and the figures behind them, known before any large table exists."""
        return plan_for(problem).cost

    def describe(self, problem: Problem) -> dict[str, str]:
        return {name: _treatment(problem, name) for name in problem.model.nodes}

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> Posterior:
        if resume is not None:
            raise UnsupportedError(
                "infer: resume= continues sampling; an exact answer has nothing to resume"
            )
        error = self._why_not(problem)
        if error is not None:
            raise error
        plan = plan_for(problem)
        states = _states(problem)
        solved = plan.solve(problem, states)
        if solved.calibrated.log_z == -np.inf:
            raise ZeroProbabilityError(_impossible(plan, problem, states))
        _refuse_invalid(problem.model, solved.invalid, solved.calibrated)
        return ExactPosterior(problem, self, solved)

    def _why_not(self, problem: Problem) -> UnsupportedError | None:
        others = _others(problem.model)
        reason = why_no_plan(problem)
        if reason is not None:
            return UnsupportedError(
                "Exact needs every hidden node to have finitely many values or to be linear-Gaussian given "
                f"those, but {reason}; use {others}"
            )
        try:
            cost = plan_for(problem).cost
        except BudgetError as error:
            return BudgetError(f"Exact: {error}; use {others}", error.bytes)
        except UnsupportedError as error:
            return UnsupportedError(f"Exact: {error}; use {others}")
        except ModelError as error:
            return UnsupportedError(
                f"Exact evaluates functions on all configurations of their parents, also impossible ones, "
                f"and one of them fails there: {error}; use {others}"
            )
        if cost.bytes > self.max_bytes:
            return BudgetError(
                f"Exact would need about {readable_bytes(cost.bytes)} ({cost.words}), above "
                f"max_bytes={readable_bytes(self.max_bytes)}; use {others}, or raise Exact(max_bytes=)",
                int(min(cost.bytes, 2**62)),
            )
        return None


def _others(model: Model) -> str:
    """What to name where this engine refuses."""
    if any(node.declaration.source == "variable" for node in model.nodes.values()):
        return "Gibbs(draws) or MetropolisHastings(draws)"
    return "LikelihoodWeighting(draws) or Importance(draws, proposal=...)"


def _states(problem: Problem) -> dict[Variable, int]:
    """Positions of the observed elements of finite nodes."""
    states: dict[Variable, int] = {}
    for name, seen in problem.observed.items():
        node = problem.model[name]
        if node.domain is None:
            continue
        values = seen.value.ravel().tolist()
        mask = None if seen.mask is None else seen.mask.ravel()
        for element, value in enumerate(values):
            if mask is None or mask[element]:
                states[(name, element)] = value
    return states


def _impossible(plan: Plan, problem: Problem, states: Mapping[Variable, int]) -> str:
    """Say which piece of evidence first makes the rest impossible."""
    entered: dict[Variable, int] = {}
    if plan.solve(problem, {}).calibrated.log_z == -np.inf:
        return "the evidence has probability zero: no configuration of the hidden nodes explains it"
    for variable, state in states.items():
        entered[variable] = state
        if plan.solve(problem, entered).calibrated.log_z == -np.inf:
            before = ", ".join(
                f"{_name(problem, v)}={_label(problem, v, s)!r}"
                for v, s in list(entered.items())[:-1]
            )
            return (
                f"the evidence has probability zero: {_name(problem, variable)}="
                f"{_label(problem, variable, state)!r} is impossible"
                + (f" given {before}" if before else "")
                + "; check the evidence, or give the tables a small positive entry"
            )
    return "the evidence has probability zero"


def _refuse_invalid(model: Model, invalid: Sequence[InvalidRows], calibrated: Calibrated) -> None:
    """Bad parameters at configurations that turn out to be possible are the user's to hear of."""
    for name, element, scope, mask in invalid:
        possible = calibrated.joint(scope) > 0 if scope else np.asarray(True)
        bad = mask & possible
        if bad.any():
            at = tuple(int(i) for i in np.argwhere(bad)[0])
            config = ", ".join(
                f"{v[0]}={model[v[0]].domain.states[i]!r}"  # type: ignore[union-attr]
                for v, i in zip(scope, at, strict=True)
            )
            where = f" (plate element {element})" if model[name].plates else ""
            raise ParameterError(
                f"node {name!r}{where}: the function gives bad parameters at {config}, which is possible",
                at,
            )


def _name(problem: Problem, variable: Variable) -> str:
    name, element = variable
    node = problem.model[name]
    if not node.plates:
        return name
    at = np.unravel_index(element, node.plate_shape)
    return f"{name}[{', '.join(str(int(i)) for i in at)}]"


def _label(problem: Problem, variable: Variable, state: int) -> Any:
    domain = problem.model[variable[0]].domain
    assert domain is not None
    return domain.states[state]


def _treatment(problem: Problem, name: str) -> str:
    node = problem.model[name]
    if node.kind in ("input", "fixed"):
        return "given"
    seen = problem.observed.get(name)
    if seen is not None:
        return (
            "observed: a likelihood factor"
            if node.domain is None
            else "observed: its axis is sliced"
        )
    if not node.is_stochastic and node.domain is None:
        return "computed: follows the nodes above it"
    return "eliminated" if node.domain is not None else "integrated out: linear-Gaussian"


def readable_bytes(count: float) -> str:
    """A number of bytes in words, such as ``4.8 GiB``."""
    for unit, scale in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}" if count < 1e6 * 2**40 else f"{count:.3g} bytes"
    return f"{count:.0f} bytes"
