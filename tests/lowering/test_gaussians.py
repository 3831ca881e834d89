"""Loops over many small Gaussians against the same by NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.lowering import Coefficients, GaussianLoops, gaussian_loops, is_available

pytestmark = pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")


@pytest.fixture(scope="module")
def loops() -> GaussianLoops:
    return gaussian_loops()


@pytest.mark.parametrize(
    ("size", "r", "c", "q", "m", "p"),
    [
        (9, 6, 4, 6, 4, 2),
        (5, 3, 2, 3, 3, 1),
        (4, 3, 0, 3, 0, 2),
        (7, 2, 3, 2, 4, 0),
        (3, 5, 2, 5, 2, 5),
    ],
)
def test_conditioning(
    loops: GaussianLoops, size: int, r: int, c: int, q: int, m: int, p: int
) -> None:
    rng = np.random.default_rng(r)
    moves, noise = rng.normal(size=(size, r, c)), rng.normal(size=(size, r, q))
    offset, row = rng.normal(size=(size, r)), rng.normal(size=p)
    mean, factor = rng.normal(size=(size, m)), np.tril(rng.normal(size=(size, m, m)))
    found = loops.conditioned(Coefficients(moves, noise, offset), mean, factor, row)
    assert found is not None
    rows = np.concatenate([moves @ factor[:, :c, :c], noise], axis=-1)
    joint = rows @ rows.swapaxes(1, 2)
    expected = offset + np.matvec(moves, mean[:, :c])
    off, seen = row - expected[:, :p], joint[:, :p, :p]
    gain = np.linalg.solve(seen, joint[:, :p, p:]).swapaxes(1, 2)
    left = joint[:, p:, p:] - gain @ joint[:, :p, p:]
    np.testing.assert_allclose(found[0], expected[:, p:] + np.matvec(gain, off), atol=1e-9)
    np.testing.assert_allclose(found[1] @ found[1].swapaxes(1, 2), left, atol=1e-9)
    assert (found[1] == np.tril(found[1])).all()
    square = np.vecdot(off, np.linalg.solve(seen, off[..., None])[..., 0])
    log = -0.5 * (square + np.linalg.slogdet(2 * np.pi * seen)[1])
    np.testing.assert_allclose(found[2], log, atol=1e-9)


@pytest.mark.parametrize(
    ("groups", "size", "n", "k"), [(3, 3, 4, 4), (2, 5, 3, 3), (4, 2, 1, 1), (2, 2, 2, 5)]
)
def test_merging(loops: GaussianLoops, groups: int, size: int, n: int, k: int) -> None:
    rng = np.random.default_rng(n)
    log, mean = rng.normal(size=(groups, size)) - 900.0, rng.normal(size=(groups, size, n))
    factor = rng.normal(size=(groups, size, n, k))
    log[0, 0] = -np.inf
    found = loops.merged(log, mean, factor)
    assert found is not None
    total = np.logaddexp.reduce(log, axis=1)
    share = np.exp(log - total[:, None])
    centre = (share[..., None] * mean).sum(axis=1)
    off = mean - centre[:, None]
    inner = factor @ factor.swapaxes(-1, -2) + off[..., :, None] * off[..., None, :]
    cov = (share[..., None, None] * inner).sum(axis=1)
    np.testing.assert_allclose(found[0], total, rtol=1e-13)
    np.testing.assert_allclose(found[1], centre, atol=1e-12)
    np.testing.assert_allclose(found[2] @ found[2].swapaxes(1, 2), cov, atol=1e-12)


def test_what_is_next_to_nothing_is_left_to_numpy(loops: GaussianLoops) -> None:
    """A number known without noise, a row that follows from another, a group without weight."""
    noise = np.array([[[1.0, 0.0], [2.0, 1e-14]]])
    none = np.zeros((1, 2, 0)), np.zeros((1, 2))
    given = Coefficients(none[0], noise, none[1])
    nothing = np.zeros((1, 0)), np.zeros((1, 0, 0))
    assert loops.conditioned(given, *nothing, np.zeros(1)) is None
    assert loops.conditioned(given, *nothing, np.zeros(2)) is None
    known = np.full((1, 2), -np.inf), np.zeros((1, 2, 1)), np.ones((1, 2, 1, 1))
    assert loops.merged(*known) is None
    assert loops.merged(np.zeros((1, 2)), np.zeros((1, 2, 1)), np.zeros((1, 2, 1, 1))) is None
