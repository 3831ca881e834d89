"""What a mode is looked for in: the log density of all free numbers that matter, and where climbs start."""

from __future__ import annotations

import math

import numpy as np
import scipy

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.approximate.modes import Mode
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.network import Problem
from bayesmc.network.expressions import Followed, density
from bayesmc.structure.affine import NotLinearError, is_hidden, linear_node
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.jumps import jumps, spread_points
from bayesmc.structure.target import Target, Values, target_of
from bayesmc.structure.unconstrained import unconstrained_density

#: free numbers up to which nodes that follow linearly are taken along
_MOST = 2000
#: starts are the same whatever the seed of the draws: a mode is no matter of chance
_SEED = 20260
#: points between which a jump is looked for, and how far out they are: from the mode and from draws of the
#: prior in standard deviations, and where a jump counts by what is behind it
_POINTS, _REACH, _FAR = 96, 2.0, 6.0
#: difference in the log density from the mode from which on nothing is missed
_NEGLIGIBLE = 30.0


def is_number(problem: Problem, name: str) -> bool:
    """Whether a node is stochastic, continuous, and not wholly observed."""
    return problem.model[name].kind == "stochastic" and is_hidden(
        problem.model[name], problem.observed
    )


def free_density(problem: Problem, also: tuple[str, ...], who: str) -> UnconstrainedDensity:
    """The log density of the continuous nodes of the chain and of some besides, finite ones summed out.

    Raises
    ------
    UnsupportedError
        It cannot be followed or has no gradient, it jumps, a node is discrete without finite states or has
        too many, or there is nothing continuous.
    """
    kept = problem.cache.setdefault("densities of modes", {})
    if also not in kept:
        try:
            kept[also] = _made(target_of(problem, also), who)
        except UnsupportedError as error:
            kept[also] = f"{who}: {error}"
    if isinstance(kept[also], str):
        raise UnsupportedError(kept[also])
    return kept[also]


def linear_below(problem: Problem) -> tuple[str, ...]:
    """Nodes on which nothing observed depends that are Normal, linear in the chain's numbers, of known scale.

    Taken along they leave the mode and the curvature of the others as they are, and have closed answers.
    """
    model, target = problem.model, target_of(problem)
    hidden = frozenset(n for n, node in model.nodes.items() if is_hidden(node, problem.observed))
    inside = {n for n in target.chain if n in hidden}
    size = sum(math.prod(model[n].value_shape) for n in inside)
    found: list[str] = []
    for name in target.forward:
        size += math.prod(model[name].value_shape)
        if name in hidden and size <= _MOST and _is_linear(problem, target, name, hidden, inside):
            inside.add(name)
            found.append(name)
    return tuple(found)


def start_points(
    density: UnconstrainedDensity, starts: int, given: Values | None = None
) -> np.ndarray:
    """Free numbers from which to climb, shape (starts, size): draws of the prior, weighed by the data."""
    rng = np.random.default_rng(_SEED)
    with marking_invalid(), np.errstate(all="ignore"):
        values = start_states(density.target, starts, rng, given)
        found = np.broadcast_to(density.unconstrain(values), (starts, density.size))
    found = np.clip(np.where(np.isnan(found), 0.0, found), -30.0, None)
    finite = np.isfinite(found).all(axis=1) & (density.value(found) > -np.inf)
    return np.unique(found[finite], axis=0) if finite.any() else np.zeros((1, density.size))


def refuse_jumps(density: UnconstrainedDensity, mode: Mode, who: str, edges: bool = False) -> None:
    """Refuse a density that jumps around its mode, or on the way from there to where the prior has mass.

    Climbs do not see it: the other side may be higher, and its gradient does not tell. Far from the mode
    jumps count where the density beside or behind them is not negligible. With ``edges`` a density is
    refused, too, that is zero beyond some values near the mode, which a Gaussian there does not know of.

    Raises
    ------
    UnsupportedError
        Names the node.
    """
    rng = np.random.default_rng(density.size)
    z = _REACH * rng.standard_normal((density.size, _POINTS))
    near = mode.u + scipy.linalg.solve_triangular(mode.root.T, z).T
    try:
        _refuse(jumps(density, near, near))
        cut = jumps(density, near, near, to_zero=True) if edges else ()
        if cut:
            raise UnsupportedError(
                f"the density is zero beyond some values of node {min(cut)!r} near its mode (an observed "
                "comparison, or bounds that depend on other nodes), where a Gaussian there has mass; use "
                "ExpectationPropagation, Gibbs or HamiltonianMonteCarlo"
            )
        least = mode.log_density - _NEGLIGIBLE
        _refuse(jumps(density, mode.u[None], _drawn(density, _FAR), above=least))
    except UnsupportedError as error:
        raise UnsupportedError(f"{who}: {error}") from error


# ---- private ------------------------------------------------------------------------------------


def _made(target: Target, who: str) -> UnconstrainedDensity:
    problem = target.problem
    numbers = [n for n in target.chain if is_number(problem, n)]
    if not numbers:
        raise UnsupportedError(_nothing(target))
    density = unconstrained_density(target, None, [n for n in target.chain if n not in numbers])
    bounds = frozenset().union(*(b.leaves for node in density.nodes for b in node.bounds))
    for name in sorted(bounds & set(density.summed)):
        raise UnsupportedError(
            f"node {name!r} is to be summed out, and the bounds of a continuous node depend on it; use Gibbs"
        )
    drawn = _drawn(density)
    for jumping in (jumps(density), jumps(density, drawn, drawn)):
        _refuse(jumping)
    return density


def _refuse(jumping: frozenset[str]) -> None:
    if jumping:
        raise UnsupportedError(
            f"the density jumps at some values of node {min(jumping)!r}, so that its curvature tells "
            "nothing; use Gibbs or MetropolisHastings"
        )


def _drawn(density: UnconstrainedDensity, reach: float = _REACH) -> np.ndarray:
    """Free numbers of the states on which functions are compared, spread out."""
    states = density.target.states
    if states is None:
        return np.empty((0, density.size))
    values, rng = {**density.target.known, **states}, np.random.default_rng(density.size)
    return spread_points(density.nodes, values, rng, _POINTS, reach)


def _nothing(target: Target) -> str:
    if target.chain:
        names = ", ".join(map(repr, target.chain[:4]))
        return f"what observations depend on is finite ({names}): there is no curvature; use Exact or Gibbs"
    return "nothing observed depends on a hidden continuous node; use LikelihoodWeighting"


def _is_linear(
    problem: Problem, target: Target, name: str, hidden: frozenset[str], inside: set[str]
) -> bool:
    model = problem.model
    read = density(model, name)
    if not isinstance(read, Followed) or len(model[name].event_shape) > 1:
        return False
    varying = {*target.chain, *target.forward, *target.links}
    if (read.leaves & varying) - inside:
        return False
    try:
        linear_node(model, name, hidden, frozenset(), target.known)
    except (NotLinearError, TraceError):
        return False
    return True
