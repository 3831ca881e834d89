"""Products of log tables over finite variables, summed or maximised out, many slices at once.

A ``Piece`` is one factor: rows of time lead, then the sequences that are filtered separately, then one axis
for every variable of its scope. Sums are taken in logs, so that densities of any size go in. It knows
variables and arrays, not nets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

#: slices back, node, element of its plates
Variable = tuple[int, str, int]


@dataclass(frozen=True, eq=False)
class Piece:
    """A factor over finite variables.

    Attributes
    ----------
    node : str
        Whose conditional density it is.
    scope : tuple of Variable
    log : ndarray, shape (rows or 1, sequences or 1, *cards)
    is_evidence : bool
        It says what was seen, not what is possible.
    invalid : ndarray of bool or None
        Configurations with bad parameters, where ``log`` is 0; shape as ``log``.
    """

    node: str
    scope: tuple[Variable, ...]
    log: np.ndarray
    is_evidence: bool = False
    invalid: np.ndarray | None = None


def product(
    pieces: Sequence[Piece], scope: Sequence[Variable], cards: Mapping[Variable, int]
) -> np.ndarray:
    """The sum of logs over a scope that holds those of all pieces, shape (rows, sequences, *cards)."""
    shape = tuple(cards[v] for v in scope)
    if len(pieces) == 1:
        alone = spread(pieces[0].log, pieces[0].scope, scope)
        return np.broadcast_to(alone, (*alone.shape[:2], *shape))
    total = np.zeros((1, 1, *shape))
    for piece in pieces:
        total = total + spread(piece.log, piece.scope, scope)
    return total


def eliminate(
    pieces: Sequence[Piece],
    keep: Sequence[Variable],
    cards: Mapping[Variable, int],
    reduce: Callable[[np.ndarray, int], np.ndarray],
) -> Piece:
    """All variables but those to ``keep`` taken out of a product, the cheapest first.

    Parameters
    ----------
    reduce : callable
        ``log_sum`` or ``log_max``.
    """
    left = list(pieces)
    todo = {v for p in left for v in p.scope} - set(keep)
    while todo:
        variable = min(todo, key=lambda v: (_size(left, v, cards), v))
        touched = [p for p in left if variable in p.scope]
        rest = tuple(dict.fromkeys(v for p in touched for v in p.scope if v != variable))
        joint = product(touched, (*rest, variable), cards)
        left = [p for p in left if variable not in p.scope]
        left.append(Piece(variable[1], rest, reduce(joint, -1)))
        todo.remove(variable)
    return Piece("", tuple(keep), product(left, tuple(keep), cards))


def width(
    scopes: Iterable[Sequence[Variable]], keep: Iterable[Variable], cards: Mapping[Variable, int]
) -> float:
    """Entries of the largest table that ``eliminate`` makes, known from scopes alone."""
    left = [frozenset(s) for s in scopes]
    kept = frozenset(keep)
    todo = {v for s in left for v in s} - kept
    widest = _entries(kept, cards)
    while todo:
        unions = {v: frozenset().union(*(s for s in left if v in s)) for v in todo}
        variable = min(todo, key=lambda v: (_entries(unions[v], cards), v))
        widest = max(widest, _entries(unions[variable], cards))
        left = [s for s in left if variable not in s] + [unions[variable] - {variable}]
        todo.remove(variable)
    return widest


def groups(
    variables: Iterable[Variable], scopes: Iterable[Sequence[Variable]]
) -> list[tuple[Variable, ...]]:
    """The variables in classes that no scope connects, each in the order given."""
    root = {v: v for v in variables}

    def top(v: Variable) -> Variable:
        while root[v] != v:
            root[v] = root[root[v]]
            v = root[v]
        return v

    for scope in scopes:
        inside = [v for v in scope if v in root]
        for other in inside[1:]:
            root[top(other)] = top(inside[0])
    found: dict[Variable, list[Variable]] = {}
    for v in root:
        found.setdefault(top(v), []).append(v)
    return [tuple(vs) for vs in found.values()]


def spread(array: np.ndarray, scope: Sequence[Variable], target: Sequence[Variable]) -> np.ndarray:
    """The array with its axes in the order of ``target``, ones where it does not vary."""
    order = sorted(range(len(scope)), key=lambda k: target.index(scope[k]))
    moved = array.transpose(0, 1, *(2 + k for k in order))
    index: list[slice | None] = [slice(None) if v in scope else None for v in target]
    return moved[(slice(None), slice(None), *index)]


def log_sum(array: np.ndarray, axis: int) -> np.ndarray:
    """Log of a sum of exponentials along an axis; -inf where all are."""
    with np.errstate(divide="ignore", invalid="ignore"):
        top = array.max(axis=axis, keepdims=True)
        safe = np.where(np.isfinite(top), top, 0.0)
        total = np.log(np.exp(array - safe).sum(axis=axis))
    return total + np.squeeze(safe, axis)


def log_max(array: np.ndarray, axis: int) -> np.ndarray:
    """The largest along an axis."""
    return array.max(axis=axis)


# ---- private ------------------------------------------------------------------------------------


def _size(pieces: Sequence[Piece], variable: Variable, cards: Mapping[Variable, int]) -> float:
    scopes = [p.scope for p in pieces if variable in p.scope]
    return _entries(frozenset().union(*scopes), cards)


def _entries(scope: Iterable[Variable], cards: Mapping[Variable, int]) -> float:
    return math.prod(float(cards[v]) for v in scope)
