"""What an auxiliary filter and a rejuvenating one do besides moving: look ahead, and begin anew.

A *first stage* gives every particle a factor by what the next row would make of it, before it is moved; its
offspring are weighted by the rest. *Rejuvenation* draws a slice from densities that do not look at the slice
before, where no particle explains what was seen.

References
----------
Pitt and Shephard (1999), Filtering via simulation: auxiliary particle filters, JASA 94.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.proposal import FUNCTION, as_function, bound
from bayesmc.engines.proposing import Propose
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import BayesmcError, ModelError, UnknownNodeError
from bayesmc.kernels.proposal import Key, names_of
from bayesmc.network import CompiledNode, Model
from bayesmc.network.align import Aligner
from bayesmc.network.forward import Compute, Draw, Pass, Step, WeighDrawn, current_distribution
from bayesmc.network.model import arguments_of
from bayesmc.network.node import bind
from bayesmc.network.store import unknown

#: a first-stage factor is at least this share of the largest (in logs), so that nothing is ruled out
_LEAST = -50.0


class PluggedIn:
    """The default first stage: the density of the row at the means of what is hidden.

    Where a node has no mean (finite nodes, heavy tails) a draw stands for it.
    """

    def __init__(self, plan: SlicePlan) -> None:
        self.plan = plan
        self._steps: dict[frozenset[str], list[Step]] = {}

    def __call__(
        self, before: Mapping[str, np.ndarray], row: Row, rng: np.random.Generator
    ) -> np.ndarray:
        seen = frozenset(n for n, o in row.seen.items() if o.mask is None)
        if seen not in self._steps:
            self._steps[seen] = self._build(seen)
        count = _particles(self.plan, before)
        state = Pass(rng, (count,), {**self.plan.known(row), **before})
        for step in self._steps[seen]:
            step(state)
        lead = tuple(self.plan.slices.first.sizes[p] for p in self.plan.apart)
        return _floored(np.broadcast_to(np.asarray(state.log_weight, dtype=float), (count, *lead)))

    def _build(self, seen: frozenset[str]) -> list[Step]:
        model = self.plan.slices.later
        found: list[Step] = []
        for name in self.plan.slices.dynamic:
            node = model[name]
            if name in seen:
                found.append(WeighDrawn(model, node, self.plan.apart))
            elif node.is_stochastic:
                found.append(_Middle(model, node))
            else:
                found.append(Compute(model, node))
        return found


class GivenStage:
    """A first stage by a user's function of the slice before and the row: log factors, one per particle."""

    def __init__(self, plan: SlicePlan, function: Callable[..., Any]) -> None:
        self.plan, self.model = plan, plan.slices.later
        self.parents, self.function = bind("auxiliary", function, None)
        for parent in self.parents:
            if parent not in self.model.nodes:
                nodes = {n: c.declaration for n, c in self.model.nodes.items()}
                raise UnknownNodeError(
                    f"ParticleFilter: auxiliary= names {parent!r}: {unknown(nodes, parent)}"
                )
        nodes_read = [self.model[p] for p in self.parents]
        self.links = tuple(
            (n.name, Aligner(plan.apart, n.plates, len(n.event_shape), n.domain))
            for n in nodes_read
        )

    def __call__(
        self, before: Mapping[str, np.ndarray], row: Row, rng: np.random.Generator
    ) -> np.ndarray:
        values = {**self.plan.known(row), **before}
        count = _particles(self.plan, before)
        lead = tuple(self.plan.slices.first.sizes[p] for p in self.plan.apart)
        if any(p not in values for p in self.parents):  # what it looks at is missing
            return np.zeros((count, *lead))
        arguments, _ = arguments_of(self.links, values)
        found = np.asarray(self.function(*arguments), dtype=float)
        if found.shape != (count, *lead) or np.isnan(found).any():
            raise ModelError(
                f"ParticleFilter: auxiliary= returns shape {found.shape} "
                f"{'with NaN ' if np.isnan(found).any() else ''}in slice {row.t}; it returns one log factor "
                f"per particle, shape {(count, *lead)}"
            )
        return _floored(found)


class Rejuvenation:
    """Steps of a slice whose nodes are drawn from given densities, without a look at the slice before.

    The weights are those of what was seen, as if the given densities were the model's: the answers of the
    slice, and the evidence, are biased by that.
    """

    def __init__(self, plan: SlicePlan, given: Mapping[Key, Any]) -> None:
        self.plan = plan
        self.drawn = {n for key in given for n in names_of(key)}
        self.first = [self._bound(plan.slices.first, k, v) for k, v in given.items()]
        self.later = [self._bound(plan.slices.later, k, v) for k, v in given.items()]
        short = [n for n in plan.slices.interface if plan.slices.later[n].is_stochastic]
        missing = sorted(set(short) - self.drawn)
        if missing:
            raise ModelError(
                f"ParticleFilter: rejuvenation= says nothing of {missing[0]!r}, which the next slice reads; "
                "give a density for each of " + ", ".join(map(repr, short))
            )

    def __call__(self, row: Row) -> Sequence[Step]:
        model = self.plan.slices.model(row.t)
        by_target = {n: p for p in (self.first if row.t == 0 else self.later) for n in p.names}
        found: list[Step] = []
        done: set[str] = set()
        for name in self.plan.slices.dynamic:
            if name in row.seen or name not in by_target:
                found.append(self.plan.step(row, name))
            elif name not in done:
                found.append(_Anew(model, row.seen, by_target[name], self.plan.apart))
                done |= set(by_target[name].names)
        return found

    def _bound(self, model: Model, key: Key, spec: Any) -> Any:
        function = as_function("ParticleFilter", key, spec, FUNCTION)
        return bound("ParticleFilter", model, key, function)


# ---- private ------------------------------------------------------------------------------------


class _Middle:
    """A hidden node at its conditional mean, or at a draw where it has none."""

    def __init__(self, model: Model, node: CompiledNode) -> None:
        self.model, self.node, self.draw = model, node, Draw(model, node)

    def __call__(self, state: Pass) -> None:
        if self.node.is_discrete:
            self.draw(state)
            return
        dist = current_distribution(self.model, self.node, state)
        try:
            mean = np.asarray(dist.mean, dtype=float)
        except (BayesmcError, NotImplementedError, AttributeError):
            self.draw(state)
            return
        if not np.isfinite(mean).all():
            self.draw(state)
            return
        state.values[self.node.name] = np.broadcast_to(mean, state.batch + self.node.value_shape)


class _Anew(Propose):
    """Draws that are taken as they come: nothing is divided out of the weight."""

    def _divide(
        self, log_q: np.ndarray, outside: np.ndarray, alive: np.ndarray, state: Pass
    ) -> None:
        if outside.any():
            state.weigh(np.where(outside, -np.inf, 0.0))


def _particles(plan: SlicePlan, before: Mapping[str, np.ndarray]) -> int:
    """How many particles the slice before has; what was seen has no axis for them."""
    for name, value in before.items():
        if value.ndim > len(plan.slices.later[name].value_shape):
            return len(value)
    return 1


def _floored(log: np.ndarray) -> np.ndarray:
    top = log.max(axis=0)
    if not np.all(np.isfinite(top)):
        return np.where(np.isfinite(top), np.maximum(log, top + _LEAST), 0.0)
    return np.maximum(log, top + _LEAST)
