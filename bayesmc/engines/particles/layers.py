"""What of a slice enters those after it: factors, computed nodes that carry values on, and bounds of factors.

It is what drawing backwards needs to know of a template.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.distributions import Cauchy, Laplace, MvNormal, Normal, StudentT
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.network.forward import Compute, Step, WeighDrawn

#: families that are highest at ``loc``; a family derived from one of them need not be
LOCATION = (Normal, MvNormal, StudentT, Laplace, Cauchy)


class Layer(NamedTuple):
    """What a slice does to one some slices later: factors that it enters, and what is computed on the way."""

    steps: Sequence[Step]
    computed: Sequence[Step]
    #: nodes whose factors the slice enters
    crossing: frozenset[str]
    #: computed nodes that take something of it on to the next
    carried: frozenset[str]


def endless(slices: Slices, seen: Collection[str] = ()) -> tuple[str, ...]:
    """Computed nodes through which a value enters all later slices, such as running sums.

    Trajectories are not put together backwards through them: each particle would be held against all that
    follows. Lags and chains of them forget; what is computed of nodes ``seen`` in full is the same for all.
    """
    found = set(_entering(slices, seen))
    while True:
        further = _carried(slices, {n + PREVIOUS for n in found})
        if further == found or not further:
            return tuple(n for n in slices.dynamic if n in further)
        found = further


def carried_on(slices: Slices, seen: Collection[str] = ()) -> set[str]:
    """Computed nodes of a slice through which values of the slice before enter the next."""
    return _carried(slices, {n + PREVIOUS for n in _entering(slices, seen)})


def layers_of(plan: SlicePlan, seen: Collection[str]) -> list[Layer]:
    """What slices do to those after them, as far as values are carried on."""
    model, slices = plan.slices.later, plan.slices
    found: list[Layer] = []
    entering = _entering(slices, seen)
    while entering and (not found or len(found) <= len(slices.interface)):
        reached = {n + PREVIOUS for n in entering}
        steps: list[Step] = []
        crossing = set()
        for name in slices.dynamic:
            node = model[name]
            if not reached & set(node.parents):
                continue
            if node.is_stochastic:
                steps.append(WeighDrawn(model, node, plan.apart))
                crossing.add(name)
            else:
                steps.append(Compute(model, node))
                reached.add(name)
        entering = {n for n in reached if n in slices.interface}
        computed = [step for step in steps if isinstance(step, Compute)]
        found.append(Layer(steps, computed, frozenset(crossing), frozenset(entering)))
    return found or [Layer([], [], frozenset(), frozenset())]


def is_bounded(plan: SlicePlan, crossing: frozenset[str]) -> bool:
    """Whether every factor is a probability, or as high as its particle alone says."""
    model, slices = plan.slices.later, plan.slices
    own = set(slices.dynamic)
    for name in crossing:
        node = model[name]
        if node.domain is not None:
            continue
        if own & set(node.parents):
            return False
        dist, _ = model.evaluate(name, {**model.probe, **plan.static})
        if type(dist) not in LOCATION:
            return False
    return True


# ---- private ------------------------------------------------------------------------------------


def _entering(slices: Slices, seen: Collection[str]) -> set[str]:
    """Nodes that the next slice reads and that particles may differ in."""
    varying = {n for n in slices.stochastic if n not in seen}
    before = -1
    while len(varying) > before:
        before = len(varying)
        for name in slices.dynamic:
            read = {p.removesuffix(PREVIOUS) for p in slices.later[name].parents}
            if not slices.later[name].is_stochastic and varying & read:
                varying.add(name)
            elif not slices.first[name].is_stochastic and varying & set(slices.first[name].parents):
                varying.add(name)
    return varying & set(slices.interface)


def _carried(slices: Slices, entering: set[str]) -> set[str]:
    """Computed nodes that take what enters a slice on to the next."""
    reached = set(entering)
    for name in slices.dynamic:
        node = slices.later[name]
        if not node.is_stochastic and reached & set(node.parents):
            reached.add(name)
    return {n for n in reached if n in slices.interface}
