"""Numbers at some values of which a log density jumps: a gradient does not see it, a slice does.

``np.where(year < change, before, after)`` has no derivative by ``change``, and where a year is passed the
density is another at once. Comparisons alone tell little, since both sides may meet there (a hinge, an
absolute value); so each node is moved by itself until a comparison turns, the turn is found by bisection, and
the density is looked at on both sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import UnsupportedError
from bayesmc.expression import Elementwise, Expression, Program, elementwise, ordered
from bayesmc.structure.free_density import FREE, UnconstrainedDensity
from bayesmc.structure.free_nodes import FreeNode
from bayesmc.structure.target import Values
from bayesmc.structure.unconstrained_check import other_values

#: what is another from one number to the next, besides comparisons and whole numbers
_STEPS = (np.floor, np.ceil, np.trunc, np.rint, np.sign, np.floor_divide, np.remainder, np.fmod)
#: ways that each node is moved, how far free numbers are from zero, and bisections of a way
_WAYS, _SPREAD, _HALVES = 8, 2.0, 48
#: ways that each node is moved among given points
_TRIES = 24
#: difference of the log density that is left at a jump, and numbers that are looked at, at most
_JUMP, _NUMBERS = 1e-3, 4_000_000
#: the size of a log density from which on it stands for one of what is impossible
_NEVER = 1e250

#: the log density of every row of free numbers, and all that may turn there
Looked = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def jumps(
    density: UnconstrainedDensity,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
    *,
    above: float = -np.inf,
    to_zero: bool = False,
) -> frozenset[str]:
    """Nodes that move at some values of which the density jumps from one positive value to another.

    Found by trying: ``8`` ways for each node, from random points around 0. With ``low`` and ``high``, points
    of free numbers, shape (points, size), ``nodes_that_jump`` looks between these, for jumps beside which or
    behind which the log density is ``above`` a number; with ``to_zero``, from a positive density to none.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.jumps import jumps
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet(plates={"year": 3})
    >>> net.add("change", bmc.Uniform(0.0, 3.0))
    >>> net.add("bend", bmc.Uniform(0.0, 3.0))
    >>> year = np.arange(3)
    >>> net.add(
    ...     "y",
    ...     lambda change, bend: bmc.Normal(
    ...         np.where(year < change, 0.0, 2.0) + np.maximum(year - bend, 0.0), 1.0
    ...     ),
    ...     plates="year",
    ... )
    >>> sorted(jumps(unconstrained_density(target_of(pose(net, {"y": [0.0, 0.0, 2.0]})))))
    ['change']
    """
    steps = _steps(density.root, FREE)
    count = len(density.nodes) * _WAYS
    if not steps or (low is None and count * _size(steps) > _NUMBERS):
        return frozenset()
    try:
        values = other_values(density, 0)
    except UnsupportedError:
        return frozenset()
    if low is not None and high is not None:
        root, nodes = density.root, density.nodes
        found = nodes_that_jump(root, FREE, values, nodes, low, high, to_zero=to_zero, above=above)
        return frozenset(found)
    rng = np.random.default_rng(density.size)
    low = _SPREAD * rng.normal(size=(count, density.size))
    high = low.copy()
    for k, node in enumerate(density.nodes):
        rows, numbers = slice(k * _WAYS, (k + 1) * _WAYS), slice(node.start, node.start + node.size)
        high[rows, numbers] = _SPREAD * rng.normal(size=(_WAYS, node.size))
    program = Program([density.root, *steps])
    differ = _jumped(program, steps, FREE, values, low, high, rng)
    owners = np.repeat(np.arange(len(density.nodes)), _WAYS)
    return frozenset(density.nodes[k].name for k in np.unique(owners[differ]))


def jumps_between(
    root: Expression,
    name: str,
    values: Values,
    low: np.ndarray,
    high: np.ndarray,
    *,
    to_zero: bool = False,
) -> np.ndarray:
    """Whether a log density of free numbers jumps on the ways between pairs of points, where tried.

    From one positive density to another; with ``to_zero``, from a positive one to none.

    Parameters
    ----------
    root : Expression
    name : str
        Its leaf of free numbers.
    values : mapping
        Its other leaves.
    low, high : ndarray, shape (ways, size)

    Returns
    -------
    ndarray of bool, shape (ways,)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.structure.jumps import jumps_between
    >>> root = trace(lambda u: np.where(u > 1.0, 0.3, 0.0).sum(), [TracedArray(leaf("u", (1,)))])
    >>> low, high = np.array([[0.0], [0.0]]), np.array([[0.5], [2.0]])
    >>> jumps_between(root, "u", {}, low, high)
    array([False,  True])
    """
    steps = _steps(root, name)
    return _jumped_in_parts(Program([root, *steps]), steps, name, values, low, high, to_zero)


def nodes_that_jump(
    root: Expression,
    name: str,
    values: Values,
    nodes: Sequence[FreeNode],
    low: np.ndarray,
    high: np.ndarray,
    *,
    to_zero: bool = False,
    above: float = -np.inf,
) -> tuple[str, ...]:
    """Nodes at some values of which a log density of free numbers jumps, looked for among points.

    Each node by itself is moved from where it is at some of ``low`` to where it is at some of ``high``, the
    others staying; otherwise as ``jumps_between``.

    Parameters
    ----------
    root : Expression
    name : str
        Its leaf of free numbers.
    values : mapping
        Its other leaves.
    nodes : sequence of FreeNode
    low, high : ndarray, shape (points, size)
    above : float
        Jumps are passed over where the log density is lower on both sides, and at the end of the way.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.free_density import FREE
    >>> from bayesmc.structure.jumps import nodes_that_jump
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Normal(0.0, 100.0))
    >>> net.add("b", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda a, b: bmc.Normal(np.where(a > 300.0, a, b), 1.0))
    >>> found = unconstrained_density(target_of(pose(net, {"y": 400.0})))
    >>> points = np.random.default_rng(0).normal(size=(50, 2)) * [200.0, 1.0]
    >>> nodes_that_jump(found.root, FREE, {}, found.nodes, points, points)
    ('a',)
    """
    steps, size = _steps(root, name), low.shape[1]
    if not steps or not len(low) or not len(high):
        return ()
    rng, found = np.random.default_rng(size), list[str]()
    program = Program([root, *steps])
    at_once = max(1, _NUMBERS // (_TRIES * max(_size(steps), size)))
    for first in range(0, len(nodes), at_once):
        some = nodes[first : first + at_once]
        start = low[rng.integers(len(low), size=len(some) * _TRIES)]
        end, other = start.copy(), high[rng.integers(len(high), size=len(start))]
        for k, node in enumerate(some):
            own = np.s_[k * _TRIES : (k + 1) * _TRIES, node.start : node.start + node.size]
            end[own] = other[own]
        differ = _jumped_in_parts(program, steps, name, values, start, end, to_zero, above)
        found += [n.name for n, d in zip(some, differ.reshape(-1, _TRIES), strict=True) if d.any()]
    return tuple(found)


def spread_points(
    nodes: Sequence[FreeNode],
    values: Values,
    rng: np.random.Generator,
    count: int,
    reach: float = _SPREAD,
) -> np.ndarray:
    """Free numbers around some states of the nodes, spread out beyond them, shape (points, size).

    Parameters
    ----------
    nodes : sequence of FreeNode
    values : mapping
        Stored values of nodes, shape ``(states, *plates, *event)``, of what is known without the first axis.
    rng : Generator
    count : int
        Points; fewer are returned where numbers run out, none where states lie at edges of supports.
    reach : float
        How far out they are, in standard deviations of the states.
    """
    with marking_invalid(), np.errstate(all="ignore"):
        parts = [node.freed(np.asarray(values[node.name], float), values) for node in nodes]
        rows = [np.reshape(p, (len(p), -1)) for p in parts]
        u = np.concatenate(rows, axis=1)
        u = u[np.isfinite(u).all(axis=1)]
        if len(u) < 2:
            return u
        picked = u[rng.integers(len(u), size=count)]
        far = reach * (0.1 + u.std(axis=0)) * rng.standard_normal(picked.shape)
        found = picked + far
    return found[np.isfinite(found).all(axis=1)]


# ---- private ------------------------------------------------------------------------------------


def _jumped_in_parts(
    program: Program,
    steps: Sequence[Expression],
    name: str,
    values: Values,
    low: np.ndarray,
    high: np.ndarray,
    to_zero: bool = False,
    above: float = -np.inf,
) -> np.ndarray:
    rng, found = np.random.default_rng(low.shape[1]), np.zeros(len(low), bool)
    if steps:
        some = max(1, _NUMBERS // _size(steps))
        for start in range(0, len(low), some):
            part = slice(start, start + some)
            ways = low[part], high[part]
            found[part] = _jumped(program, steps, name, values, *ways, rng, to_zero, above)
    return found


def _steps(root: Expression, name: str) -> list[Expression]:
    return [_whole(node) for node in ordered(root) if _is_step(node, name)]


def _size(steps: Sequence[Expression]) -> int:
    return sum(max(math.prod(s.shape), 1) for s in steps)


def _jumped(
    program: Program,
    steps: Sequence[Expression],
    name: str,
    values: Values,
    low: np.ndarray,
    high: np.ndarray,
    rng: np.random.Generator,
    to_zero: bool = False,
    above: float = -np.inf,
) -> np.ndarray:
    """Whether the density differs on both sides of a turn, for each way."""

    def looked(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(u)
        with np.errstate(all="ignore"):
            log, *found = program({**values, name: u})
        sides = [np.broadcast_to(f, (count, *s.shape)) for f, s in zip(found, steps, strict=True)]
        flat = [np.asarray(side, float).reshape(count, -1) for side in sides]
        return np.broadcast_to(log, (count,)), np.concatenate(flat, axis=1)

    turned = (looked(low)[1] != looked(high)[1]).any(axis=1)
    if not turned.any():
        return turned
    end = looked(high[turned])[0]
    low, high = _bisected(low[turned], high[turned], looked, rng)
    before, after = (looked(u)[0] for u in (low, high))
    with np.errstate(invalid="ignore"):
        if to_zero:
            differ = np.isfinite(before) != np.isfinite(after)
        else:
            differ = (np.abs(before) < _NEVER) & (np.abs(after) < _NEVER)
            differ &= np.abs(after - before) > _JUMP * (1.0 + 1e-9 * np.abs(before))
        highest = np.fmax(np.fmax(before, after), end)
    turned[turned] = differ & (highest > above if above > -np.inf else True)
    return turned


def _is_step(node: Expression, name: str) -> bool:
    if name not in node.leaves:
        return False
    return node.dtype.kind in "biu" or (isinstance(node, Elementwise) and node.function in _STEPS)


def _whole(node: Expression) -> Expression:
    """What of a step is the same on either side: of a remainder the whole part, which it leaves out."""
    if isinstance(node, Elementwise) and node.function in (np.remainder, np.fmod):
        return elementwise(np.floor_divide, *node.operands)
    return node


def _bisected(
    low: np.ndarray, high: np.ndarray, looked: Looked, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of each way moved to where one of the steps turns that do."""
    first, last = (looked(u)[1] for u in (low, high))
    turns = first != last
    one = np.argmax(turns * rng.random(turns.shape), axis=1)[:, None]  # any of those that do
    side = np.take_along_axis(first, one, axis=1)
    for _ in range(_HALVES):
        middle = 0.5 * (low + high)
        stays = np.take_along_axis(looked(middle)[1], one, axis=1) == side
        low, high = np.where(stays, middle, low), np.where(stays, high, middle)
    return low, high
