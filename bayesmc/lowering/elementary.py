"""Elementary functions without branches, so that loops over them become vector instructions.

Reductions of the argument and polynomials, right to a few units in the last place over the whole range;
``sin`` and ``cos`` up to ``LARGEST_ANGLE``, beyond which whoever calls them must do something else.

References
----------
Cody and Waite (1980), Software manual for the elementary functions; Sun Microsystems' fdlibm (``e_log``,
``k_sin``, ``k_cos``, ``e_rem_pio2``: coefficients and the parts of pi/2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from bayesmc.lowering.code import REAL, Code, Module, Number

#: beyond it multiples of pi/2 are no longer exact
LARGEST_ANGLE = 1e6

_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
#: adding it puts a whole number into the lowest bits
_ROUNDING = 6755399441055744.0
_PIO2 = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624871116645580e-21)
_PIO2_REST = 8.47842766036889956997e-32
_LOG = [
    1.479819860511658591e-01, 1.531383769920937332e-01, 1.818357216161805012e-01,
    2.222219843214978396e-01, 2.857142874366239149e-01, 3.999999999940941908e-01,
    6.666666666666735130e-01, 0.0,
]  # fmt: skip
_SIN = [
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06,
    -1.98412698298579493134e-04, 8.33333333332248946124e-03,
]  # fmt: skip
_COS = [
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07,
    2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02, 0.0,
]  # fmt: skip


def elementary(code: Code, name: str, *args: Number) -> Number:
    """A call of an elementary function, which is defined in the module when first called."""
    full = f"bayesmc_{name}"
    if not code.module.is_defined(full):
        _define(code.module, full, _FUNCTIONS[name], len(args))
    return code.call(full, *args)


def log_sum_exp(code: Code, terms: list[Number]) -> Number:
    """The logarithm of the sum of some numbers' exponentials."""
    top = terms[0]
    for term in terms[1:]:
        top = code.call("llvm.maximum.f64", top, term)
    is_finite = _absolute(code, top) < math.inf
    level = code.where(is_finite, top, 0.0)
    total = code.number(0.0)
    for term in terms:
        total = total + elementary(code, "exp", term - level)
    return elementary(code, "log", total) + level


# ---- private ------------------------------------------------------------------------------------


def _define(module: Module, name: str, body: Callable[..., Number], count: int) -> None:
    inside = Code(module)
    names = [f"%x{k}" for k in range(count)]
    found = body(inside, *(Number(inside, n, REAL) for n in names))
    inside.do(f"ret double {found.text}")
    head = ", ".join(f"double {n}" for n in names)
    module.define(name, f"define internal double @{name}({head}) alwaysinline {{\n{inside}\n}}")


def _absolute(c: Code, x: Number) -> Number:
    return c.call("llvm.fabs.f64", x)


def _rounded(c: Code, x: Number) -> Number:
    return c.call("llvm.rint.f64", x)


def _two_to(c: Code, whole: Number) -> Number:
    """2 to a whole number (as a real one) between -1022 and 1023."""
    low = (whole + _ROUNDING).bits() + 1023
    return low.shifted(52).bits()


def _reduced(c: Code, x: Number) -> tuple[Number, Number]:
    """``k`` and ``r`` with ``x = k log 2 + r``."""
    k = _rounded(c, x * (1.0 / math.log(2.0)))
    return k, (x - k * _LN2_HIGH) - k * _LN2_LOW


def _between(c: Code, x: Number, low: float, high: float) -> Number:
    """NaN stays."""
    x = c.where(x > high, high, x)
    return c.where(x < low, low, x)


def _exp(c: Code, x: Number) -> Number:
    k, r = _reduced(c, _between(c, x, -1000.0, 1000.0))
    terms = [1.0 / math.factorial(n) for n in range(13, 1, -1)]
    rest = c.polynomial(r, terms)
    found = 1.0 + c.fma(r * r, rest, r)
    half = _rounded(c, k * 0.5)
    return found * _two_to(c, half) * _two_to(c, k - half)


def _expm1(c: Code, x: Number) -> Number:
    k, r = _reduced(c, _between(c, x, -60.0, 1000.0))
    k = c.where(k > 1025.0, 1025.0, k)
    terms = [1.0 / math.factorial(n) for n in range(14, 1, -1)]
    small = c.fma(r * r, c.polynomial(r, terms), r)
    half = _two_to(c, k - 1.0)
    found = (half * small + (half - 0.5)) * 2.0
    found = c.where(k.eq(0.0), small, found)
    found = c.where(x > 709.8, math.inf, found)
    return c.where(x.eq(0.0), x, found)


def _log(c: Code, x: Number) -> Number:
    is_tiny = x < 2.2250738585072014e-308
    scaled = c.where(is_tiny, x * 2.0**54, x)
    shifted = scaled.bits() - 0x3FE6A09E667F3BCD
    exponent = shifted.shifted(-52)
    m = (scaled.bits() - exponent.shifted(52)).bits()
    lifted = (exponent + c.number(_ROUNDING).bits()).bits() - _ROUNDING
    k = lifted - c.where(is_tiny, 54.0, c.number(0.0))
    f = m - 1.0
    s = f / (f + 2.0)
    z = s * s
    half = 0.5 * f * f
    r = c.polynomial(z, _LOG)
    found = k * _LN2_HIGH - ((half - (s * (half + r) + k * _LN2_LOW)) - f)
    found = c.where(x.eq(0.0), -math.inf, found)
    found = c.where(x < 0.0, math.nan, found)
    return c.where((x.eq(math.inf)) | x.is_nan(), x, found)


def _log1p(c: Code, x: Number) -> Number:
    u = x + 1.0
    lost = c.where(x > 1.0, 1.0 - (u - x), x - (u - 1.0))
    found = elementary(c, "log", u)
    within = (u > 0.0) & (u < math.inf)
    found = c.where(within, found + lost / u, found)
    return c.where(x.eq(0.0), x, found)  # the sign of zero


def _angle(c: Code, x: Number) -> tuple[Number, Number, Number]:
    """The quadrant, and what is left of an angle with its rounding error."""
    k = _rounded(c, x * (2.0 / math.pi))
    first, second, third = _PIO2
    t = x - k * first
    w = k * second
    r = t - w
    rest = ((t - r) - w) - (k * third + k * _PIO2_REST)
    y = r + rest
    return (k + _ROUNDING).bits(), y, (r - y) + rest


def _sin_of_rest(c: Code, x: Number, tail: Number) -> Number:
    z = x * x
    v = z * x
    r = c.polynomial(z, _SIN)
    return x - ((z * (0.5 * tail - v * r) - tail) - v * -1.66666666666666324348e-01)


def _cos_of_rest(c: Code, x: Number, tail: Number) -> Number:
    z = x * x
    r = c.polynomial(z, _COS)
    half = 0.5 * z
    w = 1.0 - half
    return w + (((1.0 - w) - half) + (z * r - x * tail))


def _turned(c: Code, x: Number, quarter: int) -> Number:
    """The sine of an angle and some quarter turns."""
    quadrant, y, tail = _angle(c, x)
    quadrant = quadrant + quarter
    is_cos = (quadrant & 1).ne(0)
    found = c.where(is_cos, _cos_of_rest(c, y, tail), _sin_of_rest(c, y, tail))
    return c.where((quadrant & 2).ne(0), -found, found)


def _sin(c: Code, x: Number) -> Number:
    found = _turned(c, x, 0)
    return c.where(x.eq(0.0), x, found)


def _cos(c: Code, x: Number) -> Number:
    return _turned(c, x, 1)


def _tanh(c: Code, x: Number) -> Number:
    t = elementary(c, "expm1", 2.0 * _between(c, _absolute(c, x), 0.0, 22.0))
    return c.call("llvm.copysign.f64", t / (t + 2.0), x)


def _cosh(c: Code, x: Number) -> Number:
    half = elementary(c, "exp", 0.5 * _absolute(c, x))
    return (0.5 * half) * half + 0.5 / half / half


def _expit(c: Code, x: Number) -> Number:
    e = elementary(c, "exp", -_absolute(c, x))
    found = c.where(x < 0.0, e, c.number(1.0)) / (1.0 + e)
    return c.where(x.is_nan(), x, found)


def _log_expit(c: Code, x: Number) -> Number:
    rest = elementary(c, "log1p", elementary(c, "exp", -_absolute(c, x)))
    return c.where(x < 0.0, x, c.where(x.is_nan(), x, 0.0)) - rest


def _logaddexp(c: Code, a: Number, b: Number) -> Number:
    top = c.where(a > b, a, b)
    gap = elementary(c, "log1p", elementary(c, "exp", -_absolute(c, a - b)))
    found = c.where(a.eq(b), a + math.log(2.0), top + gap)
    return c.where(a.is_nan(), a, found)


_FUNCTIONS: Mapping[str, Callable[..., Number]] = {
    "exp": _exp, "expm1": _expm1, "log": _log, "log1p": _log1p, "sin": _sin, "cos": _cos, "tanh": _tanh,
    "cosh": _cosh, "expit": _expit, "log_expit": _log_expit, "logaddexp": _logaddexp,
}  # fmt: skip
