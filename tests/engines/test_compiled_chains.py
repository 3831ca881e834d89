"""Chains whose gradients are machine code: used where it pays, told by explain, dropped where it differs."""

from __future__ import annotations

import os
import pickle
import warnings
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EngineWarning, TraceError
from bayesmc.kernels import moving_density
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.lowering import checked, writer
from bayesmc.lowering.no_u_turn import transitions
from bayesmc.network import pose
from bayesmc.structure.compiled_density import CompiledDensity
from tests.mutants.faults import Edit

pytest.importorskip("llvmlite", reason="llvmlite is not installed")

SD = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])
EVIDENCE = {"y": [28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0]}


def schools() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"school": 8})
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("z", bmc.Normal(0.0, 1.0), plates="school")
    net.add("y", lambda mu, z: bmc.Normal(mu + 4.0 * z, SD), plates="school")
    return net


def run(monkeypatch: pytest.MonkeyPatch, **options: Any) -> tuple[Any, list[CompiledDensity]]:
    made: list[CompiledDensity] = []
    real = moving_density.in_machine_code

    def noted(*args: Any) -> CompiledDensity:
        made.append(real(*args))
        return made[-1]

    with monkeypatch.context() as patch:
        patch.setattr(moving_density, "in_machine_code", noted)
        engine = bmc.HamiltonianMonteCarlo(**{"draws": 1000, "warmup": 400, "chains": 4, **options})
        return bmc.infer(schools(), EVIDENCE, engine=engine, rng=0), made


def test_means_are_the_exact_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checked, "_WORTH", 0.0)
    monkeypatch.setattr(checked, "_ONE", 0.0)
    monkeypatch.setattr(checked, "_PAIR", 0.0)
    found, made = run(monkeypatch)
    assert [density.code for density in made] == ["machine code"]
    exact = bmc.infer(schools(), EVIDENCE, engine=bmc.Exact())
    for name in ("mu", "z"):
        off = (found.mean(name) - exact.mean(name)) / found.mcse(name)
        assert np.abs(off).max() < 5.0  # nine figures: 5e-6 of false alarms
        np.testing.assert_allclose(found.std(name), exact.std(name), rtol=0.15)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_short_warmups_stay_with_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    _, (density,) = run(monkeypatch, draws=20, warmup=20)
    assert density.code == "NumPy: 160 gradients take no time"


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_what_differs_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    options = {"draws": 30, "warmup": 30}
    plain, _ = run(monkeypatch, **options)
    for name in ("_WORTH", "_ONE", "_PAIR"):
        monkeypatch.setattr(checked, name, 0.0)
    made = writer.Writer._table
    monkeypatch.setattr(writer.Writer, "_table", lambda self, key, values, kind: made(
        self, key, values * 1.001 if kind == "double" else values, kind))  # fmt: skip
    found, (density,) = run(monkeypatch, **options)
    assert density.code.startswith("NumPy: machine code of")
    np.testing.assert_array_equal(found["z"], plain["z"])


def test_explain_names_it() -> None:
    def effort(net: bmc.BayesNet, evidence: Any, **options: Any) -> str:
        return bmc.explain(net, evidence, engine=bmc.HamiltonianMonteCarlo(**options)).effort

    assert effort(schools(), EVIDENCE, warmup=2000).endswith("; trajectories in machine code")
    assert "gradients" not in effort(schools(), EVIDENCE, warmup=10)
    net, factor = bmc.BayesNet(), np.eye(50) + 0.1 * np.eye(50, k=-1)
    net.add("s", bmc.Exponential(1.0))
    net.add("y", lambda s: bmc.MvNormal(np.zeros(50), scale_tril=s[..., None, None] * factor))
    assert effort(net, {"y": np.ones(50)}, warmup=9000).endswith(
        "gradients in NumPy: inv of 50 rows has no machine code (48 at most)"
    )


# ---- whole trajectories ------------------------------------------------------------------------------


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is asked is worth a compiler's time."""
    for name in ("_WORTH", "_ONE", "_PAIR"):
        monkeypatch.setattr(checked, name, 0.0)


def answers(net: bmc.BayesNet, evidence: Any, engine: Any, **options: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return bmc.infer(net, evidence, engine=engine, rng=5, **options)


def machine_code_of(net: bmc.BayesNet, evidence: Any, engine: Any) -> list[Hamiltonian]:
    problem = pose(net, evidence)
    kernels = [k for k in engine.sampler(problem).kernels if isinstance(k, Hamiltonian)]
    for kernel in kernels:
        kernel.expect(100, 4)
        assert kernel._moving.compiled is not None
    return kernels


def waves() -> bmc.BayesNet:
    """An angle too large for the machine's own sine in the tails: NumPy tells such leaves."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, b: bmc.Normal(b + np.sin(1e6 * a) * 1e-9, 1.0), plates="i")
    return net


@pytest.mark.usefixtures("at_once")
def test_resumed_trajectories_are_those_of_one_run() -> None:
    half, whole = (bmc.HamiltonianMonteCarlo(n, warmup=60, chains=3) for n in (40, 80))
    assert machine_code_of(schools(), EVIDENCE, half)
    first = pickle.loads(pickle.dumps(answers(schools(), EVIDENCE, half)))
    more = answers(schools(), EVIDENCE, half, resume=first)
    once = answers(schools(), EVIDENCE, whole)
    threads = answers(schools(), EVIDENCE, replace(whole, threads=2))
    for name in ("mu", "z"):
        assert np.array_equal(more[name], once[name])
        assert np.array_equal(threads[name], once[name])


@pytest.mark.usefixtures("at_once")
def test_leaves_that_machine_code_cannot_tell() -> None:
    net, evidence = waves(), {"y": np.array([0.3, 0.1, 1.2])}
    engine = bmc.HamiltonianMonteCarlo(500, warmup=200, chains=8, debug=True)
    assert machine_code_of(net, evidence, engine)
    posterior = answers(net, evidence, engine)
    assert (np.abs(posterior["a"]) > 1.0).mean() > 0.25  # a sine of more than a million
    for name, mean, sd in (("a", 0.0, 1.0), ("b", 0.4, 0.5)):
        assert abs(posterior.mean(name) - mean) < 4.9 * posterior.mcse(name)
        np.testing.assert_allclose(posterior.std(name), sd, rtol=0.15)


@pytest.mark.usefixtures("at_once")
def test_gibbs_moves_beside_them() -> None:
    """Labels that others draw are read where each chain has them; every step is compared."""
    net = bmc.BayesNet(plates={"i": 6})
    net.add("a", bmc.Laplace(0.0, 1.0))
    net.add("b", bmc.Laplace(0.0, 1.0))
    net.add("on", bmc.Bernoulli(0.4), plates="i")
    net.add("y", lambda a, b, on: bmc.Normal(a + b * on, 0.7), plates="i")
    evidence = {"y": np.array([0.1, 1.4, -0.2, 2.2, 0.4, 1.9])}
    engine = bmc.Gibbs(1000, warmup=200, chains=8, debug=True)
    assert [k.given for k in machine_code_of(net, evidence, engine)] == [("on",)]
    found = answers(net, evidence, engine)
    wanted = answers(net, evidence, bmc.LikelihoodWeighting(200_000))
    for name in ("a", "b", "on"):
        error = np.hypot(found.mcse(name), wanted.mcse(name))
        assert np.abs((found.mean(name) - wanted.mean(name)) / error).max() < 4.9


@pytest.fixture
def forgotten() -> Iterator[None]:
    """Machine code with a fault does not outlive its test."""
    yield
    transitions.cache_clear()


@pytest.mark.usefixtures("at_once", "forgotten")
@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_trees_that_differ_are_left_to_numpy() -> None:
    """Said aloud, and part of what a run remembers: going on draws the same numbers."""
    half, whole = (bmc.HamiltonianMonteCarlo(n, warmup=20, chains=3) for n in (20, 40))
    with Edit("bayesmc.lowering.no_u_turn:_Text._leapt", "2.0 * half", "1.9 * half").planted():
        transitions.cache_clear()
        with pytest.warns(EngineWarning, match="'mu', 'z': trajectories go on in NumPy"):
            first = bmc.infer(schools(), EVIDENCE, engine=half, rng=5)
        once = answers(schools(), EVIDENCE, whole)
        with pytest.raises(TraceError, match="in machine code ends at"):
            answers(schools(), EVIDENCE, replace(half, debug=True))
    transitions.cache_clear()
    more = answers(schools(), EVIDENCE, half, resume=first)  # whose machine code would do
    assert np.array_equal(more["z"], once["z"])
    right = answers(schools(), EVIDENCE, whole)
    assert not np.array_equal(once["z"], right["z"])


@pytest.mark.usefixtures("at_once")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_threads_in_a_forked_child() -> None:
    """Threads end with the process that began them; a child begins its own instead of waiting for them."""
    engine = bmc.HamiltonianMonteCarlo(20, warmup=20, chains=4, threads=2)
    here = answers(schools(), EVIDENCE, engine)["z"]
    with get_context("fork").Pool(1) as pool:
        there = pool.apply_async(_drawn_again, (engine,)).get(timeout=60.0)
    assert np.array_equal(here, there)


def _drawn_again(engine: bmc.HamiltonianMonteCarlo) -> np.ndarray:
    return np.asarray(answers(schools(), EVIDENCE, engine)["z"])
