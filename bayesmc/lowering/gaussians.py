"""Loops over many small Gaussians by their roots: conditioned on a row each, and merged group by group.

Orthogonal reflections make rows lower triangular, as ``linalg.square_root`` does. Where a pivot is next to
nothing, which takes care that is written there, the loops say so and nothing else.

References
----------
Golub and Van Loan, Matrix Computations, 4th ed., sec. 5.1 and 5.2 (Householder reflections).
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from bayesmc.lowering.code import REAL, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary
from bayesmc.lowering.machine import Loaded, loaded

#: pivots so small beside the largest entry are worth a look
_SUSPECT = 1e-11
_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


class GaussianLoops:
    """The loops, compiled once. All arrays are in C order."""

    def __init__(self) -> None:
        whole, pointer = ctypes.c_int64, ctypes.c_void_p
        self._code = code = _loaded()  # the functions live as long as this
        self._conditioned = code.function("conditioned", whole, *[whole] * 7, *[pointer] * 11)
        self._merged = code.function("merged", whole, *[whole] * 4, *[pointer] * 7)

    def conditioned(
        self, given: Coefficients, mean: np.ndarray, factor: np.ndarray, row: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Numbers ``offset + moves @ before + noise @ (independent normals)``, the first of which are a row.

        Parameters
        ----------
        given : Coefficients
        mean : ndarray, shape (size, m)
            Of the numbers before, which are the first ``c`` of ``m``.
        factor : ndarray, shape (size, m, m)
            Roots of their covariances, the first ``c`` rows and columns by themselves.
        row : ndarray, shape (p,)

        Returns
        -------
        tuple or None
            Means, shape (size, r - p), and roots, shape (size, r - p, r - p), of the others given the row,
            and log densities of the row. None where a pivot is next to nothing.
        """
        size, r, c, q = given.sizes
        m, p = mean.shape[1], len(row)
        n, width = r - p, c + q
        a, b, d, e = size * n, size * n * (n + 1), size * (n * (n + 1) + 1), r * width
        room = np.empty(d + e + r + p)  # what comes out, and room to work in
        to = room.ctypes.data
        status = self._conditioned(
            size, r, c, q, m, p, n, *given.places, mean.ctypes.data, factor.ctypes.data, row.ctypes.data,
            to, to + 8 * a, to + 8 * b, to + 8 * d, to + 8 * (d + e),
        )  # fmt: skip
        if status:
            return None
        return room[:a].reshape(size, n), room[a:b].reshape(size, n, n), room[b:d]

    def merged(
        self, log: np.ndarray, mean: np.ndarray, factor: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """One Gaussian for every group, of the same weight, mean and covariance.

        Parameters
        ----------
        log : ndarray, shape (groups, members)
            Logs of weights.
        mean : ndarray, shape (groups, members, n)
        factor : ndarray, shape (groups, members, n, k)

        Returns
        -------
        tuple or None
            Logs of the sums of weights, means, and roots, shape (groups, n, n). None where a pivot is next to
            nothing, or a group weighs nothing.
        """
        groups, members, n = mean.shape
        k = factor.shape[3]
        a, b, d = groups, groups * (1 + n), groups * (1 + n * (n + 1))
        room = np.empty(d + n * members * (k + 1))
        to = room.ctypes.data
        status = self._merged(
            groups, members, n, k, log.ctypes.data, mean.ctypes.data, factor.ctypes.data,
            to, to + 8 * a, to + 8 * b, to + 8 * d,
        )  # fmt: skip
        if status:
            return None
        return room[:a], room[a:b].reshape(groups, n), room[b:d].reshape(groups, n, n)


class Coefficients:
    """Of many Gaussians, as the loops read them.

    Parameters
    ----------
    moves : ndarray, shape (size, r, c)
    noise : ndarray, shape (size, r, q)
    offset : ndarray, shape (size, r)

    Attributes
    ----------
    is_wide : bool
        Whether there may be as many independent normals as numbers, which the loops take for granted.
    """

    def __init__(self, moves: np.ndarray, noise: np.ndarray, offset: np.ndarray) -> None:
        self._held = tuple(np.ascontiguousarray(a, dtype=float) for a in (moves, noise, offset))
        self.sizes = (*moves.shape, noise.shape[2])
        self.places = tuple(a.ctypes.data for a in self._held)
        self.is_wide = moves.shape[2] + noise.shape[2] >= moves.shape[1]


@lru_cache(maxsize=1)
def gaussian_loops() -> GaussianLoops:
    """The loops, where there is a compiler."""
    return GaussianLoops()


# ---- private ------------------------------------------------------------------------------------


def _loaded() -> Loaded:
    module = Module()
    texts = [_conditioned(module), _merged(module)]
    return loaded("\n".join([str(module), *texts]), module.foreign)


def _abs(c: Code, x: Number) -> Number:
    return c.call("llvm.fabs.f64", x)


def _triangular(c: Code, r: Number, k: Number, suspect: str) -> None:
    """Rows ``%work``, r by k, as a lower triangle with a positive diagonal; notes pivots next to nothing."""
    zero = c.number(0, WHOLE)
    largest = c.variable(c.number(0.0))
    least = c.variable(c.number(math.inf))

    def reflect(a: Number) -> None:
        own = a * k
        norm = c.call("llvm.sqrt.f64", c.total(a, k, lambda j: _square(c, own + j)))
        first = c.load("%work", own + a, REAL)
        sign = c.where(first < 0.0, c.number(1.0), c.number(-1.0))
        pivot = sign * norm  # of the sign that first has not
        half = norm * (norm + _abs(c, first))
        c.store("%work", own + a, first - pivot)

        def others(b: Number) -> None:
            at = b * k
            share = (
                c.total(
                    a,
                    k,
                    lambda j: c.load("%work", at + j, REAL) * c.load("%work", own + j, REAL),
                )
                / half
            )

            def move(j: Number) -> None:
                found = c.load("%work", at + j, REAL) - share * c.load("%work", own + j, REAL)
                c.store("%work", at + j, found)

            c.span(a, k, move)
            entry = c.load("%work", at + a, REAL) * sign
            c.store("%work", at + a, entry)
            c.set(largest, c.call("llvm.maximum.f64", c.get(largest, REAL), _abs(c, entry)))

        c.span(a + 1, r, others)
        c.store("%work", own + a, norm)
        c.set(largest, c.call("llvm.maximum.f64", c.get(largest, REAL), norm))
        c.set(least, c.call("llvm.minimum.f64", c.get(least, REAL), norm))

    c.span(zero, r, reflect)
    fine = c.get(least, REAL) > _SUSPECT * c.get(largest, REAL)
    bad = c.where(fine, c.number(0, WHOLE), c.number(1, WHOLE))
    c.set(suspect, c.get(suspect, WHOLE) | bad)


def _square(c: Code, at: Number) -> Number:
    x = c.load("%work", at, REAL)
    return x * x


def _expect(c: Code, i: Number, r: Number, m: Number, before: Number, fresh: Number) -> None:
    """Means of the numbers of Gaussian ``i``, and their coefficients of old and new noise."""
    zero, k = c.number(0, WHOLE), before + fresh
    start, root = i * m, i * (m * m)

    def expect(a: Number) -> None:
        line = i * r + a
        moves, noise, at = line * before, line * fresh, a * k

        def of_mean(j: Number) -> Number:
            return c.load("%moves", moves + j, REAL) * c.load("%mean", start + j, REAL)

        def of_factor(j: Number, x: Number) -> Number:
            return c.load("%moves", moves + x, REAL) * c.load("%factor", root + (x * m + j), REAL)

        def move(j: Number) -> None:
            c.store("%work", at + j, c.total(zero, before, lambda x: of_factor(j, x)))

        def add(j: Number) -> None:
            c.store("%work", at + (before + j), c.load("%noise", noise + j, REAL))

        c.store("%expected", a, c.total(zero, before, of_mean) + c.load("%offset", line, REAL))
        c.span(zero, before, move)
        c.span(zero, fresh, add)

    c.span(zero, r, expect)


def _conditioned(module: Module) -> str:
    c = Code(module)
    size, r, m, p, n = (Number(c, f"%{name}", WHOLE) for name in ("size", "r", "m", "p", "n"))
    before, fresh = Number(c, "%c", WHOLE), Number(c, "%q", WHOLE)
    zero, k = c.number(0, WHOLE), before + fresh
    suspect = c.variable(c.number(0, WHOLE), once=True)

    def of_eta(line: Number, b: Number) -> Number:
        return c.load("%work", line + b, REAL) * c.load("%expected", r + b, REAL)

    def one(i: Number) -> None:
        _expect(c, i, r, m, before, fresh)
        _triangular(c, r, k, suspect)
        total = c.variable(c.number(0.0))

        def solve(a: Number) -> None:
            """Standardised innovations, which stand behind what was expected."""
            known = c.total(zero, a, lambda b: of_eta(a * k, b))
            pivot = c.load("%work", a * k + a, REAL)
            eta = (c.load("%row", a, REAL) - c.load("%expected", a, REAL) - known) / pivot
            c.store("%expected", r + a, eta)
            found = c.get(total, REAL) - 0.5 * (eta * eta) - elementary(c, "log", pivot)
            c.set(total, found - _HALF_LOG_2PI)

        def rest(a: Number) -> None:
            line = (p + a) * k
            gained = c.total(zero, p, lambda b: of_eta(line, b))
            c.store("%after", i * n + a, c.load("%expected", p + a, REAL) + gained)
            _lower(c, a, n, i * (n * n), lambda b: c.load("%work", line + (p + b), REAL))

        c.span(zero, p, solve)
        c.store("%log", i, c.get(total, REAL))
        c.span(zero, n, rest)

    c.loop(size, one)
    c.do(f"ret i64 {c.get(suspect, WHOLE).text}")
    pointers = "moves noise offset mean factor row after root log work expected"
    return _function("conditioned", "size r c q m p n", pointers, c)


def _function(name: str, whole: str, pointers: str, body: Code) -> str:
    arguments = [f"i64 %{n}" for n in whole.split()]
    arguments += [f"ptr noalias %{n}" for n in pointers.split()]
    return f"define i64 @{name}({', '.join(arguments)}) {{\n{body}\n}}"


def _lower(c: Code, a: Number, n: Number, start: Number, entry: Callable[[Number], Number]) -> None:
    """Row ``a`` of a lower triangle."""

    def put(b: Number) -> None:
        c.store("%root", start + (a * n + b), c.number(0.0))
        c.when(b <= a, lambda: c.store("%root", start + (a * n + b), entry(b)))

    c.span(c.number(0, WHOLE), n, put)


def _merged(module: Module) -> str:
    c = Code(module)
    groups, size, n, width = (Number(c, f"%{name}", WHOLE) for name in ("groups", "size", "n", "k"))
    zero, k = c.number(0, WHOLE), size * (width + 1)
    suspect = c.variable(c.number(0, WHOLE), once=True)

    def one(i: Number) -> None:
        first = i * size
        top = c.variable(c.number(-math.inf))
        c.span(zero, size, lambda g: c.set(
            top, c.call("llvm.maximum.f64", c.get(top, REAL), c.load("%log", first + g, REAL))
        ))  # fmt: skip
        level = c.get(top, REAL)
        weight = c.total(
            zero, size, lambda g: elementary(c, "exp", c.load("%log", first + g, REAL) - level)
        )
        c.store("%total", i, elementary(c, "log", weight) + level)
        c.span(zero, n, lambda a: c.store("%centre", i * n + a, c.number(0.0)))

        def share(g: Number) -> Number:
            return elementary(c, "exp", c.load("%log", first + g, REAL) - level) / weight

        def gather(g: Number) -> None:
            part = share(g)
            c.span(zero, n, lambda a: c.store(
                "%centre", i * n + a,
                c.load("%centre", i * n + a, REAL) + part * c.load("%mean", (first + g) * n + a, REAL),
            ))  # fmt: skip

        c.span(zero, size, gather)

        def beside(g: Number) -> None:
            scale, at = c.call("llvm.sqrt.f64", share(g)), g * (width + 1)
            member = first + g

            def line(a: Number) -> None:
                own, place = (member * n + a) * width, a * k + at
                c.span(zero, width, lambda j: c.store(
                    "%work", place + j, scale * c.load("%factor", own + j, REAL)
                ))  # fmt: skip
                off = c.load("%mean", member * n + a, REAL) - c.load("%centre", i * n + a, REAL)
                c.store("%work", place + width, scale * off)

            c.span(zero, n, line)

        c.span(zero, size, beside)
        _triangular(c, n, k, suspect)
        c.span(zero, n, lambda a: _lower(
            c, a, n, i * (n * n), lambda b: c.load("%work", a * k + b, REAL)
        ))  # fmt: skip

    c.loop(groups, one)
    c.do(f"ret i64 {c.get(suspect, WHOLE).text}")
    return _function("merged", "groups size n k", "log mean factor total centre root work", c)
