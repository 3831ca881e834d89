"""Expectations of functions of nodes under Gaussian beliefs, and probabilities of events.

One unknown number is averaged over a line, several over point sets with a stated error; values that are known
go in as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.special import ndtri

from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.averages import as_event, called, over_normal, over_normals
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network.node import nodes_read
from bayesmc.results.posterior import quantile_levels


class Spread(Protocol):
    """Covariances of some slices."""

    def covariances(self) -> np.ndarray:
        """Of the unknown numbers, shape (steps, [*lead], n, n)."""
        ...


@dataclass(frozen=True, eq=False)
class View:
    """Gaussian beliefs about some slices, as functions of nodes are averaged over them.

    Attributes
    ----------
    layout : Layout
    mean : ndarray, shape (steps, *lead, n)
    spreads : object
        Whose ``covariances()`` are those of the unknown numbers, shape (steps, [*lead], n, n).
    known : dict
        Node -> stored values, shape (steps, *value_shape); static ones without time.
    """

    layout: Layout
    mean: np.ndarray
    spreads: Spread
    known: Mapping[str, np.ndarray]

    def last(self, steps: int, spreads: Spread) -> View:
        """Of the last so many slices, with their covariances."""
        nodes = self.layout.slices.first
        known = {
            n: v[-steps:] if v.ndim > len(nodes[n].value_shape) else v
            for n, v in self.known.items()
        }
        return View(self.layout, self.mean[-steps:], spreads, known)


def expectation(
    view: View, function: Callable[..., Any], event: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Averages in every slice, shape ``(steps, *what one value has)``, and their standard errors.

    Raises
    ------
    UnknownNodeError, UnsupportedError, QueryError
    """
    layout = view.layout
    names = nodes_read(function)
    for name in names:
        if name in layout.silent:
            raise UnsupportedError(
                f"a query reads {name!r}, which takes no continuous values, and a Gaussian belief does not "
                "answer for it; use a ParticleFilter"
            )
        if name not in layout.rows and name not in view.known:
            raise UnknownNodeError(
                f"a query reads {name!r}, which is no node of a slice; there are "
                f"{[*layout.rows, *view.known]}"
            )
    own = [n for n in names if n in layout.rows]
    spots = [np.arange(layout.rows[n].start, layout.rows[n].stop) for n in own]
    places = np.concatenate([np.zeros(0, dtype=np.intp), *spots])
    dimension, steps = len(places), len(view.mean)

    if not dimension:
        numbers = np.zeros((steps, *layout.lead, 0))
        values = _called(view, function, names, np.arange(steps), numbers, event).astype(float)
        return values, np.zeros(values.shape)
    covariances = view.spreads.covariances()[..., places[:, None], places]
    if covariances.ndim < 3 + len(layout.lead):
        covariances = covariances.reshape(steps, *(1,) * len(layout.lead), *covariances.shape[-2:])
    roots, plain = _roots(covariances)

    def averaged(chosen: np.ndarray, several: bool) -> tuple[np.ndarray, np.ndarray]:
        """Over one number each, or several, in some slices."""

        def evaluate(at: np.ndarray, points: np.ndarray) -> np.ndarray:
            at = chosen[at]
            z = points.reshape(len(at), *(1,) * len(layout.lead), -1)
            off = np.matvec(roots[at], z) if several else roots[at][..., -1] * z
            numbers = view.mean[at][..., places] + off
            return _called(view, function, names, at, numbers, event)

        if several:
            mean, error = over_normals(evaluate, len(chosen), dimension)
        else:
            mean, error = over_normal(evaluate, len(chosen))
        varies = roots[chosen].any(axis=(-2, -1))  # what is known is seen at its only point
        return mean, np.where(
            varies.reshape(varies.shape + (1,) * (mean.ndim - varies.ndim)), error, 0.0
        )

    found: tuple[Any, Any] = (None, None)
    for several in (False, True):
        chosen = np.flatnonzero(plain != several)
        if not len(chosen):
            continue
        parts = averaged(chosen, several)
        if found[0] is None:
            found = (np.empty((steps, *parts[0].shape[1:])), np.empty((steps, *parts[1].shape[1:])))
        for whole, part in zip(found, parts, strict=True):
            whole[chosen] = part
    return found


def quantiles(mean: np.ndarray, std: np.ndarray, q: Any, name: str) -> np.ndarray:
    """Quantiles of normal numbers, shape ``(steps, *q.shape, *rest)``."""
    levels = quantile_levels(name, q)
    rest = mean.ndim - 1
    lead = (len(mean), *(1,) * levels.ndim, *mean.shape[1:])
    z = ndtri(levels).reshape(1, *levels.shape, *(1,) * rest)
    with np.errstate(invalid="ignore"):
        spread = std.reshape(lead) * z
    return mean.reshape(lead) + np.where(std.reshape(lead) > 0, spread, 0.0)


# ---- private ------------------------------------------------------------------------------------


def _called(
    view: View,
    function: Callable[..., Any],
    names: tuple[str, ...],
    at: np.ndarray,
    numbers: np.ndarray,
    event: bool,
) -> np.ndarray:
    """A function's values at numbers, shape ``(count, *lead, dimension)``, of slices ``at``."""
    layout, start = view.layout, 0
    arguments = []
    for name in names:
        node = layout.slices.first[name]
        if name in layout.rows:
            size = layout.size(name)
            value = numbers[..., start : start + size]
            angles = layout.angles_of(name)
            if angles.any():
                value = np.where(angles, wrap_angle(value), value)
            value = layout.unpacked(node, value)
            start += size
        else:
            known = view.known[name]
            timed = known.ndim > len(node.value_shape)
            value = known[at] if timed else np.broadcast_to(known, (len(at), *known.shape))
        arguments.append(node.decode(value))
    with marking_invalid(), np.errstate(all="ignore"):
        values = np.asarray(called(function, arguments))
    if values.shape[: 1 + len(layout.lead)] != (len(at), *layout.lead):
        more = f", the plates {layout.apart} next" if layout.apart else ""
        raise QueryError(
            f"a query returns shape {values.shape}; it must return one value per point, the axis of "
            f"{len(at)} points first{more}"
        )
    return as_event(values) if event else values


def _roots(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roots of covariances, largest columns last, and where one column is all there is.

    Numbers of unlike units count alike: what is small beside others is judged on the correlations.
    """
    spread = np.sqrt(np.clip(np.linalg.diagonal(covariances), 0.0, None))
    unit = np.where(spread > 0, spread, 1.0)
    values, vectors = np.linalg.eigh(covariances / unit[..., :, None] / unit[..., None, :])
    values = np.clip(values, 0.0, None)
    rest = values[..., :-1].sum(axis=-1) <= 1e-14 * values[..., -1]
    plain = rest.reshape(len(values), -1).all(axis=1)
    return spread[..., :, None] * vectors * np.sqrt(values)[..., None, :], plain
