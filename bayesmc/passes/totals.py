"""Sums of entries for every element that they read, with what is the same for all of an element's taken out.

A log density is a sum of parts, and natural parameters are sums of their coefficients, so that parts are
taken apart first and summed by themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Pick,
    Reduction,
    as_expression,
    broadcast,
    elementwise,
    pick,
    reshape,
)
from bayesmc.passes.adjoints import gathered, scattered
from bayesmc.passes.arithmetic import ONE, ZERO, divide, is_all, multiply, tidy
from bayesmc.shapes import Shape


@dataclass(frozen=True, eq=False)
class Part:
    """``factor * expression``, summed over the entries that count.

    Attributes
    ----------
    mask : ndarray of bool or None
        Entries that count; broadcasts to the expression.
    is_picked : bool
        Whether it is one of two branches, of which the other does not depend on the leaf.
    """

    expression: Expression
    factor: Expression
    mask: np.ndarray | None
    is_picked: bool = False


def parts_of(root: Expression, name: str, mask: np.ndarray | None = None) -> list[Part]:
    """The parts of a sum over all entries that depend on a leaf.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.totals import parts_of
    >>> x = TracedArray(leaf("x", (3,)))
    >>> found = trace(lambda x: np.sum(np.log(x)) - 2.0 * np.sum(x) + 1.0, [x])
    >>> [(p.expression, p.factor.value.item()) for p in parts_of(found, "x")]
    [(<Elementwise log (3,)>, 1.0), (<Leaf x (3,)>, -2.0)]
    """
    return list(_parts(root, name, Part(root, ONE, mask)))


def total(
    coefficient: Expression, at: Expression, count: int, mask: np.ndarray | None = None
) -> Expression:
    """Sums of entries by the element that they read.

    Parameters
    ----------
    coefficient : Expression, shape (*entries, *block)
        Numbers, or blocks of them.
    at : Expression of whole numbers, shape (*entries)
        -1 for entries that read none.
    count : int
        Number of elements.
    mask : ndarray of bool, optional
        Entries that count; broadcasts to them.

    Returns
    -------
    Expression, shape (count, *block)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import as_expression, broadcast, elementwise, leaf
    >>> from bayesmc.passes.totals import total
    >>> scaled = elementwise(np.multiply, leaf("s", ()), np.array([1.0, 2.0, 4.0]))
    >>> total(scaled, as_expression(np.array([0, 1, 1])), 2)
    <Elementwise multiply (2,)>
    """
    block = coefficient.shape[len(at.shape) :]
    if isinstance(at, Constant):
        return _at_constants(coefficient, at.value, count, mask, block)
    shape = at.shape
    own: list[tuple[Expression, int]] = []
    rest = [] if mask is None else [_where(mask, coefficient.shape, at.shape)]
    for factor, power in _factors(coefficient):
        short = _by_rows(factor, at, (count, *block))
        (rest if short is None else own).append((factor if short is None else short, power))
    left = broadcast(_product(rest), shape + block)
    sums = gathered(left, elementwise(np.add, at, 1), (count + 1, *block))
    flat = np.arange((count + 1) * math.prod(block)).reshape(count + 1, *block)[1:]
    return multiply(pick([sums], flat), _product(own))


# ---- private ------------------------------------------------------------------------------------


def _parts(node: Expression, name: str, now: Part) -> Iterator[Part]:
    if name not in node.leaves:
        return
    factor, mask = now.factor, now.mask
    if isinstance(node, Reduction) and node.ufunc is np.add:
        (operand,) = node.operands
        wide = tuple(1 if k in node.axes else n for k, n in enumerate(operand.shape))
        factor = reshape(broadcast(factor, node.shape), wide) if factor.shape else factor
        if mask is not None:
            mask = np.broadcast_to(mask, node.shape).reshape(wide)
        yield from _parts(operand, name, Part(operand, factor, mask, now.is_picked))
        return
    if isinstance(node, Elementwise):
        found = list(_split(node, name, factor))
        if found:
            free = [a for a in node.operands[1:] if name not in a.leaves]
            branch = node.function is np.where and len(free) == 1
            picked = now.is_picked or (
                branch and not is_all(free[0], 0) and not is_all(free[0], -np.inf)
            )
            for operand, own in found:
                whole = broadcast(operand, node.shape)
                yield from _parts(whole, name, Part(whole, own, mask, picked))
            return
    yield Part(node, factor, mask, now.is_picked)


def _split(
    node: Elementwise, name: str, factor: Expression
) -> Iterator[tuple[Expression, Expression]]:
    """Terms of a sum, each with its factor; nothing where it is none."""
    function, operands = node.function, node.operands
    if function is np.negative:
        yield operands[0], multiply(factor, -1.0)
    elif function in (np.add, np.subtract):
        yield operands[0], factor
        yield operands[1], factor if function is np.add else multiply(factor, -1.0)
    elif function is np.multiply and any(name not in a.leaves for a in operands):
        free, other = operands if name not in operands[0].leaves else operands[::-1]
        yield other, multiply(factor, free)
    elif function is np.divide and name not in operands[1].leaves:
        yield operands[0], divide(factor, operands[1])
    elif function is np.where and is_all(operands[2], -np.inf):  # a support
        yield operands[1], factor
    elif function is np.where and name not in operands[0].leaves:
        condition, first, second = operands
        yield first, tidy(np.where, condition, factor, ZERO)
        yield second, tidy(np.where, condition, ZERO, factor)


def _at_constants(
    coefficient: Expression, at: np.ndarray, count: int, mask: np.ndarray | None, block: Shape
) -> Expression:
    counts = at >= 0 if mask is None else (at >= 0) & np.broadcast_to(mask, at.shape)
    kept = np.flatnonzero(counts)
    flat, size = at.reshape(-1)[kept], math.prod(block)
    if not len(kept):
        return broadcast(ZERO, (count, *block))
    first = np.zeros(count, np.intp)
    first[flat[::-1]] = kept[::-1]
    numbers = np.arange(coefficient.size).reshape(at.size, *block)
    own: list[tuple[Expression, int]] = []
    rest: list[tuple[Expression, int]] = []
    for factor, power in _factors(coefficient):
        entries = pick([broadcast(factor, coefficient.shape)], numbers[kept])
        short = pick([broadcast(factor, coefficient.shape)], numbers[first])
        again = np.arange(count * size).reshape(count, *block)[flat]
        is_own = pick([short], again) is entries
        (own if is_own else rest).append((short if is_own else entries, power))
    left = broadcast(_product(rest), (len(kept), *block))
    places = flat.reshape(-1, *(1,) * len(block)) * size + np.arange(size).reshape(block)
    return multiply(_added(left, places, (count, *block)), _product(own))


def _added(left: Expression, places: np.ndarray, shape: Shape) -> Expression:
    if isinstance(left, Constant):
        sums = np.bincount(places.reshape(-1), left.value.reshape(-1), math.prod(shape))
        return as_expression(sums.reshape(shape))
    return scattered(left, places, shape)


def _factors(node: Expression) -> Iterator[tuple[Expression, int]]:
    """What an expression is a product of: factors that broadcast to its shape, and their powers."""
    todo = [(node, 1)]
    while todo:
        found, power = todo.pop()
        if isinstance(found, Elementwise) and found.function in (np.multiply, np.divide):
            first, second = found.operands
            todo += [(first, power), (second, power if found.function is np.multiply else -power)]
        elif isinstance(found, Elementwise) and found.function is np.negative:
            yield as_expression(-1.0), power
            todo.append((found.operands[0], power))
        elif isinstance(found, Elementwise) and found.function is np.square:
            todo.append((found.operands[0], 2 * power))
        elif isinstance(found, Pick) and len(found.operands) == 1:
            base = found.operands[0]
            same = _broadcasts(base.shape, found.shape) and broadcast(base, found.shape) is found
            if same and isinstance(base, Elementwise):
                todo.append((base, power))
            else:
                yield found, power
        else:
            yield found, power


def _broadcasts(short: Shape, wide: Shape) -> bool:
    lead = len(wide) - len(short)
    return lead >= 0 and all(n in (1, m) for n, m in zip(short, wide[lead:], strict=True))


def _product(factors: list[tuple[Expression, int]]) -> Expression:
    found = ONE
    for factor, power in factors:
        for _ in range(abs(power)):
            found = multiply(found, factor) if power > 0 else divide(found, factor)
    return found


def _by_rows(factor: Expression, at: Expression, shape: Shape) -> Expression | None:
    """A factor by elements, where entries have it from the element that they read alone."""
    if factor.size == 1:
        return reshape(factor, ())
    if isinstance(factor, Gather) and factor.rows is at and factor.table.shape == shape:
        return factor.table
    return None


def _where(mask: np.ndarray, shape: Shape, entries: Shape) -> tuple[Expression, int]:
    wide = np.broadcast_to(mask, entries).reshape(entries + (1,) * (len(shape) - len(entries)))
    return as_expression(wide.astype(float)), 1
