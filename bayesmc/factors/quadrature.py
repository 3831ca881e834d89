"""A factor times a Gaussian cavity, by quadrature: along a line, on a lattice, at even points.

Panels of Gauss and Legendre between the points where a factor jumps or bends, lattices that are turned and
scaled as the product is in two and three dimensions, and beyond importance sampling. All say by how much a
coarser rule differs. Cavities are as in ``tilted``.

References
----------
Trefethen and Weideman (2014), The exponentially convergent trapezoidal rule, SIAM Review 56; Zoeter and
Heskes (2005), Gaussian quadrature based expectation propagation, AISTATS 10.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from scipy import special

from bayesmc.factors.tilted import Tilt
from bayesmc.gaussian import try_cholesky

_LOG_2PI = float(np.log(2.0 * np.pi))
#: nodes of a panel, and how many panels a stretch between two breaks is cut into; for comparison, too
_NODES, _PANELS, _FEWER = 12, 8, 5
#: logs below the largest that still count
_REACH = 42.0
#: times that a window is moved to where the mass is
_MOVES = 12
#: spacing and half-width of lattices, in standard deviations, by dimension
_LATTICE = {2: (0.4, 7.2), 3: (0.55, 6.6)}
#: spreads below this share of the spacing are the lattice's, not the product's
_FLOOR = 0.7
#: points of importance sampling, and how much wider than the belief they lie, in variances
_POINTS, _WIDER = 4096, 1.6
#: relative error of importance sampling with which it says nothing
_HOPELESS = 0.3

#: log factor at points, shape (points, *lead) each of k numbers: (points, *lead, k) -> (points, *lead)
LogFactor = Callable[[np.ndarray], np.ndarray]


def along_line(
    log_factor: LogFactor,
    precision: np.ndarray,
    linear: np.ndarray,
    near: tuple[np.ndarray, np.ndarray],
    breaks: np.ndarray | None = None,
) -> Tilt:
    """Any factor of one number, by quadrature.

    Parameters
    ----------
    log_factor : callable
    precision, linear : ndarray, shape (*lead)
    near : (ndarray, ndarray)
        A mean and a standard deviation to begin with, shape (*lead).
    breaks : ndarray, shape (*lead, b), optional
        Where the factor jumps or bends, in any order; between them it is smooth. NaN where there is none.

    Examples
    --------
    The half of a standard normal beyond zero, and one bent by a logistic function:

    >>> import numpy as np
    >>> from bayesmc.factors.quadrature import along_line
    >>> one = np.ones(1)
    >>> found = along_line(lambda u: np.where(u[..., 0] > 0, 0.0, -np.inf), one, 0 * one, (0 * one, one),
    ...                    np.zeros((1, 1)))
    >>> float((found.log - 0.5 * np.log(2 * np.pi))[0].round(9)), found.mean[0].round(9).tolist()
    (-0.693147181, [0.797884561])
    >>> found = along_line(lambda u: -np.logaddexp(0.0, -u[..., 0]), one, 0 * one, (0 * one, one))
    >>> found.error < 1e-6, found.mean[0].round(4).tolist()
    (True, [0.4132])
    """
    centre, spread = near
    low, high = centre - 10.0 * spread, centre + 10.0 * spread
    if breaks is not None and breaks.shape[-1]:
        inner = np.where(np.isnan(breaks), centre[..., None], breaks)
        low = np.minimum(low, inner.min(axis=-1) - 4.0 * spread)
        high = np.maximum(high, inner.max(axis=-1) + 4.0 * spread)
    for _ in range(_MOVES):
        u, log = _on_panels(log_factor, precision, linear, low, high, breaks)[:2]
        new_low, new_high = _window(u, log, low, high)
        width = high - low
        still = (np.abs(new_low - low) <= 0.25 * width) & (np.abs(new_high - high) <= 0.25 * width)
        low, high = new_low, new_high
        if still.all():
            break
    u, log, weight = _on_panels(log_factor, precision, linear, low, high, breaks)
    fine = _summed(u[..., None], log, weight)
    fine = fine._replace(log=np.where(_ends_in_time(u, log), fine.log, np.nan))
    rough = _summed(*_rough(log_factor, precision, linear, low, high, breaks))
    return fine._replace(error=_difference(fine, rough))


def on_lattice(
    log_factor: LogFactor,
    precision: np.ndarray,
    linear: np.ndarray,
    near: tuple[np.ndarray, np.ndarray],
) -> Tilt:
    """A smooth factor of two or three numbers, on a lattice turned and scaled as the product is.

    Parameters
    ----------
    log_factor : callable
    precision, linear : ndarray, shapes (*lead, k, k) and (*lead, k)
    near : (ndarray, ndarray)
        A mean and a covariance to begin with, shapes (*lead, k) and (*lead, k, k).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.quadrature import on_lattice
    >>> found = on_lattice(lambda u: -0.5 * ((u - 1.0) ** 2).sum(axis=-1), np.eye(2), np.zeros(2),
    ...                    (np.zeros(2), np.eye(2)))
    >>> found.mean.round(9).tolist(), abs(found.cov).round(9).tolist(), found.error < 1e-9
    ([0.5, 0.5], [[0.5, 0.0], [0.0, 0.5]], True)
    """
    mean, cov = near
    k = mean.shape[-1]
    step, reach = _LATTICE[k]
    axis = np.arange(-round(reach / step), round(reach / step) + 1) * step
    grid = np.stack(np.meshgrid(*[axis] * k, indexing="ij"), axis=-1).reshape(-1, k)
    coarse = (np.round(np.abs(grid) / step).astype(int) % 2 == 0).all(axis=-1)
    # parameters that over- or underflow far out have density zero there, as models have it
    far = (np.abs(grid).max(axis=-1) > 0.6 * reach).reshape(-1, *(1,) * (mean.ndim - 1))
    shape = (len(grid),) + (1,) * (mean.ndim - 1) + (k,)
    for turn in range(_MOVES):
        root, _ = try_cholesky(cov)
        widen = 1.0 if turn else 1.3
        u = mean + np.matvec(widen * root, grid.reshape(shape))
        log = log_factor(u) + np.vecdot(linear, u) - 0.5 * np.vecdot(u, np.matvec(precision, u))
        log = np.where(np.isnan(log) & far, -np.inf, log)
        scale = np.log(root.diagonal(0, -2, -1)).sum(axis=-1) + k * np.log(widen * step)
        fine = _summed(u, log, np.broadcast_to(scale, log.shape))
        rough = _summed(
            u[coarse], log[coarse], np.broadcast_to(scale + k * np.log(2.0), log.shape)[coarse]
        )
        moved = np.abs(fine.mean - mean) / np.sqrt(np.maximum(cov.diagonal(0, -2, -1), 1e-300))
        bent = np.abs(fine.cov / np.where(cov == 0, 1.0, cov) - 1.0).max(axis=(-2, -1))
        done = np.isnan(fine.log) | ((moved.max(axis=-1) < 0.3) & (bent < 0.5))
        good = np.isfinite(fine.log)
        coarsest = (_FLOOR * widen * step) ** 2
        held, grew = _held_wide(fine.cov, root, coarsest, good)
        done &= ~grew
        mean = np.where(good[..., None], fine.mean, mean)
        cov = np.where(good[..., None, None], held, cov)
        if done.all() and turn:
            break
    return fine._replace(error=_difference(fine, rough))


def importance(
    log_factor: LogFactor,
    precision: np.ndarray,
    linear: np.ndarray,
    near: tuple[np.ndarray, np.ndarray],
) -> Tilt:
    """A factor of many numbers, by points that lie evenly under a wider belief, weighted.

    ``error`` is the relative standard error of the integral, as of independent points: an upper bound mostly.

    Parameters
    ----------
    log_factor, precision, linear, near
        As of ``on_lattice``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.quadrature import importance
    >>> found = importance(lambda u: -0.5 * ((u - 1.0) ** 2).sum(axis=-1), np.eye(4), np.zeros(4),
    ...                    (np.zeros(4), np.eye(4)))
    >>> found.mean.round(1).tolist(), 0.0 < found.error < 0.05
    ([0.5, 0.5, 0.5, 0.5], True)
    """
    mean, cov = near
    k = mean.shape[-1]
    noise = _even_normals(k).reshape(-1, *(1,) * (mean.ndim - 1), k)
    for _ in range(3):
        root, _ = try_cholesky(_WIDER * cov)
        u = mean + np.matvec(root, noise)
        log = log_factor(u) + np.vecdot(linear, u) - 0.5 * np.vecdot(u, np.matvec(precision, u))
        size = np.log(root.diagonal(0, -2, -1)).sum(axis=-1) + 0.5 * k * _LOG_2PI
        weight = 0.5 * np.vecdot(noise, noise) + size - np.log(len(u))
        found = _summed(u, log, np.broadcast_to(weight, log.shape))
        share = np.exp(log + weight - np.where(np.isfinite(found.log), found.log, 0.0))
        error = np.sqrt(np.maximum((share**2).sum(axis=0) - 1.0 / len(u), 0.0))
        good = np.isfinite(found.log) & (error < 0.3)
        _, bad = try_cholesky(found.cov)
        good = good if bad is None else good & ~bad
        mean = np.where(good[..., None], found.mean, mean)
        cov = np.where(good[..., None, None], found.cov, cov)
    told = np.isfinite(found.log) & (error < _HOPELESS)  # else a few points are all there is
    found = found._replace(log=np.where(told, found.log, np.nan))
    return found._replace(error=float(error[told].max(initial=0.0)))


# ---- private ------------------------------------------------------------------------------------


def _legendre(panels: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and log weights on the unit interval, cut into panels."""
    x, w = np.polynomial.legendre.leggauss(_NODES)
    at = (np.arange(panels)[:, None] + 0.5 * (x + 1.0)) / panels
    return at.reshape(-1), np.log(np.tile(0.5 * w / panels, panels))


_FINE, _COARSE = _legendre(_PANELS), _legendre(_FEWER)


def _on_panels(
    log_factor: LogFactor, precision: np.ndarray, linear: np.ndarray, low: np.ndarray,
    high: np.ndarray, breaks: np.ndarray | None, rule: tuple[np.ndarray, np.ndarray] = _FINE,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Points, logs of the product there and log weights, shape (points, *lead)."""
    ends = [low[..., None], high[..., None]]
    if breaks is not None and breaks.shape[-1]:
        inside = np.clip(np.where(np.isnan(breaks), low[..., None], breaks), *ends)
        edges = np.sort(np.concatenate([ends[0], inside, ends[1]], axis=-1), axis=-1)
    else:
        edges = np.concatenate(ends, axis=-1)
    start, width = edges[..., :-1], np.diff(edges, axis=-1)
    at, log_w = rule
    u = start + width * at.reshape(-1, *[1] * start.ndim)
    with np.errstate(divide="ignore"):
        weight = np.log(width) + log_w.reshape(-1, *[1] * start.ndim)
    u, weight = (np.moveaxis(a, -1, 0).reshape(-1, *low.shape) for a in (u, weight))
    with np.errstate(all="ignore"):
        log = log_factor(u[..., None]) + (linear - 0.5 * precision * u) * u
    return u, np.where(weight == -np.inf, -np.inf, log), weight


def _rough(
    log_factor: LogFactor, precision: np.ndarray, linear: np.ndarray, low: np.ndarray,
    high: np.ndarray, breaks: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    u, log, weight = _on_panels(log_factor, precision, linear, low, high, breaks, _COARSE)
    return u[..., None], log, weight


def _window(
    u: np.ndarray, log: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the product is: shorter where most of a window is empty, longer where it ends too soon."""
    log = np.where(np.isnan(log), -np.inf, log)
    counts = log > log.max(axis=0) - _REACH
    order = np.sort(np.where(counts, u, np.inf), axis=0)[0]
    last = np.max(np.where(counts, u, -np.inf), axis=0)
    none = ~counts.any(axis=0)
    width = high - low
    gap = width / (_PANELS * 2.0)
    new_low = np.where(order - low < 0.02 * width, low - width, np.maximum(order - gap, low))
    new_high = np.where(high - last < 0.02 * width, high + width, np.minimum(last + gap, high))
    return np.where(none, low - width, new_low), np.where(none, high + width, new_high)


def _ends_in_time(u: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Whether the product is next to nothing at both ends of the window: it may have no integral."""
    log = np.where(np.isnan(log), -np.inf, log)
    top = log.max(axis=0)
    ends = [np.take_along_axis(log, f(u, axis=0)[None], axis=0)[0] for f in (np.argmin, np.argmax)]
    return np.maximum(*ends) < top - 0.4 * _REACH


def _summed(u: np.ndarray, log: np.ndarray, weight: np.ndarray) -> Tilt:
    """Integral and moments by a rule, the points as first axis."""
    with np.errstate(invalid="ignore"):
        total = log + weight
    top = total.max(axis=0)
    bad = ~np.isfinite(top)
    share = np.exp(np.where(bad, -np.inf, total - np.where(bad, 0.0, top)))
    whole = share.sum(axis=0)
    share = share / np.where(whole > 0, whole, 1.0)
    mean = (share[..., None] * u).sum(axis=0)
    off = u - mean
    if u.shape[-1] == 1:
        cov = (share[..., None] * off * off).sum(axis=0)[..., None]
    else:
        cov = np.einsum("p...,p...i,p...j->...ij", share, off, off)
    with np.errstate(divide="ignore"):
        found = np.log(whole) + np.where(bad, 0.0, top)
    found = np.where(top == -np.inf, -np.inf, np.where(bad, np.nan, found))
    return Tilt(found, mean, cov)


@functools.cache
def _even_normals(k: int) -> np.ndarray:
    """Points that lie evenly under a standard normal in k dimensions: an additive recurrence, whose steps are
    powers of the generalised golden ratio (Roberts 2018)."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1.0 + ratio) ** (1.0 / (k + 1))
    steps = ratio ** -np.arange(1.0, k + 1)
    return special.ndtri((0.5 + np.arange(1, _POINTS + 1)[:, None] * steps) % 1.0)


def _held_wide(
    cov: np.ndarray, root: np.ndarray, least: float, good: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances that are no narrower than a lattice of some spacing can tell, and which were."""
    inner = np.linalg.solve(root, np.matrix_transpose(np.linalg.solve(root, cov)))
    inner = np.where(good[..., None, None], inner, np.eye(cov.shape[-1]))
    sizes, axes = np.linalg.eigh(0.5 * (inner + np.matrix_transpose(inner)))
    narrow = np.asarray((sizes < least).any(axis=-1))
    if not narrow.any():
        return cov, narrow
    turned = root @ axes
    wide = (turned * np.maximum(sizes, least)[..., None, :]) @ np.matrix_transpose(turned)
    return np.where(narrow[..., None, None], wide, cov), narrow


def _difference(fine: Tilt, rough: Tilt) -> float:
    """How far two rules are apart, where there is an answer."""
    good = np.isfinite(fine.log) & np.isfinite(rough.log)
    if not good.any():
        return 0.0
    sd = np.sqrt(np.maximum(fine.cov.diagonal(0, -2, -1), 1e-300))
    apart = np.abs(fine.log - rough.log) + (np.abs(fine.mean - rough.mean) / sd).max(axis=-1)
    return float(apart[good].max())
