"""What is asked of a slice in vain: refusals name the node, the fault and a way that works."""

import pickle

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError, QueryError, UnsupportedError
from tests.engines.test_marginal_tables import ring

ENGINES = [bmc.DiscreteFilter(), bmc.ParticleFilter(50), bmc.ParticleFilter(50, marginalize="auto")]


def two_chains():
    dbn = bmc.DynamicBayesNet()
    dbn.table("a", ["a_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    table = [[0.9, 0.1], [0.2, 0.8]]
    dbn.table("b", ["b_prev"], table, initial=[0.5, 0.5], states=("low", "high"))
    dbn.add("y", lambda a, b: bmc.Normal(a + 1.0 * (b == "high"), 1.0))
    return dbn


@pytest.mark.parametrize("engine", ENGINES, ids=repr)
def test_labels_have_no_quantiles_and_tables_are_of_single_nodes(engine):
    dbn = two_chains()
    found = bmc.filter(dbn, {"y": [0.0, 1.0]}, engine=engine, rng=0)
    belief = engine.step(engine.start(dbn, rng=0), {"y": 1.0})
    for answers, way in ((found, "queries="), (belief, "expectation")):
        with pytest.raises(QueryError, match=r"'b' has labels, which have no quantile; use prob"):
            answers.quantile("b", 0.5)
        with pytest.raises(QueryError, match=r"'b' has labels, which have no variance"):
            answers.var("b")
        with pytest.raises(QueryError, match=rf"probabilities\('a', 'b'\): .*{way}.*lambda a, b: "):
            answers.probabilities("a", "b")
    # the way that it names
    assert 0 < belief.expectation(lambda a, b: (a == 1) & (b == "high")) < 1


def pushed():
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.static(lambda: bmc.Normal(0.0, 1.0), name="s")
    dbn.add("x", lambda x_prev, u, s: bmc.Normal(x_prev + u * s, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


@pytest.mark.parametrize(
    ("row", "inputs", "told"),
    [
        ({"y": 1.0}, None, r"input 'u' has no value in this slice; give step\(..., inputs=\{'u': "),
        ({"y": 1.0}, {"u": None}, "input 'u' has no value in this slice"),
        ({"y": 1.0}, {"u": [1.0, 2.0]}, r"input 'u' has shape \(2,\), but its plates"),
        ({"y": 1.0}, {"u": np.nan}, r"input 'u' is nan at index \(\)"),
        ({"y": 1.0, "s": 1.0}, {"u": 1.0}, r"'s' in one slice, .* static; .* start\(dbn, static="),
    ],
)
def test_rows_speak_of_one_slice(row, inputs, told):
    engine = bmc.KalmanFilter()
    belief = engine.start(pushed(), static={"s": 1.0})
    for _ in range(2):  # the first row is read with what it says of sizes, later ones are not
        with pytest.raises(EvidenceError, match=told):
            engine.step(belief, row, inputs=inputs)
        belief = engine.step(belief, {"y": 0.5}, inputs={"u": 1.0})


def test_static_nodes():
    engine = bmc.ParticleFilter(50)
    with pytest.raises(EvidenceError, match=r"static= is a list; give a dict"):
        engine.start(pushed(), static=[1.0])
    with pytest.raises(EvidenceError, match=r"'s' has no value; give start\(dbn, static=\{'s': "):
        engine.step(engine.start(pushed()), {"y": 1.0}, inputs={"u": 1.0})
    belief = engine.step(engine.start(pushed(), static={"s": 1.0}), {"y": 1.0}, inputs={"u": 1.0})
    for name in ("s", "u"):
        with pytest.raises(QueryError, match=f"'{name}' is an input or static"):
            belief.mean(name)


def fed_back():
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "m",
        lambda y_prev: bmc.Bernoulli(np.where(y_prev > 0.5, 0.8, 0.3)),
        initial=bmc.Bernoulli(0.5),
    )
    dbn.add("x", lambda x_prev, m: bmc.Normal(0.9 * x_prev + m, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.3))
    return dbn


def test_steps_go_on_where_what_all_rests_on_is_missing():
    """As ``filter`` answers, which knows of the gap beforehand: 5 standard errors, alarms below 1e-5."""
    rows = [0.1, 0.7, 1.4, None, 1.9, None, None, 2.2]
    seen = {"y": [np.nan if row is None else row for row in rows]}
    engine = bmc.ParticleFilter(4000, marginalize="auto")
    whole = bmc.filter(fed_back(), seen, engine=engine, rng=1)
    belief = engine.start(fed_back(), rng=0)
    for t, row in enumerate(rows):
        belief = engine.step(belief, {"y": row})
        if t == 2:
            assert belief.now.inner is not None
        if t == 4:  # it travels, too
            belief = engine.start(fed_back(), belief=pickle.loads(pickle.dumps(belief)))
    both = np.hypot(belief.log_marginal_likelihood_mcse, whole.log_marginal_likelihood_mcse)
    assert abs(belief.log_marginal_likelihood - whole.log_marginal_likelihood) < 5 * both < 0.6
    both = np.hypot(belief.mcse("x"), whole.mcse("x")[-1])
    assert abs(belief.mean("x") - whole.mean("x")[-1]) < 5 * both < 0.1


def test_late_answers_need_what_was_integrated_out():
    engine = bmc.ParticleFilter(50, marginalize="auto", delay=1)
    belief = engine.start(fed_back(), rng=0)
    for row in (0.1, None):
        belief = engine.step(belief, {"y": row})
    told = "'y' is missing in the slice before, and 'm', which is sampled, .*leave delay= out"
    with pytest.raises(UnsupportedError, match=told):
        engine.step(belief, {"y": 0.3})


def test_engines_that_cannot_help_are_told_to():
    """Many cells, one of which is read: no factor over all of them fits."""
    told = r"of these BoyenKoller\(\) and FactoredFrontier\(\) cannot answer here, either"
    with pytest.raises(UnsupportedError, match=told):
        bmc.filter(ring(40, 0.1), {"reading": [1, 0]}, engine=bmc.DiscreteFilter())
