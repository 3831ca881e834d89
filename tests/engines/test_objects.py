"""Nodes of objects: particles carry them along and share them; what needs numbers refuses by name."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BroadcastError, ModelError, QueryError, UnsupportedError


class Seen(bmc.FrozenObject):
    """All numbers that a particle has met."""

    def __init__(self, values: tuple[float, ...] = ()) -> None:
        self.values = values

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Seen) and self.values == other.values

    __hash__ = None  # type: ignore[assignment]


grown = np.frompyfunc(lambda seen, x: Seen((*seen.values, float(x))), 2, 1)
total = np.frompyfunc(lambda seen: sum(seen.values), 1, 1)


def sums(seen):
    return np.asarray(total(seen), dtype=float)


def template() -> bmc.DynamicBayesNet:
    """A walk; the reading is of the mean of all that was before, told by the object."""
    dbn = bmc.DynamicBayesNet("history")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("seen", lambda seen_prev, x: grown(seen_prev, x), initial=lambda x: grown(Seen(), x))
    dbn.add("y", lambda seen: bmc.Normal(sums(seen), 1.0))
    return dbn


def by_numbers() -> bmc.DynamicBayesNet:
    """The same with the sum as a number."""
    dbn = bmc.DynamicBayesNet("history")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("sum", lambda sum_prev, x: sum_prev + x, initial=lambda x: 1.0 * x)
    dbn.add("y", lambda sum: bmc.Normal(sum, 1.0))
    return dbn


ROWS = {"y": [0.5, 1.1, 2.7, 1.9, 4.2, 5.0]}


@pytest.mark.parametrize("options", [{}, {"ess_threshold": 1.0}, {"ess_threshold": 0.0}])
def test_objects_say_what_numbers_say(options) -> None:
    """The same draws, so the same answers: objects follow their particles through every resampling."""
    engine = bmc.ParticleFilter(500, compiled=False, **options)
    held = bmc.filter(
        template(), ROWS, engine=engine, rng=1, queries={"sum": lambda seen: sums(seen)}
    )
    known = bmc.filter(by_numbers(), ROWS, engine=engine, rng=1)
    np.testing.assert_allclose(held.mean("x"), known.mean("x"), rtol=1e-9)
    np.testing.assert_allclose(held.queries["sum"], known.mean("sum"), rtol=1e-9)
    assert held.log_marginal_likelihood == pytest.approx(known.log_marginal_likelihood, rel=1e-9)


def test_many_particles_in_blocks() -> None:
    engine = bmc.ParticleFilter(13_000, compiled=False, ess_threshold=1.0)
    rows = {"y": ROWS["y"][:3]}
    held = bmc.filter(template(), rows, engine=engine, rng=1).mean("x")
    known = bmc.filter(by_numbers(), rows, engine=engine, rng=1).mean("x")
    np.testing.assert_allclose(held, known, rtol=1e-9)


def test_a_belief_hands_them_out_and_pickles() -> None:
    engine = bmc.ParticleFilter(50)
    belief = engine.start(template(), rng=0)
    for y in ROWS["y"]:
        belief = engine.step(belief, {"y": y})
    objects = belief.particles("seen")
    assert objects.shape == (50,)
    assert {len(s.values) for s in objects} == {6}
    assert [s.values[-1] for s in objects] == belief.particles("x").tolist()
    expected = belief.expectation(lambda seen: sums(seen))
    np.testing.assert_allclose(expected, belief.weights @ sums(objects))
    again = pickle.loads(pickle.dumps(belief))
    assert all(a == b for a, b in zip(again.particles("seen"), objects, strict=True))
    for question in (belief.mean, belief.var, belief.probabilities, belief.mcse):
        with pytest.raises(QueryError, match="'seen' holds objects"):
            question("seen")
    with pytest.raises(QueryError, match="objects"):
        belief.quantile("seen", 0.5)
    with pytest.raises(QueryError, match="objects"):
        belief.cov("x", "seen")


def test_proposals_may_read_them() -> None:
    """A proposal that looks at the object, with p over q: the same evidence, to five errors (1e-6)."""

    def guided(x_prev, seen_prev, y):
        return bmc.Normal(0.5 * (x_prev + y - sums(seen_prev)), 1.0)

    plain, looking = (
        bmc.filter(template(), ROWS, engine=bmc.ParticleFilter(4000, proposal=p), rng=2)
        for p in (None, {"x": guided})
    )
    error = np.hypot(plain.log_marginal_likelihood_mcse, looking.log_marginal_likelihood_mcse)
    assert abs(plain.log_marginal_likelihood - looking.log_marginal_likelihood) < 5 * error


@pytest.mark.parametrize(
    "engine",
    [
        None,
        bmc.ParticleFilter(),
        bmc.KalmanFilter(),
        bmc.GridFilter(),
        bmc.DiscreteFilter(),
        bmc.UnscentedKalmanFilter(),
        bmc.ParticleFilter(50, proposal="optimal"),
        bmc.ParticleFilter(50, auxiliary=True),
        bmc.ParticleFilter(50, marginalize="auto"),
        bmc.ParticleFilter(50, delay=2),
        bmc.ParticleFilter(50, recovery=bmc.Recovery({"x": bmc.Normal(0.0, 1.0)}, share=0.1)),
    ],
)
def test_what_needs_numbers_refuses_by_name(engine) -> None:
    with pytest.raises(UnsupportedError, match="seen"):
        bmc.filter(template(), ROWS, engine=engine, rng=0)


def test_bins_of_objects_are_refused() -> None:
    engine = bmc.ParticleFilter(50, adapt=bmc.KLD({"seen": 0.5}))
    with pytest.raises(ModelError, match="holds objects"):
        bmc.filter(template(), ROWS, engine=engine, rng=0)


def test_questions_about_the_past_are_refused() -> None:
    dbn, engine = template(), bmc.ParticleFilter(50)
    for ask in (
        lambda: bmc.filter(dbn, ROWS, engine=engine, rng=0, keep="particles"),
        lambda: bmc.smooth(dbn, ROWS, engine=engine, rng=0),
        lambda: bmc.smooth(dbn, ROWS, engine=engine, rng=0, lag=2),
        lambda: bmc.most_likely(dbn, ROWS),
    ):
        with pytest.raises(UnsupportedError):
            ask()
    with pytest.raises(QueryError, match="'seen' holds objects"):
        bmc.filter(dbn, ROWS, engine=engine, rng=0).mean("seen")


def test_plain_nets_refuse_them() -> None:
    with pytest.raises(UnsupportedError, match="DynamicBayesNet"):
        bmc.infer(template().unroll(2), {})
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("seen", lambda x: grown(Seen(), x))
    with pytest.raises(UnsupportedError, match="node 'seen' holds objects"):
        net.sample(3)


def test_other_objects_and_other_faults_are_refused() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("seen", lambda x: np.frompyfunc(str, 1, 1)(x))
    with pytest.raises(ModelError, match="return a distribution"):
        dbn.validate()
    mixed = bmc.DynamicBayesNet()
    mixed.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    mixed.add("seen", lambda x: grown(Seen(), x), initial=lambda x: 2.0 * x)
    with pytest.raises(ModelError, match="initial= gives"):
        mixed.validate()
    whole = bmc.DynamicBayesNet()
    whole.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    whole.add("seen", lambda x: grown(Seen(), np.broadcast_to(np.mean(x), np.shape(x))))
    with pytest.raises(BroadcastError):
        whole.validate()
