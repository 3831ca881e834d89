"""How far beliefs move in a sweep: damping that grows where messages swing, and goes where it only slows."""

from __future__ import annotations

import numpy as np

#: sweeps after which the change must have shrunk by a factor; else shares do, down to the smallest
_PATIENCE, _SHRUNK, _SHARE, _LEAST = 8, 0.5, 0.6, 0.02
#: factor by which undamped sweeps are to shrink the rest for damping to be left out, and to be back
_QUICK, _SLOW = 0.35, 0.7
#: share below which rows are visited in parts, one after the other, and how many parts there are at most
_SHORT, _PARTS = 0.3, 64
#: cosine of two sweeps' moves from which on beliefs go the same way
_ONWARD = 0.9


class Pace:
    """The share of the way that beliefs move in a sweep.

    Where messages swing and come no closer it gets smaller. Where the damping is what slows them, it is left
    out: if undamped sweeps shrank the rest by a factor r, damped ones with a share d of the old shrink it by
    d + (1 - d) r. Should whole steps then come no closer, the damping is back for good. Where sweep after
    sweep goes the same way, there is far to go, and shorter steps would not help.

    Many like rows of which each moves the belief overshoot together, however short their steps: ``parts`` is
    into how many groups, visited one after the other, they are to be cut, on the way to updates in turn.

    Parameters
    ----------
    damping : float
    is_easy : bool
        Begin with whole steps.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.propagation.pace import Pace
    >>> pace = Pace(0.2)
    >>> for sweep in range(9):  # back and forth, without end
    ...     pace.saw(1.0, np.array([(-1.0) ** sweep]))
    >>> pace.share
    0.48
    """

    def __init__(self, damping: float, is_easy: bool = False) -> None:
        self.given = self.share = 1.0 - damping
        if is_easy:
            self.share = 1.0
        self.history: list[float] = []
        self.onward = 0
        self.may_relax = damping > 0.0
        self.parts = 1
        self.last: np.ndarray | None = None

    @property
    def is_slowest(self) -> bool:
        return self.share <= _LEAST

    def shorten(self) -> None:
        """Shorter steps; before they get very short, fewer factors at once."""
        self.share, self.history = max(self.share * _SHARE, _LEAST), []
        self.may_relax = False
        if self.share < _SHORT and self.parts < _PARTS:
            self.parts, self.share = self.parts * 8, self.given

    def saw(self, change: float, move: np.ndarray) -> None:
        """What a sweep changed, and where it went, with messages not settled."""
        self.history.append(change)
        self.onward = self.onward + 1 if self._goes_on(move) else 0
        self.last = move
        last = self.history[-3:]
        if len(self.history) > _PATIENCE and change > _SHRUNK * self.history[-1 - _PATIENCE]:
            if self.onward < _PATIENCE:
                self.shorten()
        elif self.share > self.given and len(last) > 1 and change > _SLOW * last[-2]:
            if self.onward < len(last):
                self.share, self.may_relax, self.history = self.given, False, []
        elif self.may_relax and len(last) == 3 and self.share == self.given:
            bound = 1.0 - self.share * (1.0 - _QUICK)
            if last[1] < bound * last[0] and last[2] < bound * last[1]:
                self.share, self.history = 1.0, []

    # ---- private -------------------------------------------------------------------------------

    def _goes_on(self, move: np.ndarray) -> bool:
        if self.last is None:
            return False
        size = np.linalg.norm(move) * np.linalg.norm(self.last)
        return bool(np.isfinite(size) and move @ self.last > _ONWARD * size)
