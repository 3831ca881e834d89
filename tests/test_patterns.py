"""Small matrices side by side: factors and triangles as LAPACK has them."""

import numpy as np
import pytest

from bayesmc.linalg.patterns import cholesky, triangular


@pytest.mark.parametrize("width", [1, 2, 3, 4, 5, 9])
@pytest.mark.parametrize("rows", [1, 5])
def test_triangles_are_solved(width: int, rows: int) -> None:
    rng = np.random.default_rng(width)
    root = np.tril(rng.normal(size=(rows, 6, width, width))) + 3.0 * np.eye(width)
    for columns, many in ((2, 1), (1, 1), (1, 9)):  # one column of many is solved row by row
        roots = np.concatenate([root] * many)
        right = rng.normal(size=(5 if many == 1 else rows * many, 6, width, columns))
        for transposed, matrix in ((False, roots), (True, np.swapaxes(roots, -1, -2))):
            found = triangular(roots, right, transposed)
            np.testing.assert_allclose(matrix @ found, right, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("width", [2, 3])
def test_matrices_without_a_factor_cost_no_other(width: int) -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(4, 3, width, width))
    matrices = half @ np.swapaxes(half, -1, -2) + 0.1 * np.eye(width)
    found, wrong = cholesky(matrices)
    assert not wrong.any()
    np.testing.assert_allclose(found, np.linalg.cholesky(matrices), rtol=1e-10, atol=1e-12)
    bad = {
        (0, 1): -np.eye(width),
        (1, 0): np.ones((width, width)),
        (2, 2): np.full((width,) * 2, np.nan),
    }
    bad[3, 1] = np.diag([np.inf, *[1.0] * (width - 1)])
    for at, matrix in bad.items():
        matrices[at] = matrix
    again, wrong = cholesky(matrices)
    assert {tuple(map(int, at)) for at in np.argwhere(wrong)} >= {(0, 1), (2, 2)}
    assert (again[wrong] == np.eye(width)).all()
    assert np.isfinite(again[~wrong]).all()
    right = ~wrong & ~np.isin(np.arange(12).reshape(4, 3), [1, 3, 8, 10])
    np.testing.assert_allclose(again[right], found[right], rtol=1e-10, atol=1e-12)
