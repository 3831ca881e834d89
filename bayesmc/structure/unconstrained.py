"""The log posterior density as a function of unconstrained numbers, with its gradient.

Continuous nodes become free numbers through the maps of their supports (``free_nodes``), every term is an
expression of them (``Term.expression``), and their sum with the changes of volume is one expression, whose
gradient is taken in reverse mode. Before its first use it is held against the model's own functions.

References
----------
Stan Reference Manual, version 2.36, chapter "Constraint Transforms"; Griewank and Walther (2008), Evaluating
Derivatives, 2nd ed., sec. 3.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import (
    Expression,
    Leaf,
    as_expression,
    broadcast,
    leaf,
    pick,
    reduction,
)
from bayesmc.passes.alike import sums_of
from bayesmc.passes.arithmetic import ZERO, add, multiply
from bayesmc.passes.derivatives import gradient
from bayesmc.passes.guarded import guarded
from bayesmc.passes.logarithms import stable
from bayesmc.structure.free_density import FREE, UnconstrainedDensity
from bayesmc.structure.free_nodes import FreeNode, free_node
from bayesmc.structure.free_terms import elements_of, known_values, put_in
from bayesmc.structure.summing import sum_out
from bayesmc.structure.target import Target, Term
from bayesmc.structure.unconstrained_check import hold_against_model

__all__ = ["FREE", "UnconstrainedDensity", "unconstrained_density"]

#: numbers that are added up one by one, and nodes by which one by one derivatives are taken
_FEW = 12


def unconstrained_density(
    target: Target,
    names: Iterable[str] | None = None,
    summed: Iterable[str] = (),
    shares: np.ndarray | None = None,
) -> UnconstrainedDensity:
    """The log density of some continuous nodes given all others, on unconstrained numbers.

    Parameters
    ----------
    target : Target
    names : iterable of str, optional
        Nodes of the chain that move; all continuous ones by default. The terms that they enter count.
    summed : iterable of str, optional
        Finite nodes of the chain that are summed out (``sum_out``); others are given by their values.
    shares : ndarray, optional
        For each free number how far it is centred, 1 as declared (``structure.centring``).

    Raises
    ------
    UnsupportedError
        A term cannot be followed, has no closed form or no derivative, or differs from the model's own
        functions at probe points.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet(plates={"point": 3})
    >>> net.add("rate", bmc.Exponential(1.0))
    >>> net.add("y", lambda rate: bmc.Poisson(rate), plates="point")
    >>> density = unconstrained_density(target_of(pose(net, {"y": [1, 2, 3]})))
    >>> density.labels, density.constrain(np.array([0.0])), density.with_gradient(np.array([0.0]))
    (['rate'], {'rate': array(1.)}, (np.float64(-6.484906649788), array([3.])))
    """
    nodes = _laid_out(target, names, shares)
    if not nodes:
        raise UnsupportedError("no hidden node is continuous: there are no unconstrained numbers")
    finite = [n for n in target.chain if n in set(summed)]
    terms = target.terms_of([*(n.name for n in nodes), *finite])
    parts = {n.name: leaf(f"{FREE} of {n.name}", (n.size,)) for n in nodes}
    above: dict[str, Expression] = {}
    volumes = {}
    for node in nodes:
        given = {**known_values(target, node.bounds), **above}
        above[node.name], volumes[node.name] = node.expressions(parts[node.name], given)
    logs = elements_of(target, terms, above)
    plain = [log.anywhere for log in logs]
    whole = {n.name for n in nodes if n.elements is None}
    used = [
        log.inside if t.name in whole else log.anywhere for t, log in zip(terms, logs, strict=True)
    ]
    used = stable([*used, *volumes.values()])
    tables = sum_out(target, terms, finite, above)
    inside = {term.name for table in tables for term in table.terms}
    kept = [e for e, t in zip(used, terms, strict=False) if t.name not in inside]
    kept += used[len(terms) :]
    root = _total([*sums_of(kept), *(table.total for table in tables)])
    for name in sorted(root.leaves & set(finite)):
        raise UnsupportedError(
            f"node {name!r} is to be summed out, and the bounds of a continuous node depend on it; use Gibbs"
        )
    once = _on_one_leaf(nodes, parts)
    slopes = _slopes(root, list(zip(terms, used, strict=False)), list(parts.values()), once)
    tables = [table.mapped(lambda e: once(guarded([e]))[0]) for table in tables]
    volume, root = once([_total(used[len(terms) :]), root])
    density = UnconstrainedDensity(
        target, nodes, root, slopes, tuple(finite), volume, tuple(tables)
    )
    plain = once(guarded([*plain, *volumes.values()]))
    hold_against_model(density, terms, plain, once(guarded(used)), tables)
    return density


def without_volume(density: UnconstrainedDensity) -> UnconstrainedDensity:
    """The same log density by the nodes' own coordinates, still as a function of free numbers.

    Where it is largest is the mode that is meant without mention of any map.

    Raises
    ------
    UnsupportedError
    """
    root = add(density.root, multiply(as_expression(-1.0), density.volume))
    try:
        slopes = stable([gradient(root, [FREE])[FREE]])[0]
    except TraceError as error:
        raise UnsupportedError(str(error)) from error
    return replace(density, root=root, slopes=slopes, volume=ZERO)


# ---- private ------------------------------------------------------------------------------------


def _laid_out(
    target: Target, names: Iterable[str] | None, shares: np.ndarray | None
) -> tuple[FreeNode, ...]:
    """The nodes that move, one after the other."""
    found: list[FreeNode] = []
    wanted = None if names is None else set(names)
    nodes = {n: target.model[n] for n in target.chain}
    if wanted is None:
        wanted = {n for n, node in nodes.items() if not node.is_discrete and node.domain is None}
    for name in nodes:
        if name not in wanted:
            continue
        start = found[-1].start + found[-1].size if found else 0
        node = free_node(target, name, start)
        if shares is not None:
            own = shares[start : start + node.size]
            if (own != 1.0).any():
                node = free_node(target, name, start, own, wanted)
        found.append(node)
    return tuple(found)


def _total(numbers: Sequence[Expression]) -> Expression:
    if len(numbers) > _FEW:
        return reduction(np.add, pick(numbers, np.arange(len(numbers))), [0])
    total: Expression = ZERO
    for number in numbers:
        total = add(total, number)
    return total


def _slopes(
    root: Expression,
    used: Sequence[tuple[Term, Expression]],
    parts: Sequence[Leaf],
    once: Callable[[Sequence[Expression]], list[Expression]],
) -> Expression:
    """The derivatives by all free numbers, one after the other.

    Raises
    ------
    UnsupportedError
    """
    names = [part.name for part in parts]
    try:
        if len(parts) > _FEW:  # what reads many nodes reads one array
            return stable([gradient(once([root])[0], [FREE])[FREE]])[0]
        found = gradient(root, names)
    except TraceError as error:
        for term, log in used:
            try:
                gradient(reduction(np.add, log, [0]), names)
            except TraceError as own:
                kind = "potential" if term.is_potential else "node"
                raise UnsupportedError(f"{kind} {term.name!r}: {own}") from own
        raise UnsupportedError(str(error)) from error
    each = [found.get(p.name, broadcast(ZERO, p.shape)) for p in parts]
    return once([pick(stable(each), np.arange(sum(p.size for p in parts)))])[0]


def _on_one_leaf(
    nodes: Sequence[FreeNode], parts: Mapping[str, Leaf]
) -> Callable[[Sequence[Expression]], list[Expression]]:
    """Puts parts of one array in place of the free numbers of each node."""
    whole = leaf(FREE, (sum(n.size for n in nodes),))
    places = {
        parts[n.name].name: pick([whole], n.start + np.arange(n.size)) for n in nodes if n.size
    }
    return lambda roots: put_in(roots, places)
