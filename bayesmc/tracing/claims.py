"""What is certain of a result besides being affine: a power, a copy, whole events, places that are read.

Every rule answers with ``Claims`` and the names of the sources; what no rule covers claims nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.tracing.axes import (
    KEPT,
    Span,
    behind_after,
    function_behind,
    function_span,
    index_span,
    operands,
    ufunc_behind,
)
from bayesmc.tracing.standin import Claims, StandIn, is_traced

#: ufuncs of one argument that raise it to a power, up to a constant factor
_POWERS = {
    np.positive: 1.0, np.negative: 1.0, np.square: 2.0, np.sqrt: 0.5, np.cbrt: 1 / 3,
    np.reciprocal: -1.0, np.absolute: 1.0, np.fabs: 1.0,
}  # fmt: skip
#: functions that move the elements of their first argument about (an array, or a sequence of arrays)
_MOVERS = frozenset(
    (
        np.stack, np.concatenate, np.vstack, np.hstack, np.dstack, np.column_stack, np.broadcast_to,
        np.copy, np.reshape, np.ravel, np.transpose, np.matrix_transpose, np.squeeze, np.expand_dims,
        np.moveaxis, np.swapaxes, np.rollaxis, np.repeat, np.tile, np.take, np.take_along_axis,
        np.flip, np.flipud, np.fliplr, np.rot90, np.roll, np.atleast_1d, np.atleast_2d, np.atleast_3d,
        np.diagonal, np.split, np.array_split, np.linalg.diagonal, np.linalg.matrix_transpose,
    )
)  # fmt: skip
#: of these, what leaves every element in its place, counted from the right
_STILL = frozenset((np.broadcast_to, np.copy))
_MANY = frozenset((np.split, np.array_split))

Known = tuple[frozenset[str], Claims]


def at_first(
    value: np.ndarray, sources: frozenset[str], reason: str | None, event_ndim: int
) -> Claims:
    """What is certain of a source itself."""
    known = reason is None and len(sources) == 1
    whole = event_ndim == 0 or (known and value.ndim >= event_ndim)
    power = 1.0 if known else None
    return Claims(power, known, event_ndim, whole, object() if known else None, event_ndim)


def after_ufunc(
    ufunc: Any, method: str, inputs: Any, kwargs: Any, result: Any, traced: list[StandIn]
) -> Known:
    """Sources and claims of what a ufunc makes of its inputs."""
    found = _with_places(traced)
    behind = ufunc_behind(ufunc, method, inputs, kwargs, found, result) if found else 0
    claims = Claims()
    plain = method == "__call__" and not kwargs and isinstance(result, (np.ndarray, np.float64))
    direct = [x for x in inputs if isinstance(x, StandIn)]
    if plain and len(direct) == len(traced) and np.asarray(result).dtype == np.float64:
        claims = _power(ufunc, inputs, direct)
    if ufunc is np.positive and plain and direct:
        claims = direct[0].claims
    return _joined(traced, claims, behind)


def after_function(func: Any, args: Any, kwargs: Any, result: Any, traced: list[StandIn]) -> Known:
    """Sources and claims of what a NumPy function makes of its arguments."""
    found = _with_places(traced)
    behind = function_behind(func, args, kwargs, found, result) if found else 0
    return _joined(traced, _moved(func, args, kwargs, result, traced), behind)


def after_index(value: StandIn, key: Any, result: np.ndarray) -> Known:
    """Sources and claims of what a key without anything traced picks."""
    span = index_span(key, value.ndim)
    old = value.claims
    whole = old.whole_event and _spares(span, value.ndim, old.event_ndim)
    form = (old.form, value.shape, repr(key)) if old.form and _is_plain(key) else object()
    new = Claims(old.power, old.is_copy, old.event_ndim, whole, form)
    behind = behind_after(span, value, result.ndim) if old.places else 0
    return _joined([value], new, behind)


def after_mixing(traced: list[StandIn]) -> Known:
    """Sources and claims of what may be anything."""
    return _joined(traced, Claims(), None)


def after_cast(value: StandIn, exact: bool) -> Known:
    """Sources and claims of the same numbers in another type."""
    return _joined([value], value.claims if exact else Claims(), value.claims.behind)


def as_whole(value: StandIn) -> tuple[frozenset[str], Claims, dict[str, str]]:
    """A source that may be read all over, and its names where it turns out to be read at places only."""
    old = value.claims
    final = {s: old.places.get(s, s) for s in value.sources if s in old.places or s in old.spread}
    names = {f"{s}[*]": s for s in value.sources if s not in final}
    sources = frozenset((*names, *final.values()))
    claims = Claims(
        old.power, old.is_copy, old.event_ndim, old.whole_event, old.form, 0, {}, sources
    )
    return sources, claims, names


def looked_up(
    array: StandIn, result: StandIn, names: Mapping[str, str], event_ndim: int, where: Any
) -> Known:
    """Sources and claims of elements gathered from an array, some of whose sources are renamed."""
    old = array.claims
    places = {new: whole for whole, new in names.items() if whole in array.sources}
    kept = {result.claims.places.get(s, s) for s in result.sources if s not in names}
    whole = old.event_ndim == 0 or (old.whole_event and old.event_ndim == event_ndim)
    form = (old.form, array.shape, where) if old.form is not None else None
    spread = frozenset(kept & (old.spread | result.claims.spread))
    spread |= frozenset(result.claims.places.values()) & kept
    claims = Claims(old.power, old.is_copy, old.event_ndim, whole, form, event_ndim, places, spread)
    return frozenset((*places, *kept)), claims


# ---- private ------------------------------------------------------------------------------------


def _with_places(traced: list[StandIn]) -> list[StandIn]:
    """Those that read sources at places, as often as they come in."""
    return [x for x in traced if x.claims.places]


def _joined(traced: list[StandIn], claims: Claims, behind: int | None) -> Known:
    """Sources of values together; read all over where plates may have mixed (``behind`` is None)."""
    sources = frozenset().union(*(t.sources for t in traced))
    spread = frozenset().union(*(t.claims.spread for t in traced))
    places = {s: whole for t in traced for s, whole in t.claims.places.items()}
    if places and behind is None:
        sources = frozenset(places.get(s, s) for s in sources)
        spread, places, behind = spread | frozenset(places.values()), {}, 0
    event_ndim = max((t.claims.event_ndim for t in traced), default=0)
    power = claims.power if len(sources) == 1 else None
    nothing = power is None and not claims.is_copy
    whole = event_ndim == 0 or (claims.whole_event and not nothing)
    form = None if nothing else claims.form
    return sources, Claims(
        power, claims.is_copy, event_ndim, whole, form, behind or 0, places, spread
    )


def _power(ufunc: Any, inputs: Any, direct: list[StandIn]) -> Claims:
    """A ufunc of powers, element by element."""
    first = direct[0].claims
    if any(x.claims.power is None for x in direct):
        return Claims()
    assert first.power is not None
    power, whole, form = 0.0, first.whole_event, first.form
    if ufunc in _POWERS:
        power = first.power * _POWERS[ufunc]
    elif ufunc in (np.power, np.float_power):
        # any other exponent may be a parent's value that happens to be so
        if len(direct) == 1 and direct[0] is inputs[0] and type(inputs[1]) in (int, float):
            power = first.power * inputs[1]
    elif ufunc in (np.multiply, np.true_divide):
        sign = 1.0 if ufunc is np.multiply else -1.0
        if len(direct) == 1:
            power = first.power * (1.0 if direct[0] is inputs[0] else sign)
            other = inputs[1] if direct[0] is inputs[0] else inputs[0]
            whole = whole and _is_flat(other, first.event_ndim)
        elif _aligned(*direct):
            second = direct[1].claims
            assert second.power is not None
            power = first.power + sign * second.power
            whole = whole and second.whole_event
    known = power != 0.0 and math.isfinite(power)
    return Claims(power, False, 0, whole, form) if known else Claims()


def _aligned(first: StandIn, second: StandIn) -> bool:
    """Whether equal places of two values hold powers of the same element of the same source."""
    form = first.claims.form
    same = form is not None and form == second.claims.form
    return same and first.sources == second.sources and first.ndim == second.ndim


def _moved(func: Any, args: Any, kwargs: Any, result: Any, traced: list[StandIn]) -> Claims:
    """Elements moved about, of one array or of several that are alike."""
    if {"dtype", "casting", "out"} & set(kwargs) or not args:
        return Claims()
    conditions: list[Any] = []
    if func in (np.where, np.select):
        chosen = _choices(func, args)
        conditions = args[0] if func is np.select else [args[0]]
    elif func in _MOVERS and isinstance(result, (list, tuple)) == (func in _MANY):
        chosen = operands(func, args)
    else:
        return Claims()
    if not chosen or not all(isinstance(x, StandIn) for x in chosen) or len(chosen) < len(traced):
        return Claims()  # something else comes in, or steers what is taken
    powers = {x.claims.power for x in chosen}
    power = powers.pop() if len(powers) == 1 else None
    whole = all(_event_kept(func, args, kwargs, x, result) for x in chosen)
    n = chosen[0].claims.event_ndim
    whole = whole and all(x.claims.event_ndim == n for x in chosen)
    whole = whole and all(_is_flat(c, n) for c in conditions)
    form = chosen[0].claims.form if func in _STILL else object()
    return Claims(power, all(x.claims.is_copy for x in chosen), 0, whole, form)


def _choices(func: Any, args: Any) -> list[Any]:
    """What ``np.where`` and ``np.select`` choose from."""
    if func is np.where:
        return list(args[1:]) if len(args) == 3 else []
    listed = len(args) == 3 and isinstance(args[0], list) and isinstance(args[1], list)
    return [*args[1], args[2]] if listed else []


def _event_kept(func: Any, args: Any, kwargs: Any, value: StandIn, result: Any) -> bool:
    """Whether a mover leaves the event of one of its arrays as it is."""
    n = value.claims.event_ndim
    if n == 0 or not value.claims.whole_event:
        return n == 0
    first = result[0] if isinstance(result, (list, tuple)) else result
    span = function_span(func, args, kwargs, value, first)
    if span == KEPT and np.shape(first)[-n:] != value.shape[-n:]:
        return False
    return _spares(span, value.ndim, n)


def _spares(span: Span, ndim: int, event_ndim: int) -> bool:
    """Whether the last axes are out of reach."""
    return event_ndim == 0 or (span is not None and span[1] <= ndim - event_ndim)


def _is_flat(value: Any, event_ndim: int) -> bool:
    """Whether something untraced is the same all over the event."""
    if is_traced(value):
        return False
    shape = np.shape(value)
    return all(size == 1 for size in shape[max(len(shape) - event_ndim, 0) :])


def _is_plain(key: Any) -> bool:
    """Whether a key is written in the program: whole numbers, slices, new axes."""
    keys = key if isinstance(key, tuple) else (key,)
    for k in keys:
        parts = (k.start, k.stop, k.step) if isinstance(k, slice) else (k,)
        if not all(p is None or p is Ellipsis or type(p) is int for p in parts):
            return False
    return True
