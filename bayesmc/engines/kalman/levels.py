"""A slice of any shape as a Gaussian, level by level: what nonlinear filters share.

The nodes of a slice are taken in levels: first those that read the slice before alone, then those that read
them, and so on. A *rule* looks at the nodes of one level as one function of what they read and makes it
linear, with whatever it takes for the error as noise of its own: by derivatives (``extended_kalman``) or by
sigma points (``unscented_kalman``). What comes out are rows of coefficients of independent normals, as the
Kalman filter has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.distributions import MvNormal
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.passes import State
from bayesmc.engines.kalman.reading import is_affine, typical_sizes
from bayesmc.engines.kalman.slices import Layout, Moments, put_noise
from bayesmc.errors import BayesmcError


class Made(NamedTuple):
    """A level made linear.

    Attributes
    ----------
    mean : ndarray, shape (*lead, e)
    link : ndarray, shape (*lead, e, k)
        Coefficients of the noise that there was.
    fresh : ndarray, shape (*lead, e, j)
        Coefficients of new noise.
    """

    mean: np.ndarray
    link: np.ndarray
    fresh: np.ndarray


class Rule(Protocol):
    """How a level is made linear."""

    def __call__(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """``mean``, shape (*lead, c), and ``rows``, shape (*lead, c, k), are of the numbers that it reads."""
        ...


def expected_slice(
    layout: Layout,
    values: Mapping[str, np.ndarray],
    state: State,
    pattern: Pattern,
    rule: Rule,
    plan: Plan,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the numbers that a pattern chooses, and their coefficients of the noise."""
    n, total = layout.n_prev, layout.n_prev + layout.p + layout.n
    lead = layout.lead
    mean, rows = np.zeros((*lead, total)), np.zeros((*lead, total, n))
    mean[..., :n], rows[..., :n, :] = state.mean, state.factor
    known = dict(values)
    for name in layout.computed:
        known[name] = layout.model.evaluate(name, known)[0]
    for part in plan.levels:
        level = Level(layout, part, known)
        made = rule(level, mean[..., part.reads], rows[..., part.reads, :])
        rows = np.concatenate([rows, np.zeros((*lead, total, made.fresh.shape[-1]))], axis=-1)
        mean[..., part.places] = made.mean
        rows[..., part.places, :] = np.concatenate([made.link, made.fresh], axis=-1)
    chosen = n + pattern.chosen
    rows = rows[..., chosen, :]
    if pattern.absent is not None:
        rows = without_absent(rows, pattern.absent)
    return mean[..., chosen], rows


def without_absent(rows: np.ndarray, absent: np.ndarray) -> np.ndarray:
    """Rows of what some elements lack as noise of their own, which tells nothing."""
    p = absent.shape[-1]
    rows[..., :p, :] = np.where(absent[..., None], 0.0, rows[..., :p, :])
    fresh = np.zeros((*rows.shape[:-1], p))
    index = np.arange(p)
    fresh[..., index, index] = absent
    return np.concatenate([rows, fresh], axis=-1)


class Part(NamedTuple):
    """One level of a plan.

    Attributes
    ----------
    nodes : tuple of str
        In the order of ``places``.
    order : tuple of str
        What is evaluated, parents first: these nodes and the deterministic ones between them and what they
        read.
    columns : dict
        What is read, by the name under which functions know it -> its place among ``reads``.
    reads, places : ndarray of int
        Among the slice before, the seen and the unknown numbers.
    sizes : ndarray
        Typical sizes of what is read.
    turns : ndarray of bool or None
        Which of the numbers made are angles.
    read_turns : ndarray of bool or None
        Which of the numbers read are.
    affine : bool
        Whether all nodes are proved affine in what they read.
    """

    nodes: tuple[str, ...]
    order: tuple[str, ...]
    columns: dict[str, slice]
    reads: np.ndarray
    places: np.ndarray
    sizes: np.ndarray
    turns: np.ndarray | None
    read_turns: np.ndarray | None
    affine: bool


class Plan:
    """The levels of a slice, of which ``values`` are what is known, to trace functions with."""

    def __init__(self, layout: Layout, values: Mapping[str, np.ndarray]) -> None:
        self.layout, self.values = layout, values
        self.before = {n + PREVIOUS: n for n in layout.before}
        self.sources: dict[str, tuple[str, ...]] = {}
        depth: dict[str, int] = {}
        wanted = {*layout.rows, *layout.seen}
        names = [n for n in layout.order if n in wanted]
        for name in names:
            self.sources[name] = self._sources(name)
            depth[name] = 1 + max(
                (depth[s] for s in self.sources[name] if s in layout.rows), default=-1
            )
        levels = sorted(set(depth.values()))
        self.levels = [self._part([n for n in names if depth[n] == d], names) for d in levels]

    def _sources(self, name: str) -> tuple[str, ...]:
        """Unknown numbers with a density, or of the slice before, that a function reads in the end."""
        found: dict[str, None] = {}
        for parent in self.layout.model[name].parents:
            if parent in self.before or parent in self.layout.drawn:
                found[parent] = None
            elif parent in self.layout.rows:
                found.update(dict.fromkeys(self.sources[parent]))
        return tuple(found)

    def _part(self, nodes: list[str], names: list[str]) -> Part:
        layout, n, p = self.layout, self.layout.n_prev, self.layout.p
        columns, reads, sizes, angles, at = {}, [], [], [], 0
        for source in dict.fromkeys(s for name in nodes for s in self.sources[name]):
            stem = self.before.get(source, source)
            place = layout.prev[stem] if source in self.before else layout.rows[stem]
            start = place.start if source in self.before else place.start + n + p
            size = place.stop - place.start
            columns[source] = slice(at, at + size)
            reads.append(np.arange(start, start + size))
            sizes.append(typical_sizes(layout, stem))
            angles.append(np.full(size, layout.is_angle(stem)))
            at += size
        places, turns = [], []
        for name in nodes:
            place = layout.seen[name] if name in layout.seen else layout.rows[name]
            start = place.start + n + (0 if name in layout.seen else p)
            places.append(np.arange(start, start + place.stop - place.start))
            turns.append(np.full(place.stop - place.start, layout.is_angle(name)))
        order = tuple(m for m in names if m in nodes or m in self._between(nodes))
        empty = np.zeros(0)
        return Part(
            tuple(nodes), order, columns,
            np.concatenate([empty, *reads]).astype(np.intp), np.concatenate(places),
            np.concatenate([empty, *sizes]), _some(turns), _some(angles),
            all(is_affine(layout, n, self.values) for n in nodes),
        )  # fmt: skip

    def _between(self, nodes: list[str]) -> set[str]:
        """Deterministic unknown nodes above some nodes."""
        found: set[str] = set()
        todo = list(nodes)
        while todo:
            for parent in self.layout.model[todo.pop()].parents:
                if parent in self.layout.rows and parent not in self.layout.drawn:
                    if parent not in found:
                        found.add(parent)
                        todo.append(parent)
        return found


class Level:
    """The nodes of a level as one function of what they read."""

    def __init__(self, layout: Layout, part: Part, known: Mapping[str, np.ndarray]) -> None:
        self.layout, self.part, self.known = layout, part, known

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, list[Moments]]:
        """Means at points, shape (points, *lead, c) -> (points, *lead, e), and the moments of each node."""
        layout, part = self.layout, self.part
        if part.read_turns is not None:
            points = np.where(part.read_turns, wrap_angle(points), points)
        values = dict(self.known)
        for name, place in part.columns.items():
            node = layout.model[name]
            values[name] = layout.unpacked(node, points[..., place])
        batch = points.shape[:1]
        found = {}
        for name in part.order:
            made = layout.moments(name, values, batch)
            if name in part.nodes:
                found[name] = made
            if not layout.model[name].is_stochastic:
                values[name] = layout.unpacked(layout.model[name], made.mean)
        ordered = [found[n] for n in part.nodes]
        return np.concatenate([m.mean for m in ordered], axis=-1), ordered

    def off(self, found: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Differences between numbers made, those of angles the short way round."""
        off = found - centre
        turns = self.part.turns
        return off if turns is None else np.where(turns, wrap_angle(off), off)

    def noise(self, scales: list[np.ndarray | None]) -> np.ndarray:
        """Rows of the nodes' own noise, shape (*lead, e, e), from the scale of each."""
        count = len(self.part.places)
        rows = np.zeros((*self.layout.lead, count, count))
        at = 0
        for name, scale in zip(self.part.nodes, scales, strict=True):
            own = slice(at, at + self.layout.size(name))
            if scale is not None:
                put_noise(rows[..., own, own], scale)
            at = own.stop
        return rows


def why_not_matched(layout: Layout) -> str | None:
    """Why a slice cannot be matched by means and variances, or None."""
    model = layout.model
    for name in (n for n in layout.order if n in layout.rows or n in layout.seen):
        node = model[name]
        if node.domain is not None:
            what = "hidden and" if name in layout.rows else "observed, depends on hidden nodes and"
            return f"node {name!r} is {what} discrete"
        if not node.is_stochastic:
            continue
        if name in layout.rows and node.is_discrete:
            return f"node {name!r} is hidden and discrete"
        try:
            result, _ = model.evaluate(name, model.probe)
            if isinstance(result, MvNormal):
                continue
            if node.event_shape:
                return f"node {name!r} is a vector of a family other than MvNormal"
            if not (np.isfinite(result.mean) & np.isfinite(result.var)).all():
                return f"node {name!r} has no finite variance"
        except BayesmcError as error:
            return f"node {name!r} cannot be matched by its mean and variance ({error})"
    return None


# ---- private ------------------------------------------------------------------------------------


def _some(flags: list[np.ndarray]) -> np.ndarray | None:
    found = np.concatenate([np.zeros(0, dtype=bool), *flags])
    return found if found.any() else None
