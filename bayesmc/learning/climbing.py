"""From starts to the highest maximum, and how sharp it is: quasi-Newton steps, then the curvature."""

from __future__ import annotations

from dataclasses import dataclass
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
    return _polished(objective, best._replace(value=value), ends)


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


def told_part(objective: Objective, found: Maximum) -> tuple[np.ndarray, list[np.ndarray]]:
    """The covariance that a curvature says, and groups of numbers that it does not tell.

    A direction is told where the objective is curved in it, and lower two standard errors away: it is 2 nats
    lower if it is a parabola, and no lower where it rises for ever.

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
    for k in np.flatnonzero(~flat) if found.converged else ():
        step = np.zeros(size)
        step[rest] = 2.0 * unit * vectors[:, k] / np.sqrt(values[k])
        flat[k] = any(not objective.value(at) < found.value - _FALL for at in (u - step, u + step))
    takes_part = np.abs(vectors[:, flat]) > 0.1
    groups += [rest[own] for own in takes_part.T]
    inner = (vectors[:, ~flat] / values[~flat]) @ vectors[:, ~flat].T * np.outer(unit, unit)
    lost = takes_part.any(axis=1)
    inner[lost], inner[:, lost] = np.nan, np.nan
    covariance[np.ix_(rest, rest)] = inner
    return covariance, groups


# ---- private ------------------------------------------------------------------------------------


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

    def note(at: np.ndarray) -> None:
        history.append(objective.value(at))
        bar.tell(f"{label}, at {history[-1]:.4f}")
        bar.advance()

    for k in range(_ROUNDS):
        settled = _settle(objective, u)
        before = objective.value(u)
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


def _polished(objective: Objective, climb: _Climb, ends: np.ndarray) -> Maximum:
    """Newton's steps at the end, as long as they rise: quasi-Newton ones stop where differences are rough."""
    u, value, history, steps = climb
    for _ in range(8):
        slope, hessian = objective.gradient(u), curvature(objective, u)
        rise, step = _newton(slope, hessian)
        if not rise > 1e-10:
            break
        new = u + step
        higher = objective.value(new)
        if not higher > value:
            break
        u, value, steps = new, higher, steps + 1
        history = np.append(history, higher)
    ends = np.append(max(ends[0], value), ends[1:])
    return Maximum(u, value, history, hessian, rise, steps, ends)


def _newton(slope: np.ndarray, hessian: np.ndarray) -> tuple[float, np.ndarray]:
    """How far Newton's step would rise, and the step, along directions that are curved.

    Along others (a number at the edge of its support, an angle of no account) the slope must be next to none.
    """
    nothing = float("nan"), np.zeros(len(slope))
    if not np.isfinite(hessian).all():
        return nothing
    values, vectors = np.linalg.eigh(-hessian)
    told = values > max(_FLAT, 1e-9 * values.max(initial=0.0))
    along = vectors.T @ slope
    if (values < -_FLAT).any() or (np.abs(along[~told]) > _SLOPE).any():
        return nothing
    step = along[told] / values[told]
    return float(0.5 * along[told] @ step), vectors[:, told] @ step
