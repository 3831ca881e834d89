"""The forward pass: visit nodes in topological order, sample what is hidden, weight by what is seen.

Ancestral sampling is this pass without evidence; likelihood weighting and its relatives are this pass
with some. A pass is a list of steps, one per node; engines may put faster steps in their place.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.network.evidence import Observed
from bayesmc.network.model import CompiledNode, Model, invalid_error
from bayesmc.network.node import is_link, way_out_of_lag
from bayesmc.network.probing import depends_on_numbers
from bayesmc.shapes import Shape

#: the log weight of draws that nothing was asked of yet
_NOTHING = 0.0


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
        Sum of the log densities of the evidence so far; broadcasts to ``batch``, or to ``batch`` and those
        plates whose elements have weights of their own.
    """

    rng: np.random.Generator
    batch: Shape
    values: dict[str, np.ndarray]
    log_weight: Any = _NOTHING

    @property
    def alive(self) -> np.ndarray:
        """Draws whose weight is not zero yet (in any plate element that has its own), shape ``batch``."""
        alive: np.ndarray = np.asarray(np.asarray(self.log_weight) > -np.inf)
        if alive.ndim > len(self.batch):
            alive = np.asarray(alive.any(axis=tuple(range(len(self.batch), alive.ndim))))
        return np.broadcast_to(alive, self.batch)

    def weigh(self, log_density: np.ndarray) -> None:
        """Multiply the weights by a density given in logs."""
        if self.log_weight is _NOTHING:
            self.log_weight = log_density
        else:
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
    return with_factors(steps, potential_factors(model))


def potential_factors(model: Model) -> list[tuple[Sequence[str], Step]]:
    """Every potential as a step, with the nodes it needs."""
    return [
        (potential.parents, Potential(model, name))
        for name, (potential, _) in model.potentials.items()
    ]


def with_factors(
    steps: Mapping[str, Step], factors: Iterable[tuple[Sequence[str], Step]]
) -> list[Step]:
    """The nodes' steps with every factor right after the last of the nodes it needs."""
    after: dict[str | None, list[Step]] = {}
    order = {name: k for k, name in enumerate(steps)}
    for needed, factor in factors:
        last = max(needed, key=order.__getitem__, default=None)
        after.setdefault(last, []).append(factor)
    result = list(after.get(None, []))
    for name, step in steps.items():
        result += [step, *after.get(name, [])]
    return result


def step_for(model: Model, node: CompiledNode, observed: Mapping[str, Observed]) -> Step:
    """The plain step of one node."""
    if node.kind == "input":
        return nothing
    if not node.is_stochastic:
        return Compute(model, node)
    seen = observed.get(node.name)
    if seen is None:
        return Draw(model, node)
    return Weigh(model, node, seen) if seen.mask is None else DrawAndWeigh(model, node, seen)


def nothing(state: Pass) -> None:
    """The step of a node whose value is in place already, such as an input."""


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
        dist = current_distribution(self.model, self.node, state, drawn=True)
        state.values[self.node.name] = self.model.sample_stored(
            self.node.name, dist, state.rng, state.batch
        )


class Weigh:
    """An observed node: its density at what was seen is a factor of the weight."""

    def __init__(self, model: Model, node: CompiledNode, seen: Observed) -> None:
        self.node, self.seen = node, seen
        self.weigh = WeighDrawn(model, node)

    def __call__(self, state: Pass) -> None:
        state.values[self.node.name] = self.seen.value
        self.weigh(state)


class WeighDrawn:
    """A node whose value comes from elsewhere: its density given its parents is a factor of the weight.

    Elements of the plates ``apart`` have weights of their own, shape ``(*batch, *apart)``.
    """

    def __init__(self, model: Model, node: CompiledNode, apart: tuple[str, ...] = ()) -> None:
        self.model, self.node, self.apart = model, node, apart

    def __call__(self, state: Pass) -> None:
        dist = current_distribution(self.model, self.node, state)
        log = self.model.log_density(self.node.name, dist, state.values[self.node.name])
        state.weigh(summed(log, self.node, self.apart) if self.node.plates else log)


class DrawAndWeigh:
    """A partly observed node: sample the missing plate elements, weight by the others."""

    def __init__(
        self, model: Model, node: CompiledNode, seen: Observed, apart: tuple[str, ...] = ()
    ) -> None:
        self.model, self.node, self.seen, self.apart = model, node, seen, apart
        assert seen.mask is not None
        self.elements = seen.mask
        self.mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
        self.unseen = ~seen.mask if seen.parts is None else ~(seen.mask | seen.parts.any(axis=-1))

    def __call__(self, state: Pass) -> None:
        dist = current_distribution(self.model, self.node, state, drawn=self.unseen)
        draws = self.model.sample_stored(self.node.name, dist, state.rng, state.batch)
        partial: Any = 0.0
        if self.seen.parts is not None:
            draws, partial = self._in_part(dist, draws, state)
        values = np.where(self.mask, self.seen.value, draws)
        values.flags.writeable = False
        density = self.model.log_density(self.node.name, dist, values)
        total = np.where(self.elements, density, partial)
        state.weigh(summed(total, self.node, self.apart))
        state.values[self.node.name] = values

    def _in_part(self, dist: Any, draws: np.ndarray, state: Pass) -> tuple[np.ndarray, np.ndarray]:
        """Vectors seen in part: the rest of them drawn given that, and the log density of what was seen."""
        parts = self.seen.parts
        assert parts is not None
        value, shape = self.seen.value, state.batch + self.node.plate_shape
        log = np.zeros(shape)
        for pattern in np.unique(parts.reshape(-1, parts.shape[-1]), axis=0):
            if not pattern.any():
                continue
            here = (parts == pattern).all(axis=-1)
            log = np.where(here, dist.log_prob_of(value, pattern), log)
            full = dist.completed(state.rng, shape, value, pattern)
            draws = np.where(here[..., None], full, draws)
        return draws, log


class Potential:
    """An extra log factor."""

    def __init__(self, model: Model, name: str) -> None:
        self.model, self.name = model, name

    def __call__(self, state: Pass) -> None:
        state.weigh(self.model.potential(self.name, state.values))


def current_distribution(
    model: Model, node: CompiledNode, state: Pass, drawn: bool | np.ndarray = False
) -> Distribution:
    """The node's distribution given its parents; bad parameters raise where the weight is positive.

    Elements of the plates that are ``drawn`` may be without noise.
    """
    dist, _ = model.evaluate(node.name, state.values)
    if dist.invalid is not None:
        error = invalid_error(node, dist, state.alive, state.batch, drawn)
        if error is not None:
            raise _advised(error, node, model, dist, state)
    return dist


#: draws all of which are out of range before the function is to blame, and not its parents' priors
_SEVERAL = 20


def _advised(
    error: ParameterError, node: CompiledNode, model: Model, dist: Distribution, state: Pass
) -> ParameterError:
    """The error with what to do where a prior allows what a function does not, or a function is wrong."""
    assert dist.invalid is not None
    full = np.broadcast_to(dist.invalid, state.batch + node.plate_shape)
    element = (error.index or ())[len(state.batch) :]
    where: tuple[Any, ...] = (..., *element)
    each = full[where]
    if each.size >= _SEVERAL and each.all():
        own = {p: np.asarray(state.values[p]) for p in node.parents if p in state.values}
        known = ", ".join(f"{p} = {v.item():g}" for p, v in own.items() if v.ndim == 0)
        error.args = (
            f"{error}; so it is at each of {each.size} draws of its parents"
            f"{f' ({known})' if known else ''}, so that none of them is to blame: mend the function, or the "
            "values that it reads",
        )
    elif depends_on_numbers(model, node):
        error.args = (
            f"{error}; draws of its parents may be out of range: give those a prior that cannot be "
            "(HalfNormal, LogNormal, Truncated), or use Gibbs or MetropolisHastings, which reject such "
            "points",
        )
    return error


def summed(log: np.ndarray, node: CompiledNode, apart: tuple[str, ...]) -> np.ndarray:
    """A node's log densities, ``(*lead, *plates)``, summed over all plates but those ``apart``."""
    if not node.plates:
        return log
    lead = log.shape[: max(log.ndim - len(node.plates), 0)]
    full = np.broadcast_to(log, lead + node.plate_shape)
    count = len(lead)
    others = tuple(count + k for k, p in enumerate(node.plates) if p not in apart)
    total = full.sum(axis=others) if others else full
    kept = [p for p in node.plates if p in apart]
    order = [kept.index(p) for p in apart if p in kept]
    if order != sorted(order):
        total = total.transpose(*range(count), *(count + k for k in order))
    return total


def drawn_anew(
    model: Model, wanted: Collection[str], resized: Collection[str], new_inputs: bool
) -> set[str]:
    """Nodes that a prediction draws again: those wanted, in other plates, or computed from what changes."""
    anew: set[str] = set()
    changed: set[str] = set()
    for name, node in model.nodes.items():
        other = any(plate in resized for plate in node.plates)
        if node.kind == "input":
            changed |= {name} if new_inputs or other else set()
        elif (
            name in wanted
            or other
            or (not node.is_stochastic and (anew | changed) & set(node.parents))
        ):
            anew.add(name)
    return anew


def refuse_potentials(model: Model, wanted: Collection[str], what: str) -> None:
    """Drawing a node anew from its parents would ignore a potential on it.

    Raises
    ------
    UnsupportedError
    """
    for name, (potential, _) in model.potentials.items():
        hit = [n for n in wanted if n in potential.parents]
        if hit:
            raise UnsupportedError(
                f"{what}({hit[0]!r}): the potential {name!r} reweights it, which drawing it given its "
                "parents would ignore"
            )


def refuse_parts(observed: Mapping[str, Observed], who: str) -> str | None:
    """Why an engine that takes vectors whole cannot answer: of one only some components are observed."""
    for name, seen in observed.items():
        if seen.parts is not None:
            return (
                f"{who} takes vectors observed in full, and of {name!r} some components are missing and "
                "others are not; use Exact(), Gibbs(), HamiltonianMonteCarlo(), a Kalman filter, "
                "LikelihoodWeighting(draws) or ParticleFilter(particles), split the vector into nodes of its "
                "parts, or leave all of it out"
            )
    return None


def whole(observed: Mapping[str, Observed]) -> list[str]:
    """Nodes that are observed in full; of others only some elements may have to have a density."""
    return [name for name, seen in observed.items() if seen.mask is None]


def refuse_bare(model: Model, observed: Mapping[str, Observed], who: str) -> None:
    """Refuse nodes without noise, and vectors seen in part, on behalf of an oracle.

    Raises
    ------
    UnsupportedError
    """
    reason = refuse_parts(observed, who)
    reason = reason or refuse_noiseless(model, model.nodes, who)
    if reason is not None:
        raise UnsupportedError(reason)


def refuse_noiseless(model: Model, names: Iterable[str], who: str) -> str | None:
    """Why an engine that evaluates the densities of some nodes cannot: one is a point without noise."""
    for name in names:
        if model[name].noiseless and is_link(model[name].declaration):
            return (
                f"{who} evaluates the density of {name!r}, which has none: it is computed from its parents, "
                "and observed. Observe a reading of it with a little noise instead "
                f"(net.add('{name}_seen', lambda {name}: Normal({name}, scale))), or one of its parents; "
                "where the model is linear-Gaussian, Exact() and Kalman filters take it as it is"
            )
        lag = way_out_of_lag(model[name].declaration)
        if model[name].noiseless and lag is not None:
            return f"{who} evaluates the density of {name!r}, which has none: {lag}"
        if model[name].noiseless:
            return (
                f"{who} evaluates the density of {name!r}, which has none: it is without noise (a scale of "
                "0, or a singular covariance), and its value follows from its parents; declare a function "
                "that returns the value instead of a distribution, give it a little noise, or use Exact() or "
                "a Kalman filter where the model is linear-Gaussian"
            )
    return None


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
    if model[from_density[0]].declaration.source == "variable":
        return (
            f"{who} samples every hidden node from its conditional density, but {from_density[0]!r} is a "
            "variable of a factor graph, which has none; use Gibbs(draws), MetropolisHastings(draws), or "
            "Exact() where the graph is discrete and narrow"
        )
    return (
        f"{who} samples every hidden node from its conditional density, but {from_density[0]!r} is a "
        "Density without sample=; give one, or observe the node"
    )
