"""Slice sampling leaves posteriors invariant: one node, several along learnt directions, like nodes at once.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; ``--bayesmc-seed``
shifts them, and ``--bayesmc-thorough`` makes the tests longer. Each test is shown to fail on a
kernel with a deliberate error. Closed
forms, discrete nodes, Metropolis-Hastings and whole sweeps have files of their own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.circular import wrap_angle
from bayesmc.kernels import slice
from bayesmc.kernels.accepted import Accepted, number_kernel
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.slice import Slice
from bayesmc.kernels.stacked import Stacked
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.stacked import stacks
from bayesmc.structure.target import Target
from tests.kernels import invariance_models as models
from tests.kernels.invariance import Case, Make, Model, Still, backwards, each_test

# ---- one node ----------------------------------------------------------------------------------------


class Tilted(Blanket):
    """A density on the scale of logarithms without its Jacobian."""

    def log_density(self, values: Any, candidate: Any, members: Any = None) -> np.ndarray:
        return super().log_density(values, candidate, members) - np.log(candidate)


class Unwound(Blanket):
    """A density of angles beyond the cut, where they are not what its children read."""

    def log_density(self, values: Any, candidate: Any, members: Any = None) -> np.ndarray:
        now = self.current(values, members)
        return super().log_density(values, now + wrap_angle(candidate - now), members)


class Careless(Slice):
    """Takes the first point of a wide interval, on the slice or not."""

    def start(self, values: Any, chains: int) -> Any:
        memory = super().start(values, chains)
        return {**memory, "width": 5.0 * memory["width"]}

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        if warmup:
            return {self.blanket.name: values[self.blanket.name]}, memory
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


def last_first(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
    return sliced(kind=LastFirst)(target), memory


WARM = {"warmup": 20, "pilots": 100}
CARELESS = {"careless": sliced(kind=Careless)}

ONE_NODE = {
    "line": Case(models.line(), sliced(), CARELESS, **WARM),
    "half line": Case(
        models.half_line(), sliced(), {**CARELESS, "no Jacobian": sliced(of=Tilted)}, **WARM
    ),
    "bounded": Case(models.bounded(), sliced(), CARELESS, **WARM),
    "bounds of parents": Case(models.moving_bounds("x"), sliced(), CARELESS, **WARM),
    "bound of others": Case(
        models.moving_bounds("top"), sliced("top"), {"no Jacobian": sliced("top", of=Tilted)}, **WARM
    ),
    "circle": Case(models.circle(), sliced(), CARELESS, **WARM),
    "angles read as numbers": Case(
        models.of_x(bmc.VonMises(np.pi, 1.0), lambda x: bmc.Normal(np.exp(x) / 4, 1.0)),
        sliced(), {**CARELESS, "beyond the cut": sliced(of=Unwound)}, **WARM,
    ),
    "pose": Case(models.robot(), sliced(), CARELESS, last_first),
    "integers": Case(models.integers(), sliced(), CARELESS, **WARM),
    "integers with bounds of parents": Case(models.moving_integers(), sliced(), CARELESS, **WARM),
    "components": Case(models.pairs(), sliced(), CARELESS, last_first),
    "colours": Case(
        models.ring(), sliced(), {"merged": sliced(classes=(None,))}, backwards, **WARM
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "fault", "test"), each_test(ONE_NODE))
def test_one_node(name: str, fault: str, test: str) -> None:
    ONE_NODE[name].check(test, fault)


# ---- several nodes along learnt directions -------------------------------------------------------------


class Forgetful(FactorSlice):
    """Forgets the prior of one node."""

    def _log(self, values: Any, x: np.ndarray) -> np.ndarray:
        prior = self.target.terms["a"].log({**values, **self._split(x)[0]})
        return super()._log(values, x) - prior


def factors(kind: type[FactorSlice] = FactorSlice) -> Make:
    return lambda target: kind(target, ("a", "s", "v", "u"))


def last_direction_first(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
    turned = {n: memory[n][::-1] for n in ("directions", "width")}
    return make(target), {**memory, **turned}


FACTORS = {
    "factor slice": Case(
        models.several(), factors(), {"a prior forgotten": factors(Forgetful)},
        last_direction_first, warmup=33, pilots=60, sizes={"draws": 12, "chains": 200, "replications": 500},
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "fault", "test"), each_test(FACTORS))
def test_several_nodes(name: str, fault: str, test: str) -> None:
    FACTORS[name].check(test, fault)


# ---- like nodes at once ----------------------------------------------------------------------------------


def like_nodes() -> Model:
    """An unrolled template: five numbers, each with a label and data of its own."""
    net = bmc.BayesNet()
    for j in range(5):
        net.add(f"x[{j}]", bmc.StudentT(5.0, 0.0, 1.0))
        net.add(f"z[{j}]", bmc.Categorical(models.SHARES))
        net.add(
            f"y[{j}]", lambda x, z: bmc.Normal(x + models.CENTRES[z], 0.8), [f"x[{j}]", f"z[{j}]"]
        )
    return Model(net, tuple(f"y[{j}]" for j in range(5)), ("x[0]", "x[4]", "z[0]", "z[4]"))


def stacked(letter: str, kind: Any, prior: bool = True) -> Make:
    def make(target: Target) -> Kernel:
        names = [f"{letter}[{j}]" for j in range(5)]
        blankets = {name: Blanket(target, name) for name in target.chain}
        (stack,), left = stacks(target, blankets, names)
        assert not left
        if not prior:
            stack.one.own = None
        return Stacked(stack, kind)

    return make


STACKED = {
    "numbers": Case(
        like_nodes(), stacked("x", Slice), {"careless": stacked("x", Careless)}, how="moving", **WARM
    ),
    "labels": Case(
        like_nodes(), stacked("z", Enumerate), {"no prior": stacked("z", Enumerate, False)}, how="moving",
        sizes={"replications": 4000},
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "fault", "test"), each_test(STACKED))
def test_like_nodes(name: str, fault: str, test: str) -> None:
    STACKED[name].check(test, fault)


# ---- closed forms that some terms accept -----------------------------------------------------------------


def ordered_means() -> Model:
    """Two means that like to be in order."""
    net = bmc.BayesNet(plates={"k": 2})
    net.add("x", bmc.Normal([-0.3, 0.3], 1.0), plates="k")
    net.add("y", lambda x: bmc.Normal(x, 0.8), plates="k")
    net.potential("ordered", lambda x: np.where(x[0] < x[1], 0.0, -2.0))

    def draw(rng: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
        x = rng.normal([-0.3, 0.3], 1.0, (6 * rows + 100, 2))
        kept = (x[:, 0] < x[:, 1]) | (rng.random(len(x)) < np.exp(-2.0))
        return {"x": x[kept][:rows]}

    def respond(state: Any, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"y": rng.normal(state["x"], 0.8)}

    return Model(net, ("y",), draw=draw, respond=respond)


def ordered_kernel(decides: bool = True, prior: bool = True) -> Make:
    def make(target: Target) -> Kernel:
        kernel = number_kernel(Blanket(target, "x"))
        assert isinstance(kernel, Accepted) and kernel.label == "conjugate"
        assert not kernel.constraints  # both moves in every sweep
        kernel.other = Still(kernel.names)
        if not decides:
            kernel.left_out = []
        if not prior:
            kernel._log = _twice(kernel)  # type: ignore[method-assign]
        return kernel

    return make


def _twice(kernel: Accepted) -> Any:
    """The terms of the proposal count once more."""
    log, own = kernel._log, kernel.blanket.own
    assert own is not None
    return lambda values: log(values) + own.log(values).sum(axis=-1)


ACCEPTED = {
    "order": Case(
        ordered_means(), ordered_kernel(),
        {"order forgotten": ordered_kernel(False), "prior counted twice": ordered_kernel(prior=False)},
        statistics={"gap": lambda s, y: s["x"][:, 1] - s["x"][:, 0]}, how="moving",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "fault", "test"), each_test(ACCEPTED))
def test_accepted(name: str, fault: str, test: str) -> None:
    ACCEPTED[name].check(test, fault)
