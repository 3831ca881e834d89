"""What is followed beside the particles of a filter: families, what is lost, drift, scouts.

``genealogy`` says what families are, ``tracking`` how they and the others are followed.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.smc import Particles

#: slices after which the younger origin takes over at the latest
LONGEST = 50

#: the origins of families, by the first axis of their arrays
OLD, YOUNG = 0, 1


class Lost(NamedTuple):
    """Particles of a slice that could not be trusted, and what has happened since.

    Attributes
    ----------
    where : ndarray of bool, shape (*apart,)
        Elements that are lost.
    wide : tuple of ndarray, shapes (many, numbers)
        Variances of the numbers of each node then; of finite nodes, 1.
    gone : tuple of ndarray, shapes (many, numbers)
        Variances of what was random since.
    since : int
        Slice of the last measurement.
    roots : ndarray of int or None, shape (particles, *apart)
        Whom each particle descends from there; None where everybody has itself.
    """

    where: np.ndarray
    wide: tuple[np.ndarray, ...]
    gone: tuple[np.ndarray, ...]
    since: int
    roots: np.ndarray | None = None


class Drift(NamedTuple):
    """Moves of the means of numbers so far, in units of their spreads.

    Attributes
    ----------
    moves : ndarray, shape (2, elements, numbers)
        Their sums, and the variances of these.
    worst : ndarray, shape (*apart,)
        The largest sum of moves of any number, in units of what is expected of it.
    largest : float
        That of the elements.
    limit : float
        From which on particles are missing.
    """

    moves: np.ndarray
    worst: Any
    largest: float
    limit: float


class Scouts(NamedTuple):
    """Those who are where no particle is.

    Attributes
    ----------
    values : dict
        All nodes of the slice, shape ``(scouts, *plates, *event)``.
    log_weights : ndarray, shape (scouts,)
        Relative to those of all particles together.
    share : float
        The sum of their weights, less that of the particles in such states.
    inner : Gaussians or None
        Their beliefs about what is integrated out.
    """

    values: dict[str, np.ndarray]
    log_weights: np.ndarray
    share: float
    inner: Any = None


class Families(NamedTuple):
    """Families of an old and a young origin, as they stand in the present slice.

    Attributes
    ----------
    bounds : ndarray of int, shape (2, groups + 1, *apart)
        Positions between which each family's particles lie.
    shares : ndarray, shape (2, groups, *apart)
        Their shares of the weight at the origin.
    kept : ndarray, shape (2, groups, *apart)
        Logs of what a family's weight is worth: where resampling gave it more particles than its weight
        demands, it counts for less.
    explained : ndarray, shape (2, 2, *apart)
        Variance of the log evidence that the weights of the slices since would make by themselves: of all
        slices, and of those whose weights have no tail.
    born : ndarray of int, shape (2, *apart)
        Slices of the origins.
    settled : ndarray, shape (*apart,)
        Variance of the log evidence up to the old origin.
    lost : Lost or None
        What the filter has lost sight of.
    scouts : Scouts or None
        Where states have no particle: what the rows make of these.
    drift : Drift or None
        Whether rows pull the particles the same way; None where particles are not drawn from the model.
    doubted : int or ndarray of int, shape (*apart)
        The last slice in which families differed by more than weights explain, if many did.
    """

    bounds: np.ndarray
    shares: np.ndarray
    kept: np.ndarray
    explained: np.ndarray
    born: np.ndarray
    settled: Any
    lost: Lost | None = None
    scouts: Scouts | None = None
    drift: Drift | None = None
    doubted: Any = -LONGEST


def ancestors_worth(index: np.ndarray, now: Particles) -> Any:
    """Equally weighted ancestors that those of particles are worth, shape (*apart)."""
    n, many = len(index), math.prod(index.shape[1:])
    rows = index.reshape(n, many) + n * np.arange(many)
    shares = np.bincount(rows.reshape(-1), (now.weights / now.total).reshape(-1), n * many)
    found = 1.0 / np.square(shares.reshape(many, n)).sum(axis=1)
    return found.reshape(index.shape[1:]) if index.ndim > 1 else float(found[0])
