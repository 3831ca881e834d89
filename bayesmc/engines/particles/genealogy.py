"""Families: who descends from whom, and what that says of the error of a particle filter's evidence.

The particles of an earlier slice, its *origin*, are cut into a few groups of neighbours. Ancestors are
sorted, so the descendants of a group are neighbours, too, in every later slice: a family is two positions,
and to follow it costs a search. Families hardly meet (resampling lets a family have about as many particles
as its weight demands), so each is nearly a filter of its own, and what their shares of the weight differ by
says how far the sum of all is off: batch means, over a genealogy.

An origin must be old enough for its errors to have shown, and young enough for many families to be left. So
there are two, and what happens between them is settled by the families of both when the older one is given
up: all that has happened since the older origin, less what has happened since the younger one.

Families tell only what the particles have met. Where a slice rests on a particle or two, where one family is
all that is left, or where families differ by far more than the slices' own weights explain (the particles
that later rows ask for lay at the edge of the now, rows before), the error cannot be told: it is infinite.

References
----------
Chan and Lai (2013), A general theory of particle filters in hidden Markov models, Ann. Statist. 41; Lee and
Whiteley (2018), Variance estimation in the particle filter, Biometrika 105; Olsson and Douc (2019),
Numerically stable online estimation of variance in particle filters, Bernoulli 25. Their families have one
founder, which is right for multinomial resampling; other schemes leave a group its share, so here groups
found families.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from bayesmc.engines.particles.families import LONGEST, OLD, YOUNG, Families
from bayesmc.engines.particles.smc import Layout, Particles

#: families of an origin, and founders of each, at least, where there are particles enough
GROUPS, LEAST = 32, 4
#: slices after which the younger origin takes over at the soonest
SHORTEST = 6
#: slices from one look at the families to the next
STRIDE = 3
#: share of the families that must be left to an origin, by their evenness; below it is given up sooner
LEFT = 0.5
#: equally weighted particles on which a slice must rest for its error to be told
RESTS = 4.0
#: variance of the log evidence between two looks above which it matters where it comes from, at the least and
#: at the most; between, that of so many slices whose weights are worth a single particle
MATTERS, UNEVEN = (0.05, 0.15), 80.0
#: times the variance that the slices' weights explain by themselves, above which the rest came from the edge
EDGE = 4.0
#: families that make up such differences below which these are an accident of one or two
SOME = 2.0
#: share of the particles below which the worth of a slice's has its weights looked at for a tail, and the
#: mean log of the largest of them over the next from which on they have one (Hill's estimate)
FEW, TAIL = 0.05, 0.7
#: share of the largest weight below which none is among the few largest, most often
_SMALL = 1e-3
#: variance above which slices with a tail explain nothing
LONG = 0.2
#: variance between two origins beyond which the families that are left are too few to tell
MOST = 1.0
#: sum of the moves of a mean, in units of its spread, from which on particles seem to be missing
SEEMS = 2.8


def rested(now: Particles) -> Any:
    """Whether a slice rests on particles enough for its error to be told."""
    return now.ess >= rests(len(now.weights))


def rests(particles: int) -> float:
    """Equally weighted particles on which a slice of so many must rest for its error to be told."""
    return min(RESTS, 0.9 * particles)


def level_of(particles: int) -> float:
    """Variance between two looks above which it matters where it comes from."""
    return min(max(UNEVEN / particles, MATTERS[0]), MATTERS[1])


def begun(now: Particles, layout: Layout) -> Families:
    """Families of the particles of the first slice, which were drawn independently."""
    n, lead = layout.particles, layout.lead
    groups = min(GROUPS, max(n // LEAST, 2), n)
    bounds, shares = even_groups(len(now.weights), groups, len(lead))
    return Families(
        np.array(np.broadcast_to(bounds, (2, groups + 1, *lead))),
        np.array(np.broadcast_to(shares, (2, groups, *lead))),
        np.zeros((2, groups, *lead)),
        np.zeros((2, 2, *lead)),
        np.full((2, *lead), now.t),
        np.zeros(lead),
    )


def followed(
    families: Families, earlier: Particles, now: Particles, steady: bool
) -> tuple[Families, Any]:
    """The families one slice later, and the variance of the log evidence that is settled on the way.

    Parameters
    ----------
    families : Families
        In the slice before.
    earlier, now : Particles
        Of the slice before, and of this one.
    steady : bool
        Whether resampling leaves neighbours together the particles that their weight demands, but for one.
    """
    gained: Any = 0.0
    if now.ancestors is not None:
        families = _moved(families, earlier, now, steady)
        some = now.resampled if isinstance(now.resampled, bool) else now.resampled.any()
        if some and now.t % STRIDE == 0:
            families, gained = _looked_at(families, now)
    if now.rejuvenated is not False:
        families, more = _renewed(families, earlier, now)
        gained = gained + more
    return families, gained


def unremarkable(
    families: Families, earlier: Particles, now: Particles
) -> tuple[np.ndarray, np.ndarray] | None:
    """Bounds and what is explained one slice later, where that is all that changes; None elsewhere.

    Of a filter without plates, whose families' weights are what their particles are.
    """
    chosen = now.ancestors
    if chosen is None:
        return families.bounds, families.explained
    bounds = _searched(chosen, families.bounds)
    explained = families.explained + _explained(earlier)
    if now.t % STRIDE == 0:
        n = len(chosen)
        counts = (bounds[:, 1:] - bounds[:, :-1]) / n
        off = counts - families.shares
        if _matters(families, explained, now, counts, off):
            return None
    return bounds, explained


@lru_cache(maxsize=64)
def even_groups(n: int, groups: int, axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups of about as many particles: where they begin and end, and their shares."""
    bounds = np.arange(groups + 1) * n // groups
    tail = (1,) * axes
    found = bounds.reshape(-1, *tail), (np.diff(bounds) / n).reshape(-1, *tail)
    for array in found:
        array.flags.writeable = False
    return found


def evidence_error(families: Families, now: Particles) -> Any:
    """Root mean square error of the log evidence, with its bias of minus half its variance."""
    off = _off(families, _weights(families, now))
    variance = _variance(families, off)
    explained = families.explained + _explained(now)
    at_edge, _ = _at_edge(families, variance, off, explained, len(now.weights))
    total = np.where(at_edge, np.inf, np.maximum(families.settled + variance[OLD], variance[OLD]))
    if families.scouts is not None:
        total = total + families.scouts.share**2
    found = np.sqrt(total + 0.25 * total**2)
    return found if np.ndim(found) else float(found)


def family_sums(values: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Sums of values over the particles of each family.

    Parameters
    ----------
    values : ndarray, shape (rows, numbers, particles)
    bounds : ndarray of int, shape (rows, groups + 1)

    Returns
    -------
    ndarray, shape (rows, numbers, groups)
    """
    rows, numbers, n = values.shape
    starts = bounds[:, None, :-1] + n * np.arange(rows * numbers).reshape(rows, numbers, 1)
    some, flat = bounds[:, 1:] > bounds[:, :-1], values.reshape(-1)
    if some.all():
        return np.add.reduceat(flat, starts.reshape(-1)).reshape(starts.shape)
    found, some = np.zeros(starts.shape), some[:, None].repeat(numbers, axis=1)
    found[some] = np.add.reduceat(flat, starts[some])
    return found


# ---- private ------------------------------------------------------------------------------------


def _moved(families: Families, earlier: Particles, now: Particles, steady: bool) -> Families:
    """The families after resampling."""
    assert now.ancestors is not None
    bounds = _searched(now.ancestors, families.bounds)
    explained = families.explained
    if bounds.ndim > 2:
        explained = explained + np.where(now.resampled, _explained(earlier), 0.0)
    elif now.resampled:
        explained = explained + _explained(earlier)
    if steady:
        return families._replace(bounds=bounds, explained=explained)
    sums = _sums(families, earlier)
    ratio = np.diff(bounds, axis=1) / len(now.ancestors) / (sums / earlier.total)
    extra = np.where((ratio > 0) & np.isfinite(ratio) & now.resampled, np.log(ratio), 0.0)
    return families._replace(bounds=bounds, explained=explained, kept=families.kept - extra)


def _searched(ancestors: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """How many ancestors lie below each bound."""
    if ancestors.ndim == 1:
        return ancestors.searchsorted(bounds)
    n, many = len(ancestors), int(np.prod(ancestors.shape[1:]))
    step = (max(n, int(bounds.max())) + 1) * np.arange(many)
    flat = (ancestors.reshape(n, many) + step).T.reshape(-1)
    found = flat.searchsorted(bounds.reshape(-1, many) + step) - n * np.arange(many)
    return found.reshape(bounds.shape)


def _looked_at(families: Families, now: Particles) -> tuple[Families, Any]:
    """Just after resampling: give up the older origin where few of its families are left, or it is old.

    And the variance that is settled by that.
    """
    n = len(now.weights)
    counts = (families.bounds[:, 1:] - families.bounds[:, :-1]) / n
    if families.kept.any():
        off = _off(families, counts * np.exp(families.kept))
    else:
        off = counts - families.shares
        if off.ndim == 2 and not _matters(families, families.explained, now, counts, off):
            return families, 0.0
    resampled = np.asarray(now.resampled)
    variance = _variance(families, off)
    edge = np.zeros(resampled.shape, dtype=bool)
    if variance.max() > level_of(n):
        at_edge, odd = _at_edge(families, variance, off, families.explained, n)
        if odd.any():
            edge, doubted = resampled & at_edge, np.where(resampled & odd, now.t, families.doubted)
            families = families._replace(doubted=doubted)
    age = now.t - families.born[YOUNG]
    left = _square(families.shares[OLD], 0) / _square(counts[OLD], 0)
    due = resampled & ~edge & ((age > LONGEST) | ((age > SHORTEST) & (left < LEFT)))
    if edge.any():  # what has happened is told once
        families = _begun_again(families, now, edge, True)
    if not due.any():
        return families, np.where(edge, np.inf, 0.0) if edge.any() else 0.0
    lost = np.isinf(variance).any(axis=0)
    gained = np.where(lost, np.inf, variance[OLD] - np.where(lost, 0.0, variance[YOUNG]))
    gained = np.where(edge, np.inf, np.where(due, gained, 0.0))
    return _begun_again(families, now, due, False), gained


def _matters(
    families: Families, explained: np.ndarray, now: Particles, counts: np.ndarray, off: np.ndarray
) -> bool:
    """Whether anything is due, or seems odd, in a filter without plates: the same in Python's numbers."""
    level, age = level_of(len(now.weights)), now.t - int(families.born[YOUNG])
    shares, far = _square(families.shares, 1).tolist(), _square(off, 1).tolist()
    few = shares[OLD] < LEFT * float(counts[OLD].dot(counts[OLD]))
    if age > LONGEST or (age > SHORTEST and few):
        return True
    for even, spread, (every, bounded) in zip(shares, far, explained.tolist(), strict=True):
        left = 1.0 - spread / (1.0 - even) if even < 1.0 else 0.0
        variance = -math.log(left) if left > 1e-9 else math.inf
        if variance > min(max(level, EDGE * every), max(LONG, EDGE * bounded), MOST):
            return True
    return False


def _renewed(families: Families, earlier: Particles, now: Particles) -> tuple[Families, Any]:
    """Where all particles were drawn anew: all that has happened is settled, and how much that is."""
    anew = np.broadcast_to(now.rejuvenated, now.weights.shape[1:])
    gained = _variance(families, _off(families, _weights(families, earlier)))[OLD]
    return _begun_again(families, now, anew, True), np.where(anew, gained, 0.0)


def _begun_again(families: Families, now: Particles, where: np.ndarray, both: bool) -> Families:
    """A new young origin in this slice, the young one in the place of the old one, in some plate elements."""
    groups = families.shares.shape[1]
    fresh: Any = (*even_groups(len(now.weights), groups, now.weights.ndim - 1), 0.0, 0.0, now.t)
    found: list[Any] = []
    for value, new in zip(families[:5], fresh, strict=True):
        begun = np.empty_like(value)
        begun[OLD], begun[YOUNG] = new if both else value[YOUNG], new
        found.append(begun if where.ndim == 0 else np.where(where, begun, value))
    return Families(*found, *families[5:])  # type: ignore[call-arg]


def _weights(families: Families, now: Particles) -> np.ndarray:
    """The families' weights."""
    return _sums(families, now) * np.exp(families.kept)


def _sums(families: Families, now: Particles) -> np.ndarray:
    """Sums of the weights of the particles of each family."""
    shape = families.bounds.shape
    n, elements = len(now.weights), math.prod(shape[2:])
    weights = np.tile(now.weights.reshape(n, elements).T, (2, 1))[:, None]
    bounds = families.bounds.reshape(*shape[:2], elements).swapaxes(1, 2).reshape(-1, shape[1])
    found = family_sums(weights, bounds).reshape(2, elements, -1).swapaxes(1, 2)
    return found.reshape(2, shape[1] - 1, *shape[2:])


def _off(families: Families, weights: np.ndarray) -> np.ndarray:
    """By how much the families' shares of the weight have changed."""
    found: np.ndarray = weights / weights.sum(axis=1)[:, None] - families.shares
    return found


def _variance(families: Families, off: np.ndarray) -> np.ndarray:
    """Variance of the log evidence by what has happened since each origin, shape (2, *apart).

    Shares drift apart like those of families in a population: it is minus the log of what is left of their
    evenness, and infinite where a single family is left.
    """
    even = 1.0 - _square(families.shares, 1)
    left = 1.0 - _square(off, 1) / np.where(even > 0, even, np.nan)
    return np.where(left > 1e-9, -np.log(np.maximum(left, 1e-9)), np.inf)


def _square(values: np.ndarray, axis: int) -> np.ndarray:
    """Sums of squares along an axis."""
    dot: Any = np.vecdot  # its stub knows no axis
    found: np.ndarray = dot(values, values, axis=axis)
    return found


def _explained(now: Particles) -> Any:
    """Variance of the log of the mean weight of a slice, and again, as 0 where they have a tail."""
    n = len(now.weights)
    if isinstance(now.ess, float) and now.ess >= FEW * n:
        return 1.0 / now.ess - 1.0 / n  # an array of two would cost more than it says
    ess = np.asarray(now.ess)
    variance = 1.0 / ess - 1.0 / n
    weights, bounded = now.weights.reshape(n, -1), np.array(variance, ndmin=1).reshape(-1)
    for at in np.flatnonzero(ess < FEW * n):
        if _has_tail(weights[:, at], max(int(ess.reshape(-1)[at]), 5)):
            bounded[at] = 0.0
    return np.array([variance, bounded.reshape(variance.shape)])


def _has_tail(weights: np.ndarray, count: int) -> bool:
    """Whether the few weights that a slice is worth fall off slowly."""
    some = weights[weights > weights.max() * _SMALL]  # fewer are put in order faster
    some = some if len(some) > count else weights
    top = np.partition(some, max(len(some) - count - 1, 0))[-count - 1 :]
    least = np.maximum(top.min(), 1e-300)  # fewer have any weight
    return bool(np.log(np.maximum(top, least) / least).sum() > TAIL * count)


def _at_edge(
    families: Families, variance: np.ndarray, off: np.ndarray, explained: np.ndarray, n: int
) -> tuple[Any, Any]:
    """Whether families differ by far more than the slices' weights explain, and whether some seem to.

    Many of them must where rows do not pull the same way: a few are an accident.
    """
    every, bounded = explained[:, 0], explained[:, 1]
    odd = (variance > level_of(n)) & (variance > EDGE * every)
    odd |= (variance > LONG) & (variance > EDGE * bounded)
    far = variance > MOST
    either = (odd | far).any(axis=0)
    if families.drift is None or not odd.any():
        return either, either
    squares = off**2
    by = squares.sum(axis=1) ** 2 / np.maximum((squares**2).sum(axis=1), 1e-300)
    some = np.where(families.drift.worst < SEEMS, SOME, np.inf)
    return ((odd & (by < some)) | far).any(axis=0), either
