"""What Hamiltonian chains learn while they warm up: the length of a step, and a metric.

The warmup has a beginning, in which every chain finds the mass with a step of its own; windows of doubling
length; and an end for the step alone. At the end of each window, those of the beginning included, the metric
is renewed by that window's draws of all chains, and by the gradients there: the inverse metric is the
geometric mean of the variance of the draws and the inverse variance of the gradients, which is that of a
Normal density however small a part of it the chains have seen yet. Metric and step are then common to all
chains and frozen.

Nothing here has units: the first metric comes from the gradients where chains start.

References
----------
Hoffman and Gelman (2014), JMLR 15, sec. 3.2 (dual averaging) and algorithm 4 (the first step); Stan Reference
Manual, version 2.36, chapter "MCMC Sampling", section "Automatic parameter tuning" (windows); Seyboldt,
Carlson and Carpenter (2026), Preconditioning Hamiltonian Monte Carlo by minimizing Fisher divergence, arXiv
2603.18845 (sec. 3, diagonal and dense metrics).
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np

from bayesmc.kernels.no_u_turn import DIVERGENT, Gradient, Place, Scale, energy_of, leapfrog

#: sweeps of the beginning, of the first window, and of the end; shares of a warmup too short for them
_FAST, _WINDOW, _END = 75, 25, 50
_SHORT = (0.15, 0.10)
#: a warmup below which no metric is learnt
_LEAST = 20
#: the end of the beginning of a warmup of no known length, and how often it may double
_OPEN, _DOUBLINGS = 20, 20
#: the first window of the beginning; the next are twice as long, if there is room
_FIRST = 10
#: constants of dual averaging: shrinkage towards ten times the first step, early steps, decay
_GAMMA, _EARLY, _KAPPA, _AHEAD = 0.05, 10.0, 0.75, math.log(10.0)
#: share of trajectories that diverges by chance, at most; by how much the target of acceptance comes nearer
#: to 1 where more do
_DIVERGED, _NEARER = 1e-3, 4.0
#: trajectories among which a single one that diverges tells nothing
_FEW_MADE = 500
#: doublings (or halvings) in search of a first step
_SEARCH = 60
#: draws of all chains below which a metric stays as it is
_FEW = 10
#: share of the mean variance of whitened numbers that is added to theirs, and to that of gradients, so that
#: directions that no draw tells of have the scales of their numbers; and the ratio of variances up to which a
#: direction is left so, for it may be chance
_ADDED, _CHANCE = 1e-5, 2.0
#: ratio of scales of the first metric to their median, at most
_RANGE = 1e6
#: variance between chains, over that within, above which they have not met
_APART = 4.0

Metric = Literal["auto", "diagonal", "dense"]
#: numbers up to which a matrix is no dearer than most gradients
_DENSE = 200


def fitting(metric: Metric, size: int) -> Metric:
    """The metric of so many numbers: dense up to some two hundred where nobody says which."""
    if metric != "auto":
        return metric
    return "dense" if size <= _DENSE else "diagonal"


class Windows(NamedTuple):
    """Sweeps after which the metric is renewed; how many of these windows are of the beginning."""

    ends: tuple[int, ...]
    beginning: int


def windows(warmup: int | None) -> Windows:
    """The windows of a warmup.

    Parameters
    ----------
    warmup : int or None
        Sweeps of the whole warmup; None where it may end at a hundred, or at any doubling of that: then
        windows double, and each end leaves a fifth of the sweeps so far to the step.

    Examples
    --------
    >>> from bayesmc.kernels.hamiltonian_warmup import windows
    >>> windows(1000)
    Windows(ends=(10, 30, 75, 100, 150, 250, 450, 950), beginning=3)
    >>> windows(100), windows(10), windows(None).ends[:4]
    (Windows(ends=(15, 90), beginning=1), Windows(ends=(), beginning=0), (10, 20, 40, 80))
    """
    if warmup is None:
        return Windows((_FIRST, *(_OPEN << k for k in range(_DOUBLINGS))), 2)
    if warmup < _LEAST:
        return Windows((), 0)
    fast, size, last = _FAST, _WINDOW, _END
    if fast + size + last > warmup:
        fast, last = (int(share * warmup) for share in _SHORT)
        size = warmup - fast - last
    beginning, length = [0], _FIRST
    while beginning[-1] + 2 * length <= fast:
        beginning.append(beginning[-1] + length)
        length *= 2
    limit = warmup - last
    ends = [*beginning[1:], fast]
    count = len(ends)
    while ends[-1] < limit:
        # a window that would leave the next one without room takes its place
        ends.append(limit if ends[-1] + 3 * size > limit else ends[-1] + size)
        size *= 2
    return Windows(tuple(ends), count)


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
        if diverged <= max(_DIVERGED * count, float(count < _FEW_MADE)):
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
    """Variances or covariances of the draws of all chains, and of the gradients there, window by window.

    A memory is a dict: ``first`` (the inverse metric from the start, shape (size,)), ``root`` (see
    ``Scale``), and of the present window ``count``, ``draws`` and ``slopes``, each with ``mean`` (of each
    chain) and ``square`` (sums of squares about these; for a dense metric, of products).

    Parameters
    ----------
    kind : "diagonal" or "dense"
        A dense one is diagonal all the same as long as no direction is told from chance.
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
        return {"root": root, **self._empty(*slope.shape)}

    def learnt(self, memory: dict[str, Any], u: np.ndarray, slope: np.ndarray) -> dict[str, Any]:
        """The memory with one more draw of every chain (Welford's update)."""
        if not np.isfinite(u).all() or not np.isfinite(slope).all():
            return memory
        count = memory["count"] + 1
        products = self.kind == "dense"
        draws = _with(memory["draws"], u, count, products)
        slopes = _with(memory["slopes"], slope, count, products)
        return {**memory, "count": count, "draws": draws, "slopes": slopes}

    def renewed(self, memory: dict[str, Any]) -> dict[str, Any]:
        """The memory with a metric from the window that ends, and a new window."""
        chains, size = memory["draws"]["mean"].shape
        empty, count = self._empty(chains, size), chains * memory["count"]
        if memory["count"] < 2 or count < _FEW:
            return {**memory, **empty}
        met = _met(memory["draws"], memory["count"])
        draws, slopes = (_spread(memory[n], memory["count"], met) for n in ("draws", "slopes"))
        before = memory["root"]
        own = np.square(before) if before.ndim == 1 else np.square(before).sum(axis=1)
        apart = [x if x.ndim == 1 else np.diagonal(x) for x in (draws, slopes)]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            told = np.sqrt(apart[0] / apart[1])
        scale = np.sqrt(np.where(np.isfinite(told) & (told > 0), told, own))
        root = scale
        if self.kind == "dense":
            try:
                whitened = _whitened(draws, slopes, scale)
                root = scale if whitened is None else scale[:, None] * whitened
            except np.linalg.LinAlgError:
                pass
        return {**memory, "root": root if np.isfinite(root).all() else before, **empty}

    def emptied(self, memory: dict[str, Any]) -> dict[str, Any]:
        """The memory with the metric as it is, and a new window."""
        return {**memory, **self._empty(*memory["draws"]["mean"].shape)}

    def _empty(self, chains: int, size: int) -> dict[str, Any]:
        def sums(*shape: int) -> dict[str, np.ndarray]:
            return {"mean": np.zeros((chains, size)), "square": np.zeros(shape)}

        shape = (size, size) if self.kind == "dense" else (size,)
        return {"count": 0, "draws": sums(*shape), "slopes": sums(*shape)}


# ---- private ------------------------------------------------------------------------------------


def _with(
    sums: dict[str, np.ndarray], x: np.ndarray, count: int, products: bool
) -> dict[str, np.ndarray]:
    """Means of each chain and sums of squares (or of products) about them, with the count-th ``x``."""
    away = x - sums["mean"]
    mean = sums["mean"] + away / count
    left = x - mean
    more = away.T @ left if products else (away * left).sum(axis=0)
    return {"mean": mean, "square": sums["square"] + more}


def _within(sums: dict[str, np.ndarray], count: int) -> np.ndarray:
    """Variances (or covariances) within chains."""
    return sums["square"] / (len(sums["mean"]) * (count - 1))


def _met(sums: dict[str, np.ndarray], count: int) -> bool:
    """Whether chains have met, in all their numbers.

    Chains that have not, as where they name components differently, say nothing of how far a step may go; and
    gradients by numbers that have met tell of those that have not.
    """
    within = _within(sums, count)
    inside = within if within.ndim == 1 else np.diagonal(within)
    mean = sums["mean"]
    between = np.square(mean - mean.mean(axis=0)).sum(axis=0)
    return bool((between <= _APART * (len(mean) - 1) * inside).all())


def _spread(sums: dict[str, np.ndarray], count: int, met: bool) -> np.ndarray:
    """Variances or covariances of a window's draws, those between chains counted if these have met."""
    within, mean = _within(sums, count), sums["mean"]
    chains = len(mean)
    if chains == 1 or not met:
        return np.asarray(within)
    away = mean - mean.mean(axis=0)
    between = np.square(away).sum(axis=0) if within.ndim == 1 else away.T @ away
    return np.asarray((1.0 - 1.0 / count) * within + between / (chains - 1))


def _whitened(draws: np.ndarray, slopes: np.ndarray, scale: np.ndarray) -> np.ndarray | None:
    """A root of the inverse metric of numbers in units of ``scale``, symmetric; None of the identity.

    The geometric mean of two matrices A and C is ``A (A^-1 C)^(1/2)``; here A is the inverse of B, the
    covariance of gradients: ``B^(-1/2) (B^(1/2) C B^(1/2))^(1/2) B^(-1/2)``.
    """
    units = np.outer(scale, scale)
    draws, slopes = draws / units, slopes * units
    added = _ADDED * float(np.trace(draws)) / len(scale) * np.eye(len(scale))
    values, vectors = np.linalg.eigh(slopes + added)
    half = (vectors * np.sqrt(values)) @ vectors.T
    back = (vectors / np.sqrt(values)) @ vectors.T
    values, vectors = np.linalg.eigh(half @ (draws + added) @ half)
    middle = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    values, vectors = np.linalg.eigh(back @ middle @ back)
    told = np.abs(np.log(np.maximum(values, 1e-300))) > math.log(_CHANCE)
    if not told.any():
        return None
    return np.asarray((vectors * np.sqrt(np.where(told, values, 1.0))) @ vectors.T)
