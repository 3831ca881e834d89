"""A slice of any shape as a Gaussian, level by level: what nonlinear filters share.

The nodes of a slice are taken in levels: first those that read the slice before alone, then those that read
them, and so on. A *rule* looks at the nodes of one level as one function of what they read (a program, where
it can be followed) and makes it linear, with whatever it takes for the error as noise of its own: by
derivatives or by sigma points (``nonlinear``). What comes out are rows of coefficients of independent
normals, as the Kalman filter has them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.kalman.covariances import without_absent
from bayesmc.engines.kalman.passes import Ahead
from bayesmc.engines.kalman.reading import is_affine, typical_sizes
from bayesmc.engines.kalman.slices import Layout, Moments, covariance_root, put_noise
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import Expression, Leaf, Program, broadcast, expressions_of, leaf, ordered
from bayesmc.expression import rebuilt as made_of
from bayesmc.network import Model
from bayesmc.network.expressions import Opaque, density
from bayesmc.passes.derivatives import jumps, tangent
from bayesmc.passes.mean import mean


class Followed:
    """Nodes whose functions can be followed, as functions of what they read in the end.

    Parameters
    ----------
    model : Model
    nodes : sequence of str
    reads : iterable of str
        Nodes whose values move.
    known : iterable of str
        Nodes whose values are known.

    Raises
    ------
    TraceError
        A function cannot be followed.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.kalman.levels import Followed
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(np.sin(x), 0.1))
    >>> y = Followed(net.model(), ["y"], ["x"], [])
    >>> y.slopes({"x": np.array(0.0)}, {"x": np.ones(1)})
    [array([1.])]
    """

    def __init__(
        self, model: Model, nodes: Sequence[str], reads: Iterable[str], known: Iterable[str]
    ) -> None:
        self.nodes = [model[n] for n in nodes]
        self.reads = tuple(reads)
        given = {n for n in (*self.reads, *known) if n in model.nodes}
        cut = frozenset(n for n in given if model[n].kind == "deterministic")
        self.results = []
        for name in nodes:
            found = density(model, name, cut)
            if isinstance(found, Opaque):
                raise TraceError(found.reason)
            self.results.append(found.result)
        self._program = Program([e for r in self.results for e in expressions_of(r)])

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[Any]:
        """A distribution for each node, or its value if it is deterministic."""
        found = iter(self._program(values))
        return [made_of(result, found) for result in self.results]

    @property
    def has_slopes(self) -> bool:
        """Whether derivatives of the means are known."""
        return self._slopes is not None

    def slopes(
        self,
        values: Mapping[str, np.ndarray],
        directions: Mapping[str, np.ndarray],
        batch: tuple[int, ...] = (),
    ) -> list[np.ndarray] | None:
        """How the means move as what is read does.

        Parameters
        ----------
        values : dict
            With the batch, or without.
        directions : dict
            Of each node that is read, shape (directions, *batch, *value shape).

        Returns
        -------
        list of ndarray or None
            For each node, shape (directions, *batch, *value shape); None where a mean has no derivative that
            is known, or jumps just there.
        """
        if self._slopes is None:
            return None
        count = len(next(iter(directions.values())))
        moved = {_moved(n): d for n, d in directions.items()}
        *found, jumped = self._slopes({**values, **moved})
        if np.any(jumped):
            return None
        return [
            np.broadcast_to(slope, (count, *batch, *node.value_shape))
            for slope, node in zip(found, self.nodes, strict=True)
        ]

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _slopes(self) -> Program | None:
        try:
            means = [
                broadcast(mean(r) if node.is_stochastic else r, node.value_shape)
                for node, r in zip(self.nodes, self.results, strict=True)
            ]
            directions = {
                n.name: leaf(_moved(n.name), n.shape)
                for n in ordered(*means)
                if isinstance(n, Leaf) and n.name in self.reads
            }
            slopes: list[Expression] = [tangent(m, directions) for m in means]
            return Program([*slopes, jumps(means, self.reads)])
        except TraceError:
            return None


class Made(NamedTuple):
    """A level linearised.

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


#: makes a level linear, given mean ``(*lead, c)`` and rows ``(*lead, c, k)`` of the numbers that it reads
Rule = Callable[["Level", np.ndarray, np.ndarray], Made]


def expected_slice(ahead: Ahead, rule: Rule, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the numbers that a pattern chooses, and their coefficients of the noise."""
    layout, pattern = ahead.layout, ahead.pattern
    n, total = layout.n_prev, layout.n_prev + layout.p + layout.n
    lead = layout.lead
    mean, rows = np.zeros((*lead, total)), np.zeros((*lead, total, n))
    mean[..., :n], rows[..., :n, :] = ahead.mean, ahead.factor
    for part in plan.levels:
        level = Level(layout, part, ahead.values)
        made = rule(level, mean[..., part.reads], rows[..., part.reads, :])
        rows = np.concatenate([rows, np.zeros((*lead, total, made.fresh.shape[-1]))], axis=-1)
        mean[..., part.places] = made.mean
        rows[..., part.places, :] = np.concatenate([made.link, made.fresh], axis=-1)
    chosen = n + pattern.chosen
    rows = rows[..., chosen, :]
    if pattern.absent is not None:
        rows = without_absent(rows, pattern.absent)
    return mean[..., chosen], rows


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
    followed : Followed or None
        All of them as programs; None where a function cannot be followed.
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
    followed: Followed | None


class Plan:
    """The levels of a slice, of which ``values`` are what is known, to trace functions with.

    With ``seen_last`` all that is seen is a level of its own, after the others.
    """

    def __init__(
        self, layout: Layout, values: Mapping[str, np.ndarray], seen_last: bool = False
    ) -> None:
        self.layout, self.values = layout, values
        self.before = {n + PREVIOUS: n for n in layout.before}
        self.sources: dict[str, tuple[str, ...]] = {}
        depth: dict[str, int] = {}
        wanted = {*layout.rows, *layout.seen, *layout.silent}
        names = [n for n in layout.order if n in wanted]
        for name in names:
            self.sources[name] = self._sources(name)
            depth[name] = 1 + max(
                (depth[s] for s in self.sources[name] if s in layout.rows), default=-1
            )
        placed = [n for n in names if n not in layout.silent]
        if seen_last:
            depth.update(dict.fromkeys(layout.seen, len(names)))
        levels = sorted({depth[n] for n in placed})
        self.levels = [self._part([n for n in placed if depth[n] == d], names) for d in levels]

    def _sources(self, name: str) -> tuple[str, ...]:
        """Unknown numbers with a density, or of the slice before, that a function reads in the end."""
        found: dict[str, None] = {}
        for parent in self.layout.model[name].parents:
            if parent in self.before or parent in self.layout.drawn:
                found[parent] = None
            elif parent in self.layout.rows or parent in self.layout.silent:
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
            angles.append(layout.angles_of(stem))
            at += size
        places, turns = [], []
        for name in nodes:
            place = layout.seen[name] if name in layout.seen else layout.rows[name]
            start = place.start + n + (0 if name in layout.seen else p)
            places.append(np.arange(start, start + place.stop - place.start))
            turns.append(layout.angles_of(name))
        order = tuple(m for m in names if m in nodes or m in self._between(nodes))
        empty = np.zeros(0)
        return Part(
            tuple(nodes), order, columns,
            np.concatenate([empty, *reads]).astype(np.intp), np.concatenate(places),
            np.concatenate([empty, *sizes]), _some(turns), _some(angles),
            all(is_affine(layout, n, self.values) for n in nodes), self._followed(nodes, columns),
        )  # fmt: skip

    def _followed(self, nodes: list[str], columns: Iterable[str]) -> Followed | None:
        known = (*self.values, *self.layout.computed)
        try:
            return Followed(self.layout.model, nodes, columns, known)
        except TraceError:
            return None

    def _between(self, nodes: list[str]) -> set[str]:
        """Deterministic unknown nodes above some nodes."""
        model = self.layout.model

        def is_between(name: str) -> bool:
            return name in self.sources and not model[name].is_stochastic

        return set(filter(is_between, model.above(nodes, lambda n: n in nodes or is_between(n))))


class Level:
    """The nodes of a level as one function of what they read."""

    def __init__(self, layout: Layout, part: Part, known: Mapping[str, np.ndarray]) -> None:
        self.layout, self.part, self.known = layout, part, known

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, list[Moments]]:
        """Means at points, shape (points, *lead, c) -> (points, *lead, e), and the moments of each node."""
        layout, part = self.layout, self.part
        points = self._wrapped(points)
        values = dict(self.known)
        for name, place in part.columns.items():
            values[name] = layout.unpacked(layout.model[name], points[..., place])
        batch = points.shape[:1]
        if part.followed is not None:
            results = zip(part.followed.nodes, part.followed(values), strict=True)
            ordered = [layout.moments(node, result, batch) for node, result in results]
            return np.concatenate([m.mean for m in ordered], axis=-1), ordered
        found = {}
        for name in part.order:
            if name in layout.silent:
                values[name] = layout.model.evaluate(name, values)[0]
                continue
            result, own = layout.model.evaluate(name, values)
            made = layout.moments(layout.model[name], result, batch, own)
            if name in part.nodes:
                found[name] = made
            if not layout.model[name].is_stochastic:
                values[name] = layout.unpacked(layout.model[name], made.mean)
        ordered = [found[n] for n in part.nodes]
        return np.concatenate([m.mean for m in ordered], axis=-1), ordered

    def slopes(self, mean: np.ndarray, batch: tuple[int, ...] = ()) -> np.ndarray | None:
        """Derivatives of the means.

        Parameters
        ----------
        mean : ndarray, shape (*batch, *lead, c)
            Where they are wanted.

        Returns
        -------
        ndarray, shape (*batch, *lead, e, c), or None
            None where a function cannot be followed, or has no derivative here.
        """
        layout, part = self.layout, self.part
        if not part.columns:
            return np.zeros((*batch, *layout.lead, len(part.places), 0))
        if part.followed is None:
            return None
        points, c = self._wrapped(mean), mean.shape[-1]
        ones = (1,) * (len(batch) + len(layout.lead))
        unit = np.broadcast_to(np.eye(c).reshape(c, *ones, c), (c, *mean.shape))
        values, moves = dict(self.known), {}
        for name, place in part.columns.items():
            node = layout.model[name]
            values[name] = layout.unpacked(node, points[..., place])
            moves[name] = layout.unpacked(node, unit[..., place])
        found = part.followed.slopes(values, moves, batch)
        if found is None:
            return None
        packed = [layout.packed(n, s) for n, s in zip(part.followed.nodes, found, strict=True)]
        slopes = np.moveaxis(np.concatenate(packed, axis=-1), 0, -1)
        return slopes if np.isfinite(slopes).all() else None

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

    # ---- private -------------------------------------------------------------------------------

    def _wrapped(self, points: np.ndarray) -> np.ndarray:
        """Numbers as functions read them: angles in [-pi, pi)."""
        turns = self.part.read_turns
        return points if turns is None else np.where(turns, wrap_angle(points), points)


def why_not_matched(layout: Layout) -> str | None:
    """Why a slice cannot be matched by means and variances, or None."""
    model = layout.model
    for name in layout.silent:
        if name in layout.slices.interface:
            return (
                f"node {name!r} is hidden, takes no continuous values, and the next slice reads it"
            )
    for name in (n for n in layout.order if n in layout.rows or n in layout.seen):
        node = model[name]
        if node.domain is not None:
            what = "hidden and" if name in layout.rows else "observed, depends on hidden nodes and"
            return f"node {name!r} is {what} discrete"
        if not node.is_stochastic:
            continue
        if name in layout.rows and node.is_discrete and (reader := _reader(layout, name)):
            return f"node {name!r} is hidden and discrete, and {reader} reads it"
        try:
            why = _why_no_moments(model.evaluate(name, model.probe)[0])
        except BayesmcError as error:
            why = f"cannot be matched by its mean and variance ({error})"
        if why is not None:
            return f"node {name!r} {why}"
    return None


# ---- private ------------------------------------------------------------------------------------


def _moved(name: str) -> str:
    """The leaf for how a node's value moves."""
    return f"move of {name}"


def _why_no_moments(result: Any) -> str | None:
    root = covariance_root(result)
    if root is None and result.event_shape:
        return "is a vector of a family other than MvNormal that has no cov_root"
    spread = result.var if root is None else root
    if not (np.isfinite(result.mean).all() and np.isfinite(spread).all()):
        return "has no finite variance"
    return None


def _reader(layout: Layout, name: str) -> str | None:
    """What with a density reads a node, through functions or not; None of one that is only answered for."""
    below = {name}
    for other in layout.order:
        if below & set(layout.model[other].parents):
            if layout.model[other].is_stochastic:
                return f"node {other!r}"
            below.add(other)
    return "the next slice" if below & set(layout.slices.interface) else None


def _some(flags: list[np.ndarray]) -> np.ndarray | None:
    found = np.concatenate([np.zeros(0, dtype=bool), *flags])
    return found if found.any() else None
