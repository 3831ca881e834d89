"""The weighted particles of one slice, and how their arrays are laid out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import Slices
from bayesmc.engines.particles.recovery import Averages

#: numbers of the largest node in a block of particles: its temporaries stay in cache
BLOCK = 8192


class Particles(NamedTuple):
    """Particles of one slice.

    Attributes
    ----------
    t : int
    values : dict
        Node -> stored values, shape ``(particles, *plates, *event)``; without the first axis where all
        particles agree.
    log_weights : ndarray, shape (particles, *apart)
        Up to a constant.
    weights : ndarray, shape (particles, *apart)
        Their exponentials relative to the largest.
    total : ndarray, shape (*apart,)
        Sums of ``weights``.
    log_total : ndarray, shape (*apart,)
        Log of the sums of the exponentials of ``log_weights``.
    increment : ndarray, shape (*apart,)
        Log density of the row given the rows before.
    ess : ndarray, shape (*apart,)
    ancestors : ndarray of int or None
        Positions in the slice before, sorted; None where every particle has itself.
    resampled : ndarray of bool, shape (*apart,)
    rejuvenated : ndarray of bool, shape (*apart,)
        Whether they were drawn anew, since all weights had vanished; such particles have no ancestors.
    averages : Averages or None
        How well the last rows were explained, where recovery looks at that.
    injected : int
        Particles that recovery let begin anew.
    """

    t: int
    values: dict[str, np.ndarray]
    log_weights: np.ndarray
    weights: np.ndarray
    total: Any
    log_total: Any
    increment: Any
    ess: Any
    ancestors: np.ndarray | None = None
    resampled: Any = False
    rejuvenated: Any = False
    averages: Averages | None = None
    injected: int = 0


class Selection(NamedTuple):
    """Which particles have offspring, and what weight the offspring start with.

    Attributes
    ----------
    particles : int
        Of the next slice.
    ancestors : ndarray of int or None
        Sorted positions; None where everybody has one.
    resampled : bool or ndarray of bool, shape (*apart,)
    log_weights : ndarray or float
        That the offspring have already.
    log_normaliser : ndarray or float, shape (*apart,)
        Log of what their sum stands for: an increment is the log of the new sum, less this.
    """

    particles: int
    ancestors: np.ndarray | None
    resampled: Any
    log_weights: Any
    log_normaliser: Any


@dataclass(frozen=True)
class Layout:
    """How the arrays of particles are laid out.

    Attributes
    ----------
    particles : int
    apart : tuple of str
        Plates whose elements have weights of their own: axes of the weights after that of the particles.
    lead : tuple of int
        Their sizes.
    block : int
        Particles that are worked on at a time.
    """

    particles: int
    apart: tuple[str, ...]
    lead: tuple[int, ...]
    block: int = BLOCK


class Bare(NamedTuple):
    """What of a step describes its particles: it goes with a pickle, and moves none."""

    slices: Slices
    layout: Layout


def evenly_weighted(t: int, values: dict[str, np.ndarray], layout: Layout) -> Particles:
    """Draws of equal weight."""
    shape = (layout.particles, *layout.lead)
    ones, none = np.ones(shape), np.zeros(layout.lead)
    count = np.full(layout.lead, float(layout.particles))
    return Particles(t, values, np.zeros(shape), ones, count, np.log(count), none, count)


def along_plates(
    value: np.ndarray,
    index: np.ndarray,
    plates: tuple[str, ...],
    apart: tuple[str, ...],
) -> np.ndarray:
    """``value[index]`` on the first axis; elements of the plates ``apart`` have indices of their own."""
    ndim = 1 + len(plates)
    order = [apart.index(p) if p in apart else None for p in plates]
    shape = [len(index), *(index.shape[1 + k] if k is not None else 1 for k in order)]
    first = index.transpose(0, *(1 + k for k in order if k is not None)).reshape(shape)
    rest = [
        np.arange(value.shape[axis]).reshape([-1 if a == axis else 1 for a in range(ndim)])
        for axis in range(1, ndim)
    ]
    return value[(first, *rest)]
