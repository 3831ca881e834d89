"""What children add to the natural parameters of a vector that enters a mean, or of a covariance.

A mean that is affine in a vector makes the log density a quadratic form in it; a covariance that is a
multiple of a matrix makes it that of an inverse Wishart, and one that is a multiple of a matrix's inverse
that of a Wishart. Of children that are summed by label the same is said of the sums (``label_sums``).

References
----------
Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sec. 3.5, 3.6 and 14.8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal, Normal
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Gather,
    Pick,
    TracedArray,
    as_expression,
    broadcast,
    call,
    elementwise,
    gather,
    leaf,
    ordered,
    pick,
    reduction,
    replaced,
    reshape,
    substituted,
)
from bayesmc.expression.functions import product
from bayesmc.kernels.conjugate_children import Child
from bayesmc.kernels.conjugate_terms import Moving
from bayesmc.kernels.label_sums import LabelSums
from bayesmc.passes.affine import affine
from bayesmc.passes.arithmetic import ONE, add, divide, is_all, multiply, subtract
from bayesmc.passes.derivatives import tangent
from bayesmc.passes.features import alone, statistics
from bayesmc.passes.reads import element_read, matrix_function, same_along
from bayesmc.passes.sufficient import precision_of, transposed
from bayesmc.passes.totals import total
from bayesmc.shapes import Shape

#: an inverse, beside the nodes of a model: no node has such a name
_INVERSE = "\0inverse"


def mean_added(child: Child, of: Moving) -> tuple[Expression, Expression]:
    """Precision ``(count, d, d)`` and linear term ``(count, d)`` of a vector that enters a mean.

    Raises
    ------
    TraceError
        It enters something else, or not affinely.
    """
    family, value = child.family, child.value
    parameters = family.parameters
    if family.make not in (Normal, LogNormal, MvNormal) or child.read(of.name) != ["loc"]:
        raise TraceError("it enters no mean")
    if family.make is LogNormal:
        value = elementwise(np.log, value)
    is_vector = family.make is MvNormal
    shape = child.shape + (value.shape[-1:] if is_vector else (1,))
    value = broadcast(value, shape if is_vector else child.shape)
    slope, at, offset = _slopes(reshape(broadcast(parameters["loc"], value.shape), shape), of)
    off = subtract(reshape(value, shape), offset)
    if not is_vector:
        weight = divide(1.0, elementwise(np.square, broadcast(parameters["scale"], child.shape)))
        return _of_numbers(slope, off, weight, _Entries(at, of.count, child.mask))
    root = _inverse_root(parameters, shape)
    return _of_vectors(slope, off, root, _Entries(at, of.count, child.mask))


def covariance_added(
    child: Child, of: Moving, is_inverse: bool = False
) -> tuple[Expression, Expression]:
    """Degrees of freedom ``(count,)`` and scatter ``(count, d, d)`` of a covariance.

    Parameters
    ----------
    is_inverse : bool
        Of a precision instead: its inverse is the covariance.

    Raises
    ------
    TraceError
        It enters something else, or not as a multiple of itself, or of its inverse.
    """
    parameters, value = child.family.parameters, child.value
    if child.family.make is not MvNormal or child.read(of.name) != ["cov"]:
        raise TraceError("it enters no covariance")
    d = value.shape[-1]
    cov = broadcast(parameters["cov"], (*child.shape, d, d))
    times, at = (_inverse_multiples if is_inverse else _multiples)(cov, of.name, of.numbers)
    entries = _Entries(at, of.count, child.mask)
    off = subtract(value, broadcast(parameters["loc"], value.shape))
    scaled = divide(off, reshape(elementwise(np.sqrt, times), (*child.shape, 1)))
    return entries.total(broadcast(ONE, child.shape)), entries.outer(scaled, scaled)


def mean_by_label(sums: LabelSums, of: Moving) -> tuple[Expression, Expression]:
    """The same of a child that is summed by label, from its sums.

    Raises
    ------
    TraceError
        It is not in the mean alone, or not affinely.
    """
    labels, d = _normal_labels(sums)
    given = [v for k, v in sums.family.parameters.items() if k != "loc"]
    if any(of.name in v.leaves for v in given if isinstance(v, Expression)):
        raise TraceError("it is not in the mean alone")
    loc = broadcast(as_expression(sums.family.parameters["loc"]), (*sums.shape, d))
    slope, at, offset = _slopes(reshape(loc, (labels, d)), of)
    precision = reshape(precision_of(sums.family, sums.shape)[0], (labels, d, d))
    count, first, _ = _moments(sums)
    off = add(first, multiply(count, subtract(sums.centre, offset)))
    linear = product(np.matvec, precision, off)
    itself = np.eye(d, slope.shape[-1])
    if not (isinstance(slope, Constant) and is_all(subtract(slope, itself), 0)):
        linear = product(np.matvec, transposed(slope), linear)
        precision = product(np.matmul, product(np.matmul, transposed(slope), precision), slope)
    entries = _Entries(at, of.count, None)
    precision = multiply(reshape(count, (labels, 1, 1)), precision)
    return entries.total(precision), entries.total(linear)


def covariance_by_label(
    sums: LabelSums, of: Moving, is_inverse: bool = False
) -> tuple[Expression, Expression]:
    """The same of a child that is summed by label, from its sums.

    Raises
    ------
    TraceError
        It is not the covariance alone, or not a multiple of it, or of its inverse.
    """
    labels, d = _normal_labels(sums)
    cov = sums.family.parameters.get("cov")
    if cov is None or of.name in as_expression(sums.family.parameters["loc"]).leaves:
        raise TraceError("it is not the covariance alone")
    cov = reshape(broadcast(cov, (*sums.shape, d, d)), (labels, d, d))
    times, at = (_inverse_multiples if is_inverse else _multiples)(cov, of.name, of.numbers)
    scatter = divide(_about_loc(sums), reshape(times, (labels, 1, 1)))
    entries = _Entries(at, of.count, None)
    return entries.total(reshape(sums.column(0, 1), (labels,))), entries.total(scatter)


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Entries:
    """Entries of a term, and the element that each reads."""

    at: Expression
    count: int
    mask: np.ndarray | None

    def total(self, part: Expression) -> Expression:
        """Sums by element."""
        return total(part, self.at, self.count, self.mask)

    def outer(self, first: Expression, second: Expression) -> Expression:
        """Sums of outer products of ``(*entries, p)`` and ``(*entries, q)``: ``(count, p, q)``."""
        p, q = first.shape[-1], second.shape[-1]
        if not isinstance(self.at, Constant):
            lead = first.shape[:-1]
            wide = reshape(first, (*lead, p, 1)), reshape(second, (*lead, 1, q))
            return self.total(elementwise(np.multiply, *wide))
        at = self.at.value
        kept = at >= 0 if self.mask is None else (at >= 0) & np.broadcast_to(self.mask, at.shape)
        entries = np.flatnonzero(kept)
        entries = entries[np.argsort(at.reshape(-1)[entries], kind="stable")]
        ends = np.searchsorted(at.reshape(-1)[entries], np.arange(self.count + 1))
        rows = [
            pick([e], np.arange(e.size).reshape(-1, n)[entries])
            for e, n in ((first, p), (second, q))
        ]
        return call(_Outer(tuple(ends.tolist())), rows)

    def by_element(self, part: Expression) -> Expression | None:
        """Blocks that are the same for all entries of an element: ``(count, *block)``."""
        ndim = len(self.at.shape)
        once = same_along(part, range(ndim)) if ndim else part
        return None if once is None else broadcast(once, (self.count, *part.shape[ndim:]))


@dataclass(frozen=True)
class _Outer:
    """Sums of outer products of rows, between ends."""

    ends: tuple[int, ...]

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        left = np.matrix_transpose(first)
        sizes = set(np.diff(self.ends).tolist())
        if len(sizes) == 1:  # as many for each
            count, size = len(self.ends) - 1, max(sizes)
            split = [a.reshape(*a.shape[:-2], count, size, a.shape[-1]) for a in (first, second)]
            return np.matrix_transpose(split[0]) @ split[1]
        parts = [
            left[..., a:b] @ second[..., a:b, :]
            for a, b in zip(self.ends[:-1], self.ends[1:], strict=True)
        ]
        return np.stack(np.broadcast_arrays(*parts), axis=-3)


def _slopes(mean: Expression, of: Moving) -> tuple[Expression, Expression, Expression]:
    """Of means ``(*entries, m)`` the slopes in a vector ``(*entries, m, d)``, which one it is, and the rest.

    Raises
    ------
    TraceError
        They are not affine, or not in one element alone.
    """
    whole, own = alone(mean, of.name, of.numbers)
    if own is None:
        raise TraceError("it enters no mean")
    affine(whole, [own.name])
    at = element_read(reduction(np.add, whole, [-1]), own.name, of.numbers)
    units = [np.broadcast_to(row, own.shape) for row in np.eye(own.shape[-1])]
    slopes = [tangent(whole, {own.name: as_expression(u)}) for u in units]
    zero = as_expression(np.zeros(own.shape))
    return _stacked(slopes), at, substituted(whole, {own.name: zero})


def _multiples(cov: Expression, name: str, numbers: np.ndarray) -> tuple[Expression, Expression]:
    """By what covariances ``(*entries, d, d)`` multiply a matrix, and which one it is.

    Raises
    ------
    TraceError
        They are no multiples of one element.
    """
    d = cov.shape[-1]
    flat = np.arange(numbers.size).reshape(numbers.shape)
    found = statistics(cov, name, flat)
    if set(found.coefficients) != {1.0}:
        raise TraceError("it is no multiple")
    times = same_along(found.coefficients[1.0], [-1, -2])
    whole, own = alone(cov, name, flat)
    assert own is not None
    place = element_read(whole, own.name, flat % (d * d))
    at = same_along(element_read(whole, own.name, numbers), [-1, -2])
    in_place = np.broadcast_to(np.arange(d * d).reshape(d, d), place.shape)
    if times is None or at is None or place is not as_expression(in_place):
        raise TraceError("it is no multiple")
    # features say nothing of what is added
    if not _vanishes(affine(whole, [own.name]).offset):
        raise TraceError("it is a multiple and more")
    return times, at


def _inverse_multiples(
    cov: Expression, name: str, numbers: np.ndarray
) -> tuple[Expression, Expression]:
    """By what covariances ``(*entries, d, d)`` multiply the inverse of a matrix, and which one it is.

    Raises
    ------
    TraceError
        They are no multiples of the inverse of one element.
    """
    inverses = [
        n
        for n in ordered(cov)
        if isinstance(n, Call) and name in n.leaves and matrix_function(n) == "inv"
    ]
    if len(inverses) != 1:
        raise TraceError("it is not inverted, or more than once")
    (inverse,) = inverses
    own = leaf(_INVERSE, inverse.shape)
    outside = replaced(cov, {inverse: own})
    if name in outside.leaves:
        raise TraceError("it is no multiple of its inverse alone")
    block = inverse.shape[-1] ** 2
    which = np.arange(own.size).reshape(own.shape) // block
    times, place = _multiples(outside, _INVERSE, which)
    within, at = _multiples(inverse.operands[0], name, numbers)
    within, at = (gather(reshape(e, (own.size // block,)), place) for e in (within, at))
    return divide(times, within), at


def _vanishes(node: Expression) -> bool:
    """Whether an expression is zero whatever it reads, as far as this is seen."""
    if not isinstance(node, Gather | Pick | Elementwise):
        return is_all(node, 0)
    inner = [_vanishes(a) for a in node.operands]
    if isinstance(node, Gather):
        return inner[0]
    if isinstance(node, Elementwise) and node.function in (np.multiply, np.divide):
        return inner[0] or (inner[1] and node.function is np.multiply)
    choice = isinstance(node, Elementwise) and node.function is np.where
    same = isinstance(node, Pick) or node.function in (np.add, np.subtract, np.negative)
    return all(inner[1:] if choice else inner) if choice or same else False


def _stacked(parts: list[Expression]) -> Expression:
    """Side by side along a new last axis."""
    size, shape = parts[0].size, parts[0].shape
    at = np.arange(size).reshape(*shape, 1) + size * np.arange(len(parts))
    return pick(parts, at)


def _of_numbers(
    slope: Expression, off: Expression, weight: Expression, entries: _Entries
) -> tuple[Expression, Expression]:
    """Of slopes ``(*entries, 1, d)`` and what the offset leaves, ``(*entries, 1)``."""
    ndim = len(entries.at.shape)
    d = slope.shape[-1]
    rows = reshape(slope, (*slope.shape[:ndim], d))
    both = pick([rows, off], _joined(rows.shape, off.shape))
    same = entries.by_element(weight)
    if same is not None:
        sums = entries.outer(rows, both)
        sums = elementwise(np.multiply, sums, reshape(same, (entries.count, 1, 1)))
    else:
        wide = reshape(weight, (*weight.shape, 1))
        sums = entries.outer(elementwise(np.multiply, rows, wide), both)
    return _split(sums)


def _of_vectors(
    slope: Expression, off: Expression, root: Expression, entries: _Entries
) -> tuple[Expression, Expression]:
    """Of slopes ``(*entries, m, d)``, residuals ``(*entries, m)`` and what whitens them."""
    same_slope, same_root = entries.by_element(slope), entries.by_element(root)
    if same_slope is not None and same_root is not None:
        rows = product(np.matmul, same_root, same_slope)
        count = entries.total(broadcast(ONE, entries.at.shape))
        sums = entries.total(off)
        gram = product(np.matmul, transposed(rows), rows)
        precision = elementwise(np.multiply, gram, reshape(count, (entries.count, 1, 1)))
        white = product(np.matmul, same_root, reshape(sums, (*sums.shape, 1)))
        linear = product(np.matmul, transposed(rows), white)
        return precision, reshape(linear, linear.shape[:-1])
    ndim, (m, d) = len(entries.at.shape), slope.shape[-2:]
    both = pick([slope, off], _joined(slope.shape, (*off.shape, 1)))
    white = product(np.matmul, root, both)
    at = np.repeat(np.arange(entries.at.size), m).reshape(*entries.at.shape, m)
    wide = _Entries(pick([entries.at], at), entries.count, _expanded(entries.mask, ndim))
    rows = pick([white], np.arange(white.size).reshape(white.shape)[..., :d])
    return _split(wide.outer(rows, white))


def _expanded(mask: np.ndarray | None, ndim: int) -> np.ndarray | None:
    return None if mask is None else mask.reshape(*mask.shape, 1)


def _split(sums: Expression) -> tuple[Expression, Expression]:
    """Precision and linear term that stand side by side."""
    at = np.arange(sums.size).reshape(sums.shape)
    return pick([sums], at[..., :-1]), pick([sums], at[..., -1])


def _joined(first: Shape, second: Shape) -> np.ndarray:
    """Positions of two arrays side by side."""
    size = math.prod(first)
    at = np.arange(size).reshape(first)
    return np.concatenate([at, size + np.arange(math.prod(second)).reshape(second)], axis=-1)


def _inverse_root(parameters: dict[str, Any], shape: Shape) -> Expression:
    """What whitens residuals of vectors: ``(*entries, m, m)``."""
    entries, m = shape[:-1], shape[-1]
    if parameters.get("scale_diag") is not None:
        spread = broadcast(parameters["scale_diag"], (*parameters["scale_diag"].shape[:-1], m))
        wide = divide(as_expression(np.eye(m)), reshape(spread, (*spread.shape, 1)))
        return broadcast(wide, (*entries, m, m))
    factor: Any = parameters.get("scale_tril")
    factor = (
        np.linalg.cholesky(TracedArray(parameters["cov"]))
        if factor is None
        else TracedArray(factor)
    )
    found: Any = np.linalg.inv(factor)
    return broadcast(
        found.expression if isinstance(found, TracedArray) else found, (*entries, m, m)
    )


def _normal_labels(sums: LabelSums) -> tuple[int, int]:
    """How many labels there are, and the size of the normal vectors that they are of."""
    if sums.family.make is not MvNormal or sums.repeats != 1:
        raise TraceError("they are no normal vectors")
    return sums.states, len(sums.centre)


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
