"""NumPy's random numbers in machine code: uniform and normal ones that a generator would hand out next.

The generator is SFC64 and the normals are NumPy's ziggurat, so that whoever draws here and whoever draws by
``numpy.random.Generator`` gets the same numbers from the same state. NumPy may change how it draws: before
the first use numbers and states of both are compared (``is_numpys``).

References
----------
Doty-Humphrey (2018), PractRand (SFC64); Marsaglia and Tsang (2000), The ziggurat method for generating random
variables, J. Stat. Software 5(8), with the layers of Doornik (2005).
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import numpy as np

from bayesmc.lowering.code import REAL, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary
from bayesmc.lowering.machine import loaded

#: layers of the ziggurat; bits of the number that is taken times a layer's width
_LAYERS, _BITS = 256, 52
#: numbers by which it is held against NumPy: some lie in the tail, some in wedges
_TRIED = 20_000


def draws(module: Module) -> list[str]:
    """Functions of a state: ``uniform``; ``uniforms`` and ``normals``, as many as asked for."""
    every = (_bits, _uniform, _uniforms, _rejected, _normals)
    return [written(module) for written in every]


@lru_cache(maxsize=1)
def ziggurat() -> np.ndarray:
    """Widths of the layers, bounds below which a number is taken at once (as bits), heights: (3, layers).

    The widths are those of NumPy, to the last bit: what it makes of a known state is a multiple of one.
    """
    bits = np.random.SFC64(0)
    normal, state = np.random.Generator(bits).standard_normal, bits.state
    unit, widths = 1 << (_BITS - 1), np.empty(_LAYERS)
    for layer in range(_LAYERS):
        state["state"]["state"][:] = (
            layer | unit << 9,
            0,
            1,
            0,
        )  # the next bits are the first of these
        bits.state = state
        widths[layer] = abs(normal()) / unit
    ends = widths * 2.0**_BITS
    bounds = np.zeros(_LAYERS, np.int64)
    bounds[0] = int(ends[-1] / widths[0])
    bounds[2:] = ends[1:-1] / widths[2:]
    heights = np.exp(-0.5 * ends**2)
    heights[0] = 1.0
    return np.array([widths, bounds.view(float), heights])


@lru_cache(maxsize=1)
def is_numpys() -> bool:
    """Whether numbers and states are those of this NumPy."""
    code = loaded(*text())
    pointer = ctypes.c_void_p
    run = code.function("normals", None, ctypes.c_int64, pointer, pointer, pointer)
    rng = np.random.Generator(np.random.SFC64(1))
    try:
        state, tables, found = state_of(rng), ziggurat(), np.empty(_TRIED)
    except (KeyError, TypeError, ValueError):  # states of another make
        return False
    run(_TRIED, state.ctypes.data, tables.ctypes.data, found.ctypes.data)
    same = np.allclose(found, rng.standard_normal(_TRIED), rtol=1e-13, atol=0.0)
    return bool(same and np.array_equal(state, state_of(rng)))


@lru_cache(maxsize=1)
def text() -> tuple[str, tuple[str, ...]]:
    """The module that is compared, and the functions that it calls and does not define."""
    module = Module()
    *others, normals = draws(module)
    return "\n".join([str(module), *others, normals.replace("internal ", "")]), module.foreign


def state_of(rng: np.random.Generator) -> np.ndarray:
    """The four words of a generator's state.

    Raises
    ------
    TypeError
        It is no SFC64.
    """
    if type(rng.bit_generator) is not np.random.SFC64:
        raise TypeError(f"{type(rng.bit_generator).__name__} is not drawn from in machine code")
    return np.array(rng.bit_generator.state["state"]["state"], np.uint64)


def put_state(rng: np.random.Generator, words: np.ndarray) -> None:
    """Let a generator go on where machine code stopped."""
    state: Any = rng.bit_generator.state
    state["state"]["state"][:] = words
    rng.bit_generator.state = state


# ---- private ------------------------------------------------------------------------------------


def _right(c: Code, x: Number, by: int) -> Number:
    return c.op(WHOLE, f"lshr i64 {x.text}, {by}")


def _step(c: Code, s: list[Number]) -> tuple[Number, list[Number]]:
    """Sixty-four bits, and the state after them."""
    found = s[0] + s[1] + s[3]
    turned = c.call("llvm.fshl.i64", s[2], s[2], c.number(24, WHOLE), kind=WHOLE)
    after = [s[1] ^ _right(c, s[1], 11), s[2] + s[2].shifted(3), turned + found, s[3] + 1]
    return found, after


def _bits(module: Module) -> str:
    c = Code(module)
    found, after = _step(c, [c.load("%state", k, WHOLE) for k in range(4)])
    for k, word in enumerate(after):
        c.store("%state", k, word)
    c.do(f"ret i64 {found.text}")
    return f"define internal i64 @bits(ptr %state) {{\n{c}\n}}"


def _drawn(c: Code, name: str, kind: str) -> Number:
    """A call that moves the state, so none that ``Code.call`` may declare."""
    return c.op(kind, f"call {kind} @{name}(ptr %state)")


def _uniform(module: Module) -> str:
    c = Code(module)
    found = _right(c, _drawn(c, "bits", WHOLE), 11).to(REAL) * 2.0**-53
    c.do(f"ret double {found.text}")
    return f"define internal double @uniform(ptr %state) {{\n{c}\n}}"


def _uniforms(module: Module) -> str:
    c = Code(module)
    count = Number(c, "%count", WHOLE)
    c.loop(count, lambda i: c.store("%found", i, _drawn(c, "uniform", REAL)))
    c.do("ret void")
    return f"define internal void @uniforms(i64 %count, ptr %state, ptr %found) {{\n{c}\n}}"


def _layer(c: Code, bits: Number) -> tuple[Number, Number, Number, Number]:
    """What bits say: the layer, the whole number, the normal if it is taken, and whether it is at once."""
    layer, rest = bits & (_LAYERS - 1), _right(c, bits, 8)
    whole = _right(c, rest, 1) & ((1 << _BITS) - 1)
    size = whole.to(REAL) * c.load("%ziggurat", layer, REAL)
    sign = (rest & 1).shifted(63)
    normal = (size.bits() ^ sign).bits()
    bound = c.load("%ziggurat", layer + _LAYERS, WHOLE)
    return layer, whole, normal, whole < bound


def _rejected(module: Module) -> str:
    """A normal from bits that are not taken at once: from the tail, a wedge, or by further bits."""
    c = Code(module)
    bits, found = c.variable(Number(c, "%bits", WHOLE)), c.variable(c.number(0.0))
    far = c.load("%ziggurat", _LAYERS - 1, REAL) * 2.0**_BITS

    def again() -> Number:
        layer, whole, normal, taken = _layer(c, c.get(bits, WHOLE))
        c.set(found, normal)
        done = c.variable(taken)

        def tail() -> None:
            def tried() -> Number:
                x, y = (-elementary(c, "log1p", -_drawn(c, "uniform", REAL)) for _ in range(2))
                x = x / far
                c.set(found, far + x)
                return (y + y) <= x * x

            c.repeat(tried)
            size, is_negative = c.get(found, REAL), (_right(c, whole, 8) & 1).ne(0)
            c.set(found, c.where(is_negative, -size, size))
            c.set(done, c.number(True, "i1"))

        def wedge() -> None:
            low, high = (c.load("%ziggurat", layer + 2 * _LAYERS - k, REAL) for k in (0, 1))
            height = (high - low) * _drawn(c, "uniform", REAL) + low
            c.set(done, height < elementary(c, "exp", -0.5 * normal * normal))

        c.when(~taken & layer.eq(0), tail)
        c.when(~taken & layer.ne(0), wedge)
        c.when(~c.get(done, "i1"), lambda: c.set(bits, _drawn(c, "bits", WHOLE)))
        return ~c.get(done, "i1")

    c.repeat(again)
    c.do(f"ret double {c.get(found, REAL).text}")
    head = "i64 %bits, ptr %state, ptr %ziggurat"
    return f"define internal double @rejected({head}) noinline {{\n{c}\n}}"


def _normals(module: Module) -> str:
    """As many normals as asked for; the state stays in registers but where one is not taken at once."""
    c = Code(module)
    words = [c.variable(c.load("%state", k, WHOLE)) for k in range(4)]

    def keep() -> None:
        for k, place in enumerate(words):
            c.store("%state", k, c.get(place, WHOLE))

    def body(i: Number) -> None:
        bits, after = _step(c, [c.get(place, WHOLE) for place in words])
        for place, word in zip(words, after, strict=True):
            c.set(place, word)
        _, _, normal, taken = _layer(c, bits)
        c.store("%found", i, normal)

        def other() -> None:
            keep()
            given = f"i64 {bits.text}, ptr %state, ptr %ziggurat"
            c.store("%found", i, c.op(REAL, f"call double @rejected({given})"))
            for k, place in enumerate(words):
                c.set(place, c.load("%state", k, WHOLE))

        c.when(~taken, other)

    c.loop(Number(c, "%count", WHOLE), body)
    keep()
    c.do("ret void")
    head = "i64 %count, ptr noalias %state, ptr noalias %ziggurat, ptr noalias %found"
    return f"define internal void @normals({head}) {{\n{c}\n}}"
