"""Slices in machine code go where those in NumPy go, or are not used.

Statistical tests are Geweke's and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds that
``--bayesmc-seed`` shifts; ``tests/mutants`` plants faults in the machine loop.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions import base
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import DensityError
from bayesmc.expression import elementwise, leaf
from bayesmc.kernels import slice as slices
from bayesmc.kernels.base import How
from bayesmc.kernels.compiled_slice import CompiledSlice, machine_root
from bayesmc.kernels.slice import Slice
from bayesmc.kernels.stacked import Stacked
from bayesmc.lowering import compiled, is_available
from bayesmc.lowering import slices as machine
from bayesmc.lowering.slice_moves import slice_moves
from bayesmc.network import pose
from bayesmc.passes.arithmetic import add
from bayesmc.structure import conditional
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.conditional import Conditional
from bayesmc.structure.stacked import stacks
from bayesmc.structure.target import target_of
from tests.kernels import invariance_models as models
from tests.kernels.invariance import Case, Make, Model, each_test, running
from tests.mutants.faults import Edit

pytestmark = pytest.mark.skipif(not is_available(), reason="machine code needs llvmlite")

RING, NEXT = np.arange(5), (np.arange(5) + 1) % 5
READ = np.array([0, 1, 1, 2, 0, 2])
TIMES = np.linspace(-1.0, 1.0, 120)


def random_net(seed: int) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A hierarchy of random links, supports, gathers and gaps, whose hidden nodes are moved by slices."""
    rng = np.random.default_rng(seed)
    priors = [
        bmc.Laplace(0.0, 1.0), bmc.Gamma(2.0, 2.0), bmc.StudentT(4.0, 0.3, 1.0), bmc.HalfCauchy(1.0),
        bmc.Uniform(-1.0, 2.0), bmc.LogNormal(0.0, 0.7),
    ]  # fmt: skip
    links: list[Callable[[Any], Any]] = [np.tanh, np.abs, lambda v: v**2, lambda v: 0.5 * v]
    link = links[rng.integers(len(links))]
    weights, own = rng.normal(size=6), rng.integers(0, 3, 6)
    net = bmc.BayesNet(plates={"group": 3, "point": 6})
    net.add("a", priors[rng.integers(len(priors))])
    net.add("b", priors[rng.integers(len(priors))], plates="group")
    net.add("s", bmc.LogNormal(0.0, 0.3))
    net.add("w", bmc.Dirichlet(np.ones(3)))
    net.add("k", bmc.Categorical([0.2, 0.3, 0.5]), plates="point")
    net.add("eta", lambda a, b: link(a) + np.sin(b), plates="group")
    net.add("seen", lambda eta, s: bmc.Normal(eta, s), plates="group")
    if rng.random() < 0.5:
        net.add("y", lambda b, k, a: bmc.Laplace(link(b[k]) * weights, 1.0 + a**2), plates="point")
    else:
        net.add("y", lambda b, s: bmc.StudentT(5.0, b[own] * b[READ], s), plates="point")
    data = rng.normal(size=6)
    data[rng.random(6) < 0.3] = np.nan
    groups = rng.normal(size=3)
    groups[0] = np.nan if rng.random() < 0.5 else groups[0]
    return net, {"y": data, "seen": groups, "w": np.ones(3) / 3}


def drawn(net: Any, target: Any, chains: int, seed: int = 1) -> dict[str, np.ndarray]:
    draws = net.sample(chains, rng=seed)
    values = {**target.known, **{n: draws[n] for n in target.chain}}
    for name in target.chain:
        seen = target.seen(name)
        if seen is not None:
            values[name] = np.where(seen.mask, seen.value, values[name])
    with running():
        target.compute(values, target.links)
    return values


@pytest.mark.parametrize("seed", range(24))
def test_conditionals_are_those_of_the_functions(seed: int) -> None:
    net, evidence = random_net(seed)
    target = target_of(pose(net, evidence))
    values, other = drawn(net, target, 9), drawn(net, target, 9, 2)
    asked = 0
    for name in ("a", "b", "s"):
        blanket = Blanket(target, name)
        root, parts = machine_root(Conditional(blanket).root, name)
        assert not parts
        run = compiled([root])
        for members in blanket.classes:
            candidate = blanket.current({**values, name: other[name]}, members)
            with running():
                (found,) = run({**values, name: blanket.filled(values, candidate, members)})
                wanted = blanket.log_density(values, candidate, members)
            found = found.reshape(9, -1)
            found = found if members is None else found[:, members]
            wanted = np.broadcast_to(wanted.reshape(9, -1), found.shape)
            finite = np.isfinite(wanted)
            asked += int(finite.sum())
            np.testing.assert_allclose(found[finite], wanted[finite], rtol=1e-9, atol=1e-9)
            assert not np.isfinite(found[~finite]).any()
    assert asked > 20


def line() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 6, "j": 3})
    net.add("x", bmc.Laplace(0.0, 1.0), plates="i")
    net.add("s", bmc.LogNormal(0.0, 0.5))
    net.add("y", lambda x, s: bmc.StudentT(4.0, np.tanh(x), s), plates=("j", "i"))
    data = np.random.default_rng(0).normal(size=(3, 6))
    data[1, 2] = np.nan
    return net, {"y": data}, "x"


def above_a_bound() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("x", bmc.LogNormal(0.0, 1.0))
    net.add("y", lambda x: bmc.Poisson(x), plates="i")
    return net, {"y": [0, 2, 3, np.nan]}, "x"


def bounds_of_parents() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("top", bmc.Gamma(3.0, 1.0))
    net.add("x", lambda top: bmc.Uniform(0.0, top), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 0.5), plates="i")
    return net, {"y": [0.1, 0.7, 1.2]}, "x"


def integers() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Poisson(4.0), plates="i")
    net.add("y", lambda x: bmc.Binomial(x + 5, 0.4), plates="i")
    return net, {"y": [0, 1, 4]}, "x"


def circle() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.VonMises(3.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x / 3, 0.6), plates="i")
    return net, {"y": [0.1, 0.7, -1.2]}, "x"


def looked_up() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 9, "k": 3})
    net.add("x", bmc.Gamma(3.0, 2.0), plates="k")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("y", lambda x, label: bmc.Weibull(x[label], 1.0), plates="i")
    data = np.random.default_rng(1).gamma(2.0, 1.0, 9)
    data[3] = np.nan
    return net, {"y": data}, "x"


def vectors() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 9, "k": 2})
    net.add("x", bmc.Joint(bmc.Normal(0.0, 1.0), bmc.Uniform(0.0, 2.0)), plates="k")
    net.add("label", bmc.Categorical([0.4, 0.6]), plates="i")
    net.add(
        "y",
        lambda x, label: bmc.Normal(x[label][..., 0] * x[label][..., 1], 0.8),
        plates="i",
    )
    return net, {"y": np.random.default_rng(1).normal(size=9)}, "x"


def in_turn() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 5, "k": 5})
    net.add("x", bmc.Laplace(0.0, 1.0), plates="k")
    net.add("y", lambda x: bmc.Normal(x[RING] * x[NEXT], 1.0), plates="i")
    return net, {"y": [1.0, np.nan, 3.0, 1.0, 4.0]}, "x"


def all_together() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 3, "k": 4})
    net.add("x", bmc.Laplace(0.0, 1.0), plates="k")
    net.add("total", lambda x: np.exp(x).sum("k"))
    net.add("y", lambda total: bmc.Normal(total, 1.0), plates="i")
    return net, {"y": [3.0, 5.0, 6.0]}, "x"


def in_order() -> tuple[bmc.BayesNet, Any, str]:
    """Numbers of which the smallest and the largest are read."""
    net = bmc.BayesNet(plates={"i": 4, "k": 3})
    net.add("x", bmc.Laplace(0.0, 1.0), plates="k")
    net.add("sorted", lambda x: np.sort(x.array, axis=-1))
    net.add("y", lambda sorted: bmc.Normal(sorted[..., 0] * 2 - sorted[..., 2], 1.0), plates="i")
    return net, {"y": [3.0, np.nan, -6.0, 1.0]}, "x"


def partly_seen() -> tuple[bmc.BayesNet, Any, str]:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("x", bmc.Laplace(0.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(np.sin(x), 0.3), plates="i")
    return net, {"x": [np.nan, 1.0, np.nan, 2.0], "y": [0.1, 0.2, 0.8, 0.4]}, "x"


def heavy() -> tuple[bmc.BayesNet, Any, str]:
    """Much that does not depend on what moves: NumPy makes it once for every move."""
    net = bmc.BayesNet(plates={"i": 120})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.add("curve", lambda a, b: np.exp(np.sin(a * TIMES) * b), plates="i")
    net.add("y", lambda x, curve: bmc.StudentT(4.0, x * curve, 1.0), plates="i")
    return net, {"y": np.sin(TIMES)}, "x"


MODELS = [
    line, above_a_bound, bounds_of_parents, integers, circle, looked_up, vectors, in_turn, all_together,
    in_order, partly_seen, heavy,
]  # fmt: skip


def moved(model: Any, how: How, steps: int = 6, chains: int = 50, **has: Any) -> Any:
    """A kernel, the values after some steps of warmup, and its memory."""
    net, evidence, name = model()
    target = target_of(pose(net, evidence))
    kernel = Slice(Blanket(target, name), how=how, **has)
    values, rng = drawn(net, target, chains), np.random.default_rng(3)
    kernel.expect(1000, chains)
    with running():
        memory = kernel.start(values, chains)
        for _ in range(steps):
            new, memory = kernel.step(values, memory, rng, True)
            values = {**values, **new}
            target.refresh(values, [name])
    return kernel, values, memory


@pytest.mark.parametrize("model", MODELS)
def test_moves_are_those_of_numpy(model: Any) -> None:
    """Every one of some steps, as ``debug`` compares them all with the model's functions."""
    kernel, values, memory = moved(model, How(True), debug=True)
    assert memory["machine"] and isinstance(kernel._code, CompiledSlice)
    name = kernel.names[0]
    assert values[name].dtype == moved(model, How(False), 1)[1][name].dtype
    if model is partly_seen:
        assert (values["x"][:, 1] == 1.0).all() and (values["x"][:, 3] == 2.0).all()


def test_what_does_not_move_is_computed_once() -> None:
    kernel, _, _ = moved(heavy, How(True), 1)
    assert len(machine_root(kernel._followed.root, "x")[1]) == 1
    assert not machine_root(moved(line, How(True), 1)[0]._followed.root, "x")[1]


@pytest.mark.parametrize("model", [line, in_turn, looked_up])
def test_threads_change_nothing(model: Any) -> None:
    _, one, _ = moved(model, How(True, 1))
    _, three, _ = moved(model, How(True, 3))
    np.testing.assert_array_equal(one["x"], three["x"])
    _, few, _ = moved(model, How(True, 3), chains=2)
    _, same, _ = moved(model, How(True, 1), chains=2)
    np.testing.assert_array_equal(few["x"], same["x"])


@pytest.mark.parametrize("model", [line, looked_up, in_turn, all_together, vectors])
def test_functions_are_asked_for_one_chain(model: Any) -> None:
    kernel, values, _ = moved(model, How(True), 3)
    blanket, value = kernel.blanket, values["x"]
    with running():
        wanted = np.zeros((50, blanket.size))
        for members in blanket.classes:
            at = slice(None) if members is None else members
            own = blanket.current(values, members)
            log = blanket.log_density(values, own, members).reshape(50, -1)
            wanted[:, at] = log
        for chain in (0, 17, 49):
            found = kernel._asked(values, chain, value[chain])
            np.testing.assert_allclose(found, wanted[chain], rtol=1e-9)


def test_functions_are_asked_where_earlier_elements_have_moved() -> None:
    """A square root of a negative number is asked of the model; every move is compared with NumPy's."""
    first, after = np.arange(6), (np.arange(6) + 1) % 6
    net = bmc.BayesNet(plates={"i": 6, "k": 6})
    net.add("x", bmc.Normal(0.0, 1.5), plates="k")
    net.add(
        "y",
        lambda x: bmc.Normal(x[after] * np.where(x[first] > 0, 1.0, -0.5), np.sqrt(x[first] + 2.0)),
        plates="i",
    )
    engine = bmc.Gibbs(20, warmup=20, chains=4, compiled=True, debug=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bmc.infer(net, {"y": [0.0, 1.0, 0.0, 0.5, -0.5, 1.5]}, engine=engine, rng=1)


def walk() -> tuple[Stacked, Any, dict[str, np.ndarray]]:
    """Steps of an unrolled walk, every other of which moves at once, with data of their own."""
    net = bmc.BayesNet()
    net.add("s", bmc.LogNormal(0.0, 0.3))
    net.add("x[0]", bmc.Laplace(0.0, 1.0))
    for t in range(1, 13):
        parents = [f"x[{t - 1}]", "s"]
        net.add(f"x[{t}]", lambda x, s: bmc.Laplace(0.8 * x, s), parents=parents)
        net.add(f"y[{t}]", lambda x: bmc.Poisson(np.exp(x)), parents=[f"x[{t}]"])
    target = target_of(pose(net, {f"y[{t}]": t % 4 for t in range(1, 13)}))
    blankets = {name: Blanket(target, name) for name in target.chain}
    (stack, *_), _ = stacks(target, blankets, target.chain)
    kernel = Stacked(stack, partial(Slice, debug=True, how=How(True, 2), reads_data=True))
    return kernel, target, drawn(net, target, 30)


def test_like_nodes_move_as_in_numpy() -> None:
    kernel, target, values = walk()
    kernel.expect(1000, 30)
    assert kernel.told(1000, 30) == "in machine code"
    rng = np.random.default_rng(4)
    with running():
        memory = kernel.start(values, 30)
        for _ in range(6):  # ``debug`` compares them all
            new, memory = kernel.step(values, memory, rng, True)
            values = {**values, **new}
        assert memory["machine"] and memory["width"].shape == (len(kernel.names),)
        inner: Any = kernel.kernel
        state = kernel.stack.gathered(values)
        name = kernel.stack.one.name
        wanted = kernel.stack.one.log_density(state, state[name])
        for row in (0, 7, 30 * len(kernel.names) - 1):
            chain, member = divmod(row, len(kernel.names))
            found = inner._asked(state, row, state[name][chain, member])
            np.testing.assert_allclose(found, wanted[chain, member], rtol=1e-9)


def test_functions_are_asked_as_in_the_thread_that_began() -> None:
    """What is asked of Python from other threads heeds ``np.errstate`` and ``marking_invalid``, too."""
    x = leaf("x", ())
    root = elementwise(np.multiply, elementwise(np.log, elementwise(np.minimum, x, -1.0)), 1.0)
    one = np.zeros(1, int)
    slices = machine.Slices(root, "x", machine.Turns([one], [one], ["real"], [8]))
    seen: list[tuple[int, str, bool]] = []

    def ask(chain: int, value: np.ndarray) -> np.ndarray:
        seen.append((threading.get_ident(), np.geterr()["divide"], base._mark_invalid.get()))
        return -0.5 * value**2

    ends, seeds = np.full((6, 1), np.inf), np.arange(1, 25, dtype=np.uint64).reshape(6, 1, 4) << 40
    value = np.zeros(6)
    with running(), np.errstate(divide="print"):
        slices.move(value, np.ones((6, 1)), -ends, ends, seeds, {}, ask, 3)
    assert (value != 0).all()
    assert {s[0] for s in seen} - {threading.get_ident()}
    assert {s[1:] for s in seen} == {("print", True)}


# ---- invariance --------------------------------------------------------------------------------------


def made(model: Model, name: str = "x", breaks: Callable[[Slice], None] | None = None) -> Make:
    """Slices in machine code, whose first move nobody compares."""

    def make(target: Any) -> Slice:
        kernel = Slice(Blanket(target, name), how=How(True))
        if breaks is not None:
            breaks(kernel)
        kernel.expect(1000, 100)
        assert isinstance(kernel._code, CompiledSlice), kernel._code
        kernel._code.is_checked = True
        return kernel

    return make


def _backwards(make: Make, target: Any, memory: Any) -> Any:
    kernel: Any = make(target)
    kernel.blanket.classes = kernel.blanket.classes[::-1]
    kernel.components = kernel.components[::-1]
    kernel._code.is_checked = True
    return kernel, memory


def _twice_its_prior(kernel: Slice) -> None:
    """A full conditional with the node's own density counted twice."""
    found = kernel._followed
    assert isinstance(found, Conditional)
    own = found.terms[0].expression
    assert own is not None
    found.root = add(found.root, own)


TWICE = "its prior twice"
WARM = {"warmup": 20, "pilots": 100, "how": "moving"}
CASES = {
    name: Case(
        model, made(model, node), {TWICE: made(model, node, _twice_its_prior)}, _backwards, **WARM
    )
    for name, model, node in (
        ("line", models.line(), "x"),
        ("half line", models.half_line(), "x"),
        ("bounded", models.bounded(), "x"),
        ("circle", models.circle(), "x"),
        ("integers", models.integers(), "x"),
        ("components", models.pairs(), "x"),
    )
}


@pytest.mark.parametrize(("name", "fault", "test"), each_test(CASES))
def test_invariant(name: str, fault: str, test: str) -> None:
    CASES[name].check(test, fault)


# ---- what is no number, and what differs --------------------------------------------------------------


def test_functions_say_what_machine_code_cannot() -> None:
    """A log density that is NaN somewhere, where the model's function raises."""
    net = bmc.BayesNet()
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.potential("spike", lambda x: -np.log(np.maximum(np.abs(x - 9.0) - 1.0, 0.0)))
    target = target_of(pose(net, {}))
    kernel = Slice(Blanket(target, "x"), how=How(True))
    kernel.expect(1000, 64)
    values = {"x": np.full(64, 7.5)}
    memory = kernel.start(values, 64)
    assert memory["machine"]
    with pytest.raises(DensityError, match="spike"), running():
        for seed in range(20):
            kernel.step(values, memory, np.random.default_rng(seed), True)


def test_where_the_density_is_zero() -> None:
    net, evidence, _ = above_a_bound()
    target = target_of(pose(net, evidence))
    kernel = Slice(Blanket(target, "x"), how=How(True))
    kernel.expect(1000, 3)
    values = {**target.known, "x": np.array([1.0, -1.0, 2.0])}
    memory = kernel.start(values, 3)
    with pytest.raises(DensityError, match="node 'x': the density is zero"), running():
        kernel.step(values, memory, np.random.default_rng(0), True)


def test_functions_are_asked_only_where_there_is_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel, values, memory = moved(line, How(True), 1)

    def called(*args: Any) -> Any:
        raise AssertionError("the model's functions were asked")

    monkeypatch.setattr(Blanket, "log_density", called)
    with running():
        kernel.step(values, memory, np.random.default_rng(0), False)


def _one_off(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = machine.Slices.move

    def wrong(self: Any, value: np.ndarray, *args: Any) -> np.ndarray:
        told = honest(self, value, *args)
        value.reshape(-1)[0] += 0.01
        return told

    monkeypatch.setattr(machine.Slices, "move", wrong)


def test_what_differs_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    _one_off(monkeypatch)
    kernel, values, memory = moved(line, How(True), 3)
    assert not memory["machine"] and "ends at" in kernel._code.differs
    # once more, in a run that knows it before
    again = _again(kernel, 3)
    np.testing.assert_allclose(again["x"], values["x"], rtol=1e-9)


def _again(kernel: Slice, steps: int) -> Any:
    """The run of ``moved`` by a kernel that was in one before."""
    net, evidence, _ = line()
    values, rng = drawn(net, kernel.blanket.target, 50), np.random.default_rng(3)
    with running():
        memory = kernel.start(values, 50)
        for _ in range(steps):
            new, memory = kernel.step(values, memory, rng, True)
            values = {**values, **new}
    return values


CODE = "bayesmc.lowering.slice_moves:"
SUMS = "bayesmc.structure.element_sums:_whole"
FAULTS = {
    "others of the first chain": (
        Edit(f"{CODE}_Text._point_at_others", "first + step * self.row", "first"), line,
    ),
    "no volume": (Edit(f"{CODE}_look", "line.eq(1), at, c.number(0.0)", "line.eq(1), 0.0, c.number(0.0)"),
                  above_a_bound),
    "shrunk to where it is": (
        Edit(f"{CODE}_Text._shrunk", "c.where(below, right, at)",
             "c.where(below, right, c.load(self._vector(_NOW), i, REAL))"), line,
    ),
    "a higher level": (Edit(f"{CODE}_Text._level", "self._drawn()))", "self._drawn()) * 0.9)"), integers),
    "others as they were tried": (
        Edit(f"{CODE}_Text._turn", "c.loop(self.size, lambda k",
             "c.loop(c.where(turn.eq(0), self.size, 1), lambda k"), in_turn,
    ),
    "a mask ignored": (Edit(SUMS, "counts, np.cumsum(counts) - 1, log.size", "counts, 0, 0"), line),
    "no angle": (Edit(f"{CODE}_value", "line.eq(3) & beyond", "line.eq(9) & beyond"), circle),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_seen_before_the_first_use(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    edit, model = FAULTS[fault]
    monkeypatch.setattr(conditional, "_hold", lambda *args: None)
    slice_moves.cache_clear()
    try:
        with edit.planted():
            kernel, _, memory = moved(model, How(True), 2)
    finally:
        slice_moves.cache_clear()
    assert not memory["machine"] and "ends at" in kernel._code.differs
    assert moved(model, How(True), 2)[2]["machine"]


def test_debug_says_what_differs(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel, values, memory = moved(line, How(True), 2, debug=True)
    _one_off(monkeypatch)
    with pytest.raises(DensityError, match="node 'x': a slice of chain 0 .* ends at"), running():
        kernel.step(values, memory, np.random.default_rng(0), False)


def test_without_machine_code_numpy_draws_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that began in machine code is resumed where there is none."""
    kernel, values, memory = moved(in_turn, How(True), 4)
    with running():
        wanted, _ = kernel.step(values, memory, np.random.default_rng(1), False)
        other = Slice(kernel.blanket)
        other._made = kernel.blanket.classes, other.components, "no compiler"
        found, kept = other.step(values, memory, np.random.default_rng(1), False)
    np.testing.assert_allclose(found["x"], wanted["x"], rtol=1e-9)
    assert kept["machine"]


# ---- runs --------------------------------------------------------------------------------------------


def run(model: Any, draws: int, resume: Any = None, **has: Any) -> Any:
    net, evidence, _ = model()
    engine = bmc.Gibbs(draws=draws, warmup=60, chains=6, **has)
    return bmc.infer(net, evidence, engine=engine, rng=5, resume=resume)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
@pytest.mark.parametrize("model", [looked_up, integers])
def test_a_resumed_run_draws_the_same(model: Any) -> None:
    whole = run(model, 30, compiled=True)
    parts = run(model, 18, run(model, 12, compiled=True), compiled=True)
    np.testing.assert_array_equal(whole["x"], parts["x"])
    assert (whole["x"] != run(model, 30, compiled=False)["x"]).any()
    np.testing.assert_array_equal(whole["x"], run(model, 30, compiled=True, threads=2)["x"])


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_runs_are_compiled_where_that_pays(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    honest = Slice._by_machine
    monkeypatch.setattr(
        Slice, "_by_machine", lambda self, *args: asked.append(1) or honest(self, *args)
    )
    net, evidence, _ = looked_up()

    def ran(**has: Any) -> bool:
        asked.clear()
        bmc.infer(net, evidence, engine=bmc.Gibbs(draws=2, chains=4, **has), rng=1)
        return bool(asked)

    assert ran(warmup=1000) and not ran(warmup=20)
    assert ran(warmup=20, compiled=True) and not ran(warmup=1000, compiled=False)
    monkeypatch.setattr(slices, "is_available", lambda: False)
    monkeypatch.setattr(machine, "is_available", lambda: False)
    fresh, evidence, _ = looked_up()
    asked.clear()
    bmc.infer(fresh, evidence, engine=bmc.Gibbs(draws=2, warmup=5, chains=4, compiled=True), rng=1)
    assert not asked


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_trajectories_are_compiled_where_that_is_said() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Laplace(0.0, 1.0))
    net.add("b", bmc.Laplace(0.0, 1.0))
    net.add("y", lambda a, b: bmc.Normal(a * b, 1.0))

    def is_machine(**has: Any) -> bool:
        engine = bmc.Gibbs(draws=3, chains=4, **has)
        found = bmc.infer(net, {"y": 1.0}, engine=engine, rng=1)
        memories = found.checkpoint.state["memory"]
        return any(m.get("machine") for m in memories)

    assert is_machine(warmup=5, compiled=True) and not is_machine(warmup=5)
    assert is_machine(warmup=1000) and not is_machine(warmup=1000, compiled=False)


def test_the_table_says_what_is_machine_code() -> None:
    net, evidence, _ = looked_up()
    said = bmc.explain(net, evidence, engine=bmc.Gibbs(draws=10, warmup=1000))
    assert "; in machine code" in str(said)
    said = bmc.explain(net, evidence, engine=bmc.Gibbs(draws=10, warmup=10))
    assert "machine code" not in str(said)
    net.add("z", lambda x: bmc.Normal(float(x.array.max()), 1.0), vectorize=True)
    said = bmc.explain(net, {**evidence, "z": 1.0}, engine=bmc.Gibbs(draws=10, compiled=True))
    assert "slices in NumPy: " in str(said)


@pytest.mark.parametrize("wrong", [1.5, "yes"])
def test_what_compiled_may_be(wrong: Any) -> None:
    with pytest.raises(ValueError, match="compiled is True, False or None"):
        bmc.Gibbs(compiled=wrong)


def test_marking_is_left_to_the_functions() -> None:
    """Parameters out of range where a chain looks are rejected, as NumPy does."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(0.0, 1.0 - x), plates="i")
    target = target_of(pose(net, {"y": [0.1, 0.2, 0.3]}))
    kernel = Slice(Blanket(target, "x"), how=How(True), debug=True)
    kernel.expect(1000, 50)
    values: dict[str, Any] = {**target.known, "x": np.zeros(50)}
    with marking_invalid(), np.errstate(all="ignore"):
        memory = kernel.start(values, 50)
        for k in range(10):
            new, memory = kernel.step(values, memory, np.random.default_rng(k), True)
            values = {**values, **new}
    assert memory["machine"] and (values["x"] < 1.0).all()
