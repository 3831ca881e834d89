"""Energies that jump at some values of a free number, or rise without end: climbs go on unaware.

The points of a normal factor cross a jump without a gradient telling, and a sum over a few of them says the
bound of another function than the one that is climbed.
"""

from __future__ import annotations

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.transforms import Identity, Wrapped
from bayesmc.engines.variational.factors import State
from bayesmc.engines.variational.free import FREE, FreeFactor
from bayesmc.engines.variational.steps import Plan, total_of
from bayesmc.errors import UnsupportedError
from bayesmc.structure.jumps import jumps_between

#: ways that each node is moved, and how far, in standard deviations of a draw
_WAYS, _REACH = 24, 2.0
#: how far from 0, and from all draws of the prior, there is no end in sight of a climb of a bounded number
_ENDLESS = 100.0


def refuse_jumps(plan: Plan, state: State) -> None:
    """Refuse an energy that jumps within reach of the normal factor, or of draws of the prior.

    Found by trying: what each node is moved past, the others at random places.

    Raises
    ------
    UnsupportedError
        Names the node.
    """
    free = plan.free
    if free is None:
        return
    root = total_of(s.total for s in plan.sums)
    rng = np.random.default_rng(free.size)
    own = {name: value for name, value in state.items() if name != FREE}
    for points in (_reached(free, rng), _drawn(plan, free, rng)):
        if len(points) < 2:
            continue
        for node in free.nodes:
            low, high = (points[rng.integers(len(points), size=_WAYS)] for _ in range(2))
            numbers = slice(node.start, node.start + node.size)
            ways = low.copy()
            ways[:, numbers] = high[:, numbers]
            if jumps_between(root, FREE, own, low, ways).any():
                raise UnsupportedError(
                    f"MeanField: the density jumps at some values of node {node.name!r}, which the normal "
                    "factor that it has without a closed form does not see as it climbs; use Gibbs() or "
                    "MetropolisHastings()"
                )


def refuse_edges(plan: Plan, state: State) -> None:
    """Refuse a density that is zero beyond some values of a free number, where draws of the prior lie.

    A normal factor has mass beyond any edge, where the bound is minus infinity: what it climbs is a sum over
    a few points, and it shrinks until these are inside.

    Raises
    ------
    UnsupportedError
        Names the node.
    """
    free = plan.free
    if free is None:
        return
    root = total_of(s.total for s in plan.sums)
    rng = np.random.default_rng(free.size)
    own = {name: value for name, value in state.items() if name != FREE}
    reached, drawn = _reached(free, rng), _drawn(plan, free, rng)
    if not len(drawn):
        return
    for node in free.nodes:
        low = reached[rng.integers(len(reached), size=_WAYS)]
        high = low.copy()
        numbers = slice(node.start, node.start + node.size)
        high[:, numbers] = drawn[rng.integers(len(drawn), size=_WAYS)][:, numbers]
        if jumps_between(root, FREE, own, low, high, to_zero=True).any():
            raise UnsupportedError(
                f"MeanField: the density is zero beyond some values of node {node.name!r} (an observed "
                "comparison, or bounds that depend on other nodes), in front of which a normal factor would "
                "be squeezed; use ExpectationPropagation(), Gibbs() or HamiltonianMonteCarlo()"
            )


def refuse_endless(plan: Plan) -> None:
    """Refuse a climb that has gone on to the edge of a node's support, as far as numbers go.

    Raises
    ------
    UnsupportedError
        Names the node.
    """
    free = plan.free
    if free is None:
        return
    drawn = _drawn(plan, free, np.random.default_rng(free.size))
    for node in free.nodes:
        if isinstance(node.transform, Identity | Wrapped):
            continue
        numbers = slice(node.start, node.start + node.size)
        away = np.abs(free.mean[numbers])
        if len(drawn):
            apart = np.abs(drawn[:, numbers] - free.mean[numbers]).min(axis=0)
            away = np.minimum(away, apart)
        if (away > _ENDLESS).any():
            u = free.mean[numbers][away.argmax()]
            raise UnsupportedError(
                f"MeanField: the evidence bound goes on rising as node {node.name!r} runs off to the edge of "
                f"its support (its free number, a logarithm, has come to {u:.3g}): the posterior has no "
                "integral, or next to all of its mass there, as a scale has whose readings are all equal; "
                "give the node a prior that vanishes at the edge (LogNormal, InverseGamma), or the readings "
                "the noise of their rounding"
            )


# ---- private ------------------------------------------------------------------------------------


def _reached(free: FreeFactor, rng: np.random.Generator) -> np.ndarray:
    return free.placed(_REACH * rng.standard_normal((4 * _WAYS, free.size)))


def _drawn(plan: Plan, free: FreeFactor, rng: np.random.Generator) -> np.ndarray:
    """Free numbers of the states on which functions are compared, spread out."""
    states, known = plan.target.states, dict(plan.target.known)
    if states is None:
        return np.empty((0, free.size))
    with marking_invalid(), np.errstate(all="ignore"):
        parts = []
        for node in free.nodes:
            value = np.asarray(states[node.name], float)
            parts.append(np.reshape(node.freed(value, {**known, **states}), (len(value), -1)))
    u = np.concatenate(parts, axis=1)
    u = u[np.isfinite(u).all(axis=1)]
    if len(u) < 2:
        return u
    rows = rng.integers(len(u), size=(4 * _WAYS, 1))
    spread = _REACH * (0.1 + u.std(axis=0))
    return np.take_along_axis(u, np.broadcast_to(rows, (4 * _WAYS, free.size)), 0) + spread * (
        rng.standard_normal((4 * _WAYS, free.size))
    )
