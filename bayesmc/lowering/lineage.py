"""Families of particles followed over slices as machine code, with sums over each, until one asks for more.

What families are, and what is to be said where something seems odd, stands in
``engines.particles.genealogy`` and ``tracking``: this is the loop over slices in which nothing does.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

from bayesmc.lowering.code import REAL, TRUTH, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary
from bayesmc.lowering.filter_slices import ANCESTORS, MOMENTS, TOLD, WEIGHTS
from bayesmc.lowering.machine import loaded

#: bounds of slices in which nothing seems odd: the least effective number of particles, that below which
#: weights are looked at for a tail, the largest sum of moves; even families (in units of all) that call for
#: the young origin's sums, too; variances: what matters, what is explained by so many times, that without a
#: tail, at most; the share of families left; slices to a look, the number of the slice before, ages of the
#: young origin at the soonest and the latest; the row where what is lost is looked at
LIMITS = (
    "rest", "few", "seems", "enough", "level", "edge", "long", "most", "left", "stride", "slice",
    "shortest", "longest", "lost",
)  # fmt: skip

_WHOLES = ("first", "slices", "particles", "nodes", "numbers", "groups")
_POINTERS = (
    "limits", "at", "told", "number", "moments", "bounds", "shares", "explained", "sums", "young", "roots",
    "origins", "even", "even_shares",
)  # fmt: skip
_ORIGINS = 2


@lru_cache(maxsize=1)
def followed() -> Any:
    """The function ``int64 f(...)`` of ``_WHOLES`` and ``_POINTERS``, where there is a compiler.

    Arrays are those of ``filter_slices``, and ``bounds`` (slices + 1, 2, groups + 1), ``explained``
    (slices + 1, 2, 2), both known of row ``first``; ``shares`` (2, groups). It takes the sums of row
    ``first`` (but of row 0), goes on while nothing seems odd, and gives the first row that it did not come
    to. Where the old origin is to be given up, ``origins`` (settled, born of both) and ``shares`` are written
    to; ``even`` (groups + 1) and ``even_shares`` are bounds and shares of a new one.
    ``sums`` (slices + 1, 2, 1 + numbers, groups): by family of the old origin and of the young one, of the
    weights, and of these times by how much each number lies off its mean. ``young`` (slices + 1) says whether
    those of the young one were taken. ``roots`` (1 + 2 particles): whether there are any, who they are, and
    room for a copy.
    """
    code = loaded(*text())
    types = [ctypes.c_int64] * len(_WHOLES) + [ctypes.c_void_p] * len(_POINTERS)
    found = code.function("followed", ctypes.c_int64, *types)
    found.code = code  # the function lives as long as this
    return found


@lru_cache(maxsize=1)
def text() -> tuple[str, tuple[str, ...]]:
    """The module of ``followed``, and the functions that it calls and does not define."""
    module = Module()
    texts = [_below(module), _sums(module), _whole(module)]
    return "\n".join([str(module), *texts]), module.foreign


# ---- private ------------------------------------------------------------------------------------


def _below(module: Module) -> str:
    """How many of sorted numbers lie below a bound."""
    c = Code(module)
    low, high = c.variable(c.number(0, WHOLE)), c.variable(Number(c, "%n", WHOLE))
    bound = Number(c, "%bound", WHOLE)

    def halve() -> Number:
        a, b = c.get(low, WHOLE), c.get(high, WHOLE)
        middle = (a + b).shifted(-1)
        is_below = (c.load("%sorted", middle, WHOLE) < bound) & (a < b)
        c.set(low, c.where(is_below, middle + 1, a))
        c.set(high, c.where(is_below | (a >= b), b, middle))
        return c.get(low, WHOLE) < c.get(high, WHOLE)

    c.repeat(halve)
    c.do(f"ret i64 {c.get(low, WHOLE).text}")
    return f"define internal i64 @below(i64 %n, i64 %bound, ptr %sorted) {{\n{c}\n}}"


def _sums(module: Module) -> str:
    """Sums over the particles of each family: of the weights, and of these times how far numbers lie off."""
    c = Code(module)
    groups, numbers = (Number(c, f"%{n}", WHOLE) for n in ("groups", "numbers"))
    total = c.variable(c.number(0.0))

    def over(g: Number, term: Any, to: Number) -> None:
        low, high = c.load("%bounds", g, WHOLE), c.load("%bounds", g + 1, WHOLE)
        c.set(total, c.number(0.0))

        def add(i: Number) -> None:
            old = c.get(total, REAL)
            c.set(total, c.op(REAL, f"fadd reassoc double {old.text}, {term(low + i).text}"))

        c.when(high > low, lambda: c.loop(high - low, add))
        c.store("%sums", to, c.get(total, REAL))

    def weight(i: Number) -> Number:
        return c.load("%weights", i, REAL)

    c.loop(groups, lambda g: over(g, weight, g))

    def number(k: Number) -> None:
        column, size, which = (c.load("%number", k * 4 + j, WHOLE) for j in range(3))
        values = c.op("ptr", f"inttoptr i64 {c.load('%at', column, WHOLE).text} to ptr").text
        mean = c.load("%moments", k * len(MOMENTS), REAL)

        def off(i: Number) -> Number:
            return (c.load(values, i * size + which, REAL) - mean) * weight(i)

        c.loop(groups, lambda g: over(g, off, (k + 1) * groups + g))

    c.when(numbers > 0, lambda: c.loop(numbers, number))
    c.do("ret void")
    pointers = ", ".join(
        f"ptr %{n}" for n in ("bounds", "weights", "at", "number", "moments", "sums")
    )
    return f"define internal void @sums(i64 %groups, i64 %numbers, {pointers}) {{\n{c}\n}}"


def _whole(module: Module) -> str:
    made = _Followed(module)
    head = [*(f"i64 %{n}" for n in _WHOLES), *(f"ptr noalias %{n}" for n in _POINTERS)]
    return f"define i64 @followed({', '.join(head)}) {{\n{made.c}\n}}"


class _Followed:
    """The text of ``followed``."""

    def __init__(self, module: Module) -> None:
        self.c = c = Code(module)
        self.n, self.groups, self.numbers = (
            Number(c, f"%{n}", WHOLE) for n in ("particles", "groups", "numbers")
        )
        self.row = c.variable(Number(c, "%first", WHOLE))
        self.go = c.variable(c.number(True, TRUTH))
        c.repeat(self._row)
        c.do(f"ret i64 {(c.get(self.row, WHOLE) + 1).text}")

    def _row(self) -> Number:
        """The sums of the present row; then the next one, if nothing is due in it."""
        c, row = self.c, self.c.get(self.row, WHOLE)
        self.present, self.next = row, row + 1
        c.when(row > 0, self._sum)
        c.set(self.go, row < Number(c, "%slices", WHOLE))
        c.when(c.get(self.go, TRUTH), self._step)
        is_on = c.get(self.go, TRUTH)
        c.set(self.row, c.where(is_on, row + 1, row))
        return is_on

    def _sum(self) -> None:
        c, row = self.c, self.present
        squares = c.variable(c.number(0.0))
        sums = self._summed(0)

        def square(g: Number) -> None:
            own = c.load(sums, g, REAL)
            c.set(squares, c.get(squares, REAL) + own * own)

        c.loop(self.groups, square)
        total = self._told(row, "total")
        is_few = c.get(squares, REAL) * self._limit("enough") > total * total
        c.store("%young", row, is_few.to(WHOLE))

        def young() -> None:
            self._summed(1)

        c.when(is_few, young)

    def _summed(self, origin: int) -> str:
        """Take the sums of an origin's families; where they are."""
        c, row = self.c, self.present
        weights = c.load("%at", row * self._columns + WEIGHTS, WHOLE)
        width = (self.numbers + 1) * self.groups
        to = c.address("%sums", (row * _ORIGINS + origin) * width, REAL)
        pointers = [
            self._bounds(row, origin),
            c.op("ptr", f"inttoptr i64 {weights.text} to ptr").text,
            c.address("%at", row * self._columns, WHOLE),
            "%number",
            c.address("%moments", row * self.numbers * len(MOMENTS), REAL),
            to,
        ]
        given = ", ".join(f"ptr {p}" for p in pointers)
        c.do(f"call void @sums(i64 {self.groups.text}, i64 {self.numbers.text}, {given})")
        return to

    def _step(self) -> None:
        c, row = self.c, self.present
        resampled = self._told(self.next, "resampled") > 0.0
        ess = self._told(row, "ess")
        fine = (self._told(self.next, "ess") >= self._limit("rest")) & (
            self._told(self.next, "worst") <= self._limit("seems")
        )
        fine = fine & (self.next.to(REAL) < self._limit("lost"))
        fine = fine & ((ess >= self._limit("few")) | ~resampled)
        c.set(self.go, fine)
        c.when(fine, lambda: self._move(resampled, ess))
        roots = c.load("%roots", 0, WHOLE).ne(0)
        c.when(c.get(self.go, TRUTH) & resampled & roots, self._root)

    def _move(self, resampled: Number, ess: Number) -> None:
        c, many = self.c, (self.groups + 1) * _ORIGINS
        old, new = self._bounds(self.present, 0), self._bounds(self.next, 0)
        found = c.load("%at", self.next * self._columns + ANCESTORS, WHOLE)
        ancestors = c.op("ptr", f"inttoptr i64 {found.text} to ptr").text
        more = c.where(resampled, 1.0 / ess - 1.0 / self.n.to(REAL), 0.0)

        def explained(j: Number) -> None:
            was = c.load("%explained", self.present * 4 + j, REAL)
            c.store("%explained", self.next * 4 + j, was + more)

        def search(j: Number) -> None:
            given = f"i64 {self.n.text}, i64 {c.load(old, j, WHOLE).text}, ptr {ancestors}"
            c.store(new, j, c.op(WHOLE, f"call i64 @below({given})"))

        c.loop(c.number(4, WHOLE), explained)
        c.when(resampled, lambda: c.loop(many, search))
        c.when(~resampled, lambda: c.loop(many, lambda j: c.store(new, j, c.load(old, j, WHOLE))))
        t, stride = self._limit("slice") + self.next.to(REAL), self._limit("stride")
        whole = c.call("llvm.floor.f64", t / stride)
        c.when(resampled & t.eq(whole * stride), self._look)

    def _look(self) -> None:
        """Whether anything seems odd, or the old origin is to be given up: ``genealogy._looked_at``."""
        c, n, t = self.c, self.n.to(REAL), self._limit("slice") + self.next.to(REAL)
        age = t - c.load("%origins", 2, REAL)
        due, matters = c.variable(age > self._limit("longest")), c.variable(c.number(False, TRUTH))
        even, spread, square = (c.variable(c.number(0.0)) for _ in range(3))
        gained = c.number(0.0)
        for origin in range(_ORIGINS):
            bounds = self._bounds(self.next, origin)
            for place in (even, spread, square):
                c.set(place, c.number(0.0))

            def family(g: Number, bounds: str = bounds, origin: int = origin) -> None:
                count = (c.load(bounds, g + 1, WHOLE) - c.load(bounds, g, WHOLE)).to(REAL) / n
                share = c.load("%shares", g + self.groups * origin, REAL)
                off = count - share
                for place, term in ((even, share), (spread, off), (square, count)):
                    c.set(place, c.get(place, REAL) + term * term)

            c.loop(self.groups, family)
            share, far = c.get(even, REAL), c.get(spread, REAL)
            left = c.where(share < 1.0, 1.0 - far / (1.0 - share), 0.0)
            variance = c.where(left > 1e-9, -elementary(c, "log", left), float("inf"))
            every, bounded = (
                c.load("%explained", self.next * 4 + 2 * origin + j, REAL) for j in range(2)
            )
            above = self._most(self._limit("level"), self._limit("edge") * every)
            other = self._most(self._limit("long"), self._limit("edge") * bounded)
            bound = c.where(above < other, above, other)
            bound = c.where(bound < self._limit("most"), bound, self._limit("most"))
            c.set(matters, c.get(matters, TRUTH) | (variance > bound))
            gained = gained + (variance if origin == 0 else -variance)
            if origin == 0:
                is_few = share < self._limit("left") * c.get(square, REAL)
                c.set(due, c.get(due, TRUTH) | (is_few & (age > self._limit("shortest"))))
        c.set(self.go, ~c.get(matters, TRUTH))
        is_due = c.get(self.go, TRUTH) & c.get(due, TRUTH)
        c.when(is_due, lambda: self._begin_again(t, gained))

    def _begin_again(self, t: Number, gained: Number) -> None:
        """A new young origin, the young one in the place of the old one."""
        c = self.c
        c.store("%origins", 0, c.load("%origins", 0, REAL) + gained)
        c.store("%origins", 1, c.load("%origins", 2, REAL))
        c.store("%origins", 2, t)
        places = [(self._bounds(self.next, 0), self._bounds(self.next, 1), "%even", WHOLE)]
        explained = [c.address("%explained", self.next * 4 + 2 * k, REAL) for k in range(2)]
        young = c.address("%shares", self.groups, REAL)
        places.append(("%shares", young, "%even_shares", REAL))
        for (old, new, fresh, kind), count in zip(
            places, (self.groups + 1, self.groups), strict=True
        ):

            def one(
                g: Number, old: str = old, new: str = new, fresh: str = fresh, kind: str = kind
            ) -> None:
                c.store(old, g, c.load(new, g, kind))
                c.store(new, g, c.load(fresh, g, kind))

            c.loop(count, one)
        for k in range(2):
            c.store(explained[0], k, c.load(explained[1], k, REAL))
            c.store(explained[1], k, c.number(0.0))

    def _root(self) -> None:
        """Whom particles descend from, one slice later."""
        c = self.c
        found = c.load("%at", self.next * self._columns + ANCESTORS, WHOLE)
        ancestors = c.op("ptr", f"inttoptr i64 {found.text} to ptr").text
        copy = self.n + 1

        def keep(i: Number) -> None:
            c.store("%roots", copy + i, c.load("%roots", i + 1, WHOLE))

        def take(i: Number) -> None:
            c.store("%roots", i + 1, c.load("%roots", copy + c.load(ancestors, i, WHOLE), WHOLE))

        c.loop(self.n, keep)
        c.loop(self.n, take)

    # ---- private -------------------------------------------------------------------------------

    @property
    def _columns(self) -> Number:
        return Number(self.c, "%nodes", WHOLE) + 3

    def _bounds(self, row: Number, origin: int) -> str:
        at = (row * _ORIGINS + origin) * (self.groups + 1)
        return self.c.address("%bounds", at, WHOLE)

    def _told(self, row: Number, name: str) -> Number:
        return self.c.load("%told", row * len(TOLD) + TOLD.index(name), REAL)

    def _limit(self, name: str) -> Number:
        return self.c.load("%limits", LIMITS.index(name), REAL)

    def _most(self, a: Number, b: Number) -> Number:
        return self.c.where(a > b, a, b)
