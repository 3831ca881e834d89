"""What element-wise functions are in machine code: a rule for each of NumPy's and SciPy's that has one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy import special

from bayesmc.errors import TraceError
from bayesmc.expression import Constant, Elementwise
from bayesmc.expression.graph import CASTS
from bayesmc.lowering.code import REAL, TRUTH, WHOLE, Code, Number
from bayesmc.lowering.elementary import LARGEST_ANGLE, elementary

KINDS = {"f": REAL, "i": WHOLE, "u": WHOLE, "b": TRUTH}
Rule = Callable[..., Number]

#: what a kernel says of a call that it could not do: bits of its result
OUTSIDE, TOO_LARGE = 1, 2
#: exponents up to which a power is a product
_PRODUCT = 4


def kind_of(node: Any) -> str:
    """The type of an expression's elements."""
    return KINDS[node.dtype.kind]


def is_lowerable(node: Elementwise) -> bool:
    """Whether there is a rule."""
    function = node.function
    if function is np.power and kind_of(node) != REAL:
        return exponent_of(node) is not None and float(exponent_of(node) or 0) >= 0
    if function in _REAL:
        return kind_of(node) == REAL
    if function in (np.bitwise_and, np.bitwise_or, np.bitwise_xor, np.invert):
        return True
    return function in _ANY or function in _COMPARISONS or function in _LOGICAL or function in CASTS


def is_cheap(function: Any) -> bool:
    """Whether it costs no more than to read its result from memory."""
    return function in _ANY or function in _COMPARISONS or function in _LOGICAL or function in CASTS


def exponent_of(node: Elementwise) -> float | None:
    """A known exponent that is a small whole number, or a half: part of the code, not of the data."""
    known = node.operands[1]
    if node.function is not np.power or not isinstance(known, Constant) or known.size == 0:
        return None
    first = float(known.value.flat[0])
    if not (known.value == first).all():
        return None
    return first if first == 0.5 or (first == int(first) and abs(first) <= _PRODUCT) else None


def lowered(code: Code, node: Elementwise, values: list[Number]) -> Number:
    """One element of an element-wise function, of its operands' elements.

    Raises
    ------
    TraceError
    """
    function, kind = node.function, kind_of(node)
    if function in CASTS:
        return values[0].to(kind)
    if function is np.where:
        condition, a, b = values
        return code.where(condition.to(TRUTH), a.to(kind), b.to(kind))
    if function in _COMPARISONS:
        return _COMPARISONS[function](*_alike(values))
    if function in _LOGICAL:
        return _LOGICAL[function](code, *(v.to(TRUTH) for v in values))
    if function in _OF_REAL:
        return _OF_REAL[function](code, values[0].to(REAL))
    given = [v.to(kind) for v in values]
    exponent = exponent_of(node) if function is np.power else None
    if exponent is not None:
        return _power(code, given[0], exponent)
    rule = _ANY.get(function) or (_REAL.get(function) if kind == REAL else None)
    if rule is None:
        raise TraceError(f"{node.detail} has no machine code")
    return rule(code, *given)


# ---- private ------------------------------------------------------------------------------------


def _alike(values: list[Number]) -> list[Number]:
    kinds = {v.kind for v in values}
    if len(kinds) == 1 and TRUTH not in kinds:
        return values
    wanted = REAL if REAL in kinds else WHOLE
    return [v.to(wanted) for v in values]


def _power(c: Code, x: Number, exponent: float) -> Number:
    if exponent == 0.5:
        return c.call("llvm.sqrt.f64", x)
    if exponent == 0:
        return c.number(1, x.kind)
    found = x
    for _ in range(abs(int(exponent)) - 1):
        found = found * x
    return found if exponent > 0 else 1.0 / found


def _own(name: str) -> Rule:
    """One of our elementary functions."""
    return lambda c, *x: elementary(c, name, *x)


def _machine(name: str) -> Rule:
    """An instruction of most machines."""
    return lambda c, *x: c.call(f"llvm.{name}.f64", *x)


def _rounded(name: str) -> Rule:
    """Whole numbers stay as they are."""
    return lambda c, x: c.call(f"llvm.{name}.f64", x) if x.kind == REAL else x


def _library(name: str) -> Rule:
    """A function of the C library."""
    return lambda c, *x: c.call(name, *x)


def _scipy(name: str) -> Rule:
    """SciPy's own function, whose address the linker is told."""
    return lambda c, *x: c.call(f"{SCIPY}{name}", *x, last="0")


#: in front of the names of SciPy's functions
SCIPY = "bayesmc_scipy_"


def _angular(name: str) -> Rule:
    """A sine or cosine: where the angle is too large for ours, the whole call is done again in NumPy."""

    def rule(c: Code, x: Number) -> Number:
        size = c.call("llvm.fabs.f64", x)
        too_large = (size > LARGEST_ANGLE) & size.ne(math.inf)
        c.flag(too_large, TOO_LARGE)
        return elementary(c, name, x)

    return rule


def _maximum(c: Code, a: Number, b: Number) -> Number:
    if a.kind == REAL:
        return c.call("llvm.maximum.f64", a, b)
    return c.where(a > b, a, b) if a.kind == WHOLE else a | b


def _minimum(c: Code, a: Number, b: Number) -> Number:
    if a.kind == REAL:
        return c.call("llvm.minimum.f64", a, b)
    return c.where(a < b, a, b) if a.kind == WHOLE else a & b


def _absolute(c: Code, x: Number) -> Number:
    if x.kind == REAL:
        return c.call("llvm.fabs.f64", x)
    return c.where(x < 0, -x, x) if x.kind == WHOLE else x


def _sign(c: Code, x: Number) -> Number:
    found = (x > 0).to(x.kind) - (x < 0).to(x.kind)
    return c.where(x.is_nan(), x, found) if x.kind == REAL else found


def _remainder(c: Code, a: Number, b: Number) -> Number:
    if a.kind == WHOLE:
        return c.where(b.eq(0), 0, a - _quotient(c, a, b) * b)
    rest = c.op(REAL, f"frem double {a.text}, {b.text}")
    crosses = rest.ne(0.0) & ((rest < 0.0) ^ (b < 0.0))
    found = c.where(crosses, rest + b, rest)
    return c.where(rest.eq(0.0), c.call("llvm.copysign.f64", 0.0, b), found)


def _quotient(c: Code, a: Number, b: Number) -> Number:
    if a.kind == WHOLE:
        plain = ~(b.eq(0) | b.eq(-1))
        by = c.where(plain, b, 2)
        cut = c.op(WHOLE, f"sdiv i64 {a.text}, {by.text}")
        rest = a - cut * by
        found = cut - (rest.ne(0) & ((rest < 0) ^ (by < 0))).to(WHOLE)
        return c.where(plain, found, c.where(b.eq(0), 0, -a))
    rest = c.op(REAL, f"frem double {a.text}, {b.text}")
    crosses = rest.ne(0.0) & ((rest < 0.0) ^ (b < 0.0))
    whole = (a - rest) / b - crosses.to(REAL)
    low = c.call("llvm.floor.f64", whole)
    found = c.where(whole - low > 0.5, low + 1.0, low)
    return c.where(b.eq(0.0), a / b, found)


def _xlogy(name: str) -> Rule:
    def rule(c: Code, a: Number, b: Number) -> Number:
        return c.where(a.eq(0.0) & ~b.is_nan(), 0.0, a * elementary(c, name, b))

    return rule


def _logit(c: Code, x: Number) -> Number:
    plain = elementary(c, "log", x / (1.0 - x))
    s = 2.0 * (x - 0.5)
    near = elementary(c, "log1p", s) - elementary(c, "log1p", -s)
    return c.where((x < 0.3) | (x > 0.65), plain, near)


_COMPARISONS: Mapping[Any, Rule] = {
    np.less: lambda a, b: a < b, np.less_equal: lambda a, b: a <= b,
    np.greater: lambda a, b: a > b, np.greater_equal: lambda a, b: a >= b,
    np.equal: lambda a, b: a.eq(b), np.not_equal: lambda a, b: a.ne(b),
}  # fmt: skip
_LOGICAL: Mapping[Any, Rule] = {
    np.logical_and: lambda c, a, b: a & b, np.logical_or: lambda c, a, b: a | b,
    np.logical_xor: lambda c, a, b: a ^ b, np.logical_not: lambda c, a: ~a,
}  # fmt: skip
_OF_REAL: Mapping[Any, Rule] = {
    np.isnan: lambda c, x: x.is_nan(),
    np.isinf: lambda c, x: c.call("llvm.fabs.f64", x).eq(math.inf),
    np.isfinite: lambda c, x: c.call("llvm.fabs.f64", x) < math.inf,
    np.signbit: lambda c, x: x.bits() < 0,
}
#: of any type
_ANY: Mapping[Any, Rule] = {
    np.add: lambda c, a, b: a | b if a.kind == TRUTH else a + b,
    np.multiply: lambda c, a, b: a & b if a.kind == TRUTH else a * b,
    np.subtract: lambda c, a, b: a - b,
    np.negative: lambda c, x: -x, np.square: lambda c, x: x * x, np.where: lambda c, *x: x[0],
    np.floor: _rounded("floor"), np.ceil: _rounded("ceil"), np.trunc: _rounded("trunc"),
    np.maximum: _maximum, np.minimum: _minimum, np.absolute: _absolute, np.sign: _sign,
    np.remainder: _remainder, np.floor_divide: _quotient,
    np.bitwise_and: lambda c, a, b: a & b, np.bitwise_or: lambda c, a, b: a | b,
    np.bitwise_xor: lambda c, a, b: a ^ b, np.invert: lambda c, x: ~x,
    **dict.fromkeys(_OF_REAL, lambda c, x: x),
}  # fmt: skip
_REAL: Mapping[Any, Rule] = {
    np.true_divide: lambda c, a, b: a / b, np.reciprocal: lambda c, x: 1.0 / x,
    np.fabs: _absolute, np.fmax: _machine("maxnum"), np.fmin: _machine("minnum"),
    np.sqrt: _machine("sqrt"), np.rint: _machine("rint"), np.copysign: _machine("copysign"),
    np.exp: _own("exp"), np.expm1: _own("expm1"), np.log: _own("log"), np.log1p: _own("log1p"),
    np.tanh: _own("tanh"), np.cosh: _own("cosh"), np.logaddexp: _own("logaddexp"),
    special.expit: _own("expit"), special.log_expit: _own("log_expit"),
    np.sin: _angular("sin"), np.cos: _angular("cos"),
    np.tan: _library("tan"), np.arcsin: _library("asin"), np.arccos: _library("acos"),
    np.arctan: _library("atan"), np.arctan2: _library("atan2"), np.sinh: _library("sinh"),
    np.arcsinh: _library("asinh"), np.arccosh: _library("acosh"), np.arctanh: _library("atanh"),
    np.cbrt: _library("cbrt"), np.hypot: _library("hypot"), np.exp2: _library("exp2"),
    np.log2: _library("log2"), np.log10: _library("log10"), np.power: _library("pow"),
    np.float_power: _library("pow"),
    np.fmod: lambda c, a, b: c.op(REAL, f"frem double {a.text}, {b.text}"),
    np.deg2rad: lambda c, x: x * (math.pi / 180.0), np.radians: lambda c, x: x * (math.pi / 180.0),
    np.rad2deg: lambda c, x: x * (180.0 / math.pi), np.degrees: lambda c, x: x * (180.0 / math.pi),
    special.xlogy: _xlogy("log"), special.xlog1py: _xlogy("log1p"), special.logit: _logit,
    special.erf: _scipy("__pyx_fuse_1erf"), special.erfc: _scipy("__pyx_fuse_1erfc"),
    special.ndtr: _scipy("__pyx_fuse_1ndtr"),
    special.gammaln: _scipy("gammaln"), special.digamma: _scipy("__pyx_fuse_1psi"),
    special.log_ndtr: _scipy("__pyx_fuse_1log_ndtr"), special.ndtri: _scipy("ndtri"),
    special.betaln: _scipy("betaln"), special.i0e: _scipy("i0e"), special.i1e: _scipy("i1e"),
    special.erfcx: _scipy("__pyx_fuse_1erfcx"), special.gammainc: _scipy("gammainc"),
    special.gammaincc: _scipy("gammaincc"),
}  # fmt: skip
