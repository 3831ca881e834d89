"""Which modes may follow which: pairs, their kinds, and groups of them.

A *pair* is a mode of the slice before and one of this slice that may follow it; slice 0 has modes alone.
Pairs whose Gaussian nodes have the same coefficients are of one *kind*: often there is one kind for each mode
of this slice.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.engines.switching.modes import Modes


class Groups(NamedTuple):
    """Members of groups, one group after the other.

    Attributes
    ----------
    members : ndarray of int, shape (groups, size)
    valid : ndarray of bool or None
        Which of them are members, where groups are of unequal size.
    in_order : bool
        Whether groups are of equal size and their members stand in order.
    """

    members: np.ndarray
    valid: np.ndarray | None
    in_order: bool

    @property
    def are_single(self) -> bool:
        """Whether every group has the member of its own number, and no other."""
        return self.valid is None and self.members.shape[1] == 1

    def of(self, array: np.ndarray) -> np.ndarray:
        """Entries of members, shape (groups, size, *rest)."""
        if self.in_order:
            return array.reshape(*self.members.shape, *array.shape[1:])
        return array.take(self.members, axis=0)

    def logs(self, log: np.ndarray) -> np.ndarray:
        """Logs of members' weights, shape (groups, size, *rest)."""
        found = self.of(log)
        if self.valid is None:
            return found
        return np.where(
            self.valid.reshape(self.valid.shape + (1,) * (log.ndim - 1)), found, -np.inf
        )


def grouped(of: np.ndarray, count: int) -> Groups:
    """Members by the group that they are ``of``."""
    order = np.argsort(of, kind="stable")
    sizes = np.bincount(of, minlength=count)
    most = max(int(sizes.max(initial=0)), 1)
    valid = np.arange(most) < sizes[:, None]
    members = np.zeros((count, most), dtype=np.intp)
    members[valid] = order
    everyone = np.arange(len(of))
    return Groups(
        members, None if valid.all() else valid, np.array_equal(members.reshape(-1), everyone)
    )


class Pairs:
    """Which modes may follow which.

    Parameters
    ----------
    before, now : ndarray of int
        Configurations that there are; ``before`` is empty in slice 0.
    src, dst : ndarray of int, shape (pairs,)
        Places among them, or in slice 0 no ``src``.
    classes : ndarray of int
        Of the configurations before: those that Gaussian nodes tell apart.

    Attributes
    ----------
    kind : ndarray of int, shape (pairs,)
    of_kind : ndarray of int, shape (kinds,)
        A pair of each kind.
    """

    def __init__(
        self, before: np.ndarray, now: np.ndarray, src: np.ndarray, dst: np.ndarray, classes: np.ndarray
    ) -> None:  # fmt: skip
        self.before, self.now = before, now
        self.is_first = not len(before)
        cls = np.zeros(len(dst), dtype=np.intp) if self.is_first else classes[before[src]]
        order = np.lexsort((src, cls, dst)) if len(src) else np.arange(len(dst))
        self.src, self.dst = src[order] if len(src) else src, dst[order]
        key = self.dst * (int(cls.max(initial=0)) + 1) + cls[order]
        _, self.of_kind, self.kind = np.unique(key, return_index=True, return_inverse=True)
        self.by_kind = grouped(self.kind, len(self.of_kind))
        self.by_dst = grouped(self.dst, len(now))
        self.kinds_by_dst = grouped(self.dst[self.of_kind], len(now))
        self.by_src = None if self.is_first else grouped(self.src, len(before))

    def values(self, modes: Modes, at: np.ndarray) -> dict[str, np.ndarray]:
        """Stored values of the modes of some pairs, shape (*at.shape, *plates)."""
        found = modes.at(self.now[self.dst[at]])
        return found if self.is_first else found | modes.at(self.before[self.src[at]], PREVIOUS)
