"""How far Hamiltonian chains move effects apart from their scale, learnt from the draws of a window.

Of free numbers in which a density is most like a product of Normals, trajectories need the fewest steps, and
funnels have no necks. For each effect the share of centring is the one among a few that makes the Kullback-
Leibler divergence from the draws to a Normal least: the logarithm of the numbers' standard deviation less the
mean logarithm of how far the map stretches them.

References
----------
Papaspiliopoulos, Roberts and Skold (2007), A general framework for the parametrization of
hierarchical models, Statistical Science 22; Gorinova, Moore and Hoffman (2020), Automatic
reparameterisation of probabilistic programs, ICML, sec. 4 (shares of centring).
"""

from __future__ import annotations

from typing import Any

import numpy as np

#: shares that are tried: 0 apart, 1 as declared
_SHARES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
#: nats by which a share has to be better than the present one; by which some one has to be, or all together
_EACH, _ONE, _ALL = 0.05, 0.2, 0.5
#: draws of all chains that tell of it, at least
_FEW = 80


class Centring:
    """Sums over the draws of a window, for each share and effect.

    A memory is a dict: ``count``; ``shift`` (shares, effects), which was the mean of the first draws; sums of
    numbers less that and of their squares; and of the logarithms of scales.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.centring import Centring
    >>> rng, centring = np.random.default_rng(0), Centring()
    >>> memory = centring.start(effects=2)
    >>> for _ in range(100):  # of the first effect the data say nothing, the other is known
    ...     scale = np.exp(rng.normal(size=(4, 1)))
    ...     x = np.concatenate([scale * rng.normal(size=(4, 1)), rng.normal(3.0, 0.01, (4, 1))], axis=1)
    ...     memory = centring.seen(memory, x, np.zeros((4, 2)), np.broadcast_to(scale, (4, 2)))
    >>> centring.found(memory, np.ones(2))
    array([0., 1.])
    """

    def start(self, effects: int) -> dict[str, Any]:
        """The memory at the beginning of a window."""
        rows = np.zeros((len(_SHARES), effects))
        return {"count": 0, "shift": rows, "sums": rows, "squares": rows, "logs": rows[0]}

    def seen(
        self, memory: dict[str, Any], x: np.ndarray, loc: np.ndarray, scale: np.ndarray
    ) -> dict[str, Any]:
        """The memory with one more draw of every chain, shape ``(chains, effects)`` each."""
        share, logs = _SHARES[:, None, None], np.log(scale)
        with np.errstate(over="ignore"):
            u = (x - loc) * np.exp((share - 1.0) * logs) + share * loc
        shift = memory["shift"] if memory["count"] else u.mean(axis=1)
        away = u - shift[:, None]
        return {
            "count": memory["count"] + len(x),
            "shift": shift,
            "sums": memory["sums"] + away.sum(axis=1),
            "squares": memory["squares"] + np.square(away).sum(axis=1),
            "logs": memory["logs"] + logs.sum(axis=0),
        }

    def found(self, memory: dict[str, Any], now: np.ndarray) -> np.ndarray:
        """The shares that suit best; those of now where the others are hardly better."""
        count = memory["count"]
        if count < _FEW:
            return now
        mean = memory["sums"] / count
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = 0.5 * np.log(memory["squares"] / count - np.square(mean))
        misfit = spread + (1.0 - _SHARES)[:, None] * (memory["logs"] / count)
        misfit = np.where(np.isfinite(misfit), misfit, np.inf)
        own = np.abs(_SHARES[:, None] - now).argmin(axis=0)
        best, columns = misfit.argmin(axis=0), np.arange(len(now))
        with np.errstate(invalid="ignore"):
            gain = misfit[own, columns] - misfit[best, columns]
        better = np.isfinite(gain) & (gain > _EACH)
        gains = gain[better]
        if not (gains.max(initial=0.0) > _ONE or gains.sum() > _ALL):
            return now
        return np.where(better, _SHARES[best], now)
