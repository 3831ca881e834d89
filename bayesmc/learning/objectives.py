"""What is climbed: the log evidence of the data as a function of unknown numbers, by whatever tells it.

Of a template a filter tells it; of a net its log density, finite nodes summed out, with a gradient; and where
other numbers are hidden, exact elimination.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.learning.unknowns import Unknowns
from bayesmc.network import Problem
from bayesmc.structure.free_density import UnconstrainedDensity

#: relative step of central differences
_STEP = 6e-6


class Objective(Protocol):
    """A log density to be maximised over unconstrained numbers."""

    size: int

    def value(self, u: np.ndarray) -> float:
        """At one point; minus infinity where nothing can be told."""
        ...

    def gradient(self, u: np.ndarray) -> np.ndarray:
        """Its derivatives there."""
        ...


class Evidence:
    """The log evidence as a function that is called; derivatives are central differences.

    Parameters
    ----------
    unknowns : Unknowns
    log_evidence : callable
        From values of the unknowns to the log evidence of everything else.
    with_prior : bool
        Add the log prior: its maximum is the posterior mode.
    """

    def __init__(
        self,
        unknowns: Unknowns,
        log_evidence: Callable[[Mapping[str, np.ndarray]], float],
        with_prior: bool,
    ) -> None:
        self.unknowns, self.log_evidence, self.with_prior = unknowns, log_evidence, with_prior
        self.size = unknowns.size
        #: the last refusal met at a point
        self.refused: BayesmcError | None = None

    def value(self, u: np.ndarray) -> float:
        try:
            with np.errstate(all="ignore"):
                found = self.log_evidence(self.unknowns.values(u))
                if self.with_prior:
                    found += self.unknowns.log_prior(u)
        except BayesmcError as error:
            self.refused = error
            return -np.inf
        return float(found) if np.isfinite(found) else -np.inf

    def gradient(self, u: np.ndarray) -> np.ndarray:
        return differences(self.value, u)


class Density:
    """The log density of a net with finite nodes summed out, which has a gradient of its own.

    Parameters
    ----------
    density : UnconstrainedDensity
        Without the change of volume.
    constant : float
        What no unknown changes.
    unknowns : Unknowns
        The same nodes; their log prior is taken off where it is not wanted.
    """

    def __init__(
        self, density: UnconstrainedDensity, constant: float, unknowns: Unknowns, with_prior: bool
    ) -> None:
        self.density, self.constant, self.unknowns = density, constant, unknowns
        self.with_prior, self.size = with_prior, density.size

    def value(self, u: np.ndarray) -> float:
        with np.errstate(all="ignore"):
            found = float(self.density.value(self._own(u))) + self.constant
        found = found if self.with_prior else found - self.unknowns.log_prior(u)
        return found if np.isfinite(found) else -np.inf

    def gradient(self, u: np.ndarray) -> np.ndarray:
        slope = np.empty(self.size)
        with np.errstate(all="ignore"):
            slope[self._order] = self.density.with_gradient(self._own(u))[1]
        if self.with_prior:
            return slope
        return slope - differences(self.unknowns.log_prior, u)

    def _own(self, u: np.ndarray) -> np.ndarray:
        return u[self._order]

    @property
    def _order(self) -> np.ndarray:
        """Where the density's numbers stand among the unknowns'."""
        at = {p.node.name: np.arange(p.start, p.stop) for p in self.unknowns.parts}
        return np.concatenate([at[name] for name in self.density.names])


def steps_around(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points below and above a point along each number in turn, shape ``(2 * size, size)``, and the steps."""
    steps = _STEP * np.maximum(1.0, np.abs(u))
    signs = np.stack([-np.eye(len(u)), np.eye(len(u))], axis=1).reshape(-1, len(u))
    return u + signs * steps, steps


def differences(function: Callable[[np.ndarray], float], u: np.ndarray) -> np.ndarray:
    """Central differences; one-sided where only one side can be told."""
    found = np.zeros(len(u))
    for k in range(len(u)):
        step = _STEP * max(1.0, abs(u[k]))
        at = np.array([u, u, u])
        at[0, k] -= step
        at[2, k] += step
        low, high = function(at[0]), function(at[2])
        if np.isfinite(low) and np.isfinite(high):
            found[k] = (high - low) / (2 * step)
            continue
        here = function(at[1])
        if np.isfinite(low) or np.isfinite(high):
            found[k] = (high - here) / step if np.isfinite(high) else (here - low) / step
    return found


def observed_in_part(problem: Problem, names: tuple[str, ...]) -> str | None:
    """A node that is to be learned and of which something was observed."""
    return next((name for name in names if name in problem.observed), None)


def hidden_numbers(problem: Problem, names: tuple[str, ...]) -> list[str]:
    """Continuous hidden nodes besides."""
    model: Any = problem.model
    return [
        n
        for n, node in model.nodes.items()
        if node.is_stochastic
        and n not in names
        and node.domain is None
        and (problem.observed.get(n) is None or problem.observed[n].mask is not None)
    ]
