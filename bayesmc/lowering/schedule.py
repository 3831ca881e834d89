"""In which order a kernel computes what it keeps, so that loops over the same elements are one loop.

Loops that run over the same shape, and of which none waits for another, share what they read and compute: the
sum of log densities and the derivatives of their terms take their exponentials once.
"""

from __future__ import annotations

from collections.abc import Sequence

from bayesmc.expression import Call, Expression, Pick, Reduction
from bayesmc.lowering.layout import Layout, adds_in_place, is_few, is_given
from bayesmc.shapes import Shape

#: nodes up to which loops are put together
_MOST = 600


def scheduled(nodes: Sequence[Expression], layout: Layout) -> list[list[Expression]]:
    """Nodes that are computed for later, in groups whose loops are one; operands first."""
    asked = [n for n in nodes if _is_asked(n, layout)]
    if len(nodes) > _MOST:
        return [[n] for n in asked]
    waits = _waits(nodes, asked, layout)
    shapes = {n: loop_shape(n, layout) for n in asked}
    found: list[list[Expression]] = []
    left, done = list(asked), set[Expression]()
    while left:
        ready = [n for n in left if waits[n] <= done]
        alone = [n for n in ready if shapes[n] is None]
        if alone:
            found += [[n] for n in alone]
            taken = alone
        else:
            taken = [n for n in ready if shapes[n] == shapes[ready[0]]]
            found.append(taken)
        done |= set(taken)
        left = [n for n in left if n not in done]
    return found


def loop_shape(node: Expression, layout: Layout) -> Shape | None:
    """The shape that a node's loop runs over, if it takes one element after the other; else None."""
    if is_sum(node):
        return node.operands[0].shape
    if is_few(node) or node not in layout.kept or isinstance(node, Call):
        return None
    if isinstance(node, Pick) and len(node.operands) > 1:
        return None
    return None if isinstance(node, Reduction) and adds_in_place(node) else node.shape


def is_sum(node: Expression) -> bool:
    """Whether it reduces an array of many elements to one number."""
    return isinstance(node, Reduction) and node.size == 1 and not is_few(node.operands[0])


# ---- private ------------------------------------------------------------------------------------


def _is_asked(node: Expression, layout: Layout) -> bool:
    return not is_given(node) and (is_few(node) or node in layout.kept)


def _waits(
    nodes: Sequence[Expression], asked: Sequence[Expression], layout: Layout
) -> dict[Expression, frozenset[Expression]]:
    """For each node those that are computed before it, of the same list."""
    mine, reached = set(asked), dict[Expression, frozenset[Expression]]()
    for node in nodes:
        found: frozenset[Expression] = frozenset()
        for operand in node.operands:
            found |= {operand} if operand in mine else reached.get(operand, frozenset())
        reached[node] = found
    return reached
