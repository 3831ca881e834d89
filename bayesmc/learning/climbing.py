"""From starts to the highest maximum, and how sharp it is: quasi-Newton steps, then the curvature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.learning.objectives import Objective

#: starts that are tried, of which the best are climbed from
_TRIED, _CLIMBED = 32, 3
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
    """

    u: np.ndarray
    value: float
    history: np.ndarray
    hessian: np.ndarray
    rise: float
    steps: int

    @property
    def converged(self) -> bool:
        return bool(self.rise < _RISE)


def maximum(
    objective: Objective, starts: np.ndarray, tolerance: float, max_iterations: int
) -> Maximum:
    """The highest of the maxima that climbs from the best starts find.

    Raises
    ------
    UnsupportedError
        The evidence cannot be told at any start.
    """
    from scipy.optimize import minimize

    heights = np.array([objective.value(u) for u in starts[:_TRIED]])
    if not np.isfinite(heights).any():
        refused = getattr(objective, "refused", None)
        why = f": {refused}" if refused is not None else ""
        raise UnsupportedError(
            f"fit: the data have no probability at any of {len(heights)} starts{why}; give start= "
            "values that "
            "explain them"
        )
    best: tuple[np.ndarray, float, np.ndarray, int] | None = None
    for at in np.argsort(-heights)[: 1 if len(starts) == 1 else _CLIMBED]:
        if not np.isfinite(heights[at]):
            continue
        history = [heights[at]]

        def note(u: np.ndarray, kept: list[float] = history) -> None:
            kept.append(objective.value(u))

        found = minimize(
            lambda u: min(-objective.value(u), 1e300),
            starts[at],
            jac=lambda u: -objective.gradient(u),
            method="BFGS",
            callback=note,
            options={"gtol": tolerance, "maxiter": max_iterations},
        )
        if best is None or -found.fun > best[1]:
            best = (found.x, float(-found.fun), np.array(history), int(found.nit))
    assert best is not None
    return _polished(objective, *best)


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


def _polished(
    objective: Objective, u: np.ndarray, value: float, history: np.ndarray, steps: int
) -> Maximum:
    """Newton's steps at the end, as long as they rise: quasi-Newton ones stop where differences are rough."""
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
    return Maximum(u, value, history, hessian, rise, steps)


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
