"""Topological order, ancestors, and the path of a cycle."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence

from bayesmc.errors import CycleError


def topological_order(parents: Mapping[str, Sequence[str]]) -> list[str]:
    """Names with every parent before its children, otherwise as declared (Kahn 1962)."""
    waiting = {name: len(set(above)) for name, above in parents.items()}
    children: dict[str, list[str]] = {name: [] for name in parents}
    for name, above in parents.items():
        for parent in set(above):
            children[parent].append(name)
    ready = deque(name for name, count in waiting.items() if count == 0)
    order = []
    while ready:
        name = ready.popleft()
        order.append(name)
        for child in children[name]:
            waiting[child] -= 1
            if waiting[child] == 0:
                ready.append(child)
    if len(order) < len(parents):
        path = cycle_path(parents, [n for n in parents if waiting[n] > 0])
        raise CycleError(
            f"the parents form a cycle: {' -> '.join(path)}; a net must be acyclic "
            "(for time, use a dynamic net with _prev arguments)",
            path,
        )
    return order


def cycle_path(parents: Mapping[str, Sequence[str]], among: Iterable[str]) -> list[str]:
    """One directed cycle, parent before child, its first name repeated at the end."""
    left = set(among)
    name = next(iter(sorted(left)))
    seen: dict[str, int] = {}
    trail: list[str] = []
    while name not in seen:
        seen[name] = len(trail)
        trail.append(name)
        name = next(p for p in parents[name] if p in left)
    cycle = trail[seen[name] :][::-1]
    start = cycle.index(min(cycle))
    cycle = cycle[start:] + cycle[:start]
    return [*cycle, cycle[0]]


def ancestors(parents: Mapping[str, Sequence[str]], names: Iterable[str]) -> set[str]:
    """``names`` and everything above them."""
    found: set[str] = set()
    todo = list(names)
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            todo.extend(parents[name])
    return found
