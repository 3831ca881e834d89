"""From starts to the highest maximum, and how sharp it is: quasi-Newton steps, then the curvature."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.learning.fitted import agreeing
from bayesmc.learning.objectives import Objective
from bayesmc.progress import Progress

#: climbs that are made at least, and at most, where nobody says how many
_FEWEST, _MOST = 3, 8
#: starts that are tried where every one takes a search for a grid
_TRIED_OF_COSTLY = 16
#: how often a climb goes on from where it ended, with what is found there, and what it must rise by each time
_ROUNDS, _GAIN = 4, 1e-4
#: a Newton step that would still raise the maximum by more than so much is one too many
_RISE = 1e-5
#: curvature, in nats, below which there is none, and the slope that may be left along such directions
_FLAT, _SLOPE = 1e-4, 1e-3
#: information below which numbers are not told, over a step as long as they are; the same of combinations
#: of them, beside that of each by itself
_UNTOLD, _SINGULAR = 1e-4, 1e-6
#: the same below which a ridge is looked for, and steps that others make to follow it
_DOUBTFUL, _FOLLOWS = 1e-3, 10
#: nats that the objective must be lower two standard errors away, where a parabola is 2 lower
_FALL = 0.02


@dataclass(frozen=True, eq=False)
class Maximum:
    """Where climbs ended.

    Attributes
    ----------
    u : ndarray
    value : float
    history : ndarray
        Values after each step of the climb that went highest.
    hessian : ndarray
        Second derivatives there.
    rise : float
        How much higher Newton's step would go; NaN where the curvature is not that of a maximum.
    steps : int
    ends : ndarray
        Where all climbs ended, highest first.
    """

    u: np.ndarray
    value: float
    history: np.ndarray
    hessian: np.ndarray
    rise: float
    steps: int
    ends: np.ndarray

    @property
    def converged(self) -> bool:
        return bool(self.rise < _RISE)


def maximum(
    objective: Objective,
    starts: np.ndarray,
    tolerance: float,
    max_iterations: int,
    climbs: int | None = None,
    bar: Progress | None = None,
) -> Maximum:
    """The highest of the maxima that climbs from the best starts find.

    Parameters
    ----------
    starts : ndarray, shape (starts, size)
    climbs : int, optional
        How many; None goes on until two have ended at the highest value, within bounds.
    bar : Progress, optional
        Told of every start, climb and step.

    Raises
    ------
    UnsupportedError
        The evidence cannot be told at any start.
    """
    bar = Progress(None, "fit", False) if bar is None else bar
    costly = getattr(objective, "is_costly", False)
    starts = starts[: max(_TRIED_OF_COSTLY, climbs or 0)] if costly else starts
    several = getattr(objective, "values", None)
    bar.tell(f"fit: {len(starts)} starts")
    heights = several(starts) if several else np.array([objective.value(u) for u in starts])
    bar.advance()
    if not np.isfinite(heights).any():
        refused = getattr(objective, "refused", None)
        why = f": {refused}" if refused is not None else ""
        raise UnsupportedError(
            f"fit: the data have no probability at any of {len(heights)} starts{why}; give start= "
            "values that "
            "explain them"
        )
    order = [at for at in np.argsort(-heights, kind="stable") if np.isfinite(heights[at])]
    ended: list[_Climb] = []
    for at in order[: climbs or _MOST]:
        if climbs is None and len(ended) >= _FEWEST and agreeing([c.value for c in ended]) > 1:
            break
        bar.tell(f"fit: climb {len(ended) + 1}")
        ended.append(_climbed(objective, starts[at], heights[at], tolerance, max_iterations, bar))
    bar.tell("fit: curvature")
    bar.advance()
    best = max(ended, key=lambda climb: climb.value)
    _settle(objective, best.u)
    value = objective.value(best.u)
    ends = np.sort([value if climb is best else climb.value for climb in ended])[::-1]
    return _maximum(objective, best._replace(value=value), ends)


def climbed_on(
    objective: Objective, found: Maximum, u: np.ndarray, tolerance: float, most: int
) -> Maximum:
    """A maximum by one more climb, from a point that is higher than another."""
    bar = Progress(None, "fit", False)
    _settle(objective, u)
    climb = _Climb(u, objective.value(u), found.history, found.steps)
    for _ in range(_ROUNDS):  # quasi-Newton steps from where it is next to level may end at once
        more = _climbed(objective, climb.u, climb.value, tolerance, most, bar)
        rose = more.value - climb.value
        history = np.append(climb.history, more.history)
        climb = more._replace(history=history, steps=climb.steps + more.steps)
        if not rose > _GAIN:
            break
    return _maximum(objective, climb, np.append(max(found.ends[0], climb.value), found.ends[1:]))


def polished(objective: Objective, found: Maximum) -> Maximum:
    """Newton's steps at the end, as long as they rise: quasi-Newton ones stop where differences are rough."""
    u, value, history, steps = found.u, found.value, found.history, found.steps
    if not len(u):
        return replace(found, hessian=np.zeros((0, 0)), rise=0.0)
    for _ in range(8):
        slope, hessian = objective.gradient(u), curvature(objective, u)
        rise, step = newton_step(slope, hessian)
        if not rise > 1e-10:
            break
        new = u + step
        higher = objective.value(new)
        if not higher > value:
            break
        u, value, steps = new, higher, steps + 1
        history = np.append(history, higher)
    ends = np.append(max(found.ends[0], value), found.ends[1:])
    return Maximum(u, value, history, hessian, rise, steps, ends)


def newton_step(slope: np.ndarray, hessian: np.ndarray) -> tuple[float, np.ndarray]:
    """How far Newton's step would rise, and the step, along directions that are curved.

    Along others (a number at the edge of its support, an angle of no account) the slope must be next to none.
    """
    nothing = float("nan"), np.zeros(len(slope))
    if not (np.isfinite(hessian).all() and np.isfinite(slope).all()):
        return nothing
    values, vectors = np.linalg.eigh(-hessian)
    told = values > max(_FLAT, 1e-9 * values.max(initial=0.0))
    along = vectors.T @ slope
    if (values < -_FLAT).any() or (np.abs(along[~told]) > _SLOPE).any():
        return nothing
    step = along[told] / values[told]
    return float(0.5 * along[told] @ step), vectors[:, told] @ step


def curvature(objective: Objective, u: np.ndarray) -> np.ndarray:
    """Second derivatives: differences of the gradient."""
    found = np.empty((len(u), len(u)))
    for k in range(len(u)):
        step = 1e-4 * max(1.0, abs(u[k]))
        at = np.array([u, u])
        at[0, k] -= step
        at[1, k] += step
        found[k] = (objective.gradient(at[1]) - objective.gradient(at[0])) / (2 * step)
    return 0.5 * (found + found.T)


def told_part(
    objective: Objective, found: Maximum, bounded: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The covariance that a curvature says, and groups of numbers that it does not tell.

    A direction is told where the objective is curved in it, and lower two standard errors away: it is 2 nats
    lower if it is a parabola, and no lower where it rises for ever. Towards an edge it may be next to level.

    Parameters
    ----------
    bounded : ndarray of bool, shape (size, 2)
        Whether a number far below and far above is next to an edge of its support.

    Returns
    -------
    ndarray, shape (size, size)
        NaN for what is not told, and everywhere where the curvature is not that of a maximum.
    list of ndarray
        Positions: a number alone that the objective is flat in, or several with a flat combination.
    """
    u, hessian = found.u, found.hessian
    size = len(u)
    covariance = np.full((size, size), np.nan)
    information = -hessian
    scale = np.maximum(1.0, np.abs(u))
    own = np.diagonal(information)
    with np.errstate(invalid="ignore", over="ignore"):
        alone = ~(own * scale**2 > _UNTOLD) | ~np.isfinite(information).all(axis=0)
    groups = [np.array([k]) for k in np.flatnonzero(alone)]
    rest = np.flatnonzero(~alone)
    if not len(rest):
        return covariance, groups
    unit = 1.0 / np.sqrt(own[rest])
    values, vectors = np.linalg.eigh(information[np.ix_(rest, rest)] * np.outer(unit, unit))
    if (values < -_SINGULAR).any():
        return covariance, groups
    flat = values <= _SINGULAR
    if found.converged:
        scaled = unit[:, None] * vectors
        for k in np.flatnonzero(~flat & (values < _DOUBTFUL)):
            flat[k] = _is_ridge(objective, found, rest, scaled, values, int(k))
    for k in np.flatnonzero(~flat) if found.converged else ():
        step = np.zeros(size)
        step[rest] = 2.0 * unit * vectors[:, k] / np.sqrt(values[k])
        flat[k] = _rises(objective, found, step, bounded, np.abs(vectors[:, k]) > 0.1, rest)
    takes_part = np.abs(vectors[:, flat]) > 0.1
    groups += [rest[own] for own in takes_part.T]
    inner = (vectors[:, ~flat] / values[~flat]) @ vectors[:, ~flat].T * np.outer(unit, unit)
    lost = takes_part.any(axis=1)
    inner[lost], inner[:, lost] = np.nan, np.nan
    covariance[np.ix_(rest, rest)] = inner
    return covariance, groups


# ---- private ------------------------------------------------------------------------------------


def _rises(
    objective: Objective,
    found: Maximum,
    step: np.ndarray,
    bounded: np.ndarray,
    large: np.ndarray,
    rest: np.ndarray,
) -> bool:
    """Whether the objective does not fall two standard errors away, to where there is no edge."""
    falls = found.value - np.array([objective.value(found.u + s * step) for s in (-1.0, 1.0)])
    fell = falls > _FALL
    if fell.all() or not fell.any():
        return not fell.all()
    (side,) = np.flatnonzero(~fell)
    up = (step[rest[large]] > 0) == (side == 1)
    return not (falls[side] > 0 and bounded[rest[large], up.astype(int)].all())


def _is_ridge(
    objective: Objective,
    found: Maximum,
    rest: np.ndarray,
    scaled: np.ndarray,
    values: np.ndarray,
    k: int,
) -> bool:
    """Whether the objective stays level along a direction of little curvature, where others follow.

    Curvatures are differences, whose rounding may be more than a small one.
    """
    steep = np.flatnonzero(values >= _DOUBTFUL)
    length = min(1.0, 0.5 / np.abs(scaled[:, k]).max())
    falls = []
    for side in (-length, length):
        u = found.u.copy()
        u[rest] += side * scaled[:, k]
        height = objective.value(u)
        for _ in range(_FOLLOWS):
            along = scaled[:, steep].T @ objective.gradient(u)[rest]
            new = u.copy()
            new[rest] += scaled[:, steep] @ (along / values[steep])
            higher = objective.value(new)
            if not higher > height + 1e-9 * (1.0 + abs(height)):
                break
            u, height = new, higher
        falls.append(found.value - height)
    noise = 1e-9 * (1.0 + abs(found.value))
    return bool(max(falls) <= 0.5 * _SINGULAR * length**2 + noise)


class _Climb(NamedTuple):
    u: np.ndarray
    value: float
    history: np.ndarray
    steps: int


def _climbed(
    objective: Objective,
    start: np.ndarray,
    height: float,
    tolerance: float,
    most: int,
    bar: Progress,
) -> _Climb:
    """One climb by quasi-Newton steps; what is found at its end may let it go on."""
    from scipy.optimize import minimize

    u, history, steps, label = start, [height], 0, bar.label

    step_to = getattr(objective, "step_to", lambda _: None)

    def note(at: np.ndarray) -> None:
        step_to(at)
        history.append(objective.value(at))
        bar.tell(f"{label}, at {history[-1]:.4f}")
        bar.advance()

    for k in range(_ROUNDS):
        settled = _settle(objective, u)
        before = objective.value(u)
        with np.errstate(all="ignore"):  # of steps that run off
            found = minimize(
                lambda at: min(-objective.value(at), 1e300),
                u,
                jac=lambda at: -objective.gradient(at),
                method="BFGS",
                callback=note,
                options={"gtol": tolerance, "maxiter": most - steps},
            )
        u, steps = found.x, steps + int(found.nit)
        if not settled or steps >= most or (k and -found.fun < before + _GAIN):
            break
    return _Climb(u, float(-found.fun), np.array(history), steps)


def _settle(objective: Objective, u: np.ndarray) -> bool:
    """Let an objective keep for points near one what it finds there; whether there is anything."""
    settle = getattr(objective, "settle", None)
    return bool(settle is not None and settle(u))


def _maximum(objective: Objective, climb: _Climb, ends: np.ndarray) -> Maximum:
    """The end of a climb, polished."""
    none = np.zeros((0, 0))
    return polished(
        objective,
        Maximum(climb.u, climb.value, climb.history, none, float("nan"), climb.steps, ends),
    )
