"""The tables of one group of finite nodes moved on by a slice, and multiplied by what its row says.

A table is moved on by the transition, as a hidden Markov model's belief is, multiplied by what the row says
of its states, and its sum weighs the particle. What reads one element of a plate touches that element alone.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import Row
from bayesmc.engines.discrete.rows import NEUTRAL, Piece
from bayesmc.engines.marginal.tables.plan import Group, TablePlan
from bayesmc.engines.marginal.tables.reading import Look, ParticleRows, TableReader
from bayesmc.errors import ParameterError
from bayesmc.factors.named import log_product


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


class Told(NamedTuple):
    """What a slice and its row say of tables.

    Attributes
    ----------
    pair : ndarray or None, shape (particles or 1, elements or 1, states, states)
        As ``Moved.pair``.
    log : ndarray, shape (particles, elements, states)
        Logs of what is said of the states of the slice; in slice 0 with their probabilities.
    """

    pair: np.ndarray | None
    log: np.ndarray


class Pick(NamedTuple):
    """What a row says of one element for each particle.

    Attributes
    ----------
    name : str
        The node that is seen.
    at : ndarray of int, shape (particles or 1,)
        Tables.
    log : ndarray, shape (particles or 1, states)
        Log densities.
    bad : ndarray of bool or None, same shape
        Where parameters are bad.
    """

    name: str
    at: np.ndarray
    log: np.ndarray
    bad: np.ndarray | None


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
        pieces = self._pieces(rows)
        pair, log, is_told = self._factors(pieces, before is None)
        if before is not None:
            assert pair is not None
            if not is_told and _stays(pair):
                return Moved(before, np.zeros(before.shape[:2]), pair)
            moved = propagated(before, pair) + log
        else:
            moved = np.broadcast_to(log, (rows.particles, self.group.elements, self.group.states))
        total = log_sum_exp(moved, axis=-1)
        if before is not None and pair is not None and not (total > -np.inf).all():
            exact = log_sum_exp(before[..., :, None] + pair, axis=-2) + log
            lost = ~(total > -np.inf)
            moved = np.where(lost[..., None], exact, moved)
            total = log_sum_exp(moved, axis=-1)
        log = moved - np.where(total > -np.inf, total, 0.0)[..., None]
        self._refuse_invalid(pieces, before, pair, log)
        return Moved(log, total, pair)

    def told(self, rows: ParticleRows) -> Told:
        """What moves the tables, and all that is said of them, of single elements, too."""
        pair, log, _ = self._factors(self._pieces(rows), not rows.row.t)
        log = np.array(
            np.broadcast_to(log, (rows.particles, self.group.elements, self.group.states))
        )
        every = np.arange(rows.particles)
        for pick in self.picks(rows):
            own = pick.log if pick.bad is None else np.where(pick.bad, -np.inf, pick.log)
            log[every, pick.at] += own
        return Told(pair, log)

    def is_moved_by(self, row: Row, names: Collection[str]) -> bool:
        """Whether transitions, or what is said of whole tables, depend on nodes of the slice."""
        looks = self.looks[min(row.t, 2)]
        return any(
            not lag and stem in names
            for name, look in looks.items()
            if look.at is None and (name in self.group.names or name in row.seen)
            for lag, stem in look.term.reads
        )

    def picks(self, rows: ParticleRows) -> list[Pick]:
        """What single elements are told, one entry for each number that is seen."""
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
            numbers = np.where(
                at < 0, self._first(node)[None], self._flat[source][np.maximum(at, 0)]
            )
            counts = (
                np.ones(at.shape[1], dtype=bool) if seen.mask is None else seen.mask.reshape(-1)
            )
            log = self._over_states(log, look)
            bad = None if bad is None else self._over_states(bad, look)
            for k in np.flatnonzero(counts):
                own = None if bad is None or not bad[..., k].any() else bad[..., k]
                found.append(Pick(name, numbers[:, k], log[..., k], own))
        return found

    def reads_before(self, row: Row, names: Collection[str]) -> bool:
        """Whether transitions, or what is said, depend on some nodes of the slice before."""
        return any(
            lag and stem in names
            for name, look in self.looks[min(row.t, 2)].items()
            if name in self.group.names or name in row.seen
            for lag, stem in look.term.reads
        )

    # ---- private -------------------------------------------------------------------------------

    def _factors(
        self, pieces: Sequence[Piece], is_first: bool
    ) -> tuple[np.ndarray | None, np.ndarray, bool]:
        """Logs over two slices and over this one, and whether anything is said of this one alone."""
        group = self.group
        now, earlier = group.scope(0), group.scope(1)
        sizes = {v: k for lag in (0, 1) for v, k in zip(group.scope(lag), group.sizes, strict=True)}
        both = [p for p in pieces if any(v[0] for v in p.scope)]
        here = [p for p in pieces if p not in both]
        log = log_product(here or [NEUTRAL], now, sizes)
        log = log.reshape(*log.shape[:2], group.states)
        if is_first:
            return None, log, bool(here)
        pair = log_product(both or [NEUTRAL], (*earlier, *now), sizes)
        return pair.reshape(*pair.shape[:2], group.states, group.states), log, bool(here)

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
        index: tuple[Any, ...] = (slice(None), *(codes[k] for k in axes))
        return array[index]

    def _first(self, node: Any) -> np.ndarray:
        """For each element of a node, the first table of those that are filtered together with it."""
        group = self.group
        first = [0 if p not in node.plates else None for p in group.plates]
        grid = np.arange(group.elements).reshape(group.lead)
        own = grid[tuple(0 if f == 0 else slice(None) for f in first)]
        shared = [p for p in group.plates if p in node.plates]
        order = [shared.index(p) for p in node.plates if p in shared]
        shape = [
            n if p in shared else 1 for p, n in zip(node.plates, node.plate_shape, strict=True)
        ]
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
            sizes = {
                v: k for lag in (0, 1) for v, k in zip(group.scope(lag), group.sizes, strict=True)
            }
            bad = log_product([_flags(piece)], full, sizes) > 0
            if before is None or pair is None:
                possible = log > -np.inf
                bad = bad.reshape(*bad.shape[:2], group.states)
            else:
                possible = (before[..., :, None] + pair > -np.inf) & (log > -np.inf)[..., None, :]
                bad = bad.reshape(*bad.shape[:2], group.states, group.states)
            if (bad & possible).any():
                raise bad_parameters(piece.node)


def propagated(before: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """Logs of tables after a transition.

    Parameters
    ----------
    before : ndarray, shape (particles, elements, states)
    pair : ndarray, shape (particles or 1, elements or 1, states, states)
    """
    states = before.shape[-1]
    if _stays(pair):
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
    step: GroupStep, rows: ParticleRows, moved: Moved, picks: Sequence[Pick] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Tables of single elements multiplied by what is said of them, and all log sums."""
    picks = step.picks(rows) if picks is None else picks
    if not picks:
        return moved.log, moved.total
    log, sums = np.array(moved.log), np.array(moved.total)
    every = np.arange(rows.particles)
    for name, at, density, bad in picks:
        own = log[every, at]
        refuse_bad(name, bad, own)
        own = own + density
        total = log_sum_exp(own, axis=-1)
        log[every, at] = own - np.where(total > -np.inf, total, 0.0)[:, None]
        sums[every, at] += total
    return log, sums


def refuse_bad(name: str, bad: np.ndarray | None, log: np.ndarray) -> None:
    """Refuse bad parameters of a node at states that are possible.

    Raises
    ------
    ParameterError
    """
    if bad is not None and (bad & (log > -np.inf)).any():
        raise bad_parameters(name)


def bad_parameters(name: str) -> ParameterError:
    """A node whose function gives bad parameters at a state that is possible."""
    return ParameterError(
        f"node {name!r}: its parameters are out of range at a state that is possible; mend its function for "
        "all states of its parents"
    )


# ---- private ------------------------------------------------------------------------------------


def _stays(pair: np.ndarray) -> bool:
    """Whether nothing moves, in any table."""
    if pair.shape[:2] != (1, 1):
        return False
    one = pair[0, 0]
    return bool((np.diag(one) == 0).all() and np.isneginf(one).sum() == one.size - len(one))


def _flags(piece: Piece) -> Piece:
    assert piece.invalid is not None
    return Piece(piece.node, piece.scope, piece.invalid.astype(float))
