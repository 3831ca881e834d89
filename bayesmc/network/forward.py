"""The forward pass: visit nodes in topological order, sample what is hidden, weight by what is seen.

Ancestral sampling is this pass without evidence; likelihood weighting and its relatives are this pass
with some. A pass is a list of steps, one per node; engines may put faster steps in their place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.network.evidence import Observed
from bayesmc.network.model import CompiledNode, Model, invalid_error
from bayesmc.shapes import Shape


@dataclass(eq=False)
class Pass:
    """One batch of draws in the making.

    Attributes
    ----------
    batch : tuple of int
        Shape of the batch axes, e.g. ``(draws,)``.
    values : dict
        Name -> stored values drawn, known or computed so far.
    log_weight : float or ndarray
        Sum of the log densities of the evidence so far; broadcasts to ``batch``.
    """

    rng: np.random.Generator
    batch: Shape
    values: dict[str, np.ndarray]
    log_weight: Any = 0.0

    def weigh(self, log_density: np.ndarray) -> None:
        """Multiply the weights by a density given in logs."""
        self.log_weight = self.log_weight + log_density


Step = Callable[[Pass], None]


def run(steps: Sequence[Step], start: Pass) -> Pass:
    """Take every step in order."""
    for step in steps:
        step(start)
    return start


def steps_for(model: Model, observed: Mapping[str, Observed]) -> list[Step]:
    """The plain steps of every node and potential of a model."""
    steps = {name: step_for(model, node, observed) for name, node in model.nodes.items()}
    return with_potentials(model, steps)


def with_potentials(model: Model, steps: Mapping[str, Step]) -> list[Step]:
    """The nodes' steps with every potential right after the last node it needs.

    So a configuration that a potential excludes has no weight left when later nodes are evaluated.
    """
    after: dict[str | None, list[Step]] = {}
    order = {name: k for k, name in enumerate(steps)}
    for name, (potential, _) in model.potentials.items():
        last = max(potential.parents, key=order.__getitem__, default=None)
        after.setdefault(last, []).append(Potential(model, name))
    result = list(after.get(None, []))
    for name, step in steps.items():
        result += [step, *after.get(name, [])]
    return result


def step_for(model: Model, node: CompiledNode, observed: Mapping[str, Observed]) -> Step:
    """The plain step of one node."""
    if node.kind == "input":
        return _nothing
    if not node.is_stochastic:
        return Compute(model, node)
    seen = observed.get(node.name)
    if seen is None:
        return Draw(model, node)
    return Weigh(model, node, seen) if seen.mask is None else DrawAndWeigh(model, node, seen)


class Compute:
    """A deterministic or fixed node."""

    def __init__(self, model: Model, node: CompiledNode) -> None:
        self.model, self.node = model, node

    def __call__(self, state: Pass) -> None:
        state.values[self.node.name], _ = self.model.evaluate(self.node.name, state.values)


class Draw:
    """A hidden node: sample it given its parents."""

    def __init__(self, model: Model, node: CompiledNode) -> None:
        self.model, self.node = model, node

    def __call__(self, state: Pass) -> None:
        dist = _distribution(self.model, self.node, state)
        state.values[self.node.name] = self.model.sample_stored(
            self.node.name, dist, state.rng, state.batch
        )


class Weigh:
    """An observed node: its density at what was seen is a factor of the weight."""

    def __init__(self, model: Model, node: CompiledNode, seen: Observed) -> None:
        self.model, self.node, self.seen = model, node, seen
        self.plate_axes = tuple(range(-len(node.plates), 0))

    def __call__(self, state: Pass) -> None:
        dist = _distribution(self.model, self.node, state)
        log_density = self.model.log_density(self.node.name, dist, self.seen.value)
        if self.plate_axes:
            lead = log_density.shape[: max(log_density.ndim - len(self.plate_axes), 0)]
            log_density = np.broadcast_to(log_density, lead + self.node.plate_shape)
            log_density = log_density.sum(axis=self.plate_axes)
        state.weigh(log_density)
        state.values[self.node.name] = self.seen.value


class DrawAndWeigh:
    """A partly observed node: sample the missing plate elements, weight by the others."""

    def __init__(self, model: Model, node: CompiledNode, seen: Observed) -> None:
        self.model, self.node, self.seen = model, node, seen
        assert seen.mask is not None
        self.elements = seen.mask
        self.mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
        self.plate_axes = tuple(range(-len(node.plates), 0))

    def __call__(self, state: Pass) -> None:
        dist = _distribution(self.model, self.node, state)
        draws = self.model.sample_stored(self.node.name, dist, state.rng, state.batch)
        values = np.where(self.mask, self.seen.value, draws)
        values.flags.writeable = False
        density = self.model.log_density(self.node.name, dist, values)
        state.weigh(np.where(self.elements, density, 0.0).sum(axis=self.plate_axes))
        state.values[self.node.name] = values


class Potential:
    """An extra log factor."""

    def __init__(self, model: Model, name: str) -> None:
        self.model, self.name = model, name

    def __call__(self, state: Pass) -> None:
        state.weigh(self.model.potential(self.name, state.values))


def refuse_unsampled(model: Model, known: Iterable[str], who: str) -> str | None:
    """Why the forward pass cannot run on a model: a hidden node whose density has no sampler."""
    given = set(known)
    from_density = [
        node.name
        for node in model.nodes.values()
        if node.is_stochastic and node.name not in given and node.unsampled
    ]
    if not from_density:
        return None
    return (
        f"{who} samples every hidden node from its conditional density, but {from_density[0]!r} is a "
        "Density without sample=; give one, or observe the node"
    )


def _distribution(model: Model, node: CompiledNode, state: Pass) -> Distribution:
    """The node's distribution given its parents; bad parameters raise where the weight is positive."""
    dist, _ = model.evaluate(node.name, state.values)
    if dist.invalid is not None:
        alive = np.broadcast_to(np.asarray(state.log_weight) > -np.inf, state.batch)
        error = invalid_error(node, dist, alive, state.batch)
        if error is not None:
            raise error
    return dist


def _nothing(state: Pass) -> None:
    """Inputs are in place before the pass starts."""
