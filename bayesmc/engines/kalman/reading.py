"""A template as matrices: whether its slices are linear-Gaussian, and their coefficients.

Both are read off the expressions of the declared functions, for all slices at once. Functions that can be
followed only where the index of the slice, inputs or observed nodes are known are read slice by slice.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import nullcontext
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME
from bayesmc.engines.filtering import in_slice
from bayesmc.engines.kalman.slices import Layout, put_noise
from bayesmc.errors import ModelError, ParameterError, UnsupportedError
from bayesmc.structure.affine import Gains, LinearNode, NotLinearError, linear_node

#: numbers of coefficients that are worked out at once
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
    reasons = (why_not_placed(layout, name, values) for name in layout.placed)
    return next(
        (f"node {name!r} {why}" for name, why in zip(layout.placed, reasons, strict=True) if why),
        None,
    )


def why_not_placed(layout: Layout, name: str, values: Mapping[str, np.ndarray]) -> str | None:
    """Why a node with a place is not linear-Gaussian in what is unknown, to follow its name; or None."""
    node = layout.model[name]
    if node.is_stochastic and (node.is_discrete or node.domain is not None):
        return "is discrete and depends on continuous nodes that are hidden"
    if node.is_stochastic and len(node.event_shape) > 1:
        return f"is a matrix of shape {node.event_shape}"
    try:
        _linear(layout, name, values)
    except NotLinearError as error:
        return str(error)
    return None


def is_affine(layout: Layout, name: str, values: Mapping[str, np.ndarray]) -> bool:
    """Whether a node by itself is linear-Gaussian in unknown ones, or affine if deterministic."""
    try:
        _linear(layout, name, values)
    except NotLinearError:
        return False
    return True


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
        Some slice is not linear-Gaussian after all.
    ParameterError
    """
    static = layout.slices.template.static
    timed = {n: v for n, v in values.items() if n not in static}
    fixed = {n: v for n, v in values.items() if n in static}
    if not reads_time(layout):
        return _collapsed(layout, composed(layout, fixed | {n: v[0] for n, v in timed.items()}, ()))
    size = (layout.n_prev + layout.n) * max(layout.n + layout.p, 1) * max(
        int(np.prod(layout.lead)), 1
    )  # fmt: skip
    step = max(1, _ENTRIES // max(size, 1))
    parts = []
    for low in range(0, count, step):
        part = {n: v[low : low + step] for n, v in timed.items()}
        parts.append(_together(layout, fixed, part, min(step, count - low)))
    return _collapsed(layout, Linear(*(np.concatenate(p) for p in zip(*parts, strict=True))))


def reads_time(layout: Layout, still: Collection[str] = ()) -> bool:
    """Whether functions read what differs from slice to slice; what is known and ``still`` does not."""
    template = layout.slices.template
    changing = {TIME, TIME + PREVIOUS, *template.inputs, *(n + PREVIOUS for n in template.inputs)}
    free = {n + PREVIOUS for n in layout.before} | layout.unknown
    for name in layout.order:
        for parent in layout.model[name].parents:
            known = parent not in free and parent not in template.static and parent not in still
            if parent in changing or known:
                return True
    return False


def typical_sizes(layout: Layout, name: str) -> np.ndarray:
    """A power of two near the size of each number of a node."""
    node = layout.slices.first[name]
    probe = np.asarray(layout.slices.first.probe[name], dtype=float)
    probe = np.abs(np.broadcast_to(probe, np.broadcast_shapes(probe.shape, node.value_shape)))
    sizes = layout.packed(node, probe).reshape(-1, layout.size(name)).max(axis=0, initial=0.0)
    sizes = np.where((sizes > 0) & np.isfinite(sizes), sizes, 1.0)
    return 2.0 ** np.clip(np.round(np.log2(sizes)), -1000, 1000)


def composed(layout: Layout, known: dict[str, np.ndarray], batch: tuple[int, ...]) -> Linear:
    """Matrices for a batch of known values, or with ``()`` for one by itself, whose axis has length 1.

    Raises
    ------
    UnsupportedError, ParameterError
    """
    lead, n, total = layout.lead, layout.n_prev, layout.p + layout.n
    values = dict(known)
    for name in layout.computed:
        values[name] = layout.model.evaluate(name, values)[0]
    drawn = [np.arange(p.start, p.stop) for n, p in layout.rows.items() if n in layout.drawn]
    within = layout.p + np.concatenate([np.zeros(0, dtype=np.intp), *drawn])
    shape = (*(batch or (1,)), *lead)
    offset = np.zeros((*shape, total))
    rows = np.zeros((*shape, total, n + layout.p + len(within)))
    spent = n
    for name in layout.placed:
        place = layout.place(name)
        result, gains = _at_zero(layout, name, values)
        found = layout.moments(layout.model[name], result, batch)
        own = slice(spent, spent + found.mean.shape[-1])
        offset[..., place] = found.mean
        matrix = _matrix(layout, name, gains, batch)
        rows[..., place, :n] = matrix[..., :n]
        if len(within):
            inner = matrix[..., n:]
            offset[..., place] += np.matvec(inner, offset[..., within])
            rows[..., place, :] += inner @ rows[..., within, :]
        if found.scale is not None:
            put_noise(rows[..., place, own], found.scale if batch else found.scale[None])
            spent = own.stop
    return Linear(offset, rows[..., :n], rows[..., n:])


# ---- private ------------------------------------------------------------------------------------


def _linear(layout: Layout, name: str, values: Mapping[str, np.ndarray]) -> LinearNode:
    """A node as an affine function of unknown ones with a density, and of the slice before."""
    model = layout.model
    hidden = {n + PREVIOUS for n in layout.before}.union(layout.drawn)
    known = {n: np.asarray(v) for n, v in values.items() if n in model.nodes}
    leaves = frozenset(n for n in (*hidden, *known) if model[n].kind == "deterministic")
    return linear_node(model, name, hidden, leaves, known)


def _together(
    layout: Layout, fixed: dict[str, np.ndarray], timed: dict[str, np.ndarray], count: int
) -> Linear:
    """Slices at once, or one by one where functions do not take arrays of slices."""
    try:
        return composed(layout, fixed | timed, (count,))
    except (ModelError, ParameterError, UnsupportedError):  # one by one they say in which slice
        parts = []
        for k in range(count):
            with in_slice(int(timed[TIME][k])) if TIME in timed else nullcontext():
                parts.append(composed(layout, fixed | {n: v[k] for n, v in timed.items()}, ()))
        return Linear(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def _at_zero(
    layout: Layout, name: str, values: Mapping[str, np.ndarray]
) -> tuple[Any, dict[str, Gains]]:
    try:
        return _linear(layout, name, values)(values)
    except NotLinearError as error:
        raise UnsupportedError(f"node {name!r} {error}") from error


def _matrix(
    layout: Layout, name: str, gains: Mapping[str, Gains], batch: tuple[int, ...]
) -> np.ndarray:
    """Coefficients, shape (*batch, *lead, e, numbers before and unknown ones with a density)."""
    node = layout.model[name]
    sources = [(n + PREVIOUS, n) for n in layout.prev]
    sources += [(n, n) for n in layout.rows if n in layout.drawn]
    parts = [np.zeros((*batch, *layout.lead, layout.size(name), 0))]
    for called, stem in sources:
        width = layout.size(stem)
        part = np.zeros((*parts[0].shape[:-1], width))
        if called in gains:
            parent = layout.slices.first[stem]
            places = np.arange(int(np.prod(parent.value_shape))).reshape(parent.value_shape)
            column = np.empty(places.size, np.intp)
            column[layout.packed(parent, places)] = np.arange(width)
            found = gains[called]
            shape = (*batch, *node.value_shape, found.gain.shape[-1])
            gain = _by_row(layout, node, np.broadcast_to(found.gain, shape))
            into = _by_row(layout, node, np.broadcast_to(column[found.at], shape))
            index = np.arange(len(gain))[:, None] * width + into
            sums = np.bincount(index.reshape(-1), gain.reshape(-1), len(gain) * width)
            part = sums.astype(float).reshape(part.shape)
        parts.append(part)
    return np.concatenate(parts, axis=-1)


def _by_row(layout: Layout, node: Any, array: np.ndarray) -> np.ndarray:
    """What is said of a node's numbers, shape (*batch, *value shape, k), in the order of rows."""
    packed = layout.packed(node, np.moveaxis(array, -1, 0))
    return np.moveaxis(packed, 0, -1).reshape(-1, array.shape[-1])


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
