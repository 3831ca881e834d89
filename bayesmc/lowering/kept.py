"""Values that a kernel keeps in memory: what fills them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc.expression import Call, Expression, Pick, Reduction
from bayesmc.expression.scatter import Gathered, Scattered
from bayesmc.lowering.code import REAL
from bayesmc.lowering.layout import (
    FEW,
    adds_in_place,
    cumulated_axis,
    is_given,
    linear_algebra,
)
from bayesmc.lowering.matrices import keep_matrices
from bayesmc.lowering.places import flat, plus, times, unraveled
from bayesmc.lowering.schedule import is_sum, loop_shape
from bayesmc.lowering.ufuncs import kind_of
from bayesmc.lowering.writer import Place, Writer


def keep(w: Writer, node: Expression) -> None:
    """Write a node's elements to its memory."""
    pointer = w.pointers[node]
    if isinstance(node, Call):
        if isinstance(node.call, (Scattered, Gathered)):
            _add_up(w, node)
        elif linear_algebra(node) is not None:
            keep_matrices(w, node)
        else:
            _cumulate(w, node, pointer)
    elif isinstance(node, Pick) and len(node.operands) > 1:
        _joined(w, node, pointer)
    elif isinstance(node, Reduction) and adds_in_place(node):
        _side_by_side(w, node, pointer)
    else:
        w.nest(
            node.shape,
            lambda at: w.code.store(pointer, flat(node.shape, at), w.computed(node, at)),
        )


def together(w: Writer, group: Sequence[Expression]) -> None:
    """Nodes whose loops are one (``schedule``), kept or summed."""
    shape = loop_shape(group[0], w.layout)
    assert shape is not None
    totals = {
        n: w.code.variable(w.start(n)) for n in group if isinstance(n, Reduction) and is_sum(n)
    }

    def each(at: Place) -> None:
        for node in group:
            if node in totals:
                value = w.element(node.operands[0], at).to(kind_of(node))
                old = w.code.get(totals[node], kind_of(node))
                w.code.set(totals[node], w.combined(node, old, value, free=True))
            else:
                value = w.computed(node, at)
                w.code.store(w.pointers[node], flat(node.shape, at), value)

    w.nest(shape, each)
    for node in group:
        if node in totals:
            value = w.know(node, w.code.get(totals[node], kind_of(node)))
            if node in w.layout.kept:
                w.code.store(w.pointers[node], 0, value)
        if node in w.layout.kept:
            w.ready.add(node)


# ---- private ------------------------------------------------------------------------------------


def _side_by_side(w: Writer, node: Reduction, pointer: str) -> None:
    (operand,) = node.operands
    start = w.start(node)
    w.nest((node.size,), lambda at: w.code.store(pointer, at[0] if node.size > 1 else 0, start))

    def more(place: Place) -> None:
        value = w.element(operand, place).to(start.kind)
        left = tuple(i for k, i in enumerate(place) if k not in node.axes)
        to = flat(node.shape, left)
        old = w.code.load(pointer, to, start.kind)
        w.code.store(pointer, to, w.combined(node, old, value))

    w.nest(operand.shape, more)


def _joined(w: Writer, node: Pick, pointer: str) -> None:
    """Operands side by side, each to its places."""
    positions, first = node.positions.reshape(-1), 0
    for number, operand in enumerate(node.operands):
        places = np.flatnonzero((positions >= first) & (positions < first + operand.size))
        source = positions[places] - first
        first += operand.size
        if places.size <= FEW or (not is_given(operand) and operand.size == 1):
            _one_by_one(w, node, operand, places, source, pointer)
        else:
            _copied(w, node, number, places, source)


def _copied(w: Writer, node: Pick, number: int, places: np.ndarray, source: np.ndarray) -> None:
    """Elements of one operand that lies in memory."""

    def put(at: Place) -> None:
        to = w.spaced((node, number, "to"), places, at[0])
        row = w.spaced((node, number, "from"), source, at[0])
        value = w.read(node.operands[number], row).to(kind_of(node))
        w.code.store(w.pointers[node], to, value)

    w.nest((places.size,), put)


def _one_by_one(
    w: Writer,
    node: Pick,
    operand: Expression,
    places: np.ndarray,
    source: np.ndarray,
    pointer: str,
) -> None:
    if places.size > FEW:  # one number to many places
        value = w.element(operand, (0,) * len(operand.shape)).to(kind_of(node))
        w.nest(
            (places.size,),
            lambda at: w.code.store(pointer, w.spaced((node, operand, "to"), places, at[0]), value),
        )
        return
    for to, row in zip(places, source, strict=True):
        value = w.element(operand, unraveled(int(row), operand.shape)).to(kind_of(node))
        w.code.store(pointer, int(to), value)


def _add_up(w: Writer, node: Call) -> None:
    """Elements added to an array of zeros at their places."""
    pointer, made = w.pointers[node], node.call
    zero = w.code.number(0.0)
    w.nest((node.size,), lambda at: w.code.store(pointer, at[0], zero))

    def more(place: Place) -> None:
        part = node.operands[0]
        value = w.element(part, place)
        if isinstance(made, Scattered):
            many = np.empty(made.order.array.size, np.int64)
            many[made.order.array] = np.repeat(np.arange(made.counts.array.size), made.counts.array)
            to = w.spaced((node, "to"), many, place[0])
        else:
            ndim, block = made.row_ndim, math.prod(made.shape[1:])
            rows = node.operands[1]
            row = w.within(w.element(rows, place[:ndim]), made.shape[0])
            rest = flat(made.shape[1:], place[ndim:])
            to = plus(times(row, block), rest)
        old = w.code.load(pointer, to, REAL)
        w.code.store(pointer, to, old + value)

    w.nest(node.operands[0].shape, more)


def _cumulate(w: Writer, node: Call, pointer: str) -> None:
    """Sums of all elements so far along an axis."""
    axis, shape = cumulated_axis(node), node.shape
    assert axis is not None
    (operand,), kind = node.operands, kind_of(node)
    others = tuple(1 if k == axis else n for k, n in enumerate(shape))

    def along(place: Place) -> None:
        total = w.code.variable(w.code.number(0, kind))

        def more(at: Place) -> None:
            own = (*place[:axis], at[0], *place[axis + 1 :])
            found = w.code.get(total, kind) + w.element(operand, own).to(kind)
            w.code.set(total, found)
            w.code.store(pointer, flat(shape, own), found)

        w.nest((shape[axis],), more)

    w.nest(others, along)
