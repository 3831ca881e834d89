"""Kernels of continuous nodes leave their posteriors invariant: slices, walks, ensembles, proposals.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; ``BAYESMC_SEED``
shifts them, and makes the tests longer. Each test is shown to fail on a kernel with a deliberate error. All
models have three overlapping categories. Closed forms, discrete nodes and whole sweeps have files of their
own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.metropolis_proposals import Independence, read_proposals
from bayesmc.kernels import slice
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.proposed import Proposed, ProposedBlock
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.kernels.slice import Slice
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target
from tests.kernels.invariance import Case, Make, Model, each_fault, mixture

TESTS = ("geweke", "ranks")
SHARES = [0.2, 0.3, 0.5]
CENTRES = np.array([-1.0, 0.0, 1.5])
COV = np.array([[1.0, 0.4], [0.4, 0.7]])
RING, NEXT = np.arange(5), (np.arange(5) + 1) % 5
GAMMA = bmc.Gamma(3.0, 2.0)

# ---- models ------------------------------------------------------------------------------------------


def of_x(prior: Any, child: Any) -> Model:
    return Model(mixture(prior, child, 8), ("y",), ("x",))


def line() -> Model:
    return of_x(bmc.StudentT(5.0, 0.0, 1.0), lambda x: bmc.Normal(x, 1.2))


def half_line() -> Model:
    return of_x(GAMMA, lambda x: bmc.Gamma(x, 1.0))


def bounded() -> Model:
    return of_x(bmc.Truncated(bmc.Normal(0.0, 0.7), -1.0, 1.5), lambda x: bmc.Normal(x**2, 0.8))


def circle() -> Model:
    return of_x(bmc.VonMises(0.5, 1.0), lambda x: bmc.Normal(np.cos(x), 0.6))


def integers() -> Model:
    return of_x(bmc.Poisson(3.0), lambda x: bmc.Normal(1.0 * x, 2.0))


def pairs() -> Model:
    """Vectors, whose components move one after the other."""
    return of_x(
        bmc.Joint(bmc.Normal(0.0, 1.0), bmc.Uniform(0.0, 2.0)),
        lambda x: bmc.Normal(x[..., 0] * x[..., 1], 0.8),
    )


def simplex() -> Model:
    return of_x(bmc.Dirichlet([1.0, 2.0, 1.5]), lambda x: bmc.Categorical(x))


def matrices() -> Model:
    return of_x(bmc.InverseWishart(5.0, 2 * COV), lambda x: bmc.MvNormal(np.ones(2), x))


def moving_bounds(moved: str) -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 8})
    net.add("top", bmc.Gamma(4.0, 2.0))
    net.add("x", lambda top: bmc.Truncated(bmc.Normal(0.5, 0.7), -0.5, top), plates="k")
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda x, label: bmc.Normal(x[label] ** 2, 1.0), plates="i")
    return Model(net, ("y",), (moved,))


def moving_integers() -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 8})
    net.add("total", bmc.Poisson(6.0))
    net.add("x", lambda total: bmc.Binomial(total, 0.4), plates="k")
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda x, label: bmc.Normal(1.0 * x[label], 3.0), plates="i")
    return Model(net, ("y",), ("x",))


def ring() -> Model:
    """Neighbours share data: elements of three colours."""
    net = bmc.BayesNet(plates={"k": 5, "pair": 5})
    net.add("x", bmc.Gamma(2.0, 2.0), plates="k")
    net.add("y", lambda x: bmc.Normal(x[RING] * x[NEXT], 0.7), plates="pair")
    return Model(net, ("y",))


def several() -> Model:
    """Nodes of all kinds that share their data."""
    net = bmc.BayesNet(plates={"i": 8})
    net.add("a", bmc.StudentT(5.0, 0.0, 1.0))
    net.add("s", bmc.Gamma(3.0, 2.0))
    net.add("v", bmc.MvNormal([0.0, 0.5], COV))
    net.add("u", bmc.Uniform(0.0, 1.0))
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add(
        "y",
        lambda a, s, v, u, label: bmc.Normal(
            a + s * CENTRES[label] + v[..., 0] * v[..., 1], 0.3 + u
        ),
        plates="i",
    )
    return Model(net, ("y",), ("a", "s", "v", "u"))


def few() -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 8})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x", lambda a: bmc.Gamma(3.0, np.exp(a)), plates="k")
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda x, label: bmc.Normal(1.0, x[label]), plates="i")
    return Model(net, ("y",), ("a", "x"))


def two() -> Model:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("s", bmc.Gamma(3.0, 2.0))
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda a, s, label: bmc.Normal(a + CENTRES[label], s), plates="i")
    return Model(net, ("y",), ("a", "s"))


def labels() -> Model:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("z", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda z: bmc.Normal(CENTRES[z], 1.0), plates="i")
    return Model(net, ("y",))


# ---- one node: slices and walks ----------------------------------------------------------------------


def backwards(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
    """The kernel whose elements of different colours move in the other order."""
    kernel: Any = make(target)
    kernel.blanket.classes = kernel.blanket.classes[::-1]
    return kernel, memory


class Tilted(Blanket):
    """A density on the scale of logarithms without its Jacobian."""

    def log_density(self, values: Any, candidate: Any, members: Any = None) -> np.ndarray:
        return super().log_density(values, candidate, members) - np.log(candidate)


class Careless(Slice):
    """Takes the first point of a wide interval, on the slice or not."""

    def start(self, values: Any, chains: int) -> Any:
        memory = super().start(values, chains)
        return {**memory, "width": 5.0 * memory["width"]}

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        if warmup:
            return {}, memory
        shrink, slice._shrink = slice._shrink, _first_point
        try:
            return super().step(values, memory, rng, warmup)
        finally:
            slice._shrink = shrink


def _first_point(
    log: Any, x: np.ndarray, level: Any, left: Any, right: Any, rng: Any
) -> np.ndarray:
    return left + rng.random(x.shape) * (right - left)


class LastFirst(Slice):
    """The reverse of a slice of vectors: the last component moves first."""

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        name, state = self.blanket.name, values
        for component in reversed(list(np.ndindex(self.blanket.event_shape))):
            new = self._move(state, None, component, memory, rng)
            state = {**state, name: self.blanket.moved(state, new, None)}
        return {name: state[name]}, memory


def sliced(
    name: str = "x", kind: type[Slice] = Slice, of: type[Blanket] = Blanket, **has: Any
) -> Make:
    def make(target: Target) -> Kernel:
        blanket = of(target, name)
        for attribute, value in has.items():
            setattr(blanket, attribute, value)
        return kind(blanket)

    return make


class NoVolume(AdaptiveWalk):
    """Forgets that the free scale stretches."""

    def _volume(self, transform: Any, free: Any, shape: Any) -> np.ndarray:
        return np.zeros(shape)


class Drifting(AdaptiveWalk):
    """Steps that lean to one side."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        draw = self.steps.draw
        self.steps.draw = lambda memory, rng: draw(memory, rng) + 1.0  # type: ignore[method-assign, assignment]


def walk(
    name: str = "x", kind: type[AdaptiveWalk] = AdaptiveWalk, colours: bool = True, **options: Any
) -> Make:
    def make(target: Target) -> Kernel:
        blanket = Blanket(target, name)
        if not colours:
            blanket.classes = (None,)
        return kind(blanket, **options)

    return make


CARELESS = {"careless": sliced(kind=Careless)}
DRIFT = {"drift": walk(kind=Drifting)}
VOLUME = {"no volume": walk(kind=NoVolume)}
OWN_SCALE = {"scale": 0.8, "unconstrained": False, "adaptive": False}

ONE_NODE = {
    "slice, line": Case(line(), sliced(), CARELESS, warmup=20),
    "slice, half line": Case(
        half_line(), sliced(), {**CARELESS, "no Jacobian": sliced(of=Tilted)}, warmup=20
    ),
    "slice, bounded": Case(bounded(), sliced(), CARELESS, warmup=20),
    "slice, bounds of parents": Case(moving_bounds("x"), sliced(), CARELESS, warmup=20),
    "slice, bound of others": Case(
        moving_bounds("top"), sliced("top"), {"no Jacobian": sliced("top", of=Tilted)}, warmup=20
    ),
    "slice, circle": Case(circle(), sliced(), CARELESS, warmup=20),
    "slice, integers": Case(integers(), sliced(), CARELESS, warmup=20),
    "slice, integers with bounds of parents": Case(moving_integers(), sliced(), CARELESS, warmup=20),
    "slice, components": Case(
        pairs(), sliced(), CARELESS, lambda make, target, memory: (sliced(kind=LastFirst)(target), memory)
    ),
    "slice, colours": Case(ring(), sliced(), {"merged": sliced(classes=(None,))}, backwards, warmup=20),
    "walk, line": Case(line(), walk(), DRIFT, warmup=30),
    "walk, half line": Case(half_line(), walk(), VOLUME, warmup=30),
    "walk, bounded": Case(bounded(), walk(), VOLUME, warmup=30),
    "walk, bounds of parents": Case(moving_bounds("x"), walk(), VOLUME, warmup=30, sizes={"draws": 150}),
    "walk, circle": Case(circle(), walk(), DRIFT, warmup=30),
    "walk, simplex": Case(simplex(), walk(), VOLUME, warmup=30),
    "walk, matrices": Case(matrices(), walk(), VOLUME, warmup=30),
    "walk, colours": Case(
        ring(), walk(), {"merged": walk(colours=False, scale=1.5, adaptive=False)}, backwards, warmup=30,
        sizes={"draws": 150, "chains": 200},
    ),
    "walk, own scale": Case(
        half_line(), walk(**OWN_SCALE), {"drift": walk(kind=Drifting, **OWN_SCALE)}
    ),
}  # fmt: skip


@pytest.mark.parametrize("test", TESTS)
@pytest.mark.parametrize(("name", "fault"), each_fault(ONE_NODE))
def test_one_node(name: str, fault: str, test: str) -> None:
    ONE_NODE[name].check(test, fault)


# ---- several nodes at once: factor slice, walks, ensembles ---------------------------------------------


def factors(terms: Any = np.s_[:]) -> Make:
    def make(target: Target) -> Kernel:
        kernel = FactorSlice(target, ("a", "s", "v", "u"))
        kernel.terms = kernel.terms[terms]
        return kernel

    return make


def last_direction_first(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
    turned = {n: memory[n][::-1] for n in ("directions", "width")}
    return make(target), {**memory, **turned}


class NoBlockVolume(BlockWalk):
    """Forgets that the free scale stretches."""

    def _volume(self, transform: Any, free: np.ndarray, part: Any) -> np.ndarray:
        return np.zeros(len(free))


class DriftingBlock(BlockWalk):
    """Steps that lean to one side."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        draw = self.steps.draw
        self.steps.draw = lambda *given: draw(*given) + 0.5  # type: ignore[method-assign]


class OwnHalf(BlockWalk):
    """Members follow half the differences of their own half, themselves among them."""

    def end_warmup(self, memory: Any) -> Any:
        return {**super().end_warmup(memory), "log_factor": np.log(0.5 / 1.2)}

    def _halves(self, rows: int, rng: Any) -> Any:
        return [(moving, np.repeat(moving.reshape(-1, self.ensemble // 2), self.ensemble // 2, axis=0))
                for moving, _ in super()._halves(rows, rng)]  # fmt: skip


def together(kind: type[BlockWalk] = BlockWalk, **options: Any) -> Make:
    return lambda target: kind(target, ("a", "x"), **options)


def ensembles(kind: type[BlockWalk] = BlockWalk) -> Make:
    return lambda target: kind(target, ("a", "s"), 4)


SCALES = {"scale": [0.8, 0.4, 0.4, 0.4], "unconstrained": False, "adaptive": False}

SEVERAL = {
    "factor slice": Case(
        several(), factors(), {"a prior forgotten": factors(np.s_[1:])},
        last_direction_first, warmup=33, pilots=60, sizes={"draws": 30, "chains": 60, "replications": 500},
    ),
    "block walk": Case(few(), together(), {"no volume": together(NoBlockVolume)}, warmup=30),
    "block walk, own scale": Case(
        few(), together(**SCALES), {"drift": together(DriftingBlock, **SCALES)}
    ),
    "ensembles": Case(
        two(), ensembles(), {"own half": ensembles(OwnHalf), "no volume": ensembles(NoBlockVolume)},
        members=4, warmup=30, sizes={"draws": 100, "replications": 2000},
    ),
}  # fmt: skip


@pytest.mark.parametrize("test", TESTS)
@pytest.mark.parametrize(("name", "fault"), each_fault(SEVERAL))
def test_several_nodes(name: str, fault: str, test: str) -> None:
    SEVERAL[name].check(test, fault)


# ---- proposals of a user -------------------------------------------------------------------------------


class Symmetric(Proposed):
    """Takes every proposal for a symmetric one."""

    def _drawn(self, values: Any, rng: Any) -> Any:
        new, dead, log = super()._drawn(values, rng)
        return new, dead, 0 * log

    def _backward(self, values: Any, new: Any, members: Any) -> np.ndarray:
        return 0 * super()._backward(values, new, members)


class SymmetricBlock(ProposedBlock):
    """Takes every proposal for a symmetric one."""

    def _drawn(self, values: Any, rng: Any) -> Any:
        new, dead, log = super()._drawn(values, rng)
        return new, dead, 0 * log

    def _log_density(self, given: Any, values: Any) -> np.ndarray:
        return 0 * super()._log_density(given, values)


def proposed(key: Any, given: Any, right: bool = True) -> Make:
    def make(target: Target) -> Kernel:
        (read,) = read_proposals(target.problem, {key: given}).values()
        if isinstance(key, tuple):
            return (ProposedBlock if right else SymmetricBlock)(target, key, read)  # type: ignore[arg-type]
        return (Proposed if right else Symmetric)(Blanket(target, key), read)  # type: ignore[arg-type]

    return make


def of_proposal(model: Model, key: Any, given: Any, **options: Any) -> Case:
    faults = {"no Hastings correction": proposed(key, given, right=False)}
    sizes = {"draws": 150, "chains": 120, "replications": 3000}
    return Case(model, proposed(key, given), faults, sizes=sizes, **options)


TURN = np.array([[0.2, 0.7, 0.1], [0.1, 0.3, 0.6], [0.5, 0.2, 0.3]])


def jointly(a: Any, x: Any) -> dict[str, Any]:
    return {"a": bmc.Normal(0.8 * a, 0.6), "x": bmc.LogNormal(np.log(x.array), 0.4)}


def as_vector(a: Any) -> Any:
    size = (np.zeros(4) + 0.5) ** 2 * np.eye(4)
    return bmc.MvNormal(bmc.stack([0.8 * a, 1.0, 1.2, 1.4]), size)


PROPOSALS = {
    "asymmetric": of_proposal(half_line(), "x", lambda x: bmc.LogNormal(np.log(x), 0.6)),
    "towards the data": of_proposal(
        labels(), "z", lambda y, z: bmc.Categorical(0.5 * TURN[z] + 0.5 * _near(y))
    ),
    "states": of_proposal(labels(), "z", lambda z: bmc.Categorical(TURN[z])),
    "by colours": of_proposal(
        ring(), "x", lambda x: bmc.LogNormal(np.log(x), 0.4), reverse=backwards
    ),
    "independence": of_proposal(half_line(), "x", Independence(bmc.Gamma(2.0, 1.0))),
    "prior": of_proposal(half_line(), "x", "prior"),
    "prior of integers": of_proposal(
        moving_integers(), "x", "prior",
        statistics={"spread": lambda s, y: ((s["x"] - 0.4 * s["total"][:, None]) ** 2).mean(axis=1)},
    ),
    "block": of_proposal(few(), ("a", "x"), jointly),
    "block as a vector": of_proposal(few(), ("a", "x"), as_vector),
    "block from the prior": of_proposal(few(), ("a", "x"), "prior"),
}  # fmt: skip


def _near(y: Any) -> Any:
    weight = np.exp(-0.5 * (np.asarray(y)[..., None] - CENTRES) ** 2)
    return weight / weight.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize("test", TESTS)
@pytest.mark.parametrize(("name", "fault"), each_fault(PROPOSALS))
def test_proposal(name: str, fault: str, test: str) -> None:
    PROPOSALS[name].check(test, fault)
