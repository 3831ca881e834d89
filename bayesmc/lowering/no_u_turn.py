"""One transition of the No-U-Turn sampler as machine code: trees of all chains, one chain after the other.

The text is the same for every density, whose compiled value and gradient are called from inside, so it is
compiled once for all. The tree is that of ``kernels.no_u_turn``, where its definition and sources stand:
given the same momenta and uniform numbers, both grow the same one.

Random numbers are those of xoshiro256++, which each chain begins with a state of its own at every transition:
whoever hands it in from a generator that is kept can go on where a run was cut.

References
----------
Blackman and Vigna (2021), Scrambled linear pseudorandom number generators, ACM TOMS 47(4).
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from bayesmc.lowering.code import REAL, TRUTH, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary
from bayesmc.lowering.machine import loaded

#: error of the energy beyond which a trajectory has left the level set that it should follow
DIVERGENT = 1000.0
#: what is told of each transition, in this order
TOLD = ("acceptance", "leaves", "depth", "divergent", "energy")
#: vectors of one chain's memory: the end that grows, what a new subtree has drawn, both ends, the sum of
#: momenta, a velocity; then three for each tree that waits: momenta of its first and last leaf, and the sum
_U, _P, _PULL, _SLOPE, _NEW_U, _NEW_SLOPE, _ENDS, _SUM, _VELOCITY, _PENDING = (
    *range(6),
    6,
    12,
    13,
    14,
)
#: what a trajectory is made of: whole numbers, then addresses
_WHOLES = ("first", "last", "size", "max_depth", "dense", "others")
_POINTERS = (
    "gradient", "arguments", "moving", "fallback", "memory", "u", "log", "slope", "momenta", "step", "root",
    "seeds", "told",
)  # fmt: skip

#: ``int32 f(int64 chain, double *u, double *value, double *gradient)``: where machine code cannot tell
FALLBACK: Any = ctypes.CFUNCTYPE(
    ctypes.c_int32, ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p
)


def numbers_of(size: int, max_depth: int) -> int:
    """Numbers of memory that the trees of chains of so many numbers need."""
    return size * (_PENDING + 3 * (max_depth + 1))


@lru_cache(maxsize=1)
def transitions() -> Any:
    """The function ``void f(...)`` of ``_WHOLES`` and ``_POINTERS``, where there is a compiler.

    It moves chains ``first`` to ``last - 1``. ``u``, ``log`` and ``slope`` are where they are, and will be;
    ``momenta`` (chains, size); ``step`` (chains,); ``root`` (size,) or, ``dense``, (size, size); ``seeds``
    (chains, 4); ``told`` (chains, len(TOLD)). ``moving`` has for each of ``others`` the place in
    ``arguments``, the address of the first chain's value and the bytes to the next one's.
    """
    module = Module()
    texts = [_turns(module), _copied(module), uniform(module), _Text(module).text]
    code = loaded("\n".join([str(module), *texts]), module.foreign)
    types = [ctypes.c_int64] * len(_WHOLES) + [ctypes.c_void_p] * len(_POINTERS)
    found = code.function("transitions", None, *types)
    found.code = code  # the function lives as long as this
    return found


def uniform(module: Module) -> str:
    """The function of a number above 0 and up to 1, by xoshiro256++."""
    c = Code(module)
    s = [c.load("%seed", k, WHOLE) for k in range(4)]

    def rotated(x: Number, by: int) -> Number:
        return c.call("llvm.fshl.i64", x, x, c.number(by, WHOLE), kind=WHOLE)

    found = rotated(s[0] + s[3], 23) + s[0]
    t = s[1].shifted(17)
    third, fourth = s[2] ^ s[0], s[3] ^ s[1]
    for k, value in enumerate((s[0] ^ fourth, s[1] ^ third, third ^ t, rotated(fourth, 45))):
        c.store("%seed", k, value)
    top = c.op(WHOLE, f"lshr i64 {found.text}, 11")
    c.do(f"ret double {((top + 1).to(REAL) * 2.0**-53).text}")
    return f"define internal double @uniform(ptr %seed) {{\n{c}\n}}"


# ---- private ------------------------------------------------------------------------------------


def _added(c: Code, place: str, value: Number) -> None:
    """A sum in any order, so that it is made of vectors."""
    old = c.get(place, REAL)
    c.set(place, c.op(REAL, f"fadd reassoc double {old.text}, {value.text}"))


def _turns(module: Module) -> str:
    """``kernels.no_u_turn.turning_back`` of one chain."""
    c = Code(module)
    sums = [c.variable(c.number(0.0)) for _ in range(6)]

    def body(i: Number) -> None:
        names = ("af", "al", "as", "bf", "bl", "bs")
        af, al, a, bf, bl, b = (c.load(f"%{n}", i, REAL) for n in names)
        whole, into, out_of = a + b, a + bf, b + al
        pairs = ((af, whole), (bl, whole), (af, into), (bf, into), (al, out_of), (bl, out_of))
        for place, (momentum, total) in zip(sums, pairs, strict=True):
            _added(c, place, momentum * total)

    c.loop(Number(c, "%n", WHOLE), body)
    fine = c.get(sums[0], REAL) > 0.0
    for place in sums[1:]:
        fine = fine & (c.get(place, REAL) > 0.0)
    c.do(f"ret i1 {(~fine).text}")
    head = "i64 %n, ptr %af, ptr %al, ptr %as, ptr %bf, ptr %bl, ptr %bs"
    return f"define internal i1 @turns({head}) noinline {{\n{c}\n}}"


def _copied(module: Module) -> str:
    """A vector to another place: one function, since its loop would else be compiled wherever it is used."""
    c = Code(module)
    n = Number(c, "%n", WHOLE)
    c.loop(n, lambda i: c.store("%to", i, c.load("%from", i, REAL)))
    c.do("ret void")
    return f"define internal void @copied(i64 %n, ptr noalias %from, ptr noalias %to) noinline {{\n{c}\n}}"


class _Text:
    """The text of ``transitions``; what chains read and write stands under its names."""

    def __init__(self, module: Module) -> None:
        self.c = c = Code(module)
        self.n, self.first = Number(c, "%size", WHOLE), Number(c, "%first", WHOLE)
        self.value = c.variable(c.number(0.0))
        zero, naught = c.number(0.0), c.number(0, WHOLE)
        for name in ("energy", "weight", "new", "log", "accepted", "half"):
            setattr(self, name, c.variable(zero))
        for name in ("depth", "leaf", "leaves", "top", "carry", "ended", "diverged", "side"):
            setattr(self, name, c.variable(naught))
        c.loop(Number(c, "%last", WHOLE) - self.first, self._chain)
        c.do("ret void")
        head = [*(f"i64 %{n}" for n in _WHOLES), *(f"ptr %{n}" for n in _POINTERS)]
        self.text = f"define void @transitions({', '.join(head)}) {{\n{c}\n}}"

    energy: str
    weight: str
    new: str
    log: str
    accepted: str
    half: str
    depth: str
    leaf: str
    leaves: str
    top: str
    carry: str
    ended: str
    diverged: str
    side: str

    # ---- small change --------------------------------------------------------------------------

    def _real(self, place: str) -> Number:
        return self.c.get(place, REAL)

    def _whole(self, place: str) -> Number:
        return self.c.get(place, WHOLE)

    def _vector(self, number: Any) -> str:
        """One of the vectors of the chain's memory."""
        number = number if isinstance(number, Number) else self.c.number(number, WHOLE)
        return self.c.address("%memory", number * self.n, REAL)

    def _row(self, name: str) -> str:
        """The chain's row of an array ``(chains, size)``."""
        return self.c.address(f"%{name}", self.row * self.n, REAL)

    def _each(self, body: Callable[[Number], None]) -> None:
        self.c.loop(self.n, body)

    def _copy(self, source: str, target: str) -> None:
        self.c.do(f"call void @copied(i64 {self.n.text}, ptr {source}, ptr {target})")

    def _drawn(self) -> Number:
        """The logarithm of a uniform number."""
        seed = self.c.address("%seeds", self.row * 4, WHOLE)
        return elementary(self.c, "log", self.c.op(REAL, f"call double @uniform(ptr {seed})"))

    def _turned(self, first: list[str], second: list[str]) -> Number:
        args = ", ".join(f"ptr {p}" for p in (*first, *second))
        return self.c.op(TRUTH, f"call i1 @turns(i64 {self.n.text}, {args})")

    def _tree(self, level: Number) -> list[str]:
        """A tree that waits: momenta of its first leaf and its last, and the sum."""
        return [self._vector(level * 3 + (_PENDING + k)) for k in range(3)]

    # ---- one chain -----------------------------------------------------------------------------

    def _chain(self, i: Number) -> None:
        c = self.c
        self.row = self.first + i
        self._point_at_others()
        momenta = self._row("momenta")
        self._pull(self._row("slope"), self._vector(_PULL))
        for side in (0, 1):
            for k, source in enumerate((self._row("u"), momenta, self._vector(_PULL))):
                self._copy(source, self._vector(_ENDS + 3 * side + k))
        self._copy(momenta, self._vector(_SUM))
        c.set(self.energy, self._hamiltonian(momenta, c.load("%log", self.row, REAL)))
        for place in (self.weight, self.accepted):
            c.set(place, c.number(0.0))
        for place in (self.depth, self.leaves, self.ended, self.diverged):
            c.set(place, c.number(0, WHOLE))
        c.repeat(self._double)
        leaves = self._whole(self.leaves).to(REAL)
        told = c.address("%told", self.row * len(TOLD), REAL)
        depth, diverged = self._whole(self.depth).to(REAL), self._whole(self.diverged).to(REAL)
        accepted = self._real(self.accepted) / leaves
        for k, value in enumerate((accepted, leaves, depth, diverged, self._real(self.energy))):
            c.store(told, k, value)

    def _point_at_others(self) -> None:
        """Addresses of the values that others have in this chain."""
        c, others = self.c, Number(self.c, "%others", WHOLE)

        def body(k: Number) -> None:
            place, first, step = (c.load("%moving", k * 3 + j, WHOLE) for j in range(3))
            c.store("%arguments", place, first + step * self.row)

        c.when(others > 0, lambda: c.loop(others, body))

    def _double(self) -> Number:
        """Double the tree; whether it goes on."""
        c = self.c
        seed = c.address("%seeds", self.row * 4, WHOLE)
        forwards = c.op(REAL, f"call double @uniform(ptr {seed})") < 0.5
        c.set(self.side, forwards.to(WHOLE))
        step = c.load("%step", self.row, REAL) * 0.5
        c.set(self.half, c.where(forwards, step, -step))
        for k, part in enumerate((_U, _P, _PULL)):
            self._copy(self._vector(self._end(k)), self._vector(part))
        c.set(self.leaf, c.number(0, WHOLE))
        c.set(self.top, c.number(0, WHOLE))
        c.repeat(self._grow)
        c.when(self._whole(self.ended).eq(0), self._joined)
        more = self._whole(self.depth) < Number(c, "%max_depth", WHOLE)
        return more & self._whole(self.ended).eq(0)

    def _end(self, part: int) -> Number:
        return self._whole(self.side) * 3 + (_ENDS + part)

    def _joined(self) -> None:
        """The new subtree is taken in."""
        c = self.c
        c.set(self.depth, self._whole(self.depth) + 1)
        c.when(self._drawn() < self._real(self.new) - self._real(self.weight), self._take)
        outer = self._vector((1 - self._whole(self.side)) * 3 + (_ENDS + 1))
        inner, total = self._vector(self._end(1)), self._vector(_SUM)
        tree = self._tree(c.number(0, WHOLE))
        turned = self._turned([outer, inner, total], tree)
        c.set(self.ended, turned.to(WHOLE))
        c.set(
            self.weight, elementary(c, "logaddexp", self._real(self.weight), self._real(self.new))
        )
        self._each(lambda i: c.store(total, i, c.load(total, i, REAL) + c.load(tree[2], i, REAL)))
        for k, part in enumerate((_U, _P, _PULL)):
            self._copy(self._vector(part), self._vector(self._end(k)))

    def _take(self) -> None:
        """What the subtree drew is where the chain is."""
        self._copy(self._vector(_NEW_U), self._row("u"))
        self._copy(self._vector(_NEW_SLOPE), self._row("slope"))
        self.c.store("%log", self.row, self._real(self.log))

    # ---- one leaf ------------------------------------------------------------------------------

    def _grow(self) -> Number:
        """One more leaf of the subtree; whether there are to be more."""
        c = self.c
        weight = self._leapt()
        c.set(self.leaves, self._whole(self.leaves) + 1)
        low = c.where(weight < 0.0, weight, c.number(0.0))
        _added(c, self.accepted, elementary(c, "exp", low))
        bad = ~(weight >= -DIVERGENT)
        c.set(self.diverged, bad.to(WHOLE))
        c.set(self.ended, bad.to(WHOLE))
        c.when(~bad, lambda: self._counted(weight))
        leaf = self._whole(self.leaf) + 1
        c.set(self.leaf, leaf)
        count = c.op(WHOLE, f"shl i64 1, {self._whole(self.depth).text}")
        return (leaf < count) & self._whole(self.ended).eq(0)

    def _counted(self, weight: Number) -> None:
        """A leaf that is none too far: it may be drawn, and its tree joins those that wait."""
        c = self.c
        first = self._whole(self.leaf).eq(0)
        both = elementary(c, "logaddexp", self._real(self.new), weight)
        total = c.where(first, weight, both)
        c.set(self.new, total)
        c.when((self._drawn() < weight - total) | first, self._keep)
        for part in self._tree(self._whole(self.top)):
            self._copy(self._vector(_P), part)
        c.set(self.carry, self._whole(self.leaf))
        c.when((self._whole(self.carry) & 1).ne(0), lambda: c.repeat(self._merged))
        c.set(self.top, self._whole(self.top) + 1)

    def _keep(self) -> None:
        self._copy(self._vector(_U), self._vector(_NEW_U))
        self._copy(self._vector(_SLOPE), self._vector(_NEW_SLOPE))
        self.c.set(self.log, self._real(self.value))

    def _merged(self) -> Number:
        """The last two trees that wait are one; whether it meets another of its size."""
        c = self.c
        top = self._whole(self.top) - 1
        one, other = self._tree(top), self._tree(top + 1)
        turned = self._turned(one, other)
        c.set(self.ended, self._whole(self.ended) | turned.to(WHOLE))
        self._copy(other[1], one[1])
        self._each(
            lambda i: c.store(one[2], i, c.load(one[2], i, REAL) + c.load(other[2], i, REAL))
        )
        c.set(self.top, top)
        carry = self._whole(self.carry).shifted(-1)
        c.set(self.carry, carry)
        return (carry & 1).ne(0)

    def _leapt(self) -> Number:
        """A step of the leapfrog integrator; the logarithm of its leaf's weight."""
        c = self.c
        u, p, pull, slope = (self._vector(k) for k in (_U, _P, _PULL, _SLOPE))
        half = self._real(self.half)

        def kick(i: Number) -> None:
            c.store(p, i, c.load(p, i, REAL) + half * c.load(pull, i, REAL))

        self._each(kick)
        velocity = self._vector(_VELOCITY)
        self._push(p, velocity)
        self._each(
            lambda i: c.store(u, i, c.load(u, i, REAL) + 2.0 * half * c.load(velocity, i, REAL))
        )
        self._evaluate(u, slope)
        self._pull(slope, pull)
        self._each(kick)
        return self._real(self.energy) - self._hamiltonian(p, self._real(self.value))

    def _hamiltonian(self, momenta: str, log: Number) -> Number:
        """``kernels.no_u_turn.energy_of``."""
        c = self.c
        total = c.variable(c.number(0.0))

        def body(i: Number) -> None:
            p = c.load(momenta, i, REAL)
            _added(c, total, p * p)

        self._each(body)
        found = 0.5 * c.get(total, REAL) - log
        return c.where(found.is_nan(), c.number(math.inf), found)

    def _evaluate(self, u: str, slope: str) -> None:
        """The log density and its gradient: minus infinity and 0 where they are no numbers."""
        c, value = self.c, self.value
        done = c.variable(c.number(0, WHOLE))
        known = c.op(TRUTH, "icmp ne ptr %gradient, null")

        def compiled() -> None:
            args = f"i64 1, ptr {u}, ptr {value}, ptr {slope}, ptr %arguments"
            found = c.op("i32", f"call i32 %gradient({args})")
            c.set(done, c.op(TRUTH, f"icmp eq i32 {found.text}, 0").to(WHOLE))

        def fallback() -> None:
            args = f"i64 {self.row.text}, ptr {u}, ptr {value}, ptr {slope}"
            c.op("i32", f"call i32 %fallback({args})")

        c.when(known, compiled)
        c.when(c.get(done, WHOLE).eq(0), fallback)
        found = self._real(value)
        finite = self._is_finite(found)
        c.set(value, c.where(finite, found, c.number(-math.inf)))

        def clean(i: Number) -> None:
            own = c.load(slope, i, REAL)
            c.store(slope, i, c.where(finite & self._is_finite(own), own, c.number(0.0)))

        self._each(clean)

    def _is_finite(self, x: Number) -> Number:
        return self.c.call("llvm.fabs.f64", x) < math.inf

    # ---- the metric ----------------------------------------------------------------------------

    def _push(self, p: str, velocity: str) -> None:
        """``Scale.pushed``: rows of a matrix, or one number each."""
        c, dense = self.c, Number(self.c, "%dense", WHOLE)

        def row(i: Number) -> None:
            total, own = c.variable(c.number(0.0)), c.address("%root", i * self.n, REAL)
            self._each(lambda j: _added(c, total, c.load(own, j, REAL) * c.load(p, j, REAL)))
            c.store(velocity, i, c.get(total, REAL))

        c.when(dense.ne(0), lambda: self._each(row))
        c.when(dense.eq(0), lambda: self._scaled(p, velocity))

    def _pull(self, slope: str, pull: str) -> None:
        """``Scale.pulled``: columns of a matrix, or one number each."""
        c, dense = self.c, Number(self.c, "%dense", WHOLE)

        def row(i: Number) -> None:
            own, times = c.address("%root", i * self.n, REAL), c.load(slope, i, REAL)
            self._each(
                lambda j: c.store(pull, j, c.load(pull, j, REAL) + times * c.load(own, j, REAL))
            )

        def columns() -> None:
            self._each(lambda j: c.store(pull, j, c.number(0.0)))
            self._each(row)

        c.when(dense.ne(0), columns)
        c.when(dense.eq(0), lambda: self._scaled(slope, pull))

    def _scaled(self, source: str, target: str) -> None:
        c = self.c
        self._each(lambda i: c.store(target, i, c.load(source, i, REAL) * c.load("%root", i, REAL)))
