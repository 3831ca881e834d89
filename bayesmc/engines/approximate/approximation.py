"""What an approximation of a posterior is: a joint distribution of hidden nodes, drawn from and weighed.

An engine that approximates (Laplace's method, expectation propagation, mean-field) ends with such an object.
``ApproximatePosterior`` answers queries from it, and ``posterior.check`` holds it against the model itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from bayesmc.structure.target import Values


@dataclass(frozen=True, eq=False)
class Drawn:
    """Draws of an approximation, with its own log density.

    Attributes
    ----------
    values : dict
        Node -> stored values, shape ``(draws, *plates, *event)``, of all nodes in ``names``; where a node is
        partly observed, what was seen stands in its place.
    log_density : ndarray, shape (draws,)
        Of the joint approximation, normalised, in the nodes' own coordinates: the density of numbers by
        these numbers (of a simplex by all components but the last, of a symmetric matrix by its lower
        triangle), the probability of states. Plus infinity at draws that are to have no weight (an angle
        that has gone round more than once).
    """

    values: Values
    log_density: np.ndarray


class Marginal(Protocol):
    """The approximate distributions of all scalars of a node, each by itself; a ``Distribution`` is one.

    All have the shape of a node's value, ``(*plates, *event)``; quantiles have that of the levels in front.
    """

    @property
    def mean(self) -> np.ndarray: ...
    @property
    def var(self) -> np.ndarray: ...
    def ppf(self, q: Any) -> np.ndarray: ...


class Approximation(Protocol):
    """A joint distribution of hidden nodes that stands for their posterior.

    Attributes
    ----------
    names : tuple of str
        Hidden stochastic nodes that it is a distribution of: at least those on which something observed
        depends (``Target.chain``), finite ones among them. All others are drawn from the net given these.
    coordinates : str
        In which coordinates the approximation was made, in words, for ``explain`` and ``check``.

    Notes
    -----
    It may have a method ``spread(rng, draws) -> Drawn`` besides: draws about the same centre with heavier
    tails, with the log density of what they are drawn from. ``check`` corrects by these, since weights of a
    density with light tails do not show what lies beyond them; without, by the approximation's own draws.

    And it may have a method ``log_density(values) -> ndarray`` of shape ``(draws,)``: the log density of what
    ``spread`` draws from (``draw`` without it) at values that came from elsewhere, as ``Drawn`` has them.
    With it ``check`` draws from the prior, too, whose weights show regions that the approximation misses.
    """

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def coordinates(self) -> str: ...

    def draw(self, rng: np.random.Generator, draws: int) -> Drawn:
        """Independent joint draws of all nodes in ``names``."""
        ...

    def marginal(self, name: str) -> Marginal | None:
        """Marginals of a node in closed form or by quadrature, computed nodes too; None: answered by draws.

        Of nodes with labels probabilities are asked for (``probabilities``), not this.
        """
        ...

    def probabilities(self, name: str) -> np.ndarray | None:
        """Probabilities of the states of a finite node, shape ``(*plates, states)``; None: by draws."""
        ...

    def covariance(self, *names: str) -> np.ndarray | None:
        """Of all scalars of these nodes, in order, a matrix; None: by draws."""
        ...
