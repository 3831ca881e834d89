"""Slice sampling as machine code: the numbers of all chains, one chain after the other.

The text is the same for every density, whose compiled values are called from inside, so it is compiled once
for all. The moves are those of ``kernels.slice``, where their sources stand: given the same uniform numbers,
both go to the same places. Numbers that are independent given all others move together, a call of the
density telling of all of them; those that are not take turns.

Random numbers are those of ``lowering.no_u_turn``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from bayesmc.lowering.code import REAL, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary
from bayesmc.lowering.machine import loaded
from bayesmc.lowering.no_u_turn import uniform

#: what is told of each chain's moves: what went wrong, and calls of the density
TOLD = ("fault", "calls")
#: faults: the density is zero where a chain is; it was nowhere what it was there
ZERO, NOWHERE = 1, 2
#: lines along which numbers move: their own, their logarithms, cells of integers, a circle
LINES = ("real", "logs", "integer", "circle")
#: shrinkages after which the density cannot be what it was
SHRINKAGES = 400
#: vectors of memory, of as many numbers as move at once
_NOW, _AT, _LEFT, _RIGHT, _LEVEL, _LOG, _MORE, _LESS, _OPEN, _FOUND, _VECTORS = range(11)
#: what moves are made of: whole numbers, then addresses
_WHOLES = ("first", "last", "turns", "sites", "size", "results", "whole", "others")
_POINTERS = (
    "density", "arguments", "moving", "fallback", "memory", "values", "starts", "lines", "growth", "places",
    "answers", "width", "low", "high", "seeds", "told",
)  # fmt: skip


def numbers_of(most: int, size: int, results: int) -> int:
    """Numbers of memory that moves need, of which so many are made at once."""
    return _VECTORS * most + size + results


@lru_cache(maxsize=1)
def slice_moves() -> Any:
    """The function ``void f(...)`` of ``_WHOLES`` and ``_POINTERS``, where there is a compiler.

    It moves chains ``first`` to ``last - 1``. A chain has ``size`` numbers in ``values``, of which ``sites``
    move, in ``turns``: those of turn ``t`` are ``starts[t]`` to ``starts[t + 1]``, along ``lines[t]``, by at
    most ``growth[t]`` widths. Site ``s`` is number ``places[s]``, and of the ``results`` of the density
    number ``answers[s]`` is its log density; ``width``, ``low`` and ``high`` are (chains, sites). ``seeds``
    (chains, turns, 4); ``told`` (chains, len(TOLD)). ``whole`` says that values are whole numbers;
    ``moving`` is as in ``no_u_turn.transitions``.
    """
    module = Module()
    texts = [uniform(module), _value(module), _look(module), _Text(module).text]
    code = loaded("\n".join([str(module), *texts]), module.foreign)
    types = [ctypes.c_int64] * len(_WHOLES) + [ctypes.c_void_p] * len(_POINTERS)
    found = code.function("slice_moves", None, *types)
    found.code = code  # the function lives as long as this
    return found


# ---- private ------------------------------------------------------------------------------------


def _value(module: Module) -> str:
    """``kernels.slice._Line.value`` of one number."""
    c = Code(module)
    at, low = Number(c, "%at", REAL), Number(c, "%low", REAL)
    line = Number(c, "%line", WHOLE)
    found = c.variable(at)
    c.when(line.eq(1), lambda: c.set(found, low + elementary(c, "exp", at)))
    c.when(line.eq(2), lambda: c.set(found, c.call("llvm.floor.f64", at)))
    turn = 6.283185307179586

    def wrapped() -> None:
        turns = c.call("llvm.floor.f64", at * (1.0 / turn) + 0.5)
        inside = at - turns * turn
        inside = c.where(inside < -turn / 2, inside + turn, inside)
        c.set(found, c.where(inside >= turn / 2, inside - turn, inside))

    beyond = (at < -turn / 2) | (at >= turn / 2)
    c.when(line.eq(3) & beyond, wrapped)
    c.do(f"ret double {c.get(found, REAL).text}")
    return f"define internal double @value(i64 %line, double %at, double %low) {{\n{c}\n}}"


_LOOK_WHOLES = ("row", "count", "line", "whole", "own")
_LOOK_POINTERS = (
    "density", "arguments", "fallback", "base", "tried", "logs", "places", "answers", "at", "open", "log",
    "low", "high",
)  # fmt: skip


def _look(module: Module) -> str:
    """Log densities of the open sites at places along their lines; minus infinity out of bounds.

    A log density that is no number is asked of ``fallback``; so is one that is not finite where a chain is.
    """
    c = Code(module)
    count, line = Number(c, "%count", WHOLE), Number(c, "%line", WHOLE)
    is_whole = Number(c, "%whole", WHOLE).ne(0)
    asks = c.variable(c.number(0, WHOLE))

    def put(i: Number) -> None:
        at, low, high = (c.load(f"%{n}", i, REAL) for n in ("at", "low", "high"))
        value = c.op(
            REAL,
            f"call double @value(i64 {line.text}, double {at.text}, double {low.text})",
        )
        inside = ((value > low) & (value < high)) | line.eq(3) | line.eq(2)
        inside = inside & c.load("%open", i, WHOLE).ne(0)
        place = c.load("%places", i, WHOLE)
        now = c.load("%base", place, REAL)
        stored = c.where(is_whole, value.to(WHOLE).bits(), value)
        c.store("%tried", place, c.where(inside, stored, now))
        volume = c.where(line.eq(1), at, c.number(0.0))
        c.store("%log", i, c.where(inside, volume, float("-inf")))

    c.loop(count, put)
    arguments = "i64 1, ptr %tried, ptr %logs, ptr %arguments"
    failed = c.op("i32", f"call i32 %density({arguments})")
    c.set(asks, c.op(WHOLE, f"zext i32 {failed.text} to i64"))

    def judge(i: Number) -> None:
        log = c.load("%logs", c.load("%answers", i, WHOLE), REAL)
        asked = c.load("%log", i, REAL) > float("-inf")
        bad = ~(log < float("inf"))
        own = Number(c, "%own", WHOLE).ne(0) & ~(log > float("-inf"))
        wanted = (asked & (bad | own)).to(WHOLE)
        c.set(asks, c.get(asks, WHOLE) | wanted)

    c.loop(count, judge)

    def ask() -> None:
        c.op("i32", "call i32 %fallback(i64 %row, ptr %tried, ptr %logs, ptr null)")

    c.when(c.get(asks, WHOLE).ne(0), ask)

    def add(i: Number) -> None:
        log = c.load("%logs", c.load("%answers", i, WHOLE), REAL)
        volume = c.load("%log", i, REAL)
        # what is out of bounds was not tried: its log density is that of where it is
        c.store("%log", i, c.where(volume > float("-inf"), log + volume, volume))

    c.loop(count, add)
    c.do("ret void")
    head = [*(f"i64 %{n}" for n in _LOOK_WHOLES), *(f"ptr %{n}" for n in _LOOK_POINTERS)]
    return f"define internal void @look({', '.join(head)}) noinline optsize {{\n{c}\n}}"


class _Text:
    """The text of ``slice_moves``; what chains read and write stands under its names."""

    def __init__(self, module: Module) -> None:
        self.c = c = Code(module)
        self.first = Number(c, "%first", WHOLE)
        self.sites = Number(c, "%sites", WHOLE)
        self.whole = Number(c, "%whole", WHOLE)
        naught = c.number(0, WHOLE)
        self.fault, self.calls = c.variable(naught), c.variable(naught)
        self.any, self.tries = c.variable(naught), c.variable(naught)
        c.loop(Number(c, "%last", WHOLE) - self.first, self._chain)
        c.do("ret void")
        head = [*(f"i64 %{n}" for n in _WHOLES), *(f"ptr %{n}" for n in _POINTERS)]
        self.text = f"define void @slice_moves({', '.join(head)}) optsize {{\n{c}\n}}"

    # ---- small change --------------------------------------------------------------------------

    def _vector(self, number: int) -> str:
        """One of the vectors of memory, of as many numbers as move in this turn."""
        return self.c.address("%memory", self.count * number, REAL)

    def _each(self, body: Callable[[Number], None]) -> None:
        self.c.loop(self.count, body)

    def _drawn(self) -> Number:
        """A uniform number."""
        return self.c.op(REAL, f"call double @uniform(ptr {self.seed})")

    def _look(self, at: int, own: bool = False) -> None:
        """Log densities of the open sites at one of the vectors."""
        c = self.c
        wholes = (self.row, self.count, self.line, self.whole, c.number(int(own), WHOLE))
        behind = self.count * _VECTORS
        tried = c.address("%memory", behind, REAL)
        logs = c.address("%memory", behind + Number(c, "%size", WHOLE), REAL)
        pointers = (
            "%density", "%arguments", "%fallback", self.base, tried, logs, self.places, self.answers,
            self._vector(at), self._vector(_OPEN), self._vector(_LOG), self.low, self.high,
        )  # fmt: skip
        args = [*(f"i64 {w.text}" for w in wholes), *(f"ptr {p}" for p in pointers)]
        c.do(f"call void @look({', '.join(args)})")
        c.set(self.calls, c.get(self.calls, WHOLE) + 1)

    # ---- one chain -----------------------------------------------------------------------------

    def _chain(self, i: Number) -> None:
        c = self.c
        self.row = self.first + i
        size = Number(c, "%size", WHOLE)
        self.base = c.address("%values", self.row * size, REAL)
        self._point_at_others()
        for place in (self.fault, self.calls):
            c.set(place, c.number(0, WHOLE))
        c.loop(Number(c, "%turns", WHOLE), self._turn)
        told = c.address("%told", self.row * len(TOLD), REAL)
        for k, place in enumerate((self.fault, self.calls)):
            c.store(told, k, c.get(place, WHOLE).to(REAL))

    def _point_at_others(self) -> None:
        """Addresses of the values that others have in this chain."""
        c, others = self.c, Number(self.c, "%others", WHOLE)

        def body(k: Number) -> None:
            place, first, step = (c.load("%moving", k * 3 + j, WHOLE) for j in range(3))
            c.store("%arguments", place, first + step * self.row)

        c.when(others > 0, lambda: c.loop(others, body))

    def _turn(self, turn: Number) -> None:
        c = self.c
        turns = Number(c, "%turns", WHOLE)
        self.seed = c.address("%seeds", (self.row * turns + turn) * 4, WHOLE)
        start = c.load("%starts", turn, WHOLE)
        self.count = c.load("%starts", turn + 1, WHOLE) - start
        self.line = c.load("%lines", turn, WHOLE)
        self.growth = c.load("%growth", turn, REAL)
        own = self.row * self.sites + start
        self.width, self.low, self.high = (
            c.address(f"%{n}", own, REAL) for n in ("width", "low", "high")
        )
        self.places, self.answers = (
            c.address(f"%{n}", start, WHOLE) for n in ("places", "answers")
        )
        self.size = Number(c, "%size", WHOLE)
        tried = c.address("%memory", self.count * _VECTORS, REAL)
        c.loop(self.size, lambda k: c.store(tried, k, c.load(self.base, k, REAL)))
        self._begin()
        self._level()
        c.when(c.get(self.fault, WHOLE).eq(0), self._moved)

    def _begin(self) -> None:
        """Where the numbers are along their lines, and first intervals about them."""
        c = self.c

        def place(i: Number) -> None:
            stored = c.load(self.base, c.load(self.places, i, WHOLE), REAL)
            now = c.variable(c.where(self.whole.ne(0), stored.bits().to(REAL), stored))
            c.when(
                self.line.eq(1),
                lambda: c.set(
                    now, elementary(c, "log", c.get(now, REAL) - c.load(self.low, i, REAL))
                ),
            )
            # a number uniform in the cell of each integer
            c.when(self.line.eq(2), lambda: c.set(now, c.get(now, REAL) + self._drawn()))
            c.store(self._vector(_NOW), i, c.get(now, REAL))
            c.store(self._vector(_OPEN), i, c.number(1, WHOLE))

        def interval(i: Number) -> None:
            width, now = c.load(self.width, i, REAL), c.load(self._vector(_NOW), i, REAL)
            left = now - width * self._drawn()
            c.store(self._vector(_LEFT), i, left)
            c.store(self._vector(_RIGHT), i, left + width)

        self._each(place)
        self._each(interval)

    def _level(self) -> None:
        """How high the slices lie, and by how many widths they may grow to either side."""
        c = self.c
        self._look(_NOW, own=True)

        def level(i: Number) -> None:
            log = c.load(self._vector(_LOG), i, REAL)
            zero = ~(log > float("-inf"))
            c.set(self.fault, c.get(self.fault, WHOLE) | zero.to(WHOLE))
            c.store(self._vector(_LEVEL), i, log + elementary(c, "log", self._drawn()))

        def split(i: Number) -> None:
            first = c.call("llvm.floor.f64", self.growth * self._drawn())
            c.store(self._vector(_LESS), i, first)
            c.store(self._vector(_MORE), i, self.growth - 1.0 - first)

        self._each(level)
        self._each(split)

    def _moved(self) -> None:
        c = self.c
        self._stepped_out(_LEFT, _LESS, -1.0)
        self._stepped_out(_RIGHT, _MORE, 1.0)

        def clip(i: Number) -> None:
            low, high = self._ends(i)
            for side in (_LEFT, _RIGHT):
                end = c.load(self._vector(side), i, REAL)
                end = c.where(end < low, low, end)
                c.store(self._vector(side), i, c.where(end > high, high, end))
            c.store(self._vector(_OPEN), i, c.number(1, WHOLE))

        self._each(clip)
        c.set(self.tries, c.number(0, WHOLE))
        c.repeat(self._shrunk)
        c.when(
            c.get(self.any, WHOLE).ne(0),
            lambda: c.set(self.fault, c.number(NOWHERE, WHOLE)),
        )
        c.when(c.get(self.any, WHOLE).eq(0), lambda: self._each(self._put))

    def _ends(self, i: Number) -> tuple[Number, Number]:
        """Bounds along the line: logarithms have none, and the cell of the last integer belongs to it."""
        c = self.c
        low, high = c.load(self.low, i, REAL), c.load(self.high, i, REAL)
        low = c.where(self.line.eq(1), float("-inf"), low)
        return low, c.where(self.line.eq(2), high + 1.0, high)

    def _open_if(self, i: Number, condition: Number) -> None:
        """Whether a site goes on; ``any`` remembers that one does."""
        c = self.c
        c.store(self._vector(_OPEN), i, condition.to(WHOLE))
        c.set(self.any, c.get(self.any, WHOLE) | condition.to(WHOLE))

    def _stepped_out(self, side: int, left: int, sign: float) -> None:
        """Ends that step away while the density there is above the level."""
        c = self.c

        def within(i: Number, end: Number) -> Number:
            low, high = self._ends(i)
            return (end > low) & (end < high)

        def begin(i: Number) -> None:
            self._open_if(i, within(i, c.load(self._vector(side), i, REAL)))

        def above(i: Number) -> None:
            higher = c.load(self._vector(_LOG), i, REAL) > c.load(self._vector(_LEVEL), i, REAL)
            more = c.load(self._vector(left), i, REAL) > 0.0
            going = c.load(self._vector(_OPEN), i, WHOLE).ne(0) & higher & more
            end = c.load(self._vector(side), i, REAL)
            end = c.where(going, end + c.load(self.width, i, REAL) * sign, end)
            c.store(self._vector(side), i, end)
            taken = c.load(self._vector(left), i, REAL) - c.where(going, c.number(1.0), 0.0)
            c.store(self._vector(left), i, taken)
            self._open_if(i, going & within(i, end))

        def once() -> Number:
            self._look(side)
            c.set(self.any, c.number(0, WHOLE))
            self._each(above)
            return c.get(self.any, WHOLE).ne(0)

        c.set(self.any, c.number(0, WHOLE))
        self._each(begin)
        c.when(c.get(self.any, WHOLE).ne(0), lambda: c.repeat(once))

    def _shrunk(self) -> Number:
        """One more point of every interval, which ends there where it misses; whether to go on."""
        c = self.c

        def draw(i: Number) -> None:
            left, right = (c.load(self._vector(s), i, REAL) for s in (_LEFT, _RIGHT))
            at = left + self._drawn() * (right - left)
            below = at < c.load(self._vector(_NOW), i, REAL)
            c.store(self._vector(_AT), i, at)
            c.store(self._vector(_LEFT), i, c.where(below, at, left))
            c.store(self._vector(_RIGHT), i, c.where(below, right, at))

        def judge(i: Number) -> None:
            hit = c.load(self._vector(_LOG), i, REAL) > c.load(self._vector(_LEVEL), i, REAL)
            is_open = c.load(self._vector(_OPEN), i, WHOLE).ne(0)
            at, found = (c.load(self._vector(v), i, REAL) for v in (_AT, _FOUND))
            c.store(self._vector(_FOUND), i, c.where(is_open & hit, at, found))
            self._open_if(i, is_open & ~hit)

        self._each(draw)
        self._look(_AT)
        c.set(self.any, c.number(0, WHOLE))
        self._each(judge)
        tries = c.get(self.tries, WHOLE) + 1
        c.set(self.tries, tries)
        return c.get(self.any, WHOLE).ne(0) & (tries < SHRINKAGES)

    def _put(self, i: Number) -> None:
        """A number to where its slice led it."""
        c = self.c
        at, low = c.load(self._vector(_FOUND), i, REAL), c.load(self.low, i, REAL)
        value = c.op(
            REAL,
            f"call double @value(i64 {self.line.text}, double {at.text}, double {low.text})",
        )
        stored = c.where(self.whole.ne(0), value.to(WHOLE).bits(), value)
        c.store(self.base, c.load(self.places, i, WHOLE), stored)
