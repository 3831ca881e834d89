"""Strong elimination: first the continuous blocks of a hybrid product, which leaves discrete tables.

The discrete variables that switch a connected set of hidden blocks all meet in one table when the last of
its blocks is integrated out; that table is the price of an exact answer, and known before it is paid.
Sets of blocks that share no factor stay apart, so nothing is enumerated beyond what switches one set.

References
----------
Lauritzen (1992); Lauritzen and Jensen (2001), Stable local computation with conditional Gaussian
distributions; strong triangulation: Leimer (1989).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .elimination import elimination_order
from .gaussian import Conditional, GaussianFactor, eliminate

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
