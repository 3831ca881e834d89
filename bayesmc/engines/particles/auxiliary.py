"""What an auxiliary filter does besides moving: it looks ahead.

A *first stage* gives every particle a factor by what the next row would make of it, before it is moved; its
offspring are weighted by the rest.

References
----------
Pitt and Shephard (1999), Filtering via simulation: auxiliary particle filters, JASA 94.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.particles.linearisation import LookAhead
from bayesmc.engines.particles.looking import why_not_looked_at
from bayesmc.engines.particles.mixtures import ByCase, look_ahead
from bayesmc.engines.particles.optimal import groups_of, is_affine, order_of
from bayesmc.engines.slice_steps import SlicePlan, size_of
from bayesmc.errors import ModelError, UnknownNodeError
from bayesmc.network import CompiledNode
from bayesmc.network.calling import Aligner
from bayesmc.network.declaring import unknown
from bayesmc.network.forward import Pass, Step
from bayesmc.network.model import arguments_of
from bayesmc.network.node import bind

#: a first-stage factor is at least this share of the largest (in logs), so that nothing is ruled out
_LEAST = -50.0
#: share of a factor that is the mean over all particles, where it is an estimate
_SHARE = 0.1
#: draws of what can be neither integrated nor summed over
_DRAWS = 8
#: configurations of finite nodes up to which they are summed over
_CASES = 16
#: numbers of the largest node in a block of particles
_BLOCK = 8192


class PluggedIn:
    """The default first stage: the density of the row given the slice before, p(y | x_prev).

    Hidden Normal and MvNormal nodes are integrated out as a Gaussian (``LookAhead``), finite ones outside
    plates are summed over where there are few configurations, and the others are drawn a few times. Where
    nothing is drawn and all means are affine, that is the density itself, which leaves the weights of
    offspring bounded; with ``proposal="optimal"`` they are all equal (the fully adapted filter).

    Elsewhere it is an estimate, which may be far below the density for some particles. It is mixed with its
    mean over the particles, so no factor is less than a tenth of that mean: where weights were even, no
    weight of an offspring is more than ten times what it is without a first stage.

    Parameters
    ----------
    plan : SlicePlan
    particles : int
    """

    def __init__(self, plan: SlicePlan, particles: int) -> None:
        self.plan, self.particles = plan, particles
        self.lead = tuple(plan.slices.first.sizes[p] for p in plan.apart)
        self.block = max(1, _BLOCK // max(size_of(plan.slices), 1))
        self._kept: dict[frozenset[str], _Predictive] = {}

    def __call__(
        self, before: Mapping[str, np.ndarray], row: Row, rng: np.random.Generator
    ) -> np.ndarray:
        predictive = self._predictive(row)
        known = self.plan.known(row)
        log = np.empty((self.particles, *self.lead))
        for low in range(0, self.particles, self.block):
            part = slice(low, min(low + self.block, self.particles))
            values = {k: self._cut(k, v, part) for k, v in before.items()}
            count = part.stop - low
            log[part] = predictive.log_density({**known, **values}, count, rng)
        return _floored(log) if predictive.exact else _shared(_floored(log))

    def treated(self, row: Row) -> dict[str, str]:
        """What the look ahead does to each hidden node of a row's slice that it concerns."""
        return self._predictive(row).treated()

    def _predictive(self, row: Row) -> _Predictive:
        if any(o.mask is not None for o in row.seen.values()):
            return _Predictive(self.plan, row)
        key = frozenset(row.seen)
        if key not in self._kept:
            self._kept[key] = _Predictive(self.plan, row)
        return self._kept[key]

    def _cut(self, name: str, value: np.ndarray, part: slice) -> np.ndarray:
        rank = len(self.plan.slices.later[name].value_shape)
        return value if value.ndim == rank else value[part]


class GivenStage:
    """A first stage by a user's function of the slice before and the row: log factors, one per particle."""

    def __init__(self, plan: SlicePlan, function: Callable[..., Any], particles: int) -> None:
        self.plan, self.model, self.particles = plan, plan.slices.later, particles
        self.parents, self.function = bind("auxiliary", function, None)
        for parent in self.parents:
            if parent not in self.model.nodes:
                nodes = {n: c.declaration for n, c in self.model.nodes.items()}
                raise UnknownNodeError(
                    f"ParticleFilter: auxiliary= names {parent!r}: {unknown(nodes, parent)}"
                )
        nodes_read = [self.model[p] for p in self.parents]
        self.links = tuple(
            (n.name, Aligner(plan.apart, n.plates, len(n.event_shape), n.domain))
            for n in nodes_read
        )

    def __call__(
        self, before: Mapping[str, np.ndarray], row: Row, rng: np.random.Generator
    ) -> np.ndarray:
        values = {**self.plan.known(row), **before}
        lead = tuple(self.plan.slices.first.sizes[p] for p in self.plan.apart)
        if any(p not in values for p in self.parents):  # what it looks at is missing
            return np.zeros((self.particles, *lead))
        arguments, batch = arguments_of(self.links, values)
        found = np.asarray(self.function(*arguments), dtype=float)
        if found.shape != (*batch, *lead) or np.isnan(found).any():
            raise ModelError(
                f"ParticleFilter: auxiliary= returns shape {found.shape} "
                f"{'with NaN ' if np.isnan(found).any() else ''}in slice {row.t}; it returns one log factor "
                f"per particle, shape {(*batch, *lead)}"
            )
        return _floored(np.broadcast_to(found, (self.particles, *lead)))


# ---- private ------------------------------------------------------------------------------------


class _Predictive:
    """The density of a row given the slice before, of a plan: what is integrated, summed over and drawn."""

    def __init__(self, plan: SlicePlan, row: Row) -> None:
        self.plan, self.row, self.model = plan, row, plan.slices.later
        self.lead = tuple(self.model.sizes[p] for p in plan.apart)
        self.order = order_of(self.model, plan.slices)
        self.groups = groups_of(self.model, self.order, row.seen, self._looks)
        self.looks = [
            look_ahead(
                self.model, g.block, {n: row.seen[n].mask for n in g.seen}, self.order, plan.apart,
                is_affine(self.model, g),
            )
            for g in self.groups
        ]  # fmt: skip
        self.wanted = self._wanted()
        free = [n for n in self.wanted if self.model[n].is_stochastic and not self._known(n)]
        self.cases = self._cases(free)
        summed_over = free if self.cases is not None else []
        self.steps = self._steps(frozenset(summed_over))
        drawn = len(free) > len(summed_over)
        self.rounds: list[dict[str, np.ndarray]] = (
            self.cases if self.cases is not None else [{}] * _DRAWS
        )
        self.each = -math.log(_DRAWS) if drawn else 0.0
        self.exact = not drawn and all(is_affine(self.model, g) for g in self.groups)

    def log_density(
        self, values: Mapping[str, np.ndarray], count: int, rng: np.random.Generator
    ) -> np.ndarray:
        """Logs, shape ``(count, *apart)``, given the slice before and what was seen."""
        total = np.full((count, *self.lead), -np.inf)
        for case in self.rounds:
            state = Pass(rng, (count,), {**values, **case})
            for step in self.steps:
                step(state)
            log = np.asarray(state.log_weight, dtype=float)
            total = np.logaddexp(total, np.where(np.isnan(log), -np.inf, log) + self.each)
        return total

    def treated(self) -> dict[str, str]:
        """What is done to each hidden node that matters."""
        found = {n: "integrated out" for g in self.groups for n in g.block if g.seen}
        drawn = [n for n in self.wanted if self.model[n].is_stochastic and not self._known(n)]
        how = "summed over" if self.cases is not None else f"drawn {_DRAWS} times"
        return found | dict.fromkeys(drawn, how)

    def _looks(self, name: str) -> bool:
        """Whether a node that depends on hidden numbers is integrated over these."""
        seen = self.row.seen[name]
        if seen.mask is not None and any(name in self.model[n].parents for n in self.order):
            return False  # its missing elements are needed
        return why_not_looked_at(self.model, name) is None

    def _known(self, name: str) -> bool:
        return name in self.row.seen and self.row.seen[name].mask is None

    def _wanted(self) -> list[str]:
        """Nodes whose values are needed; those that are only integrated out are not."""
        via: dict[str, set[str]] = {}
        for group, look in zip(self.groups, self.looks, strict=True):
            between = {n for names in look.between.values() for n in names}
            inside = {*group.block, *between}
            via |= dict.fromkeys((*inside, *group.seen), inside)
        wanted: set[str] = set()
        for name in reversed(self.order):
            whole = name in wanted or (name in self.row.seen and name not in via)
            if whole or name in via:
                above = (p for p in self.model[name].parents if p in self.order)
                inside = set() if whole else via[name]
                wanted |= {p for p in above if p not in inside and not self._known(p)}
        return [n for n in self.order if n in wanted]

    def _cases(self, free: Sequence[str]) -> list[dict[str, np.ndarray]] | None:
        """All values of the nodes that are free, if they are finite and few; None otherwise."""
        nodes = [self.model[n] for n in free]
        sizes = [n.domain.size if n.domain is not None else _CASES + 1 for n in nodes]
        together = all(set(n.plates) <= set(self.plan.apart) for n in nodes)
        if math.prod(sizes) > _CASES or not together or any(n in self.row.seen for n in free):
            return None
        found = []
        for index in np.ndindex(*sizes):
            pairs = zip(nodes, index, strict=True)
            found.append({n.name: np.full(n.plate_shape, k, _type(n)) for n, k in pairs})
        return found

    def _steps(self, summed_over: frozenset[str]) -> list[Step]:
        looked = {n for g in self.groups for n in g.seen}
        found: list[Step] = []
        for group, look in zip(self.groups, self.looks, strict=True):
            for name in (*group.before, None, *group.after):
                if name is None:
                    if group.block:
                        found.append(_Integrated(look, bool(set(group.block) & set(self.wanted))))
                elif name in group.block or name in looked:
                    continue
                elif name in summed_over:
                    found.append(self.plan.factor(self.row, name))
                elif name in self.wanted or name in self.row.seen:
                    found.append(self.plan.step(self.row, name))
        return found


class _Integrated:
    """A block integrated out; drawn, too, where something else depends on it."""

    def __init__(self, look: LookAhead | ByCase, drawn: bool) -> None:
        self.look, self.drawn = look, drawn

    def __call__(self, state: Pass) -> None:
        look: Any = self.look
        belief = look.believed(state)
        state.weigh(belief.log_density)
        if self.drawn:
            look.draw(state, belief)


def _type(node: CompiledNode) -> Any:
    return node.domain.dtype if node.domain is not None else float


def _floored(log: np.ndarray) -> np.ndarray:
    top = log.max(axis=0)
    if not np.all(np.isfinite(top)):
        return np.where(np.isfinite(top), np.maximum(log, top + _LEAST), 0.0)
    return np.maximum(log, top + _LEAST)


def _shared(log: np.ndarray) -> np.ndarray:
    """A mixture of factors and their mean over the particles."""
    mean = np.logaddexp.reduce(log, axis=0) - math.log(len(log))
    return np.logaddexp(math.log1p(-_SHARE) + log, math.log(_SHARE) + mean)
