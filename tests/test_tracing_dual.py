"""Forward derivatives are given only where they are right: every NumPy call, random expressions, known traps.

Whatever a ``Dual`` hands on is held against differences of the same function of plain numbers; where they
disagree it must have given up (``NoTangent``, or a NaN tangent).
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.special
from hypothesis import given, settings
from hypothesis import strategies as st

import bayesmc as bmc
from bayesmc.plates import PlateArray
from bayesmc.testing import session
from bayesmc.tracing import Dual, NoTangent, TracedCall, Tracer, partials
from bayesmc.tracing import tangents as rules

POINT = np.array([[0.31, 0.72, 0.55], [0.64, 0.18, 0.93]])
#: what differences resolve, in units of the largest value on the way
TOLERANCE = 1e-6


def dual(x: Any = POINT) -> Dual:
    """An array whose elements are the directions."""
    x = np.asarray(x, dtype=float)
    return Dual(x, np.eye(x.size).reshape(*x.shape, x.size))


def differences(function: Callable[[Any], Any], x: np.ndarray, step: float = 1e-3) -> np.ndarray:
    """Derivatives by central differences of fourth order, a direction per element on the last axis."""
    found = []
    for k in range(x.size):
        move = step * (np.arange(x.size) == k).reshape(x.shape)
        far, near = (
            np.asarray(function(x + m * move), dtype=float)
            - np.asarray(function(x - m * move), dtype=float)
            for m in (2.0, 1.0)
        )
        found.append((8 * near - far) / (12 * step))
    return np.stack(found, axis=-1)


def assert_right(function: Callable[[Any], Any], x: np.ndarray, found: Dual) -> None:
    """Value and tangent are those of the function; elements without a derivative show NaN."""
    with np.errstate(all="ignore"):
        value = np.asarray(function(x), dtype=float)
        wanted, rough = differences(function, x), differences(function, x, 3e-3)
    np.testing.assert_allclose(found.value, value, rtol=1e-12, atol=1e-14)
    assert found.tangent.shape == (*value.shape, x.size)
    given_up = ~np.isfinite(found.tangent)
    unclear = ~(np.abs(wanted - rough) <= 1e-4 * (1 + np.abs(wanted)))  # too steep for differences
    size = 1 + np.abs(wanted) + np.abs(value)[..., None]
    wrong = np.abs(found.tangent - wanted) > TOLERANCE * size + np.abs(wanted - rough)
    assert not (wrong & ~given_up & ~unclear).any()


# ---- every ufunc, every function ----------------------------------------------------------------


def ufuncs() -> list[Any]:
    every = [getattr(m, n) for m in (np, scipy.special) for n in dir(m)]
    return sorted({u for u in every if isinstance(u, np.ufunc)}, key=lambda u: u.__name__)


def attempt(function: Callable[[Any], Any], x: np.ndarray) -> bool:
    """Whether a derivative came out; it must be right, and what comes without one must not move."""
    try:
        found = function(dual(x))
    except Exception:  # whatever goes wrong, nothing is said
        return False
    try:
        with np.errstate(all="ignore"):
            function(x)
    except Exception:
        return False  # a call that nobody makes
    parts = found if isinstance(found, (list, tuple)) else [found]
    assert not any(isinstance(p, Tracer) for p in parts)
    for k, part in enumerate(parts):
        here = function if part is found else (lambda v, k=k: function(v)[k])
        if isinstance(part, Dual):
            assert_right(here, x, part)
        elif isinstance(part, (np.ndarray, np.generic)):  # constant in pieces
            with np.errstate(all="ignore"):
                moved = here(x + 1e-7)
            np.testing.assert_array_equal(np.asarray(part), np.asarray(moved))
    return any(isinstance(p, Dual) for p in parts)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_every_ufunc_is_right_or_gives_up() -> None:
    """At points inside and outside (0, 1), alone and with plain and moving others."""
    known = set()
    other = np.array([1.7, 0.4, 2.3])
    for ufunc in ufuncs():
        for x in (POINT, 3 * POINT + 1.05, -POINT):
            calls: list[Callable[[Any], Any]] = [ufunc]
            if ufunc.nin == 2:
                calls = [lambda v, u=ufunc: u(v, other), lambda v, u=ufunc: u(other, v),
                         lambda v, u=ufunc: u(v, 1.3 * v + 0.1), lambda v, u=ufunc: u(v, 2.5)]  # fmt: skip
            elif ufunc.nin > 2:
                calls = [lambda v, u=ufunc: u(*[v] * u.nin)]
            for call in calls:
                if attempt(call, x):
                    known.add(ufunc)
    missing = set(partials._PARTIALS) - known
    assert not missing, f"no point at which {missing} has a derivative"


def functions() -> list[Any]:
    """Functions of NumPy that a stand-in can take over."""
    found = {}
    for module in (np, np.linalg, np.fft):
        for name in dir(module):
            function = getattr(module, name)
            if hasattr(function, "_implementation") and not isinstance(function, np.ufunc):
                found[id(function)] = function
    skipped = {"save", "savetxt", "savez", "savez_compressed", "apply_along_axis", "copyto", "put"}
    return [f for f in found.values() if f.__name__ not in skipped]


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::RuntimeWarning")
def test_every_function_is_right_or_gives_up() -> None:
    """Called with whatever else it may want: axes, shapes, indices, weights, second arrays, lists."""
    other = np.arange(6.0).reshape(2, 3) - 2.2
    square = np.array([[2.0, 0.3, 0.1], [0.2, 1.5, 0.4], [0.0, 0.7, 1.1]])
    forms: list[Callable[[Any, Any], Any]] = [
        lambda f, v: f(v), lambda f, v: f(v, 0), lambda f, v: f(v, 1), lambda f, v: f(v, (3, 2)),
        lambda f, v: f(v, axis=0), lambda f, v: f(v, axis=-1), lambda f, v: f(v, axis=-1, keepdims=True),
        lambda f, v: f(v, other), lambda f, v: f(other, v), lambda f, v: f(v, v * v),
        lambda f, v: f(v, square), lambda f, v: f(square, v.T), lambda f, v: f(v.T, v),
        lambda f, v: f([v, other]), lambda f, v: f([v, v + other], axis=1), lambda f, v: f((v, v), axis=-1),
        lambda f, v: f(v, 0, 1), lambda f, v: f(v, 0.2, 0.6), lambda f, v: f(v, other, other + 9.0),
        lambda f, v: f(v[0], [0.0, 0.5, 2.0], [1.0, 3.0, -1.0]), lambda f, v: f([1.0, -2.0, 0.5], v),
        lambda f, v: f(other > 0, v, other), lambda f, v: f(other > 0, 1.0, v),
        lambda f, v: f(v > 0.5, v, -v),
        lambda f, v: f("ij,kj->ik", v, other), lambda f, v: f("ij,ij->i", v, v),
        lambda f, v: f(v, weights=other + 4.0), lambda f, v: f(v, initial=1e3), lambda f, v: f(v, dtype="f4"),
        lambda f, v: f(v, prepend=5.0), lambda f, v: f(v[0], [2, 0]), lambda f, v: f(v, where=other > 0),
        lambda f, v: f([other > 0, other > -1], [v, 2 * v], 7.0), lambda f, v: f(v, [1, 0, 1], axis=1),
        lambda f, v: f(v[0]), lambda f, v: f(v[0], v[1]), lambda f, v: f(v[0], other[1]),
        lambda f, v: f(v, 2), lambda f, v: f(v, ord=2), lambda f, v: f(v[0], ord=2), lambda f, v: f(v[0], 1),
        lambda f, v: f(v @ v.T), lambda f, v: f(square @ square.T, v[0]), lambda f, v: f(v, None, None),
        lambda f, v: f(v, (4, 2, 3)),
    ]  # fmt: skip
    known = {
        f for f in functions() for form in forms if attempt(lambda v, f=f, g=form: g(f, v), POINT)
    }
    names = {f.__name__ for f in known}
    assert names >= {
        "where", "select", "stack", "concatenate", "sum", "mean", "average", "dot", "einsum", "outer",
        "tensordot", "cross", "clip", "norm", "interp", "polyval", "sinc", "diff", "cumsum", "reshape",
        "transpose", "broadcast_to", "broadcast_arrays", "take", "moveaxis", "squeeze", "diagonal", "trace",
    }  # fmt: skip


# ---- random expressions ---------------------------------------------------------------------------


def _inside(x: Any) -> Any:
    """Into (0, 1), whatever it was."""
    return scipy.special.expit(x)


STEPS: list[Callable[..., Any]] = [
    lambda a, b: a + b, lambda a, b: a - 2.0 * b, lambda a, b: a * b, lambda a, b: a / (1.5 + b**2),
    lambda a, b: np.exp(-(a**2)), lambda a, b: np.log1p(a**2), lambda a, b: np.sqrt(1.0 + a * a),
    lambda a, b: np.sin(a) * np.cos(b), lambda a, b: np.arctan2(a, 2.0 + b * b), lambda a, b: np.tanh(a),
    lambda a, b: np.hypot(a, b + 3.0), lambda a, b: np.maximum(a, b), lambda a, b: np.minimum(a, 0.3),
    lambda a, b: np.where(a > b, a, b**3), lambda a, b: np.abs(a - 0.21), lambda a, b: _inside(a) ** 1.7,
    lambda a, b: _inside(a) ** b, lambda a, b: scipy.special.erf(a), lambda a, b: np.arcsin(_inside(a)),
    lambda a, b: np.remainder(a + np.pi, 2 * np.pi) - np.pi, lambda a, b: np.clip(a, -0.8, 0.9),
    lambda a, b: a[..., ::-1], lambda a, b: a[:1] + b, lambda a, b: a.mean(axis=0) * b,
    lambda a, b: np.stack([a[..., 0], b[..., 1], a[..., 2]], axis=-1),
    lambda a, b: np.concatenate([a[..., :2], b[..., 2:]], axis=-1),
    lambda a, b: np.matvec(np.arange(9.0).reshape(3, 3) / 9, a), lambda a, b: np.vecdot(a, b)[..., None] - b,
    lambda a, b: a / np.linalg.norm(a, axis=-1, keepdims=True), lambda a, b: (a @ b.T) @ a / 4,
    lambda a, b: np.einsum("ij,ik->ij", a, b), lambda a, b: bmc.stack([a[..., 0], b[..., 0], 1.0]),
    lambda a, b: np.interp(a, [-1.0, 0.11, 0.77, 2.0], [0.0, 1.0, -1.0, 0.5]), lambda a, b: np.cross(a, b),
    lambda a, b: np.polyval([0.2, -1.0, 0.4], a), lambda a, b: np.cumsum(a, axis=1) - b.T.mT,
    lambda a, b: np.sign(a) * b, lambda a, b: np.logaddexp(a, b),
]  # fmt: skip


def program(steps: list[tuple[int, int, int]], x: Any) -> Any:
    """Steps over a pool of values of shape (2, 3)."""
    pool = [x, 0.7 - 1.4 * x]
    for step, first, second in steps:
        a, b = pool[first % len(pool)], pool[second % len(pool)]
        pool.append(STEPS[step % len(STEPS)](a, b))
    return pool[-1]


STEP = st.tuples(st.integers(0, len(STEPS) - 1), st.integers(0, 9), st.integers(0, 9))


@settings(max_examples=session.scaled(150, 10))
@given(st.lists(STEP, min_size=1, max_size=7), st.integers(0, 10**6))
def test_random_expressions(steps: list[tuple[int, int, int]], seed: int) -> None:
    x = np.random.default_rng(seed).uniform(-1.2, 1.2, size=(2, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = program(steps, dual(x))
        except NoTangent as reason:  # two ways to the same number are compared
            assert not reason.always
            return
        value = program(steps, x)
        assert found.shape == value.shape == (2, 3)
        assert_right(lambda v: program(steps, v), x, found)


@pytest.mark.parametrize("seed", range(40))
def test_smooth_expressions_to_rounding(seed: int) -> None:
    """Where all steps are analytic, derivatives along complex steps have no error but rounding."""
    rng = np.random.default_rng(seed)
    smooth: list[Callable[..., Any]] = [
        lambda a, b: a * b, lambda a, b: a / (1.5 + b**2), lambda a, b: np.exp(-(a**2)),
        lambda a, b: np.sin(a) - np.cos(b), lambda a, b: np.sqrt(2.0 + a * a), lambda a, b: np.tanh(a + b),
        lambda a, b: np.log(3.0 + a * a), lambda a, b: np.arctan(a), lambda a, b: np.sinh(a) / 2,
        lambda a, b: np.where(np.arange(3) > 0, a, b), lambda a, b: np.einsum("ij,kj->kj", a, b),
    ]  # fmt: skip
    chosen = rng.integers(len(smooth), size=6), rng.integers(8, size=(6, 2))
    x = rng.uniform(-1, 1, size=(2, 3))

    def expression(v: Any) -> Any:
        pool = [v, 0.3 + 0.5 * v]
        for step, (i, j) in zip(*chosen, strict=True):
            pool.append(smooth[step](pool[i % len(pool)], pool[j % len(pool)]))
        return pool[-1]

    found = expression(dual(x))
    for k in range(x.size):
        move = 1e-30j * (np.arange(x.size) == k).reshape(x.shape)
        wanted = np.imag(expression(x + move)) / 1e-30
        size = np.abs(found.tangent).max(initial=1.0)
        np.testing.assert_allclose(found.tangent[..., k], wanted, rtol=1e-11, atol=1e-13 * size)


def test_a_wrong_rule_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: slopes of the sine that are off by 1e-4 fail each comparison."""
    table = {**partials._PARTIALS, np.sin: (lambda x, y: np.cos(x) + 1e-4,)}
    monkeypatch.setattr(partials, "_PARTIALS", table)
    with pytest.raises(AssertionError):
        attempt(np.sin, POINT)
    with pytest.raises(AssertionError):
        test_random_expressions()
    monkeypatch.undo()
    plain = rules.function_keeps_affine  # a function that is taken for affine and is not
    monkeypatch.setattr(
        rules, "function_keeps_affine", lambda f, a, k: f is np.prod or plain(f, a, k)
    )
    with pytest.raises(AssertionError):
        attempt(np.prod, POINT)


# ---- kinks, jumps, and what would show the numbers ---------------------------------------------


@pytest.mark.parametrize(
    "function",
    [
        np.abs, np.fabs, np.sqrt, np.cbrt, np.sinc, lambda x: np.maximum(x, 0), lambda x: np.clip(x, 0, 1),
        lambda x: np.minimum(x, -x), lambda x: np.hypot(x, x), lambda x: np.linalg.norm(x),
        lambda x: np.arctan2(x, x), lambda x: np.remainder(x, 2.0), lambda x: x**0.5,
        lambda x: np.interp(x, [-1.0, 0.0, 1.0], [0.0, 2.0, 1.0]),
    ],
)  # fmt: skip
def test_kinks_have_no_derivative(function: Callable[[Any], Any]) -> None:
    found = function(dual([0.0]))
    assert not np.isfinite(found.tangent).any()
    # left out, they do not count
    x = dual([0.0, 0.4])
    kept = np.where([True, False], 2.0 * x, np.where(x.value > 9, function(x), 1.0))
    assert np.array_equal(kept.tangent, [[2.0, 0.0], [0.0, 0.0]])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: np.where(x > 0, x, x**2), lambda x: np.where(x == 0, 0.0, x**2), np.sign, np.floor,
        lambda x: x // 2, lambda x: np.rint(x + 0.5), lambda x: x.astype(int), lambda x: np.equal(x, -x),
    ],
)  # fmt: skip
def test_jumps_give_up_for_this_point_only(function: Callable[[Any], Any]) -> None:
    """What is right at most points, and at a tie would depend on the side."""
    with pytest.raises(NoTangent) as caught:
        function(dual([0.3, 0.0]))
    assert not caught.value.always
    function(dual([0.3, 0.2]))


@pytest.mark.parametrize(
    "function",
    [
        float, bool, list, np.asarray, lambda x: np.array([x[0], x[1]]), np.sort, np.prod, np.std,
        lambda x: np.add.accumulate(x), lambda x: np.add.at(x, 0, 1.0), lambda x: x.astype("f4"),
        lambda x: np.arange(3)[x], lambda x: x[x], lambda x: np.where(x, 1.0, x), lambda x: np.divmod(x, 2.0),
        lambda x: np.add(x, 1.0, out=np.zeros(2)), lambda x: np.add(x, 1.0, where=x > 0), scipy.special.gamma,
        lambda x: np.vectorize(lambda v: 2 * v)(x), lambda x: [1.0, x[0]] + x, lambda x: np.sum([x, x]),
        lambda x: np.linalg.norm(np.outer(x, x), 2), lambda x: np.sum(x, initial=2.0),
    ],
)  # fmt: skip
def test_what_cannot_be_followed_gives_up_for_good(function: Callable[[Any], Any]) -> None:
    with pytest.raises((NoTangent, TypeError)) as caught:
        function(dual([0.3, 0.2]))
    assert getattr(caught.value, "always", True)


def test_what_an_array_tells_of_itself() -> None:
    x = dual()
    assert (x.shape, x.ndim, x.size, x.dtype) == ((2, 3), 2, 6, np.float64)
    assert not x.flags.writeable and np.shape(x) == (2, 3) and np.zeros_like(x).shape == (2, 3)
    assert x.T.shape == (3, 2) and x.reshape(6).tangent.shape == (6, 6)
    assert x.astype(float).tangent is x.tangent and "directions" in repr(x)
    assert (x > 0.5).dtype == bool and (np.floor(x + 0.5).astype(int)).dtype == np.int64
    one = dual(0.4)
    assert (one if one > 0 else -one).tangent.tolist() == [1.0]
    assert inspect.signature(Dual).parameters.keys() == {"value", "tangent"}


@pytest.mark.parametrize(
    ("function", "wanted"),
    [
        (lambda v: v[np.array([2, 0])], [0.0, 0.0, 1.0]),
        (lambda v: np.exp(v).sum("k")[None], np.exp(POINT[0])),
        (lambda v: (v * v)[1][None], [0.0, 2 * POINT[0, 1], 0.0]),
    ],
)
def test_foreign_plates(function: Callable[[Any], Any], wanted: Any) -> None:
    found = function(PlateArray(dual(POINT[0]), ("k",)))
    np.testing.assert_allclose(found.tangent[0], wanted)


def test_distributions_record_the_call() -> None:
    call: Any = bmc.Normal(np.sin(dual()), 1.0)
    assert isinstance(call, TracedCall) and isinstance(call.arguments["loc"], Dual)
