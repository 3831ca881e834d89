"""Quantiles over time: on grids, of finite nodes, of what was seen; and words for what is not there."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.errors import QueryError, UnsupportedError

ROWS = np.array([0.3, -1.2, 2.0, 0.7, 1.1])
LEVELS = [0.05, 0.5, 0.9]


def level() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


GRIDS = {
    "found": {},
    "even": {"x": (-8.0, 8.0, 200)},
    "few": {"x": (-8.0, 8.0, 60)},
    "uneven": {"x": np.sinh(np.linspace(-3.0, 3.0, 240))},
}


@pytest.mark.parametrize("name", GRIDS)
def test_grids_have_the_quantiles_of_the_exact_filter(name: str) -> None:
    engine = bmc.GridFilter(GRIDS[name])
    for ask in (bmc.filter, bmc.smooth):
        found = ask(level(), {"y": ROWS}, engine=engine)
        exact = ask(level(), {"y": ROWS}, engine=bmc.KalmanFilter())
        at, truth = found.quantile("x", LEVELS), exact.quantile("x", LEVELS)
        assert at.shape == truth.shape == (5, 3)
        np.testing.assert_allclose(at, truth, atol=0.01 if name == "uneven" else 1e-4)
        assert np.abs(at[:-1] - truth[1:]).max() > 0.1, "the control"
        np.testing.assert_allclose(found.quantile("x", 0.5), at[:, 1])
        np.testing.assert_array_equal(found.quantile("y", LEVELS), ROWS[:, None].repeat(3, axis=1))
    belief = engine.start(level()) if name != "found" else None
    if belief is not None:
        belief = engine.step(belief, {"y": ROWS[0]})
        filtered = bmc.filter(level(), {"y": ROWS}, engine=engine)
        np.testing.assert_allclose(belief.quantile("x", LEVELS), filtered.quantile("x", LEVELS)[0])


def test_components_plates_and_elements_that_are_seen() -> None:
    root = np.array([[1.0, 0.0], [0.6, 0.8]])
    dbn = bmc.DynamicBayesNet(plates={"i": 2})
    dbn.add("v", lambda v_prev: bmc.MvNormal(0.5 * v_prev, scale_tril=root),
            initial=bmc.MvNormal(np.zeros(2), scale_tril=root))  # fmt: skip
    dbn.add("y", lambda v: bmc.Normal(v[..., 0], 1.0))
    grid = bmc.GridFilter({"v": (-6.0, 6.0, 40)})
    found = bmc.filter(dbn, {"y": ROWS[:3]}, engine=grid)
    exact = bmc.filter(dbn, {"y": ROWS[:3]}, engine=bmc.KalmanFilter())
    np.testing.assert_allclose(found.quantile("v", LEVELS), exact.quantile("v", LEVELS), atol=0.02)
    dbn = bmc.DynamicBayesNet(plates={"i": 2})
    dbn.add("w", lambda w_prev: bmc.Normal(0.9 * w_prev, 1.0), plates="i",
            initial=bmc.Normal(0.0, 1.0))  # fmt: skip
    dbn.add("y", lambda w: bmc.Normal(w, 1.0), plates="i")
    rows = {"y": np.stack([ROWS, -ROWS], axis=1), "w": np.full((5, 2), np.nan)}
    rows["w"][2] = 0.5, np.nan
    rows["w"][3] = 0.25, 0.75
    for engine in (bmc.GridFilter({"w": (-8.0, 8.0, 200)}),):
        found = bmc.filter(dbn, rows, engine=engine)
        exact = bmc.filter(dbn, rows, engine=bmc.KalmanFilter())
        np.testing.assert_allclose(
            found.quantile("w", LEVELS), exact.quantile("w", LEVELS), atol=0.02
        )


def test_counts_and_finite_nodes_have_the_least_number_with_so_much_below() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("n", lambda n_prev: bmc.Poisson(1.0 + 0.5 * n_prev), initial=bmc.Poisson(3.0))
    dbn.add("y", lambda n: bmc.Normal(n, 1.0))
    found = bmc.filter(dbn, {"y": [2.0, 4.0, 3.0]}, engine=bmc.GridFilter({"n": np.arange(60)}))
    below = np.cumsum(found.density("n"), axis=1)
    for k, q in enumerate(LEVELS):
        np.testing.assert_array_equal(found.quantile("n", LEVELS)[:, k], (below < q).sum(axis=1))
    die = bmc.DynamicBayesNet()
    die.add("d", lambda d_prev: bmc.DiscreteUniform(1, 6), initial=bmc.DiscreteUniform(1, 6))
    die.add("y", lambda d: bmc.Normal(d, 100.0))
    found = bmc.filter(die, {"y": [3.0, 4.0]}, engine=bmc.DiscreteFilter())
    assert found.quantile("d", [0.0, 0.1, 0.45, 0.9, 1.0])[0].tolist() == [1, 1, 3, 6, 6]
    assert found.quantile("d", 0.45).shape == (2,)
    with pytest.raises(QueryError, match="between 0 and 1"):
        found.quantile("d", 1.5)


def test_levels_and_nodes_that_have_none_are_refused_in_words() -> None:
    dbn = level()
    dbn.add("z", lambda x: bmc.Normal(x, 1.0))  # integrated out
    found = bmc.filter(dbn, {"y": ROWS}, engine=bmc.GridFilter({"x": (-8.0, 8.0, 100)}))
    with pytest.raises(UnsupportedError, match=r"quantile\('z'\).*not on the grid.*\['x'\]"):
        found.quantile("z", 0.5)
    for q, says in ((1.5, "lie between 0 and 1"), ("a", "numbers between 0 and 1")):
        with pytest.raises(QueryError, match=says):
            found.quantile("x", q)
    ahead = bmc.forecast(level(), {"y": ROWS}, steps=2, engine=bmc.ParticleFilter(100), rng=0)
    with pytest.raises(UnsupportedError, match=r"'x' has no quantile.*queries="):
        ahead.quantile("x", 0.5)


@pytest.mark.parametrize(
    ("name", "says"),
    [("ess", "weight_ess"), ("interval", "hdi"), ("draws", "keep="),
     ("density", "GridFilter"), ("nonsense", "has no 'nonsense'$")],
)  # fmt: skip
def test_what_has_another_name_is_named(name: str, says: str) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.table("y", ["x"], [[0.9, 0.1], [0.2, 0.8]])
    found: Any = bmc.filter(dbn, {"y": [0, 1]}, engine=bmc.DiscreteFilter())
    with pytest.raises(AttributeError, match=says):
        getattr(found, name)
    assert not hasattr(found, name)
    for other in (copy.copy(found), copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        np.testing.assert_array_equal(other.probabilities("x"), found.probabilities("x"))


def test_the_levels_are_those_of_a_normal() -> None:
    """The reference itself: the exact filter's quantiles are mean plus std times the normal's."""
    exact = bmc.filter(level(), {"y": ROWS}, engine=bmc.KalmanFilter())
    expected = exact.mean("x")[:, None] + exact.std("x")[:, None] * special.ndtri(LEVELS)
    np.testing.assert_allclose(exact.quantile("x", LEVELS), expected)
