"""The forward step of the tables that particles carry.

A table is moved on by the transition, as a hidden Markov model's belief is, multiplied by what the row says of
its states, and its sum weighs the particle. What reads one element of a plate touches that element alone.

References
----------
Murphy (2000), Bayesian map learning in dynamic environments, NIPS 12; Doucet, de Freitas, Murphy and Russell
(2000), Rao-Blackwellised particle filtering for dynamic Bayesian networks, UAI 16.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.discrete.rows import NEUTRAL, Piece
from bayesmc.engines.marginal.tables.beliefs import Tables, drawn
from bayesmc.engines.marginal.tables.plan import Group, TablePlan
from bayesmc.engines.marginal.tables.reading import (
    Look,
    ParticleRows,
    TableReader,
    particle_rows,
)
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import ParameterError
from bayesmc.factors.named import log_product


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
        values = {n: v.repeat(times, axis=0) if n in self.own else v for n, v in self.values.items()}
        for name, value in more.items():
            values[name] = np.tile(value, (self.particles, *(1,) * (value.ndim - 1)))
        return Known(values, self.own | more.keys(), self.particles * times)


class Moved(NamedTuple):
    """A table after the transition and all that is said of whole tables, before what reads single elements.

    Attributes
    ----------
    log : ndarray, shape (particles, elements, states)
        Normalised.
    total : ndarray, shape (particles, elements)
        Log densities of what was said.
    pair : ndarray or None, shape (particles or 1, elements or 1, states, states)
        Log transitions, with what is said of two slices at once; None in slice 0.
    """

    log: np.ndarray
    total: np.ndarray
    pair: np.ndarray | None


class GroupStep:
    """The step of the tables of one group.

    Parameters
    ----------
    plan : TablePlan
    number : int
        Of the group.
    """

    def __init__(self, plan: TablePlan, number: int) -> None:
        self.group: Group = plan.groups[number]
        self.reader: TableReader = plan.readers[number]
        self.looks: list[dict[str, Look]] = [
            {n: look for (g, n, k), look in plan.looks.items() if g == number and k == kind}
            for kind in (0, 1, 2)
        ]
        self._kept: dict[Any, Any] = {}
        flat = {n: self.group.flat(n) for n in self.group.names if not self.group.inner[n]}
        self._flat = flat

    def moved(self, rows: ParticleRows, before: np.ndarray | None) -> Moved:
        """The tables moved on and multiplied by what is said of whole ones.

        Raises
        ------
        ParameterError
        """
        group, n = self.group, rows.particles
        now, earlier = group.scope(0), group.scope(1)
        pieces = self._pieces(rows)
        sizes = {v: k for lag in (0, 1) for v, k in zip(group.scope(lag), group.sizes, strict=True)}
        both = [p for p in pieces if any(v[0] for v in p.scope)]
        here = [p for p in pieces if p not in both]
        shape = (n, group.elements, group.states)
        log = log_product(here or [NEUTRAL], now, sizes)
        log = log.reshape(*log.shape[:2], group.states)
        pair = None
        if before is not None:
            pair = log_product(both or [NEUTRAL], (*earlier, *now), sizes)
            pair = pair.reshape(*pair.shape[:2], group.states, group.states)
            carried = propagated(before, pair)
            moved = carried + log
        else:
            moved = np.broadcast_to(log, shape)
        total = log_sum_exp(moved, axis=-1)
        if before is not None and pair is not None and not (total > -np.inf).all():
            exact = log_sum_exp(before[..., :, None] + pair, axis=-2) + log
            lost = ~(total > -np.inf)
            moved = np.where(lost[..., None], exact, moved)
            total = log_sum_exp(moved, axis=-1)
        log = moved - np.where(total > -np.inf, total, 0.0)[..., None]
        self._refuse_invalid(pieces, before, pair, log)
        return Moved(log, total, pair)

    def picks(self, rows: ParticleRows) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray | None]]:
        """What single elements are told: node, tables, log densities of their states, and bad ones.

        Numbers of tables have shape ``(particles or 1,)`` and densities ``(particles or 1, states)``; one
        entry for each number that is seen.
        """
        found = []
        for name, look in self.looks[rows.kind].items():
            seen = rows.row.seen.get(name)
            if look.at is None or seen is None:
                continue
            log, bad = self.reader.tables(look, rows)
            node = self.reader.slices.first[name]
            at = self.reader.place(look.at, rows)
            at = at.reshape(len(at), -1)
            source = look.term.alone[0][1]
            numbers = np.where(at < 0, self._first(node)[None], self._flat[source][np.maximum(at, 0)])
            counts = np.ones(at.shape[1], dtype=bool) if seen.mask is None else seen.mask.reshape(-1)
            log = self._over_states(log, look)
            bad = None if bad is None else self._over_states(bad, look)
            for k in np.flatnonzero(counts):
                own = None if bad is None or not bad[..., k].any() else bad[..., k]
                found.append((name, numbers[:, k], log[..., k], own))
        return found

    # ---- private -------------------------------------------------------------------------------

    def _pieces(self, rows: ParticleRows) -> list[Piece]:
        """Factors over whole tables; what is the same in all slices is kept."""
        found: list[Piece] = []
        for name, look in self.looks[rows.kind].items():
            is_own = name in self.group.names
            if look.at is not None or (not is_own and name not in rows.row.seen):
                continue
            term = look.term
            still = is_own and not term.clock and not term.reads
            key = (name, rows.kind)
            if not still or key not in self._kept:
                made = self.reader.pieces(term, rows)
                if still:
                    self._kept[key] = made
            else:
                made = self._kept[key]
            found += made
            if is_own:
                found += self.reader.indicators(name, rows)
        return found

    def _over_states(self, array: np.ndarray, look: Look) -> np.ndarray:
        """Figures by states of the nodes that are picked, as by joint states of a table.

        From ``(particles or 1, *cards, elements)`` to ``(particles or 1, states, elements)``.
        """
        group = self.group
        codes = np.unravel_index(np.arange(group.states), group.sizes)
        axes = [group.variables.index((n, 0)) for _, n in look.term.alone]
        return array[(slice(None), *(codes[k] for k in axes))]

    def _first(self, node: Any) -> np.ndarray:
        """For each element of a node, the first table of those that are filtered together with it."""
        group = self.group
        first = [0 if p not in node.plates else None for p in group.plates]
        grid = np.arange(group.elements).reshape(group.lead)
        own = grid[tuple(0 if f == 0 else slice(None) for f in first)]
        shared = [p for p in group.plates if p in node.plates]
        order = [shared.index(p) for p in node.plates if p in shared]
        shape = [n if p in shared else 1 for p, n in zip(node.plates, node.plate_shape, strict=True)]
        wide = np.transpose(own, order).reshape(shape)
        return np.broadcast_to(wide, node.plate_shape).reshape(-1)

    def _refuse_invalid(
        self,
        pieces: Sequence[Piece],
        before: np.ndarray | None,
        pair: np.ndarray | None,
        log: np.ndarray,
    ) -> None:
        """Bad parameters at states that are possible."""
        group = self.group
        for piece in pieces:
            if piece.invalid is None or not piece.invalid.any():
                continue
            full = (*group.scope(1), *group.scope(0)) if before is not None else group.scope(0)
            sizes = {v: k for lag in (0, 1) for v, k in zip(group.scope(lag), group.sizes, strict=True)}
            bad = log_product([_flags(piece)], full, sizes) > 0
            if before is None or pair is None:
                possible = log > -np.inf
                bad = bad.reshape(*bad.shape[:2], group.states)
            else:
                possible = (before[..., :, None] + pair > -np.inf) & (log > -np.inf)[..., None, :]
                bad = bad.reshape(*bad.shape[:2], group.states, group.states)
            if (bad & possible).any():
                raise bad_parameters(piece.node)


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
                    for other in self.slices.stochastic:
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
        """Log densities of the row with every choice of some nodes, shape ``(particles, choices, *apart)``."""
        count = len(next(iter(choices.values())))
        many = known.repeated(count, choices)
        after = None
        if before is not None:
            after = before._replace(logs=tuple(log.repeat(count, axis=0) for log in before.logs))
        log, _, _ = self.advanced(row, many, after)
        return log.reshape(known.particles, count, *self.lead)

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
            own = {p: values[p + PREVIOUS] for p in model[name].parents if p + PREVIOUS in values}
            past[name + PREVIOUS] = model.evaluate(name, {**known.values, **own})[0]
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


def propagated(before: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """Logs of tables after a transition.

    Parameters
    ----------
    before : ndarray, shape (particles, elements, states)
    pair : ndarray, shape (particles or 1, elements or 1, states, states)
    """
    states = before.shape[-1]
    if pair.shape[:2] == (1, 1) and _stays(pair[0, 0]):
        return before
    level = pair.max(axis=(-2, -1), keepdims=True)
    level = np.where(level > -np.inf, level, 0.0)
    top = before.max(axis=-1, keepdims=True)
    top = np.where(top > -np.inf, top, 0.0)
    moves, shares = np.exp(pair - level), np.exp(before - top)
    if pair.shape[:2] == (1, 1):
        found = (shares.reshape(-1, states) @ moves[0, 0]).reshape(before.shape)
    else:
        found = (shares[..., None, :] @ moves)[..., 0, :]
    with np.errstate(divide="ignore"):
        return np.log(found) + top + level[..., 0]


def touched(
    step: GroupStep, rows: ParticleRows, moved: Moved
) -> tuple[np.ndarray, np.ndarray]:
    """Tables of single elements multiplied by what is said of them, and all log sums."""
    picks = step.picks(rows)
    if not picks:
        return moved.log, moved.total
    log, sums = np.array(moved.log), np.array(moved.total)
    every = np.arange(rows.particles)
    for name, at, density, bad in picks:
        own = log[every, at]
        if bad is not None and (bad & (own > -np.inf)).any():
            raise bad_parameters(name)
        own = own + density
        total = log_sum_exp(own, axis=-1)
        log[every, at] = own - np.where(total > -np.inf, total, 0.0)[:, None]
        sums[every, at] += total
    return log, sums


def bad_parameters(name: str) -> ParameterError:
    """A node whose function gives bad parameters at a state that is possible."""
    return ParameterError(
        f"node {name!r}: its parameters are out of range at a state that is possible; mend its function for "
        "all states of its parents"
    )


# ---- private ------------------------------------------------------------------------------------


def _stays(pair: np.ndarray) -> bool:
    """Whether nothing moves."""
    return bool((np.diag(pair) == 0).all() and np.isneginf(pair).sum() == pair.size - len(pair))


def _flags(piece: Piece) -> Piece:
    assert piece.invalid is not None
    return Piece(piece.node, piece.scope, piece.invalid.astype(float))
