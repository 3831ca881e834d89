"""A start for chains where draws find none: free numbers moved until every term is finite.

First the number of elements with density zero goes down, then the log density up; nothing here needs to be
exact, since a start is only a start. Hidden numbers count by their free numbers, and in comparison with the
middle of their distribution: a density itself grows without end where a scale and all that it scales shrink.

References
----------
Stan Reference Manual, version 2.36, section "Initialization": free numbers between -2 and 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.transforms import transform_of
from bayesmc.errors import BayesmcError, DensityError, ParameterError
from bayesmc.network import CompiledNode
from bayesmc.network.probing import middle_of
from bayesmc.structure.target import Target, Term, Values

#: numbers that the largest term may have, over all rows that are evaluated at once
MOST_NUMBERS = 1 << 20
#: candidates of each row in one round
_CANDIDATES = 16
#: rounds until a start is found, and rounds that go on from there
_ROUNDS, _POLISH = 400, 40
#: free numbers are kept within
_FREE = 30.0


@dataclass(frozen=True, eq=False)
class Scores:
    """How good some states are.

    Attributes
    ----------
    lost : ndarray, shape (rows,)
        Elements of terms with density zero.
    far : ndarray, shape (rows,)
        How far these are from the supports that leave them out, in logs.
    log : ndarray, shape (rows,)
        Sum of all others.
    """

    lost: np.ndarray
    far: np.ndarray
    log: np.ndarray

    def best_of(self, k: int) -> np.ndarray:
        """The rows that are the best of ``k`` consecutive ones."""
        columns = [c.reshape(-1, k) for c in (-self.log, self.far, self.lost)]
        order = np.lexsort(columns, axis=1)[:, 0]
        return np.arange(len(order)) * k + order

    def at(self, rows: np.ndarray) -> Scores:
        return Scores(self.lost[rows], self.far[rows], self.log[rows])

    def where(self, better: np.ndarray, other: Scores) -> Scores:
        """These scores where ``better``, else the others."""
        return Scores(
            np.where(better, self.lost, other.lost),
            np.where(better, self.far, other.far),
            np.where(better, self.log, other.log),
        )

    def better_than(self, other: Scores) -> np.ndarray:
        fewer, nearer = self.lost < other.lost, self.far < other.far
        equal, as_near = self.lost == other.lost, self.far == other.far
        return fewer | (equal & (nearer | (as_near & (self.log > other.log))))


def row_logs(term: Term, values: Values, rows: int) -> np.ndarray:
    """A term's log factors, shape ``(rows, *term shape)``; minus infinity where it cannot be evaluated."""
    try:
        log = np.asarray(term.log(values))
        lead = log.shape[: log.ndim - len(term.shape)]
        log = np.broadcast_to(log, lead + term.shape)
        log = np.broadcast_to(log, (rows, *term.shape))
        return np.where(np.isnan(log), -np.inf, log)
    except (DensityError, ParameterError):
        if rows == 1:
            return np.full((1, *term.shape), -np.inf)
    half = rows // 2
    parts = ((slice(0, half), half), (slice(half, rows), rows - half))
    halves = [row_logs(term, _rows(term, values, at), count) for at, count in parts]
    return np.concatenate(halves)


def data_logs(target: Target, values: Values, rows: int) -> np.ndarray:
    """Log densities of the data, shape ``(rows,)``: of what is seen, if only in part, and of potentials.

    Potentials of finite nodes alone are like a prior of these, and left out.
    """
    found, model = np.zeros(rows), target.model
    for term in target.terms.values():
        if term.is_potential:
            is_told = any(model[n].domain is None for n in target.hidden_above(term))
        else:
            is_told = term.name not in target.chain or target.seen(term.name) is not None
        if is_told:
            found += row_logs(term, values, rows).reshape(rows, -1).sum(axis=1)
    return found


def largest_term(target: Target) -> int:
    """Numbers of the largest value or term of one row."""
    values = [math.prod(target.model[n].value_shape) for n in (*target.chain, *target.links)]
    terms = []
    for term in target.terms.values():
        event = () if term.is_potential else target.model[term.name].event_shape
        terms.append(math.prod(term.shape) * max(math.prod(event), 1))
    return max([1, *values, *terms])


class Climb:
    """States of some chains on their free scale, moved uphill.

    Parameters
    ----------
    target : Target
    given : dict
        Stored values of nodes that stay, shape ``(rows, *plates, *event)``.
    rows : int
    rng : Generator
    draw : callable
        From a number of rows to forward draws of all nodes.
    """

    def __init__(
        self,
        target: Target,
        given: Values,
        rows: int,
        rng: np.random.Generator,
        draw: Callable[[int], Values],
    ) -> None:
        self.target, self.given, self.rows, self.rng, self.draw = target, given, rows, rng, draw
        self.moving = [n for n in target.chain if n not in given]
        room = MOST_NUMBERS // (largest_term(target) * rows)
        self.candidates = int(np.clip(room, 2, _CANDIDATES))
        #: node -> free numbers; of finite nodes and others without a free scale their values
        self.free: Values = {}
        self.is_free: dict[str, bool] = {}
        self.values: Values = {}

    def climbed(self) -> tuple[Values, Scores]:
        """The states found, and how good they are."""
        best = self._begun()
        polish = 0
        for _ in range(_ROUNDS):
            best = self._round(best)
            polish += bool((best.lost == 0).all())
            if polish > _POLISH:
                break
        return self.values, best

    # ---- private -------------------------------------------------------------------------------

    def _begun(self) -> Scores:
        """Forward draws or free numbers near zero, node by node, the best of several."""
        drawn = self.draw(self.rows)
        self.free = {n: self._free_of(n, drawn) for n in self.moving}
        self.values, best = self._evaluated(self.free, self.rows)
        for _ in range(_CANDIDATES):
            drawn = self.draw(self.rows)
            tried = {n: self._free_of(n, drawn) for n in self.moving}
            for name in self.moving:
                if self.is_free[name] and self.rng.random() < 0.7:
                    tried[name] = self.rng.uniform(-2.0, 2.0, tried[name].shape)
            best = self._kept(tried, best, 1)
        return best

    def _round(self, best: Scores) -> Scores:
        k = self.candidates
        tried = {n: np.repeat(u, k, axis=0) for n, u in self.free.items()}
        drawn = self.draw(self.rows * k) if not all(self.is_free.values()) else {}
        count = self.rows * k
        chosen = self.rng.random((count, len(self.moving)))
        # one node as often as all of them
        single = self.rng.random(count) < 0.6
        first = chosen == chosen.min(axis=1, keepdims=True)
        moves = np.where(single[:, None], first, chosen < 0.5)
        for j, name in enumerate(self.moving):
            at = moves[:, j]
            if self.is_free[name]:
                tried[name] = np.where(
                    _wide(at, tried[name]), self._stepped(tried[name]), tried[name]
                )
            else:
                event = len(self.target.model[name].event_shape)
                some = self._some(tried[name], event) & _wide(at, tried[name])
                other = self._counted(name, tried[name], drawn[name])
                tried[name] = np.where(some, other, tried[name])
        return self._kept(tried, best, k)

    def _stepped(self, u: np.ndarray) -> np.ndarray:
        """Steps of all sizes, in one number or all; towards the middle; or somewhere else altogether."""
        rng, rows = self.rng, len(u)
        size = 10.0 ** rng.uniform(-2.0, 1.3, rows)
        step = rng.standard_normal(u.shape) * _wide(size, u)
        flat = step.reshape(rows, -1)
        if flat.shape[1] > 1:
            only = rng.random(rows) < 0.5
            mask = rng.random(flat.shape) < (1.5 / flat.shape[1])
            flat = np.where(only[:, None] & ~mask, 0.0, flat)
        kind = rng.random(rows)
        moved = u + flat.reshape(u.shape)
        shrunk = u * _wide(rng.choice([0.0, 0.3, 0.7, 0.9], rows), u)
        other = rng.uniform(-2.0, 2.0, u.shape)
        found = np.where(
            _wide(kind < 0.15, u), shrunk, np.where(_wide(kind < 0.25, u), other, moved)
        )
        return np.clip(found, -1e6, 1e6)

    def _counted(self, name: str, value: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """Counts move by steps of all sizes, too: what was seen may be where draws never come."""
        node = self.target.model[name]
        if node.domain is not None or node.event_shape or not node.is_discrete:
            return drawn
        rng, rows = self.rng, len(value)
        size = np.ceil(10.0 ** rng.uniform(-1.0, 4.0, rows)) * rng.choice([-1.0, 1.0], rows)
        moved = value + _wide(size, value).astype(value.dtype)
        return np.where(_wide(rng.random(rows) < 0.5, value), moved, drawn)

    def _some(self, values: np.ndarray, event_ndim: int) -> np.ndarray:
        """Some elements of each row, from one to all of them; True broadcasts over what one value is."""
        lead = values.shape[: values.ndim - event_ndim]
        share = np.maximum(self.rng.random(lead[0]) ** 3, 1.0 / max(math.prod(lead[1:]), 1))
        some = self.rng.random(lead) <= share.reshape((-1,) + (1,) * (len(lead) - 1))
        return some.reshape(lead + (1,) * event_ndim)

    def _kept(self, tried: Values, best: Scores, k: int) -> Scores:
        """The best of ``k`` candidates of each row, where that is better."""
        values, scores = self._evaluated(tried, self.rows * k)
        at = scores.best_of(k)
        found = scores.at(at)
        better = found.better_than(best)
        for store, new in ((self.free, tried), (self.values, values)):
            for name, array in new.items():
                store[name] = np.where(_wide(better, array), array[at], store[name])
        return found.where(better, best)

    def _evaluated(self, free: Values, rows: int) -> tuple[Values, Scores]:
        """The values of free numbers, and all terms there."""
        target = self.target
        values = in_order(target, rows, lambda node, above: self._value(node, free, above, rows))
        lost, far, log = np.zeros(rows, dtype=int), np.zeros(rows), np.zeros(rows)
        for term in target.terms.values():
            part = row_logs(term, values, rows).reshape(rows, -1)
            dead = part == -np.inf
            if dead.any():
                lost += dead.sum(axis=1)
                far += np.where(dead, _distances(term, values, rows), 0.0).sum(axis=1)
            if self.is_free.get(term.name):
                part = part - self._middle(term, free[term.name], values, rows)
            log += np.where(dead, 0.0, part).sum(axis=1)
        kept = {n: values[n] for n in (*target.chain, *target.links)}
        return kept, Scores(lost, far, log)

    def _value(self, node: CompiledNode, free: Values, values: Values, rows: int) -> np.ndarray:
        if node.name in self.given:
            fixed = self.given[node.name]
            return np.repeat(fixed, rows // len(fixed), axis=0)
        if self.is_free[node.name]:
            return self._constrained(node, free[node.name], values)
        return free[node.name]

    def _constrained(self, node: CompiledNode, u: np.ndarray, values: Values) -> np.ndarray:
        dist = self._own(node, values)
        if dist is None:
            assert node.support is not None
            return transform_of(node.support, node.event_shape).constrain(u)
        value = dist.constrain(u)
        return np.where(
            np.isfinite(value), value, np.nan_to_num(value, posinf=1e300, neginf=-1e300)
        )

    def _middle(self, term: Term, u: np.ndarray, values: Values, rows: int) -> np.ndarray:
        """What a node's own density counts from, shape ``(rows, elements)``: that of its free numbers at the
        middle, less the volume at ``u``; 0 for elements that were seen, or where there is no middle.
        """
        node, shape = term.model[term.name], (rows, *term.shape)
        try:
            dist, batch = term.distribution(values)
            middle = middle_of(dist, (rows, *node.value_shape))
            log = np.asarray(term.log_of(dist, batch, middle))
            log = log + dist.log_abs_det_jacobian(dist.unconstrain(middle))
            log = np.broadcast_to(log - dist.log_abs_det_jacobian(u), shape)
        except (BayesmcError, ValueError):
            return np.zeros((rows, math.prod(term.shape)))
        seen = self.target.seen(term.name)
        if seen is not None and seen.mask is not None:
            log = np.where(seen.mask, 0.0, log)
        return np.where(np.isfinite(log), log, 0.0).reshape(rows, -1)

    def _own(self, node: CompiledNode, values: Values) -> Distribution | None:
        if node.name not in self.target.terms:
            return None
        return self.target.model.evaluate(node.name, values)[0]

    def _free_of(self, name: str, drawn: Values) -> np.ndarray:
        """A drawn value's free numbers; the value itself where there are none."""
        node = self.target.model[name]
        value = drawn[name]
        if node.is_discrete or node.domain is not None:
            self.is_free[name] = False
            return value
        try:
            dist = self._own(node, drawn)
            if dist is None:
                assert node.support is not None
                u = transform_of(node.support, node.event_shape).unconstrain(value)
            else:
                u = dist.unconstrain(value)
        except BayesmcError:
            self.is_free[name] = False
            return value
        self.is_free[name] = True
        if not np.isfinite(u).all():
            u = np.clip(np.nan_to_num(u, nan=0.0), -_FREE, _FREE)
        return u


def in_order(
    target: Target, rows: int, value: Callable[[CompiledNode, Values], np.ndarray]
) -> Values:
    """Values of all nodes, parents first: those of the chain, with what was seen in its place, and links.

    Parameters
    ----------
    value : callable
        From a node of the chain and the values of those before it.
    """
    values: Values = dict(target.known)
    inside, links = set(target.chain), set(target.links)
    for name, node in target.model.nodes.items():
        if name in inside:
            values[name] = target.with_seen(name, value(node, values))
        elif name in links:
            computed, _ = target.model.evaluate(name, values)
            values[name] = np.array(np.broadcast_to(computed, (rows, *node.value_shape)))
    return values


# ---- private ------------------------------------------------------------------------------------


def _wide(rows: np.ndarray, like: np.ndarray) -> np.ndarray:
    """One number for each row, with the axes of an array."""
    return rows.reshape((-1,) + (1,) * (like.ndim - 1))


def _distances(term: Term, values: Values, rows: int) -> np.ndarray:
    """How far a term's values are from its support, in logs, shape ``(rows, elements)``."""
    nowhere = np.zeros((rows, math.prod(term.shape)))
    if term.is_potential or term.model[term.name].event_shape:
        return nowhere
    try:
        dist, _ = term.distribution(values)
        support = dist.support
    except BayesmcError:
        return nowhere
    if support.kind not in ("interval", "integers"):
        return nowhere
    node, value = term.model[term.name], values[term.name]
    value = value if node.domain is None else node.domain.to_support(value)
    gap = np.maximum(np.maximum(support.low - value, value - support.high), 0.0)
    lead = gap.shape[: max(gap.ndim - len(term.shape), 0)]
    full = np.broadcast_to(np.broadcast_to(gap, lead + term.shape), (rows, *term.shape))
    return np.log1p(np.nan_to_num(full, posinf=1e300)).reshape(rows, -1)


def _rows(term: Term, values: Values, at: slice) -> Values:
    """Some rows of what a term reads; what is known has none."""
    found = dict(values)
    for name in term.scope:
        value = values[name]
        if value.ndim > len(term.model[name].value_shape):
            found[name] = value[at] if len(value) > 1 else value
    return found
