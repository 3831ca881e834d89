"""Conjugate pairs of a parameter that only some elements of a child read: ``np.where(s, p, q)`` given s.

Of each element the parameter is proved affine in the node (``conjugate_matching``); its values at a few
points then tell, state by state, whether it is the node itself, one minus it, a multiple of it, or free of
it. An element of which none is true has no closed form, and what it adds is NaN.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.distributions import Categorical
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.kernels.conjugate_data import Elements
from bayesmc.kernels.conjugate_evaluation import Evaluated
from bayesmc.kernels.conjugate_kinds import Naturals
from bayesmc.kernels.conjugate_pairs import Pair
from bayesmc.kernels.conjugate_states import joint_states
from bayesmc.shapes import Shape
from bayesmc.structure.target import Values

if TYPE_CHECKING:
    from bayesmc.kernels.conjugate_children import Partner

#: kinds whose nodes may be picked
PICKED = ("scale", "share", "shares")
#: how far a parameter may be from what it is, by rounding of the arithmetic that picks
_ROUNDING = 1e-12


def points_of(kind: str, event_shape: Shape) -> np.ndarray:
    """Values of a node between which every affine function of it is known, shape (points, *event).

    The first is where statistics are taken: 1 for scales.

    Examples
    --------
    >>> from bayesmc.kernels.conjugate_picks import points_of
    >>> points_of("share", ()).tolist(), points_of("shares", (2,)).tolist()
    ([0.25, 0.75], [[0.75, 0.25], [0.25, 0.75]])
    """
    if kind == "scale":
        return np.array([1.0, 2.0])
    if kind == "share":
        return np.array([0.25, 0.75])
    (states,) = event_shape
    return 0.5 * np.eye(states) + 0.5 / states


def may_be_picked(pair: Pair, event_ndim: int) -> bool:
    """Whether some elements of a child alone may read a node; ``event_ndim`` is the child's."""
    return pair.kind in PICKED and (pair.kind != "scale" or event_ndim == 0)


def picked_natural(pair: Pair, points: np.ndarray, e: Evaluated, plates: int) -> Naturals:
    """What a child adds to the natural parameters of a node that some of its elements read.

    Parameters
    ----------
    e : Evaluated
        The child at the points.
    plates : int
        Number of the child's plates.
    """
    if pair.kind == "shares":
        return (_counts(pair, points, e),)
    theta = e.at_points(pair.parameter, 1 if pair.child is Categorical else 0)
    if pair.child is Categorical:
        theta = _of_seen(theta, e.data)
    first, last = theta[0], theta[-1]
    free = _near(first, last)
    found = pair.statistic(e)
    if pair.kind == "scale":
        mine = ~free & _near(last, 2.0 * first)
        added = [np.where(mine, part, 0.0) for part in found]
        other = np.zeros_like(mine)
    else:
        mine, other = (
            ~free & _near(first, points[i]) & _near(last, points[j]) for i, j in ((0, 1), (1, 0))
        )
        added = [np.where(mine, a, np.where(other, b, 0.0)) for a, b in (found, found[::-1])]
    lost = np.where(free | mine | other | (e.data.count == 0), 0.0, np.nan)
    return e.sum(added[0] + lost), e.sum(added[1] + lost)


def is_picked(partner: Partner) -> bool:
    """Whether a child is seen to pick at the states that are tried.

    Numbers take a slice step where a state turns up at which it is not so. Rows cannot: their parameter is
    affine in all numbers that are hidden together, so that what is picked hangs on finite nodes alone: all
    joint states of these are tried, and where they are too many nothing is claimed.
    """
    target, blanket = partner.blanket.target, partner.blanket
    states = target.states
    if states is None:
        return False
    tried: Iterable[Values] = [states]
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            if partner.kind.name == "shares":
                rest = joint_states(target, states, partner.terms)
                if rest is None:
                    return False
                tried = chain(tried, rest)
            for values in tried:
                for members in blanket.classes:
                    found = partner.natural(values, members)
                    if not all(np.isfinite(f).all() for f in found):
                        return False
    except (BayesmcError, ValueError, IndexError):
        return False
    return True


# ---- private ------------------------------------------------------------------------------------


def _near(a: Any, b: Any) -> np.ndarray:
    return np.asarray(np.abs(a - b) <= _ROUNDING * (np.abs(a) + np.abs(b)))


def _of_seen(theta: np.ndarray, data: Any) -> np.ndarray:
    """Probabilities of the states that were seen, from those of all: the last axis is taken away."""
    assert isinstance(data, Elements)
    codes = data.value.astype(np.intp)[None, ..., None]
    lead = np.broadcast_shapes(theta.shape[:-1], codes.shape[:-1])
    theta = np.broadcast_to(theta, (*lead, theta.shape[-1]))
    return np.take_along_axis(theta, np.broadcast_to(codes, (*lead, 1)), axis=-1)[..., 0]


def _counts(pair: Pair, points: np.ndarray, e: Evaluated) -> np.ndarray:
    """How often each category came where the node itself is the row."""
    theta = e.at_points(pair.parameter, 1)
    states = points.shape[-1]
    if theta.shape[-1] != states:
        return np.full(states, np.nan)
    free = _near(theta, theta[:1]).all(axis=(0, -1))
    wanted = points.reshape(len(points), *(1,) * (theta.ndim - 2), states)
    mine = ~free & _near(theta, wanted).all(axis=(0, -1))
    assert isinstance(e.data, Elements)
    if pair.child is Categorical:
        codes = e.data.value[..., None].astype(np.intp)
        counts = np.equal(codes, np.arange(states)) * e.data.count[..., None]
    else:
        counts = e.data.total
    lost = np.where(free | mine | (e.data.count == 0), 0.0, np.nan)
    return e.sum(np.where(np.asarray(mine)[..., None], counts, 0.0) + lost[..., None], 1)
