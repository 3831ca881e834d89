"""Conditional-Gaussian nets as plain arrays, and their answers by brute force.

Every joint state of the discrete elements has one dense Gaussian over all continuous scalars, conditioned
by one linear solve. It shares no code with distributions, tracing, factors or engines; the number of
configurations is the limit of what it can answer.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import UnknownNodeError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import BayesNet, Model, pose
from bayesmc.randomness import seed_sequence

#: one element of a discrete node; one component of one element of a continuous node
Variable = tuple[str, int]
Scalar = tuple[str, int, int]


@dataclass(frozen=True)
class PlainNode:
    """What is known of a node by name: its axes, and the user values of a discrete one."""

    name: str
    plates: tuple[str, ...] = ()
    plate_shape: tuple[int, ...] = ()
    event_shape: tuple[int, ...] = ()
    states: tuple[Any, ...] | None = None

    @property
    def elements(self) -> int:
        """Number of plate elements."""
        return math.prod(self.plate_shape)


@dataclass(frozen=True, eq=False)
class DiscretePart:
    """One discrete element: ``table`` has shape ``(*cards of scope, card)``."""

    variable: Variable
    scope: tuple[Variable, ...]
    table: np.ndarray


@dataclass(frozen=True, eq=False)
class GaussianPart:
    """d continuous scalars: normal, affine in p others, by the states of ``scope``.

    ``intercept`` has shape ``(*cards, d)``, ``coefficients`` ``(*cards, d, p)`` and ``covariance``
    ``(*cards, d, d)``, all zero where the scalars are computed.
    """

    scalars: tuple[Scalar, ...]
    scope: tuple[Variable, ...]
    parents: tuple[Scalar, ...]
    intercept: np.ndarray
    coefficients: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class ConditionalGaussian:
    """A conditional-Gaussian net as arrays, parents before children.

    Attributes
    ----------
    net : BayesNet
        The same net in words.
    nodes : dict
        Name -> `PlainNode`.
    discrete : tuple of DiscretePart
    gaussian : tuple of GaussianPart
    """

    net: BayesNet
    nodes: dict[str, PlainNode]
    discrete: tuple[DiscretePart, ...]
    gaussian: tuple[GaussianPart, ...]

    def posterior(self, evidence: Mapping[str, Any] | None = None) -> GaussianAnswer:
        """The exact posterior, by enumeration and dense conditioning.

        Parameters
        ----------
        evidence : dict, optional
            As for ``infer``: NaN, None and masked entries are not seen.

        Raises
        ------
        ZeroProbabilityError
            No configuration explains the evidence.
        """
        seen_states, seen = self._read(evidence or {})
        states, log_prior = self._configurations(seen_states)
        mean, cov = self._joint(states)
        index = {scalar: i for i, scalar in enumerate(s for p in self.gaussian for s in p.scalars)}
        at = [index[scalar] for scalar in seen]
        log_density, mean, cov = _condition(mean, cov, at, np.array(list(seen.values())))
        log_weights = log_prior + log_density
        top = log_weights.max()
        total = float(top + np.log(np.exp(log_weights - top).sum()))
        weights = np.exp(log_weights - total)
        model = pose(self.net, {}, None).model
        return GaussianAnswer(model, self.nodes, total, weights, states, index, mean, cov)

    def log_prob(self, values: Mapping[str, Any]) -> float:
        """Log joint density of complete user values, one for every node."""
        states, values_of = self._read(values)
        total = 0.0
        for part in self.discrete:
            at = tuple(states[v] for v in (*part.scope, part.variable))
            with np.errstate(divide="ignore"):
                total += float(np.log(part.table[at]))
        for gaussian in self.gaussian:
            row = tuple(states[v] for v in gaussian.scope)
            above = np.array([values_of[s] for s in gaussian.parents])
            off = np.array([values_of[s] for s in gaussian.scalars]) - gaussian.intercept[row]
            off = off - gaussian.coefficients[row] @ above
            if gaussian.covariance[row].any():
                total += float(_log_normal(off[None], gaussian.covariance[row][None])[0])
            elif np.abs(off).max() > 1e-9:
                return -math.inf
        return total

    def _read(self, given: Mapping[str, Any]) -> tuple[dict[Variable, int], dict[Scalar, float]]:
        """Positions of the discrete elements and values of the scalars that are given."""
        states: dict[Variable, int] = {}
        scalars: dict[Scalar, float] = {}
        for name, value in given.items():
            node = self.nodes[name]
            flat = np.reshape(np.array(value, dtype=object), -1).tolist()
            missing = np.ravel(np.ma.getmaskarray(value)).tolist()
            length = math.prod(node.event_shape)
            for place, (one, masked) in enumerate(zip(flat, missing, strict=True)):
                if masked or one is None or (isinstance(one, float) and math.isnan(one)):
                    continue
                if node.states is not None:
                    states[name, place] = node.states.index(one)
                else:
                    scalars[name, place // length, place % length] = float(one)
        return states, scalars

    def _configurations(
        self, seen: Mapping[Variable, int]
    ) -> tuple[dict[Variable, np.ndarray], np.ndarray]:
        """All possible joint states that agree with what is seen, with their log probabilities."""
        options = [
            [seen[p.variable]] if p.variable in seen else range(p.table.shape[-1])
            for p in self.discrete
        ]
        rows = list(itertools.product(*options))
        grid = np.array(rows, dtype=int).reshape(len(rows), len(options))
        states = {p.variable: grid[:, i] for i, p in enumerate(self.discrete)}
        prior = np.ones(len(grid))
        for part in self.discrete:
            prior = prior * part.table[tuple(states[v] for v in (*part.scope, part.variable))]
        possible = prior > 0
        if not possible.any():
            raise ZeroProbabilityError("ConditionalGaussian: the evidence has probability zero")
        return {v: s[possible] for v, s in states.items()}, np.log(prior[possible])

    def _joint(self, states: Mapping[Variable, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Prior means ``(C, n)`` and covariances ``(C, n, n)`` of all scalars by configuration."""
        count = len(next(iter(states.values()))) if states else 1
        total = sum(len(part.scalars) for part in self.gaussian)
        mean, cov = np.zeros((count, total)), np.zeros((count, total, total))
        index: dict[Scalar, int] = {}
        for part in self.gaussian:
            at, end = len(index), len(index) + len(part.scalars)
            row = tuple(states[v] for v in part.scope)
            above = [index[s] for s in part.parents]
            matrix = part.coefficients[row]
            mean[:, at:end] = part.intercept[row]
            mean[:, at:end] += np.matvec(matrix, mean[:, above])
            across = matrix @ cov[:, above, :at]
            cov[:, at:end, :at] = across
            cov[:, :at, at:end] = np.matrix_transpose(across)
            cov[:, at:end, at:end] = across[:, :, above] @ np.matrix_transpose(matrix)
            cov[:, at:end, at:end] += part.covariance[row]
            index.update((scalar, at + k) for k, scalar in enumerate(part.scalars))
        return mean, cov


@dataclass(frozen=True, eq=False)
class GaussianAnswer:
    """A posterior as a list of configurations, each with its weight and one dense Gaussian.

    Attributes
    ----------
    model : Model
        Of the net that was asked.
    nodes : dict
    log_marginal_likelihood : float
        Log probability (density) of the evidence.
    weights : ndarray, shape (configurations,)
        They sum to 1.
    states : dict
        Discrete element -> its position by configuration.
    index : dict
        Continuous scalar -> its place in ``means``.
    means, covs : ndarray, shapes (configurations, n) and (configurations, n, n)
    """

    model: Model
    nodes: dict[str, PlainNode]
    log_marginal_likelihood: float
    weights: np.ndarray
    states: dict[Variable, np.ndarray]
    index: dict[Scalar, int]
    means: np.ndarray
    covs: np.ndarray

    #: what the answer is good to: linear algebra in double precision
    accuracy = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that can be asked about."""
        return tuple(self.nodes)

    def probabilities(self, *names: str) -> np.ndarray:
        """Probabilities of the states, ``(*plates, states)``, or of several nodes jointly, whose plates
        lead in order of appearance and are shared by name."""
        nodes = [self._node(name) for name in names]
        sizes = {p: n for node in nodes for p, n in zip(node.plates, node.plate_shape, strict=True)}
        cards = tuple(len(_states_of(node)) for node in nodes)
        out = np.zeros((*sizes.values(), *cards))
        for at in np.ndindex(*sizes.values()):
            where = dict(zip(sizes, at, strict=True))
            picked = tuple(self.states[n.name, element_of(n, where)] for n in nodes)
            np.add.at(out[at], picked, self.weights)
        return out

    def mean(self, name: str) -> np.ndarray:
        """Posterior mean of a numeric node, shape ``(*plates, *event)``."""
        means, _ = self._moments([name])
        node = self._node(name)
        return (self.weights @ means).reshape(node.plate_shape + node.event_shape)

    def var(self, name: str) -> np.ndarray:
        """Posterior variance of every scalar, shape ``(*plates, *event)``."""
        node = self._node(name)
        return np.diagonal(self._cov([name])).reshape(node.plate_shape + node.event_shape).copy()

    def std(self, name: str) -> np.ndarray:
        """Posterior standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(np.maximum(self.var(name), 0.0))

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrix of all scalars of the named nodes, in order; of one scalar, its variance."""
        matrix = self._cov(names)
        return matrix[0, 0] if matrix.size == 1 else matrix

    def mixture(self, *names: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights ``(C,)``, means ``(C, n)`` and covariances ``(C, n, n)`` of all scalars of the nodes."""
        return (self.weights, *self._moments(names))

    def sample(self, draws: int, rng: Any = None) -> dict[str, np.ndarray]:
        """Independent joint draws of all nodes, ``(draws, *plates, *event)``; labels as their positions.

        ``rng`` is a seed or generator.
        """
        generator = np.random.default_rng(seed_sequence(rng))
        at = generator.choice(len(self.weights), size=draws, p=self.weights / self.weights.sum())
        roots, size = _roots(self.covs), self.means.shape[1]
        numbers = np.matvec(roots[at], generator.standard_normal((draws, size)))
        numbers = self.means[at] + np.where(self._is_known[at], 0.0, numbers)
        found = {}
        for node in self.nodes.values():
            columns = [self._column(node, e, at, numbers) for e in range(node.elements)]
            shape = (draws, *node.plate_shape, *node.event_shape)
            found[node.name] = np.stack(columns, axis=1).reshape(shape)
        return found

    def density(self, name: str, points: np.ndarray) -> np.ndarray:
        """Marginal density of every scalar at ``points``, shape ``(*points.shape, *plates, *event)``.

        A component without variance counts as zero.
        """
        node = self._node(name)
        means, covs = self._moments([name])
        variances = np.diagonal(covs, axis1=1, axis2=2)
        points = np.asarray(points, dtype=float)[..., None, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = -0.5 * ((points - means) ** 2 / variances + np.log(2 * np.pi * variances))
            parts = np.where(variances > 0, np.exp(logs), 0.0)
        density = (parts * self.weights[:, None]).sum(axis=-2)
        return density.reshape(points.shape[:-2] + node.plate_shape + node.event_shape)

    @property
    def _is_known(self) -> np.ndarray:
        """Scalars whose variance is rounding error, by configuration."""
        variances = np.diagonal(self.covs, axis1=1, axis2=2)
        return variances <= 1e-12 * np.maximum(1.0, self.means**2)

    def _column(
        self, node: PlainNode, element: int, at: np.ndarray, numbers: np.ndarray
    ) -> np.ndarray:
        """Draws of one element of a node."""
        if node.states is not None:
            positions = self.states[node.name, element][at]
            return (
                positions if isinstance(node.states[0], str) else np.array(node.states)[positions]
            )
        places = [self.index[node.name, element, k] for k in range(math.prod(node.event_shape))]
        return numbers[:, places]

    def _moments(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Means and covariances by configuration; a discrete node's number has no variance there."""
        columns, places = [], []
        for node in map(self._node, names):
            for element in range(node.elements):
                if node.states is not None:
                    numbers = np.array(node.states, dtype=float)
                    columns.append(numbers[self.states[node.name, element]])
                    places.append(-1)
                    continue
                for k in range(math.prod(node.event_shape)):
                    places.append(self.index[node.name, element, k])
                    columns.append(self.means[:, places[-1]])
        covs = np.zeros((len(self.weights), len(places), len(places)))
        smooth = np.flatnonzero(np.array(places) >= 0)
        at = np.array(places)[smooth]
        covs[:, smooth[:, None], smooth] = self.covs[:, at[:, None], at]
        return np.stack(columns, axis=-1), covs

    def _cov(self, names: Sequence[str]) -> np.ndarray:
        means, covs = self._moments(names)
        off = means - self.weights @ means
        return np.tensordot(self.weights, covs, axes=1) + (self.weights[:, None] * off).T @ off

    def _node(self, name: str) -> PlainNode:
        if name not in self.nodes:
            raise UnknownNodeError(f"GaussianAnswer: no node {name!r}; ask {', '.join(self.nodes)}")
        return self.nodes[name]


def _roots(covs: np.ndarray) -> np.ndarray:
    """Square roots of covariances, which may be singular."""
    values, vectors = np.linalg.eigh(covs)
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]


def _condition(
    mean: np.ndarray, cov: np.ndarray, at: list[int], values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log density of the seen scalars, and the moments of all given them, by configuration."""
    if not at:
        return np.zeros(len(mean)), mean, cov
    across = cov[:, at]
    block = across[:, :, at]
    gain = np.linalg.solve(block, across)
    off = values - mean[:, at]
    log_density = _log_normal(off, block)
    mean = mean + np.vecmat(off, gain)
    cov = cov - np.matrix_transpose(across) @ gain
    mean[:, at] = values
    cov[:, at] = 0.0
    cov[:, :, at] = 0.0
    return log_density, mean, 0.5 * (cov + np.matrix_transpose(cov))


def _log_normal(off: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Log density of centred normals, ``(C, d)`` under ``(C, d, d)``."""
    distance = np.vecdot(off, np.linalg.solve(cov, off[..., None])[..., 0])
    return -0.5 * (distance + np.linalg.slogdet(2 * np.pi * cov)[1])


def _states_of(node: PlainNode) -> tuple[Any, ...]:
    if node.states is None:
        raise UnsupportedError(f"probabilities({node.name!r}): the node is continuous")
    return node.states


def element_of(node: PlainNode, at: Mapping[str, int]) -> int:
    """Position of a node's element in a plate configuration that may have more plates."""
    own = tuple(at[p] for p in node.plates)
    return int(np.ravel_multi_index(own, node.plate_shape)) if own else 0
