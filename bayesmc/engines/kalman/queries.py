"""What Gaussian beliefs say of nodes: joint covariances, quantiles, expectations of functions and events.

One unknown number is averaged over a line, several over point sets with a stated error; values that are known
go in as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.averages import as_event, called, over_normal, over_normals
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network.node import nodes_read
from bayesmc.results.posterior import quantile_levels


class Spreads(NamedTuple):
    """Covariances of the unknown numbers of every slice, kept as roots.

    Attributes
    ----------
    roots : ndarray, shape (kinds, [*lead], n, n)
    which : ndarray of int, shape (time,)
        Which root is a slice's.
    noise : ndarray, shape (time, [*lead], c, c), or None
        Covariance of the first c numbers that a root multiplies, where it is not the identity.
    """

    roots: np.ndarray
    which: np.ndarray
    noise: np.ndarray | None = None

    def covariances(self) -> np.ndarray:
        """Of all slices, shape (time, [*lead], n, n)."""
        if self.noise is None:
            return (self.roots @ np.matrix_transpose(self.roots))[self.which]
        left, alone, noise = self._parts(self.noise)
        return left @ noise @ np.matrix_transpose(left) + alone[self.which]

    def variances(self) -> np.ndarray:
        """Their diagonals, shape (time, [*lead], n)."""
        if self.noise is None:
            return np.vecdot(self.roots, self.roots)[self.which]
        left, alone, noise = self._parts(self.noise)
        return np.vecdot(left @ noise, left) + alone.diagonal(0, -2, -1)[self.which]

    def last(self, steps: int) -> Spreads:
        """Of the last so many slices."""
        noise = None if self.noise is None else self.noise[-steps:]
        return Spreads(self.roots, self.which[-steps:], noise)

    def _parts(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Roots on that noise by slice, covariances by the rest by kind, and the noise, of one dimension."""
        c = noise.shape[-1]
        left, rest = self.roots[..., :c], self.roots[..., c:]
        ndim = max(left.ndim, noise.ndim)
        left, alone, noise = (
            a.reshape(len(a), *(1,) * (ndim - a.ndim), *a.shape[1:])
            for a in (left, rest @ np.matrix_transpose(rest), noise)
        )
        return left[self.which], alone, noise


class View(NamedTuple):
    """Gaussian beliefs about some slices, as functions of nodes are averaged over them.

    Attributes
    ----------
    layout : Layout
    mean : ndarray, shape (steps, *lead, n)
    spreads : Spreads
        Of the unknown numbers.
    known : dict
        Node -> stored values, shape (steps, *value_shape).
    """

    layout: Layout
    mean: np.ndarray
    spreads: Spreads
    known: Mapping[str, np.ndarray]

    def last(self, steps: int) -> View:
        """Of the last so many slices."""
        known = {n: v[-steps:] for n, v in self.known.items()}
        return View(self.layout, self.mean[-steps:], self.spreads.last(steps), known)

    def cov(self, names: Sequence[str]) -> np.ndarray:
        """Joint covariances of nodes, one after the other, known ones with zeros, (steps, *lead, d, d)."""
        layout, at = self.layout, 0
        here: list[int] = []
        there: list[int] = []
        for name in names:
            size, place = layout.size(name), layout.rows.get(name)
            if place is not None:
                here += range(at, at + size)
                there += range(place.start, place.stop)
            at += size
        found = np.zeros((len(self.mean), *layout.lead, at, at))
        within = np.asarray(there, dtype=np.intp)
        part = self.spreads.covariances()[..., within[:, None], within]
        wide = part.reshape(len(part), *(1,) * (found.ndim - part.ndim), *part.shape[1:])
        index = np.asarray(here, dtype=np.intp)
        found[..., index[:, None], index] = wide
        return found


def on_circle(layout: Layout, name: str, value: np.ndarray) -> np.ndarray:
    """Angles in [-pi, pi); other numbers as they are."""
    angles = layout.angles_of(name)
    return np.where(angles, wrap_angle(value), value) if angles.any() else value


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
            value = on_circle(layout, name, numbers[..., start : start + size])
            value = layout.unpacked(node, value)
            start += size
        else:
            value = view.known[name][at]
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
