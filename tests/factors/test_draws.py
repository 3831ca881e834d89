"""Draws from many rows at once: right frequencies on every code path, never a zero column."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.factors.draws import draw_columns


class AlmostOne:
    """A generator whose uniforms are all the largest float below 1."""

    def random(self, count):
        return np.full(count, np.nextafter(1.0, 0.0))


@pytest.mark.parametrize(("rows", "columns"), [(1, 5), (1, 40), (3, 2), (3, 16), (3, 17), (3, 100)])
@pytest.mark.parametrize("spare", [0, 300_000], ids=["all rows used", "few rows used"])
def test_frequencies(rows, columns, spare):
    """Each cell within 5.5 standard errors: under 700 cells in all, so a false alarm in 3e-5."""
    rng = np.random.default_rng(columns)
    weights = rng.gamma(1.0, size=(rows, columns))
    weights[rng.random(weights.shape) < 0.2] = 0.0
    weights[:, 0] += 0.1
    draws = 60_000
    which = np.sort(rng.integers(rows, size=draws))
    table = np.vstack([weights, np.zeros((spare // columns * (spare > 0), columns))])
    picked = draw_columns(table, which, rng)
    for row in range(rows):
        counts = np.bincount(picked[which == row], minlength=columns)
        expected = weights[row] / weights[row].sum()
        n = counts.sum()
        assert not counts[expected == 0.0].any()
        error = np.sqrt(n * expected * (1 - expected)) + 1e-9
        assert (np.abs(counts - n * expected) < 5.5 * error + 1).all()
        assert (np.abs(counts - n / columns) > 5.5 * error + 1).any()  # uniform draws would fail


@pytest.mark.parametrize("columns", [3, 20])
@pytest.mark.parametrize("scale", [1e-300, 0.1, 1.0, 3.0, 1e300])
def test_trailing_zeros_are_never_drawn(columns, scale):
    weights = np.zeros((4, columns))
    weights[:, 1] = scale * np.array([1.0, 0.3, 0.7, 0.9])
    rows = np.arange(4)
    assert (draw_columns(weights, rows, AlmostOne()) == 1).all()
    assert (draw_columns(weights[:1], np.zeros(5, dtype=int), AlmostOne()) == 1).all()


def test_one_column_and_no_draws():
    rng = np.random.default_rng(0)
    assert (draw_columns(np.ones((2, 1)), np.array([0, 1, 1]), rng) == 0).all()
    assert draw_columns(np.ones((2, 3)), np.array([], dtype=int), rng).shape == (0,)
