"""Which engine answers which question over time, and what its answers can be asked afterwards."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc


def linear() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def curved() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def turning() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.VonMises(x_prev, 4.0), initial=bmc.VonMises(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(np.sin(x), 0.3))
    return dbn


def switching() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add("y", lambda z: bmc.Normal(2.0 * z, 1.0))
    return dbn


def lagged() -> bmc.DynamicBayesNet:
    """Two hidden numbers a slice."""
    dbn = curved()
    dbn.add(
        "w", lambda x_prev, w_prev: bmc.Normal(np.cos(x_prev), 1.0), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("v", lambda x, w: bmc.Normal(x * w, 0.5))
    return dbn


Y = {"y": [0.4, 1.1, -0.3]}


@pytest.mark.parametrize(
    ("make", "question", "engine"),
    [
        (linear, "filter", "KalmanFilter"),
        (linear, "most_likely", "KalmanFilter"),
        (curved, "filter", "GridFilter"),
        (curved, "smooth", "GridFilter"),
        (curved, "most_likely", "GridFilter"),
        (turning, "forecast", "GridFilter"),
        (lagged, "filter", "ParticleFilter"),
        (turning, "most_likely", "GridFilter"),
        (switching, "most_likely", "DiscreteFilter"),
    ],
)
def test_the_engine_fits_the_question(make: Any, question: str, engine: str, capsys: Any) -> None:
    found = bmc.explain(make(), Y, question=question)
    assert type(found.engine).__name__ == engine
    assert f"engine: {engine}" in capsys.readouterr().out


def test_what_is_asked_besides_is_taken_into_account() -> None:
    for make in (linear, curved):
        with pytest.warns(bmc.errors.EngineWarning, match="keep='particles' has ParticleFilter"):
            kept = bmc.filter(make(), Y, keep="particles", rng=0)
        assert type(kept.engine).__name__ == "ParticleFilter"
        said = bmc.explain(make(), Y, keep="particles").reasons
        assert any("keep='particles' has ParticleFilter answer where" in why for why in said)
    bmc.filter(lagged(), Y, keep="particles", rng=0)  # which particles answer anyway: no warning
    assert bmc.most_likely(turning(), Y)["x"].shape == (3,)
    with pytest.raises(
        bmc.errors.UnsupportedError, match=r"most_likely: no engine.*give it a grid"
    ):
        bmc.most_likely(lagged(), Y)
    with pytest.raises(ValueError, match="'most_likely'"):
        bmc.explain(linear(), Y, question="viterbi")


ENGINES: dict[str, tuple[Any, Any]] = {
    "kalman": (linear, bmc.KalmanFilter()),
    "extended": (linear, bmc.ExtendedKalmanFilter()),
    "unscented": (linear, bmc.UnscentedKalmanFilter()),
    "particles": (
        linear,
        bmc.ParticleFilter(
            200,
            proposal={"x": lambda x_prev: bmc.Normal(x_prev, 2.0)},
            auxiliary=lambda x_prev: 0 * x_prev,
        ),
    ),
    "grid": (linear, bmc.GridFilter({"x": (-6.0, 6.0, 60)})),
    "discrete": (switching, bmc.DiscreteFilter()),
}


@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize("question", ["filter", "smooth"])
def test_answers_over_time_travel_without_functions(name: str, question: str) -> None:
    make, engine = ENGINES[name]
    found = getattr(bmc, question)(make(), Y, engine=engine, rng=0)
    again = pickle.loads(pickle.dumps(found))
    node = found.names[0]
    np.testing.assert_array_equal(again.mean(node), found.mean(node))
    assert repr(again) == repr(found)
    if hasattr(found, "cov") and name != "particles":
        np.testing.assert_array_equal(again.cov(node), found.cov(node))
    if name == "discrete":
        assert found.pairs(node).shape == (2, 2, 2)
        with pytest.raises(bmc.errors.QueryError, match="pickle"):
            again.pairs(node)
    if name == "particles":
        with pytest.raises(bmc.errors.UnsupportedError, match="hold no functions"):
            bmc.filter(make(), Y, engine=again.engine)


def test_particles_that_were_kept_answer_more() -> None:
    engine = bmc.ParticleFilter(40_000)
    found = bmc.filter(linear(), Y, engine=engine, rng=0, keep="particles")
    exact = bmc.filter(linear(), Y, engine=bmc.KalmanFilter())
    mean, std = exact.mean("x"), exact.std("x")
    # 40,000 particles: standard errors below .01; ten comparisons, alpha 1e-6
    np.testing.assert_allclose(found.quantile("x", 0.9), mean + 1.28155 * std, atol=0.05)
    np.testing.assert_allclose(found.cov("x"), std**2, atol=0.02)
    np.testing.assert_allclose(found.expectation(lambda x: x**2), mean**2 + std**2, atol=0.05)
    assert found.quantile("x", [[0.1], [0.9]]).shape == (3, 2, 1)
    share = found.probability(lambda x: x > 0)
    assert ((share > 0) & (share < 1)).all()
    with pytest.raises(bmc.errors.QueryError, match="not booleans"):
        found.probability(lambda x: x)
    with pytest.raises(ValueError, match="between 0 and 1"):
        found.quantile("x", 1.5)
    bare = bmc.filter(linear(), Y, engine=engine, rng=0)
    with pytest.raises(bmc.errors.UnsupportedError, match="keep="):
        bare.quantile("x", 0.5)


def test_a_belief_of_plates_apart_has_quantiles_of_each() -> None:
    dbn = bmc.DynamicBayesNet(plates={"a": 2, "b": 3})
    plates = ("b", "a")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=bmc.Normal(0, 5.0), plates=plates)
    dbn.add("y", lambda x: bmc.Normal(x, 0.01), plates=plates)
    engine = bmc.ParticleFilter(20_000)
    rows = np.arange(6.0).reshape(3, 2)
    belief = engine.step(engine.start(dbn, rng=0), {"y": rows})
    np.testing.assert_allclose(belief.quantile("x", 0.5), rows, atol=0.02)
    with pytest.raises(bmc.errors.QueryError, match="filtered separately"):
        belief.cov("x")
