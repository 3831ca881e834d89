"""Exact answers on nets whose hidden nodes are finite: a clique tree along a good elimination order.

The plan (variables, tables, tree) belongs to the net and is kept with its compiled model; evidence only
enters it. The cost is known, and refused if too high, before any large table exists.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.base import Engine
from bayesmc.engines.exact_posterior import ExactPosterior
from bayesmc.errors import (
    BudgetError,
    ModelError,
    ParameterError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.factors import BoundTree, Calibrated, CliqueTree
from bayesmc.network import Model, Problem
from bayesmc.results import Posterior
from bayesmc.structure import (
    DiscreteNet,
    InvalidRows,
    Variable,
    discrete_net,
    why_not_discrete,
)


@dataclass(frozen=True)
class Exact(Engine):
    """Variable elimination in both directions: all marginals and the evidence's probability at once.

    It takes nets whose hidden nodes have finitely many values; continuous nodes may be observed.
    Elimination orders are searched for (min-fill and others), because the order matters more than
    the arithmetic.

    Parameters
    ----------
    max_bytes : float
        Memory above which it refuses, with the figure, before allocating.

    References
    ----------
    Lauritzen and Spiegelhalter (1988); Koller and Friedman (2009), ch. 9 and 10.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.5))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> posterior = bmc.infer(net, {"x": 2.0}, engine=bmc.Exact())
    >>> float(posterior.mean("a").round(4))
    0.8808
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

    def cost(self, problem: Problem) -> Any:
        """Induced width, largest table and bytes, known before any large table exists."""
        return _prepared(problem).tree.cost

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
        prepared = _prepared(problem)
        states = _states(problem)
        bound, invalid = prepared.bound(problem)
        calibrated = bound.calibrate(states)
        if calibrated.log_z == -np.inf:
            raise ZeroProbabilityError(_impossible(prepared, problem, states))
        _refuse_invalid(problem.model, invalid, calibrated)
        return ExactPosterior(problem, self, prepared.net, calibrated)

    def _why_not(self, problem: Problem) -> UnsupportedError | None:
        reason = why_not_discrete(problem.model, problem.observed)
        if reason is not None:
            return UnsupportedError(
                f"Exact needs every hidden node to have finitely many values, but {reason}; use "
                "LikelihoodWeighting(draws)"
            )
        try:
            cost = _prepared(problem).tree.cost
        except BudgetError as error:
            return BudgetError(f"Exact: {error}; use LikelihoodWeighting(draws)", error.bytes)
        except ModelError as error:
            return UnsupportedError(
                f"Exact evaluates functions on all configurations of their parents, also impossible ones, "
                f"and one of them fails there: {error}; use LikelihoodWeighting(draws)"
            )
        if cost.bytes > self.max_bytes:
            return BudgetError(
                f"Exact would need about {readable_bytes(cost.bytes)} (induced width "
                f"{cost.induced_width}, largest table {cost.largest_entries:.3g} entries), above "
                f"max_bytes={readable_bytes(self.max_bytes)}; use LikelihoodWeighting(draws), or raise "
                "Exact(max_bytes=)",
                int(cost.bytes),
            )
        return None


class _Prepared:
    """The plan of one net: its variables, factors and clique tree."""

    def __init__(self, problem: Problem) -> None:
        self.net: DiscreteNet = discrete_net(problem.model, problem.observed, problem.inputs)
        self.tree = CliqueTree(self.net.cards, self.net.scopes)
        self._static: BoundTree | None = None

    def bound(self, problem: Problem) -> tuple[BoundTree, list[InvalidRows]]:
        """The tree with its tables (kept between calls when none depends on the evidence), and the
        configurations with bad parameters."""
        if self._static is not None:
            return self._static, self.net.invalid
        with marking_invalid(), np.errstate(all="ignore"):
            extra, invalid = self.net.evidence_factors(problem.observed)
        bound = self.tree.bind([*self.net.static, *extra])
        if not self.net.evidence_sources:
            self._static = bound
        return bound, self.net.invalid + invalid


def _prepared(problem: Problem) -> _Prepared:
    """The plan, kept as long as the compiled model lives; inputs are part of a model's identity."""
    plans: dict[Any, _Prepared] = problem.model.cache.setdefault("exact plans", {})
    key = (
        tuple(sorted((n, v.tobytes()) for n, v in problem.inputs.items())),
        frozenset(n for n in problem.observed if problem.model[n].domain is None),
    )
    if key not in plans:
        if len(plans) > 8:
            plans.clear()
        plans[key] = _Prepared(problem)
    return plans[key]


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


def _impossible(prepared: _Prepared, problem: Problem, states: Mapping[Variable, int]) -> str:
    """Say which piece of evidence first makes the rest impossible."""
    bound, _ = prepared.bound(problem)
    entered: dict[Variable, int] = {}
    if bound.calibrate({}).log_z == -np.inf:
        return "the evidence has probability zero: no configuration of the hidden nodes explains it"
    for variable, state in states.items():
        entered[variable] = state
        if bound.calibrate(entered).log_z == -np.inf:
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
        return "passed through to the finite nodes above it"
    return "eliminated"


def readable_bytes(count: float) -> str:
    """A number of bytes in words, such as ``4.8 GiB``."""
    for unit, scale in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}" if count < 1e6 * 2**40 else f"{count:.3g} bytes"
    return f"{count:.0f} bytes"
