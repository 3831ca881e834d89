"""Normals with components that have no noise: their density on the plane where they lie.

Component by component: given those before it a component has a density, or it is a point and counts as a
probability, which is one where the value is right.
"""

from __future__ import annotations

import math

import numpy as np

from bayesmc.distributions.base import Distribution
from bayesmc.distributions.mvnormal import MvNormal
from bayesmc.distributions.normal import Normal

#: how far a value without noise may be off, relative to its size, and at least
ALLOWED, FLOOR = 1e-9, 1e-12
#: and relative to the terms that it is the sum of: a few thousand roundings of each
ROUNDED = 1e-12


def plane_log_density(
    dist: Distribution, x: np.ndarray, terms: np.ndarray | float = 0.0
) -> np.ndarray | None:
    """Log density of a ``Normal`` or ``MvNormal`` that may be singular; None for other families.

    Parameters
    ----------
    x : ndarray, shape (..., *event_shape)
    terms : ndarray, shape (..., *event_shape), or float
        How large the terms are whose sum is the mean, where that may be a difference of large numbers.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> flat = bmc.MvNormal([0.0, 1.0], np.diag([1.0, 0.0]))
    >>> plane_log_density(flat, np.array([[0.0, 1.0], [0.0, 2.0]])).round(4).tolist()
    [-0.9189, -inf]
    """
    if isinstance(dist, Normal):
        loc, root = dist.loc[..., None], dist.scale[..., None, None]
        x, terms = np.asarray(x, dtype=float)[..., None], np.asarray(terms)[..., None]
    elif isinstance(dist, MvNormal):
        loc, root = dist.loc, dist.scale_tril
    else:
        return None
    off = x - loc
    size = np.abs(x) + np.abs(loc)
    went_in = np.broadcast_to(size + terms, off.shape)
    lead = np.broadcast_shapes(off.shape[:-1], root.shape[:-2])
    z = np.zeros((*lead, off.shape[-1]))
    large = np.zeros(z.shape)  # what rounding in z is relative to
    total = np.zeros(lead)
    for j in range(off.shape[-1]):
        left = off[..., j] - (root[..., j, :j] * z[..., :j]).sum(axis=-1)
        sums = went_in[..., j] + (np.abs(root[..., j, :j]) * large[..., :j]).sum(axis=-1)
        pivot = root[..., j, j]
        point = pivot == 0
        with np.errstate(divide="ignore", invalid="ignore"):
            z[..., j] = np.where(point, 0.0, left / np.where(point, 1.0, pivot))
            large[..., j] = np.where(point, 0.0, sums / np.where(point, 1.0, pivot))
            log = -0.5 * z[..., j] ** 2 - np.log(pivot) - 0.5 * math.log(2 * math.pi)
        right = np.abs(left) <= ALLOWED * size[..., j] + ROUNDED * sums + FLOOR
        total = total + np.where(point, np.where(right, 0.0, -np.inf), log)
    return total
