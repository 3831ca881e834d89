"""The proposal that looks at the row, derived from the declared densities: ``proposal="optimal"``.

For every particle the hidden numbers of a slice are taken as jointly Gaussian given the slice before, and
what was seen as Gaussian given them (``lookahead``). Where transitions are Normal and means of what is seen
are affine this is exactly p(x_t | x_{t-1}, y_t), the proposal of least variance; elsewhere weights p/q make
up for the difference.

A slice is cut into *groups*: a hidden node that is no Gaussian (a finite one, say) and depends on numbers of
a group is drawn once these are, and what depends on it makes the next group. Numbers that nothing seen
depends on within their group are drawn from their own densities.

References
----------
Doucet, Godsill and Andrieu (2000), On sequential Monte Carlo sampling methods for Bayesian filtering,
Statistics and Computing 10, sec. II-D; van der Merwe et al. (2000), The unscented particle filter.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import Row, Slices
from bayesmc.distributions import Distribution, MvNormal, Normal
from bayesmc.engines.particles.lookahead import Guarded, LookAhead
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.forward import Step
from bayesmc.structure.affine import why_not_linear

#: states of a finite node that a mean and a variance describe
_TWO = 2


class OptimalPlan(SlicePlan):
    """Steps of slices whose hidden numbers are drawn with a look at the row."""

    def _build(self, row: Row) -> list[Step]:
        model = self.slices.model(row.t)
        order = order_of(model, self.slices)
        groups = groups_of(model, order, row.seen, lambda name: has_moments(model, name))
        if not any(group.block for group in groups):
            return super()._build(row)
        steps: list[Step] = []
        for group in groups:
            steps += [self.step(row, n) for n in group.before]
            if group.block:
                steps += self._looking(row, group, order)
            steps += [self.step(row, n) for n in group.after if n not in group.block]
        return steps

    def _looking(self, row: Row, group: Group, order: Sequence[str]) -> list[Step]:
        """Draw a block, and weigh it by p/q."""
        model = self.slices.model(row.t)
        seen = {n: row.seen[n].mask for n in group.seen}
        affine = is_affine(model, group)
        look = LookAhead(model, group.block, seen, order, self.apart, affine)
        between = {n for name in group.block for n in look.between[name]}
        inside = [n for n in order if n in between or n in group.block]
        own = [self.step(row, n) for n in inside]
        factors = [
            step if n in between else self.factor(row, n)
            for n, step in zip(inside, own, strict=True)
        ]
        return [look, *factors] if affine else [Guarded(look, own, factors)]


class Group(NamedTuple):
    """A part of a slice in which hidden numbers are looked at together.

    Attributes
    ----------
    before : tuple of str
        Nodes that do not depend on numbers of the group, in the order in which steps are taken.
    block : tuple of str
        Hidden numbers that something seen depends on.
    seen : tuple of str
        What is looked at.
    after : tuple of str
        All others of the group, the block included.
    """

    before: tuple[str, ...]
    block: tuple[str, ...]
    seen: tuple[str, ...]
    after: tuple[str, ...]


def groups_of(
    model: Model,
    order: Sequence[str],
    seen: Mapping[str, Observed],
    looks: Callable[[str], bool],
) -> list[Group]:
    """A slice cut into groups, whose steps in turn respect the net's order.

    Parameters
    ----------
    order : sequence of str
        Nodes of the slice, parents first.
    looks : callable
        Whether a seen node has moments to look at.
    """
    at: dict[str, int] = {}  # the group in which a step is taken
    below: dict[str, bool] = {}  # whether it depends on numbers of its group
    looked: dict[str, int] = {}
    for name in order:
        above = [p for p in model[name].parents if p in at and not _in_full(seen, p)]
        group = max((at[p] for p in above), default=0)
        hot = any(at[p] == group and (below[p] or _is_number(model, p, seen)) for p in above)
        if hot and name in seen and looks(name):
            looked[name] = group
        known = not model[name].is_stochastic or _in_full(seen, name)
        if hot and not known and not _is_number(model, name, seen):
            group, hot = group + 1, False
        at[name], below[name] = group, hot
    needed: dict[str, set[int]] = {name: {group} for name, group in looked.items()}
    for name in reversed(order):
        if name in looked or (name in needed and not _in_full(seen, name)):
            for parent in model[name].parents:
                if parent in at and at[parent] in needed[name] and not _in_full(seen, parent):
                    if _is_number(model, parent, seen) or below[parent]:
                        needed.setdefault(parent, set()).add(at[parent])
    groups = []
    for k in range(1 + max(at.values(), default=0)):
        own = [n for n in order if at[n] == k]
        numbers = {n for n in own if _is_number(model, n, seen)}
        groups.append(
            Group(
                tuple(n for n in own if not below[n] and n not in numbers),
                tuple(n for n in own if n in numbers and n in needed),
                tuple(n for n in order if looked.get(n) == k),
                tuple(n for n in own if below[n] or n in numbers),
            )
        )
    return groups


def order_of(model: Model, slices: Slices) -> list[str]:
    """Nodes of a slice, parents first; slice 0 may have its own order."""
    return [n for n in model.nodes if n in slices.dynamic]


def has_moments(model: Model, name: str) -> bool:
    """Whether a node has a mean and a variance that say where its value is."""

    def find() -> bool:
        node = model[name]
        if node.domain is not None and node.domain.size > _TWO:
            return False
        try:
            dist, _ = model.evaluate(name, model.probe)
            spread = dist.cov if node.event_shape else dist.var
            return bool(np.isfinite(np.asarray(dist.mean)).all() and np.isfinite(spread).all())
        except (BayesmcError, AttributeError, NotImplementedError):
            return False

    return _once(model, ("moments", name), find)


def family_of(model: Model, name: str) -> type[Distribution]:
    """The family that a node's function returns."""
    return _once(model, ("family", name), lambda: type(model.evaluate(name, model.probe)[0]))


def is_affine(model: Model, group: Group) -> bool:
    """Whether a group is proved linear-Gaussian in its block, all else being known."""
    return _once(model, (group.block, group.seen), lambda: _prove_affine(model, group))


def why_not_optimal(slices: Slices, observed: Collection[str]) -> str | None:
    """Why no such proposal can be derived, or None."""
    for model in (slices.first, slices.later):
        informed: set[str] = set()
        for name in reversed(order_of(model, slices)):
            node = model[name]
            if name in observed or name in informed:
                informed |= set(node.parents)
            hidden = node.is_stochastic and not node.is_discrete and name not in observed
            if not hidden or name not in informed or _is_gaussian(model, name):
                continue
            family = family_of(model, name).__name__
            return (
                f'ParticleFilter(proposal="optimal"): {name!r} is {family}, and such a '
                "proposal is derived for Normal and MvNormal nodes only; give proposal={...} yourself"
            )
    return None


# ---- private ------------------------------------------------------------------------------------


def _is_gaussian(model: Model, name: str) -> bool:
    return issubclass(family_of(model, name), (Normal, MvNormal))


def _is_number(model: Model, name: str, seen: Mapping[str, Observed]) -> bool:
    """Whether a node is a hidden number that a block may hold."""
    node: CompiledNode = model[name]
    if name in seen or not node.is_stochastic or node.is_discrete or node.domain is not None:
        return False
    return _is_gaussian(model, name)


def _in_full(seen: Mapping[str, Observed], name: str) -> bool:
    return name in seen and seen[name].mask is None


def _prove_affine(model: Model, group: Group) -> bool:
    inner = {*group.block, *group.seen}
    nodes: dict[str, CompiledNode] = {}
    todo = list(inner)
    while todo:
        name = todo.pop()
        node = model[name]
        if name in nodes:
            continue
        if node.is_stochastic and name not in inner:  # known here, whatever its density is
            nodes[name] = replace(node, links=(), declaration=replace(node.declaration, parents=()))
            continue
        nodes[name] = node
        todo += node.parents
    ordered = {n: nodes[n] for n in model.nodes if n in nodes}
    known = {
        n: Observed(np.asarray(model.probe[n]))
        for n, node in ordered.items()
        if node.is_stochastic and n not in group.block
    }
    inputs = {n: model.probe[n] for n in ordered if model[n].kind in ("input", "fixed")}
    part = replace(model, nodes=ordered, potentials={}, cache={})
    return why_not_linear(part, known, inputs) is None


def _once(model: Model, key: Any, find: Callable[[], Any]) -> Any:
    """What was found of a model before, or is found now: rows with gaps have their steps built anew."""
    kept = model.cache.setdefault("looking ahead", {})
    if key not in kept:
        kept[key] = find()
    return kept[key]
