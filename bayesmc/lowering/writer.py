"""Elements of a graph's values, written where they are read.

Values are asked for from the results down: an element of a node is emitted where it is read, and known from
there on in the loops inside. Numbers that are constant in the graph are arguments, and so are positions that
are not evenly spaced: other data make no other code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    Reduction,
)
from bayesmc.lowering.code import REAL, TRUTH, WHOLE, Code, Index, Module, Number
from bayesmc.lowering.elementary import log_sum_exp
from bayesmc.lowering.layout import FEW, STARTS, Layout, is_given, strides_of
from bayesmc.lowering.places import flat, plus, times, unraveled
from bayesmc.lowering.ufuncs import OUTSIDE, kind_of, lowered

Place = tuple[Index, ...]
#: stands for the numbers of the entries that are read
ROWS = "rows"
#: types of numbers as they lie in memory
DTYPES = {REAL: np.dtype(float), WHOLE: np.dtype(np.int64), TRUTH: np.dtype(bool)}


class Writer:
    """Writes what elements are.

    Parameters
    ----------
    layout : Layout
    varying : frozenset of str
        Leaves that have values of their own for each entry.
    chosen : frozenset of str
        Of those the ones that are read at other entries.

    Attributes
    ----------
    code : Code
    pointers : dict
        Leaf, type of constants or kept node -> where it begins.
    ready : set of Expression
        Kept nodes that are in memory already.
    entry, row : int or Number
        The number of the entry, and that of the one whose chosen leaves it reads.
    """

    def __init__(
        self, layout: Layout, varying: frozenset[str], chosen: frozenset[str] = frozenset()
    ) -> None:
        self.layout, self.varying, self.chosen = layout, varying, chosen
        self.code = Code(Module())
        self.pointers: dict[Any, str] = {}
        self.ready: set[Expression] = set()
        self.entry: Index = 0
        self.row: Index = 0
        self._known: list[dict[tuple[Expression, Place], Number]] = [{}]
        self._tables: dict[str, list[np.ndarray]] = {kind: [] for kind in DTYPES}
        self._offsets: dict[Any, int] = {}
        self._scratch: dict[tuple[str, int], str] = {}

    @property
    def constants(self) -> dict[str, np.ndarray]:
        """Type -> all constants of it, one after the other."""
        return {
            kind: np.concatenate([*parts, np.zeros(1, DTYPES[kind])])
            for kind, parts in self._tables.items()
        }

    def scratch(self, what: str, count: int) -> str:
        """Where numbers have a place for a while: the same for all who ask for as many."""
        if (what, count) not in self._scratch:
            self._scratch[what, count] = self.code.memory(count)
        return self._scratch[what, count]

    def loop(self, count: Any, body: Callable[[Number], None]) -> None:
        """What is emitted inside is not known outside."""

        def inner(i: Number) -> None:
            self._known.append({})
            body(i)
            self._known.pop()

        self.code.loop(count, inner)

    def nest(self, shape: Sequence[int], body: Callable[[Place], None], at: Place = ()) -> None:
        """A loop for each axis."""
        if len(at) == len(shape):
            body(at)
        elif shape[len(at)] == 1:
            self.nest(shape, body, (*at, 0))
        else:
            self.loop(shape[len(at)], lambda i: self.nest(shape, body, (*at, i)))

    def element(self, node: Expression, at: Place) -> Number:
        """One element: known already, in memory, or computed here."""
        at = tuple(0 if n == 1 else i for i, n in zip(at, node.shape, strict=True))
        key = node, tuple(i if isinstance(i, int) else i.text for i in at)
        for scope in reversed(self._known):
            if key in scope:
                return scope[key]
        if is_given(node) or node in self.ready:
            found = self.read(node, flat(node.shape, at))
        else:
            found = self.computed(node, at)
        self._known[-1][key] = found
        return found

    def know(self, node: Expression, value: Number) -> Number:
        """From here on, the one element of a node."""
        self._known[-1][node, (0,) * len(node.shape)] = value
        return value

    def read(self, node: Expression, at: Index) -> Number:
        """An element that lies in memory."""
        if not is_given(node) and node not in self.ready:
            assert node.size == 1, "it was not kept"
            return self.element(node, (0,) * len(node.shape))
        kind = kind_of(node)
        if isinstance(node, Constant):
            first = self._table(node, node.value, kind)
            return self.code.load(self.pointers[kind], plus(at, first), kind)
        if isinstance(node, Leaf) and node.name in self.varying:
            entry = self.row if node.name in self.chosen else self.entry
            at = plus(times(entry, node.size), at)
        return self.code.load(self.pointers[node], at, kind)

    def computed(self, node: Expression, at: Place) -> Number:
        """One element, computed."""
        if isinstance(node, Elementwise):
            values = []
            for a in node.operands:
                own = at[len(node.shape) - len(a.shape) :]
                values.append(self.element(a, own))
            return lowered(self.code, node, values)
        if isinstance(node, Pick):
            return self._picked(node, at)
        if isinstance(node, Gather):
            return self._gathered(node, at)
        assert isinstance(node, Reduction)
        return self._reduced(node, at)

    def within(self, row: Number, size: int) -> Number:
        """A row of a table; where it is outside the call is flagged."""
        row = row.to(WHOLE)
        is_inside = row.below(size)
        self.code.flag(~is_inside, OUTSIDE)
        return self.code.where(is_inside, row, 0)

    def start(self, node: Reduction) -> Number:
        """What a reduction begins with."""
        kind, start = kind_of(node), STARTS[node.ufunc]
        if kind == WHOLE and math.isinf(start):
            info = np.iinfo(np.int64)
            start = info.min if start < 0 else info.max
        return self.code.number(start, kind)

    def combined(self, node: Reduction, a: Number, b: Number, free: bool = False) -> Number:
        """Two parts of a reduction; ``free``: the order of a long sum is the machine's."""
        if node.ufunc is np.add and a.kind == REAL and free:
            return self.code.op(REAL, f"fadd reassoc double {a.text}, {b.text}")
        return lowered(self.code, _pair(node), [a, b])

    def spaced(self, key: Any, positions: np.ndarray, i: Index) -> Index:
        """The i-th of some positions."""
        even = strides_of(positions)
        if even is not None:
            return plus(times(i, even[1][0]), even[0])
        first = self._table(key, positions, WHOLE)
        return self.code.load(self.pointers[WHOLE], plus(i, first), WHOLE)

    # ---- private -------------------------------------------------------------------------------

    def _table(self, key: Any, values: np.ndarray, kind: str) -> int:
        """Where numbers lie among the constants."""
        if key not in self._offsets:
            parts = self._tables[kind]
            self._offsets[key] = sum(p.size for p in parts)
            parts.append(np.ascontiguousarray(values, DTYPES[kind]).reshape(-1))
        return self._offsets[key]

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
            return self.element(operand, unraveled(number, operand.shape)).to(kind)
        (operand,) = node.operands
        walk = self.layout.walks.get(node)
        lies = is_given(operand) or operand in self.ready
        if walk is not None and not lies:
            place: list[Index] = list(walk.first)
            for i, axis, step in zip(at, walk.axes, walk.steps, strict=True):
                if step:
                    place[axis] = plus(place[axis], times(i, step))
            return self.element(operand, tuple(place)).to(kind)
        even = strides_of(positions)
        if even is not None:
            row: Index = even[0]
            for i, step in zip(moving, even[1], strict=True):
                row = plus(row, times(i, step))
        else:
            first = self._table((node, _static(static)), positions, WHOLE)
            at_row = plus(flat(positions.shape, moving), first)
            row = self.code.load(self.pointers[WHOLE], at_row, WHOLE)
        return self.read(operand, row).to(kind)

    def _gathered(self, node: Gather, at: Place) -> Number:
        ndim = len(node.rows.shape)
        row = self.within(self.element(node.rows, at[:ndim]), node.table.shape[0])
        rest = flat(node.table.shape[1:], at[ndim:])
        block = math.prod(node.table.shape[1:])
        return self.read(node.table, plus(times(row, block), rest))

    def _reduced(self, node: Reduction, at: Place) -> Number:
        (operand,) = node.operands
        kind = kind_of(node)
        sizes = [operand.shape[a] for a in node.axes]

        def term(inner: Place) -> Number:
            left, along = iter(at), iter(inner)
            place = tuple(
                next(along) if k in node.axes else next(left) for k in range(len(operand.shape))
            )
            return self.element(operand, place).to(kind)

        if math.prod(sizes) <= FEW:
            parts = [term(inner) for inner in np.ndindex(*sizes)]
            if node.ufunc is np.logaddexp:
                return log_sum_exp(self.code, parts)
            found = parts[0]
            for part in parts[1:]:
                found = self.combined(node, found, part)
            return found
        total = self.code.variable(self.start(node))

        def more(inner: Place) -> None:
            value = term(inner)
            found = self.combined(node, self.code.get(total, kind), value, free=True)
            self.code.set(total, found)

        self.nest(sizes, more)
        return self.code.get(total, kind)


# ---- private ------------------------------------------------------------------------------------


def _static(static: Sequence[Any]) -> tuple[Any, ...]:
    """Indices that are known, None for others."""
    return tuple(i if isinstance(i, int) else None for i in static)


def _pair(node: Reduction) -> Elementwise:
    """The ufunc of a reduction, of two elements."""
    made = Elementwise.__new__(Elementwise)
    made.operands, made.shape, made.dtype = (node, node), (), node.dtype
    made.content, made.function = (node.ufunc,), node.ufunc
    return made
