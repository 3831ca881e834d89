"""Log densities in machine code: equal to NumPy's, checked before use, with an address."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import Program
from bayesmc.lowering import compiled, machine, writer
from bayesmc.lowering.checked import Compared
from bayesmc.network import pose
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import UnconstrainedDensity, unconstrained_density
from bayesmc.testing import session
from bayesmc.testing.makers.gaussians import gaussian_evidence, random_gaussian_net
from bayesmc.testing.makers.nets import random_net
from bayesmc.testing.makers.observing import random_evidence
from tests.passes.test_log_density import FAMILIES
from tests.structure.test_unconstrained import over_family

pytest.importorskip("llvmlite", reason="llvmlite is not installed")

MANY = 100_000


def schools() -> UnconstrainedDensity:
    net = bmc.BayesNet(plates={"school": 8})
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="school")
    sd = np.array([15.0, 10, 16, 11, 9, 11, 10, 18])
    net.add("y", lambda theta: bmc.Normal(theta, sd), plates="school")
    y = [28.0, 8, -3, 7, -1, 1, 18, 12]
    return unconstrained_density(target_of(pose(net, {"y": y})))


def growth(masked: bool = True) -> UnconstrainedDensity:
    """Rats whose weights are partly missing."""
    rng, week = np.random.default_rng(0), np.arange(5.0) - 2
    net = bmc.BayesNet(plates={"rat": 12, "week": 5})
    net.add("level", bmc.Normal(0.0, 10.0))
    net.add("scale", bmc.Gamma(2.0, 1.0))
    net.add("start", lambda level, scale: bmc.Normal(level, scale), plates="rat")
    net.add("slope", bmc.StudentT(4.0, 0.0, 2.0), plates="rat")
    net.add(
        "y",
        lambda start, slope, scale: bmc.Normal(start + slope * week, scale),
        plates=("rat", "week"),
    )
    y = rng.normal(size=(12, 5)) * 3
    if masked:
        y[rng.random(y.shape) < 0.3] = np.nan
    return unconstrained_density(
        target_of(pose(net, {"y": y})), ["level", "scale", "start", "slope"]
    )


def labelled() -> UnconstrainedDensity:
    """Means of components given the labels of points, which are leaves."""
    rng = np.random.default_rng(0)
    net = bmc.BayesNet(plates={"component": 3, "point": 30})
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.Normal(0.0, 5.0), plates="component")
    net.add("sd", bmc.LogNormal(0.0, 1.0), plates="component")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean, sd: bmc.Normal(mean[label], sd[label]), plates="point")
    return unconstrained_density(
        target_of(pose(net, {"x": rng.normal(size=30)})), ["weights", "mean", "sd"]
    )


def regression() -> UnconstrainedDensity:
    rng = np.random.default_rng(0)
    design = rng.normal(size=(100, 4))
    net = bmc.BayesNet(plates={"row": 100, "group": 6})
    group = rng.integers(6, size=100)
    net.add("beta", bmc.MvNormal(np.zeros(4), np.eye(4) * 4.0))
    net.add("shape", bmc.Exponential(1.0))
    net.add("effect", bmc.Normal(0.0, 1.0), plates="group")
    net.add(
        "y",
        lambda beta, effect: bmc.Poisson(np.exp(0.3 * np.vecdot(design, beta) + effect[group])),
        plates="row",
    )
    net.add("z", lambda shape: bmc.Gamma(shape, 1.0), plates="group")
    data = {"y": rng.poisson(2.0, size=100), "z": rng.gamma(2.0, size=6)}
    return unconstrained_density(target_of(pose(net, data)))


MODELS = {"schools": schools, "growth": growth, "labelled": labelled, "regression": regression}


def others_of(density: UnconstrainedDensity, batch: tuple[int, ...]) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    return (
        {"label": rng.integers(3, size=(*batch, 30)).astype(np.uint8)}
        if "weights" in density.names
        else {}
    )


@pytest.mark.parametrize("name", MODELS)
def test_it_equals_numpy(name: str) -> None:
    density = MODELS[name]()
    fast = in_machine_code(density, MANY, debug=True)
    assert fast.code == "machine code"
    rng = np.random.default_rng(1)
    for batch in ((), (1,), (16,), (2, 5)):
        u = rng.normal(size=(*batch, density.size))
        for others in (others_of(density, ()), others_of(density, batch)):
            value, slopes = fast.with_gradient(u, others)
            wanted, gradient = density.with_gradient(u, others)
            np.testing.assert_allclose(value, wanted, rtol=1e-11)
            np.testing.assert_allclose(
                slopes, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max()
            )
            np.testing.assert_allclose(fast.value(u, others), wanted, rtol=1e-11)


def test_far_out_it_is_minus_infinity_as_in_numpy() -> None:
    density = growth()
    fast = in_machine_code(density, MANY)
    u = np.random.default_rng(0).normal(size=(40, density.size)) * np.logspace(0, 4, 40)[:, None]
    value, slopes = fast.with_gradient(u)
    wanted, gradient = density.with_gradient(u)
    np.testing.assert_array_equal(np.isfinite(value), np.isfinite(wanted))
    finite = np.isfinite(wanted)
    np.testing.assert_allclose(value[finite], wanted[finite], rtol=1e-11)
    np.testing.assert_allclose(slopes, gradient, rtol=1e-8, atol=1e-8 * np.abs(gradient).max())


def test_the_same_point_gives_the_same_bits_in_any_batch() -> None:
    density = in_machine_code(growth(), MANY)
    u = np.random.default_rng(0).normal(size=(37, density.size))
    together = density.with_gradient(u)
    for k in (0, 5, 36):
        alone = density.with_gradient(u[k])
        assert alone[0] == together[0][k]
        np.testing.assert_array_equal(alone[1], together[1][k])


def test_a_short_question_compiles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    machine.loaded.cache_clear()
    monkeypatch.setattr(machine, "Loaded", lambda *a: pytest.fail("compiled"))
    fast = in_machine_code(schools(), 100)
    assert fast.code.startswith("NumPy: 100 gradients")
    fast.with_gradient(np.zeros(fast.size))


def test_without_a_compiler_it_is_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    machine.is_available.cache_clear()
    monkeypatch.setattr(machine.importlib.util, "find_spec", lambda name: None)
    try:
        fast = in_machine_code(schools(), MANY)
        assert "bayesmc[fast]" in fast.code
        fast.with_gradient(np.zeros(fast.size))
        with pytest.raises(TraceError, match="no address"):
            fast.bound()
    finally:
        machine.is_available.cache_clear()


def test_its_address_is_a_function_in_c() -> None:
    density = in_machine_code(growth(), MANY)
    bound = density.bound()
    pointer = ctypes.POINTER(ctypes.c_double)
    function = ctypes.CFUNCTYPE(
        ctypes.c_int32, ctypes.c_int64, pointer, pointer, pointer, ctypes.c_void_p
    )(bound.address)
    u = np.random.default_rng(0).normal(size=(3, density.size))
    value, slopes = np.empty(3), np.empty((3, density.size))
    arrays = [a.ctypes.data_as(pointer) for a in (u, value, slopes)]
    assert function(3, *arrays, bound.arguments) == 0
    wanted = density.with_gradient(u)
    np.testing.assert_array_equal(value, wanted[0])
    np.testing.assert_array_equal(slopes, wanted[1])


def test_an_address_with_other_nodes_given() -> None:
    density = in_machine_code(labelled(), MANY)
    others = others_of(density, ())
    bound = density.bound(others)
    pointer = ctypes.POINTER(ctypes.c_double)
    kind = ctypes.CFUNCTYPE(
        ctypes.c_int32, ctypes.c_int64, pointer, pointer, pointer, ctypes.c_void_p
    )
    u = np.random.default_rng(0).normal(size=(2, density.size))
    value, slopes = np.empty(2), np.empty((2, density.size))
    arrays = [a.ctypes.data_as(pointer) for a in (u, value, slopes)]
    assert kind(bound.address)(2, *arrays, bound.arguments) == 0
    np.testing.assert_allclose(value, density.with_gradient(u, others)[0], rtol=1e-13)


def test_log_density_hands_out_its_address() -> None:
    net = bmc.BayesNet(plates={"day": 3})
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("count", lambda rate: bmc.Poisson(rate), plates="day")
    plain = bmc.log_density(net, {"count": [3, 1, 4]})
    fast = bmc.log_density(net, {"count": [3, 1, 4]}, compiled=True)
    assert plain.address is None and plain.arguments is None
    assert fast.address and fast.arguments
    u = np.linspace(-2, 2, 5)[:, None]
    for a, b in zip(fast(u), plain(u), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    pointer = ctypes.POINTER(ctypes.c_double)
    kind = ctypes.CFUNCTYPE(
        ctypes.c_int32, ctypes.c_int64, pointer, pointer, pointer, ctypes.c_void_p
    )
    value, slopes = np.empty(5), np.empty((5, 1))
    arrays = [a.ctypes.data_as(pointer) for a in (u, value, slopes)]
    assert kind(fast.address)(5, *arrays, fast.arguments) == 0
    np.testing.assert_array_equal(value, fast(u)[0])
    with pytest.raises(UnsupportedError, match="no machine code"):
        net, factor = bmc.BayesNet(), np.eye(50) + 0.1 * np.eye(50, k=-1)
        net.add("s", bmc.Exponential(1.0))
        net.add("y", lambda s: bmc.MvNormal(np.zeros(50), scale_tril=s[..., None, None] * factor))
        bmc.log_density(net, {"y": np.ones(50)}, compiled=True)


def same_far_out(density: UnconstrainedDensity) -> bool:
    """Whether machine code agrees wherever it is asked; false where there is none."""
    fast = in_machine_code(density, MANY, debug=True)
    if fast.code != "machine code":
        assert "no machine code" in fast.code
        return False
    if not density.others:
        u = (
            np.random.default_rng(0).normal(size=(20, density.size))
            * np.linspace(0, 6, 20)[:, None]
        )
        found, wanted = fast.with_gradient(u)[0], density.with_gradient(u)[0]
        np.testing.assert_array_equal(np.isfinite(found), np.isfinite(wanted))
    return True


def test_every_family() -> None:
    densities = [over_family(name, True) for name in FAMILIES]
    assert sum(map(same_far_out, densities)) >= len(densities) - 1


@pytest.mark.parametrize("seed", range(session.seed(), session.seed() + session.scaled(3, 2)))
@pytest.mark.parametrize("kind", ["continuous", "hybrid", "gaussian"])
def test_random_nets(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    if kind == "gaussian":
        net, _ = random_gaussian_net(seed, plates=True, vectors=True)
        evidence = gaussian_evidence(net, rng)
    else:
        net = random_net(
            seed, hybrid=kind == "hybrid", plates=True, continuous=kind == "continuous"
        )
        evidence = random_evidence(net, rng)
    try:
        density = unconstrained_density(target_of(pose(net, evidence)))
    except UnsupportedError:
        return
    same_far_out(density)


# planted faults


def fallen_back(density: UnconstrainedDensity) -> bool:
    fast = in_machine_code(density, MANY)
    u = np.random.default_rng(3).normal(size=(4, density.size))
    others = others_of(density, (4,))
    value, slopes = fast.with_gradient(u, others)
    wanted, gradient = density.with_gradient(u, others)
    np.testing.assert_array_equal(value, wanted)
    np.testing.assert_array_equal(slopes, gradient)
    return fast.code.startswith("NumPy: machine code of")


def test_a_coefficient_that_is_not_broadcast_falls_back(monkeypatch: pytest.MonkeyPatch) -> None:
    made = writer.Writer._picked

    def wrong(self: Any, node: Any, at: Any) -> Any:
        first = tuple(0 if not isinstance(i, int) else i for i in at)
        return made(self, node, first if len(node.operands) == 1 else at)

    monkeypatch.setattr(writer.Writer, "_picked", wrong)
    assert fallen_back(growth())


def test_a_mask_that_is_ignored_is_seen() -> None:
    """Code for data without the holes that these have."""
    whole, holed = growth(masked=False), in_machine_code(growth(), MANY)
    run = compiled([whole.root, whole.slopes])
    run.program = Program([holed.root, holed.slopes])
    with pytest.raises(TraceError, match="machine code of"):
        for values in holed._points():
            Compared(run)(values)


def test_a_stale_constant_falls_back(monkeypatch: pytest.MonkeyPatch) -> None:
    made = writer.Writer._table

    def wrong(self: Any, key: Any, values: np.ndarray, kind: str) -> int:
        return made(self, key, values * 1.001 if kind == "double" else values, kind)

    monkeypatch.setattr(writer.Writer, "_table", wrong)
    for model in MODELS.values():
        assert fallen_back(model())


def test_debug_compares_at_every_call(monkeypatch: pytest.MonkeyPatch) -> None:
    fast = in_machine_code(growth(), MANY, debug=True)
    u = np.zeros((2, fast.size))
    fast.with_gradient(u)
    way = next(iter(fast._both.run._ways.values()))
    way._constants[0][:] += 1.0
    with pytest.raises(TraceError, match="and NumPy"):
        fast.with_gradient(u)
