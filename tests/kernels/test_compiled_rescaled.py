"""Scales moved with what they scale in machine code: where NumPy moves them, invariant, and left where not.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; each is shown to fail
on a kernel with a deliberate error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import DensityError
from bayesmc.kernels.base import How
from bayesmc.kernels.compiled_slice import CompiledMoves
from bayesmc.kernels.rescaled import Rescaled, rescaled_kernels
from bayesmc.lowering import is_available
from bayesmc.lowering import slices as machine
from bayesmc.network import pose
from bayesmc.structure.orbit import Orbit
from bayesmc.structure.target import target_of
from tests.kernels.invariance import Case, Make, Model, each_test, running
from tests.kernels.test_rescaled import CASES, hierarchy
from tests.mutants.faults import Edit

pytestmark = pytest.mark.skipif(not is_available(), reason="machine code needs llvmlite")

ORBIT = "bayesmc.structure.orbit:"
VOLUME = Edit(f"{ORBIT}Orbit.__init__", "float(power + numbers)", "float(power + numbers - 1)")
CARRIED = Edit(f"{ORBIT}_where_it_stays", "if not centre.leaves & moved.keys():", "if True:")


def shift() -> bmc.BayesNet:
    """Above a scale of 1 the effects lie elsewhere."""
    return hierarchy(bmc.Uniform(0.0, 3.0), lambda m, s: bmc.Normal(m + 1.5 * (s > 1.0), s))


def made(name: str, power: int, fault: Edit | None = None) -> Make:
    def make(target: Any) -> Rescaled:
        kernel = Rescaled(target, name, ("b",), power, how=How(True))
        if fault is not None:
            with fault.planted():
                assert isinstance(kernel._orbit, Orbit)
        kernel.expect(1000, 100)
        assert isinstance(kernel._code, CompiledMoves), kernel._code
        kernel._code.is_checked = True  # who compares would see the fault first
        return kernel

    return make


MACHINE = {
    "precision": Case(
        CASES["precision"].model, made("s", -2), {"flat": made("s", -2, VOLUME)}, how="moving",
        sizes={"draws": 12},
    ),
    "scale": Case(
        CASES["scale"].model, made("s", 1), {"flat": made("s", 1, VOLUME)}, how="moving",
        sizes={"draws": 12},
    ),
    "shift": Case(
        Model(shift(), ("y",)), made("s", 1), {"carried": made("s", 1, CARRIED)}, how="moving",
        sizes={"draws": 20, "chains": 1000},
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "fault", "test"), each_test(MACHINE))
def test_kernel(name: str, fault: str, test: str) -> None:
    MACHINE[name].check(test, fault)


def vectors() -> bmc.BayesNet:
    """Vectors in a plate, about means of their own, some of whose readings are missing."""
    scales = np.array([1.0, 0.6])
    x = np.array([0.2, -1.0, 0.4])
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("s", bmc.LogNormal(0.0, 0.5))
    net.add(
        "b",
        lambda m, s: bmc.MvNormal(
            bmc.stack([m * x, -m * x], axis=-1), scale_diag=s[..., None] * scales
        ),
        plates="i",
    )
    net.add("y", lambda b: bmc.Poisson(np.exp(np.clip(b[..., 0] - b[..., 1], -5, 3))), plates="i")
    return net


NETS: dict[str, Callable[[], bmc.BayesNet]] = {
    "precision": lambda: hierarchy(bmc.Gamma(2.0, 1.0), lambda m, s: bmc.Laplace(m, s**-0.5)),
    "shift": shift,
    "vectors": vectors,
}
POWERS = {"precision": -2, "shift": 1, "vectors": 1}


def moved(name: str, steps: int = 8, **has: Any) -> Any:
    """A kernel, the values after some steps, and its memory."""
    net = NETS[name]()
    target = target_of(pose(net, {"y": [0.0, np.nan, 3.0]}))
    kernel = Rescaled(
        target, "s", ("b",), POWERS[name], how=How(True, has.pop("threads", 1)), **has
    )
    draws = net.sample(40, rng=1)
    values = {**target.known, **{n: draws[n] for n in target.chain}}
    rng = np.random.default_rng(2)
    kernel.expect(1000, 40)
    with running():
        memory = kernel.start(values, 40)
        for _ in range(steps):
            new, memory = kernel.step(values, memory, rng, True)
            values = {**values, **new}
    return kernel, values, memory


@pytest.mark.parametrize("name", NETS)
def test_moves_are_those_of_numpy(name: str) -> None:
    """All of them, as ``debug`` compares each with the model's functions; threads change nothing."""
    kernel, values, memory = moved(name, debug=True)
    assert memory["machine"] and isinstance(kernel._code, CompiledMoves)
    _, others, _ = moved(name, threads=3)
    for node in kernel.names:
        np.testing.assert_array_equal(values[node], others[node])


@pytest.mark.parametrize("fault", [VOLUME, CARRIED], ids=["volume", "centres"])
def test_faults_are_seen_before_the_first_use(fault: Edit) -> None:
    with fault.planted():
        kernel, _, memory = moved("shift", 2)
    assert not memory["machine"] and "ends at" in kernel._code.differs


def test_debug_says_what_differs(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = machine.Slices.move

    def wrong(self: Any, value: np.ndarray, *args: Any) -> np.ndarray:
        told = honest(self, value, *args)
        value += 0.01
        return told

    monkeypatch.setattr(machine.Slices, "move", wrong)
    with pytest.raises(DensityError, match="nodes 's', 'b': a slice of chain 0 .* ends at"):
        moved("precision", 1, debug=True)


def test_what_has_no_centre_is_left_to_numpy() -> None:
    net = hierarchy(bmc.Gamma(2.0, 1.0), lambda m, s: bmc.StudentT(4.0, m, 1 / s))
    (kernel,) = rescaled_kernels(target_of(pose(net, {"y": [0, 3, 1]})), ("b",), how=How(True))
    assert "the centre of node 'b' is no location" in kernel.told(1000, 10)
    kernel.expect(1000, 10)
    values = net.sample(10, rng=1)
    assert not kernel.start({n: values[n] for n in ("m", "s", "b")}, 10)["machine"]


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_a_resumed_run_draws_the_same() -> None:
    def run(draws: int, resume: Any = None, **has: Any) -> Any:
        engine = bmc.Gibbs(draws=draws, warmup=40, chains=6, **has)
        net = bmc.BayesNet(plates={"g": 30})
        net.add("m", bmc.Normal(0.0, 2.0))
        net.add("tau", bmc.Gamma(1.0, 1.0))
        net.add("b", lambda m, tau: bmc.Normal(m, tau**-0.5), plates="g")
        net.add("r", lambda b: bmc.Binomial(20, logits=b), plates="g")
        seen = {"r": np.arange(30) % 15}
        return net, bmc.infer(net, seen, engine=engine, rng=5, resume=resume)

    net, whole = run(20, compiled=True)
    net, first = run(9, compiled=True)
    engine = bmc.Gibbs(draws=11, warmup=40, chains=6, compiled=True)
    rest = bmc.infer(net, {"r": np.arange(30) % 15}, engine=engine, rng=5, resume=first)
    for name in ("tau", "b"):
        np.testing.assert_array_equal(whole[name], rest[name])
    said = str(bmc.explain(net, {"r": np.arange(30) % 15}, engine=engine))
    assert said.count("; in machine code") == 2
