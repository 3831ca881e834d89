"""Gaussian factors that discrete variables switch, in square-root information form.

A factor is ``exp(log_scale - |A x - z|^2 / 2)`` for every configuration of its discrete scope, kept as the
rows ``[A | z]``. Products stack rows, and a block of x is integrated out by one QR decomposition: sums of
squares are never formed, so that the condition number is never squared. Blocks and discrete variables are
hashables; nets belong to the layers above.

References
----------
Lauritzen (1992), Propagation of probabilities, means and variances in mixed graphical association models;
square-root information: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, ch. V.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

#: ratio of rows above which their order matters
_STIFF = 100.0
_LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True, eq=False)
class GaussianFactor:
    """A function of some continuous blocks, one for every configuration of its discrete scope.

    Attributes
    ----------
    scope : tuple of hashable
        Discrete variables, one leading axis each.
    blocks : tuple of hashable
        Continuous blocks, in the order of the columns.
    rows : ndarray, shape (*cards, m, n + 1)
        ``[A | z]``, where n counts the blocks' components.
    log_scale : ndarray, shape (*cards,)
    """

    scope: tuple[Any, ...]
    blocks: tuple[Any, ...]
    rows: np.ndarray
    log_scale: np.ndarray


@dataclass(frozen=True, eq=False)
class Conditional:
    """A block given other blocks: ``x = offset + gain @ parents + root @ noise``, noise standard normal.

    Attributes
    ----------
    block : hashable
    scope : tuple of hashable
        Discrete variables, one leading axis each.
    parents : tuple of hashable
        Continuous blocks, in the order of ``gain``'s columns.
    offset : ndarray, shape (*cards, d)
    gain : ndarray, shape (*cards, d, n)
    root : ndarray, shape (*cards, d, d)
        A square root of the conditional covariance (``root @ root'``).
    """

    block: Any
    scope: tuple[Any, ...]
    parents: tuple[Any, ...]
    offset: np.ndarray
    gain: np.ndarray
    root: np.ndarray


def likelihood_rows(
    matrix: np.ndarray, residual: np.ndarray, tril: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and log scale of the normal density of ``residual - matrix @ x`` with mean zero.

    Parameters
    ----------
    matrix : ndarray, shape (..., d, n)
    residual : ndarray, shape (..., d)
    tril : ndarray, shape (..., d, d)
        Lower Cholesky factor of the covariance.

    Returns
    -------
    rows : ndarray, shape (..., d, n + 1)
    log_scale : ndarray, shape (...)

    Examples
    --------
    >>> import numpy as np
    >>> rows, log_scale = likelihood_rows(np.array([[2.0]]), np.array([6.0]), np.array([[2.0]]))
    >>> rows.tolist(), float(log_scale.round(4))
    ([[1.0, 3.0]], -1.6121)
    """
    d = tril.shape[-1]
    lead = np.broadcast_shapes(matrix.shape[:-2], residual.shape[:-1], tril.shape[:-2])
    rows = np.empty((*lead, d, matrix.shape[-1] + 1))
    rows[..., :-1] = matrix
    rows[..., -1] = residual
    diagonal = np.linalg.diagonal(tril)
    if d == 1:
        rows /= tril
    else:
        rows = np.linalg.solve(np.broadcast_to(tril, (*lead, d, d)), rows)
    log_scale = -0.5 * d * _LOG_2PI - np.log(diagonal).sum(axis=-1)
    return rows, np.broadcast_to(log_scale, lead)


def compressed(rows: np.ndarray, log_scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same factor in at most n rows; what does not depend on x moves to the log scale."""
    columns = rows.shape[-1]
    if rows.shape[-2] >= columns:
        rows = _triangle(rows)
    if rows.shape[-2] == columns:
        log_scale = log_scale - 0.5 * rows[..., -1, -1] ** 2
        rows = rows[..., :-1, :]
    return rows, log_scale


def eliminate(
    factors: Sequence[GaussianFactor],
    block: Any,
    dims: Mapping[Any, int],
    cards: Mapping[Any, int],
) -> tuple[Conditional, GaussianFactor]:
    """Integrate ``block`` out of a product of factors that all hold it.

    Parameters
    ----------
    factors : sequence of GaussianFactor
        Together they must determine the block, as they do where its own conditional is among them.
    block : hashable
    dims, cards : mapping
        Components of every block, states of every discrete variable.

    Returns
    -------
    Conditional
        The block given the other blocks of the product.
    GaussianFactor
        The integral, on these other blocks.
    """
    scope, blocks = union_of(factors, block)
    rows, log_scale = _product(factors, scope, blocks, dims, cards)
    d = dims[block]
    upper = _triangle(rows)
    own = upper[..., :d, :d]
    pivots = np.linalg.diagonal(own)
    log_scale = log_scale + 0.5 * d * _LOG_2PI - np.log(np.abs(pivots)).sum(axis=-1)
    rest = upper[..., :d, d:]
    identity = np.broadcast_to(np.eye(d), (*own.shape[:-2], d, d))
    if d == 1:
        solved = np.concatenate([rest, identity], axis=-1) / own
    else:
        solved = np.linalg.solve(own, np.concatenate([rest, identity], axis=-1))
    n = rest.shape[-1] - 1
    conditional = Conditional(
        block, scope, blocks[1:], solved[..., n], -solved[..., :n], solved[..., n + 1 :]
    )
    left, log_scale = compressed(upper[..., d:, d:], log_scale)
    return conditional, GaussianFactor(scope, blocks[1:], left, log_scale)


def union_of(
    factors: Sequence[GaussianFactor], block: Any
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Discrete scope and blocks of a product, ``block`` first."""
    scope = tuple(dict.fromkeys(v for f in factors for v in f.scope))
    return scope, tuple(dict.fromkeys([block, *(b for f in factors for b in f.blocks)]))


# ---- private ------------------------------------------------------------------------------------


def _triangle(rows: np.ndarray) -> np.ndarray:
    """The triangular factor of the rows."""
    sizes = np.abs(rows[..., :-1]).max(axis=-1, initial=0.0)
    if sizes.max(initial=0.0) > _STIFF * sizes.min(initial=np.inf, where=sizes > 0):
        # large rows first: otherwise rounding of theirs would swamp small ones (Powell and Reid 1969)
        order = np.argsort(-sizes, axis=-1)
        rows = np.take_along_axis(rows, order[..., None], axis=-2)
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _product(
    factors: Sequence[GaussianFactor],
    scope: tuple[Any, ...],
    blocks: tuple[Any, ...],
    dims: Mapping[Any, int],
    cards: Mapping[Any, int],
) -> tuple[np.ndarray, np.ndarray]:
    """All rows, over the union of the scopes and of the blocks."""
    lead = tuple(cards[v] for v in scope)
    start, first = {}, 0
    for b in blocks:
        start[b] = first
        first += dims[b]
    total = sum(f.rows.shape[-2] for f in factors)
    rows = np.zeros((*lead, total, first + 1))
    log_scale = np.zeros(lead)
    top = 0
    for factor in factors:
        columns = [start[b] + k for b in factor.blocks for k in range(dims[b])] + [first]
        bottom = top + factor.rows.shape[-2]
        rows[..., top:bottom, columns] = along(factor.rows, factor.scope, scope)
        log_scale += along(factor.log_scale, factor.scope, scope)
        top = bottom
    return rows, log_scale


def along(array: np.ndarray, scope: Sequence[Any], wanted: Sequence[Any]) -> np.ndarray:
    """An array whose leading axes follow ``scope``, with those of ``wanted`` instead (size 1 where new)."""
    if scope == wanted:
        return array
    order = sorted(range(len(scope)), key=lambda k: wanted.index(scope[k]))
    moved = array.transpose([*order, *range(len(scope), array.ndim)])
    held = set(scope)
    sizes = iter(moved.shape[: len(scope)])
    lead = tuple(next(sizes) if v in held else 1 for v in wanted)
    return moved.reshape(lead + moved.shape[len(scope) :])
