"""Expressions as straight-line NumPy code for arguments of known shapes.

Most of the time that few numbers take is spent on finding shapes. Where these are known, elements that are
picked are a view or one ``take``, and what is between the calls of NumPy is one line of code for each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.expression.graph import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Leaf,
    Pick,
    Reduction,
    ordered,
)
from bayesmc.shapes import Shape

#: numbers up to which positions are written out with the batch
FEW = 1 << 12
#: powers that have a function of their own, which ``x ** 2`` of an array takes, too
POWERS: dict[float, Callable[..., np.ndarray]] = {
    2.0: np.square,
    0.5: np.sqrt,
    -1.0: np.reciprocal,
}


def power_of(node: Expression) -> Callable[..., np.ndarray] | None:
    """The function that is a power with this known exponent, if there is one."""
    if not isinstance(node, Elementwise) or node.function is not np.power:
        return None
    base, exponent = node.operands
    if isinstance(exponent, Constant) and not exponent.shape and base.dtype.kind == "f":
        return POWERS.get(float(exponent.value))
    return None


def shaped(
    roots: Sequence[Expression],
    steps: Mapping[Expression, Callable[..., np.ndarray]],
    values: Mapping[Expression, Any],
    otherwise: Callable[[Mapping[str, np.ndarray]], list[np.ndarray]],
) -> Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]:
    """A function of values that have the shapes of some values.

    Parameters
    ----------
    roots : sequence of Expression
    steps : mapping
        Node -> what evaluates it whatever the shapes.
    values : mapping
        Node -> a value of it.
    otherwise : callable
        Does the same where a call gives another shape than it did.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import Program, elementwise, leaf
    >>> x = leaf("x", (2,))
    >>> program = Program([elementwise(np.multiply, x, [1.0, 10.0])])
    >>> [program({"x": np.array([1.0, 2.0]) + i})[0].tolist() for i in range(9)][-1]  # from the fifth on
    [9.0, 100.0]
    """
    scope: dict[str, Any] = {"concatenate": np.concatenate, "otherwise": otherwise}
    names: dict[Expression, str] = {}
    lines = []
    for k, node in enumerate(ordered(*roots)):
        names[node] = f"t{k}"
        if isinstance(node, Leaf):
            scope[f"n{k}"] = node.name
            lines.append(f"t{k} = values[n{k}]")
        elif isinstance(node, Constant):
            scope[f"t{k}"] = node.value
        else:
            right = _written(node, k, names, steps, values, scope)
            lines.append(f"t{k} = {right}")
            if isinstance(node, Call):
                scope[f"s{k}"] = np.shape(values[node])
                lines.append(f"if t{k}.shape != s{k}: return otherwise(values)")
    lines.append(f"return [{', '.join(names[r] for r in roots)}]")
    exec("def function(values):\n    " + "\n    ".join(lines), scope)  # noqa: S102 - names are our own
    return scope["function"]


# ---- private ------------------------------------------------------------------------------------


def _written(
    node: Expression,
    k: int,
    names: Mapping[Expression, str],
    steps: Mapping[Expression, Callable[..., np.ndarray]],
    values: Mapping[Expression, Any],
    scope: dict[str, Any],
) -> str:
    """The right side of a node; what it names goes into the scope."""
    given = [names[a] for a in node.operands]
    power = power_of(node)
    if power is not None:
        scope[f"f{k}"] = power
        return f"f{k}({given[0]})"
    if isinstance(node, Elementwise):
        scope[f"f{k}"] = node.function
        for j, a in enumerate(node.operands):
            batch = np.shape(values[a])[: np.ndim(values[a]) - len(a.shape)]
            if batch and len(a.shape) < len(node.shape):
                ones = (1,) * (len(node.shape) - len(a.shape))
                given[j] += f".reshape({(*batch, *ones, *a.shape)})"
        return f"f{k}({', '.join(given)})"
    if isinstance(node, Reduction):
        scope[f"f{k}"] = node.ufunc.reduce
        axes = tuple(a - len(node.operands[0].shape) for a in node.axes)
        return f"f{k}({given[0]}, {axes})"
    if isinstance(node, Pick) and np.size(values[node]) <= FEW:
        return _picked(node, k, given, values, scope)
    scope[f"f{k}"] = steps[node]
    return f"f{k}({', '.join(given)})"


def _picked(
    node: Pick,
    k: int,
    given: list[str],
    values: Mapping[Expression, Any],
    scope: dict[str, Any],
) -> str:
    shapes = [np.shape(values[a]) for a in node.operands]
    whole: Shape = np.shape(values[node])
    batch = whole[: len(whole) - len(node.shape)]
    start, rows = 0, []
    for a, shape in zip(node.operands, shapes, strict=True):
        own = shape[: len(shape) - len(a.shape)]
        size = math.prod(shape)
        at = start + np.arange(size).reshape((*own, a.size))
        rows.append(np.broadcast_to(at, (*batch, a.size)))
        start += size
    places = np.concatenate(rows, axis=-1)[..., node.positions]
    scope[f"p{k}"] = places
    if len(given) > 1:
        scope[f"d{k}"] = node.dtype
        return f"concatenate(({', '.join(given)}), None, dtype=d{k}).take(p{k})"
    order, (shape,) = np.arange(start), shapes
    if start == places.size and np.array_equal(places.ravel(), order):
        return given[0] if shape == whole else f"{given[0]}.reshape({whole})"
    if len(node.operands[0].shape) > 1 and np.array_equal(
        places, order.reshape(shape).swapaxes(-1, -2)
    ):
        return f"{given[0]}.swapaxes(-1, -2)"
    return f"{given[0]}.take(p{k})"
