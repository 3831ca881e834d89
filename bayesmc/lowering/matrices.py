"""Linear algebra of small matrices: Cholesky factors, inverses, linear systems, determinants.

Loops over the matrices of a batch; each is copied to the stack and worked on in place. Where NumPy raises,
the result is NaN, as in ``passes.guarded``.

References
----------
Golub and Van Loan, Matrix Computations, 4th ed., sec. 3.4 (partial pivoting) and 4.2 (Cholesky).
"""

from __future__ import annotations

import math

import numpy as np

from bayesmc.expression import Call, Expression
from bayesmc.lowering.code import REAL, TRUTH, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary
from bayesmc.lowering.layout import linear_algebra
from bayesmc.lowering.places import flat
from bayesmc.lowering.writer import Place, Writer


def keep_matrices(w: Writer, node: Call) -> None:
    """Write the results of all matrices of a batch to the node's memory."""
    function, code = linear_algebra(node), w.code
    size = node.operands[0].shape[-1]
    core = 0 if function is np.linalg.det else 2
    batch, columns = node.shape[: len(node.shape) - core], node.shape[-1] if core else 0
    work, found = w.scratch("work", size * size), w.scratch("found", max(size * columns, 1))
    is_triangle = (
        function is np.linalg.inv and linear_algebra(node.operands[0]) is np.linalg.cholesky
    )

    def each(at: Place) -> None:
        _copied(w, node.operands[0], at, work)
        if function is np.linalg.solve:
            _copied(w, node.operands[1], at, found)
        elif function is np.linalg.inv:
            _identity(w, size, found)
        if function is np.linalg.cholesky:
            _called(code, "cholesky", work, size)
        elif is_triangle:
            _called(code, "forward", work, found, size, columns)
        else:
            det = _called(code, "eliminated", work, found, size, columns)
        if not core:
            code.store(w.pointers[node], flat(batch, at), det)
            return
        source = work if function is np.linalg.cholesky else found

        def put(inner: Place) -> None:
            value = code.load(source, flat((size, columns), inner), REAL)
            code.store(w.pointers[node], flat(node.shape, (*at, *inner)), value)

        w.nest((size, columns), put)

    w.nest(batch, each)


# ---- private ------------------------------------------------------------------------------------


def _copied(w: Writer, operand: Expression, at: Place, to: str) -> None:
    """One matrix of an operand, which may have fewer axes than the batch."""
    core = operand.shape[-2:]
    own = at[len(at) - len(operand.shape) + 2 :]

    def copy(inner: Place) -> None:
        value = w.element(operand, (*own, *inner)).to(REAL)
        w.code.store(to, flat(core, inner), value)

    w.nest(core, copy)


def _identity(w: Writer, size: int, to: str) -> None:
    zero, one = w.code.number(0.0), w.code.number(1.0)
    w.nest((size * size,), lambda at: w.code.store(to, at[0], zero))
    w.nest((size,), lambda at: w.code.store(to, at[0] * (size + 1) if size > 1 else 0, one))


def _called(code: Code, name: str, *arguments: str | int) -> Number:
    """A call of one of the functions below: addresses, then sizes."""
    if not code.module.is_defined(f"bayesmc_{name}"):
        code.module.define(f"bayesmc_{name}", _FUNCTIONS[name](code.module))
    given = ", ".join(f"i64 {a}" if isinstance(a, int) else f"ptr {a}" for a in arguments)
    return code.op(REAL, f"call double @bayesmc_{name}({given}) noinline")


def _defined(c: Code, name: str, pointers: str, sizes: str, result: Number) -> str:
    c.do(f"ret double {result.text}")
    given = [f"ptr noalias %{p}" for p in pointers.split()] + [f"i64 %{s}" for s in sizes.split()]
    return f"define internal double @bayesmc_{name}({', '.join(given)}) {{\n{c}\n}}"


class _Matrix:
    """Elements of a matrix in C order."""

    def __init__(self, code: Code, pointer: str, columns: Number) -> None:
        self.code, self.pointer, self.columns = code, pointer, columns

    def __getitem__(self, at: tuple[Number, Number]) -> Number:
        return self.code.load(self.pointer, at[0] * self.columns + at[1], REAL)

    def __setitem__(self, at: tuple[Number, Number], value: Number) -> None:
        self.code.store(self.pointer, at[0] * self.columns + at[1], value)

    def nan_unless(self, good: str, rows: Number) -> None:
        """Nothing but NaN, unless a variable says that all went well."""
        c, nan = self.code, self.code.number(math.nan)

        def spoil() -> None:
            every = rows * self.columns
            c.span(c.number(0, WHOLE), every, lambda i: c.store(self.pointer, i, nan))

        c.when(~c.get(good, TRUTH), spoil)


def _whole(c: Code, name: str) -> Number:
    return Number(c, f"%{name}", WHOLE)


def _cholesky(module: Module) -> str:
    """The lower factor in the place of a matrix, of which the lower triangle is read."""
    c = Code(module)
    n, zero = _whole(c, "n"), c.number(0, WHOLE)
    a, good = _Matrix(c, "%a", n), c.variable(c.number(True, TRUTH))

    def column(j: Number) -> None:
        rest = a[j, j] - c.total(zero, j, lambda k: a[j, k] * a[j, k])
        c.set(good, c.get(good, TRUTH) & (rest > 0.0))
        root = c.call("llvm.sqrt.f64", rest)
        a[j, j] = root

        def below(i: Number) -> None:
            a[i, j] = (a[i, j] - c.total(zero, j, lambda k: a[i, k] * a[j, k])) / root
            a[j, i] = c.number(0.0)

        c.span(j + 1, n, below)

    c.span(zero, n, column)
    a.nan_unless(good, n)
    return _defined(c, "cholesky", "a", "n", c.number(0.0))


def _forward(module: Module) -> str:
    """The solution in the place of the right sides, of a lower triangle."""
    c = Code(module)
    n, m, zero = _whole(c, "n"), _whole(c, "m"), c.number(0, WHOLE)
    a, x, good = _Matrix(c, "%a", n), _Matrix(c, "%x", m), c.variable(c.number(True, TRUTH))

    def row(i: Number) -> None:
        pivot = a[i, i]
        c.set(good, c.get(good, TRUTH) & pivot.ne(0.0))

        def solve(j: Number) -> None:
            x[i, j] = (x[i, j] - c.total(zero, i, lambda k: a[i, k] * x[k, j])) / pivot

        c.span(zero, m, solve)

    c.span(zero, n, row)
    x.nan_unless(good, n)
    return _defined(c, "forward", "a x", "n m", c.number(0.0))


def _eliminated(module: Module) -> str:
    """The solution in the place of the right sides; the determinant is the result."""
    c = Code(module)
    n, m, zero = _whole(c, "n"), _whole(c, "m"), c.number(0, WHOLE)
    a, x = _Matrix(c, "%a", n), _Matrix(c, "%x", m)
    good, det = c.variable(c.number(True, TRUTH)), c.variable(c.number(1.0))
    size = c.variable(c.number(0.0))  # its logarithm: products of pivots overflow on the way

    def column(k: Number) -> None:
        _pivot_up(c, a, x, k, det)
        pivot = a[k, k]
        c.set(det, c.get(det, REAL) * c.where(pivot < 0.0, c.number(-1.0), 1.0))
        log = elementary(c, "log", c.call("llvm.fabs.f64", pivot))
        c.set(size, c.get(size, REAL) + log)
        c.set(good, c.get(good, TRUTH) & pivot.ne(0.0))

        def below(i: Number) -> None:
            factor = a[i, k] / pivot
            c.span(k + 1, n, lambda j: a.__setitem__((i, j), a[i, j] - factor * a[k, j]))
            c.span(zero, m, lambda j: x.__setitem__((i, j), x[i, j] - factor * x[k, j]))

        c.span(k + 1, n, below)

    def back(step: Number) -> None:
        i = n - 1 - step
        pivot = a[i, i]

        def solve(j: Number) -> None:
            x[i, j] = (x[i, j] - c.total(i + 1, n, lambda k: a[i, k] * x[k, j])) / pivot

        c.span(zero, m, solve)

    c.span(zero, n, column)
    c.span(zero, n, back)
    x.nan_unless(good, n)
    found = c.get(det, REAL) * elementary(c, "exp", c.get(size, REAL))
    found = c.where(c.get(good, TRUTH), found, 0.0)
    return _defined(c, "eliminated", "a x", "n m", found)


def _pivot_up(c: Code, a: _Matrix, x: _Matrix, k: Number, det: str) -> None:
    """The row with the largest entry of a column changes places with that of the diagonal."""
    most = c.variable(c.call("llvm.fabs.f64", a[k, k]))
    best = c.variable(k)

    def look(i: Number) -> None:
        size = c.call("llvm.fabs.f64", a[i, k])
        is_larger = size > c.get(most, REAL)
        c.set(most, c.where(is_larger, size, c.get(most, REAL)))
        c.set(best, c.where(is_larger, i, c.get(best, WHOLE)))

    c.span(k + 1, a.columns, look)
    other = c.get(best, WHOLE)

    def swap(matrix: _Matrix) -> None:
        def each(j: Number) -> None:
            first, second = matrix[k, j], matrix[other, j]
            matrix[k, j], matrix[other, j] = second, first

        c.span(c.number(0, WHOLE), matrix.columns, each)

    def swap_both() -> None:
        swap(a)
        swap(x)
        c.set(det, -c.get(det, REAL))

    c.when(other.ne(k), swap_both)


_FUNCTIONS = {"cholesky": _cholesky, "forward": _forward, "eliminated": _eliminated}
