"""LLVM's language as Python writes it: numbers with operators, functions with loops, a module of both.

Text alone: nothing here needs a compiler.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

REAL, WHOLE, TRUTH = "double", "i64", "i1"
#: how a type lies in memory
STORED = {REAL: "double", WHOLE: "i64", TRUTH: "i8", "ptr": "ptr"}

#: a number of a loop or known ahead
Index = Any


class Number:
    """A value in a register."""

    __slots__ = ("code", "kind", "text")

    def __init__(self, code: Code, text: str, kind: str) -> None:
        self.code, self.text, self.kind = code, text, kind

    def _with(self, real: str, whole: str, other: Any, truth: str = "") -> Number:
        name = {REAL: real, WHOLE: whole, TRUTH: truth}[self.kind]
        return self.code.op(self.kind, f"{name} {self.kind} {self.text}, {self._same(other).text}")

    def _same(self, other: Any) -> Number:
        return other if isinstance(other, Number) else self.code.number(other, self.kind)

    def _compared(self, real: str, whole: str, other: Any) -> Number:
        name = f"fcmp {real}" if self.kind == REAL else f"icmp {whole}"
        return self.code.op(TRUTH, f"{name} {self.kind} {self.text}, {self._same(other).text}")

    def __add__(self, other: Any) -> Number:
        return self._with("fadd", "add", other)

    def __radd__(self, other: Any) -> Number:
        return self._same(other) + self

    def __sub__(self, other: Any) -> Number:
        return self._with("fsub", "sub", other)

    def __rsub__(self, other: Any) -> Number:
        return self._same(other) - self

    def __mul__(self, other: Any) -> Number:
        return self._with("fmul", "mul", other)

    def __rmul__(self, other: Any) -> Number:
        return self._same(other) * self

    def __truediv__(self, other: Any) -> Number:
        return self._with("fdiv", "", other)

    def __rtruediv__(self, other: Any) -> Number:
        return self._same(other) / self

    def __neg__(self) -> Number:
        if self.kind == REAL:
            return self.code.op(REAL, f"fneg double {self.text}")
        return 0 - self

    def __and__(self, other: Any) -> Number:
        return self._with("", "and", other, "and")

    def __or__(self, other: Any) -> Number:
        return self._with("", "or", other, "or")

    def __xor__(self, other: Any) -> Number:
        return self._with("", "xor", other, "xor")

    def __invert__(self) -> Number:
        return self ^ -1 if self.kind == WHOLE else self ^ True

    def __lt__(self, other: Any) -> Number:
        return self._compared("olt", "slt", other)

    def __le__(self, other: Any) -> Number:
        return self._compared("ole", "sle", other)

    def __gt__(self, other: Any) -> Number:
        return self._compared("ogt", "sgt", other)

    def __ge__(self, other: Any) -> Number:
        return self._compared("oge", "sge", other)

    def eq(self, other: Any) -> Number:
        return self._compared("oeq", "eq", other)

    def ne(self, other: Any) -> Number:
        return self._compared("une", "ne", other)

    def below(self, bound: int) -> Number:
        """Whether a whole number is one of ``0 .. bound - 1``."""
        return self.code.op(TRUTH, f"icmp ult i64 {self.text}, {bound}")

    def shifted(self, left: int) -> Number:
        """A whole number's bits moved to the left, or to the right with its sign."""
        name = "shl" if left > 0 else "ashr"
        return self.code.op(WHOLE, f"{name} i64 {self.text}, {abs(left)}")

    def is_nan(self) -> Number:
        return self.code.op(TRUTH, f"fcmp uno double {self.text}, {self.text}")

    def bits(self) -> Number:
        """The bits of a real number as a whole one, or back."""
        other = WHOLE if self.kind == REAL else REAL
        return self.code.op(other, f"bitcast {self.kind} {self.text} to {other}")

    def to(self, kind: str) -> Number:
        """The same number in another type, as NumPy casts it."""
        if kind == self.kind:
            return self
        if kind == TRUTH:
            return self.ne(0)
        if self.kind == TRUTH:
            name = "uitofp" if kind == REAL else "zext"
        else:
            name = "sitofp" if kind == REAL else "fptosi"
        return self.code.op(kind, f"{name} {self.kind} {self.text} to {kind}")


class Code:
    """The body of one function, block after block.

    Parameters
    ----------
    module : Module
        Where the functions that it calls are declared.
    """

    def __init__(self, module: Module) -> None:
        self.module = module
        self._entry: list[str] = []
        self._lines: list[str] = []
        self._count = 0
        self._block = "start"
        self._flags: str | None = None

    @property
    def size(self) -> int:
        """How many instructions there are."""
        return len(self._lines)

    def op(self, kind: str, text: str) -> Number:
        """The value of an instruction."""
        self._count += 1
        name = f"%v{self._count}"
        self._lines.append(f"  {name} = {text}")
        return Number(self, name, kind)

    def do(self, text: str) -> None:
        """An instruction without a value."""
        self._lines.append("  " + text)

    def number(self, value: Any, kind: str = REAL) -> Number:
        """A number that is known."""
        return Number(self, literal(value, kind), kind)

    def where(self, condition: Number, yes: Any, no: Any) -> Number:
        kind = next(v.kind for v in (yes, no) if isinstance(v, Number))
        a, b = (v if isinstance(v, Number) else self.number(v, kind) for v in (yes, no))
        return self.op(kind, f"select i1 {condition.text}, {kind} {a.text}, {kind} {b.text}")

    def call(self, name: str, *args: Any, kind: str = REAL, last: str = "") -> Number:
        """A function of the module's, the machine's or the C library's."""
        given = [a if isinstance(a, Number) else self.number(a) for a in args]
        self.module.declare(name, kind, [*(a.kind for a in given), *(["i32"] if last else [])])
        text = ", ".join(f"{a.kind} {a.text}" for a in given) + (f", i32 {last}" if last else "")
        return self.op(kind, f"call {kind} @{name}({text})")

    def fma(self, a: Any, b: Any, c: Any) -> Number:
        """``a * b + c``, rounded once where the machine can."""
        return self.call("llvm.fmuladd.f64", a, b, c)

    def polynomial(self, x: Number, coefficients: list[float]) -> Number:
        """By Horner's rule, from the highest power down."""
        found = self.number(coefficients[0])
        for c in coefficients[1:]:
            found = self.fma(found, x, c)
        return found

    def variable(self, start: Number, once: bool = False) -> str:
        """A place for a value that changes; ``once``: it starts with the function, not here."""
        self._count += 1
        name = f"%m{self._count}"
        self._entry.append(f"  {name} = alloca {start.kind}")
        if once:
            self._entry.append(f"  store {start.kind} {start.text}, ptr {name}")
        else:
            self.set(name, start)
        return name

    def memory(self, count: int, kind: str = REAL) -> str:
        """Where so many numbers have a place while the function runs."""
        self._count += 1
        self._entry.append(f"  %m{self._count} = alloca {STORED[kind]}, i64 {count}")
        return f"%m{self._count}"

    def get(self, place: str, kind: str) -> Number:
        return self.op(kind, f"load {kind}, ptr {place}")

    def set(self, place: str, value: Number) -> None:
        self.do(f"store {value.kind} {value.text}, ptr {place}")

    def address(self, pointer: str, at: Index, kind: str) -> str:
        text = str(at) if isinstance(at, int) else at.text
        if text == "0":
            return pointer
        step = STORED[kind]
        return self.op("ptr", f"getelementptr inbounds {step}, ptr {pointer}, i64 {text}").text

    def load(self, pointer: str, at: Index, kind: str) -> Number:
        place = self.address(pointer, at, kind)
        found = self.op(kind, f"load {STORED[kind]}, ptr {place}")
        return found if kind != TRUTH else self.op(TRUTH, f"icmp ne i8 {found.text}, 0")

    def store(self, pointer: str, at: Index, value: Number) -> None:
        place, text = self.address(pointer, at, value.kind), value.text
        if value.kind == TRUTH:
            text = self.op(TRUTH, f"zext i1 {text} to i8").text
        self.do(f"store {STORED[value.kind]} {text}, ptr {place}")

    def flag(self, condition: Number, bit: int) -> None:
        """Set a bit of ``flags`` where a condition holds."""
        if self._flags is None:
            self._flags = self.variable(self.number(0, WHOLE), once=True)
        found = self.get(self._flags, WHOLE) | self.where(condition, self.number(bit, WHOLE), 0)
        self.set(self._flags, found)

    @property
    def flags(self) -> Number:
        """The bits that were set."""
        return self.number(0, WHOLE) if self._flags is None else self.get(self._flags, WHOLE)

    def loop(self, count: Any, body: Callable[[Number], None]) -> None:
        """``body(i)`` for i = 0, 1, ... below a count of at least one."""
        self._count += 1
        head, end, before = f"loop{self._count}", f"end{self._count}", self._block
        i, following = Number(self, f"%i{self._count}", WHOLE), f"%n{self._count}"
        many = str(count) if isinstance(count, int) else count.text
        self.do(f"br label %{head}")
        self._lines.append(f"{head}:")
        at = len(self._lines)
        self._lines.append("")
        self._block = head
        body(i)
        self.do(f"{following} = add nuw nsw i64 {i.text}, 1")
        done = self.op(TRUTH, f"icmp eq i64 {following}, {many}")
        self.do(f"br i1 {done.text}, label %{end}, label %{head}")
        self._lines[at] = f"  {i.text} = phi i64 [ 0, %{before} ], [ {following}, %{self._block} ]"
        self._lines.append(f"{end}:")
        self._block = end

    def span(self, low: Number, high: Number, body: Callable[[Number], None]) -> None:
        """``body(i)`` for i from ``low`` to below ``high``, if any."""
        self.when(low < high, lambda: self.loop(high - low, lambda i: body(low + i)))

    def total(self, low: Number, high: Number, term: Callable[[Number], Number]) -> Number:
        """The sum of real terms over such a span, in the machine's order."""
        found = self.variable(self.number(0.0))

        def add(i: Number) -> None:
            old = self.get(found, REAL).text
            self.set(found, self.op(REAL, f"fadd reassoc double {old}, {term(i).text}"))

        self.span(low, high, add)
        return self.get(found, REAL)

    def when(self, condition: Number, body: Callable[[], None]) -> None:
        """``body()`` where a condition holds."""
        self._count += 1
        yes, after = f"when{self._count}", f"after{self._count}"
        self.do(f"br i1 {condition.text}, label %{yes}, label %{after}")
        self._begin(yes)
        body()
        self.do(f"br label %{after}")
        self._begin(after)

    def repeat(self, body: Callable[[], Number]) -> None:
        """``body()`` once, and again while what it gives is true."""
        self._count += 1
        head, end = f"repeat{self._count}", f"done{self._count}"
        self.do(f"br label %{head}")
        self._begin(head)
        again = body()
        self.do(f"br i1 {again.text}, label %{head}, label %{end}")
        self._begin(end)

    def _begin(self, block: str) -> None:
        self._lines.append(f"{block}:")
        self._block = block

    def __str__(self) -> str:
        return "\n".join(["start:", *self._entry, *self._lines])


class Module:
    """Functions that refer to each other."""

    def __init__(self) -> None:
        self._declared: dict[str, str] = {}
        self._defined: dict[str, str] = {}

    def declare(self, name: str, kind: str, arguments: list[str]) -> None:
        """A function that is without effects, and defined elsewhere unless it is here."""
        text = f"declare {kind} @{name}({', '.join(arguments)}) nounwind willreturn memory(none)"
        self._declared[name] = text

    def define(self, name: str, text: str) -> None:
        self._defined[name] = text

    def is_defined(self, name: str) -> bool:
        return name in self._defined

    @property
    def foreign(self) -> tuple[str, ...]:
        """Functions that are called and not defined."""
        return tuple(n for n in self._declared if n not in self._defined)

    def __str__(self) -> str:
        return "\n".join([*(self._declared[n] for n in self.foreign), *self._defined.values(), ""])


def literal(value: Any, kind: str) -> str:
    """A number as the language writes it."""
    if kind == REAL:
        return "0x" + struct.pack(">d", float(value)).hex().upper()
    return str(int(value)) if kind == WHOLE else ("true" if value else "false")
