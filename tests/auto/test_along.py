"""Which models ``engine=None`` answers along trajectories, and that it says so."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.auto import along
from bayesmc.auto.along import along_trajectories
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.lowering import machine
from bayesmc.network import pose
from bayesmc.structure import compiled_density

pytest.importorskip("llvmlite", reason="llvmlite is not installed")

TRIALS = np.tile([6, 9, 12, 7], 20)
DIED = np.tile([0, 3, 2, 5, 1], 16)


def litters(rows: int = 80, label: bool = False, closed: bool = False) -> Any:
    """Counts of litters, whose logits (or shares) are alike."""
    net, trials = bmc.BayesNet(plates={"litter": rows}), TRIALS[:rows]
    net.add("mean", bmc.Normal(0.0, 3.0))
    net.add("sd", bmc.HalfNormal(2.0))
    if label:
        net.add("kind", bmc.Bernoulli(0.4))
        net.add("own", lambda mean, sd, kind: bmc.Normal(mean + kind, sd), plates="litter")
    else:
        net.add("own", lambda mean, sd: bmc.Normal(mean, sd), plates="litter")
    if closed:
        net.add("died", lambda own: bmc.Normal(own, 1.0), plates="litter")
    else:
        net.add("died", lambda own: bmc.Binomial(trials, logits=own), plates="litter")
    return net, {"died": DIED[:rows]}


def chosen(net: bmc.BayesNet, evidence: Any) -> Any:
    problem = pose(net, evidence)
    return along_trajectories(problem, plan_of(problem))


def test_many_numbers_without_a_closed_form() -> None:
    engine, why = chosen(*litters())
    assert isinstance(engine, bmc.HamiltonianMonteCarlo)
    assert why.startswith("81 of 82 numbers have no closed form")
    told = bmc.explain(*litters())
    assert isinstance(told.engine, bmc.HamiltonianMonteCarlo)
    assert "slice (2)" in told.refused["Gibbs"]
    assert "trajectories in machine code" in told.effort


@pytest.mark.parametrize("options", [{"rows": 20}, {"label": True}, {"closed": True}])
def test_others_are_swept_over(options: dict[str, Any]) -> None:
    """Few numbers, finite nodes beside them, closed forms."""
    assert chosen(*litters(**options)) is None


def splines(knots: int, rows: int = 60) -> Any:
    """Mean and log scale on bases: the mean's numbers have a closed form given the scale's."""
    at = np.arange(1, knots + 1)
    x = np.linspace(0.0, 1.0, rows)
    basis = np.cos(np.pi * x[:, None] * at) / at
    net = bmc.BayesNet(plates={"row": rows, "knot": knots})
    net.add("sd", bmc.HalfNormal(5.0))
    for name in ("mean", "scale"):
        net.add(f"{name}_z", bmc.Normal(0.0, 1.0), plates="knot")
    net.add("mean", lambda mean_z: np.vecdot(basis, mean_z.array), plates="row")
    net.add("scale", lambda scale_z, sd: np.exp(sd * np.vecdot(basis, scale_z.array)), plates="row")
    net.add("y", lambda mean, scale: bmc.Normal(mean, scale), plates="row")
    return net, {"y": np.sin(6 * x) + x * np.cos(40 * x)}


def test_blocks_beside_what_they_hang_on() -> None:
    """All numbers together cost what a block costs; a model that is one block is left to Gibbs."""
    engine, why = chosen(*splines(40))
    assert isinstance(engine, bmc.HamiltonianMonteCarlo)
    assert why.startswith("41 of 81 numbers") and "hang together" in why
    assert chosen(*splines(20)) is None


def test_blocks_beside_what_has_nothing_to_do_with_them() -> None:
    net, evidence = litters(rows=80, closed=True)
    net.add("a", bmc.LogNormal(0.0, 1.0))
    net.add("b", bmc.LogNormal(0.0, 1.0))
    net.add("y", lambda a, b: bmc.Normal(a * b, 1.0))
    assert chosen(net, {**evidence, "y": 2.0}) is None


def test_numpy_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (machine, compiled_density):
        monkeypatch.setattr(module, "is_available", lambda: False)
    assert chosen(*litters()) is None


def test_what_is_too_large_is_not_even_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(along, "_LARGEST", 70)
    net, evidence = litters()
    monkeypatch.setattr(bmc.HamiltonianMonteCarlo, "refusal", lambda *_: pytest.fail("asked"))
    assert chosen(net, evidence) is None


def test_means_are_those_of_gibbs() -> None:
    """Two engines at 4.9 joint errors for 82 numbers: 1e-4 of false alarms."""
    net, evidence = litters()
    swept = bmc.infer(net, evidence, engine=bmc.Gibbs(ess=400), rng=0)
    followed = bmc.infer(net, evidence, rng=0)
    assert isinstance(followed.engine, bmc.HamiltonianMonteCarlo)
    for name in ("mean", "sd", "own"):
        error = np.hypot(swept.mcse(name), followed.mcse(name))
        assert np.abs((swept.mean(name) - followed.mean(name)) / error).max() < 4.9
