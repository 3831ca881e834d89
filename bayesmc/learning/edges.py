"""Estimates at the edge of their support: whether they are a maximum there, and what is held for the others.

A noise of 0 or a probability of 1 is a maximum where the likelihood does not fall towards the edge, and falls
away from it. There is no curvature in such a number; the others have theirs with it held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from bayesmc.distributions.transforms import Bounded, StickBreaking
from bayesmc.learning.climbing import Maximum, climbed_on, newton_step, polished
from bayesmc.learning.objectives import Objective
from bayesmc.learning.unknowns import Unknown, Unknowns

#: information of a number's logarithm above which it lies at no edge; a probability above which none is at 0
_CURVED, _NEAR = 0.05, 1e-3
#: by how much its logarithm is moved to the edge, and the nearest that it comes
_OUTWARDS, _NEAREST = 7.0, 40.0
#: nats by which the objective may fall there (times its size), and may rise
_LEVEL, _RISES = 1e-7, 1e-3
#: how far away from the edge a fall is sought, in steps of the logarithm, so many at once
_INWARDS, _AT_ONCE = 48, 8
#: a fall that is one; what is seen of it before, and how often: where numbers merely end it is steep at once
_FALL, _SEEN, _GRADUAL, _OFTEN = 0.1, 1e-5, 0.5, 2
#: what must be left of it where the others are free to follow, and a rise after which climbing goes on
_LEFT, _HIGHER = 1e-4, 1e-4
#: how often climbing goes on, and steps that others make to follow
_AGAIN, _FOLLOWS = 3, 25


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge of the support that a number lies next to.

    Attributes
    ----------
    part : Unknown
    label : int
        The number's place among all numbers of the values.
    place : int
        Its own unconstrained number; of shares, which add up to 1, the first one of their row.
    side : float
        Where the edge is along an unconstrained number: -1 or 1.
    component : int or None
        Of shares: which one is 0.
    """

    part: Unknown
    label: int
    place: int
    side: float = -1.0
    component: int | None = None

    def moved(self, u: np.ndarray, by: float) -> np.ndarray:
        """Unconstrained numbers with this one nearer to the edge by a factor ``exp(by)``."""
        new = u.copy()
        if self.component is None:
            out = self.side * u[self.place] + by
            new[self.place] = self.side * (min(out, _NEAREST) if by > 0 else out)
            return new
        row = self._row(u)
        shares = self.part.transform.constrain(u[row])
        share = shares[self.component]
        out = special.logit(share) - by
        wanted = special.expit(max(out, -_NEAREST) if by > 0 else out)
        shares = shares * (1.0 - wanted) / (1.0 - share)
        shares[self.component] = wanted
        new[row] = self.part.transform.unconstrain(shares)
        return new

    def _row(self, u: np.ndarray) -> slice:
        return slice(self.place, self.place + self.part.transform.unconstrained_shape[0])


@dataclass(frozen=True, eq=False)
class Settled:
    """A maximum, and the numbers in it that lie at an edge.

    Attributes
    ----------
    found : Maximum
        Of the numbers that are free, ``found.u`` among them.
    u : ndarray
        All numbers.
    objective : Objective
        Of the free numbers.
    free : ndarray of bool
    labels : ndarray of int
        Places of values at their edge.
    untold : list of ndarray
        Places of numbers in ``u`` that end at an edge, and are not told.
    """

    found: Maximum
    u: np.ndarray
    objective: Objective
    free: np.ndarray
    labels: np.ndarray
    untold: list[np.ndarray]


class Face:
    """An objective with some numbers held."""

    def __init__(self, objective: Objective, u: np.ndarray, free: np.ndarray) -> None:
        self.objective, self.u, self.free = objective, u, free
        self.size = int(free.sum())

    def whole(self, v: np.ndarray) -> np.ndarray:
        """All numbers, from those that are free."""
        u = self.u.copy()
        u[self.free] = v
        return u

    def value(self, v: np.ndarray) -> float:
        return self.objective.value(self.whole(v))

    def gradient(self, v: np.ndarray) -> np.ndarray:
        return self.objective.gradient(self.whole(v))[self.free]


def settled(
    objective: Objective, unknowns: Unknowns, found: Maximum, tolerance: float, most: int
) -> Settled:
    """What of an end of climbs lies at edges; where one is no maximum climbing goes on from within."""
    for again in range(_AGAIN + 1):
        result, higher = _settled(objective, unknowns, found)
        if higher is None or again == _AGAIN:
            break
        found = climbed_on(objective, found, higher, tolerance, most)
    return result


def bounded(unknowns: Unknowns) -> np.ndarray:
    """Whether unconstrained numbers far below and far above are next to an edge, shape ``(size, 2)``."""
    found = np.zeros((unknowns.size, 2), bool)
    for p in unknowns.parts:
        if isinstance(p.transform, StickBreaking):
            found[p.start : p.stop] = True
        elif isinstance(p.transform, Bounded):
            low, high = _bounds(p)
            found[p.start : p.stop] = np.stack([low | high, low & high], axis=1)
    return found


# ---- private ------------------------------------------------------------------------------------


def _settled(
    objective: Objective, unknowns: Unknowns, found: Maximum
) -> tuple[Settled, np.ndarray | None]:
    """The same, and a higher point where there is one."""
    u, height = found.u, found.value
    slack = _LEVEL * (1.0 + abs(height))
    edges: list[Edge] = []
    for edge in _candidates(unknowns, found):
        out = edge.moved(u, _OUTWARDS)
        (new,) = _heights(objective, [out])
        if height - _FALL < new < height - slack:  # which it may not, where another makes up for it
            others = _free(unknowns, [*edges, edge], len(u))
            face = Face(objective, out, others)
            v, new = _followed(face, out[others], new, found.hessian[np.ix_(others, others)])
            out = face.whole(v)
        if height - slack <= new <= height + _RISES:
            u, height = out, float(new)
            edges.append(edge)
    if not edges:
        free, none = np.ones(len(u), bool), np.zeros(0, int)
        return Settled(found, u, objective, free, none, []), None
    free = _free(unknowns, edges, len(u))
    face = Face(objective, u, free)
    best = polished(face, replace(found, u=u[free], value=height))
    u = face.whole(best.u)
    labels, untold = [], []
    for edge in edges:
        told, higher = _told(objective, edge, u, free, best)
        if higher is not None:
            return Settled(best, u, face, free, np.zeros(0, int), []), higher
        if told is None:
            labels.append(edge.label)
        else:
            untold.append(told)
    at_edge = _with_ones(unknowns, edges, labels)
    return Settled(best, u, face, free, at_edge, _apart(untold)), None


def _candidates(unknowns: Unknowns, found: Maximum) -> list[Edge]:
    """Edges next to which numbers may lie."""
    own = -np.diagonal(found.hessian)
    edges, first = [], 0
    for p in unknowns.parts:
        count = int(np.prod(p.node.value_shape, dtype=int))
        if isinstance(p.transform, Bounded):
            low, high = _bounds(p)
            for k in range(count):
                at = p.start + k
                if (low[k] or high[k]) and not own[at] >= _CURVED:
                    both = low[k] and high[k]
                    edges.append(Edge(p, first + k, at, 1.0 if both and found.u[at] > 0 else -1.0))
        elif isinstance(p.transform, StickBreaking):
            (size,) = p.transform.event_shape
            shares = p.transform.constrain(found.u[p.start : p.stop].reshape(p.shape))
            for row, values in enumerate(shares.reshape(-1, size)):
                place = p.start + row * (size - 1)
                edges += [
                    Edge(p, first + row * size + k, place, component=k)
                    for k in map(int, np.flatnonzero(values < _NEAR))
                ]
        first += count
    return edges


def _bounds(part: Unknown) -> tuple[np.ndarray, np.ndarray]:
    """Whether each number has a lower and an upper bound."""
    assert isinstance(part.transform, Bounded)
    low, high = (
        np.broadcast_to(np.isfinite(b), part.shape).ravel()
        for b in (part.transform.low, part.transform.high)
    )
    return low, high


def _free(unknowns: Unknowns, edges: Sequence[Edge], size: int) -> np.ndarray:
    """Which unconstrained numbers are left where some values are held at their edge."""
    free = np.ones(size, bool)
    rows: dict[int, list[int]] = {}
    for edge in edges:
        if edge.component is None:
            free[edge.place] = False
        else:
            rows.setdefault(edge.place, []).append(edge.component)
    sizes = {edge.place: edge.part.transform.event_shape for edge in edges}
    for place, gone in rows.items():
        (count,) = sizes[place]
        last = max(k for k in range(count) if k not in gone)  # which takes all that is left
        for k in range(count - 1):
            free[place + k] = k not in gone and k < last
    return free


def _told(
    objective: Objective, edge: Edge, u: np.ndarray, free: np.ndarray, best: Maximum
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """What is not told where a number lies at an edge, None where it is told; a higher point, if any."""
    own = np.array([edge.place if edge.component is None else _own_number(edge, u)])
    noise = 1e-9 * abs(best.value)
    gradual, at, fall = 0, None, 0.0
    for start in range(1, _INWARDS, _AT_ONCE):
        points = [edge.moved(u, -float(k)) for k in range(start, start + _AT_ONCE)]
        heights = _heights(objective, points)
        for point, height in zip(points, heights, strict=True):
            if not np.isfinite(height):
                return own, None
            fall = best.value - height
            if fall < -_HIGHER - noise:
                return None, points[int(np.argmax(heights))]
            gradual += _SEEN + noise < fall < _GRADUAL
            if fall > _FALL:
                at = point
                break
        if at is not None:
            break
    if at is None or gradual < _OFTEN:
        return own, None
    end, height = _followed(Face(objective, at, free), at[free], best.value - fall, best.hessian)
    if height > best.value + _HIGHER + noise:
        return None, Face(objective, at, free).whole(end)
    if best.value - height > _LEFT * fall:
        return None, None
    shift = np.abs(end - best.u)
    with_it = np.flatnonzero(free)[shift > 0.1 * shift.max(initial=0.0)]
    return np.sort(np.append(own, with_it)), None


def _followed(
    face: Face, v: np.ndarray, height: float, hessian: np.ndarray
) -> tuple[np.ndarray, float]:
    """Where the other numbers go when one is moved away from its edge, and how high that is."""
    for _ in range(_FOLLOWS):
        if not face.size:
            break
        _, step = newton_step(face.gradient(v), hessian)
        for scale in (1.0, 0.25, 0.0625):
            new = face.value(v + scale * step)
            if new > height:
                break
        if not new > height + 1e-7:
            break
        v, height = v + scale * step, new
    return v, height


def _own_number(edge: Edge, u: np.ndarray) -> int:
    """Which unconstrained number a share that is 0 stands by."""
    assert edge.component is not None
    return edge.place + min(edge.component, edge.part.transform.unconstrained_shape[0] - 1)


def _with_ones(unknowns: Unknowns, edges: Sequence[Edge], labels: list[int]) -> np.ndarray:
    """Places of values at their edge, with shares that are 1, since all others of their row are 0."""
    found = set(labels)
    for place in {e.place for e in edges if e.component is not None}:
        row = [e for e in edges if e.place == place and e.component is not None]
        (size,) = row[0].part.transform.event_shape
        if len(row) == size - 1 and all(e.label in found for e in row):
            assert row[0].component is not None
            first = row[0].label - row[0].component
            found |= set(range(first, first + size))
    return np.array(sorted(found), dtype=int)


def _apart(groups: list[np.ndarray]) -> list[np.ndarray]:
    """Groups once each."""
    return [np.array(g) for g in dict.fromkeys(tuple(map(int, group)) for group in groups)]


def _heights(objective: Objective, points: list[np.ndarray]) -> np.ndarray:
    several = getattr(objective, "values", None)
    if several is not None:
        return np.asarray(several(np.array(points)))
    return np.array([objective.value(u) for u in points])
