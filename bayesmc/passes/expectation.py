"""Expectations of expressions in independent leaves, as expressions of the leaves' moments.

What is a sum of products of functions of single leaves has an expectation that is the same sum of products of
their expectations (Winn and Bishop 2005, sec. 2: models are conjugate-exponential where the log joint density
is multilinear in the statistics of parents and children). The square of what is affine in a normal leaf is
the square of a mean plus a variance, so that nothing cancels. Moments are leaves of their own: derivatives by
them are natural parameters. What is none of this is refused, with the leaves that stand in the way.

References
----------
Winn and Bishop (2005), Variational Message Passing, JMLR 6; Bishop (2006), Pattern Recognition and Machine
Learning, sec. 10.1 and 10.4.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

import numpy as np
from scipy import special

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    Reduction,
    broadcast,
    elementwise,
    gather,
    pick,
    reduction,
    reshape,
    substituted,
)
from bayesmc.expression.functions import product
from bayesmc.expression.graph import CASTS
from bayesmc.passes.affine import Read, affine
from bayesmc.passes.arithmetic import ONE, add, divide, is_all, multiply, subtract, tidy
from bayesmc.passes.moments import Hidden, Meeting, NoMoment
from bayesmc.passes.reads import matrix_function
from bayesmc.shapes import Shape

#: pairs of coefficients of one entry up to which second moments are written out
_PAIRS = 1 << 22


class Expectation:
    """Takes expectations of expressions in independent leaves.

    Parameters
    ----------
    hidden : mapping
        Leaf -> ``Hidden``; all other leaves are known, or given.
    inside : iterable of str
        Leaves that are inside of the support that the expression bounds, wherever they are.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.expectation import Expectation
    >>> from bayesmc.passes.moments import Hidden, moment
    >>> x, rate = leaf("x", ()), leaf("rate", ())
    >>> root = trace(lambda x, rate: rate * (x - 3) ** 2, [TracedArray(x), TracedArray(rate)])
    >>> hidden = {"x": Hidden("x", "number", ()), "rate": Hidden("rate", "positive", ())}
    >>> found = Expectation(hidden)(root)
    >>> moments = {moment("x", "mean"): 1.0, moment("x", "cov"): [[[0.5]]], moment("rate", "x"): 2.0}
    >>> float(evaluate([found], {k: np.array(v) for k, v in moments.items()})[0])  # 2 ((1 - 3)**2 + 0.5)
    9.0
    """

    def __init__(self, hidden: Mapping[str, Hidden], inside: Iterable[str] = ()) -> None:
        self.hidden, self.inside = hidden, frozenset(inside)
        self._found: dict[Expression, Expression] = {}

    def __call__(self, node: Expression) -> Expression:
        found = self._found.get(node)
        if found is None:
            found = self._found[node] = self._expected(node)
        return found

    def names(self, *nodes: Expression) -> frozenset[str]:
        """The hidden leaves below some expressions."""
        return frozenset(n for node in nodes for n in node.leaves if n in self.hidden)

    def blocks(self, *nodes: Expression) -> frozenset[str]:
        """What is drawn together, by name: a mean that has its scale counts as that."""
        return frozenset(self.hidden[n].scale or n for n in self.names(*nodes))

    def are_apart(self, first: Expression, second: Expression) -> bool:
        return self.blocks(first).isdisjoint(self.blocks(second))

    def refuse(self, node: Expression, why: str) -> NoMoment:
        return NoMoment(why, self.names(node))

    # ---- second moments ----------------------------------------------------------------------------

    def cross(self, u: Expression, w: Expression) -> Expression:
        """The expectation of the product of two expressions, element by element."""
        if not self.names(u):
            return multiply(u, self(w))
        if not self.names(w):
            return multiply(w, self(u))
        if self.are_apart(u, w):
            return multiply(self(u), self(w))
        both = self.names(u) & self.names(w)
        numbers = [n for n in self.names(u, w) if self._is_plain(n)]
        for name in sorted(numbers, key=lambda n: (n not in both, n)):
            try:
                first, second = affine(u, [name]), affine(w, [name])
            except TraceError:
                continue
            own: dict[str, Expression] = {name: self.hidden[name].moment("mean")}
            total = self.cross(substituted(u, own), substituted(w, own))
            if name in first.reads and name in second.reads:
                spread = self._spread(self.hidden[name], first.reads[name], second.reads[name])
                total = add(total, spread)
            return total
        return self._of_monomial(elementwise(np.multiply, u, w))

    def _is_plain(self, name: str) -> bool:
        own = self.hidden[name]
        return own.kind == "number" and own.scale is None

    def _spread(self, own: Hidden, first: Read, second: Read) -> Expression:
        """What the covariance of a leaf adds to the product of two expressions that read it."""
        shape = np.broadcast_shapes(first.at.shape[:-1], second.at.shape[:-1])
        (gain, at), (other, to) = _at(first, shape, own.name), _at(second, shape, own.name)
        k, m = at.shape[-1], to.shape[-1]
        if own.width == 1 and k == m == 1:
            same = (at == to)[..., 0]
            if not same.all() and _meets(gain, other, at != to):
                raise Meeting(f"elements of {own.name!r} meet", [own.name])
            var = reshape(own.moment("cov"), (own.moment("cov").size,))
            found = multiply(
                self.cross(_column(gain, 0), _column(other, 0)), pick([var], at[..., 0])
            )
            return found if same.all() else multiply(found, same.astype(float))
        first_group, second_group = at // own.width, to // own.width
        same = first_group[..., :, None] == second_group[..., None, :]
        if not same.all() and own.width < own.moment("mean").size:
            clash = ~same & _nonzero(gain)[..., :, None] & _nonzero(other)[..., None, :]
            if clash.any():
                raise Meeting(f"elements of {own.name!r} meet", [own.name])
        if same.size > _PAIRS and not _is_uniform(at, to):
            raise NoMoment(f"{same.size} second moments of {own.name!r}", [own.name])
        return self._form(own, gain, other, at, to)

    def _form(
        self, own: Hidden, gain: Expression, other: Expression, at: np.ndarray, to: np.ndarray
    ) -> Expression:
        """``sum_ij gain_i other_j cov_ij``."""
        k, m, w = at.shape[-1], to.shape[-1], own.width
        uniform = _is_uniform(at, to)
        if uniform:
            at, to = at.reshape(-1, k)[0], to.reshape(-1, m)[0]
        same = (at // w)[..., :, None] == (to // w)[..., None, :]
        place = (at // w * w * w + at % w * w)[..., :, None] + (to % w)[..., None, :]
        cov = pick([own.moment("cov")], place)
        if not same.all():
            cov = multiply(cov, same.astype(float))
        if not self.names(gain) and not self.names(other):
            inner = product(np.matvec, cov, other)
            return product(np.vecdot, gain, broadcast(inner, (*inner.shape[:-1], k)))
        shape = (*gain.shape[:-1], k, m)
        one = broadcast(reshape(gain, (*gain.shape, 1)), shape)
        two = broadcast(reshape(other, (*other.shape[:-1], 1, m)), shape)
        whole = multiply(self.cross(one, two), cov)
        return reduction(np.add, broadcast(whole, shape), (-2, -1))

    # ---- single expressions ------------------------------------------------------------------------

    def _expected(self, node: Expression) -> Expression:
        if not self.names(node):
            return node
        if isinstance(node, Leaf):
            return self._moment_of(node, 1.0)
        if isinstance(node, Pick):
            return pick([self(a) for a in node.operands], node.positions)
        if isinstance(node, Reduction) and node.ufunc is np.add:
            (operand,) = node.operands
            return reduction(np.add, broadcast(self(operand), operand.shape), node.axes)
        if isinstance(node, Gather) and not self.names(node.rows):
            return gather(broadcast(self(node.table), node.table.shape), node.rows)
        if isinstance(node, Elementwise):
            rule = self.rules.get(node.function)
            if rule is not None:
                return broadcast(rule(self, node), node.shape)
        if isinstance(node, Call):
            return self._called(node)
        raise self.refuse(
            node, f"{node.detail or type(node).__name__} has no expectation in closed form"
        )

    def _called(self, node: Call) -> Expression:
        """Calls that are linear in each operand."""
        word = matrix_function(node)
        varying = [a for a in node.operands if self.names(a)]
        bilinear = word in ("matmul", "matvec", "vecdot", "kron", "cross", "cumsum", "trace")
        if bilinear and (len(varying) == 1 or (len(varying) == 2 and self.are_apart(*varying))):
            return node.with_operands([broadcast(self(a), a.shape) for a in node.operands])
        raise self.refuse(node, f"{node.detail} has no expectation in closed form")

    def add(self, node: Elementwise) -> Expression:
        first, second = map(self, node.operands)
        return (add if node.function is np.add else subtract)(first, second)

    def linear(self, node: Elementwise) -> Expression:
        (operand,) = node.operands
        if node.function is np.negative:
            return multiply(self(operand), -1.0)
        if not np.can_cast(operand.dtype, CASTS[node.function]):
            raise self.refuse(node, "a cast that cuts numbers")
        return self(operand)

    def multiply(self, node: Elementwise) -> Expression:
        return self.cross(*node.operands)

    def divide(self, node: Elementwise) -> Expression:
        first, second = node.operands
        if not self.names(second):
            return divide(self(first), second)
        if self.are_apart(first, second):
            return multiply(self(first), self._of_monomial(elementwise(np.divide, 1.0, second)))
        return self._of_monomial(node)

    def square(self, node: Elementwise) -> Expression:
        base = node.operands[0]
        if node.function is np.power and not is_all(node.operands[1], 2.0):
            return self._of_monomial(node)
        if isinstance(base, Elementwise) and base.function in (np.divide, np.multiply):
            first, second = base.operands
            if self.are_apart(first, second):
                if base.function is np.multiply:
                    return multiply(self.cross(first, first), self.cross(second, second))
                return multiply(self.cross(first, first), self.power(second, -2.0))
        return self.cross(base, base)

    def power(self, base: Expression, exponent: float) -> Expression:
        """The expectation of a power of something positive."""
        if not self.names(base):
            return elementwise(np.power, base, exponent)
        return self._of_powers(*self._monomial(base), exponent)

    def root(self, node: Elementwise) -> Expression:
        return self._of_monomial(node)

    def log(self, node: Elementwise) -> Expression:
        inside = node.operands[0]
        if node.function is np.log1p:
            inside = tidy(np.add, inside, 1.0)
        rest = _one_minus(inside)
        if rest is not None and self.names(rest):
            return self._feature(rest, "log1m")
        coefficient, powers = self._monomial(inside)
        total = elementwise(np.log, coefficient)
        for read, p in powers.items():
            total = add(total, multiply(p, self._feature(read, "log")))
        return total

    def xlogy(self, node: Elementwise) -> Expression:
        weight, inside = node.operands
        plain = np.log if node.function is special.xlogy else np.log1p
        if not self.names(inside):
            made = elementwise(node.function, 1.0, inside)
            return multiply(self(weight), made)
        return self.cross(weight, elementwise(plain, inside))

    def where(self, node: Elementwise) -> Expression:
        condition, first, second = node.operands
        if is_all(second, -np.inf) and self.names(condition) <= self.inside:
            return (
                self(first)
                if self.names(condition)
                else tidy(np.where, condition, self(first), second)
            )
        if self.names(condition):
            raise self.refuse(condition, "a branch on it has no expectation in closed form")
        return tidy(np.where, condition, self(first), self(second))

    # ---- products of powers ------------------------------------------------------------------------

    def _of_monomial(self, node: Expression) -> Expression:
        return self._of_powers(*self._monomial(node), 1.0)

    def _of_powers(
        self, coefficient: Expression, powers: Mapping[Expression, float], exponent: float
    ) -> Expression:
        total = coefficient
        if exponent != 1.0:
            total = tidy(np.power, coefficient, exponent)
        blocks: list[str] = []
        for read, p in powers.items():
            if p * exponent:
                total = multiply(total, self._moment_of(read, p * exponent))
                blocks += self.blocks(read)
        if len(blocks) > len(set(blocks)):
            names = frozenset(n for read in powers for n in read.leaves)
            raise NoMoment("functions of what is not independent are multiplied", names)
        return total

    def _monomial(self, node: Expression) -> tuple[Expression, dict[Expression, float]]:
        """A coefficient, and elements of leaves with their powers."""
        if not self.names(node):
            return node, {}
        if _is_read(node):
            return ONE, {node: 1.0}
        if isinstance(node, Elementwise):
            function, operands = node.function, node.operands
            if function in (np.multiply, np.divide):
                sign = 1.0 if function is np.multiply else -1.0
                (c, one), (d, other) = map(self._monomial, operands)
                both = dict(one)
                for read, p in other.items():
                    both[read] = both.get(read, 0.0) + sign * p
                return tidy(function, c, d), both
            exponent = _EXPONENT.get(function)
            if function is np.power and isinstance(operands[1], Constant) and operands[1].size == 1:
                exponent = float(operands[1].value.ravel()[0])
            if exponent is not None:
                c, own = self._monomial(operands[0])
                return tidy(np.power, c, exponent), {r: p * exponent for r, p in own.items()}
            if function is np.negative:
                c, own = self._monomial(operands[0])
                return multiply(c, -1.0), own
            if function in CASTS:
                return self._monomial(operands[0])
        if isinstance(node, Pick) and len(node.operands) == 1:
            c, own = self._monomial(node.operands[0])
            shape = node.operands[0].shape
            moved = {pick([broadcast(r, shape)], node.positions): p for r, p in own.items()}
            return pick([broadcast(c, shape)], node.positions), moved
        raise self.refuse(
            node, f"{node.detail or type(node).__name__} has no expectation in closed form"
        )

    def _moment_of(self, read: Expression, p: float) -> Expression:
        """The expectation of a power of elements of one leaf."""
        (name,) = self.names(read)
        own = self.hidden[name]
        if own.kind == "number":
            if p == 1.0:
                return self._feature(read, "mean")
            if p == 2.0 and own.scale is None:
                return self.cross(read, read)
        elif p in (1.0, -1.0) and (p == 1.0 or own.kind == "positive"):
            return self._feature(read, "x" if p == 1.0 else "inv")
        raise self.refuse(read, f"power {p:g} of it has no expectation in closed form")

    def _feature(self, read: Expression, feature: str) -> Expression:
        name, *others = self.names(read)
        if others:
            raise self.refuse(read, f"{feature} of several nodes has no expectation in closed form")
        own = self.hidden[name]
        fits = _is_read(read) and feature in _FEATURES[own.kind]
        if not fits or (own.kind == "matrix" and feature == "log"):
            raise self.refuse(read, f"{feature} of it has no expectation in closed form")
        return substituted(read, {name: own.moment(feature)})

    rules: ClassVar[Mapping[Any, Callable[[Any, Elementwise], Expression]]]


Expectation.rules = {
    np.add: Expectation.add, np.subtract: Expectation.add, np.negative: Expectation.linear,
    **dict.fromkeys(CASTS, Expectation.linear), np.multiply: Expectation.multiply,
    np.divide: Expectation.divide, np.square: Expectation.square, np.power: Expectation.square,
    np.sqrt: Expectation.root, np.reciprocal: Expectation.root, np.log: Expectation.log,
    np.log1p: Expectation.log, special.xlogy: Expectation.xlogy,
    special.xlog1py: Expectation.xlogy, np.where: Expectation.where,
}  # fmt: skip

_EXPONENT: dict[Any, float] = {np.sqrt: 0.5, np.reciprocal: -1.0, np.square: 2.0, np.cbrt: 1 / 3}
#: kind -> features that have a moment
_FEATURES: dict[str, tuple[str, ...]] = {
    "number": ("mean",), "positive": ("x", "inv", "log"), "unit": ("x", "log", "log1m"),
    "simplex": ("x", "log"), "matrix": ("x", "inv", "log"),
}  # fmt: skip


# ---- private ------------------------------------------------------------------------------------


def _is_read(node: Expression) -> bool:
    """Whether it is elements of one leaf."""
    while isinstance(node, Pick) and len(node.operands) == 1:
        (node,) = node.operands
    return isinstance(node, Leaf)


def _one_minus(node: Expression) -> Expression | None:
    """What is taken from one, if that is all."""
    if not isinstance(node, Elementwise):
        return None
    if node.function is np.subtract and is_all(node.operands[0], 1.0):
        return node.operands[1]
    if node.function is np.add:
        for one, other in (node.operands, node.operands[::-1]):
            if is_all(one, 1.0) and isinstance(other, Elementwise):
                if other.function is np.negative:
                    return other.operands[0]
    return None


def _at(read: Read, shape: Shape, name: str) -> tuple[Expression, np.ndarray]:
    """Gains ``(*shape, k)`` or what broadcasts to it, and positions."""
    if not isinstance(read.at, Constant):
        raise NoMoment(f"it hangs on others which element of {name!r} is read", [name])
    k = read.at.shape[-1]
    return broadcast(read.gain, (*shape, k)), np.broadcast_to(read.at.value, (*shape, k))


def _column(gain: Expression, k: int) -> Expression:
    at = np.arange(gain.size).reshape(gain.shape)[..., k]
    return pick([gain], at)


def _nonzero(gain: Expression) -> np.ndarray:
    """Where a coefficient may differ from 0."""
    if isinstance(gain, Constant):
        return gain.value != 0
    return np.ones(gain.shape, bool)


def _meets(gain: Expression, other: Expression, apart: np.ndarray) -> bool:
    return bool((apart & _nonzero(gain) & _nonzero(other)).any())


def _is_uniform(at: np.ndarray, to: np.ndarray) -> bool:
    """Whether all entries read the same elements."""
    first, second = at.reshape(-1, at.shape[-1]), to.reshape(-1, to.shape[-1])
    return bool((first == first[:1]).all() and (second == second[:1]).all())
