"""Tests of kernels on nets: functions of one state and of many, engines, single kernels of ours, wrong input.

Right kernels are tested at alpha = 1e-4 and fixed seeds; every kind of mover also with a fault that both
tests must find.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    EvidenceError,
    ModelError,
    UnknownNodeError,
    UnsupportedError,
)
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.proposed import Proposed
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.kernels.slice import Slice
from bayesmc.structure.blanket import Blanket
from bayesmc.testing import (
    JointModel,
    Verdict,
    geweke_test,
    random_net,
    rank_test,
    simulation_based_calibration,
    uncounted,
)
from bayesmc.testing.kernels.joint import NetJoint
from bayesmc.testing.kernels.machines import Machine
from bayesmc.testing.kernels.moves import moves_of
from bayesmc.testing.kernels.statistics import default_statistics

ALPHA = 1e-4
TESTS = {"geweke": geweke_test, "ranks": rank_test}


def labelled() -> bmc.BayesNet:
    """Labels, a plate, a computed node and data."""
    net = bmc.BayesNet(plates={"i": 3})
    net.table("a", probs=[0.3, 0.7], states=["no", "yes"])
    net.add("z", lambda a: bmc.Bernoulli(0.2 + 0.6 * (a == "yes")), plates="i")
    net.add("level", lambda z: 2.0 * z, plates="i")
    net.add("x", lambda level: bmc.Normal(level, 1.0), plates="i")
    return net


def draw_a(state: dict, rng: np.random.Generator) -> dict:
    yes = 0.7 * np.prod(np.where(state["z"] == 1, 0.8, 0.2), axis=-1)
    no = 0.3 * np.prod(np.where(state["z"] == 1, 0.2, 0.8), axis=-1)
    chosen = np.where(rng.random(np.shape(yes)) < yes / (yes + no), "yes", "no")
    return {**state, "a": chosen[()]}


def draw_z(state: dict, rng: np.random.Generator, by: float = 2.0) -> dict:
    share = np.asarray(np.where(state["a"] == "yes", 0.8, 0.2))[..., None]
    one = share * np.exp(-0.5 * (state["x"] - by) ** 2)
    none = (1 - share) * np.exp(-0.5 * state["x"] ** 2)
    drawn = (rng.random(state["x"].shape) < one / (one + none)).astype(int)
    assert np.shape(state["level"]) == drawn.shape
    return {**state, "z": drawn}


def sweep(state: dict, rng: np.random.Generator) -> dict:
    return draw_z(draw_a(state, rng), rng)


def back(state: dict, rng: np.random.Generator) -> dict:
    return draw_a(draw_z(state, rng), rng)


def faulty(state: dict, rng: np.random.Generator) -> dict:
    return draw_z(draw_a(state, rng), rng, by=1.0)


def faulty_back(state: dict, rng: np.random.Generator) -> dict:
    return draw_a(draw_z(state, rng, by=1.0), rng)


def only_moved(step: Callable) -> Callable:
    """What the same step may return: only what it moved."""

    def shorter(state: dict, rng: np.random.Generator) -> dict:
        return {n: v for n, v in step(state, rng).items() if n in ("a", "z")}

    return shorter


@pytest.mark.parametrize("batched", [False, True])
def test_functions_of_one_state_and_of_many(batched: bool) -> None:
    sizes = {"batched": batched, "alpha": ALPHA, "rng": 3}
    draws, count = (200, 1000) if batched else (40, 900)
    assert rank_test(sweep, labelled(), back, replications=count, **sizes)
    assert geweke_test(only_moved(sweep), labelled(), draws=draws, **sizes)
    assert not rank_test(faulty, labelled(), faulty_back, replications=count, **sizes)
    found = geweke_test(only_moved(faulty), labelled(), draws=draws, **sizes)
    assert not found
    assert any("z" in c.what for c in found.rejected)


def test_a_step_in_one_order_is_not_its_own_reverse() -> None:
    found = rank_test(sweep, labelled(), batched=True, replications=60_000, rng=0)
    assert not found
    assert "keeps no detailed balance" in repr(found)
    assert rank_test(draw_z, labelled(), batched=True, replications=20_000, rng=0, alpha=ALPHA)


# ---- engines and kernels ------------------------------------------------------------------------


def normal() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("m", bmc.Normal(0.5, 1.0))
    net.add("s", bmc.Gamma(3.0, 2.0))
    net.add("y", lambda m, s: bmc.Normal(m, s), plates="i")
    return net


def looking_ahead() -> bmc.BayesNet:
    """A net with an input, and with a node that nothing observed depends on."""
    net = bmc.BayesNet(plates={"i": 3})
    net.input("u", plates="i")
    net.add("m", bmc.Normal(0.5, 1.0))
    net.add("y", lambda m, u: bmc.Normal(m * u, 0.5), plates="i")
    net.add("next", lambda m: bmc.Normal(2.0 * m, 0.3))
    return net


ENGINES: dict[str, tuple[Callable[[], bmc.BayesNet], Any, dict[str, Any]]] = {
    "tables": (labelled, bmc.Gibbs(), {"replications": 100}),
    "conjugate and slice": (normal, bmc.Gibbs(), {"replications": 40}),
    "ensembles": (normal, bmc.MetropolisHastings(warmup=100), {"replications": 400}),
    "proposals": (
        normal,
        bmc.MetropolisHastings(
            proposal={"s": lambda s: bmc.LogNormal(np.log(s), 0.5), "m": "prior"}
        ),
        {},
    ),
    "drawn forward": (
        looking_ahead,
        bmc.Gibbs(),
        {"observed": "y", "inputs": {"u": [0.5, 1.0, -2.0]}, "replications": 200},
    ),
}


@pytest.mark.parametrize("name", ENGINES)
def test_engines_pass(name: str) -> None:
    make, engine, sizes = ENGINES[name]
    assert rank_test(engine, make(), alpha=ALPHA, rng=1, **sizes)


class Shifted(Kernel):
    """A kernel with an error of its own."""

    def __init__(self, kernel: Any) -> None:
        self.kernel, self.names, self.label = kernel, kernel.names, kernel.label

    def start(self, values: Any, chains: int) -> Any:
        return self.kernel.start(values, chains)

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        new, memory = self.kernel.step(values, memory, rng, warmup)
        return {n: v * 1.15 for n, v in new.items()}, memory

    def end_warmup(self, memory: Any) -> Any:
        return self.kernel.end_warmup(memory)


KERNELS: dict[str, Callable[[Any], Kernel]] = {
    "walk": lambda target: AdaptiveWalk(Blanket(target, "s")),
    "slice": lambda target: Slice(Blanket(target, "s")),
    "block": lambda target: BlockWalk(target, ["m", "s"], ensemble=8),
    "prior": lambda target: Proposed(Blanket(target, "s")),
}


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("test", TESTS)
def test_single_kernels(name: str, test: str) -> None:
    """Here they are given by functions of a target; the second one errs."""
    run = TESTS[test]
    sizes: dict[str, Any] = {"warmup": 60, "alpha": ALPHA, "rng": 5}
    if test == "geweke":
        sizes |= {"draws": 60}
    if name == "block":
        sizes |= {"chains": 32} if test == "geweke" else {"replications": 200}
    assert run(KERNELS[name], normal(), **sizes)
    assert not run(lambda target: Shifted(KERNELS[name](target)), normal(), **sizes)


def test_a_sampler_of_finite_nets_is_posed_or_given_but_never_taken_for_the_other() -> None:
    """Tables are worked out of the evidence: kernels whose placeholder must not stand for all data."""
    asked = 0
    for seed in range(24):
        net = random_net(seed, nodes=(2, 4))
        joint = NetJoint(net)
        if joint.observed:
            found = rank_test(bmc.Gibbs(), net, replications=100, alpha=1e-5, rng=seed)
            assert found, (seed, found)
            asked += 1
    assert asked >= 8


class Restless(AdaptiveWalk):
    """Goes on adapting."""

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        new, learnt = super().step(values, memory, rng, True)
        return new, learnt

    def end_warmup(self, memory: Any) -> Any:
        return memory


@pytest.mark.parametrize("test", TESTS)
def test_a_kernel_that_goes_on_adapting_is_named(test: str) -> None:
    found = TESTS[test](lambda target: Restless(Blanket(target, "s")), normal(), warmup=20, rng=0)
    assert not found
    assert found.worst is not None and "'s' goes on adapting after the warmup" in found.worst.what
    assert "infinite" not in repr(found) and "inf standard errors" in repr(found)


# ---- statistics ---------------------------------------------------------------------------------


def test_statistics_are_functions_of_nodes() -> None:
    found = rank_test(
        faulty, labelled(), faulty_back, batched=True, replications=5000, rng=0,
        statistics={
            "off": lambda level, x: ((x - level) ** 2).sum(axis=-1),
            "yes": lambda a: a == "yes",
        },
    )  # fmt: skip
    assert set(found.p_values) == {"off", "yes"}
    assert found.rejected[0].what.startswith("off, rank")


def test_default_statistics_are_finite_and_bounded_on_all_kinds_of_nodes() -> None:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("heavy", bmc.Cauchy(0.0, 1.0))
    net.add("angle", bmc.VonMises(0.0, 2.0))
    net.add("matrix", bmc.InverseWishart(4.0, np.eye(2)))
    net.add("simplex", bmc.Dirichlet([1.0, 2.0, 3.0]))
    net.add("count", bmc.Poisson(3.0))
    net.add("state", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("y", lambda heavy, angle, count: bmc.Normal(heavy + np.cos(angle) + count, 1.0))
    joint = NetJoint(net, "y")
    statistics = default_statistics(joint)
    rng = np.random.default_rng(0)
    state = joint.prior(rng, 2000)
    data = joint.simulate(state, rng)
    for name, statistic in statistics.items():
        value = np.asarray(statistic(state, data), dtype=float)
        assert value.shape == (2000,), name
        assert np.isfinite(value).all(), name
        assert np.abs(value).max() < 30, name
    wanted = {"state is 1", "state is 2", "log density", "mean of heavy", "square of angle"}
    assert wanted <= set(statistics)


# ---- wrong input --------------------------------------------------------------------------------


def expecting(error: type[Exception], words: str, *args: Any, **options: Any) -> None:
    with pytest.raises(error, match=words) as caught:
        rank_test(*args, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("result", "error", "words"),
    [
        (3, ModelError, "returned int; return the next state"),
        ({"q": 1}, ModelError, "'q', which is no node of the net; it has"),
        ({"x": [0.0, 1.0, 2.0]}, ModelError, "moved 'x', which is data"),
        ({"a": "maybe"}, EvidenceError, "'maybe' is not a state; the states are 'no', 'yes'"),
        ({"z": [0, 1]}, EvidenceError, "shape"),
        ({"z": [0, 1, 5]}, EvidenceError, "5 is not among the values 0, 1"),
        ({"a": None}, EvidenceError, "node 'a': None"),
    ],
)
def test_what_a_step_returns(result: Any, error: type[BayesmcError], words: str) -> None:
    expecting(error, words, lambda state, rng: result, labelled())


def test_what_is_no_kernel() -> None:
    net = labelled()
    for wrong in ("gibbs", bmc.Exact(), bmc.LikelihoodWeighting(10), None):
        expecting(UnsupportedError, "moves no states; give an engine of Markov chains", wrong, net)
    expecting(UnsupportedError, "made int of a target", lambda target: 3, net)
    expecting(UnsupportedError, "is no function step", sweep, net, bmc.Gibbs())


def test_what_is_no_joint_law() -> None:
    net = labelled()
    expecting(ModelError, "has no node 'q'", sweep, net, observed="q")
    expecting(ModelError, "'z' depends on 'a'", sweep, net, observed="a")
    expecting(ModelError, "'level' is not a stochastic node", sweep, net, observed="level")
    expecting(ModelError, "leaves nothing hidden", sweep, net, observed=["a", "z", "x"])
    expecting(UnsupportedError, "FactorGraph", bmc.Gibbs(), net.to_factor_graph({"x": np.zeros(3)}))
    net.potential("more", lambda a: 1.0 * (a == "yes"))
    expecting(UnsupportedError, "'more' reweights the net", sweep, net)
    blind = bmc.BayesNet()
    blind.add("x", bmc.Density(lambda x: -x * x))
    blind.add("y", lambda x: bmc.Normal(x, 1.0))
    expecting(UnsupportedError, "'x'", bmc.Gibbs(), blind)
    alone = bmc.BayesNet()
    alone.add("a", bmc.Bernoulli(0.5))
    alone.add("b", bmc.Bernoulli(0.5))
    expecting(UnsupportedError, "no kernel to test", bmc.Gibbs(), alone)


def test_states_that_a_step_gets_are_its_own() -> None:
    """Functions may write into what they get."""

    def writing(state: dict, rng: np.random.Generator) -> dict:
        state["x"] += 1.0
        state["z"][...] = 0
        return {}

    net = labelled()
    for batched in (False, True):
        moves = moves_of("test", writing, net, batched=batched, rows=5)
        rng = np.random.default_rng(0)
        state = moves.prior(rng, 5)
        data = moves.simulate(state, rng)
        before = {n: v.copy() for n, v in {**state, **data}.items()}
        after = moves.forward(state, data, rng)
        for name, value in {**after, **data}.items():
            np.testing.assert_array_equal(value, before[name])


def test_all_results_are_verdicts() -> None:
    found = rank_test(draw_z, labelled(), batched=True, replications=50, rng=0)
    assert isinstance(found, Verdict)
    assert found.p_value == min(1.0, min(found.p_values.values()) * len(found.p_values))


# ---- what a review found -------------------------------------------------------------------------


def test_vector_slices_are_reversed() -> None:
    """Directions are taken in turn, so that the reverse takes them the other way; at 1e-4."""
    net = bmc.BayesNet()
    net.add("x", bmc.MvNormal([0.0, 0.0], [[1.0, 0.95], [0.95, 1.0]]))
    net.add("y", lambda x: bmc.Normal(x[..., 0] ** 3, 1.0))
    statistics = {"p": lambda x: (x[..., 0] - x[..., 1]) * x[..., 1]}

    def slices(target: Any) -> Kernel:
        return FactorSlice(target, ("x",))

    options: dict[str, Any] = {"statistics": statistics, "steps": 2, "warmup": 0, "alpha": ALPHA}
    assert rank_test(slices, net, replications=6000, rng=7, **options)
    assert not rank_test(slices, net, slices, replications=20_000, rng=7, **options)


def test_few_data_sets_are_compiled_for_each() -> None:
    """A rare observation must not be taken for the placeholder."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("b", lambda a: bmc.Bernoulli(0.1 + 0.8 * a))
    net.add("y", lambda a, b: bmc.Bernoulli(0.04 * a * b))
    assert not Machine("test", bmc.Gibbs(), NetJoint(net), None).is_given
    statistics = {"a": lambda a: 1.0 * a, "ab": lambda a, b, y: a * b * (1.0 + 9.0 * y)}
    assert geweke_test(bmc.Gibbs(), net, draws=100, statistics=statistics, alpha=ALPHA, rng=3)


@pytest.mark.parametrize("name", ["integers", "bounds", "forward"])
def test_data_whose_support_depends_on_the_state(name: str) -> None:
    net = bmc.BayesNet()
    engine: Any = bmc.Gibbs()
    if name == "integers":
        net.add("n", bmc.Poisson(3.0))
        net.add("y", lambda n: bmc.Binomial(n, 0.4))
    elif name == "bounds":
        net.add("n", bmc.Gamma(2.0, 1.0))
        net.add("y", lambda n: bmc.Uniform(0.0, n))
    else:
        net.add("n", bmc.Normal(0.0, 1.0))
        net.add("y", lambda n: bmc.Normal(n, 1.0))
        net.add("next", lambda n: bmc.Normal(n, 1.0))
        engine = bmc.MetropolisHastings(warmup=20)
    assert rank_test(engine, net, observed="y", replications=60, alpha=1e-5, rng=0)


@pytest.mark.thorough
def test_rare_states_raise_no_alarm() -> None:
    """A state that hardly comes has no normal limit: 30 runs at .01, of which 4 or more once in 1e4."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(1e-3))
    net.add("y", lambda a: bmc.Normal(1.0 * a, 1.0))

    def step(state: dict, rng: np.random.Generator) -> dict:
        one = 1e-3 * np.exp(-0.5 * (state["y"] - 1.0) ** 2)
        none = 0.999 * np.exp(-0.5 * state["y"] ** 2)
        return {"a": (rng.random(np.shape(one)) < one / (one + none)).astype(int)}

    statistics = {"a": lambda a: 1.0 * a}
    with uncounted():
        found = [
            geweke_test(step, net, batched=True, statistics=statistics, draws=60, alpha=0.01, rng=s)
            for s in range(30)
        ]
    assert sum(not f for f in found) < 4
    often = geweke_test(lambda s, rng: {"a": 1}, net, statistics=statistics, draws=20, rng=0)
    assert not often  # what finds the rare state all the time does


def pair() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    return net


@pytest.mark.parametrize("test", [rank_test, geweke_test])
def test_a_kernel_that_pays_the_data_no_heed_is_caught(test: Any) -> None:
    """It keeps the joint law where new data are drawn after its move."""
    assert not test(lambda state, rng: {"x": rng.normal()}, pair(), rng=0)


@pytest.mark.parametrize("test", [rank_test, geweke_test, simulation_based_calibration])
def test_random_numbers_of_the_users_own_may_have_the_same_seed(test: Any) -> None:
    """Of a test's generator and one beside it, both made from 0."""
    own = np.random.default_rng(0)

    def step(state: dict, rng: Any) -> dict:
        return {
            "x": own.normal(
                state["y"] / 2, 0.5**0.5, *([9] * (test is simulation_based_calibration))
            )
        }

    assert test(step, pair(), alpha=ALPHA, rng=0)


def test_figures_of_geweke_are_told_to_be_scaled() -> None:
    def high(state: dict, rng: Any) -> dict:
        return {"x": rng.normal(state["y"] / 2 + 1.0, 0.5**0.5)}

    found = geweke_test(high, pair(), draws=50, rng=0)
    assert found.is_default and "less their median under the joint law" in repr(found)
    own = geweke_test(high, pair(), draws=50, statistics={"x": lambda x: x}, rng=0)
    assert not own.is_default and "median" not in repr(own)


@pytest.mark.parametrize("test", [rank_test, geweke_test])
@pytest.mark.parametrize(
    ("kernel", "words"),
    [
        (lambda x, y, rng: None, r"kernel\(state, data, rng\) of the JointModel returned None"),
        (lambda x, rng: x, r"kernel is called with .state, data, rng., which .x, rng. does not"),
        (lambda x, y, *, rng: x, r"which .x, y, \*, rng. does not take"),
    ],
)
def test_kernels_of_models_that_are_no_nets(test: Any, kernel: Any, words: str) -> None:
    statistics = {"x": lambda x, y: x}
    model = JointModel(lambda rng, n: rng.normal(size=n), lambda x, rng: None, statistics)
    with pytest.raises(ModelError, match=words):
        test(kernel, model)


@pytest.mark.parametrize(
    "kernel",
    [lambda x, y, rng=None: x, lambda *a: a[0], lambda x, *rest: x, lambda x, y, rng, by=1.0: x],
)
def test_kernels_that_can_be_called_with_three_arguments(kernel: Any) -> None:
    statistics = {"x": lambda x, y: x, "whole": lambda x, y: np.array([*map(int, x)], dtype=object)}
    model = JointModel(lambda rng, n: rng.normal(size=n), lambda x, rng: None, statistics)
    assert rank_test(kernel, model, replications=20, rng=0)


@pytest.mark.parametrize("observed", [np.array(["y"]), {"y": 1.0}, {"y"}, ("y",), iter(["y"])])
def test_names_of_data_in_any_container(observed: Any) -> None:
    assert NetJoint(pair(), observed).observed == ("y",)


def test_words_for_numbers_that_are_none() -> None:
    step = draw_a
    expecting(EvidenceError, "returned NaN for 'x'", lambda s, rng: {"x": np.nan}, pair())
    complex_ = {"c": lambda x: 1j * x}
    with pytest.raises(TypeError, match="statistic 'c' is of type complex128; give real numbers"):
        geweke_test(lambda s, rng: s, pair(), statistics=complex_)
    with pytest.raises(DensityError, match="NaN among the draws of 'x'"):
        simulation_based_calibration(lambda e, rng: {"x": np.full(9, np.nan)}, pair())
    unknown = {"z": lambda zz: zz}
    expecting(UnknownNodeError, "rank_test: statistic 'z': argument 'zz' is not a node; the net has x, y",
              step, pair(), statistics=unknown)  # fmt: skip
    expecting(ValueError, r"warmup=-1\): give", bmc.Gibbs(), pair(), warmup=-1)
    expecting(TypeError, "observed=3: give the name of a node", step, pair(), observed=3)
    expecting(EvidenceError, "are a list; give a dict", step, pair(), inputs=[1])
    expecting(UnsupportedError, "moves no states", lambda s, *, rng: s, pair())


def test_words_for_what_is_no_joint_law() -> None:
    net = labelled()
    expecting(UnsupportedError, "arguments are .kernel, net.", net, sweep)
    expecting(TypeError, "give a dict of name -> function", sweep, net, statistics=["a"])
    expecting(ValueError, "replications=3", sweep, net, replications=3)
