"""States that a factor leaves out because others rule them out, though the posterior may not.

Independent factors cannot hold a relation that zero probabilities make (``b`` is a copy of ``a``) but in one
of the ways in which it may hold: whatever is left out has probability zero, and no weight of a draw tells.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesmc.engines.variational.factors import IMPOSSIBLE, State, TableFactor
from bayesmc.engines.variational.reading import Sum
from bayesmc.engines.variational.steps import Plan
from bayesmc.expression import Expression, Program
from bayesmc.passes.derivatives import gradient

#: a share of what is impossible that is more than rounding
_SHARE = 1e-9


def left_out(plan: Plan, state: State) -> tuple[str, ...]:
    """Finite nodes with states that are left out, though others alone do not rule them out for certain.

    Parameters
    ----------
    plan : Plan
    state : dict
        Where the ascent ended.
    """
    tables = [f for f in plan.factors if isinstance(f, TableFactor)]
    steep = [s for s in plan.sums if s.plain is not None and _is_steep(s)]
    if not tables or not steep:
        return ()
    programs = []
    for s in steep:
        assert s.plain is not None
        slopes = gradient(s.plain, [f.table for f in tables])
        programs.append((tuple(slopes), Program(list(slopes.values()))))
    possible = _possible(tables, programs, state)
    found: dict[str, None] = {}
    ruled = _ruled_out(programs, state)
    for factor in tables:
        out = np.zeros(factor.shape, bool)
        for share in ruled.get(factor.table, []):
            out |= share > _SHARE
        if factor.seen is not None:
            out &= ~factor.seen
        if (out & possible[factor.table]).any():
            found |= dict.fromkeys(factor.names)
    return tuple(found)


# ---- private ------------------------------------------------------------------------------------

_Programs = list[tuple[tuple[str, ...], Program]]


def _is_steep(s: Sum) -> bool:
    """Whether zero probabilities occur in a term."""
    assert s.plain is not None
    return any(_is_lowest(node) for node in _below(s.plain))


def _below(root: Expression) -> list[Expression]:
    found, todo = {root}, [root]
    while todo:
        for operand in todo.pop().operands:
            if operand not in found:
                found.add(operand)
                todo.append(operand)
    return list(found)


def _is_lowest(node: Expression) -> bool:
    value = getattr(node, "value", None)
    return value is not None and value.dtype.kind == "f" and bool((value <= IMPOSSIBLE).any())


def _ruled_out(programs: _Programs, state: State) -> Mapping[str, list[np.ndarray]]:
    """Table -> for every term how often it says that a state is impossible."""
    found: dict[str, list[np.ndarray]] = {}
    for names, program in programs:
        for name, slope in zip(names, program(state), strict=True):
            value = np.asarray(slope)
            while value.ndim > state[name].ndim:  # points of free numbers
                value = value.mean(axis=0)
            found.setdefault(name, []).append(value / IMPOSSIBLE)
    return found


def _possible(
    tables: list[TableFactor], programs: _Programs, state: State
) -> dict[str, np.ndarray]:
    """Which states no term rules out whatever the others are, of those that are possible (arc consistency).

    Tables are random: a share that is whole is one of all states of the others.
    """
    rng = np.random.default_rng(0)
    allowed = {
        f.table: np.ones(f.shape, bool)
        if f.seen is None
        else np.where(f.seen, state[f.table] > 0, True)
        for f in tables
    }
    while True:
        trial = dict(state)
        for factor in tables:
            weights = np.where(allowed[factor.table], rng.uniform(0.2, 1.0, factor.shape), 0.0)
            trial[factor.table] = weights / np.maximum(weights.sum(axis=0), 1e-300)
        changed = False
        for name, shares in _ruled_out(programs, trial).items():
            for share in shares:
                whole = (share > 0.5) & (np.abs(share - np.rint(share)) < _SHARE)
                if (whole & allowed[name]).any():
                    allowed[name] = allowed[name] & ~whole
                    changed = True
        if not changed:
            return allowed
