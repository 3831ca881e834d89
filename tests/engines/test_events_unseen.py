"""Events that lie between the points of a quadrature, and functions that fail on arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import bayesmc as bmc
from bayesmc.errors import QueryError

ROWS = {"y": [1.0, 2.0, 3.0, 0.0, 1.0, 2.0]}


def wide(lead: bool = False) -> bmc.DynamicBayesNet:
    """A position known to some metres; with ``lead`` one of each of two plates."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2} if lead else {})
    at = {"plates": ["k"]} if lead else {}
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 5.0), **at)
    dbn.add("y", lambda x: bmc.Normal(x, 5.0), **at)
    return dbn


def truth(found: Any, low: float, high: float) -> np.ndarray:
    m, s = found.mean("x"), found.std("x")
    return np.asarray(norm.cdf(high, m, s) - norm.cdf(low, m, s))


ENGINES = [bmc.KalmanFilter(), bmc.UnscentedKalmanFilter(), bmc.GridFilter()]


@pytest.mark.parametrize("engine", ENGINES, ids=repr)
@pytest.mark.parametrize("call", [bmc.filter, bmc.smooth])
def test_a_band_narrower_than_the_points_are_apart(call: Any, engine: Any) -> None:
    def band(x: Any) -> Any:
        return np.abs(x - 1.2) < 0.02

    found = call(wide(), ROWS, engine=engine, queries={"band": band})
    right = truth(found, 1.18, 1.22)
    np.testing.assert_allclose(found.queries["band"], right, atol=2e-5)
    np.testing.assert_allclose(found.probability(band), right, atol=2e-5)
    assert (found.queries_mcse["band"] == 0).all()


@pytest.mark.parametrize("engine", ENGINES, ids=repr)
@pytest.mark.parametrize("flip", [False, True])
def test_what_no_point_saw_is_known_to_the_resolution(engine: Any, flip: bool) -> None:
    def sliver(x: Any) -> Any:
        return (np.abs(x - 1.2345) < 1e-7) != flip

    asked = {"sliver": sliver, "half": lambda x: x > 0.0, "square": lambda x: x**2}
    found = bmc.filter(wide(), ROWS, engine=engine, queries=asked)
    right = truth(found, 1.2345 - 1e-7, 1.2345 + 1e-7)
    off = np.abs(found.queries["sliver"] - (1 - right if flip else right))
    error = found.queries_mcse["sliver"]
    assert (off <= error).all()
    assert ((error > 1e-4) & (error < 0.01)).all()
    for name in ("half", "square"):
        assert (found.queries_mcse[name] == 0).all()
    assert found.last(2, "filter").queries_mcse["sliver"].shape == (2,)


def test_plates_and_what_is_known_have_errors_of_their_own() -> None:
    rows = {"y": np.column_stack([ROWS["y"], np.full(6, 40.0)])}
    found = bmc.filter(wide(lead=True), rows, queries={"band": lambda x: np.abs(x - 1.2) < 0.02})
    np.testing.assert_allclose(found.queries["band"], truth(found, 1.18, 1.22), atol=2e-5)
    assert found.queries_mcse["band"].shape == (6, 2)
    seen = bmc.filter(
        wide(), {**ROWS, "x": [0.5, *[None] * 5]}, queries={"far": lambda x: x > 30.0}
    )
    assert seen.queries_mcse["far"][0] == 0 and (seen.queries_mcse["far"][1:] > 0).all()


def test_several_numbers_unseen() -> None:
    dbn = wide()
    dbn.add("z", lambda z_prev, x: bmc.Normal(z_prev + 0.1 * x, 1.0), initial=bmc.Normal(0.0, 1.0))

    def both(x: Any, z: Any) -> Any:
        return (np.abs(x - 1.2) < 1e-6) & (z > 0)

    for engine in (None, bmc.GridFilter({"x": (-30, 30, 120), "z": (-15, 15, 60)})):
        found = bmc.filter(dbn, {"y": [1.0, 2.0]}, engine=engine, queries={"both": both})
        assert (found.queries["both"] == 0).all()
        error = found.queries_mcse["both"]
        assert ((error > 1e-6) & (error < 0.25)).all()  # a cell of z is half a standard deviation


FAILING: dict[str, Callable[..., Any]] = {
    "a float": lambda x: float(x),
    "an if": lambda x: 1 if x > 0 else 0,
    "an attribute": lambda x: x.foo,
}


@pytest.mark.parametrize(
    "engine",
    [
        None,
        bmc.ParticleFilter(100),
        bmc.GridFilter({"x": (-30, 30, 99)}),
        bmc.UnscentedKalmanFilter(),
    ],
    ids=repr,
)
@pytest.mark.parametrize("kind", FAILING)
def test_functions_of_single_numbers_are_refused_by_name(kind: str, engine: Any) -> None:
    asked = {"good": lambda x: x, "mine": FAILING[kind]}
    for call in (bmc.filter, bmc.smooth):
        with pytest.raises(
            QueryError, match=r"queries=\{'mine'.*fails on arrays.*np\.where for if"
        ):
            call(wide(), ROWS, engine=engine, queries=asked, rng=0)
    with pytest.raises(QueryError, match=r"queries=\{'mine'.*returns shape \(\)"):
        bmc.filter(wide(), ROWS, engine=engine, queries={"mine": lambda x: x[0]}, rng=0)


def test_functions_of_single_states_are_refused_by_name() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.table("o", ["s"], [[0.8, 0.2], [0.3, 0.7]])
    with pytest.raises(QueryError, match=r"queries=\{'mine'.*fails on arrays"):
        bmc.filter(dbn, {"o": [0, 1]}, queries={"mine": lambda s: 1 if s > 0 else 0})
