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
that later rows ask for lay at the edge of the cloud, rows before), the error cannot be told: it is infinite.

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
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.particles.cloud import Cloud
from bayesmc.engines.particles.drift import SEEMS, Compass, Drift
from bayesmc.engines.particles.forgetting import Lost, Sight
from bayesmc.engines.particles.scouts import Scouts

#: families of an origin, and founders of each, at least, where there are particles enough
GROUPS, LEAST = 32, 4
#: slices after which the younger origin takes over, at the latest and at the soonest
LONGEST, SHORTEST = 50, 6
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
#: variance above which slices with a tail explain nothing
LONG = 0.2
#: variance between two origins beyond which the families that are left are too few to tell
MOST = 1.0

#: share of the belief in states without particles, over that of all particles, up to which it is an error
LEFT_OUT = 0.1

OLD, YOUNG = 0, 1


class Families(NamedTuple):
    """Families of an old and a young origin, as they stand in the present slice.

    Attributes
    ----------
    bounds : ndarray of int, shape (2, groups + 1, *apart)
        Positions between which each family's particles lie.
    shares : ndarray, shape (2, groups, *apart)
        Their shares of the weight at the origin.
    kept : ndarray, shape (2, groups, *apart)
        Logs of what a family's weight is worth: where resampling gave it more particles than its weight
        demands, it counts for less.
    explained : ndarray, shape (2, 2, *apart)
        Variance of the log evidence that the weights of the slices since would make by themselves: of all
        slices, and of those whose weights have no tail.
    born : ndarray of int, shape (2, *apart)
        Slices of the origins.
    settled : ndarray, shape (*apart,)
        Variance of the log evidence up to the old origin.
    lost : Lost or None
        What the filter has lost sight of.
    scouts : Scouts or None
        Where states have no particle: what the rows make of these.
    drift : Drift or None
        Whether rows pull the particles the same way; None where particles are not drawn from the model.
    doubted : int or ndarray of int, shape (*apart)
        The last slice in which families differed by more than weights explain, if many did.
    """

    bounds: np.ndarray
    shares: np.ndarray
    kept: np.ndarray
    explained: np.ndarray
    born: np.ndarray
    settled: Any
    lost: Lost | None = None
    scouts: Scouts | None = None
    drift: Drift | None = None
    doubted: Any = -LONGEST


def begun(cloud: Cloud, sight: Sight) -> Families:
    """Families of the particles of the first slice, which were drawn independently."""
    n, lead = sight.layout.particles, sight.layout.lead
    groups = min(GROUPS, max(n // LEAST, 2), n)
    bounds, shares = _even(len(cloud.weights), groups, len(lead))
    rested = np.asarray(cloud.ess) >= min(RESTS, 0.9 * len(cloud.weights))
    return Families(
        np.array(np.broadcast_to(bounds, (2, groups + 1, *lead))),
        np.array(np.broadcast_to(shares, (2, groups, *lead))),
        np.zeros((2, groups, *lead)),
        np.zeros((2, 2, *lead)),
        np.full((2, *lead), cloud.t),
        np.where(rested, 0.0, np.inf),
        sight.after(None, ~rested, cloud),
    )


def followed(
    families: Families, earlier: Cloud, cloud: Cloud, steady: bool, sight: Sight
) -> Families:
    """The families one slice later.

    Parameters
    ----------
    families : Families
        In the slice before.
    earlier, cloud : Cloud
        The slice before, and this one.
    steady : bool
        Whether resampling leaves neighbours together the particles that their weight demands, but for one.
    sight : Sight
    """
    gained: Any
    if cloud.weights.ndim == 1 and steady and cloud.rejuvenated is False:
        found, gained = _followed_alone(families, earlier, cloud)
        if gained == 0.0 and families.lost is None:
            return found
        now = gained == math.inf
    else:
        found = _followed(families._replace(settled=np.zeros(())), earlier, cloud, steady)
        gained = found.settled
        now = np.isinf(gained)
    lost = sight.after(families.lost, now, cloud)
    return found._replace(settled=families.settled + gained, lost=lost)


def drifted(
    families: Families, compass: Compass, earlier: Cloud | None, cloud: Cloud, sight: Sight
) -> Families:
    """The families, where particles are missing if rows go on pulling the same way."""
    drift = compass.after(families.drift, earlier, cloud)
    families = families._replace(drift=drift)
    if drift is None:
        return families
    if not (drift.worst if isinstance(drift.worst, float) else drift.worst.max()) > SEEMS:
        return families
    worst = np.reshape(drift.worst, sight.layout.lead)
    doubted = families.doubted > cloud.t - LONGEST
    missing = (worst > compass.limit) | ((worst > SEEMS) & doubted)
    if not missing.any():
        return families
    lost = sight.after(families.lost, missing, cloud, here=True)
    return families._replace(settled=np.where(missing, np.inf, families.settled), lost=lost)


def scouted(families: Families, scouts: Scouts | None, cloud: Cloud, sight: Sight) -> Families:
    """The families, where scouts have been to states that no particle has.

    What the particles leave out is lost where it is no longer small.
    """
    if scouts is None and families.scouts is None:
        return families
    families = families._replace(scouts=scouts)
    if scouts is None or scouts.share <= LEFT_OUT:
        return families
    lost = sight.after(families.lost, True, cloud, here=True)
    return families._replace(settled=np.asarray(np.inf), lost=lost)


def evidence_error(families: Families, cloud: Cloud) -> Any:
    """Root mean square error of the log evidence, with its bias of minus half its variance."""
    off = _off(families, _weights(families, cloud))
    variance = _variance(families, off)
    explained = families.explained + _explained(cloud)
    at_edge = _at_edge(variance, explained, _even_handed(off), _some(families), len(cloud.weights))
    total = np.where(at_edge, np.inf, np.maximum(families.settled + variance[OLD], variance[OLD]))
    if families.scouts is not None:
        total = total + families.scouts.share**2
    found = np.sqrt(total + 0.25 * total**2)
    return found if np.ndim(found) else float(found)


def group_sums(values: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Sums over the particles of each family, shape ``(groups, *apart)``.

    Values have the particles first, then the plates apart, whose axes the bounds have after their first.
    """
    if bounds.ndim == 1:
        return _sums(values, bounds)
    many = int(np.prod(bounds.shape[1:]))
    found = row_sums(values.reshape(len(values), many).T, bounds.reshape(len(bounds), many))
    return found.T.reshape(len(bounds) - 1, *bounds.shape[1:])


def row_sums(values: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Sums of values ``(rows, particles, *rest)`` over families ``(groups + 1, rows)``, rows first."""
    many, n = values.shape[:2]
    if many == 1:
        return _sums(values[0], bounds[:, 0])[None]
    starts = bounds.T + n * np.arange(many)[:, None]
    flat = np.append(starts[:, :-1].reshape(-1), n * many)
    found = _sums(values.reshape(n * many, *values.shape[2:]), flat)
    return found.reshape(many, len(bounds) - 1, *values.shape[2:])


# ---- private ------------------------------------------------------------------------------------


def _followed(families: Families, earlier: Cloud, cloud: Cloud, steady: bool) -> Families:
    """The families one slice later, where nothing was settled so far."""
    poor = cloud.ess < min(RESTS, 0.9 * len(cloud.weights))
    if np.any(poor):
        families = families._replace(settled=np.where(poor, np.inf, families.settled))
    if cloud.ancestors is not None:
        families = _moved(families, earlier, cloud, steady)
        if cloud.t % STRIDE == 0:
            families = _looked_at(families, cloud)
    if cloud.rejuvenated is not False:
        families = _renewed(families, earlier, cloud)
    return families


def _sums(values: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    some = bounds[1:] > bounds[:-1]
    if some.all():
        return np.add.reduceat(values, bounds[:-1], axis=0)
    found = np.zeros((len(bounds) - 1, *values.shape[1:]))
    found[some] = np.add.reduceat(values, bounds[:-1][some], axis=0)
    return found


#: the only element of a filter by itself
_HERE = np.asarray(True)


@lru_cache(maxsize=64)
def _even(n: int, groups: int, axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups of about as many particles: where they begin and end, and their shares."""
    bounds = np.arange(groups + 1) * n // groups
    tail = (1,) * axes
    found = bounds.reshape(-1, *tail), (np.diff(bounds) / n).reshape(-1, *tail)
    for array in found:
        array.flags.writeable = False
    return found


def _followed_alone(families: Families, earlier: Cloud, cloud: Cloud) -> tuple[Families, float]:
    """The same of one filter whose families have the particles that they should, in few calls of NumPy.

    And the variance that is settled in this slice.
    """
    n = len(cloud.weights)
    gained = math.inf if cloud.ess < min(RESTS, 0.9 * n) else 0.0
    if cloud.ancestors is None:
        return families, gained
    bounds, shares, explained = families.bounds, families.shares, families.explained
    bounds = cloud.ancestors.searchsorted(bounds)
    if cloud.resampled:
        explained = explained + _explained(earlier)
    found = families._replace(bounds=bounds, explained=explained)
    if cloud.t % STRIDE or not cloud.resampled:
        return found, gained
    counts = (bounds[:, 1:] - bounds[:, :-1]) * (1.0 / n)
    off = counts - shares
    even = [float(s.dot(s)) for s in shares]
    variance = [_drifted(float(o.dot(o)), e) for o, e in zip(off, even, strict=True)]
    old, young = explained.tolist()
    some = _some(families)
    if _odd(variance[OLD], old[0], old[1], off[OLD], some, n) or _odd(
        variance[YOUNG], young[0], young[1], off[YOUNG], some, n
    ):
        return _begun_again(found, cloud, _HERE, found.settled, True), math.inf
    if _odd(variance[OLD], old[0], old[1], off[OLD], math.inf, n):
        found = found._replace(doubted=cloud.t)
    age = cloud.t - int(families.born[YOUNG])
    few = even[OLD] < LEFT * float(counts[OLD].dot(counts[OLD]))
    if age <= LONGEST and not (age > SHORTEST and few):
        return found, gained
    lost = math.inf in variance
    gained += math.inf if lost else variance[OLD] - variance[YOUNG]
    return _begun_again(found, cloud, _HERE, found.settled, False), gained


def _moved(families: Families, earlier: Cloud, cloud: Cloud, steady: bool) -> Families:
    """The families after resampling."""
    assert cloud.ancestors is not None
    bounds = _searched(cloud.ancestors, families.bounds)
    explained = families.explained
    if bounds.ndim > 2:
        explained = explained + np.where(cloud.resampled, _explained(earlier), 0.0)
    elif cloud.resampled:
        explained = explained + _explained(earlier)
    if steady:
        return families._replace(bounds=bounds, explained=explained)
    sums = [group_sums(earlier.weights, b) for b in families.bounds]
    ratio = np.diff(bounds, axis=1) / len(cloud.ancestors) / (np.stack(sums) / earlier.total)
    extra = np.where((ratio > 0) & np.isfinite(ratio) & cloud.resampled, np.log(ratio), 0.0)
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


def _looked_at(families: Families, cloud: Cloud) -> Families:
    """Just after resampling: give up the older origin where few of its families are left, or it is old."""
    n, resampled = len(cloud.weights), np.asarray(cloud.resampled)
    counts = (families.bounds[:, 1:] - families.bounds[:, :-1]) / n
    if not families.kept.any() and not _matters(families, cloud, counts):
        return families
    off = _off(families, counts * np.exp(families.kept))
    variance = _variance(families, off)
    by, some = _even_handed(off), _some(families)
    edge = resampled & _at_edge(variance, families.explained, by, some, n)
    doubted = resampled & _at_edge(variance, families.explained, by, math.inf, n)
    families = families._replace(doubted=np.where(doubted, cloud.t, families.doubted))
    age = cloud.t - families.born[YOUNG]
    left = (families.shares[OLD] ** 2).sum(axis=0) / (counts[OLD] ** 2).sum(axis=0)
    due = resampled & ((age > LONGEST) | ((age > SHORTEST) & (left < LEFT)))
    settled = np.where(edge, np.inf, families.settled)
    if edge.any():  # what has happened is told once
        families, due = _begun_again(families, cloud, edge, settled, True), due & ~edge
    if not due.any():
        return families
    lost = np.isinf(variance).any(axis=0)
    gained = np.where(lost, np.inf, variance[OLD] - np.where(lost, 0.0, variance[YOUNG]))
    return _begun_again(families, cloud, due, settled + np.where(due, gained, 0.0), False)


def _matters(families: Families, cloud: Cloud, counts: np.ndarray) -> bool:
    """Whether anything can be due: the older origin has drifted far, or the younger one is old."""
    spread = ((counts - families.shares) ** 2).sum(axis=1).max()
    groups = counts.shape[1]
    bound = min(_level(len(cloud.weights)), (1.0 / LEFT - 1.0) / groups)
    return bool(spread > 0.9 * bound or (cloud.t - families.born[YOUNG]).max() > LONGEST)


def _renewed(families: Families, earlier: Cloud, cloud: Cloud) -> Families:
    """Where all particles were drawn anew: all that has happened is settled."""
    anew = np.broadcast_to(cloud.rejuvenated, cloud.weights.shape[1:])
    gained = _variance(families, _off(families, _weights(families, earlier)))[OLD]
    settled = families.settled + np.where(anew, gained, 0.0)
    return _begun_again(families, cloud, anew, settled, True)


def _begun_again(
    families: Families, cloud: Cloud, where: np.ndarray, settled: np.ndarray, both: bool
) -> Families:
    """A new young origin in this slice, the young one in the place of the old one, in some plate elements."""
    groups = families.shares.shape[1]
    bounds, shares = _even(len(cloud.weights), groups, cloud.weights.ndim - 1)
    fresh: tuple[Any, ...] = (bounds, shares, 0.0, 0.0, cloud.t)
    found: list[np.ndarray] = []
    if cloud.weights.ndim == 1:
        for value, new in zip(families[:5], fresh, strict=True):
            found.append(np.empty_like(value))
            found[-1][OLD], found[-1][YOUNG] = new if both else value[YOUNG], new
        return _renamed(families, found, settled)
    for value, new in zip(families[:5], fresh, strict=True):
        young = np.broadcast_to(new, value[YOUNG].shape)
        old = young if both else value[YOUNG]
        found.append(np.where(where, np.stack([old, young]), value))
    return _renamed(families, found, settled)


def _renamed(families: Families, found: Sequence[np.ndarray], settled: Any) -> Families:
    bounds, shares, kept, explained, born = found
    return families._replace(
        bounds=bounds, shares=shares, kept=kept, explained=explained, born=born, settled=settled
    )


def _weights(families: Families, cloud: Cloud) -> np.ndarray:
    """The families' weights."""
    sums = np.stack([group_sums(cloud.weights, b) for b in families.bounds])
    return sums * np.exp(families.kept)


def _off(families: Families, weights: np.ndarray) -> np.ndarray:
    """By how much the families' shares of the weight have changed."""
    found: np.ndarray = weights / weights.sum(axis=1)[:, None] - families.shares
    return found


def _variance(families: Families, off: np.ndarray) -> np.ndarray:
    """Variance of the log evidence by what has happened since each origin, shape (2, *apart).

    Shares drift apart like those of families in a population: it is minus the log of what is left of their
    evenness, and infinite where a single family is left.
    """
    even = 1.0 - (families.shares**2).sum(axis=1)
    left = 1.0 - (off**2).sum(axis=1) / np.where(even > 0, even, np.nan)
    return np.where(left > 1e-9, -np.log(np.maximum(left, 1e-9)), np.inf)


def _even_handed(off: np.ndarray) -> np.ndarray:
    """How many families make up the differences between them, shape (2, *apart)."""
    squares = off**2
    found: np.ndarray = squares.sum(axis=1) ** 2 / np.maximum((squares**2).sum(axis=1), 1e-300)
    return found


def _explained(cloud: Cloud) -> Any:
    """Variance of the log of the mean weight of a slice, and again, as 0 where they have a tail."""
    n = len(cloud.weights)
    if isinstance(cloud.ess, float) and cloud.ess >= FEW * n:
        return 1.0 / cloud.ess - 1.0 / n  # an array of two would cost more than it says
    ess = np.asarray(cloud.ess)
    variance = 1.0 / ess - 1.0 / n
    few = ess < FEW * n
    if not few.any():
        return np.stack([variance, variance])
    weights = cloud.weights.reshape(n, -1)
    bounded = np.array(variance, ndmin=1).reshape(-1)
    for at in np.flatnonzero(few):
        count = max(int(ess.reshape(-1)[at]), 5)
        top = np.partition(weights[:, at], max(n - count - 1, 0))[-count - 1 :]
        least = np.maximum(top.min(), 1e-300)  # fewer have any weight
        if np.log(np.maximum(top, least) / least).sum() > TAIL * count:
            bounded[at] = 0.0
    return np.stack([variance, bounded.reshape(variance.shape)])


def _some(families: Families) -> Any:
    """How many families must make up the differences: all of them where rows pull the same way."""
    drift = families.drift
    if drift is None:
        return math.inf
    if isinstance(drift.worst, float):
        return SOME if drift.worst < SEEMS else math.inf
    return np.where(drift.worst < SEEMS, SOME, np.inf).reshape(families.shares.shape[2:])


def _at_edge(
    variance: np.ndarray, explained: np.ndarray, by: np.ndarray, some: Any, n: int
) -> np.ndarray:
    """Whether families differ by far more than the slices' weights explain."""
    odd: np.ndarray = np.any(
        _beyond(variance, explained[:, 0], explained[:, 1], by, some, n), axis=0
    )
    return odd


def _beyond(variance: Any, every: Any, bounded: Any, by: Any, some: Any, n: int) -> Any:
    """The same, of numbers or arrays, given how many families make up the differences."""
    odd = (variance > _level(n)) & (variance > EDGE * every)
    odd |= (variance > LONG) & (variance > EDGE * bounded)
    return (odd & (by < some)) | (variance > MOST)


def _odd(
    variance: float, every: float, bounded: float, off: np.ndarray, some: float, n: int
) -> bool:
    """The same of one origin of one filter."""
    if variance <= MOST and not _beyond(variance, every, bounded, 0.0, some, n):
        return False
    return bool(_beyond(variance, every, bounded, _even_handed(off[None])[0], some, n))


def _drifted(spread: float, even: float) -> float:
    """``_variance`` of one origin, by the squared distance of its shares from where they were."""
    left = 1.0 - spread / (1.0 - even) if even < 1.0 else 0.0
    return -math.log(left) if left > 1e-9 else math.inf


def _level(n: int) -> float:
    """Variance between two looks above which it matters where it comes from."""
    return min(max(UNEVEN / n, MATTERS[0]), MATTERS[1])
