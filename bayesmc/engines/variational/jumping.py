"""Energies that jump at some values of a free number, or rise without end: climbs go on unaware.

The points of a normal factor cross a jump without a gradient telling, and a sum over a few of them says the
bound of another function than the one that is climbed.
"""

from __future__ import annotations

import numpy as np

from bayesmc.distributions.transforms import Identity, Wrapped
from bayesmc.engines.variational.factors import State
from bayesmc.engines.variational.free import FREE, FreeFactor
from bayesmc.engines.variational.steps import Plan, total_of
from bayesmc.errors import UnsupportedError
from bayesmc.structure.jumps import nodes_that_jump, spread_points

#: points between which nodes are moved, and how far out they are, in standard deviations of a draw
_POINTS, _REACH = 96, 2.0
#: how far from 0, and from all draws of the prior, there is no end in sight of a climb of a bounded number
_ENDLESS = 100.0
_JUMP = (
    "MeanField: the density jumps at some values of node {!r}, which the normal factor that it has without a "
    "closed form does not see as it climbs; use Gibbs() or MetropolisHastings()"
)
_EDGE = (
    "MeanField: the density is zero beyond some values of node {!r} (an observed comparison, or bounds that "
    "depend on other nodes), in front of which a normal factor would be squeezed; use "
    "ExpectationPropagation(), Gibbs() or HamiltonianMonteCarlo()"
)


def refuse_jumps(plan: Plan, state: State, edges: bool = False) -> None:
    """Refuse an energy that jumps within reach of the normal factor, or of draws of the prior.

    Found by trying: what each node is moved past, the others at random places. With ``edges`` a density that
    is zero beyond some values, where draws of the prior lie, is refused, too: a normal factor has mass beyond
    any edge, where the bound is minus infinity, and what it climbs is a sum over a few points, which shrinks
    until these are inside.

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
    ways = [(reached, reached, False), (drawn, drawn, False)]
    if edges:
        ways.append((reached, drawn, True))
    for low, high, to_zero in ways:
        found = nodes_that_jump(root, FREE, own, free.nodes, low, high, to_zero=to_zero)
        if found:
            raise UnsupportedError((_EDGE if to_zero else _JUMP).format(found[0]))


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
    return free.placed(_REACH * rng.standard_normal((_POINTS, free.size)))


def _drawn(plan: Plan, free: FreeFactor, rng: np.random.Generator) -> np.ndarray:
    """Free numbers of the states on which functions are compared, spread out."""
    states, known = plan.target.states, dict(plan.target.known)
    if states is None:
        return np.empty((0, free.size))
    return spread_points(free.nodes, {**known, **states}, rng, _POINTS)
