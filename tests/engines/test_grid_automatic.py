"""Grids that are found: the default engine where one number of a slice is hidden.

There is no chance in the answers; data are drawn at fixed seeds. The truth is a grid of thousands of cells.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import GridWarning
from bayesmc.testing import session

#: levels shift and bursts come that the models do not have
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")

Made = tuple[bmc.DynamicBayesNet, dict[str, Any], Any]


def counts() -> bmc.DynamicBayesNet:
    """The rate of fifty trials moves slowly."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Normal(-4 + 0.98 * (x_prev + 4), 0.15),
        initial=bmc.Normal(-4.0, 0.754),
    )
    dbn.add("y", lambda x: bmc.Binomial(50, logits=x))
    return dbn


def rows_of(dbn: bmc.DynamicBayesNet, steps: int, seed: int = 1) -> dict[str, Any]:
    return {"y": dbn.sample(steps, rng=seed)["y"][0].astype(float)}


def from_the_model() -> Made:
    return counts(), rows_of(counts(), session.scaled(200, 15)), (-12.0, 5.0, 700)


def with_shifts() -> Made:
    """A level that jumps, a single row and a burst that do not fit: particles are off by hundreds here."""
    rows = rows_of(counts(), 400)
    rows["y"][150:220] = 40
    rows["y"][300] = 50
    rows["y"][350:360] = np.random.default_rng(0).integers(0, 50, 10)
    return counts(), rows, (-12.0, 9.0, 700)


def missing_rows() -> Made:
    rows = rows_of(counts(), 200)
    rows["y"][50:120] = np.nan
    return counts(), rows, (-12.0, 5.0, 700)


def volatility() -> Made:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.98 * x_prev, 0.15), initial=bmc.Normal(0.0, 0.754))
    dbn.add("y", lambda x: bmc.Normal(0.0, np.exp(x / 2)))
    rows = rows_of(dbn, 300)
    rows["y"][150] = 60.0
    rows["y"][200:210] = 1e-5
    return dbn, rows, (-14.0, 14.0, 700)


def growth() -> Made:
    dbn = bmc.DynamicBayesNet()

    @dbn.node(initial=bmc.Normal(0.0, np.sqrt(5.0)))
    def x(x_prev, t):
        mean = 0.5 * x_prev + 25 * x_prev / (1 + x_prev**2) + 8 * np.cos(1.2 * t)
        return bmc.Normal(mean, np.sqrt(10.0))

    dbn.add("y", lambda x: bmc.Normal(x**2 / 20, 1.0))
    return dbn, rows_of(dbn, 40, 4), (-60.0, 60.0, 1200)


def heavy_tails() -> Made:
    """A level like that of the Nile, with a vague start, a shift, an outlier and Student's noise."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 38.0), initial=bmc.Normal(0.0, 1e6))
    dbn.add("y", lambda x: bmc.StudentT(3.0, x, 120.0))
    y = 1100 + 120 * np.random.default_rng(2).standard_t(3, 60)
    y[30:] -= 250
    y[50] = -4000
    return dbn, {"y": y}, (-24_000.0, 26_000.0, 3000)


def regimes() -> Made:
    """A finite node beside the number."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.95, 0.05], [0.1, 0.9]], initial=[0.5, 0.5])
    dbn.add("x", lambda x_prev, z: bmc.Normal(0.9 * x_prev, 0.1 + z), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Poisson(np.exp(x)))
    return dbn, rows_of(dbn, 60, 3), (-16.0, 12.0, 800)


def rates() -> Made:
    """A number above a bound, on cells that are even in its logarithm."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x", lambda x_prev: bmc.Gamma(20.0, 20.0 / (0.8 * x_prev + 1)), initial=bmc.Gamma(5.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Poisson(x))
    return dbn, rows_of(dbn, 60), (0.0, 40.0, 2000)


def shares() -> Made:
    """A number between two bounds."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Beta(1 + 20 * x_prev, 1 + 20 * (1 - x_prev)),
        initial=bmc.Uniform(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Binomial(10, x))
    return dbn, rows_of(dbn, 50), (0.0, 1.0, 2000)


MODELS: list[Callable[[], Made]] = [
    from_the_model, with_shifts, missing_rows, volatility, growth, heavy_tails, regimes, rates, shares
]  # fmt: skip


def on(dbn: bmc.DynamicBayesNet, rows: dict[str, Any], grid: Any, **options: Any) -> Any:
    engine = bmc.GridFilter({"x": grid}, tolerance=np.inf)
    return bmc.filter(dbn, rows, engine=engine, keep="summaries", **options)


@pytest.mark.parametrize("make", MODELS)
def test_the_default_is_a_grid_with_its_error(make: Callable[[], Made]) -> None:
    dbn, rows, fine = make()
    found, truth = bmc.filter(dbn, rows), on(dbn, rows, fine)
    assert type(found.engine) is bmc.GridFilter
    error = found.log_marginal_likelihood_mcse
    assert 0 < error <= 0.01
    assert abs(found.log_marginal_likelihood - truth.log_marginal_likelihood) <= error + 1e-9
    np.testing.assert_allclose(found.mean("x"), truth.mean("x"), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(found.std("x"), truth.std("x"), rtol=0.01)


def test_it_says_so() -> None:
    why = bmc.explain(counts(), rows_of(counts(), 20))
    assert "'x' is the one hidden number of a slice" in why.reasons[0]
    assert "give the log evidence to within" in why.reasons[0]
    assert "on a grid of" in why.nodes["x"]


@pytest.mark.parametrize("cells", [24, 32])
def test_too_few_cells_have_an_error_that_holds_and_half_of_it_does_not(cells: int) -> None:
    dbn, rows = counts(), rows_of(counts(), 100, 3)
    truth = on(dbn, rows, (-10.0, 4.0, 2000)).log_marginal_likelihood
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GridWarning)
        found = bmc.filter(dbn, rows, engine=bmc.GridFilter(cells=cells))
    off, error = abs(found.log_marginal_likelihood - truth), found.log_marginal_likelihood_mcse
    assert 0.5 * error < off <= error


def test_an_error_that_is_too_large_is_said() -> None:
    dbn, rows = counts(), rows_of(counts(), 100, 3)
    with pytest.warns(GridWarning, match=r"have an error of .* in the log evidence"):
        bmc.filter(dbn, rows, engine=bmc.GridFilter(cells=24))
    assert np.isnan(on(dbn, rows, (-10.0, 4.0, 100)).log_marginal_likelihood_mcse)


def test_where_no_grid_is_fine_enough_particles_answer_and_explain_says_why() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1e-3), initial=bmc.Normal(0.0, 100.0))
    dbn.add("y", lambda x: bmc.StudentT(3.0, x, 50.0))
    rows = {"y": [1.0, 4.0, 2.0]}
    why = bmc.explain(dbn, rows)
    assert type(why.engine) is bmc.ParticleFilter
    assert "so narrow that this takes more than" in why.refused["GridFilter"]
    with pytest.raises(bmc.errors.UnsupportedError, match="give it one, grid="):
        bmc.filter(dbn, rows, engine=bmc.GridFilter())


def test_plates_inputs_and_time() -> None:
    dbn = bmc.DynamicBayesNet(plates={"s": 3})
    dbn.input("u")
    dbn.add(
        "x",
        lambda x_prev, u, t: bmc.Normal(0.9 * x_prev + 0.3 * u + np.sin(t), 0.3),
        initial=bmc.Normal(0.0, 1.0),
        plates="s",
    )
    dbn.add("y", lambda x: bmc.Poisson(np.exp(x)), plates="s")
    inputs = {"u": np.random.default_rng(0).normal(size=30)}
    rows = {"y": dbn.sample(30, rng=3, inputs=inputs)["y"][0].astype(float)}
    rows["y"][5:15, 2] = np.nan
    rows["y"][20, :2] = 60
    found = bmc.filter(dbn, rows, inputs=inputs)
    truth = on(dbn, rows, (-12.0, 12.0, 800), inputs=inputs)
    assert type(found.engine) is bmc.GridFilter
    error = found.log_marginal_likelihood_mcse
    off = np.abs(found.log_marginal_likelihood - truth.log_marginal_likelihood)
    assert error.shape == (3,)
    assert (off <= error + 1e-9).all() and (error <= 0.01).all()


def test_other_questions_take_it_too() -> None:
    dbn, rows, fine = with_shifts()
    engine = bmc.GridFilter({"x": fine}, tolerance=np.inf)
    rows = {"y": rows["y"][140:170]}
    smoothed = bmc.smooth(dbn, rows)
    truth = bmc.smooth(dbn, rows, engine=engine)
    np.testing.assert_allclose(smoothed.mean("x"), truth.mean("x"), atol=1e-4)
    lagged = bmc.smooth(dbn, rows, lag=2)
    truth = bmc.smooth(dbn, rows, lag=2, engine=engine)
    np.testing.assert_allclose(lagged.mean("x"), truth.mean("x"), atol=1e-4)
    ahead = bmc.forecast(dbn, rows, steps=2)
    truth = bmc.forecast(dbn, rows, steps=2, engine=engine)
    np.testing.assert_allclose(ahead.mean("y"), truth.mean("y"), rtol=1e-4)
    path, best = bmc.most_likely(dbn, rows)["x"], bmc.most_likely(dbn, rows, engine=engine)["x"]
    assert np.abs(path - best).max() < 0.15  # no closer than its cells are wide


# ---- what lands far from the rest ---------------------------------------------------------------


def pieces_that_jump() -> Made:
    """A hundredth of all moves lands at forty, and once one did."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Mixture(
            [0.99, 0.01], [bmc.Normal(0.9 * x_prev, 0.3), bmc.Normal(40, 0.3)]
        ),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn, {"y": np.array([0.1, 0.3, -0.2, 40.2, 36.0, 32.5, 29.0])}, (-10.0, 50.0, 2000)


def an_unlikely_start() -> Made:
    """What the row asks for has a thousandth of the probability."""
    dbn = bmc.DynamicBayesNet()
    initial = bmc.Mixture([0.999, 0.001], [bmc.Normal(0, 1), bmc.Normal(40, 1)])
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.3), initial=initial)
    dbn.add("y", lambda x: bmc.Normal(x, 8.0))
    return dbn, {"y": np.array([40.0])}, (-15.0, 60.0, 2000)


def a_start_that_is_only_known_by_draws() -> Made:
    """The same, as a density of the user's."""

    def log_density(x: np.ndarray) -> np.ndarray:
        peaks = np.log(0.999) - x**2 / 2, np.log(0.001) - (x - 40) ** 2 / 2
        return np.logaddexp(*peaks) - np.log(2 * np.pi) / 2

    def sample(rng: np.random.Generator, shape: Any) -> np.ndarray:
        return np.where(rng.random(shape) < 0.001, 40.0, 0.0) + rng.normal(size=shape)

    dbn = bmc.DynamicBayesNet()
    initial = bmc.Density(log_density, sample=sample)
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.3), initial=initial)
    dbn.add("y", lambda x: bmc.Normal(x, 8.0))
    return dbn, {"y": np.array([40.0])}, (-15.0, 60.0, 2000)


def a_state_that_lands_far_off() -> Made:
    """A finite node says where the number lands."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.999, 0.001], [0.5, 0.5]], initial=[1.0, 0.0])
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(np.where(z == 1, -60.0, 0.9 * x_prev), 0.3),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.StudentT(3.0, x, 1.0))
    return dbn, {"y": np.array([0.5, 0.1, -61.0, -60.0, 0.1])}, (-70.0, 10.0, 2000)


def counts_that_jump() -> Made:
    """Whole numbers, some of them hundreds."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Mixture(
            [0.98, 0.02], [bmc.Poisson(1 + 0.5 * x_prev), bmc.Poisson(300.0)]
        ),
        initial=bmc.Poisson(2.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 2.0))
    return dbn, {"y": np.array([2.0, 3.0, 297.0, 150.0])}, np.arange(600)


FAR: list[Callable[[], Made]] = [
    pieces_that_jump, an_unlikely_start, a_start_that_is_only_known_by_draws, a_state_that_lands_far_off,
    counts_that_jump,
]  # fmt: skip


@pytest.mark.parametrize("make", FAR)
def test_what_lands_far_from_the_rest_is_on_the_grid(make: Callable[[], Made]) -> None:
    dbn, rows, fine = make()
    found, truth = bmc.filter(dbn, rows), on(dbn, rows, fine)
    assert type(found.engine) is bmc.GridFilter
    error = found.log_marginal_likelihood_mcse
    assert error <= 0.01
    assert abs(found.log_marginal_likelihood - truth.log_marginal_likelihood) <= error + 1e-6
    np.testing.assert_allclose(found.mean("x"), truth.mean("x"), rtol=1e-3, atol=1e-3)
    smoothed = bmc.smooth(dbn, rows)
    truth = bmc.smooth(dbn, rows, engine=bmc.GridFilter({"x": fine}, tolerance=np.inf))
    np.testing.assert_allclose(smoothed.mean("x"), truth.mean("x"), rtol=1e-3, atol=1e-3)


def test_a_function_that_jumps_from_beyond_the_ends_has_an_error_that_holds() -> None:
    """No cell ends where it jumps, so the error is large, and is said; particles are off by dozens."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Normal(np.where(x_prev > 3.5, 60.0, 0.9 * x_prev), 0.3),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.StudentT(3.0, x, 1.0))
    for y in ([0.1, 0.3, 1.2, 2.5, 60.2, 60.0, 60.0], [0.1, 0.3, 3.2, 60.0, 54.0, 48.0]):
        with pytest.warns(GridWarning, match="have an error of .* lands far from the rest"):
            found = bmc.filter(dbn, {"y": y})
        # cells that end at 3.5
        truth = on(dbn, {"y": np.array(y)}, (-10.0, 80.0, 2000)).log_marginal_likelihood
        error = found.log_marginal_likelihood_mcse
        assert type(found.engine) is bmc.GridFilter and error <= 0.25
        assert abs(found.log_marginal_likelihood - truth) <= error


def test_what_cannot_be_covered_is_left_to_particles() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Mixture([0.99, 0.01], [bmc.Normal(x_prev, 0.3), bmc.Normal(1e6, 0.3)]),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    why = bmc.explain(dbn, {"y": [0.0, 0.1, 0.3]})
    assert type(why.engine) is bmc.ParticleFilter
    assert "takes more than" in why.refused["GridFilter"]


def test_a_mistake_in_a_function_is_raised() -> None:
    dbn = bmc.DynamicBayesNet()

    @dbn.node(initial=bmc.Normal(0.0, 1.0))
    def x(x_prev):
        if np.size(x_prev) > 100:  # as on the cells of a grid
            raise KeyError("no such column")
        return bmc.Normal(0.9 * x_prev, 0.3)

    dbn.add("y", lambda x: bmc.StudentT(3.0, x, 1.0))
    with pytest.raises(Exception, match="no such column"):
        bmc.filter(dbn, {"y": [0.0, 0.1]})


@pytest.mark.thorough
def test_the_log_evidence_of_many_series_is_within_its_error() -> None:
    """Three thousand rows, as reported; of data from the model and with a shift."""
    for seed in range(10):
        rows = rows_of(counts(), 3000, seed)
        rows["y"][1000 : 1000 + 100 * (seed % 3)] = 35
        found = bmc.filter(counts(), rows)
        truth = on(counts(), rows, (-14.0, 7.0, 1200))
        off = abs(found.log_marginal_likelihood - truth.log_marginal_likelihood)
        assert off <= found.log_marginal_likelihood_mcse + 1e-8
        assert found.log_marginal_likelihood_mcse <= 0.01
