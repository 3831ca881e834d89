"""Many evidence sets on one clique tree at once: both passes with the sets as the last axis of every table.

What a message costs in calls is paid once for some hundred sets, and sums run along memory. Evidence is
entered by zeros, so that sets may observe different variables; cliques below which no set of a block
observes anything have one table for all. Ordinary arithmetic under NumPy's traps: a block in which something
that could matter underflows is for `BoundTree.calibrate`, set by set.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from .calibrated import Calibrated, Context
from .cliquetree import BoundTree
from .propagation import Collected
from .structure import Program, SumStep

#: entries of the whole tree above which its tables are better cut by the evidence of each set
MOST_ENTRIES = 30_000
#: numbers that the tables of a block hold: about what stays in cache
_BLOCK = 1 << 17
#: evidence sets in a block, at most
_SETS = 256
_TINY = 5e-324


class Block(NamedTuple):
    """Answers for some evidence sets.

    Attributes
    ----------
    log_z : ndarray, shape (sets,)
        ``-inf`` where the evidence is impossible; marginals mean nothing there.
    marginals : ndarray, shape (sets, states of all variables)
        Those of all variables, end to end as in ``Program.place``.
    """

    log_z: np.ndarray
    marginals: np.ndarray


def is_worth_it(bound: BoundTree) -> bool:
    """Whether a tree is small enough for blocks of evidence sets, and its tables are safe without logs."""
    return bound.tree.cost.total_entries <= MOST_ENTRIES and bound._linear is not None


def block_size(bound: BoundTree) -> int:
    """Evidence sets that are taken together."""
    return max(1, min(_SETS, int(_BLOCK // max(bound.tree.cost.total_entries, 1.0))))


def calibrate_many(bound: BoundTree, states: np.ndarray) -> Block:
    """The marginals of all variables under some evidence sets.

    Parameters
    ----------
    bound : BoundTree
        One that ``is_worth_it``.
    states : ndarray of int, shape (sets, variables)
        Positions of observed states, in the order of ``tree.variables``; -1 where unobserved.

    Of evidence that is impossible ``log_z`` is -inf, and marginals are NaN.

    Notes
    -----
    Hugin propagation (Jensen, Lauritzen and Olesen 1990), as in `BoundTree.calibrate`.

    Examples
    --------
    >>> from bayesmc.factors import CliqueTree
    >>> tree = CliqueTree({"rain": 2, "wet": 2}, [("rain",), ("rain", "wet")])
    >>> bound = tree.bind([np.array([0.8, 0.2]), np.array([[0.9, 0.1], [0.1, 0.9]])])
    >>> found = calibrate_many(bound, np.array([[-1, -1], [-1, 1]]))
    >>> np.exp(found.log_z).round(4).tolist(), found.marginals[1, :2].round(4).tolist()
    ([1.0, 0.26], [0.3077, 0.6923])
    """
    try:
        with np.errstate(under="raise", over="raise", invalid="raise"):
            found = _Passes(bound, np.ascontiguousarray(states.T)).run()
    except FloatingPointError:
        return _one_by_one(bound, states)
    possible = np.isfinite(found.log_z)
    if possible.any() and not possible.all():  # impossible sets have no marginals; the others have
        found.marginals[possible] = calibrate_many(bound, states[possible]).marginals
    return found


class OneOfMany(Calibrated):
    """The distribution under one of many evidence sets: marginals are at hand, all else is worked out.

    Parameters
    ----------
    bound : BoundTree
    states : dict
        Variable -> position of its observed state.
    log_z : float
    flat : ndarray
        Marginals of all variables, end to end.
    """

    def __init__(
        self, bound: BoundTree, states: Mapping[Any, int], log_z: float, flat: np.ndarray
    ) -> None:
        self.log_z, self._bound, self._given = log_z, bound, dict(states)
        self._row = flat
        flat.flags.writeable = False

    @cached_property
    def _whole(self) -> Calibrated:
        return self._bound.calibrate(self._given)

    @property
    def _context(self) -> Context:  # type: ignore[override]
        return self._whole._context

    @property
    def _collected(self) -> Any:  # type: ignore[override]
        return self._whole._collected

    @property
    def _ratios(self) -> Any:  # type: ignore[override]
        return self._whole._ratios

    def marginal(self, variable: Any) -> np.ndarray:
        return self._marginal(self._bound.tree.index[variable])

    def marginals(self) -> list[np.ndarray]:
        return [self._marginal(v) for v in range(len(self._bound.tree.variables))]

    def _marginal(self, v: int) -> np.ndarray:
        start, stop = self._bound.tree.program().place[v]
        return self._row[start:stop]


# ---- private ------------------------------------------------------------------------------------


class _Passes:
    """Both passes for one block; tables have the sets last, or one entry there where all agree."""

    def __init__(self, bound: BoundTree, states: np.ndarray) -> None:
        assert bound._linear is not None
        self.tree, self.states = bound.tree, states
        self.potentials, self.log_scale = bound._linear
        self.program: Program = bound.tree.program()
        self.sets = states.shape[1]
        self.work: list[np.ndarray] = []
        self.total: list[np.ndarray] = []

    def run(self) -> Block:
        log_z = self.collect()
        if not np.isfinite(log_z).all():
            return Block(log_z, np.full((self.sets, int(self.program.counts.sum())), np.nan))
        # an underflow here only loses parts of beliefs that are below 1e-308 of the whole
        with np.errstate(under="ignore"):
            return Block(log_z, self.distribute())

    def collect(self) -> np.ndarray:
        """Messages to the roots; the log of the total of each set."""
        cliques, shapes, kept = self.tree.cliques, self.program.cliques, self.potentials.unobserved
        masks = self.masks()
        count = len(cliques)
        work: list[Any] = [None] * count
        total: list[Any] = [None] * count
        message: list[Any] = [None] * count
        changed = [False] * count
        log_z = np.full(self.sets, self.log_scale)
        for k in range(count - 1, -1, -1):
            own = cliques[k]
            changed[k] = k in masks or any(changed[c] for c in own.children)
            if not changed[k] and k in kept:
                one = kept[k]
                work[k], total[k] = one.work[..., None], one.total[:, None]
                message[k] = None if one.message is None else one.message[:, None]
                log_z += one.log_scale
                continue
            table = self.potentials.tables[k][..., None]
            for (before, states, after), seen in masks.get(k, ()):
                table = table.reshape(before, states, after, -1) * seen[:, None]
            for child in own.children:
                if not shapes[child].parent_runs:  # a parent with a single entry
                    table = table * message[child][0]
                    continue
                view = table.reshape(*shapes[child].parent_runs, -1)
                table = view * message[child].reshape(*shapes[child].message_runs, -1)
            work[k] = table.reshape(*shapes[k].matrix, -1)
            total[k] = np.add.reduce(work[k], axis=1)
            mean = np.add.reduce(total[k], axis=0) / len(total[k])
            with np.errstate(divide="ignore"):
                scale = np.log(mean)
            log_z += scale
            message[k] = total[k] / np.where(mean > 0.0, mean, 1.0)
            if not changed[k] and mean[0] > 0.0:
                kept[k] = Collected(
                    work[k][..., 0], total[k][:, 0], message[k][:, 0], float(scale[0])
                )
        self.work, self.total = work, total
        return log_z

    def masks(self) -> dict[int, list[tuple[tuple[int, int, int], np.ndarray]]]:
        """Clique -> of its observed variables how they stand in its table, and which states are left."""
        found: dict[int, list[tuple[tuple[int, int, int], np.ndarray]]] = {}
        for v in np.flatnonzero((self.states >= 0).any(axis=1)).tolist():
            shape = self.tree.mask_shapes[v]
            own = self.states[v]
            seen = ((own == np.arange(shape[1])[:, None]) | (own < 0)).astype(float)
            found.setdefault(self.tree.home[v], []).append((shape, seen))
        return found

    def distribute(self) -> np.ndarray:
        """Beliefs from the roots on; the marginals of all variables, set by set."""
        shapes = self.program.cliques
        above: list[Any] = [np.ones((1, 1))] * len(shapes)
        found: list[np.ndarray] = []
        for k, clique in enumerate(self.tree.cliques):
            ratio = above[k] / np.maximum(self.total[k], _TINY)
            belief = self.work[k] * ratio[:, None]
            if shapes[k].outputs:
                residual = np.add.reduce(belief, axis=0)
                found += [_summed(residual, steps) for _, steps in shapes[k].outputs]
            for child in clique.children:
                above[child] = _summed(belief, shapes[child].from_parent)
        if not found:
            return np.zeros((self.sets, 0))
        flat = np.concatenate([np.broadcast_to(f, (len(f), self.sets)) for f in found])
        sums = np.add.reduceat(flat, self.program.starts, axis=0)
        flat /= np.repeat(sums, self.program.counts, axis=0)
        return np.ascontiguousarray(flat.T)


def _summed(table: np.ndarray, steps: tuple[SumStep, ...]) -> np.ndarray:
    """A table summed over runs of its axes, the sets last."""
    sets = table.shape[-1]
    for before, summed, after in steps:
        table = np.add.reduce(table.reshape(before, summed, after, sets), axis=1)
    return table.reshape(-1, sets)


def _one_by_one(bound: BoundTree, states: np.ndarray) -> Block:
    """The same, each set by itself, with logs where they are needed."""
    tree = bound.tree
    place = tree.program().place
    size = max((stop for _, stop in place.values()), default=0)
    log_z, flat = np.empty(len(states)), np.full((len(states), size), math.nan)
    for k, row in enumerate(states):
        seen = {tree.variables[v]: int(row[v]) for v in np.flatnonzero(row >= 0)}
        one = bound.calibrate(seen)
        log_z[k] = one.log_z
        if one.log_z > -math.inf:
            for v, marginal in enumerate(one.marginals()):
                flat[k, slice(*place[v])] = marginal
    return Block(log_z, flat)
