"""Which continuous nodes of a Gibbs sweep move together along trajectories, and the densities of these."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

from bayesmc.errors import UnsupportedError
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.hamiltonian_warmup import Metric
from bayesmc.network import Problem
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.target import Target, target_of
from bayesmc.structure.unconstrained import unconstrained_density

#: numbers up to which their covariance is learnt, and not their scales alone
_DENSE = 64
#: numbers of one vector, at most
_MOST = 4096


def continuous(target: Target) -> tuple[str, ...]:
    """Nodes of the chain that are numbers with a density."""
    nodes = ((n, target.model[n]) for n in target.chain)
    return tuple(n for n, node in nodes if not node.is_discrete and node.domain is None)


def density_of(problem: Problem, names: tuple[str, ...]) -> UnconstrainedDensity:
    """The density of some nodes given the rest, made once.

    Raises
    ------
    UnsupportedError
        It cannot be followed, or has no derivative.
    """
    found = problem.cache.setdefault("densities of free numbers", {})
    if names not in found:
        try:
            found[names] = unconstrained_density(target_of(problem), names)
        except UnsupportedError as error:
            found[names] = str(error)
    if isinstance(found[names], str):
        raise UnsupportedError(found[names])
    return found[names]


def trajectories_of(
    problem: Problem,
    names: Iterable[str],
    closed: Collection[str] = (),
    alone: Collection[str] = (),
) -> list[Hamiltonian]:
    """Kernels of nodes without a closed form that move better together than one at a time.

    That is so up to so many numbers that their covariance is learnt. Of more that share terms, the larger
    nodes are left to slices, which move all elements of a plate at once; vectors, which slices move number
    by number, are not.

    Parameters
    ----------
    names : iterable of str
        Nodes without a closed form.
    closed : collection of str
        Nodes with one, each by itself: they join what shares terms with them, since given each other they may
        hardly move.
    alone : collection of str
        Nodes that others move in their own way.
    """
    target = target_of(problem)
    kernels = []
    for group in _groups(target, [n for n in names if n not in alone]):
        joined = _joined(target, group, [n for n in closed if n not in alone])
        density = _density_or_none(problem, joined) or _density_or_none(problem, group)
        if density is not None:
            metric: Metric = "dense" if density.size <= _DENSE else "diagonal"
            match = f"{density.size} free numbers jointly, {metric} metric"
            kernels.append(Hamiltonian(density, density.others, metric=metric, match=match))
    return kernels


# ---- private ------------------------------------------------------------------------------------


def _density_or_none(problem: Problem, names: tuple[str, ...]) -> UnconstrainedDensity | None:
    try:
        return density_of(problem, names)
    except UnsupportedError:
        return None


def _groups(target: Target, names: Sequence[str]) -> list[tuple[str, ...]]:
    """Groups of nodes that share terms, of two numbers or more, small nodes first."""
    model = target.model
    fit = [
        n
        for n in names
        if n in target.terms and model[n].angles is None and not model[n].is_discrete
    ]
    groups: list[list[str]] = []
    for name in sorted(fit, key=lambda n: _size(target, [n])):
        if _size(target, [name]) > _DENSE:
            if not model[name].plates and _size(target, [name]) <= _MOST:
                groups.append([name])
            continue
        mine = {id(t) for t in target.terms_of((name,))}
        merged = [name]
        for group in list(groups):
            meets = any(id(t) in mine for other in group for t in target.terms_of((other,)))
            if meets and _size(target, [*group, *merged]) <= _DENSE:
                merged = [*group, *merged]
                groups.remove(group)
        if len(merged) > 1 or not model[name].plates:
            groups.append(merged)
    return [
        tuple(n for n in target.chain if n in group) for group in groups if _size(target, group) > 1
    ]


def _joined(target: Target, group: tuple[str, ...], closed: Sequence[str]) -> tuple[str, ...]:
    """A group with those that have a closed form given it, and share its terms, while all are few."""
    found = set(group)
    terms = {id(t) for t in target.terms_of(group)}
    for name in sorted(closed, key=lambda n: _size(target, [n])):
        if _size(target, [*found, name]) <= _DENSE:
            if any(id(t) in terms for t in target.terms_of((name,))):
                found.add(name)
    return tuple(n for n in target.chain if n in found)


def _size(target: Target, names: Iterable[str]) -> int:
    return sum(math.prod(target.model[n].value_shape) for n in names)
