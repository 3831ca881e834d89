"""Random walks of one node: every element takes a Gaussian step and is accepted by itself.

On the unconstrained scale of its support a node of any kind can walk, a simplex and a matrix, too; the
acceptance ratio then has the change of volume. Walks of several nodes at once are in ``ensemble``; where the
numbers of each stand in one vector is said here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.support import Support
from bayesmc.distributions.transforms import Identity, Transform, Wrapped, transform_of
from bayesmc.errors import ShapeError
from bayesmc.kernels.adaptation import Steps, chance, turning
from bayesmc.kernels.base import Kernel, Memory, counted
from bayesmc.kernels.densities import accepted, compare, instead
from bayesmc.network import Model
from bayesmc.shapes import Shape, broadcasts_to
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values

#: free numbers beyond these are at a bound as far as floating point can tell
_FAR = 700.0
#: numbers that are few enough for a mixture to be fitted to them
_FEW = 6


class AdaptiveWalk(Kernel):
    """Metropolis-Hastings with Gaussian steps, whose size and shape adapt until the warmup ends.

    All chains and all elements of a plate that are independent given the rest step together, each accepted
    by itself; the components of a vector, a simplex or a matrix step jointly.

    Parameters
    ----------
    blanket : Blanket
    reason : str
        Why the node walks, for the table of kernels.
    scale : array_like, optional
        Standard deviations of the steps, broadcasting to ``(*plates, *event)`` (of the unconstrained
        numbers, if it walks there); by default they are learnt.
    unconstrained : bool
        Walk on the unconstrained scale; otherwise on the node's own, where steps out of the support are
        rejected.
    adaptive : bool
        Learn in the warmup, from ``scale`` on if it is given.

    References
    ----------
    Haario, Saksman and Tamminen (2001), Bernoulli 7; Roberts and Rosenthal (2001), Statistical Science 16.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.random_walk import AdaptiveWalk
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("w", bmc.Dirichlet([1.0, 1.0, 1.0]))
    >>> net.add("n", lambda w: bmc.Multinomial(10, w))
    >>> target = target_of(pose(net, {"n": [5, 3, 2]}))
    >>> kernel = AdaptiveWalk(Blanket(target, "w"))
    >>> values = {**target.known, "w": np.full((4, 3), 1 / 3)}
    >>> new, memory = kernel.step(values, kernel.start(values, 4), np.random.default_rng(0), True)
    >>> new["w"].shape, bool(np.allclose(new["w"].sum(axis=-1), 1.0))
    ((4, 3), True)
    """

    label = "adaptive random walk"

    def __init__(
        self,
        blanket: Blanket,
        reason: str = "",
        *,
        scale: Any = None,
        unconstrained: bool = True,
        adaptive: bool = True,
    ) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        self.match = reason
        self.unconstrained = unconstrained
        node = blanket.node
        support = some_support(blanket.target.model, node.name)
        self.free_shape = walked(support, node.event_shape, unconstrained).unconstrained_shape
        size = math.prod(self.free_shape)
        if scale is not None:
            wanted = node.plate_shape + self.free_shape
            if not broadcasts_to(np.shape(scale), wanted):
                raise ShapeError(
                    f"RandomWalk: the scale for node {node.name!r} has shape {np.shape(scale)}, which does "
                    f"not fit {wanted}; give one number, or one for each number that walks"
                )
            full = np.broadcast_to(scale, wanted)
            scale = full.reshape(blanket.size, size)
        angles = turning(support, node.event_shape, unconstrained)
        self.steps = Steps(size, scale, adaptive, angles)
        if not adaptive:
            self.label = "random walk"

    def start(self, values: Values, chains: int) -> Memory:
        free = self._free(self._transform(values), values[self.blanket.name])
        return {"steps": self.steps.start(free), "accepted": np.zeros(chains), "moves": 0}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket, name = self.blanket, self.blanket.name
        now = values[name]
        transform = self._transform(values)
        free = self._free(transform, now)
        tried = self.steps.wrapped(free + self.steps.draw(memory["steps"], rng))
        shape = (len(now), *blanket.node.plate_shape)
        proposal = transform.constrain(tried.reshape(shape + self.free_shape))
        volume = self._volume(transform, tried, shape) - self._volume(transform, free, shape)
        rates = np.full(tried.shape[:2], np.nan)
        state, taken = values, []
        for members in blanket.classes:
            new, grown = picked(proposal, volume, members, blanket)
            dead = self._outside(new)
            found = compare(blanket, state, new, members, dead)
            log_ratio = found.own + found.rest + grown
            accept = accepted(log_ratio, rng)
            new = instead(~accept, found.new, blanket.current(state, members))
            state = {**state, name: blanket.moved(state, new, members)}
            at = slice(None) if members is None else members
            rates[:, at] = chance(log_ratio).reshape(len(now), -1)
            free[:, at] = instead(~accept.reshape(len(now), -1), tried[:, at], free[:, at])
            taken.append(accept.reshape(len(now), -1))
        if warmup:
            steps = self.steps.learnt(memory["steps"], free, rates)
            return {name: state[name]}, {**memory, "steps": steps}
        share = np.concatenate(taken, axis=1).mean(axis=1)
        return {name: state[name]}, counted(memory, share)

    def end_warmup(self, memory: Memory) -> Memory:
        return {**memory, "steps": self.steps.frozen(memory["steps"])}

    # ---- private -------------------------------------------------------------------------------

    def _transform(self, values: Values) -> Transform:
        """The map to the numbers that walk, given the parents."""
        blanket = self.blanket
        support = blanket.node.support  # None where its bounds depend on parents
        if support is None and blanket.own is not None:
            support = blanket.own.distribution(values)[0].support
        assert support is not None
        return walked(support, blanket.event_shape, self.unconstrained)

    def _free(self, transform: Transform, value: np.ndarray) -> np.ndarray:
        """The numbers that walk, shape (chains, elements, size)."""
        return finite(transform.unconstrain(value)).reshape(
            len(value), self.blanket.size, self.steps.size
        )

    def _volume(self, transform: Transform, free: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        log = transform.log_abs_det_jacobian(free.reshape(shape + self.free_shape))
        return np.broadcast_to(log, shape)

    def _outside(self, new: np.ndarray) -> np.ndarray | None:
        """Proposals outside the support of a variable that has no density of its own."""
        if self.blanket.own is not None or self.unconstrained:
            return None
        assert self.blanket.node.support is not None
        return ~self.blanket.node.support.contains(new)


def some_support(model: Model, name: str, known: Mapping[str, np.ndarray] | None = None) -> Support:
    """The support of a node; if its bounds depend on parents, that for some values of these.

    Bounds may be out of order at these values: it is asked for its kind.
    """
    support = model[name].support
    if support is not None:
        return support
    with marking_invalid(), np.errstate(all="ignore"):
        return model.evaluate(name, {**model.probe, **(known or {})})[0].support


def walked(support: Support, event_shape: tuple[int, ...], unconstrained: bool) -> Transform:
    """The map from the numbers that walk to values: on a node's own scale, they are the values."""
    if unconstrained:
        return transform_of(support, event_shape)
    return (Wrapped if support.kind == "circle" else Identity)(event_shape)


def finite(free: np.ndarray) -> np.ndarray:
    """Free numbers with those at a bound moved next to it."""
    if np.isfinite(free).all():
        return free
    return np.clip(np.nan_to_num(free, nan=0.0), -_FAR, _FAR)


def picked(
    value: np.ndarray, log: np.ndarray, members: np.ndarray | None, blanket: Blanket
) -> tuple[np.ndarray, np.ndarray]:
    """A class of elements of a value ``(chains, *plates, *event)`` and of numbers ``(chains, *plates)``."""
    if members is None:
        return value, log
    chains = len(value)
    flat = value.reshape(chains, blanket.size, *blanket.event_shape)
    return flat[:, members], log.reshape(chains, -1)[:, members]


@dataclass(frozen=True)
class Part:
    """Where the numbers of one node stand in the vector of a block.

    Attributes
    ----------
    free : ndarray or None
        Flat plate elements that move; None where all do.
    shape : tuple of int
        Of the unconstrained numbers of one element.
    start, stop : int
    """

    name: str
    free: np.ndarray | None
    shape: Shape
    start: int
    stop: int


def parts_of(target: Target, names: Sequence[str], unconstrained: bool = True) -> list[Part]:
    """Where the numbers of each node stand in the vector of a block; names with parents first."""
    parts, start = [], 0
    for name in names:
        node = target.model[name]
        free = target.free_elements(name)
        support = some_support(target.model, name)
        shape = walked(support, node.event_shape, unconstrained).unconstrained_shape
        count = math.prod(node.plate_shape) if free is None else len(free)
        stop = start + count * math.prod(shape)
        parts.append(Part(name, free, shape, start, stop))
        start = stop
    return parts


def angles_of(target: Target, part: Part, unconstrained: bool) -> np.ndarray:
    """Which numbers of a part are angles, shape (stop - start,)."""
    support = some_support(target.model, part.name)
    one = turning(support, target.model[part.name].event_shape, unconstrained)
    return np.tile(one, (part.stop - part.start) // max(len(one), 1))


def may_be_drawn_anew(target: Target, names: Sequence[str]) -> bool:
    """Whether some nodes are all that is hidden, few numbers, each with a prior that can be drawn from.

    Angles are left out, which a mixture does not know to be such, and nodes that are seen in part.
    """
    nodes = [target.model[n] for n in names]
    if set(names) != set(target.chain) or any(n not in target.terms for n in names):
        return False
    if any(n.is_discrete or n.unsampled or target.seen(n.name) is not None for n in nodes):
        return False
    parts = parts_of(target, names)
    angles = (turned for part in parts for turned in angles_of(target, part, True))
    return parts[-1].stop <= _FEW and not any(angles)
