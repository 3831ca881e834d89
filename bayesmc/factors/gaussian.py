"""Gaussian factors that discrete variables switch, in square-root information form, and strong elimination.

A factor is ``exp(log_scale - |A x - z|^2 / 2)`` for every configuration of its discrete scope, kept as the
rows ``[A | z]``. Products stack rows, and a block of x is integrated out by one QR decomposition: sums of
squares are never formed, so that the condition number is never squared. Blocks and discrete variables are
hashables; nets belong to the layers above.

In a hybrid product the continuous blocks go first, which leaves discrete tables. The discrete variables that
switch a connected set of hidden blocks all meet in one table when the last of its blocks is integrated out;
that table is the price of an exact answer, and known before it is paid. Sets of blocks that share no factor
stay apart, so nothing is enumerated beyond what switches one set.

References
----------
Lauritzen (1992), Propagation of probabilities, means and variances in mixed graphical association models;
square-root information: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, ch. V;
Lauritzen and Jensen (2001), Stable local computation with conditional Gaussian distributions; strong
triangulation: Leimer (1989).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .elimination import elimination_order

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


Scope = tuple[Any, ...]


@dataclass(frozen=True)
class Step:
    """One block integrated out: the factors that hold it, and what the product spans.

    Attributes
    ----------
    block : hashable
    sources : tuple of int
        Positions of the factors multiplied: those given first, then the results of earlier steps.
    scope : tuple of hashable
        Discrete variables of the product.
    parents : tuple of hashable
        Blocks left in the result; none where a set of blocks is done.
    bytes : float
        Memory of the product.
    """

    block: Any
    sources: tuple[int, ...]
    scope: Scope
    parents: tuple[Any, ...]
    bytes: float


@dataclass(frozen=True)
class StrongPlan:
    """The order of integration for factors of given scopes, and its price.

    Attributes
    ----------
    steps : tuple of Step
    table_scopes : tuple of tuple
        Discrete scopes of the tables that are left, in the order of `integrate`.
    bytes : float
        Memory of all products together.
    largest : Step or None
        The step of the largest product.
    """

    steps: tuple[Step, ...]
    table_scopes: tuple[Scope, ...]
    bytes: float
    largest: Step | None


def strong_plan(
    dims: Mapping[Any, int],
    cards: Mapping[Any, int],
    factors: Sequence[tuple[Scope, Scope, int]],
) -> StrongPlan:
    """Plan the integration of all blocks.

    Parameters
    ----------
    dims, cards : mapping
        Components of every block that is to go, states of every discrete variable.
    factors : sequence of (discrete scope, blocks, rows)

    Examples
    --------
    Two levels that share a discrete switch in the middle:

    >>> plan = strong_plan({"x": 1, "y": 1}, {"s": 2}, [((), ("x",), 1), (("s",), ("x", "y"), 1)])
    >>> [step.block for step in plan.steps], plan.table_scopes
    (['x', 'y'], (('s',),))
    """
    names = list(dims)
    index = {b: k for k, b in enumerate(names)}
    graph = [tuple(index[b] for b in blocks) for _, blocks, _ in factors]
    sizes = [2 ** min(dims[b], 1000) for b in names]
    order = elimination_order(sizes, graph, "min-fill").order if names else ()
    live: dict[int, tuple[Scope, Scope, int]] = dict(enumerate(factors))
    holding: dict[Any, set[int]] = {b: set() for b in names}
    for k, (_, blocks, _) in live.items():
        for b in blocks:
            holding[b].add(k)
    steps, tables = [], []
    for position in order:
        block = names[position]
        sources = tuple(sorted(holding[block]))
        parts = [live.pop(k) for k in sources]
        scope = tuple(dict.fromkeys(v for s, _, _ in parts for v in s))
        rest = tuple(b for b in dict.fromkeys(b for _, bs, _ in parts for b in bs) if b != block)
        width = dims[block] + sum(dims[b] for b in rest) + 1
        rows = sum(r for _, _, r in parts)
        entries = math.prod(map(float, (cards[v] for v in scope)))
        steps.append(Step(block, sources, scope, rest, 16.0 * entries * rows * width))
        made = len(factors) + len(steps) - 1
        for b in (block, *rest):
            holding[b].difference_update(sources)
        if rest:
            left = min(max(rows - dims[block], 0), width - 1 - dims[block])
            live[made] = (scope, rest, left)
            for b in rest:
                holding[b].add(made)
        else:
            tables.append(scope)
    largest = max(steps, key=lambda s: s.bytes, default=None)
    return StrongPlan(tuple(steps), tuple(tables), sum(s.bytes for s in steps), largest)


def integrate(
    plan: StrongPlan,
    factors: Sequence[GaussianFactor],
    dims: Mapping[Any, int],
    cards: Mapping[Any, int],
) -> tuple[list[Conditional], list[np.ndarray]]:
    """Integrate all blocks out, along the plan.

    Returns
    -------
    conditionals : list of Conditional
        Every block given blocks that were integrated after it.
    log_tables : list of ndarray
        Log factors over the plan's ``table_scopes``.
    """
    live: dict[int, GaussianFactor] = dict(enumerate(factors))
    conditionals, tables = [], []
    for number, step in enumerate(plan.steps):
        parts = [live.pop(k) for k in step.sources]
        conditional, left = eliminate(parts, step.block, dims, cards)
        conditionals.append(conditional)
        if left.blocks:
            live[len(factors) + number] = left
        else:
            tables.append(left.log_scale)
    return conditionals, tables


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
