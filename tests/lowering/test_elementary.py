"""Element-wise functions of machine code: a few units in the last place over the whole range."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import special

from bayesmc.expression import cast, elementwise, leaf
from bayesmc.lowering import compiled
from bayesmc.lowering.elementary import LARGEST_ANGLE

pytest.importorskip("llvmlite", reason="llvmlite is not installed")

#: enough digits to judge the last one of a float
LONG = np.finfo(np.longdouble).nmant > 60
EDGES = np.array(
    [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, np.inf, -np.inf, np.nan, 5e-324, -5e-324, 1e-310, 2.3e-308]
    + [1e-16, -1e-16, 1e-8, -1e-8, 709.7, 709.79, -745.1, -745.2, 710.4, -1e300, 1e300, np.pi, np.pi / 2]
)  # fmt: skip


def numbers(low: float, high: float, seed: int = 0) -> np.ndarray:
    """Numbers of all sizes between bounds, and edges."""
    rng = np.random.default_rng(seed)
    spread = rng.uniform(low, high, 20_000)
    small = np.exp(rng.uniform(-700, np.log(max(abs(low), abs(high))), 20_000))
    both = np.concatenate([spread, small * np.where(low < 0, rng.choice([-1, 1], 20_000), 1)])
    return np.concatenate([both[(both >= low) & (both <= high)], EDGES])


def machine(function: Any, *args: np.ndarray) -> np.ndarray:
    leaves = [leaf(f"x{k}", (), a.dtype) for k, a in enumerate(args)]
    run = compiled([elementwise(function, *leaves)])
    return run({f"x{k}": a for k, a in enumerate(args)})[0]


def units(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Distances in units in the last place; NaN and infinities must be the same."""
    with np.errstate(all="ignore"):
        near = exact.astype(float)
        same = (found == near) | (np.isnan(found) & np.isnan(near))
        off = np.abs(found.astype(np.longdouble) - exact) / np.spacing(np.abs(near))
        off = np.where(np.isfinite(near), off, np.inf)
    return np.where(same, 0.0, np.where(np.isnan(off), np.inf, off).astype(float))


def expit(x: Any) -> Any:
    return np.where(x < 0, np.exp(-abs(x)), 1) / (1 + np.exp(-abs(x)))


def log_expit(x: Any) -> Any:
    return np.minimum(x, 0) - np.log1p(np.exp(-abs(x)))


CASES: list[tuple[Any, Callable[..., Any], float, float, float]] = [
    (np.exp, np.exp, -760.0, 720.0, 2.0),
    (np.expm1, np.expm1, -60.0, 720.0, 4.0),
    (np.log, np.log, 0.0, 1e300, 2.0),
    (np.log1p, np.log1p, -1.0, 1e300, 4.0),
    (np.sin, np.sin, -LARGEST_ANGLE, LARGEST_ANGLE, 2.0),
    (np.cos, np.cos, -LARGEST_ANGLE, LARGEST_ANGLE, 2.0),
    (np.tanh, np.tanh, -30.0, 30.0, 4.0),
    (np.cosh, np.cosh, -715.0, 715.0, 4.0),
    (special.expit, expit, -760.0, 760.0, 4.0),
    (special.log_expit, log_expit, -760.0, 760.0, 4.0),
]


@pytest.mark.skipif(not LONG, reason="no numbers with more digits to compare with")
@pytest.mark.parametrize("case", CASES, ids=lambda c: c[0].__name__)
def test_elementary_functions_are_right_to_a_few_units(case: Any) -> None:
    function, exact, low, high, most = case
    x = numbers(low, high)
    with np.errstate(all="ignore"):
        expected = np.asarray(exact(x.astype(np.longdouble)))
    off = units(machine(function, x), expected)
    worst = np.argsort(off)[-3:]
    assert off.max() <= most, list(zip(x[worst], off[worst], strict=True))


@pytest.mark.parametrize("value", [1e9, 1e22, -3e300, 12345678.9])
def test_large_angles_are_left_to_numpy(value: float) -> None:
    x = np.array([0.5, value, 1.0])
    assert np.array_equal(machine(np.sin, x), np.sin(x))
    assert np.array_equal(machine(np.cos, x), np.cos(x))


OTHERS = [
    np.sqrt, np.floor, np.ceil, np.trunc, np.rint, np.reciprocal, np.fabs, np.absolute, np.sign, np.negative,
    np.square, np.tan, np.arcsin, np.arccos, np.arctan, np.sinh, np.arcsinh, np.arccosh, np.arctanh, np.cbrt,
    np.exp2, np.log2, np.log10, np.deg2rad, np.rad2deg, special.logit, special.erf, special.erfc, special.ndtr,  # noqa: E501
    special.gammaln, special.digamma, special.log_ndtr, special.ndtri, special.i0e, special.i1e,
    special.erfcx, np.isnan, np.isinf, np.isfinite, np.signbit,
]  # fmt: skip


@pytest.mark.parametrize("function", OTHERS, ids=lambda f: f.__name__)
def test_other_functions_are_those_of_numpy_and_scipy(function: Any) -> None:
    x = numbers(-40.0, 40.0)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        expected = function(x)
    found = machine(function, x)
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=2e-14, atol=1e-300)


BINARY = [
    np.add, np.subtract, np.multiply, np.true_divide, np.maximum, np.minimum, np.fmax, np.fmin, np.copysign,
    np.hypot, np.arctan2, np.power, np.logaddexp, np.remainder, np.fmod, np.floor_divide, np.less,
    np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal, special.xlogy, special.xlog1py,
    special.betaln, special.gammainc, special.gammaincc, np.logical_and, np.logical_or, np.logical_xor,
]  # fmt: skip


@pytest.mark.parametrize("function", BINARY, ids=lambda f: f.__name__)
def test_functions_of_two_numbers(function: Any) -> None:
    rng = np.random.default_rng(1)
    a = np.concatenate([np.repeat(EDGES, EDGES.size), rng.normal(scale=5, size=5000)])
    b = np.concatenate([np.tile(EDGES, EDGES.size), rng.normal(scale=5, size=5000)])
    with np.errstate(all="ignore"):
        expected = function(a, b)
    found = machine(function, a, b)
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize(
    "function",
    [np.add, np.subtract, np.multiply, np.maximum, np.minimum, np.remainder, np.floor_divide, np.less,
     np.equal,
     np.true_divide, np.bitwise_and, np.bitwise_or, np.bitwise_xor],
    ids=lambda f: f.__name__,
)  # fmt: skip
def test_functions_of_whole_numbers(function: Any) -> None:
    a, b = (v.ravel() for v in np.meshgrid(np.arange(-7, 8), np.arange(-7, 8)))
    with np.errstate(all="ignore"):
        expected = function(a, b)
    found = machine(function, a, b)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_rounding_whole_numbers_leaves_them() -> None:
    a = np.arange(-5, 6)
    for function in (np.floor, np.ceil, np.trunc):
        np.testing.assert_array_equal(machine(function, a), function(a))


@pytest.mark.parametrize("exponent", [2.0, 0.5, -1.0, 3.0, -2.0, 0.0, 1.0, 2.5, 17.0])
def test_known_exponents(exponent: float) -> None:
    x = np.abs(numbers(-40.0, 40.0))
    run = compiled([elementwise(np.power, leaf("x", ()), exponent)])
    with np.errstate(all="ignore"):
        expected = np.power(x, exponent)
    np.testing.assert_allclose(run({"x": x})[0], expected, rtol=1e-14, atol=5e-324)


def test_casts_and_choices() -> None:
    x = np.array([-1.7, 0.0, 2.9])
    given = leaf("x", ())
    roots = [
        cast(given, int),
        cast(given, bool),
        elementwise(np.where, given, given, cast(given, int)),
    ]
    found = compiled(roots)({"x": x})
    expected = [x.astype(int), x.astype(bool), np.where(x, x, x.astype(int))]
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
