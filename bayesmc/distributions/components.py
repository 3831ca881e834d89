"""Some components of a vector: what they say by themselves, and the others drawn given them."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.distributions.base import Distribution
from bayesmc.distributions.joint import Joint
from bayesmc.distributions.mvnormal import MvNormal
from bayesmc.errors import UnsupportedError
from bayesmc.shapes import Shape


def splits(dist: Any) -> bool:
    """Whether a family has marginals of some components, and can draw the others given those."""
    return isinstance(dist, (MvNormal, Joint))


def log_prob_of(dist: Distribution, x: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Log density of some components by themselves; the batch broadcasts.

    Parameters
    ----------
    dist : MvNormal or Joint
    x : ndarray, shape (..., d)
    present : ndarray of bool, shape (d,)

    Raises
    ------
    UnsupportedError
        A part of a ``Joint`` that is no ``MvNormal`` is present in part.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> pose = bmc.MvNormal([0.0, 1.0], [[4.0, 1.0], [1.0, 1.0]])
    >>> float(log_prob_of(pose, np.array([0.0, 9.0]), np.array([True, False])).round(4))
    -1.6121
    """
    if present.all():
        return dist.log_prob_unchecked(x)
    if isinstance(dist, MvNormal):
        at = np.flatnonzero(present)
        if not len(at):
            return np.zeros(np.broadcast_shapes(x.shape[:-1], dist.batch_shape))
        cov = dist.cov[..., at[:, None], at]
        return MvNormal(dist.loc[..., at], cov).log_prob_unchecked(x[..., at])
    total: Any = np.zeros(np.broadcast_shapes(x.shape[:-1], dist.batch_shape))
    for part, where in _parts(dist):
        here = present[where]
        if np.ndim(here):
            if here.any():
                total = total + log_prob_of(part, x[..., where], here)
        elif here:
            total = total + part.log_prob_unchecked(x[..., where])
    return total


def completed(
    dist: Distribution, rng: np.random.Generator, shape: Shape, x: np.ndarray, present: np.ndarray
) -> np.ndarray:
    """Draws, shape ``(*shape, d)``, of the components that are not there given those that are.

    Parameters
    ----------
    x : ndarray, shape (..., d)
        Broadcasts to the draws.
    present : ndarray of bool, shape (d,)

    References
    ----------
    Doucet (2010), A note on efficient conditional simulation of Gaussian distributions (a joint draw moved by
    what was seen, less what was drawn of it).
    """
    draws = dist.sample_to(rng, shape)
    if isinstance(dist, MvNormal):
        at, rest = np.flatnonzero(present), np.flatnonzero(~present)
        cov = dist.cov
        inside = cov[..., at[:, None], at]
        off = (x - draws)[..., at]
        moved = np.matvec(
            cov[..., rest[:, None], at], np.linalg.solve(inside, off[..., None])[..., 0]
        )
        draws[..., rest] += moved
    else:
        for part, where in _parts(dist):
            here = present[where]
            if np.ndim(here) and here.any() and not here.all():
                draws[..., where] = completed(part, rng, shape, x[..., where], here)
    return np.where(present, x, draws)


# ---- private ------------------------------------------------------------------------------------


def _parts(dist: Distribution) -> Any:
    if not isinstance(dist, Joint):
        raise UnsupportedError(
            f"{type(dist).__name__} has no marginal of some components; a vector seen in part needs an "
            "MvNormal, or a Joint of parts that are seen in full or not at all"
        )
    return dist._places()
