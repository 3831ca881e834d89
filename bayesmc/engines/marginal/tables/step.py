"""The forward step of all tables that the particles of a template carry.

References
----------
Murphy (2000), Bayesian map learning in dynamic environments, NIPS 12; Doucet, de Freitas, Murphy and Russell
(2000), Rao-Blackwellised particle filtering for dynamic Bayesian networks, UAI 16.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.tables.beliefs import Tables, drawn
from bayesmc.engines.marginal.tables.groups import GroupStep, Moved, refuse_bad, touched
from bayesmc.engines.marginal.tables.plan import TablePlan
from bayesmc.engines.marginal.tables.reading import dependent, particle_rows
from bayesmc.errors import UnsupportedError
from bayesmc.network import Observed


class Known(NamedTuple):
    """Values in a slice and in the one before it that particles have.

    Attributes
    ----------
    values : dict
        By the names that functions of the slice have for them.
    own : frozenset of str
        Those with an axis of particles.
    particles : int
    """

    values: Mapping[str, np.ndarray]
    own: frozenset[str]
    particles: int

    def repeated(self, times: int, more: Mapping[str, np.ndarray]) -> Known:
        """Every particle so many times, with further values, of which each has that many."""
        values = {
            n: v.repeat(times, axis=0) if n in self.own else v for n, v in self.values.items()
        }
        for name, value in more.items():
            values[name] = np.tile(value, (self.particles, *(1,) * (value.ndim - 1)))
        return Known(values, self.own | more.keys(), self.particles * times)


class TableFilter:
    """The step of all tables of the particles of a template.

    Parameters
    ----------
    slices : Slices
    apart : tuple of str
        Plates that are filtered separately.
    plan : TablePlan
    """

    def __init__(self, slices: Slices, apart: tuple[str, ...], plan: TablePlan) -> None:
        self.slices, self.apart, self.plan = slices, apart, plan
        self.lead = tuple(slices.first.sizes[p] for p in apart)
        self.steps = [GroupStep(plan, k) for k in range(len(plan.groups))]
        self.hidden_before = frozenset(n + PREVIOUS for n in plan.hidden)
        #: nodes of the slice before of which values are wanted afterwards, once tables are drawn from
        self.wanted_before = self._wanted_before()

    def left_out(self, is_first: bool) -> frozenset[str]:
        """Nodes that wait for tables: those with one, and what depends on these in a slice."""
        return self.plan.hidden | self.plan.told(is_first)

    def without(self, layout: Layout) -> Layout:
        """A layout of what other numbers there are in a slice, without these nodes."""
        out = self.left_out(layout.first)
        for part in ("order", "certain", "computed"):
            setattr(layout, part, tuple(n for n in getattr(layout, part) if n not in out))
        return layout

    def unexplained(self, full: Collection[str], seen: Collection[str]) -> tuple[str, str] | None:
        """A node that was to be seen always and is missing, and one that is sampled and depends on it."""
        for name in self.slices.dynamic:
            if name in self.plan.below and name in seen and name not in full:
                for model in (self.slices.first, self.slices.later):
                    for other in (n for n in self.slices.dynamic if n not in self.plan.hidden):
                        if {name, name + PREVIOUS} & set(model[other].parents):
                            return name, other
        return None

    def advanced(
        self, row: Row, known: Known, before: Tables | None
    ) -> tuple[np.ndarray, Tables, list[Moved]]:
        """Log densities of the row, shape ``(particles, *apart)``, and the tables after it.

        Raises
        ------
        ParameterError
        """
        refuse_seen_in_part(self.plan, row.seen)
        rows = particle_rows(row, known.values, known.own, known.particles)
        total: Any = 0.0
        logs, moves = [], []
        for k, step in enumerate(self.steps):
            moved = step.moved(rows, None if before is None else before.logs[k])
            log, sums = touched(step, rows, moved)
            total = total + self._by_apart(sums)
            logs.append(log)
            moves.append(moved)
        return total, Tables(self.plan.groups, tuple(logs)), moves

    def predicted(
        self, row: Row, known: Known, before: Tables | None, choices: Mapping[str, np.ndarray]
    ) -> np.ndarray:
        """Log densities of the row with every choice of some nodes, shape ``(particles, choices, *apart)``.

        Tables are moved on once for each particle where no transition, and nothing that is said of whole
        tables, depends on the choice.
        """
        count, n = len(next(iter(choices.values()))), known.particles
        more = known.repeated(count, choices)
        many = particle_rows(row, more.values, more.own, more.particles)
        once = particle_rows(row, known.values, known.own, n)
        moving = frozenset(choices) | dependent(self.slices, frozenset(choices))
        of = np.arange(n * count) // count
        total: Any = 0.0
        for k, step in enumerate(self.steps):
            log = None if before is None else before.logs[k]
            if step.is_moved_by(row, moving):
                moved = step.moved(many, None if log is None else log.take(of, axis=0))
                total = total + self._by_apart(touched(step, many, moved)[1])
                continue
            moved = step.moved(once, log)
            picks = step.picks(many)
            if len(picks) > 1:  # they may be of one element
                moved = Moved(moved.log.take(of, axis=0), moved.total.take(of, axis=0), None)
                total = total + self._by_apart(touched(step, many, moved, picks)[1])
                continue
            total = total + self._by_apart(moved.total).take(of, axis=0)
            for name, at, density, bad in picks:
                own = moved.log[of, at]
                refuse_bad(name, bad, own)
                sums = log_sum_exp(own + density, axis=-1)
                each = np.zeros((n * count, math.prod(self.lead)))
                each[np.arange(n * count), at // (step.group.elements // each.shape[1])] = sums
                total = total + each.reshape(n * count, *self.lead)
        return total.reshape(n, count, *self.lead)

    def completed(
        self,
        tables: Tables,
        before: Tables | None,
        moves: Sequence[Moved],
        row: Row,
        known: Known,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """One draw of all nodes with a table, and of the slice before with it what others read."""
        codes = tables.drawn(rng)
        nodes = [self.slices.later[n] for n in self.plan.names]
        now = tables.values(codes, nodes)
        if not self.wanted_before or before is None:
            return now, {}
        earlier = []
        for own, log, moved in zip(codes, before.logs, moves, strict=True):
            assert moved.pair is not None
            pair = np.broadcast_to(moved.pair, (*log.shape, log.shape[-1]))
            column = np.take_along_axis(pair, own[..., None, None], -1)[..., 0]
            earlier.append(drawn(log + column, rng))
        past = {n + PREVIOUS: v for n, v in before.values(earlier, nodes).items()}
        model = self.slices.model(row.t - 1)
        for name in (n for n in model.nodes if n in self.wanted_before & self.plan.computed):
            values = {**known.values, **past}
            past_of = {
                p: values[p + PREVIOUS] for p in model[name].parents if p + PREVIOUS in values
            }
            past[name + PREVIOUS] = model.evaluate(name, {**known.values, **past_of})[0]
        return now, past

    # ---- private -------------------------------------------------------------------------------

    def _wanted_before(self) -> frozenset[str]:
        """Of the nodes that wait, those whose values in the slice before others need that wait."""
        found: set[str] = set()
        todo = [
            p.removesuffix(PREVIOUS)
            for n in (*self.plan.below, *self.plan.computed)
            for p in self.slices.later[n].parents
            if p in self.hidden_before
        ]
        while todo:
            name = todo.pop()
            if name in found:
                continue
            found.add(name)
            for model in (self.slices.first, self.slices.later):
                if name in self.plan.computed:
                    todo += [p for p in model[name].parents if p in self.plan.hidden]
        return frozenset(found)

    def _by_apart(self, sums: np.ndarray) -> np.ndarray:
        """Logs of all tables of a particle added, but for plates that are filtered separately."""
        return sums.reshape(len(sums), *self.lead, -1).sum(axis=-1)


def refuse_seen_in_part(plan: TablePlan, seen: Mapping[str, Observed]) -> None:
    """Refuse vectors of which some components are missing, where tables take in their density.

    Raises
    ------
    UnsupportedError
    """
    for name in plan.below:
        if name in seen and seen[name].parts is not None:
            nodes = ", ".join(map(repr, sorted(plan.names)))
            raise UnsupportedError(
                f"ParticleFilter(marginalize=...): of {name!r} some components are missing, and tables of "
                f"{nodes} take its vectors in whole; give marginalize=None, or leave all of it out"
            )
