"""Chains that a warmup leaves in modes that weigh nothing, and how they go on among the others.

A chain that starts near a mode of its own may stay there for ever, however little that mode weighs, and every
average over chains is then wrong by its share of them. What a mode weighs is its height times its width: of
the draws of a window, the mean log density, and the entropy of a Normal density with their spread. That
entropy is one of independent numbers, too large where numbers are correlated, by less than one for each in
most posteriors; so modes are compared with a margin of one for each number, and ``exp(-20)`` for the answer.

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
#: draws of a chain below which its spread is not known
_FEW = 40
#: share of all chains, and how many of them at least, that have to be in the modes that count
_SHARE, _FOUND = 1 / 32, 2
#: standard deviations of both by which modes are apart
_APART = 4.0
#: of that log, how much a chain may rise within a window and count as one that stays
_RISE = 0.25


class LostChains:
    """Of each chain in a window: mean and rise of the log density, and means and squares of its numbers.

    A memory is a dict: ``count``, ``log`` and ``timed`` (chains,), ``mean`` and ``square`` (chains, size).

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

    def start(self, chains: int, size: int) -> dict[str, Any]:
        """The memory at the beginning of a window."""
        row, rows = np.zeros(chains), np.zeros((chains, size))
        return {"count": 0, "log": row, "timed": row, "mean": rows, "square": rows}

    def seen(self, memory: dict[str, Any], u: np.ndarray, log: np.ndarray) -> dict[str, Any]:
        """The memory with one more draw of every chain (Welford's update)."""
        count = memory["count"] + 1
        away = u - memory["mean"]
        mean = memory["mean"] + away / count
        return {
            "count": count,
            "log": memory["log"] + (log - memory["log"]) / count,
            "timed": memory["timed"] + (count * log - memory["timed"]) / count,
            "mean": mean,
            "square": memory["square"] + away * (u - mean),
        }

    def found(self, memory: dict[str, Any]) -> np.ndarray:
        """Which chains are lost: those that stay in modes that weigh nothing beside where others are.

        Both the height and the weight of a mode have to be far below: a spike that is high and thin outweighs
        nobody, and one that is low and wide is not misjudged by its width. It has to be a mode of its own, in
        some number apart from each of those that outweigh it: a chain that goes up and down a funnel is far
        wider than where it mostly is, but no mode is apart from it. Nor is a chain lost that still rises.
        """
        chains, size = memory["mean"].shape
        nobody, count = np.zeros(chains, dtype=bool), memory["count"]
        best = max(math.ceil(_SHARE * chains), _FOUND)
        if count < _FEW or chains <= best:
            return nobody
        with np.errstate(divide="ignore", invalid="ignore"):
            width = 0.5 * np.log(memory["square"] / count).sum(axis=1)
        height = memory["log"]
        weight = height + width
        if not np.isfinite(weight).all():
            return nobody
        top = np.argsort(-weight, kind="stable")[:best]
        margin = _NOTHING + _EACH * size
        # of a line through the log densities, by least squares
        rise = 12 * count / (count**2 - 1) * (memory["timed"] - 0.5 * (count + 1) * height)
        below = (height < height[top].min() - margin) & (weight < weight[top].min() - margin)
        found = below & (rise < _RISE * margin)
        mean, variance = memory["mean"], memory["square"] / count
        for other in top:
            away = np.square(mean - mean[other]) / (variance + variance[other])
            found &= away.max(axis=1) > _APART**2
        return np.asarray(found)

    def moved(self, lost: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """For every chain the one from whose place it goes on: its own, or one of those not lost."""
        rows = np.arange(len(lost))
        rows[lost] = rng.choice(rows[~lost], size=int(lost.sum()))
        return rows
