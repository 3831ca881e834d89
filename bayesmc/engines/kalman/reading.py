"""A template as matrices: whether its slices are linear-Gaussian, proved by tracing, and their coefficients.

That a mean is affine and a scale constant is proved by calling the functions with stand-ins, once for
slice 0 and once for a later slice. The coefficients come from the functions themselves, at a base point, one
step away along every direction, and at two more points that must agree; for all slices in one call where
functions read the index of the slice, inputs or observed nodes, and once where they do not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME
from bayesmc.distributions import Normal
from bayesmc.engines.filtering import in_slice
from bayesmc.engines.kalman.slices import Layout, Moments, put_noise
from bayesmc.errors import ModelError, ParameterError, UnsupportedError
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.node import Declaration
from bayesmc.structure.affine import affine_nodes, why_not_linear

_EPS = float(np.finfo(float).eps)
_CHECKS = 2
#: relative error of a prediction from the coefficients that rounding may explain
_TOLERANCE = 1e-8
#: numbers that one call of a function may make
_ENTRIES = 1 << 21


class Linear(NamedTuple):
    """Slices as matrices: all numbers are ``offset + moves @ before + noise @ (independent normals)``.

    The seen numbers come first, then the unknown ones. The axis for time has length 1 where nothing varies,
    and the axes of plates are left out of a matrix that is the same in all of them.

    Attributes
    ----------
    offset : ndarray, shape (time or 1, *lead, p + n)
    moves : ndarray, shape (time or 1, [*lead], p + n, n_prev)
    noise : ndarray, shape (time or 1, [*lead], p + n, q)
    """

    offset: np.ndarray
    moves: np.ndarray
    noise: np.ndarray


def why_not_gaussian(layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
    """Why a slice is not linear-Gaussian in what is unknown, or None.

    Parameters
    ----------
    values : dict
        Static nodes, inputs and nodes seen in full, of some slice.
    """
    for name in layout.drawn:
        node = layout.model[name]
        if node.domain is not None or node.is_discrete:
            return f"node {name!r} is hidden and discrete"
    for name in layout.silent:
        return f"node {name!r} is computed from hidden nodes and takes no continuous values"
    return why_not_linear(*_posed(layout, layout.order, values))


def is_affine(layout: Layout, name: str, values: Mapping[str, np.ndarray]) -> bool:
    """Whether a node by itself is proved linear-Gaussian in unknown ones, or affine if deterministic."""
    posed = _posed(layout, [name], values)
    if layout.model[name].is_stochastic:
        return why_not_linear(*posed) is None
    return name in affine_nodes(*posed)


def read_linear(layout: Layout, values: Mapping[str, np.ndarray], count: int) -> Linear:
    """Coefficients of slices that ``why_not_gaussian`` found no reason against.

    Parameters
    ----------
    values : dict
        Known values with time first: inputs and nodes seen in full; static nodes without time.
    count : int
        Number of slices.

    Raises
    ------
    UnsupportedError
        A mean is not affine, or a scale not constant, in some slice after all.
    ParameterError
    """
    static = layout.slices.template.static
    timed = {n: v for n, v in values.items() if n not in static}
    fixed = {n: v for n, v in values.items() if n in static}
    if not reads_time(layout):
        return _collapsed(
            layout, _composed(layout, fixed | {n: v[0] for n, v in timed.items()}, ())
        )
    stacked = {n: v[:, None] for n, v in timed.items()}
    size = (3 + layout.n_prev + layout.n) * max(layout.n + layout.p, 1) * max(
        int(np.prod(layout.lead)), 1
    )  # fmt: skip
    step = max(1, _ENTRIES // size)
    parts = []
    for low in range(0, count, step):
        high = min(low + step, count)
        part = {n: v[low:high] for n, v in stacked.items()}
        parts.append(_together(layout, fixed, part, high - low))
    return _collapsed(layout, Linear(*(np.concatenate(p) for p in zip(*parts, strict=True))))


# ---- proving ------------------------------------------------------------------------------------


def _posed(
    layout: Layout, names: Sequence[str], values: Mapping[str, np.ndarray]
) -> tuple[Model, dict[str, Observed], dict[str, np.ndarray]]:
    """A question about some nodes, as tracing of static nets takes it."""
    model = _traceable(layout, names)
    fixed = {n for n in model.nodes if model[n].kind in ("input", "fixed")}
    observed = {
        n: Observed(np.asarray(v)) for n, v in values.items() if n in model.nodes and n not in fixed
        and model[n].is_stochastic
    }  # fmt: skip
    return model, observed, {n: np.asarray(v) for n, v in values.items() if n in fixed}


def _traceable(layout: Layout, names: Sequence[str]) -> Model:
    """Some nodes' model, in which unknown numbers above them are free and what they do not need is out."""
    model, nodes = layout.model, {}
    before = {n + PREVIOUS for n in layout.before} | (set(layout.drawn) - set(names))
    wanted = _above(model, names, before)
    for name, node in model.nodes.items():
        if name in before or (name in wanted and name.endswith(PREVIOUS) and node.is_stochastic):
            nodes[name] = _free(node)
        elif name in wanted:
            nodes[name] = node
    return replace(model, nodes=nodes, potentials={}, cache={})


def _above(model: Model, names: Iterable[str], stop: Iterable[str]) -> set[str]:
    """Nodes, and those that their functions read, up to ``stop``."""
    found: set[str] = set()
    todo, stop = list(names), set(stop)
    while todo:
        name = todo.pop()
        if name in found or name in stop:
            continue
        found.add(name)
        if not (name.endswith(PREVIOUS) and model[name].is_stochastic):
            todo += model[name].parents
    return found


def _free(node: CompiledNode) -> CompiledNode:
    """The same values with nothing known of them."""
    declaration = Declaration(
        node.name, "function", (), node.plates, function=lambda: Normal(0.0, 1.0)
    )
    return CompiledNode(declaration, (), node.plate_shape, node.event_shape)


# ---- reading ------------------------------------------------------------------------------------


def reads_time(layout: Layout) -> bool:
    """Whether functions read what differs from slice to slice."""
    template = layout.slices.template
    changing = {TIME, TIME + PREVIOUS, *template.inputs, *(n + PREVIOUS for n in template.inputs)}
    free = {n + PREVIOUS for n in layout.before} | layout.unknown
    for name in layout.order:
        for parent in layout.model[name].parents:
            known = parent not in free and parent not in template.static
            if parent in changing or known:
                return True
    return False


def _together(
    layout: Layout, fixed: dict[str, np.ndarray], timed: dict[str, np.ndarray], count: int
) -> Linear:
    """Slices in one call each of their functions, or one by one where these do not take arrays of slices."""

    def one(k: int) -> Linear:
        with in_slice(int(timed[TIME][k, 0])) if TIME in timed else nullcontext():
            return _composed(layout, fixed | {n: v[k, 0] for n, v in timed.items()}, ())

    if count > 1:
        try:
            found = _composed(layout, fixed | timed, (count,))
        except (ModelError, ParameterError):  # one by one they say in which slice it is
            found = None
        if found is not None and all(_same(found, k, one(k)) for k in {0, count // 2, count - 1}):
            return found
    parts = [one(k) for k in range(count)]
    return Linear(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def _same(found: Linear, k: int, single: Linear) -> bool:
    """Whether slice k came out as it does by itself."""
    return all(
        np.allclose(a[k], b[0], rtol=1e-9, atol=1e-12 * (1 + np.abs(b[0]).max(initial=0.0)))
        for a, b in zip(found, single, strict=True)
    )


def _composed(layout: Layout, known: Mapping[str, np.ndarray], batch: tuple[int, ...]) -> Linear:
    """Matrices of ``count`` slices (``batch`` is ``(count,)``, or ``()`` for one by itself)."""
    lead, n, total = layout.lead, layout.n_prev, layout.p + layout.n
    columns = _Columns(layout)
    shape = (*(batch or (1,)), *lead)
    offset = np.zeros((*shape, total))
    rows = np.zeros((*shape, total, n + _noises(layout)))
    spent = n
    for name, place, found in _read(layout, known, batch, columns):
        mean, scale = found
        base, matrix = columns.coefficients(name, mean, scale, len(batch))
        own = slice(spent, spent + base.shape[-1])
        offset[..., place] = base
        rows[..., place, :n] = matrix[..., :n]
        if columns.drawn.size:
            within, at = matrix[..., n:], layout.p + columns.drawn
            offset[..., place] += np.matvec(within, offset[..., at])
            rows[..., place, :] += within @ rows[..., at, :]
        if scale is not None:
            put_noise(rows[..., place, own], np.asarray(columns.base(scale, mean, len(batch))))
            spent = own.stop
    return Linear(offset, rows[..., :n], rows[..., n:])


def _noises(layout: Layout) -> int:
    """Independent sources of chance in a slice."""
    return layout.p + sum(layout.size(n) for n in layout.drawn)


def _read(
    layout: Layout, known: Mapping[str, np.ndarray], batch: tuple[int, ...], columns: _Columns
) -> Iterator[tuple[str, slice, Moments]]:
    """Means and scales of the nodes of a slice at all points, parents first."""
    values = {**known, **columns.values()}
    full = (*batch, columns.count)
    for name in layout.order:
        if name in layout.certain:
            continue
        if name in layout.computed:
            values[name] = layout.model.evaluate(name, values)[0]
            continue
        found = layout.moments(name, values, full)
        if name in layout.seen:
            yield name, layout.seen[name], found
            continue
        place = layout.rows[name]
        yield name, slice(layout.p + place.start, layout.p + place.stop), found
        if not layout.model[name].is_stochastic:
            values[name] = layout.unpacked(layout.model[name], found.mean)


class _Columns:
    """The points at which functions are read: a base, a step along every unknown number, two to check."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        drawn = [np.arange(p.start, p.stop) for n, p in layout.rows.items() if n in layout.drawn]
        #: places of the numbers with a density among the unknown ones
        self.drawn = np.concatenate([np.zeros(0, dtype=np.intp), *drawn])
        self.steps = np.concatenate([np.zeros(0), *self._typical()])
        width = len(self.steps)
        self.count = 1 + width + _CHECKS
        turns = np.round(256 * np.sin(1.0 + np.arange(_CHECKS * width))) / 128
        signs = (-1.0) ** np.arange(_CHECKS)[:, None]
        self.moved = np.abs(turns.reshape(_CHECKS, width)) * self.steps * signs
        self.points = np.concatenate([np.zeros((1, width)), np.diag(self.steps), self.moved])

    def values(self) -> dict[str, np.ndarray]:
        """Stored values of the unknown nodes at all points."""
        layout, found = self.layout, {}
        names = [(n, n + PREVIOUS) for n in layout.prev] + [
            (n, n) for n in layout.rows if n in layout.drawn
        ]
        at = 0
        for name, called in names:
            size = layout.size(name)
            lead = (self.count,) + (1,) * len(layout.lead) + (size,)
            value = self.points[:, at : at + size].reshape(lead)
            value = np.broadcast_to(value, (self.count, *layout.lead, size))
            found[called] = layout.unpacked(layout.slices.first[name], value)
            at += size
        return found

    def base(self, array: np.ndarray, mean: np.ndarray, axis: int) -> np.ndarray:
        """What a function gives at the base point, an axis for time in front."""
        first = array[(slice(None),) * axis + (0,)]
        return first if axis else first[None]

    def coefficients(
        self, name: str, mean: np.ndarray, scale: np.ndarray | None, axis: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Offset and matrix of a node's mean, checked at the other points."""
        width = len(self.steps)
        points = np.moveaxis(mean if axis else mean[None], 1, -1)  # (time, *lead, e, points)
        base = points[..., 0]
        matrix = (points[..., 1 : 1 + width] - points[..., :1]) / self.steps
        if len(matrix) > 1:  # offsets that vary with time leave their rounding in what does not
            slack = 8 * _EPS * np.abs(points).max(axis=-1, keepdims=True) / self.steps
            same = (np.abs(matrix - matrix[:1]) <= slack).all(axis=0)
            matrix = np.where(same, matrix[:1], matrix)
        size = np.abs(base)[..., None] + np.abs(matrix) @ np.abs(self.moved).T
        wrong = np.abs(points[..., 1 + width :] - (base[..., None] + matrix @ self.moved.T))
        noise = 0.0 if scale is None else np.abs(scale).max(initial=0.0)
        if not (wrong <= _TOLERANCE * (size + noise)).all():
            raise UnsupportedError(f"node {name!r} has a mean that is not affine in what is hidden")
        if scale is not None:
            first = np.expand_dims(np.take(scale, 0, axis=axis), axis)
            if not (np.abs(scale - first) <= _TOLERANCE * np.abs(first).max(initial=0.0)).all():
                raise UnsupportedError(f"node {name!r} has a scale that depends on what is hidden")
        return base, matrix

    def _typical(self) -> list[np.ndarray]:
        """Powers of two near the size of each number's values, so that steps of them lose no digits."""
        layout = self.layout
        names = [*layout.prev, *(n for n in layout.rows if n in layout.drawn)]
        return [typical_sizes(layout, n) for n in names]


def typical_sizes(layout: Layout, name: str) -> np.ndarray:
    """A power of two near the size of each number of a node."""
    node = layout.slices.first[name]
    probe = np.asarray(layout.slices.first.probe[name], dtype=float)
    probe = np.abs(np.broadcast_to(probe, np.broadcast_shapes(probe.shape, node.value_shape)))
    sizes = layout.packed(node, probe).reshape(-1, layout.size(name)).max(axis=0, initial=0.0)
    sizes = np.where((sizes > 0) & np.isfinite(sizes), sizes, 1.0)
    return 2.0 ** np.clip(np.round(np.log2(sizes)), -1000, 1000)


def _collapsed(layout: Layout, found: Linear) -> Linear:
    """Without axes along which nothing varies."""
    arrays = []
    for array, tail in zip(found, (1, 2, 2), strict=True):
        if len(array) > 1 and (array == array[:1]).all():
            array = array[:1].copy()
        if tail == 2 and layout.lead:
            axes = tuple(range(1, 1 + len(layout.lead)))
            first = array[(slice(None),) + (slice(0, 1),) * len(axes)]
            if (array == first).all():
                array = first.reshape(len(array), *array.shape[-2:]).copy()
        arrays.append(array)
    return Linear(*arrays)
