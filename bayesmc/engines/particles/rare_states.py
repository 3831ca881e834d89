"""States that next to no particle has met, and what the rows make of them.

A state of probability 1e-4 has no particle among a thousand, or one that an earlier row has left without
weight, so nothing shows that the rows ask for it: all particles explain them alike, badly. Where a finite
hidden node has such states, a few scouts are put there, with the weight that the model gives them: they move
on by themselves as long as particles are rare where they are, and the sum of their weights, less that of such
particles, says what the particles leave out. Nothing here touches the particles, or the numbers that they are
drawn with.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.categorical import pick
from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.particles.families import Scouts
from bayesmc.engines.particles.smc import Particles
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.forward import Pass
from bayesmc.network.forward import run as passed

#: scouts that are sent to the unmet states of a node, and those that go on
SCOUTS = 32
#: states of a node up to which it is looked at
STATES = 16
#: nodes of a slice that are looked at
NODES = 4
#: particles below which a state is rare
RARE = 4


class Scouting:
    """Sends scouts to the states that no particle of a slice has.

    Parameters
    ----------
    slices : Slices
    plan : SlicePlan
        Its proposals, if any, are not used.
    """

    def __init__(self, slices: Slices, plan: SlicePlan) -> None:
        self.slices, self.plan = slices, SlicePlan(slices, plan.apart, plan.static)
        self.nodes = () if plan.apart else _looked_at(slices)

    def after(
        self, scouts: Scouts | None, earlier: Particles | None, now: Particles, row: Row
    ) -> Scouts | None:
        """The scouts of a slice, after those of the slice before; None where nobody is needed."""
        if now.rejuvenated is not False:
            return None
        unmet = self._unmet(earlier, now, row)
        if not unmet or not math.isfinite(now.increment):
            return None
        rng = np.random.default_rng([row.t, int(np.float64(now.increment).view(np.uint64))])
        old = None if scouts is None else self._moved(scouts, now, row, rng)
        parties = [] if old is None else [old]
        try:
            parties += self._sent(unmet, earlier, now, row, rng)
        except BayesmcError:  # functions that break on what never came: nothing is said then
            return None
        if not parties:
            return None
        there = float(now.weights[among(now.values, unmet)].sum() / now.total)
        return together([away(p, unmet) for p in parties], there, rng)

    # ---- private -------------------------------------------------------------------------------

    def _unmet(
        self, earlier: Particles | None, now: Particles, row: Row
    ) -> list[tuple[CompiledNode, np.ndarray]]:
        """Nodes of which a state has next to no particle, and such states."""
        found, kept = [], None
        if (
            earlier is not None
            and now.resampled is False
            and len(earlier.weights) == len(now.weights)
        ):
            kept = earlier.weights * (len(earlier.weights) / earlier.total)
        for node in self.nodes:
            value = now.values.get(node.name)
            if node.name in row.seen or value is None or value.ndim == 0:
                continue
            assert node.domain is not None
            counts: Any = np.bincount(value, minlength=node.domain.size)
            if kept is not None:  # where there are particles, but none of any weight
                counts = np.minimum(counts, np.bincount(value, kept, node.domain.size))
            if counts.min() < RARE:
                found.append((node, np.flatnonzero(counts < RARE)))
        return found

    def _sent(
        self,
        unmet: Sequence[tuple[CompiledNode, np.ndarray]],
        earlier: Particles | None,
        now: Particles,
        row: Row,
        rng: np.random.Generator,
    ) -> list[Scouts]:
        """New scouts in the rare states of nodes, from particles that were in none of them."""
        before, carried = {}, -math.log(SCOUTS) - float(now.increment)
        if earlier is not None:
            weights = np.where(among(earlier.values, unmet), 0.0, earlier.weights)
            share = float(weights.sum() / earlier.total)
            if not share > 0:
                return []
            carried += math.log(share)
            at = pick(weights, rng.random(SCOUTS))
            for name in self.slices.interface:
                value = earlier.values[name]
                shared = value.ndim == len(self.slices.later[name].value_shape)
                before[name + PREVIOUS] = value if shared else value[at]
        model, found = self.slices.model(row.t), []
        order = [n for n in model.nodes if n in self.slices.dynamic]
        for node, codes in unmet:
            steps = [self.plan.step(row, n) for n in order]
            steps[order.index(node.name)] = _Put(model, model[node.name], codes)
            start = Pass(rng, (SCOUTS,), {**self.plan.known(row), **before})
            found.append(self._weighed(passed(steps, start), carried))
        return found

    def _moved(
        self, scouts: Scouts, now: Particles, row: Row, rng: np.random.Generator
    ) -> Scouts | None:
        """Scouts of the slice before, one slice later."""
        before = {n + PREVIOUS: scouts.values[n] for n in self.slices.interface}
        state = Pass(rng, scouts.log_weights.shape, {**self.plan.known(row), **before})
        try:
            passed(self.plan.steps(row), state)
        except BayesmcError:
            return None
        return self._weighed(state, scouts.log_weights - float(now.increment))

    def _weighed(self, state: Pass, carried: float | np.ndarray) -> Scouts:
        log = np.broadcast_to(np.asarray(state.log_weight) + carried, state.batch)
        values = {}
        for name in self.slices.dynamic:
            shape = (*state.batch, *self.slices.later[name].value_shape)
            values[name] = np.broadcast_to(state.values[name], shape)
        return Scouts(values, log, 0.0)


class _Put:
    """A hidden finite node: drawn from some of its states, weighted by their probability."""

    def __init__(self, model: Model, node: CompiledNode, codes: np.ndarray) -> None:
        self.model, self.node, self.codes = model, node, codes

    def __call__(self, state: Pass) -> None:
        assert self.node.domain is not None
        name, kind = self.node.name, self.node.domain.dtype
        dist, _ = self.model.evaluate(name, state.values)
        each = [np.full(state.batch, code, dtype=kind) for code in self.codes]
        densities = [self.model.log_density(name, dist, codes) for codes in each]
        logs = np.stack([np.broadcast_to(log, state.batch) for log in densities])
        level = np.maximum(logs.max(axis=0), -1e300)
        weights = np.exp(logs - level)
        chosen = self.codes.astype(kind)[pick(weights, state.rng.random(state.batch))]
        chosen.flags.writeable = False
        state.values[name] = chosen
        with np.errstate(divide="ignore"):
            state.weigh(level + np.log(weights.sum(axis=0)))


def among(
    values: Mapping[str, np.ndarray], unmet: Sequence[tuple[CompiledNode, np.ndarray]]
) -> np.ndarray:
    """Who is in a rare state of some node."""
    found: Any = False
    for node, codes in unmet:
        value = values.get(node.name)
        for code in codes if value is not None else ():
            found = found | (value == code)
    return np.asarray(found)


def away(scouts: Scouts, unmet: Sequence[tuple[CompiledNode, np.ndarray]]) -> Scouts:
    """The scouts that are where particles are rare; the others have done their work."""
    away = among(scouts.values, unmet)
    return scouts._replace(log_weights=np.where(away, scouts.log_weights, -np.inf))


def together(parties: Sequence[Scouts], there: float, rng: np.random.Generator) -> Scouts | None:
    """All that have any weight as one party of bounded size, whose weights sum to the same."""
    log = np.concatenate([p.log_weights for p in parties])
    log = np.where(np.isnan(log), -np.inf, log)
    top = float(log.max())
    if top == -math.inf:
        return None
    weights = np.exp(log - top)
    whole = top + math.log(weights.sum())
    at = pick(weights, (rng.random() + np.arange(SCOUTS)) / SCOUTS)
    names = parties[0].values
    values = {n: np.concatenate([p.values[n] for p in parties])[at] for n in names}
    even = np.full(SCOUTS, whole - math.log(SCOUTS))
    share = max(math.exp(min(whole, 300.0)) - there, 0.0)
    inner = None if parties[0].inner is None else parties[0].inner.joined(parties, at)
    return Scouts(values, even, share, inner)


# ---- private ------------------------------------------------------------------------------------


def _looked_at(slices: Slices) -> tuple[CompiledNode, ...]:
    """Finite nodes that may be hidden: without plates, of few states."""
    found = []
    for name in slices.stochastic:
        node = slices.later[name]
        if node.domain is not None and not node.value_shape and node.domain.size <= STATES:
            found.append(node)
    return tuple(found[:NODES])
