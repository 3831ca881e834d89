"""Sums over many like expressions as sums over one: log factors of a template's slices, of a loop's nodes.

What is the same but for constants and the names of leaves becomes one expression with one more axis.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from bayesmc.expression import Expression, Leaf, constant, ordered, pick, reduction
from bayesmc.passes.templates import Template, stacked_rows, template
from bayesmc.passes.widening import widened

#: like expressions from which on they become one
FEWEST = 4


def sums_of(expressions: Sequence[Expression]) -> list[Expression]:
    """The sums of expressions over all their elements; those of like ones together.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, evaluate, leaf
    >>> from bayesmc.passes.alike import sums_of
    >>> made = [elementwise(np.multiply, leaf(f"x{t}", ()), float(t)) for t in range(5)]
    >>> sums = sums_of(made)
    >>> len(sums), evaluate(sums, {f"x{t}": np.array(10.0**t) for t in range(5)})
    (1, [np.float64(43210.0)])
    """
    groups: dict[Hashable, list[tuple[Expression, Template]]] = {}
    for expression in expressions:
        found = template(expression)
        groups.setdefault(found.key, []).append((expression, found))
    sums = []
    for members in groups.values():
        if len(members) < FEWEST or not members[0][0].leaves:
            sums += [_sum(e) for e, _ in members]
        else:
            sums.append(_sum(_as_one(members)))
    return sums


# ---- private ------------------------------------------------------------------------------------


def _sum(expression: Expression) -> Expression:
    return reduction(np.add, expression, range(len(expression.shape)))


def _as_one(members: Sequence[tuple[Expression, Template]]) -> Expression:
    """Like expressions as one, the members in front of its shape."""
    together = stacked_rows([(e,) for e, _ in members], [t for _, t in members])
    assert together is not None, "their templates are alike"
    leaves = {n.name: n for e, _ in members for n in ordered(e) if isinstance(n, Leaf)}
    values: dict[str, Expression] = {n: constant(v) for n, v in together.constants.items()}
    for names in zip(*together.leaves, strict=True):
        if len(set(names)) > 1:
            one = leaves[names[0]]
            places = np.arange(len(names) * one.size).reshape(len(names), *one.shape)
            distinct = {name: k for k, name in enumerate(dict.fromkeys(names))}
            first = one.size * np.array([distinct[n] for n in names])
            places = first.reshape((-1,) + (1,) * len(one.shape)) + np.arange(one.size).reshape(
                one.shape
            )
            values[names[0]] = pick([leaves[n] for n in distinct], places)
    return widened(together.root, values, len(members))
