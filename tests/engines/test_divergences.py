"""What is done about trajectories that diverge, and what is said of those that are left."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc.trajectories import _apart_from
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.hamiltonian_warmup import Bends
from bayesmc.kernels.rescaled import Rescaled

TREATED = np.array(
    [3, 7, 5, 102, 28, 4, 98, 60, 25, 138, 64, 45, 9, 57, 25, 33, 28, 8, 6, 32, 27, 22]
)
OF_THESE = np.array(
    [38, 114, 69, 1533, 355, 59, 945, 632, 278, 1916, 873, 263, 291, 858, 154, 207, 251, 151, 174,
     209, 391, 680]
)  # fmt: skip
CONTROLS = np.array(
    [3, 14, 11, 127, 27, 6, 152, 48, 37, 188, 52, 47, 16, 45, 31, 38, 12, 6, 3, 40, 43, 39]
)
OF_THOSE = np.array(
    [39, 116, 93, 1520, 365, 52, 939, 471, 282, 1921, 583, 266, 293, 883, 147, 213, 122, 154, 134,
     218, 364, 674]
)  # fmt: skip


def trials(apart: bool) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Beta blockers in 22 trials (BUGS examples, volume 1): a precision that may be anything."""
    net = bmc.BayesNet(plates={"trial": 22})
    net.add("effect", bmc.Normal(0.0, 1e3))
    net.add("precision", bmc.Gamma(0.001, 0.001))
    net.add("base", bmc.Normal(0.0, 316.0), plates="trial")
    if apart:
        net.add("raw", bmc.Normal(0.0, 1.0), plates="trial")
        net.add(
            "own", lambda effect, precision, raw: effect + raw * precision**-0.5, plates="trial"
        )
    else:
        net.add(
            "own", lambda effect, precision: bmc.Normal(effect, precision**-0.5), plates="trial"
        )
    net.add("control", lambda base: bmc.Binomial(OF_THOSE, logits=base), plates="trial")
    net.add("treated", lambda base, own: bmc.Binomial(OF_THESE, logits=base + own), plates="trial")
    return net, {"control": CONTROLS, "treated": TREATED}


def infer(*question: Any, **options: Any) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = bmc.infer(*question, rng=0, **options)
    return found, [str(w.message) for w in caught]


def reached(posterior: Any) -> list[float]:
    memory = posterior.checkpoint.state["memory"]
    return [m["step"]["target"] for m in memory if "metric" in m]


@pytest.mark.parametrize("apart", [True, False])
def test_steps_are_learnt_anew_where_trajectories_diverge(apart: bool) -> None:
    """With the first steps more than one in a thousand diverges."""
    pytest.importorskip("llvmlite", reason="llvmlite is not installed")
    posterior, told = infer(*trials(apart))
    assert not [t for t in told if "diverged" in t]
    assert posterior.divergences.mean() <= 1e-3
    if apart:
        assert reached(posterior) == pytest.approx([0.95])


def test_steps_that_do_are_left_alone() -> None:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("a", bmc.Laplace(0.0, 1.0))
    net.add("y", lambda a: bmc.StudentT(5.0, a, 1.0), plates="i")
    engine = bmc.HamiltonianMonteCarlo()
    posterior, told = infer(net, {"y": np.linspace(-1, 2, 6)}, engine=engine)
    assert told == []
    assert reached(posterior) == [0.8]


def test_a_warmup_whose_length_is_said_keeps_to_what_is_said() -> None:
    engine = bmc.HamiltonianMonteCarlo(100, warmup=200, target_accept=0.6)
    posterior, told = infer(*trials(apart=True), engine=engine)
    assert any("diverged" in t for t in told)
    assert reached(posterior) == [0.6]


def test_the_later_half_of_a_window_counts() -> None:
    bends, some = Bends(), np.array([True, True, False, False])
    memory = bends.start()
    for sweep in range(1, 6):
        memory = bends.seen(memory, some, sweep, begun=0, end=10)
    assert memory.tolist() == [0.0, 0.0]
    memory = bends.seen(memory, some, 6, begun=0, end=10)
    assert memory.tolist() == [2.0, 4.0]
    assert bends.target(memory, 0.9) == pytest.approx(0.975)
    assert bends.target(np.array([1.0, 640.0]), 0.8) == pytest.approx(0.95)
    assert bends.target(np.array([1.0, 1000.0]), 0.8) == 0.8  # that is chance


def test_a_warmup_does_not_end_on_steps_that_were_too_long() -> None:
    kernel = Hamiltonian.__new__(Hamiltonian)
    assert kernel.unsettled({"raised": 3, "windows": 3})
    assert not kernel.unsettled({"raised": 3, "windows": 4})
    assert not kernel.unsettled({"raised": 0, "windows": 0})


def test_the_advice_is_not_what_the_model_does_already() -> None:
    advice = {}
    for apart in (True, False):
        engine = bmc.HamiltonianMonteCarlo(200, warmup=100, target_accept=0.4)
        _, told = infer(*trials(apart), engine=engine)
        (advice[apart],) = [t for t in told if "diverged" in t]
    assert "declare 'own' apart from the scale 'precision'" in advice[False]
    assert "apart from" not in advice[True]
    for words in advice.values():
        assert "give tighter priors, or raise target_accept=0.4 (0.95 or 0.99 or 0.999)" in words


def test_of_several_scales_the_advice_names_that_of_the_trajectories_that_diverged() -> None:
    kernels = []
    for name, below in (("scale_a", ("a",)), ("scale_g", ("g",))):
        kernel = Rescaled.__new__(Rescaled)
        kernel.name, kernel.below = name, below
        kernels.append(kernel)
    nuts = Hamiltonian.__new__(Hamiltonian)
    assert "declare 'g' apart from the scale 'scale_g'" in _apart_from(
        nuts, {}, kernels, ["scale_g", "g"]
    )
    assert "declare 'a' apart from the scale 'scale_a'" in _apart_from(nuts, {}, kernels)


def test_the_advice_where_a_scale_is_not_found() -> None:
    """The exponential of a number is no power of it: effects hang on it all the same."""
    net = bmc.BayesNet(plates={"i": 6})
    net.add("log_sd", bmc.Normal(0.0, 3.0))
    net.add("b", lambda log_sd: bmc.Normal(0.0, np.exp(log_sd)), plates="i")
    net.add("y", lambda b: bmc.Normal(b, 3.0), plates="i")
    engine = bmc.HamiltonianMonteCarlo(200, warmup=100, target_accept=0.4)
    _, told = infer(net, {"y": np.linspace(-2, 2, 6)}, engine=engine)
    (words,) = [t for t in told if "diverged" in t]
    assert "declare effects apart from their scale (z ~ Normal(0, 1), b = sigma * z)" in words
