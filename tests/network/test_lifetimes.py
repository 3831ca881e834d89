"""What a net and its posteriors hold: nothing of the user's, nothing beyond their lives, no state left on."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.forward import fast_steps
from bayesmc.engines.weighted.drawing import passes
from bayesmc.errors import ParameterError
from bayesmc.network import pose
from bayesmc.randomness import seed_sequence
from bayesmc.results import sums

ENGINES = [bmc.Exact(), bmc.LikelihoodWeighting(500), None]
IDS = ["exact", "weighting", "chosen"]


def alive(reference: weakref.ref) -> bool:
    gc.collect()
    return reference() is not None


# ---- models and plans are freed -----------------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES, ids=IDS)
@pytest.mark.parametrize("observed", [False, True], ids=["no evidence", "evidence"])
def test_a_model_lives_as_long_as_its_net_and_posteriors(engine, observed: bool) -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3))
    net.add("b", lambda a: bmc.Bernoulli(0.2 + 0.5 * a))
    evidence = {"b": 1} if observed else {}
    model = weakref.ref(net.model())
    posterior = bmc.infer(net, evidence, engine=engine, rng=0)
    bmc.explain(net, evidence)
    del net
    assert alive(model)  # the posterior's snapshot
    assert posterior.mean("a").shape == ()
    del posterior
    assert not alive(model)


@pytest.mark.parametrize("engine", ENGINES, ids=IDS)
def test_models_of_other_inputs_are_not_hoarded(engine) -> None:
    net = bmc.BayesNet()
    net.input("u")
    net.add("a", lambda u: bmc.Bernoulli(u))
    models = []
    for u in np.linspace(0.1, 0.9, 40):
        posterior = bmc.infer(net, inputs={"u": u}, engine=engine, rng=0)
        models.append(weakref.ref(posterior.model))
    del posterior
    gc.collect()
    assert sum(m() is not None for m in models) <= 10
    assert models[-1]() is not None  # a few are kept, so that asking again is cheap


def test_a_changed_net_lets_go_of_what_it_was() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3))
    model = weakref.ref(net.model())
    bmc.infer(net)
    net.add("a", bmc.Bernoulli(0.6), replace=True)
    assert not alive(model)
    assert bmc.infer(net).mean("a") == pytest.approx(0.6)


# ---- the user's arrays --------------------------------------------------------------------------


def test_changing_the_arrays_of_a_distribution_does_not_reach_the_net() -> None:
    loc, probs, table = np.zeros(3), np.array([0.3, 0.7]), np.array([0.2, 0.8])
    cov = np.eye(2)
    net = bmc.BayesNet(plates={"p": 3})
    net.add("x", bmc.Normal(loc, 1.0), plates="p")
    net.add("a", bmc.Categorical(probs))
    net.add("v", bmc.MvNormal(np.zeros(2), cov))
    net.table("t", probs=table)
    early = bmc.infer(net, engine=bmc.LikelihoodWeighting(500), rng=0)
    for array, value in ((loc, 100.0), (probs, 0.5), (table, 0.5), (cov, 9.0)):
        array[...] = value
    late = bmc.infer(net, engine=bmc.LikelihoodWeighting(500), rng=0)
    for name in ("x", "a", "v", "t"):
        np.testing.assert_array_equal(early[name], late[name])
    exact = bmc.infer(net, {"x": np.zeros(3), "v": np.zeros(2)}, engine=bmc.Exact())
    np.testing.assert_allclose(exact.probabilities("a"), [0.3, 0.7])
    np.testing.assert_allclose(exact.probabilities("t"), [0.2, 0.8])
    assert np.abs(early.predict("x", rng=1)["x"]).max() < 10  # the snapshot, drawn from again


def test_one_buffer_for_many_nodes_leaves_each_its_own_numbers() -> None:
    net, buffer = bmc.BayesNet(), np.empty(2)
    for i, p in enumerate((0.1, 0.4, 0.8)):
        buffer[:] = 1 - p, p
        net.add(f"a{i}", bmc.Categorical(buffer))
    buffer[:] = -5.0
    p = bmc.infer(net, engine=bmc.Exact())
    assert [round(float(p.mean(f"a{i}")), 6) for i in range(3)] == [0.1, 0.4, 0.8]


def test_the_users_arrays_stay_writable_and_unchanged() -> None:
    loc, data = np.zeros(3), np.array([1.0, np.nan, 2.0])
    net = bmc.BayesNet(plates={"p": 3})
    net.add("x", bmc.Normal(loc, 1.0), plates="p")
    p = bmc.infer(net, {"x": data}, engine=bmc.LikelihoodWeighting(100), rng=0)
    assert loc.flags.writeable and data.flags.writeable and np.isnan(data[1])
    draws = p["x"]
    before = p.mean("x").copy()
    draws[:] = 50.0
    data[:] = 50.0
    np.testing.assert_array_equal(p.mean("x"), before)


# ---- interrupts ---------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_interrupt_leaves_no_check_switched_off(monkeypatch, error) -> None:
    """The consumer of the chunks fails, and its traceback is held, as an interactive shell does."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    before = np.geterr()

    def fail(self, *args):
        raise error

    monkeypatch.setattr(sums.Sums, "add", fail)
    with pytest.raises(error) as held:
        bmc.infer(net, engine=bmc.LikelihoodWeighting(1000), rng=0, keep="summaries")
    assert held.tb is not None  # alive, and with it the suspended loop over chunks
    with pytest.raises(ParameterError, match="scale must be positive"):
        bmc.Normal(0.0, -1.0)
    assert np.geterr() == before


def test_a_suspended_pass_leaves_no_check_switched_off() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    before = np.geterr()
    steps = fast_steps(pose(net, {}).model, {}, {})
    chunks = passes(steps, [20_000, 20_000], seed_sequence(0), {})
    next(chunks)
    with pytest.raises(ParameterError, match="scale must be positive"):
        bmc.Normal(0.0, -1.0)
    assert np.geterr() == before
    chunks.close()
