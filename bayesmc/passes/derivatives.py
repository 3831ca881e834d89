"""Derivatives of expressions, as expressions: along directions, or of a number by everything below it.

At a kink (``np.abs`` at 0, ``np.maximum`` of equal numbers) a derivative is the mean of those on both sides,
so that kinks that cancel do (``x - x.max()`` in a softmax); what is constant in pieces has the derivative 0.
Branches that ``np.where`` leaves out add nothing, even where their own derivative overflows.

References
----------
Griewank and Walther (2008), Evaluating Derivatives, 2nd ed., sec. 3.1 (forward) and 3.2 (reverse); Giles
(2008), Collected matrix derivative results for forward and reverse mode (matrices).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

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
    TracedArray,
    as_expression,
    broadcast,
    elementwise,
    gather,
    ordered,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.graph import CASTS
from bayesmc.passes.adjoints import (
    call_adjoints,
    call_tangent,
    excluded_products,
    gathered,
    scattered,
)
from bayesmc.passes.arithmetic import ONE, ZERO, add, divide, is_all, multiply, tidy
from bayesmc.passes.partials import PIECES, partials


def tangent(root: Expression, directions: Mapping[str, Expression]) -> Expression:
    """The derivative of an expression as some leaves move along directions.

    Parameters
    ----------
    root : Expression
    directions : mapping
        Leaf -> how its elements move, an expression of the leaf's shape.

    Raises
    ------
    TraceError
        Something on the way has no derivative that is known.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import as_expression, elementwise, evaluate, leaf
    >>> from bayesmc.passes.derivatives import tangent
    >>> x = leaf("x", ())
    >>> slope = tangent(elementwise(np.sin, x), {"x": as_expression(1.0)})
    >>> evaluate([slope], {"x": np.array([0.0, np.pi])})
    [array([ 1., -1.])]
    """
    moving = frozenset(directions)
    found: dict[Expression, Expression] = {}
    for node in ordered(root):
        if isinstance(node, Leaf) and node.name in moving:
            found[node] = broadcast(directions[node.name], node.shape)
        elif not node.leaves & moving or node.dtype.kind != "f":
            found[node] = ZERO
        else:
            found[node] = _pushed(node, [found[a] for a in node.operands])
    return broadcast(found[root], root.shape)


def gradient(root: Expression, names: Iterable[str]) -> dict[str, Expression]:
    """The derivatives of a number by some leaves.

    Parameters
    ----------
    root : Expression of shape ()
    names : iterable of str

    Returns
    -------
    dict
        Leaf -> an expression of the leaf's shape; without those that the number does not depend on.

    Raises
    ------
    TraceError

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, evaluate, leaf, reduction
    >>> from bayesmc.passes.derivatives import gradient
    >>> x = leaf("x", (2,))
    >>> total = reduction(np.add, elementwise(np.exp, x), [0])
    >>> evaluate([gradient(total, ["x"])["x"]], {"x": np.array([0.0, 1.0])})[0].round(3)
    array([1.   , 2.718])
    """
    if root.shape:
        raise TraceError(f"the gradient of an array of shape {root.shape}, not of a number")
    wanted = frozenset(names)
    nodes = ordered(root)
    adjoints: dict[Expression, Expression] = {root: ONE}
    masked: set[Expression] = set()
    for node in reversed(nodes):
        own = adjoints.get(node)
        if own is None or not node.operands or not node.leaves & wanted:
            continue
        if node.dtype.kind != "f":
            continue
        own = broadcast(own, node.shape)
        below = _pulled(node, own, wanted, node in masked)
        for operand, part in zip(node.operands, below, strict=True):
            if part is None or not operand.leaves & wanted or operand.dtype.kind != "f":
                continue
            part = _unbroadcast(part, operand.shape)
            adjoints[operand] = add(adjoints[operand], part) if operand in adjoints else part
            if node in masked or _leaves_out(node):
                masked.add(operand)
    return {
        n.name: broadcast(adjoints.get(n, ZERO), n.shape)
        for n in nodes
        if isinstance(n, Leaf) and n.name in wanted
    }


def slopes(node: Elementwise) -> list[Expression | None]:
    """Partial derivatives by each operand; None where it is constant in pieces."""
    if node.function is np.where:
        condition = node.operands[0]
        return [None, tidy(np.where, condition, ONE, ZERO), tidy(np.where, condition, ZERO, ONE)]
    if node.function in PIECES or node.dtype.kind != "f":
        return [None] * len(node.operands)
    if node.function in CASTS:
        return [ONE]
    rules = _KINKED.get(node.function) or partials(node.function)
    if rules is None:
        raise TraceError(f"no derivative of {node.detail} is known")
    values = [TracedArray(a) for a in (*node.operands, node)]
    return [_as_expression(rule(*values)) for rule in rules]


def jumps(roots: Iterable[Expression], names: Iterable[str]) -> Expression:
    """Whether something of what leaves move that is constant in pieces jumps just where they are.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, evaluate, leaf
    >>> from bayesmc.passes.derivatives import jumps
    >>> step = elementwise(np.floor, leaf("x", ()))
    >>> evaluate([jumps([step], ["x"])], {"x": np.array([0.5, 1.0])})
    [array([False,  True])]
    """
    moving, found = frozenset(names), as_expression(False)
    for node in ordered(*roots):
        rule = PIECES.get(node.function) if isinstance(node, Elementwise) else None
        if rule is None or not node.leaves & moving:
            continue
        at = as_expression(rule(*map(TracedArray, (*node.operands, node))).expression)
        whole = reduction(np.logical_or, at, range(len(at.shape)))
        found = elementwise(np.logical_or, found, whole)
    return found


# ---- private ------------------------------------------------------------------------------------


def _larger(a: Any, b: Any, y: Any) -> Any:
    return np.where(np.equal(a, b), 0.5, np.where(np.greater(a, b), 1.0, 0.0))


def _smaller(a: Any, b: Any, y: Any) -> Any:
    return _larger(b, a, y)


def _of_length(side: Any, length: Any) -> Any:
    return side / np.where(np.equal(length, 0.0), 1.0, length)


_KINKED: Mapping[Any, tuple[Any, ...]] = {
    np.absolute: (lambda x, y: np.sign(x),),
    np.fabs: (lambda x, y: np.sign(x),),
    np.maximum: (_larger, _smaller),
    np.fmax: (_larger, _smaller),
    np.minimum: (_smaller, _larger),
    np.fmin: (_smaller, _larger),
    np.hypot: (lambda a, b, y: _of_length(a, y), lambda a, b, y: _of_length(b, y)),
    np.remainder: (lambda a, b, y: 1.0, lambda a, b, y: np.negative(np.floor_divide(a, b))),
}


def _as_expression(value: Any) -> Expression:
    from_array = getattr(value, "expression", value)
    return from_array if isinstance(from_array, Expression) else multiply(ONE, from_array)


def _pushed(node: Expression, moved: list[Expression]) -> Expression:
    """How a value moves when its operands move so."""
    if all(is_all(m, 0) for m in moved):
        return ZERO
    if isinstance(node, Elementwise) and node.function is np.where:
        return tidy(np.where, node.operands[0], moved[1], moved[2])  # the other stays out, even NaN
    if isinstance(node, Elementwise):
        total = ZERO
        for slope, own in zip(slopes(node), moved, strict=True):
            if slope is not None and not is_all(own, 0):
                total = add(total, _times(slope, own, _leaves_out(node)))
        return total
    full = [broadcast(m, a.shape) for m, a in zip(moved, node.operands, strict=True)]
    if isinstance(node, Pick):
        return pick(full, node.positions)
    if isinstance(node, Gather):
        return gather(full[0], node.rows)
    if isinstance(node, Reduction):
        part = _reduced_slopes(node)
        inner = full[0] if part is None else _times(part, full[0], _leaves_out(node))
        return reduction(np.add, inner, node.axes)
    assert isinstance(node, Call)
    return call_tangent(node, full)


def _pulled(
    node: Expression, own: Expression, wanted: frozenset[str], masked: bool
) -> list[Expression | None]:
    """What a value's adjoint adds to those of its operands."""
    if isinstance(node, Elementwise) and node.function is np.where:
        condition = node.operands[
            0
        ]  # an adjoint that is no number stays with the branch that is left out
        return [None, tidy(np.where, condition, own, ZERO), tidy(np.where, condition, ZERO, own)]
    if isinstance(node, Elementwise):
        return [
            None if s is None or not a.leaves & wanted else _times(own, s, masked)
            for a, s in zip(node.operands, slopes(node), strict=True)
        ]
    if isinstance(node, Pick):
        return list(_picked_back(node, own, wanted))
    if isinstance(node, Gather):
        return [gathered(own, node.rows, node.table.shape), None]
    if isinstance(node, Reduction):
        (operand,) = node.operands
        kept = tuple(1 if k in node.axes else n for k, n in enumerate(operand.shape))
        wide = broadcast(reshape(own, kept), operand.shape)
        part = _reduced_slopes(node)
        return [wide if part is None else _times(wide, part, masked)]
    assert isinstance(node, Call)
    return call_adjoints(node, own)


def _leaves_out(node: Expression) -> bool:
    """Whether some operands count for nothing at some values: what is below need not be finite there.

    A branch that is not taken; a term of a sum of exponentials that is impossible, minus infinity.
    """
    function = getattr(node, "function", None) or getattr(node, "ufunc", None)
    return function in (np.where, np.logaddexp, np.logaddexp2)


def _times(adjoint: Expression, slope: Expression, masked: bool) -> Expression:
    """Their product; 0 where nothing comes in, though the slope may not be finite there."""
    product = multiply(adjoint, slope)
    if not masked or isinstance(product, Constant) or isinstance(slope, Constant):
        return product
    return tidy(np.where, elementwise(np.equal, adjoint, 0.0), ZERO, product)


def _picked_back(
    node: Pick, own: Expression, wanted: frozenset[str]
) -> Iterable[Expression | None]:
    first = 0
    for operand in node.operands:
        last = first + operand.size
        if not operand.leaves & wanted:
            yield None
        else:
            inside = (node.positions >= first) & (node.positions < last)
            some = own if inside.all() else pick([own], np.flatnonzero(inside))
            yield scattered(some, node.positions[inside].reshape(some.shape) - first, operand.shape)
        first = last


def _reduced_slopes(node: Reduction) -> Expression | None:
    """Partial derivatives of a reduction by the elements of its operand; None for a sum."""
    (operand,) = node.operands
    if node.ufunc is np.add:
        return None
    kept = tuple(1 if k in node.axes else n for k, n in enumerate(operand.shape))
    whole = reshape(node, kept)
    if node.ufunc is np.multiply:
        return excluded_products(operand, node.axes)
    if node.ufunc in (np.logaddexp,):
        share = elementwise(np.exp, elementwise(np.subtract, operand, whole))
        nothing = elementwise(np.equal, whole, -np.inf)  # no term is possible
        return tidy(np.where, nothing, ZERO, share)
    if node.ufunc in (np.maximum, np.minimum, np.fmax, np.fmin):
        top = tidy(np.where, elementwise(np.equal, operand, whole), ONE, ZERO)
        count = reshape(reduction(np.add, top, node.axes), kept)
        return divide(top, count)
    raise TraceError(f"no derivative of {node.ufunc.__name__}.reduce is known")


def _unbroadcast(part: Expression, shape: tuple[int, ...]) -> Expression:
    """Sums over the axes along which an operand was broadcast."""
    if part.shape == shape:
        return part
    whole = np.broadcast_shapes(part.shape, shape)
    part = broadcast(part, whole)
    lead = len(whole) - len(shape)
    inner = [lead + k for k, n in enumerate(shape) if n == 1 and whole[lead + k] != 1]
    return reshape(reduction(np.add, part, [*range(lead), *inner]), shape)
