"""Children of a conjugate node that are summed by label, and what they add where they are normal vectors.

A child's log density by label is an expression of the sums (``label_sums``), of which the features are
read as of any other; of vectors, the quadratic form in the mean, or the scatter about it.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from bayesmc.distributions import MvNormal
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Expression,
    as_expression,
    broadcast,
    constant,
    leaf,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.functions import product
from bayesmc.kernels.label_sums import LabelSums, label_sums, sums_by_label
from bayesmc.passes.affine import affine
from bayesmc.passes.arithmetic import add, divide, is_all, multiply, subtract
from bayesmc.passes.sufficient import precision_of, transposed
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values

#: elements per label from which on sums by label pay
_PER_LABEL = 4


def by_label(target: Target, term: Term, node: str) -> LabelSums | None:
    """The sums of a child of a node by its label, where it has one and they pay."""
    own = [p for p in term.parents if set(term.plates) & set(target.model[p].plates)]
    if len(own) != 1 or node in own:
        return None
    sums = label_sums(target, term, own[0])
    if sums is None or sums.states * _PER_LABEL > sums.statistics.shape[1]:
        return None
    return sums


class Counts:
    """How often each of a label's states came, from sums that somebody takes by it where there are any.

    Attributes
    ----------
    leaf : Leaf, shape (states,)
        What stands for them.
    sums : LabelSums or None
        That somebody takes by the label.
    """

    def __init__(self, target: Target, label: str) -> None:
        self.target, self.label = target, label
        domain = target.model[label].domain
        assert domain is not None
        self.leaf = leaf(f"counts of {label}", (domain.size,))

    def placed(self, values: Values) -> Values:
        """A state with the counts beside it."""
        if self.sums is not None:
            return {**values, self.leaf.name: self.sums.sums(values)[..., 0]}
        label = values[self.label]
        ones = np.ones((1, label[0].size))
        found = sums_by_label(label.reshape(len(label), -1), ones, self.leaf.size)
        return {**values, self.leaf.name: found[..., 0]}

    @cached_property
    def sums(self) -> LabelSums | None:
        """Looked up at the first step, when all kernels have been made."""
        return _counted(self.target, self.label)


def mean_by_label(sums: LabelSums, blanket: Blanket) -> tuple[Expression, Expression]:
    """Precision and linear term of a vector in which the mean is affine.

    Raises
    ------
    TraceError
        It is not in the mean alone, or not so.
    """
    if sums.family.make is not MvNormal or sums.repeats != 1:
        raise TraceError("they are no normal vectors")
    node, value_shape = blanket.name, blanket.node.value_shape
    plates = len(blanket.node.plate_shape)
    labels, d = sums.states, len(sums.centre)
    loc = broadcast(as_expression(sums.family.parameters["loc"]), (*sums.shape, d))
    form = affine(reshape(loc, (labels, d)), [node])
    if node in _precision_leaves(sums):
        raise TraceError("it is not in the mean alone")
    read = form.reads[node]
    at = _known(read.at)
    event, shape = value_shape[plates:], value_shape[:plates]
    own = int(np.prod(event, dtype=int))
    element = at // own
    if (element != element[:, :1, :1]).any():
        raise TraceError("several elements are read")
    hot = constant((at[..., None] % own == np.arange(own)).astype(float))
    slope = reduction(np.add, multiply(reshape(read.gain, (*read.gain.shape, 1)), hot), (2,))
    precision, _ = precision_of(sums.family, sums.shape)
    precision = reshape(precision, (labels, d, d))
    count, first, _ = _moments(sums)
    total = add(first, multiply(count, subtract(sums.centre, form.offset)))
    linear = product(np.matvec, precision, total)
    if not (isinstance(slope, Constant) and is_all(subtract(slope, np.eye(d, own)), 0)):
        linear = product(np.matvec, transposed(slope), linear)
        precision = product(np.matmul, product(np.matmul, transposed(slope), precision), slope)
    precision = multiply(reshape(count, (labels, 1, 1)), precision)
    if not event:
        precision, linear = reshape(precision, (labels,)), reshape(linear, (labels,))
    at = element[:, 0, 0]
    return (
        _collected(precision, at, shape, 2 * len(event)),
        _collected(linear, at, shape, len(event)),
    )


def covariance_by_label(sums: LabelSums, blanket: Blanket) -> tuple[Expression, Expression]:
    """Degrees of freedom and scale of a node of which the covariance is a multiple.

    Raises
    ------
    TraceError
        It is not the covariance alone, or not so.
    """
    if sums.family.make is not MvNormal or sums.repeats != 1:
        raise TraceError("they are no normal vectors")
    node, shape = blanket.name, blanket.node.plate_shape
    labels, d = sums.states, len(sums.centre)
    cov = sums.family.parameters.get("cov")
    if cov is None or node in as_expression(sums.family.parameters["loc"]).leaves:
        raise TraceError("it is not the covariance alone")
    form = affine(reshape(broadcast(cov, (*sums.shape, d, d)), (labels, d, d)), [node])
    read = form.reads[node]
    at = _known(read.at)
    block = np.arange(d * d).reshape(d, d)
    element = at[:, 0, 0, 0] // (d * d)
    fits = read.gain.shape[-1] == 1 and is_all(form.offset, 0)
    if not fits or (at[..., 0] != element[:, None, None] * d * d + block).any():
        raise TraceError("the covariance is no multiple of it")
    gain = reshape(read.gain, (labels, d, d))
    scatter = _about_loc(sums)
    if not is_all(gain, 1):
        if not isinstance(gain, Constant) or (gain.value != gain.value[:, :1, :1]).any():
            raise TraceError("the covariance is no multiple of it")
        scatter = divide(scatter, gain)
    count = reshape(sums.column(0, 1), (labels,))
    return _collected(count, element, shape, 0), _collected(scatter, element, shape, 2)


# ---- private ------------------------------------------------------------------------------------


def _counted(target: Target, label: str) -> LabelSums | None:
    """Sums by this very label that count all its elements, if somebody takes any."""
    for term in target.terms.values():
        sums = term.summaries.get(label)
        if sums is not None and sums.ones == 1 and term.mask is None:
            return sums
    return None


def _known(at: Expression) -> np.ndarray:
    """Positions that do not depend on the state."""
    if not isinstance(at, Constant):
        raise TraceError("which element is read varies")
    return at.value


def _collected(
    parts: Expression, at: np.ndarray, shape: tuple[int, ...], event_ndim: int
) -> Expression:
    """Sums of entries ``(*entries, *event)`` over those at each element of a node."""
    size = int(np.prod(shape, dtype=int))
    event = parts.shape[len(parts.shape) - event_ndim :]
    flat = reshape(parts, (at.size, *event))
    if not np.array_equal(at.ravel(), np.arange(size)):
        hot = (at.ravel() == np.arange(size)[:, None]).astype(float)
        wide = constant(hot.reshape(hot.shape + (1,) * event_ndim))
        flat = reduction(np.add, multiply(wide, flat), (1,))
    return reshape(flat, (*shape, *event))


def _moments(sums: LabelSums) -> tuple[Expression, Expression, Expression | None]:
    """How many, their sum about the centre and the products', by label."""
    d = len(sums.centre)
    rows = sums.leaf.shape[1]
    count, first = sums.column(0, 1), sums.column(1, d)
    if rows == 1 + d:
        return count, first, None
    if rows != 1 + d + d * (d + 1) // 2:
        raise TraceError("some products have no coefficient")
    i, j = np.tril_indices(d)
    place = np.empty((d, d), dtype=np.intp)
    place[i, j] = place[j, i] = 1 + d + np.arange(len(i))
    at = np.arange(sums.leaf.size).reshape(sums.leaf.shape)
    return count, first, pick([sums.leaf], at[:, place])


def _precision_leaves(sums: LabelSums) -> frozenset[str]:
    """What the covariance depends on."""
    given = [v for k, v in sums.family.parameters.items() if k != "loc"]
    return frozenset().union(*(v.leaves for v in given if isinstance(v, Expression)))


def _about_loc(sums: LabelSums) -> Expression:
    """Scatter matrices about the mean, (labels, d, d)."""
    labels, d = sums.states, len(sums.centre)
    count, first, second = _moments(sums)
    if second is None:
        raise TraceError("the covariance is known")
    loc = broadcast(as_expression(sums.family.parameters["loc"]), (*sums.shape, d))
    off = subtract(reshape(loc, (labels, d)), sums.centre)
    half = subtract(first, multiply(multiply(0.5, count), off))
    cross = multiply(reshape(off, (labels, d, 1)), reshape(half, (labels, 1, d)))
    return subtract(second, add(cross, transposed(cross)))
