"""How far a posterior lies from what is published, in units of what its rule allows.

- ``bugs``: means within 0.15 published standard deviations, which is JAGS's own rule; standard deviations
  within 10 % or 4 standard errors (ours and the benchmark's together), whichever is more; an effective
  sample size of 1,000. Where an exact cdf is known, quartiles replace moments: the cdf at our quartiles
  within 4 standard errors of 1/4, 1/2, 3/4.
- ``posteriordb``: means within 4 standard errors (ours and the reference's together), standard deviations
  within 10 %; the same effective size.

R-hat (nested, of many short chains) is below 1.01, or below what chance gives so many groups of draws that
agree but for 1 scalar in 10,000.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

import bayesmc as bmc
from references.case import Case, Figures, Index

LEAST_ESS = 1000
_MOST_RHAT, _ALARM = 1.01, 1e-4


@dataclass(frozen=True)
class Deviation:
    """One figure of ours beside the published one.

    Attributes
    ----------
    name, what : str
        The reference name; mean, sd, quartile, ess or R-hat.
    ours, published, allowed : float
        What we found, what stands in print, and how far apart they may be.
    """

    name: str
    what: str
    ours: float
    published: float
    allowed: float

    @property
    def units(self) -> float:
        """Distance over what is allowed: up to 1 is fine; NaN counts as infinitely far."""
        if self.what == "ess":
            distance = self.published / self.ours if self.ours > 0 else math.inf
        else:
            difference = abs(self.ours - self.published)
            distance = difference / self.allowed if self.allowed > 0 else _zero_allowed(difference)
        return math.inf if math.isnan(distance) else distance


def deviations(case: Case, posterior: bmc.Posterior, root: Path) -> list[Deviation]:
    """Every comparison that the case's rule asks for, the effective sample sizes included."""
    found: list[Deviation] = []
    for name, figures in case.published(root).items():
        scalar = _Scalar(posterior, *case.locate(name))
        if case.rule == "posteriordb":
            found += _by_standard_errors(name, figures, scalar)
        elif figures.cdf is not None:
            found += _by_quartiles(name, figures, scalar)
        else:
            found += _by_benchmark(name, figures, scalar)
        found += _by_chains(name, scalar)
    return found


def figures_of(case: Case, posterior: bmc.Posterior, root: Path) -> dict[str, tuple[float, float]]:
    """Effective sample size and R-hat of every parameter published."""
    scalars = {name: _Scalar(posterior, *case.locate(name)) for name in case.published(root)}
    return {name: (scalar.ess, scalar.rhat) for name, scalar in scalars.items()}


class _Scalar:
    """One element of one node, and its figures."""

    def __init__(self, posterior: bmc.Posterior, node: str, index: Index) -> None:
        self._posterior = posterior
        self.node = node
        self.index = index
        self.mean = float(posterior.mean(node)[index])
        self.sd = float(posterior.std(node)[index])

    @property
    def ess(self) -> float:
        return float(self._posterior.ess(self._of(lambda x: x)))

    @property
    def rhat(self) -> float:
        return float(self._posterior.rhat(self._of(lambda x: x)))

    @property
    def groups(self) -> int:
        """Groups of draws that R-hat compares: superchains, else halves of chains."""
        superchains = int(getattr(self._posterior, "superchains", 0))
        return superchains or 2 * len(self._posterior[self.node])

    @property
    def mcse(self) -> float:
        return float(self._posterior.mcse(self._of(lambda x: x)))

    def quantile(self, q: float) -> float:
        return float(self._posterior.quantile(self.node, q)[self.index])

    def error_below(self, value: float) -> float:
        """Standard error of the estimated probability of lying below ``value``."""
        return float(self._posterior.mcse(self._of(lambda x: x <= value)))

    def error_of_sd(self) -> float:
        """Standard error of the estimated standard deviation, to first order."""
        squares = self._posterior.mcse(self._of(lambda x: (x - self.mean) ** 2))
        return float(squares) / (2 * self.sd)

    def kurtosis(self) -> float:
        fourth = self._posterior.expectation(self._of(lambda x: (x - self.mean) ** 4))
        return float(fourth) / self.sd**4

    def _of(self, function: Callable[[Any], Any]) -> Callable[..., Any]:
        """``function`` of this element, as a query: its argument bears the node's name."""

        def query(x: Any) -> Any:
            return np.asarray(function(np.asarray(x[(Ellipsis, *self.index)], dtype=float)))

        argument = inspect.Parameter(self.node, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        query.__signature__ = inspect.Signature([argument])  # type: ignore[attr-defined]
        return query


def _by_standard_errors(name: str, figures: Figures, scalar: _Scalar) -> Iterator[Deviation]:
    error = math.hypot(figures.mcse, scalar.mcse)
    yield Deviation(name, "mean", scalar.mean, figures.mean, 4 * error)
    yield Deviation(name, "sd", scalar.sd, figures.sd, 0.1 * figures.sd)


def _by_benchmark(name: str, figures: Figures, scalar: _Scalar) -> Iterator[Deviation]:
    yield Deviation(name, "mean", scalar.mean, figures.mean, 0.15 * figures.sd)
    error = scalar.error_of_sd()
    if figures.mcse > 0:
        # the benchmark's run was as good as this many independent draws, at least for squares
        draws = (figures.sd / figures.mcse) ** 2
        error = math.hypot(error, figures.sd * math.sqrt((scalar.kurtosis() - 1) / (4 * draws)))
    yield Deviation(name, "sd", scalar.sd, figures.sd, max(0.1 * figures.sd, 4 * error))


def _by_quartiles(name: str, figures: Figures, scalar: _Scalar) -> Iterator[Deviation]:
    assert figures.cdf is not None
    for q in (0.25, 0.5, 0.75):
        at = scalar.quantile(q)
        yield Deviation(name, "quartile", float(figures.cdf(at)), q, 4 * scalar.error_below(at))


def _by_chains(name: str, scalar: _Scalar) -> Iterator[Deviation]:
    yield Deviation(name, "ess", scalar.ess, LEAST_ESS, 1.0)
    rhat = scalar.rhat
    if not math.isnan(rhat):  # independent draws have none
        groups = scalar.groups
        chance = chdtri(groups - 1, _ALARM) * groups / (groups - 1) / max(scalar.ess, 1.0)
        most = max(_MOST_RHAT, math.sqrt(1.0 + chance))
        yield Deviation(name, "R-hat", max(rhat, 1.0), 1.0, most - 1.0)


def _zero_allowed(difference: float) -> float:
    return 0.0 if difference == 0 else math.inf
