"""A graph as one function of machine code: loops over a batch, and inside over the elements of arrays.

Values are asked for from the results down: an element of a node is emitted where it is read, and known from
there on in the loops inside. Numbers that are constant in the graph are arguments of the function, and so
are positions that are not evenly spaced: other data make no other code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.expression import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    Reduction,
)
from bayesmc.expression.scatter import Scattered
from bayesmc.lowering.code import REAL, TRUTH, WHOLE, Code, Index, Module, Number
from bayesmc.lowering.layout import (
    FEW,
    STARTS,
    Layout,
    adds_in_place,
    is_few,
    is_given,
    laid_out,
    strides_of,
)
from bayesmc.lowering.places import flat, plus, times, unraveled
from bayesmc.lowering.ufuncs import OUTSIDE, kind_of, lowered

#: the name of the function in the machine code
ENTRY = "bayesmc_kernel"
Place = tuple[Index, ...]


class Kernel:
    """The text of a function of many entries.

    ``int32 f(int64 entries, void** arguments)``: arguments are addresses, in the order of ``leaves``, the
    constants (real, whole, true), what is kept of one entry (one for each), the roots. The result is 0, or
    the bits of ``lowering.ufuncs`` for what could not be done.

    Parameters
    ----------
    roots : sequence of Expression
    varying : frozenset of str
        Leaves that have values of their own for each entry; of the others there is one.

    Attributes
    ----------
    text : str
    leaves : list of Leaf
    constants : dict
        Type -> all constants of it, one after the other.
    kept : list of Expression
        Of which the function needs memory for one entry.

    Raises
    ------
    TraceError
        Something has no machine code.
    """

    def __init__(self, roots: Sequence[Expression], varying: frozenset[str]) -> None:
        self.layout: Layout = laid_out(roots)
        self.varying = varying
        self.leaves = [n for n in self.layout.nodes if isinstance(n, Leaf)]
        self.kept = [n for n in self.layout.nodes if n in self.layout.kept]
        self._module = Module()
        self._code = Code(self._module)
        self._tables: dict[str, list[np.ndarray]] = {REAL: [], WHOLE: [], TRUTH: []}
        self._offsets: dict[Any, int] = {}
        self._entry: Index = 0
        self._known: list[dict[tuple[Expression, Place], Number]] = [{}]
        self._ready: set[Expression] = set()
        self._pointers: dict[Any, str] = {}
        names = [*self.leaves, *self._tables, *self.kept, *range(len(roots))]
        for k, what in enumerate(names):
            self._pointers[what] = f"%p{k}"
        self._write(roots)
        self.text = self._function(len(names))
        self.foreign = self._module.foreign
        self.constants = {
            kind: np.concatenate([*parts, np.zeros(1, _DTYPES[kind])])
            for kind, parts in self._tables.items()
        }

    # ---- private -------------------------------------------------------------------------------

    def _write(self, roots: Sequence[Expression]) -> None:
        varies = [n for n in self.layout.nodes if n.leaves & self.varying]
        for node in self.layout.nodes:
            if not node.leaves & self.varying:
                self._prepare(node)

        def entry(i: Number) -> None:
            self._entry = i
            for node in varies:
                self._prepare(node)
            for k, root in enumerate(roots):
                self._result(k, root)

        self._loop(Number(self._code, "%entries", WHOLE), entry)

    def _function(self, count: int) -> str:
        code = self._code
        flags = code.op("i32", f"trunc i64 {code.flags.text} to i32")
        code.do(f"ret i32 {flags.text}")
        pointers = ", ".join(f"ptr noalias %p{k}" for k in range(count))
        body = f"define internal i32 @body(i64 %entries, {pointers}) noinline {{\n{code}\n}}"
        outer = Code(self._module)
        given = [outer.load("%arguments", k, "ptr").text for k in range(count)]
        args = ", ".join(f"ptr {g}" for g in given)
        found = outer.op("i32", f"call i32 @body(i64 %entries, {args})")
        outer.do(f"ret i32 {found.text}")
        head = f"define i32 @{ENTRY}(i64 %entries, ptr %arguments) {{\n{outer}\n}}"
        return f"{self._module}\n{body}\n{head}\n"

    def _prepare(self, node: Expression) -> None:
        """What later loops read of a node, computed now."""
        if is_given(node):
            return
        if is_few(node):
            if not isinstance(node, Call):
                values = [self._element(node, at) for at in np.ndindex(node.shape)]
                if node in self.layout.kept:
                    for k, value in enumerate(values):
                        self._code.store(self._pointers[node], k, value)
            else:
                self._added_up(node)
        elif node in self.layout.kept:
            self._keep(node)
        if node in self.layout.kept:
            self._ready.add(node)

    def _keep(self, node: Expression) -> None:
        pointer = self._pointers[node]
        if isinstance(node, Call):
            self._added_up(node)
        elif isinstance(node, Pick) and len(node.operands) > 1:
            self._together(node, pointer)
        elif isinstance(node, Reduction) and adds_in_place(node):
            self._side_by_side(node, pointer)
        else:
            self._nest(
                node.shape,
                lambda at: self._code.store(
                    pointer, flat(node.shape, at), self._computed(node, at)
                ),
            )

    def _result(self, number: int, root: Expression) -> None:
        pointer = self._pointers[number]
        first = times(self._entry, root.size) if root.leaves & self.varying else 0

        def put(at: Place) -> None:
            place = plus(first, flat(root.shape, at))
            self._code.store(pointer, place, self._element(root, at))

        if is_few(root):
            for at in np.ndindex(root.shape):
                put(at)
        else:
            self._nest(root.shape, put)

    # loops

    def _loop(self, count: Any, body: Callable[[Number], None]) -> None:
        """What is emitted inside is not known outside."""

        def inner(i: Number) -> None:
            self._known.append({})
            body(i)
            self._known.pop()

        self._code.loop(count, inner)

    def _nest(self, shape: Sequence[int], body: Callable[[Place], None], at: Place = ()) -> None:
        if len(at) == len(shape):
            body(at)
        elif shape[len(at)] == 1:
            self._nest(shape, body, (*at, 0))
        else:
            self._loop(shape[len(at)], lambda i: self._nest(shape, body, (*at, i)))

    def _table(self, key: Any, values: np.ndarray, kind: str) -> int:
        """Where numbers lie among the constants."""
        if key not in self._offsets:
            parts = self._tables[kind]
            self._offsets[key] = sum(p.size for p in parts)
            parts.append(np.ascontiguousarray(values, _DTYPES[kind]).reshape(-1))
        return self._offsets[key]

    # elements

    def _element(self, node: Expression, at: Place) -> Number:
        at = tuple(0 if n == 1 else i for i, n in zip(at, node.shape, strict=True))
        key = node, tuple(i if isinstance(i, int) else i.text for i in at)
        for scope in reversed(self._known):
            if key in scope:
                return scope[key]
        if is_given(node) or node in self._ready:
            found = self._read(node, flat(node.shape, at))
        else:
            found = self._computed(node, at)
        self._known[-1][key] = found
        return found

    def _read(self, node: Expression, at: Index) -> Number:
        """An element that lies in memory."""
        if not is_given(node) and node not in self._ready:
            assert node.size == 1, "it was not kept"
            return self._element(node, (0,) * len(node.shape))
        kind = kind_of(node)
        if isinstance(node, Constant):
            first = self._table(node, node.value, kind)
            return self._code.load(self._pointers[kind], plus(at, first), kind)
        if isinstance(node, Leaf) and node.name in self.varying:
            at = plus(times(self._entry, node.size), at)
        return self._code.load(self._pointers[node], at, kind)

    def _computed(self, node: Expression, at: Place) -> Number:
        if isinstance(node, Elementwise):
            values = []
            for a in node.operands:
                own = at[len(node.shape) - len(a.shape) :]
                values.append(self._element(a, own))
            return lowered(self._code, node, values)
        if isinstance(node, Pick):
            return self._picked(node, at)
        if isinstance(node, Gather):
            return self._gathered(node, at)
        assert isinstance(node, Reduction)
        return self._reduced(node, at)

    def _picked(self, node: Pick, at: Place) -> Number:
        static = tuple(i if isinstance(i, int) else slice(None) for i in at)
        moving = tuple(i for i in at if not isinstance(i, int))
        positions, kind = np.asarray(node.positions[static]), kind_of(node)
        if not moving:
            number = int(positions)
            for operand in node.operands:
                if number < operand.size:
                    break
                number -= operand.size
            return self._element(operand, unraveled(number, operand.shape)).to(kind)
        (operand,) = node.operands
        walk = self.layout.walks.get(node)
        lies = is_given(operand) or operand in self._ready
        if walk is not None and not lies:
            place: list[Index] = list(walk.first)
            for i, axis, step in zip(at, walk.axes, walk.steps, strict=True):
                if step:
                    place[axis] = plus(place[axis], times(i, step))
            return self._element(operand, tuple(place)).to(kind)
        even = strides_of(positions)
        if even is not None:
            row: Index = even[0]
            for i, step in zip(moving, even[1], strict=True):
                row = plus(row, times(i, step))
        else:
            first = self._table((node, static_key(static)), positions, WHOLE)
            at_row = plus(flat(positions.shape, moving), first)
            row = self._code.load(self._pointers[WHOLE], at_row, WHOLE)
        return self._read(operand, row).to(kind)

    def _gathered(self, node: Gather, at: Place) -> Number:
        ndim = len(node.rows.shape)
        row = self._within(self._element(node.rows, at[:ndim]), node.table.shape[0])
        rest = flat(node.table.shape[1:], at[ndim:])
        block = math.prod(node.table.shape[1:])
        return self._read(node.table, plus(times(row, block), rest))

    def _within(self, row: Number, size: int) -> Number:
        row = row.to(WHOLE)
        is_inside = row.below(size)
        self._code.flag(~is_inside, OUTSIDE)
        return self._code.where(is_inside, row, 0)

    # sums

    def _reduced(self, node: Reduction, at: Place) -> Number:
        (operand,) = node.operands
        kind = kind_of(node)
        sizes = [operand.shape[a] for a in node.axes]

        def term(inner: Place) -> Number:
            left, along = iter(at), iter(inner)
            place = tuple(
                next(along) if k in node.axes else next(left) for k in range(len(operand.shape))
            )
            return self._element(operand, place).to(kind)

        if math.prod(sizes) <= FEW:
            parts = [term(inner) for inner in np.ndindex(*sizes)]
            found = parts[0]
            for part in parts[1:]:
                found = self._combined(node, found, part)
            return found
        total = self._code.variable(self._start(node))

        def more(inner: Place) -> None:
            value = term(inner)
            found = self._combined(node, self._code.get(total, kind), value, free=True)
            self._code.set(total, found)

        self._nest(sizes, more)
        return self._code.get(total, kind)

    def _start(self, node: Reduction) -> Number:
        kind, start = kind_of(node), STARTS[node.ufunc]
        if kind == WHOLE and math.isinf(start):
            info = np.iinfo(np.int64)
            start = info.min if start < 0 else info.max
        return self._code.number(start, kind)

    def _combined(self, node: Reduction, a: Number, b: Number, free: bool = False) -> Number:
        """Two parts of a reduction; ``free``: the order of a long sum is the machine's."""
        if node.ufunc is np.add and a.kind == REAL and free:
            return self._code.op(REAL, f"fadd reassoc double {a.text}, {b.text}")
        return lowered(self._code, _pair(node), [a, b])

    def _side_by_side(self, node: Reduction, pointer: str) -> None:
        (operand,) = node.operands
        start = self._start(node)
        self._nest(
            (node.size,), lambda at: self._code.store(pointer, at[0] if node.size > 1 else 0, start)
        )

        def more(place: Place) -> None:
            value = self._element(operand, place).to(start.kind)
            left = tuple(i for k, i in enumerate(place) if k not in node.axes)
            to = flat(node.shape, left)
            old = self._code.load(pointer, to, start.kind)
            self._code.store(pointer, to, self._combined(node, old, value))

        self._nest(operand.shape, more)

    def _together(self, node: Pick, pointer: str) -> None:
        """Operands side by side, each to its places."""
        positions, first = node.positions.reshape(-1), 0
        for number, operand in enumerate(node.operands):
            places = np.flatnonzero((positions >= first) & (positions < first + operand.size))
            source = positions[places] - first
            first += operand.size
            if places.size <= FEW or (not is_given(operand) and operand.size == 1):
                self._one_by_one(node, operand, places, source, pointer)
            else:
                self._copied(node, number, places, source)

    def _copied(self, node: Pick, number: int, places: np.ndarray, source: np.ndarray) -> None:
        """Elements of one operand that lies in memory."""

        def put(at: Place) -> None:
            to = self._spaced((node, number, "to"), places, at[0])
            row = self._spaced((node, number, "from"), source, at[0])
            value = self._read(node.operands[number], row).to(kind_of(node))
            self._code.store(self._pointers[node], to, value)

        self._nest((places.size,), put)

    def _one_by_one(
        self,
        node: Pick,
        operand: Expression,
        places: np.ndarray,
        source: np.ndarray,
        pointer: str,
    ) -> None:
        if places.size > FEW:  # one number to many places
            value = self._element(operand, (0,) * len(operand.shape)).to(kind_of(node))
            self._nest(
                (places.size,),
                lambda at: self._code.store(
                    pointer, self._spaced((node, operand, "to"), places, at[0]), value
                ),
            )
            return
        for to, row in zip(places, source, strict=True):
            value = self._element(operand, unraveled(int(row), operand.shape)).to(kind_of(node))
            self._code.store(pointer, int(to), value)

    def _spaced(self, key: Any, positions: np.ndarray, i: Index) -> Index:
        """The i-th of some positions."""
        even = strides_of(positions)
        if even is not None:
            return plus(times(i, even[1][0]), even[0])
        first = self._table(key, positions, WHOLE)
        return self._code.load(self._pointers[WHOLE], plus(i, first), WHOLE)

    def _added_up(self, node: Call) -> None:
        """Elements added to an array of zeros at their places."""
        pointer, made = self._pointers[node], node.call
        zero = self._code.number(0.0)
        self._nest((node.size,), lambda at: self._code.store(pointer, at[0], zero))

        def more(place: Place) -> None:
            part = node.operands[0]
            value = self._element(part, place)
            if isinstance(made, Scattered):
                many = np.empty(made.order.array.size, np.int64)
                many[made.order.array] = np.repeat(
                    np.arange(made.counts.array.size), made.counts.array
                )
                to = self._spaced((node, "to"), many, place[0])
            else:
                ndim, block = made.row_ndim, math.prod(made.shape[1:])
                rows = node.operands[1]
                row = self._within(self._element(rows, place[:ndim]), made.shape[0])
                rest = flat(made.shape[1:], place[ndim:])
                to = plus(times(row, block), rest)
            old = self._code.load(pointer, to, REAL)
            self._code.store(pointer, to, old + value)

        self._nest(node.operands[0].shape, more)


def static_key(static: Sequence[Any]) -> tuple[Any, ...]:
    """Indices that are known, None for others."""
    return tuple(i if isinstance(i, int) else None for i in static)


# ---- private ------------------------------------------------------------------------------------

_DTYPES = {REAL: np.dtype(float), WHOLE: np.dtype(np.int64), TRUTH: np.dtype(bool)}


def _pair(node: Reduction) -> Elementwise:
    """The ufunc of a reduction, of two elements."""
    made = Elementwise.__new__(Elementwise)
    made.operands, made.shape, made.dtype = (node, node), (), node.dtype
    made.content, made.function = (node.ufunc,), node.ufunc
    return made
