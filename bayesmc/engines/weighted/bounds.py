"""Upper bounds on what the evidence can weigh, for rejection sampling: proved, or given and checked.

A bound is on the log density of each observed element given its parents, whatever they are. It is proved by
trying all configurations of finite parents, where a location family's height does not depend on the other
hidden ones; a probability is at most 1. What cannot be proved must be given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Cauchy,
    Laplace,
    MvNormal,
    Normal,
    StudentT,
    marking_invalid,
)
from bayesmc.errors import EnvelopeError, EvidenceError, ShapeError, UnknownNodeError
from bayesmc.expression import Family, expressions_of
from bayesmc.network import CompiledNode, Model, Problem
from bayesmc.network.declaring import unknown
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.forward import Pass, Step
from bayesmc.network.model import potential_shape
from bayesmc.shapes import Shape, broadcasts_to
from bayesmc.structure.tables import Reads, configure, constants_of, reads_of

#: configurations, times plate elements, up to which parents are tried out
_CONFIGURATIONS = 1 << 20
#: axes that configurations may take, below NumPy's limit with room for plates and events
_AXES = 40
#: families that are highest at ``loc``, at a height that only their other parameters set
_LOCATION_FAMILIES = (Normal, MvNormal, StudentT, Laplace, Cauchy)
#: how far rounding may carry a log density above its bound
_SLACK = 1e-9


def log_bounds(
    problem: Problem, given: Mapping[str, Any]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Log bounds of every weight of a problem, per plate element, and the names that have none.

    The names are those of observed nodes and of potentials; a given bound goes before a proved one.
    """
    model = problem.model
    for name in given:
        _check_name(problem, name)
    found: dict[str, np.ndarray] = {}
    missing = []
    for name in [*problem.observed, *model.potentials]:
        shape = _plate_shape(model, name)
        if name in given:
            bound = np.asarray(given[name], dtype=float)
            if not broadcasts_to(bound.shape, shape):
                raise ShapeError(
                    f"Rejection: the bound of {name!r} has shape {bound.shape}, but its plates make "
                    f"{shape}; give one number, or one for each element"
                )
            found[name] = np.broadcast_to(bound, shape)
            continue
        proved = proved_log_bound(problem, name)
        if proved is None:
            missing.append(name)
        else:
            found[name] = proved
    return found, missing


def total_log_bound(problem: Problem, name: str, bound: np.ndarray) -> float:
    """The bound of a node's or potential's whole weight: only observed elements count."""
    seen = problem.observed.get(name)
    if seen is not None and seen.mask is not None:
        bound = np.where(seen.mask, bound, 0.0)
    return float(bound.sum())


def proved_log_bound(problem: Problem, name: str) -> np.ndarray | None:
    """A bound on an observed node's log density at what was seen (or on a potential), if one is proved.

    Returns
    -------
    ndarray, shape plates, or None
    """
    model = problem.model
    if name in model.potentials:
        indexed = model.potentials[name][0].index is not None
        return None if indexed else _largest_potential(problem, name)
    node = model[name]
    bound = _largest_density(problem, node)
    if bound is not None:
        return bound
    return np.zeros(node.plate_shape) if node.is_discrete else None


class Bounded:
    """A weighing step relative to its bound: the weight becomes a probability of acceptance.

    A weight above the bound raises, with the parents' values.
    """

    def __init__(self, problem: Problem, name: str, step: Step, log_bound: float) -> None:
        self.model = problem.model
        self.name = name
        self.step = step
        self.log_bound = log_bound
        self.limit = log_bound + _SLACK * max(1.0, abs(log_bound))

    def __call__(self, state: Pass) -> None:
        before = np.asarray(state.log_weight)
        # draws that are rejected already stay so, whatever they weigh here
        state.log_weight = np.where(before > -np.inf, 0.0, -np.inf)
        self.step(state)
        gained = np.asarray(state.log_weight)
        if gained.size and not gained.max() <= self.limit:
            raise self._violated(np.broadcast_to(gained, state.batch), state)
        state.log_weight = before + (gained - self.log_bound)

    def _violated(self, gained: np.ndarray, state: Pass) -> EnvelopeError:
        draw = int(np.argmax(gained))
        potential = self.model.potentials.get(self.name)
        parents = self.model[self.name].parents if potential is None else potential[0].parents
        point = {
            parent: _value_at(self.model[parent], state.values[parent], draw) for parent in parents
        }
        where = ", ".join(f"{parent}={_shown(value)}" for parent, value in point.items())
        what = f"potential {self.name!r}" if potential is not None else f"density of {self.name!r}"
        excess = float(gained[draw]) - self.log_bound
        return EnvelopeError(
            f"Rejection: the bound is too low: the log {what} is {gained[draw]:.6g} at "
            f"{where or 'what was seen'}, above the bound of {self.log_bound:.6g} by "
            f"{excess:.3g}; accepted draws would be wrong, so raise bound={{{self.name!r}: ...}}",
            point,
            float(np.exp(excess)),
        )


# ---- private ------------------------------------------------------------------------------------


def _check_name(problem: Problem, name: str) -> None:
    model = problem.model
    if name in problem.observed or name in model.potentials:
        return
    if name not in model.nodes:
        declarations = {n: c.declaration for n, c in model.nodes.items()}
        raise UnknownNodeError(f"Rejection: bound= names {name!r}: {unknown(declarations, name)}")
    raise EvidenceError(
        f"Rejection: bound= names {name!r}, which is not observed and so weighs nothing; leave it out"
    )


def _plate_shape(model: Model, name: str) -> Shape:
    if name in model.potentials:
        return potential_shape(model.sizes, model.potentials[name][0])
    return model[name].plate_shape


def _largest_potential(problem: Problem, name: str) -> np.ndarray | None:
    """The largest value of a potential over all configurations of finite nodes."""
    potential, _ = problem.model.potentials[name]
    known = _known(problem)
    reads = reads_of(problem.model, potential.parents, potential.plates, known.__contains__)
    if reads.others:
        return None

    def evaluate(values: Mapping[str, Any]) -> np.ndarray:
        return problem.model.potential(name, values, total=False)

    return _largest(problem, potential.parents, potential.plates, known, reads, evaluate)


def _largest_density(problem: Problem, node: CompiledNode) -> np.ndarray | None:
    """The largest log density of what was seen over all configurations of the parents.

    Of a location family whose other parameters depend on finite parents alone it is the one at its location.
    """
    model, seen = problem.model, problem.observed[node.name].value
    known = _known(problem)
    reads = reads_of(model, node.parents, node.plates, known.__contains__)
    if reads.others and not _depends_by_location(model, node.name, reads.others):
        return None
    for name in reads.others:  # any value will do
        probe = model.probe[name]
        lead = probe.ndim - len(model[name].value_shape)
        known[name] = probe[(0,) * lead + (Ellipsis,)]

    def evaluate(values: Mapping[str, Any]) -> np.ndarray:
        dist: Any = model.evaluate(node.name, values)[0]
        if reads.others:
            height = np.asarray(dist.log_prob(dist.loc))
        else:
            height = model.log_density(node.name, dist, seen)
        return height if dist.invalid is None else np.where(dist.invalid, -np.inf, height)

    return _largest(problem, node.parents, node.plates, known, reads, evaluate)


def _depends_by_location(model: Model, name: str, hidden: Sequence[str]) -> bool:
    """Whether some nodes act on a density through its location alone."""
    found = density(model, name)
    if isinstance(found, Opaque) or not isinstance(found.result, Family):
        return False
    family = found.result
    if family.make not in _LOCATION_FAMILIES:
        return False
    others = [v for parameter, v in family.parameters.items() if parameter != "loc"]
    return not any(e.leaves & set(hidden) for e in expressions_of(others))


def _known(problem: Problem) -> dict[str, Any]:
    """Values that never vary."""
    seen = {n: o.value for n, o in problem.observed.items() if o.mask is None}
    return {**constants_of(problem.model, problem.inputs), **seen}


def _largest(
    problem: Problem,
    parents: Sequence[str],
    plates: Sequence[str],
    known: Mapping[str, Any],
    reads: Reads,
    evaluate: Callable[[Mapping[str, Any]], np.ndarray],
) -> np.ndarray | None:
    """The largest value of a function over all configurations of its finite parents, by element."""
    model, shape = problem.model, tuple(problem.model.sizes[p] for p in plates)
    if not _few(model, reads.alone, reads.whole, shape):
        return None
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            values, cards = configure(model, known, reads.alone, reads.whole, parents)
            logs = np.asarray(evaluate(values), dtype=float)
    except Exception:  # a function may fail at what never happens
        return None
    full = np.broadcast_to(logs, cards + shape)
    top = full.max(axis=tuple(range(len(cards))))
    return None if np.isnan(top).any() or (top == np.inf).any() else top


def _few(model: Model, alone: Sequence[str], whole: Sequence[str], shape: Shape) -> bool:
    entries = float(math.prod(shape))
    axes = len(alone)
    for name in alone:
        entries *= model[name].domain.size  # type: ignore[union-attr]
    for name in whole:
        count = math.prod(model[name].plate_shape)
        axes += count
        if axes > _AXES:
            return False
        entries *= float(model[name].domain.size) ** count  # type: ignore[union-attr]
    return axes <= _AXES and entries <= _CONFIGURATIONS


def _value_at(node: CompiledNode, stored: np.ndarray, draw: int) -> Any:
    """A node's user value in one draw."""
    value = stored[draw] if stored.ndim > len(node.value_shape) else stored
    return node.decode(np.asarray(value))


def _shown(value: Any) -> str:
    value = getattr(value, "labels", value)
    return " ".join(np.array2string(np.asarray(value), precision=6, threshold=8).split())
