"""What a child summed by label adds to a conjugate node, read off its expression.

The child's log density by label is an expression of the sums (``label_sums``); the natural parameters are
its coefficients of the node's powers and logarithms, and for normal vectors the quadratic form in the
mean, or the scatter about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import MvNormal
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Expression,
    as_expression,
    broadcast,
    constant,
    elementwise,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.products import product
from bayesmc.expression.scalars import SmallProgram
from bayesmc.kernels.label_sums import LabelSums, label_sums
from bayesmc.passes.affine import affine
from bayesmc.passes.arithmetic import add, divide, is_all, multiply, subtract
from bayesmc.passes.features import LOG, LOG1M, statistics
from bayesmc.passes.sufficient import precision_of, transposed
from bayesmc.structure.target import Target, Term, Values

#: elements per label from which on sums by label pay
_PER_LABEL = 4


class ByLabel:
    """Natural parameters that a child summed by label adds.

    Parameters
    ----------
    sums : LabelSums
    naturals : sequence of Expression, shapes (*node's value, ...)
    """

    def __init__(self, sums: LabelSums, naturals: tuple[Expression, ...]) -> None:
        self.sums, self.naturals = sums, naturals
        self._program = SmallProgram(naturals)
        self._ranks = [len(n.shape) for n in naturals]

    def __call__(self, values: Values) -> tuple[np.ndarray, ...]:
        """In a state, shapes ``(chains, *plates, ...)``."""
        found = self._program(self.sums.placed(values))
        return tuple(
            f if f.ndim > rank else f[None] for f, rank in zip(found, self._ranks, strict=True)
        )


def by_label(target: Target, term: Term, node: str, kind: str, power: float) -> ByLabel | None:
    """The natural parameters that a term's sums by label add to a node, if there is such a label.

    Parameters
    ----------
    kind : str
        Of the full conditional (``conjugate_kinds``).
    power : float
        Of the node in a scale's exponential.
    """
    own = [p for p in term.parents if set(term.plates) & set(target.model[p].plates)]
    if len(own) != 1 or node in own:
        return None
    sums = label_sums(target, term, own[0])
    if sums is None or sums.states * _PER_LABEL > sums.statistics.shape[1]:
        return None
    try:
        return ByLabel(sums, _naturals(sums, target, node, kind, power))
    except (TraceError, ValueError):
        return None


def counted(target: Target, label: str) -> LabelSums | None:
    """Sums by this very label that count all its elements, if somebody takes any."""
    for term in target.terms.values():
        sums = term.summaries.get(label)
        if sums is not None and sums.ones == 1 and term.mask is None:
            return sums
    return None


def with_sums(values: Values, every: Sequence[LabelSums]) -> tuple[Values, Values]:
    """A state with sums by label in it, and those that were not there: others read the same."""
    derived: Values = {}
    for sums in every:
        placed = sums.placed(values)
        if placed is not values:
            derived |= sums.kept(placed[sums.label], placed[sums.key])
            values = placed
    return values, derived


def summed(
    prior: Sequence[np.ndarray],
    added: Sequence[Sequence[Expression] | None],
    shape: tuple[int, ...],
    event_ndims: Sequence[int],
) -> list[Expression] | None:
    """Natural parameters ``(*shape, *event)`` of prior and children; None where one is no expression."""
    if any(len(a) != 1 for a in prior) or any(a is None for a in added):
        return None
    totals: list[Expression] = [as_expression(a[0]) for a in prior]
    for parts in added:
        assert parts is not None
        totals = [add(a, b) for a, b in zip(totals, parts, strict=True)]
    return [
        broadcast(t, shape + t.shape[len(t.shape) - n :])
        for t, n in zip(totals, event_ndims, strict=True)
    ]


# ---- private ------------------------------------------------------------------------------------


def _naturals(
    sums: LabelSums, target: Target, node: str, kind: str, power: float
) -> tuple[Expression, ...]:
    shape = target.model[node].plate_shape
    if sums.family.make is MvNormal and sums.repeats == 1:
        if kind == "mean":
            return _quadratic(sums, node, target.model[node].value_shape, len(shape))
        if kind == "covariance":
            return _scatter(sums, node, shape)
        if kind == "scale":
            return _spread(sums, node, shape, power)
    if target.model[node].event_shape:
        raise TraceError("it is a vector")
    found = statistics(sums.expression, node)
    wanted: dict[str, tuple[Any, Any]] = {
        "mean": (2.0, 1.0), "scale": (LOG, power), "share": (LOG, LOG1M),
    }  # fmt: skip
    first, second = wanted[kind]
    if not set(found.coefficients) <= {first, second}:
        raise TraceError("it is not of this family")
    zero = broadcast(as_expression(0.0), sums.expression.shape)
    a, b = (found.coefficients.get(f, zero) for f in (first, second))
    if kind == "mean":
        a = multiply(a, -2.0)
    elif kind == "scale":
        b = multiply(b, -1.0)
    at = _known(found.at)
    return _collected(a, at, shape, 0), _collected(b, at, shape, 0)


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


# ---- normal vectors -----------------------------------------------------------------------------


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


def _quadratic(
    sums: LabelSums, node: str, value_shape: tuple[int, ...], plates: int
) -> tuple[Expression, ...]:
    """Precision and linear term of a node in which the mean is affine."""
    labels, d = sums.states, len(sums.centre)
    loc = broadcast(as_expression(sums.family.parameters["loc"]), (*sums.shape, d))
    form = affine(reshape(loc, (labels, d)), [node])
    if node in precision_leaves(sums):
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


def precision_leaves(sums: LabelSums) -> frozenset[str]:
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


def _scatter(sums: LabelSums, node: str, shape: tuple[int, ...]) -> tuple[Expression, ...]:
    """Degrees of freedom and scale of a node of which the covariance is a multiple."""
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


def _spread(
    sums: LabelSums, node: str, shape: tuple[int, ...], power: float
) -> tuple[Expression, ...]:
    """Exponent and coefficient of a number whose power multiplies the covariance."""
    labels, d = sums.states, len(sums.centre)
    given = sums.family.parameters
    if node in as_expression(given["loc"]).leaves:
        raise TraceError("it is in the mean, too")
    name = next(k for k in ("scale_diag", "scale_tril", "cov") if given.get(k) is not None)
    twice = 1.0 if name == "cov" else 2.0
    event = (d,) if name == "scale_diag" else (d, d)
    whole = reshape(broadcast(given[name], (*sums.shape, *event)), (labels, *event))
    found = statistics(whole, node)
    at = _known(found.at).reshape(labels, -1)
    if len(found.coefficients) != 1 or (at != at[:, :1]).any():
        raise TraceError("the covariance is no multiple of a power of it")
    ((p, matrix),) = found.coefficients.items()
    if not isinstance(p, float) or p * twice != -power:
        raise TraceError("the covariance is no multiple of this power of it")
    if name == "scale_diag":
        root = multiply(reshape(matrix, (labels, d, 1)), np.eye(d))
        cov = product(np.matmul, root, transposed(root))
    else:
        cov = matrix if name == "cov" else product(np.matmul, matrix, transposed(matrix))
    inverse = _inverse(sums, cov)
    traces = reduction(np.add, multiply(inverse, _about_loc(sums)), (1, 2))
    rate = multiply(0.5, elementwise(np.maximum, traces, 0.0))
    exponent = multiply(reshape(sums.column(0, 1), (labels,)), 0.5 * d * power)
    return _collected(exponent, at[:, 0], shape, 0), _collected(rate, at[:, 0], shape, 0)


def _inverse(sums: LabelSums, cov: Expression) -> Expression:
    family = type(sums.family)(MvNormal, {"loc": None, "cov": cov})
    return precision_of(family, cov.shape[:-2])[0]
