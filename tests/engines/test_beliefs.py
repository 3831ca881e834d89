"""Beliefs that are pickled or copied go on as if nothing had happened, or say what they need."""

import copy
import pickle

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError, ModelError, QueryError


def level():
    """A level under two sensors, one of which drops out, and an input."""
    dbn, noise = bmc.DynamicBayesNet(plates={"sensor": ["left", "right"]}), 0.5
    dbn.input("u")
    dbn.add("x", lambda x_prev, u: bmc.Normal(0.9 * x_prev + u, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, noise), plates="sensor")
    dbn.add("step", lambda x, x_prev: bmc.Normal(x - x_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    return dbn, [{"y": [1.0, np.nan]}, {"y": [0.5, 1.5], "step": 0.1}, {"y": [2.0, 1.0]}]


def regimes():
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.table("x", ["x_prev"], [[0.7, 0.3], [0.3, 0.7]], ("no", "yes"), initial=[0.5, 0.5])
    dbn.add("y", lambda x, u: bmc.Normal(u + np.where(x == "yes", 1.0, 0.0), 1.0))
    dbn.add(
        "same", lambda x, x_prev: bmc.Bernoulli(np.where(x == x_prev, 0.3, 0.6)),
        initial=bmc.Bernoulli(0.5),
    )  # fmt: skip
    return dbn, [{"y": 0.5}, {"y": 1.5, "same": 1}, {"y": 0.0}]


LOST = bmc.Recovery({"x": lambda: bmc.Normal(0.0, 2.0)}, slow=0.05, fast=0.5)
FILTERS = {
    "kalman": (bmc.KalmanFilter(), level),
    "extended": (bmc.ExtendedKalmanFilter(), level),
    "unscented": (bmc.UnscentedKalmanFilter(), level),
    "particles": (bmc.ParticleFilter(200), level),
    "optimal": (bmc.ParticleFilter(200, proposal="optimal"), level),
    "kld": (bmc.ParticleFilter(2000, adapt=bmc.KLD({"x": 0.5})), level),
    "recovery": (bmc.ParticleFilter(200, recovery=LOST), level),
    "finite particles": (bmc.ParticleFilter(200), regimes),
    "grid": (bmc.GridFilter({"x": (-6.0, 6.0, 60)}), level),
    "finite grid": (bmc.GridFilter(), regimes),
    "discrete": (bmc.DiscreteFilter(), regimes),
}


def run(engine, dbn, rows, interrupt=None, after=()):
    """All beliefs; after some of the slices the belief goes through ``interrupt``."""
    belief, found = engine.start(dbn, rng=3), []
    for k, row in enumerate([None, *rows]):
        if row is not None:
            belief = engine.step(belief, row, inputs={"u": 0.1 * k})
            found.append(belief)
        if k in after:
            belief = interrupt(belief)
    return found


def same(one, other):
    assert one.t == other.t
    assert np.array_equal(one.log_marginal_likelihood, other.log_marginal_likelihood)
    assert one.names == other.names
    for name in one.names:
        finite = one.slices.first[name].domain is not None
        for ask in ("probabilities",) if finite else ("mean", "var"):
            assert np.array_equal(getattr(one, ask)(name), getattr(other, ask)(name)), name


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("after", [(0,), (1,), (2, 3)])
def test_belief_of_a_pickle_goes_on_given_the_template_again(name, after):
    engine, model = FILTERS[name]
    dbn, rows = model()

    def travel(belief):
        back = pickle.loads(pickle.dumps(belief))
        if belief.t >= 0:
            same(back, belief)
        with pytest.raises(
            ModelError, match=r"loaded or unpickled.*engine\.start\(dbn, belief=belief\)"
        ):
            engine.step(back, rows[0], inputs={"u": 0.0})
        again = pickle.loads(pickle.dumps(back))
        return engine.start(model()[0], belief=again)

    for one, other in zip(
        run(engine, dbn, rows), run(engine, dbn, rows, travel, after), strict=True
    ):
        same(one, other)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy])
def test_copies_go_on_as_they_are(name, copied):
    engine, model = FILTERS[name]
    dbn, rows = model()
    there = run(engine, dbn, rows, copied, (0, 1, 2))
    for one, other in zip(run(engine, dbn, rows), there, strict=True):
        same(one, other)


def test_tables_alone_travel_whole():
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.table("y", ["x"], [[0.8, 0.2], [0.1, 0.9]])
    engine = bmc.DiscreteFilter()
    belief = engine.step(engine.start(dbn), {"y": 1})
    back = pickle.loads(pickle.dumps(belief))
    same(engine.step(back, {"y": 0}), engine.step(belief, {"y": 0}))


def walk(plates=None, states=("a", "b"), parent="w", table=((0.7, 0.3), (0.3, 0.7)), more=()):
    dbn = bmc.DynamicBayesNet(plates=plates)
    dbn.table("x", ["x_prev"], table, states, initial=[0.5, 0.5])
    for name in ("v", "w", *more):
        dbn.add(name, bmc.Bernoulli(0.5))
    dbn.add("y", lambda z: bmc.Normal(1.0 * z, 1.0), parents=[parent])
    return dbn


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"plates": {"p": 2}}, "its plates are none, not 'p'"),
        ({"states": ("a", "c")}, r"list of states of 'x' is \['a', 'b'\], not \['a', 'c'\]"),
        ({"parent": "v"}, r"list of parents of 'y' is \['w'\], not \['v'\]"),
        ({"table": ((0.6, 0.4), (0.3, 0.7))}, "the table of 'x' is"),
        ({"more": "u"}, "its nodes are 'x', 'v', 'w', 'y', not 'x', 'v', 'w', 'u', 'y'"),
    ],
)
def test_belief_about_another_template(other, words):
    engine = bmc.ParticleFilter(50)
    belief = pickle.loads(pickle.dumps(engine.step(engine.start(walk(), rng=0), {"y": 0.3})))
    with pytest.raises(ModelError, match=f"another template.*{words}"):
        engine.start(walk(**other), belief=belief)
    assert engine.start(walk(), belief=belief).t == 0


def test_other_engines_and_arguments():
    dbn, rows = level()
    belief = run(bmc.ParticleFilter(50), dbn, rows)[-1]
    with pytest.raises(ValueError, match=r"ParticleFilter\(100\).*the belief has 50 particles"):
        bmc.ParticleFilter(100).start(dbn, belief=belief)
    with pytest.raises(TypeError, match="KalmanFilter.*start: the belief is a ParticleBelief"):
        bmc.KalmanFilter().start(dbn, belief=belief)
    with pytest.raises(ValueError, match="leave static= and rng= out"):
        bmc.ParticleFilter(50).start(dbn, belief=belief, rng=1)
    coarse, fine = (bmc.GridFilter({"x": (-6.0, 6.0, n)}) for n in (40, 60))
    belief = run(coarse, dbn, rows)[-1]
    with pytest.raises(ValueError, match="another grid"):
        fine.start(dbn, belief=belief)
    with pytest.raises(QueryError, match="loaded or unpickled"):
        pickle.loads(pickle.dumps(belief)).expectation(lambda x: x**2)


def test_static_values_and_plates_filtered_apart():
    dbn = bmc.DynamicBayesNet(plates={"track": 3})
    dbn.add_static("scale", bmc.Gamma(2.0, 2.0))
    dbn.add(
        "x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0), plates="track"
    )
    dbn.add("y", lambda x, scale: bmc.Normal(x, scale), plates="track")
    rows = {"y": [0.3, np.nan, 1.0]}
    for engine in (bmc.KalmanFilter(), bmc.ParticleFilter(100), bmc.GridFilter({"x": (-5, 5, 40)})):
        belief = engine.step(engine.start(dbn, static={"scale": 0.7}, rng=0), rows)
        back = engine.start(dbn, belief=pickle.loads(pickle.dumps(belief)))
        same(engine.step(back, rows), engine.step(belief, rows))
        with pytest.raises((ModelError, EvidenceError)):
            engine.start(level()[0], belief=back)


def test_copies_of_posteriors_keep_their_functions():
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0))
    posterior = bmc.infer(net, {"b": 1.0}, engine=bmc.Gibbs(500, 100, 2), rng=0)
    for copied in (copy.copy, copy.deepcopy):
        same_draws = copied(posterior).predict("b", rng=1)["b"]
        assert np.array_equal(same_draws, posterior.predict("b", rng=1)["b"])
    dbn = bmc.DynamicBayesNet()
    dbn.table("x", ["x_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.table("y", ["x"], [[0.8, 0.2], [0.1, 0.9]])
    smoothed = bmc.smooth(dbn, {"y": [1, 0, 1]})
    assert np.array_equal(copy.deepcopy(smoothed).pairs("x"), smoothed.pairs("x"))


@pytest.mark.parametrize(
    "engine",
    [bmc.KalmanFilter(), bmc.GridFilter({"x": (-8, 8, 200)}), bmc.ParticleFilter(50)],
    ids=lambda e: type(e).__name__,
)
def test_deep_copies_of_series_have_arrays_of_their_own(engine):
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    asked = {"up": lambda x: x > 0}
    keep = {"keep": "particles"} if isinstance(engine, bmc.ParticleFilter) else {}
    found = bmc.filter(dbn, {"y": [0.3, 1.0]}, engine=engine, queries=asked, rng=0, **keep)
    before = [found.mean("x"), found.queries["up"].copy(), found.log_marginal_increments.copy()]
    other = copy.deepcopy(found)
    assert other.model is found.model and other.engine is found.engine
    other.queries["up"][:] = 7.0
    other.queries["more"] = other.log_marginal_increments
    other.log_marginal_increments[:] = 7.0
    for cloud in getattr(other, "clouds", None) or ():
        cloud.values["x"][...] = 7.0
    after = [found.mean("x"), found.queries["up"], found.log_marginal_increments]
    for one, two in zip(before, after, strict=True):
        assert np.array_equal(one, two)
    assert list(found.queries) == ["up"]
    if hasattr(found, "expectation") and (keep or not isinstance(engine, bmc.ParticleFilter)):
        assert (found.expectation(lambda x: x) != 7.0).all()
        again = copy.deepcopy(found).expectation(lambda x: x)
        assert np.array_equal(again, found.expectation(lambda x: x))
