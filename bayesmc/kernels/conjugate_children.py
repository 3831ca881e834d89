"""Children of a conjugate node: which pair each makes with the node's prior, and what it adds.

A pair is proved by tracing the child's function; its coefficients come from calling that function with the
node at a neutral value (and at unit steps, for means). What cannot change from sweep to sweep is worked
out once: slopes where the mean is affine in everything hidden, and all of it where nothing else is hidden.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Categorical, Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.kernels.conjugate_data import TRANSFORMS, Elements, Groups, counted
from bayesmc.kernels.conjugate_evaluation import Evaluated, Looked, slope_of
from bayesmc.kernels.conjugate_kinds import Kind, Naturals
from bayesmc.kernels.conjugate_labels import (
    ByLabel,
    by_label,
    read_directly,
)
from bayesmc.kernels.conjugate_pairs import Pair
from bayesmc.kernels.conjugate_sums import Collector
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.target import Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer


class Partner:
    """One child with the pair that it makes.

    Attributes
    ----------
    pair : Pair
    power : float
        The power of the node in the parameter (1 for copies and means).
    is_copy : bool
        Whether the parameter is the node's value.
    """

    def __init__(
        self, blanket: Blanket, child: Child, kind: Kind, pair: Pair, power: float, is_copy: bool
    ) -> None:
        self.blanket, self.child, self.kind = blanket, child, kind
        self.pair, self.power, self.is_copy = pair, power, is_copy
        self.term = child.term
        self.node = blanket.target.model[child.term.name]
        neutral = kind.neutral(blanket.event_shape)
        axes = (1,) * (1 + len(blanket.node.plates))
        self._neutral = neutral.reshape(axes + neutral.shape)
        self._steps = _steps(blanket) if kind.name == "mean" else np.zeros(0)
        self._moved = self._neutral
        if len(self._steps):
            self._moved = _stepped(self._neutral, self._steps, blanket.event_shape)
        self._data = self._known_data()
        self._slope: np.ndarray | None = None
        self._fixed: Naturals | None = None
        self._way: ByLabel | None = None
        self.is_mean_by_label = False
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

    # ---- evaluating ---------------------------------------------------------------------------

    def _natural(self, values: Values, members: np.ndarray | None) -> Naturals:
        if self.counts is not None:
            count = self.counts.at(values).count
            return (count.reshape((len(count), -1)),)
        if self.is_mean_by_label:
            return self._by_label(values)
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

    def _mean(self, e: Evaluated | Looked, slope: np.ndarray) -> Naturals:
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

    def _by_label(self, values: Values) -> Naturals:
        """The same for vectors whose mean is this node itself, element k under label k."""
        assert self._way is not None
        precision, data = self._way.precision(values), self._way.groups.at(values)
        d = precision.matrix.shape[-1]
        count = data.count.reshape((len(data.count), -1, 1, 1))
        total = data.total.reshape((len(count), -1, d))
        return count * precision.matrix, np.matvec(precision.matrix, total)

    @cached_property
    def counts(self) -> Groups | None:
        """Where the child is itself the label of somebody's sums, how often each of its states came.

        Looked up at the first step, when all kernels have been made.
        """
        alone = self.pair.child is Categorical and not self.blanket.node.plates
        if not alone or self.blanket.target.seen(self.term.name) is not None:
            return None
        return counted(self.blanket.target, self.term)

    @property
    def _event_ndim(self) -> int:
        return len(self.node.event_shape)

    def _evaluated(
        self, values: Values, members: np.ndarray | None, steps: bool
    ) -> Evaluated | Looked:
        if self._way is not None:
            if self._way.direct is not None:
                return self._way.looked(values)
            return self._way.evaluated(values, self._moved if steps else self._neutral, steps)
        dist, batch, keys = self._distribution(values, members, steps)
        value = values[self.term.name]
        if dist.invalid is not None:
            self.term.log_of(dist, batch, value)  # raises where that is the model's fault
        data = self._data if self._data is not None else self._data_of(value)
        collector = Collector(self.child.relation, self.term.shape, keys, members)
        return Evaluated(dist, steps, len(self.term.shape), data, collector)

    def _distribution(
        self, values: Values, members: np.ndarray | None, steps: bool
    ) -> tuple[Distribution, Shape, tuple[Any, ...]]:
        candidate = self._full(self._moved if steps else self._neutral, members)
        state = self.blanket.placed(values, candidate, members)
        return self.blanket.distribution(self.child, state)

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
        if value.ndim == len(self.node.value_shape):
            value = value[None]
        if self.kind.name != "shares":
            value = TRANSFORMS[self.pair.transform](value)
        return Elements(value, self.term.mask, self._event_ndim)

    def _known_data(self) -> Elements | None:
        target = self.blanket.target
        if not target.is_known(self.term.name):
            return None
        with np.errstate(all="ignore"):
            return self._data_of(target.known[self.term.name])

    # ---- what never changes -------------------------------------------------------------------

    def _settle(self) -> None:
        """Find sums by label, constant slopes and constant children."""
        alone = self.child.relation.kind != "whole" and len(self.child.relation.rows) <= 1
        if not alone or len(self.blanket.classes) > 1:
            return
        target, name = self.blanket.target, self.blanket.name
        above = target.hidden_above(self.term)
        members = self.blanket.classes[0]
        if above == (name,) and target.is_known(self.term.name):
            value = np.broadcast_to(self._neutral, (1, *self.blanket.node.value_shape))
            self._fixed = self._natural({**target.known, name: value}, members)
            return
        if members is None and self.pair.by_label:
            self._way = by_label(self.blanket, self.child, self.pair)
        if self._way is not None:
            if self.is_copy or self.pair.form != "multiple":
                self._read_directly(above)
        elif self.kind.name == "mean":
            self._find_slope(above, members)

    def _read_directly(self, above: tuple[str, ...]) -> None:
        """Leave out calls of the function where its parameters are plain nodes by label."""
        assert self._way is not None
        example = read_directly(self._way, self._neutral, above)
        if example is not None and self.kind.name == "mean":
            # the mean varies with this node and the label alone
            dist, _ = self._way.at_labels(example, self._moved)
            self._slope = slope_of(dist, len(self.term.shape), self._steps)
            self.is_mean_by_label = self._is_itself(self._slope)

    def _is_itself(self, slope: np.ndarray) -> bool:
        """Whether the mean of vectors is the node's value under each label."""
        assert self._way is not None
        if not self.blanket.event_shape or not self.blanket.node.plates or not self._event_ndim:
            return False
        unit = np.eye(len(self._steps)).reshape((len(slope), *(1,) * (slope.ndim - 2), -1))
        at_zero = self._way.parameter("loc", {})
        return bool((slope == unit).all() and not np.any(at_zero))

    def _find_slope(self, above: tuple[str, ...], members: np.ndarray | None) -> None:
        """Slopes are constant where the mean is affine in all that is hidden together."""
        target = self.blanket.target
        if any(target.model[n].is_discrete for n in above):
            return
        try:
            result = traced_term(target, above, self.term).result
        except Untraceable:
            return
        loc = result.arguments["loc"] if isinstance(result, TracedCall) else None
        if not (isinstance(loc, Tracer) and loc.is_affine):
            return
        # values that can be: the noise may depend on some of these nodes, too
        state = target.example(above)
        try:
            dist, _, _ = self._distribution(state, members, True)
        except BayesmcError:
            return
        slope = slope_of(dist, len(self.term.shape), self._steps)
        if np.isfinite(slope).all():
            self._slope = slope


def partner_of(
    blanket: Blanket, child: Child, kind: Kind, pairs: Sequence[Pair]
) -> Partner | str | None:
    """The pair that a child makes with a kind, None where it does not vary with the node, or why not."""
    term = child.term
    if term.is_potential:
        return f"it enters the potential {term.name!r}"
    try:
        result = traced_term(blanket.target, (blanket.name,), term).result
    except Untraceable as error:
        return f"child {term.name!r} cannot be followed ({error})"
    if isinstance(result, Distribution):
        return None
    if not isinstance(result, TracedCall):
        return f"child {term.name!r} is no distribution that can be followed"
    family: Any = result.function
    traced = result.traced
    mine = [p for p in pairs if p.kind == kind.name and p.child is family]
    if not mine:
        return f"child {term.name!r} is {family.__name__}, which makes no conjugate pair"
    if len(traced) > 1:
        return f"it enters {_listed(traced)} of child {term.name!r}"
    ((parameter, value),) = traced.items()
    pair = next((p for p in mine if p.parameter == parameter), None)
    if pair is None or not isinstance(value, Tracer):
        return f"it enters the {parameter} of {family.__name__} {term.name!r}"
    reason = _why_not(blanket, child, pair, value)
    if reason is not None:
        return f"the {parameter} of child {term.name!r} {reason}"
    power = 1.0 if pair.form != "power" else value.power
    assert power is not None
    return Partner(blanket, child, kind, pair, power, value.is_copy)


# ---- private ------------------------------------------------------------------------------------


def _why_not(blanket: Blanket, child: Child, pair: Pair, value: Tracer) -> str | None:
    """Why a parameter does not have the form that the pair wants, or None."""
    name = blanket.name
    if pair.form == "affine":
        return (
            None if value.is_affine else f"is not known to be affine in it (after {value.reason})"
        )
    relation = child.relation
    if relation.kind == "whole" or len(relation.rows) > 1 or len(value.sources) > 1:
        return f"may depend on several elements of {name!r}"
    if pair.form == "power":
        return (
            None if value.power is not None else "is not known to be a power of it times a constant"
        )
    if pair.form == "multiple":
        if value.power == 1.0 and value.whole_event:
            return None
        return "is not known to be its value times a number"
    if not value.is_copy or (blanket.event_shape and not value.whole_event):
        return "is not known to be its value itself"
    return None


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


def _listed(traced: dict[str, Any]) -> str:
    return " and ".join(traced)
