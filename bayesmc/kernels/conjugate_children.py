"""What a child of a conjugate node adds to the node's full conditional.

The coefficients of the pair that it makes (``conjugate_matching``) come from calling its function with the
node at a neutral value (and at unit steps, for means). What cannot change from sweep to sweep is worked
out once: slopes where the mean is affine in everything hidden, and all of it where nothing else is hidden.
Many like children are one partner, see ``conjugate_like``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Categorical, Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.expression import Expression, as_expression
from bayesmc.kernels.conjugate_data import TRANSFORMS, Elements
from bayesmc.kernels.conjugate_evaluation import Evaluated, slope_of
from bayesmc.kernels.conjugate_kinds import Kind, Naturals
from bayesmc.kernels.conjugate_labels import ByLabel, by_label, counted
from bayesmc.kernels.conjugate_matching import Match
from bayesmc.kernels.conjugate_picks import picked_natural, points_of
from bayesmc.kernels.conjugate_sums import Collector
from bayesmc.kernels.label_sums import LabelSums
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer


class Partner:
    """One child with the pair that it makes.

    Parameters
    ----------
    match : Match
        The child and the pair.
    settle : bool
        Whether what never changes is worked out, which takes some calls.
    """

    def __init__(self, blanket: Blanket, match: Match, kind: Kind, settle: bool = True) -> None:
        self.blanket, self.kind = blanket, kind
        self.child, self.pair = match.child, match.pair
        self.power, self.is_copy = match.power, match.is_copy
        self.unless_picked, self.is_picked = match.unless_picked, match.unless_picked is not None
        self.term, self.relation = self.child.term, self.child.relation
        self.node = self.term.model[self.term.name]
        neutral = kind.neutral(blanket.event_shape)
        axes = (1,) * (1 + len(blanket.node.plates))
        self._neutral = neutral.reshape(axes + neutral.shape)
        self._steps = _steps(blanket) if kind.name == "mean" else np.zeros(0)
        self._moved = self._neutral
        if len(self._steps):
            self._moved = _stepped(self._neutral, self._steps, blanket.event_shape)
        self._points = np.zeros(0)
        if self.is_picked:
            self._points = points_of(kind.name, blanket.event_shape)
            self._moved = self._points.reshape((len(self._points), *axes, *neutral.shape))
        self._data = self._known_data()
        self._slope: np.ndarray | None = None
        self._fixed: Naturals | None = None
        self._way: ByLabel | None = None
        if settle:
            with marking_invalid(), np.errstate(all="ignore"):
                self._settle()

    def natural(self, values: Values, members: np.ndarray | None) -> Naturals:
        """What the child adds, natural parameters ``(lead, *plates, ...)`` or ``(lead, members, ...)``."""
        if self._fixed is not None:
            return self._fixed
        return self._natural(values, members)

    @property
    def way(self) -> ByLabel | None:
        """How it is summed by label, if it is."""
        return self._way

    @property
    def expressions(self) -> tuple[Expression, ...] | None:
        """What it adds as expressions of the state, where it is summed by label or fixed."""
        if self._way is not None:
            return self._way.naturals
        if self._fixed is None or any(len(a) != 1 for a in self._fixed):
            return None
        return tuple(as_expression(a[0]) for a in self._fixed)

    # ---- evaluating ---------------------------------------------------------------------------

    def _natural(self, values: Values, members: np.ndarray | None) -> Naturals:
        if self.counts is not None:
            return (self.counts.sums(values)[..., 0],)
        if self._way is not None:
            return self._way(values)
        if self.is_picked:
            e = self._evaluated(values, members, True)
            assert isinstance(e, Evaluated)
            return picked_natural(self.pair, self._points, e, len(self.shape))
        steps = self.kind.name == "mean" and self._slope is None
        e = self._evaluated(values, members, steps)
        if self.kind.name == "mean":
            return self._mean(e, e.slope(self._steps) if self._slope is None else self._slope)
        found = self.pair.statistic(e)
        if self.kind.name == "scale":
            return self.power * e.sum(found[0]), e.sum(found[1])
        if self.kind.name == "share":
            return e.sum(found[0]), e.sum(found[1])
        if self.kind.name == "shares":
            return (found if self.pair.child is Categorical else e.sum(found, 1),)
        # the node stands at the unit matrix, of which the covariance is a multiple
        spread = np.ones(()) if self.is_copy else e.get("cov", 2)[..., 0, 0]
        return e.sum(found), e.data.scatter(e.get("loc", 1), spread, e)

    def _mean(self, e: Evaluated, slope: np.ndarray) -> Naturals:
        """Precision and linear term of a node that enters a mean affinely."""
        rows = self.pair.statistic(e, slope)  # (components, lead, *plates, m)
        residual = self.pair.statistic(e, e.data.deviations(e.get("loc", self._event_ndim)))
        count = e.data.count
        if not self.blanket.event_shape:
            rows = rows[0]
            squares = count * np.vecdot(rows, rows)
            return e.sum(squares), e.sum(np.vecdot(rows, residual))
        weighted = _last(rows * np.sqrt(count)[..., None])
        return e.outer(weighted), e.sum(_last(np.vecdot(rows, residual)), 1)

    @cached_property
    def counts(self) -> LabelSums | None:
        """Where the child is itself the label of somebody's sums, how often each of its states came.

        Looked up at the first step, when all kernels have been made.
        """
        alone = self.kind.name == "shares" and self.pair.child is Categorical
        if not alone or len(self.terms) > 1 or self.is_picked or self.blanket.node.plates:
            return None
        target = self.blanket.target
        return None if target.seen(self.term.name) is not None else counted(target, self.term.name)

    @property
    def _event_ndim(self) -> int:
        return len(self.node.event_shape)

    def _evaluated(self, values: Values, members: np.ndarray | None, steps: bool) -> Evaluated:
        candidate = self._full(self._moved if steps else self._neutral, members)
        state = self.blanket.placed(values, candidate, members)
        dist, keys = self._valid(state)
        data = self._data if self._data is not None else self._data_of(self._value(values))
        collector = Collector(self.relation, self.shape, keys, members)
        return Evaluated(dist, steps, len(self.shape), data, collector)

    def _valid(self, state: Values) -> tuple[Distribution, tuple[Any, ...]]:
        """The distribution, and the index by which it read the node; raises where the model is at fault."""
        dist, batch, keys = self._distribution(state)
        if dist.invalid is not None:
            self.term.refuse_out_of_range(dist, batch, self._value(state))
        return dist, keys

    def _full(self, candidate: np.ndarray, members: np.ndarray | None) -> np.ndarray:
        """A candidate for every element, or for those of a class."""
        if members is None:
            return candidate
        event = self.blanket.event_shape
        lead = candidate.shape[: candidate.ndim - len(self.blanket.node.value_shape)]
        return np.broadcast_to(candidate.reshape(lead + (1, *event)), lead + (len(members), *event))

    def _data_of(self, value: np.ndarray) -> Elements:
        domain = self.node.domain
        if domain is not None and (domain.low or self.kind.name != "shares"):
            value = domain.to_support(value)
        if value.ndim == len(self.shape) + self._event_ndim:
            value = value[None]
        if self.kind.name != "shares":
            value = TRANSFORMS[self.pair.transform](value)
        return Elements(value, self.term.mask, self._event_ndim)

    def _known_data(self) -> Elements | None:
        target = self.blanket.target
        if not all(target.is_known(t.name) for t in self.terms):
            return None
        with np.errstate(all="ignore"):
            return self._data_of(self._value(target.known))

    # ---- the child as such --------------------------------------------------------------------

    @property
    def terms(self) -> tuple[Term, ...]:
        """The child, or those that are one here."""
        return (self.term,)

    @property
    def shape(self) -> Shape:
        """Of its elements."""
        return self.term.shape

    def _distribution(self, state: Values) -> tuple[Distribution, Shape, tuple[Any, ...]]:
        """Its distribution, the batch of its parents, and the index by which it read the node."""
        return self.blanket.distribution(self.child, state)

    def _value(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """What was drawn from it, shape ``(chains, *shape, *event)``, without chains where it is known."""
        return values[self.term.name]

    def _find_way(self) -> ByLabel | None:
        name = self.blanket.name
        return by_label(self.blanket.target, self.term, name, self.kind.name, self._exponent)

    @property
    def _exponent(self) -> float:
        """The power of the node in the exponential, for a scale."""
        return self.power * self.pair.exponent

    # ---- what never changes -------------------------------------------------------------------

    def _settle(self) -> None:
        """Find sums by label, constant slopes and constant children."""
        alone = self.relation.kind != "whole" and len(self.relation.rows) <= 1
        if not alone or len(self.blanket.classes) > 1:
            return
        target, name = self.blanket.target, self.blanket.name
        above = dict.fromkeys(n for t in self.terms for n in target.hidden_above(t))
        members = self.blanket.classes[0]
        if list(above) == [name] and self._data is not None:
            value = np.broadcast_to(self._neutral, (1, *self.blanket.node.value_shape))
            self._fixed = self._natural({**target.known, name: value}, members)
            return
        if members is None and self.pair.by_label and not self.is_picked:
            self._way = self._find_way()
        if self._way is None and self.kind.name == "mean":
            self._find_slope(tuple(above), members)

    def _find_slope(self, above: tuple[str, ...], members: np.ndarray | None) -> None:
        """Slopes are constant where the mean is affine in all that is hidden together."""
        target = self.blanket.target
        if any(target.model[n].is_discrete for n in above):
            return
        if not all(_mean_is_affine(target, t) for t in self.terms):
            return
        # values that can be: the noise may depend on some of these nodes, too
        drawn = [t.name for t in self.terms if t.name in target.chain]
        state = target.example((*above, *drawn))
        candidate = self._full(self._moved, members)
        try:
            dist, _, _ = self._distribution(self.blanket.placed(state, candidate, members))
        except BayesmcError:
            return
        slope = slope_of(dist, len(self.shape), self._steps)
        if np.isfinite(slope).all():
            self._slope = slope


# ---- private ------------------------------------------------------------------------------------


def _mean_is_affine(target: Target, term: Term) -> bool:
    """Whether a term's mean is affine in all hidden nodes that it varies with together."""
    try:
        result = traced_term(target, target.hidden_above(term), term).result
    except Untraceable:
        return False
    loc = result.arguments["loc"] if isinstance(result, TracedCall) else None
    return isinstance(loc, Tracer) and loc.is_affine


def _steps(blanket: Blanket) -> np.ndarray:
    """For every component a power of two near the size of its values, so that steps lose no digits."""
    d = math.prod(blanket.event_shape)
    probe = np.abs(np.asarray(blanket.target.model.probe[blanket.name], dtype=float))
    sizes = probe.reshape(-1, d).max(axis=0, initial=0.0)
    sizes = np.where((sizes > 0) & np.isfinite(sizes), sizes, 1.0)
    return 2.0 ** np.clip(np.round(np.log2(sizes)), -1000, 1000)


def _stepped(neutral: np.ndarray, steps: np.ndarray, event_shape: Shape) -> np.ndarray:
    """The neutral value and a step along every component, one more axis in front."""
    d = len(steps)
    moves = np.concatenate([np.zeros((1, d)), np.diag(steps)])
    lead = neutral.ndim - len(event_shape)
    return neutral + moves.reshape((d + 1,) + (1,) * lead + event_shape)


def _last(array: np.ndarray) -> np.ndarray:
    """The first axis moved to the end."""
    return array.transpose((*range(1, array.ndim), 0))
