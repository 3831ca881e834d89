"""Which continuous nodes of a Gibbs sweep move together along trajectories, and the densities of these."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence

from bayesmc.errors import UnsupportedError
from bayesmc.kernels.base import ANYHOW, How
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.hamiltonian_warmup import fitting
from bayesmc.network import Problem
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.jumps import jumps
from bayesmc.structure.summing import components
from bayesmc.structure.target import Target, target_of
from bayesmc.structure.unconstrained import unconstrained_density

#: numbers of nodes that move jointly, at most
DENSE = 64
#: numbers of like nodes from which on slices move them as one (60 slices of a volatility: 5 times better)
CROWD = 32
#: numbers of one vector, at most
_MOST = 4096


def continuous(target: Target) -> tuple[str, ...]:
    """Nodes of the chain that are numbers with a density."""
    nodes = ((n, target.model[n]) for n in target.chain)
    return tuple(n for n, node in nodes if not node.is_discrete and node.domain is None)


def density_of(
    problem: Problem, names: tuple[str, ...], summed: tuple[str, ...] = ()
) -> UnconstrainedDensity:
    """The density of some nodes given the rest, with some finite nodes summed out, made once.

    Raises
    ------
    UnsupportedError
        It cannot be followed, or has no derivative; or too many states would have to be summed over.
    """
    found = problem.cache.setdefault("densities of free numbers", {})
    if (names, summed) not in found:
        try:
            found[names, summed] = unconstrained_density(target_of(problem), names, summed)
        except UnsupportedError as error:
            found[names, summed] = str(error)
    if isinstance(found[names, summed], str):
        raise UnsupportedError(found[names, summed])
    return found[names, summed]


def summed_with(problem: Problem, moving: tuple[str, ...]) -> tuple[str, ...]:
    """Finite nodes of the chain that can be summed out of the density of nodes that move.

    What hangs together is summed out together or not at all.
    """
    target = target_of(problem)
    finite = [n for n in target.chain if n not in moving and target.model[n].domain is not None]
    found: list[str] = []
    for group in components(target, finite):
        try:
            density_of(problem, moving, tuple(group))
        except UnsupportedError:
            continue
        found += group
    return tuple(n for n in target.chain if n in found)


def jumping(problem: Problem, density: UnconstrainedDensity) -> frozenset[str]:
    """Nodes at some values of which the density jumps, looked for once: slices move them."""
    found = problem.cache.setdefault("jumps", {})
    if density.names not in found:
        found[density.names] = jumps(density)
    return found[density.names]


def trajectories_of(
    problem: Problem,
    names: Iterable[str],
    closed: Collection[str] = (),
    alone: Collection[str] = (),
    keys: Mapping[str, Hashable] | None = None,
    debug: bool = False,
    how: How = ANYHOW,
) -> list[Hamiltonian]:
    """Kernels of nodes without a closed form that move better together than one at a time.

    That is so up to `DENSE` numbers that share terms; plates join each other where their elements do so among
    themselves, too. Of more that share terms, the larger
    nodes are left to slices, which move all elements of a plate at once; vectors, which slices move number
    by number, are not. Many like nodes (slices of a template) count as one plate, and keep what shares terms
    with them. A node whose own density is another for each state of a hidden finite one is left out: no one
    length of a step suits them all.

    Parameters
    ----------
    names : iterable of str
        Nodes without a closed form.
    closed : collection of str
        Nodes with one, each by itself: they join what shares terms with them, since given each other they may
        hardly move.
    alone : collection of str
        Nodes that others move in their own way.
    keys : mapping, optional
        What is equal for like nodes, which slices move as one (``structure.stacked.Forms.key``).
    debug : bool
        Compare machine code with NumPy at every step.
    how : How
        Whether trajectories are machine code.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.mcmc.jointly import trajectories_of
    >>> from bayesmc.network import pose
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Laplace(0.0, 1.0))
    >>> net.add("b", bmc.Laplace(0.0, 1.0))
    >>> net.add("y", lambda a, b: bmc.Normal(a * b, 1.0))
    >>> [kernel.names for kernel in trajectories_of(pose(net, {"y": 1.0}), ["a", "b"])]
    [('a', 'b')]
    """
    target = target_of(problem)
    kernels = []
    fit = [n for n in _few(target, names, keys or {}) if n not in alone]
    for group in _groups(target, [n for n in fit if not _is_switched(target, n)]):
        joined = _joined(target, group, [n for n in closed if n not in alone])
        density = _smooth(problem, joined) or _smooth(problem, group)
        if density is not None:
            metric = fitting("auto", density.size)
            match = f"{density.size} free numbers jointly, {metric} metric"
            kernels.append(
                Hamiltonian(
                    density,
                    density.others,
                    metric=metric,
                    match=match,
                    threads=how.threads,
                    compiled=how.compiled,
                    debug=debug,
                )
            )
    return kernels


# ---- private ------------------------------------------------------------------------------------


def _smooth(problem: Problem, names: tuple[str, ...]) -> UnconstrainedDensity | None:
    """The density of those of some nodes at no values of which it jumps; None where these are too few."""
    density = _density_or_none(problem, names)
    bent = frozenset() if density is None else jumping(problem, density)
    if not bent:
        return density
    left = tuple(n for n in names if n not in bent)
    return _density_or_none(problem, left) if _size(target_of(problem), left) > 1 else None


def _density_or_none(problem: Problem, names: tuple[str, ...]) -> UnconstrainedDensity | None:
    try:
        return density_of(problem, names)
    except UnsupportedError:
        return None


def _few(target: Target, names: Iterable[str], keys: Mapping[str, Hashable]) -> list[str]:
    """Nodes without those of which there are many alike, and what shares terms with these."""
    names = list(names)
    numbers: Counter[Hashable] = Counter()
    for name, key in keys.items():
        numbers[key] += _size(target, [name])
    many = {
        n
        for n, key in keys.items()
        if key is not None and max(CROWD, _size(target, [n])) < numbers[key]
    }
    near = {id(t) for t in target.terms_of(many)} if many else set()
    return [n for n in names if not any(id(t) in near for t in target.terms_of((n,)))]


def _is_switched(target: Target, name: str) -> bool:
    """Whether hidden finite nodes enter its own density."""
    own = target.terms.get(name)
    above = () if own is None else target.hidden_above(own)
    return any(target.model[n].domain is not None for n in above)


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
        if _size(target, [name]) > DENSE:
            if not model[name].plates and _size(target, [name]) <= _MOST:
                groups.append([name])
            continue
        mine = {id(t) for t in target.terms_of((name,))}
        merged = [name]
        for group in list(groups):
            meets = any(id(t) in mine for other in group for t in target.terms_of((other,)))
            if meets and _size(target, [*group, *merged]) <= DENSE:
                merged = [*group, *merged]
                groups.remove(group)
        if len(merged) > 1 or not model[name].plates or _is_coupled(target, name):
            groups.append(merged)
    # the elements of one plate by themselves are moved at once by slices
    several = [g for g in groups if len(g) > 1 or not model[g[0]].plates]
    return [tuple(n for n in target.chain if n in g) for g in several if _size(target, g) > 1]


def _is_coupled(target: Target, name: str) -> bool:
    """Whether terms read several elements of a plate at once, as those of a mixture do of its components.

    Elements that meet in no term are slices' affair: trajectories of all would take the shortest step of any.
    """
    return len(Blanket(target, name).classes) > 1


def _joined(target: Target, group: tuple[str, ...], closed: Sequence[str]) -> tuple[str, ...]:
    """A group with those that have a closed form given it, and share its terms, while all are few."""
    found = set(group)
    terms = {id(t) for t in target.terms_of(group)}
    for name in sorted(closed, key=lambda n: _size(target, [n])):
        if _size(target, [*found, name]) <= DENSE:
            if any(id(t) in terms for t in target.terms_of((name,))):
                found.add(name)
    return tuple(n for n in target.chain if n in found)


def _size(target: Target, names: Iterable[str]) -> int:
    return sum(math.prod(target.model[n].value_shape) for n in names)
