"""What is rounding in a file, and what is a fault."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.io.rows import first_improbable, renormalised, sum_fault, without_rounding


@pytest.mark.parametrize(
    ("states", "off", "is_rounding"),
    [(2, 1e-6, True), (2, 1.1e-6, False), (3, 1.5e-6, True), (3, 1.6e-6, False),
     (20, 1e-5, True), (20, 1.1e-5, False)],
)  # fmt: skip
@pytest.mark.parametrize("sign", [-1, 1])
def test_rounding_is_half_a_unit_of_the_sixth_decimal_per_entry(states, off, is_rounding, sign):
    row = np.full((1, states), 1 / states)
    row[0, 0] += sign * off
    rows, bad = renormalised(row)
    assert (bad is None) == is_rounding
    assert rows.sum() == pytest.approx(1.0 if is_rounding else row.sum(), abs=1e-15)


def test_six_decimals_of_any_row_are_rounding():
    """As other programs print them."""
    rng = np.random.default_rng(0)
    for states in (2, 3, 5, 30):
        printed = np.round(rng.dirichlet(np.ones(states), size=500), 6)
        assert renormalised(printed)[1] is None
        assert states == 2 or np.abs(printed.sum(axis=1) - 1).max() > 9e-7


def test_the_worst_row_is_named_and_exact_rows_are_left_alone():
    table = np.array([[0.1, 0.9], [0.3, 0.6], [0.5, 0.4], [0.3, 0.7 + 1e-7]])
    rows, bad = renormalised(table)
    assert bad in (1, 2) and "a row sums to 0.9, not 1" in sum_fault(table[bad])
    np.testing.assert_array_equal(rows[0], table[0])
    assert without_rounding(table) is table
    np.testing.assert_array_equal(without_rounding(table[[0, 3]]), rows[[0, 3]])
    assert table[3, 1] == 0.7 + 1e-7  # the argument is as it was


@pytest.mark.parametrize(
    ("values", "index"),
    [([0.5, 0.5], None), ([], None), ([0.0, 1.0 + 1e-6], None), ([0.1, 1.1, -1.0], 1),
     ([0.1, float("nan")], 1), ([float("inf")], 0), ([-1e-300, 1.0], 0)],
)  # fmt: skip
def test_first_improbable(values, index):
    assert first_improbable(values) == index
