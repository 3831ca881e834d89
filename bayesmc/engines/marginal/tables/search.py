"""Which finite nodes are integrated out as tables, and which are sampled so that these stay small.

Nothing that is sampled may depend on what is integrated out, and where what is linear-Gaussian depends on a
finite node that node is sampled. Of the others all are integrated out, if their tables are small; else one
after the other is sampled, whichever leaves the smaller tables, and of those that leave tables of one size
whichever has fewer states.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.engines.marginal.tables.plan import (
    AUTO_NUMBERS,
    AUTO_STATES,
    MOST_NUMBERS,
    MOST_STATES,
    Fault,
    TablePlan,
    nodes_read,
    planned,
)
from bayesmc.errors import UnsupportedError

#: nodes of one table of which any may be sampled
_TRIED = 8


def is_finite(slices: Slices, name: str) -> bool:
    """Whether a node with a density has finitely many states, one number each."""
    node = slices.first[name]
    return node.is_stochastic and node.domain is not None and not node.event_shape


def found_plan(
    slices: Slices,
    hidden: Sequence[str],
    seen: Collection[str],
    apart_from: Collection[str],
    static: Mapping[str, np.ndarray],
) -> tuple[TablePlan | None, dict[str, str]]:
    """What ``"auto"`` integrates out, and why other finite nodes are not, but for those that numbers need.

    Parameters
    ----------
    hidden : sequence of str
    seen : collection of str
        Nodes that are seen in full in every slice.
    apart_from : collection of str
        Nodes that Kalman filters integrate out, or weigh.
    static : dict
    """
    read, limits = nodes_read(slices), (AUTO_STATES, AUTO_NUMBERS)
    names = [n for n in hidden if is_finite(slices, n) and n in read]
    why: dict[str, str] = {}

    def plan(some: Collection[str]) -> TablePlan | Fault:
        return planned(slices, some, seen, apart_from, static, limits)

    while names:
        found = plan(names)
        if isinstance(found, TablePlan):
            return _with_more(found, names, why, plan)
        if not found.is_size:
            first: Sequence[str] = found.nodes or names
        else:
            first = (_given_up(slices, names, found, plan),)
        out = _closed(slices, names, first)
        for name in out:
            by = f"{first[0]!r}, which is sampled, depends on it"
            if name not in first:
                why[name] = by
            elif not found.is_filtered:
                why[name] = found.reason
        if found.is_size and len(found.nodes) > 1:
            why[first[0]] += "; sampling it leaves the smallest tables"
        names = [n for n in names if n not in out]
    return None, why


def named_plan(
    slices: Slices,
    names: Sequence[str],
    seen: Collection[str],
    apart_from: Collection[str],
    static: Mapping[str, np.ndarray],
) -> TablePlan | None:
    """Some finite nodes integrated out; those that no density reads are drawn afterwards anyway.

    Raises
    ------
    UnsupportedError
        They cannot be.
    """
    read = nodes_read(slices)
    asked = [n for n in names if n in read]
    if not asked:
        return None
    found = planned(slices, asked, seen, apart_from, static, (MOST_STATES, MOST_NUMBERS))
    if isinstance(found, TablePlan):
        return found
    if found.is_size:
        remedy = "name fewer, so that others are sampled"
    else:
        remedy = f"leave {', '.join(map(repr, found.nodes))} out"
    raise UnsupportedError(
        f"marginalize= names {found.nodes[0]!r}, which has no table for each particle: {found.reason}; "
        f"{remedy}"
    )


# ---- private ------------------------------------------------------------------------------------


def _given_up(slices: Slices, names: Sequence[str], fault: Fault, plan: object) -> str:
    """The node that is sampled: the one without which tables are the smallest."""
    assert callable(plan)
    tried = sorted(fault.nodes, key=lambda n: -_states(slices, n))[:_TRIED]

    def size(name: str) -> tuple[float, float, int]:
        out = _closed(slices, names, (name,))
        left = plan([n for n in names if n not in out])
        largest = left.largest[0] if isinstance(left, TablePlan) else math.inf
        return largest, _log_states(slices, out), names.index(name)

    sizes = {n: size(n) for n in tried}
    best = min(tried, key=lambda n: sizes[n])
    if math.isinf(sizes[best][0]):  # one is not enough
        return tried[0]
    return best


def _with_more(
    found: TablePlan, names: Sequence[str], why: dict[str, str], plan: object
) -> tuple[TablePlan, dict[str, str]]:
    """With nodes that were given up before others were, where there is room for them now."""
    assert callable(plan)
    for name in list(why):
        more = plan([*names, name])
        if isinstance(more, TablePlan):
            found, names = more, [*names, name]
            del why[name]
    return found, why


def _closed(slices: Slices, names: Collection[str], out: Collection[str]) -> tuple[str, ...]:
    """Nodes that are sampled, with all of those that they depend on."""
    found, todo, met = set(out), list(out), set(out)
    while todo:
        name = todo.pop()
        for model in (slices.first, slices.later):
            for parent in model[name].parents:
                stem = parent.removesuffix(PREVIOUS)
                if stem in met or stem not in slices.dynamic:
                    continue
                met.add(stem)
                if stem in names:
                    found.add(stem)
                    todo.append(stem)
                elif not slices.first[stem].is_stochastic:
                    todo.append(stem)
    return tuple(n for n in slices.dynamic if n in found)


def _states(slices: Slices, name: str) -> float:
    node = slices.first[name]
    assert node.domain is not None
    return math.log(node.domain.size) * math.prod(node.plate_shape)


def _log_states(slices: Slices, names: Collection[str]) -> float:
    return sum(_states(slices, n) for n in names)
