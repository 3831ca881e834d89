"""Quick steps for mixtures of few components: from a state to Python's floats, round arrays.

A step is quick where a node holds the means or the covariances of two-dimensional normals by label
(``conjugate_planar`` has the formulas), or the weights of labels that somebody counts, and its prior is
constant. Everywhere else, and with the same law, ``conjugate`` works on arrays.
"""

from __future__ import annotations

import numpy as np

from bayesmc.kernels.conjugate_children import Partner
from bayesmc.kernels.conjugate_data import Groups
from bayesmc.kernels.conjugate_kinds import Naturals
from bayesmc.kernels.conjugate_labels import ByLabel
from bayesmc.kernels.conjugate_planar import FEW, planar_covariances, planar_means
from bayesmc.kernels.precisions import Precision, keep_precision
from bayesmc.structure.target import Values


class PlanarStep:
    """Draws all components of a node; ``way`` tells their children's parameters and sums.

    Parameters
    ----------
    way : ByLabel
        With ``direct`` known.
    prior : tuple of ndarray
        Natural parameters of the constant prior.
    """

    def __init__(self, way: ByLabel, prior: Naturals) -> None:
        self.way, self.prior = way, prior
        self.name = way.blanket.name
        self.labels = way.groups.states
        self.centre: list[float] = way.groups.centre.tolist()  # type: ignore[assignment]

    def draw(self, values: Values, rng: np.random.Generator) -> np.ndarray | None:
        """New values, or None before anything was drawn where floats do not pay or do not do."""
        chains = len(values[self.name])
        if chains * self.labels > FEW:
            return None
        return self._drawn(values, rng, chains)

    def _drawn(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray | None:
        raise NotImplementedError


class PlanarCovariances(PlanarStep):
    """Covariances under one inverse-Wishart prior, about means that are a node by label."""

    def __init__(self, way: ByLabel, prior: Naturals, means: str) -> None:
        super().__init__(way, prior)
        self.means = means
        self.df, self.scale = float(prior[0].item()), prior[1].reshape(2, 2).tolist()

    def _drawn(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray | None:
        sums = self.way.groups.at(values).rows
        offs: list[list[float]] = (
            (values[self.means] - self.way.groups.centre).reshape(-1, 2).tolist()
        )
        if len(offs) != len(sums):
            return None
        found = planar_covariances(self.df, self.scale, sums, offs, rng)
        if found is None:
            return None
        drawn, entries = found
        cov = np.array(drawn).reshape(chains, self.labels, 2, 2)
        if entries is not None:
            precision = Precision((chains, self.labels), entries=entries)
            keep_precision(self.way.blanket.target, self.name, cov, precision)
        return cov


class PlanarMeans(PlanarStep):
    """Means under constant Normal priors."""

    def __init__(self, way: ByLabel, prior: Naturals) -> None:
        super().__init__(way, prior)
        precision = np.broadcast_to(prior[0], (1, self.labels, 2, 2))[0]
        self.precisions = [(m[0][0], m[1][0], m[1][1]) for m in precision.tolist()]
        self.linear = np.broadcast_to(prior[1], (1, self.labels, 2))[0].tolist()

    def _drawn(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray | None:
        sums = self.way.groups.at(values).rows
        noise = self.way.precision(values)
        if noise.batch != (chains, self.labels) or len(sums) != chains * self.labels:
            return None
        drawn = planar_means(
            self.precisions * chains, self.linear * chains, sums, self.centre, noise.entries, rng
        )
        return np.array(drawn).reshape(chains, self.labels, 2)


class CountedShares:
    """Weights of labels under a constant Dirichlet prior, all of whose concentrations are at least 1."""

    def __init__(self, groups: Groups, prior: list[float]) -> None:
        self.groups, self.prior = groups, prior

    def draw(self, values: Values, rng: np.random.Generator) -> np.ndarray | None:
        """New values, or None before anything was drawn where floats do not pay."""
        chains, states = len(values[self.groups.label]), self.groups.states
        if chains * states > FEW:
            return None
        rows = self.groups.at(values).rows
        gammas = [
            rng.standard_gamma(a + row[0]) for a, row in zip(self.prior * chains, rows, strict=True)
        ]
        if chains == 1:
            total = sum(gammas)
            return np.array([[g / total for g in gammas]])
        found = np.array(gammas).reshape(chains, states)
        return found / found.sum(axis=-1, keepdims=True)


def quick_step(partner: Partner, prior: Naturals) -> PlanarStep | CountedShares | None:
    """The quick step of a node under its constant prior, where there is one.

    Parameters
    ----------
    partner : Partner
        Its only child.
    prior : tuple of ndarray
        Natural parameters.
    """
    if partner.counts is not None:
        weights = prior[0].ravel().tolist()
        fits = len(weights) == partner.counts.states and min(weights) >= 1.0
        return CountedShares(partner.counts, weights) if fits else None
    way = partner.way
    if way is None or way.direct is None or set(way.direct) != {"loc", "cov"}:
        return None
    node, labels = way.blanket.node, (way.groups.states,)
    if way.groups.centre.shape != (2,) or node.plate_shape != labels or len(prior[0]) != 1:
        return None
    if partner.is_mean_by_label:
        return PlanarMeans(way, prior)
    loc = way.direct["loc"]
    one = partner.kind.name == "covariance" and prior[0].size == 1 and prior[1].size == 4
    if one and loc.node is not None and loc.is_copy and loc.trailing == 2:
        return PlanarCovariances(way, prior, loc.node)
    return None
