"""``Marginal``: one node's distribution as histogram, density or table, from weighted draws or exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, Mixture
from bayesmc.errors import UnsupportedError
from bayesmc.network import CompiledNode


@dataclass(frozen=True, eq=False)
class Marginal:
    """The marginal distribution of one node (each plate element and component by itself).

    Attributes
    ----------
    name : str
    values : ndarray, shape (draws, *plates, *event)
        Draws; the node's possible values where it is answered from a table; where it is a mixture of
        Gaussians the means of the components, ``(components, *plates, *event)``.
    weights : ndarray, shape (draws,), (*plates, states) or (*plates, components)
        Weights that sum to 1.
    states : tuple or None
        For a finite discrete node.
    distribution : Distribution or None
        The marginal itself, where it is known exactly: of a continuous node a ``Mixture`` of Gaussians, with
        the node's plates as batch.
    ends : (float, float)
        Of the support: kernel densities are reflected there, and 0 beyond.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> marginal = bmc.infer(net, engine=bmc.LikelihoodWeighting(20_000), rng=0).marginal("x")
    >>> heights, edges = marginal.histogram(bins=30)
    >>> bool(abs(marginal.density(0.0) - 0.3989) < 0.02)
    True
    """

    name: str
    values: np.ndarray
    weights: np.ndarray
    states: tuple[Any, ...] | None = None
    distribution: Distribution | None = None
    ends: tuple[float, float] = (-np.inf, np.inf)

    @property
    def probabilities(self) -> np.ndarray:
        """Probabilities of the states, shape ``(*plates, states)``."""
        if self.states is None:
            raise UnsupportedError(
                f"marginal({self.name!r}): a continuous node has no table of states"
            )
        return self.weights

    def histogram(self, bins: Any = 40, range: Any = None, density: bool = True) -> tuple[Any, Any]:  # noqa: A002
        """Weighted histogram of a scalar node: ``(heights, edges)`` as ``np.histogram`` gives them."""
        values = self._scalar("histogram")
        if self.distribution is not None:
            return self._exact_histogram(bins, range, density)
        return np.histogram(values, bins=bins, range=range, weights=self.weights, density=density)

    def density(self, points: Any, bandwidth: str | float = "scott") -> np.ndarray:
        """Density at ``points``: exact where it is known, else a kernel estimate on weighted draws.

        At an end of the support kernels are reflected, so that none of their mass lies beyond.

        Parameters
        ----------
        points : array_like
        bandwidth : "scott", "silverman" or float
            A rule with the weights' effective sample size, or the kernel's standard deviation.

        References
        ----------
        Scott, Multivariate Density Estimation (1992), sec. 6.5; Silverman (1986), eq. 3.31 and sec. 2.10
        (reflection).
        """
        values = self._scalar("density")
        points = np.asarray(points, dtype=float)
        if self.distribution is not None:
            return np.exp(self.distribution.log_prob(points))
        h = self._bandwidth(values, bandwidth)
        flat = points.ravel()
        low, high = self.ends
        places = [flat, *(2.0 * end - flat for end in self.ends if np.isfinite(end))]
        total = sum(self._kernels(at, values, h) for at in places)
        total = np.where((flat >= low) & (flat <= high), total, 0.0)
        return (total / (h * np.sqrt(2 * np.pi))).reshape(points.shape)

    def _kernels(self, flat: np.ndarray, values: np.ndarray, h: float) -> np.ndarray:
        """Sums of weighted kernels, without their constant."""
        total = np.zeros(flat.shape)
        step = max(1, 2_000_000 // max(len(flat), 1))
        for start in range(0, len(values), step):
            z = (flat[:, None] - values[None, start : start + step]) / h
            total += np.exp(-0.5 * z * z) @ self.weights[start : start + step]
        return total

    def _exact_histogram(self, bins: Any, limits: Any, density: bool) -> tuple[Any, Any]:
        """Probabilities of bins, between the 0.1 % and 99.9 % quantiles where no range is given."""
        assert self.distribution is not None
        if np.ndim(bins) == 0:
            if isinstance(bins, str):
                raise UnsupportedError(
                    f"marginal({self.name!r}).histogram(bins={bins!r}): rules of thumb are for draws; give a "
                    "number of bins, or edges"
                )
            low, high = self.bounds() if limits is None else limits
            if low == high:  # as np.histogram does
                low, high = low - 0.5, high + 0.5
            bins = np.linspace(low, high, int(bins) + 1)
        edges = np.asarray(bins, dtype=float)
        mass = np.diff(self.distribution.cdf(edges))
        total = mass.sum()
        return (mass / np.diff(edges) / (total if total > 0 else 1.0) if density else mass), edges

    def bounds(self, outside: float = 0.001) -> tuple[float, float]:
        """The ends between which a scalar lies, but for a probability of ``outside`` at either end."""
        values = self._scalar("bounds")
        if self.distribution is not None:
            low, high = self.distribution.ppf([outside, 1 - outside])
            return float(low), float(high)
        order = np.argsort(values)
        mass = np.cumsum(self.weights[order])
        found = np.searchsorted(mass, [outside * mass[-1], (1 - outside) * mass[-1]])
        ends = values[order][np.minimum(found, len(order) - 1)]
        return float(ends[0]), float(ends[1])

    def _scalar(self, what: str) -> np.ndarray:
        if self.states is not None:
            raise UnsupportedError(
                f"marginal({self.name!r}).{what}: use .probabilities of a discrete node"
            )
        if self.values.ndim != 1:
            raise UnsupportedError(
                f"marginal({self.name!r}).{what}: the node has shape {self.values.shape[1:]}; ask for one "
                f"scalar with marginal({self.name!r}, index)"
            )
        return self.values

    def _bandwidth(self, values: np.ndarray, rule: str | float) -> float:
        if not isinstance(rule, str):
            if not rule > 0:
                raise ValueError(f"bandwidth={rule!r} must be positive")
            return float(rule)
        ess = 1.0 / np.sum(self.weights**2)
        mean = self.weights @ values
        spread = np.sqrt(self.weights @ (values - mean) ** 2)
        spread = spread or max(abs(mean), 1.0) * 1e-3
        if rule == "scott":
            return float(spread * ess ** (-1 / 5))
        if rule == "silverman":
            return float(spread * (0.75 * ess) ** (-1 / 5))
        raise ValueError(f"bandwidth={rule!r} is not 'scott', 'silverman' or a number")


def ends_of(node: CompiledNode) -> tuple[float, float]:
    """Between what each number of a node lies, whatever its parents are."""
    support = node.support
    if support is not None and support.kind == "simplex":
        return 0.0, 1.0
    if support is None or support.kind != "interval":
        return -np.inf, np.inf
    within = support.at_most
    low, high = (float(np.asarray(end).flat[0]) for end in (within.low, within.high))
    return low, high


def gaussian_marginal(name: str, mixture: Mixture) -> Marginal:
    """The marginal of a continuous node that is a mixture of Gaussians."""
    means = np.asarray(mixture.components.mean)
    axis = len(mixture.batch_shape)
    return Marginal(name, np.moveaxis(means, axis, 0), mixture.weights, distribution=mixture)
