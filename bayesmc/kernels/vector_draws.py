"""Draws of vectors and covariances from natural parameters, few of them on Python's floats."""

from __future__ import annotations

from functools import cache

import numpy as np

from bayesmc.distributions.wishart import bartlett, gram
from bayesmc.expression import call, constant, elementwise, leaf, pick
from bayesmc.expression.products import product
from bayesmc.expression.scalars import SmallProgram, upper_inverse
from bayesmc.passes.arithmetic import add, divide, multiply
from bayesmc.passes.sufficient import transposed
from bayesmc.shapes import Shape

#: squared sine of an angle between rows, below which a product may be singular to rounding
_CLOSE = 1e-6


def normal_draw(
    rng: np.random.Generator, precision: np.ndarray, linear: np.ndarray, shape: Shape
) -> np.ndarray:
    """Draws from ``exp(linear'x - x' precision x / 2)``.

    Parameters
    ----------
    precision : ndarray, shape (*batch, d, d)
    linear : ndarray, shape (*batch, d)
    shape : tuple of int
        What the batches broadcast to.

    Returns
    -------
    ndarray, shape (*shape, d)

    Raises
    ------
    LinAlgError
        A precision is not positive definite to rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.vector_draws import normal_draw
    >>> rng = np.random.default_rng(0)
    >>> draws = normal_draw(rng, np.diag([4.0, 1.0]), np.array([4.0, 0.0]), (10_000,))
    >>> draws.mean(axis=0).round(1).tolist(), draws.std(axis=0).round(1).tolist()
    ([1.0, 0.0], [0.5, 1.0])
    """
    d = linear.shape[-1]
    noise = rng.standard_normal((*shape, d))
    values = {"precision": precision, "linear": linear, "noise": noise}
    if precision.shape[:-2] != shape:
        values["precision"] = np.broadcast_to(precision, (*shape, d, d))
    if linear.shape[:-1] != shape:
        values["linear"] = np.broadcast_to(linear, (*shape, d))
    (draw,) = _normal(d)(values)
    return draw


def inverse_wishart_draw(
    rng: np.random.Generator, df: np.ndarray, scale: np.ndarray, shape: Shape
) -> np.ndarray:
    """Draws from the inverse Wishart distribution, positive definite after rounding, too.

    If the scale is ``R R'`` and B is Bartlett's triangle, the draw is ``M M'`` with ``M = R B^-1'``.

    Parameters
    ----------
    df : ndarray, shape (*batch)
    scale : ndarray, shape (*batch, d, d)
    shape : tuple of int
        What the batches broadcast to.

    Returns
    -------
    ndarray, shape (*shape, d, d)

    Raises
    ------
    LinAlgError
        A scale is not positive definite to rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.vector_draws import inverse_wishart_draw
    >>> rng = np.random.default_rng(0)
    >>> draws = inverse_wishart_draw(rng, np.array(12.0), 9.0 * np.eye(2), (10_000,))
    >>> draws.mean(axis=0).round(1).tolist()  # the scale over df - d - 1
    [[1.0, 0.0], [0.0, 1.0]]
    """
    d = scale.shape[-1]
    noise = bartlett(rng, df[..., None] - np.arange(d - 1, -1, -1.0), shape)
    if scale.shape[:-2] != shape:
        scale = np.broadcast_to(scale, (*shape, d, d))
    draw, factor, angles = _inverse_wishart(d)({"scale": scale, "noise": noise})
    return draw if angles.min(initial=1.0) >= _CLOSE else gram(factor)[0]


# ---- private ------------------------------------------------------------------------------------


@cache
def _normal(d: int) -> SmallProgram:
    precision, linear, noise = leaf("precision", (d, d)), leaf("linear", (d,)), leaf("noise", (d,))
    root = call(upper_inverse, [transposed(call(np.linalg.cholesky, [precision]))])
    white = add(product(np.vecmat, linear, root), noise)
    return SmallProgram([product(np.matvec, root, white)])


@cache
def _inverse_wishart(d: int) -> SmallProgram:
    scale, noise = leaf("scale", (d, d)), leaf("noise", (d, d))
    over = transposed(call(upper_inverse, [transposed(noise)]))
    lower = constant(np.tril(np.ones((d, d))))
    factor = product(np.matmul, multiply(call(np.linalg.cholesky, [scale]), lower), over)
    draw = product(np.matmul, factor, transposed(factor))
    diagonal = np.arange(d) * (d + 1)
    pivots = elementwise(np.square, pick([factor], diagonal))
    return SmallProgram([draw, factor, divide(pivots, pick([draw], diagonal))])
