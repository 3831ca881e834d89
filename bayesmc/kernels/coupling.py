"""Which finite nodes must move jointly: those that tables with zeros, or nearly zeros, tie together.

A Gibbs sampler that changes one node at a time cannot leave a configuration all of whose neighbours are
impossible. What is possible is read off the tables; whether the moves connect it is then settled by
elimination and enumeration, where that is feasible, and otherwise taken to fail.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bayesmc.factors.named import Named, aligned, connected, sizes_of
from bayesmc.kernels.enumerate import FiniteTerm, FiniteTerms
from bayesmc.structure.target import Target

#: one element of a node: its name and number
_Variable = Any

#: joint states of a block
_STATES = 256
#: a table's entries below this share of its largest tie its nodes
_TINY = 1e-6
#: joint states that are enumerated to see whether moves connect them
_ENUMERATED = 1 << 16
#: elements of a table's plates that are looked at; they are mostly alike
_ELEMENTS = 64


def coupled_blocks(
    target: Target,
    terms: FiniteTerms | None = None,
    joined: Sequence[Sequence[str]] = (),
    largest: int = _STATES,
) -> list[tuple[str, ...]]:
    """Small blocks of finite nodes that should be drawn jointly, so that chains can move.

    Parameters
    ----------
    joined : sequence of sequence of str
        What is drawn jointly already.
    largest : int
        Joint states of a block.

    Returns
    -------
    list of tuple of str
        Blocks, which may overlap; none where moves of single nodes do. Nodes of a block live in the same
        plates.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.coupling import coupled_blocks, deterministic_constraints
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Bernoulli(0.5))
    >>> net.add("y", bmc.Bernoulli(0.5))
    >>> net.add("parity", lambda x, y: bmc.Bernoulli((x + y) % 2 * 1.0))
    >>> target = target_of(pose(net, {"parity": 1}))
    >>> coupled_blocks(target)
    [('x', 'y')]
    >>> deterministic_constraints(target)
    ()
    """
    terms = FiniteTerms(target) if terms is None else terms
    supports = _supports(target, terms, _TINY)
    blocks: list[tuple[str, ...]] = []
    for grow in (False, True):
        stuck = _stuck(supports, _moves(target, [*joined, *blocks]))
        for component in stuck:
            for block in _proposed(target, supports, component, largest, grow):
                if block not in blocks and _alike(target, block):
                    blocks.append(block)
    sets = [set(b) for b in blocks]
    return [b for b in blocks if not any(set(b) < s for s in sets)]


def deterministic_constraints(
    target: Target,
    blocks: Sequence[Sequence[str]] | None = None,
    terms: FiniteTerms | None = None,
) -> tuple[str, ...]:
    """Nodes among which zeros in tables may keep a chain from reaching every possible configuration.

    Parameters
    ----------
    blocks : sequence of sequence of str, optional
        What is drawn jointly, beside every node alone; `coupled_blocks` by default.

    Returns
    -------
    tuple of str
        Parents first; empty where the moves are known to connect all that is possible, as far as zeros of
        tables go. Zero densities of other terms are not looked at.
    """
    terms = FiniteTerms(target) if terms is None else terms
    joined = coupled_blocks(target, terms) if blocks is None else blocks
    supports = _supports(target, terms, 0.0)
    found = {n for c in _stuck(supports, _moves(target, joined)) for n, _ in c}
    return tuple(n for n in target.chain if n in found)


# ---- private ------------------------------------------------------------------------------------


def _supports(target: Target, terms: FiniteTerms, share: float) -> list[Named]:
    """What every table allows: entries above a share of its largest."""
    found = []
    for term in target.terms.values():
        table = terms.of(term)
        if table is None or not table.scope:
            continue
        axes = tuple(range(len(table.scope)))
        with np.errstate(divide="ignore", invalid="ignore"):
            possible = table.log > table.log.max(axis=axes) + np.log(share)
        found += list(_elements(target, table, possible))
    return found


def _elements(target: Target, table: FiniteTerm, possible: np.ndarray) -> Iterator[Named]:
    """The supports of the elements of a term, but for those that allow all."""
    n = len(table.scope)
    shape = possible.shape[n:]
    free = possible.all(axis=tuple(range(n)))
    for at in np.argwhere(~free)[:_ELEMENTS] if shape else ([()] if not free else []):
        element = dict(zip(table.plates, (int(i) for i in at), strict=True))
        scope = []
        for name in table.scope:
            node = target.model[name]
            own = tuple(element[p] for p in node.plates)
            scope.append((name, int(np.ravel_multi_index(own, node.plate_shape)) if own else 0))
        yield Named(tuple(scope), possible[(Ellipsis, *at)])


def _stuck(
    supports: Sequence[Named], moves: Sequence[frozenset[_Variable]]
) -> list[tuple[_Variable, ...]]:
    """Sets of variables whose possible states the moves are not known to connect.

    A state that a variable may take whatever the others are lets it step aside: all can go there first,
    and what is left is smaller.
    """
    tied = _without_safe(list(supports))
    several = [s.scope for s in tied if len(s.scope) > 1]
    if not several:
        return []
    return [
        scope
        for scope in connected((v for s in several for v in s), several)
        if not _connects(scope, [s for s in tied if set(s.scope) <= set(scope)], moves)
    ]


def _without_safe(supports: list[Named]) -> list[Named]:
    changed = True
    while changed:
        changed = False
        for variable in dict.fromkeys(v for s in supports for v in s.scope):
            touching = [s for s in supports if variable in s.scope]
            state = _safe_state(variable, touching) if touching else None
            if state is not None:
                changed = True
                supports = [
                    Named(
                        tuple(v for v in s.scope if v != variable),
                        s.values.take(state, axis=s.scope.index(variable)),
                    )
                    if variable in s.scope
                    else s
                    for s in supports
                ]
                supports = [s for s in supports if s.scope and not s.values.all()]
    return supports


def _safe_state(variable: _Variable, touching: Sequence[Named]) -> int | None:
    """A state that is possible wherever any state of the variable is."""
    safe = np.ones(touching[0].values.shape[touching[0].scope.index(variable)], dtype=bool)
    for support in touching:
        axis = support.scope.index(variable)
        front = np.moveaxis(support.values, axis, 0).reshape(support.values.shape[axis], -1)
        safe &= (front >= front.any(axis=0)).all(axis=1)
    return int(np.argmax(safe)) if safe.any() else None


def _connects(
    scope: tuple[_Variable, ...],
    supports: Sequence[Named],
    moves: Sequence[frozenset[_Variable]],
) -> bool:
    """Whether moves lead from every possible joint state to every other, by enumeration if need be."""
    if any(move.issuperset(scope) for move in moves):
        return True
    sizes = sizes_of(supports)
    cards = tuple(sizes[v] for v in scope)
    if math.prod(cards) > _ENUMERATED:
        return False
    possible = np.ones(cards, dtype=bool)
    for support in supports:
        possible &= aligned(support, scope)
    nowhere = possible.size
    label = np.where(possible, np.arange(nowhere).reshape(cards), nowhere)
    axes: list[tuple[int, ...]] = [(i,) for i in range(len(scope))]
    axes += [tuple(i for i, v in enumerate(scope) if v in move) for move in moves]
    axes = [a for a in axes if a]
    while True:
        before = label
        for along in axes:
            label = np.where(possible, label.min(axis=along, keepdims=True), nowhere)
        if (label == before).all():
            return len(np.unique(label[possible])) <= 1


def _moves(target: Target, blocks: Sequence[Sequence[str]]) -> list[frozenset[_Variable]]:
    """The blocks of all elements."""
    found = []
    for block in blocks:
        for element in range(math.prod(target.model[block[0]].plate_shape)):
            found.append(frozenset((n, element) for n in block))
    return found


def _proposed(
    target: Target,
    supports: Sequence[Named],
    component: tuple[_Variable, ...],
    largest: int,
    grow: bool,
) -> Iterator[tuple[str, ...]]:
    """Blocks for a set of variables that are stuck: the scopes of its tables, or larger ones."""
    inside = set(component)
    sizes = {v: n for v, n in sizes_of(supports).items() if v in inside}
    tied = [s for s in supports if len(inside & set(s.scope)) > 1]
    if grow and math.prod(sizes.values()) <= largest:
        yield _ordered(target, component)
        return
    for support in tied:
        scope = [v for v in support.scope if v in inside]
        for start in scope:
            block = _fitting([start, *(v for v in scope if v != start)], sizes, largest)
            if grow:
                block = _grown(block, tied, sizes, largest)
            if len(block) > 1:
                yield _ordered(target, block)


def _fitting(
    variables: Sequence[_Variable], sizes: dict[_Variable, int], largest: int
) -> list[_Variable]:
    """Those of some variables, in order, that have few joint states together."""
    block: list[_Variable] = []
    states = 1
    for variable in variables:
        if variable not in block and states * sizes[variable] <= largest:
            block.append(variable)
            states *= sizes[variable]
    return block


def _grown(
    block: list[_Variable], tied: Sequence[Named], sizes: dict[_Variable, int], largest: int
) -> list[_Variable]:
    """A block with what is tied to it, nearest first, as long as it fits."""
    while True:
        near = [v for s in tied if set(s.scope) & set(block) for v in s.scope if v in sizes]
        larger = _fitting([*block, *near], sizes, largest)
        if len(larger) == len(block):
            return block
        block = larger


def _ordered(target: Target, block: Sequence[_Variable]) -> tuple[str, ...]:
    names = {n for n, _ in block}
    return tuple(n for n in target.chain if n in names)


def _alike(target: Target, block: tuple[str, ...]) -> bool:
    """Whether the nodes can be a block: in the same plates, and more than one."""
    return len(block) > 1 and len({target.model[n].plates for n in block}) == 1
