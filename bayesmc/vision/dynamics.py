"""Second-order dynamics of a vector: the next one given the last two, learned from a stretch of a series.

A dynamic Bayes net's node reads the slice before. The one before that is a computed node that hands on what
it was::

    @dbn.node(initial=start)
    def shape(shape_prev, before_prev):
        return dynamics.given(shape_prev, before_prev)

    @dbn.node(initial=lambda shape: shape)
    def before(shape_prev):
        return shape_prev
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import MvNormal
from bayesmc.distributions.base import as_float
from bayesmc.distributions.parameters import as_number
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.shapes import read_only


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """``x_t = mean + last (x_{t-1} - mean) + earlier (x_{t-2} - mean) + root w``, with standard normal ``w``.

    Parameters
    ----------
    mean : array_like, shape (size,)
    last, earlier, root : array_like, shape (size, size)
        ``root`` is lower triangular with a positive diagonal.

    Raises
    ------
    ShapeError
        Shapes that are not those of one vector.
    ParameterError
        Numbers that are not finite.

    References
    ----------
    Isard and Blake (1998), CONDENSATION, IJCV 29, section 4.2; Blake, Isard and Reynard (1995), Learning to
    track the visual motion of contours, Artificial Intelligence 78.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.vision import SecondOrder
    >>> going = SecondOrder.steady(2, noise=0.5)
    >>> going.given([3.0, 0.0], [1.0, 0.0]).mean.tolist()  # as fast as before
    [5.0, 0.0]
    >>> going.is_stable
    False
    """

    mean: np.ndarray
    last: np.ndarray
    earlier: np.ndarray
    root: np.ndarray

    def __post_init__(self) -> None:
        mean = np.array(self.mean, dtype=float)
        if mean.ndim != 1 or not mean.size:
            raise ShapeError(f"SecondOrder: mean has shape {mean.shape}; give a vector (size,)")
        object.__setattr__(self, "mean", mean)
        for name in ("last", "earlier", "root"):
            matrix = np.array(getattr(self, name), dtype=float)
            if matrix.shape != (mean.size, mean.size):
                raise ShapeError(
                    f"SecondOrder: {name} has shape {matrix.shape}; give ({mean.size}, {mean.size})"
                )
            object.__setattr__(self, name, matrix)
        for name in ("mean", "last", "earlier", "root"):
            if not np.isfinite(getattr(self, name)).all():
                raise ParameterError(f"SecondOrder: {name} must be finite")
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @classmethod
    def steady(cls, size: int, noise: Any, damping: float = 0.0, mean: Any = 0.0) -> SecondOrder:
        """Speeds that stay as they are but for noise, or die away: where nothing has been learned.

        Parameters
        ----------
        size : int
        noise : array_like, shape () or (size,)
            Standard deviation of the change of speed in a step.
        damping : float
            Share of the speed that is lost in a step, 0 to 1: at 1 a random walk.
        mean : array_like, shape () or (size,)
            Of no effect on where things go.

        Raises
        ------
        ParameterError
            Noise that is not positive, or damping outside 0..1.
        ShapeError
            Another number of components than ``size``.
        """
        scale, middle = _vector("noise", noise, size), _vector("mean", mean, size)
        if not (scale > 0).all() or not np.isfinite(scale).all():
            raise ParameterError(f"SecondOrder.steady: noise must be positive; got {noise!r:.60}")
        if not 0 <= as_number(damping) <= 1:
            raise ParameterError(
                f"SecondOrder.steady: damping must lie in 0..1; got {damping!r:.60}"
            )
        unit = np.eye(size)
        return cls(middle, (2 - damping) * unit, (damping - 1) * unit, np.diag(scale))

    @property
    def is_stable(self) -> bool:
        """Whether it stays about its mean: all roots of the recursion lie inside the unit circle."""
        # a double root at 1 is computed to half of the digits
        return bool(np.abs(np.linalg.eigvals(self._companion)).max() < 1 - 1e-7)

    def given(self, previous: Any, before: Any) -> MvNormal:
        """The next vector given the last two.

        Parameters
        ----------
        previous, before : array_like, shape (..., size)
            Of one step ago, and of two.

        Returns
        -------
        MvNormal
        """
        ahead = np.matvec(self.last, previous - self.mean)
        return MvNormal(
            self.mean + ahead + np.matvec(self.earlier, before - self.mean), scale_tril=self.root
        )

    @property
    def _companion(self) -> np.ndarray:
        size = len(self.mean)
        return np.block([[self.last, self.earlier], [np.eye(size), np.zeros((size, size))]])


def fit_dynamics(states: Any, prior: float = 60.0) -> SecondOrder:
    """Dynamics that are most probable given stretches of a series.

    Ridge regression of each vector on the two before it and a constant, shrunk towards going on at the same
    speed. Where what comes out would run away, its roots are drawn inside the unit circle, at
    most .99, about the mean of the stretch.

    Parameters
    ----------
    states : array_like, shape (..., time, size)
        Where the thing was; leading axes are stretches of their own, such as trajectories drawn by
        ``bmc.smooth``, which carry what is uncertain about it: means alone leave the noise too small.
    prior : float
        Weight of the shrinkage, in observations of each component's typical change: 0 for plain least
        squares.

    Raises
    ------
    ShapeError
        Fewer than three vectors, or no time axis.
    ParameterError
        Vectors that are not finite or never move (no noise can be learned), or a negative ``prior``.

    References
    ----------
    Blake, Isard and Reynard (1995), Learning to track the visual motion of contours, Artificial Intelligence
    78, section 4; North and Blake (1998), Learning dynamical models using expectation-maximisation, ICCV.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.vision import fit_dynamics
    >>> x, rng = np.zeros((500, 1)), np.random.default_rng(0)
    >>> for t in range(2, 500):
    ...     x[t] = 1.8 * x[t - 1] - 0.9 * x[t - 2] + rng.normal()
    >>> found = fit_dynamics(x)
    >>> found.last.round(1).tolist(), found.earlier.round(1).tolist(), found.root.round(1).tolist()
    ([[1.8]], [[-0.9]], [[1.0]])
    """
    x = as_float(states)
    if x.ndim < 2 or x.shape[-2] < 3:
        raise ShapeError(
            f"fit_dynamics: states have shape {x.shape}; give (..., time, size) with three or more "
            f"of them in time"
        )
    if not np.isfinite(x).all():
        raise ParameterError("fit_dynamics: states must be finite")
    if not 0 <= as_number(prior) < math.inf:
        raise ParameterError(f"fit_dynamics: prior must be 0 or more; got {prior!r:.60}")
    size, stretches = x.shape[-1], math.prod(x.shape[:-2])
    mean = x.reshape(-1, size).mean(axis=0)
    apart = x - mean
    # of z = x_{t-1} - mean and v = x_{t-1} - x_{t-2}: what is left of going on at the same speed
    z, v = apart[..., 1:-1, :], apart[..., 1:-1, :] - apart[..., :-2, :]
    left = (apart[..., 2:, :] - z - v).reshape(-1, size)
    design = np.concatenate([z, v, np.ones((*z.shape[:-1], 1))], axis=-1).reshape(-1, 2 * size + 1)
    typical = np.sqrt((design**2).mean(axis=0))
    ridge = np.diag(
        prior * stretches * np.where(np.arange(2 * size + 1) < 2 * size, typical, 0.0) ** 2
    )
    found = np.linalg.lstsq(
        np.vstack([design, np.sqrt(ridge)]), np.vstack([left, np.zeros((2 * size + 1, size))]),
        rcond=None,
    )[0].T  # fmt: skip
    noise = left - design @ found.T
    cov = noise.T @ noise / max(len(noise) - stretches, 1)
    least = np.linalg.eigvalsh(cov)
    if least[-1] <= 0:
        raise ParameterError(
            "fit_dynamics: the states never depart from one recursion, so there is no noise to learn; give a "
            "longer stretch, or write the SecondOrder down"
        )
    cov += max(1e-6 * least[-1] - least[0], 0.0) * np.eye(size)
    of_z, of_v, rest = found[:, :size], found[:, size:-1], found[:, -1]
    last, earlier = np.eye(size) * 2 + of_z + of_v, -np.eye(size) - of_v
    root = np.linalg.cholesky(cov)
    return _about(mean, last, earlier, rest, root)


# ---- private ------------------------------------------------------------------------------------


def _vector(name: str, value: Any, size: int) -> np.ndarray:
    found = as_float(value)
    if found.shape not in ((), (1,), (size,)):
        raise ShapeError(
            f"SecondOrder.steady: {name} has shape {found.shape}; give one number, or {size}: one for each "
            "component"
        )
    return np.broadcast_to(found, (size,))


def _about(
    mean: np.ndarray, last: np.ndarray, earlier: np.ndarray, rest: np.ndarray, root: np.ndarray
) -> SecondOrder:
    """The recursion with its constant moved into the mean, and its roots inside the circle."""
    size = len(mean)
    companion = SecondOrder(mean, last, earlier, root)._companion
    largest = np.abs(np.linalg.eigvals(companion)).max()
    if largest > 0.99:  # scaling by r per step of lag scales all roots by r
        shrunk = 0.99 / largest
        last, earlier = last * shrunk, earlier * shrunk**2
        return SecondOrder(mean, last, earlier, root)
    return SecondOrder(
        mean + np.linalg.solve(np.eye(size) - last - earlier, rest), last, earlier, root
    )
