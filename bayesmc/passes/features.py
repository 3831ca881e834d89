"""A log density as a sum of features of one leaf with coefficients that are free of it.

Features are 1, ``x**p``, ``log x`` and ``log(1 - x)``: with these, densities in a node's blanket that are
of exponential families add up to its full conditional by adding coefficients.

References
----------
Wainwright and Jordan (2008), Graphical Models, Exponential Families, and Variational Inference, sec. 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Elementwise,
    Expression,
    Leaf,
    Pick,
    Reduction,
    as_expression,
    broadcast,
    elementwise,
    leaf,
    pick,
    reduction,
    replaced,
)
from bayesmc.expression.graph import CASTS
from bayesmc.passes.arithmetic import ONE, ZERO, add, divide, is_all, multiply, subtract, tidy
from bayesmc.passes.sinking import reads, sunk

#: powers p of ``x**p``, and the two logarithms
Feature = float | str
LOG, LOG1M, CONSTANT = "log x", "log(1 - x)", 0.0
Features = dict[Feature, Expression]


@dataclass(frozen=True, eq=False)
class Statistics:
    """``sum_f coefficients[f] * f(x)`` for every entry, where x is the element that the entry reads.

    Attributes
    ----------
    coefficients : dict
        Feature (a power of x, ``LOG`` or ``LOG1M``) -> expression of the shape of the entries.
    at : Expression of whole numbers
        Flat position of the element of the leaf that each entry reads.
    """

    coefficients: Features
    at: Expression


def statistics(density: Expression, name: str) -> Statistics:
    """The features of a log density in a leaf, entry by entry.

    Parameters
    ----------
    density : Expression
    name : str
        Each entry reads one element of it.

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
    whole = sunk(density, name)
    ways = {r: _positions(r, name) for r in reads(whole, name)}
    shape = density.shape
    at = {_broadcast_to(p, shape) for p in ways.values()}
    if len(at) != 1:
        raise TraceError(f"an entry reads {len(at)} elements of {name!r}")
    element = leaf(f"element of {name}", ())
    # shapes are those of the entries, so that coefficients keep theirs
    instead: dict[Expression, Expression] = {
        r: broadcast(leaf(element.name, r.shape), r.shape) for r in ways
    }
    found = _Reader(element.name)(replaced(whole, instead))
    kept = {f: broadcast(c, shape) for f, c in found.items() if f != CONSTANT and not is_all(c, 0)}
    return Statistics(kept, at.pop())


# ---- private ------------------------------------------------------------------------------------


def _positions(read: Expression, name: str) -> Expression:
    """Positions of the elements that are read."""
    own = [n for n in _leaves_of(read) if n.name == name]
    numbers = as_expression(np.arange(own[0].size).reshape(own[0].shape))
    return replaced(read, dict.fromkeys(own, numbers))


def _leaves_of(root: Expression) -> list[Leaf]:
    found: list[Leaf] = []
    todo = [root]
    while todo:
        node = todo.pop()
        if isinstance(node, Leaf):
            found.append(node)
        todo += node.operands
    return found


def _broadcast_to(positions: Expression, shape: tuple[int, ...]) -> Expression:
    try:
        return broadcast(positions, shape)
    except ValueError as error:  # more elements than entries
        raise TraceError("an entry reads several elements") from error


class _Reader:
    """Features of expressions in one number."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._found: dict[Expression, Features] = {}

    def __call__(self, node: Expression) -> Features:
        found = self._found.get(node)
        if found is None:
            found = self._found[node] = self._read(node)
        return found

    def _is_free(self, node: Expression) -> bool:
        return self.name not in node.leaves

    def _read(self, node: Expression) -> Features:
        if self._is_free(node):
            return {CONSTANT: node}
        if isinstance(node, Leaf):
            return {1.0: ONE}
        if isinstance(node, Reduction) and node.ufunc is np.add:
            (operand,) = node.operands
            inner = self(operand)
            return {
                f: reduction(np.add, broadcast(c, operand.shape), node.axes)
                for f, c in inner.items()
            }
        if isinstance(node, Pick) and len(node.operands) == 1:
            (operand,) = node.operands
            inner = self(operand)
            return {
                f: pick([broadcast(c, operand.shape)], node.positions) for f, c in inner.items()
            }
        if isinstance(node, Elementwise):
            rule = _RULES.get(node.function)
            if rule is not None:
                return rule(self, node)
            if node.function in CASTS:
                return self(node.operands[0])
        raise TraceError(f"{node.detail or type(node).__name__} of it is no feature")

    # ---- element by element ------------------------------------------------------------------------

    def add(self, node: Elementwise) -> Features:
        first, second = map(self, node.operands)
        join = add if node.function is np.add else subtract
        return {f: join(first.get(f, ZERO), second.get(f, ZERO)) for f in {**first, **second}}

    def negative(self, node: Elementwise) -> Features:
        return {f: multiply(c, -1.0) for f, c in self(node.operands[0]).items()}

    def multiply(self, node: Elementwise) -> Features:
        first, second = node.operands
        if self._is_free(first):
            return {f: multiply(c, first) for f, c in self(second).items()}
        if self._is_free(second):
            return {f: multiply(c, second) for f, c in self(first).items()}
        return _product(_powers(self(first)), _powers(self(second)))

    def divide(self, node: Elementwise) -> Features:
        first, second = node.operands
        if self._is_free(second):
            return {f: divide(c, second) for f, c in self(first).items()}
        ((power, coefficient),) = _single(_powers(self(second))).items()
        top = _powers(self(first))
        return {f - power: divide(c, coefficient) for f, c in top.items()}  # type: ignore[operator]

    def square(self, node: Elementwise) -> Features:
        inner = _powers(self(node.operands[0]))
        return _product(inner, inner)

    def power(self, node: Elementwise) -> Features:
        base, exponent = node.operands
        if not is_constant(exponent):
            raise TraceError("a power that varies of it is no feature")
        p = float(np.ravel(exponent.value)[0])  # type: ignore[attr-defined]
        inner = _powers(self(base))
        if p == 2.0:
            return _product(inner, inner)
        ((power, coefficient),) = _single(inner).items()
        return {power * p: tidy(np.power, coefficient, p)}  # type: ignore[operator]

    def root(self, node: Elementwise) -> Features:
        p = {np.sqrt: 0.5, np.reciprocal: -1.0, np.cbrt: 1 / 3}[node.function]  # type: ignore[index]
        ((power, coefficient),) = _single(_powers(self(node.operands[0]))).items()
        return {power * p: elementwise(node.function, coefficient)}  # type: ignore[operator]

    def log(self, node: Elementwise) -> Features:
        inner = dict(self(node.operands[0]))
        if node.function is np.log1p:
            inner[CONSTANT] = add(inner.get(CONSTANT, ZERO), ONE)
        inner = {f: c for f, c in inner.items() if not is_all(c, 0)}
        if set(inner) == {CONSTANT, 1.0} and is_all(inner[CONSTANT], 1) and is_all(inner[1.0], -1):
            return {LOG1M: ONE}
        ((power, coefficient),) = _single(_powers(inner)).items()
        return {LOG: as_expression(float(power)), CONSTANT: elementwise(np.log, coefficient)}

    def xlogy(self, node: Elementwise) -> Features:
        weight, inside = node.operands
        if not self._is_free(weight):
            raise TraceError(f"{node.detail} of it is no feature")
        plain = np.log if node.function is special.xlogy else np.log1p
        inner = self(elementwise(plain, inside))
        return {f: multiply(c, weight) for f, c in inner.items()}

    def where(self, node: Elementwise) -> Features:
        condition, first, second = node.operands
        if not self._is_free(condition):
            if is_all(second, -np.inf):  # a support: its bounds are the family's affair
                return self(first)
            raise TraceError("a branch on it is no feature")
        one, other = self(first), self(second)
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
    return {f: c for f, c in found.items() if not is_all(c, 0)}


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
    return found


_RULES: dict[Any, Any] = {
    np.add: _Reader.add, np.subtract: _Reader.add, np.negative: _Reader.negative,
    np.multiply: _Reader.multiply, np.divide: _Reader.divide, np.square: _Reader.square,
    np.power: _Reader.power, np.float_power: _Reader.power, np.sqrt: _Reader.root,
    np.cbrt: _Reader.root, np.reciprocal: _Reader.root, np.log: _Reader.log,
    np.log1p: _Reader.log, special.xlogy: _Reader.xlogy, special.xlog1py: _Reader.xlogy,
    np.where: _Reader.where,
}  # fmt: skip
