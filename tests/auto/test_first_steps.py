"""What is said of the slips of a first day: data without plates, words of other programs."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.options import engine_meant
from bayesmc.errors import (
    BroadcastError,
    EvidenceError,
    EvidenceWarning,
    ModelError,
    ParameterError,
    PlateError,
    ShapeError,
    UnknownNodeError,
)

X, Y = np.arange(5.0), 1.0 + 2.0 * np.arange(5.0)


def line() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"row": None})
    net.input("x", plates="row")
    net.add("a", bmc.Normal(0.0, 10.0))
    net.add("b", bmc.Normal(0.0, 10.0))
    net.add("y", lambda a, b, x: bmc.Normal(a + b * x, 1.0), plates="row")
    return net


def net_of(function: Callable[..., Any], **plates: int | None) -> bmc.BayesNet:
    net = bmc.BayesNet(plates=plates)
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", function, plates=tuple(plates))
    return net


def walk(function: Callable[..., Any]) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", function, initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def groups(positions: list[int]) -> Any:
    net = bmc.BayesNet(plates={"g": 3, "i": None})
    net.input("k", plates="i")
    net.add("m", bmc.Normal(0.0, 1.0), plates="g")
    net.add("y", lambda m, k: bmc.Normal(m[k], 1.0), plates="i")
    return bmc.infer(net, {"y": np.zeros(len(positions))}, inputs={"k": positions})


def test_data_with_more_axes_than_the_node_ask_for_plates() -> None:
    net = net_of(lambda a: bmc.Normal(a, 1.0))
    with pytest.raises(
        EvidenceError, match=r"BayesNet\(plates={'row': 3}\) and plates='row' of 'y'$"
    ):
        bmc.infer(net, {"y": [1.0, 2.0, 3.0]})
    with pytest.raises(
        EvidenceError, match=r"plates={'row': 2, 'column': 3}\) and plates=\('row', 'column'\)"
    ):
        bmc.infer(net, {"y": np.zeros((2, 3))})
    with pytest.raises(
        EvidenceError, match=r"plates={'column': 2}\) and plates=\('column', 'row'\)"
    ):
        bmc.infer(net_of(lambda a: bmc.Normal(a, 1.0), row=3), {"y": np.zeros((2, 3))})
    with pytest.raises(EvidenceError, match="the data have 1 axis too many"):
        bmc.infer(net_of(lambda a: bmc.Normal(a, 1.0), row=3), {"y": np.zeros((3, 2))})
    with pytest.raises(EvidenceError, match=r"make \(3,\)$"):  # not of data with fewer
        bmc.infer(net_of(lambda a: bmc.Normal(a, 1.0), row=3), {"y": 1.0})


def test_data_of_two_axes_in_one_plate_are_told_apart_from_another_length() -> None:
    for data in (np.tile(Y, (2, 1)), np.tile(Y, (1, 2, 1))):
        with pytest.raises(
            PlateError, match=r"data of 'y' have shape .* is [12] ax[ie]s too many; declare"
        ):
            bmc.infer(line(), {"y": data}, inputs={"x": X})
    with pytest.raises(PlateError, match="but 5 in that of 'x'$"):
        bmc.infer(line(), {"y": Y[:4]}, inputs={"x": X})


@pytest.mark.parametrize("length", range(2, 8))
def test_data_around_a_function_ask_for_a_plate_and_an_input(length: int) -> None:
    xs = np.arange(float(length))
    listed = xs.tolist()
    for function in (
        lambda a: bmc.Normal(a * xs, 1.0),
        lambda a, xs=xs: bmc.Normal(a * xs, 1.0),
        lambda: bmc.Normal(xs, 1.0),
        lambda a: bmc.Normal(np.add(a, listed), 1.0),
    ):
        name = "listed" if "listed" in function.__code__.co_freevars else "xs"
        with pytest.raises(
            (BroadcastError, ShapeError),
            match=rf"'{name}' of shape .*net.input\('{name}', plates='row'\)",
        ) as caught:
            bmc.infer(net_of(function), {"y": np.zeros(length)})
        assert "vectorize" not in str(caught.value)
    with pytest.raises((BroadcastError, ShapeError), match="the node's plates are row=9"):
        net_of(lambda a: bmc.Normal(a * xs, 1.0), row=9).validate()
    net = bmc.BayesNet(plates={"row": length})  # what it says runs
    net.input("xs", plates="row")
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, xs: bmc.Normal(a * xs, 1.0), plates="row")
    bmc.infer(net, {"y": np.zeros(length)}, inputs={"xs": xs})


def test_arrays_around_a_function_that_are_no_data_stand() -> None:
    three, table = np.ones(3), np.array([[0.2, 0.8], [0.6, 0.4]])
    net = net_of(lambda a: bmc.Normal(a + three, 1.0), row=3)
    net.add("w", lambda: bmc.Dirichlet(three))
    net.add("k", lambda: bmc.Categorical(table[0]))
    net.validate()
    with pytest.raises(BroadcastError, match="vectorize=True"):
        net_of(lambda a: bmc.Normal(three.sum() if a > 0 else 0.0, 1.0)).validate()


def test_positions_that_count_from_one_are_told() -> None:
    with pytest.raises(ModelError, match="count from 0: if these count from 1, subtract 1"):
        groups([1, 2, 3])
    for positions in ([0, 2, 3], [1, 2, 4], [-1, 2, 3]):
        with pytest.raises(ModelError) as caught:
            groups(positions)
        assert "outside plate 'g'" in str(caught.value) and "subtract" not in str(caught.value)
    graph = bmc.FactorGraph(plates={"g": 3})
    graph.variable("s", (0, 1), plates="g")
    with pytest.raises(ModelError, match="subtract 1"):
        graph.factor(lambda s, t: s * t, scope=("s", "s"), index=([1, 2], [2, 3]))


def test_an_input_in_the_evidence_is_told() -> None:
    with pytest.raises(EvidenceError, match=r"'x', which is an input: .* pass inputs={'x': value}"):
        bmc.infer(line(), {"y": Y, "x": X})
    with pytest.raises(EvidenceError, match="input 'x' has no value"):
        bmc.infer(line(), {"y": Y})


def test_arguments_that_go_by_keyword_are_named() -> None:
    with pytest.raises(TypeError, match=r"write infer\(net, evidence, inputs=\.\.\.\)"):
        bmc.infer(line(), {"y": Y}, {"x": X})  # type: ignore[misc]
    with pytest.raises(TypeError, match=r"infer\(net, evidence, engine=\.\.\.\)"):
        bmc.infer(line(), {"y": Y}, bmc.Gibbs())  # type: ignore[misc]
    with pytest.raises(TypeError, match=r"filter\(dbn, observations, rng=\.\.\.\)"):
        bmc.filter(walk(lambda x_prev: bmc.Normal(x_prev, 1.0)), {"y": Y}, 1)  # type: ignore
    for call, names in (
        (bmc.fit, "net, data"), (bmc.map, "net, evidence"), (bmc.log_density, "net, evidence"),
        (bmc.explain, "net, evidence, engine"),
    ):  # fmt: skip
        some: Any = (line(), {"y": Y}, None)[: names.count(",") + 1]
        with pytest.raises(TypeError, match=rf"{call.__name__}\({names}, inputs=\.\.\.\)"):
            call(*some, {"x": X})
    with pytest.raises(
        TypeError, match=r"what follows data by keyword; write fit\(net, data, learn="
    ):
        bmc.fit(line(), {"y": Y}, ["a"])  # type: ignore[misc]
    with pytest.raises(TypeError, match=r"prior_predict\(net, draws, inputs=\.\.\.\)"):
        bmc.prior_predict(line(), 10, {"x": X})  # type: ignore[misc]
    assert list(inspect.signature(bmc.infer).parameters)[:3] == ["net", "evidence", "inputs"]
    assert pickle.loads(pickle.dumps(bmc.infer)) is bmc.infer


@pytest.mark.parametrize("name", ["x_t1", "x_t_1", "x_tm1", "x_lag", "x_lag1", "x_last", "last_x"])
def test_other_names_of_the_slice_before(name: str) -> None:
    functions = {name: lambda before: bmc.Normal(before, 1.0)}
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", functions[name], parents=[name], initial=bmc.Normal(0.0, 1.0))
    with pytest.raises(UnknownNodeError, match="did you mean 'x_prev'"):
        bmc.filter(dbn, {"x": Y})


def test_a_parent_near_to_no_name_lists_the_nodes() -> None:
    net = line()
    net.add("z", lambda slop: bmc.Normal(slop, 1.0))
    with pytest.raises(UnknownNodeError, match=r"no node 'slop' \(its nodes are x, a, b, y\)"):
        net.validate()


OPTIONS = {
    "burnin": (bmc.Gibbs, "warmup"),
    "tune": (bmc.HamiltonianMonteCarlo, "warmup"),
    "adapt_delta": (bmc.HamiltonianMonteCarlo, "target_accept"),
    "n_iter": (bmc.MetropolisHastings, "draws, counted after warmup"),
    "n_chains": (bmc.Gibbs, "chains"),
    "thin": (bmc.ParticleGibbs, "thinning"),
    "n_particles": (bmc.ParticleFilter, "particles"),
    "num_samples": (bmc.LikelihoodWeighting, "draws"),
    "sweep": (bmc.MeanField, "'sweeps'"),
    "inits": (bmc.Gibbs, "start"),
}


@pytest.mark.parametrize("option", OPTIONS)
def test_options_as_other_programs_call_them(option: str) -> None:
    engine, meant = OPTIONS[option]
    with pytest.raises(TypeError) as caught:
        engine(**{option: 1})
    name = engine.__name__
    assert str(caught.value).startswith(
        f"{name} has no option {option!r} (did you mean {meant}?); it takes "
    )


def test_options_of_the_call_and_of_nobody() -> None:
    with pytest.raises(TypeError, match=r"'seed' \(rng= is given to the call"):
        bmc.Gibbs(seed=1)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="KalmanFilter has no option 'magic'; it takes none"):
        bmc.KalmanFilter(magic=1)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="GridFilter has no option 'magic'; it takes grid, cells"):
        bmc.GridFilter(magic=1)  # type: ignore[call-arg]


def test_engines_of_users_take_their_own_options() -> None:
    class Short(bmc.Gibbs):
        pass

    class Odd(bmc.Gibbs):
        def __init__(self, burnin: int) -> None:
            super().__init__(warmup=burnin)

    @dataclass(frozen=True)
    class More(bmc.Gibbs):
        burnin: int = 3

    with pytest.raises(TypeError, match="Short has no option 'burnin' .*warmup"):
        Short(burnin=1)  # type: ignore[call-arg]
    assert Odd(burnin=7).warmup == 7 and More(burnin=4).burnin == 4
    assert replace(bmc.Gibbs(), warmup=5).warmup == 5 and bmc.Gibbs(1, 2, 3).chains == 3
    assert pickle.loads(pickle.dumps(bmc.Gibbs(warmup=5))).warmup == 5


@pytest.mark.parametrize(
    ("word", "engine"),
    [
        ("nuts", "HamiltonianMonteCarlo"), ("HMC", "HamiltonianMonteCarlo"), ("gibbs", "Gibbs"),
        ("mcmc", "Gibbs"), ("kalman", "KalmanFilter"), ("pf", "ParticleFilter"), ("smc", "ParticleFilter"),
        ("vi", "MeanField"), ("Particle-Filter", "ParticleFilter"), ("variable_elimination", "Exact"),
    ],
)  # fmt: skip
def test_engines_called_by_a_word(word: str, engine: str) -> None:
    said = rf"engine='{word}' is (not an engine|no engine over time) \(did you mean bmc\.{engine}\("
    with pytest.raises(TypeError, match=said):
        bmc.infer(line(), {"y": Y}, inputs={"x": X}, engine=word)
    with pytest.raises(TypeError, match=said):
        bmc.filter(walk(lambda x_prev: bmc.Normal(x_prev, 1.0)), {"y": Y}, engine=word)  # type: ignore[arg-type]


def test_every_engine_is_found_by_its_own_name() -> None:
    from bayesmc.engines.base import Engine
    from bayesmc.engines.filtering import FilterEngine
    from bayesmc.engines.options import _ENGINES

    for name in _ENGINES:
        found = getattr(bmc, name.split("(")[0])
        assert issubclass(found, (Engine, FilterEngine))
        assert engine_meant(found.__name__) == f" (did you mean bmc.{name}?)"


def test_a_flat_prior_is_a_wide_normal() -> None:
    for low, high in ((-np.inf, np.inf), (0.0, np.inf), (-np.inf, 0.0)):
        with pytest.raises(ParameterError, match="for a flat prior take a wide Normal"):
            bmc.Uniform(low, high)
    with pytest.raises(ParameterError, match="high must be finite and above low; got 1"):
        bmc.Uniform(2.0, 1.0)


def test_no_data_at_all_are_told() -> None:
    with pytest.warns(EvidenceWarning, match="evidence on 'y' is empty .* the answer is the prior"):
        found = bmc.infer(line(), {"y": []}, inputs={"x": []}, rng=0)
    assert abs(found.mean("a")) < 2.0
    net = line()
    net.add("seen", lambda a: bmc.Normal(a, 1.0))
    bmc.infer(net, {"y": [], "seen": 1.0}, inputs={"x": []}, rng=0)  # a warning is an error here


def test_starts_of_what_is_not_learned() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("scale", bmc.HalfNormal(1.0))
    dbn.add("x", lambda x_prev, scale: bmc.Normal(x_prev, scale), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(ModelError, match=r"'scales', which is not learned \(did you mean 'scale'"):
        bmc.fit(dbn, {"y": Y}, start={"scales": 1.0})
