"""Chains whose gradients are machine code: used where it pays, told by explain, dropped where it differs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.kernels import hamiltonian
from bayesmc.lowering import checked, writer
from bayesmc.structure.compiled_density import CompiledDensity

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
    real = hamiltonian.in_machine_code

    def noted(*args: Any) -> CompiledDensity:
        made.append(real(*args))
        return made[-1]

    with monkeypatch.context() as patch:
        patch.setattr(hamiltonian, "in_machine_code", noted)
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
    net, factor = bmc.BayesNet(), np.array([[1.0, 0.0], [0.5, 1.0]])
    net.add("s", bmc.Exponential(1.0))
    net.add("y", lambda s: bmc.MvNormal(np.zeros(2), scale_tril=s[..., None, None] * factor))
    assert effort(net, {"y": np.ones(2)}, warmup=9000).endswith(
        "gradients in NumPy: inv has no machine code"
    )
