"""Draws from weights: right frequencies on every code path, never a state of weight zero."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.categorical import edges, pick, pick_log, pick_rows


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
    picked = pick_rows(table, which, rng)
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
    assert (pick_rows(weights, rows, AlmostOne()) == 1).all()
    assert (pick_rows(weights[:1], np.zeros(5, dtype=int), AlmostOne()) == 1).all()


def test_one_column_and_no_draws():
    rng = np.random.default_rng(0)
    assert (pick_rows(np.ones((2, 1)), np.array([0, 1, 1]), rng) == 0).all()
    assert pick_rows(np.ones((2, 3)), np.array([], dtype=int), rng).shape == (0,)


@pytest.mark.parametrize("states", [1, 2, 7, 300])
def test_every_way_draws_alike(states):
    """The same uniform numbers give the same states by weights, logs, columns and edges."""
    rng = np.random.default_rng(states)
    weights = rng.gamma(0.5, size=(states, 3)) * (rng.random((states, 3)) < 0.7)
    weights[rng.integers(states)] = 0.5
    uniform = rng.random((500, 3))
    many = pick(weights, uniform)
    with np.errstate(divide="ignore"):
        log = np.log(weights) - 2000.0
    for u, found in zip(uniform, many, strict=True):
        assert (pick(weights, u) == found).all()
        assert (pick_log(log, u, "x") == found).all()
    assert (weights[many, np.arange(3)] > 0).all()
    passed = edges(weights.T / weights.sum(axis=0)[:, None])
    assert (many == (uniform[..., None] >= passed).sum(axis=-1)).all()
