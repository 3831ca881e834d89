"""What a run makes: its warmup, and rounds of draws until they are enough, or are seen not to be."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

#: the first sweep at which a warmup may end where that is judged
_END = 100
#: draws of each chain from which on a run may be seen not to get to its effective size
_HOPELESS = 500
#: how many times what is announced a run makes at most that would get there so
_FURTHER = 2
#: draws of each chain in the first round, at least, and how much longer a later round may make a run
_ROUND, _GROWTH = 16, 3.0


@dataclass(frozen=True)
class Lengths:
    """What a run makes.

    Attributes
    ----------
    chains : int
    warmup : int
        Sweeps; at most, where there is a ``judge``.
    draws : int
        Of each chain; where there is an ``ess`` at most, or up to ``most`` where these will do.
    superchains : int
        Groups of consecutive chains that start as one; 0 where every chain starts by itself.
    ess : float or None
        Effective size after which nothing more is drawn.
    judge : callable or None
        Whether draws of a warmup, some nodes' stored values, tell nothing of their starts any more.
    """

    chains: int
    warmup: int
    draws: int
    superchains: int = 0
    ess: float | None = None
    judge: Callable[[Mapping[str, np.ndarray]], bool] | None = None

    @property
    def most(self) -> int:
        """Draws of each chain that a run makes that is nearly there after ``draws``."""
        return self.draws if self.ess is None else _FURTHER * self.draws

    def ends(self) -> Iterator[int]:
        """Sweeps at which the warmup may end."""
        end = _END
        while self.judge is not None and end < self.warmup:
            yield end
            end *= 2
        yield self.warmup

    def first(self) -> int:
        """Draws of each chain in the first round."""
        if self.ess is None:
            return self.draws
        return min(max(math.ceil(self.ess / self.chains), _ROUND), self.draws)

    def further(self, made: int, share: float) -> int:
        """Draws of each chain in the next round, where those made are a share of what is wanted.

        None where even the most that a run makes would not do: the limit is there for the hopeless, and
        whoever is nearly there goes on.
        """
        if made >= min(_HOPELESS, self.draws) and share * self.most < made:
            return 0
        needed = made * min(1.05 / max(share, 1e-9), _GROWTH)
        return min(max(math.ceil(needed) - made, made // 8, 1), self.most - made)
