"""Affine forms: an expression as an offset plus coefficients times elements of some leaves.

The coefficients are read off the graph, exactly; each entry of the expression names the elements that it
reads by their positions, constant or computed (``mean[label]`` reads element ``label``), so plates cost no
matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
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
    as_expression,
    broadcast,
    elementwise,
    gather,
    ordered,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.functions import Repeated, product
from bayesmc.expression.graph import as_float
from bayesmc.passes.arithmetic import ONE, ZERO, add, is_all, tidy

#: function -> the arguments in each of which it is linear
_LINEAR: dict[Any, tuple[int, ...]] = {
    **dict.fromkeys(
        (
            np.cumsum, np.trace, np.real, np.trapezoid, np.gradient, np.linalg.trace,
            np.add.accumulate, np.add.reduceat,
        ),
        (0,),
    ),
    **dict.fromkeys(
        (
            np.kron, np.tensordot, np.cross, np.linalg.vecdot, np.linalg.matmul, np.linalg.cross,
            np.linalg.tensordot,
        ),
        (0, 1),
    ),
    np.linalg.solve: (1,),
}  # fmt: skip
#: entries of a matrix up to which it is made
_ENTRIES = 1 << 22


@dataclass(frozen=True, eq=False)
class Read:
    """What an expression of shape ``S`` has of one leaf: a sum of k elements for each entry.

    Attributes
    ----------
    gain : Expression, shape (*S, k)
        Coefficients.
    at : Expression of whole numbers, shape (*S, k)
        Flat positions of the elements that they belong to.
    """

    gain: Expression
    at: Expression


@dataclass(frozen=True, eq=False)
class Affine:
    """``offset + sum_k gain[..., k] * leaf.flat[at[..., k]]``, summed over leaves.

    Attributes
    ----------
    offset : Expression, shape S
    reads : dict
        Leaf -> ``Read``.
    """

    offset: Expression
    reads: Mapping[str, Read]


def affine(root: Expression, names: Iterable[str]) -> Affine:
    """The affine form of an expression in some leaves jointly.

    Parameters
    ----------
    root : Expression
    names : iterable of str
        Neither coefficients nor offset depend on these.

    Raises
    ------
    TraceError
        It is not affine, or not seen to be; the message names the operation.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.affine import affine
    >>> x = TracedArray(leaf("x", (3,)))
    >>> form = affine(trace(lambda x: 2 * x[..., 0] - x[..., 2] / 4 + 1, [x]), ["x"])
    >>> form.offset.value, form.reads["x"].gain.value, form.reads["x"].at.value
    (array(1.), array([ 2.  , -0.25]), array([0, 2]))
    """
    form = _forms(root, frozenset(names), {})
    offset = form.offset
    if offset.dtype != float:
        offset = elementwise(as_float, offset)
    return Affine(broadcast(offset, root.shape), form.reads)


def refuse_beyond_affine(root: Expression, names: Iterable[str]) -> None:
    """Refuse an expression that is not affine in some leaves jointly, however large its coefficients are.

    Raises
    ------
    TraceError
        It is not affine, or not seen to be; the message names the operation.
    """
    wanted = frozenset(names)
    for node in ordered(root):
        varying = [k for k, a in enumerate(node.operands) if a.leaves & wanted]
        if not varying or isinstance(node, Pick):
            continue
        if isinstance(node, Call):
            refuse_unless_linear(node, node.operands[varying[0]])
        elif not _keeps_affine(node, varying):
            raise TraceError(f"{_name(node)} is not affine")


def as_product(node: Call, operand: Expression) -> Expression:
    """The same value as a matrix times one operand of a call, all others being constant.

    Raises
    ------
    TraceError
        The call is not known to be linear in it, or something else varies.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.affine import as_product
    >>> x = leaf("x", (3,))
    >>> sums = trace(lambda x: np.cumsum(x, axis=-1), [TracedArray(x)])
    >>> evaluate([as_product(sums, x)], {"x": np.ones(3)})
    [array([1., 2., 3.])]
    """
    made = refuse_unless_linear(node, operand)
    size = operand.size
    if size * node.size > _ENTRIES:
        raise TraceError(f"{node.detail} of {size} numbers is not affine")

    def called(array: np.ndarray) -> np.ndarray:
        shaped = array.reshape(*array.shape[:-1], *operand.shape)
        return made(*(shaped if a is operand else _value(a) for a in node.operands))

    matrix = called(np.eye(size)).reshape(size, node.size).T
    some = np.sin(np.arange(1.0, size + 1))
    if not np.allclose(called(some).reshape(-1), matrix @ some, rtol=1e-9):
        raise TraceError(f"{node.detail} treats a batch as something else")
    flat = product(np.matvec, as_expression(matrix), reshape(operand, (operand.size,)))
    return reshape(flat, node.shape)


def refuse_unless_linear(node: Call, operand: Expression) -> Repeated:
    """The call behind an expression that is linear in one operand, all others being constant.

    Raises
    ------
    TraceError
        It is not known to be, or something else varies.
    """
    made = node.call
    if not isinstance(made, Repeated) or made.output is not None or "dtype" in made.kwargs:
        raise TraceError(f"{node.detail} is not affine")
    places = [k for k in _LINEAR.get(made.function, ()) if k < len(made.args)]
    at = [made.slots[k] for k in places]
    if not any(k is not None and node.operands[k] is operand for k in at):
        raise TraceError(f"{node.detail} is not affine")
    if sum(a is operand or not isinstance(a, Constant) for a in node.operands) > 1:
        raise TraceError(f"{node.detail} is not affine")
    return made


# ---- private ------------------------------------------------------------------------------------


def _keeps_affine(node: Expression, varying: list[int]) -> bool:
    """Whether a value is affine where those operands are that vary."""
    if isinstance(node, Elementwise):
        allowed = _AFFINE_IN.get(node.function, ())
        return tuple(varying) in allowed
    if isinstance(node, Gather):
        return varying == [0]
    return isinstance(node, Reduction) and node.ufunc is np.add


#: function -> the operands that may vary together
_AFFINE_IN: dict[Any, tuple[tuple[int, ...], ...]] = {
    **dict.fromkeys((as_float, np.negative), ((0,),)),
    **dict.fromkeys((np.add, np.subtract), ((0,), (1,), (0, 1))),
    np.multiply: ((0,), (1,)), np.divide: ((0,),), np.where: ((1,), (2,), (1, 2)),
}  # fmt: skip


def _forms(root: Expression, wanted: frozenset[str], found: dict[Expression, Affine]) -> Affine:
    for node in ordered(root):
        if node in found:
            continue
        if not node.leaves & wanted:
            found[node] = Affine(node, {})
        elif isinstance(node, Call):
            (operand, *_) = (a for a in node.operands if a.leaves & wanted)
            found[node] = _forms(as_product(node, operand), wanted, found)
        else:
            found[node] = _step(node, [found[a] for a in node.operands])
    return found[root]


def _step(node: Expression, inner: list[Affine]) -> Affine:
    if isinstance(node, Leaf):
        own = reshape(as_expression(np.arange(node.size)), (*node.shape, 1))
        return Affine(
            broadcast(ZERO, node.shape), {node.name: Read(broadcast(ONE, own.shape), own)}
        )
    if isinstance(node, Pick):
        return _picked(node, inner)
    if isinstance(node, Gather) and not inner[1].reads:
        return _mapped(inner[0], lambda e: gather(e, node.rows), node.operands[0].shape)
    if isinstance(node, Reduction) and node.ufunc is np.add:
        return _summed(node, inner[0])
    if isinstance(node, Elementwise):
        return _elementwise(node, inner)
    raise TraceError(f"{_name(node)} is not affine")


def _name(node: Expression) -> str:
    if isinstance(node, Reduction):
        return f"np.{node.ufunc.__name__}.reduce"
    return f"np.{node.detail}" if isinstance(node, Elementwise) else node.detail or "an index"


def _elementwise(node: Elementwise, inner: list[Affine]) -> Affine:
    function, shape = node.function, node.shape
    if function is as_float:
        return inner[0]
    if function is np.negative:
        return _scaled(inner[0], as_expression(-1.0), shape, np.multiply)
    if function in (np.add, np.subtract):
        first, second = inner
        if function is np.subtract:
            second = _scaled(second, as_expression(-1.0), second.offset.shape, np.multiply)
        return _added(first, second, shape)
    if function is np.multiply and not (inner[0].reads and inner[1].reads):
        one, other = inner if inner[0].reads else inner[::-1]
        return _scaled(one, other.offset, shape, np.multiply)
    if function is np.divide and not inner[1].reads:
        return _scaled(inner[0], inner[1].offset, shape, np.divide)
    if function is np.where and not inner[0].reads:
        return _chosen(node.operands[0], inner[1], inner[2], shape)
    raise TraceError(f"{_name(node)} is not affine")


def _scaled(form: Affine, by: Expression, shape: tuple[int, ...], function: np.ufunc) -> Affine:
    wide = reshape(by, (*by.shape, 1))
    reads = {
        n: Read(tidy(function, _full(r.gain, shape), wide), _full(r.at, shape))
        for n, r in form.reads.items()
    }
    return Affine(broadcast(tidy(function, form.offset, by), shape), reads)


def _full(expression: Expression, shape: tuple[int, ...]) -> Expression:
    """Coefficients or positions of entries that are broadcast to a shape."""
    count = expression.shape[-1]
    lead = len(shape) - len(expression.shape) + 1
    padded = reshape(expression, (1,) * lead + expression.shape)
    return broadcast(padded, (*shape, count))


def _added(first: Affine, second: Affine, shape: tuple[int, ...]) -> Affine:
    reads: dict[str, Read] = {}
    for name in {**first.reads, **second.reads}:
        parts = [
            Read(_full(f.reads[name].gain, shape), _full(f.reads[name].at, shape))
            for f in (first, second)
            if name in f.reads
        ]
        reads[name] = parts[0] if len(parts) == 1 else _joined(*parts)
    return Affine(broadcast(add(first.offset, second.offset), shape), reads)


def _joined(first: Read, second: Read) -> Read:
    """Both, where they read the same elements with the sum of their gains."""
    if first.at is second.at:
        return Read(add(first.gain, second.gain), first.at)
    return Read(_side_by_side(first.gain, second.gain), _side_by_side(first.at, second.at))


def _side_by_side(first: Expression, second: Expression) -> Expression:
    at = np.arange(first.size).reshape(first.shape)
    behind = first.size + np.arange(second.size).reshape(second.shape)
    return pick([first, second], np.concatenate([at, behind], axis=-1))


def _chosen(condition: Expression, first: Affine, second: Affine, shape: tuple[int, ...]) -> Affine:
    """``np.where`` of two forms: gains of what is not chosen are 0."""
    yes, no = tidy(np.where, condition, ONE, ZERO), tidy(np.where, condition, ZERO, ONE)
    offset = tidy(np.where, condition, first.offset, second.offset)
    parts = []
    for form, kept in ((first, yes), (second, no)):
        zero = Affine(ZERO, form.reads)
        parts.append(_scaled(zero, kept, shape, np.multiply))
    both = _added(parts[0], parts[1], shape)
    return Affine(broadcast(offset, shape), both.reads)


def _mapped(
    form: Affine, move: Callable[[Expression], Expression], shape: tuple[int, ...]
) -> Affine:
    """Elements looked up along the first axis."""
    offset = move(broadcast(form.offset, shape))
    return Affine(offset, {n: Read(move(r.gain), move(r.at)) for n, r in form.reads.items()})


def _picked(node: Pick, inner: list[Affine]) -> Affine:
    shapes = [a.shape for a in node.operands]
    offsets = [broadcast(f.offset, s) for f, s in zip(inner, shapes, strict=True)]
    reads = {}
    for name in dict.fromkeys(n for f in inner for n in f.reads):
        count = max(f.reads[name].at.shape[-1] for f in inner if name in f.reads)
        gains, ats = [], []
        for form, shape in zip(inner, shapes, strict=True):
            own = form.reads.get(name)
            gains.append(_padded(None if own is None else own.gain, (*shape, count)))
            ats.append(_padded(None if own is None else own.at, (*shape, count), True))
        rows = node.positions[..., None] * count + np.arange(count)
        reads[name] = Read(pick(gains, rows), pick(ats, rows))
    return Affine(pick(offsets, node.positions), reads)


def _padded(part: Expression | None, shape: tuple[int, ...], whole: bool = False) -> Expression:
    """Coefficients filled up with zeros to a number of elements."""
    zero = as_expression(0) if whole else ZERO
    if part is None:
        return broadcast(zero, shape)
    missing = shape[-1] - part.shape[-1]
    if not missing:
        return part
    return _side_by_side(part, broadcast(zero, (*shape[:-1], missing)))


def _summed(node: Reduction, form: Affine) -> Affine:
    """The elements of all that is summed, one after the other."""
    (operand,) = node.operands
    ndim = len(operand.shape)
    kept = [k for k in range(ndim) if k not in node.axes]
    reads = {}
    for name, read in form.reads.items():
        at = np.arange(read.at.size).reshape(read.at.shape)
        turned = at.transpose(*kept, *node.axes, ndim).reshape(*node.shape, -1)
        gain, place = pick([read.gain], turned), pick([read.at], turned)
        reads[name] = _without_zeros(gain, place)
    return Affine(reduction(np.add, broadcast(form.offset, operand.shape), node.axes), reads)


def _without_zeros(gain: Expression, at: Expression) -> Read:
    """Without the elements that no entry has a coefficient of."""
    if is_all(gain, 0):
        return Read(pick([gain], np.arange(gain.size).reshape(gain.shape)[..., :1]), _first(at))
    return Read(gain, at)


def _first(at: Expression) -> Expression:
    return pick([at], np.arange(at.size).reshape(at.shape)[..., :1])


def _value(node: Expression) -> np.ndarray:
    assert isinstance(node, Constant)
    return node.value
