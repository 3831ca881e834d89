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
    for node in ordered(*roots):
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
    key.append(tuple(number[r] for r in roots))
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
    columns = zip(*(t.constants for t in found), strict=True)
    first = [n for n in ordered(*rows[0]) if isinstance(n, Constant) and n.dtype.kind in "fi"]
    values: dict[str, np.ndarray] = {}
    instead: dict[Expression, Expression] = {}
    for node, column in zip(first, columns, strict=True):
        if all(c is column[0] or np.array_equal(c, column[0], equal_nan=True) for c in column):
            continue
        name = f"constant {len(values)}"
        values[name] = np.stack(column)
        instead[node] = leaf(name, node.shape, node.dtype)
    roots = tuple(replaced(r, instead) if instead else r for r in rows[0])
    return Stacked(roots, values, tuple(t.leaves for t in found))
