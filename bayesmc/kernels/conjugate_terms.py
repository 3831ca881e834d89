"""What a term adds to the natural parameters of a node, as expressions of the state of a chain.

Values that are known are constants here, so that what does not change from sweep to sweep is worked out
once, when the expressions are made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Reduction,
    broadcast,
    ordered,
    replaced,
)
from bayesmc.passes.arithmetic import ONE, ZERO, add, is_all, multiply, tidied
from bayesmc.passes.branches import branches_up
from bayesmc.passes.features import Feature, statistics
from bayesmc.passes.reads import element_read, reads, same_along, sunk
from bayesmc.passes.totals import parts_of, total
from bayesmc.structure.blanket import Blanket


@dataclass(frozen=True, eq=False)
class Moving:
    """The elements of a node that move together, all others given.

    Attributes
    ----------
    numbers : ndarray of int, shape of the node's value
        The element that each number belongs to; -1 for those that do not move.
    count : int
        Elements of the node, or of its numbers where these are elements.
    """

    blanket: Blanket
    numbers: np.ndarray
    count: int

    @property
    def name(self) -> str:
        return self.blanket.name


@dataclass(frozen=True, eq=False)
class Added:
    """Coefficients of features, summed for every element.

    Attributes
    ----------
    coefficients : dict
        Feature -> expression of shape ``(count,)``.
    is_picked : bool
        Whether it hangs on other nodes which entries read an element.
    """

    coefficients: Mapping[Feature, Expression] = field(default_factory=dict)
    is_picked: bool = False


def moving(blanket: Blanket, members: np.ndarray | None, by_number: bool = False) -> Moving:
    """The elements of a class of a node; with ``by_number``, their numbers one by one."""
    elements = np.arange(blanket.size)
    if len(blanket.classes) > 1 and members is not None:
        elements = np.full(blanket.size, -1)
        elements[members] = members
    event = int(np.prod(blanket.event_shape, dtype=int))
    if by_number:
        inner = elements[:, None] * event + np.arange(event)
        numbers = np.where(elements[:, None] < 0, -1, inner)
        return Moving(blanket, numbers.reshape(blanket.node.value_shape), blanket.size * event)
    numbers = np.repeat(elements, event).reshape(blanket.node.value_shape)
    return Moving(blanket, numbers, blanket.size)


def features_of(
    expression: Expression,
    of: Moving,
    mask: Any = None,
    strict: bool = False,
    is_share: bool = True,
) -> Added:
    """The features of a log density, summed over all entries for every element.

    Parameters
    ----------
    strict : bool
        Whether every entry must have them for all values of other nodes.
    is_share : bool
        Whether the node is between 0 and 1.

    Raises
    ------
    TraceError
        It is no sum of features.
    """
    found: dict[Feature, Expression] = {}
    picked = False
    for part in parts_of(sunk(tidied(expression), of.name), of.name, mask):
        some = statistics(part.expression, of.name, of.numbers, strict, is_share)
        picked = picked or some.is_picked or part.is_picked
        for feature, coefficient in some.coefficients.items():
            whole = multiply(coefficient, broadcast(part.factor, coefficient.shape))
            sums = total(whole, some.at, of.count, part.mask)
            found[feature] = add(found.get(feature, ZERO), sums)
    return Added(found, picked)


def refuse_moving_support(expression: Expression, name: str) -> None:
    """Raise where what is possible under a density depends on a node: its features alone say less.

    Raises
    ------
    TraceError
    """
    for node in ordered(expression):
        if isinstance(node, Elementwise) and node.function is np.where:
            condition, _, impossible = node.operands
            if name in condition.leaves and is_all(impossible, -np.inf):
                raise TraceError("what is possible under it depends on the node")


def shares_sum_to_one(expression: Expression, blanket: Blanket) -> Expression:
    """An expression in which the sum of all of a node's shares is 1."""
    size = blanket.event_shape[-1]
    name = blanket.name
    flat = np.arange(blanket.size * size).reshape(blanket.node.value_shape)
    whole = sunk(branches_up(sunk(tidied(expression), name), name), name)
    instead: dict[Expression, Expression] = {}
    pure = set(reads(whole, name))
    for node in ordered(whole):
        if isinstance(node, Reduction) and node.ufunc is np.add and node.operands[0] in pure:
            (axis, *more), operand = node.axes, node.operands[0]
            rows = element_read(operand, name, flat // size)
            places = element_read(operand, name, flat % size)
            if more or same_along(rows, [axis]) is None or not isinstance(places, Constant):
                continue
            every = np.sort(np.moveaxis(places.value, axis, -1), axis=-1)
            if every.shape[-1] == size and (every == np.arange(size)).all():
                instead[node] = broadcast(ONE, node.shape)
    return replaced(whole, instead) if instead else whole
