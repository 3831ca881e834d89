"""Moments and draws of continuous blocks, from each block's distribution given others and discrete variables.

Conditionals come from both directions: blocks that were integrated out, given those integrated after them;
and blocks nothing observed depends on, given their parents. A block's distribution is a mixture with one
Gaussian for every configuration of the discrete variables that switch it or any block above it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import BudgetError
from .gaussian import Conditional

Scope = tuple[Any, ...]
#: components from which on means and variances are had from the parents' where that is possible
_MANY = 1 << 12
#: components beyond which a mixture is refused
_MOST = 1 << 26
#: configurations worked on at a time
_CHUNK = 1 << 14
#: entries of a joint covariance held at a time
_ENTRIES = 1 << 24


@dataclass(frozen=True, eq=False)
class Components:
    """The joint distribution of some blocks, as the mixture that it is.

    Attributes
    ----------
    states : dict
        Discrete variable -> its state in every component, shape ``(components,)``.
    weights : ndarray, shape (components,)
        Positive; they sum to 1.
    mean : ndarray, shape (components, n)
    cov : ndarray, shape (components, n, n)
    """

    states: dict[Any, np.ndarray]
    weights: np.ndarray
    mean: np.ndarray
    cov: np.ndarray

    def collapsed(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of the whole mixture."""
        if len(self.weights) == 1:
            return self.mean[0], self.cov[0]
        mean = self.weights @ self.mean
        spread = self.mean - mean
        within = np.tensordot(self.weights, self.cov, axes=1)
        return mean, within + (spread * self.weights[:, None]).T @ spread


class Moments:
    """Answers about blocks.

    Parameters
    ----------
    conditionals : sequence of Conditional
        One for each block, in any order without cycles.
    dims, cards : mapping
    joint : callable
        Discrete variables -> the table of their joint probabilities.
    """

    def __init__(
        self,
        conditionals: Sequence[Conditional],
        dims: Mapping[Any, int],
        cards: Mapping[Any, int],
        joint: Callable[[Scope], np.ndarray],
    ) -> None:
        self._of = {c.block: c for c in conditionals}
        self._dims, self._cards, self._joint = dims, cards, joint
        self.scopes = mixture_scopes({c.block: (c.scope, c.parents) for c in conditionals})
        self._order = {b: k for k, b in enumerate(self.scopes)}
        self._collapsed: dict[Any, tuple[np.ndarray, np.ndarray]] = {}

    def moments(self, block: Any) -> tuple[np.ndarray, np.ndarray]:
        """Mean ``(d,)`` and covariance ``(d, d)`` of one block; all that share its scope come along."""
        if block not in self._collapsed:
            scope = self.scopes[block]
            if self._count(scope) > _MANY and not self._of[block].scope:
                self._collapsed[block] = self._by_parents(block)
            else:
                among = frozenset(scope)
                group = [b for b, s in self.scopes.items() if frozenset(s) == among]
                self._collapsed.update(self._collapse(group, scope))
        return self._collapsed[block]

    def components(
        self, blocks: Sequence[Any], extra: Sequence[Any] = (), spread: bool = True
    ) -> Components:
        """The mixture of some blocks jointly, split by further discrete variables, too.

        Configurations of probability zero are left out. Without ``spread`` only means are worked out, and
        covariances are empty.
        """
        scope = tuple(dict.fromkeys([*(v for b in blocks for v in self.scopes[b]), *extra]))
        if not scope and len(blocks) == 1:  # one Gaussian, as worked out with all others
            mean, cov = self.moments(blocks[0])
            return Components({}, np.ones(1), mean[None], cov[None])
        states, weights = self._configurations(scope)
        passed = _Descent(self._of, self._dims, self._cards, self._visits(blocks), blocks, spread)
        means, covs = [], []
        for rows in passed.chunks(len(weights)):
            *_, (mean, cov) = passed.run({v: s[rows] for v, s in states.items()})
            means.append(mean)
            covs.append(cov)
        return Components(states, weights, np.concatenate(means), np.concatenate(covs))

    def sample(
        self, rng: np.random.Generator, codes: Mapping[Any, np.ndarray], draws: int
    ) -> dict[Any, np.ndarray]:
        """Draws of every block, shape ``(draws, d)``, given draws of the discrete variables."""
        drawn: dict[Any, np.ndarray] = {}
        for block in self.scopes:
            given = self._of[block]
            at = _rows(given.scope, self._cards, codes, draws)
            noise = rng.standard_normal((draws, self._dims[block]))
            value = _flat(given.offset, given)[at] + np.matvec(_flat(given.root, given)[at], noise)
            if given.parents:
                above = np.concatenate([drawn[p] for p in given.parents], axis=-1)
                value = value + np.matvec(_flat(given.gain, given)[at], above)
            drawn[block] = value
        return drawn

    def _count(self, scope: Iterable[Any]) -> float:
        """Number of configurations of some discrete variables."""
        return math.prod([float(self._cards[v]) for v in scope])

    def _by_parents(self, block: Any) -> tuple[np.ndarray, np.ndarray]:
        """Moments of a block that no discrete variable switches itself: linear in those of its parents,
        two at a time, however many configurations they have all together."""
        given = self._of[block]
        mean = given.offset.copy()
        cov = given.root @ given.root.T
        columns = np.cumsum([0, *(self._dims[p] for p in given.parents)])
        gains = [given.gain[:, i:j] for i, j in itertools.pairwise(columns)]
        for k, (p, gain) in enumerate(zip(given.parents, gains, strict=True)):
            own_mean, own_cov = self.moments(p)
            mean = mean + gain @ own_mean
            cov = cov + gain @ own_cov @ gain.T
            for other, its_gain in zip(given.parents[:k], gains[:k], strict=True):
                _, joint = self.components([p, other]).collapsed()
                d = self._dims[p]
                cross = gain @ joint[:d, d:] @ its_gain.T
                cov = cov + cross + cross.T
        return mean, cov

    def _collapse(
        self, group: Sequence[Any], scope: Scope
    ) -> dict[Any, tuple[np.ndarray, np.ndarray]]:
        """Moments of the whole mixture, for every block of a group with one scope."""
        states, weights = self._configurations(scope)
        sums: dict[Any, tuple[float, np.ndarray, np.ndarray]] = {}
        passed = _Descent(self._of, self._dims, self._cards, self._visits(group), ())
        wanted = set(group)
        for rows in passed.chunks(len(weights)):
            here = {v: s[rows] for v, s in states.items()}
            w = weights[rows]
            for block, (mean, cov) in zip(passed.order, passed.run(here), strict=False):
                if block in wanted:
                    part = Components(here, w / w.sum(), mean, cov).collapsed()
                    sums[block] = _merged(sums.get(block), (float(w.sum()), *part))
        return {block: sums[block][1:] for block in group}

    def _configurations(self, scope: Scope) -> tuple[dict[Any, np.ndarray], np.ndarray]:
        """The possible configurations of a scope, and their probabilities."""
        if not scope:
            return {}, np.ones(1)
        count = self._count(scope)
        if count > _MOST:
            raise BudgetError(
                f"it is a mixture of {count:.3g} Gaussians, one for every configuration of {len(scope)} "
                "discrete variables; ask for fewer nodes at a time, or draw with resample(draws)",
                int(min(8 * count, 2**62)),
            )
        table = self._joint(scope)
        at = np.nonzero(table)
        weights = table[at]
        return dict(zip(scope, at, strict=True)), weights / weights.sum()

    def _visits(self, blocks: Sequence[Any]) -> list[Any]:
        """The blocks and all above them, parents first, each as soon as its parents are there."""
        needed: set[Any] = set()
        todo = list(blocks)
        while todo:
            b = todo.pop()
            if b not in needed:
                needed.add(b)
                todo += self._of[b].parents
        pending = {b: len(self._of[b].parents) for b in needed}
        below: dict[Any, list[Any]] = {b: [] for b in needed}
        for b in sorted(needed, key=self._order.__getitem__):
            for p in self._of[b].parents:
                below[p].append(b)
        ready = [b for b in sorted(needed, key=self._order.__getitem__) if not pending[b]][::-1]
        order = []
        while ready:
            b = ready.pop()  # last in, first out: a branch is finished before the next is begun
            order.append(b)
            for c in below[b]:
                pending[c] -= 1
                if not pending[c]:
                    ready.append(c)
        return order


def mixture_scopes(
    blocks: Mapping[Any, tuple[Scope, Sequence[Any]]],
) -> dict[Any, Scope]:
    """For every block the discrete variables that its mixture runs over, parents before children.

    ``blocks`` maps each block to its own discrete scope and its parent blocks. The order of variables is
    that of these, not of a set: sums over configurations are then the same bits in every process.
    """
    scopes: dict[Any, Scope] = {}
    todo = list(blocks)
    while todo:
        block = todo[-1]
        own, parents = blocks[block]
        missing = [p for p in parents if p not in scopes]
        if missing and block not in scopes:
            todo += missing
            continue
        todo.pop()
        if block not in scopes:
            scopes[block] = tuple(dict.fromkeys([*(v for p in parents for v in scopes[p]), *own]))
    return scopes


# ---- private ------------------------------------------------------------------------------------


class _Descent:
    """Means and covariances of blocks in turn, parents first.

    Of each block only what later ones need stays, in columns that are given out again when it goes.

    Parameters
    ----------
    order : sequence
        The blocks to visit, each after its parents.
    keep : sequence
        Blocks whose joint distribution is wanted in the end.
    spread : bool
        Whether covariances are wanted at all.
    """

    def __init__(
        self,
        of: Mapping[Any, Conditional],
        dims: Mapping[Any, int],
        cards: Mapping[Any, int],
        order: Sequence[Any],
        keep: Sequence[Any],
        spread: bool = True,
    ) -> None:
        self.of, self.dims, self.cards = of, dims, cards
        self.order, self.keep, self.spread = order, keep, spread
        last = {p: k for k, b in enumerate(order) for p in of[b].parents}
        last.update(dict.fromkeys(keep, len(order)))
        self.last = last
        self.places: dict[Any, np.ndarray] = {}
        #: the columns in use by others when a block is put in its place
        self.beside: dict[Any, np.ndarray] = {}
        self.width = 0
        self._lay_out()

    def chunks(self, count: int) -> Iterator[slice]:
        """Configurations in parts that keep covariances small."""
        size = max(1, min(_CHUNK, _ENTRIES // max(self.width, 1) ** 2))
        return (slice(k, k + size) for k in range(0, count, size))

    def run(self, codes: Mapping[Any, np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Mean and covariance of each visited block; last of all, jointly of those to keep."""
        count = len(next(iter(codes.values()))) if codes else 1
        mean = np.zeros((count, self.width))
        cov = np.zeros((count, self.width, self.width) if self.spread else (count, 0, 0))
        for block in self.order:
            given, d = self.of[block], self.dims[block]
            at = _rows(given.scope, self.cards, codes, count)
            above = self._columns(given.parents)
            own = _flat(given.offset, given)[at]
            gain = _flat(given.gain, given)[at]
            if len(above):
                own = own + np.matvec(gain, mean[:, above])
            own = np.broadcast_to(own, (count, d))
            inside = np.zeros((count, 0, 0))
            if self.spread:
                root = _flat(given.root, given)[at]
                inside = root @ np.matrix_transpose(root)
                if len(above):
                    inside = inside + gain @ _block(cov, above, above) @ np.matrix_transpose(gain)
                inside = np.broadcast_to(inside, (count, d, d))
            yield own, inside
            if block not in self.places:
                continue
            mine, others = self.places[block], self.beside[block]
            mean[:, mine] = own
            if self.spread:
                # read before writing: columns of a parent may be taken over
                cross = gain @ _block(cov, above, others)
                cov[:, mine[:, None], others] = cross
                cov[:, others[:, None], mine] = np.matrix_transpose(cross)
                cov[:, mine[:, None], mine] = inside
        columns = self._columns(self.keep)
        yield mean[:, columns], _block(cov, columns, columns) if self.spread else cov

    def _lay_out(self) -> None:
        """Give every block that stays for a while its columns."""
        free: list[int] = []
        live: list[Any] = []
        for k, block in enumerate(self.order):
            gone = [b for b in live if self.last[b] <= k]
            live = [b for b in live if self.last[b] > k]
            free += [c for b in gone for c in self.places[b].tolist()]
            if self.last.get(block, -1) <= k:
                continue
            missing = self.dims[block] - len(free)
            if missing > 0:
                free += range(self.width, self.width + missing)
                self.width += missing
            self.beside[block] = self._columns(live)
            self.places[block] = np.array([free.pop() for _ in range(self.dims[block])], dtype=int)
            live.append(block)

    def _columns(self, blocks: Sequence[Any]) -> np.ndarray:
        parts = [self.places[b] for b in blocks]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=int)


def _block(cov: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return cov[:, rows[:, None], columns]


def _flat(array: np.ndarray, given: Conditional) -> np.ndarray:
    """An array of a conditional with its discrete axes as one."""
    axes = len(given.scope)
    return array.reshape((math.prod(array.shape[:axes]), *array.shape[axes:]))


def _rows(
    scope: Scope, cards: Mapping[Any, int], codes: Mapping[Any, np.ndarray], count: int
) -> Any:
    """Row of every configuration among those of a scope."""
    if not scope:
        return np.zeros(1 if count > 1 else count, dtype=np.intp)
    row: Any = 0
    for v in scope:
        row = row * cards[v] + codes[v].astype(np.intp)
    return row


def _merged(
    before: tuple[float, np.ndarray, np.ndarray] | None,
    new: tuple[float, np.ndarray, np.ndarray],
) -> tuple[float, np.ndarray, np.ndarray]:
    """Weight, mean and covariance of two parts together (Chan, Golub and LeVeque 1983)."""
    if before is None:
        return new
    weight = before[0] + new[0]
    share = new[0] / weight
    shift = new[1] - before[1]
    mean = before[1] + share * shift
    cov = (1 - share) * before[2] + share * new[2]
    return weight, mean, cov + share * (1 - share) * np.multiply.outer(shift, shift)
