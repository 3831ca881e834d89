"""What Hamiltonian chains learn while they warm up: the length of a step, and a metric.

The warmup has a beginning, in which every chain finds the mass with a step of its own; windows of doubling
length, at the end of each of which the metric becomes the variance (or covariance) of that window's draws
of all chains; and an end for the step alone. Metric and step are then common to all chains and frozen.

Nothing here has units: the first metric comes from the gradients where chains start, and is what later ones
are shrunk towards, as Stan shrinks towards a thousandth of the identity.

References
----------
Hoffman and Gelman (2014), JMLR 15, sec. 3.2 (dual averaging) and algorithm 4 (the first step); Stan Reference
Manual, version 2.36, chapter "MCMC Sampling", section "Automatic parameter tuning" (windows, regularisation).
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from bayesmc.kernels.no_u_turn import DIVERGENT, Gradient, Place, Scale, energy_of, leapfrog

#: sweeps of the beginning, of the first window, and of the end; shares of a warmup too short for them
_FAST, _WINDOW, _END = 75, 25, 50
_SHORT = (0.15, 0.10)
#: a warmup below which no metric is learnt
_LEAST = 20
#: the end of the beginning of a warmup of no known length, and how often it may double
_OPEN, _DOUBLINGS = 20, 20
#: constants of dual averaging: shrinkage towards ten times the first step, early steps, decay
_GAMMA, _EARLY, _KAPPA, _AHEAD = 0.05, 10.0, 0.75, math.log(10.0)
#: trajectories that diverge by chance, their number and their share, at most; by how much the target of
#: acceptance comes nearer to 1 where more do
_DIVERGED, _NEARER = (2, 2e-3), 4.0
#: doublings (or halvings) in search of a first step
_SEARCH = 60
#: draws that the metric from before counts for, and the share of it that it is shrunk towards
_PRIOR, _SHRUNK = 5.0, 1e-3
#: ratio of scales of the first metric to their median, at most
_RANGE = 1e6
#: variance between chains, over that within, above which they have not met
_APART = 4.0

Metric = Literal["diagonal", "dense"]


def windows(warmup: int | None) -> tuple[int, ...]:
    """Sweeps after which the metric is renewed; the first is where the beginning ends.

    Parameters
    ----------
    warmup : int or None
        Sweeps of the whole warmup; None where it may end at a hundred, or at any doubling of that: then
        windows double, and each end leaves a fifth of the sweeps so far to the step.

    Examples
    --------
    >>> from bayesmc.kernels.hamiltonian_warmup import windows
    >>> windows(1000), windows(100), windows(10), windows(None)[:4]
    ((75, 100, 150, 250, 450, 950), (15, 90), (), (20, 40, 80, 160))
    """
    if warmup is None:
        return tuple(_OPEN << k for k in range(_DOUBLINGS))
    if warmup < _LEAST:
        return ()
    fast, size, last = _FAST, _WINDOW, _END
    if fast + size + last > warmup:
        fast, last = (int(share * warmup) for share in _SHORT)
        size = warmup - fast - last
    limit = warmup - last
    ends = [fast]
    while ends[-1] < limit:
        # a window that would leave the next one without room takes its place
        ends.append(limit if ends[-1] + 3 * size > limit else ends[-1] + size)
        size *= 2
    return tuple(ends)


class StepSize:
    """Dual averaging of the logarithm of a step's length towards a mean acceptance.

    A memory is a dict: ``log`` and ``average`` (chains,), ``centre``, ``bias`` (chains,), ``count``, and the
    ``target``.

    Parameters
    ----------
    target : float
        The mean acceptance that is wanted.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.hamiltonian_warmup import StepSize
    >>> learning = StepSize(0.8)
    >>> memory = learning.start(np.zeros(2))
    >>> for _ in range(2000):
    ...     memory = learning.learnt(memory, np.exp(-np.exp(memory["log"])), pooled=True)
    >>> learning.frozen(memory)["log"].round(1)  # the step at which exp(-step) is 0.8
    array([-1.5, -1.5])
    """

    def __init__(self, target: float) -> None:
        self.target = target

    def start(self, log: np.ndarray, target: float | None = None) -> dict[str, Any]:
        """The memory before the first step, given a first length for each chain, and another target."""
        zeros = np.zeros_like(log)
        return {"log": log, "average": log, "centre": log + _AHEAD, "bias": zeros, "count": 0,
                "target": self.target if target is None else target}  # fmt: skip

    def learnt(
        self, memory: dict[str, Any], acceptance: np.ndarray, pooled: bool
    ) -> dict[str, Any]:
        """The memory after a sweep; ``pooled`` where all chains are to take the same step."""
        error = memory["target"] - np.where(np.isnan(acceptance), 0.0, acceptance)
        if pooled:
            error = np.full_like(error, error.mean())
        count = memory["count"] + 1
        share = 1.0 / (count + _EARLY)
        bias = (1.0 - share) * memory["bias"] + share * error
        log = memory["centre"] - bias * math.sqrt(count) / _GAMMA
        weight = count**-_KAPPA
        average = (1.0 - weight) * memory["average"] + weight * log
        return {**memory, "log": log, "average": average, "bias": bias, "count": count}

    def frozen(self, memory: dict[str, Any]) -> dict[str, Any]:
        """The memory at the end of the warmup: one length for all chains."""
        log = memory["average"] if memory["count"] else memory["log"]
        log = np.full_like(log, log.mean())
        return {**memory, "log": log, "average": log}


class Bends:
    """Whether trajectories go on diverging in a warmup, so that shorter steps are to be learnt.

    A memory is an array: trajectories that diverged in the later half of a window, and all of that half. A
    density that bends more sharply in places than elsewhere asks for shorter steps than a mean acceptance
    does; so the target comes nearer to 1, once.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.hamiltonian_warmup import Bends
    >>> bends = Bends()
    >>> memory = bends.seen(bends.start(), np.array([True, False, False, True]), sweep=9, begun=0, end=10)
    >>> round(bends.target(memory, 0.8), 2), bends.target(bends.start(), 0.8)
    (0.95, 0.8)
    """

    def start(self) -> np.ndarray:
        """The memory at the beginning of a window."""
        return np.zeros(2)

    def seen(
        self, memory: np.ndarray, divergent: np.ndarray, sweep: int, begun: int, end: int
    ) -> np.ndarray:
        """The memory after a sweep of a window that began after one sweep and ends after another."""
        if 2 * sweep <= begun + end:
            return memory
        return np.asarray(memory + [divergent.sum(), divergent.size])

    def target(self, memory: np.ndarray, target: float) -> float:
        """The acceptance that steps are learnt for after a window."""
        diverged, count = memory
        if diverged < _DIVERGED[0] or diverged < _DIVERGED[1] * count:
            return target
        return 1.0 - (1.0 - target) / _NEARER


def first_steps(
    gradient: Gradient,
    place: Place,
    log: np.ndarray,
    scale: Scale,
    rng: np.random.Generator,
    target: float,
    pooled: bool,
) -> np.ndarray:
    """Logarithms of lengths of a step, of each chain or of all together, about which one step is accepted.

    Lengths are doubled while a step is accepted with more than the wanted chance, or halved while it is not.
    """
    rows = np.arange(len(log))
    slope = scale.pulled(place.slope)
    up = np.zeros(len(log), dtype=bool)
    going = np.ones(len(log), dtype=bool)
    for turn in range(_SEARCH):
        momenta = rng.standard_normal(place.u.shape)
        half = 0.5 * np.exp(log)[:, None]
        _, moved, _, ahead, _ = leapfrog(gradient, place.u, momenta, slope, half, scale, rows)
        change = energy_of(momenta, place.log) - energy_of(moved, ahead)
        chance = np.exp(np.minimum(np.where(np.isnan(change), -DIVERGENT, change), 0.0))
        accepted = np.full_like(going, chance.mean() > target) if pooled else chance > target
        if turn == 0:
            up = accepted
        going &= accepted == up
        if not going.any():
            break
        log = np.where(going, log + np.where(up, math.log(2.0), -math.log(2.0)), log)
    return log


class MetricLearning:
    """Variances or covariances of the draws of all chains, window by window.

    A memory is a dict: ``first`` (the inverse metric from the start, shape (size,)), ``root`` (see
    ``Scale``), and of the present window ``count``, ``mean`` (of each chain) and ``square`` (sums of squares,
    or of products, about these).

    Parameters
    ----------
    kind : "diagonal" or "dense"
    """

    def __init__(self, kind: Metric) -> None:
        self.kind = kind

    def start(self, slope: np.ndarray) -> dict[str, Any]:
        """The memory before the first step, given gradients at the starting points, shape (chains, size).

        Where a density is Normal, the mean square of its gradients is the inverse of its variance; far out
        all of them are too large in proportion, which the step makes good.
        """
        square = np.square(slope).mean(axis=0)
        fine = np.isfinite(square) & (square > 0)
        middle = float(np.median(square[fine])) if fine.any() else 1.0
        square = np.where(fine, square, middle)
        first = 1.0 / np.clip(square, middle / _RANGE**2, middle * _RANGE**2)
        root = np.sqrt(first)
        return {
            "first": first,
            "root": root if self.kind == "diagonal" else np.diag(root),
            **self._empty(*slope.shape),
        }

    def learnt(self, memory: dict[str, Any], u: np.ndarray) -> dict[str, Any]:
        """The memory with one more draw of every chain (Welford's update)."""
        if not np.isfinite(u).all():
            return memory
        count = memory["count"] + 1
        away = u - memory["mean"]
        mean = memory["mean"] + away / count
        left = u - mean
        square = (away * left).sum(axis=0) if self.kind == "diagonal" else away.T @ left
        return {**memory, "count": count, "mean": mean, "square": memory["square"] + square}

    def renewed(self, memory: dict[str, Any]) -> dict[str, Any]:
        """The memory with a metric from the window that ends, and a new window."""
        found = self._spread(memory)
        chains, size = memory["mean"].shape
        count = chains * memory["count"]
        if found is None:
            return {**memory, **self._empty(chains, size)}
        share = count / (count + _PRIOR)
        found = share * found
        prior = (1.0 - share) * _SHRUNK * memory["first"]
        root = memory["root"]
        if self.kind == "diagonal":
            root = np.sqrt(found + prior)
        else:
            try:
                root = _root_of(found + np.diag(prior))
            except np.linalg.LinAlgError:  # rounding: keep what was there
                pass
        if not np.isfinite(root).all():
            root = memory["root"]
        return {**memory, "root": root, **self._empty(chains, size)}

    def _spread(self, memory: dict[str, Any]) -> np.ndarray | None:
        """Variances or covariances of the window's draws; None of too few.

        Chains that have not met, as where they name components differently, say nothing of how far a step may
        go: what lies between them counts only where it is not far more than what lies within.
        """
        count, mean = memory["count"], memory["mean"]
        chains = len(mean)
        if count < 2:
            return None
        within = memory["square"] / (chains * (count - 1))
        if chains == 1:
            return np.asarray(within)
        away = mean - mean.mean(axis=0)
        inside = within if within.ndim == 1 else np.diagonal(within)
        met = np.square(away).sum(axis=0) <= _APART * (chains - 1) * inside
        away = away * met
        between = np.square(away).sum(axis=0) if within.ndim == 1 else away.T @ away
        return np.asarray((1.0 - 1.0 / count) * within + between / (chains - 1))

    def _empty(self, chains: int, size: int) -> dict[str, Any]:
        shape = (size,) if self.kind == "diagonal" else (size, size)
        return {"count": 0, "mean": np.zeros((chains, size)), "square": np.zeros(shape)}


# ---- private ------------------------------------------------------------------------------------


def _root_of(cov: np.ndarray) -> np.ndarray:
    """Cholesky factor of a covariance, taken of the correlation, so that units do not matter."""
    scale = np.sqrt(np.diagonal(cov))
    return scale[:, None] * np.linalg.cholesky(cov / np.outer(scale, scale))
