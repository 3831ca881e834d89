"""What is hidden and what is known in each slice of an unrolled question, and the steps that pass through it.

The posterior of the unrolled net says which nodes are in the chain (hidden, and something observed depends
on them); particles draw those of the slices, by the template's own two-slice model. Values come and go under
their names in the unrolled net, ``"x[3]"``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, SeriesProblem
from bayesmc.engines.slice_steps import SlicePlan, plates_apart
from bayesmc.errors import ParameterError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.forward import Compute, Pass, Step, summed
from bayesmc.network.probing import depends_on_numbers
from bayesmc.structure.target import Target, Values

#: what becomes of a node of a slice
_HIDDEN, _SEEN, _LINK = "hidden", "seen", "link"


@dataclass(frozen=True, eq=False)
class Slice:
    """One slice as particles pass it.

    Attributes
    ----------
    t : int
    known : dict
        Values in place: inputs, ``t``, what was observed and what follows from it.
    hidden : dict
        Node -> its name in the unrolled net, of those that are drawn, parents first.
    moves : tuple
        Name and step of every node that is drawn, weighed or computed, parents first.
    crossing : tuple of Step
        Factors that the slice before enters, where the slice itself is in place.
    weighs : bool
        Whether anything in it is weighed.
    """

    t: int
    known: Values
    hidden: dict[str, str]
    moves: tuple[tuple[str, Step], ...]
    crossing: tuple[Step, ...]
    weighs: bool


class Trellis:
    """The slices of a question up to the last that matters.

    Parameters
    ----------
    target : Target
        Of the unrolled net.
    series : SeriesProblem
        The question over time that it was unrolled from.

    Attributes
    ----------
    slices : list of Slice
    names : tuple of str
        All hidden nodes of the slices, by their names in the unrolled net.
    static : tuple of str
        Static nodes.
    apart : tuple of str
        Plates whose elements are independent given the static nodes: particles of their own.
    carries : bool
        Whether a deterministic node takes something of a slice two slices on, so that a slice given the one
        before is not all that there is to know.
    """

    def __init__(self, target: Target, series: SeriesProblem) -> None:
        self.target, self.series = target, series
        self.model: Model = series.slices.later
        self.static = tuple(series.slices.template.static)
        self.apart = plates_apart(series.slices)
        self.lead = tuple(series.slices.first.sizes[p] for p in self.apart)
        known = {n: target.known[n] for n in self.static if n in target.known}
        self.plan = SlicePlan(series.slices, self.apart, known)
        self.carries = False
        self._made: dict[Any, tuple[tuple[tuple[str, Step], ...], tuple[Step, ...]]] = {}
        self.slices = [self._slice(k) for k in range(self._last() + 1)]
        self.names = tuple(own for s in self.slices for own in s.hidden.values())

    def statics(self, values: Values) -> Values:
        """The static nodes' part of a state."""
        return {n: values[n] for n in self.static if n in values}

    # ---- private -------------------------------------------------------------------------------

    def _last(self) -> int:
        """The last slice with something to draw or to weigh."""
        inside = {*self.target.chain, *self.target.terms}
        dynamic = self.series.slices.dynamic
        used = (k for k in range(self.series.steps) for n in dynamic if f"{n}[{k}]" in inside)
        return max(used, default=-1)

    def _slice(self, k: int) -> Slice:
        target, slices = self.target, self.series.slices
        row = self.series.series.row(k)
        kinds: dict[str, str] = {}
        known: Values = dict(row.inputs)
        for name in slices.dynamic:
            own = f"{name}[{k}]"
            if own in target.chain:
                kinds[name] = _HIDDEN
                continue
            if own in target.known:
                known[name] = target.known[own]
            if own in target.terms:
                kinds[name] = _SEEN
            elif own in target.links:
                kinds[name] = _LINK
        varying = {*target.chain, *target.links}
        reached = {n + PREVIOUS for n in slices.interface if f"{n}[{k - 1}]" in varying}
        moves, crossing = self._steps(row, kinds, reached)
        hidden = {n: f"{n}[{k}]" for n, kind in kinds.items() if kind == _HIDDEN}
        return Slice(row.t, known, hidden, moves, crossing, bool(row.seen))

    def _steps(
        self, row: Row, kinds: dict[str, str], reached: set[str]
    ) -> tuple[tuple[tuple[str, Step], ...], tuple[Step, ...]]:
        """Moves and crossing factors; slices of one kind share theirs."""
        partly = any(seen.mask is not None for seen in row.seen.values())
        key = (row.t == 0, tuple(kinds.items()), frozenset(row.seen), frozenset(reached))
        if not partly and key in self._made:
            return self._made[key]
        model = self.series.slices.model(row.t)
        moves = tuple((n, self._tolerant(model, n, self.plan.step(row, n))) for n in kinds)
        found = moves, self._crossing(row, kinds, reached)
        if not partly:
            self._made[key] = found
        return found

    def _crossing(self, row: Row, kinds: dict[str, str], reached: set[str]) -> tuple[Step, ...]:
        if not reached:
            return ()
        model = self.series.slices.later
        touched = set(reached)
        factors = []
        for name, kind in kinds.items():
            if not touched & set(model[name].parents):
                continue
            if kind == _LINK:
                touched.add(name)
                self.carries |= name in self.series.slices.interface
            else:
                factors.append(name)
        needed = set(factors)
        for name in reversed(kinds):
            if name in needed:
                needed |= {p for p in model[name].parents if kinds.get(p) == _LINK}
        steps: list[Step] = []
        for name, kind in kinds.items():
            if name not in needed:
                continue
            if kind == _LINK:
                steps.append(Compute(model, model[name]))
                continue
            masked = kind == _SEEN and row.seen[name].mask is not None
            step = self.plan.step(row, name) if masked else self.plan.factor(row, name)
            steps.append(self._tolerant(model, name, step))
        return tuple(steps)

    def _tolerant(self, model: Model, name: str, step: Step) -> Step:
        return Tolerant(model, model[name], step, self.apart) if model[name].is_stochastic else step


class Tolerant:
    """A step that takes parameters which over- or underflow, or are out of range: a density of zero.

    Parameters that are wrong at configurations of finite parents still raise.
    """

    def __init__(
        self, model: Model, node: CompiledNode, step: Step, apart: tuple[str, ...]
    ) -> None:
        self.model, self.node, self.step, self.apart = model, node, step, apart

    def __call__(self, state: Pass) -> None:
        try:
            self.step(state)
        except ParameterError:
            dist, batch = self.model.evaluate(self.node.name, state.values)
            if dist.invalid is None or dist.problem is None:
                raise
            if not dist.problem.is_overflow and not depends_on_numbers(self.model, self.node):
                raise
            full = np.broadcast_to(dist.invalid, batch + self.node.plate_shape)
            state.weigh(summed(np.where(full, -np.inf, 0.0), self.node, self.apart))
            self.step(state)
