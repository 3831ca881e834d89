"""States that next to no particle has, where every particle carries a Gaussian belief about the rest.

As ``particles.rare_states``, but scouts go through all joint states of the finite nodes and weigh these by
predictive densities, so that a few say what many with draws of their own would.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.categorical import log_sum_exp, pick
from bayesmc.dbn import PREVIOUS, Row
from bayesmc.engines.marginal.choices import Choices
from bayesmc.engines.marginal.gaussians import Gaussians, nothing
from bayesmc.engines.marginal.reading import Values
from bayesmc.engines.marginal.tables.beliefs import Tables
from bayesmc.engines.marginal.tables.step import Known
from bayesmc.engines.particles.families import Scouts
from bayesmc.engines.particles.rare_states import SCOUTS, Scouting, among, away, together
from bayesmc.engines.particles.smc import Particles
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode


class Carried(NamedTuple):
    """What each scout believes of what is integrated out."""

    inner: Gaussians
    tables: Tables | None

    def joined(self, parties: Sequence[Any], at: np.ndarray) -> Carried:
        """Some of those of several parties, one after the other."""
        inner = self.inner.joined([p._replace(inner=p.inner.inner) for p in parties], at)
        tables = self.tables
        return Carried(inner, tables and tables.joined([p.inner.tables for p in parties], at))


class MarginalScouting(Scouting):
    """Sends scouts to the states that no particle of a slice has.

    Parameters
    ----------
    step : MarginalStep
        Whose sampled nodes are finite, with one Gaussian for each particle: otherwise nobody is sent.
    """

    def __init__(self, step: Any) -> None:
        super().__init__(step.slices, step.plan)
        self.step = step
        inner = step.integrated | step.split.seen
        sampled = [n for n in step.slices.stochastic if n not in inner]
        if step.tables is not None:
            sampled = [n for n in sampled if n not in step.tables.plan.below]
        if (
            step.blocks
            or step.by_element
            or any(step.slices.later[n].domain is None for n in sampled)
        ):
            self.nodes = ()
        self.nodes = tuple(n for n in self.nodes if n.name in sampled)
        self._choices: dict[int, Choices] = {}

    def after(
        self, scouts: Scouts | None, earlier: Particles | None, now: Particles, row: Row
    ) -> Scouts | None:
        unmet = self._unmet(earlier, now, row)
        if not unmet or not math.isfinite(now.increment):
            return None
        rng = np.random.default_rng([row.t, int(np.float64(now.increment).view(np.uint64))])
        try:
            parties = []
            if scouts is not None and isinstance(scouts.inner, Carried):
                log = scouts.log_weights - float(now.increment)
                parties.append(self._gone(scouts.values, scouts.inner, log, row, rng))
            parties += self._put(unmet, earlier, now, row, rng)
        except BayesmcError:  # functions that break on what never came: nothing is said then
            return None
        if not parties:
            return None
        there = float(now.weights[among(now.values, unmet)].sum() / now.total)
        return together([away(p, unmet) for p in parties], there, rng)

    # ---- private -------------------------------------------------------------------------------

    def _put(
        self,
        unmet: Sequence[tuple[CompiledNode, np.ndarray]],
        earlier: Particles | None,
        now: Particles,
        row: Row,
        rng: np.random.Generator,
    ) -> list[Scouts]:
        """New scouts in rare states, from particles that were in none of them."""
        carried = np.full(SCOUTS, -math.log(SCOUTS) - float(now.increment))
        if earlier is None:
            return [self._gone({}, None, carried, row, rng, unmet)]
        weights = np.where(among(earlier.values, unmet), 0.0, earlier.weights)
        share = float(weights.sum() / earlier.total)
        if not share > 0:
            return []
        at = pick(weights, rng.random(SCOUTS))
        values = {}
        for name in self.slices.interface:
            value = earlier.values[name]
            shared = value.ndim == len(self.slices.later[name].value_shape)
            values[name] = value if shared else value[at]
        carried += math.log(share)
        tables = earlier.tables and earlier.tables.taken(at)
        beliefs = Carried(earlier.inner.taken(at), tables)
        return [self._gone(values, beliefs, carried, row, rng, unmet)]

    def _gone(
        self,
        values: Mapping[str, np.ndarray],
        beliefs: Carried | None,
        carried: np.ndarray,
        row: Row,
        rng: np.random.Generator,
        unmet: Sequence[tuple[CompiledNode, np.ndarray]] | None = None,
    ) -> Scouts:
        """Scouts one slice later, all of them or those of its states that are rare."""
        step, count = self.step, len(carried)
        inner, tables = (None, None) if beliefs is None else beliefs
        place = step.place(row, inner)
        choices = self._choices.get(id(place))
        if choices is None:
            full = frozenset(n for n, o in row.seen.items() if o.mask is None)
            choices = self._choices[id(place)] = Choices(place.layout, full, step.sampling)
        before = nothing(place.layout, count) if inner is None else inner.carried()
        plain, own = dict(step.sampling.known(row)), dict[str, np.ndarray]()
        for name in self.slices.interface if inner is not None else ():
            if name + PREVIOUS in step.hidden_before(place):
                continue
            value = values[name]
            shared = value.ndim == len(self.slices.later[name].value_shape)
            (plain if shared else own)[name + PREVIOUS] = value
        known = Values(plain, own, count)
        joint, made, _ = step.looked(place, choices, row, known, before)
        if step.tables is not None:
            joint = joint + step.tables.predicted(
                row, Known({**plain, **own}, frozenset(own), count), tables, choices.values
            )
        if unmet is not None:
            rare = among(choices.values, unmet)
            joint = np.where(rare, joint, -np.inf)
        log = carried + log_sum_exp(joint, axis=1)
        _, at = choices.drawn(joint, rng)
        found: dict[str, Any] = {n: row.seen[n].value for n in row.seen}
        found |= step.chosen_values(place, choices, known, found, at)
        after = made.chosen(at)
        later: Tables | None = None
        if step.tables is not None:
            each = {n for n, v in found.items() if v.ndim == step.ranks[n]}
            every = Known({**plain, **own, **found}, frozenset(own) | each, count)
            _, later, moves = step.tables.advanced(row, every, tables)
        found |= after.completed(rng)
        if step.tables is not None:
            found |= step.completed(row, every, found, (tables, later, moves), rng)
        for name in self.slices.dynamic:
            shape = (count, *self.slices.later[name].value_shape)
            found[name] = np.broadcast_to(found[name], shape)
        return Scouts(found, log, 0.0, Carried(after, later))
