"""Equality up to constants: the slices of a template, the like nodes of a loop, as one stacked expression."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.expression import Constant, Expression, Leaf, leaf, ordered, replaced


@dataclass(frozen=True, eq=False)
class Template:
    """Expressions that are the same but for constants and the names of leaves.

    Attributes
    ----------
    key : hashable
        Equal for those that are alike.
    constants : tuple of ndarray
        Real and whole ones, in the order in which they occur.
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
    root : Expression
        Its leaves are those of the first, and ``constant 0``, ``constant 1``, ... for constants that differ.
    constants : dict
        Leaf -> the constants of all of them, shape ``(count, *shape)``.
    leaves : tuple of tuple of str
        For each the names that stand for the first one's leaves.
    """

    root: Expression
    constants: dict[str, np.ndarray]
    leaves: tuple[tuple[str, ...], ...]


def template(root: Expression) -> Template:
    """What an expression is, apart from its constants and the names of its leaves.

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
    for node in ordered(root):
        number[node] = len(number)
        if isinstance(node, Constant) and node.dtype.kind in "fi":
            constants.append(node.value)
            key.append(("constant", node.shape, node.dtype.str))
        elif isinstance(node, Leaf):
            place = leaves.setdefault(node.name, len(leaves))
            key.append(("leaf", place, node.shape, node.dtype.str, node.states))
        else:
            own = tuple(number[a] for a in node.operands)
            key.append((type(node).__name__, own, node.content, node.shape))
    return Template(tuple(key), tuple(constants), tuple(leaves))


def stacked(roots: Sequence[Expression]) -> Stacked | None:
    """One expression for all, or None where they are not alike."""
    found = [template(r) for r in roots]
    if len({t.key for t in found}) != 1:
        return None
    columns = list(zip(*(t.constants for t in found), strict=True))
    first = [n for n in ordered(roots[0]) if isinstance(n, Constant) and n.dtype.kind in "fi"]
    values: dict[str, np.ndarray] = {}
    instead: dict[Expression, Expression] = {}
    for node, column in zip(first, columns, strict=True):
        if all(np.array_equal(c, column[0], equal_nan=True) for c in column):
            continue
        name = f"constant {len(values)}"
        values[name] = np.stack(column)
        instead[node] = leaf(name, node.shape, node.dtype)
    root = replaced(roots[0], instead) if instead else roots[0]
    return Stacked(root, values, tuple(t.leaves for t in found))


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
