"""Where chains stand, and by what it is told whether a question is the one that they were asked.

A function may say something else by the time that it is called again: what it said is held as densities.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.distributions import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model, Observed, Problem


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Where chains stand after their last kept draw, to go on from.

    Attributes
    ----------
    state : dict
        The sampler's state.
    generator : dict
        State of the bit generator.
    values : dict
        Stored values of the last draw.
    observed : dict
        The evidence, as stored.
    densities : dict or None
        Node or potential -> its log density at ``values`` (a deterministic node's sum) when the draws
        were made, so that a function that says something else by now is noticed.
    """

    state: Mapping[str, Any]
    generator: Mapping[str, Any]
    values: Mapping[str, np.ndarray]
    observed: Mapping[str, Observed]
    densities: Mapping[str, float] | None = None

    def noted(self, problem: Problem) -> Checkpoint:
        """The same with its densities under a problem, if they are not known."""
        if self.densities is not None:
            return self
        return replace(self, densities=noted_densities(problem, self.values))

    def fits(self, model: Model, problem: Problem) -> bool:
        """Whether it belongs to this question, though the functions of its ``model`` are lost."""
        if list(model.nodes) != list(problem.model.nodes) or model.sizes != problem.model.sizes:
            return False
        if any(outline(node) != outline(problem.model[n]) for n, node in model.nodes.items()):
            return False
        seen = problem.observed
        if self.observed.keys() != seen.keys() or not all(
            np.array_equal(o.value, seen[n].value) and np.array_equal(o.mask, seen[n].mask)  # type: ignore[arg-type]
            for n, o in self.observed.items()
        ):
            return False
        return (
            self.densities is not None
            and other_density(problem, self.values, self.densities) is None
        )


def outline(node: CompiledNode) -> tuple[Any, ...]:
    """What can be compared of a node whose function is lost."""
    arrays = (node.declaration.probs, node.declaration.value)
    tables = tuple(None if a is None else (a.shape, a.tobytes()) for a in arrays)
    states = None if node.domain is None else node.domain.states
    return (node.kind, node.parents, node.plates, node.value_shape, states, *tables)


def log_densities(problem: Problem, values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Log density of every node and potential at some draws, summed; a deterministic node's values."""
    model = problem.model
    at = {**problem.inputs, **values}
    found = {name: float(np.sum(value)) for name, value in problem.inputs.items()}
    with marking_invalid(), np.errstate(all="ignore"):
        for name, node in model.nodes.items():
            if node.is_stochastic and node.declaration.source in ("function", "table"):
                given, _ = model.evaluate(name, at)
                found[name] = float(np.sum(model.log_density(name, given, at[name])))
            elif node.kind == "deterministic":
                found[name] = float(np.sum(model.evaluate(name, at)[0], dtype=float))
        for name in model.potentials:
            found[f"potential {name}"] = float(np.sum(model.potential(name, at)))
    return found


def noted_densities(problem: Problem, values: Mapping[str, np.ndarray]) -> dict[str, float] | None:
    """``log_densities``, to be held against later; None where a draw has none, at a pole for one."""
    try:
        return log_densities(problem, values)
    except BayesmcError:
        return None


def other_density(
    problem: Problem, values: Mapping[str, np.ndarray], densities: Mapping[str, float]
) -> str | None:
    """The first node or potential whose log density at some draws is another than was noted."""
    now = noted_densities(problem, values) or {}
    for name in dict.fromkeys([*densities, *now]):
        if name not in now or name not in densities:
            return name
        a, b = densities[name], now[name]
        if not (a == b or (a != a and b != b) or math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9)):
            return name
    return None
