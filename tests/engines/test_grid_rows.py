"""Grids compare rows with those they expect: ranks, deficits and the warning, found grids and given ones.

Draws are of fixed seeds. Counts of ranks in ten cells are held against their expectation by chi-square at a
chance of 1e-4 each; a right model warns with a chance below 1e-6.
"""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.errors import ModelMisfitWarning
from bayesmc.testing import session


def series(moves: float = 0.15, start: float = 0.754) -> bmc.DynamicBayesNet:
    """The binomial series, with its noise to choose."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x", lambda x_prev: bmc.Normal(-4 + 0.98 * (x_prev + 4), moves),
        initial=bmc.Normal(-4, start),
    )  # fmt: skip
    dbn.add("y", lambda x: bmc.Binomial(50, logits=x))
    return dbn


def level(density: Any) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.2), initial=bmc.Normal(0.0, 0.5))
    dbn.add("y", density)
    return dbn


MODELS = {
    "binomial": (series, lambda y: 50 - y),
    "poisson": (lambda: level(lambda x: bmc.Poisson(np.exp(x))), lambda y: 30 * y),
    "heavy tails": (lambda: level(lambda x: bmc.StudentT(4, x, 0.3)), lambda y: 30 * y),
}


def drawn(dbn: bmc.DynamicBayesNet, steps: int, seed: int) -> np.ndarray:
    return dbn.sample(steps, rng=session.seed() + seed)["y"][0]


def unevenness(ranks: np.ndarray) -> float:
    """Chance of counts in ten cells as uneven as these, of uniform ranks."""
    ranks = ranks[np.isfinite(ranks)]
    count = np.histogram(ranks, 10, (0.0, 1.0))[0]
    expected = len(ranks) / 10
    return float(special.chdtrc(9, ((count - expected) ** 2).sum() / expected))


@pytest.mark.parametrize("name", MODELS)
def test_the_grid_that_is_taken_unasked_notices_rows_of_another_kind(name: str) -> None:
    make, other = MODELS[name]
    dbn = make()
    y = drawn(dbn, 60, 1)
    found = bmc.filter(dbn, {"y": y}, rng=2)  # warnings are errors
    assert isinstance(found.engine, bmc.GridFilter)
    assert np.isfinite(found.row_ranks).sum() >= 5 and np.nanmean(found.row_deficits) < 1.0
    wrong = series(0.05, 0.15) if name == "binomial" else dbn
    with pytest.warns(ModelMisfitWarning, match="GridFilter: .* rows compared in slices") as said:
        lost = bmc.filter(wrong, {"y": other(y)}, rng=2)
    assert said[0].filename == __file__
    assert np.nanmean(lost.row_deficits) > 1.0
    with pytest.warns(ModelMisfitWarning):
        smoothed = bmc.smooth(wrong, {"y": other(y)}, rng=2)
    np.testing.assert_array_equal(smoothed.row_ranks, lost.row_ranks)
    again = pickle.loads(pickle.dumps(lost))
    np.testing.assert_array_equal(again.predictive_ranks("y"), lost.predictive_ranks("y"))


def pairs() -> bmc.DynamicBayesNet:
    """Plates that never meet, two hidden numbers in each, one of which is seen now and then."""
    dbn = bmc.DynamicBayesNet(plates={"site": 3})
    dbn.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 0.4), plates="site",
            initial=bmc.Normal(0.0, 0.6))  # fmt: skip
    dbn.add("on", lambda on_prev: bmc.Bernoulli(np.where(on_prev, 0.9, 0.2)), plates="site",
            initial=bmc.Bernoulli(0.5), parents=["on_prev"])  # fmt: skip
    dbn.add("y", lambda x, on: bmc.Normal(x + 2.0 * on, 0.4), plates="site")
    dbn.add("n", lambda x: bmc.Poisson(np.exp(x)), plates="site")
    return dbn


def test_ranks_are_uniform_on_a_grid_that_is_given() -> None:
    dbn = pairs()
    rows = {n: v[0].copy() for n, v in dbn.sample(120, rng=session.seed() + 3).items() if n != "x"}
    rows["on"] = rows["on"].astype(float)
    rows["on"][np.arange(120) % 5 != 0] = np.nan
    rows["y"][::7, 1] = np.nan
    engine = bmc.GridFilter({"x": (-6.0, 6.0, 100)})
    found = bmc.filter(dbn, rows, engine=engine, rng=4)
    assert found.row_ranks.shape == (120, 3)
    for ranks in (found.row_ranks, *(found.predictive_ranks(n) for n in ("y", "n", "on"))):
        assert ranks.shape == (120, 3) and unevenness(ranks) > 1e-4
    with pytest.warns(ModelMisfitWarning):
        wrong = bmc.filter(dbn, {**rows, "n": 8 * rows["n"]}, engine=engine, rng=4)
    assert unevenness(wrong.predictive_ranks("n")) < 1e-4


def test_draws_from_cells_are_draws_from_the_belief() -> None:
    """Means of 4,000 draws within 5 standard errors of the belief's: one false alarm in 1e5 runs."""
    from bayesmc.engines.filtering import quiet
    from bayesmc.engines.grid.posterior import draws_of

    dbn, engine = pairs(), bmc.GridFilter({"x": (-6.0, 6.0, 100)})
    belief = engine.step(engine.start(dbn), {"y": [3.0, 0.5, -1.0], "n": [2, 0, 1]})
    with quiet():
        drawn = draws_of(belief.state.mover.model, belief.state.cells)(
            np.random.default_rng(5), 4000
        )
    for name, mean, std in (
        ("x", belief.mean("x"), belief.std("x")),
        ("on", belief.mean("on"), belief.std("on")),
    ):
        assert drawn[name].shape == (4000, 3)
        off = np.abs(drawn[name].mean(axis=0) - mean) / (std / np.sqrt(4000) + 1e-12)
        assert off.max() < 5
        assert (np.abs(drawn[name].mean(axis=0)[::-1] - mean) / std)[0] > 0.2, "the control"
    both = (drawn["x"] * drawn["on"]).mean(axis=0)
    expected = belief.expectation(lambda x, on: x * on)
    assert np.abs(both - expected).max() < 5 * 1.0 / np.sqrt(4000)
