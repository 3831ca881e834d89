"""Slices of a particle filter as machine code: several in one call, resampling included.

The text is the same for every template, whose compiled slice (``series.SliceKernel``) is called from inside,
so it is compiled once for all. Random numbers are those that NumPy's generator would hand out
(``generator``), in the order of the plain steps: where particles are resampled, one uniform for the comb;
then, block by block, the normals or uniform numbers of each hidden node.

A slice that is not what it should be (a parameter out of range, a weight that is no number, none that is
positive) is left alone, with the generator where it was, and so are all after it.
"""

from __future__ import annotations

import ctypes
import math
from functools import lru_cache
from typing import Any

from bayesmc.lowering.code import REAL, TRUTH, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary
from bayesmc.lowering.generator import draws
from bayesmc.lowering.machine import loaded
from bayesmc.lowering.weights import LARGE, SMALL, loops

#: what is told of a slice, in this order
TOLD = ("total", "log_total", "ess", "increment", "resampled", "unique", "worst")
#: what is told of a number in a slice: its mean and variance; by how much it lies off the mean without the
#: slice's row, and the variance there; the sum of what rows move it by, in units of its spread, and the
#: variance of that
MOMENTS = ("mean", "variance", "shift", "wide", "moved", "expected")
#: columns of ``at`` beside those of nodes
LOG, WEIGHTS, ANCESTORS = range(3)

_WHOLES = (
    "slices", "particles", "block", "nodes", "noises", "known", "rows_place", "log_place",
    "numbers", "strata",
)  # fmt: skip
_REALS = ("least", "log_particles", "fading", "kept", "least_expected")
_POINTERS = (
    "kernel", "arguments", "state", "ziggurat", "node", "noise", "moving", "at", "identity", "running",
    "told", "number", "moments", "points",
)  # fmt: skip


@lru_cache(maxsize=1)
def passes() -> Any:
    """The function ``int64 f(...)`` of ``_WHOLES``, ``_REALS`` and ``_POINTERS``, where there is a compiler.

    It makes up to so many slices, and gives how many it made. Row 0 of ``at`` and ``told`` is that of the
    slice before. Of each slice, ``at`` (slices + 1, 3 + nodes) has the addresses of log weights, weights,
    ancestors (one more than there are particles), and the values of each node.

    ``node`` (nodes, 3): where a node's values are results of the kernel, where those of the slice before are
    its leaves (either -1: nowhere), the bytes of one particle. ``noise`` (noises, 3): the address of a leaf
    of random numbers, how many one particle has, whether they are uniform. ``moving`` (known, 3): the place
    of a leaf that all particles share, the address of its value in the first slice, the bytes to the next
    one's. ``rows_place`` is where the kernel is told the ancestors (-1: nowhere), ``log_place`` where it
    leaves the log density of what is seen.

    Particles are resampled where they are worth less than ``least``, by a comb or, ``strata``, by a point in
    each stratum.

    ``number`` (numbers, 4) says of which numbers ``moments`` (slices + 1, numbers, len(MOMENTS)) are taken:
    the column of ``at``, how many numbers of a particle lie there and which one it is, whether its moves
    count for ``worst``: the largest sum of moves in units of what is expected of it. From slice to slice sums
    fade by ``fading`` and the worst by ``kept``.
    """
    code = loaded(*text())
    wholes, reals = [ctypes.c_int64] * len(_WHOLES), [ctypes.c_double] * len(_REALS)
    found = code.function(
        "slices", ctypes.c_int64, *wholes, *reals, *[ctypes.c_void_p] * len(_POINTERS)
    )
    found.code = code  # the function lives as long as this
    return found


@lru_cache(maxsize=1)
def text() -> tuple[str, tuple[str, ...]]:
    """The module of ``passes``, and the functions that it calls and does not define."""
    module = Module()
    texts = [*draws(module), *loops(module), _slices(module)]
    return "\n".join([str(module), *texts]), module.foreign


# ---- private ------------------------------------------------------------------------------------


def _slices(module: Module) -> str:
    made = _Text(module)
    head = [*(f"i64 %{n}" for n in _WHOLES), *(f"double %{n}" for n in _REALS)]
    head += [f"ptr noalias %{n}" for n in _POINTERS]
    return f"define i64 @slices({', '.join(head)}) {{\n{made.c}\n}}"


class _Text:
    """The text of ``slices``; what stands under its names is the present slice's."""

    def __init__(self, module: Module) -> None:
        self.c = c = Code(module)
        self.n, self.columns = Number(c, "%particles", WHOLE), Number(c, "%nodes", WHOLE) + 3
        naught = c.number(0, WHOLE)
        self.slice, self.unique = c.variable(naught), c.variable(naught)
        self.fine = c.variable(c.number(True, TRUTH))
        self.bad = c.variable(c.number(False, TRUTH))
        self.level, self.spent = (c.variable(c.number(0.0)) for _ in range(2))
        self.rows = c.variable(self._whole("ptrtoint ptr %identity to i64"))
        self.saved = [c.variable(naught) for _ in range(4)]
        c.repeat(self._slice)
        c.do(f"ret i64 {c.get(self.slice, WHOLE).text}")

    # ---- one slice -----------------------------------------------------------------------------

    def _slice(self) -> Number:
        c = self.c
        for k, place in enumerate(self.saved):
            c.set(place, c.load("%state", k, WHOLE))
        s = c.get(self.slice, WHOLE)
        self.before, self.now = s * self.columns, (s + 1) * self.columns
        self.old, self.new = s * len(TOLD), (s + 1) * len(TOLD)
        c.set(self.fine, c.number(True, TRUTH))
        resampled = self._told(self.old, "ess") < Number(c, "%least", REAL)
        c.set(self.rows, self._whole("ptrtoint ptr %identity to i64"))
        c.set(self.unique, self.n)
        c.set(self.spent, self._told(self.old, "log_total"))
        c.when(resampled, self._resample)
        c.when(c.get(self.fine, TRUTH), self._propagate)
        c.when(c.get(self.fine, TRUTH), lambda: self._level(resampled))
        c.when(c.get(self.fine, TRUTH), lambda: self._weigh(resampled))
        many = Number(c, "%numbers", WHOLE)
        is_asked = c.get(self.fine, TRUTH) & (many > 0)
        c.when(is_asked, lambda: c.loop(many, lambda k: self._moments(k, resampled)))
        c.when(~c.get(self.fine, TRUTH), self._back)
        step = c.where(c.get(self.fine, TRUTH), c.number(1, WHOLE), c.number(0, WHOLE))
        c.set(self.slice, s + step)
        return c.get(self.fine, TRUTH) & (c.get(self.slice, WHOLE) < Number(c, "%slices", WHOLE))

    def _back(self) -> None:
        for k, place in enumerate(self.saved):
            self.c.store("%state", k, self.c.get(place, WHOLE))

    def _resample(self) -> None:
        c, n = self.c, self.n
        weights, found = self._array(self.before, WEIGHTS), self._array(self.now, ANCESTORS)
        given = f"i64 {n.text}, ptr {weights}, ptr %running"
        total = c.op(REAL, f"call double @running({given})")
        c.set(self.fine, (total > SMALL) & (total < LARGE))
        c.set(self.spent, Number(c, "%log_particles", REAL))
        c.set(self.rows, self._whole(f"ptrtoint ptr {found} to i64"))

        def choose() -> None:
            scale = n.to(REAL) / total
            last = c.load("%running", n - 1, REAL) * scale
            c.loop(n + 1, lambda j: c.store(found, j, c.number(0, WHOLE)))
            sizes, arrays = f"i64 {n.text}, i64 {n.text}", f"ptr %running, ptr {found}"

            def comb() -> None:
                u = c.op(REAL, "call double @uniform(ptr %state)")
                shift = c.where(u.eq(0.0), 0.0, 1.0 - u)
                given = [f"double {x.text}" for x in (scale, last + shift, shift)]
                c.do(f"call void @systematic({', '.join([sizes, *given, arrays])})")

            def strata() -> None:
                c.do(f"call void @uniforms(i64 {n.text}, ptr %state, ptr %points)")
                c.store("%points", n, c.number(2.0))
                given = [f"double {x.text}" for x in (scale, last)]
                c.do(f"call void @stratified({', '.join([sizes, *given, 'ptr %points', arrays])})")

            is_stratified = Number(c, "%strata", WHOLE).ne(0)
            c.when(~is_stratified, comb)
            c.when(is_stratified, strata)
            c.set(self.unique, c.number(1, WHOLE))

            def other(j: Number) -> None:
                differs = c.load(found, j, WHOLE).ne(c.load(found, j + 1, WHOLE))
                c.set(self.unique, c.get(self.unique, WHOLE) + differs.to(WHOLE))

            c.when(n > 1, lambda: c.loop(n - 1, other))

        c.when(c.get(self.fine, TRUTH), choose)

    def _propagate(self) -> None:
        """Values and log densities, block by block."""
        c, n, size = self.c, self.n, Number(self.c, "%block", WHOLE)
        s = c.get(self.slice, WHOLE)

        def known(k: Number) -> None:
            place, first, step = (c.load("%moving", k * 3 + j, WHOLE) for j in range(3))
            c.store("%arguments", place, first + s * step)

        c.when(Number(c, "%known", WHOLE) > 0, lambda: c.loop(Number(c, "%known", WHOLE), known))

        def chosen(k: Number) -> None:
            place = c.load("%node", k * 3 + 1, WHOLE)
            first = c.load("%at", self.before + k + 3, WHOLE)
            c.when(place > -1, lambda: c.store("%arguments", place, first))

        c.loop(Number(c, "%nodes", WHOLE), chosen)

        def block(b: Number) -> None:
            low = b * size
            count = c.where(n - low < size, n - low, size)
            self._block(low, count)

        many = c.op(WHOLE, f"sdiv i64 {(n + size - 1).text}, {size.text}")
        c.loop(many, block)

    def _block(self, low: Number, count: Number) -> None:
        c = self.c

        def drawn(k: Number) -> None:
            first, many, even = (c.load("%noise", k * 3 + j, WHOLE) for j in range(3))
            to, numbers, is_even = self._pointer(first), (count * many).text, even.ne(0)
            normals = f"call void @normals(i64 {numbers}, ptr %state, ptr %ziggurat, ptr {to})"
            c.when(~is_even, lambda: c.do(normals))
            uniforms = f"call void @uniforms(i64 {numbers}, ptr %state, ptr {to})"
            c.when(is_even, lambda: c.do(uniforms))

        c.loop(Number(c, "%noises", WHOLE), drawn)

        def result(k: Number) -> None:
            place, step = (c.load("%node", k * 3 + j, WHOLE) for j in (0, 2))
            first = c.load("%at", self.now + k + 3, WHOLE)
            c.when(place > -1, lambda: c.store("%arguments", place, first + low * step))

        c.loop(Number(c, "%nodes", WHOLE), result)
        rows = Number(c, "%rows_place", WHOLE)
        c.when(rows > -1, lambda: c.store("%arguments", rows, c.get(self.rows, WHOLE) + low * 8))
        log = c.load("%at", self.now + LOG, WHOLE) + low * 8
        c.store("%arguments", Number(c, "%log_place", WHOLE), log)
        flags = c.op("i32", f"call i32 %kernel(i64 {count.text}, ptr %arguments)")
        right = c.op(TRUTH, f"icmp eq i32 {flags.text}, 0")
        c.set(self.fine, c.get(self.fine, TRUTH) & right)

    def _level(self, resampled: Number) -> None:
        """Log weights that particles bring along, and the largest of the sums."""
        c = self.c
        before, now = (self._array(at, LOG) for at in (self.before, self.now))

        def more(i: Number) -> None:
            c.store(now, i, c.load(now, i, REAL) + c.load(before, i, REAL))

        c.when(~resampled, lambda: c.loop(self.n, more))
        c.set(self.level, c.number(-math.inf))
        c.set(self.bad, c.number(False, TRUTH))

        def look(i: Number) -> None:
            log, top = c.load(now, i, REAL), c.get(self.level, REAL)
            c.set(self.bad, c.get(self.bad, TRUTH) | ~(log < math.inf))
            above = c.op(TRUTH, f"fcmp nnan nsz ogt double {log.text}, {top.text}")
            picked = f"i1 {above.text}, double {log.text}, double {top.text}"
            c.set(self.level, c.op(REAL, f"select nnan nsz {picked}"))

        c.loop(self.n, look)
        bad = c.get(self.bad, TRUTH)
        c.set(self.fine, ~bad)
        c.when(~bad, lambda: c.set(self.fine, c.get(self.level, REAL) > -math.inf))

    def _weigh(self, resampled: Number) -> None:
        c, new = self.c, self.new
        log, weights = self._array(self.now, LOG), self._array(self.now, WEIGHTS)
        level, sums = c.get(self.level, REAL), c.address("%told", new, REAL)
        worst = self._told(self.old, "worst") * Number(c, "%kept", REAL)
        given = f"i64 {self.n.text}, double {level.text}, ptr {log}, ptr {weights}, ptr {sums}"
        c.do(f"call void @exponentials({given})")
        total, squares = (c.load(sums, k, REAL) for k in range(2))
        log_total = level + elementary(c, "log", total)
        told = {
            "total": total, "log_total": log_total, "ess": total * total / squares, "worst": worst,
            "increment": log_total - c.get(self.spent, REAL), "resampled": resampled.to(REAL),
            "unique": c.get(self.unique, WHOLE).to(REAL),
        }  # fmt: skip
        for k, name in enumerate(TOLD):
            c.store("%told", new + k, told[name])

    def _moments(self, k: Number, resampled: Number) -> None:
        """Those of one number, and what the row moves it by."""
        c, n = self.c, self.n
        column, size, which, counts = (c.load("%number", k * 4 + j, WHOLE) for j in range(4))
        values = self._pointer(c.load("%at", self.now + column, WHOLE))
        weights, before = (self._array(at, WEIGHTS) for at in (self.now, self.before))
        total, zero = self._told(self.new, "total"), c.number(0.0)
        mean, variance, shift, square = (c.variable(zero) for _ in range(4))

        def value(i: Number) -> Number:
            return c.load(values, i * size + which, REAL)

        def add(place: str, term: Number) -> None:
            c.set(place, c.op(REAL, f"fadd reassoc double {c.get(place, REAL).text}, {term.text}"))

        c.loop(n, lambda i: add(mean, value(i) * c.load(weights, i, REAL)))
        c.set(mean, c.get(mean, REAL) / total)

        def terms(i: Number, is_even: bool) -> None:
            off = value(i) - c.get(mean, REAL)
            own = off if is_even else off * c.load(before, i, REAL)
            add(variance, off * (off * c.load(weights, i, REAL)))
            add(shift, own)
            add(square, own * off)

        c.when(resampled, lambda: c.loop(n, lambda i: terms(i, True)))
        c.when(~resampled, lambda: c.loop(n, lambda i: terms(i, False)))
        spent = c.where(resampled, n.to(REAL), self._told(self.old, "total"))
        own, off = c.get(variance, REAL) / total, c.get(shift, REAL) / spent
        wide = c.get(square, REAL) / spent - off * off
        many, s = Number(c, "%numbers", WHOLE), c.get(self.slice, WHOLE)
        at = [(row * many + k) * len(MOMENTS) for row in (s, s + 1)]
        fading, some = Number(c, "%fading", REAL), wide > 0.0
        moved, expected = (
            c.load("%moments", at[0] + MOMENTS.index(name), REAL) for name in ("moved", "expected")
        )
        root, left = c.call("llvm.sqrt.f64", wide), 1.0 - own / wide
        moved = moved * fading - c.where(some, off / root, 0.0)
        left = c.where(left > 0.0, left, 0.0)
        expected = expected * (fading * fading) + c.where(some, left, 0.0)
        for j, found in enumerate((c.get(mean, REAL), own, off, wide, moved, expected)):
            c.store("%moments", at[1] + j, found)
        spread = c.call("llvm.sqrt.f64", expected + Number(c, "%least_expected", REAL))
        far, worst = c.call("llvm.fabs.f64", moved) / spread, self._told(self.new, "worst")
        is_worse = counts.ne(0) & (far > worst)
        place = self.new + TOLD.index("worst")
        c.store("%told", place, c.where(is_worse, far, worst))

    # ---- private -------------------------------------------------------------------------------

    def _told(self, first: Number, name: str) -> Number:
        return self.c.load("%told", first + TOLD.index(name), REAL)

    def _whole(self, text: str) -> Number:
        return self.c.op(WHOLE, text)

    def _pointer(self, address: Number) -> str:
        return self.c.op("ptr", f"inttoptr i64 {address.text} to ptr").text

    def _array(self, first: Number, column: int) -> str:
        return self._pointer(self.c.load("%at", first + column, WHOLE))
