"""Clusters of the nodes that a slice hands on: as users name them, and as a junction tree.

A belief over clusters is the product of their tables over those of the separators, so clusters that overlap
must form a tree in which whatever two of them share is in all between.

References
----------
Boyen and Koller (1998), Tractable inference for complex stochastic processes, UAI; Koller and Friedman
(2009), sec. 15.3.2 (factored and conditionally factored beliefs) and 10.4.2 (the maximum spanning tree).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import Slices
from bayesmc.engines.discrete.rows import Variable
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.errors import UnknownNodeError, UnsupportedError, did_you_mean

Scope = tuple[Variable, ...]


@dataclass(frozen=True)
class Cluster:
    """Variables whose joint probabilities are kept.

    Attributes
    ----------
    scope : tuple of Variable
        Seen from their own slice.
    separator : tuple of Variable
        Those that an earlier cluster of the tree has, too.
    size : int
        Joint states.
    """

    scope: Scope
    separator: Scope
    size: int

    @property
    def before(self) -> Scope:
        """The same variables, seen from the next slice."""
        return tuple((1, *v[1:]) for v in self.scope)

    def conditional(self, table: np.ndarray, semiring: Any) -> np.ndarray:
        """Its table, (..., *cards), given its separator: what it adds to the clusters before it."""
        if not self.separator:
            return table
        lead = table.ndim - len(self.scope)
        out = [lead + k for k, v in enumerate(self.scope) if v not in self.separator]
        shape = [1 if k in out else n for k, n in enumerate(table.shape)]
        rows = np.moveaxis(table, out, range(-len(out), 0)).reshape(math.prod(shape), -1)
        return semiring.ratio(table, semiring.row_sums(rows).reshape(shape))


def named_clusters(given: Any, plan: DiscreteSlices) -> list[Scope]:
    """The clusters of users, element by element; faults are told by name.

    A cluster that names nodes in plates stands for one of each element.

    Raises
    ------
    TypeError, UnknownNodeError, UnsupportedError
    """
    slices, found = plan.slices, []
    persistent = {v for chain in plan.chains for v in chain.state}
    for cluster in given:
        for scope in _elements(cluster, slices, plan.reader.apart):
            for name, _ in scope:
                _check_handed_on(name, slices, plan)
            own = tuple(dict.fromkeys((0, *v) for v in scope))
            found.append(tuple(v for v in own if v in persistent))
    covered = {v for scope in found for v in scope}
    missing = [v for chain in plan.chains for v in chain.state if v not in covered]
    if missing:
        names = ", ".join(dict.fromkeys(repr(v[1]) for v in missing))
        raise UnsupportedError(
            f"BoyenKoller(clusters=): the next slice reads {names}, in none of the clusters; put each such "
            "node into one, or leave clusters= out"
        )
    return found


def check_clusters(given: Any) -> tuple[tuple[Any, ...], ...]:
    """Clusters as tuples.

    Raises
    ------
    TypeError
    """
    fix = 'give clusters=[["a", "b"], ["c"]], lists of names of nodes'
    if isinstance(given, (str, bytes)) or not isinstance(given, Iterable):
        raise TypeError(f"BoyenKoller(clusters={given!r}): {fix}")
    found = []
    for cluster in given:
        if isinstance(cluster, (str, bytes)) or not isinstance(cluster, Iterable):
            raise TypeError(f"BoyenKoller(clusters=): {cluster!r} is no cluster; {fix}")
        found.append(tuple(cluster))
        for name in found[-1]:
            at = name[1:] if isinstance(name, tuple) else ()
            plain = name[0] if isinstance(name, tuple) and name else name
            if not isinstance(plain, str) or not all(isinstance(k, (int, np.integer)) for k in at):
                raise TypeError(
                    f"BoyenKoller(clusters=): {name!r} is no node; {fix}, or of one element of a plate, "
                    '("a", 3)'
                )
    return tuple(found)


def junction_tree(scopes: Sequence[Scope], state: Scope, plan: DiscreteSlices) -> list[Cluster]:
    """Clusters of one chain as a tree, each after the one that its separator is in.

    What of a cluster is in other chains is independent of the rest, always, and is left out.

    Raises
    ------
    UnsupportedError
        The clusters form no junction tree.
    """
    inside = {v: k for k, v in enumerate(state)}
    own = dict.fromkeys(
        tuple(sorted((v for v in s if v in inside), key=inside.__getitem__)) for s in scopes
    )
    holding: dict[Variable, list[Scope]] = {}
    for scope in own:
        for v in scope:
            holding.setdefault(v, []).append(scope)
    left = [s for s in own if s and not any(set(s) < set(other) for other in holding[s[0]])]
    shared = dict.fromkeys(left, 0)  # variables with the cluster of the tree that has most of them
    found: list[Cluster] = []
    placed: list[frozenset[Variable]] = []
    seen: set[Variable] = set()
    while shared:
        scope = max(shared, key=shared.__getitem__)
        del shared[scope]
        members = frozenset(scope)
        separator = members & seen
        around = [g for g in placed if g & separator] if separator else []
        if separator and not any(separator <= g for g in around):
            raise _no_tree(scope, around)
        size = math.prod(plan.cards[v] for v in scope)
        found.append(Cluster(scope, tuple(v for v in scope if v in separator), size))
        placed.append(members)
        seen.update(members)
        for other in (s for v in scope for s in holding[v] if s in shared):
            shared[other] = max(shared[other], len(members.intersection(other)))
    return found


def in_words(scope: Iterable[Variable], slices: Slices) -> str:
    """A cluster's nodes, with the elements of those in plates."""
    parts = []
    for _, name, element in scope:
        parts.append(f"{name}[{element}]" if slices.first[name].plates and element else name)
    return ", ".join(parts)


# ---- private ------------------------------------------------------------------------------------


def _elements(
    cluster: Sequence[Any], slices: Slices, apart: tuple[str, ...]
) -> list[list[tuple[str, int]]]:
    """A cluster's nodes with the elements that they stand for, one list for each element of its plates."""
    names = [n if isinstance(n, tuple) else (n,) for n in cluster]
    for name, *at in names:
        node = slices.first.nodes.get(name)
        if node is None or name not in slices.dynamic:
            raise UnknownNodeError(
                f"BoyenKoller(clusters=): there is no node {name!r} in a slice"
                f"{did_you_mean(name, slices.dynamic)}; there are {list(slices.dynamic)}"
            )
        if at and (
            len(at) != len(node.plates)
            or any(not 0 <= k < n for k, n in zip(at, node.plate_shape, strict=True))
        ):
            raise UnsupportedError(
                f"BoyenKoller(clusters=): {(name, *at)!r}: node {name!r} has plates "
                f"{dict(zip(node.plates, node.plate_shape, strict=True))}; give one position in each"
            )
    sizes = {
        p: size
        for name, *at in names if not at
        for p, size in zip(slices.first[name].plates, slices.first[name].plate_shape, strict=True)
        if p not in apart
    }  # fmt: skip
    found = []
    for place in itertools.product(*(range(n) for n in sizes.values())):
        here = dict(zip(sizes, place, strict=True))
        scope = []
        for name, *at in names:
            node = slices.first[name]
            inner = [k for k, p in enumerate(node.plates) if p not in apart]
            own = [at[k] if at else here[node.plates[k]] for k in inner]
            shape = [node.plate_shape[k] for k in inner]
            scope.append((name, int(np.ravel_multi_index(own, shape)) if own else 0))
        found.append(scope)
    return found


def _check_handed_on(name: str, slices: Slices, plan: DiscreteSlices) -> None:
    """Refuse nodes that no belief need keep; those that are observed are known, and may stand there."""
    if name in slices.interface or any(v[1] == name for c in plan.chains for v in c.state):
        return
    names = list(dict.fromkeys(v[1] for c in plan.chains for v in c.state))
    raise UnsupportedError(
        f"BoyenKoller(clusters=): the next slice does not read {name!r}, so that no belief keeps it; leave "
        f"it out: clusters are made of {names}"
    )


def _no_tree(scope: Scope, others: Sequence[frozenset[Variable]]) -> UnsupportedError:
    def words(variables: Iterable[Variable]) -> str:
        return "(" + ", ".join(sorted({v[1] for v in variables})) + ")"

    return UnsupportedError(
        f"BoyenKoller(clusters=): the clusters {words(scope)}, {', '.join(map(words, others))} overlap in a "
        "ring; clusters that overlap must form a tree, in which what two of them share is in all between: "
        "put two of them together"
    )
