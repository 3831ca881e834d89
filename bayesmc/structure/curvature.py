"""Second derivatives of a log density of free numbers: exact ones of its graph, or checked differences.

Products of the matrix with directions come of differentiating the gradient once more, forwards. They are
held against differences of the gradient where they are used; where the graph has no second derivatives, the
differences stand in, by two lengths of step, which must agree.

References
----------
Griewank and Walther (2008), Evaluating Derivatives, 2nd ed., sec. 5.1 (forward over reverse).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Program, leaf
from bayesmc.passes.arrays import for_arrays
from bayesmc.passes.derivatives import tangent
from bayesmc.passes.logarithms import stable
from bayesmc.structure.free_density import FREE, UnconstrainedDensity

_DIRECTION = "\0direction"
#: numbers of all directions of one call, times the elements of the density's largest part
_NUMBERS = 1 << 22
#: a step of differences, in standard deviations of one number given the others
_STEP = 1e-3
#: how far products with directions may be from differences, relative to their own size
_AGREE = 1e-3


@dataclass(frozen=True, eq=False)
class Curved:
    """Minus the second derivatives at a point.

    Attributes
    ----------
    matrix : ndarray, shape (size, size)
    error : float
        What its entries may be off, relative to the geometric mean of both diagonal entries.
    is_exact : bool
        From the graph; else from differences.
    """

    matrix: np.ndarray
    error: float
    is_exact: bool


@dataclass(frozen=True, eq=False)
class Curvature:
    """Minus the second derivatives of a log density of free numbers, which no other node moves.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.curvature import Curvature
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet(plates={"point": 3})
    >>> net.add("rate", bmc.Exponential(1.0))
    >>> net.add("y", lambda rate: bmc.Poisson(rate), plates="point")
    >>> density = unconstrained_density(target_of(pose(net, {"y": [1, 2, 3]})))
    >>> found = Curvature(density).at(np.array([0.5]))  # 4 exp(u) for the rate, and no more
    >>> found.matrix.round(6), found.is_exact
    (array([[6.594885]]), True)
    """

    density: UnconstrainedDensity

    def at(self, u: np.ndarray) -> Curved:
        """The matrix at free numbers, shape ``(size,)``."""
        if self._program is not None:
            matrix = self._exact(u)
            if np.isfinite(matrix).all() and self._agrees(matrix, u):
                return Curved(matrix, 64 * np.finfo(float).eps, True)
        return self._differences(u)

    @property
    def has_derivatives(self) -> bool:
        """Whether the graph has second derivatives."""
        return self._program is not None

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _program(self) -> Program | None:
        direction = leaf(_DIRECTION, (self.density.size,))
        try:
            moved = tangent(self.density.slopes, {FREE: direction})
            return Program(for_arrays(stable([moved])))
        except TraceError:
            return None

    @cached_property
    def _rows(self) -> int:
        """Directions of one call."""
        return max(_NUMBERS // max(_largest(self.density), self.density.size, 1), 1)

    def _exact(self, u: np.ndarray) -> np.ndarray:
        size = self.density.size
        found = np.empty((size, size))
        for first in range(0, size, self._rows):
            last = min(first + self._rows, size)
            directions = np.zeros((last - first, size))
            directions[np.arange(last - first), np.arange(first, last)] = 1.0
            found[first:last] = self._products(u, directions)
        return -0.5 * (found + found.T)

    def _products(self, u: np.ndarray, directions: np.ndarray) -> np.ndarray:
        assert self._program is not None
        with np.errstate(all="ignore"):
            (found,) = self._program({FREE: u, _DIRECTION: directions})
        return np.broadcast_to(found, directions.shape)

    def _agrees(self, matrix: np.ndarray, u: np.ndarray) -> bool:
        """Whether products with some directions are the differences of the gradient along them."""
        scale = _scales(np.diag(matrix))
        rng = np.random.default_rng(len(u))
        for _ in range(2):
            way = rng.choice([-1.0, 1.0], size=len(u)) * scale / np.sqrt(len(u))
            step = _STEP * way
            _, (before, after) = self.density.with_gradient(np.stack([u - step, u + step]))
            found = (before - after) / (2.0 * _STEP) * scale
            wanted = matrix @ way * scale
            size = np.abs(wanted).max() + np.sqrt(np.square(wanted).mean()) + 1e-6
            if not np.abs(found - wanted).max() <= _AGREE * size:
                return False
        return True

    def _differences(self, u: np.ndarray) -> Curved:
        scale = np.full(len(u), 1.0)
        for _ in range(2):  # the first tells how long steps are
            near = self._central(u, _STEP * scale)
            scale = _scales(np.diag(near))
        near, far = (self._central(u, k * _STEP * scale) for k in (1.0, 2.0))
        matrix = (4.0 * near - far) / 3.0
        # a kink shows as what differs between the steps, or between both triangles
        error = np.maximum(np.abs(near - far), np.abs(near - near.T)) * np.outer(scale, scale)
        matrix = 0.5 * (matrix + matrix.T)
        worst = float(error.max(initial=0.0))
        return Curved(matrix, worst if np.isfinite(worst) else np.inf, False)

    def _central(self, u: np.ndarray, steps: np.ndarray) -> np.ndarray:
        size = len(u)
        found = np.empty((size, size))
        for first in range(0, size, self._rows):
            at = np.arange(first, min(first + self._rows, size))
            moves = np.zeros((len(at), size))
            moves[np.arange(len(at)), at] = steps[at]
            _, before = self.density.with_gradient(u - moves)
            _, after = self.density.with_gradient(u + moves)
            found[at] = (before - after) / (2.0 * steps[at, None])
        return found


# ---- private ------------------------------------------------------------------------------------


def _scales(diagonal: np.ndarray) -> np.ndarray:
    """Standard deviations of single numbers given all others, as far as curvatures tell."""
    with np.errstate(all="ignore"):
        found = 1.0 / np.sqrt(np.abs(diagonal))
    return np.where(np.isfinite(found), np.clip(found, 1e-8, 1e8), 1.0)


def _largest(density: UnconstrainedDensity) -> int:
    from_terms = (int(np.prod(t.shape)) for t in density.target.terms.values())
    return max(from_terms, default=1)
