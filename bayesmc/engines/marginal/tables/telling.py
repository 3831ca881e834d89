"""What is said of nodes that have tables, and of those that wait for them."""

from __future__ import annotations

from collections.abc import Sequence

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.marginal.tables.plan import Group, TablePlan


def tables_told(plan: TablePlan, problem: SeriesProblem) -> dict[str, str]:
    """Node -> what is done to it."""
    found: dict[str, str] = {}
    observed = problem.series.observed
    for group in plan.groups:
        for name in group.names:
            found[name] = f"integrated out, {_table(group, name)}"
            if name in observed:
                found[name] += "; its state where it is seen"
    for name in plan.below:
        group = next(plan.groups[g] for g, n, _ in plan.looks if n == name)
        picks = any(look.at is not None for (_, n, _), look in plan.looks.items() if n == name)
        if name not in observed:
            found[name] = "drawn given one draw from each particle's tables"
            continue
        where = f" of the element of {_names(group.names)} that it reads" if picks else ""
        found[name] = f"observed, weights the particles by its sum over the states{where}"
        if observed[name].mask is not None:
            found[name] += "; drawn given one draw from the tables where it is missing"
    return found


# ---- private ------------------------------------------------------------------------------------


def _table(group: Group, name: str) -> str:
    each = "each particle"
    if group.plates:
        each += f" and element of {_names(group.plates)}"
    if len(group.variables) == 1:
        return f"a table of {group.states} states for {each}"
    others = [n for n in group.names if n != name]
    with_ = f" with {_names(others)}" if others else ""
    return f"a table of {group.states} joint states{with_} for {each}"


def _names(names: Sequence[str]) -> str:
    return " and ".join(map(repr, names))
