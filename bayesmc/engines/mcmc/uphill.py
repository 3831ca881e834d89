"""Starts moved towards the mass, along the gradient of the log density on free numbers.

Draws of a vague prior may start chains so far out that one number at a time never finds the way. A few
steps of a quasi-Newton method do; but a mode itself is no start (that of a hierarchy is the neck of its
funnel), and starts ought to differ. So each start moves as little as it must: to the first point on its
path that is nearly as good as where the path leads. One that is good enough stays where it is.

Out of some regions no path leads: growth curves are flat where rates are in the thousands. So where starts
had to move, paths from free numbers near zero are followed, too; they take the place of those that end far
lower, if the data are not far likelier there.

References
----------
Zhang, Carpenter, Gelman and Vehtari (2022), Pathfinder, JMLR 23 (points on an optimiser's path as starts);
Gelman and Rubin (1992), Statistical Science 7 (starts wider than the target).
"""

from __future__ import annotations

import numpy as np

from bayesmc.engines.mcmc.climbing import data_logs
from bayesmc.engines.mcmc.jointly import continuous, density_of
from bayesmc.errors import BayesmcError
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.target import Target, Values, target_of
from bayesmc.structure.unconstrained import UnconstrainedDensity, unconstrained_density

#: iterations of the optimiser, those after which it must have gained, those that it remembers, and how
#: often a step is cut
_STEPS, _SOME, _MEMORY, _HALVES = 500, 10, 8, 12
#: how far the largest free number moves in the first step, and in any
_FIRST, _FARTHEST = 0.5, 5.0
#: how much lower than the path's end the log density may be, for each free number and besides: that of draws
#: lies half a number below the mode
_EACH, _BESIDES = 2.0, 20.0
#: how many times more, below the best end, loses a start altogether
_LOST = 5.0
#: how far from zero free numbers of other starts are, at most; what some steps must gain where paths of
#: starts that may be lost are followed further
_NEAR, _LITTLE = np.array([0.5, 2.0, 8.0]), 1.0
#: free numbers of all starts beyond which their paths take longer than they save
_LARGEST = 150_000


def uphill(target: Target, values: Values, rng: np.random.Generator) -> Values:
    """The starts, moved where they are far below what is near.

    Parameters
    ----------
    target : Target
    values : dict
        Stored values of all nodes, hidden ones ``(rows, *plates, *event)``, of positive density.
    rng : Generator

    Returns
    -------
    dict
        The same where the density has no gradient, or where no start is moved.
    """
    model = target.model
    if all(model[n].is_discrete or model[n].domain is not None for n in target.chain):
        return values
    try:
        density = _density(target)
    except BayesmcError:
        return values
    hidden = {n: v for n, v in values.items() if n in target.chain}
    inside = {*hidden, *target.links}
    rows = len(next(iter(hidden.values())))
    if not 0 < rows * density.size <= _LARGEST:
        return values
    free = np.array(density.unconstrain(values), dtype=float)
    margin = _BESIDES + _EACH * density.size
    points, logs = _paths(density, free, values, margin)
    ends = logs.max(axis=0)
    if np.isfinite(ends).all() and not (logs[0] < ends - margin).any():
        if (ends >= ends.max() - _LOST * margin).all():
            return values
    of = np.arange(rows)
    try:
        points, logs, of = _from_near(target, density, points, logs, values, margin, rng)
    except BayesmcError:  # where parameters are out of range, paths near zero are none
        pass
    ends = logs.max(axis=0)
    enough = (logs >= ends - margin).argmax(axis=0)
    good = np.flatnonzero(ends >= ends.max() - _LOST * margin)
    if not np.isfinite(ends[good]).all():
        return values
    source = np.arange(rows)
    lost = np.setdiff1d(source, good)
    source[lost] = rng.choice(good, len(lost))
    moved = {**values, **{n: v[of[source]] for n, v in hidden.items()}}
    moved.update(density.constrain(points[enough[source], source], moved))
    target.refresh(moved, target.chain)
    try:  # the model's own functions have the last word
        log = np.broadcast_to(target.log_density(moved), (rows,))
    except BayesmcError:
        return values
    fine = np.isfinite(log)
    if fine.all() or not fine.any():
        return moved if fine.all() else values
    source = np.where(fine, np.arange(rows), rng.choice(np.flatnonzero(fine), rows))
    return {n: v[source] if n in inside else v for n, v in moved.items()}


# ---- private ------------------------------------------------------------------------------------


def _density(target: Target) -> UnconstrainedDensity:
    """That of all continuous nodes; of a problem's own target the one that kernels have."""
    if target is target_of(target.problem):
        return density_of(target.problem, continuous(target))
    return unconstrained_density(target)


def _from_near(
    target: Target,
    density: UnconstrainedDensity,
    points: np.ndarray,
    logs: np.ndarray,
    values: Values,
    margin: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The paths, those that are lost replaced by such as begin with free numbers near zero.

    The third array tells which row's other values each goes with.
    """
    rows = points.shape[1]
    of, wide = np.arange(rows), np.repeat(np.arange(rows), len(_NEAR))
    density = in_machine_code(density, _STEPS, len(wide))  # most paths take no more
    held = {n: v[wide] if n in target.chain else v for n, v in values.items()}
    target.refresh(held, target.chain)
    spread = np.tile(_NEAR, rows)[:, None]
    near = spread * rng.spawn(1)[0].uniform(-1.0, 1.0, (len(wide), density.size))
    others, other_logs = _paths(density, near, held, margin)
    further, far = _paths(density, points[-1], values, _LITTLE)
    far, reached = (np.where(np.isnan(a), -np.inf, a)[-1] for a in (far, other_logs))
    seen, seen_near = (
        _of_data(target, density, further, values),
        _of_data(target, density, others, held),
    )
    lower = (far[:, None] + margin < reached) & (seen[:, None] < seen_near + margin)
    lost = np.flatnonzero(lower.any(axis=1))
    if not len(lost):
        return points, logs, of
    steps = max(len(points), len(others))
    points, logs, others, other_logs = (
        np.concatenate([a, np.repeat(a[-1:], steps - len(a), axis=0)])
        for a in (points, logs, others, other_logs)
    )
    for row in lost:
        by = rng.choice(np.flatnonzero(lower[row]))
        points[:, row], logs[:, row], of[row] = others[:, by], other_logs[:, by], wide[by]
    return points, logs, of


def _of_data(
    target: Target, density: UnconstrainedDensity, points: np.ndarray, values: Values
) -> np.ndarray:
    """Log densities of the data where paths end, shape (rows,)."""
    rows = points.shape[1]
    state = {**values, **density.constrain(points[-1], values)}
    target.refresh(state, target.chain)
    return data_logs(target, state, rows)


def _paths(
    density: UnconstrainedDensity, start: np.ndarray, values: Values, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points of L-BFGS paths of all rows, and their log densities, shapes (step, row, size), (step, row).

    They end where some steps gain less than ``least``: what is left is a chain's affair, and the way into a
    funnel's neck, too.
    """
    u, (log, slope) = start, density.with_gradient(start, values)
    points, logs = [u], [log]
    memory: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(_STEPS):
        direction = _newton(slope, memory)
        rise = (direction * slope).sum(axis=1)
        bad = ~(rise > 0) | ~np.isfinite(direction).all(axis=1)
        direction = np.where(bad[:, None], slope, direction)
        rise = np.where(bad, (slope * slope).sum(axis=1), rise)
        length = np.abs(direction).max(axis=1, initial=1e-300)
        longest = _FIRST if not memory else _FARTHEST
        step = np.where(bad, _FIRST / length, np.minimum(1.0, longest / length))
        best, new_log, new_slope = u, log, slope
        open_ = np.isfinite(rise) & (rise > 0)
        for _ in range(_HALVES):
            tried = np.where(open_[:, None], u + step[:, None] * direction, best)
            there, slope_there = density.with_gradient(tried, values)
            hit = open_ & (there > log + 1e-4 * step * rise) & np.isfinite(slope_there).all(axis=1)
            best = np.where(hit[:, None], tried, best)
            new_log = np.where(hit, there, new_log)
            new_slope = np.where(hit[:, None], slope_there, new_slope)
            open_ &= ~hit
            if not open_.any():
                break
            step = np.where(open_, 0.3 * step, step)
        memory = [*memory, (best - u, slope - new_slope)][-_MEMORY:]
        u, log, slope = best, new_log, new_slope
        points.append(u)
        logs.append(log)
        if len(logs) > _SOME and not (log - logs[-_SOME - 1] > least).any():
            break
    return np.stack(points), np.stack(logs)


def _newton(slope: np.ndarray, memory: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The slope times an inverse curvature learnt on the way (Nocedal and Wright 2006, alg. 7.4), by rows."""
    found, shares = slope, []
    for move, change in reversed(memory):
        product = (move * change).sum(axis=1)
        weight = np.where(product > 1e-12, 1.0 / np.where(product > 1e-12, product, 1.0), 0.0)
        share = weight * (move * found).sum(axis=1)
        shares.append((share, weight))
        found = found - share[:, None] * change
    if memory:
        move, change = memory[-1]
        squares = (change * change).sum(axis=1)
        scale = (move * change).sum(axis=1) / np.where(squares > 0, squares, 1.0)
        found = found * np.where(scale > 0, scale, 1.0)[:, None]
    for (move, change), (share, weight) in zip(memory, reversed(shares), strict=True):
        found = found + move * (share - weight * (change * found).sum(axis=1))[:, None]
    return found
