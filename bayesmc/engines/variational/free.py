"""The factor of nodes without closed forms: normal in unconstrained coordinates, all of them jointly.

Its expectations are sums over fixed points that have a normal's mean and covariance exactly, so that the
bound is a function without noise, which is climbed by quasi-Newton steps and never falls (Giordano, Ingram
and Broderick 2024). Up to two numbers the points are those of Gauss and Hermite, of more a Sobol sequence.

References
----------
Kucukelbir, Tran, Ranganath, Gelman and Blei (2017), Automatic Differentiation Variational Inference, JMLR 18;
Giordano, Ingram and Broderick (2024), Black Box Variational Inference with a Deterministic Objective, JMLR
25.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy
from scipy import special

from bayesmc.engines.variational.factors import Factor, State
from bayesmc.expression import Expression, Leaf, Program, leaf, pick
from bayesmc.passes.arithmetic import ZERO, add
from bayesmc.passes.arrays import for_arrays
from bayesmc.passes.derivatives import gradient
from bayesmc.passes.logarithms import stable
from bayesmc.structure.free_nodes import FreeNode, free_node
from bayesmc.structure.free_terms import known_values
from bayesmc.structure.target import Target

#: the leaf of all free numbers
FREE = "\0free numbers of the approximation"
#: numbers up to which their covariance is full, and points of a rule by its dimension
FULL = 40
_HERMITE = {1: 40, 2: 24}
_LOG_2PI = math.log(2 * math.pi)
#: times that a factor is made ten times narrower where its bound is no number
_SHRINKS = 10
#: what stands for a bound that is no number
_LOST = 1e200


class FreeFactor(Factor):
    """Nodes as free numbers with a normal distribution.

    Attributes
    ----------
    nodes : tuple of FreeNode
    above : dict
        Node -> its value, of the leaf of free numbers.
    volume : Expression
        The logarithm of the change of volume.
    mean, root : ndarray
        Of the free numbers; a lower triangle, or standard deviations.
    """

    seen = None

    def __init__(self, target: Target, names: Sequence[str]) -> None:
        self.target = target
        found: list[FreeNode] = []
        for name in target.chain:
            if name in names:
                start = found[-1].start + found[-1].size if found else 0
                found.append(free_node(target, name, start))
        self.nodes, self.names = tuple(found), tuple(n.name for n in found)
        self.size = sum(n.size for n in found)
        self.is_full = self.size <= FULL
        self.leaf: Leaf = leaf(FREE, (self.size,))
        self.moments = (FREE,)
        self.shapes = {FREE: (self.size,)}
        self.above: dict[str, Expression] = {}
        total: Expression = ZERO
        for node in found:
            part = pick([self.leaf], node.start + np.arange(node.size))
            given = {**known_values(target, node.bounds), **self.above}
            self.above[node.name], volume = node.expressions(part, given)
            total = add(total, volume)
        self.volume = total
        self.points, self.weights = rule(self.size, self.is_full)
        self.mean: np.ndarray = np.zeros(self.size)
        self.root: np.ndarray = np.eye(self.size)

    def prepare(self, energy: Expression) -> None:
        """Make ready to climb, given the part of the energy that reads it."""
        (root,) = stable([add(energy, self.volume)])
        (slopes,) = stable([gradient(root, [FREE])[FREE]])
        self._both = Program(for_arrays([root, slopes]))
        self._volume = Program(for_arrays(stable([self.volume])))

    def start(self, state: State, values: Mapping[str, np.ndarray]) -> None:
        known = {**self.target.known, **values}
        self.mean = self.freed(known).reshape(-1)
        scale = 0.1  # of a unit on the free line
        self.root = np.full(self.size, scale) if not self.is_full else scale * np.eye(self.size)
        state[FREE] = self.placed(self.points)

    def placed(self, z: np.ndarray) -> np.ndarray:
        """Free numbers from standard ones, shape (points, size)."""
        return self.mean + (z @ self.root.T if self.is_full else z * self.root)

    def update(self, state: State, slopes: Mapping[str, np.ndarray]) -> None:
        """Some quasi-Newton steps, in units of what the factor is now; they are taken if the bound gains."""
        for _ in range(_SHRINKS):  # where it overflows, nearer to its middle
            if self._lost(self._origin(), state)[0] < _LOST:
                break
            self.root = 0.1 * self.root
        best = scipy.optimize.minimize(
            self._lost, self._origin(), args=(state,), jac=True, method="L-BFGS-B",
            options={"maxiter": self.steps, "maxcor": 20, "ftol": 1e-15, "gtol": 1e-10},
        )  # fmt: skip
        if best.fun < self._lost(self._origin(), state)[0]:
            self.mean, self.root = self._moved(best.x)
        state[FREE] = self.placed(self.points)

    #: quasi-Newton steps of one sweep
    steps = 12

    def entropy(self, state: State) -> float:
        return 0.5 * self.size * (1.0 + _LOG_2PI) + self._log_det(self.root)

    def bound_parts(self, state: State) -> float:
        """The expected logarithm of the change of volume."""
        return self.average(self._volume(state)[0])

    def log_volumes(self, u: np.ndarray) -> np.ndarray:
        """The logarithm of the change of volume at free numbers."""
        return self._volume({FREE: u})[0]

    def average(self, values: np.ndarray) -> float:
        """An expectation, from values at the points."""
        return float(self.weights @ np.broadcast_to(values, self.weights.shape))

    def spreads(self, state: State) -> list[np.ndarray]:
        diagonal = np.linalg.norm(self.root, axis=1) if self.is_full else self.root
        return [self.mean / diagonal, np.log(diagonal)]

    def constrained(self, u: np.ndarray, known: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Node -> stored value at free numbers ``(*batch, size)``."""
        above = dict(known)
        for node in self.nodes:
            above[node.name] = node.constrained(u[..., node.start : node.start + node.size], above)
        return {n: above[n] for n in self.names}

    def freed(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Free numbers of stored values of its nodes and those above, shape ``(*batch, size)``."""
        parts = [node.freed(np.asarray(values[node.name], float), values) for node in self.nodes]
        return np.concatenate(parts, axis=-1)

    def log_volume(self, u: np.ndarray, known: Mapping[str, np.ndarray]) -> np.ndarray:
        above = {**known, **self.constrained(u, known)}
        parts = [n.log_volume(u[..., n.start : n.start + n.size], above) for n in self.nodes]
        return np.asarray(sum(parts, np.zeros(u.shape[:-1])))

    # ---- private -------------------------------------------------------------------------------

    def _log_det(self, root: np.ndarray) -> float:
        diagonal = np.diagonal(root) if self.is_full else root
        return float(np.log(np.abs(diagonal)).sum())

    def _origin(self) -> np.ndarray:
        inner = self.size * (self.size + 1) // 2 if self.is_full else self.size
        return np.zeros(self.size + inner)

    def _step(self, x: np.ndarray) -> np.ndarray:
        """The factor's root in units of what it is: a lower triangle, or its diagonal."""
        d = self.size
        if not self.is_full:
            return np.exp(x[d:])
        step = np.zeros((d, d))
        step[np.diag_indices(d)] = np.exp(x[d : 2 * d])
        step[np.tril_indices(d, -1)] = x[2 * d :]
        return step

    def _moved(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step = self._step(x)
        if self.is_full:
            return self.mean + self.root @ x[: self.size], self.root @ step
        return self.mean + self.root * x[: self.size], self.root * step

    def _lost(self, x: np.ndarray, state: State) -> tuple[float, np.ndarray]:
        """Minus the part of the bound that it moves, and its derivatives."""
        d, z = self.size, self.points
        with np.errstate(all="ignore"):
            mean, root = self._moved(x)
            u = mean + (z @ root.T if self.is_full else z * root)
            logs, slopes = self._both({**state, FREE: u})
            logs = np.broadcast_to(logs, self.weights.shape)
            slopes = np.broadcast_to(slopes, u.shape)
            value = float(self.weights @ logs) + self._log_det(root)
            if not np.isfinite(value) or not np.isfinite(slopes).all():
                return _LOST, np.zeros_like(x)
            weighted = self.weights[:, None] * slopes
            of_mean = weighted.sum(axis=0)
            found = np.empty_like(x)
            if self.is_full:
                found[:d] = self.root.T @ of_mean
                of_step = self.root.T @ (weighted.T @ z)
                step = self._step(x)
                found[d : 2 * d] = np.diagonal(of_step) * np.diagonal(step) + 1.0
                found[2 * d :] = of_step[np.tril_indices(d, -1)]
            else:
                found[:d] = self.root * of_mean
                found[d:] = (weighted * z).sum(axis=0) * root + 1.0
        return -value, -found


def rule(size: int, is_full: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of a standard normal, whose first two moments are exact.

    Returns
    -------
    tuple of ndarray, shapes (points, size) and (points,)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.variational.free import rule
    >>> z, w = rule(5, True)
    >>> bool(np.allclose(w @ z, 0.0)), bool(np.allclose((z * w[:, None]).T @ z, np.eye(5)))
    (True, True)
    """
    if size in _HERMITE:
        return _hermite(size, _HERMITE[size])
    half = 1 << max(6, math.ceil(math.log2(6 * size))) if is_full else 32
    z, weights = fresh_points(size, np.random.default_rng(0), half)
    if is_full:
        root = np.linalg.cholesky(z.T @ z / len(z))
        z = np.linalg.solve(root, z.T).T
    else:
        z = z / np.sqrt((z**2).mean(axis=0))
    return z, weights


def finer_rule(size: int) -> tuple[np.ndarray, np.ndarray] | None:
    """More points of the rule of Gauss and Hermite, where it is used."""
    return _hermite(size, 3 * _HERMITE[size] // 2) if size in _HERMITE else None


def fresh_points(
    size: int, rng: np.random.Generator, half: int = 256
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of opposite points of a scrambled Sobol sequence, made normal, with their weights."""
    from scipy.stats import qmc  # heavy: loaded where it is used

    uniform = qmc.Sobol(size, rng=rng).random(half)
    some = special.ndtri(np.clip(uniform, 1e-12, 1 - 1e-12))
    return np.concatenate([some, -some]), np.full(2 * half, 0.5 / half)


# ---- private ------------------------------------------------------------------------------------


def _hermite(size: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The product rule of Gauss and Hermite without points of next to no weight."""
    nodes, weights = special.roots_hermitenorm(count)
    weights = weights / weights.sum()
    grid = np.stack(np.meshgrid(*[nodes] * size, indexing="ij"), axis=-1).reshape(-1, size)
    each = np.stack(np.meshgrid(*[weights] * size, indexing="ij"), axis=-1).reshape(-1, size)
    product = each.prod(axis=-1)
    kept = product > 1e-14
    return grid[kept], product[kept] / product[kept].sum()
