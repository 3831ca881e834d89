"""Draws of normals, covariances and shares whose natural parameters are expressions of a state.

Parameters and draw are one program, of few numbers on Python's floats.

References
----------
Rue and Held (2005), Gaussian Markov Random Fields, algorithm 2.5; Smith and Hocking (1972), Wishart
variate generator, Applied Statistics 21.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from bayesmc.distributions.wishart import gram
from bayesmc.expression import (
    Expression,
    broadcast,
    call,
    constant,
    elementwise,
    leaf,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.functions import product
from bayesmc.expression.scalars import SmallProgram, upper_inverse
from bayesmc.passes.arithmetic import add, divide, multiply, subtract
from bayesmc.passes.sufficient import transposed
from bayesmc.shapes import Shape
from bayesmc.structure.target import Values

#: what is drawn, beside the nodes of a model: no node has such a name
_NOISE, _GAMMA, _NORMAL = "\0noise", "\0gamma", "\0normal"
#: squared sine of an angle between rows, below which a product may be singular to rounding
_CLOSE = 1e-6
#: numbers that are drawn one by one
_FEW = 24
#: chi-square variates of few degrees of freedom underflow; squares must not
_LEAST = 1e-280


class NormalDraw:
    """Draws from ``exp(linear'x - x' precision x / 2)`` of all elements of a node.

    Parameters
    ----------
    precision, linear : Expression, shapes (*plates, d, d) and (*plates, d), or both (*plates)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import as_expression
    >>> from bayesmc.kernels.vector_draws import NormalDraw
    >>> draw = NormalDraw(as_expression(np.diag([4.0, 1.0])), as_expression(np.array([4.0, 0.0])))
    >>> draws = draw({}, np.random.default_rng(0), 10_000)
    >>> draws.mean(axis=0).round(1).tolist(), draws.std(axis=0).round(1).tolist()
    ([1.0, 0.0], [0.5, 1.0])
    """

    def __init__(self, precision: Expression, linear: Expression) -> None:
        self.shape = linear.shape
        noise = leaf(_NOISE, self.shape)
        if precision.shape == self.shape:
            spread = elementwise(np.sqrt, precision)
            draw = add(divide(linear, precision), divide(noise, spread))
        else:
            draw = _normal_of(precision, linear, noise)
        self._program = SmallProgram([draw])

    def __call__(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray:
        noise = rng.standard_normal((chains, *self.shape))
        return self._program({**values, _NOISE: noise})[0]


class InverseWishartDraw:
    """Draws from the inverse Wishart distribution, positive definite after rounding, too.

    If the scale is ``R R'`` and B is Bartlett's triangle, the draw is ``M M'`` with ``M = R B^-1'``.

    Parameters
    ----------
    df, scale : Expression, shapes (*plates) and (*plates, d, d)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import as_expression
    >>> from bayesmc.kernels.vector_draws import InverseWishartDraw
    >>> draw = InverseWishartDraw(as_expression(12.0), as_expression(9.0 * np.eye(2)))
    >>> draws = draw({}, np.random.default_rng(0), 10_000)
    >>> bool(np.abs(draws.mean(axis=0) - np.eye(2)).max() < 0.05)  # the scale over df - d - 1
    True
    """

    def __init__(self, df: Expression, scale: Expression) -> None:
        d = scale.shape[-1]
        self.shape = scale.shape[:-1]
        half = subtract(multiply(0.5, reshape(df, (*df.shape, 1))), _halves(d))
        self._half = SmallProgram([broadcast(half, self.shape)])
        self._normals = (*scale.shape[:-2], d * (d - 1) // 2)
        gamma, normal = leaf(_GAMMA, self.shape), leaf(_NORMAL, self._normals)
        draw, angle, factor = self._of(scale, _triangle(gamma, normal))
        self._program, self._factor = SmallProgram([draw, angle]), SmallProgram([factor])

    def __call__(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray:
        (half,) = self._half(values)
        normal = rng.standard_normal((chains, *self._normals))
        gamma = gammas(rng, half, (chains, *self.shape))
        values = {**values, _GAMMA: gamma, _NORMAL: normal}
        draw, angle = self._program(values)
        return draw if _least_of(angle) >= _CLOSE else self._gram(self._factor(values)[0])

    # ---- private -------------------------------------------------------------------------------

    @staticmethod
    def _of(scale: Expression, triangle: Expression) -> tuple[Expression, Expression, Expression]:
        lower = constant(np.tril(np.ones(scale.shape[-2:])))
        root = multiply(call(np.linalg.cholesky, [scale]), lower)
        return _squared(call(np.matmul, [root, transposed(call(upper_inverse, [triangle]))]))

    @staticmethod
    def _gram(factor: np.ndarray) -> np.ndarray:
        return gram(factor)[0]


class WishartDraw(InverseWishartDraw):
    """Draws from the Wishart distribution ``|x|^((df - d - 1)/2) exp(-tr(S x) / 2)``, given S.

    If S is ``R R'`` and B is Bartlett's triangle, an upper one, the draw is ``M M'`` with ``M = R'^-1 B``:
    the inverse of what an inverse Wishart draw of scale S is.

    Parameters
    ----------
    df, scale : Expression, shapes (*plates) and (*plates, d, d)
        The scale is S, the inverse of the one that ``Wishart`` has.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import as_expression
    >>> from bayesmc.kernels.vector_draws import WishartDraw
    >>> draw = WishartDraw(as_expression(12.0), as_expression(12.0 * np.eye(2)))
    >>> draws = draw({}, np.random.default_rng(0), 10_000)
    >>> bool(np.abs(draws.mean(axis=0) - np.eye(2)).max() < 0.05)  # df times the inverse of S
    True
    """

    @staticmethod
    def _of(scale: Expression, triangle: Expression) -> tuple[Expression, Expression, Expression]:
        root = transposed(call(np.linalg.cholesky, [scale]))
        return _squared(call(np.matmul, [call(upper_inverse, [root]), triangle]))

    @staticmethod
    def _gram(factor: np.ndarray) -> np.ndarray:
        return gram(factor[..., ::-1, ::-1])[0][..., ::-1, ::-1]  # a lower triangle, reversed


class DirichletDraw:
    """The same for shares; nothing where a concentration below 1 may underflow.

    Parameters
    ----------
    powers : Expression, shape (*plates, k)
        Of the shares in the density.
    """

    def __init__(self, powers: Expression) -> None:
        self.shape = powers.shape
        self._program = SmallProgram([add(powers, 1.0)])

    def __call__(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray | None:
        (concentration,) = self._program(values)
        shape = (chains, *self.shape)
        if concentration.shape == shape and concentration.size <= _FEW:
            flat = concentration.ravel().tolist()
            if not all(a >= 1.0 for a in flat):  # nor where one is no number
                return None
            drawn = [rng.standard_gamma(a) for a in flat]
            if len(drawn) == shape[-1]:
                total = sum(drawn)
                return np.array([x / total for x in drawn]).reshape(shape)
            found = np.array(drawn).reshape(shape)
        else:
            if not concentration.min(initial=1.0) >= 1.0:
                return None
            found = rng.standard_gamma(concentration, shape)
        return found / np.add.reduce(found, -1, keepdims=True)


def gammas(rng: np.random.Generator, concentration: np.ndarray, shape: Shape) -> np.ndarray:
    """Standard gamma numbers as ``rng.standard_gamma`` draws them, which checks few slowly.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.vector_draws import gammas
    >>> gammas(np.random.default_rng(0), np.array([2.0, 3.0]), (2,))
    array([1.83431007, 3.85514353])
    >>> np.random.default_rng(0).standard_gamma([2.0, 3.0])
    array([1.83431007, 3.85514353])
    """
    if concentration.size > _FEW or concentration.shape != shape:
        return rng.standard_gamma(concentration, shape)
    draw = rng.standard_gamma
    return np.array([draw(a) for a in concentration.ravel().tolist()]).reshape(shape)


# ---- private ------------------------------------------------------------------------------------


def _least_of(array: np.ndarray) -> float:
    if array.size == 1:
        return array.item()
    return np.minimum.reduce(array, axis=None, initial=1.0)


@cache
def _halves(d: int) -> np.ndarray:
    """Half of ``d - 1, ..., 0``."""
    return 0.5 * np.arange(d - 1, -1, -1.0)


def _normal_of(precision: Expression, linear: Expression, noise: Expression) -> Expression:
    root = call(upper_inverse, [transposed(call(np.linalg.cholesky, [precision]))])
    white = add(call(np.vecmat, [linear, root]), noise)
    return call(np.matvec, [root, white])


def _triangle(gamma: Expression, normal: Expression) -> Expression:
    """Bartlett's triangle, an upper one: from its diagonal, what is beside it, and zero."""
    *batch, d = gamma.shape
    least = elementwise(np.maximum, multiply(2.0, gamma), _LEAST)
    parts = [elementwise(np.sqrt, least), normal, broadcast(constant(0.0), (*batch, 1))]
    at, start = np.empty((*batch, d, d), dtype=np.intp), 0
    row, column = np.tril_indices(d, -1)
    places = [(np.arange(d), np.arange(d)), (column, row), (row, column)]
    for part, (i, j) in zip(parts, places, strict=True):
        own = start + np.arange(part.size).reshape(part.shape)
        at[..., i, j] = own
        start += part.size
    return pick(parts, at)


def _squared(factor: Expression) -> tuple[Expression, Expression, Expression]:
    """A draw, the least square of the sine of an angle between its factor's rows, and the factor."""
    draw = product(np.matmul, factor, transposed(factor))  # symmetric to the last bit
    sines = divide(elementwise(np.square, _diagonal(factor)), _diagonal(draw))
    least = reduction(np.minimum, sines, range(len(sines.shape)))
    return draw, least, factor


def _diagonal(matrix: Expression) -> Expression:
    at = np.arange(matrix.size).reshape(matrix.shape)
    return pick([matrix], at.diagonal(axis1=-2, axis2=-1))
