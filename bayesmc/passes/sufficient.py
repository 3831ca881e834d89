"""Exponential families found in their densities: sufficient statistics and natural parameters.

``log p(y) = sum_j coefficients[j] * statistics[j](y)`` up to what depends on ``y`` alone, with coefficients
that are free of ``y``. Nothing here knows families but one: that of normal vectors, whose matrices are no
element-wise functions.

References
----------
Wainwright and Jordan (2008), Graphical Models, Exponential Families, and Variational Inference, sec. 3;
Barndorff-Nielsen (1978), Information and Exponential Families.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions import Categorical, MvNormal
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Family,
    as_expression,
    broadcast,
    call,
    constant,
    elementwise,
    expressions_of,
    leaf,
    ordered,
    pick,
    reduction,
    replaced,
    reshape,
)
from bayesmc.expression.scalars import upper_inverse
from bayesmc.passes.arithmetic import ONE, ZERO, TermReader, add, divide, is_all, multiply, subtract
from bayesmc.passes.log_density import log_density
from bayesmc.shapes import Shape

#: name of the leaf that statistics are functions of
VALUE = "\0value"
#: how far probabilities may be off one
_SUM = 1e-8
#: statistic -> coefficient
Form = dict[Expression, Expression]


@dataclass(frozen=True, eq=False)
class NaturalForm:
    """A log density as a sum of statistics of the value times coefficients, at values in the support.

    Attributes
    ----------
    statistics : tuple of Expression, shape ()
        Of the leaf ``VALUE``, which stands for the value less a centre. The first is 1.
    coefficients : tuple of Expression, shape (*batch)
        One for each: the natural parameters; of the first, minus the log normaliser.
    indicators : bool
        Whether every statistic is 0 or 1.
    """

    statistics: tuple[Expression, ...]
    coefficients: tuple[Expression, ...]
    indicators: bool = False


def natural_form(family: Family, centre: Any = 0.0, log_centre: float = 0.0) -> NaturalForm:
    """The statistics of a family and their coefficients.

    Parameters
    ----------
    family : Family
        Of numbers, or of normal vectors.
    centre : float or ndarray, shape the event
        Near the values: products of coefficients and statistics about it do not cancel.
    log_centre : float
        Near their logarithms.

    Raises
    ------
    TraceError
        It is not of exponential family, or not seen to be.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.sufficient import natural_form
    >>> family = trace(lambda r: bmc.Poisson(r), [TracedArray(leaf("r", ()))])
    >>> form = natural_form(family)
    >>> [type(s).__name__ for s in form.statistics]  # 1, and the value
    ['Constant', 'Leaf']
    >>> [float(c) for c in evaluate(form.coefficients, {"r": 1.0})]  # minus the rate, and its logarithm
    [-1.0, 0.0]
    """
    if family.make is MvNormal:
        return _of_vectors(family, np.asarray(centre, dtype=float))
    value = add(leaf(VALUE, ()), centre)
    return _found(_Reader(value, log_centre)(log_density(family, value)))


def tabulated(family: Family, values: np.ndarray) -> NaturalForm:
    """The same for a family of numbers of which a few come: how often each does, and its log density.

    Parameters
    ----------
    values : ndarray, shape (m,)
        All different.

    Raises
    ------
    TraceError
        The family has no closed form.
    """
    y = leaf(VALUE, ())
    logs = log_probabilities(family, values)
    block = np.arange(logs.size).reshape(logs.shape)
    hot = [elementwise(np.equal, y, float(v)) for v in values]
    return NaturalForm((ONE, *hot), (ZERO, *(pick([logs], at) for at in block)), True)


def log_probabilities(family: Family, values: np.ndarray) -> Expression:
    """Log densities of a family of numbers at known values ``(m,)``, shape ``(m, *batch)``.

    NaN where the probabilities of categories do not sum to one.

    Raises
    ------
    TraceError
        The family has no closed form.
    """
    parameters = expressions_of(family)
    ndim = max((len(e.shape) for e in parameters), default=0)
    log = log_density(family, as_expression(values.reshape((-1,) + (1,) * ndim)))
    probs = family.parameters.get("probs")
    if family.make is Categorical and probs is not None:
        log = add(log, _off_one(probs))
    return log if ndim == 0 else _squeezed(log, len(values))


# ---- private ------------------------------------------------------------------------------------


def _found(form: Form) -> NaturalForm:
    form = {f: _guarded(c) for f, c in form.items()}
    first = form.pop(ONE, ZERO)
    kept = {f: c for f, c in form.items() if not _is_uniform(c)}
    return NaturalForm((ONE, *kept), (first, *kept.values()))


def _is_uniform(node: Expression) -> bool:
    """Whether an expression is one number, known and the same all over."""
    return isinstance(node, Constant) and is_all(node, np.ravel(node.value)[0])


def _guarded(coefficient: Expression) -> Expression:
    """NaN where a concentration is not positive, of which the log of the gamma function does not tell."""
    instead: dict[Expression, Expression] = {
        n: elementwise(np.where, elementwise(np.greater, n.operands[0], 0), n, np.nan)
        for n in ordered(coefficient)
        if isinstance(n, Elementwise) and n.function is special.gammaln and n.leaves
    }
    return replaced(coefficient, instead) if instead else coefficient


def _squeezed(log: Expression, count: int) -> Expression:
    """Without the axes of size one behind the first that no parameter has."""
    shape = log.shape[1:]
    while shape and shape[0] == 1:
        shape = shape[1:]
    return reshape(log, (count, *shape))


def _off_one(probs: Expression) -> Expression:
    """Zero, NaN where probabilities do not sum to one."""
    total = reduction(np.add, probs, (-1,))
    off = elementwise(np.abs, subtract(total, 1.0))
    return elementwise(np.where, elementwise(np.less_equal, off, _SUM), 0.0, np.nan)


class _Reader(TermReader):
    """Splits expressions of one number and parameters into statistics and coefficients."""

    one = ONE

    def __init__(self, value: Expression, log_centre: float) -> None:
        super().__init__()
        self.value, self.log_centre = value, as_expression(float(log_centre))

    def is_free(self, node: Expression) -> bool:
        return VALUE not in node.leaves

    def term(self, node: Expression) -> Form:
        if node.leaves == {VALUE} and not node.shape and not isinstance(node, Call):
            return {node: ONE}
        raise TraceError(
            f"{node.detail or type(node).__name__} keeps value and parameters together"
        )

    def multiply(self, node: Elementwise) -> Form:
        return _product(*map(self, node.operands))

    def divide(self, node: Elementwise) -> Form:
        first, second = node.operands
        if VALUE not in second.leaves:
            return {f: divide(c, second) for f, c in self(first).items()}
        if second.leaves == {VALUE} and not second.shape:
            return _product(self(first), {elementwise(np.divide, 1.0, second): ONE})
        ((f, c),) = _single(self(second)).items()
        return _product(self(first), {elementwise(np.divide, 1.0, f): divide(1.0, c)})

    def square(self, node: Elementwise) -> Form:
        inner = self(node.operands[0])
        return _product(inner, inner)

    def log(self, node: Elementwise) -> Form:
        if node.function is np.log and node.operands[0] is self.value:
            return {subtract(node, self.log_centre): ONE, ONE: self.log_centre}
        if node.leaves == {VALUE} and not node.shape:
            return {node: ONE}
        if node.function is np.log1p:
            raise TraceError("log1p keeps value and parameters together")
        ((f, c),) = _single(self(node.operands[0])).items()
        return {elementwise(np.log, f): ONE, ONE: elementwise(np.log, c)}

    def xlogy(self, node: Elementwise) -> Form:
        weight, inside = node.operands
        plain = np.log if node.function is special.xlogy else np.log1p
        if node.leaves == {VALUE} and not node.shape:
            return {node: ONE}
        return _product(self(weight), self(elementwise(plain, inside)))

    def where(self, node: Elementwise) -> Form:
        condition, first, second = node.operands
        if is_all(second, -np.inf) and condition.leaves <= {VALUE}:
            return self(first)  # in the support, that is
        if condition.leaves == {VALUE} and not condition.shape:
            one, other = self(first), self(second)
            found: Form = {}
            for part, turned in ((one, False), (other, True)):
                for f, c in part.items():
                    sides = (ZERO, f) if turned else (f, ZERO)
                    chosen = elementwise(np.where, condition, *sides)
                    found[chosen] = add(found.get(chosen, ZERO), c)
            return found
        if VALUE not in condition.leaves:
            one, other = self(first), self(second)
            return {
                f: elementwise(np.where, condition, one.get(f, ZERO), other.get(f, ZERO))
                for f in {**one, **other}
            }
        raise TraceError("a branch on value and parameters together")


def _single(form: Form) -> Form:
    found = {f: c for f, c in form.items() if not is_all(c, 0)}
    if len(found) != 1:
        raise TraceError("a function of a sum keeps value and parameters together")
    return found


def _product(first: Form, second: Form) -> Form:
    found: Form = {}
    for f, u in first.items():
        for g, v in second.items():
            both = _times(f, g)
            found[both] = add(found.get(both, ZERO), multiply(u, v))
    return found


def _times(f: Expression, g: Expression) -> Expression:
    """The product of two statistics."""
    if f is ONE or g is ONE:
        return g if f is ONE else f
    return elementwise(np.multiply, f, g)


_Reader.rules = {
    np.add: _Reader.add, np.subtract: _Reader.add, np.negative: _Reader.negative,
    np.multiply: _Reader.multiply, np.divide: _Reader.divide, np.square: _Reader.square,
    np.log: _Reader.log, np.log1p: _Reader.log, special.xlogy: _Reader.xlogy,
    special.xlog1py: _Reader.xlogy, np.where: _Reader.where,
}  # fmt: skip


# ---- normal vectors -----------------------------------------------------------------------------


def precision_of(family: Family, batch: Shape) -> tuple[Expression, Expression]:
    """Inverse covariances of normal vectors, and half their log determinants.

    Parameters
    ----------
    family : Family of ``MvNormal``
    batch : tuple of int
        What its parameters are broadcast to.

    Returns
    -------
    tuple of Expression, shapes (*batch, d, d) and (*batch)
    """
    root = _root(family)
    diagonal = pick([root], np.arange(root.size).reshape(root.shape).diagonal(axis1=-2, axis2=-1))
    half = reduction(np.add, elementwise(np.log, diagonal), (-1,))
    precision = call(np.matmul, [root, transposed(root)])
    return broadcast(precision, batch + precision.shape[-2:]), broadcast(half, batch)


def transposed(matrix: Expression) -> Expression:
    """The last two axes exchanged."""
    return pick([matrix], np.arange(matrix.size).reshape(matrix.shape).swapaxes(-1, -2))


def _root(family: Family) -> Expression:
    """Upper triangles R with precision ``R R'``."""
    given = family.parameters
    if given.get("scale_diag") is not None:
        diag = given["scale_diag"]
        eye = constant(np.eye(diag.shape[-1]))
        return divide(eye, reshape(diag, (*diag.shape, 1)))
    tril = given.get("scale_tril")
    if tril is None:
        tril = call(np.linalg.cholesky, [given["cov"]])
    return call(upper_inverse, [transposed(tril)])


def _of_vectors(family: Family, centre: np.ndarray) -> NaturalForm:
    loc = subtract(as_expression(family.parameters["loc"]), centre)
    d = loc.shape[-1]
    root = _root(family)
    batch = np.broadcast_shapes(root.shape[:-2], loc.shape[:-1])
    precision, half = precision_of(family, batch)
    loc = broadcast(loc, (*batch, d))
    linear = call(np.matvec, [precision, loc])
    first = subtract(half, multiply(0.5, call(np.vecdot, [linear, loc])))
    y = leaf(VALUE, (d,))
    ys = [pick([y], i) for i in range(d)]
    statistics, coefficients = [ONE, *ys], [first]
    coefficients += [_component(linear, (i,)) for i in range(d)]
    for i, j in np.transpose(np.tril_indices(d)).tolist():
        statistics.append(elementwise(np.multiply, ys[i], ys[j]))
        coefficients.append(multiply(_component(precision, (i, j)), -0.5 if i == j else -1.0))
    kept = [k for k, c in enumerate(coefficients) if not k or not _is_uniform(c)]
    return NaturalForm(tuple(statistics[k] for k in kept), tuple(coefficients[k] for k in kept))


def _component(node: Expression, at: tuple[int, ...]) -> Expression:
    """One element of the last axes."""
    place: Any = (Ellipsis, *at)
    return pick([node], np.arange(node.size).reshape(node.shape)[place])
