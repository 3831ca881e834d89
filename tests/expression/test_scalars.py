"""Small expressions on Python's floats: what arrays give, and arrays where Python refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import special

from bayesmc.expression import (
    Expression,
    Program,
    TracedArray,
    call,
    elementwise,
    leaf,
    pick,
    scalars,
    trace,
)
from bayesmc.expression.functions import product
from bayesmc.expression.scalars import SmallProgram, upper_inverse

RNG = np.random.default_rng(3)


def _both(
    roots: list[Expression], values: dict[str, np.ndarray], code: bool = True
) -> list[np.ndarray]:
    program = SmallProgram(roots)
    assert (program._code is not None) == code
    found, expected = program(values), Program(roots)(values)
    for a, b in zip(found, expected, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)
    return found


def _function(x: Any, s: Any) -> Any:
    z = (x[..., 0] - 2.0) ** 2 / s[..., 1] + np.sqrt(s[..., 0]) * np.log1p(s).sum(axis=-1)
    z = z + np.max(s, axis=-1) - np.min(x[..., :2], axis=-1)
    return np.where(x[..., 1] > 0.3, z, -np.maximum(x[..., 1], np.exp(-np.abs(x[..., 2]))))


@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 2), (400,)])
def test_the_same_as_arrays(batch: tuple[int, ...]) -> None:
    x, s = leaf("x", (3,)), leaf("s", (2,))
    root = trace(_function, [TracedArray(x), TracedArray(s)])
    values = {"x": RNG.normal(size=(*batch, 3)), "s": RNG.gamma(2.0, size=(*batch, 2))}
    _both([root, pick([root], np.zeros((2, 1), int)), pick([x], 1)], values)
    _both([root], {**values, "s": RNG.gamma(2.0, size=2)})


@pytest.mark.parametrize("d", [1, 2, 4])
def test_triangles(d: int) -> None:
    a, b = leaf("a", (3, d, d)), leaf("b", (3, d))
    root = call(np.linalg.cholesky, [a])
    turned = np.arange(3 * d * d).reshape(3, d, d).swapaxes(-1, -2)
    inverse = call(upper_inverse, [pick([root], turned)])
    m = RNG.normal(size=(2, 3, d, d))
    values = {"a": m @ m.swapaxes(-1, -2) + np.eye(d), "b": RNG.normal(size=(2, 3, d))}
    found = _both([root, product(np.matvec, inverse, b)], values)
    np.testing.assert_allclose(found[0] @ found[0].swapaxes(-1, -2), values["a"], rtol=1e-12)


@pytest.mark.parametrize(
    ("function", "at"), [(np.log, 0.0), (np.log, -1.0), (np.reciprocal, 0.0), (np.exp, 1e4)]
)
def test_what_python_refuses_is_what_arrays_say(function: Any, at: float) -> None:
    root = elementwise(function, leaf("x", (2,)))
    with np.errstate(all="ignore"):
        expected = function(np.array([at, 2.0]))
    np.testing.assert_array_equal(SmallProgram([root])({"x": np.array([at, 2.0])})[0], expected)


def test_a_matrix_without_a_factor_raises_as_arrays_do() -> None:
    program = SmallProgram([call(np.linalg.cholesky, [leaf("a", (2, 2))])])
    with pytest.raises(np.linalg.LinAlgError):
        program({"a": np.array([[1.0, 2.0], [2.0, 1.0]])})


def test_what_has_no_rule_is_left_to_arrays() -> None:
    x = leaf("x", (2,))
    _both([elementwise(special.gammaln, x)], {"x": RNG.gamma(2.0, size=(3, 2))}, False)
    many = leaf("many", (20_000,))
    _both([elementwise(np.add, many, 1.0)], {"many": RNG.normal(size=20_000)}, False)


def test_not_a_number_stays_so() -> None:
    x = leaf("x", (2,))
    least = elementwise(np.maximum, pick([x], 0), pick([x], 1))
    for pair in ([np.nan, 1.0], [1.0, np.nan]):
        assert np.isnan(SmallProgram([least])({"x": np.array(pair)})[0])


def test_long_sums_are_no_deep_lines() -> None:
    """Python's compiler gives up where one line nests some thousand signs."""
    x = leaf("x", (2000,))
    total = trace(lambda x: np.sum(x * x, axis=-1), [TracedArray(x)])
    inner = trace(lambda x: np.vecdot(x, x), [TracedArray(x)])
    at = RNG.normal(size=2000)
    for root in (total, inner):
        function, _ = scalars._compiled((root,), (("x", 1, 2000),))
        assert function([at.tolist()]) == pytest.approx([at @ at])
