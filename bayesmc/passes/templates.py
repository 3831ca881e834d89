"""Equality up to constants: the slices of a template, the like nodes of a loop, as one stacked expression."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import TypeGuard

import numpy as np

from bayesmc.expression import Call, Constant, Expression, Leaf, leaf, ordered, replaced


@dataclass(frozen=True, eq=False)
class Template:
    """Expressions that are the same but for constants and the names of leaves.

    Attributes
    ----------
    key : hashable
        Equal for those that are alike.
    constants : tuple of ndarray
        Real and whole ones, in the order in which they occur; equal ones as often as they do.
    leaves : tuple of str
        Names, in the order in which they occur first.
    """

    key: Hashable
    constants: tuple[np.ndarray, ...]
    leaves: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Stacked:
    """One expression for many that are alike.

    Attributes
    ----------
    roots : tuple of Expression
        Of the leaves of the first, and ``constant 0``, ``constant 1``, ... for constants that differ.
    constants : dict
        Leaf -> the constants of all of them, shape ``(count, *shape)``.
    leaves : tuple of tuple of str
        For each the names that stand for the first one's leaves.
    """

    roots: tuple[Expression, ...]
    constants: dict[str, np.ndarray]
    leaves: tuple[tuple[str, ...], ...]

    @property
    def root(self) -> Expression:
        """The only one."""
        (root,) = self.roots
        return root


def template(*roots: Expression) -> Template:
    """What expressions are, together, apart from their constants and the names of their leaves.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.passes.templates import template
    >>> twice = template(elementwise(np.multiply, leaf("x[0]", ()), 2.0))
    >>> thrice = template(elementwise(np.multiply, leaf("x[1]", ()), 3.0))
    >>> twice.key == thrice.key, thrice.constants, thrice.leaves
    (True, (array(3.),), ('x[1]',))
    """
    number: dict[Expression, int] = {}
    key: list[Hashable] = []
    constants: list[np.ndarray] = []
    leaves: dict[str, int] = {}

    def place(operand: Expression) -> Hashable:
        if not _is_number(operand):
            return number[operand]
        constants.append(operand.value)
        return operand.shape, operand.dtype.str

    for node in ordered(*roots):
        if _is_number(node):
            continue
        number[node] = len(number)
        if isinstance(node, Leaf):
            at = leaves.setdefault(node.name, len(leaves))
            key.append(("leaf", at, node.shape, node.dtype.str, node.states))
        else:
            at_call = isinstance(node, Call)  # its function may take one array for all
            own = tuple(a.content if at_call and _is_number(a) else place(a) for a in node.operands)
            key.append((type(node).__name__, own, node.content, node.shape))
    key.append(tuple(map(place, roots)))
    return Template(tuple(key), tuple(constants), tuple(leaves))


def stacked(roots: Sequence[Expression]) -> Stacked | None:
    """One expression for all, or None where they are not alike."""
    return stacked_rows([(r,) for r in roots])


def stacked_rows(
    rows: Sequence[Sequence[Expression]], templates: Sequence[Template] | None = None
) -> Stacked | None:
    """One row of expressions for many, as the parameters of a distribution; None where they are not alike.

    Parameters
    ----------
    templates : sequence of Template, optional
        Of the rows, where they are known.
    """
    found = [template(*r) for r in rows] if templates is None else templates
    if len({t.key for t in found}) != 1:
        return None
    values: dict[str, np.ndarray] = {}
    instead: dict[int, Expression] = {}
    for k, column in enumerate(zip(*(t.constants for t in found), strict=True)):
        first = column[0]
        if all(c is first for c in column):
            continue
        stack = np.stack(column)
        if not np.array_equal(stack, np.broadcast_to(first, stack.shape), equal_nan=True):
            name = f"constant {len(values)}"
            values[name] = stack
            instead[k] = leaf(name, first.shape, first.dtype)
    return Stacked(_with_leaves(rows[0], instead), values, tuple(t.leaves for t in found))


def without_names(
    root: Expression,
) -> tuple[Expression, dict[str, np.ndarray], dict[str, str]]:
    """An expression that all share that are the same but for constants and the names of leaves.

    Returns
    -------
    Expression
        Of leaves ``leaf 0``, ... and ``constant 0``, ...
    dict
        Constants by leaf.
    dict
        Names by leaf.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.passes.templates import without_names
    >>> twice = without_names(elementwise(np.multiply, leaf("x", ()), 2.0))
    >>> thrice = without_names(elementwise(np.multiply, leaf("y", ()), 3.0))
    >>> twice[0] is thrice[0], thrice[1:]
    (True, ({'constant 0': array(3.)}, {'leaf 0': 'y'}))
    """
    names: dict[str, str] = {}
    constants: dict[str, np.ndarray] = {}
    instead: dict[Expression, Expression] = {}
    for node in ordered(root):
        if isinstance(node, Leaf):
            called = f"leaf {len(names)}"
            names[called] = node.name
            instead[node] = leaf(called, node.shape, node.dtype, node.states)
        elif isinstance(node, Constant) and node.dtype.kind == "f" and not node.shape:
            called = f"constant {len(constants)}"
            constants[called] = node.value
            instead[node] = leaf(called, node.shape, node.dtype)
    return replaced(root, instead), constants, names


# ---- private ------------------------------------------------------------------------------------


def _is_number(node: Expression) -> TypeGuard[Constant]:
    return isinstance(node, Constant) and node.dtype.kind in "fi"


def _with_leaves(
    roots: Sequence[Expression], instead: dict[int, Expression]
) -> tuple[Expression, ...]:
    """The expressions with leaves in place of some constants, by their places in the template."""
    found: dict[Expression, Expression] = {}
    occurs = count()

    def place(operand: Expression) -> Expression:
        return instead.get(next(occurs), operand) if _is_number(operand) else found[operand]

    for node in ordered(*roots):
        if not _is_number(node):
            at_call = isinstance(node, Call)
            operands = [a if at_call and _is_number(a) else place(a) for a in node.operands]
            found[node] = node.with_operands(operands)
    return tuple(map(place, roots))
