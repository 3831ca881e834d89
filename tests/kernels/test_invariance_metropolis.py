"""Metropolis-Hastings leaves posteriors invariant: walks, ensembles, proposals of a user.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; ``--bayesmc-seed``
shifts them, and ``--bayesmc-thorough`` makes the tests longer. Each test is shown to fail on a
kernel with a deliberate error. What
adapts does so beforehand, on draws of its own, and is frozen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc.proposals import Independence, read_proposals
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.proposed import Proposed, ProposedBlock
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target
from tests.kernels import invariance_models as models
from tests.kernels.invariance import Case, Make, Model, backwards, each_test

# ---- walks of one node -------------------------------------------------------------------------------


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


DRIFT = {"drift": walk(kind=Drifting)}
VOLUME = {"no volume": walk(kind=NoVolume)}
OWN_SCALE = {"scale": 0.8, "unconstrained": False, "adaptive": False}

ONE_NODE = {
    "line": Case(models.line(), walk(), DRIFT, warmup=30),
    "half line": Case(models.half_line(), walk(), VOLUME, warmup=30),
    "bounded": Case(models.bounded(), walk(), VOLUME, warmup=30),
    "bounds of parents": Case(
        models.moving_bounds("x"), walk(), VOLUME, warmup=30, sizes={"draws": 150}
    ),
    "circle": Case(models.circle(), walk(), DRIFT, warmup=30),
    "simplex": Case(models.simplex(), walk(), VOLUME, warmup=30),
    "matrices": Case(models.matrices(), walk(), VOLUME, warmup=30),
    "colours": Case(
        models.ring(), walk(), {"merged": walk(colours=False, scale=1.5, adaptive=False)}, backwards,
        warmup=30, sizes={"draws": 150, "chains": 200},
    ),
    "own scale": Case(
        models.half_line(), walk(**OWN_SCALE), {"drift": walk(kind=Drifting, **OWN_SCALE)}
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "fault", "test"), each_test(ONE_NODE))
def test_one_node(name: str, fault: str, test: str) -> None:
    ONE_NODE[name].check(test, fault)


# ---- blocks and ensembles ------------------------------------------------------------------------------


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


class OneWayRound(BlockWalk):
    """Differences of angles all go the same way round, and are not as likely backwards."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        angles = self.steps.angles
        self.steps.wrapped = lambda u: np.where(angles, np.remainder(u, 2 * np.pi), u)  # type: ignore[method-assign]


def together(kind: type[BlockWalk] = BlockWalk, **options: Any) -> Make:
    return lambda target: kind(target, ("a", "x"), **options)


def ensembles(kind: type[BlockWalk] = BlockWalk, names: tuple[str, ...] = ("a", "s")) -> Make:
    return lambda target: kind(target, names, 4)


def of_angles(model: Model, *names: str) -> Case:
    """Ensembles on a model with an angle, whose mass lies on both sides of the cut at pi."""
    fault = {"one way round": ensembles(OneWayRound, names)}
    sizes = {"draws": 100, "replications": 8000}
    return Case(model, ensembles(names=names), fault, members=4, warmup=30, sizes=sizes)


SCALES = {"scale": [0.8, 0.4, 0.4, 0.4], "unconstrained": False, "adaptive": False}

SEVERAL = {
    "block walk": Case(models.few(), together(), {"no volume": together(NoBlockVolume)}, warmup=30),
    "block walk, own scale": Case(
        models.few(), together(**SCALES), {"drift": together(DriftingBlock, **SCALES)},
        sizes={"draws": 120},
    ),
    "ensembles": Case(
        models.two(), ensembles(), {"own half": ensembles(OwnHalf), "no volume": ensembles(NoBlockVolume)},
        members=4, warmup=30, sizes={"draws": 100, "replications": 8000},
    ),
    "von Mises": of_angles(models.heading(bmc.VonMises(3.0, 3.0)), "a", "h"),
    "wrapped normal": of_angles(models.heading(bmc.WrappedNormal(-3.0, 0.6)), "a", "h"),
    "pose": of_angles(models.robot(), "x"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "fault", "test"), each_test(SEVERAL))
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
    sizes = {"draws": 100 if isinstance(key, tuple) else 50, "chains": 240, "replications": 5000}
    return Case(model, proposed(key, given), faults, sizes=sizes, **options)


TURN = np.array([[0.2, 0.7, 0.1], [0.1, 0.3, 0.6], [0.5, 0.2, 0.3]])


def jointly(a: Any, x: Any) -> dict[str, Any]:
    return {"a": bmc.Normal(0.8 * a, 0.6), "x": bmc.LogNormal(np.log(x.array), 0.4)}


def as_vector(a: Any) -> Any:
    size = (np.zeros(4) + 0.5) ** 2 * np.eye(4)
    return bmc.MvNormal(bmc.stack([0.8 * a, 1.0, 1.2, 1.4]), size)


PROPOSALS = {
    "asymmetric": of_proposal(models.half_line(), "x", lambda x: bmc.LogNormal(np.log(x), 0.6)),
    "towards the data": of_proposal(
        models.labels(), "z", lambda y, z: bmc.Categorical(0.5 * TURN[z] + 0.5 * _near(y))
    ),
    "states": of_proposal(models.labels(), "z", lambda z: bmc.Categorical(TURN[z])),
    "by colours": of_proposal(
        models.ring(), "x", lambda x: bmc.LogNormal(np.log(x), 0.4), reverse=backwards
    ),
    "independence": of_proposal(models.half_line(), "x", Independence(bmc.Gamma(2.0, 1.0))),
    "prior": of_proposal(models.half_line(), "x", "prior"),
    "prior of integers": of_proposal(
        models.moving_integers(), "x", "prior",
        statistics={"spread": lambda s, y: ((s["x"] - 0.4 * s["total"][:, None]) ** 2).mean(axis=1)},
    ),
    "block": of_proposal(models.few(), ("a", "x"), jointly),
    "block as a vector": of_proposal(models.few(), ("a", "x"), as_vector),
    "block from the prior": of_proposal(models.few(), ("a", "x"), "prior"),
}  # fmt: skip


def _near(y: Any) -> Any:
    weight = np.exp(-0.5 * (np.asarray(y)[..., None] - models.CENTRES) ** 2)
    return weight / weight.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize(("name", "fault", "test"), each_test(PROPOSALS))
def test_proposal(name: str, fault: str, test: str) -> None:
    PROPOSALS[name].check(test, fault)
