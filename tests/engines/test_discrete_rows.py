"""Discrete filters compare rows with those they expect: ranks, deficits and the warning.

Draws are of fixed seeds. Counts of ranks in ten cells are held against their expectation by chi-square at a
chance of 1e-4 each; a right model warns with a chance below 1e-6.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.errors import ModelMisfitWarning
from bayesmc.testing import session

CHANGES = [[0.95, 0.05], [0.1, 0.9]]


def levels() -> bmc.DynamicBayesNet:
    """Plates that never meet, a computed level, and an observed node that is read in the next slice."""
    dbn = bmc.DynamicBayesNet(plates={"site": 4})
    dbn.table("x", ["x_prev"], CHANGES, initial=[0.5, 0.5], plates="site")
    dbn.add("m", lambda x: np.where(x == 1, 2.0, -1.0), plates="site")
    dbn.add("y", lambda m, y_prev: bmc.Normal(m + 0.3 * y_prev, 0.5), plates="site",
            initial=bmc.Normal(0.0, 1.0))  # fmt: skip
    return dbn


def steps() -> bmc.DynamicBayesNet:
    """Two chains that one row reads, by way of a computed node of this slice and of the one before."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], CHANGES, initial=[0.5, 0.5])
    dbn.table("z", ["z_prev"], CHANGES, initial=[0.5, 0.5])
    dbn.add("c", lambda x, z: 2.0 * x + z)
    dbn.add("y", lambda c, c_prev: bmc.Normal(c - c_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    return dbn


def labels() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], CHANGES, initial=[0.5, 0.5])
    dbn.table("y", ["x"], [[0.97, 0.02, 0.01], [0.01, 0.02, 0.97]])
    return dbn


def unevenness(ranks: np.ndarray) -> float:
    """Chance of counts in ten cells as uneven as these, of uniform ranks."""
    ranks = ranks[np.isfinite(ranks)]
    count = np.histogram(ranks, 10, (0.0, 1.0))[0]
    expected = len(ranks) / 10
    return float(special.chdtrc(9, ((count - expected) ** 2).sum() / expected))


@pytest.mark.parametrize(
    ("make", "other"),
    [
        (levels, lambda y: 5 * y),
        (steps, lambda y: 5 * y),
        (labels, lambda y: (y + 1) % 3),  # a column in another order
    ],
)
def test_rows_are_compared(
    make: Callable[[], bmc.DynamicBayesNet], other: Callable[[np.ndarray], np.ndarray]
) -> None:
    dbn = make()
    y = dbn.sample(600, rng=session.seed() + 1)["y"][0]
    found = bmc.filter(dbn, {"y": y}, engine=bmc.DiscreteFilter(), rng=2)  # warnings are errors
    assert found.row_ranks.shape == y.shape and 40 <= np.isfinite(found.row_ranks).sum() <= 1600
    assert unevenness(found.row_ranks) > 1e-4 and unevenness(found.predictive_ranks("y")) > 1e-4
    with pytest.warns(ModelMisfitWarning, match="DiscreteFilter: .* rows compared") as said:
        lost = bmc.filter(dbn, {"y": other(y)}, engine=bmc.DiscreteFilter(), rng=2)
    assert said[0].filename == __file__
    assert unevenness(lost.row_ranks) < 1e-4 and np.nanmean(lost.row_deficits) > 1.0
    with pytest.warns(ModelMisfitWarning):
        smoothed = bmc.smooth(dbn, {"y": other(y)}, engine=bmc.DiscreteFilter(), rng=2)
    np.testing.assert_array_equal(smoothed.row_ranks, lost.row_ranks)
