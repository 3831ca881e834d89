"""Chains that a warmup leaves in modes that weigh nothing, and how they go on among the others.

A chain that starts near a mode of its own may stay there for ever, however little that mode weighs, and every
average over chains is then wrong by its share of them. What a mode weighs is its height times its width: of
the draws of a window, the mean log density, and the entropy of a Normal density with their spread. Of a chain
that may be lost that entropy is the one of independent numbers, which is too large; of one that outweighs it,
that of the covariance of its draws, which is too small where they are few. A margin of one for each number is
for what is no Normal density, and ``exp(-20)`` for the answer.

References
----------
Yao, Vehtari and Gelman (2022), Stacking for non-mixing Bayesian computations, JMLR 23 (chains in modes that
weigh little; there they are weighed after the run); DiCiccio, Kass, Raftery and Wasserman (1997), JASA 92,
sec. 2 (the weight of a mode by draws from it).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

#: the log of what a mode weighs beside another that is left out, and more of it for each number
_NOTHING, _EACH = 20.0, 1.0
#: draws of a chain below which its spread is not known: at least, and for each number; and numbers up to
#: which chains keep their covariances
_FEW, _FOR_EACH, _NUMBERS = 40, 2, 100
#: share of all chains, and how many of them at least, that have to be in the modes that count
_SHARE, _FOUND = 1 / 32, 2
#: standard deviations of both by which modes are apart
_APART = 4.0
#: of that log, how much a chain may rise within a window and count as one that stays
_RISE = 0.25
#: share of a number's variance within a window that a line may explain: the spread of a chain that is on its
#: way somewhere is not that of its mode
_DRIFT = 0.5


class LostChains:
    """Of each chain in a window: the log density and its numbers, their products, and how they go with time.

    A memory is a dict: ``count``; of log density and numbers (chains, 1 + size) ``mean`` and ``timed``, the
    means of them and of them times the count; ``products`` of numbers about their means (chains, size, size).

    Parameters
    ----------
    numbers : int
        How many there may be at most; with more, and of 0, nobody is lost.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.lost_chains import LostChains
    >>> rng, lost = np.random.default_rng(0), LostChains()
    >>> memory = lost.start(chains=4, size=1)
    >>> for _ in range(50):  # the last chain is 40 below the others and 9 away
    ...     u = rng.standard_normal((4, 1))
    ...     memory = lost.seen(memory, u + [[0], [0], [0], [9]], -0.5 * u[:, 0] ** 2 - [0, 0, 0, 40])
    >>> lost.found(memory)
    array([False, False, False,  True])
    >>> lost.moved(lost.found(memory), rng)[:3]
    array([0, 1, 2])
    """

    def __init__(self, numbers: int = _NUMBERS) -> None:
        self.numbers = numbers

    def start(self, chains: int, size: int) -> dict[str, Any]:
        """The memory at the beginning of a window."""
        rows, kept = np.zeros((chains, 1 + size)), size if size <= self.numbers else 0
        return {"count": 0, "mean": rows, "timed": rows, "products": np.zeros((chains, kept, kept))}

    def seen(self, memory: dict[str, Any], u: np.ndarray, log: np.ndarray) -> dict[str, Any]:
        """The memory with one more draw of every chain (Welford's update)."""
        if not memory["products"].size:
            return memory
        count = memory["count"] + 1
        rows = np.column_stack([log, u])
        away = rows - memory["mean"]
        mean = memory["mean"] + away / count
        return {
            "count": count,
            "mean": mean,
            "timed": memory["timed"] + (count * rows - memory["timed"]) / count,
            "products": memory["products"] + away[:, 1:, None] * (rows - mean)[:, None, 1:],
        }

    def found(self, memory: dict[str, Any]) -> np.ndarray:
        """Which chains are lost: those that stay in modes that weigh nothing beside where others are.

        Both the height and the weight of a mode have to be far below: a spike that is high and thin outweighs
        nobody, and one that is low and wide is not misjudged by its width. It has to be a mode of its own, in
        some number apart from each of those that outweigh it: a chain that goes up and down a funnel is far
        wider than where it mostly is, but no mode is apart from it. Nor is a chain lost that still rises, or
        is on its way somewhere else.
        """
        products, count = memory["products"], memory["count"]
        chains, size, _ = products.shape
        nobody = np.zeros(chains, dtype=bool)
        best = max(math.ceil(_SHARE * chains), _FOUND)
        if not size or count < max(_FEW, _FOR_EACH * size) or chains <= best:
            return nobody
        height, mean = memory["mean"][:, 0], memory["mean"][:, 1:]
        variance = np.diagonal(products, axis1=1, axis2=2) / count
        # of lines through what is kept, by least squares: how far they rise within the window
        rise = memory["timed"] - 0.5 * (count + 1) * memory["mean"]
        rise *= 12 * count / (count**2 - 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            most = height + 0.5 * np.log(variance).sum(axis=1)
            sign, log_det = np.linalg.slogdet(products / count)
            drift = np.square(rise[:, 1:]) / (12 * variance)
        least = np.where(sign > 0, height + 0.5 * log_det, -np.inf)
        top = np.argsort(-least, kind="stable")[:best]
        if not (np.isfinite(height).all() and np.isfinite(least[top]).all()):
            return nobody
        margin = _NOTHING + _EACH * size
        found = (height < height[top].min() - margin) & (most < least[top].min() - margin)
        # a chain that stands still has no drift
        found &= (rise[:, 0] < _RISE * margin) & ~(drift > _DRIFT).any(axis=1)
        for other in top:
            away = np.square(mean - mean[other]) / (variance + variance[other])
            found &= away.max(axis=1) > _APART**2
        return np.asarray(found)

    def moved(self, lost: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """For every chain the one from whose place it goes on: its own, or one of those not lost."""
        rows = np.arange(len(lost))
        rows[lost] = rng.choice(rows[~lost], size=int(lost.sum()))
        return rows
