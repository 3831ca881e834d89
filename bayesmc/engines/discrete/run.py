"""A series passed through the chains of a template, and what that says of any variables of a slice.

The one loop over stretches of time: tables are made for a stretch, used, and made anew on the way back, so
that memory holds beliefs and a few stretches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from bayesmc.categorical import log_sum_exp, pick
from bayesmc.dbn import Series
from bayesmc.engines.discrete.chain import Passed, filtered, lagged, smoothed
from bayesmc.engines.discrete.rows import Piece, Rows, Variable
from bayesmc.engines.discrete.slices import STRETCH_ENTRIES, Block, DiscreteSlices
from bayesmc.errors import ParameterError, ZeroProbabilityError
from bayesmc.factors.named import Named, aligned, summed

#: bytes of factors that are kept for the next pass
_KEPT = 1 << 28


class Run:
    """Beliefs about every chain of a template.

    Parameters
    ----------
    plan : DiscreteSlices
    series : Series
    first : int, optional
        The slice to begin with; rows before it are there to be read.
    before : list of ndarray, optional
        Logs of the beliefs in the slice before, by chain, shape (sequences, states).
    """

    #: whether it knows joint tables of two slices in a row
    ties_slices = True

    def __init__(
        self,
        plan: DiscreteSlices,
        series: Series,
        first: int = 0,
        before: Sequence[np.ndarray] | None = None,
    ) -> None:
        self.plan, self.series, self.first = plan, series, first
        self.stop = series.start + series.steps
        self.before = before
        self.sequences = plan.reader.sequences
        self._kept: dict[Any, list[Piece]] = {}
        self._suspect: set[int] = set()  # chains with bad parameters somewhere
        self.passed: list[Passed] = []
        self.beliefs: list[Passed] = []

    @property
    def steps(self) -> int:
        return self.stop - self.first

    @property
    def is_suspect(self) -> bool:
        """Whether some configuration, perhaps an impossible one, has bad parameters."""
        return bool(self._suspect)

    # ---- passing ----------------------------------------------------------------------------

    def forward(self) -> np.ndarray:
        """Filter all chains; log densities of the rows, shape (steps, sequences).

        Raises
        ------
        ZeroProbabilityError, ParameterError
        """
        increments = np.zeros((self.steps, self.sequences))
        for start, stop in self._stretches(None):
            rows = self.plan.rows(self.series, start, stop)
            for piece in self.pieces(None, rows):
                increments[start - self.first : stop - self.first] += piece.values
                if piece.invalid is not None and piece.invalid.any():
                    row = int(np.argmax(piece.invalid.reshape(len(piece.invalid), -1).any(axis=1)))
                    raise bad_parameters(piece.node, start + row)
        for number in range(len(self.plan.chains)):
            increments += self._passed(number)
        if not (increments > -np.inf).all():
            self._refuse_impossible(increments)
        self._refuse_invalid()
        return increments

    def backward(self, lag: int | None) -> None:
        """Beliefs given all rows, or those up to ``lag`` slices later."""
        self.beliefs = [
            smoothed(self.blocks(k), found) if lag is None else lagged(self.blocks(k), found, lag)
            for k, found in enumerate(self.passed)
        ]

    def forget(self) -> None:
        """Let go of factors that were kept for the next pass."""
        self._kept.clear()

    def blocks(
        self, number: int, reduce: Callable[[np.ndarray, int], np.ndarray] = log_sum_exp
    ) -> Callable[[bool], Iterator[Block]]:
        """Makes the blocks of one chain, in either direction."""

        def make(backwards: bool) -> Iterator[Block]:
            cuts = self._stretches(number)
            for start, stop in reversed(cuts) if backwards else cuts:
                rows = self.plan.rows(self.series, start, stop)
                yield self.plan.block(number, self.pieces(number, rows), rows, reduce)

        return make

    def pieces(self, number: int | None, rows: Rows) -> list[Piece]:
        """The factors of a chain in some slices; the last few are kept."""
        key = (number, rows.start, rows.stop)
        found = self._kept.get(key)
        if found is None:
            found = [
                p
                for p in self.plan.pieces(rows, number)
                if (not p.scope if number is None else p.scope and self._is_of(p, number))
            ]
            while self._kept and sum(map(_bytes, self._kept.values())) > _KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = found
            if number is not None and any(p.invalid is not None for p in found):
                self._suspect.add(number)
        return found

    def stretches(self, entries: float) -> list[tuple[int, int]]:
        """All slices cut so that tables of so many entries a row stay within bounds."""
        length = max(1, int(STRETCH_ENTRIES / max(entries, 1.0)))
        return list(self.plan.stretches(self.first, self.stop, length))

    # ---- reading ----------------------------------------------------------------------------

    def last(self) -> Any:
        """What the slice after the last one goes on from: logs of the beliefs of each chain."""
        return [p.logs(slice(-1, None))[0] for p in self.passed]

    def alone(self, variable: Variable) -> np.ndarray | None:
        """Probabilities of a variable, (steps, sequences, states), where they stand by themselves."""
        number = self.plan.chain_of(variable)
        if self.plan.chains[number].state != (variable,):
            return None
        return self.beliefs[number].belief

    def entries(self, variables: Iterable[Variable]) -> float:
        """Entries of the largest table of a slice that joint probabilities of variables take."""
        found, asked = 1.0, set(variables)
        for number in {self.plan.chain_of(v) for v in asked}:
            chain = self.plan.chains[number]
            plain = asked <= set(chain.state)
            found = max(found, float(chain.size) if plain else self.plan.widest[number])
        return found

    def drawn(self, at: int, rng: np.random.Generator, count: int) -> dict[Variable, np.ndarray]:
        """Draws of all that the next slice reads from the filtered belief of slice ``first + at``.

        Each has shape (count, sequences).
        """
        found: dict[Variable, np.ndarray] = {}
        for chain, passed in zip(self.plan.chains, self.passed, strict=True):
            belief = passed.belief[at]
            sizes = [self.plan.cards[v] for v in chain.state]
            flat = pick(belief.T, rng.random((count, len(belief))))
            if sizes:
                codes = np.unravel_index(flat, sizes)
                found.update(zip(chain.state, codes, strict=True))
        return found

    def joint(self, scope: Sequence[Variable], start: int, stop: int) -> np.ndarray:
        """Probabilities of variables in slices of one kind, shape (rows, sequences, *cards)."""
        scope = tuple(scope)
        cards = self.plan.cards
        owners = list(dict.fromkeys(self.plan.chain_of(v) for v in scope))
        if len(owners) == 1:
            found = self._marginal(owners[0], scope, start, stop)
        else:
            found = np.ones((1, 1, *(cards[v] for v in scope)))
        for number in owners if len(owners) > 1 else ():
            own = tuple(v for v in scope if self.plan.chain_of(v) == number)
            found = found * aligned(Named(own, self._marginal(number, own, start, stop)), scope)
        return np.broadcast_to(found, (stop - start, self.sequences, *found.shape[2:]))

    # ---- private ----------------------------------------------------------------------------

    def _stretches(self, number: int | None) -> list[tuple[int, int]]:
        entries = self.sequences if number is None else self.plan.row_entries[number]
        return self.stretches(float(entries))

    def _passed(self, number: int) -> np.ndarray:
        """Filter one chain; log densities of its rows, shape (steps, sequences)."""
        last = None if self.before is None else self.before[number]
        size = self.plan.chains[number].size
        found = filtered(self.blocks(number), self.steps, self.sequences, size, last)
        self.passed.append(found)
        self.beliefs = self.passed
        return found.increments

    def _increments(self, number: int) -> np.ndarray:
        """Log densities of the rows of one chain, shape (steps, sequences)."""
        return self.passed[number].increments

    def _is_of(self, piece: Piece, number: int) -> bool:
        return self.plan.chain_of(piece.scope[0]) == number

    def _marginal(
        self, number: int, scope: tuple[Variable, ...], start: int, stop: int
    ) -> np.ndarray:
        """The joint of some variables of one chain."""
        chain, cards = self.plan.chains[number], self.plan.cards
        now = slice(start - self.first, stop - self.first)
        if set(scope) <= set(chain.state):
            belief = self.beliefs[number].belief[now]
            shaped = belief.reshape(*belief.shape[:2], *(cards[v] for v in chain.state))
            out = tuple(2 + k for k, v in enumerate(chain.state) if v not in scope)
            left = tuple(v for v in chain.state if v in scope)
            return aligned(Named(left, shaped.sum(axis=out) if out else shaped), scope)
        return self._eliminated(number, scope, start, stop)

    def _eliminated(
        self, number: int, scope: tuple[Variable, ...], start: int, stop: int
    ) -> np.ndarray:
        """The joint of some variables of one chain, all others summed out of its slices."""
        cards = self.plan.cards
        rows = self.plan.rows(self.series, start, stop)
        pieces = [*self.pieces(number, rows), *self._around(number, start, stop)]
        table = summed(pieces, scope, cards, log_sum_exp)
        over = tuple(range(2, table.ndim))
        top = table.max(axis=over, keepdims=True)
        found = np.exp(table - np.where(np.isfinite(top), top, 0.0))
        return found / found.sum(axis=over, keepdims=True)

    def _around(self, number: int, start: int, stop: int) -> list[Piece]:
        """What the slices before, and the rows after, say of the states of some slices."""
        chain, cards = self.plan.chains[number], self.plan.cards
        shape = tuple(cards[v] for v in chain.state)
        first, last = start - self.first, stop - self.first
        passed, now = self.passed[number], self.beliefs[number]
        found = []
        if start > 0:
            logs = np.empty((stop - start, self.sequences, chain.size))
            skip = 1 if first == 0 else 0
            if skip:
                assert self.before is not None
                logs[0] = self.before[number]
            logs[skip:] = passed.logs(slice(first - 1 + skip, last - 1))
            found.append(Piece("", chain.before, logs.reshape(*logs.shape[:2], *shape)))
        if now is not passed:
            with np.errstate(invalid="ignore"):
                after = now.logs(slice(first, last)) - passed.logs(slice(first, last))
            after = np.where(np.isnan(after), -np.inf, after)
            found.append(Piece("", chain.state, after.reshape(*after.shape[:2], *shape)))
        return found

    def _refuse_invalid(self) -> None:
        """Bad parameters at configurations that turn out to be possible are the user's to hear of."""
        for number in tuple(self._suspect):
            for start, stop in self._stretches(number):
                rows = self.plan.rows(self.series, start, stop)
                for piece in self.pieces(number, rows):
                    if piece.invalid is None:
                        continue
                    bad = piece.invalid & (self.joint(piece.scope, start, stop) > 0)
                    if bad.any():
                        row = int(np.argmax(bad.reshape(len(bad), -1).any(axis=1)))
                        raise bad_parameters(piece.node, start + row)

    def _refuse_impossible(self, increments: np.ndarray) -> None:
        """Say in which slice, and at which node, nothing is left."""
        impossible = np.isnan(increments) | (increments == -np.inf)
        row, sequence = (int(k) for k in np.argwhere(impossible)[0])
        t = self.first + row
        where = f" of sequence {sequence}" if self.sequences > 1 else ""
        node = self._culprit(t, sequence)
        raise ZeroProbabilityError(
            f"the observations have probability zero: in slice {t}{where}, what was seen of {node!r} is "
            "impossible given what was seen before; check that row, or give the tables a small positive entry"
        )

    def _culprit(self, t: int, sequence: int) -> str:
        """The first observed node of a slice at which no probability is left."""
        rows = self.plan.rows(self.series, t, t + 1)
        for piece in self.pieces(None, rows):
            if not (piece.values > -np.inf).all():
                return piece.node
        for number in range(len(self.plan.chains)):
            if not self._increments(number)[t - self.first, sequence] > -np.inf:
                node = self._culprit_of(number, t, sequence)
                if node is not None:
                    return node
        return self.plan.slices.dynamic[-1]

    def _culprit_of(self, number: int, t: int, sequence: int) -> str | None:
        """That node of one chain."""
        rows = self.plan.rows(self.series, t, t + 1)
        order = {n: k for k, n in enumerate(self.plan.slices.dynamic)}
        pieces = sorted(self.pieces(number, rows), key=lambda p: order[p.node])
        taken = [p for p in pieces if not p.is_evidence]
        now = [p for p in self._around(number, t, t + 1) if p.scope and p.scope[0][0] == 1]
        for piece in (p for p in pieces if p.is_evidence):
            taken.append(piece)
            total = summed([*taken, *now], (), self.plan.cards, log_sum_exp)
            if np.broadcast_to(total, (1, self.sequences))[0, sequence] == -np.inf:
                return piece.node
        return None


# ---- private ------------------------------------------------------------------------------------


def _bytes(pieces: Sequence[Piece]) -> int:
    return sum(p.values.nbytes for p in pieces)


def bad_parameters(node: str, t: int) -> ParameterError:
    """The error for bad parameters at a configuration that is possible."""
    return ParameterError(
        f"node {node!r}: the function gives bad parameters in slice {t} at a configuration that is possible",
        (t,),
    )
