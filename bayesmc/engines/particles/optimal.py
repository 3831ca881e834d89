"""The proposal that looks at the row, derived from the declared densities: ``proposal="optimal"``.

For every particle the hidden numbers of a slice are taken as jointly Gaussian given the slice before, and
what was seen as Gaussian given them (``linearisation``), or by the curvature of its log density
(``laplace``); mixtures of Gaussians by their components (``mixtures``). Where transitions are Normal and
means of what is seen are affine this is exactly p(x_t | x_{t-1}, y_t), the proposal of least variance;
elsewhere weights p/q make up for the difference.

A slice is cut into *groups*: a hidden node that is no number (a finite one, say) and depends on numbers of
a group is drawn once these are, and what depends on it makes the next group. Numbers that nothing seen
depends on within their group are drawn from their own densities. What became of each node is told by
``guidance``.

References
----------
Doucet, Godsill and Andrieu (2000), On sequential Monte Carlo sampling methods for Bayesian filtering,
Statistics and Computing 10, sec. II-D; van der Merwe et al. (2000), The unscented particle filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import Row, Slices
from bayesmc.engines.particles.looking import (
    NUMBERS,
    mask_of,
    once,
    why_not_drawn,
    why_not_looked_at,
)
from bayesmc.engines.particles.mixtures import look_ahead
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.network import Model, Observed
from bayesmc.network.forward import Pass, Step, run
from bayesmc.structure.affine import NotLinearError, linear_node

#: share of the particles that a guarded block draws from its own densities
SHARE = 0.1


class OptimalPlan(SlicePlan):
    """Steps of slices whose hidden numbers are drawn with a look at the row."""

    guided = True

    def _build(self, row: Row) -> list[Step]:
        model = self.slices.model(row.t)
        order = order_of(model, self.slices)
        groups = groups_of(model, order, row.seen, lambda n: why_not_looked_at(model, n) is None)
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
        seen = {n: mask_of(row.seen[n]) for n in group.seen}
        affine = is_affine(model, group)
        look = look_ahead(model, group.block, seen, order, self.apart, affine)
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
        Whether a seen node tells anything.
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


def is_affine(model: Model, group: Group) -> bool:
    """Whether a group is proved linear-Gaussian in its block, all else being known."""
    return once(model, (group.block, group.seen), lambda: _prove_affine(model, group))


class Guidance(NamedTuple):
    """What the row does for the nodes of a slice.

    Attributes
    ----------
    guided : dict
        Hidden node -> seen nodes with a look at which it is drawn.
    unguided : dict
        Hidden node that something seen depends on -> why it is drawn from its own density all the same.
    unheard : dict
        Seen node that depends on hidden ones -> why it guides none.
    finite : frozenset of str
        Hidden nodes without a number to guide.
    """

    guided: dict[str, tuple[str, ...]]
    unguided: dict[str, str]
    unheard: dict[str, str]
    finite: frozenset[str]

    def missing(self) -> str | None:
        """What one would expect to be guided and is not, or None; finite nodes beside guided ones may be."""
        if not self.unguided and not self.unheard:
            return None
        told = {n: why for n, why in self.unguided.items() if n not in self.finite}
        told |= {n: why for n, why in self.unheard.items() if why != _NO_NUMBER}
        if not self.guided:
            told = {**self.unguided, **told}
        return "; ".join(f"{n!r}: {why}" for n, why in told.items()) or None


def guidance(
    slices: Slices, observed: Collection[str], apart: tuple[str, ...], t: int = 1
) -> Guidance:
    """What a row with these nodes seen does for each node of slice ``t``.

    Parameters
    ----------
    observed : collection of str
    apart : tuple of str
        Plates that are filtered separately.
    t : int
        0 for the first slice; all others are alike.
    """
    model = slices.model(t)
    order = order_of(model, slices)
    seen = {n: Observed(np.asarray(model.probe[n])) for n in order if n in observed}
    groups = groups_of(model, order, seen, lambda n: why_not_looked_at(model, n) is None)
    below, informed = _reach(model, order, seen)
    heard: dict[str, list[str]] = {}
    for group in (g for g in groups if g.block):
        look = look_ahead(model, group.block, dict.fromkeys(group.seen), order, apart)
        for name in group.seen:
            if name not in look.ignored:
                heard[name] = [n for n in group.block if n in below[name]]
    guided = {n: tuple(s for s in seen if n in heard.get(s, ())) for n in order}
    guided = {n: by for n, by in guided.items() if by}
    hidden = [n for n in informed if model[n].is_stochastic and n not in guided]
    unguided = {n: why_not_drawn(model, n) or _LATER for n in hidden}
    finite = frozenset(n for n in hidden if model[n].is_discrete or model[n].domain is not None)
    unheard = {}
    for name in (n for n in seen if below[n] and not heard.get(n)):
        numbers = [n for n in below[name] if why_not_drawn(model, n) is None]
        looked = any(name in g.seen for g in groups)
        why = why_not_looked_at(model, name) if numbers else _NO_NUMBER
        unheard[name] = why or (_MANY if looked else _BEHIND)
    return Guidance(guided, unguided, unheard, finite)


class Guarded:
    """Draws a block by looking ahead, a share of the particles from its own densities instead; weighs by p/q.

    A Gaussian can be far too narrow where means are not affine. In the mixture no weight is more than
    1 / ``SHARE`` of what it is when all are drawn from their own densities (Hesterberg 1995, Weighted average
    importance sampling and defensive mixture distributions, Technometrics 37).

    Parameters
    ----------
    look : LookAhead or ByCase
    own : sequence of steps
        Draw the block from its own densities, and compute what lies between.
    factors : sequence of steps
        Compute what lies between, and weigh by the block's own densities.
    """

    def __init__(self, look: Any, own: Sequence[Step], factors: Sequence[Step]) -> None:
        self.look, self.own, self.factors = look, own, factors

    def __call__(self, state: Pass) -> None:
        look = self.look
        belief = look.believed(state)
        shape = belief.log_density.shape
        alive = state.alive.reshape(state.batch + (1,) * len(look.apart))
        dead = np.where(alive, 0.0, -np.inf)  # bad parameters are excused there
        plain = run(self.own, Pass(state.rng, state.batch, dict(state.values), dead))
        look.draw(state, belief)
        valid: dict[str, np.ndarray] = {}
        plainly = state.rng.random(shape) < SHARE
        for name in look.block:
            at = look.along(plainly, look.model[name])
            mixed = np.where(at, plain.values[name], state.values[name])
            mixed.flags.writeable = False
            state.values[name] = mixed
        drawn = run(self.factors, Pass(state.rng, state.batch, dict(state.values), dead))
        log_p = np.broadcast_to(drawn.log_weight, shape)
        lost = log_p == -np.inf
        if lost.any():  # such as below zero: without weight, but what comes later has to stand them
            for name in look.block:
                at = look.along(lost, look.model[name])
                kept = np.where(at, plain.values[name], state.values[name])
                kept.flags.writeable = False
                valid[name] = kept
        log_q = look.log_density(state.values, belief)
        mixture = np.logaddexp(math.log1p(-SHARE) + log_q, math.log(SHARE) + log_p)
        state.weigh(np.where(lost, -np.inf, log_p - mixture))
        state.values.update(valid)


# ---- private ------------------------------------------------------------------------------------

_NO_NUMBER = "it depends on no hidden number"
_BEHIND = "it depends on no number but through nodes that are drawn from their own densities"
_LATER = "what is seen of it hangs on a node between that is drawn after it"
_MANY = f"it depends on more than {NUMBERS} hidden numbers, too many for derivatives of its density"


def _reach(
    model: Model, order: Sequence[str], seen: Mapping[str, Observed]
) -> tuple[dict[str, set[str]], list[str]]:
    """For each node the hidden nodes of its slice that it depends on, and those that any seen one does."""
    below: dict[str, set[str]] = {}
    for name in order:
        below[name] = set()
        for parent in (p for p in model[name].parents if p in below and p not in seen):
            below[name] |= below[parent] | ({parent} if model[parent].is_stochastic else set())
    told = {n for name in seen for n in below[name]}
    return below, [n for n in order if n in told]


def _is_number(model: Model, name: str, seen: Mapping[str, Observed]) -> bool:
    """Whether a node is a hidden number that a block may hold."""
    return name not in seen and model[name].is_stochastic and why_not_drawn(model, name) is None


def _in_full(seen: Mapping[str, Observed], name: str) -> bool:
    return name in seen and seen[name].mask is None


def _prove_affine(model: Model, group: Group) -> bool:
    known = {n: np.asarray(model.probe[n]) for n in model.nodes if n not in group.block}
    known = {n: v for n, v in known.items() if model[n].kind != "deterministic"}
    try:
        for name in (*group.block, *group.seen):
            linear_node(model, name, group.block, frozenset(), known)
    except NotLinearError:
        return False
    return True
