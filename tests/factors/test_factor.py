"""Textbook factors and variable elimination against einsum."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.errors import BudgetError
from bayesmc.factors import Factor, sum_product

RNG = np.random.default_rng(0)
AB = Factor(("a", "b"), RNG.random((2, 3)))
CB = Factor(("c", "b"), RNG.random((4, 3)), log_scale=np.log(10.0))


def test_product_aligns_by_name():
    product = AB * CB
    assert product.scope == ("a", "b", "c")
    np.testing.assert_allclose(product.values, np.einsum("ab,cb->abc", AB.values, CB.values))
    assert product.log_scale == pytest.approx(np.log(10.0))


def test_sum_out_and_reduce():
    summed = (AB * CB).sum_out(["b", "absent"])
    assert summed.scope == ("a", "c")
    np.testing.assert_allclose(summed.values, AB.values @ CB.values.T)
    at = CB.reduce({"b": 2, "absent": 0})
    assert at.scope == ("c",)
    np.testing.assert_array_equal(at.values, CB.values[:, 2])


def test_rescaled_is_the_same_function():
    tiny = Factor(("a",), np.array([2e-300, 4e-300]))
    scaled = tiny.rescaled()
    np.testing.assert_allclose(scaled.values, [0.5, 1.0])
    assert scaled.log_scale == pytest.approx(np.log(4e-300))
    assert Factor(("a",), np.zeros(2)).rescaled().log_scale == 0.0


def test_table_orders_axes_and_normalises():
    table = CB.table(("b", "c"))
    np.testing.assert_allclose(table, CB.values.T / CB.values.sum())


def test_sum_product_matches_einsum():
    da = Factor(("d", "a"), RNG.random((2, 2)))
    found = sum_product([AB, CB, da], keep=["d", "c"])
    expected = np.einsum("ab,cb,da->dc", AB.values, CB.values, da.values)
    np.testing.assert_allclose(found.table(("d", "c")), expected / expected.sum())
    total = np.exp(found.log_scale) * found.values.sum()
    assert total == pytest.approx(10.0 * expected.sum())


def test_sum_product_refuses_before_it_multiplies():
    factors = [Factor((f"x{i}",), np.ones(10)) for i in range(40)]
    with pytest.raises(BudgetError, match="bytes") as caught:
        sum_product(factors, keep=[f"x{i}" for i in range(40)], max_bytes=1e9)
    assert caught.value.bytes > 1e40


def test_scope_must_name_the_axes():
    with pytest.raises(ValueError, match="must name each of the 2 axes"):
        Factor(("a",), np.ones((2, 2)))
    with pytest.raises(ValueError, match="once"):
        Factor(("a", "a"), np.ones((2, 2)))
