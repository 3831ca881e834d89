"""Which element of a leaf each entry of an expression reads.

The numbers of the elements go the way that the elements themselves go: through picks, gathers and
broadcasting. Where two of them meet in one entry there is no answer, unless they come in apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

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
    as_expression,
    broadcast,
    elementwise,
    gather,
    leaf,
    ordered,
    pick,
    replaced,
    reshape,
)
from bayesmc.passes.arithmetic import rewritten

#: operations on a node in all terms that are few, and how often each may be in one
_LONG, _SHARED = 2000, 8

#: functions of whole matrices: their batch axes are all but the last two
_OF_MATRICES = frozenset(("cholesky", "inv", "solve", "det", "upper_inverse"))
#: what an entry reads that reads no element
NOTHING = as_expression(-1)


Select = Callable[[Expression], Expression]


def element_read(root: Expression, name: str, numbers: np.ndarray | Expression) -> Expression:
    """The number of the element that each entry reads, -1 where it reads none.

    Parameters
    ----------
    root : Expression
    name : str
    numbers : ndarray of int or Expression, shape of the leaf
        The element that each number of the leaf belongs to.

    Returns
    -------
    Expression of whole numbers, shape of the root

    Raises
    ------
    TraceError
        An entry reads several elements, or may do so.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.reads import element_read
    >>> x = TracedArray(leaf("x", (3, 2)))
    >>> found = trace(lambda x: np.exp(x[..., 0] - x[..., 1]), [x])
    >>> element_read(found, "x", np.array([[0, 0], [1, 1], [2, 2]]))
    <Constant [0 1 2] (3,)>
    """
    found: dict[Expression, Expression] = {}
    for node in ordered(root):
        if name not in node.leaves:
            continue
        if isinstance(node, Leaf):
            found[node] = reshape(as_expression(numbers), node.shape)
        else:
            found[node] = _read(node, [found.get(a) for a in node.operands])
    return found[root] if root in found else broadcast(NOTHING, root.shape)


def elements_read(root: Expression, name: str, numbers: np.ndarray) -> tuple[Expression, ...]:
    """The numbers of the elements that each entry reads, one expression for each way in which they come in.

    As ``element_read``, where the elements of a pair come in apart: ``x[i] - x[j]``.

    Raises
    ------
    TraceError
        An entry reads several elements in one way, or may do so.

    Examples
    --------
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.reads import elements_read
    >>> x = TracedArray(leaf("x", (3,)))
    >>> found = trace(lambda x: abs(2 * x[..., 1:] - x[..., :2]), [x])
    >>> elements_read(found, "x", np.arange(3))
    (<Constant [1 2] (2,)>, <Constant [0 1] (2,)>)
    """
    whole = sunk(root, name)
    ways: dict[Expression, Expression] = {
        read: leaf(f"way {k} into {name}", read.shape, read.dtype)
        for k, read in enumerate(reads(whole, name))
    }
    apart = replaced(whole, ways)
    if name in apart.leaves:
        raise TraceError("an index depends on it")
    found = [
        element_read(apart, way.name, element_read(read, name, numbers))  # type: ignore[attr-defined]
        for read, way in ways.items()
    ]
    return tuple(dict.fromkeys(found))


def same_along(expression: Expression, axes: Sequence[int]) -> Expression | None:
    """The expression without some axes, where it is the same along them; else None.

    Examples
    --------
    >>> from bayesmc.expression import broadcast, leaf
    >>> from bayesmc.passes.reads import same_along
    >>> x = leaf("x", (3,))
    >>> same_along(broadcast(x, (2, 3)), [0]) is x, same_along(x, [0])
    (True, None)
    """
    shape = expression.shape
    gone = {a % len(shape) for a in axes}
    at = np.arange(expression.size).reshape(shape)
    first = pick(
        [expression], at[tuple(0 if k in gone else slice(None) for k in range(len(shape)))]
    )
    kept = tuple(1 if k in gone else n for k, n in enumerate(shape))
    return first if broadcast(reshape(first, kept), shape) is expression else None


def matrix_function(node: Call) -> str:
    """What the function of a call is called."""
    function = getattr(node.call, "function", node.call)
    return getattr(function, "__name__", "")


def sunk(root: Expression, name: str) -> Expression:
    """The expression with all choices of elements that concern a leaf as near to it as they can be.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.reads import sunk
    >>> x = TracedArray(leaf("x", (3,)))
    >>> found = trace(lambda x: np.exp(2 * x)[..., 1], [x])
    >>> found, sunk(found, "x")
    (<Pick ()>, <Elementwise exp ()>)
    """
    return rewritten([root], lambda node, new: _sunk(node.with_operands(new), name))[0]


def is_recursion(terms: Iterable[Expression], name: str) -> bool:
    """Whether terms share most of what they make of a node, as those of a recursion over time do.

    Whoever writes out coefficients term by term would write the square of its length.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.passes.reads import is_recursion
    >>> x, made = leaf("x", ()), [leaf("x", ())]
    >>> for _ in range(100):
    ...     made.append(elementwise(np.add, elementwise(np.multiply, made[-1], 0.5), x))
    >>> is_recursion(made, "x"), is_recursion(made[:20], "x")
    (True, False)
    """
    once: set[Expression] = set()
    count = 0
    for term in terms:
        own = [node for node in ordered(term) if name in node.leaves]
        once.update(own)
        count += len(own)
    return count > max(_LONG, _SHARED * len(once))


# ---- private ------------------------------------------------------------------------------------


def _several() -> TraceError:
    return TraceError("an entry may read several elements")


def _read(node: Expression, inner: list[Expression | None]) -> Expression:
    if isinstance(node, Elementwise):
        parts = [broadcast(a, node.shape) for a in inner if a is not None]
        return _merged(parts)
    if isinstance(node, Pick):
        filled = [
            broadcast(NOTHING if at is None else at, a.shape)
            for at, a in zip(inner, node.operands, strict=True)
        ]
        return _laid_out(filled, node.positions)
    if isinstance(node, Gather):
        return _gathered(node, inner)
    if isinstance(node, Reduction) and inner[0] is not None:
        return _along(inner[0], node.axes)
    assert isinstance(node, Call)
    lead = min(2, *(len(a.shape) for a in node.operands))
    if matrix_function(node) not in _OF_MATRICES:
        lead = max(len(a.shape) for a in node.operands)
    parts = []
    for at in inner:
        if at is not None:
            ndim = len(at.shape)
            parts.append(_along(at, range(max(ndim - lead, 0), ndim)))
    batch = np.broadcast_shapes(*(p.shape for p in parts))
    found = _merged([broadcast(p, batch) for p in parts])
    return broadcast(reshape(found, batch + (1,) * (len(node.shape) - len(batch))), node.shape)


def _laid_out(parts: list[Expression], positions: np.ndarray) -> Expression:
    """A pick of several expressions, of which some may be the same."""
    ends = np.cumsum([0, *(p.size for p in parts)])
    once = list(dict.fromkeys(parts))
    starts = np.cumsum([0, *(p.size for p in once)])
    which = np.searchsorted(ends[1:], positions, side="right")
    moved = np.array([starts[once.index(p)] for p in parts]) - ends[:-1]
    return pick(once, positions + moved[which])


def _merged(parts: Sequence[Expression]) -> Expression:
    """What entries read that read several things."""
    found = parts[0]
    for part in parts[1:]:
        if part is found:
            continue
        if isinstance(part, Constant) and isinstance(found, Constant):
            if ((part.value >= 0) & (found.value >= 0) & (part.value != found.value)).any():
                raise _several()
        elif not _is_alone(part, found):
            raise _several()
        found = elementwise(np.maximum, part, found)
    return found


def _is_alone(*parts: Expression) -> bool:
    """Whether no more than one element is meant by all the numbers in some expressions."""
    met: set[int] = set()
    for part in parts:
        tables = _tables(part)
        if tables is None:
            return False
        met |= tables
    return len(met - {-1}) <= 1


def _tables(at: Expression) -> set[int] | None:
    """All numbers that may come out of picks and gathers of constants, None where that is not known."""
    if isinstance(at, Constant):
        return set(np.unique(at.value).tolist())
    if isinstance(at, Gather):
        return _tables(at.table)
    if isinstance(at, Pick) or (isinstance(at, Elementwise) and at.function is np.maximum):
        inner = [_tables(a) for a in at.operands]
        return None if any(i is None for i in inner) else set().union(*inner)  # type: ignore[arg-type]
    return None


def _gathered(node: Gather, inner: list[Expression | None]) -> Expression:
    at, of_rows = inner
    block = len(node.table.shape) - 1
    if of_rows is not None:
        if at is not None:
            raise TraceError("an index depends on it")
        return broadcast(reshape(of_rows, of_rows.shape + (1,) * block), node.shape)
    assert at is not None
    short = same_along(at, range(1, block + 1)) if block else at
    if short is None:
        row = same_along(at, [0])
        return gather(at, node.rows) if row is None else broadcast(row, node.shape)
    if isinstance(short, Constant) and np.array_equal(short.value, np.arange(short.size)):
        rows = node.rows
        rows = rows if rows.dtype.kind == "i" else elementwise(np.add, rows, 0)
    else:
        rows = gather(short, node.rows)
    return broadcast(reshape(rows, rows.shape + (1,) * block), node.shape)


def _along(at: Expression, axes: Sequence[int]) -> Expression:
    """What is read all along some axes, which go."""
    if not len(axes):
        return at
    short = same_along(at, axes)
    if short is not None:
        return short
    if isinstance(at, Constant):
        most = at.value.max(axis=tuple(axes), initial=-1)
        wide = np.expand_dims(most, tuple(axes))
        if ((at.value >= 0) & (at.value != wide)).any():
            raise _several()
        return as_expression(most)
    if isinstance(at, Pick):
        found = _along_picked(at, axes)
        if found is not None:
            return found
    if not _is_alone(at):
        raise _several()
    shape = tuple(n for k, n in enumerate(at.shape) if k not in set(axes))
    only = max(_tables(at) or {-1})
    return broadcast(as_expression(only), shape)


def _along_picked(at: Pick, axes: Sequence[int]) -> Expression | None:
    """The same where along the axes some numbers are of what reads nothing, and all others one number."""
    idle = [isinstance(a, Constant) and bool((a.value < 0).all()) for a in at.operands]
    ends = np.cumsum([a.size for a in at.operands])
    reads = ~np.array(idle)[np.searchsorted(ends, at.positions, side="right")]
    most = np.where(reads, at.positions, -1).max(axis=tuple(axes), keepdims=True)
    if (reads & (at.positions != most)).any():
        return None
    any_of = np.where(most < 0, at.positions.min(axis=tuple(axes), keepdims=True), most)
    return pick(at.operands, np.squeeze(any_of, tuple(axes)))


def _sunk(node: Expression, name: str) -> Expression:
    if name not in node.leaves or not isinstance(node, (Pick, Gather)):
        return node
    first = node.operands[0]
    if not isinstance(first, Elementwise) or (isinstance(node, Pick) and len(node.operands) > 1):
        return node
    if isinstance(node, Gather) and name in node.rows.leaves:
        return node

    def select(part: Expression) -> Expression:
        whole = broadcast(part, first.shape)
        if isinstance(node, Pick):
            return pick([whole], node.positions)
        assert isinstance(node, Gather)
        return gather(whole, node.rows)

    made = first.with_operands([_sunk(select(a), name) for a in first.operands])
    return broadcast(made, node.shape)


def reads(root: Expression, name: str) -> list[Expression]:
    """The expressions through which a leaf comes in: itself, or elements chosen from it.

    After ``sunk``; the leaf itself, or a pick or gather of it that reads nothing else.
    """
    found: dict[Expression, None] = {}
    chosen: dict[Expression, bool] = {}
    for node in ordered(root):
        if isinstance(node, Leaf):
            chosen[node] = node.name == name
        elif isinstance(node, Pick):
            chosen[node] = all(chosen[a] for a in node.operands)
        elif isinstance(node, Gather):
            chosen[node] = chosen[node.table] and name not in node.rows.leaves
        else:
            chosen[node] = False
        if not chosen[node]:
            found.update(dict.fromkeys(a for a in node.operands if chosen[a]))
    if chosen[root]:
        found[root] = None
    return list(found)
