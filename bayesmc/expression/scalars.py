"""Small expressions as straight-line code on Python's floats: a call of NumPy takes as long as thirty.

Every element becomes a variable, equal ones once. What Python refuses (a logarithm of zero, a division
by it, the root of a negative number) and what has no rule here is evaluated as arrays, which say in NumPy's
way what follows.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from bayesmc.expression.evaluate import Program
from bayesmc.expression.graph import (
    Call,
    Constant,
    Elementwise,
    Expression,
    Leaf,
    Pick,
    Reduction,
    as_float,
    ordered,
)
from bayesmc.shapes import Shape

#: operations of one call of NumPy's time
_PER_CALL = 30
#: calls that a factor or an inverse takes the time of
_MATRIX = 5
#: elements of a graph up to which code is made
_MOST = 10_000
#: terms of one sum in a line of code
_SIGNS = 100


class SmallProgram:
    """Expressions made ready to be evaluated often, for few elements at a time.

    As ``Program``, with results that may differ from its by rounding.

    Parameters
    ----------
    roots : sequence of Expression

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.expression.scalars import SmallProgram
    >>> x = leaf("x", (2,))
    >>> program = SmallProgram([elementwise(np.multiply, x, [1.0, 10.0])])
    >>> program({"x": np.array([[1.0, 2.0], [3.0, 4.0]])})
    [array([[ 1., 20.],
           [ 3., 40.]])]
    """

    def __init__(self, roots: Sequence[Expression]) -> None:
        self._roots = tuple(roots)
        nodes = ordered(*roots)
        leaves = (n for n in nodes if isinstance(n, Leaf))
        self._leaves = tuple((n.name, len(n.shape), n.size) for n in leaves)
        self._calls = sum(_MATRIX if _is_matrix(n) else bool(n.operands) for n in nodes)
        self._size = sum(n.size for n in nodes)
        ends = np.cumsum([0, *(r.size for r in roots)]).tolist()
        self._parts = [
            (slice(a, b), r.shape)
            for r, (a, b) in zip(roots, itertools.pairwise(ends), strict=True)
        ]

    @cached_property
    def _arrays(self) -> Program:
        return Program(self._roots)

    @cached_property
    def _code(self) -> tuple[Callable[..., Any], int] | None:
        """The function, and the largest batch that it pays for."""
        if self._size > _MOST or not self._leaves:
            return None
        try:
            function, count = _compiled(self._roots, self._leaves)
        except NotImplementedError:
            return None
        count += sum(size for *_, size in self._leaves) + sum(r.size for r in self._roots)
        most = self._calls * _PER_CALL // max(count, 1)
        return (function, most) if most else None

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        code = self._code
        if code is None:
            return self._arrays(values)
        function, most = code
        batch: Shape = ()
        given = []
        for name, rank, size in self._leaves:  # one entry, mostly
            value = values[name]
            if value.size != size:
                return self._entries(function, most, values)
            if value.ndim > rank:
                batch = value.shape[: value.ndim - rank]
            given.append(value.ravel().tolist())
        try:
            flat = np.array(function(*[[rows] for rows in given]))
        except (ArithmeticError, ValueError):
            return self._arrays(values)
        return [flat[part].reshape(batch + shape) for part, shape in self._parts]

    def _entries(
        self, function: Callable[..., Any], most: int, values: Mapping[str, np.ndarray]
    ) -> list[np.ndarray]:
        """The same for several entries, one after the other."""
        batch: Shape = ()
        count, given = 1, []
        for name, rank, size in self._leaves:
            value = values[name]
            lead = value.shape[: value.ndim - rank]
            if lead and lead != batch:
                if batch or (count := math.prod(lead)) > most:
                    return self._arrays(values)
                batch = lead
            given.append(value.reshape(-1, size).tolist() if size else [[]] * math.prod(lead))
        given = [rows if len(rows) == count else rows * count for rows in given]
        try:
            flat = np.array(function(*given)).reshape(count, -1)
        except (ArithmeticError, ValueError):
            return self._arrays(values)
        return [flat[:, part].reshape(batch + shape) for part, shape in self._parts]


def upper_inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverses of upper triangles with positive diagonals: back substitution, nothing is pivoted."""
    return np.linalg.inv(matrix)


# ---- private ------------------------------------------------------------------------------------


def _is_matrix(node: Expression) -> bool:
    return isinstance(node, Call) and node.call in _MATRICES


class _Lines:
    """Assignments, one for every different right side."""

    def __init__(self) -> None:
        self.lines: dict[str, str] = {}
        self._names: dict[str, str] = {}

    def __call__(self, right: str) -> str:
        found = self._names.get(right)
        if found is None:
            found = self._names[right] = f"t{len(self.lines)}"
            self.lines[found] = right
        return found

    def needed(self, names: Sequence[str]) -> list[str]:
        """The assignments that names rest on."""
        kept, found = set(names), []
        for name, right in reversed(self.lines.items()):
            if name in kept:
                found.append(f"{name} = {right}")
                kept.update(_NAME.findall(right))
        return found[::-1]


def _operation(function: Any, row: Sequence[str], lines: _Lines) -> str:
    """The name of what a function makes of some elements; in one order where that does not matter."""
    if function in (np.add, np.multiply):
        row = sorted(row)
        neutral = "0.0" if function is np.add else "1.0"
        if neutral in row:
            return row[1] if row[0] == neutral else row[0]
    return lines(_TEXTS[function].format(*row))


@lru_cache(maxsize=256)  # equal expressions are one object: a model asked again has its code
def _compiled(
    roots: tuple[Expression, ...], leaves: tuple[tuple[str, int, int], ...]
) -> tuple[Callable[..., Any], int]:
    """A function of the leaves' elements (a list of each leaf's for every entry), and its operations."""
    lines = _Lines()
    names = {name: f"v{k}" for k, (name, _, _) in enumerate(leaves)}
    made: dict[Expression, np.ndarray] = {}
    for node in ordered(*roots):
        made[node] = _written(node, [made[a] for a in node.operands], names, lines)
    results = [x for r in roots for x in made[r].ravel()]
    needed = lines.needed(results)
    heads = [
        f"({''.join(f'{v}_{i}, ' for i in range(size))})" if size else v
        for (_, _, size), v in zip(leaves, names.values(), strict=True)
    ]
    rows = ", ".join(names.values())
    text = f"def function({rows}):\n    found = []\n"
    text += f"    for {', '.join(heads)}, in zip({rows}, strict=True):\n        "
    text += "\n        ".join([*needed, f"found += ({''.join(f'{x}, ' for x in results)})"])
    text += "\n    return found"
    scope: dict[str, Any] = {
        "log": math.log, "log1p": math.log1p, "exp": math.exp, "sqrt": math.sqrt, "pow": math.pow,
        "lgamma": math.lgamma, "inf": math.inf, "nan": math.nan,
    }  # fmt: skip
    exec(text, scope)  # noqa: S102 - nothing of a user's is in the text
    return scope["function"], len(needed)


def _written(
    node: Expression, operands: list[np.ndarray], names: Mapping[str, str], lines: _Lines
) -> np.ndarray:
    """The names of a node's elements."""
    if isinstance(node, Leaf):
        return _objects([f"{names[node.name]}_{i}" for i in range(node.size)], node.shape)
    if isinstance(node, Constant):
        return _objects([_literal(x) for x in node.value.ravel().tolist()], node.shape)
    if isinstance(node, Pick):
        flat = np.concatenate([a.ravel() for a in operands])
        return flat[node.positions.ravel()].reshape(node.shape)
    if isinstance(node, Reduction) and node.ufunc in (np.add, np.maximum, np.minimum):
        (a,) = operands
        moved = np.moveaxis(a, node.axes, range(-len(node.axes), 0))
        rows = moved.reshape(node.size, -1).tolist() if a.size else [[]] * node.size
        return _objects([_reduced(node.ufunc, row, lines) for row in rows], node.shape)
    if isinstance(node, Elementwise) and node.function in _TEXTS:
        function = node.function
        wide = [np.broadcast_to(a, node.shape).ravel() for a in operands]
        return _objects(
            [_operation(function, row, lines) for row in zip(*wide, strict=True)], node.shape
        )
    if (
        isinstance(node, Elementwise)
        and node.function is as_float
        and node.operands[0].dtype != bool
    ):
        return operands[0]
    if isinstance(node, Call) and node.call in _MATRICES and len(node.operands) == 1:
        (a,) = operands
        rule, d = _MATRICES[node.call], a.shape[-1]
        if not a.size:
            raise NotImplementedError
        return np.stack([rule(m, lines) for m in a.reshape(-1, d, d)]).reshape(a.shape)
    if isinstance(node, Call) and node.call in _PRODUCTS:
        return _multiplied(node, operands, lines)
    raise NotImplementedError


def _reduced(ufunc: np.ufunc, row: list[str], lines: _Lines) -> str:
    if ufunc is np.add:
        return _summed(row, lines)
    if not row:
        raise NotImplementedError
    found = row[0]
    for x in row[1:]:
        found = _operation(ufunc, (found, x), lines)
    return found


def _summed(terms: list[str], lines: _Lines) -> str:
    """Their sum, of many in parts: Python's compiler goes one level deeper with every sign."""
    while len(terms) > _SIGNS:
        starts = range(0, len(terms), _SIGNS)
        terms = [lines(" + ".join(terms[k : k + _SIGNS])) for k in starts]
    return lines(" + ".join(terms)) if terms else "0.0"


def _multiplied(node: Call, operands: list[np.ndarray], lines: _Lines) -> np.ndarray:
    """A product of matrices or vectors whose batches are equal."""
    left, right, out = _PRODUCTS[node.call]
    a, b = operands
    sizes = dict(zip(left + right, (*a.shape[-len(left) :], *b.shape[-len(right) :]), strict=False))
    sizes |= dict(zip(right, b.shape[-len(right) :], strict=True))
    a = a.reshape(-1, *a.shape[-len(left) :])
    b = b.reshape(-1, *b.shape[-len(right) :])
    if len(a) != len(b) or not node.size:
        raise NotImplementedError
    found = []
    for one, other in zip(a, b, strict=True):
        for at in np.ndindex(*(sizes[c] for c in out)):
            place = dict(zip(out, at, strict=True))
            terms = []
            for j in range(sizes["j"]):
                where = {**place, "j": j}
                x, y = one[tuple(where[c] for c in left)], other[tuple(where[c] for c in right)]
                if "0.0" not in (x, y):
                    terms.append(" * ".join(sorted((x, y))))
            found.append(_summed(terms, lines))
    return _objects(found, node.shape)


def _objects(items: list[str], shape: tuple[int, ...]) -> np.ndarray:
    found = np.empty(len(items), dtype=object)
    found[:] = items
    return found.reshape(shape)


def _literal(x: Any) -> str:
    if isinstance(x, bool):
        return repr(x)
    return repr(float(x)) if x >= 0 else f"({float(x)!r})"


def _cholesky(a: np.ndarray, lines: _Lines) -> np.ndarray:
    found = np.full(a.shape, "0.0", dtype=object)
    for i in range(len(a)):
        for j in range(i + 1):
            rest = "".join(f" - {found[i, k]} * {found[j, k]}" for k in range(j))
            right = f"{a[i, j]}{rest}"
            found[i, j] = lines(f"sqrt({right})" if i == j else f"({right}) / {found[j, j]}")
    return found


def _upper_inverse(a: np.ndarray, lines: _Lines) -> np.ndarray:
    found = np.full(a.shape, "0.0", dtype=object)
    for j in range(len(a)):
        found[j, j] = lines(f"1.0 / {a[j, j]}")
        for i in reversed(range(j)):
            total = " + ".join(f"{a[i, k]} * {found[k, j]}" for k in range(i + 1, j + 1))
            found[i, j] = lines(f"-({total}) / {a[i, i]}")
    return found


_MATRICES: dict[Any, Callable[[np.ndarray, _Lines], np.ndarray]] = {
    np.linalg.cholesky: _cholesky,
    upper_inverse: _upper_inverse,
}
#: axes of both factors, and of the product
_PRODUCTS: dict[Any, tuple[str, str, str]] = {
    np.matmul: ("ij", "jk", "ik"), np.matvec: ("ij", "j", "i"),
    np.vecmat: ("j", "jk", "k"), np.vecdot: ("j", "j", ""),
}  # fmt: skip
#: what stands for an element that was computed
_NAME = re.compile(r"\bt\d+\b")
#: right sides, and what happens to NaN as in NumPy
_TEXTS: dict[Any, str] = {
    np.add: "{} + {}", np.subtract: "{} - {}", np.multiply: "{} * {}", np.divide: "{} / {}",
    np.negative: "-{}", np.square: "{0} * {0}", np.sqrt: "sqrt({})", np.log: "log({})",
    np.log1p: "log1p({})", np.exp: "exp({})", np.reciprocal: "1.0 / {}", np.power: "pow({}, {})",
    np.float_power: "pow({}, {})", np.abs: "abs({})", np.where: "{1} if {0} else {2}",
    np.maximum: "{0} if {0} >= {1} or {0} != {0} else {1}",
    np.minimum: "{0} if {0} <= {1} or {0} != {0} else {1}",
    np.greater: "{} > {}", np.greater_equal: "{} >= {}", np.less: "{} < {}",
    np.less_equal: "{} <= {}", np.equal: "{} == {}",
}  # fmt: skip
