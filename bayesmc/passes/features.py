"""A log density as a sum of features of one leaf with coefficients that are free of it.

Features are 1, ``x**p``, ``log x`` and ``log(1 - x)``: with these, densities in a node's blanket that are
of exponential families add up to its full conditional by adding coefficients.

References
----------
Wainwright and Jordan (2008), Graphical Models, Exponential Families, and Variational Inference, sec. 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import special

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Call,
    Elementwise,
    Expression,
    Leaf,
    Pick,
    as_expression,
    broadcast,
    elementwise,
    leaf,
    ordered,
    replaced,
)
from bayesmc.passes.arithmetic import (
    ONE,
    ZERO,
    TermReader,
    add,
    divide,
    is_all,
    multiply,
    subtract,
    tidied,
    tidy,
)
from bayesmc.passes.branches import branches_up
from bayesmc.passes.reads import NOTHING, element_read, matrix_function, reads, sunk

#: powers p of ``x**p``, and the two logarithms
Feature = float | str
LOG, LOG1M, CONSTANT = "log x", "log(1 - x)", 0.0
Features = dict[Feature, Expression]
#: powers beyond which no product is worked out for a family: it may be twice as long as what is multiplied
_MOST = 16


@dataclass(frozen=True, eq=False)
class Statistics:
    """``sum_f coefficients[f] * f(x)`` for every entry, where x is the element that the entry reads.

    Attributes
    ----------
    coefficients : dict
        Feature (a power of x, ``LOG`` or ``LOG1M``) -> expression of the shape of the entries.
    at : Expression of whole numbers
        Number of the element of the leaf that each entry reads, -1 where it reads none.
    is_picked : bool
        Whether it hangs on other leaves whether an entry reads its element.
    """

    coefficients: Features
    at: Expression
    is_picked: bool = False


def statistics(
    density: Expression,
    name: str,
    numbers: np.ndarray | None = None,
    strict: bool = True,
    is_share: bool = True,
) -> Statistics:
    """The features of a log density in a leaf, entry by entry.

    Parameters
    ----------
    density : Expression
    name : str
        Each entry reads one element of it.
    numbers : ndarray of int, shape of the leaf
        The element that each number of the leaf belongs to, itself by default; -1 for those that are
        taken as given.
    strict : bool
        Whether to refuse entries that have features for some values of other leaves only. If not,
        coefficients are NaN for all others.
    is_share : bool
        Whether it is between 0 and 1, so that one minus it may be meant.

    Raises
    ------
    TraceError
        An entry reads several elements, or something else than features of one.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.features import statistics
    >>> from bayesmc.passes.log_density import log_density
    >>> family = trace(lambda m: bmc.Normal(3 * m, 2.0), [TracedArray(leaf("m", ()))])
    >>> found = statistics(log_density(family, leaf("y", ())), "m")
    >>> sorted(found.coefficients)
    [1.0, 2.0]
    """
    whole, own = alone(density, name, numbers)
    if own is None:
        return Statistics({}, broadcast(NOTHING, density.shape))
    at = element_read(whole, own.name, own_numbers(own, numbers))
    # shapes are those of the entries, so that coefficients keep theirs
    instead: dict[Expression, Expression] = {
        r: leaf(own.name, r.shape) for r in reads(whole, own.name)
    }
    reader = _Reader(own.name, strict, is_share)
    found = reader(replaced(whole, instead))
    kept = {
        f: broadcast(c, density.shape)
        for f, c in found.items()
        if f != CONSTANT and not is_all(c, 0)
    }
    return Statistics(kept, at, reader.is_picked)


def alone(
    root: Expression, name: str, numbers: np.ndarray | None
) -> tuple[Expression, Leaf | None]:
    """An expression with a leaf of its own for the elements that are not given, and that leaf.

    All choices of elements are made near to it; it is None where the leaf does not occur.
    """
    own = next((n for n in ordered(root) if isinstance(n, Leaf) and n.name == name), None)
    if own is None:
        return root, None
    element = leaf(f"element of {name}", own.shape)
    moving: Expression = element
    if numbers is not None and (numbers < 0).any():
        moving = elementwise(np.where, numbers.reshape(own.shape) >= 0, element, own)
    whole = sunk(tidied(replaced(root, {own: moving})), element.name)
    return sunk(branches_up(whole, element.name), element.name), element


def own_numbers(own: Leaf, numbers: np.ndarray | None) -> np.ndarray:
    """The numbers of the elements of a leaf, its own by default."""
    return np.arange(own.size).reshape(own.shape) if numbers is None else numbers.reshape(own.shape)


# ---- private ------------------------------------------------------------------------------------


class _Reader(TermReader):
    """Features of expressions in one number."""

    one = CONSTANT

    def __init__(self, name: str, strict: bool, is_share: bool) -> None:
        super().__init__()
        self.name, self.strict, self.is_share = name, strict, is_share
        self.is_picked = False

    def is_free(self, node: Expression) -> bool:
        return self.name not in node.leaves

    def term(self, node: Expression) -> Features:
        if isinstance(node, Leaf):
            return {1.0: ONE}
        if isinstance(node, Call):
            return self.matrices(node)
        raise TraceError(f"{node.detail or type(node).__name__} of it is no feature")

    # ---- element by element ------------------------------------------------------------------------

    def multiply(self, node: Elementwise) -> Features:
        first, second = node.operands
        if self.is_free(first):
            return {f: multiply(c, first) for f, c in self(second).items()}
        if self.is_free(second):
            return {f: multiply(c, second) for f, c in self(first).items()}
        if first is second:
            return _square(_powers(self(first)))
        return _product(_powers(self(first)), _powers(self(second)))

    def divide(self, node: Elementwise) -> Features:
        first, second = node.operands
        if self.is_free(second):
            return {f: divide(c, second) for f, c in self(first).items()}
        powers = _powers(self(second))
        below = self.each(powers, lambda c: divide(1.0, c), lambda p, c: (-p, divide(1.0, c)))
        return _product(_powers(self(first)), below)

    def square(self, node: Elementwise) -> Features:
        return _square(_powers(self(node.operands[0])))

    def power(self, node: Elementwise) -> Features:
        base, exponent = node.operands
        if not is_constant(exponent):
            raise TraceError("a power that varies of it is no feature")
        e = float(np.ravel(exponent.value)[0])  # type: ignore[attr-defined]
        inner = _powers(self(base))
        if e == 2.0:
            return _square(inner)
        return self.each(
            inner, lambda c: tidy(np.power, c, e), lambda p, c: (p * e, tidy(np.power, c, e))
        )

    def root(self, node: Elementwise) -> Features:
        function = node.function
        e = {np.sqrt: 0.5, np.reciprocal: -1.0, np.cbrt: 1 / 3}[function]  # type: ignore[index]
        of = partial(elementwise, function)
        return self.each(_powers(self(node.operands[0])), of, lambda p, c: (p * e, of(c)))

    def log(self, node: Elementwise) -> Features:
        inner = dict(self(node.operands[0]))
        if node.function is np.log1p:
            inner[CONSTANT] = add(inner.get(CONSTANT, ZERO), ONE)
        inner = _powers(inner)
        rest = set(inner) == {CONSTANT, 1.0} and subtract(ZERO, inner[1.0]) is inner[CONSTANT]
        if rest:
            return {LOG1M: ONE, CONSTANT: elementwise(np.log, inner[CONSTANT])}
        of = partial(elementwise, np.log)
        found = self.each(inner, of, lambda p, c: (LOG, as_expression(p)), of_rest=True)
        if LOG in found and len(inner) == 1:
            ((_, coefficient),) = inner.items()
            found[CONSTANT] = of(coefficient)
        return found

    def each(self, found: Features, of_free: Any, of_power: Any, of_rest: bool = False) -> Features:
        """A function of a power of it; of what is that in some entries, and free of it in others.

        With ``of_rest``, it may also be a multiple of one minus it, of which the function is the logarithm.
        """
        if len(found) == 1:
            ((power, coefficient),) = found.items()
            feature, made = of_power(power, coefficient)
            return {feature: made}
        if len(found) != 2 or CONSTANT not in found:
            raise TraceError("a function of a sum of its powers is no feature")
        (power,) = (f for f in found if f != CONSTANT)
        free, own = found[CONSTANT], found[power]
        varies = elementwise(np.not_equal, own, 0.0)
        mine = elementwise(np.logical_and, varies, elementwise(np.equal, free, 0.0))
        feature, made = of_power(power, tidy(np.where, mine, own, ONE))
        plain = of_free(tidy(np.where, varies, ONE, free))
        result: Features = {
            CONSTANT: tidy(np.where, varies, ZERO, plain),
            feature: tidy(np.where, mine, made, ZERO),
        }
        closed = mine
        if of_rest and self.is_share and power == 1.0:
            rest = elementwise(
                np.logical_and, varies, elementwise(np.equal, free, multiply(own, -1.0))
            )
            result[LOG1M] = tidy(np.where, rest, ONE, ZERO)
            closed = elementwise(np.logical_or, mine, rest)
        closed = elementwise(np.logical_or, closed, elementwise(np.logical_not, varies))
        lost = tidy(np.where, closed, ZERO, as_expression(np.nan))
        if not is_all(lost, 0):
            if self.strict:
                raise TraceError("a function of a sum of its powers is no feature")
            self.is_picked = True
        result[feature] = add(result[feature], lost)
        return result

    def matrices(self, node: Call) -> Features:
        """Functions of matrices that are a power of it times a matrix."""
        ways = {"cholesky": 0.5, "inv": -1.0, "upper_inverse": -1.0}
        word = matrix_function(node)
        if word in ways:
            (operand,) = node.operands
            ((power, c),) = _single(_powers(self(operand))).items()
            made = node.with_operands([broadcast(c, operand.shape)])
            return {power * ways[word]: made}  # type: ignore[operator]
        if word == "solve":
            matrix, right = node.operands
            ((power, c),) = _single(_powers(self(matrix))).items()
            whole = broadcast(c, matrix.shape)
            return {
                f - power: node.with_operands([whole, broadcast(r, right.shape)])  # type: ignore[operator]
                for f, r in _powers(self(right)).items()
            }
        raise TraceError(f"{node.detail} of it is no feature")

    def xlogy(self, node: Elementwise) -> Features:
        weight, inside = node.operands
        if not self.is_free(weight):
            raise TraceError(f"{node.detail} of it is no feature")
        plain = np.log if node.function is special.xlogy else np.log1p
        inner = self(elementwise(plain, inside))
        return {f: multiply(c, weight) for f, c in inner.items()}

    def where(self, node: Elementwise) -> Features:
        condition, first, second = node.operands
        if is_all(second, -np.inf):  # a support: its bounds are the family's affair
            return self(first)
        if not self.is_free(condition):
            raise TraceError("a branch on it is no feature")
        one, other = self(first), self(second)
        free = [a for a in (first, second) if self.is_free(a)]
        self.is_picked = self.is_picked or (len(free) == 1 and not is_all(free[0], 0))
        return {
            f: tidy(np.where, condition, one.get(f, ZERO), other.get(f, ZERO))
            for f in {**one, **other}
        }


def is_constant(node: Expression) -> bool:
    """Whether an expression is one number, known and the same all over."""
    value = getattr(node, "value", None)
    return value is not None and bool((value == np.ravel(value)[0]).all())


def _powers(found: Features) -> Features:
    if LOG in found or LOG1M in found:
        raise TraceError("a product with a logarithm of it is no feature")
    kept = {f: c for f, c in found.items() if not _is_zero(c)}
    return kept or {CONSTANT: ZERO}


def _is_zero(node: Expression) -> bool:
    """Whether a coefficient is 0 for all finite values."""
    if isinstance(node, Elementwise) and node.function is np.multiply:
        return any(map(_is_zero, node.operands))
    if isinstance(node, Pick):
        return all(map(_is_zero, node.operands))
    return is_all(node, 0)


def _square(found: Features) -> Features:
    squares: dict[Any, Expression] = {}
    powers = list(found.items())
    for k, (f, u) in enumerate(powers):
        for g, v in powers[k:]:
            term = elementwise(np.square, u) if f == g else multiply(2.0, multiply(u, v))
            squares[f + g] = add(squares.get(f + g, ZERO), term)  # type: ignore[operator]
    return _few(squares)


def _single(found: Features) -> Features:
    if len(found) != 1:
        raise TraceError("a function of a sum of its powers is no feature")
    return found


def _product(first: Features, second: Features) -> Features:
    found: dict[Any, Expression] = {}
    for f, u in first.items():
        for g, v in second.items():
            both = f + g  # type: ignore[operator]
            found[both] = add(found.get(both, ZERO), multiply(u, v))
    return _few(found)


def _few(found: Features) -> Features:
    """Powers, unless they are more than any family has: each step of a recursion doubles the degree."""
    if len(found) > _MOST:
        raise TraceError(f"more than {_MOST} powers of it are no features")
    return found


_Reader.rules = {
    np.add: _Reader.add, np.subtract: _Reader.add, np.negative: _Reader.negative,
    np.multiply: _Reader.multiply, np.divide: _Reader.divide, np.square: _Reader.square,
    np.power: _Reader.power, np.float_power: _Reader.power, np.sqrt: _Reader.root,
    np.cbrt: _Reader.root, np.reciprocal: _Reader.root, np.log: _Reader.log,
    np.log1p: _Reader.log, special.xlogy: _Reader.xlogy, special.xlog1py: _Reader.xlogy,
    np.where: _Reader.where,
}  # fmt: skip
