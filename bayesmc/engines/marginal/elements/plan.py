"""Whether the elements of a plate are independent given what is sampled, and what a slice reads of them.

Every number that is integrated out and handed on lives in the same plates, and its density reads its own
element of the slice before and of this one. Whatever is measured reads one element each, its own or one that
is picked by what is known or sampled: proven on the expression of the density, or not claimed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.distributions import MvNormal, Normal
from bayesmc.engines.kalman.slices import Layout, always_unknown
from bayesmc.engines.marginal.elements.looks import PickedLook
from bayesmc.errors import TraceError
from bayesmc.expression import Constant, Expression, Family, Leaf
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.model import Model
from bayesmc.structure.picked import picked_element


@dataclass(frozen=True, eq=False)
class Group:
    """Readings whose elements pick the same elements: they are taken in together.

    Attributes
    ----------
    looks : tuple of PickedLook
    at : Expression
    bent : bool
        Whether any of their means must be made linear.
    picker : str or None
        A finite node, sampled, of the same plates, that nothing else reads but what picks by it: it is drawn
        given the reading.
    """

    looks: tuple[PickedLook, ...]
    at: Expression
    bent: bool
    picker: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(look.node.name for look in self.looks)

    @property
    def leaves(self) -> frozenset[str]:
        """Known values that they depend on."""
        return frozenset().union(*(look.leaves for look in self.looks))

    @property
    def count(self) -> int:
        return self.looks[0].count


@dataclass(frozen=True, eq=False)
class ElementPlan:
    """What is integrated out element by element.

    Attributes
    ----------
    states : tuple of str
        Nodes of the plates.
    plates : tuple of str
        Those whose elements are apart from each other, ``lead`` those and the ones filtered separately.
    groups : tuple of tuple of Group
        Of slice 0 and of later ones.
    still : bool
        Whether elements stay what they are from slice to slice.
    below : frozenset of str
        Computed nodes that wait for pickers.
    """

    states: tuple[str, ...]
    plates: tuple[str, ...]
    lead: tuple[str, ...]
    groups: tuple[tuple[Group, ...], tuple[Group, ...]]
    still: bool
    below: frozenset[str]

    @property
    def readings(self) -> frozenset[str]:
        return frozenset(n for groups in self.groups for g in groups for n in g.names)

    @property
    def pickers(self) -> frozenset[str]:
        """Finite nodes that are drawn given what they pick."""
        return frozenset(g.picker for groups in self.groups for g in groups if g.picker is not None)

    @property
    def is_picked(self) -> bool:
        """Whether any reading picks, beyond its own element."""
        return any(
            not _is_own(g, look) for groups in self.groups for g in groups for look in g.looks
        )

    @property
    def late(self) -> frozenset[str]:
        """Nodes that steps of a slice leave out."""
        return frozenset(self.states) | self.readings | self.pickers | self.below


def element_plan(
    slices: Slices,
    inner: Collection[str],
    seen: Collection[str],
    bent: Collection[str],
    apart: tuple[str, ...],
    guided: Collection[str] = (),
) -> ElementPlan | None:
    """The plan, or None where elements are not proven to be independent.

    Parameters
    ----------
    inner : collection of str
        Nodes that are integrated out.
    seen : collection of str
        Nodes that are seen in full in every slice.
    bent : collection of str
        Nodes that are made linear.
    apart : tuple of str
        Plates that are filtered separately.
    guided : collection of str
        Nodes that have proposals of their own: no picker.
    """
    layouts = _layouts(slices, inner)
    placed = {n for layout in layouts for n in (*layout.placed, *layout.silent)}
    if any(not slices.first[n].is_stochastic for n in placed):
        return None
    read = {p.removesuffix(PREVIOUS) for m in (slices.first, slices.later) for n in slices.dynamic
            for p in m[n].parents}  # fmt: skip
    states = tuple(n for n in slices.dynamic if n in placed and n in inner and n in read)
    readings = placed - set(states)
    if not states:
        return None
    lead = slices.first[states[0]].plates
    plates = tuple(p for p in lead if p not in apart)
    if not plates or any(slices.first[n].plates != lead for n in states):
        return None
    if bent and set(bent) & set(states):
        return None
    if not all(_reads_own(layout, states) for layout in layouts):
        return None
    ranges = _ranges(slices, states)
    groups = []
    for layout in layouts:
        found = _groups(layout, states, ranges, readings, bent, apart)
        if found is None:
            return None
        groups.append(found)
    picking = _with_pickers(slices, groups, seen, states, guided)
    below = _below(slices, picking)
    still = _is_still(layouts[1], states)
    return ElementPlan(states, plates, lead, (picking[0], picking[1]), still, below)


# ---- private ------------------------------------------------------------------------------------


def _layouts(slices: Slices, inner: Collection[str]) -> list[Layout]:
    """Slice 0 and later ones, of all that is integrated out in any slice."""
    known = frozenset(slices.stochastic) - frozenset(inner)
    unknown = always_unknown(slices, known)
    before = tuple(n for n in slices.interface if n in unknown)
    return [Layout(slices, (), k == 0, before, unknown) for k in range(2)]


def _is_own(group: Group, look: PickedLook) -> bool:
    """Whether each element of a reading reads the element with its own number."""
    value = getattr(look.at, "value", None)
    return value is not None and np.array_equal(np.ravel(value), np.arange(look.count))


def _ranges(slices: Slices, states: tuple[str, ...]) -> dict[str, slice]:
    """Where numbers of nodes stand among those of an element, as layouts have them."""
    order = (
        *(n for n in slices.interface if n in states),
        *(n for n in states if n not in slices.interface),
    )
    found, low = {}, 0
    for name in order:
        size = math.prod(slices.first[name].event_shape)
        found[name] = slice(low, low + size)
        low += size
    return found


def _reads_own(layout: Layout, states: tuple[str, ...]) -> bool:
    """Whether nodes of the plates read their own elements alone."""
    hidden = layout.unknown | {n + PREVIOUS for n in layout.before}
    for name in states:
        for parent, link in layout.model[name].links:
            if parent in hidden and (link.foreign or parent.removesuffix(PREVIOUS) not in states):
                return False
    return True


def _cut(model: Model) -> list[str]:
    """Computed nodes of the slice before, whose values are given."""
    return [n for n in model.nodes if n.endswith(PREVIOUS) and not model[n].is_stochastic]


def _groups(
    layout: Layout,
    states: tuple[str, ...],
    ranges: Mapping[str, slice],
    readings: Collection[str],
    bent: Collection[str],
    apart: tuple[str, ...],
) -> tuple[Group, ...] | None:
    """Readings by what they pick; None where it is not proven."""
    model = layout.model
    before = {n + PREVIOUS for n in layout.before}
    cut = _cut(model)
    found: dict[tuple[Expression, tuple[str, ...]], list[PickedLook]] = {}
    for name in (n for n in layout.order if n in readings):
        node = model[name]
        if node.domain is not None or node.is_discrete or len(node.event_shape) > 1:
            return None
        for parent, link in node.links:
            if parent in states and any(p in apart for p in link.foreign):
                return None
        if any(p not in node.plates for p in apart):
            return None
        try:
            look = PickedLook(model, name, ranges, cut)
        except TraceError:
            return None
        if look.leaves & (before | set(readings)):
            return None
        key = (look.at, node.plates if look.count > 1 else ())
        found.setdefault(key, []).append(look)
    made = []
    for (at, _), looks in found.items():
        if len({look.count for look in looks}) > 1:
            return None
        names = [look.node.name for look in looks]
        made.append(Group(tuple(looks), at, bool(set(names) & set(bent))))
    return tuple(made)


def _with_pickers(
    slices: Slices,
    groups: list[tuple[Group, ...]],
    seen: Collection[str],
    states: tuple[str, ...],
    guided: Collection[str],
) -> list[tuple[Group, ...]]:
    """The same with the finite nodes that are drawn given what they pick."""
    found = []
    for model, own in zip((slices.first, slices.later), groups, strict=True):
        made = []
        for group in own:
            names = [n for n in sorted(group.leaves) if _may_pick(slices, model, n, seen, guided)]
            fits = [n for n in names if _picks_alone(slices, model, n, group, own)]
            picker = fits[0] if len(fits) == 1 else None
            made.append(Group(group.looks, group.at, group.bent, picker))
        found.append(tuple(made))
    first, later = ({g.picker for g in own if g.picker} for own in found)
    if first != later:  # drawn in one way throughout
        return list(groups)
    return found


def _may_pick(
    slices: Slices, model: Model, name: str, seen: Collection[str], guided: Collection[str]
) -> bool:
    return (
        name in slices.stochastic
        and name not in seen
        and name not in guided
        and model[name].domain is not None
        and not model[name].event_shape
    )


def _picks_alone(
    slices: Slices, model: Model, name: str, group: Group, groups: tuple[Group, ...]
) -> bool:
    """Whether each element of a finite node decides on one reading, and on no other density of the slice."""
    node, reading = model[name], group.looks[0].node
    if any(name in g.leaves for g in groups if g is not group):
        return False
    if node.plates != reading.plates and not (not node.plates and group.count == 1):
        return False
    if any(look.node.plates != reading.plates for look in group.looks):
        return False
    below = descendants(slices, model, {name})
    for other in slices.dynamic:
        if other in below and model[other].is_stochastic and other not in group.names:
            return False
    cut = _cut(model)
    looks = [look for look in group.looks if name in look.leaves]
    own = (picked_element(model, look.node.name, [name], cut) for look in looks)
    every = np.arange(math.prod(node.plate_shape))
    return all(np.array_equal(np.ravel(getattr(at, "value", -1)), every) for at in own)


def descendants(slices: Slices, model: Model, names: Collection[str]) -> set[str]:
    """Nodes of the slice that depend on some."""
    found = set(names)
    for name in model.nodes:
        if name in slices.dynamic and any(p in found for p in model[name].parents):
            found.add(name)
    return found - set(names)


def _below(slices: Slices, groups: list[tuple[Group, ...]]) -> frozenset[str]:
    """Computed nodes that depend on pickers, in the same slice."""
    found: set[str] = set()
    for model, own in zip((slices.first, slices.later), groups, strict=True):
        pickers = {g.picker for g in own if g.picker is not None}
        below = descendants(slices, model, pickers)
        found |= {n for n in below if not model[n].is_stochastic}
    return frozenset(found)


def _is_still(layout: Layout, states: tuple[str, ...]) -> bool:
    """Whether a later slice's elements are those of the slice before, as their functions say it."""
    return all(_is_carried_on(layout.model, name) for name in states)


def _is_carried_on(model: Model, name: str) -> bool:
    """Whether a node is normal about its own value before, without noise."""
    read = density(model, name)
    if isinstance(read, Opaque) or not isinstance(read.result, Family):
        return False
    if read.result.make not in (Normal, MvNormal):
        return False
    parameters = dict(read.result.parameters)
    loc = parameters.pop("loc", None)
    if not isinstance(loc, Leaf) or loc.name != name + PREVIOUS:
        return False
    scales = [v.value if isinstance(v, Constant) else v for v in parameters.values()]
    scales = [v for v in scales if v is not None]
    if not scales or any(isinstance(v, Expression) for v in scales):
        return False
    return not any(np.any(v) for v in scales)
