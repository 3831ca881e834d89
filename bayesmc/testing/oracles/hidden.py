"""A question as a plain function: the log joint density of what is hidden, at free numbers.

The finite hidden elements are listed (every joint state is a configuration), the continuous ones become
unconstrained numbers, and what nothing observed depends on is left out (Shachter 1986). Integrating this
function is for others; it knows how a net evaluates a node given its parents, and nothing of engines.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, marking_invalid
from bayesmc.distributions.support import Support
from bayesmc.distributions.transforms import Identity, Transform, transform_of
from bayesmc.errors import BayesmcError, BudgetError, DensityError, ParameterError, UnsupportedError
from bayesmc.network import CompiledNode, Problem

#: numbers in flight at a time
_CHUNK = 4_000_000
#: beyond it a draw is no place to start from
_FAR = 1e8


@dataclass(frozen=True)
class FreeElement:
    """A hidden continuous element: its place in the node, and its free numbers in the vector of all."""

    name: str
    element: int
    start: int
    shape: tuple[int, ...]

    @property
    def stop(self) -> int:
        return self.start + math.prod(self.shape)


@dataclass(frozen=True, eq=False)
class Evaluated:
    """One evaluation of the joint density.

    Attributes
    ----------
    log_density : ndarray, shape (*batch,)
        With the change of volume of the free numbers; minus infinity at bad parameters.
    values : dict
        Node -> stored values, whose batch axes broadcast to the batch.
    suspect : ndarray, shape (*batch,)
        Where parameters are bad, the log density but for the nodes that have them; else minus infinity.
    beyond : ndarray, shape (*batch,)
        The log density where a value is closer to a bound than floating point tells, and so neither value nor
        density is right; else minus infinity.
    """

    log_density: np.ndarray
    values: dict[str, np.ndarray]
    suspect: np.ndarray
    beyond: np.ndarray


class HiddenPart:
    """What is hidden and matters to a question.

    Parameters
    ----------
    problem : Problem
    max_configurations : int
        Of finite hidden elements.
    read : set of str, optional
        Nodes whose hidden elements count, with all their ancestors; by default those that something
        observed, or a potential, depends on.

    Attributes
    ----------
    read : set of str
    free : tuple of FreeElement
        Hidden continuous elements among them.
    dimension : int
        Number of free numbers.
    states : dict
        Hidden (or partly hidden) finite node -> stored values, shape ``(configurations, *plates)``.
    count : int
        Number of configurations.
    """

    def __init__(
        self, problem: Problem, max_configurations: int, read: set[str] | None = None
    ) -> None:
        self.problem, self.model = problem, problem.model
        self.read = needed_nodes(problem) if read is None else read
        self.limit = max_configurations
        self.transforms: dict[str, Transform] = {}
        self.trouble: BayesmcError | None = None
        self.states: dict[str, np.ndarray] = {}
        self.count = 1
        self._integrated: set[str] = set()
        free: list[FreeElement] = []
        values: dict[str, np.ndarray] = {n: v[None] for n, v in problem.inputs.items()}
        with marking_invalid(), np.errstate(all="ignore"):
            for name, node in self.visited():
                result, _ = self.model.evaluate(name, values)
                if not isinstance(result, Distribution):
                    # a constant has no axis of configurations
                    constant = np.ndim(result) == len(node.value_shape)
                    values[name] = np.asarray(result)[None] if constant else result
                elif not self._hidden(node).size:
                    values[name] = problem.observed[name].value[None]
                elif result.is_discrete:
                    values = self._list_states(node, result, values)
                else:
                    free += self._free_elements(node, result, free[-1].stop if free else 0)
                    values[name] = self._filled(node, self._middle(node, result))
        self.free = tuple(free)
        self._integrated |= {f.name for f in free}
        self.dimension = free[-1].stop if free else 0
        #: numbers that one evaluation of one configuration holds
        self.weight = sum(math.prod(node.value_shape) for _, node in self.visited()) or 1

    def evaluate(self, states: Mapping[str, np.ndarray], free: np.ndarray) -> Evaluated:
        """The joint density at free numbers ``(*batch, dimension)`` and states ``(*batch, *plates)``."""
        values: dict[str, np.ndarray] = {
            n: v[(None,) * (free.ndim - 1)] for n, v in self.problem.inputs.items()
        }
        total: Any = np.zeros(())
        anywhere: Any = np.zeros((), dtype=bool)
        lost: Any = np.zeros((), dtype=bool)
        with marking_invalid(), np.errstate(all="ignore"):
            for name, node in self.visited():
                result, _ = self.model.evaluate(name, values)
                if not isinstance(result, Distribution):
                    values[name] = result
                    continue
                values[name], density, volume = self.weigh(node, result, states, free)
                bad = self._bad(node, result, density)
                if bad is not None:
                    anywhere, density = anywhere | bad, np.where(bad, 0.0, density)
                total = total + density + volume
            for name in self.model.potentials:
                total = total + self.model.potential(name, values)
        for f in self.free:
            lost = lost | self._is_beyond(f, values[f.name], free)
        log_density = np.where(anywhere | lost, -np.inf, total)
        beyond = np.where(lost & ~anywhere, total, -np.inf)
        return Evaluated(log_density, values, np.where(anywhere, total, -np.inf), beyond)

    def log_density(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log densities ``(configurations, points)`` at free numbers ``(points, dimension)``, and what of
        them is suspect, and beyond floating point."""
        states = {n: v[:, None] for n, v in self.states.items()}
        shape = (self.count, len(free))
        logs, suspect, beyond = np.empty(shape), np.empty(shape), np.empty(shape)
        step = max(1, _CHUNK // (self.weight * self.count))
        for at in range(0, len(free), step):
            found = self.evaluate(states, free[None, at : at + step])
            logs[:, at : at + step] = found.log_density
            suspect[:, at : at + step] = found.suspect
            beyond[:, at : at + step] = found.beyond
        return logs, suspect, beyond

    def log_density_of(self, configuration: int, free: np.ndarray) -> np.ndarray:
        """Log density of one configuration at free numbers ``(points, dimension)``."""
        states = {n: v[configuration][None] for n, v in self.states.items()}
        step = max(1, _CHUNK // self.weight)
        parts = [
            np.broadcast_to(
                self.evaluate(states, free[at : at + step]).log_density, len(free[at : at + step])
            )
            for at in range(0, len(free), step)
        ]
        return np.concatenate(parts)

    def values_at(self, rows: np.ndarray, free: np.ndarray) -> dict[str, np.ndarray]:
        """Stored values of all nodes that matter, by row, at configurations ``rows`` and free numbers."""
        states = {n: v[rows] for n, v in self.states.items()}
        values = {n: v[None] for n, v in self.problem.inputs.items()}
        with marking_invalid(), np.errstate(all="ignore"):
            for name, node in self.visited():
                result, _ = self.model.evaluate(name, values)
                if isinstance(result, Distribution):
                    result, _ = self._value(node, result, states, free)
                values[name] = result
        return {n: values[n] for n, _ in self.visited()}

    def draws(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Free numbers drawn from the prior, ``(configurations, count, dimension)``; where a density has no
        sampler, from a wide normal."""
        batch = (self.count, count)
        free = np.zeros((*batch, self.dimension))
        values: dict[str, np.ndarray] = {n: v[None, None] for n, v in self.problem.inputs.items()}
        with marking_invalid(), np.errstate(all="ignore"):
            for name, node in self.visited():
                result, _ = self.model.evaluate(name, values)
                if not isinstance(result, Distribution):
                    values[name] = result
                    continue
                mine = [f for f in self.free if f.name == name]
                if mine:
                    transform = self._transform(node, result)
                    drawn = self._drawn(node, result, transform, rng, batch)
                    flat = drawn.reshape(*batch, -1, *transform.unconstrained_shape)
                    for f in mine:
                        free[..., f.start : f.stop] = flat[:, :, f.element].reshape(*batch, -1)
                states = {n: v[:, None] for n, v in self.states.items()}
                values[name], _ = self._value(node, result, states, free)
        return free

    def visited(self) -> list[tuple[str, CompiledNode]]:
        """Nodes that matter, parents first, without inputs."""
        return [
            (n, node)
            for n, node in self.model.nodes.items()
            if node.kind != "input" and (n in self.read or n in self.problem.observed)
        ]

    def seen(self, node: CompiledNode, elements: int) -> np.ndarray:
        """Which elements of a node are observed, flat."""
        found = self.problem.observed.get(node.name)
        if found is None:
            return np.zeros(elements, dtype=bool)
        return np.ones(elements, dtype=bool) if found.mask is None else found.mask.ravel()

    def weigh(
        self,
        node: CompiledNode,
        dist: Distribution,
        states: Mapping[str, np.ndarray],
        free: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, Any]:
        """A stochastic node's stored values, its log density and the log volume of its free numbers, both
        summed over the elements that matter."""
        value, volume = self._value(node, dist, states, free)
        plates = tuple(range(-len(node.plate_shape), 0))
        counts = self.seen(node, math.prod(node.plate_shape)).reshape(node.plate_shape)
        if node.name in self._integrated or node.name in states:
            volume = np.where(counts, 0.0, volume)
            counts = np.ones(node.plate_shape, dtype=bool)
        given = node.domain.to_support(value) if node.domain is not None else value
        density = dist.log_prob_unchecked(np.asarray(given))
        if plates:
            head = density.shape[: max(density.ndim - len(plates), 0)]
            full = np.broadcast_to(density, head + node.plate_shape)
            density = (full if counts.all() else np.where(counts, full, 0.0)).sum(axis=plates)
            volume = volume.sum(axis=plates) if volume.ndim else volume
        return value, density, volume

    # ---- private ----------------------------------------------------------------------------

    def _hidden(self, node: CompiledNode) -> np.ndarray:
        """Flat places of the hidden elements that matter."""
        elements = math.prod(node.plate_shape)
        if node.name not in self.read:
            return np.arange(0)
        return np.flatnonzero(~self.seen(node, elements))

    def _list_states(
        self, node: CompiledNode, dist: Distribution, values: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Every configuration so far once for every joint state of a node's hidden elements."""
        low, high = np.min(dist.support.low), np.max(dist.support.high)
        if node.event_shape or not (np.isfinite(low) and np.isfinite(high)):
            raise UnsupportedError(
                f"the hidden node {node.name!r} has too many values to list "
                f"({dist.support.describe()}); observe it"
            )
        support = np.arange(int(low), int(high) + 1)
        stored = node.domain.from_support(support) if node.domain is not None else support
        hidden = self._hidden(node)
        count = len(stored) ** len(hidden)
        if self.count * count > self.limit:
            raise BudgetError(
                f"the finite hidden nodes up to {node.name!r} have {self.count * count} joint states, "
                f"more than {self.limit}; observe more of them, or take a smaller net",
                8 * self.count * count,
            )
        every = stored[np.indices((len(stored),) * len(hidden)).reshape(len(hidden), -1).T]
        full = np.zeros((count, math.prod(node.plate_shape)), dtype=stored.dtype)
        if node.name in self.problem.observed:
            full[:] = self.problem.observed[node.name].value.ravel()
        full[:, hidden] = every
        old = np.repeat(np.arange(self.count), count)
        wide = {n: v if len(v) == 1 else v[old] for n, v in values.items()}
        self.states = {n: v[old] for n, v in self.states.items()}
        column = np.tile(full, (self.count, 1)).reshape(-1, *node.plate_shape)
        self.count *= count
        self.states[node.name] = wide[node.name] = column
        return wide

    def _free_elements(
        self, node: CompiledNode, dist: Distribution, start: int
    ) -> list[FreeElement]:
        shape = self._transform(node, dist).unconstrained_shape
        size = math.prod(shape)
        return [
            FreeElement(node.name, int(e), start + k * size, shape)
            for k, e in enumerate(self._hidden(node))
        ]

    def _transform(self, node: CompiledNode, dist: Distribution) -> Transform:
        """From free numbers to values; kept where the bounds are the same everywhere."""
        if node.name in self.transforms:
            return self.transforms[node.name]
        support = dist.support
        if support.kind == "circle":  # once around, not a covering: its integral is finite
            support = Support("interval", -np.pi, np.pi, open_low=True, open_high=True)
        if any(part.kind == "circle" for part, _ in support.parts):
            raise UnsupportedError(
                f"the hidden node {node.name!r} is a vector with angles among its parts; observe it, "
                "or split it into nodes"
            )
        transform = transform_of(support, dist.event_shape)
        if node.support is not None:  # what compiling found to be the same for all parents
            self.transforms[node.name] = transform
        return transform

    def _middle(self, node: CompiledNode, dist: Distribution) -> np.ndarray:
        transform = self._transform(node, dist)
        value = transform.constrain(
            np.zeros((1, *node.plate_shape, *transform.unconstrained_shape))
        )
        return np.asarray(value)

    def _filled(self, node: CompiledNode, value: np.ndarray) -> np.ndarray:
        """The value with what is observed in its place."""
        found = self.problem.observed.get(node.name)
        if found is None:
            return value
        if found.mask is None:
            return found.value[(None,) * (value.ndim - found.value.ndim)]
        mask = found.mask.reshape(found.mask.shape + (1,) * len(node.event_shape))
        return np.where(mask, found.value, value)

    def _value(
        self,
        node: CompiledNode,
        dist: Distribution,
        states: Mapping[str, np.ndarray],
        free: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """A stochastic node's stored values, and the log volume of its free numbers by element."""
        if node.name in states:
            return states[node.name], np.zeros(())
        if node.name in self._integrated:
            return self._constrained(node, dist, free)
        lead = (None,) * (free.ndim - 1)
        return self.problem.observed[node.name].value[lead], np.zeros(())

    def _constrained(
        self, node: CompiledNode, dist: Distribution, free: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values of a continuous node, hidden ones from free numbers, and the log volume by element."""
        transform = self._transform(node, dist)
        shape = transform.unconstrained_shape
        batch, elements = free.shape[:-1], math.prod(node.plate_shape)
        numbers = np.zeros((*batch, elements, math.prod(shape)))
        for f in (f for f in self.free if f.name == node.name):
            numbers[..., f.element, :] = free[..., f.start : f.stop]
        numbers = numbers.reshape(*batch, *node.plate_shape, *shape)
        value = self._filled(node, transform.constrain(numbers))
        # beyond the largest float the volume would grow on while value and density stand still
        most = math.log(np.finfo(float).max) * math.prod(shape)
        return value, np.minimum(transform.log_abs_det_jacobian(numbers), most)

    def _is_beyond(self, f: FreeElement, value: np.ndarray, free: np.ndarray) -> Any:
        """Where the way from free numbers to a value does not lead back."""
        transform = self.transforms.get(f.name)
        if transform is None or isinstance(transform, Identity):
            return False
        node = self.model[f.name]
        own = value.reshape(*free.shape[:-1], -1, *node.event_shape)
        cut = own.ndim - 1 - len(node.event_shape)
        back = transform.unconstrain(np.take(own, f.element, axis=cut))
        off = np.abs(back.reshape(*free.shape[:-1], -1) - free[..., f.start : f.stop])
        return ~(off <= 0.5).all(axis=-1)

    def _drawn(
        self,
        node: CompiledNode,
        dist: Distribution,
        transform: Transform,
        rng: np.random.Generator,
        batch: tuple[int, ...],
    ) -> np.ndarray:
        shape = (*batch, *node.plate_shape, *transform.unconstrained_shape)
        try:
            drawn = transform.unconstrain(dist.sample_to(rng, (*batch, *node.plate_shape)))
        except BayesmcError:  # a density given as an equation only
            return 3.0 * rng.standard_normal(shape)
        return np.where(np.abs(drawn) < _FAR, drawn, rng.standard_normal(shape))

    def _bad(
        self, node: CompiledNode, dist: Distribution, density: np.ndarray
    ) -> np.ndarray | None:
        """Where a node's parameters or its density are none, with what is wrong kept."""
        bad = ~(density < np.inf)
        if bad.any():
            self.trouble = self.trouble or DensityError(
                f"node {node.name!r}: the log density of {dist!r} is "
                f"{density[bad].flat[0] if density.ndim else density}; it must be below infinity and "
                "not NaN"
            )
        if dist.invalid is not None:
            self.trouble = ParameterError(f"node {node.name!r}: {dist.problem}")
            lead = max(dist.invalid.ndim - len(node.plate_shape), 0)
            axes = tuple(range(lead, dist.invalid.ndim))
            bad = bad | dist.invalid.any(axis=axes)
        return bad if bad.any() else None


def needed_nodes(problem: Problem) -> set[str]:
    """Nodes that evidence or potentials depend on."""
    model = problem.model
    read = {p for potential, _ in model.potentials.values() for p in potential.parents}
    for name in reversed(model.nodes):
        if name in read or name in problem.observed:
            read |= set(model[name].parents)
    return read
