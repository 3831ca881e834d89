"""Expected log densities of families whose parameters, and values, have distributions of their own.

Of most families the log density is taken as it stands (``passes.log_density``); of normal ones the quadratic
form is taken apart by hand, since a mean may share a distribution with the precision (normal-Wishart), and
since matrices are no element-wise functions.

References
----------
Bishop (2006), Pattern Recognition and Machine Learning, sec. 10.2; Gelman et al., Bayesian Data Analysis, 3rd
ed. (2013), sec. 3.6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions import (
    Categorical,
    InverseWishart,
    LogNormal,
    Multinomial,
    MvNormal,
    Normal,
    Wishart,
)
from bayesmc.expression import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Family,
    Leaf,
    Pick,
    TracedArray,
    broadcast,
    constant,
    elementwise,
    pick,
    reduction,
    replaced,
    reshape,
    substituted,
)
from bayesmc.passes.affine import affine
from bayesmc.passes.arithmetic import ONE, add, is_all, multiply, subtract, tidied, tidy
from bayesmc.passes.expectation import Expectation
from bayesmc.passes.log_density import log_density
from bayesmc.passes.reads import matrix_function

_LOG_2PI = math.log(2 * math.pi)


def expected_log_density(of: Expectation, family: Family, value: Expression) -> Expression:
    """The expectation of a family's log density at a value, as an expression of moments.

    Parameters
    ----------
    of : Expectation
    family : Family
    value : Expression, shape (*batch, *event)

    Raises
    ------
    NoMoment
        It is no sum of products that has one.
    TraceError
        The family has no closed form.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.expectation import Expectation
    >>> from bayesmc.passes.moments import Hidden, moment
    >>> from bayesmc.passes.expected_density import expected_log_density
    >>> family = trace(lambda m: bmc.Normal(m, 2.0), [TracedArray(leaf("m", ()))])
    >>> of = Expectation({"m": Hidden("m", "number", ())})
    >>> found = expected_log_density(of, family, leaf("y", ()))
    >>> values = {moment("m", "mean"): 1.0, moment("m", "cov"): np.full((1, 1, 1), 0.5), "y": 1.0}
    >>> float(evaluate([found], values)[0]), bmc.Normal(1.0, 2.0).log_prob(1.0) - 0.5 * 0.5 / 2.0**2
    (-1.674585713764618, np.float64(-1.674585713764618))
    """
    parameters = family.parameters
    if family.make in (Normal, LogNormal):
        x = elementwise(np.log, value) if family.make is LogNormal else value
        found = _normal(of, subtract(x, parameters["loc"]), parameters["scale"])
        return subtract(found, of(x)) if family.make is LogNormal else found
    if family.make is MvNormal:
        return _mv_normal(of, subtract(value, parameters["loc"]), parameters)
    if family.make in (Wishart, InverseWishart):
        return _matrix(of, value, parameters, family.make is InverseWishart)
    return of(tidied(plain_density(family, value)))


def plain_density(family: Family, value: Expression) -> Expression:
    """A log density whose probabilities are taken to sum to one, as families see to."""
    root = log_density(family, value)
    probs = family.parameters.get("probs")
    if family.make not in (Categorical, Multinomial) or not isinstance(probs, Expression):
        return root
    if not probs.leaves:
        return root
    p: Any = TracedArray(probs)
    norm = np.log(np.sum(p, axis=-1, keepdims=True)).expression
    return replaced(root, {norm: constant(np.zeros(norm.shape))})


def quadratic_moments(
    of: Expectation, loc: Expression, parameters: dict[str, Any], is_vector: bool
) -> tuple[Expression, Expression, Expression, Expression]:
    """What a normal says of a value that is known: ``y' P y``, ``y' b``, and what is free of y.

    Parameters
    ----------
    loc : Expression, shape (*batch, d)
        Its mean less a centre; of a number, d is 1.

    Returns
    -------
    tuple of Expression
        Expected precision P ``(*batch, d, d)``, b ``(*batch, d)``, expected quadratic form of the mean, and
        log determinant of the precision.
    """
    if not is_vector:
        scale = parameters["scale"]
        precision = of.power(scale, -2.0)
        mean = broadcast(of(loc), loc.shape)
        shape = np.broadcast_shapes(precision.shape, loc.shape[:-1])
        flat = pick([loc], np.arange(loc.size).reshape(loc.shape[:-1]))
        form = _scaled_square(of, flat, scale)
        logs = multiply(-2.0, of(elementwise(np.log, scale)))
        wide = reshape(broadcast(precision, shape), (*shape, 1))
        return reshape(wide, (*shape, 1, 1)), multiply(wide, mean), form, logs
    factors = _factors(of, parameters)
    precision, logs = factors.expected(of, -1.0), multiply(-1.0, factors.log_det(of))
    mean = broadcast(of(loc), loc.shape)
    linear = TracedArray(precision)
    b = np.matvec(linear, TracedArray(mean)).expression
    return precision, b, _form(of, loc, factors), logs


# ---- private ------------------------------------------------------------------------------------


def _normal(of: Expectation, off: Expression, scale: Expression) -> Expression:
    form = _scaled_square(of, off, scale)
    logs = of(elementwise(np.log, scale)) if of.names(scale) else elementwise(np.log, scale)
    return subtract(multiply(-0.5, form), add(logs, 0.5 * _LOG_2PI))


def _scaled_square(of: Expectation, off: Expression, scale: Expression) -> Expression:
    """The expectation of ``(off / scale)**2``."""
    if not of.names(off) or of.are_apart(off, scale):
        return multiply(of.cross(off, off), of.power(scale, -2.0))
    shape = np.broadcast_shapes(off.shape, scale.shape)
    off, scale = broadcast(off, shape), broadcast(scale, shape)
    name, gain, at = _own_mean(of, off, scale, 1)
    coefficient, read = _precision_read(of, scale)
    number = _numbers(of, read, 1)
    if not np.array_equal(np.broadcast_to(number, shape), at):
        raise of.refuse(off, f"mean {name!r} meets another scale than its own")
    rest = substituted(off, {name: of.hidden[name].moment("mean")})
    own = of.hidden[name].moment("spread")
    # of a precision L times (rest**2 + gain**2 spread / L) the scale drops out of the second part
    first = multiply(of.cross(rest, rest), of.power(scale, -2.0))
    second = multiply(multiply(of.cross(gain, gain), of(coefficient)), pick([own], at))
    return add(first, second)


def _own_mean(
    of: Expectation, off: Expression, other: Expression, inner: int
) -> tuple[str, Expression, np.ndarray]:
    """The one mean that shares its distribution with a scale: its name, its coefficient, which element."""
    scales = of.names(other)
    names = [n for n in of.names(off) if of.hidden[n].scale in scales]
    direct = of.names(off) & scales
    if len(names) != 1 or direct:
        raise of.refuse(off, "mean and scale hang together in a way that is not closed")
    form = affine(off, names)
    read = form.reads[names[0]]
    if read.at.shape[-1] != 1 or not isinstance(read.at, Constant):
        raise of.refuse(off, f"several elements of {names[0]!r} meet one scale")
    shape = off.shape
    gain = pick([read.gain], np.arange(read.gain.size).reshape(read.gain.shape)[..., 0])
    if of.names(form.offset) & {names[0]} or not of.are_apart(form.offset, other):
        raise of.refuse(off, "mean and scale hang together in a way that is not closed")
    return names[0], broadcast(gain, shape), np.broadcast_to(read.at.value[..., 0], shape)


def _precision_read(of: Expectation, scale: Expression) -> tuple[Expression, Expression]:
    """A precision as a coefficient times a power of elements of one leaf."""
    coefficient, powers = of._monomial(scale)
    if len(powers) != 1:
        raise of.refuse(scale, "several scales are multiplied")
    ((read, _),) = powers.items()
    return tidy(np.power, coefficient, -2.0), read


def _numbers(of: Expectation, read: Expression, inner: int) -> np.ndarray:
    """Which element of its leaf each entry reads, ``inner`` numbers to each."""
    (name,) = of.names(read)
    own = of.hidden[name]
    flat = constant(np.arange(int(np.prod(own.shape, dtype=int))).reshape(own.shape) // inner)
    return substituted(read, {name: flat}).value  # type: ignore[attr-defined]


# ---- vectors ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Factors:
    """A matrix as a number times a power of another: free of hidden leaves, or matrices of one leaf."""

    coefficient: Expression
    base: Expression
    power: float

    def expected(self, of: Expectation, exponent: float) -> Expression:
        """The expectation of the matrix, or of its inverse."""
        p, base = self.power * exponent, self.base
        if of.names(base):
            (name,) = of.names(base)
            own = of.hidden[name].moment("x" if p > 0 else "inv")
            matrix = substituted(base, {name: own})
        else:
            matrix = base if p > 0 else _inverse(base)
        if is_all(self.coefficient, 1.0):
            return matrix
        number = of.power(self.coefficient, exponent)
        return multiply(matrix, reshape(number, (*number.shape, 1, 1)))

    def log_det(self, of: Expectation) -> Expression:
        base, d = self.base, self.base.shape[-1]
        if of.names(base):
            (name,) = of.names(base)
            own = of.hidden[name].moment("log")
            found = pick([own], self.groups(of))
        else:
            root: Any = np.linalg.cholesky(TracedArray(base))
            logs: Any = np.log(np.linalg.diagonal(root))
            found = (2.0 * np.sum(logs, axis=-1)).expression if base.leaves else _log_det(base)
        found = multiply(self.power, found)
        if is_all(self.coefficient, 1.0):
            return found
        return add(found, multiply(float(d), of(elementwise(np.log, self.coefficient))))

    def groups(self, of: Expectation) -> np.ndarray:
        """Which matrix of its leaf each entry is."""
        d = self.base.shape[-1]
        return _numbers(of, self.base, d * d)[..., 0, 0]


def _inverse(matrix: Expression) -> Expression:
    if isinstance(matrix, Constant):
        return constant(np.linalg.inv(matrix.value))
    found: Any = np.linalg.inv(TracedArray(matrix))
    return found.expression


def _log_det(matrix: Expression) -> Expression:
    return constant(np.linalg.slogdet(matrix.value)[1])  # type: ignore[attr-defined]


def _factors(of: Expectation, parameters: dict[str, Any]) -> _Factors:
    tril, diag = parameters.get("scale_tril"), parameters.get("scale_diag")
    if diag is not None:
        if of.names(diag):
            raise of.refuse(diag, "scale_diag has no expectation in closed form")
        eye: Any = np.eye(diag.shape[-1])
        return _Factors(
            ONE, multiply(eye, reshape(elementwise(np.square, diag), (*diag.shape, 1))), 1
        )
    if tril is not None:
        if isinstance(tril, Call) and matrix_function(tril) == "cholesky":
            return _factored(of, tril.operands[0])
        if of.names(tril):
            raise of.refuse(tril, "scale_tril has no expectation in closed form")
        root: Any = TracedArray(tril)
        return _Factors(ONE, np.matmul(root, np.swapaxes(root, -1, -2)).expression, 1)
    return _factored(of, parameters["cov"])


def _factored(of: Expectation, node: Expression) -> _Factors:
    if not of.names(node):
        return _Factors(ONE, node, 1.0)
    inner = node
    while isinstance(inner, Pick) and len(inner.operands) == 1:
        (inner,) = inner.operands
    if isinstance(inner, Leaf):
        d = node.shape[-1]
        numbers = _numbers(of, node, 1)
        first = numbers[..., :1, :1]
        whole = numbers - first == np.arange(d * d).reshape(d, d)
        if of.hidden[inner.name].kind == "matrix" and whole.all() and (first % (d * d) == 0).all():
            return _Factors(ONE, node, 1.0)
    if isinstance(node, Pick) and not isinstance(inner, Leaf):
        moved = _moved_inside(of, node)
        if moved is not None:
            return moved
    if isinstance(node, Call) and matrix_function(node) == "inv":
        own = _factored(of, node.operands[0])
        return _Factors(tidy(np.power, own.coefficient, -1.0), own.base, -own.power)
    if isinstance(node, Elementwise) and node.function in (np.multiply, np.divide):
        first_, second = node.operands
        if node.function is np.multiply and _is_scalar(first_):
            first_, second = second, first_
        if _is_scalar(second):
            own = _factored(of, broadcast(first_, node.shape))
            number = pick([second], np.arange(second.size).reshape(second.shape[:-2] or ()))
            return _Factors(tidy(node.function, own.coefficient, number), own.base, own.power)
    raise of.refuse(node, "it is no multiple of a matrix, or of its inverse")


def _is_scalar(node: Expression) -> bool:
    return node.shape[-2:] in ((), (1, 1)) and node.size == int(np.prod(node.shape[:-2], dtype=int))


def _moved_inside(of: Expectation, node: Pick) -> _Factors | None:
    """Whole matrices picked of a product: the same of its parts."""
    if len(node.operands) != 1:
        return None
    (whole,) = node.operands
    d = node.shape[-1]
    at = node.positions
    first = at[..., :1, :1]
    if whole.shape[-2:] != (d, d) or not (at - first == np.arange(d * d).reshape(d, d)).all():
        return None
    if (first % (d * d)).any():
        return None
    own = _factored(of, whole)
    batch = whole.shape[:-2]
    base = pick([broadcast(own.base, whole.shape)], at)
    number = pick([broadcast(own.coefficient, batch)], first[..., 0, 0] // (d * d))
    return _Factors(number, base, own.power)


def _mv_normal(of: Expectation, off: Expression, parameters: dict[str, Any]) -> Expression:
    factors = _factors(of, parameters)
    form, logs = _form(of, off, factors), factors.log_det(of)
    size = off.shape[-1]
    return multiply(-0.5, add(add(form, logs), size * _LOG_2PI))


def _form(of: Expectation, off: Expression, factors: _Factors) -> Expression:
    """The expectation of ``off' C^-1 off``."""
    precision = factors.expected(of, -1.0)
    scale = factors.base if of.names(factors.base) else factors.coefficient
    if not of.names(off) or of.are_apart(off, scale):
        return _traced(of, off, precision)
    d = off.shape[-1]
    batch = np.broadcast_shapes(off.shape[:-1], factors.base.shape[:-2])
    off = broadcast(off, (*batch, d))
    name, gain, at = _own_mean(of, off, factors.base, d)
    same = np.broadcast_to(factors.groups(of)[..., None] * d + np.arange(d), off.shape)
    of_one = _same_along(gain)
    if factors.power not in (1.0, -1.0) or not np.array_equal(same, at) or of_one is None:
        raise of.refuse(off, f"mean {name!r} meets another covariance than its own")
    rest = substituted(off, {name: of.hidden[name].moment("mean")})
    own = pick([of.hidden[name].moment("spread")], at[..., 0] // d)
    number = of.power(factors.coefficient, -1.0)
    second = multiply(multiply(of.cross(of_one, of_one), number), multiply(own, float(d)))
    return add(_traced(of, rest, precision), second)


def _same_along(gain: Expression) -> Expression | None:
    """A coefficient without its last axis, along which it is the same."""
    at = np.arange(gain.size).reshape(gain.shape)
    first = pick([gain], at[..., 0])
    return first if broadcast(reshape(first, (*first.shape, 1)), gain.shape) is gain else None


def _traced(of: Expectation, off: Expression, precision: Expression) -> Expression:
    """``sum_ij precision_ij E[off_i off_j]``."""
    d = off.shape[-1]
    if not of.names(off):
        inner: Any = np.matvec(TracedArray(precision), TracedArray(off))
        return np.vecdot(inner, TracedArray(off)).expression
    shape = (*off.shape[:-1], d, d)
    one = broadcast(reshape(off, (*off.shape, 1)), shape)
    two = broadcast(reshape(off, (*off.shape[:-1], 1, d)), shape)
    whole = multiply(of.cross(one, two), precision)
    return reduction(np.add, whole, (-2, -1))


def _matrix(
    of: Expectation, value: Expression, parameters: dict[str, Any], is_inverse: bool
) -> Expression:
    """Log densities of Wishart and inverse Wishart."""
    df, scale = parameters["df"], parameters["scale"]
    d = value.shape[-1]
    if of.names(df):
        raise of.refuse(df, "degrees of freedom have no expectation in closed form")
    own, given = _factored(of, value), _factored(of, scale)
    if not of.are_apart(value, scale):
        raise of.refuse(value, "a matrix and its own scale hang together")
    x, v = (own.expected(of, -1.0), given.expected(of, 1.0)) if is_inverse else (
        own.expected(of, 1.0), given.expected(of, -1.0))  # fmt: skip
    whole = multiply(x, v)
    trace = reduction(np.add, whole, (-2, -1))
    halves: Any = 0.5 * (np.reshape(TracedArray(df), (*df.shape, 1)) - np.arange(d))
    norm = add(
        multiply(df, 0.5 * d * math.log(2.0)),
        add(0.25 * d * (d - 1) * math.log(math.pi), np.sum(special.gammaln(halves), axis=-1).expression),
    )  # fmt: skip
    sign = 1.0 if is_inverse else -1.0
    power = add(multiply(-0.5 * sign, df), -0.5 * (d + 1))
    logs = add(
        multiply(multiply(0.5 * sign, df), given.log_det(of)), multiply(power, own.log_det(of))
    )
    return subtract(subtract(logs, multiply(0.5, trace)), norm)
