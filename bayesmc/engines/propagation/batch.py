"""Many like factors at once: their messages, their cavities, and a visit to all or some of them.

A factor reads Gaussian coordinates through a few affine combinations, its own directions, and finite
variables. Its message is a Gaussian of these numbers and a table for each of these variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from bayesmc.engines.propagation.beliefs import NOTHING, Beliefs, Blocks, clipped, normalised
from bayesmc.engines.propagation.scopes import is_one_row
from bayesmc.factors.tilted import Tilt, inverses, log_integral, log_sum, mixed
from bayesmc.gaussian import try_cholesky

#: a cavity or message this small, beside what it is a difference of, is rounding
ROUNDING = 1e-13
#: errors of quadrature above this are rough, and the share of the way that is gone with them at most
_ROUGH, _CAUTIOUS = 0.1, 0.1


class Kernel(Protocol):
    """What a batch asks of its factors."""

    @property
    def how(self) -> str:
        """How the moments come about, in words."""

    def tilted(
        self,
        members: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        """Factors times Gaussian cavities, for all states of their finite variables.

        Parameters
        ----------
        members : ndarray of int, shape (f,)
        precision, linear : ndarray, shapes (f, k, k) and (f, k)
        near : (ndarray, ndarray)
            Mean and covariance of the belief.

        Returns
        -------
        Tilt
            Shapes (f, *cards, ...); of factors without directions only ``log`` counts.
        """


class Edge(NamedTuple):
    """The finite variables, one of every factor, at one place of the scope."""

    group: int
    at: np.ndarray


class Outcome(NamedTuple):
    """What a visit did."""

    skipped: int
    error: float


@dataclass(eq=False)
class Batch:
    """Like factors.

    Attributes
    ----------
    name : str
        The node or potential that they come from.
    kernel : Kernel
    count : int
    edges : tuple of Edge
    cards : tuple of int
    block : int
        Which of the beliefs' blocks they read; -1 where none.
    component : ndarray of int, shape (count,)
    columns : ndarray of int, shape (count, m)
        Places in the component.
    weights : ndarray, shape (count, k, m)
        The directions.
    is_prior : bool
        Whether it is the density of coordinates that it reads.
    elements : ndarray of int, shape (count,)
        Which elements of the node's plates they are.
    index : ndarray of int, shape (count,), optional
        Which of the kernel's factors they are.
    """

    name: str
    kernel: Kernel
    count: int
    edges: tuple[Edge, ...] = ()
    cards: tuple[int, ...] = ()
    block: int = -1
    component: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    columns: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=int))
    weights: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    is_prior: bool = False
    elements: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    index: np.ndarray | None = None

    def __post_init__(self) -> None:
        k = self.weights.shape[1] if self.block >= 0 else 0
        self.k = k
        self.precision = np.zeros((self.count, k, k))
        self.linear = np.zeros((self.count, k))
        self.tables = [np.zeros((self.count, c)) for c in self.cards]
        #: logs of the constants by which factors exceed their messages, as of the last visit
        self.logs = np.zeros(self.count)
        self.error = 0.0
        #: integrals of what contradicts the belief; of densities there is no telling
        self.floor = NOTHING if not k else -np.inf
        self.is_shared = self.block >= 0 and is_one_row(self.component) and is_one_row(self.columns)
        self._touched = self.component[:1] if self.is_shared else np.unique(self.component)
        self.everyone = np.arange(self.count)

    @property
    def is_exact(self) -> bool:
        """Whether its factors are not approximated."""
        return not self.k

    # ---- a visit -------------------------------------------------------------------------------

    def visit(self, beliefs: Beliefs, share: float, members: np.ndarray | None = None) -> Outcome:
        """Make messages anew and move the beliefs by ``share`` of the way; improper ones are left out."""
        at = self.everyone if members is None else members
        found = self._tilted(beliefs, at)
        fine = np.isfinite(found.log) & (found.log > self.floor)
        self.error = max(self.error, found.error)
        skipped = int((~fine).sum())
        if len(at) > 1:
            share = cautious(share, found.error)
        self._send_tables(beliefs, at, found, fine, share if self.k else _whole(share))
        if self.k:
            skipped += self._moved(beliefs, at, found, fine, share)
        self.logs[at] = self._constants(beliefs, found, at)
        return Outcome(skipped, found.error)

    def begin(self, beliefs: Beliefs, mean: np.ndarray, cov: np.ndarray) -> None:
        """Start with Gaussian messages of these moments, shapes (count, k) and (count, k, k)."""
        own = inverses(cov)
        self._add(beliefs.blocks[self.block], self.everyone, own, np.matvec(own, mean))
        self.precision, self.linear = own, np.matvec(own, mean)

    def constants(self, beliefs: Beliefs) -> np.ndarray:
        """Logs by which factors exceed their messages, given beliefs as they are."""
        return self._constants(beliefs, self._tilted(beliefs, self.everyone), self.everyone)

    def joint(self, beliefs: Beliefs, member: int) -> np.ndarray:
        """Joint probabilities of one factor's finite variables, shape its cards."""
        found = self._tilted(beliefs, np.array([member]))
        table = found.joint[0]
        return np.exp(table - log_sum(table.reshape(1, -1))[0])

    # ---- private -------------------------------------------------------------------------------

    def _tilted(self, beliefs: Beliefs, at: np.ndarray) -> Found:
        """Cavities, and factors times these."""
        cavities = [
            normalised(beliefs.finite[e.group].logs[e.at[at]] - own[at])
            for e, own in zip(self.edges, self.tables, strict=True)
        ]
        outer = np.zeros((len(at), *(1,) * len(cavities)))
        for end, cavity in enumerate(cavities):
            shape = [len(at), *(1,) * len(cavities)]
            shape[1 + end] = -1
            outer = outer + cavity.reshape(shape)
        if self.k:
            near = self._projected(beliefs.blocks[self.block], at)
            own = inverses(near[1])
            precision = own - self.precision[at]
            linear = np.matvec(own, near[0]) - self.linear[at]
            size = np.abs(own).max(axis=(-2, -1), keepdims=True) if self.k > 1 else own
            precision = np.where(np.abs(precision) < ROUNDING * size, 0.0, precision)
            with np.errstate(all="ignore"):
                tilt = self._product(beliefs, at, precision, linear, near)
        else:
            empty = np.zeros((len(at), 0, 0))
            none = np.zeros((len(at), 0))
            tilt = self._product(beliefs, at, empty, none, (none, empty))
            precision, linear = empty, none
        if not self.edges:
            return Found(
                tilt.log, (), (), tilt.log, precision, linear, tilt.mean, tilt.cov, tilt.error
            )
        joint = np.broadcast_to(tilt.log + outer, (len(at), *self.cards))
        possible = outer > NOTHING
        joint = np.where(possible, joint, np.where(np.isnan(joint), -np.inf, joint))
        flat = joint.reshape(len(at), -1)
        log = log_sum(flat)
        tables = []
        for end in range(len(self.edges)):
            turned = np.moveaxis(joint, 1 + end, 1).reshape(len(at), self.cards[end], -1)
            tables.append(log_sum(turned))
        mean = cov = np.zeros((len(at), 0))
        if self.k:
            states = flat.shape[1]
            means = np.broadcast_to(tilt.mean, (*joint.shape, self.k)).reshape(
                len(at), states, self.k
            )
            covs = np.broadcast_to(tilt.cov, (*joint.shape, self.k, self.k))
            _, mean, cov = mixed(flat, means, covs.reshape(len(at), states, self.k, self.k))[:3]
        return Found(log, tables, cavities, joint, precision, linear, mean, cov, tilt.error)

    def _send_tables(
        self, beliefs: Beliefs, at: np.ndarray, found: Found, fine: np.ndarray, step: float
    ) -> None:
        """Messages to finite variables, by a share of the way."""
        for end, edge in enumerate(self.edges):
            new = clipped(found.tables[end] - found.cavities[end])
            new = np.where(fine[:, None], new, self.tables[end][at])
            change = step * (new - self.tables[end][at])
            self.tables[end][at] += change
            logs = beliefs.finite[edge.group].logs
            if self.count == 1 or _is_unique(edge.at[at]):
                logs[edge.at[at]] += change
            else:
                np.add.at(logs, edge.at[at], change)

    def _product(
        self,
        beliefs: Beliefs,
        at: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        """Factors times the cavities of what is not finite."""
        return self.kernel.tilted(self._index(at), precision, linear, near)

    def _index(self, at: np.ndarray) -> np.ndarray:
        return at if self.index is None else self.index[at]

    def _constants(self, beliefs: Beliefs, found: Found, at: np.ndarray) -> np.ndarray:
        """Logs by which factors exceed their messages, with the cavities that were found."""
        logs = found.log.copy()
        for cavity, table in zip(found.cavities, self.tables, strict=True):
            logs -= log_sum(cavity + table[at])
        if self.k:
            own = found.precision + self.precision[at]
            logs -= log_integral(own, found.linear + self.linear[at])
        return logs

    def _projected(self, blocks: Blocks, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of the directions of some factors."""
        weights = self.weights if at is self.everyone else self.weights[at]
        if self.is_shared:
            c, columns = self.component[0], self.columns[0]
            cov = blocks.cov[c][np.ix_(columns, columns)]
            mean = weights @ blocks.mean[c, columns]
            flat = weights.reshape(-1, weights.shape[-1]) @ cov
            turned = flat.reshape(weights.shape)
        else:
            c, columns = self.component[at][:, None], self.columns[at]
            mean = np.matvec(weights, blocks.mean[c, columns])
            turned = weights @ blocks.cov[c[..., None], columns[:, :, None], columns[:, None, :]]
        if self.k == 1:
            return mean, np.einsum("fkm,fkm->fk", turned, weights)[..., None]
        return mean, turned @ np.matrix_transpose(weights)

    def _add(
        self, blocks: Blocks, at: np.ndarray, precision: np.ndarray, linear: np.ndarray
    ) -> None:
        """Add messages of some factors to their components."""
        weights = self.weights if at is self.everyone else self.weights[at]
        if self.is_shared:
            c, columns = self.component[0], self.columns[0]
            if self.k == 1:
                flat = weights[:, 0]
                own = flat.T @ (precision[:, 0] * flat)
                own = 0.5 * (own + own.T)
                blocks.linear[c, columns] += linear[:, 0] @ flat
            else:
                blocks.linear[c, columns] += np.einsum("fki,fk->i", weights, linear)
                own = np.einsum("fki,fkl,flj->ij", weights, precision, weights, optimize=True)
            blocks.precision[c][np.ix_(columns, columns)] += own
            return
        turned = np.matrix_transpose(weights)
        c, columns = self.component[at][:, None], self.columns[at]
        place = c[..., None], columns[:, :, None], columns[:, None, :]
        np.add.at(blocks.precision, place, turned @ precision @ weights)
        np.add.at(blocks.linear, (c, columns), np.matvec(turned, linear))

    def _moved(
        self, beliefs: Beliefs, at: np.ndarray, found: Found, fine: np.ndarray, share: float
    ) -> int:
        """Move Gaussian messages as far as components stay proper; how many could not."""
        blocks = beliefs.blocks[self.block]
        proper = fine & np.isfinite(found.mean).all(axis=-1) & _is_definite(found.cov)
        cov = (
            found.cov
            if proper.all()
            else np.where(proper[:, None, None], found.cov, np.eye(self.k))
        )
        own = inverses(cov)
        told = np.isfinite(own).all(axis=(-2, -1))
        if not told.all():
            proper &= told
            own = np.where(told[:, None, None], own, np.eye(self.k))
        new = own - found.precision
        change = np.where(proper[:, None, None], share * (new - self.precision[at]), 0.0)
        towards = np.matvec(own, found.mean) - found.linear
        move = np.where(proper[:, None], share * (towards - self.linear[at]), 0.0)
        skipped = int((fine & ~proper).sum())
        touched = self._touched if at is self.everyone else np.unique(self.component[at])
        kept = blocks.precision[touched].copy(), blocks.linear[touched].copy()
        for _ in range(8):
            self._add(blocks, at, change, move)
            improper = blocks.refreshed(touched)
            if not improper.any():
                break
            broken = np.isin(self.component[at], touched[improper])
            blocks.precision[touched], blocks.linear[touched] = kept
            change = np.where(broken[:, None, None], 0.25 * change, change)
            move = np.where(broken[:, None], 0.25 * move, move)
        else:
            blocks.precision[touched], blocks.linear[touched] = kept
            blocks.refreshed(touched)
            return skipped + len(at)
        self.precision[at] += change
        self.linear[at] += move
        return skipped


class Found(NamedTuple):
    """Factors times their cavities."""

    log: np.ndarray
    tables: Sequence[np.ndarray]
    cavities: Sequence[np.ndarray]
    joint: np.ndarray
    precision: np.ndarray
    linear: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    error: float


def cautious(share: float, error: float) -> float:
    """How far messages of rough moments move beliefs: many of them together would overshoot.

    Where beliefs come near, rules that were too coarse for vague ones get fine.
    """
    return min(share, _CAUTIOUS) if error > _ROUGH else share


def _is_definite(matrices: np.ndarray) -> np.ndarray:
    """Which matrices are positive definite."""
    if matrices.shape[-1] == 1:
        return matrices[..., 0, 0] > 0
    _, bad = try_cholesky(np.where(np.isfinite(matrices), matrices, 0.0))
    return np.ones(len(matrices), dtype=bool) if bad is None else ~bad


def _whole(share: float) -> float:
    """Tables of finite variables alone are not damped, unless nothing comes closer."""
    return 1.0 if share > 0.5 else share


def _is_unique(places: np.ndarray) -> bool:
    return len(np.unique(places)) == len(places)
