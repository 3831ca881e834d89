"""What templates say of names that are not there, of bad parameters, and where no filter answers."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BayesmcError, ConvergenceWarning, ParameterError, UnsupportedError

ROWS = {"y": [0.1, 0.2, 0.3]}


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.input("speed")
    dbn.add("x", lambda x_prev, speed: bmc.Normal(x_prev + speed, 1.0), initial=bmc.Normal(0, 1))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


INPUTS = {"speed": np.zeros(3)}


def read(parent: str) -> Callable[[], Any]:
    """A filter of a template in which a node reads ``parent``."""

    def ask() -> Any:
        dbn = walk()
        dbn.add("z", lambda p: bmc.Normal(p, 1.0), [parent], initial=bmc.Normal(0.0, 1.0))
        return bmc.filter(dbn, ROWS, inputs=INPUTS)

    return ask


def asked(**options: Any) -> Callable[[], Any]:
    given: dict[str, Any] = {"inputs": INPUTS, **options}
    return lambda: bmc.filter(walk(), given.pop("rows", ROWS), **given)


def by_particles(**options: Any) -> Callable[[], Any]:
    return asked(engine=bmc.ParticleFilter(9, **options), rng=0)


NAMES: dict[str, tuple[Callable[[], Any], str]] = {
    "a slip": (read("x_pev"), r"no node 'x_pev' \(did you mean 'x_prev'\?\)"),
    "case": (read("X_prev"), "did you mean 'x_prev'"),
    "the other way round": (read("prev_x"), "did you mean 'x_prev'"),
    "spelt out": (read("x_previous"), "did you mean 'x_prev'"),
    "an input": (read("sped"), "did you mean 'speed'"),
    "the clock": (read("T"), "did you mean 't'"),
    "observations": (asked(rows={"Y": [0.1]}), r"observations of 'Y'.*did you mean 'y'"),
    "of an unrolled net": (asked(rows={"y[0]": 0.1}), "under the name 'y', time first"),
    "inputs": (asked(inputs={"Speed": np.zeros(3)}), r"inputs= gives 'Speed'.*mean 'speed'"),
    "evidence": (lambda: bmc.infer(walk(), {"Y": [0.1]}, inputs=INPUTS), "did you mean 'y'"),
    "unrolled": (lambda: walk().unrolled_evidence({"Y": [0.1]}), "did you mean 'y'"),
    "a query": (asked(
        engine=bmc.ParticleFilter(9), queries={"q": lambda X: X}, rng=0), "did you mean 'x'"),
    "a proposal": (by_particles(proposal={"X": bmc.Normal(0.0, 1.0)}), "did you mean 'x'"),
    "its argument": (
        by_particles(proposal={"x": lambda Y: bmc.Normal(Y, 1.0)}), "did you mean 'y'"),
    "a first stage": (by_particles(auxiliary=lambda X_prev: X_prev), "did you mean 'x_prev'"),
    "an answer": (lambda: asked()().mean("X"), "did you mean 'x'"),
    "a look-up": (lambda: walk()["X"], "did you mean 'x'"),
    "a static value": (
        lambda: bmc.KalmanFilter().start(with_parameter(), static={"Rate": 1.0}),
        "did you mean 'rate'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", NAMES)
def test_names_that_may_be_meant_are_told(what: str) -> None:
    ask, message = NAMES[what]
    with pytest.raises(BayesmcError, match=message):
        ask()


@pytest.mark.parametrize("name", ["x_prev2", "x_prev_prev", "x_prev_2", "x_2prev", "x_lag2"])
def test_two_slices_back_is_told_by_a_lag_node(name: str) -> None:
    with pytest.raises(BayesmcError, match="look one slice back") as caught:
        read(name)()
    told = str(caught.value)
    assert "dbn.add('x_lag', lambda x_prev: x_prev, initial=...)" in told
    assert "'x_lag_prev'" in told and "docs/time.md" in told
    assert "Declare it" not in told
    with pytest.raises(BayesmcError, match="no node 'w_prev2'"):
        read("w_prev2")()


# ---- bad parameters -------------------------------------------------------------------------------


def scale(t: Any) -> np.ndarray:
    return np.where(t == 30, -1.0, 1.0)


def moving() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev, t: bmc.Normal(x_prev, scale(t)), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def seen() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.2), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, t: bmc.Normal(x, scale(t)))
    return dbn


def switching() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("y", lambda z, t: bmc.Normal(1.0 * z, scale(t)))
    return dbn


GRID = bmc.GridFilter(grid={"x": (-12.0, 12.0, 200)})
NUMBERS = [
    None, bmc.KalmanFilter(), bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter(), GRID,
    bmc.ParticleFilter(40), bmc.ParticleFilter(40, proposal="optimal", auxiliary=True),
]  # fmt: skip
STATES = [None, bmc.DiscreteFilter(), bmc.GridFilter(), bmc.ParticleFilter(40)]
EACH = [(b, e) for b in (moving, seen) for e in NUMBERS] + [(switching, e) for e in STATES]


@pytest.mark.parametrize(("build", "engine"), EACH)
def test_bad_parameters_name_their_slice_in_every_filter(build: Any, engine: Any) -> None:
    """Where the row is seen, where it is missing, ahead of the data, and row by row."""
    rows: Any = np.ma.masked_array(np.zeros(40))
    gap = rows.copy()
    gap[30] = np.ma.masked
    told = re.compile(r"\bslice 30\b")
    options: dict[str, Any] = {"engine": engine, "rng": 0}
    with pytest.raises(ParameterError, match=told):
        bmc.filter(build(), {"y": rows}, **options)
    with pytest.raises(ParameterError, match=told):
        bmc.filter(build(), {"y": gap}, **options)
    with pytest.raises(ParameterError, match=told):
        bmc.forecast(build(), {"y": np.zeros(29)}, steps=3, **options)
    if engine is not None:
        belief = engine.start(build(), rng=0)
        with pytest.raises(ParameterError, match=told):
            for _ in range(40):
                belief = engine.step(belief, {"y": 0.0})


@pytest.mark.parametrize("build", [moving, seen, switching])
def test_bad_parameters_name_their_slice_elsewhere(build: Any) -> None:
    rows = {"y": np.zeros(32)}
    with pytest.raises(ParameterError, match="slice 30"):
        build().sample(32, 1, rng=0)
    with pytest.raises(ParameterError, match="slice 30"):
        bmc.smooth(build(), rows)
    for engine in (
        bmc.Exact(),
        bmc.LikelihoodWeighting(50),
        bmc.Gibbs(9, warmup=9, chains=2),
        bmc.ParticleGibbs(9, warmup=9, chains=2, particles=9),
    ):
        with pytest.raises(ParameterError, match=r"\[30\]"):
            bmc.infer(build(), rows, engine=engine, rng=0)


def test_bad_parameters_of_impossible_states_are_no_fault() -> None:
    """A missing reading in a state that is never entered: its parameters are nobody's concern."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[1.0, 0.0], [0.5, 0.5]], initial=[1.0, 0.0])
    dbn.add("y", lambda z: bmc.Normal(0.0, np.where(z == 1, -1.0, 1.0)))
    for engine in STATES[:3]:
        found = bmc.filter(dbn, {"y": [0.1, None, 0.2]}, engine=engine)
        assert found.std("y")[1] == pytest.approx(1.0)


# ---- explain, and where to turn --------------------------------------------------------------------


def with_parameter() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("rate", bmc.Beta(2.0, 2.0))
    dbn.add("x", lambda x_prev, rate: bmc.Normal(rate * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.3))
    return dbn


def hidden_density() -> bmc.DynamicBayesNet:
    """Two states that no filter draws, and Gibbs does."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Normal(0.0, 1.0)

    def moves(before: Any) -> bmc.Density:
        return bmc.Density(lambda now: -0.5 * (now - before) ** 2, support=(-np.inf, np.inf))

    dbn.add("x", moves, ["x_prev"], initial=start)
    dbn.add("w", moves, ["w_prev"], initial=start)
    dbn.add("y", lambda x, w: bmc.Normal(x + w, 1.0))
    return dbn


@pytest.mark.parametrize("build", [with_parameter, hidden_density])
@pytest.mark.parametrize("question", ["filter", "smooth"])
def test_explain_answers_where_infer_does(build: Any, question: str) -> None:
    """It says what infer takes, and once why no filter answers."""
    told = bmc.explain(build(), ROWS, question=question)
    assert told.reasons[0].startswith("infer(dbn, observations) takes it")
    assert isinstance(told.engine, (bmc.Gibbs, bmc.MetropolisHastings)) and set(told.nodes) >= {
        "x[0]",
        "y[2]",
    }
    assert not bmc.explain(build(), ROWS, told.engine).refused
    assert str(told).count("ParticleGibbs(draws)") <= 1
    assert "KalmanFilter: KalmanFilter" not in str(told.reasons)


@pytest.mark.parametrize(
    "engine", [bmc.Gibbs(9), bmc.ParticleGibbs(9), bmc.ParticleMetropolis(9), bmc.Exact()]
)
def test_explain_answers_for_static_engines_on_templates(engine: Any) -> None:
    told = bmc.explain(with_parameter(), ROWS, engine)
    assert told.engine is engine
    assert bool(told.refused) is isinstance(engine, bmc.Exact)


@pytest.mark.parametrize("ask", [bmc.filter, bmc.smooth, bmc.most_likely])
def test_unknown_static_nodes_are_said_once_and_point_on(ask: Any) -> None:
    with pytest.raises(UnsupportedError, match="'rate' is not observed") as caught:
        ask(with_parameter(), ROWS)
    told = str(caught.value)
    assert told.count("not observed") == 1
    assert "ParticleGibbs(draws)" in told and "ParticleMetropolis(draws)" in told
    with pytest.raises(UnsupportedError, match="ParticleGibbs"):
        ask(with_parameter(), ROWS, engine=bmc.ParticleFilter(9))


def test_unmixed_chains_on_a_template_name_particle_gibbs() -> None:
    options: dict[str, Any] = {"warmup": 2, "chains": 4}
    for engine, named in (
        (bmc.Gibbs(20, **options), True),
        (bmc.MetropolisHastings(20, **options), True),
        (bmc.ParticleGibbs(8, particles=4, **options), False),
    ):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            bmc.infer(with_parameter(), {"y": np.arange(12.0)}, engine=engine, rng=0)
        told = [str(w.message) for w in caught if issubclass(w.category, ConvergenceWarning)]
        assert told
        assert sum("ParticleGibbs(draws) draws whole" in text for text in told) == named
    net = with_parameter().unroll(3)
    evidence = with_parameter().unrolled_evidence(ROWS)
    with pytest.warns(ConvergenceWarning) as record:
        bmc.infer(net, evidence, engine=bmc.Gibbs(20, **options), rng=0)
    assert not any("ParticleGibbs" in str(w.message) for w in record)
